"""Locates the disagreement of a recording and simulated presses: electrodes by phase, load and pitch."""

import numpy as np

from ...matching.fit import Rows
from ..evidence import RATE
from ..report.verdict import electrode_names
from ..where import Cells
from .models import Judged, blocks

_LEADS = 1.3  # times the median electrode's RMS: such electrodes lead
_FEWEST = 8  # rows of a cell


def _conditions(rows, judged):
    """{name: rows (n,) bool} of phases, and of thirds by load and pitch, that have enough rows."""
    rate, thirds = np.gradient(rows.force[:, 2]), ("low", "middle", "high")
    still = np.quantile(np.abs(rate), 1 / 3)
    out = {
        "phase loading": rate > still,
        "phase holding": np.abs(rate) <= still,
        "phase unloading": rate < -still,
    }
    for view, value in (("load", rows.force[:, 2]), ("pitch", judged.state[:, 0])):
        part = np.searchsorted(np.quantile(value, [1 / 3, 2 / 3]), value)
        out |= {f"{view} {name}": part == k for k, name in enumerate(thirds)}
    return {name: where for name, where in out.items() if where.sum() >= _FEWEST}


def press_cells(rows: Rows, judged: Judged, noise: np.ndarray) -> list[dict]:
    """Every electrode under every condition: channel, condition, RMS of the error (counts), what noise and
    the fit's own uncertainty explain of it (expected), family-wise p that it is no more, red where it is;
    these first, the largest error first.

    Args:
      noise: (nelectrode,) of the electrodes [counts].
    """
    expected, square = np.hypot(noise, judged.uncertainty) ** 2, judged.error**2
    conditions, channels = _conditions(rows, judged), electrode_names(range(square.shape[1]))
    parts = blocks(len(rows))
    cells = Cells.of(
        [(square - expected)[b] for b in parts],
        {name: [(where[b], 1.0) for b in parts] for name, where in conditions.items()},
        {name: slice(k, k + 1) for k, name in enumerate(channels)},
    )
    t, p = cells.tested(cells.mean)
    out = [
        {
            "channel": channel,
            "condition": condition,
            "counts": float(np.sqrt(square[where, k].mean())),
            "expected": float(np.sqrt(expected[where, k].mean())),
            "p": float(p[c, k]) if t[c, k] > 0 else 1.0,
        }
        for c, (condition, where) in enumerate(conditions.items())
        for k, channel in enumerate(channels)
    ]
    out = [one | {"red": one["p"] < RATE} for one in out]
    return sorted(out, key=lambda one: (not one["red"], -one["counts"]))


def leading(judged: Judged) -> list[int]:
    """Electrodes that err most, by number from 0, the worst first."""
    rms = np.sqrt((judged.error**2).mean(0))
    order = np.argsort(-rms)
    return [int(k) for k in order if rms[k] > _LEADS * np.median(rms)] or [int(order[0])]


def missing(judged: Judged) -> tuple[np.ndarray, np.ndarray]:
    """Fraction by which the electrodes' changes are too small (nelectrode,), and its standard error over
    blocks: the slope of the residual over the modelled change."""
    parts = [
        (-(judged.error[b] * judged.change[b]).sum(0), (judged.change[b] ** 2).sum(0))
        for b in blocks(len(judged.error))
    ]
    top, bottom = (np.array(x) for x in zip(*parts))
    slope = top.sum(0) / bottom.sum(0)
    left = top - slope * bottom
    n = len(parts)
    return slope, np.sqrt((left**2).sum(0) * n / (n - 1)) / bottom.sum(0)
