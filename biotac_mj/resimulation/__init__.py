"""Recordings of real sensors with simulated skins: the deformation behind each reading."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from . import resimulate as resimulate  # the module, which has a function of its name
    from .resimulate import ResimulateOptions as ResimulateOptions

__getattr__, __dir__ = lazy(__name__)
