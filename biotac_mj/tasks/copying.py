"""What a copy of an environment goes on from: an environment that is pickled or copied is made anew of its
arguments, and then gets the state taken here."""

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

__all__ = ["Copyable", "give_state", "take_state"]

_COUNTERS = ("_reset_next_step", "_mjcf_never_compiled", "_fixed_random_state", "_time_limit")
_HOOKS = tuple(f"_{name}" for name in composer.HOOK_NAMES)
_OF_OBSERVABLE = ("enabled", "update_interval", "buffer_size", "delay", "rate", "lag")
_OF_READING = ("buffer", "update_schedule", "update_interval", "buffer_size", "delay")


class Copyable:
    """Mixin that makes a `composer.Environment` one that can be pickled and copied, and goes on from there:

        class Peg(biotac_mj.tasks.Copyable, composer.Environment):
            def __init__(self, seed=0):
                super().__init__(PegTask(), random_state=seed)

    A copy is made anew of the arguments of the class, which therefore must make its own task, and then gets
    the state (`take_state`). Arguments have to be copied and pickled themselves. What goes wrong in a BioTac
    while the model is compiled is raised with its cause.
    """

    def __new__(cls, *args: object, **settings: object):
        self = super().__new__(cls)
        self._made_of = args, settings
        return self

    def __init__(self, *args: object, **settings: object):
        with plugin.explained():
            super().__init__(*args, **settings)

    def reset(self) -> dm_env.TimeStep:
        with plugin.explained():  # composer compiles anew in every episode, unless told otherwise
            return super().reset()

    def __reduce__(self):
        args, settings = self._made_of
        return functools.partial(type(self), *args, **settings), (), take_state(self)

    def __setstate__(self, state: dict | None) -> None:
        give_state(self, state)

    def __copy__(self):
        return copy.deepcopy(self)  # two that shared a state would step each other


def take_state(env: composer.Environment) -> dict | None:
    """All that steps and episodes have changed: the physics with its model (time, the skins' memory, masses
    that an episode drew), the random generator, what tasks and entities note down (targets, beliefs, sensors
    drawn), observations on their way, hooks. None of a closed environment.

    Nothing of it is shared with the environment, but for hooks, which a pickle holds by their names.
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
        "notes": [copy.deepcopy(_notes(owner)) for owner in _owners(env.task)],
        "observables": {name: _settings(one) for name, one in env.task.observables.items()},
        "observed": _observed(env._observation_updater),
    }


def give_state(env: composer.Environment, state: dict | None) -> None:
    """Makes an environment of the same arguments go on from a state of `take_state`."""
    if state is None:
        env.close()
        return
    physics, data = env._physics, state["data"]
    physics._reload_from_data(wrapper.MjData(copy.deepcopy(data)))
    # what it computes while it loads goes: with it the next step would begin elsewhere
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
    # this episode observes what was enabled when it began
    for name, one in observables.items():
        one.enabled = name in state["observed"][1]
    env._observation_updater = env._make_observation_updater()
    env._observation_updater.reset(env._physics_proxy, env.random_state)
    _observe(env._observation_updater, state["observed"])
    for name, settings in state["observables"].items():
        observables[name].enabled = settings["enabled"]
    # last: readings draw noise, and bindings compute
    mujoco.mj_copyData(physics.data.ptr, physics.model.ptr, data)
    if (
        physics.legacy_step
    ):  # which ends with the first half of the next step: its skins are no data of MuJoCo
        mujoco.mj_step1(physics.model.ptr, physics.data.ptr)
    physics._dirty = state["dirty"]
    env.random_state.set_state(state["random"])


def _owners(task):
    """Who may note something down in an episode."""
    return [task, *task.root_entity.iter_entities()]


def _notes(owner):
    return {name: value for name, value in vars(owner).items() if _is_plain(value)}


def _is_plain(value):
    """Whether a value is numbers and texts alone: elements of the scene are made anew, and not copied."""
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
    """Of each observable of the episode what it goes by: its buffer, with what has not arrived yet, and when
    it is read."""
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
