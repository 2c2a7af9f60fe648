"""Settings as dicts and files give them: names that are known, values of the right type."""

import dataclasses
import difflib
import math
import numbers
import types
import typing
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from .short_repr import short_repr

_CALLED = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    dict: "a dict",
    tuple: "a list",
    list: "a list",
    type(None): "None",
}


def refuse_unknown(given: Iterable[str], known: Iterable[str], what: str) -> None:
    """Raises ValueError for unknown names, with the most similar known one."""
    known = list(known)
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise ValueError(f"{what} has {short_repr(name)}: {hint}choose from {', '.join(known)}")


def check_choice(what: str, value: object, known: Collection[str], more: str = "") -> None:
    """Raises ValueError for a value that is none of the known texts; more: what else can be given."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{what} {short_repr(value)}: choose one of {', '.join(known)}{more}")


def check_types(settings: object, names: Iterable[str] | None = None) -> None:
    """Raises ValueError for values of a dataclass that do not have the types of its fields.

    Args:
      names: of the fields; None: all.
    """
    for field in dataclasses.fields(settings):
        if names is None or field.name in names:
            _check(field.name, getattr(settings, field.name), field.type)


def either(name: str, value: object, given: object, where: str) -> object:
    """A setting with two sources: the argument `value`, or an entry of the dict `given`; None: not given.

    Raises:
      ValueError: both are given and differ.
    """
    other = given.get(name) if isinstance(given, Mapping) else None
    if value is None or other is None:
        return other if value is None else value
    if repr(value) != repr(other):  # arrays have no one truth
        raise ValueError(
            f"{name} is {short_repr(value)} and {where} has {short_repr(other)}: give one of them"
        )
    return value


def as_numbers(what: str, value: object) -> np.ndarray:
    """Converts to an array of floats; raises ValueError for anything else."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} is {short_repr(value)}: pass a number, or an array of them") from None


def as_real(what: str, value: object, least: float = -math.inf, above: bool = False, unit: str = "") -> float:
    """Converts to a finite number; raises ValueError for anything else, or below `least`; above: also for
    `least` itself. unit: for the message."""
    try:
        good = isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        good = False
    if not good or value < least or (above and value == least):
        more = "" if least == -math.inf else f" {'>' if above else '>='} {least:g}"
        unit = f" [{unit}]" if unit else ""
        raise ValueError(f"{what} is {short_repr(value)}: give a finite number{more}{unit}")
    return float(value)


def as_whole(what: str, value: object, least: int = -(2**31), most: int = 2**31 - 1) -> int:
    """Converts to an integer; raises ValueError for anything else, or outside [least, most]."""
    good = isinstance(value, numbers.Real) and not isinstance(value, bool) and value % 1 == 0
    if not good or not least <= value <= most:
        raise ValueError(f"{what} is {short_repr(value)}: give a whole number from {least} to {most}")
    return int(value)


def check_entries(what: str, given: object, wanted: Mapping[str, type], optional: Iterable = ()) -> dict:
    """Returns a dict after a check that it has the wanted entries with their types.

    Raises:
      ValueError: it is no dict, or an entry is missing or of another type.
    """
    if not isinstance(given, dict):
        raise ValueError(f"{what} is {short_repr(given)}: a dict is needed")
    missing = [name for name in wanted if name not in given and name not in optional]
    if missing:
        raise ValueError(f"{what} has no {', '.join(missing)}: add what is missing, or write it again")
    for name, kind in wanted.items():
        if name in given:
            _check(f"{name} of {what}", given[name], kind)
    return given


def _check(name, value, kind):
    if not _fits(value, kind):
        nan = isinstance(value, numbers.Real) and value != value
        called = "a finite number" if nan else _called(kind)
        raise ValueError(f"{name} is {short_repr(value)}: pass {called}")


def _fits(value, kind):
    parts = typing.get_args(kind)
    if isinstance(kind, types.UnionType):
        return any(_fits(value, one) for one in parts)
    if parts:  # tuple[int, ...], list[str], dict[str, float]
        inside = value.values() if isinstance(value, dict) else value
        return _fits(value, typing.get_origin(kind)) and all(_fits(one, _inside(parts)) for one in inside)
    if kind is float:
        return isinstance(value, numbers.Real) and not _is_flag(value) and _is_number(value)
    if kind is int:
        return isinstance(value, numbers.Integral) and not _is_flag(value)
    if kind is bool:
        return _is_flag(value)
    return isinstance(value, (tuple, list) if kind in (tuple, list) else kind or type(None))


def _inside(parts):
    """KIND of dict[str, KIND], list[KIND] or tuple[KIND, ...]."""
    return parts[0] if parts[-1] is Ellipsis else parts[-1]


def _is_flag(value):
    return isinstance(value, bool | np.bool_)


def _is_number(value):
    try:
        return not math.isnan(float(value))
    except OverflowError:
        return False


def _called(kind):
    parts = typing.get_args(kind)
    if isinstance(kind, types.UnionType):
        return " or ".join(_called(one) for one in parts)
    if parts:
        return f"{_CALLED[typing.get_origin(kind)]}, each {_called(_inside(parts))}"
    return _CALLED.get(kind, getattr(kind, "__name__", "None"))
