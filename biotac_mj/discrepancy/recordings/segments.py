"""The stretches of a checkup's protocol: in each the sensor was touched, or nothing touched it."""

import dataclasses

import numpy as np
from scipy.ndimage import uniform_filter1d

from ...recordings.protocol import STEPS, Protocol
from .candidates import Candidate
from .recording import PlainRecording, enough

_BEGUN = 1.0  # [s] by which a person is late
_TIMES = 6.0  # of the force's noise, where something touches
_AFTER = 0.05  # [s]


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


def sharply_touched(recording: PlainRecording, protocol: Protocol) -> np.ndarray:
    """(n,) bool, rows of steps that ask for sharp touches."""
    some = protocol.rows(_clock(recording), *(kind for kind, step in STEPS.items() if step.sharp))
    out = np.zeros(len(recording), bool)
    out[np.concatenate([[], *some]).astype(int)] = True
    return out


def free_rows(recording: PlainRecording, protocol: Protocol, late: float) -> np.ndarray:
    """(n,) bool, rows in which nothing touches the sensor: by the force, if there is one, from a moment after
    it has ceased, which the electrodes follow `late` [s]; else by the protocol, from a second after a step's
    begin."""
    time, force = _clock(recording), recording.force
    free = np.zeros(len(recording), bool)
    for one in protocol.segments:
        if not STEPS[one.kind].touched:
            free |= (time >= one.start + _BEGUN) & (time < one.stop)
    if force is None or not free.any():
        return free
    unloaded = force[free] - np.median(force[free], 0)
    limit = _TIMES * 1.4826 * np.median(np.abs(unloaded), 0)
    pressed = (np.abs(force - np.median(force[free], 0)) > limit).any(1)
    rows = round((_AFTER + 2 * max(late, 0.0)) * recording.rate)
    return ~(uniform_filter1d(pressed.astype(float), 2 * rows + 1) > 0.5 / (2 * rows + 1))


def moved(finding: Candidate, rows: np.ndarray | slice, recording: PlainRecording) -> Candidate:
    """A finding in some rows as one of the whole recording, which acts in these rows alone."""
    time, shape = recording.time[rows], recording.electrodes.shape
    mask, correct, own = finding.mask, finding.correct, np.arange(len(time)) / recording.rate
    if mask is not None:
        mask = np.zeros(shape, bool)
        mask[rows] = finding.mask

    def without(counts, at):
        counts = counts.copy()
        counts[rows] = correct(counts[rows], own)
        return counts

    start, end, *places = np.interp((finding.start, finding.end, *finding.places), own, time).tolist()
    return dataclasses.replace(
        finding,
        start=start,
        end=end,
        mask=mask,
        correct=None if correct is None else without,
        places=tuple(places),
        trend=None,
    )
