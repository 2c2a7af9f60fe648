"""Plain recordings: raw electrode counts, optionally with force and TDC, one row per sample, read and
checked."""

import dataclasses
import math
import pathlib

import numpy as np

from ...geometry.design import DESIGNS, Design, design_of_channels, read_design
from ...quality.clock import guessed_rate
from ...quality.repeats import repeated_rows
from ...recordings import Recording, load
from ...recordings.importers import choose
from ...recordings.inspection import check_clock, doubts
from ...recordings.recording import rest_correlation
from ...sensor.channels import check_counts, check_force

__all__ = ["FORCE_MOVED", "PlainRecording", "as_plain", "read_recording"]

FORCE_MOVED = 0.02  # [N] standard deviation of the force where something touched
LEAST_RATE = 2.0  # [Hz] rhythms above 0.5 Hz are looked for, and need so many rows
MIN_ROWS = 400  # fewer leave no rows to hold out
_MOST_OF = 0.5  # of the rows must have a force, one after another, or it takes no part


@dataclasses.dataclass
class PlainRecording:
    """A recording without poses for diagnosis: electrodes of one sensor, uniformly sampled, as raw
    counts.Attributes have n rows.

    `biotac_mj.recordings.Recording` is the general form, with times, poses, all channels and their units;
    `diagnose_recording` takes either.

    Attributes:
      electrodes: (n, nelectrode) raw counts e1, e2, ...
      force: (n, 3) Fx Fy Fz [N], or None.
      tdc: (n,) raw counts of the thermistor, or None.
      rate: rows per second [Hz]; rate_source: where it comes from.
      name: for the report. warnings: what makes it doubtful, one line each.
      missing: (n,) rows that the file's clock says were dropped before each, or None without a clock.
      since: (n,) [s] of the file's clock since its first row, None without a clock.
      unit: of what was logged, one of `recordings.UNITS`; electrodes that are not "counts" stand on a rest
        that was assumed (`tared.py`).

    Raises:
      ValueError: shapes that differ, numbers that are no counts, or too few rows.
    """

    electrodes: np.ndarray
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None
    rate: float | None = None
    rate_source: str = "given"
    name: str = "recording"
    warnings: tuple[str, ...] = ()
    missing: np.ndarray | None = None
    unit: str = "counts"
    since: np.ndarray | None = None

    @property
    def design(self) -> Design:
        """The fingertip that has so many electrodes."""
        return design_of_channels(self.electrodes.shape[1])

    def __post_init__(self):
        e = self.electrodes = np.asarray(self.electrodes, float)
        if e.ndim != 2 or design_of_channels(e.shape[1]) is None:
            raise ValueError(
                f"electrodes have shape {e.shape}: a column of raw counts for each electrode of "
                f"{' or '.join(read_design(name).title for name in DESIGNS)} is needed, one row per sample"
            )
        _check_numbers(e, "electrodes")
        if len(e) < MIN_ROWS:
            raise ValueError(
                f"{len(e)} rows are too few to fit on one part and check on another: "
                f"record at least {MIN_ROWS} of this {self.design.title}"
            )
        check_counts(e, self.name)
        for label, width in (("force", 3), ("tdc", None)):
            value = getattr(self, label)
            if value is None:
                continue
            value = np.asarray(value, float)
            shape = (len(e), width) if width else (len(e),)
            value = value.reshape(len(value), -1)[:, 0] if width is None else value
            if value.shape != shape:
                raise ValueError(
                    f"{label} has shape {value.shape}, the electrodes have {len(e)} rows: "
                    f"{shape} is needed, row by row"
                )
            _check_numbers(value.reshape(len(e), -1), label)
            setattr(self, label, value)
        if self.missing is not None and np.shape(self.missing) != (len(e),):
            raise ValueError(f"missing has shape {np.shape(self.missing)}: ({len(e)},) is needed, row by row")
        if self.force is not None:
            check_force(self.force, self.name)
        if self.rate is None:
            self.rate, self.rate_source = guessed_rate(e)
        if not LEAST_RATE <= self.rate < math.inf:
            raise ValueError(f"rate is {self.rate:g}: give rows per second, at least {LEAST_RATE:g}")

    def __len__(self):
        return len(self.electrodes)

    @property
    def absolute(self) -> bool:
        """Whether the counts are the converter's own."""
        return self.unit == "counts"

    @property
    def signed(self) -> bool:
        """Whether the electrodes say which way they go."""
        return not self.unit.endswith("without sign")

    @property
    def time(self) -> np.ndarray:
        """(n,) [s] from the first row."""
        return np.arange(len(self)) / self.rate

    def part(self, rows: slice) -> "PlainRecording":
        """Some contiguous rows, as a recording."""
        cut = {
            name: None if value is None else value[rows]
            for name in ("electrodes", "force", "tdc", "missing", "since")
            for value in [getattr(self, name)]
        }
        return dataclasses.replace(self, **cut)

    @property
    def repeated(self) -> np.ndarray:
        """(n,) bool, rows that only hold the electrodes of the one before (`quality.repeats`)."""
        return repeated_rows(self.electrodes)

    @property
    def rest_correlation(self) -> float:
        """Correlation of the median ln Z with the mean pattern of the published sensors (`REST_LIKE`)."""
        return rest_correlation(self.electrodes)


def read_recording(
    electrodes: pathlib.Path | str,
    force: pathlib.Path | str | None = None,
    tdc: pathlib.Path | str | None = None,
    rate: float | None = None,
    which: str | None = None,
) -> PlainRecording:
    """Reads a recording of any kind that `biotac recording import` knows for `diagnose_recording`.

    Args:
      electrodes: path of it, or of text with a column of counts for each electrode.
      force, tdc: paths of text beside it, 3 columns [N] and 1 of raw counts. rate: rows per second [Hz], None
        takes the file's, or guesses (see PlainRecording). which: recording of a file that has several, None
        takes the first, with a warning.

    Raises:
      FileNotFoundError, ValueError: the text names file, line and remedy.
    """
    found, others = choose(load(electrodes, force=force, tdc=tdc, rate=rate), electrodes, which)
    plain = as_plain(found)
    plain.warnings = (*others, *plain.warnings)
    return plain


def as_plain(found: Recording | PlainRecording) -> PlainRecording:
    """A recording without its poses, its gaps and units said in words; a plain one as it is.

    Where the force is not there in some rows, as before its logger began, the longest run of rows that have
    it is taken; where that is less than half of them, all rows are, without force.

    Raises:
      ValueError: no electrodes, or what a PlainRecording refuses. TypeError: no recording.
    """
    if isinstance(found, PlainRecording):
        return found
    if not isinstance(found, Recording):
        raise TypeError(f"recording is {type(found).__name__}: pass a Recording or a PlainRecording")
    begin = found.time[0]
    found, lacks = _with_force(found)
    counts, _ = found.counts()
    unit, tdc = found.unit("electrodes"), found.tdc
    if tdc is not None and found.unit("tdc") != "counts":  # of no temperature
        tdc = None
    missing, faults = check_clock(found, counts)
    left = (note for note in found.notes if "left out" in note)
    said = (*doubts(found), *lacks, *(fault.message for fault in faults), *left)
    source = found.rate_source
    since = found.time - begin
    out = PlainRecording(counts, found.force, tdc, found.rate, source, found.name, said, missing, unit, since)
    if not np.ptp(counts, axis=0).any():
        raise ValueError(f"{found.name}: {said[0]}")
    return out


def _with_force(found):
    """Rows of a recording whose force is whole, and what to say of the others."""
    if found.force is None or (there := np.isfinite(found.force).all(1)).all():
        return found, []
    edges = np.flatnonzero(np.diff(np.pad(there.astype(int), 1)))
    begin, end = max(zip(edges[::2], edges[1::2]), key=lambda run: run[1] - run[0], default=(0, 0))
    said = f"the force is not there in {(~there).sum()} of {len(there)} rows"
    if end - begin < max(MIN_ROWS, _MOST_OF * len(there)):
        return dataclasses.replace(found, force=None), [f"{said}: it took no part"]
    return found.rows(slice(begin, end)), [f"{said}: only rows {begin + 1} to {end} took part"]


def _check_numbers(value, label):
    bad = np.argwhere(~np.isfinite(value))
    if len(bad):
        row, column = bad[0]
        raise ValueError(
            f"{label}: {len(bad)} values are not finite, the first in row {row + 1}, column {column + 1}: a "
            "gap cannot be guessed; "
            "cut the recording there or log it again"
        )
