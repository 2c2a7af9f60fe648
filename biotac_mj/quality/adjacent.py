"""Readings of a channel around a row: its last measurement, and lines on either side."""

import numpy as np


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
