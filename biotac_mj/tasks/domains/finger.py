"""Tasks of one finger on a gantry."""

import typing

from dm_control.utils import containers

from ..suite import environment

if typing.TYPE_CHECKING:
    from dm_control import composer

SUITE = containers.TaggedTasks()


@SUITE.add("benchmarking", "easy")
def press(**settings: object) -> "composer.Environment":
    """Press to a target force."""
    from .press import Press

    return environment(Press, **settings)


@SUITE.add("benchmarking")
def follow_edge(**settings: object) -> "composer.Environment":
    """Follow the rim of a plate."""
    from .edge import FollowEdge

    return environment(FollowEdge, **settings)


@SUITE.add("benchmarking")
def roll_ball(**settings: object) -> "composer.Environment":
    """Roll a ball to a target."""
    from .roll import RollBall

    return environment(RollBall, **settings)


@SUITE.add("benchmarking", "hard")
def explore(**settings: object) -> "composer.Environment":
    """Classify the object under the finger as one of seventeen."""
    from .explore import Explore

    return environment(Explore, **settings)
