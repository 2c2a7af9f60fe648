"""Effects of the transduction and the acquisition: readings of electrodes, pressure and force for a given
skin."""

from collections.abc import Sequence

import numpy as np

from ..geometry.design import BIOTAC, electrode_positions
from ..sensor.channels import PDC_REST
from ..sensor.presets import MOST_LATENCY, Sensor
from .effect import Effect, Param, Run, Whole, memory, shifted
from .in_skin import Inside

_LOG_MODULUS = 0.1  # scatter between batches of rubber
_FILM = 0.5e-3  # [m] mean thickness of liquid between skin and core


_LEADS = Param("1", -0.6, 0.9, "adjacent leads: CHOSEN", 0.1)
_NEAR = 5.0  # [mm] between electrodes whose leads lie side by side
_FADE = Param("1/1000 counts", 0.01, 10.0, "a nonlinear gain: CHOSEN", 1.0, 0.01, True)


class Linear(Effect):
    """An effect on the counts that is linear in the electrodes' changes from rest. `apply` on unit changes of
    one electrode at a time gives the matrix for a running sensor."""

    stage = "A"

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        counts = np.array(sensor.rest) + np.eye(sensor.nelectrode)
        pdc = np.full(sensor.nelectrode, PDC_REST + 1.0)
        run = Run.of_counts(counts, np.log(sensor.impedance), pdc=pdc)
        self.apply(run, theta)
        mixing = (run.counts - np.array(sensor.rest)).T
        before = np.array(sensor.mixing) if sensor.mixing else np.eye(sensor.nelectrode)
        return {"mixing": mixing @ before, "pdc_gain": sensor.pdc_gain * float(run.pdc[0] - PDC_REST)}


class Bubble(Effect):
    id, name, stage = "bubble", "air bubble in the liquid", "B"
    physics = "p (V0 + dV) = const: the liquid is compressible; pressure and far electrodes respond less"
    params = {"volume": Param("m3", 0.0, 40e-9, "0-30 uL", 8e-9)}
    confusable = {"fluidloss": "the same probe at the beginning and the end of the session"}

    def in_whole(self, whole: Whole, theta: dict) -> None:
        whole.air += theta["volume"]

    def apply(self, run: Run, theta: dict) -> None:
        run.bubble = run.bubble + theta["volume"]


class FluidLoss(Effect):
    id, name, stage = "fluidloss", "liquid lost over the session", "T"
    physics = (
        "liquid is lost with the session's clock: the film gets thinner and the sensor softer; "
        "or the skin sinks to the core, equally everywhere"
    )
    params = {
        "rate": Param("1/h", 0.0, 6.0, "0-15 % a day from permeability; a leak empties it in minutes", 0.2),
        "before": Param("1", 0.0, 0.3, "loss before the session: CHOSEN", 0.03),
        "suction": Param("Pa", 0.0, 1.5e5, "of all the liquid; 1 kPa by 2 % of it at rest", 3e4),
    }
    rare = {"sink": Param("m/h", 0.0, 20e-3, "of the skin; 0.1 mm in a minute empties a fifth: CHOSEN", 1e-3)}
    equivalents, answers = ("warmup",), ("fill", "sink")
    confusable = {
        "warmup": "log TDC; wait an hour",
        "gain": "the same probe at the beginning and the end of the session",
    }

    def in_whole(self, whole: Whole, theta: dict) -> dict:
        whole.lost += theta.get("before", 0.0)
        return theta

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        for name, value in (("loss", theta["rate"]), ("before", theta.get("before", 0.0))):
            if value > 0:
                inside.film[name] = inside.film.get(name, 0.0) + value
        return True

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"loss": sensor.loss + theta["rate"]}

    def apply(self, run: Run, theta: dict) -> None:
        gone = theta.get("before", 0.0) + theta["rate"] * run.clock / 3600
        lost = -np.log(np.maximum(1 - gone, 0.2))
        sunk = theta.get("sink", 0.0) * run.clock / 3600
        if "sink" in run.answers:
            run.log_z = run.log_z + sunk[:, None] * run.answers["sink"][:, 4:]
        if "fill" not in run.answers:  # every impedance in proportion, all else as before
            run.log_z = run.log_z + lost[:, None]
            return
        # its pressure is above that at rest, from which suction subtracts
        run.pressure = run.pressure - theta.get("suction", 0.0) * (lost + sunk / _FILM)
        run.add(-lost[:, None] * run.answers["fill"])


class Thermal(Effect):
    id, name, stage = "thermal", "temperature dependence of conductivity", "T"
    fits, requires, detector = frozenset({"poses", "log"}), frozenset({"tdc", "time"}), "shared"
    physics = "ln Z = ... - alpha (T - T0), T from TDC"
    params = {
        "alpha": Param(
            "1/K", -0.05, 0.15, "0.014-0.028 of salt solutions; 0.064-0.078 over five sensors", 0.02
        )
    }
    confusable = {"warmup": "heater on and off"}

    def applicable(self, trajectories: list) -> str | None:
        tdc = [t.tdc for t in trajectories if t.tdc is not None]
        return None if tdc and np.ptp(np.concatenate(tdc)) > 8 else "no TDC, or it does not change"

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"per_degree": theta["alpha"]} if theta["alpha"] else {}

    def apply(self, run: Run, theta: dict) -> None:
        if run.temperature is not None:
            run.log_z = run.log_z - theta["alpha"] * run.temperature[:, None]


class WarmUp(Effect):
    id, name, stage = "warmup", "shared impedance gain (warm-up)", "T"
    physics = "every impedance times exp(a (1 - exp(-t / tau))), t the session's clock"
    params = {
        "a": Param("ln Z", -1.0, 1.0, "-0.23 over 190 s measured; 10-17 % of full scale (Mongeon 2015)", 0.1),
        "tau": Param("s", 5, 5000, "minutes", 100, 100, True),
    }
    grid = ({"tau": 20.0}, {"tau": 80.0}, {"tau": 300.0})
    equivalents = ("fluidloss",)
    confusable = {
        "thermal": "log TDC",
        "fluidloss": "wait an hour",
        "drift": "free segments: one electrode or all",
    }

    def alias(self, theta: dict) -> tuple:
        """Warmth lowers impedances; a common rise may also be a cooling sensor or lost liquid."""
        return ("fluidloss",) if theta["a"] > 0 else ()

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"warm_up": -theta["a"] / sensor.per_degree, "warm_time": theta["tau"]}

    def apply(self, run: Run, theta: dict) -> None:
        run.log_z = run.log_z + theta["a"] * (1 - np.exp(-run.clock / theta["tau"]))[:, None]


class Asperities(Effect):
    id, name, stage = "asper", "sensitivity of impedance to the film", "T"
    physics = "conductance ~ gap^p: the change of ln Z from rest is multiplied by p"
    params = {
        "log_p": Param("1", -0.8, 0.8, "p 1-3; asperities give the range of a thousand (Wettels 2008)", 0.15)
    }
    equivalents = ("crosstalk",)
    confusable = {"gain": "one electrode or all", "saturate": "depth ladder", "crosstalk": "drive one alone"}

    def in_skin(self, inside: Inside, theta: dict) -> bool:
        if theta["log_p"]:
            inside.film["power"] = inside.film.get("power", 1.0) * float(np.exp(theta["log_p"]))
        return True

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"power": sensor.power * float(np.exp(theta["log_p"]))}

    def apply(self, run: Run, theta: dict) -> None:
        run.log_z = run.rest_log_z + np.exp(theta["log_p"]) * (run.log_z - run.rest_log_z)


class Gain(Linear):
    """A gain of only some electrodes also has a "fade": data that identify the electrodes also show their
    nonlinearity."""

    id, name, stage = "gain", "gain of single electrodes", "A"
    physics = "an electrode's change from rest has its own factor (manufacturing)"
    each = Param("1", -0.8, 1.5, "3-15 %", 0.1)
    requires = frozenset({"protocol"})
    params = dict.fromkeys(BIOTAC.electrodes, each)
    equivalents, per_channel = ("inhomog",), True
    # Electrodes are 0.1 to 0.2 mm from their drawn positions, which looks like such gains. Gains found for
    # such positions were up to 4.2 % (docs/lab/discrepancy.md).
    sound = 0.05
    confusable = {
        "asper": "one electrode or all",
        "crosstalk": "drive one electrode alone",
        "saturate": "depth ladder",
    }
    refit_with = tuple(confusable)  # one law common to all electrodes, against nineteen gains

    def only(self, names: Sequence[str]) -> "Gain":
        other = super().only(names)
        other.params["fade"] = _FADE
        other.grid = ({"fade": _FADE.low}, {"fade": 1.5})
        return other

    def given(self, names: Sequence[str]) -> "Gain":
        return self.only(list(self.params)) if "fade" in names else self

    def rejection_reason(self, theta: dict) -> str | None:
        g = np.array([theta.get(e, 0.0) for e in self.design.electrodes])
        # manufacturing scatter has zero mean
        return "common" if abs(g.mean()) > 3.5 * g.std(ddof=1) / np.sqrt(len(g)) else None

    def apply(self, run: Run, theta: dict) -> None:
        rest, change = run.rest, run.counts - run.rest
        gain = np.array([theta.get(e, 0.0) for e in self.design.electrodes])
        if "fade" in theta:
            gain = gain / (1 + theta["fade"] * np.abs(change) / 1000)
        run.counts = rest + change * (1 + gain)


class DeadTaxels(Linear):
    """Not in the catalogue: `diagnose` finds stuck channels of recordings separately."""

    id, name, stage = "dead", "electrodes that no longer respond", "A"
    fits, per_channel = frozenset(), True
    physics = "a broken lead or a corroded contact: the electrode shows only its baseline and noise"
    each = Param("1", 0.0, 1.0, "none to all; fraction of electrodes: CHOSEN", 0.02)
    params = dict.fromkeys(BIOTAC.electrodes, each)
    confusable = {"gain": "a gain is not zero"}

    def draw(self, rng: np.random.Generator, size: float = 1.0) -> dict:
        """Each electrode is dead with probability `size` times `scale`."""
        return {k: float(rng.random() < size * p.scale) for k, p in self.params.items()}

    def apply(self, run: Run, theta: dict) -> None:
        rest = run.rest
        run.counts = rest + (run.counts - rest) * (1 - np.array([theta[k] for k in self.params]))


def _pair(i, j):
    return f"e{i + 1}_hears_e{j + 1}"


class CrossTalk(Linear):
    """Cross-talk by distance, by the order of sampling, or to all; or, where the data single out pairs of
    leads, of these: parameters "e3_hears_e5", the fraction of e5's change added to e3."""

    id, name, stage = "crosstalk", "cross-talk between electrodes", "A"
    physics = (
        "V = (I + kappa K + scan S + common M + pairs) U: "
        "K decreases with distance, S is the channel sampled before, M the mean of all"
    )
    requires = frozenset({"protocol"})
    params = {
        "kappa": Param("1", -0.1, 0.4, "0-0.2", 0.05),
        "scan": Param("1", -0.4, 0.4, "charge held by a multiplexer: CHOSEN, like kappa", 0.05),
        "common": Param("1", -0.6, 0.6, "a sagging supply or reference: CHOSEN, like kappa", 0.05),
        "length": Param("mm", 1, 10, "2-6 mm", 3, 3, True),
    }
    grid = ({"length": 2.0}, {"length": 4.0})
    equivalents = ("asper",)
    confusable = {
        "gain": "drive one electrode alone",
        "rocking": "another place",
        "base": "a footprint or mesh that is a little off looks alike",
    }

    def __init__(self, hears: Sequence[tuple[int, int]] = ()):
        """hears: (electrode, the one that couples into it), numbers from 0."""
        self.hears = {_pair(i, j): (i, j) for i, j in hears}
        self.params = CrossTalk.params | dict.fromkeys(self.hears, _LEADS)

    @property
    def rare(self) -> dict:
        """Parameters of all pairs of leads that lie side by side, in place or in the order of sampling."""
        at = electrode_positions(self.design)
        near = np.linalg.norm(at[:, None] - at, axis=2) < _NEAR
        near |= np.eye(len(at), k=1, dtype=bool) | np.eye(len(at), k=-1, dtype=bool)
        return {_pair(i, j): _LEADS for i, j in np.argwhere(near & ~np.eye(len(at), dtype=bool))}

    def given(self, names: Sequence[str]) -> "CrossTalk":
        """With pairs; with these alone where no name is of another parameter."""
        pairs = [name.split("_hears_") for name in names if "_hears_" in name]
        other = CrossTalk([tuple(int(e[1:]) - 1 for e in pair) for pair in pairs]).on(self.design)
        if len(pairs) == len(names):
            other.params, other.grid, other.per_channel = dict.fromkeys(other.hears, _LEADS), ({},), True
        return other

    def apply(self, run: Run, theta: dict) -> None:
        p = electrode_positions(self.design)
        n = len(p)
        M = theta.get("scan", 0.0) * np.eye(n, k=-1) + theta.get("common", 0.0) / n
        if theta.get("kappa"):
            distance = np.linalg.norm(p[:, None] - p[None], axis=2)
            M += theta["kappa"] * np.exp(-distance / theta["length"]) * (1 - np.eye(n))
        for name in theta.keys() & self.hears.keys():
            M[self.hears[name]] += theta[name]
        run.counts = run.counts + (run.counts - run.rest) @ M.T


class Saturation(Effect):
    id, name, stage = "saturate", "saturation of the change", "A"
    physics = "changes from rest are compressed beyond a knee: soft clip"
    params = {
        "strength": Param("1", 0.0, 1.0, "none to hard", 0.3),
        "knee": Param("counts", 60, 1500, "60-1500", 300, 300, True),
    }
    grid = ({"knee": 120.0}, {"knee": 400.0}, {"knee": 900.0})
    confusable = {"gain": "depth ladder at one place"}

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"saturation": (theta["strength"], theta["knee"])}

    def apply(self, run: Run, theta: dict) -> None:
        change = run.counts - run.rest
        over = np.sign(change) * np.maximum(np.abs(change) - theta["knee"], 0)
        run.counts = run.counts - theta["strength"] * over


class LowPass(Effect):
    id, name, stage = "lowpass", "low-pass filter of the electrodes", "A"
    fits, requires = frozenset({"poses", "log"}), frozenset({"load"})
    physics = "electrodes follow their input with a time constant: tau dV/dt + V = U"
    params = {"tau": Param("s", 0.0, 0.5, "3-150 ms", 0.03)}
    equivalents, alike = ("latency",), True
    confusable = {"latency": "two speeds a decade apart and a tap"}

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"lowpass": sensor.lowpass + theta["tau"]}

    def apply(self, run: Run, theta: dict) -> None:
        if theta["tau"] > 0:
            run.counts = run.counts - memory(run, run.counts, theta["tau"])


class Latency(Effect):
    id, name, stage = "latency", "latency of the electrodes", "A"
    fits, requires = frozenset({"poses", "log"}), frozenset({"force"})
    alike, most = True, {"delay": MOST_LATENCY}
    physics = "electrodes are read with a delay: V(t - delay)"
    params = {"delay": Param("s", -0.1, 0.5, "0-100 ms", 0.03)}
    rare = {"of_pdc": Param("s", 0.0, 0.5, "one bus for all: CHOSEN", 0.03)}
    equivalents = ("lowpass",)
    confusable = {"lowpass": "two speeds a decade apart and a tap"}

    def rejection_reason(self, theta: dict) -> str | None:
        # a delay of the pressure alone is no latency of the electrodes
        return "pressure" if theta.get("of_pdc", 0.0) > 1.5 * theta["delay"] + 0.01 else None

    def of_setup(self, theta: dict) -> bool:
        """A negative delay belongs to the other device's clock."""
        return theta["delay"] < 0

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"latency": sensor.latency + theta["delay"]}

    def apply(self, run: Run, theta: dict) -> None:
        run.counts = shifted(run.counts, run.time, theta["delay"])
        if theta.get("of_pdc"):
            run.pdc = shifted(run.pdc, run.time, theta["of_pdc"])


class Drift(Effect):
    id, name, stage = "drift", "drift of offsets within a trajectory", "A"
    physics = "counts + v t from the trajectory's beginning, the same for all electrodes"
    params = {"rate": Param("counts/s", -60, 60, "0-20 counts in 10 s", 2.0)}
    confusable = {"warmup": "free segments over the session", "relax": "free segments"}

    def in_sensor(self, sensor: Sensor, theta: dict) -> dict:
        return {"drift": tuple(np.full(sensor.nelectrode, sensor.drift) + theta["rate"])}

    def apply(self, run: Run, theta: dict) -> None:
        run.counts = run.counts + theta["rate"] * (run.time - run.time[0])[:, None]


class PressureGain(Linear):
    id, name, stage = "pdc_gain", "gain of the pressure channel", "A"
    physics = "PDC's change from rest is multiplied by a factor"
    params = {"gain": Param("1", -0.7, 2.0, "transducer 10 %", 0.15)}
    confusable = {"bubble": "electrodes far from the contact", "relax": "holds"}

    def applicable(self, trajectories: list) -> str | None:
        return None if any(t.pdc is not None for t in trajectories) else "no PDC"

    def undoes(self, theta: dict, log_modulus: float) -> bool:
        """The modulus was fitted to the force: if the pressure then agrees with the base model, the force is
        the one that does not."""
        taken = -log_modulus
        return abs(taken) > _LOG_MODULUS and abs(np.log1p(theta["gain"]) - taken) < 0.3 * abs(taken)

    def apply(self, run: Run, theta: dict) -> None:
        run.pdc = 2000 + (run.pdc - 2000) * (1 + theta["gain"])


class ForceZero(Effect):
    id, name, stage = "force_cross", "cross-axis sensitivity of the force sensor", "A"
    physics = "a fraction of the normal force appears in the tangential components"
    params = {k: Param("1", -0.4, 0.4, "1-5 %", 0.04) for k in ("x", "z")}
    confusable = {
        "misalign": "turn the force sensor by 180 degrees",
        "friction": "press without slides",
        "rocking": "turn the force sensor by 180 degrees; a sideways motion by the load also adds force",
    }

    def applicable(self, trajectories: list) -> str | None:
        return None if any(t.force is not None for t in trajectories) else "no force"

    def of_setup(self, theta: dict) -> bool:
        return True

    def apply(self, run: Run, theta: dict) -> None:
        run.force = run.force + np.outer(run.normal_force, np.array([theta["x"], 0, theta["z"]]))
