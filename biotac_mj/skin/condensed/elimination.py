"""A small dense system that the threads of a block share. On the CPU a block is one thread."""

import warp as wp

from ..block import block_memory

MOST_EQUATIONS = 1024  # that `eliminate` has room for


# Gauss's elimination with row pivots, of which eight are found at a time: what is right of their columns is
# changed by all eight at once. On CUDA rows stay where they are. Eight columns are copied to shared memory,
# where a thread has whole rows and a pivot takes one barrier; right of them it has a column and every
# warps-th row, four at once, since a load takes long.
# A system of up to some 95 equations fits in shared memory on CUDA. There each pivot clears its column in all
# rows (Gauss and Jordan); each warp finds it for itself, its row being the last bits of what is compared.
@wp.func_native(f"""
    const int width = n + m;
    float* a = A.data + (long long)world * A.shape[1];
#if defined(__CUDA_ARCH__)
    const int t = threadIdx.x, threads = blockDim.x, lane = t % 32, warp = t / 32, warps = threads / 32;
    typedef float nine[9];
    nine* panel = (nine*)memory;
    __shared__ unsigned long long most[2][32];
    __shared__ float square[8][8];
    __shared__ unsigned short order[{MOST_EQUATIONS}];
    __shared__ unsigned char used[{MOST_EQUATIONS}];
    if (n > {MOST_EQUATIONS} || m > 8) return 0;
    const int wide = width | 1;
    if (n * wide <= 9 * {MOST_EQUATIONS}) {{
        float* whole = &panel[0][0];
        unsigned done = 0;  // which of this lane's rows were pivots
        __syncthreads();
        for (int i = warp; i < n; i += warps)
            for (int k = lane; k < width; k += 32) whole[i * wide + k] = a[(long long)i * width + k];
        __syncthreads();
        for (int j = 0; j < n; ++j) {{
            unsigned largest = 0;
            for (int i = lane; i < n; i += 32) {{
                const float v = fabsf(whole[i * wide + j]);
                const unsigned key = (__float_as_uint(v) & ~127u) | (127 - i);
                if (v > 0.0f && !(done >> i / 32 & 1) && key > largest) largest = key;
            }}
            for (int far = 16; far > 0; far /= 2) {{
                const unsigned other = __shfl_xor_sync(0xffffffffu, largest, far);
                largest = other > largest ? other : largest;
            }}
            if (largest == 0) return 0;
            const int p = 127 - (int)(largest & 127u);
            const float inverse = 1.0f / whole[p * wide + j];
            if (p % 32 == lane) done |= 1u << p / 32;
            if (t == 0) order[j] = p;
            for (int i = warp; i < n; i += warps) {{
                if (i == p) continue;
                const float f = whole[i * wide + j] * inverse;
                for (int k = j + 1 + lane; k < width; k += 32) whole[i * wide + k] -= f * whole[p * wide + k];
            }}
            __syncthreads();
        }}
        for (int o = t; o < n * m; o += threads) {{
            const float* row = whole + order[o / m] * wide;
            a[(long long)(o / m) * width + n + o % m] = row[n + o % m] / row[o / m];
        }}
        __syncthreads();
        return 1;
    }}
    for (int i = t; i < n; i += threads) used[i] = 0;
    for (int first = 0; first < n; first += 8) {{
        const int next = first + 8 < n ? first + 8 : n;
        __syncthreads();
        for (int o = t; o < 8 * n; o += threads)
            panel[o / 8][o % 8] = first + o % 8 < next ? a[(long long)(o / 8) * width + first + o % 8] : 0.0f;
        __syncthreads();
        int p = n;
        float inverse = 0.0f;
        for (int j = -1; j < next - first; ++j) {{
            // by the last pivot the thread's rows are changed, and of them the next one is found
            unsigned long long largest = 0;
            for (int i = t; i < n; i += threads) {{
                if (used[i] || i == p) continue;
                if (j >= 0) {{
                    const float f = panel[i][j] * inverse;
                    panel[i][j] = f;
                    for (int k = j + 1; k < 8; ++k) panel[i][k] -= f * panel[p][k];
                }}
                const float v = fabsf(panel[i][j + 1 < 8 ? j + 1 : 7]);
                const unsigned long long key = (unsigned long long)__float_as_uint(v) << 32 | (n - i);
                if (v > 0.0f && key > largest) largest = key;
            }}
            if (j >= 0 && p % threads == t) used[p] = 1;
            if (j + 1 == next - first) break;
            for (int far = 16; far > 0; far /= 2) {{
                const unsigned long long other = __shfl_xor_sync(0xffffffffu, largest, far);
                largest = other > largest ? other : largest;
            }}
            if (lane == 0) most[j & 1][warp] = largest;
            __syncthreads();
            largest = 0;
            for (int i = 0; i < warps; ++i) largest = most[j & 1][i] > largest ? most[j & 1][i] : largest;
            if (largest == 0) return 0;
            p = n - (int)(largest & 0xffffffffu);
            inverse = 1.0f / panel[p][j + 1];
            if (t == 0) order[first + j + 1] = p;
        }}
        __syncthreads();
        // what is right of the pivots in their rows
        const unsigned short* row = order + first;
        for (int k = next + t; k < width; k += threads) {{
            float u[8];
            for (int l = 0; l < next - first; ++l) u[l] = a[(long long)row[l] * width + k];
            for (int l = 1; l < next - first; ++l) {{
                for (int q = 0; q < l; ++q) u[l] -= panel[row[l]][q] * u[q];
                a[(long long)row[l] * width + k] = u[l];
            }}
        }}
        for (int o = t; o < 64; o += threads)
            if (o / 8 < next - first && o % 8 < next - first)
                a[(long long)row[o / 8] * width + first + o % 8] = panel[row[o / 8]][o % 8];
        __syncthreads();
        // and in all other rows
        for (int k = next + lane; k < width; k += 32) {{
            float u[8];
            #pragma unroll
            for (int l = 0; l < 8; ++l) u[l] = l < next - first ? a[(long long)row[l] * width + k] : 0.0f;
            for (int i = warp; i < n; i += 4 * warps) {{
                float v[4];
                bool on[4];
                #pragma unroll
                for (int b = 0; b < 4; ++b) {{
                    const int r = i + b * warps;
                    on[b] = r < n && !used[r];
                    v[b] = on[b] ? a[(long long)r * width + k] : 0.0f;
                }}
                #pragma unroll
                for (int b = 0; b < 4; ++b) {{
                    const int r = on[b] ? i + b * warps : i;
                    #pragma unroll
                    for (int l = 0; l < 8; ++l) v[b] -= panel[r][l] * u[l];
                    if (on[b]) a[(long long)r * width + k] = v[b];
                }}
            }}
        }}
    }}
    __syncthreads();
    for (int o = t; o < n * m; o += threads)
        panel[o / m][o % m] = a[(long long)order[o / m] * width + n + o % m];
    for (int first = (n - 1) / 8 * 8; first >= 0; first -= 8) {{
        const int count = first + 8 < n ? 8 : n - first;
        for (int o = t; o < 64; o += threads)
            if (o / 8 < count && o % 8 < count)
                square[o / 8][o % 8] = a[(long long)order[first + o / 8] * width + first + o % 8];
        __syncthreads();
        for (int k = t; k < m; k += threads)
            for (int i = count - 1; i >= 0; --i) {{
                float v = panel[first + i][k];
                for (int j = i + 1; j < count; ++j) v -= square[i][j] * panel[first + j][k];
                panel[first + i][k] = v / square[i][i];
            }}
        __syncthreads();
        for (int i = t; i < first; i += threads) {{
            const float* mine = a + (long long)order[i] * width + first;
            float f[8];
            #pragma unroll
            for (int l = 0; l < 8; ++l) f[l] = l < count ? mine[l] : 0.0f;
            for (int k = 0; k < m; ++k) {{
                float v = panel[i][k];
                for (int l = 0; l < count; ++l) v -= f[l] * panel[first + l][k];
                panel[i][k] = v;
            }}
        }}
    }}
    __syncthreads();
    for (int o = t; o < n * m; o += threads) a[(long long)(o / m) * width + n + o % m] = panel[o / m][o % m];
    __syncthreads();
#else
    // eight pivots are found at a time; what is right of and below them is changed by all eight at once, two
    // rows together
    typedef float eight __attribute__((vector_size(32), aligned(4)));
    for (int first = 0; first < n; first += 8) {{
        const int next = first + 8 < n ? first + 8 : n;
        const bool whole = next - first == 8;
        for (int j = first; j < next; ++j) {{
            float* row = a + (long long)j * width;
            int p = n;
            float largest = 0.0f;
            for (int i = j; i < n; ++i) {{
                const float v = fabsf(a[(long long)i * width + j]);
                if (v > largest) largest = v, p = i;
            }}
            if (p == n) return 0;
            float* other = a + (long long)p * width;
            for (int k = first; k < width && p != j; ++k) {{
                const float v = row[k];
                row[k] = other[k];
                other[k] = v;
            }}
            const float inverse = 1.0f / row[j];
            eight right = {{0.0f}};
            for (int k = j + 1; k < next; ++k) right[k - first] = row[k];
            for (int i = j + 1; i < n; ++i) {{
                float* mine = a + (long long)i * width;
                const float f = inverse * mine[j];
                if (whole)
                    *(eight*)(mine + first) -= f * right;
                else
                    for (int k = j + 1; k < next; ++k) mine[k] -= f * row[k];
                mine[j] = f;  // after that: of what has just been stored in part a load would wait
            }}
        }}
        const float* b = a + (long long)first * width;
        for (int j = first + 1; j < next; ++j) {{
            float* mine = a + (long long)j * width;
            for (int r = first; r < j; ++r) {{
                const float f = mine[r];
                const float* row = a + (long long)r * width;
                for (int k = next; k < width; ++k) mine[k] -= f * row[k];
            }}
        }}
        for (int i = next; i < n; i += 2) {{
            float* one = a + (long long)i * width;
            float* other = i + 1 < n ? one + width : one;
            eight f[8], g[8];
            for (int l = 0; l < 8; ++l)
                f[l] = one[first + l] + (eight){{}}, g[l] = other[first + l] + (eight){{}};
            int k = next;
            for (; k + 8 <= width; k += 8) {{
                eight u = *(eight*)(one + k), v = *(eight*)(other + k);
                #pragma unroll
                for (int l = 0; l < 8; ++l) {{
                    const eight c = *(const eight*)(b + (long long)l * width + k);
    #if defined(__FMA__)  // of vectors the compiler makes none of its own
                    u = __builtin_elementwise_fma(-f[l], c, u);
                    v = __builtin_elementwise_fma(-g[l], c, v);
    #else
                    u -= f[l] * c;
                    v -= g[l] * c;
    #endif
                }}
                *(eight*)(other + k) = v;
                *(eight*)(one + k) = u;
            }}
            for (; k < width; ++k) {{
                float u = one[k], v = other[k];
                for (int l = 0; l < 8; ++l) {{
                    u -= f[l][0] * b[(long long)l * width + k];
                    v -= g[l][0] * b[(long long)l * width + k];
                }}
                other[k] = v;
                one[k] = u;
            }}
        }}
    }}
    // the last row, whose factors are no longer needed, stores the solutions
    float* x = a + (long long)(n - 1) * width;
    const float last = x[n - 1];
    for (int k = n; k < width; ++k)
        for (int i = n - 1; i >= 0; --i) {{
            float* row = a + (long long)i * width;
            eight part = {{row[k]}};
            int j = i + 1;
            for (; j + 8 <= n; j += 8) part -= *(eight*)(row + j) * *(eight*)(x + j);
            float sum = 0.0f;
            for (; j < n; ++j) sum -= row[j] * x[j];
            for (int b = 0; b < 8; ++b) sum += part[b];
            row[k] = sum / (i == n - 1 ? last : row[i]);
            x[i] = row[k];
        }}
#endif
    return 1;
""")
def _eliminate(A: wp.array2d(dtype=float), world: int, n: int, m: int, memory: wp.uint64) -> int: ...


@wp.func
def eliminate(A: wp.array2d(dtype=float), world: int, n: int, m: int):
    """Solves n equations for m right-hand sides, at most eight, which follow the matrix in each of the n rows
    of A[world] and become the solutions; 0 where the matrix is singular or no number."""
    return _eliminate(A, world, n, m, block_memory())
