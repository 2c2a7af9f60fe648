"""How far a row is from the rows that a model was fitted to, and whether an electrode is stuck."""

import dataclasses
import functools

import numpy as np
from scipy.spatial import cKDTree

from ...sensor.channels import FULL_SCALE
from .force import causal_average
from .linear import principal_components, ridge

__all__ = ["Known", "Moving", "even"]

_NEAR, _ALIKE = 5, 10  # neighbours that a row is compared with, and that say what PDC goes with it
_MOST = 8000  # rows that stand for what was trained on
# where a change begins to count by its ratio and no longer by its size: ln Z, and counts of PDC (chosen on
# synthetic touches; docs/lab/learning.md)
_KNEE, _KNEE_PDC = 0.2, 5.0
_USUAL = 0.9  # of the known rows' PDC is less off than what counts as one (chosen likewise)
_LEAST = 0.05  # of PDC, so squeezed: how far alike rows differ at least (chosen likewise)
# of electrodes that are stuck (chosen on the first 70 % of two pressed sensors): what changes over more rows
# does not count, how much less such a one moves than a good one errs, evidence below which nothing is said
_SLOW, _STILL, _SURE = 100.0, 0.5, 10.0
_RIDGE = 1e-4
_COUNT = 4 / FULL_SCALE  # what one count in the middle of the range is in ln Z: rows are no more exact


def even(change: np.ndarray) -> np.ndarray:
    """(n, 19) changes of ln Z, so squeezed that light and hard touches are as dense."""
    return np.arcsinh(change / _KNEE)


@dataclasses.dataclass(frozen=True, eq=False)
class Moving:
    """Which electrode no longer moves as the others say; made by `fit`, called with rows in order of time.

    Two stories are told of every electrode: that it does what the others let expect, up to its usual error,
    and that it is stuck. The sum of the logarithm of how much likelier the second makes each row, held above
    zero, is the evidence (Page, 1954): it grows while others move and falls where the electrode does.

    Attributes:
      weight: (19, 19) what each electrode (a column) is by the others. spread: (19,) its usual error.
      most: () the strongest evidence in known rows, of any electrode.
    """

    weight: np.ndarray
    spread: np.ndarray
    most: np.ndarray

    @classmethod
    def fit(cls, x: np.ndarray, learned: np.ndarray) -> "Moving":
        """Rows x (n, k) of ln Z, of which those `learned` (n,) say how electrodes go with each other; how far
        evidence goes where nothing is stuck is looked up in all."""
        move = _moves(x)[learned]
        weight = np.zeros((x.shape[1],) * 2)
        for k in range(x.shape[1]):
            other = np.arange(x.shape[1]) != k
            weight[other, k] = ridge(move[:, other], move[:, [k]], _RIDGE)[0][:, 0]
        spread = np.sqrt(((move - move @ weight) ** 2).mean(0) + _COUNT**2)
        one = cls(weight, spread, np.ones(()))
        return dataclasses.replace(one, most=np.maximum(one._evidence(x).max(), _SURE))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(n,) evidence in rows (n, k) that an electrode is stuck, over the most that known rows have."""
        return self._evidence(x).max(1) / self.most if len(x) else np.zeros(0)

    def _evidence(self, x):
        # rows that are held as a whole, by a logger that is faster than the sensor, say nothing new
        new = np.concatenate([[True], (np.diff(x, axis=0) != 0).any(1)])
        move = _moves(x[new])
        total = (((move - move @ self.weight) ** 2 - (move / _STILL) ** 2) / (2 * self.spread**2)).cumsum(0)
        return (total - np.minimum.accumulate(np.minimum(total, 0)))[new.cumsum() - 1]


def _moves(x):
    """Rows (n, k) without what changes slowly: warm-up is not told from an electrode that drifts."""
    return x - causal_average(x, _SLOW)


# scikit-learn's LocalOutlierFactor, in these components, is no better: areas under the curve of 0.968 against
# 0.971 for an electrode that stays at its rest, 0.997 against 0.998 for two contacts (touches of
# tests/test_learning_reader.py). It cannot leave a row's own trajectory out, nor be kept as plain numbers.
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
        mean, axes, variance = principal_components(x)
        # what the smaller half of the components has is noise: less counts for nothing
        spread = np.sqrt(variance + variance[(len(variance) + 1) // 2 :].mean() + _COUNT**2)
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
