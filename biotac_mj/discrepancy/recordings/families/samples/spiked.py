"""Samples and rows that leave the trace and come back at once."""

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.stats import poisson

from .....quality.noise import ROUNDING, noise_level, running_median
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from .faults import by_block, fault

__all__ = ["off_rows", "spiked"]

_NAN = float("nan")
_FEW = 4  # electrodes that may jump for reasons of their own
_ROWS = 7  # times the noise that all of these leave the trace by
# times the noise and a count, that a sample leaves the trace by; share of samples of real recordings that do
_FAR, _BY_ITSELF = 20.0, 3e-6
# electrodes that a cable may carry, and times as often as others such an electrode leaves its trace: where
# more do, or others as often, their cause is one
_CABLE, _MORE = 3, 1.4
_TOGETHER = 0.5  # of the samples of each of two, in the same rows, from which on they have one cause
_OFTEN_EACH = 3  # of these of one electrode at most, where any has them
_BESIDE, _HELD = 0.1, 0.3  # of the samples that leave the trace, side by side, and where rows are repeated
_GONE = 100  # counts that most electrodes leave for a row: no load comes and goes like that
_MOST = 12  # electrodes that leave and come back at once: no touch is over after a row or two


def spiked(session: Session) -> list[Finding]:
    """Samples of an electrode that leave its trace, or of some in the same rows, or of any, now and then,
    that are far off."""
    x = session.recording.electrodes
    coarse = np.zeros(19)
    for f in session.findings:
        if f.id == "quantise":
            coarse[list(f.channels)] = f.parameters["step"][0]
    bad = _outliers(x, coarse) & ~session.masked
    bad &= bad.sum(1, keepdims=True) <= _FEW  # what all do at once is of no channel
    number = bad.sum(0)  # each is told by the samples beside it, whatever is fitted
    off = np.abs(x - running_median(x, 7, "mirror"))
    far = bad & (off > _FAR * (noise_level(x, least=ROUNDING) + 1))
    own = (far.sum(0) >= _FEW) & (number > _MORE * (1 + np.sort(number)[-1 - _CABLE]))
    own &= (far.sum(0) >= _FEW).sum() <= _CABLE
    minutes = len(x) / session.recording.rate / 60
    found = []
    for alike in _together(bad):
        k = int(alike[0])
        if _in_a_row(session, bad[:, k]):
            if far[:, k].sum() >= _FEW:
                session.unnamed.append(
                    f"e{k + 1} leaves its trace {number[k]} times, often for more than one row: no spikes are"
                )
            continue
        mask = np.zeros(x.shape, bool)
        mask[:, alike] = bad[:, alike]
        rate = float(number[k] / minutes)
        found.append(
            fault(
                session,
                "spikes",
                alike,
                {"rate": (rate, _NAN, _NAN)},
                mask,
                f"{number[k]} samples leave their neighbours by more than ten times the noise"
                + ", in the same rows" * (len(alike) > 1),
                by_block(mask[:, k], 1e-5),
                BLOCKS,
            )
        )
        others = 1 if len(alike) > 1 else 1 + np.sort(np.delete(number, k))[-_CABLE]
        found[-1].p = float(poisson.sf(number[k] - 1, others))
        found[-1].clues["alone"] = float(np.log(number[k] / others))
        if own[k]:
            _by_far(found[-1], far[:, k])
    return found + _anywhere(session, far)


def _together(bad):
    """Electrodes with a few samples bad (n, 19) bool, each with those whose are in the same rows: no sound
    sensor has such, so that these say nothing against each other. The most samples first."""
    number = bad.sum(0)
    near = maximum_filter1d(bad.astype(np.int8), 3, axis=0)
    share = bad.T.astype(float) @ near / np.maximum(number, 1)[:, None]
    alike = np.minimum(share, share.T) >= _TOGETHER
    left, out = number >= _FEW, []
    for k in np.argsort(-number, kind="stable"):
        if left[k]:
            mine = [int(k), *(int(j) for j in np.flatnonzero(alike[k] & left) if j != k)]
            left[mine] = False
            out.append(tuple(mine))
    return out


def _in_a_row(session, bad):
    """Whether samples (n,) bool often stand side by side: a loose contact, or a word that overflows, leaves
    for longer than a sample. Rows that a logger repeats are one, where it does not repeat so many."""
    rows = np.flatnonzero(bad)
    fresh = np.unique(np.cumsum(~session.recording.repeated)[rows])
    return any(
        np.count_nonzero(np.diff(at) == 1) > max(1, share * len(at))
        for at, share in ((fresh, _BESIDE), (rows, _HELD))
    )


def _by_far(finding, far):
    """Samples far (n, ...) bool that no electrode has by itself."""
    finding.p = min(finding.p, float(poisson.sf(far.sum() - 1, _BY_ITSELF * 19 * len(far))))
    finding.clues["far"] = float(np.log(far.sum()))


def _anywhere(session, far):
    """Samples far (n, 19) bool of any electrode, now and then: bits or words lost on the way, whosever they
    are."""
    number = far.sum(0)
    hit = np.flatnonzero(number)
    if len(hit) < _FEW or number.sum() > _OFTEN_EACH * len(hit):  # more are a fault of their electrode
        return []
    rate = float(number.sum() * session.recording.rate / len(far) * 60)
    found = fault(
        session,
        "spikes",
        hit,
        {"rate": (rate, _NAN, _NAN)},
        far,
        f"{number.sum()} samples of {len(hit)} electrodes leave their neighbours by more than {_FAR:.0f} "
        "times the noise, one at a time",
        by_block(far.any(1), 1e-5),
        BLOCKS,
    )
    found.p = 1.0
    _by_far(found, far)
    return [found]


def off_rows(session: Session) -> list[Finding]:
    """Rows that most electrodes leave at once and come back to, however often."""
    x = session.recording.electrodes
    off = _outliers(x, np.zeros(19), often=True).sum(1) >= _MOST
    return _whole_rows(session, off) if off.any() else []


def _whole_rows(session, whole):
    """Rows (n,) bool that are no measurement, on any electrode."""
    rate = session.recording.rate
    mask = np.repeat(whole[:, None], 19, axis=1)
    f = fault(
        session,
        "spikes",
        range(19),
        {"rate": (float(whole.sum() * rate / len(whole) * 60), _NAN, _NAN)},
        mask,
        f"{whole.sum()} rows leave their neighbours on most electrodes at once and come back",
        by_block(whole, 1e-5),
        BLOCKS,
    )
    f.p = float(poisson.sf(whole.sum() - 1, 1e-5 * len(whole)))
    f.clues["rows"] = float(np.log(whole.sum()))
    x = session.recording.electrodes
    off = np.abs(x - running_median(x, 7, "mirror"))[whole]
    if np.median(off, axis=1).min() > _GONE:
        f.clues["gone"] = 1.0
    return [f]


def _outliers(x, coarse, often=False):
    """(n, 19) bool of one or two samples that leave the trace and come back; coarse: (19,) step of codes.
    often: also where these are so frequent that they are most of what is around."""
    middle = running_median(x, 7, "mirror")  # the first and the last row are one of seven, too
    off = np.abs(x - middle)
    beside = np.pad(middle, ((6, 6), (0, 0)), mode="edge")
    before, after = beside[:-12], beside[12:]
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
