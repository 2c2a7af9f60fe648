"""What one sensor has of its own: rest counts, noise, levels, warm-up, gains; those of real sensors, and
draws from their spread.

The numbers of real sensors are read off recordings by `benchmarks/sensor_presets.py`; a recording without a
channel leaves that channel's default. Whoever names a sensor says `sensor=` a name of SENSORS, "random", or a
dict of fields of `Sensor` ("like": the name of another one); `read_sensor` reads it."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from biotac_mj.sensor.channels import (
    FULL_SCALE,
    NELECTRODE,
    PAC_COLOUR,
    PAC_NOISE,
    PAC_REST,
    PDC_REST,
    REST_COUNTS,
    REST_TEMPERATURE,
    TAC_REST,
    counts_from_impedance,
    counts_from_temperature,
    electrode_noise,
    impedance_from_counts,
    log_impedance,
    temperature_from_counts,
)

from ..shown import shown

__all__ = [
    "MEASURED",
    "MOST_LATENCY",
    "NAMES",
    "NNUMBER",
    "NUMBERS",
    "PER_DEGREE",
    "SENSORS",
    "Sensor",
    "draw_sensor",
    "generator",
    "read_sensor",
]

# [1/C] of ln Z: all electrodes answer the liquid's temperature by -6.4 to -7.8 % per degree in five sensors
PER_DEGREE = 0.071
MOST_LATENCY = 0.11  # [s] eleven frames
_HUGE = 1e9  # of any number of a sensor: beyond it sums of counts are no longer numbers
_EYE = tuple(map(tuple, np.eye(NELECTRODE).tolist()))
# Scatter of an electrode's gain: 3 to 15 % (`effects.sensing.Gain`); no recording has the state beside it.
_GAIN = 0.1


@dataclasses.dataclass(frozen=True)
class Sensor:
    """One sensor's own numbers. All counts are of 12 bits; rests are untouched and at the reset.

    Attributes:
      rest: (19,) of the electrodes. noise: (19,) RMS of theirs at rest; None: the law of `electrode_noise`.
      mixing: (19, 19), what the electrodes' changes of counts from rest are multiplied with: gains, dead
        taxels and cross-talk; () is one.
      pdc_rest, pdc_noise: of PDC [counts]; pdc_gain: of its change.
      pac_rest, pac_noise, pac_colour: level, and n[i] = colour n[i - 1] + noise white.
      tdc_rest, tdc_noise, tac_rest, tac_noise: of TDC and TAC.
      per_degree: by how much ln Z falls when the liquid is warmer [1/C].
      warm_up: how much warmer it gets after the reset [C], all electrodes with it; warm_time: of the
        exponential [s]; warm_share: (19,) of it that each electrode takes, below 0 the other
        way, () is all. A sensor with heat has
        its own time.
      relaxation: share and time [s] by which PDC answers pressure too much and comes back.
      loss: of the liquid [1/h]; drift: of the electrodes [counts/s], one or (19,).
      power: of the change of ln Z from rest. saturation: share and knee [counts]: of a change beyond the
        knee that share is lost. lowpass: time constant of the electrodes [s]. latency: theirs [s], to
        MOST_LATENCY.

    Raises:
      ValueError: a number that cannot be.
    """

    rest: tuple = tuple(REST_COUNTS["1"].tolist())
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
        shapes = {"rest": (19,), "noise": (19,), "mixing": (19, 19), "relaxation": (2,), "saturation": (2,)}
        shapes |= {"warm_share": (19,), "drift": np.shape(self.drift) and (19,)}
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
                    f"{field.name} of a sensor is {shown(value)}: give {wanted or 'a number'}, "
                    f"finite and no more than {_HUGE:g}"
                )
            plain = number.tolist()
            plain = tuple(map(tuple, plain)) if number.ndim == 2 else tuple(plain) if wanted else plain
            object.__setattr__(self, field.name, plain)
        for name in ("rest", "pdc_rest", "pac_rest", "tdc_rest", "tac_rest"):
            counts = np.array(getattr(self, name))
            if not ((counts > 0) & (counts < FULL_SCALE)).all():
                raise ValueError(
                    f"{name} of a sensor is {shown(getattr(self, name))}: rest counts of 12 bits lie "
                    f"between 0 and {FULL_SCALE:g}"
                )
        if max(self.rest) <= 1:
            raise ValueError(
                f"rest of a sensor is {shown(self.rest)}: no electrode rests at more than one count, "
                f"these look normalised; give counts of 12 bits (times {FULL_SCALE:g})"
            )
        share, knee = self.saturation
        limits = {
            **{f"{name}_noise": (0, None) for name in ("pdc", "pac", "tdc", "tac")},
            "loss": (0, None),
            "lowpass": (0, None),
            "latency": (0, MOST_LATENCY),
        }
        for name, (low, high) in limits.items():
            self._refuse(name, low <= getattr(self, name) <= (high or _HUGE), f"{low} or more", high)
        self._refuse("noise", min(self.noise or (0,)) >= 0, "0 or more each")
        for name in ("warm_time", "power"):
            self._refuse(name, getattr(self, name) > 0, "more than 0")
        self._refuse("pac_colour", 0 <= self.pac_colour < 1, "0 or more, less than 1")
        self._refuse("per_degree", self.per_degree != 0, "another number than 0")
        good = 0 <= self.relaxation[0] <= 1 and self.relaxation[1] > 0
        self._refuse("relaxation", good, "a share from 0 to 1 and a time of more than 0 s")
        good = 0 <= share <= 1 and knee > 0
        self._refuse("saturation", good, "a share from 0 to 1 and a knee of more than 0")

    def _refuse(self, name, good, wanted, most=None):
        if not good:
            more = "" if most is None else f", at most {most:g}"
            value = shown(getattr(self, name))
            raise ValueError(f"{name} of a sensor is {value}: give {wanted}{more}")

    @property
    def temperature(self) -> float:
        """Of its core at the reset [C]."""
        return float(temperature_from_counts(self.tdc_rest))

    @property
    def impedance(self) -> np.ndarray:
        """(19,) at rest [ohm]."""
        return impedance_from_counts(self.rest)

    def electrode_noise(self, counts: ArrayLike) -> np.ndarray:
        """RMS [counts] of electrodes that read counts (..., 19): the law, in proportion to this sensor's."""
        return self._noise_factor() * electrode_noise(np.asarray(counts, float))

    def _noise_factor(self):
        return (
            np.ones(NELECTRODE) if self.noise is None else self.noise / electrode_noise(np.array(self.rest))
        )

    def numbers(self, film_rest: ArrayLike | None = None, heat: bool = False) -> np.ndarray:
        """(NNUMBER,) as they lie in an acquisition's state (NUMBERS says where).

        Args:
          film_rest: (19,) what the film gives at rest [ohm]; None: this sensor's own.
          heat: whether a model of heat warms it up.
        """
        values = {
            "scale": np.ones(NELECTRODE) if film_rest is None else self.impedance / film_rest,
            "base": self.rest,
            "noise": self._noise_factor(),
            "mixing": self.mixing or _EYE,
            "mixed": float(bool(self.mixing)),
            "warm_share": self.warm_share or np.ones(NELECTRODE),
            "drift": np.full(NELECTRODE, self.drift),
            "saturated": self.saturation[0],
            "knee": self.saturation[1],
            "relax_share": self.relaxation[0],
            "relax_time": self.relaxation[1],
        }
        if heat:
            values["warm_up"] = 0.0
        return np.concatenate([np.ravel(values.get(name, getattr(self, name, 0))) for name in NUMBERS])


_WIDE = dict.fromkeys(("scale", "base", "noise", "warm_share", "drift"), NELECTRODE)
_WIDE["mixing"] = NELECTRODE**2
_ORDER = (
    *_WIDE, "mixed", "pdc_rest", "pdc_gain", "pdc_noise", "pac_rest", "pac_noise", "pac_colour",
    "tdc_noise", "tac_rest", "tac_noise", "warm_up", "warm_time", "relax_share", "relax_time", "loss",
    "per_degree", "power", "saturated", "knee", "lowpass", "latency",
)  # fmt: skip
_ENDS = np.cumsum([_WIDE.get(name, 1) for name in _ORDER]).tolist()
NUMBERS = dict(zip(_ORDER, [0, *_ENDS], strict=False))  # name -> where it begins
NNUMBER = _ENDS[-1]


# MEASURED by benchmarks/sensor_presets.py: single numbers, rest counts, noise; the published rest counts are
# "1" to "3". epfl_f1 was never untouched: its rest is extrapolated from light presses, and lies within 0.05
# in ln Z, RMS, of the published "1". epfl_f2 hung untouched beside it. phac_*: two of a gripper (PHAC-2)
# in the holds of a soft sponge; what PAC feels of the gripper is in its noise. btd_sp: a BioTac SP, a log.
_TABLE = """
epfl_f1 warm_up 5.92 warm_time 210
1944 3111 3116 2751 3117 2747 2464 2609 2632 2782 2328 3119 3166 2890 3161 2802 3026 3221 3262
6.19 3.88 2.84 3.39 2.45 3.38 6.34 6.39 6.1 6.72 5.5 3.39 2.54 2.81 2.1 3.24 8.67 2.41 1.57
epfl_f2 warm_up 5.34 warm_time 201
2202 3095 3151 2875 3090 2766 2302 2518 2502 2679 1995 3040 3089 2769 3061 2662 2926 3115 3156
5.9 2.93 2.54 3.8 2.82 4.14 5.86 5.53 5.53 4.98 6.03 3.16 2.84 4.29 2.98 4.55 3.9 2.72 2.2
phac_f0 pdc 1075 .26 tac 2062 .52 tdc 2067 .28 pac 2054.6 1.64 pac_colour .82
3312 3686 3683 3599 3676 3512 3296 3418 3393 3491 3157 3647 3676 3556 3662 3574 3616 3674 3622
.39 .48 .4 .46 .38 .45 .43 .39 .44 .48 .36 .43 .43 .37 .41 .36 .45 .43 .42
phac_f1 pdc 1069 .17 tac 2039 .49 tdc 1941 .17 pac 2030.8 1.67 pac_colour .83
3166 3613 3623 3514 3604 3427 3223 3337 3331 3431 3051 3601 3633 3523 3603 3492 3545 3618 3461
.36 .4 .37 .39 .39 .33 .33 .38 .38 .36 .33 .36 .41 .4 .4 .41 .34 .38 .36
btd_sp pdc 1326 .22 tac 2053.4 .55 tdc 1913.8 .22 pac 2038.6 3.84 pac_colour .26
3423 3590 3404 3542 3460 3320 3560 3454 3407 3213 3430 3570 3422 3319 3437 3401 3445 3428 2956
4.03 4.95 4.26 5.07 4.58 4.3 5.44 5.19 4.18 4.94 3.56 5.77 4.85 4.66 4.66 4.13 5.3 5.09 3.8
"""


def _read_table():
    """{name: fields of a Sensor}; a channel's two numbers are its rest and its noise."""
    out, lines = {}, [line.split() for line in _TABLE.strip().splitlines()]
    for head, *rows in zip(lines[::3], lines[1::3], lines[2::3], strict=True):
        fields = dict(zip(("rest", "noise"), (tuple(map(float, row)) for row in rows), strict=True))
        name, *words = head
        for word in words:
            if word[0].isalpha():
                keys = [f"{word}_rest", f"{word}_noise"] if word in ("pdc", "pac", "tac", "tdc") else [word]
            else:
                fields[keys.pop(0)] = float(word)
        out[name] = fields
    return out


MEASURED = _read_table()
SENSORS = {name: Sensor(rest=tuple(counts.tolist())) for name, counts in REST_COUNTS.items()}
SENSORS |= {name: Sensor(**fields) for name, fields in MEASURED.items()}
NAMES = (*SENSORS, "random")
# the SP's electrodes lie elsewhere, and "1" is epfl_f1 once more
_PATTERNS = [name for name in SENSORS if name not in ("btd_sp", "1")]


def draw_sensor(rng: np.random.Generator) -> Sensor:
    """A sensor from the spread of the measured ones. Rest counts: their mean pattern in ln Z, moved all
    together and each on its own as they differ; noise: that of one of them, times a factor up to 1.2; single
    numbers: evenly between the least and the most that was measured; gains: 1 +- 0.1."""
    log_z = np.array([log_impedance(SENSORS[name].rest) for name in _PATTERNS])
    common = log_z.mean(1).std(ddof=1)
    each = (log_z - log_z.mean(1, keepdims=True)).std(0, ddof=1)
    pattern = log_z.mean(0) + rng.normal(0, common) + rng.normal(0, 1, NELECTRODE) * each
    rest = np.clip(counts_from_impedance(1e4 * np.exp(pattern)), 100.0, 0.97 * FULL_SCALE)
    one = MEASURED[list(MEASURED)[rng.integers(len(MEASURED))]]
    out = {"rest": rest, "noise": np.array(one["noise"]) * np.exp(rng.uniform(-1, 1) * np.log(1.2))}
    singles = sorted({name for fields in MEASURED.values() for name in fields} - set(out))
    for name in singles:
        found = [fields[name] for fields in MEASURED.values() if name in fields]
        out[name] = rng.uniform(min(found), max(found))
    out["warm_up"] = rng.uniform(0.0, max(f.get("warm_up", 0.0) for f in MEASURED.values()))  # some are warm
    out["mixing"] = np.diag(np.exp(rng.normal(0, _GAIN, NELECTRODE)))
    return Sensor(**out)


def generator(seed: ArrayLike, what: int) -> np.random.Generator:
    """Draws `what` of a sensor: whole numbers up to 2^64 - 1, one or several, are its seed.

    Raises:
      ValueError: others.
    """
    words = np.ravel(np.asarray(seed, object))
    if not all(isinstance(word, (int, np.integer)) and 0 <= word < 2**64 for word in words):
        raise ValueError(f"seed is {shown(seed)}: pass whole numbers from 0 to 2**64 - 1")
    return np.random.default_rng([*map(int, words), what])


def read_sensor(value: str | Sensor | Mapping, seed: ArrayLike = 0) -> Sensor:
    """A sensor of what a user says.

    Args:
      value: a name of NAMES, or a dict of Sensor's fields, which change those of "like" (default "1").
      seed: of "random", whole numbers.

    Raises:
      ValueError: an unknown name or field, or a number that cannot be.
    """
    if isinstance(value, Sensor):
        return value
    if isinstance(value, Mapping):
        fields = dict(value)
        like = read_sensor(fields.pop("like", "1"), seed)
        known = [field.name for field in dataclasses.fields(Sensor)]
        unknown = [name for name in fields if name not in known]
        if unknown:
            raise ValueError(f"a sensor has no {unknown[0]!r}: choose from like, {', '.join(known)}")
        return dataclasses.replace(like, **fields)
    if not isinstance(value, str) or value not in NAMES:
        raise ValueError(
            f"sensor is {shown(value)}: pass one of {', '.join(map(repr, NAMES))}, or a dict of numbers"
        )
    if value == "random":
        return draw_sensor(generator(seed, 0x5E))
    return SENSORS[value]
