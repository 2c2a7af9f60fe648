"""One press of an indenter into a BioTac: its path (`path`), the scene, the simulation (`pressing`), the
record and its files (`record`, `report`)."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .path import Path as Path
    from .path import PressOptions as PressOptions
    from .path import plan_path as plan_path
    from .pressing import PressResult as PressResult
    from .pressing import press as press
    from .pressing import render as render
    from .record import PressRecord as PressRecord
    from .record import write_readings as write_readings
    from .record import write_skin as write_skin
    from .report import write_picture as write_picture
    from .scene import build_scene as build_scene
    from .scene import see_through as see_through

__getattr__, __dir__ = lazy(__name__)
