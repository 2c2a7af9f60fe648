"""Candidates of a recording: effects of the catalogue with their parameters, and their removal from the
counts."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...effects.catalogue import entries
from ...effects.effect import Entry
from ...quality.fault import Fault
from ...quality.log import Log
from ...recordings.recording import CLOCKED
from ..report.verdict import Gap
from .detectors.trends import Trend
from .recording import PlainRecording

KINDS = {effect.id: effect for effect in (*entries("poses"), *entries("log"))}
_MOST = 12  # electrodes: what more have is of the sensor


@dataclasses.dataclass(eq=False, kw_only=True)
class Candidate(Fault):
    """An effect that the search has found: a fault of the log, or another effect on electrodes, with what the
    search needs to continue. The report has it as a `report.verdict.Finding`.

    Attributes:
      id: of KINDS; ties: ids that the evidence does not separate; p: sign flips of blocks left out.
      of_log: whether it is a fault of the log itself, detected in its own rows and their neighbours.
      sudden: whether it happens between two rows and is detected in them alone: several of one row are one
        event, and held-out rows have no further evidence.
      under_load: whether an electrode was compared with the others while a load moves them.
      delay: [s] by which the electrodes follow the force later.
      trend: of levels over time, or None; fraction: (nelectrode,) of it that each electrode has, None of
        a single one.
      gap: on the held-out rows, None where nothing there measures it; verified: whether they confirm it,
        None where they cannot; written: whether it is in the amended sensor, with which the held-out rows are
        no further off.
    """

    of_log: bool = False
    sudden: bool = False
    under_load: bool = False
    delay: float = 0.0
    trend: Trend | None = None
    fraction: np.ndarray | None = None
    gap: Gap | None = None
    verified: bool | None = None
    written: bool = True

    @property
    def kind(self) -> Entry:
        return KINDS[self.id]

    @property
    def possible(self) -> bool:
        """Whether its parameters lie within the catalogue's bounds."""
        return self.kind.possible(self.parameters)

    @property
    def of_all(self) -> bool:
        """Whether it is of the sensor rather than of some electrodes."""
        return len(self.channels) > _MOST

    @property
    def where(self) -> str:
        """Its electrodes in words, " e3, e4"; nothing where it is of all."""
        return "" if self.of_all else " " + ", ".join(f"e{k + 1}" for k in self.channels[:4])


def as_log(
    recording: PlainRecording,
    counts: np.ndarray | None = None,
    masked: np.ndarray | None = None,
) -> Log:
    """A recording as a log; counts (n, nelectrode) and samples masked (n, nelectrode) of the whole
    recording: others than its own."""
    return Log(
        recording.electrodes if counts is None else counts,
        recording.rate,
        recording.rate_source == CLOCKED,
        masked=masked,
        repeated=recording.repeated,
        missing=recording.missing,
        other_device=recording.force,
        converter=recording.absolute,
        signed=recording.signed,
    )


def as_candidates(faults: Sequence[Fault]) -> tuple[list[Candidate], list[Fault]]:
    """Faults as candidates, and those that no effect of the catalogue is."""
    found = [Candidate(**vars(f), of_log=True) for f in faults if f.id in KINDS]
    return found, [f for f in faults if f.id not in KINDS]
