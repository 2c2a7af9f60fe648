"""The skin's linear model in mujoco_warp's dynamics: the equations of docs/lab/coupling.md for all worlds at
once.

Arrays of mujoco_warp lead with the world and are single precision; ours are [item, world] and double. A
wrench or a small motion has its linear part first. Everything is in the BioTac frame, about its origin."""

import mujoco
import warp as wp

from ...kernels import kernel_module
from ...skin.newton.worlds import NOT_FINITE
from ...skin.types import mat66, real, vec6

kernel_module(__name__)


_EQUALITY = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))


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
