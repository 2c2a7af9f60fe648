"""Contact of a known sensor: fits a press such that the simulator has the measured readings.

A Gauss-Newton method moves and tilts the press. The simulator supplies its gradients, the table of presses
its start."""

import dataclasses
import functools

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from ...calibration.forward import Steps
from ...sensor.channels import electrode_noise, log_impedance, pressure_from_counts
from ...sensor.film import FilmConduction, NoFilmError
from ..record import follow
from ..sweep import Inputs, push_forward
from .belief import TILT
from .presses import Presses, frame_of, outcome_of, slopes_of_film

_STARTS, _SPACING = 3, 2e-3  # starting positions from the table, and their least distance [m]
_ITERATIONS, _LONGEST = 20, 0.5  # per start; longest move of an iteration [mm]
_CONVERGED = 0.1  # least gain of ln of the likelihood per iteration: well inside the interval


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
    """A simulated press: its outcome, residuals in standard deviations (k,), derivatives of both by its five
    coordinates, and -2 ln of its likelihood."""

    outcome: np.ndarray
    outcome_by: np.ndarray
    missed: np.ndarray
    missed_by: np.ndarray
    cost: float


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
    starts = _starts(presses, signal, noise)
    with tqdm(desc="estimate: fit", unit="press", disable=not progress or None, leave=False) as bar:
        searches = (_Search(presses, film, signal, noise, start, bar) for start in starts)
        found = [press for press in (search.run() for search in searches) if press is not None]
    if not found:
        raise ValueError("no press near what was read can be simulated: choose a row under less load")
    # several presses may fit: they are weighted by their likelihood
    best = min(found, key=lambda press: press.cost)
    likely = np.exp(-0.5 * (np.array([press.cost for press in found]) - best.cost))
    likely /= likely.sum()
    mean = likely @ np.array([press.outcome for press in found])
    covariance = sum(
        p * (_covariance(press, len(signal)) + np.outer(press.outcome - mean, press.outcome - mean))
        for p, press in zip(likely, found)
    )
    n = presses.geometry.design.nelectrode
    fraction = float(np.linalg.norm((best.missed * noise)[:n]) / np.linalg.norm(signal[:n]))
    return Fit(mean, covariance, fraction)


def _covariance(press, size):
    """(7, 7) covariance of a press's outcome, with the noise scaled to the residual of `size` numbers."""
    scale = max(1.0, press.missed @ press.missed / (size - len(_PRIOR)))
    own = np.linalg.inv(press.missed_by.T @ press.missed_by / scale + np.diag(_PRIOR))
    return press.outcome_by @ own @ press.outcome_by.T


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


class _Search:
    """Search from one press of the table."""

    def __init__(self, presses, film, signal, noise, start, bar):
        self._presses, self._film, self._signal, self._noise = presses, film, signal, noise
        self._steps = presses.path(*presses.at[start])
        self._axes, self._bar = frame_of(self._steps, presses.at[start, 1]), bar

    def run(self) -> _Press | None:
        """Levenberg-Marquardt iterations. The scale of the noise is estimated with the press, so the prior
        limits the tilts while the residual is large."""
        at, damping = np.zeros(5), 1e-2
        try:
            here = self._simulate(at)
        except NoFilmError:
            return None
        for _ in range(_ITERATIONS):
            scale = max(1.0, here.missed @ here.missed / len(here.missed))
            normal = here.missed_by.T @ here.missed_by / scale + np.diag(_PRIOR)
            pull = -here.missed_by.T @ here.missed / scale - _PRIOR * at
            move = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), pull)
            move *= min(1.0, _LONGEST / np.linalg.norm(move[:3]))
            try:
                there = self._simulate(at + move)
            except NoFilmError:  # deeper than the film allows
                there = None
            if there is None or there.cost >= here.cost:
                damping = max(1e-2, 10 * damping)
                if damping > 1e2:
                    break
                continue
            gain, at, here, damping = here.cost - there.cost, at + move, there, damping / 5
            if gain < _CONVERGED:
                break
        return here

    def _simulate(self, at):
        """Simulates a press moved by the first three coordinates [mm] and tilted by the others [rad]."""
        self._bar.update()
        skin, presses, start = self._presses.skin, self._presses, self._steps.pos[0]
        turn = Rotation.from_rotvec(at[3:] @ self._axes).as_matrix()
        pos = start + (self._steps.pos - start) @ turn.T + 1e-3 * at[:3]
        steps = Steps(pos, turn @ self._steps.mat, self._steps.dt, self._steps.ends)
        pose = np.zeros((5, 1, len(pos), 1, 6))
        pose[:3, 0, :, 0, :3] = 1e-3 * np.eye(3)[:, None]
        for k, axis in enumerate(self._axes):
            pose[3 + k, 0, :, 0] = np.column_stack(
                [np.cross(axis, pos[:, 0] - pos[0, 0]), np.tile(axis, (len(pos), 1))]
            )
        with skin.lock:
            trajectory = follow(skin, steps.pos[None], steps.mat[None], skin.friction, skin.own)
            still = {name: np.zeros((5, 1)) for name in skin.own}
            tangents = push_forward(skin, trajectory, Inputs(pose, np.zeros((5, 1, 1)), still))
        record, rest, n = trajectory.steps[-1], trajectory.rest, presses.geometry.nvert
        lies = rest.x[:n, 0].numpy() if rest else presses.geometry.vert
        before = np.log(self._film.impedance(lies))
        value, slopes = slopes_of_film(self._film, record.x[:n, 0].numpy(), tangents.nodes[:, 0, -1, :n])
        pressure = float(record.pressure - (rest.pressure if rest else 0.0))
        read = np.append(value - before, 1e-3 * pressure)
        read_by = np.column_stack([slopes, 1e-3 * tangents.pressure[:, 0, -1]])
        wrench = record.wrench[0, 0]
        outcome = functools.partial(outcome_of, middle=torch.from_numpy(presses.middle(record.touches)))
        by = torch.autograd.functional.jacobian(outcome, wrench).numpy() @ tangents.wrench[:, 0, -1, 0].T
        used = slice(len(self._signal))
        missed = (read[used] - self._signal) / self._noise[used]
        scale = max(1.0, missed @ missed / len(missed))
        cost = missed @ missed / scale + len(missed) * np.log(scale) + at**2 @ _PRIOR
        return _Press(outcome(wrench).numpy(), by, missed, (read_by[:, used] / self._noise[used]).T, cost)
