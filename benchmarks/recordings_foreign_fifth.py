"""Pieces of recordings of real sensors with one or two hidden effects, by a fifth author: a blind test.

    plan() -> list of dicts (id, base, kinds)
    make(id, data) -> Piece (case: fields of recordings_foreign.Case; clean (n, 19): without what is hidden)
    describe(id, data) -> dict for a row: what is hidden, whether a careful person sees it

Numpy and scipy alone. Names of bases and effects are those of the benchmark's vocabulary. Everything is
seeded by the piece's id. Sizes are in counts, seconds or shares that a fault may have; where the number
`see` says that nobody would see it in a plot, the size grows by half, three times at most; what is still
below 1 is not `detectable`.
"""

import functools
import gzip
import pathlib
import zlib
from dataclasses import dataclass, field

import numpy as np
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import butter, lfilter, sosfilt, sosfilt_zi

ALL = list(range(19))
LATE = ("quantise", "spikes", "stuck", "freeze", "dither", "saturate")  # after what changes the signal itself
RING = [0, 1, 2, 3, 4, 5, 15, 14, 13, 12, 11, 10]  # E1-E6 on one side, E11-E16 on the other
SIDES = ([0, 1, 2, 3, 4, 5], [10, 11, 12, 13, 14, 15])
TIP = [6, 7, 8, 9, 16]


# ---------------------------------------------------------------- recordings


def _text(path):
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        return np.loadtxt(file)


@functools.cache
def _pressed(data, which):
    """counts (n, 19), force (n, 3)"""
    if which == "F1":
        return _text(data / "epfl_flat_press/SynImpF1.txt"), _text(data / "epfl_flat_press/ForceData.txt")
    if which == "F2":
        counts, force = _text(data / "epfl_f2/SynImpF2.txt.gz"), _text(data / "epfl_f2/ForceData.txt.gz")
        n = min(len(counts), len(force))
        return counts[:n], force[:n]
    return _text(data / "epfl_flat_press/SynImpF2.txt"), None


@functools.cache
def _held(data, trial, finger):
    mat = loadmat(data / "phac_hold" / f"{trial}_HOLD.mat")
    return mat[f"F{finger}Electrodes"].T.astype(float), mat[f"F{finger}tdc"].ravel().astype(float)


@functools.cache
def _native(data):
    """SynTouch's log: lines of time, ids, channel (17: E1), ..., value, ..."""
    out, row = [], np.full(19, np.nan)
    with gzip.open(data / "btd/btsp_touch.btd.gz", "rt", errors="replace") as file:
        for line in file:
            parts = line.split()
            if len(parts) < 9 or not parts[0][0].isdigit():
                continue
            channel = int(parts[3])
            if channel == 17 and np.isfinite(row).all():
                out.append(row)
                row = np.full(19, np.nan)
            if 17 <= channel <= 35:
                row[channel - 17] = float(parts[8])
    return np.array(out)


@functools.cache
def _slid(data, name):
    with gzip.open(data / "slides_20" / f"{name}_bio.csv.gz", "rt") as file:
        lines = file.read().splitlines()[1:]
    return np.array([[float(v) for v in line.strip(",").split(",")][26:45] for line in lines])


@functools.cache
def _levels(data):
    """(19,) counts at rest and (19,) the sign of a change under load, of a pressed sensor."""
    counts, force = _pressed(data, "F1")
    load = np.abs(force[:, 2])
    low, high = load < np.quantile(load, 0.05), load > np.quantile(load, 0.7)
    rest = np.median(counts[low], 0)
    return rest, np.where(np.median(counts[high], 0) > rest, 1.0, -1.0)


TRIALS = [f"{o}_0{k}" for o in ("steel_vase_702", "acrylic_211", "car_sponge_101") for k in range(1, 6)]
SLIDES = ["mat7_1", "mat7_2", "mat12_1", "mat12_2", "mat15_1", "mat15_2", "mat18_1", "mat18_2", "mat20_1"]


@dataclass
class Context:
    """What an effect may know of its piece."""

    base: str
    rate: float
    counts: np.ndarray
    force: np.ndarray | None = None
    hidden_force: np.ndarray | None = None  # the force where the piece does not tell it
    tdc: np.ndarray | None = None
    before: np.ndarray | None = None  # rows before the piece
    loaded: bool = False
    repeat: int = 1
    rest: np.ndarray = field(default_factory=lambda: np.zeros(19))  # counts

    @property
    def n(self):
        return len(self.counts)

    @property
    def t(self):
        return np.arange(self.n) / self.rate


def _start(base, place, lively, data, rng):
    """A piece of a recording. base: F1, F2 (+f: with force), N, hold (:object), touch, slide, scrape
    (:finger); place: where, 0 to 1; lively: 40 s or more, of a varied load."""
    name = base.split(":")[0]
    if name.rstrip("f") in ("F1", "F2", "N"):
        counts, force = _pressed(data, name.rstrip("f"))
        rate = 118.0
        seconds = float(np.exp(rng.uniform(np.log(14), np.log(110))))
        if rng.random() < 0.1:
            seconds = rng.uniform(150, 185)
        if lively:
            seconds = float(np.exp(rng.uniform(np.log(40), np.log(130))))
        n = min(int(seconds * rate), len(counts) - 130)
        at = 120 + int(place * (len(counts) - n - 120))
        if lively:
            tried = [120 + int((place + j / 7) % 1 * (len(counts) - n - 120)) for j in range(4)]
            span = [
                np.ptp(np.quantile(np.linalg.norm(force[a : a + n], axis=1), [0.03, 0.97])) for a in tried
            ]
            at = next(a for a, s in zip(tried, span) if s >= 0.7 * max(span))
        piece = counts[at : at + n]
        f = None if force is None else force[at : at + n]
        if f is None:
            rest = np.median(piece, 0)
        else:
            load = np.abs(f[:, 2])
            rest = np.median(piece[load <= np.quantile(load, 0.06)], 0)
        return Context(
            "still" if name == "N" else "press",
            rate,
            piece.copy(),
            f.copy() if name.endswith("f") else None,
            f,
            None,
            counts[at - 120 : at],
            name != "N",
            1,
            rest,
        )
    if name == "hold":
        wanted = base.split(":")[1] if ":" in base else ""
        those = [(t, f) for f in (0, 1) for t in TRIALS if t.startswith(wanted)]
        trial, finger = those[int(place * len(those))]
        counts, tdc = _held(data, trial, finger)
        n = int(rng.integers(820, 1001))
        at = int(rng.integers(0, 1000 - n + 1))
        piece = counts[at : at + n].copy()
        return Context("grip", 100.0, piece, tdc=tdc[at : at + n].copy(), rest=np.median(piece, 0))
    if name == "touch":
        counts = _native(data)
        n = int(rng.integers(900, 1500))
        at = int(place * (len(counts) - n))
        piece = counts[at : at + n].copy()
        return Context("touch", 100.0, piece, rest=np.median(piece, 0))
    rest, sign = _levels(data)
    if name == "slide":
        piece = np.round(rest + sign * _slid(data, SLIDES[int(place * len(SLIDES))]))
        return Context("slide", 100.0, piece, rest=rest.copy())
    tared = _text(data / "scraping" / f"sense_R_{base.split(':')[1]}.txt.gz")
    return Context("scraped", 100.0, np.round(rest + tared)[::3], repeat=3, rest=rest.copy())


# ---------------------------------------------------------------- small tools


def _z(c):
    c = np.clip(c, 2, 4093)
    return np.log((4095 - c) / c)


def _c(z):
    return 4095 / (1 + np.exp(z))


def _dz(ctx, x):
    """(n, 19) change of ln Z from where the load is least"""
    return _z(x) - _z(ctx.rest)


def _load(ctx):
    f = ctx.force if ctx.force is not None else ctx.hidden_force
    return np.linalg.norm(f, axis=1)


def _on(ctx, rng, low=0.25, high=0.6):
    return int(ctx.n * rng.uniform(low, high))


def _smooth_step(ctx, at, seconds):
    return 1 / (1 + np.exp(-np.clip((np.arange(ctx.n) - at) / ctx.rate / max(seconds, 1e-3), -40, 40)))


def _lively(ctx, x, rng, take=7):
    """An electrode among those that swing most."""
    swing = np.quantile(x, 0.97, 0) - np.quantile(x, 0.03, 0)
    return int(rng.choice(np.argsort(swing)[-take:]))


def _some_one(ctx, x, rng):
    """Any electrode that is not near an end of the range."""
    level = np.median(x, 0)
    return int(rng.choice(np.flatnonzero((level > 400) & (level < 3750))))


def _noise_of(x):
    """(19,) of a row, from the differences of rows that change"""
    d = np.diff(x, axis=0)
    d = d[np.any(d != 0, axis=1)]
    if len(d) < 20:
        return np.full(19, 0.5)
    quiet = np.quantile(np.abs(d), 0.5, axis=0) * 1.4826 / np.sqrt(2)
    return np.maximum(quiet, 0.5)


def _episodes(ctx, rng, number, low, high, lead=0.1):
    """(n,) bool, that many stretches of low to high seconds, apart from each other"""
    on = np.zeros(ctx.n, bool)
    centres = np.linspace(lead, 1 - lead / 2, number + 1)
    for a, b in zip(centres[:-1], centres[1:]):
        length = min(rng.uniform(low, high) * ctx.rate, 0.8 * (b - a) * ctx.n)
        start = int(rng.uniform(a * ctx.n, b * ctx.n - length))
        on[start : start + int(length)] = True
    return on


# --------------------------------------------------- effects: (ctx, x, form, size, rng) -> x, channels


def warmup(ctx, x, form, size, rng):
    t, end = ctx.t, ctx.t[-1]
    if form == 0:  # just switched on
        law = 1 - np.exp(-t / (end * rng.uniform(0.25, 0.5)))
    elif form == 1:  # out of standby: the core first, then the fluid
        s = np.clip(t - end * rng.uniform(0.15, 0.35), 0, None)
        law = 0.45 * (1 - np.exp(-s / (0.06 * end))) + 0.55 * (1 - np.exp(-s / (0.4 * end)))
    else:  # a lamp beside it warms the finger: slow, fast, slow
        mid, half = end * rng.uniform(0.4, 0.6), end * rng.uniform(0.28, 0.4)
        law = 0.5 - 0.5 * np.cos(np.pi * np.clip((t - mid) / half / 2 + 0.5, 0, 1))
    each = 1 + 0.12 * rng.standard_normal(19)
    return _c(_z(x) - size * rng.uniform(0.14, 0.2) * law[:, None] * each), ALL


def fluidloss(ctx, x, form, size, rng):
    t, end = ctx.t, ctx.t[-1]
    s = np.clip(t - end * rng.uniform(0.1, 0.4), 0, None)
    if form == 0:  # a puncture: quick while the skin is tight, then ever slower
        law = 1 - 1 / (1 + s / (0.25 * end)) ** 2
    elif form == 1:  # it seeps into the glue: root of time
        law = np.sqrt(s / end)
    else:  # two squirts while somebody handles it, and it drips between them
        a, b = np.sort(rng.uniform(0.2, 0.85, 2))
        law = (
            0.4 * _smooth_step(ctx, a * ctx.n, 0.6) + 0.4 * _smooth_step(ctx, b * ctx.n, 0.9) + 0.2 * t / end
        )
    each = 0.85 + 0.3 * rng.random(19)
    each[TIP] += 0.15
    return _c(_z(x) + size * rng.uniform(0.16, 0.24) * law[:, None] * each), ALL


def count_offset(ctx, x, form, size, rng):
    t = ctx.t
    big = size * rng.uniform(45, 80) * rng.choice([-1, 1])
    if form == 0:  # the reference changes with a load on the supply
        return x + big * _smooth_step(ctx, _on(ctx, rng), 0.05)[:, None], ALL
    if form == 1:  # a converter's reference that breathes with a regulator
        period = ctx.t[-1] / rng.uniform(2.2, 4.5)
        wave = np.sin(2 * np.pi * t / period + rng.uniform(0, 6)) + 0.3 * np.sin(4 * np.pi * t / period + 1)
        return x + 0.8 * big * wave[:, None], ALL
    if form == 2:  # a full scale that settles to another value: a gain of the counts
        law = 1 - np.exp(-np.clip(t - ctx.t[-1] * rng.uniform(0.2, 0.5), 0, None) / rng.uniform(0.5, 2.5))
        return x * (1 + big / 2600 * law[:, None]), ALL
    law = np.clip((t / t[-1] - rng.uniform(0.2, 0.4)) / rng.uniform(0.15, 0.35), 0, 1)  # a ramp that ends
    return x + 1.2 * big * law[:, None], ALL


def thermal(ctx, x, form, size, rng):
    heat = gaussian_filter1d(ctx.tdc, 25, mode="nearest")
    if form in (1, 3):  # something warm (or cold) is brought near: the thermistor tells it
        s = np.clip(ctx.t - ctx.t[-1] * rng.uniform(0.2, 0.45), 0, None)
        event = (1 - np.exp(-s / rng.uniform(1.5, 4))) * rng.uniform(25, 50) * (1 if form == 1 else -1)
        ctx.tdc = np.round(ctx.tdc + event)
        heat = heat + event
    change = heat - heat[0]
    if form == 2:  # the fluid follows the thermistor by and by
        a = np.exp(-1 / (ctx.rate * rng.uniform(0.6, 1.2)))
        change = lfilter([1 - a], [1, -a], change)
    change = change / max(np.abs(change).max(), 1e-9)  # warmer liquid conducts better: the counts rise
    each = 1 + 0.15 * rng.standard_normal(19)
    return _c(_z(x) - size * rng.uniform(0.13, 0.2) * change[:, None] * each), ALL


def drift(ctx, x, form, size, rng):
    k = _some_one(ctx, x, rng)
    t, end = ctx.t, ctx.t[-1]
    big = size * rng.uniform(90, 220) * rng.choice([-1, 1])
    if form == 0:  # corrosion sets in
        law = np.clip(t / end - rng.uniform(0.15, 0.4), 0, None) ** 1.4
        law = law / law.max()
    elif form == 1:  # up and slowly back: a wet connector that dries
        s = np.clip(t / end - rng.uniform(0.1, 0.3), 0, None) / rng.uniform(0.12, 0.2)
        law = s * np.exp(1 - s)
    elif form == 2:  # it wanders
        a = np.exp(-1 / (ctx.rate * 0.18 * end))
        law = lfilter([1 - a], [1, -a], lfilter([1 - a], [1, -a], rng.standard_normal(ctx.n)))
        law = (law - law[0]) / np.abs(law - law[0]).max()
    else:  # two straight legs
        law = np.interp(t / end, [0, rng.uniform(0.3, 0.5), rng.uniform(0.6, 0.8), 1], [0, 0, 1, 0.55])
    y = x.copy()
    y[:, k] += big * law
    return y, [k]


def jump(ctx, x, form, size, rng):
    k = _some_one(ctx, x, rng)
    big = size * rng.uniform(80, 200) * rng.choice([-1, 1])
    at = _on(ctx, rng, 0.2, 0.7)
    law = np.zeros(ctx.n)
    if form == 0:  # a crack in a track
        law[at:] = 1
    elif form == 1:  # there and back
        law[at : at + int(ctx.n * rng.uniform(0.12, 0.25))] = 1
    elif form == 2:  # overshoots, then stays
        s = np.clip(np.arange(ctx.n) - at, 0, None) / ctx.rate
        law = (np.arange(ctx.n) >= at) * (1 + 0.7 * np.exp(-s / 0.25))
    else:  # a bigger step, then a part of the way back
        law[at:] = 1
        law[at + int(0.2 * ctx.n) :] = 0.4
    y = x.copy()
    y[:, k] += big * law
    return y, [k]


def gain(ctx, x, form, size, rng):
    k = _lively(ctx, x, rng)
    d = x[:, k] - ctx.rest[k]
    if form == 0:
        g = np.where(np.arange(ctx.n) >= _on(ctx, rng), 1 - min(0.85, 0.5 * size), 1.0)
    elif form == 1:  # fades over the whole of it
        g = np.interp(ctx.t / ctx.t[-1], [0, 0.2, 1], [1, 1, 1 - min(0.9, 0.65 * size)])
    elif form == 2:  # in two stretches
        g = np.where(
            _episodes(ctx, rng, 2, 0.15 * ctx.t[-1], 0.3 * ctx.t[-1]), 1 - min(0.85, 0.55 * size), 1.0
        )
    else:  # more than it was
        g = 1 + 0.6 * size * _smooth_step(ctx, _on(ctx, rng), 0.4)
    y = x.copy()
    y[:, k] = ctx.rest[k] + g * d
    return y, [k]


def flip(ctx, x, form, size, rng):
    k = _lively(ctx, x, rng, 6)
    d = x[:, k] - ctx.rest[k]
    if form == 0:
        on = np.arange(ctx.n) >= _on(ctx, rng)
    elif form == 1:
        on = _episodes(ctx, rng, 2, 0.15 * ctx.t[-1], 0.3 * ctx.t[-1])
    else:  # at first, then somebody turns the plug
        on = np.arange(ctx.n) < _on(ctx, rng, 0.35, 0.6)
    y = x.copy()
    y[on, k] = ctx.rest[k] - min(1.0, 0.8 * size) * d[on]
    return y, [k]


def swap(ctx, x, form, size, rng):
    a = _lively(ctx, x, rng, 9)
    level = np.median(x, 0)
    others = [k for k in ALL if k != a]
    if form == 1:  # of levels that are not far apart
        others = sorted(others, key=lambda k: abs(level[k] - level[a]))[3:8]
    b = int(rng.choice(others))
    if form == 2:
        on = np.arange(ctx.n) < _on(ctx, rng, 0.3, 0.6)
    elif form == 3:
        on = _episodes(ctx, rng, 1, 0.25 * ctx.t[-1], 0.45 * ctx.t[-1], 0.2)
    else:
        on = np.arange(ctx.n) >= _on(ctx, rng)
    y = x.copy()
    y[on, a], y[on, b] = x[on, b], x[on, a]
    return y, [a, b]


def crosstalk(ctx, x, form, size, rng):
    d = x - ctx.rest
    mix = np.zeros((19, 19))
    if form == 0:  # along the flex: neighbours of the row in which they lie
        for row in (SIDES[0], SIDES[1], TIP):
            for a, b in zip(row[:-1], row[1:]):
                mix[a, b] = mix[b, a] = rng.uniform(0.25, 0.4)
    elif form == 1:  # the multiplexer has not settled: a part of the channel before
        for k in ALL:
            mix[k, k - 1] = 0.42
            mix[k, k] = -0.42
    elif form == 2:  # two connectors, each with its own poor ground
        for group in (ALL[:10], ALL[10:]):
            mix[np.ix_(group, group)] = rng.uniform(0.08, 0.12)
    else:  # across the finger: what lies opposite
        for a, b in zip(*SIDES):
            mix[a, b], mix[b, a] = rng.uniform(0.3, 0.5, 2)
    on = (
        (np.arange(ctx.n) >= _on(ctx, rng, 0.2, 0.5))[:, None]
        if form != 2
        else _smooth_step(ctx, _on(ctx, rng), 1.0)[:, None]
    )
    moved = size * d @ mix.T
    return x + on * moved, [k for k in ALL if np.any(mix[k])]


def lowpass(ctx, x, form, size, rng):
    at = 0 if form == 1 else _on(ctx, rng, 0.25, 0.5)
    if form == 0:  # the driver averages from now on
        y = uniform_filter1d(
            x, int(ctx.rate * 0.35 * size), axis=0, mode="nearest", origin=int(ctx.rate * 0.17 * size)
        )
    elif form == 1:  # a capacitor too large
        a = np.exp(-1 / (ctx.rate * 0.3 * size))
        y = lfilter([1 - a], [1, -a], x - x[0], axis=0) + x[0]
    else:  # a filter of the second order
        sos = butter(2, 1.1 / size, fs=ctx.rate, output="sos")
        y, _ = sosfilt(sos, x, axis=0, zi=sosfilt_zi(sos)[:, :, None] * x[0])
    y[:at] = x[:at]
    return y, ALL


def hum(ctx, x, form, size, rng):
    noise = np.median(_noise_of(x))
    t, rate = ctx.t, ctx.rate
    if form == 0:  # mains, seen as it folds at this rate
        f = (50.0 + rng.uniform(-0.1, 0.1)) if rate > 101 else rng.choice([18.3, 23.7])
        wave = np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
        each = 0.6 + 0.8 * rng.random(19)
    elif form == 1:  # folded down to a slow beat
        f = rng.uniform(1.4, 3.2)
        wave = np.sin(2 * np.pi * f * t) + 0.25 * np.sin(6 * np.pi * f * t + 1)
        each = 0.7 + 0.6 * rng.random(19)
    else:  # a switched heater, as a filtered square wave
        f = rng.uniform(5, 8)
        p = 2 * np.pi * f * t
        wave = sum(np.sin((2 * k + 1) * p) / (2 * k + 1) for k in range(3))
        each = 0.6 + 0.8 * rng.random(19)
    return x + size * (2.6 * noise + 3) * (1.8 if ctx.loaded else 1) * wave[:, None] * each, ALL


def quantise(ctx, x, form, size, rng):
    step = {0: 16, 1: 32, 2: 25}[form] * (2 ** np.ceil(np.log2(size)) if form < 2 else size)
    if form == 0:  # the lower bits are lost
        return np.floor(x / step) * step, ALL
    if form == 1:  # from now on a converter of fewer bits
        on = np.arange(ctx.n) >= _on(ctx, rng, 0.2, 0.5)
        return np.where(on[:, None], np.floor(x / step) * step + step // 2, x), ALL
    return np.round(np.round(x / step) * step), ALL  # tens of millivolts in a text file


def stuck(ctx, x, form, size, rng):
    k = _some_one(ctx, x, rng)
    y = x.copy()
    at = _on(ctx, rng, 0.3, 0.65)
    if form == 0:  # a dead channel of the converter: its last value for ever
        y[at:, k] = np.round(x[at, k])
    elif form == 1:  # the wire breaks
        y[at:, k] = rng.choice([0, 4095])
    elif form == 2:  # it comes and goes
        on = _episodes(ctx, rng, 4, 0.06 * ctx.t[-1], 0.14 * ctx.t[-1])
        y[on, k] = 4095
    else:  # holds, for a good while, and comes back
        to = at + int(ctx.n * rng.uniform(0.2, 0.3))
        y[at:to, k] = np.round(x[at, k])
    return y, [k]


def saturate(ctx, x, form, size, rng):
    share = min(0.4, 0.2 * size)
    if form == 1:
        swing = np.quantile(x, 0.99, 0) - np.quantile(x, 1 - share, 0)
    else:
        swing = np.quantile(x, share, 0) - np.quantile(x, 0.01, 0)
    k = int(rng.choice(np.argsort(swing)[-5:]))
    swing = np.ptp(np.quantile(x, [0.02, 0.98], axis=0), axis=0)
    y = x.copy()
    s = x[:, k]
    if form == 0:  # cannot go lower
        y[:, k] = np.maximum(s, np.quantile(s, share))
    elif form == 1:  # cannot go higher
        y[:, k] = np.minimum(s, np.quantile(s, 1 - share))
    elif form == 2:  # a rounded lower end
        a, width = np.quantile(s, share), 0.05 * swing[k]
        y[:, k] = a + width * np.logaddexp(0, (s - a) / width)
    else:  # a diode: beyond it a tenth
        a = np.quantile(s, share)
        y[:, k] = np.where(s < a, a + 0.1 * (s - a), s)
    return y, [k]


def spikes(ctx, x, form, size, rng):
    k = _some_one(ctx, x, rng)
    y = x.copy()
    number = int(np.clip(ctx.t[-1] * rng.uniform(0.4, 0.9), 7, 30))
    at = np.sort(rng.choice(np.arange(10, ctx.n - 10), number, replace=False))
    high = size * rng.uniform(250, 700, number) * rng.choice([-1, 1], number)
    if form == 0:
        y[at, k] += high
    elif form == 1:  # static: it falls back within three rows
        for i, h in zip(at, high):
            y[i : i + 3, k] += np.abs(h) * np.array([1, 0.45, 0.2])
    elif form == 2:  # a wire that is open for a row
        y[at, k] = rng.choice([0.0, 4095.0])
    else:  # a bit that is read wrong
        y[at, k] = np.bitwise_xor(np.round(x[at, k]).astype(int), 512)
    return y, [k]


def _hold_rows(x, held):
    last = np.maximum.accumulate(np.where(held, 0, np.arange(len(x))))
    return x[last]


def freeze(ctx, x, form, size, rng):
    held = np.zeros(ctx.n, bool)
    if form == 0:  # the driver hangs, again and again
        held = _episodes(ctx, rng, int(np.clip(ctx.t[-1] / 5, 4, 9)), 0.8, min(2.2, 0.09 * ctx.t[-1]) * size)
    elif form == 1:  # once, for long
        at = _on(ctx, rng)
        held[at : at + int(ctx.n * 0.14 * size)] = True
    else:  # from now on every so manieth row is new
        at, k = _on(ctx, rng, 0.2, 0.5), int(rng.integers(12, 20) * size)
        i = np.arange(ctx.n)
        held = (i >= at) & ((i - at) % k != 0)
    return _hold_rows(x, held), ALL


def dither(ctx, x, form, size, rng):
    i = np.arange(ctx.n)
    if form == 0:  # read a few times a second, shown with a least bit that flickers
        k = int(rng.integers(12, 18) * size)
        y = _hold_rows(x, i % k != 0) + rng.integers(-1, 2, x.shape)
    elif form == 1:  # hangs for seconds while a display adds its own noise
        held = _episodes(ctx, rng, int(np.clip(ctx.t[-1] / 6, 4, 9)), 1.2, min(3.0, 0.12 * ctx.t[-1]) * size)
        y = np.where(held[:, None], _hold_rows(x, held) + 0.7 * rng.standard_normal(x.shape), x)
    else:  # refreshed after uneven times from now on
        held, j = np.zeros(ctx.n, bool), _on(ctx, rng, 0.15, 0.35)
        while j < ctx.n:
            k = int(rng.integers(9, 24) * size)
            held[j + 1 : j + k] = True
            j += k
        y = np.where(held[:, None], _hold_rows(x, held) + rng.integers(-1, 2, x.shape), x)
    return y, ALL


def lost(ctx, x, form, size, rng):
    """(n,) bool: rows that are kept; gaps lie where something moves"""
    n = ctx.n
    lengths = {
        0: rng.uniform(0.5, 1.2, 4),
        1: np.array([rng.uniform(2.0, 3.5)]),
        2: rng.uniform(0.25, 0.5, 9),
    }[form]
    lengths = np.maximum((lengths * size * ctx.rate).astype(int), 3)
    smooth = uniform_filter1d(x, 5, axis=0)
    keep = np.ones(n, bool)
    edge = int(0.06 * n)
    for m in lengths:
        step = np.sqrt(np.mean((smooth[m:] - smooth[:-m]) ** 2, axis=1))
        ok = np.zeros(n - m, bool)
        ok[edge : n - m - edge] = True
        for i in np.flatnonzero(~keep):
            ok[max(0, i - int(ctx.rate) - m) : i + int(ctx.rate)] = False
        if not ok.any():
            continue
        good = np.flatnonzero(ok & (step >= np.quantile(step[ok], 0.85)))
        i = int(rng.choice(good))
        keep[i : i + m] = False
    return keep, ALL


def noise(ctx, x, form, size, rng):
    k = _some_one(ctx, x, rng)
    own = _noise_of(x)[k]
    big = size * (rng.uniform(4, 8) * own + 8)
    at = _on(ctx, rng, 0.2, 0.5)
    if form == 0:  # a bad solder joint, from now on
        add = rng.standard_normal(ctx.n)
        add[:at] = 0
    elif form == 1:  # a telegraph: to and fro between two levels at uneven times
        flips = rng.random(ctx.n) < 0.08
        add = np.cumsum(flips) % 2 * 2.0 - 1
        add[:at] = 0
    elif form == 2:  # loud while something runs beside the wire
        add = rng.standard_normal(ctx.n) * _episodes(ctx, rng, 4, 0.07 * ctx.t[-1], 0.14 * ctx.t[-1])
    else:  # all along, and with a heavier tail
        add = rng.standard_t(4, ctx.n) * 0.8
    y = x.copy()
    y[:, k] += big * add
    return y, [k]


def common_noise(ctx, x, form, size, rng):
    own = np.median(_noise_of(x))
    big = size * (rng.uniform(2.2, 3.5) * own + 4)
    if form == 0:  # a noisy reference
        add, each = rng.standard_normal(ctx.n), np.ones(19)
    elif form == 1:  # with a memory of some rows, more on high counts
        a = 0.6
        add = lfilter([np.sqrt(1 - a * a)], [1, -a], rng.standard_normal(ctx.n))
        each = np.median(x, 0) / np.median(x)
    else:  # from now on, a switching supply
        add, each = rng.uniform(-1.7, 1.7, ctx.n), rng.uniform(0.8, 1.2, 19)
        add[: _on(ctx, rng, 0.2, 0.4)] = 0
    return x + big * add[:, None] * each, ALL


def latency(ctx, x, form, size, rng):
    whole = np.vstack([ctx.before, x])
    n0, n = len(ctx.before), ctx.n
    i = np.arange(n)
    if form == 0:  # a buffer
        late = np.full(n, size * rng.uniform(0.11, 0.2))
    elif form == 1:  # two clocks that part
        late = size * rng.uniform(0.3, 0.45) * i / n
    else:  # the buffer grows in the middle
        late = size * (0.05 + rng.uniform(0.15, 0.25) * (i >= _on(ctx, rng)))
    at = n0 + i - np.round(np.minimum(late * ctx.rate, n0 - 1)).astype(int)
    return whole[at], ALL


def relax(ctx, x, form, size, rng):
    dz, dt = _dz(ctx, x), 1 / ctx.rate
    part = min(0.75, size * rng.uniform(0.38, 0.5))
    first = dz[: int(0.3 * ctx.rate)].mean(0)  # what came before was as the first rows are

    def past(tau):
        a = np.exp(-dt / tau)
        return first + lfilter([1 - a], [1, -a], dz - first, axis=0)

    if form == 0:  # two Maxwell elements
        slow = 0.5 * past(rng.uniform(0.6, 1.2)) + 0.5 * past(rng.uniform(4, 8))
    elif form == 1:  # a stretched exponential, as a sum
        taus = np.geomspace(0.2, 20, 9)
        weights = taus**0.3
        weights /= weights.sum()
        slow = sum(w * past(s) for w, s in zip(weights, taus))
    else:  # the pore fluid: a single one, and not alike at the tip
        slow = past(rng.uniform(2, 4)) * (1 + 0.25 * np.isin(ALL, TIP))
    return _c(_z(ctx.rest) + dz - part * slow), ALL


def hyster(ctx, x, form, size, rng):
    """The change lags behind the load: a loop over the load, of the shape in which each electrode answers."""
    dz = _dz(ctx, x)
    f = gaussian_filter1d(_load(ctx), 0.06 * ctx.rate)
    answer = np.sqrt(np.mean(dz**2, axis=0)) * np.sign(np.mean(dz, axis=0))
    span = np.ptp(np.quantile(f, [0.02, 0.98]))
    df = np.diff(f, prepend=f[0])
    h = np.zeros(ctx.n)
    if form == 0:  # Bouc-Wen
        width = rng.uniform(0.22, 0.3) * span
        for i in range(1, ctx.n):
            h[i] = h[i - 1] + (df[i] - 0.6 * abs(df[i]) * h[i - 1] - 0.4 * df[i] * abs(h[i - 1])) / width
    elif form == 1:  # relays that switch at different loads
        low = np.sort(rng.uniform(f.min(), f.max() - 0.3 * span, 60))
        high = low + rng.uniform(0.2, 0.55, 60) * span
        state = np.where(f[0] > (low + high) / 2, 1.0, -1.0)
        for i in range(ctx.n):
            state = np.where(f[i] >= high, 1.0, np.where(f[i] <= low, -1.0, state))
            h[i] = state.mean()
        h = gaussian_filter1d(h, 0.05 * ctx.rate)
    else:  # Dahl, less of it where little is pressed
        width = rng.uniform(0.25, 0.35) * span
        for i in range(1, ctx.n):
            h[i] = np.clip(h[i - 1] + df[i] / width * (1 - np.sign(df[i]) * h[i - 1]) ** 1.3, -1, 1)
        h = h * np.clip(f / np.median(f), 0.2, 1.6)
    return _c(_z(ctx.rest) + dz + size * rng.uniform(0.35, 0.45) * answer * h[:, None]), ALL


# ---------------------------------------------------------------- outside the catalogue


def outside(ctx, x, form, size, rng):
    """At rest or held."""
    n, t, end = ctx.n, ctx.t, ctx.t[-1]
    if form == 0:  # a bubble that drifts past the electrodes of one side, over the tip and back on the other
        order = [*SIDES[0][::-1], 6, 7, 9, 8, *SIDES[1]]
        place = np.linspace(-3, len(order) + 1, n)
        y = x.copy()
        for j, k in enumerate(order):
            y[:, k] += size * 130 * np.exp(-0.5 * ((place - j) / 1.1) ** 2)
        return y, order
    if form == 1:  # the finger rocks: one side up, the other down
        f = rng.uniform(0.18, 0.4)
        w = (
            size
            * 70
            * np.sin(2 * np.pi * f * t + 2.2 * np.sin(2 * np.pi * 0.043 * t))
            * np.clip((t - 0.15 * end) / 2, 0, 1)
        )
        y = x.copy()
        y[:, SIDES[0]] += w[:, None] * rng.uniform(0.6, 1.3, 6)
        y[:, SIDES[1]] -= w[:, None] * rng.uniform(0.6, 1.3, 6)
        return y, [*SIDES[0], *SIDES[1]]
    if form == 2:  # a patch of skin creeps and lets go: saw teeth on some electrodes
        start = int(rng.integers(0, 6))
        who = [RING[(start + j) % 12] for j in range(6)]
        law, j = np.zeros(n), int(0.15 * n)
        while j < n:
            m = int(rng.uniform(0.08, 0.16) * n)
            law[j : j + m] = np.linspace(0, rng.uniform(0.6, 1.2), m)[: n - j]
            j += m
        y = x.copy()
        y[:, who] += size * 110 * law[:, None] * rng.uniform(0.5, 1.2, 6) * np.array([1, 1, -0.6, 1, -0.6, 1])
        return y, who
    if form == 3:  # gas at the electrodes: here and there some neighbours leap and fall back over seconds
        y, who = x.copy(), set()
        for _ in range(int(np.clip(end / 2.5, 6, 16))):
            at, start = int(rng.uniform(0.05, 0.92) * n), int(rng.integers(12))
            s = (np.arange(n) - at) / ctx.rate
            law = np.where(s >= 0, np.exp(-np.clip(s, 0, None) / rng.uniform(0.5, 1.6)), 0)
            for j in range(int(rng.integers(2, 5))):
                k = RING[(start + j) % 12]
                who.add(k)
                y[:, k] -= size * rng.uniform(60, 160) * law
        return y, sorted(who)
    if form == 4:  # two amplifiers, for odd and even electrodes, that see-saw
        law = np.sign(np.sin(2 * np.pi * t / (end / rng.uniform(4, 7)) + rng.uniform(0, 6)))
        law = gaussian_filter1d(law, 0.15 * ctx.rate)
        return x + size * 55 * law[:, None] * np.where(np.arange(19) % 2, 1.0, -1.0), ALL
    # a field from outside that turns about the finger: each electrode with its own phase, ever faster
    phase = 2 * np.pi * (0.12 * t + 0.5 * 0.25 * t**2 / end)
    y = x.copy()
    for j, k in enumerate(RING):
        y[:, k] += size * 65 * np.sin(phase - 2 * np.pi * j / 12) * np.clip(t / (0.2 * end), 0, 1)
    return y, RING


def outside_loaded(ctx, x, form, size, rng):
    n = ctx.n
    d = x - ctx.rest
    at = _on(ctx, rng, 0.2, 0.45)
    on = (np.arange(n) >= at)[:, None]
    if form == 0:  # an echo: what was sent a good second ago comes once more
        lag = int(ctx.rate * rng.uniform(1.0, 1.7))
        echo = np.vstack([np.zeros((lag, 19)), d[:-lag]])
        return x + on * size * 0.45 * echo, ALL
    if form == 1:  # a mount on a loose spring: it swings after every change of load
        f0, zeta = rng.uniform(1.8, 3.0), 0.06
        w, dt = 2 * np.pi * f0, 1 / ctx.rate
        a1, a2 = (
            2 * np.exp(-zeta * w * dt) * np.cos(w * dt * np.sqrt(1 - zeta**2)),
            -np.exp(-2 * zeta * w * dt),
        )
        swung = lfilter([1 - a1 - a2], [1, -a1, -a2], d - d[0], axis=0) + d[0]
        return np.where(on, x + min(1.0, 0.8 * size) * (swung - d), x), ALL
    if form == 2:  # buffers that are written from their end
        m, y = int(ctx.rate * rng.uniform(0.9, 1.4)), x.copy()
        starts = np.arange(at, n - m, m)
        for s in starts[rng.random(len(starts)) < min(0.9, 0.45 * size)]:
            y[s : s + m] = x[s : s + m][::-1]
        return y, ALL
    if form == 3:  # two converters take turns, and one answers more to load
        m = max(2, int(ctx.rate * 0.5))
        turn = np.where((np.arange(n) // m) % 2, 1.0, -1.0)[:, None]
        return x + on * size * 0.22 * turn * d, ALL
    if form == 4:  # five electrodes of a plug are short-circuited: all read what they have in common
        start = int(rng.integers(12))
        who = [RING[(start + j) % 12] for j in range(5)]
        y = x.copy()
        y[at:, who] = x[at:, who].mean(1, keepdims=True) + 0.08 * d[at:, who]
        return y, who
    if form == 5:  # beyond some load the fluid is pushed to one side and takes ten seconds to come back
        load = np.mean(np.abs(d), axis=1)
        hit = (load > np.quantile(load, 0.6)).astype(float)
        a, b = np.exp(-1 / (ctx.rate * 0.5)), np.exp(-1 / (ctx.rate * 9))
        m, level = np.zeros(n), 0.0
        for i in range(n):
            level = a * level + (1 - a) * hit[i] if hit[i] > level else b * level + (1 - b) * hit[i]
            m[i] = level
        m = (m - m.min()) * on[:, 0]
        dz = np.zeros((n, 19))
        dz[:, SIDES[0]] = size * 0.3 * m[:, None] * rng.uniform(0.6, 1.2, 6)
        dz[:, SIDES[1]] = -size * 0.3 * m[:, None] * rng.uniform(0.6, 1.2, 6)
        return _c(_z(x) + dz), [*SIDES[0], *SIDES[1]]
    if (
        form == 6
    ):  # each electrode answers to the product of load and its neighbour's answer: an overdriven stage
        unit = np.quantile(np.abs(d), 0.9, axis=0) + 20
        return x + on * size * 0.3 * d * np.roll(d / unit, 4, axis=1), ALL
    # the skin buckles under load: a ripple over the electrodes that runs with the load, not with time
    load = gaussian_filter1d(np.mean(np.abs(d), axis=1), 0.05 * ctx.rate)
    phase = 2 * np.pi * load / (0.22 * (np.quantile(load, 0.95) - load.min()) + 1)
    y = (
        x
        + on
        * size
        * 85
        * np.sin(phase[:, None] + 2 * np.pi * np.arange(19) / 5)
        * np.clip(load / np.median(load), 0, 1)[:, None]
    )
    return y, ALL


LAWS = {
    f.__name__: f
    for f in (
        *(warmup, fluidloss, count_offset, thermal, drift, jump, gain, flip, swap, crosstalk, lowpass, hum),
        *(
            quantise,
            stuck,
            saturate,
            spikes,
            freeze,
            lost,
            dither,
            noise,
            common_noise,
            latency,
            relax,
            hyster,
        ),
        *(outside, outside_loaded),
    )
}


# ---------------------------------------------------------------- whether a person sees it


def _others_say(x, k, extra=None):
    """RMS of what the other electrodes (and the force) leave of electrode k: what an eye takes for usual"""
    cols = [np.ones(len(x)), np.linspace(-1, 1, len(x))]
    a = np.column_stack([*cols, np.delete(x, k, axis=1)] + ([] if extra is None else [extra]))
    fit, *_ = np.linalg.lstsq(a, x[:, k], rcond=1e-8)
    return float(np.sqrt(np.mean((x[:, k] - a @ fit) ** 2)))


def see(kind, ctx, x, y, channels, keep=None, force=None):
    """1 or more: a careful person who plots the right channel (all of them, for what all share) sees it.

    Levels: the change, smooth over a quarter of a second (what is outside the catalogue: a twelfth), at its
    90 % quantile where it acts, over the largest of four times the noise of a row, twice what the other
    electrodes leave unexplained, a twentieth of the plot's height (the channel's 1 to 99 % range). What all
    share is set against how far the level wanders by itself. Texture: times the usual row-to-row change.
    Held and lost rows: seconds of them, and the step at their end against usual steps.
    """
    rate = ctx.rate
    own = _noise_of(x)
    if kind == "lost":
        cut = np.flatnonzero(np.diff(keep.astype(int)) == -1)
        step = []
        for i in cut:
            j = i + 1 + int(np.argmax(keep[i + 1 :]))
            step.append(np.sqrt(np.mean((x[j] - x[i]) ** 2)))
        usual = np.quantile(np.sqrt(np.mean(np.diff(x, axis=0) ** 2, axis=1)), 0.9)
        return float(np.max(step) / (3 * usual + 1e-9))
    d = y - x
    if kind in ("noise", "common_noise", "hum"):
        ratio = []
        for k in channels:
            if kind == "hum" or np.std(d[:, k]) > 0:
                on = np.abs(d[:, k]) > 0
                swing = np.quantile(x[:, k], 0.99) - np.quantile(x[:, k], 0.01)
                ratio.append(np.sqrt(np.mean(d[on, k] ** 2)) / max(1.3 * own[k] + 1.5, 0.008 * swing))
        return float(np.median(ratio))
    if kind == "spikes":
        k = channels[0]
        high = np.abs(d[:, k][np.abs(d[:, k]) > 20])
        swing = np.quantile(x[:, k], 0.99) - np.quantile(x[:, k], 0.01)
        return float(np.median(high) / max(8 * own[k], 0.1 * swing, 15)) if len(high) >= 4 else 0.0
    if kind == "quantise":
        step = np.median(
            [
                np.median(np.diff(np.unique(np.round(y[-len(y) // 3 :, k]))))
                for k in ALL
                if len(np.unique(y[-len(y) // 3 :, k])) > 1
            ]
        )
        swing = np.median(np.quantile(x, 0.99, 0) - np.quantile(x, 0.01, 0))
        return float(step / max(2.0 * np.median(own), 0.025 * swing, 4))
    if kind in (
        "freeze",
        "dither",
    ):  # rows that hold where the clean ones move, and by how much the trace leaves them
        quiet = np.abs(np.diff(y, axis=0)) <= (0 if kind == "freeze" else 3)
        was = np.abs(np.diff(x, axis=0)) <= (0 if kind == "freeze" else 3)
        share = quiet.mean() - was.mean()
        off = np.sqrt(np.mean(d**2)) / np.median(own)
        return float(min(share / 0.05, max(off / 1.2, np.median(own) / 1.5 if kind == "freeze" else 0)))
    if kind == "lowpass":
        on = np.flatnonzero(np.abs(d).sum(1) > 0)
        calm = np.median(np.std(np.diff(x[on], axis=0), axis=0)) / (
            np.median(np.std(np.diff(y[on], axis=0), axis=0)) + 0.3
        )
        return float(min(calm / 1.8, np.median(own) / 1.5))
    if kind == "stuck":
        k = channels[0]
        on = np.abs(d[:, k]) > 0
        return float(
            min(on.sum() / rate / 1.0, max(own[k] / 1.5, np.quantile(np.abs(d[on, k]), 0.9) / (6 * own[k])))
        )
    if kind == "latency":
        late = np.median(np.abs(d), axis=1)
        move = np.abs(gaussian_filter1d(x, 0.03 * rate, axis=0, order=1)) * rate
        fast = np.quantile(move.mean(1), 0.9)
        return float(np.quantile(late, 0.9) / max(4 * np.median(own), 0.04 * fast))
    soft = gaussian_filter1d(d, (0.04 if kind.startswith("outside") else 0.12) * rate, axis=0)
    if kind in ("warmup", "fluidloss", "count_offset", "thermal"):
        blocks = np.array_split(np.arange(len(x)), 10)
        q = 0.75 if ctx.loaded else 0.5
        level = np.array([np.mean(np.quantile(x[b], q, axis=0)) for b in blocks])
        change = np.array([np.mean(soft[b]) for b in blocks])
        return float(np.ptp(change) / (1.5 * np.std(level) + 3 * np.median(own) / 2 + 3))
    out = []
    for k in channels:
        on = np.abs(soft[:, k]) > 0.5
        if on.sum() < 3:
            out.append(0.0)
            continue
        swing = np.quantile(x[:, k], 0.99) - np.quantile(x[:, k], 0.01)
        if kind in ("relax", "hyster"):
            f = ctx.force
            m = np.column_stack([np.ones(len(f)), ctx.t, f, f**2, np.linalg.norm(f, axis=1)])
            usual = x[:, k] - m @ np.linalg.lstsq(m, x[:, k], rcond=None)[0]
            usual = 0.7 * np.sqrt(np.mean(usual**2))
        else:
            usual = 2 * _others_say(x, k)
        out.append(np.quantile(np.abs(soft[on, k]), 0.9) / max(4 * own[k], usual, 0.05 * swing))
    out = np.sort(out)
    return float(np.median(out[-min(6, len(out)) :]))


# ---------------------------------------------------------------- the plan

_SINGLES = {  # kind: (base, form) ...
    "warmup": [("N", 0), ("hold:car", 1), ("touch", 2), ("F2", 0)],
    "fluidloss": [("N", 0), ("hold:steel", 2), ("F1f", 1)],
    "count_offset": [("N", 0), ("F1f", 3), ("hold:acrylic", 1), ("F2", 2)],
    "thermal": [("hold:steel", 0), ("hold:acrylic", 1), ("hold:steel", 2), ("hold:car", 3)],
    "drift": [("N", 0), ("F1", 1), ("hold", 2), ("touch", 3)],
    "jump": [("F2f", 0), ("hold", 1), ("slide", 3), ("scrape:RF", 0)],
    "gain": [("F1", 0), ("F2f", 1), ("F1f", 3)],
    "flip": [("F2", 0), ("F1f", 1), ("F2f", 2)],
    "swap": [("F1", 0), ("hold", 1), ("F2f", 3), ("slide", 2)],
    "crosstalk": [("F1", 0), ("F2", 1), ("F2f", 3)],
    "lowpass": [("N", 0), ("F1f", 1), ("F2", 2)],
    "hum": [("N", 0), ("hold", 1), ("F1", 2)],
    "quantise": [("N", 0), ("F1", 1), ("F2f", 2)],
    "stuck": [("F1", 0), ("N", 1), ("F2f", 2)],
    "saturate": [("F1", 0), ("F2f", 1), ("F2", 2)],
    "spikes": [("hold", 0), ("F1f", 1), ("touch", 2), ("scrape:LF", 0)],
    "freeze": [("F1", 0), ("N", 1), ("F2f", 2)],
    "lost": [("F2", 0), ("F1f", 1), ("F1", 2)],
    "dither": [("N", 0), ("F2f", 1), ("F1", 2)],
    "noise": [("hold", 0), ("F2", 1), ("N", 2), ("slide", 3)],
    "common_noise": [("F1f", 0), ("hold", 1), ("N", 2)],
    "latency": [("F1f", 0), ("F2f", 1), ("F2f", 2)],
    "relax": [("F1f", 0), ("F2f", 1), ("F1f", 2)],
    "hyster": [("F2f", 0), ("F1f", 1), ("F2f", 2)],
    "outside": [("N", 0), ("hold", 1), ("N", 2), ("hold", 3), ("touch", 4), ("N", 5), ("hold", 2), ("N", 1)],
    "outside_loaded": [
        ("F1", 0),
        ("F2f", 1),
        ("F1f", 2),
        ("F2", 3),
        ("F1", 4),
        ("F2f", 5),
        ("F1f", 6),
        ("F2", 7),
    ],
}
_PAIRS = [
    ("N", ("drift", 0), ("hum", 1)),
    ("F1", ("gain", 0), ("noise", 0)),
    ("F2", ("swap", 0), ("spikes", 0)),
    ("F1f", ("latency", 0), ("stuck", 0)),
    ("F2f", ("relax", 1), ("jump", 0)),
    ("hold:steel", ("thermal", 0), ("noise", 2)),
    ("N", ("fluidloss", 2), ("jump", 1)),
    ("hold", ("warmup", 2), ("spikes", 1)),
    ("F2", ("drift", 3), ("freeze", 0)),
    ("F1", ("saturate", 0), ("lost", 0)),
    ("N", ("count_offset", 0), ("quantise", 0)),
    ("F2f", ("crosstalk", 0), ("stuck", 1)),
    ("touch", ("common_noise", 0), ("swap", 3)),
    ("F1f", ("hyster", 2), ("spikes", 2)),
    ("F2", ("flip", 0), ("common_noise", 2)),
]
_NONE = {
    "F1": 4,
    "F1f": 5,
    "F2": 4,
    "F2f": 5,
    "N": 8,
    "hold": 9,
    "touch": 2,
    "slide": 3,
    "scrape:RF": 1,
    "scrape:LF": 1,
}
_LIVELY = {"latency", "relax", "hyster"}


def plan():
    """One dict a piece, in an order that mixes them. place: where in its recordings, spread evenly."""
    out = [(b, ()) for b, m in _NONE.items() for _ in range(m)]
    out += [(b, ((k, f),)) for k, v in _SINGLES.items() for b, f in v]
    out += [(b, (one, two)) for b, one, two in _PAIRS]
    pieces, number = [], {}
    for i, (base, effects) in enumerate(out):
        what = "+".join(f"{k}.{f}" for k, f in effects) or "none"
        where = base.split(":")[0].rstrip("f") + (":" + base.split(":")[1] if ":" in base else "")
        number[where] = number.get(where, -1) + 1
        place = (0.31 + number[where] * 0.6180339887) % 1
        name = f"v{i:03d}:{base.replace(':', '-')}:{what}"
        lively = any(k in _LIVELY for k, _ in effects) or (base.startswith("F") and "outside_loaded" in what)
        pieces.append({"id": name, "base": base, "effects": effects, "place": place, "lively": lively})
    order = np.random.default_rng(20261122).permutation(len(pieces))
    return [pieces[i] for i in order]


@dataclass
class Piece:
    case: dict
    clean: np.ndarray
    see: list
    sizes: list


_RETRY = {}  # id: which draw, where the first is not what it should be (found in plots)


def make(name, data):
    data = pathlib.Path(data)
    (spec,) = [p for p in plan() if p["id"] == name]
    seed = zlib.crc32(name.encode())
    ctx = _start(
        spec["base"],
        spec["place"],
        spec["lively"],
        data,
        np.random.default_rng([5, seed, _RETRY.get(name, 0)]),
    )
    clean, x = ctx.counts.copy(), ctx.counts.copy()
    effects = list(spec["effects"])
    channels, seen, sizes, keep = [], [], [], None
    for j, (kind, form) in enumerate(effects):
        tdc = ctx.tdc
        for size in (1.0, 1.5, 2.25, 3.4):
            ctx.tdc = tdc
            made, who = LAWS[kind](
                ctx, x, form, size, np.random.default_rng([55, seed, j, _RETRY.get(name, 0)])
            )
            if kind == "lost":
                number = see(kind, ctx, x, x, who, keep=made)
            else:
                made = np.clip(np.round(made), 0, 4095)
                number = see(kind, ctx, x, made, who)
            if number >= 1:
                break
        if kind == "lost":
            keep = made
        else:
            x = made
        channels.append([int(k) for k in who])
        seen.append(round(float(number), 2))
        sizes.append(size)
    force, tdc, gaps = ctx.force, ctx.tdc, []
    if keep is not None:
        kept = np.flatnonzero(keep)
        gaps = np.flatnonzero(np.diff(kept) > 1) + 1
        x, force, tdc = x[keep], None if force is None else force[keep], None if tdc is None else tdc[keep]
    if ctx.repeat > 1:
        x, clean = np.repeat(x, ctx.repeat, axis=0), np.repeat(clean, ctx.repeat, axis=0)
    case = {
        "base": ctx.base,
        "counts": x.astype(float),
        "rate": ctx.rate * ctx.repeat,
        "force": force,
        "tdc": tdc,
        "loaded": ctx.loaded,
        "channels": channels,
        "truth": [k for k, _ in effects],
        "forms": [f for _, f in effects],
        "seen": seen,
        "gaps": gaps,
    }
    return Piece(case, clean, seen, sizes)


def describe(name, data):
    piece = make(name, data)
    (spec,) = [p for p in plan() if p["id"] == name]
    n = len(spec["effects"])
    kinds = [k for k, _ in spec["effects"]]
    outside = any(k.startswith("outside") for k in kinds)
    return {
        "id": name,
        "source": spec["base"].split(":")[0],
        "group": "outside" if outside else ("none", "single", "pair")[n],
        "kinds": kinds,
        "see": piece.see,
        "detectable": [bool(s >= 1) for s in piece.see],
        "sizes": piece.sizes,
        "length": round(len(piece.case["counts"]) / piece.case["rate"], 1),
    }
