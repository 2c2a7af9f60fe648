"""Proximity query: which faces of a skin at rest are near to the geoms of one world, and whether a geom is
inside the core.

Faces near to the geoms are kept for a few poses, with their clearances, and hold until the geoms have moved
far: BioTacs of one model share a skin. Which of them is used changes nothing but the time."""

import dataclasses
import typing
from collections.abc import Iterator

import numpy as np
import warp as wp

from ...geometry.rigid import displace, displacement
from ...launches import recorded
from ..geoms import GeomSet
from ..types import real, vec3
from .broadphase import ALL, geoms_within, sample_clearance
from .meshes import TRILINEAR
from .penetration import core_clearance
from .posed import Geoms
from .touch import SOLIDS

if typing.TYPE_CHECKING:
    from ..model import SkinModel

__all__ = ["ProximityQuery", "poses"]

wp.set_module_options({"enable_backward": False})

_REGION = 2e-3  # geoms may move this far before the region around them is chosen again [m]
_KEPT = 16
_NARROW = 1e-4  # [m] within which the place is found where a geom begins to touch
_CORE = 1e-6  # and where it comes out of the core
_EVEN = 1e-9  # of a path: finer it is not divided
_FAR = 1.0  # [m] geoms are moved out of the skin by no more
_NONE = np.zeros(0, int)


@wp.kernel
def _measure_faces(
    # In:
    count: wp.array(dtype=int),
    number: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    center: vec3,
    radius: real,
    reach: wp.array(dtype=real),
    # Out:
    clearance_out: wp.array(dtype=real),
):
    """Clearance of the first count[0] numbered faces, where it is less than reach[0] [m]; below reach[1] any
    bound will do. All faces lie in the ball (centre, radius): most geoms are far from it."""
    _count, near = geoms_within(center, radius + reach[0], 0, geoms, ALL)
    for i in range(count[0]):
        t = face[number[i]]
        clearance_out[i] = sample_clearance(
            x[t[0], 0], x[t[1], 0], x[t[2], 0], sample, 0, geoms, near, reach[0], reach[1]
        )


@wp.kernel
def _measure_core(
    # In:
    core_vert: wp.array(dtype=vec3),
    core: Geoms,
    geoms: Geoms,
    # Out:
    clearance_out: wp.array(dtype=real),
):
    """`core_clearance` of each geom from all points of the core."""
    g = wp.tid()
    least = real(1.0)
    for i in range(core_vert.shape[0] + 1):
        at = core_clearance(i, geoms, g, geoms.pos[g, 0], geoms.mat[g, 0], core, core_vert)
        least = wp.min(least, at)
    clearance_out[g] = least


def poses(geoms: GeomSet) -> tuple[np.ndarray, ...]:
    """Views of the positions (ngeom, 3) [m] and rotations (ngeom, 3, 3) of geoms of one world on the CPU, now
    and at the last step: made once, as Warp takes longer for them than for writing there."""
    struct = geoms.struct
    return tuple(a.numpy()[:, 0] for a in (struct.pos, struct.mat, struct.pos_last, struct.mat_last))


@dataclasses.dataclass(frozen=True)
class _Region:
    """Faces (n,) of the resting skin nearer than `width` [m] to the geoms, their clearances (n,), which grow,
    and the geoms' clearance from the core [m]. A width below zero: only the latter is known."""

    faces: np.ndarray
    clearances: np.ndarray
    width: float
    core: float

    @property
    def least(self) -> float:
        """No geom is nearer to the skin."""
        return self.clearances[0] if len(self.faces) else self.width


class _Regions:
    """What was found at the last few poses of `ngeom` geoms, and how far points in a ball at the BioTac have
    moved since in their frames."""

    def __init__(self, ngeom: int, center: np.ndarray, radius: float):
        self._found, self._next, self._asked, self._moved = [], 0, None, []
        self._center, self._radius = center, radius
        self._local, self._mat = np.zeros((_KEPT, ngeom, 3)), np.zeros((_KEPT, ngeom, 9))

    def add(self, pos: np.ndarray, mat: np.ndarray, found: _Region) -> None:
        """Keeps what was found at poses (ngeom, 3), (ngeom, 3, 3) instead of the oldest."""
        place = self._next
        self._local[place], self._mat[place] = self._in_frames(pos, mat), mat.reshape(-1, 9)
        self._found[place : place + 1] = [found]
        self._next, self._asked = (place + 1) % _KEPT, None

    def since(self, pos: np.ndarray, mat: np.ndarray) -> Iterator[tuple[_Region, float]]:
        """What was found, and the bound of the motion since [m]: `broadphase.motion_bound`."""
        asked = pos.tobytes(), mat.tobytes()
        if asked != self._asked:  # a step asks some times for each pose
            n = len(self._found)
            moved = self._in_frames(pos, mat) - self._local[:n]
            turned = mat.reshape(-1, 9) - self._mat[:n]
            bound = np.sqrt(np.einsum("kij,kij->ki", moved, moved))
            bound += self._radius * np.sqrt(np.einsum("kij,kij->ki", turned, turned))
            self._asked, self._moved = asked, bound.max(1).tolist()
        return zip(self._found, self._moved)

    def _in_frames(self, pos, mat):
        return np.einsum("gij,gi->gj", mat, self._center - pos)


class ProximityQuery:
    """Queries about a skin at rest and the geoms of one world, on the CPU.

    Args:
      model: SkinModel. geoms: GeomSet of one world, posed before each query.
    """

    def __init__(self, model: "SkinModel", geoms: GeomSet):
        geoms.resolve(model.spacing, model.options.samples)
        self._model, self._geoms, self._now = model, geoms, poses(geoms)
        self._rest, self._face = np.ascontiguousarray(model.rest.vert, float), model.outer.face.numpy()
        nface, ngeom = len(self._face), max(geoms.count, 1)

        def zeros(shape, dtype):
            array = wp.zeros(shape, dtype=dtype, device="cpu")
            return array, array.numpy()

        number, self._number = zeros(nface, int)
        count, self._count = zeros(1, int)
        reach, self._reach = zeros(2, real)
        clearance, self._clearance = zeros(nface, real)
        core, self._core = zeros(ngeom, real)
        x = wp.array(self._rest[:, None], dtype=vec3, device="cpu")
        points = self._rest[self._face.ravel()]
        center = (points.min(0) + points.max(0)) / 2
        radius = float(np.linalg.norm(points - center, axis=1).max())
        faces = [count, number, model.outer.face, model.sample, geoms.struct, x, vec3(*center), radius, reach]
        self._measure_faces = recorded(_measure_faces, 1, faces, [clearance])
        if model.has_core and geoms.count:
            inputs = [model.core_vert, model.core(1).struct, geoms.struct]
            self._measure_core = recorded(_measure_core, geoms.count, inputs, [core])
        self._regions = _Regions(geoms.count, center, radius)
        # of a mesh it is the distance here and a lower bound there
        spacing = geoms.struct.grids.spacing.numpy() if geoms.shapes != SOLIDS else np.zeros(1)
        self._jump = float(TRILINEAR) * float(spacing.max())

    def faces(self, reach: float, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Faces at rest with a sample nearer than the reach [m] to a geom."""
        if not self._geoms.count:
            return _NONE
        region, moved = self._region(reach, pos, mat)
        count = int(np.searchsorted(region.clearances, reach + moved))
        faces = region.faces[:count]
        return np.sort(faces[self._clearances(faces, reach, reach) < reach]) if count else _NONE

    def clear(self, pos: np.ndarray, mat: np.ndarray, margin: float) -> bool:
        """Whether the skin at rest is further than a margin [m] from geoms at these poses, and none of these
        too `deep` in the core."""
        if not self._geoms.count:
            return True
        self.pose(pos, mat)
        for region, moved in self._regions.since(pos, mat):
            if region.least - moved > margin and region.core > 2 * moved:
                return True
        return not len(self.faces(margin, pos, mat)) and not self.deep(pos, mat)

    def overlaps(self, pos: np.ndarray, mat: np.ndarray) -> bool:
        """Whether geoms at these poses, which are not `clear`, have a sample of the resting skin inside, or
        are `deep`. That looks at the solids themselves: bounds of distances count how far the law of edges
        reaches, too."""
        self.pose(pos, mat)
        self._region(0.0, pos, mat)
        window = self._geoms.struct.window.numpy()
        kept, window[:] = window.copy(), 0.0
        inside = len(self.faces(0.0, pos, mat)) > 0
        window[:] = kept
        return inside or self.deep(pos, mat)

    def last_clear(
        self, pos0: np.ndarray, mat0: np.ndarray, pos: np.ndarray, mat: np.ndarray, margin: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses (ngeom, 3) [m], (ngeom, 3, 3), about the last on the path from the first ones, which are
        `clear`, to the others."""
        path, low, high = displacement(pos, mat, pos0, mat0), 0.0, 1.0
        far = np.abs(path).max(initial=0.0)
        while (high - low) * far > _NARROW and high - low > _EVEN:
            middle = 0.5 * (low + high)
            clear = self.clear(*displace(pos0, mat0, middle * path), margin)
            low, high = (middle, high) if clear else (low, middle)
        return displace(pos0, mat0, low * path)

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
            normal = self._outward(pos[g], self.faces(margin, alone, mat))
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
        corner = self._rest[self._face]
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
        if any(region.core - 2 * moved > least for region, moved in self._regions.since(pos, mat)):
            return False
        self._measure_core()
        least = float(self._core.min())
        if least > -limit:  # it is known for the next steps
            self._regions.add(pos, mat, _Region(_NONE, _NONE, -1.0, least))
        return -least > limit

    def pose(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Puts the geoms to (ngeom, 3), (ngeom, 3, 3) for what is queried next."""
        self._now[0][...], self._now[1][...] = pos, mat

    def _region(self, reach, pos, mat):
        """A region that holds all faces nearer than the reach [m] to geoms at these poses, and how far these
        may have moved since [m]."""
        for region, moved in self._regions.since(pos, mat):
            if reach + 2 * moved <= region.width:  # further off, too many faces are evaluated
                return region, moved
        width = reach + _REGION
        found = self._clearances(np.arange(len(self._face)), width, -1.0).copy()
        faces = np.flatnonzero(found < width)
        faces = faces[np.argsort(found[faces], kind="stable")]
        core = -1.0
        if self._model.has_core:
            self._measure_core()
            core = float(self._core.min())
        region = _Region(faces, found[faces], width, core)
        self._regions.add(pos, mat, region)
        return region, 0.0

    def _clearances(self, faces, reach, enough):
        """(n,) of faces (n,) where they are less than the reach [m]; else that. Below `enough`, any bound."""
        n = len(faces)
        self._count[0], self._reach[:], self._number[:n] = n, (reach, enough), faces
        self._measure_faces()
        return self._clearance[:n]
