"""Triangle meshes as solids: tests whether a mesh bounds a solid, has the size of a part of a fingertip and
lies at its frame's origin, convex hulls, solids of height fields."""

from collections.abc import Iterable

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from .tet_mesh import enclosed_volume


def check_size(size: float, what: str = "skin", least: float = 5e-3, most: float = 0.1) -> None:
    """Raises ValueError unless the largest dimension [m] of a body is from `least` to `most`, by default that
    of a part of a fingertip."""
    if least <= size <= most:
        return
    meant = {1e-3: "is it in millimetres? ", 1e-6: "is it in micrometres? ", 1e3: "was it scaled twice? "}
    factor = next((factor for factor in meant if least <= factor * size <= most), None)
    remedy = "make it smaller" if size > most else "scale it to metres"
    if factor:
        remedy = f"{meant[factor]}multiply it by {factor:g}"
    raise ValueError(
        f"the {what}'s largest dimension is {1e3 * size:.4g} mm, not between {1e3 * least:g} and "
        f"{1e3 * most:g} mm: {remedy}"
    )


def check_place(vert: np.ndarray, what: str) -> None:
    """Raises ValueError where the box around vertices (n, 3) [m] is farther from the origin of their frame
    than it is long."""
    off = np.linalg.norm(np.maximum(np.maximum(vert.min(axis=0), -vert.max(axis=0)), 0.0))
    size = np.ptp(vert, axis=0).max()
    if off > size:
        raise ValueError(
            f"the {what} is {1e3 * off:.4g} mm from the origin of its frame, and {1e3 * size:.4g} mm long: "
            "move it to the origin"
        )


def bounds_solid(vert: np.ndarray, face: np.ndarray) -> bool:
    """Whether a mesh (n, 3) [m], (m, 3) bounds a solid: every edge is traversed equally often in both
    directions, and the outermost shells face outwards. Vertices within 1 nm are merged."""
    return no_solid(vert, face) is None


def no_solid(vert: np.ndarray, face: np.ndarray) -> str | None:
    """Why a mesh does not bound a solid, see `bounds_solid`, and the remedy; None if it does."""
    if not len(face):
        return "has no faces: give a triangle mesh"
    edges, _, (there, back) = _half_edges(vert, face)
    if not np.array_equal(np.sort(there), np.sort(back)):
        _, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
        odd = int((count % 2).sum())
        if odd:
            return f"is open: its inside is not defined, {odd} edges have one face only; close its holes"
        return "has faces of both orientations: make all normals point outwards"
    volume = np.linalg.det(vert[face] - vert.mean(axis=0))
    if abs(volume.sum()) <= 1e-6 * np.abs(volume).sum():
        return "encloses no volume: give a solid"
    if volume.sum() > 0 and np.array_equal(face_outwards(vert, face), face):
        return None
    return "is inside out: flip its faces, so that all normals point outwards"


def _half_edges(vert, face):
    """Half edges (k, 2) of a mesh with vertices within 1 nm merged, the face of each (k,), and numbers (k,)
    of each and of its opposite."""
    _, merged = np.unique(vert.round(9) + 0.0, axis=0, return_inverse=True)
    welded = merged.reshape(-1)[face]
    edges = np.concatenate([welded[:, [0, 1]], welded[:, [1, 2]], welded[:, [2, 0]]])
    long = edges[:, 0] != edges[:, 1]
    edges, owner = edges[long], np.tile(np.arange(len(face)), 3)[long]
    return edges, owner, [edges @ [len(vert), 1][::step] for step in (1, -1)]


def face_outwards(vert: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Faces (m, 3) of a closed mesh (n, 3) [m], each shell that is inside no other one turned outwards, and
    with it what is inside it, so that a cavity stays one. An open mesh stays as it is."""
    _, owner, edges = _half_edges(vert, face)
    there, back = (np.lexsort((owner, number)) for number in edges)
    if not np.array_equal(edges[0][there], edges[1][back]):
        return face
    joined = sparse.coo_array((np.ones(len(owner)), (owner[there], owner[back])), shape=[len(face)] * 2)
    _, part = connected_components(joined, directed=False)
    volume = np.bincount(part, np.linalg.det(vert[face] - vert.mean(axis=0)))
    # degenerate faces are shells of no volume
    inwards = np.flatnonzero(volume < -1e-9 * np.abs(volume).sum())
    others = np.flatnonzero(np.abs(volume) > 1e-9 * np.abs(volume).sum())
    shell = {k: face[part == k] for k in others.tolist()} if len(inwards) else {}
    turned = []
    for k in inwards.tolist():
        if not any(_inside(vert, shell[k], other) for other in shell.values()):
            turned += [k, *(j for j, other in shell.items() if _inside(vert, other, shell[k]))]
    return np.where(np.isin(part, turned)[:, None], face[:, ::-1], face)


def _inside(vert, inner, outer):
    """Whether a shell (k, 3) is inside another one (m, 3)."""
    point, corner = vert[inner].reshape(-1, 3), vert[outer].reshape(-1, 3)
    if (point.min(axis=0) <= corner.min(axis=0)).any() or (point.max(axis=0) >= corner.max(axis=0)).any():
        return False
    return all(abs(winding(at, vert[outer])) > 0.5 for at in point[:: len(point) // 32 + 1])


def winding(point: np.ndarray, corner: np.ndarray) -> float:
    """Winding number of closed triangles (m, 3, 3) around a point: solid angle (van Oosterom, Strackee
    1983)."""
    a, b, c = np.moveaxis(corner - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a)))
    across = np.linalg.det(np.stack([a, b, c], axis=1))
    return np.arctan2(across, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * np.pi)


def close_rim(face: np.ndarray) -> np.ndarray:
    """Faces (m, 3) of a surface with a fan over its rim, where it has one."""
    if not len(face):
        return face
    edges = np.concatenate([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]]).astype(np.int64)
    there, back = (edges @ [face.max() + 1, 1][::step] for step in (1, -1))
    rim = edges[~np.isin(there, back)]
    if not len(rim):
        return face
    first = rim[0, 0]
    rim = rim[(rim != first).all(axis=1)]
    fan = np.column_stack([rim[:, ::-1], np.full(len(rim), first)])
    return np.concatenate([face, fan.astype(face.dtype)])


def joined(meshes: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes (n, 3) [m], (m, 3) as one."""
    vert, face = zip(*meshes)
    first = np.cumsum([0, *map(len, vert[:-1])])
    return np.concatenate(vert), np.concatenate([f + n for f, n in zip(face, first)]).astype(np.int32)


def convex_hull(vert: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Mesh (k, 3) [m], (m, 3) of the convex hull of points (n, 3), faces outwards; None if they span no
    volume."""
    try:
        hull = ConvexHull(vert)
    except (QhullError, ValueError):  # flat, or fewer than four points
        return None
    inward = np.einsum("ij,ij->i", hull.equations[:, :3], np.cross(*_edges(vert, hull.simplices))) < 0
    face = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, face = np.unique(face, return_inverse=True)
    vert, face = vert[used], face.reshape(-1, 3).astype(np.int32)
    return (vert, face) if bounds_solid(vert, face) else None


def _edges(vert, face):
    corner = vert[face]
    return corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]


def ground(height: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed mesh (n, 3) [m], (m, 3) of MuJoCo's height field: height (nrow, ncol) in [0, 1], size (4,) [m]:
    half lengths in x and y, largest elevation, thickness of the base."""
    nrow, ncol = height.shape
    y, x = np.meshgrid(*(np.linspace(-s, s, n) for s, n in ((size[1], nrow), (size[0], ncol))), indexing="ij")
    top = np.stack([x, y, size[2] * height], axis=-1).reshape(-1, 3)
    number = np.arange(nrow * ncol).reshape(nrow, ncol)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    # each cell is divided from its lowest row and column to its highest, as in MuJoCo
    upper = np.concatenate([np.stack(corner, axis=-1).reshape(-1, 3) for corner in ((a, b, c), (a, c, d))])
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    lower, next_rim = len(top) + np.arange(len(rim)), np.roll(rim, -1)
    next_lower = np.roll(lower, -1)
    wall = np.concatenate([np.stack([rim, lower, next_lower], 1), np.stack([rim, next_lower, next_rim], 1)])
    floor = np.stack([np.full(len(rim), len(top) + len(rim)), next_lower, lower], 1)
    base = np.append(top[rim], [[0.0, 0.0, 0.0]], axis=0)
    base[:, 2] = -size[3]
    return np.concatenate([top, base]), np.concatenate([upper, wall, floor]).astype(np.int32)


def spread_points(vert: np.ndarray, face: np.ndarray, spacing: float, most: float = np.inf) -> np.ndarray:
    """Points (k, 3) on a mesh (n, 3) [m], (m, 3) with about this spacing [m], vertices first; the spacing is
    wider if there would be more than about `most` points."""
    corner = vert[face]
    first, second = _edges(vert, face)
    area = np.linalg.norm(np.cross(first, second), axis=1).sum() / 2
    spacing = max(spacing, float(np.sqrt(area / most)))
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    pieces, out = np.maximum(np.ceil(longest / spacing), 1).astype(int), [vert[np.unique(face)]]
    for n in np.unique(pieces[pieces > 1]).tolist():
        a, b = (x.ravel() / n for x in np.meshgrid(*[np.arange(n + 1)] * 2))
        weight = np.stack([a, b, 1 - a - b], axis=1)[a + b < 1 + 1e-9]
        out.append((weight @ corner[pieces == n]).reshape(-1, 3))
    points = np.concatenate(out)
    return points[np.sort(np.unique(np.floor(points / spacing), axis=0, return_index=True)[1])]


def farthest_points(point: np.ndarray, count: int, first: int = 0) -> np.ndarray:
    """(count,) indices of a farthest-point sampling of points (n, 3) that starts at `first`."""
    keep = [first]
    nearest = np.linalg.norm(point - point[first], axis=1)
    for _ in range(count - 1):
        keep.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(point - point[keep[-1]], axis=1))
    return np.array(keep)


def fills_hull(vert: np.ndarray, face: np.ndarray) -> bool:
    """Whether a closed mesh is convex: its volume is that of its convex hull to a thousandth."""
    hull = convex_hull(vert)
    return hull is None or enclosed_volume(vert, face) > (1 - 1e-3) * enclosed_volume(*hull)
