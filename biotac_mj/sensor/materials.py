"""Thermal properties of materials that a finger may touch: effusivity e = sqrt(k rho c) and temperature.

`material_of` finds a material by the words of a name ("car_sponge_101", "steel vase"). `read_thermal` reads a
user's description of a geom."""

import dataclasses
import difflib
import math
import re
import statistics
from collections.abc import Callable, Iterable, Mapping

from biotac_mj.sensor.channels import check_temperature

from ..geometry.assets import asset_path
from ..short_repr import short_repr

ROOM, SKIN = 23.0, 33.0  # [C] of objects in a room, of a living hand
# Limits of `read_thermal`: from below gases (air has 5.5 and 0.026) to above diamond (6e4 and 2300)
_EFFUSIVITY, _CONDUCTIVITY_RANGE = (1.0, 1e5), (1e-3, 1e4)
_HOTTEST = 4000.0  # [C] above every solid: hafnium carbonitride melts last, at about that


@dataclasses.dataclass(frozen=True)
class Material:
    """Thermal properties of a touched body.

    Attributes:
      name: of the material.
      conductivity: k [W/(m K)]; density: [kg/m^3]; heat: specific heat capacity [J/(kg K)].
      source: the kind of handbook with the three numbers (see the head of `assets/materials.txt`).
      temperature: before it is touched [C].
    """

    name: str
    conductivity: float
    density: float
    heat: float
    source: str = ""
    temperature: float = ROOM

    @property
    def effusivity(self) -> float:
        """sqrt(k rho c) [W s^0.5 / (m^2 K)]."""
        return math.sqrt(self.conductivity * self.density * self.heat)


_TEMPERATURES = {"ice": -1.0, "skin": SKIN}


def _read_table():
    materials, words, things = {}, {}, {}
    lines = asset_path("materials.txt").read_text(encoding="utf-8").splitlines()
    for line in (line for line in lines if not line.startswith("#")):
        name, numbers, synonyms, *made = (part.strip() for part in line.split("|"))
        k, density, heat, source = numbers.split()
        temperature = _TEMPERATURES.get(name, ROOM)
        materials[name] = Material(name, float(k), float(density), float(heat), source, temperature)
        for table, names in ((words, f"{name}, {synonyms}"), (things, ",".join(made))):
            for alias in filter(None, map(str.strip, names.split(","))):
                if table.setdefault(alias, name) != name:
                    raise ValueError(f"{alias!r} stands for {table[alias]} and for {name}: drop one")
    return materials, words, things


MATERIALS, *_NAMES = _read_table()
# Conductivity over effusivity in the table, in logarithms: for materials given by their effusivity only.
_CONDUCTIVITY = statistics.linear_regression(
    *zip(*((math.log(m.effusivity), math.log(m.conductivity)) for m in MATERIALS.values()), strict=True)
)


_NUMBERS = "dict(effusivity=, temperature=)"  # of heat, instead of a name


def material_of(name: str, choices: Iterable[str] = MATERIALS, numbers: str = _NUMBERS) -> Material:
    """The material in a name: the longest phrase of the table that it contains, among equals the last.

    Case, underscores, numbers after them and plurals are ignored: "acrylic_211", "Steel Vase" and
    "car_sponges" are found. A material has precedence over an object: a glass bottle is of glass, a bottle of
    polyethylene.

    Args:
      choices, numbers: suggestions of the error for an unknown name: names, and what to give instead.

    Raises:
      ValueError: the name has no known word, or another number or an "at", as of a temperature.
    """
    if re.search(r"[\d@°]|(?<![a-z])at(?![a-z])", re.sub(r"_\d+", "", name.lower())):
        raise ValueError(
            f"a material's name is {name!r}: give words alone, to thermal also 'steel at 40' [C]"
        )
    words = re.findall(r"[a-z]+", name.lower())
    for table in _NAMES:
        for length in range(len(words), 0, -1):
            for start in range(len(words) - length, -1, -1):
                phrase = " ".join(words[start : start + length])
                known = table.get(phrase) or table.get(phrase.removesuffix("s"))
                if known:
                    return MATERIALS[known]
    close = difflib.get_close_matches(name.lower(), choices, 1)
    names = f"did you mean {close[0]!r}? Or" if close else f"use one of {', '.join(choices)}, or"
    raise ValueError(f"no material is known by {name!r}: {names} give {numbers}")


def check_choices(value: object, read: Callable) -> None:
    """Raises ValueError if `read` rejects a value, or one of a list of choices."""
    for one in value if isinstance(value, (list, tuple)) and value else [value]:
        read(one)


def check_geoms(what: str, given: object, read: Callable) -> None:
    """Raises ValueError for anything but None or {geom's name: value that `read` accepts, or a list of
    choices}."""
    if not isinstance(given, dict | None) or not all(isinstance(name, str) for name in given or ()):
        raise ValueError(f"{what} is {short_repr(given)}: give a dict, of geoms' names")
    for value in (given or {}).values():
        check_choices(value, read)


def read_thermal(value: str | Material | Mapping) -> Material:
    """A material from a user's description of a geom.

    Args:
      value: a name for `material_of`, "name at 40" for another temperature [C], a `Material`, or a dict with
        any of: material (such a name), effusivity [W s^0.5 / (m^2 K)], conductivity [W/(m K)], temperature
        [C].
        An effusivity without a conductivity gets the typical one of the table's materials.

    Raises:
      ValueError: an unknown name or key, or an impossible number.
    """
    if isinstance(value, Material):
        return _checked(value)
    if isinstance(value, str):
        value = {"material": value}
    if not isinstance(value, Mapping) or not isinstance(value.get("material", ""), str):
        raise ValueError(f"thermal is {short_repr(value)}: give a material's name, or a dict of numbers")
    unknown = set(value) - {"material", "effusivity", "conductivity", "temperature"}
    if unknown or not {"material", "effusivity"} & set(value):
        raise ValueError(
            f"thermal has {', '.join(map(repr, value)) or 'nothing'}: give material or effusivity, and "
            "conductivity and temperature if need be"
        )
    if "material" in value:
        name, *at = re.split(r"\s+at\s+", value["material"], maxsplit=1, flags=re.IGNORECASE)
        if at and "temperature" in value:
            raise ValueError(f"thermal {dict(value)!r} has two temperatures: leave one of them out")
        value = {**value, "material": name} | ({"temperature": at[0]} if at else {})
    try:
        numbers = {key: float(value[key]) for key in value if key != "material"}
        if any(isinstance(value[key], bool) for key in numbers):
            raise TypeError
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"thermal {short_repr(dict(value))} holds something that is not a number") from None
    if not all(math.isfinite(x) for x in numbers.values()) or any(
        numbers.get(key, 1.0) <= 0 for key in ("effusivity", "conductivity")
    ):
        raise ValueError(
            f"thermal {dict(value)!r}: effusivity and conductivity must be positive, temperature finite"
        )
    material = material_of(value["material"]) if "material" in value else None
    temperature = numbers.get("temperature", material.temperature if material else ROOM)
    if not {"effusivity", "conductivity"} & set(numbers):
        return _checked(dataclasses.replace(material, temperature=temperature))
    e = numbers.get("effusivity") or material.effusivity
    slope, intercept = _CONDUCTIVITY
    k = numbers.get("conductivity") or max(
        math.exp(slope * math.log(e) + intercept), MATERIALS["air"].conductivity
    )
    # only the product of density and specific heat matters
    return _checked(Material("as given", k, 1000.0, e * e / k / 1000.0, "as given", temperature))


def _checked(material):
    """The material, after a check of its numbers."""
    check_temperature("temperature of a body", material.temperature, _HOTTEST, "no solid is hotter")
    for name, (least, most) in (("effusivity", _EFFUSIVITY), ("conductivity", _CONDUCTIVITY_RANGE)):
        value = getattr(material, name)
        if not least <= value <= most:
            raise ValueError(
                f"{name} of a body is {value:g}: give {least:g} to {most:g} in SI units (air to diamond)"
            )
    return material
