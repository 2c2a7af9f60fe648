"""The skin's linear model in mujoco_warp's dynamics: the equations of docs/lab/coupling.md for all worlds at
once.

Arrays of mujoco_warp lead with the world and are single precision; ours are [item, world] and double. A
wrench or a small motion has its linear part first. Everything is in the BioTac frame, about its origin."""

import mujoco
import warp as wp

from ...coupling.implicit.rounds import Rounds, follow
from ...geometry.rigid_warp import is_finite, rotation
from ...skin.newton.worlds import NOT_FINITE
from ...skin.types import double, widen

__all__ = [
    "accelerate",
    "acting_wrenches",
    "add_forces",
    "advance_core",
    "advance_groups",
    "find_drift",
    "find_rows",
    "relative_jacobians",
    "write_rows",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
vec6 = wp.spatial_vectord
mat66 = wp.spatial_matrixd

_EQUALITY = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
_NEGLIGIBLE = wp.constant(wp.float64(1e-15))  # mjMINVAL
_PIVOT = wp.constant(wp.float64(1e-9))  # of a diagonal entry: stiffness that is rounding


@wp.func
def _ahead_pos(b: int, w: int, h: real, rootid: wp.array(dtype=int), xpos: wp.array2d(dtype=wp.vec3),
               com: wp.array2d(dtype=wp.vec3), cvel: wp.array2d(dtype=wp.spatial_vector)):  # fmt: skip
    """Where a body is after h at its present velocity."""
    spin = double(wp.spatial_top(cvel[w, b]))
    pos = double(xpos[w, b])
    return pos + h * (double(wp.spatial_bottom(cvel[w, b])) + wp.cross(spin, pos - double(com[w, rootid[b]])))


@wp.func
def _ahead_mat(
    b: int, w: int, h: real, xmat: wp.array2d(dtype=wp.mat33), cvel: wp.array2d(dtype=wp.spatial_vector)
):
    return rotation(h * double(wp.spatial_top(cvel[w, b]))) * widen(xmat[w, b])


@wp.kernel
def advance_groups(
    # In:
    core: int,
    body: wp.array(dtype=int),
    horizon: wp.array2d(dtype=real),
    rootid: wp.array(dtype=int),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    com: wp.array2d(dtype=wp.vec3),
    cvel: wp.array2d(dtype=wp.spatial_vector),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
):
    """Poses of the touching bodies after a horizon [s] at present velocities [group, world]."""
    g, w = wp.tid()
    b = body[g]
    h = horizon[g, w]
    frame = wp.transpose(_ahead_mat(core, w, h, xmat, cvel))
    origin = _ahead_pos(core, w, h, rootid, xpos, com, cvel)
    pos_out[g, w] = frame * (_ahead_pos(b, w, h, rootid, xpos, com, cvel) - origin)
    mat_out[g, w] = frame * _ahead_mat(b, w, h, xmat, cvel)


@wp.kernel
def relative_jacobians(
    # In:
    core: int,
    body: wp.array(dtype=int),
    rootid: wp.array(dtype=int),
    isdofancestor: wp.array2d(dtype=int),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    com: wp.array2d(dtype=wp.vec3),
    cdof: wp.array2d(dtype=wp.spatial_vector),
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    # Out:
    jacobian_out: wp.array3d(dtype=vec6),
):
    """Jacobians of the touching bodies relative to the BioTac, column i by thread i; pos, mat of
    `advance_groups`."""
    g, w, i = wp.tid()
    b = body[g]
    sign = real(isdofancestor[b, i] - isdofancestor[core, i])
    # the bodies' own columns differ in sign alone: both are about the BioTac's origin
    j = vec6()
    if sign != real(0.0) and is_finite(pos[g, w], mat[g, w]):  # what is lost takes no part in the dynamics
        turn = wp.transpose(widen(xmat[w, core]))
        spin = double(wp.spatial_top(cdof[w, i]))
        arm = double(xpos[w, core]) - double(com[w, rootid[wp.where(sign > real(0.0), b, core)]])
        linear = sign * (turn * (double(wp.spatial_bottom(cdof[w, i])) + wp.cross(spin, arm)))
        angular = sign * (turn * spin)
        j = vec6(linear[0], linear[1], linear[2], angular[0], angular[1], angular[2])
    jacobian_out[g, w, i] = j


@wp.kernel
def find_drift(
    # In:
    h: real,
    horizon: wp.array2d(dtype=real),
    jacobian: wp.array3d(dtype=vec6),
    qvel: wp.array2d(dtype=float),
    # Out:
    straight_out: wp.array2d(dtype=vec6),
    drift_out: wp.array2d(dtype=vec6),
):
    """Motions of the touching bodies at present velocities, in the step h and in the horizon [group,
    world]."""
    g, w = wp.tid()
    velocity = vec6()
    for i in range(jacobian.shape[2]):
        velocity += real(qvel[w, i]) * jacobian[g, w, i]
    straight_out[g, w] = h * velocity
    drift_out[g, w] = horizon[g, w] * velocity


@wp.kernel
def advance_core(
    # In:
    core: int,
    h: real,
    accelerated: int,
    rootid: wp.array(dtype=int),
    isdofancestor: wp.array2d(dtype=int),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    com: wp.array2d(dtype=wp.vec3),
    cvel: wp.array2d(dtype=wp.spatial_vector),
    cdof: wp.array2d(dtype=wp.spatial_vector),
    qacc: wp.array2d(dtype=float),
    # Out:
    pos_out: wp.array(dtype=vec3),
    mat_out: wp.array(dtype=mat33),
    pos_end_out: wp.array(dtype=vec3),
    mat_end_out: wp.array(dtype=mat33),
):
    """Poses of the BioTac frame in the world: now, and after h at present velocities moved by h^2 J a."""
    w = wp.tid()
    here = double(xpos[w, core])
    arm = here - double(com[w, rootid[core]])
    linear = vec3()
    angular = vec3()
    if accelerated == 1:
        for i in range(cdof.shape[1]):
            if isdofancestor[core, i] != 0:
                spin = double(wp.spatial_top(cdof[w, i]))
                a = h * h * real(qacc[w, i])
                linear += a * (double(wp.spatial_bottom(cdof[w, i])) + wp.cross(spin, arm))
                angular += a * spin
    pos_out[w] = here
    mat_out[w] = widen(xmat[w, core])
    pos_end_out[w] = _ahead_pos(core, w, h, rootid, xpos, com, cvel) + linear
    mat_end_out[w] = rotation(angular) * _ahead_mat(core, w, h, xmat, cvel)


@wp.kernel
def accelerate(
    # In:
    h: real,
    jacobian: wp.array3d(dtype=vec6),
    qacc: wp.array2d(dtype=float),
    # In and out:
    r: Rounds,
):
    """Where the bodies go with accelerations (nworld, nv), see `rounds.follow`."""
    g, w = wp.tid()
    gain = vec6()
    for i in range(jacobian.shape[2]):
        gain += real(qacc[w, i]) * jacobian[g, w, i]
    follow(r, g, w, h, gain)


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
    """What the bodies get in the step: the forces of `add_forces`, and those of the rows of `write_rows` at
    the accelerations that the constraint solver has found."""
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
def write_rows(
    # In:
    square: wp.array2d(dtype=real),
    group_slot: wp.array(dtype=int),
    row: wp.array2d(dtype=int),
    jacobian: wp.array3d(dtype=vec6),
    tangent: wp.array2d(dtype=mat66),
    sparse: int,
    rownnz: wp.array2d(dtype=int),
    rowadr: wp.array2d(dtype=int),
    colind: wp.array3d(dtype=int),
    # Out:
    J_out: wp.array3d(dtype=float),
    D_out: wp.array2d(dtype=float),
    aref_out: wp.array2d(dtype=float),
    pos_out: wp.array2d(dtype=float),
):
    """beta h^2 J' S J as six rows with reference acceleration zero: S = L D L', a row for each column of L.

    Each thread writes one column of the rows: loads and stores in turn take ten times the sums."""
    s, w, n = wp.tid()
    first = row[s, w]
    if first < 0:
        return
    S = mat66()
    group = int(0)
    for g in range(tangent.shape[0]):
        if group_slot[g] == s:  # bodies that are welded together move as one: their stiffnesses add
            S += square[g, w] * tangent[g, w]
            group = g
    whole = wp.get_diag(S)
    for k in range(6):
        pivot = wp.float64(0.0)
        column = vec6()
        if S[k, k] > _PIVOT * wp.abs(whole[k]):
            pivot = S[k, k]
            for i in range(k, 6):
                column[i] = S[i, k] / pivot
            S -= pivot * wp.outer(column, column)
        r = first + k
        if n == 0:
            D_out[w, r] = float(wp.max(pivot, _NEGLIGIBLE))
            aref_out[w, r] = 0.0
            pos_out[w, r] = 0.0
        if sparse == 0:
            J_out[w, r, n] = float(wp.dot(column, jacobian[group, w, n]))
        elif n < rownnz[w, r]:
            at = rowadr[w, r] + n
            J_out[w, 0, at] = float(wp.dot(column, jacobian[group, w, colind[w, 0, at]]))
