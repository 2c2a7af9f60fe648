"""Effects of real sensors beyond the base model: one class per effect, its stage, and the catalogue."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .effect import Effect as Effect
    from .effect import Param as Param

__getattr__, __dir__ = lazy(__name__)
