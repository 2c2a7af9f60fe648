"""A task in the hand, for reinforcement learning in batches: a Shadow Hand rolls a rod between its thumb and
two fingers.

    env = RollRod("shadow_hand/right_hand.xml", num_envs=1024)
    observations, extras = env.reset()
    observations, reward, terminated, truncated, extras = env.step(actions)

`environment` has the environment, `scene` the model and where the hand begins, `libraries` what RSL-RL and
skrl ask of an environment.
"""

from .environment import RollRod
from .libraries import rsl_rl_env, skrl_env

__all__ = ["RollRod", "rsl_rl_env", "skrl_env"]
