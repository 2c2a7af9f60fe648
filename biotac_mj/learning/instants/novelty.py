"""Distance of a row from the training rows of a model, and detection of stuck electrodes."""

import dataclasses
import functools

import numpy as np
from scipy.spatial import cKDTree

from ...sensor.channels import FULL_SCALE
from .force import causal_average
from .linear import principal_components, ridge

_NEIGHBOURS, _SIMILAR = 5, 10  # nearest neighbours for the distance, and for the expected PDC
_MOST = 8000  # most reference rows
# scale above which a change counts by its ratio instead of its size: ln Z, and counts of PDC (chosen on
# synthetic touches; docs/lab/learning.md)
_KNEE, _KNEE_PDC = 0.2, 5.0
_USUAL = 0.9  # quantile of the training rows' PDC error that is one unit (chosen likewise)
_LEAST = 0.05  # least spread of PDC, compressed, among neighbours (chosen likewise)
# for stuck electrodes (chosen on the first 70 % of two pressed sensors): slowest counted change in rows,
# ratio of a stuck electrode's motion to a healthy one's error, evidence that is ignored
_SLOW, _STILL, _SURE = 100.0, 0.5, 10.0
_RIDGE = 1e-4
_COUNT = 4 / FULL_SCALE  # change of ln Z per count at mid-range: the resolution of rows


def compressed(change: np.ndarray) -> np.ndarray:
    """(n, nelectrode) changes of ln Z, compressed so that light and hard touches are equally dense."""
    return np.arcsinh(change / _KNEE)


@dataclasses.dataclass(frozen=True, eq=False)
class StuckDetector:
    """Detects electrodes that no longer move as predicted by the others; made by `fit`, called with rows in
    order.

    Each electrode has two hypotheses: it follows the conditional prediction from the others up to its usual
    error, or it is stuck. The evidence is the cumulative log-likelihood ratio, held above zero (CUSUM; Page,
    1954): it grows while others move and falls when the electrode does.

    Attributes:
      weight: (nelectrode, nelectrode) coefficients of each electrode (a column) on the others. spread:
        (nelectrode,) its usual error.
      most: () largest evidence in known rows, of any electrode.
    """

    weight: np.ndarray
    spread: np.ndarray
    most: np.ndarray

    @classmethod
    def fit(cls, x: np.ndarray, learned: np.ndarray) -> "StuckDetector":
        """Fits to rows x (n, k) of ln Z: correlations of electrodes from the rows `learned` (n,), the largest
        evidence without a stuck electrode from all."""
        move = _moves(x)[learned]
        weight = np.zeros((x.shape[1],) * 2)
        for k in range(x.shape[1]):
            other = np.arange(x.shape[1]) != k
            weight[other, k] = ridge(move[:, other], move[:, [k]], _RIDGE)[0][:, 0]
        spread = np.sqrt(((move - move @ weight) ** 2).mean(0) + _COUNT**2)
        one = cls(weight, spread, np.ones(()))
        return dataclasses.replace(one, most=np.maximum(one._evidence(x).max(), _SURE))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(n,) evidence in rows (n, k) that an electrode is stuck, over the largest in known rows."""
        return self._evidence(x).max(1) / self.most if len(x) else np.zeros(0)

    def _evidence(self, x):
        # rows repeated as a whole, by a logger that is faster than the sensor, are no evidence
        new = np.concatenate([[True], (np.diff(x, axis=0) != 0).any(1)])
        move = _moves(x[new])
        total = (((move - move @ self.weight) ** 2 - (move / _STILL) ** 2) / (2 * self.spread**2)).cumsum(0)
        return (total - np.minimum.accumulate(np.minimum(total, 0)))[new.cumsum() - 1]


def _moves(x):
    """Rows (n, k), high-passed: warm-up cannot be separated from a drifting electrode."""
    return x - causal_average(x, _SLOW)


# scikit-learn's LocalOutlierFactor, in these components, is no better: areas under the curve of 0.968 against
# 0.971 for an electrode that stays at its baseline, 0.997 against 0.998 for two contacts (touches of
# tests/test_learning_reader.py). It can neither exclude a row's own trajectory nor be saved as plain numbers.
@dataclasses.dataclass(frozen=True, eq=False)
class NoveltyDetector:
    """Reference rows; made by `fit`, called with other rows.

    Attributes:
      mean (k,), axes (k, k), spread (k,): of the principal components in which rows are compared.
      rows: (m, k) reference rows in them. apart: (m,) distance of each from its neighbours of other
        trajectories.
      pdc: (m,) their PDC, compressed, (0,) if unknown. off: () usual deviation of PDC from neighbours of
        other trajectories, over its spread among these.
    """

    mean: np.ndarray
    axes: np.ndarray
    spread: np.ndarray
    rows: np.ndarray
    apart: np.ndarray
    pdc: np.ndarray
    off: np.ndarray

    @classmethod
    def fit(
        cls, x: np.ndarray, owner: np.ndarray, pdc: np.ndarray | None = None, seed: int = 0
    ) -> "NoveltyDetector":
        """Fits to rows x (n, k) of at least two trajectories `owner` (n,). pdc: (n,) changes [counts]; seed:
        of the subsample of rows."""
        mean, axes, variance = principal_components(x)
        # the smaller half of the components is noise: smaller deviations do not count
        spread = np.sqrt(variance + variance[(len(variance) + 1) // 2 :].mean() + _COUNT**2)
        chosen = np.random.default_rng(seed).permutation(len(x))[:_MOST]
        rows, owner = (x[chosen] - mean) @ axes / spread, np.unique(owner[chosen], return_inverse=True)[1]
        # rows of one trajectory are similar, so distances to other trajectories represent new data
        count = min(len(rows), _SIMILAR + np.bincount(owner).max())
        distance, neighbour = cKDTree(rows).query(rows, count)
        distance = np.where(owner[neighbour] == owner[:, None], np.inf, distance)
        order = np.argsort(distance, 1, kind="stable")[:, :_SIMILAR]
        distance, neighbour = (np.take_along_axis(value, order, 1) for value in (distance, neighbour))
        near = distance[:, :_NEIGHBOURS]
        there = np.isfinite(near)
        apart = np.where(there, near, 0).sum(1) / np.maximum(there.sum(1), 1)
        apart = np.maximum(apart, np.linalg.norm(_COUNT / spread))
        pdc = np.zeros(0) if pdc is None else _squeezed(pdc[chosen])
        off = np.quantile(_off(pdc, pdc[neighbour], distance), _USUAL) if len(pdc) else 1.0
        return cls(mean, axes, spread, rows, apart, pdc, np.array(max(off, _LEAST)))

    @functools.cached_property
    def _tree(self):
        return cKDTree(self.rows)

    def __call__(self, x: np.ndarray, pdc: np.ndarray | None = None) -> np.ndarray:
        """(n,) distances of rows (n, k) from the nearest reference rows, relative to these rows' own spacing.
        pdc: (n,) changes [counts]; a deviation from similar rows' PDC increases the distance."""
        which = np.arange(1, min(_SIMILAR, len(self.rows)) + 1)
        distance, neighbour = self._tree.query((x - self.mean) @ self.axes / self.spread, which)
        strange = distance[:, :_NEIGHBOURS].mean(1) / self.apart[neighbour[:, :_NEIGHBOURS]].mean(1)
        if pdc is None:
            return strange
        return np.hypot(strange, _off(_squeezed(pdc), self.pdc[neighbour], distance) / self.off)


def _squeezed(pdc):
    return np.arcsinh(pdc / _KNEE_PDC)


def _off(value, alike, distance):
    """(n,) deviation of values from those (n, k) of similar rows, over their spread; nearer ones weigh
    more."""
    weight = 1 / np.maximum(distance, 1e-3)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-9)
    mean = (weight * alike).sum(1)
    return np.abs(value - mean) / (np.sqrt((weight * (alike - mean[:, None]) ** 2).sum(1)) + _LEAST)
