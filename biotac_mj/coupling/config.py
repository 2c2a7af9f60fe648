"""The settings of one BioTac, as they travel in a model: strings in the plugin instance's configuration."""

import dataclasses
import json
from collections.abc import Callable

__all__ = ["COUPLINGS", "PLUGIN_NAME", "TIERS", "Config"]

PLUGIN_NAME = "biotac_mj.skin"
COUPLINGS = ("two-way", "one-way")
TIERS = ("full", "condensed")


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of one BioTac.

    Attributes:
      skin: name or file of the `SkinGeometry`.
      stepper: what solves the skin: a name known to `biotac_mj.coupling.stepper`.
      tier: "full" finite elements, or "condensed" for real time on one CPU core (docs/condensed.md); the
        number of its place in TIERS is in the status sensor.
      readings: what turns the deformed skin into counts: a name known to `biotac_mj.coupling.stepper`.
      material: name of the skin's material, a dict of its parameters or a .json file; None is the default
        one.
      liquid: whether the space between skin and core is filled.
      coupling: "two-way" (the touching bodies and the BioTac feel the skin) or "one-way" (readings only).
      geoms: names of the geoms that touch; None is every colliding geom that is not on the BioTac's own
        links.
      rounding: geom name -> radius of its rounded edges [m].
      thermal: geom name -> material, for heat between the sensor and what it touches
        (`sensor.materials.read_thermal`); geoms that are not named are of plastic. None leaves heat out: TDC
        is constant.
      friction: the skin's Coulomb friction; MuJoCo's rule (larger one, or higher priority) combines it with
        the geom's. Default: the paper's 0.783 (Narang et al., ICRA 2021).
      priority: contact priority of the skin.
      seed: of the sensor's noise.
      device: Warp device of the skin.
      options: further settings: "skin" of SkinOptions, "modulus" of the elements (a list, or a .npy file),
        and "readings".
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
    friction: float = 0.783414394
    priority: int = 0
    seed: int = 0
    device: str = "cpu"
    options: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        if self.coupling not in COUPLINGS:
            raise ValueError(f"unknown coupling {self.coupling!r}: choose one of {', '.join(COUPLINGS)}")
        if self.tier not in TIERS:
            raise ValueError(f"unknown tier {self.tier!r}: choose one of {', '.join(TIERS)}")
        if self.tier != "full" and self.stepper != "fem":
            raise ValueError(
                f"tier {self.tier!r} is one of the FEM skin and the stepper is {self.stepper!r}: "
                "leave one of them out"
            )
        if self.thermal is None and self.options.get("readings", {}).get("cold"):
            raise ValueError("cold is of a sensor with heat: give thermal, {} if all is of plastic")
        if not self.friction >= 0:
            raise ValueError(f"the skin's friction is {self.friction}: give a number >= 0")
        if self.geoms is not None:
            object.__setattr__(self, "geoms", tuple(self.geoms))

    def strings(self) -> dict:
        """Attribute name -> JSON text; `parse` reads it back."""
        return {f.name: json.dumps(getattr(self, f.name)) for f in dataclasses.fields(self)}

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
