"""`add` puts a BioTac into an MjSpec without the engine plugin that mujoco_warp refuses."""

import pathlib
from collections.abc import Collection

import mujoco
from numpy.typing import ArrayLike

from ..coupling.config import OWN, Config, collides
from ..coupling.parts import add_parts, add_slots, check_place, check_touching
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import skin_of_design, skin_reference


def add(
    spec: mujoco.MjSpec,
    *,
    site: str | None = None,
    body: str | None = None,
    pos: ArrayLike = (0.0, 0.0, 0.0),
    quat: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    prefix: str = "biotac_",
    design: str | pathlib.Path | None = None,
    skin: str | pathlib.Path | SkinGeometry | None = None,
    coupling: str = "two-way",
    geoms: Collection[str] | None = None,
) -> str:
    """Step 1 of 2 (then: compile, and `batch.attach` or `make`): adds a BioTac with its sensors, and without
    the engine plugin that mujoco_warp refuses, to a model.

    Args:
      spec: the MjSpec to change. Add the objects first: two-way coupling makes room for the bodies that can
        touch and move against the BioTac now, and names those that have no name.
      site, body: name of the site or the body it is fixed to, one of them; body "world" is the world.
      pos, quat: (3,) [m], (4,) (w, x, y, z), pose of the BioTac frame there.
      prefix: of every name it adds.
      design, skin, coupling, geoms: as for `biotac_mj.attach`; give `batch.attach` the same. "one-way" makes
        no room for forces on what touches.

    Returns:
      prefix.

    Raises:
      ValueError: unknown site or body, or none given; the prefix is taken. FileNotFoundError: no such skin.
    """
    check_place(spec, site, body, prefix, pos, quat)
    config = Config(coupling=coupling, geoms=geoms)
    check_touching(spec, config.geoms or (), geoms)
    own = spec.site(site).parent if site is not None else spec.body(body)
    bodies = _movers(spec, own, prefix, geoms) if coupling == "two-way" else []
    geometry = skin_reference(skin_of_design(design, skin))[1]
    core = add_parts(spec, geometry, site, body, pos, quat, prefix, config)
    _couple(spec, core, prefix, bodies)
    if coupling == "two-way" and geoms is None:
        _couple_earlier(spec, core)
    return prefix


def _couple(spec, core, prefix, bodies):
    """Makes room for the rows of a BioTac and of bodies that it can touch."""
    there = sum(e.name.startswith(f"{prefix}couple") for e in spec.equalities)
    add_slots(spec, core, prefix, len(bodies), there)
    for i, name in enumerate(bodies, there):
        weld = spec.equality(f"{prefix}couple{i}")
        # active, so that mujoco_warp makes room for its rows; it holds as good as nothing
        weld.active, weld.name2 = True, name


def _couple_earlier(spec, core):
    """Makes room for the rows of BioTacs that were added before one whose skin theirs meet."""
    own = _mover(core)
    for geom in spec.geoms:
        body, prefix = geom.parent, geom.name.removesuffix("core")
        is_core = geom.contype & OWN and geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.name == body.name
        if not is_core or body.name == core.name:
            continue
        met = {e.name2 for e in spec.equalities if e.name.startswith(f"{prefix}couple")}
        if own.name not in met and _mover(body).name != own.name:
            own.name = own.name or f"{core.name}_on"
            _couple(spec, body, prefix, [own.name])


def _movers(spec, own, prefix, geoms):
    """Names of the bodies with joints, or the world, that carry geoms which can touch and move against body
    `own`."""
    own, names = _mover(own), {}
    for geom in spec.geoms:
        if not collides(geom) if geoms is None else geom.name not in geoms:
            continue
        body = _mover(geom.parent)
        if body.id != own.id or body.name != own.name:
            body.name = body.name or f"{prefix}touching{len(names)}"
            names[body.name] = True
    return list(names)


def _mover(body):
    """The nearest body with a joint upwards from a body, or the world."""
    while body.parent is not None and body.name != "world" and not body.joints:
        body = body.parent
    return body
