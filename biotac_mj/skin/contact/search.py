"""Which faces of a skin a geom may touch, and whether one is inside the core.

Only a region around the geoms is searched, wider than what they and the skin can have moved since it was
chosen. A few regions are kept: BioTacs of one model share a skin. Which one is used changes nothing but the
time."""

import dataclasses
import typing
from collections.abc import Iterator

import numpy as np
import warp as wp

from ...geometry.rigid import displace, displacement
from ...launches import recorded
from ..geoms import GeomSet
from ..types import real, vec3
from .meshes import TRILINEAR, grid_value
from .posed import Geoms, bound_to, place_on, rough_bound_to
from .touch import SOLIDS

if typing.TYPE_CHECKING:
    from ..model import SkinModel

__all__ = ["NearSearch", "poses"]

wp.set_module_options({"enable_backward": False})

_REGION = 2e-3  # geoms may move this far before the region around them is chosen again [m]
_KEPT = 16
_NARROW = 1e-4  # [m] within which the place is found where a geom begins to touch
_CORE = 1e-6  # and where it comes out of the core
_EVEN = 1e-9  # of a way: finer it is not divided
_FAR = 1.0  # [m] geoms are moved out of the skin by no more
_NONE = np.zeros(0, int)


@wp.kernel
def _near(
    # In:
    count: wp.array(dtype=int),
    number: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    ball: wp.array(dtype=real),
    reach: wp.array(dtype=real),
    # Out:
    near_out: wp.array(dtype=int),
    met_out: wp.array(dtype=int),
    gap_out: wp.array(dtype=real),
):
    """Which of the first count[0] numbered faces have a sample that is nearer to a geom than the reach;
    count[1] of them. All samples are in the ball (centre, radius) [m]: most geoms are far from it. Where all
    faces are asked for, no sample of a face is nearer to any geom than its gap."""
    whole = wp.where(count[0] == face.shape[0], 1, 0)
    met = int(0)
    for g in range(geoms.count):
        p = vec3(ball[0], ball[1], ball[2])
        far = rough_bound_to(geoms, g, p, place_on(geoms, g, 0, p))
        # a bound may change a little faster than its place: grids are trilinear
        if far < real(2.0) * ball[3] + reach[0]:
            met_out[met] = g
            met += 1
    found = int(0)
    for i in range(count[0]):
        f = number[i]
        t = face[f]
        x0 = x[t[0], 0]
        x1 = x[t[1], 0]
        x2 = x[t[2], 0]
        center = (x0 + x1 + x2) / real(3.0)
        radius = wp.sqrt(
            wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center)))
        )
        gap = reach[0]
        for m in range(met):
            g = met_out[m]
            if gap == reach[0] or whole == 1:
                bound = bound_to(geoms, g, center, place_on(geoms, g, 0, center))
                if bound < radius + gap:
                    for s in range(sample.shape[0]):
                        if gap == reach[0] or whole == 1:
                            b = sample[s]
                            p = b[0] * x0 + b[1] * x1 + b[2] * x2
                            gap = wp.min(gap, bound_to(geoms, g, p, place_on(geoms, g, 0, p)))
        if gap < reach[0]:
            near_out[found] = f
            gap_out[found] = gap
            found += 1
    count[1] = found


@wp.kernel
def _core_clearance(
    # In:
    core_vert: wp.array(dtype=vec3),
    core: Geoms,
    geoms: Geoms,
    # Out:
    clearance_out: wp.array(dtype=real),
):
    """Distance of each geom to the nearest vertex of the core, negative where it is inside the geom, or the
    geom inside the core."""
    g = wp.tid()
    least = real(1.0)
    for i in range(core_vert.shape[0]):
        least = wp.min(least, bound_to(geoms, g, core_vert[i], place_on(geoms, g, 0, core_vert[i])))
    p = geoms.pos[g, 0]
    if bound_to(geoms, g, p, vec3()) < real(0.0):  # no ring around it
        # outside too: it jumps nowhere
        least = wp.min(least, grid_value(core.grids, core.grid[0], p))
    clearance_out[g] = least


def poses(geoms: GeomSet) -> tuple[np.ndarray, ...]:
    """Views of the positions (ngeom, 3) [m] and rotations (ngeom, 3, 3) of geoms of one world on the CPU, now
    and at the last step: made once, as Warp takes longer for them than for writing there."""
    struct = geoms.struct
    return tuple(a.numpy()[:, 0] for a in (struct.pos, struct.mat, struct.pos_last, struct.mat_last))


@dataclasses.dataclass(frozen=True)
class _Region:
    """Faces (n,) of the resting skin nearer than `width` to the geoms, and their gaps (n,), which grow; a
    ball around them, centre and radius (4,), and the geoms' clearance from the core [m]. A width below zero:
    only the latter is known."""

    faces: np.ndarray
    gaps: np.ndarray
    width: float
    ball: np.ndarray
    clearance: float

    @property
    def least(self) -> float:
        """No geom is nearer to the skin."""
        return self.gaps[0] if len(self.gaps) else self.width


class _Regions:
    """What was found at some poses of `ngeom` geoms, the last few of them."""

    def __init__(self, ngeom: int):
        self._found, self._next, self._asked, self._ways = [], 0, None, []
        self._pos, self._mat = np.zeros((_KEPT, ngeom, 3)), np.zeros((_KEPT, ngeom, 9))
        self._lever = np.zeros((_KEPT, ngeom))

    def add(self, pos: np.ndarray, mat: np.ndarray, found: _Region) -> None:
        """Keeps what was found at poses (ngeom, 3), (ngeom, 3, 3) instead of the oldest."""
        place = self._next
        self._pos[place], self._mat[place] = pos, mat.reshape(-1, 9)
        self._lever[place] = np.sqrt((pos * pos).sum(1)) + 0.05
        self._found[place : place + 1] = [found]
        self._next, self._asked = (place + 1) % _KEPT, None

    def since(self, pos: np.ndarray, mat: np.ndarray) -> Iterator[tuple[_Region, float]]:
        """What was found, and how far points of geoms near the skin may have moved since [m]."""
        asked = pos.tobytes(), mat.tobytes()
        if asked != self._asked:  # a step asks some times for each pose
            n = len(self._found)
            dp, dm = pos - self._pos[:n], mat.reshape(-1, 9) - self._mat[:n]
            turned = np.sqrt(np.einsum("kij,kij->ki", dm, dm)) * self._lever[:n]
            ways = turned + np.sqrt(np.einsum("kij,kij->ki", dp, dp))
            self._asked, self._ways = asked, ways.max(1).tolist()
        return zip(self._found, self._ways)


class NearSearch:
    """Searches the outer faces of a skin.

    Args:
      model: SkinModel. geoms: GeomSet of one world, posed before each search.
      rest: (nvert, 3) nodes at rest [m]. x_wp, x: (nvert, 1) present nodes, as Warp array and as its view.
    """

    def __init__(self, model: "SkinModel", geoms: GeomSet, rest: np.ndarray, x_wp: wp.array, x: np.ndarray):
        self._model, self._geoms, self._rest, self._x = model, geoms, rest, x
        self._nface, self._now = len(model.outer.face), poses(geoms)

        def zeros(shape, dtype):
            array = wp.zeros(shape, dtype=dtype, device="cpu")
            return array, array.numpy()

        near, self._near = zeros(self._nface, int)
        number, self._asked = zeros(self._nface, int)
        count, self._count = zeros(2, int)
        reach, self._reach = zeros(1, real)
        ball, self._ball = zeros(4, real)
        met, _ = zeros(max(geoms.count, 1), int)
        gap, self._gap = zeros(self._nface, real)
        clearance, self._clearance = zeros(max(geoms.count, 1), real)
        self._detect = recorded(
            _near,
            1,
            [count, number, model.outer.face, model.sample, geoms.struct, x_wp, ball, reach],
            [near, met, gap],
        )
        if model.has_core and geoms.count:
            self._clearances = recorded(
                _core_clearance,
                geoms.count,
                [model.core_vert, model.core(1).struct, geoms.struct],
                [clearance],
            )
        self._regions, self._loaded = _Regions(geoms.count), None
        # of a mesh it is the distance here and a lower bound there
        spacing = geoms.struct.grids.spacing.numpy() if geoms.shapes != SOLIDS else np.zeros(1)
        self._jump = float(TRILINEAR) * float(spacing.max())
        self._whole = _ball(self._rest[model.outer.face.numpy().ravel()])

    def faces(self, reach: float, moved: float, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Faces with a sample nearer than the reach to a geom; `moved` bounds how far the nodes are from rest
        [m]."""
        if not self._geoms.count:
            return _NONE
        region, way = self._region(moved + reach, pos, mat)
        count = int(np.searchsorted(region.gaps, moved + reach + way))
        if not count:
            return _NONE
        if self._loaded is not region:
            self._asked[: len(region.faces)], self._loaded = region.faces, region
        return np.sort(self._look(count, reach, region.ball, moved))

    def clear(self, pos: np.ndarray, mat: np.ndarray, margin: float) -> bool:
        """Whether the skin at rest is further than a margin [m] from geoms at these poses."""
        if not self._geoms.count:
            return True
        self.pose(pos, mat)
        for region, way in self._regions.since(pos, mat):
            if region.least - way > margin and region.clearance > 2 * way:
                return True
        region, _ = self._region(margin, pos, mat)
        if not len(region.faces):
            return region.clearance > 0 or not self.deep(pos, mat)
        self._x[:, 0] = self._rest
        return not len(self.faces(margin, 0.0, pos, mat)) and not self.deep(pos, mat)

    def last_clear(
        self, pos0: np.ndarray, mat0: np.ndarray, pos: np.ndarray, mat: np.ndarray, margin: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses (ngeom, 3) [m], (ngeom, 3, 3), about the last on the way from the first ones, which are
        `clear`, to the others."""
        way, low, high = displacement(pos, mat, pos0, mat0), 0.0, 1.0
        far = np.abs(way).max(initial=0.0)
        while (high - low) * far > _NARROW and high - low > _EVEN:
            middle = 0.5 * (low + high)
            clear = self.clear(*displace(pos0, mat0, middle * way), margin)
            low, high = (middle, high) if clear else (low, middle)
        return displace(pos0, mat0, low * way)

    def outside(self, pos: np.ndarray, mat: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Positions (ngeom, 3) [m] where geoms that are in the resting skin have just left it, each along the
        mean normal of what it touches."""
        return self._out(pos, mat, lambda at: self.clear(at, mat, margin), _NARROW, margin)

    def shallow(self, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Positions (ngeom, 3) [m] where geoms that are too `deep` inside the core have just come out so far
        that a skin fits between, each along the mean normal of what it touches of the resting skin."""
        return self._out(pos, mat, lambda at: not self.deep(at, mat), _CORE)

    def _out(self, pos, mat, free, narrow, margin=0.0):
        """Positions from where each geom, alone at (ngeom, 3), is free, found to within `narrow` [m]."""
        out = pos.copy()
        for g in range(len(pos)):
            alone = np.full_like(pos, 2 * _FAR)

            def is_free(distance, g=g, alone=alone, normal=0.0):
                alone[g] = pos[g] + distance * normal
                self.pose(alone, mat)
                return free(alone)

            if is_free(0.0):
                continue
            self._x[:, 0] = self._rest
            normal = self._outward(pos[g], self.faces(margin, 0.0, alone, mat))
            high = narrow
            while high < _FAR and not is_free(high, normal=normal):
                high *= 2
            low = high / 2
            while high - low > narrow:
                middle = (low + high) / 2
                low, high = (low, middle) if is_free(middle, normal=normal) else (middle, high)
            out[g] = pos[g] + high * normal
        return out

    def _outward(self, point, faces):
        """Mean outward normal (3,) of outer faces (n,) at rest; without any, of the one next to
        a point (3,)."""
        corner = self._rest[self._model.outer.face.numpy()]
        if not len(faces):
            away = corner.mean(1) - point
            faces = np.array([np.einsum("ij,ij->i", away, away).argmin()])
        a, b, c = corner[faces].transpose(1, 0, 2)
        total = np.cross(b - a, c - a).sum(0)
        return total / max(np.linalg.norm(total), 1e-30)

    def deep(self, pos: np.ndarray, mat: np.ndarray) -> bool:
        """Whether a geom, posed so, is deeper inside the core than `max_core_depth`."""
        if not (self._model.has_core and self._geoms.count):
            return False
        limit = self._model.options.max_core_depth
        # a bound may change a little faster than the geom moves, as grids are trilinear, and jump
        least = self._jump - limit
        if any(region.clearance - 2 * way > least for region, way in self._regions.since(pos, mat)):
            return False
        self._clearances()
        least = float(self._clearance.min())
        if least > -limit:  # it is known for the next steps
            self._regions.add(pos, mat, _Region(_NONE, _NONE, -1.0, self._whole, least))
        return -least > limit

    def clearance(self, pos: np.ndarray, mat: np.ndarray) -> np.ndarray | None:
        """(ngeom,) of geoms at these poses from the core, negative inside it [m]; None without a core."""
        if not (self._model.has_core and self._geoms.count):
            return None
        self.pose(pos, mat)
        self._clearances()
        return self._clearance.copy()

    def pose(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Puts the geoms to (ngeom, 3), (ngeom, 3, 3) for what is searched next."""
        self._now[0][...], self._now[1][...] = pos, mat

    def _region(self, reach, pos, mat):
        """A region that holds all faces nearer than the reach [m] to geoms at these poses, and how far these
        may have moved since [m]."""
        for region, way in self._regions.since(pos, mat):
            if reach + 2 * way <= region.width:  # further off, too many faces are looked at
                return region, way
        self._asked[:], self._loaded = np.arange(self._nface), None
        here = self._x.copy()
        self._x[:, 0] = self._rest
        faces = self._look(self._nface, reach + _REGION, self._whole, 0.0)
        nearest = np.argsort(self._gap[: len(faces)], kind="stable")
        faces, gaps = faces[nearest], self._gap[nearest]
        self._x[:] = here
        corner = self._model.outer.face.numpy()[faces].ravel()
        ball = _ball(self._rest[corner]) if len(faces) else self._whole
        clearance = -1.0
        if self._model.has_core:
            self._clearances()
            clearance = float(self._clearance.min())
        region = _Region(faces, gaps, reach + _REGION, ball, clearance)
        self._regions.add(pos, mat, region)
        return region, 0.0

    def _look(self, count, reach, ball, moved):
        """Which of the first faces asked for, in a ball at rest and moved since, are nearer than the
        reach."""
        self._reach[0], self._count[0] = reach, count
        self._ball[:], self._ball[3] = ball, ball[3] + moved
        self._detect()
        return self._near[: self._count[1]].astype(np.int64)


def _ball(points):
    """Centre and radius (4,) of a ball around points (n, 3)."""
    centre = (points.min(0) + points.max(0)) / 2
    return np.append(centre, np.linalg.norm(points - centre, axis=1).max())
