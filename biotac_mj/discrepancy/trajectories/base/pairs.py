"""Pairs of electrodes that are exchanged, or that have cross-talk.

They are found before anything is fitted, since no small change leads from one wiring to another. There are
three hundred pairs of leads; only neighbours, in place or in the order of sampling, are tried for
cross-talk."""

import typing

import numpy as np
from scipy.optimize import linear_sum_assignment

from ....effects.electrodes import Exchange
from ....effects.sensing import CrossTalk
from ....geometry.design import electrode_positions
from ...evidence import signed_root_t
from ..fitting import fit_effects

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

_SWAPPED = 3.0  # nats per trajectory that each electrode has to gain in another's place
_SWAP_CHANCE = 0.01  # of all electrodes of a ring together

_GAIN = 1.5  # nats per trajectory by which another electrode has to explain more than a gain of its own
_GAIN_CHANCE = 0.05
_LEAST = 0.04  # fraction of the other electrode's change
_MOST = 8  # pairs: more are a sign of another skin or set-up
_ROUNDS = 3
_NEAR = 5.0  # [mm], or sampled one after the other
_RIDGE = 1e-3


def exchanged(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> Exchange | None:
    """Electrodes that another one's prediction fits better, by their changes in touch, or None.

    What stands still is no evidence: rests are compared with nothing here."""
    predicted = [m - r for m, r in zip(comparison.measured, fit.raw(comparison))]
    # (chosen, nelectrode, nelectrode) evidence of electrode i read as j says
    fits = np.array([_in_place_of(comparison, i, predicted[i]) for i in chosen])
    _, reads = linear_sum_assignment(-fits.mean(0))
    row = np.arange(len(reads))
    gain = fits[:, row, reads] - fits[:, row, row]
    # A contact that changes one electrode little is still evidence on the others in its ring.
    moved = []
    for ring in _rings(reads):
        if gain[:, ring].mean(0).min() > _SWAPPED and signed_root_t(gain[:, ring].sum(1)) < _SWAP_CHANCE:
            moved += [(i, int(reads[i])) for i in ring]
    return Exchange(sorted(moved)).on(comparison.sim.design) if moved else None


def _rings(reads):
    """Lists of electrodes, each of which reads the next one: the cycles of a permutation."""
    left, out = set(np.flatnonzero(reads != np.arange(len(reads))).tolist()), []
    while left:
        ring = [left.pop()]
        while int(reads[ring[-1]]) in left:
            ring.append(int(reads[ring[-1]]))
            left.remove(ring[-1])
        out.append(ring)
    return out


def _in_place_of(comparison, i, predicted):
    """(nelectrode, nelectrode) evidence of measured electrode a by prediction b, both about their first
    row: what the session's clock does is no wiring."""
    n = comparison.nelectrode
    measured = comparison.measured[i][:, :n]
    measured, predicted = measured - measured[:1], predicted[:, :n] - predicted[:1, :n]
    square = ((measured[:, :, None] - predicted[:, None]) ** 2).mean(0) / comparison.sigma[:n, None] ** 2
    return _evidence(square, len(measured))


def cross_talk(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> CrossTalk | None:
    """Cross-talk with the pairs that the data show, or None where they show none.

    A pair is added if, on held-out trajectories, the neighbour's change in touch predicts the electrode's
    residual better than its own change alone. It is tested again with all other pairs in the model, since a
    strong pair shifts the estimated poses and thereby all electrodes. The fit decides whether the pairs are
    cross-talk."""
    pairs, design = {}, comparison.sim.design
    n = design.nelectrode
    for _ in range(_ROUNDS):
        white, raw = fit.posed(comparison), fit.raw(comparison)
        residual = [white[i][:, :n] for i in chosen]
        change = [(comparison.measured[i] - raw[i])[:, :n] / comparison.sigmas[i][:n] for i in chosen]
        new = {
            (i, j): fraction
            for i in range(n)
            for j, fraction in _best_source(i, residual, change, set(pairs), design)
        }
        if not new or len(pairs) + len(new) > _MOST:
            break
        # neighbours couple in both directions; the reverse one looks like a gain where both respond alike
        pairs = {(j, i): 0.0 for i, j in new} | pairs | new
        effect = CrossTalk(list(pairs)).on(design)
        theta = effect.default() | dict(zip(effect.hears, pairs.values()))
        fit = fit_effects(comparison, [(effect, theta)], chosen, fit)
        pairs = {effect.hears[name]: fit.effects[0][1][name] for name in effect.hears}
    pairs = [pair for pair, fraction in pairs.items() if fraction > _LEAST]
    return CrossTalk(pairs).on(design) if pairs else None


def _best_source(i, residual, change, known, design):
    """[(electrode that explains electrode i best, the fraction of its change)], or []."""
    y = [r[:, i] for r in residual]
    if np.mean([_evidence((b**2).mean(), len(b)) for b in y]) > -_GAIN:  # there is no more to gain
        return []
    own, _ = _predicted_by(y, [c[:, [i]] for c in change])
    tried = {
        j: _predicted_by(y, [c[:, [i, j]] for c in change])
        for j in _neighbours(i, design)
        if (i, j) not in known
    }
    tried = {j: (held - own, fraction) for j, (held, fraction) in tried.items() if fraction > _LEAST}
    if not tried:
        return []
    j = max(tried, key=lambda k: tried[k][0].mean())
    gain, fraction = tried[j]
    return [(j, fraction)] if _supported(gain, _GAIN, _GAIN_CHANCE) else []


def _neighbours(i, design):
    at = electrode_positions(design)
    near = np.linalg.norm(at - at[i], axis=1) < _NEAR
    return [j for j in range(len(at)) if j != i and (near[j] or abs(i - j) == 1)]


def _evidence(square: np.ndarray, rows: int) -> np.ndarray:
    """-(rows / 2) log of mean squares, of what lies beyond noise [nats]."""
    return -0.5 * rows * np.log(np.maximum(square, 1.0))


def _supported(gain: np.ndarray, nats: float, p: float) -> bool:
    """Whether gains of evidence (trajectories,) are large enough on average, and no chance."""
    return bool(gain.mean() > nats and signed_root_t(gain) < p)


def _predicted_by(y: list[np.ndarray], x: list[np.ndarray]) -> tuple[np.ndarray, float]:
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
    return np.array([_evidence((b**2).mean(), len(b)) for b in left]), float(whole[-1])
