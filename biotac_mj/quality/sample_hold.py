"""Sample-and-hold faults: rows that repeat the one before, arrive slower than the bus rate, or jitter between
new values."""

from collections.abc import Sequence

import numpy as np

from .clock import BUS_RATE
from .codes import mostly_coarse
from .evidence import BLOCKS, NAN, by_block, evidence, runs
from .fault import Fault
from .log import Log
from .noise import sound_noise

__all__ = ["sample_and_hold"]

_HAND = 10.0  # [Hz] bandwidth of a load moved by hand, which a log must resolve
_WINDOW = 24  # rows of a window in which the few new values stand out
# median difference over RMS difference within windows: 0.67 for noise, at least 0.5 for real sensors
_UNEVEN = 0.36
# fraction of rows that repeat the one before by rounding alone, and its factor on the observed fraction
_BY_CHANCE, _FEW = 1e-4, 0.05
_OFTEN = 0.002  # fraction of rows that may repeat by chance
# of the bus rate; real recordings have at least 0.78 in any sixteenth
_SLOW, _LASTING = 0.65, 0.25
# fraction of rows that repeat more often than a bus explains: at most 0.01 in real recordings, at least 0.03
# if rows repeat at random
_UNEVENLY = 0.02
_HEIGHT = 1.3  # of the noise: change at a new reading; sqrt(2) if nothing moves


def sample_and_hold(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds rows that repeat longer or less evenly than a slow bus explains, and steps with only white noise
    between them."""
    n = len(log)
    if mostly_coarse(log, faults):  # then rows repeat by chance
        return []
    same = (np.diff(log.counts, axis=0) == 0).mean(1)
    held = np.concatenate([[False], same > 0.99]) & ~log.masked.all(1)
    start, length = runs(held)
    if len(start):
        # a bus that is slower by a factor r repeats floor(r) - 1 or floor(r) rows (the most frequent runs) at
        # any time
        each = [length[start * BLOCKS // n == b] for b in range(BLOCKS)]
        usual = int(np.quantile([np.bincount(r).argmax() if len(r) else 0 for r in each], 0.25)) + 1
        long = length > usual
        mask = np.zeros(n, bool)
        for s, k in zip(start[long], length[long]):
            mask[s : s + k] = True
        longest = length[long].max(initial=0)
        if (mask.mean() > 0.03 or longest >= max(8, 3 * usual)) and longest >= 2 + usual:
            return [_frozen(log, mask, f", up to {longest / log.rate:.2f} s at a time")]
    if any(f.step for f in faults):
        return []
    return _slower(log, held) or (_dithered(log) if held.mean() < 0.4 else [])


def _slower(log, held):
    """Repeated rows (n,) bool that a bus does not explain. A bus that is slower by a factor r repeats a row
    at most ceil(r) - 1 times and delivers a hundred new rows per second."""
    n = len(held)
    if not held.any():
        return []
    unchanged = (np.diff(log.counts, axis=0) == 0)[~held[1:]].mean(0)
    chance = np.prod(np.clip(unchanged, 1e-2, 1))
    if chance > max(_BY_CHANCE, _FEW * held.mean()):  # equal rows are no fault
        return []
    fresh = np.flatnonzero(~held)
    repeats = np.diff(fresh) - 1
    often = max(1, int(np.ceil(n / len(fresh) - 1e-9)) - 1)
    block = fresh[:-1] * BLOCKS // n
    uneven = np.bincount(block, repeats > often, BLOCKS) / np.maximum(np.bincount(block, minlength=BLOCKS), 1)
    rates = np.array([log.rate * (1 - part.mean()) for part in np.array_split(held, BLOCKS)])
    # a stated rate may be that of another logger: the fastest segments of the log then give the bus rate
    bus = min(log.rate, BUS_RATE) if log.clocked else np.quantile(rates, 0.9)
    slow = rates < _SLOW * bus
    if slow.mean() >= _LASTING:
        when = np.repeat(slow, [len(part) for part in np.array_split(held, BLOCKS)])
        return [
            _frozen(
                log,
                held & when,
                f": a new row {np.median(rates[slow]):.0f} times a second, where a bus brings {bus:.0f}",
            )
        ]
    if (repeats > often).mean() > _UNEVENLY and (uneven > 0.5 * _UNEVENLY).mean() > 0.5:
        often = f"{(repeats > often).mean():.1%} of them more often than the {often} of a bus as fast"
        return [_frozen(log, held, f": {often}")]
    return []


def _frozen(log, mask, how):
    """Fault of rows that repeat in all channels. mask: (n,)."""
    seconds = float(mask.sum() / log.rate)
    message = f"{seconds:.1f} s of rows repeat the one before in all electrodes{how}"
    # each block of repeated rows, however few
    return _fault(log, mask, seconds, message, by_block(mask[mask], _OFTEN))


def _fault(log, mask, seconds, message, strength, known=True):
    """Fault of repeated rows, mask (n,) or None. known: whether the interval of `seconds` is known."""
    rows = np.flatnonzero(mask) if mask is not None else [0, len(log) - 1]
    return Fault(
        "freeze",
        tuple(range(log.channels)),
        rows[0] / log.rate,
        rows[-1] / log.rate,
        message,
        {"seconds": (seconds, seconds, seconds) if known else (seconds, NAN, NAN)},
        None if mask is None else np.repeat(mask[:, None], log.channels, axis=1),
        held=True,
        detector="samples",
        **evidence(strength),
    )


def _dithered(log):
    """Finds values that are sampled now and then with jitter between: in a short window most differences are
    small and a few as large as noise, in most channels, at any rows.

    Not applicable to logs slower than twice the bandwidth of a hand: there touches begin within one row, as
    new values do.
    """
    if log.rate <= 2 * _HAND:
        return []
    rows = np.flatnonzero(~log.repeated & ~log.masked.all(1))
    change = np.diff(log.counts[rows], axis=0)
    step = np.abs(change)
    k = len(step) // (_WINDOW)
    if k < BLOCKS:
        return []
    cells = step[: k * _WINDOW].reshape(k, _WINDOW, -1)
    size = np.sqrt((cells**2).mean(1))
    lively = size > 2.5  # below it rounding alone makes differences uneven
    uneven = np.where(lively, np.maximum(np.median(cells, axis=1), 0.5) / np.maximum(size, 0.1), np.nan)
    known = np.flatnonzero(lively.mean(0) > 0.2)
    if len(known) < max(1, log.some(12)):
        return []
    usual = np.maximum(np.median(step, axis=0), 0.5)
    jump = step > 3 * usual
    if _is_load(jump[:, known], change[:, known]):
        return []
    law = sound_noise(np.median(log.counts[rows], axis=0))
    height = [np.median(step[jump[:, e], e]) / law[e] for e in known if jump[:, e].any()]
    # the median over rows also jumps, by less than the noise
    if np.median(np.nanmedian(uneven[:, known], axis=0)) > _UNEVEN or np.median(height or [0.0]) < _HEIGHT:
        return []
    mask, simultaneous = None, jump.mean(1) > 0.25
    if jump[simultaneous].sum() > 0.8 * jump.sum():  # all channels at once: no jitter between
        mask = _hardly_changed(log.counts, 3 * usual)
    seconds = float(1 / (log.rate * jump[:, known].mean()))
    message = f"all electrodes take a new value every {seconds:.3f} s, and tremble between"
    parts = [part[np.isfinite(part)] for part in np.array_split(uneven[:, known], BLOCKS)]
    strength = -np.log(np.array([np.median(part) if len(part) else np.nan for part in parts]) / 0.67)
    return [_fault(log, mask, seconds, message, np.nan_to_num(strength) * k, known=False)]


def _is_load(jump, change):
    """Whether large changes (n, c) at jump (n, c) bool come from a load: they then continue in the same
    direction, at least every second one of them. New values after held ones have random signs."""
    first = jump[:-1]
    followed = np.count_nonzero(first & jump[1:] & (change[:-1] * change[1:] > 0))
    chance = max(jump.mean() / 2, 1 / jump.size)
    isolated = np.count_nonzero(first) - followed
    return followed * np.log(0.5 / chance) + isolated * np.log(0.5 / (1 - chance)) > 0


def _hardly_changed(x, usual):
    """(n,) bool, rows of x (n, c) in which fewer than a quarter of the channels take a new value."""
    step = np.abs(np.diff(x, axis=0, prepend=x[:1]))
    return (step > usual).mean(1) <= 0.25
