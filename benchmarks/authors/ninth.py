"""Pieces of recordings of real sensors with one or two hidden effects, by a ninth author.

    plan() -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own
words. The author drew all pieces from one stream of random numbers, where each lies and what is hidden in it:
the table says where in the stream a piece begins, so that each is made alone and is the very one that was
judged blind. Pieces have a clock of their own, as a file has.
"""

import dataclasses
import functools
import gzip
import pathlib

import numpy as np
from scipy.io import loadmat
from scipy.signal import lfilter

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

_SEED = 90917
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
# rows, grasps cool a finger, the native log has bursts
NATURAL = {
    "ninth F1": {"warmup", "latency", "freeze"},
    "ninth F2": {"warmup", "latency", "freeze"},
    "ninth U": {"warmup", "freeze"},
    "ninth phac": {"warmup", "thermal", "fluidloss"},
    "ninth btd": {"lost_rows"},
}


# ---------------------------------------------------------------- recordings


@dataclasses.dataclass
class _Source:
    """A sensor's whole recording: counts x (n, 19), time (n,) [s], rate [Hz], force (n, 3), tdc (n,)."""

    x: np.ndarray
    time: np.ndarray
    rate: float
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None


def _native(path):
    """Time (n,) [s], electrodes (n, 19) and TDC (n,) of the frames of SynTouch's own log that are whole and
    last no longer than 10.5 ms."""
    with gzip.open(path, "rt", encoding="latin1") as file:
        lines = [line.split() for line in file.read().split("Begin File")[1].split("\n")]
    table = np.array([(float(v[0]), int(v[3]), int(v[8])) for v in lines if len(v) >= 9])
    time, electrodes, tdc = [], [], []
    for i in np.flatnonzero(table[:, 1] == 17):
        frame = table[i : i + 43]
        if len(frame) < 43 or frame[-1, 0] - frame[0, 0] > 0.0105:
            continue
        if list(frame[:38:2, 1].astype(int)) != list(range(17, 36)):
            continue
        time.append(frame[0, 0])
        electrodes.append(frame[:38:2, 2])
        tdc.append(frame[38:][frame[38:, 1] == 3][0, 2])
    return np.array(time), np.array(electrodes), np.array(tdc)


@functools.cache
def _source(data, name):
    if name == "btd":
        time, x, tdc = _native(data / "btd/btsp_touch.btd.gz")
        return _Source(x, time, 100.0, tdc=tdc)
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
    x = np.loadtxt(data / electrodes)
    return _Source(x, np.arange(len(x)) / _EPFL, _EPFL, None if force is None else np.loadtxt(data / force))


# ---------------------------------------------------------------- a piece


class _Piece:
    """Rows of a source on their way.

    Attributes: x (n, 19) counts; time (n,); force (n, 3) and tdc (n,) as the file will have them; pressed
    (n,) size of the normal force, also where the file has none; noise (19,) of the electrodes, spread (19,)
    of what they do, rest (19,): where the force is least, else the medians; again (n,) rows that repeat the
    one before; gaps: rows before which some were lost; other: rows of another sensor.
    """

    def __init__(self, source, first, rows, with_force, rng, other=None):
        part = slice(first, first + rows)
        self.x, self.rate, self.rng, self.other = source.x[part].astype(float), source.rate, rng, other
        self.time = source.time[part] - source.time[first]
        self.force = source.force[part].copy() if with_force else None
        self.pressed = None if source.force is None else np.abs(source.force[part, 2])
        self.tdc = None if source.tdc is None else source.tdc[part].copy()
        change = np.diff(self.x, axis=0)
        self.noise = np.maximum(0.5, 1.4826 * np.median(np.abs(change), 0) / 1.41)
        self.spread = np.maximum(self.x.std(0), 2 * self.noise)
        still = np.ones(rows, bool)
        if self.pressed is not None:
            still = self.pressed <= np.quantile(self.pressed, 0.1)
        self.rest = np.median(self.x[still], 0)
        self.again = np.r_[False, (change == 0).all(1)]
        self.gaps = []

    @property
    def n(self):
        return len(self.x)

    @property
    def load(self):
        return self.x - self.rest

    @property
    def noisy(self):
        return self.noise.mean() > 1.5

    def lively(self, number=1):
        """Of the nine electrodes that move most."""
        return sorted(self.rng.choice(np.argsort(-self.spread)[:9], number, False).tolist())

    def few(self, number=None):
        return sorted(self.rng.choice(19, number or int(self.rng.integers(1, 4)), False).tolist())

    def step(self, width=1.0, low=0.2, high=0.65):
        """(n,) 0 before a row, 1 from so many rows after it, and the row."""
        row = int(self.n * self.rng.uniform(low, high))
        return np.clip((np.arange(self.n) - row) / max(width, 1), 0, 1), row

    def shares(self, spread=0.2):
        return 1 + self.rng.normal(0, spread, 19)

    def keep(self, rows):
        """Leaves rows (numbers) alone, with their times."""
        for name in ("x", "force", "tdc", "time"):
            if getattr(self, name) is not None:
                setattr(self, name, getattr(self, name)[rows])
        self.again = np.zeros(len(rows), bool)


ALL = list(range(19))


def _lag(x, seconds, rate):
    """One pole, along the first axis; it begins where x does."""
    a = 1 - np.exp(-1 / (seconds * rate))
    return x[0] + lfilter([a], [1, a - 1], x - x[0], axis=0)


def _among(p, channels):
    """(19,) 1 of the electrodes that have an effect."""
    out = np.zeros(19)
    out[channels] = 1
    return out


# ---------------------------------------------------------------- effects: (piece, form) -> channels


def _gain(p, form):
    c, rng = p.lively(int(p.rng.integers(1, 4))), p.rng
    g = float(rng.choice([0.75, 1.35, 0.6, 1.6, 0.4]))
    if form == "from first row":
        w, g = np.ones(p.n), float(rng.choice([0.4, 1.8, 0.5]))
    elif form == "slow ramp":
        w, _ = p.step(p.n * rng.uniform(0.3, 0.6), 0.1, 0.4)
    else:  # sudden; sudden, back after a quarter
        w, row = p.step()
        if "back" in form:
            w = w * (1 - np.clip((np.arange(p.n) - row - p.n * 0.25) / 50, 0, 1))
    p.x[:, c] = p.rest[c] + (1 + (g - 1) * w)[:, None] * (p.x[:, c] - p.rest[c])
    return c


def _sign(p, form):
    c = p.lively(1 + int(p.rng.uniform() < 0.3))
    on = p.step()[0] > 0 if form == "from a row on" else np.ones(p.n, bool)
    about = np.full(len(c), 4095) if "4095" in form else 2 * p.rest[c]
    p.x[:, c] = np.where(on[:, None], about - p.x[:, c], p.x[:, c])
    return c


def _permutation(p, form):
    a = int(p.rng.integers(0, 16))
    distant = sorted(p.rng.choice(19, 2, False).tolist())
    c = distant if "distant" in form else [a, a + 1, a + 2] if "3 cyclic" in form else [a, a + 1]
    row = 0 if "throughout" in form else int(p.n * p.rng.uniform(0.2, 0.7))
    p.x[row:, c] = p.x[row:, c[1:] + c[:1]]
    return c


def _offset(p, form):
    c, i = p.few(), np.arange(p.n)
    h = float(p.rng.choice([-1, 1]) * p.rng.uniform(6, 30))
    row = int(p.n * p.rng.uniform(0.15, 0.8))
    w = (i >= row) * 1.0
    if form == "step and back":
        w = w * (i < row + p.n * 0.15)
    elif form == "two steps":
        w = w + (i >= min(p.n - 50, row + p.n * 0.15))
    p.x[:, c] += h * w[:, None] * np.maximum(p.noise[c], 1)
    return c


def _drift(p, form):
    c, rng, u = p.few(), p.rng, np.linspace(0, 1, p.n)
    h = float(rng.choice([-1, 1]) * rng.uniform(10, 35))
    for q in c:
        if form == "random walk":
            w = _lag(np.cumsum(rng.normal(0, 1, p.n)), 1, p.rate)
            w = w / np.ptp(w)
        elif form == "saturating":
            w = 1 - np.exp(-u / rng.uniform(0.15, 0.4))
        elif form == "starts in the middle":
            w = np.clip(u - 0.5, 0, 1) * 2
        else:  # slow wave
            w = 0.5 * np.sin(2 * np.pi * (u * rng.uniform(0.6, 1.6) + rng.uniform()))
        p.x[:, q] += h * max(p.noise[q], 1) * w
    return c


def _warm_up(p, form):
    u = np.linspace(0, 1, p.n)
    h = p.rng.uniform(40, 160) if p.noisy else p.rng.uniform(15, 60)
    if form == "exponential":
        w = 1 - np.exp(-u / 0.3)
    elif form == "delayed start":
        w = 1 - np.exp(-np.clip(u - 0.35, 0, 1) / 0.2)
    else:  # two time constants
        w = 0.6 * (1 - np.exp(-u / 0.08)) + 0.4 * u
    p.x += h * w[:, None] * p.shares()
    if p.tdc is not None:
        p.tdc = np.round(p.tdc + h * 0.6 * w)
    return ALL


def _temperature(p, form):
    rng, curved = p.rng, form == "slightly curved"
    if np.ptp(p.tdc) < 25 or curved:  # too even by itself: it changes too
        h, u = rng.uniform(30, 90), np.linspace(0, 1, p.n)
        lagged = form == "lagging 1.5 s"
        w = 1 / (1 + np.exp(-(u - 0.5) * 15)) if lagged else np.sin(2 * np.pi * u * rng.uniform(0.7, 1.6))
        p.tdc = np.round(p.tdc + h * w)
    d = _lag(p.tdc - p.tdc[0], 1.5 if form == "lagging 1.5 s" else 0.2, p.rate)[:, None]
    slope = rng.uniform(0.4, 1.4) * rng.choice([-1, 1])
    p.x += slope * d * p.shares(0.25) * (1 + (0.004 * d if curved else 0))
    return ALL


def _fluid_loss(p, form):
    """Counts fall, and a load is answered by 15 % more."""
    u = np.linspace(0, 1, p.n)
    h = p.rng.uniform(40, 180) if p.noisy else p.rng.uniform(15, 50)
    if form == "linear":
        w = u
    elif form == "accelerating":
        w = u**2.2
    else:  # loss under load
        w = np.cumsum((p.pressed if p.pressed is not None else np.ones(p.n)) ** 2)
        w = w / w[-1]
    p.x = p.rest + p.load * (1 + 0.15 * w[:, None]) - h * w[:, None] * p.shares(0.3)
    return ALL


def _relaxation(p, form):
    a, tau, x = p.rng.uniform(0.15, 0.5), p.rng.uniform(1.5, 7), p.load
    y = _lag(x, tau, p.rate)
    if form == "overshoot and relaxation":
        out = x + a * (x - y)
    else:
        if form == "creep, two time constants":
            y = 0.5 * _lag(x, tau / 5, p.rate) + 0.5 * _lag(x, tau * 2, p.rate)
        out = (1 - a) * x + a * y
    p.x = p.rest + out
    return ALL


def _play(x, width):
    """x (n, c) with play of half a width (c,)."""
    y, s = np.empty_like(x), x[0].copy()
    for j, now in enumerate(x):
        s = np.maximum(now - width, np.minimum(now + width, s))
        y[j] = s
    return y


def _hysteresis(p, form):
    a, x = p.rng.uniform(0.3, 0.8), p.load
    if form == "branch by direction of force" and p.pressed is not None:
        g = _lag(np.gradient(_lag(p.pressed, 0.1, p.rate)) * p.rate, 0.4, p.rate)
        out = x + a * 0.5 * p.spread * np.tanh(g / g.std())[:, None]
    else:
        width = p.spread * p.rng.uniform(0.3, 0.9) * (1 if form == "play" else 0.5)
        out = (1 - a) * x + a * _play(x, width)
    p.x = p.rest + out
    return ALL


def _latency(p, form):
    m, i = int(p.rng.integers(4, 25)), np.arange(p.n)
    c = p.lively(2) if form == "two electrodes" else ALL
    late = (m * i / p.n).astype(int) * 2 if form == "growing lag" else m
    p.x[:, c] = p.x[np.maximum(0, i - late)][:, c]
    p.again[:] = False
    return c


def _low_pass(p, form):
    f = p.rng.uniform(0.4, 2.5)
    c = p.lively(2) if form == "first order, electrodes" else ALL
    row = int(p.n * 0.4) if form == "first order from 40 %" else 0
    if form == "moving average":
        m = int(p.rng.integers(15, 60))
        y = lfilter(np.ones(m) / m, 1, p.x - p.x[0], axis=0) + p.x[0]
    else:
        y = _lag(p.x, 1 / (2 * np.pi * f), p.rate)
    p.x[row:, c] = y[row:, c]
    return c


def _noise(p, form):
    one, some = p.few(1), p.few()
    c = {"white, one": one, "white, all": ALL}.get(form, some)
    h, w = p.rng.uniform(2, 7), p.rng.normal(0, 1, (p.n, 19))
    if form == "coloured, from 40 %":
        w = lfilter([1], [1, -0.85], w, axis=0) * 0.53
        w[: int(p.n * 0.4)] = 0
    p.x += h * w * p.noise * _among(p, c)
    return c


def _line_noise(p, form):
    """[Hz] as the converter sees it."""
    rng = p.rng
    f, other = rng.uniform(14, 40), rng.uniform(8, 45)
    f = {"steady": f, "with a harmonic, fades in": 16.7}.get(form, other)
    c = p.few() if form == "steady, few electrodes" else ALL
    h = rng.uniform(1.5, 6)
    w = np.sin(2 * np.pi * f * p.time + rng.uniform(0, 6))
    if form == "with a harmonic, fades in":
        w = w + 0.4 * np.sin(4 * np.pi * f * p.time)
        w = w * p.step(p.n * 0.1)[0]
    p.x += h * w[:, None] * p.noise * _among(p, c) * p.shares(0.25)
    return c


def _cross_talk(p, form):
    g, x, everywhere = p.rng.uniform(0.1, 0.45), p.load, form.startswith("all")
    c = ALL[1:]
    if not everywhere:
        c = sorted(p.rng.choice(np.arange(1, 19), int(p.rng.integers(1, 3)), False).tolist())
    w = p.step()[0] if "from a row on" in form else np.ones(p.n)
    p.x += g * w[:, None] * _among(p, c) * (np.roll(x, 1, 1) - x * everywhere)
    return ALL if everywhere else c


def _quantisation(p, form):
    step = int(p.rng.choice([8, 16, 32] if p.noisy else [4, 8]))
    c = p.few() if form == "few" else ALL
    row = int(p.n * 0.4) if form == "all from 40 %" else 0
    p.x[row:, c] = np.floor(p.x[row:, c] / step) * step
    return c


def _saturation(p, form):
    c = p.lively(int(p.rng.integers(1, 4)))
    for q in c:
        x = p.x[:, q]
        low, high = np.quantile(x, [0.01, 0.99])
        span = max(high - low, 12 * p.noise[q])
        if form == "upper clip":
            p.x[:, q] = np.minimum(x, high - span * p.rng.uniform(0.2, 0.45))
        elif form == "lower clip":
            p.x[:, q] = np.maximum(x, low + span * p.rng.uniform(0.2, 0.45))
        else:  # shifted into 4095
            p.x[:, q] = np.minimum(4095, x + 4095 - np.quantile(x, p.rng.uniform(0.7, 0.9)))
    return c


def _stuck(p, form):
    c, rng = p.few(1 + int(p.rng.uniform() < 0.3)), p.rng
    row = int(p.n * rng.uniform(0.2, 0.7))
    row = {"at a rail throughout": 0, "at its value": row}.get(form, int(p.n * 0.3))
    end = int(p.n * rng.uniform(0.45, 0.7)) if form == "at its value for a while" else p.n
    for q in c:
        p.x[row:end, q] = float(rng.choice([0, 4095])) if form == "at a rail throughout" else p.x[row, q]
    return c


def _spikes(p, form):
    rng, m = p.rng, int(p.rng.integers(4, 25))
    rows = rng.choice(np.arange(5, p.n - 5), m, False)
    c = ALL if form == "all electrodes" else p.few()
    h = rng.uniform(12, 50)
    for row in rows:
        side = rng.choice([-1, 1])
        for q in c:
            if form == "bit 8 flips":
                p.x[row, q] += rng.choice([-1, 1]) * 256
            else:
                p.x[row, q] += side * (h * max(1, p.noise[q]) * rng.uniform(0.6, 1.4))
    p.again[:] = False
    return c


def _lost(p, form):
    rng, n, keep = p.rng, p.n, np.ones(p.n, bool)
    scattered = form == "scattered rows"
    for row in rng.integers(20, n - 200, int(rng.integers(3, 12))):
        length = 1 + int(rng.uniform() < 0.5) * 2 if scattered else int(rng.integers(5, 90))
        keep[row : row + length] = False
    if scattered:
        keep[rng.choice(n, n // 60, False)] = False
    time, rows = p.time, np.flatnonzero(keep)
    p.keep(rows)
    if "renumbered" in form:
        p.time = time[: len(rows)]
    p.gaps = list(np.flatnonzero(np.diff(rows) > 1) + 1)
    return ALL


def _held(p, form):
    rng, i = p.rng, np.arange(p.n)
    if form == "blocks":
        for row in rng.integers(20, p.n - 100, int(rng.integers(4, 12))):
            i[row : row + int(rng.integers(8, 60))] = row
    elif form == "every few rows from 40 %":
        m, row = int(rng.integers(3, 7)), int(p.n * 0.4)
        i[row:] = i[row:] // m * m
    else:  # every few rows
        m = int(rng.integers(4, 9))
        i = i // m * m
    p.x = p.x[i]
    p.again[:] = False
    return ALL


_LATER = ("quantisation", "lost_samples", "held_samples")  # of a pair, this comes second
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


# ---------------------------------------------------------------- outside the catalogue: (piece) -> None


def _bubble(p):
    """It travels along the electrodes."""
    last = p.time[-1]
    for q in range(19):
        p.x[:, q] -= (
            25 * p.noise.mean() * np.exp(-0.5 * ((p.time - last * (0.2 + 0.03 * q)) / (last * 0.04)) ** 2)
        )


def _loose(p):
    """Now and then without contact."""
    q = p.lively()[0]
    off = np.cumsum(p.rng.uniform(size=p.n) < 0.01) % 2
    p.x[:, q] -= off * (p.rng.uniform(150, 400) + p.rng.normal(0, 20, p.n))


def _decaying(p, at, seconds):
    """(n,) 0 before a time, then 1 that decays, and the time since then."""
    since = np.where(p.time > at, p.time - at, 0)
    return (p.time > at) * np.exp(-since / seconds), since


def _knock(p):
    """On the housing, which rings."""
    size = 18 * p.noise.mean()
    for at in p.rng.uniform(0.1, 0.9, 5) * p.time[-1]:
        w, since = _decaying(p, at, 0.35)
        p.x += (w * np.sin(2 * np.pi * 7 * since))[:, None] * size * p.shares(0.4)


def _modulated(p):
    p.x = p.rest + p.load * (1 + 0.4 * np.sin(2 * np.pi * 0.25 * p.time))[:, None]


def _halves(p):
    """Of the electrodes' record, exchanged."""
    p.x = np.r_[p.x[p.n // 2 :], p.x[: p.n // 2]]


def _chirps(p):
    """Bursts of aliased interference."""
    for at in p.rng.uniform(0.05, 0.85, 5) * p.time[-1]:
        on = (p.time > at) & (p.time < at + 1.2)
        t, f = p.time[on], p.rng.uniform(5, 40)
        wave = np.sin(2 * np.pi * (f * t + 6 * (t - at) ** 2))
        p.x[on] += wave[:, None] * 7 * p.noise.mean() * p.shares(0.4)


def _rub(p):
    wave = lfilter([1], [1, -1.6, 0.9], p.rng.normal(0, 1, p.n))
    wave = wave * np.clip(np.sin(2 * np.pi * p.time / 4), 0, 1)
    p.x[:, 3:7] += (wave / wave.std())[:, None] * 8 * p.noise.mean() * p.rng.uniform(0.5, 1, 4)


def _backwards(p):
    """The middle third."""
    a, b = p.n // 3, p.n // 3 * 2
    p.x[a:b] = p.x[a:b][::-1]


def _copied(p):
    """One electrode is another."""
    a, b = p.lively(2)
    p.x[:, a] = p.x[:, b]


def _clock_jumps(p):
    """No rows are lost."""
    for share in p.rng.uniform(0.1, 0.9, 4):
        p.time = p.time.copy()
        p.time[int(share * p.n) :] += p.rng.uniform(-1, 3)


def _wraps(p):
    """The upper bits are lost from 30 % on."""
    late = np.arange(p.n)[:, None] > p.n * 0.3
    p.x = np.where(late, p.x % 1024, p.x)


def _bounces(p):
    """The ground: all fall with the sum."""
    p.x = p.x - 0.12 * p.load.sum(1)[:, None]


def _dead_zone(p):
    x = p.load
    p.x = p.rest + np.sign(x) * np.maximum(0, abs(x) - 1.2 * p.spread * 0.6)


def _curved(p):
    x = p.load
    p.x = p.rest + np.sign(x) * p.spread * (abs(x) / p.spread) ** 0.55


def _again(p):
    """A part is played twice."""
    a, m = p.n // 4, p.n // 6
    p.x[2 * a : 2 * a + m] = p.x[a : a + m]


def _discharges(p):
    """All drop and recover."""
    size = 45 * p.noise.mean()
    for at in p.rng.uniform(0.1, 0.85, 6) * p.time[-1]:
        p.x -= _decaying(p, at, 0.8)[0][:, None] * size * p.shares(0.2)


def _automatic_gain(p):
    x = p.load
    p.x = p.rest + x / (0.5 + _lag(abs(x).mean(1), 2, p.rate) / abs(x).mean())[:, None]


def _slow_slew(p):
    most, now = p.spread * 0.012, p.x[0].copy()
    for j in range(p.n):
        now = now + np.clip(p.x[j] - now, -most, most)
        p.x[j] = now


def _on_change(p):
    """An electrode is sent when it has changed."""
    now, least = p.x[0].copy(), np.maximum(4 * p.noise, 0.25 * p.spread)
    for j in range(p.n):
        now = np.where(abs(p.x[j] - now) > least, p.x[j], now)
        p.x[j] = now


def _unplugged(p):
    """For a moment, again and again."""
    for row in p.rng.integers(50, p.n - 80, 8):
        p.x[row : row + int(p.rng.integers(8, 40))] = p.rng.normal(0, 2, (1, 19)) + 900


def _slow_chirp(p):
    t = p.time
    wave = np.sin(2 * np.pi * (0.3 * t + (0.5 * 18 / t[-1]) * t**2))
    p.x += wave[:, None] * 5 * p.noise.mean() * p.shares(0.3)


def _pulse(p):
    """An operator's."""
    t = p.time
    beat = np.maximum(0, np.sin(2 * np.pi * 1.15 * t + 0.4 * np.sin(0.3 * t))) ** 12
    p.x[:, 6:11] += beat[:, None] * 15 * p.noise.mean()


def _another_sensor(p):
    """Its rows, now and then."""
    there = np.arange(p.n) % 700 > 560
    p.x[there] = p.other[: p.n][there]


def _rate(p):
    """Is read too."""
    speed = np.gradient(_lag(p.x.mean(1), 0.1, p.rate))
    p.x += 0.8 * (speed / speed.std() * p.noise.mean() * 6)[:, None] * p.shares(0.5)


def _wobble(p):
    """It grows with the load."""
    c, x = np.argsort(-p.spread)[:4], p.load
    wave = np.sin(2 * np.pi * 0.7 * p.time)[:, None]
    p.x[:, c] += np.abs(x[:, c]) ** 2 / (4 * p.spread[c]) * wave


OUTSIDE = {
    "bubble": _bubble,
    "loose": _loose,
    "knock": _knock,
    "am": _modulated,
    "halves": _halves,
    "chirp": _chirps,
    "rub": _rub,
    "reverse": _backwards,
    "copy": _copied,
    "clock": _clock_jumps,
    "wrap": _wraps,
    "bounce": _bounces,
    "dead": _dead_zone,
    "power": _curved,
    "again": _again,
    "discharge": _discharges,
    "agc": _automatic_gain,
    "slew": _slow_slew,
    "onchange": _on_change,
    "unplugged": _unplugged,
    "slowchirp": _slow_chirp,
    "pulse": _pulse,
    "other": _another_sensor,
    "rate": _rate,
    "wobble": _wobble,
}


# ---------------------------------------------------------------- the plan


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base, with +f at its end where the file has the force; first: row of the source; rows;
    drawn: numbers taken from the author's stream before it, and half of one that was left over, or None;
    effects: of (kind, form), the author's names, of one outside the catalogue (kind, "")."""

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
        """The author's, where this piece begins."""
        bits = np.random.PCG64(_SEED).advance(self.drawn[0])
        if self.drawn[1] is not None:
            bits.state = bits.state | {"has_uint32": 1, "uinteger": self.drawn[1]}
        return np.random.Generator(bits)


def plan() -> list[Spec]:
    """193 pieces: singles, pairs, outside the catalogue, untouched. The author's four of logs that were tared
    are left out: none is read."""
    return [
        Spec(f"{number:03d}", *where, tuple((e, "") if isinstance(e, str) else e for e in effects))
        for number, *where, effects in ((*row[:5], row[5:]) for row in _PLAN)
    ]


def make(spec: Spec, data: str) -> tuple[dict, np.ndarray]:
    """Fields of the case, its counts as a file has them, and the counts without what is hidden (n, 19), rows
    that are lost later among them."""
    folder, name = pathlib.Path(data), spec.base.removesuffix("+f")
    other = _source(folder, "F2").x if spec.effects[:1] == (("other", ""),) else None
    with_force = spec.base.endswith("+f")
    p = _Piece(_source(folder, name), spec.first, spec.rows, with_force, spec.stream(), other)
    clean, channels, noise = p.x.copy(), [], p.noise
    for kind, form in spec.effects:
        if spec.outside:
            OUTSIDE[kind](p)
            channels.append(ALL)
        else:
            p.rng.uniform()  # the author drew a size here that no effect takes
            channels.append(LAWS[kind](p, form))
    if spec.effects and not spec.outside and p.again.any():  # what repeated a row repeats it now
        p.x = p.x[np.maximum.accumulate(np.where(p.again, 0, np.arange(p.n)))]
    p.x, kind = np.round(p.x).clip(0, 4095), name.split("/")[0]
    seen = []
    if spec.effects and p.x.shape == clean.shape:
        seen = [float(np.sqrt(((p.x - clean) ** 2).mean(0) / noise**2).max())]
    case = {
        "base": f"ninth {kind}",
        "counts": p.x,
        "rate": p.rate,
        "force": None if p.force is None else np.round(p.force, 5),
        "tdc": None if p.tdc is None else np.round(p.tdc),
        "loaded": kind in ("F1", "F2"),
        "channels": channels,
        "truth": list(spec.kinds),
        "forms": [form or effect for effect, form in spec.effects],
        "seen": seen,
        "gaps": p.gaps,
        "time": np.round(p.time, 5),
    }
    return case, clean


# number, base, first row, rows, where in the stream, effects: (kind, form), or what is outside the catalogue
_PLAN = (
    (1, "F1", 4403, 3099, (257, None), ("relaxation", "creep, one time constant")),
    (2, "F2+f", 3370, 6379, (265, 627172731), ("offset", "step and back")),
    (3, "F1", 16842, 1642, (274, 841971472), ("sign", "from a row on")),
    (4, "F1+f", 4421, 16985, (281, 2987593901), ("fluid_loss", "loss under load")),
    (5, "F2", 11920, 6535, (306, None), ("gain", "sudden")),
    (6, "phac/acrylic_211_01/F0", 0, 1000, (313, 1122498955), ("fluid_loss", "linear")),
    (7, "F2+f", 10944, 3293, (340, 3123092016), ("held_samples", "every few rows from 40 %")),
    (8, "F2", 12369, 3416, (346, 1529823936)),
    (9, "F2+f", 1753, 18749, (349, None), ("fluid_loss", "linear"), ("spikes", "all electrodes")),
    (10, "F1+f", 7224, 6161, (807, None), ("gain", "sudden"), ("offset", "step and back")),
    (11, "F1", 14824, 7640, (823, 215907419), ("saturation", "shifted into 4095")),
    (12, "btd", 164, 1903, (830, None), ("offset", "step")),
    (13, "F2+f", 16654, 2768, (840, None), ("latency", "constant"), ("noise", "white, one")),
    (14, "F2", 4246, 3273, (54587, 2962536833), "power"),
    (15, "F2", 15400, 2257, (54594, None), "knock"),
    (16, "U", 13010, 2125, (54699, 2824645132), "clock"),
    (17, "F1+f", 13684, 1702, (54711, None), ("relaxation", "overshoot and relaxation")),
    (18, "F1+f", 17337, 2179, (54719, 1779211632), ("relaxation", "creep, two time constants")),
    (19, "F2+f", 6835, 6030, (54728, None), ("drift", "saturating")),
    (20, "F2+f", 18616, 1718, (54742, None), ("permutation", "adjacent, throughout")),
    (21, "F1", 3310, 6007, (54753, 540879116)),
    (22, "F1+f", 18311, 3133, (54760, None)),
    (23, "F2+f", 7714, 2208, (54768, 1888127513), ("noise", "white, one")),
    (24, "U", 8984, 1675, (97671, 1050362986)),
    (25, "btd", 0, 2124, (97741, 4040370221), ("relaxation", "creep, one time constant")),
    (26, "phac/acrylic_211_01/F0", 0, 1000, (97747, 4040370221), ("temperature", "linear")),
    (
        27,
        "U",
        9786,
        7941,
        (97775, 942512713),
        ("stuck", "at its value for a while"),
        ("permutation", "adjacent, from a row on"),
    ),
    (28, "F2+f", 5578, 2867, (97790, None)),
    (29, "F2", 18354, 3035, (97798, 2760142320), ("held_samples", "every few rows from 40 %")),
    (30, "U", 2604, 3050, (97805, None), ("spikes", "bit 8 flips")),
    (31, "F1", 9928, 1670, (97872, 271560167), "onchange"),
    (32, "F1", 1314, 1717, (97876, None), ("gain", "from first row")),
    (33, "F1+f", 15853, 3043, (97886, None), "unplugged"),
    (34, "F2+f", 573, 3110, (98054, 3579969881), ("relaxation", "overshoot and relaxation")),
    (35, "F2+f", 20366, 2300, (98067, None), ("gain", "sudden")),
    (36, "phac/acrylic_211_04/F0", 0, 1000, (98074, 215808684)),
    (37, "U", 17030, 3720, (98080, 1315521397), "rub"),
    (38, "phac/car_sponge_101_03/F1", 0, 1000, (101887, 1315521397)),
    (39, "F2", 9098, 2406, (101899, 1824487044)),
    (40, "F1", 11519, 3697, (101917, 1776498712)),
    (41, "F2+f", 18583, 4852, (102009, 1672195371), ("fluid_loss", "accelerating")),
    (42, "F1", 172, 7653, (102042, 3984369983), ("permutation", "adjacent, from a row on")),
    (43, "F2+f", 21606, 1968, (102050, None), ("spikes", "all electrodes")),
    (44, "phac/car_sponge_101_02/F1", 0, 1000, (102240, 3057617483)),
    (45, "F1+f", 3135, 1952, (102249, 5548760), "again"),
    (
        46,
        "F2+f",
        21,
        6671,
        (102253, None),
        ("permutation", "adjacent, throughout"),
        ("line_noise", "with a harmonic, fades in"),
    ),
    (47, "btd", 396, 1559, (102352, None), ("spikes", "few electrodes")),
    (48, "F1+f", 389, 1880, (102412, None), ("noise", "coloured, from 40 %")),
    (49, "U", 5196, 2208, (138862, None)),
    (
        50,
        "F1+f",
        1081,
        3509,
        (138868, None),
        ("low_pass", "first order, electrodes"),
        ("offset", "two steps"),
    ),
    (51, "F2+f", 10598, 12371, (138910, None), ("hysteresis", "play")),
    (
        52,
        "F2+f",
        10508,
        1566,
        (138927, 2270594430),
        ("cross_talk", "few from the channel before"),
        ("line_noise", "steady, few electrodes"),
    ),
    (53, "F1", 14957, 2707, (139051, 2363719397)),
    (54, "F1+f", 6954, 2944, (139060, 2176301923), ("cross_talk", "few, from a row on")),
    (55, "phac/acrylic_211_05/F1", 0, 1000, (139068, 11087215), ("temperature", "slightly curved")),
    (56, "F2", 2190, 1997, (139180, None)),
    (57, "F1+f", 8672, 3422, (139186, None), ("quantisation", "all")),
    (58, "btd", 177, 1937, (139258, 261405227), ("cross_talk", "few from the channel before")),
    (
        59,
        "F1+f",
        10678,
        6328,
        (139273, None),
        ("warm_up", "exponential"),
        ("line_noise", "steady, few electrodes"),
    ),
    (60, "F2", 11588, 1910, (139326, 3028261144), ("spikes", "bit 8 flips"), ("quantisation", "all")),
    (61, "F1+f", 1464, 1801, (139459, None)),
    (62, "F1", 2997, 3502, (139464, 1202365460), ("drift", "slow wave"), ("quantisation", "all from 40 %")),
    (63, "F1+f", 5799, 1688, (139475, None), ("low_pass", "first order from 40 %")),
    (64, "F1+f", 20465, 1565, (139524, 773865515), "halves"),
    (65, "F2+f", 3895, 2054, (139528, None), ("stuck", "at a rail throughout")),
    (66, "F2", 1275, 1715, (139558, 2116196673), "reverse"),
    (67, "F2+f", 16082, 5502, (139607, None)),
    (68, "btd", 0, 2124, (139676, None), ("temperature", "lagging 1.5 s")),
    (
        69,
        "F2+f",
        9882,
        5535,
        (139714, 1031491042),
        ("saturation", "lower clip"),
        ("held_samples", "every few rows from 40 %"),
    ),
    (70, "F1+f", 12338, 1633, (139729, None), ("hysteresis", "play")),
    (71, "U", 14905, 5139, (139788, 3211879266)),
    (72, "phac/car_sponge_101_03/F0", 0, 1000, (139791, 3211879266), ("held_samples", "blocks")),
    (73, "phac/car_sponge_101_05/F1", 0, 1000, (139804, None)),
    (74, "U", 7907, 1957, (139809, 508342787), ("noise", "white, one")),
    (75, "F1", 1784, 11872, (177914, 411533948), ("drift", "starts in the middle")),
    (76, "U", 262, 2193, (177925, 3607799413), ("quantisation", "few")),
    (77, "F1+f", 5842, 4981, (177980, None), ("saturation", "lower clip")),
    (78, "U", 10747, 2231, (178013, None)),
    (79, "F2", 4812, 1601, (178021, 34610289), ("sign", "from a row on")),
    (80, "F1", 12999, 3587, (178054, None), ("permutation", "3 cyclic, from a row on")),
    (81, "F2+f", 22024, 1621, (178151, None), ("stuck", "at its value for a while")),
    (82, "F2+f", 13889, 2475, (178161, None), ("lost_samples", "scattered rows")),
    (83, "U", 6388, 14778, (178223, None), ("warm_up", "delayed start")),
    (84, "F1+f", 19198, 1700, (178256, None), ("sign", "from first row")),
    (85, "U", 7136, 4113, (178263, None), "pulse"),
    (86, "F1+f", 9632, 2106, (178356, None)),
    (87, "U", 1374, 2865, (178397, 2345015489)),
    (88, "F2", 9893, 2883, (178448, 2250793480), "am"),
    (89, "phac/acrylic_211_03/F1", 0, 1000, (178451, 2250793480), ("temperature", "linear")),
    (90, "U", 14602, 2297, (178478, None), ("quantisation", "all")),
    (91, "phac/steel_vase_702_02/F1", 0, 1000, (178482, 3656609795), ("warm_up", "delayed start")),
    (92, "F1+f", 8372, 2103, (178554, 2376211526), ("permutation", "3 cyclic, from a row on")),
    (
        93,
        "phac/steel_vase_702_04/F0",
        0,
        1000,
        (178561, 3765931278),
        ("line_noise", "with a harmonic, fades in"),
    ),
    (94, "F2", 19930, 1625, (178601, 186092423), ("low_pass", "moving average")),
    (95, "U", 12330, 1840, (178696, None)),
    (96, "btd", 0, 2124, (178766, 1554771693)),
    (97, "F2+f", 3107, 1969, (178853, 3096002388), ("saturation", "lower clip")),
    (98, "F1+f", 7428, 1766, (178896, 3742037928), ("spikes", "all electrodes")),
    (99, "F2+f", 12925, 1716, (179409, 2549546457), "slew"),
    (100, "F2+f", 17361, 1602, (179502, 2228563037), "chirp"),
    (101, "F1", 6422, 1892, (179682, None), "other"),
    (102, "F1+f", 4045, 1599, (179747, 2881430951), ("sign", "inverted counts, 4095 less them")),
    (103, "F2+f", 7020, 1602, (179782, None), ("latency", "growing lag")),
    (104, "U", 19564, 2837, (179788, None), ("held_samples", "every few rows")),
    (105, "phac/steel_vase_702_04/F1", 0, 1000, (179793, 1558776229), ("lost_samples", "bursts")),
    (106, "F1", 13523, 1576, (179893, None), "copy"),
    (
        107,
        "U",
        1154,
        7150,
        (179987, 168992634),
        ("warm_up", "exponential"),
        ("stuck", "at a rail throughout"),
    ),
    (108, "F1", 2358, 4028, (180104, 3289129728), ("fluid_loss", "linear")),
    (
        109,
        "F1+f",
        10192,
        3012,
        (180162, None),
        ("relaxation", "overshoot and relaxation"),
        ("noise", "white, one"),
    ),
    (110, "F1+f", 3127, 1959, (238742, 2263186916), ("gain", "from first row")),
    (111, "U", 921, 4121, (238839, 225131854), "bubble"),
    (112, "F2+f", 2037, 3416, (238905, 1067597282), ("line_noise", "steady")),
    (113, "F2+f", 21045, 1946, (239022, 1090751559)),
    (114, "F1+f", 5245, 1856, (239114, 3778558207), ("latency", "constant")),
    (115, "U", 19090, 2094, (239129, 2624256560), ("stuck", "at a rail throughout")),
    (116, "F1+f", 15510, 1558, (239160, None), ("hysteresis", "narrow play")),
    (117, "phac/steel_vase_702_05/F1", 0, 1000, (239166, None)),
    (118, "F2", 229, 1711, (239210, 1334534993), ("low_pass", "first order, electrodes")),
    (119, "btd", 0, 2124, (239283, None), ("stuck", "at its value")),
    (120, "F2+f", 8728, 1607, (239350, 3891666959), ("quantisation", "few")),
    (121, "F2", 19610, 1635, (239446, None), "rate"),
    (122, "F2+f", 11601, 1528, (239558, None)),
    (123, "F2+f", 14947, 4129, (239617, 3809214207), ("noise", "coloured, from 40 %")),
    (124, "F1+f", 473, 1548, (319906, None)),
    (125, "U", 12580, 9138, (319919, 3556298234), ("drift", "saturating"), ("spikes", "few electrodes")),
    (126, "F1+f", 9703, 7487, (320073, None), ("offset", "step and back")),
    (
        127,
        "F1",
        12707,
        2138,
        (320173, 2220677118),
        ("stuck", "at a rail throughout"),
        ("noise", "white, one"),
    ),
    (128, "F1", 16757, 3853, (361674, None), ("cross_talk", "all from the channel before")),
    (129, "U", 4854, 1940, (361769, None), "discharge"),
    (130, "F2", 6336, 10353, (361986, None), ("fluid_loss", "accelerating")),
    (131, "U", 12082, 4188, (362021, 3630081046), ("line_noise", "steady, few electrodes")),
    (132, "F1+f", 2635, 6320, (362140, 1129646306), ("warm_up", "two time constants")),
    (133, "phac/car_sponge_101_04/F0", 0, 1000, (362164, 1129646306), ("offset", "two steps")),
    (134, "btd", 0, 2124, (362239, None), ("sign", "from first row")),
    (135, "U", 3945, 8203, (362310, 3170986722), ("drift", "slow wave")),
    (136, "F2", 434, 1747, (362414, None)),
    (138, "phac/car_sponge_101_01/F0", 0, 1000, (362420, None)),
    (139, "F2+f", 15081, 1670, (362453, None), ("line_noise", "steady")),
    (140, "F1", 16260, 1640, (362570, None), ("stuck", "at its value for a while")),
    (141, "btd", 41, 1734, (362645, None), ("latency", "constant")),
    (142, "F1+f", 14182, 2095, (362659, 1430719319), ("gain", "slow ramp")),
    (143, "F2+f", 132, 12754, (362673, 950686886), ("warm_up", "exponential")),
    (144, "F1+f", 18660, 1838, (362787, 230723966), "wobble"),
    (145, "F1", 14329, 4984, (362879, 212064028), ("drift", "random walk")),
    (146, "F1+f", 15031, 7332, (368076, None), ("warm_up", "exponential")),
    (147, "btd", 0, 2124, (368166, 2520834984), ("noise", "white, all")),
    (148, "F1+f", 20175, 2193, (409546, None), ("gain", "from first row"), ("drift", "random walk")),
    (149, "phac/acrylic_211_01/F1", 0, 1000, (411794, 2790004906)),
    (150, "F2+f", 8134, 1639, (411887, 616510911), "loose"),
    (153, "btd", 287, 1671, (415279, None), ("line_noise", "with a harmonic, fades in")),
    (154, "F1", 96, 4113, (415397, None), ("cross_talk", "few from the channel before")),
    (155, "F1", 11295, 1715, (415493, None), "agc"),
    (156, "btd", 0, 2124, (415555, None), ("drift", "saturating")),
    (157, "F2+f", 18820, 4354, (415656, 1265286912), ("drift", "random walk")),
    (158, "F2+f", 3826, 1821, (420183, None)),
    (159, "phac/steel_vase_702_05/F0", 0, 1000, (420186, None)),
    (160, "F1+f", 8152, 5851, (420278, None), ("latency", "two electrodes")),
    (161, "F2+f", 3027, 7395, (420374, None), ("gain", "sudden, back after a quarter")),
    (162, "F1+f", 4477, 1675, (420473, 4206223058), "dead"),
    (163, "F2+f", 5227, 1933, (420565, 32080554), ("hysteresis", "play"), ("offset", "two steps")),
    (164, "btd", 0, 2124, (420639, None), ("quantisation", "all from 40 %")),
    (165, "F2+f", 7483, 1515, (420734, 1103634158), ("permutation", "distant, throughout")),
    (166, "F2+f", 9086, 2494, (420829, 2976479472), ("latency", "two electrodes")),
    (167, "btd", 0, 2124, (420902, 2816312619), ("saturation", "upper clip")),
    (168, "F1", 68, 3077, (421000, 2034891045), "wrap"),
    (169, "F1+f", 11168, 3473, (421093, 1947462567), ("lost_samples", "bursts")),
    (170, "F2+f", 15102, 1531, (421194, None)),
    (171, "F1+f", 1969, 2021, (421287, None), ("offset", "step")),
    (172, "F1+f", 13912, 4557, (421386, 1705911103), ("noise", "white, all")),
    (173, "F2", 6197, 4203, (510011, None), ("saturation", "upper clip")),
    (174, "btd", 0, 2124, (510086, None), ("permutation", "adjacent, throughout")),
    (175, "U", 16009, 2795, (510094, 3436119465), ("offset", "two steps")),
    (176, "F2+f", 1246, 1580, (510193, None), ("lost_samples", "scattered rows")),
    (177, "F1", 18244, 1908, (510328, None), ("low_pass", "moving average")),
    (178, "F2", 7231, 1781, (510424, 3338771944)),
    (179, "F1+f", 11376, 1821, (510517, 2657708631), ("spikes", "few electrodes")),
    (180, "F1+f", 8238, 2236, (510653, 2238265718)),
    (181, "btd", 0, 2124, (510723, 3725665100), ("temperature", "lagging 1.5 s")),
    (182, "F1", 12811, 1978, (510838, None), ("low_pass", "first order, electrodes")),
    (183, "F1", 6044, 2530, (510935, 3500268295), ("stuck", "at its value")),
    (
        184,
        "F1+f",
        7273,
        1758,
        (511031, None),
        ("sign", "inverted counts, 4095 less them"),
        ("lost_samples", "scattered rows"),
    ),
    (185, "F2+f", 347, 1856, (511172, None), ("hysteresis", "narrow play")),
    (186, "F2+f", 3324, 1528, (511268, None), "bounce"),
    (187, "U", 20630, 1842, (511361, None)),
    (188, "F1+f", 20409, 1525, (511454, None)),
    (189, "F2", 7570, 4228, (511547, None), "slowchirp"),
    (190, "F1", 14287, 1994, (511659, None)),
    (191, "F1+f", 18743, 3372, (511751, None), ("hysteresis", "branch by direction of force")),
    (192, "F2", 5857, 2735, (511846, None), ("cross_talk", "all from the channel before")),
    (194, "F1+f", 2353, 1763, (511944, None)),
    (195, "F1+f", 6894, 1504, (512037, None), ("held_samples", "blocks")),
    (196, "F2+f", 18393, 3029, (512141, 3486548278)),
    (197, "U", 9021, 3264, (512148, None), ("lost_samples", "bursts, time renumbered")),
)
