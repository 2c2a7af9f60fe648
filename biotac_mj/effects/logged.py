"""Effects of a log: faults of electrodes, converter, bus and logger, and the forms of the sensor's effects in
logs of counts only."""

import abc

import numpy as np

from ..sensor.channels import FULL_SCALE
from .effect import Entry, Param
from .electrodes import Noise
from .sensing import FluidLoss, Saturation, WarmUp

_COUNTS = Param("counts", -FULL_SCALE, FULL_SCALE, "12-bit range")
_TIME = Param("s", 0, 1e6, "the record")
_LOG = frozenset({"log"})


class Logged(Entry):
    """A fault of a log."""

    stage = "A"
    fits, requires = _LOG, frozenset()


class SharedLevel(Entry, abc.ABC):
    """A level common to all electrodes that changes with the session's clock.

    Attributes:
      rises: whether it only raises impedances.
    """

    rises = False

    def pattern(self, slope: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """(c,) relative change of ln Z of each electrode.

        Args:
          slope: (c,) d counts / d ln Z, positive; counts: (c,) at rest.
        """
        return np.ones(len(slope))

    @abc.abstractmethod
    def of_trend(self, time: np.ndarray, y: np.ndarray, slope: np.ndarray, counts: np.ndarray) -> dict:
        """The effect's parameters for a trend, {name: (value, low, high)}; nan if no interval is known.

        Args:
          time: (n,) from start to end [s]. y: (n,) change of the mean ln Z since the start. slope, counts:
            see `pattern`.
        """


class CountOffset(Logged, SharedLevel):
    id, name, detector = "count_offset", "common offset in counts", "supply"
    requires = frozenset({"rest", "change"})
    physics = "reference or supply: adds the same counts to every electrode"
    params = {"change": _COUNTS}
    confusable = {"warmup": "log TDC; load and unload", "count_gain": "rest levels that differ more"}

    def pattern(self, slope: np.ndarray, counts: np.ndarray) -> np.ndarray:
        return 1 / slope

    def of_trend(self, time: np.ndarray, y: np.ndarray, slope: np.ndarray, counts: np.ndarray) -> dict:
        return {"change": (-y[-1] * float(slope.mean()), np.nan, np.nan)}


class CountGain(Logged, SharedLevel):
    id, name, detector = "count_gain", "common gain in counts", "supply"
    requires = frozenset({"rest", "change"})
    physics = "reference or supply: scales every count"
    params = {"change": Param("1", -0.9, 0.9, "supplies")}
    confusable = {"count_offset": "rest levels that differ more"}

    def pattern(self, slope: np.ndarray, counts: np.ndarray) -> np.ndarray:
        return counts / slope

    def of_trend(self, time: np.ndarray, y: np.ndarray, slope: np.ndarray, counts: np.ndarray) -> dict:
        return {"change": (-y[-1] * float((slope / counts).mean()), np.nan, np.nan)}


class Level(Logged):
    id, name = "drift", "drift or jump of an electrode"
    drifts, requires = True, frozenset({"time"})
    physics = "an offset of one channel's amplifier or contact"
    params = {"change": _COUNTS}
    confusable = {
        "gain": "load and unload",
        "warmup": "one electrode or all",
        "crosstalk": "press next to the electrode that couples in",
    }


class Flip(Logged):
    id, name = "flip", "sign of an electrode reversed"
    requires = frozenset({"sign", "change"})
    physics = "an electrode responds to the load with the opposite sign"
    params = {"factor": Param("1", -5, -0.05, "polarity")}
    confusable = {"gain": "press next to the electrode"}


class ExchangeInLog(Logged):
    id, name = "swap", "exchanged channels"
    wiring, requires = True, frozenset({"change"})
    physics = "electrodes carry each other's signal: cable or channel order"
    params = {"onset": _TIME}
    confusable = {"gain": "an exchange changes two channels at once"}


class Stuck(Logged):
    id, name = "stuck", "stuck channel"
    silent = True
    physics = "an electrode repeats one count although its noise would change it"
    params = {"value": _COUNTS}
    confusable = {"saturate": "press harder: a stuck channel does not leave its value"}


class LateForce(Logged):
    id, name = "force_late", "late force log"
    requires = frozenset({"force"})
    physics = "the force's rows are of an earlier moment than the electrodes' beside them: of clock or logger"
    params = {"delay": Param("s", 0.0, 0.5, "clocks and loggers")}


class Freeze(Logged):
    id, name = "freeze", "held rows"
    physics = "rows repeat, or only noise follows: bus or logger"
    params = {"seconds": Param("s", 0, 1e4, "longer than any bus period")}
    confusable = {"stuck": "one channel or all", "lowpass": "a tap: a filter has no steps"}


class LostRows(Logged):
    id, name = "lost_rows", "lost rows"
    physics = "the record jumps: rows were dropped"
    params = {"seconds": Param("s", 0, 1e4, "what the load did meanwhile")}
    confusable = {"freeze": "the clock of the logger"}


class SaturationInLog(Logged):
    id, name, physics = Saturation.id, Saturation.name, Saturation.physics
    requires = frozenset({"time", "load"})
    params = {"level": _COUNTS}
    confusable = Saturation.confusable | {
        "stuck": "a clipped channel leaves the limit when the load decreases",
        "flip": "press less, below the limit",
    }


class Quantise(Logged):
    id, name = "quantise", "coarse quantisation"
    physics = "values are multiples of more than one count"
    params = {"step": Param("counts", 2, 512, "3 to 11 of 12 bits", start=1.0)}
    confusable = {"stuck": "a coarse channel takes several values"}


class Spikes(Logged):
    id, name = "spikes", "spikes or dropouts of single samples"
    physics = "a few samples leave the signal and return at once"
    params = {"rate": Param("1/min", 0, 6000, "up to every tenth sample")}
    confusable = {"noise": "noise is in every sample"}


class Hum(Logged):
    id, name = "hum", "mains hum or another periodic disturbance"
    in_noise = True
    physics = "A sin(2 pi f t): mains, its alias, or a machine"
    params = {
        "amplitude": Param("counts", 0.3, 500, "1-10 counts"),
        "frequency": Param("Hz", 0.2, 2000, "half the rate"),
    }
    confusable = {"noise": "noise has no line"}


class NoiseInLog(Logged):
    id, name, physics, is_noise = Noise.id, Noise.name, Noise.physics, True
    params = {"size": Param("counts", 0, 500, "RMS beyond the law of noise", 10.0)}
    confusable = Noise.confusable | {"gain": "press next to the electrode: a gain makes touches larger, too"}


class CommonNoise(Logged):
    id, name = "common_noise", "noise common to all channels"
    requires = frozenset({"protocol"})
    physics = "one noise is added to every channel: reference, supply"
    params = {"correlation": Param("1", 0.05, 1, "0.001 in a real sensor")}
    confusable = {"crosstalk": "cross-talk falls off with distance"}


_LEVELS = {
    "count_offset": "load and unload: an offset is the same in counts",
    "count_gain": "rest levels that differ more",
}


class WarmUpInLog(WarmUp, SharedLevel):
    fits, requires, detector, drifts = _LOG, frozenset({"time"}), "shared", True
    params = {"a": Param("ln Z", -1.5, 1.5, WarmUp.params["a"].source), "tau": Param("s", 1, 1e5, "minutes")}
    confusable = WarmUp.confusable | _LEVELS

    def of_trend(self, time: np.ndarray, y: np.ndarray, slope: np.ndarray, counts: np.ndarray) -> dict:
        """a, tau of the a (1 - exp(-t / tau)) closest to the trend, with an a that a sensor can have. A
        straight line has no end: of all that are nearly as close it is the one with the least a; the interval
        has those that are less close."""
        bounds, fits = self.params["tau"], []
        for tau in np.unique(np.clip(np.geomspace(0.05, 20, 240) * time[-1], bounds.low, bounds.high)):
            basis = np.column_stack([1 - np.exp(-time / tau), np.ones(len(time))])
            w, *_ = np.linalg.lstsq(basis, y, rcond=None)
            fits.append((float(((y - basis @ w) ** 2).sum()), tau, w[0]))
        fits = [f for f in fits if self.params["a"].low <= f[2] <= self.params["a"].high] or fits
        off = 0.5 * min(fits)[0] + 1e-4 * (y**2).sum()
        near, nearly = ([f for f in fits if f[0] <= min(fits)[0] + part * off] for part in (1.0, 0.5))
        least = min(nearly, key=lambda f: abs(f[2]))
        return {
            name: (least[i], min(f[i] for f in near), max(f[i] for f in near))
            for name, i in (("a", 2), ("tau", 1))
        }


class FluidLossInLog(FluidLoss, SharedLevel):
    fits, requires, detector, drifts = _LOG, frozenset({"sign", "time"}), "loss", True
    rises = True
    params = FluidLoss.params | {
        "rate": Param("1/h", 0.0, 60.0, "0-15 % a day from permeability; a leak empties it in a minute", 0.2)
    }
    confusable = FluidLoss.confusable | _LEVELS

    def of_trend(self, time: np.ndarray, y: np.ndarray, slope: np.ndarray, counts: np.ndarray) -> dict:
        lost = 1 - np.exp(-y[-1] * np.array([1.0, 0.9, 1.1]))
        return {"rate": tuple(3600 / time[-1] * lost)}


LOGGED = (
    FluidLossInLog(),
    WarmUpInLog(),
    CountOffset(),
    CountGain(),
    Level(),
    Flip(),
    ExchangeInLog(),
    Stuck(),
    LateForce(),
    Freeze(),
    LostRows(),
    SaturationInLog(),
    Quantise(),
    Spikes(),
    Hum(),
    NoiseInLog(),
    CommonNoise(),
)
SHARED = tuple(effect for effect in LOGGED if isinstance(effect, SharedLevel))
