"""The colour of the noise: a filter takes some of it away."""

import numpy as np
from scipy.optimize import brentq

from .....quality.noise import sound_noise
from ....evidence import sign_flip
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS

__all__ = ["coloured", "muted"]

_NAN = float("nan")
_FEWEST = 6  # blocks behind the time from which on noise is correlated
# of a filter: logarithm of the law's noise over what is left at the highest frequencies; 0.3 at most without
_QUIET = 0.4
_EVERYWHERE = 0.25  # of a fall of the spectrum, in the block with the least


def coloured(session: Session) -> Finding | None:
    """White noise that has been filtered: in block after block less is left at the highest frequencies than
    the law of sound sensors says. Its spectrum falls to there from the band above the load's, but of a sharp
    filter, after which nothing is left in either."""
    x = _fresh(session)
    size = 64
    if not session.recording.absolute:  # how loud a sensor is follows from its counts
        return None
    if len(x) < 2 * size * BLOCKS // 3 or x.std(0).max() < 0.25:
        return None
    starts = np.arange(0, len(x) - size + 1, size // 2)
    window = np.hanning(size)[:, None]
    line = np.vander(np.linspace(-1, 1, size), 3)
    project = line @ np.linalg.pinv(line)
    parts = np.stack([x[a : a + size] - project @ x[a : a + size] for a in starts]) * window
    power = np.abs(np.fft.rfft(parts, axis=1)) ** 2
    f = np.fft.rfftfreq(size)
    bands = ((0.16, 0.27) if session.loaded else (0.05, 0.2), (0.38, 0.5))
    middle, high = (power[:, (f >= a) & (f <= b)].mean(1) for a, b in bands)
    # rounding alone has a floor of its own
    floor = (window**2).sum() / 12
    alive = np.median(middle, axis=0) > 0.5 * floor
    if alive.sum() < 6:
        return None
    block = np.arange(len(parts)) * BLOCKS // len(parts)
    ratio = np.array(
        [
            np.median(np.log(low / above))
            for low, above in (
                [
                    np.maximum(np.quantile(part[block == b][:, alive], 0.3, axis=0), 0.01 * floor)
                    for part in (middle, high)
                ]
                for b in range(BLOCKS)
            )
        ]
    )
    value = float(np.median(ratio))
    # a filter takes noise away, where a wave adds some and values that are held keep theirs, in steps
    law = sound_noise(np.median(x, axis=0))
    white = law * np.sqrt((window**2).sum())
    # a fast touch has such a spectrum where it is; a filter is there in every block
    each = np.array([np.median(high[block == b], axis=0) for b in range(BLOCKS)])
    missing = np.log(white / np.sqrt(np.maximum(each, 0.01 * floor)))
    p = sign_flip(np.median(missing[:, alive], axis=1) - _QUIET)
    if p > 0.01 or value > 1 and ratio.min() < _EVERYWHERE * value:
        return None
    quiet = np.log(white / np.sqrt(np.maximum(high.mean(0), 0.01 * floor)))
    step = np.abs(np.diff(x, axis=0))
    step = step[: len(step) // 24 * 24].reshape(-1, 24, 19)
    even = np.median(np.median(step, axis=1) + 0.25, axis=0) / np.median(
        np.sqrt((step**2).mean(1)) + 0.25, axis=0
    )
    quiet, even = float(np.median(quiet[alive])), float(np.log(np.median(even[alive])))
    rate = session.recording.rate * session.fresh
    tau, low, high = (
        -1 / (rate * np.log(np.clip(_pole(v, bands), 1e-3, 0.995)))
        for v in (value, *np.quantile(ratio, [0.1, 0.9]))
    )
    return Finding(
        "lowpass",
        tuple(range(19)),
        {"tau": (tau, low, high)},
        float(np.sum(ratio**2) * len(starts) / BLOCKS),
        p,
        0.0,
        session.recording.time[-1],
        note=f"at the highest frequencies is {np.exp(quiet):.1f} times less noise than the law of sound "
        f"sensors says, and {np.exp(value):.1f} times less power than at a quarter of the rate",
        clues={"ratio": value, "quiet": quiet, "even": even},
    )


def muted(session: Session) -> Finding | None:
    """Noise that a filter takes away from some time on, down to rounding: then neighbouring rows are mostly
    equal and none jumps, as rows that are held do."""
    x = session.counts[session.fit & ~session.masked.all(1)]
    d, blocks = np.abs(np.diff(x, n=3, axis=0)), 2 * BLOCKS
    if len(d) < 32 * blocks:
        return None
    # of third differences: what all but the largest are below, beside what the law's noise would make
    usual = sound_noise(np.median(x, axis=0)) * np.sqrt(20)
    size = np.stack([np.quantile(part, 0.97, axis=0) for part in np.array_split(d, blocks)]) / 2.17
    calm = np.median(np.log(usual / (size + 0.5)), axis=1)

    def gain(b):
        return (calm[b:].mean() - calm[:b].mean()) * np.sqrt(b * (blocks - b))

    first = max(range(4, blocks - _FEWEST + 1), key=gain)
    before, after = float(np.median(calm[:first])), calm[first:]
    p, quiet = sign_flip(after - before - _QUIET), float(np.median(after))
    if p > 0.02 or quiet - before < 2 * _QUIET or after.min() < calm[:first].max():
        return None
    rate, last = session.recording.rate, session.recording.time[session.fit][-1]
    # of white noise a first-order filter leaves a / (2 tau rate): at least so much that it rounds away
    tau = 0.5 * np.exp(2 * (quiet - before)) / rate
    return Finding(
        "lowpass",
        tuple(range(19)),
        {"tau": (tau, tau, _NAN)},
        float(blocks * (quiet - before)),
        p,
        last * first / blocks,
        session.recording.time[-1],
        note=f"from {last * first / blocks:.1f} s on noise is {np.exp(quiet - before):.0f} times smaller, "
        "and no row jumps",
        clues={"ratio": quiet - before, "quiet": quiet - before, "even": 0.0},
    )


def _fresh(session):
    """(n, 19) counts of rows that are no repetition."""
    return session.counts[session.fit & ~session.recording.repeated & ~session.masked.all(1)]


def _pole(ratio, bands):
    """Of noise a[i] = pole a[i - 1] + white, whose power falls by e^ratio between the two bands."""

    def fall(pole):
        power = [
            np.mean(1 / (1 + pole**2 - 2 * pole * np.cos(2 * np.pi * np.linspace(*band, 50))))
            for band in bands
        ]
        return np.log(power[0] / power[1])

    if ratio <= 0:
        return 0.0
    return 0.99 if ratio >= fall(0.99) else brentq(lambda a: fall(a) - ratio, 0.0, 0.99)
