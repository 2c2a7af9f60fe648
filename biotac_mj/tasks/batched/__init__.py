"""Tasks by touch for reinforcement learning in batches: many worlds in mujoco_warp, PyTorch tensors.

    env = make("insert_peg", num_envs=1024, observe="electrodes")
    observations, extras = env.reset()
    observations, reward, terminated, truncated, extras = env.step(actions)

`task` is their base class, `touch` the observations of touch, `libraries` has wrappers for RSL-RL, skrl and
Gymnasium."""

import inspect
import typing

from ...coupling.settings import SettingKeywords
from ...fields import check_choice, refuse_unknown
from .follow_edge import FollowEdge
from .insert_peg import InsertPeg
from .libraries import gymnasium_env, rsl_rl_env, skrl_env
from .roll_rod import RollRod
from .task import BatchTask, TaskSettings
from .touch import OBSERVE

__all__ = [
    "OBSERVE",
    "TASKS",
    "BatchTask",
    "FollowEdge",
    "InsertPeg",
    "RollRod",
    "TaskSettings",
    "gymnasium_env",
    "make",
    "rsl_rl_env",
    "skrl_env",
]

TASKS = {"roll_rod": RollRod, "insert_peg": InsertPeg, "follow_edge": FollowEdge}


def make(task: str, num_envs: int = 256, **keywords: typing.Any) -> BatchTask:
    """A task of TASKS; keywords as its class has them, or as `biotac_mj.batch.attach` has them for the
    BioTacs.

    Raises:
      ValueError: there is no such task. TypeError: there is no such keyword.
    """
    check_choice("no task", task, TASKS)
    try:
        refuse_unknown(keywords, _keywords(TASKS[task]), f"a call of make({task!r})")
    except ValueError as error:
        raise TypeError(str(error)) from None
    return TASKS[task](num_envs=num_envs, **keywords)


def _keywords(kind):
    """Keywords of a task's class: its own, those of all tasks, those of BioTacs, in this order."""
    own = [
        name
        for base in (kind, BatchTask)
        for name, one in inspect.signature(base).parameters.items()
        if name != "num_envs" and one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)
    ]
    return dict.fromkeys((*own, *SettingKeywords.__annotations__))
