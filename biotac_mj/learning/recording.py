"""A sensor's log as text: 19 columns of electrode counts, and perhaps 3 of force beside it."""

import dataclasses
import pathlib

import numpy as np

from ..data.columns import read_columns
from ..sensor.channels import ELECTRODES, FULL_SCALE, check_counts, check_force

__all__ = ["Recording", "load_recording"]

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


def load_recording(electrodes: pathlib.Path | str, force: pathlib.Path | str | None = None) -> Recording:
    """Reads a log.

    Args:
      electrodes: text file of 19 columns, counts 0..4095 of e1..e19, one row per sample (`data.columns`).
      force: text file of 3 columns Fx Fy Fz [N], as many rows; None where there is none.

    Raises:
      FileNotFoundError: no such file.
      ValueError: wrong number of columns, text that is no number, NaN, counts that are not 12 bit, lengths
        that differ, or a log too short.
    """
    counts = read_columns(electrodes, ELECTRODES)
    check_counts(counts, str(electrodes))
    if not np.ptp(counts, axis=0).any():
        raise ValueError(f"{electrodes}: no channel changes: this is not a recording of a touch")
    if len(counts) < _SHORTEST:
        raise ValueError(
            f"{electrodes} has {len(counts)} rows: at least {_SHORTEST} are needed for a split in time"
        )
    if force is not None:
        force = read_columns(force, ("Fx", "Fy", "Fz"))
        if len(force) != len(counts):
            raise ValueError(
                f"{electrodes} has {len(counts)} rows and the force file {len(force)}: "
                "they must be samples of the same instants"
            )
        check_force(force, "the force file")
    return Recording(counts, force, ((counts <= 0) | (counts >= FULL_SCALE)).mean(0))
