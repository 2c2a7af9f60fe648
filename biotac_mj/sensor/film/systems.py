"""The film's linear system, its Laplacian A with the discs' weights W as further rows: Cholesky's method
leaves -W' A^-1 W. Direct, in double precision. CUDA has a band of tiles, a block of threads for each world.
The CPU has a sparse factor, with a twentieth of the band's products; on CUDA it takes twice as long as the
band, since its products wait for one another."""

import functools

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse.linalg import splu

from biotac_mj.geometry.design import MOST_DISCS
from biotac_mj.sensor.film.kernels import Network, driving_point, real

from ...kernels import kernel_module

TILE = MOST_DISCS  # rows of a tile, and columns of right-hand sides: the discs, padded
THREADS = 128  # of a block that solves a band
_AHEAD = 3  # numbers behind a world's last entry that are read


@wp.struct
class Pattern:
    """Where a world's system has its entries, by numbers of `make_band` or `make_factor`."""

    # of each entry: its place, that of its column's diagonal (-1: is not eliminated), its first slot and run
    entry: wp.array(dtype=wp.vec4i)
    slot: wp.array(dtype=int)  # numbers that sum to the entry, but for the sign of those beside the diagonal
    run: wp.array(dtype=wp.vec3i)  # products to subtract: places of the first factors, and how many
    disc: wp.array2d(dtype=int)  # place of each entry of -W' A^-1 W
    nblock: int  # tiles on the diagonal; 0: a sparse factor
    reach: int  # and beside each


def edges(face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (3 m,) of the edges opposite corners 0, 1, 2 of every face (m, 3)."""
    return np.roll(face, -1, axis=1).ravel(), np.roll(face, -2, axis=1).ravel()


def _terms(face, n, pair):
    """Row and column (k,) of each number that is summed to an entry, and its slot: of edges 3 face + corner,
    of the discs' weights 3 (m + pair) + corner, in row n + disc."""
    i, j = edges(face)
    which, over = pair
    # an entry on the diagonal sums all edges at its node; once more at node 0, which fixes the free constant:
    # no current flows through that, so the impedances do not depend on it
    first, own = np.arange(len(i)), np.flatnonzero((i == 0) | (j == 0))
    row = np.concatenate([i, i, j, np.zeros(len(own), int), np.repeat(n + which, 3)])
    column = np.concatenate([j, i, j, np.zeros(len(own), int), face[over].ravel()])
    return row, column, np.concatenate([first, first, first, own, len(i) + np.arange(3 * len(over))])


def make_band(face: np.ndarray, n: int, pair: tuple, ndisc: int) -> tuple[dict, int]:
    """Fields of `Pattern`, and the size of a world's system: tiles of the band, of which the lower ones are
    stored transposed under their column's diagonal; right-hand sides, one row per node and one column per
    disc; the result. A system is zero but for the result before its entries are written, and afterwards.

    Args:
      face: (m, 3) of nodes in an order of small bandwidth. n: nodes. pair: disc and face (k,) each of those
        that may lie over each other. ndisc: number of discs.
    """
    row, column, slot = _terms(face, n, pair)
    low, high = np.minimum(row, column), np.maximum(row, column)
    keys, number = np.unique(low * (n + ndisc) + high, return_inverse=True)
    low, high = keys // (n + ndisc), keys % (n + ndisc)
    nblock, of_node = -(-n // TILE), high < n
    reach = max(int((high // TILE - low // TILE)[of_node].max()), 1)
    rhs, size = nblock * (reach + 1) * TILE * TILE, TILE * TILE
    down = low // TILE * (reach + 1) + np.where(of_node, high // TILE - low // TILE, 0)
    place = np.where(of_node, (down * TILE + low % TILE) * TILE + high % TILE, rhs + low * TILE + high - n)
    sort, every = np.argsort(number, kind="stable"), np.arange(len(keys) + 1)
    first = np.searchsorted(number[sort], every)
    # Cholesky's factor of a diagonal tile also needs its lower triangle
    within = np.flatnonzero(of_node & (high // TILE == low // TILE) & (low != high))
    lower = (down * TILE + high % TILE) * TILE + low % TILE
    length = np.diff(first)
    takes = np.concatenate([np.arange(len(keys)), within])
    padding = np.arange(n, nblock * TILE)
    padding = (padding // TILE * (reach + 1) * TILE + padding % TILE) * TILE + padding % TILE
    places = np.concatenate([place, lower[within], padding])
    pivot = np.where(np.concatenate([low == high, np.zeros(len(within), bool), padding >= 0]), places, -1)
    slots = np.concatenate([np.arange(first[e], first[e + 1]) for e in takes])
    firsts = np.cumsum([0, *length[takes], *np.zeros(len(padding), int)])
    entry = [np.append(places, 0), np.append(pivot, 0), firsts, np.zeros(len(firsts), int)]
    result = rhs + nblock * size
    return {
        "entry": np.stack(entry, axis=1),
        "slot": slot[sort][slots],
        "run": np.zeros((0, 3), int),
        "disc": result + TILE * np.arange(ndisc)[:, None] + np.arange(ndisc),
        "nblock": nblock,
        "reach": reach,
    }, result + size


def make_factor(face: np.ndarray, n: int, pair: tuple, ndisc: int) -> tuple[dict, int]:
    """As `make_band`: the entries of the sparse factor, column by column in minimum-degree order. A world
    keeps them row by row, so that what is multiplied lies side by side."""
    row, column, slot = _terms(face, n, pair)
    place = np.arange(n + ndisc)
    place[_minimum_degree(row[row < n], column[row < n], n)] = np.arange(n)
    low, high = np.minimum(place[row], place[column]), np.maximum(place[row], place[column])
    a, b = np.tril_indices(ndisc)
    start, rows = _fill(np.concatenate([low, n + b]), np.concatenate([high, n + a]), n + ndisc)
    columns, number = np.repeat(np.arange(n + ndisc), np.diff(start)), np.full((n + ndisc, n + ndisc), -1)
    number[rows, columns] = np.arange(len(rows))
    at = np.empty(len(rows), int)
    at[np.lexsort((columns, rows))] = np.arange(len(rows))
    pivot = np.where(columns < n, at[start[columns]], -1)

    # the entry (high, low) loses the product of the entries of both rows in each column that has both
    changed, left, right = [], [], []
    triangle = functools.cache(np.tril_indices)
    for k in range(n):
        below = slice(start[k] + 1, start[k + 1])
        a, b = triangle(int(start[k + 1] - start[k] - 1))
        changed.append(number[rows[below][a], rows[below][b]])
        left.append(at[below][a])
        right.append(at[below][b])
    changed, left, right = (np.concatenate(one) for one in (changed, left, right))
    sort = np.argsort(changed.astype(np.int64) * len(rows) + right)
    changed, left, right = changed[sort], left[sort], right[sort]
    begins = (np.diff(changed, prepend=-1) != 0) | (np.diff(left, prepend=-1) != 1)
    begins = np.flatnonzero(begins | (np.diff(right, prepend=-1) != 1))
    length = np.diff(begins, append=len(changed))

    owner = number[high, low]
    sort, every = np.argsort(owner, kind="stable"), np.arange(len(rows) + 1)
    firsts = np.searchsorted(owner[sort], every), np.searchsorted(changed[begins], every)
    return {
        "entry": np.stack([np.append(at, 0), np.append(pivot, 0), *firsts], axis=1),
        "slot": slot[sort],
        "run": np.stack([left[begins], right[begins], length], axis=1),
        "disc": at[np.maximum(number[n:, n:], number[n:, n:].T)],
        "nblock": 0,
        "reach": 0,
    }, len(rows) + _AHEAD


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


# By one thread. Products are taken four at a time; of those behind a run none is kept. A pivot that is not
# positive leaves nan, which marks the film invalid.
_ELIMINATE = """
#if !defined(__CUDA_ARCH__)
    typedef double quad __attribute__((vector_size(32), aligned(8)));
    typedef long long bits __attribute__((vector_size(32), aligned(8)));
    static const long long kept[8] = {-1, -1, -1, -1, 0, 0, 0, 0};
    const double* summand = given.data + world;
    const long long apart = given.shape[1];
    double* value = system.data + (long long)world * system.shape[1];
    for (int e = 0; e + 1 < entry.shape[0]; ++e) {
        const auto own = entry.data[e], next = entry.data[e + 1];
        const int place = own.c[0], pivot = own.c[1];
        double sum = 0.0;
        for (int k = own.c[2]; k < next.c[2]; ++k) sum += summand[slot.data[k] * apart];
        if (place != pivot) sum = -sum;
        quad four = {};
        for (int r = own.c[3]; r < next.c[3]; ++r) {
            const auto at = run.data[r];
            const double *a = value + at.c[0], *b = value + at.c[1];
            int k = 0;
            for (; k + 4 <= at.c[2]; k += 4) four -= *(const quad*)(a + k) * *(const quad*)(b + k);
            const quad rest = *(const quad*)(a + k) * *(const quad*)(b + k);
            four -= (quad)((bits)rest & *(const bits*)(kept + 4 - (at.c[2] - k)));
        }
        sum += (four[0] + four[1]) + (four[2] + four[3]);
        value[place] = place == pivot ? 1.0 / sqrt(sum) : pivot < 0 ? sum : sum * value[pivot];
    }
#endif
"""


@wp.func_native(_ELIMINATE)
def _eliminate(
    world: int,
    entry: wp.array(dtype=wp.vec4i),
    slot: wp.array(dtype=int),
    run: wp.array(dtype=wp.vec3i),
    given: wp.array2d(dtype=real),
    system: wp.array2d(dtype=real),
): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def _synchronize(): ...


# For each tile along the diagonal: factor the tile, solve for the tiles right of it and its right-hand
# sides, update the tiles further on, and leave zeros. One thread block per world on CUDA, one thread
# elsewhere. Warp's own tiles do the same, but take CUDA over a minute to compile. A pivot that is not
# positive leaves nan, which marks the film invalid. On CUDA one warp factors a tile, one row per lane in
# registers: a block would wait at two barriers for each column. Products use tensor cores, which have
# double precision from sm_80 on.
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
    double* base = system.data + (long long)world * system.shape[1];
    double* rhs = base + (long long)nblock * (reach + 1) * size;
    double* out = rhs + (long long)nblock * size;
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
                const double pivot = rsqrt(__shfl_sync(0xffffffffu, own[c], c));
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
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
                // a quarter for each of four warps, by eight rows and columns: four lanes have a row of the
                // first factor, and two neighbours in one of the result
                const int lane = t & 31, far = lane / 4, near = lane & 3;
                const int row = t / 64 * 16 + far, column = t / 32 % 2 * 16;
                double sum[2][2][2] = {}, before[2][2][2];
                #pragma unroll
                for (int m = 0; m < 2; ++m)
                    #pragma unroll
                    for (int n = 0; n < 2; ++n)
                        #pragma unroll
                        for (int b = 0; b < 2; ++b)
                            before[m][n][b] = target[(row + 8 * m) * TILE + column + 8 * n + 2 * near + b];
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
                    for (int n = 0; n < 2; ++n)
                        #pragma unroll
                        for (int b = 0; b < 2; ++b)
                            target[(row + 8 * m) * TILE + column + 8 * n + 2 * near + b] =
                                before[m][n][b] - sum[m][n][b];
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
                    for (int b = 0; b < 8; ++b) target[(r + b) * TILE + c] -= sum[b];
                }
#endif
            }
        TOGETHER
        for (int i = t; i < (beside + 1) * size; i += threads) first[i] = 0.0;
        for (int i = t; i < size; i += threads) rhs[(long long)k * size + i] = 0.0;
    }
    TOGETHER
    #undef SHARED
    #undef TOGETHER
""".replace("THREADS", str(THREADS))
    .replace("TILE", str(TILE))
    .replace("PITCH", str(TILE + 4))
)


@wp.func_native(_SOLVE_BAND)
def _eliminate_band(world: int, nblock: int, reach: int, system: wp.array2d(dtype=real)): ...


# launched with its own block size: in this module all kernels would be compiled for both sizes
@wp.kernel(module=kernel_module(f"{__name__}.solve_sheet"), launch_bounds=(THREADS, 4))
def solve_sheet(
    # In:
    due: wp.array(dtype=int),
    conductivity: real,
    network: Network,
    pattern: Pattern,
    cell_constant: wp.array2d(dtype=real),
    given: wp.array2d(dtype=real),
    local: wp.array2d(dtype=real),
    # Out:
    system_out: wp.array2d(dtype=real),
    trial_out: wp.array2d(dtype=real),
    impedance_out: wp.array2d(dtype=real),
    valid_out: wp.array(dtype=int),
):
    """Impedances [world, electrode], by a block of threads. If the film cannot be solved, the last values
    stay."""
    w, t = wp.tid()
    if due[w] == 0:
        return
    threads = wp.block_dim()
    if pattern.nblock == 0:
        _eliminate(w, pattern.entry, pattern.slot, pattern.run, given, system_out)
    else:
        for e in range(t, pattern.entry.shape[0] - 1, threads):
            own = pattern.entry[e]
            end = pattern.entry[e + 1][2]
            total = real(0.0)
            for k in range(own[2], end):
                total += given[pattern.slot[k], w]
            if own[2] == end:  # padding
                total = real(1.0)
            system_out[w, own[0]] = wp.where(own[0] == own[1], total, -total)
        _eliminate_band(w, pattern.nblock, pattern.reach, system_out)
    for e in range(t, trial_out.shape[1], threads):
        trial_out[w, e] = cell_constant[w % cell_constant.shape[0], e] * driving_point(
            e, w, trial_out.shape[1], pattern.disc, system_out, local, network, conductivity
        )
    _synchronize()
    if t == 0:
        valid = int(1)
        for e in range(trial_out.shape[1]):
            if not (trial_out[w, e] > real(0.0) and trial_out[w, e] < real(1.0e12)):
                valid = 0
        if valid == 1:
            for e in range(trial_out.shape[1]):
                impedance_out[w, e] = trial_out[w, e]
        valid_out[w] = valid
