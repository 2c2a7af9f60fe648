"""How the bodies that touch a skin give way while it is solved: one goes to its predicted pose with the
wrench that was predicted, and by the compliance of its inertia and of what holds it elsewhere with another.

So to contact a body is a compliance of rank six beside the skin's own (`docs/design.md`)."""

import dataclasses

import numpy as np
import warp as wp

from ..geometry import rigid_warp
from ..geometry.rigid import cross, rotation
from .types import mat33, vec3

__all__ = ["Bodies", "BodyMotion", "follow_wrench", "make_bodies"]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Bodies:
    """The bodies of each group of geoms [group, world]; wrenches are of the skin on them, wrenches and
    motions about the origin of the BioTac's frame, linear part first. Where poses are prescribed there are
    none."""

    # motion of one by a wrench on another [group, group, world]
    compliance: wp.array3d(dtype=wp.spatial_matrixd)
    predicted: wp.array2d(dtype=wp.spatial_vectord)  # wrenches with which their poses were predicted
    origin: wp.array2d(dtype=vec3)  # own points of the bodies at these poses
    arm: wp.array2d(dtype=vec3)  # and where the step begins, where motions are measured
    spin: wp.array2d(dtype=vec3)  # rotation vectors from there to these poses
    begun: wp.array2d(dtype=wp.spatial_vectord)  # wrenches of what is remembered, when the step begins
    converged: wp.array2d(dtype=wp.spatial_vectord)  # of the last converged load increment
    posed: wp.array2d(dtype=wp.spatial_vectord)  # those with which the geoms are where they are
    wrench: wp.array2d(dtype=wp.spatial_vectord)  # for a product with the compliance, and its result
    motion: wp.array2d(dtype=wp.spatial_vectord)
    column: wp.array2d(dtype=int)  # of its six among the equations after those of contact; -1: none is near


def make_bodies(groups: int, nworld: int) -> Bodies:
    """Of so many groups of geoms, on Warp's default device, that do not give way."""
    b = Bodies()
    b.compliance = wp.zeros((groups, groups, nworld), dtype=wp.spatial_matrixd)
    for name in ("predicted", "begun", "converged", "posed", "wrench", "motion"):
        setattr(b, name, wp.zeros((groups, nworld), dtype=wp.spatial_vectord))
    b.origin, b.arm, b.spin = (wp.zeros((groups, nworld), dtype=vec3) for _ in range(3))
    b.column = wp.full((groups, nworld), -1, dtype=int)
    return b


@wp.func
def follow_wrench(h: int, w: int, b: Bodies, m: wp.spatial_vectord, pos: vec3, mat: mat33):
    """Pose of a geom of body h, moved by m from where it is predicted at pos, mat."""
    more = vec3(m[3], m[4], m[5])
    # bodies turn by both at once, which is not by one after the other
    turn = rigid_warp.rotation(b.spin[h, w] + more) * wp.transpose(rigid_warp.rotation(b.spin[h, w]))
    origin = b.origin[h, w]
    go = vec3(m[0], m[1], m[2]) + wp.cross(more, b.arm[h, w])
    return origin + go + turn * (pos - origin), turn * mat


@dataclasses.dataclass(frozen=True)
class BodyMotion:
    """How the bodies of a skin's geoms give way: predicted ones move by compliance (wrench - predicted).

    Attributes:
      compliance: (ngroup, ngroup, 6, 6) motion of one body by a wrench on another [m/N], about the origin of
        the BioTac's frame, linear part first.
      wrench: (ngroup, 6) of the skin ON the bodies with which their poses were predicted [N, N m].
      pos, arm: (ngroup, 3) the bodies' own points at these poses, and where the step begins: motions are
        measured there [m].
      spin: (ngroup, 3) rotation vectors from there to these poses [rad].
    """

    compliance: np.ndarray
    wrench: np.ndarray
    pos: np.ndarray
    arm: np.ndarray
    spin: np.ndarray

    def moved(self, wrench: np.ndarray) -> np.ndarray:
        """(ngroup, 6) motions from the predicted poses by wrenches (ngroup, 6)."""
        return np.einsum("ghij,hj->gi", self.compliance, wrench - self.wrench)

    def without(self, group: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> tuple:
        """Poses (ngeom, 3), (ngeom, 3, 3) of the geoms without the skin's wrenches, for predicted ones."""
        m, origin = self.moved(np.zeros_like(self.wrench)), self.pos[group]
        turn = (rotation(self.spin + m[:, 3:]) @ rotation(-self.spin))[group]
        go = (m[:, :3] + cross(m[:, 3:], self.arm))[group]
        return origin + go + (turn @ (pos - origin)[:, :, None])[:, :, 0], turn @ mat
