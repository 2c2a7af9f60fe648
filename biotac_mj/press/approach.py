"""First contact of an indenter with the undeformed skin: points and normals of its surface, and the distance
to first contact by ray casting."""

import mujoco
import numpy as np

from ..geometry.closest import ray_distances
from ..geometry.core_surface import CoreSurface
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.solid import winding
from ..geometry.surface import face_areas

# radius over which a normal is averaged [m]: about two edges of the default skin
_PATCH = 1.5e-3


def normal_at(geometry: SkinGeometry, point: np.ndarray) -> np.ndarray:
    """Unit outward normal (3,) of the outer surface around a point (3,) [m], averaged by area over a small
    patch."""
    distance = np.linalg.norm(geometry.vert[geometry.outer_face].mean(1) - point, axis=1)
    weight = np.clip(1 - distance / max(_PATCH, 1.01 * distance.min()), 0, None)
    normal = weight @ face_areas(geometry.vert, geometry.outer_face)
    return normal / np.linalg.norm(normal)


def surface_point(geometry: SkinGeometry, x: float, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """The point of the outer surface at a position along and around the finger.

    Args:
      geometry: the skin.
      x: along the finger, tip at -x [m].
      angle: around the x axis [rad]: 0 on the pad's midline, positive towards +z, pi on the nail.

    Returns:
      point (3,) [m] and unit outward normal (3,).

    Raises:
      ValueError: no surface there; the message gives the extent of the skin.
    """
    tri = geometry.vert[geometry.outer_face]
    outward = np.array([0.0, -np.cos(angle), np.sin(angle)])
    reach = 2 * np.abs(geometry.vert).max()
    distance = ray_distances(tri, np.array([x, 0.0, 0.0]) + reach * outward, -outward).min()
    if distance >= reach:
        low, high = 1e3 * tri[..., 0].min(), 1e3 * tri[..., 0].max()
        raise ValueError(
            f"no skin at x = {1e3 * x:g} mm: it reaches from {low:.1f} to {high:.1f} mm; choose x inside"
        )
    point = np.array([x, 0.0, 0.0]) + (reach - distance) * outward
    return point, normal_at(geometry, point)


def nearest_point(geometry: SkinGeometry, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point of the outer surface nearest to position (3,) [m], and its unit outward normal (3,)."""
    surface = CoreSurface(geometry.vert, geometry.outer_face)
    point = surface.closest(np.asarray(position, float)[None])[1][0]
    return point, normal_at(geometry, point)


def is_inside(vert: np.ndarray, face: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point (3,) is inside a closed mesh (n, 3) [m], (m, 3)."""
    return bool(abs(winding(np.asarray(point, float), vert[face])) > 0.5)


def _split(tri):
    """Divides each triangle (m, 3, 3) into four."""
    a, b, c = tri[:, 0], tri[:, 1], tri[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def first_touch(
    vert: np.ndarray,
    face: np.ndarray,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    direction: np.ndarray,
    resolution: float = 2e-5,
    keep: int = 48,
) -> float:
    """Distance that the geoms of a model travel along a direction until they first touch a surface.

    Rays are cast from the surface's faces against the direction to the geoms. The faces closest to a geom are
    divided repeatedly, so that contact inside faces is found, too.

    Args:
      vert, face: the surface, (n, 3) in the world frame of the model [m], (m, 3).
      model, data: with the indenter's geoms only, in front of the surface, after `mj_forward`.
      direction: of travel (3,).
      resolution: edge to which the nearest faces are divided [m]; on a sphere of radius r the distance is
        accurate to resolution^2 / r.
      keep: number of faces that are divided each time.

    Returns:
      travel [m]; inf if the geoms pass the surface.
    """
    backward = -np.asarray(direction, float) / np.linalg.norm(direction)
    geom = np.empty(1, np.int32)
    normal = np.zeros(3)

    def gap(points):
        hits = np.array([mujoco.mj_ray(model, data, p, backward, None, 1, -1, geom, normal) for p in points])
        return np.where(hits < 0, np.inf, hits)

    tri = _split(vert[face[face_areas(vert, face) @ backward > 0]])
    best = np.inf
    while len(tri):
        nearest = np.minimum(gap(tri.mean(1)), gap(tri.reshape(-1, 3)).reshape(-1, 3).min(1))
        best = min(best, nearest.min())
        tri = tri[np.argsort(nearest)[:keep]]
        if np.linalg.norm(tri - np.roll(tri, 1, axis=1), axis=2).max() < resolution:
            break
        tri = _split(tri)
    return float(best)
