"""Drifts of single electrodes beside a load: what a smooth course over time adds to what all others say of an
electrode, at all frequencies and not within windows alone.

Within windows the joint model (`model.py`) says what the load does, but levels wander by what it does not
say of slow changes: a course fits these wanderings as well. Here others and course are fitted together, on
blocks of time left out, so that a course has to explain what the others, their squares and products
cannot."""

import numpy as np

from ...evidence import sign_flip
from ..model import Model
from .courses import BLOCKS, Course, goes_on, hats

__all__ = ["Drifts", "drifts"]

_AXES = 5  # principal components whose products are among the regressors
_FAR = 4.0  # standard deviations of one: beyond, a square would only extrapolate
_KNOTS = 7
_RIDGE, _BENT = 1e-3, 1e-4  # of a regressor's variance: of the others, of the course
_COUNT = 1.0  # [counts] that nothing says


class Drifts:
    """Of the electrodes used (c,): gain (c, blocks) half the logarithm of the ratio of mean squares on blocks
    left out, without the course and with it; size (c,) RMS of the difference [counts]."""

    def __init__(self, model: Model):
        self._model = model
        self._x, self._time = model.value[model.inside], model.time[model.inside]
        n, c = self._x.shape
        self._block = np.arange(n) * BLOCKS // n
        self._knots = np.linspace(self._time[0], self._time[-1], _KNOTS)
        self._hats = hats(self._time, self._knots)
        floor = model.noise**2 + (_COUNT / model.slope) ** 2
        self.gain, self.size = np.zeros((c, BLOCKS)), np.zeros(c)
        for i in range(c):
            A, y, ridge = self._design(i)
            missed = [self._left_out(A[:, :q], y, ridge[:q]) for q in (A.shape[1] - _KNOTS, A.shape[1])]
            self.gain[i] = 0.5 * np.log((missed[0] + floor[i]) / (missed[1] + floor[i]))
            self.size[i] = np.sqrt(max(missed[0].mean() - missed[1].mean(), 0)) * model.slope[i]

    def course(self, i: int) -> Course:
        """What used electrode i does over time beside the others [ln Z]."""
        A, y, ridge = self._design(i)
        w = np.linalg.solve(A.T @ A + np.diag(ridge), A.T @ y)
        values = w[-_KNOTS:] - (self._hats @ w[-_KNOTS:]).mean()
        # three cells a block, as of the other courses
        gain = 3 * self.gain[i]
        found = Course("smooth", np.nan, self._knots, values, 0.0, gain, sign_flip(gain))
        beside = np.full(len(self._model.time), np.nan)
        beside[self._model.inside] = y - A[:, :-_KNOTS] @ w[:-_KNOTS]
        found.tail = goes_on(*self._model.levels(beside))
        return found

    def _design(self, i):
        """Regressors (n, q) of used electrode i, the course's last; its own values (n,); ridge (q,)."""
        n = len(self._x)
        others = np.delete(self._x, i, axis=1)
        others = others - others.mean(0)
        u = np.linalg.svd(others / np.delete(self._model.noise, i), full_matrices=False)[0]
        u = np.clip(u[:, :_AXES] * np.sqrt(n), -_FAR, _FAR)
        a, b = np.triu_indices(u.shape[1])
        products = u[:, a] * u[:, b]
        linear = np.column_stack([others, products - products.mean(0)])
        linear /= np.maximum(linear.std(0), 1e-12)
        ridge = n * np.r_[np.full(linear.shape[1], _RIDGE), np.full(_KNOTS, _BENT)]
        course = self._hats - self._hats.mean(0)
        return np.column_stack([linear, course]), self._x[:, i] - self._x[:, i].mean(), ridge

    def _left_out(self, A, y, ridge):
        """(blocks,) mean squares of y (n,) less what regressors A (n, q) say of it, fitted without each
        block."""
        G, h, out = A.T @ A + np.diag(ridge), A.T @ y, np.empty(BLOCKS)
        for b in range(BLOCKS):
            mine = self._block == b
            w = np.linalg.solve(G - A[mine].T @ A[mine], h - A[mine].T @ y[mine])
            out[b] = np.mean((y[mine] - A[mine] @ w) ** 2)
        return out


def drifts(model: Model) -> Drifts | None:
    """None where so little is fitted that a block has no bins, or too few electrodes are left."""
    return Drifts(model) if model.inside.sum() > 4 * BLOCKS and len(model.used) > 6 else None
