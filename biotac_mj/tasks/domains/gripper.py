"""Tasks of two fingertips on a parallel gripper."""

import typing

from dm_control.utils import containers

from ..suite import environment

if typing.TYPE_CHECKING:
    from dm_control import composer

SUITE = containers.TaggedTasks()


@SUITE.add("benchmarking")
def hold(**settings: object) -> "composer.Environment":
    """Hold an object whose weight changes."""
    from .hold import Hold

    return environment(Hold, **settings)


@SUITE.add("benchmarking")
def lift(**settings: object) -> "composer.Environment":
    """Lift an object of unknown mass."""
    from .hold import Lift

    return environment(Lift, **settings)
