"""Sensor classes with the interfaces of other frameworks: `mjlab` inside mujoco_warp's step, `isaaclab` with
any physics that supplies poses, and `ros`, which publishes a running simulation. All can be imported without
the framework."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from . import isaaclab as isaaclab
    from . import mjlab as mjlab
    from . import ros as ros

__getattr__, __dir__ = lazy(__name__)
