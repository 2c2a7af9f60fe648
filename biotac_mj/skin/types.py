"""Scalar, vector and matrix types of the kernels, casts between them, and sums over a block of threads.

Positions and forces are in double precision on every device. Directions (of Newton's method, of conjugate
gradients, of the preconditioner) are double on the CPU and single on CUDA, where they only steer the
iteration; kernels with directions are made for one `Precision`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

__all__ = [
    "DOUBLE",
    "SINGLE",
    "Precision",
    "double",
    "mat33",
    "mat66",
    "narrow",
    "real",
    "single",
    "sum_of_block",
    "sum_of_lanes",
    "vec3",
    "vec4",
    "vec6",
    "widen",
]

real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d
vec6 = wp.spatial_vectord
mat33 = wp.mat33d
mat66 = wp.spatial_matrixd


@wp.func
def double(p: wp.vec3):
    return vec3(real(p[0]), real(p[1]), real(p[2]))


@wp.func
def single(p: vec3):
    return wp.vec3(float(p[0]), float(p[1]), float(p[2]))


@wp.func
def widen(A: wp.mat33):
    return mat33(
        real(A[0, 0]), real(A[0, 1]), real(A[0, 2]),
        real(A[1, 0]), real(A[1, 1]), real(A[1, 2]),
        real(A[2, 0]), real(A[2, 1]), real(A[2, 2]),
    )  # fmt: skip


@wp.func
def narrow(A: mat33):
    return wp.mat33(
        float(A[0, 0]), float(A[0, 1]), float(A[0, 2]),
        float(A[1, 0]), float(A[1, 1]), float(A[1, 2]),
        float(A[2, 0]), float(A[2, 1]), float(A[2, 2]),
    )  # fmt: skip


# Warp's tiles do the same, but on the CPU all host threads share the memory of a tile: such kernels would
# have to wait for each other.
_OF_BLOCK = """
#if defined(__CUDA_ARCH__)
    const int count = sizeof(own) / sizeof(double), warps = (blockDim.x + 31) / 32;
    __shared__ double part[32][count];
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
def sum_of_block(own: real) -> real:
    """Sum of a number or vector over the threads of a block of whole warps, in a fixed order. All threads
    must take part, and get it. On the CPU a block has one thread."""
    ...


@wp.func_native(_OF_BLOCK)
def sum_of_block(own: vec3) -> vec3: ...  # noqa: F811


@wp.func_native(_OF_BLOCK)
def sum_of_block(own: vec6) -> vec6: ...  # noqa: F811


_OF_LANES = """
#if defined(__CUDA_ARCH__)
    for (int c = 0; c < 3; ++c)
        for (int far = lanes / 2; far > 0; far /= 2) p[c] += __shfl_xor_sync(0xffffffffu, p[c], far);
#endif
    return p;
"""


# A mask may contain lanes that have ended; the lanes of one sum take part or have ended together.
@wp.func_native(_OF_LANES)
def sum_of_lanes(p: vec3, lanes: int) -> vec3:
    """Sum of a vector over `lanes` neighbouring lanes of a warp, a power of two; all lanes get it. On the CPU
    there is one."""
    ...


@wp.func_native(_OF_LANES)
def sum_of_lanes(p: wp.vec3, lanes: int) -> wp.vec3: ...  # noqa: F811


@wp.func
def same_vector(p: vec3):
    return p


@wp.func
def same_matrix(A: mat33):
    return A


class Precision(NamedTuple):
    """Types of directions, and casts between them and double precision.

    Attributes:
      name: "single" or "double".
      scalar, vec, mat: Warp types.
      lower, raised: casts of a vector from and to double. narrow, widen: of a matrix.
    """

    name: str
    scalar: Any
    vec: Any
    mat: Any
    lower: Callable
    raised: Callable
    narrow: Callable
    widen: Callable


SINGLE = Precision("single", wp.float32, wp.vec3, wp.mat33, single, double, narrow, widen)
DOUBLE = Precision("double", real, vec3, mat33, same_vector, same_vector, same_matrix, same_matrix)
