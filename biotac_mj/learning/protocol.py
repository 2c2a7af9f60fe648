"""Evaluation of models: errors per interaction, coverage, paired tests, intervals. Unit: raw counts; the
paper's is counts / 2048."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t, wilcoxon


def interaction_errors(
    predicted: ArrayLike, truth: ArrayLike, owner: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """RMS over the electrodes of each row, averaged over the rows of each interaction.

    Args:
      predicted, truth: (n, nelectrode) tared counts. owner: (n,) interaction of each row.

    Returns:
      interactions (k,) and their errors (k,) [counts].

    Raises:
      ValueError: shapes that differ, no rows, or values that are not finite.
    """
    predicted, truth, owner = np.asarray(predicted, float), np.asarray(truth, float), np.asarray(owner)
    if predicted.shape != truth.shape or truth.ndim != 2 or len(owner) != len(truth):
        raise ValueError(
            f"predicted {predicted.shape}, truth {truth.shape}, owner {owner.shape}: "
            "(n, nelectrode), the same and (n,) are needed"
        )
    if not len(truth):
        raise ValueError("there are no rows to judge: the test part of the split is empty")
    if not (np.isfinite(predicted).all() and np.isfinite(truth).all()):
        raise ValueError(
            "predicted or truth holds values that are not finite: "
            "look for NaN in the data set's measured_counts"
        )
    rms = np.sqrt(((predicted - truth) ** 2).mean(1))
    which, index = np.unique(owner, return_inverse=True)
    return which, np.bincount(index, rms) / np.bincount(index)


def quartiles(values: ArrayLike) -> tuple[float, float, float]:
    """Median, lower and upper quartile as floats."""
    q25, q50, q75 = np.percentile(values, [25, 50, 75])
    return float(q50), float(q25), float(q75)


def paired_test(a: ArrayLike, b: ArrayLike) -> dict:
    """Wilcoxon's signed-rank test of paired errors a, b (k,) of the same interactions, two-sided.

    Returns:
      dict: n, median of a - b [counts], fraction of interactions with smaller a, p (1 if nothing differs).
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    if a.shape != b.shape or a.ndim != 1 or len(a) < 5:
        raise ValueError(
            f"paired test of {a.shape} and {b.shape} errors: the same interactions, at least five, are needed"
        )
    difference = a - b
    p = 1.0 if not difference.any() else float(wilcoxon(a, b).pvalue)
    return {
        "n": len(a),
        "median_difference": float(np.median(difference)),
        "better": float((difference < 0).mean()),
        "p": p,
    }


def is_better(error: np.ndarray, other: np.ndarray, owner: ArrayLike) -> bool:
    """Whether one model's RMS errors per trajectory are smaller than another's by more than chance: a paired
    one-sided t test (Student) at 5 %. False for a single trajectory.

    Args:
      error, other: (n, k) errors of both models in the same rows. owner: (n,) trajectory of each row.
    """
    _, index = np.unique(owner, return_inverse=True)
    mine, theirs = (np.bincount(index, (e**2).mean(axis=1)) / np.bincount(index) for e in (error, other))
    gain = np.sqrt(theirs) - np.sqrt(mine)
    n = len(gain)
    return n > 1 and bool(gain.mean() > t.ppf(0.95, n - 1) * gain.std(ddof=1) / np.sqrt(n))


def check_changes(source: str, force: np.ndarray) -> None:
    """Raises a ValueError where a force (n, 3) [N] is the same in all rows that have one."""
    known = force[np.isfinite(force).all(axis=1)]
    if len(known) and not np.ptp(known, axis=0).any():
        raise ValueError(
            f"{source}: the force never changes, so that it cannot be learned: leave it out, or record again "
            "with the force sensor on"
        )


def conformal_width(error: np.ndarray, owner: ArrayLike, alpha: float = 0.1) -> np.ndarray:
    """Half widths (nelectrode,) [counts] of intervals that cover a new interaction's rows with mean
    probability 1 - alpha.

    Rows of one interaction are similar, so the interactions are the exchangeable units: the distribution
    functions of their absolute errors are averaged, with one more interaction of infinite error (pooling of
    distribution functions, Dunn, Wasserman and Ramdas, 2022).

    Args:
      error: (n, nelectrode) predicted - truth on the validation interactions. owner: (n,).

    Returns:
      (nelectrode,); infinite if there are too few interactions for alpha.
    """
    error, owner = np.abs(np.asarray(error, float)), np.asarray(owner)
    which, index = np.unique(owner, return_inverse=True)
    weight = (1 / np.bincount(index))[index] / (len(which) + 1)
    out = np.empty(error.shape[1])
    for e in range(error.shape[1]):
        order = np.argsort(error[:, e])
        rank = np.searchsorted(np.cumsum(weight[order]), 1 - alpha - 1e-12)
        out[e] = error[order[rank], e] if rank < len(order) else np.inf
    return out
