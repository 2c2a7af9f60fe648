"""Pieces of recordings of real sensors with none, one or two hidden effects, by a seventeenth author.

    plan() -> list of Spec: what is hidden in which piece of which sensor
    make(spec, data) -> (case: fields of authors.first.Case, clean (n, 19): without what is hidden)

Written as one who keeps a laboratory's sensors would note their faults: when each begins, what it does and
whether it ends. A form is an array to be added, at any scale; or f(a), what is read at strength 0 < a <= 1;
or a list of what might be read. Its strength is drawn in multiples of the electrodes' noise (`fast` forms) or
of what the other electrodes leave unexplained of them.
"""

import dataclasses
import pathlib
import zlib

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.signal import lfilter

from authors.sources import source
from authors.vocabulary import KINDS

__all__ = ["KINDS", "NATURAL", "Spec", "make", "plan"]

NATURAL = {
    "seventeenth F1": {"warmup", "latency", "freeze"},
    "seventeenth F2": {"warmup", "latency", "freeze"},
    "seventeenth U": {"warmup", "freeze"},
    "seventeenth phac": {"warmup", "thermal", "fluidloss"},
    "seventeenth slides": {"warmup", "thermal", "fluidloss", "latency"},
    "seventeenth scraping": {"freeze", "latency"},
    "seventeenth btd": {"lost_rows", "spikes"},
}
_SEED = 17093
# A piece: recording, +f where it has the force, @ from - to [s]; level 0, 1, 2; forms.
_PLAN = """
F1+f@21-83 1 wear; F2@96-143 2 lopsided; btd@2-44 0 etched; F1@4-52 2 loose_pair; F2+f@62-118 1 inverted;
F2@24-79 2 replug; F1+f@99-161 1 rotated; U@14-62 0 settle; phac/steel_vase_702_01/F0 1 stairs;
F1+f@43-131 2 clamp_slip; U@88-140 0 plating; phac/acrylic_211_02/F1 1 tide; F2+f@3-71 2 wander;
U@5-96 1 surfaces; F1@30-119 2 thermostat; scraping/RF 0 stretched; btd@10-68 1 held_hand;
phac/car_sponge_101_02/F0 0 window; U@44-149 2 cycling; F2+f@88-172 1 valve; btd@23-69 2 cracked;
F2+f@104-166 1 spectrum; F1@66-112 2 deep; F1+f@128-186 1 slow_recovery; F2@60-104 1 plays; F1+f@9-68 2 bouc;
F2+f@1-41 1 turning; F2+f@130-190 1 usb; F1@97-149 1 afe; F2@109-152 0 median; F1@22-58 2 warburg;
phac/acrylic_211_03/F0 0 tails; F2@47-93 2 breathing; slides/mat15_1 1 rumble; U@70-105 0 beat;
phac/steel_vase_702_05/F1 1 skewed_mains; btd@27-63 2 pump; F1+f@62-117 1 damp; F2@12-49 2 capacitive;
btd@3-57 0 settling; slides/mat18_1 1 digits; F2@132-169 2 table; F1+f@74-128 0 swing; F2@66-121 1 battery;
U@24-66 0 dropouts; F2+f@18-60 1 open_lead; F1@132-171 2 long_hold; F1@150-186 0 esd;
phac/car_sponge_101_04/F1 1 code_errors; scraping/LF 2 bursts; F1+f@1-59 2 radio; F2+f@35-97 1 wrap;
btd@14-59 0 congested; btd@21-61 1 collector;

F1+f@85-150 1 wear usb; U@30-91 2 plating beat; F2@70-133 2 settle tails; btd@5-66 1 held_hand bursts;
U@3-81 2 surfaces stairs; F1@47-108 1 damp digits; F2+f@75-129 2 plays dropouts;
slides/mat20_2 0 rumble stairs; phac/acrylic_211_04/F0 1 cycling esd; F2@2-63 0 valve skewed_mains;

U@52-116 1 brownout; F2+f@42-101 2 skew; F1@15-64 1 rectified; F2@88-147 2 square; btd@8-61 1 mixer;
U@9-49 2 collision; F1+f@33-94 2 crumb; phac/steel_vase_702_04/F0 0 carry; F2+f@6-62 1 agc;
F1@78-141 2 coupled; F1+f@109-170 1 pingpong; F2@150-197 0 slew; F1@2-40 2 overflow;
phac/acrylic_211_02/F0 0 run_up; U@131-188 1 front; scraping/RF@0-11 2 roll
"""
_BARE = """
F1@3-48 F1@52-139 F1@101-184 F1@139-189 F1+f@18-41 F1+f@27-98 F1+f@64-91 F1+f@119-188 F2@4-58 F2@34-126
F2@99-128 F2@141-195 F2+f@10-88 F2+f@53-80 F2+f@92-199 F2+f@123-176 U@2-47 U@18-125 U@39-61 U@63-133 U@82-189
U@112-166 U@147-187 btd@2-29 btd@9-53 btd@16-70 btd@32-69 phac/acrylic_211_01/F0 phac/acrylic_211_04/F1
phac/car_sponge_101_01/F0 phac/car_sponge_101_01/F1 phac/car_sponge_101_05/F0 phac/steel_vase_702_01/F1
phac/steel_vase_702_05/F0 slides/mat15_1 slides/mat18_1 slides/mat20_2 slides/mat7_1 scraping/LF scraping/RF
"""
# Multiples of scatter; of noise.
_REACH = {False: ((2, 3.5), (4.5, 7.5), (9, 15)), True: ((1.8, 3.2), (4.5, 8.5), (11, 24))}
_SIDES = [np.arange(0, 6), np.arange(10, 16), np.arange(6, 10), np.arange(16, 19)]  # left, right, tip, middle
_TDC, _SALT = 66.0, 0.02  # for a kelvin: counts near 2000 by the manual's formula; share of the impedance
_FORMS = {}


def _form(kind, reach=1.0, **traits):
    """traits: fast: measured by the noise; bus: after the log's repeats; exact: of codes themselves."""

    def add(function):
        _FORMS[function.__name__] = dict(kind=kind, reach=reach, does=function, **traits)
        return function

    return add


@dataclasses.dataclass(frozen=True)
class Spec:
    """A piece: name; base; log to be read, part (from, to) [s] or None: all; force; level 0, 1, 2 or None;
    forms that it hides."""

    name: str
    base: str
    log: str
    part: tuple | None
    force: bool
    level: int | None
    forms: tuple

    @property
    def outside(self) -> bool:
        return any(_FORMS[form]["kind"] == "outside" for form in self.forms)

    @property
    def kinds(self) -> tuple:
        """Of the benchmark's vocabulary."""
        if self.outside:
            return ("outside_loaded",) if self.base[0] == "F" else ("outside",)
        return tuple(KINDS[_FORMS[form]["kind"]] for form in self.forms)


def plan():
    pieces = [p.split() for p in _PLAN.split(";")] + [[where] for where in _BARE.split()]
    out = []
    for i, (where, *rest) in enumerate(pieces):
        log, _, part = where.partition("@")
        name = f"seventeenth {i:03d} {where} {'+'.join(rest[1:]) or 'none'}"
        part, force = tuple(map(float, part.split("-"))) if part else None, log.endswith("+f")
        log, level = log.removesuffix("+f"), int(rest[0]) if rest else None
        out.append(Spec(name, log.split("/")[0], log, part, force, level, tuple(rest[1:])))
    return out


class _Piece:
    """What is read, x (n, 19), as it is changed by one form after another, with what the forms need of it."""

    def __init__(self, spec, data):
        self.rng = np.random.default_rng([_SEED, zlib.crc32(spec.name.encode())])
        self.u, self.way, self.level = self.rng.uniform, self.rng.choice([-1.0, 1.0]), spec.level
        self.side = _SIDES[self.rng.integers(4)]
        log = source(data, spec.log)
        part = slice(*np.searchsorted(log.time, spec.part)) if spec.part else slice(None)
        self.folded, self.tared = spec.base == "slides", spec.base in ("slides", "scraping")
        self.x = -log.x[part] if self.folded else log.x[part].copy()  # a press lowers counts
        self.t = log.time[part] - log.time[part][0]
        self.n, self.span, self.clean = len(self.x), self.t[-1], self.x.copy()
        self.row, self.f, self.rate = np.arange(self.n), self.t / self.span, (self.n - 1) / self.span
        self.keep = np.ones(self.n, bool)
        self.dither = self.rng.uniform(-0.499, 0.499, self.x.shape)  # what the log's own rounding took
        self.force = log.force[part] if spec.force else None
        self.tdc = None if log.tdc is None else log.tdc[part].copy()
        self.fresh = np.maximum.accumulate(np.where(np.r_[False, log.held[part][1:]], 0, self.row))
        self.noise, self.rest = log.noise, log.rest
        if spec.base[0] == "F":  # as it lies nearly free
            free = np.abs(log.force[:, 2])
            self.rest = np.median(log.x[free < np.quantile(free, 0.04)], 0)
        z = self.x - self.x.mean(0)
        inverse = np.linalg.inv(z.T @ z / self.n + np.diag(self.noise**2) / 4)
        alone = z @ inverse / np.diag(inverse)
        self.scatter = np.maximum(1.48 * np.median(np.abs(alone - np.median(alone, 0)), 0), self.noise)

    def look(self):
        """d: change from rest; sense: counts for a unit of -ln Z; load (n,): 0..1; press: d of load 1."""
        self.d, self.warm = self.x - self.rest, None
        counts = np.clip(self.x + 3300 * self.tared, 50, 4000)
        self.sense = counts * (1 - counts / 4095)
        load = gaussian_filter1d(np.sqrt(np.mean((self.d / self.scatter) ** 2, 1)), 3)
        load = load - np.quantile(load, 0.08)
        self.load = np.clip(load / np.quantile(load, 0.97), 0, 1.4)
        self.press = self.load @ self.d / np.sum(self.load**2)
        self.loud = self.rng.permutation(np.argsort(-np.std(self.x, 0) / self.scatter)[:7])

    def rise(self, start, over):
        """From 0 to 1 within `over` [s], soon, then slower."""
        f = np.clip((self.t - start * self.span) / over, 0, 1)
        return 1 - (1 - f**2) ** 1.5

    def spells(self, *parts):
        """1 within parts (from, to) of the piece."""
        return sum(((self.f >= a) & (self.f < b)) * 1.0 for a, b in parts)

    def on(self, shape, channels, weights=1.0):
        out = np.zeros((self.n, 19))
        channels = np.atleast_1d(channels)
        out[:, channels] = (shape if np.ndim(shape) == 2 else shape[:, None]) * weights
        return out

    def put(self, channels, values):
        out = self.x.copy()
        out[:, channels] = values
        return out

    def slow(self, d, tau):
        b = np.exp(-1 / (max(tau, 1e-6) * self.rate))
        return lfilter([1 - b], [1, -b], d - d[:1], axis=0) + d[:1]

    def tails(self, *channels):
        """Noise with heavier tails than a Gaussian's."""
        return self.rng.standard_t(4, (self.n, *channels))

    def finish(self, x, bus):
        x = x if bus else x[self.fresh]
        return -np.abs(x) if self.folded else np.clip(x, -4095 * self.tared, 4095)


@_form("gain")
def wear(p):  # a plug's contact wears off, with a pause in between
    c, fade = p.loud[0], 0.6 * p.rise(0.15, 0.2 * p.span) + 0.4 * p.rise(0.55, 0.3 * p.span)
    return lambda a: p.x - 0.9 * a * p.on(p.d[:, c] * fade, c)


@_form("gain", 3)
def lopsided(p):  # an amplifier's two halves: what lowers counts is read smaller than what raises them
    c = p.loud[0]
    lower = 0.5 * (p.d - np.sqrt(p.d**2 + (3 * p.noise) ** 2))[:, c]
    return lambda a: p.x - p.on(0.9 * a * lower + 0.1 * a * p.d[:, c], c)


@_form("gain")
def etched(p):  # neighbours that lost some of their gold
    at = p.rng.integers(0, 17) + np.arange(3)
    return lambda a: p.x - 0.8 * a * p.on(p.d[:, at], at, [0.6, 1.0, 0.75])


@_form("sign")
def loose_pair(p):  # a differential input's leads touch the other pins for two spells
    gate, middle = gaussian_filter1d(p.spells((0.18, 0.38), (0.6, 0.83)), 0.05 * p.rate), np.median(p.x, 0)
    return [p.put(c, p.x[:, c] - 1.9 * gate * (p.x[:, c] - middle[c])) for c in range(19)]


@_form("sign")
def inverted(p):  # a demodulator loses its reference, slides through zero to the opposite phase, stays there
    turn, middle = np.cos(np.pi * p.rise(0.45, 0.8)) * (1 - 0.12 * p.rise(0.45, 0.8)), np.median(p.x, 0)
    return [p.put(c, middle[c] + turn * (p.x[:, c] - middle[c])) for c in range(19)]


@_form("permutation")
def replug(p):  # the connector was drawn in a break; two pins near each other came back exchanged
    late, pairs = p.f[:, None] > 0.42, [[i, i + k] for k in (1, 2) for i in range(19 - k)]
    return [p.put(i, np.where(late, p.x[:, i[::-1]], p.x[:, i])) for i in pairs]


@_form("permutation")
def rotated(p):  # four wires of a ribbon, one place on; levels were trimmed again by hand
    late, out = p.f[:, None] > 0.55, []
    for first in range(16):
        i = first + np.arange(4)
        out.append(p.put(i, np.where(late, p.rest[i] + 0.97 * p.d[:, np.roll(i, 1)] + 6 * p.way, p.x[:, i])))
    return out


@_form("offset")
def settle(p):  # a solder joint gives; the level goes on for a while, as a logarithm
    since = np.maximum(p.t - p.u(0.3, 0.5) * p.span, 0)
    return p.way * p.on(
        (since > 0) * (0.75 + 0.25 * np.log1p(since / 0.3) / np.log1p(30)), p.rng.integers(19)
    )


@_form("offset")
def stairs(p):  # twice in one electrode, the second time part of the way back
    up, back = p.rise(0.28, 0.05), p.rise(0.74, 0.12)
    return p.way * p.on(up - 0.45 * back, p.rng.integers(19))


@_form("offset")
def clamp_slip(p):  # the skin's clamp slips on one side and comes back a little
    since = np.maximum(p.t - 0.47 * p.span, 0)
    shape = p.rise(0.47, 0.18) * (0.8 + 0.2 / (1 + since / 1.5))
    return p.on(shape, _SIDES[1], p.way * np.array([0.35, 0.7, 1.0, 0.9, -0.3, -0.5]) * p.scatter[_SIDES[1]])


@_form("drift", 1.5)
def plating(p):  # metal grows on an electrode, fastest at first
    since = np.maximum(p.f - 0.08, 0)
    return -p.on(np.log1p(since / 0.07) / np.log1p(13), p.rng.integers(19))


@_form("drift", 1.2)
def tide(p):  # up, then partly back
    return p.way * p.on(np.sin(0.8 * np.pi * p.f**1.35) + 0.1 * p.f, p.rng.integers(19))


@_form("drift")
def wander(p):  # two electrodes with each its own slow ups and downs
    waves = sum(np.sin(2 * np.pi * k * p.f[:, None] + p.u(0, 6, 2)) / k**1.2 for k in (0.6, 1.1, 1.9, 2.8))
    some = p.rng.choice(19, 2, replace=False)
    return p.on((waves - waves[0]) / np.ptp(waves, 0), some, [1.0, 0.8] * p.scatter[some])


@_form("warm_up", 1.3)
def surfaces(p):  # a body that cools by its surface and by what it lies on: a power of time
    share = gaussian_filter1d(p.u(0.6, 1.4, 19), 2)
    return p.sense * share * (1 - (1 + p.f / 0.14) ** -0.85)[:, None]


@_form("warm_up", 2.5)
def thermostat(p):  # a heater with a controller that goes a little beyond
    u = p.f / 0.17
    return p.sense * (1 - np.exp(-u) * (np.cos(0.9 * u) + 0.3 * np.sin(0.9 * u)))[:, None]


@_form("warm_up", 1.4)
def stretched(p):
    return p.sense * (1 - np.exp(-((p.f / 0.3) ** 0.62)))[:, None]


def _warmed(p, shape, near=1.0):
    p.warm = shape - shape[0]
    return _SALT * p.sense * near * p.warm[:, None]


@_form("temperature", 1.4)
def held_hand(p):  # somebody holds the finger for a while; glue, core and liquid follow
    taken = p.slow(p.slow(p.spells((0.22, 0.57)), 0.03 * p.span), 0.09 * p.span)
    return _warmed(p, taken + 0.15 * p.slow(taken, 0.2 * p.span))


@_form("temperature", 1.3)
def window(p):  # open for some seconds: colder steadily, most on one side, then back
    near = np.where(np.isin(np.arange(19), _SIDES[0]), 1.0, 0.6)
    return _warmed(p, -np.interp(p.f, [0, 0.16, 0.52, 0.78, 1], [0, 0, 1, 0.55, 0.42]), near)


@_form("temperature")
def cycling(p):  # an air conditioner: short cold, long return
    phase = (2.4 * p.f + p.u(0, 1)) % 1
    return _warmed(p, p.slow(np.where(phase < 0.3, -phase / 0.3, (phase - 1) / 0.7), 0.03 * p.span))


def _emptied(p, gone):
    """(n, 19): thinner liquid: less in all electrodes, presses are read larger."""
    return (gone / gone[-1])[:, None] * (0.5 * p.d - p.sense * gaussian_filter1d(p.u(0.5, 1.5, 19), 1))


@_form("fluid_loss", 2.4)
def valve(p):  # a fill port that weeps when pressed, a little also without
    return _emptied(p, np.cumsum((p.load + 0.25) * (p.f > 0.12)))


@_form("fluid_loss")
def cracked(p):  # runs out from some moment on, slower as the pressure falls
    return _emptied(p, 1 - (1 + np.maximum(p.f - 0.3, 0) / 0.2) ** -1.4)


@_form("relaxation", 1.7)
def spectrum(p):  # of a filled rubber: all times from 0.2 to 25 s, a power law
    taus = np.geomspace(0.2, 25, 8)
    lag = sum(p.slow(p.d, tau) * tau**-0.25 for tau in taus) / np.sum(taus**-0.25)
    return lambda a: p.x + 1.4 * a * (p.d - lag)


@_form("relaxation", 1.3)
def deep(p):  # the more the deeper
    lag = 0.6 * p.slow(p.d, 1.1) + 0.4 * p.slow(p.d, 7.0)
    return lambda a: p.x + 1.4 * a * (p.d - lag) * np.sqrt(np.clip(p.load, 0.02, 1.2))[:, None]


@_form("relaxation", 2.5)
def slow_recovery(p):  # quick under load, slow after it
    memory, quick, late = p.load.copy(), 1 / (0.7 * p.rate), 1 / (5.5 * p.rate)
    for i in range(1, p.n):
        step = p.load[i] - memory[i - 1]
        memory[i] = memory[i - 1] + step * (quick if step > 0 else late)
    return lambda a: p.x + 1.2 * a * (p.load - memory)[:, None] * p.press


@_form("hysteresis", 2)
def plays(p):  # elements with more and more play
    out = np.zeros(p.n)
    for width in (0.04, 0.1, 0.2, 0.3):
        play = p.load.copy()
        for i in range(1, p.n):
            play[i] = min(max(play[i - 1], p.load[i] - width), p.load[i] + width)
        out += (play - p.load) / 2
    return lambda a: p.x + a * out[:, None] * p.press


@_form("hysteresis", 1.3)
def bouc(p):  # and Wen's, of each electrode by its own sensitivity
    step, z = np.diff(p.load, prepend=p.load[0]) / 0.15, np.zeros(p.n)
    for i in range(1, p.n):
        bend = abs(z[i - 1]) ** 1.6 * (0.6 * np.sign(step[i] * z[i - 1]) + 0.4)
        z[i] = np.clip(z[i - 1] + step[i] * (1 - bend), -1.2, 1.2)
    share = p.u(0.6, 1.4, 19)
    return lambda a: p.x - 0.5 * a * z[:, None] * share * p.press


@_form("hysteresis", 2.5)
def turning(p):  # on its way back a press is read deeper, by how far it had gone
    peak, most = np.zeros(p.n), 0.0
    for i, load in enumerate(p.load):
        most = max(most, load) if load > 0.06 else load
        peak[i] = most
    more = p.load * (peak - p.load) / np.maximum(peak, 0.06)
    return lambda a: p.x + 2.5 * a * more[:, None] * p.press


@_form("latency", fast=True)
def usb(p):  # what waits in a driver's queue: all electrodes, never quite the same
    late = p.rate * p.u(0.8, 1.2) * (0.04, 0.08, 0.18)[p.level] * (1 + 0.15 * np.sin(2 * np.pi * 3.3 * p.f))
    return [p.x[np.maximum(np.round(p.row - late).astype(int), 0)]]


@_form("latency", fast=True)
def afe(p):  # the second front end's electrodes, every other one
    return [p.put(p.row[1:19:2], p.x[np.maximum(p.row - (1, 3, 8)[p.level], 0), 1::2])]


@_form("low_pass", fast=True)
def median(p):  # of the rows before, in the firmware, for one electrode
    c = p.loud[0]
    return lambda a: p.put(
        c, median_filter(p.x[:, c], k := 3 + 2 * int(50 * a), mode="nearest", origin=k // 2)
    )


@_form("low_pass", fast=True)
def warburg(p):  # an electrode behind swollen varnish: diffusion, half an order
    c, omega = p.loud[:2], 2j * np.pi * np.fft.rfftfreq(2 * p.n, 1 / p.rate)[:, None]
    spectrum = np.fft.rfft(np.r_[p.x[:, c], p.x[::-1, c]], axis=0)
    return lambda a: p.put(c, np.fft.irfft(spectrum / (1 + np.sqrt(6 * a * omega)), 2 * p.n, axis=0)[: p.n])


@_form("noise", fast=True)
def tails(p):  # of a resistor that ages: from some row on, each value half of the last one
    white = p.tails()
    return p.on((white + 0.5 * np.r_[0, white[:-1]]) * p.rise(0.3, 0.15 * p.span), p.rng.integers(19))


@_form("noise", fast=True)
def breathing(p):  # a bond that is noisy while it is bent
    return p.on(p.tails() * (0.15 + p.load), p.loud[0])


@_form("noise", fast=True)
def rumble(p):  # a wide resonance of a cable, in each lead by itself
    pole = 0.9 * np.exp(2j * np.pi * 8 / p.rate)
    shake = lfilter([1.0], [1, -2 * pole.real, abs(pole) ** 2], p.tails(3), axis=0)
    return p.on(shake, p.rng.choice(19, 3, replace=False), [1.0, 0.8, 0.9])


@_form("line_noise", fast=True)
def beat(p):  # a ground loop, with another machine's that is a little off
    tone = np.sin(2 * np.pi * 49.93 * p.t) + 0.55 * np.sin(2 * np.pi * 50.11 * p.t + 1)
    return p.on(tone, p.side, p.u(0.6, 1.0, len(p.side)))


@_form("line_noise", fast=True)
def skewed_mains(p):  # electrodes are read one after another, so each sees its own phase
    at = p.t[:, None] + np.arange(19) / (44 * p.rate)
    return (np.sin(2 * np.pi * 59.97 * at) + 0.3 * np.sin(2 * np.pi * 179.91 * at + 0.7)) * p.noise


@_form("line_noise", fast=True)
def pump(p):  # turns at about 7 times a second, not round
    turn = 2 * np.pi * (7.3 * p.t + 0.4 * np.sin(2 * np.pi * 1.7 * p.f))
    return (np.sin(turn) + 0.4 * np.sin(2 * turn + 0.5))[:, None] * p.u(0.4, 1.2, 19) * p.noise


@_form("cross_talk")
def damp(p):  # moisture in the plug creeps from a pin to those beside it
    c = min(max(int(p.loud[0]), 2), 16)
    wet = p.rise(0.2, 0.4 * p.span)
    return lambda a: p.x + 0.9 * a * p.on(p.d[:, c] * wet, c + np.array([-1, 1, 2]), [0.8, 1.0, 0.3])


@_form("cross_talk")
def capacitive(p):  # a broken shield: quick changes go over more than slow ones
    c, to = p.loud[0], p.rng.choice(np.setdiff1d(np.arange(19), p.loud[:1]), 2, replace=False)
    d = p.d[:, c] - 0.6 * p.slow(p.d[:, c], 0.4)
    return lambda a: p.x + a * p.on(d, to, [1.0, 0.7])


@_form("cross_talk", 1.8)
def settling(p):  # a multiplexer does not settle: something of the two electrodes before
    before = 0.7 * np.roll(p.d, 1, 1) + 0.25 * np.roll(p.d, 2, 1) - 0.7 * p.d
    return lambda a: p.x + 0.7 * a * p.on(before[:, 2:10], np.arange(2, 10))


@_form("quantisation", fast=True, exact=True)
def digits(p):  # written with few digits
    return [np.round(p.x / k) * k for k in (2, 4, 5, 10, 20, 25, 40, 50, 100)]


@_form("quantisation", fast=True, exact=True)
def table(p):  # a table of codes with wide and narrow places, in half of the electrodes
    some = p.rng.choice(19, 10, replace=False)
    edges = np.cumsum(np.tile([1.0, 2.2, 1.0, 1.5], 1200))
    return lambda a: p.put(
        some, (g := 1 + 100 * a) * edges[np.searchsorted(edges, p.x[:, some] / g)] - 0.8 * g
    )


@_form("saturation", exact=True)
def swing(p):  # an amplifier that comes ever less near to its lower rail
    c = p.loud[:2]
    low, high = p.x[:, c].min(0), np.quantile(p.x[:, c], 0.6, axis=0)
    knee = np.maximum(0.04 * (high - low), 2)
    return lambda a: p.put(c, (e := low + a * (high - low)) + knee * np.logaddexp(0, (p.x[:, c] - e) / knee))


@_form("saturation", exact=True)
def battery(p):  # the upper rail follows the battery
    c = p.loud[0]
    top, low = p.x[:, c].max() + 2, np.quantile(p.x[:, c], 0.25)
    return lambda a: p.put(c, np.minimum(p.x[:, c], top - a * (top - low) * (0.75 + 0.25 * p.f**1.5)))


def _stuck(p, spells):
    """Of each electrode in turn; the last digit flickers."""
    flicker, out = (p.u(size=p.n) < 0.04) * 1.0, []
    for c in range(19):
        x = p.x[:, c].copy()
        for start, to in (np.array(spells) * p.n).astype(int):
            x[start:to] = x[start] + flicker[start:to]
        out.append(p.put(c, x))
    return out


@_form("stuck")
def dropouts(p):
    return _stuck(p, [(0.2, 0.29), (0.41, 0.47), (0.66, 0.79)])


@_form("stuck")
def long_hold(p):
    return _stuck(p, [(0.36, 0.81)])


@_form("stuck")
def open_lead(p):  # breaks: in half a second to where its input floats, for good
    broken, out = p.rise(0.52, 0.5), []
    for c in range(19):
        floats = p.rest[c] + 5 * p.way * p.scatter[c] + np.round(np.sin(5 * p.f + c))
        out.append(p.put(c, (1 - broken) * p.x[:, c] + broken * floats))
    return out


def _struck(p, rows, shape):
    out = np.zeros(p.n + 9)
    for row, size in zip(rows, p.u(0.7, 1.5, len(rows))):
        out[row : row + len(shape)] += size * np.array(shape)
    return out[: p.n]


@_form("spikes", 3, fast=True)
def esd(p):  # discharges over all electrodes, each there and back
    rows = p.rng.integers(5, p.n - 5, 5 + p.n // 400)
    return _struck(p, rows, [1, -0.55, 0.2])[:, None] * p.rng.normal(1, 0.4, 19) * p.noise


@_form("spikes", 3, fast=True, bus=True)
def code_errors(p):  # single values of one electrode
    rows = p.rng.integers(5, p.n - 5, 4 + p.n // 150)
    return p.on(_struck(p, rows, [1]) * p.rng.choice([-1, 1, 1], p.n), p.rng.integers(19))


@_form("spikes", 3, fast=True)
def bursts(p):  # a radio nearby: packets of some rows in two leads
    starts = p.rng.integers(5, p.n - 60, 3 + p.n // 900)
    rows = np.concatenate([start + np.cumsum(p.rng.integers(2, 9, p.rng.integers(4, 8))) for start in starts])
    return p.way * p.on(_struck(p, rows, [1, 0.3]), p.rng.choice(19, 2, replace=False), [1.0, -0.7])


def _gone(p, spells):
    for start, count in spells:
        p.keep[start : start + count] = False
    return [p.x]


@_form("lost_samples", bus=True)
def radio(p):  # packets lost in flocks
    count, mean = (8, 14, 24)[p.level], (6, 14, 30)[p.level]
    return _gone(p, zip(p.rng.integers(50, p.n - 200, count), 1 + p.rng.geometric(1 / mean, count)))


@_form("lost_samples", bus=True)
def wrap(p):  # whenever a buffer is full
    starts = np.arange(300, p.n - 100, 620) + p.rng.integers(0, 12)
    return _gone(p, zip(starts, p.rng.integers(4, 8, len(starts)) * (1, 5, 9)[p.level]))


def _again(p, spells):
    row = p.row.copy()
    for start, count in spells:
        row[start : start + count] = row[start]
    p.tdc = None if p.tdc is None else p.tdc[row]
    return [p.x[row]]


@_form("held_samples", bus=True, fast=True)
def congested(p):  # a busy bus: now and then the last frame, for some rows
    starts = p.rng.integers(20, p.n - 60, p.n // (20, 12, 7)[p.level])
    return _again(p, zip(starts, 2 + p.rng.geometric(0.4, len(starts))))


@_form("held_samples", bus=True, fast=True)
def collector(p):  # a reader that cleans its memory
    starts = (np.arange(0.4, p.span - 0.5, 1.37) * p.rate + p.rng.integers(0, 5)).astype(int)
    return _again(p, zip(starts, p.rng.integers(4, 7, len(starts)) * (1, 2, 4)[p.level]))


@_form("outside")
def brownout(p):  # a supply that dips when something else starts: all sag, ring, are back
    dips = np.zeros(p.n)
    for start, size in zip((0.13, 0.29, 0.44, 0.52, 0.77), (0.6, 1.0, 0.7, 1.2, 0.8)):
        s = np.maximum(p.t - start * p.span, 0)
        dips += size * (s / 0.3) * np.exp(1 - s / 0.3) * (s > 0) - 0.4 * size * (s / 1.2) ** 2 * np.exp(
            2 - 2 * s / 1.2
        )
    return -dips[:, None] * (p.x + 3300 * p.tared)


@_form("outside", 2.5, fast=True)
def skew(p):  # the reader's clock runs slow against the force's and is set again every 9 s
    lag = (p.t % 9.1) / 9.1
    return lambda a: p.x[np.maximum(np.round(p.row - 110 * a * lag).astype(int), 0)]


@_form("outside", 1.6)
def rectified(p):  # an electrode tells how far, no more which way
    c = p.loud[0]
    middle = np.median(p.x[:, c]) if p.level else p.rest[c]
    return lambda a: p.put(c, p.x[:, c] - 2 * a * np.minimum(p.x[:, c] - middle, 0))


@_form("outside", 1.5)
def square(p):  # distortion of the second order, in three electrodes
    c = p.loud[:3]
    return lambda a: p.x + 2 * a * p.on(p.d[:, c] ** 2 / np.quantile(np.abs(p.d[:, c]), 0.97, axis=0), c)


@_form("outside", 1.6)
def mixer(p):  # the product of two electrodes in a third
    i, j = p.loud[:2]
    both = (p.d[:, i] - p.d[:, i].mean()) * (p.d[:, j] - p.d[:, j].mean())
    return p.on(both, p.rng.choice(np.setdiff1d(np.arange(19), [i, j])))


@_form("outside", bus=True)
def collision(p):  # two sensors answer together: a bit is set only if both set it; now one, now another
    other = np.roll(p.x, p.n // 3, 0).astype(int)[:, ::-1]
    start = p.rng.integers(100, p.n - 200, 12)
    hit = np.zeros(p.n, bool)
    for s in start:
        hit[s : s + p.rng.integers(10, 70)] = True
    return [np.where(hit[:, None], p.x.astype(int) & (other | 4096 - 2**k), p.x) for k in range(3, 12)]


@_form("outside")
def crumb(p):  # under the skin: it is felt by light presses, sunk in by others
    bump = np.exp(-(((p.load - 0.3) / 0.12) ** 2))
    return p.way * p.on(bump, p.side[:3], [1.0, -0.6, 0.4])


@_form("outside", fast=True)
def carry(p):  # a converter whose great bits do not fit the small ones: a saw over the codes
    return lambda a: p.x + 100 * a * ((p.x % 64) / 64 - 0.5)


@_form("outside", 2.5)
def agc(p):  # an automatic gain: the louder it was, the less is read
    loud = np.sqrt(p.slow(np.mean((p.d / p.scatter) ** 2, 1), 3.0))
    loud = loud / np.quantile(loud, 0.9)
    return lambda a: p.rest + p.d / (1 + 4 * a * loud[:, None] ** 1.5)


@_form("outside")
def coupled(p):  # by capacitors: six electrodes forget their level
    some = p.loud[:6]
    return lambda a: p.put(some, p.x[:, some] - a * (p.slow(p.x[:, some], 2.5) - p.rest[some]))


@_form("outside", fast=True, bus=True)
def pingpong(p):  # two buffers take turns, one of them is sent a turn late
    late = (p.row // 4) % 2 == 1
    return lambda a: p.x[np.where(late, np.maximum(p.row - max(2, round(60 * a)), 0), p.row)]


@_form("outside", fast=True)
def slew(p):  # two electrodes cannot go faster than so many counts a row
    c = p.loud[:2]

    def read(a):
        x, most = p.x[:, c].copy(), np.ptp(p.x[:, c], 0) / p.rate / (0.02 + 4 * a)
        for i in range(1, p.n):
            x[i] = np.clip(x[i], x[i - 1] - most, x[i - 1] + most)
        return p.put(c, x)

    return read


@_form("outside", exact=True)
def overflow(p):  # a counter that begins again when it is full
    return [
        p.put(c, np.where(p.x[:, c] < np.quantile(p.x[:, c], q), p.x[:, c] + k, p.x[:, c]))
        for c in p.loud
        for q in (0.05, 0.12)
        for k in (64, 128, 256)
    ]


@_form("outside", 2, fast=True)
def run_up(p):  # a motor that starts: from 1 to 30 turns a second, once
    s = np.clip((p.f - 0.2) / 0.6, 0, 1)
    turn = 2 * np.pi * 0.6 * p.span * (s + 14.5 * s**2)
    return (np.sin(turn) * np.sin(np.pi * s) ** 0.5)[:, None] * gaussian_filter1d(p.u(-1, 1, 19), 1) * p.noise


@_form("outside", 1.4)
def front(p):  # a drop dries: a front goes from the tip to the base, and over
    far = np.r_[np.arange(6, 0, -1), -0.3, 0, 0.2, 0.1, np.arange(6.3, 1, -1), 2, 4, 6]
    s = (p.f[:, None] - 0.15 - 0.09 * far) / 0.08
    return -p.sense * np.exp(-np.where(s < 0, s**2, np.abs(s) / 2.5))


@_form("outside")
def roll(p):  # the finger rolls in its holder, to and fro: one side less what the other has more
    angle = np.sin(2 * np.pi * 1.6 * p.f**1.2) + 0.3 * np.sin(2 * np.pi * 3.7 * p.f + 1)
    weights = np.zeros(19)
    weights[_SIDES[0]], weights[_SIDES[1]] = np.linspace(1, 0.4, 6), -np.linspace(0.9, 0.5, 6)
    return angle[:, None] * weights * p.scatter


def _hide(p, name):
    form = _FORMS[name]
    fast, bus = form.get("fast", False), form.get("bus", False)
    unit = p.noise if fast else p.scatter
    target = form["reach"] * p.u(*_REACH[fast][p.level])

    def size(x):
        """The plainest electrode's: its RMS change over the eighth of rows that changed most, in units."""
        change = np.sort(np.abs(p.finish(x, bus) - p.x) / unit, 0)
        return np.sqrt(np.mean(change[-max(p.n // 8, 1) :] ** 2, 0)).max()

    def peak(x):
        return np.abs((p.finish(x, bus) - p.x) / unit).max()

    p.look()
    what, measure = form["does"](p), peak if form["kind"] == "spikes" else size
    if isinstance(what, list):
        best = min(what, key=lambda x: abs(np.log(max(measure(x), 1e-3) / target)))
    else:
        read = what if callable(what) else lambda a: p.x + a * what
        low, high = (-9.0, 0.0) if callable(what) else (-18.0, 14.0)
        for _ in range(24):
            middle = (low + high) / 2
            low, high = (middle, high) if measure(read(np.exp(middle))) < target else (low, middle)
        best = read(np.exp(high))
        if p.tdc is not None and p.warm is not None:
            p.tdc = np.round(p.tdc + _TDC * np.exp(high) * p.slow(p.warm, 0.8))
    seen = np.mean(~p.keep) if form["kind"] == "lost_samples" else measure(best)  # of lost rows the share
    before, p.x = p.x, p.finish(np.round(best + p.dither * (not form.get("exact"))), bus)
    return np.flatnonzero((before != p.x).any(0)).tolist(), float(seen)


def make(spec, data):
    p = _Piece(spec, pathlib.Path(data))
    hidden = [_hide(p, form) for form in spec.forms]
    keep, clock = p.keep, spec.base in ("btd", "slides")
    case = dict(base=f"seventeenth {spec.base}", counts=p.x[keep], loaded=spec.base[0] == "F")
    case |= dict(rate=100.0 if clock else p.rate, time=p.t[keep] if clock else None)
    case |= dict(force=None if p.force is None else p.force[keep], tdc=None if p.tdc is None else p.tdc[keep])
    case |= dict(channels=[c for c, _ in hidden], seen=[size for _, size in hidden], forms=list(spec.forms))
    gaps = np.flatnonzero(np.diff(np.flatnonzero(keep)) > 1) + 1
    return case | dict(truth=list(spec.kinds), gaps=gaps.tolist()), p.clean[keep]
