"""The size of the noise: electrodes that are noisier than the others, or all."""

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import norm

from .....quality.noise import sound_noise
from ....evidence import sign_flip
from ...confidence import NAMED, confidence
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS
from .differences import differences

__all__ = ["noisy"]

_FEWEST = 6  # blocks behind the time from which on noise is correlated
# logarithm of times the next quieter electrode that one, or each of a few, is noisier: 0.4 at most in real
# recordings whose noise is more than rounding
_APART = 0.2
_LOUDEST = 4  # electrodes that are noisier than the others by themselves, at most
_AUDIBLE = 1.5  # [counts] of noise, below which rounding makes electrodes differ by up to a logarithm of 0.9
# rows, and logarithm of how much farther an electrode goes to one side: 0.3 at most where noise was added, of
# whatever kind, 1.0 and more where a contact is loose
_AROUND, _ONE_SIDED = 51, 0.9
# logarithm of times the law by which all are noisier: 0.4 in a real sensor that is, 0.0 in the others
_ALL_LOUDER = 0.6
_SINCE = (0.0, 1 / 2, 3 / 4)  # of the rows fitted, that all are looked at in the rest of
_LOUD = 0.8  # quantile of an electrode's noise: a bad contact is loud for a third of the rows
_CLIP = 6.0  # times the law's noise, so that no outlier says what electrodes have in common
_OWN = 0.05  # of a channel's variance, that no other can know of


def noisy(session: Session) -> list[Finding]:
    """Electrodes whose noise is larger than the law says that the others follow, from the first row or from
    some time on; or all of them, where that is larger than any sensor's."""
    d, _ = differences(session)
    units = int(np.clip(len(d) // 12, 0, 4 * BLOCKS))
    # of values that are coarse, or held, what is left from row to row is no noise
    if units < BLOCKS or {f.id for f in session.findings} & {"quantise", "freeze"}:
        return []
    law = sound_noise(np.median(session.counts[session.fit], axis=0))
    k = len(d) // units
    known = np.isfinite(d[: k * units]).reshape(units, k, 19)
    cells = np.abs(_left_of_others(d / (law * np.sqrt(20)))[: k * units]).reshape(units, k, 19)
    # a channel masked throughout: no noise is seen; what comes and goes is in few of the samples, and a
    # single spike in fewer
    cells = np.where(known | ~known.any(1, keepdims=True), cells, np.nan)
    level = np.quantile(cells, _LOUD, axis=1)
    some = np.isnan(level)  # of these alone, since NumPy's without nan takes a fiftieth of the time
    level[some] = np.nanquantile(cells.swapaxes(1, 2)[some], _LOUD, axis=1) if some.any() else 0
    level /= norm.ppf(0.5 + _LOUD / 2)
    ratio = np.log(np.maximum(level, 0.3 / law))
    common = np.median(ratio, axis=1)
    ratio -= common[:, None]
    own = np.quantile(ratio, 0.85, axis=0)  # it may have begun, or end
    spread = 1.4826 * np.median(np.abs(own - np.median(own))) + 0.05
    ends = [f for f in session.findings if f.id == "stuck" or "rail" in f.clues]
    own[[k for f in ends for k in f.channels]] = 0  # little is left of them
    found, order = [], np.argsort(-own)
    quieter = _next_quieter(own[order])
    for e, least in zip(order[:_LOUDEST], quieter):
        # every recording has one that is the noisiest, but not by much
        apart, counts = own[e] - least, level[:, e] * law[e]
        if not (own[e] > np.log(1.6) and apart > _APART) or np.quantile(counts, 0.85) < _AUDIBLE:
            continue
        excess = ratio[:, e] - np.median(ratio, axis=1)
        since = max(range(units - _FEWEST + 1), key=lambda b: excess[b:].sum() / np.sqrt(units - b))
        p = sign_flip(excess[since:])
        if p > 0.01:
            continue
        factor, last = float(np.exp(own[e])), session.recording.time[session.fit][-1]
        finding = Finding(
            "noise",
            (int(e),),
            {"factor": (factor, *np.exp(np.quantile(ratio[since:, e], [0.1, 0.9])))},
            float(k * units * own[e] ** 2),
            p,
            float(last * since / units),
            session.recording.time[-1],
            note=f"{factor:.1f} times as noisy as the other electrodes' law says",
            clues={
                "apart": float(apart),
                "stands": float(own[e] / spread),
                "blocks": float(np.mean(excess > 0)),
                "counts": float(np.log(np.quantile(counts, 0.85))),
            },
        )
        side = _side(session, e)
        if abs(side) < _ONE_SIDED:
            found.append(finding)
        elif confidence(finding) >= NAMED:
            session.unnamed.append(
                f"e{e + 1} is again and again off to one side, {'above' if side > 0 else 'below'} what it "
                "reads around: no noise is"
            )
    known = session.recording.absolute and "common_noise" not in {f.id for f in session.findings}
    everyone = _all_noisy(session, common) if known else None
    return found if everyone is None else [*found, everyone]


def _all_noisy(session, ratio):
    """Noise of all electrodes, by the logarithm of times the law that the median one has, by unit (u,)."""
    # touches, and what else comes and goes, are in the others; it may have begun late, or grown
    first = [int(since * len(ratio)) for since in _SINCE]
    sizes = [float(np.quantile(ratio[i:], 0.3)) for i in first]
    loud = int(np.argmax(np.array(sizes) >= _ALL_LOUDER))
    size, ratio, since = sizes[loud], ratio[first[loud] :], _SINCE[loud]
    p = sign_flip(ratio - 0.5 * _ALL_LOUDER)
    if size < _ALL_LOUDER or p > 0.01:
        return None
    factor = float(np.exp(size))
    return Finding(
        "noise",
        tuple(range(19)),
        {"factor": (factor, *np.exp(np.quantile(ratio, [0.1, 0.9])))},
        float(len(ratio) * size**2),
        p,
        float(since * session.recording.time[session.fit][-1]),
        session.recording.time[-1],
        note=f"all electrodes are {factor:.1f} times as noisy as the law of sound sensors says",
        clues={"everyone": size - _ALL_LOUDER},
    )


def _side(session, e):
    """Logarithm of how much farther electrode e goes above what it reads around than below."""
    x = session.counts[session.fit & ~session.masked[:, e], e]
    low, middle, high = np.quantile(x - median_filter(x, _AROUND, mode="nearest"), [0.03, 0.5, 0.97])
    return float(np.log((high - middle + 0.5) / (middle - low + 0.5)))


def _next_quieter(own):
    """(_LOUDEST,) of electrodes (19,) in falling order: the noise of the loudest that is none of their group.
    Several may be noisy alike, so a group ends where the largest gap is."""
    gap = own[:_LOUDEST] - own[1 : _LOUDEST + 1]
    last = int(gap.argmax())
    return np.r_[np.full(last + 1, own[last + 1]), own[last + 2 : _LOUDEST + 1]]


def _left_of_others(d):
    """Differences d (n, 19) of noise of about unit size less what the others say of them: the load's part of
    what changes within rows, which a regression on channels with noise of their own leaves to the noise."""
    x = np.clip(np.nan_to_num(d), -_CLIP, _CLIP)
    P = np.linalg.inv(x.T @ x / len(x) + _OWN * np.eye(19))
    return np.nan_to_num(d) + x @ P / np.diag(P) - x
