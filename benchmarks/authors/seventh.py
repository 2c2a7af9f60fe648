"""Pieces of recordings of real sensors with one or two hidden effects, by a seventh author.

    plan(data) -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own
words. Everything is seeded; rows of effects of the same kind overlap as little as 150 draws allow. Pieces
have a clock of their own, as a file has: a native log's, one that begins anywhere, and one that jumps.
"""

import dataclasses
import functools
import gzip
import pathlib
import zlib

import numpy as np
from scipy.io import loadmat
from scipy.signal import butter, lfilter, sawtooth, sosfilt

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

_SEED = 20770431
_EPFL = 118.0  # [Hz] of the pressed sensors and the neighbour of one: every seventh row is held
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
    "seventh F1": {"warmup", "latency", "freeze"},
    "seventh F2": {"warmup", "latency", "freeze"},
    "seventh U": {"warmup", "freeze"},
    "seventh phac": {"warmup", "thermal", "fluidloss"},
    "seventh btd": {"lost_rows"},
}


# ---------------------------------------------------------------- recordings


@dataclasses.dataclass
class _Source:
    """A sensor's whole recording: counts x (n, 19), rest (19,), rate [Hz], held (n,) rows that repeat the one
    before, force (n, 3), tdc (n,), time (n,) [s]."""

    x: np.ndarray
    rate: float
    rest: np.ndarray | None = None
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None
    time: np.ndarray | None = None
    held: np.ndarray | None = None


def _text(path):
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        return np.loadtxt(file)


def _native(path):
    """Time (n,) [s], electrodes (n, 19) and TDC (n,) of SynTouch's own log; its first frame is an outlier."""
    rows, row = [], None
    with gzip.open(path, "rt", errors="replace") as file:
        for line in file:
            parts = line.split()
            if len(parts) != 10:
                continue
            try:
                channel, value, time = int(parts[3]), int(parts[8]), float(parts[0])
            except ValueError:
                continue
            if channel == 17:
                row = {"time": time}
                rows.append(row)
            if channel and row is not None:
                row[channel] = value
    rows = [r for r in rows if all(k in r for k in [*range(17, 36), 3])][1:]
    electrodes = np.array([[r[k] for k in range(17, 36)] for r in rows], float)
    return np.array([r["time"] for r in rows]), electrodes, np.array([r[3] for r in rows], float)


def _unpressed(x, force):
    """(19,) medians of the fiftieth of the rows with the least force."""
    return np.median(x[np.argsort(np.linalg.norm(force, axis=1))[: len(force) // 50]], 0)


@functools.cache
def _sources(data):
    out = {}
    x, force = _text(data / "epfl_flat_press/SynImpF1.txt"), _text(data / "epfl_flat_press/ForceData.txt")
    out["F1"] = _Source(x, _EPFL, _unpressed(x, force), force)
    out["U"] = _Source(_text(data / "epfl_flat_press/SynImpF2.txt"), _EPFL)
    x, force = _text(data / "epfl_f2/SynImpF2.txt.gz"), _text(data / "epfl_f2/ForceData.txt.gz")
    out["F2"] = _Source(x, _EPFL, _unpressed(x, force), force)
    time, x, tdc = _native(data / "btd/btsp_touch.btd.gz")
    out["btd"] = _Source(x, 100.0, np.median(x[50:500], 0), tdc=tdc, time=time)
    for finger in ("F0", "F1"):
        x, tdc, rest = [], [], []
        for what in ("car_sponge", "acrylic", "steel"):
            for path in sorted((data / "phac_hold").glob(f"{what}*.mat")):
                mat = loadmat(path, squeeze_me=True)
                x.append(mat[f"{finger}Electrodes"].T.astype(float))
                tdc.append(mat[f"{finger}tdc"].astype(float))
                if what == "car_sponge":
                    rest.append(np.median(x[-1], 0))
        out["phac" + finger] = _Source(np.concatenate(x), 100.0, np.median(rest, 0), tdc=np.concatenate(tdc))
    for source in out.values():
        again = np.r_[False, (np.diff(source.x, axis=0) == 0).all(1)]
        source.held = again if source.rate == _EPFL else np.zeros(len(again), bool)
    return out


@dataclasses.dataclass
class _Piece:
    """Rows of a source on their way: x (n, 19) counts, first (n, 19) as they were; late: what was done is
    done to what the converter has read."""

    base: str
    x: np.ndarray
    first: np.ndarray
    time: np.ndarray
    rate: float
    rest: np.ndarray
    held: np.ndarray
    force: np.ndarray | None
    tdc: np.ndarray | None
    joins: list  # rows at which another grasp begins
    late: bool = False
    gaps: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))

    @property
    def n(self):
        return len(self.x)

    @property
    def load(self):
        return self.x - self.rest


# ---------------------------------------------------------------- helpers


def _lag(x, rows, start=None):
    """One pole, along the first axis; it begins at rest."""
    a = 1 - np.exp(-1 / max(rows, 1e-6))
    x = np.asarray(x, float)
    z = (x[0] if start is None else start) * (1 - a)
    if x.ndim == 1:
        return lfilter([a], [1, a - 1], x, zi=[z])[0]
    return lfilter([a], [1, a - 1], x, axis=0, zi=np.atleast_2d(z))[0]


def _smooth(n, a, b):
    """(n,) from 0 to 1 between rows a and b."""
    u = np.clip((np.arange(n) - a) / max(b - a, 1), 0, 1)
    return u * u * (3 - 2 * u)


def _pink(rng, n, beta=1.0):
    f = np.fft.rfftfreq(n)
    f[0] = f[1]
    s = (rng.normal(size=len(f)) + 1j * rng.normal(size=len(f))) * f ** (-beta / 2)
    s[0] = 0
    x = np.fft.irfft(s, n)
    return x / x.std()


def _busy(p, number=6):
    """Electrodes that move most."""
    return np.argsort(-p.x.std(0))[:number]


def _onset(p, rng, low=0.3, high=0.6):
    """A row, not where a grasp begins."""
    for _ in range(40):
        row = int(p.n * rng.uniform(low, high))
        if all(abs(row - j) > 150 for j in p.joins):
            break
    return row


def _noise_of(x):
    """(19,) counts"""
    d = np.diff(x, axis=0)
    usual = np.sqrt(np.median(d**2, axis=0) / 0.455 / 2)
    return np.maximum(usual, np.sqrt(np.mean(d**2, axis=0) / 2) * 0.4).clip(0.5)


def _span(p, channels):
    """Counts by which a load moves channels."""
    high, low = (np.percentile(p.x[:, channels], q, axis=0) for q in (97, 3))
    return float(np.mean(high - low))


def _share(rng):
    return np.clip(rng.normal(1, 0.2, 19), 0.5, 1.5)


ALL = list(range(19))


# ---------------------------------------------------------------- effects: (piece, rng, form) -> channels


def _gain(p, rng, form):
    n, u = p.n, np.arange(p.n)
    number = {"two electrodes, from the first row": 2, "three electrodes lose it slowly": 3}.get(form, 1)
    c = rng.choice(_busy(p, 7), number, replace=False)
    d, o = p.x[:, c] - p.rest[c], _onset(p, rng, 0.25, 0.5)
    g = rng.choice([rng.uniform(0.4, 0.8), rng.uniform(1.22, 1.8)])
    if form == "sudden":
        w = (u >= o) * 1.0
    elif form == "slow, S-shaped":
        w = _smooth(n, o * 0.5, min(n * 0.95, o + 0.4 * n))
    elif form in ("from the first row", "two electrodes, from the first row"):
        w = np.ones(n)
    elif form == "three electrodes lose it slowly":
        g = rng.uniform(0.35, 0.55)
        w = 1 - np.exp(-np.maximum(u - 0.1 * n, 0) / (n * 0.25))
    elif form == "in three steps":
        w = sum((u >= q) * 1.0 for q in np.sort(rng.uniform(0.2, 0.75, 3)) * n) / 3
    else:  # sags when hot and comes half back
        w = _smooth(n, 0.2 * n, 0.5 * n) - 0.5 * _smooth(n, 0.65 * n, 0.85 * n)
    p.x[:, c] = p.rest[c] + d * (1 + (g - 1) * w)[:, None]
    return c


def _sign(p, rng, form):
    c = rng.choice(_busy(p, 7), 2 if "two" in form else 1, replace=False)
    o, g, u = _onset(p, rng), -1.0, np.arange(p.n)
    if "throughout" in form:
        w = np.ones(p.n, bool)
    elif form == "for a while":
        w = (u >= o) & (u < o + int(0.28 * p.n))
    else:
        w = u >= o
    if form == "reversed and weaker, from a time on":
        g = -rng.uniform(0.5, 0.8)
    p.x[:, c] = np.where(w[:, None], p.rest[c] + g * (p.x[:, c] - p.rest[c]), p.x[:, c])
    return c


def _permutation(p, rng, form):
    x, o = p.x, _onset(p, rng)
    y = x.copy()

    def far():
        for _ in range(200):
            a, b = rng.choice(19, 2, replace=False)
            if abs(np.median(x[:, a] - x[:, b])) > 90 or np.std(x[:, a] - x[:, b]) > 60:
                break
        return [a, b]

    if form.startswith("two"):
        a = far()
        b = a[::-1]
    elif form.startswith("neighbours"):
        k = int(rng.integers(0, 18))
        a, b = [k, k + 1], [k + 1, k]
    elif form.startswith("ring"):
        a = list(rng.choice(_busy(p, 9), 3, replace=False))
        b = a[1:] + a[:1]
    elif form.startswith("a plug"):
        k = int(rng.integers(0, 14))
        a = list(range(k, k + 5))
        b = a[::-1]
    else:
        a, b = ALL, [18, *range(18)]
    if "throughout" in form:
        o = 0
    y[o:, a] = x[o:][:, b]
    p.x[:] = y
    return [i for i, j in zip(a, b) if i != j]


def _height(p, rng, channels, times=1.0):
    noise = 9 * np.mean(_noise_of(p.x)[channels])
    least = max(_span(p, channels) * 0.22, noise, 8.0)
    return rng.choice([-1, 1]) * least * rng.uniform(0.8, 1.8) * rng.choice([0.5, 0.8, 1.2]) * times


def _offset(p, rng, form):
    n, u, o = p.n, np.arange(p.n), _onset(p, rng, 0.2, 0.7)
    number = {"three electrodes, each its own": 3, "two alike": 2}.get(form, 1)
    c = rng.choice(19, number, replace=False)
    late = (u - o).clip(0)
    w = (u >= o) * 1.0
    if form == "jump that rings and settles":
        w = w * (1 + 0.5 * np.exp(-late / 25.0) * np.cos((u - o) / 6.0))
    elif form == "jumps up and later back":
        w = w * (u < min(o + 0.3 * n, 0.92 * n))
    elif form == "two jumps one way":
        w = 0.5 * w + (u >= o + 0.2 * n) * 0.5
    z = np.array([_height(p, rng, [k]) for k in c])
    if form == "two alike":
        z[:] = z[0]
    p.x[:, c] += w[:, None] * z
    return c


def _drift(p, rng, form):
    n = p.n
    u = np.arange(n) / n
    number = {"three electrodes, linear, each its own": 3, "saturating, two electrodes": 2}.get(form, 1)
    c = rng.choice(19, number, replace=False)
    if form == "random walk":
        w = np.cumsum(rng.normal(size=n))
        w = _lag(w - w[0], n * 0.01)
        w = w / np.ptp(w)
    elif form.startswith("saturating"):
        w = 1 - np.exp(-u / 0.2)
    elif form == "starts in the middle, ramp":
        a = rng.uniform(0.35, 0.5)
        w = np.clip(u - a, 0, None) / (1 - a)
    elif form == "wanders up and down":
        w = 0.5 * np.sin(2 * np.pi * (u * rng.uniform(1.1, 1.7) + rng.uniform()))
        w = w + 0.18 * np.sin(2 * np.pi * (u * rng.uniform(2.2, 3.3) + rng.uniform()))
        w = w - w[0]
    elif form == "accelerates":
        w = (np.exp(3 * u) - 1) / (np.exp(3) - 1)
    elif form == "drifts off and comes back":
        a = rng.uniform(0.25, 0.35)
        w = _smooth(n, a * n, (a + 0.25) * n) * np.exp(-np.clip(u - a - 0.3, 0, None) / 0.18)
    else:
        w = u.copy()
    z = np.array([_height(p, rng, [k], 1.25) for k in c])
    p.x[:, c] += w[:, None] * z
    return c


def _warm_up(p, rng, form):
    n = p.n
    u, a = np.arange(n) / n, rng.uniform(0.25, 0.45)
    size = rng.uniform(60, 200) if p.rate == _EPFL else rng.uniform(20, 80)
    if p.base == "U":
        size = rng.uniform(110, 180)
    if form == "exponential":
        w = 1 - np.exp(-u / a)
    elif form == "two time constants":
        w = 0.45 * (1 - np.exp(-u / 0.06)) + 0.55 * (1 - np.exp(-u / 0.6))
    elif form == "with a first plateau, then rising and levelling":
        w = _smooth(n, 0.1 * n, 0.9 * n)
    elif form == "heat arrives in the middle (lamp switched on)":
        w = np.where(u > 0.35, 1 - np.exp(-(u - 0.35) / 0.25), 0)
    else:  # nearly linear, slight bend
        w = u - 0.25 * u * u
    w = w / w.max()
    p.x += size * np.outer(w, _share(rng))
    if p.tdc is not None:  # in these logs TDC falls on cold steel: warmer is more
        p.tdc = p.tdc + size * rng.uniform(0.35, 0.6) * _lag(w, 0.02 * n)
    return ALL


def _temperature(p, rng, form):
    n = p.n
    u = np.arange(n)
    swing = {
        "hand-warm object, all": 45,
        "air conditioning cycles, all": 30,
        "a few electrodes follow, cycles": 30,
        "cold draught, lagging": 40,
    }.get(form, 0) * rng.uniform(0.8, 1.3)
    w = np.zeros(n)
    if form == "hand-warm object, all":
        w = _smooth(n, 0.3 * n, 0.45 * n) * np.exp(-np.clip(u - 0.5 * n, 0, None) / (0.35 * n))
    elif "cycles" in form:
        w = _lag(sawtooth(2 * np.pi * u / (n * rng.uniform(0.28, 0.4)), 0.35) * 0.5, n * 0.02)
        w = w - w[0]
    elif form == "cold draught, lagging":
        w = 0.8 * _smooth(n, 0.6 * n, 0.85 * n) - _smooth(n, 0.25 * n, 0.4 * n)
    p.tdc = p.tdc + swing * w
    q = _lag(p.tdc, 5 * p.rate * 0.3) - p.tdc[0]
    if "lagging" in form:
        q = _lag(q, 2.5 * p.rate)
    k = rng.uniform(0.6, 1.7) * (1.6 if not swing else 1)
    if "a few" in form:
        c, share = rng.choice(19, 5, replace=False), np.zeros(19)
        share[c] = rng.uniform(0.8, 1.3, 5) * 1.3
    else:
        c, share = ALL, _share(rng)
    p.x += k * np.outer(q, share)
    return c


def _fluid_loss(p, rng, form):
    n = p.n
    u = np.arange(n) / n
    size = rng.uniform(70, 220) if p.rate == _EPFL else rng.uniform(25, 90)
    if p.base == "U":
        size = rng.uniform(150, 300)
    if form == "steady":
        w = u.copy()
    elif form == "faster and faster":
        w = u**2.2
    elif form == "leaks only while pressed":
        d = np.sqrt(np.mean(p.load**2, axis=1))
        w = np.cumsum(np.clip(_lag(d, 20) - np.percentile(d, 15), 0, None))
        w = w / w[-1]
    elif form == "begins in the middle":
        w = np.clip(u - 0.4, 0, None) / 0.6
    else:  # fast at first, then ever slower
        w = np.log1p(12 * u) / np.log(13)
    share = np.array([9, 9, 9, 8, 8, 9, 13, 14, 14, 14, 9, 9, 9, 8, 8, 9, 12, 10, 9]) / 10
    share = np.clip(share * rng.normal(1, 0.12, 19), 0.4, None)
    # a thinner film: fewer counts, more sensitive
    p.x[:] = p.rest + p.load * (1 + 0.15 * w[:, None]) - size * np.outer(w, share)
    return ALL


def _relaxation(p, rng, form):
    a, rows, c, d = rng.uniform(0.3, 0.5), rng.uniform(1.2, 4) * p.rate, ALL, p.load
    if p.base == "btd":
        rows *= 0.35
    if form == "creep, one time constant":
        y = (1 - a) * d + a * _lag(d, rows)
    elif form == "creep, spread of time constants":
        y = (1 - a) * d + a * (_lag(d, rows * 0.15) + _lag(d, rows * 0.6) + _lag(d, rows * 2.4)) / 3
    elif form == "overshoot that relaxes":
        y = d + a * (d - _lag(d, rows))
    elif form == "recovers slowly after release only":
        k, y, q = np.exp(-1 / rows), d.copy(), d[0].copy()
        for i, now in enumerate(d):
            q = np.where(np.abs(now) > np.abs(q), now, now + (q - now) * k)
            y[i] = now + a * 1.2 * (q - now)
    else:  # creep of the tip and the middle only
        c, y, a = np.array([6, 7, 8, 9, 16, 17, 18]), d.copy(), min(a + 0.12, 0.6)
        y[:, c] = (1 - a) * d[:, c] + a * _lag(d[:, c], rows)
    p.x[:] = p.rest + y
    return c


def _play(d, width):
    y, q = np.empty_like(d), d[0].copy()
    for i, now in enumerate(d):
        q = np.minimum(np.maximum(q, now - width), now + width)
        y[i] = q
    return y


def _hysteresis(p, rng, form):
    d, c = p.load, ALL
    height, h = np.percentile(np.abs(d), 97, axis=0), rng.uniform(0.08, 0.19)
    width = np.maximum(h * height, 0)
    slow = _lag(d, 4)
    fine = d - slow  # the electronics' noise does not go through the rubber
    if form == "play":
        y = _play(slow, width) + fine
    elif form == "sum of plays":
        y = 0.4 * slow + 0.25 * _play(slow, 0.7 * width) + fine
        y = y + 0.2 * _play(slow, 1.6 * width) + 0.15 * _play(slow, 2.6 * width)
    elif form == "branch follows the force":
        f = _lag(np.linalg.norm(p.force, axis=1), 10)
        df, branch = np.diff(f, prepend=f[0]), np.zeros(len(f))
        turn = 0.25 * np.ptp(np.percentile(f, [3, 97]))
        for i in range(1, len(f)):
            way = min(abs(df[i]) / turn, 1)
            branch[i] = branch[i - 1] + (np.sign(df[i]) - branch[i - 1]) * way
        y = d * (1 - h * 1.4 * branch[:, None])
    elif form == "only the side electrodes, play":
        c, y = np.array([0, 1, 2, 3, 4, 5, 10, 11, 12, 13, 14, 15]), d.copy()
        y[:, c] = _play(slow[:, c], h * 1.4 * height[c]) + fine[:, c]
    else:  # unloading lags, loading does not
        q = _play(slow, 1.5 * width)
        y = d + np.where(np.abs(q) > np.abs(slow), q - slow, 0)
    p.x[:] = p.rest + y
    return c


def _latency(p, rng, form):
    n, c, u = p.n, ALL, np.arange(p.n)
    k = int(rng.integers(6, 22))
    if form == "queue fills up: growing":
        late = (int(rng.integers(20, 45)) * u / n).astype(int)
    elif form == "from a time on":
        late = np.where(u >= _onset(p, rng, 0.25, 0.4), k, 0)
    elif form == "jittering":
        k = int(rng.integers(10, 24))
        wander = np.interp(u, u[::60], _pink(rng, len(u[::60]), 1.0))
        late = np.round(k * (1 + 0.4 * wander.clip(-1.5, 1.5))).astype(int)
    elif form == "second half of the electrodes late":
        c, late = np.arange(10, 19), np.full(n, int(rng.integers(14, 30)))
    else:
        late = np.full(n, k)
    p.x[:, c] = p.x[np.maximum.accumulate(np.maximum(u - late, 0))][:, c]
    return c


def _low_pass(p, rng, form):
    x, c, rate = p.x, ALL, p.rate
    f = rng.uniform(0.5, 2.5)
    if form == "one electrode, capacitor":
        c = rng.choice(_busy(p, 8), 1)
        f = rng.uniform(0.4, 1.5)
        x[:, c] = _lag(x[:, c], rate / (2 * np.pi * f))
    elif form == "all, one pole":
        x[:] = _lag(x, rate / (2 * np.pi * f))
    elif form == "all, moving average in the driver":
        k = int(rng.integers(15, 45))
        x[:] = lfilter(np.ones(k) / k, 1, x - x[0], axis=0) + x[0]
    elif form == "all, second order, switched on later":
        o = _onset(p, rng, 0.25, 0.45)
        x[o:] = sosfilt(butter(2, f * 1.5, fs=rate, output="sos"), x[o:] - x[o], axis=0) + x[o]
    else:  # four electrodes, one pole
        k = int(rng.integers(0, 16))
        c = np.arange(k, k + 4)
        x[:, c] = _lag(x[:, c], rate / (2 * np.pi * f))
    return c


def _noise(p, rng, form):
    n, noise = p.n, _noise_of(p.x)
    f = rng.uniform(1.9, 4.5)
    number = 1 if form.startswith("one") else 3
    c = np.array(ALL) if form.startswith("all") else rng.choice(19, number, replace=False)
    wave, w = rng.normal(size=(n, len(c))), np.ones(n)
    if "from a time on" in form:
        w = (np.arange(n) >= _onset(p, rng)) * 1.0
    if "pink" in form:
        wave = np.stack([0.5 * _pink(rng, n, 1.0) + 0.85 * rng.normal(size=n) for _ in c], 1)
    if "bursts" in form:
        w = _lag(rng.normal(size=n), 80)
        w = (w > np.quantile(w, 0.6)) * 1.0
        f *= 1.4
    if "growing" in form:
        w = 0.15 + 0.85 * np.linspace(0, 1, n) ** 1.5
        f *= 1.6
    if "heavy tails" in form:
        wave = rng.standard_t(2.5, size=(n, len(c))).clip(-8, 8) / 1.6
    p.x[:, c] += wave * w[:, None] * f * np.maximum(noise[c], 1.6)
    return c


def _line_noise(p, rng, form):
    n, c = p.n, np.array(ALL)
    t = p.time - p.time[0]
    size = rng.uniform(1.2, 3.2) * max(np.median(_noise_of(p.x)), 1.6)
    f = rng.choice([50.0, 60.0]) + rng.normal(0, 0.06)
    w, share, third = np.ones(n), rng.uniform(0.5, 1.4, 19), 0.0
    if form == "one electrode (broken shield)":
        c = rng.choice(19, 1)
        size *= 1.7
    elif form == "all, with third harmonic":
        third = 0.45
    elif form == "all, from a time on":
        w = (np.arange(n) >= _onset(p, rng)) * 1.0
    elif form == "all, breathing slowly":
        w = 0.6 + 0.4 * np.sin(2 * np.pi * t / rng.uniform(4, 9))
    elif form == "a group, rectified (100/120 Hz)":
        k = int(rng.integers(0, 13))
        c, f = np.arange(k, k + 7), f * 2
    else:
        f = rng.uniform(12, 38)
    y = np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) + third * np.sin(6 * np.pi * f * t + 1)
    p.x[:, c] += size * np.outer(y * w, share[c])
    return c


def _cross_talk(p, rng, form):
    x, d, busy = p.x, p.load, _busy(p, 9)
    before = [k for k in busy if k < 18]
    k, a = int(rng.choice(before[:6])), rng.uniform(0.22, 0.45)
    c = [k + 1]
    if form == "one takes from the one before":
        x[:, k + 1] += a * d[:, k]
    elif form == "one takes from the one before, from a time on":
        o = _onset(p, rng, 0.25, 0.5)
        x[o:, k + 1] += a * d[o:, k]
    elif form == "whole chain, charge left over":
        a = rng.uniform(0.1, 0.22)
        x[:], c = (1 - a) * x + a * np.roll(x, 1, axis=1), ALL
    elif form == "grows slowly":
        x[:, k + 1] += a * 1.3 * d[:, k] * np.linspace(0, 1, p.n)
    elif form == "two take from the one before":
        other = int(rng.choice([q for q in before if abs(q - k) > 1]))
        c = [k + 1, other + 1]
        for i in c:
            x[:, i] += a * d[:, i - 1]
    else:  # one takes from the one after
        k = int(rng.choice([q for q in busy if q > 0][:6]))
        c = [k - 1]
        x[:, k - 1] += a * d[:, k]
    return c


def _quantisation(p, rng, form):
    x, c, o = p.x, ALL, 0
    read = np.round(x).clip(0, 4095).astype(int)
    bits = 4 if p.rate == _EPFL else 2
    if form == "lowest bits zero":
        k = bits + int(rng.integers(0, 2))
        y = (read >> k) << k
    elif form == "rounded to a step":
        q = int(rng.choice([10, 20, 25])) if bits == 4 else int(rng.choice([5, 10]))
        y = np.round(read / q) * q
    elif form == "one electrode, lowest bits zero":
        c, k = rng.choice(_busy(p, 9), 1), bits + 1
        y = (read >> k) << k
    elif form == "from a time on, lowest bits one":
        o, y = _onset(p, rng), read | (2 ** (bits + 1) - 1)
    else:  # eight bits, scaled up
        q = 16 if bits == 4 else 8
        y = (read // q) * q + q // 2
    x[o:, c] = y[o:, c]
    p.late = True
    return c


def _saturation(p, rng, form):
    x, o = p.x, 0
    c = rng.choice(_busy(p, 7), 2 if "two" in form else 1, replace=False)
    if form.startswith("all"):
        lower = "lower" in form
        ends = x.min(1) if lower else x.max(1)
        limit = float(np.round(np.percentile(ends, rng.uniform(*((10, 18) if lower else (60, 80))))))
        x[:] = np.maximum(x, limit) if lower else np.minimum(x, limit)
        c = np.where(((p.first < limit) if lower else (p.first > limit)).mean(0) > 0.002)[0]
    for k in [] if form.startswith("all") else c:
        y = x[:, k]
        up = np.percentile(y, 98) - np.median(y) > np.median(y) - np.percentile(y, 2)
        if form.startswith("4095"):
            x[:, k] = np.minimum(y + 4095 - np.percentile(y, rng.uniform(75, 88)), 4095)
            continue
        q = rng.uniform(9, 18)
        limit = np.round(np.percentile(y, 100 - q if up else q))
        side = np.minimum if up else np.maximum
        if "soft" in form:
            knee = 0.25 * np.ptp(np.percentile(y, [2, 98]))
            z = (y - limit) if up else (limit - y)
            z = np.where(z > -knee, -knee + knee * np.tanh((z + knee) / knee), z)
            x[:, k] = limit + z if up else limit - z
        else:
            o = int(0.3 * p.n) if "from a time on" in form else 0
            x[o:, k] = side(y[o:], limit)
        if "noisy" in form:
            hit = x[:, k] == limit
            x[hit, k] += rng.integers(-1, 2, hit.sum())
    p.late = "noisy" not in form
    return c


def _stuck(p, rng, form):
    x, n = p.x, p.n
    o, e = (0 if "throughout" in form else _onset(p, rng, 0.2, 0.6)), n
    until = o + int(0.3 * n) if "for a while" in form else n
    values = np.array([len(np.unique(x[o:until, k])) for k in ALL])
    lively = np.where(values >= min(6, np.sort(values)[-4]))[0]
    c = rng.choice(lively, 2 if "two" in form else 1, replace=False)
    if "for a while" in form:
        e = o + int(0.3 * n)
    for k in c:
        value = 4095 if "upper rail" in form else 0 if "lower rail" in form else x[o, k]
        if "odd value" in form:
            value = rng.choice([512, 1023, 2048, 2730])
        x[o:e, k] = value
        if "flickers" in form:
            x[o:e, k] += rng.choice([0, 0, 0, 1, -1], e - o)
    p.late = "flickers" not in form
    return c


def _spikes(p, rng, form):
    x, n, noise, one = p.x, p.n, _noise_of(p.x), "one" in form
    c = rng.choice(19, 1) if one else np.arange(19)
    number = max(5, int(n * rng.uniform(0.0015, 0.006)))
    rows = np.sort(rng.choice(np.where(~p.held[2:-2])[0] + 2, number, replace=False))
    size = max(14 * np.median(noise), 25) * rng.uniform(1, 3)
    if "clusters" in form:
        centre = rng.integers(50, n - 50, max(3, number // 5))
        rows = np.unique((centre[:, None] + rng.integers(0, 40, (len(centre), 5))).ravel())
    for i in rows:
        if form == "whole row zero":
            x[i] = 0
        elif form == "whole row off":
            way = rng.choice([-1, 1]) * size * rng.uniform(0.8, 1.6) * rng.uniform(0.7, 1.3, 19)
            x[i] = np.clip(x[i] + way, 0, 4095)
        elif "bit flip" in form:
            j = int(rng.integers(19))
            x[i, j] = int(x[i, j]) ^ int(rng.choice([256, 512, 1024, 2048]))
        elif "exponential" in form:
            x[i, c] += size * (0.4 + rng.exponential(1.2))
        elif "any electrode" in form or "clusters" in form:
            x[i, int(rng.integers(19))] += rng.choice([-1, 1]) * size * rng.uniform(0.8, 2)
        else:
            x[i, c] += rng.choice([-1, 1]) * size * rng.uniform(0.8, 2)
    p.late = True
    return c


def _lost(p, rng, form):
    n = p.n
    keep = np.ones(n, bool)
    if form == "short random gaps":
        for i in rng.integers(20, n - 20, max(6, n // 250)):
            keep[i : i + int(rng.integers(2, 9))] = False
    elif form == "every so many rows one block (buffer overrun)":
        period, block = int(rng.integers(128, 400)), int(rng.integers(4, 16))
        keep[(np.arange(n) % period) >= period - block] = False
    elif form == "few long gaps":
        for i in rng.integers(int(0.1 * n), int(0.85 * n), 3):
            keep[i : i + int(rng.integers(60, 180))] = False
    elif form == "losses pile up towards the end (full disk)":
        for q in rng.beta(4, 1.4, max(8, n // 150)):
            i = int(q * (n - 30)) + 1
            keep[i : i + int(rng.integers(3, 14))] = False
    else:  # gaps that the time column hides
        move = np.abs(np.diff(_lag(p.x, 5), axis=0)).sum(1)
        for i in rng.choice(np.argsort(-move)[: n // 25], 10):
            keep[max(1, i - int(rng.integers(10, 25))) : i + int(rng.integers(15, 40))] = False
    for name in ("x", "tdc", "force", "held"):
        if getattr(p, name) is not None:
            setattr(p, name, getattr(p, name)[keep])
    p.time = p.time[: p.n] if "hides" in form else p.time[keep]
    p.gaps = np.flatnonzero(np.diff(np.flatnonzero(keep)) > 1) + 1
    p.late = True
    return ALL


def _held(p, rng, form):
    n, i = p.n, np.arange(p.n)
    if form == "each row held three or four times":
        q = int(rng.integers(3, 5))
        i = i // q * q
    elif form == "random stalls":
        for a in rng.integers(20, n - 60, max(8, n // 160)):
            i[a : a + int(rng.integers(12, 45))] = a
    elif form == "bus slows from a time on":
        q, o = int(rng.integers(3, 6)), _onset(p, rng)
        i[o:] = o + (i[o:] - o) // q * q
    elif form == "stalls grow (logger overloaded)":
        a = int(0.1 * n)
        while a < n - 5:
            length = int(4 + 36 * (a / n) ** 2 * rng.uniform(0.6, 1.4))
            i[a : a + length] = a
            a += length + int(rng.integers(8, 40))
    else:  # few long freezes
        for a in rng.integers(int(0.1 * n), int(0.8 * n), 5):
            i[a : a + int(rng.integers(70, 200))] = a
    i = np.minimum(i, n - 1)
    p.x = p.x[i]
    if p.tdc is not None:
        p.tdc = p.tdc[i]
    p.late = True  # force comes from another instrument and runs on
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


# ---------------------------------------------------------------- outside the catalogue: (piece, rng)


def _large(p, share, electrodes, times, least=None):
    """Counts: a share of what a load moves the busiest electrodes by, or so many times their noise."""
    noise = np.median(_noise_of(p.x))
    return max(share * _span(p, _busy(p, electrodes)), times * noise)


def _bubble(p, rng):
    n, ring = p.n, [6, 7, 9, 16, 17, 18, 12, 2]
    size = _large(p, 0.3, 8, 12) * rng.uniform(0.8, 1.3)
    steps = np.cumsum(rng.choice([0, 1, 1, 2, -1], 9)).astype(float) + rng.uniform(0, 7)
    place = np.interp(np.arange(n), np.linspace(0, n, 9), steps)
    for j, k in enumerate(ring):
        away = np.abs((place - j + 4) % 8 - 4)
        p.x[:, k] -= size * np.exp(-0.5 * (away / 0.6) ** 2)


def _contact(p, rng):
    k = int(rng.choice(_busy(p, 8)))
    wave, i = np.zeros(p.n), int(0.2 * p.n)
    size = max(0.6 * _span(p, [k]), 15 * _noise_of(p.x)[k]) * rng.choice([-1, 1])
    while i < p.n:
        length = int(rng.exponential(9)) + 1
        wave[i : i + length] = rng.uniform(0.6, 1.3)
        i += length + int(rng.exponential(45)) + 1
    p.x[:, k] += size * wave


def _knock(p, rng):
    u, rate = np.arange(p.n), p.rate
    size, share = _large(p, 0.35, 10, 16), rng.normal(0, 0.9, 19)
    f = rng.uniform(4, 9)
    for q in rng.uniform(0.1, 0.9, 6) * p.n:
        ring = (u >= q) * np.exp(-(u - q).clip(0) / (0.35 * rate)) * np.sin(2 * np.pi * f * (u - q) / rate)
        p.x += size * rng.uniform(0.6, 1.2) * np.outer(ring, share)


def _modulated(p, rng):
    f, depth = rng.uniform(0.25, 0.9), rng.uniform(0.22, 0.38)
    wave = 1 + depth * np.sin(2 * np.pi * f * (p.time - p.time[0]))
    p.x[:] = p.rest + p.load * wave[:, None]


def _halves(p, rng):
    i = np.roll(np.arange(p.n), -(p.n // 2))
    for name in ("x", "tdc", "force", "held"):
        if getattr(p, name) is not None:
            setattr(p, name, getattr(p, name)[i])


def _bursts(p, rng):
    u, t = np.arange(p.n), p.time - p.time[0]
    size, share = rng.uniform(5, 9) * np.median(_noise_of(p.x)).clip(1.5), rng.uniform(0.2, 1.4, 19)
    for q in rng.uniform(0.05, 0.92, 9) * p.n:
        length = rng.uniform(60, 200)
        chirp = np.sin(2 * np.pi * (217.0 * t + rng.uniform(0.5, 6) * (t - q / p.rate) ** 2))
        p.x += size * np.outer(((u > q) & (u < q + length)) * chirp, share)


def _rub(p, rng):
    wave = sosfilt(butter(2, [6, 22], "band", fs=p.rate, output="sos"), rng.normal(size=p.n))
    wave, share = wave / wave.std(), np.abs(rng.normal(0.3, 0.8, 19))
    episodes = _lag(np.clip(_pink(rng, p.n, 1.8), 0, None), 20)
    size = rng.uniform(4, 7) * np.median(_noise_of(p.x)).clip(1.5)
    p.x += size * np.outer(wave * episodes, share)


def _backwards(p, rng):
    a, b = int(p.n * 0.3), int(p.n * 0.75)
    p.x[a:b] = p.x[a:b][::-1].copy()


def _dead_zone(p, rng):
    d = p.load
    w = np.percentile(np.abs(d), 55, axis=0) * rng.uniform(0.7, 1.0)
    p.x[:] = p.rest + np.sign(d) * np.clip(np.abs(d) - w, 0, None) + np.round(0.15 * d) * (np.abs(d) < w)


def _pulse(p, rng):
    t = p.time - p.time[0]
    f = rng.uniform(1.0, 1.5)
    phase = 2 * np.pi * (f * t + 0.04 * np.cumsum(rng.normal(size=len(t))) / np.sqrt(100))
    size = rng.uniform(3, 5) * np.median(_noise_of(p.x)).clip(1.2)
    beat = np.exp(3.5 * (np.cos(phase) - 1)) + 0.35 * np.exp(5 * (np.cos(phase - 1.9) - 1))
    p.x += size * np.outer(beat, np.clip(rng.normal(1, 0.5, 19), 0.1, None))


def _sags(p, rng):
    u, size = np.arange(p.n), _large(p, 0.3, 10, 25)
    for q in rng.uniform(0.08, 0.9, 5) * p.n:
        high = size * rng.uniform(0.6, 1.4)
        sag = (u >= q) * np.exp(-(u - q).clip(0) / rng.uniform(25, 90))
        p.x -= high * np.outer(sag, rng.normal(1, 0.1, 19))


def _echo(p, rng):
    k, a, d = int(rng.integers(90, 200)), rng.uniform(0.35, 0.55), p.load
    p.x[k:] = p.rest + (d[k:] + a * d[:-k])


def _parallel(p, rng):
    busy = _busy(p, 8)
    for _ in range(50):
        i, j = rng.choice(busy, 2, replace=False)
        if abs(i - j) > 2:
            break
    mean = (p.x[:, i] + p.x[:, j]) / 2
    o = int(p.n * rng.uniform(0.2, 0.45))
    p.x[o:, [i, j]] = mean[o:, None]


def _replay(p, rng):
    n = p.n
    length, a = int(0.18 * n), int(0.15 * n)
    for b in (0.4, 0.7):
        p.x[int(b * n) : int(b * n) + length] = p.x[a : a + length]
    p.late = True


def _wraps(p, rng):
    o = int(p.n * 0.2)
    for k in _busy(p, 5)[:3]:
        limit = np.percentile(p.x[:, k], rng.uniform(80, 92))
        p.x[o:, k] = np.where(p.x[o:, k] > limit, p.x[o:, k] - 256, p.x[o:, k])
    p.late = True


def _sweep(p, rng):
    t = p.time - p.time[0]
    high = rng.uniform(18, 32)
    wave = np.sin(2 * np.pi * (0.8 * t + (high - 0.8) * t * t / (2 * t[-1])))
    size = rng.uniform(3, 5) * np.median(_noise_of(p.x)).clip(1.5)
    p.x += size * np.outer(wave, rng.uniform(0.2, 1.6, 19))


def _stick_slip(p, rng):
    n, c = p.n, rng.choice(19, 8, replace=False)
    phase = np.cumsum(rng.uniform(0.6, 1.5, n) * rng.uniform(1.2, 2.5) / p.rate)
    stretch = _smooth(n, 0.15 * n, 0.25 * n) * (1 - _smooth(n, 0.7 * n, 0.8 * n))
    size = max(0.2 * _span(p, c), 12 * np.median(_noise_of(p.x)))
    p.x[:, c] += size * np.outer(((phase % 1) - 0.5) * stretch, rng.normal(0, 1, 8))


def _automatic_gain(p, rng):
    d = p.load
    size = np.sqrt((d**2).mean(1))
    g = np.median(size) / _lag(size, 1.2 * p.rate).clip(np.median(size) * 0.2)
    p.x[:] = p.rest + d * g[:, None].clip(0.3, 2.5)


def _clock_jumps(p, rng):
    p.time = p.time.copy()
    p.time[int(p.n * rng.uniform(0.3, 0.7)) :] += 3600.0


def _clock_set_back(p, rng):
    p.time = p.time.copy()
    p.time[int(p.n * rng.uniform(0.3, 0.7)) :] -= rng.uniform(2, 6)


def _warped(p, rng):
    n = p.n
    i = np.cumsum(1 + 0.75 * np.sin(2 * np.pi * np.arange(n) / n * rng.uniform(4, 7)))
    i = np.round(i / i[-1] * (n - 1)).astype(int)
    p.x = p.x[i]
    if p.tdc is not None:
        p.tdc = p.tdc[i]
    p.late = True


def _excitation(p, rng):
    wave = _pink(rng, p.n, 1.3)
    p.x *= (1 + rng.uniform(0.007, 0.012) * wave)[:, None]


def _shorted(p, rng):
    on = _lag(rng.normal(size=p.n), 40)
    on = on > np.quantile(on, 0.8)
    mean = p.x.mean(1)
    p.x[on] = 0.55 * p.x[on] + 0.45 * mean[on][:, None]


OUTSIDE = {
    "bubble": _bubble,
    "contact": _contact,
    "knock": _knock,
    "am": _modulated,
    "swap": _halves,
    "bursts": _bursts,
    "rub": _rub,
    "reverse": _backwards,
    "dead": _dead_zone,
    "pulse": _pulse,
    "brown": _sags,
    "echo": _echo,
    "par": _parallel,
    "replay": _replay,
    "wrap": _wraps,
    "sweep": _sweep,
    "stick": _stick_slip,
    "agc": _automatic_gain,
    "clk": _clock_jumps,
    "clk2": _clock_set_back,
    "warp": _warped,
    "exc": _excitation,
    "steal": _shorted,
}


# ---------------------------------------------------------------- the plan; a base with f has its force

_SINGLES = {
    "gain": [
        ("sudden", "F1"),
        ("slow, S-shaped", "F2"),
        ("from the first row", "F1f"),
        ("two electrodes, from the first row", "F2f"),
        ("three electrodes lose it slowly", "F1f"),
        ("in three steps", "F2f"),
        ("sags when hot and comes half back", "btd"),
    ],
    "sign": [
        ("throughout", "F1"),
        ("from a time on", "F2f"),
        ("for a while", "F1f"),
        ("reversed and weaker, from a time on", "F2"),
        ("two, throughout", "F2f"),
        ("from a time on", "btd"),
    ],
    "permutation": [
        ("two, throughout", "F1"),
        ("two, from a time on", "F2"),
        ("neighbours, from a time on", "phacF0"),
        ("ring of three, from a time on", "F1f"),
        ("a plug of five turned round, throughout", "F2f"),
        ("all shifted by one, from a time on", "U"),
    ],
    "offset": [
        ("one jump", "F1"),
        ("jump that rings and settles", "F2f"),
        ("jumps up and later back", "U"),
        ("two jumps one way", "phacF1"),
        ("three electrodes, each its own", "F1f"),
        ("two alike", "phacF0"),
    ],
    "drift": [
        ("random walk", "U"),
        ("saturating", "F1f"),
        ("starts in the middle, ramp", "F2"),
        ("wanders up and down", "phacF0"),
        ("accelerates", "F2f"),
        ("drifts off and comes back", "U"),
        ("saturating, two electrodes", "btd"),
        ("three electrodes, linear, each its own", "phacF1"),
    ],
    "warm_up": [
        ("exponential", "F1"),
        ("two time constants", "F2f"),
        ("with a first plateau, then rising and levelling", "phacF0"),
        ("heat arrives in the middle (lamp switched on)", "phacF1"),
        ("nearly linear, slight bend", "F2"),
        ("exponential", "btd"),
    ],
    "temperature": [
        ("as logged, all", "phacF0"),
        ("as logged, lagging by seconds", "phacF1"),
        ("hand-warm object, all", "phacF0"),
        ("air conditioning cycles, all", "phacF1"),
        ("a few electrodes follow, cycles", "phacF0"),
        ("cold draught, lagging", "btd"),
    ],
    "fluid_loss": [
        ("steady", "F1f"),
        ("faster and faster", "F2"),
        ("leaks only while pressed", "F1"),
        ("begins in the middle", "U"),
        ("fast at first, then ever slower", "phacF0"),
        ("leaks only while pressed", "F2f"),
    ],
    "relaxation": [
        ("creep, one time constant", "F1f"),
        ("creep, spread of time constants", "F2f"),
        ("overshoot that relaxes", "F1f"),
        ("recovers slowly after release only", "F2f"),
        ("creep of the tip and the middle only", "F2"),
        ("overshoot that relaxes", "F2"),
    ],
    "hysteresis": [
        ("play", "F1f"),
        ("sum of plays", "F2f"),
        ("branch follows the force", "F1f"),
        ("only the side electrodes, play", "F2f"),
        ("unloading lags, loading does not", "F1f"),
        ("branch follows the force", "F2f"),
    ],
    "latency": [
        ("constant", "F1f"),
        ("queue fills up: growing", "F2f"),
        ("from a time on", "F1f"),
        ("jittering", "F2f"),
        ("second half of the electrodes late", "F1f"),
        ("second half of the electrodes late", "F2"),
    ],
    "low_pass": [
        ("one electrode, capacitor", "F1"),
        ("all, one pole", "F2f"),
        ("all, moving average in the driver", "F1f"),
        ("all, second order, switched on later", "U"),
        ("four electrodes, one pole", "F2"),
    ],
    "noise": [
        ("one, from a time on", "F1"),
        ("all, white", "phacF0"),
        ("one, pink", "U"),
        ("three, in bursts", "F2f"),
        ("all, growing", "F1f"),
        ("one, heavy tails", "phacF1"),
        ("three, from a time on", "btd"),
    ],
    "line_noise": [
        ("one electrode (broken shield)", "F2"),
        ("all, with third harmonic", "phacF1"),
        ("all, from a time on", "F1f"),
        ("all, breathing slowly", "U"),
        ("a group, rectified (100/120 Hz)", "F2f"),
        ("all, motor hum", "phacF0"),
        ("one electrode (broken shield)", "btd"),
    ],
    "cross_talk": [
        ("one takes from the one before", "F1"),
        ("one takes from the one before, from a time on", "F2"),
        ("whole chain, charge left over", "F1f"),
        ("grows slowly", "F2f"),
        ("two take from the one before", "F1"),
        ("one takes from the one after", "F2"),
    ],
    "quantisation": [
        ("lowest bits zero", "F1"),
        ("rounded to a step", "phacF0"),
        ("one electrode, lowest bits zero", "F2f"),
        ("from a time on, lowest bits one", "U"),
        ("eight bits, scaled up", "phacF1"),
    ],
    "saturation": [
        ("one, hard", "F1"),
        ("two, soft", "F2f"),
        ("all at one lower rail", "F1f"),
        ("4095, one set too high", "F2"),
        ("one, from a time on, noisy rail", "F1"),
        ("all at one upper rail", "F2f"),
    ],
    "stuck": [
        ("holds its last value", "F1"),
        ("at the upper rail, throughout", "F2f"),
        ("at the lower rail from a time on", "phacF0"),
        ("flickers by one count", "U"),
        ("two, hold their last values", "F1f"),
        ("holds for a while and comes back, for a while", "phacF1"),
        ("odd value, throughout", "btd"),
    ],
    "spikes": [
        ("one electrode, both ways", "F1"),
        ("any electrode", "F2f"),
        ("bit flip", "U"),
        ("whole row zero", "phacF0"),
        ("whole row off", "F1f"),
        ("clusters", "phacF1"),
        ("one electrode, exponential, one way", "F2"),
    ],
    "lost_samples": [
        ("short random gaps", "F1f"),
        ("every so many rows one block (buffer overrun)", "F2"),
        ("few long gaps", "phacF1"),
        ("losses pile up towards the end (full disk)", "U"),
        ("gaps that the time column hides", "F1f"),
        ("short random gaps", "phacF0"),
    ],
    "held_samples": [
        ("each row held three or four times", "phacF0"),
        ("random stalls", "F1f"),
        ("bus slows from a time on", "U"),
        ("stalls grow (logger overloaded)", "phacF1"),
        ("few long freezes", "F2f"),
    ],
}
_PAIRS = [
    (("gain", "sudden"), ("drift", "saturating"), "F1f"),
    (("offset", "one jump"), ("noise", "all, white"), "phacF0"),
    (("stuck", "holds its last value"), ("spikes", "any electrode"), "F2f"),
    (("line_noise", "all, motor hum"), ("permutation", "two, from a time on"), "F1"),
    (("offset", "three electrodes, each its own"), ("quantisation", "rounded to a step"), "phacF1"),
    (("warm_up", "exponential"), ("stuck", "flickers by one count"), "F2"),
    (("cross_talk", "grows slowly"), ("latency", "constant"), "F1f"),
    (("cross_talk", "whole chain, charge left over"), ("spikes", "any electrode"), "F2"),
    (("drift", "wanders up and down"), ("saturation", "one, hard"), "F1"),
    (("offset", "two jumps one way"), ("low_pass", "all, one pole"), "F2f"),
    (("sign", "from a time on"), ("noise", "one, pink"), "F1f"),
    (("drift", "random walk"), ("held_samples", "random stalls"), "phacF1"),
    (("sign", "for a while"), ("lost_samples", "short random gaps"), "F2f"),
    (("fluid_loss", "steady"), ("noise", "three, in bursts"), "U"),
    (("relaxation", "creep, one time constant"), ("quantisation", "lowest bits zero"), "F1f"),
    (("hysteresis", "play"), ("offset", "one jump"), "F2f"),
    (("temperature", "air conditioning cycles, all"), ("spikes", "one electrode, both ways"), "phacF0"),
    (("warm_up", "two time constants"), ("gain", "sudden"), "F2"),
    (("line_noise", "all, from a time on"), ("stuck", "at the lower rail from a time on"), "U"),
    (("temperature", "hand-warm object, all"), ("line_noise", "all, with third harmonic"), "phacF1"),
    (("permutation", "neighbours, from a time on"), ("drift", "accelerates"), "F1f"),
]
_OUTSIDE = [
    ("bubble", "F1"),
    ("bubble2", "phacF1"),
    ("contact", "F2"),
    ("contact2", "btd"),
    ("knock", "F1"),
    ("knock2", "U"),
    ("am", "F2"),
    ("am2", "F1"),
    ("swap", "U"),
    ("swap2", "F2"),
    ("bursts", "phacF0"),
    ("rub", "F2"),
    ("rub2", "phacF1"),
    ("reverse", "F1f"),
    ("dead", "F1"),
    ("pulse", "U"),
    ("pulse2", "phacF0"),
    ("brown", "F2"),
    ("echo", "F1f"),
    ("par", "F2"),
    ("replay", "F2f"),
    ("wrap", "F1"),
    ("sweep", "U"),
    ("stick", "F2"),
    ("agc", "F1f"),
    ("clk", "F2"),
    ("clk2", "phacF0"),
    ("warp", "F2f"),
    ("exc", "U"),
    ("steal", "F1"),
]
_NONE = ["F1", "F1f"] * 5 + ["F2", "F2f"] * 5 + ["U"] * 8 + ["phacF0"] * 7 + ["phacF1"] * 7 + ["btd"]
_LONG = {("lost_samples", "F2"), ("drift", "F2f"), ("noise", "U")}
_SLOW = {"warm_up", "fluid_loss", "drift", "temperature"}
_LOADED = {
    "gain",
    "sign",
    "cross_talk",
    "relaxation",
    "hysteresis",
    "latency",
    "saturation",
    "low_pass",
}


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base; effects: of (kind, form), the author's names; rows: first and last + 1 of the
    source; draws: how often its generator was asked for rows."""

    name: str
    base: str
    effects: tuple
    group: str
    rows: tuple
    key: str
    draws: int

    @property
    def kinds(self) -> tuple:
        """Of the benchmark's vocabulary."""
        if self.group == "outside":
            return ("outside_loaded",) if self.base[:2] in ("F1", "F2") else ("outside",)
        return tuple(KINDS[kind] for kind, _ in self.effects)


def _jobs():
    out = [("single", ((kind, form),), base) for kind, forms in _SINGLES.items() for form, base in forms]
    out += [("pair", (one, two), base) for one, two, base in _PAIRS]
    out += [("outside", ((name, ""),), base) for name, base in _OUTSIDE]
    return out + [("none", (), base) for base in _NONE]


def _untouched(sources, rng):
    """base -> [(first row, rows)]: pieces without an effect do not overlap."""
    out = {}
    for base, source in sources.items():
        number = sum(q.rstrip("f") == base for q in _NONE)
        if base != "btd":
            share = rng.dirichlet(np.full(number, 0.9)) * (len(source.x) - 1500 * number - 50)
            length = 1500 + np.floor(share).astype(int)
            out[base] = [(int(e - w), int(w)) for e, w in zip(np.cumsum(length), length)]
            rng.shuffle(out[base])
    return out


def _length(rng, group, effects, base, source):
    """Rows of a piece."""
    if source == "btd":
        return int(rng.integers(1500, 2050))
    if source.startswith("phac"):
        return int(rng.integers(1500, 5000))
    if group == "single" and (effects[0][0], base) in _LONG:
        return int(rng.integers(12000, 19500))
    if {kind for kind, _ in effects} & _SLOW and group != "outside":
        return int(rng.integers(4500, 10000)) if group == "single" else int(rng.integers(2500, 6000))
    return int(np.exp(rng.uniform(np.log(1700), np.log(6500 if group == "single" else 3500))))


def _overlap(start, length, others, kinds):
    """How much a piece repeats others (first row, rows after the last, kinds) of its source."""
    total, end = 0.0, start + length
    for first, last, theirs in others:
        both = max(0, min(end, last) - max(start, first))
        union = both / (max(end, last) - min(start, first))
        total += both / min(length, last - first) * (8 if theirs & kinds else 0.12)
        total += 2 * union if union > 0.6 else 0
    return total


@functools.cache
def plan(data: str) -> list[Spec]:
    """224 pieces: singles, pairs, outside the catalogue, untouched. data: folder of the recordings."""
    sources = _sources(pathlib.Path(data))
    jobs, rng = _jobs(), np.random.default_rng(_SEED)
    used, free = {k: [] for k in sources}, _untouched(sources, rng)
    numbers, out = rng.permutation(len(jobs)) + 1, []
    for i, (group, effects, base) in enumerate(jobs):
        key = f"{group}{list(effects)}{base}{i}"
        mine, source = _generator(key), base.removesuffix("f")
        kinds = {kind for kind, _ in effects} if group in ("single", "pair") else {group}
        moves = (bool(kinds & _LOADED) or group == "outside") and source in ("F1", "F2")
        best, draws, x = None, 0, sources[source].x
        if group == "none" and source != "btd":
            best = 0.0, *free[source].pop()
        while best is None or draws and draws < (20 if source == "btd" else 150):
            draws += 1
            length = _length(mine, group, effects, base, source)
            start = int(mine.integers(0, len(x) - length + 1))
            cost = _overlap(start, length, used[source], kinds) - 0.25 * min(length, 5000) / 5000
            if moves:
                halves = x[start : start + length // 2], x[start + length // 2 : start + length]
                cost += 8 * max(0, 1 - min(h.std(0).max() for h in halves) / 130)
            if best is None or cost < best[0]:
                best = cost, start, length
        _, start, length = best
        used[source].append((start, start + length, kinds))
        out.append(Spec(f"{numbers[i]:03d}", base, effects, group, (start, start + length), key, draws))
    return sorted(out, key=lambda s: s.name)


def _generator(key):
    return np.random.default_rng([_SEED, zlib.crc32(key.encode())])


def _hold(p):
    """Rows that the logger held hold what was done to the one before, too."""
    if p.held.any():
        p.x = p.x[np.maximum.accumulate(np.where(p.held, 0, np.arange(p.n)))]


def make(spec: Spec, data: str) -> tuple[dict, np.ndarray]:
    """Fields of the case, its counts as a file has them, and the counts without what is hidden (n, 19), rows
    that are lost later among them."""
    rng, name = _generator(spec.key), spec.base.removesuffix("f")
    source = _sources(pathlib.Path(data))[name]
    for _ in range(spec.draws):  # those of the plan
        length = _length(rng, spec.group, spec.effects, spec.base, name)
        rng.integers(0, len(source.x) - length + 1)
    a, b = spec.rows
    time = np.arange(b - a) / source.rate if source.time is None else source.time[a:b] - source.time[a]
    if rng.uniform() < 0.3:  # a clock that ran before
        time = time + np.round(rng.uniform(5, 900), 3)
    x = source.x[a:b]
    p = _Piece(
        name,
        x.copy(),
        x.copy(),
        time,
        source.rate,
        np.median(x, 0) if source.rest is None else source.rest,
        source.held[a:b].copy(),
        None if source.force is None else source.force[a:b].copy(),
        None if source.tdc is None else source.tdc[a:b].copy(),
        [k - a for k in range(1000, 15000, 1000) if a < k < b] if name.startswith("phac") else [],
    )
    channels = []
    for kind, form in spec.effects:
        p.late = False
        if spec.group == "outside":
            (OUTSIDE.get(kind) or OUTSIDE[kind.removesuffix("2")])(p, rng)
            c = ALL
        else:
            c = LAWS[kind](p, rng, form)
        channels.append(sorted(int(k) for k in c))
        if not p.late:
            _hold(p)
        p.x = np.round(p.x).clip(0, 4095)
        if p.tdc is not None:
            p.tdc = np.round(p.tdc)
    noise, seen = _noise_of(x), []
    if spec.effects and p.x.shape == x.shape:
        seen = [float(np.sqrt(((p.x - x) ** 2).mean(0) / noise**2).max())]
    case = {
        "base": "seventh " + name[:4],
        "counts": p.x,
        "rate": p.rate,
        "force": p.force if spec.base.endswith("f") else None,
        "tdc": p.tdc,
        "loaded": name in ("F1", "F2"),
        "channels": channels,
        "truth": list(spec.kinds),
        "forms": [form or kind for kind, form in spec.effects],
        "seen": seen,
        "gaps": list(p.gaps),
        "time": p.time,
    }
    return case, x.copy()
