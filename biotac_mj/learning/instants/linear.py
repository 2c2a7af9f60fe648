"""Principal components, and ridge regression with its strength chosen by group cross-validation."""

from collections.abc import Sequence

import numpy as np

# scikit-learn is imported only for fitting: it takes two seconds, and saved models do not need it


def principal_components(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (k,), axes (k, k) in columns, the largest first, and variances (k,) of rows x (n, k).

    scikit-learn's PCA has at most as many axes as rows. Few rows, such as the rests of a dozen touches, do
    not span all channels, and novelty is measured outside of their span."""
    mean = x.mean(0)
    variance, axes = np.linalg.eigh((x - mean).T @ (x - mean) / len(x))
    return mean, axes[:, ::-1].copy(), np.maximum(variance[::-1], 0)


def ridges(x: np.ndarray, y: np.ndarray, strengths: Sequence[float]) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each strength the weights (k, m) and offset (m,) that minimise |y - x w - b|^2 / n + strength *
    |std(x) w|^2; x (n, k), y (n, m). For infinite strength, w is 0 and b the mean.

    scikit-learn's `ridge_regression` factors once for every target and strength, here once for a strength."""
    from sklearn.preprocessing import StandardScaler

    scaler, mean = StandardScaler().fit(x), y.mean(0)
    scaled = scaler.transform(x)
    gram, moment, weights = scaled.T @ scaled, scaled.T @ (y - mean), []
    for strength in strengths:
        w = np.zeros_like(moment)
        if np.isfinite(strength):
            w = np.linalg.solve(gram + len(x) * strength * np.eye(len(gram)), moment)
        weights.append(w / scaler.scale_[:, None])
    return [(w, mean - scaler.mean_ @ w) for w in weights]


def ridge(x: np.ndarray, y: np.ndarray, strength: float) -> tuple[np.ndarray, np.ndarray]:
    """`ridges` for one strength."""
    return ridges(x, y, [strength])[0]


def held_out_errors(
    x: np.ndarray, y: np.ndarray, groups: np.ndarray, strengths: Sequence[float], folds: int
) -> np.ndarray:
    """(len(strengths), m) mean squared errors of `ridges` on held-out groups.

    Args:
      x: (n, k); y: (n, m). groups: (n,) at least two groups, which are not split. folds: at most.
    """
    from sklearn.model_selection import LeaveOneGroupOut

    # cyclic folds: groups are in order of time, and each fold should cover the whole drift; GroupKFold sorts
    # by size
    fold = np.unique(groups, return_inverse=True)[1] % folds
    error = np.zeros((len(strengths), y.shape[1]))
    for train, test in LeaveOneGroupOut().split(x, groups=fold):
        for square, (w, b) in zip(error, ridges(x[train], y[train], strengths)):
            square += ((x[test] @ w + b - y[test]) ** 2).sum(0)
    return error / len(x)


def best_ridge(
    x: np.ndarray, y: np.ndarray, groups: np.ndarray, strengths: Sequence[float], folds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (k, m) and offset (m,), with the strength that minimises `held_out_errors` for each target."""
    return of_strengths(x, y, strengths, held_out_errors(x, y, groups, strengths, folds).argmin(0))


def of_strengths(
    x: np.ndarray, y: np.ndarray, strengths: Sequence[float], chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (k, m) and offset (m,) of `ridges`, by the strength of number `chosen` (m,) for each target."""
    fits, column = ridges(x, y, strengths), np.arange(y.shape[1])
    weights, offsets = (np.array(part) for part in zip(*fits))
    return weights[chosen, :, column].T, offsets[chosen, column]
