"""Which electrodes hear which other one: pairs of leads side by side, as a cable has them.

Found before anything is fitted: all pairs together are three hundred, and what falls off with distance or
goes by the order of sampling is no pair."""

import typing

import numpy as np

from ....effects.sensing import CrossTalk
from ....geometry.electrodes import electrode_positions
from ...evidence import signed_root_t
from ..fitting import fit_effects

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = ["hearing", "told_by"]

_NATS = 1.5  # per trajectory that an electrode has to gain by another one, beside a gain of its own
_CHANCE = 0.05
_LEAST = 0.04  # share
_MOST = 8  # pairs: where more electrodes follow others, it is the skin or the set-up that is another
_ROUNDS = 3
_NEAR = 5.0  # [mm], or sampled one after the other
_RIDGE = 1e-3


def hearing(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> CrossTalk | None:
    """Cross-talk with the pairs that the data show, or None where they show none.

    A pair is taken up if its electrode's change in touch is told by its neighbour's beside its own, on
    trajectories left out, and looked at again with all others in place: one that is loud moves what poses
    are thought to be, and with them all electrodes. Whether the pairs are cross-talk is left to the fit."""
    pairs = {}
    for _ in range(_ROUNDS):
        white, raw = fit.residuals(comparison), fit.raw(comparison)
        residual = [white[i][:, :19] for i in chosen]
        change = [(comparison.measured[i] - raw[i])[:, :19] / comparison.sigmas[i][:19] for i in chosen]
        new = {(i, j): share for i in range(19) for j, share in _heard(i, residual, change, set(pairs))}
        if not new or len(pairs) + len(new) > _MOST:
            break
        # side by side is mutual; what the other hears may look like a gain of its own where both answer alike
        pairs = {(j, i): 0.0 for i, j in new} | pairs | new
        effect = CrossTalk(list(pairs))
        theta = effect.default() | dict(zip(effect.hears, pairs.values()))
        fit = fit_effects(comparison, [(effect, theta)], chosen, fit)
        pairs = {effect.hears[name]: fit.effects[0][1][name] for name in effect.hears}
    pairs = [pair for pair, share in pairs.items() if share > _LEAST]
    return CrossTalk(pairs) if pairs else None


def _heard(i, residual, change, known):
    """[(electrode that electrode i hears best, its share)], or []."""
    y = [r[:, i] for r in residual]
    if _evidence(y).mean() > -_NATS:  # there is no more to gain
        return []
    own, _ = told_by(y, [c[:, [i]] for c in change])
    tried = {j: told_by(y, [c[:, [i, j]] for c in change]) for j in _beside(i) if (i, j) not in known}
    tried = {j: (held - own, share) for j, (held, share) in tried.items() if share > _LEAST}
    if not tried:
        return []
    j = max(tried, key=lambda k: tried[k][0].mean())
    gain, share = tried[j]
    return [(j, share)] if gain.mean() > _NATS and signed_root_t(gain) < _CHANCE else []


def _beside(i):
    at = electrode_positions()
    near = np.linalg.norm(at - at[i], axis=1) < _NEAR
    return [j for j in range(19) if j != i and (near[j] or abs(i - j) == 1)]


def told_by(y: list[np.ndarray], x: list[np.ndarray]) -> tuple[np.ndarray, float]:
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
    return _evidence(left), float(whole[-1])


def _evidence(y):
    """(trajectories,) -(rows / 2) log of mean squares, of what lies beyond noise [nats]."""
    return np.array([-0.5 * len(b) * np.log(max((b**2).mean(), 1.0)) for b in y])
