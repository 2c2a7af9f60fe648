"""Penetration: geoms inside the rigid core, inner faces inside it, and geoms whose path is not known."""

import warp as wp

from ..types import mat33, real, vec3
from .meshes import TRILINEAR, grid_value
from .posed import SKIN, Geoms, LoadPath, bound_to, distance_from
from .shapes import distance, rough_bound

__all__ = [
    "come_from_outside",
    "core_clearance",
    "mark_crushed",
    "start_path_outside",
    "mark_deep_geoms",
    "rest_gap",
]

wp.set_module_options({"enable_backward": False})

_ROUNDS = 4  # distances of meshes from afar are lower bounds along their grid's box


# in a module of its own: it is needed first, while the others compile
@wp.kernel(module=f"{__name__}.rest_gap", enable_backward=False)
def rest_gap(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    gap_out: wp.array(dtype=real),
):
    """Distance of every sample to the first geom."""
    f, s = wp.tid()
    t = face[f]
    b = sample[s]
    p = b[0] * x[t[0], 0] + b[1] * x[t[1], 0] + b[2] * x[t[2], 0]
    dn = distance(geoms.kind[0], geoms.size[0], geoms.rounding[0], geoms.grids, geoms.grid[0], p)
    gap_out[f * sample.shape[0] + s] = dn[3]


@wp.kernel
def mark_crushed(
    # In:
    limit: real,
    node: wp.array(dtype=int),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    asked: wp.array(dtype=int),
    # Out:
    failed_out: wp.array(dtype=int),
):
    """Marks worlds with a node of the inner surface deeper in the core than the limit: on its way through."""
    n, w = wp.tid()
    if asked[w] == 0:
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
    """Lower bound of the distance [m] between geom g at pos, mat and point i of the core, negative where they
    overlap. The points are the core's vertices; the last is the geom's own centre, which finds a geom that
    lies between them."""
    n = core_vert.shape[0]
    p = pos
    if i < n:
        p = core_vert[i]
    bound = bound_to(geoms, g, p, wp.transpose(mat) * (p - pos))
    if i == n:
        if bound < real(0.0):
            k = core.grid[0]  # it is a mesh
            bound = grid_value(core.grids, k, pos) - TRILINEAR * core.grids.spacing[k]
        else:  # a ring, which may lie around the core
            bound = real(1.0)
    return bound


@wp.kernel
def mark_deep_geoms(
    # In:
    chunk: int,
    limit: real,
    core_vert: wp.array(dtype=vec3),
    core: Geoms,
    geoms: Geoms,
    # In and out:
    active: wp.array(dtype=int),
    # Out:
    failed_out: wp.array(dtype=int),
    deep_out: wp.array(dtype=int),
):
    """Worlds in which a geom reaches deeper into the rigid core than the limit fail: no skin fits between
    them."""
    g, c, w = wp.tid()
    if active[w] == 0:
        return
    for i in range(c * chunk, wp.min((c + 1) * chunk, core_vert.shape[0] + 1)):
        if core_clearance(i, geoms, g, geoms.pos[g, w], geoms.mat[g, w], core, core_vert) < -limit:
            active[w] = 0
            failed_out[w] = 1
            deep_out[w] = 1


@wp.func
def _outside(geoms: Geoms, g: int, center: vec3, radius: real, pos: vec3, mat: mat33):
    """Where a geom at pos, mat comes from if it comes from outside: clear of a ball."""
    p = pos
    rounds = int(_ROUNDS)  # a variable: unrolled, the module takes a minute to compile for CUDA
    for _round in range(rounds):
        dn = distance_from(geoms, g, center, wp.transpose(mat) * (center - p), mat)
        left = wp.max(radius - dn[3], real(0.0))
        if geoms.kind[g] == SKIN:  # where two meet goes half as far
            left *= real(2.0)
        p -= left * (mat * vec3(dn[0], dn[1], dn[2]))
    return p


@wp.kernel
def start_path_outside(
    # In:
    center: vec3,
    radius: real,
    geoms: Geoms,
    asked: wp.array(dtype=int),
    # In and out:
    path: LoadPath,
):
    """Where nothing is known of how geoms came to where they are, they come from outside: their way starts
    where the ball around the skin is clear of them."""
    w = wp.tid()
    if asked[w] == 0:
        return
    still = int(1)
    for g in range(geoms.count):
        p = path.pos_start[g, w]
        R = path.mat_start[g, w] - path.mat_end[g, w]
        if wp.length_sq(p - path.pos_end[g, w]) + wp.ddot(R, R) > real(0.0):
            still = 0
    for g in range(geoms.count):
        p = path.pos_start[g, w]
        if still == 1 or not wp.isfinite(p[0] + p[1] + p[2]):
            R = path.mat_end[g, w]
            p = _outside(geoms, g, center, radius, path.pos_end[g, w], R)
            path.pos_start[g, w] = p
            path.mat_start[g, w] = R


@wp.kernel
def come_from_outside(
    # In:
    center: vec3,
    radius: real,
    geoms: Geoms,
    # Out:
    pos_out: wp.array2d(dtype=vec3),
):
    """Where geoms of which nothing is known come from."""
    g, w = wp.tid()
    last = geoms.pos_last[g, w]
    if not wp.isfinite(last[0] + last[1] + last[2]):
        pos_out[g, w] = _outside(geoms, g, center, radius, geoms.pos[g, w], geoms.mat[g, w])
