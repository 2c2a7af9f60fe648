"""Where a finger stands still, and where it does so untouched: there levels owe nothing to the load."""

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from ...sensor.channels import log_impedance
from ..noise import noise_level

__all__ = ["moved", "resting", "still"]

STILL = 10  # rows over which nothing moves
_QUIET = 5.0  # of the noise, how far electrodes then wander at most
_ROWS = 15  # of a stand, at least
_ALIKE = 0.1  # of how far an electrode moves: stands as near to each other are of one load
_STANDS = 6  # that tell how rest develops, at least, and over what share of the recording
_SPAN = 0.6


def moved(x: np.ndarray, rows: int) -> np.ndarray:
    """(n, c) by how much x (n, c) changes within some rows around each."""
    return maximum_filter1d(x, rows, axis=0) - minimum_filter1d(x, rows, axis=0)


def still(x: np.ndarray) -> np.ndarray:
    """(n,) whether nearly all of the electrodes x (n, c) [counts] stand still."""
    noise = noise_level(x)
    return (moved(uniform_filter1d(x, 3, axis=0), STILL) < _QUIET * (noise + 0.5)).mean(1) > 0.9


def resting(counts: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Times (m,) [s] and ln Z (m, c) of the stands of counts (n, c) that come again and again, each near the
    one before: untouched. None of a finger that seldom stands still, or never twice alike."""
    edge = np.flatnonzero(np.diff(np.r_[False, still(counts), False]))
    spans = [(a, b) for a, b in zip(edge[::2], edge[1::2]) if b - a >= _ROWS]
    if len(spans) < _STANDS:
        return None
    level = np.stack([counts[a:b].mean(0) for a, b in spans])
    at = np.array([time[a:b].mean() for a, b in spans])
    scaled = level / np.maximum(np.ptp(np.quantile(counts, [0.01, 0.99], axis=0), axis=0), 1.0)
    away = np.sqrt(((scaled[:, None] - scaled) ** 2).mean(2))
    first = int((away < _ALIKE).sum(1).argmax())
    mine = [first]
    for way in (range(first + 1, len(at)), range(first - 1, -1, -1)):  # the level may drift far
        last = first
        for i in way:
            if away[i, last] < _ALIKE:
                mine.append(i)
                last = i
    mine = np.sort(mine)
    if len(mine) < _STANDS or np.ptp(at[mine]) < _SPAN * np.ptp(time):
        return None
    return at[mine], log_impedance(level[mine])
