"""Signed distance to MuJoCo's geoms, in Warp: sphere, capsule, cylinder, ellipsoid, box, plane and meshes as
distance grids.

A `rounding` radius r shrinks a box or a cylinder by r and grows it again by r: its edges become fillets of
radius r, its faces stay."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ...geometry.solid import bounds_solid
from ..types import real, vec3

__all__ = [
    "GEOM_TYPES",
    "DistanceGrid",
    "Grids",
    "bake_distance_grid",
    "distance",
    "distance_bound",
    "grid_value",
    "lower_bound",
    "pack_grids",
    "primitive_distance",
    "rough_bound",
]

wp.set_module_options({"enable_backward": False})


# MuJoCo's mjtGeom
GEOM_TYPES = {"plane": 0, "sphere": 2, "capsule": 3, "ellipsoid": 4, "cylinder": 5, "box": 6, "mesh": 7}


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
    smooth: wp.array(dtype=int)  # of all faces: 1 where the mesh hardly turns at any of its corners


@dataclasses.dataclass(frozen=True)
class DistanceGrid:
    """Signed distance of a closed mesh on a regular grid.

    Attributes:
      value: (nx, ny, nz) float32, negative inside [m].
      origin: (3,) position of value[0, 0, 0] [m].
      spacing: of the grid, the same along the three axes [m].
      vert, face: (n, 3) [m], (m, 3) the mesh: within a few cells of its surface the distance is computed from
        the triangles.
    """

    value: np.ndarray
    origin: np.ndarray
    spacing: float
    vert: np.ndarray
    face: np.ndarray


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
    """Distance grid of a closed triangle mesh.

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
    mesh = _mesh(vert, face, "cpu")
    scale = 1e3
    shape = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
    origin = low - margin
    value = wp.zeros(int(shape.prod()), dtype=wp.float32, device="cpu")
    reach = float(np.linalg.norm(high - low) + 4 * margin) * scale
    wp.launch(
        _bake,
        dim=len(value),
        inputs=[mesh.id, wp.vec3(*(origin * scale)), spacing * scale, int(shape[1]), int(shape[2]), reach],
        outputs=[value],
        device="cpu",
    )
    return DistanceGrid((value.numpy() / scale).reshape(shape), origin, spacing, vert, face)


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
        smooth = [_smooth(g.vert, g.face) for g in grids]
        packed.smooth = wp.array(np.concatenate(smooth or [np.zeros(0)]), dtype=int)
    return packed, meshes


def _smooth(vert, face):
    """Of each face whether the normals around each of its corners are within 13 degrees of their mean, so
    within 26 degrees of each other."""
    normal = np.cross(vert[face[:, 1]] - vert[face[:, 0]], vert[face[:, 2]] - vert[face[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # corners that faces do not share by number may be in one place all the same
    places, of_vert = np.unique(vert, axis=0, return_inverse=True)
    pairs = cKDTree(places).query_pairs(1e-8, output_type="ndarray")
    near = sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(places),) * 2)
    face = connected_components(near, directed=False)[1][of_vert.reshape(-1)][face]
    mean, least = np.zeros((len(vert), 3)), np.ones(len(vert))
    np.add.at(mean, face.ravel(), np.repeat(normal, 3, axis=0))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    np.minimum.at(least, face.ravel(), (mean[face] * normal[:, None]).sum(-1).ravel())
    return (least[face] > np.cos(np.radians(13.0))).all(1)


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


# [m] cells that a bound may err by; distances that matter to who asks for one
_COARSE, _NEAR = (wp.constant(real(2.5e-4)), wp.constant(real(5e-3)))
# of what is linear between the corners of a cell, of a function of slope 1, in cells
_TRILINEAR = wp.constant(real(0.5 * 3.0**0.5))


@wp.func
def _mesh_distance(grids: Grids, k: int, p: vec3):
    """From the grid far from the surface, from the nearest triangle close to it: edges of the mesh stay
    sharp."""
    d = grid_value(grids, k, p)
    h = grids.spacing[k]
    if d > _TRILINEAR * h:  # surely outside: no contact here
        return wp.vec4d(real(1.0), real(0.0), real(0.0), d)
    if d < -h:
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
    return _to_triangles(grids, k, p, wp.abs(d) + h)


@wp.func
def _to_triangles(grids: Grids, k: int, p: vec3, within: real):
    """From the nearest triangle, which is within so far [m]; four cells if there is none."""
    h = grids.spacing[k]
    mesh = grids.mesh[k]
    q = wp.vec3(
        wp.float32(p[0] * real(1.0e3)), wp.float32(p[1] * real(1.0e3)), wp.float32(p[2] * real(1.0e3))
    )
    query = wp.mesh_query_point_no_sign(mesh, q, wp.float32(real(1.0e3) * within))
    if not query.result:
        return wp.vec4d(real(1.0), real(0.0), real(0.0), real(4.0) * h)
    a = _double(wp.mesh_get_point(mesh, 3 * query.face))
    ab = _double(wp.mesh_get_point(mesh, 3 * query.face + 1)) - a
    ac = _double(wp.mesh_get_point(mesh, 3 * query.face + 2)) - a
    mm = real(1.0e3) * p
    u = real(query.u)
    v = real(query.v)
    w = real(1.0) - u - v
    n = wp.normalize(wp.cross(ab, ac))
    edge = real(1.0e-5)
    if wp.min(u, wp.min(v, w)) > edge:
        d = wp.dot(mm - a, n)  # over the inside of a face: its plane, exactly
    else:
        away = _from_edges(mm - a, ab, ac)
        d = wp.length(away)
        side = wp.dot(away, n)
        # around a smooth corner all normals agree with their angle-weighted mean about the side, and that is
        # right (Baerentzen and Aanaes 2005). Elsewhere rays tell: by normals around sharp corners a point out
        # there seems deep
        if grids.smooth[grids.first_face[k] + query.face] == 0 or wp.abs(side) < real(0.5) * d:
            side = real(wp.mesh_query_point(mesh, q, wp.float32(real(1.0e3) * within)).sign)
        side = wp.sign(side)
        if d > real(1.0e-5):
            n = side * away / d
        d = side * d
    return wp.vec4d(n[0], n[1], n[2], d * real(1.0e-3))


@wp.func
def _from_edges(p: vec3, ab: vec3, ac: vec3):
    """From the nearest point of a triangle's boundary to p, both seen from its first corner. The query knows
    that point in single precision, to a nanometre: close to an edge a normal of such points would jump."""
    away = _from_edge(p, ab)
    other = _from_edge(p, ac)
    if wp.dot(other, other) < wp.dot(away, away):
        away = other
    other = _from_edge(p - ab, ac - ab)
    if wp.dot(other, other) < wp.dot(away, away):
        away = other
    return away


@wp.func
def _from_edge(p: vec3, edge: vec3):
    along = wp.clamp(wp.dot(p, edge) / wp.dot(edge, edge), real(0.0), real(1.0))
    return p - along * edge


@wp.func
def _double(p: wp.vec3):
    return vec3(real(p[0]), real(p[1]), real(p[2]))


@wp.func
def _signs(p: vec3):
    s = vec3(real(1.0), real(1.0), real(1.0))
    for i in range(3):
        if p[i] < real(0.0):
            s[i] = real(-1.0)
    return s


@wp.func
def _rounded_box(half: vec3, r: real, p: vec3):
    q = wp.cw_mul(_signs(p), p) - (half - vec3(r, r, r))
    n = vec3()
    d = real(0.0)
    if wp.max(q) > real(0.0):
        out = wp.max(q, vec3())
        d = wp.length(out)
        n = out / d
    else:
        d = wp.max(q)
        axis = int(wp.argmax(q))
        n[axis] = real(1.0)
    n = wp.cw_mul(_signs(p), n)
    return wp.vec4d(n[0], n[1], n[2], d - r)


@wp.func
def _rounded_cylinder(radius: real, half: real, r: real, p: vec3):
    rho = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    e = vec3(real(1.0), real(0.0), real(0.0))
    if rho > real(0.0):
        e = vec3(p[0] / rho, p[1] / rho, real(0.0))
    side = wp.sign(p[2])
    a = rho - (radius - r)
    b = wp.abs(p[2]) - (half - r)
    n = vec3()
    d = real(0.0)
    if a > real(0.0) and b > real(0.0):
        d = wp.sqrt(a * a + b * b)
        n = (a * e + vec3(real(0.0), real(0.0), b * side)) / d
    elif a > b:
        d = a
        n = e
    else:
        d = b
        n = vec3(real(0.0), real(0.0), side)
    return wp.vec4d(n[0], n[1], n[2], d - r)


@wp.func
def _ellipsoid(radii: vec3, p: vec3):
    """Closest point p_i r_i^2 / (t + r_i^2), t the largest root of sum (r_i p_i / (t + r_i^2))^2 = 1
    (Eberly): Newton from the left."""
    q = wp.cw_mul(_signs(p), p) + vec3(real(1.0e-12), real(1.0e-12), real(1.0e-12))
    r2 = wp.cw_mul(radii, radii)
    t = wp.max(wp.cw_mul(radii, q) - r2)
    for _ in range(50):
        g = real(-1.0)
        dg = real(0.0)
        for i in range(3):
            s = radii[i] * q[i] / (t + r2[i])
            g += s * s
            dg -= real(2.0) * s * s / (t + r2[i])
        step = -g / dg
        t += step
        if wp.abs(step) < real(1.0e-14) * r2[0]:
            break
    c = vec3()
    n = vec3()
    for i in range(3):
        c[i] = r2[i] * q[i] / (t + r2[i])
        n[i] = c[i] / r2[i]
    d = wp.length(q - c)
    if t < real(0.0):
        d = -d
    n = wp.cw_mul(_signs(p), wp.normalize(n))
    return wp.vec4d(n[0], n[1], n[2], d)


@wp.func
def primitive_distance(kind: int, size: vec3, rounding: real, p: vec3):
    """`distance` of what is no mesh."""
    if kind == 0:
        return wp.vec4d(real(0.0), real(0.0), real(1.0), p[2])
    if kind == 2 or kind == 3:
        q = p
        if kind == 3:
            q = vec3(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1]))
        r = wp.length(q)
        n = vec3(real(0.0), real(0.0), real(1.0))
        if r > real(0.0):
            n = q / r
        return wp.vec4d(n[0], n[1], n[2], r - size[0])
    if kind == 4:
        return _ellipsoid(size, p)
    if kind == 5:
        return _rounded_cylinder(size[0], size[1], rounding, p)
    return _rounded_box(size, rounding, p)


@wp.func
def distance(kind: int, size: vec3, rounding: real, grids: Grids, grid: int, p: vec3):
    """Outward unit normal (x, y, z) and signed distance (w) [m] of point p in the geom's frame."""
    if kind == 7:
        return _mesh_distance(grids, grid, p)
    return primitive_distance(kind, size, rounding, p)


@wp.func
def lower_bound(kind: int, grids: Grids, grid: int, d: real):
    """The least that a `distance` d may be [m]: far from a mesh it is the grid's, which errs at sharp
    tips."""
    if kind == 7 and d > _TRILINEAR * grids.spacing[grid]:
        return d - _TRILINEAR * grids.spacing[grid]
    return d


@wp.func
def rough_bound(kind: int, size: vec3, rounding: real, grids: Grids, grid: int, p: vec3):
    """Lower bound of the distance [m] that asks no mesh: of one, by its grid alone."""
    if kind == 7:
        return grid_value(grids, grid, p) - _TRILINEAR * grids.spacing[grid]
    return distance(kind, size, rounding, grids, grid, p)[3]


@wp.func
def distance_bound(kind: int, size: vec3, rounding: real, grids: Grids, grid: int, p: vec3):
    """Lower bound of the distance [m], cheap where that is far: what is surely not nearer needs no exact
    distance."""
    bound = rough_bound(kind, size, rounding, grids, grid, p)
    if kind == 7:
        h = grids.spacing[grid]
        # a large mesh has large cells, and what is centimetres away is not near
        if h > _COARSE and bound < _NEAR and bound > -(real(1.0) + _TRILINEAR) * h:
            bound = wp.max(bound, _to_triangles(grids, grid, p, real(4.0) * h)[3])
    return bound
