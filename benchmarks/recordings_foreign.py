"""Recordings of real sensors with a hidden effect, in forms that the diagnosis does not fit.

Numpy and scipy alone: nothing here shares code, or the form of a formula, with what is judged. Base signals
are read from a folder of recordings; every effect of the catalogue has three forms or more, and some
effects are outside the catalogue. Half of the base signals is for practice, the other half is used once.
"""

import gzip
import pathlib
import zlib
from dataclasses import dataclass, field

import numpy as np
from scipy.io import loadmat
from scipy.signal import butter, sosfilt

__all__ = ["ACCEPTED", "EFFECTS", "OUTSIDE", "SINGLE", "Case", "Effect", "bases", "make", "plan"]


@dataclass
class Case:
    """One recording on its way: counts (n, 19), force (n, 3) [N], tdc (n,) or None; rate [Hz]; seen: how
    plain each hidden effect is, where the generator measures it."""

    base: str
    counts: np.ndarray
    rate: float
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None
    loaded: bool = False
    channels: list = field(default_factory=list)
    truth: list = field(default_factory=list)
    forms: list = field(default_factory=list)
    seen: list = field(default_factory=list)
    gaps: list = field(default_factory=list)  # rows before which some were lost

    @property
    def clock(self):
        """(n,) 0..1"""
        return np.linspace(0, 1, len(self.counts))


@dataclass(frozen=True)
class Effect:
    """forms: functions (case, rng) that change the counts in place and return the channels concerned; on:
    'any', 'loaded', 'force' or 'tdc', what a base has to have; late: acts on what the converter has read."""

    forms: tuple
    on: str = "any"
    late: bool = False


def _z(counts):
    c = np.clip(counts, 1, 4094)
    return np.log((4095 - c) / c)


def _counts(z):
    return 4095 / (1 + np.exp(z))


def _sign(rng):
    return float(rng.choice([-1, 1]))


def _start(rng, n):
    return int(rng.uniform(0.15, 0.5) * n)


def _since(case, rng):
    """(n,) 0 before a random row, then 0..1 at the end."""
    start = _start(rng, len(case.counts))
    return np.clip((np.arange(len(case.counts)) - start) / (len(case.counts) - start), 0, 1)


# --- what develops over time in all electrodes


def _shared(shape, low, high, sign):
    def form(c, rng):
        share = 1 + 0.1 * rng.standard_normal(19)
        c.counts = _counts(
            _z(c.counts) + sign * rng.uniform(low, high) * shape(c.clock, rng)[:, None] * share
        )
        return range(19)

    return form


_RISES = (
    lambda t, r: np.sqrt(t),
    lambda t, r: 1 / (1 + np.exp(-(t - r.uniform(0.2, 0.4)) / r.uniform(0.06, 0.12))),
    lambda t, r: 0.5 * t / (t + 0.05) + 0.5 * t / (t + 0.6),
    lambda t, r: np.arctan(t / r.uniform(0.1, 0.4)),
)
_LOSSES = (
    lambda t, r: t,
    lambda t, r: np.log1p(t / 0.3) / np.log1p(1 / 0.3),
    lambda t, r: t**0.7,
)


def _supply_step(c, rng):
    step = 0.5 * (1 + np.tanh((np.arange(len(c.counts)) - _start(rng, len(c.counts))) / (0.3 * c.rate)))
    c.counts += _sign(rng) * rng.uniform(20, 60) * step[:, None]
    return range(19)


def _supply_ramp(c, rng):
    c.counts += _sign(rng) * rng.uniform(30, 80) * (_since(c, rng) ** 1.3)[:, None]
    return range(19)


def _supply_stairs(c, rng):
    t = _since(c, rng)
    c.counts += _sign(rng) * rng.uniform(30, 80) * (np.ceil(3 * np.clip(t, 0, 0.4) / 0.4) / 3)[:, None]
    return range(19)


def _temperature(law):
    def form(c, rng):
        t = c.tdc - c.tdc[0]
        c.counts = _counts(_z(c.counts) - rng.uniform(0.004, 0.01) * law(t, c)[:, None])
        return range(19)

    return form


def _lagging(t, c):
    out = np.empty_like(t)
    value = t[0]
    for i, now in enumerate(t):
        value += (now - value) / c.rate
        out[i] = value
    return out


# --- single electrodes


def _one(c, rng, lively=False):
    if not lively:
        return int(rng.integers(19))
    return int(np.argsort(-c.counts.std(0))[rng.integers(9)])


def _slow(shape):
    def form(c, rng):
        k = _one(c, rng)
        c.counts[:, k] += _sign(rng) * rng.uniform(80, 300) * shape(c, rng)
        return [k]

    return form


_DRIFTS = tuple(
    _slow(s)
    for s in (
        lambda c, r: 1 / (1 + np.exp(-(c.clock - r.uniform(0.25, 0.55)) / r.uniform(0.03, 0.08))),
        lambda c, r: np.sqrt(_since(c, r)),
        lambda c, r: _since(c, r) ** 2,
        lambda c, r: np.log1p(_since(c, r) / 0.1) / np.log(11),
    )
)


def _hard_step(c, rng):
    k = _one(c, rng)
    c.counts[_start(rng, len(c.counts)) :, k] += _sign(rng) * rng.uniform(60, 250)
    return [k]


def _soft_step(c, rng):
    k = _one(c, rng)
    x = (np.arange(len(c.counts)) - _start(rng, len(c.counts))) / (0.2 * c.rate)
    c.counts[:, k] += _sign(rng) * rng.uniform(60, 250) * 0.5 * (1 + np.tanh(x))
    return [k]


def _settling_step(c, rng):
    k = _one(c, rng)
    s = _start(rng, len(c.counts))
    t = np.arange(len(c.counts) - s) / len(c.counts)
    c.counts[s:, k] += _sign(rng) * rng.uniform(60, 250) * (0.7 + 0.3 * 0.5 ** (t / 0.05))
    return [k]


def _factor(law):
    def form(c, rng):
        k, s = _one(c, rng, True), _start(rng, len(c.counts))
        rest = np.quantile(c.counts[:, k], 0.9)
        c.counts[s:, k] = rest + law(c.counts[s:, k] - rest, np.linspace(0, 1, len(c.counts) - s), rng)
        return [k]

    return form


_GAINS = (
    _factor(lambda x, t, r: x * r.uniform(0.4, 0.65)),
    _factor(lambda x, t, r: x * (1 - r.uniform(0.4, 0.6) * np.clip(3 * t, 0, 1))),
    _factor(lambda x, t, r: x * r.uniform(1.4, 1.7)),
    _factor(lambda x, t, r: np.sign(x) * np.abs(x) ** 0.87),
)


def _flip(law):
    def form(c, rng):
        k, s = _one(c, rng, True), _start(rng, len(c.counts))
        c.counts[s:, k] = law(c.counts[s:, k], c.counts[:, k])
        return [k]

    return form


_FLIPS = (
    _flip(lambda x, whole: _counts(2 * _z(np.median(whole)) - _z(x))),
    _flip(lambda x, whole: np.mean(whole) - 0.7 * (x - np.mean(whole))),
    _flip(lambda x, whole: 4095 * (1 - x / 4095) ** 0.8),
)


def _permuted(cycle):
    def form(c, rng):
        s = _start(rng, len(c.counts))
        who = cycle(rng)
        c.counts[s:, who] = c.counts[s:, np.roll(who, 1)]
        return [int(k) for k in who]

    return form


_SWAPS = (
    _permuted(lambda r: r.choice(19, 2, replace=False)),
    _permuted(lambda r: r.choice(19, 3, replace=False)),
    _permuted(lambda r: (r.integers(19) + np.arange(2)) % 19),
    _permuted(lambda r: (r.integers(19) + np.arange(4)) % 19),
)

# --- acquisition


def _mix(matrix):
    def form(c, rng):
        rest = c.counts.mean(0)
        c.counts = rest + (c.counts - rest) @ (np.eye(19) + matrix(rng)).T
        return range(19)

    return form


def _chain(rng):
    return rng.uniform(0.1, 0.25) * np.eye(19, k=-1)


_CROSS = (
    _mix(_chain),
    _mix(lambda r: r.uniform(0.08, 0.18) * (np.eye(19, k=1) + np.eye(19, k=-1))),
    _mix(lambda r: r.uniform(0.015, 0.03) * (1 - np.eye(19))),
)


def _filtered(kind):
    def form(c, rng):
        # The converter's noise comes after the filter in part of the sensors; here all is filtered.
        cut = rng.uniform(0.03, 0.1) * c.rate
        if kind == "boxcar":
            w = np.ones(int(rng.integers(3, 9)))
        elif kind == "triangle":
            w = np.bartlett(int(rng.integers(7, 15)))[1:-1]
        else:
            sos = butter(int(kind), cut, fs=c.rate, output="sos")
            level = c.counts[0]
            c.counts = level + sosfilt(sos, c.counts - level, axis=0)
            return range(19)
        pad = np.concatenate([np.repeat(c.counts[:1], len(w) - 1, axis=0), c.counts])
        c.counts = np.stack([np.convolve(x, w / w.sum(), "valid") for x in pad.T], axis=1)
        return range(19)

    return form


_FILTERS = (_filtered("1"), _filtered("2"), _filtered("boxcar"), _filtered("triangle"))


def _tone(wave):
    def form(c, rng):
        f = rng.uniform(0.2, 0.44) * c.rate
        t = np.arange(len(c.counts)) / c.rate
        size = rng.uniform(4, 12) * rng.uniform(0.6, 1.3, 19)
        c.counts += wave(2 * np.pi * f * t + rng.uniform(0, 6), t / t[-1])[:, None] * size
        return range(19)

    return form


_TONES = (
    _tone(lambda p, u: np.sign(np.sin(p))),
    _tone(lambda p, u: np.sin(p) * (1 + 0.4 * np.sin(12 * u))),
    _tone(lambda p, u: np.sin(p + 0.8 * np.sin(5 * u))),
)


def _coarse(law):
    def form(c, rng):
        c.counts = law(c.counts, 2.0 ** rng.integers(2, 5))
        return range(19)

    return form


_COARSE = (
    _coarse(lambda x, q: q * np.floor(x / q)),
    _coarse(lambda x, q: q * np.ceil(x / q) - 1),
    _coarse(lambda x, q: (q + 1) * np.rint(x / (q + 1))),
)


def _held_channel(law):
    def form(c, rng):
        k, n = _one(c, rng), len(c.counts)
        a = _start(rng, n)
        b = a + int(rng.uniform(0.1, 0.3) * n)
        c.counts[a:b, k] = law(c.counts[a, k], b - a, rng)
        return [k]

    return form


_STUCK = (
    _held_channel(lambda v, n, r: np.rint(v)),
    _held_channel(lambda v, n, r: r.choice([0.0, 4095.0])),
    _held_channel(lambda v, n, r: np.rint(v) + (r.random(n) < 0.002)),
)


def _clipped(law):
    def form(c, rng):
        k = _one(c, rng, True)
        x = c.counts[:, k]
        c.counts[:, k] = law(x, np.quantile(x, rng.uniform(0.1, 0.3)), rng)
        return [k]

    return form


_CLIPS = (
    _clipped(lambda x, level, r: np.maximum(x, np.rint(level))),
    _clipped(lambda x, level, r: np.minimum(x, np.rint(np.quantile(x, 0.8)))),
    _clipped(lambda x, level, r: np.where(x < level, np.rint(level) - (r.random(len(x)) < 0.1), x)),
)


def _outliers(law):
    def form(c, rng):
        k = _one(c, rng)
        rows = rng.choice(len(c.counts) - 20, max(12, len(c.counts) // 400), replace=False) + 10
        c.counts[rows, k] = law(c.counts[rows, k], rng)
        return [k]

    return form


_SPIKES = (
    _outliers(lambda x, r: x + r.choice([-1, 1], len(x)) * r.uniform(200, 700, len(x))),
    _outliers(lambda x, r: np.bitwise_xor(x.astype(int), 512)),
    _outliers(lambda x, r: 0 * x),
)


def _hold_rows(rows):
    def form(c, rng):
        at = np.arange(len(c.counts))
        for a, b in rows(len(at), c.rate, rng):
            at[a:b] = at[a]
        c.counts = c.counts[at]
        return range(19)

    return form


def _pauses(number, low, high):
    def rows(n, rate, rng):
        starts = (rng.uniform(0.05, 0.9, number) * n).astype(int)
        return [(a, a + int(rng.uniform(low, high) * rate)) for a in starts]

    return rows


def _jitter(n, rate, rng):
    steps = rng.choice([1, 2, 3, 5, 8, 13], n)
    edges = np.concatenate([[0], np.cumsum(steps)])
    edges = edges[edges < n]
    return list(zip(edges[:-1], edges[1:]))


_HELD = (_hold_rows(_pauses(1, 1, 3)), _hold_rows(_pauses(6, 0.4, 1)), _hold_rows(_jitter))


def _dropped(number, low, high):
    def form(c, rng):
        keep = np.ones(len(c.counts), bool)
        for a in (rng.uniform(0.1, 0.85, number) * len(keep)).astype(int):
            keep[a : a + int(rng.uniform(low, high) * c.rate)] = False
        c.gaps = np.flatnonzero(np.diff(np.flatnonzero(keep)) > 1) + 1
        c.counts = c.counts[keep]
        c.force = None if c.force is None else c.force[: keep.sum()]
        c.tdc = None if c.tdc is None else c.tdc[: keep.sum()]
        return range(19)

    return form


_LOST = (_dropped(1, 1.5, 4), _dropped(3, 0.8, 2), _dropped(8, 0.5, 1.2))


def _dithered(every):
    def form(c, rng):
        at = np.arange(len(c.counts)) // every * every
        c.counts = c.counts[at] + rng.uniform(0.5, 1.0) * rng.standard_normal(c.counts.shape)
        return range(19)

    return form


_DITHERED = (_dithered(4), _dithered(6), _dithered(10))


def _loud(law):
    def form(c, rng):
        k, n = _one(c, rng), len(c.counts)
        c.counts[:, k] += rng.uniform(4, 8) * 4 * law(n, rng)
        return [k]

    return form


_LOUD = (
    _loud(lambda n, r: r.standard_normal(n)),
    _loud(lambda n, r: r.uniform(-1.7, 1.7, n)),
    _loud(lambda n, r: r.laplace(0, 0.7, n)),
)


def _reference(law):
    def form(c, rng):
        c.counts += rng.uniform(5, 9) * law(len(c.counts), rng)[:, None] * rng.uniform(0.8, 1.2, 19)
        return range(19)

    return form


_REFERENCE = (
    _reference(lambda n, r: r.standard_normal(n)),
    _reference(lambda n, r: r.laplace(0, 0.7, n)),
    _reference(lambda n, r: r.choice([-1.0, 1.0], n)),
)

# --- between force and electrodes


def _late(delay):
    def form(c, rng):
        n = len(c.counts)
        late = np.rint(delay(c.clock, rng) * np.ones(n) * c.rate).astype(int)
        first = late.max()
        c.counts = c.counts[np.arange(n) - late][first:]
        c.force = c.force[first:]
        return range(19)

    return form


_LATE = (
    _late(lambda t, r: r.uniform(0.08, 0.25)),
    _late(lambda t, r: r.uniform(0.1, 0.25) * (0.8 + 0.4 * t)),
    _late(lambda t, r: r.uniform(0.1, 0.25) + 0.01 * np.sin(40 * t)),
)


def _remember(weights):
    def form(c, rng):
        total, size = np.zeros_like(c.force), rng.uniform(0.25, 0.45)
        for share, tau in weights:
            state = c.force[0].copy()
            a = 1 / (tau * c.rate)
            for i, f in enumerate(c.force):
                state += a * (f - state)
                total[i] += share * (f - state)
        c.force = c.force + size * total
        return range(19)

    return form


_RELAXING = (
    _remember(((0.6, 0.6), (0.4, 3.0))),
    _remember(((0.34, 0.4), (0.33, 1.5), (0.33, 6.0))),
    _remember(((1.0, 2.0),)),
)


def _loop(law):
    def form(c, rng):
        width = 0.5 * c.force.std(0)
        kernel = np.hanning(25)[1:-1] / np.hanning(25)[1:-1].sum()
        smooth = np.stack(
            [np.convolve(np.pad(x, 11, mode="edge"), kernel, "valid") for x in c.force.T], axis=1
        )
        z, out = np.zeros(3), np.empty_like(c.force)
        for i, step in enumerate(np.diff(smooth, axis=0, prepend=smooth[:1])):
            z = np.clip(law(z / width, step / width), -1, 1) * width
            out[i] = z
        c.force = c.force + rng.uniform(0.5, 0.9) * out
        return range(19)

    return form


_LOOPS = (
    _loop(lambda z, d: z + d * (1 - np.sign(d) * z)),
    _loop(lambda z, d: z + d - 0.6 * np.abs(d) * z * np.abs(z) - 0.4 * d * z**2),
    _loop(lambda z, d: z + d * (1 - np.sign(d) * z) ** 2 / 2),
)

# --- outside the catalogue


def _wander(c, rng):
    for k in rng.choice(19, 6, replace=False):
        c.counts[:, k] += rng.uniform(30, 70) * np.sin(
            2 * np.pi * rng.uniform(3, 9) * c.clock + rng.uniform(0, 6)
        )
    return range(19)


def _telegraph(c, rng):
    flips = np.cumsum(rng.random(len(c.counts)) < 14 / len(c.counts)) % 2
    c.counts *= 1 + 0.02 * flips[:, None] * rng.choice([-1, 1], 19)
    return range(19)


def _flicker(c, rng):
    """The gain of three electrodes changes every few seconds."""
    for k in rng.choice(19, 3, replace=False):
        steps = np.repeat(rng.uniform(0.4, 1.6, 40), len(c.counts) // 40 + 1)[: len(c.counts)]
        middle = np.median(c.counts[:, k])
        c.counts[:, k] = middle + (c.counts[:, k] - middle) * steps
    return range(19)


def _sawtooth(c, rng):
    k = _one(c, rng)
    c.counts[:, k] += rng.uniform(80, 160) * ((c.clock * rng.uniform(6, 14)) % 1 - 0.5)
    return [k]


def _echo(c, rng):
    """Six electrodes hear themselves again later."""
    d = int(rng.uniform(0.5, 1.5) * c.rate)
    for k in rng.choice(19, 6, replace=False):
        x = c.counts[:, k] - c.counts[:, k].mean()
        c.counts[d:, k] += 0.6 * x[:-d]
    return range(19)


def _bubble(c, rng):
    """From some time on the changes of half of the electrodes saturate and lag."""
    s = _start(rng, len(c.counts))
    for k in rng.choice(19, 9, replace=False):
        rest = np.quantile(c.counts[:, k], 0.9)
        x = c.counts[s:, k] - rest
        slow = np.empty_like(x)
        value = x[0]
        for i, now in enumerate(x):
            value += (now - value) / (1.5 * c.rate)
            slow[i] = value
        c.counts[s:, k] = rest + 0.5 * x + 0.6 * np.abs(slow)
    return range(19)


# --- further forms, to see what a fit to those above is worth elsewhere


def _two_jumps(c, rng):
    k, n = _one(c, rng), len(c.counts)
    s, size = _start(rng, n), _sign(rng) * rng.uniform(60, 250)
    c.counts[s:, k] += 0.6 * size
    c.counts[s + int(rng.uniform(1, 3) * c.rate) :, k] += 0.4 * size
    return [k]


def _ringing_jump(c, rng):
    k, s = _one(c, rng), _start(rng, len(c.counts))
    t = np.arange(len(c.counts) - s) / c.rate
    c.counts[s:, k] += _sign(rng) * rng.uniform(60, 250) * (1 + 0.3 * np.exp(-t) * np.cos(6 * t))
    return [k]


def _supply_jump(c, rng):
    c.counts[_start(rng, len(c.counts)) :] += _sign(rng) * rng.uniform(20, 60)
    return range(19)


def _supply_settling(c, rng):
    s = _start(rng, len(c.counts))
    t = np.arange(len(c.counts) - s) / len(c.counts)
    c.counts[s:] += (_sign(rng) * rng.uniform(30, 70) * (0.6 + 0.4 * np.exp(-t / 0.03)))[:, None]
    return range(19)


def _of_impedance(law):
    def form(c, rng):
        k, s = _one(c, rng, True), _start(rng, len(c.counts))
        z = _z(c.counts[:, k])
        rest = np.median(z)
        c.counts[s:, k] = _counts(rest + law(z[s:] - rest, np.linspace(0, 1, len(z) - s), rng))
        return [k]

    return form


def _two_pairs(c, rng):
    s, who = _start(rng, len(c.counts)), rng.choice(19, 4, replace=False)
    c.counts[s:, who] = c.counts[s:, who[[1, 0, 3, 2]]]
    return [int(k) for k in who]


def _heard(rng):
    """Every other electrode hears one of the two before it."""
    m = np.zeros((19, 19))
    for k in range(2, 19, 2):
        m[k, k - rng.integers(1, 3)] = rng.uniform(0.12, 0.28)
    return m


def _few_hum(c, rng):
    t, f = np.arange(len(c.counts)) / c.rate, rng.uniform(0.2, 0.44) * c.rate
    who = rng.choice(19, 6, replace=False)
    c.counts[:, who] += (rng.uniform(4, 12) * np.sin(2 * np.pi * f * t))[:, None]
    return range(19)


def _smoothing(c, rng):
    a, value = rng.uniform(0.15, 0.45), c.counts[0].copy()
    for i, row in enumerate(c.counts):
        value = value + a * (row - value)
        c.counts[i] = value
    return range(19)


def _bell(c, rng):
    w = np.exp(-0.5 * (np.arange(-9, 10) / rng.uniform(1.2, 3.5)) ** 2)
    pad = np.concatenate([np.repeat(c.counts[:1], 18, axis=0), c.counts])
    c.counts = np.stack([np.convolve(x, w / w.sum(), "valid") for x in pad.T], axis=1)
    return range(19)


def _at_times(n, r):
    on = np.repeat(r.random(24) < 0.6, n // 24 + 1)[:n]
    return 1.3 * on * r.standard_normal(n)


def _fading(c, rng):
    """A memory that fades as a power of time, in sixteen terms."""
    total, size = np.zeros_like(c.force), rng.uniform(0.3, 0.5)
    for tau in np.geomspace(0.2, 20, 16):
        state, a = c.force[0].copy(), 1 / (tau * c.rate)
        for i, f in enumerate(c.force):
            state += a * (f - state)
            total[i] += (f - state) / 16
    c.force = c.force + size * total
    return range(19)


def _plays(c, rng):
    """Three plays of different widths."""
    out = np.zeros_like(c.force)
    for share in (0.2, 0.5, 1.0):
        width, z = share * c.force.std(0), np.zeros(3)
        for i, step in enumerate(np.diff(c.force, axis=0, prepend=c.force[:1])):
            z = np.clip(z + step, -width, width)
            out[i] += z / 3
    c.force = c.force + rng.uniform(0.6, 1.0) * out
    return range(19)


def _loose(c, rng):
    """The levels of two electrodes change many times."""
    for k in rng.choice(19, 2, replace=False):
        steps = np.repeat(rng.uniform(-90, 90, 24), len(c.counts) // 24 + 1)[: len(c.counts)]
        c.counts[:, k] += steps
    return range(19)


def _bump(c, rng):
    """Four electrodes leave their level for a while."""
    a = _start(rng, len(c.counts))
    b = a + int(rng.uniform(0.08, 0.16) * len(c.counts))
    for k in rng.choice(19, 4, replace=False):
        c.counts[a:b, k] += _sign(rng) * rng.uniform(60, 140) * np.hanning(b - a)
    return range(19)


def _sliding(c, rng):
    """A slow oscillation of five electrodes that becomes faster."""
    for k in rng.choice(19, 5, replace=False):
        c.counts[:, k] += rng.uniform(30, 60) * np.sin(2 * np.pi * (3 * c.clock + 8 * c.clock**2) + k)
    return range(19)


_MORE = {
    "warmup": [
        _shared(shape, 0.12, 0.35, -1)
        for shape in (
            lambda t, r: t**0.35,
            lambda t, r: np.minimum(t / r.uniform(0.4, 0.8), 1),
            lambda t, r: np.tanh(t / r.uniform(0.1, 0.3)) * (0.8 + 0.2 * t),
        )
    ],
    "fluidloss": [
        _shared(shape, 0.12, 0.35, 1) for shape in (lambda t, r: t**1.4, lambda t, r: np.tanh(2 * t))
    ],
    "count_offset": [_supply_jump, _supply_settling],
    "thermal": [_temperature(lambda t, c: np.sign(t) * np.abs(t) ** 0.9)],
    "drift": [
        _slow(lambda c, r: np.clip((c.clock - 0.2) / r.uniform(0.1, 0.3), 0, 1)),
        _slow(lambda c, r: np.exp(-3 * np.exp(-8 * c.clock))),
        _slow(lambda c, r: np.arctan(8 * _since(c, r)) / 1.45),
        _slow(lambda c, r: c.clock),
    ],
    "jump": [_two_jumps, _ringing_jump],
    "gain": [
        _of_impedance(lambda x, t, r: x * r.uniform(0.4, 0.65)),
        _of_impedance(lambda x, t, r: x * r.uniform(1.4, 1.7)),
        _factor(lambda x, t, r: x * (1 - r.uniform(0.4, 0.6) / (1 + np.exp(-(t - 0.2) * 20)))),
        _factor(lambda x, t, r: np.tanh(x / 150) * 150),
    ],
    "flip": [_flip(lambda x, whole: 2 * np.median(whole) - x), _of_impedance(lambda x, t, r: -1.2 * x)],
    "swap": [_two_pairs, _permuted(lambda r: (r.integers(19) + np.array([0, 5, 9])) % 19)],
    "crosstalk": [_mix(_heard), _mix(lambda r: r.uniform(0.1, 0.2) * (np.eye(19, k=-1) + np.eye(19, k=-2)))],
    "lowpass": [_smoothing, _bell, _filtered("3")],
    "hum": [
        _tone(lambda p, u: 2 * np.abs((p / np.pi) % 2 - 1) - 1),
        _tone(lambda p, u: np.sin(p) + 0.5 * np.sin(1.37 * p)),
        _few_hum,
    ],
    "quantise": [_coarse(lambda x, q: 3 * np.floor(x / 3)), _coarse(lambda x, q: q * np.rint(x / q) + 1)],
    "stuck": [
        _held_channel(lambda v, n, r: np.rint(v) + (np.arange(n) % 97 == 0)),
        _held_channel(lambda v, n, r: np.full(n, np.rint(v) - r.integers(5, 60))),
    ],
    "saturate": [_clipped(lambda x, level, r: np.clip(x, np.rint(level), None) + (x < level - 200))],
    "spikes": [
        _outliers(lambda x, r: np.rint(x / 2)),
        _outliers(lambda x, r: np.clip(x + r.exponential(300, len(x)) + 150, 0, 4095).astype(int)),
    ],
    "freeze": [_hold_rows(_pauses(3, 0.5, 2)), _hold_rows(_pauses(12, 0.3, 0.6))],
    "lost": [_dropped(2, 1, 3), _dropped(5, 0.7, 1.5)],
    "dither": [_dithered(5), _dithered(8)],
    "noise": [
        _loud(lambda n, r: r.standard_t(4, n) / np.sqrt(2)),
        _loud(_at_times),
    ],
    "common_noise": [
        _reference(lambda n, r: r.uniform(-1.7, 1.7, n)),
        _reference(lambda n, r: r.standard_t(5, n) / 1.29),
    ],
    "latency": [_late(lambda t, r: r.uniform(0.08, 0.2) + 0.04 * (t > 0.4))],
    "relax": [_fading],
    "hyster": [_plays],
    "outside": [_loose, _bump, _sliding],
}


EFFECTS = {
    "warmup": Effect(tuple(_shared(s, 0.12, 0.35, -1) for s in _RISES)),
    "fluidloss": Effect(tuple(_shared(s, 0.12, 0.35, 1) for s in _LOSSES)),
    "count_offset": Effect((_supply_step, _supply_ramp, _supply_stairs)),
    "thermal": Effect(
        (
            _temperature(lambda t, c: t),
            _temperature(lambda t, c: t + 0.01 * t**2),
            _temperature(_lagging),
        ),
        "tdc",
    ),
    "drift": Effect(_DRIFTS),
    "jump": Effect((_hard_step, _soft_step, _settling_step)),
    "gain": Effect(_GAINS, "loaded"),
    "flip": Effect(_FLIPS, "loaded"),
    "swap": Effect(_SWAPS),
    "crosstalk": Effect(_CROSS, "loaded"),
    "lowpass": Effect(_FILTERS, "noisy"),
    "hum": Effect(_TONES, "noisy"),
    "quantise": Effect(_COARSE, "noisy", True),
    "stuck": Effect(_STUCK, "noisy", True),
    "saturate": Effect(_CLIPS, "loaded", True),
    "spikes": Effect(_SPIKES, "any", True),
    "freeze": Effect(_HELD, "noisy", True),
    "lost": Effect(_LOST, "loaded", True),
    "dither": Effect(_DITHERED, "noisy"),
    "noise": Effect(_LOUD),
    "common_noise": Effect(_REFERENCE),
    "latency": Effect(_LATE, "force"),
    "relax": Effect(_RELAXING, "force"),
    "hyster": Effect(_LOOPS, "force"),
    "outside": Effect((_wander, _telegraph, _sawtooth, _flicker, _echo, _bubble)),
}
FEW = {name: len(effect.forms) for name, effect in EFFECTS.items()}
for _name, _forms in _MORE.items():
    EFFECTS[_name] = Effect((*EFFECTS[_name].forms, *_forms), EFFECTS[_name].on, EFFECTS[_name].late)
OUTSIDE = {"outside"}
SINGLE = {"drift", "jump", "gain", "flip", "swap", "stuck", "saturate", "spikes", "noise"}
# names of the verdict that are right; an id among the ties counts
ACCEPTED = {name: {name} for name in EFFECTS} | {
    "count_offset": {"count_offset", "count_gain"},
    "jump": {"drift"},
    "dither": {"freeze"},
    "lost": {"lost_rows"},
    "flip": {"flip", "gain"},
}
# what a base has by itself
NATURAL = {
    "rest": {"warmup"},
    "pressed": {"warmup", "latency"},
    "hold": {"warmup", "thermal", "fluidloss"},
    "scrape": set(),
}


def _table(path):
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        return np.loadtxt(file)


def bases(folder: pathlib.Path, half: str) -> dict:
    """name -> function (rng) -> Case: real base signals of a half, "practice" or "blind"; no sensor and no
    stretch of one is in both. "mixed": of either."""
    folder = pathlib.Path(folder)
    if half == "mixed":
        both = [bases(folder, name) for name in ("practice", "blind")]
        return {name: lambda rng, name=name: both[rng.integers(2)][name](rng) for name in both[0]}
    first = half == "practice"

    def piece(e, rng, *others, low=60):
        length = int(min(len(e), rng.uniform(low, 190) * 117))
        a = int(rng.integers(len(e) - length + 1))
        return [None if x is None else x[a : a + length].copy() for x in (e, *others)]

    pressed = (
        ("epfl_flat_press", "SynImpF1.txt", "ForceData.txt")
        if first
        else ("epfl_f2", "SynImpF2.txt.gz", "ForceData.txt.gz")
    )
    pressed = _table(folder / pressed[0] / pressed[1]), _table(folder / pressed[0] / pressed[2])
    rest = _table(folder / "epfl_flat_press/SynImpF2.txt")
    rest = rest[: len(rest) // 2] if first else rest[len(rest) // 2 :]
    holds = [p for i, p in enumerate(sorted((folder / "phac_hold").glob("*.mat"))) if (i % 2 == 0) == first]
    scrape = _table(folder / f"scraping/sense_R_{'LF' if first else 'RF'}.txt.gz")

    def loaded(with_force):
        def make(rng):
            e, f = piece(pressed[0], rng, pressed[1])
            return Case("pressed", e, 117.0, f if with_force else None, None, True)

        return make

    def unloaded(rng):
        return Case("rest", piece(rest, rng, low=45)[0], 117.0)

    def hold(rng):
        data = loadmat(holds[rng.integers(len(holds))])
        finger = "F0" if rng.random() < 0.5 else "F1"
        return Case(
            "hold",
            data[f"{finger}Electrodes"].T.astype(float),
            100.0,
            None,
            data[f"{finger}tdc"].ravel().astype(float),
        )

    def scraping(rng):
        return Case("scrape", scrape + np.rint(rng.uniform(2000, 3300, 19)), 300.0)

    return {
        "pressed": loaded(False),
        "pressed with force": loaded(True),
        "rest": unloaded,
        "hold": hold,
        "scrape": scraping,
    }


def plan(half: str, nulls: int, singles: int, pairs: int) -> list:
    """(base, effects, seed) of a half: recordings without effect on each base, of each effect, and pairs."""
    names = ["pressed", "pressed with force", "rest", "hold", "scrape"]
    can = {
        "any": names[:4],
        "noisy": names[:3],
        "loaded": names[:2],
        "force": names[1:2],
        "tdc": ["hold"],
    }
    out = [(base, (), i) for base in names for i in range(nulls)]
    for effect, spec in EFFECTS.items():
        number = singles * (3 if effect in OUTSIDE else 1)
        out += [(can[spec.on][i % len(can[spec.on])], (effect,), i) for i in range(number)]
    rng = np.random.default_rng(zlib.crc32(half.encode()))
    free = [e for e, s in EFFECTS.items() if s.on in ("any", "noisy", "loaded") and e not in OUTSIDE]
    for i in range(pairs):
        a, b = sorted(rng.choice(len(free), 2, replace=False))
        pair = (free[a], free[b])
        loaded = any(EFFECTS[e].on == "loaded" for e in pair)
        out.append((names[i % 2] if loaded else names[i % 3], pair, i))
    return out


def make(half: str, sources: dict, base: str, effects: tuple, seed: int) -> tuple[Case, np.ndarray]:
    """The case, and the counts without the hidden effects (n, 19); rows that were lost are lost in both."""
    rng = np.random.default_rng(zlib.crc32(repr((half, base, effects, seed)).encode()))
    case = sources[base](rng)
    clean = None
    for effect in sorted(effects, key=lambda e: EFFECTS[e].late):
        spec = EFFECTS[effect]
        case.counts = np.clip(np.rint(case.counts), 0, 4095) if spec.late else case.counts
        clean = case.counts.copy() if clean is None else clean
        few = FEW[effect]
        form = seed % few if len(effects) == 1 else int(rng.integers(few))
        if half == "mixed":  # the further forms first
            form = (seed + few) % len(spec.forms) if len(effects) == 1 else int(rng.integers(len(spec.forms)))
        if len(effects) == 1 and effect in OUTSIDE and not case.loaded and 3 <= form < few:
            form %= 3  # the others act on the load
        case.channels.append([int(k) for k in spec.forms[form](case, rng)])
        case.truth.append(effect)
        case.forms.append(form)
    clean = case.counts.copy() if clean is None else clean
    case.counts = np.clip(np.rint(case.counts), 0, 4095)
    return case, clean
