"""White noise of a record, from its quietest segments, the expected noise of a healthy electrode, and
channels that have more."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from ..sensor.channels import electrode_noise
from .adjacent import last_measured
from .evidence import BLOCKS, evidence, runs, signed_root_t
from .fault import Fault
from .log import Log

ROUNDING = 0.29  # [counts] of a number rounded to whole ones: 1 / sqrt(12)
_FEWEST = 20  # rows of a block that show its noise
# logarithm of a channel's noise over the median one's, by itself and over the law, which it exceeds in this
# fraction of the blocks: 0.51 at most in 51 recordings of eight sensors
_TWICE, _MOSTLY = 0.69, 0.8
_LASTS = 6  # blocks one after another: all signs of fewer are alike by chance more often than one in fifty


def sound_noise(counts: np.ndarray) -> np.ndarray:
    """Standard deviation of a healthy electrode's noise [counts]. It is at least that of rounding, which
    alone remains at the ends of the range."""
    return np.maximum(electrode_noise(counts), ROUNDING)


def noise_level(counts: np.ndarray, repeated: np.ndarray | None = None, least: float = 0.05) -> np.ndarray:
    """(c,) standard deviation of the white noise of samples (n, c) [counts], from second differences in the
    quietest quarter of the record."""
    x = counts if repeated is None else counts[~repeated]
    d = np.diff(x, n=2, axis=0) / np.sqrt(6)
    size = max(20, len(d) // 60)
    k = max(1, len(d) // size)
    blocks = (d[: k * size].reshape(k, -1, d.shape[1]) ** 2).mean(1)
    return np.maximum(np.sqrt(np.quantile(blocks, 0.25, axis=0)), least)


def running_median(x: np.ndarray, size: int, mode: str) -> np.ndarray:
    """Running median over `size` rows of x (n, c), per column. mode: boundary treatment as in
    scipy.ndimage.median_filter, which is up to twenty times faster on single columns."""
    return np.stack([median_filter(column, size, mode=mode) for column in x.T], axis=1)


def noisy(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds channels that have more than twice the noise of the others, throughout or for a part of the log.
    Their common noise is free: it differs between laboratories by a factor of ten."""
    rows = np.flatnonzero(~log.repeated & ~log.masked.all(1))
    x = last_measured(log.counts, log.masked)[rows]
    sound = np.ones(log.channels, bool)
    sound[[k for f in faults if f.step or f.silent for k in f.channels]] = False
    if len(x) < _FEWEST * BLOCKS or sound.sum() < 4:
        return []
    law = sound_noise(np.median(x, axis=0))
    level = np.log([noise_level(part) for part in np.array_split(x, BLOCKS)])
    residuals = (r - np.median(r[:, sound], axis=1, keepdims=True) for r in (level, level - np.log(law)))
    more = np.minimum(*residuals)
    edges = np.linspace(0, len(x) - 1, BLOCKS + 1).astype(int)
    found = []
    for k in np.flatnonzero(sound):
        first, last = _noisy_blocks(more[:, k])
        if first == last:
            continue
        some = slice(first, last)
        own, usual = np.exp(level[some, k]), np.exp(level[some, k] - more[some, k])
        size = np.sqrt(np.maximum(own**2 - usual**2, 0.0))
        number, over = len(x) / BLOCKS, 2 * (more[:, k] - _TWICE)
        strength = np.sign(over) * number / 2 * (np.expm1(over) - over)
        found.append(
            Fault(
                "noise",
                (int(k),),
                rows[edges[first]] / log.rate,
                rows[edges[last]] / log.rate,
                f"{log.name([k])} has noise of {np.median(own):.1f} counts, usual are {np.median(usual):.1f}",
                {"size": (float(np.median(size)), float(size.min()), float(size.max()))},
                detector="loud",
                ties=("gain",),
                **evidence(strength[some]) | {"p": signed_root_t(strength[some])},  # also of few blocks
            )
        )
    return found


def _noisy_blocks(more):
    """First and one beyond the last block of a channel's noise, equal where it has none: nearly all blocks of
    more (blocks,), or the longest run of them."""
    if np.quantile(more, 1 - _MOSTLY) > _TWICE:
        return 0, len(more)
    start, length = runs(more > _TWICE)
    k = int(np.argmax(length)) if len(length) else 0
    return (start[k], start[k] + length[k]) if len(length) and length[k] >= _LASTS else (0, 0)
