"""The tasks as Gymnasium environments: BioTac/Press-v0 and so on.

    biotac_mj.tasks.register()
    env = gymnasium.make("BioTac/Press-v0", observe="tactile")

`gymnasium.make("biotac_mj.tasks.environments:BioTac/Press-v0")` registers them too.
"""

import copy

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils import EzPickle

from ..fields import as_whole
from ..short_repr import short_repr
from ..view.offscreen import Offscreen, find_gl
from . import copying, load, tasks
from .biotac import TACTILE

IDS = {
    f"BioTac/{''.join(w.capitalize() for w in task.split('_'))}-v0": (domain, task)
    for domain, task in tasks()
}
_MADE_ANEW = ("suite", "_screen", "action_space", "observation_space", "_ezpickle_args", "_ezpickle_kwargs")


class BioTacEnv(gymnasium.Env, EzPickle):
    """A task of the suite: observations are a dict of float32 arrays, actions in [-1, 1], rewards in [0, 1].
    A pickle or copy continues its episode, with its own random generator.

    Args:
      domain, task: see `suite.tasks`.
      observe: "tactile", "estimated", "privileged" or "none".
      render_mode: None or "rgb_array", the camera `side`, with the available GL library.
      width, height: of a picture [pixel].
      settings: further arguments of the task (time_limit, physics_timestep, biotac ...).

    Raises:
      ValueError: no such task or preset; render_mode without a GL library.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 100}

    def __init__(
        self,
        domain: str,
        task: str,
        observe: str = "tactile",
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
        **settings: object,
    ):
        known = isinstance(render_mode, str) and render_mode in self.metadata["render_modes"]
        if render_mode is not None and not known:
            raise ValueError(f"unknown render_mode {short_repr(render_mode)}: choose rgb_array or None")
        EzPickle.__init__(self, domain, task, observe, render_mode, width, height, **settings)
        self.render_mode, self._screen = render_mode, None
        self._size = as_whole("width", width, 1), as_whole("height", height, 1)
        self.suite = load(domain, task, task_kwargs={"observe": observe, **settings})
        if render_mode is not None:
            self._screen = self._make_screen()
        action = self.suite.action_spec()  # all of them in [-1, 1]
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, action.shape, np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {
                name: gymnasium.spaces.Box(
                    *((0, 4095) if name.split("/")[-1] in TACTILE else (-np.inf, np.inf)),
                    spec.shape,
                    np.float32,
                )
                for name, spec in sorted(self.suite.observation_spec().items())
            }
        )

    def __getstate__(self) -> dict:
        now = {name: copy.deepcopy(value) for name, value in vars(self).items() if name not in _MADE_ANEW}
        suite_state = None if self.suite is None else copying.take_state(self.suite)
        return super().__getstate__() | {"now": now, "suite": suite_state}

    def __setstate__(self, state: dict) -> None:
        super().__setstate__(state)
        vars(self).update(copy.deepcopy(state["now"]))
        if state["suite"] is None:
            self.close()
            return
        copying.give_state(self.suite, state["suite"])
        if self._screen is not None:  # it belongs to the old model
            self._screen.close()
            self._screen = self._make_screen()

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        if seed is not None:
            seed = as_whole("seed", seed, 0, 2**32 - 1)
        self._open()
        super().reset(seed=seed)
        if seed is not None:
            self.suite.random_state.seed(seed)
        return self._observation(self.suite.reset()), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self._open()
        step = self.suite.step(action)
        ended = step.last() and step.discount == 0.0
        return self._observation(step), float(step.reward), bool(ended), bool(step.last() and not ended), {}

    def render(self) -> np.ndarray | None:
        if self._screen is None:
            return None
        physics, camera = self.suite.physics, mujoco.MjvCamera()
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, physics.model.camera("side").id
        return self._screen.render(physics.data.ptr, camera)

    def _make_screen(self):
        return Offscreen(self.suite.physics.model.ptr, *self._size, find_gl())

    def _open(self):
        if self.suite is None:
            raise ValueError("the environment is closed: make another one")

    def close(self) -> None:
        if self._screen is not None:
            self._screen.close()
            self._screen = None
        if self.suite is not None:
            self.suite.close()
            self.suite = None

    def _observation(self, step):
        return {name: np.asarray(step.observation[name], np.float32) for name in self.observation_space}


def register() -> list[str]:
    """Registers all tasks with Gymnasium; may be called repeatedly. Returns their ids."""
    for name, (domain, task) in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name, entry_point=f"{__name__}:BioTacEnv", kwargs={"domain": domain, "task": task}
            )
    return list(IDS)


register()
