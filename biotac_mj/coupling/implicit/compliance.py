"""Compliance of the bodies that touch a skin, beta h^2 J H^-1 J', and their frequencies on it, in one world
or in all at once.

H is M - h D, with D what the integrator treats implicitly, and the springs that MuJoCo's other constraints
are where its solver left them: joints that friction holds, contacts, the rows of other skins.

The kernels read an engine's own arrays, as those of `poses` do."""

from typing import Any

import mujoco
import warp as wp

from ...kernels import add_zeros, kernel_module, set_fields
from ...skin.block import MEMORY, block_memory, block_rank, sync
from ...skin.types import real, vec6
from .rounds import Model
from .rows import ROWS

kernel_module(__name__)

THREADS = 64  # that factor a world's matrix on CUDA

_QUADRATIC, _CONE = (
    wp.constant(int(getattr(mujoco.mjtConstraintState, f"mjCNSTRSTATE_{name}")))
    for name in ("QUADRATIC", "CONE")
)
_LEAST = wp.constant(wp.float64(1e-12))  # of a pivot, of the entry that it came from
_NONE = wp.constant(wp.float64(2e-15))  # of a row without stiffness, twice mjMINVAL


@wp.func
def _entry(rows: Any, w: int, r: int, k: int):
    """Entry k of those that a constraint's row has in the Jacobian."""
    if rows.sparse == 1:
        return real(rows.J[w, 0, rows.J_rowadr[w, r] + k])
    return real(rows.J[w, r, k])


@wp.func
def _stiffness(
    w: int,
    spring: int,
    a: int,
    b: int,
    rows: Any,
    cone: wp.array2d(dtype=int),
    hessian: wp.array2d(dtype=vec6),
):
    """What a row of `factor` adds between the degrees of freedom of its entries a and b."""
    r = spring
    push = real(0.0)
    if spring < 0:
        r = -1 - spring
        for k in range(6):
            if hessian[w, r][k] != real(0.0):
                push += hessian[w, r][k] * _entry(rows, w, cone[w, r] + k, b)
    else:
        push = real(rows.D[w, r]) * _entry(rows, w, r, b)
    return push * _entry(rows, w, r, a)


@wp.func
def _is_spring(r: int, w: int, own: wp.array2d(dtype=int), rows: Any, cone: wp.array2d(dtype=int)):
    """Whether a constraint's row holds, 1 or 0: none of a skin's own, of which the first of six are `own`."""
    spring = wp.where(rows.state[w, r] == _QUADRATIC and real(rows.D[w, r]) > _NONE, 1, 0)
    if rows.state[w, r] == _CONE:
        spring = wp.where(cone[w, r] >= 0, 1, 0)
    for k in range(own.shape[0]):
        if own[k, w] >= 0 and r >= own[k, w] and r < own[k, w] + 6:
            spring = 0
    return spring


@wp.kernel(launch_bounds=(THREADS, 10))
def factor(
    # In:
    going: wp.array(dtype=int),
    inertia: wp.array2d(dtype=Any),
    rownnz: wp.array(dtype=int),
    rowadr: wp.array(dtype=int),
    colind: wp.array(dtype=int),
    own: wp.array2d(dtype=int),
    count: wp.array(dtype=int),
    rows: Any,
    cone: wp.array2d(dtype=int),
    hessian: wp.array2d(dtype=vec6),
    # Out:
    spring_out: wp.array2d(dtype=int),
    L_out: wp.array3d(dtype=real),
):
    """Cholesky's factor of the inertia with what constraints now hold, and a list of their rows [world, k],
    r or, of a cone, -1 - r; by the threads of a block, in worlds that have not finished. `count` of the
    `Rows` of a world are there.

    A contact that slides on its elliptic cone holds by its Hessian: `cone` is the first of its rows, or -1
    where it is not known, and `hessian` has a row for each. They have their entries in the same columns."""
    w, t = wp.tid()
    if going[w] == 0:
        return
    threads = wp.block_dim()
    n = L_out.shape[1]
    springs = int(0)
    nrow = wp.min(count[w], rows.state.shape[1])
    for begin in range(0, nrow, threads):
        spring = int(0)
        if begin + t < nrow:
            spring = _is_spring(begin + t, w, own, rows, cone)
        rank = block_rank(spring)
        if spring == 1:
            r = begin + t
            spring_out[w, springs + rank[0]] = wp.where(rows.state[w, r] == _CONE, -1 - r, r)
        springs += rank[1]
    memory = block_memory()
    if memory == wp.uint64(0) or n * n > MEMORY:
        memory = L_out.ptr + wp.uint64(8 * n * n) * wp.uint64(w)
    L = wp.array(ptr=memory, shape=(n, n), dtype=real)
    for i in range(t, n, threads):
        for j in range(n):
            L[i, j] = real(0.0)
        for k in range(rownnz[i]):
            L[i, colind[rowadr[i] + k]] = real(inertia[w, rowadr[i] + k])
    sync()
    if rows.sparse == 1:
        for k in range(springs):
            spring = spring_out[w, k]
            r = wp.where(spring < 0, -1 - spring, spring)
            size = rows.J_rownnz[w, r]
            for m in range(t, size * size, threads):
                i = rows.J_colind[w, 0, rows.J_rowadr[w, r] + m / size]
                j = rows.J_colind[w, 0, rows.J_rowadr[w, r] + m % size]
                if i >= j:
                    held = _stiffness(w, spring, m / size, m % size, rows, cone, hessian)
                    L[i, j] = L[i, j] + held
            sync()
    else:
        for m in range(t, n * n, threads):
            held = real(0.0)
            for k in range(wp.where(m / n >= m % n, springs, 0)):
                held += _stiffness(w, spring_out[w, k], m / n, m % n, rows, cone, hessian)
            L[m / n, m % n] = L[m / n, m % n] + held
    sync()
    for j in range(n):
        whole = L[j, j]
        sync()
        for i in range(j + t, n, threads):
            total = L[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total
        sync()
        pivot = wp.sqrt(wp.max(L[j, j], _LEAST * whole))
        sync()
        for i in range(j + t, n, threads):
            L[i, j] = wp.where(i == j, pivot, L[i, j] / pivot)
        sync()
    for i in range(t, n, threads):
        for j in range(i + 1):
            L_out[w, i, j] = L[i, j]


# an overload that a launch makes would change the module after it was compiled
for _real in (wp.float32, wp.float64):
    wp.overload(factor, {"inertia": wp.array2d(dtype=_real), "rows": ROWS[_real]})


@wp.func
def substitute(L: wp.array3d(dtype=real), w: int, c: int, x: wp.array3d(dtype=real)):
    """Solves L L' y = x[w, :, c] in place, by one thread: those of other columns read what is beside it."""
    n = L.shape[1]
    for i in range(n):
        total = x[w, i, c]
        for k in range(i):
            total -= L[w, i, k] * x[w, k, c]
        x[w, i, c] = total / L[w, i, i]
    for back in range(n):
        i = n - 1 - back
        total = x[w, i, c]
        for k in range(i + 1, n):
            total -= L[w, k, i] * x[w, k, c]
        x[w, i, c] = total / L[w, i, i]


@wp.func
def holds(model: Model, g: int, w: int):
    """Whether a skin has a stiffness against a body."""
    return wp.ddot(model.tangent0[g, w], model.tangent0[g, w]) > real(0.0)


@wp.struct
class Columns:
    """Response of the bodies that touch a skin to a unit of each component of the wrenches on them, a
    column."""

    jacobian: wp.array3d(dtype=vec6)  # of the bodies
    model: Model
    # accelerations of the degrees of freedom [world, dof, column]; by what all skins do against such a motion
    found: wp.array3d(dtype=real)
    driven: wp.array3d(dtype=real)
    # contribution [world, column] to the traces of the second and the fourth power of the modal matrix, in
    # which the highest frequency dominates
    power: wp.array2d(dtype=wp.vec2d)


@wp.kernel
def give(going: wp.array(dtype=int), L: wp.array3d(dtype=real), held: int, columns: Columns):
    """Finds the accelerations. held: of those alone that the skin holds."""
    w, c = wp.tid()
    if going[w] == 0 or (held == 1 and not holds(columns.model, c / 6, w)):
        return
    for i in range(L.shape[1]):
        columns.found[w, i, c] = columns.jacobian[c / 6, w, i][c % 6]
    substitute(L, w, c, columns.found)


@wp.kernel
def move(
    # In:
    going: wp.array(dtype=int),
    square: wp.array2d(dtype=real),
    columns: Columns,
    # Out:
    compliance_out: wp.array4d(dtype=real),
):
    """A column of the compliance: motions of all bodies by that."""
    w, c = wp.tid()
    if going[w] == 0:
        return
    groups = columns.jacobian.shape[0]
    for g in range(groups):
        m = vec6()
        # of two bodies whose steps differ the mean, so that it stays symmetric
        both = wp.sqrt(square[g, w] * square[c / 6, w])
        for i in range(columns.found.shape[1]):
            m += (both * columns.found[w, i, c]) * columns.jacobian[g, w, i]
        for b in range(6):
            compliance_out[groups * g + c / 6, w, b, c % 6] = m[b]


@wp.kernel
def add_stiffness(
    # In:
    jacobian: wp.array3d(dtype=vec6),
    model: Model,
    # In and out:
    stiffness: wp.array3d(dtype=real),
):
    """Adds a skin's stiffness against the degrees of freedom [world, dof, dof], a row by each thread."""
    w, i = wp.tid()
    for g in range(jacobian.shape[0]):
        if holds(model, g, w):
            held = wp.transpose(model.tangent0[g, w]) * jacobian[g, w, i]
            for j in range(jacobian.shape[2]):
                stiffness[w, i, j] = stiffness[w, i, j] + wp.dot(held, jacobian[g, w, j])


@wp.kernel
def drive(
    taking_part: wp.array(dtype=int),
    stiffness: wp.array3d(dtype=real),
    L: wp.array3d(dtype=real),
    columns: Columns,
):
    """Finds the accelerations by what all skins do [world, dof, dof], of bodies that this skin holds."""
    w, c = wp.tid()
    if taking_part[w] == 0 or not holds(columns.model, c / 6, w):
        return
    for i in range(stiffness.shape[1]):
        held = real(0.0)
        for j in range(stiffness.shape[1]):
            held += stiffness[w, i, j] * columns.found[w, j, c]
        columns.driven[w, i, c] = held
    substitute(L, w, c, columns.driven)


@wp.kernel
def add_powers(taking_part: wp.array(dtype=int), stiffness: wp.array3d(dtype=real), columns: Columns):
    """Finds the powers."""
    w, c = wp.tid()
    g = c / 6
    second = vec6()
    fourth = vec6()
    if taking_part[w] == 1 and holds(columns.model, g, w):
        for i in range(stiffness.shape[1]):
            once = real(0.0)
            twice = real(0.0)
            for j in range(stiffness.shape[1]):
                once += stiffness[w, i, j] * columns.found[w, j, c]
                twice += stiffness[w, i, j] * columns.driven[w, j, c]
            for b in range(6):
                second[b] = second[b] + once * columns.found[w, i, 6 * g + b]
                fourth[b] = fourth[b] + twice * columns.driven[w, i, 6 * g + b]
    T = columns.model.tangent0[g, w]
    columns.power[w, c] = wp.vec2d((T * second)[c % 6], (T * fourth)[c % 6])


@wp.kernel
def find_frequencies(
    # In:
    taking_part: wp.array(dtype=int),
    columns: Columns,
    # Out:
    frequency_out: wp.array2d(dtype=real),
):
    """Angular frequencies [rad/s] at which bodies bounce in the stiffest mode in which a skin holds them,
    with all other skins."""
    g, w = wp.tid()
    if taking_part[w] == 0:
        return
    total = wp.vec2d()
    for c in range(6 * g, 6 * g + 6):
        total += columns.power[w, c]
    frequency = real(0.0)
    if total[0] > real(0.0) and total[1] > real(0.0):
        frequency = wp.sqrt(wp.sqrt(total[1] / total[0]))
    frequency_out[g, w] = frequency


class Response:
    """Response of the bodies that touch one skin to wrenches on them, as launches (kernel, dim, arguments).

    Args:
      jacobian: (group, world, dof) of the bodies. model: of the skin.
    """

    def __init__(self, jacobian: wp.array, model: Model):
        groups, nworld, nv = jacobian.shape
        self._shape, self._columns = (
            (nworld, 6 * groups),
            set_fields(Columns(), jacobian=jacobian, model=model),
        )
        with wp.ScopedDevice(jacobian.device):
            add_zeros(self._columns, "found driven", nworld, nv, 6 * groups)
            add_zeros(self._columns, "power", *self._shape)

    def compliance(self, going: wp.array, L: wp.array, square: wp.array, out: wp.array) -> list[tuple]:
        """Computes the compliance [group, group, world] with factors of `factor`, in the worlds marked in
        going (nworld,). square: [group, world] factor from an acceleration to the bodies' displacement at the
        pose where the skin is solved [m per m/s^2]."""
        groups, _, nworld = out.shape
        shape, where = (groups * groups, nworld, 6, 6), out.device
        entries = wp.array(ptr=out.ptr, shape=shape, dtype=real, device=where, copy=False)
        return [
            (give, self._shape, [going, L, 0, self._columns]),
            (move, self._shape, [going, square, self._columns, entries]),
        ]

    def frequencies(
        self, taking_part: wp.array, stiffness: wp.array, L: wp.array, out: wp.array
    ) -> list[tuple]:
        """Finds the frequency of each body [group, world], with factors in which no skin holds anything;
        stiffness: of all skins (nworld, nv, nv)."""
        return [
            (give, self._shape, [taking_part, L, 1, self._columns]),
            (drive, self._shape, [taking_part, stiffness, L, self._columns]),
            (add_powers, self._shape, [taking_part, stiffness, self._columns]),
            (find_frequencies, out.shape, [taking_part, self._columns, out]),
        ]
