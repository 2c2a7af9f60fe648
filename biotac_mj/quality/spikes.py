"""Samples and rows that leave the trace and come back at once."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.stats import poisson

from .evidence import NAN, by_block, evidence
from .fault import Fault
from .log import Log
from .noise import ROUNDING, noise_level, running_median

__all__ = ["off_rows", "spikes"]

_FEW = 4  # channels of 19 that may leave at once for reasons of their own
_TIMES = 4  # samples of a channel that are more than chance
_ROWS = 7  # times the noise that all of these leave the trace by
# times the noise and a count, that a sample leaves the trace by; fraction of samples of real recordings that
# do
_FAR, _BY_ITSELF = 20.0, 3e-6
_RARE = 1e-5  # fraction of rows that leave the trace by chance
# channels that a cable may carry, and times as often as others such a channel leaves its trace: where more
# do, or others as often, their cause is one
_CABLE, _MORE = 3, 1.4
_TOGETHER = 0.5  # of the samples of each of two, in the same rows, from which on they have one cause
_OFTEN_EACH = 3  # of these of one channel at most, where any has them
_ADJACENT, _HELD = 0.1, 0.3  # of the samples that leave the trace, side by side, and where rows are repeated
_GONE = 100  # counts that most channels leave for a row: no load comes and goes like that
_MOST = 12  # channels of 19 that leave and come back at once: no touch is over after a row or two
_SPAN = 7  # rows of the median that is the trace


def spikes(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds spikes: single samples far from the trace of one channel, of several channels in the same row,
    or of any channel now and then. Channels that often leave their trace for longer are "contact"."""
    x, coarse = log.counts, np.zeros(log.channels)
    for f in faults:
        if f.step:
            coarse[list(f.channels)] = f.step
    bad = _outliers(x, coarse) & ~log.masked
    bad &= bad.sum(1, keepdims=True) <= max(1, log.some(_FEW))  # what all do at once is of no channel
    number = bad.sum(0)  # each is told by the samples beside it, whatever is fitted
    ordered = np.concatenate([np.zeros(_CABLE), np.sort(number)])
    off = np.abs(x - running_median(x, _SPAN, "mirror"))
    far = bad & (off > _FAR * (noise_level(x, least=ROUNDING) + 1))
    own = (far.sum(0) >= _TIMES) & (number > _MORE * (1 + ordered[-1 - _CABLE]))
    own &= (far.sum(0) >= _TIMES).sum() <= _CABLE
    found = []
    for alike in _together(bad):
        k = int(alike[0])
        if _in_a_row(log, bad[:, k]):
            if far[:, k].sum() >= _TIMES:
                found.append(_loose(log, k, bad[:, k]))
            continue
        mask = np.zeros(x.shape, bool)
        mask[:, alike] = bad[:, alike]
        message = (
            f"{number[k]} samples of {log.name(alike)} leave their neighbours by more than ten times the "
            f"noise, {'in the same rows' if len(alike) > 1 else 'one at a time'}"
        )
        one = _spikes(log, alike, mask, number[k], message, by_block(mask[:, k], _RARE))
        others = (
            1 if len(alike) > 1 else 1 + np.append(np.zeros(_CABLE), np.sort(np.delete(number, k)))[-_CABLE]
        )
        one.p = float(poisson.sf(number[k] - 1, others))
        one.features["alone"] = float(np.log(number[k] / others))
        if own[k]:
            _by_far(one, far[:, k], log)
        found.append(one)
    return found + _anywhere(log, far)


def _spikes(log, channels, mask, number, message, strength):
    """Samples, mask (n, c), so many of each channel."""
    rows = np.flatnonzero(mask.any(1))
    return Fault(
        "spikes",
        tuple(int(k) for k in channels),
        rows[0] / log.rate,
        rows[-1] / log.rate,
        message,
        {"rate": (float(number * log.rate / len(log) * 60), NAN, NAN)},
        mask,
        detector="single",
        **evidence(strength),
    )


def _loose(log, k, bad):
    """Channel k whose samples (n,) bool leave its trace for longer than a row."""
    rows = np.flatnonzero(bad)
    message = (
        f"{log.name([k])} leaves its trace {len(rows)} times, often for more than one row: no spikes are"
    )
    return Fault("contact", (k,), rows[0] / log.rate, rows[-1] / log.rate, message)


def _together(bad):
    """Channels with a few samples bad (n, c) bool, each with those whose are in the same rows: no sound
    sensor has such, so that these say nothing against each other. The most samples first."""
    number = bad.sum(0)
    near = maximum_filter1d(bad.astype(np.int8), 3, axis=0)
    fraction = bad.T.astype(float) @ near / np.maximum(number, 1)[:, None]
    alike = np.minimum(fraction, fraction.T) >= _TOGETHER
    unassigned, out = number >= _TIMES, []
    for k in np.argsort(-number, kind="stable"):
        if unassigned[k]:
            mine = [int(k), *(int(j) for j in np.flatnonzero(alike[k] & unassigned) if j != k)]
            unassigned[mine] = False
            out.append(tuple(mine))
    return out


def _in_a_row(log, bad):
    """Whether samples (n,) bool often stand side by side: a loose contact, or a word that overflows, leaves
    for longer than a sample. Rows that a logger repeats are one, where it does not repeat so many."""
    rows = np.flatnonzero(bad)
    fresh = np.unique(np.cumsum(~log.repeated)[rows])
    return any(
        np.count_nonzero(np.diff(at) == 1) > max(1, fraction * len(at))
        for at, fraction in ((fresh, _ADJACENT), (rows, _HELD))
    )


def _by_far(fault, far, log):
    """Samples far (n, ...) bool that no channel has by itself."""
    fault.p = min(fault.p, float(poisson.sf(far.sum() - 1, _BY_ITSELF * log.channels * len(far))))
    fault.detector = "far"


def _anywhere(log, far):
    """Samples far (n, c) bool of any channel, now and then: bits or words lost on the way, whosever they
    are."""
    number = far.sum(0)
    hit = np.flatnonzero(number)
    if len(hit) < _FEW or number.sum() > _OFTEN_EACH * len(hit):  # more are a fault of their channel
        return []
    message = (
        f"{number.sum()} samples of {log.name(hit)} leave their neighbours by more than {_FAR:.0f} times the "
        "noise, one at a time"
    )
    found = _spikes(log, hit, far, number.sum(), message, by_block(far.any(1), _RARE))
    found.p = 1.0
    _by_far(found, far, log)
    return [found]


def off_rows(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Rows that most channels leave at once and come back to, however often."""
    whole = _outliers(log.counts, np.zeros(log.channels), often=True).sum(1) >= max(2, log.some(_MOST))
    if not whole.any():
        return []
    mask = np.repeat(whole[:, None], log.channels, axis=1)
    message = f"{whole.sum()} rows leave their neighbours on most electrodes at once and come back"
    found = _spikes(log, range(log.channels), mask, whole.sum(), message, by_block(whole, _RARE))
    found.p = float(poisson.sf(whole.sum() - 1, _RARE * len(whole)))
    off = np.abs(log.counts - running_median(log.counts, _SPAN, "mirror"))[whole]
    found.detector = "gone" if np.median(off, axis=1).min() > _GONE else "rows"
    return [found]


def _outliers(x, coarse, often=False):
    """(n, c) bool of one or two samples that leave the trace and come back; coarse: (c,) step of codes.
    often: also where these are so frequent that they are most of what is around."""
    middle = running_median(x, _SPAN, "mirror")  # the first and the last row are one of seven, too
    off = np.abs(x - middle)
    padded = np.pad(middle, ((6, 6), (0, 0)), mode="edge")
    before, after = padded[:-12], padded[12:]
    noise, lively = noise_level(x, least=ROUNDING), np.minimum(off, 200)
    if often:
        noise = np.minimum(noise, np.maximum(1.6 * np.median(off, axis=0), ROUNDING))
    least = (_ROWS if often else 10) * noise + 4 * coarse
    if often:  # those that stand alone are none of what is around
        next_to = np.pad(off, ((1, 1), (0, 0)), mode="edge")
        lively = np.where((off > least) & (np.maximum(next_to[:-2], next_to[2:]) < 0.3 * off), 0, lively)
    around = uniform_filter1d(lively, 101, axis=0, mode="mirror")
    # lively stretches leave the median by more
    limit = np.maximum(least, 10 * around)
    return (off > limit) & (np.abs(before - after) < 0.3 * off)
