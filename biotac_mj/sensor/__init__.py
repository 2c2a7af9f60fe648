"""The sensor's electronics and fluids: film, electrodes, pressure, heat, vibration, acquisition into
counts."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .film import FilmConduction as FilmConduction
    from .presets import Sensor as Sensor
    from .readings import PhysicsReadings as PhysicsReadings
    from .weighted import WeightedElectrodes as WeightedElectrodes

__getattr__, __dir__ = lazy(__name__)
