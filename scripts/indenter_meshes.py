"""Closed meshes of the paper's eight indenters, which `make_assets.py` writes."""

import numpy as np

from biotac_mj.geometry.indenters import RING_HEIGHT, Indenter
from biotac_mj.triangles import trimesh

__all__ = ["make_mesh"]

_RING = (0.0035, 0.007)  # inner and outer radius [m]
_SECTIONS = 96  # of a turned mesh


def make_mesh(shape: Indenter) -> tuple[np.ndarray, np.ndarray]:
    """A shape with its rounded edges: vert (n, 3) [m], indenter frame, face (m, 3), normals outwards."""
    if shape.geom_type == "sphere":
        radius = shape.size[0]
        angle = np.linspace(0.0, np.pi, 49)
        vert, face = _revolve(np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1))
    elif shape.geom_type == "cylinder":
        radius, half = shape.size
        vert, face = _revolve(_rounded_rectangle(0.0, radius, -half, half, shape.rounding))
        vert = vert[:, [1, 2, 0]]  # axis y to axis x (a rotation)
    elif shape.geom_type == "box":
        vert, face = _rounded_box(np.array(shape.size), shape.rounding)
    else:
        ring = _rounded_rectangle(*_RING, -RING_HEIGHT / 2, RING_HEIGHT / 2, shape.rounding)
        vert, face = _revolve(np.concatenate([ring, ring[:1]]))
    return vert + np.array(shape.pos), face


def _rounded_rectangle(inner, outer, low, high, edge, arc=9):
    """Clockwise profile (n, 2) of (radius, height), corners rounded; for inner = 0 it runs from the axis at
    `high` to the axis at `low`."""
    quarter = np.linspace(0.0, np.pi / 2, arc)

    def corner(r, y, start):
        return np.stack([r + edge * np.cos(start + quarter), y + edge * np.sin(start + quarter)], axis=1)

    corners = [corner(outer - edge, low + edge, -np.pi / 2), corner(outer - edge, high - edge, 0.0)]
    if inner == 0.0:
        return np.concatenate([[[0.0, low]], *corners, [[0.0, high]]])[::-1]
    corners += [corner(inner + edge, high - edge, np.pi / 2), corner(inner + edge, low + edge, np.pi)]
    return np.concatenate(corners)[::-1]


def _revolve(profile):
    """Closed mesh by turning a clockwise profile (n, 2) of (radius, height) about y; the profile is closed or
    starts and ends on the axis."""
    # in millimetres, since trimesh drops triangles of less than 1e-8
    turned = trimesh.creation.revolve(1e3 * profile[::-1], sections=_SECTIONS)
    return 1e-3 * turned.vertices[:, [1, 2, 0]], turned.faces.astype(np.int32)  # axis z to y (a rotation)


def _rounded_box(half, edge, arc=9):
    """Closed mesh of a box with half widths (3,) and rounded edges: a cube's grid, whose outer cells are bent
    round the edges."""
    bend = np.tan(np.linspace(0.0, np.pi / 4, (arc + 1) // 2))  # equal angles on each half of an edge
    line = np.concatenate([-1 - bend[::-1], [0.0], 1 + bend])  # |coordinate| >= 1: in the rounding
    n = len(line)
    u, v = (g.ravel() for g in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    points, faces = [], []
    for axis in range(3):
        for side in (-1, 1):
            grid = np.empty((n * n, 3))
            grid[:, axis], grid[:, (axis + 1) % 3], grid[:, (axis + 2) % 3] = 2.0 * side, line[u], line[v]
            core = np.clip(grid, -1, 1)
            outwards = grid - core
            points.append(core * (half - edge) + edge * outwards / np.linalg.norm(outwards, axis=1)[:, None])
            a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
            quads = np.stack([a, a + n, a + n + 1, a + 1], axis=1)[:, ::side]
            faces.append(np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]) + len(points[:-1]) * n * n)
    vert, index = np.unique(np.round(np.concatenate(points), 12), axis=0, return_inverse=True)
    return vert, index.reshape(-1)[np.concatenate(faces)].astype(np.int32)
