"""Contact of a known sensor: fits a press such that the simulator has the measured readings.

A Gauss-Newton method moves and tilts the press. The simulator supplies its gradients, the table of presses
its start. Several combinations of place, depth and tilt may have nearly the same readings. Gradients at one
press cannot tell how far these lie apart: samples begin and cease to touch, and errors of a few percent in
large gradients hide small ones. Therefore presses at both ends of the interval correct the gradients there.
"""

import dataclasses
import functools

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from ...sensor.channels import electrode_noise, log_impedance, pressure_from_counts
from ...sensor.film import FilmConduction, NoFilmError
from ..record import Trajectory, follow
from ..sweep import Inputs, push_forward
from .belief import TILT
from .presses import Presses, frame_of, outcome_of, slopes_of_film

_STARTS, _SPACING = 3, 2e-3  # starting positions from the table at most, and their least distance [m]
_ITERATIONS, _LONGEST = 20, 1.0  # per start; longest move of an iteration [mm]
_CONVERGED = 0.1  # least gain of ln of the likelihood per iteration: well inside the interval
_EXPLAINED = 2.0  # mean square residual, in variances of the noise, of a press that explains a reading
_SECANTS = 8  # pairs of presses at most that correct the gradients
_AGREES = 0.2  # relative error of a gradient that needs no correction


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
    """A simulated press at five coordinates: its steps, outcome, residuals in standard deviations (k,), -2 ln
    of its likelihood, and derivatives of outcome and residuals by the coordinates, None if not computed."""

    at: np.ndarray
    trajectory: Trajectory
    pos: np.ndarray
    outcome: np.ndarray
    missed: np.ndarray
    cost: float
    outcome_by: np.ndarray | None = None
    missed_by: np.ndarray | None = None

    @property
    def explains(self) -> bool:
        """Whether its residuals are those of noise."""
        return self.missed @ self.missed < _EXPLAINED * len(self.missed)

    @property
    def spread(self) -> np.ndarray:
        """(5, 5) covariance of the coordinates, with the noise scaled to the residuals."""
        scale = max(1.0, self.missed @ self.missed / (len(self.missed) - len(_PRIOR)))
        return np.linalg.inv(self.missed_by.T @ self.missed_by / scale + np.diag(_PRIOR))


def noise_of(rest: np.ndarray, rows: int) -> np.ndarray:
    """(nelectrode + 1,) standard deviations of one row's change of ln Z and pressure [kPa] from the mean of
    `rows` rows of rest (nelectrode,) [counts]."""
    slope = 0.5 * np.abs(log_impedance(rest + 1) - log_impedance(rest - 1))
    count = 1e-3 * (pressure_from_counts(1.0) - pressure_from_counts(0.0))
    return np.append(electrode_noise(rest) * slope, count) * np.sqrt(1 + 1 / rows)


def fit(
    presses: Presses, film: FilmConduction, signal: np.ndarray, noise: np.ndarray, progress: bool = False
) -> Fit:
    """Fits presses to a signal (nelectrode + 1,), or (nelectrode,) without pressure, with that noise.

    Raises:
      ValueError: no starting press can be simulated.
    """
    found = []
    with tqdm(desc="estimate: fit", unit="press", disable=not progress or None, leave=False) as bar:
        for start in _starts(presses, signal, noise):
            press = _Search(presses, film, signal, noise, start, bar).run()
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


_PRIOR = np.array([0, 0, 0, 1, 1]) / TILT**2  # precisions of three moves [mm], which are free, and two tilts


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
        self._steps = presses.path(*presses.at[start])
        self._axes, self._bar = frame_of(self._steps, presses.at[start, 1]), bar

    def run(self) -> _Press | None:
        """Levenberg-Marquardt iterations. The scale of the noise is estimated with the press, so the prior
        limits the tilts while the residual is large."""
        damping = 1e-2
        try:
            here = self._differentiated(self._simulate(np.zeros(5)))
        except NoFilmError:
            return None
        for _ in range(_ITERATIONS):
            scale = max(1.0, here.missed @ here.missed / len(here.missed))
            normal = here.missed_by.T @ here.missed_by / scale + np.diag(_PRIOR)
            pull = -here.missed_by.T @ here.missed / scale - _PRIOR * here.at
            move = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), pull)
            move *= min(1.0, _LONGEST / np.linalg.norm(move[:3]))
            try:
                there = self._simulate(here.at + move)
            except NoFilmError:  # deeper than the film allows
                there = None
            if there is None or there.cost >= here.cost:
                damping = max(1e-2, 10 * damping)
                if damping > 1e2:
                    break
                continue
            gain, here, damping = here.cost - there.cost, self._differentiated(there), damping / 5
            if gain < _CONVERGED:
                break
        return self._with_secants(here)

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
            except NoFilmError:
                break
            missed, outcome = (
                0.5 * (getattr(ends[1], of) - getattr(ends[0], of)) for of in ("missed", "outcome")
            )
            wrong = missed - press.missed_by @ move
            by = {
                "missed_by": press.missed_by + np.outer(wrong, slope),
                "outcome_by": press.outcome_by + np.outer(outcome - press.outcome_by @ move, slope),
            }
            best = min([press, *ends], key=lambda one: one.cost)
            press = dataclasses.replace(best, **by)
            agrees = agrees + 1 if np.linalg.norm(wrong) < _AGREES * np.linalg.norm(missed) else 0
            if agrees == 2:
                break
        return press

    def _simulate(self, at):
        """Simulates a press moved by the first three coordinates [mm] and tilted by the others [rad]."""
        self._bar.update()
        skin, presses, start = self._presses.skin, self._presses, self._steps.pos[0]
        turn = Rotation.from_rotvec(at[3:] @ self._axes).as_matrix()
        pos = start + (self._steps.pos - start) @ turn.T + 1e-3 * at[:3]
        with skin.lock:
            trajectory = follow(skin, pos[None], (turn @ self._steps.mat)[None], skin.friction, skin.own)
        record, rest, n = trajectory.steps[-1], trajectory.rest, presses.geometry.nvert
        lies = rest.x[:n, 0].numpy() if rest else presses.geometry.vert
        pressure = float(record.pressure - (rest.pressure if rest else 0.0))
        after, before = (np.log(self._film.impedance(x)) for x in (record.x[:n, 0].numpy(), lies))
        used = slice(len(self._signal))
        missed = (np.append(after - before, 1e-3 * pressure)[used] - self._signal) / self._noise[used]
        scale = max(1.0, missed @ missed / len(missed))
        cost = missed @ missed / scale + len(missed) * np.log(scale) + at**2 @ _PRIOR
        outcome = outcome_of(record.wrench[0, 0], self._middle(record)).numpy()
        return _Press(at, trajectory, pos, outcome, missed, cost)

    def _middle(self, record):
        return torch.from_numpy(self._presses.middle(record.touches))

    def _differentiated(self, press):
        """A press with its derivatives by the coordinates."""
        skin, pos, record = self._presses.skin, press.pos, press.trajectory.steps[-1]
        pose = np.zeros((5, 1, len(pos), 1, 6))
        pose[:3, 0, :, 0, :3] = 1e-3 * np.eye(3)[:, None]
        for k, axis in enumerate(self._axes):
            pose[3 + k, 0, :, 0] = np.column_stack(
                [np.cross(axis, pos[:, 0] - pos[0, 0]), np.tile(axis, (len(pos), 1))]
            )
        still = {name: np.zeros((5, 1)) for name in skin.own}
        with skin.lock:
            tangents = push_forward(skin, press.trajectory, Inputs(pose, np.zeros((5, 1, 1)), still))
        x, n = record.x[:, 0].numpy(), self._presses.geometry.nvert
        read_by = slopes_of_film(self._film, x[:n], tangents.nodes[:, 0, -1, :n])[1]
        used = slice(len(self._signal))
        read_by = np.column_stack([read_by, 1e-3 * tangents.pressure[:, 0, -1]])[:, used] / self._noise[used]
        outcome = functools.partial(outcome_of, middle=self._middle(record))
        by_wrench = torch.autograd.functional.jacobian(outcome, record.wrench[0, 0]).numpy()
        by = by_wrench @ tangents.wrench[:, 0, -1, 0].T
        return dataclasses.replace(press, outcome_by=by, missed_by=read_by.T)
