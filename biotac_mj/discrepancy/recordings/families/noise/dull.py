"""Electrodes whose noise a filter takes away: far less is left at the highest frequencies than the others
have beside the law, and less there than below. No load does that, so it needs no model of the load."""

import numpy as np

from .....quality.noise import sound_noise
from ....evidence import sign_flip
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from ..levels.together import MOST

__all__ = ["dulled"]

_SIZE = 64  # rows of a spectrum
_LOUD = 1e12  # that masked ones are taken for, so that they are not missed
_BANDS = (0.16, 0.27), (0.38, 0.5)  # of the rate: above the load's, and the highest
_AUDIBLE = 1.2  # [counts] of noise that an electrode would have, below which rounding is most of it
_LEAST = 0.7  # logarithm of noise that is missing, from which on it is looked at
_SINCE = (0.0, 1 / 2, 5 / 8)  # of the rows fitted, that it is looked for in the rest of
_AS_MUCH = 0.8  # of the most that is missing in any of these: it was there as early


def dulled(session: Session) -> Finding | None:
    """The electrodes that are filtered, from the first row on or since some time."""
    rows = np.flatnonzero(session.fit & ~session.recording.repeated)
    x, masked = session.counts[rows], session.masked[rows]
    starts = np.arange(0, len(x) - _SIZE + 1, _SIZE // 2)
    if len(starts) < BLOCKS or any(f.id in ("quantise", "freeze", "lowpass") for f in session.findings):
        return None
    window = np.hanning(_SIZE)[:, None]
    line = np.vander(np.linspace(-1, 1, _SIZE), 3)
    project = line @ np.linalg.pinv(line)
    parts = np.stack([x[a : a + _SIZE] - project @ x[a : a + _SIZE] for a in starts]) * window
    power = np.abs(np.fft.rfft(parts, axis=1)) ** 2
    power = np.where(np.stack([masked[a : a + _SIZE].any(0) for a in starts])[:, None], _LOUD, power)
    f, white = np.fft.rfftfreq(_SIZE), (window**2).sum()
    cells = np.array_split(np.arange(len(starts)), BLOCKS)
    middle, high = (
        np.stack([np.median(power[cell][:, (f >= a) & (f <= b)], axis=(0, 1)) for cell in cells])
        for a, b in _BANDS
    )
    least = white / 40  # of what rounding makes, a third
    law = sound_noise(np.median(x, axis=0))
    missing = np.log(law / np.sqrt(np.maximum(high, least) / white / np.log(2)))  # of a spectrum's median
    common = np.median(missing, axis=1, keepdims=True)
    own = np.where(law * np.exp(-common) > _AUDIBLE, missing - common, 0.0)
    first = [int(since * BLOCKS) for since in _SINCE]
    sizes = np.stack([np.median(own[i:], axis=0) for i in first])
    which = int(np.argmax(sizes.max(1) >= _AS_MUCH * sizes.max()))
    size, since = sizes[which], first[which]
    order = np.argsort(-size)
    gap = size[order[:MOST]] - size[order[1 : MOST + 1]]
    last = int(gap.argmax())
    channels = tuple(sorted(int(k) for k in order[: last + 1]))
    if size[order[last]] < _LEAST:
        return None
    k = int(order[0])
    ratio = np.log(np.maximum(middle, least) / np.maximum(high, least))[since:, k]
    rate, end = session.recording.rate * session.fresh, session.recording.time[session.fit][-1]
    # of white noise a first-order filter leaves a / (2 tau rate)
    sizes = (size[k], *np.quantile(own[since:, k], [0.1, 0.9]))
    tau, low, high = (0.5 * float(np.exp(2 * s)) / rate for s in sizes)
    who = ", ".join(f"e{c + 1}" for c in channels)
    return Finding(
        "lowpass",
        channels,
        {"tau": (tau, low, high)},
        float(BLOCKS * size[k]),
        sign_flip(own[since:, k] - 0.5 * _LEAST),
        float(end * since / BLOCKS),
        session.recording.time[-1],
        note=f"the noise of {who} is {np.exp(size[order[last]]):.1f} times smaller or more than the others' "
        "is beside the law",
        clues={"dull": float(gap[last]), "falls": float(np.median(ratio))},
    )
