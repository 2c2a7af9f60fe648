"""What is left once everything named is taken out: whether each electrode does what the others, and its own
earlier blocks, say it should."""

import dataclasses

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from ...recordings.recording import CLOCK_FAULT
from ..noise import noise_level, sound_noise
from .apart import SAID, noises
from .confidence import family, strange, unusual
from .findings import Finding
from .resting import STILL, moved, still
from .session import Session

__all__ = ["LIKELY", "UNKNOWN", "Rest", "left_of", "rest"]

# p up to which something is said to be there that has no name, so that few recordings without an effect are
# taken for one
UNKNOWN = 0.05
# logarithm of the power of the median electrode below 10 Hz over that of its noise, from which on something
# moves: 0.6 at most at rest and in grips, 2 or more in slides, touches and presses
_LIVELY = 1.0
# of a load that is too short to be told from drift: 3.3 at most in touches, 4.6 at least in presses
_SWINGS = 4.0
_LONGEST = 70.0  # [s] of the rows fitted, that practice has
_HAND = 2.0  # [Hz] below which a load may have a rhythm by itself
_RESOLVED = 1.0  # [counts] by which a rhythm moves an electrode at least
# of a name that is not given: more likely than not it is right, and if it is not, something else is there
LIKELY = 0.5
_ROUND = 0.2  # [counts] below which a noise is not told from rounding
_WINDOWS, _SHORT = 16, 60  # of noise whose size may change, and rows of each at least
_LEAST_OF, _LEAST_ROWS = 9, 200  # electrodes and rows, of which they are told apart
_MASKED = 0.2  # of an electrode's samples that may be no measurement
_SAID = 6  # things at most that are said of what is left
_P = 0.02  # of sign flips: more is no finding (`search.py`)
_FEW = 3  # samples that are sharp in a recording of any length
# rows within which a finger stands still before it is touched or after it is let go; of the noise, how far
# three electrodes move in a touch
_NEAR, _TOUCHED = 20, 10.0
# of sharp samples where no touch begins or ends: one, or this share of all, is chance; in one row a touch
# makes six at most (simulated), rows that are put together from elsewhere 16
_STRAY, _MANY = 0.01, 8


@dataclasses.dataclass
class Rest:
    """significant; text; kind of recordings that it is compared with (`confidence.json`); cells: dicts
    (channel, from, to, counts) of what departs, the largest first; clues: numbers that the decision is made
    of; p: share of real recordings without an effect that are as unusual, 0 where the clock is wrong, many
    electrodes drift, a name is likely, or something was seen for sure (`Session.unnamed`)."""

    significant: bool
    text: str
    kind: str
    cells: list
    clues: dict
    p: float


def rest(session: Session, weak: list[Finding], many: list[Finding]) -> Rest:
    """Compares what every electrode does with what the others say of it, in the rows fitted and in those
    kept aside.

    Args:
      weak: what was seen and not named, or contradicted; many: what is not named since too many electrodes
        have it.
    """
    clues, kind, said = left_of(session)
    p = unusual(clues, kind)
    text = "what each electrode does, the others and its own earlier blocks explain"
    faults = [w for w in session.recording.warnings if w.startswith(CLOCK_FAULT)] + session.unnamed
    if many:
        moved = ", ".join(f"e{k + 1}" for k in sorted({f.channels[0] for f in many}))
        faults.append(f"{moved} each drift or jump beside the load, more of them than faults of single ones")
    # a sensor that warms up a little is any sensor
    own = [f for f in weak if f not in many and family(f) != "shared"]
    likely = [f for f in own if f.confidence >= LIKELY and f.p < _P]
    if likely:
        most = max(likely, key=lambda f: f.confidence)
        where = "" if len(most.channels) > 12 else " " + ", ".join(f"e{k + 1}" for k in most.channels[:3])
        why = "too little to be named" if most.verified is not False else "but not in the part kept aside"
        faults.append(f"perhaps {most.kind.name}{where}, at {most.confidence:.2f} {why}")
    significant = p <= UNKNOWN or bool(faults)
    if significant:
        why = strange(clues, kind, UNKNOWN) if p <= UNKNOWN else []
        text = "; ".join(list(dict.fromkeys([*faults, *(said[k] for k in why)]))[:_SAID])
    return Rest(significant, text, kind, _where(session.model()), clues, 0.0 if faults else p)


def left_of(session: Session) -> tuple[dict, str, dict]:
    """Clues of what is left, the kind of recording that it is compared with, and what each clue says."""
    m = session.model()
    clues, said = _whole(session)
    # without a load, or where it is not told from a drift, something else is usual; what a few electrodes do
    # is no load
    kind = "moving" if clues["low"] > _LIVELY else "still"
    swings = m.moved and not m.parted and clues["low"] > _SWINGS
    kind = "left_" + ("loaded" if session.loaded else "short" if swings else kind)
    clues["seconds"] = float(np.log(min(m.time[m.inside][-1], _LONGEST)))
    own, words = _each(session)
    return clues | own, kind, said | words


def _each(session):
    """Clues of how far one electrode stands apart from the others, and what they say. Those that have a name
    of their own are not asked."""
    named = {k for f in session.findings if len(f.channels) <= 12 for k in f.channels}
    fresh, m = ~session.recording.repeated, session.model()
    used = [k for k in m.used if k not in named and session.masked[fresh, k].mean() < _MASKED]
    rows = np.flatnonzero(fresh & ~session.masked[:, used].any(1))
    if len(used) < _LEAST_OF or len(rows) < _LEAST_ROWS:
        return {}, {}
    place = np.isin(m.used, used)
    numbers = noises(session.counts[np.ix_(rows, used)])
    left, clues, said = np.abs(m.alone()[:, place]) * m.slope[place], {}, {}
    for name, value in numbers.items():
        most = int(value.argmax())
        clues[name] = float(value[most] - np.median(value))
        said[name] = (
            f"e{used[most] + 1} {SAID[name]} (up to {left[:, most].max():.0f} counts from what they say, at "
            f"{m.time[left[:, most].argmax()]:.0f} s)"
        )
    return clues, said


def _where(m):
    """Of the three electrodes that depart most from what the others say: when, and by how much."""
    cells, time = m.levels(m.alone(), every=True)
    counts = np.abs(cells) * m.slope
    out = []
    for i in np.argsort(-counts.max(0) / (m.activity + 2 * m.noise) / m.slope)[:3]:
        w = int(counts[:, i].argmax())
        first, last = time[max(w - 1, 0)], time[min(w + 1, len(time) - 1)]
        out.append({"channel": f"e{m.used[i] + 1}", "from": float(first), "to": float(last)})
        out[-1]["counts"] = float(counts[w, i])
    return out


_OF_ROWS = ("rhythm", "sharp", "again", "low", "swells")


def _whole(session):
    """Clues that no model of the load is needed for, of the recording less what was named: rhythms, sharp
    changes, rows that come again, and what is more than noise where noise is all there should be. And what
    they say, in words."""
    r = session.recording
    rows = np.flatnonzero(~r.repeated & ~session.masked.any(1))
    x, rate = session.counts[rows], r.rate * session.fresh
    if len(x) < 128:
        return dict.fromkeys(_OF_ROWS, 0.0), {}
    size = int(np.clip(2 ** round(np.log2(4 * rate)), 64, len(x) // 3))
    window = np.hanning(size)[:, None]
    line = np.vander(np.linspace(-1, 1, size), 2)
    project = line @ np.linalg.pinv(line)
    parts = [x[a : a + size] for a in range(0, len(x) - size + 1, size // 2)]
    power = np.mean([np.abs(np.fft.rfft((y - project @ y) * window, axis=0)) ** 2 for y in parts], axis=0)
    power += (window**2).sum() / 12  # rounding
    f = np.fft.rfftfreq(size, 1 / rate)
    around = median_filter(power, (2 * max(4, size // 32) + 1, 1), mode="nearest")
    slowest = _HAND if session.loaded else 0.5
    band = (f > max(slowest, 3 / size * rate)) & (f < 0.48 * rate)
    over = np.log(power / around)[band]
    beats = 2 * np.sqrt(power[band]) / window.sum()  # [counts]
    at = int(over.mean(1).argmax())
    low = np.log(power[(f > 0.5) & (f < 10)].mean(0) / power[f > 0.35 * rate].mean(0))
    # from one row to the next, more than noise and than the rows around
    step = np.abs(np.diff(x, axis=0))
    usual = uniform_filter1d(step, 21, axis=0)
    sharp = (step > 6 * noise_level(x) + 2) & (step > 5 * usual)
    # noise never comes again in all electrodes
    same = np.unique(np.ascontiguousarray(np.rint(x)), axis=0, return_counts=True)[1]
    live = np.median(noise_level(x)) > 1.0
    number = int(sharp.sum())
    # a hard touch is as sharp as what goes wrong, but a finger that stood still begins or ends to move there
    touch = _touched(x) & (sharp.sum(1) <= _MANY)
    if session.loaded and sharp[~touch].sum() <= max(1, _STRAY * number):
        sharp, number = np.zeros_like(sharp), 0
    most = np.argsort(-sharp.sum(0))[:2]
    said = {
        "rhythm": f"a rhythm of {f[band][at]:.1f} Hz and up to {beats[at].max():.0f} counts",
        "sharp": f"{number} samples change from one row to the next by more than noise and the rows around "
        f"do, most of {' and '.join(f'e{k + 1}' for k in most)}",
        "again": "rows come again, in all electrodes",
        "swells": "the noise of all electrodes grows and falls against the law of sound sensors",
    }
    return {
        "rhythm": float(over[at].mean()) if np.sort(beats[at])[-3] >= _RESOLVED else 0.0,
        "sharp": float(np.log(sharp.mean() * 1e4 + 1)) if number >= _FEW else 0.0,
        "again": float(np.log(1 + 100 * (same - 1).sum() / len(x))) if live else 0.0,
        "low": float(np.median(low)),
        "swells": _swells(x) if r.absolute else 0.0,  # the law is one of counts
    }, said


def _touched(x):
    """(n - 1,) whether a touch begins or ends between two rows of x (n, 19): at least three electrodes move
    there, and before it or after it nearly all stand still. What stands still on both sides and elsewhere
    than before was touched within few rows."""
    half = STILL // 2
    near = np.concatenate([[0], np.cumsum(still(x))])
    i, n = np.arange(len(x) - 1), len(x)
    before = near[np.clip(i - half, 1, n)] > near[np.clip(i - _NEAR, 0, n - 1)]
    after = near[np.clip(i + _NEAR, 1, n)] > near[np.clip(i + 1 + half, 0, n - 1)]
    far = moved(x, 2 * _NEAR + 1)[:-1] > _TOUCHED * noise_level(x) + 4
    return (before | after) & (far.sum(1) >= 3)


def _swells(x):
    """By how much the noise of most electrodes x (n, 19) changes over time against what the law says at their
    counts: a logarithm. What amplifies, bends, or smooths what is read does that to its noise, too."""
    size = max(_SHORT, len(x) // _WINDOWS)
    d = np.abs(np.diff(x, n=5, axis=0))
    ratio = []
    for first in range(0, len(d) - size + 1, size):
        noise = 1.4826 * np.median(d[first : first + size], axis=0) / np.sqrt(252)
        law = sound_noise(np.median(x[first : first + size], axis=0))
        ratio.append(np.median(np.log((noise + _ROUND) / (law + _ROUND))))
    return float(np.quantile(ratio, 0.9) - np.quantile(ratio, 0.1)) if ratio else 0.0
