"""Plain recordings with a hidden effect: base signals and effects, in numpy alone.

Base signals are synthetic (unloaded or pressed by a simulated hand) and, where
`../shared/data/epfl_flat_press` exists, pieces of real recordings of 40 s or more. Nothing here shares code,
or the form of a formula, with the effects that are fitted."""

import functools
import pathlib

import numpy as np

__all__ = ["ALSO", "EFFECTS", "NATURAL", "OUTSIDE", "SEEDS", "bases", "hash_of", "hide", "make_case"]

REAL = pathlib.Path(__file__).parents[1] / "../shared/data/epfl_flat_press"
SEEDS = {
    "development": 0,
    "practice": 100_000,
    "blind": 900_000,
    "second blind": 1_700_000,
    "third blind": 2_600_000,
}
NATURAL = {"loaded, real": {"warmup", "lowpass", "latency", "relax", "hyster"}, "unloaded, real": {"warmup"}}
PLACES = np.array(
    [
        [-14.5, 71],
        [-9.6, 44],
        [-6.1, 44],
        [-4.3, 71],
        [-1.8, 44],
        [1.1, 71],
        [-17, 0],
        [-15.3, 30],
        [-15.3, -30],
        [-13.6, 0],
        [-14.5, -71],
        [-9.6, -44],
        [-6.1, -44],
        [-4.3, -71],
        [-1.8, -44],
        [1.1, -71],
        [-9.5, 0],
        [-2.5, 0],
        [1.3, 0],
    ]
)
XY = np.column_stack([PLACES[:, 0], 5.3 * np.radians(PLACES[:, 1])])  # unrolled [mm]


# --- base signals  ---


def unloaded(rng, rate, seconds):
    """Counts (n, 19) before noise and rounding, no force."""
    rest = rng.uniform(2000, 3350, 19)
    return np.tile(rest, (int(rate * seconds), 1)), None


def hand(rng, rate, seconds):
    """Counts and force of a finger pressed by hand: holds with ramps between, the place of the contact
    wanders."""
    n = int(rate * seconds)
    t = np.arange(n) / rate

    def holds(low, high, period):
        knots, values = [0.0], [rng.uniform(low, high)]
        while knots[-1] < seconds:
            stay, move = rng.uniform(0.3, 1.7) * period, rng.uniform(0.1, 0.6)
            last = values[-1]
            now = rng.uniform(low, high)
            knots += [knots[-1] + stay, knots[-1] + stay + move]
            values += [last, now]
        x = np.interp(t, knots, values)
        width = max(3, int(0.08 * rate))
        return np.convolve(
            np.pad(x, width, mode="edge"),
            np.hanning(2 * width + 1) / np.hanning(2 * width + 1).sum(),
            "valid",
        )[:n]

    normal, shear_x, shear_y = holds(0.4, 6, 2.5), holds(-1.2, 1.2, 3), holds(-1.5, 1.5, 3)
    px, py = holds(-14, -3, 6) + 0.3 * shear_y, holds(-2, 2, 6) + 0.3 * shear_x
    squared = (XY[None, :, 0] - px[:, None]) ** 2 + (XY[None, :, 1] - py[:, None]) ** 2
    width = 2.2 + 0.35 * np.sqrt(normal)[:, None]
    press = 0.55 * normal[:, None] ** 0.8 * np.exp(-squared / (2 * width**2))
    bulge = 0.05 * normal[:, None] ** 0.7 * (1 - np.exp(-squared / 60))
    tilt = 0.02 * (shear_x[:, None] * XY[None, :, 1] + shear_y[:, None] * XY[None, :, 0] * 0.3)
    z = rng.uniform(-1.2, -0.1, 19) + press - bulge + tilt
    force = np.column_stack([shear_x, shear_y, -normal]) + 0.01 * rng.standard_normal((n, 3))
    return 4095 / (1 + np.exp(z)), force


def real(rng, name):
    """A piece of a recording: counts (n, 19) and, of the pressed sensor, force."""
    e, force = np.loadtxt(REAL / name), None
    if name == "SynImpF1.txt":
        force = np.loadtxt(REAL / "ForceData.txt")
    length = int(rng.uniform(40 * 117, len(e)))
    start = rng.integers(len(e) - length + 1)
    return e[start : start + length], None if force is None else force[start : start + length]


def bases():
    """Names of the base signals that can be made here."""
    names = ["unloaded, synthetic", "loaded, synthetic"]
    return names + (["unloaded, real", "loaded, real"] if REAL.exists() else [])


# --- hidden effects: counts (n, 19) float before noise, force, rng, rate -> the same, plus the channels
# concerned


def _onset(rng, n):
    return int(rng.choice([0, rng.uniform(0.15, 0.55)]) * n)


def _scale_impedance(e, factor):
    z = (4095 / np.clip(e, 1, 4094) - 1) * factor
    return 4095 / (z + 1)


def warmup(e, force, rng, rate):
    n = len(e)
    start, tau = _onset(rng, n), rng.uniform(0.2, 1.0) * n
    rise = 1 - np.exp(-np.maximum(np.arange(n) - start, 0) / tau)
    return _scale_impedance(e, np.exp(-rng.uniform(0.08, 0.3) * rise)[:, None]), force, range(19)


def offset(e, force, rng, rate):
    step = (np.arange(len(e)) > rng.uniform(0.2, 0.5) * len(e)).astype(float)
    return e + rng.choice([-1, 1]) * rng.uniform(15, 60) * step[:, None], force, range(19)


def drift(e, force, rng, rate):
    n, k = len(e), rng.integers(19)
    start = _onset(rng, n)
    ramp = np.maximum(np.arange(n) - start, 0) / n
    out = e.copy()
    out[:, k] += rng.choice([-1, 1]) * rng.uniform(60, 250) * ramp
    return out, force, [k]


def jump(e, force, rng, rate):
    n, k = len(e), rng.integers(19)
    out = e.copy()
    out[int(rng.uniform(0.2, 0.55) * n) :, k] += rng.choice([-1, 1]) * rng.uniform(40, 150)
    return out, force, [k]


def gain(e, force, rng, rate):
    n, k = len(e), int(np.argsort(-e.std(0))[rng.integers(10)])
    out, start = e.copy(), int(rng.uniform(0.2, 0.55) * n)
    middle = np.median(e[:, k])
    out[start:, k] = middle + (e[start:, k] - middle) * (1 + rng.choice([-1, 1]) * rng.uniform(0.25, 0.5))
    return out, force, [k]


def swap(e, force, rng, rate):
    a, b = rng.choice(19, 2, replace=False)
    out, start = e.copy(), int(rng.uniform(0.2, 0.6) * len(e))
    out[start:, a], out[start:, b] = e[start:, b], e[start:, a]
    return out, force, [a, b]


def lowpass(e, force, rng, rate):
    tau = rng.uniform(0.02, 0.08)
    a = 1 - np.exp(-1 / (tau * rate))
    out = e.copy()
    for i in range(1, len(e)):
        out[i] = out[i - 1] + a * (e[i] - out[i - 1])
    return out, force, range(19)


def crosstalk(e, force, rng, rate):
    d = np.sqrt(((XY[:, None] - XY[None]) ** 2).sum(2))
    near = (d < 6.5) & (d > 0) if rng.random() < 0.5 else np.abs(np.subtract.outer(range(19), range(19))) == 1
    m = np.eye(19) + rng.uniform(0.06, 0.2) * near / max(1, near.sum(1).mean() / 2)
    return e.mean(0) + (e - e.mean(0)) @ m.T, force, range(19)


def hum(e, force, rng, rate):
    f = rng.uniform(0.08, 0.46) * rate
    t = np.arange(len(e)) / rate
    on = (t > rng.choice([0, 0.4]) * t[-1]) & (t <= 1.0 * t[-1])
    return (
        e
        + rng.uniform(3, 12)
        * (on * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)))[:, None]
        * rng.uniform(0.6, 1.2, 19),
        force,
        range(19),
    )


def stuck(e, force, rng, rate):
    k, n = rng.integers(19), len(e)
    out, a = e.copy(), int(rng.uniform(0.1, 0.4) * n)
    out[a : a + int(rng.uniform(0.08, 0.25) * n), k] = np.rint(e[a, k])
    return out, force, [k]


def saturate(e, force, rng, rate):
    k = int(np.argsort(-e.std(0))[rng.integers(8)])
    out = e.copy()
    if rng.random() < 0.5:
        out[:, k] = np.minimum(e[:, k], np.quantile(e[:, k], rng.uniform(0.75, 0.95)).round())
    else:
        out[:, k] = np.maximum(e[:, k], np.quantile(e[:, k], rng.uniform(0.05, 0.25)).round())
    return out, force, [k]


def quantise(e, force, rng, rate):
    q = rng.choice([4, 8, 16])
    return q * np.rint(e / q), force, range(19)


def spikes(e, force, rng, rate):
    k, out = rng.integers(19), e.copy()
    rows = rng.choice(len(e) - 20, 40, replace=False) + 10
    out[rows, k] += rng.choice([-1, 1], 40) * rng.uniform(200, 700, 40)
    return out, force, [k]


def noise(e, force, rng, rate):
    k, out = rng.integers(19), e.copy()
    out[:, k] += rng.uniform(20, 40) * rng.standard_normal(len(e))
    return out, force, [k]


def latency(e, force, rng, rate):
    d = int(max(3, rng.uniform(0.05, 0.2) * rate))
    return np.concatenate([np.repeat(e[:1], d, axis=0), e[:-d]]), force, range(19)


def relax(e, force, rng, rate):
    tau, g, state = rng.uniform(0.6, 3), rng.uniform(0.2, 0.4), force[0].copy()
    slow, a = np.empty_like(force), 1 - np.exp(-1 / (tau * rate))
    for i, f in enumerate(force):
        state = state + a * (f - state)
        slow[i] = state
    return e, force + g * (force - slow), range(19)


def hyster(e, force, rng, rate):
    out, width = force.copy(), 0.5 * force.std(0)
    z, half = np.zeros(3), max(2, int(0.1 * rate))
    # of the movement, not of the force sensor's noise: going to and fro by a hundredth of a newton wears a
    # loop off within a second
    kernel = np.hanning(2 * half + 3)[1:-1]
    smooth = np.stack(
        [np.convolve(np.pad(x, half, mode="edge"), kernel / kernel.sum(), "valid") for x in force.T], axis=1
    )
    for i in range(1, len(force)):
        step = smooth[i] - smooth[i - 1]
        z = z + step * (1 - np.sign(step) * z / width)  # Dahl's law, not the play operator that is fitted
        z = np.clip(z, -width, width)
        out[i] += 0.5 * z
    return e, out, range(19)


def wander(e, force, rng, rate):
    """Outside the catalogue: six electrodes swing slowly, each with its own period and phase."""
    t = np.arange(len(e)) / len(e)
    out = e.copy()
    for k in rng.choice(19, 6, replace=False):
        out[:, k] += rng.uniform(15, 40) * np.sin(2 * np.pi * rng.uniform(3, 9) * t + rng.uniform(0, 6))
    return out, force, range(19)


def telegraph(e, force, rng, rate):
    """Outside the catalogue: the common level jumps to and fro at random."""
    flips = np.cumsum(rng.random(len(e)) < 12 / len(e)) % 2
    return e * (1 + 0.012 * flips[:, None]), force, range(19)


# id -> (function, where it is injected: before or after the noise, bases on which it can show)
U, L, B = ("unloaded",), ("loaded",), ("unloaded", "loaded")
EFFECTS = {
    "none": (lambda e, f, rng, rate: (e, f, []), "before", B),
    "warmup": (warmup, "before", B),
    "count_offset": (offset, "before", U),
    "drift": (drift, "before", B),
    "jump": (jump, "before", B),
    "gain": (gain, "before", L),
    "swap": (swap, "after", B),
    "lowpass": (lowpass, "after", B),
    "crosstalk": (crosstalk, "after", B),
    "hum": (hum, "before", B),
    "stuck": (stuck, "after", B),
    "saturate": (saturate, "after", L),
    "quantise": (quantise, "after", B),
    "spikes": (spikes, "after", B),
    "noise": (noise, "before", B),
    "latency": (latency, "before", ("loaded+force",)),
    "relax": (relax, "before", ("loaded+force",)),
    "hyster": (hyster, "before", ("loaded+force",)),
    "wander": (wander, "before", U),
    "telegraph": (telegraph, "before", U),
}
OUTSIDE = {"wander", "telegraph"}
ALSO = {
    "jump": {"drift", "gain"},
    "gain": {"gain", "drift"},
    "count_offset": {"count_offset", "count_gain"},
    "drift": {"drift"},
}


def make_case(effect, base, seed, with_force):
    """electrodes (n, 19) rounded counts, force or None, rate, truth dict."""
    rng = np.random.default_rng(seed)
    rate = float(rng.choice([50, 100, 100, 117, 200])) if "synthetic" in base else 117.0
    seconds = rng.uniform(40, 150)
    if base == "unloaded, synthetic":
        e, force = unloaded(rng, rate, seconds)
    elif base == "loaded, synthetic":
        e, force = hand(rng, rate, seconds)
    else:
        e, force = real(rng, "SynImpF2.txt" if base.startswith("unloaded") else "SynImpF1.txt")
    function, when, _ = EFFECTS[effect]
    synthetic = "synthetic" in base
    level = rng.uniform(0.5, 1.2)

    def add_noise(x):
        # a straight line in counts, not the law of the sensor model
        if not synthetic:
            return x
        spread = level * np.interp(x, [500, 2000, 3400, 4000], [5.5, 6.5, 2.8, 1.0])
        return x + spread * rng.standard_normal(x.shape)

    if when == "after":
        e = np.rint(add_noise(e))
    e, force, channels = function(e, force, rng, rate)
    if when == "before":
        e = add_noise(e)
    e = np.clip(np.rint(e), 0, 4095)
    return (
        e,
        force if with_force else None,
        rate,
        {"effect": effect, "channels": [int(k) for k in channels], "base": base},
    )


def hide(count, seeds, only=None, on=None, null=None):
    """Yields (name, function that makes electrodes, force, rate, truth); null: how many without effect on
    each base, None: count."""
    for effect, (_, _, where) in EFFECTS.items():
        if only and effect not in only:
            continue
        for base in bases():
            if on and base != on:
                continue
            kind = base.split(",")[0]
            for with_force in (False, True):
                label = f"{kind}+force" if with_force else kind
                if with_force and (kind == "unloaded" or not (label in where or kind in where)):
                    continue
                if not with_force and kind not in where:
                    continue
                for i in range(null if effect == "none" and null is not None else count):
                    seed = SEEDS[seeds] + hash_of(effect, base, with_force, i)
                    yield (f"{effect} on {base}{' with force' if with_force else ''} #{i}",
                           functools.partial(make_case, effect, base, seed, with_force))  # fmt: skip


def hash_of(*parts):
    import zlib

    return zlib.crc32(repr(parts).encode()) % 90_000
