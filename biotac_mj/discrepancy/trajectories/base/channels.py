"""Single electrodes that show what the others do not: a gain or a drift of their own, another rest.

Each search gives every electrode a number and looks for those that stand out of the others'. Where many do,
it is the base model or the sensor that is another, and none is named."""

import typing

import numpy as np

from ...evidence import signed_root_t

if typing.TYPE_CHECKING:
    from ....effects.effect import Effect
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = [
    "evidence",
    "narrowed",
    "predicted_by",
    "standing",
    "supported",
]

_ROBUST = 1.4826  # standard deviation of a normal variable by its median absolute deviation
_RIDGE = 1e-3

# Electrodes of which each has a gain or a drift: nineteen parameters of which two are needed cost more than
# they explain.
_OWN = 1.0  # nats per trajectory left out, of one electrode
_OWN_CHANCE = 0.05
_APART = 5.0  # robust standard deviations of the other electrodes
_FEW = 5  # electrodes: where more have it, all may
_OFF = 0.1  # of its change, by which what the base model says of an electrode may be off

# Electrodes that rest elsewhere, which comparisons about the rest leave out.
_FAR = 8.0  # robust standard deviations of the other electrodes, which differ from sensor to sensor
_LEAST = 12.0  # [counts]
_FEW_OFFSETS = 4


def evidence(square: np.ndarray, rows: int) -> np.ndarray:
    """-(rows / 2) log of mean squares, of what lies beyond noise [nats]."""
    return -0.5 * rows * np.log(np.maximum(square, 1.0))


def supported(gain: np.ndarray, nats: float, p: float) -> bool:
    """Whether gains of evidence (trajectories,) are large enough on average, and no chance."""
    return bool(gain.mean() > nats and signed_root_t(gain) < p)


def predicted_by(y: list[np.ndarray], x: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Evidence (trajectories,) of y [(n,)] by x [(n, q)], each by weights from the others [nats]; the last
    weight of all together."""
    squares = np.array([a.T @ a for a in x])
    products = np.array([a.T @ b for a, b in zip(x, y)])
    ridge = (_RIDGE * squares.sum(0).trace() + 1e-12) * np.eye(squares.shape[1])
    left = [
        b - a @ np.linalg.solve(squares.sum(0) - s + ridge, products.sum(0) - p)
        for a, b, s, p in zip(x, y, squares, products)
    ]
    whole = np.linalg.solve(squares.sum(0) + ridge, products.sum(0))
    return np.array([evidence((b**2).mean(), len(b)) for b in left]), float(whole[-1])


def _few(away, most):
    """Electrodes of a mask (nelectrode,); none where there are more than so many."""
    which = np.flatnonzero(away)
    return which if len(which) <= most else which[:0]


def narrowed(comparison: "Comparison", fit: "Fit", effect: "Effect", chosen: np.ndarray) -> "Effect":
    """The effect with the electrodes that stand out beside `fit`, or as it is where none or many do, or where
    it is not of single electrodes."""
    if not effect.per_channel or any(e.id in effect.confusable for e, _ in fit.effects):
        return effect  # what the law of one like it lacks stands out, too
    # What a pose may be off by moves all electrodes.
    n = comparison.nelectrode
    residual = [r[:, :n] for r in fit.posed(comparison)]
    parts = zip(comparison.measured, fit.raw(comparison), comparison.sigmas)
    change = [(m - r)[:, :n] / s[:n] for m, r, s in parts]  # what each electrode should have shown
    found = set()
    for trend in effect.trends(change, [t.clock + t.time for t in comparison.trajectories]):
        found |= _following(residual, trend, chosen)
    return effect.only([f"e{k + 1}" for k in sorted(found)]) if 0 < len(found) <= _FEW else effect


def _following(residual, trend, chosen):
    """Electrodes whose weight on the course is another than the others'."""
    weights, gains = np.zeros(residual[0].shape[1]), []
    for k in range(len(weights)):
        x = [trend[i][:, k] for i in chosen]
        y = [residual[i][:, k] for i in chosen]
        doubt = [np.sqrt(1 + (_OFF * b) ** 2) for b in x]
        x, y = ([a / d for a, d in zip(one, doubt)] for one in (x, y))
        held, weights[k] = predicted_by(y, [b[:, None] for b in x])
        gains.append(held - predicted_by(y, [0.0 * b[:, None] for b in x])[0])
    away = np.abs(weights - np.median(weights))
    far = away > _APART * _ROBUST * np.median(away)
    return {k for k, gain in enumerate(gains) if far[k] and supported(gain, _OWN, _OWN_CHANCE)}


def standing(other: np.ndarray) -> tuple[np.ndarray, float]:
    """Baselines that deviate from the model's, by differences (nelectrode,) about their median [counts]: a
    mask, empty if many do, and the threshold."""
    limit = max(_FAR * _ROBUST * np.median(np.abs(other)), _LEAST)
    return _few(np.abs(other) > limit, _FEW_OFFSETS), limit
