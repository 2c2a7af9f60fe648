"""Pieces of recordings of real sensors with one or two hidden effects, by an eighth author.

    plan() -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own
words. Everything is seeded. Where each piece lies was drawn once, seven rounds over all pieces with 250 draws
each, so that it shares little with others and least with those of the same kind; the table holds what came
out. Pieces have a clock of their own, as a file has.
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

_SEED = 88202611
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
    "eighth F1": {"warmup", "latency", "freeze"},
    "eighth F2": {"warmup", "latency", "freeze"},
    "eighth U": {"warmup", "freeze"},
    "eighth phac": {"warmup", "thermal", "fluidloss"},
    "eighth btd": {"lost_rows"},
}


# ---------------------------------------------------------------- recordings


@dataclasses.dataclass
class _Source:
    """A sensor's whole recording: counts x (n, 19), time (n,) [s], rate [Hz], rest (19,), force (n, 3), tdc
    (n,)."""

    x: np.ndarray
    time: np.ndarray
    rate: float
    rest: np.ndarray | None = None
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None

    @functools.cached_property
    def noise(self) -> np.ndarray:
        """(19,) counts"""
        return np.maximum(np.median(np.abs(np.diff(self.x, axis=0)), 0) / 0.954, 0.4)


def _native(path):
    """Time (n,) [s], electrodes (n, 19) and TDC (n,) of SynTouch's own log: a frame begins at the channel
    before E1's and has 44 lines."""
    with gzip.open(path, "rt") as file:
        lines = [line.split() for line in file.read().split("Begin File")[1].strip().splitlines()]
    table = np.array([[float(v) for v in line] for line in lines if len(line) == 10])
    time, electrodes, tdc = [], [], []
    for i in np.flatnonzero(table[:, 3] == 17) - 1:
        if i < 0 or i + 44 > len(table):
            continue
        frame = table[i : i + 44]
        read = dict(zip(frame[:, 3].astype(int), frame[:, 8]))
        time.append(frame[0, 0])
        electrodes.append([read[c] for c in range(17, 36)])
        tdc.append(read[3])
    return np.array(time), np.array(electrodes), np.array(tdc)


@functools.cache
def _source(data, name):
    if name == "btd":
        time, x, tdc = _native(data / "btd/btsp_touch.btd.gz")
        return _Source(x, time, 100.0, np.median(x[:500], 0), tdc=tdc)
    if name.startswith("phac"):
        _, thing, finger = name.split("/")
        mat = loadmat(data / f"phac_hold/{thing}_HOLD.mat")
        x, tdc = mat[f"{finger}Electrodes"].T.astype(float), mat[f"{finger}tdc"].ravel().astype(float)
        return _Source(x, np.round(np.arange(len(x)) / 100.0, 3), 100.0, tdc=tdc)
    electrodes, force = {
        "F1": ("epfl_flat_press/SynImpF1.txt", "epfl_flat_press/ForceData.txt"),
        "F2": ("epfl_f2/SynImpF2.txt.gz", "epfl_f2/ForceData.txt.gz"),
        "U": ("epfl_flat_press/SynImpF2.txt", None),
    }[name]
    x = np.loadtxt(data / electrodes)
    time = np.round(np.arange(len(x)) / _EPFL, 4)
    if force is None:
        return _Source(x, time, _EPFL)
    return _Source(x, time, _EPFL, np.median(x, 0), np.loadtxt(data / force))


# ---------------------------------------------------------------- a piece


class _Piece:
    """Rows of a source on their way.

    Attributes: x (n, 19) counts; time (n,); force (n, 3) and tdc (n,) as the file will have them; pressed
    (n, 3) force, also where the file has none; rest, noise (19,); whole (N, 19): the source's counts, where
    x began at row `first`; touched: whether an effect is in x already; used: electrodes that have one.
    """

    def __init__(self, source, first, last, loaded, with_force, rng, other):
        self.whole, self.first, self.rate, self.noise = source.x, first, source.rate, source.noise
        self.x, self.time = source.x[first:last].copy(), source.time[first:last].copy()
        self.pressed = None if source.force is None else source.force[first:last].copy()
        self.force = self.pressed.copy() if with_force else None
        self.tdc = None if source.tdc is None else source.tdc[first:last].copy()
        self.rest = np.median(self.x[:50], 0) if source.rest is None else source.rest
        self.loaded, self.rng, self.other = loaded, rng, other
        self.used, self.touched, self.gaps = set(), False, []

    @property
    def n(self):
        return len(self.x)

    @property
    def load(self):
        return self.x - self.rest

    def smooth(self, width=7):
        return gaussian_filter1d(self.x, width, axis=0)

    def pick(self, number=1, active=None):
        """Electrodes without an effect; active: of those that move most, by itself where the sensor is
        pressed."""
        active = self.loaded if active is None else active
        spread = self.smooth(5).std(0)
        free = [c for c in range(19) if c not in self.used]
        if active:
            free.sort(key=lambda c: -spread[c])
            free = free[: max(number + 3, int(len(free) * 0.6))]
        c = sorted(int(v) for v in self.rng.choice(free, number, replace=False))
        self.used.update(c)
        return c

    def electrodes(self, number, active=None):
        return ALL if number is None else self.pick(number, active)

    def when(self, low=0.25, high=0.7, calm=False):
        """A row between shares of the piece; calm: one about which little moves."""
        a, b = int(low * self.n), int(high * self.n)
        if not calm:
            return int(self.rng.integers(a, b))
        move = np.gradient(uniform_filter1d(self.x, 25, axis=0), axis=0) / self.noise
        move = uniform_filter1d(np.abs(move).sum(1), 181)[a:b]
        return a + int(self.rng.choice(np.flatnonzero(move <= np.quantile(move, 0.12))))

    def keep(self, rows):
        """Leaves rows (a mask, or numbers) alone, with their times."""
        for name in ("x", "time", "force", "tdc"):
            if getattr(self, name) is not None:
                setattr(self, name, getattr(self, name)[rows])


# ---------------------------------------------------------------- helpers

ALL = list(range(19))
_SIDE, _OTHER_SIDE, _TIP = list(range(6)), list(range(10, 16)), [6, 7, 8, 9]


def _logistic(n, at, width):
    return 1 / (1 + np.exp(-np.clip((np.arange(n) - at) / max(width, 1e-9), -50, 50)))


def _walk(rng, n, smooth=60):
    """(n,) from 0, within -1 and 1."""
    w = np.cumsum(rng.normal(size=n))
    w = gaussian_filter1d(w - w[0], smooth)
    w -= w[0]
    return w / np.abs(w).max()


def _ln_z(counts):
    counts = np.clip(counts, 2, 4093)
    return np.log(counts / (4095 - counts))


def _counts(z):
    return 4095 / (1 + np.exp(-z))


def _lag(x, rows):
    """One pole, along the first axis; it begins where x does."""
    a = 1 - np.exp(-1 / rows)
    start = ((1 - a) * x[0])[None] if x.ndim > 1 else [(1 - a) * x[0]]
    return lfilter([a], [1, a - 1], x, axis=0, zi=start)[0]


def _pink(rng, n):
    f = np.fft.rfftfreq(n)
    f[0] = f[1]
    z = np.fft.irfft((rng.normal(size=len(f)) + 1j * rng.normal(size=len(f))) / f**0.5, n)
    return z / z.std()


def _from(p, row):
    return np.arange(p.n) >= row


# ---------------------------------------------------------------- effects: (piece, form, ...) -> channels


def _gain(p, form, g, k=1):
    c, n = p.pick(k, active=True), p.n
    row, u = np.arange(n), np.arange(n)[:, None]
    d, o = p.x[:, c] - p.rest[c], p.when(0.3, 0.6)
    if form == "in impedance, soft onset":
        z, z0 = _ln_z(p.x[:, c]), _ln_z(p.rest[c])
        p.x[:, c] = _counts(z0 + (z - z0) * (1 + (g - 1) * _logistic(n, o, 60)[:, None]))
        return c
    if form == "sudden":
        factor = np.where(u >= o, g, 1.0)
    elif form == "slow ramp":
        factor = 1 + (g - 1) * np.clip((u - 0.2 * n) / (0.65 * n), 0, 1)
    elif form == "from first row":
        factor = np.full((n, 1), g)
    elif form == "one sided":
        factor = np.where((d < 0) & (u >= o), g, 1.0)
    elif form == "staircase":
        rows = sorted(int(v * n) for v in p.rng.uniform(0.2, 0.85, 3))
        factor = 1 + (g - 1) * sum((row >= r) * 1.0 for r in rows)[:, None] / 3
    else:  # wandering
        factor = (1 + (g - 1) * (0.5 + 0.5 * _walk(p.rng, n, 150)))[:, None]
    p.x[:, c] = p.rest[c] + d * factor
    return c


def _sign(p, form, k=1):
    c = p.pick(k, active=True)
    y = 4095 - p.x[:, c] if "4095" in form else p.rest[c] - (p.x[:, c] - p.rest[c])
    on = np.ones(p.n, bool)
    if form == "from a row on":
        on = _from(p, p.when(0.3, 0.6))
    elif form == "for a while":
        o = p.when(0.25, 0.4)
        on = _from(p, o) & ~_from(p, o + int(0.35 * p.n))
    p.x[:, c] = np.where(on[:, None], y, p.x[:, c])
    return c


def _permutation(p, form, chosen=None):
    c, o = p.pick(2) if chosen is None else list(chosen), 0
    p.used.update(c)
    if form.startswith("cyclic shift of all"):
        c, sources = ALL, ALL[-1:] + ALL[:-1]
    elif form.startswith("plug reversed"):
        sources = c[::-1]
    else:
        sources = c[1:] + c[:1]
    if "from" in form:
        o = p.when(0.3, 0.65)
    y = p.x.copy()
    y[o:, c] = p.x[o:][:, sources]
    p.x = y
    return c


def _offset(p, form, h, k=1):
    c, n, first = p.pick(k, active=False), p.n, None
    for q in c:
        s = h * p.rng.choice([-1, 1]) * p.rng.uniform(0.8, 1.2)
        o = p.when(0.2, 0.75, calm=True)
        if form == "common step":
            first = o if first is None else first
            w = _from(p, first) * 1.0
        elif form == "step that settles":
            w = _from(p, o) * (1 - 0.5 * np.exp(-np.clip(np.arange(n) - o, 0, None) / (0.15 * p.rate)))
        elif form == "two steps":
            w = _from(p, o) + 0.7 * _from(p, min(n - 50, o + int(0.15 * n)))
        elif form == "there and back":
            w = _from(p, o) & ~_from(p, o + int(0.18 * n))
        elif form == "staircase":
            w = sum(_from(p, int(v * n)) * 1.0 for v in p.rng.uniform(0.15, 0.85, 3)) / 1.5
        else:  # step
            w = _from(p, o)
        p.x[:, q] += s * w
    return c


def _drift(p, form, h, k=1):
    c, i = p.pick(k, active=False), np.arange(p.n) / p.n
    for q in c:
        s = h * p.rng.choice([-1, 1]) * p.rng.uniform(0.8, 1.2)
        if form == "random walk":
            d = _walk(p.rng, p.n, p.rng.choice([15, 30, 80]))
        elif form == "saturating":
            d = 1 - np.exp(-i / p.rng.uniform(0.12, 0.3))
        elif form == "starts in the middle, linear":
            d = np.clip(i - p.rng.uniform(0.35, 0.5), 0, None) / 0.5
        elif form == "accelerating":
            d = i**2.5
        else:  # slow wave
            d = np.sin(2 * np.pi * (i * p.rng.uniform(0.7, 1.3) + p.rng.uniform()))
        p.x[:, q] += s * (d - d[0])
    return c


def _warm_up(p, form, h, tdc=0.0):
    n = p.n
    i = np.arange(n) / n
    share = p.rng.uniform(0.7, 1.25, 19) * (1.25 - 0.5 * (p.rest - p.rest.min()) / np.ptp(p.rest))
    if form == "exponential":
        w = 1 - np.exp(-i / 0.35)
    elif form == "two time constants":
        w = 0.4 * (1 - np.exp(-i / 0.05)) + 0.6 * (1 - np.exp(-i / 0.6))
    elif form == "switched on late":
        w = 1 - np.exp(-np.clip(i - p.rng.uniform(0.25, 0.4), 0, None) / 0.25)
    elif form == "nearly linear":
        w = (1 - np.exp(-i / 1.5)) / (1 - np.exp(-1 / 1.5))
    else:  # S-shaped
        w = 1 / (1 + np.exp(-(i - 0.45) / 0.12))
        w = (w - w[0]) / (w[-1] - w[0])
    p.x += h * np.outer(w, share)
    if tdc and p.tdc is not None:
        p.tdc = p.tdc + tdc * _lag(w, 0.02 * n)
    return ALL


def _temperature(p, form, slope, chosen=None):
    """slope: counts per count of TDC."""
    n, c = p.n, ALL if chosen is None else list(chosen)
    if "warm air" in form:
        p.tdc = p.tdc + 55 * np.exp(-(((np.arange(n) / n - 0.55) / 0.13) ** 2))
    if "draught" in form:
        p.tdc = p.tdc - 40 * np.clip(_walk(p.rng, n, 60), -1, 1)
    d = gaussian_filter1d(p.tdc, 6)
    d = d - d[0]
    if "lagged" in form:
        d = _lag(d, 1.5 * p.rate)
    if "curved" in form:
        d = d * (1 + 0.6 * np.abs(d) / np.abs(d).max())
    if "beyond a threshold" in form:
        d = np.sign(d) * np.clip(np.abs(d) - 0.4 * np.abs(d).max(), 0, None) * 1.6
    share = slope * p.rng.uniform(0.7, 1.3, len(c))
    if "mixed" in form:
        share = share * p.rng.choice([-1, 1], len(c))
    p.x[:, c] += np.outer(d, share)
    return c


def _fluid_loss(p, form, h):
    """Less liquid: more impedance everywhere, and a load is answered by a little more of it."""
    i = np.arange(p.n) / p.n
    if form == "steady":
        w = i
    elif form == "leak slows down":
        w = (1 - np.exp(-i / 0.4)) / (1 - np.exp(-1 / 0.4))
    elif form == "leak starts in the middle":
        o = p.rng.uniform(0.3, 0.45)
        w = np.clip((i - o) / (1 - o), 0, None) ** 0.8
    elif form == "faster under load":
        w = np.cumsum(np.abs(p.smooth(20) - p.rest).mean(1) ** 1.5)
        w = w / w[-1]
    else:  # in small portions
        w = sum(np.clip((i - q) / 0.035, 0, 1) for q in np.sort(p.rng.uniform(0.05, 0.95, 9))) / 9
    share, z0 = p.rng.uniform(0.75, 1.25, 19), _ln_z(p.rest)
    lost = h / (p.rest * (4095 - p.rest) / 4095).mean() * share
    p.x = _counts(z0 + (_ln_z(p.x) - z0) * (1 + 0.12 * w[:, None]) - np.outer(w, lost))
    return ALL


def _after_release(x, rows):
    """x (n, c) that follows a growing load at once and a falling one through one pole."""
    y, s, b = np.empty_like(x), x[0].copy(), 1 - np.exp(-1 / rows)
    for j, now in enumerate(x):
        s = s + np.where(np.abs(now) > np.abs(s), now - s, b * (now - s))
        y[j] = s
    return y


def _relaxation(p, form, a, tau, k=None):
    c, t = p.electrodes(k, active=True), tau * p.rate
    x = p.smooth(4)[:, c] - p.rest[c]
    if form == "overshoot that decays":
        d = x - _lag(x, t)
    elif form == "creeps on, exponential":
        d = _lag(x, t) - x
    elif form == "creeps on, many time constants":
        d = sum(_lag(x, q * t) for q in (0.15, 0.5, 1.5, 4)) / 4 - x
    elif form == "slow only after release":
        d = _after_release(x, t) - x
    else:  # stretched
        d = 0.6 * _lag(_lag(x, 0.3 * t), t) + 0.4 * _lag(x, 3 * t) - x
    p.x[:, c] += a * d
    return c


def _play(x, width):
    """x (n, c) with play of half a width (c,)."""
    y, s = np.empty_like(x), x[0].copy()
    for j, now in enumerate(x):
        s = np.minimum(np.maximum(s, now - width), now + width)
        y[j] = s
    return y


def _hysteresis(p, form, a, k=None):
    c = p.electrodes(k, active=True)
    x = p.smooth(5)[:, c] - p.rest[c]
    size = np.maximum(x.std(0), 15)
    if form == "play":
        d = 2.0 * (_play(x, size) - x)
    elif form == "sum of plays":
        d = 2.0 * (sum(_play(x, q * size) for q in (0.3, 0.7, 1.2, 1.8)) / 4 - x)
    elif form == "unloading retraces lower":
        y, most, stay = np.empty_like(x), np.zeros(x.shape[1]), np.exp(-1 / (6 * p.rate))
        for j, now in enumerate(x):
            most = np.where(np.abs(now) > np.abs(most), now, most * stay + now * (1 - stay))
            y[j] = most
        d = (y - x) * (np.clip(np.abs(x) / (np.abs(y) + 1), 0, 1) + 0.5)
    elif form == "friction of the skin, follows direction of force":
        f = gaussian_filter1d(p.pressed[:, 2], 12)
        slip = (f - _play(f[:, None], 0.35)[:, 0]) / 0.35
        d = size * np.sign(p.rng.normal(size=len(c))) * slip[:, None]
    else:  # Bouc-Wen
        z, s = np.empty_like(x), np.zeros(x.shape[1])
        for j, v in enumerate(1.5 * np.diff(x, axis=0, prepend=x[:1]) / size):
            s = np.clip(s + v - (np.abs(v) * s * 0.6 + v * np.abs(s) * 0.4), -1.5, 1.5)
            z[j] = s
        d = -size * z
    p.x[:, c] += a * d
    return c


def _latency(p, form, m, chosen=None):
    n, c = p.n, ALL if chosen is None else list(chosen)
    i, late = np.arange(n), np.full(n, float(m))
    if form == "from the middle":
        late = m * _from(p, p.when(0.3, 0.6))
    elif form == "grows":
        late = m * i / n
    elif form == "jitters":
        late = m * (1 + 0.5 * _walk(p.rng, n, 40))
    late = np.round(late).astype(int)
    if p.touched:
        p.x[:, c] = p.x[np.clip(i - late, 0, n - 1)][:, c]
    else:  # what was there before the piece began
        p.x[:, c] = p.whole[np.clip(p.first + i - late, 0, len(p.whole) - 1)][:, c]
    return c


def _low_pass(p, form, tau, k=None):
    c = p.electrodes(k)
    x, rows = p.x[:, c], tau * p.rate
    if form == "first order":
        y = _lag(x, rows)
    elif form == "moving average":
        m = int(2 * rows)
        y = [np.convolve(np.r_[np.full(m - 1, v[0]), v], np.ones(m) / m, "valid") for v in x.T]
        y = np.array(y).T
    elif form == "second order from the middle":
        y = _lag(_lag(x, rows / 1.5), rows / 1.5)
        y = np.where(_from(p, p.when(0.3, 0.55))[:, None], y, x)
    elif form == "slew limited":  # tau: counts a row
        y, s = np.empty_like(x), x[0].copy()
        for j, now in enumerate(x):
            s = s + np.clip(now - s, -tau, tau)
            y[j] = s
    else:  # zero phase
        y = sosfiltfilt(butter(2, 1 / (2 * np.pi * tau), fs=p.rate, output="sos"), x, axis=0)
    p.x[:, c] = y
    return c


def _noise(p, form, s, k=1):
    c, n = p.electrodes(k, active=False), p.n
    for q in c:
        a, e = s * p.noise[q], p.rng.normal(size=n)
        if form == "heavy tails":
            e = p.rng.standard_t(2.5, n) / 1.6
        elif form == "flicker":
            e = _pink(p.rng, n)
        elif form == "bursts":
            w = gaussian_filter1d(p.rng.normal(size=n), 90)
            e = 1.4 * e * (w > np.quantile(w, 0.6))
        elif form == "under load only":
            load = np.abs(p.smooth(10)[:, q] - p.rest[q])
            e = e * np.clip(load / np.quantile(load, 0.7), 0, 1.3)
        elif form == "white, from the middle":
            e = e * _from(p, p.when(0.35, 0.6))
        p.x[:, q] += a * e
    return c


def _line_noise(p, form, f, a, k=None):
    """f [Hz] as it is, sampled where it falls; each electrode has its phase in the multiplexer's frame."""
    c, n, t, rng = p.electrodes(k, active=False), p.n, p.time, p.rng
    begin, w = rng.uniform(0, 6.28), np.ones(n)
    wander = f + rng.normal() * 0.03 + 0.04 * _walk(rng, n, 400) * (form != "steady")
    phase = 2 * np.pi * np.cumsum(wander * np.diff(t, prepend=t[0]))
    if form == "swells and fades":
        w = 0.55 + 0.45 * _walk(rng, n, 200)
    elif form == "from the middle":
        w = _from(p, p.when(0.3, 0.6)) * 1.0
    elif form == "switched on and off":
        z = gaussian_filter1d(rng.normal(size=n), 150)
        w = (z > np.quantile(z, 0.4)) * 1.0
    for q in c:
        at = phase + begin + 2 * np.pi * f * (q * 2 + 1) / 44 / p.rate
        y = np.sin(at)
        if form == "with harmonics":
            y = y + 0.5 * np.sin(3 * at + 0.7) + 0.3 * np.sin(2 * at)
        p.x[:, q] += a * rng.uniform(0.75, 1.25) * w * y
    return c


def _cross_talk(p, form, g, k=1):
    if form.startswith("all"):
        c = ALL[1:]
    else:  # those whose neighbour moves
        spread, apart = p.smooth(5).std(0), np.abs(np.diff(p.x.mean(0)))
        by = spread[:-1] + (0 if p.loaded else 0.2 * apart)
        order = sorted(range(1, 19), key=lambda q: -by[q - 1])
        free = [q for q in order[:9] if q not in p.used]
        c = sorted(int(v) for v in p.rng.choice(free, k, replace=False))
        p.used.update(c)
    x, heard = p.x.copy(), [q - 1 for q in c]
    if "next" in form:
        heard = [q + 1 if q < 18 else q - 1 for q in c]
    d = g * (x[:, heard] - (p.rest[heard] if "response only" in form else x[:, c]))
    w = np.ones(p.n)
    if "from" in form:
        w = _from(p, p.when(0.3, 0.6)) * 1.0
    if "slowly" in form:
        w = np.linspace(0, 1, p.n) ** 1.5
    p.x[:, c] = x[:, c] + d * w[:, None]
    return c


def _quantisation(p, form, step, k=None):
    c = p.electrodes(k, active=True)
    x = p.x[:, c]
    if "truncated" in form:
        y = np.floor(np.round(x) / step) * step
    elif "centred" in form:
        y = np.floor(np.round(x) / step) * step + step // 2
    else:  # rounded, rescaled
        y = np.round(np.round(x / step) * step)
    if "from" in form:
        y = np.where(_from(p, p.when(0.3, 0.6))[:, None], y, x)
    p.x[:, c] = y
    return c


def _saturation(p, form, q, k=1):
    """q: share of the rows that are beyond the rail."""
    c = p.electrodes(k, active=True)
    for j in c:
        x = p.x[:, j]
        low, high = np.quantile(x, [q, 1 - q])
        flicker = p.rng.integers(0, 2, p.n) * (p.rng.random(p.n) < 0.08)
        if form == "lower rail above zero":
            y = np.maximum(x, low) + (x < low) * flicker
        elif form == "upper rail below 4095":
            y = np.minimum(x, high) - (x > high) * flicker
        elif form == "soft knee at the upper rail":
            w = 0.12 * np.ptp(x)
            y = np.minimum(high - w * np.log1p(np.exp(np.clip((high - x) / w, -40, 40))), high)
        elif form == "biased, clips at 4095":
            y = np.minimum(x + (4095 - high), 4095)
        elif form == "biased, clips at 0":
            y = np.maximum(x - low, 0)
        else:  # rail comes down (supply sags)
            rail = np.linspace(x.max() + 5, np.quantile(x, 1 - 1.6 * q), p.n)
            y = np.minimum(x, rail + 2 * _walk(p.rng, p.n))
        p.x[:, j] = y
    return c


def _stuck(p, form, k=1):
    c, n, rng = p.pick(k), p.n, p.rng
    for j in c:
        o = p.when(0.2, 0.55)
        level, on, flicker = p.x[o, j], _from(p, o), 0
        if form == "holds, last bit flickers":
            flicker = rng.random(n) < 0.15
        elif form == "at 0 from first row":
            level, on = 0, _from(p, 0)
        elif form == "at 4095 from a row on":
            level = 4095
        elif form == "mid-scale from first row":
            level, on = 2048 + int(rng.integers(-30, 30)), _from(p, 0)
            flicker = (rng.random(n) < 0.05) * rng.choice([-1, 1], n)
        elif form == "for a while, comes back":
            on = on & ~_from(p, o + int(0.3 * n))
        elif form == "freezes again and again":
            on, level = np.zeros(n, bool), p.x[:, j].copy()
            for q in np.sort(rng.integers(0, n - 260, 7)):
                length = int(rng.integers(90, 250))
                on[q : q + length], level[q : q + length] = True, level[q]
        p.x[:, j] = np.where(on, level + flicker, p.x[:, j])
    return c


def _spikes(p, form, h=300.0, m=12, k=1):
    n, rng, hit = p.n, p.rng, set()
    rows = np.sort(rng.choice(np.arange(20, n - 20), m, replace=False))
    c = p.electrodes(k, active=False)
    if form == "regular":
        rows = int(rng.integers(20, n // m)) + n // m * np.arange(m)
        rows = rows[rows < n]
    for r in rows:
        if form in ("one channel", "regular"):
            p.x[r, c] += h * rng.uniform(0.7, 1.4) * rng.choice([-1, 1], len(c))
            continue
        if form == "one sided":
            p.x[r, c] -= h * (0.4 + rng.exponential(0.8, len(c)))
            continue
        if form == "whole frame off":
            p.x[r] += h * rng.normal(size=19)
            continue
        q = int(rng.integers(19)) if form == "any channel, one a row" else int(rng.choice(c))
        hit.add(q)
        if form == "bit flips":
            p.x[r, q] = int(p.x[r, q]) ^ (1 << int(rng.choice([7, 8, 9])))
        elif form == "reads 0 or 4095":
            p.x[r, q] = rng.choice([0, 4095])
        else:
            p.x[r, q] += h * rng.choice([-1, 1]) * rng.uniform(0.7, 1.4)
    return ALL if form == "whole frame off" else sorted(hit) or c


def _lost(p, form, m=6):
    n, rng, keep = p.n, p.rng, np.ones(p.n, bool)
    if form == "single rows at random":
        keep[rng.choice(np.arange(5, n - 5), m, replace=False)] = False
    elif form == "bursts":
        for q in rng.integers(50, n - 150, m):
            keep[q : q + int(rng.integers(8, 70))] = False
    elif form == "buffer overflow, every so often":
        for q in range(int(rng.integers(20, n // m)), n - 10, n // m):
            keep[q : q + 5] = False
    elif form == "more and more":
        keep[np.unique((n * rng.random(m) ** 0.35).astype(int).clip(5, n - 5))] = False
    elif form == "one long gap":
        q = p.when(0.3, 0.7)
        keep[q : q + m] = False
    else:  # in bad minutes (Gilbert)
        bad = gaussian_filter1d(rng.normal(size=n), 60)
        keep = ~((bad > np.quantile(bad, 0.85)) & (rng.random(n) < 0.4))
        keep[:3] = True
    p.keep(keep)
    p.gaps = list(np.flatnonzero(np.diff(np.flatnonzero(keep)) > 1) + 1)
    return ALL


def _held(p, form, m=3, share=0.1):
    """Force comes from another instrument and runs on."""
    n, rng, i = p.n, p.rng, np.arange(p.n)
    source = i.copy()
    if form == "every row repeated (slow publisher)":
        source = i - i % m
    elif form == "random repeats":
        again = rng.random(n) < share
        again[0] = False
        source = np.maximum.accumulate(np.where(again, 0, i))
    elif form == "freezes":
        for q in np.sort(rng.integers(30, n - 150, m)):
            source[q : q + int(rng.integers(20, 110))] = source[q]
    elif form == "slow publisher from the middle":
        o = p.when(0.3, 0.6)
        source = np.where(i < o, i, i - (i - o) % m)
    elif form == "uneven 2-3-2-3":
        lengths = rng.choice([1, 2, 3, 4], n)
        ends = np.cumsum(lengths)
        which = np.searchsorted(ends, i, "right")
        source = ends[which] - lengths[which]
    else:  # rows written twice, same time stamp
        times = np.ones(n, int)
        times[rng.choice(n, int(share * n), replace=False)] = 2
        p.keep(np.repeat(i, times))
        return ALL
    p.x = p.x[source]
    if p.tdc is not None:
        p.tdc = p.tdc[source]
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


# ---------------------------------------------------------------- outside the catalogue: (piece, ...)


def _bubble(p, h, under=_TIP):
    """It wanders under neighbours, one after another."""
    i, o, w = np.arange(p.n), p.when(0.25, 0.5), 1.6 * p.rate
    for j, q in enumerate(under):
        high = h * p.rng.uniform(0.7, 1.2)
        p.x[:, q] -= high * np.exp(-(((i - o - j * 1.9 * w) / w) ** 2)) * (1 + 0.15 * _pink(p.rng, p.n))


def _pops(p, h, k=3):
    """Small bubbles: jumps that decay."""
    c, i = p.pick(k, active=False), np.arange(p.n)
    for r in p.rng.integers(0, p.n - 50, 14):
        w = (i >= r) * np.exp(-np.clip(i - r, 0, None) / (p.rng.uniform(0.1, 0.8) * p.rate))
        p.x[:, c] += h * p.rng.exponential(1) * w[:, None] * p.rng.uniform(0.3, 1.2, k)


def _loose(p, h=700, k=1, chosen=None):
    """A wire or a plug."""
    c, n, w = list(chosen) if chosen else p.pick(k, active=False), p.n, np.zeros(p.n)
    for r in p.rng.integers(0, n - 100, 22):
        w[r : r + int(p.rng.exponential(14)) + 2] = 1
    p.x[:, c] = np.minimum(p.x[:, c] + w[:, None] * (h + 90 * p.rng.normal(size=(n, len(c)))), 4095)


def _knock(p, h, m=3):
    """On the housing, which rings."""
    i, share = np.arange(p.n), p.rng.normal(size=19)
    for r in np.sort(p.rng.integers(int(0.1 * p.n), int(0.9 * p.n), m)):
        t = np.clip(i - r, 0, None) / p.rate
        ring = (i >= r) * np.exp(-t / 0.35) * np.sin(2 * np.pi * p.rng.uniform(7, 13) * t)
        p.x += h * np.outer(ring, share)


def _modulated(p, f=0.8, a=0.45):
    wave = 1 + a * np.sin(2 * np.pi * f * np.arange(p.n) / p.rate + p.rng.uniform(0, 6))
    p.x = p.rest + p.load * wave[:, None]


def _halves(p):
    """Of the electrodes' record, exchanged."""
    p.x = np.roll(p.x, -(p.n // 2), axis=0)


def _chirps(p, a, m=6):
    """A motor runs up: bursts of aliased interference."""
    share = p.rng.uniform(0.5, 1.2, 19) * p.rng.choice([-1, 1], 19)
    for r in p.rng.integers(0, p.n - 400, m):
        length = min(int(p.rng.uniform(0.8, 2.5) * p.rate), p.n - r)
        t = np.arange(length) / p.rate
        low, high = p.rng.uniform(1, 20), p.rng.uniform(25, 110)
        wave = np.sin(2 * np.pi * (low * t + (high - low) * t**2 / (2 * length / p.rate)))
        p.x[r : r + length] += a * np.outer(np.hanning(length) * wave, share)


def _rub(p, a, c=_SIDE):
    n, z = p.n, gaussian_filter1d(p.rng.normal(size=p.n), 70)
    stretch = np.clip((z - np.quantile(z, 0.55)) / z.std(), 0, 1.5)
    waves = sosfilt(butter(2, [6, 22], "band", fs=p.rate, output="sos"), p.rng.normal(size=(n, 3)), axis=0)
    waves /= waves.std(0)
    p.x[:, c] += a * stretch[:, None] * (waves @ p.rng.normal(size=(3, len(c)))) / 1.7


def _backwards(p):
    a, b = int(0.3 * p.n), int(0.75 * p.n)
    p.x[a:b] = p.x[a:b][::-1].copy()


def _another_sensor(p):
    """For a while."""
    a, b = int(0.4 * p.n), int(0.7 * p.n)
    start = int(p.rng.integers(0, len(p.other) - p.n))
    p.x[a:b] = p.other[start : start + b - a]


def _curved(p, power=1.6):
    d = p.load
    size = np.quantile(np.abs(d), 0.9, 0) + 1
    p.x = p.rest + np.sign(d) * size * (np.abs(d) / size) ** power


def _dead_zone(p, h=120):
    slow = p.smooth(6) - p.rest
    p.x = p.x - slow + np.sign(slow) * np.clip(np.abs(slow) - h, 0, None)


def _force_drifts(p, h=2.5):
    p.force[:, 2] += h * np.linspace(0, 1, p.n) ** 1.3


def _force_turned(p):
    """By 90 degrees, from a time on."""
    o = p.when(0.35, 0.5)
    p.force[o:] = p.force[o:][:, [1, 0, 2]] * [1, -1, 1]


def _force_scaled(p):
    p.force[p.when(0.3, 0.5) :, 2] *= -0.45


def _clock_jumps(p, d=40.0):
    p.time[p.when(0.3, 0.7) :] += d


def _clock_runs(p, rate=1.35):
    o = p.when(0.3, 0.5)
    p.time[o:] = p.time[o] + (p.time[o:] - p.time[o]) * rate
    p.time = np.round(p.time, 4)


def _echo(p, g=0.5, s=0.9):
    m, d = int(s * p.rate), p.smooth(2) - p.rest
    p.x = p.x + g * np.r_[np.repeat(d[:1], m, 0), d[:-m]]


def _wraps(p, k=2):
    """Upper bits are lost."""
    c = p.pick(k, active=True)
    p.x[:, c] = np.round(p.x[:, c]) % 1024


def _rectified(p):
    p.x = p.rest + np.abs(p.load)


def _automatic_gain(p, g=0.6):
    size, s = np.abs(p.smooth(10) - p.rest).mean(1), 0.0
    held = np.empty(p.n)
    for j, now in enumerate(size):
        s = max(s * np.exp(-1 / (5 * p.rate)), now)
        held[j] = s
    held /= held.max()
    p.x = p.rest + p.load * (1 - g * np.clip(held - 0.2, 0, None) / 0.8)[:, None]


def _warped(p, h=0.12):
    """Against the force."""
    n, i = p.n, np.arange(p.n)
    at = i + h * n * np.sin(np.pi * i / n) * np.sin(2 * np.pi * i / n)
    p.x = p.x[np.round(np.clip(at, 0, n - 1)).astype(int)]


def _packets(p, length=14):
    """Rows of one in four are out of order."""
    i = np.arange(p.n)
    for r in range(0, p.n - length, length):
        if p.rng.random() < 0.25:
            i[r : r + length] = i[r : r + length][p.rng.permutation(length)]
    p.x = p.x[i]


def _bits(p, a=5, b=7):
    """Two of the converter's, exchanged."""
    c = p.pick(1, active=True)[0]
    v = np.round(p.x[:, c]).astype(int)
    p.x[:, c] = v & ~(1 << a | 1 << b) | (v >> a & 1) << b | (v >> b & 1) << a


def _taps(p, h):
    """On the table: irregular short pulses in a fixed pattern."""
    i, share = np.arange(p.n), p.rng.normal(size=19)
    times, wave = np.cumsum(p.rng.uniform(1.2, 4.5, 60)) * p.rate, np.zeros(p.n)
    for r in times:
        t = (i - r) / (0.25 * p.rate)
        wave += np.where(i > r, t * np.exp(1 - t.clip(0)), 0) * p.rng.uniform(0.5, 1.4)
    p.x += h * np.outer(wave, share)


OUTSIDE = {
    "bubble": _bubble,
    "pops": _pops,
    "loose": _loose,
    "knock": _knock,
    "am": _modulated,
    "halves": _halves,
    "chirp": _chirps,
    "rub": _rub,
    "reverse": _backwards,
    "other": _another_sensor,
    "power": _curved,
    "dead": _dead_zone,
    "fdrift": _force_drifts,
    "faxes": _force_turned,
    "fscale": _force_scaled,
    "clock": _clock_jumps,
    "clockrate": _clock_runs,
    "echo": _echo,
    "wrap": _wraps,
    "rect": _rectified,
    "agc": _automatic_gain,
    "warp": _warped,
    "shuffle": _packets,
    "bits": _bits,
    "wob": _taps,
}


# ---------------------------------------------------------------- the plan


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base, with f at its end where the file has the force; rows: first and last + 1 of the
    source; effects: of (kind, form, sizes), the author's names, of one outside the catalogue (kind, "", ...);
    seed."""

    name: str
    base: str
    rows: tuple
    effects: tuple
    seed: int

    @property
    def outside(self) -> bool:
        return bool(self.effects) and self.effects[0][0] in OUTSIDE

    @property
    def loaded(self) -> bool:
        return self.base != "U"

    @property
    def kinds(self) -> tuple:
        """Of the benchmark's vocabulary."""
        if self.outside:
            return ("outside_loaded",) if self.base[:2] in ("F1", "F2") else ("outside",)
        return tuple(KINDS[kind] for kind, *_ in self.effects)


def plan() -> list[Spec]:
    """222 pieces: singles, pairs, outside the catalogue, untouched."""
    specs = [
        Spec(f"{number:03d}", base, (first, first + rows), effects, seed)
        for seed, (number, base, first, rows, *effects) in enumerate(_PLAN)
    ]
    return sorted((dataclasses.replace(s, effects=tuple(s.effects)) for s in specs), key=lambda s: s.name)


def make(spec: Spec, data: str) -> tuple[dict, np.ndarray]:
    """Fields of the case, its counts as a file has them, and the counts without what is hidden (n, 19), rows
    that are lost later among them."""
    folder, name = pathlib.Path(data), spec.base.removesuffix("f")
    source, rng = _source(folder, name), np.random.default_rng([_SEED, spec.seed])
    other = _source(folder, "F2").x if "other" in {kind for kind, *_ in spec.effects} else None
    p = _Piece(source, *spec.rows, spec.loaded, spec.base.endswith("f"), rng, other)
    clean, channels = p.x.copy(), []
    rng.random()  # the author drew the name of the clock's column here
    for kind, form, sizes in spec.effects:
        if spec.outside:
            OUTSIDE[kind](p, **sizes)
            channels.append(ALL)
        else:
            channels.append(LAWS[kind](p, form, **sizes))
        p.touched = True
    p.x = np.round(p.x).clip(0, 4095)
    seen = []
    if spec.effects and p.x.shape == clean.shape:
        seen = [float(np.sqrt(((p.x - clean) ** 2).mean(0) / source.noise**2).max())]
    case = {
        "base": "eighth " + name.split("/")[0],
        "counts": p.x,
        "rate": p.rate,
        "force": None if p.force is None else np.round(p.force, 4),
        "tdc": None if p.tdc is None else np.round(p.tdc),
        "loaded": name in ("F1", "F2"),
        "channels": channels,
        "truth": list(spec.kinds),
        "forms": [form or kind for kind, form, _ in spec.effects],
        "seen": seen,
        "gaps": p.gaps,
        "time": p.time,
    }
    return case, clean


# number, base, first row, rows, effects: (kind, form, sizes)
_PLAN = (
    (158, "F1f", 16592, 3868, ("gain", "sudden", dict(g=0.55))),
    (3, "F2f", 2108, 5906, ("gain", "slow ramp", dict(g=1.7, k=2))),
    (104, "F1", 4927, 3445, ("gain", "from first row", dict(g=0.4))),
    (201, "F2", 18646, 4878, ("gain", "from first row", dict(g=1.7))),
    (91, "F2f", 13784, 4620, ("gain", "in impedance, soft onset", dict(g=0.5, k=3))),
    (44, "F1f", 9880, 5047, ("gain", "one sided", dict(g=0.45))),
    (130, "F2f", 8393, 5986, ("gain", "staircase", dict(g=0.45, k=2))),
    (89, "F1f", 3982, 6711, ("gain", "wandering", dict(g=0.4))),
    (198, "F1f", 12005, 2298, ("sign", "throughout, about rest", dict())),
    (132, "F2f", 13677, 2754, ("sign", "from a row on", dict())),
    (182, "F2", 8635, 3566, ("sign", "raw count inverted (4095 - c)", dict())),
    (23, "F1", 16835, 2559, ("sign", "throughout, two electrodes", dict(k=2))),
    (222, "F1f", 3119, 5830, ("sign", "for a while", dict())),
    (180, "F1f", 17401, 2490, ("permutation", "two channels throughout", dict())),
    (161, "F2f", 20399, 2552, ("permutation", "two channels from a row on", dict())),
    (215, "F2", 17165, 2988, ("permutation", "cycle of three throughout", dict(chosen=(2, 9, 16)))),
    (22, "F1", 892, 2325, ("permutation", "cyclic shift of all from a row on", dict())),
    (49, "U", 11575, 2440, ("permutation", "two channels from a row on", dict(chosen=(1, 14)))),
    (
        65,
        "F2f",
        11911,
        3959,
        ("permutation", "plug reversed throughout", dict(chosen=(10, 11, 12, 13, 14, 15))),
    ),
    (206, "F1f", 10100, 2960, ("permutation", "two alike channels from a row on", dict(chosen=(2, 12)))),
    (78, "U", 13267, 1755, ("offset", "step", dict(h=14))),
    (105, "F1", 6789, 2632, ("offset", "step", dict(h=70))),
    (24, "F2f", 6170, 3226, ("offset", "step that settles", dict(h=110, k=2))),
    (43, "U", 2147, 3734, ("offset", "there and back", dict(h=25, k=2))),
    (210, "F1f", 11315, 4077, ("offset", "two steps", dict(h=90))),
    (207, "F2", 3432, 2182, ("offset", "common step", dict(h=130, k=4))),
    (111, "F1f", 16786, 4931, ("offset", "staircase", dict(h=120))),
    (6, "U", 37, 4625, ("drift", "random walk", dict(h=45))),
    (190, "F1f", 2658, 10481, ("drift", "saturating", dict(h=160))),
    (220, "U", 18362, 4081, ("drift", "starts in the middle, linear", dict(h=30, k=2))),
    (205, "F2", 101, 7053, ("drift", "accelerating", dict(h=220))),
    (32, "phac/car_sponge_101_04/F0", 0, 1000, ("drift", "random walk", dict(h=14))),
    (76, "F2f", 13207, 10312, ("drift", "random walk", dict(h=260, k=3))),
    (156, "U", 13992, 4409, ("drift", "slow wave", dict(h=22, k=2))),
    (95, "F1f", 379, 15997, ("warm_up", "exponential", dict(h=160))),
    (70, "F2", 11947, 8214, ("warm_up", "two time constants", dict(h=130))),
    (169, "U", 10488, 5019, ("warm_up", "switched on late", dict(h=70))),
    (139, "phac/car_sponge_101_03/F1", 0, 1000, ("warm_up", "exponential", dict(h=25, tdc=45))),
    (92, "phac/acrylic_211_05/F0", 0, 1000, ("warm_up", "nearly linear", dict(h=35, tdc=60))),
    (20, "F2f", 2691, 15343, ("warm_up", "S-shaped", dict(h=190))),
    (194, "phac/steel_vase_702_05/F1", 0, 1000, ("temperature", "straight", dict(slope=0.8))),
    (79, "phac/steel_vase_702_04/F1", 0, 1000, ("temperature", "lagged", dict(slope=1.4))),
    (186, "phac/acrylic_211_03/F0", 0, 1000, ("temperature", "curved, mixed signs", dict(slope=1.2))),
    (
        28,
        "phac/car_sponge_101_05/F0",
        0,
        1000,
        ("temperature", "straight, warm air comes by (in TDC too)", dict(slope=0.7)),
    ),
    (
        167,
        "phac/car_sponge_101_04/F1",
        0,
        1000,
        (
            "temperature",
            "straight, draught (in TDC too), four electrodes",
            dict(chosen=(3, 4, 12, 13), slope=1.1),
        ),
    ),
    (51, "phac/steel_vase_702_04/F0", 0, 1000, ("temperature", "beyond a threshold", dict(slope=1.3))),
    (166, "btd", 369, 1750, ("temperature", "straight", dict(slope=9.0))),
    (14, "F2f", 8681, 13519, ("fluid_loss", "steady", dict(h=150))),
    (55, "F1f", 167, 9402, ("fluid_loss", "leak slows down", dict(h=170))),
    (195, "F1", 6647, 8105, ("fluid_loss", "leak starts in the middle", dict(h=140))),
    (153, "F2f", 490, 12222, ("fluid_loss", "faster under load", dict(h=200))),
    (46, "U", 14676, 7466, ("fluid_loss", "in small portions", dict(h=110))),
    (185, "F2f", 505, 4821, ("relaxation", "overshoot that decays", dict(a=0.45, tau=3.0))),
    (131, "F1f", 5423, 6369, ("relaxation", "creeps on, exponential", dict(a=0.4, tau=3.0))),
    (42, "F2", 10574, 7094, ("relaxation", "creeps on, many time constants", dict(a=0.55, tau=3.0))),
    (16, "F1", 10772, 6205, ("relaxation", "slow only after release", dict(a=0.5, tau=2.5))),
    (172, "F2f", 4406, 7366, ("relaxation", "stretched", dict(a=0.45, tau=5.0, k=5))),
    (21, "btd", 38, 1560, ("relaxation", "creeps on, exponential", dict(a=0.6, tau=4.0))),
    (221, "F2f", 3520, 5744, ("hysteresis", "play", dict(a=0.28))),
    (208, "F1f", 1848, 5828, ("hysteresis", "sum of plays", dict(a=0.4))),
    (90, "F2f", 9619, 6608, ("hysteresis", "unloading retraces lower", dict(a=0.4))),
    (83, "F1f", 15368, 7064, ("hysteresis", "friction of the skin, follows direction of force", dict(a=0.7))),
    (69, "F1", 5885, 4467, ("hysteresis", "Bouc-Wen", dict(a=0.5))),
    (178, "F2f", 17143, 5295, ("hysteresis", "play", dict(a=0.38, k=4))),
    (115, "F2f", 12029, 2484, ("latency", "constant", dict(m=25))),
    (84, "F1f", 18021, 3354, ("latency", "constant", dict(m=12))),
    (159, "F2f", 7064, 3820, ("latency", "from the middle", dict(m=45))),
    (196, "F1f", 7594, 4897, ("latency", "grows", dict(m=70))),
    (
        187,
        "F2f",
        18946,
        3148,
        ("latency", "some channels", dict(m=30, chosen=(10, 11, 12, 13, 14, 15, 16, 17, 18))),
    ),
    (103, "F1f", 12363, 4178, ("latency", "jitters", dict(m=35))),
    (192, "F1f", 8317, 2708, ("low_pass", "first order", dict(tau=0.25))),
    (5, "F2f", 789, 2964, ("low_pass", "moving average", dict(tau=0.15, k=3))),
    (39, "F2", 18075, 2315, ("low_pass", "second order from the middle", dict(tau=0.4))),
    (109, "U", 13953, 1918, ("low_pass", "first order", dict(tau=0.03, k=2))),
    (214, "F1", 2790, 2277, ("low_pass", "slew limited", dict(tau=5.0))),
    (110, "F1f", 4469, 3073, ("low_pass", "zero phase", dict(tau=0.12))),
    (100, "U", 14728, 1698, ("noise", "white", dict(s=2.5))),
    (152, "F1f", 7728, 2250, ("noise", "heavy tails", dict(s=5.0, k=2))),
    (85, "F2", 20831, 2661, ("noise", "flicker", dict(s=6.0))),
    (17, "phac/acrylic_211_04/F0", 0, 1000, ("noise", "white, from the middle", dict(s=5.0, k=1))),
    (157, "F2f", 5550, 3062, ("noise", "bursts", dict(s=5.0, k=3))),
    (112, "F1", 3872, 3033, ("noise", "under load only", dict(s=7.0, k=2))),
    (64, "U", 17147, 3367, ("noise", "white", dict(s=2.0, k=None))),
    (188, "U", 17961, 1571, ("line_noise", "steady", dict(f=50.0, a=7.0))),
    (63, "F1f", 5566, 2449, ("line_noise", "swells and fades", dict(f=50.0, a=18.0))),
    (120, "F2", 15300, 1940, ("line_noise", "with harmonics", dict(f=16.7, a=22.0, k=4))),
    (81, "phac/car_sponge_101_05/F1", 0, 1000, ("line_noise", "steady", dict(f=60.0, a=1.6))),
    (59, "F2f", 8319, 2563, ("line_noise", "switched on and off", dict(f=100.0, a=28.0))),
    (200, "U", 3923, 2454, ("line_noise", "from the middle", dict(f=60.0, a=12.0, k=2))),
    (160, "F1f", 11144, 2741, ("cross_talk", "share of the previous, one electrode", dict(g=0.35))),
    (4, "F2f", 15729, 3620, ("cross_talk", "all take from the previous", dict(g=0.25))),
    (146, "F2", 609, 2565, ("cross_talk", "response only, from a row on", dict(g=0.5, k=2))),
    (181, "F1", 796, 4572, ("cross_talk", "grows slowly", dict(g=0.5, k=2))),
    (47, "F2f", 4764, 3284, ("cross_talk", "share of the next, one electrode", dict(g=0.45))),
    (126, "U", 12454, 2304, ("cross_talk", "share of the previous, from a row on", dict(g=0.08, k=1))),
    (102, "U", 11315, 1500, ("quantisation", "lowest bits truncated", dict(step=8))),
    (218, "F1f", 3, 2387, ("quantisation", "lowest bits truncated", dict(step=32))),
    (62, "F2", 4406, 2287, ("quantisation", "rescaled, 8-bit log", dict(step=4095 / 255, k=None))),
    (1, "phac/steel_vase_702_02/F1", 0, 1000, ("quantisation", "rounded", dict(step=4))),
    (26, "F2f", 19659, 1894, ("quantisation", "centred, from a row on", dict(step=64, k=None))),
    (165, "F2f", 16300, 3350, ("saturation", "lower rail above zero", dict(q=0.2))),
    (135, "F1f", 1149, 2840, ("saturation", "upper rail below 4095", dict(q=0.3, k=2))),
    (163, "F2", 3649, 3656, ("saturation", "soft knee at the upper rail", dict(q=0.2))),
    (119, "F1", 15922, 3206, ("saturation", "biased, clips at 4095", dict(q=0.2))),
    (217, "F2f", 19856, 3545, ("saturation", "biased, clips at 0", dict(q=0.12))),
    (216, "F1f", 8963, 4627, ("saturation", "rail comes down (supply sags)", dict(q=0.2, k=None))),
    (61, "F1f", 4439, 1881, ("stuck", "holds its last value", dict())),
    (75, "U", 19949, 1872, ("stuck", "holds, last bit flickers", dict())),
    (125, "F2", 9334, 2078, ("stuck", "at 0 from first row", dict())),
    (193, "phac/steel_vase_702_01/F1", 0, 1000, ("stuck", "at 4095 from a row on", dict())),
    (202, "F2f", 6018, 1766, ("stuck", "mid-scale from first row", dict(k=2))),
    (199, "F1", 471, 2399, ("stuck", "for a while, comes back", dict(k=2))),
    (37, "U", 12819, 3887, ("stuck", "freezes again and again", dict())),
    (177, "U", 3416, 1957, ("spikes", "one channel", dict(h=60, m=7))),
    (116, "F1f", 19910, 2509, ("spikes", "whole frame off", dict(h=250, m=9))),
    (113, "F2", 10539, 2656, ("spikes", "bit flips", dict(m=16, k=3))),
    (204, "phac/acrylic_211_04/F1", 0, 1000, ("spikes", "any channel, one a row", dict(h=40, m=12))),
    (141, "F2f", 6549, 2456, ("spikes", "regular", dict(h=350, m=20))),
    (191, "U", 18973, 2303, ("spikes", "one sided", dict(h=70, m=15, k=2))),
    (171, "F2f", 14071, 1555, ("spikes", "reads 0 or 4095", dict(m=6))),
    (117, "F1f", 16263, 2153, ("lost_samples", "single rows at random", dict(m=40))),
    (54, "F2f", 7839, 2589, ("lost_samples", "bursts", dict(m=7))),
    (48, "U", 1129, 2274, ("lost_samples", "buffer overflow, every so often", dict(m=25))),
    (107, "phac/car_sponge_101_01/F1", 0, 1000, ("lost_samples", "more and more", dict(m=35))),
    (87, "F2", 3229, 2947, ("lost_samples", "one long gap", dict(m=200))),
    (41, "F1", 12542, 2299, ("lost_samples", "in bad minutes (Gilbert)", dict())),
    (183, "F1f", 14168, 1838, ("held_samples", "every row repeated (slow publisher)", dict(m=3))),
    (147, "F2f", 9959, 2411, ("held_samples", "random repeats", dict(share=0.12))),
    (13, "U", 9714, 1971, ("held_samples", "freezes", dict(m=6))),
    (7, "F2", 2153, 2425, ("held_samples", "slow publisher from the middle", dict(m=2))),
    (12, "F1", 22, 1500, ("held_samples", "uneven 2-3-2-3", dict())),
    (
        72,
        "phac/steel_vase_702_03/F0",
        0,
        1000,
        ("held_samples", "rows written twice, same time stamp", dict(share=0.08)),
    ),
    (98, "U", 7327, 4880, ("bubble", "", dict(h=45))),
    (60, "F1f", 17421, 5013, ("bubble", "", dict(h=220, under=(10, 11, 12, 13)))),
    (53, "U", 6475, 3468, ("pops", "", dict(h=40))),
    (68, "F2", 12460, 2884, ("loose", "", dict(k=1))),
    (162, "F1f", 14637, 2516, ("loose", "", dict(h=400, chosen=_OTHER_SIDE))),
    (50, "U", 7781, 2771, ("knock", "", dict(h=35))),
    (133, "F2f", 15363, 2969, ("am", "", dict())),
    (106, "F1f", 14439, 4190, ("halves", "", dict())),
    (80, "F2f", 17908, 3479, ("halves", "", dict())),
    (29, "U", 5584, 2528, ("chirp", "", dict(a=18))),
    (86, "F1f", 6076, 3115, ("rub", "", dict(a=60))),
    (93, "phac/car_sponge_101_01/F0", 0, 1000, ("rub", "", dict(a=5, c=(6, 7, 8, 9, 16)))),
    (56, "F2f", 1598, 4737, ("reverse", "", dict())),
    (151, "F1", 3432, 3048, ("other", "", dict())),
    (114, "F2f", 240, 3936, ("power", "", dict())),
    (35, "F1f", 2122, 4058, ("dead", "", dict())),
    (71, "F1f", 8508, 9390, ("fdrift", "", dict())),
    (176, "F2f", 12757, 4258, ("faxes", "", dict())),
    (219, "F1f", 1928, 2886, ("fscale", "", dict())),
    (164, "F2f", 11485, 2222, ("clock", "", dict(d=40.0))),
    (19, "U", 6890, 1706, ("clockrate", "", dict())),
    (209, "F2f", 19349, 3316, ("echo", "", dict())),
    (2, "F2", 14512, 2499, ("wrap", "", dict())),
    (149, "F1f", 18815, 3162, ("rect", "", dict())),
    (173, "F2f", 14531, 6383, ("agc", "", dict())),
    (123, "F1f", 7351, 3801, ("warp", "", dict())),
    (212, "F2f", 18953, 2004, ("shuffle", "", dict())),
    (18, "F1", 13278, 2504, ("bits", "", dict())),
    (213, "U", 2092, 2173, ("wob", "", dict(h=16))),
    (211, "F1f", 2, 4473, ("gain", "sudden", dict(g=0.45)), ("offset", "step", dict(h=110))),
    (148, "U", 3937, 5311, ("drift", "random walk", dict(h=45)), ("noise", "white", dict(s=3.0, k=2))),
    (
        33,
        "F2",
        282,
        2369,
        ("stuck", "holds its last value", dict()),
        ("spikes", "one channel", dict(h=350, m=10)),
    ),
    (8, "U", 8813, 2136, ("offset", "step", dict(h=30)), ("line_noise", "steady", dict(f=50.0, a=9.0))),
    (
        124,
        "F2f",
        5158,
        5330,
        ("gain", "from first row", dict(g=1.6)),
        ("permutation", "two channels from a row on", dict()),
    ),
    (
        150,
        "F1f",
        5863,
        14112,
        ("warm_up", "exponential", dict(h=170)),
        ("stuck", "holds, last bit flickers", dict()),
    ),
    (
        88,
        "F1",
        9755,
        2495,
        ("spikes", "any channel, one a row", dict(h=350, m=14)),
        ("lost_samples", "bursts", dict(m=6)),
    ),
    (
        137,
        "F2f",
        7033,
        5412,
        ("drift", "accelerating", dict(h=260)),
        ("quantisation", "lowest bits truncated", dict(step=32)),
    ),
    (
        30,
        "F1f",
        8939,
        2918,
        ("sign", "throughout, about rest", dict()),
        ("noise", "bursts", dict(s=6.0, k=2)),
    ),
    (
        40,
        "F2f",
        9431,
        3999,
        ("cross_talk", "share of the previous, one electrode", dict(g=0.4)),
        ("offset", "common step", dict(h=130, k=2)),
    ),
    (
        66,
        "F2f",
        2371,
        3144,
        ("latency", "constant", dict(m=30)),
        ("line_noise", "swells and fades", dict(f=50.0, a=22.0)),
    ),
    (
        129,
        "F1",
        13517,
        6601,
        ("low_pass", "first order", dict(tau=0.3, k=2)),
        ("drift", "saturating", dict(h=170)),
    ),
    (
        155,
        "F2",
        10782,
        3316,
        ("saturation", "lower rail above zero", dict(q=0.25)),
        ("noise", "white", dict(s=4.0, k=2)),
    ),
    (
        175,
        "U",
        16429,
        2632,
        ("offset", "there and back", dict(h=35)),
        ("held_samples", "random repeats", dict(share=0.15)),
    ),
    (
        179,
        "phac/steel_vase_702_02/F0",
        0,
        1000,
        ("temperature", "straight", dict(slope=0.9)),
        ("stuck", "at 0 from first row", dict()),
    ),
    (170, "F1f", 11345, 10812, ("fluid_loss", "steady", dict(h=170)), ("gain", "slow ramp", dict(g=0.4))),
    (
        203,
        "F2f",
        16197,
        7366,
        ("relaxation", "creeps on, exponential", dict(a=0.45, tau=3.0)),
        ("spikes", "whole frame off", dict(h=300, m=10)),
    ),
    (
        128,
        "F1f",
        12850,
        4968,
        ("hysteresis", "sum of plays", dict(a=0.45)),
        ("noise", "heavy tails", dict(s=5.0, k=1)),
    ),
    (
        138,
        "U",
        9331,
        4314,
        ("drift", "starts in the middle, linear", dict(h=40)),
        ("spikes", "one sided", dict(h=70, m=12, k=1)),
    ),
    (31, "F1f", 7411, 1500),
    (127, "F1f", 8857, 1500),
    (73, "F1f", 11509, 1758),
    (108, "F1f", 15390, 2290),
    (15, "F1f", 13712, 2907),
    (101, "F1f", 20861, 1500),
    (9, "F1f", 9536, 1648),
    (45, "F1f", 19400, 2095),
    (118, "F1", 6714, 1500),
    (82, "F1", 10691, 1670),
    (145, "F1", 18252, 2154),
    (25, "F2f", 84, 1500),
    (34, "F2f", 4464, 1580),
    (140, "F2f", 15499, 2072),
    (97, "F2f", 7265, 2499),
    (57, "F2f", 1403, 2823),
    (52, "F2f", 21887, 1638),
    (189, "F2f", 5455, 1777),
    (122, "F2f", 12858, 2182),
    (143, "F2", 18602, 1500),
    (11, "F2", 20147, 1761),
    (168, "F2", 16796, 2048),
    (36, "U", 10700, 1500),
    (134, "U", 18679, 1500),
    (96, "U", 48, 1821),
    (197, "U", 20735, 1753),
    (27, "U", 15782, 2005),
    (99, "U", 335, 2472),
    (58, "U", 19311, 1500),
    (174, "U", 4682, 2684),
    (38, "phac/acrylic_211_02/F1", 0, 1000),
    (154, "phac/acrylic_211_02/F0", 0, 1000),
    (144, "phac/acrylic_211_01/F0", 0, 1000),
    (142, "phac/car_sponge_101_02/F0", 0, 1000),
    (67, "phac/car_sponge_101_02/F1", 0, 1000),
    (121, "phac/steel_vase_702_01/F0", 0, 1000),
    (184, "phac/steel_vase_702_03/F1", 0, 1000),
    (136, "phac/steel_vase_702_05/F0", 0, 1000),
    (74, "btd", 0, 2124),
    (94, "F1f", 168, 6534),
    (10, "F2f", 7623, 7893),
    (77, "U", 1943, 16425),
)
