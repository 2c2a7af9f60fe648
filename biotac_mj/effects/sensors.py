"""Effects of a running simulated sensor, and random draws of them: domain randomisation with physical names.

The classes are those that `biotac diagnose` fits to data."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ..fields import as_real
from ..geometry.design import BIOTAC, Design
from ..sensor.presets import Sensor, generator, read_sensor
from ..short_repr import short_repr
from .effect import Effect
from .rubber import Relaxation
from .sensing import CrossTalk, DeadTaxels, Drift, FluidLoss, Gain, PressureGain, WarmUp

RANDOM = {
    effect.id: effect
    for effect in (
        Gain(),
        DeadTaxels(),
        CrossTalk(),
        PressureGain(),
        Relaxation(),
        WarmUp(),
        FluidLoss(),
        Drift(),
    )
}


def with_effects(sensor: Sensor, effects: list[tuple[Effect, dict]]) -> Sensor:
    """The sensor with effects [(Effect, theta)] that act in a running sensor (`Effect.in_sensor`)."""
    for effect, theta in effects:
        sensor = dataclasses.replace(sensor, **effect.in_sensor(sensor, theta))
    return sensor


def read_randomise(value: object) -> dict[str, float]:
    """{name of RANDOM: size} from names or such a dict; size 1 is a real sensor's.

    Raises:
      ValueError: an unknown name, or a size that is not a number >= 0.
    """
    if isinstance(value, (list, tuple)):
        value = dict.fromkeys(map(str, value), 1.0)
    if not isinstance(value, Mapping):
        raise ValueError(
            f"randomise is {short_repr(value)}: give names of {', '.join(RANDOM)}, or a dict of their sizes"
        )
    for name, size in value.items():
        if name not in RANDOM:
            raise ValueError(f"cannot randomise {short_repr(name)}: choose from {', '.join(RANDOM)}")
        as_real(f"size of {short_repr(name)} in randomise", size, 0.0)
    return dict(value)


def draw_effects(
    randomise: object, rng: np.random.Generator, design: Design = BIOTAC
) -> list[tuple[Effect, dict]]:
    """[(Effect, theta)] drawn for one sensor of a design; see `read_randomise`."""
    drawn = [(RANDOM[name].on(design), size) for name, size in read_randomise(randomise).items()]
    return [(effect, effect.draw(rng, size)) for effect, size in drawn]


def take_sensor(settings: dict, seed: ArrayLike = 0, design: Design = BIOTAC) -> tuple[Sensor, dict, bool]:
    """Sensor from the settings of readings.

    Args:
      settings: may have "sensor" (see `presets.read_sensor`) and "randomise" (see `read_randomise`).
      seed: of random draws, whole numbers. design: of the sensor.

    Returns:
      the sensor, the other settings, and whether the sensor depends on the seed.

    Raises:
      ValueError: an invalid name or number.
    """
    rest = {name: value for name, value in settings.items() if name not in ("sensor", "randomise")}
    choice, randomise = settings.get("sensor"), settings.get("randomise", {})
    effects = draw_effects(randomise, generator(seed, 0xEF), design)
    sensor = with_effects(read_sensor(choice, seed, design), effects)
    drawn = choice == "random" or (isinstance(choice, Mapping) and choice.get("like") == "random")
    return sensor, rest, bool(drawn or randomise)
