"""How far a row is from the rows that a model was fitted to."""

import dataclasses
import functools

import numpy as np
from scipy.spatial import cKDTree

from ...sensor.channels import FULL_SCALE

__all__ = ["Known", "even"]

_NEAR = 5  # neighbours that a row is compared with
_MOST = 8000  # rows that stand for what was trained on
# where a change begins to count by its ratio and no longer by its size: ln Z, and counts of PDC (chosen on
# synthetic touches; docs/lab/learning.md)
_KNEE, _KNEE_PDC = 0.2, 5.0
_COUNT = 4 / FULL_SCALE  # what one count in the middle of the range is in ln Z: rows are no more exact


def even(change: np.ndarray, pdc: np.ndarray | None = None) -> np.ndarray:
    """(n, 19) changes of ln Z, and (n,) of PDC [counts], as columns in which light and hard touches are as
    dense."""
    columns = np.arcsinh(change / _KNEE)
    return columns if pdc is None else np.column_stack([columns, np.arcsinh(pdc / _KNEE_PDC)])


@dataclasses.dataclass(frozen=True, eq=False)
class Known:
    """Rows that are known; made by `fit`, called with others.

    Attributes:
      mean (k,), axes (k, k), spread (k,): of the principal components that rows are compared in.
      rows: (m, k) known ones in them. apart: (m,) how far each is from its neighbours of other owners.
    """

    mean: np.ndarray
    axes: np.ndarray
    spread: np.ndarray
    rows: np.ndarray
    apart: np.ndarray

    @classmethod
    def fit(cls, x: np.ndarray, owner: np.ndarray, seed: int = 0) -> "Known":
        """Rows x (n, k) of trajectories `owner` (n,), of which there are at least two; seed: which of many
        rows are remembered."""
        mean = x.mean(0)
        size, axes = np.linalg.eigh((x - mean).T @ (x - mean) / len(x))
        # what the smaller half of the components has is noise: less counts for nothing
        spread = np.sqrt(np.maximum(size, 0) + np.maximum(size[: len(size) // 2], 0).mean() + _COUNT**2)
        chosen = np.random.default_rng(seed).permutation(len(x))[:_MOST]
        rows, owner = (x[chosen] - mean) @ axes / spread, np.unique(owner[chosen], return_inverse=True)[1]
        # rows of one trajectory are alike: how dense the others lie is what an unseen one meets
        count = min(len(rows), _NEAR + np.bincount(owner).max())
        distance, who = cKDTree(rows).query(rows, count)
        distance = np.sort(np.where(owner[who] == owner[:, None], np.inf, distance), 1)[:, :_NEAR]
        there = np.isfinite(distance)
        apart = np.where(there, distance, 0).sum(1) / np.maximum(there.sum(1), 1)
        return cls(mean, axes, spread, rows, np.maximum(apart, np.linalg.norm(_COUNT / spread)))

    @functools.cached_property
    def _tree(self):
        return cKDTree(self.rows)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(n,) distances of rows (n, k) from the nearest known ones, over how far those are apart."""
        which = np.arange(1, min(_NEAR, len(self.rows)) + 1)
        near, who = self._tree.query((x - self.mean) @ self.axes / self.spread, which)
        return near.mean(1) / self.apart[who].mean(1)
