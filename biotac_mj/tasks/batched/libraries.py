"""The environments as RSL-RL, skrl and Gymnasium take them; none of these is a requirement."""

import typing

import numpy as np
import torch

from .task import BatchTask

if typing.TYPE_CHECKING:
    import gymnasium
    import rsl_rl.env


def rsl_rl_env(env: BatchTask) -> "rsl_rl.env.VecEnv":
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
        def episode_length_buf(self) -> torch.Tensor:
            return env.episode_length_buf

        @episode_length_buf.setter
        def episode_length_buf(self, value):
            env.episode_length_buf[:] = value

        def get_observations(self):
            return TensorDict(env.observe(), batch_size=[env.num_envs])

        def step(self, actions):
            observations, reward, terminated, truncated, extras = env.step(actions)
            found = TensorDict(observations, batch_size=[env.num_envs])
            return found, reward, (terminated | truncated).long(), extras

        __reduce__ = BatchTask.__reduce__

    return Worlds()


def _policy(observations):
    """Observations (num_envs, n) of a policy."""
    return torch.cat([observations["body"], observations["touch"]], dim=1)


def _spaces(env):
    """Spaces of observations and actions of one world."""
    import gymnasium

    shape = _policy(env.observe()).shape[1:]
    act = gymnasium.spaces.Box(-1.0, 1.0, (env.num_actions,), np.float32)
    return gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32), act


def skrl_env(env: BatchTask) -> object:
    """Environment for `skrl.envs.wrappers.torch.wrap_env(..., wrapper="isaaclab")`: observations are
    {"policy": (num_envs, n)}, body and touch.

    Raises:
      ModuleNotFoundError: Gymnasium is not there: pip install gymnasium.
    """
    space, act = _spaces(env)

    class Worlds:
        num_envs, device = env.num_envs, env.device
        max_episode_length, cfg = env.max_episode_length, env.cfg
        single_observation_space = {"policy": space}
        single_action_space = act

        @property
        def unwrapped(self) -> "Worlds":
            return self

        def reset(self, seed=None, options=None):
            observations, extras = env.reset(seed=seed)
            return {"policy": _policy(observations)}, extras

        def step(self, actions):
            observations, *others = env.step(actions)
            return ({"policy": _policy(observations)}, *others)

        def close(self):
            env.close()

        __reduce__ = BatchTask.__reduce__

    return Worlds()


def gymnasium_env(env: BatchTask) -> "gymnasium.vector.VectorEnv":
    """A `gymnasium.vector.VectorEnv` with NumPy arrays: observations (num_envs, n), body and touch. Worlds
    that end begin anew in a step; its info has "success" and "error" of what was before, and theirs again in
    "final_info", with "final_obs". One seed is for all, reset at once; it is neither copied nor pickled.

    Raises:
      ModuleNotFoundError: Gymnasium is not there: pip install gymnasium.
      ValueError: of `reset`: a seed for each world, or options.
      TypeError: of a copy.
    """
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space

    space, act = _spaces(env)

    class Worlds(gymnasium.vector.VectorEnv):
        metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        num_envs = env.num_envs
        single_observation_space, single_action_space = space, act
        observation_space, action_space = (batch_space(one, env.num_envs) for one in (space, act))

        def reset(self, *, seed=None, options=None):
            if options:
                raise ValueError(f"options of reset are {sorted(options)}: pass none, all worlds are reset")
            return _policy(env.reset(seed=seed)[0]).cpu().numpy(), {}

        def step(self, actions):
            given = torch.as_tensor(np.asarray(actions, np.float32), device=env.device)
            observations, *others, extras = env.step(given)
            info = {name: extras[name].cpu().numpy() for name in ("success", "error")}
            if "final" in extras:
                done = (others[1] | others[2]).cpu().numpy()
                seen = _policy(extras["final"]).cpu().numpy()
                final = np.full(env.num_envs, None, object)
                for world in np.flatnonzero(done):
                    final[world] = seen[world]
                ended = {name: np.where(done, value, np.zeros_like(value)) for name, value in info.items()}
                ended |= {f"_{name}": done for name in info}
                info |= {"final_obs": final, "final_info": ended, "_final_obs": done, "_final_info": done}
            return (_policy(observations).cpu().numpy(), *(x.cpu().numpy() for x in others), info)

        __reduce__ = BatchTask.__reduce__

    return Worlds()
