"""First contact of an indenter with the undeformed skin: points and normals of its surface, and the distance
to first contact by ray casting."""

import mujoco
import numpy as np

from ..geometry.skin_geometry import SkinGeometry

__all__ = ["first_touch", "is_inside", "nearest_point", "room", "surface_point"]

# radius over which a normal is averaged [m]: about two edges of the default skin
_PATCH = 1.5e-3
_TOUCHING = 1e-5  # [m] largest depth of bonded skin in a solid


def _hits(tri, origin, direction):
    """Distances (m,) along a ray to the triangles tri (m, 3, 3), inf if it misses (Moeller and Trumbore,
    1997)."""
    a, ab, ac = tri[:, 0], tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]
    p = np.cross(direction, ac)
    det = np.einsum("ij,ij->i", ab, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - a
        u = np.einsum("ij,ij->i", s, p) / det
        q = np.cross(s, ab)
        v = q @ direction / det
        t = np.einsum("ij,ij->i", ac, q) / det
        # slightly wider than the triangle, so that no ray passes between two
        return np.where((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t >= 0), t, np.inf)


def _closest(tri, point):
    """Closest points (m, 3) of triangles tri (m, 3, 3) to a point: its projection on the plane if that is
    inside, else the closest point of the three edges."""
    a, b, c = tri[:, 0], tri[:, 1], tri[:, 2]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    foot = point - np.einsum("ij,ij->i", point - a, normal)[:, None] * normal
    inside = np.ones(len(tri), bool)
    best, best_distance = foot.copy(), np.full(len(tri), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ij,ij->i", np.cross(q - p, foot - p), normal) >= 0
        t = np.clip(np.einsum("ij,ij->i", point - p, q - p) / np.einsum("ij,ij->i", q - p, q - p), 0, 1)
        on_edge = p + t[:, None] * (q - p)
        distance = np.linalg.norm(on_edge - point, axis=1)
        best = np.where((distance < best_distance)[:, None], on_edge, best)
        best_distance = np.minimum(best_distance, distance)
    return np.where(inside[:, None], foot, best)


def _normal_at(tri, point):
    """Unit outward normal of the surface around a point, averaged by area over a small patch."""
    area_normal = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    distance = np.linalg.norm(tri.mean(1) - point, axis=1)
    weight = np.clip(1 - distance / max(_PATCH, 1.01 * distance.min()), 0, None)
    normal = weight @ area_normal
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
    distance = _hits(tri, np.array([x, 0.0, 0.0]) + reach * outward, -outward).min()
    if distance >= reach:
        low, high = 1e3 * tri[..., 0].min(), 1e3 * tri[..., 0].max()
        raise ValueError(
            f"no skin at x = {1e3 * x:g} mm: it reaches from {low:.1f} to {high:.1f} mm; choose x inside"
        )
    point = np.array([x, 0.0, 0.0]) + (reach - distance) * outward
    return point, _normal_at(tri, point)


def nearest_point(geometry: SkinGeometry, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point of the outer surface nearest to position (3,) [m], and its unit outward normal (3,)."""
    tri = geometry.vert[geometry.outer_face]
    candidates = _closest(tri, np.asarray(position, float))
    point = candidates[np.linalg.norm(candidates - position, axis=1).argmin()]
    return point, _normal_at(tri, point)


def is_inside(vert: np.ndarray, face: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point (3,) is inside a closed mesh (n, 3) [m], (m, 3), by the solid angle (van Oosterom and
    Strackee, 1983)."""
    a, b, c = np.moveaxis(vert[face] - np.asarray(point, float), 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = la * lb * lc + sum(
        np.einsum("ij,ij->i", p, q) * length for p, q, length in ((a, b, lc), (b, c, la), (c, a, lb))
    )
    return bool(abs(np.arctan2(volume, denominator).sum()) > np.pi)


def room(geometry: SkinGeometry, point: np.ndarray, direction: np.ndarray) -> float:
    """Distance from a point (3,) of the outer surface along a direction (3,) to core, nail or clamp [m]; inf
    if the ray misses them."""
    solids = (
        (geometry.core_vert, geometry.core_face),
        (geometry.nail_vert, geometry.nail_face),
        (geometry.clamp_vert, geometry.clamp_face),
    )
    unit = np.asarray(direction, float) / np.linalg.norm(direction)
    start = np.asarray(point, float) - _TOUCHING * unit
    distances = [_hits(vert[face], start, unit).min(initial=np.inf) for vert, face in solids]
    return max(float(min(distances)) - _TOUCHING, 0.0)


def _split(tri):
    """Divides each triangle (m, 3, 3) into four."""
    a, b, c = tri[:, 0], tri[:, 1], tri[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def first_touch(
    geometry: SkinGeometry,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    direction: np.ndarray,
    resolution: float = 2e-5,
    keep: int = 48,
) -> float:
    """Distance that the geoms of a model travel along a direction until they first touch the undeformed skin.

    Rays are cast from the skin's faces against the direction to the geoms. The faces closest to a geom are
    divided repeatedly, so that contact inside faces is found, too.

    Args:
      geometry: the skin, in the world frame of the model.
      model, data: with the indenter's geoms only, in front of the skin, after `mj_forward`.
      direction: of travel (3,).
      resolution: edge to which the nearest faces are divided [m]; on a sphere of radius r the distance is
        accurate to resolution^2 / r.
      keep: number of faces that are divided each time.

    Returns:
      travel [m].

    Raises:
      ValueError: the indenter would pass the skin.
    """
    backward = -np.asarray(direction, float) / np.linalg.norm(direction)
    geom = np.empty(1, np.int32)
    normal = np.zeros(3)

    def gap(points):
        hits = np.array([mujoco.mj_ray(model, data, p, backward, None, 1, -1, geom, normal) for p in points])
        return np.where(hits < 0, np.inf, hits)

    tri = geometry.vert[geometry.outer_face]
    facing = np.einsum("ij,j->i", np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]), backward) > 0
    tri = _split(tri[facing])
    best = np.inf
    while True:
        nearest = np.minimum(gap(tri.mean(1)), gap(tri.reshape(-1, 3)).reshape(-1, 3).min(1))
        best = min(best, nearest.min())
        tri = tri[np.argsort(nearest)[:keep]]
        if np.linalg.norm(tri - np.roll(tri, 1, axis=1), axis=2).max() < resolution:
            break
        tri = _split(tri)
    if not np.isfinite(best):
        raise ValueError(
            "the indenter passes the skin without touching it: change the location or the direction"
        )
    return float(best)
