"""Residual after all named effects are removed: whether each electrode agrees with the prediction from the
others and from its own earlier blocks."""

import dataclasses
import json
import pathlib

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from ...quality.adjacent import sharp
from ...quality.clock import CLOCK_FAULT
from ...quality.confidence import NAMED
from ...quality.noise import noise_level, running_median
from .candidates import as_log
from .segments import sharply_touched
from .session import Session

# logarithm of the power of the median electrode below 10 Hz over that of its noise, from which on something
# moves: 0.6 at most at rest and in grips, 2 or more in slides, touches and presses
_LIVELY = 1.0
# of a load that is too short to be separated from drift: 3.3 at most in touches, 4.6 at least in presses
_SWINGS = 4.0
_COMPARED = 400  # rows of the shortest recording in USUAL
_BY_HAND = 10.0  # [Hz] below which a load moves
_RESOLVED = 1.0  # [counts] by which an electrode departs at least, or a rhythm moves it
_OWN = 4  # electrodes of 19 that change from one row to the next by themselves: a touch moves more
_FEW = 3  # samples that are sharp in a recording of any length
# kind of recordings -> what is usual of those without an effect (`farthest`), and the limit that one in ten
# of them exceeds (`benchmarks/discrepancy_confidence.py`)
USUAL: dict = json.loads(pathlib.Path(__file__).with_name("usual.json").read_text())
_FAR = 6.0  # spreads: what lies beyond is unusual, whatever it is


@dataclasses.dataclass
class Rest:
    """significant; text; kind of recordings that it is compared with (`USUAL`); cells: dicts
    (channel, from, to, counts) of what departs, the largest first; features: numbers that the decision is
    made of."""

    significant: bool
    text: str
    kind: str
    cells: list
    features: dict


def rest(session: Session) -> Rest:
    """Compares every electrode with its prediction from the others, in the fitted and the held-out rows, in
    units of its change by the load; and the residual rows with those of recordings without an effect."""
    m = session.model()
    cells, time = m.levels(m.residual(), every=True)
    counts = np.abs(cells) * m.slope
    inside = time < m.time[m.inside][-1]
    level, aside = (
        np.sqrt((part**2).mean(0)) / (m.activity + 2 * m.noise) for part in (cells[inside], cells[~inside])
    )
    features, said = _of_rows(session)
    features["seconds"] = float(np.log(m.time[m.inside][-1]))
    if counts.max() >= _RESOLVED:
        features["level3"] = float(np.log(np.sort(level)[-min(3, len(level))]))
    kind = _kind(session, features["low"])
    listed = [
        {"channel": f"e{m.used[i] + 1}"} | _where(counts[:, i], time)
        for i in np.argsort(-np.maximum(level, aside))[:3]
    ]
    faults = [w for w in session.recording.warnings if w.startswith(CLOCK_FAULT)]
    faults += [f.message for f in session.unnamed]
    faults += _contradicted(session)
    far, name = farthest(features, USUAL[kind]["features"])
    compared = len(session.recording) * session.fresh >= _COMPARED
    if compared and far > USUAL[kind]["limit"]:
        departs = "; ".join(
            f"{c['channel']} departs from what the others say by up to {c['counts']:.0f} counts, most from "
            f"{c['from']:.0f} s to {c['to']:.0f} s"
            for c in listed
        )
        faults = [*faults, departs if name == "level3" else said[name]]
    text = "; ".join(faults) or "what each electrode does, the others and its own earlier blocks explain"
    if not (faults or compared):
        text = f"what fewer than {_COMPARED} new rows leave is not compared with that of other recordings"
    return Rest(bool(faults), text, kind, listed, features)


def farthest(features: dict, usual: dict) -> tuple[float, str]:
    """Largest deviation of a recording's features above their usual values, in spreads, and the feature's
    name.

    Args:
      features: with the logarithm of the recording's seconds. usual: name -> (median, its change with the
        logarithm of the seconds, spread).
    """
    seconds = features["seconds"]
    return max(
        (
            (min(max((features[name] - middle - slope * seconds) / spread, 0.0), _FAR), name)
            for name, (middle, slope, spread) in usual.items()
            if name in features
        ),
        default=(0.0, ""),
    )


def _kind(session, low):
    """Key of USUAL. Other features are usual without a load, or if the load is not distinguished from a
    drift; a change of a few electrodes is no load."""
    m = session.model()
    if session.loaded:
        return "loaded"
    if not m.parted and low > _SWINGS:
        return "short"
    return "moving" if low > _LIVELY else "still"


def _where(counts, time):
    """Between which times (w,) [s] an electrode departs most, by counts (w,)."""
    w = int(counts.argmax())
    first, last = time[max(w - 1, 0)], time[min(w + 1, len(time) - 1)]
    return {"from": float(first), "to": float(last), "counts": float(counts[w])}


def _contradicted(session):
    """Line on names that held-out rows contradict, except a warm-up, which every sensor has."""
    weak = [f for f in session.weak if f.verified is False and f.confidence >= NAMED and f.fraction is None]
    names = [f.kind.name + f.where for f in weak]
    if not names:
        return []
    return [f"{' and '.join(names)} would explain the rows fitted, and the held-out ones contradict it"]


def _of_rows(session):
    """Features of the recording without the named effects that need no model of the load: rhythms, sharp
    changes, and more than noise where only noise is expected. And their description."""
    r = session.recording
    rows = np.flatnonzero(~r.repeated & ~session.masked.any(1))
    x, rate = session.counts[rows], r.rate * session.fresh
    series = [one for one in np.split(np.arange(len(x)), np.searchsorted(rows, r.joints)) if len(one)]
    if len(x) < 128 or max(map(len, series)) < 64:
        return {"low": 0.0}, {}
    size = int(np.clip(2 ** round(np.log2(4 * rate)), 64, min(len(x) // 3, max(map(len, series)))))
    power, over = _spectrum(x, series, size, (np.hanning(size) ** 2).sum() / 12)  # rounding
    f = np.fft.rfftfreq(size, 1 / rate)
    band = (f > max(0.5, 3 / size * rate)) & (f < 0.48 * rate)
    over = over[band]
    # a touch that comes again is none of the sensor's
    if r.force is not None:
        over = over - np.maximum(_spectrum(r.force[rows], series, size, 1e-12)[1][band].max(1), 0)[:, None]
    elif session.loaded:
        over[f[band] < _BY_HAND] = 0.0
    beats = 2 * np.sqrt(power[band]) / np.hanning(size).sum()  # [counts]
    most_over = int(over.mean(1).argmax())
    swing = float(np.sort(beats[most_over])[-3])
    low = np.log(power[(f > 0.5) & (f < 10)].mean(0) / power[f > 0.35 * rate].mean(0))
    # from one row to the next, more than noise and than the rows around, where nothing touches
    least, log = 6 * noise_level(x) + 2, as_log(r)
    touch = log.touched[rows][1:] if r.force is not None else _together(np.diff(x, axis=0) / least, log)
    if session.protocol is not None:
        touch = touch | sharply_touched(r, session.protocol)[rows][1:]
    jumps = sharp(x, least) & ~touch[:, None]
    jumps[[one[0] - 1 for one in series[1:]]] = False
    number = int(jumps.sum())
    most = np.argsort(-jumps.sum(0))[:2]
    rhythm = f"a rhythm of {f[band][most_over]:.1f} Hz and up to {beats[most_over].max():.0f} counts"
    said = {"rhythm": rhythm} | dict.fromkeys(
        ("sharp", "sharp1"),
        f"{number} samples change from one row to the next by more than noise and the rows around do, most "
        f"of {' and '.join(f'e{k + 1}' for k in most)}",
    )
    said |= dict.fromkeys(("low1", "low6"), f"electrodes move below 10 Hz, e{int(low.argmax()) + 1} most")
    return {
        "rhythm": float(over.mean(1).max()) if swing >= _RESOLVED else 0.0,
        "sharp": float(np.log(jumps.mean() * 1e4 + 1)) if number >= _FEW else 0.0,
        "sharp1": float(np.log(np.sort(jumps.mean(0))[-2] * 1e4 + 1)) if number >= _FEW else 0.0,
        "low": float(np.median(low)),
        "low1": float(low.max()),
        "low6": float(np.sort(low)[-6]),
    }, said


def _together(step, log):
    """(n,) bool, steps (n, c) of more than one in many electrodes, as a touch makes where no force says so.
    No two touches are alike: what comes, stays and goes several times by the same is none."""
    many = (np.abs(step) > 1).sum(1) > log.some(_OWN)
    stays = np.flatnonzero(many & (uniform_filter1d(many.astype(float), 5) < 0.3))
    if len(stays):
        tree = cKDTree(step[stays])
        alike = [tree.query_ball_point(s * step[stays], 1, p=np.inf, return_length=True) for s in (1, -1)]
        many[stays] = sum(alike) <= 2 * _FEW
    return many


def _spectrum(x, series, size, least):
    """(f, c) power of x (n, c) in windows of `size` rows of one of the series, straight lines taken out, and
    the logarithm of how far it rises above that around."""
    window, line = np.hanning(size)[:, None], np.vander(np.linspace(-1, 1, size), 2)
    project = line @ np.linalg.pinv(line)
    parts = [x[one[a : a + size]] for one in series for a in range(0, len(one) - size + 1, size // 2)]
    power = np.mean([np.abs(np.fft.rfft((y - project @ y) * window, axis=0)) ** 2 for y in parts], axis=0)
    power += least
    return power, np.log(power / running_median(power, 2 * max(4, size // 32) + 1, "nearest"))
