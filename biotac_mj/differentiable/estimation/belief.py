"""Prior and posterior of a sensor's constants, and their effect on its electrodes.

A sensor's response is the simulated one plus constants times sensitivities: gains, cross-talk, a common mode,
positions of the electrodes, residual film, fill and the gain of its pressure. The constants are normally
distributed over sensors, so learning them from touches with known force is linear regression. The modulus
scales the force, lognormal."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...geometry.skin_geometry import SkinGeometry
from .presses import Presses

# Standard deviations over sensors, and of the residual of a press: maximum likelihood for 80 presses of 4
# synthetic sensors (docs/lab/differentiable.md, A contact from electrodes), unless another source is given
_GAIN = 0.42  # of each electrode
_CROSS, _CROSS_MEAN, _REACH = 0.22, 0.1, 4e-3  # cross-talk of neighbours, and its range [m]
_COMMON_MODE = 0.63  # of the mean of all
_SHIFT, _EACH = 0.55, 0.75  # [mm] of the electrodes' positions, in common and each
_FLOOR = 0.85  # of ln of the residual film
_FILL = 0.75  # [ul]
_PRESSURE, _PRESSURE_MEAN = 0.2, -0.23  # of the pressure's gain
_MODULUS, _MODULUS_MEAN = 0.353, 0.049  # of ln of the force
TILT = 0.18  # [rad] of a press from the normal, in each of two directions: uniform to 25 degrees
# Standard deviation of the residual, as a fraction of an electrode's change and of the RMS change of all.
# CHOSEN: 1.6 times the most likely values (0.43, 0.08), so that intervals need less widening
_OFF, _LEVEL = 0.68, 0.126
_CORRELATION = 0.4  # correlation of both between neighbours
_ABSOLUTE, _COMMON = 0.006, 0.007  # residual of ln Z: of each, common to all
_KILOPASCAL = 0.2  # residual of the pressure
# CHOSEN, of ln of the force and of the centre [m]: the most likely value for forces, 0.11, excludes outliers
FORCE, PLACE = 0.3, 0.3e-3
_LABEL = 0.5e-3  # [m] error of given centres
AWAY = 1.5e-3  # [m] largest distance of a press from the touch
_ROUNDS, _LIKELY = 3, 8  # iterations of learning; candidate presses per touch


@dataclasses.dataclass(frozen=True)
class Touch:
    """A touch of the unknown sensor.

    Attributes:
      change: (nelectrode,) of ln Z from rest. pressure: its change [kPa], NaN: unknown.
      force: norm [N]. centre: (3,) of the contact on the skin at rest, in the BioTac frame [m].
    """

    change: np.ndarray
    pressure: float
    force: float
    centre: np.ndarray

    @property
    def signal(self) -> np.ndarray:
        """Changes of the electrodes, and of the pressure if known."""
        return np.append(self.change, self.pressure) if np.isfinite(self.pressure) else self.change


@dataclasses.dataclass(frozen=True, eq=False)
class Belief:
    """Normal distributions: mean (m,) and covariance (m, m) of a sensor's constants; mean and variance of ln
    of its force over the simulated one's."""

    mean: np.ndarray
    covariance: np.ndarray
    force: float
    force_variance: float


def believe(n: int) -> Belief:
    """Prior of a sensor with n electrodes."""
    design = (
        (n, 0, _GAIN), (1, _CROSS_MEAN, _CROSS), (1, 0, _COMMON_MODE), (2, 0, _SHIFT), (2 * n, 0, _EACH),
        (1, 0, _FLOOR), (1, 0, _FILL), (1, _PRESSURE_MEAN, _PRESSURE),
    )  # fmt: skip
    mean, spread = (np.repeat([p[k] for p in design], [p[0] for p in design]).astype(float) for k in (1, 2))
    return Belief(mean, np.diag(spread**2), _MODULUS_MEAN, _MODULUS**2)


class Posterior:
    """Posterior over presses, given a belief about the sensor.

    Args:
      presses: all. geometry: of the skin. belief: about the sensor. pressed: whether pressures are known.
      among: (k,) numbers of the candidate presses; None: all.
    """

    def __init__(
        self,
        presses: Presses,
        geometry: SkinGeometry,
        belief: Belief,
        pressed: bool = True,
        among: np.ndarray | slice = slice(None),
    ):
        n = geometry.design.nelectrode
        used = slice(n + 1 if pressed else n)
        signal, tilts = presses.signal[among], np.swapaxes(presses.by_press[among, :2], 1, 2)
        own, near = signal[:, :n], _nearness(geometry)
        floor, along, across = np.moveaxis(presses.by_sensor[among], 1, 0)
        design = np.zeros((len(signal), n + 1, len(belief.mean)))
        i = np.arange(n)
        for first, value in ((0, own), (n + 4, along[:, :n]), (2 * n + 4, across[:, :n])):
            design[:, i, first + i] = value
        design[:, :n, n], design[:, :n, n + 1] = own @ (near - np.eye(n)), own.mean(1)[:, None]
        design[:, :, n + 2], design[:, :, n + 3] = along, across
        design[:, :, -3], design[:, :, -2], design[:, n, -1] = floor, presses.by_press[among, 2], signal[:, n]
        level, alike = ((own**2).mean(1)[:, None, None], _CORRELATION * near + (1 - _CORRELATION) * np.eye(n))
        noise = np.zeros((len(signal), n + 1, n + 1))
        noise[:, :n, :n] = (_OFF**2 * own[:, :, None] * own[:, None] + _LEVEL**2 * level) * alike
        noise[:, :n, :n] += _ABSOLUTE**2 * np.eye(n) + _COMMON**2
        noise[:, n, n] = _KILOPASCAL**2
        noise += TILT**2 * tilts @ np.swapaxes(tilts, 1, 2)
        self._n = n
        self.design, self.noise, self.signal = design[:, used], noise[:, used, used], signal[:, used]
        covariance = self.design @ belief.covariance @ np.swapaxes(self.design, 1, 2) + self.noise
        self._inverse = np.linalg.inv(np.linalg.cholesky(covariance))
        self._expected = self.signal + self.design @ belief.mean
        self._scale = np.log(np.diagonal(self._inverse, axis1=1, axis2=2)).sum(1) + presses.weight[among]
        self._tilt = TILT**2 * self._inverse @ tilts[:, used]
        turned = presses.outcome_by[among]
        self._outcome_by = turned[:, :2]
        self._outcome = presses.outcome[among] + belief.mean[-2] * turned[:, 2]
        self._outcome[:, 0] += belief.force
        left = TILT**2 * np.eye(2) - np.swapaxes(self._tilt, 1, 2) @ self._tilt
        self.variance = np.einsum("nko,nkl,nlo->no", turned[:, :2], left, turned[:, :2])

    def __call__(self, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """ln of the likelihood of each press (n,), and its expected outcome (n, 7) with variance `variance`,
        for a signal (nelectrode + 1,), one less without pressure."""
        missed = np.einsum("nij,nj->ni", self._inverse, signal - self._expected)
        tilt = np.einsum("nik,ni->nk", self._tilt, missed)
        outcome = self._outcome + np.einsum("nk,nko->no", tilt, self._outcome_by)
        return self._scale - 0.5 * (missed**2).sum(1), outcome

    def unexplained(self, press: int, signal: np.ndarray) -> float:
        """Fraction of the electrodes' change, RMS, that a press does not explain."""
        n = self._n
        return float(np.linalg.norm(signal[:n] - self._expected[press, :n]) / np.linalg.norm(signal[:n]))


def likelihood(posterior: Posterior, touch: Touch, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
    """ln of the likelihood (n,) that the touch was each press, and ln of the touch's force over that of each
    (n,)."""
    likely, outcome = posterior(touch.signal)
    force = np.log(touch.force) - outcome[:, 0]
    spread = posterior.variance[:, :4] + np.array([FORCE**2 + belief.force_variance, *3 * [_LABEL**2]])
    missed = np.column_stack([force, touch.centre - outcome[:, 1:4]])
    return likely - 0.5 * (missed**2 / spread + np.log(spread)).sum(1), force


def learn(presses: Presses, geometry: SkinGeometry, touches: Sequence[Touch]) -> Belief:
    """Belief about a sensor after touches. The likelihood of a press for each follows from its force, its
    position and the belief so far.

    Raises:
      ValueError: no touch is near a simulated press.
    """
    before = belief = believe(geometry.design.nelectrode)
    off = [np.linalg.norm(presses.outcome[:, 1:4] - touch.centre, axis=1) for touch in touches]
    known = [(touch, np.flatnonzero(d < AWAY)) for touch, d in zip(touches, off) if (d < AWAY).any()]
    if not known:
        raise ValueError(
            f"no touch that is known lies within {1e3 * AWAY:g} mm of the sensing skin: give force [N] and "
            "contact_pos [m] in the BioTac frame"
        )
    prior = np.linalg.inv(before.covariance)
    for _ in range(_ROUNDS):
        precision, weighted = prior.copy(), prior @ before.mean
        stiff, scaled = 1 / before.force_variance, before.force / before.force_variance
        for touch, among in known:
            pressed = bool(np.isfinite(touch.pressure))
            posterior = Posterior(presses, geometry, belief, pressed, among)
            likely, force = likelihood(posterior, touch, belief)
            best = np.argsort(-likely)[:_LIKELY]
            p = np.exp(likely[best] - likely[best[0]])
            p /= p.sum()
            design = posterior.design[best]
            pull = np.swapaxes(np.linalg.solve(posterior.noise[best], design), 1, 2)
            precision += np.einsum("n,nij->ij", p, pull @ design)
            weighted += np.einsum("n,nij,nj->i", p, pull, touch.signal - posterior.signal[best])
            force = force[best] + belief.force
            about = p @ force
            one = p @ ((force - about) ** 2 + posterior.variance[best, 0]) + FORCE**2
            stiff, scaled = stiff + 1 / one, scaled + about / one
        covariance = np.linalg.inv(precision)
        belief = Belief(covariance @ weighted, covariance, scaled / stiff, 1 / stiff)
    return belief


def _nearness(geometry):
    """(nelectrode, nelectrode) proximity: 1 on the diagonal, decreasing with distance."""
    place = geometry.electrode_pos
    return np.exp(-np.linalg.norm(place[:, None] - place, axis=2) / _REACH)
