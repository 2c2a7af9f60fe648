"""The settings of one BioTac, as they travel in a model: strings in the plugin instance's configuration."""

import dataclasses
import json
import zlib
from collections.abc import Callable

import mujoco
import numpy as np

from ..fields import as_real, as_whole, check_choice, check_types, refuse_unknown
from ..short_repr import short_repr

OWN = 1 << 30  # bit of contype and conaffinity that BioTacs alone have
SOLID = 1 | OWN  # contype and conaffinity of core, nail and clamp: MuJoCo's default, and other BioTacs'
TO_COME = 64  # bodies that a BioTac makes room for beyond those it sees: a place costs 60 kB, 0.2 us a step
PLUGIN_NAME = "biotac_mj.skin"
COUPLINGS = ("two-way", "one-way")
TIERS = ("full", "condensed")
ON_ERROR = ("warn", "raise")
_OPTIONS = ("skin", "modulus", "film", "readings", "rounds", "threads", "loss")
_PLAIN = "skin stepper readings device name liquid rounding options thermal textures".split()
ROUNDS = 16  # of a skin in two-way coupling, in a step


def collides(geom: mujoco.MjsGeom, mask: int = SOLID) -> bool:
    """Whether a geom of a spec meets geoms whose contype and conaffinity are `mask`, by MuJoCo's rule."""
    return bool(geom.contype & mask or mask & geom.conaffinity)


def _plain(value):
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise ValueError(f"a BioTac's setting holds {short_repr(value)}: give numbers, texts, lists and dicts")


def refuse_two_way(coupling: str, options: dict) -> None:
    """Raises ValueError for a number of rounds, or of threads, or a loss, of a skin that has none."""
    reasons = {"rounds": "solved once a step", "threads": "solved by itself", "loss": "no force on bodies"}
    for name, why in reasons.items():
        if coupling == "one-way" and name in options:
            raise ValueError(f"{name} of options is of coupling='two-way': one-way a skin is {why}")


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of one BioTac, as `Settings` has them, with the material's choices in their places.

    Attributes:
      skin: name or file of the `SkinGeometry`.
      stepper, readings: names known to `biotac_mj.coupling.stepper`: what solves the skin, and what turns it
        into counts.
      tier: see `SkinSettings`; the number of its place in TIERS is in the status sensor.
      material: name of the skin's material, a dict of its parameters or a .json file; None is the default
        one.
      liquid: whether the space between skin and core is filled.
      coupling, geoms, rounding, priority: see `ContactSettings`.
      thermal, textures: see `SensorSettings`; geoms that are not named are of plastic, and smooth.
      friction: the skin's Coulomb friction; MuJoCo's rule (larger one, or higher priority) combines it with
        the geom's. Default: the paper's 0.783 (Narang et al., ICRA 2021).
      seed: of the sensor's noise, and of what is drawn. name: of the sensor; sensors of one seed that have
        other names are drawn apart.
      device: Warp device of the skin.
      options: of the keyword `options`, by part: "skin", "modulus" (a list, or a .npy file), "film",
        "readings" with the sensor in it, "loss", "rounds" and "threads". In two-way coupling a skin is
        solved at most "rounds" times in a step (default: 16). A smaller number limits the cost of a step; if
        bodies and skin then do not reach an equilibrium, the last model acts. `mj_step` solves several skins
        together, with the largest of their numbers of rounds and of threads (default: 1).
      on_error: effect of an exception inside `mj_step`: "warn" warns, keeps it for `plugin.check()` and
        continues without this skin's force, with status -1; "raise" raises it once MuJoCo has returned.
    """

    skin: str = "default"
    stepper: str = "fem"
    tier: str = "full"
    readings: str = "biotac"
    material: str | dict | None = None
    liquid: bool = True
    coupling: str = "two-way"
    geoms: tuple | None = None
    rounding: dict = dataclasses.field(default_factory=dict)
    thermal: dict | None = None
    textures: dict | None = None
    friction: float = 0.783414394
    priority: int = 0
    seed: int = 0
    name: str = ""
    device: str = "cpu"
    options: dict = dataclasses.field(default_factory=dict)
    on_error: str = "warn"

    def __post_init__(self):
        for name, choices in (("coupling", COUPLINGS), ("tier", TIERS), ("on_error", ON_ERROR)):
            check_choice(f"unknown {name}", getattr(self, name), choices)
        check_types(self, _PLAIN)
        if self.tier != "full" and self.stepper != "fem":
            raise ValueError(
                f"tier {self.tier!r} is one of the FEM skin and the stepper is {self.stepper!r}: "
                "leave one of them out"
            )
        if self.geoms is not None:
            numpys = isinstance(self.geoms, np.ndarray) and self.geoms.ndim == 1
            listed = isinstance(self.geoms, (list, tuple, set)) or numpys
            if not listed or not all(isinstance(name, str) and name for name in self.geoms):
                raise ValueError(f"geoms is {short_repr(self.geoms)}: give a list of names")
            self._set("geoms", tuple(dict.fromkeys(self.geoms)))
        for name in ("rounding", "thermal", "textures"):
            if not all(isinstance(geom, str) and geom for geom in getattr(self, name) or ()):
                raise ValueError(f"{name} is {short_repr(getattr(self, name))}: give a dict, of geoms' names")
        self._set("friction", as_real("the skin's friction", self.friction, 0.0))
        self._set("priority", as_whole("priority", self.priority))
        self._set("seed", as_whole("seed", self.seed, 0, 2**64 - 1))
        self._set("rounding", {k: as_real(f"rounding of {k!r}", v, 0.0) for k, v in self.rounding.items()})
        if self.stepper == "fem":  # others have options of their own
            refuse_unknown(self.options, _OPTIONS, "options")
            as_whole("rounds of options", self.rounds, 1, 1000)
            as_whole("threads of options", self.threads, 1, 1000)
            as_real("loss of options", self.loss, 0.0)
            refuse_two_way(self.coupling, self.options)
            readings = self.options.get("readings")
            if self.thermal is None and isinstance(readings, dict) and readings.get("cold"):
                raise ValueError("cold needs a sensor with heat: give thermal, {} if all is of plastic")

    @property
    def rounds(self) -> int:
        """Largest number of solves of the skin in a step."""
        return self.options.get("rounds", ROUNDS)

    @property
    def loss(self) -> float:
        """Loss factor of the rubber at 50 Hz."""
        from ..sensor.vibration import LOSS_FACTOR  # which loads Warp

        return self.options.get("loss", LOSS_FACTOR)

    @property
    def threads(self) -> int:
        """In how many threads the skins of a scene are solved."""
        return self.options.get("threads", 1)

    def own_seed(self, seed: int | None = None) -> list[int]:
        """Seed of this sensor's random draws: `seed`, or the configured one, and its name."""
        return [self.seed if seed is None else int(seed), zlib.crc32(self.name.encode())]

    def noise_seed(self, seed: int | None = None) -> int:
        """Seed of this sensor's noise, below 2^64: `seed`, or the configured one, below a word of its name,
        so that sensors of one seed have noise of their own. The default name's word is zero."""
        word = zlib.crc32(self.name.encode()) ^ zlib.crc32(b"biotac_")
        return (self.own_seed(seed)[0] + (word << 32)) % 2**64

    def _set(self, name, value):
        object.__setattr__(self, name, value)

    def strings(self) -> dict:
        """Attribute name -> JSON text, NumPy's numbers and arrays as plain ones; `parse` reads it back."""
        return {f.name: json.dumps(getattr(self, f.name), default=_plain) for f in dataclasses.fields(self)}

    @classmethod
    def parse(cls, read: Callable[[str], str]) -> "Config":
        """Settings from read(attribute) -> text, "" where the model gives none.

        Raises:
          ValueError: a text is not JSON, or a value is not allowed.
        """
        values = {}
        for field in dataclasses.fields(cls):
            text = read(field.name)
            if text:
                try:
                    values[field.name] = json.loads(text)
                except json.JSONDecodeError as error:
                    raise ValueError(
                        f"plugin setting {field.name}={text!r} is not JSON ({error}): "
                        "strings need quotes, as in '\"default\"'"
                    ) from error
        return cls(**values)
