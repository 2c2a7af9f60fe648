"""Plain recordings: raw electrode counts, optionally with force and TDC, one row per sample, read and
checked."""

import dataclasses
import math
import os
import pathlib
from collections.abc import Sequence

import numpy as np

from ...geometry.design import DESIGNS, Design, design_of_channels, read_design
from ...quality.clock import guessed_rate
from ...quality.repeats import repeated_rows
from ...recordings import Recording, load
from ...recordings.importers import choose
from ...recordings.inspection import check_clock, remarks
from ...recordings.recording import rest_correlation
from ...sensor.channels import check_counts, check_force

FORCE_MOVED = 0.02  # [N] standard deviation of the force where something touched
LEAST_RATE = 2.0  # [Hz] rhythms above 0.5 Hz are looked for, and need so many rows
# rows for each electrode: to predict one from all others takes as many coefficients as there are electrodes,
# and each of two parts, fitted and held out, must leave as many degrees of freedom
ROWS_PER_ELECTRODE = 4
_APART = 1.0  # [s] between two series that are put together, as after a clock that starts anew
_SAME_RATE = 0.05  # difference of the rates of series of one logger
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
        that was assumed (`recordings.recording.with_baseline`).
      joints: first rows of further series, where several of one sensor were put together.

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
    joints: tuple[int, ...] = ()

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
        if not enough(len(e), self.design):
            raise ValueError(
                f"{len(e)} rows are too few to fit on one part and check on another: record at least "
                f"{ROWS_PER_ELECTRODE * e.shape[1]} of this {self.design.title}, or give several series of it"
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
        """Whether the electrodes' changes have a sign."""
        return not self.unit.endswith("without sign")

    @property
    def time(self) -> np.ndarray:
        """(n,) [s] from the first row."""
        return np.arange(len(self)) / self.rate

    def part(self, rows: slice) -> "PlainRecording":
        """Some contiguous rows, as a recording."""
        first, last, _ = rows.indices(len(self))
        cut = {
            name: None if value is None else value[rows]
            for name in ("electrodes", "force", "tdc", "missing", "since")
            for value in [getattr(self, name)]
        }
        joints = tuple(k - first for k in self.joints if first < k < last)
        return dataclasses.replace(self, joints=joints, **cut)

    @property
    def tick(self) -> np.ndarray:
        """(n,) number of each row, in which rows that are missing count too."""
        missing = np.zeros(len(self)) if self.missing is None else self.missing.astype(float)
        missing[list(self.joints)] = _APART * self.rate
        return np.arange(len(self)) + np.cumsum(missing)

    @property
    def repeated(self) -> np.ndarray:
        """(n,) bool, rows that only hold the electrodes of the one before (`quality.repeats`)."""
        return repeated_rows(self.electrodes)

    @property
    def rest_correlation(self) -> float:
        """Correlation of the median ln Z with the mean pattern of the published sensors (`REST_LIKE`)."""
        return rest_correlation(self.electrodes)


def enough(rows: int, design: Design) -> bool:
    """Whether so many rows of a sensor can be diagnosed (ROWS_PER_ELECTRODE)."""
    return rows >= ROWS_PER_ELECTRODE * design.nelectrode


def read_recording(
    electrodes: pathlib.Path | str | Sequence,
    force: pathlib.Path | str | None = None,
    tdc: pathlib.Path | str | None = None,
    rate: float | None = None,
    which: str | None = None,
) -> PlainRecording:
    """Reads a recording of any kind that `biotac recording import` knows for `diagnose_recording`.

    Args:
      electrodes: path of it, or of text with a column of counts for each electrode; or paths of several
        series of one sensor.
      force, tdc: paths of text beside it, 3 columns [N] and 1 of raw counts. rate: rows per second [Hz], None
        takes the file's, or guesses (see PlainRecording). which: recording of a file that has several, None
        takes the first, with a warning.

    Raises:
      FileNotFoundError, ValueError: the text names file, line and remedy.
    """
    paths = [electrodes] if isinstance(electrodes, str | os.PathLike) else list(electrodes)
    if len(paths) > 1 and (force or tdc):
        raise ValueError("force and tdc are files beside one recording: put them into each of the series")
    chosen = [choose(load(path, force=force, tdc=tdc, rate=rate), path, which) for path in paths]
    series = [one for one, _ in chosen]
    plain = as_plain(_joined(series))
    plain.joints = tuple(np.cumsum([len(one) for one in series])[:-1].tolist())
    if plain.joints and plain.missing is not None:
        plain.missing[list(plain.joints)] = 0
    notes = [note for _, more in chosen for note in more]
    if others := series[1:]:
        names = ", ".join(one.name for one in others[:4]) + (" ..." if len(others) > 4 else "")
        notes.append(f"{series[0].name}, {names} are taken for series of one sensor: diagnose several apart")
    plain.warnings = (*notes, *plain.warnings)
    return plain


def _joined(series):
    """Electrodes, and the force that all have, of series of one sensor as one recording."""
    first, *others = series
    if not others:
        return first
    kinds = [(one.counts()[0].shape[1], one.unit("electrodes"), one.rate) for one in series]
    for one, kind in zip(series, kinds):
        if kind[:2] != kinds[0][:2] or abs(kind[2] / kinds[0][2] - 1) > _SAME_RATE:
            said = [f"{n} electrodes in {unit} at {rate:.4g} Hz" for n, unit, rate in (kind, kinds[0])]
            raise ValueError(
                f"{one.name} has {said[0]}, {first.name} {said[1]}: give series of one sensor and one logger"
            )
    there = ["electrodes", *(["force"] if all(one.force is not None for one in series) else [])]
    length = [one.time[-1] - one.time[0] + _APART for one in series]
    start = np.cumsum([0.0, *length[:-1]])
    return Recording(
        np.concatenate([one.time - one.time[0] + begin for one, begin in zip(series, start)]),
        **{name: np.concatenate([getattr(one, name) for one in series]) for name in there},
        units={"electrodes": first.unit("electrodes")},
        name=f"{first.name} and {len(others)} more",
        rate_source=first.rate_source,
    )


def as_plain(found: Recording | PlainRecording) -> PlainRecording:
    """A recording without its poses, with notes on its gaps and units; a plain one as it is.

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
    left = (note for note in found.notes if "left out" in note or "taken for dead" in note)
    said = (*remarks(found), *lacks, *(fault.message for fault in faults), *left)
    source = found.rate_source
    since = found.time - begin
    out = PlainRecording(counts, found.force, tdc, found.rate, source, found.name, said, missing, unit, since)
    if not np.ptp(counts, axis=0).any():
        raise ValueError(f"{found.name}: {said[0]}")
    return out


def _with_force(found):
    """Rows of a recording whose force is complete, and notes on the others."""
    if found.force is None or (there := np.isfinite(found.force).all(1)).all():
        return found, []
    edges = np.flatnonzero(np.diff(np.pad(there.astype(int), 1)))
    begin, end = max(zip(edges[::2], edges[1::2]), key=lambda run: run[1] - run[0], default=(0, 0))
    said = f"the force is not there in {(~there).sum()} of {len(there)} rows"
    if end - begin < _MOST_OF * len(there) or not enough(end - begin, found.design):
        return dataclasses.replace(found, force=None), [f"{said}: it took no part"]
    return found.rows(slice(begin, end)), [f"{said}: only rows {begin + 1} to {end} took part"]


def _check_numbers(value, label):
    bad = np.argwhere(~np.isfinite(value))
    if len(bad):
        row, column = bad[0]
        raise ValueError(
            f"{label}: {len(bad)} values are not finite, the first in row {row + 1}, column {column + 1}: a "
            "gap cannot be guessed; cut the recording there or log it again"
        )
