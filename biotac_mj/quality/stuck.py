"""Constant channels: dead, stuck, or clipped at a limit of their range."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from ..sensor.channels import FULL_SCALE
from .evidence import by_block, evidence, runs, stretch
from .fault import Fault
from .log import Log
from .noise import sound_noise

_WINDOW = 12  # rows of a window that shows whether a channel has noise
_QUIET = 0.3  # of its usual noise: 3 of 1000 windows of a real sensor have less by chance
_FRACTION = 0.01  # of the rows
_BY_CHANCE = 0.003  # fraction of windows that are quiet by chance
# middle half of the channel's range; fraction of samples there that a low-pass makes constant: 0.45 to 0.61
# for low-passes of three authors, 0 at limits (34 channels of five authors)
_INNER, _FILTERED, _STAYS = 0.35, 0.2, 5
_BRIEF = 0.25  # [s]
_CHANCE = 12.0  # nats: one in 1e5
_STAYS_PUT = 0.8  # of the samples between the first and the last constant one
_ALIVE = 1.2  # [counts] of noise, four times that of rounding


def dead(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds channels that never change while others do, unless their values are coarse."""
    low, high = log.counts.min(0), log.counts.max(0)
    same = np.flatnonzero(low == high)
    coarse = {k for f in faults if f.step for k in f.channels}
    if len(log) < 2 or len(same) == log.channels:
        return []
    found = []
    for k in [k for k in same if k not in coarse]:
        mask = np.zeros(log.counts.shape, bool)
        mask[:, k] = True
        value, end = float(low[k]), (len(log) - 1) / log.rate
        message = f"{log.name([k])} never changes: is it dead? Models that use it are wrong there"
        level = {"value": (value, value, value)}
        found.append(Fault("stuck", (int(k),), 0.0, end, message, level, mask, silent=True, detector="dead"))
    return found


def stuck_or_clipped(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds channels that are constant for a time; a live one has noise in every row. A channel that returns
    again and again to a limit of its range is clipped, others are stuck."""
    known = {k for f in faults if f.step or f.silent for k in f.channels}
    rows = np.flatnonzero(~log.masked.all(1) & ~log.repeated)  # repeated rows are constant anyway
    if len(rows) < 4 * _WINDOW:
        return []
    quiet = _quiet(log, rows)
    fraction = quiet.mean(0)
    fraction[[k for f in faults if f.silent for k in f.channels]] = 0.0
    ordered = np.concatenate([np.zeros(3), np.sort(fraction)])
    # several constant channels at a time have a common cause, unless each is at its limit
    single = fraction > np.maximum(_FRACTION, 6 * ordered[-3])
    limited = fraction > np.maximum(_FRACTION, 6 * ordered[-1 - max(1, log.some(8))])
    # a row that repeats another has the same state
    before = np.maximum(np.searchsorted(rows, np.arange(len(log)), "right") - 1, 0)
    sure = _long_constant(log, log.read[rows])[before]
    found = []
    for k in np.flatnonzero(single | limited | sure.any(0)):
        if k not in known:
            at = np.pad(quiet[:, k] & (single | limited)[k], 1)
            some = _constant_faults(log, int(k), at[before] | sure[:, k], sure[:, k])
            found += [f for f in some if single[k] or f.beyond or sure[:, k].any()]
    return found


def _long_constant(log, x):
    """(n, c) bool: samples of x (n, c) that repeat longer than chance allows. If a step is zero with
    probability q, runs of m steps have probability q^m, and the longest in n rows is about log n / -log q. q
    comes from the channel's second longest run and those of all other channels but one."""
    out, found = np.zeros(x.shape, bool), [runs(c) for c in (np.diff(x, axis=0) == 0).T]
    longest = np.array([np.sort(np.r_[0, 0, length])[-2:] for _, length in found])
    for k, (start, length) in enumerate(found):
        others = np.sort(np.r_[0, 0, np.delete(longest[:, 1], k)])[-2]
        nats = length * np.log(len(x)) / max(others, longest[k, 0], 1)
        sure = (nats > _CHANCE + np.log(x.size)) & (length >= _BRIEF * log.rate)
        for a, n in zip(start[sure], length[sure]):
            out[a : a + n + 1, k] = True
    return out


def _quiet(log, rows):
    """(n - 2, c) bool: windows of rows (n,) in which a channel has no noise. Hum does not count as noise, but
    a constant channel has no hum either."""
    x, law, size = log.read[rows], *_noise(log.counts[rows])
    lively = size > 0.2 * np.quantile(size, 0.9, axis=0)
    usual, loud = (  # NaN where none is lively
        np.ma.median(np.ma.masked_array(values, ~lively), axis=0).filled(np.nan) for values in (size, law)
    )
    law, size = _noise(x)
    noisy = usual[~np.isnan(usual)]
    others = np.median(noisy) if noisy.size else 0.0  # of a log in which nothing has noise
    # ignore spikes, bursts, and channels that jittered from the start
    usual = np.where(usual > _QUIET * others, np.minimum(usual, others), others)
    # without noise a constant reading is no evidence
    alive = usual * np.where(np.isnan(loud), np.median(law, axis=0), loud) > _ALIVE
    # at an end of the converter nothing is measured, with any noise
    railed = minimum_filter1d(np.isin(x, (0, FULL_SCALE)).astype(np.int8), _WINDOW, axis=0)[1:-1] > 0
    return (size < _QUIET * usual) & alive | railed & log.converter


def _noise(x):
    """Noise of a healthy channel, and noise of windows of x (n, c) in units of it: (n - 2, c) each."""
    bend = np.minimum(np.diff(x, n=2, axis=0) ** 2 / 6, 1e4)
    law = sound_noise(uniform_filter1d(x, _WINDOW, axis=0)[1:-1])
    return law, np.sqrt(np.maximum(uniform_filter1d(bend, _WINDOW, axis=0), 0)) / law


def _constant_faults(log, k, still, sure):
    """Faults of channel k that is constant in samples still (n,) bool, and certainly in samples sure (n,)
    bool."""
    whole, found = log.read[:, k], []
    moving = ~still & ~log.masked.all(1)
    start, length = runs(still)
    values = np.array([np.median(whole[a : a + n]) for a, n in zip(start, length)])
    on = np.flatnonzero(still)
    first = on[len(on) // 20]  # a limit may begin late, and a window may be quiet by chance
    if moving[first:].sum() > 0.2 * len(on):
        moving[:first] = False
    # range of the channel while it moves: hardly anything lies beyond a limit
    ever = _moving_range(whole[~still & ~log.masked.all(1)])
    ends = _moving_range(whole[moving])
    inner = np.abs(whole - ends.mean()) < _INNER * np.ptp(ends)
    between = np.abs(values - ends.mean()) < _INNER * np.ptp(ends)
    if between.sum() > _STAYS and np.ptp(values[between]) > _INNER * np.ptp(ends):
        if still[inner].mean() > _FILTERED:
            return []
    stays = still[on[0] : on[-1] + 1].mean() > _STAYS_PUT
    low, high = _at_ends(values, ends)
    left = np.ones(len(values), bool)
    for side, mine in ((-1, low), (1, high), (0, left)):
        if side < 0 and not log.signed:  # its baseline
            continue
        if side and (mine.sum() < 2 or np.ptp(ends) < 20 * _ALIVE):
            continue
        if not side and found:  # beside limits, what no chance makes
            mine = left & [sure[a : a + n].any() for a, n in zip(start, length)]
        if not side and length[mine].max(initial=0) < _BRIEF * log.rate:
            continue
        one = _constant_fault(log, k, side, values[mine], start[mine], length[mine])
        if (one.mask[:, k] & sure).any():
            one.p = min(one.p, float(np.exp(-_CHANCE)))
        if not side and max(np.ptp(ends), np.ptp(ever)) >= 20 * _ALIVE:
            if any(at.all() for at in (low, high, *_at_ends(values, ever))):
                one.ties = ("saturate",)  # a single stay at a limit
        left = left & ~mine
        found.append(_with_ties(one, mine.sum(), stays))
    return found


def _with_ties(fault, number, stays):
    """A fault of a channel that is constant so often, or most of the time, and what it may be instead."""
    if number > 8 and not stays:  # it moves in between: it does not respond there
        fault.ties = ("gain",) if fault.beyond else ("gain", "saturate")
    if fault.detector == "rail":  # a response of the wrong sign also drives levels to the converter's end
        fault.ties = (*fault.ties, "flip")
    return fault


def _moving_range(moving):
    """Range of a channel's samples (n,), without a few outliers."""
    return np.quantile(moving, [0.03, 0.97]) if len(moving) else np.array([np.inf, -np.inf])


def _at_ends(values, ends):
    """Masks of values (k,) at or beyond the lower and the upper of two ends. Values far beyond the range are
    no limit."""
    near = np.abs(values - np.clip(values, *ends)) < np.ptp(ends)
    return near & (values <= ends[0] + 3), near & (values >= ends[1] - 3)


def _constant_fault(log, k, side, values, start, length):
    """Fault of channel k, constant at some values in runs: side 1 at its upper limit, -1 at its lower, 0
    anywhere."""
    mask = np.zeros(log.counts.shape, bool)
    for a, n in zip(start, length):
        mask[a : a + n, k] = True
    flags, value = mask[:, k], float(np.median(values))
    spread = float(np.ptp(values)) / 2 + 0.5
    place = {1: ", the upper end of what it reads", -1: ", the lower end of what it reads", 0: ""}[side]
    rows = np.flatnonzero(flags)
    found = Fault(
        "saturate" if side else "stuck",
        (k,),
        rows[0] / log.rate,
        rows[-1] / log.rate,
        f"{log.name([k])} is constant at {value:.0f} counts in {flags.mean():.1%} of the samples{place}",
        {"level" if side else "value": (value, value - spread, value + spread)},
        mask,
        beyond=side,
        silent=not side,
        detector="limit" if side else "still",
        **evidence(by_block(stretch(flags), _BY_CHANCE)),
    )
    found.features |= {"runs": float(np.log(len(values)))}
    if side and value in (0, FULL_SCALE) and log.converter:
        found.detector = "rail"
    found.p = 0.5 ** int(max(len(values), flags.sum() // _WINDOW))
    return found
