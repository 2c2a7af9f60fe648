"""Pieces of recordings of real sensors with none, one or two hidden effects, by a thirteenth author.

    plan() -> list of Spec: what is hidden in which rows of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Numpy and scipy alone. Kinds are those of the benchmark's vocabulary (`KINDS`), forms are the author's own,
each faint, medium or strong. Each piece has a seed of its own. Effects act before the bus, so that rows which
the log repeats stay repeated. Grasps, slides and scrapes last 6 to 11 s and are taken whole or nearly so;
slides are absolute deviations from rest and scrapes are tared, as their files are (scrapes have negative
counts).
"""

import dataclasses
import pathlib

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import lfilter

from .sources import source as _source
from .vocabulary import KINDS

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

_SEED = 130924
_EPFL = 118.0  # [Hz] of the pressed sensors and the neighbour of one
_LEVELS = ("faint", "medium", "strong")
# what a base has by itself
NATURAL = {
    "thirteenth F1": {"warmup", "latency", "freeze"},
    "thirteenth F2": {"warmup", "latency", "freeze"},
    "thirteenth U": {"warmup", "freeze"},
    "thirteenth phac": {"warmup", "thermal", "fluidloss"},
    "thirteenth slides": {"warmup", "thermal", "fluidloss", "latency"},
    "thirteenth scraping": {"freeze", "latency"},
    "thirteenth btd": {"lost_rows", "spikes"},
}
ALL = list(range(19))


# ---------------------------------------------------------------- a piece


class _Piece:
    """Rows of a source on their way: x is changed in place; kept: rows that the log has; bus: whether rows
    that the source repeats are repeated again at the end; deviations: whether the log has their size
    alone."""

    def __init__(self, source, first, rows, force, level, rng, tared):
        part = slice(first, first + rows)
        self.x = source.x[part].copy()
        self.held = source.held[part].copy()
        self.held[0] = False
        self.time = source.time[part] - source.time[first]
        self.rate, self.noise, self.rest = source.rate, source.noise, source.rest
        self.force = source.force[part] if force and source.force is not None else None
        self.tdc = None if source.tdc is None else source.tdc[part].copy()
        self.n, self.level, self.rng, self.tared = len(self.x), level, rng, tared
        self.swing = np.maximum(np.percentile(np.abs(self.dev), 95, axis=0), 2 * self.noise)
        self.kept, self.bus, self.deviations = np.arange(self.n), True, False

    @property
    def dev(self):
        return self.x - self.rest

    @property
    def clock(self):
        return self.time / self.time[-1]

    def of(self, *sizes):
        """The level's size, a few per cent to either side."""
        return sizes[self.level] * self.rng.uniform(0.85, 1.2)

    def sign(self):
        return self.rng.choice((-1.0, 1.0))

    def pick(self, *numbers, loud=False):
        """So many channels of the level, of those that move most if loud."""
        number = numbers[self.level]
        among = np.argsort(-self.swing / self.noise)[: max(8, number)] if loud else np.arange(19)
        return sorted(int(k) for k in self.rng.choice(among, number, replace=False))

    def at(self, low=0.2, high=0.7):
        return int(self.n * self.rng.uniform(low, high))

    def after(self, low=0.2, high=0.7):
        """(n,) 0 before, 1 after a moment"""
        return (np.arange(self.n) >= self.at(low, high)).astype(float)

    def window(self, share):
        """rows of a stretch of so long a share"""
        length = max(3, int(self.n * min(share, 0.9)))
        first = int(self.rng.integers(1, self.n - length))
        return slice(first, first + length)

    def moments(self, number, edge=3):
        number = min(int(number), self.n // 8)
        return np.sort(self.rng.choice(np.arange(edge, self.n - edge - 1), max(1, number), replace=False))

    def smooth(self, seconds, columns=1):
        """(n, columns) random, slow, of unit RMS"""
        y = gaussian_filter1d(
            self.rng.standard_normal((self.n, columns)), seconds * self.rate, axis=0, mode="reflect"
        )
        y = y - y[0]
        return y / np.maximum(np.sqrt((y**2).mean(0)), 1e-9)

    def spread(self, width=0.3):
        return np.clip(1 + width * self.rng.standard_normal(19), 0.2, 2)

    def load(self):
        """(n,) how far the electrodes are from rest, 0..1"""
        y = np.sqrt(((self.dev / self.noise) ** 2).mean(1))
        y = np.maximum(gaussian_filter1d(y, 0.1 * self.rate) - np.percentile(y, 5), 0)
        return y / max(np.percentile(y, 99), 1e-9)

    def heat(self, counts):
        if self.tdc is not None:
            self.tdc += counts


def _pole(x, seconds, rate):
    """One pole from rest at the first row."""
    a = 1 - np.exp(-1 / (rate * seconds))
    return lfilter([a], [1, a - 1], x, axis=0, zi=((1 - a) * x[0])[None])[0]


def _later(x, rows):
    """x as it was (n,) or so many rows ago, between rows interpolated."""
    n = len(x)
    where = np.clip(np.arange(n) - rows, 0, n - 1)
    low = np.floor(where).astype(int)
    part = (where - low)[:, None]
    return x[low] * (1 - part) + x[np.minimum(low + 1, n - 1)] * part


# ---------------------------------------------------------------- laws


def _gain(p, form):
    k = p.pick(2, 3, 6, loud=True) if form != "supply" else ALL
    g = p.sign() * p.of(0.10, 0.22, 0.45)
    if form == "divider":  # a bias resistor of another size
        x = p.x[:, k]
        p.x[:, k] = x * (1 + g) if p.tared else 4095 * (1 + g) * x / (4095 + g * x)
    elif form == "trim":
        p.x[:, k] += g * p.dev[:, k]
    elif form == "joint":  # a solder joint gives way at a moment
        p.x[:, k] += p.after()[:, None] * g * p.dev[:, k]
    else:  # excitation sags slowly
        p.x -= abs(g) * p.clock[:, None] * (p.x if p.tared else p.dev)
    return k


def _sign(p, form):
    k = p.pick(1, 2, 4, loud=True)
    if form == "leads":
        p.x[:, k] -= 2 * p.dev[:, k]
    elif form == "complement":
        p.x[:, k] = -p.x[:, k] if p.tared else 4095 - p.x[:, k]
    else:  # for a while
        w = p.window((0.35, 0.5, 0.7)[p.level])
        p.x[w, k] -= 2 * p.dev[w, k]
    return k


def _permutation(p, form):
    if form == "pair":
        k = p.pick(2, 2, 4, loud=p.level < 2)
        order = [j for i in range(0, len(k), 2) for j in (k[i + 1], k[i])]
    elif form == "ring":
        k = p.pick(3, 4, 6)
        order = k[1:] + k[:1]
    elif form == "connector":  # a plug one pin off
        first, number = int(p.rng.integers(0, 10)), (3, 5, 9)[p.level]
        k = list(range(first, first + number))
        order = k[1:] + k[:1]
    else:  # mirrored bank, from a moment on
        first, number = int(p.rng.integers(0, 12)), (3, 4, 7)[p.level]
        k = list(range(first, first + number))
        order, s = k[::-1], p.at(0.3, 0.6)
        p.x[s:, k] = p.x[s:][:, order]
        return [i for i, j in zip(k, order, strict=True) if i != j]
    p.x[:, k] = p.x[:, order]
    return k


def _offset(p, form):
    size = p.of(4, 9, 22)
    if form == "reference":
        p.x += (p.sign() * size * np.median(p.noise) * p.spread(0.15)) * p.after()[:, None]
        return ALL
    k = p.pick(2, 3, 5)
    a = p.rng.choice((-1, 1), len(k)) * size * p.noise[k]
    if form == "knock":
        shape = p.after()
    elif form == "visit":  # there for a stretch, then back
        shape = np.zeros(p.n)
        shape[p.window(0.35)] = 1
    else:  # creeps in within a third of a second, in three stairs
        shape = sum(gaussian_filter1d(p.after(0.1, 0.85), 0.05 * p.rate) for _ in range(3)) / 3
    p.x[:, k] += a * shape[:, None]
    return k


def _drift(p, form):
    size, u = p.of(6, 14, 35), p.clock
    k = p.pick(4, 6, 10)
    a = p.rng.choice((-1, 1), len(k)) * size * p.noise[k] * p.rng.uniform(0.6, 1.3, len(k))
    if form == "ramp":
        p.x[:, k] += a * u[:, None]
    elif form == "walk":
        p.x[:, k] += 0.5 * a * p.smooth(0.15 * p.time[-1], len(k))
    elif form == "onset":
        s = p.rng.uniform(0.2, 0.5)
        p.x[:, k] += a * np.maximum(u - s, 0)[:, None] / (1 - s)
    else:  # electrodes age with the root of time
        p.x[:, k] += a * np.sqrt(u)[:, None]
    return k


def _warm_up(p, form):
    a, d, t = p.of(9, 22, 60) * np.median(p.noise) * p.spread(0.25), p.time[-1], p.time
    if form == "one":
        w = -np.expm1(-t / (d * p.rng.uniform(0.2, 0.35)))
    elif form == "two":
        w = -0.5 * np.expm1(-t / (0.06 * d)) - 0.5 * np.expm1(-t / (0.5 * d))
    elif form == "standby":  # warm, off for a moment, warms anew
        s = t[p.at(0.15, 0.4)]
        w = np.where(t < s, 1, 1 - np.exp(-(t - s) / (0.2 * d)))
    else:  # the core lags the electronics: S-shaped
        q = t / (0.12 * d)
        w = 1 - (1 + q) * np.exp(-q)
    p.x += a * w[:, None]
    p.heat((6, 15, 40)[p.level] * w)
    return ALL


def _temperature(p, form):
    a, u = p.sign() * p.of(7, 16, 40) * np.median(p.noise) * p.spread(0.2), p.clock
    if form == "room":
        w = np.sin(2 * np.pi * p.rng.uniform(0.8, 1.6) * u)
    elif form == "draught":
        s, tau = p.rng.uniform(0.15, 0.4), p.rng.uniform(0.1, 0.16)
        q = np.maximum(u - s, 0) / tau
        w = q * np.exp(1 - q)
    elif form == "thing":  # what it touches cools it while it touches
        w = _pole(p.load()[:, None], 0.12 * p.time[-1], p.rate)[:, 0]
        w = w / max(w.max(), 1e-9)
    else:  # a heater that a thermostat switches
        q = (u * p.rng.uniform(3, 5)) % 1 < 0.5
        w = _pole(q.astype(float)[:, None], 0.06 * p.time[-1], p.rate)[:, 0]
    p.x += a * w[:, None]
    p.heat(np.sign(a[0]) * (5, 12, 30)[p.level] * w)
    return ALL


def _fluid_loss(p, form):
    size, u = p.of(8, 20, 50), p.clock
    if form == "weep":
        w = u
    elif form == "puncture":
        s = p.rng.uniform(0.2, 0.5)
        w = np.where(u < s, 0, -np.expm1(-np.maximum(u - s, 0) / 0.25))
    else:  # every press squeezes some out
        w = np.cumsum(p.load() ** 1.5 + 1e-4)
        w = w / w[-1]
    pattern = p.noise * np.clip(1 + 0.4 * p.rng.standard_normal(19), 0.3, 2)
    grow = p.of(0.06, 0.15, 0.3)
    p.x += grow * w[:, None] * p.dev - size * w[:, None] * pattern
    return ALL


def _relaxation(p, form):
    c, dev = p.of(0.10, 0.22, 0.4), p.dev
    if form == "solid":
        p.x += c * (dev - _pole(dev, p.rng.uniform(1.0, 3.0), p.rate))
    elif form == "spectrum":
        p.x += c * sum(dev - _pole(dev, s, p.rate) for s in (0.4, 1.6, 6.4)) / 3
    else:  # slow to come back after release, quick to follow a press
        slow = np.empty_like(dev)
        slow[0], a = dev[0], 1 - np.exp(-1 / (p.rate * p.rng.uniform(0.8, 2)))
        for i in range(1, p.n):
            up = np.abs(dev[i]) > np.abs(slow[i - 1])
            slow[i] = np.where(up, dev[i], slow[i - 1] + a * (dev[i] - slow[i - 1]))
        p.x += 1.3 * c * (slow - dev)
    return ALL


def _hysteresis(p, form):
    dev, c = p.dev, p.of(0.06, 0.13, 0.28)
    if form == "slack":
        y, w = dev.copy(), c * p.swing
        for i in range(1, p.n):
            y[i] = np.clip(y[i - 1], dev[i] - w, dev[i] + w)
        p.x += y - dev
    elif form == "branches":  # below on the way out, above on the way back
        rise = np.gradient(gaussian_filter1d(np.abs(dev), 0.15 * p.rate, axis=0), axis=0) * p.rate
        way = np.tanh(rise / (0.3 * p.swing))
        p.x -= 1.4 * c * np.abs(dev) * np.sign(dev) * gaussian_filter1d(way, 0.05 * p.rate, axis=0)
    else:  # stops of several heights
        for share in (0.3, 1, 2.5):
            s, h = np.zeros_like(dev), share * c * p.swing
            for i in range(1, p.n):
                s[i] = np.clip(s[i - 1] + dev[i] - dev[i - 1], -h, h)
            p.x += 0.5 * s
    return ALL


def _latency(p, form):
    delay = p.of(0.04, 0.1, 0.25) * p.rate
    k = ALL
    if form == "all":
        p.x = _later(p.x, round(delay))
    elif form == "bank":
        first, number = int(p.rng.integers(0, 10)), (4, 6, 9)[p.level]
        k = list(range(first, first + number))
        p.x[:, k] = _later(p.x[:, k], round(delay))
    elif form == "queue":  # a buffer that fills up
        p.x = _later(p.x, np.round(2 * delay * p.clock))
    else:
        k = p.pick(2, 3, 5, loud=True)
        p.x[:, k] = _later(p.x[:, k], delay)
    return k


def _low_pass(p, form):
    tau = p.of(0.04, 0.12, 0.4)
    if form == "rc":
        k = p.pick(3, 5, 8, loud=True)
        p.x[:, k] = _pole(p.x[:, k], tau, p.rate)
        return k
    if form == "mean":
        size = max(3, round(2.5 * tau * p.rate))
        p.x = uniform_filter1d(p.x, size, axis=0, origin=(size - 1) // 2, mode="nearest")
    elif form == "double":
        p.x = _pole(_pole(p.x, tau / 2, p.rate), tau / 2, p.rate)
    else:  # switched on at a moment
        s = p.at(0.25, 0.6)
        p.x[s:] = _pole(p.x[s:], tau, p.rate)
    return ALL


def _noise(p, form):
    size = p.of(1.2, 2.5, 6)
    k = p.pick(2, 4, 8)
    y = p.rng.standard_normal((p.n, len(k)))
    if form == "flicker":
        f = np.fft.rfftfreq(p.n, 1 / p.rate)
        f[0] = np.inf
        y = np.fft.irfft(np.fft.rfft(y, axis=0) / np.sqrt(np.maximum(f, 0.3))[:, None], p.n, axis=0)
        y = 1.3 * y / y.std(0)
    elif form == "fits":
        on = gaussian_filter1d(p.rng.standard_normal(p.n), 0.4 * p.rate)
        y *= 1.6 * (on > np.percentile(on, 65))[:, None]
    elif form == "amplifier":  # common to all
        k, y = ALL, p.rng.standard_normal((p.n, 1)) * p.spread(0.2)
    p.x[:, k] += size * p.noise[k] * y
    return k


def _line_noise(p, form):
    f = p.rng.choice((50.0, 60.0)) * (1 + 2e-4 * p.rng.standard_normal())
    phase = 2 * np.pi * (f * p.time + p.rng.uniform()) + 0.1 * np.cumsum(
        p.rng.standard_normal(p.n)
    ) / np.sqrt(p.rate)
    k = ALL if form != "lead" else p.pick(2, 4, 6)
    a = p.of(1.5, 3, 7) * p.noise[k] * p.spread(0.25)[k]
    if form in ("mains", "lead"):
        y = np.sin(phase)
        if abs(f - 50) < 1 and p.rate == 100:  # off the zero crossings
            y = np.sin(phase * 0.992)
    elif form == "rectified":
        y = 0.7 * np.sin(2.003 * phase) + 0.5 * np.sin(3.996 * phase + 1)
    else:  # a machine nearby that runs at times
        on = (p.clock * p.rng.uniform(2, 4) + p.rng.uniform()) % 1 < 0.55
        y = 1.2 * np.sin(0.47 * phase) * gaussian_filter1d(on.astype(float), 0.2 * p.rate)
    p.x[:, k] += a * y[:, None]
    return k


def _cross_talk(p, form):
    c, dev = p.of(0.08, 0.18, 0.4), p.dev
    if form == "neighbours":
        k = p.pick(4, 7, 12, loud=True)
        for i in k:
            p.x[:, i] += c * 0.5 * (dev[:, (i - 1) % 19] + dev[:, (i + 1) % 19])
    elif form == "settling":  # the converter keeps a part of the channel before
        k, x = ALL, dev if p.tared else p.x
        p.x = p.x + 0.6 * c * (np.roll(x, 1, 1) - x)
    elif form == "aggressor":
        a = int(np.argmax(p.swing / p.noise))
        k = [i for i in p.pick(4, 6, 11) if i != a]
        p.x[:, k] += c * dev[:, [a]] * p.rng.uniform(0.6, 1.2, len(k))
    else:  # a common return
        k = ALL
        p.x += c * dev.mean(1, keepdims=True) * 4
    return k


def _quantisation(p, form):
    q = p.of(4, 8, 20)
    if form == "bits":
        q = 2 ** round(np.log2(q * np.median(p.noise)) - 0.3)
        p.x = np.floor(p.x / q) * q
        return ALL
    k = p.pick(3, 6, 12)
    step = np.maximum(np.round(q * p.noise[k]), 3)
    if form == "round":
        p.x[:, k] = np.round(p.x[:, k] / step) * step
    elif form == "deadband":  # sent when it has moved by a step
        for i, w in zip(k, step * 0.6, strict=True):
            last = p.x[0, i]
            for j in range(p.n):
                if abs(p.x[j, i] - last) >= w:
                    last = p.x[j, i]
                p.x[j, i] = last
    else:  # from a moment on
        s = p.at(0.2, 0.5)
        p.x[s:, k] = np.floor(p.x[s:, k] / step) * step
    return k


def _saturation(p, form):
    k = p.pick(3, 5, 9, loud=True)
    share = (6, 16, 32)[p.level]
    x = p.x[:, k]
    low, high = np.percentile(x, share, axis=0), np.percentile(x, 100 - share, axis=0)
    if form == "ceiling":
        p.x[:, k] = np.minimum(x, np.round(high))
    elif form == "floor":
        p.x[:, k] = np.maximum(x, np.round(low))
    elif form == "knee":  # bends before it stops
        mid = np.median(x, 0)
        h = np.maximum(np.where(high - mid > mid - low, high - mid, mid - low), 2 * p.noise[k])
        p.x[:, k] = mid + h * np.tanh((x - mid) / h)
    else:
        p.x[:, k] = np.clip(x, np.round(low), np.round(high))
    return k


def _stuck(p, form):
    k = p.pick(1, 2, 3)
    if form == "last":
        s = p.at(0.35, 0.75)
        p.x[s:, k] = p.x[s, k]
    elif form == "rail":
        w = p.window((0.1, 0.25, 0.6)[p.level])
        p.x[w, k] = (-400 if p.rng.random() < 0.5 else 400) if p.tared else p.rng.choice((0, 4095))
    elif form == "contact":  # comes and goes
        for _ in range((3, 5, 9)[p.level]):
            w = p.window(p.rng.uniform(0.03, 0.09))
            p.x[w, k] = p.x[w.start, k]
    else:  # dead from the beginning, the last bit alive
        p.x[:, k] = np.round(p.rest[k]) + (p.rng.random((p.n, len(k))) < 0.15)
    return k


def _spikes(p, form):
    number = max(3, p.time[-1] * (0.15, 0.35, 0.9)[p.level])
    where, size = p.moments(number), (10, 22, 60)[p.level]
    if form == "common":
        for i in where:
            p.x[i] += p.sign() * size * p.noise * p.rng.uniform(0.5, 1.6, 19)
        return ALL
    k = p.pick(1, 3, 6)
    for i in where:
        j = int(p.rng.choice(k))
        a = p.sign() * size * p.noise[j] * p.rng.uniform(0.8, 2)
        if form == "single":
            p.x[i, j] += a
        elif form == "doublet":
            p.x[i : i + 2, j] += (a, -0.7 * a)
        else:
            tail = min(8, p.n - i)
            p.x[i : i + tail, j] += a * 0.5 ** np.arange(tail)
    return k


def _lost(p, form):
    keep = np.ones(p.n, bool)
    if form == "gaps":
        for i in p.moments((2, 4, 8)[p.level], 30):
            keep[i : i + min(int(p.rate * p.of(0.1, 0.25, 0.5)), p.n // 40)] = False
    elif form == "scattered":
        keep = p.rng.random(p.n) > (0.015, 0.04, 0.12)[p.level]
    else:  # the disk flushes at a steady pace
        every = int(p.rate * (3.1, 1.9, 1.1)[p.level])
        for i in range(int(p.rng.integers(5, every)), p.n, every):
            keep[i : i + (3, 5, 9)[p.level]] = False
    keep[:2] = keep[-2:] = True
    p.kept = np.flatnonzero(keep)
    return ALL


def _frozen(p, form):
    k, index = ALL, np.arange(p.n)
    if form == "stalls":
        for i in p.moments((4, 7, 14)[p.level], 20):
            stop = min(p.n, i + max(4, int(p.rate * p.of(0.12, 0.3, 0.7))))
            index[i:stop] = i
    elif form == "slow_bus":  # a clock that is divided
        every = (2, 4, 9)[p.level]
        index = index // every * every
    else:  # a part of the channels misses frames
        k = p.pick(5, 8, 12)
        old = p.rng.random(p.n) < (0.2, 0.4, 0.7)[p.level]
        index = np.maximum.accumulate(np.where(old, 0, index))
    p.x[:, k] = p.x[index][:, k]
    return k


LAWS = {
    "gain": (_gain, "divider trim joint supply"),
    "sign": (_sign, "leads complement while"),
    "permutation": (_permutation, "pair ring connector bank"),
    "offset": (_offset, "reference knock visit stairs"),
    "drift": (_drift, "ramp walk onset root"),
    "warm_up": (_warm_up, "one two standby core"),
    "temperature": (_temperature, "room draught thing thermostat"),
    "fluid_loss": (_fluid_loss, "weep puncture squeezed"),
    "relaxation": (_relaxation, "solid spectrum release"),
    "hysteresis": (_hysteresis, "slack branches stops"),
    "latency": (_latency, "all bank queue few"),
    "low_pass": (_low_pass, "rc mean double onset"),
    "noise": (_noise, "white flicker fits amplifier"),
    "line_noise": (_line_noise, "mains lead rectified machine"),
    "cross_talk": (_cross_talk, "neighbours settling aggressor return"),
    "quantisation": (_quantisation, "bits round deadband onset"),
    "saturation": (_saturation, "ceiling floor knee both"),
    "stuck": (_stuck, "last rail contact dead"),
    "spikes": (_spikes, "common single doublet tail"),
    "lost_samples": (_lost, "gaps scattered flush"),
    "held_samples": (_frozen, "stalls slow_bus frames"),
}
_LOADED = {
    "gain",
    "sign",
    "relaxation",
    "hysteresis",
    "latency",
    "low_pass",
    "cross_talk",
    "saturation",
    "permutation",
}
_LOADED |= {"fluid_loss"}


# ---------------------------------------------------------------- outside the catalogue


def _bubble(p):
    """An air bubble wanders along the pad: electrodes on its way see less liquid, one after the other."""
    way = 9 + 8 * p.smooth(0.2 * p.time[-1])[:, 0]
    shade = np.exp(-(((np.arange(19) - way[:, None]) / 1.8) ** 2))
    p.x -= p.of(12, 28, 70) * p.noise * shade


def _bubble_pumped(p):
    """A bubble under two electrodes is pressed away by load and comes back late."""
    k = p.pick(2, 3, 4)
    gone = 1 - np.clip(_pole(p.load()[:, None], 0.6, p.rate) * 2, 0, 1)
    p.x[:, k] += p.of(12, 28, 60) * p.noise[k] * (gone - gone[0])


def _unbonded(p):
    """The membrane is loose in part: there the response is shifted beyond a threshold and flutters."""
    first = int(p.rng.integers(0, 13))
    k = list(range(first, first + 6))
    y, h = p.load(), p.rng.uniform(0.25, 0.45)
    off = 1 / (1 + np.exp(-(y - h) / 0.04))
    flutter = 1 + 0.25 * p.smooth(0.08)[:, 0]
    p.x[:, k] += p.of(10, 24, 60) * p.noise[k] * (off * flutter)[:, None]


def _esd(p):
    """Discharges: all channels jump, the amplifiers recover with their own times, a residue stays."""
    for i in p.moments((2, 3, 6)[p.level], 20):
        a = p.sign() * p.of(20, 45, 110) * p.noise * p.rng.uniform(0.3, 1.7, 19)
        t = (np.arange(p.n - i) / p.rate)[:, None]
        p.x[i:] += a * (np.exp(-t / p.rng.uniform(0.05, 0.5, 19)) + 0.06)


def _ghost(p):
    """The multiplexer shows a channel another's value for single rows, more often for two codes."""
    for i in p.moments(max(6, p.time[-1] * (0.4, 1, 3)[p.level])):
        j = int(p.rng.choice((4, 12, int(p.rng.integers(0, 19)))))
        p.x[i, j] = p.x[i, (j + 8) % 19]


def _missing_codes(p):
    """Wide codes at the converter's major carries: values near multiples of a power of two are never read."""
    q, w = (64, 64, 128)[p.level], int((7, 14, 34)[p.level])
    r = np.mod(p.x + w, q)
    p.x = np.where(r < 2 * w, p.x - r + w + np.where(r < w, -w, w), p.x)


def _bit(p):
    """One bit of the word follows its neighbour at times: errors of exactly a power of two."""
    value = (16, 32, 128)[p.level]
    wrong = p.rng.random((p.n, 19)) < (0.03, 0.06, 0.15)[p.level]
    x = np.round(p.x).astype(int)
    p.x = np.where(wrong & ((x & (2 * value)) > 0), x | value, x).astype(float)


def _clock_wander(p):
    """The converter's clock wanders against the log's: rows are taken early and late."""
    p.x = _later(p.x, np.abs(p.smooth(1.5)[:, 0]) * p.of(0.06, 0.15, 0.4) * p.rate)


def _mixed_files(p):
    """A stretch of the rows is another time's of the same file, without a seam in the levels."""
    length = int(p.n * (0.12, 0.2, 0.35)[p.level])
    a = int(p.rng.integers(1, p.n // 2 - length // 2))
    b = min(a + length + int(p.n * 0.1), p.n - length)
    p.x[a : a + length] = p.x[b : b + length].copy() + (p.x[a] - p.x[b]) * 0.5
    p.bus = False


def _droop(p):
    """The reference droops when many electrodes draw current: all counts rise by a share of themselves."""
    y = _pole(p.load()[:, None], 0.3, p.rate)
    y = y * np.mod(p.clock * p.rng.uniform(2, 4), 1)[:, None]
    scale = p.x / 3000 if not p.tared else np.ones((1, 19))
    p.x += p.of(8, 20, 50) * np.median(p.noise) * y * scale


def _wrapped(p):
    """A narrow word: what exceeds a power of two above the channel's middle wraps around."""
    k = p.pick(2, 4, 7, loud=True)
    for i in k:
        width = 2 ** int(np.ceil(np.log2(max(8, (0.9, 0.7, 0.5)[p.level] * np.ptp(p.x[:, i])))))
        width = width // 2 if width > np.ptp(p.x[:, i]) else width
        base = np.round(np.median(p.x[:, i]) - width / 2)
        p.x[:, i] = base + np.mod(p.x[:, i] - base, width)


def _telegraph(p):
    """A charge trap: a few channels hop between two levels at random."""
    k = p.pick(1, 3, 5)
    for i in k:
        hop = p.rng.random(p.n) < 1 / (p.rate * p.rng.uniform(0.3, 1.5))
        p.x[:, i] += p.of(5, 10, 25) * p.noise[i] * (np.cumsum(hop) % 2)


def _levelled(p):
    """A firmware's automatic levelling takes out a part of the common change, slowly, and lets go in
    steps."""
    common = np.median(p.dev / p.noise, axis=1)
    every = int(p.rate * p.rng.uniform(1.5, 3))
    steps = common[np.arange(p.n) // every * every]
    p.x -= p.of(0.35, 0.6, 1.0) * steps[:, None] * p.noise + p.of(1, 2, 4) * np.round(p.smooth(2)) * p.noise


def _resampled(p):
    """The logger resampled by cubic averages and sharpened: overshoot at every edge, noise coloured."""
    soft = gaussian_filter1d(p.x, 0.03 * p.rate, axis=0)
    p.x = soft + p.of(1.5, 3, 7) * (soft - gaussian_filter1d(soft, 0.05 * p.rate, axis=0))


def _torn(p):
    """Torn frames: the first channels of a row are new, the others those of rows before."""
    x = p.x.copy()
    back = (4, 8, 20)[p.level]
    for i in p.moments(p.n * (0.04, 0.1, 0.1)[p.level], 25):
        cut = int(p.rng.integers(4, 16))
        p.x[i, cut:] = x[i - back, cut:]


def _charge(p):
    """Rubbing charges the skin: motion is rectified into a potential which leaks away."""
    move = np.abs(np.gradient(gaussian_filter1d(p.dev / p.noise, 0.05 * p.rate, axis=0), axis=0)).mean(1)
    y = _pole(move[:, None], 0.08 * p.time[-1], p.rate) - move[0]
    y = y - y[0]
    p.x += p.of(10, 22, 55) * p.noise * y / max(np.abs(y).max(), 1e-9) * p.spread(0.6)


def _bridge(p):
    """A film of liquid bridges two electrodes for a while: both read their mean."""
    k = p.pick(2, 2, 2, loud=True)
    shape = np.zeros(p.n)
    shape[p.window((0.15, 0.3, 0.6)[p.level])] = (0.3, 0.6, 1)[p.level]
    w = gaussian_filter1d(shape, 0.1 * p.rate)[:, None]
    p.x[:, k] = p.x[:, k] * (1 - w) + w * p.x[:, k].mean(1, keepdims=True)


def _servo(p):
    """A hand's servo hunts: pulses of shrinking amplitude, alike in all channels, with their own signs."""
    a = p.rng.choice((-1, 1), 19) * p.noise * p.rng.uniform(0.3, 1.5, 19)
    f = p.rng.uniform(3, 9)
    for i in p.moments((3, 5, 9)[p.level], 20):
        t = (np.arange(p.n - i) / p.rate)[:, None]
        p.x[i:] += p.of(3, 7, 16) * a * np.exp(-t / 0.5) * np.sin(2 * np.pi * f * t)


OUTSIDE = {
    "bubble": _bubble,
    "bubble_pumped": _bubble_pumped,
    "unbonded": _unbonded,
    "esd": _esd,
    "ghost": _ghost,
    "missing_codes": _missing_codes,
    "bit": _bit,
    "clock_wander": _clock_wander,
    "mixed_files": _mixed_files,
    "droop": _droop,
    "wrapped": _wrapped,
    "telegraph": _telegraph,
    "levelled": _levelled,
    "resampled": _resampled,
    "torn": _torn,
    "charge": _charge,
    "bridge": _bridge,
    "servo": _servo,
}


# ---------------------------------------------------------------- the plan


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base, with +f at its end where the file has the force; first: row of the source; rows;
    level: faint, medium, strong; effects: of (kind, form), the author's names, of one outside (kind, "")."""

    name: str
    base: str
    first: int
    rows: int
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


_PAIRS = (
    ("gain", "noise"),
    ("offset", "line_noise"),
    ("drift", "spikes"),
    ("warm_up", "quantisation"),
    ("temperature", "stuck"),
    ("fluid_loss", "held_samples"),
    ("relaxation", "offset"),
    ("hysteresis", "noise"),
    ("latency", "line_noise"),
    ("low_pass", "drift"),
    ("cross_talk", "lost_samples"),
    ("saturation", "spikes"),
    ("permutation", "warm_up"),
    ("sign", "noise"),
    ("gain", "held_samples"),
    ("stuck", "lost_samples"),
    ("cross_talk", "quantisation"),
)
_ROWS = {"F1": 22508, "F2": 23671, "U": 22508, "btd": 2123, "scraping": 1122, "phac": 1000, "slides": 600}
_ANY = ("F1", "U", "btd", "F2", "phac", "U", "scraping", "F2", "slides", "btd", "F1", "phac")
_PRESSED = ("F1", "F2", "btd", "F2", "F1", "slides", "F2", "btd", "F1", "scraping")
_THINGS = [
    f"{t}_{trial:02d}" for t in ("acrylic_211", "car_sponge_101", "steel_vase_702") for trial in range(1, 6)
]
_SLIDES = [f"mat{material}_{trial}" for material in (12, 15, 18, 1, 20, 7) for trial in (1, 2)]


def _stretch(base, rng):
    """Full name of the source, first row, rows."""
    total, rate = _ROWS[base], _EPFL if base in ("F1", "F2", "U") else 100.0
    if base == "phac":
        return f"phac/{rng.choice(_THINGS)}/F{rng.integers(0, 2)}", 0, total
    if base == "slides":
        slide = str(rng.choice(_SLIDES))
        return (
            f"slides/{slide}" + ("+f" if rng.random() < 0.5 else ""),
            0,
            600 if slide.startswith("mat1_") else 799,
        )
    if base == "scraping":
        rows = int(rng.integers(850, total + 1))
        return f"scraping/{rng.choice(('LF', 'RF'))}", int(rng.integers(0, total - rows + 1)), rows
    seconds = np.exp(rng.uniform(np.log(15), np.log(110))) if base != "btd" else rng.uniform(15, 55)
    rows = min(int(seconds * rate), total - 2)
    if base == "btd":  # rows are fewer than the clock's: of every five frames four are kept
        rows = int(rows * 0.4)
    rows = min(max(rows, 500), total)
    name = base + ("+f" if base in ("F1", "F2") and rng.random() < 0.5 else "")
    return name, int(rng.integers(0, total - rows)), rows


def plan() -> list[Spec]:
    """180 pieces: 40 untouched, 96 with one effect, 17 with two, 27 with one outside the catalogue."""
    rng = np.random.default_rng([_SEED])
    todo = [(_ANY[i % len(_ANY)], None, ()) for i in range(40)]
    kinds, level, turn = list(LAWS), 0, [0, 0]
    extra = set(rng.choice(len(kinds), 12, replace=False))

    def where(pressed):
        turn[pressed] += 1
        return (_ANY, _PRESSED)[pressed][turn[pressed] % (len(_ANY), len(_PRESSED))[pressed]]

    for number, kind in enumerate(kinds):
        forms = LAWS[kind][1].split()
        for i in range(4 + (number in extra)):
            level += 1
            base = where(kind in _LOADED)
            if kind == "sign" and base == "slides":  # without a sign
                base = "F2"
            todo.append((base, _LEVELS[level % 3], ((kind, forms[(i + number) % len(forms)]),)))
    for a, b in _PAIRS:
        level += 1
        forms = [str(rng.choice(LAWS[kind][1].split())) for kind in (a, b)]
        todo.append(
            (where(bool(_LOADED & {a, b})), _LEVELS[max(level % 3, 1)], ((a, forms[0]), (b, forms[1])))
        )
    names = list(OUTSIDE)
    for i in range(27):
        name = names[i % len(names)]
        pressed = {"bubble_pumped", "unbonded", "clock_wander", "mixed_files", "droop", "wrapped", "charge"}
        pressed |= {"bridge", "levelled", "torn"}
        todo.append((where(name in pressed), _LEVELS[max(i % 3, i // 18)], ((name, ""),)))
    order = rng.permutation(len(todo))
    specs = []
    for number, i in enumerate(order, 1):
        base, level, effects = todo[i]
        specs.append(Spec(f"{number:03d}", *_stretch(base, rng), level, effects))
    return specs


def make(spec: Spec, data: str) -> tuple[dict, np.ndarray]:
    """Fields of the case, its counts as a file has them, and the counts without what is hidden (n, 19), rows
    that are lost later among them."""
    folder, name = pathlib.Path(data), spec.base.removesuffix("+f")
    kind = name.split("/")[0]
    source, level = _source(folder, name), _LEVELS.index(spec.level) if spec.level else 0
    rng = np.random.default_rng([_SEED, int(spec.name)])
    tared = kind in ("scraping", "slides")
    p = _Piece(source, spec.first, spec.rows, spec.base.endswith("+f"), level, rng, tared)
    p.deviations = kind == "slides"
    clean, channels = p.x.copy(), []
    for effect, form in spec.effects:
        if spec.outside:
            OUTSIDE[effect](p)
            channels.append(ALL)
        else:
            channels.append(LAWS[effect][0](p, form))
    counts, seen = _written(p, -4095 if kind == "scraping" else 0), []
    if spec.effects:
        seen = [float(np.sqrt(((counts - clean) ** 2).mean(0) / p.noise**2).max())]
    digits = 6 if kind in ("btd", "slides") else 5
    case = {
        "base": f"thirteenth {kind}",
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
    return np.round(x, number)


def _written(p, lowest):
    """Counts as the log has them: integers within the converter's range, repeated where the bus repeats."""
    x = np.clip(np.round(np.abs(p.x) if p.deviations else p.x), lowest, 4095)
    if p.bus:
        x = x[np.maximum.accumulate(np.where(p.held, 0, np.arange(p.n)))]
    return x
