"""Constants of a single sensor: rest counts, noise, levels, warm-up, gains; measured ones of real sensors,
and draws from their spread.

`benchmarks/sensor_presets.py` extracts the constants from recordings; a channel without a recording has its
default. `sensor=` is a name of SENSORS, "random", or a dict of fields of `Sensor` ("like": name of another
one), read by `read_sensor`."""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from biotac_mj.sensor.channels import (
    FULL_SCALE,
    PAC_COLOUR,
    PAC_NOISE,
    PAC_REST,
    PDC_REST,
    REST_TEMPERATURE,
    TAC_REST,
    counts_from_impedance,
    counts_from_temperature,
    electrode_noise,
    impedance_from_counts,
    log_impedance,
    temperature_from_counts,
)

from ..fields import refuse_unknown
from ..geometry.design import BIOTAC, Design, check_nelectrode, designs
from ..short_repr import short_repr

# [1/C] of ln Z: all electrodes change by -6.4 to -7.8 % per degree of the liquid in five sensors
PER_DEGREE = 0.071
MOST_LATENCY = 0.11  # [s] eleven frames
_HUGE = 1e9  # limit of any number of a sensor: above it sums of counts are no longer numbers
# Scatter of an electrode's gain: 3 to 15 % (`effects.sensing.Gain`); no recording includes the skin's state.
_GAIN = 0.1


# fields of a sensor, whether a value is possible, and what is
_LIMITS = (
    ("pdc_noise pac_noise tac_noise tdc_noise loss lowpass", lambda x: x >= 0, "0 or more"),
    ("latency", lambda x: 0 <= x <= MOST_LATENCY, f"0 or more, at most {MOST_LATENCY:g}"),
    ("noise", lambda x: min(x or (0,)) >= 0, "0 or more each"),
    ("warm_time power", lambda x: x > 0, "more than 0"),
    ("pac_colour", lambda x: 0 <= x < 1, "0 or more, less than 1"),
    ("per_degree", lambda x: x != 0, "another number than 0"),
    (
        "relaxation",
        lambda x: 0 <= x[0] <= 1 and x[1] > 0,
        "a fraction from 0 to 1 and a time of more than 0 s",
    ),
    ("saturation", lambda x: 0 <= x[0] <= 1 and x[1] > 0, "a fraction from 0 to 1 and a knee of more than 0"),
)


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Constants of one sensor with n electrodes. Counts have 12 bits; rest values are untouched, at the
    reset.

    Attributes:
      rest: (n,) of the electrodes. noise: (n,) RMS of the electrodes at rest; None: by `electrode_noise`.
      mixing: (n, n) matrix on the electrodes' changes of counts from rest: gains, dead taxels and cross-talk;
        () is the identity.
      pdc_rest, pdc_noise: of PDC [counts]; pdc_gain: of its change.
      pac_rest, pac_noise, pac_colour: level, and n[i] = colour n[i - 1] + noise white.
      tdc_rest, tdc_noise, tac_rest, tac_noise: of TDC and TAC.
      per_degree: decrease of ln Z per degree of the liquid [1/C].
      warm_up: warming of liquid and electrodes after the reset [C]; warm_time: time constant [s]; warm_share:
        (n,) fraction of it for each electrode, may be negative, () is all. With heat, the time constant
        follows from the heat model.
      relaxation: fraction and time constant [s] of PDC's decaying excess response.
      loss: of the liquid [1/h]; drift: of the electrodes [counts/s], one or (n,).
      power: exponent on the change of ln Z from rest. saturation: fraction and knee [counts]: that fraction
        of a change beyond the knee is lost. lowpass: time constant of the electrodes [s]. latency: of the
        electrodes [s], up to MOST_LATENCY.

    Raises:
      ValueError: an invalid number.
    """

    rest: tuple = tuple(BIOTAC.sensors["1"]["rest"])
    noise: tuple | None = None
    mixing: tuple = ()
    pdc_rest: float = PDC_REST
    pdc_gain: float = 1.0
    pdc_noise: float = 0.22
    pac_rest: float = PAC_REST
    pac_noise: float = PAC_NOISE
    pac_colour: float = PAC_COLOUR
    tdc_rest: float = float(counts_from_temperature(REST_TEMPERATURE))
    tdc_noise: float = 0.22
    tac_rest: float = TAC_REST
    tac_noise: float = 0.52
    warm_up: float = 0.0
    warm_time: float = 205.0
    relaxation: tuple = (0.0, 1.0)
    loss: float = 0.0
    drift: float | tuple = 0.0
    per_degree: float = PER_DEGREE
    warm_share: tuple = ()
    power: float = 1.0
    saturation: tuple = (0.0, 1.0)
    lowpass: float = 0.0
    latency: float = 0.0

    def __post_init__(self):
        n = np.size(self.rest)
        shapes = {"rest": (n,), "noise": (n,), "mixing": (n, n), "relaxation": (2,), "saturation": (2,)}
        shapes |= {"warm_share": (n,), "drift": np.shape(self.drift) and (n,)}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is None and field.default is None:
                continue
            if field.default == () and np.size(value) == 0 and value is not None:
                object.__setattr__(self, field.name, ())
                continue
            try:
                number = np.asarray(value, float)
            except (TypeError, ValueError, OverflowError):
                number = np.array(np.nan)
            wanted = shapes.get(field.name, ())
            huge = not (np.abs(number) < _HUGE).all()  # also NaN
            if number.shape != wanted or huge or isinstance(value, (bool, np.bool_)):
                raise ValueError(
                    f"{field.name} of a sensor is {short_repr(value)}: give {wanted or 'a number'}, "
                    f"finite and no more than {_HUGE:g}"
                )
            plain = number.tolist()
            plain = tuple(map(tuple, plain)) if number.ndim == 2 else tuple(plain) if wanted else plain
            object.__setattr__(self, field.name, plain)
        for name in ("rest", "pdc_rest", "pac_rest", "tdc_rest", "tac_rest"):
            counts = np.array(getattr(self, name))
            if not ((counts > 0) & (counts < FULL_SCALE)).all():
                raise ValueError(
                    f"{name} of a sensor is {short_repr(getattr(self, name))}: rest counts of 12 bits lie "
                    f"between 0 and {FULL_SCALE:g}"
                )
        if max(self.rest) <= 1:
            raise ValueError(
                f"rest of a sensor is {short_repr(self.rest)}: no electrode rests at more than one count, "
                f"these look normalised; give counts of 12 bits (times {FULL_SCALE:g})"
            )
        for names, fits, wanted in _LIMITS:
            for name in names.split():
                value = getattr(self, name)
                if not fits(value):
                    raise ValueError(f"{name} of a sensor is {short_repr(value)}: give {wanted}")

    @property
    def nelectrode(self) -> int:
        return len(self.rest)

    @property
    def temperature(self) -> float:
        """Temperature of the core at the reset [C]."""
        return float(temperature_from_counts(self.tdc_rest))

    @property
    def impedance(self) -> np.ndarray:
        """(n,) impedance at rest [ohm]."""
        return impedance_from_counts(self.rest)

    def electrode_noise(self, counts: ArrayLike) -> np.ndarray:
        """RMS noise [counts] of electrodes that read counts (..., n): the law, scaled to this sensor's."""
        return self._noise_factor() * electrode_noise(np.asarray(counts, float))

    def _noise_factor(self):
        return (
            np.ones(self.nelectrode)
            if self.noise is None
            else self.noise / electrode_noise(np.array(self.rest))
        )

    def numbers(self, film_rest: ArrayLike | None = None, heat: bool = False) -> np.ndarray:
        """(nnumber,) constants in the layout of an acquisition's state (`numbers_of` has the offsets).

        Args:
          film_rest: (n,) impedance of the film at rest [ohm]; None: this sensor's own.
          heat: whether a heat model computes the warm-up.
        """
        values = {
            "scale": np.ones(self.nelectrode) if film_rest is None else self.impedance / film_rest,
            "base": self.rest,
            "noise": self._noise_factor(),
            "mixing": self.mixing or np.eye(self.nelectrode),
            "mixed": float(bool(self.mixing)),
            "warm_share": self.warm_share or np.ones(self.nelectrode),
            "drift": np.full(self.nelectrode, self.drift),
            "saturated": self.saturation[0],
            "knee": self.saturation[1],
            "relax_fraction": self.relaxation[0],
            "relax_time": self.relaxation[1],
        }
        if heat:
            values["warm_up"] = 0.0
        return np.concatenate([np.ravel(values.get(name, getattr(self, name, 0))) for name in _ORDER])


_OF_ELECTRODES = ("rest", "noise", "mixing", "warm_share", "drift")  # fields, one number or row for each
_PER_ELECTRODE = ("scale", "base", "noise", "warm_share", "drift")
_ORDER = (
    *_PER_ELECTRODE, "mixing", "mixed", "pdc_rest", "pdc_gain", "pdc_noise", "pac_rest", "pac_noise",
    "pac_colour", "tdc_noise", "tac_rest", "tac_noise", "warm_up", "warm_time", "relax_fraction",
    "relax_time", "loss", "per_degree", "power", "saturated", "knee", "lowpass", "latency",
)  # fmt: skip


def numbers_of(nelectrode: int) -> tuple[dict[str, int], int]:
    """{name: offset} of the constants of a sensor with so many electrodes, and their number."""
    wide = {**dict.fromkeys(_PER_ELECTRODE, nelectrode), "mixing": nelectrode**2}
    ends = np.cumsum([wide.get(name, 1) for name in _ORDER]).tolist()
    return dict(zip(_ORDER, [0, *ends], strict=False)), ends[-1]


@functools.cache
def sensors_of(design: Design) -> dict[str, Sensor]:
    """The design's sensors, by name."""
    return {name: Sensor(**fields) for name, fields in design.sensors.items()}


def sensor_names(design: Design) -> tuple[str, ...]:
    """Names that `read_sensor` accepts for a design."""
    return (*design.sensors, *(["random"] if len(design.patterns) > 1 else []))


MEASURED = {name: fields for name, fields in BIOTAC.sensors.items() if name not in BIOTAC.published}
SENSORS, NAMES = sensors_of(BIOTAC), sensor_names(BIOTAC)


def draw_sensor(rng: np.random.Generator, design: Design = BIOTAC) -> Sensor:
    """A sensor drawn from the spread of the measured ones. Rest counts: mean pattern in ln Z plus a common
    and an individual deviation; noise: that of one of them, times a factor up to 1.2; scalars: uniform
    between the measured extremes; gains: 1 +- 0.1. The design's own sensor where fewer than two were
    measured."""
    n, known = design.nelectrode, sensors_of(design)
    if len(design.patterns) < 2:
        return known[design.sensor]
    measured = {name: fields for name, fields in design.sensors.items() if name not in design.published}
    log_z = np.array([log_impedance(known[name].rest) for name in design.patterns])
    common = log_z.mean(1).std(ddof=1)
    each = (log_z - log_z.mean(1, keepdims=True)).std(0, ddof=1)
    pattern = log_z.mean(0) + rng.normal(0, common) + rng.normal(0, 1, n) * each
    rest = np.clip(counts_from_impedance(1e4 * np.exp(pattern)), 100.0, 0.97 * FULL_SCALE)
    one = measured[list(measured)[rng.integers(len(measured))]]
    out = {"rest": rest, "noise": np.array(one["noise"]) * np.exp(rng.uniform(-1, 1) * np.log(1.2))}
    singles = sorted({name for fields in measured.values() for name in fields} - set(out))
    for name in singles:
        found = [fields[name] for fields in measured.values() if name in fields]
        out[name] = rng.uniform(min(found), max(found))
    out["warm_up"] = rng.uniform(0.0, max(f.get("warm_up", 0.0) for f in measured.values()))  # some are warm
    out["mixing"] = np.diag(np.exp(rng.normal(0, _GAIN, n)))
    return Sensor(**out)


def generator(seed: ArrayLike, what: int) -> np.random.Generator:
    """Random generator for purpose `what` of a sensor; seed: one or several whole numbers up to 2^64 - 1.

    Raises:
      ValueError: another seed.
    """
    words = np.ravel(np.asarray(seed, object))
    if not all(isinstance(word, (int, np.integer)) and 0 <= word < 2**64 for word in words):
        raise ValueError(f"seed is {short_repr(seed)}: pass whole numbers from 0 to 2**64 - 1")
    return np.random.default_rng([*map(int, words), what])


def read_sensor(value: str | Sensor | Mapping | None, seed: ArrayLike = 0, design: Design = BIOTAC) -> Sensor:
    """A sensor from a user's description.

    Args:
      value: a name of `sensor_names(design)`, or a dict of Sensor's fields, which override those of "like"
        (default: the design's own); None is the design's own.
      seed: of "random", whole numbers. design: of the fingertip.

    Raises:
      ValueError: an unknown name or field, an invalid number, or another number of electrodes.
    """
    if value is None:
        value = design.sensor
    if isinstance(value, Mapping):
        fields = dict(value)
        like = read_sensor(fields.pop("like", None), seed, design)
        refuse_unknown(fields, ["like", *(field.name for field in dataclasses.fields(Sensor))], "sensor")
        for name, value in fields.items():
            if name in _OF_ELECTRODES and np.ndim(value) and len(value):  # empty: as the design has it
                check_nelectrode(design, len(value), f"{name} of a sensor")
        return dataclasses.replace(like, **fields)
    if isinstance(value, Sensor):
        check_nelectrode(design, value.nelectrode, "a sensor")
        return value
    names = sensor_names(design)
    if not isinstance(value, str) or value not in names:
        for other in designs():
            if isinstance(value, str) and value in other.sensors:
                check_nelectrode(design, other.nelectrode, f"sensor {value!r}")
        of = "" if design.name == BIOTAC.name else f" of a {design.title}"
        raise ValueError(
            f"sensor{of} is {short_repr(value)}: pass one of {', '.join(map(repr, names))}, or a dict of "
            "numbers"
        )
    if value == "random":
        return draw_sensor(generator(seed, 0x5E), design)
    return sensors_of(design)[value]
