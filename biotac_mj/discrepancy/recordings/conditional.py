"""One electrode given the others: ln Z of all electrodes, and products of its principal components, as one
Gaussian.

How electrodes depend on each other changes with the place of the load; products of principal components model
this. With the precision P of all columns, the residual of an electrode given all others is (P y)_k / P_kk,
with a standard deviation of 1 / sqrt(P_kk); and the amplitude of a common pattern p has the minimum-variance
estimate p'P y / p'P p."""

import numpy as np


class Components:
    """Principal components of rows x (n, c), c columns about their means.

    Args:
      number: of components at most; None: all.

    Attributes:
      size: (k,) singular values, the largest first.
    """

    def __init__(self, x: np.ndarray, number: int | None = None):
        _, self.size, axes = np.linalg.svd(x, full_matrices=False)
        self._axes = axes[:number]
        score = x @ self._axes.T
        self._spread = np.maximum(score.std(0), 1e-9 * self.size[0])  # a channel may stand still
        self._range = (score / self._spread).min(0), (score / self._spread).max(0)
        self._middle = 0.0
        self._middle = self.products(x).mean(0)

    def scores(self, x: np.ndarray) -> np.ndarray:
        """(m, k) of rows x (m, c) in standard deviations of the rows fitted, no farther out than these were:
        beyond them a product would only extrapolate."""
        return np.clip(x @ self._axes.T / self._spread, *self._range)

    def products(self, x: np.ndarray) -> np.ndarray:
        """(m, k (k + 1) / 2) squares and products of scores of rows x (m, c) less their mean in the rows
        fitted."""
        score = self.scores(x)
        i, j = np.triu_indices(score.shape[1])
        return score[:, i] * score[:, j] - self._middle


class Conditional:
    """Gaussian of c electrodes and further columns, q in all.

    Args:
      moment: (q, q) mean products of rows that are normal. floor: (q,) variance of each column by itself.
      number: c, the first columns; None: all.
    """

    def __init__(self, moment: np.ndarray, floor: np.ndarray, number: int | None = None):
        self.precision = np.linalg.inv(moment + np.diag(floor))
        self.number = len(moment) if number is None else number

    @property
    def noise(self) -> np.ndarray:
        """(c,) standard deviation of an electrode given the others."""
        return 1 / np.sqrt(np.diag(self.precision)[: self.number])

    def residual(self, rows: np.ndarray) -> np.ndarray:
        """(n, c) residuals of the electrodes of rows (n, q), given all other columns."""
        return rows @ self.precision[:, : self.number] * self.noise**2

    def along(self, pattern: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(n,) amplitude of a pattern (c,) of the electrodes in rows (n, q)."""
        filtered = self.precision[:, : self.number] @ pattern
        return rows @ filtered / (pattern @ filtered[: self.number])

    def marginal(self) -> np.ndarray:
        """(c, c) precision of the electrodes alone."""
        return np.linalg.inv(np.linalg.inv(self.precision)[: self.number, : self.number])
