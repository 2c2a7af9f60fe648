"""Closest points on closed surfaces: on the rigid core they give the thickness of the liquid film under every
node of the skin."""

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..kernels import kernel_module
from ..quiet import quiet_warp
from .closest import (
    FACE,
    Lists,
    TriangleLists,
    closest_on_face,
    list_nearest,
    nearest_listed,
    pack_lists,
    pseudonormals,
)

quiet_warp()

kernel_module(__name__)

_FARTHEST = 1.0e4  # [mm] largest distance of a query point from the core
_NEAREST = 64  # most candidate triangles per point
_ROOM = 0.5  # [mm] motion of a point for which its candidates suffice
real, vec3 = wp.float64, wp.vec3d


@wp.struct
class Core:
    """Triangles of the core and their adjacency."""

    mesh: wp.uint64  # in mm, single precision
    corner: wp.array2d(dtype=vec3)  # (ntriangle, 3) [mm]
    normal: wp.array2d(dtype=wp.vec3)  # (ntriangle, 6), `closest.pseudonormals`
    start: wp.array(dtype=int)
    adjacent: wp.array(dtype=int)


@wp.struct
class NearestTriangles:
    """Candidate triangles for each point, from the rest positions."""

    rest: wp.array(dtype=vec3)
    lists: TriangleLists


@wp.func
def _from_face(core: Core, face: int, q: vec3):
    """Vector from the closest point of a triangle to q [m; q in mm] and its length, negative inside."""
    at, place = closest_on_face(core.corner, face, q)
    gap = real(1.0e-3) * (q - at)
    side = real(0.0)
    if place != FACE:
        normal = core.normal[face, place]
        side = wp.dot(gap, vec3(real(normal[0]), real(normal[1]), real(normal[2])))
    if side == real(0.0):
        a = core.corner[face, 0]
        side = wp.dot(gap, wp.cross(core.corner[face, 1] - a, core.corner[face, 2] - a))
    distance = wp.length(gap)
    if side < real(0.0):
        distance = -distance
    return gap, distance


@wp.func
def nearest_on_core(core: Core, p: vec3):
    """Vector from the closest point to p [m], its length (negative inside the core) and the triangle; nan and
    -1 for a point that is not finite."""
    q = real(1.0e3) * p
    query = wp.mesh_query_point_no_sign(
        core.mesh, wp.vec3(wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2])), wp.float32(_FARTHEST)
    )
    if not query.result:
        none = real(wp.nan)
        return vec3(none, none, none), none, -1
    face = int(query.face)
    at, place = closest_on_face(core.corner, face, q)
    if place != FACE:  # single precision may have taken the edge's other side
        least = wp.length_sq(q - at)
        for k in range(core.start[query.face], core.start[query.face + 1]):
            at, _place = closest_on_face(core.corner, core.adjacent[k], q)
            if wp.length_sq(q - at) < least:
                least = wp.length_sq(q - at)
                face = core.adjacent[k]
    gap, distance = _from_face(core, face, q)
    return gap, distance, face


@wp.func
def nearest_listed_on_core(core: Core, nearest: NearestTriangles, i: int, p: vec3):
    """`nearest_on_core` of point i: most points need only their candidate triangles, others query the
    tree."""
    moved = real(1.0e3) * wp.length(p - nearest.rest[i])
    face = nearest_listed(nearest.lists, i, core.corner, 0, real(1.0e3) * p, moved)
    if face < 0:
        gap, distance, face = nearest_on_core(core, p)
        return gap, distance, face
    gap, distance = _from_face(core, face, real(1.0e3) * p)
    return gap, distance, face


@wp.kernel
def _closest(
    # In:
    core: Core,
    point: wp.array(dtype=vec3),
    # Out:
    gap_out: wp.array(dtype=vec3),
    distance_out: wp.array(dtype=real),
    face_out: wp.array(dtype=int),
):
    i = wp.tid()
    gap, distance, face = nearest_on_core(core, point[i])
    gap_out[i] = gap
    distance_out[i] = distance
    face_out[i] = face


class CoreSurface:
    """Exact distance to a closed triangulated surface: the tree of a Warp mesh proposes a triangle, and the
    distance to it and its neighbours is computed in double precision.

    Args:
      vert: (n, 3) [m].
      face: (m, 3), normals outwards; those without area are ignored.
      device: Warp device.

    Attributes:
      normal: (ntriangle, 3) outwards.
      core: argument of `nearest_on_core`.
    """

    def __init__(self, vert: ArrayLike, face: ArrayLike, device: str = "cpu"):
        vert, face = np.asarray(vert, dtype=float), np.asarray(face)
        corner = vert[face]
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(cross, axis=1)
        face, corner = face[area > 0], corner[area > 0]
        self.normal = cross[area > 0] / area[area > 0, None]
        self.device = wp.get_device(device)
        start, adjacent = _neighbours(face, len(vert))
        with wp.ScopedDevice(self.device):
            self._mesh = wp.Mesh(wp.array(vert * 1e3, dtype=wp.vec3), wp.array(face.ravel(), dtype=int))
            self.core = Core()
            self.core.mesh = self._mesh.id
            self.core.corner = wp.array(1e3 * corner, dtype=vec3, ndim=2)
            self.core.normal = wp.array(pseudonormals(vert, face), dtype=wp.vec3, ndim=2)
            self.core.start, self.core.adjacent = wp.array(start, dtype=int), wp.array(adjacent, dtype=int)

    def closest(self, point: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Signed distance (positive outside) and foot point.

        Args:
          point: (n, 3) [m].

        Returns:
          distance (n,) [m], foot (n, 3) [m], triangle (n,) int.
        """
        point = np.asarray(point, dtype=float)
        n = len(point)
        with wp.ScopedDevice(self.device):
            gap, distance, triangle = wp.zeros(n, dtype=vec3), wp.zeros(n, dtype=real), wp.zeros(n, dtype=int)
            wp.launch(_closest, n, [self.core, wp.array(point, dtype=vec3)], [gap, distance, triangle])
        return distance.numpy(), point - gap.numpy(), triangle.numpy()

    def nearest(self, rest: ArrayLike) -> NearestTriangles:
        """Candidates for `nearest_listed_on_core`, for points at (n, 3) [m] at rest."""
        rest = np.asarray(rest, dtype=float)
        lists = list_nearest(self._mesh, 1e3 * rest, 2.0 * _ROOM)
        end = np.cumsum(lists.count)
        place = np.arange(len(lists.face)) - np.repeat(end - lists.count, lists.count)
        more = lists.count > _NEAREST  # the entry after the kept ones is the first that is missing
        reach = lists.reach.copy()
        reach[more] = lists.away[(end - lists.count)[more] + _NEAREST]
        kept = place < _NEAREST
        lists = Lists(np.minimum(lists.count, _NEAREST), lists.face[kept], lists.away[kept], reach)
        with wp.ScopedDevice(self.device):
            nearest = NearestTriangles()
            nearest.rest = wp.array(rest, dtype=vec3)
            nearest.lists = pack_lists([lists])
        return nearest


def _neighbours(face, nvert):
    """Faces that share a node with each face: start (m + 1,), adjacent."""
    from scipy.sparse import coo_matrix

    m = len(face)
    at = coo_matrix((np.ones(3 * m), (np.repeat(np.arange(m), 3), face.ravel())), shape=(m, nvert)).tocsr()
    shared = (at @ at.T).tocsr()
    return shared.indptr, shared.indices
