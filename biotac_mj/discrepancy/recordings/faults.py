"""Faults of the log (`quality`) as findings."""

import numpy as np

from ...quality.fault import Fault
from ...quality.log import Log
from ...recordings.recording import CLOCKED
from .candidates import KINDS, Candidate, Detector
from .recording import PlainRecording

__all__ = ["as_candidates", "as_log"]


def as_log(
    recording: PlainRecording,
    counts: np.ndarray | None = None,
    masked: np.ndarray | None = None,
    rows: np.ndarray | slice = slice(None),
) -> Log:
    """Rows of a recording as a log; counts (n, 19) and samples masked (n, 19) of the whole recording: others
    than its own."""
    counts = recording.electrodes if counts is None else counts
    return Log(
        counts[rows],
        recording.rate,
        recording.rate_source == CLOCKED,
        masked=None if masked is None else masked[rows],
        repeated=recording.repeated[rows],
        missing=None if recording.missing is None else recording.missing[rows],
        other_device=None if recording.force is None else recording.force[rows],
        converter=recording.absolute,
        signed=recording.signed,
    )


def as_candidates(faults: list[Fault]) -> tuple[list[Candidate], list[str]]:
    """Faults as findings, and in words those that no effect of the catalogue is."""
    return [_finding(f) for f in faults if f.id in KINDS], [f.message for f in faults if f.id not in KINDS]


def _finding(fault):
    correct = fault.correct
    return Candidate(
        fault.id,
        fault.channels,
        fault.parameters,
        fault.nats,
        fault.p,
        fault.start,
        fault.end,
        Detector(fault.detector, of_log=True),
        fault.message,
        fault.ties,
        fault.features,
        fault.confidence,
        correct=None if correct is None else lambda counts, time: correct(counts),
        mask=fault.mask,
        beyond=fault.beyond,
        places=fault.places,
    )
