"""Effects of a log: faults of electrodes, converter, bus and logger, and the forms of the sensor's effects in
logs of counts only.

Each acts on some electrodes for some time of a Run, so that a fault can be added to a recording."""

import abc
import dataclasses
import typing
from collections.abc import Sequence

import numpy as np

from ..sensor.channels import FULL_SCALE, NELECTRODE, electrode_noise
from .effect import Effect, Param, Run
from .electrodes import Noise
from .sensing import FluidLoss, Saturation, WarmUp

_COUNTS = Param("counts", -FULL_SCALE, FULL_SCALE, "12-bit range")
_TIME = Param("s", 0, 1e6, "the record")
_LOG = frozenset({"log"})
_FAR = 300.0  # [counts] height of a spike


class Logged(Effect):
    """An effect on some electrodes for some time.

    Args:
      channels: affected electrodes (from 0). start, end: [s] of the Run's time.
      rng: for random values; None: the same values every time.
    """

    stage = "A"
    fits, requires = _LOG, frozenset()

    def __init__(
        self,
        channels: Sequence[int] = range(NELECTRODE),
        start: float = 0.0,
        end: float = np.inf,
        rng: np.random.Generator | None = None,
    ):
        self.channels, self.start, self.end = list(channels), start, end
        self.rng = np.random.default_rng(0) if rng is None else rng

    def apply(self, run: Run, theta: dict) -> None:
        """Replaces the counts of its rows and electrodes by `changed`."""
        some = np.ix_((run.time >= self.start) & (run.time <= self.end), self.channels)
        counts = np.array(run.counts, float)
        counts[some] = self.changed(counts[some], run.time[some[0][:, 0]][:, None], run.rest[some[1]], theta)
        run.counts = counts

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        """(n, c) counts with the effect, from counts without.

        Args:
          counts: (n, c). time: (n, 1) [s]. rest: (1, c) counts at rest.
        """
        raise NotImplementedError(f"{self.id} does not implement `changed`")


class Trend(typing.Protocol):
    """A trend: values (n,) at times (n,) [s], and its knots."""

    knots: np.ndarray

    def __call__(self, time: np.ndarray) -> np.ndarray: ...


class SharedLevel(Effect):
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
    def of_trend(self, trend: Trend, change: float, slope: np.ndarray, counts: np.ndarray) -> dict:
        """The effect's parameters for a trend, {name: (value, low, high)}; nan if no interval is known.

        Args:
          trend: of the mean ln Z over time. change: of it from start to end. slope, counts: see `pattern`.
        """


class CountOffset(Logged, SharedLevel):
    id, name, detector = "count_offset", "common offset in counts", "supply"
    requires = frozenset({"rest", "change"})
    physics = "reference or supply: adds the same counts to every electrode"
    params = {"change": _COUNTS}
    confusable = {"warmup": "log TDC; load and unload", "count_gain": "rest levels that differ more"}

    def pattern(self, slope: np.ndarray, counts: np.ndarray) -> np.ndarray:
        return 1 / slope

    def of_trend(self, trend: Trend, change: float, slope: np.ndarray, counts: np.ndarray) -> dict:
        return {"change": (-change * float(slope.mean()), np.nan, np.nan)}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return counts + theta["change"]


class CountGain(Logged, SharedLevel):
    id, name, detector = "count_gain", "common gain in counts", "supply"
    requires = frozenset({"rest", "change"})
    physics = "reference or supply: scales every count"
    params = {"change": Param("1", -0.9, 0.9, "supplies")}
    confusable = {"count_offset": "rest levels that differ more"}

    def pattern(self, slope: np.ndarray, counts: np.ndarray) -> np.ndarray:
        return counts / slope

    def of_trend(self, trend: Trend, change: float, slope: np.ndarray, counts: np.ndarray) -> dict:
        return {"change": (-change * float((slope / counts).mean()), np.nan, np.nan)}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return counts * (1 + theta["change"])


class Level(Logged):
    """A step if it ends where it begins, else a ramp to a constant level."""

    id, name = "drift", "drift or jump of an electrode"
    drifts, requires = True, frozenset({"time"})
    physics = "an offset of one channel's amplifier or contact"
    params = {"change": _COUNTS}
    confusable = {
        "gain": "load and unload",
        "warmup": "one electrode or all",
        "crosstalk": "press next to the electrode that couples in",
    }

    def apply(self, run: Run, theta: dict) -> None:
        wide = max(min(self.end, run.time[-1]) - self.start, 1e-9)
        counts = np.array(run.counts, float)
        counts[:, self.channels] += theta["change"] * np.clip((run.time[:, None] - self.start) / wide, 0, 1)
        run.counts = counts


class Flip(Logged):
    id, name = "flip", "sign of an electrode reversed"
    requires = frozenset({"sign", "change"})
    physics = "an electrode responds to the load with the opposite sign"
    params = {"factor": Param("1", -5, -0.05, "polarity")}
    confusable = {"gain": "press next to the electrode"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return rest + theta["factor"] * (counts - rest)


class ExchangeInLog(Logged):
    """Each of its electrodes shows the next one, from the start on."""

    id, name = "swap", "exchanged channels"
    wiring, requires = True, frozenset({"change"})
    physics = "electrodes carry each other's signal: cable or channel order"
    params = {"onset": _TIME}
    confusable = {"gain": "an exchange changes two channels at once"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return np.where(time >= theta["onset"], np.roll(counts, -1, axis=1), counts)


class Stuck(Logged):
    id, name = "stuck", "stuck channel"
    silent = True
    physics = "an electrode repeats one count although its noise would change it"
    params = {"value": _COUNTS}
    confusable = {"saturate": "press harder: a stuck channel does not leave its value"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return np.full_like(counts, theta["value"])


class Freeze(Logged):
    id, name = "freeze", "held rows"
    physics = "rows repeat, or only noise follows: bus or logger"
    params = {"seconds": Param("s", 0, 1e4, "longer than any bus period")}
    confusable = {"stuck": "one channel or all", "lowpass": "a tap: a filter has no steps"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        held = time < time[:1] + theta["seconds"]
        return np.where(held, counts[:1], counts)


class LostRows(Logged):
    id, name = "lost_rows", "lost rows"
    physics = "the record jumps: rows were dropped"
    params = {"seconds": Param("s", 0, 1e4, "what the load did meanwhile")}
    confusable = {"freeze": "the clock of the logger"}

    def apply(self, run: Run, theta: dict) -> None:
        """Every array of the run gets shorter, but its times are evenly spaced as before."""
        n = len(run.time)
        kept = (run.time < self.start) | (run.time >= self.start + theta["seconds"])
        for field in dataclasses.fields(run):
            value = getattr(run, field.name)
            if isinstance(value, np.ndarray) and len(value) == n:
                clock = field.name in ("time", "clock")
                setattr(run, field.name, value[: kept.sum()] if clock else value[kept])


class SaturationInLog(Saturation, Logged):
    fits, requires = _LOG, frozenset({"time", "load"})
    params = {"level": _COUNTS}
    grid = ({},)
    confusable = Saturation.confusable | {
        "stuck": "a clipped channel leaves the limit when the load decreases",
        "flip": "press less, below the limit",
    }
    apply = Logged.apply

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        low, high = np.maximum(counts, theta["level"]), np.minimum(counts, theta["level"])
        return np.where(theta["level"] < rest, low, high)


class Quantise(Logged):
    id, name = "quantise", "coarse quantisation"
    physics = "values are multiples of more than one count"
    params = {"step": Param("counts", 2, 512, "3 to 11 of 12 bits", start=1.0)}
    confusable = {"stuck": "a coarse channel takes several values"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return theta["step"] * np.rint(counts / theta["step"])


class Spikes(Logged):
    id, name = "spikes", "spikes or dropouts of single samples"
    physics = "a few samples leave the signal and return at once"
    params = {"rate": Param("1/min", 0, 6000, "up to every tenth sample")}
    confusable = {"noise": "noise is in every sample"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        often = theta["rate"] / 60 * np.gradient(time[:, 0])[:, None]
        far = self.rng.choice([-_FAR, _FAR], counts.shape)
        return counts + np.where(self.rng.random(counts.shape) < often, far, 0.0)


class Hum(Logged):
    id, name = "hum", "mains hum or another periodic disturbance"
    in_noise = True
    physics = "A sin(2 pi f t): mains, its alias, or a machine"
    params = {
        "amplitude": Param("counts", 0.3, 500, "1-10 counts"),
        "frequency": Param("Hz", 0.2, 2000, "half the rate"),
    }
    confusable = {"noise": "noise has no line"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return counts + theta["amplitude"] * np.sin(2 * np.pi * theta["frequency"] * time)


class NoiseInLog(Noise, Logged):
    fits, requires = _LOG, frozenset()
    params = {"size": Param("counts", 0, 500, "RMS beyond the law of noise", 10.0)}
    confusable = Noise.confusable | {"gain": "press next to the electrode: a gain makes touches larger, too"}
    apply = Logged.apply

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        return counts + theta["size"] * self.rng.standard_normal(counts.shape)


class CommonNoise(Logged):
    """Not searched."""

    id, name = "common_noise", "noise common to all channels"
    fits, requires = frozenset(), frozenset({"search"})
    physics = "one noise is added to every channel: reference, supply"
    params = {"correlation": Param("1", 0.05, 1, "0.001 in a real sensor")}
    confusable = {"crosstalk": "cross-talk falls off with distance"}

    def changed(self, counts: np.ndarray, time: np.ndarray, rest: np.ndarray, theta: dict) -> np.ndarray:
        own = np.mean(electrode_noise(rest))
        size = own * np.sqrt(theta["correlation"] / max(1 - theta["correlation"], 1e-3))
        return counts + size * self.rng.standard_normal((len(counts), 1))


_LEVELS = {
    "count_offset": "load and unload: an offset is the same in counts",
    "count_gain": "rest levels that differ more",
}


class WarmUpInLog(WarmUp, SharedLevel):
    fits, requires, detector, drifts = _LOG, frozenset(), "shared", True
    params = {"a": Param("ln Z", -1.5, 1.5, WarmUp.params["a"].source), "tau": Param("s", 1, 1e5, "minutes")}
    confusable = WarmUp.confusable | _LEVELS

    def of_trend(self, trend: Trend, change: float, slope: np.ndarray, counts: np.ndarray) -> dict:
        """a, tau of the a (1 - exp(-t / tau)) closest to the trend, with an a that a sensor can have. A
        straight line has no end: of all that are nearly as close it is the one with the least a; the interval
        has those that are less close."""
        time, bounds = np.linspace(trend.knots[0], trend.knots[-1], 200), self.params["tau"]
        y = trend(time) - trend(time[:1])
        fits = []
        for tau in np.unique(np.clip(np.geomspace(0.05, 20, 240) * time[-1], bounds.low, bounds.high)):
            basis = np.column_stack([1 - np.exp(-time / tau), np.ones(len(time))])
            w, *_ = np.linalg.lstsq(basis, y, rcond=None)
            fits.append((float(((y - basis @ w) ** 2).sum()), tau, w[0]))
        fits = [f for f in fits if self.params["a"].low <= f[2] <= self.params["a"].high] or fits
        off = 0.5 * min(fits)[0] + 1e-4 * (y**2).sum()
        near, nearly = ([f for f in fits if f[0] < min(fits)[0] + part * off] for part in (1.0, 0.5))
        least = min(nearly, key=lambda f: abs(f[2]))
        return {
            name: (least[i], min(f[i] for f in near), max(f[i] for f in near))
            for name, i in (("a", 2), ("tau", 1))
        }


class FluidLossInLog(FluidLoss, SharedLevel):
    fits, requires, detector, drifts = _LOG, frozenset({"sign"}), "loss", True
    rises = True
    params = FluidLoss.params | {
        "rate": Param("1/h", 0.0, 60.0, "0-15 % a day from permeability; a leak empties it in a minute", 0.2)
    }
    confusable = FluidLoss.confusable | _LEVELS

    def of_trend(self, trend: Trend, change: float, slope: np.ndarray, counts: np.ndarray) -> dict:
        lost = 1 - np.exp(-np.array([change, 0.9 * change, 1.1 * change]))
        return {"rate": tuple(3600 / trend.knots[-1] * lost)}


LOGGED = (
    FluidLossInLog(),
    WarmUpInLog(),
    CountOffset(),
    CountGain(),
    Level(),
    Flip(),
    ExchangeInLog(),
    Stuck(),
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
