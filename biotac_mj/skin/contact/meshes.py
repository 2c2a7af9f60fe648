"""Signed distance to closed triangle meshes, in Warp: far from the surface by a grid, close to it by the
nearest triangle."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ...cache import cached
from ...geometry.solid import bounds_solid
from ..types import double, real, single, vec3
from .candidates import (
    Candidates,
    Lists,
    list_candidates,
    nearest_candidate,
    nearest_place,
    pack_lists,
    triangle_of,
)

__all__ = [
    "TRILINEAR",
    "DistanceGrid",
    "Grids",
    "bake_distance_grid",
    "grid_value",
    "mesh_distance",
    "mesh_field",
    "pack_grids",
    "to_triangles",
]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Grids:
    """Distance grids of all meshes, one after another, and the meshes themselves (millimetres)."""

    mesh: wp.array(dtype=wp.uint64)
    value: wp.array(dtype=wp.float32)
    first: wp.array(dtype=int)
    shape: wp.array(dtype=wp.vec3i)
    origin: wp.array(dtype=vec3)
    spacing: wp.array(dtype=real)
    first_face: wp.array(dtype=int)
    normal: wp.array(dtype=wp.vec3)  # six of each face, see `_normals`
    candidates: Candidates


@dataclasses.dataclass(frozen=True)
class DistanceGrid:
    """Signed distance of a closed mesh on a regular grid.

    Attributes:
      value: (nx, ny, nz) float32, negative inside [m].
      origin: (3,) position of value[0, 0, 0] [m].
      spacing: of the grid, the same along the three axes [m].
      vert, face: (n, 3) [m], (m, 3) the mesh: within a few cells of its surface the distance is computed from
        the triangles.
      lists: which triangles can be the nearest, of the cells there.
    """

    value: np.ndarray
    origin: np.ndarray
    spacing: float
    vert: np.ndarray
    face: np.ndarray
    lists: Lists


@wp.kernel
def _bake(
    mesh: wp.uint64,
    origin: wp.vec3,
    spacing: float,
    ny: int,
    nz: int,
    reach: float,
    value_out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    p = origin + spacing * wp.vec3(float(i // (ny * nz)), float((i // nz) % ny), float(i % nz))
    query = wp.mesh_query_point(mesh, p, reach)
    q = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    value_out[i] = query.sign * wp.length(p - q)


def bake_distance_grid(
    vert: np.ndarray, face: np.ndarray, cells: int = 64, margin: float = 2e-3, spacing: float | None = None
) -> DistanceGrid:
    """Distance grid of a closed triangle mesh. It takes seconds, once: grids are kept on disk.

    Args:
      vert: (n, 3) [m].
      face: (m, 3), outward orientation.
      cells: grid cells along the longest side of the mesh, and at most twice as many with the margins.
      margin: how far the grid reaches beyond the mesh [m].
      spacing: of the grid [m], instead of `cells`.

    Raises:
      ValueError: the mesh bounds no solid (it is open, say) or is empty.
    """
    vert, face = np.asarray(vert, float), np.asarray(face, np.int32)
    if not len(vert) or not len(face):
        raise ValueError("a mesh geom without faces has no distance field: give it a triangle mesh")
    if not bounds_solid(vert, face):
        raise ValueError("the mesh is open: its inside is not defined; close its holes")
    low, high = vert.min(0), vert.max(0)
    if spacing is None:
        longest = float((high - low).max())
        spacing = max(longest / cells, (longest + 2 * margin) / (2 * cells))
    origin = low - margin

    def baked():
        mesh, scale = _mesh(vert, face, "cpu"), 1e3
        shape = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
        value = wp.zeros(int(shape.prod()), dtype=wp.float32, device="cpu")
        reach = float(np.linalg.norm(high - low) + 4 * margin) * scale
        given = [mesh.id, wp.vec3(*(origin * scale)), spacing * scale, int(shape[1]), int(shape[2]), reach]
        wp.launch(_bake, len(value), given, [value], device="cpu")
        value = (value.numpy() / scale).reshape(shape)
        return {"value": value, **dataclasses.asdict(list_candidates(mesh, value, origin, spacing))}

    found = cached("grid", [vert, face, spacing, margin], baked)
    return DistanceGrid(found.pop("value"), origin, spacing, vert, face, Lists(**found))


def _mesh(vert, face, device) -> wp.Mesh:
    """In millimetres: single-precision queries drop triangles that are tiny in metres."""
    vert, face = (
        wp.array(vert * 1e3, dtype=wp.vec3, device=device),
        wp.array(face.ravel(), dtype=int, device=device),
    )
    # a query of few points waits for one node of the tree after the other: 23 us on an H100 where Warp's
    # choice for CUDA takes 35
    return wp.Mesh(vert, face, bvh_constructor="sah", bvh_leaf_size=1)


def pack_grids(grids: Sequence[DistanceGrid], device: wp.DeviceLike) -> tuple[Grids, list]:
    """The grids as one Warp struct, and the meshes, which must live as long as the struct does."""
    grids = list(grids)
    meshes = [_mesh(g.vert, g.face, device) for g in grids]
    packed = Grids()
    with wp.ScopedDevice(device):
        packed.mesh = wp.array([m.id for m in meshes], dtype=wp.uint64)
        packed.value = wp.array(
            np.concatenate([g.value.ravel() for g in grids] or [np.zeros(0)]), dtype=wp.float32
        )
        packed.first = wp.array(np.cumsum([0] + [g.value.size for g in grids[:-1]])[: len(grids)], dtype=int)
        packed.shape = wp.array(np.array([g.value.shape for g in grids]).reshape(-1, 3), dtype=wp.vec3i)
        packed.origin = wp.array(np.array([g.origin for g in grids]).reshape(-1, 3), dtype=vec3)
        packed.spacing = wp.array([g.spacing for g in grids], dtype=real)
        nface = [len(g.face) for g in grids]
        packed.first_face = wp.array(np.cumsum([0, *nface])[: len(grids)], dtype=int)
        normals = [_normals(g.vert, g.face).reshape(-1, 3) for g in grids]
        packed.normal = wp.array(np.concatenate([np.zeros((0, 3)), *normals]), dtype=wp.vec3)
        packed.candidates = pack_lists([g.lists for g in grids])
    return packed, meshes


def _normals(vert, face):
    """(nface, 6, 3) mean normals around the corners of each face, by angles, and along the edges opposite to
    them: these tell on which side a point is whose nearest place is there, however sharp that is (Baerentzen
    and Aanaes 2005). Zero where other than two faces meet at an edge."""
    # corners that faces do not share by number may be in one place all the same
    places, of_vert = np.unique(vert, axis=0, return_inverse=True)
    pairs = cKDTree(places).query_pairs(1e-8, output_type="ndarray")
    near = sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(places),) * 2)
    corner = connected_components(near, directed=False)[1][of_vert.reshape(-1)][face]
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


@wp.func
def grid_value(grids: Grids, k: int, p: vec3):
    """Trilinear; outside the grid, whose box holds the mesh, a lower bound of the distance (by the box's
    nearest point)."""
    n = grids.shape[k]
    top = vec3(real(n[0] - 1), real(n[1] - 1), real(n[2] - 1))
    asked = (p - grids.origin[k]) / grids.spacing[k]
    s = wp.min(wp.max(asked, vec3()), top)
    beyond = wp.length(asked - s) * grids.spacing[k]
    i = wp.clamp(int(s[0]), 0, n[0] - 2)
    j = wp.clamp(int(s[1]), 0, n[1] - 2)
    l = wp.clamp(int(s[2]), 0, n[2] - 2)
    a = s[0] - real(i)
    b = s[1] - real(j)
    c = s[2] - real(l)
    base = grids.first[k] + (i * n[1] + j) * n[2] + l
    row = n[2]
    slab = n[1] * n[2]
    one = real(1.0)
    v00 = real(grids.value[base]) * (one - c) + real(grids.value[base + 1]) * c
    v01 = real(grids.value[base + row]) * (one - c) + real(grids.value[base + row + 1]) * c
    v10 = real(grids.value[base + slab]) * (one - c) + real(grids.value[base + slab + 1]) * c
    v11 = real(grids.value[base + slab + row]) * (one - c) + real(grids.value[base + slab + row + 1]) * c
    value = (v00 * (one - b) + v01 * b) * (one - a) + (v10 * (one - b) + v11 * b) * a
    if beyond > real(0.0):  # the angle at the box's nearest point is at least a right one
        value = wp.sqrt(value * value + beyond * beyond)
    return value


# of what is linear between the corners of a cell, of a function of slope 1, in cells
TRILINEAR = wp.constant(real(0.5 * 3.0**0.5))


@wp.func
def mesh_distance(grids: Grids, k: int, p: vec3):
    """From the grid far from the surface, from the nearest triangle close to it: edges of the mesh stay
    sharp."""
    d = grid_value(grids, k, p)
    h = grids.spacing[k]
    if d > TRILINEAR * h:  # surely outside: no contact here
        return wp.vec4d(real(1.0), real(0.0), real(0.0), d)
    return mesh_field(grids, k, p, d)


@wp.func
def mesh_field(grids: Grids, k: int, p: vec3, d: real):
    """Unit gradient and value of the distance where the grid says d: from the nearest triangle close to the
    surface."""
    h = grids.spacing[k]
    if wp.abs(d) <= h:
        return to_triangles(grids, k, p, wp.abs(d) + h)
    n = vec3(
        grid_value(grids, k, p + vec3(h, real(0.0), real(0.0)))
        - grid_value(grids, k, p - vec3(h, real(0.0), real(0.0))),
        grid_value(grids, k, p + vec3(real(0.0), h, real(0.0)))
        - grid_value(grids, k, p - vec3(real(0.0), h, real(0.0))),
        grid_value(grids, k, p + vec3(real(0.0), real(0.0), h))
        - grid_value(grids, k, p - vec3(real(0.0), real(0.0), h)),
    )
    n = wp.normalize(n)
    return wp.vec4d(n[0], n[1], n[2], d)


@wp.func
def to_triangles(grids: Grids, k: int, p: vec3, within: real):
    """From the nearest triangle, which is within so far [m]; four cells if there is none."""
    h = grids.spacing[k]
    mesh = grids.mesh[k]
    q = real(1.0e3) * p
    face = nearest_candidate(grids.candidates, mesh, grids.first[k], grids.shape[k], grids.origin[k], h, p)
    if face < 0:
        query = wp.mesh_query_point_no_sign(mesh, single(q), wp.float32(real(1.0e3) * within))
        if not query.result:
            return wp.vec4d(real(1.0), real(0.0), real(0.0), real(4.0) * h)
        face = query.face
    t = triangle_of(mesh, face)
    at, place = nearest_place(t, q)
    away = q - at
    d = wp.length(away)
    a = double(t.a)
    n = wp.normalize(wp.cross(double(t.b) - a, double(t.c) - a))
    if place == 6:
        d = wp.dot(q - a, n)
    else:
        side = wp.dot(away, double(grids.normal[6 * (grids.first_face[k] + face) + place]))
        if side == real(0.0):  # normals do not tell: rays do
            side = real(wp.mesh_query_point(mesh, single(q), wp.float32(real(1.0e3) * within)).sign)
        side = wp.sign(side)
        if d > real(1.0e-5):
            n = side * away / d
        d = side * d
    return wp.vec4d(n[0], n[1], n[2], d * real(1.0e-3))
