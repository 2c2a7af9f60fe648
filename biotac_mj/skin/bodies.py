"""Compliance of the bodies that touch a skin. A body is at its predicted pose under the predicted wrench;
another wrench moves it by the compliance of its inertia and of its other constraints.

To contact, a body is thus a compliance of rank six in series with the skin's own (`docs/design.md`)."""

import dataclasses

import numpy as np
import warp as wp

from ..geometry import rigid_warp
from ..geometry.rigid import cross, rotation
from ..kernels import add_zeros, kernel_module
from .types import mat33, vec3

kernel_module(__name__)


@wp.struct
class Bodies:
    """The compliant body of each group of geoms [group, world]. Wrenches are those of the skin on the bodies;
    wrenches and motions are about the origin of the BioTac frame, linear part first. Empty where poses are
    prescribed."""

    compliance: wp.array3d(dtype=wp.spatial_matrixd)  # motion by a wrench [moved group, loaded group, world]
    predicted: wp.array2d(dtype=wp.spatial_vectord)  # wrenches at the predicted poses
    origin: wp.array2d(dtype=vec3)  # reference points of the bodies at the predicted poses [m]
    arm: wp.array2d(dtype=vec3)  # and at the start of the step, where motions are measured [m]
    spin: wp.array2d(dtype=vec3)  # rotation vectors from the start of the step to the predicted poses [rad]
    begun: wp.array2d(dtype=wp.spatial_vectord)  # wrenches at the start of the step
    converged: wp.array2d(dtype=wp.spatial_vectord)  # at the end of the last accepted load increment
    posed: wp.array2d(dtype=wp.spatial_vectord)  # of the present poses of the geoms
    wrench: wp.array2d(dtype=wp.spatial_vectord)  # factor of a product with the compliance
    motion: wp.array2d(dtype=wp.spatial_vectord)  # and its result
    column: wp.array2d(dtype=int)  # first of the body's six equations in the condensed system; -1: none


def make_bodies(groups: int, nworld: int) -> Bodies:
    """Rigid bodies (zero compliance) for `groups` groups of geoms, on Warp's default device."""
    b = Bodies()
    add_zeros(b, "compliance", groups, groups, nworld)
    add_zeros(b, "predicted begun converged posed wrench motion origin arm spin", groups, nworld)
    b.column = wp.full((groups, nworld), -1, dtype=int)
    return b


@wp.func
def follow_wrench(h: int, w: int, b: Bodies, m: wp.spatial_vectord, pos: vec3, mat: mat33):
    """Pose of a geom of body h that is moved by m from its predicted pose pos, mat."""
    more = vec3(m[3], m[4], m[5])
    # the rotation by the sum of two rotation vectors is not the product of both rotations
    turn = rigid_warp.rotation(b.spin[h, w] + more) * wp.transpose(rigid_warp.rotation(b.spin[h, w]))
    origin = b.origin[h, w]
    translation = vec3(m[0], m[1], m[2]) + wp.cross(more, b.arm[h, w])
    return origin + translation + turn * (pos - origin), turn * mat


@wp.kernel
def uncoupled_geoms(
    # In:
    b: Bodies,
    group: wp.array(dtype=int),
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
):
    """Poses of geoms without the skin's wrenches on their bodies, from the predicted poses."""
    g, w = wp.tid()
    h = group[g]
    m = wp.spatial_vectord()
    for k in range(b.compliance.shape[1]):
        m -= b.compliance[h, k, w] * b.predicted[k, w]
    p, R = follow_wrench(h, w, b, m, pos[g, w], mat[g, w])
    pos_out[g, w] = p
    mat_out[g, w] = R


@dataclasses.dataclass(frozen=True)
class BodyMotion:
    """Compliance of the bodies of a skin's geoms: they move by compliance (wrench - predicted wrench).

    Attributes:
      compliance: (ngroup, ngroup, 6, 6) motion of one body by a wrench on another [m/N], about the origin of
        the BioTac frame, linear part first.
      wrench: (ngroup, 6) predicted wrench of the skin ON the bodies [N, N m].
      pos, arm: (ngroup, 3) reference points of the bodies at the predicted poses, and at the start of the
        step, where motions are measured [m].
      spin: (ngroup, 3) rotation vectors from the start of the step to the predicted poses [rad].
    """

    compliance: np.ndarray
    wrench: np.ndarray
    pos: np.ndarray
    arm: np.ndarray
    spin: np.ndarray

    def moved(self, wrench: np.ndarray) -> np.ndarray:
        """Motions (ngroup, 6) from the predicted poses by wrenches (ngroup, 6)."""
        return np.einsum("ghij,hj->gi", self.compliance, wrench - self.wrench)

    def without(self, group: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> tuple:
        """Poses (ngeom, 3), (ngeom, 3, 3) of the geoms without the skin's wrenches, from the predicted
        poses."""
        m, origin = self.moved(np.zeros_like(self.wrench)), self.pos[group]
        turn = (rotation(self.spin + m[:, 3:]) @ rotation(-self.spin))[group]
        translation = (m[:, :3] + cross(m[:, 3:], self.arm))[group]
        return origin + translation + (turn @ (pos - origin)[:, :, None])[:, :, 0], turn @ mat
