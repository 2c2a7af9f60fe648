"""What a skin meets, as its solver takes it: the descriptions of touching geoms as a `GeomSet`."""

import functools

import numpy as np
import warp as wp

from ..geometry.skin_geometry import SkinGeometry
from ..skin import GeomSet, bake_distance_grid
from .stepper import Geom

__all__ = ["geom_set"]


def geom_set(
    geoms: list[Geom], geometry: SkinGeometry, nworld: int = 1, device: wp.DeviceLike = "cpu"
) -> GeomSet:
    """The geoms that may touch a skin.

    Args:
      geometry: of that skin. nworld: number of worlds. device: Warp device.
    """
    node, face = np.unique(geometry.outer_face, return_inverse=True)
    own = geometry.vert[node], face.reshape(-1, 3).astype(np.int32)
    return GeomSet(
        [g.type for g in geoms],
        [g.size for g in geoms],
        [g.friction for g in geoms],
        [g.group for g in geoms],
        [g.rounding for g in geoms],
        [_grid(g.vert.tobytes(), g.face.tobytes()) for g in geoms if g.type in ("mesh", "skin")],
        _grid(*(a.tobytes() for a in own)) if any(g.type == "skin" for g in geoms) else None,
        nworld=nworld,
        device=device,
    )


@functools.lru_cache(maxsize=16)
def _grid(vert, face):
    return bake_distance_grid(
        np.frombuffer(vert).reshape(-1, 3), np.frombuffer(face, np.int32).reshape(-1, 3)
    )
