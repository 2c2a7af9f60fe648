"""Faults of the converter's codes: codes that never occur, and lost upper bits."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..sensor.channels import FULL_SCALE
from .adjacent import last_measured
from .evidence import BLOCKS, evidence
from .fault import Fault
from .log import Log
from .noise import noise_level, sound_noise

# visits of a code after which one in a hundred of its neighbours is unvisited by chance
_OFTEN = 5
_CUT, _CODES = 4, 16  # least step and number of codes if a single channel is coarse
_LATER = 0.1  # least fraction of coarse rows if not all are
_CHANCE = 12.0  # nats: one in 1e5

_BITS = (7, 8, 9, 10, 11)  # number of bits that remain
_SURE = 16.0  # nats: changes match the size and ends of the band by chance once in 9e6 times
_NEAR = 1 / 16  # of the band
_LOOSE = 1 / 4  # of the band, if other channels overflow: the load moves channels meanwhile
_TIMES = 3  # overflows in each direction: a single excursion may be a spike
_USUAL = 0.95  # quantile of the channel's steps; larger ones come from the load
_FRACTION = 0.8  # least fraction of overflows among changes of more than half a band


def coarse(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds channels that skip codes which their noise should reach, for example every second one."""
    if not log.whole:
        return []
    x = log.counts.astype(int)
    lattice = np.array([_lattice([c]) for c in x.T])
    lattice = np.maximum(lattice, _lattice(x.T))  # catches channels that each have too few values
    step = np.where(lattice > 1, lattice, [_spacing(c) for c in x.T])
    found, known = np.flatnonzero(step >= 2), np.isfinite(step)
    # levels far from each other look coarse, but are not multiples of anything
    if 1 < len(found) < 0.5 * known.sum():
        found = np.flatnonzero(lattice > 1)
    if len(found) == 1:  # all channels share one converter, but one channel's word may lose bits
        codes = len(np.unique(x[:, found[0]]))
        found = found[(lattice[found] >= _CUT) & (codes >= _CODES)]
    if not len(found):
        return _coarse_since(log, x)
    q = float(np.median(step[found]))
    # one in q of the codes that noise visits would be a multiple by chance
    parts = np.array_split(x[:, found], BLOCKS)
    channels = range(log.channels) if len(found) > 0.75 * known.sum() else found
    message = (
        f"values of {log.name(channels)} are coarse: of the codes that noise should visit only one in "
        f"{q:.3g} is ever read"
    )
    return [_coarse(log, channels, q, 0.0, message, parts, len(found) == 1)]


def _coarse_since(log, x):
    """Finds channels that become coarse at some row: the largest common divisor of all differences from the
    last row, back to where it ends."""
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
    """Fault of channels with code distance q. parts: their values by block."""
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
    """Length of the leading run of numbers (n,) with a common divisor, the divisor, and whether the changes
    off (n, c) show that it is not chance and starts at some row."""
    common = np.gcd.accumulate(numbers)
    steps = np.unique(common[common > 1])  # one row more may share a smaller divisor by chance
    if not len(steps):
        return 0, 0.0, False
    rows = np.array([np.count_nonzero(common % step == 0) for step in steps])  # equal rows share any divisor
    best = int((rows * np.log(steps)).argmax())
    long, q = int(rows[best]), float(steps[best])
    if long == len(numbers) or long < max(_LATER * len(numbers), 2 * BLOCKS):
        return long, q, False
    return long, q, np.count_nonzero(np.diff(off[:long], axis=0)) * np.log(q) > 2 * _CHANCE


def _lattice(columns):
    """Step of the lattice that contains all codes of columns of integers (n,); 1 if it may be chance."""
    gaps = np.concatenate([np.diff(np.unique(x)) for x in columns])
    step = int(np.gcd.reduce(gaps)) if len(gaps) else 1
    # each further code lies on the lattice by chance once in `step` times
    return step if step > 1 and (len(gaps) - 1) * np.log(step) > _CHANCE else 1


def _spacing(x):
    """Typical distance of the codes that integers x (n,) visit, on a lattice or not. 1 if often-visited codes
    have neighbours, nan if too few codes are visited often."""
    value, count = np.unique(x[1:][np.diff(x) != 0], return_counts=True)  # ignore constant stretches
    often = count >= _OFTEN
    if often.sum() < 3:
        return np.nan
    gap = np.diff(value)
    isolated = np.minimum(np.append(gap, gap[-1]), np.insert(gap, 0, gap[0]))[often] > 1
    return float(np.median(gap[often[:-1]])) if isolated.mean() > 0.8 else 1.0


def mostly_coarse(log: Log, faults: Sequence[Fault]) -> bool:
    """Whether most channels are so coarse that noise rarely changes their code."""
    noise = sound_noise(np.median(log.counts, axis=0))
    return any(len(f.channels) > 0.5 * log.channels and f.step > 2 * np.median(noise) for f in faults)


def put_back(log: Log) -> tuple[Log, list[Fault]]:
    """Restores lost upper bits by continuity between rows. Returns the log and that fault; the same log and
    none if nothing overflows.

    A value that leaves a band (a power of two) at one end returns at the other. The band before the first row
    is unknown: the one closest to the other channels is used.
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
    for k in faulty:  # offset by whole bands, within the converter's range
        shift = band * np.rint((sound - np.median(out[:, k])) / band)
        if np.ptp(x[:, k]) < band and 0 <= out[:, k].min() + shift and out[:, k].max() + shift <= 4095:
            out[:, k] += shift
    channels = tuple(int(k) for k in faulty)
    message = (
        f"counts of {log.name(channels)} overflow at {band:.0f}: upper bits are lost; other findings are "
        "for restored counts"
    )
    fault = Fault("overflow", channels, 0.0, (len(x) - 1) / log.rate, message, {"band": (band, band, band)})
    return dataclasses.replace(log, counts=np.clip(out, 0, 4095), read=None), [fault]


def _overflowing(x):
    """Modulus (a power of two) at which channels x (n, c) wrap, and the channels that do: those that leave
    and return, and, if some surely wrap, also those that do not return."""
    noise, x = noise_level(x), _without_rails(x)
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
            if len(mine) < max(_TIMES, _FRACTION * len(rows)):
                continue
            after = x[mine[0] + 1 :, k]
            inside = after[: mine[-1] - mine[0]]
            ends = np.where(step[mine] < 0, x[mine + 1, k], x[mine, k])  # on the lower side
            same = np.unique(ends, return_counts=True)[1].max()  # a dropout always goes to the same count
            # one faulty bit of a word moves it out of the band
            few = 2 * same <= len(ends)
            # minus one band, an overflow is an ordinary step; a spike of nearly that size is not
            usual = np.quantile(np.delete(np.abs(step), rows), _USUAL) + 1
            continues = np.median(remainder[remainder < _NEAR * band]) <= usual
            if {1.0, -1.0} == {*np.sign(step[mine])} and np.ptp(inside) < band and few and continues:
                both.append(k)
                near = np.maximum(remainder[remainder < _NEAR * band], noise[k]) + 1
                nats -= np.log(2 * near / band).sum()
        if both and nats > _SURE:
            return float(band), np.union1d(both, once).astype(int)
    return 0.0, np.zeros(0, int)


def _without_rails(x):
    """Counts x (n, c); a value that repeats at an end of the converter is replaced by the one before. Nothing
    is measured there, while a word that overflows keeps its noise."""
    same = np.diff(x, axis=0) == 0
    ends = np.isin(x, (0, FULL_SCALE))
    ends &= np.pad(same, ((1, 0), (0, 0))) | np.pad(same, ((0, 1), (0, 0)))
    return last_measured(x, ends)
