"""What the times of a log say: its rate, rows that are missing, and where the clock cannot be right."""

import numpy as np

from .fault import Fault
from .repeats import repeated_rows

__all__ = ["BUS_RATE", "CLOCK_FAULT", "clock_faults", "guessed_rate", "missing_rows", "usual_step"]

# [Hz] at which a BioTac refreshes each electrode (SynTouch manual); a faster logger repeats rows
BUS_RATE = 100.0
CLOCK_FAULT = "the clock "  # messages that begin with this say that times cannot be trusted
_FINE = 1e-3  # of a step: a tick is coarser
_FEW_STEPS = 4.0  # beyond which a step is a gap, whatever the clock
_FREQUENT = 0.1  # of the steps
_GUESS = (0.02, 0.98)  # fraction of repeated rows from which a rate can be guessed
# a clock whose steps are farther than this fraction of a row from whole rows cannot count missing rows
_TREMBLE = 0.3
# parts of a log, rows from which on they are compared, and fraction by which the rows of one lie farther
# apart than those of another: 0.0003 at most where the clock is true
_PARTS, _ROWS, _PACE = 8, 400, 0.1
_GOES_ON = 4.0  # times the usual change from row to row, of the median channel


def usual_step(time: np.ndarray) -> tuple[float, float]:
    """Seconds from a row to the next, and of the clock's tick where it is coarse, else 0.

    Of stamps in whole milliseconds no single step is the rows' own at 300 Hz, their mean is. Steps that are
    off by half of it and by more than a tick are gaps. time: (n,) increasing [s], n at least 2.
    """
    step = np.diff(time)
    usual = float(np.median(step))
    parts = np.unique(np.rint(step[step < _FEW_STEPS * usual] / (_FINE * usual)))
    tick = float(np.diff(parts).min()) * _FINE * usual if len(parts) > 1 else 0.0
    if tick > 0.75 * usual:  # a step of two ticks is a gap, unless such steps are frequent and even
        off = np.abs(time - np.linspace(time[0], time[-1], len(time))).max()
        even = (step > 1.5 * usual).mean() > _FREQUENT and off < 1.5 * tick
        return (float(step.mean()), tick) if even else (usual, 0.0)
    for _ in range(2):
        near = np.abs(step - usual) < max(0.5 * usual, tick + _FINE * usual)
        usual = float(step[near].mean())
    return usual, tick


def guessed_rate(*counts: np.ndarray) -> tuple[float, str]:
    """Rows per second [Hz] of logs (n, c) without times, and the reason in words.

    Args:
      counts: of sensors that were logged together.
    """
    repeated = np.mean([repeated_rows(one).mean() for one in counts]) if counts else 0.0
    if _GUESS[0] < repeated < _GUESS[1]:
        text = f"{repeated:.1%} of the rows repeat the one before: a logger faster than the bus of"
        return BUS_RATE / (1 - repeated), f"{text} {BUS_RATE:g} Hz"
    return BUS_RATE, "assumed: the bus rate"


def missing_rows(time: np.ndarray) -> np.ndarray | None:
    """(n,) number of rows that are missing before each, or None where the clock trembles by half a row, or is
    so coarse that it skips one evenly. time: (n,) increasing [s]."""
    if len(time) < 2:
        return None
    step = np.diff(time)
    _, tick = usual_step(time)
    least = np.quantile(step, 0.3)  # half of the rows may be gone
    near = step < max(1.5 * least, least + 1.01 * tick)
    count = step / step[near].mean()
    if np.quantile(np.abs(count - np.rint(count)), 0.8) > _TREMBLE:
        return None
    # a stamp that comes late is followed by a step as much shorter
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
    """Rows that are missing (n,) before each, or None where the clock does not tell, and faults of the clock.

    Args:
      time: (n,) increasing [s]. counts: (n, c), or None: then no gap is taken for a leap of the clock.
      complete: whether times and rows are as the file has them; else none is missing by its clock.
    """
    missing, found = missing_rows(time) if complete else None, []
    if missing is not None and counts is not None:
        missing, found = _leaps(missing, time, counts)
    return missing, found + _paces(time)


def _leaps(missing, time, counts):
    """Rows that are missing (n,) without gaps longer than the log across which the channels go on as from row
    to row: there the clock leaps."""
    step = np.abs(np.diff(counts, axis=0))
    usual = np.maximum(np.median(step, axis=0), 1.0)
    found = []
    for row in np.flatnonzero(missing > len(counts)):
        if np.median(step[row - 1] / usual) < _GOES_ON:
            missing[row] = 0
            text = (
                f"{CLOCK_FAULT}leaps by {time[row] - time[row - 1]:.4g} s before row {row + 1}, "
                "and the electrodes go on as if no time had passed"
            )
            found.append(Fault("clock", (), time[row - 1] - time[0], time[row] - time[0], text))
    return missing, found


def _paces(time):
    """A clock of which rows lie farther apart in one part of the log than in another."""
    step = np.diff(time)
    if len(step) < _ROWS:
        return []
    pace = []
    for part in np.array_split(step, _PARTS):  # gaps are another fault
        middle = np.median(part)
        pace.append(part[(part < 1.5 * middle) & (part > 0.5 * middle)].mean())
    if max(pace) < (1 + _PACE) * min(pace):
        return []
    text = (
        f"{CLOCK_FAULT}changes its pace: rows lie {1e3 * min(pace):.3g} ms apart in one part of the "
        f"recording, {1e3 * max(pace):.3g} ms in another"
    )
    return [Fault("clock", (), 0.0, time[-1] - time[0], text)]
