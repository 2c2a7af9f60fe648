"""The eight indenters of Narang et al., ICRA 2021, as MuJoCo shapes. In the names the number is a diameter.

The indenter frame has its origin at the tip and presses along +y; the body lies in y <= 0. Dimensions were
measured on the paper's meshes, without handles and mounts, which never touch the skin. Edges of cylinders,
cube and ring have a radius of 1 mm."""

import dataclasses

import numpy as np

_EDGE = 0.001  # rounding of cylinders, cube and ring [m]; the meshes have it within their tessellation
_RING = (0.0035, 0.007)  # inner and outer radius [m]
_RING_HEIGHT = 0.007  # [m], down to where the paper's ring joins its mount
_SECTIONS = 96  # of a turned mesh
_ALONG_X = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # turns a geom's z axis to the indenter's x axis
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Indenter:
    """One indenter.

    Attributes:
      name: as in the paper.
      geom_type: MuJoCo's: "sphere", "cylinder", "box" or "mesh".
      size: MuJoCo's half sizes [m]: (radius,), (radius, half length), three half widths, or () for a mesh.
      rounding: radius of the edges [m]: the true shape is the geom shrunk by it, then inflated by it. 0 for
        spheres.
      pos: centre of the geom in the indenter frame [m].
      quat: its orientation there (w, x, y, z).
    """

    name: str
    geom_type: str
    size: tuple
    rounding: float
    pos: tuple
    quat: tuple = _UPRIGHT

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """The shape with its rounded edges as a closed mesh: vert (n, 3) [m], indenter frame, face (m, 3),
        normals outwards."""
        if self.geom_type == "sphere":
            radius = self.size[0]
            angle = np.linspace(0.0, np.pi, 49)
            vert, face = _revolve(np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1))
        elif self.geom_type == "cylinder":
            radius, half = self.size
            vert, face = _revolve(_rounded_rectangle(0.0, radius, -half, half, self.rounding))
            vert = vert[:, [1, 2, 0]]  # axis y to axis x (a rotation)
        elif self.geom_type == "box":
            vert, face = _rounded_box(np.array(self.size), self.rounding)
        else:
            ring = _rounded_rectangle(*_RING, -_RING_HEIGHT / 2, _RING_HEIGHT / 2, self.rounding)
            vert, face = _revolve(np.concatenate([ring, ring[:1]]))
        return vert + np.array(self.pos), face


def _sphere(name, diameter):
    return Indenter(name, "sphere", (diameter / 2,), 0.0, (0.0, -diameter / 2, 0.0))


def _cylinder(name, diameter, length):
    return Indenter(name, "cylinder", (diameter / 2, length / 2), _EDGE, (0.0, -diameter / 2, 0.0), _ALONG_X)


_ALL = (
    _sphere("sphere_3-5mm", 0.0035),
    _sphere("sphere_7mm", 0.007),
    _sphere("sphere_14mm", 0.014),
    _cylinder("cylinder_short_3-5mm", 0.0035, 0.007),
    _cylinder("cylinder_short_7mm", 0.007, 0.007),
    _cylinder("cylinder_long_7mm", 0.007, 0.028),
    Indenter("cube_14mm", "box", (0.007, 0.007, 0.007), _EDGE, (0.0, -0.007, 0.0)),
    Indenter("ring_7mm", "mesh", (), _EDGE, (0.0, -_RING_HEIGHT / 2, 0.0)),
)
INDENTERS = tuple(shape.name for shape in _ALL)


def indenter(name: str) -> Indenter:
    """One of the paper's eight indenters.

    Raises:
      ValueError: unknown name; the text lists the names.
    """
    for shape in _ALL:
        if shape.name == name:
            return shape
    raise ValueError(f"unknown indenter {name!r}: choose one of {', '.join(INDENTERS)}")


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
    from ..triangles import trimesh

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
