"""Where a recording and the simulation disagree: electrodes by phase, load and pitch."""

import dataclasses

import numpy as np

from ...matching.fit import Rows
from ..evidence import max_t
from .nested import Judged, blocks, noise_of_prediction

__all__ = ["Cell", "cells", "leading", "missing"]

_P = 0.05  # family-wise, over all cells
_LEADS = 1.3  # times the median electrode's RMS: such electrodes lead
_FEWEST = 8  # rows of a cell


@dataclasses.dataclass(frozen=True)
class Cell:
    """Rows of one electrode.

    Attributes:
      channel: number from 0. view, part: "phase" loading, holding, unloading; "load" or "pitch" low, middle,
        high. rms: of the error [counts]; expected: by noise and the fit's own uncertainty [counts]. p:
        family-wise.
    """

    channel: int
    view: str
    part: str
    rms: float
    expected: float
    p: float

    @property
    def red(self) -> bool:
        return self.p < _P


def _views(rows, judged, rate):
    """(view, part, rows (n,) bool)."""
    third = ("low", "middle", "high")
    still = np.quantile(np.abs(rate), 1 / 3)
    yield "phase", "loading", rate > still
    yield "phase", "holding", np.abs(rate) <= still
    yield "phase", "unloading", rate < -still
    for view, value in (("load", rows.force[:, 2]), ("pitch", judged.state[:, 0])):
        part = np.searchsorted(np.quantile(value, [1 / 3, 2 / 3]), value)
        for k, name in enumerate(third):
            yield view, name, part == k


def cells(rows: Rows, judged: Judged, noise: np.ndarray) -> list[Cell]:
    """All cells, red ones first, the largest error first.

    Args:
      noise: (19,) of the electrodes [counts].
    """
    expected = np.hypot(noise, noise_of_prediction(judged))
    excess = judged.error**2 - expected**2
    rate = np.gradient(rows.force[:, 2])
    found, statistic = [], []
    for view, part, where in _views(rows, judged, rate):
        if where.sum() < _FEWEST:
            continue
        parts = [b[where[b]] for b in blocks(len(rows))]
        statistic.append([excess[b].mean(0) if len(b) else np.full(excess.shape[1], np.nan) for b in parts])
        rms = np.sqrt((judged.error[where] ** 2).mean(0))
        floor = np.sqrt((expected[where] ** 2).mean(0))
        found += [(k, view, part, float(rms[k]), float(floor[k])) for k in range(excess.shape[1])]
    t, p = max_t(np.concatenate(statistic, 1))
    out = [Cell(*cell, float(q) if s > 0 else 1.0) for cell, s, q in zip(found, t, p)]
    return sorted(out, key=lambda cell: (not cell.red, -cell.rms))


def leading(judged: Judged) -> list[int]:
    """Electrodes that err most, by number from 0, the worst first."""
    rms = np.sqrt((judged.error**2).mean(0))
    order = np.argsort(-rms)
    return [int(k) for k in order if rms[k] > _LEADS * np.median(rms)] or [int(order[0])]


def missing(judged: Judged) -> tuple[np.ndarray, np.ndarray]:
    """By how much the electrodes' changes are too small (19,), as a share of them, and its standard error
    over blocks: the slope of what is left over what is modelled."""
    parts = [
        (-(judged.error[b] * judged.change[b]).sum(0), (judged.change[b] ** 2).sum(0))
        for b in blocks(len(judged.error))
    ]
    top, bottom = (np.array(x) for x in zip(*parts))
    slope = top.sum(0) / bottom.sum(0)
    left = top - slope * bottom
    n = len(parts)
    return slope, np.sqrt((left**2).sum(0) * n / (n - 1)) / bottom.sum(0)
