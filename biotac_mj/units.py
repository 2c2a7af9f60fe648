"""Quantities with units: "1.5mm", "-12deg", or plain numbers in SI."""

import math
import re

from .short_repr import short_repr

# units of each kind in SI; the SI unit first, the usual unit second
UNITS = {
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6},
    "angle": {"rad": 1.0, "deg": math.pi / 180},
    "time": {"s": 1.0, "ms": 1e-3},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
}
SI = {kind: next(iter(units)) for kind, units in UNITS.items()}
_TEXT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s]*)\s*")


def read_quantity(name: str, value: object, kind: str) -> object:
    """A quantity in SI: number times unit for a text; other types are returned unchanged.

    Args:
      name: of the quantity, for messages. kind: of UNITS.

    Raises:
      ValueError: a text that is no number, or a unit of another kind.
    """
    if not isinstance(value, str):
        return value
    plain = value.replace("\u00b5", "u").replace("\u03bc", "u")  # the micro sign, the letter mu
    found, units = _TEXT.fullmatch(plain), UNITS[kind]
    if not found or found[2] not in ("", *units):
        usual = list(units)[1]
        raise ValueError(
            f"{name} is {short_repr(value)}: give a number with a unit, as in 2{usual} (of "
            f"{', '.join(units)}), or a plain number in {SI[kind]}"
        )
    return float(found[1]) * units.get(found[2], 1.0)


def number_of(text: str) -> float:
    """The number of a quantity that `read_quantity` takes, without its unit."""
    return float(_TEXT.fullmatch(text)[1])


def question(number: float, most: float, kind: str, least: float = -math.inf) -> str:
    """Question for messages whether a number outside least..most was meant in the usual unit or in that of
    SI; "" if neither is inside."""
    si, usual = list(UNITS[kind])[:2]
    meant = (unit for unit in (usual, si) if max(least, -most) <= number * UNITS[kind][unit] <= most)
    unit = next(meant, None)
    return f"did you mean {number:g}{unit}? " if unit else ""
