"""The skin's stiffness as rows of MuJoCo's constraints, see `metric`: written to an engine's own arrays, or
to others of the same layout."""

from typing import Any

import warp as wp

from ...kernels import kernel_module
from ...skin.types import mat66, real, vec6

kernel_module(__name__)


_NEGLIGIBLE = wp.constant(wp.float64(1e-15))  # mjMINVAL
_PIVOT = wp.constant(wp.float64(1e-9))  # of `_scale`: stiffness that is rounding


def _rows(precision):
    """`Rows` whose numbers have this precision."""

    @wp.struct
    class Rows:
        """Constraint rows of all worlds, the fields of an engine's `efc` by their names."""

        state: wp.array2d(dtype=int)
        force: wp.array2d(dtype=precision)
        pos: wp.array2d(dtype=precision)
        aref: wp.array2d(dtype=precision)
        D: wp.array2d(dtype=precision)
        J: wp.array3d(dtype=precision)
        sparse: int  # 1: J and J_colind are lists of the entries that are not zero
        J_rownnz: wp.array2d(dtype=int)
        J_rowadr: wp.array2d(dtype=int)
        J_colind: wp.array3d(dtype=int)

    return Rows


ROWS = {precision: _rows(precision) for precision in (wp.float32, wp.float64)}


@wp.func
def _scale(S: mat66):
    """Stiffness against translations and rotations to which rounding is in proportion. A diagonal entry may
    be nothing else, as along a flat side without friction, and its pivot divides the rounding of others."""
    d = wp.abs(wp.get_diag(S))
    push = d[0] + d[1] + d[2]
    turn = d[3] + d[4] + d[5]
    return vec6(push, push, push, turn, turn, turn)


@wp.func
def _pivot(S: mat66, scale: vec6, k: int):
    """Pivot k of the remaining matrix, 0 if it is negligible, and its column of L."""
    column = vec6()
    if S[k, k] <= _PIVOT * scale[k]:
        return wp.float64(0.0), column
    for i in range(k, 6):
        column[i] = S[i, k] / S[k, k]
    return S[k, k], column


@wp.func
def hold_by_rows(S: mat66):
    """The part of a stiffness that constraint rows can represent: L D L' without the pivots that are not
    positive. A model has only that part, so that its forces are those of the rows."""
    scale = _scale(S)
    left = S
    held = mat66()
    for k in range(6):
        pivot, column = _pivot(left, scale, k)
        one = pivot * wp.outer(column, column)
        left -= one
        held += one
    return held


@wp.kernel
def keep_held(tangent: wp.array2d(dtype=mat66)):
    """`hold_by_rows` of each body's, in place."""
    g, w = wp.tid()
    tangent[g, w] = hold_by_rows(tangent[g, w])


@wp.kernel
def write_rows(
    # In:
    square: wp.array2d(dtype=real),
    group_slot: wp.array(dtype=int),
    row: wp.array2d(dtype=int),
    jacobian: wp.array3d(dtype=vec6),
    tangent: wp.array2d(dtype=mat66),
    threads: int,
    # Out:
    rows: Any,
    basis_out: wp.array2d(dtype=vec6),
):
    """beta h^2 J' S J as six rows with reference acceleration zero: S = L D L', a row for each column of L,
    which is written to basis [row, world] where that has room.

    The columns of the rows of a slot are written by so many threads in turn: on CUDA by one for each, since
    loads and stores in turn take ten times the sums."""
    s, w, t = wp.tid()
    first = row[s, w]
    if first < 0:
        return
    S = mat66()
    group = int(0)
    for g in range(tangent.shape[0]):
        if group_slot[g] == s:  # bodies that are welded together move as one: their stiffnesses add
            S += square[g, w] * tangent[g, w]
            group = g
    scale = _scale(S)
    for k in range(6):
        pivot, column = _pivot(S, scale, k)
        S -= pivot * wp.outer(column, column)
        r = first + k
        if t == 0:
            rows.D[w, r] = type(rows.D[w, r])(wp.max(pivot, _NEGLIGIBLE))
            rows.aref[w, r] = type(rows.aref[w, r])(0.0)
            rows.pos[w, r] = type(rows.pos[w, r])(0.0)
            if r < basis_out.shape[0]:
                basis_out[r, w] = column
        for n in range(t, jacobian.shape[2], threads):
            if rows.sparse == 0:
                rows.J[w, r, n] = type(rows.J[w, r, n])(wp.dot(column, jacobian[group, w, n]))
            elif n < rows.J_rownnz[w, r]:
                at = rows.J_rowadr[w, r] + n
                held = wp.dot(column, jacobian[group, w, rows.J_colind[w, 0, at]])
                rows.J[w, 0, at] = type(rows.J[w, 0, at])(held)


# an overload that a launch makes would change the module after it was compiled
for _struct in ROWS.values():
    wp.overload(write_rows, {"rows": _struct})
