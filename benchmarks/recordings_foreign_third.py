"""Pieces of real recordings with one or two effects put in, by a third author: own shapes, sizes, onsets.

Numpy, scipy. The vocabulary (names, Case) is that of the first two authors' generators; no form is theirs.
Sizes are in the recording's own measures: `noise` (robust, row to row) and `span` (2nd to 98th percentile,
what a plot of the electrode fills), so that a person sees each of them in a plot of the piece.
"""

import gzip
import pathlib
import zlib

import numpy as np
from recordings_foreign import Case
from scipy.io import loadmat
from scipy.signal import lfilter

__all__ = ["EFFECTS", "bases", "make", "plan"]

SEED = b"third author, 22 November"


def Z(c):
    return np.log(4095 / np.clip(c, 1, 4094) - 1)


def C(z):
    return 4095 / (1 + np.exp(z))


def noise(x):
    return np.maximum(np.median(np.abs(np.diff(x, axis=0)), axis=0) / 0.954, 0.7)


def span(x):
    return np.maximum(np.quantile(x, 0.98, axis=0) - np.quantile(x, 0.02, axis=0), 6 * noise(x))


def rest(x):
    return np.median(np.sort(x, axis=0)[-len(x) // 5 :], axis=0)


def onset(n, r, a=0.25, b=0.6):
    return int(r.uniform(a, b) * n)


def window(n, r, a, b):
    """Rows s..e: a to b of the piece, somewhere inside."""
    m = int(r.uniform(a, b) * n)
    s = int(r.uniform(0.1, 0.85) * (n - m))
    return s, s + m


def pm(r):
    return 1.0 if r.random() < 0.5 else -1.0


def pick(c, r, lively=False):
    """An electrode not used yet; lively: of the eight that move most."""
    used = {k for ch in c.channels if len(ch) < 19 for k in ch}
    order = np.argsort(-span(c.counts))[:8] if lively else r.permutation(19)
    return int(r.choice([k for k in order if k not in used]))


# --- gradual, all electrodes: in z (log of impedance ratio)


def shared(sign):
    """Size: the median electrode moves by 0.5 to 1.3 of the piece's median span, and 25 counts at least."""

    def wrap(course, spread):
        def form(c, r):
            t = c.clock[:, None]
            goal = np.clip(r.uniform(0.5, 1.3) * np.median(span(c.counts)), 25, 900)
            slope = np.median(c.counts[0] * (1 - c.counts[0] / 4095))
            w = 1 + spread * r.uniform(-1, 1, 19)
            y = course(t, r)
            c.counts = C(Z(c.counts) + sign * goal / slope * w * (y - y[0]) / np.ptp(y))
            return range(19)

        return form

    return wrap


_warm, _dry = shared(-1), shared(1)
WARMUP = (
    _warm(lambda t, r: 0.6 * (1 - np.exp(-t / 0.08)) + 0.7 * (1 - np.exp(-t / r.uniform(0.4, 0.6))), 0.12),
    _warm(lambda t, r: np.tanh(t / r.uniform(0.3, 0.7)), 0.2),
    _warm(lambda t, r: t / (t + r.uniform(0.15, 0.5)), 0.1),
)
FLUID = (
    _dry(lambda t, r: np.maximum(t - r.uniform(0.15, 0.3), 0), 0.2),
    _dry(lambda t, r: np.sqrt(t + 0.002), 0.15),
    _dry(lambda t, r: 1 / (1.5 - t) ** r.uniform(0.5, 1), 0.3),
)


def thermal(course):
    def form(c, r):
        t = (c.tdc - c.tdc[:10].mean()).astype(float)
        y = course(np.convolve(np.pad(t, 20, "edge"), np.ones(41) / 41, "valid"), c, r)
        goal = max(25.0, r.uniform(0.6, 1.5) * np.median(span(c.counts)))
        k = goal / np.median(c.counts[0] * (1 - c.counts[0] / 4095)) / np.abs(y).max()
        c.counts = C(Z(c.counts) - k * y[:, None] * r.normal(1, 0.12, 19))
        return range(19)

    return form


def _lag(y, c, r):
    m = r.uniform(0.5, 1.5) * c.rate
    return lfilter([1 / m], [1, 1 / m - 1], y)


THERMAL = (
    thermal(lambda y, c, r: y),
    thermal(_lag),
    thermal(lambda y, c, r: y + 0.35 * y * np.abs(y) / np.abs(y).max()),
)

# --- supply


def supply(course):
    def form(c, r):
        size = max(8 * np.median(noise(c.counts)), min(300, r.uniform(0.3, 0.8) * np.median(span(c.counts))))
        c.counts = c.counts + pm(r) * size * course(len(c.counts), c, r)[:, None]
        return range(19)

    return form


def _brownout(n, c, r):
    a, b = window(n, r, 0.2, 0.4)
    m = 0.4 * c.rate
    return np.interp(np.arange(n), [a, a + m, b, b + 2 * m], [0, 1, 0.85, 0])


def _toggling(n, c, r):
    edges = np.sort(r.uniform(0.1, 0.95, 5)) * n
    return (np.searchsorted(edges, np.arange(n)) % 2).astype(float)


def _swell(n, c, r):
    return np.sin(2 * np.pi * (np.arange(n) / n * r.uniform(2.2, 4.5) + r.random()))


OFFSET = (supply(_brownout), supply(_toggling), supply(_swell))

# --- one electrode, level


def level(course, low=0.25, high=0.7):
    def form(c, r):
        k = pick(c, r)
        n = len(c.counts)
        size = max(10 * noise(c.counts)[k], min(500, r.uniform(low, high) * span(c.counts)[k]))
        s, ends = pm(r), np.quantile(c.counts[:, k], [0.02, 0.98])
        if not (30 < ends[0] + s * size and ends[1] + s * size < 4065):
            s = -s
        c.counts[:, k] += s * size * course(n, c, r)
        return [k]

    return form


DRIFT = (
    level(lambda n, c, r: np.clip((np.arange(n) - onset(n, r, 0.1, 0.4)) / (0.6 * n), 0, None)),
    level(lambda n, c, r: 1 / (1 + np.exp(-(c.clock - r.uniform(0.35, 0.65)) / r.uniform(0.04, 0.1)))),
    level(lambda n, c, r: np.sin(2 * np.pi * c.clock * r.uniform(0.7, 1.3)), 0.3, 0.6),
)


def _box(n, c, r):
    a, b = window(n, r, 0.2, 0.4)
    x = np.zeros(n)
    x[a:b] = 1
    return x


def _thrown(n, c, r):
    t = (np.arange(n) - onset(n, r)) / c.rate
    return (t >= 0) * (0.6 + 0.9 * np.exp(-np.maximum(t, 0) / r.uniform(0.4, 1.5)))


JUMP = (
    level(lambda n, c, r: (np.arange(n) >= onset(n, r)).astype(float)),
    level(_box),
    level(_thrown),
)


def answer(law):
    def form(c, r):
        n = len(c.counts)
        for _ in range(80):  # an electrode that does not reach the converter's ends by it
            k = pick(c, r, True)
            x0 = rest(c.counts)[k]
            y = x0 + law(c.counts[:, k] - x0, n, r)
            if y.min() > 20 and y.max() < 4075:
                break
        else:
            raise ValueError("no electrode has room")
        c.counts[:, k] = y
        return [k]

    return form


def _stepgain(x, n, r):
    f = r.uniform(0.3, 0.55) if r.random() < 0.6 else r.uniform(1.5, 1.8)
    return np.where(np.arange(n) >= onset(n, r), f, 1) * x


def _fadegain(x, n, r):
    return x * np.interp(np.linspace(0, 1, n), [0.2, r.uniform(0.6, 0.9)], [1, r.uniform(0.2, 0.4)])


def _gaintoggle(x, n, r):
    a, b = window(n, r, 0.3, 0.45)
    f = np.ones(n)
    f[a:b] = r.uniform(0.25, 0.5)
    return f * x


GAIN = tuple(map(answer, (_stepgain, _fadegain, _gaintoggle)))


def _upside(x, n, r):
    return np.where(np.arange(n) >= onset(n, r), -r.uniform(0.6, 1.1), 1) * x


def _upside_while(x, n, r):
    a, b = window(n, r, 0.3, 0.45)
    f = np.ones(n)
    f[a:b] = -r.uniform(0.6, 1)
    return f * x


FLIP = (answer(_upside), answer(_upside_while))


def swapped(who, part):
    def form(c, r):
        n = len(c.counts)
        a, b = (onset(n, r), n) if part == "end" else window(n, r, 0.3, 0.45)
        to, frm = who(c, r)
        x = c.counts.copy()
        c.counts[a:b, to] = x[a:b, frm]
        return [int(k) for k in np.atleast_1d(to)]

    return form


def _two(c, r):
    a, b = pick(c, r, True), 0
    b = int(
        r.choice([k for k in range(19) if k != a and abs(c.counts[:, k].mean() - c.counts[:, a].mean()) > 30])
    )
    return np.array([a, b]), np.array([b, a])


def _three(c, r):
    a = r.permutation(19)[:3]
    return a, np.roll(a, 1)


def _nibbles(c, r):
    """A ribbon of six wires put on one position off."""
    a = r.integers(12) + np.arange(6)
    return a, np.roll(a, 1)


SWAP = (swapped(_two, "end"), swapped(_three, "while"), swapped(_nibbles, "end"))


def leak(law):
    def form(c, r):
        x = c.counts - rest(c.counts)
        c.counts = c.counts + law(x, r)
        return range(19)

    return form


def _next(x, r):
    return r.uniform(0.35, 0.6) * np.roll(x, 1, axis=1)


def _block(x, r):
    """Two blocks of a board leak into their own sums."""
    out = np.zeros_like(x)
    for part in (slice(0, 10), slice(10, 19)):
        out[:, part] = r.uniform(0.06, 0.1) * (x[:, part].sum(1, keepdims=True) - x[:, part])
    return out


def _mirror(x, r):
    """E1 and E19, E2 and E18, ...: two connectors face to face."""
    return r.uniform(0.3, 0.5) * x[:, ::-1] * (np.arange(19) != 9)


CROSS = tuple(map(leak, (_next, _block, _mirror)))

# --- filters and additions


def _rc(c, r):
    a = 1 - np.exp(-1 / (r.uniform(0.05, 0.2) * c.rate))
    x0 = c.counts[0]
    c.counts = x0 + lfilter([a], [1, a - 1], c.counts - x0, axis=0)
    return range(19)


def _boxcar(c, r):
    m = int(r.integers(8, 30))
    x = np.vstack([np.repeat(c.counts[:1], m - 1, 0), c.counts]).cumsum(0)
    x = np.vstack([np.zeros((1, 19)), x])
    c.counts = (x[m:] - x[:-m]) / m
    return range(19)


def _alpha(c, r):
    """Alpha-beta tracker of a driver."""
    a = r.uniform(0.12, 0.3)
    b = a * a / (2 - a)
    x, v = c.counts[0].copy(), np.zeros(19)
    out = np.empty_like(c.counts)
    for i, row in enumerate(c.counts):
        x = x + v
        e = row - x
        x, v = x + a * e, v + b * e
        out[i] = x
    c.counts = out
    return range(19)


LOWPASS = (_rc, _boxcar, _alpha)


def line(wave):
    def form(c, r):
        n = len(c.counts)
        f = r.uniform(0.11, 0.44)
        a = r.uniform(3, 8) * np.median(noise(c.counts))
        c.counts = c.counts + a * r.uniform(0.6, 1.4, 19) * wave(
            2 * np.pi * f * np.arange(n)[:, None], n, c, r
        )
        return range(19)

    return form


HUM = (
    line(lambda p, n, c, r: np.sin(p)),
    line(lambda p, n, c, r: np.sin(p) * (1 + 0.6 * np.sin(2 * np.pi * c.clock * r.uniform(3, 9)))[:, None]),
    line(lambda p, n, c, r: np.sign(np.sin(p + r.uniform(0, 6)))),
)


def hiss(law):
    def form(c, r):
        k = pick(c, r)
        size = max(r.uniform(4, 10) * noise(c.counts)[k], 0.02 * span(c.counts)[k])
        c.counts[:, k] += size * law(len(c.counts), r)
        return [k]

    return form


def _from(n, r):
    return r.standard_normal(n) * (np.arange(n) >= onset(n, r))


NOISE = (
    hiss(lambda n, r: r.standard_normal(n)),
    hiss(_from),
    hiss(lambda n, r: r.laplace(0, 0.8, n)),
)


def ground(law):
    def form(c, r):
        x, w = law(len(c.counts), r)
        c.counts = c.counts + r.uniform(3, 7) * np.median(noise(c.counts)) * x[:, None] * w
        return range(19)

    return form


def _middle(n, r):
    a, b = window(n, r, 0.4, 0.6)
    x = r.standard_normal(n)
    x[:a] = x[b:] = 0
    return x, r.uniform(0.8, 1.2, 19)


COMMON = (
    ground(lambda n, r: (r.standard_normal(n), np.ones(19))),
    ground(lambda n, r: (lfilter([0.85], [1, -0.5], r.standard_normal(n)), r.uniform(0.7, 1.3, 19))),
    ground(_middle),
)

# --- late: on what the converter gave


def _pow2(c, r):
    step = 2.0 ** np.ceil(np.log2(3 * np.median(noise(c.counts)) * r.uniform(1, 2)))
    c.counts = np.floor(c.counts / step) * step
    return range(19)


def _tens(c, r):
    step = max(10.0, 10 * np.ceil(r.uniform(3, 6) * np.median(noise(c.counts)) / 10))
    c.counts = np.rint(c.counts / step) * step
    return range(19)


def _percent(c, r):
    """Stored as thousandths of the full range, or coarser."""
    step = max(4.095, 4.095 * np.ceil(3.5 * np.median(noise(c.counts)) / 4.095))
    c.counts = np.rint(np.rint(c.counts / step) * step)
    return range(19)


QUANT = (_pow2, _tens, _percent)


def _dead(c, r):
    k, a = pick(c, r), onset(len(c.counts), r, 0.3, 0.7)
    c.counts[a:, k] = c.counts[a, k]
    return [k]


def _nap(c, r):
    k = pick(c, r)
    a, b = window(len(c.counts), r, 0.15, 0.3)
    c.counts[a:b, k] = c.counts[a, k]
    return [k]


def _rail(c, r):
    k = pick(c, r)
    a, b = window(len(c.counts), r, 0.1, 0.25)
    c.counts[a:b, k] = r.choice([0, 4095, 2048])
    return [k]


STUCK = (_dead, _nap, _rail)


def _floor(c, r):
    k = pick(c, r, True)
    c.counts[:, k] = np.maximum(c.counts[:, k], np.rint(np.quantile(c.counts[:, k], r.uniform(0.15, 0.35))))
    return [k]


def _ceiling(c, r):
    k = pick(c, r, True)
    c.counts[:, k] = np.minimum(c.counts[:, k], np.rint(np.quantile(c.counts[:, k], r.uniform(0.5, 0.75))))
    return [k]


def _both(c, r):
    k = pick(c, r, True)
    c.counts[:, k] = np.clip(
        c.counts[:, k], *np.rint(np.quantile(c.counts[:, k], [r.uniform(0.1, 0.2), 0.8]))
    )
    return [k]


SATURATE = (_floor, _ceiling, _both)


def glitch(value, length=1):
    def form(c, r):
        k, n = pick(c, r), len(c.counts)
        at = np.sort(r.choice(np.arange(15, n - 15, 4), int(r.integers(10, 26)), replace=False))
        size = max(20 * noise(c.counts)[k], 0.4 * span(c.counts)[k])
        for a in at:
            for j in range(length):
                c.counts[a + j, k] = value(c.counts[a + j, k], size, j, r)
        return [k]

    return form


SPIKES = (
    glitch(lambda x, s, j, r: x + pm(r) * s * r.uniform(0.8, 2)),
    glitch(lambda x, s, j, r: 0.0),
    glitch(lambda x, s, j, r: x + (-1) ** j * s * r.uniform(0.8, 1.5), 2),
)


def hold(rows):
    def form(c, r):
        at = np.where(rows(len(c.counts), c, r), 0, np.arange(len(c.counts)))
        c.counts = c.counts[np.maximum.accumulate(at)]
        return range(19)

    return form


def _stalls(n, c, r):
    x = np.zeros(n, bool)
    for a in r.uniform(0.05, 0.95, r.integers(5, 10)):
        x[int(a * n) : int(a * n + r.uniform(0.3, 1.2) * c.rate)] = True
    return x


def _longstall(n, c, r):
    x = np.zeros(n, bool)
    a, b = window(n, r, 0.08, 0.15)
    x[a:b] = True
    return x


def _slowpart(n, c, r):
    a, b = window(n, r, 0.4, 0.6)
    i, m = np.arange(n), int(r.integers(4, 9))
    return (i >= a) & (i < b) & (i % m > 0)


FREEZE = tuple(map(hold, (_stalls, _longstall, _slowpart)))


def lossy(rows):
    def form(c, r):
        keep = ~rows(len(c.counts), c, r)
        keep[:10] = True
        c.gaps = np.flatnonzero(np.diff(np.flatnonzero(keep)) > 1) + 1
        c.counts = c.counts[keep]
        c.force = None if c.force is None else c.force[keep]
        return range(19)

    return form


def _holes(number, low, high):
    """Gaps where something happens meanwhile: the largest change across of 12 places tried."""

    def rows(n, c, r):
        x = np.zeros(n, bool)
        for _ in range(int(r.integers(*number))):
            m = int(r.uniform(low, high) * c.rate)
            tries = r.integers(20, n - m - 20, 12)
            a = max(
                tries,
                key=lambda a: (not x[a - 5 : a + m + 5].any(), np.abs(c.counts[a + m] - c.counts[a]).mean()),
            )
            x[a : a + m] = True
        return x

    return rows


def _buffers(n, c, r):
    a, b = window(n, r, 0.4, 0.6)
    i, m = np.arange(n), int(r.integers(60, 130))
    return (i >= a) & (i < b) & (i % m < 0.35 * m)


LOST = (lossy(_holes((4, 8), 0.4, 1.0)), lossy(_holes((2, 3), 1.5, 3)), lossy(_buffers))


def dither(period, tremble):
    def form(c, r):
        n = len(c.counts)
        c.counts = c.counts[period(n, r)] + tremble(r, (n, 19))
        return range(19)

    return form


DITHER = (
    dither(lambda n, r: np.arange(n) // 5 * 5, lambda r, s: r.integers(-1, 2, s)),
    dither(lambda n, r: np.arange(n) // 8 * 8, lambda r, s: np.rint(0.6 * r.standard_normal(s))),
    dither(
        lambda n, r: np.maximum.accumulate(np.where(r.random(n) < 0.17, np.arange(n), 0)),
        lambda r, s: np.rint(r.uniform(-1.2, 1.2, s)),
    ),
)

# --- with force


def late(law):
    """Electrodes late by 80 ms at least."""

    def form(c, r):
        n = len(c.counts)
        d = law(n, c, r) * c.rate
        m = int(np.ceil(d.max()))
        at = np.arange(n) - np.rint(d).astype(int)
        c.counts, c.force = c.counts[np.maximum(at, 0)][m:], c.force[m:]
        return range(19)

    return form


LATE = (
    late(lambda n, c, r: np.full(n, r.uniform(0.1, 0.35))),
    late(lambda n, c, r: np.where(c.clock < r.uniform(0.3, 0.6), 0.08, r.uniform(0.2, 0.4))),
    late(lambda n, c, r: 0.08 + r.uniform(0.2, 0.4) * c.clock),
)


def _low(f, seconds, rate):
    a = 1 - np.exp(-1 / (seconds * rate))
    return lfilter([a], [1, a - 1], f, axis=0)


def fading(law):
    def form(c, r):
        f = c.force - c.force[0]
        c.force = c.force[0] + law(f, c.rate, r)
        return range(19)

    return form


def _logs(f, rate, r):
    """Equal parts relax in 0.3, 1, 3 and 10 s."""
    return f - r.uniform(0.5, 0.8) * np.mean([_low(f, s, rate) for s in (0.3, 1, 3, 10)], axis=0)


RELAX = (
    fading(lambda f, rate, r: f - r.uniform(0.4, 0.7) * _low(f, r.uniform(1, 6), rate)),
    fading(lambda f, rate, r: f - r.uniform(0.25, 0.4) * (_low(f, 0.6, rate) + _low(f, 8.0, rate))),
    fading(_logs),
)


def _boucwen(f, rate, r):
    out, z = np.zeros_like(f), np.zeros(3)
    lim = np.maximum(r.uniform(0.35, 0.6) * f.std(0), 0.05)
    for i, d in enumerate(np.diff(_low(f, 0.03, rate), axis=0, prepend=0 * f[:1])):
        z = z + d - np.abs(d) * z / lim
        out[i] = z
    return f + r.uniform(1, 1.6) * out


def _preisach(f, rate, r):
    """Relays that switch up at one force and down at a lower one."""
    g, out = _low(f, 0.03, rate), np.zeros_like(f)
    for j in range(3):
        s = max(f[:, j].std(), 0.02)
        up = np.quantile(g[:, j], r.uniform(0.1, 0.98, 60))
        down = up - r.uniform(0.3, 1.6, 60) * s
        on = g[0, j] > up
        for i, x in enumerate(g[:, j]):
            on = np.where(x > up, True, np.where(x < down, False, on))
            out[i, j] = on.sum()
        out[:, j] *= 1.2 * s / max(out[:, j].std(), 1)
    return f + out


def _direction(f, rate, r):
    """A guide's friction beside the sensor: against the direction, growing with the load."""
    v = rate * np.gradient(_low(f, 0.15, rate), axis=0)
    return f + r.uniform(0.25, 0.4) * (np.abs(f) + 0.3 * f.std(0)) * np.tanh(v / (0.3 * v.std(0) + 1e-6))


HYSTER = tuple(map(fading, (_boucwen, _preisach, _direction)))

# --- outside the catalogue


def _big(c, r, low=0.35, high=0.9):
    return np.maximum(12 * noise(c.counts), np.minimum(400, r.uniform(low, high) * span(c.counts)))


def _taps(c, r):
    """Somebody taps the table: a shared frequency rings down, each electrode with its own sign."""
    n, w = len(c.counts), r.normal(0, 1, 19)
    f = r.uniform(5, 9)
    y = np.zeros(n)
    for a in r.uniform(0.05, 0.95, 7) * n:
        t = (np.arange(n) - a) / c.rate
        y += (t >= 0) * np.exp(-np.maximum(t, 0) / 0.35) * np.sin(2 * np.pi * f * t)
    c.counts = c.counts + _big(c, r) * y[:, None] * w
    return range(19)


def _halves(c, r):
    """The finger rocks: one half of the electrodes against the other, every few seconds."""
    n = len(c.counts)
    y = np.sin(2 * np.pi * np.arange(n) / c.rate / r.uniform(0.8, 2.5) + 0.7 * np.sin(np.arange(n) / c.rate))
    c.counts = c.counts + _big(c, r, 0.3, 0.6) * y[:, None] * np.where(np.arange(19) < 9, 1, -1) * r.uniform(
        0.6, 1, 19
    )
    return range(19)


def _bit(c, r):
    """One data line of the bus is stuck low, in a middle part: that bit reads 0 in all words."""
    a, b = window(len(c.counts), r, 0.4, 0.6)
    bit = int(2 ** np.ceil(np.log2(6 * np.median(noise(c.counts)))))
    x = np.rint(c.counts).astype(int)
    x[a:b] &= ~bit
    c.counts = x.astype(float)
    return range(19)


def _group(c, r):
    """Six electrodes switch between two states together, up or down, dozens of times."""
    n, who = len(c.counts), r.permutation(19)[:6]
    edges = np.cumsum(r.exponential(0.02 * n, 200) + 3)
    y = (np.searchsorted(edges, np.arange(n)) % 2).astype(float)
    c.counts[:, who] += (
        y[:, None] * (_big(c, r, 0.25, 0.5) * r.choice([-1, 1], 19) * r.uniform(0.7, 1.3, 19))[who]
    )
    return who


def _backwards(c, r):
    """A part of the file is written backwards."""
    a, b = window(len(c.counts), r, 0.25, 0.35)
    c.counts[a:b] = c.counts[a:b][::-1].copy()
    return range(19)


def _replay(c, r):
    """A ring buffer is sent again and again: one second of it, in a quarter of the piece."""
    n = len(c.counts)
    a, b = window(n, r, 0.2, 0.3)
    m = int(1.0 * c.rate)
    a = max(a, m)
    c.counts[a:b] = c.counts[a - m + np.arange(b - a) % m]
    return range(19)


def _echo(c, r):
    d, x = int(r.uniform(0.8, 2) * c.rate), c.counts - rest(c.counts)
    y = np.zeros_like(x)
    y[d:] = x[:-d]
    c.counts = c.counts + r.uniform(0.5, 0.8) * y
    return range(19)


def _breathing_gain(c, r):
    t = np.arange(len(c.counts)) / c.rate
    x0 = rest(c.counts)
    c.counts = x0 + (c.counts - x0) * (1 + 0.5 * np.sin(2 * np.pi * t * r.uniform(0.4, 1.2)))[:, None]
    return range(19)


EFFECTS = {  # name: (forms, bases, rank of application)
    "warmup": (WARMUP, "any", 0),
    "fluidloss": (FLUID, "any", 0),
    "thermal": (THERMAL, "tdc", 0),
    "gain": (GAIN, "loaded", 1),
    "flip": (FLIP, "loaded", 1),
    "crosstalk": (CROSS, "loaded", 2),
    "swap": (SWAP, "any", 2),
    "count_offset": (OFFSET, "any", 3),
    "drift": (DRIFT, "any", 3),
    "jump": (JUMP, "any", 3),
    "lowpass": (LOWPASS, "noisy", 4),
    "hum": (HUM, "noisy", 5),
    "noise": (NOISE, "any", 5),
    "common_noise": (COMMON, "any", 5),
    "latency": (LATE, "force", 6),
    "relax": (RELAX, "force", 6),
    "hyster": (HYSTER, "force", 6),
    "quantise": (QUANT, "noisy", 7),
    "saturate": (SATURATE, "loaded", 7),
    "stuck": (STUCK, "noisy", 8),
    "spikes": (SPIKES, "any", 8),
    "dither": (DITHER, "noisy", 9),
    "freeze": (FREEZE, "noisy", 9),
    "lost": (LOST, "loaded", 10),
    "outside": ((_taps, _halves, _bit, _group, _taps, _halves, _group, _bit), "any", 5),
    "outside_loaded": ((_backwards, _replay, _echo, _breathing_gain), "loaded", 5),
}
CAN = {
    "any": ["press", "grip", "still", "slide", "touch", "press with force", "scraped", "grip"],
    "noisy": ["still", "press", "press with force"],
    "loaded": ["press", "press with force"],
    "force": ["press with force"],
    "tdc": ["grip"],
}


# --- base signals


def _read(path):
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt") as file:
        return np.loadtxt(file)


def bases(folder):
    """Both pressed sensors and the unloaded one, in short (17 to 27 s) and long (155 to 175 s) pieces; the
    other trials of the gripper than the second author's, both fingers; the other eight slides; a part of the
    touch; both scraping fingers in shorter parts, as written (300 rows/s) or one row of three."""
    d = pathlib.Path(folder)
    pressed = [
        (_read(d / "epfl_flat_press/SynImpF1.txt"), _read(d / "epfl_flat_press/ForceData.txt")),
        (_read(d / "epfl_f2/SynImpF2.txt.gz"), _read(d / "epfl_f2/ForceData.txt.gz")),
    ]
    idle = _read(d / "epfl_flat_press/SynImpF2.txt")
    trials = [loadmat(p) for p in sorted((d / "phac_hold").glob("*.mat"))[1::2]]
    with gzip.open(d / "btd/btsp_touch.btd.gz", "rt") as file:
        log = np.array([x.split() for x in file.read().split("Begin File")[1].strip().splitlines()])
    ids, values = log[:, 3].astype(int), log[:, 8].astype(float)
    columns = [values[ids == k] for k in range(17, 36)]
    touched = np.stack([x[: min(map(len, columns))] for x in columns], axis=1)
    slid = [
        np.loadtxt(d / f"slides_20/mat{m}_{i}_bio.csv.gz", delimiter=",", skiprows=1, usecols=range(26, 45))
        for m in (7, 12, 15, 20)
        for i in (1, 2)
    ]
    hand = [_read(d / f"scraping/sense_R_{s}.txt.gz") for s in ("RF", "LF")]

    def cut(r, m, *arrays):
        a = int(r.integers(len(arrays[0]) - m + 1))
        return [x[a : a + m].astype(float).copy() for x in arrays]

    def seconds(r):
        return int(117 * (r.uniform(17, 27) if r.random() < 0.5 else r.uniform(155, 175)))

    def press(force):
        def of(r):
            while True:
                x, f = cut(r, seconds(r), *pressed[r.integers(2)])
                if (span(x) > 150).sum() >= 10:
                    return Case("press", x, 117.0, f if force else None, None, True)

        return of

    def grip(r):
        t, f = trials[r.integers(len(trials))], f"F{r.integers(2)}"
        x, tdc = cut(r, int(r.integers(480, 690)), t[f"{f}Electrodes"].T, t[f"{f}tdc"].ravel())
        return Case("grip", x, 100.0, None, tdc)

    def slide(r):
        (x,) = cut(r, int(r.integers(380, 690)), slid[r.integers(8)])
        return Case("slide", np.rint(r.uniform(1700, 3300, 19)) - x * r.choice([1, 1, 1, -1], 19), 100.0)

    def scraped(r):
        (x,) = cut(r, int(r.integers(820, 1110)), hand[r.integers(2)])
        level = np.rint(r.uniform(1800, 3000, 19)) - np.rint(x.mean(0))
        if r.random() < 0.5:
            return Case("scraped", level + x, 300.0)
        return Case("scrape", level + x[1::3], 100.0)

    return {
        "press": press(False),
        "press with force": press(True),
        "still": lambda r: Case("still", *cut(r, seconds(r), idle), 117.0),
        "grip": grip,
        "touch": lambda r: Case("touch", *cut(r, int(r.integers(700, 1300)), touched), 100.0),
        "slide": slide,
        "scraped": scraped,
    }


APART = [{"warmup", "fluidloss", "thermal", "count_offset"}, {"freeze", "dither", "lost", "lowpass"}]
APART += [
    {"gain", "flip"},
    {"swap", "gain"},
    {"swap", "flip"},
    {"swap", "crosstalk"},
    {"common_noise", "hum"},
]
APART += [{"lowpass", "hum"}, {"lowpass", "common_noise"}, {"thermal", "lowpass"}, {"thermal", "hum"}]
APART += [{"thermal", x} for x, (_, on, _) in EFFECTS.items() if on not in ("any", "tdc")]
NULLS = {"press": 6, "press with force": 5, "still": 6, "grip": 6, "touch": 2, "slide": 5, "scraped": 2}


def plan(rounds=1):
    """[(base, effects, number)], in random order: 32 without effect, 52 of one, 12 pairs, 14 outside; in
    every further round the same kinds in other draws and forms."""
    r = np.random.default_rng(zlib.crc32(SEED))
    out = [(b, (), i) for b, m in NULLS.items() for i in range(m)]
    for name, (_, on, _) in EFFECTS.items():
        many = {"outside": 10, "outside_loaded": 4}.get(name, 3 if on in ("force", "tdc") else 2)
        turn = int(r.integers(8))
        for i in range(many):
            out.append((CAN[on][(turn + i) % len(CAN[on])], (name,), i + (turn if many == 2 else 0)))
    free = [e for e, (_, on, _) in EFFECTS.items() if on not in ("force",) and not e.startswith("outside")]
    names = [e for e in free if e != "thermal"]  # 20, each once, and four a second time
    while True:
        deck = [*r.permutation(names), *r.permutation(names)[:4]]
        pairs = [tuple(sorted(map(str, deck[2 * i : 2 * i + 2]))) for i in range(12)]
        if (
            all(len(set(p)) == 2 and not any(set(p) <= a for a in APART) for p in pairs)
            and len(set(pairs)) == 12
        ):
            break
    for i, p in enumerate(pairs):
        can = min((CAN[EFFECTS[e][1]] for e in p), key=len)
        if {"loaded", "noisy"} & {EFFECTS[e][1] for e in p} == {"loaded", "noisy"}:
            can = CAN["loaded"]
        out.append((can[int(r.integers(len(can)))], p, i))
    out = [out[i] for i in r.permutation(len(out))]
    return [(b, e, i + 25 * k) for k in range(rounds) for b, e, i in out]


def make(have, base, effects, number):
    """The case and its counts without the effects."""
    r = np.random.default_rng(zlib.crc32(SEED + repr((base, effects, number)).encode()))
    c = have[base](r)
    c.counts = np.clip(np.rint(c.counts), 0, 4095)
    clean = c.counts.copy()
    for name in sorted(effects, key=lambda e: EFFECTS[e][2]):
        forms, _, rank = EFFECTS[name]
        if rank >= 7:
            c.counts = np.clip(np.rint(c.counts), 0, 4095)
        form = number % len(forms) if len(effects) < 2 else int(r.integers(len(forms)))
        channels = forms[form](c, r)
        c.channels.append([int(k) for k in channels])
        c.truth.append(name)
        c.forms.append(form)
    c.counts = np.clip(np.rint(c.counts), 0, 4095)
    return c, clean
