"""Recordings of real sensors with simulated skins: the deformation behind each reading."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from . import resimulate as resimulate
    from .resimulate import ResimulateOptions as ResimulateOptions

# so that the function, not its module, has the name
_HOME = {"ResimulateOptions": ".resimulate", "resimulate": None}

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
