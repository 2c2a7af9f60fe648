"""Differences of rows that are fresh, above the band in which the load moves, and where they are calm."""

import numpy as np

from ...session import Session
from ..courses import BLOCKS

__all__ = ["calm_cells", "differences"]


def differences(session: Session, order: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Differences (n, 19) of fresh rows [counts], nan where a sample is masked, and their rows."""
    rows = np.flatnonzero(session.fit & ~session.recording.repeated & ~session.masked.all(1))
    x = np.where(session.masked, np.nan, session.counts)[rows]
    return np.diff(x, n=order, axis=0), rows[order:]


def calm_cells(d: np.ndarray, share: float = 0.5, size: int = 40) -> tuple[np.ndarray, np.ndarray, int]:
    """(windows, size, 19) of differences (n, 19) where all electrodes move least, in each block alike, their
    blocks, and how many these are."""
    k = len(d) // size
    blocks = int(np.clip(k // 5, BLOCKS, 2 * BLOCKS))
    cells = d[: k * size].reshape(k, size, -1)
    known = np.isfinite(cells)
    power = np.where(known, cells**2, 0).sum(1) / np.maximum(known.sum(1), 1)
    level = np.median(power / np.maximum(np.quantile(power, 0.1, axis=0), 0.1), axis=1)
    block = np.arange(k) * blocks // k
    keep = np.zeros(k, bool)
    for b in range(blocks):
        mine = np.flatnonzero(block == b)
        if len(mine):
            keep[mine[level[mine] <= np.quantile(level[mine], share)]] = True
    return cells[keep], block[keep], blocks
