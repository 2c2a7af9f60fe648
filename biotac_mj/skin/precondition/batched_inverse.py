"""Batched inverses of small matrices on CUDA: the threads of a block share one matrix in registers."""

import functools
import typing
from collections.abc import Callable

import warp as wp

if typing.TYPE_CHECKING:
    from ..program import Launcher

__all__ = ["invert", "kernels_up_to"]

wp.set_module_options({"enable_backward": False})

# (tiles of 32 rows, warps, blocks of a multiprocessor): each size is for the matrices that are too large for
# the one before. In a block for many rows, a small matrix would wait for the barriers.
_SIZES = (1, 3, 8), (2, 7, 4), (3, 7, 3), (4, 7, 2), (6, 15, 1)
_THREADS = 512  # of a block that works in global memory, one for each row

# Gauss-Jordan exchange with row pivots, by panels of eight columns: unknown k and the right-hand side of its
# pivot row change places. The matrix is in registers: thread (r, c) of W warps has the entries
# (r + W i, c + 32 j). One more warp exchanges the columns of a panel, lane c with the rows c + 32 m. This
# gives M: the other columns become M times the former pivot rows, added to all other rows and replacing the
# pivot rows. Meanwhile the other warps work on the panel before; they update the columns of the next panel
# first. A condition such as i == p / W on an unrolled index would make the compiler index registers, and thus
# move them to local memory: conditions are therefore ranges.
_EXCHANGE = """
    const int NC = %(tiles)d, W = %(warps)d, NR = (32 * NC + W - 1) / W, P = 8, PITCH = 12;
    const int t = threadIdx.x, r = t / 32, c = t %% 32;
    __shared__ __align__(16) float panels[2][W * NR][PITCH];
    __shared__ float rows[P][32 * NC];
    __shared__ int pivot[32 * NC], chosen[2][P];
    const int n = n_in;
    const long long stride = A.shape[1];
    const float* source = A.data + (long long)world * stride * stride;
    float* target = B.data + (long long)world * stride * stride;
    const int npanel = (n + P - 1) / P;
    if (r == W) {
        // the warp of the panels: lane c has the rows c, c + 32, ... of eight columns
        unsigned taken = 0;
        for (int q = 0; q < npanel; ++q) {
            asm volatile("bar.sync 1, %%0;" ::"n"(32 * W + 32) : "memory");
            float* panel = &panels[q & 1][0][0];
            float a[NC][P];
            #pragma unroll
            for (int m = 0; m < NC; ++m) {
                const float4* own = (const float4*)&panel[PITCH * (c + 32 * m)];
                const float4 left = own[0], right = own[1];
                a[m][0] = left.x; a[m][1] = left.y; a[m][2] = left.z; a[m][3] = left.w;
                a[m][4] = right.x; a[m][5] = right.y; a[m][6] = right.z; a[m][7] = right.w;
            }
            #pragma unroll
            for (int s = 0; s < P; ++s) {
                if (P * q + s >= n) break;
                // bits of a number that is not negative are ordered as it is; the last eight hold the row
                unsigned best = 0;
                #pragma unroll
                for (int m = 0; m < NC; ++m) {
                    const int i = c + 32 * m;
                    const unsigned key = (__float_as_uint(fabsf(a[m][s])) & 0xffffff00u) | (255u - i);
                    if (i < n && !(taken >> m & 1) && key > best) best = key;
                }
#if __CUDA_ARCH__ >= 800
                best = __reduce_max_sync(0xffffffffu, best);
#else
                for (int d = 16; d > 0; d >>= 1) best = max(best, __shfl_xor_sync(0xffffffffu, best, d));
#endif
                const int p = 255 - (int)(best & 255u), at = p / 32;
                float v[P];
                #pragma unroll
                for (int b = 0; b < P; ++b) {
                    float mine = a[0][b];
                    #pragma unroll
                    for (int m = 1; m < NC; ++m) if (at == m) mine = a[m][b];
                    v[b] = __shfl_sync(0xffffffffu, mine, p & 31);
                }
                float d;
                asm("rcp.approx.ftz.f32 %%0, %%1;" : "=f"(d) : "f"(v[s]));
                d = d * (2.0f - v[s] * d);
                #pragma unroll
                for (int b = 0; b < P; ++b) v[b] = b == s ? d : v[b] * d;
                #pragma unroll
                for (int m = 0; m < NC; ++m) {
                    const bool is = c + 32 * m == p;
                    const float f = is ? -1.0f : a[m][s];
                    #pragma unroll
                    for (int b = 0; b < P; ++b) a[m][b] = (is || b == s ? 0.0f : a[m][b]) - f * v[b];
                }
                if ((p & 31) == c) taken |= 1u << at;
                if (c == 0) { chosen[q & 1][s] = p; pivot[p] = P * q + s; }
            }
            #pragma unroll
            for (int m = 0; m < NC; ++m) {
                *(float4*)&panel[PITCH * (c + 32 * m)] = make_float4(a[m][0], a[m][1], a[m][2], a[m][3]);
                *(float4*)&panel[PITCH * (c + 32 * m) + 4] = make_float4(a[m][4], a[m][5], a[m][6], a[m][7]);
            }
            asm volatile("bar.sync 2, %%0;" ::"n"(32 * W + 32) : "memory");
        }
    } else {
        // the others: thread (r, c) has the entries (r + W i, c + 32 j)
        float a[NR][NC];
        #pragma unroll
        for (int i = 0; i < NR; ++i)
            #pragma unroll
            for (int j = 0; j < NC; ++j) {
                const int ri = r + W * i, cj = c + 32 * j;
                a[i][j] = (ri < n && cj < n) ? source[ri * stride + cj] : 0.0f;
            }
        if (c < P)
            #pragma unroll
            for (int i = 0; i < NR; ++i)
                panels[0][r + W * i][c] = a[i][0];
        asm volatile("bar.sync 1, %%0;" ::"n"(32 * W + 32) : "memory");
        for (int q = 0; q < npanel; ++q) {
            asm volatile("bar.sync 2, %%0;" ::"n"(32 * W + 32) : "memory");
            const float* panel = &panels[q & 1][0][0];
            const int tile = q / 4, next = (q + 1) / 4, lane = c - P * (q & 3), after = c - P * ((q + 1) & 3);
            const int width = min(P, n - P * q);
            // broadcast the pivot rows before elimination; zero them in the tile
            #pragma unroll
            for (int s = 0; s < P; ++s) {
                const int p = s < width ? chosen[q & 1][s] : -1;
                if (s < width) {
                    if (p %% W == r) {
                        #pragma unroll
                        for (int i = 0; i < NR; ++i)
                            if (r + W * i == p) {
                                #pragma unroll
                                for (int j = 0; j < NC; ++j) {
                                    rows[s][c + 32 * j] = a[i][j];
                                    a[i][j] = 0.0f;
                                }
                            }
                    }
                } else if (r == 0)
                    #pragma unroll
                    for (int j = 0; j < NC; ++j) rows[s][c + 32 * j] = 0.0f;
            }
            asm volatile("bar.sync 3, %%0;" ::"n"(32 * W) : "memory");
            if (q + 1 < npanel) {
                float along[P];
                #pragma unroll
                for (int b = 0; b < P; ++b) along[b] = rows[b][c + 32 * next];
                #pragma unroll
                for (int i = 0; i < NR; ++i) {
                    const float4* own = (const float4*)&panel[PITCH * (r + W * i)];
                    const float4 left = own[0], right = own[1];
                    float sum = left.x * along[0];
                    sum += left.y * along[1]; sum += left.z * along[2]; sum += left.w * along[3];
                    sum += right.x * along[4]; sum += right.y * along[5];
                    sum += right.z * along[6]; sum += right.w * along[7];
                    #pragma unroll
                    for (int j = 0; j < NC; ++j)
                        if (4 * j <= q + 1 && q + 1 < 4 * j + 4) {
                            a[i][j] += sum;
                            if (after >= 0 && after < P) panels[(q + 1) & 1][r + W * i][after] = a[i][j];
                        }
                }
                asm volatile("bar.sync 1, %%0;" ::"n"(32 * W + 32) : "memory");
            }
            #pragma unroll
            for (int h = 0; h < 2; ++h) {
                float along[NC][4];
                #pragma unroll
                for (int j = 0; j < NC; ++j)
                    #pragma unroll
                    for (int b = 0; b < 4; ++b)
                        along[j][b] = (j == next && q + 1 < npanel) ? 0.0f : rows[4 * h + b][c + 32 * j];
                #pragma unroll
                for (int i = 0; i < NR; ++i) {
                    const float4 f = *(const float4*)&panel[PITCH * (r + W * i) + 4 * h];
                    #pragma unroll
                    for (int j = 0; j < NC; ++j) {
                        a[i][j] += f.x * along[j][0]; a[i][j] += f.y * along[j][1];
                        a[i][j] += f.z * along[j][2]; a[i][j] += f.w * along[j][3];
                    }
                }
            }
            // the panel's own columns
            if (lane >= 0 && lane < P)
                #pragma unroll
                for (int j = 0; j < NC; ++j)
                    if (4 * j <= q && q < 4 * j + 4)
                        #pragma unroll
                        for (int i = 0; i < NR; ++i) a[i][j] = panel[PITCH * (r + W * i) + lane];
        }
        // column k of the exchanged matrix belongs to the right-hand side of the row whose pivot is k
        int* owner = (int*)rows;
        asm volatile("bar.sync 3, %%0;" ::"n"(32 * W) : "memory");
        for (int i = t; i < n; i += 32 * W) owner[pivot[i]] = i;
        asm volatile("bar.sync 3, %%0;" ::"n"(32 * W) : "memory");
        #pragma unroll
        for (int i = 0; i < NR; ++i)
            #pragma unroll
            for (int j = 0; j < NC; ++j) {
                const int ri = r + W * i, cj = c + 32 * j;
                if (ri < n && cj < n) target[pivot[ri] * stride + owner[cj]] = a[i][j];
            }
    }
"""

# the same in global memory, for matrices that do not fit into registers: thread t has row t of the panel, and
# a warp updates a row by the panel
_EXCHANGE_LARGE = """
    const int t = threadIdx.x, lane = t %% 32, P = 8;
    __shared__ __align__(16) float panel[%(threads)d][P];
    __shared__ float rows[P][%(threads)d];
    __shared__ float values[%(threads)d / 32];
    __shared__ int places[%(threads)d / 32], number[%(threads)d], chosen[P];
    const int w = world;
    const int n = n_in;
    const long long stride = A.shape[1];
    float* a = A.data + (long long)w * stride * stride;
    float* target = B.data + (long long)w * stride * stride;
    number[t] = -1;
    for (int k = 0; k < n; k += P) {
        const int width = min(P, n - k);
        __syncthreads();
        for (int o = t; o < n * P; o += %(threads)d)
            panel[o / P][o %% P] = o %% P < width ? a[o / P * stride + k + o %% P] : 0.0f;
        __syncthreads();
        float own[P];
        #pragma unroll
        for (int b = 0; b < P; ++b) own[b] = t < n ? panel[t][b] : 0.0f;
        #pragma unroll
        for (int s = 0; s < P; ++s) {
            if (s >= width) break;
            float best = t < n && number[t] < 0 ? fabsf(own[s]) : -1.0f;
            int at = t;
            for (int d = 16; d > 0; d >>= 1) {
                const float other = __shfl_xor_sync(0xffffffffu, best, d);
                const int where = __shfl_xor_sync(0xffffffffu, at, d);
                if (other > best || (other == best && where < at)) { best = other; at = where; }
            }
            if (lane == 0) { values[t / 32] = best; places[t / 32] = at; }
            __syncthreads();
            best = values[0]; at = places[0];
            for (int m = 1; m < %(threads)d / 32; ++m)
                if (values[m] > best) { best = values[m]; at = places[m]; }
            if (t == at) {
                #pragma unroll
                for (int b = 0; b < P; ++b) panel[t][b] = own[b];
                number[t] = k + s;
                chosen[s] = t;
            }
            __syncthreads();
            float v[P];
            #pragma unroll
            for (int b = 0; b < P; ++b) v[b] = panel[at][b];
            const float d = 1.0f / v[s], f = t == at ? -1.0f : own[s];
            #pragma unroll
            for (int b = 0; b < P; ++b) {
                const float share = b == s ? d : v[b] * d;
                own[b] = (t == at || b == s ? 0.0f : own[b]) - f * share;
            }
        }
        __syncthreads();
        #pragma unroll
        for (int b = 0; b < P; ++b) panel[t][b] = own[b];
        for (int s = 0; s < P; ++s)
            if (t < n) rows[s][t] = s < width ? a[chosen[s] * stride + t] : 0.0f;
        __syncthreads();
        for (int i = t / 32; i < n; i += %(threads)d / 32) {
            const float4 left = *(const float4*)&panel[i][0], right = *(const float4*)&panel[i][4];
            const bool was = number[i] >= k;
            for (int j = lane; j < n; j += 128) {
                float sum[4];  // all are read before one is written, which a later read would wait for
                #pragma unroll
                for (int m = 0; m < 4; ++m)
                    sum[m] = was || j + 32 * m >= n ? 0.0f : a[i * stride + j + 32 * m];
                #pragma unroll
                for (int m = 0; m < 4; ++m) {
                    const int h = j + 32 * m;
                    if (h >= n) break;
                    sum[m] += left.x * rows[0][h]; sum[m] += left.y * rows[1][h];
                    sum[m] += left.z * rows[2][h]; sum[m] += left.w * rows[3][h];
                    sum[m] += right.x * rows[4][h]; sum[m] += right.y * rows[5][h];
                    sum[m] += right.z * rows[6][h]; sum[m] += right.w * rows[7][h];
                    a[i * stride + h] = h >= k && h < k + width ? panel[i][h - k] : sum[m];
                }
            }
        }
    }
    // column k of the exchanged matrix belongs to the right-hand side of the row whose pivot is k
    __syncthreads();
    for (int i = t / 32; i < n; i += %(threads)d / 32)
        for (int j = lane; j < n; j += 32) target[number[i] * stride + j] = a[i * stride + number[j]];
    __syncthreads();
"""


@functools.cache
def _kernel(least, tiles, warps, blocks):
    """Kernel for matrices of more than `least` and up to 32 `tiles` rows."""
    threads = 32 * (warps + 1)

    @wp.func_native(_EXCHANGE % dict(tiles=tiles, warps=warps))
    def exchange(world: int, n_in: int, A: wp.array3d(dtype=float), B: wp.array3d(dtype=float)): ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(threads, blocks))
    def invert_kernel(
        extra: int,
        size: wp.array(dtype=int),
        on: wp.array(dtype=int),
        A: wp.array3d(dtype=float),
        B: wp.array3d(dtype=float),
    ):
        w, _t = wp.tid()
        if on[w] == 1:
            n = extra + 3 * size[w]
            if n > wp.static(least) and n <= wp.static(32 * tiles):
                exchange(w, n, A, B)

    return invert_kernel, threads


@functools.cache
def _kernel_large(least):
    """Kernel for matrices of more than `least` rows."""

    @wp.func_native(_EXCHANGE_LARGE % dict(threads=_THREADS))
    def exchange(world: int, n_in: int, A: wp.array3d(dtype=float), B: wp.array3d(dtype=float)): ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=_THREADS)
    def invert_kernel(
        extra: int,
        size: wp.array(dtype=int),
        on: wp.array(dtype=int),
        A: wp.array3d(dtype=float),
        B: wp.array3d(dtype=float),
    ):
        w, _t = wp.tid()
        if on[w] == 1:
            n = extra + 3 * size[w]
            if n > wp.static(least):
                exchange(w, n, A, B)

    return invert_kernel


def kernels_up_to(capacity: int = _THREADS) -> list[tuple[wp.Kernel, int]]:
    """Kernels that invert matrices of up to `capacity` rows, with their block sizes."""
    found, least = [], 0
    for sizes in _SIZES:
        found.append(_kernel(least, *sizes))
        least = 32 * sizes[0]
        if least >= capacity:
            return found
    return [*found, (_kernel_large(least), _THREADS)]


def invert(
    program: "Launcher",
    in_parallel: Callable[..., None],
    extra: int,
    size: wp.array,
    on: wp.array,
    A: wp.array,
    B: wp.array,
) -> None:
    """B = A^-1 (nworld, n, n) for the first extra + 3 size[w] rows of every world that is on; may overwrite
    A. The kernel for a matrix depends only on its number of rows.

    Args:
      in_parallel: launches functions that do not need each other's results.
    """
    nworld, capacity = A.shape[0], A.shape[1]
    if capacity > _THREADS:
        raise ValueError(f"a system of {capacity} rows is too large: a block has {_THREADS} threads")
    given = [extra, size, on, A]
    launches = [
        functools.partial(program.launch, kernel, (nworld, threads), given, [B], threads)
        for kernel, threads in kernels_up_to(capacity)
    ]
    in_parallel(*launches)
