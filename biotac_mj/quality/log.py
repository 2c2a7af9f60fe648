"""A log as arrays."""

import dataclasses
import functools

import numpy as np

from ..sensor.channels import NELECTRODE
from .clock import BUS_RATE
from .repeats import repeated_rows

__all__ = ["Log"]


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """n rows of c channels that are evenly sampled but for rows that are missing.

    Attributes:
      counts: (n, c). rate: rows per second [Hz]; clocked: whether the file's own times say so.
      masked: (n, c) bool, samples that are no measurement. repeated: (n,) bool, rows that only hold the one
        before. Both are found or empty where they are not given.
      missing: (n,) number of rows that are missing before each by the file's clock, None: it does not tell.
      other_device: (n, k) what another device logged, as a force, or None.
      read: (n, c) counts before a disturbance was taken out of them; `counts` where they are not given.
      in_counts: whether values are counts, whose noise is known; converter: whether they are the converter's
        own, 0..4095; signed: whether they say which way a channel goes.
    """

    counts: np.ndarray
    rate: float = BUS_RATE
    clocked: bool = False
    masked: np.ndarray | None = None
    repeated: np.ndarray | None = None
    missing: np.ndarray | None = None
    other_device: np.ndarray | None = None
    read: np.ndarray | None = None
    in_counts: bool = True
    converter: bool = True
    signed: bool = True

    def __post_init__(self):
        counts = np.asarray(self.counts, float)
        if counts.ndim != 2 or not counts.size:
            raise ValueError(f"counts have shape {counts.shape}: (n, c) is needed, a row per sample")
        object.__setattr__(self, "counts", counts)
        if self.read is None:
            object.__setattr__(self, "read", counts)
        if self.masked is None:
            object.__setattr__(self, "masked", np.zeros(counts.shape, bool))
        if self.repeated is None:
            object.__setattr__(self, "repeated", repeated_rows(counts))

    def __len__(self):
        return len(self.counts)

    @property
    def channels(self) -> int:
        return self.counts.shape[1]

    @functools.cached_property
    def whole(self) -> bool:
        """Whether all counts are whole numbers."""
        return bool((self.counts == np.rint(self.counts)).all())

    def some(self, of_biotac: int) -> int:
        """So many of c channels as of the electrodes of a BioTac."""
        return of_biotac * self.channels // NELECTRODE

    def without(self, mask: np.ndarray | None, counts: np.ndarray | None = None) -> "Log":
        """The log less samples (n, c) bool that are no measurement, with other counts where given."""
        masked = self.masked if mask is None else self.masked | mask
        return dataclasses.replace(self, masked=masked, counts=self.counts if counts is None else counts)

    def name(self, channels) -> str:
        """Of channels, in words."""
        names, shown = [f"e{k + 1}" for k in channels], 4
        if len(names) == self.channels > 1:
            return "all electrodes"
        if len(names) > shown + 1:
            return f"{', '.join(names[:shown])} and {len(names) - shown} others"
        return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
