"""Kernels of `skin.py`, `skins.py` and `batch.py`: poses in, linear models kept, forces and readings out.

Arrays of the simulator lead with the world and are single precision; ours are [item, world] and double. A
wrench or a small motion has its linear part first. Everything is in the BioTac frame, about its origin,
unless stated otherwise."""

import mujoco
import warp as wp

from ..coupling.implicit.rounds import Model
from ..coupling.implicit.rows import hold_by_rows
from ..kernels import kernel_module
from ..sensor.acquisition_kernels import Place
from ..skin.contact.posed import Geoms
from ..skin.newton.worlds import CONVERGED, NOT_FINITE, Worlds
from ..skin.types import double, mat33, mat66, real, vec3, vec6, widen

kernel_module(__name__)

_EQUALITY = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))


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
    pos[w] = double(xpos[w, core])
    mat[w] = widen(xmat[w, core])
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
    pos_out[k, w] = pos[group[k], w] + R * double(geom_pos[w % geom_pos.shape[0], g])
    mat_out[k, w] = (R * local) / scale


@wp.kernel
def accept_models(
    # In:
    st: Worlds,
    began: wp.array(dtype=int),
    wrench: wp.array2d(dtype=vec6),
    tangent: wp.array2d(dtype=mat66),
    slack: wp.array2d(dtype=real),
    at_rest: wp.array(dtype=bool),
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    geoms: Geoms,
    last: Model,
    # Out:
    model: Model,
):
    """Linear models of skins after a solve for poses pos, mat: about the poses that were reached. Where none
    was reached: the last step's model, or in a first step one about the target poses. No force where poses
    are not finite."""
    g, w = wp.tid()
    if st.wanted[w] == 0:
        return
    load_factor = st.load_factor[w]
    p = last.pos0[g, w]
    R = last.mat0[g, w]
    if st.reason[w] == NOT_FINITE:
        model.wrench0[g, w] = vec6()
        model.tangent0[g, w] = mat66()
    elif began[w] == 1 and load_factor == real(0.0):
        model.wrench0[g, w] = last.wrench0[g, w]
        model.tangent0[g, w] = last.tangent0[g, w]
    else:
        p = pos[g, w]
        R = mat[g, w]
        if load_factor > real(0.0):
            k = int(0)
            while geoms.group[k] != g:
                k += 1
            turn = geoms.mat_last[k, w] * wp.transpose(geoms.mat[k, w])
            p = turn * (p - geoms.pos[k, w]) + geoms.pos_last[k, w]
            R = turn * R
        model.wrench0[g, w] = wrench[g, w]
        model.tangent0[g, w] = hold_by_rows(tangent[g, w])
    model.pos0[g, w] = p
    model.mat0[g, w] = R
    model.slack[g, w] = real(0.0)
    if slack.shape[0] > 0 and load_factor == real(1.0) and not at_rest[w]:
        model.slack[g, w] = slack[g, w]


@wp.kernel
def reset_models(
    # In:
    mask: wp.array(dtype=bool),
    # Out:
    model: Model,
    failed_out: wp.array(dtype=int),
    began_out: wp.array(dtype=int),
):
    w = wp.tid()
    if not mask[w]:
        return
    for g in range(model.pos0.shape[0]):
        model.wrench0[g, w] = vec6()
        model.tangent0[g, w] = mat66()
        model.pos0[g, w] = vec3()
        model.mat0[g, w] = wp.identity(n=3, dtype=real)
        model.slack[g, w] = real(0.0)
    failed_out[w] = 0
    began_out[w] = 0


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
    frame = widen(xmat[w, core])
    origin = double(xpos[w, core])
    back = vec3()
    wind = vec3()
    for g in range(wrench.shape[0]):
        force = frame * vec3(wrench[g, w][0], wrench[g, w][1], wrench[g, w][2])
        torque = frame * vec3(wrench[g, w][3], wrench[g, w][4], wrench[g, w][5])
        back -= force
        wind -= torque
        _add_force(w, body[g], force, torque + wp.cross(origin - double(xipos[w, body[g]]), force), xfrc_out)
    _add_force(w, core, back, wind + wp.cross(origin - double(xipos[w, core]), back), xfrc_out)


@wp.func
def _add_force(w: int, b: int, force: vec3, torque: vec3, xfrc: wp.array3d(dtype=float)):
    for i in range(3):
        xfrc[w, b, i] = xfrc[w, b, i] + float(force[i])
        xfrc[w, b, 3 + i] = xfrc[w, b, 3 + i] + float(torque[i])


@wp.kernel
def write_force(
    # In:
    address: wp.array(dtype=int),
    wrench: wp.array2d(dtype=vec6),
    fraction: wp.array(dtype=real),
    besides: wp.array(dtype=vec6),
    # Out:
    sensordata_out: wp.array2d(dtype=float),
):
    """contact_force at its address among those of `write_sensors`: what acts on others, of which `wrench`
    holds a fraction, turned round, and what others do besides."""
    w, i = wp.tid()
    if address[5] >= 0:
        total = besides[w][i]
        for g in range(wrench.shape[0]):
            total -= wrench[g, w][i] / fraction[g]
        sensordata_out[w, address[5] + i] = float(total)


@wp.kernel
def write_sensors(
    # In:
    at: Place,
    address: wp.array(dtype=int),
    state: wp.array2d(dtype=real),
    # Out:
    sensordata_out: wp.array2d(dtype=float),
):
    """Readings at the addresses of electrodes, pdc, pac, tac and tdc; -1: the model has no such sensor.
    Each thread writes one number of every channel that has as many."""
    w, i = wp.tid()
    if address[0] >= 0 and i < at.nelectrode:
        sensordata_out[w, address[0] + i] = float(state[w, at.sampled + i])
    if address[2] >= 0 and i < at.slots / 2:
        sensordata_out[w, address[2] + i] = float(state[w, at.pac + i])
    if i > 0:
        return
    if address[1] >= 0:
        sensordata_out[w, address[1]] = float(state[w, at.pdc])
    if address[3] >= 0:
        sensordata_out[w, address[3]] = float(state[w, at.tac])
    if address[4] >= 0:
        sensordata_out[w, address[4]] = float(state[w, at.tdc])


@wp.kernel
def write_status(
    # In:
    address: wp.array(dtype=int),
    st: Worlds,
    valid: wp.array(dtype=int),
    settled: wp.array(dtype=int),
    failed: wp.array(dtype=int),
    rounds: wp.array(dtype=int),
    push: wp.array2d(dtype=real),
    tier: wp.array(dtype=int),
    # Out:
    sensordata_out: wp.array2d(dtype=float),
):
    """status at its address among those of `write_sensors`."""
    w = wp.tid()
    at = address[6]
    if at < 0:
        return
    good = float(0.0)
    if st.reason[w] == CONVERGED and settled[w] == 1:
        good = 1.0
    residual = float(st.error[w])
    if st.reason[w] == NOT_FINITE:
        residual = wp.nan
    if residual != residual or valid[w] == 0:
        good = -1.0
    least = real(1.0)
    for g in range(push.shape[0]):
        least = wp.min(least, push[g, w])
    sensordata_out[w, at] = good
    sensordata_out[w, at + 1] = float(failed[w])
    sensordata_out[w, at + 2] = float(st.iterations[w])
    sensordata_out[w, at + 3] = residual
    sensordata_out[w, at + 4] = float(tier[w])
    sensordata_out[w, at + 5] = float(rounds[w])
    sensordata_out[w, at + 6] = float(st.load_factor[w])
    sensordata_out[w, at + 7] = float(real(1.0) - least)


@wp.kernel
def add_forces(
    # In:
    jacobian: wp.array3d(dtype=vec6),
    wrench: wp.array2d(dtype=vec6),
    correction: wp.array2d(dtype=vec6),
    # In, out:
    qfrc: wp.array2d(dtype=float),
):
    w, i = wp.tid()
    total = real(0.0)
    for g in range(wrench.shape[0]):
        total += wp.dot(jacobian[g, w, i], wrench[g, w] + correction[g, w])
    qfrc[w, i] += float(total)


@wp.kernel
def acting_wrenches(
    # In:
    square: wp.array2d(dtype=real),
    jacobian: wp.array3d(dtype=vec6),
    qacc: wp.array2d(dtype=float),
    wrench: wp.array2d(dtype=vec6),
    correction: wp.array2d(dtype=vec6),
    tangent: wp.array2d(dtype=mat66),
    reason: wp.array(dtype=int),
    # Out:
    acting_out: wp.array2d(dtype=vec6),
):
    """Total wrench on the bodies in the step: the forces of `add_forces`, and those of the rows of
    `write_rows` at the accelerations of the constraint solver."""
    g, w = wp.tid()
    total = wrench[g, w] + correction[g, w]
    if reason[w] != NOT_FINITE:  # what is lost has no force, and no accelerations
        moved = vec6()
        for i in range(jacobian.shape[2]):
            moved += square[g, w] * real(qacc[w, i]) * jacobian[g, w, i]
        total -= tangent[g, w] * moved
    acting_out[g, w] = total


@wp.kernel
def find_rows(
    # In:
    slot: wp.array(dtype=int),
    ne: wp.array(dtype=int),
    efc_type: wp.array2d(dtype=int),
    efc_id: wp.array2d(dtype=int),
    # Out:
    row_out: wp.array2d(dtype=int),
):
    """The first of the six rows of each weld that holds a slot [slot, world]; -1 where there was no room for
    it."""
    s, w = wp.tid()
    row = int(-1)
    for r in range(wp.min(ne[w], efc_id.shape[1])):
        if row < 0 and efc_type[w, r] == _EQUALITY and efc_id[w, r] == slot[s]:
            row = r
    row_out[s, w] = row


@wp.kernel
def read_outputs(
    # In:
    rest_pressure: wp.array(dtype=real),
    has_liquid: int,
    st: Worlds,
    wrench: wp.array3d(dtype=real),
    fraction: wp.array(dtype=real),
    path: wp.array(dtype=real),
    # Out:
    pressure_out: wp.array(dtype=real),
    wrench_out: wp.array2d(dtype=vec6),
    tangent_out: wp.array2d(dtype=mat66),
):
    """Pressure; of the wrench and tangent of each group the fraction that this skin answers for, and how far
    what it meets goes with the group."""
    w = wp.tid()
    if has_liquid == 1:
        pressure_out[w] = st.pressure[w] - rest_pressure[w]
    for g in range(wrench_out.shape[0]):
        v = vec6()
        for i in range(6):
            v[i] = fraction[g] * wrench[g, w, i]
        wrench_out[g, w] = v
        if path[g] != real(1.0):
            tangent_out[g, w] = fraction[g] * path[g] * tangent_out[g, w]


@wp.kernel
def begin_near(
    wanted: wp.array(dtype=int),
    reason: wp.array(dtype=int),
    reset: wp.array(dtype=bool),
    # Out:
    begins_out: wp.array(dtype=int),
):
    """Lets solves of the wanted worlds begin where the previous one of the step has found an equilibrium."""
    w = wp.tid()
    begins_out[w] = wp.where(wanted[w] == 1 and reason[w] == CONVERGED and not reset[w], 1, 0)


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
def copy_anchors(
    # In:
    on: wp.array(dtype=int),
    kept: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    # In and out:
    kept_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
):
    """Copies the contact of face f, see `contact.faces.commit_face`: anchors of faces that have some."""
    w, f = wp.tid()
    has = kept[f, w]
    if on[w] == 0 or (has == 0 and kept_out[f, w] == 0):
        return
    kept_out[f, w] = has
    nsample = geom.shape[0] / kept.shape[0]
    for i in range(f * nsample, (f + 1) * nsample):
        g = int(-1)
        if has == 1:
            g = geom[i, w]
        geom_out[i, w] = g
        if g >= 0:
            anchor_out[i, w] = anchor[i, w]


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
