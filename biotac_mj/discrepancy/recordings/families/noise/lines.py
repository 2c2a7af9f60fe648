"""Lines in the spectrum: hum, and the waves that go with it."""

import dataclasses

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import zoom_fft

from .....quality.noise import running_median
from ....evidence import sign_flip
from ...findings import Finding
from ...session import Session
from ..courses import BLOCKS

__all__ = ["humming"]

_WANDERS = 3.0  # [s] within which a line keeps its phase
_LINES = 8
_THERE = 0.15  # of the blocks, in which a line is to be at least
_SLOWEST = 5.0  # [Hz]: what is slower a hand, a pulse or a pump does
# times the spectrum around it; rhythms of the load itself stand out by 9 at most in real recordings
_RHYTHM = 8.0
_PLAIN = 4.0  # logarithm of times the spectrum around it, beyond which a line is none the more one


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
    smooth = running_median(power, 2 * max(3, size // 100) + 1, "mirror")
    wide = running_median(power, 2 * max(10, size // 40) + 1, "nearest")  # a line is no band
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
    fine = fine[fine <= 0.5 * rate]  # beyond it lies a mirror image
    lines = (np.abs(zoom_fft(y, fine[[0, -1]], len(fine), fs=rate, endpoint=True, axis=0)) ** 2).sum(1)
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
