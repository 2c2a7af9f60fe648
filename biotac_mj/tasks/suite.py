"""`load(domain, task)` as in `dm_control.suite`, for the tasks of this package."""

import functools
import importlib
import inspect
import typing

import numpy as np

from ..fields import as_real, as_whole, refuse_unknown
from ..short_repr import short_repr

if typing.TYPE_CHECKING:
    from dm_control import composer

    from .base import TouchTask

DOMAINS = ("finger", "gripper")


@functools.cache
def _environment_class():
    from dm_control import composer

    from . import copying

    class Environment(copying.Copyable, composer.Environment):
        arguments: dict  # of `environment`, for copies

        def step(self, action):
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

        def __reduce__(self):
            return functools.partial(environment, **self.arguments), (), copying.take_state(self)

    return Environment


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


def environment(
    task: "type[TouchTask]",
    environment_kwargs: dict | None = None,
    random: "int | np.random.RandomState | None" = None,
    time_limit: float | None = None,
    **settings: object,
) -> "composer.Environment":
    """A composer.Environment of a TouchTask class. A pickle or copy continues from the same state.

    Args:
      task: the class; settings: its arguments.
      random: seed or RandomState of episodes and noise.
      time_limit: length of an episode [s]; None takes the task's.
      environment_kwargs: further arguments of `composer.Environment`.

    Raises:
      ValueError: an invalid setting, or one that the task does not have.
    """
    refuse_unknown(settings, (*_settings(task), "random", "time_limit"), f"task_kwargs of {task.__name__}")
    if time_limit is not None:
        as_real("time_limit", time_limit, 0.0)
    if random is not None and not isinstance(random, np.random.RandomState):
        random = as_whole("random", random, 0, 2**32 - 1)
    _dict("biotac", settings.get("biotac"))
    more = _check_environment(environment_kwargs)
    made = task(**settings)
    # MuJoCo's own step: the readings after a step are those of the step, and the skin is solved under the
    # forces that act in it
    options = dict(recompile_mjcf_every_episode=False, strip_singleton_obs_buffer_dim=True, legacy_step=False)
    # sums of time steps may be too small by rounding
    limit = (made.seconds if time_limit is None else time_limit) - 1e-6
    env = _environment_class()(made, time_limit=limit, random_state=random, **options | more)
    env.arguments = dict(
        task=task, environment_kwargs=environment_kwargs, random=random, time_limit=time_limit, **settings
    )
    state = env.random_state.get_state()
    # the first episode compiles and draws noise that later ones do not: done here, so that a seed determines
    # an episode
    env.reset()
    env.random_state.set_state(state)
    return env


def _check_environment(given):
    """Further arguments of `composer.Environment`, with checked names and types."""
    from dm_control import composer

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


def _domain(name):
    if not isinstance(name, str) or name not in DOMAINS:
        raise ValueError(f"no domain {short_repr(name)}: choose one of {', '.join(DOMAINS)}")
    try:
        return importlib.import_module(f".domains.{name}", __package__)
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("dm_control"):
            raise
        raise ModuleNotFoundError(f"{error}: pip install 'biotac-mj[control]'", name=error.name) from error


def tasks() -> list[tuple[str, str]]:
    """All (domain, task) pairs."""
    return [(domain, task) for domain in DOMAINS for task in _domain(domain).SUITE]


def load(
    domain_name: str, task_name: str, task_kwargs: dict | None = None, environment_kwargs: dict | None = None
) -> "composer.Environment":
    """An environment: `load("finger", "press", task_kwargs={"random": 0})`.

    Args:
      domain_name, task_name: see `tasks()`, docs/lab/tasks.md.
      task_kwargs: random (seed), time_limit [s], observe ("tactile", "estimated", "privileged", "none"),
        physics_timestep [s], biotac (dict, settings of `BioTac`).
      environment_kwargs: further arguments of `composer.Environment`.

    Raises:
      ValueError: no such domain or task, or a setting that the task does not have.
    """
    suite = _domain(domain_name).SUITE
    if not isinstance(task_name, str) or task_name not in suite:
        raise ValueError(
            f"domain {domain_name!r} has no task {short_repr(task_name)}: choose one of {', '.join(suite)}"
        )
    settings = _dict("task_kwargs", task_kwargs)
    if "environment_kwargs" in settings or "task" in settings:
        raise ValueError("task_kwargs has environment_kwargs, or task: give them as arguments of their own")
    return suite[task_name](environment_kwargs=environment_kwargs, **settings)
