"""Poses in, linear models kept, forces and readings out: kernels of `skins.py`.

Arrays of the simulator lead with the world and are single precision; ours are [item, world] and double. A
wrench or a small motion has its linear part first. Everything is in the BioTac frame, about its origin, where
nothing else is said."""

import warp as wp

from ..sensor.acquisition import HELD, HELD_PDC, HELD_TAC, HELD_TDC, PAC
from ..sensor.channels import NELECTRODE, NPAC
from ..skin.newton.worlds import CONVERGED, INSIDE_CORE, NOT_CONVERGED, NOT_FINITE

__all__ = [
    "accept_models",
    "body_forces",
    "core_pose",
    "geom_poses",
    "matrix",
    "relative_poses",
    "reset_models",
    "vector",
    "write_sensors",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
vec6 = wp.spatial_vectord
mat66 = wp.spatial_matrixd


@wp.func
def vector(v: wp.vec3):
    return vec3(real(v[0]), real(v[1]), real(v[2]))


@wp.func
def matrix(m: wp.mat33):
    return mat33(
        real(m[0, 0]), real(m[0, 1]), real(m[0, 2]),
        real(m[1, 0]), real(m[1, 1]), real(m[1, 2]),
        real(m[2, 0]), real(m[2, 1]), real(m[2, 2]),
    )  # fmt: skip


@wp.kernel
def relative_poses(
    # In:
    core: int,
    body: wp.array(dtype=int),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
):
    """Poses of the touching bodies now [group, world]."""
    g, w = wp.tid()
    turn = wp.transpose(matrix(xmat[w, core]))
    pos_out[g, w] = turn * (vector(xpos[w, body[g]]) - vector(xpos[w, core]))
    mat_out[g, w] = turn * matrix(xmat[w, body[g]])


@wp.kernel
def core_pose(
    # In:
    core: int,
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    fresh: wp.array(dtype=int),
    # In and out:
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    # Out:
    last_pos_out: wp.array(dtype=vec3),
    last_mat_out: wp.array(dtype=mat33),
):
    """The BioTac frame in the world, and where it was in the last step; in the first it was here."""
    w = wp.tid()
    last_pos_out[w] = pos[w]
    last_mat_out[w] = mat[w]
    pos[w] = vector(xpos[w, core])
    mat[w] = matrix(xmat[w, core])
    if fresh[w] == 1:
        last_pos_out[w] = pos[w]
        last_mat_out[w] = mat[w]


@wp.kernel
def geom_poses(
    # In:
    geom: wp.array(dtype=int),
    group: wp.array(dtype=int),
    geom_pos: wp.array2d(dtype=wp.vec3),
    geom_quat: wp.array2d(dtype=wp.quat),
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
):
    """Poses of the geoms [geom, world] on bodies at pos, mat [group, world]; quaternions are mujoco_warp's
    (w, x, y, z)."""
    k, w = wp.tid()
    g = geom[k]
    q = geom_quat[w % geom_quat.shape[0], g]
    a = real(q[0])
    u = vec3(real(q[1]), real(q[2]), real(q[3]))
    local = (
        (a * a - wp.dot(u, u)) * wp.identity(n=3, dtype=real)
        + real(2.0) * wp.outer(u, u)
        + real(2.0) * a * wp.skew(u)
    )
    scale = a * a + wp.dot(u, u)  # stored in single precision
    R = mat[group[k], w]
    pos_out[k, w] = pos[group[k], w] + R * vector(geom_pos[w % geom_pos.shape[0], g])
    mat_out[k, w] = (R * local) / scale


@wp.kernel
def accept_models(
    # In:
    reason: wp.array(dtype=int),
    wrench: wp.array2d(dtype=vec6),
    tangent: wp.array2d(dtype=mat66),
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    # In, out:
    wrench0: wp.array2d(dtype=vec6),
    tangent0: wp.array2d(dtype=mat66),
    pos0: wp.array2d(dtype=vec3),
    mat0: wp.array2d(dtype=mat33),
    failed: wp.array(dtype=int),
):
    """The linear models of this step: of the skin just solved; its last wrench where it found no balance;
    none where the input was bad."""
    g, w = wp.tid()
    why = reason[w]
    if why == NOT_FINITE or why == INSIDE_CORE:
        wrench0[g, w] = vec6()
        tangent0[g, w] = mat66()
        pos0[g, w] = vec3()
        mat0[g, w] = wp.identity(n=3, dtype=real)
    elif why == NOT_CONVERGED:
        tangent0[g, w] = mat66()
        if g == 0:
            failed[w] += 1
    else:
        wrench0[g, w] = wrench[g, w]
        tangent0[g, w] = tangent[g, w]
        pos0[g, w] = pos[g, w]
        mat0[g, w] = mat[g, w]


@wp.kernel
def reset_models(
    # In:
    mask: wp.array(dtype=bool),
    # Out:
    wrench_out: wp.array2d(dtype=vec6),
    tangent_out: wp.array2d(dtype=mat66),
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
    failed_out: wp.array(dtype=int),
):
    w = wp.tid()
    if not mask[w]:
        return
    for g in range(wrench_out.shape[0]):
        wrench_out[g, w] = vec6()
        tangent_out[g, w] = mat66()
        pos_out[g, w] = vec3()
        mat_out[g, w] = wp.identity(n=3, dtype=real)
    failed_out[w] = 0


@wp.kernel
def body_forces(
    # In:
    core: int,
    body: wp.array(dtype=int),
    wrench: wp.array2d(dtype=vec6),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    xipos: wp.array2d(dtype=wp.vec3),
    # Out:
    xfrc_out: wp.array3d(dtype=float),
):
    """Wrenches on the bodies' centres of mass in the world's frame; the BioTac's body gets the opposite of
    all."""
    w = wp.tid()
    for b in range(xfrc_out.shape[1]):
        for i in range(6):
            xfrc_out[w, b, i] = 0.0
    frame = matrix(xmat[w, core])
    origin = vector(xpos[w, core])
    back = vec3()
    wind = vec3()
    for g in range(wrench.shape[0]):
        force = frame * vec3(wrench[g, w][0], wrench[g, w][1], wrench[g, w][2])
        torque = frame * vec3(wrench[g, w][3], wrench[g, w][4], wrench[g, w][5])
        back -= force
        wind -= torque
        _add_force(w, body[g], force, torque + wp.cross(origin - vector(xipos[w, body[g]]), force), xfrc_out)
    _add_force(w, core, back, wind + wp.cross(origin - vector(xipos[w, core]), back), xfrc_out)


@wp.func
def _add_force(w: int, b: int, force: vec3, torque: vec3, xfrc: wp.array3d(dtype=float)):
    for i in range(3):
        xfrc[w, b, i] = xfrc[w, b, i] + float(force[i])
        xfrc[w, b, 3 + i] = xfrc[w, b, 3 + i] + float(torque[i])


@wp.kernel
def write_sensors(
    # In:
    address: wp.array(dtype=int),
    state: wp.array2d(dtype=real),
    wrench: wp.array2d(dtype=vec6),
    reason: wp.array(dtype=int),
    valid: wp.array(dtype=int),
    failed: wp.array(dtype=int),
    iterations: wp.array(dtype=int),
    error: wp.array(dtype=real),
    # Out:
    sensordata_out: wp.array2d(dtype=float),
):
    """Readings at the addresses of electrodes, pdc, pac, tac, tdc, contact_force and status; -1: the model
    has no such sensor."""
    w = wp.tid()
    if address[0] >= 0:
        for e in range(NELECTRODE):
            sensordata_out[w, address[0] + e] = float(state[w, HELD + e])
    if address[1] >= 0:
        sensordata_out[w, address[1]] = float(state[w, HELD_PDC])
    if address[2] >= 0:
        for k in range(NPAC):
            sensordata_out[w, address[2] + k] = float(state[w, PAC + k])
    if address[3] >= 0:
        sensordata_out[w, address[3]] = float(state[w, HELD_TAC])
    if address[4] >= 0:
        sensordata_out[w, address[4]] = float(state[w, HELD_TDC])
    if address[5] >= 0:
        total = vec6()
        for g in range(wrench.shape[0]):
            total += wrench[g, w]
        for i in range(6):
            sensordata_out[w, address[5] + i] = float(-total[i])
    if address[6] >= 0:
        why = reason[w]
        good = float(1.0)
        residual = float(error[w])
        if why != CONVERGED:
            good = 0.0
        if why == NOT_FINITE or why == INSIDE_CORE:
            residual = wp.nan
        if residual != residual or valid[w] == 0:
            good = -1.0
        sensordata_out[w, address[6]] = good
        sensordata_out[w, address[6] + 1] = float(failed[w])
        sensordata_out[w, address[6] + 2] = float(iterations[w])
        sensordata_out[w, address[6] + 3] = residual
        sensordata_out[w, address[6] + 4] = 0.0
