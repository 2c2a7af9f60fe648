"""The seventeen objects that touch the sensor: the paper's eight indenters, six pegs and three features of a
table.

Narang et al. (ICRA 2021) name pegs and table features without sizes: those here are chosen. Frames are those
of `press.indenter`: the tip at the origin, +y forward.
"""

import functools

import numpy as np

from ..geometry.indenters import INDENTERS
from ..geometry.rigid import UPRIGHT, Z_TO_Y, matrix, quaternion_from_y
from ..press.indenter import Indenter, make_indenter, solid
from ..triangles import trimesh

_EDGE = 0.5e-3  # [m] rounding of pegs and of the table's edges
_LENGTH = 12e-3  # [m] of a peg
_TABLE = 20e-3  # [m] half width of the block for the table: larger than the finger on all sides

PEGS = (
    "peg_round_4mm",
    "peg_round_8mm",
    "peg_square_5mm",
    "peg_square_10mm",
    "peg_hexagon_8mm",
    "peg_triangle_8mm",
)
TABLE = ("table_surface", "table_edge", "table_corner")
OBJECTS = (*INDENTERS, *PEGS, *TABLE)


def _box(name, half, turn):
    """A rounded box, rotated about its centre and shifted so that its foremost point is at the origin."""
    quat = (
        UPRIGHT
        if turn is None
        else quaternion_from_y(np.array(turn) / np.linalg.norm(turn)) * [1, -1, -1, -1]
    )
    reach = np.abs(matrix(quat)[1]) @ (np.array(half) - _EDGE) + _EDGE
    return solid(name, "box", half, quat, np.array([0.0, -reach, 0.0]), _EDGE)


def _prism(name, corners, width):
    """A regular prism as a mesh: the hull of balls at its corners, so that its edges are round; `width`:
    diameter of the circumscribed circle [m]."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=_EDGE).vertices
    angle = 2 * np.pi * np.arange(corners) / corners
    radius = width / 2 - _EDGE
    ring = radius * np.stack([np.cos(angle), np.zeros(corners), np.sin(angle)], axis=1)
    centre = np.concatenate([ring + [0, y, 0] for y in (-_EDGE, _EDGE - _LENGTH)])
    hull = trimesh.Trimesh((centre[:, None] + ball).reshape(-1, 3)).convex_hull
    return Indenter(
        name, "mesh", (), 0.0, np.zeros(3), UPRIGHT, np.asarray(hull.vertices), np.asarray(hull.faces)
    )


def make_object(name: str) -> Indenter:
    """One of OBJECTS, or any name for `press.indenter.make_indenter`.

    Raises:
      ValueError: unknown name; the text lists the names.
    """
    return make_indenter(name) if name.startswith("mesh:") else _made(name)  # a file may change


@functools.lru_cache(maxsize=32)
def _made(name):
    if name in INDENTERS or name.startswith("geom:"):
        return make_indenter(name)
    if name not in OBJECTS:
        raise ValueError(
            f"unknown object {name!r}: "
            f"choose from {', '.join(OBJECTS)}, or geom:TYPE:SIZE[,SIZE...], or mesh:FILE"
        )
    if name in TABLE:
        turn = {"table_surface": None, "table_edge": (0, 1, 1), "table_corner": (1, 1, 1)}[name]
        return _box(name, (_TABLE, _TABLE, _TABLE), turn)
    kind, width = name.split("_")[1], float(name.split("_")[2][:-2]) * 1e-3
    if kind == "round":
        pos = np.array([0.0, -_LENGTH / 2, 0.0])
        return solid(name, "cylinder", (width / 2, _LENGTH / 2), Z_TO_Y, pos, _EDGE)
    if kind == "square":
        return _box(name, (width / 2, _LENGTH / 2, width / 2), None)
    return _prism(name, {"hexagon": 6, "triangle": 3}[kind], width)
