"""Effects between force and electrodes: latency, low-pass, relaxation after a load change, hysteresis.

Each says what a force sensor shows of the force that the electrodes follow (`unsee`) and the other way round
(`see`). Which of them acts is decided for all together in `recordings/load_search.py`."""

import abc
from typing import Any

import numpy as np
from scipy.signal import lfilter

from .effect import Parameter, RecordedEffect

__all__ = [
    "ForceEffect",
    "Hysteresis",
    "Latency",
    "LoadLowPass",
    "Relaxation",
    "force_features",
    "lagged",
    "play",
    "shift",
]


class ForceEffect(RecordedEffect):
    """Subclasses write `see(force, rate, theta)`, the force that the electrodes follow, its inverse `unsee`,
    and what is tried.

    Attributes:
      arrow: whether the effect has to beat itself run backwards in time: what has no memory looks alike from
        both ends.
      linear: parameter that `unsee` is linear in, or None.
    """

    unit = "N"
    arrow = True
    linear = None

    def find(self, session: Any) -> list:
        """Nothing alone: effects between force and electrodes are compared with each other
        (`load_search.find_between`)."""
        return []

    @abc.abstractmethod
    def tried(self, rate: float, seconds: float) -> list:
        """Parameters (dicts) to try on a record of `seconds` at `rate` [Hz]."""

    @abc.abstractmethod
    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        """(n, m) force that the electrodes follow [N]."""

    @abc.abstractmethod
    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        """(n, m) force that a sensor would have said from what the electrodes followed [N]: the inverse of
        `see`."""

    def note(self, theta: dict) -> str:
        """What was seen, in words."""
        return ""


class Latency(ForceEffect):
    id, name, stage = "latency", "latency between force and electrodes", "A"
    physics = "the electrodes are logged later (positive) or earlier than the force: V(t - d)"
    params = {"delay": Parameter("s", -0.3, 0.6, "0-100 ms; buses, buffers and drivers more")}
    confusable = {"lowpass": "a tap: delay shifts, a filter rounds", "relax": "longer holds"}
    arrow = False  # run backwards it is a delay of the other sign, which is tried as well

    def tried(self, rate: float, seconds: float) -> list:
        fine = max(1, round(0.01 * rate))
        near, far = np.arange(-5, 11) * fine, np.unique(np.geomspace(12 * fine, 0.6 * rate, 8).astype(int))
        rows = np.unique(np.concatenate([-far[far < 0.3 * rate], near, far]))
        return [{"delay": d / rate, "start": 0.0, "end": np.inf} for d in rows if d]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return self._moved(force, rate, theta, 1.0)

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return self._moved(force, rate, theta, -1.0)

    @staticmethod
    def _moved(force, rate, theta, sign):
        late = shift(force, sign * theta["delay"] * rate)
        if theta["start"] == 0 and not np.isfinite(theta["end"]):
            return late
        time = np.arange(len(force)) / rate
        on = ((time >= theta["start"]) & (time < theta["end"]))[:, None]
        return np.where(on, late, shift(force, sign * theta.get("otherwise", 0.0) * rate))

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        rate = (len(time) - 1) / (time[-1] - time[0])
        return shift(counts, theta["delay"] * rate)


class LoadLowPass(ForceEffect):
    id, name, stage = "lowpass", "low-pass filter", "A"
    physics = "tau dV/dt + V = U: electrodes follow force rounded"
    params = {"tau": Parameter("s", 0.002, 1.0, "electronics 3-150 ms")}
    confusable = {"latency": "a tap: delay shifts, a filter rounds", "relax": "longer holds"}

    def tried(self, rate: float, seconds: float) -> list:
        return [{"tau": t} for t in np.geomspace(0.007, 0.4, 12) if t > 0.4 / rate]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return lagged(force, theta["tau"], rate)

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        # F = V + tau dV/dt; the derivative over the filter's own time, so that it does not magnify the
        # electrodes' noise
        return force + shift(force, -0.5 * theta["tau"] * rate) - shift(force, 0.5 * theta["tau"] * rate)

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return lagged(counts, theta["tau"], (len(time) - 1) / (time[-1] - time[0]))


class Relaxation(ForceEffect):
    id, name, stage = "relax", "relaxation after load changes", "C"
    physics = (
        "force answers a change of deformation at once and relaxes towards a part of it: "
        "G(t) = Ginf + G1 exp(-t / tau)"
    )
    params = {
        "fraction": Parameter("1", -0.6, 1.0, "0.02-0.3 of silicone; with the liquid's flow more"),
        "tau": Parameter("s", 0.1, 60, "0.5 s and 4-7 s (PDC)"),
    }
    confusable = {
        "hyster": "hold 0, 1 and 30 s at the same depth",
        "lowpass": "longer holds",
        "latency": "a tap",
    }
    linear = "fraction"

    def tried(self, rate: float, seconds: float) -> list:
        fractions = (-0.25, -0.1, 0.08, 0.16, 0.3, 0.5)
        return [
            {"fraction": g, "tau": t}
            for t in (0.3, 0.5, 0.9, 1.6, 2.8, 5, 9, 16)
            if t < seconds / 8
            for g in fractions
        ]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        g, tau = theta["fraction"], theta["tau"]
        return force - g / (1 + g) * (force - lagged(force, tau * (1 + g), rate))

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return force + theta["fraction"] * (force - lagged(force, theta["tau"], rate))

    def note(self, theta: dict) -> str:
        return (
            f"force {'overshoots' if theta['fraction'] > 0 else 'lags'} what the electrodes say and "
            "comes back"
        )


class Hysteresis(ForceEffect):
    id, name, stage = "hyster", "rate-independent hysteresis", "C"
    physics = (
        "loading and unloading differ at equal electrodes, whatever the speed (Dahl, Prandtl-Ishlinskii)"
    )
    params = {
        "fraction": Parameter("1", -1, 1, "loops of soft tactile sensors: 13-24 % of full scale"),
        "width": Parameter("N", 0.01, 5, "the record"),
    }
    confusable = {"relax": "hold 0, 1 and 30 s at the same depth", "latency": "two speeds a decade apart"}

    def tried(self, rate: float, seconds: float) -> list:
        # widths in standard deviations; the fraction is fitted
        return [{"share": share} for share in (0.15, 0.3, 0.6, 1.2)]

    def see(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return force - theta["fraction"] * play(lagged(force, 3 / rate, rate), theta["width"])

    def unsee(self, force: np.ndarray, rate: float, theta: dict) -> np.ndarray:
        return force + theta["fraction"] * play(lagged(force, 3 / rate, rate), theta["width"])

    def note(self, theta: dict) -> str:
        return "the loop between loading and unloading does not depend on speed"


def shift(x: np.ndarray, delay: float) -> np.ndarray:
    """x (n, m) delayed by a fractional number of rows; the ends hold."""
    n = len(x)
    at = np.clip(np.arange(n) - delay, 0, n - 1)
    low = np.minimum(at.astype(int), n - 2)
    part = (at - low)[:, None]
    return x[low] * (1 - part) + x[low + 1] * part


def lagged(x: np.ndarray, tau: float, rate: float) -> np.ndarray:
    """First-order low-pass of (n, m) with time constant tau [s], at rest before the first row."""
    a = np.exp(-1 / max(tau * rate, 1e-9))
    return lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]


def play(x: np.ndarray, width: np.ndarray) -> np.ndarray:
    """(n, m) elastic part of a play operator: follows x up to +-width (m,), then slips."""
    out = np.empty_like(x)
    z = np.zeros(x.shape[1])
    previous = x[0]
    for i, now in enumerate(x):
        z = np.clip(z + now - previous, -width, width)
        out[i], previous = z, now
    return out


def force_features(force: np.ndarray) -> np.ndarray:
    """(n, 16) of a force: components, place-like ratios, squares and products."""
    normal = np.where(np.abs(force[:, 2]) < 0.2, 0.2 * np.where(force[:, 2] < 0, -1, 1), force[:, 2])
    x = np.concatenate([force, np.clip(force[:, :2] / normal[:, None], -3, 3)], axis=1)
    i, j = np.triu_indices(3)
    return np.concatenate(
        [np.ones((len(x), 1)), x, x[:, i] * x[:, j], x[:, 3:] * x[:, 2:3], x[:, 3:] ** 2], axis=1
    )
