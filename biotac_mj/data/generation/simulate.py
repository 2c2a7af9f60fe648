"""Simulates the skin under a batch of motions; every interaction is a world."""

import dataclasses
import platform
from collections.abc import Callable

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from ...geometry.surface import pressure_area
from ...kernels import kernel_module
from ...skin import GeomSet, SkinModel, step
from ...skin.modes import SkinModes
from ...skin.per_world import make_worlds
from ...skin.touched import Touched
from ...skin.types import real, vec3
from ..contact import contact_labels
from ..objects import make_object
from ..schema import DISPLACEMENT_SCALE, nodes_of
from .clearance import Placed
from .readings import Readings, Touch

kernel_module(__name__)

_LARGEST_STEP = 1.0e-4  # [m] longest displacement in a step of the skin: twice that converges worse at edges
_ARM = 4e-3  # [m] lever arm that converts rotations of an object to displacements
_AWAY = 1.0  # [m] position of the objects of other worlds


@dataclasses.dataclass
class Fields:
    """Fields of the skin: k interactions of n time steps.

    Attributes:
      displacement: (k, n, nvert, 3) int16, in units of schema.DISPLACEMENT_SCALE; nodes against the
        unstressed skin.
      contact_force: (k, n, nouter, 3) float32 [N].
      wrench: (k, n, 6) of the skin on the object [N, N m]. pressure: (k, n) [Pa]. converged: (k, n) bool.
      slip: (k, n) [m/s]; drive: (k, n, nmode); gain: (k, n, nmode + 1), see `skin.touched.Touched`; empty
        without modes.
      rest: (k, nvert, 3) displacements of the skins at rest [m], if they differ; else None.
    """

    displacement: np.ndarray
    contact_force: np.ndarray
    wrench: np.ndarray
    pressure: np.ndarray
    converged: np.ndarray
    slip: np.ndarray
    drive: np.ndarray
    gain: np.ndarray
    rest: np.ndarray | None = None

    def touch(self, model: SkinModel, i: int) -> Touch:
        """The object's contact in interaction i."""
        area = pressure_area(np.linalg.norm(self.contact_force[i], axis=2), model.outer.node_areas())
        force = np.linalg.norm(self.wrench[i, :, :3], axis=1)
        return Touch(area, force, self.slip[i], self.drive[i], self.gain[i])

    def vert_xpos(self, vert: np.ndarray, i: int) -> np.ndarray:
        """(n, nvert, 3) stored node positions of interaction i [m]; vert: the skin at rest."""
        return vert + self.displacement[i] * DISPLACEMENT_SCALE

    def columns(self, model: SkinModel, i: int, read: Readings, n: int | None = None) -> dict:
        """Columns of `schema.Interaction` of the first n time steps of interaction i (None: all): the skin's,
        and what the sensor read."""
        rows = slice(n)
        force = self.contact_force[i, rows]
        rest = model.rest.vert - model.geometry.vert if self.rest is None else self.rest[i]
        moved = self.displacement[i, rows] * DISPLACEMENT_SCALE
        return {
            "displacement": self.displacement[i, rows] * np.float32(DISPLACEMENT_SCALE),
            "wrench": self.wrench[i, rows],
            "contact_force": force,
            **contact_labels(model.geometry, moved, force, rest),
            "pressure": self.pressure[i, rows],
            "impedance": read.impedance,
            "counts": read.counts,
            "pac": read.pac,
            "converged": self.converged[i, rows] & ~read.failed,
        }


def describe(model: SkinModel, skin: str, tier: str = "full") -> dict:
    """Attributes of a set: the skin's name, tier, and what its model is made of."""
    device = model.device
    return {
        "skin": skin,
        "material": dataclasses.asdict(model.material),
        "element": model.element,
        "tier": tier,
        "liquid": model.has_liquid,
        "device": device.name if device.is_cuda else platform.processor() or platform.machine(),
    }


def simulate(
    model: SkinModel,
    names: list | tuple,
    motions: list,
    progress: Callable | None = None,
    time: np.ndarray | list | None = None,
    materials: list | None = None,
    worlds: dict | None = None,
    modes: SkinModes | None = None,
    tier: str = "full",
) -> Fields:
    """Simulates all motions: on a GPU in parallel, on a CPU one after another, where a batch would only cost
    more. A step that does not converge keeps the last converged state and is marked.

    Args:
      model: the skin, on any device.
      names: object of each motion, or of all.
      motions: plan.Motions of equal length.
      progress: called with the number of completed time steps over all motions, after each step of the
        solver.
      time: (n,) of the motions' rows [s], or one for each motion; required for relaxing rubber and inertia.
        The approach before the first row takes as long as the first row's step.
      materials: one for each motion, or None for the model's.
      worlds: name -> (k,) further properties per motion, see `skin.per_world.make_worlds`.
      modes: of the skin, for slip, drive and gain; requires time.
      tier: "condensed" has no rate effects, and one skin for all motions.

    Raises:
      ValueError: an object deep inside the rigid core (plans avoid it), missing times, or a feature that the
        condensed tier lacks.
    """
    names = [names] * len(motions) if isinstance(names, str) else list(names)
    if tier == "condensed":
        if materials is not None or worlds:
            raise ValueError(
                "the condensed tier has one skin for all interactions: leave vary out, or choose tier='full'"
            )
        if modes is not None:
            raise ValueError(
                "sets of the condensed tier know no vibration: leave texture out, or tier='full'"
            )
        return _simulate_condensed(model, names, motions, progress)
    k = len(motions)
    times = [None] * k if time is None else list(time) if np.ndim(time[0]) else [time] * k
    worlds = {name: np.asarray(value) for name, value in (worlds or {}).items()}
    if model.device.is_cuda:
        return _simulate(model, names, motions, progress, times, materials, worlds, modes)
    ones = []
    for i in range(k):
        mine = None if materials is None else materials[i : i + 1]
        own = {name: value[i : i + 1] for name, value in worlds.items()}
        one = slice(i, i + 1)
        ones.append(_simulate(model, names[one], motions[one], progress, times[one], mine, own, modes))
    parts = ([getattr(one, field.name) for one in ones] for field in dataclasses.fields(Fields))
    return Fields(*(None if part[0] is None else np.concatenate(part) for part in parts))


def _simulate(model, names, motions, progress, times=None, materials=None, worlds=None, modes=None):
    nworld, nstep = len(motions), len(motions[0].pos)
    data = make_worlds(model, nworld, materials, worlds)
    scene = Scene(names, model.device, model.material.friction)
    if materials is not None:
        scene.geoms.set_friction([[m.friction] * scene.geoms.count for m in materials])
    outer = nodes_of(model.geometry)
    fields = _empty(nworld, nstep, model.nvert, len(outer), 0 if modes is None else len(modes.rate))
    if data.rests is not None:
        fields.rest = (data.rests.vert - model.geometry.vert).astype(np.float32)
    touched = None if modes is None else Touched(data, np.zeros(scene.geoms.count, int), 1, modes)
    reader = _Reader(model, outer)
    walks = [_walk(m.pos, m.mat) for m in motions]
    clocks = None
    if times is not None and times[0] is not None:
        clocks = [clock(walk[2], time, time[1] - time[0])[0] for walk, time in zip(walks, times)]
    scene.place([w[0][0] for w in walks], [w[1][0] for w in walks])
    for k in range(max(len(w[0]) for w in walks)):
        at = [min(k, len(w[0]) - 1) for w in walks]  # finished motions stay at their end
        scene.place([w[0][i] for w, i in zip(walks, at)], [w[1][i] for w, i in zip(walks, at)])
        dt = None if clocks is None else np.array([c[i] for c, i in zip(clocks, at)])
        if touched:
            touched.begin()
        step(model, data, scene.geoms, dt)
        there = np.array([[i, w[2][k]] for i, w in enumerate(walks) if k < len(w[0]) and w[2][k] >= 0])
        if not len(there):
            continue
        world, row = there.T
        # convergence at the stored pose; failures of intermediate steps that were corrected do not count
        fields.converged[world, row] = data.converged[world]
        fields.displacement[world, row], fields.contact_force[world, row] = reader.read(data, world)
        fields.wrench[world, row], fields.pressure[world, row] = data.wrench[world, 0], data.pressure[world]
        if dt is not None:
            data.dt.assign(dt)
        if touched:
            _evaluate_touch(touched, data, scene.geoms)
            for name in ("slip", "drive", "gain"):
                array = getattr(touched, name).numpy()
                getattr(fields, name)[world, row] = array[world] if name == "drive" else array[world, 0]
        if progress:
            progress(len(there))
    return fields


def _evaluate_touch(touched, data, geoms):
    """Evaluates `touched` for the step's result; the tangent costs a solve."""
    wrench, tangent = (np.ascontiguousarray(a.swapaxes(0, 1)) for a in (data.wrench, data.tangent(geoms)))
    with wp.ScopedDevice(data.model.device):
        touched.end(
            wp.array(wrench, dtype=wp.spatial_vectord, ndim=2),
            wp.array(tangent, dtype=wp.spatial_matrixd, ndim=2),
        )


def clock(row: np.ndarray, time: np.ndarray, first: float) -> tuple[np.ndarray, np.ndarray]:
    """Time steps (m,) [s] of the poses of a path, and their end times (m,) [s].

    Args:
      row: (m,) row that each pose completes, -1 for intermediate ones, see `_walk`. time: (n,) of the rows
        [s].
      first: duration before the first row [s].
    """
    count = np.diff(np.flatnonzero(row >= 0), prepend=-1)  # steps to each row
    dt = np.repeat(np.diff(time, prepend=time[0] - first) / count, count)
    return dt, time[0] + np.cumsum(dt) - dt[0]


def _simulate_condensed(model, names, motions, progress):
    """Interactions of the condensed skin one after another on one core, without rate effects."""
    from ...skin.condensed import CondensedSkin, Memory

    nstep = len(motions[0].pos)
    outer = nodes_of(model.geometry)
    fields = _empty(len(motions), nstep, model.nvert, len(outer), 0)
    skins = {}
    for k, (name, motion) in enumerate(zip(names, motions)):
        if name not in skins:
            placed = Placed(name, 1, model.device, model.material.friction)
            skins[name] = placed, CondensedSkin(model, placed.geoms)
        placed, skin = skins[name]
        memory = Memory.rest(1)
        for pos, mat, row in zip(*_walk(motion.pos, motion.mat)):
            at, turn = placed.pose(pos[None], mat[None])
            out = skin.solve(memory, at[0], turn[0])
            memory = out.memory
            if row >= 0:
                fields.converged[k, row], fields.wrench[k, row], fields.pressure[k, row] = (
                    out.converged,
                    out.wrench[0],
                    memory.pressure,
                )
                fields.displacement[k, row] = _units(out.vert_xpos - model.geometry.vert)
                fields.contact_force[k, row] = skin.contact_force(memory)[outer]
        if progress:
            progress(nstep)
    return fields


class Scene:
    """All objects of a batch in every world: its own one at its pose, the others out of reach.

    Args:
      names: object of each world. device: of Warp. friction: Coulomb coefficient.

    Attributes:
      geoms: GeomSet of the different objects, in order of first appearance.
    """

    def __init__(self, names: list | tuple, device: str = "cpu", friction: float = 0.0):
        kinds = list(dict.fromkeys(names))
        self._which = np.array([kinds.index(name) for name in names])
        self._shapes = [make_object(name) for name in kinds]
        geoms = {key: sum((shape.geom[key] for shape in self._shapes), []) for key in self._shapes[0].geom}
        friction = [friction] * len(kinds)
        self.geoms = GeomSet(**geoms, friction=friction, nworld=len(names), device=device)

    def place(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Moves each world's object to pos (nworld, 3) [m] with rotation mat (nworld, 3, 3)."""
        pos, mat = np.asarray(pos, float), np.asarray(mat, float)
        at = np.tile([0.0, -_AWAY, 0.0], (len(pos), len(self._shapes), 1))
        turn = np.tile(np.eye(3), (len(pos), len(self._shapes), 1, 1))
        for k, shape in enumerate(self._shapes):
            mine = np.flatnonzero(self._which == k)
            at[mine, k], turn[mine, k] = shape.pose(pos[mine], mat[mine])
        self.geoms.set_pose(at, turn)


@wp.kernel
def gather(
    # In:
    x: wp.array2d(dtype=vec3),
    force: wp.array2d(dtype=vec3),
    vert: wp.array(dtype=vec3),
    outer: wp.array(dtype=int),
    world: wp.array(dtype=int),
    scale: real,
    # Out:
    displacement_out: wp.array2d(dtype=wp.vec3s),
    force_out: wp.array2d(dtype=wp.vec3),
):
    """Displacements as the store's integers, and forces of the outer nodes, of some worlds."""
    k, i = wp.tid()
    w = world[k]
    u = (x[i, w] - vert[i]) / scale
    limit = real(32767.0)
    displacement_out[k, i] = wp.vec3s(
        wp.int16(wp.rint(wp.clamp(u[0], -limit, limit))),
        wp.int16(wp.rint(wp.clamp(u[1], -limit, limit))),
        wp.int16(wp.rint(wp.clamp(u[2], -limit, limit))),
    )
    if i < outer.shape[0]:
        f = force[outer[i], w]
        force_out[k, i] = wp.vec3(float(f[0]), float(f[1]), float(f[2]))


class _Reader:
    """Stored fields of some worlds, computed on the device: a tenth of the state's size."""

    def __init__(self, model, outer):
        self.model, self.count = model, len(outer)
        with wp.ScopedDevice(model.device):
            self.vert = wp.array(model.geometry.vert, dtype=vec3)
            self.outer = wp.array(outer.astype(np.int32), dtype=int)

    def read(self, data, worlds):
        """Stored fields of worlds (k,): displacement (k, nvert, 3) int16, contact_force (k, nouter, 3)."""
        m, device = self.model, self.model.device
        displacement = wp.zeros((len(worlds), m.nvert), dtype=wp.vec3s, device=device)
        force = wp.zeros((len(worlds), self.count), dtype=wp.vec3, device=device)
        chosen = wp.array(np.asarray(worlds, np.int32), dtype=int, device=device)
        wp.launch(
            gather,
            (len(worlds), m.nvert),
            [data.x, data.outer.node_force, self.vert, self.outer, chosen, DISPLACEMENT_SCALE],
            [displacement, force],
            device=device,
        )
        return displacement.numpy(), force.numpy()


def _empty(nworld, nstep, nvert, nouter, nmode):
    return Fields(
        np.zeros((nworld, nstep, nvert, 3), np.int16),
        np.zeros((nworld, nstep, nouter, 3), np.float32),
        np.zeros((nworld, nstep, 6)),
        np.zeros((nworld, nstep)),
        np.ones((nworld, nstep), bool),
        np.zeros((nworld, nstep)),
        np.zeros((nworld, nstep, nmode)),
        np.zeros((nworld, nstep, nmode + 1 if nmode else 0)),
    )


def _units(displacement):
    return np.clip(np.rint(displacement / DISPLACEMENT_SCALE), -32767, 32767).astype(np.int16)


def _walk(pos, mat):
    """Poses of one motion (n, 3), (n, 3, 3) with intermediate ones: positions (m, 3), rotations (m, 3, 3) and
    the time step (m,) that each pose completes, -1 for intermediate ones."""
    vector = Rotation.from_matrix(mat[1:] @ np.swapaxes(mat[:-1], 1, 2)).as_rotvec()
    distance = np.linalg.norm(np.diff(pos, axis=0), axis=1) + _ARM * np.linalg.norm(vector, axis=1)
    out = [(pos[0], mat[0], 0)]
    for i, count in enumerate(np.maximum(1, np.ceil(distance / _LARGEST_STEP - 1e-6)).astype(int)):
        weight = np.arange(1, count) / count
        turned = Rotation.from_rotvec(weight[:, None] * vector[i]).as_matrix() @ mat[i] if count > 1 else []
        out += [(pos[i] + s * (pos[i + 1] - pos[i]), R, -1) for s, R in zip(weight, turned)]
        out.append((pos[i + 1], mat[i + 1], i + 1))
    return tuple(np.array(part) for part in zip(*out))
