"""Shapes of pads: domes and blocks of tetrahedra on a flat backing, and the core under a dome.

All are in the BioTac frame: the face of the backing is the plane y = 0, and the pad extends to -y. Metres, or
any other unit of length."""

import numpy as np
from numpy.typing import ArrayLike

from ..tet_mesh import TetMesh


def _disc(rings):
    """Points (n, 2) of the unit disc on `rings` rings, 6 k on ring k, and triangles (m, 3),
    counter-clockwise."""
    point, start, triangle = [np.zeros((1, 2))], [0, 1], []
    for k in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * k) / (6 * k)
        point.append(k / rings * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        start.append(start[-1] + 6 * k)
    for k in range(1, rings + 1):
        inner, outer = start[k - 1], start[k]
        few = max(6 * (k - 1), 1)
        for side in range(6):
            for i in range(k):
                a, b = outer + side * k + i, outer + (side * k + i + 1) % (6 * k)
                c = inner + (side * (k - 1) + i) % few
                triangle.append((a, b, c))
                if i < k - 1:
                    triangle.append((b, inner + (side * (k - 1) + i + 1) % few, c))
    return np.concatenate(point), np.array(triangle)


def ellipsoid_cap(semi_axes: ArrayLike, centre_y: float, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """The part below y = 0 of an ellipsoid about (0, centre_y, 0): vert (n, 3), the last 6 rings of them on
    the rim; face (m, 3), normals outwards."""
    a, b, c = semi_axes
    disc, face = _disc(rings)
    polar = np.hypot(*disc.T) * np.arccos(np.clip(centre_y / b, -1, 1))
    around = np.arctan2(disc[:, 1], disc[:, 0])
    side = np.sin(polar)
    vert = np.stack(
        [a * side * np.cos(around), centre_y - b * np.cos(polar), c * side * np.sin(around)], axis=1
    )
    vert[-6 * rings :, 1] = 0.0  # on the plane to the last bit
    return vert, face


def on_ellipsoid(point: np.ndarray, semi_axes: ArrayLike, centre_y: float) -> np.ndarray:
    """Points (n, 3) moved onto that ellipsoid, those on the plane y = 0 within it."""
    centre = np.array([0.0, centre_y, 0.0])
    scaled = (point - centre) / np.asarray(semi_axes, float)
    out = centre + (point - centre) / np.linalg.norm(scaled, axis=1, keepdims=True)
    rim = point[:, 1] > -1e-9
    scale = np.sqrt(1 - (centre_y / semi_axes[1]) ** 2)
    out[rim] = point[rim] * scale / np.hypot(*(point[rim][:, [0, 2]] / np.take(semi_axes, [0, 2])).T)[:, None]
    return out


def dome_shell(outer: tuple, inner: tuple, rings: int) -> TetMesh:
    """The shell between two ellipsoids' caps, each given as (semi axes (3,), centre_y)."""
    (vert, face), (within, _) = (ellipsoid_cap(*shape, rings) for shape in (outer, inner))
    return TetMesh(np.concatenate([within, vert]), column_tetrahedra(face, len(vert), 1))


def dome_core(shape: tuple, rings: int, facet: tuple | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The solid under an ellipsoid's cap with a flat top at y = 0: vert (n, 3), face (m, 3), closed.

    Args:
      shape: semi axes (3,) and centre_y. facet: unit normal (3,) and distance from the origin of a plane that
        cuts it, or None."""
    vert, face = ellipsoid_cap(*shape, rings)
    if facet is not None:
        beyond = vert @ np.asarray(facet[0], float)
        vert = vert * np.where(beyond > facet[1], facet[1] / np.maximum(beyond, 1e-12), 1.0)[:, None]
    rim, middle = len(vert) - 6 * rings + np.arange(6 * rings), len(vert)
    top = np.stack([np.roll(rim, -1), rim, np.full(len(rim), middle)], axis=1)
    return np.vstack([vert, np.zeros((1, 3))]), np.concatenate([face, top]).astype(np.int32)


def plate(outline: ArrayLike, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """A plate on the plane y = 0, upwards, of a convex outline (n, 2) in x and z, anticlockwise as x, z are
    drawn: vert (2 n + 2, 3), face (4 n, 3), closed."""
    x, z = np.transpose(outline)
    sides, centre = len(x), np.array([x.mean(), 0.0, z.mean()])
    ring = np.stack([x, np.zeros(sides), z], axis=1)
    up = np.array([0.0, thickness, 0.0])
    vert = np.vstack([ring, ring + up, [centre, centre + up]])
    i, j = np.arange(sides), np.roll(np.arange(sides), -1)
    low, high = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    sheets = (i, j, low), (j + sides, i + sides, high), (j, i, i + sides), (j, i + sides, j + sides)
    return vert, np.concatenate([np.stack(sheet, axis=1) for sheet in sheets]).astype(np.int32)


def block(size: ArrayLike, cells: ArrayLike) -> TetMesh:
    """A box under the plane y = 0, with cells (3,) along x, y, z; size (3,)."""
    (nx, ny, nz), (sx, sy, sz) = cells, size
    x, z = np.linspace(-sx / 2, sx / 2, nx + 1), np.linspace(-sz / 2, sz / 2, nz + 1)
    grid = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange((nx + 1) * (nz + 1)).reshape(nx + 1, nz + 1)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    face = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    layer = [
        np.stack([grid[:, 0], np.full(len(grid), y), grid[:, 1]], axis=1) for y in np.linspace(0, -sy, ny + 1)
    ]
    return TetMesh(np.concatenate(layer), column_tetrahedra(face, len(grid), ny))


def column_tetrahedra(triangle: np.ndarray, n: int, layers: int) -> np.ndarray:
    """Tetrahedra (3 layers m, 4) that fill the prisms over triangles (m, 3); the index of a node is layer * n
    + column.

    Each prism is divided from its column with the lowest index upwards, so that neighbours divide their
    common sides equally."""
    turn = np.argsort(triangle, axis=1)
    odd = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], bool)  # whether a permutation that begins so is odd
    flip = odd[turn[:, 0], turn[:, 1]]
    a, b, c = np.take_along_axis(triangle, turn, 1).T
    out = []
    for layer in range(layers):
        low, high = layer * n, (layer + 1) * n
        for tet in (
            (a + low, b + low, c + low, c + high),
            (a + low, b + low, c + high, b + high),
            (a + low, b + high, c + high, a + high),
        ):
            tet = np.stack(tet, 1)
            tet[flip, :2] = tet[flip, 1::-1]
            out.append(tet)
    return np.concatenate(out)
