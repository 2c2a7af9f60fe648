"""Closest points on the rigid core: how thick the liquid film is under every node of the skin."""

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from biotac_mj.quiet import quiet_warp

quiet_warp()

__all__ = ["Core", "CoreSurface", "Near", "nearest_of_near", "nearest_on_core"]

wp.set_module_options({"enable_backward": False})

_FARTHEST = 1.0e4  # [mm] from the core at which a point is still found
_NEAR = 16  # triangles that are kept for a point
_ROOM = 0.2e-3  # [m] of motion that they are looked for
_ROUNDING = 1e-12  # [m] by which distances may differ that are the same
real, vec3 = wp.float64, wp.vec3d


@wp.struct
class Core:
    """Triangles of the core, and which share a node with which."""

    mesh: wp.uint64  # in mm, single precision
    corner: wp.array2d(dtype=vec3)  # (ntriangle, 3) [m]
    start: wp.array(dtype=int)
    beside: wp.array(dtype=int)


@wp.struct
class Near:
    """Triangles near to points at rest, nearest first. From a point that has moved by d they are d nearer at
    most, so a few of them settle which is nearest now; behind the last one no triangle is missing up to a
    distance that has the face -1."""

    rest: wp.array(dtype=vec3)
    distance: wp.array2d(dtype=real)  # [point, triangle], at rest
    face: wp.array2d(dtype=int)


@wp.func
def _on_triangle(p: vec3, a: vec3, b: vec3, c: vec3):
    """Coordinates (s, t) of the point a + s (b - a) + t (c - a) of a triangle that is closest to p (Ericson,
    Real-Time Collision Detection, 5.1.5)."""
    zero = real(0.0)
    one = real(1.0)
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, p - a)
    d2 = wp.dot(ac, p - a)
    d3 = wp.dot(ab, p - b)
    d4 = wp.dot(ac, p - b)
    d5 = wp.dot(ab, p - c)
    d6 = wp.dot(ac, p - c)
    if d1 <= zero and d2 <= zero:
        return wp.vec2d(zero, zero)
    if d3 >= zero and d4 <= d3:
        return wp.vec2d(one, zero)
    if d6 >= zero and d5 <= d6:
        return wp.vec2d(zero, one)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    if vc <= zero and d1 >= zero and d3 <= zero:
        return wp.vec2d(d1 / (d1 - d3), zero)
    if vb <= zero and d2 >= zero and d6 <= zero:
        return wp.vec2d(zero, d2 / (d2 - d6))
    if va <= zero and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec2d(one - t, t)
    return wp.vec2d(vb, vc) / (va + vb + vc)


@wp.func
def _gap(core: Core, f: int, p: vec3):
    """From the closest point of triangle f to p, and whether that point is on the triangle's edge."""
    a = core.corner[f, 0]
    b = core.corner[f, 1]
    c = core.corner[f, 2]
    at = _on_triangle(p, a, b, c)
    inside = wp.min(wp.min(at[0], at[1]), real(1.0) - at[0] - at[1])
    return p - a - at[0] * (b - a) - at[1] * (c - a), inside <= real(1.0e-12)


@wp.func
def nearest_on_core(core: Core, p: vec3):
    """Vector from the closest point to p [m], its length, negative inside the core, and the triangle; nan and
    -1 for a point that is not finite."""
    mm = real(1.0e3) * p
    query = wp.mesh_query_point_no_sign(
        core.mesh, wp.vec3(wp.float32(mm[0]), wp.float32(mm[1]), wp.float32(mm[2])), wp.float32(_FARTHEST)
    )
    if not query.result:
        none = real(wp.nan)
        return vec3(none, none, none), none, -1
    face = int(query.face)
    gap, edge = _gap(core, face, p)
    if edge:  # single precision may have taken the edge's other side
        for k in range(core.start[query.face], core.start[query.face + 1]):
            other, _edge = _gap(core, core.beside[k], p)
            if wp.length_sq(other) < wp.length_sq(gap):
                gap = other
                face = core.beside[k]
    return gap, _signed(core, face, gap), face


@wp.func
def _signed(core: Core, face: int, gap: vec3):
    a = core.corner[face, 0]
    normal = wp.cross(core.corner[face, 1] - a, core.corner[face, 2] - a)
    distance = wp.length(gap)
    if wp.dot(gap, normal) < real(0.0):
        distance = -distance
    return distance


@wp.func
def nearest_of_near(core: Core, near: Near, i: int, p: vec3):
    """As `nearest_on_core`, of point i: most points are settled by a few triangles that are near to them at
    rest, others ask the tree."""
    moved = wp.length(p - near.rest[i])
    gap = vec3()
    least = real(wp.inf)
    face = int(-1)
    for k in range(near.face.shape[1]):
        if near.distance[i, k] - moved > least + real(_ROUNDING):
            return gap, _signed(core, face, gap), face
        if near.face[i, k] < 0:
            break
        other, _edge = _gap(core, near.face[i, k], p)
        length = wp.length(other)
        if length < least:
            gap = other
            least = length
            face = near.face[i, k]
    gap, distance, face = nearest_on_core(core, p)
    return gap, distance, face


@wp.kernel
def _find_near(
    # In:
    core: Core,
    rest: wp.array(dtype=vec3),
    reach: wp.array(dtype=real),
    # Out:
    distance_out: wp.array2d(dtype=real),
    face_out: wp.array2d(dtype=int),
):
    """The nearest triangles of each point up to a distance `reach`, in order; where there is room left, face
    -1 at that distance."""
    i = wp.tid()
    p = rest[i]
    mm = wp.vec3(real(1.0e3) * p)
    side = wp.float32(real(1.001e3) * reach[i])  # of a box that holds that ball, in single precision
    box = wp.vec3(side, side, side)
    query = wp.mesh_query_aabb(core.mesh, mm - box, mm + box)
    face = int(0)
    count = int(0)
    last = distance_out.shape[1] - 1
    while wp.mesh_query_aabb_next(query, face):
        gap, _edge = _gap(core, face, p)
        distance = wp.length(gap)
        if distance < reach[i] and (count <= last or distance < distance_out[i, last]):
            at = wp.min(count, last)
            while at > 0 and distance_out[i, at - 1] > distance:
                distance_out[i, at] = distance_out[i, at - 1]
                face_out[i, at] = face_out[i, at - 1]
                at -= 1
            distance_out[i, at] = distance
            face_out[i, at] = face
            count += 1
    if count <= last:
        distance_out[i, count] = reach[i]
        face_out[i, count] = -1
    else:
        face_out[i, last] = -1  # what comes behind it is not known


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
    """Exact distance to a closed triangulated surface: the tree of a Warp mesh proposes a triangle, and on
    that one and its neighbours the distance is found in double precision.

    Args:
      vert: (n, 3) [m].
      face: (m, 3), normals outwards; those without area are left out.
      device: Warp device.

    Attributes:
      normal: (ntriangle, 3) outwards.
      core: the struct that `nearest_on_core` takes.
    """

    def __init__(self, vert: ArrayLike, face: ArrayLike, device: str = "cpu"):
        vert, face = np.asarray(vert, dtype=float), np.asarray(face)
        corner = vert[face]
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(cross, axis=1)
        face, corner = face[area > 0], corner[area > 0]
        self.normal = cross[area > 0] / area[area > 0, None]
        self.device = wp.get_device(device)
        start, beside = _neighbours(face, len(vert))
        with wp.ScopedDevice(self.device):
            self._mesh = wp.Mesh(wp.array(vert * 1e3, dtype=wp.vec3), wp.array(face.ravel(), dtype=int))
            self.core = Core()
            self.core.mesh = self._mesh.id
            self.core.corner = wp.array(corner, dtype=vec3, ndim=2)
            self.core.start, self.core.beside = wp.array(start, dtype=int), wp.array(beside, dtype=int)

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

    def near(self, rest: ArrayLike) -> Near:
        """What `nearest_of_near` takes for points that are at (n, 3) [m] at rest."""
        rest = np.asarray(rest, dtype=float)
        reach = np.abs(self.closest(rest)[0]) + 2.0 * _ROOM
        with wp.ScopedDevice(self.device):
            near = Near()
            near.rest = wp.array(rest, dtype=vec3)
            near.distance = wp.zeros((len(rest), _NEAR), dtype=real)
            near.face = wp.full((len(rest), _NEAR), -1, dtype=int)
            inputs = [self.core, near.rest, wp.array(reach, dtype=real)]
            wp.launch(_find_near, len(rest), inputs, [near.distance, near.face])
        return near


def _neighbours(face, nvert):
    """Faces that share a node with each face: start (m + 1,), beside."""
    from scipy.sparse import coo_matrix

    m = len(face)
    at = coo_matrix((np.ones(3 * m), (np.repeat(np.arange(m), 3), face.ravel())), shape=(m, nvert)).tocsr()
    shared = (at @ at.T).tocsr()
    return shared.indptr, shared.indices
