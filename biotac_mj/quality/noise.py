"""White noise of a record, from its quietest segments, and the expected noise of a healthy electrode."""

import numpy as np
from scipy.ndimage import median_filter

from ..sensor.channels import electrode_noise

__all__ = ["ROUNDING", "noise_level", "running_median", "sound_noise"]

ROUNDING = 0.29  # [counts] of a number rounded to whole ones: 1 / sqrt(12)


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
