"""The eight indenters of Narang et al., ICRA 2021, as MuJoCo shapes. In the names the number is a diameter.

The indenter frame has its origin at the tip and presses along +y; the body lies in y <= 0. Dimensions were
measured on the paper's meshes, without handles and mounts, which never touch the skin. Edges of cylinders,
cube and ring have a radius of 1 mm."""

import dataclasses
import functools

import numpy as np

from ..fields import check_choice
from .assets import asset_path
from .making.importing import read_obj

_EDGE = 0.001  # rounding of cylinders, cube and ring [m]; the meshes have it within their tessellation
RING_HEIGHT = 0.007  # [m], down to where the paper's ring joins its mount
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
        return tuple(array.copy() for array in _mesh(self.name))


@functools.cache
def _mesh(name):
    ((vert, face),) = read_obj(asset_path(f"indenters/{name}.obj"))
    return vert, face


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
    Indenter("ring_7mm", "mesh", (), _EDGE, (0.0, -RING_HEIGHT / 2, 0.0)),
)
INDENTERS = tuple(shape.name for shape in _ALL)


def indenter(name: str) -> Indenter:
    """One of the paper's eight indenters.

    Raises:
      ValueError: unknown name; the text lists the names.
    """
    check_choice("unknown indenter", name, INDENTERS)
    return _ALL[INDENTERS.index(name)]
