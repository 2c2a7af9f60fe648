"""Rows that are missing: by the log's own clock, where all channels jump from one row to the next, or since
nothing was measured in them."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import percentile_filter, uniform_filter1d
from scipy.signal import find_peaks

from ..sensor.channels import FULL_SCALE
from .codes import mostly_coarse
from .evidence import BLOCKS, NAN, evidence, runs
from .fault import Fault
from .log import Log
from .noise import noise_level

__all__ = ["dropped", "jumping", "unmeasured"]

_MOST = 12  # channels of 19 that no load takes to an end of the converter at once
_NEVER = 1e-5  # fraction of rows in which that is chance
_FEW = 4  # channels of 19 that may jump for reasons of their own
_BEGUN = 2.0  # [s] within which it is known when an effect on all channels begins
_CHANCE = 12.0  # nats: one in 1e5
_WINDOW = 12  # rows in which a channel without noise is told from one with it
_LEAST = 200  # rows
# of places where rows may be lost, and times what else was logged does elsewhere that it does there: 5 and
# more where a logger lost rows, 0.9 at most where electrodes alone jump
_PLAINEST, _LEAPS = 3, 2.5
_END, _MEETS = 4, 2.0  # rows at either end, and their distance in noises where they meet
_LINE = 4  # rows of the lines on either side
# score of a jump, times those around it, and rows that jumps lie apart
_SCORE, _TIMES, _APART = 4.0, 3.0, 13
# [s] of a bin and of a window; windows that are left out, since a step is no load; counts by which the six
# liveliest of 19 change within windows where something is touched
_BIN, _SPAN, _LIVELIEST, _MOVED = 0.1, 3.0, 0.04, 6.0


def dropped(log: Log) -> list[Fault]:
    """Rows that the file's own clock says are missing."""
    if log.missing is None or not log.missing.any():
        return []
    at, lost = np.flatnonzero(log.missing), int(log.missing.sum())
    longest = at[np.argmax(log.missing[at])]
    found = _lost(
        log,
        at,
        f"clock: {len(at)} gap{'s' * (len(at) > 1)}, the longest of {log.missing[longest]} rows before row "
        f"{longest + 1}; about {lost} rows were dropped ({lost / (lost + len(log)):.1%})",
        np.full(len(at), _CHANCE),
    )
    found.parameters = {"seconds": (lost / log.rate, NAN, NAN)}
    found.detector, found.p = "clock", float(np.exp(-_CHANCE))
    return [found]


def unmeasured(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Rows in which most channels read an end of the converter: a sensor without power, a plug that is out,
    a message that was not filled in."""
    gone = (np.isin(log.counts, (0, FULL_SCALE)) & ~log.masked).sum(1) >= max(2, log.some(_MOST))
    if not log.converter or not gone.any() or gone.all():
        return []
    start, length = runs(gone)
    seconds = float(gone.sum() / log.rate)
    found = _lost(
        log,
        start,
        f"{gone.sum()} rows read an end of the converter on most electrodes: nothing was measured in them",
        length * -np.log(_NEVER),
    )
    found.mask = np.repeat(gone[:, None], log.channels, axis=1)
    found.parameters = {"seconds": (seconds, seconds, seconds)}
    found.detector, found.p = "gone", float(_NEVER ** gone.sum())
    found.end = float((start[-1] + length[-1] - 1) / log.rate)
    return [found]


def _lost(log, at, message, nats):
    """Rows that are missing before rows at (k,), each by so many nats."""
    strength = np.zeros(BLOCKS)
    np.add.at(strength, at * BLOCKS // len(log), nats)
    return Fault(
        "lost_rows",
        tuple(range(log.channels)),
        float(at.min() / log.rate),
        float(at.max() / log.rate),
        message,
        {"seconds": (NAN, NAN, NAN)},
        places=tuple(at / log.rate),
        detector="lost",
        **evidence(strength),
    )


def jumping(log: Log, faults: Sequence[Fault], begun: tuple[float, ...] = ()) -> list[Fault]:
    """Places where all channels jump from one row to the next: straight lines on either side do not meet.

    Rows are missing there ("lost_rows"), or were put together from elsewhere ("order"), or only the channels
    jump ("jump").

    Args:
      begun: times [s] at which something else of all channels begins.
    """
    rows = np.flatnonzero(~log.repeated)
    good = log.masked[~log.masked.all(1)].mean(0) < 0.02
    if not log.in_counts or len(rows) < _LEAST or not good.any() or mostly_coarse(log, faults):
        return []
    x, masked = log.counts[rows][:, good], log.masked[rows][:, good]
    before = np.maximum.accumulate(np.where(masked, 0, np.arange(len(rows))[:, None]), axis=0)
    x = np.take_along_axis(x, before, axis=0)  # a masked sample is the last one that was measured
    noise = noise_level(x)
    if np.median(noise) < 0.7:
        return []
    before, after, spread = _ends(x)
    jump = (after - before) / noise / spread
    # a few channels that jump are no loss: of all others a fifth has to
    others = np.sort(np.abs(jump), axis=1)[:, : max(_FEW, jump.shape[1] - log.some(_FEW))]
    score = np.sqrt((others**2).mean(1)) * ((others > 3).mean(1) >= 0.2)
    # the load bends by as much on the rows around, a loss stands alone
    around = np.maximum(percentile_filter(score, 90, size=81), 1)
    places = [
        i
        for i in _alone(score, around)
        if all(abs(rows[i + _LINE] / log.rate - start) > _BEGUN for start in begun)
    ]
    places = _in_order(_lively(log, x, rows, places), x, before, after)
    if not places:
        return []
    # the same counts on every channel are a supply's, not a load's
    change = (after - before)[places]
    chosen = np.array(places)[np.abs(change.mean(1)) <= 2 * change.std(1)]
    if not len(chosen) or not _moved(log):  # at rest nothing is missed
        return []
    at = rows[chosen + _LINE]
    when = ", ".join(f"{row / log.rate:.2f}" for row in sorted(at)[:6])
    found = _lost(
        log, at, f"at {when} s all electrodes jump between two rows: rows were lost", 0.5 * score[chosen] ** 2
    )
    found.p = len(chosen) / len(score)  # rows that stand alone as much
    found.features = {
        # up to a dozen times what is around it a place or two of every log jumps
        "times": float(np.clip(np.max(score[chosen] / around[chosen]), 12, 30)),
        "score": float(np.log(score[chosen].max())),
    }
    return [_or_not(log, found, rows, chosen + _LINE, noise, x)]


def _ends(x):
    """Ends of least-squares lines of the rows on the left and on the right of every gap between rows of
    x (n, c), and the spread of their difference in noises."""
    h, n = _LINE, len(x)
    line = np.vander(np.arange(h), 2)
    end = np.array([h - 0.5, 1.0]) @ np.linalg.pinv(line)
    before = sum(end[i] * x[i : n - h + 1 + i] for i in range(h))  # value half a row after rows i..i+h-1
    after = sum(end[::-1][i] * x[i : n - h + 1 + i] for i in range(h))
    return before[:-h], after[h:], np.sqrt(2 * (end**2).sum())


def _alone(score, around):
    """Places, the plainest first, whose score stands out of those around."""
    times = np.where(score > _SCORE, score / around, 0.0)
    places, _ = find_peaks(times, height=_TIMES, distance=_APART)
    return places[np.argsort(-times[places], kind="stable")].tolist()


def _lively(log, x, rows, places):
    """Places that do not follow rows that were held, trembling or not: after these the load has moved on."""
    bend = np.abs(np.diff(x, n=3, axis=0))
    usual = np.maximum(np.median(bend, axis=0), 0.5)
    return [
        i
        for i in places
        if not log.masked[max(rows[i + _LINE] - 3 * _LINE, 0) : rows[i + _LINE] + 1].all(1).any()
        and np.median(bend[max(i + _LINE - 2 * _WINDOW, 0) : i + _LINE - 3] / usual) > 0.4
    ]


def _in_order(places, x, before, after):
    """Places at which rows are missing, and not those of rows that come again, or that were written last
    first: from there it jumps back to what lies beside another place."""
    _, which, times = np.unique(x, axis=0, return_inverse=True, return_counts=True)
    again = uniform_filter1d((times[which.ravel()] > 1).astype(float), 2 * _LINE) > 0.4
    out = []
    for i in places:
        size = np.linalg.norm(after[i] - before[i])
        back = any(
            np.linalg.norm(before[i] - before[j]) + np.linalg.norm(after[i] - after[j]) < 0.25 * size
            for j in places
            if j != i
        )
        if not back and not again[i : i + 2 * _LINE].any():
            out.append(i)
    return out


def _moved(log):
    """Whether channels move by tens of counts within seconds, as a load moves them."""
    size = max(1, round(_BIN * log.rate))
    m = len(log) // size
    x = log.counts[: m * size].reshape(m, size, -1).mean(1)
    span = min(max(4, round(_SPAN * log.rate / size)), m)
    cells = x[: m // span * span].reshape(m // span, span, -1)
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, span), 2))[0]
    power = ((cells - basis @ (basis.T @ cells)) ** 2).sum(1) / (span - 2)
    liveliest = (power / np.maximum(power.mean(0), 1e-12)).max(1)
    power = power[liveliest <= np.quantile(liveliest, 1 - _LIVELIEST)].mean(0)
    return bool(np.median(np.sqrt(np.sort(power)[-max(1, log.some(6)) :])) >= _MOVED)


def _or_not(log, found, rows, at, noise, x):
    """The fault, or another one where something speaks against rows that are missing before some of the rows
    read x (n, c), the plainest first: what was logged beside the channels misses them as well, and what was
    there before them comes before what is there after."""
    if log.other_device is not None:
        leaps = np.median([_leap(log.other_device, int(row)) for row in rows[at[:_PLAINEST]]])
        id_, why = ("lost_rows", "") if leaps > _LEAPS else ("jump", "and the force does not")
    elif log.missing is not None:
        id_, why = "jump", "and the clock runs on"
    else:
        ends = np.abs(x[-_END:].mean(0) - x[:_END].mean(0)) / np.maximum(noise, 1)
        jump = np.abs(x[at[0] : at[0] + _END].mean(0) - x[at[0] - _END : at[0]].mean(0)) / np.maximum(
            noise, 1
        )
        turned = np.median(ends) < _MEETS and np.median(jump) > 5 * _MEETS
        id_, why = ("order", "and the last row goes on with the first") if turned else ("lost_rows", "")
    if why:
        found.id, found.message = id_, found.message.replace(": rows were lost", f", {why}")
        found.channels, found.parameters = (), {}
    return found


def _leap(signal, row):
    """By how many times what it does elsewhere something (n, k) changes at a row, the liveliest component."""
    before, after = _END + 1, _END - 1
    at = np.clip(np.r_[row, np.arange(10, len(signal) - 10, 7)], before, len(signal) - after)
    size = np.abs([signal[i : i + after].mean(0) - signal[i - before : i - 1].mean(0) for i in at])
    usual = np.quantile(size[1:], 0.9, axis=0)
    moved = usual > 0
    return float((size[0] / np.where(moved, usual, 1.0))[moved].max(initial=0.0))
