"""Tasks of two fingertips on a parallel gripper."""

from dm_control.utils import containers

from .suite import environment

__all__ = ["SUITE", "hold", "lift"]

SUITE = containers.TaggedTasks()


@SUITE.add("benchmarking")
def hold(**settings):
    """Hold an object whose weight changes."""
    from .hold import Hold

    return environment(Hold, **settings)


@SUITE.add("benchmarking")
def lift(**settings):
    """Lift an object of unknown mass."""
    from .hold import Lift

    return environment(Lift, **settings)
