"""Sensor classes with the interfaces of other frameworks: `mjlab` inside mujoco_warp's step, `isaaclab`
beside any physics that tells poses. Neither needs the framework."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from . import isaaclab as isaaclab
    from . import mjlab as mjlab

_HOME = {"isaaclab": None, "mjlab": None}

__all__ = list(_HOME)
__getattr__, __dir__ = lazy(__name__, _HOME)
