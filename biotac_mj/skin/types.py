"""Scalar and small tensor types of the kernels: double precision, so that CPU and CUDA give the same
answers."""

import warp as wp

__all__ = ["mat33", "real", "vec3"]

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
