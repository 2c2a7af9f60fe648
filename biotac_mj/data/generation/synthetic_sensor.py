"""A synthetic substitute for a real sensor, used only where measured data are wanted and none are available.

The simulator does not use it. It differs from the simulator like a real sensor: another mesh, another law and
constants of the skin, three-dimensional conduction with electrodes at slightly different positions, and
effects that the simulation lacks: warm-up drift, slow temperature, relaxation. A model trained on its counts
is trained on synthetic data.

Sizes of the effects are those measured on real sensors (an unloaded sensor next to a flat press, EPFL, 22508
rows, and published grasps); chosen values are marked."""

import dataclasses
import importlib.util
from collections.abc import Callable

import numpy as np

from ...effects.rubber import modulus_of
from ...geometry import load_skin
from ...geometry.core_surface import CoreSurface
from ...geometry.design import BIOTAC, Design, electrode_positions
from ...geometry.skin_geometry import SkinGeometry
from ...sensor.film import excitation_places
from ...sensor.presets import Sensor, draw_sensor
from ..schema import DISPLACEMENT_SCALE
from .liquid_conduction import LiquidConduction
from .readings import sample

_CLEARING = 12.0  # [s] between the starts of successive contacts of a session: chosen
_TARE = 50  # frames of 10 ms before the contact, whose mean is row 0, like a sensor's tare
_WAVES = 64  # number of waves in a random field


@dataclasses.dataclass(frozen=True)
class Waves:
    """A smooth random field: a function of points (n, 3) [m] -> (n,), with mean 0, RMS `size` and correlation
    length `length` [m]."""

    seed: tuple
    size: float
    length: float

    def __call__(self, at: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(self.seed)
        wave, phase = rng.normal(size=(_WAVES, 3)) / self.length, rng.uniform(0, 2 * np.pi, _WAVES)
        return self.size * np.sqrt(2 / _WAVES) * np.cos(at @ wave.T + phase).sum(1)


@dataclasses.dataclass(frozen=True)
class SensorVariation:
    """Differences between sensors; `draw(seed)` gives sensor number `seed`.

    Ranges are those of real sensors, in the cited lab books, or marked as chosen.

    Attributes:
      youngs_modulus, poissons_ratio, friction: of a Neo-Hookean skin. E: all fits to two pressed sensors
        (docs/lab/real_match.md, 0.47 to 1.36 MPa); nu: the default's and the least compressible tried there.
      uneven: gradient of the modulus along and across the finger [1/cm], the catalogue's `inhomog` (0.15).
      rest_pressure: of its liquid [Pa]: 0 to 0.0194 E (docs/lab/real_match.md, Filling).
      film, film_spread, film_length: thickness where the skin touches the core [m], and its spatial scatter
        in the logarithm: the catalogue's range, 20-100 um, for the mean and again from place to place.
      texture, texture_length: relief of the skin's inner surface, RMS and length [m]. Walls fitted to two
        sensors deviate by up to 0.29 mm (docs/lab/real_match.md, The tip); the length is chosen.
      excitation: (4, 2) of X1..X4 as in `sensor.film.FilmConduction`, or (4, 3), within 0.7 mm of the
        design's (chosen: the BioTac's is known to some millimetres at best).
      electrode_shift: (nelectrode, 3) [m] of the electrodes, in common by up to 1 mm along and across (the
        catalogue's `misalign`), and each by 0.3 mm (chosen).
      mixing: (nelectrode, nelectrode) matrix on the changes of ln Z: gains with a scatter of 0.27 (0.25 to
        0.29 in two sensors, docs/lab/real_match.md), cross-talk of neighbours 0-0.2 within 2-6 mm, and global
        coupling, a fraction of the mean (the catalogue's `crosstalk`).
      sensor: rest counts, noise and warm-up, drawn from the spread of the measured ones (`sensor.presets`).
      ambient, ambient_time: standard deviation [C] and correlation time [s] of the temperature afterwards
        (chosen).
      overshoot, pressure_overshoot, relaxation_time: (2,), (2,), (2,) [s]: ln Z and pressure overshoot a step
        by these fractions and relax. Published: 0.5 s and 4-7 s; pressure falls 1.2-1.7 kPa at a constant
        grip, electrodes undershoot 5-25 counts after release.
    """

    youngs_modulus: float
    poissons_ratio: float
    friction: float
    uneven: dict
    rest_pressure: float
    film: float
    film_spread: float
    film_length: float
    texture: float
    texture_length: float
    excitation: np.ndarray
    electrode_shift: np.ndarray
    mixing: np.ndarray
    sensor: Sensor
    ambient: float
    ambient_time: float
    overshoot: np.ndarray
    pressure_overshoot: np.ndarray
    relaxation_time: np.ndarray

    @classmethod
    def draw(cls, seed: int, design: Design = BIOTAC) -> "SensorVariation":
        rng, n = np.random.default_rng([seed, 19]), design.nelectrode
        youngs_modulus = rng.uniform(0.47e6, 1.36e6)
        place = electrode_positions(design)  # [mm]
        far = np.linalg.norm(place[:, None] - place, axis=2)
        cross_talk = rng.uniform(0, 0.2) * np.exp(-far / rng.uniform(2, 6)) * (far > 0)
        gain = np.diag(np.exp(rng.normal(0, 0.27, n)))
        return cls(
            youngs_modulus=youngs_modulus,
            poissons_ratio=rng.uniform(0.32, 0.45),
            friction=rng.uniform(0.5, 0.9),
            uneven={name: rng.normal(0, 0.15) for name in ("along", "across")},
            rest_pressure=rng.uniform(0, 0.0194) * youngs_modulus,
            film=np.exp(rng.uniform(*np.log([20e-6, 100e-6]))),
            film_spread=np.log(100 / 20) / np.sqrt(12),  # that of a uniform draw from the range
            film_length=rng.uniform(1.5e-3, 4e-3),
            texture=rng.uniform(0.1e-3, 0.29e-3),
            texture_length=rng.uniform(1.5e-3, 4e-3),
            excitation=_shifted_excitation(design, rng),
            electrode_shift=rng.uniform(-1e-3, 1e-3, 3) * [1, 0, 1] + rng.normal(0, 0.3e-3, (n, 3)),
            mixing=gain @ (np.eye(n) + cross_talk + rng.uniform(-0.6, 0.6) / n),
            sensor=draw_sensor(rng, design),
            ambient=0.3,
            ambient_time=600.0,
            overshoot=np.array([0.03, 0.03]) * rng.uniform(0.7, 1.3, 2),
            pressure_overshoot=np.array([0.08, 0.08]) * rng.uniform(0.7, 1.3, 2),
            relaxation_time=np.array([0.5, rng.uniform(4.0, 7.0)]),
        )


def _shifted_excitation(design, rng):
    """Randomly shifted excitation of the design, as argument of `excitation_places`."""
    place = np.array(design.excitation)
    if place.shape[1] == 2:
        return place + rng.uniform(-1, 1, place.shape) * [0.7e-3, 0.1]
    return excitation_places(place + rng.uniform(-0.7, 0.7, place.shape), design, published=True)


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
        from ...skin import SkinModel, SkinOptions
        from ...skin.rubber.material import Material

        for module, name in (("skfem", "scikit-fem"), ("cholespy", "cholespy")):
            if importlib.util.find_spec(module) is None:
                raise ValueError(
                    f"the synthetic measured sensor needs {name}: "
                    "pip install 'biotac-mj[data]', or take --labelled 0"
                )
        geometry = load_skin(skin)
        v = self.variation = SensorVariation.draw(seed, geometry.design)
        material = Material("neo_hookean", v.youngs_modulus, v.poissons_ratio, v.friction)
        options = SkinOptions(element="quadratic", rest_pressure=v.rest_pressure)
        self.seed = seed
        self.model = SkinModel(geometry, material, options, device, modulus=modulus_of(v.uneven))

    def simulate(self, names: list | tuple, motions: list, progress: Callable | None = None) -> object:
        """Its skin under the same motions of the same objects: simulate.Fields, on its own mesh."""
        from .simulate import simulate

        return simulate(self.model, names, motions, progress)

    def meter(self) -> "Meter":
        """Converter from its skin to counts, light enough to be sent to another process."""
        return Meter(self.variation, self.model.geometry, self.model.rest.vert, self.seed)


@dataclasses.dataclass
class Meter:
    """Liquid, electrodes and electronics of a synthetic sensor; geometry and rest_vert (nvert, 3) [m] of its
    own skin."""

    variation: SensorVariation
    geometry: object
    rest_vert: np.ndarray
    seed: int

    def __post_init__(self):
        self._conduction = None

    def impedance(self, vert_xpos: np.ndarray) -> np.ndarray:
        """(n, nelectrode) [ohm] for nodes (n, nvert, 3) [m]: the sensor's rest values times mixed changes of
        ln Z."""
        v = self.variation
        if self._conduction is None:
            self._conduction = self._make()
            self._rest = np.log(self._conduction.impedance(self.rest_vert))
        out = []
        for i, x in enumerate(vert_xpos):  # repeated skins are solved once
            same = i and np.array_equal(x, vert_xpos[i - 1])
            out.append(out[-1] if same else np.log(self._conduction.impedance(x)) - self._rest)
        return v.sensor.impedance * np.exp(np.array(out) @ v.mixing.T)

    def _make(self):
        """The liquid over shifted electrodes; the shift is limited to positions with liquid."""
        v, geometry = self.variation, self.geometry
        core = CoreSurface(geometry.core_vert, geometry.core_face)
        floor = Waves((self.seed, 1), v.film_spread, v.film_length)
        relief = Waves((self.seed, 2), v.texture, v.texture_length)
        for fraction in (1.0, 0.75, 0.5, 0.25):
            _, foot, face = core.closest(geometry.electrode_pos + fraction * v.electrode_shift)
            moved = dataclasses.replace(geometry, electrode_pos=foot, electrode_normal=core.normal[face])
            try:
                return LiquidConduction(
                    moved, v.excitation, residual_film=lambda at: v.film * np.exp(floor(at)), relief=relief
                )
            except ValueError:
                continue
        return LiquidConduction(geometry, v.excitation, residual_film=v.film, relief=relief)

    def measure(
        self, vert_xpos: np.ndarray, time: np.ndarray, pressure: np.ndarray, start: float, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """(n, nchannel) counts, in the order of the design's channels, and (n, npac) PAC of the last frame,
        of one contact that begins `start` seconds into the session.

        Row 0 is the mean of 50 frames before the contact, so it is fractional; the others are whole numbers
        with noise.

        Args:
          vert_xpos: (n, nvert, 3) [m]; time: (n,) [s]; pressure: (n,) above rest [Pa]. Before row 0 the skin
            is at rest.
          seed: of the noise.
        """
        v = self.variation
        early = time[0] - 0.01 * np.arange(_TARE, 0, -1)
        when = np.concatenate([early, time])
        still = np.repeat(np.log(v.sensor.impedance)[None], _TARE, 0)
        log_z = np.concatenate([still, np.log(self.impedance(vert_xpos))])
        log_z = relax(when, log_z, v.overshoot, v.relaxation_time)
        pressure = relax(
            when, np.concatenate([np.zeros(_TARE), pressure]), v.pressure_overshoot, v.relaxation_time
        )
        temperature = self.temperature(start + when)
        log_z = log_z + (v.sensor.per_degree * (v.sensor.temperature - temperature))[:, None]
        # ln Z already includes its warm-up and gains
        plain = dataclasses.replace(v.sensor, warm_up=0.0, mixing=())
        counts, pac = sample(when, np.exp(log_z), pressure, seed, temperature, plain, self.geometry.design)
        counts = np.concatenate([counts[:_TARE].mean(0, keepdims=True), counts[_TARE + 1 :]])
        return counts, np.concatenate([pac[_TARE - 1 : _TARE], pac[_TARE + 1 :]])

    def temperature(self, t: np.ndarray) -> np.ndarray:
        """(n,) [C] at times (n,) of the session [s]: warm-up, then slow sines, the same for every contact."""
        v = self.variation
        rng = np.random.default_rng([self.seed, 23])
        slow = 2 * np.pi / (v.ambient_time * rng.uniform(0.5, 4.0, 8))
        wander = v.ambient * np.sqrt(2 / 8) * np.sin(np.outer(t, slow) + rng.uniform(0, 2 * np.pi, 8)).sum(1)
        warm = 1 - np.exp(-np.asarray(t) / v.sensor.warm_time)
        return v.sensor.temperature + v.sensor.warm_up * warm + warm * wander


def relax(time: np.ndarray, value: np.ndarray, fraction: float, tau: float) -> np.ndarray:
    """A signal (n,) or (n, k) with overshoot and relaxation: value + sum of fraction (value - its low-pass),
    exact for linear interpolation between samples.

    Args:
      time: (n,) [s]; value: the signal; fraction, tau: (m,), (m,) [s], of each term.
    """
    value = np.asarray(value, float)
    out = value.copy()
    for amplitude, tau_ in zip(fraction, tau):
        low = value[0]
        for i in range(1, len(time)):
            dt = time[i] - time[i - 1]
            rise = (value[i] - value[i - 1]) / dt
            low = value[i] - rise * tau_ + (low - value[i - 1] + rise * tau_) * np.exp(-dt / tau_)
            out[i] += amplitude * (value[i] - low)
    return out


_meter = {}  # a worker's state


def start_worker(geometry: SkinGeometry, meter: Meter | None, *film: object) -> None:
    """Prepares a worker: the film of the simulated skin, and the synthetic sensor if there are labels; film:
    further arguments of `readings.prepare_worker`."""
    from . import readings

    readings.prepare_worker(geometry, *film)
    _meter["one"] = meter


def measure_in_worker(
    displacement: np.ndarray, time: np.ndarray, pressure: np.ndarray, number: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """`Meter.measure` of contact `number` of the session; displacement (n, nvert, 3) int16 of the synthetic
    sensor's skin."""
    meter = _meter["one"]
    vert = meter.geometry.vert + displacement * DISPLACEMENT_SCALE
    return meter.measure(vert, time, pressure, _CLEARING * number, seed ^ 0x5EED)
