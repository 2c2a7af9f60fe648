"""Linear systems of many worlds at once: GMRES by kernels, each world with its own matrix.

All of it is launches with loops that look at flags on the device (`skin.program`), so that a solve is part of
one recorded graph on CUDA. Directions have the precision of the approximate inverse; where that is single,
residuals are measured in double and solved for again, each time as far as its digits carry.

`warp.optim.linear.gmres` makes whole restarts for all systems until the worst is solved, in one precision. A
solve here takes 12 to 20 products, and worlds that are done do no more."""

import functools
import types
from collections.abc import Callable

import numpy as np
import warp as wp

from ...skin.newton.worlds import BLOCK, total_of
from ...skin.program import Launcher
from ...skin.types import DOUBLE, Precision, real, vec3

__all__ = ["Gmres", "refuse_unsolved"]

_BASIS = 40  # vectors, after which it begins anew: a solve takes 20, or 12 for the digits of a single inverse
_DIGITS = 1e-4  # what products of a single inverse reduce a residual by, before it is measured anew
_LEAST = wp.constant(real(1e-300))
_FEW, _FEW_THREADS = 16, 64  # worlds that do not fill the device, as in `skin.precondition.dense`


@wp.struct
class _State:
    """Of every world (nworld,), but for `at` and `go`."""

    size: wp.array(dtype=real)  # of the solution, about; less than nothing: not yet known
    beta: wp.array(dtype=real)  # of the residual after the inverse
    goal: wp.array(dtype=real)  # to which it is reduced in this cycle
    cycling: wp.array(dtype=int)  # takes part in this cycle
    on: wp.array(dtype=int)  # is still reduced in it
    columns: wp.array(dtype=int)  # of the basis that it has used
    failed: wp.array(dtype=int)  # most products that a system took which was not solved
    length: wp.array(dtype=real)  # of the next vector of the basis
    at: wp.array(dtype=int)  # number of the last column; products of this solve; of all
    go: wp.array(dtype=int)  # whether there are more cycles; more columns


@wp.kernel(enable_backward=False)
def _judge(first: int, precision: real, digits: real, most: int, part: wp.array3d(dtype=real), st: _State):
    """Ends worlds whose residual is small enough, and begins a cycle of the others. go[0] is 0 before."""
    w, t = wp.tid()
    if first == 0 and st.cycling[w] == 0:
        return
    size = st.size[w]
    square = total_of(part, 0, w, t)
    if t > 0:
        return
    beta = wp.sqrt(square)
    if first == 1:
        size = beta
        st.size[w] = beta
    asked = precision * size
    on = wp.int32(0)
    if not (beta <= asked):
        if st.at[1] < most and wp.isfinite(beta):
            on = 1
            st.go[0] = 1
        else:
            st.failed[w] = wp.max(st.failed[w], st.at[1] + 1)
    st.beta[w] = beta
    st.goal[w] = wp.max(asked, digits * beta)
    st.cycling[w] = on
    st.on[w] = on
    st.columns[w] = 0


@wp.kernel(enable_backward=False)
def _sum_dot_products(part: wp.array3d(dtype=real), st: _State, share_out: wp.array2d(dtype=real)):
    """Scalar products with the basis [vector, world], of their parts [vector, chunk, world]."""
    i, w, t = wp.tid()
    if st.on[w] == 0 or i > st.at[0]:
        return
    total = total_of(part, i, w, t)
    if t == 0:
        share_out[i, w] = total


@wp.kernel(enable_backward=False)
def _turn(
    # In:
    passes: int,
    most: int,
    part: wp.array3d(dtype=real),
    dot_product: wp.array3d(dtype=real),
    # In and out:
    along: wp.array3d(dtype=real),
    turns: wp.array3d(dtype=real),
    missed: wp.array2d(dtype=real),
    st: _State,
):
    """Givens' rotations keep what is along the basis triangular [row, column, world]; ends worlds that have
    missed no more than their goal. go[1] is 0 before."""
    w, t = wp.tid()
    if st.on[w] == 0:
        return
    square = total_of(part, 0, w, t)
    if t > 0:
        return
    j = st.at[0]
    length = wp.sqrt(square)
    miss = st.beta[w]
    if j > 0:
        miss = missed[j, w]
    here = dot_product[0, 0, w]
    if passes == 2:
        here += dot_product[1, 0, w]
    for i in range(j):
        below = dot_product[0, i + 1, w]
        if passes == 2:
            below += dot_product[1, i + 1, w]
        c = turns[0, i, w]
        s = turns[1, i, w]
        along[i, j, w] = c * here + s * below
        here = c * below - s * here
    diagonal = wp.sqrt(here * here + length * length)
    c = real(1.0)
    s = real(0.0)
    if diagonal > real(0.0):
        c = here / diagonal
        s = length / diagonal
    else:
        diagonal = real(1.0)
    turns[0, j, w] = c
    turns[1, j, w] = s
    along[j, j, w] = diagonal
    missed[j, w] = c * miss
    missed[j + 1, w] = -s * miss
    st.length[w] = length
    st.columns[w] = j + 1
    if wp.abs(s * miss) <= st.goal[w] or not wp.isfinite(miss):
        st.on[w] = 0
    elif j + 1 < along.shape[1] and st.at[1] < most:
        st.go[1] = 1


@wp.kernel(module=f"{__name__}.triangle", enable_backward=False)
def _solve_triangle(
    # In:
    along: wp.array3d(dtype=real),
    missed: wp.array2d(dtype=real),
    st: _State,
    # Out:
    share_out: wp.array2d(dtype=real),
):
    """How much of each vector of the basis the solution has; afterwards all worlds of the cycle are on."""
    w = wp.tid()
    if w == 0:
        st.go[0] = 0
    st.on[w] = st.cycling[w]
    if st.cycling[w] == 0:
        return
    k = st.columns[w]
    for i in range(k):
        share_out[i, w] = missed[i, w]
    for back in range(k):
        i = k - 1 - back
        y = share_out[i, w] / along[i, i, w]
        share_out[i, w] = y
        for h in range(i):
            share_out[h, w] = share_out[h, w] - along[h, i, w] * y


@functools.cache
def _kernels(precision: Precision) -> types.SimpleNamespace:
    """Kernels that know directions. Threads have chunks of nodes, of which they sum up what is asked of
    them."""
    module = f"{__name__}.{precision.name}"
    scalar, vec, lower, raised = precision.scalar, precision.vec, precision.lower, precision.raised

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        # In:
        first: int,
        chunk: int,
        mask: wp.array(dtype=real),
        right: wp.array2d(dtype=vec3),
        product: wp.array2d(dtype=vec3),
        # Out:
        x: wp.array2d(dtype=vec3),
        r_out: wp.array2d(dtype=vec),
        part_out: wp.array3d(dtype=real),
        st: _State,
    ):
        """The residual right - product, and its square; at first the right-hand side, and x is zero."""
        c, w = wp.tid()
        if first == 1:
            if c == 0:
                st.on[w] = 1
                if w == 0:
                    st.at[1] = 0
                    st.go[0] = 0
        elif st.on[w] == 0:
            return
        rr = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, right.shape[0])):
            r = right[i, w]
            if first == 1:
                x[i, w] = vec3()
            else:
                r -= product[i, w]
            if mask[i] == real(0.0):
                r = vec3()
            r_out[i, w] = lower(r)
            rr += wp.dot(r, r)
        part_out[0, c, w] = rr

    @wp.kernel(module=module, enable_backward=False)
    def measure(
        # In:
        chunk: int,
        counts: int,
        v: wp.array2d(dtype=vec),
        # Out:
        part_out: wp.array3d(dtype=real),
        st: _State,
    ):
        """The square of v by chunks; counts: 1: a product that makes the next column was taken."""
        c, w = wp.tid()
        if counts == 1 and c == 0 and w == 0:
            st.at[0] = st.at[0] + 1
            st.at[1] = st.at[1] + 1
            st.at[2] = st.at[2] + 1
            st.go[1] = 0
        if st.on[w] == 0:
            return
        vv = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, v.shape[0])):
            vv += real(wp.dot(v[i, w], v[i, w]))
        part_out[0, c, w] = vv

    @wp.kernel(module=module, enable_backward=False)
    def extend(
        # In:
        first: int,
        z: wp.array2d(dtype=vec),
        # Out:
        basis: wp.array3d(dtype=vec),
        p_out: wp.array2d(dtype=vec),
        st: _State,
    ):
        """z over its length is the next vector of the basis, and the next direction; at first, there is
        none."""
        i, w = wp.tid()
        if first == 1 and i == 0 and w == 0:
            st.at[0] = -1
            st.go[1] = 1
        if st.on[w] == 0:
            return
        j = wp.int32(0)
        length = st.beta[w]
        if first == 0:
            j = st.at[0] + 1
            length = st.length[w]
        v = vec()
        if length > _LEAST:
            v = lower(raised(z[i, w]) / length)
        if j < basis.shape[0]:
            basis[j, i, w] = v
        p_out[i, w] = v

    @wp.kernel(module=module, enable_backward=False)
    def project(
        # In:
        chunk: int,
        basis: wp.array3d(dtype=vec),
        z: wp.array2d(dtype=vec),
        # Out:
        part_out: wp.array3d(dtype=real),
        st: _State,
    ):
        """Scalar products of z with the basis, by chunks [vector, chunk, world]."""
        k, c, w = wp.tid()
        if st.on[w] == 0 or k > st.at[0]:
            return
        total = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, z.shape[0])):
            total += real(wp.dot(basis[k, i, w], z[i, w]))
        part_out[k, c, w] = total

    @wp.kernel(module=module, enable_backward=False)
    def subtract(
        # In:
        chunk: int,
        basis: wp.array3d(dtype=vec),
        dot_product: wp.array2d(dtype=real),
        # In and out:
        z: wp.array2d(dtype=vec),
        # Out:
        part_out: wp.array3d(dtype=real),
        st: _State,
    ):
        """z less what it has of the basis, and the square of what is left, by chunks."""
        c, w = wp.tid()
        if st.on[w] == 0:
            return
        j = st.at[0]
        zz = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, z.shape[0])):
            v = z[i, w]
            for k in range(j + 1):
                v -= scalar(dot_product[k, w]) * basis[k, i, w]
            z[i, w] = v
            zz += real(wp.dot(v, v))
        part_out[0, c, w] = zz

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        # In:
        basis: wp.array3d(dtype=vec),
        dot_product: wp.array2d(dtype=real),
        st: _State,
        # In and out:
        x: wp.array2d(dtype=vec3),
    ):
        """Adds to x what the basis has of the solution."""
        i, w = wp.tid()
        if st.on[w] == 0:
            return
        total = x[i, w]
        for k in range(st.columns[w]):
            total += dot_product[k, w] * raised(basis[k, i, w])
        x[i, w] = total

    return types.SimpleNamespace(
        begin=begin, measure=measure, extend=extend, project=project, subtract=subtract, gather=gather
    )


class Gmres:
    """Solutions of A x = right of all worlds; the residual is measured after the approximate inverse, as
    `linear.inverse.solve_by_gmres` has it.

    Args:
      precision: of directions, and what the inverse has. chunk: nodes summed by one thread.
      mask: (n,) 0 at nodes where right-hand sides are left out, a double array.
      p, q: directions and their products, r, z: residuals and their inverses [n, world], of that precision;
        p and z may be the same, as may q and r. part: (>= 1, chunks, nworld) double.
      on: (nworld,) int: flags of the worlds that product and inverse have to look at.
      error: of x to end at, of its size in each world. most: products.
      digits: how far a residual is reduced before it is measured anew; None: all the way in double, else
        1e-4.

    Attributes:
      right, x, product: [n, world] double, what is given, the solution, and where `exact` has to write.
      failed: (nworld,) int: not 0 where a system was not solved since it was zeroed.
      taken: (3,) int, of which the second are the products of the last solve, the third those of all since
        it was zeroed.
    """

    def __init__(
        self,
        precision: Precision,
        chunk: int,
        mask: wp.array,
        p: wp.array,
        q: wp.array,
        r: wp.array,
        z: wp.array,
        part: wp.array,
        on: wp.array,
        error: float,
        most: int = 400,
        digits: float | None = None,
    ):
        n, nworld = p.shape
        self._kernels, self._vectors, self._part, self._mask = _kernels(precision), (p, q, r, z), part, mask
        double = precision is DOUBLE
        self._digits = (0.0 if double else _DIGITS) if digits is None else digits
        self._error, self._most, self._chunk = error, most, chunk
        # of orthogonalization: where all digits are wanted, once more for what rounding left
        self._passes = 2 if double else 1
        self._dim, self._chunks = (n, nworld), (-(-n // chunk), nworld)
        self._few = nworld <= _FEW
        with wp.ScopedDevice(p.device):
            self.right, self.x, self.product = (wp.zeros((n, nworld), dtype=vec3) for _ in range(3))
            self._basis = wp.zeros((_BASIS, n, nworld), dtype=precision.vec)
            self._parts = wp.zeros((_BASIS, *self._chunks), dtype=real)
            self._along = wp.zeros((_BASIS, _BASIS, nworld), dtype=real)
            self._turns = wp.zeros((2, _BASIS, nworld), dtype=real)
            self._missed = wp.zeros((_BASIS + 1, nworld), dtype=real)
            self._dot_products = wp.zeros((2, _BASIS, nworld), dtype=real)
            self._st = st = _State()
            st.size, st.beta, st.goal, st.length = (wp.zeros(nworld, dtype=real) for _ in range(4))
            st.cycling, st.columns, st.failed = (wp.zeros(nworld, dtype=int) for _ in range(3))
            st.at, st.go = wp.zeros(3, dtype=int), wp.zeros(2, dtype=int)
            st.on = on
        self._each_pass = self._dot_products[0], self._dot_products[1]
        self._cycles, self._more = st.go[:1], st.go[1:]
        self.failed, self.taken = st.failed, st.at

    def put(
        self,
        program: Launcher,
        product: Callable[[], None],
        exact: Callable[[], None],
        inverse: Callable[[wp.array], None],
    ) -> None:
        """Puts a solve into a program. What is called puts there, in the worlds that are on:

        Args:
          product: q = A p. exact: `product` = A x, in double.
          inverse: of an array, q or r: z = approximate inverse times it, part[0] the square of it by chunks.
        """
        self._program, kernels, st = program, self._kernels, self._st
        p, q, r, z = self._vectors

        def look_again(first):
            given = [first, self._chunk, self._mask, self.right, self.product]
            self._launch(kernels.begin, self._chunks, given, [self.x, r, self._part, st])
            inverse(r)
            self._measure(z, 0)
            limits = [first, self._error, self._digits, self._most]
            self._blocks(_judge, self._dim[1:], [*limits, self._part], [st])

        def column():
            product()
            self._measure(q, 1)
            inverse(q)
            for dot_product in self._each_pass[: self._passes]:
                self._launch(
                    kernels.project, (_BASIS, *self._chunks), [self._chunk, self._basis, z], [self._parts, st]
                )
                self._blocks(_sum_dot_products, (_BASIS, self._dim[1]), [self._parts, st], [dot_product])
                self._launch(
                    kernels.subtract,
                    self._chunks,
                    [self._chunk, self._basis, dot_product, z],
                    [self._part, st],
                )
            given = [self._passes, self._most, self._part, self._dot_products]
            self._blocks(_turn, self._dim[1:], given, [self._along, self._turns, self._missed, st])
            self._launch(kernels.extend, self._dim, [0, z], [self._basis, p, st])

        def cycle():
            self._launch(kernels.extend, self._dim, [1, z], [self._basis, p, st])
            program.loop(self._more, column)
            self._launch(_solve_triangle, self._dim[1], [self._along, self._missed, st], [self._each_pass[0]])
            self._launch(kernels.gather, self._dim, [self._basis, self._each_pass[0], st], [self.x])
            exact()
            look_again(0)

        look_again(1)
        program.loop(self._cycles, cycle)

    def _measure(self, v, counts):
        self._launch(self._kernels.measure, self._chunks, [self._chunk, counts, v], [self._part, self._st])

    def _launch(self, kernel, dim, inputs, outputs):
        self._program.launch(kernel, dim, inputs, outputs, _FEW_THREADS if self._few else 256)

    def _blocks(self, kernel, dim, inputs, outputs):
        self._program.launch_blocks(kernel, list(dim), inputs, outputs, BLOCK)


def refuse_unsolved(failed: np.ndarray) -> None:
    """Raises ValueError where `Gmres.failed` (nworld,) says that a system was not solved."""
    if failed.any():
        world = int(failed.argmax())
        raise ValueError(
            f"the adjoint of a step of world {world} was not solved with {failed[world] - 1} products: its "
            "tangent is next to singular, as of skin that slides freely; look at the step's changes and "
            "shorten it"
        )
