"""A sensor's log as text: 19 columns of electrode counts, and perhaps 3 of force beside it."""

import dataclasses
import pathlib

import numpy as np

from ..sensor.channels import FULL_SCALE

__all__ = ["ELECTRODES", "Recording", "counts_of", "load_counts", "load_recording", "log_impedance"]

ELECTRODES = 19
_SHORTEST = 400  # rows: fewer leave too little for a time split with walk-forward choices


@dataclasses.dataclass(frozen=True)
class Recording:
    """Rows of one log in order of time.

    Attributes:
      counts: (n, 19) raw electrode counts.
      force: (n, 3) [N], or None.
      saturated: (19,) share of rows in which a channel reads 0 or 4095.
    """

    counts: np.ndarray
    force: np.ndarray | None
    saturated: np.ndarray


def load_recording(electrodes, force=None) -> Recording:
    """Reads a log.

    Args:
      electrodes: text file of 19 columns, counts 0..4095 in the order e1..e19, one row per sample, blanks or commas between them.
      force: text file of 3 columns Fx Fy Fz [N], as many rows; None where there is none.

    Raises:
      FileNotFoundError: no such file.
      ValueError: wrong number of columns, text that is no number, NaN, counts that are not 12 bit, lengths that differ, or a log too short.
    """
    counts = _table(electrodes, ELECTRODES, "electrode counts e1..e19")
    low, high = counts.min(0), counts.max(0)
    if (low < 0).any() or (high > FULL_SCALE).any():
        bad = [f"e{i + 1} ({low[i]:g}..{high[i]:g})" for i in np.flatnonzero((low < 0) | (high > FULL_SCALE))]
        raise ValueError(
            f"{electrodes}: counts of {', '.join(bad)} are outside 0..4095: raw 12-bit counts are needed, not tared or scaled ones"
        )
    if not (low < high).any():
        raise ValueError(f"{electrodes}: no channel changes: this is not a recording of a touch")
    if len(counts) < _SHORTEST:
        raise ValueError(f"{electrodes} has {len(counts)} rows: at least {_SHORTEST} are needed for a split in time")
    if force is not None:
        force = _table(force, 3, "forces Fx Fy Fz")
        if len(force) != len(counts):
            raise ValueError(
                f"{electrodes} has {len(counts)} rows and the force file {len(force)}: they must be samples of the same instants"
            )
    return Recording(counts, force, ((counts <= 0) | (counts >= FULL_SCALE)).mean(0))


def load_counts(path):
    """(n, 19) raw counts of a text file as `load_recording` reads it, or of the columns e1..e19 of a CSV with a header.

    Raises:
      FileNotFoundError, ValueError: as `load_recording`; a header without all of e1..e19 is named.
    """
    path = pathlib.Path(path)
    if path.suffix != ".csv":
        return _table(path, ELECTRODES, "electrode counts e1..e19")
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: give readings.csv of `biotac press`, or text of 19 columns")
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    header = [name.strip() for name in lines[0].split(",")] if lines else []
    missing = [f"e{i}" for i in range(1, ELECTRODES + 1) if f"e{i}" not in header]
    if missing:
        raise ValueError(f"{path} has no columns {', '.join(missing)}: its header must name e1..e19")
    columns = [header.index(f"e{i}") for i in range(1, ELECTRODES + 1)]
    try:
        return np.array([[float(row.split(",")[k]) for k in columns] for row in lines[1:]])
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path} has a row that is not numbers in columns e1..e19 ({error})") from error


def log_impedance(counts):
    """ln(Z / 10 kohm) = ln(4095 / E - 1) of counts, any shape; 0 and 4095 are taken as half a count away, so that it stays finite."""
    counts = np.clip(counts, 0.5, FULL_SCALE - 0.5)
    return np.log(FULL_SCALE / counts - 1)


def counts_of(log_impedance):
    """Counts (fractional) of ln(Z / 10 kohm), the inverse of `log_impedance`."""
    return FULL_SCALE / (1 + np.exp(log_impedance))


def _table(path, columns, what):
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: give a text file of {what}")
    rows = [line.replace(",", " ").replace(";", " ").split() for line in path.read_text().splitlines()]
    rows = [(i, row) for i, row in enumerate(rows, start=1) if row and not row[0].startswith(("#", "%"))]
    for i, row in rows:
        if len(row) != columns:
            raise ValueError(f"{path} line {i} has {len(row)} columns: {what} need {columns}")
    if not rows:
        raise ValueError(f"{path} is empty: {what} need {columns} columns")
    try:
        table = np.array([row for _, row in rows], dtype=float)
    except ValueError as error:
        raise ValueError(f"{path} holds text that is no number ({error}): {what} are numbers only, comments begin with #") from error
    if not np.isfinite(table).all():
        i, j = np.argwhere(~np.isfinite(table))[0]
        raise ValueError(f"{path} line {rows[i][0]} column {j + 1} is {table[i, j]}: remove or repair rows that are not finite")
    return table
