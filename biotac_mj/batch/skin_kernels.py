"""Kernels of `skin.py`: where a step begins, and its outputs."""

import warp as wp

from ..skin.newton.worlds import Worlds

__all__ = [
    "begin_at_rest",
    "begin_frames",
    "read_outputs",
    "share_tangents",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
vec6 = wp.spatial_vectord


@wp.kernel
def read_outputs(
    # In:
    rest_pressure: wp.array(dtype=real),
    has_liquid: int,
    st: Worlds,
    wrench: wp.array3d(dtype=real),
    share: wp.array(dtype=real),
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
            v[i] = share[g] * wrench[g, w, i]
        wrench_out[g, w] = v


@wp.kernel
def share_tangents(
    share: wp.array(dtype=real), way: wp.array(dtype=real), tangent: wp.array2d(dtype=wp.spatial_matrixd)
):
    """Takes of tangents what this skin answers for, and how far what it meets goes with a group."""
    g, w = wp.tid()
    if way[g] != real(1.0):
        tangent[g, w] = share[g] * way[g] * tangent[g, w]


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
