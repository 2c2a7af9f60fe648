"""Readings of a channel around a row: its last measurement, lines on either side, and sharp changes."""

import numpy as np
from scipy.ndimage import uniform_filter1d

_AROUND, _TIMES = 21, 5.0  # rows around, and times their change


def last_measured(x: np.ndarray, masked: np.ndarray) -> np.ndarray:
    """(n, c) values of x (n, c); samples masked (n, c) take the last one before them that is not."""
    last = np.maximum.accumulate(np.where(masked, 0, np.arange(len(x))[:, None]), axis=0)
    return np.take_along_axis(x, last, axis=0)


def line_ends(x: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Ends of least-squares lines through `rows` rows on the left and right of every gap between rows of x
    (n, c), and the standard deviation of their difference in noise units."""
    n, line = len(x), np.vander(np.arange(rows), 2)
    end = np.array([rows - 0.5, 1.0]) @ np.linalg.pinv(line)  # value half a row after the last one
    before = sum(end[i] * x[i : n - rows + 1 + i] for i in range(rows))
    after = sum(end[::-1][i] * x[i : n - rows + 1 + i] for i in range(rows))
    return before[:-rows], after[rows:], np.sqrt(2 * (end**2).sum())


def sharp(x: np.ndarray, least: np.ndarray | float) -> np.ndarray:
    """(n - 1, c) bool: changes of x (n, c) from one row to the next that exceed `least` (c,) and those of the
    rows around."""
    step = np.abs(np.diff(x, axis=0))
    return (step > least) & (step > _TIMES * uniform_filter1d(step, _AROUND, axis=0))
