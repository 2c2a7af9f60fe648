"""The real-time tier: a skin that is linear but for its contact.

The names below load their modules when they are first used: the full tier takes its search for near geoms
from here, and nothing else."""

import typing

from ...lazy import lazy

if typing.TYPE_CHECKING:
    from .skin import CondensedSkin as CondensedSkin
    from .step import Memory as Memory
    from .step import Outcome as Outcome

_HOME = {"CondensedSkin": ".skin", "Memory": ".step", "Outcome": ".step"}

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
