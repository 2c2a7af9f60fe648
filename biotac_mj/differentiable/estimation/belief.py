"""What is believed of a sensor: how its own constants change what its electrodes read and what a press comes
to, before and after touches, labelled or not.

Of each press in the table what the electrodes read, force, centre and direction are jointly normal: expected
values plus the sensor's constants times slopes, plus the press's tilt, plus what neither explains. So what is
seen tells what is not by conditioning: of a press what it came to, of touches the sensor's constants. Which
press each touch was is unknown, and weighed; constants are the same in all. Expectation propagation (Minka,
2001) puts the touches together."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...geometry.skin_geometry import SkinGeometry
from ...sensor.channels import NELECTRODE
from .presses import SIGNALS, Presses

__all__ = ["Belief", "Posterior", "Session", "Touch", "believe", "constants_at"]

# Constants of a sensor: how many, mean and spread over sensors, by the ranges that real ones showed
# (`data.generation.synthetic_sensor` names the sources)
_CONSTANTS = {
    "gain": (NELECTRODE, 0.0, 0.27),  # of each electrode
    "near": (1, 0.05, 0.06),  # cross-talk of neighbours
    "share": (1, 0.0, 0.35),  # of the mean of all
    "shift": (2, 0.0, 0.58),  # [mm] of the electrodes, together along and across
    "each": (2 * NELECTRODE, 0.0, 0.3),  # [mm] and each
    "floor": (1, 0.0, 0.46),  # of ln of the residual film
    "floor_each": (NELECTRODE, 0.0, 0.46),
    "relief": (NELECTRODE, 0.0, 1.9),  # [0.1 mm] of the liquid's thickness over each
    "fill": (1, 0.0, 67.0),  # [ul]
    "ratio": (1, 0.0, 0.0375),  # Poisson's
    "pressure": (1, 0.1, 0.05),  # of its gain
    "modulus": (1, 0.02, 0.3),  # of its ln
    "uneven": (2, 0.0, 0.15),  # [1/cm] of the modulus, along and across
}
_REACH = 4e-3  # [m] of cross-talk
_TILT = 0.2  # [rad] of a press from the normal, in each of two directions: to 25 degrees, evenly
# What neither explains, CHOSEN after four sets were tried on 59 presses of synthetic sensors 301 to 308
# (docs/lab/differentiable.md, A contact from electrodes): of an electrode's change, and of the RMS of all;
# the part of both that neighbours share; of ln Z, of each and of all together; of the pressure [kPa], and of
# its change
_OFF, _LEVEL, _ALIKE = 0.1, 0.03, 0.6
_ABSOLUTE, _COMMON = 0.005, 0.005
_KILOPASCAL, _PRESSED = 0.12, 0.05
_FORCED, _PLACED = 0.15, 0.3  # the same of ln of the force and of the centre [mm]
_LABEL = 0.3  # [mm] of the centres that are given
_DIRECTION = 1e-2  # of the force's direction
_MIDDLE = -8e-3  # [m] along the finger, where an uneven modulus is the mean
_SEEN = SIGNALS + 7
_FORCE, _CENTRE, _WAY = SIGNALS, slice(SIGNALS + 1, SIGNALS + 4), slice(SIGNALS + 4, _SEEN)
_LIKELY, _UNLIKELY = 150, 15.0  # presses that a touch may be; ln of how much less likely than the best
_ROUNDS, _DAMPING = 2, 0.7  # of propagation, and what later rounds take of what they find
_LEAST = 1e-4  # weight of a press that counts


def _places():
    """name -> slice of the constants, and how many they are."""
    at, begin = {}, 0
    for name, (count, *_) in _CONSTANTS.items():
        at[name] = slice(begin, begin + count)
        begin += count
    return at, begin


constants_at, _COUNT = _places()


@dataclasses.dataclass(frozen=True)
class Touch:
    """A touch of the sensor.

    Attributes:
      change: (19,) of ln Z from rest. pressure: its change [kPa], NaN: not known.
      force: its size [N], NaN: not known. centre: (3,) of the contact on the resting skin, in the BioTac
        frame [m]; None: not known.
    """

    change: np.ndarray
    pressure: float = np.nan
    force: float = np.nan
    centre: np.ndarray | None = None

    @property
    def seen(self) -> np.ndarray:
        """(27,) changes, pressure, ln of the force, centre [mm] and direction; NaN is not known."""
        out = np.full(_SEEN, np.nan)
        out[:NELECTRODE], out[NELECTRODE], out[_FORCE] = self.change, self.pressure, np.log(self.force)
        if self.centre is not None:
            out[_CENTRE] = 1e3 * np.asarray(self.centre)
        return out

    @property
    def unlabelled(self) -> "Touch":
        """What the sensor alone told."""
        return Touch(self.change, self.pressure)


@dataclasses.dataclass(frozen=True, eq=False)
class Belief:
    """A normal distribution of a sensor's constants: mean (m,), covariance (m, m)."""

    mean: np.ndarray
    covariance: np.ndarray

    def of(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Mean and spread of the constants of one name, see `_CONSTANTS`."""
        at = constants_at[name]
        return self.mean[at], np.sqrt(np.diagonal(self.covariance)[at])


def believe() -> Belief:
    """Of any sensor."""
    count, *parts = zip(*_CONSTANTS.values())
    mean, spread = (np.repeat(part, count).astype(float) for part in parts)
    return Belief(mean, np.diag(spread**2))


class Posterior:
    """What presses would have been seen as, for a sensor of which nothing is known yet.

    Args:
      presses: all. geometry: of the skin.

    Attributes:
      expected: (n, 27) as `Touch.seen`. slopes: (n, 27, m) by the sensor's constants. rest: (n, 27, 27)
      covariance of what is left.
    """

    def __init__(self, presses: Presses, geometry: SkinGeometry):
        n, here = NELECTRODE, slice(0, SIGNALS)
        signal, outcome, by = presses.signal, presses.outcome.copy(), presses.outcome_by.copy()
        outcome[:, 1:4] *= 1e3
        by[:, :, 1:4] *= 1e3
        own, near, i = signal[:, :n], _nearness(geometry), np.arange(n)
        floor, along, across, thicker = np.moveaxis(presses.by_sensor, 1, 0)
        slopes = np.zeros((len(signal), _SEEN, _COUNT))

        def column(name, k=0):
            return slopes[:, :, constants_at[name].start + k]

        for name, first, value in (
            ("gain", 0, own), ("each", 0, along), ("each", n, across), ("floor_each", 0, floor),
            ("relief", 0, thicker),
        ):  # fmt: skip
            slopes[:, i, constants_at[name].start + first + i] = value[:, :n]
        column("near")[:, :n], column("share")[:, :n] = own @ (near - np.eye(n)), own.mean(1)[:, None]
        column("shift")[:, here], column("shift", 1)[:, here], column("floor")[:, here] = along, across, floor
        for k, name in ((2, "fill"), (3, "ratio")):
            column(name)[:] = np.concatenate([presses.by_press[:, k], by[:, k]], 1)
        column("pressure")[:, n] = column("modulus")[:, n] = signal[:, n]
        column("modulus")[:, _FORCE] = 1.0
        for k, place in enumerate((outcome[:, 1] - 1e3 * _MIDDLE, outcome[:, 3])):
            column("uneven", k)[:, _FORCE] = 0.1 * place
        level, alike = (own**2).mean(1)[:, None, None], _ALIKE * near + (1 - _ALIKE) * np.eye(n)
        rest = np.zeros((len(signal), _SEEN, _SEEN))
        left = _OFF**2 * own[:, :, None] * own[:, None] + _LEVEL**2 * level
        rest[:, :n, :n] = (left + presses.left[:, :, None] * presses.left[:, None]) * alike
        rest[:, :n, :n] += _ABSOLUTE**2 * np.eye(n) + _COMMON**2
        rest[:, n, n] = _KILOPASCAL**2 + (_PRESSED * signal[:, n]) ** 2
        diagonal = np.einsum("nii->ni", rest)
        diagonal[:, _FORCE], diagonal[:, _CENTRE], diagonal[:, _WAY] = _FORCED**2, _PLACED**2, _DIRECTION**2
        tilts = np.concatenate([presses.by_press[:, :2], by[:, :2]], 2)
        rest += _TILT**2 * np.swapaxes(tilts, 1, 2) @ tilts
        self.expected, self.slopes, self.rest = np.concatenate([signal, outcome], 1), slopes, rest
        self._weight = presses.weight
        self._any = self.given(believe())

    def given(self, belief: Belief, among: np.ndarray | slice = slice(None)) -> "Given":
        """For a sensor of which something is believed; among: (k,) presses."""
        slopes = self.slopes[among]
        covered = slopes @ belief.covariance
        covariance = covered @ np.swapaxes(slopes, 1, 2) + self.rest[among]
        return Given(self.expected[among] + slopes @ belief.mean, covariance, covered, self._weight[among])

    def likely(self, seen: np.ndarray, most: int) -> np.ndarray:
        """(k,) presses, at most so many, that a touch may be, of any sensor."""
        found = self._any.conditioned(seen).likely
        best = np.argsort(-found)[:most]
        return best[found[best] > found[best[0]] - _UNLIKELY]


@dataclasses.dataclass(frozen=True, eq=False)
class Given:
    """n presses, as normal distributions of what would be seen of each: expected (n, 27), covariance
    (n, 27, 27), with the sensor's constants covered (n, 27, m); ln of their weight (n,)."""

    expected: np.ndarray
    covariance: np.ndarray
    covered: np.ndarray
    weight: np.ndarray

    def conditioned(self, seen: np.ndarray) -> "Conditioned":
        """On what was seen (27,), of which NaN was not."""
        at = np.flatnonzero(np.isfinite(seen))
        label = _LABEL**2 * np.isin(at, np.arange(_SEEN)[_CENTRE])
        covariance = self.covariance[:, at[:, None], at] + np.diag(label)
        missed = seen[at] - self.expected[:, at]
        lower = np.linalg.cholesky(covariance)
        white = np.linalg.solve(lower, missed[..., None])[..., 0]
        likely = self.weight - 0.5 * (white**2).sum(1)
        return Conditioned(self, at, covariance, missed, likely - np.log(np.einsum("nii->ni", lower)).sum(1))


@dataclasses.dataclass(frozen=True, eq=False)
class Conditioned:
    """`Given` and what was seen: at (k,) which of the 27, with its covariance (n, k, k), missed by (n, k); ln
    of the likelihood of each press (n,)."""

    given: Given
    at: np.ndarray
    covariance: np.ndarray
    missed: np.ndarray
    likely: np.ndarray

    def weights(self) -> np.ndarray:
        """(n,) probabilities; what hardly counts is none."""
        p = np.exp(self.likely - self.likely.max())
        p = np.where(p > _LEAST * p.sum(), p, 0)
        return p / p.sum()

    def outcome(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (7,) of ln of the force, centre [mm] and direction over the presses, and variances (4,) of the
        first four."""
        p = self.weights()
        among = np.flatnonzero(p)
        given, p, out = self.given, p[among], slice(SIGNALS, _SEEN)
        both = given.covariance[among, out][:, :, self.at]
        gain = np.linalg.solve(self.covariance[among], np.swapaxes(both, 1, 2))
        each = given.expected[among, out] + np.einsum("nko,nk->no", gain, self.missed[among])
        left = np.einsum("noo->no", given.covariance[among, out, out]) - np.einsum("nok,nko->no", both, gain)
        mean = p @ each
        return mean, (p @ (left + (each - mean) ** 2))[:4]

    def learned(self, belief: Belief) -> Belief:
        """Mean and covariance of the constants after this touch; belief: that of `given`."""
        p = self.weights()
        among = np.flatnonzero(p)
        p, covered = p[among], self.given.covered[among][:, self.at]
        gain = np.linalg.solve(self.covariance[among], covered)
        moved = np.einsum("nkm,nk->nm", gain, self.missed[among])
        mean = p @ moved
        known = np.tensordot(p[:, None, None] * gain, covered, ([0, 1], [0, 1]))
        apart = moved - mean
        covariance = belief.covariance - known + (p[:, None] * apart).T @ apart
        return Belief(belief.mean + mean, 0.5 * (covariance + covariance.T))


class Session:
    """What touches of one sensor tell of it together.

    Args:
      posterior: of the presses. touches: of the sensor, labelled or not.
    """

    def __init__(self, posterior: Posterior, touches: Sequence[Touch]):
        self._posterior, self._seen = posterior, [touch.seen for touch in touches]
        self._among = [posterior.likely(seen, _LIKELY) for seen in self._seen]
        self._all = _Natural.of(believe())
        self._own = [_Natural.none() for _ in touches]
        for part in (1.0, *(_ROUNDS - 1) * [_DAMPING]):
            for i in range(len(touches)):
                self._take(i, part)

    @property
    def belief(self) -> Belief:
        """Of the sensor, after all touches."""
        return self._all.belief()

    def without(self, i: int) -> Belief:
        """Of the sensor, after all touches but one."""
        try:
            return (self._all - self._own[i]).belief()
        except np.linalg.LinAlgError:  # what it taught is not to be told from the others
            return believe()

    def _take(self, i, part):
        try:
            others = self._all - self._own[i]
            belief = others.belief()
            given = self._posterior.given(belief, self._among[i])
            after = _Natural.of(given.conditioned(self._seen[i]).learned(belief))
        except np.linalg.LinAlgError:  # then it teaches nothing more
            return
        own = self._own[i] * (1 - part) + (after - others) * part
        self._all, self._own[i] = others + own, own


@dataclasses.dataclass(frozen=True, eq=False)
class _Natural:
    """A normal distribution by its precision (m, m) and that times its mean (m,): touches add up."""

    precision: np.ndarray
    weighted: np.ndarray

    @classmethod
    def of(cls, belief):
        np.linalg.cholesky(belief.covariance)  # raises LinAlgError where it is none
        precision = np.linalg.inv(belief.covariance)
        return cls(precision, precision @ belief.mean)

    @classmethod
    def none(cls):
        return cls(np.zeros((_COUNT, _COUNT)), np.zeros(_COUNT))

    def belief(self):
        np.linalg.cholesky(self.precision)
        covariance = np.linalg.inv(self.precision)
        return Belief(covariance @ self.weighted, 0.5 * (covariance + covariance.T))

    def __add__(self, other):
        return _Natural(self.precision + other.precision, self.weighted + other.weighted)

    def __sub__(self, other):
        return _Natural(self.precision - other.precision, self.weighted - other.weighted)

    def __mul__(self, share):
        return _Natural(share * self.precision, share * self.weighted)


def _nearness(geometry):
    """(19, 19) 1 at home, less with the distance."""
    place = geometry.electrode_pos
    return np.exp(-np.linalg.norm(place[:, None] - place, axis=2) / _REACH)
