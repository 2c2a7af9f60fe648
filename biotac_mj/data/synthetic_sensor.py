"""A synthetic 'real sensor': where measured data are wanted and none are at hand, and never anything else.

The simulator does not use it. It differs from the simulator in everything that a real sensor differs in:
another mesh, another law and constants of the skin, three-dimensional conduction with electrodes in slightly
other places, and what no simulation here has: warm-up drift, slow temperature, relaxation. What learns on its
counts is trained on synthetic data, whatever it is called.

Sizes of the effects are those measured on real sensors (a real unloaded sensor beside a flat press, EPFL,
22508 rows, and published grasps); what is chosen says so."""

import dataclasses
import importlib.util
from collections.abc import Callable

import numpy as np

from ..geometry import load_skin
from ..geometry.skin_geometry import SkinGeometry
from ..sensor.channels import (
    NELECTRODE,
    REST_COUNTS,
    REST_TEMPERATURE,
    counts_from_impedance,
    impedance_from_counts,
)
from ..sensor.film import EXCITATION
from .liquid_conduction import LiquidConduction
from .readings import sample
from .schema import DISPLACEMENT_SCALE

__all__ = ["SensorVariation", "SyntheticSensor", "start_worker", "measure_in_worker", "relax"]

_CLEARING = 12.0  # [s] from the start of one contact of a session to that of the next: chosen
_TARE = 50  # frames of 10 ms before the contact, whose mean is row 0, as one tares a sensor
_PER_DEGREE = -0.07  # d ln Z / dT [1/C]: -0.064 .. -0.078 over five sensors


@dataclasses.dataclass(frozen=True)
class SensorVariation:
    """What makes one sensor different from the next; `draw(seed)` gives sensor number `seed`.

    Attributes:
      youngs_modulus, poissons_ratio, friction: of a Neo-Hookean skin. rest_pressure: of its liquid [Pa].
        Chosen ranges.
      residual_film: where the skin lies on the core [m], catalogue range 20-100 um.
      excitation: (4, 2) of X1..X4, within 0.7 mm of the estimate (chosen: it is known to some millimetres at
        best).
      rest_counts: (19,) at rest: the mean pattern in ln Z of three published sensors, with the spread that
        they have.
      drift: of ln Z, all electrodes together, while warming up, and drift_time [s]: -0.38 and 205 s were
        fitted to the unloaded sensor.
      ambient, ambient_time: standard deviation [C] and correlation time [s] of the temperature afterwards
        (chosen).
      overshoot, pressure_overshoot, relaxation_time: (2,), (2,), (2,) [s]: ln Z and pressure answer a step by
        these shares too much and relax. Published: 0.5 s and 4-7 s; pressure falls 1.2-1.7 kPa at a constant
        grip, electrodes undershoot 5-25 counts after release.
    """

    youngs_modulus: float
    poissons_ratio: float
    friction: float
    rest_pressure: float
    residual_film: float
    excitation: np.ndarray
    rest_counts: np.ndarray
    drift: float
    drift_time: float
    ambient: float
    ambient_time: float
    overshoot: np.ndarray
    pressure_overshoot: np.ndarray
    relaxation_time: np.ndarray

    @classmethod
    def draw(cls, seed: int) -> "SensorVariation":
        rng = np.random.default_rng([seed, 19])
        log_z = np.log([impedance_from_counts(counts) for counts in REST_COUNTS.values()])
        # what the published sensors share, and how they differ: all electrodes together, and each on its own
        common, each = log_z.mean(1).std(ddof=1), (log_z - log_z.mean(1, keepdims=True)).std(0, ddof=1).mean()
        pattern = log_z.mean(0) + rng.normal(0, common) + rng.normal(0, each, NELECTRODE)
        excitation = np.array(EXCITATION) + rng.uniform(-1, 1, (4, 2)) * [0.7e-3, 0.1]
        return cls(
            youngs_modulus=rng.uniform(0.8e6, 1.1e6),
            poissons_ratio=rng.uniform(0.40, 0.44),
            friction=rng.uniform(0.5, 0.9),
            rest_pressure=rng.uniform(0.0, 1500.0),
            residual_film=rng.uniform(30e-6, 70e-6),
            excitation=excitation,
            rest_counts=counts_from_impedance(np.exp(pattern)),
            drift=-0.38 * rng.uniform(0.6, 1.2),
            drift_time=205.0 * rng.uniform(0.7, 1.5),
            ambient=0.3,
            ambient_time=600.0,
            overshoot=np.array([0.03, 0.03]) * rng.uniform(0.7, 1.3, 2),
            pressure_overshoot=np.array([0.08, 0.08]) * rng.uniform(0.7, 1.3, 2),
            relaxation_time=np.array([0.5, rng.uniform(4.0, 7.0)]),
        )


class SyntheticSensor:
    """One synthetic sensor.

    Args:
      seed: its number; see `SensorVariation.draw`.
      skin: its mesh. device: where its skin is solved.

    Attributes:
      variation: SensorVariation. model: SkinModel of its skin.

    Raises:
      ValueError: scikit-fem or cholespy is missing.
    """

    def __init__(self, seed: int = 0, skin: str = "fine", device: str = "cpu"):
        from ..skin import SkinModel, SkinOptions
        from ..skin.rubber.material import Material

        for module, name in (("skfem", "scikit-fem"), ("cholespy", "cholespy")):
            if importlib.util.find_spec(module) is None:
                raise ValueError(
                    f"the synthetic measured sensor needs {name}: "
                    "pip install 'biotac-mj[data]', or take --labelled 0"
                )
        v = self.variation = SensorVariation.draw(seed)
        material = Material("neo_hookean", v.youngs_modulus, v.poissons_ratio, v.friction)
        options = SkinOptions(element="quadratic", rest_pressure=v.rest_pressure)
        self.seed = seed
        self.model = SkinModel(load_skin(skin), material, options, device)

    def simulate(self, names: list | tuple, motions: list, progress: Callable | None = None) -> object:
        """Its skin under the same motions of the same objects: simulate.Fields, of its own mesh."""
        from .simulate import simulate

        return simulate(self.model, names, motions, progress)

    def meter(self) -> "Meter":
        """What turns its skin into counts; light enough to be sent to another process."""
        return Meter(self.variation, self.model.geometry, self.model.rest.vert, self.seed)


@dataclasses.dataclass
class Meter:
    """Liquid, electrodes and electronics of a synthetic sensor: geometry and rest_vert (nvert, 3) [m] are of
    its own skin."""

    variation: SensorVariation
    geometry: object
    rest_vert: np.ndarray
    seed: int

    def __post_init__(self):
        self._conduction = None

    def impedance(self, vert_xpos: np.ndarray) -> np.ndarray:
        """(n, 19) [ohm] for nodes (n, nvert, 3) [m]; with the cell constants that give the sensor's counts at
        rest."""
        if self._conduction is None:
            v = self.variation
            self._conduction = LiquidConduction(self.geometry, v.excitation, residual_film=v.residual_film)
            rest = self._conduction.impedance(self.rest_vert)
            self._cell = impedance_from_counts(v.rest_counts) / rest
        out = []
        for i, x in enumerate(vert_xpos):  # a skin that stands still is solved once
            out.append(
                out[-1]
                if i and np.array_equal(x, vert_xpos[i - 1])
                else self._cell * self._conduction.impedance(x)
            )
        return np.array(out)

    def measure(
        self, vert_xpos: np.ndarray, time: np.ndarray, pressure: np.ndarray, start: float, seed: int
    ) -> np.ndarray:
        """(n, 23) counts, in the order of sensor.channels.CHANNELS, of one contact that begins `start`
        seconds into the session.

        Row 0 is the mean of 50 frames before the contact, so it has fractions; the others are whole numbers
        with their noise.

        Args:
          vert_xpos: (n, nvert, 3) [m]; time: (n,) [s]; pressure: (n,) above rest [Pa]; row 0 at rest.
          seed: of the noise.
        """
        v = self.variation
        early = time[0] - 0.01 * np.arange(_TARE, 0, -1)
        rows = np.concatenate([np.zeros(_TARE, int), np.arange(len(time))])
        when = np.concatenate([early, time])
        log_z = np.log(self.impedance(vert_xpos))[rows]
        log_z = relax(when, log_z, v.overshoot, v.relaxation_time)
        pressure = relax(when, np.asarray(pressure)[rows], v.pressure_overshoot, v.relaxation_time)
        temperature = self.temperature(start + when)
        log_z = log_z + (_PER_DEGREE * (temperature - REST_TEMPERATURE + self._warm_up))[:, None]
        counts = sample(when, np.exp(log_z), pressure, seed, temperature)
        return np.concatenate([counts[:_TARE].mean(0, keepdims=True), counts[_TARE + 1 :]])

    @property
    def _warm_up(self):
        """[C] by which the sensor is cold at the start of a session: its counts there are those of
        `rest_counts`."""
        return self.variation.drift / _PER_DEGREE

    def temperature(self, t: np.ndarray) -> np.ndarray:
        """(n,) [C] at times (n,) of the session [s]: warming up, then wandering as slow sines, the same for
        every contact."""
        v = self.variation
        rng = np.random.default_rng([self.seed, 23])
        slow = 2 * np.pi / (v.ambient_time * rng.uniform(0.5, 4.0, 8))
        wander = v.ambient * np.sqrt(2 / 8) * np.sin(np.outer(t, slow) + rng.uniform(0, 2 * np.pi, 8)).sum(1)
        warm = 1 - np.exp(-np.asarray(t) / v.drift_time)
        return REST_TEMPERATURE - self._warm_up * (1 - warm) + warm * wander


def relax(time: np.ndarray, value: np.ndarray, share: float, tau: float) -> np.ndarray:
    """A signal (n,) or (n, k) that overshoots and relaxes: value + sum of share (value - its low-pass), exact
    between samples (linear).

    Args:
      time: (n,) [s]; value: the signal; share, tau: (m,), (m,) [s], of each part.
    """
    value = np.asarray(value, float)
    out = value.copy()
    for part, tau_ in zip(share, tau):
        low = value[0]
        for i in range(1, len(time)):
            dt = time[i] - time[i - 1]
            rise = (value[i] - value[i - 1]) / dt
            low = value[i] - rise * tau_ + (low - value[i - 1] + rise * tau_) * np.exp(-dt / tau_)
            out[i] += part * (value[i] - low)
    return out


_meter = {}  # what a worker keeps


def start_worker(
    geometry: SkinGeometry, meter: Meter | None, rest_vert: np.ndarray | None = None, film: dict | None = None
) -> None:
    """Prepares a worker: the film of the simulated skin, and the synthetic sensor where there are labels to
    make."""
    from . import readings

    readings.prepare_worker(geometry, rest_vert, film)
    _meter["one"] = meter


def measure_in_worker(
    displacement: np.ndarray, time: np.ndarray, pressure: np.ndarray, number: int, seed: int
) -> np.ndarray:
    """`Meter.measure` of contact `number` of the session; displacement (n, nvert, 3) int16 of the synthetic
    sensor's skin."""
    meter = _meter["one"]
    vert = meter.geometry.vert + displacement * DISPLACEMENT_SCALE
    return meter.measure(vert, time, pressure, _CLEARING * number, seed ^ 0x5EED)
