"""Pieces of recordings of real sensors with one or two hidden effects, by an eleventh author.

    plan() -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own.
One stream of random numbers made all pieces: the table says how far it was where the effects of each begin,
so that each piece is made alone and is the very one that was judged blind. The author hides what a sensor
does in its own frames and repeats them as the log did. Pieces have a clock of their own, as a file has.
"""

import dataclasses
import functools
import gzip
import pathlib

import numpy as np
from scipy.io import loadmat
from scipy.signal import butter, filtfilt, lfilter

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

_SEED = 110263
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
    "eleventh F1": {"warmup", "latency", "freeze"},
    "eleventh F2": {"warmup", "latency", "freeze"},
    "eleventh U": {"warmup", "freeze"},
    "eleventh phac": {"warmup", "thermal", "fluidloss"},
    "eleventh btd": {"lost_rows", "spikes"},
}
ALL = list(range(19))


# ---------------------------------------------------------------- recordings


@dataclasses.dataclass
class _Source:
    """A sensor's whole recording: counts x (n, 19), time (n,) [s], rate [Hz], force (n, 3), tdc (n,), rest
    (19,): what it reads without load, None: a piece's median."""

    x: np.ndarray
    time: np.ndarray
    rate: float
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None
    rest: np.ndarray | None = None


@functools.cache
def _source(data, name):
    if name == "btd":
        with gzip.open(data / "btd/btsp_touch.btd.gz", "rt", errors="replace") as file:
            words = [line.split() for line in file.read().split("Begin File\n")[1].splitlines()]
        log = np.array(words, float)
        frames = log[:, 8].reshape(-1, 44)
        return _Source(frames[:, 1:38:2], log[::44, 0], 100.0, tdc=frames[:, 43])
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
    time = np.arange(len(x)) / _EPFL
    if force is None:
        return _Source(x, time, _EPFL)
    force = np.loadtxt(data / force)
    press = np.abs(force[:, 2])
    return _Source(x, time, _EPFL, force, rest=x[press < np.percentile(press, 1.5)].mean(0))


# ---------------------------------------------------------------- a piece


class _Piece:
    """Rows of a source on their way, as frames that the log repeats.

    Attributes: x (m, 19) frames; t (m,) their times [s]; pace: frames per second; rows (n, 19) of the log;
    of (n,) frame of each row; time (n,); force (n, 3) and tdc (n,) as the file will have them; pressed (n,)
    normal force, also where the file has none; rest, noise (19,); gaps: rows before which some were lost;
    before (k + n, 19): the source up to the piece's end; other: the counts of another sensor.
    """

    def __init__(self, source, first, rows, with_force, rng, other=None):
        part = slice(first, first + rows)
        self.rows, self.rng, self.other, self.rate = source.x[part].copy(), rng, other, source.rate
        self.time = source.time[part] - source.time[first]
        self.before, self.first_row = source.x[: first + rows], first
        self.force = source.force[part].copy() if with_force else None
        self.pressed = None if source.force is None else np.abs(source.force[part, 2])
        self.tdc = None if source.tdc is None else source.tdc[part].copy()
        self.rest = np.median(self.rows, 0) if source.rest is None else source.rest
        self.start = np.flatnonzero(np.r_[True, (np.diff(self.rows, axis=0) != 0).any(1)])
        self.of = np.zeros(len(self.rows), int)
        self.of[self.start] = 1
        self.of = np.cumsum(self.of) - 1
        self.x = self.rows[self.start].copy()
        m, clocked = len(self.x), np.ptp(np.diff(source.time[:1000])) > 1e-3
        self.t = self.time[self.start] if clocked else np.arange(m) * (self.time[-1] / max(1, m - 1))
        self.pace = 100.0 if clocked else m / max(self.time[-1], 1e-6)
        d = np.diff(self.x, axis=0)
        self.noise = np.maximum(1.4826 * np.median(np.abs(d - np.median(d, 0)), 0) / 1.414 + 0.3, 0.8)
        self.still = self.noise.mean() < 1.2
        self.gaps, self.logged = [], False

    @property
    def end(self):
        return self.t[-1]

    def some(self, number):
        return sorted(int(k) for k in self.rng.choice(19, number, replace=False))

    def lively(self, number):
        """Of the eleven electrodes that move most."""
        among = np.argsort(-self.rows.std(0))[:11]
        return sorted(int(k) for k in self.rng.choice(among, number, replace=False))

    def onset(self, low=0.3, high=0.65):
        return self.rng.uniform(low, high) * self.end

    def log(self):
        """Writes the frames down as rows; what is hidden later is hidden in these."""
        if not self.logged:
            self.rows, self.logged = _counts(self.x)[self.of], True
        return self.rows

    def keep(self, rows):
        """Leaves rows (numbers) alone, with their times."""
        for name in ("rows", "force", "tdc", "time"):
            if getattr(self, name) is not None:
                setattr(self, name, getattr(self, name)[rows])


def _counts(x):
    return np.clip(np.rint(x), 0, 4095)


def _lag(x, seconds, step):
    """One pole, along the first axis; it begins where x does. step [s], one or one for each row."""
    a = 1 - np.exp(-step / seconds)
    if np.ndim(a) == 0:
        zi = np.atleast_1d(x[0]) * (1 - a)
        return lfilter([a], [1, -(1 - a)], x, axis=0, zi=zi if x.ndim == 1 else zi[None])[0]
    out, s = np.empty_like(x), x[0]
    for i in range(len(x)):
        s = out[i] = s + a[i] * (x[i] - s)
    return out


def _play(x, width):
    out, s = np.empty_like(x), x[0].copy()
    for i in range(len(x)):
        s = out[i] = np.minimum(np.maximum(s, x[i] - width), x[i] + width)
    return out


def _wander(rng, n, cycles):
    """(n,) smooth random walk, one from its lowest to its highest."""
    w = np.cumsum(rng.normal(size=n))
    w = filtfilt(*butter(2, min(0.9, cycles / n)), w)
    w -= w[0]
    return w / (np.ptp(w) + 1e-9)


# ---------------------------------------------------------------- effects: (piece, form) -> channels


def _gain(p, form):
    rng, t = p.rng, p.t
    if form == "sudden":
        c, g = p.lively(1), rng.choice([0.45, 1.8])
        w = (t > p.onset()).astype(float)
    elif form == "slow_ramp":
        c, g = p.lively(2), rng.choice([0.35, 2.1])
        w = np.clip((t - 0.15 * p.end) / (0.7 * p.end), 0, 1)
    elif form == "first_one":
        c, g, w = p.lively(1), 0.3, np.ones(len(t))
    elif form == "fading_three":
        c, g = p.lively(3), 0.55
        row = p.onset(0.2, 0.5)
        w = np.clip(1 - np.exp(-(t - row) / 6.0), 0, 1) * (t > row)
    else:  # first_two
        c, g, w = p.lively(2), 1.55, np.ones(len(t))
    for k in c:
        p.x[:, k] = p.rest[k] + (1 + (g - 1) * w) * (p.x[:, k] - p.rest[k])
    return c


def _sign(p, form):
    c = p.lively({"three": 3, "partial_two": 2}.get(form, 1))
    w = p.t > p.onset() if form == "from_time" else np.ones(len(p.t), bool)
    share = 0.7 if form == "partial_two" else 1
    for k in c:
        share = min(share, (4050 - p.rest[k]) / max(1, (p.rest[k] - p.x[w, k]).max()))
    for k in c:
        p.x[w, k] = p.rest[k] - float(share) * (p.x[w, k] - p.rest[k])
    return c


def _permutation(p, form):
    w = slice(0, None)
    if form == "connector_four_from":
        first = int(p.rng.integers(2, 14))
        c = [first, first + 1, first + 2, first + 3]
    else:
        c = p.lively(3 if form == "cycle3" else 2)
    other = c[1:] + c[:1] if form == "cycle3" else c[::-1]
    if form in ("pair_from", "connector_four_from"):
        w = p.t > p.onset()
    y = p.x.copy()
    for a, b in zip(c, other):
        p.x[w, a] = y[w, b]
    return c


def _offset(p, form):
    t, rng = p.t, p.rng
    begin = p.onset()
    w = (t > begin).astype(float)
    if form == "step":
        c = p.some(1)
        size = [rng.uniform(35, 60) * rng.choice([-1, 1])]
    elif form == "three_own":
        c = p.some(3)
        size = [rng.uniform(50, 160) * rng.choice([-1, 1]) for _ in c]
    elif form == "there_and_back":
        c, size = p.some(1), [-240.0]
        w = w * (t < begin + 0.25 * p.end)
    else:  # quick_ramp_two
        c, size = p.some(2), [90.0, 130.0]
        w = np.clip((t - begin) / 0.15, 0, 1)
    for k, a in zip(c, size):
        p.x[:, k] += (0.35 if p.still else 1) * a * w
    return c


def _drift(p, form):
    u = p.t / p.end
    if form == "random_walk":
        c = p.some(1)
        w = [_wander(p.rng, len(u), 6) * 110]
    elif form == "saturating_two":
        c, w = p.some(2), [x * (1 - np.exp(-u * 4)) for x in (90, -120)]
    elif form == "mid_linear":
        begin = p.rng.uniform(0.35, 0.55)
        c, w = p.some(1), [130 * np.clip(u - begin, 0, None) / (1 - begin)]
    elif form == "accelerating_three":
        c, w = p.some(3), [x * u**2.2 for x in (100, 140, -80)]
    elif form == "straight":
        c, w = p.some(1), [-70 * u]
    else:  # creeps_then_stays
        c, w = p.some(2), [x * np.clip((u - 0.25) / 0.3, 0, 1) ** 0.7 for x in (150, 105)]
    for k, a in zip(c, w):
        p.x[:, k] += (0.3 if p.still else 1) * a
    return c


def _warm_up(p, form):
    t, end, each = p.t, p.end, p.rng.uniform(0.7, 1.3, 19)
    if form == "exp":
        size, w = 170, 1 - np.exp(-t / (0.35 * end))
    elif form == "two_tau":
        size, w = 110, 0.6 * (1 - np.exp(-t / (0.1 * end))) + 0.4 * t / end
    elif form == "switched_on":
        size, w = 140, (t > 0.3 * end) * (1 - np.exp(-(t - 0.3 * end).clip(0) / (0.3 * end)))
    else:  # sqrt
        size, w = 80, np.sqrt(t / end)
    p.x += (0.3 if p.still else 1) * size * w[:, None] * each
    if p.tdc is not None:
        p.tdc = np.rint(p.tdc + 35 * np.interp(p.time, t, w))
    return ALL


def _temperature(p, form):
    if form == "warm_body_passes":
        t, end = p.time, p.end
        up = np.clip((t - 0.2 * end) / (0.3 * end), 0, 1) - np.clip((t - 0.55 * end) / (0.35 * end), 0, 1)
        p.tdc = np.rint(p.tdc + _lag(60 * up, 3.0, np.r_[0.01, np.diff(t)]))
    heat = p.tdc[p.start]
    heat = _lag(heat - heat[0], 0.3, 1 / p.rate)
    if form == "follow":
        share = p.rng.uniform(0.9, 1.2) * np.ones(19)
    elif form == "lagging_own":
        share, heat = p.rng.uniform(0.5, 1.6, 19), _lag(heat, 1.5, 1 / p.rate)
    elif form == "opposite":
        share = -p.rng.uniform(0.6, 1.1, 19)
    else:
        share = p.rng.uniform(1.2, 2.0, 19)
    p.x += heat[:, None] * share
    return ALL


def _fluid_loss(p, form):
    u, each = p.t / p.end, p.rng.uniform(0.6, 1.4, 19)
    if form == "linear":
        size, w = 150, u
    elif form == "accelerating":
        size, w = 220, u**1.8
    elif form == "under_pressure":
        flow = p.pressed[p.start] ** 2
        size, w = 200, np.cumsum(flow) / flow.sum()
    else:  # puncture
        size, w = 110, np.clip(u - 0.4, 0, None) / 0.6
    p.x -= size * w[:, None] * each
    return ALL


def _relaxation(p, form):
    step, c = 1 / p.pace, ALL
    if form == "overshoot":
        share, y = 0.45, _lag(p.x, 3.5, step)
    elif form == "creep":
        share, y = -0.4, _lag(p.x, 5.0, step)
    elif form == "creep_two_tau":
        share, y = -0.5, 0.5 * _lag(p.x, 0.9, step) + 0.5 * _lag(p.x, 9.0, step)
    else:  # overshoot_five
        c, share, y = p.lively(5), 0.5, _lag(p.x, 2.0, step)
    p.x[:, c] += share * (p.x[:, c] - y[:, c])
    return c


def _hysteresis(p, form):
    spread = p.rows.std(0)
    if form == "play":
        p.x += 0.8 * (_play(p.x, 0.35 * spread) - p.x)
    elif form == "three_plays":
        p.x += 0.9 * (sum(_play(p.x, k * spread) for k in (0.25, 0.6, 1.1)) / 3 - p.x)
    elif form == "falling_larger":
        step = 1 / p.pace
        press = _lag(p.pressed[p.start], 0.08, step)
        falls = (np.gradient(_lag(press, 0.15, step)) < 0).astype(float) - 0.5
        p.x += 2 * 0.35 * 0.8 * _lag(falls, 0.12, step)[:, None] * (p.x - p.rest)
    else:  # wide_six
        c = p.lively(6)
        y = _play(p.x, spread)
        p.x[:, c] = y[:, c] + 0.1 * (p.x[:, c] - y[:, c])
        return c
    return ALL


def _latency(p, form):
    i, c = np.arange(len(p.rows)), ALL
    if form == "constant_12":
        late = np.full(len(i), 12)
    elif form == "constant_35":
        late = np.full(len(i), 35)
    elif form == "buffer_from":
        late = np.clip(i - int(0.45 * len(i)), 0, 25)
    else:  # four
        late, c = np.full(len(i), 30), p.lively(4)
    was = p.before[np.maximum(p.first_row + i - late, 0)]
    p.x = p.rows.copy()
    p.x[:, c] = was[:, c]
    p.of = p.start = i
    p.t, p.pace = p.time, p.rate
    return c


def _low_pass(p, form):
    step, c = 1 / p.pace, ALL
    if form == "one_slow":
        c, y = p.lively(1), _lag(p.x, 1 / (2 * np.pi * 0.8), step)
    elif form == "all":
        y = _lag(p.x, 1 / (2 * np.pi * 3.0), step)
    elif form == "second_order_from":
        c = p.lively(3)
        y = lfilter(*butter(2, 2.0 / (p.pace / 2)), p.x - p.x[0], axis=0) + p.x[0]
        before = p.t < p.onset()
        y[before] = p.x[before]
    else:  # boxcar_two
        c, k = p.lively(2), 31
        total = np.cumsum(np.r_[np.repeat(p.x[:1], k, 0), p.x], 0)
        y = (total[k:] - total[:-k]) / k
    p.x[:, c] = y[:, c]
    return c


def _noise(p, form):
    rng, n, c = p.rng, len(p.x), ALL
    if form == "one_white":
        c, size = p.some(1), 4.0
        w = rng.normal(size=(n, 1))
    elif form == "all_white":
        size, w = 2.2, rng.normal(size=(n, 19))
    elif form == "two_from":
        c, size = p.some(2), 5.0
        w = rng.normal(size=(n, 2)) * (p.t > p.onset())[:, None]
    elif form == "one_flicker":
        c, size = p.some(1), 6.0
        f = np.fft.rfftfreq(n)
        f[0] = 1
        f = np.maximum(f, 0.2 / p.pace)
        w = np.fft.irfft(np.fft.rfft(rng.normal(size=n)) / np.sqrt(f), n)
        w = (w / w.std())[:, None]
    else:  # three_growing
        c, size = p.some(3), 6.0
        w = rng.normal(size=(n, 3)) * (p.t / p.end)[:, None]
    p.x[:, c] += size * p.noise[c] * w
    return c


def _line_noise(p, form):
    t, c, turn = p.t, ALL, 2 * np.pi
    if form == "mains_60":
        wave = [2.2 * p.noise[k] * np.sin(turn * 60.0 * t + 60.0 * k * turn * 5e-4) for k in c]
    elif form == "motor_one":
        c = p.some(1)
        wave = [3.5 * p.noise[k] * np.sin(turn * 23.4 * t) for k in c]
    elif form == "railway_weak":
        wave = [max(1.3 * p.noise[k], 1.7) * np.sin(turn * 16.7 * t + 0.4 * k) for k in c]
    elif form == "fan_five":
        c = p.some(5)
        phase = turn * 31.0 * t + 1.2 * np.sin(turn * 0.13 * t)
        wave = [3 * p.noise[k] * (np.sin(phase) + 0.3 * np.sin(0.5 * phase)) for k in c]
    else:  # harmonic_from
        shape = np.sin(turn * 9.6 * t) + 0.4 * np.sin(2 * turn * 9.6 * t + 0.7)
        wave = [2.5 * p.noise[k] * shape * (t > 0.35 * p.end) for k in c]
    for k, w in zip(c, wave):
        p.x[:, k] += w
    return c


def _cross_talk(p, form):
    y, w = p.x.copy(), 1.0
    if form == "one":
        c = [k for k in p.lively(8) if k > 0]
        c, share = [max(c, key=lambda k: p.rows[:, k - 1].std() / p.rows[:, k].std())], 0.3
    elif form == "mixing":
        for k in ALL[1:]:
            p.x[:, k] = y[:, k] + 0.18 * (y[:, k - 1] - y[:, k])
        return ALL[1:]
    elif form == "four_from":
        c, share = [k for k in p.some(6) if k > 0][:4], 0.35
        w = (p.t > p.onset()).astype(float)
    else:  # negative
        c, share = ALL[1:], -0.15
    for k in c:
        p.x[:, k] = y[:, k] + w * share * (y[:, k - 1] - p.rest[k - 1])
    return c


def _quantisation(p, form):
    x = p.log()
    if form == "three_bits":
        x[:] = np.floor(x / 8) * 8
    elif form == "two_bits_rounded":
        x[:] = np.rint(x / 4) * 4
    elif form == "four_by_16":
        c = p.lively(4)
        x[:, c] = np.floor(x[:, c] / 16) * 16 + 7
        return c
    else:  # tens_from
        row = int(0.4 * len(x))
        x[row:] = np.rint(x[row:] / 10) * 10
    return ALL


def _saturation(p, form):
    def level(k, percent):
        return float(np.percentile(p.x[:, k], percent))

    if form == "low_one":
        c = p.lively(1)
        p.x[:, c] = np.maximum(p.x[:, c], level(c[0], 18))
    elif form == "one_ceiling":
        top = float(np.percentile(p.x.max(1), 45))
        c = [int(k) for k in np.flatnonzero((p.x > top).mean(0) > 0.002)]
        p.x = np.minimum(p.x, top)
    elif form == "moved_up":
        c = p.lively(1)
        p.x[:, c] += 4095 - level(c[0], 70)
    elif form == "own_ceilings":
        c = p.lively(3)
        for k in c:
            p.x[:, k] = np.minimum(p.x[:, k], level(k, 75))
    else:  # low_two_from
        c = p.lively(2)
        w = p.t > p.onset(0.25, 0.45)
        for k in c:
            p.x[w, k] = np.maximum(p.x[w, k], level(k, 35))
    p.x = _counts(p.x)
    return c


def _stuck(p, form):
    begin = p.onset()
    w = p.t > begin
    if form == "zero_throughout":
        c = p.some(1)
        p.x[:, c] = 0
    elif form == "full_two_from":
        c = p.some(2)
        p.x[np.ix_(w, c)] = 4095
    elif form == "median_throughout":
        c = p.some(1)
        p.x[:, c] = np.rint(np.median(p.x[:, c]))
    else:  # last_from, interval
        c = p.some(1)
        if form == "interval":
            w &= p.t < begin + 0.28 * p.end
        p.x[w, c[0]] = p.x[np.argmax(w), c[0]]
    return c


def _spikes(p, form):
    x, rng = p.log(), p.rng
    n = len(x)
    number = max(4, int(n * rng.uniform(0.002, 0.005)))
    rows, c = rng.choice(np.arange(5, n - 5), number, replace=False), ALL
    if form == "one":
        c = p.some(1)
        x[rows, c[0]] += rng.choice([-1, 1], number) * rng.uniform(120, 500, number)
    elif form == "rows_of_all":
        size = (rng.choice([-1, 1], number) * rng.uniform(80, 250, number))[:, None]
        x[rows] += size * rng.uniform(0.6, 1.2, (1, 19))
    elif form == "bits":
        each = rng.integers(0, 19, number)
        for i, k in zip(rows, each):
            x[i, k] = int(x[i, k]) ^ int(rng.choice([256, 512, 1024, 2048]))
        c = sorted({int(k) for k in each})
    else:  # zeros_of_three
        c = p.some(3)
        x[rows, np.array(c)[rng.integers(0, 3, number)]] = 0
    p.rows = _counts(x)
    return c


def _lost(p, form):
    n, rng = len(p.log()), p.rng
    keep = np.ones(n, bool)
    if form == "single":
        keep[rng.random(n) < 0.03] = False
    elif form == "five_gaps":
        for row in rng.integers(50, n - 200, 5):
            keep[row : row + int(rng.integers(15, 70))] = False
    elif form == "every_64th":
        keep[63::64] = False
    elif form == "one_gap":
        row = int(0.45 * n)
        keep[row : row + 260] = False
    else:  # quarter_from
        row = int(0.5 * n)
        keep[row:][(rng.random(n) < 0.25)[row:]] = False
    keep[[0, -1]] = True
    rows = np.flatnonzero(keep)
    p.keep(rows)
    p.gaps = list(np.flatnonzero(np.diff(rows) > 1) + 1)
    return ALL


def _held(p, form):
    n = len(p.log())
    i = np.arange(n)
    if form == "fourteen":
        for row in p.rng.integers(50, n - 60, 14):
            i[row : row + int(p.rng.integers(8, 30))] = row
    elif form == "every4":
        i = i // 4 * 4
    elif form == "every6_from":
        row = int(0.5 * n)
        i[row:] = row + (i[row:] - row) // 6 * 6
    else:  # one_180
        row = int(0.4 * n)
        i[row : row + 180] = row
    p.rows = p.rows[i]
    if form == "fourteen" and p.force is not None:
        p.force = p.force[i]
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
    for _ in range(2):
        begin = p.rng.uniform(0.1, 0.6) * p.end
        for j, k in enumerate((6, 7, 8, 9, 16)):
            p.x[:, k] -= p.rng.uniform(90, 200) * np.exp(-0.5 * ((p.t - begin - j * 1.1) / 0.7) ** 2)


def _contact(p):
    k, open_, w = p.lively(1)[0], False, np.zeros(len(p.x), bool)
    for i in range(len(w)):
        if p.rng.random() < (0.08 if open_ else 0.006):
            open_ = not open_
        w[i] = open_
    p.x[w, k] = 3900 + 60 * p.rng.normal(size=w.sum())


def _knock(p):
    share = p.rng.uniform(0.5, 1.3, 19) * p.rng.choice([-1, 1], 19)
    for begin in p.rng.uniform(0.1, 0.9, 4) * p.end:
        d = (p.t - begin).clip(0)
        ring = p.rng.uniform(90, 200) * np.exp(-d / 0.25) * np.sin(2 * np.pi * 9 * d)
        p.x += (p.t > begin)[:, None] * ring[:, None] * share


def _modulated(p):
    p.x = p.rest + (p.x - p.rest) * (1 + 0.45 * np.sin(2 * np.pi * p.t / 7.0))[:, None]


def _halves(p):
    half = len(p.x) // 2
    p.x = np.r_[p.x[half:], p.x[:half]]


def _alias(p):
    c, rng = p.some(6), p.rng
    for begin in rng.uniform(0.05, 0.9, 6) * p.end:
        long, f = rng.uniform(0.8, 2.0), rng.uniform(5, 40)
        d = p.t - begin
        w = (d > 0) & (d < long)
        sweep = np.sin(2 * np.pi * (f * d[w] - 0.5 * f / long * d[w] ** 2)) * np.sin(np.pi * d[w] / long)
        for k in c:
            p.x[w, k] += 6 * p.noise[k] * sweep


def _rub(p):
    shake = lfilter(*butter(2, [3 / (p.pace / 2), 14 / (p.pace / 2)], "band"), p.rng.normal(size=len(p.x)))
    shake *= np.sqrt(np.clip(np.sin(2 * np.pi * p.t / 6.3 + 1), 0, 1)) / shake.std()
    p.x += shake[:, None] * p.rng.uniform(15, 45, 19) * p.rng.choice([-1, 1], 19)


def _reverse(p):
    p.x = p.x[::-1].copy()


def _popcorn(p):
    for k in p.some(2):
        state, w = 0, np.zeros(len(p.x))
        for i in range(len(w)):
            if p.rng.random() < 0.025:
                state = 1 - state
            w[i] = state
        p.x[:, k] += w * (9 * p.noise[k] + 10)


def _pulse(p):
    beat = np.cumsum(1.15 * (1 + 0.04 * _wander(p.rng, len(p.x), 40)) / p.pace) % 1
    wave = np.exp(-0.5 * ((beat - 0.2) / 0.07) ** 2) + 0.35 * np.exp(-0.5 * ((beat - 0.48) / 0.08) ** 2)
    p.x += wave[:, None] * (p.rng.uniform(4, 7, 19) * np.maximum(p.noise, 3))


def _dead(p):
    d, y = 0.6 * p.rows.std(0), p.x - p.rest
    y = np.sign(y) * np.maximum(np.abs(y) - d, 0)
    p.x = p.rest + y + p.rng.normal(size=y.shape) * p.noise * 0.6


def _missing_codes(p):
    p.x = p.x + 24 * (np.floor(p.x / 128) % 2)


def _wrap(p):
    k = p.lively(1)[0]
    p.x[:, k] = (p.x[:, k] - np.percentile(p.x[:, k], 40)) % 2048


def _dips(p):
    for begin in p.rng.uniform(0.05, 0.95, 9) * p.end:
        d = p.t - begin
        p.x *= (1 - 0.12 * ((d > 0) & (d < p.rng.uniform(0.15, 0.5))))[:, None]


def _splice(p):
    half, n = int(0.5 * len(p.x)), len(p.x)
    row = int(p.rng.integers(0, len(p.other) - n))
    p.x[half:] = p.other[row : row + n - half]


def _slow(p):
    t, end = p.t, p.end
    at = np.where(t < 0.75 * end, 0.35 * end + (t - 0.35 * end) * 0.4, 0.51 * end + (t - 0.75 * end))
    at = np.where(t < 0.35 * end, t, at)
    p.x = np.stack([np.interp(at, t, v) for v in p.x.T], 1)


def _tare(p):
    part = (p.t // 4.5).astype(int)
    for j in range(part.max() + 1):
        p.x[part == j] += p.rest - p.x[part == j][:8].mean(0)


def _gain_control(p):
    y = p.x - p.rest
    size = np.sqrt(_lag((y**2).mean(1), 2.0, 1 / p.pace))
    p.x = p.rest + y * (180 / np.maximum(size, 25))[:, None]


def _echo(p):
    k, y = int(1.6 * p.pace), p.x - p.x[0]
    p.x[k:] += 0.45 * y[:-k]


def _discharges(p):
    for begin in p.rng.uniform(0.1, 0.9, 5) * p.end:
        fall = (p.t > begin) * np.exp(-(p.t - begin).clip(0) / 0.6)
        p.x += fall[:, None] * p.rng.uniform(-260, 60, 19)


def _stick_slip(p):
    n = len(p.x)
    size = np.where(np.isin(np.arange(19), [6, 7, 8, 9, 10, 0, 16]), p.rng.uniform(30, 90, 19), 0)
    tooth = np.cumsum(p.rng.uniform(1.2, 3.2, n) * (1 + 0.5 * _wander(p.rng, n, 20)) / p.pace) % 1
    p.x += (tooth * (np.sin(2 * np.pi * p.t / 11.0) > 0))[:, None] * size


def _companded(p):
    y = (p.x - p.rest) / 1200.0
    p.x = p.rest + 1200 * np.sign(y) * np.log1p(12 * np.abs(y)) / np.log(13)


def _coupled(p):
    p.x = p.rest + p.x - _lag(p.x, 1.2, 1 / p.pace)


def _clock(p):
    p.log()
    p.time = p.time.copy()
    p.time[int(0.55 * len(p.time)) :] -= 7.25


OUTSIDE = {
    "bubble": _bubble,
    "contact": _contact,
    "knock": _knock,
    "am": _modulated,
    "halves": _halves,
    "alias": _alias,
    "rub": _rub,
    "reverse": _reverse,
    "popcorn": _popcorn,
    "pulse": _pulse,
    "dead": _dead,
    "inl": _missing_codes,
    "wrap": _wrap,
    "brown": _dips,
    "splice": _splice,
    "slow": _slow,
    "tare": _tare,
    "agc": _gain_control,
    "echo": _echo,
    "esd": _discharges,
    "stick": _stick_slip,
    "mulaw": _companded,
    "ac": _coupled,
    "clock": _clock,
}


# ---------------------------------------------------------------- the plan


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base, with +f at its end where the file has the force; first: row of the source; rows;
    drawn: numbers taken from the author's stream before its effects, and half of one that was left over, or
    None, of an untouched one None; effects: of (kind, form), the author's names, of one outside the catalogue
    (kind, "")."""

    name: str
    base: str
    first: int
    rows: int
    drawn: tuple | None
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
    """171 pieces: singles, pairs, outside the catalogue, untouched. The author's two of logs that were tared
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
    if spec.effects[:1] == (("splice", ""),):
        other = _source(folder, "F2" if kind == "F1" else "F1").x
    source = _source(folder, name)
    p = _Piece(source, spec.first, spec.rows, spec.base.endswith("+f"), spec.stream(), other)
    clean, channels, noise = p.rows.copy(), [], p.noise
    for effect, form in spec.effects:
        if spec.outside:
            OUTSIDE[effect](p)
            channels.append(ALL)
        else:
            channels.append(LAWS[effect](p, form))
    counts, seen = _counts(p.log()), []
    if spec.effects and counts.shape == clean.shape:
        seen = [float(np.sqrt(((counts - clean) ** 2).mean(0) / noise**2).max())]
    case = {
        "base": f"eleventh {kind}",
        "counts": counts,
        "rate": p.rate,
        "force": None if p.force is None else np.array([[float(f"{v:.6g}") for v in r] for r in p.force]),
        "tdc": p.tdc,
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
    (1, "phac/steel_vase_702_03/F1", 0, 1000, None),
    (2, "F2+f", 5484, 5200, (8626, 1274494916), ("hysteresis", "play")),
    (3, "F1", 15200, 1500, None),
    (4, "F2+f", 124, 3516, (184054, None), "halves"),
    (5, "U", 13121, 3400, (66239, None), ("line_noise", "harmonic_from")),
    (6, "F2+f", 15362, 3600, (9715, None), ("low_pass", "all")),
    (7, "U", 63, 2000, (68191, None), ("spikes", "one")),
    (8, "F2+f", 7363, 5200, (9471, None), ("latency", "four")),
    (9, "U", 3837, 2300, (66973, None), ("quantisation", "two_bits_rounded")),
    (
        10,
        "phac/steel_vase_702_02/F1",
        0,
        1000,
        (21, None),
        ("temperature", "lagging_own"),
        ("stuck", "median_throughout"),
    ),
    (11, "F1+f", 18531, 3600, (9111, None), ("latency", "constant_12")),
    (12, "F1+f", 9600, 1500, None),
    (13, "F1+f", 8452, 3542, (186822, 2595823963), "reverse"),
    (14, "F1", 18101, 4300, (179212, None), ("cross_talk", "four_from"), ("spikes", "rows_of_all")),
    (15, "F2+f", 20831, 2818, (236598, None), "slow"),
    (16, "F2", 158, 5000, (8501, None), ("relaxation", "overshoot_five")),
    (17, "phac/acrylic_211_01/F1", 0, 1000, (7008, None), ("drift", "straight")),
    (18, "F1", 11100, 1800, None),
    (19, "U", 1500, 1500, None),
    (20, "F1", 16373, 4500, (565, None), ("gain", "fading_three")),
    (21, "phac/steel_vase_702_04/F1", 0, 1000, (42, 1482206782), ("temperature", "follow")),
    (22, "F2", 13412, 4400, (1418, 2254095377), ("permutation", "pair_from")),
    (23, "F1", 13639, 3566, (236097, None), "inl"),
    (24, "F2+f", 8137, 5000, (79363, None), ("gain", "sudden"), ("low_pass", "one_slow")),
    (25, "U", 18989, 3500, (75955, None), ("drift", "random_walk"), ("spikes", "one")),
    (26, "F1+f", 12900, 2300, None),
    (27, "F1+f", 0, 5600, (8746, 933367136), ("hysteresis", "three_plays")),
    (28, "F1", 15428, 3000, (9595, 1108345235), ("low_pass", "one_slow")),
    (29, "phac/acrylic_211_04/F1", 0, 1000, (65995, 2658677189), ("line_noise", "railway_weak")),
    (30, "U", 7609, 2400, (72876, 1836065012), ("held_samples", "one_180")),
    (31, "F1+f", 95, 7800, (689, 1293865414), ("gain", "first_two")),
    (32, "F2+f", 0, 1500, None),
    (33, "F1", 8848, 3300, (67217, 3769724419), ("saturation", "low_one")),
    (34, "F2+f", 19514, 4100, (67578, 748470809), ("saturation", "own_ceilings")),
    (35, "U", 20568, 1700, (67823, 3644681047), ("stuck", "last_from")),
    (36, "F2", 17248, 2200, (71382, 2695942145), ("lost_samples", "every_64th")),
    (37, "F1+f", 7336, 2600, (72622, 1400615312), ("held_samples", "fourteen")),
    (38, "F1+f", 10508, 3300, (9959, 2834128591), ("low_pass", "boxcar_two")),
    (39, "F1+f", 12424, 3000, (71257, 2032881387), ("lost_samples", "five_gaps")),
    (40, "F1+f", 3556, 2900, (67457, None), ("saturation", "moved_up")),
    (41, "U", 15422, 2900, (79486, 963039601), ("line_noise", "harmonic_from"), ("stuck", "last_from")),
    (42, "phac/car_sponge_101_05/F0", 0, 1000, None),
    (43, "F2", 9605, 8000, (179383, None), ("fluid_loss", "linear"), ("line_noise", "motor_one")),
    (44, "phac/acrylic_211_03/F0", 0, 1000, (72756, 2311386207), ("held_samples", "every6_from")),
    (45, "F1+f", 4176, 3900, (179523, 405429804), ("saturation", "low_one"), ("offset", "quick_ramp_two")),
    (46, "F1+f", 12315, 3800, (810, None), ("sign", "throughout")),
    (47, "F2", 18635, 4900, (180079, None), ("drift", "saturating_two"), ("lost_samples", "one_gap")),
    (48, "F1+f", 16700, 2700, None),
    (49, "U", 1950, 6600, (7129, 1876981447), ("drift", "creeps_then_stays")),
    (50, "F1", 11082, 2571, (236719, 1842325307), "tare"),
    (51, "phac/car_sponge_101_04/F1", 0, 1000, None),
    (52, "phac/acrylic_211_01/F0", 0, 1000, None),
    (53, "phac/acrylic_211_04/F0", 0, 1000, (1915, None), ("offset", "there_and_back")),
    (54, "F2", 7702, 2500, (67093, None), ("quantisation", "four_by_16")),
    (55, "F2", 17160, 6000, (323, 1519837184), ("gain", "slow_ramp")),
    (56, "U", 18285, 2478, (237301, 3046877598), "stick"),
    (57, "F2", 18280, 2667, (237080, None), "esd"),
    (58, "F1+f", 59, 2100, (67944, None), ("stuck", "zero_throughout")),
    (59, "F1+f", 18359, 4000, (8141, None), ("relaxation", "overshoot")),
    (60, "phac/acrylic_211_02/F1", 0, 1000, (68508, 3825664501), ("spikes", "zeros_of_three")),
    (61, "F2+f", 17244, 2584, (195360, 1788891691), "dead"),
    (62, "F2+f", 3889, 5700, (179646, 324180133), ("hysteresis", "play"), ("drift", "straight")),
    (63, "U", 1112, 2600, (1784, None), ("offset", "step")),
    (64, "U", 2238, 5600, (179888, 947128311), ("warm_up", "two_tau"), ("spikes", "bits")),
    (65, "F2", 3829, 4300, (67700, None), ("saturation", "low_two_from")),
    (66, "F1", 40, 3600, (56437, 3773989876), ("noise", "three_growing")),
    (67, "btd", 0, 2124, (7408, None), ("warm_up", "switched_on")),
    (68, "F2+f", 8682, 12000, (7863, None), ("fluid_loss", "under_pressure")),
    (69, "F2", 68, 7000, (7389, None), ("warm_up", "two_tau")),
    (70, "phac/steel_vase_702_05/F1", 0, 1000, None),
    (71, "F1", 14296, 8200, (7585, None), ("fluid_loss", "linear")),
    (72, "phac/car_sponge_101_01/F0", 0, 1000, (67097, 1284434779), ("quantisation", "tens_from")),
    (73, "F1+f", 59, 9000, (7250, None), ("warm_up", "exp")),
    (74, "phac/steel_vase_702_01/F1", 0, 1000, (43, 1482206782), ("temperature", "lagging_own")),
    (75, "btd", 0, 2124, None),
    (76, "phac/car_sponge_101_02/F1", 0, 1000, (7427, None), ("warm_up", "sqrt")),
    (77, "F2+f", 134, 4000, (66487, 1097774991), ("cross_talk", "mixing")),
    (78, "F1+f", 18221, 4205, (236477, None), "splice"),
    (79, "F1", 19400, 1500, None),
    (81, "F2+f", 404, 4600, (9231, None), ("latency", "constant_35")),
    (82, "phac/car_sponge_101_03/F1", 0, 1000, (51585, 3882136408), ("noise", "two_from")),
    (83, "F2", 6300, 1700, None),
    (84, "U", 7850, 4134, (184175, 1152752160), "alias"),
    (85, "F1+f", 17242, 2634, (183934, 1712329542), "am"),
    (86, "F2+f", 19045, 4600, (8261, None), ("relaxation", "creep")),
    (87, "F2+f", 21300, 2100, None),
    (88, "U", 10774, 2500, (68637, 3585658819), ("lost_samples", "single")),
    (89, "F1", 18288, 4200, (66359, None), ("cross_talk", "one")),
    (90, "F1+f", 12032, 4400, (179766, None), ("relaxation", "creep"), ("stuck", "zero_throughout")),
    (91, "F1+f", 8105, 5200, (1296, None), ("permutation", "pair")),
    (92, "F1", 17499, 5000, (1175, 2797812453), ("sign", "partial_two")),
    (93, "F2+f", 3100, 18000, None),
    (94, "U", 9484, 2800, (65874, None), ("line_noise", "mains_60")),
    (95, "F2", 17666, 6000, (8986, 3238966085), ("hysteresis", "wide_six")),
    (96, "U", 12136, 4712, (180201, None), "bubble"),
    (97, "F1", 12, 3672, (180334, 1649249918), "contact"),
    (98, "F1", 72, 5600, (1663, 3936862960), ("permutation", "connector_four_from")),
    (99, "F2", 9734, 3700, (67337, None), ("saturation", "one_ceiling")),
    (100, "U", 20200, 2300, None),
    (101, "F1+f", 13414, 4800, (8866, 666135993), ("hysteresis", "falling_larger")),
    (102, "phac/car_sponge_101_05/F1", 0, 1000, None),
    (103, "F1+f", 7924, 5100, (79882, 3763487183), ("latency", "constant_35"), ("noise", "all_white")),
    (104, "F1", 15235, 3300, (72996, 3602411337), ("offset", "three_own"), ("noise", "one_white")),
    (105, "F1+f", 5471, 7000, (8002, None), ("fluid_loss", "puncture")),
    (106, "F2", 2712, 2800, (72756, 2311386207), ("held_samples", "every4")),
    (107, "F1", 10314, 4800, (6763, 1877817811), ("drift", "saturating_two")),
    (108, "F1+f", 6318, 4200, (201, 1116957745), ("gain", "sudden")),
    (109, "F1", 20011, 2400, (68332, None), ("spikes", "rows_of_all")),
    (110, "U", 3000, 8400, None),
    (111, "F2+f", 5089, 2600, (11952, 3882136408), ("noise", "all_white")),
    (112, "F1+f", 13771, 4386, (241733, None), "mulaw"),
    (113, "F2", 9500, 7800, None),
    (114, "F2", 10314, 5200, (931, 2795670260), ("sign", "from_time")),
    (115, "F1+f", 2160, 6200, (9351, None), ("latency", "buffer_from")),
    (116, "F2+f", 13641, 3400, (71502, 1108264100), ("lost_samples", "one_gap")),
    (117, "F2+f", 7010, 3601, (236839, None), "agc"),
    (118, "F2+f", 1, 4200, (179087, 1681626497), ("sign", "throughout"), ("lost_samples", "five_gaps")),
    (119, "phac/acrylic_211_02/F0", 0, 1000, None),
    (120, "F2+f", 8000, 1500, None),
    (121, "phac/car_sponge_101_01/F1", 0, 1000, (7446, None), ("temperature", "warm_body_passes")),
    (122, "F2+f", 17300, 2500, None),
    (123, "U", 15700, 1500, None),
    (124, "U", 88, 3085, (236339, 2768930463), "brown"),
    (125, "F1+f", 0, 6200, None),
    (126, "F2", 15771, 4400, (66733, None), ("cross_talk", "negative")),
    (128, "phac/car_sponge_101_04/F0", 0, 1000, None),
    (129, "phac/acrylic_211_05/F1", 0, 1000, (71502, 1108264100), ("lost_samples", "quarter_from")),
    (130, "F2", 21048, 2400, (65994, None), ("line_noise", "motor_one")),
    (131, "F2+f", 49, 4600, (1052, None), ("sign", "three")),
    (132, "F1+f", 13070, 5200, (66607, 1608820951), ("cross_talk", "four_from")),
    (133, "phac/steel_vase_702_04/F0", 0, 1000, (62, 1482206782), ("temperature", "opposite")),
    (134, "F1+f", 20900, 1500, None),
    (135, "F1", 9051, 5200, (8381, None), ("relaxation", "creep_two_tau")),
    (136, "phac/acrylic_211_03/F1", 0, 1000, None),
    (137, "F2+f", 10801, 6400, (7006, 184836535), ("drift", "accelerating_three")),
    (138, "U", 16667, 3800, (6884, None), ("drift", "mid_linear")),
    (139, "F2+f", 2172, 2470, (241854, 2452055663), "ac"),
    (140, "phac/car_sponge_101_02/F0", 0, 1000, (68070, 1126752854), ("stuck", "median_throughout")),
    (141, "F2", 13, 2700, (68068, None), ("stuck", "interval")),
    (142, "F1+f", 7810, 2600, (66115, 3995628282), ("line_noise", "fan_five")),
    (143, "F2+f", 3000, 3300, None),
    (144, "F2+f", 4696, 6200, (1540, None), ("permutation", "cycle3")),
    (145, "F1", 13815, 3600, (2037, 4282603596), ("offset", "quick_ramp_two")),
    (146, "F1", 4811, 2891, (184319, 2130609814), "rub"),
    (147, "F1", 6200, 3400, None),
    (148, "F2", 10615, 2464, (236218, 3791948995), "wrap"),
    (149, "F2+f", 14188, 1800, (68499, None), ("spikes", "bits")),
    (150, "F1+f", 17, 4700, (79607, None), ("permutation", "pair"), ("held_samples", "fourteen")),
    (151, "U", 8629, 5200, (2159, None), ("drift", "random_walk")),
    (152, "F2", 1500, 1500, None),
    (153, "U", 44, 2200, (10080, None), ("noise", "one_white")),
    (154, "F2+f", 4154, 5200, (445, 3774553677), ("gain", "first_one")),
    (155, "F2", 17558, 6100, (79743, 1569038809), ("warm_up", "exp"), ("quantisation", "three_bits")),
    (156, "U", 17200, 3000, None),
    (157, "F2", 11260, 3800, (9835, None), ("low_pass", "second_order_from")),
    (158, "U", 11400, 4300, None),
    (159, "F1+f", 5592, 1900, (66853, None), ("quantisation", "three_bits")),
    (160, "F2+f", 20230, 3400, (1907, None), ("offset", "three_own")),
    (161, "F2", 19800, 1500, None),
    (162, "phac/steel_vase_702_05/F0", 0, 1000, None),
    (163, "F1+f", 3682, 4818, (236960, 410169156), "echo"),
    (164, "F2", 13398, 3998, (241974, None), "clock"),
    (165, "U", 0, 1500, None),
    (166, "U", 13482, 9000, (7724, None), ("fluid_loss", "accelerating")),
    (167, "btd", 0, 2124, (67946, 2928608833), ("stuck", "full_two_from")),
    (168, "phac/acrylic_211_05/F0", 0, 1000, None),
    (169, "F2", 13079, 4092, (186942, None), "popcorn"),
    (170, "F2+f", 4566, 4161, (183777, 434096682), "knock"),
    (171, "U", 6045, 3000, (53751, None), ("noise", "one_flicker")),
    (172, "phac/steel_vase_702_02/F0", 0, 1000, (194196, None), "pulse"),
    (173, "phac/car_sponge_101_03/F0", 0, 1000, None),
)
