"""Electrodes that are noisier than the others: no prediction tells it, and their readings are worth less."""

import numpy as np

from ....effects.electrodes import Noise
from ....sensor.channels import electrode_noise
from ..trajectory import Trajectory, settled, still_differences

__all__ = ["noisy_electrodes"]

_FEWEST = 40  # rows at rest
_FREE = 2.0  # as the ratio, without touch
_RATIO = 2.5  # over the law of noise, to the median electrode
_TOUCH = 1e-3  # [N]
_LEAST = 6.0  # [counts]
_MOST = 6  # electrodes: where more are, it is the sensor's noise
_LAGS = 4  # rows over which coloured noise has grown to what it is


def noisy_electrodes(
    trajectories: list[Trajectory], forces: list[np.ndarray], values: list[np.ndarray] | None = None
) -> tuple[Noise, dict, dict] | None:
    """The effect, its theta [counts RMS] and {electrode: (low, high)} of 95 %, or None.

    By rows in which the object stands still, and by those without touch alone: what only touch stirs is
    another matter. By the later half of such rows, too: what is late comes to rest after the object, and a
    latency is no noise. An electrode's share of the noise that all have is taken off by the law of its
    counts.

    Args:
      forces: (n, 3) of the base model, which tell the touch. values: (n, 19) what scatters, in place of the
        counts: what a fit leaves of them.
    """
    values = [t.electrodes for t in trajectories] if values is None else values
    steps, late = (
        [
            np.concatenate(
                [still_differences(x, t, lag, only) for x, t, only in zip(values, trajectories, o)]
            )
            for lag in range(1, _LAGS + 1)
        ]
        for o in ([None] * len(values), [settled(t) for t in trajectories])
    )
    apart = [_apart(x, f) for x, f in zip(values, forces)]
    rows, free = len(steps[0]), sum(map(len, apart))
    if rows < _FEWEST or free < _FEWEST // 4 or not any(map(len, late)):  # never long enough at rest
        return None
    rms = np.minimum(*(np.max([_rms(one) for one in ones if len(one)], axis=0) for ones in (steps, late)))
    law = electrode_noise(np.mean([t.electrodes[0] for t in trajectories], axis=0))
    own = np.median(rms / law)
    noisy = (rms > _RATIO * own * law) & (rms > _LEAST)
    alone = _rms(np.concatenate(apart))
    noisy &= alone > _FREE * np.median(alone / law) * law
    away = np.flatnonzero(noisy)
    if not 0 < len(away) <= _MOST:
        return None
    more = np.sqrt(np.maximum(rms**2 - (own * law) ** 2, 0.0))
    half = 1.96 / np.sqrt(2 * rows / _LAGS)  # of a standard deviation, of rows that know of each other
    theta = dict(Noise().default()) | {f"e{k + 1}": float(more[k]) for k in away}
    sure = {f"e{k + 1}": (float(more[k] * (1 - half)), float(more[k] * (1 + half))) for k in away}
    return Noise(), theta, sure


def _apart(electrodes, force):
    """(k, 19) steps between rows without touch, before it and after."""
    free = np.linalg.norm(force, axis=1) < _TOUCH
    return np.diff(electrodes, axis=0)[free[1:] & free[:-1]]


def _rms(steps):
    """(19,) RMS of what differs by these steps [(n, 19)]; spikes and colour are in it."""
    return np.sqrt((steps**2).mean(0) / 2)
