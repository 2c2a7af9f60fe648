"""Contacts between the solid parts of a BioTac and meshes that are not convex, in Warp, by the signed
distances that the skin uses instead of convex hulls.

Points are spread over the surfaces of both. A point inside the other solid is a contact. Points are grouped
by the nearest of a few seeds on the part, and the deepest of each group counts."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from ...geometry.solid import farthest_points, spread_points
from ...kernels import kernel_module
from ..geoms import GeomSet
from ..types import real, vec3
from .meshes import TRILINEAR, DistanceGrid, grid_value, mesh_distance
from .posed import Geoms, place_on

kernel_module(__name__)

MOST = 6  # contacts of a part with a shape, and seeds of a part
_SPACING, _POINTS = (
    7e-4,
    4000,
)  # spacing of points on a solid [m], and most points: fewer per area on large ones
_ANYWHERE = 1e9  # [m] initial value of a least distance
_SHIFT = wp.constant(wp.int64(1 << 31))
_NANO = wp.constant(real(1e9))


@wp.struct
class Points:
    """Points on solids, each in its solid's frame; parts come first among the solids."""

    pos: wp.array(dtype=vec3)
    owner: wp.array(dtype=int)
    nparts: int
    seed: wp.array2d(dtype=vec3)  # [part, seed], in the BioTac frame


@wp.func
def _inside(solids: Geoms, points: Points, n: int, other: int, w: int):
    """Normal and distance of point n from another solid, and the point, in the BioTac frame."""
    o = points.owner[n]
    x = solids.pos[o, w] + solids.mat[o, w] * points.pos[n]
    y = place_on(solids, other, w, x)
    k = solids.grid[other]
    dn = wp.vec4d(real(1.0), real(0.0), real(0.0), grid_value(solids.grids, k, y))
    if dn[3] < TRILINEAR * solids.grids.spacing[k]:
        dn = mesh_distance(solids.grids, k, y)
    normal = solids.mat[other, w] * vec3(dn[0], dn[1], dn[2])
    return normal, dn[3], x


@wp.kernel
def find_deepest(
    # In:
    solids: Geoms,
    points: Points,
    wanted: wp.array2d(dtype=int),
    # In and out:
    deepest: wp.array3d(dtype=wp.int64),
    least: wp.array2d(dtype=real),
):
    """Depth in nanometres and index of the deepest point at each seed [pair, seed, world], and a lower bound
    of the points' distances [pair, world]. Pairs are numbered part by part."""
    n, w = wp.tid()
    o = points.owner[n]
    nshapes = solids.count - points.nparts
    first = int(points.nparts)
    last = int(solids.count)
    if o >= points.nparts:
        first = 0
        last = points.nparts
    for other in range(first, last):
        part = wp.min(o, other)
        pair = part * nshapes + wp.max(o, other) - points.nparts
        if wanted[pair, w] == 1:
            _normal, d, x = _inside(solids, points, n, other, w)
            bound = d - TRILINEAR * solids.grids.spacing[solids.grid[other]]
            if bound < least[pair, w]:
                wp.atomic_min(least, pair, w, bound)
            if d < real(0.0):
                near = int(0)
                for s in range(points.seed.shape[1]):
                    if wp.length_sq(x - points.seed[part, s]) < wp.length_sq(x - points.seed[part, near]):
                        near = s
                wp.atomic_max(deepest, pair, near, w, wp.int64(-d * _NANO) * _SHIFT + wp.int64(n))


@wp.kernel
def describe_deepest(
    # In:
    solids: Geoms,
    points: Points,
    deepest: wp.array3d(dtype=wp.int64),
    # Out:
    pos_out: wp.array3d(dtype=vec3),
    normal_out: wp.array3d(dtype=vec3),
    depth_out: wp.array3d(dtype=real),
):
    """Midpoint, normal from part to shape, and depth [m] of the contact of a pair at a seed, in the BioTac
    frame; depth 0: no contact."""
    pair, s, w = wp.tid()
    depth_out[pair, s, w] = real(0.0)
    found = deepest[pair, s, w]
    if found > wp.int64(0):
        n = int(found % _SHIFT)
        nshapes = solids.count - points.nparts
        other = pair // nshapes
        sign = real(1.0)
        if points.owner[n] < points.nparts:
            other = points.nparts + pair % nshapes
            sign = real(-1.0)
        normal, d, x = _inside(solids, points, n, other, w)
        pos_out[pair, s, w] = x - real(0.5) * d * normal
        normal_out[pair, s, w] = sign * normal
        depth_out[pair, s, w] = -d


class Overlaps:
    """Overlaps of solid parts, fixed in the BioTac frame, with shapes that are not convex.

    Args:
      parts, shapes: their grids. solids: GeomSet of all these meshes, parts first.

    Attributes:
      pos, mat: [solid, world] poses in the BioTac frame, written by the caller.
      wanted: [pair, world] int, pairs that are evaluated, written by the caller; numbered part by part.
      least: [pair, world] lower bounds of the distances of their points [m].
      contact_pos, contact_normal, depth: [pair, seed, world] see `describe_deepest`.
    """

    def __init__(self, parts: Sequence[DistanceGrid], shapes: Sequence[DistanceGrid], solids: GeomSet):
        self.nparts, self.nshapes, self._solids = len(parts), len(shapes), solids
        self.npair, nworld, device = self.nparts * self.nshapes, solids.nworld, solids.device
        sets = [spread_points(grid.vert, grid.face, _SPACING, _POINTS) for grid in [*parts, *shapes]]
        self._points = points = Points()
        shape = self.npair, MOST, nworld
        with wp.ScopedDevice(device):
            points.pos = wp.array(np.concatenate(sets), dtype=vec3)
            owner = np.repeat(np.arange(len(sets)), [len(s) for s in sets])
            points.owner = wp.array(owner.astype(np.int32), dtype=int)
            seeds = [s[farthest_points(s, MOST, _outermost(s))] for s in sets[: len(parts)]]
            points.seed = wp.array(np.array(seeds), dtype=vec3, ndim=2)
            self.wanted = wp.zeros(shape[::2], dtype=int)
            self.least = wp.zeros(shape[::2], dtype=real)
            self._deepest = wp.zeros(shape, dtype=wp.int64)
            self.contact_pos, self.contact_normal = (wp.zeros(shape, dtype=vec3) for _ in range(2))
            self.depth = wp.zeros(shape, dtype=real)
        points.nparts = self.nparts
        self.pos, self.mat = solids.struct.pos, solids.struct.mat

    def find(self) -> None:
        """Finds the contacts of the wanted pairs. Launches only."""
        solids, points = self._solids.struct, self._points
        self._deepest.zero_()
        self.least.fill_(_ANYWHERE)
        known, device = [solids, points], self._solids.device
        dim = len(points.pos), self._solids.nworld
        wp.launch(find_deepest, dim, [*known, self.wanted], [self._deepest, self.least], device=device)
        found = [self.contact_pos, self.contact_normal, self.depth]
        wp.launch(describe_deepest, self.depth.shape, [*known, self._deepest], found, device=device)


def _outermost(points):
    """Number of the point (n, 3) that is farthest from their mean."""
    return int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
