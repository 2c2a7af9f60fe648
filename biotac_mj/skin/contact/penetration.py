"""Penetration checks: geoms in the rigid core, inner faces in the core, start poses of geoms whose path is
not known, and clearances of geoms from the core."""

import warp as wp

from ..block import block_max
from ..types import mat33, real, vec3
from .broadphase import ALL, has
from .meshes import DISTANCES, TRILINEAR, grid_value
from .posed import SKIN, Geoms, LoadPath, bound_to, distance_from, place_on
from .shapes import distance, rough_bound

_ROUNDS = 4  # steps out of the skin: the distance from a mesh outside its grid is only a lower bound


@wp.kernel(module=DISTANCES)
def rest_gap(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    gap_out: wp.array(dtype=real),
):
    """Distance of sample s of face f from the first geom [m]."""
    f, s = wp.tid()
    t = face[f]
    b = sample[s]
    p = b[0] * x[t[0], 0] + b[1] * x[t[1], 0] + b[2] * x[t[2], 0]
    dn = distance(geoms.kind[0], geoms.size[0], geoms.rounding[0], geoms.grids, geoms.grid[0], p)
    gap_out[f * sample.shape[0] + s] = dn[3]


@wp.kernel(module=DISTANCES)
def mark_crushed(
    # In:
    limit: real,
    node: wp.array(dtype=int),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # Out:
    failed_out: wp.array(dtype=int),
):
    """Marks a world with a node of the inner surface deeper in the core than `limit` [m]."""
    n, w = wp.tid()
    if on[w] == 0:
        return
    y = wp.transpose(core.mat[0, w]) * (x[node[n], w] - core.pos[0, w])
    if rough_bound(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], y) < -limit:
        dn = distance(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], y)
        if dn[3] < -limit:
            failed_out[w] = 1


@wp.func
def core_clearance(
    i: int, geoms: Geoms, g: int, pos: vec3, mat: mat33, core: Geoms, core_vert: wp.array(dtype=vec3)
):
    """Lower bound of the distance between geom g at pos, mat and point i of the core [m], negative where they
    overlap. The points are the core's vertices and, last, the geom's centre, for geoms between vertices."""
    n = core_vert.shape[0]
    p = pos
    if i < n:
        p = core_vert[i]
    bound = bound_to(geoms, g, p, wp.transpose(mat) * (p - pos))
    if i == n:
        if bound < real(0.0):
            k = core.grid[0]  # the core is a mesh
            bound = grid_value(core.grids, k, pos) - TRILINEAR * core.grids.spacing[k]
        else:  # a ring, which may lie around the core
            bound = real(1.0)
    return bound


@wp.func
def geoms_core_clearance(
    w: int, t: int, threads: int, geoms: Geoms, near: wp.int64, core: Geoms, core_vert: wp.array(dtype=vec3)
):
    """Least `core_clearance` of a set of geoms over all points of the core [m], by the threads of a block;
    infinite where there is no core."""
    least = real(wp.inf)
    points = wp.where(core_vert.shape[0] > 0, core_vert.shape[0] + 1, 0)
    for g in range(geoms.count):
        p = vec3()
        room = real(0.0)  # points this near to p cannot be the nearest
        for i in range(t, wp.where(has(near, g), points, 0), threads):
            if i < core_vert.shape[0]:
                # a trilinear distance changes by up to the root of three times as much as the place
                if real(3.0) * wp.length_sq(core_vert[i] - p) < room * wp.abs(room):
                    continue
                p = core_vert[i]
            at = core_clearance(i, geoms, g, geoms.pos[g, w], geoms.mat[g, w], core, core_vert)
            least = wp.min(least, at)
            room = at - least
    return -block_max(-least)


@wp.kernel(module=DISTANCES)
def mark_deep_geoms(
    # In:
    chunk: int,
    limit: real,
    core_vert: wp.array(dtype=vec3),
    center: vec3,
    radius: real,
    core: Geoms,
    geoms: Geoms,
    # In and out:
    active: wp.array(dtype=int),
    # Out:
    failed_out: wp.array(dtype=int),
    deep_out: wp.array(dtype=int),
):
    """Marks a world as failed and deep if geom g is deeper in the rigid core than `limit` [m], since no skin
    fits between them. center, radius: of a ball around the core."""
    g, c, w = wp.tid()
    if active[w] == 0:
        return
    if bound_to(geoms, g, center, place_on(geoms, g, w, center)) > radius:
        return
    for i in range(c * chunk, wp.min((c + 1) * chunk, core_vert.shape[0] + 1)):
        if core_clearance(i, geoms, g, geoms.pos[g, w], geoms.mat[g, w], core, core_vert) < -limit:
            active[w] = 0
            failed_out[w] = 1
            deep_out[w] = 1


@wp.func
def _outside(geoms: Geoms, g: int, center: vec3, radius: real, pos: vec3, mat: mat33):
    """Position of a geom at pos, mat after it is moved out of a ball along its distance's gradient [m]."""
    p = pos
    rounds = int(_ROUNDS)  # a variable, since the module takes a minute to compile for CUDA if unrolled
    for _round in range(rounds):
        dn = distance_from(geoms, g, center, wp.transpose(mat) * (center - p), mat)
        overlap = wp.max(radius - dn[3], real(0.0))
        if geoms.kind[g] == SKIN:  # the surface between two skins moves half as far
            overlap *= real(2.0)
        p -= overlap * (mat * vec3(dn[0], dn[1], dn[2]))
    return p


@wp.kernel(module=DISTANCES)
def start_path_outside(
    # In:
    center: vec3,
    radius: real,
    geoms: Geoms,
    on: wp.array(dtype=int),
    # In and out:
    path: LoadPath,
):
    """Starts the path of geoms without a previous pose, or of geoms that all stand still, where a ball around
    the skin is clear of them."""
    w = wp.tid()
    if on[w] == 0:
        return
    unmoved = int(1)
    for g in range(geoms.count):
        p = path.pos_start[g, w]
        R = path.mat_start[g, w] - path.mat_end[g, w]
        if wp.length_sq(p - path.pos_end[g, w]) + wp.ddot(R, R) > real(0.0):
            unmoved = 0
    for g in range(geoms.count):
        p = path.pos_start[g, w]
        if unmoved == 1 or not wp.isfinite(p[0] + p[1] + p[2]):
            R = path.mat_end[g, w]
            p = _outside(geoms, g, center, radius, path.pos_end[g, w], R)
            path.pos_start[g, w] = p
            path.mat_start[g, w] = R


@wp.kernel(module=DISTANCES)
def measure_core(
    # In:
    core_vert: wp.array(dtype=vec3),
    core: Geoms,
    geoms: Geoms,
    # Out:
    clearance_out: wp.array(dtype=real),
):
    """Clearance of the geoms of world 0 from the core [m]."""
    clearance_out[0] = geoms_core_clearance(0, 0, 1, geoms, ALL, core, core_vert)
