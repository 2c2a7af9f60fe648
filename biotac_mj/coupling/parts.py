"""Elements that a BioTac adds to an MjSpec, for `attach` and for `batch.add`: body, meshes, sensors, and
plugin state for what touches it."""

import importlib.resources
from collections.abc import Iterable

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ..fields import as_real
from ..geometry.rigid import unit
from ..geometry.skin_geometry import RIGID, SkinGeometry
from ..short_repr import short_repr
from .config import Config, collides
from .touching import deformable


def check_place(
    spec: mujoco.MjSpec, site: str | None, body: str | None, prefix: str, pos: ArrayLike, quat: ArrayLike
) -> None:
    """Raises the errors of `attach` about a spec, place or prefix."""
    if not isinstance(spec, mujoco.MjSpec):
        raise TypeError(f"spec is {type(spec).__name__}: pass a mujoco.MjSpec, before it is compiled")
    if site is None and body is None:
        raise ValueError("no place is given: pass site= or body=; body='world' fixes the BioTac to the world")
    if site is not None and body is not None:
        raise ValueError(f"both site {site!r} and body {body!r} are given: a BioTac is fixed to one of them")
    for kind, name, present in (("site", site, spec.sites), ("body", body, spec.bodies)):
        if name is not None and not isinstance(name, str):
            raise ValueError(f"{kind} is {short_repr(name)}: give the name of a {kind} of the model")
        if name is not None and name not in [p.name for p in present]:
            raise ValueError(
                f"no {kind} {short_repr(name)} to attach to: the model has "
                f"{', '.join(p.name for p in present if p.name) or f'no named {kind}'}"
            )
    for what, value, size in (("pos", pos, 3), ("quat", quat, 4)):
        elements = _listed(value, size)
        if elements is None:
            raise ValueError(f"{what} is {short_repr(value)}: give {size} numbers")
        for number in elements:
            as_real(f"{what} {short_repr(value)} has an element that", number)
    if not np.any(quat):
        raise ValueError("quat is zero: give a rotation (w, x, y, z), such as (1, 0, 0, 0)")
    if not isinstance(prefix, str) or not prefix or not prefix.isprintable():  # MJCF has no empty names
        raise ValueError(f"prefix is {short_repr(prefix)}: give a text that the BioTac's names begin with")
    if any(b.name == prefix + "core" for b in spec.bodies):
        raise ValueError(
            f"prefix {prefix!r} is taken by another BioTac of this model: give each one its own prefix"
        )


def _listed(value, size):
    """Values of a list or array (size,); None for anything else."""
    try:
        return list(value) if np.shape(value) == (size,) else None
    except Exception:  # numpy refuses uneven lists, and others' arrays raise what they like
        return None


def check_touching(spec: mujoco.MjSpec, wanted: Iterable[str], geoms: Iterable[str] | None) -> None:
    """Raises ValueError for a name that no geom of the model has, and for a flex that collides with a
    BioTac whose `geoms` is not given."""
    flexes = [repr(flex.name) for flex in spec.flexes if geoms is None and collides(flex)]
    if flexes:
        raise ValueError(deformable(flexes))
    names = [g.name for g in spec.geoms]
    for name in wanted:
        if name not in names:
            raise ValueError(
                f"no geom {short_repr(name)} to touch: the model has "
                f"{', '.join(n for n in names if n) or 'no named geom'}"
            )


def add_parts(
    spec: mujoco.MjSpec,
    geometry: SkinGeometry,
    site: str | None,
    body: str | None,
    pos: ArrayLike,
    quat: ArrayLike,
    prefix: str,
    config: Config,
) -> mujoco.MjsBody:
    """Fixes the model of a skin to a site or body; its core, nail and clamp collide with config's geoms, or
    with all that collides. The core's body, whose frame is the BioTac frame."""
    child = _model(geometry)
    child.body("core").pos, child.body("core").quat = pos, unit(quat)  # MuJoCo squares it
    if site is not None:
        spec.attach(child, site=spec.site(site), prefix=prefix)
    else:
        spec.attach(child, frame=spec.body(body).add_frame(), prefix=prefix)
    core = spec.body(prefix + "core")
    _collide(spec, core, config.friction, config.priority, config.geoms)
    return core


def add_slots(spec: mujoco.MjSpec, core: mujoco.MjsBody, prefix: str, count: int, first: int = 0) -> None:
    """Inactive welds whose rows the coupling writes: one for each body that may touch."""
    for i in range(first, first + count):
        spec.add_equality(
            name=f"{prefix}couple{i}",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=core.name,
            active=False,
            # as good as nothing wherever the plugin does not write the rows: no stiffness, no damping, least
            # impedance
            solref=[0.0, 0.0],
            solimp=[1e-4, 1e-4, 1.0, 0.5, 1.0],
        )


def _model(geometry):
    """mjcf/biotac.xml with the meshes, electrodes and outer surface of a skin."""
    with importlib.resources.as_file(importlib.resources.files("biotac_mj.mjcf")) as folder:
        spec = mujoco.MjSpec.from_file(str(folder / "biotac.xml"))
    for part in RIGID:
        mesh, vert, face = (
            spec.mesh(part),
            getattr(geometry, f"{part}_vert"),
            getattr(geometry, f"{part}_face"),
        )
        if len(face) == 0:
            spec.delete(next(g for g in spec.geoms if g.name == part))
            spec.delete(mesh)
            continue
        mesh.file = ""
        mesh.uservert, mesh.userface = vert.ravel().tolist(), face.ravel().tolist()
    _set_channels(spec, geometry)
    node, face = np.unique(geometry.outer_face, return_inverse=True)
    skin = spec.skins[0]
    skin.vert, skin.face = geometry.vert[node].ravel().tolist(), face.ravel().tolist()
    skin.bodyname, skin.bindpos, skin.bindquat = ["core"], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    skin.vertid, skin.vertweight = [list(range(len(node)))], [[1.0] * len(node)]
    return spec


def _set_channels(spec, geometry):
    """Sites of the electrodes and widths of the sensors, as the skin's design has them."""
    core, design = spec.body("core"), geometry.design
    there = [site for site in spec.sites if site.name[1:].isdigit()]
    for site in there[design.nelectrode :]:
        spec.delete(site)
    for name in design.electrodes[len(there) :]:
        core.add_site(there[0].classname, name=name)
    for name, position in zip(design.electrodes, geometry.electrode_pos):
        spec.site(name).pos = position
    for name, width in design.widths.items():
        if width:
            spec.sensor(name).dim = width
        else:
            spec.delete(spec.sensor(name))


def _collide(spec, core, friction, priority, geoms):
    """Core, nail and clamp meet what the skin meets: the geoms that are named, or all that collide."""
    for solid in core.geoms:
        solid.friction[0], solid.priority = friction, priority
        if geoms is None:
            continue
        solid.contype = solid.conaffinity = 0
        for name in geoms:
            if not (spec.geom(name).contype or spec.geom(name).conaffinity):
                continue  # nothing solid stops it
            spec.add_pair(
                geomname1=solid.name,
                geomname2=name,
                condim=3,
                solref=solid.solref,
                friction=[max(friction, spec.geom(name).friction[0])] * 2 + [5e-3, 1e-4, 1e-4],
            )
