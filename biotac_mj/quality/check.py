"""Finds all faults of a log, each once."""

import typing
from collections.abc import Sequence

from .again import logged_twice
from .codes import coarse, put_back
from .confidence import clear, confidence
from .fault import Fault
from .lines import hum
from .log import Log
from .lost import dropped, jumping, unmeasured
from .noise import noisy
from .sample_hold import sample_and_hold
from .spikes import off_rows, spikes
from .stuck import dead, stuck_or_clipped

_LEAST = 200  # rows: sixteen blocks of twelve; fewer do not show the noise


class Checked(typing.NamedTuple):
    """A log after the checks: `log` with lost upper bits restored, its `faults`, and `weak` candidates whose
    evidence is too little to report."""

    log: Log
    faults: list[Fault]
    weak: list[Fault]


def check(log: Log) -> Checked:
    """Finds all faults of a log."""
    checked = sample_faults(log)
    found = lost_rows(less(checked.log, checked.faults), checked.faults)
    for fault in found:
        fault.confidence = confidence(fault)
    return Checked(
        checked.log,
        [*checked.faults, *(f for f in found if clear(f))],
        [*checked.weak, *(f for f in found if not clear(f))],
    )


def sample_faults(log: Log) -> Checked:
    """Finds faults of samples: dead, coarse, repeated, stuck, clipped and spiked ones, rows logged twice,
    words that overflow, hum, noise.

    Each detector ignores the samples that the detectors before it rejected.
    """
    nothing = (log.counts == log.counts[0]).all()  # nothing was measured, so there is no fault
    if len(log) < _LEAST or not log.in_counts or nothing:
        return Checked(log, dead(log), [])
    log, faults = put_back(log)
    weak = []
    of_rows = (off_rows, unmeasured, coarse, dead, sample_and_hold, logged_twice)
    for find in (*of_rows, hum, stuck_or_clipped, spikes, noisy):
        for fault in find(less(log, faults), faults):
            fault.confidence = confidence(fault, _others_of_detector(fault, faults + weak))
            (faults if clear(fault) else weak).append(fault)
    for fault in faults:  # before all that was found after it
        fault.confidence = confidence(fault, _others_of_detector(fault, faults + weak))
    weak += [f for f in faults if not clear(f)]
    faults = [f for f in faults if clear(f)]
    return Checked(log, faults, weak)


def lost_rows(log: Log, faults: Sequence[Fault], begun: tuple[float, ...] = ()) -> list[Fault]:
    """Finds missing rows, by the clock if it is reliable, else by jumps of all channels (`jumping`)."""
    return dropped(log) or jumping(log, faults, begun)


def less(log: Log, faults: Sequence[Fault]) -> Log:
    """The log with correctable faults corrected and invalid samples masked."""
    for fault in faults:
        log = log.without(fault.mask, None if fault.correct is None else fault.correct(log.counts, log.time))
    return log


def _others_of_detector(fault, others):
    """Number of other candidates of the same detector."""
    return sum(f is not fault and f.detector == fault.detector for f in others)
