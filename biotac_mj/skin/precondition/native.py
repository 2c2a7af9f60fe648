"""CUDA code for what Warp's kernels cannot say: threads of a block that work on one small matrix together."""

import functools
import typing

import warp as wp

if typing.TYPE_CHECKING:
    from ..program import Launcher

__all__ = ["invert"]

wp.set_module_options({"enable_backward": False})

_THREADS = 512
_ROWS, _COLUMNS = (
    16,
    32,
)  # a block's threads as a grid: thread (r, c) holds the entries (r + 16 i, c + 32 j) in its registers

# Gauss-Jordan exchange with row pivots, see `small.invert_serial`. NR x NC registers hold the matrix. A
# column is taken out of them (zero is left) when it is shared, and the pivot's row is made anew by the factor
# -1: so one multiplication and addition serves all entries.
_EXCHANGE = """
    const int NR = %(nr)d, NC = %(nc)d;
    const int t = threadIdx.x, r = t / %(columns)d, c = t %% %(columns)d;
    __shared__ float columns[2][NR * %(rows)d];
    __shared__ float row[NC * %(columns)d];
    __shared__ int pivot[NR * %(rows)d];
    const int w = world;
    const int n = n_in;
    float a[NR][NC];
    const long long stride = A.shape[1];
    const float* source = A.data + (long long)w * stride * stride;
    float* target = B.data + (long long)w * stride * stride;
    #pragma unroll
    for (int i = 0; i < NR; ++i)
        #pragma unroll
        for (int j = 0; j < NC; ++j) {
            const int ri = r + %(rows)d * i, cj = c + %(columns)d * j;
            a[i][j] = (ri < n && cj < n) ? source[ri * stride + cj] : 0.0f;
        }
    if (c == 0)
        #pragma unroll
        for (int i = 0; i < NR; ++i) { columns[0][r + %(rows)d * i] = a[i][0]; a[i][0] = 0.0f; }
    // of the rows c, c + 32, ...; every warp finds the pivots for itself, which saves a barrier
    unsigned taken = 0;
    for (int k = 0; k < n; ++k) {
        const float* column = columns[k & 1];
        __syncthreads();
        // bits of a number that is not negative are ordered as the number is
        unsigned best = 0, at = 0xffffffffu;
        #pragma unroll
        for (int m = 0; m < NC; ++m) {
            if (c + 32 * m >= n || (taken >> m & 1)) continue;
            const unsigned bits = __float_as_uint(fabsf(column[c + 32 * m]));
            if (at == 0xffffffffu || bits > best) { best = bits; at = c + 32 * m; }
        }
#if __CUDA_ARCH__ >= 800
        const unsigned largest = __reduce_max_sync(0xffffffffu, best);
        const unsigned p = __reduce_min_sync(0xffffffffu, best == largest ? at : 0xffffffffu);
#else
        unsigned largest = best, p = at;
        for (int s = 16; s > 0; s >>= 1) {
            const unsigned other = __shfl_xor_sync(0xffffffffu, largest, s);
            const unsigned where = __shfl_xor_sync(0xffffffffu, p, s);
            if (other > largest || (other == largest && where < p)) { largest = other; p = where; }
        }
#endif
        if (p %% 32 == c) taken |= 1u << (p / 32);
        if (t == 0) pivot[p] = k;
        if (r == p %% %(rows)d) {
            const int pi = p / %(rows)d;
            const float d = __frcp_rn(column[p]);
            #pragma unroll
            for (int i = 0; i < NR; ++i)
                if (i == pi)
                    #pragma unroll
                    for (int j = 0; j < NC; ++j) {
                        row[c + %(columns)d * j] = (c + %(columns)d * j == k) ? d : a[i][j] * d;
                        a[i][j] = 0.0f;
                    }
        }
        float f[NR];
        #pragma unroll
        for (int i = 0; i < NR; ++i) {
            const int ri = r + %(rows)d * i;
            f[i] = (ri == p) ? -1.0f : column[ri];
        }
        __syncthreads();
        #pragma unroll
        for (int j = 0; j < NC; ++j)
            if (%(columns)d * j < n) {
                const float along = row[c + %(columns)d * j];
                #pragma unroll
                for (int i = 0; i < NR; ++i) a[i][j] -= f[i] * along;
            }
        if (c == (k + 1) %% %(columns)d)
            #pragma unroll
            for (int j = 0; j < NC; ++j)
                if (j == (k + 1) / %(columns)d)
                    #pragma unroll
                    for (int i = 0; i < NR; ++i) {
                        columns[(k + 1) & 1][r + %(rows)d * i] = a[i][j];
                        if (k + 1 < n) a[i][j] = 0.0f;
                    }
    }
    __syncthreads();
    // column k of the exchanged matrix belongs to the right-hand side of the row whose pivot is k
    int* owner = (int*)columns[0];
    for (int k = t; k < n; k += %(threads)d) owner[pivot[k]] = k;
    __syncthreads();
    #pragma unroll
    for (int i = 0; i < NR; ++i)
        #pragma unroll
        for (int j = 0; j < NC; ++j) {
            const int ri = r + %(rows)d * i, cj = c + %(columns)d * j;
            if (ri < n && cj < n) target[pivot[ri] * stride + owner[cj]] = a[i][j];
        }
    __syncthreads();
"""

# the same in global memory, for matrices that registers do not hold
_EXCHANGE_LARGE = """
    const int t = threadIdx.x;
    __shared__ float values[16];
    __shared__ int places[16];
    __shared__ int chosen;
    const int w = world;
    const int n = n_in;
    const long long stride = A.shape[1];
    float* a = A.data + (long long)w * stride * stride;
    float* target = B.data + (long long)w * stride * stride;
    int* pivot = P.data + (long long)w * stride;
    for (int k = t; k < n; k += %(threads)d) pivot[k] = -1;
    for (int k = 0; k < n; ++k) {
        __syncthreads();
        float best = -1.0f; int at = 0;
        for (int i = t; i < n; i += %(threads)d) {
            const float v = fabsf(a[i * stride + k]);
            if (pivot[i] < 0 && v > best) { best = v; at = i; }
        }
        for (int s = 16; s > 0; s >>= 1) {
            const float other = __shfl_xor_sync(0xffffffffu, best, s);
            const int where = __shfl_xor_sync(0xffffffffu, at, s);
            if (other > best || (other == best && where < at)) { best = other; at = where; }
        }
        if (t %% 32 == 0) { values[t / 32] = best; places[t / 32] = at; }
        __syncthreads();
        if (t == 0) {
            for (int s = 1; s < 16; ++s)
                if (values[s] > best) { best = values[s]; at = places[s]; }
            chosen = at; pivot[at] = k;
        }
        __syncthreads();
        const int p = chosen;
        const float d = 1.0f / a[p * stride + k];
        __syncthreads();
        for (int j = t; j < n; j += %(threads)d) a[p * stride + j] = (j == k) ? d : a[p * stride + j] * d;
        __syncthreads();
        for (int i = t / 32; i < n; i += %(threads)d / 32) {
            if (i == p) continue;
            const float f = a[i * stride + k];
            __syncwarp();
            for (int j = t %% 32; j < n; j += 32) {
                const float old = (j == k) ? 0.0f : a[i * stride + j];
                a[i * stride + j] = (j == k) ? -f * d : old - f * a[p * stride + j];
            }
        }
    }
    __syncthreads();
    for (int i = t / 32; i < n; i += %(threads)d / 32)
        for (int j = t %% 32; j < n; j += 32) target[pivot[i] * stride + j] = a[i * stride + pivot[j]];
    __syncthreads();
"""


@functools.cache
def _kernel(tiles):
    """Kernel for matrices of up to 32 `tiles` rows; 0: of any size."""
    names = dict(nr=2 * tiles, nc=tiles, rows=_ROWS, columns=_COLUMNS, threads=_THREADS)
    snippet = (_EXCHANGE if tiles else _EXCHANGE_LARGE) % names

    @wp.func_native(snippet)
    def exchange(
        world: int,
        n_in: int,
        A: wp.array3d(dtype=float),
        P: wp.array2d(dtype=int),
        B: wp.array3d(dtype=float),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=_THREADS)
    def invert_kernel(
        extra: int,
        size: wp.array(dtype=int),
        on: wp.array(dtype=int),
        A: wp.array3d(dtype=float),
        P: wp.array2d(dtype=int),
        B: wp.array3d(dtype=float),
    ):
        w, _t = wp.tid()
        if on[w] == 1:
            n = extra + 3 * size[w]
            if n > 0:
                exchange(w, n, A, P, B)

    return invert_kernel


def invert(
    program: "Launcher", extra: int, size: wp.array, on: wp.array, A: wp.array, pivot: wp.array, B: wp.array
) -> None:
    """B = A^-1 for the leading extra + 3 size[w] rows of every world that is on, (nworld, n, n); may
    overwrite A."""
    tiles = -(-A.shape[1] // _COLUMNS)
    kernel = _kernel(tiles if tiles <= 6 else 0)
    program.launch(kernel, (A.shape[0], _THREADS), [extra, size, on, A, pivot], [B], _THREADS)
