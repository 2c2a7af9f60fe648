"""Distance of objects from the skin and the core, for many poses in parallel: first touch and admissible
depth."""

import numpy as np
import warp as wp

from ...kernels import kernel_module
from ...skin.contact.faces import face_samples
from ...skin.contact.posed import Geoms
from ...skin.contact.shapes import distance
from ...skin.geoms import GeomSet
from ...skin.types import real, vec3
from ..objects import make_object

kernel_module(__name__)

_FAR = 2e-3  # [m] range of a mesh's distance grid
_REACH = 0.12  # [m] longest travel to the first touch


@wp.kernel
def nearest(
    # In:
    points: wp.array(dtype=vec3),
    geoms: Geoms,
    far: real,
    # Out:
    distance_out: wp.array(dtype=real),
):
    """Smallest distance of any point to the geom, at most `far`. The order of the threads does not matter."""
    i, w = wp.tid()
    y = wp.transpose(geoms.mat[0, w]) * (points[i] - geoms.pos[0, w])
    d = distance(geoms.kind[0], geoms.size[0], geoms.rounding[0], geoms.grids, geoms.grid[0], y)[3]
    wp.atomic_min(distance_out, w, wp.min(d, far))


class Placed:
    """One object in `nworld` poses.

    Args:
      name: of the object.
      nworld: how many poses.
      device: of Warp.
      friction: Coulomb coefficient.

    Attributes:
      geoms: GeomSet with that one geom.
    """

    def __init__(self, name: str, nworld: int, device: str = "cpu", friction: float = 0.0):
        self._shape = make_object(name)
        self.geoms = GeomSet(**self._shape.geom, friction=[friction], nworld=nworld, device=device)

    def place(self, pos: np.ndarray, mat: np.ndarray) -> None:
        """Puts the object's frame at pos (nworld, 3) [m], turned by mat (nworld, 3, 3)."""
        self.geoms.set_pose(*self.pose(pos, mat))

    def pose(self, pos: np.ndarray, mat: np.ndarray) -> object:
        """Position (nworld, 1, 3) [m] and rotation (nworld, 1, 3, 3) of the geom for those of the object's
        frame."""
        pos, mat = self._shape.pose(np.asarray(pos, float), np.asarray(mat, float))
        return pos[:, None], mat[:, None]

    def nearest(self, points: wp.array) -> np.ndarray:
        """(nworld,) signed distance to the nearest of points (n,) vec3 [m], at most 2 mm."""
        out = wp.full(self.geoms.nworld, _FAR, dtype=real, device=self.geoms.device)
        wp.launch(
            nearest,
            dim=(len(points), self.geoms.nworld),
            inputs=[points, self.geoms.struct, _FAR],
            outputs=[out],
            device=self.geoms.device,
        )
        return out.numpy()


def surface_samples(vert: np.ndarray, face: np.ndarray, device: str, order: int = 3) -> wp.array:
    """Vertices of a surface and order^2 points in each face, on a device."""
    inside = np.einsum("sk,fkd->fsd", face_samples(order), np.asarray(vert)[face]).reshape(-1, 3)
    return wp.array(np.concatenate([np.asarray(vert)[np.unique(face)], inside]), dtype=vec3, device=device)


def first_touch(
    placed: Placed, points: wp.array, start: np.ndarray, mat: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Travel (nworld,) [m] from start (nworld, 3) along direction (nworld, 3) until the object touches one of
    the points.

    Each step is as long as the smallest distance, so it cannot pass a point. NaN if none is met within
    `_REACH`, or if the object starts in contact."""
    travel = np.zeros(len(start))
    for _ in range(400):
        placed.place(start + travel[:, None] * direction, mat)
        gap = placed.nearest(points)
        if not travel.any():
            begun = gap > 0
        moving = begun & (gap > 1e-7) & (travel < _REACH)
        if not moving.any():
            break
        travel += np.where(moving, gap, 0)
    return np.where(begun & (travel < _REACH) & (gap < 1e-5), travel, np.nan)
