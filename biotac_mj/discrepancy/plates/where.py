"""Locates the disagreement of a recording and simulated presses: electrodes by phase, load and pitch."""

import numpy as np

from ...matching.fit import Rows
from ..evidence import RATE
from ..report.verdict import electrode_names
from ..where import Cells
from .models import Fit

_LEADS = 1.3  # times the median electrode's RMS: such electrodes lead
_FEWEST, _BLOCKS = 8, 16  # rows of a cell; units of time: rows of one press are one piece of evidence


def _blocks(fit):
    return np.array_split(np.arange(len(fit.error)), _BLOCKS)


def _conditions(rows, fit):
    """{name: rows (n,) bool} of phases, and of thirds by load and pitch, that have enough rows."""
    rate, thirds = np.gradient(rows.force[:, 2]), ("low", "middle", "high")
    still = np.quantile(np.abs(rate), 1 / 3)
    out = {
        "phase loading": rate > still,
        "phase holding": np.abs(rate) <= still,
        "phase unloading": rate < -still,
    }
    for view, value in (("load", rows.force[:, 2]), ("pitch", fit.state[:, 0])):
        part = np.searchsorted(np.quantile(value, [1 / 3, 2 / 3]), value)
        out |= {f"{view} {name}": part == k for k, name in enumerate(thirds)}
    return {name: where for name, where in out.items() if where.sum() >= _FEWEST}


def press_cells(rows: Rows, fit: Fit, noise: np.ndarray) -> list[dict]:
    """Every electrode under every condition: channel, condition, RMS of the error (counts), what noise
    explains of it (expected), family-wise p that it is no more, red where it is; these first, the largest
    error first.

    Args:
      noise: (nelectrode,) of the electrodes [counts].
    """
    square, parts = fit.error**2, _blocks(fit)
    conditions, channels = _conditions(rows, fit), electrode_names(range(len(noise)))
    cells = Cells.of(
        [square[b] - noise**2 for b in parts],
        {name: [(where[b], 1.0) for b in parts] for name, where in conditions.items()},
        {name: slice(k, k + 1) for k, name in enumerate(channels)},
    )
    t, p = cells.tested(cells.mean)
    out = [
        {
            "channel": channel,
            "condition": condition,
            "counts": float(np.sqrt(square[where, k].mean())),
            "expected": float(noise[k]),
            "p": float(p[c, k]) if t[c, k] > 0 else 1.0,
        }
        for c, (condition, where) in enumerate(conditions.items())
        for k, channel in enumerate(channels)
    ]
    out = [one | {"red": one["p"] < RATE} for one in out]
    return sorted(out, key=lambda one: (not one["red"], -one["counts"]))


def leading(fit: Fit) -> list[int]:
    """Electrodes that err most, by number from 0, the worst first."""
    rms = np.sqrt((fit.error**2).mean(0))
    order = np.argsort(-rms)
    return [int(k) for k in order if rms[k] > _LEADS * np.median(rms)] or [int(order[0])]


def missing(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Fraction by which the electrodes' changes are too small (nelectrode,), and its standard error over
    blocks: the slope of the residual over the modelled change."""
    parts = [(-(fit.error[b] * fit.change[b]).sum(0), (fit.change[b] ** 2).sum(0)) for b in _blocks(fit)]
    top, bottom = (np.array(x) for x in zip(*parts))
    slope = top.sum(0) / bottom.sum(0)
    left = top - slope * bottom
    n = len(parts)
    return slope, np.sqrt((left**2).sum(0) * n / (n - 1)) / bottom.sum(0)
