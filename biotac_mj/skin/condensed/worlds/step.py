"""The condensed skins of many worlds: what is made once, and a step."""

import numpy as np
import warp as wp

from ...contact import limits
from ...contact.meshes import grid_value
from ...data import SkinData
from ...geoms import GeomSet
from ...model import SkinModel
from ...program import Launcher
from ...types import mat33, real, vec3
from ..refusals import refuse
from ..skin import CondensedSkin
from .balance import Contact
from .lanes import MOST_EQUATIONS
from .results import conclude
from .structs import NVECTOR, Constants, Remembered, Scratch
from .way import BLOCK, solver

__all__ = ["CondensedStep"]

wp.set_module_options({"enable_backward": False})

# candidates that there is room for: faces and nodes of both surfaces; nodes that touch
_FACES, _CORE_FACES, _NODES, _CORE_NODES, _TOUCHED = 768, 384, 448, 240, MOST_EQUATIONS // 3
# nodes that touch, in more worlds than this: their systems take 0.8 MB a world, and not 2.1
_MANY, _TOUCHED_OF_MANY = 256, 144
_MOST = 240  # evaluations of contact in a step


@wp.kernel
def _rest_gaps(
    # In:
    face: wp.array(dtype=wp.vec3i),
    c: Constants,
    # Out:
    gap_out: wp.array2d(dtype=real),
):
    """The grid rounds edges of the core by micrometres: what starts outside stays outside."""
    f, i = wp.tid()
    t = face[f]
    b = c.sample[i]
    p = b[0] * c.rest[t[0], 0] + b[1] * c.rest[t[1], 0] + b[2] * c.rest[t[2], 0]
    gap_out[f, i] = wp.min(grid_value(c.core.grids, c.core.grid[0], p), real(0.0))


@wp.kernel
def _reset(mask: wp.array(dtype=bool), r: Remembered, tier_out: wp.array(dtype=int)):
    """Forgets the worlds of mask, and that they were pressed beyond what was measured."""
    i, w = wp.tid()
    if not mask[w]:
        return
    if i < r.force.shape[0]:
        r.force[i, w] = vec3()
        r.change[i, w] = vec3()
    if i < r.core_force.shape[0]:
        r.core_force[i, w] = real(0.0)
        r.core_change[i, w] = real(0.0)
    if i == 0:
        r.bulge[w] = real(0.0)
        r.growth[w] = real(0.0)
        r.solved[w] = wp.vec2d(real(1.0), real(1.0))
        r.after[w] = wp.vec2d(real(1.0), real(1.0))
        r.drift[w] = wp.vec2d()
        tier_out[w] = 1


class CondensedStep:
    """A step of all wanted worlds by the condensed tier, as `skin.step` has one of the full tier: poses in
    `geoms.struct`, positions, wrenches and pressures out.

    Args:
      model: SkinModel on any device. twin: the same on the CPU, of which the compliance is made.
      data: of the skins. geoms: what touches them.

    Attributes:
      tier: (nworld,) int, what the sensor `status` says: 1, or -1 beyond what the error was measured for.

    Raises:
      ValueError: what the tier cannot do, see `refusals`.
    """

    def __init__(self, model: SkinModel, twin: SkinModel, data: SkinData, geoms: GeomSet):
        refuse(model.material.extensions, model.options, model.has_liquid, False)
        self._model, self._data, self._geoms = model, data, geoms
        skin = CondensedSkin(twin, GeomSet([], [], nworld=1))
        with wp.ScopedDevice(model.device):
            self._constants = _constants(model, skin)
            self.remembered = _remembered(skin, data.nworld)
            self._scratch = _scratch(model, skin, data.nworld, geoms.count)
            self.tier = wp.ones(data.nworld, dtype=int)
            self._no_tangents = wp.zeros((0, data.nworld), dtype=wp.spatial_matrixd)
        self._kernel = solver(geoms.shapes)
        vert = model.rest.vert
        center = (vert.min(0) + vert.max(0)) / 2
        self._center, self._radius = vec3(*center), float(np.linalg.norm(vert - center, axis=1).max())
        self._touch = touch = Contact()
        outer = data.outer
        touch.stiffness, touch.laws, touch.x_last = (
            data.worlds.contact_stiffness,
            data.laws.struct,
            data.x_last,
        )
        touch.anchor_geom, touch.anchor, touch.corner = outer.anchor_geom, outer.anchor, outer.corner
        touch.block, touch.touching, touch.geom = outer.block, outer.touching, outer.trial_geom
        touch.trial, touch.force, touch.kept = outer.trial_anchor, outer.sample_force, outer.kept
        self.reset(wp.ones(data.nworld, dtype=bool, device=model.device))

    def launch(self, tangent: wp.array | None = None) -> None:
        """Launches only: may be captured in a CUDA graph.

        Args:
          tangent: (ngroup, nworld) spatial_matrixd for -d wrench / d motion, or None.
        """
        m, d, geoms = self._model, self._data, self._geoms
        motion, touched_by, wrench = d.geom_memory(geoms.count, geoms.ngroup)
        tangent = self._no_tangents if tangent is None else tangent
        launcher, n, c, s = Launcher(m.device), d.nworld, self._constants, self._scratch
        from_outside = [self._center, self._radius, geoms.struct]
        launcher.launch(limits.come_from_outside, (geoms.count, n), from_outside, [s.from_pos])
        launcher.launch_blocks(
            self._kernel,
            n,
            [m.law, min(_MOST, m.options.max_work), geoms.struct, d.rest_pressure, c],
            [d.x, motion, touched_by, self._touch, s, self.remembered, d.worlds]
            + [d.outer.node_force, self.tier],
            block_dim=BLOCK,
        )
        launcher.launch_blocks(
            conclude,
            n,
            [geoms.struct, c, d.worlds.wanted, d.x, self._touch, s],
            [touched_by, wrench, tangent],
            block_dim=BLOCK,
        )

    def reset(self, mask: wp.array) -> None:
        """Forgets the worlds of mask (nworld,) of bool. Launches only."""
        r = self.remembered
        dim = max(r.force.shape[0], r.core_force.shape[0], 1), self._data.nworld
        wp.launch(_reset, dim, [mask, r, self.tier], device=self._model.device)

    @property
    def memory(self) -> list[wp.array]:
        """Arrays [item, world] that a step starts from."""
        r = self.remembered
        return [r.force, r.core_force, r.bulge, r.solved, r.after]

    @property
    def changes(self) -> list[wp.array]:
        """Those that say how it is expected to go on."""
        r = self.remembered
        return [r.change, r.core_change, r.growth, r.drift]


def _constants(model, skin):
    c, g = Constants(), model.geometry
    nouter = len(skin._outer)
    c.node, c.number = _ints(skin._outer), _ints(skin._number)
    c.opposite, c.free = _ints(skin._opposite), _ints(model.free)
    c.rest = wp.array(model.rest.vert[:, None].astype(float), dtype=vec3, ndim=2)
    o = model.outer
    c.face, c.area, c.sample, c.start, c.slot = o.face, o.area, model.sample, o.start, o.slot
    c.ring_start, c.ring, c.term_start, c.term = (
        _ints(a) for a in _rings(g.outer_face, skin._number, nouter)
    )
    rows = skin.compliance.row(list(range(skin.compliance.count)))
    c.compliance = wp.array(_between(skin, rows), dtype=float, ndim=2)
    rows = np.array(rows)
    largest = np.abs(rows).max(1)
    c.row = wp.array((rows / largest[:, None]).astype(np.float16), dtype=wp.float16, ndim=2)
    c.largest = wp.array(largest, dtype=float)
    n = skin.compliance.count
    c.give = wp.array(skin._give.reshape(-1, 3), dtype=vec3)
    c.give_at = wp.array(skin._give_at if model.has_liquid else np.zeros(n), dtype=real)
    c.liquid_give = skin._liquid_give if model.has_liquid else 0.0
    c.gradient = wp.array(skin._gradient[model.free], dtype=vec3)
    none, nobody = wp.zeros(0, dtype=wp.vec3i), wp.zeros(0, dtype=int)
    c.wet = none if model.inner is None else model.inner.face
    c.cavity = 0.0 if model.inner is None else skin._cavity
    c.core_vert, c.core_depth = wp.zeros(0, dtype=vec3), model.options.max_core_depth
    c.inner, c.inner_number = _ints(skin._inner), _ints(np.full(model.nvert, -1))
    c.away = wp.array(skin._away, dtype=vec3)
    c.inner_face, c.inner_area = none, wp.zeros(0, dtype=real)
    c.inner_start, c.inner_slot, c.inner_rest = nobody, nobody, wp.zeros((0, 0), dtype=real)
    c.inner_ring_start, c.inner_ring, c.inner_term_start, c.inner_term = nobody, nobody, nobody, nobody
    if model.has_core:
        surface = model.core_surface
        number = np.full(model.nvert, -1)
        number[skin._inner] = np.arange(len(skin._inner))
        c.inner_number = _ints(number)
        c.core, c.core_vert = model.core(1).struct, model.core_vert
        c.inner_face, c.inner_area = surface.face, surface.area
        c.inner_start, c.inner_slot = surface.start, surface.slot
        rings = _rings(surface.face_np, number, len(skin._inner))
        c.inner_ring_start, c.inner_ring, c.inner_term_start, c.inner_term = (_ints(a) for a in rings)
        c.inner_rest = wp.zeros((len(surface.face), len(model.sample)), dtype=real)
        wp.launch(_rest_gaps, c.inner_rest.shape, [surface.face, c], [c.inner_rest])
    k = skin.correction
    c.stick_ratio = model.options.stick_ratio
    c.depth, c.most, c.width, c.stretch, c.squeeze = k.depth, k.most, k.width, k.stretch, k.squeeze
    low, high = k.poissons_ratio
    c.squeezed = k.squeezed if low <= model.material.poissons_ratio <= high else -1.0
    c.narrow = k.narrow
    return c


def _ints(values):
    return wp.array(np.asarray(values, np.int32), dtype=int)


def _between(skin, rows):
    """(n, n) float32 compliance of contact coordinates among each other; rows are rounded one by one, so it
    is the mean of both ways."""
    first, position = 3 * len(skin._outer), skin.compliance.position
    outer = (3 * position(skin._outer)[:, None] + np.arange(3)).ravel()
    inner = 3 * position(skin._inner)[:, None] + np.arange(3)
    out = np.empty((len(rows), len(rows)), np.float32)
    for row, entries in zip(rows, out):
        entries[:first] = row[outer]
        entries[first:] = (row[inner] * skin._away).sum(1)
    return (out + out.T) / 2


def _rings(face, number, nouter):
    """Neighbours of outer nodes in CSR lists, and what each pair takes from faces, in CSR lists."""
    f, a, b = (x.ravel() for x in np.meshgrid(np.arange(len(face)), range(3), range(3), indexing="ij"))
    one, other = number[face[f, a]], number[face[f, b]]
    here = (one >= 0) & (other >= 0)
    pair, term = (one * nouter + other)[here], (9 * f + 3 * a + b)[here]
    order = np.argsort(pair, kind="stable")
    pairs, begin = np.unique(pair[order], return_index=True)
    ring_start = np.searchsorted(pairs // nouter, np.arange(nouter + 1))
    return ring_start, pairs % nouter, np.append(begin, len(term)), term[order]


def _remembered(skin, nworld):
    r, n, k = Remembered(), len(skin._outer), len(skin._inner)
    r.force, r.change = (wp.zeros((n, nworld), dtype=vec3) for _ in range(2))
    r.core_force, r.core_change = (wp.zeros((k, nworld), dtype=real) for _ in range(2))
    r.bulge, r.growth = (wp.zeros(nworld, dtype=real) for _ in range(2))
    r.solved, r.after, r.drift = (wp.zeros(nworld, dtype=wp.vec2d) for _ in range(3))
    return r


def _scratch(model, skin, nworld, ngeom):
    s = Scratch()
    nface, nouter, ninner = len(model.outer.face_np), len(skin._outer), len(skin._inner)
    ncore = len(model.core_surface.face_np) if model.has_core else 0
    faces, nodes = min(_FACES, nface), min(_NODES, nouter)
    touched = min(_TOUCHED if nworld <= _MANY else _TOUCHED_OF_MANY, nouter + ninner)
    core_faces, core_nodes = min(_CORE_FACES, ncore), min(_CORE_NODES, ninner)
    n = 3 * nodes + core_nodes
    for name, count in (
        ("near", nface),
        ("near_core", ncore),
        ("face", faces),
        ("core_face", core_faces),
        ("place", nouter),
        ("core_place", ninner),
        ("node", nodes),
        ("core_node", core_nodes),
        ("coordinate", n),
        ("loaded", n),
        ("on", nodes + core_nodes),
        ("touched", touched),
    ):
        setattr(s, name, wp.zeros((nworld, count), dtype=int))
    s.force = wp.zeros((nworld, nouter), dtype=vec3)
    s.core_force = wp.zeros((nworld, ninner), dtype=real)
    s.vector = wp.zeros((nworld, NVECTOR, n), dtype=real)
    s.load = wp.zeros((nworld, n), dtype=float)
    s.swollen = wp.zeros((nworld, 3 * touched), dtype=float)
    s.stiff = wp.zeros((nworld, core_nodes), dtype=real)
    s.gap, s.now = (wp.zeros((nworld, core_faces, len(model.sample)), dtype=real) for _ in range(2))
    ring = model.ring.shape[1]
    s.block = wp.zeros((nworld, touched, ring), dtype=wp.mat33)
    s.core_block = wp.zeros((nworld, touched, ring), dtype=float)
    s.matrix = wp.zeros((nworld, 3 * touched * (3 * touched + 6)), dtype=float)
    s.count = wp.zeros((nworld, 3), dtype=int)
    s.linear = wp.zeros((nworld, 3), dtype=real)
    s.pos, s.from_pos = (wp.zeros((ngeom, nworld), dtype=vec3) for _ in range(2))
    s.mat, s.from_mat = (wp.zeros((ngeom, nworld), dtype=mat33) for _ in range(2))
    return s
