"""Constants of one real sensor from a recording: rest counts, noise, warm-up (`sensor.presets.Sensor`)."""

import numpy as np

from ..sensor.channels import counts_from_log_impedance, log_impedance
from ..sensor.presets import PER_DEGREE

_TIMES = np.geomspace(0.1, 1.1, 60)  # candidate time constants of warm-up, over the recording's length
_LIGHT = 0.08  # fraction of rows of a loaded sensor that are used: those with least force


def noise(counts: np.ndarray) -> np.ndarray:
    """RMS (k,) of white noise [counts] in counts (n, k), without rounding noise."""
    second = np.diff(counts, n=2, axis=0)
    quiet = np.abs(second) <= 6 * np.maximum(np.median(np.abs(second), axis=0), 1)
    square = np.array([np.mean(d[q] ** 2) for d, q in zip(second.T, quiet.T, strict=True)]) / 6
    return np.sqrt(np.maximum(square - 1 / 12, 0))


def rest_of(counts: np.ndarray, rate: float, force: np.ndarray | None) -> dict:
    """Estimates constants of a sensor.

    Args:
      counts: (n, nelectrode) of the electrodes, raw. rate: rows per second [Hz]. force: (n, 3) on them [N],
        or None: no contact.

    Returns:
      rest: (nelectrode,) counts without force at the start; loaded: whether it was always touched; noise:
        (nelectrode,) RMS [counts]; warm_up [C] at 7.1 % per degree, warm_time [s] of its exponential, and
        warm_share (nelectrode,), the fraction of it for each electrode.
    """
    time, log_z = np.arange(len(counts)) / rate, log_impedance(counts)
    load, light = np.zeros((len(counts), 0)), np.ones(len(counts), bool)
    if force is not None:
        load, normal = np.column_stack([force, force[:, 2] ** 2]), np.abs(force[:, 2])
        light = normal <= np.quantile(normal, _LIGHT)  # often all of it is 0
    best = None
    for tau in _TIMES * time[-1]:
        design = np.column_stack([np.ones(len(time)), 1 - np.exp(-time / tau), load])[light]
        answer = np.linalg.lstsq(design, log_z[light], rcond=None)[0]
        error = np.mean((log_z[light] - design @ answer) ** 2)
        if best is None or error < best[0]:
            best = error, tau, answer
    _, tau, answer = best
    # common size of the warm-up; RMS if electrodes have different signs
    whole = float(answer[1].mean()) or 1e-9
    if abs(whole) < 0.1 * np.abs(answer[1]).max():
        whole = float(np.copysign(np.abs(answer[1]).max(), whole))
    return {
        "rest": counts_from_log_impedance(answer[0]),
        "loaded": force is not None,
        "noise": noise(counts),
        "warm_up": float(-whole / PER_DEGREE),
        "warm_time": float(tau),
        "warm_share": answer[1] / whole,
    }
