"""Batched inverses of small matrices on CUDA, by Gauss-Jordan exchange with row pivots: unknown k and the
right-hand side of its pivot row change places. A block has one matrix."""

import typing

import warp as wp

if typing.TYPE_CHECKING:
    from ..program import Launcher

THREADS = 512  # of a block: one for each row

# By panels of eight columns: thread t has row t of the panel, and a warp updates a row by the panel.
_EXCHANGE = f"""
    const int t = threadIdx.x, lane = t % 32, P = 8;
    __shared__ __align__(16) float panel[{THREADS}][P];
    __shared__ float rows[P][{THREADS}];
    __shared__ float values[{THREADS} / 32];
    __shared__ int places[{THREADS} / 32], number[{THREADS}], chosen[P];
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
        float own[P];
        #pragma unroll
        for (int b = 0; b < P; ++b) own[b] = t < n ? panel[t][b] : 0.0f;
        #pragma unroll
        for (int s = 0; s < P; ++s) {{
            if (s >= width) break;
            float best = t < n && number[t] < 0 ? fabsf(own[s]) : -1.0f;
            int at = t;
            for (int d = 16; d > 0; d >>= 1) {{
                const float other = __shfl_xor_sync(0xffffffffu, best, d);
                const int where = __shfl_xor_sync(0xffffffffu, at, d);
                if (other > best || (other == best && where < at)) {{ best = other; at = where; }}
            }}
            if (lane == 0) {{ values[t / 32] = best; places[t / 32] = at; }}
            __syncthreads();
            best = values[0]; at = places[0];
            for (int m = 1; m < {THREADS} / 32; ++m)
                if (values[m] > best) {{ best = values[m]; at = places[m]; }}
            if (t == at) {{
                #pragma unroll
                for (int b = 0; b < P; ++b) panel[t][b] = own[b];
                number[t] = k + s;
                chosen[s] = t;
            }}
            __syncthreads();
            float v[P];
            #pragma unroll
            for (int b = 0; b < P; ++b) v[b] = panel[at][b];
            const float d = 1.0f / v[s], f = t == at ? -1.0f : own[s];
            #pragma unroll
            for (int b = 0; b < P; ++b) {{
                const float share = b == s ? d : v[b] * d;
                own[b] = (t == at || b == s ? 0.0f : own[b]) - f * share;
            }}
        }}
        __syncthreads();
        #pragma unroll
        for (int b = 0; b < P; ++b) panel[t][b] = own[b];
        for (int s = 0; s < P; ++s)
            if (t < n) rows[s][t] = s < width ? a[chosen[s] * stride + t] : 0.0f;
        __syncthreads();
        for (int i = t / 32; i < n; i += {THREADS} / 32) {{
            const float4 left = *(const float4*)&panel[i][0], right = *(const float4*)&panel[i][4];
            const bool was = number[i] >= k;
            for (int j = lane; j < n; j += 128) {{
                float sum[4];  // all are read before one is written, which a later read would wait for
                #pragma unroll
                for (int m = 0; m < 4; ++m)
                    sum[m] = was || j + 32 * m >= n ? 0.0f : a[i * stride + j + 32 * m];
                #pragma unroll
                for (int m = 0; m < 4; ++m) {{
                    const int h = j + 32 * m;
                    if (h >= n) break;
                    sum[m] += left.x * rows[0][h]; sum[m] += left.y * rows[1][h];
                    sum[m] += left.z * rows[2][h]; sum[m] += left.w * rows[3][h];
                    sum[m] += right.x * rows[4][h]; sum[m] += right.y * rows[5][h];
                    sum[m] += right.z * rows[6][h]; sum[m] += right.w * rows[7][h];
                    a[i * stride + h] = h >= k && h < k + width ? panel[i][h - k] : sum[m];
                }}
            }}
        }}
    }}
    // column k of the exchanged matrix belongs to the right-hand side of the row whose pivot is k
    __syncthreads();
    for (int i = t / 32; i < n; i += {THREADS} / 32)
        for (int j = lane; j < n; j += 32) target[number[i] * stride + j] = a[i * stride + number[j]];
    __syncthreads();
"""


@wp.func_native(_EXCHANGE)
def exchange(world: int, n_in: int, A: wp.array3d(dtype=float), B: wp.array3d(dtype=float)): ...


@wp.kernel(module="unique", enable_backward=False, launch_bounds=THREADS)
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
