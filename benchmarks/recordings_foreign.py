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
    stretch of one is in both."""
    folder = pathlib.Path(folder)
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
        form = seed % len(spec.forms) if len(effects) == 1 else int(rng.integers(len(spec.forms)))
        if len(effects) == 1 and effect in OUTSIDE and not case.loaded:
            form %= 3  # the others act on the load
        case.channels.append([int(k) for k in spec.forms[form](case, rng)])
        case.truth.append(effect)
        case.forms.append(form)
    clean = case.counts.copy() if clean is None else clean
    case.counts = np.clip(np.rint(case.counts), 0, 4095)
    return case, clean
