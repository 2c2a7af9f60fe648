"""Locates the largest residuals, and the remainder without a name."""

import typing

import numpy as np

from ..where import Cells
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
    """Cells of the chosen trajectories' residuals, divided by noise and resolution; channels: name ->
    columns."""
    white = null.posed(comparison)
    asked = conditions([comparison.trajectories[i] for i in chosen])
    return Cells.of([white[i] for i in chosen], asked, channels)


def where(comparison: "Comparison", null: "Fit", chosen: np.ndarray) -> list[dict]:
    """Cells channel x condition that stand out; family-wise p by sign flips of whole trajectories.

    All trajectories share the error of the rest levels, which sign flips do not cover: a mean has to be three
    times that, a trend 0.3 sigma."""
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


def left_over(comparison: "Comparison", current: "Fit", chosen: np.ndarray) -> str:
    """Line on the largest residuals of a fit."""
    cells = where(comparison, current, chosen)[:_SAID]
    if not cells:
        return "no channel stands out under any condition"
    return "most in " + ", ".join(f"{one['channel']} ({one['condition']})" for one in cells)
