"""The parametric BioTac: skin, core, nail plate, clamp plate and electrodes as smooth implicit bodies.

The shape is described in millimetres, as it was published and measured; `SkinGeometry`, which the rest of the
package sees, is in metres.

Sources of the numbers:
  [lin]  the 19 electrode coordinates and the 30 degree facet of Lin et al. 2013.
  [nv]   dimensions measured on the mesh of Narang et al., ICRA 2021 (NVlabs/biotac_sim, MIT): least-squares
         fits of the section family below to its surface vertices, rounded to 0.01 mm; its vertices lie within
         0.06 mm RMS of these surfaces, most of it at the clamp.
"""

import dataclasses

import numpy as np

from biotac_mj.geometry.design import BIOTAC, electrode_positions

__all__ = [
    "BioTacDimensions",
    "Body",
    "biotac_bodies",
    "clamp_plate",
    "electrodes",
    "nail_plate",
]

# Sections at x [mm]: (x, centre y, radius, height of the flat top, radius of the edge between them). [nv] The
# flat tops are constant up to x = 0: there the skin is bonded to the nail plate (outside) and to the core
# (inside).
_OUTER = (
    (-18.0, -0.79, 6.97, 3.479, 3.60),
    (-15.0, -0.89, 6.99, 3.479, 3.60),
    (-12.0, -1.09, 7.08, 3.479, 3.52),
    (-7.0, -1.21, 7.10, 3.479, 3.52),
    (-2.0, -1.09, 7.11, 3.479, 3.60),
    (0.0, -0.93, 7.11, 3.479, 3.75),
    (1.0, -0.85, 7.06, 3.86, 4.60),
    (2.0, -0.82, 6.91, 4.50, 5.30),
    (3.0, -0.85, 6.66, 4.98, 5.75),
    (4.0, -0.88, 6.37, 5.26, 5.75),
    (5.0, -0.87, 6.13, 5.24, 5.50),
    (6.65, -0.85, 5.70, 4.84, 5.20),
)
_CAVITY = (
    (-18.0, -0.75, 5.38, 1.905, 2.00),
    (-15.0, -0.86, 5.41, 1.905, 2.00),
    (-12.0, -1.06, 5.52, 1.905, 1.95),
    (-7.0, -1.17, 5.53, 1.905, 1.95),
    (-2.0, -1.06, 5.55, 1.905, 2.00),
    (0.0, -0.91, 5.54, 1.905, 2.10),
    (1.0, -0.85, 5.47, 2.22, 2.50),
    (2.0, -0.85, 5.28, 2.74, 3.35),
    (3.0, -0.87, 5.05, 3.31, 4.10),
    (4.0, -0.90, 4.76, 3.68, 4.40),
    (5.08, -0.86, 4.51, 3.64, 4.20),
)
_CORE = (
    (-14.0, 0.0, 5.338, 1.905, 2.05),
    (0.0, 0.0, 5.338, 1.905, 2.05),
    (1.0, -0.09, 5.22, 2.02, 2.09),
    (2.0, -0.28, 5.05, 2.43, 2.68),
    (3.0, -0.50, 4.83, 2.96, 3.40),
    (4.0, -0.72, 4.61, 3.48, 4.10),
    (5.08, -0.84, 4.46, 3.60, 4.10),
)


@dataclasses.dataclass(frozen=True)
class BioTacDimensions:
    """Every dimension of the parametric BioTac [mm], BioTac frame (tip -x, pad -y, nail +y, clamp +x).

    A body is a row of sections, each a disc cut by a flat top with a rounded edge: rows (x, centre y, radius,
    top, edge radius). Beyond `*_tip` towards the fingertip the last section is turned about the y axis, which
    makes the spherical tip."""

    outer: tuple = _OUTER  # outer skin [nv]
    # centre of the tip sphere [nv]: the outermost point of the mesh is at x = -21.31
    outer_tip: float = -14.34
    outer_end: float = 6.65  # end face on the clamp plate [nv]
    outer_end_edge: float = 1.80  # its rounded edge [nv]
    cavity: tuple = _CAVITY  # inner skin [nv]
    cavity_tip: float = -14.36  # [nv]
    cavity_end: float = 5.08  # [nv]
    cavity_end_edge: float = 0.42  # [nv]
    core: tuple = _CORE  # rigid core, 10.65 mm in diameter [nv]
    core_tip: float = -13.98  # [nv]
    # [nv] has 5.105, 0.025 mm inside the skin; equal to cavity_end here, so that the skin is bonded without
    # overlap
    core_end: float = 5.08
    # [nv] has 0.5; wider, so that chords of the skin across its own edge of 0.42 do not cut into the core
    core_end_edge: float = 0.90
    # flat of electrodes E7-E10, 30 degrees to the axis [lin]
    facet_normal: tuple = (-0.5, -0.8660254037844386, 0.0)
    facet_offset: float = 10.795  # its distance from the origin [nv]
    facet_edge: float = 0.30  # [nv]
    nail_thickness: float = 1.0  # [nv]
    nail_x: tuple = (-17.38, 0.0)  # [nv]
    nail_half_width: float = 3.43  # [nv], also the radius of its round end
    clamp_thickness: float = 1.0  # [nv]
    clamp_centre_y: float = -0.8125  # [nv]
    clamp_radius: float = 4.1245  # [nv]


def _cut_disc(y, w, radius, top):
    """Signed distance in the (w, y) half plane, w >= 0, to the disc of `radius` about the origin cut at y =
    top; exact outside it."""
    top = np.minimum(top, radius)
    half = np.sqrt(radius * radius - top * top)
    corner = np.where(w <= half, y - top, np.hypot(w - half, y - top))
    return np.where(y * half <= top * w, np.hypot(y, w) - radius, corner)


def _rounded_max(a, b, edge):
    """Intersection of two distance fields with a rounded edge."""
    return (
        np.minimum(np.maximum(a, b) + edge, 0.0)
        + np.hypot(np.maximum(a + edge, 0.0), np.maximum(b + edge, 0.0))
        - edge
    )


class Body:
    """A smooth solid, negative inside: sections along x, a turned tip, a flat end and perhaps a facet.
    Millimetres."""

    def __init__(self, sections: tuple, tip: float, end: float, end_edge: float, facet: tuple | None = None):
        from scipy.interpolate import PchipInterpolator

        table = np.asarray(sections, dtype=float)
        self._x, self._tip, self._end, self._end_edge, self._facet = table[:, 0], tip, end, end_edge, facet
        # monotone, so that the flat tops stay exactly flat
        self._section = PchipInterpolator(table[:, 0], table[:, 1:], axis=0)

    def field(self, point: np.ndarray) -> np.ndarray:
        """Implicit function at (n, 3) [mm] -> (n,); close to a distance, zero on the surface."""
        x, y, z = np.asarray(point, dtype=float).T
        centre, radius, top, edge = self._section(np.clip(x, self._x[0], self._x[-1])).T
        w = np.hypot(z, np.minimum(x - self._tip, 0.0))  # turns the section at the tip
        value = _cut_disc(y - centre, w, radius - edge, top - edge - centre) - edge
        if self._facet is not None:
            normal, offset, facet_edge = self._facet
            value = _rounded_max(value, x * normal[0] + y * normal[1] + z * normal[2] - offset, facet_edge)
        return _rounded_max(value, x - self._end, self._end_edge)

    def gradient(self, point: np.ndarray, step: float = 1e-4) -> np.ndarray:
        """(n, 3) gradient of `field` by central differences; step [mm]."""
        shift = step * np.eye(3)
        return np.stack(
            [(self.field(point + s) - self.field(point - s)) / (2 * step) for s in shift], axis=-1
        )

    def normal(self, point: np.ndarray) -> np.ndarray:
        """(n, 3) unit outward normals."""
        gradient = self.gradient(point)
        return gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)

    def distance(self, point: np.ndarray) -> np.ndarray:
        """(n,) signed distance to first order, exact on the surface [mm]."""
        return self.field(point) / np.linalg.norm(self.gradient(point), axis=-1)

    def project(self, point: np.ndarray, iterations: int = 8) -> np.ndarray:
        """(n, 3) points moved onto the surface along its normals (Newton)."""
        point = np.array(point, dtype=float)
        for _ in range(iterations):
            gradient = self.gradient(point)
            point -= (self.field(point) / np.sum(gradient**2, axis=-1))[:, None] * gradient
        return point


def biotac_bodies(dimensions: BioTacDimensions = BioTacDimensions()) -> dict[str, Body]:
    """The three curved bodies by name: "outer" (skin outside), "cavity" (skin inside) and "core"."""
    d = dimensions
    return {
        "outer": Body(d.outer, d.outer_tip, d.outer_end, d.outer_end_edge),
        "cavity": Body(d.cavity, d.cavity_tip, d.cavity_end, d.cavity_end_edge),
        "core": Body(
            d.core, d.core_tip, d.core_end, d.core_end_edge, (d.facet_normal, d.facet_offset, d.facet_edge)
        ),
    }


def electrodes(core: Body) -> tuple[np.ndarray, np.ndarray]:
    """E1..E19 on the core: positions (19, 3) [mm] and unit outward normals (19, 3)."""
    position = core.project(BIOTAC.in_biotac_frame(electrode_positions()))
    return position, core.normal(position)


def nail_plate(dimensions: BioTacDimensions = BioTacDimensions()) -> tuple[np.ndarray, np.ndarray]:
    """Closed mesh of the nail plate on the flat top of the outer skin: vert (n, 3) [mm], face (m, 3); its end
    at the tip is round."""
    d = dimensions
    angle = np.linspace(np.pi / 2, 3 * np.pi / 2, 25)
    centre = d.nail_x[0] + d.nail_half_width
    outline = np.stack(
        [centre + d.nail_half_width * np.cos(angle), d.nail_half_width * np.sin(angle)], axis=1
    )
    side = np.linspace(0.0, 1.0, 10)[1:, None]
    low = outline[-1] + side * (np.array([d.nail_x[1], -d.nail_half_width]) - outline[-1])
    outline = np.concatenate([outline, low, low[::-1] * [1.0, -1.0]])  # counter-clockwise in (x, z)
    bottom = d.outer[0][3]
    vert, face = _prism(outline, bottom, bottom + d.nail_thickness)
    return vert[:, [0, 2, 1]], face[:, ::-1]  # (x, z, y) -> (x, y, z) is a reflection


def clamp_plate(dimensions: BioTacDimensions = BioTacDimensions()) -> tuple[np.ndarray, np.ndarray]:
    """Closed mesh of the clamp plate: vert (n, 3) [mm], face (m, 3), a disc on the end face of the outer
    skin."""
    d = dimensions
    angle = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
    outline = np.stack(
        [d.clamp_centre_y + d.clamp_radius * np.cos(angle), d.clamp_radius * np.sin(angle)], axis=1
    )
    vert, face = _prism(outline, d.outer_end, d.outer_end + d.clamp_thickness)
    return vert[:, [2, 0, 1]], face  # (y, z, x) -> (x, y, z) is a rotation


def _prism(outline, low, high):
    """Convex prism over a counter-clockwise outline (n, 2), from `low` to `high` along the third axis:
    closed, normals outwards."""
    n = len(outline)
    middle = outline.mean(axis=0)
    ring = np.concatenate([outline, middle[None]])
    vert = np.concatenate([np.c_[ring, np.full(n + 1, low)], np.c_[ring, np.full(n + 1, high)]])
    i, j, up = np.arange(n), np.roll(np.arange(n), -1), n + 1
    bottom = np.stack([j, i, np.full(n, n)], axis=1)
    top = np.stack([i + up, j + up, np.full(n, n + up)], axis=1)
    sides = np.concatenate([np.stack([i, j, j + up], axis=1), np.stack([i, j + up, i + up], axis=1)])
    return vert, np.concatenate([bottom, top, sides]).astype(np.int32)
