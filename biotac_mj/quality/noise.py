"""White noise of a record, from its quietest parts, and what a sound electrode has."""

import numpy as np
from scipy.ndimage import median_filter

from ..sensor.channels import electrode_noise

__all__ = ["ROUNDING", "noise_level", "running_median", "sound_noise"]

ROUNDING = 0.29  # [counts] of a number rounded to whole ones: 1 / sqrt(12)


def sound_noise(counts: np.ndarray) -> np.ndarray:
    """Standard deviation of a sound electrode's noise at these counts [counts]: of rounding at least, which
    is all that is left at the ends of what it can read, where a broken wire leaves it."""
    return np.maximum(electrode_noise(counts), ROUNDING)


def noise_level(counts: np.ndarray, repeated: np.ndarray | None = None, least: float = 0.05) -> np.ndarray:
    """(c,) standard deviation of the white noise of samples (n, c) [counts]: second differences of the
    quietest quarter of the record."""
    x = counts if repeated is None else counts[~repeated]
    d = np.diff(x, n=2, axis=0) / np.sqrt(6)
    size = max(20, len(d) // 60)
    k = max(1, len(d) // size)
    blocks = (d[: k * size].reshape(k, -1, d.shape[1]) ** 2).mean(1)
    return np.maximum(np.sqrt(np.quantile(blocks, 0.25, axis=0)), least)


def running_median(x: np.ndarray, size: int, mode: str) -> np.ndarray:
    """Medians of `size` rows of x (n, c), column by column; mode: how it goes on beyond its ends, as
    scipy.ndimage.median_filter has it. One column at a time takes scipy up to twenty times less."""
    return np.stack([median_filter(column, size, mode=mode) for column in x.T], axis=1)
