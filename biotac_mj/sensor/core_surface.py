"""Closest points on the rigid core: how thick the liquid film is under every node of the skin."""

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from biotac_mj.calm import calm_warp

calm_warp()

__all__ = ["Core", "CoreSurface", "nearest_on_core"]

wp.set_module_options({"enable_backward": False})

_FARTHEST = 1.0e4  # [mm] from the core at which a point is still found
real, vec3 = wp.float64, wp.vec3d


@wp.struct
class Core:
    """Triangles of the core, and which share a node with which."""

    mesh: wp.uint64  # in mm, single precision
    corner: wp.array2d(dtype=vec3)  # (ntriangle, 3) [m]
    start: wp.array(dtype=int)
    beside: wp.array(dtype=int)


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
    a = core.corner[face, 0]
    normal = wp.cross(core.corner[face, 1] - a, core.corner[face, 2] - a)
    distance = wp.length(gap)
    if wp.dot(gap, normal) < real(0.0):
        distance = -distance
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


def _neighbours(face, nvert):
    """Faces that share a node with each face: start (m + 1,), beside."""
    from scipy.sparse import coo_matrix

    m = len(face)
    at = coo_matrix((np.ones(3 * m), (np.repeat(np.arange(m), 3), face.ravel())), shape=(m, nvert)).tocsr()
    shared = (at @ at.T).tocsr()
    return shared.indptr, shared.indices
