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
      source: the kind of handbook with the three numbers (see the table's head).
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


# Typical values. The last column names the handbook to check one in; they were not compared entry by entry.
# INC: Incropera and others, Fundamentals of Heat and Mass Transfer, tables A.1 to A.5 (300 K).
# ISO: EN ISO 10456, table 3. CRC: CRC Handbook of Chemistry and Physics. ASH: ASHRAE Handbook, Fundamentals.
# MAK: makers' usual data for the grade. CHO: Choi and Okos' formulas for food. MOR: Morton and Hearle,
# Physical Properties of Textile Fibres; fabrics are k of fibre and air at the named density. Densities of
# foams, fabrics and powders vary by a factor of two between goods, effusivities so by about 1.4.
_TABLE = """
steel             | 16.0   7900   490   INC | stainless, stainless steel
carbon steel      | 52     7850   470   INC | mild steel, tool steel | screwdriver, wrench
iron              | 55     7200   460   INC | cast iron
aluminium         | 167    2700   900   INC | aluminum, alu | can, foil
copper            | 390    8930   385   INC |
brass             | 110    8530   380   INC | bronze
zinc              | 112    7140   390   INC | zamak | die cast
titanium          | 17     4500   560   INC |
lead              | 35     11340  129   INC | solder
tin               | 65     7300   227   INC |
silver            | 425    10500  235   INC |
gold              | 315    19300  129   INC |
magnesium         | 100    1800   1020  INC |
nickel            | 90     8900   440   INC |
metal             | 50     7800   480   INC | metallic | keys, coin
steel wool        | 0.09   150    490   MAK | scourer, wire wool
acrylic           | 0.19   1190   1450  CRC | pmma, plexiglas, plexiglass, perspex
polycarbonate     | 0.20   1200   1200  ISO | pc | goggles
abs               | 0.17   1050   1400  MAK | toy brick | lego
polyethylene | 0.4 950 1900 ISO | hdpe, ldpe, pe, water bottle | cutting board, bottle, shampoo, dispenser
polypropylene     | 0.22   910    1800  ISO | pp | placemat
pvc               | 0.17   1390   900   ISO | vinyl, tarp, tarpaulin
polystyrene       | 0.16   1050   1300  ISO | ps
nylon             | 0.25   1150   1600  ISO | polyamide
acetal            | 0.30   1410   1400  ISO | pom, delrin
ptfe              | 0.25   2200   1000  ISO | teflon
pet               | 0.20   1380   1150  MAK | mylar, polyester film, petg
pla               | 0.13   1240   1800  MAK | polylactide
polyurethane      | 0.25   1200   1800  ISO | pu
epoxy             | 0.20   1200   1400  ISO | resin
plastic           | 0.20   1100   1450  ISO |  | container, case, box, toothpaste tube, laptop, tape
glass             | 1.0    2500   750   ISO | pyrex | window, jar, mirror, nail polish
ceramic | 1.5 2300 840 ISO | porcelain, stoneware, coffee mug, coffee cup | mug, cup, plate, tile
brick             | 0.8    1800   840   ISO | clay brick, terracotta
concrete          | 1.4    2200   880   INC | cement, mortar
stone             | 2.5    2600   900   ISO | rock, natural stone, pebble
asphalt           | 0.70   2100   1000  ISO | tarmac
granite           | 2.8    2630   775   INC |
marble            | 2.8    2680   830   INC | limestone
slate             | 2.2    2400   1000  ISO |
gypsum            | 0.25   900    1000  ISO | plaster, drywall, chalk
wood              | 0.16   600    1700  ISO | wooden, lumber | pencil, plank, bark, brush
oak               | 0.18   700    1700  ISO | hardwood, beech, maple, walnut, ash, birch, mahogany
pine              | 0.13   480    1700  ISO | softwood, spruce, fir, cedar
balsa             | 0.055  140    1700  INC |
bamboo            | 0.17   700    1700  MAK | sushi mat
plywood           | 0.13   500    1600  ISO |
fiberboard        | 0.14   700    1700  ISO | mdf, fibreboard, chipboard, particle board, hardboard
cork              | 0.045  160    1800  ISO | corkboard | coaster
layered cork      | 0.065  250    1800  ISO | agglomerated cork
paper | 0.12 800 1350 INC | sandpaper, card stock | notebook, book, notepad, envelope, index cards, magazine
cardboard         | 0.065  250    1400  MAK | carton, paperboard, corrugated
tissue            | 0.05   120    1350  MAK | toilet paper, napkin, paper towel | kitchen roll
leather           | 0.16   900    1500  ISO | suede | wallet, shoe, purse
rubber | 0.16 1100 1600 INC | hard rubber, tyre, tire, latex | eraser, basketball, ball, shelf liner, gum
silicone          | 0.25   1150   1250  MAK | silicone block, silly putty, putty
neoprene          | 0.055  170    1900  MAK | koozie | wetsuit, mouse pad
gel               | 0.55   1050   3900  CHO | gel pack, hydrogel
foam              | 0.038  30     1450  ISO | polyurethane foam, packaging foam | sofa, pillow
charcoal foam     | 0.036  30     1450  ISO | gray foam, grey foam, flat foam
hard foam         | 0.033  45     1450  ISO | xps, rigid foam, insulation board
styrofoam         | 0.036  25     1450  ISO | expanded polystyrene, eps, polystyrene foam
polyethylene foam | 0.045  35     1900  MAK | pool noodle, eva, eva foam, pe foam | yoga mat
bubble wrap       | 0.04   20     1900  MAK | bubble envelope, cushioned envelope
sponge            | 0.045  35     1450  MAK | car sponge, bath sponge, loofah, polyurethane sponge, bath puff
cellulose sponge  | 0.05   70     1350  MAK | kitchen sponge, dish sponge, scrubber, scouring pad
memory foam       | 0.04   50     1450  MAK |
cotton | 0.06 300 1300 MOR | fabric, cloth, textile, dishcloth, denim, canvas, linen | shirt, jeans, mitt
terry cloth       | 0.05   200    1300  MOR | towel, bath cloth, washcloth | sock
satin             | 0.07   400    1350  MOR | silk, polyester | pillowcase
wool              | 0.045  150    1350  MOR | fleece, yarn, pom pom | sweater, scarf
felt              | 0.05   200    1350  MOR | velvet
fur               | 0.04   80     1350  MOR | plush, stuffed, teddy, furry
carpet            | 0.06   200    1300  ISO | coir, coco liner | rug, doormat
velcro            | 0.08   300    1500  MAK | nylon bag, webbing | backpack
rope              | 0.07   500    1500  MAK |  | string, cord
flour             | 0.11   550    1750  CHO | starch, powder, cocoa, dry dough
sugar             | 0.21   850    1250  CHO |
salt              | 0.35   1200   870   CRC |
rice              | 0.12   800    1700  CHO | lentil, lentils, bean, beans, grain, cereal, wheat
sand              | 0.30   1550   800   INC |
soil              | 0.52   2050   1840  INC | earth, mud, clay
coffee            | 0.10   400    1700  CHO |
water             | 0.606  997    4180  INC |
ice               | 2.2    917    2050  INC |
oil               | 0.17   910    1950  CHO | butter, wax, candle, crayon
soap              | 0.25   1000   2000  MAK | toothpaste
dough             | 0.42   1100   2800  CHO | play doh, playdough, plasticine, modelling clay
fruit             | 0.50   950    3700  CHO | apple, orange, lemon, pear, tomato, banana, peach
vegetable         | 0.55   1050   3600  CHO | potato, carrot, cucumber, onion
meat              | 0.48   1060   3500  CHO | sausage, ham, fish
cheese            | 0.35   1080   2800  CHO |
bread             | 0.10   250    2700  CHO | toast, cake, bun
chocolate         | 0.20   1250   1700  CHO |
egg               | 0.50   1040   3300  CHO |
skin              | 0.37   1100   3400  INC | human skin | hand, finger, arm
bone              | 0.40   1900   1300  ASH |
graphite          | 120    2200   710   INC | carbon
silicon           | 148    2330   712   INC | wafer
quartz            | 1.4    2200   745   INC | fused silica
diamond           | 2300   3500   509   INC |
circuit board     | 0.30   1850   1100  MAK | pcb, fr4, fiberglass, fibreglass
air               | 0.026  1.16   1007  INC |
"""
_TEMPERATURES = {"ice": -1.0, "skin": SKIN}


def _read_table():
    materials, words, things = {}, {}, {}
    for line in _TABLE.strip().splitlines():
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
    """The material in a name: the longest phrase that the table knows, among equals the last.

    Case, digits, underscores and plurals are ignored: "acrylic_211", "Steel Vase" and "car_sponges" are
    found. A material has precedence over an object: a glass bottle is of glass, a bottle of polyethylene.

    Args:
      choices, numbers: suggestions of the error for an unknown name: names, and what to give instead.

    Raises:
      ValueError: the name has no known word.
    """
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


def material_named(name: str, choices: Iterable[str] = MATERIALS, numbers: str = _NUMBERS) -> Material:
    """`material_of` for a user's text, in which a temperature would be ignored.

    Raises:
      ValueError: no word is known, or the name has a number or an "at" ("acrylic_211" is a file's name).
    """
    if re.search(r"[\d@°]|(?<![a-z])at(?![a-z])", re.sub(r"_\d+", "", name.lower())):
        raise ValueError(
            f"a material's name is {name!r}: give words alone, to thermal also 'steel at 40' [C]"
        )
    return material_of(name, choices, numbers)


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
    material = material_named(value["material"]) if "material" in value else None
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
