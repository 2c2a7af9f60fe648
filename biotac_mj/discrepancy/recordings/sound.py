"""What sound sensors have in common whatever presses them: levels at rest, how electrodes answer a load
together, how loud they are; and by how much sensors and presses differ in it.

Levels are the patterns of `sensor/presets.py`. The rest (`sound.json`, written by
`benchmarks/sound_sensors.py`) are statistics of pressed sensors: mean over sensors, the directions in which
presses and sensors differ, and what each number differs by besides."""

import functools
import json
import pathlib

import numpy as np

from ...sensor.channels import NELECTRODE, log_impedance
from ...sensor.presets import SENSORS

__all__ = ["PAD", "PATTERNS", "Answers", "Levels", "Loudness", "answers_of", "measured"]

PATTERNS = ("2", "3", "epfl_f1", "epfl_f2", "phac_f0", "phac_f1")  # "1" is epfl_f1 once more, the SP differs
# E17 to E19 lie where a pad is pressed: below a contact impedance rises, beside it the film bulges and it
# falls, so which sign their answers have depends on where it is
PAD = (16, 17, 18)
_ALIKE = 0.985  # correlations are counted up to this: beyond it noise decides
_COMMON = 1.0  # logarithm by which all levels, amplitudes or noises may differ together
_OWN = 0.08  # [ln Z] of an electrode's level beside what six sensors show
_LEVELS, _ANSWERS, _LOUDNESS = 6.0, 20.0, 6.0  # degrees of freedom: how far tails reach


@functools.cache
def measured() -> dict:
    """Statistics of sound sensors (`sound.json`)."""
    return json.loads(pathlib.Path(__file__).with_name("sound.json").read_text())


def answers_of(square: np.ndarray) -> np.ndarray:
    """(..., c (c - 1) / 2 + c) numbers of mean squares and products of changes (..., c, c): arctanh of the
    correlations, and half the logarithms of the squares about their mean."""
    power = np.einsum("...ii->...i", square)
    i, j = np.triu_indices(square.shape[-1], 1)
    r = square[..., i, j] / np.sqrt(power[..., i] * power[..., j])
    size = 0.5 * np.log(power)
    size = size - size.mean(-1, keepdims=True)
    return np.concatenate([np.arctanh(np.clip(r, -_ALIKE, _ALIKE)), size], axis=-1)


class _Student:
    """Log likelihood of numbers (..., f): Student's t about a mean (f,)."""

    def __init__(self, mean, covariance, freedom):
        self.mean, self.precision, self.freedom = mean, np.linalg.inv(covariance), freedom

    def __call__(self, value: np.ndarray) -> np.ndarray:
        d = value - self.mean
        distance = np.einsum("...i,...i->...", d @ self.precision, d)
        return -0.5 * (self.freedom + d.shape[-1]) * np.log1p(distance / self.freedom)


class Levels(_Student):
    """ln Z at rest (c,). used: (c,) electrodes; spread: (c,) by what a load may have moved each [ln Z]."""

    def __init__(self, used: np.ndarray, spread: np.ndarray):
        z = np.array([log_impedance(SENSORS[name].rest) for name in PATTERNS])
        z = (z - z.mean(1, keepdims=True))[:, used]
        own = (z.var(0, ddof=1) + _OWN**2) * (1 + 1 / len(z)) + spread**2
        super().__init__(z.mean(0), np.diag(own) + _COMMON**2, _LEVELS)


class Answers(_Student):
    """How electrodes (c,) answer together, as `answers_of` says it."""

    def __init__(self, used: np.ndarray):
        known, c = measured(), len(used)
        one = np.isin(np.arange(NELECTRODE), used)
        i, j = np.triu_indices(NELECTRODE, 1)
        keep = np.concatenate([one[i] & one[j], one])
        mean = np.array(known["mean"])[keep]
        mean[-c:] -= mean[-c:].mean()
        directions = np.array(known["directions"])[:, keep]
        covariance = directions.T @ directions + np.diag(np.array(known["own"])[keep] ** 2)
        covariance[-c:, -c:] += _COMMON**2
        super().__init__(mean, covariance, _ANSWERS)
        self.number = c

    def alike(self, value: np.ndarray) -> float:
        """Correlation of the correlations in (f,) numbers with those of sound sensors."""
        return float(np.corrcoef(value[: -self.number], self.mean[: -self.number])[0, 1])

    def square(self) -> np.ndarray:
        """(c, c) mean squares and products of changes of a sound sensor, up to a factor."""
        c, size = self.number, np.exp(self.mean[-self.number :])
        r = np.eye(c)
        r[np.triu_indices(c, 1)] = np.tanh(self.mean[:-c])
        value, axes = np.linalg.eigh((r + np.triu(r, 1).T) * np.outer(size, size))
        return (axes * np.maximum(value, 0)) @ axes.T


class Loudness(_Student):
    """Logarithms of noise over the law of a sound electrode's (c,)."""

    def __init__(self, used: np.ndarray):
        known = measured()
        spread = np.array(known["noise_spread"])[used]
        super().__init__(np.array(known["noise"])[used], np.diag(spread**2) + _COMMON**2, _LOUDNESS)
