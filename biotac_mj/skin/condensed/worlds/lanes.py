"""What the threads of a block do together: barriers, sums, and a small dense system. On the CPU a block is
one thread."""

import warp as wp

from ...types import real, vec3

__all__ = ["block_max", "block_rank", "block_sum", "eliminate", "sync"]

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def sync():
    """Waits until all threads of the block are here, and what they wrote can be read."""
    ...


_SUM = """
#if defined(__CUDA_ARCH__)
    __shared__ double part[32][{n}];
    const int warps = blockDim.x / 32;
    for (int c = 0; c < {n}; ++c)
        for (int far = 16; far > 0; far /= 2) {at} += __shfl_xor_sync(0xffffffffu, {at}, far);
    __syncthreads();
    if (threadIdx.x % 32 == 0)
        for (int c = 0; c < {n}; ++c) part[threadIdx.x / 32][c] = {at};
    __syncthreads();
    for (int c = 0; c < {n}; ++c) {{
        double total = 0.0;
        for (int i = 0; i < warps; ++i) total += part[i][c];
        {at} = total;
    }}
#endif
    return own;
"""


@wp.func_native(_SUM.format(n=1, at="own"))
def block_sum(own: real) -> real:
    """Sum over the block, always in the same order; all of it get it."""
    ...


@wp.func_native(_SUM.format(n=3, at="own[c]"))
def block_sum(own: vec3) -> vec3: ...  # noqa: F811


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ double part[32];
    const int warps = blockDim.x / 32;
    for (int far = 16; far > 0; far /= 2) own = fmax(own, __shfl_xor_sync(0xffffffffu, own, far));
    __syncthreads();
    if (threadIdx.x % 32 == 0) part[threadIdx.x / 32] = own;
    __syncthreads();
    own = part[0];
    for (int i = 1; i < warps; ++i) own = fmax(own, part[i]);
#endif
    return own;
""")
def block_max(own: real) -> real:
    """The largest of the block."""
    ...


@wp.func_native("""
    int before = 0, total = own;
#if defined(__CUDA_ARCH__)
    __shared__ int held[1024];
    __syncthreads();
    held[threadIdx.x] = own;
    __syncthreads();
    total = 0;
    for (int i = 0; i < blockDim.x; ++i) {
        if (i == threadIdx.x) before = total;
        total += held[i];
    }
#endif
    return wp::vec_t<2, int>(before, total);
""")
def block_rank(own: int) -> wp.vec2i:
    """Sum of the counts of the threads before this one, and of all."""
    ...


# Gauss's elimination with row pivots. A column takes three barriers; a warp takes whole rows.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int t = threadIdx.x, threads = blockDim.x, lane = t % 32, lanes = 32;
    __shared__ int chosen;
    auto wait = []() { __syncthreads(); };
#else
    const int t = 0, threads = 1, lane = 0, lanes = 1;
    int chosen;
    auto wait = []() {};
#endif
    const int warp = t / lanes, warps = threads / lanes, width = n + m;
    float* a = A.data + (long long)world * A.shape[1];
    for (int j = 0; j < n; ++j) {
        float* row = a + (long long)j * width;
        wait();
        if (warp == 0) {
            float most = 0.0f;
            int at = n;
            for (int i = j + lane; i < n; i += lanes) {
                const float v = fabsf(a[(long long)i * width + j]);
                if (v > most) most = v, at = i;
            }
#if defined(__CUDA_ARCH__)
            for (int far = 16; far > 0; far /= 2) {
                const float v = __shfl_xor_sync(0xffffffffu, most, far);
                const int k = __shfl_xor_sync(0xffffffffu, at, far);
                if (v > most || (v == most && k < at)) most = v, at = k;
            }
#endif
            if (lane == 0) chosen = at;
        }
        wait();
        const int p = chosen;
        if (p == n) return 0;
        if (p != j) {
            float* other = a + (long long)p * width;
            for (int k = j + t; k < width; k += threads) {
                const float v = row[k];
                row[k] = other[k];
                other[k] = v;
            }
            wait();
        }
        // a thread has a column and every warps-th row, four at once: a load takes long
        const float inverse = 1.0f / row[j];
        for (int k = j + 1 + lane; k < width; k += lanes) {
            const float pivot = inverse * row[k];
            int i = j + 1 + warp;
            for (; i + 3 * warps < n; i += 4 * warps) {
                float *r0 = a + (long long)i * width, *r1 = r0 + warps * width, *r2 = r1 + warps * width,
                      *r3 = r2 + warps * width;
                const float f0 = r0[j], f1 = r1[j], f2 = r2[j], f3 = r3[j];
                const float v0 = r0[k], v1 = r1[k], v2 = r2[k], v3 = r3[k];
                r0[k] = v0 - f0 * pivot;
                r1[k] = v1 - f1 * pivot;
                r2[k] = v2 - f2 * pivot;
                r3[k] = v3 - f3 * pivot;
            }
            for (; i < n; i += warps) {
                float* mine = a + (long long)i * width;
                mine[k] -= mine[j] * pivot;
            }
        }
    }
    for (int j = n - 1; j >= 0; --j) {
        float* row = a + (long long)j * width;
        wait();
        for (int k = n + t; k < width; k += threads) row[k] /= row[j];
        wait();
        for (int i = t; i < j; i += threads) {
            float* mine = a + (long long)i * width;
            for (int k = n; k < width; ++k) mine[k] -= mine[j] * row[k];
        }
    }
    wait();
    return 1;
""")
def eliminate(A: wp.array2d(dtype=float), world: int, n: int, m: int) -> int:
    """Solves n equations for m right-hand sides, which follow the matrix in each of the n rows of A[world]
    and become the solutions; 0 where the matrix is singular or no number."""
    ...
