"""What the noise says of the electronics: lines, colour, correlations, and electrodes noisier than the
others.

Everything is looked for above the band in which the load moves: of a recording's rows less what a smooth
course through them says."""

import dataclasses

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.optimize import brentq
from scipy.stats import norm

from ....evidence import sign_flip
from ....noise import sound_noise
from ...confidence import TAKEN, confidence
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS

__all__ = ["calm_cells", "coloured", "differences", "humming", "muted", "noisy"]

_NAN = float("nan")
_WANDERS = 3.0  # [s] within which a line keeps its phase
_LINES = 8
_THERE = 0.15  # of the blocks, in which a line is to be at least
_SLOWEST = 5.0  # [Hz]: what is slower a hand, a pulse or a pump does
# times the spectrum around it; rhythms of the load itself stand out by 9 at most in real recordings
_RHYTHM = 8.0
_PLAIN = 4.0  # logarithm of times the spectrum around it, beyond which a line is none the more one
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
_LOUD = 0.8  # quantile of an electrode's noise: a bad contact is loud for a third of the rows
_CLIP = 6.0  # times the law's noise, so that no outlier says what electrodes have in common
_OWN = 0.05  # of a channel's variance, that no other can know of
# of a filter: logarithm of the law's noise over what is left at the highest frequencies; 0.3 at most without
_QUIET = 0.4
_EVERYWHERE = (
    0.25  # of a filter's fall of the spectrum, in the block with the least; a weak one may have none
)
# logarithm of typical over RMS differences, -0.4 of pressed sensors: with less values are held, and step
_STEPS = -0.5


def differences(session: Session, order: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Differences (n, 19) of fresh rows [counts], nan where a sample is masked, and their rows."""
    rows = np.flatnonzero(session.fit & ~session.recording.repeated & ~session.masked.all(1))
    x = np.where(session.masked, np.nan, session.counts)[rows]
    return np.diff(x, n=order, axis=0), rows[order:]


def calm_cells(d: np.ndarray, share: float = 0.5, size: int = 40) -> tuple[np.ndarray, np.ndarray, int]:
    """(windows, size, 19) of differences (n, 19) where all electrodes move least, in each block alike, their
    blocks, and how many these are."""
    k = len(d) // size
    blocks = int(np.clip(k // 5, BLOCKS, 2 * BLOCKS))
    cells = d[: k * size].reshape(k, size, -1)
    known = np.isfinite(cells)
    power = np.where(known, cells**2, 0).sum(1) / np.maximum(known.sum(1), 1)
    level = np.median(power / np.maximum(np.quantile(power, 0.1, axis=0), 0.1), axis=1)
    block = np.arange(k) * blocks // k
    keep = np.zeros(k, bool)
    for b in range(blocks):
        mine = np.flatnonzero(block == b)
        if len(mine):
            keep[mine[level[mine] <= np.quantile(level[mine], share)]] = True
    return cells[keep], block[keep], blocks


# --- colour


def coloured(session: Session) -> Finding | None:
    """White noise that has been filtered: its spectrum falls from the band above the load's to the highest
    frequencies, in every block."""
    x = _fresh(session)
    size = 64
    if not session.recording.absolute:  # how loud a sensor is follows from its counts
        return None
    if len(x) < 2 * size * BLOCKS // 3 or x.std(0).max() < 0.25:
        return None
    starts = np.arange(0, len(x) - size + 1, size // 2)
    window = np.hanning(size)[:, None]
    line = np.vander(np.linspace(-1, 1, size), 3)
    project = line @ np.linalg.pinv(line)
    parts = np.stack([x[a : a + size] - project @ x[a : a + size] for a in starts]) * window
    power = np.abs(np.fft.rfft(parts, axis=1)) ** 2
    f = np.fft.rfftfreq(size)
    bands = ((0.16, 0.27) if session.loaded else (0.05, 0.2), (0.38, 0.5))
    middle, high = (power[:, (f >= a) & (f <= b)].mean(1) for a, b in bands)
    # rounding alone has a floor of its own
    floor = (window**2).sum() / 12
    alive = np.median(middle, axis=0) > 0.5 * floor
    if alive.sum() < 6:
        return None
    block = np.arange(len(parts)) * BLOCKS // len(parts)
    ratio = np.array(
        [
            np.median(np.log(low / above))
            for low, above in (
                [
                    np.maximum(np.quantile(part[block == b][:, alive], 0.3, axis=0), 0.01 * floor)
                    for part in (middle, high)
                ]
                for b in range(BLOCKS)
            )
        ]
    )
    p, value = sign_flip(ratio), float(np.median(ratio))
    pole = _pole(value, bands)
    # a filter takes noise away, where a wave adds some and values that are held keep theirs, in steps
    law = sound_noise(np.median(x, axis=0))
    quiet = np.log(law * np.sqrt((window**2).sum()) / np.sqrt(np.maximum(high.mean(0), 0.01 * floor)))
    step = np.abs(np.diff(x, axis=0))
    step = step[: len(step) // 24 * 24].reshape(-1, 24, 19)
    even = np.median(np.median(step, axis=1) + 0.25, axis=0) / np.median(
        np.sqrt((step**2).mean(1)) + 0.25, axis=0
    )
    quiet, even = float(np.median(quiet[alive])), float(np.log(np.median(even[alive])))
    # a fast touch has such a spectrum where it is; a filter is there in every block
    if ratio.min() < (_EVERYWHERE * value if value > 1 else -0.5 * _EVERYWHERE):
        return None
    if p > 0.01 or pole < 0.05 or quiet < _QUIET or even < _STEPS:
        return None
    rate = session.recording.rate * session.fresh
    tau, low, high = (
        -1 / (rate * np.log(np.clip(_pole(v, bands), 1e-3, 0.995)))
        for v in (value, *np.quantile(ratio, [0.1, 0.9]))
    )
    return Finding(
        "lowpass",
        tuple(range(19)),
        {"tau": (tau, low, high)},
        float(np.sum(ratio**2) * len(starts) / BLOCKS),
        p,
        0.0,
        session.recording.time[-1],
        note=f"the noise is {np.exp(value):.1f} times stronger at a quarter of the rate than at half of it",
        clues={
            "pole": pole,
            "ratio": value,
            "least": float(ratio.min()),
            "quiet": quiet,
            "even": even,
        },
    )


def muted(session: Session) -> Finding | None:
    """Noise that a filter takes away from some time on, down to rounding: then neighbouring rows are mostly
    equal and none jumps, as rows that are held do."""
    x = session.counts[session.fit & ~session.masked.all(1)]
    d, blocks = np.abs(np.diff(x, n=3, axis=0)), 2 * BLOCKS
    if len(d) < 32 * blocks:
        return None
    # of third differences: what all but the largest are below, beside what the law's noise would make
    usual = sound_noise(np.median(x, axis=0)) * np.sqrt(20)
    size = np.stack([np.quantile(part, 0.97, axis=0) for part in np.array_split(d, blocks)]) / 2.17
    calm = np.median(np.log(usual / (size + 0.5)), axis=1)

    def gain(b):
        return (calm[b:].mean() - calm[:b].mean()) * np.sqrt(b * (blocks - b))

    first = max(range(4, blocks - _FEWEST + 1), key=gain)
    before, after = float(np.median(calm[:first])), calm[first:]
    p, quiet = sign_flip(after - before - _QUIET), float(np.median(after))
    if p > 0.02 or quiet - before < 2 * _QUIET or after.min() < calm[:first].max():
        return None
    rate, last = session.recording.rate, session.recording.time[session.fit][-1]
    # of white noise a first-order filter leaves a / (2 tau rate): at least so much that it rounds away
    tau = 0.5 * np.exp(2 * (quiet - before)) / rate
    return Finding(
        "lowpass",
        tuple(range(19)),
        {"tau": (tau, tau, _NAN)},
        float(blocks * (quiet - before)),
        p,
        last * first / blocks,
        session.recording.time[-1],
        note=f"from {last * first / blocks:.1f} s on noise is {np.exp(quiet - before):.0f} times smaller, "
        "and no row jumps",
        clues={"ratio": quiet - before, "quiet": quiet - before, "even": 0.0},
    )


def _fresh(session):
    """(n, 19) counts of rows that are no repetition."""
    return session.counts[session.fit & ~session.recording.repeated & ~session.masked.all(1)]


def _pole(ratio, bands):
    """Of noise a[i] = pole a[i - 1] + white, whose power falls by e^ratio between the two bands."""

    def fall(pole):
        power = [
            np.mean(1 / (1 + pole**2 - 2 * pole * np.cos(2 * np.pi * np.linspace(*band, 50))))
            for band in bands
        ]
        return np.log(power[0] / power[1])

    if ratio <= 0:
        return 0.0
    return 0.99 if ratio >= fall(0.99) else brentq(lambda a: fall(a) - ratio, 0.0, 0.99)


# --- lines


def humming(session: Session) -> Finding | None:
    """A disturbance made of lines in the spectrum, above the band in which the load moves: the strongest,
    and those that are left once it is taken out (a wave that is no sine has several)."""
    first = found = _line(session)
    for _ in range(_LINES - 1):
        if found is None:
            break
        session = Session(session.recording, session.fit, [*session.findings, found])
        found = _line(session)
        if found is not None:
            first = _with_line(first, found)
    return first


def _smooth(x, rows):
    """x (n, c) averaged over some rows, twice."""
    size = max(1, int(rows))
    return uniform_filter1d(uniform_filter1d(x, size, axis=0, mode="nearest"), size, axis=0, mode="nearest")


def _with_line(hum, line):
    """A disturbance and one more line of it."""
    before, after = hum.correct, line.correct
    frequency = line.parameters["frequency"][0]
    return dataclasses.replace(
        hum,
        channels=tuple(sorted({*hum.channels, *line.channels})),
        note=f"{hum.note}; and at {frequency:.2f} Hz",
        correct=lambda counts, at: after(before(counts, at), at),
    )


def _between(x, gone):
    """x (n, 19) with rows that are no measurement (n,) on the line between those beside them."""
    if not gone.any() or gone.all():
        return x
    rows, known = np.arange(len(x)), np.flatnonzero(~gone)
    return np.column_stack([np.interp(rows, known, c[known]) for c in x.T])


def _line(session):
    """The strongest line whose phase on blocks left out is that of the blocks around, by the logger's clock
    or by the sensor's own: a logger that repeats rows now and then tears a wave that the sensor sampled
    evenly, and the other way round."""
    clocks = [_line_by(session, np.ones(len(session.recording), bool), 1.0)]
    if session.recording.repeated.any():
        clocks.append(_line_by(session, ~session.recording.repeated, session.fresh))
    found = [f for f in clocks if f is not None]
    return max(found, key=lambda f: f.nats) if found else None


def _line_by(session, read, share):
    """The strongest line of rows that were read (n,) bool, a share of all, which lie evenly in time."""
    r = session.recording
    part = read & session.fit
    x = _between(session.counts[part], session.masked[part].all(1))
    n, rate = len(x), r.rate * share
    size = int(min(n // 4, 4096))
    if size < 128:
        return None
    window = np.hanning(size)
    starts = np.arange(0, n - size + 1, size // 2)
    parts = np.stack([x[a : a + size] - x[a : a + size].mean(0) for a in starts])
    power = np.mean(np.abs(np.fft.rfft(parts * window[:, None], axis=1)) ** 2, axis=0)  # (f, 19)
    f = np.fft.rfftfreq(size, 1 / rate)
    floor = np.median(power[f > 0.3 * rate], axis=0)
    # the load's band ends where the spectrum comes down to the floor
    # mirrored at half of the rate, where a line may lie in the last place there is
    smooth = median_filter(power, (2 * max(3, size // 100) + 1, 1), mode="mirror")
    wide = median_filter(power, (2 * max(10, size // 40) + 1, 1), mode="nearest")  # a line is no band
    above = np.flatnonzero(np.median(wide / np.maximum(floor, 1e-9), axis=1) > 3)
    band = f[above[-1]] if len(above) and f[above[-1]] < 0.35 * rate else 0.0
    inside = f > max(_SLOWEST, 8 * rate / size)
    if inside.sum() < 20:
        return None
    ratio = power / np.maximum(smooth, 1e-9)
    # where the load moves, a line has to stand out by far more than a movement's rhythm does
    ratio /= np.where(f > 1.15 * band, 1.0, _RHYTHM)[:, None]
    together = np.exp(np.log(np.maximum(ratio, 1e-6)).mean(1))
    best = None
    for who, score in [(tuple(range(19)), together * 3), *(((k,), ratio[:, k]) for k in range(19))]:
        i = int(np.argmax(np.where(inside, score, 0)))
        if best is None or score[i] > best[0]:
            best = float(score[i]), float(f[i]), who
    score, frequency, channels = best
    if score < 4:
        return None
    if len(channels) == 1:
        near = np.abs(f - frequency) < 1.5 * rate / size
        channels = tuple(np.flatnonzero(ratio[near].max(0) > max(4.0, 0.01 * score)))
    y = np.diff(x[:, list(channels)], axis=0)
    t = np.arange(n) / rate
    fine = frequency + np.linspace(-1.5, 1.5, 301) * rate / size
    lines = [float((np.abs(np.exp(-2j * np.pi * g * t[:-1]) @ y) ** 2).sum()) for g in fine]
    frequency = float(fine[int(np.argmax(lines))])
    wave = np.column_stack([np.sin(2 * np.pi * frequency * t), np.cos(2 * np.pi * frequency * t)])
    step = np.diff(wave, axis=0)
    # of at least four periods: a line may be there for a part of the time
    blocks = int(np.clip(frequency * n / rate / 4, BLOCKS, 4 * BLOCKS))
    block = np.arange(len(y)) * blocks // len(y)
    gain, local = np.empty(blocks), []
    noise = np.maximum(np.median(np.abs(y), axis=0) / 0.6745, 0.5)
    clipped = np.clip(y, -4 * noise, 4 * noise)
    for b in range(blocks):
        # the phase of the neighbours: a line whose frequency wanders is still one; the weaker side's, for it
        # may begin or end here
        sides = [(block >= b - 2) & (block < b), (block > b) & (block <= b + 2)]
        fits = [np.linalg.lstsq(step[near], clipped[near], rcond=None)[0] for near in sides if near.any()]
        w = min(fits, key=lambda w: np.sum((w / noise) ** 2))
        local.append(w)
        mine = clipped[block == b] / noise
        left = mine - step[block == b] @ w / noise
        gain[b] = 0.5 * ((mine**2).sum() - (left**2).sum()) / len(channels)
    p = sign_flip(gain)
    # it may have been switched on late, or come and go
    there = gain >= np.quantile(gain, 1 - _THERE)
    amplitude = np.median(np.array([np.hypot(*w) for w in local])[there], axis=0)
    if p > 0.01 or gain[there].min() < 1:
        return None
    who = list(channels)

    def correct(counts, at):
        """Takes out what lies about the line: its phase and size may wander, slower than seconds."""
        turn = np.exp(-2j * np.pi * frequency * np.arange(read.sum()) / rate)[:, None]
        y = counts[np.ix_(read, who)]
        y = y - _smooth(y, 0.25 * rate)
        wander = _smooth(y * turn, _WANDERS * rate) / turn
        out = counts.copy()
        out[:, who] -= 2 * wander.real[np.maximum(np.cumsum(read) - 1, 0)]
        return out

    width = rate / size / 4
    return Finding(
        "hum",
        tuple(int(k) for k in channels),
        {
            "frequency": (frequency, frequency - width, frequency + width),
            "amplitude": (float(np.median(amplitude)), float(amplitude.min()), float(amplitude.max())),
        },
        float(gain.sum()),
        p,
        0.0,
        r.time[-1],
        note=f"a line {score:.0f} times above the spectrum around it, above the {band:.1f} Hz in which the "
        "load moves",
        clues={
            "score": min(float(np.log(score)), _PLAIN),
            "amplitude": float(np.log(np.median(amplitude / (noise / np.sqrt(2))))),
            "blocks": float(np.mean(gain > 0)),
            "many": float(len(channels) > 12),
        },
        correct=correct,
    )


# --- size


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
        elif confidence(finding) >= TAKEN:
            session.unnamed.append(
                f"e{e + 1} is again and again off to one side, {'above' if side > 0 else 'below'} what it "
                "reads around: no noise is"
            )
    known = session.recording.absolute and "common_noise" not in {f.id for f in session.findings}
    everyone = _all_noisy(session, common) if known else None
    return found if everyone is None else [*found, everyone]


def _all_noisy(session, ratio):
    """Noise of all electrodes, by the logarithm of times the law that the median one has, by unit (u,)."""
    size = float(np.quantile(ratio, 0.3))  # touches, and what else comes and goes, are in the others
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
        0.0,
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
