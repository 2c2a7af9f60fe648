"""Synthetic counts of a BioTac that nothing touches, that is pressed, and that is touched now and then."""

import numpy as np

from biotac_mj.sensor.channels import electrode_noise

RATE, BUS = 100.0, 100.0
LOGGER = 118.0  # [Hz] of one that is faster than the bus


def unloaded(seed=0, seconds=60):
    rng = np.random.default_rng(seed)
    return np.tile(rng.uniform(2100, 3300, 19), (int(seconds * RATE), 1)), rng


def noisy(counts, rng, size=4.0):
    return np.clip(np.rint(counts + size * rng.standard_normal(counts.shape)), 0, 4095)


def pressed(seed=0, seconds=80):
    """Counts and force of a synthetic hand: three force components and a place, all changing in holds and
    ramps."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    kernel = np.hanning(31) / np.hanning(31).sum()

    def holds(low, high):
        x = np.repeat(rng.uniform(low, high, n // 150 + 2), rng.integers(100, 200, n // 150 + 2))
        return np.convolve(np.resize(x, n + 30), kernel, "valid")[:n]

    f = np.column_stack([holds(-1, 1), holds(-1, 1), holds(-5, -0.5)])
    state = np.column_stack([f, holds(-1, 1), holds(-1, 1)])
    z = (
        rng.uniform(-1, -0.2, 19)
        + 0.1 * state @ rng.standard_normal((5, 19))
        + 0.01 * (state[:, 2:3] * state[:, 3:4]) @ rng.standard_normal((1, 19))
    )
    return 4095 / (1 + np.exp(z)), f + 0.01 * rng.standard_normal(f.shape), rng


def touched(seed=0, seconds=40, rate=BUS):
    """Counts (n, 19), force (n, 3) and a generator: touches of a second at changing places, as noisy as
    a sensor is."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    kernel = np.hanning(41) / np.hanning(41).sum()
    steps = np.repeat(rng.uniform(-1, 1, (n // 120 + 2, 5)), 120, axis=0)[: n + 40]
    state = np.column_stack([np.convolve(x, kernel, "valid") for x in steps.T])
    clean = rng.uniform(2100, 3200, 19) + 120 * state @ rng.standard_normal((5, 19))
    clean = np.clip(clean, 200, 3900)
    counts = np.rint(clean + electrode_noise(clean) * rng.standard_normal(clean.shape))
    force = state[:, :3] * [1.0, 1.0, 4.0] + 0.01 * rng.standard_normal((n, 3))
    return np.clip(counts, 0, 4095), force, rng


def tapped(rows, seed=0, seconds=40):
    """Counts (n, 19), force (n, 3) and a generator: touches at changing places that last some rows, and come
    and go within one."""
    rng = np.random.default_rng(seed)
    state = np.zeros((int(seconds * RATE), 5))
    for begin in range(150, len(state) - 85, 70):
        some = slice(begin + (k := rng.integers(25)), begin + k + rows)
        state[some] = np.r_[rng.uniform(-1, 1, 4), rng.uniform(0.3, 1)]
    clean = rng.uniform(2100, 3200, 19) + 120 * state @ rng.standard_normal((5, 19))
    force = state[:, [0, 1, 4]] * [0.3, 0.3, -3.0] + 0.01 * rng.standard_normal((len(state), 3))
    return np.rint(clean + electrode_noise(clean) * rng.standard_normal(clean.shape)), force, rng


def through_a_bus(counts):
    """As a logger of LOGGER writes what a bus brings a hundred times a second."""
    rows = int(len(counts) * LOGGER / BUS)
    return counts[np.minimum((np.arange(rows) * BUS / LOGGER).astype(int), len(counts) - 1)]


def overflowing(seed, number, band, since):
    """Counts of a pressed sensor, whole and with upper bits lost of the channels that go over a boundary most
    often."""
    counts, _, rng = pressed(seed, 30)
    whole = noisy(counts, rng, 3.0)
    over = np.abs(np.diff(whole[since:] // band, axis=0)).sum(0)
    channels, cut = np.argsort(-over)[:number], whole.copy()
    cut[since:, channels] %= band
    return whole, cut
