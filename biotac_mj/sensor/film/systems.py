"""The film's linear system: its Laplacian A with the discs' weights W as further rows, eliminated by
Cholesky's method down to -W' A^-1 W. Direct, in double precision. The pattern and the order of elimination
are those of the skin's mesh: all worlds share them."""

import functools

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse.linalg import splu

from biotac_mj.sensor.film.kernels import (
    Discs,
    Network,
    driving_point,
    face_conductance,
    real,
    samples_over,
    vec3,
    weights_over,
)

__all__ = ["AHEAD", "THREADS", "Pattern", "edges", "make_pattern", "solve_sheet"]

wp.set_module_options({"enable_backward": False})

THREADS = 512  # of the block that solves a world's film
AHEAD = 3  # numbers behind a world's last entry that are read
_LANES = 8  # that sum an entry on CUDA


@wp.struct
class Pattern:
    """Entries of the factor, column by column in the order of elimination. A world keeps them row by row, so
    that what is multiplied lies side by side.

    Columns of one level do not change each other. The last level has the discs' rows among themselves.
    """

    level: wp.array(dtype=int)  # first entry of each level
    # of each entry: its place, that of its column's diagonal (-1: is not eliminated), its first slot and run
    entry: wp.array(dtype=wp.vec4i)
    slot: wp.array(dtype=int)  # numbers that sum to the entry, but for the sign of those beside the diagonal
    run: wp.array(dtype=wp.vec3i)  # products to subtract: places of the first factors, and how many
    disc: wp.array2d(dtype=int)  # place of each entry of -W' A^-1 W


def edges(face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (3 m,) of the edges opposite corners 0, 1, 2 of every face (m, 3)."""
    return np.roll(face, -1, axis=1).ravel(), np.roll(face, -2, axis=1).ravel()


def make_pattern(face: np.ndarray, n: int, pair: tuple[np.ndarray, np.ndarray], ndisc: int) -> dict:
    """Arrays of `Pattern`.

    Args:
      face: (m, 3) of nodes. n: nodes. pair: disc and face (k,) each of those that may lie over each other.
      ndisc: number of discs.

    Slots of edges are 3 face + corner, those of the discs' weights 3 (m + k) + corner.
    """
    i, j = edges(face)
    which, over = pair
    # an entry on the diagonal sums all edges at its node; once more at node 0, which fixes the free constant:
    # no current flows through that, so the impedances do not depend on it
    first, own = np.arange(len(i)), np.flatnonzero((i == 0) | (j == 0))
    row = np.concatenate([i, i, j, np.zeros(len(own), int), np.repeat(n + which, 3)])
    column = np.concatenate([j, i, j, np.zeros(len(own), int), face[over].ravel()])
    slot = np.concatenate([first, first, first, own, len(i) + np.arange(3 * len(over))])

    place = np.arange(n + ndisc)
    place[_minimum_degree(row[row < n], column[row < n], n)] = np.arange(n)
    low, high = np.minimum(place[row], place[column]), np.maximum(place[row], place[column])
    a, b = np.tril_indices(ndisc)
    start, rows = _fill(np.concatenate([low, n + b]), np.concatenate([high, n + a]), n + ndisc)
    columns = np.repeat(np.arange(n + ndisc), np.diff(start))

    # a column's parent is the first row below its diagonal; leaves are of level 0
    level = np.zeros(n + ndisc, int)
    for k in range(n):
        parent = rows[start[k] + 1]
        level[parent] = max(level[parent], level[k] + 1)
    level[n:] = level.max()

    order = np.lexsort((rows, columns, level[columns]))
    number = np.full((n + ndisc, n + ndisc), -1)
    number[rows[order], columns[order]] = np.arange(len(rows))
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
    entry = [np.append(at[order], 0), np.append(pivot[order], 0), *firsts]
    return {
        "level": np.append(np.searchsorted(level[columns[order]], np.arange(level.max() + 1)), len(rows)),
        "entry": np.stack(entry, axis=1),
        "slot": slot[sort],
        "run": np.stack([left[begins], right[begins], length], axis=1),
        "disc": at[order][np.maximum(number[n:, n:], number[n:, n:].T)],
    }


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


# An entry is summed by some lanes of a warp on CUDA, where a world is a block of threads, else by one thread.
# The CPU takes four products at a time, of the last ones those that are kept: rows have `AHEAD` more numbers.
# A pivot that is not positive leaves nan, which marks the film invalid.
_ELIMINATE = """
#if defined(__CUDA_ARCH__)
    const int lanes = LANES, thread = threadIdx.x, threads = blockDim.x;
#else
    typedef double quad __attribute__((vector_size(32), aligned(8)));
    typedef long long bits __attribute__((vector_size(32), aligned(8)));
    static const long long kept[8] = {-1, -1, -1, -1, 0, 0, 0, 0};
    const int lanes = 1, thread = 0, threads = 1;
#endif
    const double* summand = given.data + (long long)world * given.shape[1];
    double* value = factor.data + (long long)world * factor.shape[1];
    const int part = thread % lanes, together = threads / lanes;
    for (int l = 0; l + 1 < level.shape[0]; ++l) {
        const int begin = level.data[l], end = level.data[l + 1];
        for (int first = begin; first < end; first += together) {
            const int e = first + thread / lanes;
            double sum = 0.0;
            int place = 0, pivot = 0;
            if (e < end) {
                const auto own = entry.data[e], next = entry.data[e + 1];
                place = own.c[0];
                pivot = own.c[1];
                for (int k = own.c[2] + part; k < next.c[2]; k += lanes) sum += summand[slot.data[k]];
                if (place != pivot) sum = -sum;
#if !defined(__CUDA_ARCH__)
                quad four = {};
#endif
                for (int r = own.c[3]; r < next.c[3]; ++r) {
                    const auto at = run.data[r];
                    const double *a = value + at.c[0], *b = value + at.c[1];
#if defined(__CUDA_ARCH__)
                    for (int k = part; k < at.c[2]; k += lanes) sum -= a[k] * b[k];
#else
                    int k = 0;
                    for (; k + 4 <= at.c[2]; k += 4) four -= *(const quad*)(a + k) * *(const quad*)(b + k);
                    const quad rest = *(const quad*)(a + k) * *(const quad*)(b + k);
                    four -= (quad)((bits)rest & *(const bits*)(kept + 4 - (at.c[2] - k)));
#endif
                }
#if !defined(__CUDA_ARCH__)
                sum += (four[0] + four[1]) + (four[2] + four[3]);
#endif
            }
#if defined(__CUDA_ARCH__)
            for (int far = lanes / 2; far > 0; far /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, far);
#else
            if (place != pivot && pivot >= 0) sum *= value[pivot];
#endif
            if (e < end && part == 0) value[place] = place == pivot ? 1.0 / sqrt(sum) : sum;
        }
#if defined(__CUDA_ARCH__)
        __syncthreads();
        for (int e = begin + thread; e < end; e += threads) {
            const auto own = entry.data[e];
            if (own.c[0] != own.c[1] && own.c[1] >= 0) value[own.c[0]] *= value[own.c[1]];
        }
        __syncthreads();
#endif
    }
""".replace("LANES", str(_LANES))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def _together(): ...


@wp.func_native(_ELIMINATE)
def _eliminate(
    world: int,
    level: wp.array(dtype=int),
    entry: wp.array(dtype=wp.vec4i),
    slot: wp.array(dtype=int),
    run: wp.array(dtype=wp.vec3i),
    given: wp.array2d(dtype=real),
    factor: wp.array2d(dtype=real),
): ...


# launched with its own block size: in this module all kernels would be compiled for both sizes
@wp.kernel(module="unique", enable_backward=False, launch_bounds=(THREADS, 2))
def solve_sheet(
    # In:
    due: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    conductivity: real,
    discs: Discs,
    network: Network,
    pattern: Pattern,
    cell_constant: wp.array2d(dtype=real),
    middle: wp.array2d(dtype=vec3),
    thickness: wp.array2d(dtype=real),
    # Out:
    given_out: wp.array2d(dtype=real),
    over_out: wp.array2d(dtype=int),
    local_out: wp.array2d(dtype=real),
    factor_out: wp.array2d(dtype=real),
    trial_out: wp.array2d(dtype=real),
    impedance_out: wp.array2d(dtype=real),
    valid_out: wp.array(dtype=int),
):
    """Impedances of a film whose surface is known, [world, electrode], by a block of threads; if the film
    cannot be solved, the last values stay."""
    w, t = wp.tid()
    if due[w] == 0:
        return
    threads = wp.block_dim()
    nface = face.shape[0]
    for f in range(t, nface, threads):
        edge = face_conductance(face[f], w, conductivity, middle, thickness)
        for c in range(3):
            given_out[w, 3 * f + c] = edge[c]
    for k in range(t, discs.pair_face.shape[0], threads):
        over_out[w, k] = samples_over(k, w, discs, face, middle)
    _together()
    for k in range(t, discs.pair_face.shape[0], threads):
        weights = weights_over(k, w, discs, face, middle, over_out)
        for c in range(3):
            given_out[w, 3 * (nface + k) + c] = weights[c]
    _together()
    for e in range(t, local_out.shape[0], threads):
        local = real(0.0)  # of a disc that no film is over
        for k in range(discs.pair_start[e], discs.pair_start[e + 1]):
            if over_out[w, k] != 0:  # where a corner is not finite the face is over no sample
                corner = face[discs.pair_face[k]]
                for c in range(3):
                    local += given_out[w, 3 * (nface + k) + c] * thickness[corner[c], w]
        local_out[e, w] = local
    _eliminate(w, pattern.level, pattern.entry, pattern.slot, pattern.run, given_out, factor_out)
    for e in range(t, trial_out.shape[1], threads):
        trial_out[w, e] = cell_constant[w % cell_constant.shape[0], e] * driving_point(
            e, w, trial_out.shape[1], pattern.disc, factor_out, local_out, network, conductivity
        )
    _together()
    if t == 0:
        valid = int(1)
        for e in range(trial_out.shape[1]):
            if not (trial_out[w, e] > real(0.0) and trial_out[w, e] < real(1.0e12)):
                valid = 0
        if valid == 1:
            for e in range(trial_out.shape[1]):
                impedance_out[w, e] = trial_out[w, e]
        valid_out[w] = valid
