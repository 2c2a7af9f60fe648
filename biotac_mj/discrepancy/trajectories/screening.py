"""Linearised signatures: what one effect can mimic of another, and the experiment that tells them apart."""

import typing

import numpy as np

from ...effects.catalogue import CATALOGUE
from .fitting import sizes

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
    "stacked",
]

# Friction is no part of it: what it is off by has a name.
STEPS = {"log_modulus": 0.05, "footprint": 0.02, "mesh": 0.2, "tier": 0.2, "log_film": 0.2, "age": 0.2}
STEPS |= {"stands_off": 0.3}
_SEEN = 3.0  # nats, all trajectories together, with which an effect can be seen


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
