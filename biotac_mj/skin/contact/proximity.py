"""Proximity queries: which faces of the undeformed skin are near the geoms of one world, and whether a geom
is inside the core.

Near faces are stored with their clearances for a few poses, and are valid until the geoms have moved far. The
cache changes only the time, not the results."""

import dataclasses
import typing
from collections.abc import Iterator

import numpy as np
import warp as wp

from ...geometry.rigid import displace, displacement
from ...geometry.surface import face_areas
from ...launches import recorded
from ..geoms import GeomSet
from ..types import mat33, real, vec3
from .meshes import TRILINEAR
from .outside import leave_skin
from .penetration import measure_core, measure_faces
from .touch import SOLIDS

if typing.TYPE_CHECKING:
    from ..model import SkinModel

_REGION = 2e-3  # motion of the geoms for which a region is valid [m]
_MAX_REGIONS = 16  # stored regions; several BioTacs of one model share a skin
_NARROW = 1e-4  # [m] accuracy of the position at first contact
_CORE = 1e-6  # [m] accuracy of the position at which a geom leaves the core
_LEAST_INTERVAL = 1e-9  # of a path in a bisection
_FAR = 1.0  # [m] most motion of a geom out of the skin
_NONE = np.zeros(0, int)


def poses(geoms: GeomSet) -> tuple[np.ndarray, ...]:
    """Views of the positions (ngeom, 3) [m] and rotations (ngeom, 3, 3) of geoms of one world on the CPU, of
    this step and the last. Make them once: Warp needs more time for a view than for writing to it."""
    struct = geoms.struct
    return tuple(a.numpy()[:, 0] for a in (struct.pos, struct.mat, struct.pos_last, struct.mat_last))


@dataclasses.dataclass(frozen=True)
class _Region:
    """Faces (n,) of the undeformed skin closer than `width` [m] to the geoms, their clearances (n,) in
    ascending order, and the geoms' clearance from the core [m]. width < 0: only the latter is known."""

    faces: np.ndarray
    clearances: np.ndarray
    width: float
    core: float

    @property
    def least(self) -> float:
        """Least clearance of the skin from all geoms [m]."""
        return self.clearances[0] if len(self.faces) else self.width


class _Regions:
    """Regions at the last few poses of `ngeom` geoms, and the motion since in the geoms' frames of points in
    a ball around the skin."""

    def __init__(self, ngeom: int, center: np.ndarray, radius: float):
        self._found, self._next, self._queried, self._moved = [], 0, None, []
        self._center, self._radius = center, radius
        self._local, self._mat = np.zeros((_MAX_REGIONS, ngeom, 3)), np.zeros((_MAX_REGIONS, ngeom, 9))

    def add(self, pos: np.ndarray, mat: np.ndarray, found: _Region) -> None:
        """Stores a region at poses (ngeom, 3), (ngeom, 3, 3) in place of the oldest."""
        place = self._next
        self._local[place], self._mat[place] = self._in_frames(pos, mat), mat.reshape(-1, 9)
        self._found[place : place + 1] = [found]
        self._next, self._queried = (place + 1) % _MAX_REGIONS, None

    def since(self, pos: np.ndarray, mat: np.ndarray) -> Iterator[tuple[_Region, float]]:
        """Yields each region and a bound of the motion since [m], see `broadphase.motion_bound`."""
        queried = pos.tobytes(), mat.tobytes()
        if queried != self._queried:  # a step queries each pose several times
            n = len(self._found)
            moved = self._in_frames(pos, mat) - self._local[:n]
            turned = mat.reshape(-1, 9) - self._mat[:n]
            bound = np.sqrt(np.einsum("kij,kij->ki", moved, moved))
            bound += self._radius * np.sqrt(np.einsum("kij,kij->ki", turned, turned))
            self._queried, self._moved = queried, bound.max(1).tolist()
        return zip(self._found, self._moved)

    def _in_frames(self, pos, mat):
        return np.einsum("gij,gi->gj", mat, self._center - pos)


class ProximityQuery:
    """Queries about the undeformed skin and the geoms of one world, on the CPU.

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
        core, self._core = zeros(1, real)
        x = wp.array(self._rest[:, None], dtype=vec3, device="cpu")
        points = self._rest[self._face.ravel()]
        center = (points.min(0) + points.max(0)) / 2
        radius = float(np.linalg.norm(points - center, axis=1).max())
        faces = [count, number, model.outer.face, model.sample, geoms.struct, x, vec3(*center), radius, reach]
        self._measure_faces = recorded(measure_faces, 1, faces, [clearance])
        if model.has_core and geoms.count:
            inputs = [model.core_vert, model.core(1).struct, geoms.struct]
            self._measure_core = recorded(measure_core, 1, inputs, [core])
        if geoms.count:
            self._left, self._turned = zeros((ngeom, 1), vec3)[0], zeros((ngeom, 1), mat33)[0]
            self._known = wp.ones(1, dtype=int, device="cpu"), model.outer.face, model.sample, x, geoms.struct
        self._regions = _Regions(geoms.count, center, radius)
        # of a mesh it is the distance here and a lower bound there
        spacing = geoms.struct.grids.spacing.numpy() if geoms.shapes != SOLIDS else np.zeros(1)
        self._jump = float(TRILINEAR) * float(spacing.max())

    def faces(self, reach: float, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Indices (n,) of the undeformed faces with a sample closer than `reach` [m] to a geom."""
        if not self._geoms.count:
            return _NONE
        region, moved = self._region(reach, pos, mat)
        count = int(np.searchsorted(region.clearances, reach + moved))
        faces = region.faces[:count]
        return np.sort(faces[self._clearances(faces, reach, reach) < reach]) if count else _NONE

    def clear(self, pos: np.ndarray, mat: np.ndarray, margin: float) -> bool:
        """Whether geoms at these poses are further than `margin` [m] from the undeformed skin, and none is
        too `deep` in the core."""
        if not self._geoms.count:
            return True
        self.pose(pos, mat)
        for region, moved in self._regions.since(pos, mat):
            if region.least - moved > margin and region.core > 2 * moved:
                return True
        return not len(self.faces(margin, pos, mat)) and not self.deep(pos, mat)

    def last_clear(
        self, pos0: np.ndarray, mat0: np.ndarray, pos: np.ndarray, mat: np.ndarray, margin: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Last poses (ngeom, 3) [m], (ngeom, 3, 3), to within 0.1 mm, that are `clear` on the path from pos0,
        mat0, which are clear, to pos, mat."""
        path, low, high = displacement(pos, mat, pos0, mat0), 0.0, 1.0
        far = np.abs(path).max(initial=0.0)
        while (high - low) * far > _NARROW and high - low > _LEAST_INTERVAL:
            middle = 0.5 * (low + high)
            clear = self.clear(*displace(pos0, mat0, middle * path), margin)
            low, high = (middle, high) if clear else (low, middle)
        return displace(pos0, mat0, low * path)

    def outside(self, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Positions (ngeom, 3) [m] of the geoms after each is moved out of the undeformed skin, along the
        mean normal of the faces that it touches (`outside.leave_skin`); of one in the core that touches none,
        after it is made `shallow`."""
        if self.clear(pos, mat, 0.0):
            return pos
        out = self._leave_skin(pos, mat)
        self.pose(out, mat)
        return self._leave_skin(self.shallow(out, mat), mat) if self.deep(out, mat) else out

    def _leave_skin(self, pos, mat):
        self.pose(pos, mat)
        left = self._left.numpy()[:, 0]
        left[...] = np.nan
        # not recorded beforehand: few geoms begin in a skin, and the kernel takes 2 s to compile
        wp.launch_tiled(
            leave_skin,
            dim=self._left.shape,
            inputs=self._known,
            outputs=[self._left, self._turned],
            block_dim=1,
            device="cpu",
        )
        return left.copy()

    def shallow(self, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Positions (ngeom, 3) [m] of the geoms. Each one that is too `deep` in the core is moved out, along
        the mean normal of the undeformed faces that it touches, until a skin fits between; accurate to 1
        um."""
        out = pos.copy()
        for g in range(len(pos)):
            single = np.full_like(pos, 2 * _FAR)  # the others far away

            def is_free(distance, g=g, single=single, normal=0.0):
                single[g] = pos[g] + distance * normal
                self.pose(single, mat)
                return not self.deep(single, mat)

            if is_free(0.0):
                continue
            normal = self._outward(pos[g], self.faces(0.0, single, mat))
            high = _CORE
            while high < _FAR and not is_free(high, normal=normal):
                high *= 2
            low = high / 2
            while high - low > _CORE:
                middle = (low + high) / 2
                low, high = (low, middle) if is_free(middle, normal=normal) else (middle, high)
            out[g] = pos[g] + high * normal
        return out

    def _outward(self, point, faces):
        """Mean outward normal (3,) of outer faces (n,) of the undeformed skin; if n is 0, that of the face
        closest to a point (3,)."""
        if not len(faces):
            away = self._rest[self._face].mean(1) - point
            faces = np.array([np.einsum("ij,ij->i", away, away).argmin()])
        total = face_areas(self._rest, self._face[faces]).sum(0)
        return total / max(np.linalg.norm(total), 1e-30)

    def deep(self, pos: np.ndarray, mat: np.ndarray) -> bool:
        """Whether a geom at these poses is deeper inside the core than `max_core_depth`."""
        if not (self._model.has_core and self._geoms.count):
            return False
        limit = self._model.options.max_core_depth
        # a bound may change slightly faster than the geom moves, since grids are trilinear, and jump
        least = self._jump - limit
        if any(region.core - 2 * moved > least for region, moved in self._regions.since(pos, mat)):
            return False
        self._measure_core()
        least = float(self._core[0])
        if least > -limit:  # stored for the next steps
            self._regions.add(pos, mat, _Region(_NONE, _NONE, -1.0, least))
        return -least > limit

    def pose(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Sets the geoms' poses (ngeom, 3), (ngeom, 3, 3) for the next query."""
        self._now[0][...], self._now[1][...] = pos, mat

    def _region(self, reach, pos, mat):
        """A region with all faces closer than `reach` [m] to geoms at these poses, and a bound of the motion
        since it was found [m]."""
        for region, moved in self._regions.since(pos, mat):
            if reach + 2 * moved <= region.width:  # with more motion, too many faces would be evaluated
                return region, moved
        width = reach + _REGION
        found = self._clearances(np.arange(len(self._face)), width, -1.0).copy()
        faces = np.flatnonzero(found < width)
        faces = faces[np.argsort(found[faces], kind="stable")]
        core = -1.0
        if self._model.has_core:
            self._measure_core()
            core = float(self._core[0])
        region = _Region(faces, found[faces], width, core)
        self._regions.add(pos, mat, region)
        return region, 0.0

    def _clearances(self, faces, reach, enough):
        """Clearances (n,) of faces (n,), at most `reach` [m]; below `enough` any lower bound."""
        n = len(faces)
        self._count[0], self._reach[:], self._number[:n] = n, (reach, enough), faces
        self._measure_faces()
        return self._clearance[:n]
