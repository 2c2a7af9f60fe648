"""Linearised signatures: what effects do about a fit by straight lines, beside all that the fit can move."""

import typing

import numpy as np

from .fitting import sizes
from .likelihood import of

if typing.TYPE_CHECKING:
    from ...effects.effect import Effect
    from .fitting import Fit
    from .whitening import Comparison


class Signatures:
    """Signatures of effects beside a fit, in the likelihood's eigenvectors and divided by the standard
    deviation there, without what poses, the base model and the fit's effects can mimic within their
    priors."""

    def __init__(self, comparison: "Comparison", current: "Fit", chosen: np.ndarray):
        self.comparison, self.current = comparison, current
        self.likelihood = of(comparison, chosen)
        self.sd = np.sqrt(self.likelihood.variance(current.amplitude, current.size)).ravel()
        self.known = current.columns.reshape(len(current.columns), -1) / self.sd
        factor = np.linalg.cholesky(np.eye(len(self.known)) + self.known @ self.known.T)
        self._weights = np.linalg.solve(factor, self.known)
        self._base = self._residual(current.effects)

    def _residual(self, effects):
        raw = self.comparison.raw(effects, self.current.nuisance, offsets=self.current.offsets)
        return self.likelihood.turned(self.likelihood.stacked(raw))

    def columns(self, effect: "Effect", shape: dict) -> np.ndarray:
        """Changes (free, rows) by a realistic size of each free parameter, by secants."""
        out = []
        for name, size in sizes(effect):
            theta = {**effect.default(), **shape}
            theta[name] = theta[name] + size
            out.append(self._base - self._residual([*self.current.effects, (effect, theta)]))
        return np.array(out).reshape(len(out), -1) / self.sd

    def own(self, columns: np.ndarray) -> np.ndarray:
        """Columns (m, rows) without the part that can be mimicked: its products with any columns equal those
        of the remaining parts."""
        return columns - (columns @ self._weights.T) @ self._weights
