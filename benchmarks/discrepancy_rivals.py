"""Other ways to name what a simulation misses, for the cases of `discrepancy.py` and on the same library.

The library is one block of linearised signatures for each effect of the catalogue, at the shape that fits
best, with what modulus, friction, footprint and mesh can mimic taken out. Rivals:

- least RMS in sample: the effect whose block leaves least. It always names.
- BIC: forward selection over the library, every sample taken as independent.
- sparse regression: sequentially thresholded ridge regression over the library, which is the optimiser of
  PySINDy (Brunton, Proctor and Kutz 2016), here by numpy since pysindy is no dependency; whole blocks are
  thresholded, at the level that trajectories left out like best.
- the way of `mujoco.sysid`: least squares of a fixed list of parameters by its optimiser
  (`mujoco.minimize.least_squares`) with its intervals; the toolbox itself is not imported, since it needs
  packages that are no dependency here. It has no step that chooses between models, so it is given every
  parameter of its kind (SYSID) and names those whose 95 % interval leaves zero out. Effects with memory or
  order, cross-talk, adhesion and loss of liquid are nothing that its parameters and signal modifiers (gain,
  bias, delay) can express: there it does not apply."""

import numpy as np

__all__ = ["SYSID", "cells", "f1", "nuisance_space", "rivals", "stacked"]

SYSID = ("depth0", "misalign", "radius", "mount", "rocking", "friction", "latency", "pdc_gain", "force_cross")
_LEVELS = (0.1, 0.2, 0.4, 0.8, 1.6)  # of realistic sizes, below which sparse regression drops a block
_MOST = 3


# Of the base model's parameters, for differences. Friction is no part of it: what it is off by has a name.
STEPS = {"log_modulus": 0.05, "footprint": 0.02, "mesh": 0.2, "tier": 0.2, "log_film": 0.2, "age": 0.2}
STEPS |= {"stands_off": 0.3}


def columns(comparison, current, effect, shape, base, chosen):
    """(rows, free) signatures of an effect about the present model: secants at a realistic size.

    Args:
      base: (rows of a trajectory,) `Fit.vectors` of the present model, of every trajectory.
    """
    from biotac_mj.discrepancy.trajectories.fitting import sizes

    out = []
    for name, size in sizes(effect):
        theta = {**effect.default(), **shape}
        theta[name] = theta[name] + size
        r = comparison.vectors([*current.effects, (effect, theta)], current.nuisance)
        out.append(stacked(comparison, [b - a for a, b in zip(r, base)], chosen))
    return np.stack(out, axis=1)


def stacked(comparison: object, vectors: list, chosen: np.ndarray) -> np.ndarray:
    """(rows,) of the chosen trajectories one after another, each with as many nats as it has rows."""
    return np.concatenate([vectors[i] * np.sqrt(len(comparison.trajectories[i].time)) for i in chosen])


def nuisance_space(comparison: object, current: object, base: list, chosen: np.ndarray) -> np.ndarray:
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


def _library(comparison, null, chosen):
    """[(effect, shape, block (rows, free))] of the usable catalogue, and y (rows,), both without nuisance."""
    from biotac_mj.effects.catalogue import CATALOGUE

    base = comparison.vectors(null.effects, null.nuisance)
    q = nuisance_space(comparison, null, base, chosen)
    y = stacked(comparison, base, chosen)
    y, out = y - q @ (q.T @ y), []
    there = [comparison.trajectories[i] for i in chosen]
    for effect in CATALOGUE:
        if effect.applicable(there):
            continue
        effect, best = effect.among(there), None
        for shape in effect.grid:
            S = columns(comparison, null, effect, shape, base, chosen)
            S = S - q @ (q.T @ S)
            left = _rss(S, y)
            if best is None or left < best[0]:
                best = left, effect, shape, S
        out.append(best[1:])
    return out, y


def _rss(S, y):
    w, *_ = np.linalg.lstsq(S, y, rcond=None)
    return float(((y - S @ w) ** 2).sum())


def _theta(library, picked, y):
    """[(effect, theta)] of the blocks picked, by least squares in realistic sizes, within bounds."""
    from biotac_mj.discrepancy.trajectories.fitting import sizes

    if not picked:
        return []
    w, *_ = np.linalg.lstsq(np.concatenate([library[k][2] for k in picked], axis=1), y, rcond=None)
    out, at = [], 0
    for k in picked:
        effect, shape, S = library[k]
        theta = {**effect.default(), **shape}
        for (name, size), share in zip(sizes(effect), w[at : at + S.shape[1]]):
            p = effect.params[name]
            theta[name] = float(np.clip(theta[name] + share * size, p.low, p.high))
        out.append((effect, theta))
        at += S.shape[1]
    return out


def _bic(library, y):
    picked, n = [], len(y)

    def score(some):
        S = np.concatenate([library[k][2] for k in some], axis=1) if some else np.zeros((n, 1))
        return n * np.log(_rss(S, y) / n) + (S.shape[1] if some else 0) * np.log(n)

    now = score([])
    while len(picked) < _MOST:
        best = min((score([*picked, k]), k) for k in range(len(library)) if k not in picked)
        if best[0] >= now:
            break
        now, picked = best[0], [*picked, best[1]]
    return picked


def _sparse(library, y, owner):
    """Blocks that survive; owner: (rows,) trajectory of every row."""
    S = np.concatenate([block for *_, block in library], axis=1)
    block = np.concatenate([np.full(b.shape[1], k) for k, (*_, b) in enumerate(library)])

    def regress(rows, level):
        alive = np.arange(len(library))
        for _ in range(10):
            use = np.isin(block, alive)
            A = S[rows][:, use]
            w = np.zeros(S.shape[1])
            w[use] = np.linalg.solve(A.T @ A + 0.01 * np.eye(use.sum()), A.T @ y[rows])
            kept = np.array([k for k in alive if np.abs(w[block == k]).max() > level])
            if len(kept) == len(alive) or not len(kept):
                return kept.astype(int), w if len(kept) else 0 * w
            alive = kept
        return alive, w

    fold = owner % 4
    loss = {
        level: sum(
            float(((y[fold == f] - S[fold == f] @ regress(fold != f, level)[1]) ** 2).sum()) for f in range(4)
        )
        for level in _LEVELS
    }
    loss[None] = float(y @ y)
    level = min(loss, key=loss.get)
    if level is None:
        return []
    kept, w = regress(np.ones(len(y), bool), level)
    size = {int(k): float(((S[:, block == k] @ w[block == k]) ** 2).sum()) for k in kept}
    return sorted(size, key=lambda k: -size[k])


def _sysid(comparison, null, chosen):
    """[(effect, theta)] whose interval leaves zero out, largest first, and ln of the modulus."""
    from mujoco import minimize

    from biotac_mj.discrepancy.trajectories.base.nuisance import Nuisance
    from biotac_mj.effects.catalogue import CATALOGUE

    there = [comparison.trajectories[i] for i in chosen]
    effects = [e.among(there) for e in CATALOGUE if e.id in SYSID and not e.applicable(there)]
    table = [(e, name, e.params[name]) for e in effects for name in e.free]
    # in realistic sizes; a bound at no effect is opened a little, to start inside
    x0 = np.array([p.start / p.scale for *_, p in table] + [null.nuisance.log_modulus])
    low = np.array([min(p.low, p.start - 0.1 * p.scale) / p.scale for *_, p in table] + [-1.5])
    high = np.array([p.high / p.scale for *_, p in table] + [1.5])

    def model(x):
        theta = {e.id: e.default() for e in effects}
        for (e, name, p), value in zip(table, x):
            theta[e.id][name] = float(value * p.scale)
        return [(e, theta[e.id]) for e in effects], Nuisance(log_modulus=float(x[-1]))

    def residual(points):
        columns = [
            stacked(comparison, comparison.vectors(*model(x)), chosen) for x in np.atleast_2d(points.T)
        ]
        return np.stack(columns, axis=1)

    def jacobian(x, r):
        return np.stack(
            [(residual(x + step[:, None]) - r)[:, 0] / 1e-3 for step in 1e-3 * np.eye(len(x0))], axis=1
        )

    found, trace = minimize.least_squares(
        x0, residual, [low, high], jacobian, max_iter=12, verbose=0, x_scale="jac"
    )
    found = np.ravel(found)
    r = residual(found[:, None])
    J = jacobian(found[:, None], r)
    variance = float(np.sum(r**2)) / (len(r) - len(x0))
    half = 1.96 * np.sqrt(variance * np.diag(np.linalg.pinv(J.T @ J)))
    sure = np.abs(found - x0) / np.maximum(half, 1e-12)
    best = {}
    for (e, *_), ratio in zip(table, sure):
        best[e.id] = max(best.get(e.id, 0.0), float(ratio))
    effects, nuisance = model(found)
    named = sorted((e for e in effects if best[e[0].id] > 1), key=lambda e: -best[e[0].id])
    return named, nuisance.log_modulus


def rivals(comparison, chosen) -> dict:
    """name of the rival -> (effects [(Effect, theta)] that it names, ln of its modulus or None)."""
    from biotac_mj.discrepancy.trajectories.fitting import fit_effects

    null = fit_effects(comparison, [], chosen)
    library, y = _library(comparison, null, chosen)
    owner = np.concatenate([np.full(len(comparison.vector(i, comparison.measured[i])), i) for i in chosen])
    picked = {
        "least_rms": [min(range(len(library)), key=lambda k: _rss(library[k][2], y))],
        "bic": _bic(library, y),
        "sparse": _sparse(library, y, owner),
    }
    out = {name: (_theta(library, some, y), None) for name, some in picked.items()}
    out["sysid"] = _sysid(comparison, null, chosen)
    return out


def cells(comparison, chosen, change) -> set:
    """(channel, phase) in which changes (n, width) of trajectories exceed the noise and the model's
    resolution in the root mean square."""
    from biotac_mj.discrepancy.trajectories.where import phases

    out = set()
    parts = {i: phases(comparison.trajectories[i]) for i in chosen}
    for phase in next(iter(parts.values())):
        rows = np.concatenate([(change[i] / comparison.sigma)[parts[i][phase]] for i in chosen])
        if len(rows):
            out |= {(int(k), phase) for k in np.flatnonzero(np.sqrt((rows**2).mean(0)) > 1)}
    return out


def f1(found: set, truth: set) -> float:
    """Harmonic mean of precision and recall; 1 where there is nothing and nothing is found."""
    return 2 * len(found & truth) / (len(found) + len(truth)) if found or truth else 1.0
