"""Storage and solution of the film's Laplacian: a band of tiles, one thread block per world (CUDA), or a
sparse factor, one world after the other (CPU). Both are direct, in double precision, and give W' A^-1 W for
the discs W.

A layout gives the row and column of each entry of A in a world's system [row, TILE] (`entry`), the edges of
faces that each entry sums (`slot`, `start`, `sign`), and the first row of the right-hand sides, which have
one row per node and one column per disc (`rhs`)."""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse.linalg import splu

from biotac_mj.sensor.film.kernels import TILE, real

__all__ = ["BandLayout", "SparseLayout", "edges"]

wp.set_module_options({"enable_backward": False})

_LANES = 8  # SIMD width in numbers
_THREADS = 128  # of a block that solves a band


def edges(face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (3 m,) of the edges opposite corners 0, 1, 2 of every face (m, 3)."""
    return np.roll(face, -1, axis=1).ravel(), np.roll(face, -2, axis=1).ravel()


def _sums(face, n):
    """Entries of A: row <= column (nentry,) each, and for each the list of slots (3 face + corner) that it
    sums."""
    i, j = edges(face)
    low, high = np.minimum(i, j), np.maximum(i, j)
    # a diagonal entry sums all edges at its node
    keys = np.concatenate([low * (n + 1), high * (n + 1), low * n + high])
    used, number = np.unique(keys, return_inverse=True)
    order = np.argsort(number, kind="stable")
    slot = np.split(np.tile(np.arange(len(low)), 3)[order], np.cumsum(np.bincount(number))[:-1])
    return used // n, used % n, slot


class BandLayout:
    """Tiles of the band; the lower ones are stored transposed under their column's diagonal.

    Args:
      face: (m, 3) of nodes in an order of small bandwidth. n: nodes.

    Attributes:
      entry (nentry, 2): row and column in a world's system; entry 0 is the first diagonal. sign (nentry,),
        start (nentry + 1,), slot: edges of faces (3 face + corner) that each entry sums, none for padding.
      rhs: first row of the right-hand sides. rows: of the system in all.
    """

    def __init__(self, face: np.ndarray, n: int):
        row, column, slot = _sums(face, n)
        self._nblock = -(-n // TILE)
        self._reach = max(int((column // TILE - row // TILE).max()), 1)
        padding = np.arange(n, self._nblock * TILE)
        row, column = np.concatenate([row, padding]), np.concatenate([column, padding])
        slot += [np.zeros(0, int)] * len(padding)
        # Cholesky's factor of a diagonal tile also needs its lower triangle
        within = np.flatnonzero((column // TILE == row // TILE) & (row != column))
        row, column = np.concatenate([row, column[within]]), np.concatenate([column, row[within]])
        slot += [slot[k] for k in within]
        self.slot, self.start = np.concatenate(slot), np.cumsum([0, *map(len, slot)])
        self.sign = np.where(row == column, 1.0, -1.0)
        block, down = row // TILE, column // TILE - row // TILE
        self.entry = np.stack([(block * (self._reach + 1) + down) * TILE + row % TILE, column % TILE], axis=1)
        self.rhs = self._nblock * (self._reach + 1) * TILE
        self.rows = self.rhs + self._nblock * TILE

    def solve(self, launch: Callable, due: wp.array, system: wp.array, resistance: wp.array) -> None:
        """Resistance (nworld, TILE, TILE) of the worlds that are due; overwrites the system."""
        band = [due, self._nblock, self._reach, system]
        launch(solve_band, [system.shape[0]], band, [resistance], wp.launch_tiled, _THREADS)


class SparseLayout:
    """Columns of the sparse factor one after the other, in minimum-degree order, which needs a twentieth of
    the band's operations.

    Args:
      face, n: as for `BandLayout`. columns: number of right-hand sides.

    Attributes: as for `BandLayout`.
    """

    def __init__(self, face: np.ndarray, n: int, columns: int):
        row, column, slot = _sums(face, n)
        self._n, self._columns = n, columns
        self._order = _minimum_degree(row, column, n)
        place = np.empty(n, int)
        place[self._order] = np.arange(n)
        low, high = np.minimum(place[row], place[column]), np.maximum(place[row], place[column])
        self._start, self._row = _fill(low, high, n)
        key = np.repeat(np.arange(n), np.diff(self._start)) * n + self._row
        at = np.searchsorted(key, low * n + high)
        self.slot, self.start = np.concatenate(slot), np.cumsum([0, *map(len, slot)])
        self.sign = np.where(row == column, 1.0, -1.0)
        self.entry = np.stack([at // TILE, at % TILE], axis=1)
        self.rhs = -(-len(self._row) // TILE)
        self.rows = self.rhs + n + -(-n // TILE)  # and a column of scratch
        # entries left of the diagonal, row by row: their place in their column, and its end
        of = np.repeat(np.arange(n), np.diff(self._start))
        left = np.argsort(self._row, kind="stable")
        left = left[of[left] != self._row[left]]
        self._left_start = np.searchsorted(self._row[left], np.arange(n + 1))
        self._left = np.stack([left, self._start[of[left] + 1]], axis=1)
        self._kept = None

    def solve(self, launch: Callable, due: wp.array, system: wp.array, resistance: wp.array) -> None:
        """As `BandLayout.solve`, on the CPU."""
        if self._kept is None:
            lists = self._start, self._row, self._order[self._row], self._left_start
            with wp.ScopedDevice("cpu"):
                self._kept = [wp.array(a.astype(np.int32), dtype=int) for a in lists]
                self._kept.append(wp.array(self._left.astype(np.int32), dtype=wp.vec2i))
        sizes = [self._columns, self._n, self.rhs]
        launch(solve_sparse, system.shape[0], [due, *sizes, *self._kept, system], [resistance])


def _minimum_degree(row, column, n):
    """Elimination order of the nodes that SuperLU chooses for a matrix of this pattern."""
    both = np.concatenate([row, column]), np.concatenate([column, row])
    pattern = sp.coo_matrix((np.ones(len(both[0])), both), shape=(n, n)).tocsc()
    pattern.data[:] = -1.0
    dominant = pattern + sp.diags_array(2.0 * np.diff(pattern.indptr))
    lu = splu(
        sp.csc_matrix(dominant),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.argsort(lu.perm_c)


def _fill(low, high, n):
    """Sparsity pattern of the Cholesky factor of a matrix with entries at (high, low), by columns: start (n +
    1,), row (nnz,) with the diagonal first."""
    order = np.argsort(low, kind="stable")
    ends = np.searchsorted(low[order], np.arange(n + 1))
    columns, below = [], [[] for _ in range(n)]
    for j in range(n):
        own = [high[order[ends[j] : ends[j + 1]]], [j]]
        rows = np.unique(np.concatenate(own + [columns[k][1:] for k in below[j]]))
        columns.append(rows)
        if len(rows) > 1:
            below[rows[1]].append(j)
    return np.cumsum([0, *map(len, columns)]), np.concatenate(columns)


# For each tile along the diagonal: factor the tile, solve for the tiles right of it and its right-hand sides,
# and update the tiles further on. One thread block per world on CUDA, one thread elsewhere. Warp's own tiles
# do the same, but take CUDA over a minute to compile. A pivot that is not positive leaves nan, which marks
# the film invalid. On CUDA one warp factors a tile, one row per lane in registers: a block would wait at two
# barriers for each column. Products use tensor cores, which have double precision from sm_80 on.
_SOLVE_BAND = (
    """
#if defined(__CUDA_ARCH__)
    #define SHARED __shared__
    #define TOGETHER __syncthreads();
    const int t = threadIdx.x, threads = THREADS;
#else
    #define SHARED
    #define TOGETHER
    const int t = 0, threads = 1;
#endif
    const int size = TILE * TILE, kept = 4;
    // rows of tiles that are kept are so far apart that four of them lie in different banks
    SHARED double factor[TILE * PITCH], inverse[TILE], tile[kept][TILE * PITCH];
    double* base = system.data + (long long)world * system.shape[1] * TILE;
    double* rhs = base + (long long)nblock * (reach + 1) * size;
    double* out = resistance.data + (long long)world * size;
    for (int i = t; i < size; i += threads) out[i] = 0.0;
    for (int k = 0; k < nblock; ++k) {
        double* first = base + (long long)k * (reach + 1) * size;
        const int beside = reach < nblock - 1 - k ? reach : nblock - 1 - k;
        TOGETHER
        // factor[c][r] is the factor's entry (r, c)
#if defined(__CUDA_ARCH__)
        if (t < TILE) {
            double own[TILE];
            #pragma unroll
            for (int c = 0; c < TILE; ++c) own[c] = first[c * TILE + t];
            #pragma unroll
            for (int c = 0; c < TILE; ++c) {
                const double pivot = 1.0 / sqrt(__shfl_sync(0xffffffffu, own[c], c));
                const double entry = own[c] * pivot;
                factor[c * PITCH + t] = entry;
                if (t == c) inverse[c] = pivot;
                __syncwarp();
                #pragma unroll
                for (int d = c + 1; d < TILE; ++d) own[d] -= entry * factor[c * PITCH + d];
            }
        }
#else
        for (int c = 0; c < TILE; ++c) {
            const double pivot = 1.0 / sqrt(first[c * TILE + c]);
            inverse[c] = pivot;
            for (int r = c; r < TILE; ++r) factor[c * PITCH + r] = first[r * TILE + c] * pivot;
            for (int d = c + 1; d < TILE; ++d) {
                const double entry = factor[c * PITCH + d];
                for (int r = d; r < TILE; ++r) first[r * TILE + d] -= factor[c * PITCH + r] * entry;
            }
        }
#endif
        TOGETHER
        // a column of the right-hand sides, or of a tile beside, for each thread
        for (int i = t; i < (beside + 1) * TILE; i += threads) {
            const int which = i / TILE, c = i - which * TILE, apart = which < kept ? PITCH : TILE;
            double* source = which ? first + (long long)which * size : rhs + (long long)k * size;
            double* target = which < kept ? tile[which] : source;
            double y[TILE];
            #pragma unroll
            for (int a = 0; a < TILE; ++a) y[a] = source[a * TILE + c];
            #pragma unroll
            for (int a = 0; a < TILE; ++a) {
                y[a] *= inverse[a];
                #pragma unroll
                for (int b = a + 1; b < TILE; ++b) y[b] -= factor[a * PITCH + b] * y[a];
                target[a * apart + c] = y[a];
            }
        }
        TOGETHER
        for (int i = 0; i <= beside; ++i)
            for (int j = 0; j <= i; ++j) {
                const double* left = i < kept ? tile[i] : first + (long long)i * size;
                const double* right = j < kept ? tile[j] : first + (long long)j * size;
                int left_apart = i < kept ? PITCH : TILE, right_apart = j < kept ? PITCH : TILE;
                double* target = out;
                if (i > 0) {
                    target = rhs + (long long)(k + i) * size;
                    if (j > 0) {
                        target = base + ((long long)(k + j) * (reach + 1) + i - j) * size;
                        const double* other = left;
                        left = right;
                        right = other;
                        const int apart = left_apart;
                        left_apart = right_apart;
                        right_apart = apart;
                    }
                }
                const double sign = i > 0 ? -1.0 : 1.0;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
                // a quarter for each of four warps, by eight rows and columns: four lanes have a row of the
                // first factor, and two neighbours in one of the result
                const int lane = t & 31, far = lane / 4, near = lane & 3;
                const int row = t / 64 * 16 + far, column = t / 32 % 2 * 16;
                double sum[2][2][2] = {};
                #pragma unroll
                for (int a = near; a < TILE; a += 4)
                    #pragma unroll
                    for (int m = 0; m < 2; ++m)
                        #pragma unroll
                        for (int n = 0; n < 2; ++n) {
                            const double x = left[a * left_apart + row + 8 * m];
                            const double y = right[a * right_apart + column + far + 8 * n];
                            asm("mma.sync.aligned.m8n8k4.row.col.f64.f64.f64.f64 "
                                "{%0, %1}, {%2}, {%3}, {%0, %1};"
                                : "+d"(sum[m][n][0]), "+d"(sum[m][n][1]) : "d"(x), "d"(y));
                        }
                #pragma unroll
                for (int m = 0; m < 2; ++m)
                    #pragma unroll
                    for (int n = 0; n < 2; ++n) {
                        double* at = target + (row + 8 * m) * TILE + column + 8 * n + 2 * near;
                        at[0] += sign * sum[m][n][0];
                        at[1] += sign * sum[m][n][1];
                    }
#else
                for (int part = t; part < size / 8; part += threads) {
                    const int c = part & (TILE - 1), r = part / TILE * 8;
                    double sum[8] = {};
                    for (int a = 0; a < TILE; ++a) {
                        const double y = right[a * right_apart + c];
                        #pragma unroll
                        for (int b = 0; b < 8; ++b) sum[b] += left[a * left_apart + r + b] * y;
                    }
                    #pragma unroll
                    for (int b = 0; b < 8; ++b) target[(r + b) * TILE + c] += sign * sum[b];
                }
#endif
            }
        TOGETHER
    }
    #undef SHARED
    #undef TOGETHER
""".replace("THREADS", str(_THREADS))
    .replace("TILE", str(TILE))
    .replace("PITCH", str(TILE + 4))
)


@wp.func_native(_SOLVE_BAND)
def _eliminate_band(
    world: int, nblock: int, reach: int, system: wp.array3d(dtype=real), resistance: wp.array3d(dtype=real)
): ...


# launched with its own block size: in this module all kernels would be compiled for both sizes
@wp.kernel(module="unique", enable_backward=False)
def solve_band(
    # In:
    due: wp.array(dtype=int),
    nblock: int,
    reach: int,
    # In, out:
    system: wp.array3d(dtype=real),
    # Out:
    resistance: wp.array3d(dtype=real),
):
    """W' A^-1 W of the discs W by Cholesky's factor, one thread block per world; A has `reach` tiles beside
    the diagonal."""
    w, _t = wp.tid()
    if due[w] != 0:
        _eliminate_band(w, nblock, reach, system, resistance)


# For each column: subtract the updates of the columns left of it, scale by its pivot, then solve the
# right-hand sides of its node, which are complete by then. A pivot that is not positive leaves nan, which
# marks the film invalid.
_SOLVE = """
    const int width = WIDTH, parts = width / 8;
    double* value = system.data + (long long)world * system.shape[1] * tile;
    double* y = value + (long long)rhs * tile;
    double* work = y + (long long)n * tile;
    for (int j = 0; j < n; ++j) {
        const int begin = start.data[j], end = start.data[j + 1];
        for (int q = begin; q < end; ++q) work[row.data[q]] = value[q];
        for (int t = left_start.data[j]; t < left_start.data[j + 1]; ++t) {
            const int from = left.data[t].c[0], to = left.data[t].c[1];
            const double s = value[from];
            for (int q = from; q < to; ++q) work[row.data[q]] -= s * value[q];
        }
        const double pivot = 1.0 / sqrt(work[j]);
        value[begin] = pivot;
        double* own = y + node.data[begin] * tile;
        lanes v[parts];
        for (int i = 0; i < parts; ++i) {
            v[i] = pivot * ((lanes*)own)[i];
            ((lanes*)own)[i] = v[i];
        }
        for (int q = begin + 1; q < end; ++q) {
            const double s = value[q] = work[row.data[q]] * pivot;
            lanes* other = (lanes*)(y + node.data[q] * tile);
            for (int i = 0; i < parts; ++i) other[i] -= s * v[i];
        }
    }
    double* out = resistance.data + (long long)world * tile * tile;
    for (int a = 0; a < width; a += 8) {
        lanes sum[8][parts];
        for (int b = 0; b < 8; ++b)
            for (int i = 0; i < parts; ++i) sum[b][i] = lanes{};
        for (int k = 0; k < n; ++k) {
            const double* own = y + k * tile;
            #pragma unroll
            for (int b = 0; b < 8; ++b) {
                #pragma unroll
                for (int i = 0; i < parts; ++i) sum[b][i] += own[a + b] * ((const lanes*)own)[i];
            }
        }
        for (int b = 0; b < 8; ++b)
            for (int i = 0; i < parts; ++i) ((lanes*)(out + (a + b) * tile))[i] = sum[b][i];
    }
"""
# the discs are columns of right-hand sides: loops are compiled for each number of SIMD lanes
_SOLVE = "\n".join(
    [
        f"typedef double lanes __attribute__((vector_size(64), aligned(8)));\nconst int tile = {TILE};",
        *(
            f"if (columns > {width - _LANES} && columns <= {width}) {{{_SOLVE.replace('WIDTH', str(width))}}}"
            for width in range(_LANES, TILE + 1, _LANES)
        ),
    ]
)


@wp.func_native(_SOLVE)
def _eliminate(
    world: int,
    columns: int,
    n: int,
    rhs: int,
    start: wp.array(dtype=int),
    row: wp.array(dtype=int),
    node: wp.array(dtype=int),
    left_start: wp.array(dtype=int),
    left: wp.array(dtype=wp.vec2i),
    system: wp.array3d(dtype=real),
    resistance: wp.array3d(dtype=real),
): ...


@wp.kernel
def solve_sparse(
    # In:
    due: wp.array(dtype=int),
    columns: int,
    n: int,
    rhs: int,
    start: wp.array(dtype=int),
    row: wp.array(dtype=int),
    node: wp.array(dtype=int),
    left_start: wp.array(dtype=int),
    left: wp.array(dtype=wp.vec2i),
    # In, out:
    system: wp.array3d(dtype=real),
    # Out:
    resistance: wp.array3d(dtype=real),
):
    """W' A^-1 W of the discs W by Cholesky's sparse factor, one thread per world."""
    w = wp.tid()
    if due[w] != 0:
        _eliminate(w, columns, n, rhs, start, row, node, left_start, left, system, resistance)
