"""Presses whose answers `skin_oracle.npz` keeps, as `scripts/freeze_oracle.py` wrote them.

Every case has one answer that does not depend on how it is found: nothing snaps in a step, and steps end far
closer to balance than answers are compared. Sharp corners of mesh geoms would spoil this: skin then has
several places to rest.
"""

import dataclasses
import functools
import math
import pathlib
from collections.abc import Callable

import numpy as np
import trimesh
from blocks import boundary, box, faces_on, four_nodes, shell, skin

from biotac_mj.geometry import load_skin
from biotac_mj.skin import (
    ContactLaw,
    GeomSet,
    Material,
    SkinData,
    SkinModel,
    SkinOptions,
    bake_distance_grid,
    step,
)

__all__ = ["CASES", "FILE", "Case", "halved", "solve"]

FILE = pathlib.Path(__file__).with_suffix(".npz")
TIGHT = dict(tolerance=1e-9, max_newton=300, max_cg=300)
SAMPLE = 30  # nodes whose displacements are kept, about
DOWN = np.diag([1.0, -1.0, -1.0])  # a plane that faces -z


@dataclasses.dataclass(frozen=True)
class Case:
    """One press.

    Attributes:
      covers: what it is there for.
      geometry: () -> SkinGeometry.
      material, worlds: of the model, and one for each world; None: one world of the model's.
      geoms: arguments of GeomSet but the number of worlds, or a function that makes them.
      pos: (nstep, ngeom, 3) or (nstep, nworld, ngeom, 3), where the steps end [m].
      mat: rotations (ngeom, 3, 3), or (nstep, ngeom, 3, 3), or None.
      kept: steps whose answers are kept, counted from zero.
      options, model: arguments of SkinOptions and of SkinModel beyond geometry and material.
      liquid: arguments of `set_liquid`.
      load: (rest positions (n, 3), step) -> external forces (nworld, n, 3) [N].
      dt: [s].
      core_pos, core_mat: (nstep, nworld, 3), (nstep, nworld, 3, 3) of the moving core.
      elastic: whether the answers depend on where the geoms are alone, not on how they came there. Liquid of
        infinite modulus is not: its pressure starts from that of the last step.
      tangent: whether the tangent is kept. Not of nearly incompressible rubber in a single world: there it
        depends on when the solver last renewed its factor.
    """

    covers: str
    geometry: Callable
    material: Material
    geoms: dict | Callable
    pos: np.ndarray
    kept: tuple
    mat: np.ndarray | None = None
    worlds: tuple | None = None
    options: dict = dataclasses.field(default_factory=dict)
    model: dict = dataclasses.field(default_factory=dict)
    liquid: dict = dataclasses.field(default_factory=dict)
    load: Callable | None = None
    dt: float | None = None
    core_pos: np.ndarray | None = None
    core_mat: np.ndarray | None = None
    elastic: bool = False
    tangent: bool = True


def solve(case, device="cpu", modulus=1.0, preconditioner=None, **options):
    """The answers of a case.

    Args:
      modulus: factor on Young's moduli.
      preconditioner: of SkinData; None: the device's own.
      options: beyond or instead of the case's.

    Returns:
      Arrays (kept step, world, ...) of each quantity; "converged" is of all steps.
    """
    given = (case.material, *(case.worlds or (case.material,)))
    rubber, *worlds = (dataclasses.replace(m, youngs_modulus=modulus * m.youngs_modulus) for m in given)
    if case.worlds:  # what froze the answers had one contact stiffness for all worlds, the model's
        options = {"contact_stiffness": 180e3 * rubber.youngs_modulus, **options}
    options = SkinOptions(**{**TIGHT, **case.options, **options})
    model = SkinModel(case.geometry(), rubber, options, device=device, **case.model)
    data = SkinData(model, len(worlds), worlds, preconditioner=preconditioner)
    touching = case.geoms() if callable(case.geoms) else case.geoms
    geoms = GeomSet(**touching, nworld=len(worlds), device=device)
    if case.liquid:
        data.set_liquid(**case.liquid)
    out, rest = {"converged": []}, model.geometry.vert
    for k, pos in enumerate(case.pos):
        geoms.set_pose(pos, case.mat if case.mat is None or np.ndim(case.mat) == 3 else case.mat[k])
        if case.load:
            data.set_external(case.load(rest, k))
        frame = [None if a is None else a[k] for a in (case.core_pos, case.core_mat)]
        step(model, data, geoms, case.dt, *frame)
        out["converged"].append(np.array(data.converged))
        if k in case.kept:
            for name, value in _answers(model, data, geoms, case.tangent).items():
                out.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in out.items()}


def _answers(model, data, geoms, tangent):
    moved = data.vert_xpos - model.geometry.vert
    sample = model.free[:: -(-len(model.free) // SAMPLE)]
    out = {
        "displacement": moved[:, sample],
        "mean_displacement": np.concatenate([moved.mean(1), np.sqrt((moved**2).sum(2).mean(1))[:, None]], 1),
        "force": data.wrench[..., :3],
        "torque": data.wrench[..., 3:],
        "contact_force": _total(data.contact_force),
        "core_force": _total(data.core_force),
        "pressure": np.array(data.pressure),
        "volume": np.array(data.volume),
    }
    if tangent:
        K = data.tangent(geoms)
        out |= {"translation": K[..., :3, :3], "rotation": K[..., 3:, 3:], "coupling": K[..., :3, 3:]}
    return out


def _total(force):
    """(nworld, 4) [N]: sum over nodes, and that of magnitudes, which pushes from all sides do not cancel."""
    return np.concatenate([force.sum(1), np.linalg.norm(force, axis=2).sum(1)[:, None]], 1)


def halved(case):
    """The case in half steps."""
    pos = np.asarray(case.pos)
    half = np.empty((2 * len(pos) - 1, *pos.shape[1:]))
    half[::2], half[1::2] = pos, (pos[1:] + pos[:-1]) / 2
    return dataclasses.replace(case, pos=half, kept=tuple(2 * k for k in case.kept))


# --- bodies -------------------------------------------------------------------------------------------------


@functools.cache
def pad(cells=(6, 6, 3), size=(10e-3, 10e-3, 4e-3)):
    """A pad held at z = 0, to be touched on top."""
    vert, elem = box([np.linspace(0, s, n + 1) for s, n in zip(size, cells)], jitter=0.2)
    top = faces_on(vert, boundary(elem), 2, size[2])
    return skin(vert, elem, np.flatnonzero(vert[:, 2] == 0), outer_face=top, name="pad")


@functools.cache
def small_pad():
    """For ten-node elements."""
    return pad(cells=(4, 4, 2))


@functools.cache
def long_pad():
    return pad(cells=(12, 8, 2), size=(24e-3, 16e-3, 4e-3))


@functools.cache
def bar():
    """20 mm long, held at x = 0."""
    vert, elem = box([np.linspace(0, 20e-3, 7), np.linspace(0, 5e-3, 3), np.linspace(0, 5e-3, 3)], jitter=0.1)
    return skin(vert, elem, np.flatnonzero(vert[:, 0] == 0), name="bar")


@functools.cache
def ball(subdivisions=2, inner=8.5e-3, core=7e-3):
    """A shell of 20 mm diameter about a core, held below."""
    vert, elem, inner_face = shell(10e-3, inner, subdivisions, layers=2)
    rigid = trimesh.creation.icosphere(subdivisions=3, radius=core)
    held = np.flatnonzero(vert[:, 2] < -6e-3)
    return skin(vert, elem, held, inner_face=inner_face, core=(rigid.vertices, rigid.faces), name="ball")


@functools.cache
def small_ball():
    """For ten-node elements."""
    return ball(subdivisions=1)


@functools.cache
def thick_ball():
    """Its wall is too thick to buckle where it is dented."""
    return ball(inner=7.5e-3, core=6.5e-3)


@functools.cache
def pebble():
    """Grid of a mesh geom; a body with sharp corners would have several balances."""
    body = trimesh.creation.icosphere(subdivisions=3)
    return bake_distance_grid(body.vertices * [3e-3, 2.5e-3, 2e-3], body.faces, spacing=2e-4, margin=1e-3)


# --- paths --------------------------------------------------------------------------------------------------


def one(*points):
    """(nstep, 1, 3) of one geom from points in millimetres."""
    return 1e-3 * np.array(points, float)[:, None]


def sphere(radius, friction=0.0):
    return dict(types=["sphere"], sizes=[(radius,)], friction=[friction])


def turned(axis, *angles):
    """Rotations (n, 1, 3, 3) about a coordinate axis [rad]."""
    out = np.tile(np.eye(3), (len(angles), 1, 1, 1))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    c, s = np.cos(angles), np.sin(angles)
    out[:, 0, i, i], out[:, 0, j, j], out[:, 0, i, j], out[:, 0, j, i] = c, c, -s, s
    return out


def centre(*heights, x=4.7, y=5.2):
    """Above a point of the pad that is no node [mm]."""
    return one(*[(x, y, z) for z in heights])


def above(*heights, x=0.8, y=-0.5):
    """Above the ball [mm]."""
    return one(*[(x, y, z) for z in heights])


RUBBER = dict(youngs_modulus=1e6, poissons_ratio=0.3)
DRY = dict(liquid=False)


def uneven(p):
    return 1 + 0.5 * np.sin(400 * p[:, 0]) * np.cos(300 * p[:, 2])


def pulled(rest, k, size=3e-4):
    """Loads on all nodes that grow from step to step [N]."""
    x, _, z = rest.T
    return size * (k + 1) * np.stack([np.sin(300 * z), np.cos(200 * x), 100 * z], 1)[None]


def shaken(n, worlds=1):
    """Poses of a core that swings: positions (n, worlds, 3) [m] and rotations (n, worlds, 3, 3)."""
    t = np.arange(1, n + 1)[:, None] * (1 + 0.5 * np.arange(worlds))
    pos = 3e-4 * np.stack([np.sin(t), 0.5 * t, 1 - np.cos(0.7 * t)], -1)
    return pos, turned(1, *(0.02 * np.sin(t).ravel())).reshape(n, worlds, 3, 3)


def many():
    return dict(
        types=["mesh", "box", "capsule", "cylinder", "ellipsoid", "plane", "cylinder"],
        sizes=[
            (),
            (1.5e-3, 1e-3, 1e-3),
            (1e-3, 2e-3),
            (1.2e-3, 2e-3),
            (1.5e-3, 1e-3, 2e-3),
            (),
            (1.5e-3, 1e-3),
        ],
        friction=[0.3, 0.0, 0.5, 0.2, 0.6, 0.1, 0.4],
        groups=[0, 0, 1, 1, 2, 3, 1],
        rounding=[0, 5e-4, 0, 6e-4, 0, 0, 5e-4],
        grids=[pebble()],
    )


# where each of them just touches the long pad [m], and how it lies
PARTS_AT = 1e-3 * np.array(
    [[4, 4, 6], [10, 4, 5], [4, 11, 5], [11, 11.5, 5.2], [17, 5, 5], [24, 8, 4], [18, 11, 5]]
)
PARTS_LIE = np.concatenate([
    turned(2, 0.3)[:, 0], turned(2, 0.7)[:, 0], turned(1, np.pi / 2)[:, 0], turned(0, np.pi / 2 + 0.05)[:, 0],
    turned(1, np.pi / 2 + 0.2)[:, 0], turned(1, 0.1)[:, 0] @ DOWN, turned(0, 0.05)[:, 0],
])  # fmt: skip


def parts(depth, drag=0.0):
    out = PARTS_AT.copy()
    out[:, 2] -= depth
    out[:, 0] += drag
    return out


MEMORY = dict(prony=((0.4, 0.02), (0.2, 0.3)), mullins=(2.0, 2e3, 0.2), hysteresis=((0.5, 0.02), (0.3, 0.1)))

CASES = {
    "plane_on_linear_pad": Case(
        "the linear law, a plane that is tilted",
        pad, Material("linear", **RUBBER), dict(types=["plane"], sizes=[()]), centre(3.95, 3.85, 3.7),
        kept=(0, 2), mat=turned(0, 0.04)[0] @ DOWN, elastic=True,
    ),
    "linear_law_ten_nodes": Case(
        "the linear law with ten-node elements",
        small_pad, Material("linear", 1e6, 0.45), sphere(5e-3), centre(8.9, 8.8, 8.7), kept=(0, 2),
        options=dict(element="quadratic"), elastic=True,
    ),
    "svk_bar": Case(
        "svk, loads on the nodes, nothing that touches",
        bar, Material("svk", **RUBBER), dict(types=[], sizes=[]), np.zeros((3, 0, 3)), kept=(0, 2),
        load=pulled,
    ),
    "svk_ten_nodes_box": Case(
        "svk with ten-node elements, a rounded box that twists, sticks and slips",
        small_pad, Material("svk", **RUBBER),
        dict(types=["box"], sizes=[(2e-3, 1.5e-3, 1e-3)], friction=[0.4], rounding=[5e-4]),
        centre(4.95, 4.85, 4.8, 4.8, 4.8), kept=(1, 2, 4), mat=turned(2, 0.2, 0.2, 0.22, 0.3, 0.5),
        options=dict(element="quadratic"),
    ),
    "corotational_slide": Case(
        "a sphere that is dragged: stick, slip and back",
        pad, Material(**RUBBER), sphere(4e-3, 0.5),
        one((4, 5, 7.9), (4, 5, 7.7), (4.02, 5, 7.7), (4.1, 5, 7.7), (4.4, 5.1, 7.7), (4.3, 5.1, 7.7)),
        kept=(1, 2, 4, 5),
    ),
    "corotational_ten_nodes_roll": Case(
        "a lying cylinder that rolls, ten-node elements, two samples a side",
        small_pad, Material(**RUBBER),
        dict(types=["cylinder"], sizes=[(3e-3, 4e-3)], friction=[0.8], rounding=[1e-3]),
        one((4, 5, 6.9), (4, 5, 6.75), (4.1, 5, 6.75), (4.3, 5, 6.75)), kept=(1, 3),
        mat=turned(1, 0, 0, 0.033, 0.1) @ turned(0, np.pi / 2),
        options=dict(element="quadratic", samples=2, stick_ratio=0.3),
    ),
    "incompressible": Case(
        "rubber of nu 0.495 in ten-node elements",
        small_pad, Material("neo_hookean", 2.8e5, 0.495), sphere(4e-3), centre(7.9, 7.7, 7.4), kept=(0, 2),
        options=dict(element="quadratic"), elastic=True, tangent=False,
    ),
    "incompressible_worlds": Case(
        "the same in two worlds, whose factor is never renewed, with friction",
        small_pad, Material("neo_hookean", 2.8e5, 0.49), sphere(4e-3, 0.6),
        np.stack([one((4, 5, 7.9), (4, 5, 7.7), (4, 5, 7.6), (4.3, 5, 7.6)),
                  one((5, 5, 7.9), (5, 5, 7.6), (5, 5, 7.5), (5.3, 5, 7.5))], 1),
        kept=(1, 3), worlds=(Material("neo_hookean", 2.8e5, 0.49), Material("neo_hookean", 4e5, 0.485)),
        options=dict(element="quadratic"),
    ),
    "water": Case(
        "a ball full of water",
        ball, Material(**RUBBER), sphere(3.5e-3, 0.3), above(13.2, 12.9, 12.6), kept=(0, 2),
        options=dict(liquid=True),
    ),
    "incompressible_liquid": Case(
        "a liquid that keeps its volume, and neo-Hookean rubber",
        ball, Material("neo_hookean", 2.8e5, 0.45), sphere(5e-3), above(14.8, 14.4, 14.0), kept=(0, 2),
        options=dict(liquid=True, bulk_modulus=math.inf),
    ),
    "dry_core": Case(
        "pressed through to the core, without liquid",
        thick_ball, Material(**RUBBER), sphere(3.5e-3), above(12.9, 12.3, 11.8, 11.4), kept=(1, 3),
        options=DRY, elastic=True,
    ),
    "core_in_liquid": Case(
        "pressed through to the core in a soft liquid",
        ball, Material(**RUBBER), sphere(3.5e-3, 0.2), above(13.0, 12.4, 11.8, 11.5), kept=(1, 3),
        options=dict(liquid=True, bulk_modulus=1e5),
    ),
    "core_ten_nodes": Case(
        "the same with ten-node elements and svk",
        small_ball, Material("svk", **RUBBER), sphere(3.5e-3), above(12.6, 12.0, 11.5, 11.3), kept=(0, 1, 3),
        options=dict(liquid=True, bulk_modulus=1e5, element="quadratic"),
    ),
    "filled": Case(
        "skin that its liquid inflates, pressed and let go",
        ball, Material("neo_hookean", 2.8e5, 0.45), sphere(4e-3), above(14.0, 13.6, 16.0), kept=(0, 1, 2),
        options=dict(liquid=True, bulk_modulus=1e6, fill_volume=1.5e-7), elastic=True,
    ),
    "rest_pressure": Case(
        "skin under a given pressure at rest, ten-node elements",
        small_ball, Material("neo_hookean", 1e6, 0.4), sphere(4e-3), above(13.8, 13.4), kept=(0, 1),
        options=dict(liquid=True, bulk_modulus=1e7, rest_pressure=4e3, element="quadratic"), elastic=True,
    ),
    "swinging_bar": Case(
        "implicit dynamics on a core that swings, both dampings, loads",
        bar, Material("neo_hookean", **RUBBER), dict(types=[], sizes=[]), np.zeros((5, 0, 3)), kept=(0, 2, 4),
        options=dict(dynamics="implicit", mass_damping=20.0, stiffness_damping=2e-4), load=pulled, dt=2e-3,
        core_pos=shaken(5)[0], core_mat=shaken(5)[1],
    ),
    "struck_ball": Case(
        "implicit dynamics with liquid, core and friction in two worlds",
        ball, Material(**RUBBER), sphere(3.5e-3, 0.4),
        np.stack([above(13.3, 12.9, 12.5, 12.7), above(13.3, 12.9, 12.6, 12.8, x=2)], 1), kept=(1, 3),
        worlds=(Material(**RUBBER), Material("corotational", 1.3e6, 0.35)), dt=1e-3,
        options=dict(dynamics="implicit", stiffness_damping=1e-4, liquid=True, bulk_modulus=1e6),
        core_pos=shaken(4, 2)[0], core_mat=shaken(4, 2)[1],
    ),
    "prony": Case(
        "relaxation in two terms: pressed, held, let go",
        pad, Material("neo_hookean", **RUBBER, prony=MEMORY["prony"]), sphere(4e-3),
        centre(7.8, 7.6, 7.6, 7.7), kept=(1, 2, 3), dt=0.02,
    ),
    "prony_ten_nodes": Case(
        "the same in ten-node elements, corotational",
        small_pad, Material(**RUBBER, prony=MEMORY["prony"]), sphere(4e-3), centre(7.8, 7.6, 7.7),
        kept=(1, 2), dt=0.05, options=dict(element="quadratic"),
    ),
    "mullins": Case(
        "softening: in, out, in and further",
        pad, Material("svk", **RUBBER, mullins=MEMORY["mullins"]), sphere(4e-3),
        centre(7.8, 7.5, 7.7, 7.6, 7.4), kept=(1, 2, 4),
    ),
    "hysteresis": Case(
        "two friction elements in the rubber: in, out, in",
        pad, Material(**RUBBER, hysteresis=MEMORY["hysteresis"]), sphere(4e-3), centre(7.8, 7.5, 7.7, 7.6),
        kept=(1, 2, 3),
    ),
    "hysteresis_ten_nodes": Case(
        "the same in ten-node elements, neo-Hookean",
        small_pad, Material("neo_hookean", **RUBBER, hysteresis=MEMORY["hysteresis"]), sphere(4e-3),
        centre(7.7, 7.5, 7.7), kept=(1, 2), options=dict(element="quadratic"),
    ),
    "stiffening": Case(
        "rubber that stiffens",
        pad, Material("neo_hookean", **RUBBER, stiffening=0.8), sphere(4e-3), centre(7.7, 7.3, 7.0),
        kept=(0, 2), elastic=True,
    ),
    "softening": Case(
        "a negative second term, ten-node elements, corotational; stiff contact",
        small_pad, Material(**RUBBER, stiffening=-0.5), sphere(4e-3), centre(7.7, 7.4, 7.2), kept=(0, 2),
        options=dict(element="quadratic", contact_stiffness=6e11), elastic=True,
    ),
    "modulus_of_elements": Case(
        "rubber that is not the same everywhere, given as numbers",
        pad, Material("corotational", **RUBBER), sphere(4e-3), centre(7.8, 7.5), kept=(0, 1), elastic=True,
        model=dict(modulus=1 + 0.5 * np.sin(np.arange(648))),
    ),
    "modulus_of_places": Case(
        "the same as a function of place, in a ball of ten-node elements",
        small_ball, Material("neo_hookean", **RUBBER), sphere(4e-3), above(13.7, 13.2), kept=(0, 1),
        options=dict(liquid=True, bulk_modulus=1e6, element="quadratic", core_contact=False),
        model=dict(modulus=uneven),
        elastic=True,
    ),
    "adhesion": Case(
        "a sphere that pulls before it touches, parts with more work than it joined, and comes off",
        pad, Material(**RUBBER), sphere(4e-3), centre(8.05, 7.98, 8.04, 8.1, 8.3), kept=(0, 1, 2, 3, 4),
        options=dict(contact_law=ContactLaw(adhesion=0.1, adhesion_hysteresis=2.0, adhesion_range=2e-4)),
    ),
    "friction_exponent": Case(
        "friction that falls with pressure: stick, then slip",
        pad, Material(**RUBBER), sphere(4e-3, 0.3),
        one((4, 5, 7.8), (4, 5, 7.7), (4.05, 5, 7.7), (4.3, 5, 7.7)), kept=(1, 2, 3),
        options=dict(contact_law=ContactLaw(friction_exponent=1 / 3, friction_pressure=1e5)),
    ),
    "many_geoms": Case(
        "a mesh, rounded boxes and cylinders, capsule, ellipsoid and plane in four groups, dragged",
        long_pad, Material("neo_hookean", 1e6, 0.4), many,
        np.array([parts(5e-5), parts(1.5e-4), parts(2e-4, 1e-4)]), kept=(0, 2), mat=PARTS_LIE,
    ),
    "worlds": Case(
        "worlds of their own material, liquid and path",
        ball, Material("neo_hookean", 1e6, 0.4),
        dict(types=["sphere", "box"], sizes=[(3.5e-3,), (2e-3, 2e-3, 2e-3)], friction=[0.5, 0.2],
             groups=[0, 1], rounding=[0, 5e-4]),
        1e-3 * np.array([[[[0.3 * d, w, 13.5 - d], [12 - 0.5 * d, 0, 0.3 * w]] for w in (0, 1, 2)]
                         for d in (0.1, 0.4, 0.8)]),
        kept=(0, 2),
        worlds=tuple(Material("neo_hookean", E, nu) for E, nu in ((1e6, 0.4), (6e5, 0.45), (1.5e6, 0.3))),
        options=dict(liquid=True),
        liquid=dict(bulk_modulus=[0.0, 1e6, math.inf], fill_volume=[0.0, 5e-9, -2e-9]),
    ),
    "release": Case(
        "pressed with friction, dragged, let go and met elsewhere",
        ball, Material(**RUBBER), sphere(3.5e-3, 0.6),
        one((0.8, 0, 13.2), (0.8, 0, 12.8), (1.1, 0, 12.8), (1.1, 0, 15), (-2.0, 1.0, 12.8)), kept=(2, 3, 4),
        options=dict(liquid=True, bulk_modulus=1e6),
    ),
    "large_steps": Case(
        "a millimetre and more in a step, back and forth",
        thick_ball, Material("neo_hookean", 2.8e5, 0.4), sphere(5e-3), above(13.5, 14.8, 13.2),
        kept=(0, 1, 2), options=DRY, elastic=True,
    ),
    "coarse": Case(
        "the shipped skin of ten-node elements with water",
        lambda: load_skin("coarse"), Material(), sphere(3.5e-3, 0.5),
        one((-12, -11.6, 0.2), (-12, -11.2, 0.2), (-11.9, -11.1, 0.2)), kept=(0, 2),
        options=dict(liquid=True),
    ),
    "coarse_four_nodes": Case(
        "the shipped skin's corners as four-node elements, dry, down to the core",
        lambda: four_nodes("coarse"), Material(liquid=False), sphere(3.5e-3, 0.5),
        one((-12, -11.4, 0.2), (-12, -10.6, 0.2), (-12, -10, 0.2)), kept=(0, 2),
    ),
    "everything": Case(
        "all that the skin knows, at once",
        small_ball, Material("neo_hookean", 1e6, 0.4, stiffening=0.5, **MEMORY),
        dict(types=["sphere", "capsule"], sizes=[(3.5e-3,), (2e-3, 3e-3)], friction=[0.4, 0.2],
             groups=[0, 1]),
        1e-3 * np.array([[[[x, w, z], [12 - 0.1 * k, 0, w]] for w in (0, 1)] for k, (x, z) in
                         enumerate([(0.5, 13.2), (0.5, 12.5), (0.6, 11.8), (0.9, 11.6), (0.9, 12.2)])]),
        kept=(0, 2, 3, 4),
        worlds=(Material("neo_hookean", 1e6, 0.4, stiffening=0.5, **MEMORY),
                Material("neo_hookean", 7e5, 0.45, stiffening=0.5, **MEMORY)),
        options=dict(element="quadratic", liquid=True, bulk_modulus=2e5, fill_volume=3e-8,
                     dynamics="implicit", mass_damping=100.0, stiffness_damping=1e-4,
                     contact_law=ContactLaw(1 / 3, 1e5, 0.2, 1.5, 3e-4)),
        model=dict(modulus=uneven), load=lambda rest, k: np.repeat(pulled(rest, k, 2e-5), 2, 0),
        dt=5e-3, core_pos=shaken(5, 2)[0], core_mat=shaken(5, 2)[1],
    ),
}  # fmt: skip
