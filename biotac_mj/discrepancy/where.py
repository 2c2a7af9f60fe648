"""Locates the disagreement of measurement and model: residual of each channel under each condition, in each
unit of evidence (a trajectory, a block of time)."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from .evidence import max_t


@dataclasses.dataclass(frozen=True, eq=False)
class Cells:
    """Means of a residual.

    Attributes:
      conditions, channels: names. rows: (units, conditions) how many a unit has of each. mean: (units,
        conditions, channels) over these, nan where it has none.
    """

    conditions: tuple[str, ...]
    channels: tuple[str, ...]
    rows: np.ndarray
    mean: np.ndarray

    @classmethod
    def of(
        cls,
        units: Sequence[np.ndarray],
        conditions: Mapping[str, Sequence[tuple[np.ndarray, float]]],
        channels: Mapping[str, slice],
    ) -> "Cells":
        """Cells of residuals units (n, width).

        Args:
          conditions: name -> of each unit its rows (n,) bool and the weight of their mean. channels: name ->
            columns.
        """
        rows = np.array([[where.sum() for where, _ in parts] for parts in conditions.values()]).T
        mean = np.full((*rows.shape, len(channels)), np.nan)
        for c, parts in enumerate(conditions.values()):
            for u, (unit, (where, weight)) in enumerate(zip(units, parts)):
                if where.any():
                    mean[u, c] = [weight * unit[where, part].mean() for part in channels.values()]
        return cls(tuple(conditions), tuple(channels), rows, mean)

    @property
    def overall(self) -> np.ndarray:
        """(conditions, channels) mean over the units that have rows, nan where none has."""
        units = (self.rows > 0).sum(0)[:, None]
        return np.where(units, np.nansum(self.mean, axis=0) / np.maximum(units, 1), np.nan)

    def tested(self, statistic: np.ndarray, fewest: int = 2) -> tuple[np.ndarray, np.ndarray]:
        """t and family-wise p (conditions, channels) of a statistic (units, conditions, channels), by flips
        of whole units; nan where fewer units have data."""
        known = np.isfinite(statistic).sum(0) >= fewest
        t, p = np.full((2, *known.shape), np.nan)
        if known.any():
            t[known], p[known] = max_t(statistic[:, known])
        return t, p
