"""Kernels of `skin.py`: outputs of the step, reset of some worlds."""

import warp as wp

from ..skin.newton.worlds import Worlds

__all__ = [
    "begin_at_rest",
    "begin_frames",
    "put_back",
    "read_outputs",
    "reset_faces",
    "reset_geoms",
    "reset_nodes",
    "reset_samples",
    "reset_worlds",
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
def reset_nodes(
    # In:
    mask: wp.array(dtype=bool),
    rest: wp.array2d(dtype=vec3),
    # Out:
    x_out: wp.array2d(dtype=vec3),
    x_last_out: wp.array2d(dtype=vec3),
    increment_out: wp.array2d(dtype=vec3),
    velocity_out: wp.array2d(dtype=vec3),
):
    i, w = wp.tid()
    if mask[w]:
        x0 = rest[i, w % rest.shape[1]]
        x_out[i, w] = x0
        x_last_out[i, w] = x0
        increment_out[i, w] = vec3()
        velocity_out[i, w] = vec3()


@wp.kernel
def reset_samples(
    mask: wp.array(dtype=bool),
    anchor_geom_out: wp.array2d(dtype=int),
    trial_geom_out: wp.array2d(dtype=int),
    bond_out: wp.array2d(dtype=int),
):
    i, w = wp.tid()
    if mask[w]:
        anchor_geom_out[i, w] = -1
        trial_geom_out[i, w] = -1
        bond_out[i, w] = -1


@wp.kernel
def reset_faces(
    # In:
    mask: wp.array(dtype=bool),
    # Out:
    touching_out: wp.array2d(dtype=int),
    kept_out: wp.array2d(dtype=int),
    clearance_out: wp.array2d(dtype=real),
):
    f, w = wp.tid()
    if mask[w]:
        touching_out[f, w] = 0
        kept_out[f, w] = 0
        clearance_out[f, w] = real(0.0)


@wp.kernel
def reset_geoms(
    # In:
    mask: wp.array(dtype=bool),
    # Out:
    pos_last_out: wp.array2d(dtype=vec3),
    motion_out: wp.array2d(dtype=vec3),
    touched_by_out: wp.array2d(dtype=int),
):
    """Geoms that were nowhere before: the next step takes where they are then for where they were."""
    g, w = wp.tid()
    if mask[w]:
        pos_last_out[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))
        motion_out[g, w] = vec3()
        touched_by_out[g, w] = 0


@wp.kernel
def reset_worlds(
    # In:
    mask: wp.array(dtype=bool),
    rest_pressure: wp.array(dtype=real),
    # Out:
    st: Worlds,
    pressure_out: wp.array(dtype=real),
    fresh_out: wp.array(dtype=int),
    stays_out: wp.array(dtype=int),
):
    w = wp.tid()
    if mask[w]:
        pressure = rest_pressure[w]
        if st.kappa[w] == real(0.0):  # no liquid
            pressure = real(0.0)
        st.last_pressure[w] = pressure
        st.pressure[w] = pressure
        st.reason[w] = 0
        st.reached[w] = real(1.0)
        st.nonconverged[w] = 0
        st.iterations[w] = 0
        st.error[w] = real(0.0)
        pressure_out[w] = real(0.0)
        fresh_out[w] = 1
        stays_out[w] = 0


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
def put_back(
    # In:
    kept: wp.array3d(dtype=int),
    wanted: wp.array(dtype=int),
    start: int,
    reason: wp.array(dtype=int),
    # Out:
    out: wp.array3d(dtype=int),
):
    """start: whether it is what Newton's method starts from, and stays that of a solve that converged."""
    i, w = wp.tid()
    if wanted[w] == 1 and (start == 0 or reason[w] != 0):
        for k in range(out.shape[2]):
            out[i, w, k] = kept[i, w, k]
