"""The environment as RSL-RL and skrl take it; neither is a requirement."""

import typing

import numpy as np

if typing.TYPE_CHECKING:
    import rsl_rl.env
    import torch

    from .environment import RollRod

__all__ = ["rsl_rl_env", "skrl_env"]


def rsl_rl_env(env: "RollRod") -> "rsl_rl.env.VecEnv":
    """An `rsl_rl.env.VecEnv`: observations are a TensorDict with the environment's groups, of which
    `obs_groups` of the runner's configuration chooses ({"actor": ["body", "touch"], ...}).

    Raises:
      ModuleNotFoundError: RSL-RL is not there: pip install rsl-rl-lib.
    """
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict

    class Worlds(VecEnv):
        num_envs, num_actions = env.num_envs, env.num_actions
        max_episode_length, device, cfg = env.max_episode_length, env.device, env.cfg

        @property
        def episode_length_buf(self) -> "torch.Tensor":
            return env.episode_length_buf

        @episode_length_buf.setter
        def episode_length_buf(self, value):
            pass  # worlds begin together with the rod in its fixture: an episode has no other beginning

        def get_observations(self):
            return TensorDict(env.observe(), batch_size=[env.num_envs])

        def step(self, actions):
            observations, reward, terminated, truncated, extras = env.step(actions)
            found = TensorDict(observations, batch_size=[env.num_envs])
            return found, reward, (terminated | truncated).long(), extras

    return Worlds()


def skrl_env(env: "RollRod", touch: bool = True) -> object:
    """What `skrl.envs.wrappers.torch.wrap_env(..., wrapper="isaaclab")` takes: observations are
    {"policy": (num_envs, 99)}, or without touch (num_envs, 39).

    Raises:
      ModuleNotFoundError: Gymnasium is not there: pip install gymnasium.
    """
    import gymnasium
    import torch

    groups = ("body", "touch") if touch else ("body",)
    widths = {name: value.shape[1] for name, value in env.observe().items()}
    count = sum(widths[name] for name in groups)

    class Worlds:
        num_envs, device = env.num_envs, env.device
        max_episode_length, cfg = env.max_episode_length, env.cfg
        single_observation_space = {"policy": gymnasium.spaces.Box(-np.inf, np.inf, (count,), np.float32)}
        single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (env.num_actions,), np.float32)

        @property
        def unwrapped(self) -> "Worlds":
            return self

        def _policy(self, observations):
            return {"policy": torch.cat([observations[name] for name in groups], dim=1)}

        def reset(self, seed=None, options=None):
            observations, extras = env.reset(seed=seed)
            return self._policy(observations), extras

        def step(self, actions):
            observations, *rest = env.step(actions)
            return (self._policy(observations), *rest)

        def close(self):
            env.close()

    return Worlds()
