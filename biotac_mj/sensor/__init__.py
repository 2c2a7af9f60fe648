"""The sensor beyond its skin: film, electrodes, pressure, heat, vibration; acquisition into counts."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .film import FilmConduction as FilmConduction
    from .presets import Sensor as Sensor
    from .readings import PhysicsReadings as PhysicsReadings

_HOME = {"FilmConduction": ".film", "PhysicsReadings": ".readings", "Sensor": ".presets"}

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
