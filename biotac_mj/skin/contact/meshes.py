"""Signed distance from closed triangle meshes, in Warp: far from the surface by a grid; close to it by the
nearest triangle or, if the mesh approximates a smooth surface, by a spline through the grid."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
import warp as wp
from scipy.ndimage import spline_filter

from ...cache import cached
from ...geometry.closest import (
    FACE,
    Lists,
    TriangleLists,
    closest_on_face,
    list_nearest,
    nearest_listed,
    pack_lists,
    pseudonormals,
)
from ...geometry.solid import no_solid
from ...kernels import kernel_module
from ..types import double, real, single, vec3

kernel_module(__name__)

# Warp module of all kernels that look for the distance of any shape, whose functions take most of the time to
# compile
DISTANCES = kernel_module(f"{__package__}.distances")

_MAX_TRIANGLES = 48  # in the list of a cell; the bounding volume hierarchy is faster for more


@wp.struct
class Grids:
    """Distance grids of all meshes, concatenated, and the meshes in millimetres."""

    mesh: wp.array(dtype=wp.uint64)
    value: wp.array(dtype=wp.float32)
    first: wp.array(dtype=int)
    shape: wp.array(dtype=wp.vec3i)
    origin: wp.array(dtype=vec3)
    spacing: wp.array(dtype=real)
    first_face: wp.array(dtype=int)
    corner: wp.array2d(dtype=wp.vec3)  # of each face [mm]
    normal: wp.array2d(dtype=wp.vec3)  # of each face, `closest.pseudonormals`
    of_cell: wp.array(dtype=int)  # index of a cell's list, or -1; a cell has the index of its first corner
    lists: TriangleLists
    coefficient: wp.array(dtype=wp.float32)  # of splines, see `DistanceGrid`
    spline: wp.array(dtype=int)  # where those of each grid begin; -1: its mesh has edges
    error: wp.array(dtype=real)  # of each spline [m]


@dataclasses.dataclass(frozen=True)
class DistanceGrid:
    """Signed distance of a closed mesh on a regular grid.

    Attributes:
      value: (nx, ny, nz) float32, negative inside [m].
      origin: (3,) position of value[0, 0, 0] [m].
      spacing: of the grid, equal along the three axes [m].
      vert, face: (n, 3) [m], (m, 3) the mesh; within a few cells of its surface the distance is computed from
        the triangles.
      of_cell: (nx, ny, nz) index of the cell's list of triangles that can be the nearest; -1: no list.
      lists: these lists.
      coefficient: (nx, ny, nz) float32, of the quadratic B-spline through the values [m], which is the
        distance near the surface; None: the triangles are.
      error: largest difference between spline and mesh near the surface [m].
    """

    value: np.ndarray
    origin: np.ndarray
    spacing: float
    vert: np.ndarray
    face: np.ndarray
    of_cell: np.ndarray
    lists: Lists
    coefficient: np.ndarray | None = None
    error: float = 0.0

    @functools.cached_property
    def facet_width(self) -> float:
        """Median width of the two facets at edges of 1 to 25 degrees, across the edge [m]; 0 without such
        edges."""
        from ...triangles import trimesh

        mesh = trimesh.Trimesh(self.vert, self.face, process=False)
        turn = mesh.face_adjacency_angles
        shallow = (turn > np.radians(1)) & (turn < np.radians(25))
        if not shallow.any():
            return 0.0
        a, b = self.vert[mesh.face_adjacency_edges[shallow].T]
        across = mesh.area_faces[mesh.face_adjacency[shallow]].sum(axis=1) / np.linalg.norm(b - a, axis=1)
        return float(np.median(across))


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
    vert: np.ndarray,
    face: np.ndarray,
    cells: int = 64,
    margin: float = 2e-3,
    spacing: float | None = None,
    smooth: bool = False,
) -> DistanceGrid:
    """Distance grid of a closed triangle mesh. It takes seconds, once: grids are cached on disk.

    Args:
      vert: (n, 3) [m].
      face: (m, 3), outward orientation.
      cells: grid cells along the longest side of the mesh, and at most twice as many with the margins.
      margin: width of the grid beyond the mesh [m].
      spacing: of the grid [m], instead of `cells`.
      smooth: whether the mesh approximates a surface without edges. Its distance is then a spline with a
        continuous normal, so that the energy of contact has no kinks, each of which may separate two
        equilibria.

    Raises:
      ValueError: the mesh bounds no solid.
    """
    vert, face = np.asarray(vert, float), np.asarray(face, np.int32)
    wrong = no_solid(vert, face)
    if wrong is not None:
        raise ValueError(f"the mesh {wrong}")
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
        return {"value": value, **_list_cells(mesh, value, origin, spacing)}

    found = cached("grid", [vert, face, spacing, margin], baked)
    lists = Lists(found["count"], found["face"], found["away"], reach=np.zeros(0, np.float32))
    grid = DistanceGrid(found["value"], origin, spacing, vert, face, found["of_cell"], lists)
    if not smooth:
        return grid
    spline = cached("spline", [vert, face, spacing, margin], lambda: _spline_of(grid))
    return dataclasses.replace(grid, coefficient=spline["coefficient"], error=float(spline["error"]))


def _spline_of(grid):
    """The spline through a grid's values, and its largest error against the mesh at eight points of each cell
    within `NEAR_SURFACE`."""
    coefficient = spline_filter(grid.value, order=2, mode="mirror").astype(np.float32)
    packed = [pack_grids([g], "cpu") for g in (grid, dataclasses.replace(grid, coefficient=coefficient))]
    # the first corner of a cell may be further away by the length of the diagonal
    cell = np.argwhere(abs(grid.value[:-1, :-1, :-1]) <= (float(NEAR_SURFACE) + 3**0.5) * grid.spacing)
    middle = (np.indices((2, 2, 2)).reshape(3, -1).T + 0.5) / 2
    point = grid.origin + grid.spacing * (cell[:, None] + middle).reshape(-1, 3)
    error = wp.zeros(len(point), dtype=real, device="cpu")
    given = [*(grids for grids, _mesh in packed), wp.array(point, dtype=vec3, device="cpu")]
    wp.launch(_compare, len(point), given, [error], device="cpu")
    return {"coefficient": coefficient, "error": error.numpy().max(initial=0.0)}


@wp.kernel(module=DISTANCES)
def _compare(sharp: Grids, smooth: Grids, point: wp.array(dtype=vec3), error_out: wp.array(dtype=real)):
    """Difference of both kinds of distance at point i, near the surface [m]."""
    i = wp.tid()
    far = wp.abs(grid_value(sharp, 0, point[i]))
    if far <= NEAR_SURFACE * sharp.spacing[0]:
        spline = spline_field(smooth, 0, point[i])[3]
        within = far + real(2.0) * sharp.spacing[0]
        error_out[i] = wp.abs(spline - to_triangles(sharp, 0, point[i], within)[3])


def _list_cells(mesh, value, origin, spacing):
    """Lists of triangles for the cells (nx, ny, nz) near the surface, valid for all points of a cell: a
    triangle that is further from the cell's centre than the nearest one, by more than the diagonal, is the
    nearest to no point of the cell."""
    low, high = value[:-1, :-1, :-1].copy(), value[:-1, :-1, :-1].copy()
    for corner in np.ndindex(2, 2, 2):
        there = value[tuple(slice(c, n - 1 + c) for c, n in zip(corner, value.shape))]
        np.minimum(low, there, out=low)
        np.maximum(high, there, out=high)
    cell = np.argwhere((low <= spacing) & (high >= -spacing))
    lists = list_nearest(
        mesh, 1e3 * (origin + spacing * (cell + 0.5)), 3**0.5 * 1e3 * spacing, _MAX_TRIANGLES
    )
    listed = lists.count > 0
    of_cell = np.full(value.shape, -1, np.int32)
    of_cell[tuple(cell[listed].T)] = np.arange(listed.sum())
    found = {"count": lists.count[listed], "face": lists.face, "away": lists.away}
    return {"of_cell": of_cell.ravel(), **found}


def _mesh(vert, face, device) -> wp.Mesh:
    """Warp mesh in millimetres: queries in single precision lose triangles that are tiny in metres."""
    vert, face = (
        wp.array(vert * 1e3, dtype=wp.vec3, device=device),
        wp.array(face.ravel(), dtype=int, device=device),
    )
    # a query of few points reads the nodes of the tree one after the other: 23 us on an H100, 35 us with
    # Warp's default for CUDA
    return wp.Mesh(vert, face, bvh_constructor="sah", bvh_leaf_size=1)


def pack_grids(grids: Sequence[DistanceGrid], device: wp.DeviceLike) -> tuple[Grids, list]:
    """The grids as one Warp struct, and the meshes, which must live as long as the struct."""
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
        corners = [1e3 * g.vert[g.face] for g in grids]
        packed.corner = wp.array(np.concatenate([np.zeros((0, 3, 3)), *corners]), dtype=wp.vec3, ndim=2)
        normals = [pseudonormals(g.vert, g.face) for g in grids]
        packed.normal = wp.array(np.concatenate([np.zeros((0, 6, 3)), *normals]), dtype=wp.vec3, ndim=2)
        before = np.cumsum([0, *(len(g.lists.count) for g in grids)])
        cells = [np.where(g.of_cell < 0, -1, g.of_cell + n) for g, n in zip(grids, before)]
        packed.of_cell = wp.array(np.concatenate([np.zeros(0, int), *cells]), dtype=int)
        packed.lists = pack_lists([g.lists for g in grids])
        splines = [np.zeros(0) if g.coefficient is None else g.coefficient.ravel() for g in grids]
        packed.coefficient = wp.array(np.concatenate([np.zeros(0), *splines]), dtype=wp.float32)
        begins = np.cumsum([0, *map(len, splines)])
        packed.spline = wp.array([n if len(s) else -1 for n, s in zip(begins, splines)], dtype=int)
        packed.error = wp.array([g.error for g in grids], dtype=real)
    return packed, meshes


@wp.func
def grid_value(grids: Grids, k: int, p: vec3):
    """Distance by trilinear interpolation [m]; outside the grid's box, which contains the mesh, a lower bound
    from the nearest point of the box."""
    n = grids.shape[k]
    top = vec3(real(n[0] - 1), real(n[1] - 1), real(n[2] - 1))
    scaled = (p - grids.origin[k]) / grids.spacing[k]
    s = wp.min(wp.max(scaled, vec3()), top)
    beyond = wp.length(scaled - s) * grids.spacing[k]
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
    if beyond > real(0.0):  # the angle at the nearest point of the box is at least 90 degrees
        value = wp.sqrt(value * value + beyond * beyond)
    return value


NEAR_SURFACE = wp.constant(real(2.0))  # distance in cells within which the error of a spline is known

# error bound of trilinear interpolation of a function with slope 1, in cells
TRILINEAR = wp.constant(real(0.5 * 3.0**0.5))


@wp.func
def _spline_row(grids: Grids, at: int, value: vec3, slope: vec3):
    """Value and slope of a spline along one row of three coefficients from index `at`."""
    c = vec3(real(grids.coefficient[at]), real(grids.coefficient[at + 1]), real(grids.coefficient[at + 2]))
    return wp.vec2d(wp.dot(c, value), wp.dot(c, slope))


@wp.func
def _spline_weights(t: real):
    """Weights of the three quadratic B-splines around a point, t cells from the nearest centre."""
    low = real(0.5) - t
    high = real(0.5) + t
    return vec3(real(0.5) * low * low, real(0.75) - t * t, real(0.5) * high * high)


@wp.func
def _spline_slopes(t: real):
    return vec3(t - real(0.5), real(-2.0) * t, t + real(0.5))


@wp.func
def _spline_centre(grids: Grids, k: int, p: vec3):
    """Nearest spline centre with neighbours on all sides, and the point relative to it, in cells."""
    n = grids.shape[k]
    # outside the grid a lower bound, as in `grid_value`
    top = vec3(real(n[0] - 1), real(n[1] - 1), real(n[2] - 1))
    s = wp.min(wp.max((p - grids.origin[k]) / grids.spacing[k], vec3()), top)
    i = wp.vec3i()
    for a in range(3):
        i[a] = wp.clamp(int(wp.round(s[a])), 1, n[a] - 2)
    return i, s - vec3(real(i[0]), real(i[1]), real(i[2]))


@wp.func
def spline_field(grids: Grids, k: int, p: vec3):
    """Gradient and value of a smooth mesh's quadratic spline: both are continuous."""
    n = grids.shape[k]
    h = grids.spacing[k]
    i, t = _spline_centre(grids, k, p)
    x = _spline_weights(t[0])
    y = _spline_weights(t[1])
    z = _spline_weights(t[2])
    dx = _spline_slopes(t[0])
    dy = _spline_slopes(t[1])
    dz = _spline_slopes(t[2])
    first = grids.spline[k] + ((i[0] - 1) * n[1] + i[1] - 1) * n[2] + i[2] - 1
    gradient = vec3()
    value = real(0.0)
    for a in range(3):
        for b in range(3):
            row = _spline_row(grids, first + (a * n[1] + b) * n[2], z, dz)
            value += x[a] * y[b] * row[0]
            gradient += vec3(dx[a] * y[b] * row[0], x[a] * dy[b] * row[0], x[a] * y[b] * row[1])
    gradient = gradient / h
    return wp.vec4d(gradient[0], gradient[1], gradient[2], value)


@wp.func
def mesh_distance(grids: Grids, k: int, p: vec3):
    """Normal and distance: from the grid far from the surface; close to it from the nearest triangle, so that
    edges stay sharp, or from the spline of a smooth mesh, whose gradient may differ slightly from length
    1."""
    d = grid_value(grids, k, p)
    h = grids.spacing[k]
    if d > TRILINEAR * h:  # surely outside: no contact here
        return wp.vec4d(real(1.0), real(0.0), real(0.0), d)
    if grids.spline[k] >= 0:
        return spline_field(grids, k, p)
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
def smooth_distance(grids: Grids, k: int, p: vec3):
    """`mesh_distance` from a smooth mesh, without the code for triangles, which takes registers on CUDA."""
    d = grid_value(grids, k, p)
    if d > TRILINEAR * grids.spacing[k]:
        return wp.vec4d(real(1.0), real(0.0), real(0.0), d)
    return spline_field(grids, k, p)


@wp.func
def _listed(grids: Grids, k: int, p: vec3):
    """Index of the face closest to p, or -1 if the cell of p has no list."""
    shape = grids.shape[k]
    h = grids.spacing[k]
    s = (p - grids.origin[k]) / h
    i = int(wp.floor(s[0]))
    j = int(wp.floor(s[1]))
    l = int(wp.floor(s[2]))
    if i < 0 or j < 0 or l < 0 or i > shape[0] - 2 or j > shape[1] - 2 or l > shape[2] - 2:
        return -1
    cell = grids.of_cell[grids.first[k] + (i * shape[1] + j) * shape[2] + l]
    if cell < 0:
        return -1
    half = real(0.5)
    center = grids.origin[k] + h * vec3(real(i) + half, real(j) + half, real(l) + half)
    moved = real(1.0e3) * wp.length(p - center)
    return nearest_listed(grids.lists, cell, grids.corner, grids.first_face[k], real(1.0e3) * p, moved)


@wp.func(inline=False)  # long, with Warp's queries, and called from a dozen places of a kernel
def to_triangles(grids: Grids, k: int, p: vec3, within: real):
    """Normal and distance from the nearest triangle within `within` [m], or four cells if there is none."""
    h = grids.spacing[k]
    q = real(1.0e3) * p
    face = _listed(grids, k, p)
    if face < 0:
        query = wp.mesh_query_point_no_sign(grids.mesh[k], single(q), wp.float32(real(1.0e3) * within))
        if not query.result:
            return wp.vec4d(real(1.0), real(0.0), real(0.0), real(4.0) * h)
        face = query.face
    face += grids.first_face[k]
    at, place = closest_on_face(grids.corner, face, q)
    away = q - at
    d = wp.length(away)
    a = double(grids.corner[face, 0])
    n = wp.normalize(wp.cross(double(grids.corner[face, 1]) - a, double(grids.corner[face, 2]) - a))
    if place == FACE:
        d = wp.dot(q - a, n)
    else:
        side = wp.dot(away, double(grids.normal[face, place]))
        if side == real(0.0):  # normals do not decide: cast rays
            reach = wp.float32(real(1.0e3) * within)
            side = real(wp.mesh_query_point(grids.mesh[k], single(q), reach).sign)
        side = wp.sign(side)
        if d > real(1.0e-5):
            n = side * away / d
        d = side * d
    return wp.vec4d(n[0], n[1], n[2], d * real(1.0e-3))
