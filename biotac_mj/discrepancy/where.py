"""Where the residual stands out, and what a remainder that has no name depends on."""

import numpy as np

from .evidence import max_t

__all__ = ["depends_on", "phases", "where"]


def phases(t) -> dict:
    """Boolean rows of free, approach, hold, slide, unload."""
    speed = np.gradient(t.depth, t.time)
    across = np.linalg.norm(np.gradient(t.pos, t.time, axis=0) - np.outer(speed, t.heading), axis=1)
    touch = t.depth > 20e-6
    limit = 0.1 * max(np.abs(speed).max(), 1e-9)
    slide = touch & (across > np.maximum(limit, np.abs(speed)))
    return {
        "free": ~touch, "slide": slide, "approach": touch & ~slide & (speed > limit), "unload": touch & ~slide & (speed < -limit),
        "hold": touch & ~slide & (np.abs(speed) <= limit),
    }  # fmt: skip


def where(comparison, null, chosen):
    """Cells channel group x phase and x depth, tool, time; family-wise p by sign flips of whole trajectories."""
    white = null.residuals(comparison)
    cells, names = [], []
    channels = {**{f"e{k + 1}": slice(k, k + 1) for k in range(19)}, **{k: s for k, s in comparison.groups.items() if k != "electrodes"}}
    for name, part in channels.items():
        for phase in ("free", "approach", "hold", "slide", "unload"):
            column = []
            for i in chosen:
                rows = phases(comparison.trajectories[i])[phase]
                x = white[i][rows][:, part]
                column.append(x.mean() * np.sqrt(len(x)) if x.size else np.nan)
            if np.isfinite(column).sum() >= 5:
                cells.append(column)
                names.append((name, phase))
    if not cells:
        return []
    t, p = max_t(np.array(cells).T)
    out = [{"channel": n[0], "phase": n[1], "t": float(a), "p": float(b)} for n, a, b in zip(names, t, p) if b < 0.05]
    return sorted(out, key=lambda c: -abs(c["t"]))


def _features(t):
    speed = np.gradient(t.depth, t.time)
    touched = np.cumsum(t.depth > 20e-6) > 0
    since = np.where(touched, t.time - t.time[np.argmax(touched)] if touched.any() else 0, 0)
    return {
        "depth": t.depth / 1e-3, "speed": np.sign(speed) * np.log1p(np.abs(speed) / 1e-4), "time since contact": np.log1p(since / 0.1),
        "place along the finger": np.full(len(t.time), t.pos[np.argmax(t.depth), 0] / 5e-3),
        "place across": np.full(len(t.time), t.pos[np.argmax(t.depth), 2] / 5e-3), "session's clock": np.full(len(t.time), t.clock / 300),
    }  # fmt: skip


def depends_on(comparison, current, chosen):
    """What the remainder depends on: held-out share that features explain, and what permuting each of them costs."""
    white = current.residuals(comparison)
    y = np.concatenate([white[i] for i in chosen])
    u, s, vt = np.linalg.svd(y, full_matrices=False)
    y = u[:, :3] * s[:3]
    owner = np.concatenate([np.full(len(white[i]), k) for k, i in enumerate(chosen)])
    table = [_features(comparison.trajectories[i]) for i in chosen]
    names = list(table[0])
    x = np.stack([np.concatenate([f[n] for f in table]) for n in names], axis=1)
    x = (x - x.mean(0)) / np.maximum(x.std(0), 1e-9)
    share = _explained(x, y, owner)
    if share < 0.1:
        return f"nothing that was looked at explains it on trajectories left out ({max(share, 0):.0%})"
    loss = {n: share - _explained(np.delete(x, k, axis=1), y, owner) for k, n in enumerate(names)}
    top = [n for n, v in sorted(loss.items(), key=lambda kv: -kv[1]) if v > 0.05 * share][:2]
    rest = [n for n in names if n not in top]
    return f"depends on {' and '.join(top) or 'several things together'}, not visibly on {', '.join(rest)}; these explain {share:.0%} of it on trajectories left out"  # noqa: E501


def _explained(x, y, owner):
    i, j = np.triu_indices(x.shape[1])
    a = np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j]], axis=1)
    error = 0.0
    for f in range(4):
        test = owner % 4 == f
        w = np.linalg.solve(a[~test].T @ a[~test] + 0.02 * len(a) * np.eye(a.shape[1]), a[~test].T @ y[~test])
        error += ((y[test] - a[test] @ w) ** 2).sum()
    return float(1 - error / (y**2).sum())
