"""Reads a skin's material, options and modulus from names, dicts, arrays and files."""

import dataclasses
import json
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..fields import refuse_unknown
from ..geometry.skin_geometry import SkinGeometry
from ..reading import read_json, reading
from ..short_repr import short_repr
from .contact.law import ContactLaw
from .model import SkinOptions, filled
from .rubber.material import PRESETS, Material

_KEYS = ("skin", "modulus")


class Settings(NamedTuple):
    """Arguments of a SkinModel: Material, SkinOptions, factors on Young's modulus (or None)."""

    material: Material
    options: SkinOptions
    modulus: np.ndarray | Callable | None


def read_settings(
    material: Material | dict | str | pathlib.Path | None = None,
    options: dict | None = None,
    also: tuple = (),
    **defaults: object,
) -> Settings:
    """Settings of a skin.

    Args:
      material: see `read_material`.
      options: {"skin": {...} or SkinOptions, "modulus": see `read_modulus`}, a JSON text of it or a file.
      also: further keys of `options`, which the caller reads.
      defaults: of SkinOptions, for fields that `options` does not have.

    Raises:
      ValueError: unknown keys, or values that cannot be. FileNotFoundError: no such file.
    """
    given = read_dict(options, "options")
    refuse_unknown(given, (*_KEYS, *also), "options")
    skin = given.get("skin")
    if not isinstance(skin, SkinOptions):
        skin = SkinOptions(
            **{**defaults, **_known(read_dict(skin, "options['skin']"), SkinOptions, "options['skin']")}
        )
    rubber = read_material(material)
    return Settings(rubber, filled(skin, rubber), read_modulus(given.get("modulus")))


def read_material(choice: Material | dict | str | pathlib.Path | None) -> Material:
    """The Material of a preset's name, a dict of its fields, JSON text or file (as
    `biotac lab calibrate` writes), a Material, or None (the default).

    Raises:
      ValueError: `choice` is none of these.
      FileNotFoundError: the file does not exist.
    """
    if choice is None or isinstance(choice, Material):
        return choice or PRESETS["default"]
    if isinstance(choice, str) and choice in PRESETS:
        return PRESETS[choice]
    if isinstance(choice, str) and not choice.endswith(".json") and not choice.lstrip().startswith("{"):
        raise ValueError(
            f"unknown material {short_repr(choice)}: choose one of {', '.join(PRESETS)}, a .json file or a "
            "dict of Material's fields"
        )
    fields = read_dict(choice, "material")
    return Material(**_known(read_dict(fields.get("material", fields), "material"), Material, "material"))


def read_modulus(choice: ArrayLike | str | pathlib.Path | Callable | None) -> np.ndarray | Callable | None:
    """Factors on Young's modulus: (nelem,) numbers, a .npy file of them, a function of positions, or None.

    Raises:
      ValueError: not numbers. FileNotFoundError: no such file.
    """
    if choice is None or callable(choice):
        return choice
    if isinstance(choice, (str, pathlib.Path)):
        with reading(choice, "modulus", "write one factor per element with numpy.save"):
            choice = np.asarray(np.load(choice, allow_pickle=False), float)
    try:
        factors = np.asarray(choice, float)
    except (TypeError, ValueError, OverflowError):
        factors = np.array(np.nan)
    if factors.ndim != 1 or not (np.isfinite(factors) & (factors > 0)).all():
        raise ValueError(
            f"modulus is {short_repr(choice)}: pass a positive factor for each element, or a .npy file of "
            "them"
        )
    return factors


def read_dict(choice: dict | str | pathlib.Path | None, what: str) -> dict:
    """A dict, a JSON text of one ("{...}") or a file of it, as a dict; None is empty.

    Raises:
      ValueError: not JSON, or not a dict. FileNotFoundError: no such file.
    """
    if choice is None:
        return {}
    if isinstance(choice, (str, pathlib.Path)):
        text = str(choice)
        if not text.lstrip().startswith("{"):
            return read_json(text, what, "give a file of JSON, or the JSON itself")
        try:
            choice = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{what} is no JSON ({error}): write {{...}} with names in quotes") from None
    if not isinstance(choice, dict):
        raise ValueError(f"{what} is {type(choice).__name__}: pass a dict, or JSON of one")
    return dict(choice)


def plain(value: object, geometry: SkinGeometry | None = None) -> object:
    """Converts settings to JSON types: Materials, ContactLaws and SkinOptions to dicts, arrays to lists, and
    a function of positions to its values at the centroids of the geometry's elements."""
    if isinstance(value, SkinOptions):  # without defaults
        given = ((f.name, getattr(value, f.name), f.default) for f in dataclasses.fields(value))
        value = {name: one for name, one, default in given if one != default}
    if isinstance(value, (Material, ContactLaw)):
        value = dataclasses.asdict(value)
    if isinstance(value, dict):
        return {key: plain(one, geometry) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one, geometry) for one in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, pathlib.Path):
        return str(value)
    if callable(value) and geometry is not None:
        return np.asarray(value(geometry.vert[geometry.elem[:, :4]].mean(1)), float).tolist()
    return value


def _known(fields, kind, what):
    refuse_unknown(fields, [f.name for f in dataclasses.fields(kind)], what)
    return fields
