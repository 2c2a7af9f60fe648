"""What stands out of the noise while nothing touches a sensor: rows that all channels leave at once, and
noise that is not white. No load makes any, so they are compared with noise alone."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import norm, poisson

from .adjacent import last_measured
from .evidence import BLOCKS, NAN, evidence
from .fault import Fault
from .log import Log
from .noise import ROUNDING, noise_level, sound_noise

_ROW, _FEW = 8.0, 4  # times the noise, of a row over all channels; so many of them
_SLOW = (4, 8)  # rows of means, whose noise is compared with that of rows
_CALM = 4.0  # times the noise, of a sample that counts as noise
# correlation of the noise of channels: of the mean pair, 0.001 at most in a real sensor, of any pair 0.10
_COMMON, _COUPLED = 0.1, 0.1
_RARE = 1e-3  # chance of a pair that exceeds this
_OWN = 9  # channels of 19: faults of fewer are of these
_CHANGED = 0.2  # logarithm of the noise of a channel in a later rest over that in the first
_COLOURED = 0.25  # logarithm by which it is more than the other channels': 0.15 at most in sound ones


def at_rest(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds spikes and coloured noise of a log in which nothing touched the sensor."""
    rows = np.flatnonzero(~log.repeated & ~log.masked.all(1))
    sound = np.ones(log.channels, bool)
    sound[[k for f in faults if f.silent or f.correct is not None for k in f.channels]] = False
    if len(rows) < 20 * BLOCKS or sound.sum() < 4 or any(f.step for f in faults):
        return []
    x = last_measured(log.counts, log.masked)[rows]
    off = (x[1:-1] - 0.5 * (x[2:] + x[:-2])) / noise_level(x, least=ROUNDING) / np.sqrt(1.5)
    off /= np.concatenate([np.broadcast_to(_usual(part), part.shape) for part in np.array_split(off, BLOCKS)])
    off[:, ~sound] = 0.0
    common = off.sum(1) / np.sqrt(sound.sum())
    whole = _peaks(np.abs(common) / _usual(common) > _ROW, np.abs(common))
    return ([_spikes(log, rows, whole)] if whole.sum() >= _FEW else []) + _coloured(log, x, sound)


def between_rests(log: Log, rests: Sequence[slice], faults: Sequence[Fault] = ()) -> list[Fault]:
    """What the noise says of several rests, in which nothing touches the sensor, together: noise of channels
    is independent, and as much in the last rest as in the first."""
    sound = np.ones(log.channels, bool)
    faulty = (
        f for f in faults if len(f.channels) <= log.some(_OWN) or f.step or f.correct or f.mask is not None
    )
    sound[[k for f in faulty for k in f.channels]] = False
    fresh = ~log.repeated & ~log.masked[:, sound].any(1)
    off = []
    for rows in rests:
        x = log.counts[rows][fresh[rows]]
        if len(x) < 20 * BLOCKS:
            continue
        off.append((x[1:-1] - 0.5 * (x[2:] + x[:-2])) / sound_noise(np.median(x, axis=0)) / np.sqrt(1.5))
    if not off or sound.sum() < 7:
        return []
    spread = np.median(np.abs(np.concatenate(off)), axis=0) / norm.ppf(0.75) + ROUNDING
    off = [np.clip(one, -_CALM * spread, _CALM * spread) for one in off]
    return _in_common(log, np.concatenate(off), sound) + _noise_changes(log, off, sound)


def _in_common(log, off, sound):
    """What the noise off (n, c) of sound channels has in common: of all a disturbance, of some cross-talk."""
    channels = np.flatnonzero(sound)
    blocks = np.array([np.corrcoef(part.T) for part in np.array_split(off[:, channels], BLOCKS)])
    i, j = np.triu_indices(len(channels), 1)
    pairs, rows = blocks[:, i, j], len(off) / BLOCKS
    common = np.median(pairs, axis=1)
    found = []
    if common.mean() > _COMMON:
        text = f"{common.mean():.0%} of the noise is common to all electrodes while nothing touches"
        every, values = range(log.channels), {"correlation": float(common.mean())}
        found.append(_of_noise(log, "common_noise", every, text, values, rows * (common - _COMMON)))
    own = pairs - common[:, None]
    # error of a correlation of differences that overlap, and the largest of so many by chance
    chance = norm.isf(_RARE / len(i)) / np.sqrt(0.6 * len(off))
    over = np.flatnonzero(np.abs(own.mean(0)) > _COUPLED + chance)
    if len(over):
        worst = over[np.argmax(np.abs(own[:, over].mean(0)))]
        fraction = float(own[:, worst].mean())
        a, b = (log.name([channels[k[worst]]]) for k in (i, j))
        text = f"the noise of {a} and {b} correlates by {fraction:+.2f} while nothing touches"
        which = sorted({int(channels[k]) for n in over for k in (i[n], j[n])})
        strength = rows * (np.sign(fraction) * own[:, worst] - _COUPLED)
        found.append(_of_noise(log, "crosstalk", which, text, {"kappa": fraction}, strength))
    return found


def _noise_changes(log, off, sound):
    """Channels whose noise is another one in a later rest than in the first, as their gain is."""
    first, *others = (
        np.log([np.sqrt((part**2).mean(0)) + ROUNDING for part in np.array_split(one, BLOCKS)]) for one in off
    )
    found = {}
    first -= np.median(first[:, sound], axis=1, keepdims=True)
    for later in others:
        later -= np.median(later[:, sound], axis=1, keepdims=True)
        change = later - first.mean(0)
        for k in np.flatnonzero(sound & (np.abs(change.mean(0)) > _CHANGED)):
            size = float(change[:, k].mean())
            text = f"the noise of {log.name([k])} is {np.exp(size):.2f} times that of the first rest"
            strength = 20 * (np.sign(size) * change[:, k] - _CHANGED)
            ends = first[:, k].mean(), later[:, k].mean()
            if sum(ends) < 0:  # less than the others have, noise and all
                found[k] = _of_noise(log, "gain", [k], text, {f"e{k + 1}": float(np.expm1(size))}, strength)
                found[k].ties = ("lowpass",)
            else:
                counts = float(np.exp(max(ends)) * noise_level(log.counts)[k])
                found[k] = _of_noise(log, "noise", [k], text, {"size": counts}, strength)
                found[k].ties = ("gain",)
    return list(found.values()) if len(found) <= log.some(_FEW) else []


def _of_noise(log, id_, channels, text, values, strength):
    parameters = {name: (value, NAN, NAN) for name, value in values.items()}
    end, which = (len(log) - 1) / log.rate, tuple(int(k) for k in channels)
    return Fault(id_, which, 0.0, end, text, parameters, detector="loud", **evidence(strength))


def _usual(off):
    """Standard deviation of most of off (n, ...), at least 1: noise that is another one at times makes no
    spikes."""
    return np.maximum(np.median(np.abs(off), axis=0) / norm.ppf(0.75), 1.0)


def _peaks(some, size):
    """The largest of neighbouring samples (n,) bool: one that is off moves the difference of those beside
    it."""
    padded = np.pad(np.where(some, size, 0.0), 1)
    return some & (size >= padded[:-2]) & (size >= padded[2:])


def _spikes(log, rows, at):
    """Fault of all channels in rows (n,), at (n - 2,) bool."""
    mask = np.zeros(log.counts.shape, bool)
    mask[rows[1:-1][at]] = True
    strength = np.bincount(np.flatnonzero(at) * BLOCKS // len(at), minlength=BLOCKS) * _ROW**2 / 2
    when, number = rows[1:-1][at] / log.rate, int(at.sum())
    text = "rows leave their neighbours on all electrodes at once, by more than noise, while nothing touches"
    found = Fault(
        "spikes",
        tuple(range(log.channels)),
        float(when[0]),
        float(when[-1]),
        f"{number} {text}",
        {"rate": (number * log.rate / len(log) * 60, NAN, NAN)},
        mask,
        detector="gone",
        **evidence(strength),
    )
    found.p = float(poisson.sf(number - 1, 2 * norm.sf(_ROW) * len(at)))
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
