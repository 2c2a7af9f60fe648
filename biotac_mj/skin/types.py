"""Scalar, vector and matrix types of the kernels, and casts between them.

Positions and forces are in double precision on every device. Directions (of Newton's method, of conjugate
gradients, of the preconditioner) are double on the CPU and single on CUDA, where they only steer the
iteration; kernels with directions are made for one `Precision`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d
vec6 = wp.spatial_vectord
mat33 = wp.mat33d
mat66 = wp.spatial_matrixd


@wp.func
def double(p: Any):
    return vec3(real(p[0]), real(p[1]), real(p[2]))


@wp.func
def single(p: vec3):
    return wp.vec3(float(p[0]), float(p[1]), float(p[2]))


@wp.func
def widen(A: Any):
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
