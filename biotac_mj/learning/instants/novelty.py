"""How far a row is from the rows that a model was fitted to, and how long electrodes have stood still."""

import dataclasses
import functools

import numpy as np
from scipy.spatial import cKDTree

from ...sensor.channels import FULL_SCALE

__all__ = ["Known", "even", "standing_still"]

_NEAR, _ALIKE = 5, 10  # neighbours that a row is compared with, and that say what PDC goes with it
_MOST = 8000  # rows that stand for what was trained on
# where a change begins to count by its ratio and no longer by its size: ln Z, and counts of PDC (chosen on
# synthetic touches; docs/lab/learning.md)
_KNEE, _KNEE_PDC = 0.2, 5.0
_USUAL = 0.9  # of the known rows' PDC is less off than what counts as one (chosen likewise)
_LEAST = 0.05  # of PDC, so squeezed: how far alike rows differ at least (chosen likewise)
_COUNT = 4 / FULL_SCALE  # what one count in the middle of the range is in ln Z: rows are no more exact


def even(change: np.ndarray) -> np.ndarray:
    """(n, 19) changes of ln Z, so squeezed that light and hard touches are as dense."""
    return np.arcsinh(change / _KNEE)


def standing_still(counts: np.ndarray, owner: np.ndarray | None = None) -> np.ndarray:
    """(n, 19) for how many rows, in which others changed, an electrode has read the same; counts (n, 19) in
    order of time, owner (n,): trajectories, which begin anew."""
    new = np.concatenate([np.zeros((1, counts.shape[1]), bool), np.diff(counts, axis=0) != 0])
    if owner is not None:
        new[1:] |= (np.diff(owner) != 0)[:, None]
    at = np.cumsum(new.any(1))[:, None]
    return at - np.maximum.accumulate(np.where(new, at, 0), axis=0)


@dataclasses.dataclass(frozen=True, eq=False)
class Known:
    """Rows that are known; made by `fit`, called with others.

    Attributes:
      mean (k,), axes (k, k), spread (k,): of the principal components that rows are compared in.
      rows: (m, k) known ones in them. apart: (m,) how far each is from its neighbours of other owners.
      pdc: (m,) their PDC, squeezed, (0,) where it is not known. off: () how far it usually is from that of
        neighbours of other owners, over what it varies by among these.
    """

    mean: np.ndarray
    axes: np.ndarray
    spread: np.ndarray
    rows: np.ndarray
    apart: np.ndarray
    pdc: np.ndarray
    off: np.ndarray

    @classmethod
    def fit(cls, x: np.ndarray, owner: np.ndarray, pdc: np.ndarray | None = None, seed: int = 0) -> "Known":
        """Rows x (n, k) of trajectories `owner` (n,), of which there are at least two; pdc: (n,) changes
        [counts]; seed: which of many rows are remembered."""
        mean = x.mean(0)
        size, axes = np.linalg.eigh((x - mean).T @ (x - mean) / len(x))
        # what the smaller half of the components has is noise: less counts for nothing
        spread = np.sqrt(np.maximum(size, 0) + np.maximum(size[: len(size) // 2], 0).mean() + _COUNT**2)
        chosen = np.random.default_rng(seed).permutation(len(x))[:_MOST]
        rows, owner = (x[chosen] - mean) @ axes / spread, np.unique(owner[chosen], return_inverse=True)[1]
        # rows of one trajectory are alike: how dense the others lie is what an unseen one meets
        count = min(len(rows), _ALIKE + np.bincount(owner).max())
        distance, who = cKDTree(rows).query(rows, count)
        distance = np.where(owner[who] == owner[:, None], np.inf, distance)
        order = np.argsort(distance, 1, kind="stable")[:, :_ALIKE]
        distance, who = (np.take_along_axis(value, order, 1) for value in (distance, who))
        near = distance[:, :_NEAR]
        there = np.isfinite(near)
        apart = np.where(there, near, 0).sum(1) / np.maximum(there.sum(1), 1)
        apart = np.maximum(apart, np.linalg.norm(_COUNT / spread))
        pdc = np.zeros(0) if pdc is None else _squeezed(pdc[chosen])
        off = np.quantile(_off(pdc, pdc[who], distance), _USUAL) if len(pdc) else 1.0
        return cls(mean, axes, spread, rows, apart, pdc, np.array(max(off, _LEAST)))

    @functools.cached_property
    def _tree(self):
        return cKDTree(self.rows)

    def __call__(self, x: np.ndarray, pdc: np.ndarray | None = None) -> np.ndarray:
        """(n,) distances of rows (n, k) from the nearest known ones, over how far those are apart; pdc: (n,)
        changes [counts] that make a row the stranger, the less they are those of rows alike."""
        which = np.arange(1, min(_ALIKE, len(self.rows)) + 1)
        distance, who = self._tree.query((x - self.mean) @ self.axes / self.spread, which)
        strange = distance[:, :_NEAR].mean(1) / self.apart[who[:, :_NEAR]].mean(1)
        if pdc is None:
            return strange
        return np.hypot(strange, _off(_squeezed(pdc), self.pdc[who], distance) / self.off)


def _squeezed(pdc):
    return np.arcsinh(pdc / _KNEE_PDC)


def _off(value, alike, distance):
    """(n,) how far values are from those (n, k) of rows alike, over how far these differ; nearer ones count
    more."""
    weight = 1 / np.maximum(distance, 1e-3)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-9)
    mean = (weight * alike).sum(1)
    return np.abs(value - mean) / (np.sqrt((weight * (alike - mean[:, None]) ** 2).sum(1)) + _LEAST)
