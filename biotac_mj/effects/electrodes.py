"""Effects of single electrodes other than gain: offset, drift, noise, and exchanged channels."""

from collections.abc import Sequence

import numpy as np

from ..geometry.design import BIOTAC
from ..sensor.channels import FULL_SCALE
from ..sensor.presets import Sensor
from .effect import Effect, Param, Run

SESSION = 100.0  # [s] after which a drift has the size of its parameter
_WHOLE = 0.25  # largest deviation of an exchange's fraction from one


class Offset(Effect):
    id, name, stage = "offset", "offset of single electrodes", "A"
    physics = "an electrode has an offset in counts that no contact changes (contact resistance, a leak)"
    each = Param("counts", -1500, 1500, "5-100 counts from sensor to sensor", 30.0)
    params = dict.fromkeys(BIOTAC.electrodes, each)
    per_channel = of_rest = True
    confusable = {
        "electrode_drift": "the rests again at the end of the session",
        "swap": "press one electrode alone",
    }

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"rest": tuple(np.array(sensor.rest) + [theta[e] for e in self.params])}

    def apply(self, run: Run, theta: dict) -> None:
        run.counts = run.counts + np.array([theta[e] for e in self.design.electrodes])


class ElectrodeDrift(Effect):
    id, name, stage = "electrode_drift", "drift of single electrodes", "A"
    physics = "an electrode's counts + a (t / 100 s)^q, t the session's clock, each its own a"
    each = Param("counts", -1500, 1500, "0-100 counts in minutes", 20.0)
    params = dict.fromkeys(BIOTAC.electrodes, each) | {
        "q": Param("1", 0.2, 3.0, "root of time to a run-away: CHOSEN", 1.0, 1.0, True)
    }
    grid = ({"q": 0.4}, {"q": 1.0})
    equivalents, per_channel, requires = ("warmup",), True, frozenset()
    confusable = {
        "warmup": "free segments over the session: one electrode or all",
        "gain": "the same probe at the beginning and the end of the session",
    }

    def rejection_reason(self, theta: dict) -> str | None:
        a = np.array([theta.get(e, 0.0) for e in self.design.electrodes])
        # a common trend is a warm-up
        return "common" if abs(a.mean()) > 3.5 * a.std(ddof=1) / np.sqrt(len(a)) else None

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        # a straight line to the value at SESSION
        rates = np.array([theta.get(e, 0.0) for e in self.design.electrodes]) / SESSION
        return {"drift": tuple(np.full(sensor.nelectrode, sensor.drift) + rates)}

    def apply(self, run: Run, theta: dict) -> None:
        trend = np.power(np.maximum(run.clock, 0) / SESSION, theta["q"])
        run.counts = run.counts + np.outer(trend, [theta.get(e, 0.0) for e in self.design.electrodes])


class Noise(Effect):
    """Not searched with poses, as it changes no prediction; `diagnose` measures it in rows at rest."""

    id, name, stage = "noise", "noise of single electrodes", "A"
    physics = "an electrode is noisier than the others: a bad contact, a leaking lead"
    fits = frozenset()
    per_channel = is_noise = True
    each = Param("counts", 0, 500, "RMS beyond the law of noise", 10.0)
    params = dict.fromkeys(BIOTAC.electrodes, each)
    confusable = {"offset": "a long record at rest"}

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        before = sensor.electrode_noise(np.array(sensor.rest))
        return {"noise": tuple(np.hypot(before, [theta[e] for e in self.params]))}

    def apply(self, run: Run, theta: dict) -> None:
        """No change: its mean is zero."""


class Exchange(Effect):
    """Parameters "e3_reads_e5": fraction of e5 in the reading of e3, for candidate electrodes that were found
    before any fit (`trajectories.base.exchanges`)."""

    id, name, stage = "swap", "exchanged electrodes", "A"
    physics = "a plug in another's place: an electrode shows the counts of another one"
    per_channel = wiring = True
    confusable = {"gain": "press one electrode alone", "crosstalk": "drive one electrode alone"}

    def __init__(self, reads: Sequence[tuple[int, int]] = ((0, 1), (1, 0))):
        """reads: (electrode, the one that it shows), numbers from 0."""
        of = Param("1", -0.3, 1.5, "1 is an exchange", 1.0)
        self.reads = tuple(reads)
        self.params = {f"e{i + 1}_reads_e{j + 1}": of for i, j in self.reads}

    def given(self, names: Sequence[str]) -> "Exchange":
        pairs = [name.split("_reads_") for name in names if "_reads_" in name]
        return Exchange([tuple(int(e[1:]) - 1 for e in pair) for pair in pairs])

    def rejection_reason(self, theta: dict) -> str | None:
        return "partly" if max(abs(v - 1) for v in theta.values()) > _WHOLE else None

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        """Channels with their baselines; a channel's counts from ln Z refer to the baseline that it shows."""
        before, read = np.array(sensor.rest), np.eye(sensor.nelectrode)
        same = read.copy()
        for (i, j), coupling in zip(self.reads, (theta[name] for name in self.params)):
            read[i] += coupling * (same[j] - same[i])
        rest = read @ before
        by_log = [counts * (1 - counts / FULL_SCALE) for counts in (before, rest)]
        mixing = read * (by_log[0] / by_log[1])
        return {"rest": tuple(rest), "mixing": mixing @ (sensor.mixing or same)}

    def apply(self, run: Run, theta: dict) -> None:
        counts = run.counts.copy()
        for (i, j), coupling in zip(self.reads, (theta[name] for name in self.params)):
            counts[:, i] += coupling * (run.counts[:, j] - run.counts[:, i])
        run.counts = counts
