"""Collective operations of the threads of a block: barriers, sums, maxima, ranks. On the CPU a block is one
thread."""

import functools

import warp as wp

from .types import real, vec3, vec6


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def sync():
    """Waits until all threads of the block are here, and what they wrote can be read."""
    ...


# One buffer of 40 kB, which functions of a kernel use in turn: a block may declare 48 kB of shared memory
MEMORY = wp.constant(5120)


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ double memory[{MEMORY}];
    return (uint64_t)memory;
#else
    return 0;
#endif
""")
def block_memory() -> wp.uint64:
    """Address of shared memory of the block on CUDA, for MEMORY real numbers, else 0. Its contents last until
    another function takes it."""
    ...


# Warp's tiles do the same, but on the CPU all host threads share the memory of a tile: such kernels would
# have to wait for each other.
_OF_BLOCK = """
#if defined(__CUDA_ARCH__)
    const int count = sizeof(own) / sizeof(double), warps = (blockDim.x + 31) / 32;
    __shared__ double part[16][count];
    double* number = (double*)&own;
    for (int i = 0; i < count; ++i)
        for (int far = 16; far > 0; far /= 2) number[i] += __shfl_down_sync(0xffffffffu, number[i], far);
    __syncthreads();  // all threads have read the result of an earlier sum
    if (threadIdx.x % 32 == 0)
        for (int i = 0; i < count; ++i) part[threadIdx.x / 32][i] = number[i];
    __syncthreads();
    for (int i = 0; i < count; ++i) {
        number[i] = part[0][i];
        for (int w = 1; w < warps; ++w) number[i] += part[w][i];
    }
#endif
    return own;
"""


@wp.func_native(_OF_BLOCK)
def block_sum(own: real) -> real:
    """Sum of a number or vector over the threads of a block, at most 16 whole warps, in a fixed order. All
    must take part, and get it. On the CPU a block has one thread."""
    ...


@wp.func_native(_OF_BLOCK)
def block_sum(own: vec3) -> vec3: ...  # noqa: F811


@wp.func_native(_OF_BLOCK)
def block_sum(own: vec6) -> vec6: ...  # noqa: F811


# Lanes of other sums may be elsewhere, at a barrier: a shuffle whose mask has them never ends.
_OF_LANES = """
#if defined(__CUDA_ARCH__)
    const unsigned mask = 0xffffffffu >> (32 - lanes) << threadIdx.x % 32 / lanes * lanes;
    NUMBER* number = (NUMBER*)&p;
    for (int far = lanes / 2; far > 0; far /= 2)
        #pragma unroll
        for (int c = 0; c < sizeof(p) / sizeof(NUMBER); ++c)
            number[c] += __shfl_xor_sync(mask, number[c], far);
#endif
    return p;
"""


@functools.cache
def lane_sum(dtype: type, scalar: type) -> wp.Function:
    """As `sum_of_lanes`, of any type that consists of numbers `scalar`."""

    @wp.func_native(_OF_LANES.replace("NUMBER", "double" if scalar is real else "float"))
    def sum_of_lanes(p: dtype, lanes: int) -> dtype: ...

    return sum_of_lanes


@wp.func_native(_OF_LANES.replace("NUMBER", "double"))
def sum_of_lanes(p: vec3, lanes: int) -> vec3:
    """Sum of a vector over `lanes` neighbouring lanes of a warp, a power of two, which take part together and
    get it. On the CPU there is one."""
    ...


@wp.func_native(_OF_LANES.replace("NUMBER", "float"))
def sum_of_lanes(p: wp.vec3, lanes: int) -> wp.vec3: ...  # noqa: F811


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ double part[16];
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
    __shared__ int part[16];
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32, warps = blockDim.x / 32;
    int sum = own;
    for (int near = 1; near < 32; near *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, sum, near);
        if (lane >= near) sum += other;
    }
    __syncthreads();
    if (lane == 31) part[warp] = sum;
    __syncthreads();
    before = sum - own;
    total = 0;
    for (int i = 0; i < warps; ++i) {
        if (i < warp) before += part[i];
        total += part[i];
    }
#endif
    return wp::vec_t<2, int>(before, total);
""")
def block_rank(own: int) -> wp.vec2i:
    """Sum of the counts of the threads before this one, and of all."""
    ...
