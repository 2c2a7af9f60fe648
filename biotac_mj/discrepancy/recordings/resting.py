"""Where a finger stands still."""

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from ...quality.noise import noise_level

__all__ = ["moved", "still"]

STILL = 10  # rows over which nothing moves
_QUIET = 5.0  # of the noise, how far electrodes then wander at most


def moved(x: np.ndarray, rows: int) -> np.ndarray:
    """(n, c) by how much x (n, c) changes within some rows around each."""
    return maximum_filter1d(x, rows, axis=0) - minimum_filter1d(x, rows, axis=0)


def still(x: np.ndarray) -> np.ndarray:
    """(n,) whether nearly all of the electrodes x (n, c) [counts] stand still."""
    noise = noise_level(x)
    return (moved(uniform_filter1d(x, 3, axis=0), STILL) < _QUIET * (noise + 0.5)).mean(1) > 0.9
