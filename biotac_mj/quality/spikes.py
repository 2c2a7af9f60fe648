"""Single samples and rows that leave the signal and return at once."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import poisson

from .evidence import NAN, by_block, evidence
from .fault import Fault
from .log import Log
from .noise import ROUNDING, noise_level, running_median

_FEW = 4  # channels of 19 that may leave at once for other reasons
_TIMES = 4  # samples of a channel, more than chance explains
_ROWS = 7  # times the noise, distance of all of these from the signal
_FAR = 20.0  # times the noise plus one count, distance of a sample of a loose contact from the signal
_RARE = 1e-5  # fraction of such rows by chance
_MOVED = 5.0  # times the noise, by which a channel that is touched leaves its running median
_CABLE = 3  # channels that one cable may affect: if more have as many spikes, the cause is a common one
_ADJACENT, _REPEATED = 0.1, 0.3  # fraction of outliers side by side, without and with repeated rows
_GONE = 100  # [counts] by which most channels leave for a row: no load does that
_MOST = 12  # channels of 19 that leave and return at once: no touch lasts one or two rows
_SPAN = 7  # rows of the running median


def spikes(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds channels with single samples far from the signal. Those that often leave for longer have the
    fault "contact"."""
    x, coarse = log.counts, np.zeros(log.channels)
    for f in faults:
        if f.step:
            coarse[list(f.channels)] = f.step
    bad = _outliers(x, coarse) & ~log.masked & ~log.touched[:, None]
    bad &= bad.sum(1, keepdims=True) <= max(1, log.some(_FEW))  # an event of all has another cause
    off, noise = np.abs(x - running_median(x, _SPAN, "mirror")), noise_level(x, least=ROUNDING)
    # a touch moves others as well: so what a channel does mostly in their company is none of its own
    single = bad & ((off > _MOVED * noise).sum(1, keepdims=True) <= _CABLE)
    bad = np.where(single.sum(0) > 0.5 * bad.sum(0), bad, False)
    number = bad.sum(0)
    far = bad & (off > _FAR * (noise + 1))
    found = []
    for k in np.argsort(-number, kind="stable")[: np.count_nonzero(number >= _TIMES)]:
        if _consecutive(log, bad[:, k]):
            if far[:, k].sum() >= _TIMES:
                found.append(_loose_contact(log, int(k), bad[:, k]))
            continue
        mask = np.zeros(x.shape, bool)
        mask[:, k] = bad[:, k]
        message = (
            f"{number[k]} samples of {log.name([k])} leave their neighbours by more than ten times the "
            "noise, one at a time"
        )
        one = _spikes(log, [k], mask, number[k], message, by_block(mask[:, k], _RARE))
        # one cable may have several channels: as many more must have fewer
        others = 1 + np.append(np.zeros(_CABLE), np.sort(np.delete(number, k)))[-_CABLE]
        one.p = float(poisson.sf(number[k] - 1, others))
        one.features["isolation"] = float(np.log(number[k] / others))
        found.append(one)
    return found


def _spikes(log, channels, mask, number, message, strength):
    """Fault of samples mask (n, c), number (c,) per channel."""
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


def _loose_contact(log, k, bad):
    """Fault of channel k, whose samples bad (n,) leave the signal for more than one row."""
    rows = np.flatnonzero(bad)
    message = (
        f"{log.name([k])} jumps away and returns {len(rows)} times, often for more than one row: spikes last "
        "one row, look for a loose contact"
    )
    return Fault("contact", (k,), rows[0] / log.rate, rows[-1] / log.rate, message)


def _consecutive(log, bad):
    """Whether outliers (n,) bool are often consecutive: a loose contact or an overflow lasts longer than a
    sample. Rows that the logger repeats count as one, unless too many repeat."""
    rows = np.flatnonzero(bad)
    fresh = np.unique(np.cumsum(~log.repeated)[rows])
    return any(
        np.count_nonzero(np.diff(at) == 1) > max(1, fraction * len(at))
        for at, fraction in ((fresh, _ADJACENT), (rows, _REPEATED))
    )


def off_rows(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds rows that most channels leave at once and return to, at any rate."""
    whole = _outliers(log.counts, np.zeros(log.channels), often=True).sum(1) >= max(2, log.some(_MOST))
    whole &= ~log.touched
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
    """(n, c) bool, one or two samples that leave the signal and return. coarse: (c,) step of codes. often:
    also finds those that are frequent in their neighbourhood."""
    middle = running_median(x, _SPAN, "mirror")  # the first and the last row also have seven
    off = np.abs(x - middle)
    padded = np.pad(middle, ((6, 6), (0, 0)), mode="edge")
    before, after = padded[:-12], padded[12:]
    noise, lively = noise_level(x, least=ROUNDING), np.minimum(off, 200)
    if often:
        noise = np.minimum(noise, np.maximum(1.6 * np.median(off, axis=0), ROUNDING))
    least = (_ROWS if often else 10) * noise + 4 * coarse
    if often:  # exclude single outliers from the neighbourhood's scale
        next_to = np.pad(off, ((1, 1), (0, 0)), mode="edge")
        lively = np.where((off > least) & (np.maximum(next_to[:-2], next_to[2:]) < 0.3 * off), 0, lively)
    around = uniform_filter1d(lively, 101, axis=0, mode="mirror")
    # active segments deviate more from the median
    limit = np.maximum(least, 10 * around)
    return (off > limit) & (np.abs(before - after) < 0.3 * off)
