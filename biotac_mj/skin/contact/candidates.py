"""Which triangles of a mesh can be the nearest to a point in a cell of its distance grid.

A query of a tree of boxes waits for one node after the other. Close to a surface few triangles come into
question, and a list of them for each cell there is read at once. A triangle that is farther from the cell's
centre than the nearest one, by more than the cell's diagonal, is the nearest to no point of the cell: so the
lists lack none.
"""

import dataclasses

import numpy as np
import warp as wp

from ..types import double, real, vec3

__all__ = [
    "Candidates",
    "Lists",
    "Triangle",
    "list_candidates",
    "nearest_candidate",
    "nearest_place",
    "pack_lists",
    "triangle_of",
]

wp.set_module_options({"enable_backward": False})

_MOST = 48  # triangles of a cell; where there are more the tree is faster
_DIAGONAL = wp.constant(real(3.0**0.5))  # of a cell
_SLACK = wp.constant(real(1e-4))  # [mm] more than single precision rounds


@wp.struct
class Candidates:
    """Of all cells of all grids, which are numbered as the values at their first corners."""

    of_cell: wp.array(dtype=int)  # number of the cell's list, or -1
    begin: wp.array(dtype=int)  # of each list, and where the last one ends
    face: wp.array(dtype=int)  # the nearest first
    away: wp.array(dtype=float)  # from the cell's centre [mm]


@dataclasses.dataclass(frozen=True)
class Lists:
    """The same of one grid: of_cell (nvalue,), count (nlist,), face, away (nentry,)."""

    of_cell: np.ndarray
    count: np.ndarray
    face: np.ndarray
    away: np.ndarray


@wp.struct
class Triangle:
    """Corners [mm]."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3


@wp.func
def triangle_of(mesh: wp.uint64, face: int):
    found = Triangle()
    found.a = wp.mesh_get_point(mesh, 3 * face)
    found.b = wp.mesh_get_point(mesh, 3 * face + 1)
    found.c = wp.mesh_get_point(mesh, 3 * face + 2)
    return found


@wp.func
def nearest_place(t: Triangle, q: vec3):
    """The point of a triangle that is the nearest to q [mm], and where that is: a corner (0 to 2), the edge
    opposite to one (3 to 5), between them (6). After Ericson 2004, 5.1.5; in double precision, as of long
    triangles single finds the wrong one."""
    a = double(t.a)
    ab = double(t.b) - a
    ac = double(t.c) - a
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
    return a + (vb * ab + vc * ac) / (va + vb + vc), 6


@wp.func
def _away(t: Triangle, q: vec3):
    at, _place = nearest_place(t, q)
    return wp.length(q - at)


@wp.func
def nearest_candidate(
    candidates: Candidates, mesh: wp.uint64, first: int, shape: wp.vec3i, origin: vec3, spacing: real, p: vec3
):
    """The face that is the nearest to p, or -1 where its cell has no list. first, shape, origin, spacing: of
    the grid."""
    found = int(-1)
    s = (p - origin) / spacing
    i = int(wp.floor(s[0]))
    j = int(wp.floor(s[1]))
    k = int(wp.floor(s[2]))
    if i < 0 or j < 0 or k < 0 or i > shape[0] - 2 or j > shape[1] - 2 or k > shape[2] - 2:
        return found
    cell = candidates.of_cell[first + (i * shape[1] + j) * shape[2] + k]
    if cell < 0:
        return found
    half = real(0.5)
    center = origin + spacing * vec3(real(i) + half, real(j) + half, real(k) + half)
    off = real(1.0e3) * wp.length(p - center)
    q = real(1.0e3) * p
    best = real(wp.inf)
    end = candidates.begin[cell + 1]
    for n in range(candidates.begin[cell], end, 3):
        if real(candidates.away[n]) - off > best + _SLACK:  # and so are all that follow
            break
        # read together: what is read after a branch waits for it
        face = wp.vec3i(
            candidates.face[n],
            candidates.face[wp.min(n + 1, end - 1)],
            candidates.face[wp.min(n + 2, end - 1)],
        )
        t0 = triangle_of(mesh, face[0])
        t1 = triangle_of(mesh, face[1])
        t2 = triangle_of(mesh, face[2])
        away = vec3(_away(t0, q), _away(t1, q), _away(t2, q))
        m = int(wp.argmin(away))
        if away[m] < best:
            best = away[m]
            found = face[m]
    return found


@wp.kernel
def _find(
    # In:
    mesh: wp.uint64,
    origin: wp.vec3,
    spacing: float,
    reach: float,
    cell: wp.array(dtype=wp.vec3i),
    begin: wp.array(dtype=int),
    # Out:
    count_out: wp.array(dtype=int),
    face_out: wp.array(dtype=int),
    away_out: wp.array(dtype=float),
):
    """Counts, or lists where the lists have room; more than _MOST count as none."""
    i = wp.tid()
    at = cell[i]
    center = origin + spacing * wp.vec3(float(at[0]) + 0.5, float(at[1]) + 0.5, float(at[2]) + 0.5)
    q = double(center)
    nearest = _away(triangle_of(mesh, wp.mesh_query_point_no_sign(mesh, center, reach).face), q)
    within = nearest + _DIAGONAL * real(spacing) + _SLACK
    box = float(within) * wp.vec3(1.0, 1.0, 1.0)
    query = wp.mesh_query_aabb(mesh, center - box, center + box)
    face = int(0)
    n = int(0)
    while n <= wp.static(_MOST) and wp.mesh_query_aabb_next(query, face):
        away = _away(triangle_of(mesh, face), q)
        if away <= within:
            if face_out.shape[0] > 0 and n < count_out[i]:
                face_out[begin[i] + n] = face
                away_out[begin[i] + n] = float(away)
            n += 1
    if face_out.shape[0] == 0:
        count_out[i] = wp.where(n > wp.static(_MOST), 0, n)


def list_candidates(mesh: wp.Mesh, value: np.ndarray, origin: np.ndarray, spacing: float) -> Lists:
    """Lists of the cells through which the surface may go, or to which it is close.

    Args:
      mesh: in millimetres, on the CPU.
      value: (nx, ny, nz) signed distances [m]. origin, spacing: of the grid [m].
    """
    low, high = value[:-1, :-1, :-1].copy(), value[:-1, :-1, :-1].copy()
    for corner in np.ndindex(2, 2, 2):
        there = value[tuple(slice(c, n - 1 + c) for c, n in zip(corner, value.shape))]
        np.minimum(low, there, out=low)
        np.maximum(high, there, out=high)
    cell = np.argwhere((low <= spacing) & (high >= -spacing))
    with wp.ScopedDevice("cpu"):
        reach = 1e3 * float(np.abs(value).max() + 4 * spacing)
        given = [mesh.id, wp.vec3(*(1e3 * origin)), 1e3 * spacing, reach, wp.array(cell, dtype=wp.vec3i)]
        none, count = wp.zeros(0, dtype=int), wp.zeros(len(cell), dtype=int)
        wp.launch(_find, len(cell), [*given, none], [count, none, wp.zeros(0, dtype=float)])
        counted = count.numpy()
        begin = np.concatenate([[0], np.cumsum(counted)])
        face, away = wp.zeros(int(begin[-1]), dtype=int), wp.zeros(int(begin[-1]), dtype=float)
        if begin[-1]:
            wp.launch(_find, len(cell), [*given, wp.array(begin, dtype=int)], [count, face, away])
    order = np.lexsort((face.numpy(), away.numpy(), np.repeat(np.arange(len(cell)), counted)))
    of_cell = np.full(value.shape, -1, np.int32)
    listed = cell[counted > 0]
    of_cell[tuple(listed.T)] = np.arange(len(listed))
    return Lists(of_cell.ravel(), counted[counted > 0], face.numpy()[order], away.numpy()[order])


def pack_lists(lists: list[Lists]) -> Candidates:
    """Of several grids, one after another, on Warp's present device."""
    none = Lists(*(np.zeros(0, np.int32) for _ in range(4)))
    packed, lists = Candidates(), lists or [none]
    before = np.cumsum([0, *(len(one.count) for one in lists)])
    of_cell = [np.where(one.of_cell < 0, -1, one.of_cell + n) for one, n in zip(lists, before)]
    count = np.concatenate([one.count for one in lists])
    packed.of_cell = wp.array(np.concatenate(of_cell), dtype=int)
    packed.begin = wp.array(np.concatenate([[0], np.cumsum(count)]), dtype=int)
    packed.face = wp.array(np.concatenate([one.face for one in lists]), dtype=int)
    packed.away = wp.array(np.concatenate([one.away for one in lists]), dtype=float)
    return packed
