"""Contact of a known sensor: fits a press such that the simulator has the measured readings.

A Gauss-Newton method moves, tilts and slides the press: by the condensed tier and its differences, a hundred
times faster, for the start, and by the full skin, whose readings are fitted, and the tangents of its steps
from there.
Several combinations of place, depth, tilt and slide may have nearly the same readings. Gradients at one press
cannot tell how far these lie apart, since samples begin and cease to touch. Therefore presses at both ends of
the interval correct the gradients there.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from ...sensor.channels import electrode_noise, log_impedance, pressure_from_counts
from ...sensor.film import FilmConduction, NoFilmError
from ..record import Trajectory, follow
from ..sweep import Inputs, push_forward
from .belief import TILT
from .presses import Presses, Solved, frame_of, slopes_of_film

_STARTS, _SPACING = 3, 2e-3  # starting positions from the table at most, and their least distance [m]
_ITERATIONS, _LONGEST = 30, 1.0  # per start and tier; longest move of an iteration [mm]
_ALONG = 1e-4  # of a coordinate, in differences of paths
_STEP = 5e-4  # [m] longest step of a path: forces are those of steps of a quarter to 0.5 %
_SLIDE = 1.0  # [mm] standard deviation of a slide that follows a press, in each of two directions
_APART = np.array([0.05, 0.05, 0.05, 0.02, 0.02, 0.05, 0.05])  # of coordinates in differences [mm], [rad]
# least gain of -2 ln of the likelihood to go on for: well inside the interval; by the condensed tier
_CONVERGED, _ROUGHLY = 0.1, 2.0
_EXPLAINED = 2.0  # mean square residual, in variances of the noise, of a press that explains a reading
_SECANTS = 8  # pairs of presses at most that correct the gradients
_AGREES = 0.2  # relative error of a gradient that needs no correction


class _NoPressError(ValueError):
    """The geom does not touch the skin."""


_IMPOSSIBLE = NoFilmError, _NoPressError  # a press deeper than the film allows, or beside the skin


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """Fitted contact.

    Attributes:
      outcome: (7,) of `outcome_of`, mean of the fitted presses. covariance: (7, 7) of it.
      unexplained: fraction of the electrodes' change, RMS, that the most likely press does not explain.
    """

    outcome: np.ndarray
    covariance: np.ndarray
    unexplained: float


@dataclasses.dataclass(frozen=True, eq=False)
class _Press:
    """A simulated press at seven coordinates: its outcome, residuals in standard deviations (k,), -2 ln of
    its likelihood, the steps of the full skin, None by the condensed tier, and derivatives of outcome and
    residuals by the coordinates, None if not computed."""

    at: np.ndarray
    outcome: np.ndarray
    missed: np.ndarray
    cost: float
    trajectory: Trajectory | None = None
    outcome_by: np.ndarray | None = None
    missed_by: np.ndarray | None = None

    @property
    def explains(self) -> bool:
        """Whether its residuals are those of noise."""
        return self.missed @ self.missed < _EXPLAINED * len(self.missed)

    @property
    def spread(self) -> np.ndarray:
        """(7, 7) covariance of the coordinates, with the noise scaled to the residuals."""
        scale = max(1.0, self.missed @ self.missed / (len(self.missed) - len(_PRIOR)))
        return np.linalg.inv(self.missed_by.T @ self.missed_by / scale + np.diag(_PRIOR))


def noise_of(rest: np.ndarray, rows: int) -> np.ndarray:
    """(nelectrode + 1,) standard deviations of one row's change of ln Z and pressure [kPa] from the mean of
    `rows` rows of rest (nelectrode,) [counts]."""
    return np.append(electrode_noise(rest), 1.0) * slopes_at(rest) * np.sqrt(1 + 1 / rows)


def slopes_at(counts: np.ndarray) -> np.ndarray:
    """(nelectrode + 1,) sizes of the slopes of ln Z at counts (nelectrode,), and of pressure [kPa], by the
    counts."""
    slope = 0.5 * np.abs(log_impedance(counts + 1) - log_impedance(counts - 1))
    return np.append(slope, 1e-3 * (pressure_from_counts(1.0) - pressure_from_counts(0.0)))


def fit(
    presses: Presses, film: FilmConduction, signal: np.ndarray, noise: np.ndarray, progress: bool = False
) -> Fit:
    """Fits presses to a signal (nelectrode + 1,), or (nelectrode,) without pressure, with that noise.

    Raises:
      ValueError: no starting press can be simulated.
    """
    found = []
    with tqdm(desc="estimate: fit", unit="press", disable=not progress or None, leave=False) as bar:
        searches = [
            _Search(presses, film, signal, noise, start, bar) for start in _starts(presses, signal, noise)
        ]
        rough = [(press, search) for search in searches if (press := search.rough()) is not None]
        for start, search in sorted(rough, key=lambda one: one[0].cost):
            press = search.fine(start)
            found += [press] if press is not None else []
            if found and found[-1].explains:
                break
    if not found:
        raise ValueError("no press near what was read can be simulated: choose a row under less load")
    # several presses may fit: they are weighted by their likelihood
    best = min(found, key=lambda press: press.cost)
    likely = np.exp(-0.5 * (np.array([press.cost for press in found]) - best.cost))
    likely /= likely.sum()
    mean = likely @ np.array([press.outcome for press in found])
    covariance = sum(
        p
        * (one.outcome_by @ one.spread @ one.outcome_by.T + np.outer(one.outcome - mean, one.outcome - mean))
        for p, one in zip(likely, found)
    )
    n = presses.geometry.design.nelectrode
    fraction = float(np.linalg.norm((best.missed * noise)[:n]) / np.linalg.norm(signal[:n]))
    return Fit(mean, covariance, fraction)


# precisions of three moves [mm], which are free, of two tilts and of the slide
_PRIOR = np.array([0, 0, 0, TILT**-2, TILT**-2, _SLIDE**-2, _SLIDE**-2])


def _starts(presses, signal, noise):
    """Numbers of the table's presses with the most similar signal, at several positions."""
    far = (((presses.signal[:, : len(signal)] - signal) / noise) ** 2).sum(1)
    chosen, place = [], presses.outcome[:, 1:4]
    for k in np.argsort(far):
        if all(np.linalg.norm(place[k] - place[j]) > _SPACING for j in chosen):
            chosen.append(k)
        if len(chosen) == _STARTS:
            break
    return chosen


# scipy.optimize.least_squares takes no scale of the noise that is estimated with the fit, and no step that
# cannot be simulated
class _Search:
    """Search from one press of the table."""

    def __init__(self, presses, film, signal, noise, start, bar):
        self._presses, self._film, self._signal, self._noise = presses, film, signal, noise
        self._steps, self._place, self._bar = presses.path(*presses.at[start]), presses.at[start, :2], bar
        self._axes = frame_of(self._steps, presses.at[start, 1])
        self._known, self._nodes_by = [], np.zeros((0, 0))
        self._rest = np.log(film.impedance(presses.skin.model.rest.vert[: presses.geometry.nvert]))

    def rough(self) -> _Press | None:
        """The press of the condensed tier; None: none can be simulated."""
        try:
            start = self._differentiated(self._approximated(np.zeros(len(_PRIOR))))
            return self._fitted(start, self._approximated, self._differentiated, _ROUGHLY)
        except _IMPOSSIBLE:
            return None

    def fine(self, start: _Press) -> _Press | None:
        """The press of the full skin from that of the condensed tier; None: it cannot be simulated."""
        try:
            press = self._linear(self._simulate(start.at))
            return self._with_secants(self._fitted(press, self._simulate, self._linear, _CONVERGED))
        except _IMPOSSIBLE:
            return None

    def _fitted(self, here: _Press, simulate: Callable, differentiate: Callable, least: float) -> _Press:
        """Levenberg-Marquardt iterations, whose derivatives every press corrects (Broyden) and which takes
        new ones where these lead no further. The scale of the noise is estimated with the press, so the prior
        limits tilts and slide while the residual is large."""
        damping, fresh = 1e-2, True
        for _ in range(_ITERATIONS):
            scale = max(1.0, here.missed @ here.missed / len(here.missed))
            normal = here.missed_by.T @ here.missed_by / scale + np.diag(_PRIOR)
            pull = -here.missed_by.T @ here.missed / scale - _PRIOR * here.at
            if pull @ np.linalg.solve(normal, pull) < least or damping > 1e2:
                break
            move = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), pull)
            move *= min(1.0, _LONGEST / np.linalg.norm(move[:3]))
            try:
                there = simulate(here.at + move)
            except _IMPOSSIBLE:
                damping *= 10
                continue
            slope = move / _APART**2
            by, _ = _corrected(here, here, there, move, slope / (slope @ move))
            gain = here.cost - there.cost
            here = dataclasses.replace(there if gain > 0 else here, **by)
            if gain > least:
                damping, fresh = damping / 5, False
            elif not fresh:
                here, fresh = differentiate(here), True
            elif gain > 0:
                break
            else:
                damping *= 10
        return here

    def _with_secants(self, press):
        """The press with derivatives corrected by secants over one standard deviation to both sides: in turn
        along the directions in which the force, and the centre, are least known."""
        agrees = 0
        for k in range(_SECANTS):
            spread, centre_by = press.spread, press.outcome_by[1:4]
            axis = np.linalg.eigh(centre_by @ spread @ centre_by.T)[1][:, -1]
            slope = centre_by.T @ axis if k % 2 else press.outcome_by[0]
            slope = slope / np.sqrt(slope @ spread @ slope)
            move = spread @ slope
            try:
                ends = [self._simulate(press.at + sign * move) for sign in (-1, 1)]
            except _IMPOSSIBLE:
                break
            by, error = _corrected(press, *ends, 2 * move, slope / 2)
            press = dataclasses.replace(min([press, *ends], key=lambda one: one.cost), **by)
            agrees = agrees + 1 if error < _AGREES else 0
            if agrees == 2:
                break
        return press

    def _path(self, at, like=None):
        """Poses (nstep, 1, 3) [m], (nstep, 1, 3, 3) of a press at seven coordinates: moved along and around
        the finger, deeper [mm], tilted by two [rad], and then slid by two [mm]. The skin's curvature is in
        the moves, so that a place is changed at a depth. As many points as the path at `like`, or at `at`."""
        capsule, (along, around) = self._presses.capsule, self._place
        around_by = 1e-3 / (capsule.radius * max(np.cos(capsule.turn(along)), 0.3))
        there = along + 1e-3 * at[0], around + around_by * at[1]
        moved = capsule.frame(*there).T @ capsule.frame(*self._place)
        turn = Rotation.from_rotvec(at[3:5] @ self._axes).as_matrix()
        start, down = self._steps.pos[0, 0], (self._steps.pos[-1] - self._steps.pos[0])[0]
        length, counted = np.linalg.norm(down), at if like is None else like
        down, slide = turn @ down * (1 + 1e-3 * at[2] / length), 1e-3 * at[5:] @ self._axes
        counts = _count(length + 1e-3 * counted[2]), _count(1e-3 * np.linalg.norm(counted[5:]))
        first, then = (np.linspace(0, 1, n)[:, None] * leg for n, leg in zip(counts, (down, slide)))
        pos = start - capsule.at(*self._place) + np.concatenate([first, down + then[1:]])
        pos = pos @ moved.T + capsule.at(*there)
        return pos[:, None], np.repeat((moved @ turn @ self._steps.mat[0])[None], len(pos), axis=0)

    def _simulate(self, at):
        """Simulates a press of the full skin."""
        self._bar.update()
        skin, (pos, mat) = self._presses.skin, self._path(at)
        near = self._nodes_near(at, len(pos))
        with skin.lock:
            trajectory = follow(skin, pos[None], mat[None], skin.friction, skin.own, near=near)
        self._known.append((at, np.stack([step.x.numpy() for step in trajectory.steps])))
        last = self._presses.solved(trajectory.steps[-1], trajectory.rest)
        return self._read(at, last, trajectory)

    def _nodes_near(self, at, nstep):
        """Nodes (nstep, nvert, 1, 3) of a press by the nearest one of as many steps and its tangents [m];
        None: not known."""
        known = [one for one in self._known if len(one[1]) == nstep == self._nodes_by.shape[1]]
        if not known:
            return None
        there, nodes = min(known, key=lambda one: np.linalg.norm(at - one[0]))
        return nodes + np.tensordot(at - there, self._nodes_by, 1)[:, :, None]

    def _approximated(self, at):
        """Simulates a press of the condensed tier."""
        *_, last = self._presses.approximate(*self._path(at))
        return self._read(at, last)

    def _read(self, at, step: Solved, trajectory=None):
        if not len(step.touches):
            raise _NoPressError
        change = np.log(self._film.impedance(step.x)) - self._rest
        signal = np.append(change, 1e-3 * step.pressure)[: len(self._signal)]
        missed = (signal - self._signal) / self._noise
        scale = max(1.0, missed @ missed / len(missed))
        cost = missed @ missed / scale + len(missed) * np.log(scale) + at**2 @ _PRIOR
        return _Press(at, self._presses.outcome_of_step(step), missed, cost, trajectory)

    def _linear(self, press):
        """A press of the full skin with its derivatives by the coordinates, tangents of its steps; the middle
        of the contact stays."""
        presses, trajectory, k = self._presses, press.trajectory, len(_PRIOR)
        pose = np.zeros((k, 1, len(trajectory.steps), 1, 6))
        for one, move in zip(pose[:, 0, :, 0], _ALONG * np.eye(k)):
            (low, before), (high, after) = (self._path(press.at + m, press.at) for m in (-move, move))
            one[:, :3] = (high - low)[:, 0] / (2 * _ALONG)
            turn = after[:, 0] @ before[:, 0].mT
            one[:, 3:] = Rotation.from_matrix(turn).as_rotvec() / (2 * _ALONG)
        inputs = Inputs(pose, np.zeros((k, 1, 1)), {name: np.zeros((k, 1)) for name in presses.skin.own})
        with presses.skin.lock:
            tangents = push_forward(presses.skin, trajectory, inputs)
        self._nodes_by = tangents.nodes[:, 0]
        last = presses.solved(trajectory.steps[-1], trajectory.rest)
        _, slopes = slopes_of_film(self._film, last.x, tangents.nodes[:, 0, -1, : presses.geometry.nvert])
        signal_by = np.column_stack([slopes, 1e-3 * tangents.pressure[:, 0, -1]])[:, : len(self._signal)]
        outcome_by = presses.outcome_slopes(last, tangents.wrench[:, 0, -1, 0])
        missed_by = signal_by.T / self._noise[:, None]
        return dataclasses.replace(press, missed_by=missed_by, outcome_by=outcome_by.T)

    def _differentiated(self, press):
        """A press of the condensed tier with its derivatives by the coordinates, differences."""
        columns = []
        for move in np.diag(_APART):
            try:
                there = self._approximated(press.at + move)
            except _IMPOSSIBLE:  # the other way
                move = -move
                there = self._approximated(press.at + move)
            by = ((getattr(there, of) - getattr(press, of)) / move.sum() for of in ("missed", "outcome"))
            columns.append(tuple(by))
        missed_by, outcome_by = (np.array(rows).T for rows in zip(*columns))
        return dataclasses.replace(press, missed_by=missed_by, outcome_by=outcome_by)


def _corrected(press, begin, end, move, slope):
    """Derivatives of a press corrected along a move, by the presses at its ends, and their relative error
    there; slope @ move is 1."""
    by, errors = {}, []
    for of in ("missed", "outcome"):
        change, known = getattr(end, of) - getattr(begin, of), getattr(press, f"{of}_by")
        wrong = change - known @ move
        by[f"{of}_by"] = known + np.outer(wrong, slope)
        errors.append(np.linalg.norm(wrong) / np.linalg.norm(change))
    return by, errors[0]


def _count(length):
    """Points of a straight part of a path of that length [m], two or more."""
    return 1 + max(1, int(np.ceil(length / _STEP)))
