"""`load(domain, task)` as in `dm_control.suite`, for the tasks of this package."""

import inspect

import dm_env
import numpy as np
from dm_control import composer

from ..fields import as_real, as_whole, check_choice, refuse_unknown
from ..short_repr import short_repr
from . import copying
from .base import TouchTask
from .domains.edge import FollowEdge
from .domains.explore import Explore
from .domains.hold import Hold, Lift
from .domains.press import Press
from .domains.roll import RollBall

_TASKS = {
    "finger": {"press": Press, "follow_edge": FollowEdge, "roll_ball": RollBall, "explore": Explore},
    "gripper": {"hold": Hold, "lift": Lift},
}


def _settings(task):
    """Argument names of a task's class: its own, and those of the base classes that take its remaining
    ones."""
    kinds, names = [k for k in task.__mro__ if "__init__" in vars(k)], []
    for kind in kinds:
        own = list(inspect.signature(kind.__init__).parameters.values())[1:]
        named = [p for p in own if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        # arguments that the subclass supplies to its base class
        names += [p.name for p in named if kind is kinds[0] or p.default is not p.empty]
        if not any(p.kind is p.VAR_KEYWORD for p in own):
            break
    return names


class Environment(copying.Copyable, composer.Environment):
    """The environment of a TouchTask class. A pickle or copy continues from the same state.

    Args:
      task: the class; settings: its arguments.
      random: seed or RandomState of episodes and noise.
      time_limit: length of an episode [s]; None takes the task's.
      environment_kwargs: further arguments of `composer.Environment`.

    Raises:
      ValueError: an invalid setting, or one that the task does not have.
    """

    def __init__(
        self,
        task: type[TouchTask],
        environment_kwargs: dict | None = None,
        random: int | np.random.RandomState | None = None,
        time_limit: float | None = None,
        **settings: object,
    ):
        refuse_unknown(
            settings, (*_settings(task), "random", "time_limit"), f"task_kwargs of {task.__name__}"
        )
        if time_limit is not None:
            as_real("time_limit", time_limit, 0.0)
        if random is not None and not isinstance(random, np.random.RandomState):
            random = as_whole("random", random, 0, 2**32 - 1)
        _dict("biotac", settings.get("biotac"))
        more = _check_environment(environment_kwargs)
        made = task(**settings)
        # MuJoCo's own step: the readings after a step are those of the step, and the skin is solved under the
        # forces that act in it
        options = dict(
            recompile_mjcf_every_episode=False, strip_singleton_obs_buffer_dim=True, legacy_step=False
        )
        # sums of time steps may be too small by rounding
        limit = (made.seconds if time_limit is None else time_limit) - 1e-6
        super().__init__(made, time_limit=limit, random_state=random, **options | more)
        state = self.random_state.get_state()
        # the first episode compiles and draws noise that later ones do not: done here, so that a seed
        # determines an episode
        self.reset()
        self.random_state.set_state(state)

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        shape = self.action_spec().shape
        try:
            good = np.shape(action) == shape and np.isfinite(action).all()
        except (TypeError, ValueError):
            good = False
        if not good:
            raise ValueError(
                f"the action is {short_repr(action)}: give {shape[0]} finite numbers in [-1, 1] "
                f"({', '.join(self.action_spec().name.split())})"
            )
        return super().step(np.asarray(action, float))


def _check_environment(given):
    """Further arguments of `composer.Environment`, with checked names and types."""
    given = _dict("environment_kwargs", given)
    known = inspect.signature(composer.Environment.__init__).parameters
    own = ("self", "task", "time_limit", "random_state")  # of task_kwargs
    refuse_unknown(given, [name for name in known if name not in own], "environment_kwargs")
    for name, value in given.items():
        if isinstance(known[name].default, bool) and not isinstance(value, bool):
            raise ValueError(f"{name} of environment_kwargs is {short_repr(value)}: give True or False")
        if name == "delayed_observation_padding" and not isinstance(value, type(known[name].default)):
            choices = ", ".join(map(str, type(known[name].default)))
            raise ValueError(f"{name} of environment_kwargs is {short_repr(value)}: give one of {choices}")
        if name in ("max_reset_attempts", "n_sub_steps") and value is not None:
            as_whole(f"{name} of environment_kwargs", value, 1)
    return given


def _dict(name, value):
    if not isinstance(value, (dict, type(None))) or not all(isinstance(key, str) for key in value or ()):
        raise ValueError(f"{name} is {short_repr(value)}: give a dict of names and values")
    return value or {}


def tasks() -> list[tuple[str, str]]:
    """All (domain, task) pairs."""
    return [(domain, task) for domain, known in _TASKS.items() for task in known]


def load(
    domain_name: str, task_name: str, task_kwargs: dict | None = None, environment_kwargs: dict | None = None
) -> Environment:
    """An environment: `load("finger", "press", task_kwargs={"random": 0})`.

    Args:
      domain_name, task_name: see `tasks()`, docs/lab/tasks.md.
      task_kwargs: random (seed), time_limit [s], observe ("tactile", "estimated", "privileged", "none"),
        physics_timestep [s], biotac (dict, settings of `BioTac`).
      environment_kwargs: further arguments of `composer.Environment`.

    Raises:
      ValueError: no such domain or task, or a setting that the task does not have.
    """
    check_choice("no domain", domain_name, _TASKS)
    known = _TASKS[domain_name]
    check_choice(f"domain {domain_name!r} has no task", task_name, known)
    settings = _dict("task_kwargs", task_kwargs)
    if "environment_kwargs" in settings or "task" in settings:
        raise ValueError("task_kwargs has environment_kwargs, or task: give them as arguments of their own")
    return Environment(known[task_name], environment_kwargs, **settings)
