"""Batched inverses of small matrices on CUDA, by Gauss-Jordan exchange with row pivots: unknown k and the
right-hand side of its pivot row change places. A block has one matrix."""

import typing

import warp as wp

if typing.TYPE_CHECKING:
    from ..program import Launcher

THREADS = 512  # of a block: one for each row

# By panels of eight columns, of which thread t has row t. At a pivot each warp proposes its largest entry, by
# a key of bits that are ordered as the number is, with the row in the last ones. Then each warp updates rows
# by the panel, a column for each lane, which keeps what the pivots' rows have there.
_EXCHANGE = f"""
    const int t = threadIdx.x, lane = t % 32, warp = t / 32, P = 8, W = {THREADS} / 32;
    const int R = 8;  // rows that a warp reads at once
    __shared__ __align__(16) float panel[{THREADS}][P];
    __shared__ __align__(16) float proposed[2][W][P];
    __shared__ float rows[P][{THREADS}];
    __shared__ unsigned keys[2][W];
    __shared__ int number[{THREADS}];
    const int w = world;
    const int n = n_in;
    const long long stride = A.shape[1];
    float* a = A.data + (long long)w * stride * stride;
    float* target = B.data + (long long)w * stride * stride;
    number[t] = -1;
    for (int k = 0; k < n; k += P) {{
        const int width = min(P, n - k);
        __syncthreads();
        for (int o = t; o < n * P; o += {THREADS})
            panel[o / P][o % P] = o % P < width ? a[o / P * stride + k + o % P] : 0.0f;
        __syncthreads();
        float own[P], pivot[P];
        #pragma unroll
        for (int b = 0; b < P; ++b) {{ own[b] = t < n ? panel[t][b] : 0.0f; pivot[b] = 0.0f; }}
        bool open = t < n && number[t] < 0;
        #pragma unroll
        for (int s = 0; s < P; ++s) {{
            if (s >= width) break;
            const unsigned size = __float_as_uint(fabsf(own[s])) & ~{THREADS - 1}u;
            const unsigned key = open ? size | ({THREADS - 1} - t) : 0;
            unsigned best = key;
#if __CUDA_ARCH__ >= 800
            best = __reduce_max_sync(0xffffffffu, best);
#else
            for (int d = 16; d > 0; d >>= 1) best = max(best, __shfl_xor_sync(0xffffffffu, best, d));
#endif
            if (lane == 0) keys[s % 2][warp] = best;
            if (open && key == best)
                #pragma unroll
                for (int b = 0; b < P; ++b) proposed[s % 2][warp][b] = own[b];
            __syncthreads();  // the next pivot but one writes there again
            #pragma unroll
            for (int m = 0; m < W; ++m) best = max(best, keys[s % 2][m]);
            const int at = {THREADS - 1} - (best & {THREADS - 1});
            if (t < n) pivot[s] = a[at * stride + t];
            float v[P];
            #pragma unroll
            for (int b = 0; b < P; ++b) v[b] = proposed[s % 2][at / 32][b];
            const float d = 1.0f / v[s], f = t == at ? -1.0f : own[s];
            #pragma unroll
            for (int b = 0; b < P; ++b) {{
                const float share = b == s ? d : v[b] * d;
                own[b] = (t == at || b == s ? 0.0f : own[b]) - f * share;
            }}
            if (t == at) {{ number[t] = k + s; open = false; }}
        }}
        #pragma unroll
        for (int b = 0; b < P; ++b) {{ panel[t][b] = own[b]; rows[b][t] = pivot[b]; }}
        __syncthreads();
        for (int j = lane; j < n; j += 32) {{
            float row[P];
            #pragma unroll
            for (int s = 0; s < P; ++s) row[s] = rows[s][j];
            for (int i = warp; i < n; i += R * W) {{
                float sum[R];  // all are read before one is written, which a later read would wait for
                #pragma unroll
                for (int r = 0; r < R; ++r) {{
                    const int l = i + r * W;
                    sum[r] = l >= n || number[l] >= k ? 0.0f : a[l * stride + j];
                }}
                #pragma unroll
                for (int r = 0; r < R; ++r) {{
                    const int l = i + r * W;
                    if (l >= n) break;
                    #pragma unroll
                    for (int s = 0; s < P; ++s) sum[r] += panel[l][s] * row[s];
                    a[l * stride + j] = j >= k && j < k + width ? panel[l][j - k] : sum[r];
                }}
            }}
        }}
    }}
    // column k of the exchanged matrix belongs to the right-hand side of the row whose pivot is k
    __syncthreads();
    for (int i = warp; i < n; i += W)
        for (int j = lane; j < n; j += 32) target[number[i] * stride + j] = a[i * stride + number[j]];
    __syncthreads();
"""


@wp.func_native(_EXCHANGE)
def exchange(world: int, n_in: int, A: wp.array3d(dtype=float), B: wp.array3d(dtype=float)): ...


@wp.kernel(module="unique", enable_backward=False, launch_bounds=(THREADS, 2))
def invert_kernel(
    # In:
    extra: int,
    size: wp.array(dtype=int),
    on: wp.array(dtype=int),
    # In and out:
    A: wp.array3d(dtype=float),
    # Out:
    inverse_out: wp.array3d(dtype=float),
):
    """See `invert`."""
    w, _t = wp.tid()
    if on[w] == 1:
        exchange(w, extra + 3 * size[w], A, inverse_out)


def invert(program: "Launcher", extra: int, size: wp.array, on: wp.array, A: wp.array, B: wp.array) -> None:
    """B = A^-1 (nworld, n, n) for the first extra + 3 size[w] rows of worlds that are on; overwrites A."""
    nworld, capacity = A.shape[0], A.shape[1]
    if capacity > THREADS:
        raise ValueError(f"a system of {capacity} rows is too large: a block has {THREADS} threads")
    program.launch(invert_kernel, (nworld, THREADS), [extra, size, on, A], [B], THREADS)
