"""Sample-and-hold faults: rows that repeat the one before for longer than a slow bus explains."""

from collections.abc import Sequence

import numpy as np

from .codes import mostly_coarse
from .evidence import BLOCKS, by_block, evidence, runs
from .fault import Fault
from .log import Log

_OFTEN = 0.002  # fraction of rows that may repeat by chance


def sample_and_hold(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds rows that repeat longer than a slow bus explains."""
    n = len(log)
    if mostly_coarse(log, faults):  # then rows repeat by chance
        return []
    same = (np.diff(log.counts, axis=0) == 0).mean(1)
    held = np.concatenate([[False], same > 0.99]) & ~log.masked.all(1)
    start, length = runs(held)
    if not len(start):
        return []
    # a bus that is slower by a factor r repeats floor(r) - 1 or floor(r) rows (the most frequent runs) at any
    # time
    each = [length[start * BLOCKS // n == b] for b in range(BLOCKS)]
    usual = int(np.quantile([np.bincount(r).argmax() if len(r) else 0 for r in each], 0.25)) + 1
    long = length > usual
    mask = np.zeros(n, bool)
    for s, k in zip(start[long], length[long]):
        mask[s : s + k] = True
    longest = length[long].max(initial=0)
    if longest < 2 + usual or mask.mean() <= 0.03 and longest < max(8, 3 * usual):
        return []
    seconds, rows = float(mask.sum() / log.rate), np.flatnonzero(mask)
    return [
        Fault(
            "freeze",
            tuple(range(log.channels)),
            rows[0] / log.rate,
            rows[-1] / log.rate,
            f"{seconds:.1f} s of rows repeat the one before in all electrodes, up to "
            f"{longest / log.rate:.2f} s at a time",
            {"seconds": (seconds, seconds, seconds)},
            np.repeat(mask[:, None], log.channels, axis=1),
            held=True,
            detector="samples",
            **evidence(by_block(mask[mask], _OFTEN)),  # each block of repeated rows, however few
        )
    ]
