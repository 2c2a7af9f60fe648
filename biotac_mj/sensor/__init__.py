"""The sensor's electronics and fluids: film, electrodes, pressure, heat, vibration, acquisition into
counts."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .film import FilmConduction as FilmConduction
    from .presets import Sensor as Sensor
    from .readings import PhysicsReadings as PhysicsReadings
    from .weighted import WeightedElectrodes as WeightedElectrodes

_HOME = {"FilmConduction": ".film", "PhysicsReadings": ".readings", "Sensor": ".presets"}
_HOME["WeightedElectrodes"] = ".weighted"

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
