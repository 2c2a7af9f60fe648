"""Evidence whose unit is the block of time or the trajectory, never the sample, and what of it is enough."""

import numpy as np
from scipy.stats import false_discovery_control

from ..quality.evidence import signs

RATE = 1 / 21  # of false discoveries
ODDS = (1 - RATE) / RATE  # how much likelier than all else an explanation has to be

# scipy has no max-T


def log_ratio(
    before: np.ndarray, after: np.ndarray, rows: np.ndarray | float, floor: np.ndarray | float = 0.0
) -> np.ndarray:
    """Log likelihood [nats] that data left out gain from one model to another, by the mean squares of both on
    so many independent rows, with noise of a mean square `floor` beneath."""
    return 0.5 * rows * np.log((before + floor) / (after + floor))


def asked(count: int) -> float:
    """Evidence [nats] that makes one of so many candidates likelier than nothing by `ODDS`, where any may be
    there as well as none."""
    return float(np.log(ODDS) + np.log(max(count, 1)))


def by_chance(gain: float, count: int) -> float:
    """Probability at most with which any of so many candidates has this evidence [nats] of data without it:
    without an effect the expected ratio of densities is one (Markov's inequality)."""
    return float(np.exp(min(np.log(count) - gain, 0.0)))


def not_distinguished(best: float, other: float, law_error: float) -> bool:
    """Whether an effect with evidence `other` [nats] is nearly as likely as one with `best`: within the odds
    that decide, or within what the law of the best one is off by (a fraction), which evidence has twice."""
    return bool(best - other < max(np.log(ODDS), 2 * law_error * best))


def discoveries(p: np.ndarray) -> np.ndarray:
    """Discoveries among tests with p-values p (tests, ...), at a rate of false discoveries of `RATE`
    (Benjamini and Hochberg 1995)."""
    return false_discovery_control(np.asarray(p, float), axis=0) <= RATE


def further_off(before: np.ndarray, after: np.ndarray, chance: np.ndarray | None = None) -> bool:
    """Whether a model is further off from held-out data than the one without what was found, in any group of
    channels by more than chance: nothing is written that is.

    Args:
      before, after: (units, groups) squares of errors of blocks of time or of trajectories.
      chance: (groups,) standard deviation of the change of their sums; None: estimated from the units, at
        least two.
    """
    change = np.subtract(after, before)
    if chance is None:
        chance = change.std(0, ddof=1) * np.sqrt(len(change))
    return bool((change.sum(0) > chance).any())


def max_t(statistic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Family-wise p of many cells by sign flips of whole units (Andreella and Finos 2026; max-T of Westfall
    and Young).

    Args:
      statistic: (units, cells), one number for each trajectory or block and cell, symmetric about zero under
        the null; nan where a unit has no data on a cell.

    Returns:
      t (cells,), p (cells,) adjusted.
    """
    x = np.asarray(statistic, float)
    known = np.isfinite(x)
    x = np.where(known, x, 0.0)
    scale = np.sqrt(np.maximum((x**2).sum(0), 1e-30))
    t = x.sum(0) / scale
    largest = np.abs(signs(len(x)) @ x / scale).max(1)
    return t, np.array([np.mean(largest >= abs(v) - 1e-12) for v in t])
