"""Three-dimensional conduction in the liquid between core and skin: the transduction of the synthetic
measured sensor.

It is independent of `sensor.film` except for the electrodes' positions. The liquid between the core and the
deformed skin is meshed with tetrahedra, electrodes are discs of constant potential (so floating ones shunt
the liquid), and the potential is solved with scikit-fem. The mesh is made once: columns start on the core in
fixed directions and end at the skin, so no tetrahedron inverts when the skin slides over the electrodes or is
pressed onto the core."""

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import ConvexHull, cKDTree

from ...geometry.closest import ray_distances
from ...geometry.core_surface import CoreSurface
from ...geometry.making.pads import column_tetrahedra
from ...geometry.rigid import across
from ...geometry.skin_geometry import SkinGeometry
from ...geometry.surface import face_areas, node_normals
from ...geometry.tet_mesh import connected_cells
from ...sensor.film import excitation_places

_RINGS = (
    (0.25e-3, 6),
    (0.5e-3, 12),
    (0.75e-3, 14),
    (1.1e-3, 14),
)  # radius [m] and points around each electrode; 0.5 mm is its rim
_LAYERS = (0.0, 0.2, 0.5, 1.0)  # of the gap: fine at the core, at the electrodes
_SPACING = 0.2e-3  # [m] least distance of points
_WET = 0.1e-3  # [m] thinner films at rest count as none: the skin is bonded there, or touches the core
_SLIP = 1.6e-3  # [m] most sliding of the skin over the core


class LiquidConduction:
    """Impedances of the electrodes by a three-dimensional solution. Constant after construction.

    Args:
      geometry: the skin with its core and electrodes.
      excitation: of X1, X2, ..., which are shorted and grounded; see `sensor.film.FilmConduction`.
      conductivity: of the liquid [S/m].
      residual_film: thickness of liquid where the skin touches the core [m]; or a function of points (n, 3)
        [m] on the core -> (n,).
      relief: additional thickness of the liquid over the geometry's, such a function; None: zero.

    Attributes:
      core_point (n, 3) [m], normal (n, 3): feet and directions of the columns. triangle (m, 3): of the core's
      wet surface.
      elem (9 m, 4): tetrahedra over nodes layer * n + column.

    Raises:
      ValueError: an electrode without liquid.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        excitation: np.ndarray,
        conductivity: float = 0.4,
        residual_film: float | Callable[[np.ndarray], np.ndarray] = 4e-5,
        relief: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        self.geometry, self.conductivity, self.residual_film = geometry, conductivity, residual_film
        self._layers = _LAYERS
        core = CoreSurface(geometry.core_vert, geometry.core_face)
        _, foot, owner = core.closest(excitation_places(excitation, geometry.design))
        self._n = geometry.design.nelectrode
        centre = np.concatenate([geometry.electrode_pos, foot])
        point, disc = _points(
            core, centre, np.concatenate([geometry.electrode_normal, core.normal[owner]]), geometry.core_vert
        )
        triangle = _triangulate(point, core)
        normal = _smooth_normals(point, triangle)
        self.core_point, self.normal = point, normal
        self._pair = self._pairs_within(np.arange(len(point)))
        gap = self.gap(geometry.vert, rest=True)
        triangle, keep = _wet_component(triangle, gap > _WET, disc)
        number = np.full(len(point), -1)
        number[keep] = np.arange(len(keep))
        self.core_point, self.normal, self.triangle, disc = (
            point[keep],
            normal[keep],
            number[triangle],
            disc[keep],
        )
        missing = [name for e, name in enumerate(geometry.design.discs) if (disc == e).sum() < 10]
        if missing:
            raise ValueError(
                f"no liquid over {', '.join(missing)}: the skin is bonded or lies on the core there; "
                "move the electrode"
            )
        self._floor = residual_film(self.core_point) if callable(residual_film) else residual_film
        self._relief = 0.0 if relief is None else relief(self.core_point)
        self._pair = self._pairs_within(np.arange(len(keep)))
        self.elem = column_tetrahedra(self.triangle, len(keep), len(self._layers) - 1)
        self._elem = np.ascontiguousarray(self.elem.T)
        self._set_unknowns(disc)

    def impedance(self, vert_xpos: np.ndarray) -> np.ndarray:
        """(n,) [ohm] of e1, e2, ... for nodes vert_xpos (nvert, 3) [m]: one electrode injects, X1, X2, ...
        sink, the others float."""
        from cholespy import CholeskySolverD, MatrixType

        matrix = self.matrix(self.nodes(self.gap(vert_xpos))).tocoo()
        row, column = self._unknown[matrix.row], self._unknown[matrix.col]
        inside = (row >= 0) & (column >= 0)
        reduced = coo_matrix(
            (matrix.data[inside], (row[inside], column[inside])), shape=(self._size, self._size)
        ).tocsc()
        reduced.sum_duplicates()
        coo = reduced.tocoo()
        solver = CholeskySolverD(
            self._size, coo.row.astype(np.int32), coo.col.astype(np.int32), coo.data, MatrixType.COO
        )
        own = np.arange(self._n)
        current = np.zeros((self._size, self._n))
        current[own, own] = 1
        potential = np.empty_like(current)
        solver.solve(current, potential)
        return potential[own, own] / self.conductivity

    def matrix(self, nodes: np.ndarray) -> object:
        """Stiffness matrix of the Laplacian over nodes (4 n, 3), in millimetres, per conductivity [m]
        (scikit-fem, linear tetrahedra)."""
        import skfem
        from skfem.models.poisson import laplace

        mesh = skfem.MeshTet(np.ascontiguousarray(1e3 * nodes.T), self._elem, validate=False, sort_t=False)
        return 1e-3 * laplace.assemble(skfem.Basis(mesh, skfem.ElementTetP1(), intorder=1))

    def nodes(self, gap: np.ndarray) -> np.ndarray:
        """(4 n, 3) nodes of the columns [m] for thicknesses gap (n,) [m]."""
        film = np.maximum(gap + self._relief, self._floor)
        return np.concatenate([self.core_point + (s * film)[:, None] * self.normal for s in self._layers])

    def gap(self, vert_xpos: np.ndarray, rest: bool = False) -> np.ndarray:
        """(n,) length of each column up to the inner skin [m]; negative below the core. A column without skin
        above it has its nearest node's height, or nan at `rest`."""
        column, face = self._pair
        corner = np.asarray(vert_xpos, float)[self.geometry.inner_face]
        away = ray_distances(corner[face], self.core_point[column], self.normal[column], -1e-3, 1e-6)
        gap = np.full(len(self.core_point), np.inf)
        np.minimum.at(gap, column, away)
        lost = ~np.isfinite(gap)
        if rest:
            gap[lost] = np.nan
        elif lost.any():
            inner = np.asarray(vert_xpos)[np.unique(self.geometry.inner_face)]
            nearest = inner[cKDTree(inner).query(self.core_point[lost])[1]]
            gap[lost] = np.einsum("ij,ij->i", nearest - self.core_point[lost], self.normal[lost])
        return gap

    def _pairs_within(self, columns):
        """Pairs (column, inner face) that may meet: at rest the distance between them is within the range of
        sliding."""
        centre = self.geometry.vert[self.geometry.inner_face].mean(1)
        tree = cKDTree(centre)
        lists = tree.query_ball_point(self.core_point[columns] + 1.2e-3 * self.normal[columns], 2.6e-3)
        column, face = (
            np.repeat(columns, [len(l) for l in lists]),
            np.concatenate([np.array(l, int) for l in lists]),
        )
        offset = centre[face] - self.core_point[column]
        height = np.einsum("ij,ij->i", offset, self.normal[column])
        aside = np.linalg.norm(offset - height[:, None] * self.normal[column], axis=1)
        within = aside < _SLIP
        return column[within], face[within]

    def _set_unknowns(self, disc):
        """Nodes of one disc share an unknown, first those of e1, e2, ...; nodes of X1, X2, ... are
        grounded."""
        n = len(disc)
        self._unknown = np.full(len(self._layers) * n, -1)
        bottom = np.where((disc >= 0) & (disc < self._n), disc, -1)
        free = np.flatnonzero(disc < 0)
        bottom[free] = self._n + np.arange(len(free))
        self._unknown[:n] = bottom
        above = (len(self._layers) - 1) * n
        self._unknown[n:] = self._n + len(free) + np.arange(above)
        self._size = self._n + len(free) + above


def _points(core, centre, direction, core_vert):
    """Points on the core (n, 3), dense around the electrodes, and the disc (n,) of each, -1 for none."""
    ring, disc = [centre], [np.arange(len(centre))]
    first, second = across(direction)
    for k, (radius, count) in enumerate(_RINGS):
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
        around = centre[:, None] + radius * (
            np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
        )
        ring.append(core.closest(around.reshape(-1, 3))[1])
        disc.append(np.where(radius <= 0.5e-3, np.repeat(np.arange(len(centre)), count), -1))
    disc = np.concatenate([*disc, np.full(len(core_vert), -1)])
    point = np.concatenate([*ring, core_vert])
    far = cKDTree(centre).query(point)[0]
    keep = (disc >= 0) | (np.arange(len(point)) < len(point) - len(core_vert)) | (far > 1.35e-3)
    keep &= (disc >= 0) | (far > 0.6e-3)  # no other point inside a disc
    point, disc = point[keep], disc[keep]
    tree, dropped = cKDTree(point), np.zeros(len(point), bool)
    for i, j in sorted(tree.query_pairs(_SPACING)):  # points of discs come first and stay
        if not (dropped[i] or dropped[j]) and disc[j] < 0:
            dropped[j] = True
    return point[~dropped], disc[~dropped]


def _triangulate(point, core):
    """Triangles (m, 3) over points of the core, normals outwards: Delaunay on a sphere to which the core is
    mapped."""
    middle = (point.max(0) + point.min(0)) / 2
    flat = (point - middle) * [0.5, 1, 1]  # about as long as it is wide
    triangle = ConvexHull(flat / np.linalg.norm(flat, axis=1, keepdims=True)).simplices
    area, outwards = face_areas(point, triangle), core.normal[core.closest(point[triangle].mean(1))[2]]
    inwards = np.einsum("ij,ij->i", area, outwards) < 0
    triangle[inwards] = triangle[inwards][:, ::-1]
    return triangle[np.linalg.norm(area, axis=1) > 5e-13]


def _smooth_normals(point, triangle):
    """Unit directions (n, 3) that vary smoothly over the core's edges."""
    normal, tree = node_normals(point, triangle), cKDTree(point)
    within = tree.query_ball_point(point, 1.2e-3)
    smooth = np.array([normal[l].sum(0) for l in within])
    return smooth / np.linalg.norm(smooth, axis=1, keepdims=True)


def _wet_component(triangle, wet, disc):
    """The connected wet triangles under the first electrode (m, 3) and their nodes (k,)."""
    first = np.flatnonzero(disc == 0)[0]
    parts = connected_cells(triangle[wet[triangle].all(1)])
    triangle = next((part for part in parts if first in part), np.zeros((0, 3), int))
    return triangle, np.unique(triangle)
