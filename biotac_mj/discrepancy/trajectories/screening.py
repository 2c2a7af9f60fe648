"""Linearised signatures: the screen of the catalogue, what one effect can mimic of another, and the
experiment that tells them apart."""

import typing
from collections.abc import Iterator

import numpy as np

from ...effects.catalogue import CATALOGUE

if typing.TYPE_CHECKING:
    from ...effects.effect import Effect
    from ..report.verdict import Finding
    from .fitting import Fit
    from .whitening import Comparison

__all__ = [
    "STEPS",
    "columns",
    "isolability",
    "next_experiment",
    "nuisance_space",
    "screen",
    "sizes",
    "stacked",
]

# Friction is no part of it: what it is off by has a name.
STEPS = {"log_modulus": 0.05, "footprint": 0.02, "mesh": 0.2, "tier": 0.2, "log_film": 0.2, "age": 0.2}
STEPS |= {"stands_off": 0.3}
_SEEN = 3.0  # nats, all trajectories together, with which an effect can be seen
_RARE = 1.5  # nats per trajectory that rare parameters have to gain: else they cost those that are needed
_RIDGE = 0.01  # of signatures, whose squares are nats


def columns(
    comparison: "Comparison", current: "Fit", effect: "Effect", shape: dict, base: list, chosen: np.ndarray
) -> np.ndarray:
    """(rows, free) signatures of an effect about the present model: secants at a realistic size.

    Args:
      base: (rows of a trajectory,) `Fit.vectors` of the present model, of every trajectory.
    """
    out = []
    for name, size in sizes(effect):
        theta = {**effect.default(), **shape}
        theta[name] = theta[name] + size
        r = comparison.vectors([*current.effects, (effect, theta)], current.nuisance)
        out.append(stacked(comparison, [b - a for a, b in zip(r, base)], chosen))
    return np.stack(out, axis=1)


def stacked(comparison: "Comparison", vectors: list, chosen: np.ndarray) -> np.ndarray:
    """(rows,) of the chosen trajectories one after another, each with as many nats as it has rows."""
    return np.concatenate([vectors[i] * np.sqrt(len(comparison.trajectories[i].time)) for i in chosen])


def sizes(effect: "Effect") -> Iterator[tuple[str, float]]:
    """(name, realistic size) of the free parameters."""
    for name in effect.free:
        p = effect.params[name]
        yield name, (1.0 if p.high > 0 else -1.0) * min(p.scale, 0.5 * max(abs(p.high), abs(p.low)))


def nuisance_space(comparison: "Comparison", current: "Fit", base: list, chosen: np.ndarray) -> np.ndarray:
    """(rows, up to 7) orthonormal: what the nuisance parameters can mimic; those at their bounds can no more.
    A latency of five frames looks like the one frame that a row's electrodes may be late, and more."""
    out = []
    for name, by in STEPS.items():
        if current.nuisance.at_bound(name) or name == "stands_off" and not np.any(comparison.sim.log_rest):
            continue
        r = comparison.vectors(current.effects, current.nuisance.moved(**{name: by}))
        out.append(stacked(comparison, [b - a for a, b in zip(r, base)], chosen))
    if not out:
        return np.zeros((stacked(comparison, base, chosen).size, 0))
    q, r = np.linalg.qr(np.stack(out, axis=1))
    return q[:, np.abs(np.diag(r)) > 1e-9]


def screen(comparison: "Comparison", current: "Fit", effects: list, chosen: np.ndarray) -> list[tuple]:
    """Linearised, cross-validated by trajectory: (mean log c removed, effect, parameters where a fit may
    start), best first. Effects come with those of their rare parameters that pay for themselves."""
    rows = np.mean([len(comparison.trajectories[i].time) for i in chosen])
    base = current.vectors(comparison)
    q = nuisance_space(comparison, current, base, chosen)
    counts = [base[i].size for i in chosen]
    edges = np.concatenate([[0], np.cumsum(counts)])
    weight = np.concatenate(
        [np.full(s, 1 / np.sqrt(max(base[i] @ base[i], 0.5))) for s, i in zip(counts, chosen)]
    )
    y = stacked(comparison, base, chosen) * weight
    q, _ = np.linalg.qr(q * weight[:, None])
    y = y - q @ (q.T @ y)
    folds = np.arange(len(chosen)) % 4
    out = []
    for effect, price in [one for e in effects for one in _variants(e, 2 * _RARE / rows)]:
        for shape in effect.grid:
            S = columns(comparison, current, effect, shape, base, chosen) * weight[:, None]
            S = S - q @ (q.T @ S)
            gain, ridge = [], np.eye(S.shape[1]) * _RIDGE
            for f in range(4):
                train = np.concatenate(
                    [np.arange(a, b) for a, b, g in zip(edges[:-1], edges[1:], folds) if g != f]
                )
                w = np.linalg.solve(S[train].T @ S[train] + ridge, S[train].T @ y[train])
                for a, b, g in zip(edges[:-1], edges[1:], folds):
                    if g == f:
                        gain.append(
                            np.log(max((y[a:b] ** 2).sum(), 1e-9))
                            - np.log(max(((y[a:b] - S[a:b] @ w) ** 2).sum(), 1e-9))
                        )
            w = np.linalg.solve(S.T @ S + ridge, S.T @ y)
            start = {**effect.default(), **shape}
            for (name, size), share in zip(sizes(effect), w):
                p = effect.params[name]
                start[name] = float(
                    np.clip(
                        start[name] + np.clip(share, -3, 3) * size,
                        p.low + 0.01 * p.scale,
                        p.high - 0.01 * p.scale,
                    )
                )
            out.append((float(np.mean(gain)) - price, effect, start))
    best = {}
    for score, effect, start in sorted(out, key=lambda o: -o[0]):
        best.setdefault(effect.id, (score, effect, start))
    return sorted(best.values(), key=lambda o: -o[0])


def _variants(effect, price):
    """The effect as it is mostly, and with its rare parameters, at a price."""
    return [(effect, 0.0), *([(effect.given(list(effect.rare)), price)] if effect.rare else [])]


def isolability(
    comparison: "Comparison", current: "Fit", usable: list, found: list, chosen: np.ndarray
) -> dict:
    """M[i, j]: share of effect i's signature that effect j cannot mimic, on these trajectories; nats that i
    makes at a realistic size."""
    base = current.vectors(comparison)
    q = nuisance_space(comparison, current, base, chosen)
    ids, spaces, size = [], [], []
    for effect in usable:
        shape = effect.grid[len(effect.grid) // 2]
        S = columns(comparison, current, effect, shape, base, chosen)
        S = S - q @ (q.T @ S)
        norms = np.linalg.norm(S, axis=0)
        size.append(0.5 * float(norms.max() ** 2) / len(chosen))
        ids.append(effect.id)
        spaces.append(S)
    n = len(ids)
    M = np.ones((n, n))
    for j in range(n):
        basis, _ = np.linalg.qr(spaces[j] + 1e-12)
        for i in range(n):
            s = spaces[i][:, np.argmax(np.linalg.norm(spaces[i], axis=0))]
            M[i, j] = np.linalg.norm(s - basis @ (basis.T @ s)) ** 2 / max(s @ s, 1e-30)
    unseen = [e.name for e, v in zip(usable, size) if v * len(chosen) < _SEEN]
    notes = [f"too small to show in these data at a realistic size: {', '.join(unseen)}"] if unseen else []
    return {"ids": ids, "matrix": M.tolist(), "nats": size, "notes": notes}


def next_experiment(effects: "list[Finding]", isolability: dict, unknown: bool, tier: str) -> str:
    """What to do next, in words.

    Args:
      effects: Findings, the one that explains most first.
      isolability: see `isolability`.
      unknown: whether something is left that no effect explains.
      tier: of the skin with which the recording was compared.
    """
    pairs = [(e, t) for e in effects for t in e.ties]
    if not pairs:
        pairs = [(e, next((o for o in e.confusable if o in isolability["ids"]), None)) for e in effects[:1]]
    out = []
    if tier == "condensed" and (effects or unknown):
        out.append("compare again with --tier full: what the condensed skin lacks may be taken for an effect")
    for effect, other in pairs[:3]:
        if other is None:
            continue
        text = effect.confusable.get(other) or next(
            (e.confusable.get(effect.id) for e in CATALOGUE if e.id == other), None
        )
        ids, own = isolability["ids"], ""
        if effect.id in ids and other in ids:
            i, j = ids.index(effect.id), ids.index(other)
            share = isolability["matrix"][i][j]
            count = int(np.ceil(_SEEN / max(share * isolability["nats"][i], 1e-3)))
            own = f" (here {share:.0%} of what it does is its own" + (
                f": about {count} trajectories like these are needed)" if count > 1 else ")"
            )
        name = next((e.name for e in CATALOGUE if e.id == other), other)
        how = text or "vary load, speed and hold together less"
        out.append(f"to tell {effect.name} from {name}: {how}{own}")
    if unknown and not effects:
        out.append("repeat some trajectories unchanged: what does not come again is no effect of the sensor")
    return "; ".join(out) or "none needed: nothing is tied, and nothing is left"
