"""Rows that come again later, as of a block that is logged twice: noise never repeats in all channels."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import poisson

from .codes import mostly_coarse
from .evidence import NAN
from .fault import Fault
from .log import Log
from .noise import noise_level


def logged_twice(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds rows that equal an earlier one, not the one before, in all channels, where noise does not make as
    many equal."""
    x = log.counts
    rows = np.flatnonzero(np.append(True, (np.diff(x, axis=0) != 0).any(1)) & ~log.masked.all(1))
    if len(rows) < 3 or mostly_coarse(log, faults):  # then rows are equal by chance
        return []
    _, first, group = np.unique(x[rows], axis=0, return_index=True, return_inverse=True)
    lag = np.arange(len(rows)) - first[group.ravel()]
    if not (number := np.count_nonzero(lag)):
        return []
    step = np.ones(log.channels)
    for fault in faults:
        step[list(fault.channels)] = np.maximum(step[list(fault.channels)], fault.step)
    # two values of Gaussian noise are rounded to the same one as often as this or less
    equal = np.minimum(step / (2 * np.sqrt(np.pi) * noise_level(x[rows])), 1.0).prod()
    edge = np.concatenate([[0], np.flatnonzero(np.diff(lag)) + 1, [len(lag)]])
    block = np.argmax(np.diff(edge) * (lag[edge[:-1]] > 0))  # the longest that comes again in order
    begin, end = edge[block], edge[block + 1] - 1
    mask = np.zeros(log.counts.shape, bool)
    mask[rows[lag > 0]] = True
    return [
        Fault(
            "again",
            tuple(range(log.channels)),
            rows[begin] / log.rate,
            rows[end] / log.rate,
            f"{number} rows come again, in all electrodes: rows {rows[begin] + 1} to {rows[end] + 1} are as "
            f"from row {rows[begin - lag[begin]] + 1} on, logged twice",
            {"seconds": (number / log.rate, NAN, NAN)},
            mask,
            p=float(poisson.sf(number - 1, len(rows) ** 2 / 2 * equal)),
        )
    ]
