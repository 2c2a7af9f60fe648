"""What the segments of a checkup's protocol show: each isolates effects that a plain log mixes."""

import dataclasses
import functools

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import lfilter

from ...quality.confidence import probability
from ...quality.evidence import BLOCKS
from ...quality.noise import ROUNDING, noise_level, sound_noise
from ...recordings.protocol import STEPS, Protocol
from ..evidence import sign_flip
from ..report.verdict import Gap
from .candidates import Candidate, Detector
from .detectors.latency import force_view
from .detectors.together import MOST
from .recording import MIN_ROWS, PlainRecording
from .session import Session

__all__ = ["Noise", "memory_of", "moved", "segment_findings", "stretches"]

_BLOCK, _LEAST = 100, 6  # rows of a block of noise; blocks
_WIDTHS = 8, 32  # rows over which slow noise is averaged, between which it lies
_FITTED = 2 / 3  # of the blocks
_FAR = 5.0  # spreads of all pairs, from which one is no pair of the others'
_TAUS = 0.5, 1.0, 2.0, 4.0  # [s] of relaxation: what is slower is not told from drift
_PLAYS = 0.05, 0.1, 0.2  # of the largest force, over which hysteresis turns
_P = 0.02  # of sign flips of blocks
_SEGMENT = Detector("segment")
# of the confidence, as `quality.confidence.WEIGHTS`
_WEIGHTS = {"segment": (1.5, {"excess": (1.0, 0.0, 2.0)})}
# what sound sensors have at most: 1.4 times the largest of 19 electrodes in twelve sessions of EPFL's F1 with
# its unloaded neighbour (`benchmarks/checkup_labs.py --half practice`)
_SOUND = {"level": 0.36, "colour": 0.21, "load": 0.44, "pair": 0.17, "load pair": 0.38}


def stretches(recording: PlainRecording, protocol: Protocol) -> list[slice]:
    """Rows of the contiguous stretches in which something touched the sensor, or nothing did; none where all
    of the recording is one, or where a stretch is too short to be diagnosed."""
    time, found = _clock(recording), []
    for one in protocol.segments:
        touched = STEPS[one.kind].touched
        first, last = np.searchsorted(time, [one.start, one.stop])
        if found and found[-1][0] == touched:
            found[-1] = touched, slice(found[-1][1].start, last)
        else:
            found.append((touched, slice(first, last)))
    if len(found) < 2:
        return []
    return [rows for _, rows in found if rows.stop - rows.start >= MIN_ROWS]


def _clock(recording):
    """(n,) [s] since the first row."""
    return recording.time if recording.since is None else recording.since


def moved(finding: Candidate, rows: slice, recording: PlainRecording) -> Candidate:
    """A finding in some rows as one of the whole recording, which acts in these rows alone."""
    begin, shape = recording.time[rows.start], recording.electrodes.shape
    mask, correct = finding.mask, finding.correct
    if mask is not None:
        mask = np.zeros(shape, bool)
        mask[rows] = finding.mask

    def without(counts, time):
        counts = counts.copy()
        counts[rows] = correct(counts[rows], time[rows] - begin)
        return counts

    return dataclasses.replace(
        finding,
        start=finding.start + begin,
        end=finding.end + begin,
        mask=mask,
        correct=None if correct is None else without,
        places=tuple(place + begin for place in finding.places),
        trend=None,
    )


def segment_findings(session: Session, protocol: Protocol, faulty: set[int]) -> list[Candidate]:
    """Findings of the segments' own detectors.

    Args:
      faulty: electrodes with a fault of the log, which says nothing of the sensor's noise.
    """
    still, touched = (_parts(session.recording, protocol, one) for one in (False, True))
    found = _of_noise(session, still, touched, faulty)
    for finding in found:
        finding.confidence = probability("segment", finding.features, 0, _WEIGHTS)
    return found


def _parts(recording, protocol, touched):
    """Rows of the segments in which something touched the sensor, or nothing did, in order of time."""
    kinds = [kind for kind, step in STEPS.items() if step.touched == touched]
    return protocol.rows(_clock(recording), *kinds)


@dataclasses.dataclass
class Noise:
    """Noise of electrodes (c,) in blocks of rows: level (blocks, c), logarithm of its standard deviation over
    that of a sound electrode; colour (blocks, c), the same of slow noise over fast; pairs (blocks, c, c),
    correlations; time (blocks,) [s] of their middles."""

    level: np.ndarray
    colour: np.ndarray
    pairs: np.ndarray
    time: np.ndarray

    @classmethod
    def of(cls, session: Session, parts: list[np.ndarray]) -> "Noise | None":
        """Of rows (k,) of each part; None where they are too few for blocks."""
        repeated, time = session.recording.repeated, session.recording.time
        parts = [rows[~repeated[rows]] for rows in parts]
        size = max(_BLOCK, sum(map(len, parts)) // BLOCKS)
        blocks = [block for rows in parts for block in np.split(rows, range(size, len(rows), size))]
        blocks = [block for block in blocks if len(block) >= _BLOCK]
        if len(blocks) < _LEAST:
            return None
        each = [cls._block(session.counts[block]) for block in blocks]
        return cls(*(np.array(value) for value in zip(*each)), np.array([time[b].mean() for b in blocks]))

    @staticmethod
    def _block(x):
        d = np.diff(x, n=5, axis=0) / np.sqrt(252)  # what a load does is slower
        sd = _spread(d)
        level = np.log((sd + ROUNDING) / (sound_noise(np.median(x, axis=0)) + ROUNDING))
        short, long = (uniform_filter1d(x, width, axis=0) for width in _WIDTHS)
        slow = _spread(short - long) / np.sqrt(1 / _WIDTHS[0] - 1 / _WIDTHS[1])
        clipped = np.clip(d, -4 * sd, 4 * sd)
        clipped = (clipped - clipped.mean(0)) / np.maximum(clipped.std(0), 1e-9)
        return level, np.log((slow + ROUNDING) / (sd + ROUNDING)), clipped.T @ clipped / len(d)


def _spread(x):
    """(c,) standard deviation of x (n, c) by its median."""
    return 1.4826 * np.median(np.abs(x - np.median(x, axis=0)), axis=0)


def _of_noise(session, still, touched, faulty):
    """What the noise of electrodes says: at rest against the law of sound ones, touched against their own at
    rest; and of pairs, which have none in common."""
    rest, load = Noise.of(session, still), Noise.of(session, touched)
    if rest is None:
        return []
    level, colour = (x - np.median(x, axis=1, keepdims=True) for x in (rest.level, rest.colour))
    sound = [k for k in range(level.shape[1]) if k not in faulty]
    more = np.zeros_like(level)
    if load is not None:
        more = load.level - np.median(load.level, axis=1, keepdims=True) - np.median(level, axis=0)
    found = []
    for k in sound:
        size, hue = level[:, k].mean(), colour[:, k].mean()
        if hue > _SOUND["colour"] and size < -_SOUND["level"]:
            tau = {"tau": (_time_constant(hue, session.recording.rate), np.nan, np.nan)}
            told = colour[:, k], "colour", "slow noise over fast at rest"
            found.append(_follow(session, touched, _finding("lowpass", (k,), tau, rest, *told)))
        elif hue > _SOUND["colour"]:
            told = colour[:, k], "colour", "slow noise over fast at rest"
            found.append(_finding("noise", (k,), _louder(session, k, hue), rest, *told))
        elif abs(size) > _SOUND["level"]:
            found.append(_loud(session, k, rest, level[:, k], "level", "noise at rest over the law"))
        elif more[:, k].mean() > _SOUND["load"]:  # less has many causes: a hold, a filter, a gain
            text = "noise while touched over that at rest"
            found.append(_loud(session, k, load, more[:, k], "load", text))
    if len(found) > MOST:  # not of single electrodes
        found = []
    pairs = _of_pairs(rest, "pair", sound)
    if load is not None:
        pairs = pairs or _of_pairs(load, "load pair", sound)
    return found + pairs


def _loud(session, k, noise, value, key, text):
    """An electrode that scatters more than it should, or whose gain is less, noise and all."""
    size = float(value.mean())
    if size > 0:
        return _finding("noise", (k,), _louder(session, k, size), noise, value, key, text)
    return _finding(
        "gain", (k,), {f"e{k + 1}": (float(np.expm1(size)), np.nan, np.nan)}, noise, value, key, text
    )


def _louder(session, k, size):
    """{electrode: its noise beyond the law [counts]} by the logarithm of a ratio."""
    law = float(sound_noise(np.median(session.counts[:, k])))
    return {f"e{k + 1}": (law * float(np.sqrt(np.expm1(2 * size))), np.nan, np.nan)}


def _of_pairs(noise, key, sound):
    """Cross-talk of the pairs of electrodes whose noise has more in common than that of other pairs."""
    i, j = np.triu_indices(noise.pairs.shape[1], 1)
    pairs = noise.pairs[:, i, j]
    mean = pairs.mean(0)
    limit = max(_SOUND[key], _FAR * 1.4826 * float(np.median(np.abs(mean - np.median(mean)))))
    over = [n for n in np.flatnonzero(np.abs(mean) > limit) if i[n] in sound and j[n] in sound]
    if not over:
        return []
    worst = max(over, key=lambda n: abs(mean[n]))
    channels = tuple(sorted({int(k) for n in over for k in (i[n], j[n])}))
    if len(channels) > MOST:  # of all that share a supply or a disturbance
        return []
    text = f"noise that e{i[worst] + 1} and e{j[worst] + 1} have in common"
    share = {"kappa": (float(mean[worst]), np.nan, np.nan)}
    return [_finding("crosstalk", channels, share, noise, pairs[:, worst], key, text)]


def _finding(id_, channels, parameters, noise, value, key, text):
    """A finding whose size is the mean of values (blocks,), of which a sound sensor has _SOUND[key] at most:
    estimated on the first blocks, judged on the last."""
    fit = np.arange(len(value)) < round(_FITTED * len(value))
    size, late = float(value[fit].mean()), value[~fit]
    beyond = np.sign(size) * value - _SOUND[key]
    before, after = (float(np.sqrt(np.mean((late - x) ** 2))) for x in (0.0, size))
    spread = max(float(value[fit].std()), 1e-3)
    out = Candidate(
        id_,
        channels,
        parameters,
        float(0.5 * len(value) * np.log1p((size / spread) ** 2)),
        sign_flip(beyond),
        float(noise.time[0]),
        float(noise.time[-1]),
        _SEGMENT,
        f"{text}: {size:+.2f}, {_SOUND[key]:.2f} in sound sensors",
        features={"excess": float(np.log(max(abs(size) / _SOUND[key], 0.1)))},
    )
    out.gap = Gap("1", before, after, spread, f"RMS of {text} in the last blocks")
    out.verified = after < before
    return out


def _follow(session, touched, finding):
    """Time constant of a low-pass by touches: of what the others say, filtered, fitted on the first of these
    rows and judged on the last. Noise at rest has it where these do not say."""
    if not touched or not session.loaded:
        return finding
    rate, (k,) = session.recording.rate, finding.channels
    rows = np.arange(touched[0][0], touched[-1][-1] + 1)
    x = session.counts[rows] - gaussian_filter1d(session.counts[rows], rate, axis=0)
    others, own = np.delete(x, k, axis=1), x[:, k]
    fit = np.arange(len(rows)) < round(_FITTED * len(rows))

    def left(tau):
        said = others if tau == 0 else _slow(tau, others, rate)
        weights = np.linalg.lstsq(said[fit], own[fit], rcond=None)[0]
        error = own - said @ weights
        return [float(np.sqrt(np.mean(error[some] ** 2))) for some in (fit, ~fit)]

    taus = np.geomspace(0.2 / rate, 1.0, 24)
    tau = float(min(taus, key=lambda tau: left(tau)[0]))
    (plain, before), (fitted, after) = left(0), left(tau)
    if fitted < plain:
        floor = float(noise_level(session.counts[rows])[k])
        finding.parameters = {"tau": (tau, np.nan, np.nan)}
        finding.gap = Gap(
            "counts", before, after, floor, "RMS of the electrode against the others while touched"
        )
        finding.verified = after < before
    return finding


def _time_constant(hue, rate):
    """[s] of the first-order low-pass that gives white noise this colour."""
    taus = np.geomspace(0.1, 50, 60)  # [rows]
    f = np.linspace(1e-3, 0.5, 2000)
    box = [np.sinc(width * f) / np.sinc(f) for width in _WIDTHS]
    slow, fast = (box[0] - box[1]) ** 2, (2 * np.sin(np.pi * f)) ** 10

    def of(tau):
        gain = 1 / np.abs(1 + tau * (1 - np.exp(-2j * np.pi * f))) ** 2
        return 0.5 * np.log((slow @ gain / slow.sum()) / (fast @ gain / fast.sum()))

    return float(np.interp(hue, [of(tau) for tau in taus], taus) / rate)


def memory_of(session: Session, protocol: Protocol) -> str:
    """What touches say of relaxation and hysteresis, in words: the force is better told by the electrodes
    with what a memory of it adds. Every rubber has some, so no name is made of it."""
    touched = _parts(session.recording, protocol, True)
    if not touched or session.recording.force is None:
        return ""
    rows = np.zeros(len(session.recording), bool)
    rows[touched[0][0] : touched[-1][-1] + 1] = True
    view = force_view(session, rows)
    if view is None:
        return ""
    relaxes = [(f"relaxation of {tau:g} s", functools.partial(_slow, tau)) for tau in _TAUS]
    plays = [
        (f"hysteresis over {share:.0%} of the force", functools.partial(_play, share)) for share in _PLAYS
    ]
    tried = [*relaxes, *plays]
    gains = view.with_memory([memory for _, memory in tried])
    (text, _), (gain, weight) = max(zip(tried, gains), key=lambda one: one[1][0].mean())
    if weight <= 0 or gain.mean() <= 0 or sign_flip(gain) > _P:
        return ""
    less = 1 - np.exp(-gain.mean() / 2)
    return (
        f"{text}, {weight / (1 + weight):.0%}, takes {less:.0%} off the error of the force foreseen from the "
        "electrodes: whether it is more than the rubber's own, a second sensor would tell"
    )


def _slow(tau, force, rate):
    """(n, 3) force [N] that follows with a time constant [s]."""
    keep = np.exp(-1 / (tau * rate))
    return lfilter([1 - keep], [1, -keep], force - force[:1], axis=0) + force[:1]


def _play(share, force, rate):
    """(n, 3) force [N] that follows its size with a play, a share of its largest."""
    size = np.linalg.norm(force, axis=1)
    width, out = share * np.quantile(size, 0.97), size.copy()
    for n in range(1, len(out)):
        out[n] = min(max(out[n - 1], size[n] - width), size[n] + width)
    return force * (out / np.maximum(size, 1e-6))[:, None]
