"""Sampling rate, missing rows and faults of the clock, from the times of a log."""

import numpy as np

from .fault import Fault
from .repeats import repeated_rows

# [Hz] refresh rate of each electrode (SynTouch manual); a faster logger repeats rows
BUS_RATE = 100.0
CLOCK_FAULT = "the clock "  # prefix of messages that say that times cannot be trusted
_FINE = 1e-3  # of a step: smallest resolution of a coarse clock
_FEW_STEPS = 4.0  # a longer step is a gap with any clock
_FREQUENT = 0.1  # of the steps
_GUESS = (0.02, 0.98)  # fraction of repeated rows within which a rate can be estimated
# mean distance of steps from whole rows above which missing rows cannot be counted
_TREMBLE = 0.3
# A log is compared in this many segments, if each has so many rows; a clock is faulty if their sampling
# intervals differ by this fraction (with a correct clock they differ by at most 0.0003)
_SEGMENTS, _ROWS, _PACE = 8, 400, 0.1
_CONTINUES = 4.0  # times the usual change between rows, of the median channel


def usual_step(time: np.ndarray) -> tuple[float, float]:
    """Sampling interval [s] and, if the clock is coarse, its resolution [s], else 0.

    With stamps in whole milliseconds no single step equals the interval at 300 Hz, but their mean does. Steps
    that deviate by more than half of it and by more than the resolution are gaps. time: (n,) increasing [s],
    n > 1.
    """
    step = np.diff(time)
    usual = float(np.median(step))
    parts = np.unique(np.rint(step[step < _FEW_STEPS * usual] / (_FINE * usual)))
    tick = float(np.diff(parts).min()) * _FINE * usual if len(parts) > 1 else 0.0
    if tick > 0.75 * usual:  # a step of two ticks is a gap, unless such steps are frequent and regular
        off = np.abs(time - np.linspace(time[0], time[-1], len(time))).max()
        even = (step > 1.5 * usual).mean() > _FREQUENT and off < 1.5 * tick
        return (float(step.mean()), tick) if even else (usual, 0.0)
    for _ in range(2):
        near = np.abs(step - usual) < max(0.5 * usual, tick + _FINE * usual)
        usual = float(step[near].mean())
    return usual, tick


def guessed_rate(*counts: np.ndarray) -> tuple[float, str]:
    """Estimated rate [Hz] of logs (n, c) without times, and the reason in words.

    Args:
      counts: of sensors that were logged together.
    """
    repeated = np.mean([repeated_rows(one).mean() for one in counts]) if counts else 0.0
    if _GUESS[0] < repeated < _GUESS[1]:
        text = f"{repeated:.1%} of the rows repeat the one before: a logger faster than the bus of"
        return BUS_RATE / (1 - repeated), f"{text} {BUS_RATE:g} Hz"
    return BUS_RATE, "assumed: the bus rate"


def missing_rows(time: np.ndarray) -> np.ndarray | None:
    """(n,) number of rows missing before each row. None if the clock jitters by half a row or skips ticks
    evenly. time: (n,) increasing [s]."""
    if len(time) < 2:
        return None
    step = np.diff(time)
    _, tick = usual_step(time)
    least = np.quantile(step, 0.3)  # up to half of the rows may be missing
    near = step < max(1.5 * least, least + 1.01 * tick)
    count = step / step[near].mean()
    if np.quantile(np.abs(count - np.rint(count)), 0.8) > _TREMBLE:
        return None
    # a delayed stamp is followed by a step that is shorter by the same amount
    pair = np.pad(count[1:] + count[:-1], 1, constant_values=np.inf)
    gap = (count > 1.5) & (np.minimum(pair[1:], pair[:-1]) > 2.5)
    missing = np.concatenate([[0], np.where(gap, np.rint(count) - 1, 0)]).astype(int)
    at = np.flatnonzero(missing)
    if len(at) > 2 and missing.max() == 1 and np.ptp(np.diff(at)) <= 1:
        return None
    return missing


def clock_faults(
    time: np.ndarray, counts: np.ndarray | None, complete: bool = True
) -> tuple[np.ndarray | None, list[Fault]]:
    """(n,) number of rows missing before each row, or None if the clock does not show it, and clock faults.

    Args:
      time: (n,) increasing [s]. counts: (n, c), or None: then no gap is taken for a jump of the clock.
      complete: whether times and rows are those of the file; if not, no row counts as missing.
    """
    missing, found = missing_rows(time) if complete else None, []
    if missing is not None and counts is not None:
        missing, found = _clock_jumps(missing, time, counts)
    return missing, found + _pace_fault(time)


def _clock_jumps(missing, time, counts):
    """Missing rows (n,) without jumps of the clock, and a fault for each jump. A gap that is longer than the
    log is a jump if the channels change no more across it than between neighbouring rows."""
    step = np.abs(np.diff(counts, axis=0))
    usual = np.maximum(np.median(step, axis=0), 1.0)
    found = []
    for row in np.flatnonzero(missing > len(counts)):
        if np.median(step[row - 1] / usual) < _CONTINUES:
            missing[row] = 0
            text = (
                f"{CLOCK_FAULT}leaps by {time[row] - time[row - 1]:.4g} s before row {row + 1}, "
                "and the electrodes go on as if no time had passed"
            )
            found.append(Fault("clock", (), time[row - 1] - time[0], time[row] - time[0], text))
    return missing, found


def _pace_fault(time):
    """Fault of a clock whose sampling interval differs between segments of the log."""
    step = np.diff(time)
    if len(step) < _ROWS:
        return []
    pace = []
    for part in np.array_split(step, _SEGMENTS):  # gaps are a separate fault
        middle = np.median(part)
        pace.append(part[(part < 1.5 * middle) & (part > 0.5 * middle)].mean())
    if max(pace) < (1 + _PACE) * min(pace):
        return []
    text = (
        f"{CLOCK_FAULT}changes its pace: rows lie {1e3 * min(pace):.3g} ms apart in one part of the "
        f"recording, {1e3 * max(pace):.3g} ms in another"
    )
    return [Fault("clock", (), 0.0, time[-1] - time[0], text)]
