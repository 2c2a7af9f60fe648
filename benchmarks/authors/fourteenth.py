"""Pieces of recordings of real sensors with none, one or two hidden effects, by a fourteenth author.

    plan() -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own.
Each piece has a seed of its own and a level: just visible, middling, plain. What the sensor does comes before
the bus, so rows that the log repeats stay repeated. Slides are absolute deviations from rest, scrapes tared.
"""

import dataclasses
import pathlib

import numpy as np
from authors.sources import source
from authors.vocabulary import KINDS
from scipy.fft import dct, idct
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

NATURAL = {
    "fourteenth F1": {"warmup", "latency", "freeze"},
    "fourteenth F2": {"warmup", "latency", "freeze"},
    "fourteenth U": {"warmup", "freeze"},
    "fourteenth phac": {"warmup", "thermal", "fluidloss"},
    "fourteenth slides": {"warmup", "thermal", "fluidloss", "latency"},
    "fourteenth scraping": {"freeze", "latency"},
    "fourteenth btd": {"lost_rows", "spikes"},
}
ALL = list(range(19))
_SEED = 140426
_KELVIN = 0.071  # share of the impedance for a kelvin
_TDC = 44.0  # counts of TDC for a kelvin


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base, +f where the file has the force; level 0, 1, 2 or None; effects: of (kind, form),
    of one outside ("outside", form)."""

    name: str
    base: str
    level: int | None
    effects: tuple

    @property
    def outside(self) -> bool:
        return bool(self.effects) and self.effects[0][0] == "outside"

    @property
    def kinds(self) -> tuple:
        """Of the benchmark's vocabulary."""
        if self.outside:
            return ("outside_loaded",) if self.base[:2] in ("F1", "F2") else ("outside",)
        return tuple(_COMMON.get(form, KINDS[kind]) for kind, form in self.effects)


class _Piece:
    def __init__(self, log, rows, rng, level, slides):
        first = int(rng.integers(0, len(log.x) - rows + 1))
        part = slice(first, first + rows)
        self.rng, self.level, self.rate = rng, level, log.rate
        self.x = -log.x[part] if slides else log.x[part].copy()  # a press lowers counts
        self.time = log.time[part] - log.time[first]
        self.held = log.held[part].copy()
        self.held[0] = False
        self.rest, self.noise, self.n = log.rest, log.noise, rows
        self.force = None if log.force is None else log.force[part]
        self.tdc = None if log.tdc is None else log.tdc[part].copy()
        self.swing = np.maximum(np.percentile(np.abs(self.x - self.rest), 95, axis=0), 4 * self.noise)
        self.kept, self.free, self.late, self.numbered = np.arange(rows), set(ALL), [], False
        self.u = self.time / self.time[-1]

    @property
    def dev(self):
        return self.x - self.rest

    def of(self, *sizes):
        return sizes[self.level] * self.rng.uniform(0.9, 1.12)

    def side(self):
        return self.rng.choice((-1.0, 1.0))

    def pick(self, number, loud=True):
        pool = sorted(self.free, key=lambda k: -self.swing[k] / self.noise[k])
        pool = pool[: max(9, number)] if loud else pool
        out = sorted(int(k) for k in self.rng.choice(pool, number, replace=False))
        self.free -= set(out)
        return out

    def size(self, k):
        """Counts that a slow change of one electrode has at this level."""
        return self.of(1, 2.2, 5) * max(5 * self.noise[k], 0.12 * self.swing[k])

    def rows(self, seconds):
        return max(1, int(round(seconds * self.rate)))

    def ease(self, begin, length):
        """(n,) 0, then half a cosine to 1; both in shares of the piece."""
        v = np.clip((self.u - begin) / max(length, 1e-9), 0, 1)
        return 0.5 - 0.5 * np.cos(np.pi * v)

    def windows(self, number, share):
        """(n,) whether a row is in one of some stretches that do not touch."""
        on, cell = np.zeros(self.n, bool), self.n / number
        for i in range(number):
            length = int(np.clip(cell * share * self.rng.uniform(0.7, 1.3), 3, 0.85 * cell))
            first = int(i * cell + self.rng.uniform(0.05, 0.95) * (cell - length))
            on[first : first + length] = True
        return on

    def slow(self, seconds):
        """(n,) random, of unit RMS, slow"""
        y = gaussian_filter1d(self.rng.standard_normal(self.n), seconds * self.rate, mode="reflect")
        y -= y[0]
        return y / max(y.std(), 1e-9)

    def load(self):
        """(n,) 0..1"""
        y = np.sqrt(((self.dev / self.noise) ** 2).mean(1))
        y = gaussian_filter1d(y, 0.05 * self.rate)
        y = np.maximum(y - np.percentile(y, 5), 0)
        return y / max(np.percentile(y, 99), 1e-9)

    def impede(self, relative):
        """Changes all impedances by shares (n, 19)."""
        counts = np.maximum(self.rest, 200.0)
        self.x -= relative * counts * (1 - counts / 4095)

    def spread(self, width):
        return np.clip(1 + width * self.rng.standard_normal(19), 0.25, 2)


# of the vocabulary


def _gain(p, form):
    channels = p.pick({"swelling": 1, "corroding": 2, "three plateaus": 1}[form])
    size = p.of(0.18, 0.33, 0.55) * p.side()
    if form == "swelling":
        shape = np.sin(np.pi * np.clip((p.u - 0.15) / 0.8, 0, 1)) ** 2
    elif form == "corroding":
        size, shape = -abs(size), 1 - (1 + 12 * p.u) ** -0.7
    else:
        shape = sum(w * p.ease(b, 0.03) for b, w in ((0.2, 0.5), (0.45, 0.2), (0.7, 0.3)))
    p.x[:, channels] += p.dev[:, channels] * (size * shape)[:, None]
    return channels


def _sign(p, form):
    channels = p.pick(1)
    if form == "wiggled plug":  # goes through nothing
        flip = p.ease(0.3, 0.01) - p.ease(0.55, 0.01) + p.ease(0.68, 0.01)
    else:
        flip = p.windows(4, p.of(0.35, 0.5, 0.65)).astype(float)
    p.x[:, channels] -= 2 * p.dev[:, channels] * flip[:, None]
    return channels


def _permutation(p, form):
    if form == "three in a ring":
        channels = p.pick(3)
        on = p.u > p.rng.uniform(0.35, 0.6)
    else:
        channels = p.pick(2)
        on = p.windows(2, 0.55)
    p.x[np.ix_(on, channels)] = p.x[np.ix_(on, np.roll(channels, 1))]
    return channels


def _offset(p, form):
    if form == "brown-outs":
        y = np.zeros(p.n)
        for begin, depth in zip(np.sort(p.rng.uniform(0.1, 0.9, 4)), p.rng.uniform(0.4, 1, 4)):
            y -= depth * (p.ease(begin, 0.004) - 0.75 * p.ease(begin + p.rng.uniform(0.03, 0.1), 0.02))
        p.x += (y * p.of(4, 9, 22) * np.median(p.noise))[:, None]
        return ALL
    channels = p.pick(1, loud=False)
    k, begin = channels[0], p.rng.uniform(0.25, 0.55)
    if form == "ledge that creeps":
        after = np.maximum(p.u - begin, 0)
        y = p.ease(begin, 0.008) * (1 + 0.12 * np.log1p(40 * after))
    else:
        y = p.ease(begin, 0.02) - p.ease(begin + p.rng.uniform(0.15, 0.35), 0.03)
    p.x[:, k] += p.side() * p.size(k) * y
    return channels


def _drift(p, form):
    channels = p.pick(1, loud=False)
    k = channels[0]
    if form == "gompertz":
        y = np.exp(-5 * np.exp(-7 * p.u))
        y -= y[0]
    elif form == "lopsided triangle":
        y = np.interp(p.u, [0, 0.12, 0.34, 1], [0, 0, 1, 0.1])
    else:
        y = 5.4 * p.u * np.exp(-2 * p.u) * (1 + 0.15 * p.slow(0.12 * p.time[-1]))
    p.x[:, k] += p.side() * 1.5 * p.size(k) * y
    return channels


def _warm_up(p, form):
    y = np.tanh(np.sqrt(3 * p.u)) if form == "square root" else p.u**2.5 / (p.u**2.5 + 0.35**2.5)
    kelvin = p.of(0.25, 0.6, 1.4)
    if p.noise.max() < 1.5:  # grasps hold still
        kelvin *= 0.3
    p.impede(-_KELVIN * kelvin * np.outer(y, p.spread(0.2)))
    if p.tdc is not None:
        p.tdc += _TDC * kelvin * 0.4 * y**2
    return ALL


def _temperature(p, form):
    kelvin = p.of(0.25, 0.6, 1.4) * p.side() * (0.4 if p.noise.max() < 1.5 else 1)
    if form == "a hand comes near":
        y = p.ease(0.2, 0.35) - 0.8 * p.ease(0.6, 0.35)
    else:
        y = np.sin(2 * np.pi * (1.3 * p.u + 0.4 * p.u**2)) * p.ease(0, 0.2)
    p.tdc += _TDC * kelvin * y
    a = np.exp(-1 / (0.02 * p.n)) if form == "a hand comes near" else 0.0
    p.impede(-_KELVIN * kelvin * np.outer(lfilter([1 - a], [1, -a], y), p.spread(0.15)))
    return ALL


def _fluid_loss(p, form):
    if form == "weeps under load":
        y = np.cumsum(p.load() ** 1.5 + 0.02)
        y /= y[-1]
    elif form == "bursting seam":
        y = 0.25 * p.u**1.6 + 0.75 * np.clip((p.u - 0.4) / 0.6, 0, None) ** 0.6
    else:
        y = sum(p.ease(b, 0.05) for b in np.linspace(0.08, 0.88, 6)) / 6
    size = p.of(0.02, 0.05, 0.11) * (0.3 if p.noise.max() < 1.5 else 1)
    p.impede(size * np.outer(y, p.spread(0.35)))
    return ALL


def _relaxation(p, form):
    d, size = p.dev, p.of(0.12, 0.22, 0.38)
    sums = np.zeros_like(d)
    if form == "sinks under load alone":
        y, v = np.zeros(19), np.zeros_like(d)
        quick, tardy = 1 / (0.5 * p.rate), 1 / (5 * p.rate)
        for i in range(p.n):
            more = np.abs(d[i]) > np.abs(y)
            y = y + np.where(more, quick, tardy) * (d[i] - y)
            v[i] = y
        p.x -= size * v
        return ALL
    for tau, w in ((0.15, 0.4), (0.9, 0.35), (6.0, 0.25)):  # near a power of time
        a = np.exp(-1 / (tau * p.rate))
        sums += w * lfilter([1 - a], [1, -a], d, axis=0, zi=(a * d[:1]))[0]
    p.x += -size * sums if form == "power law" else size * (sums - d)  # the latter creeps
    return ALL


def _hysteresis(p, form):
    d, size, out = p.dev, p.of(0.18, 0.35, 0.6), np.zeros((p.n, 19))
    if form == "many stops":
        for r, w in ((0.08, 0.4), (0.2, 0.35), (0.4, 0.25)):
            y = d[0].copy()
            for i in range(p.n):
                y = np.clip(y, d[i] - r * p.swing, d[i] + r * p.swing)
                out[i] += w * y
    elif form == "bouc-wen":
        z, s = np.zeros(19), 0.35 * p.swing
        step = np.diff(d, axis=0, prepend=d[:1]) / s
        for i in range(p.n):
            dz = step[i] - 0.6 * np.abs(step[i]) * np.abs(z) * z - 0.4 * step[i] * z**2
            z = np.clip(z + dz, -1.2, 1.2)
            out[i] = d[i] - s * z
    else:  # a leaf: on the way back it reads more
        f, h = p.load(), -1.0
        for i in range(p.n):
            h = np.clip(h - 5 * (f[i] - f[i - 1] if i else 0), -1, 1)
            out[i] = d[i] * (1 + 0.5 * h)
    p.x += size * (out - d)
    return ALL


def _latency(p, form):
    seconds = p.of(0.045, 0.09, 0.18)
    if form == "wandering":
        seconds = seconds * (1 + 0.3 * np.clip(p.slow(4.0), -2, 2))
    fresh = ~p.held
    for k in ALL:
        p.x[:, k] = np.interp(p.time - seconds, p.time[fresh], p.x[fresh, k])
    return ALL


def _low_pass(p, form):
    if form == "two poles":
        w = 2 * np.pi * p.of(8, 4, 1.8) / p.rate
        a = np.exp(-w)
        y = lfilter([1 - a], [1, -a], p.dev - p.dev[0], axis=0)
        p.x = p.rest + p.dev[0] + lfilter([1 - a], [1, -a], y, axis=0)
        return ALL
    channels = p.pick(2 if form == "triangle" else 1)
    for k in channels:
        if form == "triangle":
            h = np.bartlett(2 * p.rows(p.of(0.07, 0.15, 0.35)) + 1)
            back = np.r_[np.full(len(h), p.x[0, k]), p.x[:, k]]
            p.x[:, k] = lfilter(h / h.sum(), [1], back)[len(h) :]
        else:  # a tracker that overshoots
            w, y, v = 2 * np.pi * p.of(7, 3.5, 1.6) / p.rate, p.x[0, k], 0.0
            for i in range(p.n):
                v += w * w * (p.x[i, k] - y) - 2 * 0.45 * w * v
                y += v
                p.x[i, k] = y
    return channels


def _noise(p, form):
    if form == "shared, heavy tails":
        y = np.clip(p.rng.standard_t(3, p.n), -9, 9)
        p.x += np.outer(y * p.of(0.5, 1, 2), p.noise * p.spread(0.15))
        return ALL
    channels = p.pick(1 if form == "pink" else 2, loud=False)
    for k in channels:
        if form == "pink":
            spectrum = np.fft.rfft(p.rng.standard_normal(p.n))
            f = np.maximum(np.fft.rfftfreq(p.n, 1 / p.rate), 1.0)
            y = np.fft.irfft(spectrum / np.sqrt(f), p.n)
            y /= y.std()
        else:
            y = p.rng.laplace(size=p.n) * p.windows(5, 0.5)
        p.x[:, k] += p.of(1.3, 2.8, 6) * p.noise[k] * y
    return channels


def _line_noise(p, form):
    size = p.of(0.6, 1.3, 2.8)
    if form == "beating":
        f, channels = p.rng.uniform(11, 24), ALL
        swell = 1 + 0.6 * np.cos(2 * np.pi * 0.21 * p.time + 1)
    else:
        f, channels, swell = p.rng.uniform(27, 42), p.pick(6, loud=False), 1.0
    for k in channels:
        phase = 2 * np.pi * (f * p.time + p.rng.uniform())
        p.x[:, k] += size * p.noise[k] * swell * (np.sin(phase) + 0.25 * np.sin(3 * phase + 0.7))
    return channels


def _cross_talk(p, form):
    d, size = p.dev, p.of(0.12, 0.24, 0.42)
    if form == "multiplexer remembers":
        first = int(p.rng.integers(1, 13))
        channels = list(range(first, first + 6))
        p.x[:, channels] += size * d[:, [k - 1 for k in channels]]
        return channels
    j, k = p.pick(2)
    p.x[:, k] += size * (1 + 0.25 * p.slow(5.0)) * d[:, j]
    return [k]


def _quantisation(p, form):
    if form == "odd step":
        step = max(3, int(p.of(1.4, 3, 6) * np.median(p.noise)))
        p.late.append(lambda x: np.rint((x - 1) / step) * step + 1)
    else:  # steps that grow with the deviation, as of a logarithmic format
        ratio = p.of(0.03, 0.07, 0.15)

        def coarse(x):
            e = x - p.rest
            return p.rest + np.sign(e) * np.expm1(np.rint(np.log1p(np.abs(e) / 4) / ratio) * ratio) * 4

        p.late.append(coarse)
    return ALL


def _saturation(p, form):
    channels = p.pick({"knee": 3, "rail that lets go late": 1, "squeezed": 2}[form])
    for k in channels:
        d = p.dev[:, k]
        room = p.of(1.5, 0.95, 0.55) * p.swing[k]
        if form == "knee":
            p.x[:, k] = p.rest[k] + d / (1 + np.abs(d / room) ** 3) ** (1 / 3)
        elif form == "squeezed":
            half = 0.4 * room
            p.x[:, k] = p.rest[k] + np.where(
                np.abs(d) > half, np.sign(d) * half * (1 + np.log(np.maximum(np.abs(d) / half, 1))), d
            )
        else:
            side = np.sign(d[np.argmax(np.abs(d))])
            low, since = np.minimum(side * d, room), 0
            for i in range(p.n):
                since = p.rows(0.12) if side * d[i] > room else since - 1
                if since > 0:
                    low[i] = room
            p.x[:, k] = p.rest[k] + side * low
    return channels


def _stuck(p, form):
    channels = p.pick(1)
    k = channels[0]
    on = p.windows(1 if form == "flickers" else 4, p.of(0.12, 0.3, 0.6))
    begins = np.flatnonzero(on & ~np.r_[False, on[:-1]])

    def hold(x):
        for a in begins:
            b = a + int(np.argmin(np.r_[on[a:], False]))
            x[a:b, k] = x[a, k]
            if form == "flickers":
                x[a:b, k] += p.rng.random(b - a) < 0.08
        return x

    p.late.append(hold)
    return channels


def _spikes(p, form):
    number = max(4, int(p.of(0.12, 0.25, 0.5) * p.time[-1]))
    fresh = np.flatnonzero(~p.held[5:-5]) + 5
    rows = p.rng.choice(fresh, number, replace=False)
    if form == "bit":
        channels = p.pick(1, loud=False)
        bit = (16, 64, 256)[p.level]

        def toggle(x):
            x[rows, channels[0]] = (x[rows, channels[0]].astype(int) ^ bit).astype(float)
            return x

        p.late.append(toggle)
        return channels
    channels = p.pick(1 if form == "pareto" else 4, loud=False)
    for k in channels:
        size = p.of(9, 18, 40) * p.noise[k] * np.minimum(1 + 0.5 * p.rng.pareto(2, number), 6)
        p.x[rows, k] += size * (p.side() if form == "pareto" else 1)
    return channels


def _lost_samples(p, form):
    number = (5, 9, 16)[p.level]
    if form == "radio, numbered rows":
        begins = np.sort(p.rng.choice(np.arange(20, p.n - 60), number, replace=False))
        lengths = 4 + p.rng.geometric(0.08, number)
        p.numbered = True
    else:
        begins = (np.arange(number) + 0.6) * p.n // (number + 1)
        lengths = np.full(number, p.rows(0.14))
    gone = np.zeros(p.n, bool)
    for a, length in zip(begins.astype(int), lengths):
        gone[a : a + length] = True
    p.kept = np.flatnonzero(~gone)
    return ALL


def _held_samples(p, form):
    on = np.zeros(p.n, bool)
    if form == "every so often":
        on = np.arange(p.n) % 23 < (4, 8, 13)[p.level]
    else:
        i = 10
        while i < p.n:
            length = int(np.clip(np.exp(p.rng.normal(2.0, 0.7)), 2, 60))
            on[i : i + length] = True
            i += length + int(length * p.rng.exponential((4, 2, 1)[p.level])) + 2

    def hold(x):
        i = np.where(on, 0, np.arange(p.n))
        return x[np.maximum.accumulate(i)]

    p.late.append(hold)
    return ALL


_LAWS = {
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
    "lost_samples": _lost_samples,
    "held_samples": _held_samples,
}
_COMMON = {"brown-outs": "count_offset", "shared, heavy tails": "common_noise"}


# outside the vocabulary


def _outside(p, form):
    d, t, s = p.dev, p.time, p.of(1, 2.2, 5)
    if form == "pulse":  # of the hand that holds the sensor, with a second wave
        phase = np.cumsum(1.15 * (1 + 0.05 * p.slow(3.0))) / p.rate % 1
        y = np.exp(-(((phase - 0.2) / 0.07) ** 2)) + 0.4 * np.exp(-(((phase - 0.5) / 0.09) ** 2))
        p.x -= np.outer(1.6 * s * y, p.noise * p.spread(0.4))
    elif form == "slosh":  # the liquid rings after a quick change of load
        w, z, a, b = 2 * np.pi * 4.3 / p.rate, 0.07, np.zeros(19), np.zeros(19)
        step = np.diff(d, axis=0, prepend=d[:1])
        for i in range(p.n):
            b = b - w * w * a - 2 * z * w * b + 0.35 * w * s * step[i] / 2
            a = a + b
            p.x[i] += a
    elif form == "dead zone":
        for k in p.pick(3):
            room = s * 0.08 * p.swing[k]
            p.x[:, k] = p.rest[k] + np.sign(d[:, k]) * np.maximum(np.abs(d[:, k]) - room, 0)
    elif form == "converter's steps":  # codes are not even: a saw tooth over each 64
        p.late.append(lambda x: x + 6 * s * ((x % 64) / 64 - 0.5))
    elif form == "old buffer":  # now and then 16 rows of the time before
        blocks = [i for i in range(2, p.n // 16 - 1) if p.rng.random() < 0.03 * s]

        def again(x):
            y = x.copy()
            for i in blocks:
                y[16 * i : 16 * i + 16] = x[16 * i - 32 : 16 * i - 16]
            return y

        p.late.append(again)
    elif form == "lossy blocks":  # coefficients of 32 rows that are small are dropped

        def squeeze(x):
            m = p.n // 32 * 32
            c = dct(x[:m].reshape(-1, 32, 19), axis=1, norm="ortho")
            c[:, 1:] = np.where(np.abs(c[:, 1:]) > 1.5 * s * p.noise, c[:, 1:], 0)
            x[:m] = idct(c, axis=1, norm="ortho").reshape(m, 19)
            return x

        p.late.append(squeeze)
    elif form == "supply sags":  # with the square of what all draw
        f = p.load()
        p.x -= np.outer(0.06 * s * f**2, np.percentile(np.abs(d), 90) * np.ones(19))
    elif form == "skin rolls":  # each electrode more and more feels what the next but one should
        share = np.minimum(0.12 * s, 0.8) * np.sin(np.pi / 2 * p.u)[:, None]
        p.x = p.rest + (1 - share) * d + share * np.roll(d / p.swing, 2, axis=1) * p.swing
    elif form == "draughts":  # cold puffs, each over neighbours
        for _ in range(max(3, int(p.time[-1] / 4))):
            width, middle = p.rng.uniform(0.3, 1.2), p.rng.uniform(0, t[-1])
            near = np.exp(-0.5 * ((np.arange(19) - p.rng.uniform(0, 19)) / 2.5) ** 2)
            p.x -= np.outer(np.exp(-(((t - middle) / width) ** 2)), 5 * s * p.noise * near)
    elif form == "chirps":  # a motor that starts and stops
        for begin in np.sort(p.rng.uniform(0.05, 0.9, max(3, int(p.time[-1] / 7)))) * t[-1]:
            v = np.clip((t - begin) / 1.5, 0, 1)
            y = np.sin(2 * np.pi * (4 * v + 9 * v**2) * 1.5) * np.sin(np.pi * v)
            p.x += np.outer(1.8 * s * y, p.noise * p.spread(0.3))
    elif form == "two bits exchanged":
        k, (a, b) = p.pick(1)[0], ((3, 5), (4, 6), (5, 7))[p.level]

        def bits(x):
            v = np.maximum(x[:, k], 0).astype(int)
            differ = ((v >> a) ^ (v >> b)) & 1
            x[:, k] = v ^ ((differ << a) | (differ << b))
            return x

        p.late.append(bits)
    elif form == "two banks":  # of a multiplexer, that go apart and together
        y = 3 * s * p.slow(1.0)
        p.x += np.outer(y, p.noise * np.where(np.arange(19) % 2, 1, -1))
    elif form == "knocks":  # at the table
        for begin in p.rng.uniform(0.03, 0.95, max(4, int(p.time[-1] / 5))) * t[-1]:
            v = np.maximum(t - begin, 0)
            y = np.sin(2 * np.pi * 11.3 * v) * np.exp(-v / 0.13)
            p.x += np.outer(3 * s * y, p.noise * p.spread(0.3))
    elif form == "carrier":  # its amplitude goes up and down in a triangle
        y = 2 * np.abs((0.17 * t) % 1 - 0.5) - 0.5
        p.x += np.outer(y, 5 * s * p.noise)
    elif form == "two wires touch":
        j, k = p.pick(2)
        on = p.windows(max(4, int(t[-1] / 3)), min(0.1 * s, 0.6))
        p.x[np.ix_(on, [j, k])] = p.x[np.ix_(on, [j, k])].mean(1, keepdims=True)
    else:
        raise KeyError(form)
    return ALL


_NOTHING = (
    *(["F1", "F1", "F1+f", "F1+f", "F1", "F2", "F2", "F2+f", "F2+f", "F2"]),
    *(["U"] * 5),
    *(["phac"] * 6),
    *(["slides", "slides+f", "slides"]),
    *(["scraping", "scraping"]),
    *(["btd"] * 4),
)
_SINGLES = (
    ("gain", "swelling", "F1"),
    ("gain", "corroding", "F2+f"),
    ("gain", "three plateaus", "btd"),
    ("sign", "wiggled plug", "F2"),
    ("sign", "on and off", "F1+f"),
    ("permutation", "three in a ring", "F1"),
    ("permutation", "for a while", "F2"),
    ("offset", "ledge that creeps", "U"),
    ("offset", "there and back", "phac"),
    ("offset", "brown-outs", "F1"),
    ("drift", "gompertz", "F2"),
    ("drift", "lopsided triangle", "U"),
    ("drift", "heap", "phac"),
    ("warm_up", "square root", "F2"),
    ("warm_up", "late", "phac"),
    ("temperature", "a hand comes near", "btd"),
    ("temperature", "fan", "phac"),
    ("fluid_loss", "weeps under load", "F1+f"),
    ("fluid_loss", "bursting seam", "U"),
    ("fluid_loss", "drop by drop", "btd"),
    ("relaxation", "power law", "F1+f"),
    ("relaxation", "creep", "F2+f"),
    ("relaxation", "sinks under load alone", "F2+f"),
    ("hysteresis", "many stops", "F2+f"),
    ("hysteresis", "bouc-wen", "F1+f"),
    ("hysteresis", "leaf", "F1+f"),
    ("latency", "constant", "F2+f"),
    ("latency", "wandering", "F1+f"),
    ("low_pass", "two poles", "F1"),
    ("low_pass", "triangle", "F2"),
    ("low_pass", "tracker", "btd"),
    ("noise", "pink", "U"),
    ("noise", "bursts", "scraping"),
    ("noise", "shared, heavy tails", "phac"),
    ("line_noise", "beating", "U"),
    ("line_noise", "some", "F2"),
    ("cross_talk", "multiplexer remembers", "F1"),
    ("cross_talk", "one hears", "F2"),
    ("quantisation", "odd step", "U"),
    ("quantisation", "logarithmic", "F1"),
    ("saturation", "knee", "F2"),
    ("saturation", "rail that lets go late", "F1"),
    ("saturation", "squeezed", "slides+f"),
    ("stuck", "flickers", "F1"),
    ("stuck", "four times", "slides"),
    ("spikes", "pareto", "U"),
    ("spikes", "discharge", "F2"),
    ("spikes", "bit", "phac"),
    ("lost_samples", "radio, numbered rows", "F1"),
    ("lost_samples", "even gaps", "F2"),
    ("held_samples", "every so often", "btd"),
    ("held_samples", "at random", "F2"),
)
_PAIRS = (
    ("F1", ("gain", "three plateaus"), ("warm_up", "square root")),
    ("U", ("stuck", "flickers"), ("line_noise", "beating")),
    ("U", ("noise", "pink"), ("drift", "gompertz")),
    ("F1+f", ("latency", "constant"), ("gain", "swelling")),
    ("F2", ("permutation", "for a while"), ("offset", "there and back")),
    ("btd", ("spikes", "discharge"), ("fluid_loss", "bursting seam")),
    ("F1", ("cross_talk", "one hears"), ("held_samples", "at random")),
    ("F2", ("low_pass", "two poles"), ("drift", "lopsided triangle")),
    ("F2", ("lost_samples", "radio, numbered rows"), ("sign", "wiggled plug")),
    ("phac", ("temperature", "fan"), ("noise", "bursts")),
)
_OUTSIDE = (
    ("pulse", "U"),
    ("pulse", "phac"),
    ("slosh", "F1"),
    ("dead zone", "F2"),
    ("converter's steps", "F1"),
    ("old buffer", "F2"),
    ("lossy blocks", "U"),
    ("supply sags", "F2+f"),
    ("skin rolls", "F1+f"),
    ("draughts", "U"),
    ("draughts", "btd"),
    ("chirps", "F2"),
    ("two bits exchanged", "F1"),
    ("two banks", "F1"),
    ("knocks", "U"),
    ("knocks", "slides"),
    ("carrier", "phac"),
    ("two wires touch", "F2"),
)
_GRASPS = [f"{t}_{i:02d}/F{f}" for t in ("acrylic_211", "car_sponge_101", "steel_vase_702")
           for i in range(1, 6) for f in (0, 1)]  # fmt: skip
_SLIDES = [f"mat{m}_{i}" for m in (1, 7, 12, 15, 18, 20) for i in (1, 2)]


def plan() -> list[Spec]:
    """110 pieces: 30 untouched, 52 with one effect, 10 with two, 18 with one outside the vocabulary."""
    rng = np.random.default_rng(_SEED)
    todo = [(base, ()) for base in _NOTHING]
    todo += [(base, ((kind, form),)) for kind, form, base in _SINGLES]
    todo += [(base, effects) for base, *effects in _PAIRS]
    todo += [(base, (("outside", form),)) for form, base in _OUTSIDE]
    levels = np.concatenate([rng.permutation(3) for _ in range(len(todo) // 3 + 1)])
    grasps, slides = list(rng.permutation(_GRASPS)), list(rng.permutation(_SLIDES))
    specs, scrapes = [], 0
    for number, (base, effects) in enumerate(todo):
        name, plus, _ = base.partition("+")
        if name == "phac":
            name = f"phac/{grasps.pop()}"
        elif name == "slides":
            name = f"slides/{slides.pop()}"
        elif name == "scraping":
            name, scrapes = f"scraping/{('LF', 'RF')[scrapes % 2]}", scrapes + 1
        specs.append(
            Spec(
                f"{number + 1:03d}",
                name + ("+f" if plus else ""),
                int(levels[number]) if effects else None,
                tuple(map(tuple, effects)),
            )
        )
    return specs


def make(spec: Spec, data: str) -> tuple[dict, np.ndarray]:
    """Fields of the case, its counts as a file has them, and the counts without what is hidden (n, 19)."""
    name, kind = spec.base.removesuffix("+f"), spec.base.removesuffix("+f").split("/")[0]
    log, rng = source(pathlib.Path(data), name), np.random.default_rng([_SEED, int(spec.name)])
    total = len(log.x)
    rows = int(rng.integers(4000, 8000)) if total > 5000 else total - int(rng.integers(0, total // 12))
    p = _Piece(log, rows, rng, spec.level or 0, kind == "slides")
    clean, channels = p.x.copy(), []
    for effect, form in spec.effects:
        channels.append(_outside(p, form) if effect == "outside" else _LAWS[effect](p, form))
    lowest = -4095 if kind in ("scraping", "slides") else 0

    def written(x, late):
        x = np.clip(np.rint(x), lowest, 4095)
        for act in late:
            x = np.clip(np.rint(act(x)), lowest, 4095)
        if log.held.mean() > 0.05:
            x = x[np.maximum.accumulate(np.where(p.held, 0, np.arange(p.n)))]
        return np.abs(x) if kind == "slides" else x

    counts, clean = written(p.x, p.late), written(clean, [])
    clock = p.time[: len(p.kept)] if p.numbered else p.time[p.kept]
    seen = [float(np.sqrt(((counts - clean) ** 2).mean(0) / p.noise**2).max())] if spec.effects else []
    case = {
        "base": f"fourteenth {kind}",
        "counts": counts[p.kept],
        "rate": p.rate,
        "force": p.force[p.kept] if spec.base.endswith("+f") else None,
        "tdc": None if p.tdc is None else np.rint(p.tdc)[p.kept],
        "loaded": kind in ("F1", "F2", "slides"),
        "channels": channels,
        "truth": list(spec.kinds),
        "forms": [f"{form} {spec.level}" for _, form in spec.effects],
        "seen": seen,
        "gaps": list(np.flatnonzero(np.diff(p.kept) > 1) + 1),
        "time": clock,
    }
    return case, clean
