"""Missing rows: by the log's clock, by jumps of all channels between two rows, or because nothing was
measured."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import percentile_filter
from scipy.signal import find_peaks

from ..sensor.channels import FULL_SCALE
from .adjacent import last_measured, line_ends
from .codes import mostly_coarse
from .evidence import BLOCKS, NAN, evidence, runs
from .fault import Fault
from .log import Log
from .noise import noise_level

_MOST = 12  # channels of 19; no load drives as many to an end of the converter at once
_NEVER = 1e-5  # fraction of rows in which that happens by chance
_FEW = 4  # channels of 19 that may jump for other reasons
_BEGUN = 2.0  # [s] accuracy of the start of an effect on all channels
_CHANCE = 12.0  # nats: one in 1e5
_LEAST = 200  # rows
# places to check; ratio of the other device's change there to its usual change: at least 5 where a logger
# lost rows, at most 0.9 where only electrodes jump
_PLAINEST, _LEAPS = 3, 2.5
_AT_REST = 0.1  # of the force beside it
_END, _MEETS = 4, 2.0  # rows at either end, and their largest distance in noise units if they join
_LINE = 4  # rows of the line fitted on either side
# least score of a jump, least ratio to its neighbourhood, and least distance between jumps in rows
_SCORE, _TIMES, _SPACING = 4.0, 3.0, 13


def dropped(log: Log) -> list[Fault]:
    """Finds rows that are missing by the file's own clock."""
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
    """Finds rows in which most channels read an end of the converter: no power, an unplugged connector or an
    empty message."""
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
    """Fault of rows missing before rows at (k,), with evidence `nats` each."""
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
    """Finds places where all channels jump between two rows: lines fitted on either side do not meet.

    There rows are missing ("lost_rows"), were joined from elsewhere ("order"), or only the channels jump
    ("jump").

    Args:
      begun: start times [s] of other effects on all channels.
    """
    rows = np.flatnonzero(~log.repeated)
    good = log.masked[~log.masked.all(1)].mean(0) < 0.02
    if not log.in_counts or len(rows) < _LEAST or not good.any() or mostly_coarse(log, faults):
        return []
    x, masked = log.counts[rows][:, good], log.masked[rows][:, good]
    x = last_measured(x, masked)
    noise = noise_level(x)
    if np.median(noise) < 0.7:
        return []
    before, after, spread = line_ends(x, _LINE)
    jump = (after - before) / noise / spread
    # a loss affects all channels: a fifth of the others must jump too
    others = np.sort(np.abs(jump), axis=1)[:, : max(_FEW, jump.shape[1] - log.some(_FEW))]
    score = np.sqrt((others**2).mean(1)) * ((others > 3).mean(1) >= 0.2)
    # a load bends the rows around as well, a loss is a single event
    around = np.maximum(percentile_filter(score, 90, size=81), 1)
    # after rows that were held all channels jump as well, and none is missing
    gap = np.diff(rows, prepend=rows[0] - 1)
    places = [
        i
        for i in _isolated(score, around)
        if gap[i + _LINE] <= 2 * np.median(gap)
        and all(abs(rows[i + _LINE] / log.rate - start) > _BEGUN for start in begun)
    ]
    if not places:
        return []
    # equal changes on all channels come from the supply, not from a load
    change = (after - before)[places]
    chosen = np.array(places)[np.abs(change.mean(1)) <= 2 * change.std(1)]
    if not len(chosen):
        return []
    at = rows[chosen + _LINE]
    when = ", ".join(f"{row / log.rate:.2f}" for row in sorted(at)[:6])
    found = _lost(
        log, at, f"at {when} s all electrodes jump between two rows: rows were lost", 0.5 * score[chosen] ** 2
    )
    found.p = len(chosen) / len(score)  # fraction of rows that stand out as much
    found.features = {
        # every log has one or two places with up to a dozen times the score around them
        "times": float(np.clip(np.max(score[chosen] / around[chosen]), 12, 30)),
        "score": float(np.log(score[chosen].max())),
    }
    if _from_rest(log, at[:_PLAINEST]):
        return []
    return [_alternative(log, found, rows, chosen + _LINE, noise, x)]


def _from_rest(log, at):
    """Whether the other device says that something touched or let go at rows at (k,): it is at rest on one
    side of most of them, where one that lost rows goes on."""
    if log.other_device is None:
        return False
    size = np.linalg.norm(log.other_device, axis=1)
    sides = [sorted((size[max(i - _END, 0) : i].mean(), size[i : i + _END].mean())) for i in at]
    return np.median([low / max(high, 1e-12) for low, high in sides]) < _AT_REST


def _isolated(score, around):
    """Places whose score exceeds those around, by decreasing ratio."""
    times = np.where(score > _SCORE, score / around, 0.0)
    places, _ = find_peaks(times, height=_TIMES, distance=_SPACING)
    return places[np.argsort(-times[places], kind="stable")].tolist()


def _alternative(log, found, rows, at, noise, x):
    """The fault, or another one if evidence is against missing rows: signals of the other device must jump
    too, and the rows before must precede those after. x: rows (n, c) as read; rows: by decreasing score."""
    if log.other_device is not None:
        leaps = np.median([_relative_jump(log.other_device, int(row)) for row in rows[at[:_PLAINEST]]])
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


def _relative_jump(signal, row):
    """Change of signal (n, k) at a row over its usual change, for the most active component."""
    before, after = _END + 1, _END - 1
    at = np.clip(np.r_[row, np.arange(10, len(signal) - 10, 7)], before, len(signal) - after)
    size = np.abs([signal[i : i + after].mean(0) - signal[i - before : i - 1].mean(0) for i in at])
    usual = np.quantile(size[1:], 0.9, axis=0)
    moved = usual > 0
    return float((size[0] / np.where(moved, usual, 1.0))[moved].max(initial=0.0))
