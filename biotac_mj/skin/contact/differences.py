"""Stiffness of contact as it is, by differences of the law itself."""

import functools

import warp as wp

from ..types import mat33, real, vec3
from .faces import Laws, block_index
from .posed import Geoms
from .touch import contact_kernels

__all__ = ["face_by_differences"]

wp.set_module_options({"enable_backward": False})

_BY = wp.constant(1e-9)  # of a difference [m]


@functools.cache
def face_by_differences(shapes: str) -> wp.Function:
    """A function that writes the stiffness of a touching face: with what friction takes from the normal force
    and with the curvature of the geoms. It is not symmetric. shapes: see `touch.contact_kernels`."""
    touch_sample = contact_kernels(False, False, shapes).touch_sample

    @wp.func
    def difference_face(
        f: int,
        w: int,
        # In:
        t: wp.vec3i,
        share: real,
        sample: wp.array(dtype=vec3),
        stiffness: real,
        stick_ratio: real,
        geoms: Geoms,
        laws: Laws,
        x: wp.array2d(dtype=vec3),
        x_last: wp.array2d(dtype=vec3),
        anchor_geom: wp.array2d(dtype=int),
        anchor: wp.array2d(dtype=vec3),
        geom: wp.array2d(dtype=int),
        # Out:
        block_out: wp.array2d(dtype=mat33),
    ):
        """t: nodes of face f; share: of its area that a sample stands for."""
        for c in range(6):
            block_out[6 * f + c, w] = mat33()
        k = stiffness * share
        for s in range(sample.shape[0]):
            i = f * sample.shape[0] + s
            if geom[i, w] >= 0:
                b = sample[s]
                K = mat33()
                for axis in range(3):
                    for way in range(2):
                        by = vec3()
                        by[axis] = wp.where(way == 0, real(_BY), -real(_BY))
                        _t, _b, _c, force, _K, _a = touch_sample(
                            i, w, b, t, x[t[0], w] + by, x[t[1], w] + by, x[t[2], w] + by, k, k * stick_ratio,
                            share, laws, geoms, x_last, anchor_geom, anchor, 0,
                        )  # fmt: skip
                        for row in range(3):
                            K[row, axis] = K[row, axis] - force[row] / (real(2.0) * by[axis])
                for c in range(3):
                    for e in range(c, 3):
                        block_out[6 * f + block_index(c, e), w] += b[c] * b[e] * K

    return difference_face
