"""Sample-and-hold faults: rows that repeat the one before, or arrive slower than the bus rate."""

from collections.abc import Sequence

import numpy as np

from .clock import BUS_RATE
from .codes import mostly_coarse
from .evidence import BLOCKS, by_block, evidence, runs
from .fault import Fault
from .log import Log

# fraction of rows that repeat the one before by rounding alone, and its factor on the observed fraction
_BY_CHANCE, _FEW = 1e-4, 0.05
_OFTEN = 0.002  # fraction of rows that may repeat by chance
# of the bus rate; real recordings have at least 0.78 in any sixteenth
_SLOW, _LASTING = 0.65, 0.25
# fraction of rows that repeat more often than a bus explains: at most 0.01 in real recordings, at least 0.03
# if rows repeat at random
_UNEVENLY = 0.02


def sample_and_hold(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds rows that repeat longer or less evenly than a slow bus explains."""
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
    return _slower(log, held)


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
    seconds, rows = float(mask.sum() / log.rate), np.flatnonzero(mask)
    return Fault(
        "freeze",
        tuple(range(log.channels)),
        rows[0] / log.rate,
        rows[-1] / log.rate,
        f"{seconds:.1f} s of rows repeat the one before in all electrodes{how}",
        {"seconds": (seconds, seconds, seconds)},
        np.repeat(mask[:, None], log.channels, axis=1),
        held=True,
        detector="samples",
        **evidence(by_block(mask[mask], _OFTEN)),  # each block of repeated rows, however few
    )
