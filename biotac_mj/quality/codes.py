"""Codes of the converter: some are never read, or the upper bits are lost."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..sensor.channels import FULL_SCALE
from .evidence import BLOCKS, evidence
from .fault import Fault
from .log import Log
from .noise import noise_level, sound_noise

__all__ = ["coarse", "mostly_coarse", "put_back"]

# visits of a code, of whose neighbours one in a hundred is then missed by chance
_OFTEN = 5
_CUT, _CODES = 4, 16  # step and codes at least of one channel that is coarse alone
_LATER = 0.1  # of the rows, that are coarse at least where not all are
_CHANCE = 12.0  # nats: one in 1e5

_BITS = (7, 8, 9, 10, 11)  # that a word has left
_SURE = 16.0  # nats: by chance changes are as near to the size and ends of the band once in 9e6 times
_NEAR = 1 / 16  # of the band
_LOOSE = 1 / 4  # of the band, where others overflow: a load moves channels meanwhile
_TIMES = 3  # in each: what leaves and comes back once may be a spike
# of one that leaves and comes back once: of a band so large, for so many rows, from its one end to the other
_LARGE, _AWAY = 1024, 3
_USUAL = 0.95  # of the channel's steps, of which the largest are the load's
_FRACTION = 0.8  # of the changes beyond half of the band that are overflows


def coarse(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Channels that leave out some of the codes which their noise should visit, on a lattice or not."""
    if not log.whole:
        return []
    x = log.counts.astype(int)
    lattice = np.array([_lattice([c]) for c in x.T])
    lattice = np.maximum(lattice, _lattice(x.T))  # where each takes too few values
    step = np.where(lattice > 1, lattice, [_spacing(c) for c in x.T])
    found, known = np.flatnonzero(step >= 2), np.isfinite(step)
    # levels that lie far apart look alike, but are no multiples of anything
    if 1 < len(found) < 0.5 * known.sum():
        found = np.flatnonzero(lattice > 1)
    if len(found) == 1:  # one converter reads all, but a channel's word may be cut
        codes = len(np.unique(x[:, found[0]]))
        found = found[(lattice[found] >= _CUT) & (codes >= _CODES)]
    if not len(found):
        return _coarse_since(log, x)
    q = float(np.median(step[found]))
    # of codes that noise takes it to by chance every q-th would be one of these
    parts = np.array_split(x[:, found], BLOCKS)
    channels = range(log.channels) if len(found) > 0.75 * known.sum() else found
    message = (
        f"values of {log.name(channels)} are coarse: of the codes that noise should visit only one in "
        f"{q:.3g} is ever read"
    )
    return [_coarse(log, channels, q, 0.0, message, parts, len(found) == 1)]


def _coarse_since(log, x):
    """All channels or some that are coarse from some row on: the largest number that all differences from the
    last row have in common, back to where they no longer have one."""
    off = np.abs(x - x[-1])[::-1]
    long, q, sure = _common(np.gcd.reduce(off, axis=1), off)
    if sure and (np.ptp(off[:long], axis=0) > 0).sum() > log.some(4):
        channels = np.arange(log.channels)
    else:
        each = [_common(off[:, k], off[:, [k]]) for k in range(log.channels)]
        channels = np.array([k for k, (_, step, sure) in enumerate(each) if sure and step >= _CUT], int)
        if not len(channels):
            return []
        long, q = max(each[k][0] for k in channels), float(np.median([each[k][1] for k in channels]))
    since = (len(x) - long) / log.rate
    message = f"values of {log.name(channels)} are multiples of {q:.3g} apart from {since:.1f} s on"
    found = _coarse(
        log, channels, q, since, message, np.array_split(off[:long][:, channels], BLOCKS), len(channels) == 1
    )
    found.p = min(found.p, float(np.exp(-2 * _CHANCE)))
    return [found]


def _coarse(log, channels, q, since, message, parts, cut):
    """A fault of channels whose codes are q apart; parts: their values, block by block."""
    found = Fault(
        "quantise",
        tuple(int(k) for k in channels),
        since,
        (len(log) - 1) / log.rate,
        message,
        {"step": (q, q, q)},
        detector="cut" if cut else "samples",
        **evidence([np.log(q) * np.count_nonzero(np.diff(part, axis=0)) for part in parts]),
    )
    return found


def _common(numbers, off):
    """Of numbers (n,) how many of the first have a divisor in common, which, and whether so many changes of
    what they stand for, off (n, c), show that it is no chance, and begins at some row."""
    common = np.gcd.accumulate(numbers)
    steps = np.unique(common[common > 1])  # a row more may have a part of it in common by chance
    if not len(steps):
        return 0, 0.0, False
    rows = np.array([np.count_nonzero(common % step == 0) for step in steps])  # equal rows have all of it
    best = int((rows * np.log(steps)).argmax())
    long, q = int(rows[best]), float(steps[best])
    if long == len(numbers) or long < max(_LATER * len(numbers), 2 * BLOCKS):
        return long, q, False
    return long, q, np.count_nonzero(np.diff(off[:long], axis=0)) * np.log(q) > 2 * _CHANCE


def _lattice(columns):
    """Step of the lattice that all codes of columns of integers (n,) lie on; 1 where it may be chance."""
    gaps = np.concatenate([np.diff(np.unique(x)) for x in columns])
    step = int(np.gcd.reduce(gaps)) if len(gaps) else 1
    # each further code would lie on the lattice by chance once in `step` times
    return step if step > 1 and (len(gaps) - 1) * np.log(step) > _CHANCE else 1


def _spacing(x):
    """Typical distance of the codes that integers x (n,) visit, on a lattice or not; 1 where codes that are
    visited often have neighbours, nan where too few are."""
    value, count = np.unique(x[1:][np.diff(x) != 0], return_counts=True)  # one that stands still is no pile
    often = count >= _OFTEN
    if often.sum() < 3:
        return np.nan
    gap = np.diff(value)
    alone = np.minimum(np.append(gap, gap[-1]), np.insert(gap, 0, gap[0]))[often] > 1
    return float(np.median(gap[often[:-1]])) if alone.mean() > 0.8 else 1.0


def mostly_coarse(log: Log, faults: Sequence[Fault]) -> bool:
    """Whether most channels are so coarse that noise seldom takes them from one code to another."""
    noise = sound_noise(np.median(log.counts, axis=0))
    return any(len(f.channels) > 0.5 * log.channels and f.step > 2 * np.median(noise) for f in faults)


def put_back(log: Log) -> tuple[Log, list[Fault]]:
    """A log with the upper bits that its words lost put back by going on from row to row, and that fault; the
    same log and none where nothing overflows.

    What leaves a band of a power of two on one side comes back on the other. Which band a channel was in
    before the first row nobody knows: the one nearest to the other channels is taken.
    """
    x = log.counts
    band, faulty = _overflowing(x) if log.converter else (0.0, ())
    if not len(faulty):
        return log, []
    out = x.copy()
    for k in faulty:
        step = np.diff(x[:, k])
        out[1:, k] = x[0, k] + np.cumsum(step - band * np.rint(step / band))
    sound = np.median(np.delete(out, faulty, axis=1)) if len(faulty) < x.shape[1] else np.median(out)
    for k in faulty:  # a whole number of bands that keeps it within what a converter gives
        shift = band * np.rint((sound - np.median(out[:, k])) / band)
        if np.ptp(x[:, k]) < band and 0 <= out[:, k].min() + shift and out[:, k].max() + shift <= 4095:
            out[:, k] += shift
    channels = tuple(int(k) for k in faulty)
    message = (
        f"counts of {log.name(channels)} overflow at {band:.0f}: upper bits are lost; what is said is of "
        "counts put back"
    )
    fault = Fault("overflow", channels, 0.0, (len(x) - 1) / log.rate, message, {"band": (band, band, band)})
    return dataclasses.replace(log, counts=np.clip(out, 0, 4095), read=None), [fault]


def _overflowing(x):
    """Counts after which channels x (n, c) begin again, a power of two, and which do: those that leave and
    come back, and where some surely do, those that left for good, too."""
    noise, x = noise_level(x), _less_ends(x)
    for band in 2.0 ** np.array(_BITS):
        both, once, nats = [], [], 0.0
        for k in range(x.shape[1]):
            step = np.diff(x[:, k])
            rows = np.flatnonzero(np.abs(step) > band / 2)
            remainder = np.abs(step[rows] - band * np.rint(step[rows] / band))
            mine = rows[remainder < _NEAR * band]
            if (
                len(rows)
                and (remainder < _LOOSE * band).mean() > _FRACTION
                and np.ptp(x[rows[0] + 1 :, k]) < band
            ):
                once.append(k)
            away = band >= _LARGE and len(mine) == 2 and _once(x[:, k], mine, band)
            if not away and len(mine) < max(_TIMES, _FRACTION * len(rows)):
                continue
            after = x[mine[0] + 1 :, k]
            inside = after[: mine[-1] - mine[0]]
            ends = np.where(step[mine] < 0, x[mine + 1, k], x[mine, k])  # on the lower side
            same = np.unique(ends, return_counts=True)[1].max()  # what drops out does so to one count
            # one bit of a word that fails leaves the band
            few = away or 2 * same <= len(ends)
            # less a band an overflow is a step like the others; a spike of nearly that size is not
            usual = np.quantile(np.delete(np.abs(step), rows), _USUAL) + 1
            goes_on = away or np.median(remainder[remainder < _NEAR * band]) <= usual
            if {1.0, -1.0} == {*np.sign(step[mine])} and np.ptp(inside) < band and few and goes_on:
                both.append(k)
                near = np.maximum(remainder[remainder < _NEAR * band], noise[k]) + 1
                nats -= np.log(2 * near / band).sum() + (4 * np.log(_NEAR) if away else 0)
        if both and nats > _SURE:
            return float(band), np.union1d(both, once).astype(int)
    return 0.0, np.zeros(0, int)


def _less_ends(x):
    """Counts x (n, c) with the value before where one at an end of the converter repeats: nothing is measured
    there, while a word that overflows goes on with its noise."""
    same = np.diff(x, axis=0) == 0
    ends = np.isin(x, (0, FULL_SCALE))
    ends &= np.pad(same, ((1, 0), (0, 0))) | np.pad(same, ((0, 1), (0, 0)))
    last = np.maximum.accumulate(np.where(ends, 0, np.arange(len(x))[:, None]), axis=0)
    return np.take_along_axis(x, last, axis=0)


def _once(x, rows, band):
    """Whether what leaves x (n,) after the first and comes back after the second of two rows does so from one
    end of a band to the other: neither a spike nor a wire that breaks begins and ends there."""
    ends = x[[rows[0], rows[0] + 1, rows[1], rows[1] + 1]] % band / band
    near = np.minimum(ends, 1 - ends) < _NEAR
    low = ends < 0.5
    across = (low == [low[0], not low[0], not low[0], low[0]]).all()
    one = np.abs(np.diff(x)[rows]).max() < 1.5 * band
    return rows[1] - rows[0] >= _AWAY and near.all() and across and one
