"""Impedance of the 19 electrodes: quasi-static conduction in the thin liquid film between the rigid core and
the skin.

The film is a sheet of conductance sigma h, h the gap from the deformed skin to the core. It is triangulated
by the inner surface of the skin, laid halfway between skin and core, and its P1 finite-element Laplacian L
gives the potential of any current pattern. The four excitation electrodes are short-circuited and grounded,
one sensing electrode injects the current, the others float (19 patterns, one factorisation).

Electrodes are discs with uniform current density, so the result does not depend on how nodes fall under them.
Two parts of the field near a disc are closed forms with the film's local thickness h: the mesh carries the
current in over a disc of radius b that it resolves, and ln(b / a) / (2 pi sigma h) is the sheet between that
and the electrode's radius a; and a sheet is exact only where it is thinner than the disc is wide, so what a
slab of thickness h adds is `spreading_resistance`."""

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.special import j1

from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.sensor.channels import REST_COUNTS, impedance_from_counts
from biotac_mj.sensor.core_surface import CoreSurface
from biotac_mj.threads import single_thread

__all__ = ["CONDUCTIVITY", "EXCITATION", "FilmConduction", "sheet_laplacian", "spreading_resistance"]

# X1..X4 as (x [m], angle from the pad's midline about the core's axis [rad]). ESTIMATED: not published for
# this sensor; the two pairs, symmetric about z = 0, that best explain the published rest counts
# (scripts/fit_excitation.py on the paper's mesh: ln Z correlates 0.978, RMS 0.054).
EXCITATION = ((-6.76e-3, -1.235), (-6.76e-3, 1.235), (3.2e-3, -1.299), (3.2e-3, 1.299))
# [S/m], of that fit: the mean ln of film and published impedances agree; about 30 mmol/l NaBr in water at 25
# C
CONDUCTIVITY = 0.367
_CORE_RADIUS = (
    5.325e-3  # [m], published cylinder about the x axis; only says where to look for the core's surface
)
_FOOTPRINT = 0.8e-3  # [m], radius over which a disc's current enters the sheet: wide enough for 0.8 mm edges
_SLACK = (
    2.0e-3  # [m], tangential motion of the skin over an electrode that the list of candidate faces allows for
)


class FilmConduction:
    """Impedances of the 19 sensing electrodes from the deformed skin. Constant after construction, holds no
    state.

    Args:
      geometry: the skin, its core and its electrodes.
      conductivity: of the liquid [S/m].
      residual_film: thickness left where the skin lies on the core, held off by the asperities of its inner
        face [m] (chosen; catalogue range 20-100 um).
      electrode_radius: of all discs [m] (chosen: not published).
      excitation: (4, 2), position x [m] and angle about the x axis from the pad's midline, positive to +z
        [rad], of X1..X4.
      sensor: "1" | "2" | "3" calibrates one constant factor per electrode so that the skin at rest gives that
        sensor's published rest counts; None leaves the factors at one: physics alone.

    Attributes:
      cell_constant: (19,), what the film's impedance is multiplied with.
      excitation_pos: (4, 3), X1..X4 on the core [m].

    Raises:
      ValueError: a parameter out of range, or an electrode that the film does not cover.
    """

    def __init__(
        self,
        geometry: SkinGeometry,
        conductivity=CONDUCTIVITY,
        residual_film=50e-6,
        electrode_radius=0.5e-3,
        excitation=EXCITATION,
        sensor="1",
    ):
        for name, value in (
            ("conductivity", conductivity),
            ("residual_film", residual_film),
            ("electrode_radius", electrode_radius),
        ):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: pass a positive number in SI units")
        if sensor is not None and sensor not in REST_COUNTS:
            raise ValueError(
                f"sensor is {sensor!r}: pass one of {', '.join(map(repr, REST_COUNTS))}, or None for no "
                "calibration"
            )
        excitation = np.asarray(excitation, dtype=float)
        if excitation.ndim != 2 or excitation.shape[1] != 2 or not np.all(np.isfinite(excitation)):
            raise ValueError(
                f"excitation has shape {excitation.shape}: pass (n, 2) finite numbers, position x [m] and "
                "angle [rad] of each electrode"
            )

        self.geometry, self.conductivity, self.residual_film, self.electrode_radius = (
            geometry,
            conductivity,
            residual_film,
            electrode_radius,
        )
        self.core = CoreSurface(geometry.core_vert, geometry.core_face)
        x, angle = excitation.T
        seed = np.stack([x, -_CORE_RADIUS * np.cos(angle), _CORE_RADIUS * np.sin(angle)], axis=1)
        _, self.excitation_pos, triangle = self.core.closest(seed)
        self._pos = np.concatenate([geometry.electrode_pos, self.excitation_pos])
        self._normal = np.concatenate([geometry.electrode_normal, self.core.normal[triangle]])
        self._set_mesh()
        self._set_discs()
        self._spreading = _spreading_table()
        self.cell_constant = np.ones(19)
        if sensor is not None:
            self.cell_constant = impedance_from_counts(REST_COUNTS[sensor]) / self.impedance(geometry.vert)

    def impedance(self, vert_xpos):
        """Impedance of E1..E19.

        Args:
          vert_xpos: (nvert, 3) or (nworld, nvert, 3), deformed nodes in the BioTac frame [m].

        Returns:
          (19,) or (nworld, 19) [ohm].

        Raises:
          ValueError: wrong shape, a position that is not finite, or a skin so far off that it leaves an
            electrode uncovered.
        """
        vert_xpos = np.asarray(vert_xpos, dtype=float)
        if vert_xpos.ndim not in (2, 3) or vert_xpos.shape[-2:] != (self.geometry.nvert, 3):
            raise ValueError(
                f"vert_xpos has shape {vert_xpos.shape}: the skin '{self.geometry.name}' needs "
                f"({self.geometry.nvert}, 3), "
                f"or (nworld, {self.geometry.nvert}, 3)"
            )
        if vert_xpos.ndim == 3:
            return (
                np.stack([self.impedance(world) for world in vert_xpos])
                if len(vert_xpos)
                else np.empty((0, 19))
            )
        middle, thickness = self.film(vert_xpos)
        weight = self._disc_weights(middle)
        resistance = self._resistances(middle, thickness, weight)
        a, local = self.electrode_radius, thickness @ weight
        near = np.log(self._footprint / a) / (2 * np.pi * local) + self._spreading(local / a) / a
        resistance[np.diag_indices(len(self._pos))] += near / self.conductivity
        return self.cell_constant * _driving_point(resistance, 19)

    def film(self, vert_xpos):
        """The film under the skin.

        Args:
          vert_xpos: (nvert, 3) [m].

        Returns:
          middle (nnode, 3), the surface halfway between skin and core, and thickness (nnode,), at least
          `residual_film` [m], at the nodes `self.node`.
        """
        point = vert_xpos[self.node]
        if not np.all(np.isfinite(point)):
            bad = self.node[~np.all(np.isfinite(point), axis=1)]
            raise ValueError(
                f"vert_xpos is not finite at {len(bad)} inner node(s), first {bad[0]}: "
                "the skin's step did not converge; keep the last good state"
            )
        distance, foot, _ = self.core.closest(point)
        return 0.5 * (point + foot), np.maximum(distance, self.residual_film)

    def _set_mesh(self):
        """Film nodes in an order of small bandwidth. Faces bonded to core, nail or clamp (all nodes fixed)
        carry no liquid."""
        fixed = np.zeros(self.geometry.nvert, dtype=bool)
        fixed[self.geometry.fixed] = True
        face = self.geometry.inner_face[~fixed[self.geometry.inner_face].all(axis=1)]
        if not len(face):
            raise ValueError(
                f"the skin '{self.geometry.name}' has no free inner face: no liquid film; check inner_face "
                "and fixed"
            )
        graph = _face_graph(face, self.geometry.nvert)
        label = connected_components(graph, directed=False)[1]
        largest = np.argmax(np.bincount(label[face[:, 0]]))
        face = face[label[face[:, 0]] == largest]
        node = np.unique(face)
        order = reverse_cuthill_mckee(graph[node][:, node].tocsr(), symmetric_mode=True)
        self.node = node[order]
        index = np.full(self.geometry.nvert, -1)
        index[self.node] = np.arange(len(node))
        self.face = index[face]
        i, j = _edges(self.face)
        low, high = np.minimum(i, j), np.maximum(i, j)
        # LAPACK's lower band storage, column-major: entry (row, column) lies at column * (bandwidth + 1) +
        # row - column.
        self._band = int((high - low).max()) + 1
        diagonal = self._band * np.arange(len(node))
        self._slot = np.concatenate([diagonal[low] + high - low, diagonal[low], diagonal[high]])

    def _set_discs(self):
        """Points that stand for equal parts of a disc, and the faces that may come to lie over each
        electrode."""
        self._footprint = max(self.electrode_radius, _FOOTPRINT)
        radius = np.sqrt((np.arange(3) + 0.5) / 3)
        angle = 2 * np.pi * (np.arange(8)[None] + np.array([0, 0.5, 0])[:, None]) / 8
        self._disc = self._footprint * np.stack(
            [radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)], axis=-1
        ).reshape(-1, 2)
        helper = np.where(np.abs(self._normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
        tangent = np.cross(self._normal, helper)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        self._tangent = np.stack([tangent, np.cross(self._normal, tangent)], axis=1)
        corner = self.film(self.geometry.vert)[0][self.face]
        centre = corner.mean(1)
        reach = self._footprint + _SLACK + np.linalg.norm(corner - centre[:, None], axis=2).max(1)
        offset = centre[None] - self._pos[:, None]
        tangential = np.linalg.norm(np.einsum("efk,eak->efa", offset, self._tangent), axis=2)
        height = np.einsum("efk,ek->ef", offset, self._normal)
        # A face on the far side of the finger projects onto the disc too: it lies several millimetres under
        # it.
        self._pair = np.nonzero((tangential < reach) & (np.abs(height) < _SLACK))

    def _disc_weights(self, middle):
        """(nnode, 23): mean over each disc = weights applied to nodal values; columns sum to one."""
        electrode, face = self._pair
        offset = middle[self.face[face]] - self._pos[electrode, None]
        flat = np.einsum("pck,pak->pca", offset, self._tangent[electrode])
        near = np.all((flat.min(1) <= self._footprint) & (flat.max(1) >= -self._footprint), axis=1)
        electrode, face, flat = electrode[near], face[near], flat[near]
        e1, e2 = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
        d = self._disc[None] - flat[:, None, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (d[..., 0] * e2[:, None, 1] - d[..., 1] * e2[:, None, 0]) / area[:, None]
            t = (e1[:, None, 0] * d[..., 1] - e1[:, None, 1] * d[..., 0]) / area[:, None]
            pair, sample = np.nonzero((s >= 0) & (t >= 0) & (s + t <= 1))
        s, t, electrode = s[pair, sample], t[pair, sample], electrode[pair]
        key = electrode * len(self._disc) + sample
        hits = np.bincount(
            key, minlength=len(self._pos) * len(self._disc)
        )  # a sample on an edge or under a fold is shared
        covered = (hits.reshape(len(self._pos), -1) > 0).sum(1)
        if not covered.all():
            missing = [f"E{e + 1}" if e < 19 else f"X{e - 18}" for e in np.flatnonzero(covered == 0)]
            raise ValueError(
                f"no liquid film over {', '.join(missing)}: the skin has left the electrode by more than "
                f"{_SLACK * 1e3:g} mm, "
                "or is bonded there"
            )
        share = 1.0 / (hits[key] * covered[electrode])
        node = self.face[face[pair]]
        weight = np.zeros((len(self.node), len(self._pos)), order="F")
        value = np.stack([1 - s - t, s, t], axis=1) * share[:, None]
        np.add.at(weight, (node, electrode[:, None]), value)
        return weight

    def _resistances(self, middle, thickness, weight):
        """(23, 23) [ohm]: mean potential of disc i for a unit current into disc j, up to a constant that
        balanced currents cancel."""
        conductance = self.conductivity * thickness[self.face].mean(
            1
        )  # of a linear thickness: its mean is exact
        off = _cotangent_weights(middle, self.face, conductance).ravel()
        band = np.bincount(
            self._slot, np.concatenate([-off, off, off]), minlength=self._band * len(self.node)
        ).reshape(-1, self._band)
        band[0, 0] += band[
            :, 0
            # holds the free constant; no current flows through it, so the impedances do not depend on it
        ].mean()
        with single_thread():
            factor, info = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
            if info:
                raise ValueError(
                    "the film's conductance is not positive definite: the inner surface is folded; keep the "
                    "last good state"
                )
            half, _ = lapack.dtbtrs(factor, weight, uplo="L")
            return half.T @ half


def sheet_laplacian(point, face, conductance):
    """P1 finite-element matrix of div(s grad u) on a triangulated surface.

    Args:
      point: (n, 3) [m]; face: (m, 3); conductance: (m,) sheet conductance sigma h per face [S].

    Returns:
      scipy.sparse CSR (n, n) [S], positive semi-definite, constants in its kernel.
    """
    i, j = _edges(face)
    off = _cotangent_weights(point, face, np.asarray(conductance)).ravel()
    n = len(point)
    return coo_matrix(
        (
            np.concatenate([-off, -off, off, off]),
            (np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])),
        ),
        shape=(n, n),
    ).tocsr()


def spreading_resistance(ratio, npoint=20000):
    """Resistance near a disc that a thin sheet leaves out, times sigma a.

    A disc of radius a injects uniformly into a slab of thickness h between insulating planes. Its mean
    potential is a Hankel integral over coth(k h); the sheet keeps the part 1 / (k h) of it, the rest is
    F(h/a) / (sigma a) with F(r) = 2/pi int J1(x)^2 / x^2 (coth(r x)
    - 1/(r x)) dx: F -> r / (3 pi) for thin films.

    Args:
      ratio: (n,) h / a.

    Returns:
      (n,) F.
    """
    ratio = np.asarray(ratio, dtype=float)
    width = 60.0 / npoint
    x = (np.arange(npoint) + 0.5) * width
    weight = 2 / np.pi * width * (j1(x) / x) ** 2
    y = ratio[..., None] * x
    tail = 1 / (
        np.pi**2 * 60.0**2
    )  # J1^2 averages 1 / (pi x) and coth - 1/y is about one beyond the last point
    return (weight * (1 / np.tanh(y) - 1 / y)).sum(-1) + tail * np.where(
        ratio > 0.05, 1 - 1 / np.maximum(40 * ratio, 1), 0
    )


def _spreading_table():
    """F as a fast interpolant, linear in r / (1 + r)."""
    s = np.linspace(0, 0.98, 200)[1:]
    value = np.concatenate([[0.0], spreading_resistance(s / (1 - s), 2000)])
    s = np.concatenate([[0.0], s])
    return lambda ratio: np.interp(ratio / (1 + ratio), s, value)


def _driving_point(resistance, nsense):
    """Impedance of each sensing disc against the excitation discs, which share one potential and together
    sink the current."""
    sense, ground = slice(0, nsense), slice(nsense, None)
    nground = len(resistance) - nsense
    bordered = np.ones((nground + 1, nground + 1))
    bordered[:nground, :nground] = resistance[ground, ground]
    bordered[nground, nground] = 0
    rhs = np.concatenate([resistance[ground, sense], np.ones((1, nsense))])
    solution = np.linalg.solve(bordered, rhs)  # currents into the ground discs, then their common potential
    return np.diag(resistance)[sense] - (rhs[:nground] * solution[:nground]).sum(0) - solution[nground]


def _cotangent_weights(point, face, conductance):
    """(m, 3): conductance * cot / 2 of the angle opposite each edge of `_edges`."""
    corner = point[face]
    edge = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)  # edge k is opposite corner k
    double_area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
    double_area = np.maximum(
        double_area, 1e-6 * (edge**2).sum((1, 2))
    )  # a face squeezed to a line stays finite
    dot = -(np.roll(edge, -1, axis=1) * np.roll(edge, -2, axis=1)).sum(2)
    return 0.5 * conductance[:, None] * dot / double_area[:, None]


def _edges(face):
    """Nodes (3 m,) of the edges opposite corners 0, 1, 2 of every face."""
    return np.roll(face, -1, axis=1).ravel(), np.roll(face, -2, axis=1).ravel()


def _face_graph(face, nnode):
    i, j = _edges(face)
    return coo_matrix(
        (np.ones(2 * len(i)), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(nnode, nnode)
    ).tocsr()
