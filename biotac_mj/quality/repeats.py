"""Rows that repeat the one before, because the logger is faster than the bus or values were held."""

import numpy as np

from ..sensor.channels import NELECTRODE


def repeated_rows(counts: np.ndarray) -> np.ndarray:
    """(n,) bool: rows of counts (n, c) that equal the one before, unless by chance.

    A few channels, 4 of a BioTac's, may differ: something may have been added to single channels after the
    hold.
    """
    n, c = counts.shape
    if n < 2:
        return np.zeros(n, bool)
    least = c - 4 * c // NELECTRODE
    equal = np.diff(counts, axis=0) == 0
    same = np.concatenate([[False], equal.sum(1) >= least])
    single = equal.mean(0)
    by_channel = np.clip((single - same.mean()) / max(1 - same.mean(), 1e-9), 1e-3, 1)
    chance = np.prod(np.sort(by_channel)[::-1][:least])
    return same if same.mean() > 20 * chance else np.zeros(n, bool)
