"""State of an environment for pickles and copies: an environment is made again from its arguments, then gets
this state."""

import copy
import functools
import numbers

import dm_env
import mujoco
import numpy as np
from dm_control import composer
from dm_control.mujoco import wrapper

from .. import plugin
from ..sensor.presets import Sensor

_COUNTERS = ("_reset_next_step", "_mjcf_never_compiled", "_fixed_random_state", "_time_limit")
_HOOKS = tuple(f"_{name}" for name in composer.HOOK_NAMES)
_OF_OBSERVABLE = ("enabled", "update_interval", "buffer_size", "delay", "rate", "lag")
_OF_READING = ("buffer", "update_schedule", "update_interval", "buffer_size", "delay")


class Copyable:
    """Mixin for a `composer.Environment` that can be pickled and copied in its current state:

        class Peg(biotac_mj.tasks.Copyable, composer.Environment):
            def __init__(self, seed=0):
                super().__init__(PegTask(), random_state=seed)

    A copy is made from the arguments of the class, which must therefore make its own task, and then gets the
    state (`take_state`). The arguments must be copyable and picklable. An error of a BioTac while the model
    is compiled is raised with its cause.
    """

    def __new__(cls, *args: object, **settings: object):
        self = super().__new__(cls)
        self._made_of = args, settings
        return self

    def __init__(self, *args: object, **settings: object):
        with plugin.explained():
            super().__init__(*args, **settings)

    def reset(self) -> dm_env.TimeStep:
        with plugin.explained():  # composer recompiles in every episode by default
            return super().reset()

    def __reduce__(self):
        args, settings = self._made_of
        if any(isinstance(value, composer.Task) for value in (*args, *settings.values())):
            raise TypeError(f"{type(self).__name__} was given its task: only one that it makes is copied")
        return functools.partial(type(self), *args, **settings), (), take_state(self)

    def __setstate__(self, state: dict | None) -> None:
        give_state(self, state)

    def __copy__(self):
        return copy.deepcopy(self)  # two with one state would step each other


def take_state(env: composer.Environment) -> dict | None:
    """All changes by steps and episodes: the physics with its model (time, the skins' memory, masses drawn in
    an episode), the random generator, attributes of tasks and entities (targets, beliefs, drawn sensors),
    pending observations, hooks. None for a closed environment.

    It shares nothing with the environment except hooks, which are pickled by name.
    """
    if env._physics is None:
        return None
    return {
        "data": copy.deepcopy(env._physics.data.ptr),
        "dirty": env._physics.is_dirty,
        "random": env.random_state.get_state(),
        "counters": {name: getattr(env, name) for name in _COUNTERS},
        "steps": env._hooks._episode_step_count,
        "hooks": {name: list(getattr(env._hooks, name).extra_hooks) for name in _HOOKS},
        "notes": [
            copy.deepcopy({name: value for name, value in vars(owner).items() if _is_plain(value)})
            for owner in _owners(env.task)
        ],
        "observables": {name: _settings(one) for name, one in env.task.observables.items()},
        "observed": _observed(env._observation_updater),
    }


def give_state(env: composer.Environment, state: dict | None) -> None:
    """Sets an environment with the same arguments to a state of `take_state`."""
    if state is None:
        env.close()
        return
    physics, data = env._physics, state["data"]
    physics._reload_from_data(wrapper.MjData(copy.deepcopy(data)))
    # results computed during loading are dropped, as the next step would start from them
    mujoco.mj_copyData(physics.data.ptr, physics.model.ptr, data)
    for owner, notes in zip(_owners(env.task), state["notes"], strict=True):
        vars(owner).update(copy.deepcopy(notes))
    for name, value in state["counters"].items():
        setattr(env, name, copy.deepcopy(value))
    env._hooks._episode_step_count = state["steps"]
    for name, hooks in state["hooks"].items():
        getattr(env._hooks, name).extra_hooks[:] = hooks
    observables = env.task.observables
    for name, settings in state["observables"].items():
        for key, value in settings.items():
            setattr(observables[name], key, value)
    # this episode observes what was enabled at its start
    for name, one in observables.items():
        one.enabled = name in state["observed"][1]
    env._observation_updater = env._make_observation_updater()
    env._observation_updater.reset(env._physics_proxy, env.random_state)
    _observe(env._observation_updater, state["observed"])
    for name, settings in state["observables"].items():
        observables[name].enabled = settings["enabled"]
    # last, because readings draw noise and bindings compute
    mujoco.mj_copyData(physics.data.ptr, physics.model.ptr, data)
    if (
        physics.legacy_step
    ):  # ends with the first half of the next step, because its skins are not in MuJoCo's data
        mujoco.mj_step1(physics.model.ptr, physics.data.ptr)
    physics._dirty = state["dirty"]
    env.random_state.set_state(state["random"])


def _owners(task):
    """Objects whose attributes may change in an episode."""
    return [task, *task.root_entity.iter_entities()]


def _is_plain(value):
    """Whether a value consists of numbers and texts: elements of the scene are made again, not copied."""
    if isinstance(value, dict):
        return all(_is_plain(key) and _is_plain(one) for key, one in value.items())
    if isinstance(value, (list, tuple, set, frozenset)):
        return all(map(_is_plain, value))
    plain = (numbers.Number, str, bytes, np.generic, Sensor, np.random.RandomState, np.random.Generator)
    return value is None or isinstance(value, plain) or type(value) is np.ndarray and value.dtype != object


def _settings(observable):
    out = {name: getattr(observable, name) for name in _OF_OBSERVABLE if hasattr(observable, name)}
    return out | ({"corruptor": None} if observable.corruptor is None else {})


def _observed(updater):
    """For each observable of the episode its buffer with pending values, and its schedule."""
    kept = {
        name: {key: getattr(one, key) for key in _OF_READING if not callable(getattr(one, key))}
        for name, one in updater._enabled_structure.items()
    }
    return copy.deepcopy((updater._step_counter, kept))


def _observe(updater, observed):
    updater._step_counter, kept = copy.deepcopy(observed)
    for name, settings in kept.items():
        for key, value in settings.items():
            setattr(updater._enabled_structure[name], key, value)
