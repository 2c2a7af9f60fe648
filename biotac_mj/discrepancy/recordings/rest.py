"""What is left once everything named is taken out: whether each electrode does what the others, and its own
earlier blocks, say it should."""

import dataclasses

import numpy as np
from scipy.ndimage import uniform_filter1d

from ...quality.clock import CLOCK_FAULT
from ...quality.noise import noise_level, running_median, sound_noise
from .apart import apart
from .candidates import Candidate
from .confidence import family, strange, unusual
from .recording import MIN_ROWS
from .resting import STILL, moved, still
from .session import Session

__all__ = ["LIKELY", "UNKNOWN", "Rest", "rest"]

# p up to which something is said to be there that has no name, so that few recordings without an effect are
# taken for one
UNKNOWN = {"left_loaded": 0.1, "left_short": 0.1, "left_moving": 0.1, "left_still": 0.1}
# logarithm of the power of the median electrode below 10 Hz over that of its noise, from which on something
# moves: 0.6 at most at rest and in grips, 2 or more in slides, touches and presses
_LIVELY = 1.0
# of a load that is too short to be told from drift: 3.3 at most in touches, 4.6 at least in presses
_SWINGS = 4.0
_RESOLVED = 1.0  # [counts] by which an electrode departs at least, or a rhythm moves it
# of a name that is not given: more likely than not it is right, and if it is not, something else is there
LIKELY = 0.5
_ROUND = 0.2  # [counts] below which a noise is not told from rounding
_WINDOWS, _SHORT = 16, 60  # of noise whose size may change, and rows of each at least
# windows on either side of a change of one electrode's noise; its size: logarithm against the other
# electrodes (0.7 at most in pieces of 13 s and more of two pressed sensors and an unloaded one), and counts
# (noise of less than a count is rounded: 1.7 in grips)
_SPLIT, _LOUDER, _LOUD = 3, 1.0, 4.0
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


def rest(session: Session, weak: list[Candidate], many: list[Candidate]) -> Rest:
    """Compares what every electrode does with what the others say of it, in the rows fitted and in those
    kept aside, in units of what the load does to it.

    Args:
      weak: what was seen and not named, or contradicted; many: what is not named since too many electrodes
        have it.
    """
    m = session.model()
    residual = m.alone()
    cells, time = m.levels(residual, every=True)
    inside = time < m.time[m.inside][-1]
    change = m.activity + 2 * m.noise
    counts = np.abs(cells) * m.slope

    def size(x):
        return np.sqrt((x**2).mean(0)) / change

    parts = {"fast": size(residual[m.inside]), "level": size(cells[inside]), "aside": size(cells[~inside])}
    parts["counts"] = parts["level"] * change * m.slope
    clues = {}
    for name, value in parts.items():
        ordered = np.sort(value)
        clues |= {f"{name}{n}": float(np.log(ordered[-n])) for n in (1, 3)}
        clues[name] = float(np.log(np.median(value)))
    # what was seen and could not be named
    seen = [f.clues for f in weak if len(f.channels) == 1 and "nats" in f.clues and f.p < _P]
    clues["seen"] = max((c["nats"] for c in seen), default=0.0)
    clues["number"] = float(np.log1p(len(seen)))
    clues["stands"] = max((c.get("stands", 0.0) for c in seen), default=0.0)
    clues["seconds"] = float(np.log(m.time[m.inside][-1]))
    whole, said = _whole(session)
    clues |= whole
    # without a load, or where it is not told from a drift, something else is usual; what a few electrodes do
    # is no load
    kind = "moving" if clues["low"] > _LIVELY else "still"
    swings = m.moved and not m.parted and clues["low"] > _SWINGS
    kind = "left_" + ("loaded" if session.loaded else "short" if swings else kind)
    given = clues if counts.max() >= _RESOLVED else clues | dict.fromkeys(_OF_LEVELS, -np.inf)
    p = unusual(given, kind)
    if len(session.recording) * session.fresh < MIN_ROWS:  # as few as a recording that is refused
        p = 1.0
    listed = []
    for i in np.argsort(-np.maximum(parts["level"], parts["aside"]))[:3]:
        w = int(counts[:, i].argmax())
        first, last = time[max(w - 1, 0)], time[min(w + 1, len(time) - 1)]
        listed.append(
            {
                "channel": f"e{m.used[i] + 1}",
                "from": float(first),
                "to": float(last),
                "counts": float(counts[w, i]),
            }
        )
    text = "what each electrode does, the others and its own earlier blocks explain"
    faults = [w for w in session.recording.warnings if w.startswith(CLOCK_FAULT)] + session.unnamed
    faults += [said for said in (apart(session), _louder_since(session)) if said]
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
    significant = p <= UNKNOWN[kind] or bool(faults)
    if significant:
        said |= dict.fromkeys(
            _OF_LEVELS,
            "; ".join(
                f"{c['channel']} departs from what the others say by up to {c['counts']:.0f} counts, most "
                f"from {c['from']:.0f} s to {c['to']:.0f} s"
                for c in listed
            ),
        )
        why = strange(given, kind, UNKNOWN[kind]) if p <= UNKNOWN[kind] else []
        text = "; ".join(dict.fromkeys([*faults, *(said[k] for k in why)]))
    return Rest(significant, text, kind, listed, clues, 0.0 if faults else p)


_OF_ROWS = ("rhythm", "rhythm1", "sharp", "sharp1", "again", "low", "low1", "low6", "swells")
# clues of departures in counts
_OF_LEVELS = (
    *(f"{name}{n}" for name in ("fast", "level", "aside", "counts") for n in ("", 1, 3)),
    *("seen", "stands", "number"),
)


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
    around = running_median(power, 2 * max(4, size // 32) + 1, "nearest")
    band = (f > max(0.5, 3 / size * rate)) & (f < 0.48 * rate)
    over = np.log(power / around)[band]
    beats = 2 * np.sqrt(power[band]) / window.sum()  # [counts]
    third = np.argsort(over, axis=1)[:, -3]
    at = {"rhythm": int(over.mean(1).argmax())}
    at["rhythm1"] = int(over[np.arange(len(over)), third].argmax())
    swing = {k: float(np.sort(beats[i])[-3]) for k, i in at.items()}
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
        k: f"a rhythm of {f[band][i]:.1f} Hz and up to {beats[i].max():.0f} counts" for k, i in at.items()
    }
    said |= dict.fromkeys(
        ("sharp", "sharp1"),
        f"{number} samples change from one row to the next by more than noise and the rows around do, most "
        f"of {' and '.join(f'e{k + 1}' for k in most)}",
    )
    said |= dict.fromkeys(
        ("low", "low1", "low6"), f"electrodes move below 10 Hz, e{int(low.argmax()) + 1} most"
    )
    said["again"] = "rows come again, in all electrodes"
    said["swells"] = "the noise of all electrodes grows and falls against the law of sound sensors"
    return {
        "rhythm": float(over.mean(1).max()) if swing["rhythm"] >= _RESOLVED else 0.0,
        "rhythm1": float(np.sort(over, axis=1)[:, -3].max()) if swing["rhythm1"] >= _RESOLVED else 0.0,
        "sharp": float(np.log(sharp.mean() * 1e4 + 1)) if number >= _FEW else 0.0,
        "sharp1": float(np.log(np.sort(sharp.mean(0))[-2] * 1e4 + 1)) if number >= _FEW else 0.0,
        "again": float(np.log(1 + 100 * (same - 1).sum() / len(x))) if live else 0.0,
        "low": float(np.median(low)),
        "low1": float(low.max()),
        "low6": float(np.sort(low)[-6]),
        "swells": _swells(x) if r.absolute else 0.0,  # the law is one of counts
    }, said


def _louder_since(session):
    """The electrode whose noise is another from some time on, against the law and all other electrodes; None
    without one. What begins in the part kept aside is searched nowhere else."""
    r = session.recording
    rows = np.flatnonzero(~r.repeated & ~session.masked.any(1))
    x = session.counts[rows]
    size = max(_SHORT, len(x) // _WINDOWS)
    starts = range(0, len(x) - size - 4, size)
    if not r.absolute or len(starts) < 3 * _SPLIT:
        return None
    d = np.abs(np.diff(x, n=5, axis=0))
    noise = np.array([1.4826 * np.median(d[a : a + size], axis=0) / np.sqrt(252) for a in starts])
    law = np.array([sound_noise(np.median(x[a : a + size], axis=0)) for a in starts])
    ratio = np.log((noise + _ROUND) / (law + _ROUND))
    ratio -= np.median(ratio, axis=1, keepdims=True)
    named = {k for f in session.findings if len(f.channels) < 12 for k in f.channels}
    best = None
    for k in range(_SPLIT, len(starts) - _SPLIT + 1):
        change = np.median(ratio[k:], axis=0) - np.median(ratio[:k], axis=0)
        before, after = np.median(noise[:k], axis=0), np.median(noise[k:], axis=0)
        change[list(named)] = 0.0
        change[np.abs(after - before) < _LOUD] = 0.0
        i = int(np.abs(change).argmax())
        if abs(change[i]) > (abs(best[0]) if best else _LOUDER):
            best = change[i], i, r.time[rows[starts[k]]], before[i], after[i]
    if best is None:
        return None
    _, i, since, before, after = best
    return (
        f"the noise of e{i + 1} is {after:.1f} counts from about {since:.0f} s on, and {before:.1f} before it"
    )


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
