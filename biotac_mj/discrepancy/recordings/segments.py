"""The stretches of a checkup's protocol: in each the sensor was touched, or nothing touched it."""

import dataclasses

import numpy as np

from ...recordings.protocol import STEPS, Protocol
from .candidates import Candidate
from .recording import PlainRecording, enough


def stretches(recording: PlainRecording, protocol: Protocol) -> list[tuple[bool, slice]]:
    """Whether something touched the sensor, and rows, of the contiguous stretches in which it did or did not;
    none where all of the recording is one, or where a stretch is too short to be diagnosed."""
    time, found = _clock(recording), []
    for one in protocol.segments:
        touched = STEPS[one.kind].touched
        first, last = np.searchsorted(time, [one.start, one.stop])
        if found and found[-1][0] == touched:
            found[-1] = touched, slice(found[-1][1].start, last)
        else:
            found.append((touched, slice(first, last)))
    if len(found) < 2:
        return []
    return [(touched, rows) for touched, rows in found if enough(rows.stop - rows.start, recording.design)]


def _clock(recording):
    """(n,) [s] since the first row."""
    return recording.time if recording.since is None else recording.since


def moved(finding: Candidate, rows: slice, recording: PlainRecording) -> Candidate:
    """A finding in some rows as one of the whole recording, which acts in these rows alone."""
    begin, shape = recording.time[rows.start], recording.electrodes.shape
    mask, correct = finding.mask, finding.correct
    if mask is not None:
        mask = np.zeros(shape, bool)
        mask[rows] = finding.mask

    def without(counts, time):
        counts = counts.copy()
        counts[rows] = correct(counts[rows], time[rows] - begin)
        return counts

    return dataclasses.replace(
        finding,
        start=finding.start + begin,
        end=finding.end + begin,
        mask=mask,
        correct=None if correct is None else without,
        places=tuple(place + begin for place in finding.places),
        trend=None,
    )
