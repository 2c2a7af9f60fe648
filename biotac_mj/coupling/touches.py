"""Contacts that stand for a skin: what acts on a body, parted among its geoms as the skin pushes on them."""

import numpy as np
import warp as wp

from ..kernels import kernel_module
from ..skin.types import real, vec3, vec6
from .implicit.kinematics import row

kernel_module(__name__)

_TINY = wp.constant(wp.float64(1e-12))  # [N]


@wp.kernel
def find_touches(
    # In:
    nsample: int,
    face: wp.array(dtype=wp.vec3i),
    group: wp.array(dtype=int),
    kept: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    acting: wp.array2d(dtype=vec6),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    normal_out: wp.array2d(dtype=vec3),
    fraction_out: wp.array2d(dtype=real),
    wrench_out: wp.array2d(dtype=vec6),
):
    """Contact of each geom: centre of pressure, mean normal out of the skin there, fraction of the body's
    wrench, force and torque about the centre. Where no push is known the first geom gets all, on the axis of
    the wrench."""
    g, w = wp.tid()
    first = int(-1)
    for k in range(group.shape[0]):
        if group[k] == g:
            if first < 0:
                first = k
            pos_out[k, w] = vec3()
            normal_out[k, w] = vec3()
            fraction_out[k, w] = real(0.0)
            wrench_out[k, w] = vec6()
    total = real(0.0)
    for f in range(kept.shape[0]):
        if kept[f, w] == 1:
            t = face[f]
            a = x[t[0], w]
            b = x[t[1], w]
            c = x[t[2], w]
            n = wp.normalize(wp.cross(b - a, c - a))
            for s in range(nsample):
                k = geom[f * nsample + s, w]
                if k >= 0:
                    if group[k] == g:
                        push = wp.max(-wp.dot(force[f * nsample + s, w], n), real(0.0))
                        total += push
                        fraction_out[k, w] += push
                        pos_out[k, w] += push / real(3.0) * (a + b + c)
                        normal_out[k, w] += push * n
    pushed = wp.spatial_top(acting[g, w])
    square = wp.dot(pushed, pushed)
    if first < 0 or square < _TINY * _TINY:
        return
    if total < _TINY:
        pos_out[first, w] = wp.cross(pushed, wp.spatial_bottom(acting[g, w])) / square
        normal_out[first, w] = pushed
        fraction_out[first, w] = real(1.0)
        total = real(1.0)
    centre = vec3()
    for k in range(group.shape[0]):
        if group[k] == g and fraction_out[k, w] > real(0.0):
            centre += pos_out[k, w] / total
            pos_out[k, w] = pos_out[k, w] / fraction_out[k, w]
            normal_out[k, w] = wp.normalize(normal_out[k, w])
            fraction_out[k, w] = fraction_out[k, w] / total
    turn = wp.spatial_bottom(acting[g, w]) - wp.cross(centre, pushed)
    for k in range(group.shape[0]):
        if group[k] == g:
            fraction = fraction_out[k, w]
            for i in range(3):
                wrench_out[k, w][i] = fraction * pushed[i]
                wrench_out[k, w][i + 3] = fraction * turn[i]


class Touches:
    """`find_touches` in one world.

    Args:
      group: (ngeom,) body of each geom. face: (nface, 3) outer faces of a skin with `nvert` nodes.

    Attributes, for the caller to write:
      wrench: (ngroup, 6) on the bodies.
      kept, geom, force, x: what touches, with one sample a face: (nface,), (nface,), (nface, 3), (nvert, 3).
    """

    def __init__(self, group: np.ndarray, face: np.ndarray, nvert: int, ngroup: int):
        nface = len(face)
        given = (nface, int), (nface, int), (nface, vec3), (nvert, vec3), (ngroup, vec6)
        with wp.ScopedDevice("cpu"):
            fixed = [wp.array(face, dtype=wp.vec3i), wp.array(group, dtype=int)]
            given = [wp.zeros((n, 1), dtype=kind) for n, kind in given]
            found = [wp.zeros((len(group), 1), dtype=kind) for kind in (vec3, vec3, real, vec6)]
        self.kept, self.geom, self.force, self.x, self.wrench = (a.numpy()[:, 0] for a in given)
        self._found = [a.numpy()[:, 0] for a in found]
        self._find = row((find_touches, (ngroup, 1), [1, *fixed, *given, *found]))

    def find(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (k,) of geoms on which something acts, and (k, 4, 3): centre of pressure [m], normal out of
        the skin there, force [N], and torque [N m] about the centre."""
        self._find()
        pos, normal, fraction, wrench = self._found
        which = fraction.nonzero()[0]
        return which, np.concatenate([pos, normal, wrench], axis=1)[which].reshape(-1, 4, 3)
