"""Impedance of the electrodes: quasi-static conduction in the thin liquid film between the rigid core and
the skin.

The film is a sheet of conductance sigma h, where h is the gap from the deformed skin to the core. Its mesh is
the inner surface of the skin, moved halfway to the core. The P1 finite-element Laplacian L gives the
potential of any current pattern. The four excitation electrodes are short-circuited and grounded, one sensing
electrode injects the current, the others float (one pattern per electrode, one factorisation).

Electrodes are discs with uniform current density, so the result does not depend on where nodes lie under
them. Two contributions near a disc have closed forms in the local thickness h. The mesh injects the current
over a disc of radius b that it resolves, and ln(b / a) / (2 pi sigma h) is the resistance of the sheet
between b and the electrode's radius a. A sheet is exact only if it is thinner than the disc is wide;
`spreading_resistance` is the additional resistance of a slab of thickness h.

`FilmConduction` holds the constants of one skin and evaluates one deformed skin at a time; `BatchFilm`
evaluates many on one device. Both launch the kernels of `kernels.py`, distances from the core's triangles
and the sheet Laplacian, and Cholesky's method in the form that suits the device (`systems.py`). The solver is
direct: conjugate gradients would need tens of iterations, since a film pressed to a twentieth of its
thickness differs much from the one at rest."""

import copy
import functools
import threading
from collections.abc import Callable

import numpy as np
import warp as wp
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from scipy.special import j1

from biotac_mj.cache import cached
from biotac_mj.fields import as_numbers, as_real, check_entries, refuse_unknown
from biotac_mj.geometry.core_surface import CoreSurface
from biotac_mj.geometry.design import BIOTAC, Design, electrode_positions
from biotac_mj.geometry.rigid import across
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.tet_mesh import connected_cells
from biotac_mj.kernels import set_fields
from biotac_mj.launches import recorded
from biotac_mj.sensor.channels import impedance_from_counts
from biotac_mj.sensor.film import kernels
from biotac_mj.sensor.film.kernels import real, vec3
from biotac_mj.sensor.film.systems import THREADS, Pattern, edges, make_band, make_factor, solve_sheet
from biotac_mj.sensor.presets import Sensor, read_sensor

from ...short_repr import short_repr

# X1..X4 as (x [m], angle from the pad's midline about the core's axis [rad]). ESTIMATED, since not published
# for this sensor: the two pairs, symmetric about z = 0, that best explain the published rest counts
# (scripts/fit_excitation.py on the paper's mesh: ln Z correlates 0.978, RMS 0.054).
EXCITATION = BIOTAC.excitation
# [S/m], from that fit: the mean ln of film and published impedances are equal; about 30 mmol/l NaBr in water
# at 25 C
CONDUCTIVITY = 0.367
# [m], published cylinder about the x axis; only a start for the search of the core's surface
_CORE_RADIUS = 5.325e-3
ELECTRODE_RADIUS = 0.5e-3  # [m] of the discs (chosen: not published)
_FOOTPRINT = 0.8e-3  # [m], radius of the disc that injects into the sheet: resolved by 0.8 mm edges
# [m], tangential motion of the skin over an electrode for which the candidate faces suffice
_SLACK = 2.0e-3


class NoFilmError(ValueError):
    """The deformed skin leaves no conducting film."""


class FilmConduction:
    """Impedances of the sensing electrodes from the deformed skin. Constant after construction.

    Args:
      geometry: the skin, its core and its electrodes.
      conductivity: of the liquid [S/m].
      residual_film: thickness where the skin touches the core, kept by the asperities of its inner face [m]
        (chosen; catalogue range 20-100 um).
      electrode_radius: of all discs [m] (chosen: not published).
      excitation: positions of X1, X2, ... if not the design's: (k, 2), x [m] and angle about the x axis from
        the pad's midline, positive to +z [rad], on a cylindrical core; or (k, 3), points near the core [m];
        BioTac frame.
      sensor: name of one of the design's, or a `presets.Sensor`: one constant factor per electrode makes the
        skin at rest give its rest counts. "" is the design's own. None: all factors one, pure physics.

    Attributes:
      cell_constant: (n,), factor on the film's impedance.
      rest: (n,) impedance of the skin at rest [ohm].
      excitation_pos: (k, 3), X1, X2, ... on the core [m].

    Raises:
      ValueError: a parameter out of range, or an electrode that the film does not cover.
    """

    _power = 1.0  # exponent of the conductance over thickness

    def __init__(
        self,
        geometry: SkinGeometry,
        conductivity: float = CONDUCTIVITY,
        residual_film: float = 50e-6,
        electrode_radius: float = ELECTRODE_RADIUS,
        excitation: ArrayLike | None = None,
        sensor: str | Sensor | None = "",
    ):
        settings = {"residual_film": residual_film, "electrode_radius": electrode_radius}
        _check_numbers({"conductivity": conductivity, **settings}, geometry)
        self.design = design = geometry.design
        if not design.nelectrode:
            raise ValueError(f"{design.title} has no electrodes: leave the readings out (readings=False)")
        if sensor is not None:
            sensor = read_sensor(sensor or None, design=design)
        if excitation is None:
            seed = excitation_places(design.excitation, design, published=True)
        else:
            seed = excitation_places(excitation, design)
        self.geometry, self.conductivity = geometry, conductivity
        self.residual_film, self.electrode_radius = residual_film, electrode_radius
        self.core = CoreSurface(geometry.core_vert, geometry.core_face)
        _, self.excitation_pos, triangle = self.core.closest(seed)
        self._pos = np.concatenate([geometry.electrode_pos, self.excitation_pos])
        self._normal = np.concatenate([geometry.electrode_normal, self.core.normal[triangle]])
        self._set_mesh()
        self._set_discs()
        self._wanted = None if sensor is None else impedance_from_counts(sensor.rest)
        self._set_rest()

    def _set_rest(self):
        """Sets the cell constants to give the skin at rest the impedances of the sensor; to one without."""
        self.cell_constant = self.rest = np.ones(self.design.nelectrode)
        self._set_single()
        self.rest = self.impedance(self.geometry.vert)
        if self._wanted is not None:
            self.cell_constant = self._wanted / self.rest
            self.rest = self.cell_constant * self.rest
            self._set_single()

    def with_residual_film(self, thickness: float) -> "FilmConduction":
        """The same film with another thickness where the skin touches the core [m]."""
        _check_numbers({"residual_film": thickness}, self.geometry)
        other = copy.copy(self)
        other.residual_film = thickness
        other._set_mesh()
        other._set_rest()
        return other

    def impedance(self, vert_xpos: ArrayLike) -> np.ndarray:
        """Impedance of E1, E2, ...

        Args:
          vert_xpos: (nvert, 3) or (nworld, nvert, 3), deformed nodes in the BioTac frame [m].

        Returns:
          (n,) or (nworld, n) [ohm].

        Raises:
          ValueError: wrong shape, or a position that is not finite.
          NoFilmError: the skin is folded, or so far off that an electrode is uncovered.
        """
        vert_xpos = as_numbers("vert_xpos", vert_xpos)
        if vert_xpos.ndim not in (2, 3) or vert_xpos.shape[-2:] != (self.geometry.nvert, 3):
            raise ValueError(
                f"vert_xpos has shape {vert_xpos.shape}: the skin '{self.geometry.name}' needs "
                f"({self.geometry.nvert}, 3), or (nworld, {self.geometry.nvert}, 3)"
            )
        if vert_xpos.ndim == 3:
            out = np.empty((len(vert_xpos), self.design.nelectrode))
            for w, world in enumerate(vert_xpos):
                out[w] = self.impedance(world)
            return out
        x, valid, impedance, local = self._views
        with self._lock:
            if not (valid[0] and np.array_equal(x[:, 0], vert_xpos)):  # else the skin is as it was
                x[:, 0] = vert_xpos
                for launch in self._solve_single:
                    launch()
            if valid[0]:  # then all positions are finite
                return impedance[0].copy()
            local = local[:, 0].copy()
        self._check_finite(vert_xpos)
        missing = [name for name, thickness in zip(self.design.discs, local) if thickness == 0]
        if missing:
            raise NoFilmError(
                f"no liquid film over {', '.join(missing)}: the skin has left the electrode by more than "
                f"{_SLACK * 1e3:g} mm, or is bonded there"
            )
        raise NoFilmError(
            "the film's conductance is not positive definite: the inner surface is folded; keep the last "
            "good state"
        )

    @functools.cached_property
    def _band(self):
        return make_band(self.face, len(self.node), self._pair, len(self._pos))

    @functools.cached_property
    def _factor(self):
        sizes = len(self.node), len(self._pos)

        def make():
            pattern, size = make_factor(self.face, sizes[0], self._pair, sizes[1])
            return pattern | {"size": size}

        pattern = cached("film", [self.face, *self._pair, *sizes], make, ("sensor",))
        pattern = {name: value if np.ndim(value) else int(value) for name, value in pattern.items()}
        size = pattern.pop("size")
        return pattern, size

    def film(self, vert_xpos: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Geometry of the film under the skin.

        Args:
          vert_xpos: (nvert, 3) [m].

        Returns:
          middle (nnode, 3), the surface halfway between skin and core, and thickness (nnode,), at least
          `residual_film` [m], at the nodes `self.node`.
        """
        vert_xpos = np.asarray(vert_xpos, dtype=float)
        self._check_finite(vert_xpos)
        with self._lock:
            self._views[0][:, 0], self._views[1][0] = vert_xpos, 0  # no impedance belongs to it
            self._single.lay(self._x, self._now)
            return self._single.middle.numpy()[:, 0].copy(), self._single.thickness.numpy()[:, 0].copy()

    def _check_finite(self, vert_xpos):
        finite = np.isfinite(vert_xpos[self.node]).all(axis=1)
        if not finite.all():
            bad = self.node[~finite]
            raise ValueError(
                f"vert_xpos is not finite at {len(bad)} inner node(s), first {bad[0]}: "
                "the skin's step did not converge; keep the last good state"
            )

    def _set_single(self):
        """Makes the arrays of one world on the CPU, for one thread at a time."""
        self._single, self._lock = BatchFilm(self, 1), threading.Lock()
        self._x = wp.zeros((self.geometry.nvert, 1), dtype=vec3, device="cpu")
        self._now = wp.ones(1, dtype=int, device="cpu")
        self._solve_single = self._single.recorded(self._x, self._now)
        arrays = self._x, self._single.valid, self._single.impedance, self._single.local
        self._views = [array.numpy() for array in arrays]
        self._views[1][0] = 0

    def _set_mesh(self):
        """Film nodes, ordered for a small bandwidth. Faces bonded to core, nail or clamp (all nodes fixed)
        have no liquid."""
        fixed = np.zeros(self.geometry.nvert, dtype=bool)
        fixed[self.geometry.fixed] = True
        face = self.geometry.inner_face[~fixed[self.geometry.inner_face].all(axis=1)]
        if not len(face):
            raise ValueError(
                f"the skin '{self.geometry.name}' has no free inner face: no liquid film; check inner_face "
                "and fixed"
            )
        face = max(connected_cells(face), key=len)
        node, own = np.unique(face, return_inverse=True)
        order = reverse_cuthill_mckee(_face_graph(own.reshape(-1, 3), len(node)), symmetric_mode=True)
        self.node = node[order]
        index = np.full(self.geometry.nvert, -1)
        index[self.node] = np.arange(len(node))
        self.face = index[face]
        distance, foot, _ = self.core.closest(self.geometry.vert[self.node])
        self._rest_middle = 0.5 * (self.geometry.vert[self.node] + foot)
        self._rest_thickness = np.maximum(distance, self.residual_film)

    def _set_discs(self):
        """Sample points of equal area on a disc, and the candidate faces over each electrode."""
        self._footprint = max(self.electrode_radius, _FOOTPRINT)
        radius = np.sqrt((np.arange(3) + 0.5) / 3)
        angle = 2 * np.pi * (np.arange(8)[None] + np.array([0, 0.5, 0])[:, None]) / 8
        self._disc = self._footprint * np.stack(
            [radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)], axis=-1
        ).reshape(-1, 2)
        self._tangent = np.stack(across(self._normal), axis=1)
        corner = self._rest_middle[self.face]
        centre = corner.mean(1)
        reach = self._footprint + _SLACK + np.linalg.norm(corner - centre[:, None], axis=2).max(1)
        offset = centre[None] - self._pos[:, None]
        tangential = np.linalg.norm(np.einsum("efk,eak->efa", offset, self._tangent), axis=2)
        height = np.einsum("efk,ek->ef", offset, self._normal)
        # A face on the far side of the finger projects onto the disc too: it is excluded by its distance of
        # several millimetres.
        self._pair = np.nonzero((tangential < reach) & (np.abs(height) < _SLACK))


def read_film(
    given: object, electrode_radius: float | None = None, geometry: SkinGeometry | None = None
) -> dict:
    """Reads `options["film"]` into settings of `FilmConduction`.

    Args:
      given: dict of residual_film, electrode_radius [m], excitation; None is empty.
      electrode_radius: default [m]; None: the film's own.
      geometry: of the skin, to check the values against; None leaves that to `FilmConduction`.

    Raises:
      ValueError: not a dict, an unknown name, or an invalid value.
    """
    kinds = {"residual_film": float, "electrode_radius": float, "excitation": list}
    out = dict(check_entries("options['film']", {} if given is None else given, kinds, kinds))
    refuse_unknown(out, kinds, "options['film']")
    if electrode_radius is not None:
        out = {"electrode_radius": electrode_radius, **out}
    _check_numbers({name: value for name, value in out.items() if name != "excitation"}, geometry)
    if "excitation" in out:
        excitation_places(out["excitation"], BIOTAC if geometry is None else geometry.design)
    return out


def _check_numbers(given, geometry):
    for name, value in given.items():
        as_real(name, value, 0.0, above=True, unit="SI")
    places = electrode_positions(BIOTAC if geometry is None else geometry.design)
    half_distance = 1e-3 * pdist(places).min(initial=np.inf) / 2
    if given.get("electrode_radius", 0.0) >= half_distance:
        raise ValueError(
            f"electrode_radius is {given['electrode_radius']}: the electrodes would touch; pass less than "
            f"{half_distance:.2g} m, half of what the nearest two are apart"
        )
    if geometry is None:
        return
    inner = geometry.vert[np.unique(geometry.inner_face)]
    thickest = cKDTree(geometry.core_vert).query(inner)[0].max()
    if given.get("residual_film", 0.0) >= thickest:
        raise ValueError(
            f"residual_film is {given['residual_film']}: the film at rest is nowhere thicker than "
            f"{thickest:.2g} m; pass less (asperities have 2e-5 to 1e-4)"
        )


def excitation_places(given: ArrayLike, design: Design, published: bool = False) -> np.ndarray:
    """(k, 3) points near the core [m], BioTac frame, from excitation positions in a form of `FilmConduction`,
    or, with `published`, of `Design`.

    Raises:
      ValueError: wrong number or shape.
    """
    k = len(design.excitation)
    try:
        places = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        places = np.empty(0)
    if places.shape not in ((k, 2), (k, 3)) or not np.isfinite(places).all():
        raise ValueError(
            f"excitation is {short_repr(given)}: pass ({k}, 2) finite numbers, position x [m] and angle "
            f"[rad] of each electrode, or ({k}, 3), its place [m]"
        )
    if places.shape[1] == 3:
        return 1e-3 * design.in_biotac_frame(places) if published else places
    x, angle = places.T
    return np.stack([x, -_CORE_RADIUS * np.cos(angle), _CORE_RADIUS * np.sin(angle)], axis=1)


class BatchFilm:
    """The film of `nworld` sensors of one geometry on one device. Worlds that are not due compute nothing, so
    the same launches can be recorded in a CUDA graph and replayed every step.

    Args:
      film: `FilmConduction` that supplies the constants.
      nworld: number of worlds.
      device: Warp device.
      band: whether the Laplacian is solved as a band of tiles, else by its sparse factor (CPU only); None:
        only on CUDA.

    Attributes:
      impedance: (nworld, n) wp.array float64 [ohm], of the last `solve_film` that succeeded; at rest before.
      valid: (nworld,) wp.array int, 0 where the last one failed: an electrode without film over it, or a
        position that is not finite.
      rest: (n,) impedance at rest [ohm]. design: of the skin.
      middle, thickness, local: wp.arrays of the last film: the surface halfway between skin and core [node,
        world], its thickness [node, world] and the mean of that over each disc [disc, world] [m].
      nbytes: device memory of all worlds.
    """

    def __init__(self, film: FilmConduction, nworld: int, device: str = "cpu", band: bool | None = None):
        self.film, self.nworld, self.device, self.rest = film, nworld, wp.get_device(device), film.rest
        self.design = film.design
        self._record = None  # list that collects launches instead of running them
        band = self.device.is_cuda if band is None else band
        (pattern, size), n, (disc, face) = film._band if band else film._factor, len(film.node), film._pair
        table_step, table = spreading_table()
        geometry = film.geometry
        with wp.ScopedDevice(self.device):
            self._core = (
                film.core
                if self.device == film.core.device
                else CoreSurface(geometry.core_vert, geometry.core_face, self.device)
            )
            self._nearest_core = self._core.nearest(geometry.vert[film.node])
            self._node = wp.array(film.node, dtype=int)
            self._rest_thickness = wp.array(film._rest_thickness, dtype=real)
            self._face = wp.array(film.face, dtype=wp.vec3i)
            self._pattern, footprint = set_fields(Pattern(), **pattern), film._footprint
            starts = np.searchsorted(disc, np.arange(len(film._pos) + 1))
            self._discs = set_fields(kernels.Discs(), pos=film._pos, tangent=film._tangent, pair_start=starts)
            set_fields(self._discs, pair_disc=disc, pair_face=face, sample=film._disc, footprint=footprint)
            self._network = set_fields(kernels.Network(), spreading=table, step=table_step)
            self._network.radius, self._network.footprint = film.electrode_radius, footprint
            self._cell_constant = wp.array(film.cell_constant[None], dtype=real)
            self.impedance = wp.array(np.tile(self.rest, (nworld, 1)), dtype=real)
            self.valid = wp.ones(nworld, dtype=int)
            self.middle = wp.zeros((n, nworld), dtype=vec3)
            self.thickness = wp.zeros((n, nworld), dtype=real)
            self.local = wp.zeros((len(film._pos), nworld), dtype=real)
            self._given = wp.zeros((3 * (len(film.face) + len(face)), nworld), dtype=real)
            self._over = wp.zeros((len(face), nworld), dtype=int)
            self._system = wp.zeros((nworld, size), dtype=real)
            self._trial = wp.zeros_like(self.impedance)
        of_film = [self.middle, self.thickness, self.local]
        per_world = [*of_film, self._given, self._over, self._system, self._trial]
        self.nbytes = sum(array.capacity for array in per_world)

    def calibrate(self, x: wp.array) -> None:
        """Sets the cell constants of each world so that its skin at rest has the film's impedances.

        Args:
          x: (nvert, nworld) wp.array of vec3d, rest positions [m].

        Raises:
          NoFilmError: an electrode of some world has no film.
        """
        self.solve_film(x, wp.ones(self.nworld, dtype=int, device=self.device))
        if not self.valid.numpy().all():
            world = int(self.valid.numpy().argmin())
            raise NoFilmError(f"no liquid film over an electrode in world {world} at rest: take less filling")
        own = self.film.cell_constant * self.rest / self.impedance.numpy()
        with wp.ScopedDevice(self.device):
            self._cell_constant = wp.array(own, dtype=real)
            self.impedance.assign(np.tile(self.rest, (self.nworld, 1)))

    def lay(self, x: wp.array, due: wp.array) -> None:
        """Computes `middle` and `thickness`; arguments and errors as `solve_film`."""
        if x.device != self.device or due.device != self.device:
            raise ValueError(
                f"the film is on {self.device}, x on {x.device} and due on {due.device}: make both where "
                "the film is"
            )
        f = self.film
        constants = [
            self._core.core,
            self._nearest_core,
            self._node,
            f.residual_film,
            f._power,
            self._rest_thickness,
        ]
        self._launch(
            kernels.film_surface, self.middle.shape, [due, *constants, x], [self.middle, self.thickness]
        )

    def solve_film(self, x: wp.array, due: wp.array) -> None:
        """Computes new impedances of the worlds that are due. Launches only: may be captured in a CUDA graph.

        Args:
          x: (nvert, nworld) wp.array of vec3d, nodes in the BioTac frame [m].
          due: (nworld,) wp.array of int, 0: keep the last impedances.

        Raises:
          ValueError: an array is on another device.
        """
        self.lay(x, due)
        surface, given, discs = [self.middle, self.thickness], self._given, [due, self._discs, self._face]
        conductivity, pairs = self.film.conductivity, self._over.shape
        sheet = [due, self._face, conductivity, *surface]
        self._launch(kernels.face_conductance, (len(self._face), self.nworld), sheet, [given])
        self._launch(kernels.samples_over, pairs, [*discs, self.middle], [self._over])
        weights = [*discs, self._over, *surface]
        self._launch(kernels.find_weights, self.local.shape, weights, [given, self.local])
        known = [due, conductivity, self._network, self._pattern, self._cell_constant, given, self.local]
        found = [self._system, self._trial, self.impedance, self.valid]
        self._launch(solve_sheet, self.nworld, known, found, wp.launch_tiled, THREADS)

    def recorded(self, x: wp.array, due: wp.array) -> list[Callable[[], None]]:
        """The launches of `solve_film` with these arrays as functions (CPU). Packing the arguments once saves
        a quarter of the time."""
        self._record = []
        self.solve_film(x, due)
        made, self._record = self._record, None
        return made

    def _launch(self, kernel, dim, inputs, outputs, launch=wp.launch, block_dim=256):
        if self._record is not None:
            self._record.append(recorded(kernel, dim, inputs, outputs, tiled=launch is wp.launch_tiled))
            return
        launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=block_dim)


def spreading_resistance(ratio: ArrayLike, npoint: int = 20000) -> np.ndarray:
    """Additional resistance near a disc, relative to a thin sheet, times sigma a.

    A disc of radius a injects uniformly into a slab of thickness h between insulating planes. Its mean
    potential is a Hankel integral over coth(k h). The sheet accounts for the term 1 / (k h); the remainder is
    F(h/a) / (sigma a) with F(r) = 2/pi int J1(x)^2 / x^2 (coth(r x) - 1/(r x)) dx. F -> r / (3 pi) for thin
    films.

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
    # beyond the last point J1^2 averages 1 / (pi x) and coth - 1/y is about one
    tail = 1 / (np.pi**2 * 60.0**2)
    return (weight * (1 / np.tanh(y) - 1 / y)).sum(-1) + tail * np.where(
        ratio > 0.05, 1 - 1 / np.maximum(40 * ratio, 1), 0
    )


@functools.cache
def spreading_table() -> tuple[float, np.ndarray]:
    """Step in r / (1 + r), r = h / a, and values of `spreading_resistance`; the kernels interpolate in this
    table."""
    s = np.linspace(0, 0.98, 200)
    return float(s[1]), np.concatenate([[0.0], spreading_resistance(s[1:] / (1 - s[1:]), 2000)])


def _face_graph(face, nnode):
    i, j = edges(face)
    return coo_matrix(
        (np.ones(2 * len(i)), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(nnode, nnode)
    ).tocsr()
