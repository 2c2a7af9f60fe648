"""A log as arrays."""

import dataclasses
import functools

import numpy as np
from scipy.ndimage import maximum_filter1d

from ..sensor.channels import NELECTRODE
from .adjacent import sharp
from .clock import BUS_RATE
from .repeats import repeated_rows

_LATER = 3  # rows by which one device follows another at most
_TREMBLES = 0.05  # of its standard deviation: what another device changes by when nothing happens


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """n rows of c channels, evenly sampled except for missing rows.

    Attributes:
      counts: (n, c). rate: [Hz]; clocked: whether it comes from the file's times.
      masked: (n, c) bool, samples without a measurement. repeated: (n,) bool, rows that equal the one before.
        Default: none masked; repeats are detected.
      missing: (n,) number of rows missing before each by the file's clock; None: unknown.
      other_device: (n, k) signals logged by another device, such as force, or None.
      read: (n, c) counts before a disturbance was removed; default `counts`.
      in_counts: whether values are counts, whose noise is known. converter: whether they are the converter's
        codes, 0..4095. signed: whether the sign of a channel's response is known.
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

    @property
    def time(self) -> np.ndarray:
        """(n,) [s] from the first row."""
        return np.arange(len(self)) / self.rate

    @functools.cached_property
    def whole(self) -> bool:
        """Whether all counts are whole numbers."""
        return bool((self.counts == np.rint(self.counts)).all())

    @functools.cached_property
    def touched(self) -> np.ndarray:
        """(n,) bool, rows about which the other device changes sharply as well: a touch, no fault of this
        log."""
        if self.other_device is None:
            return np.zeros(len(self), bool)
        force = self.other_device
        changes = sharp(force, _TREMBLES * force.std(0)).any(1)
        return maximum_filter1d(np.pad(changes, (1, 0)), 2 * _LATER + 1)

    def some(self, of_biotac: int) -> int:
        """Number of channels that corresponds to `of_biotac` of a BioTac's 19 electrodes."""
        return of_biotac * self.channels // NELECTRODE

    def without(self, mask: np.ndarray | None, counts: np.ndarray | None = None) -> "Log":
        """The log with further samples (n, c) bool masked and, if given, other counts."""
        masked = self.masked if mask is None else self.masked | mask
        return dataclasses.replace(self, masked=masked, counts=self.counts if counts is None else counts)

    def name(self, channels) -> str:
        """Names of channels, in words."""
        names, most = [f"e{k + 1}" for k in channels], 4
        if len(names) == self.channels > 1:
            return "all electrodes"
        if len(names) > most + 1:
            return f"{', '.join(names[:most])} and {len(names) - most} others"
        return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
