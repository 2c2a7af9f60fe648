"""Where the residual stands out, and what a remainder that has no name depends on."""

import typing

import numpy as np

from ..where import Cells
from .settings import SETTINGS

if typing.TYPE_CHECKING:
    from .fitting import Fit
    from .trajectory import Trajectory
    from .whitening import Comparison

__all__ = ["channel_groups", "conditions", "depends_on", "phases", "residual_cells", "where"]

TRENDS = "along finger", "across finger", "clock", "temperature"  # over trajectories
_FEWEST = 5  # trajectories that know a cell


def phases(t: "Trajectory") -> dict:
    """Boolean rows of free, approach, hold, slide, unload."""
    speed = np.gradient(t.depth, t.time)
    across = np.linalg.norm(np.gradient(t.pos, t.time, axis=0) - np.outer(speed, t.heading), axis=1)
    touch = t.depth > 20e-6
    limit = 0.1 * max(np.abs(speed).max(), 1e-9)
    slide = touch & (across > np.maximum(limit, np.abs(speed)))
    return {
        "free": ~touch,
        "slide": slide,
        "approach": touch & ~slide & (speed > limit),
        "unload": touch & ~slide & (speed < -limit),
        "hold": touch & ~slide & (np.abs(speed) <= limit),
    }


def conditions(trajectories: "list[Trajectory]") -> dict:
    """name -> per trajectory (boolean rows, weight): phases, load, tool, place, session's clock and
    temperature.

    A weight of 1 asks for the mean residual of the rows, a centred one for its trend over trajectories.
    """
    out = {name: [] for name in ("free", "approach", "hold", "slide", "unload")}
    for t in trajectories:
        for name, rows in phases(t).items():
            out[name].append((rows, 1.0))
    deepest = np.median([t.depth.max() for t in trajectories])
    out["deep"] = [(t.depth > 0.75 * deepest, 1.0) for t in trajectories]
    out["light"] = [((t.depth > 20e-6) & (t.depth < 0.4 * deepest), 1.0) for t in trajectories]
    touch = [t.depth > 20e-6 for t in trajectories]
    tools = sorted({t.tool for t in trajectories})
    for tool in tools if len(tools) > 1 else ():
        out[tool] = [(rows & (t.tool == tool), 1.0) for t, rows in zip(trajectories, touch)]
    place = np.array([t.pos[np.argmax(t.depth)] for t in trajectories])
    trends = [place[:, 0], place[:, 2], [t.clock for t in trajectories]]
    if all(t.tdc is not None for t in trajectories):
        trends.append([float(t.tdc.mean()) for t in trajectories])
    for name, values in zip(TRENDS, trends):
        spread = np.std(values)
        if spread > 0:
            rows = (
                [np.ones(len(t.time), bool) for t in trajectories]
                if name in ("clock", "temperature")
                else touch
            )
            out[name] = list(zip(rows, (values - np.mean(values)) / spread))
    return out


def channel_groups(comparison: "Comparison") -> dict:
    """name -> slice of the residual's columns: every electrode, PDC, force."""
    return {
        **{f"e{k + 1}": slice(k, k + 1) for k in range(comparison.nelectrode)},
        **{k: s for k, s in comparison.groups.items() if k != "electrodes"},
    }


def residual_cells(
    comparison: "Comparison", null: "Fit", chosen: np.ndarray, channels: dict[str, slice]
) -> Cells:
    """Of the residuals of the chosen trajectories over noise and resolution; channels: name -> columns."""
    white = null.posed(comparison)
    asked = conditions([comparison.trajectories[i] for i in chosen])
    return Cells.of([white[i] for i in chosen], asked, channels)


def where(comparison: "Comparison", null: "Fit", chosen: np.ndarray) -> list[dict]:
    """Cells channel x condition that stand out; family-wise p by sign flips of whole trajectories.

    All trajectories share the error of the rest levels, which no flip knows: a mean has to be three times
    that, a trend 0.3 sigma."""
    cells = residual_cells(comparison, null, chosen, channel_groups(comparison))
    t, p = cells.tested(cells.mean * np.sqrt(cells.rows)[:, :, None], _FEWEST)
    trend = np.array([name in TRENDS for name in cells.conditions])
    least = np.where(trend, 0.3, 3 / np.sqrt(len(chosen)))
    out = [
        {
            "channel": cells.channels[k],
            "condition": cells.conditions[c],
            "t": float(t[c, k]),
            "p": float(p[c, k]),
        }
        for c, k in np.argwhere((p < SETTINGS.rate) & (np.abs(cells.overall) > least[:, None]))
    ]
    return sorted(out, key=lambda c: -abs(c["t"]))


def _features(t):
    speed = np.gradient(t.depth, t.time)
    touched = np.cumsum(t.depth > 20e-6) > 0
    since = np.where(touched, t.time - t.time[np.argmax(touched)] if touched.any() else 0, 0)
    return {
        "depth": t.depth / 1e-3,
        "speed": np.sign(speed) * np.log1p(np.abs(speed) / 1e-4),
        "time since contact": np.log1p(since / 0.1),
        "place along the finger": np.full(len(t.time), t.pos[np.argmax(t.depth), 0] / 5e-3),
        "place across": np.full(len(t.time), t.pos[np.argmax(t.depth), 2] / 5e-3),
        "session's clock": np.full(len(t.time), t.clock / 300),
    }


def depends_on(comparison: "Comparison", current: "Fit", chosen: np.ndarray) -> str:
    """What the remainder depends on: held-out share that features explain, and what permuting each of them
    costs."""
    white = current.posed(comparison)
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
    return (
        f"depends on {' and '.join(top) or 'several things together'}, not visibly on {', '.join(rest)}; "
        f"these explain {share:.0%} of it on trajectories left out"
    )


def _explained(x, y, owner):
    i, j = np.triu_indices(x.shape[1])
    a = np.concatenate([np.ones((len(x), 1)), x, x[:, i] * x[:, j]], axis=1)
    error = 0.0
    for f in range(4):
        test = owner % 4 == f
        w = np.linalg.solve(a[~test].T @ a[~test] + 0.02 * len(a) * np.eye(a.shape[1]), a[~test].T @ y[~test])
        error += ((y[test] - a[test] @ w) ** 2).sum()
    return float(1 - error / (y**2).sum())
