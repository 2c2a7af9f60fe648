"""Kernels of `skin.py`: where a step begins, and its outputs."""

import warp as wp

from ..skin.block import block_max, block_sum
from ..skin.contact.posed import Geoms, bound_to, distance_from
from ..skin.newton.worlds import Worlds
from ..skin.types import mat33, real, vec3, vec6

__all__ = [
    "begin_at_rest",
    "begin_frames",
    "come_from_outside",
    "find_bare",
    "forget_contacts",
    "forget_poses",
    "read_outputs",
    "scale_tangents",
]

wp.set_module_options({"enable_backward": False})

_ROUNDS = wp.constant(24)  # each takes the deepest point's depth off
_LEFT = wp.constant(wp.float64(1e-6))  # [m] of depth that will do


@wp.kernel
def read_outputs(
    # In:
    rest_pressure: wp.array(dtype=real),
    has_liquid: int,
    st: Worlds,
    wrench: wp.array3d(dtype=real),
    fraction: wp.array(dtype=real),
    # Out:
    pressure_out: wp.array(dtype=real),
    wrench_out: wp.array2d(dtype=vec6),
):
    """Pressure, and of the wrench on each group the share that this skin answers for."""
    w = wp.tid()
    if has_liquid == 1:
        pressure_out[w] = st.pressure[w] - rest_pressure[w]
    for g in range(wrench_out.shape[0]):
        v = vec6()
        for i in range(6):
            v[i] = fraction[g] * wrench[g, w, i]
        wrench_out[g, w] = v


@wp.kernel
def scale_tangents(
    fraction: wp.array(dtype=real), path: wp.array(dtype=real), tangent: wp.array2d(dtype=wp.spatial_matrixd)
):
    """Takes of tangents what this skin answers for, and how far what it meets goes with a group."""
    g, w = wp.tid()
    if path[g] != real(1.0):
        tangent[g, w] = fraction[g] * path[g] * tangent[g, w]


@wp.kernel
def begin_at_rest(
    # In:
    fresh: wp.array(dtype=int),
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    pos_end: wp.array(dtype=vec3),
    mat_end: wp.array(dtype=mat33),
    dt: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    velocity_out: wp.array2d(dtype=vec3),
):
    """Skins whose first step this is move with their core."""
    i, w = wp.tid()
    if fresh[w] == 1:
        velocity_out[i, w] = ((mat_end[w] - mat[w]) * x[i, w] + pos_end[w] - pos[w]) / dt[w]


@wp.kernel
def begin_frames(
    # In:
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    # Out:
    fresh_out: wp.array(dtype=int),
    pos_out: wp.array(dtype=vec3),
    mat_out: wp.array(dtype=mat33),
):
    w = wp.tid()
    fresh_out[w] = 0
    pos_out[w] = pos[w]
    mat_out[w] = mat[w]


@wp.kernel
def forget_poses(
    # In:
    placed: wp.array2d(dtype=int),
    began: wp.array(dtype=int),
    by_mocap: wp.array(dtype=bool),
    awake: wp.array(dtype=int),
    # In and out:
    geoms: Geoms,
):
    """Forgets the last poses of geoms on bodies that were placed [group, world]. After the first step the
    poses of a body that a mocap body moves are its motion. Near a skin that this step leaves at rest they are
    those at its end already."""
    g, w = wp.tid()
    h = geoms.group[g]
    if awake[w] == 1 and placed[h, w] == 1 and not (by_mocap[h] and began[w] == 1):
        geoms.pos_last[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))


@wp.kernel
def forget_contacts(
    # In:
    on: wp.array(dtype=int),
    nsample: int,
    geoms: Geoms,
    # In and out:
    anchor_geom: wp.array2d(dtype=int),
    # Out:
    touched_out: wp.array(dtype=int),
):
    """Clears the contact of the samples of face f with geoms whose last poses are not known; whether other
    contact is left."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    for i in range(f * nsample, (f + 1) * nsample):
        g = anchor_geom[i, w]
        if g >= 0 and not wp.isfinite(geoms.pos_last[g, w][0]):
            anchor_geom[i, w] = -1
        elif g >= 0:
            touched_out[w] = 1


@wp.kernel
def find_bare(
    # In:
    on: wp.array(dtype=int),
    touched: wp.array(dtype=int),
    began: wp.array(dtype=int),
    # Out:
    bare_out: wp.array(dtype=bool),
):
    """Skins that nothing touches any more since bodies were placed."""
    w = wp.tid()
    bare_out[w] = on[w] == 1 and began[w] == 1 and touched[w] == 0


@wp.kernel
def come_from_outside(
    # In:
    wanted: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    rest: wp.array2d(dtype=vec3),
    # In and out:
    geoms: Geoms,
):
    """Geoms without a known earlier pose start where they just leave the undeformed skin along the mean
    normal of the touched faces, as in `ProximityQuery.outside` for one world. One block per geom."""
    g, w, t = wp.tid()
    last = geoms.pos_last[g, w]
    if wanted[w] == 0 or wp.isfinite(last[0] + last[1] + last[2]):
        return
    p = geoms.pos[g, w]
    R = geoms.mat[g, w]
    if not wp.isfinite(p[0] + p[1] + p[2] + wp.ddot(R, R)):
        return
    column = w % rest.shape[1]
    normal = vec3()
    moved = int(0)
    while moved < _ROUNDS:
        deepest = real(0.0)
        for f in range(t, face.shape[0], wp.block_dim()):
            a = rest[face[f][0], column]
            b = rest[face[f][1], column]
            c = rest[face[f][2], column]
            depth = real(0.0)
            for s in range(sample.shape[0]):
                x = sample[s][0] * a + sample[s][1] * b + sample[s][2] * c
                y = wp.transpose(R) * (x - p)
                if bound_to(geoms, g, x, y) < real(0.0):
                    dn = distance_from(geoms, g, x, y, R)
                    depth = wp.max(depth, -dn[3])
            deepest = wp.max(deepest, depth)
            if moved == 0 and depth > real(0.0):
                normal += wp.cross(b - a, c - a)
        deepest = block_max(deepest)
        if moved == 0:
            normal = block_sum(normal)
        if deepest < _LEFT or wp.length_sq(normal) == real(0.0):
            moved = _ROUNDS
        else:
            normal = wp.normalize(normal)
            p += deepest * normal
            moved += 1
    if t == 0:
        geoms.pos_last[g, w] = p
        geoms.mat_last[g, w] = R
