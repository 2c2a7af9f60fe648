"""Multifrontal factor of a symmetric positive definite sparse matrix, for many fast solves on one core.

Groups of nodes are eliminated together (`nested_dissection`), each with a dense front: A within the group and
B to nodes that are eliminated later, after the updates of earlier groups (Duff and Reid 1983). S = A^-1 and
C = B S are stored. A solve computes  b_later -= C b  up the tree and  x = S b - C^T x_later  down it, by
products with dense panels. Panels are in single precision, since a solve is limited by reading them; sums are
in double. The operator is linear and symmetric to double precision, and differs from the inverse by 1e-6 in
the energy norm (2e-5 at a Poisson's ratio of 0.4999).

A press spends 0.4 of its time in solves. One with the default skin (10 674 coordinates) takes 1.3 ms on one
core; scipy's `splu` takes 7.3 ms and CHOLMOD from cholespy 3.3 ms."""

import hashlib
import threading

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import lapack

from ...kernels import kernel_module
from ...launches import recorded
from .nested_dissection import dissect

kernel_module(__name__)

_LANES = 8  # numbers of a SIMD multiplication, to which rows of panels are padded with zeros
_TOGETHER = 4  # nodes whose rows are computed together, since right-hand sides share reading the panels
_FEW = 16  # right-hand sides up to which a launch is cached: packing its arguments is a third of a solve

# Both sweeps for all right-hand sides. Four rows of a panel are read and converted once for up to four
# right-hand sides; the sums of one do not depend on the others.
_SWEEPS = """
    typedef float narrow __attribute__((vector_size(32), aligned(4)));
    typedef double lanes __attribute__((vector_size(64), aligned(8)));
    #define WIDE(x) __builtin_convertvector(x, lanes)
    #define TOTAL(x) (((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7])))
    struct One { enum { sides = 1 }; };
    struct Two { enum { sides = 2 }; };
    struct Four { enum { sides = 4 }; };
    const int nfront = front.shape[0], nrhs = work.shape[0];
    const long long stride = work.shape[1];

    auto up = [&](const int* f, double* first, auto number) {
        constexpr int R = decltype(number)::sides;
        const int at = f[0], a = f[1], b = f[2];
        const int* rows = row.data + f[3];
        const int n = (a + b + 7) / 8, m = (b + 7) / 8;
        const narrow* p = (const narrow*)(panel.data + (long long)f[4]);
        double* w[R];
        lanes* t[R];
        bool none = true;
        for (int r = 0; r < R; ++r) {
            w[r] = first + r * stride;
            t[r] = (lanes*)(w[r] + size);
            for (int j = 0; j < a; ++j) none = none && w[r][at + j] == 0.0;
        }
        if (none) return;
        for (int r = 0; r < R; ++r)
            for (int i = 0; i < m; ++i) t[r][i] = lanes{};
        int j = 0;
        for (; j + 4 <= a; j += 4) {
            const narrow *p0 = p + j * n, *p1 = p0 + n, *p2 = p1 + n, *p3 = p2 + n;
            double s[R][4];
            #pragma unroll
            for (int r = 0; r < R; ++r) {
                const double* load = w[r] + at + j;
                s[r][0] = load[0], s[r][1] = load[1], s[r][2] = load[2], s[r][3] = load[3];
            }
            for (int i = 0; i < m; ++i) {
                const lanes c0 = WIDE(p0[i]), c1 = WIDE(p1[i]), c2 = WIDE(p2[i]), c3 = WIDE(p3[i]);
                #pragma unroll
                for (int r = 0; r < R; ++r)
                    t[r][i] = s[r][0] * c0 + (s[r][1] * c1 + (s[r][2] * c2 + (s[r][3] * c3 + t[r][i])));
            }
        }
        for (; j < a; ++j) {
            const narrow* c = p + j * n;
            for (int r = 0; r < R; ++r) {
                const double s = w[r][at + j];
                for (int i = 0; i < m; ++i) t[r][i] += s * WIDE(c[i]);
            }
        }
        for (int r = 0; r < R; ++r) {
            const double* sum = (const double*)t[r];
            for (int i = 0; i < b; ++i) w[r][rows[i]] -= sum[i];
        }
    };
    auto down = [&](const int* f, double* first, auto number) {
        constexpr int R = decltype(number)::sides;
        const int at = f[0], a = f[1], b = f[2];
        const int* rows = row.data + f[3];
        const int n = (a + b + 7) / 8;
        const narrow* p = (const narrow*)(panel.data + (long long)f[4]);
        double* w[R];
        const lanes* t[R];
        for (int r = 0; r < R; ++r) {
            w[r] = first + r * stride;
            double* value = w[r] + size;
            for (int i = 0; i < b; ++i) value[i] = -w[r][rows[i]];
            for (int i = 0; i < a; ++i) value[b + i] = w[r][at + i];
            for (int i = a + b; i < 8 * n; ++i) value[i] = 0.0;
            t[r] = (const lanes*)value;
        }
        for (int j = 0; j < a; j += 4) {
            const int some = a - j < 4 ? a - j : 4;
            const narrow* p0 = p + j * n;
            const narrow* p1 = some > 1 ? p0 + n : p0;
            const narrow *p2 = some > 2 ? p0 + 2 * n : p0, *p3 = some > 3 ? p0 + 3 * n : p0;
            lanes s[R][4];
            #pragma unroll
            for (int r = 0; r < R; ++r) s[r][0] = s[r][1] = s[r][2] = s[r][3] = lanes{};
            for (int i = 0; i < n; ++i) {
                const lanes c0 = WIDE(p0[i]), c1 = WIDE(p1[i]), c2 = WIDE(p2[i]), c3 = WIDE(p3[i]);
                #pragma unroll
                for (int r = 0; r < R; ++r) {
                    const lanes v = t[r][i];
                    s[r][0] += c0 * v;
                    s[r][1] += c1 * v;
                    s[r][2] += c2 * v;
                    s[r][3] += c3 * v;
                }
            }
            #pragma unroll
            for (int r = 0; r < R; ++r) {
                double* out = w[r] + at + j;
                out[0] = TOTAL(s[r][0]);
                if (some > 1) out[1] = TOTAL(s[r][1]);
                if (some > 2) out[2] = TOTAL(s[r][2]);
                if (some > 3) out[3] = TOTAL(s[r][3]);
            }
        }
    };
    #define FOR_SIDES(sweep, k) \\
        for (int r = 0; r < nrhs;) { \\
            const int* f = front.data + 5 * (k); \\
            double* w = work.data + r * stride; \\
            if (nrhs - r >= 4) { sweep(f, w, Four()); r += 4; } \\
            else if (nrhs - r >= 2) { sweep(f, w, Two()); r += 2; } \\
            else { sweep(f, w, One()); r += 1; } \\
        }
    for (int k = 0; k < nfront; ++k) FOR_SIDES(up, k)
    for (int k = nfront - 1; k >= 0; --k) FOR_SIDES(down, k)
    #undef FOR_SIDES
    #undef TOTAL
    #undef WIDE
"""


@wp.func_native(_SWEEPS)
def sweeps(
    size: int,
    front: wp.array2d(dtype=int),
    row: wp.array(dtype=int),
    panel: wp.array(dtype=wp.float32),
    work: wp.array2d(dtype=wp.float64),
): ...


@wp.kernel
def substitute(
    # In:
    size: int,
    front: wp.array2d(dtype=int),
    row: wp.array(dtype=int),
    panel: wp.array(dtype=wp.float32),
    # In and out:
    work: wp.array2d(dtype=wp.float64),
):
    """Solves for the right-hand sides in the rows of `work`; entries after the first `size` are scratch."""
    sweeps(size, front, row, panel, work)


class Elimination:
    """Elimination order of a matrix and the pattern of its fronts; depends on the matrix's pattern only.

    Args:
      matrix: (3n, 3n) sparse, symmetric; three coordinates for each node.
      points: (n, 3) positions of the nodes.

    Attributes:
      order: (n,) nodes in the order of elimination.
      fronts: for each group its first coordinate, its last, the coordinates of its front that are eliminated
        later (b,), and the groups below it, all in the new order.
    """

    def __init__(self, matrix: sp.csc_matrix, points: np.ndarray):
        n = len(points)
        coo = matrix.tocoo()
        neighbours = sp.coo_matrix(
            (np.ones(len(coo.row), np.int8), (coo.row // 3, coo.col // 3)), shape=(n, n)
        ).tocsr()
        groups = dissect(neighbours, points)
        self.order = np.concatenate(groups)
        place = np.empty(n, int)
        place[self.order] = np.arange(n)
        ends = np.cumsum([len(g) for g in groups])
        owner = np.repeat(np.arange(len(groups)), np.diff(ends, prepend=0))  # group of each place
        later, below = [], [[] for _ in groups]
        for k, group in enumerate(groups):
            reached = [
                place[neighbours.indices[neighbours.indptr[v] : neighbours.indptr[v + 1]]] for v in group
            ]
            nodes = np.unique(np.concatenate(reached + [later[c] for c in below[k]]))
            later.append(nodes[nodes >= ends[k]])
            if len(later[k]):
                below[owner[later[k][0]]].append(k)
        self.fronts = [
            (3 * (end - len(group)), 3 * end, (3 * nodes[:, None] + np.arange(3)).ravel(), under)
            for group, end, nodes, under in zip(groups, ends.tolist(), later, below, strict=True)
        ]


_KEPT = 8  # a few MB each
_cached: dict[bytes, Elimination] = {}


def elimination_of(matrix: sp.csc_matrix, points: np.ndarray) -> Elimination:
    """The cached `Elimination` of a matrix. Skins of the same mesh share it, since it takes as long as a
    factor."""
    parts = (np.ascontiguousarray(x) for x in (matrix.indptr, matrix.indices, points))
    key = hashlib.sha256(b"".join(x.tobytes() for x in parts)).digest()
    found = _cached.get(key)
    if found is None:
        found = Elimination(matrix, points)
        while len(_cached) >= _KEPT:
            _cached.pop(next(iter(_cached)), None)
        _cached[key] = found
    return found


class SupernodalFactor:
    """Solves with a symmetric positive definite matrix (3n, 3n).

    Args:
      matrix: scipy sparse.
      elimination: of this matrix, or of one with the same pattern. Stored as an attribute.
      nodes: (n,) index of the matrix's nodes in right-hand sides.

    Raises:
      ValueError: the matrix is not positive definite.
    """

    def __init__(self, matrix: sp.csc_matrix, elimination: Elimination, nodes: np.ndarray):
        self.size, self.elimination = matrix.shape[0], elimination
        self._nodes = nodes[elimination.order]
        self._place = np.argsort(elimination.order)  # position of each node in the order
        self._index = np.full(nodes.max() + 1, -1)
        self._index[nodes] = np.arange(len(nodes))
        self._rows = {}
        self._answer = np.zeros(0, int)  # position of each node of the right-hand sides; the last: none
        where = (3 * elimination.order[:, None] + np.arange(3)).ravel()
        lower = sp.tril(matrix.tocsr()[where][:, where], format="csc")
        table, panels, rows, waiting = [], [], [], {}
        begin_panel = begin_row = 0
        for k, (begin, end, later, below) in enumerate(elimination.fronts):
            a, n = end - begin, end - begin + len(later)
            dofs = np.concatenate([np.arange(begin, end), later])
            front = np.zeros((n, n))
            entries = slice(lower.indptr[begin], lower.indptr[end])
            column = np.repeat(np.arange(a), np.diff(lower.indptr[begin : end + 1]))
            front[np.searchsorted(dofs, lower.indices[entries]), column] = lower.data[entries]
            for child in below:
                their, update = waiting.pop(child)
                there = np.searchsorted(dofs, their)
                front[np.ix_(there, there)] += update
            factor, trouble = lapack.dpotrf(front[:a, :a], lower=1)
            if trouble:
                raise ValueError(
                    "the stiffness is not positive definite: check for inverted elements, and for parts of "
                    "the skin without fixed nodes"
                )
            inverse = np.tril(lapack.dpotri(factor, lower=1)[0])
            inverse += np.tril(inverse, -1).T
            carry = front[a:, :a] @ inverse
            if n > a:
                waiting[k] = later, front[a:, a:] - carry @ front[a:, :a].T
            panel = np.zeros((a, -(-n // _LANES) * _LANES), np.float32)
            panel[:, : n - a], panel[:, n - a : n] = carry.T, inverse
            panels.append(panel.ravel())
            rows.append(later)
            table.append((begin, a, len(later), begin_row, begin_panel))
            begin_panel, begin_row = begin_panel + panel.size, begin_row + len(later)
        self._scratch = max(a + b for _, a, b, _, _ in table) + _LANES
        self._cached = threading.local()
        self._panels = [
            wp.array(np.array(table, np.int32), dtype=int, ndim=2, device="cpu"),
            wp.array(np.concatenate(rows).astype(np.int32), dtype=int, device="cpu"),
            wp.array(np.concatenate(panels), dtype=wp.float32, device="cpu"),
        ]

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Inverse times rhs: (nvert, nrhs, 3) -> the same shape. Rows that are not in `nodes` are ignored,
        and zero in the result."""
        nvert, nrhs = rhs.shape[:2]
        if len(self._answer) != nvert:
            answer = np.full(nvert, len(self._nodes))
            answer[self._nodes] = np.arange(len(self._nodes))
            self._answer = answer  # assigned when complete, since threads share a factor
        values, sweep = self._sides(nrhs)
        for side, value in enumerate(values):  # faster than indexing all sides at once
            np.take(rhs[:, side], self._nodes, 0, value[:-1], "clip")
        sweep()
        values[:, -1] = 0
        out = np.empty((nrhs, nvert, 3))
        for value, answer in zip(values, out):
            np.take(value, self._answer, 0, answer, "clip")
        return out.swapaxes(0, 1)

    def rows(self, nodes: np.ndarray) -> np.ndarray:
        """Rows of the inverse for nodes (k,) of right-hand sides: (3k, 3n) float32. They are cached."""
        index = self._index[nodes].tolist()
        missing = [i for i in index if i not in self._rows]
        for first in range(0, len(missing), _TOGETHER):
            some = missing[first : first + _TOGETHER]
            nrhs = 3 * len(some)
            values, sweep = self._sides(nrhs)
            values[...] = 0
            values[np.arange(nrhs), np.repeat(self._place[some], 3), np.arange(nrhs) % 3] = 1
            sweep()
            found = values.astype(np.float32)[:, self._place].reshape(-1, 3, self.size)
            self._rows.update(zip(some, found, strict=True))
        out = np.empty((len(index), 3, self.size), np.float32)
        for row, i in zip(out, index, strict=True):
            row[...] = self._rows[i]
        return out.reshape(-1, self.size)

    def dof(self, nodes: np.ndarray) -> np.ndarray:
        """Positions of the coordinates of nodes (k,) of right-hand sides in a row: (3k,)."""
        return (3 * self._index[nodes][:, None] + np.arange(3)).ravel()

    def _sides(self, nrhs):
        """Array of right-hand sides [side, node, 3], and the launch that replaces them by the answers; the
        entry after the last node is scratch."""
        cached = self._cached.__dict__
        if nrhs not in cached:
            work = np.zeros((nrhs, self.size + self._scratch))
            shared = wp.array(work, dtype=wp.float64, ndim=2, device="cpu", copy=False)
            inputs = [self.size, *self._panels, shared]
            made = work[:, : self.size + 3].reshape(nrhs, -1, 3), recorded(substitute, 1, inputs)
            if nrhs > _FEW:
                return made
            cached[nrhs] = made
        return cached[nrhs]
