"""Multifrontal factor of a symmetric positive definite sparse matrix, made for many fast solves on one core.

Groups of nodes are eliminated together (`dissection`), each with a dense front: A within the group, B to what
is eliminated later, both after what was eliminated before has been added in (Duff and Reid 1983). S = A^-1
and C = B S are kept. A solve is  b_later -= C b  up the tree and  x = S b - C^T x_later  down it: products
with dense panels, nothing else. Panels are kept in single precision, which halves what a solve reads, and
reading is what it takes; all sums are in double. The operator stays linear and symmetric to double precision,
and differs from the inverse by 1e-6 in the energy norm (2e-5 at a Poisson's ratio of 0.4999)."""

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import lapack

from .dissection import dissect

__all__ = ["Elimination", "SupernodalFactor"]

wp.set_module_options({"enable_backward": False})

_LANES = (
    8  # numbers that are multiplied at once; rows of panels are filled up with zeros to whole groups of them
)

# both sweeps for all right-hand sides; four rows of a panel at a time
_SWEEPS = """
    typedef float narrow __attribute__((vector_size(32), aligned(4)));
    typedef double lanes __attribute__((vector_size(64), aligned(8)));
    #define WIDE(x) __builtin_convertvector(x, lanes)
    const int nfront = front.shape[0], nrhs = work.shape[0];
    const long long stride = work.shape[1];
    for (int k = 0; k < nfront; ++k) {
        const int* f = front.data + 5 * k;
        const int at = f[0], a = f[1], b = f[2];
        const int* rows = row.data + f[3];
        const int n = (a + b + 7) / 8, m = (b + 7) / 8;
        const narrow* p = (const narrow*)(panel.data + (long long)f[4]);
        for (int r = 0; r < nrhs; ++r) {
            double* w = work.data + r * stride;
            lanes* t = (lanes*)(w + size);
            bool none = true;
            for (int j = 0; j < a; ++j) none = none && w[at + j] == 0.0;
            if (none) continue;
            for (int i = 0; i < m; ++i) t[i] = lanes{};
            int j = 0;
            for (; j + 4 <= a; j += 4) {
                const narrow *c0 = p + j * n, *c1 = c0 + n, *c2 = c1 + n, *c3 = c2 + n;
                const double s0 = w[at + j], s1 = w[at + j + 1], s2 = w[at + j + 2], s3 = w[at + j + 3];
                for (int i = 0; i < m; ++i)
                    t[i] += (s0 * WIDE(c0[i]) + s1 * WIDE(c1[i])) + (s2 * WIDE(c2[i]) + s3 * WIDE(c3[i]));
            }
            for (; j < a; ++j) {
                const narrow* c = p + j * n;
                const double s = w[at + j];
                for (int i = 0; i < m; ++i) t[i] += s * WIDE(c[i]);
            }
            const double* sum = (const double*)t;
            for (int i = 0; i < b; ++i) w[rows[i]] -= sum[i];
        }
    }
    for (int k = nfront - 1; k >= 0; --k) {
        const int* f = front.data + 5 * k;
        const int at = f[0], a = f[1], b = f[2];
        const int* rows = row.data + f[3];
        const int n = (a + b + 7) / 8;
        const narrow* p = (const narrow*)(panel.data + (long long)f[4]);
        for (int r = 0; r < nrhs; ++r) {
            double* w = work.data + r * stride;
            double* value = w + size;
            for (int i = 0; i < b; ++i) value[i] = -w[rows[i]];
            for (int i = 0; i < a; ++i) value[b + i] = w[at + i];
            for (int i = a + b; i < 8 * n; ++i) value[i] = 0.0;
            const lanes* t = (const lanes*)value;
            for (int j = 0; j < a; j += 4) {
                const int some = a - j < 4 ? a - j : 4;
                const narrow* c0 = p + j * n;
                const narrow* c1 = some > 1 ? c0 + n : c0;
                const narrow *c2 = some > 2 ? c0 + 2 * n : c0, *c3 = some > 3 ? c0 + 3 * n : c0;
                lanes s0 = {}, s1 = {}, s2 = {}, s3 = {};
                for (int i = 0; i < n; ++i) {
                    const lanes v = t[i];
                    s0 += WIDE(c0[i]) * v;
                    s1 += WIDE(c1[i]) * v;
                    s2 += WIDE(c2[i]) * v;
                    s3 += WIDE(c3[i]) * v;
                }
                const lanes* s[4] = {&s0, &s1, &s2, &s3};
                for (int q = 0; q < some; ++q) {
                    double total = 0.0;
                    for (int l = 0; l < 8; ++l) total += (*s[q])[l];
                    w[at + j + q] = total;
                }
            }
        }
    }
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
    """Solves for the right-hand sides in `work`, one in a row; behind its first `size` entries a row is
    scratch."""
    sweeps(size, front, row, panel, work)


class Elimination:
    """In which order a matrix is eliminated, and where its fronts have entries: of the pattern alone.

    Args:
      matrix: (3n, 3n) sparse, symmetric; three coordinates to a node.
      points: (n, 3) where the nodes are.

    Attributes:
      order: (n,) nodes in the order of elimination.
      fronts: for each group its first coordinate, its coordinates in the new order that are eliminated later
        (b,), and the groups below it.
    """

    def __init__(self, matrix: sp.csc_matrix, points: np.ndarray):
        n = len(points)
        coo = matrix.tocoo()
        near = sp.coo_matrix(
            (np.ones(len(coo.row), np.int8), (coo.row // 3, coo.col // 3)), shape=(n, n)
        ).tocsr()
        groups = dissect(near, points)
        self.order = np.concatenate(groups)
        place = np.empty(n, int)
        place[self.order] = np.arange(n)
        ends = np.cumsum([len(g) for g in groups])
        owner = np.repeat(np.arange(len(groups)), np.diff(ends, prepend=0))  # group of each place
        later, below = [], [[] for _ in groups]
        for k, group in enumerate(groups):
            reached = [place[near.indices[near.indptr[v] : near.indptr[v + 1]]] for v in group]
            nodes = np.unique(np.concatenate(reached + [later[c] for c in below[k]]))
            later.append(nodes[nodes >= ends[k]])
            if len(later[k]):
                below[owner[later[k][0]]].append(k)
        self.fronts = [
            (3 * (end - len(group)), 3 * end, (3 * nodes[:, None] + np.arange(3)).ravel(), under)
            for group, end, nodes, under in zip(groups, ends.tolist(), later, below, strict=True)
        ]


class SupernodalFactor:
    """Solves with a symmetric positive definite matrix (3n, 3n).

    Args:
      matrix: scipy sparse.
      elimination: made of this matrix, or of one with the same pattern.
      nodes: (n,) where the right-hand sides have the matrix's nodes.

    Raises:
      ValueError: the matrix is not positive definite.
    """

    def __init__(self, matrix: sp.csc_matrix, elimination: Elimination, nodes: np.ndarray):
        self.size, self._rows = matrix.shape[0], nodes[elimination.order]
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
                    "the stiffness is not positive definite: elements are inverted, or parts of the skin "
                    "are not held"
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
        self._panels = [
            wp.array(np.array(table, np.int32), dtype=int, ndim=2, device="cpu"),
            wp.array(np.concatenate(rows).astype(np.int32), dtype=int, device="cpu"),
            wp.array(np.concatenate(panels), dtype=wp.float32, device="cpu"),
        ]

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Inverse times rhs: (nvert, nrhs, 3) -> the same shape; rows that are none of `nodes` are not looked
        at, and zero."""
        nrhs = rhs.shape[1]
        work = np.zeros((nrhs, self.size + self._scratch))
        work[:, : self.size] = np.swapaxes(rhs[self._rows], 0, 1).reshape(nrhs, self.size)
        shared = wp.array(work, dtype=wp.float64, ndim=2, device="cpu", copy=False)
        wp.launch(substitute, dim=1, inputs=[self.size, *self._panels, shared], device="cpu")
        out = np.zeros(rhs.shape)
        out[self._rows] = np.swapaxes(work[:, : self.size].reshape(nrhs, -1, 3), 0, 1)
        return out
