"""Locates the largest residuals, and the remainder without a name."""

import typing

import numpy as np

from ..evidence import max_t
from .settings import SETTINGS

if typing.TYPE_CHECKING:
    from .fitting import Fit
    from .trajectory import Trajectory
    from .whitening import Comparison

TRENDS = "along finger", "across finger", "clock", "temperature"  # over trajectories
_FEWEST = 5  # trajectories with data on a cell
_SAID = 3  # cells that are listed for an unknown effect


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
    each = [phases(t) for t in trajectories]
    out = {name: [(rows[name], 1.0) for rows in each] for name in each[0]}
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


def residual_cells(
    comparison: "Comparison", null: "Fit", chosen: np.ndarray
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Residuals of the chosen trajectories, divided by noise and resolution: names of conditions, number of
    rows (trajectories, conditions), and means over these (trajectories, conditions, channels), nan where
    there are none."""
    white, asked = null.posed(comparison), conditions([comparison.trajectories[i] for i in chosen])
    rows = np.array([[part.sum() for part, _ in parts] for parts in asked.values()]).T
    mean = np.full((*rows.shape, comparison.width), np.nan)
    for c, parts in enumerate(asked.values()):
        for u, (i, (some, weight)) in enumerate(zip(chosen, parts)):
            if some.any():
                mean[u, c] = weight * white[i][some].mean(0)
    return list(asked), rows, mean


def overall(mean: np.ndarray) -> np.ndarray:
    """(conditions, channels) mean (trajectories, conditions, channels) over those that have it, else nan."""
    known = np.isfinite(mean).sum(0)
    return np.where(known, np.nansum(mean, axis=0) / np.maximum(known, 1), np.nan)


def where(comparison: "Comparison", null: "Fit", chosen: np.ndarray) -> list[dict]:
    """Cells channel x condition that stand out; family-wise p by sign flips of whole trajectories.

    All trajectories share the error of the rest levels, which sign flips do not cover: a mean has to be three
    times that, a trend 0.3 sigma."""
    names, rows, mean = residual_cells(comparison, null, chosen)
    statistic, channels = mean * np.sqrt(rows)[:, :, None], comparison.channels
    known = np.isfinite(statistic).sum(0) >= _FEWEST
    t, p = np.full((2, *known.shape), np.nan)
    if known.any():
        t[known], p[known] = max_t(statistic[:, known])
    least = np.where(np.isin(names, TRENDS), 0.3, 3 / np.sqrt(len(chosen)))
    out = [
        {"channel": channels[k], "condition": names[c], "t": float(t[c, k]), "p": float(p[c, k])}
        for c, k in np.argwhere((p < SETTINGS.rate) & (np.abs(overall(mean)) > least[:, None]))
    ]
    return sorted(out, key=lambda c: -abs(c["t"]))


def left_over(comparison: "Comparison", current: "Fit", chosen: np.ndarray) -> str:
    """Line on the largest residuals of a fit."""
    cells = where(comparison, current, chosen)[:_SAID]
    if not cells:
        return "no channel stands out under any condition"
    return "most in " + ", ".join(f"{one['channel']} ({one['condition']})" for one in cells)
