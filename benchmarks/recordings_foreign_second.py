"""Recordings of real sensors with a hidden effect, by a second author: other laws, other base signals.

Numpy and scipy alone, as in `recordings_foreign.py`, whose vocabulary (Case, Effect, what a name may be) is
used and none of whose forms. A form takes a size in (0, 1], of which 1 is plain; `make` looks for the size
at which the change is as large against the recording's own floor (`visible`) as the case is to be: from
LEAST, that an expert with the clean recording beside it would just see, to PLAIN.
"""

import gzip
import pathlib
import zlib
from dataclasses import replace

import numpy as np
from recordings_foreign import ACCEPTED as FIRST_ACCEPTED
from recordings_foreign import NATURAL as FIRST_NATURAL
from recordings_foreign import OUTSIDE as FIRST_OUTSIDE
from recordings_foreign import SINGLE, Case, Effect, _counts, _table, _z
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter1d, median_filter, minimum_filter1d
from scipy.signal import bessel, fftconvolve, lfilter, sosfilt

__all__ = ["ACCEPTED", "EFFECTS", "LEAST", "NATURAL", "OUTSIDE", "PLAIN", "SINGLE"]
__all__ += ["Case", "Effect", "bases", "make", "plan", "visible"]

LEAST, PLAIN = 1.5, 10.0
_GRADUAL = {"warmup", "fluidloss", "thermal"}
_SIZES = np.geomspace(1 / 64, 1, 13)


def _columns(case):
    """(n, 19) counts as a converter gives them, or (n, 22) with the force beside them."""
    counts = np.clip(np.rint(case.counts), 0, 4095)
    return counts if case.force is None else np.hstack([counts, case.force])


def visible(before: np.ndarray, after: np.ndarray, gradual: bool = False) -> float:
    """How plain a change is, 1: as large as what the clean recording has without it.

    before (n, 19) counts or (n, 22) with force [N], after (m <= n, the same). The larger of two ratios,
    median over the columns that change: RMS over the rows that change over the error with which the other
    columns predict this one (leave one out, linear), and RMS of the row-to-row change over half of the
    recording's own (noise). gradual: a slow change of all electrodes, which has to be seen against the slow
    changes that the recording has by itself (spread of the rest over twelve parts of it), too. 0 where
    nothing changes.
    """
    before = before[len(before) - len(after) :]
    change = after - before
    moved = np.flatnonzero(np.abs(change).max(0) > 0)
    if not len(moved):
        return 0.0
    unit = np.array([1.0] * 19 + [0.01] * 3)[: before.shape[1]]  # a count, and 10 mN of a force plate
    x = (before - before.mean(0)) / unit
    alone = unit / np.sqrt(np.diag(np.linalg.inv(np.cov(x.T) + np.eye(len(unit)))))
    if gradual:
        rests = [np.quantile(part, 0.9, axis=0) for part in np.array_split(before, 12)]
        alone = np.maximum(alone, np.std(rests, axis=0))
    noise = np.maximum(np.median(np.abs(np.diff(before, axis=0)), axis=0) / 0.6745, 0.5 * unit)
    change, alone, noise = change[:, moved], alone[moved], noise[moved]
    rows = np.maximum((change != 0).sum(0), 1)
    slow = np.sqrt((change**2).sum(0) / rows) / alone
    fast = np.sqrt(np.mean(np.diff(change, axis=0) ** 2, axis=0)) / (0.5 * noise)
    return float(np.median(np.maximum(slow, fast)))


# --- time courses: (n,) from a case and a generator


def _sign(rng):
    return float(rng.choice([-1, 1]))


def _onset(n, rng):
    return int(rng.uniform(0.2, 0.65) * n)


def _after(n, start, seconds, rate):
    """(n,) 0 before a row, then 1 - exp(-t / seconds)."""
    return 1 - np.exp(-np.maximum(np.arange(n) - start, 0) / (seconds * rate))


def _stretches(n, number, low, high, rng):
    """(n,) bool: that many stretches, of low to high of the whole in all."""
    on = np.zeros(n, bool)
    for a, share in zip(np.linspace(0.08, 0.9, number, endpoint=False), rng.dirichlet(4 * np.ones(number))):
        start = int((a + rng.uniform(0, 0.3) * 0.8 / number) * n)
        on[start : start + int(min(share * rng.uniform(low, high), 0.6 / number) * n) + 2] = True
    return on


def _wandering(n, width, rng):
    """(n,) a random walk, smooth over width rows, from 0 to a largest value of 1 on either side."""
    walk = gaussian_filter1d(np.cumsum(rng.standard_normal(n)), width)
    walk -= walk[0]
    return walk / np.abs(walk).max()


def _coloured(n, power, rng):
    """(n,) noise of RMS 1 whose power falls as 1 / f ** power."""
    f = np.maximum(np.fft.rfftfreq(n), 4 / n)
    x = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) * f ** (-power / 2), n)
    return x / x.std()


def _bursts(n, rate, rng):
    """(n,) 0 or 1, on and off for seconds."""
    edges = np.cumsum(rng.exponential(3, 400) + 0.5) * rate
    return (np.searchsorted(edges, np.arange(n)) % 2).astype(float)


def _one(c, rng, lively=False):
    order = np.argsort(-c.counts.std(0) if lively else rng.random(19))
    return int(order[rng.integers(9)])


# --- all electrodes in time


def _shared(plain, law):
    """z changes by plain * size * law, law (n, 1) or (n, 19)."""

    def form(c, rng, size):
        c.counts = _counts(_z(c.counts) + plain * size * law(c, rng))
        return range(19)

    return form


def _slab(c, rng):
    """Heat through a slab, its mean temperature."""
    k, tau = np.arange(1, 40, 2), rng.uniform(0.15, 0.5)
    rise = 1 - (8 / (np.pi * k) ** 2 * np.exp(-(k**2) * c.clock[:, None] / tau)).sum(1, keepdims=True)
    return rise * rng.uniform(0.8, 1.2, 19)


def _from_the_core(c, rng):
    """Electrodes far from the electronics warm later."""
    return 1 - np.exp(-c.clock[:, None] / rng.uniform(0.08, 0.7, 19))


def _switched_on(c, rng):
    """Another finger of the hand is switched on in the middle."""
    n = len(c.counts)
    return _after(n, _onset(n, rng), 0.15 * n / c.rate, c.rate)[:, None] * rng.uniform(0.85, 1.15, 19)


def _room(c, rng):
    """The room's heating switches on and off meanwhile."""
    cycle = np.abs((c.clock * rng.uniform(3, 6) + rng.random()) % 1 - 0.5)
    return (1 - np.exp(-c.clock / 0.3) + 0.3 * (cycle - cycle[0]))[:, None] * rng.uniform(0.9, 1.1, 19)


def _pressed_out(c, rng):
    """Liquid leaves while the finger is loaded."""
    z = _z(c.counts)
    load = np.abs(z - np.quantile(z, 0.1, axis=0)).mean(1)
    lost = np.cumsum(0.1 * load.mean() + load**2 / load.mean())
    return (lost / lost[-1])[:, None] * rng.uniform(0.8, 1.2, 19)


def _drops(c, rng):
    """It leaves in drops."""
    n = len(c.counts)
    lost = sum(
        rng.exponential() * _after(n, start, 0.8, c.rate)
        for start in rng.uniform(0.02, 0.95, rng.integers(7, 15)) * n
    )
    return (lost / lost[-1])[:, None] * rng.uniform(0.85, 1.15, 19)


def _torricelli(c, rng):
    """It runs out of a hole, from some electrodes more than from others."""
    return (1 - (1 - c.clock) ** 2)[:, None] * rng.permutation(np.linspace(0.35, 1.65, 19))


def _sealed(c, rng):
    """Somebody tightens the screw."""
    a, b = rng.uniform(0, 0.2), rng.uniform(0.5, 0.75)
    return np.clip((c.clock - a) / (b - a), 0, 1)[:, None] * rng.uniform(0.85, 1.15, 19)


def _supply(law):
    def form(c, rng, size):
        c.counts += (_sign(rng) * 400 * size * law(c, len(c.counts), rng))[:, None]
        return range(19)

    return form


def _sag(c, n, rng):
    start = _onset(n, rng)
    return (np.arange(n) >= start) * (1 - 0.6 * _after(n, start, rng.uniform(2, 8), c.rate))


def _neighbour_device(c, n, rng):
    a = _onset(n, rng)
    x = np.arange(n)
    return ((x >= a) & (x < a + rng.uniform(0.15, 0.3) * n)).astype(float)


def _uneasy(c, n, rng):
    """A reference that wanders within seconds."""
    x = gaussian_filter1d(rng.standard_normal(n), rng.uniform(1, 2.5) * c.rate)
    return x / np.abs(x).max()


def _heat(law):
    def form(c, rng, size):
        t = lfilter([1 / 30], [1, 1 / 30 - 1], c.tdc - c.tdc[0])  # the code of one row is coarse
        c.counts = _counts(_z(c.counts) - 0.03 * size * law(t, c, rng))
        return range(19)

    return form


def _inside_later(t, c, rng):
    a = 1 / (rng.uniform(1, 2.5) * c.rate)
    return lfilter([a], [1, a - 1], lfilter([a], [1, a - 1], t))[:, None] * rng.uniform(0.9, 1.1, 19)


def _with_flow(t, c, rng):
    return (t + rng.uniform(1.5, 4) * c.rate * np.gradient(t))[:, None] * rng.uniform(0.9, 1.1, 19)


# --- one electrode


def _alone(law):
    def form(c, rng, size):
        k = _one(c, rng)
        c.counts[:, k] += _sign(rng) * 800 * size * law(c, len(c.counts), rng)
        return [k]

    return form


def _knots(c, n, rng):
    at = np.concatenate([[0], np.sort(rng.uniform(0.1, 0.9, 3)), [1]])
    return np.interp(c.clock, at, np.concatenate([[0], np.cumsum(rng.uniform(0.1, 1, 4))]) / 2)


def _arch(c, n, rng):
    a, b = rng.uniform(0.05, 0.3), rng.uniform(0.65, 0.95)
    return np.sin(np.pi * np.clip((c.clock - a) / (b - a), 0, 1)) ** 2


def _ringing(c, n, rng):
    t = np.maximum(np.arange(n) - _onset(n, rng), 0) / c.rate
    swing = np.cos(2 * np.pi * rng.uniform(1, 3) * t)
    return 1 - np.exp(-t / rng.uniform(0.2, 0.5)) * swing


def _two_clicks(c, n, rng):
    a = _onset(n, rng)
    return 0.6 * (np.arange(n) >= a) + 0.4 * (np.arange(n) >= a + rng.uniform(0.5, 2) * c.rate)


def _chatter(c, n, rng):
    """A contact makes and breaks for a second, then it stays."""
    a, m = _onset(n, rng), int(rng.uniform(0.5, 1.5) * c.rate)
    out = (np.arange(n) >= a).astype(float)
    out[a : a + m] = np.repeat(rng.integers(0, 2, m // 6 + 1), 6)[:m]
    return out


def _resistor(c, rng, size):
    """A plug's contact resistance is in series from now on."""
    k, z = _one(c, rng), _z(c.counts)
    s = _onset(len(z), rng)
    c.counts[s:, k] = _counts(np.log(np.exp(z[s:, k]) + 0.4 * size))
    return [k]


def _answer(law):
    """From some row on an electrode's change from rest is another: law (x, t [s], rng, size)."""

    def form(c, rng, size):
        k, s = _one(c, rng, True), _onset(len(c.counts), rng)
        rest = np.quantile(c.counts[:, k], 0.95)
        x = c.counts[s:, k] - rest
        c.counts[s:, k] = rest + law(x, np.arange(len(x)) / c.rate, rng, size)
        return [k]

    return form


def _settling_gain(x, t, rng, size):
    return x * (1 + (0.9 if rng.random() < 0.4 else -0.9) * size * (1 - np.exp(-t / rng.uniform(2, 8))))


def _one_sided(x, t, rng, size):
    knee = np.quantile(x, rng.uniform(0.4, 0.7))
    return np.where(x < knee, knee + (x - knee) * (1 - 0.95 * size), x)


def _compressed(x, t, rng, size):
    width = 0.6 * np.abs(x).mean() / size
    return width * np.tanh(x / width)


def _shunted(c, rng, size):
    """A film of liquid beside the electrode: a conductance in parallel, with the load it tells less of."""
    k, z = _one(c, rng, True), _z(c.counts)
    s, share = _onset(len(z), rng), 0.75 * size
    rest = np.exp(np.quantile(z[:, k], 0.05))
    x = np.exp(z[s:, k])
    mixed = 1 / ((1 - share) / x + share / rest)
    c.counts[s:, k] = _counts(np.log(mixed))
    return [k]


_FLIPS = (
    _answer(lambda x, t, r, size: -r.uniform(0.7, 1.1) * x),
    _answer(lambda x, t, r, size: x * (1 - (1 + r.uniform(0.7, 1)) * np.clip(t / r.uniform(3, 8), 0, 1))),
)


def _reversed_pair(c, rng, size):
    """The two wires of a differential input changed places."""
    k, s = _one(c, rng, True), _onset(len(c.counts), rng)
    c.counts[s:, k] = 4095 - c.counts[s:, k]
    return [k]


def _moved(when, who):
    """In the rows of `when` the electrodes who[0] read what who[1] read."""

    def form(c, rng, size):
        n = len(c.counts)
        rows = np.flatnonzero(when(n, rng))
        to, source = who(rng)
        c.counts[np.ix_(rows, to)] = c.counts[np.ix_(rows, source)]
        return to[to != source]

    return form


def _from_now(n, rng):
    return np.arange(n) >= _onset(n, rng)


def _for_a_while(n, rng):
    a = _onset(n, rng)
    return (np.arange(n) >= a) & (np.arange(n) < a + rng.uniform(0.15, 0.35) * n)


def _turned_plug(rng):
    a = rng.integers(15) + np.arange(rng.integers(4, 6))
    return a, a[::-1]


def _two_pairs(rng):
    a = rng.choice(19, 4, replace=False)
    return a, a[[1, 0, 3, 2]]


def _pair(rng):
    a = rng.choice(19, 2, replace=False)
    return a, a[::-1]


def _address_bit(rng):
    """A bit of the multiplexer's address stays 0: who has it set reads its sibling."""
    bit = 1 << int(rng.integers(1, 4))
    to = np.flatnonzero(np.arange(19) & bit)
    return to, to ^ bit


# --- acquisition


def _leaking(law):
    """Counts added to all electrodes: law (x (n, 19) change from rest, case, rng) times size."""

    def form(c, rng, size):
        c.counts = c.counts + size * law(c.counts - np.quantile(c.counts, 0.9, axis=0), c, rng)
        return range(19)

    return form


def _aggressor(x, c, rng):
    k = _one(c, rng, True)
    return 0.8 * x[:, [k]] * np.where(np.arange(19) == k, 0, rng.uniform(0.5, 1, 19))


def _common_return(x, c, rng):
    """All currents come back through one wire."""
    return -0.12 * x.sum(1, keepdims=True) * rng.uniform(0.4, 1, 19)


def _charge(x, c, rng):
    """The converter keeps charge of the sample before: E1 of the last row's E19."""
    flat = c.counts.ravel()
    before = np.concatenate([flat[:1], flat[:-1]]).reshape(-1, 19)
    return 0.6 * (before - c.counts)


def _capacitive(x, c, rng):
    slope = c.rate * np.gradient(gaussian_filter1d(x, 2, axis=0), axis=0)
    return 0.25 * (np.roll(slope, 1, axis=1) + 0.5 * np.roll(slope, -1, axis=1))


def _median_of_rows(c, rng, size):
    c.counts = median_filter(c.counts, size=(2 * int(1 + 7 * size) + 1, 1), mode="nearest")
    return range(19)


def _slewing(c, rng, size):
    """The driver lets a value change by so much a row."""
    out, limit = c.counts.copy(), np.quantile(np.abs(np.diff(c.counts, axis=0)), 0.9 - 0.55 * size, axis=0)
    limit = np.maximum(limit, 0.5)
    for before, now in zip(out[:-1], out[1:]):
        now[:] = before + np.clip(now - before, -limit, limit)
    c.counts = out
    return range(19)


def _upsampled(c, rng, size):
    """Read less often, with straight lines between the readings."""
    at = np.arange(0, len(c.counts), int(2 + 12 * size))
    rows = np.arange(len(c.counts))
    c.counts = np.stack([np.interp(rows, at, x) for x in c.counts[at].T], axis=1)
    return range(19)


def _bessel(c, rng, size):
    sos = bessel(3, c.rate * 0.3 * 0.06**size, fs=c.rate, output="sos", norm="mag")
    level = c.counts[0]
    c.counts = level + sosfilt(sos, c.counts - level, axis=0)
    return range(19)


def _line(low, high, wave):
    """wave (phase (n, 1), electrode (19,), n, rng) -> (n, 1) or (n, 19); low, high: of the rate."""

    def form(c, rng, size):
        n = len(c.counts)
        phase = 2 * np.pi * rng.uniform(low, high) * np.arange(n)[:, None]
        c.counts += 40 * size * wave(phase, np.arange(19), n, c.rate, rng) * rng.uniform(0.5, 1.2, 19)
        return range(19)

    return form


_LINES = (
    _line(0.13, 0.16, lambda p, k, n, rate, r: np.sin(p) + 0.6 * np.sin(2 * p + 1) + 0.4 * np.sin(3 * p + 2)),
    # the multiplexer reads E1 to E19 one after the other, and the mains are not quite constant
    _line(0.22, 0.4, lambda p, k, n, rate, r: np.sin(p + 3 * _wandering(n, 200, r)[:, None] + 0.45 * k)),
    _line(0.2, 0.44, lambda p, k, n, rate, r: np.sin(p) * _bursts(n, rate, r)[:, None]),
    _line(0.2, 0.3, lambda p, k, n, rate, r: p / np.pi % 2 - 1),
)


def _written(law):
    """size -> a whole number of bits, 0 to 5"""

    def form(c, rng, size):
        c.counts = law(c.counts, int(np.rint(5 * (1 + np.log(size) / np.log(64)))))
        return range(19)

    return form


def _volts(x, bits):
    step = 0.0005 * 2**bits  # of 3.3 V
    return np.rint(step * np.rint(3.3 * x / 4095 / step) * 4095 / 3.3)


def _short_float(x, bits):
    step = 2.0 ** (np.floor(np.log2(np.maximum(x, 1))) - 10 + bits)
    return step * np.rint(x / step)


def _error_feedback(x, bits):
    step = 2.0**bits + 1
    return np.diff(step * np.rint(np.cumsum(x, axis=0) / step), axis=0, prepend=0 * x[:1])


def _two_codes(c, rng, size):
    """An open input that toggles between two codes."""
    k = _one(c, rng)
    rows = np.flatnonzero(_for_a_while(len(c.counts), rng))
    c.counts[rows, k] = c.counts[rows[0], k] + rng.integers(0, 2, len(rows))
    return [k]


def _loose_wire(c, rng, size):
    """It holds what it had, several times."""
    k = _one(c, rng)
    on = _stretches(len(c.counts), int(rng.integers(3, 6)), 0.2, 0.4, rng)
    at = np.where(on, 0, np.arange(len(on)))
    c.counts[:, k] = c.counts[np.maximum.accumulate(at), k]
    return [k]


def _floating(c, rng, size):
    """An open input that drifts to a rail and stays there."""
    k, n = _one(c, rng), len(c.counts)
    s, rail = _onset(n, rng), rng.choice([0.0, 4095.0])
    away = _after(n, s, rng.uniform(0.3, 1), c.rate)[s:]
    c.counts[s:, k] = np.rint(c.counts[s, k] + (rail - c.counts[s, k]) * away)
    return [k]


def _bounded(law):
    """law (x, level, case, rng): level is passed in 2 to 40 % of the rows."""

    def form(c, rng, size):
        k = _one(c, rng, True)
        x = c.counts[:, k]
        c.counts[:, k] = np.rint(law(x, np.quantile(x, 0.02 + 0.38 * size), c, rng))
        return [k]

    return form


_BOUNDS = (
    _bounded(lambda x, level, c, r: np.where(x < level, level + 0.06 * (x - level), x)),  # a diode
    _bounded(lambda x, level, c, r: np.maximum(x, level + 25 * (c.clock - 0.5))),  # the battery
    # an amplifier that takes its time to come back
    _bounded(lambda x, level, c, r: minimum_filter1d(np.maximum(x, level), 15, origin=7)),
    _bounded(lambda x, level, c, r: np.clip(x, level, level + 0.6 * (x.max() - level))),
)


def _discharges(c, rng, size):
    """Sparks from a sleeve: bursts that die away in some rows."""
    k, n = _one(c, rng), len(c.counts)
    for a in rng.integers(10, n - 20, rng.integers(8, 16)):
        m = int(rng.integers(3, 8))
        c.counts[a : a + m, k] += _sign(rng) * 1500 * size * 0.5 ** np.arange(m) * rng.uniform(0.7, 1.3)
    return [k]


def _wrong_word(law):
    """In some rows: law (value, the next electrode's value), both int."""

    def form(c, rng, size):
        k, n = _one(c, rng), len(c.counts)
        rows = rng.choice(n - 20, max(12, n // 500), replace=False) + 10
        x = c.counts.astype(int)
        c.counts[rows, k] = law(x[rows, k], x[rows, (k + 1) % 19])
        return [k]

    return form


_WORDS = (
    _wrong_word(lambda x, other: (x & 0xFF) | (other & 0xF00)),  # the high byte of another word
    _wrong_word(lambda x, other: (x << 1) & 0xFFF),  # the clock slipped by a bit
)


def _held(rows):
    """rows (n, rate, rng, size) -> (n,) bool: this row is what the one before it was."""

    def form(c, rng, size):
        at = np.arange(len(c.counts))
        at[rows(len(at), c.rate, rng, size)] = 0
        c.counts = c.counts[np.maximum.accumulate(at)]
        return range(19)

    return form


def _regularly(periods, pauses):
    """A program that stops to tidy up, a buffer that is thrown away when it is full: so long [s] every so
    often."""

    def rows(n, rate, rng, size):
        period, pause = rng.uniform(*periods) * rate, rng.uniform(*pauses) * rate
        return (np.arange(n) + rng.integers(int(period))) % period < pause

    return rows


_TIDIES, _OVERFLOWS = _regularly((3, 6), (0.35, 0.8)), _regularly((6, 12), (0.3, 1.2))


def _two_clocks(n, rate, rng, size):
    """The sensor is read ever less often: every row at first, every sixth at the end."""
    read = np.floor(np.cumsum(1 / (1 + 5 * np.linspace(0, 1, n) ** 1.5)))
    return np.diff(read, prepend=-1) == 0


def _radio(n, rate, rng, size):
    """Pauses of all lengths."""
    on = np.zeros(n, bool)
    for a in rng.integers(10, n - 10, max(6, int(n / rate / 6))):
        on[a : a + int(min(0.08 * (1 + rng.pareto(0.9)), 4) * rate)] = True
    return on


def _lossy(rows):
    """rows (n, rate, rng, size) -> (n,) bool, lost; the force plate's logger may be another one."""

    def form(c, rng, size):
        keep = ~rows(len(c.counts), c.rate, rng, size)
        keep[:10] = True
        c.gaps = np.flatnonzero(np.diff(np.flatnonzero(keep)) > 1) + 1
        c.counts = c.counts[keep]
        same = rng.random() < 0.5
        for name in ("force", "tdc"):
            x = getattr(c, name)
            setattr(c, name, None if x is None else x[keep] if same else x[: keep.sum()])
        return range(19)

    return form


def _interference(n, rate, rng, size):
    """A radio link that is good or bad for a while; bad, it loses most rows."""
    return (_bursts(n, rate, rng) > 0) & (rng.random(n) < 0.75)


def _half_rate(n, rate, rng, size):
    """For a quarter of the recording two rows of three are not written."""
    return _for_a_while(n, rng) & (np.arange(n) % 3 > 0)


def _refreshed(period, tremble):
    """period (n, rng) -> (n, 19) the row at which each value was read; tremble: what hides it, 1 count."""

    def form(c, rng, size):
        n = len(c.counts)
        at = np.clip(period(n, rng), 0, n - 1).astype(int)
        c.counts = np.take_along_axis(c.counts, np.broadcast_to(at, c.counts.shape), 0)
        c.counts = c.counts + tremble(rng, c.counts.shape)
        return range(19)

    return form


def _irregular(n, rng):
    read = np.unique(np.concatenate([[0], np.cumsum(rng.integers(3, 10, n // 3))]))
    return read[np.searchsorted(read, np.arange(n), "right") - 1][:, None]


_REFRESHED = (
    _refreshed(_irregular, lambda r, shape: r.integers(-1, 2, shape)),
    # a driver that reads a fifth of the electrodes a turn
    _refreshed(
        lambda n, r: (np.arange(n)[:, None] - np.arange(19) % 5) // 5 * 5 + np.arange(19) % 5,
        lambda r, shape: 0.7 * r.standard_normal(shape),
    ),
    _refreshed(
        lambda n, r: np.arange(n)[:, None] * 3 // 10 * 10 // 3,
        lambda r, shape: r.uniform(-1, 1, shape) + r.uniform(-1, 1, shape),
    ),
)


def _hiss(law):
    def form(c, rng, size):
        k, n = _one(c, rng), len(c.counts)
        c.counts[:, k] += 80 * size * law(c, n, k, rng)
        return [k]

    return form


def _with_load(c, n, k, rng):
    depth = np.abs(c.counts[:, k] - np.quantile(c.counts[:, k], 0.9))
    return (0.3 + depth / depth.std()) * rng.standard_normal(n)


_HISS = (
    _hiss(lambda c, n, k, r: _coloured(n, r.uniform(0.5, 0.8), r)),
    _hiss(_with_load),
    _hiss(lambda c, n, k, r: _bursts(n, c.rate, r) * r.standard_normal(n)),
    _hiss(lambda c, n, k, r: np.diff(r.standard_normal(n + 1))),
)


def _ground(law):
    """law (case, n, rng) -> (n,), weights (19,)"""

    def form(c, rng, size):
        x, weights = law(c, len(c.counts), rng)
        c.counts += 40 * size * x[:, None] * weights
        return np.flatnonzero(weights)

    return form


_GROUND = (
    _ground(lambda c, n, r: (_coloured(n, 0.6, r), r.uniform(0.6, 1.4, 19))),
    # one of two multiplexers
    _ground(lambda c, n, r: (r.standard_normal(n), np.where(np.arange(19) < 12, r.uniform(0.8, 1.2, 19), 0))),
    _ground(lambda c, n, r: (_bursts(n, c.rate, r) * r.standard_normal(n), r.uniform(0.8, 1.2, 19))),
)


# --- between force and electrodes


def _late(law):
    """law (n, rate, rng): (n,) by which the electrodes are late, 1: 35 ms at least, more than they are by
    themselves."""

    def form(c, rng, size):
        n = len(c.counts)
        late = (0.035 + 0.3 * size) * c.rate * law(n, c.rate, rng)
        at, first = np.arange(n) - np.rint(late).astype(int), int(np.ceil(late.max()))
        c.counts = c.counts[np.maximum(at, 0)][first:]
        c.force = c.force[first:]
        return range(19)

    return form


_LATE = (
    _late(lambda n, rate, r: 1 + r.uniform(0.6, 1.5) * (np.arange(n) > _onset(n, r))),
    _late(lambda n, rate, r: 0.7 + 1.2 * (np.arange(n) / rate / r.uniform(12, 30) % 1)),
    _late(lambda n, rate, r: 1.2 + 0.6 * _wandering(n, int(2 * rate), r)),
)


def _fading(kernel):
    """Force less its past, weighed by kernel (t [s], rng)."""

    def form(c, rng, size):
        t = (0.5 + np.arange(int(40 * c.rate))) / c.rate
        k = kernel(t, rng)
        past = fftconvolve(c.force - c.force[0], (k / k.sum())[:, None], axes=0)[: len(c.force)]
        c.force = c.force + size * (c.force - c.force[0] - past)
        return range(19)

    return form


def _quick_in_slow_out(c, rng, size):
    """Relaxes faster under a growing load than it comes back."""
    state, out = c.force[0].copy(), np.empty_like(c.force)
    quick, slow = 1 / (rng.uniform(0.5, 1.2) * c.rate), 1 / (rng.uniform(4, 10) * c.rate)
    for f, o in zip(c.force, out):
        state += np.where(np.abs(f) > np.abs(state), quick, slow) * (f - state)
        o[:] = f - state
    c.force = c.force + size * out
    return range(19)


def _stops(width):
    """Slip with a limit: width (force (n, 3), rng) -> (n, 3, m) of each of m elements."""

    def form(c, rng, size):
        limit = width(c.force, rng)
        smooth = gaussian_filter1d(c.force, 3, axis=0)
        z, out = np.zeros(limit.shape[1:]), np.empty_like(c.force)
        for i, step in enumerate(np.diff(smooth, axis=0, prepend=smooth[:1])):
            z = np.clip(z + step[:, None], -limit[i], limit[i])
            out[i] = z.sum(1)
        c.force = c.force + 2 * size * out
        return range(19)

    return form


def _many(force, rng):
    scale = force.std(0)[:, None] * np.array([0.1, 0.3, 0.7, 1.2]) / 2
    return np.broadcast_to(scale, (len(force), 3, 4))


def _coulomb(force, rng):
    return rng.uniform(0.15, 0.3) * np.abs(force[:, 2])[:, None, None] * np.ones((1, 3, 1))


def _backlash(c, rng, size):
    """A fixture with play, wider one way than the other."""
    gap = 2.5 * size * c.force.std(0)
    low, high = 0.3 * gap, 0.7 * gap
    at, out = c.force[0].copy(), np.empty_like(c.force)
    for f, o in zip(c.force, out):
        at = np.clip(at, f - high, f + low)
        o[:] = at
    c.force = out
    return range(19)


# --- outside the catalogue, any recording


def _pulse(c, rng, size):
    """The heart of who holds the sensor."""
    n = len(c.counts)
    beat = np.cumsum(rng.normal(0.85, 0.04, int(n / c.rate / 0.7) + 4))
    t = np.arange(n) / c.rate
    since = t - np.concatenate([[0], beat])[np.searchsorted(beat, t)]
    wave = since / 0.08 * np.exp(1 - since / 0.08) + 0.4 * np.exp(-(((since - 0.4) / 0.07) ** 2))
    c.counts += 150 * size * wave[:, None] * rng.standard_normal(19)
    return range(19)


def _motor(c, rng, size):
    """A motor runs up, again and again, beside a part of the electrodes."""
    t = np.arange(len(c.counts)) / c.rate
    u = t / rng.uniform(4, 8) % 1
    who = rng.choice(19, 7, replace=False)
    phase = 2 * np.pi * np.cumsum(0.3 + 0.2 * c.rate * u**2) / c.rate
    c.counts[:, who] += 150 * size * (np.sin(phase) * u)[:, None] * rng.uniform(0.5, 1, 7)
    return who


def _travelling(c, rng, size):
    """A wave that runs round the fluid and changes all impedances, each in its turn."""
    phase = 2 * np.pi * rng.uniform(0.3, 0.9) * np.arange(len(c.counts)) / c.rate
    c.counts = _counts(_z(c.counts) + 0.15 * size * np.sin(phase[:, None] + 2 * np.pi * np.arange(19) / 19))
    return range(19)


# --- and under load


def _auto_zero(c, rng, size):
    """A firmware that takes the mean of the last seconds for rest."""
    a = 1 / (rng.uniform(2, 6) * c.rate)
    level = c.counts[0]
    c.counts = c.counts - size * lfilter([a], [1, a - 1], c.counts - level, axis=0)
    return range(19)


def _out_of_order(c, rng, size):
    """Packets that overtake each other."""
    block = int(4 + 16 * size)
    at = np.arange(len(c.counts))
    at = np.argsort(at // block * block + rng.permuted(np.resize(np.arange(block), len(at))), kind="stable")
    c.counts = c.counts[at]
    return range(19)


def _stick_slip(c, rng, size):
    """The skin sticks and slips where the load is high."""
    z = _z(c.counts)
    load = np.abs(z - np.quantile(z, 0.1, axis=0)).mean(1)
    saw = (np.cumsum(rng.uniform(4, 9) / c.rate * (1 + 0.3 * rng.standard_normal(len(load))))) % 1 - 0.5
    sides = rng.choice([-1, 1], 19) * rng.uniform(0.3, 1, 19)
    c.counts += 250 * size * ((load > np.quantile(load, 0.6)) * saw)[:, None] * sides
    return range(19)


def _products(c, rng, size):
    """An amplifier near its end mixes what passes through it: products of two electrodes in others."""
    x = (c.counts - np.median(c.counts, axis=0)) / np.maximum(c.counts.std(0), 1)
    a, b, *others = rng.choice(19, 8, replace=False)
    product = x[:, a] * x[:, b]
    c.counts[:, others] += 150 * size * (product - np.median(product))[:, None] * rng.uniform(0.5, 1, 6)
    return others


def _creeping_skin(c, rng, size):
    """The skin turns on the core: each electrode passes over to its neighbour."""
    x = c.counts - np.quantile(c.counts, 0.95, axis=0)
    c.counts = c.counts + size * c.clock[:, None] ** 1.5 * (np.roll(x, int(_sign(rng)), axis=1) - x)
    return range(19)


def _automatic_gain(c, rng, size):
    """A driver that turns the gain down after strong signals."""
    x = c.counts - np.median(c.counts, axis=0)
    a = 1 / (rng.uniform(2, 5) * c.rate)
    loud = np.sqrt(lfilter([a], [1, a - 1], (x**2).mean(1)) + 1)
    c.counts = c.counts + size * x * (np.median(loud) / loud - 1)[:, None].clip(-0.9, 1.5)
    return range(19)


EFFECTS = {
    "warmup": Effect(tuple(_shared(-0.6, x) for x in (_slab, _from_the_core, _switched_on, _room))),
    "fluidloss": Effect(tuple(_shared(0.6, x) for x in (_pressed_out, _drops, _torricelli, _sealed))),
    "count_offset": Effect(
        (
            _supply(_sag),
            _supply(_neighbour_device),
            _supply(_uneasy),
        )
    ),
    "thermal": Effect(
        (
            _heat(lambda t, c, r: t[:, None] * r.uniform(0.3, 1.7, 19)),
            _heat(_inside_later),
            _heat(_with_flow),
        ),
        "tdc",
    ),
    "drift": Effect(
        (
            _alone(lambda c, n, r: _wandering(n, int(4 * c.rate), r)),
            _alone(_arch),
            _alone(lambda c, n, r: np.expm1(5 * c.clock) / np.expm1(5)),
            _alone(_knots),
        )
    ),
    "jump": Effect((_alone(_ringing), _alone(_two_clicks), _alone(_chatter), _resistor)),
    "gain": Effect((_answer(_settling_gain), _answer(_one_sided), _answer(_compressed), _shunted), "loaded"),
    "flip": Effect((*_FLIPS, _reversed_pair), "loaded"),
    "swap": Effect(
        (
            _moved(_from_now, _turned_plug),
            _moved(_for_a_while, lambda r: (np.arange(19), np.roll(np.arange(19), 1))),  # a word slipped
            _moved(_from_now, _two_pairs),
            _moved(lambda n, r: _stretches(n, 4, 0.3, 0.5, r), _pair),
        )
    ),
    "crosstalk": Effect(tuple(map(_leaking, (_aggressor, _common_return, _charge, _capacitive))), "loaded"),
    "lowpass": Effect((_median_of_rows, _slewing, _upsampled, _bessel), "noisy"),
    "hum": Effect(_LINES, "noisy"),
    "quantise": Effect(tuple(map(_written, (_volts, _short_float, _error_feedback))), "noisy", True),
    "stuck": Effect((_two_codes, _loose_wire, _floating), "noisy", True),
    "saturate": Effect(_BOUNDS, "loaded", True),
    "spikes": Effect((_discharges, *_WORDS), "any", True),
    "freeze": Effect(
        tuple(map(_held, (_regularly((3, 6), (0.35, 0.8)), _two_clocks, _radio))), "noisy", True
    ),
    "lost": Effect(
        tuple(map(_lossy, (_regularly((6, 12), (0.3, 1.2)), _interference, _half_rate))), "loaded", True
    ),
    "dither": Effect(_REFRESHED, "noisy"),
    "noise": Effect(_HISS),
    "common_noise": Effect(_GROUND),
    "latency": Effect(_LATE, "force"),
    "relax": Effect(
        (
            _fading(lambda t, r: t ** -r.uniform(0.6, 0.9)),
            _fading(lambda t, r: np.exp(-np.sqrt(t / r.uniform(0.3, 1)))),
            _quick_in_slow_out,
        ),
        "force",
    ),
    "hyster": Effect((_stops(_many), _stops(_coulomb), _backlash), "force"),
    "outside": Effect(
        (_pulse, _motor, _travelling, _moved(lambda n, r: _stretches(n, 5, 0.3, 0.5, r), _address_bit))
    ),
    "outside_loaded": Effect(
        (_auto_zero, _out_of_order, _stick_slip, _products, _creeping_skin, _automatic_gain), "loaded"
    ),
}
OUTSIDE = FIRST_OUTSIDE | {"outside_loaded"}
ACCEPTED = FIRST_ACCEPTED | {"outside_loaded": {"outside_loaded"}}
# What a base has by itself, read from the recordings.
#   press, still: 14 to 15 % of the rows repeat the one before in all 19 electrodes, at noises of 2 to 7
#     counts: a sensor of 100 Hz is asked 117 times a second. The unloaded sensor rises by 150 to 230 counts
#     in 192 s, by less every minute; F1 and F2, in the hand, by 100 to 160 in their means of a sixth.
#   press: a regression of force on the electrodes is best where these are taken 2 to 4 rows later.
#   grip: TDC falls by 20 to 55 counts on steel and acrylic and by 1 to 8 on sponge, all in one direction with
#     the electrodes' means, twelve or more of which move together; ten seconds do not say by which law.
#   touch: the native log has bursts of 40 ms a quarter of a second to half a second apart.
#   slide: absolute deviations from rest; electrodes that stay near rest are bounded there on one side.
#   scrape: each value stands in three rows.
NATURAL = FIRST_NATURAL | {
    "press": {"warmup", "latency", "freeze"},
    "still": {"warmup", "freeze"},
    "grip": {"warmup", "thermal", "fluidloss"},
    "touch": {"lost_rows"},
    "slide": {"saturate"},
    "scraped": {"freeze"},
}
_BASES = ["press", "press with force", "still", "grip", "touch", "slide", "scraped"]
_CAN = {
    "any": _BASES[:6],
    "noisy": _BASES[:3],
    "loaded": _BASES[:2],
    "force": _BASES[1:2],
    "tdc": _BASES[3:4],
}


def _native(path):
    """(n, 19) electrodes of SynTouch's own log: lines of time, ids, channel (17: E1), ..., value."""
    with gzip.open(path, "rt") as file:
        lines = np.array([line.split() for line in file.read().split("Begin File")[1].strip().splitlines()])
    channel, value = lines[:, 3].astype(int), lines[:, 8].astype(float)
    read = [value[channel == k] for k in range(17, 36)]
    return np.stack([x[: min(map(len, read))] for x in read], axis=1)


def bases(folder: pathlib.Path) -> dict:
    """name -> function (rng) -> Case: pieces of real recordings in a folder.

    Both pressed sensors and the unloaded one (28 to 150 s of each), both fingers of a gripper on steel,
    acrylic and sponge (trials that the first generators leave to practice), SynTouch's own log of a touch,
    four slides whose electrodes stay on one side of rest, both fingers of a scraping hand.
    """
    folder = pathlib.Path(folder)
    names = (
        ("epfl_flat_press/SynImpF1.txt", "epfl_flat_press/ForceData.txt"),
        ("epfl_f2/SynImpF2.txt.gz", "epfl_f2/ForceData.txt.gz"),
    )
    pressed = [[_table(folder / name) for name in pair] for pair in names]
    rest = _table(folder / "epfl_flat_press/SynImpF2.txt")
    holds = sorted((folder / "phac_hold").glob("*.mat"))[::2]
    log = _native(folder / "btd/btsp_touch.btd.gz")
    slides = [
        np.loadtxt(
            folder / f"slides_20/mat{name}_bio.csv.gz", delimiter=",", skiprows=1, usecols=range(26, 45)
        )
        for name in ("18_1", "18_2", "1_1", "1_2")
    ]
    tools = [_table(folder / f"scraping/sense_R_{side}.txt.gz") for side in ("LF", "RF")]

    def piece(rng, low, high, *arrays):
        n = len(arrays[0])
        length = min(n, int(np.exp(rng.uniform(np.log(low), np.log(high)))))
        a = int(rng.integers(n - length + 1))
        return [x[a : a + length].astype(float) for x in arrays]

    def press(with_force):
        def of(rng):
            counts, force = piece(rng, 28 * 117, 150 * 117, *pressed[rng.integers(2)])
            return Case("press", counts, 117.0, force if with_force else None, None, True)

        return of

    def grip(rng):
        data, finger = loadmat(holds[rng.integers(len(holds))]), f"F{rng.integers(2)}"
        counts, tdc = piece(rng, 700, 1000, data[f"{finger}Electrodes"].T, data[f"{finger}tdc"].ravel())
        return Case("grip", counts, 100.0, None, tdc)

    def above_rest(name, rate, low, recordings, side):
        def of(rng):
            (x,) = piece(rng, low, 10**4, recordings[rng.integers(len(recordings))])
            return Case(name, np.rint(rng.uniform(2100, 3350, 19)) + side(rng) * x, rate)

        return of

    return {
        "press": press(False),
        "press with force": press(True),
        "still": lambda rng: Case("still", *piece(rng, 28 * 117, 150 * 117, rest), 117.0),
        "grip": grip,
        "touch": lambda rng: Case("touch", *piece(rng, 1400, len(log), log), 100.0),
        "slide": above_rest("slide", 100.0, 500, slides, lambda r: r.choice([-1, 1], 19)),
        "scraped": above_rest("scraped", 300.0, 900, tools, lambda r: 1),
    }


def plan(nulls: int, singles: int, pairs: int) -> list:
    """(base, effects, seed): recordings without effect on each of 7 bases, of each effect (twice as many of
    each kind outside the catalogue), and pairs."""
    out = [(base, (), i) for base in _BASES for i in range(nulls)]
    for effect, spec in EFFECTS.items():
        can, turn = _CAN[spec.on], zlib.crc32(effect.encode())
        for i in range(singles * (2 if effect in OUTSIDE else 1)):
            out.append((can[(turn + i + i // len(spec.forms)) % len(can)], (effect,), i))
    rng = np.random.default_rng(zlib.crc32(b"second"))
    free = [e for e, s in EFFECTS.items() if s.on in ("any", "noisy", "loaded") and e not in OUTSIDE]
    for i in range(pairs):
        pair = tuple(sorted(rng.choice(free, 2, replace=False)))
        can = min((_CAN[EFFECTS[e].on] for e in pair), key=len)
        out.append((str(can[i % len(can)]), tuple(map(str, pair)), i))
    return out


def make(sources: dict, base: str, effects: tuple, seed: int) -> tuple[Case, np.ndarray]:
    """The case, and the counts without the hidden effects (n, 19), rows that are lost later among them.

    The same arguments give the same case. Raises ValueError where no draw of a form can be seen on the base.
    """
    key = zlib.crc32(repr((base, effects, seed)).encode())
    for attempt in range(40):
        rng = np.random.default_rng([key, attempt])
        case = sources[base](rng)
        clean = case.counts.copy()
        for effect in sorted(effects, key=lambda e: EFFECTS[e].late):
            spec = EFFECTS[effect]
            form = seed % len(spec.forms) if len(effects) == 1 else int(rng.integers(len(spec.forms)))
            aim = np.exp(rng.uniform(np.log(LEAST), np.log(PLAIN)))
            case = _hide(case, effect, form, aim, int(rng.integers(2**31)))
            if case is None:
                break
        else:
            case.counts = np.clip(np.rint(case.counts), 0, 4095)
            return case, clean
    raise ValueError(f"no draw of {effects} can be seen on {base!r}: give it another base in the plan")


def _hide(case, effect, form, aim, seed):
    """The case with an effect of the least size that is as visible as aimed at, or as it gets; None where
    that is less than LEAST."""
    spec = EFFECTS[effect]
    counts = np.clip(np.rint(case.counts), 0, 4095) if spec.late else case.counts
    before = _columns(case)
    for size in _SIZES:
        now = replace(case, counts=counts.copy())
        channels = [int(k) for k in spec.forms[form](now, np.random.default_rng(seed), size)]
        seen = visible(before, _columns(now), effect in _GRADUAL)
        if seen >= aim:
            break
    if seen < LEAST:
        return None
    found = {"channels": channels, "truth": effect, "forms": form, "seen": seen}
    return replace(now, **{name: [*getattr(case, name), value] for name, value in found.items()})
