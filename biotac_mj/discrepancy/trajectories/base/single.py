"""Electrodes of which each by itself shows a gain or a drift that the others do not have: nineteen parameters
of which two are needed cost more than they explain."""

import typing

import numpy as np

from ...evidence import signed_root_t
from .leads import told_by

if typing.TYPE_CHECKING:
    from ....effects.effect import Effect
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = ["narrowed"]

_NATS = 1.0  # per trajectory left out, of one electrode
_CHANCE = 0.05
_APART = 5.0  # robust standard deviations of the other electrodes
_MOST = 5  # electrodes: where more have it, all may
_SHARE = 0.1  # of its change, by which what the base model says of an electrode may be off


def narrowed(comparison: "Comparison", fit: "Fit", effect: "Effect", chosen: np.ndarray) -> "Effect":
    """The effect with the electrodes that stand out beside `fit`, or as it is where none or many do, or where
    it is not of single electrodes."""
    if not effect.per_channel or any(e.id in effect.confusable for e, _ in fit.effects):
        return effect  # what the law of one like it lacks stands out, too
    # What a pose may be off by moves all electrodes.
    residual = [r[:, :19] for r in fit.residuals(comparison)]
    parts = zip(comparison.measured, fit.raw(comparison), comparison.sigmas)
    change = [(m - r)[:, :19] / s[:19] for m, r, s in parts]  # what each electrode should have shown
    found = {}
    for course in effect.courses(change, [t.clock + t.time for t in comparison.trajectories]):
        for k, gain in _standing(residual, course, chosen):
            found[k] = max(gain, found.get(k, 0.0))
    return effect.only([f"e{k + 1}" for k in sorted(found)]) if 0 < len(found) <= _MOST else effect


def _standing(residual, course, chosen):
    """[(electrode, nats per trajectory)] whose share of the course is another than the others'."""
    shares, gains = np.zeros(19), []
    for k in range(19):
        x = [course[i][:, k] for i in chosen]
        y = [residual[i][:, k] for i in chosen]
        doubt = [np.sqrt(1 + (_SHARE * b) ** 2) for b in x]
        x, y = ([a / d for a, d in zip(one, doubt)] for one in (x, y))
        held, shares[k] = told_by(y, [b[:, None] for b in x])
        gains.append(held - told_by(y, [0.0 * b[:, None] for b in x])[0])
    away = np.abs(shares - np.median(shares))
    far = away > _APART * 1.4826 * np.median(away)
    return [
        (k, float(g.mean()))
        for k, g in enumerate(gains)
        if far[k] and g.mean() > _NATS and signed_root_t(g) < _CHANCE
    ]
