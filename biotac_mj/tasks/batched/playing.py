"""Evaluation of policies: scores with intervals, in the environment that a policy's card describes."""

import importlib.resources
import pathlib
from collections.abc import Callable, Sequence

import torch
from scipy.stats import binomtest

from . import TASKS, make
from .policy import load_policy
from .task import BatchTask

HELD_OUT = 54321  # seed of beginnings that no policy learns from


def seen_by(env: BatchTask, observe: str, worlds: slice = slice(None)) -> torch.Tensor:
    """Inputs (n, k) of a policy: body and touch."""
    seen = env.observe(observe)
    return torch.cat([seen["body"], seen["touch"]], dim=1)[worlds]


def find_policy(task: str, policy: pathlib.Path | str | None = None) -> pathlib.Path:
    """Path of a policy of the task: None is the shipped one, a name another shipped one; anything else is a
    path.

    Raises:
      FileNotFoundError: the package ships no policy of this task, or this one of another.
    """
    name = task if policy is None else f"{task}-{policy}"
    assets = pathlib.Path(str(importlib.resources.files("biotac_mj.assets")))
    path = assets / "policies" / f"{name}.safetensors"
    if path.is_file():
        return path
    if policy is not None:
        others = [name for name in TASKS if (path.parent / f"{name}-{policy}.safetensors").is_file()]
        if others:
            raise FileNotFoundError(f"{policy} is a policy of {', '.join(others)}: play that")
        return pathlib.Path(policy)
    raise FileNotFoundError(
        f"no policy of {task} comes with this version: give --policy script, or --policy FILE that "
        f"`python -m biotac_mj.tasks.batched.training {task} --out FOLDER` wrote"
    )


def env_of(card: dict, num_envs: int, **changes: object) -> BatchTask:
    """The environment in which a policy learned.

    Args:
      card: the policy's card, or {"task": name}.
      changes: keywords of `make` that replace those of the card.
    """
    full_card = {"biotac": {"sensor": "random"}} | card
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in full_card.get("settings", {}).items()}
    if settings:
        changes = {"settings": type(TASKS[card["task"]].settings)(**settings)} | changes
    own = {name: card[name] for name in ("observe", "history") if name in card}
    return make(card["task"], num_envs, **own | full_card["biotac"] | changes)


def acting(task: str, policy: pathlib.Path | str | None, device: str) -> tuple[str, Callable, dict]:
    """Observation of a policy, a function (env) -> actions (num_envs, num_actions), and its card.

    Args:
      policy: a file, None or a word (`find_policy`), "script", which uses the true state, or "random".
    """
    if policy == "script":
        return "none", lambda env: env.script(), {"task": task}
    if policy == "random":
        draw = torch.Generator(device).manual_seed(0)
        shape = dict(generator=draw, device=device)
        return "none", lambda env: 2 * torch.rand(env.num_envs, env.num_actions, **shape) - 1, {"task": task}
    network, card = load_policy(find_policy(task, policy), device)
    if card["task"] != task:
        raise ValueError(f"{policy} is a policy of {card['task']}: play that, or give one of {task}")
    return card["observe"], lambda env: network(seen_by(env, card["observe"])), card


@torch.no_grad()
def play(env: BatchTask, acts: Sequence[tuple[slice, Callable]], seed: int = HELD_OUT) -> list[dict]:
    """Plays an episode in each world, from random initial states and new grips, by `seed`.

    Args:
      acts: [(worlds, policy)]; a policy is a function of the environment to the actions of all or of these
        worlds.

    Returns:
      for each {"success", "low", "high" (Wilson, 95 %), "episodes", "held", "error"}.
    """
    if env.cfg.prepare:
        env.prepare_held(seed=seed)
    env.reset(seed=seed + 1)
    over, success, held = (torch.zeros(env.num_envs, dtype=torch.bool, device=env.device) for _ in range(3))
    error = torch.zeros(env.num_envs, device=env.device)
    for _ in range(env.max_episode_length):
        actions = torch.zeros(env.num_envs, env.num_actions, device=env.device)
        for worlds, policy in acts:
            actions[worlds] = policy(env)
        _, _, terminated, truncated, extras = env.step(actions)
        now = (terminated | truncated) & ~over
        success, held = success | extras["success"] & now, held | truncated & now
        error = torch.where(now, extras["error"], error)
        over |= now
    return [_score(success[w], held[w], error[w]) for w, _ in acts]


def _score(success, held, error):
    off = float(error[held].mean()) if held.any() else None
    more = {"held": int(held.sum()) / len(success), "error": off}
    return interval(int(success.sum()), len(success)) | more


def interval(hits: int, episodes: int) -> dict:
    """{"success", "low", "high" (Wilson, 95 %), "episodes"} of so many successes."""
    low, high = binomtest(hits, episodes).proportion_ci(method="wilson")
    return {"success": hits / episodes, "low": float(low), "high": float(high), "episodes": episodes}


def agree(score: dict, card: dict) -> bool | None:
    """Whether the intervals of two scores meet; None where the card has none."""
    if "low" not in card:
        return None
    return score["low"] <= card["high"] and card["low"] <= score["high"]
