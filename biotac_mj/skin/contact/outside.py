"""Where geoms come from whose earlier poses are not known: out of the undeformed skin."""

import warp as wp

from ...kernels import kernel_module
from ..block import block_max, block_sum
from ..types import mat33, real, vec3
from .posed import Geoms, bound_to, distance_from

kernel_module(__name__)

_ROUNDS = wp.constant(24)  # each takes the deepest point's depth off
_LEFT = wp.constant(wp.float64(1e-6))  # [m] of depth that will do


@wp.kernel
def leave_skin(
    # In:
    wanted: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    rest: wp.array2d(dtype=vec3),
    geoms: Geoms,
    # In and out:
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
):
    """Poses [geom, world], where they are not finite yet, at which the geoms just leave the undeformed skin
    along the mean normal of the touched faces. One block per geom."""
    g, w, t = wp.tid()
    last = pos[g, w]
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
        pos[g, w] = p
        mat[g, w] = R
