"""Pieces of recordings of real sensors with one or two hidden effects, by a tenth author.

    plan() -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own
words. Every piece has a stream of random numbers of its own, of which the author drew the place first: the
table says how far the stream was then, so that each piece is made alone and is the very one that was judged
blind. Pieces have a clock of their own, as a file has.
"""

import dataclasses
import functools
import gzip
import pathlib

import numpy as np
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import butter, lfilter, sosfilt, sosfiltfilt

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

_SEED = 20261123
_EPFL = 118.0  # [Hz] of the pressed sensors and the neighbour of one
KINDS = {  # the author's name of a kind: the vocabulary's
    "gain": "gain",
    "sign": "flip",
    "permutation": "swap",
    "offset": "jump",
    "drift": "drift",
    "warm_up": "warmup",
    "temperature": "thermal",
    "fluid_loss": "fluidloss",
    "relaxation": "relax",
    "hysteresis": "hyster",
    "latency": "latency",
    "low_pass": "lowpass",
    "noise": "noise",
    "line_noise": "hum",
    "cross_talk": "crosstalk",
    "quantisation": "quantise",
    "saturation": "saturate",
    "stuck": "stuck",
    "spikes": "spikes",
    "lost_samples": "lost",
    "held_samples": "freeze",
}
# what a base has by itself: sensors in the hand warm up and are late, a bus slower than the logger holds
# rows, grasps cool a finger, the native log has bursts and single spikes
NATURAL = {
    "tenth F1": {"warmup", "latency", "freeze"},
    "tenth F2": {"warmup", "latency", "freeze"},
    "tenth U": {"warmup", "freeze"},
    "tenth phac": {"warmup", "thermal", "fluidloss"},
    "tenth btd": {"lost_rows", "spikes"},
}
ALL = list(range(19))


# ---------------------------------------------------------------- recordings


@dataclasses.dataclass
class _Source:
    """A sensor's whole recording: counts x (n, 19), time (n,) [s], rate [Hz], force (n, 3), tdc (n,), rest
    (n, 19): what it reads without load, noise (19,) [counts]."""

    x: np.ndarray
    time: np.ndarray
    rate: float
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None
    rest: np.ndarray | None = None

    def __post_init__(self):
        d = np.diff(self.x, axis=0)
        d = d[(d != 0).any(1)]
        middle = np.median(np.abs(d - np.median(d, axis=0)), axis=0)
        cut = np.stack([np.clip(v, *np.quantile(v, [0.05, 0.95])) for v in d.T], 1)
        self.noise = np.maximum(0.4, 1.4826 * middle / 1.41)
        self.noise = np.maximum(self.noise, 0.6 * np.sqrt((cut**2).mean(0) / 2))
        if self.rest is None:
            self.rest = np.repeat(np.median(self.x, axis=0)[None], len(self.x), 0)


def _native(path):
    """Time (n,) [s], electrodes (n, 19) and TDC (n,) of the frames of SynTouch's own log that are whole."""
    frames, frame = [], {}
    with gzip.open(path, "rt", errors="replace") as file:
        for words in map(str.split, file):
            if len(words) != 10:
                continue
            try:
                time, channel, value = float(words[0]), int(words[3]), int(words[8])
            except ValueError:
                continue
            if channel == 17:
                frame = {"time": time}
                frames.append(frame)
            if channel and frame:
                frame[channel] = value
    frames = [f for f in frames if 3 in f and all(17 + k in f for k in ALL)]
    x = np.array([[f[17 + k] for k in ALL] for f in frames], float)
    return np.array([f["time"] for f in frames]), x, np.array([f[3] for f in frames], float)


def _unloaded(x, force):
    """A straight line through the twelfth of the rows with the least force: (n, 19)."""
    press = _smooth(-force[:, 2], 25)
    least = press < np.quantile(press, 0.08)
    line = np.c_[np.ones(len(x)), np.arange(len(x)) / len(x) - 0.5]
    return np.stack([line @ np.linalg.lstsq(line[least], v[least], rcond=None)[0] for v in x.T], 1)


@functools.cache
def _source(data, name):
    if name == "btd":
        time, x, tdc = _native(data / "btd/btsp_touch.btd.gz")
        rest = np.repeat(np.median(x[:650], axis=0)[None], len(x), 0)
        return _Source(x, time, 100.0, tdc=tdc, rest=rest)
    if name.startswith("phac"):
        _, thing, finger = name.split("/")
        mat = loadmat(data / f"phac_hold/{thing}_HOLD.mat")
        x, tdc = mat[f"{finger}Electrodes"].T.astype(float), mat[f"{finger}tdc"].ravel().astype(float)
        return _Source(x, np.arange(len(x)) / 100.0, 100.0, tdc=tdc)
    electrodes, force = {
        "F1": ("epfl_flat_press/SynImpF1.txt", "epfl_flat_press/ForceData.txt"),
        "F2": ("epfl_f2/SynImpF2.txt.gz", "epfl_f2/ForceData.txt.gz"),
        "U": ("epfl_flat_press/SynImpF2.txt", None),
    }[name]
    x, time = np.loadtxt(data / electrodes), None
    time = np.arange(len(x)) / _EPFL
    if force is None:
        return _Source(x, time, _EPFL)
    force = np.loadtxt(data / force)
    return _Source(x, time, _EPFL, force, rest=_unloaded(x, force))


# ---------------------------------------------------------------- a piece


def _smooth(x, rows):
    return uniform_filter1d(x, rows, axis=0, mode="nearest")


class _Piece:
    """Rows of a source on their way.

    Attributes: x (n, 19) counts; time (n,); force (n, 3) and tdc (n,) as the file will have them; pressed
    (n,) normal force, also where the file has none; rest (n, 19); noise (19,) of the electrodes, answer
    (19,): how they move with the load; gaps: rows before which some were lost; other (m, 19): rows of
    another sensor.
    """

    def __init__(self, source, kind, first, rows, with_force, rng, other=None):
        part = slice(first, first + rows)
        self.x, self.rate, self.rng, self.other = source.x[part].copy(), source.rate, rng, other
        self.time = source.time[part].copy()
        self.force = source.force[part].copy() if with_force else None
        self.pressed = None if source.force is None else -source.force[part, 2]
        self.tdc = None if source.tdc is None else source.tdc[part].copy()
        self.rest, self.noise = source.rest[part].copy(), source.noise.copy()
        self.answer = np.maximum(_smooth(self.x - self.rest, 9).std(0), 1e-6)
        self.held, self.loaded = kind == "phac", kind in ("F1", "F2", "btd")
        self.still = kind in ("phac", "U")
        self.gaps = []

    @property
    def n(self):
        return len(self.x)

    @property
    def load(self):
        return self.x - self.rest

    def some(self, number, lively=False):
        """Electrodes, of the nine that move most or of all."""
        among = np.argsort(-self.answer)[:9] if lively else np.arange(19)
        return np.sort(self.rng.choice(among, number, replace=False))

    def row(self, low=0.25, high=0.7):
        return int(self.n * self.rng.uniform(low, high))

    def size(self, k, times, least):
        """Counts to add: so many times the noise, under a load a share of the answer at least."""
        share = least * self.answer[k] if self.loaded else 0
        return float(max(times * self.noise[k], share, 7 if self.held else 8))

    def side(self, k, size):
        """+size or -size, downward where it would leave the range."""
        size = size * (1 if self.rng.random() < 0.5 else -1)
        return -abs(size) if self.x[:, k].max() + size > 4090 else size

    def keep(self, rows):
        """Leaves rows (numbers) alone, with their times."""
        for name in ("x", "force", "tdc", "time", "rest", "pressed"):
            if getattr(self, name) is not None:
                setattr(self, name, getattr(self, name)[rows])


def _lag(x, seconds, rate):
    """One pole, along the first axis; it begins where x does."""
    a = 1 - np.exp(-1 / (seconds * rate))
    if x.ndim == 1:
        return lfilter([a], [1, -(1 - a)], x, zi=np.atleast_1d(x[0]) * (1 - a))[0]
    return lfilter([a], [1, -(1 - a)], x, axis=0, zi=(x[0] * (1 - a))[None, :])[0]


# ---------------------------------------------------------------- effects: (piece, form) -> channels


def _gain(p, form):
    number = {"slow": 2, "first": 2, "few_sudden": 4}.get(form, 1)
    c, load, rng, i, row = p.some(number, True), p.load, p.rng, np.arange(p.n), None
    for k in c:
        g = float(rng.choice([rng.uniform(0.25, 0.65), rng.uniform(1.5, 2.2)], p=[0.65, 0.35]))
        rest = p.rest[:, k].mean()
        if rest + g * load[:, k].min() < 50 or rest + g * load[:, k].max() > 4090:
            g = float(rng.uniform(0.3, 0.65))
        if form == "whole_count":
            row, g = p.row(), np.round(float(rng.uniform(0.86, 0.93)), 3)
            p.x[:, k] *= 1 + (g - 1) * np.clip((i - row) / (p.rate * 1.5), 0, 1)
            continue
        if form == "slow":
            row = row or (p.row(0.05, 0.3), p.row(0.75, 1.0))
            w = 1 + (g - 1) * np.clip((i - row[0]) / (row[1] - row[0]), 0, 1) ** 1.4
        elif form == "first":
            w = np.full(p.n, g)
        elif form == "flicker_two_levels":
            a, b, _ = p.row(0.15, 0.3), p.row(0.45, 0.6), p.row(0.75, 0.85)
            w = np.where(i < a, 1, np.where(i < b, (1 + g) / 2, g))
        else:  # sudden, few_sudden
            row = row or p.row()
            w = np.where(i >= row, g, 1)
        p.x[:, k] = p.rest[:, k] + w * load[:, k]
    return c


def _sign(p, form):
    c = p.some(3 if form == "three" else 1, True)
    row = 0 if form in ("throughout", "three") else p.row(0.3, 0.6)
    end = int(min(p.n, row + p.n * p.rng.uniform(0.25, 0.4))) if form == "interval" else p.n
    share = np.round(float(p.rng.uniform(0.55, 0.75)), 3) if form == "partial" else 1.0
    for k in c:
        load = p.x[row:end, k] - p.rest[row:end, k]
        share_k = share * min(1, (4080 - p.rest[:, k].mean()) / max(1, -load.min()))
        p.x[row:end, k] = p.rest[row:end, k] - share_k * load
    return c


def _permutation(p, form):
    row = 0
    if form == "pair":
        c = p.some(2)
    elif form == "pair_from":
        c, row = p.some(2, True), p.row()
    elif form == "cycle3_from":
        c, row = p.some(3), p.row()
    elif form == "connector_shift":
        c = np.arange(5) + int(p.rng.integers(0, 14))
    else:  # adjacent_from
        c = np.arange(2) + min(int(np.argsort(-p.answer)[p.rng.integers(5)]), 17)
        row = p.row()
    p.x[row:, c] = p.x[row:, np.roll(c, 1)]
    return c


def _offset(p, form):
    c, i = p.some({"three_mixed": 3}.get(form, 1)), np.arange(p.n)
    row = p.row()
    later = int(row + (p.n - row) * p.rng.uniform(0.4, 0.7))
    w = (i >= row) * 1.0
    if form == "there_and_back":
        w[later:] = 0
    elif form == "quick_ramp":
        w = np.clip((i - row) / (p.rate * 0.35), 0, 1)
    elif form == "staircase":
        w = 0.5 * (i >= p.row(0.15, 0.3)) + 0.5 * (i >= later)
    for k in c:
        size = p.size(k, p.rng.choice([6, 10, 20]), float(p.rng.choice([0.3, 0.6])))
        p.x[:, k] += p.side(k, size) * w
    return c


def _drift(p, form):
    c, rng, n, u = p.some({"saturating": 2, "stepless_sigmoid": 3}.get(form, 1)), p.rng, p.n, None
    u = np.linspace(0, 1, n)
    for k in c:
        if form == "random_walk":
            w = np.cumsum(gaussian_filter1d(rng.standard_normal(n), p.rate * 0.5))
            w += np.cumsum(rng.standard_normal(n)) * 0.04
            w -= w[0]
            w /= np.abs(w).max()
        elif form == "saturating":
            w = 1 - np.exp(-u / rng.uniform(0.12, 0.3))
        elif form == "mid_linear":
            row = p.row(0.3, 0.55)
            w = np.clip((np.arange(n) - row) / (n - row), 0, 1)
        elif form == "hump":
            middle = rng.uniform(0.35, 0.65)
            w = np.exp(-0.5 * ((u - middle) / rng.uniform(0.12, 0.2)) ** 2)
        else:  # stepless_sigmoid
            w = 1 / (1 + np.exp(-(u - rng.uniform(0.4, 0.6)) / 0.09))
        size = max(10, p.size(k, rng.choice([7, 14, 26]), float(rng.choice([0.45, 0.9]))))
        p.x[:, k] += p.side(k, size) * w
    return c


def _warm_up(p, form):
    n, rng, i, u = p.n, p.rng, np.arange(p.n), np.linspace(0, 1, p.n)
    if form == "exp":
        w = 1 - np.exp(-u / 0.3)
    elif form == "two_tau":
        w = 0.5 * (1 - np.exp(-u / 0.08)) + 0.5 * (1 - np.exp(-u / 0.6))
    elif form == "from_mid":
        w = 1 - np.exp(-np.maximum(0, i - p.row(0.3, 0.5)) / (n * 0.3))
    elif form == "almost_linear":
        w = 1 - np.exp(-u / 1.5)
    else:  # sqrt_late
        row = p.row(0.1, 0.2)
        w = np.sqrt(np.clip((i - row) / (n - row), 0, 1))
    w = w / w.max()
    mean = float(rng.uniform(9, 20) if p.held else rng.uniform(60, 170))
    size = np.minimum(mean * np.clip(rng.normal(1, 0.25, 19), 0.45, 1.7), 4091 - p.x.max(0))
    p.x += w[:, None] * np.maximum(size, 2)
    if p.tdc is not None:
        p.tdc = p.tdc + float(rng.uniform(25, 60)) * _lag(w, 1.0, p.rate)
    return ALL


def _temperature(p, form):
    n, rng, rate, t = p.n, p.rng, p.rate, np.arange(p.n) / p.rate
    c = np.arange(19)
    if form == "follow_own_tdc":
        d = _smooth(p.tdc, 25) - p.tdc[:20].mean()
        share = rng.uniform(0.35, 0.9, 19)
    elif form == "draught":
        wave = np.sin(2 * np.pi * t / rng.uniform(3.2, 5) + rng.uniform(0, 6)) > rng.uniform(-0.3, 0.3)
        d = -_lag(wave.astype(float), 0.9, rate) * rng.uniform(22, 35)
        d -= d[0]
        p.tdc, share = p.tdc + d, rng.uniform(0.3, 0.8, 19)
    elif form == "warm_hand":
        since = np.clip(t - p.row(0.25, 0.45) / rate, 0, None)
        d = (1 - np.exp(-since / 1.6)) * np.exp(-since / 7) * rng.uniform(40, 60)
        p.tdc, share = p.tdc + d, rng.uniform(0.3, 0.7, 19)
        d = _lag(d, 0.4, rate)
    elif form == "few_lagging":
        slow = gaussian_filter1d(rng.standard_normal(n + 4000), rate * 1.0)[2000 : 2000 + n]
        d = (slow - slow[0]) / slow.std() * 14
        p.tdc, share, c = p.tdc + d, np.zeros(19), p.some(5)
        share[c] = rng.uniform(0.7, 1.3, 5) * np.where(rng.random(5) < 0.75, 1, -1)
        d = _lag(d, 0.3, rate)
    else:  # mixed_sign
        d = 10 * np.sin(2 * np.pi * t / 6.5) + 8 * np.sin(2 * np.pi * t / 10 + 1)
        d -= d[0]
        p.tdc = p.tdc + d
        share = rng.uniform(0.25, 0.8, 19) * np.where(rng.random(19) < 0.7, 1, -1)
    p.x += d[:, None] * share
    return c


def _fluid_loss(p, form):
    """Counts fall, most at the tip and in the middle, and a load is answered by up to a quarter more."""
    n, rng, u = p.n, p.rng, np.linspace(0, 1, p.n)
    if form == "linear":
        w = u
    elif form == "leak_from_mid":
        row = p.row(0.25, 0.5)
        w = (1 - np.exp(-2.2 * np.clip((np.arange(n) - row) / (n - row), 0, 1))) / (1 - np.exp(-2.2))
    elif form == "under_pressure":
        w = np.cumsum(np.clip(_smooth(p.pressed, 15) - 2, 0, None) ** 1.5)
        w /= w[-1]
    elif form == "accelerating":
        w = u**2
    else:  # weeping_steps
        w = gaussian_filter1d(np.interp(u, np.sort(rng.random(9)), np.linspace(0, 1, 9)), p.rate * 0.8)
        w = (w - w[0]) / (w[-1] - w[0])
    share = np.clip(rng.normal(1, 0.2, 19), 0.5, 1.6)
    share[[6, 7, 8, 9, 16, 17, 18]] *= 1.4
    size = float(rng.uniform(10, 20) if p.held else rng.uniform(70, 190))
    answer = 1 if p.still else (1 + 0.25 * w)[:, None]
    p.x = p.rest + p.load * answer - size * w[:, None] * share
    return ALL


def _relaxation(p, form):
    load, c = p.load, np.arange(19)
    smooth = _smooth(load, 3)
    a, tau = float(p.rng.uniform(0.2, 0.42)), float(p.rng.uniform(1.5, 5))
    if form == "creep_one_tau":
        y = load + a * _lag(smooth, tau, p.rate)
    elif form == "relax_one_tau":
        y = load - a * _lag(smooth - smooth[0], tau, p.rate)
    elif form == "log_time":
        y = load * (1 - a) + a * sum(_lag(smooth, s, p.rate) for s in (0.6, 2, 6, 15)) / 4
    elif form == "after_release_only":
        late = _lag(smooth, tau, p.rate)
        y = load + a * 1.3 * np.where(np.abs(late) > np.abs(smooth), late - smooth, 0)
    else:  # tip_only
        c = np.array([6, 7, 8, 9])
        y = load * (1 - a * 1.2) + a * 1.2 * _lag(smooth, tau, p.rate)
    p.x[:, c] = (p.rest + y)[:, c]
    return c


def _play(x, width):
    """x (n, c) with play of half a width (c,)."""
    y, s = np.empty_like(x), x[0].copy()
    for j, now in enumerate(x):
        s = np.minimum(np.maximum(s, now - width), now + width)
        y[j] = s
    return y


def _hysteresis(p, form):
    load, c = p.load, np.arange(19)
    smooth = _smooth(load, 5)
    span = np.quantile(smooth, 0.97, axis=0) - np.quantile(smooth, 0.03, axis=0)
    a = float(p.rng.uniform(0.13, 0.24))
    fast = load - smooth
    if form == "play":
        y = _play(smooth, a * span) + fast
    elif form == "many_plays":
        y = 0.4 * load + sum(0.2 * _play(smooth, q * 2 * a * span) for q in (0.3, 0.7, 1.0))
    elif form == "five_electrodes":
        c = p.some(5, True)
        y = _play(smooth, 1.2 * a * span) + fast
    elif form == "rate_direction":
        speed = gaussian_filter1d(np.gradient(smooth, axis=0), p.rate * 0.12, axis=0)
        y = load - a * span * np.tanh(2 * lfilter([1], [1, -0.985], speed, axis=0) / (0.2 * span + 1))
    else:  # from_mid
        row, y = p.n // 2, load.copy()
        y[row:] = _play(smooth[row:], a * span) + fast[row:]
    p.x[:, c] = (p.rest + y)[:, c]
    return c


def _latency(p, form):
    m, i, row, c = int(p.rng.integers(9, 32)), np.arange(p.n), 0, np.arange(19)
    if form == "few_throughout":
        c = p.some(3, True)
    elif form == "one_from":
        c, row, m = p.some(1, True), p.row(0.2, 0.4), int(m * 1.4)
    elif form == "all_growing":
        m = np.rint(np.linspace(0, int(m * 1.8), p.n)).astype(int)
    elif form == "half_board":
        c = np.arange(9, 19)
    p.x[row:, c] = p.x[:, c][np.clip(i - m, 0, None)][row:]
    return c


def _low_pass(p, form):
    rng, row, c = p.rng, 0, np.arange(19)
    if form == "all_one_pole":
        y = _lag(p.x, float(rng.uniform(0.12, 0.35)), p.rate)
    elif form == "one_strong":
        c = p.some(1, True)
        y = _lag(p.x, float(rng.uniform(0.4, 0.9)), p.rate)
    elif form == "boxcar_few":
        c = p.some(4, True)
        m = int(int(rng.integers(21, 51)) / p.rate * p.rate)
        y = lfilter(np.ones(m) / m, 1, p.x - p.x[0], axis=0) + p.x[0]
    elif form == "one_from":
        c = p.some(1, True)
        seconds, row = float(rng.uniform(0.25, 0.6)), p.row(0.3, 0.55)
        y = _lag(p.x, seconds, p.rate)
    else:  # butter_all_from
        row = p.row(0.3, 0.5)
        sections = butter(2, float(rng.uniform(0.9, 2)), fs=p.rate, output="sos")
        y = sosfilt(sections, p.x - p.x[0], axis=0) + p.x[0]
    p.x[row:, c] = y[row:, c]
    return c


def _noise(p, form):
    n, rng, w = p.n, p.rng, np.ones(p.n)
    times, draw = float(rng.choice([1.8, 3, 4.5, 7])), rng.standard_normal((p.n, 19))
    if form == "one_throughout":
        c = p.some(1)
    elif form == "all_throughout":
        c, times = np.arange(19), max(1.6, times * 0.7)
    elif form == "one_from":
        c = p.some(1)
        w[: p.row()] = 0
    elif form == "two_growing":
        c, w = p.some(2), np.linspace(0, 1.5, n) ** 1.5
    elif form == "pink_few":
        c, times = p.some(3), times * 1.2
        f = np.maximum(np.fft.rfftfreq(n, 1 / p.rate), 0.8)
        draw = np.fft.irfft(np.fft.rfft(draw, axis=0) / np.sqrt(f)[:, None], n, axis=0)
        draw /= draw.std(0)
    else:  # heavy_tailed
        c, draw = p.some(1), rng.standard_t(4, (n, 19)) / 1.41
    p.x[:, c] += (draw * w[:, None] * times * np.maximum(p.noise, 0.7))[:, c]
    return c


def _line_noise(p, form):
    """[Hz] before the converter."""
    n, rng, w, c = p.n, p.rng, np.ones(p.n), np.arange(19)
    times = float(rng.choice([1.5, 2.5, 4, 7]))
    if form == "all_50":
        f = 50.0 + rng.normal(0, 0.03) - (2.7 if p.rate == 100 else 0)
    elif form == "one_60":
        c, f = p.some(1), 60 + rng.normal(0, 0.03)
    elif form == "few_pump_16":
        c, f = p.some(4), rng.uniform(14, 22)
    elif form == "all_from_harm":
        f = rng.uniform(8, 13)
        w[: p.row(0.25, 0.6)] = 0
    else:  # fm_wander_one
        c, f = p.some(2), rng.uniform(24, 36)
    phase = rng.uniform(0, 0.6 if len(c) == 19 else 6.28, 19)
    wander = 0.004 * np.cumsum(rng.standard_normal(n)) if form == "fm_wander_one" else np.zeros(n)
    wave = np.sin(2 * np.pi * f * p.time[:, None] + wander[:, None] + phase)
    if form == "all_from_harm":
        wave = wave + 0.4 * np.sin(4 * np.pi * f * p.time[:, None] + 2 * phase + 1)
    size = times * np.maximum(p.noise, 0.8) * rng.uniform(0.7, 1.3, 19)
    p.x[:, c] += (wave * size * w[:, None])[:, c]
    return c


def _cross_talk(p, form):
    rng, load, before = p.rng, p.load, np.roll(p.x, 1, axis=1)
    g = float(rng.uniform(0.15, 0.4))
    heard = np.argsort(-(np.abs(p.answer[np.arange(-1, 18)]) / (p.answer + 15)))[:5]
    y, row = p.x.copy(), 0
    if form == "all_settling":
        c, g = np.arange(1, 19), g * 0.6
        y[:, c] = (1 - g) * p.x[:, c] + g * before[:, c]
    elif form == "absolute_one":
        c, g = rng.choice(heard[heard > 0], 1), max(g, 0.25)
        y[:, c] = (1 - g) * p.x[:, c] + g * p.x[:, c - 1]
    elif form == "next_two":
        c = rng.choice(np.argsort(-np.roll(p.answer, -1) / (p.answer + 15))[:5], 2, replace=False)
        y[:, c] += g * np.roll(load, -1, axis=1)[:, c]
    else:  # one, one_from
        c = rng.choice(heard, 1)
        row = p.row(0.3, 0.55) if form == "one_from" else 0
        y[row:, c] += g * np.roll(load, 1, axis=1)[row:, c]
    p.x = y
    return np.sort(c)


def _quantisation(p, form):
    row, c = 0, np.arange(19)
    step = int(p.rng.choice([4, 8, 16] if p.held else [8, 16, 32]))
    if form == "all_8bit":
        step = 16
    elif form == "one":
        c, step = p.some(1), max(step, 16)
    elif form == "from_mid":
        row, step = p.row(), max(step, 8)
    elif form == "round_decimal":
        step = 5 if p.held else 10
    p.x = np.rint(p.x)
    cut = np.rint if form == "round_decimal" else np.floor
    p.x[row:, c] = cut(p.x[row:, c] / step) * step
    return c


def _saturation(p, form):
    rng, x = p.rng, p.x
    if form == "low_one":
        c = [int(np.argmax(p.answer))]
        x[:, c] = np.maximum(x[:, c], np.quantile(x[:, c], rng.uniform(0.12, 0.3)))
    elif form == "high_all":
        highest = np.argsort(x.max(0))[-5:]
        limit = np.sort(x.max(0))[-4] - rng.uniform(0.2, 0.5) * p.answer[highest].mean() - 10
        limit = float(int(limit))
        c = np.where(x.max(0) > limit)[0]
        p.x = np.minimum(x, limit)
    elif form == "high_4095":
        c = [int(np.argsort(-p.answer)[rng.integers(3)])]
        x[:, c] += 4095 - np.quantile(x[:, c], rng.uniform(0.55, 0.75))
    elif form == "low_zero":
        c = [int(np.argsort(-p.answer)[rng.integers(2)])]
        x[:, c] -= np.quantile(x[:, c], rng.uniform(0.2, 0.35))
    else:  # soft_two_from
        c, row = np.sort(np.argsort(-p.answer)[:2]), p.row(0.1, 0.25)
        for k in c:
            limit, width = np.quantile(x[:, k], 0.25), 0.06 * np.ptp(x[:, k]) + 3
            x[row:, k] = limit + width * np.logaddexp(0, (x[row:, k] - limit) / width)
    return c


def _stuck(p, form):
    k, row, end = int(p.some(1, p.loaded)[0]), p.row(), p.n
    value = np.rint(p.x[row, k])
    if form == "rail_high_from":
        value = 4095
    elif form == "rail_zero_first":
        row, value = 0, 0
    elif form == "value_first_jitter":
        row, value = 0, float(p.rng.integers(1800, 3300))
        value = value + (p.rng.random(p.n) < 0.04)
    elif form == "interval":
        end = int(row + (p.n - row) * 0.6)
    p.x[row:end, k] = value
    return [k]


def _spikes(p, form):
    n, rng = p.n, p.rng
    m = max(8, int(n * float(rng.choice([0.002, 0.004, 0.008]))))
    rows, c = np.sort(rng.choice(np.arange(3, n - 3), m, replace=False)), np.arange(19)
    if form == "one_random":
        c = p.some(1)
        size = p.size(c[0], 18, 0.8)
        p.x[rows, c[0]] += rng.choice([-1, 1], m) * size * rng.uniform(0.7, 1.8, m)
    elif form == "frames_all":
        size = 25 if p.held else 70
        p.x[rows] += rng.choice([-1, 1], m)[:, None] * size * rng.uniform(0.5, 1.6, (m, 19))
    elif form == "bitflip_random_channel":
        where = rng.integers(0, 19, m)
        p.x[rows, where] = np.rint(p.x[rows, where]).astype(int) ^ 256
    elif form == "to_zero_one":
        c = p.some(1)
        p.x[rows, c[0]] = 0
    else:  # downward_few
        c = p.some(3)
        size = max(60, 15 * p.noise[c].max())
        for k in c:
            rows = rng.choice(np.arange(3, n - 3), m, replace=False)
            p.x[rows, k] -= size * rng.exponential(1, m) + size * 0.5
    return c


def _lost(p, form):
    n, rng, keep = p.n, p.rng, np.ones(p.n, bool)
    if form == "random_single":
        share = rng.uniform(0.015, 0.05)
        keep[rng.choice(np.arange(2, n - 2), int(n * share), replace=False)] = False
    elif form == "one_gap":
        row = p.row()
        keep[row : row + int(p.rate * rng.uniform(0.6, 2.2))] = False
    elif form == "bursts":
        for row in rng.choice(np.arange(50, n - 80), int(rng.integers(5, 10)), replace=False):
            keep[row : row + int(rng.integers(5, 25))] = False
    elif form == "periodic":
        every = int(rng.integers(23, 90))
        keep[int(rng.integers(5, every)) :: every] = False
    else:  # late_worse
        keep = rng.random(n) > np.linspace(0, 0.12, n)
        keep[0] = True
    rows = np.flatnonzero(keep)
    p.keep(rows)
    p.gaps = list(np.flatnonzero(np.diff(rows) > 1) + 1)
    return ALL


def _held(p, form):
    n, rng, i = p.n, p.rng, np.arange(p.n)
    if form == "bursts":
        for row in rng.choice(np.arange(50, n - 80), int(rng.integers(8, 16)), replace=False):
            i[row : row + int(rng.integers(6, 20))] = row
    elif form == "one_freeze":
        row = p.row()
        i[row : row + int(p.rate * rng.uniform(0.8, 2.2))] = row
    elif form == "every4":
        i = i // 4 * 4
    elif form == "random_double":
        i = np.maximum.accumulate(np.where(np.r_[False, (rng.random(n) < 0.35)[1:]], 0, i))
    else:  # from_mid_every5
        row = p.row(0.35, 0.6)
        i[row:] = row + (i[row:] - row) // 5 * 5
    p.x = p.x[i]
    if p.tdc is not None:
        p.tdc = p.tdc[i]
    return ALL


LAWS = {
    "gain": _gain,
    "sign": _sign,
    "permutation": _permutation,
    "offset": _offset,
    "drift": _drift,
    "warm_up": _warm_up,
    "temperature": _temperature,
    "fluid_loss": _fluid_loss,
    "relaxation": _relaxation,
    "hysteresis": _hysteresis,
    "latency": _latency,
    "low_pass": _low_pass,
    "noise": _noise,
    "line_noise": _line_noise,
    "cross_talk": _cross_talk,
    "quantisation": _quantisation,
    "saturation": _saturation,
    "stuck": _stuck,
    "spikes": _spikes,
    "lost_samples": _lost,
    "held_samples": _held,
}


# ------------------------------------------ outside the catalogue: (piece, least noise, size (19,)) -> None


def _since(p, row):
    """[s] since a row, 0 before it, and whether it is past."""
    i = np.arange(p.n)
    return np.clip((i - row) / p.rate, 0, None), i >= row


def _bubble_passes(p, noise, size):
    row = p.row(0.25, 0.5)
    for q, k in enumerate((6, 7, 8, 9)):
        t = (np.arange(p.n) - (row + q * p.rate * 0.7)) / p.rate
        a = 1.6 * max(size[k], 25) * p.rng.uniform(0.8, 1.3)
        p.x[:, k] -= a * np.where(t < 0, np.exp(-((t / 0.25) ** 2)), np.exp(-((t / 0.6) ** 2)))


def _bubble_wobbles(p, noise, size):
    c, w = np.array([16, 17, 18]), np.zeros(p.n)
    for row in p.rng.choice(p.n - 200, 8, replace=False):
        t = (np.arange(p.n) - row) / p.rate
        ring = np.exp(-np.clip(t, 0, 50) / 1.2) * np.cos(2 * np.pi * 1.8 * t)
        w += np.where(t > 0, ring, 0) * p.rng.uniform(0.5, 1.2)
    p.x[:, c] += w[:, None] * size[c] * 1.2 * p.rng.uniform(0.8, 1.2, 3)


def _intermittent(p, noise, size):
    k, off, on, row = int(p.some(1)[0]), np.zeros(p.n), 0, 0
    while row < p.n:
        rows = int(p.rng.exponential(p.rate * (0.35 if on else 1.8))) + 2
        off[row : row + rows] = on
        row, on = row + rows, 1 - on
    p.x[:, k] += max(120, 3 * p.answer[k]) * off * np.where(p.rng.random(p.n) < 0.8, 1, 0.4)
    p.x[:, k] = np.minimum(p.x[:, k], 4070)


def _knocked(p, noise, size):
    for row in np.sort(p.rng.choice(np.arange(200, p.n - 200), 4, replace=False)):
        t, past = _since(p, row)
        w = np.where(past, np.exp(-t / 0.22) * np.sin(2 * np.pi * 11 * t + 0.4), 0)
        a = size * p.rng.uniform(1.0, 2.2)
        p.x += w[:, None] * a * p.rng.uniform(0.5, 1.2, 19) * np.sign(p.rng.standard_normal(19))


def _modulated(p, noise, size):
    f, m = p.rng.uniform(0.5, 1.1), p.rng.uniform(0.2, 0.35)
    p.x = p.rest + p.load * (1 + m * np.sin(2 * np.pi * f * p.time)[:, None])


def _halves(p, noise, size):
    row = int(p.n * p.rng.uniform(0.4, 0.6))
    p.x = np.r_[p.x[row:], p.x[:row]]


def _bursts(p, noise, size):
    rng = p.rng
    for row in rng.choice(p.n - 400, 7, replace=False):
        rows = min(int(p.rate * rng.uniform(0.5, 1.8)), p.n - row)
        t = np.arange(rows) / p.rate
        w = np.hanning(rows) * np.sin(2 * np.pi * (rng.uniform(3, 30) * t + rng.uniform(-8, 8) * t * t))
        p.x[row : row + rows] += w[:, None] * noise * 6 * rng.uniform(0.5, 1.4, 19)


def _rubbing(p, noise, size):
    rng = p.rng
    band = butter(2, [4, 18], "band", fs=p.rate, output="sos")
    wave = sosfiltfilt(band, rng.standard_normal((p.n, 19)), axis=0)
    wave /= wave.std(0)
    on = np.zeros(p.n)
    for row in rng.choice(p.n - 400, 4, replace=False):
        on[row : row + int(p.rate * rng.uniform(1.5, 4))] = 1
    on = gaussian_filter1d(on, p.rate * 0.15)[:, None]
    c = np.array([0, 1, 2, 9, 10, 16] if rng.random() < 0.5 else [6, 7, 8, 9, 16, 17])
    p.x[:, c] += (on * (0.7 * wave[:, :1] + 0.5 * wave) * noise * 6)[:, c]


def _reversed(p, noise, size):
    row, rows = p.row(0.2, 0.4), int(p.n * 0.3)
    p.x[row : row + rows] = p.x[row : row + rows][::-1].copy()


def _echo(p, noise, size):
    late, a = int(p.rate * p.rng.uniform(0.9, 1.6)), p.rng.uniform(0.25, 0.4)
    load, ghost = p.load, np.zeros(p.x.shape)
    ghost[late:] = load[:-late] - load[0]
    p.x = p.x + a * ghost


def _bit(p, noise, size):
    k, row = int(p.some(1, True)[0]), p.row(0.2, 0.45)
    p.x[:, k] = np.rint(p.x[:, k])
    p.x[row:, k] = p.x[row:, k].astype(int) ^ 32


def _pulse(p, noise, size):
    wander = gaussian_filter1d
    f = p.rng.uniform(1.0, 1.4)
    f = f * (1 + 0.05 * wander(p.rng.standard_normal(p.n), p.rate) * 8)
    phase = np.cumsum(f) / p.rate % 1
    w = np.exp(-0.5 * ((phase - 0.2) / 0.06) ** 2) + 0.35 * np.exp(-0.5 * ((phase - 0.5) / 0.09) ** 2)
    p.x += w[:, None] * noise * 5 * np.clip(p.rng.normal(1, 0.4, 19), 0.2, 2)


def _footsteps(p, noise, size):
    rng, every, w = p.rng, int(p.rate * p.rng.uniform(0.5, 0.7)), np.zeros(p.n)
    for row in range(int(every * 0.4), p.n, every):
        t = (np.arange(p.n) - (row + int(rng.normal(0, 0.03 * p.rate)))) / p.rate
        ring = np.exp(-np.clip(t, 0, 30) / 0.06) * np.cos(2 * np.pi * 14 * t)
        w += np.where(t >= 0, ring, 0) * rng.uniform(0.6, 1.3)
    p.x += w[:, None] * noise * 8 * rng.uniform(0.4, 1.3, 19) * np.sign(rng.standard_normal(19))


def _pumping(p, noise, size):
    level = np.abs(_smooth(p.load, 5)).mean(1)
    g = 1 / (1 + 1.1 * _lag(level, 0.8, p.rate) / np.quantile(level, 0.9))
    p.x = p.rest + p.load * (g / np.median(g))[:, None]


def _foreign(p, noise, size):
    row, rows = p.row(0.3, 0.45), int(p.n * 0.2)
    at = int(p.rng.integers(0, len(p.other) - rows))
    p.x[row : row + rows] = p.other[at : at + rows]


def _sag(p, noise, size):
    a, mean = p.rng.uniform(0.5, 0.9), _smooth(p.load, 3).mean(1)
    p.x = p.x + a * (np.abs(mean) - np.abs(mean).min())[:, None] * -1


def _discharges(p, noise, size):
    for row in p.rng.choice(np.arange(100, p.n - 300), 6, replace=False):
        t, past = _since(p, row)
        w = np.where(past, np.exp(-t / p.rng.uniform(0.15, 0.6)), 0)
        p.x += w[:, None] * size * 2 * p.rng.choice([-1, 1]) * p.rng.uniform(0.3, 1.4, 19)


def _wraps(p, noise, size):
    k = int(np.argsort(-p.answer)[1])
    top = np.quantile(p.x[:, k], p.rng.uniform(0.5, 0.75))
    p.x[:, k] = np.rint(p.x[:, k] + 4095 - top).astype(int) % 4096


def _oscillation(p, noise, size):
    c, row = p.some(2), p.row(0.3, 0.6)
    t, last = (np.arange(p.n) - row) / p.rate, (p.n - row) / p.rate
    grown = np.where(t > 0, np.exp(np.clip(t / last * 3.2, 0, 3.2)) - 1, 0) / 23
    f = p.rng.uniform(2, 6)
    wave = np.sin(2 * np.pi * (f * t + 0.5 * f * 0.05 * t * t))
    p.x[:, c] += (grown * wave)[:, None] * size[c] * 2.5


def _short(p, noise, size):
    row = p.row(0.3, 0.5)
    both = p.x[row:][:, [2, 14]].mean(1)
    for k in (2, 14):
        p.x[row:, k] = both + p.rng.standard_normal(p.n - row)


def _dead_band(p, noise, size):
    c = p.some(3, True)
    width, load = 0.55 * p.answer[c], p.load[:, c]
    through = np.sign(load) * np.maximum(np.abs(load) - width, 0)
    p.x[:, c] = p.rest[:, c] + through + p.rng.standard_normal((p.n, 3)) * noise[c] * 0.5


def _interpolated(p, noise, size):
    for row in np.sort(p.rng.choice(np.arange(100, p.n - 500), 4, replace=False)):
        rows = int(p.rate * p.rng.uniform(0.8, 2.0))
        w = np.linspace(0, 1, rows + 1)[:, None]
        p.x[row : row + rows + 1] = p.x[row] * (1 - w) + p.x[row + rows] * w


def _shuffled(p, noise, size):
    rows, first = int(p.rng.integers(8, 14)), p.row(0.3, 0.5)
    i = np.arange(p.n)
    for a in range(first, p.n - 2 * rows, 2 * rows):
        if p.rng.random() < 0.5:
            i[a : a + 2 * rows] = np.roll(i[a : a + 2 * rows], rows)
    p.x = p.x[i]


def _clock(p, noise, size):
    p.time[p.row() :] += p.rng.choice([-1, 1]) * p.rng.uniform(1.5, 9.0)


def _stick_slip(p, noise, size):
    c, w, rng = np.array([0, 1, 2, 9, 10, 11, 16]), np.zeros(p.n), p.rng
    row, end = int(p.n * rng.uniform(0.15, 0.3)), int(p.n * rng.uniform(0.7, 0.9))
    while row < end:
        rows, high = max(6, int(p.rate * rng.uniform(0.2, 0.5))), rng.uniform(0.5, 1.3)
        w[row : row + rows] = high * np.linspace(0, 1, rows)[: len(w[row : row + rows])]
        row += rows
    a = np.maximum(6 * noise, 0.2 * p.answer) * rng.uniform(0.5, 1.3, 19)
    p.x[:, c] += (w[:, None] * a * np.sign(rng.standard_normal(19)))[:, c]


def _tremor(p, noise, size):
    f = p.rng.uniform(6, 9) + 0.5 * gaussian_filter1d(p.rng.standard_normal(p.n), p.rate * 0.3) * 5
    strength = np.clip(1 + gaussian_filter1d(p.rng.standard_normal(p.n), p.rate) * 9, 0, 3)
    a = p.answer * 0.12 * np.sign(p.rng.standard_normal(19))
    a = np.where(np.abs(a) < 2 * noise, np.sign(a) * 2 * noise, a)
    p.x += (strength * np.sin(2 * np.pi * np.cumsum(f) / p.rate))[:, None] * a


OUTSIDE = {
    "bubble_passes": _bubble_passes,
    "bubble_wobbles": _bubble_wobbles,
    "intermittent_contact": _intermittent,
    "knocked_housing": _knocked,
    "amplitude_modulated": _modulated,
    "halves_swapped": _halves,
    "interference_bursts": _bursts,
    "rubbing": _rubbing,
    "segment_reversed": _reversed,
    "ghost_echo": _echo,
    "bit_inverted": _bit,
    "pulse_beat": _pulse,
    "footsteps": _footsteps,
    "agc_pumping": _pumping,
    "foreign_middle": _foreign,
    "common_mode_sag": _sag,
    "esd_transients": _discharges,
    "wrap_around": _wraps,
    "oscillation_grows": _oscillation,
    "short_of_distant": _short,
    "deadband": _dead_band,
    "interpolated_gaps": _interpolated,
    "blocks_shuffled": _shuffled,
    "clock_jump": _clock,
    "tremor": _tremor,
    "stick_slip": _stick_slip,
}


# ---------------------------------------------------------------- the plan


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base, with +f at its end where the file has the force; first: row of the source; rows;
    drawn: the piece's number in the author's own order, numbers taken from its stream before its effects,
    and half of one that was left over, or None; effects: of (kind, form), the author's names, of one outside
    the catalogue (kind, "")."""

    name: str
    base: str
    first: int
    rows: int
    drawn: tuple
    effects: tuple

    @property
    def outside(self) -> bool:
        return bool(self.effects) and self.effects[0][0] in OUTSIDE

    @property
    def kinds(self) -> tuple:
        """Of the benchmark's vocabulary."""
        if self.outside:
            return ("outside_loaded",) if self.base[:2] in ("F1", "F2") else ("outside",)
        return tuple(KINDS[kind] for kind, _ in self.effects)

    def stream(self) -> np.random.Generator:
        """The author's, where this piece's effects begin."""
        number, taken, left = self.drawn
        bits = np.random.PCG64([_SEED, number]).advance(taken)
        if left is not None:
            bits.state = bits.state | {"has_uint32": 1, "uinteger": left}
        return np.random.Generator(bits)


def plan() -> list[Spec]:
    """197 pieces: singles, pairs, outside the catalogue, untouched. The author's two of logs that were tared
    are left out: none is read."""
    return [
        Spec(f"{number:03d}", *where, tuple((e, "") if isinstance(e, str) else e for e in effects))
        for number, *where, effects in ((*row[:5], row[5:]) for row in _PLAN)
    ]


def make(spec: Spec, data: str) -> tuple[dict, np.ndarray]:
    """Fields of the case, its counts as a file has them, and the counts without what is hidden (n, 19), rows
    that are lost later among them."""
    folder, name = pathlib.Path(data), spec.base.removesuffix("+f")
    kind, other = name.split("/")[0], None
    if spec.effects[:1] == (("foreign_middle", ""),):
        other = _source(folder, "F1" if kind == "F2" else "F2").x
    with_force = spec.base.endswith("+f")
    p = _Piece(_source(folder, name), kind, spec.first, spec.rows, with_force, spec.stream(), other)
    clean, channels, noise = p.x.copy(), [], p.noise
    for effect, form in spec.effects:
        if spec.outside:
            least = np.maximum(noise, 1)
            OUTSIDE[effect](p, least, np.maximum(8 * least, 0.35 * p.answer if p.loaded else 0))
            channels.append(ALL)
        else:
            channels.append([int(k) for k in LAWS[effect](p, form)])
    p.x, seen = np.rint(p.x).clip(0, 4095), []
    if spec.effects and p.x.shape == clean.shape:
        seen = [float(np.sqrt(((p.x - clean) ** 2).mean(0) / noise**2).max())]
    case = {
        "base": f"tenth {kind}",
        "counts": p.x,
        "rate": p.rate,
        "force": None if p.force is None else np.array([[float(f"{v:.6g}") for v in r] for r in p.force]),
        "tdc": None if p.tdc is None else np.rint(p.tdc),
        "loaded": kind in ("F1", "F2"),
        "channels": channels,
        "truth": list(spec.kinds),
        "forms": [form or effect for effect, form in spec.effects],
        "seen": seen,
        "gaps": p.gaps,
        "time": np.array([float(f"{v:.4f}") for v in p.time]),
    }
    return case, clean


# number, base, first row, rows, where in the stream, effects: (kind, form), or what is outside the catalogue
_PLAN = (
    (1, "F2", 7446, 1990, (156, 123, 810504456), "stick_slip"),
    (2, "F1+f", 18798, 3491, (164, 124, None)),
    (3, "F1", 15788, 3005, (170, 124, None)),
    (4, "F1", 629, 5580, (47, 123, 3463101958), ("relaxation", "log_time")),
    (5, "btd", 184, 1547, (193, 2, None)),
    (6, "F2+f", 17307, 6317, (57, 123, 2580533223), ("latency", "one_from")),
    (7, "F2+f", 12961, 2037, (155, 123, 2458137290), "tremor"),
    (8, "F2+f", 264, 2820, (101, 124, None), ("spikes", "downward_few")),
    (9, "F1", 12412, 4417, (43, 124, None), ("fluid_loss", "accelerating")),
    (10, "F1+f", 9631, 6426, (55, 123, 3352842209), ("latency", "all_throughout")),
    (11, "F1", 7168, 2477, (90, 124, None), ("saturation", "low_zero")),
    (13, "phac/steel_vase_702_02/F1", 0, 1000, (35, 2, 2893673858), ("temperature", "follow_own_tdc")),
    (14, "F1+f", 10529, 3917, (19, 124, None), ("offset", "step")),
    (15, "F1", 14578, 6898, (6, 123, None), ("gain", "whole_count")),
    (16, "phac/car_sponge_101_02/F0", 0, 1000, (36, 2, 2301378392), ("temperature", "draught")),
    (17, "F1", 7589, 1966, (17, 124, None), ("permutation", "adjacent_from")),
    (18, "phac/steel_vase_702_04/F1", 0, 1000, (185, 2, 486719390)),
    (19, "F2+f", 4778, 4992, (58, 123, 79946748), ("latency", "all_growing")),
    (20, "phac/car_sponge_101_04/F0", 0, 1000, (26, 2, 1315368660), ("drift", "saturating")),
    (21, "phac/acrylic_211_05/F0", 0, 1000, (149, 2, 2804564871), "oscillation_grows"),
    (
        22,
        "phac/car_sponge_101_03/F0",
        0,
        1000,
        (124, 1, None),
        ("temperature", "draught"),
        ("noise", "all_throughout"),
    ),
    (23, "F1+f", 6821, 3531, (34, 124, None), ("warm_up", "sqrt_late")),
    (
        24,
        "phac/acrylic_211_04/F1",
        0,
        1000,
        (127, 2, 746805474),
        ("drift", "saturating"),
        ("line_noise", "few_pump_16"),
    ),
    (25, "F1+f", 8873, 6116, (4, 123, None), ("gain", "few_sudden")),
    (26, "F1+f", 202, 2165, (128, 123, None), ("hysteresis", "play"), ("noise", "one_from")),
    (27, "U", 6773, 2615, (20, 43, None), ("offset", "three_mixed")),
    (28, "U", 11503, 2399, (104, 43, None), ("lost_samples", "bursts")),
    (29, "phac/steel_vase_702_01/F0", 0, 1000, (97, 2, 283699056), ("spikes", "one_random")),
    (30, "F2", 21962, 1706, (85, 124, None), ("quantisation", "from_mid")),
    (31, "F1", 76, 2253, (145, 123, 1018424445), "foreign_middle"),
    (32, "F1", 11436, 3821, (172, 124, None)),
    (33, "U", 17637, 2127, (132, 42, 590883585), "intermittent_contact"),
    (34, "phac/acrylic_211_03/F0", 0, 1000, (93, 2, 3322814687), ("stuck", "rail_high_from")),
    (35, "F1", 16603, 5612, (80, 123, 1774358806), ("cross_talk", "absolute_one")),
    (36, "U", 205, 2006, (15, 43, None), ("permutation", "cycle3_from")),
    (37, "F1+f", 11586, 1823, (150, 123, 1481886002), "short_of_distant"),
    (38, "F2+f", 6898, 16408, (197, 123, 1322261868)),
    (39, "phac/steel_vase_702_03/F0", 0, 1000, (191, 2, 3923858748)),
    (40, "U", 18169, 3511, (28, 43, None), ("drift", "hump")),
    (41, "F1", 680, 2384, (8, 123, 408508546), ("sign", "from_time")),
    (42, "F2+f", 3016, 6115, (77, 123, 1490624875), ("cross_talk", "one")),
    (43, "F1", 4806, 7611, (168, 124, None)),
    (44, "phac/car_sponge_101_03/F1", 0, 1000, (31, 2, 2731941355), ("warm_up", "two_tau")),
    (45, "F2+f", 20301, 3360, (160, 124, None)),
    (46, "F1", 14458, 2429, (114, 123, 3710622822), ("stuck", "hold_from"), ("spikes", "one_random")),
    (47, "F1+f", 2521, 2073, (159, 124, None)),
    (48, "F2+f", 5786, 1895, (139, 123, 2432635314), "segment_reversed"),
    (49, "U", 4338, 1506, (22, 43, None), ("offset", "quick_ramp")),
    (50, "F1", 12090, 2430, (122, 123, None), ("sign", "throughout"), ("noise", "heavy_tailed")),
    (52, "phac/car_sponge_101_04/F1", 0, 1000, (25, 2, 1675544227), ("drift", "random_walk")),
    (53, "F2", 4803, 5794, (171, 124, None)),
    (54, "phac/steel_vase_702_03/F0", 0, 1000, (106, 2, 4134796011), ("lost_samples", "late_worse")),
    (55, "F2", 9140, 2306, (63, 123, 2396136573), ("low_pass", "one_from")),
    (56, "F2+f", 5576, 3581, (30, 124, None), ("warm_up", "exp")),
    (57, "U", 17303, 3534, (182, 43, None)),
    (58, "F1", 5542, 5124, (61, 123, 2725576988), ("low_pass", "one_strong")),
    (59, "F1+f", 16495, 5977, (100, 124, None), ("spikes", "to_zero_one")),
    (60, "U", 15238, 3756, (40, 43, None), ("fluid_loss", "linear")),
    (61, "F2", 20134, 2051, (152, 123, 958262182), "interpolated_gaps"),
    (62, "U", 20177, 2074, (113, 42, 72016558), ("offset", "step"), ("noise", "one_from")),
    (63, "F2", 17766, 1836, (140, 123, 227082250), "ghost_echo"),
    (64, "F2+f", 12042, 4617, (105, 124, None), ("lost_samples", "periodic")),
    (65, "phac/car_sponge_101_05/F1", 0, 1000, (39, 2, 1221187527), ("temperature", "mixed_sign")),
    (66, "U", 6744, 3586, (66, 43, None), ("noise", "all_throughout")),
    (67, "phac/car_sponge_101_05/F1", 0, 1000, (187, 2, 210700939)),
    (68, "F1+f", 11427, 2009, (119, 123, None), ("low_pass", "one_strong"), ("drift", "random_walk")),
    (69, "U", 20852, 1619, (133, 42, 1200197757), "knocked_housing"),
    (70, "btd", 155, 1775, (23, 2, None), ("offset", "staircase")),
    (71, "F1+f", 14939, 3728, (49, 123, 2736405776), ("relaxation", "tip_only")),
    (72, "F2", 16445, 5862, (2, 123, None), ("gain", "slow")),
    (73, "F1", 173, 7058, (12, 124, None), ("permutation", "pair")),
    (74, "phac/steel_vase_702_05/F0", 0, 1000, (138, 2, 3322642730), "rubbing"),
    (75, "F2+f", 14, 14202, (108, 124, None), ("held_samples", "one_freeze")),
    (76, "F1+f", 11853, 2511, (92, 124, None), ("stuck", "hold_from")),
    (77, "phac/steel_vase_702_01/F1", 0, 1000, (18, 2, 879926648), ("offset", "step")),
    (78, "F1+f", 3071, 5409, (1, 123, None), ("gain", "slow")),
    (79, "phac/acrylic_211_01/F0", 0, 1000, (32, 2, 1263350103), ("warm_up", "from_mid")),
    (80, "F1", 6124, 2240, (135, 123, 963959101), "halves_swapped"),
    (81, "F1", 165, 1783, (73, 124, None), ("line_noise", "one_60")),
    (82, "F2+f", 70, 5437, (7, 123, 3251619559), ("sign", "throughout")),
    (83, "U", 10340, 5435, (24, 43, None), ("drift", "random_walk")),
    (84, "U", 2303, 4261, (44, 43, None), ("fluid_loss", "weeping_steps")),
    (85, "U", 19727, 2716, (70, 43, None), ("noise", "heavy_tailed")),
    (86, "F2", 20759, 2739, (94, 124, None), ("stuck", "rail_zero_first")),
    (87, "btd", 64, 1929, (111, 2, None), ("held_samples", "random_double")),
    (88, "U", 10020, 2323, (76, 43, None), ("line_noise", "fm_wander_one")),
    (89, "F2+f", 11476, 1586, (153, 123, 3281111276), "blocks_shuffled"),
    (90, "F1", 7231, 2824, (52, 123, 1292381138), ("hysteresis", "five_electrodes")),
    (91, "phac/acrylic_211_04/F0", 0, 1000, (142, 2, 474646415), "pulse_beat"),
    (92, "F2", 18190, 5388, (11, 123, 457857911), ("sign", "partial")),
    (93, "F1+f", 13265, 4489, (161, 124, None)),
    (94, "F2+f", 14790, 2427, (141, 123, 3298347641), "bit_inverted"),
    (95, "U", 6080, 5206, (110, 43, None), ("held_samples", "from_mid_every5")),
    (96, "phac/acrylic_211_01/F1", 0, 1000, (183, 1, None)),
    (97, "phac/acrylic_211_05/F0", 0, 1000, (189, 2, 1962705151)),
    (98, "U", 13236, 4456, (84, 43, None), ("quantisation", "one")),
    (99, "U", 11913, 2297, (181, 43, None)),
    (100, "F1+f", 58, 3071, (112, 123, None), ("gain", "sudden"), ("drift", "hump")),
    (101, "phac/steel_vase_702_03/F1", 0, 1000, (75, 2, 66913081), ("line_noise", "all_from_harm")),
    (102, "F1+f", 16202, 2227, (16, 124, None), ("permutation", "connector_shift")),
    (103, "phac/acrylic_211_05/F1", 0, 1000, (72, 2, 2415401674), ("line_noise", "all_50")),
    (
        104,
        "phac/acrylic_211_02/F1",
        0,
        1000,
        (115, 2, 1003038441),
        ("warm_up", "exp"),
        ("line_noise", "all_50"),
    ),
    (105, "F1+f", 176, 3747, (62, 123, 2713823914), ("low_pass", "boxcar_few")),
    (
        106,
        "F2+f",
        14353,
        3241,
        (126, 123, 3791424846),
        ("fluid_loss", "leak_from_mid"),
        ("stuck", "rail_high_from"),
    ),
    (107, "F2+f", 14236, 5805, (163, 124, None)),
    (108, "F1", 3850, 3703, (117, 123, 2965531990), ("offset", "three_mixed"), ("saturation", "low_one")),
    (109, "F1+f", 19291, 1948, (151, 123, 3509029712), "deadband"),
    (110, "F2", 181, 4556, (174, 124, None)),
    (111, "btd", 260, 1769, (81, 2, None), ("cross_talk", "next_two")),
    (112, "F1", 10106, 7042, (69, 124, None), ("noise", "pink_few")),
    (113, "U", 14250, 3367, (177, 43, None)),
    (114, "F2", 5242, 4951, (3, 123, None), ("gain", "first")),
    (115, "F2", 211, 2523, (154, 123, 57841173), "clock_jump"),
    (116, "F2+f", 15245, 2781, (50, 123, 1189095622), ("hysteresis", "play")),
    (117, "btd", 182, 1797, (194, 2, None)),
    (118, "U", 11322, 2196, (137, 42, 4015310599), "rubbing"),
    (119, "F1+f", 8834, 1865, (144, 123, 1628644786), "agc_pumping"),
    (120, "F2+f", 729, 3861, (60, 123, 3785724773), ("low_pass", "all_one_pole")),
    (121, "F1+f", 19330, 2914, (10, 123, 453822572), ("sign", "interval")),
    (122, "F2", 14284, 2831, (59, 123, 3260796255), ("latency", "half_board")),
    (123, "F2+f", 18114, 4965, (46, 123, 3603519851), ("relaxation", "relax_one_tau")),
    (124, "F1", 8082, 3633, (103, 124, None), ("lost_samples", "one_gap")),
    (125, "F2", 12641, 2046, (169, 124, None)),
    (126, "phac/acrylic_211_02/F1", 0, 1000, (186, 2, 3315052407)),
    (127, "U", 475, 1593, (129, 42, 2289856942), "bubble_passes"),
    (128, "phac/steel_vase_702_04/F0", 0, 1000, (107, 2, 3011568875), ("held_samples", "bursts")),
    (129, "F2+f", 17005, 3333, (91, 124, None), ("saturation", "soft_two_from")),
    (130, "F2", 16680, 5015, (109, 124, None), ("held_samples", "every4")),
    (131, "phac/acrylic_211_03/F1", 0, 1000, (130, 2, 1809185307), "bubble_wobbles"),
    (132, "F1", 1745, 6191, (78, 123, 2132467543), ("cross_talk", "all_settling")),
    (133, "F1+f", 6691, 2621, (158, 124, None)),
    (134, "F1+f", 3042, 2233, (134, 123, 1129507320), "amplitude_modulated"),
    (135, "F2+f", 13510, 9872, (67, 124, None), ("noise", "one_from")),
    (136, "phac/car_sponge_101_03/F1", 0, 1000, (188, 2, 2881656392)),
    (137, "F2+f", 683, 3383, (87, 124, None), ("saturation", "low_one")),
    (138, "U", 4158, 2264, (147, 42, 3925586547), "esd_transients"),
    (139, "F2+f", 14362, 2508, (9, 123, 4158992655), ("sign", "three")),
    (140, "phac/acrylic_211_02/F0", 0, 1000, (37, 2, 963547796), ("temperature", "warm_hand")),
    (141, "F1", 2807, 3712, (56, 123, 2316243893), ("latency", "few_throughout")),
    (142, "phac/car_sponge_101_01/F0", 0, 1000, (38, 2, 2043924120), ("temperature", "few_lagging")),
    (143, "U", 17576, 2452, (95, 43, None), ("stuck", "value_first_jitter")),
    (144, "F2", 180, 5290, (27, 124, None), ("drift", "mid_linear")),
    (145, "phac/steel_vase_702_02/F0", 0, 1000, (14, 2, 1651206855), ("permutation", "pair_from")),
    (146, "phac/car_sponge_101_01/F0", 0, 1000, (192, 2, 2298516135)),
    (147, "F1+f", 13572, 2365, (136, 123, 2055988096), "interference_bursts"),
    (148, "F2", 12539, 5712, (33, 124, None), ("warm_up", "almost_linear")),
    (
        149,
        "U",
        1583,
        2576,
        (118, 42, 1601220007),
        ("noise", "one_throughout"),
        ("lost_samples", "random_single"),
    ),
    (150, "F1+f", 9451, 1944, (157, 124, None)),
    (151, "U", 13923, 3507, (123, 42, 4105027244), ("spikes", "frames_all"), ("held_samples", "bursts")),
    (152, "F2+f", 4606, 4766, (96, 124, None), ("stuck", "interval")),
    (153, "F2+f", 7971, 4437, (162, 124, None)),
    (154, "F2+f", 408, 4469, (166, 124, None)),
    (155, "U", 111, 2834, (176, 43, None)),
    (156, "F1+f", 10365, 1980, (83, 124, None), ("quantisation", "all_8bit")),
    (157, "F1+f", 3846, 3306, (102, 124, None), ("lost_samples", "random_single")),
    (158, "phac/car_sponge_101_02/F1", 0, 1000, (82, 2, 2336109200), ("quantisation", "all_floor")),
    (159, "U", 8363, 1595, (143, 42, 2529904449), "footsteps"),
    (160, "phac/steel_vase_702_05/F1", 0, 1000, (86, 2, 2617887634), ("quantisation", "round_decimal")),
    (161, "F1+f", 16102, 3335, (121, 123, 3113347296), ("offset", "there_and_back"), ("cross_talk", "one")),
    (162, "F1+f", 14413, 1892, (89, 124, None), ("saturation", "high_4095")),
    (163, "F2+f", 9296, 4918, (79, 123, 3786981519), ("cross_talk", "one_from")),
    (164, "U", 19425, 2987, (179, 43, None)),
    (165, "U", 3575, 3436, (99, 43, None), ("spikes", "bitflip_random_channel")),
    (166, "phac/steel_vase_702_04/F1", 0, 1000, (65, 2, 3403612316), ("noise", "one_throughout")),
    (167, "F2+f", 5285, 1793, (165, 124, None)),
    (168, "F2+f", 8958, 2220, (131, 123, 308401873), "intermittent_contact"),
    (169, "F1", 225, 15605, (198, 123, 3873028627)),
    (170, "phac/acrylic_211_03/F0", 0, 1000, (190, 2, 2514133585)),
    (171, "F2+f", 1651, 3413, (116, 123, None), ("gain", "first"), ("permutation", "pair_from")),
    (172, "U", 5682, 5888, (178, 43, None)),
    (173, "F2", 3094, 2380, (148, 123, 3466814486), "wrap_around"),
    (174, "F1+f", 17158, 2089, (146, 123, 3077966130), "common_mode_sag"),
    (175, "F1+f", 17945, 4531, (64, 123, 528829561), ("low_pass", "butter_all_from")),
    (176, "F2", 17019, 3502, (173, 124, None)),
    (177, "phac/car_sponge_101_05/F0", 0, 1000, (29, 2, 514139229), ("drift", "stepless_sigmoid")),
    (178, "btd", 193, 1506, (5, 2, None), ("gain", "flicker_two_levels")),
    (179, "phac/car_sponge_101_01/F1", 0, 1000, (41, 2, 1658393757), ("fluid_loss", "leak_from_mid")),
    (180, "F2+f", 9971, 4433, (54, 123, 2800113567), ("hysteresis", "from_mid")),
    (181, "F1+f", 16908, 5524, (53, 123, 458198793), ("hysteresis", "rate_direction")),
    (182, "F2+f", 603, 3747, (48, 123, 226907537), ("relaxation", "after_release_only")),
    (183, "F2+f", 9546, 3107, (13, 124, None), ("permutation", "pair_from")),
    (184, "F1+f", 19255, 3146, (125, 123, None), ("latency", "all_throughout"), ("offset", "staircase")),
    (185, "F1", 138, 2747, (88, 124, None), ("saturation", "high_all")),
    (186, "U", 2500, 3576, (180, 43, None)),
    (187, "F1", 19013, 3424, (175, 124, None)),
    (188, "F1+f", 18382, 3610, (42, 124, None), ("fluid_loss", "under_pressure")),
    (189, "F2", 12977, 2551, (21, 124, None), ("offset", "there_and_back")),
    (190, "F2+f", 7767, 4430, (45, 123, 2181385419), ("relaxation", "creep_one_tau")),
    (191, "F2+f", 20016, 3611, (120, 123, 3568305725), ("warm_up", "two_tau"), ("quantisation", "all_floor")),
    (192, "F1+f", 108, 3573, (167, 124, None)),
    (193, "F2", 11252, 2099, (98, 124, None), ("spikes", "frames_all")),
    (194, "phac/car_sponge_101_05/F0", 0, 1000, (184, 2, 4078890846)),
    (195, "btd", 370, 1683, (68, 2, None), ("noise", "two_growing")),
    (196, "U", 166, 3337, (74, 43, None), ("line_noise", "few_pump_16")),
    (197, "F2+f", 10425, 3676, (0, 123, None), ("gain", "sudden")),
    (198, "F2+f", 249, 1584, (71, 124, None), ("line_noise", "all_50")),
    (199, "F2+f", 4177, 3710, (51, 123, 1002355479), ("hysteresis", "many_plays")),
)
