"""The linear skin of the condensed tier: constants of a model, shared by all its skins."""

import typing
import weakref

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from ...cache import cached
from ...geometry.tet_mesh import enclosed_volume
from ...kernels import kernel_module, set_fields
from ..contact.meshes import smooth_distance, spline_field
from ..contact.posed import Geoms
from ..liquid import volume_gradient
from ..types import real, vec3
from .compliance import SurfaceCompliance
from .correction import correction
from .structs import Constants

if typing.TYPE_CHECKING:
    from ..model import SkinModel

kernel_module(__name__)

# half a step of the differences that give the directions away from the core, half a cell of its grid [m]
_PROBE = 2e-4
# motions of the skin by which is measured how well a distance at rest and its slope foretell one: how many,
# how far, in the largest gap, at least so far [m]; half a step of the slope [m]
_MOTIONS, _FARTHEST, _LEAST, _STEP = 80, 1.5, 2e-3, 5e-5


@wp.kernel
def _core_gaps(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core: Geoms,
    vert: wp.array(dtype=vec3),
    shift: vec3,
    everywhere: int,
    # Out:
    gap_out: wp.array2d(dtype=real),
):
    """Distance of the samples of an inner face from the core, with the skin shifted [m]; everywhere: 1: by
    the core's spline at any distance."""
    f, i = wp.tid()
    t = face[f]
    b = sample[i]
    p = b[0] * vert[t[0]] + b[1] * vert[t[1]] + b[2] * vert[t[2]] + shift
    k = core.grid[0]
    if everywhere == 1:
        gap_out[f, i] = spline_field(core.grids, k, p)[3]
    else:
        gap_out[f, i] = smooth_distance(core.grids, k, p)[3]


def _meet_core(model, free, rest):
    """Inner nodes that can touch the core and their directions away from it; gaps of the inner faces' samples
    without contact, by the core's mesh and by its spline [m]; the slope of these by a motion of the skin, and
    a bound of their curvature (nface,)."""
    surface = model.core_surface
    face = surface.face_np
    inner = np.unique(face)
    inner = inner[free[inner]]
    gap = wp.zeros((len(face), len(model.sample)), dtype=real, device="cpu")
    vert = wp.array(rest, dtype=vec3, device="cpu")

    def gaps(shift, everywhere=0):
        inputs = [surface.face, model.sample, model.core(1).struct, vert, vec3(*shift), everywhere]
        wp.launch(_core_gaps, gap.shape, inputs, [gap], device="cpu")
        return gap.numpy().copy()

    probe = _PROBE * np.eye(3)
    gradient = np.stack([(gaps(p) - gaps(-p)).mean(1) for p in probe], axis=1)
    nodal = np.zeros((model.nvert, 3))
    np.add.at(nodal, face, np.repeat(gradient[:, None], 3, 1))
    away = nodal[inner] / np.linalg.norm(nodal[inner], axis=1, keepdims=True)
    core_gap, spline_gap = gaps(np.zeros(3)), gaps(np.zeros(3), 1)
    between = [(gaps(_STEP * axis, 1) - gaps(-_STEP * axis, 1)) / (2 * _STEP) for axis in np.eye(3)]
    slope = np.stack(between, axis=2)
    draw, off, near = np.random.default_rng(0), 0.0, np.zeros(gap.shape, bool)
    farthest = max(_FARTHEST * spline_gap.max(), _LEAST)
    for _ in range(_MOTIONS):
        motion = draw.standard_normal(3)
        length = draw.uniform(0.05, 1.0) * farthest
        motion *= length / np.linalg.norm(motion)
        found = gaps(motion, 1)
        here = found < _STEP
        if here.any():
            off = max(off, ((spline_gap + slope @ motion - found)[here]).max() / length)
            near |= here
    # for samples that were never near, the motion itself is the only bound
    bend = np.where(near.any(1), min(1.5 * off + 0.05, 2.0), 2.0)
    return dict(inner=inner, away=away, gap=core_gap, spline_gap=spline_gap, slope=slope, bend=bend)


class LinearSkin:
    """Contact nodes of a model, and the displacements by forces on them.

    Args:
      model: SkinModel on the CPU, quasi-static.
      cache: whether to cache the compliance on disk (see `compliance`).

    Attributes:
      node: (nouter,) free outer nodes. number: (nvert,) their indices; -1: fixed, or not an outer node.
      opposite: (nouter,) the node across the wall from each.
      inner: (ninner,) free inner nodes that can touch the core. away: (ninner, 3) directions away from it.
      core_gap: (nface, nsample) gaps of the inner faces' samples without contact [m].
      compliance: SurfaceCompliance of these.
      give: (nfree, 3) [m/Pa], times E, displacement of the free nodes by the liquid's pressure; give_at:
        (count,) along contact coordinates. liquid_give: of the cavity's volume [m^3/Pa], times E.
      gradient: (nfree, 3) of the cavity's volume [m^2]. cavity: its volume without contact [m^3].
      correction: Correction of the material's law.
    """

    def __init__(self, model: "SkinModel", cache: bool = True):
        self._nvert, self._constants, g = model.nvert, {}, model.geometry
        rest, free = model.rest.vert.astype(float), np.zeros(model.nvert, bool)
        free[model.free] = True
        self.correction = correction(model.material.law)
        self.node = np.unique(g.outer_face)
        self.node = self.node[free[self.node]]
        self.number = self._numbers(self.node)
        wall = np.unique(g.inner_face) if len(g.inner_face) else np.setdiff1d(model.fixed, g.outer_face)
        self.opposite = wall[cKDTree(rest[wall]).query(rest[self.node])[1]]
        self.inner, self.away, self.core_gap = np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 1))
        self._spline_gap, self._slope, self._bend = self.core_gap, np.zeros((0, 1, 3)), np.zeros(0)
        if model.has_core:
            inputs = [g, rest, free, model.core_surface.face_np, model.sample.numpy()]
            core = cached("core", inputs, lambda: _meet_core(model, free, rest))
            self.inner, self.away, self.core_gap = core["inner"], core["away"], core["gap"]
            self._spline_gap, self._slope, self._bend = core["spline_gap"], core["slope"], core["bend"]
        self.compliance = SurfaceCompliance(model, self.node, self.inner, self.away, cache)
        self._fill(model, rest)

    @classmethod
    def of(cls, model: "SkinModel", cache: bool = True) -> "LinearSkin":
        """The LinearSkin of a model, cached while it is used."""
        mine = _made.setdefault(model, weakref.WeakValueDictionary())
        found = mine.get(cache)
        if found is None:
            found = mine[cache] = cls(model, cache)
        return found

    def _numbers(self, nodes):
        out = np.full(self._nvert, -1)
        out[nodes] = np.arange(len(nodes))
        return out

    def _fill(self, model, rest):
        nfree, n = len(model.free), self.compliance.count
        self.gradient, self.give, self.give_at = np.zeros((nfree, 3)), np.zeros((nfree, 3)), np.zeros(n)
        self.liquid_give = self.cavity = 0.0
        if model.inner is None:
            return
        face = model.geometry.inner_face
        self.cavity = -enclosed_volume(rest, face)
        if not model.has_liquid:
            return
        gradient = volume_gradient(rest, face)
        gradient[model.fixed] = 0
        self.gradient = gradient[model.free]
        self.give = self.compliance.vector(gradient).reshape(-1, 3)
        self.liquid_give = float(np.vdot(self.gradient, self.give))
        position = self.compliance.position
        along = np.einsum("ij,ij->i", self.give[position[self.inner]], self.away)
        self.give_at = np.concatenate([self.give[position[self.node]].ravel(), along])

    def constants(self, model: "SkinModel") -> Constants:
        """Constants for kernels, made once for each device.

        Args:
          model: the same SkinModel, on that device.
        """
        device = model.device.alias
        if device not in self._constants:
            with wp.ScopedDevice(model.device):
                self._constants[device] = self._make_constants(model)
        return self._constants[device]

    def _make_constants(self, model):
        c, g, made, o = Constants(), model.geometry, self.compliance, model.outer
        vert, number, mean = model.rest.vert, self._numbers(self.inner), self._slope.mean(1)
        set_fields(c, node=self.node, number=self.number, opposite=self.opposite, free=model.free)
        set_fields(c, rest=vert[:, None].astype(float), face=o.face, sample=model.sample)
        set_fields(c, start=o.start, slot=o.slot, give=self.give, give_at=self.give_at)
        set_fields(c, gradient=self.gradient, liquid_give=self.liquid_give, cavity=self.cavity)
        set_fields(c, **_rings("", g.outer_face, self.number, len(self.node)))
        # on the CPU the mapped file itself
        c.compliance = wp.array(made.between, dtype=float, ndim=2, copy=False)
        c.row = wp.array(made.rows, dtype=wp.float16, ndim=2, copy=False)
        c.largest = wp.array(made.largest, dtype=float, copy=False)
        none = np.zeros((0, 3), np.int32)
        c.wet = wp.array(none, dtype=wp.vec3i) if model.inner is None else model.inner.face
        center = (vert.min(0) + vert.max(0)) / 2
        c.center, c.radius = vec3(*center), float(np.linalg.norm(vert - center, axis=1).max())
        c.core_depth = model.options.max_core_depth
        set_fields(c, inner=self.inner, inner_number=number, away=self.away)
        surface = model.core_surface if model.has_core else None
        if surface:
            c.core, c.core_vert, c.inner_area = model.core(1).struct, model.core_vert, surface.area
            c.inner_face, c.inner_start, c.inner_slot = surface.face, surface.start, surface.slot
        else:
            set_fields(c, core_vert=none, inner_area=[], inner_face=none, inner_start=[], inner_slot=[])
        set_fields(c, **_rings("inner_", surface.face_np if surface else none, number, len(self.inner)))
        # the spline rounds edges of the core by micrometres: samples that are outside must not start inside
        set_fields(c, inner_rest=np.minimum(self.core_gap, 0.0), inner_gap=self._spline_gap)
        set_fields(c, inner_slope=self._slope, inner_mean_slope=mean, inner_bend=self._bend)
        set_fields(c, inner_spread=np.linalg.norm(self._slope - mean[:, None], axis=2).max(1))
        set_fields(c, inner_far=self._spline_gap.min(1))
        k = self.correction
        c.depth, c.most, c.width, c.stretch, c.squeeze = k.depth, k.most, k.width, k.stretch, k.squeeze
        low, high = k.poissons_ratio
        c.squeezed = k.squeezed if low <= model.material.poissons_ratio <= high else -1.0
        c.narrow = k.narrow
        return c


# by model; a LinearSkin must not refer to its model, which would keep both
_made = weakref.WeakKeyDictionary()


def _rings(of, face, number, count):
    """CSR lists of the neighbours of `count` numbered nodes, and of the blocks of faces for each pair, by the
    names of `Constants` that begin with `of`."""
    f, a, b = (x.ravel() for x in np.meshgrid(np.arange(len(face)), range(3), range(3), indexing="ij"))
    one, other = number[face[f, a]], number[face[f, b]]
    here = (one >= 0) & (other >= 0)
    pair, term = (one * count + other)[here], (9 * f + 3 * a + b)[here]
    order = np.argsort(pair, kind="stable")
    pairs, begin = np.unique(pair[order], return_index=True)
    ring_start = np.searchsorted(pairs // count, np.arange(count + 1))
    return {
        f"{of}ring_start": ring_start,
        f"{of}ring": pairs % count,
        f"{of}term_start": np.append(begin, len(term)),
        f"{of}term": term[order],
    }
