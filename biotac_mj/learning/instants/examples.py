"""Rows of electrodes with their targets, from a recording or from a data set."""

import dataclasses
import pathlib

import numpy as np

from ...geometry.design import SINGLES
from ...recordings import Recording
from ...sensor.channels import log_impedance

_BLOCKS = 56  # trajectories of a recording: its rows are correlated in time (docs/lab/learning.md)


@dataclasses.dataclass(frozen=True, eq=False)
class Examples:
    """n rows.

    Attributes:
      counts: (n, nelectrode) raw; tare: (n, nelectrode) at rest. owner: (n,) number of the trajectory.
      targets: "force" (n, 3) [N], "place" (n, 3) [m], if known; NaN in rows without.
      pdc: (n,) change of PDC from rest [counts], None if unknown.
      tared: whether the tare was measured; else absolute ln Z is used. synthetic: not a real sensor.
    """

    counts: np.ndarray
    tare: np.ndarray
    owner: np.ndarray
    targets: dict[str, np.ndarray]
    tared: bool
    source: str
    synthetic: bool
    pdc: np.ndarray | None = None

    @property
    def log_change(self) -> np.ndarray:
        """(n, nelectrode) d ln Z against the tare, or ln Z itself."""
        return log_impedance(self.counts) - (log_impedance(self.tare) if self.tared else 0.0)


def blocks(n: int) -> np.ndarray:
    """(n,) block of each row of a recording, which stands for a trajectory."""
    return np.arange(n) * _BLOCKS // n


def from_recording(recording: Recording, rest: int | None = None) -> Examples:
    """A recording as 56 blocks in order of time, with force and contact position if it has them.

    Args:
      rest: number of first rows whose mean is the sensor at rest; None: not known.

    Raises:
      ValueError: no raw counts, or neither force nor contact position.
    """
    counts, _ = recording.counts()
    found = {"force": recording.force, "place": recording.contact_pos}
    targets = {name: value for name, value in found.items() if value is not None}
    if not targets:
        raise ValueError(
            f"{recording.name} has neither force nor contact place, so that no model can be kept: "
            "give --force"
        )
    tare = np.broadcast_to(counts[:rest].mean(0), counts.shape)
    known = rest is not None
    return Examples(counts, tare, blocks(len(counts)), targets, known, recording.name, False)


def from_set(path: pathlib.Path | str) -> Examples:
    """A data set: measured counts of labelled interactions or, without labels, simulated ones. The first row
    of each is its tare. The force is the skin's on the object, from a measurement if known.

    Raises:
      FileNotFoundError, ValueError: no set, or one without counts.
    """
    from ...data import TactileSet

    with TactileSet(path) as data:
        measured = bool(data.labelled.any())
        name = "measured_counts" if measured else "counts"
        chosen = np.flatnonzero(data.labelled) if measured else np.arange(len(data))
        rows = data.steps(chosen)
        owner, first = data.owner()[rows], np.repeat(data.start, data.stop - data.start)[rows]
        good = (
            data["converged"][rows].astype(bool) if "converged" in data.columns else np.ones(len(rows), bool)
        )
        counts = data[name]
        tare = counts[first][:, : -len(SINGLES)].astype(float)
        targets = {}
        known = [c for c in ("measured_wrench", "wrench") if c in data.columns]
        if known:
            force = data[known[0]][rows][:, :3].astype(float)
            for other in known[1:]:
                force = np.where(np.isfinite(force), force, data[other][rows][:, :3])
            targets["force"] = force
        if "contact_pos" in data.columns:
            targets["place"] = data["contact_pos"][rows].astype(float)
        if not targets:
            raise ValueError(
                f"{path} has neither forces nor contacts: make a set with `biotac data generate`"
            )
        keep = good & (rows != first)  # exclude tare rows
        now = counts[rows][:, : -len(SINGLES)].astype(float)
        pdc = SINGLES.index("pdc") - len(SINGLES)
        pressed = (counts[rows][:, pdc] - counts[first][:, pdc]).astype(float)[keep]
        return Examples(
            now[keep],
            tare[keep],
            owner[keep],
            {k: v[keep] for k, v in targets.items()},
            True,
            str(data.path.name),
            not bool(np.isin(data.kind[chosen], ("recorded", "resimulated")).all()) or not measured,
            pressed if np.isfinite(pressed).all() else None,
        )
