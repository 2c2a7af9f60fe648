"""Linearised signatures: what effects do about a fit by straight lines, beside all that the fit can move."""

import typing

import numpy as np

from .fitting import sizes
from .likelihood import of

if typing.TYPE_CHECKING:
    from ...effects.effect import Effect
    from .fitting import Fit
    from .whitening import Comparison

SEEN = 3.0  # nats, all trajectories together, with which an effect can be seen


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


def isolability(comparison: "Comparison", current: "Fit", usable: list, chosen: np.ndarray) -> dict:
    """matrix[i, j]: fraction of effect i's signature that effect j cannot mimic, on these trajectories; nats
    that i makes at a realistic size, per trajectory; notes."""
    signatures = Signatures(comparison, current, chosen)
    columns = [signatures.columns(e, e.grid[len(e.grid) // 2]) for e in usable]
    own = [signatures.own(c) for c in columns]
    squares = [c @ o.T for c, o in zip(columns, own)]
    loudest = [int(np.argmax(np.diag(s))) for s in squares]
    size = np.array([max(s[k, k], 1e-30) for s, k in zip(squares, loudest)])
    matrix = np.ones((len(usable), len(usable)))
    for i, (c, k) in enumerate(zip(columns, loudest)):
        for j, (other, square) in enumerate(zip(own, squares)):
            along = other @ c[k]
            matrix[i, j] -= along @ np.linalg.pinv(square, hermitian=True) @ along / size[i]
    unseen = [e.name for e, s in zip(usable, size) if 0.5 * s < SEEN]
    notes = [f"too small to show in these data at a realistic size: {', '.join(unseen)}"] if unseen else []
    return {
        "ids": [e.id for e in usable],
        "matrix": np.clip(matrix, 0.0, 1.0).tolist(),
        "nats": (0.5 * size / len(chosen)).tolist(),
        "notes": notes,
    }
