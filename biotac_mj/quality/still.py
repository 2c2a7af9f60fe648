"""What stands out of the noise while nothing touches a sensor: rows that all channels leave at once, samples
of one channel, and noise that is not white. No load makes any, so they are compared with noise alone."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.stats import norm, poisson

from .adjacent import last_measured
from .evidence import BLOCKS, NAN, evidence
from .fault import Fault
from .log import Log
from .noise import ROUNDING, noise_level, sound_noise

_ROW, _SAMPLE = 8.0, 5.5  # times the noise: of a row over all channels, of a sample
_FEW, _NEAR = 4, 3  # of either; rows around one of all channels that belong to it
_SLOW = (4, 8)  # rows of means, whose noise is compared with that of rows
_COLOURED = 0.25  # logarithm by which it is more than the other channels': 0.15 at most in sound ones


def at_rest(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds spikes and coloured noise of a log in which nothing touched the sensor."""
    rows = np.flatnonzero(~log.repeated & ~log.masked.all(1))
    sound = np.ones(log.channels, bool)
    sound[[k for f in faults if f.silent or f.correct is not None for k in f.channels]] = False
    if len(rows) < 20 * BLOCKS or sound.sum() < 4 or any(f.step for f in faults):
        return []
    x = last_measured(log.counts, log.masked)[rows]
    noise = noise_level(x, least=ROUNDING)
    off = (x[1:-1] - 0.5 * (x[2:] + x[:-2])) / noise / np.sqrt(1.5)
    comes_back = np.abs(x[2:] - x[:-2]) / noise < np.maximum(np.abs(off), _SAMPLE) / 2
    off[:, ~sound] = 0.0
    common = off.sum(1) / np.sqrt(sound.sum())
    usual = max(float(np.median(np.abs(common))) / norm.ppf(0.75), 1.0)
    whole = _peaks(np.abs(common) / usual > _ROW, np.abs(common))
    found = []
    if whole.sum() >= _FEW:
        mask = np.repeat(whole[:, None], log.channels, axis=1)
        text = "rows leave their neighbours on all electrodes at once, by more than noise"
        found.append(_spikes(log, rows, mask, whole, np.arange(log.channels), text))
        comes_back &= ~maximum_filter1d(whole, 2 * _NEAR + 1)[:, None]
    single = (np.abs(off) > _SAMPLE) & comes_back
    for k in np.flatnonzero(single.sum(0) >= _FEW):
        own = _peaks(single[:, k], np.abs(off[:, k]))
        if own.sum() >= _FEW:
            mask = np.zeros_like(single)
            mask[:, k] = own
            text = f"samples of {log.name([k])} leave their neighbours by more than noise"
            found.append(_spikes(log, rows, mask, own, [k], text))
            sound[k] = False
    return found + _coloured(log, x, sound)


def _peaks(some, size):
    """The largest of neighbouring samples (n,) bool: one that is off moves the difference of those beside
    it."""
    padded = np.pad(np.where(some, size, 0.0), 1)
    return some & (size >= padded[:-2]) & (size >= padded[2:])


def _spikes(log, rows, mask, at, channels, text):
    """Fault of samples mask (n - 2, c) of rows (n,), at (n - 2,) bool."""
    whole = np.zeros(log.counts.shape, bool)
    whole[rows[1:-1]] = mask
    number = int(at.sum())
    strength = np.bincount(np.flatnonzero(at) * BLOCKS // len(at), minlength=BLOCKS) * _SAMPLE**2 / 2
    when = rows[1:-1][at] / log.rate
    found = Fault(
        "spikes",
        tuple(int(k) for k in channels),
        float(when[0]),
        float(when[-1]),
        f"{number} {text}, while nothing touches",
        {"rate": (number * log.rate / len(log) * 60, NAN, NAN)},
        whole,
        detector="gone",
        **evidence(strength),
    )
    found.p = float(poisson.sf(number - 1, 2 * norm.sf(_SAMPLE) * len(at) * log.channels))
    return found


def _coloured(log, x, sound):
    """Noise of channels that is more than the others' in means of some rows, and than their own from row to
    row."""
    law = sound_noise(np.median(x, axis=0))
    more = []
    for rows in (1, *_SLOW):
        mean = x[: len(x) // rows * rows].reshape(-1, rows, x.shape[1]).mean(1)
        bend = mean[1:-1] - 0.5 * (mean[2:] + mean[:-2])
        square = [(part**2).mean(0) for part in np.array_split(bend, BLOCKS)]
        level = 0.5 * np.log(np.maximum(square, 1e-12)) - np.log(law)
        more.append(level - np.median(level[:, sound], axis=1, keepdims=True))
    beyond = np.minimum(*more[1:]) - np.maximum(more[0], 0.0) - _COLOURED
    found = []
    for k in np.flatnonzero(sound & (np.median(beyond, axis=0) > 0)):
        size = float(np.exp(np.median(more[1][:, k])) * law[k])
        found.append(
            Fault(
                "noise",
                (int(k),),
                0.0,
                (len(log) - 1) / log.rate,
                f"{log.name([k])} has noise over several rows that the others have not",
                {"size": (size, NAN, NAN)},
                detector="loud",
                ties=("gain",),
                **evidence(beyond[:, k] * len(x) / BLOCKS / _SLOW[-1]),
            )
        )
    return found
