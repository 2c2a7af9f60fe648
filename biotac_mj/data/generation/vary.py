"""Random skins, sensors and surfaces per interaction."""

import dataclasses
from typing import Any

import numpy as np

from ...effects.sensors import take_sensor
from ...geometry.design import BIOTAC, Design
from ...sensor.materials import read_thermal
from ...sensor.vibration import Modes, read_texture
from ...skin.per_world import NAMES
from ...skin.rubber.material import Material
from .readings import Sense

_NUMBERS = ("youngs_modulus", "poissons_ratio", "friction", "stiffening")
_FACTORS = ("prony", "hysteresis")
_WORLDS = tuple(name for name in NAMES if name != "modulus")


def check_vary(vary: dict) -> None:
    """Raises ValueError for unknown names and invalid intervals."""
    known = (*_NUMBERS, *_FACTORS, *_WORLDS)
    for name, interval in vary.items():
        if name not in known:
            raise ValueError(f"cannot vary {name!r}: choose from {', '.join(known)}")
        try:
            low, high = (float(v) for v in interval)
        except (TypeError, ValueError):
            low, high = np.nan, np.nan
        if not (np.isfinite([low, high]).all() and low <= high):
            raise ValueError(f"{name} varies over {interval!r}: pass (low, high), finite numbers")


def refuse_impossible(vary: dict, material: Material) -> None:
    """Raises ValueError for a property that this material lacks, and bounds that no material can have."""
    for name in _FACTORS:
        if name in vary and not getattr(material, name):
            raise ValueError(
                f"{name} varies but the material has none: give its terms in material, "
                "vary multiplies their g"
            )
    for end in (0, 1):
        ends = {name: interval[end] for name, interval in vary.items() if name in (*_NUMBERS, *_FACTORS)}
        _of_material(material, ends)


def _of_material(material, drawn):
    """The material with the random values."""
    changes = {name: drawn[name] for name in _NUMBERS if name in drawn}
    for name in _FACTORS:
        if name in drawn:
            changes[name] = tuple((drawn[name] * g, other) for g, other in getattr(material, name))
    return dataclasses.replace(material, **changes)


def draw_worlds(vary: dict, material: Material, seeds: list) -> tuple[list | None, dict, list]:
    """Skins of some interactions.

    Args:
      vary: {name: (low, high)}, see `GenerateOptions.vary`. material: of all, except for varied properties.
      seeds: of each interaction.

    Returns:
      materials of each (None if they are equal), {name: (k,)} for `make_worlds`, and [{name: value}].
    """
    drawn = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        drawn.append({name: float(rng.uniform(*vary[name])) for name in sorted(vary)})
    worlds = {name: np.array([one[name] for one in drawn]) for name in vary if name in _WORLDS}
    if not set(vary) - set(worlds):
        return None, worlds, drawn
    return [_of_material(material, one) for one in drawn], worlds, drawn


def draw_sense(options: Any, seed: list, modes: Modes | None, design: Design = BIOTAC) -> tuple[Sense, dict]:
    """Sensor and object of an interaction.

    Args:
      options: GenerateOptions: sensor, randomise, thermal, texture. seed: of the interaction. modes: of the
        skin, for vibration. design: of the sensor.

    Returns:
      Sense, and its random values: {"sensor": numbers, "thermal": value, "texture": value}.
    """
    sensor, _, open_ = take_sensor({"sensor": options.sensor, "randomise": options.randomise}, seed, design)
    drawn, rng = {}, np.random.default_rng(seed)
    if open_:
        drawn["sensor"] = {k: v for k, v in dataclasses.asdict(sensor).items() if v not in (None, ())}
    chosen = {}
    for name in ("thermal", "texture"):
        value = chosen[name] = getattr(options, name)
        if isinstance(value, (list, tuple)):
            drawn[name] = chosen[name] = value[rng.integers(len(value))]
    body = None if chosen["thermal"] is None else read_thermal(chosen["thermal"])
    surface = None if chosen["texture"] is None else read_texture(chosen["texture"])
    return Sense(sensor, body, surface, modes), drawn
