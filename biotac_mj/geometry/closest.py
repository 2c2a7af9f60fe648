"""Closest points of triangle meshes, in Warp: on a triangle (Ericson, Real-Time Collision Detection, 5.1.5),
the side of the surface, and lists of the triangles that can be the nearest.

A query of a bounding volume hierarchy reads one node after the other. Near a known point only few triangles
can be the nearest; a list of them, sorted by distance from that point, is read without waiting. For a point
at a distance d from it, all distances change by at most d, so that the first entries determine the nearest
triangle.

Meshes are in millimetres, since queries in single precision lose triangles that are tiny in metres.
"""

import dataclasses
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..kernels import kernel_module

kernel_module(__name__)

real, vec3 = wp.float64, wp.vec3d
FACE = wp.constant(
    6
)  # where a closest point is: a corner (0 to 2), the edge opposite to one (3 to 5), or this
SLACK = 1e-4  # [mm] above the rounding of single precision
_SLACK = wp.constant(real(SLACK))
_FARTHEST = 1.0e5  # [mm] from the mesh at which a triangle is still found


@wp.struct
class TriangleLists:
    """Triangles near points, the nearest first. A list is complete up to its reach, or without limit if
    `reach` is empty."""

    begin: wp.array(dtype=int)  # start of each list, and end of the last one
    face: wp.array(dtype=int)
    away: wp.array(dtype=float)  # from the list's point [mm]
    reach: wp.array(dtype=float)  # [mm]


@dataclasses.dataclass(frozen=True)
class Lists:
    """Lists of one mesh: count (nlist,), face, away (nentry,), reach (nlist,) or (0,)."""

    count: np.ndarray
    face: np.ndarray
    away: np.ndarray
    reach: np.ndarray


@wp.func
def _double(p: wp.vec3):
    return vec3(real(p[0]), real(p[1]), real(p[2]))


@wp.func
def _double(p: vec3):  # noqa: F811
    return p


@wp.func
def closest_on_triangle(a: vec3, b: vec3, c: vec3, q: vec3):
    """The point of a triangle closest to q, and its place (see FACE). In double precision, since single
    precision fails for long triangles. A triangle without area is an edge or a point."""
    ab = b - a
    ac = c - a
    zero = real(0.0)
    d1 = wp.dot(ab, q - a)
    d2 = wp.dot(ac, q - a)
    if d1 <= zero and d2 <= zero:
        return a, 0
    d3 = wp.dot(ab, q - a - ab)
    d4 = wp.dot(ac, q - a - ab)
    if d3 >= zero and d4 <= d3:
        return a + ab, 1
    vc = d1 * d4 - d3 * d2
    if vc <= zero and d1 >= zero and d3 <= zero and d1 > d3:  # else that edge has no length
        return a + d1 / (d1 - d3) * ab, 5
    d5 = wp.dot(ab, q - a - ac)
    d6 = wp.dot(ac, q - a - ac)
    if d6 >= zero and d5 <= d6:
        return a + ac, 2
    vb = d5 * d2 - d1 * d6
    if vb <= zero and d2 >= zero and d6 <= zero and d2 > d6:
        return a + d2 / (d2 - d6) * ac, 4
    va = d3 * d6 - d5 * d4
    if va <= zero and d4 >= d3 and d5 >= d6 and d4 - d3 + d5 - d6 > zero:
        return a + ab + (d4 - d3) / (d4 - d3 + d5 - d6) * (ac - ab), 3
    return a + (vb * ab + vc * ac) / (va + vb + vc), FACE


@wp.func
def closest_on_face(corner: wp.array2d(dtype=Any), face: int, q: vec3):
    """`closest_on_triangle` for a face of corner (nface, 3)."""
    at, place = closest_on_triangle(
        _double(corner[face, 0]), _double(corner[face, 1]), _double(corner[face, 2]), q
    )
    return at, place


@wp.func
def _distance(corner: wp.array2d(dtype=Any), face: int, q: vec3):
    at, _place = closest_on_face(corner, face, q)
    return wp.length(q - at)


@wp.func
def nearest_listed(
    lists: TriangleLists, k: int, corner: wp.array2d(dtype=Any), first: int, q: vec3, moved: real
):
    """Index of the face of list k that is closest to q; -1 if the list is too short to tell, since q is
    `moved` [mm] from the point that the list was made for. corner: (nface, 3) [mm] of all faces; those of the
    list's mesh start at `first`."""
    found = int(-1)
    best = real(wp.inf)
    end = lists.begin[k + 1]
    for n in range(lists.begin[k], end, 3):
        if real(lists.away[n]) - moved > best + _SLACK:  # and so are all that follow
            break
        # read together, since a read after a branch waits for it
        face = wp.vec3i(lists.face[n], lists.face[wp.min(n + 1, end - 1)], lists.face[wp.min(n + 2, end - 1)])
        away = vec3(
            _distance(corner, first + face[0], q),
            _distance(corner, first + face[1], q),
            _distance(corner, first + face[2], q),
        )
        m = int(wp.argmin(away))
        if away[m] < best:
            best = away[m]
            found = face[m]
    if lists.reach.shape[0] > 0:
        if real(lists.reach[k]) - moved <= best + _SLACK:
            found = -1
    return found


@wp.func
def _from_mesh(mesh: wp.uint64, face: int, q: vec3):
    at, _place = closest_on_triangle(
        _double(wp.mesh_get_point(mesh, 3 * face)),
        _double(wp.mesh_get_point(mesh, 3 * face + 1)),
        _double(wp.mesh_get_point(mesh, 3 * face + 2)),
        q,
    )
    return wp.length(q - at)


@wp.kernel
def _find(
    # In:
    mesh: wp.uint64,
    point: wp.array(dtype=wp.vec3),
    room: real,
    most: int,
    begin: wp.array(dtype=int),
    # In and out:
    count: wp.array(dtype=int),
    # Out:
    reach_out: wp.array(dtype=float),
    face_out: wp.array(dtype=int),
    away_out: wp.array(dtype=float),
):
    """Counts the triangles of a list, or writes them if there is space; more than `most` count as none."""
    i = wp.tid()
    p = point[i]
    q = _double(p)
    nearest = _from_mesh(mesh, wp.mesh_query_point_no_sign(mesh, p, wp.static(_FARTHEST)).face, q)
    within = nearest + room
    reach_out[i] = float(within)
    box = float(within) * wp.vec3(1.0, 1.0, 1.0)
    query = wp.mesh_query_aabb(mesh, p - box, p + box)
    face = int(0)
    n = int(0)
    while n <= most and wp.mesh_query_aabb_next(query, face):
        away = _from_mesh(mesh, face, q)
        if away <= within:
            if face_out.shape[0] > 0 and n < count[i]:
                face_out[begin[i] + n] = face
                away_out[begin[i] + n] = float(away)
            n += 1
    if face_out.shape[0] == 0:
        count[i] = wp.where(n > most, 0, n)


def list_nearest(mesh: wp.Mesh, point: np.ndarray, room: float, most: int = 1 << 30) -> Lists:
    """For each point, the list of all triangles that are at most `room` further away than the nearest one.

    Args:
      mesh: in millimetres. point: (n, 3) [mm].
      room: at least twice the motion for which the list must contain the nearest triangle [mm].
      most: triangles of a list; longer lists are left empty.
    """
    n, room = len(point), room + SLACK
    with wp.ScopedDevice(mesh.device):
        given = [mesh.id, wp.array(point, dtype=wp.vec3), room, most]
        none, count, reach = wp.zeros(0, dtype=int), wp.zeros(n, dtype=int), wp.zeros(n, dtype=float)
        wp.launch(_find, n, [*given, none], [count, reach, none, wp.zeros(0, dtype=float)])
        counted = count.numpy()
        begin = np.concatenate([[0], np.cumsum(counted)])
        face, away = wp.zeros(int(begin[-1]), dtype=int), wp.zeros(int(begin[-1]), dtype=float)
        if begin[-1]:
            wp.launch(_find, n, [*given, wp.array(begin, dtype=int)], [count, reach, face, away])
    order = np.lexsort((face.numpy(), away.numpy(), np.repeat(np.arange(n), counted)))
    return Lists(counted, face.numpy()[order], away.numpy()[order], reach.numpy())


def pack_lists(lists: list[Lists]) -> TriangleLists:
    """Concatenates the lists of several meshes, on Warp's default device."""
    packed = TriangleLists()

    def joined(name, kind):
        return np.concatenate([np.zeros(0, kind), *(getattr(one, name) for one in lists)]).astype(kind)

    begin = np.concatenate([[0], np.cumsum(joined("count", np.int32))])
    packed.begin, packed.face = wp.array(begin, dtype=int), wp.array(joined("face", np.int32), dtype=int)
    packed.away = wp.array(joined("away", np.float32), dtype=float)
    packed.reach = wp.array(joined("reach", np.float32), dtype=float)
    return packed


def pseudonormals(vert: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Mean normals (nface, 6, 3) at the corners of each face, weighted by angles, and at the edges opposite
    to them. They determine on which side of a corner or edge of any angle a point is (Baerentzen and Aanaes
    2005). Zero at edges that do not have two faces.

    Args:
      vert: (n, 3) [m]. face: (nface, 3).
    """
    # corners with different indices may be at the same place
    places, of_vert = np.unique(vert, axis=0, return_inverse=True)
    pairs = cKDTree(places).query_pairs(1e-8, output_type="ndarray")
    joined = sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(places),) * 2)
    corner = connected_components(joined, directed=False)[1][of_vert.reshape(-1)][face]
    to_next, to_last = (vert[np.roll(face, n, 1)] - vert[face] for n in (-1, 1))
    normal = np.cross(to_next[:, 0], to_last[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    sine = np.linalg.norm(np.cross(to_next, to_last), axis=-1)
    angle = np.arctan2(sine, (to_next * to_last).sum(-1))
    around = np.zeros((corner.max() + 1, 3))
    np.add.at(around, corner, angle[..., None] * normal[:, None])
    ends = np.sort(np.stack([np.roll(corner, -1, 1), np.roll(corner, -2, 1)], -1), -1)
    _, edge, faces = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1, 3)
    along = np.zeros((len(faces), 3))
    np.add.at(along, edge, np.repeat(normal[:, None], 3, 1))
    along[faces != 2] = 0.0
    around[ends[faces[edge] != 2]] = 0.0
    return np.concatenate([around[corner], along[edge]], 1)


def ray_distances(
    corner: np.ndarray, start: np.ndarray, direction: np.ndarray, least: float = 0.0, margin: float = 1e-9
) -> np.ndarray:
    """Distances (n,) along rays to triangles of corners (n, 3, 3), inf where a ray misses its triangle
    (Moeller and Trumbore 1997).

    Args:
      start, direction: (3,) of one ray, or (n, 3) of a ray for each triangle; distances are in lengths of the
        direction.
      least: smallest distance that counts, negative for hits behind the start.
      margin: barycentric coordinate by which triangles are wider, so that no ray passes between two.
    """
    first, along, across = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal, offset = np.cross(direction, across), start - first
    side, direction = np.cross(offset, along), np.broadcast_to(direction, first.shape)
    pairs = (along, normal), (offset, normal), (side, direction), (across, side)
    over, u, v, t = (np.einsum("ij,ij->i", *pair) for pair in pairs)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, t = u / over, v / over, t / over
        met = (u >= -margin) & (v >= -margin) & (u + v <= 1 + margin) & (t >= least)
    return np.where(met, t, np.inf)
