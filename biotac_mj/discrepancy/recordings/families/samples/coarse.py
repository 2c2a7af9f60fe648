"""Values that are coarse: of the codes that noise should visit some are left out, from the first row or from
some time on."""

import numpy as np

from .....quality.noise import sound_noise
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from .faults import fault

__all__ = ["coarse", "quantised"]

_FEW = 4  # electrodes that may jump for reasons of their own
# visits of a code, of whose neighbours one in a hundred is then missed by chance
_OFTEN = 5
_CUT, _CODES = 4, 16  # step and codes at least of one channel that is coarse alone
_LATER = 0.1  # of the rows, that are coarse at least where not all are
_CHANCE = 12.0  # nats: one in 1e5


def quantised(session: Session) -> list[Finding]:
    """Coarse channels: of the codes that their noise should visit they leave out some, lattice or not."""
    x = session.recording.electrodes[session.fit]
    if np.any(x != np.rint(x)):
        return []
    x = x.astype(int)
    blocks = np.array_split(x, BLOCKS)
    lattice = np.array([_lattice([c]) for c in x.T])
    lattice = np.maximum(lattice, _lattice(x.T))  # where each takes too few values
    step = np.where(lattice > 1, lattice, [_spacing(c) for c in x.T])
    coarse, told = np.flatnonzero(step >= 2), np.isfinite(step)
    # levels that lie far apart look alike, but are no multiples of anything
    if 1 < len(coarse) < 0.5 * told.sum():
        coarse = np.flatnonzero(lattice > 1)
    if len(coarse) == 1:  # one converter reads all, but a channel's word may be cut
        codes = len(np.unique(x[:, coarse[0]]))
        coarse = coarse[(lattice[coarse] >= _CUT) & (codes >= _CODES)]
    if not len(coarse):
        return _coarse_since(session)
    q = float(np.median(step[coarse]))
    # of codes that noise takes it to by chance every q-th would be one of these
    strength = [np.log(q) * np.count_nonzero(np.diff(b[:, coarse], axis=0)) for b in blocks]
    channels = range(19) if len(coarse) > 0.75 * told.sum() else coarse
    found = fault(
        session,
        "quantise",
        channels,
        {"step": (q, q, q)},
        None,
        f"of the codes among those visited often only one in {q:.3g} is ever read",
        strength,
        BLOCKS,
    )
    if len(coarse) == 1:
        found.clues["cut"] = 1.0
    return [found]


def _coarse_since(session):
    """All channels or some that are coarse from some row on: the largest number that all differences from the
    last row have in common, back to where they no longer have one. Codes say so themselves, also in rows kept
    aside."""
    x = session.recording.electrodes
    if np.any(x != np.rint(x)):
        return []
    off = np.abs(x.astype(int) - x[-1].astype(int))[::-1]
    long, q, sure = _common(np.gcd.reduce(off, axis=1), off)
    if sure and (np.ptp(off[:long], axis=0) > 0).sum() > _FEW:
        channels = np.arange(19)
    else:
        each = [_common(off[:, k], off[:, [k]]) for k in range(19)]
        channels = np.array([k for k, (_, step, sure) in enumerate(each) if sure and step >= _CUT], int)
        if not len(channels):
            return []
        long, q = max(each[k][0] for k in channels), float(np.median([each[k][1] for k in channels]))
    parts = np.array_split(off[:long][:, channels], BLOCKS)
    since = (len(x) - long) / session.recording.rate
    found = fault(
        session,
        "quantise",
        channels,
        {"step": (q, q, q)},
        None,
        f"from {since:.1f} s on values are multiples of {q:.3g} apart",
        [np.log(q) * np.count_nonzero(np.diff(part, axis=0)) for part in parts],
        BLOCKS,
    )
    found.start = since
    found.p = min(found.p, float(np.exp(-2 * _CHANCE)))
    if len(channels) == 1:
        found.clues["cut"] = 1.0
    return [found]


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


def coarse(session: Session) -> bool:
    """Whether most channels are so coarse that noise seldom takes them from one code to another."""
    noise = sound_noise(np.median(session.recording.electrodes[session.fit], axis=0))
    return any(
        f.id == "quantise" and len(f.channels) > 9 and f.parameters["step"][0] > 2 * np.median(noise)
        for f in session.findings
    )
