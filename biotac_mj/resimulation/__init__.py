"""Recordings of real sensors with the simulated skin beside them: what it was like under each reading."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from . import resimulate as resimulate
    from .resimulate import ResimulateOptions as ResimulateOptions

# the function keeps its place in the module of its name
_HOME = {"ResimulateOptions": ".resimulate", "resimulate": None}

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
