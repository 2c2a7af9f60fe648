"""Pieces of recordings of real sensors with one or two hidden effects, by a twelfth author.

    plan() -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own,
each faint, medium or strong. One stream of random numbers made all pieces: the table says how far it was
where the effects of each begin, so that each piece is made alone and is the very one that was judged blind.
The author hides what a sensor does in the log's rows; noise is held where these repeat. Pieces have a clock
of their own, as a file has.
"""

import dataclasses
import functools
import gzip
import pathlib

import numpy as np
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, lfilter, lfilter_zi

from .vocabulary import KINDS

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

_SEED = 120731
_EPFL = 118.0  # [Hz] of the pressed sensors and the neighbour of one
_LEVELS = ("faint", "medium", "strong")
# what a base has by itself: sensors in the hand warm up and are late, a bus slower than the logger holds
# rows, grasps cool a finger, the native log has bursts and single spikes
NATURAL = {
    "twelfth F1": {"warmup", "latency", "freeze"},
    "twelfth F2": {"warmup", "latency", "freeze"},
    "twelfth U": {"warmup", "freeze"},
    "twelfth phac": {"warmup", "thermal", "fluidloss"},
    "twelfth slides": {"warmup", "thermal", "fluidloss", "latency"},
    "twelfth btd": {"lost_rows", "spikes"},
}
ALL = list(range(19))


# ---------------------------------------------------------------- recordings


@dataclasses.dataclass
class _Source:
    """A sensor's whole recording: counts x (n, 19), time (n,) [s], rate [Hz], force (n, 3) [N], tdc (n,),
    rest (19,): what it reads without load, None: its median."""

    x: np.ndarray
    time: np.ndarray
    rate: float
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None
    rest: np.ndarray | None = None

    def __post_init__(self):
        change = np.abs(np.diff(self.x, axis=0))
        new = change.sum(1) > 0
        self.held = np.r_[False, ~new]
        self.noise = np.maximum(np.median(change[new], 0) * 1.05, 0.6)
        if self.rest is None:
            self.rest = np.median(self.x, 0)


@functools.cache
def _source(data, name):
    if name == "btd":
        with gzip.open(data / "btd/btsp_touch.btd.gz", "rt") as file:
            lines = file.read().splitlines()
        begin = next(i for i, line in enumerate(lines) if line.startswith("Begin"))
        log = np.array([w for w in (line.split() for line in lines[begin + 1 :]) if len(w) == 10], float)
        frames = []
        for first in np.flatnonzero(log[:, 3] == 17):
            frame = log[first : first + 44]
            read = {int(row[3]): row[8] for row in frame if row[3] != 0}
            if len(frame) == 44 and len(read) == 22:
                frames.append([frame[0, 0], *(read[k] for k in range(17, 36)), read[3]])
        frames = np.array(frames)
        rest = np.median(frames[:800, 1:20], 0)
        return _Source(frames[:, 1:20], frames[:, 0], 100.0, tdc=frames[:, 20], rest=rest)
    if name.startswith("phac"):
        _, thing, finger = name.split("/")
        mat = loadmat(data / f"phac_hold/{thing}_HOLD.mat")
        x, tdc = mat[f"{finger}Electrodes"].T.astype(float), mat[f"{finger}tdc"].ravel().astype(float)
        return _Source(x, np.arange(len(x)) / 100.0, 100.0, tdc=tdc)
    if name.startswith("slides"):
        log = data / f"slides_20/{name.split('/')[1]}"
        a = np.genfromtxt(f"{log}_bio.csv.gz", delimiter=",", skip_header=1)
        w = np.genfromtxt(f"{log}_cw.csv.gz", delimiter=",", skip_header=1)
        force = np.stack([np.interp(a[:, 0], w[:, 0], w[:, i]) for i in (1, 2, 3)], 1)
        time = a[:, 0] - a[0, 0]
        return _Source(a[:, 26:45], time, 100.0, force, a[:, 1], np.zeros(19))
    electrodes, force = {
        "F1": ("epfl_flat_press/SynImpF1.txt", "epfl_flat_press/ForceData.txt"),
        "F2": ("epfl_f2/SynImpF2.txt.gz", "epfl_f2/ForceData.txt.gz"),
        "U": ("epfl_flat_press/SynImpF2.txt", None),
    }[name]
    x = np.loadtxt(data / electrodes)
    force = None if force is None else np.loadtxt(data / force)
    n = len(x) if force is None else min(len(x), len(force))
    return _Source(x[:n], np.arange(n) / _EPFL, _EPFL, None if force is None else force[:n])


# ---------------------------------------------------------------- a piece


class _Piece:
    """Rows of a source on their way.

    Attributes: x (n, 19) counts; time (n,) [s]; force (n, 3) [N] and tdc (n,) as the file will have them;
    loads (n, 3) [N] force, also where the file has none; rest, noise, std (19,); held: (n,) rows that repeat
    the one before; free: electrodes without an effect; after: what is done to the counts once they are
    rounded; kept: rows that are not lost; seconds (n,) from the first row; source, first: where it was cut.
    """

    def __init__(self, source, first, rows, with_force, level, rng, other=None):
        part = slice(first, first + rows)
        self.source, self.first, self.rng, self.other, self.rate = source, first, rng, other, source.rate
        self.level, self.n = level, len(source.x[part])
        self.x, self.time = source.x[part].copy(), source.time[part].copy()
        self.loads = None if source.force is None else source.force[part]
        self.force = self.loads.copy() if with_force else None
        self.tdc = None if source.tdc is None else source.tdc[part].copy()
        self.rest, self.noise, self.held = source.rest, source.noise, source.held[part]
        self.std, self.free = self.x.std(0), set(ALL)
        self.seconds, self.kept, self.after = np.arange(self.n) / self.rate, np.arange(self.n), []

    def size(self, *values):
        """Of the piece's level, a tenth more or less."""
        return values[self.level] * self.rng.uniform(0.9, 1.1)

    def side(self):
        return float(self.rng.choice([-1, 1]))

    def some(self, number, lively=True):
        """Electrodes that are free yet, lively: of those that move most."""
        pool = sorted(self.free)
        if lively:
            pool = sorted(pool, key=lambda k: -self.std[k])[: max(number + 3, int(len(pool) * 0.6))]
        return self.take(self.rng.choice(pool, number, replace=False))

    def take(self, channels):
        channels = sorted(int(k) for k in channels)
        self.free -= set(channels)
        return channels

    def row(self, low=0.25, high=0.65):
        return int(self.rng.uniform(low, high) * self.n)

    def walk(self):
        x = np.cumsum(self.rng.standard_normal(self.n))
        x -= x[0]
        return x / np.abs(x).max()

    def slow(self, rows):
        """(n,) noise of spread one that is alike for so many rows."""
        a, more = np.exp(-1 / rows), int(4 * rows)
        x = self.rng.standard_normal(self.n + more)
        return lfilter([np.sqrt(1 - a * a)], [1, -a], x)[more:]

    def holding(self, x):
        """x as the log repeats it."""
        i = np.where(self.held, 0, np.arange(self.n))
        return x[np.maximum.accumulate(i)]

    def earlier(self, rows):
        """Counts of the source some rows before, (n, 19)."""
        i = np.clip(self.first + np.arange(self.n) - rows, 0, len(self.source.x) - 1)
        return self.source.x[i.astype(int)]

    def amplify(self, channels, factor):
        rest = self.rest[channels]
        self.x[:, channels] = rest + (self.x[:, channels] - rest) * factor


def _lag(x, seconds, rate):
    a = np.exp(-1 / (seconds * rate))
    return lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]


def _play(x, width):
    y = np.empty_like(x)
    y[0] = x[0]
    for i in range(1, len(x)):
        y[i] = np.minimum(np.maximum(y[i - 1], x[i] - width), x[i] + width)
    return y


# ---------------------------------------------------------------- effects: (piece, form) -> channels


def _factor(p, less=None):
    less = p.rng.random() < 0.5 if less is None else less
    return p.size(0.75, 0.55, 0.3) if less else p.size(1.35, 1.6, 2.0)


def _gain(p, form):
    w = np.ones((p.n, 1))
    if form == "first":
        c = p.some(1)
        w = _factor(p)
    elif form == "first3":
        c = p.some(3)
        w = np.array([_factor(p, less) for less in (True, False, True)])
    elif form == "sudden":
        c = p.some(int(p.rng.integers(1, 3)))
        g = _factor(p)
        w[p.row() :] = g
    elif form == "slow":
        c = p.some(1)
        g, k = _factor(p), p.row(0.1, 0.3)
        m = p.n - k
        w[k:, 0] = 1 + (g - 1) * (1 - np.exp(-np.arange(m) / (m * 0.3)))
    elif form == "walk":
        c = p.some(1)
        w = 1 + p.size(0.3, 0.45, 0.65) * gaussian_filter1d(p.walk(), p.n / 60)[:, None]
    else:  # steps, the last a partial recovery
        c = p.some(1)
        g = _factor(p, True)
        k = sorted((p.rng.uniform([0.2, 0.4, 0.7], [0.35, 0.6, 0.85]) * p.n).astype(int).tolist())
        w[k[0] :], w[k[1] :], w[k[2] :] = (1 + g) / 2, g, (1 + 2 * g) / 3
    p.amplify(c, w)
    return c


def _sign(p, form):
    mirrored = 2 * p.rest - p.x
    inside = (mirrored.min(0) > 2) & (mirrored.max(0) < 4093)  # of the converter
    pool = sorted([k for k in p.free if inside[k]], key=lambda k: -p.std[k])[:10]
    c = p.take(p.rng.choice(pool, 2 if form == "two" else 1, replace=False))
    w = np.ones((p.n, 1))
    if form in ("all", "two"):
        w[:] = -1
    elif form == "from":
        k = p.row()
        w[k:] = p.size(-0.6, -1, -1)
    else:  # window
        first, last = p.row(0.2, 0.35), p.row(0.65, 0.8)
        w[first:last] = -1
    p.amplify(c, w)
    return c


def _permutation(p, form):
    first, last = 0, p.n
    if form == "rev":  # a plug turned
        k = int(p.rng.integers(0, 14))
        c = list(range(k, k + 4))
        first = p.row()
    elif form == "cyc":
        c = p.rng.permutation(p.some(3)).tolist()
    else:
        c = p.some(2)
        if form == "from":
            first = p.row()
        elif form == "win":
            first, last = p.row(0.2, 0.35), p.row(0.6, 0.8)
    carries = np.arange(19)
    carries[c] = c[1:] + c[:1] if len(c) <= 3 else c[::-1]
    p.x[first:last] = p.x[first:last][:, carries]
    return p.take(c)


def _offset(p, form):
    w = np.zeros((p.n, 1))
    c = p.some(3 if form == "three" else 1, False)
    if form == "step":
        k = p.row(0.2, 0.8)
        a = p.side() * p.size(5, 12, 30) * p.noise[c]
        w[k:] = 1
    elif form == "soft":
        k = p.row(0.2, 0.8)
        a = p.side() * p.size(6, 14, 35) * p.noise[c]
        w[k:, 0] = 1 - np.exp(-np.arange(p.n - k) / (0.12 * p.rate))
    elif form == "three":
        k = p.row(0.2, 0.8)
        a = p.size(5, 12, 30) * p.noise[c] * p.rng.choice([-1, 1], 3) * p.rng.uniform(0.6, 1.3, 3)
        w[k:] = 1
    elif form == "back":
        k, last = p.row(0.2, 0.4), p.row(0.6, 0.8)
        a = p.side() * p.size(6, 14, 35) * p.noise[c]
        w[k:last] = 1
    else:  # two, the same way
        k = sorted([p.row(0.15, 0.4), p.row(0.5, 0.85)])
        a = p.side() * p.size(6, 12, 25) * p.noise[c]
        w[k[0] :] += 1
        w[k[1] :] += p.rng.uniform(0.6, 1.2)
    p.x[:, c] += w * a
    return c


def _drift(p, form):
    u = np.arange(p.n) / p.n
    if form == "walk":
        w = p.walk()
    elif form == "sat":
        w = 1 - np.exp(-u / 0.2)
    elif form == "mid":
        k = p.row(0.35, 0.6)
        w = np.clip(np.arange(p.n) - k, 0, None) / (p.n - k)
    elif form == "back":
        w = np.sin(np.pi * np.linspace(0, 1, p.n)) ** 2
        w = w * (1 + 0.2 * gaussian_filter1d(p.walk(), p.n / 30))
    elif form == "log":
        w = np.log1p(u / 0.03)
        w = w / w[-1]
    else:  # acc
        w = np.linspace(0, 1, p.n) ** 2.7 + 0.05 * gaussian_filter1d(p.walk(), p.n / 25)
    number = {"sat": 2, "log": 3}.get(form, 1)
    c = p.some(number, False)
    a = p.size(9, 20, 45) * np.maximum(p.noise[c], 1)
    a = a * p.rng.choice([-1, 1], number) * p.rng.uniform(0.7, 1.2, number)
    p.x[:, c] += w[:, None] * a
    return c


def _common(p, w, counts, spread):
    p.x += w[:, None] * counts * p.rng.uniform(1 - spread, 1 + spread, 19)
    return ALL


def _shared(p):
    return p.size(9, 20, 40) * max(1, np.median(p.noise))


def _warm_up(p, form):
    u, spread, sizes = np.arange(p.n) / p.n, 0.25, (20, 40, 70)
    if form == "exp":
        w = 1 - np.exp(-u / 0.35)
    elif form == "mid":
        k, spread = p.row(0.2, 0.4), 0.35
        w, m = np.zeros(p.n), p.n - k
        y = 1 - np.exp(-np.arange(m) / (m * 0.4))
        w[k:] = y / y[-1]
    elif form == "two":
        spread = 0.2
        w = 0.4 * (1 - np.exp(-u / 0.06)) + 0.6 * (1 - np.exp(-u / 0.7))
        w /= w[-1]
    else:  # sig: heat comes through the housing
        spread, sizes = 0.3, (15, 30, 60)
        w = 1 / (1 + np.exp(-np.linspace(-5, 5, p.n)))
        w = w + 0.04 * gaussian_filter1d(p.walk(), p.n / 30)
    warms = p.size(*sizes)
    if p.tdc is not None:
        p.tdc = p.tdc + warms * (_lag(w, 1.0, p.rate) if form == "mid" else w)
    return _common(p, w, _shared(p), spread)


def _temperature(p, form):
    c, sizes = ALL, (0.6, 1.2, 2.5)
    if form == "nat":
        w = gaussian_filter1d(p.tdc, 6)
    elif form == "lag":
        w = _lag(gaussian_filter1d(p.tdc, 6), 1.5, p.rate)
    elif form == "osc":  # a draught
        x = 30 * np.sin(2 * np.pi * p.seconds / p.rng.uniform(4, 6) + 1) + 12 * p.slow(150)
        new = p.tdc + gaussian_filter1d(x, 15)
        p.tdc = new + (p.tdc[0] - new[0])
        w, sizes = gaussian_filter1d(p.tdc, 4), (0.25, 0.5, 1.0)
    elif form == "few":
        w, c, sizes = gaussian_filter1d(p.tdc, 6), p.some(3, False), (1.0, 1.6, 2.5)
    else:  # pulse: a warm touch
        x, k = np.zeros(p.n), p.row(0.25, 0.45)
        m = np.arange(p.n - k) / p.rate
        x[k:] = 60 * (m / 0.8) * np.exp(1 - m / 0.8) * (m < 30)
        p.tdc = p.tdc + x
        w, sizes = p.tdc, (0.2, 0.4, 0.8)
    a = p.size(*sizes) * p.side()
    swing = np.ptp(gaussian_filter1d(w, 20))
    a *= max(1, 8 / swing) if swing < 8 else 1
    each = p.rng.uniform(0.6, 1.4, 19) if c is ALL else p.rng.uniform(0.8, 1.2, len(c))
    p.x[:, c] += (w - w[0])[:, None] * a * each
    return c


def _fluid_loss(p, form):
    more, spread = 1.0, 0.3
    if form == "lin":
        w, spread = np.linspace(0, 1, p.n), 0.4
    elif form == "acc":
        k = p.row(0.2, 0.45)
        w, more = np.clip((np.arange(p.n) - k) / (p.n - k), 0, None) ** 1.8, 1.1
    elif form == "load":  # faster under load, and answers grow meanwhile
        q = np.ones(p.n) if p.loads is None else np.abs(p.loads[:, 2])
        w = np.cumsum(np.clip(q - np.percentile(q, 10), 0, None) ** 2 + 0.1)
        w /= w[-1]
        p.amplify(ALL, (1 + 0.15 * w)[:, None])
        more = 1.2
    else:  # exp
        w = 1 - np.exp(-np.arange(p.n) / (p.n * 0.5))
        w /= w[-1]
    return _common(p, w, -_shared(p) * more, spread)


def _relaxation(p, form):
    r = p.x - p.rest
    if form == "exp":
        a = p.size(0.15, 0.28, 0.45)
        y = (1 - a) * r + a * _lag(r, p.rng.uniform(2, 4), p.rate)
    elif form == "log":
        a = p.size(0.18, 0.32, 0.5)
        y = (1 - a) * r + a * sum(_lag(r, s, p.rate) for s in (0.6, 2.5, 9)) / 3
    elif form == "peak":
        a = p.size(0.18, 0.3, 0.5)
        y = r + a * (r - _lag(r, p.rng.uniform(1.5, 3.5), p.rate))
    else:  # asym: quick on loading, slow on release
        a = p.size(0.2, 0.35, 0.55)
        s, up, down = np.empty_like(r), 1 - np.exp(-1 / (0.4 * p.rate)), 1 - np.exp(-1 / (4.0 * p.rate))
        s[0] = r[0]
        for i in range(1, p.n):
            rises = np.abs(r[i]) > np.abs(s[i - 1])
            s[i] = s[i - 1] + np.where(rises, up, down) * (r[i] - s[i - 1])
        y = (1 - a) * r + a * s
    p.x = p.rest + y
    return ALL


def _hysteresis(p, form):
    if form == "play":
        width = p.size(0.2, 0.35, 0.6) * p.std
        s = gaussian_filter1d(p.x, 2, axis=0)
        p.x = _play(s, width) + (p.x - s)
    elif form == "share":
        a, c = p.size(0.3, 0.5, 0.75), p.some(6)
        s = gaussian_filter1d(p.x[:, c], 2, axis=0)
        p.x[:, c] = (1 - a) * p.x[:, c] + a * (_play(s, 0.7 * p.std[c]) + p.x[:, c] - s)
        return c
    elif form == "force":
        q = gaussian_filter1d(np.linalg.norm(p.loads, axis=1), 4)
        width = 0.35 * (np.percentile(q, 95) - np.percentile(q, 5))
        d = (q - _play(q[:, None], width)[:, 0]) / width
        side = np.sign(((p.x - p.x.mean(0)) * (q - q.mean())[:, None]).mean(0))
        p.x -= d[:, None] * p.size(0.2, 0.35, 0.6) * p.std * side
    else:  # prei: four plays in sum (Prandtl-Ishlinskii)
        r = p.x - p.rest
        s, a = gaussian_filter1d(r, 2, axis=0), p.size(0.35, 0.55, 0.8)
        y = sum(_play(s, width * p.std) for width in (0.15, 0.5, 1.1, 2.0)) / 4
        p.x = p.rest + (1 - a) * r + a * (y + r - s)
    return ALL


def _latency(p, form):
    if form == "const":
        p.x = p.x - p.source.x[p.first : p.first + p.n] + p.earlier(int(p.size(8, 16, 36)))
    elif form == "some":
        k, c = int(p.size(8, 15, 30)), p.some(5)
        p.x[:, c] = p.earlier(k)[:, c]
        return c
    elif form == "grow":
        p.x = p.earlier(np.round(np.linspace(0, p.size(20, 35, 70), p.n)))
    elif form == "mid":
        k, row = int(p.size(12, 22, 45)), p.row(0.3, 0.5)
        p.x[row:] = p.earlier(k)[row:]
    else:  # jit: a buffer
        x = np.clip(p.size(10, 18, 35) * (1 + 0.5 * p.slow(2 * p.rate)), 0, None)
        i = np.maximum.accumulate(np.arange(p.n) - np.round(x))
        p.x = p.earlier(np.arange(p.n) - i)
    return ALL


def _low_pass(p, form):
    if form == "one":
        c = p.some(1)
        corner = 1 / p.size(0.22, 0.6, 1.5)
        p.x[:, c] = _lag(p.x[:, c], 1 / (2 * np.pi * corner), p.rate)
    elif form == "avg":
        m, c = int(p.size(5, 11, 25)), ALL
        p.x = lfilter(np.ones(m) / m, 1, np.r_[np.repeat(p.x[:1], m - 1, 0), p.x], axis=0)[m - 1 :]
    elif form == "mid":
        c = p.some(3)
        corner, k = 1 / p.size(0.2, 0.4, 1.0), p.row(0.3, 0.5)
        b, a = butter(2, corner / (p.rate / 2))
        x = p.x[k:, c]
        p.x[k:, c] = lfilter(b, a, x, axis=0, zi=lfilter_zi(b, a)[:, None] * x[0])[0]
    else:  # zero: without a phase
        width, c = p.size(2, 5, 12), p.some(2)
        p.x[:, c] = gaussian_filter1d(p.x[:, c], width, axis=0)
    return c


def _noise(p, form):
    n, rng = p.n, p.rng
    if form == "one":
        c = p.some(1, False)
        a = p.size(2.2, 4, 9) * p.noise[c]
        p.x[:, c] += p.holding(rng.standard_normal((n, 1))) * a
    elif form == "all":
        c, a = ALL, p.size(1.8, 3, 6) * p.noise
        p.x += p.holding(rng.standard_normal((n, 19))) * a
    elif form == "mid":  # with heavy tails
        c, k = p.some(2, False), p.row()
        a = p.size(2.5, 4.5, 10) * p.noise[c]
        p.x[k:, c] += (p.holding(rng.standard_t(4, (n, 2)) / 1.41) * a)[k:]
    elif form == "grow":
        c = p.some(1, False)
        a = p.size(4, 7, 14) * p.noise[c]
        w = np.linspace(0, 1, n)[:, None] ** 1.5
        p.x[:, c] += p.holding(rng.standard_normal((n, 1)) * w) * a
    else:  # pink
        c, f = p.some(1, False), np.fft.rfftfreq(n, 1 / p.rate)
        f[0] = f[1]
        s = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) / np.sqrt(np.maximum(f, 0.5)), n)
        s /= s.std()
        p.x[:, c] += p.holding(s[:, None]) * p.size(3, 5, 11) * p.noise[c]
    return c


def _wave(p, frequency, amplitude, phase, swell=1, wanders=0.03):
    angle = 2 * np.pi * np.cumsum(frequency + wanders * p.slow(3 * p.rate)) / p.rate
    return p.holding(np.sin(angle[:, None] + phase) * swell) * amplitude


def _line_noise(p, form):
    rng, mains = p.rng, 50.0 if p.rate > 110 else 60.0
    if form == "one":
        c = p.some(1, False)
        a = p.size(2, 4, 9) * p.noise[c]
        p.x[:, c] += _wave(p, mains, a, rng.uniform(0, 6.28, 1))
    elif form == "all":  # the multiplexer is later for each
        c, a = ALL, p.size(1.5, 3, 7) * np.maximum(np.median(p.noise), 1) * rng.uniform(0.6, 1.4, 19)
        p.x += _wave(p, 60.0, a, 2 * np.pi * 60.0 * np.arange(19) * 2 / 4400)
    elif form == "fan":
        c, f = ALL, rng.uniform(11, 23)
        a, swell = p.size(1.5, 3, 6) * p.noise, 1 + 0.4 * np.clip(p.slow(p.rate), -2, 2)
        p.x += _wave(p, f, a, rng.uniform(0, 0.5, 19), swell[:, None], 0.15)
    else:  # mid: with a harmonic
        c, k = p.some(4, False), p.row()
        a = p.size(2.5, 4.5, 9) * p.noise[c]
        h = _wave(p, mains, a, rng.uniform(0, 6.28, 4))
        h = h + 0.4 * _wave(p, mains * 3 % p.rate, a, rng.uniform(0, 6.28, 4))
        p.x[k:, c] += h[k:]
    return c


def _cross_talk(p, form):
    before, first = p.x.copy(), 0
    if form == "all":
        k = p.size(0.1, 0.18, 0.3)
        p.x[:, 1:] = (1 - k) * before[:, 1:] + k * before[:, :-1]
        return ALL
    if form == "block":  # of what changes alone
        s = int(p.rng.integers(1, 14))
        c = np.arange(s, s + 4)
        p.x[:, c] += p.size(0.12, 0.22, 0.35) * (before - p.rest)[:, c - 1]
        return c.tolist()
    apart = np.r_[0, (before[:, :-1] - before[:, 1:]).std(0)]
    pool = [k for k in np.argsort(-apart)[:9] if k in p.free and k > 0]
    (c,) = p.take([p.rng.choice(pool)])
    if form == "one":
        k = p.size(0.12, 0.22, 0.4)
    else:  # mid
        k, first = p.size(0.1, 0.2, 0.35), p.row()
    p.x[first:, c] = (1 - k) * before[first:, c] + k * before[first:, c - 1]
    return [c]


def _quantisation(p, form):
    c, first = ALL, 0
    bits = ((4, 8, 16) if p.noise.mean() < 2 else (16, 32, 64))[p.level]
    if form == "one":
        c = p.some(2)
    elif form == "mid":
        first = p.row()
    elif form == "dec":
        bits = ((10, 25, 50) if p.noise.mean() > 2 else (4, 7, 10))[p.level]

    def act(counts):
        counts[first:, c] = np.floor(counts[first:, c] / bits) * bits
        return counts

    p.after.append(act)
    return c


def _saturation(p, form):
    if form == "top":
        limit = np.percentile(p.x.max(0), (80, 60, 40)[p.level])
        p.after.append(lambda counts: np.minimum(counts, limit))
        return p.take(np.flatnonzero((p.x > limit).mean(0) > 0.02))
    if form == "low":
        c = p.some(1)
        limit = round(np.percentile(p.x[:, c], (6, 14, 30)[p.level]))

        def act(counts):
            counts[:, c] = np.clip(counts[:, c], limit, 4095)
            return counts

        p.after.append(act)
        return c
    if form == "soft":  # both ends, with a knee
        c = p.some(2)
        low = np.percentile(p.x[:, c], (8, 18, 35)[p.level], axis=0)
        high = np.percentile(p.x[:, c], (94, 88, 78)[p.level], axis=0)
        middle, half = (low + high) / 2, (high - low) / 2
        x = (p.x[:, c] - middle) / half
        bent = np.sign(x) * (0.85 + 0.15 * np.tanh((np.abs(x) - 0.85) / 0.15))
        p.x[:, c] = middle + half * np.where(np.abs(x) < 0.85, x, bent)
        return c
    top, sags = np.percentile(p.x.max(0), 75), p.size(40, 90, 180)  # sag: a supply's
    limit = top - sags * np.linspace(0, 1, p.n) - 0.1 * sags * np.abs(p.slow(300))
    p.after.append(lambda counts: np.minimum(counts, np.round(limit)[:, None]))
    return np.flatnonzero((p.x > limit[:, None]).mean(0) > 0.02).tolist()


def _stuck(p, form):
    c, first, last, flutter = p.some(2 if form == "lsb" else 1), 0, p.n, 0
    if form in ("val", "lsb"):
        value, flutter = np.round(np.median(p.x[:, c], 0)), 0.5 if form == "lsb" else 0
    elif form == "mid":
        first = p.row(0.2, 0.8)
        value = np.round(p.x[first, c])
    elif form == "rail":
        first = p.row(0.2, 0.6)
        value = float(p.rng.choice([0, 4095]))
    else:  # win
        first = p.row(0.2, 0.4)
        last = first + int(p.size(0.1, 0.2, 0.4) * p.n)
        value = np.round(p.x[first, c])
    value = value + np.round(flutter * p.rng.standard_normal((p.n, len(c))))

    def act(counts):
        counts[first:last, c] = value[first:last]
        return counts

    p.after.append(act)
    return c


def _spikes(p, form):
    rng, number = p.rng, max(3, int(p.size(0.0015, 0.004, 0.01) * p.n))
    rows = np.sort(rng.choice(np.arange(20, p.n - 20), number, replace=False))
    if form == "all":
        rows = rows[::2]
        a = p.size(12, 30, 80) * max(1, p.noise.mean())
        w = rng.uniform(0.4, 1.6, 19) * a
        change, c = rng.choice([-1, 1], len(rows))[:, None] * w, ALL
    elif form == "one":
        c = p.some(1, False)
        a = p.size(12, 30, 80) * max(1, p.noise[c[0]])
        change = (rng.choice([-1, 1], len(rows)) * rng.uniform(0.6, 1.5, len(rows)) * a)[:, None]
    elif form == "bit":
        bit = ((64, 256, 1024) if p.noise.mean() < 3 else (256, 512, 1024))[p.level]
        at = rng.integers(0, 19, (len(rows), 1))

        def turn(counts):
            counts[rows, at[:, 0]] = counts[rows, at[:, 0]].astype(int) ^ bit
            return counts

        p.after.append(turn)
        return sorted(set(at.ravel().tolist()))
    else:  # zero
        c = p.some(2, False)

    def act(counts):
        cells = np.ix_(rows, c)
        counts[cells] = 0 if form == "zero" else counts[cells] + change
        return counts

    p.after.append(act)
    return c


def _lost(p, form):
    n, rng, keep = p.n, p.rng, np.ones(p.n, bool)
    if form == "rand":
        keep[rng.random(n) < p.size(0.01, 0.04, 0.12)] = False
    elif form == "gaps":
        number = (2, 3, 5)[p.level]
        length = (rng.uniform(0.5, 1.5, number) * p.size(15, 50, 120)).astype(int)
        for a, rows in zip((rng.uniform(0.08, 0.9, number) * n).astype(int), length):
            keep[a : min(a + rows, n - 5)] = False
    elif form == "per":
        every = (50, 20, 7)[p.level]
        keep[int(every * rng.uniform(0.3, 0.9)) : n - 1 : every] = False
    else:  # burst, worse towards the end
        share = np.linspace(0, 1, n) ** 2 * p.size(0.1, 0.25, 0.5) * (p.slow(80) > 0.3)
        keep[rng.random(n) < share] = False
    p.kept = np.flatnonzero(keep)
    return ALL


def _held(p, form):
    n, rng = p.n, p.rng
    i = np.arange(n)
    if form == "runs":
        for a in (rng.uniform(0.05, 0.92, (4, 8, 15)[p.level]) * n).astype(int):
            i[a : a + int(rng.integers(8, 40))] = a
        i = np.maximum.accumulate(np.minimum(i, np.arange(n)))
    elif form == "long":
        a = p.row(0.2, 0.7)
        i[a : a + int(p.size(50, 120, 300))] = a
    elif form == "half":
        every, k = (2, 3, 5)[p.level], p.row(0.1, 0.4)
        i[k:] = k + (i[k:] - k) // every * every
    else:  # rand
        again = rng.random(n) < p.size(0.25, 0.4, 0.6)
        again[0] = False
        i = np.maximum.accumulate(np.where(again, 0, i))
    p.after.append(lambda counts: counts[i])
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


# ---------------------------------------------------------------- outside the catalogue: (piece)


def _bubble(p):
    order = np.array([10, 11, 12, 13, 16, 17, 18])
    a, passes = p.size(8, 18, 40) * p.noise.mean(), int(p.rng.integers(2, 5))
    for begin in p.rng.uniform(0.05, 0.8, passes) * p.n:
        v = p.rng.uniform(0.25, 0.6) * p.rate
        for i, k in enumerate(order):
            p.x[:, k] -= a * np.exp(-0.5 * ((np.arange(p.n) - begin - i * v) / (v * 0.6)) ** 2)


def _bubbles_form(p):
    c = [6, 7, 8, 9]
    a, x = p.size(10, 20, 40) * p.noise[c].mean(), np.zeros(p.n)
    for s in np.cumsum(p.rng.exponential(2.2, 60)):
        k = int(s * p.rate)
        if k >= p.n:
            break
        m = np.arange(p.n - k) / p.rate
        x[k:] += p.rng.uniform(0.4, 1.2) * np.exp(-m / p.rng.uniform(0.3, 0.9))
    p.x[:, c] -= x[:, None] * a * np.array([1, 0.7, 0.5, 0.3])


def _telegraph(p, up, down):
    x, i, on = np.zeros(p.n, bool), 0, False
    while i < p.n:
        k = int(p.rng.exponential(down if on else up)) + 2
        x[i : i + k] = on
        i, on = i + k, not on
    return x


def _contact(p):
    (c,) = p.some(1, False)
    m = _telegraph(p, p.rate * 2.5, p.rate * p.size(0.08, 0.25, 0.6))
    v = p.size(60, 200, 600) * p.side()
    p.x[m, c] += v + p.rng.normal(0, abs(v) * 0.35, m.sum())


def _ground(p):
    m = _telegraph(p, p.rate * 1.5, p.rate * 0.3)
    a = p.size(6, 14, 35) * p.noise.mean()
    w = p.rng.uniform(0.3, 1.7, 19) * a
    some = np.where(p.rng.random(p.n) < 0.85, 1, 0.4)[:, None]
    p.x += gaussian_filter1d(m.astype(float), 0.7)[:, None] * w * some


def _knock(p):
    a, number = p.size(10, 25, 60) * p.noise.mean(), int(p.rng.integers(3, 8))
    f, w = p.rng.uniform(7, 14), p.rng.normal(0, 1, 19)
    for k in (p.rng.uniform(0.05, 0.95, number) * p.n).astype(int):
        m = np.arange(p.n - k) / p.rate
        rings = p.rng.uniform(0.5, 1.3) * np.exp(-m / 0.25) * np.sin(2 * np.pi * f * m)
        p.x[k:] += rings[:, None] * a * w


def _modulated(p):
    a, f = p.size(0.15, 0.3, 0.5), p.rng.uniform(0.3, 0.8)
    p.amplify(ALL, (1 + a * np.sin(2 * np.pi * f * p.seconds + 1))[:, None])


def _chopped(p):
    a, f = p.size(0.12, 0.25, 0.4), p.rng.uniform(3, 6)
    p.amplify(p.some(6), (1 + a * np.sign(np.sin(2 * np.pi * f * p.seconds)))[:, None])


def _halves(p):
    k = p.n // 2
    p.after.append(lambda counts: np.r_[counts[k:], counts[:k]])


def _reversed(p):
    a, b = p.row(0.2, 0.35), p.row(0.65, 0.85)
    p.after.append(lambda counts: np.r_[counts[:a], counts[a:b][::-1], counts[b:]])


def _chirps(p):
    a, x, k, rng = p.size(3, 6, 14) * p.noise.mean(), np.zeros(p.n), int(p.rate), p.rng
    while k < p.n - 50:
        rows = int(rng.uniform(0.3, 1.0) * p.rate)
        m = np.arange(min(rows, p.n - k))
        turns = rng.uniform(2, 15) * m / p.rate + 0.5 * rng.uniform(-20, 20) * (m / p.rate) ** 2
        x[k : k + rows] += np.hanning(rows)[: len(m)] * np.sin(2 * np.pi * turns)
        k += int(rng.uniform(1.5, 4) * p.rate)
    p.x += x[:, None] * a * rng.uniform(0.3, 1.5, 19)


def _rub(p):
    a = p.size(3, 6, 12) * p.noise.mean()
    band = butter(2, [4 / (p.rate / 2), 14 / (p.rate / 2)], "band")
    s = lfilter(*band, p.rng.standard_normal((p.n, 3)), axis=0)
    s /= s.std(0)
    strokes = np.clip(np.sin(2 * np.pi * 0.45 * p.seconds + p.slow(p.rate * 2)) + 0.2, 0, None)
    p.x += (s * strokes[:, None]) @ p.rng.normal(0, 1, (3, 19)) * a / 1.5


def _comb(p):
    m, a, x = int(p.rng.integers(31, 53)), p.size(4, 9, 20) * p.noise.mean(), np.zeros(p.n)
    for begin, v in ((0, 1), (1, 0.6), (2, 0.25)):
        x[begin::m] = v
    p.x -= x[:, None] * a * p.rng.uniform(0.4, 1.5, 19)


def _pulse(p):
    a = p.size(2.5, 5, 10) * p.noise.mean()
    beat = np.cumsum((1.15 + 0.06 * p.slow(p.rate)) / p.rate) % 1
    x = np.exp(-(((beat - 0.2) / 0.08) ** 2)) + 0.35 * np.exp(-(((beat - 0.5) / 0.1) ** 2))
    c = p.some(8, False)
    p.x[:, c] += x[:, None] * a * p.rng.uniform(0.4, 1.3, 8)


def _wavy(p):
    a = p.size(6, 14, 30)
    p.x = p.x + a * np.sin(2 * np.pi * p.x / p.rng.uniform(90, 170))


def _fold(p):
    c = p.some(2)
    h = np.percentile(p.x[:, c], (90, 80, 65)[p.level], axis=0)
    p.x[:, c] = np.where(p.x[:, c] > h, 2 * h - p.x[:, c], p.x[:, c])


def _short(p):
    c, k = p.some(2), p.row(0.2, 0.5)
    p.x[k:, c] = p.x[k:, c].mean(1)[:, None]


def _slip(p):
    k, d, w = p.row(), p.size(0.35, 0.6, 0.9), np.zeros((p.n, 1))
    w[k:, 0] = d * (1 - np.exp(-np.arange(p.n - k) / (0.5 * p.rate)))
    r = p.x - p.rest
    q = r.copy()
    q[:, 1:6], q[:, 11:16] = r[:, 0:5], r[:, 10:15]
    p.x = p.rest + r * (1 - w) + q * w


def _two_levels(p):
    (c,) = p.some(1, False)
    m = _telegraph(p, p.rate * 1.2, p.rate * 0.8)
    p.x[m, c] += p.size(3.5, 7, 15) * p.noise[c]


def _clock(p):
    k = p.row(0.3, 0.7)
    p.time[k:] += float(p.rng.choice([-1, 1])) * p.size(0.8, 2.5, 8)


def _gain_control(p):
    a, r = p.size(0.35, 0.55, 0.8), p.x - p.rest
    level = _lag(np.sqrt((r**2).mean(1))[:, None], 0.8, p.rate)
    p.x = p.rest + r * (np.median(level) / np.maximum(level, 1)) ** a


def _splice(p):
    rows, a = int(p.size(60, 200, 500)), p.row(0.2, 0.6)
    k = int(p.rng.integers(500, 15000))
    p.x[a : a + rows] = p.other[k : k + rows][: len(p.x[a : a + rows])]


def _rocking(p):
    a = p.size(3, 7, 15) * p.noise.mean()
    angle = 2 * np.pi * np.cumsum(0.27 + 0.03 * p.slow(p.rate * 4)) / p.rate
    w = np.zeros(19)
    w[:6], w[10:16] = 1, -1
    p.x += np.sin(angle)[:, None] * a * w * p.rng.uniform(0.6, 1.3, 19)


def _slew(p):
    c = p.some(2)
    v = p.std[c] * p.size(4.0, 2.0, 0.8) / p.rate
    y = p.x[:, c].copy()
    for i in range(1, p.n):
        y[i] = y[i - 1] + np.clip(p.x[i, c] - y[i - 1], -v, v)
    p.x[:, c] = y


def _dead(p):
    c = p.some(3)
    w, middle = p.size(0.3, 0.55, 0.9) * p.std[c], np.median(p.x[:, c], 0)
    r = p.x[:, c] - middle
    p.x[:, c] = middle + np.sign(r) * np.clip(np.abs(r) - w, 0, None)


def _echo(p):
    k, a = int(p.rng.uniform(0.9, 1.8) * p.rate), p.size(0.2, 0.35, 0.5)
    p.x = p.x + a * (p.earlier(k) - p.rest)


OUTSIDE = {
    "bubble": _bubble,
    "bubble2": _bubbles_form,
    "contact": _contact,
    "ground": _ground,
    "knock": _knock,
    "am": _modulated,
    "am_fast": _chopped,
    "halves": _halves,
    "rev": _reversed,
    "rf": _chirps,
    "rub": _rub,
    "comb": _comb,
    "pulse": _pulse,
    "inl": _wavy,
    "fold": _fold,
    "short": _short,
    "skin": _slip,
    "rtn": _two_levels,
    "clock": _clock,
    "agc": _gain_control,
    "splice": _splice,
    "breath": _rocking,
    "slew": _slew,
    "dead": _dead,
    "echo": _echo,
}


# ---------------------------------------------------------------- the plan


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base, with +f at its end where the file has the force; first: row of the source; rows;
    drawn: numbers taken from the author's stream before its effects, and half of one that was left over, or
    None, of an untouched one None; level: faint, medium, strong; effects: of (kind, form), the author's
    names, of one outside the catalogue (kind, "")."""

    name: str
    base: str
    first: int
    rows: int
    drawn: tuple | None
    level: str | None
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
        bits = np.random.PCG64(_SEED)
        if self.drawn is not None:
            taken, left = self.drawn
            bits.advance(taken)
            if left is not None:
                bits.state = bits.state | {"has_uint32": 1, "uinteger": left}
        return np.random.Generator(bits)


def plan() -> list[Spec]:
    """178 pieces: singles, pairs, outside the catalogue, untouched. The author's two of logs that were tared
    are left out: none is read."""
    return [
        Spec(f"{number:03d}", *where, tuple((e, "") if isinstance(e, str) else e for e in effects))
        for number, *where, effects in ((*row[:6], row[6:]) for row in _PLAN)
    ]


def make(spec: Spec, data: str) -> tuple[dict, np.ndarray]:
    """Fields of the case, its counts as a file has them, and the counts without what is hidden (n, 19), rows
    that are lost later among them."""
    folder, name = pathlib.Path(data), spec.base.removesuffix("+f")
    kind, other = name.split("/")[0], None
    if spec.effects[:1] == (("splice", ""),):
        other = _source(folder, "F1" if kind == "F2" else "F2").x
    source, level = _source(folder, name), _LEVELS.index(spec.level) if spec.level else 0
    p = _Piece(source, spec.first, spec.rows, spec.base.endswith("+f"), level, spec.stream(), other)
    clean, channels = p.x.copy(), []
    for effect, form in spec.effects:
        if spec.outside:
            OUTSIDE[effect](p)
            channels.append(ALL)
        else:
            channels.append(LAWS[effect](p, form))
    counts, seen = written(p), []
    if spec.effects:
        seen = [float(np.sqrt(((counts - clean) ** 2).mean(0) / p.noise**2).max())]
    digits = 6 if kind in ("btd", "slides") else 5
    case = {
        "base": f"twelfth {kind}",
        "counts": counts[p.kept],
        "rate": p.rate,
        "force": None if p.force is None else _digits(p.force, 5)[p.kept],
        "tdc": None if p.tdc is None else np.round(p.tdc)[p.kept],
        "loaded": kind in ("F1", "F2", "slides"),
        "channels": channels,
        "truth": list(spec.kinds),
        "forms": [form or effect for effect, form in spec.effects],
        "seen": seen,
        "gaps": list(np.flatnonzero(np.diff(p.kept) > 1) + 1),
        "time": _digits(p.time, digits)[p.kept],
    }
    return case, clean


def _digits(x, number):
    """x as text of so many decimals has it."""
    return np.array([float(f"{v:.{number}f}") for v in np.ravel(x)]).reshape(np.shape(x))


def written(p) -> np.ndarray:
    """(n, 19) counts of a piece as its log has them, before rows are lost."""
    counts = np.round(p.x)
    for act in p.after:
        counts = act(counts)
    return np.clip(np.round(counts), 0, 4095)


# number, base, first row, rows, where in the stream, level, effects: (kind, form), or what is outside the
# catalogue
_PLAN = (
    (1, "F2", 5430, 1657, None, None),
    (2, "U", 3197, 1985, (273489, 3710420502), "medium", ("line_noise", "one"), ("lost_samples", "rand")),
    (3, "U", 14210, 2698, (153705, None), "medium", "bubble2"),
    (4, "F2+f", 9288, 3790, (11153, None), "strong", ("warm_up", "two")),
    (5, "F2", 11335, 1805, (179237, None), "strong", "skin"),
    (6, "F1+f", 5907, 2827, (14730, 2009895379), "faint", ("relaxation", "peak")),
    (7, "phac/acrylic_211_04/F1", 0, 1000, (127982, None), "strong", ("stuck", "rail")),
    (8, "F2+f", 18864, 2432, (2572, None), "strong", ("sign", "two")),
    (9, "U", 13549, 2387, (2729, None), "medium", ("offset", "soft")),
    (10, "F1+f", 879, 3649, (17213, None), "medium", ("latency", "jit")),
    (11, "F1", 12116, 3752, (109473, None), "medium", ("quantisation", "one")),
    (12, "F2+f", 8716, 3336, (152021, None), "medium", ("held_samples", "half")),
    (13, "F2+f", 14015, 3648, (16881, 4013535912), "faint", ("latency", "mid")),
    (14, "U", 7317, 1918, None, None),
    (15, "F1+f", 17629, 3032, (22365, None), "faint", ("low_pass", "avg")),
    (16, "F1+f", 121, 1728, (110897, None), "strong", ("saturation", "sag")),
    (17, "phac/steel_vase_702_04/F0", 0, 1000, (12219, None), "medium", ("temperature", "nat")),
    (18, "F2+f", 158, 1706, (144642, None), "medium", ("lost_samples", "gaps")),
    (19, "U", 5766, 2241, None, None),
    (20, "F2+f", 610, 4971, (15792, 2866887636), "medium", ("hysteresis", "prei")),
    (21, "F1+f", 3246, 3467, (157005, 1953510590), "medium", "knock"),
    (22, "U", 14692, 3514, None, None),
    (23, "U", 652, 2358, None, None),
    (24, "phac/car_sponge_101_01/F1", 0, 1000, (103419, 3074693928), "strong", ("line_noise", "mid")),
    (25, "F2", 6726, 3797, (159369, None), "strong", "rub"),
    (26, "F1+f", 5435, 2327, (158674, 586099256), "medium", "rev"),
    (27, "F2+f", 3655, 2228, (206007, 2301180416), "strong", ("sign", "all"), ("offset", "step")),
    (28, "phac/steel_vase_702_03/F0", 0, 1000, None, None),
    (29, "slides/mat12_2+f", 0, 800, (22727, 757775872), "medium", ("low_pass", "one")),
    (31, "F2+f", 14327, 2981, None, None),
    (32, "F1+f", 7665, 10729, None, None),
    (33, "F2", 3148, 2053, None, None),
    (34, "F1", 4406, 7825, (180069, None), "medium", "clock"),
    (35, "slides/mat1_1+f", 0, 600, None, None),
    (36, "F2+f", 3874, 6931, (15206, 2559237742), "strong", ("hysteresis", "share")),
    (37, "F1", 2036, 1896, (141222, 1060860230), "medium", ("spikes", "zero")),
    (38, "F2+f", 6456, 2647, (14141, 224478622), "medium", ("fluid_loss", "load")),
    (39, "F2+f", 8125, 2464, (2549, None), "strong", ("gain", "steps")),
    (40, "phac/acrylic_211_01/F0", 0, 1000, (176273, None), "medium", "pulse"),
    (41, "slides/mat18_2+f", 0, 800, None, None),
    (42, "F1", 19871, 2290, (88819, None), "medium", ("line_noise", "one")),
    (43, "phac/car_sponge_101_05/F1", 0, 1000, (10976, None), "medium", ("warm_up", "mid")),
    (44, "F2+f", 21146, 1694, (97989, 3074693928), "medium", ("line_noise", "fan")),
    (45, "U", 17801, 2469, None, None),
    (46, "F2+f", 6299, 9829, (2614, 4031379181), "medium", ("permutation", "all")),
    (47, "phac/acrylic_211_04/F0", 0, 1000, (144649, None), "medium", ("lost_samples", "per")),
    (48, "U", 16277, 2644, (137699, None), "faint", ("stuck", "mid")),
    (49, "F2", 7394, 2195, (140670, 193981669), "faint", ("spikes", "one")),
    (50, "F1+f", 11649, 3288, None, None),
    (51, "phac/car_sponge_101_03/F1", 0, 1000, (11174, None), "faint", ("warm_up", "sig")),
    (52, "F1+f", 18698, 2104, (388, 1334191749), "strong", ("gain", "walk")),
    (53, "U", 4681, 1775, None, None),
    (54, "F1+f", 6630, 2922, (157858, None), "medium", "am_fast"),
    (55, "F1+f", 14856, 2930, (206472, 3254798818), "strong", ("latency", "const"), ("low_pass", "one")),
    (56, "F1+f", 4929, 3103, (207495, None), "strong", ("hysteresis", "play"), ("noise", "all")),
    (57, "F2", 15336, 2420, (185865, None), "medium", "slew"),
    (58, "F1+f", 8576, 2516, (16554, 4012046519), "strong", ("latency", "grow")),
    (59, "phac/car_sponge_101_02/F1", 0, 1000, (14161, 224478622), "faint", ("fluid_loss", "exp")),
    (60, "F1+f", 13139, 2655, (205662, None), "medium", ("permutation", "all"), ("held_samples", "long")),
    (61, "F2", 20330, 2244, (180443, None), "strong", "agc"),
    (62, "F2+f", 1591, 2541, (2673, 375472448), "medium", ("permutation", "win")),
    (63, "F1+f", 14480, 2829, (10955, None), "medium", ("warm_up", "exp")),
    (64, "F1+f", 1730, 10076, None, None),
    (65, "U", 4114, 3539, (92781, None), "faint", ("line_noise", "all")),
    (66, "F1", 11218, 3192, (153432, None), "medium", "bubble"),
    (67, "F2", 855, 1511, (199311, 600457534), "medium", ("offset", "step"), ("spikes", "one")),
    (68, "F1+f", 7779, 3362, (178204, 3718570186), "strong", "inl"),
    (69, "F1+f", 9977, 2950, (187152, 3744505651), "medium", ("gain", "sudden"), ("noise", "one")),
    (70, "U", 2014, 2880, (176253, 2693153050), "medium", "comb"),
    (71, "phac/car_sponge_101_04/F1", 0, 1000, (5554, 1601274995), "medium", ("drift", "back")),
    (72, "F2", 4710, 3056, (2597, None), "strong", ("sign", "win")),
    (73, "slides/mat7_1+f", 0, 800, (2693, None), "medium", ("permutation", "rev")),
    (74, "slides/mat18_1+f", 0, 800, None, None),
    (75, "U", 175, 2069, (154456, None), "strong", "ground"),
    (76, "phac/steel_vase_702_04/F1", 0, 1000, (13923, 1981336652), "faint", ("temperature", "pulse")),
    (77, "U", 11764, 2084, (22724, None), "medium", ("low_pass", "zero")),
    (78, "F2+f", 3562, 3491, (178638, None), "medium", "fold"),
    (79, "F1+f", 421, 3039, (2720, 3714929788), "medium", ("offset", "step")),
    (80, "F2+f", 18358, 2100, (154039, None), "medium", "contact"),
    (81, "btd", 0, 2123, None, None),
    (82, "F2+f", 13007, 2644, (14850, None), "strong", ("relaxation", "asym")),
    (
        83,
        "phac/steel_vase_702_01/F1",
        0,
        1000,
        (268014, None),
        "strong",
        ("fluid_loss", "exp"),
        ("spikes", "bit"),
    ),
    (84, "F2+f", 16509, 2841, (157438, None), "medium", "am"),
    (85, "F1", 8461, 4761, (14074, 2059701267), "strong", ("fluid_loss", "acc")),
    (86, "F2", 9669, 10818, (116912, 2900332057), "medium", ("stuck", "mid")),
    (87, "F2+f", 16274, 1775, (22040, None), "medium", ("low_pass", "one")),
    (88, "F2+f", 397, 2353, None, None),
    (89, "phac/car_sponge_101_01/F0", 0, 1000, (87564, None), "medium", ("noise", "pink")),
    (90, "phac/car_sponge_101_03/F0", 0, 1000, (12260, None), "medium", ("temperature", "osc")),
    (91, "F1+f", 17086, 1773, (108054, None), "medium", ("cross_talk", "one")),
    (92, "F1+f", 17154, 4963, (14304, 843840255), "medium", ("relaxation", "exp")),
    (93, "F1", 545, 8559, (2562, None), "strong", ("sign", "all")),
    (94, "F2", 11042, 3871, (6709, 4033392571), "strong", ("drift", "log")),
    (95, "F1+f", 11499, 2100, (365, 3996916771), "faint", ("gain", "sudden")),
    (96, "phac/acrylic_211_03/F1", 0, 1000, None, None),
    (97, "U", 10249, 2613, (2839, 2681689853), "medium", ("drift", "walk")),
    (98, "F1", 18139, 3307, (180930, 3011825203), "medium", "splice"),
    (99, "F1+f", 4695, 1907, None, None),
    (100, "phac/car_sponge_101_02/F0", 0, 1000, (2809, None), "faint", ("offset", "back")),
    (101, "phac/acrylic_211_02/F1", 0, 1000, None, None),
    (102, "phac/acrylic_211_05/F1", 0, 1000, (13916, 148899581), "faint", ("temperature", "few")),
    (103, "F1+f", 4505, 3035, (16065, None), "medium", ("latency", "const")),
    (104, "U", 5607, 4113, (6737, None), "strong", ("drift", "acc")),
    (105, "slides/mat1_2+f", 0, 600, None, None),
    (106, "F2+f", 16639, 3684, (352, None), "medium", ("gain", "first3")),
    (107, "F1", 18305, 1543, None, None),
    (108, "F1+f", 15291, 3172, (23052, None), "faint", ("noise", "one")),
    (109, "F1+f", 1544, 4111, (15069, 800455136), "medium", ("hysteresis", "play")),
    (110, "phac/steel_vase_702_05/F1", 0, 1000, None, None),
    (111, "F2+f", 1101, 3229, None, None),
    (112, "F2+f", 17755, 2975, (206974, None), "strong", ("relaxation", "exp"), ("drift", "sat")),
    (113, "U", 9294, 3126, (151223, None), "medium", ("held_samples", "runs")),
    (114, "U", 16596, 3426, (179579, None), "medium", "rtn"),
    (115, "F2", 17031, 1561, None, None),
    (116, "F1+f", 2354, 2200, (186273, None), "medium", "dead"),
    (117, "F2+f", 15648, 3527, (109782, None), "medium", ("quantisation", "mid")),
    (119, "U", 11859, 3622, (129310, None), "medium", ("stuck", "lsb")),
    (120, "F2", 18965, 3015, (268881, 741261252), "medium", ("quantisation", "all"), ("gain", "slow")),
    (121, "F1+f", 15681, 3972, (5531, 3656591728), "medium", ("drift", "sat")),
    (122, "F2+f", 19675, 3978, (14561, 2479460034), "medium", ("relaxation", "log")),
    (123, "U", 7280, 3207, (140953, 1064580993), "medium", ("spikes", "all")),
    (124, "U", 2538, 3747, (2701, 306924424), "medium", ("permutation", "from")),
    (125, "phac/steel_vase_702_05/F0", 0, 1000, (152022, None), "faint", ("held_samples", "rand")),
    (126, "U", 19560, 2815, (144896, 3037672079), "strong", ("lost_samples", "burst")),
    (127, "F1+f", 18780, 3120, (151617, None), "faint", ("held_samples", "long")),
    (128, "F1+f", 16918, 2987, (110481, 843796125), "medium", ("saturation", "low")),
    (129, "U", 8982, 2519, (2822, None), "faint", ("offset", "two")),
    (130, "U", 13514, 6481, (109163, None), "faint", ("quantisation", "all")),
    (131, "U", 11019, 2569, None, None),
    (132, "F1+f", 3936, 2309, (344, 4239964730), "medium", ("gain", "first")),
    (133, "F2", 7894, 3677, None, None),
    (134, "U", 1680, 10343, None, None),
    (135, "phac/steel_vase_702_01/F0", 0, 1000, None, None),
    (136, "F1", 3068, 2875, (141596, 386378916), "faint", ("lost_samples", "rand")),
    (137, "F2+f", 16897, 6474, (16332, None), "medium", ("latency", "some")),
    (138, "F2", 1344, 3681, (186719, None), "strong", "echo"),
    (139, "U", 17944, 3480, (83997, 606344501), "strong", ("noise", "grow")),
    (140, "U", 6601, 2187, (181229, 1718303723), "medium", "breath"),
    (141, "F1", 12981, 2020, (2583, None), "medium", ("sign", "from")),
    (142, "F2+f", 12581, 6115, (2800, None), "strong", ("offset", "three")),
    (143, "phac/acrylic_211_01/F1", 0, 1000, None, None),
    (144, "F2+f", 10270, 3424, (22699, None), "strong", ("low_pass", "mid")),
    (145, "F2+f", 2296, 2713, (109052, None), "medium", ("cross_talk", "block")),
    (146, "F1+f", 13235, 9152, None, None),
    (147, "U", 7864, 6682, (158901, None), "medium", "rf"),
    (148, "F2+f", 5817, 2444, (110104, 2778602426), "medium", ("saturation", "top")),
    (149, "U", 15711, 1943, (26313, None), "medium", ("noise", "all")),
    (150, "U", 7613, 4149, (190648, None), "medium", ("drift", "walk"), ("stuck", "mid")),
    (151, "F2+f", 10339, 1846, (110692, 2234027343), "faint", ("saturation", "soft")),
    (152, "F2+f", 484, 3172, (64356, 100600434), "medium", ("noise", "mid")),
    (
        153,
        "phac/acrylic_211_05/F0",
        0,
        1000,
        (268050, 6806945),
        "medium",
        ("temperature", "nat"),
        ("offset", "soft"),
    ),
    (154, "U", 10311, 3955, (199693, 2158594517), "strong", ("warm_up", "exp"), ("line_noise", "all")),
    (155, "F2+f", 6099, 3561, None, None),
    (156, "F1+f", 3682, 4878, (268407, 1894129115), "medium", ("saturation", "low"), ("drift", "mid")),
    (157, "slides/mat12_1+f", 0, 800, None, None),
    (158, "slides/mat20_1+f", 0, 800, None, None),
    (159, "F1+f", 2818, 2223, (2690, 1797361619), "medium", ("permutation", "cyc")),
    (160, "F2+f", 2821, 3462, (376, 3323685530), "medium", ("gain", "slow")),
    (161, "phac/steel_vase_702_02/F1", 0, 1000, (140988, None), "medium", ("spikes", "bit")),
    (162, "F1", 16047, 2788, None, None),
    (163, "F2", 4137, 2504, (108370, None), "faint", ("cross_talk", "all")),
    (164, "U", 808, 3480, (5550, 2884004673), "faint", ("drift", "mid")),
    (165, "F1", 20621, 1775, None, None),
    (166, "F1+f", 17451, 3718, (269393, 2457346204), "medium", ("stuck", "val"), ("permutation", "from")),
    (
        167,
        "F2+f",
        19801,
        1846,
        (268006, 854919025),
        "medium",
        ("cross_talk", "one"),
        ("lost_samples", "gaps"),
    ),
    (168, "phac/steel_vase_702_03/F1", 0, 1000, (12240, 2396541740), "strong", ("temperature", "lag")),
    (169, "slides/mat15_1+f", 0, 800, (2554, 3942318483), "strong", ("gain", "first")),
    (170, "F2+f", 13437, 3178, (158291, 1545451693), "medium", "halves"),
    (171, "F1", 9703, 2468, None, None),
    (172, "F1+f", 7930, 2330, (114208, None), "medium", ("stuck", "val")),
    (173, "F1+f", 12629, 6067, (178974, 2946758645), "medium", "short"),
    (174, "phac/car_sponge_101_05/F0", 0, 1000, (109783, None), "medium", ("quantisation", "dec")),
    (175, "F1+f", 6703, 3726, (2630, 752135616), "medium", ("permutation", "from")),
    (176, "slides/mat20_2+f", 0, 799, (136722, 825431103), "faint", ("stuck", "win")),
    (177, "F2+f", 11996, 3742, None, None),
    (178, "phac/car_sponge_101_04/F0", 0, 1000, (13944, None), "medium", ("fluid_loss", "lin")),
    (179, "F1+f", 8891, 3078, (108736, None), "strong", ("cross_talk", "mid")),
    (180, "F1+f", 13414, 3065, (15512, None), "faint", ("hysteresis", "force")),
)
