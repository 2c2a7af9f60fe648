"""The skin's linear model in mujoco_warp's dynamics: the equations of docs/lab/coupling.md for all worlds at
once.

Arrays of mujoco_warp lead with the world and are single precision; ours are [item, world] and double. A
wrench or a small motion has its linear part first. Everything is in the BioTac frame, about its origin."""

import mujoco
import warp as wp

from ...skin.newton.worlds import NOT_FINITE
from ...skin.types import mat66, real, vec6

__all__ = [
    "acting_wrenches",
    "add_forces",
    "find_rows",
    "write_rows",
]

wp.set_module_options({"enable_backward": False})


_EQUALITY = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
_NEGLIGIBLE = wp.constant(wp.float64(1e-15))  # mjMINVAL
_PIVOT = wp.constant(wp.float64(1e-9))  # of a diagonal entry: stiffness that is rounding


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
