"""Spectral lines: hum and other periodic disturbances."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import zoom_fft

from .evidence import BLOCKS, sign_flip
from .fault import Fault
from .log import Log
from .noise import running_median

_WANDERS = 3.0  # [s] coherence time of a line's phase
_LINES = 8
_THERE = 0.15  # least fraction of the blocks that show the line
_SLOWEST = 5.0  # [Hz]: lower frequencies may be a hand, a pulse or a pump
# ratio to the surrounding spectrum; rhythms of the load reach at most 9 in real recordings
_RHYTHM = 8.0
_PLAIN = 4.0  # log of the ratio to the surrounding spectrum above which evidence saturates
_LEAST = 4.0  # least ratio to the surrounding spectrum
_SIZE = (128, 4096)  # fewest and most rows of a spectrum


def hum(log: Log, faults: Sequence[Fault] = ()) -> list[Fault]:
    """Finds a disturbance made of spectral lines above the load's band: the strongest, and those that remain
    after its removal (a wave that is not a sine has several)."""
    first = found = _line(log)
    for _ in range(_LINES - 1):
        if found is None:
            break
        log = log.without(None, found.correct(log.counts, log.time))
        found = _line(log)
        if found is not None:
            first = _with_line(first, found)
    return [] if first is None else [first]


def _with_line(fault, line):
    """The disturbance with one more line."""
    before, after = fault.correct, line.correct
    channels = tuple(sorted({*fault.channels, *line.channels}))
    return dataclasses.replace(
        fault,
        channels=channels,
        message=f"{fault.message}; and at {line.parameters['frequency'][0]:.2f} Hz",
        correct=lambda counts, time: after(before(counts, time), time),
    )


def _line(log):
    """Strongest line whose phase in a held-out block is predicted by its neighbours, by the logger's clock or
    the sensor's own. Repeated rows break a wave that the sensor sampled evenly, and vice versa."""
    clocks = [_line_by(log, np.ones(len(log), bool))]
    if log.repeated.any():
        clocks.append(_line_by(log, ~log.repeated))
    return max((f for f in clocks if f is not None), key=lambda f: f.nats, default=None)


def _line_by(log, read):
    """Strongest line in the rows with read (n,) bool, taken as evenly sampled."""
    x = _interpolated(log.counts[read], log.masked[read].all(1))
    n, rate = len(x), log.rate * read.mean()
    size = int(min(n // 4, _SIZE[1]))
    if size < _SIZE[0]:
        return None
    peak = _peak(x, size, rate)
    if peak is None:
        return None
    score, frequency, channels, band = peak
    y = np.diff(x[:, channels], axis=0)
    fine = frequency + np.linspace(-1.5, 1.5, 301) * rate / size
    fine = fine[fine <= 0.5 * rate]  # higher frequencies are aliases
    lines = (np.abs(zoom_fft(y, fine[[0, -1]], len(fine), fs=rate, endpoint=True, axis=0)) ** 2).sum(1)
    frequency = float(fine[int(np.argmax(lines))])
    gain, amplitude = _phase_prediction(y, frequency, rate)
    there = gain >= np.quantile(gain, 1 - _THERE)  # it may start late or be intermittent
    p = sign_flip(gain)
    if p > 0.01 or gain[there].min() < 1:
        return None
    amplitude = np.median(amplitude[there], axis=0)
    width = rate / size / 4
    return Fault(
        "hum",
        tuple(int(k) for k in channels),
        0.0,
        (len(log) - 1) / log.rate,
        f"a line at {frequency:.2f} Hz in {log.name(channels)}, {score:.0f} times above the spectrum around "
        f"it, above the {band:.1f} Hz in which the load moves",
        {
            "frequency": (frequency, frequency - width, frequency + width),
            "amplitude": (float(np.median(amplitude)), float(amplitude.min()), float(amplitude.max())),
        },
        correct=lambda counts, time: _without_line(counts, read, channels, frequency, rate),
        detector="line",
        features={"score": min(float(np.log(score)), _PLAIN)},
        nats=float(gain.sum()),
        p=p,
    )


def _peak(x, size, rate):
    """Strongest line in the windowed spectra of x (n, c): ratio to the surrounding spectrum, frequency [Hz],
    channels that show it, and end of the load's band [Hz]. None without a line. size: rows of a window."""
    starts = np.arange(0, len(x) - size + 1, size // 2)
    parts = np.stack([x[a : a + size] - x[a : a + size].mean(0) for a in starts])
    power = np.mean(np.abs(np.fft.rfft(parts * np.hanning(size)[:, None], axis=1)) ** 2, axis=0)  # (f, c)
    f = np.fft.rfftfreq(size, 1 / rate)
    floor = np.median(power[f > 0.3 * rate], axis=0)
    # the load's band ends where the spectrum reaches its floor
    # mirrored at the Nyquist frequency, since a line may lie in the last bin
    smooth = running_median(power, 2 * max(3, size // 100) + 1, "mirror")
    wide = running_median(power, 2 * max(10, size // 40) + 1, "nearest")  # wider than a line
    above = np.flatnonzero(np.median(wide / np.maximum(floor, 1e-9), axis=1) > 3)
    band = f[above[-1]] if len(above) and f[above[-1]] < 0.35 * rate else 0.0
    inside = f > max(_SLOWEST, 8 * rate / size)
    if inside.sum() < 20:
        return None
    ratio = power / np.maximum(smooth, 1e-9)
    # within the load's band a line must exceed the rhythm of a movement by far
    ratio /= np.where(f > 1.15 * band, 1.0, _RHYTHM)[:, None]
    common = np.exp(np.log(np.maximum(ratio, 1e-6)).mean(1))
    every = list(range(x.shape[1]))
    best = None
    many = [(every, common * 3)] if len(every) > 1 else []
    for channels, score in [*many, *(([k], ratio[:, k]) for k in every)]:
        i = int(np.argmax(np.where(inside, score, 0)))
        if best is None or score[i] > best[0]:
            best = float(score[i]), float(f[i]), channels
    score, frequency, channels = best
    if score < _LEAST:
        return None
    if len(channels) == 1:
        near = np.abs(f - frequency) < 1.5 * rate / size
        channels = np.flatnonzero(ratio[near].max(0) > max(_LEAST, 0.01 * score)).tolist()
    return score, frequency, channels, band


def _phase_prediction(y, frequency, rate):
    """Prediction of a line's phase in each block from its neighbours: gain (blocks,) [nats] for differences y
    (n, c) of channels, and amplitude (blocks, c)."""
    wave = np.exp(2j * np.pi * frequency * np.arange(len(y) + 1) / rate)
    step = np.diff(np.column_stack([wave.imag, wave.real]), axis=0)
    # at least four periods: a line may be present for a part of the time
    blocks = int(np.clip(frequency * (len(y) + 1) / rate / 4, BLOCKS, 4 * BLOCKS))
    block = np.arange(len(y)) * blocks // len(y)
    gain, amplitude = np.empty(blocks), []
    noise = np.maximum(np.median(np.abs(y), axis=0) / 0.6745, 0.5)
    clipped = np.clip(y, -4 * noise, 4 * noise)
    for b in range(blocks):
        # phase of the neighbours, so that a wandering frequency is allowed; the weaker neighbour's amplitude,
        # since the line may begin or end here
        sides = [(block >= b - 2) & (block < b), (block > b) & (block <= b + 2)]
        fits = [np.linalg.lstsq(step[near], clipped[near], rcond=None)[0] for near in sides if near.any()]
        w = min(fits, key=lambda w: np.sum((w / noise) ** 2))
        amplitude.append(np.hypot(*w))
        mine = clipped[block == b] / noise
        residual = mine - step[block == b] @ w / noise
        gain[b] = 0.5 * ((mine**2).sum() - (residual**2).sum()) / y.shape[1]
    return gain, np.array(amplitude)


def _without_line(counts, read, channels, frequency, rate):
    """Counts (n, c) minus a line whose phase and size may change within seconds."""
    turn = np.exp(-2j * np.pi * frequency * np.arange(read.sum()) / rate)[:, None]
    y = counts[np.ix_(read, channels)]
    y = y - _smooth(y, 0.25 * rate)
    wander = _smooth(y * turn, _WANDERS * rate) / turn
    out = counts.copy()
    out[:, channels] -= 2 * wander.real[np.maximum(np.cumsum(read) - 1, 0)]
    return out


def _smooth(x, rows):
    """x (n, c), smoothed twice by a moving average over some rows."""
    size = max(1, int(rows))
    return uniform_filter1d(uniform_filter1d(x, size, axis=0, mode="nearest"), size, axis=0, mode="nearest")


def _interpolated(x, gone):
    """x (n, c) with invalid rows gone (n,) interpolated linearly."""
    if not gone.any() or gone.all():
        return x
    rows, known = np.arange(len(x)), np.flatnonzero(~gone)
    return np.column_stack([np.interp(rows, known, c[known]) for c in x.T])
