"""Kernels of `skin.py`: outputs of the device step, the stiffness that a touching body feels, reset of some
worlds.

The body drags the contact springs D of the nodes that it touches, and the skin behind them gives way by its
corrected compliance C: R' (D - D C D) R with the body's rigid motions R (`skin.preconditioner.body_tangent`).
The device step has just made G = (I + D W)^-1 D over all touching nodes for its linear solves, and that is D
- D C D; a body's tangent is R' G R over the nodes that it touches. Nodes that two bodies touch count for one
of them."""

import warp as wp

from ..skin.newton.worlds import Worlds

__all__ = [
    "drag_rows",
    "group_rows",
    "read_outputs",
    "reset_faces",
    "reset_geoms",
    "reset_nodes",
    "reset_samples",
    "reset_worlds",
    "sum_rows",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
vec6 = wp.spatial_vectord
mat66 = wp.spatial_matrixd


@wp.kernel
def read_outputs(
    # In:
    rest_pressure: real,
    has_liquid: int,
    st: Worlds,
    wrench: wp.array3d(dtype=real),
    # Out:
    pressure_out: wp.array(dtype=real),
    wrench_out: wp.array2d(dtype=vec6),
):
    w = wp.tid()
    if has_liquid == 1:
        pressure_out[w] = st.pressure[w] - rest_pressure
    for g in range(wrench_out.shape[0]):
        v = vec6()
        for i in range(6):
            v[i] = wrench[g, w, i]
        wrench_out[g, w] = v


@wp.kernel
def group_rows(
    # In:
    size: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    nsample: int,
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    group: wp.array(dtype=int),
    # Out:
    group_out: wp.array2d(dtype=int),
):
    """Which body touches each node of the small systems from outside [row, world]; -1: none."""
    s, w = wp.tid()
    found = int(-1)
    if s < size[w]:
        i = node[s, w]
        for k in range(start[i], start[i + 1]):
            f = slot[k] / 3
            if touching[f, w] == 1:
                for j in range(nsample):
                    g = geom[f * nsample + j, w]
                    if g >= 0:
                        found = wp.max(found, group[g])
    group_out[s, w] = found


@wp.kernel
def drag_rows(
    # In:
    liquid: int,
    size: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    G: wp.array3d(dtype=float),
    x: wp.array2d(dtype=vec3),
    group: wp.array2d(dtype=int),
    # Out:
    part_out: wp.array2d(dtype=mat66),
):
    """Each row's part R_s' sum_t G_st R_t of its body's tangent [row, world]."""
    s, w = wp.tid()
    if s >= size[w]:
        return
    mine = group[s, w]
    if mine < 0:
        return
    move = mat33()  # forces on node s of the body's unit translations, and rotations
    turn = mat33()
    for t in range(size[w]):
        if group[t, w] == mine:
            g = mat33()
            for a in range(3):
                for b in range(3):
                    # stored transposed; G is symmetric but for rounding
                    g[a, b] = real(G[w, liquid + 3 * t + b, liquid + 3 * s + a])
            move += g
            turn -= g * wp.skew(x[node[t, w], w])
    arm = wp.skew(x[node[s, w], w])
    bend = arm * move
    wind = arm * turn
    part = mat66()
    for a in range(3):
        for b in range(3):
            part[a, b] = move[a, b]
            part[a, 3 + b] = turn[a, b]
            part[3 + a, b] = bend[a, b]
            part[3 + a, 3 + b] = wind[a, b]
    part_out[s, w] = part


@wp.kernel
def sum_rows(
    # In:
    size: wp.array(dtype=int),
    group: wp.array2d(dtype=int),
    part: wp.array2d(dtype=mat66),
    # Out:
    tangent_out: wp.array2d(dtype=mat66),
):
    g, w = wp.tid()
    total = mat66()
    for s in range(size[w]):
        if group[s, w] == g:
            total += part[s, w]
    tangent_out[g, w] = real(0.5) * (total + wp.transpose(total))


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
        x_out[i, w] = rest[i, 0]
        x_last_out[i, w] = rest[i, 0]
        increment_out[i, w] = vec3()
        velocity_out[i, w] = vec3()


@wp.kernel
def reset_samples(
    mask: wp.array(dtype=bool), anchor_geom_out: wp.array2d(dtype=int), trial_geom_out: wp.array2d(dtype=int)
):
    i, w = wp.tid()
    if mask[w]:
        anchor_geom_out[i, w] = -1
        trial_geom_out[i, w] = -1


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
    mask: wp.array(dtype=bool), rest_pressure: real, st: Worlds, pressure_out: wp.array(dtype=real)
):
    w = wp.tid()
    if mask[w]:
        pressure = rest_pressure
        if st.kappa[w] == real(0.0):  # no liquid
            pressure = real(0.0)
        st.last_pressure[w] = pressure
        st.pressure[w] = pressure
        st.reason[w] = 0
        st.nonconverged[w] = 0
        st.iterations[w] = 0
        st.error[w] = real(0.0)
        pressure_out[w] = real(0.0)
