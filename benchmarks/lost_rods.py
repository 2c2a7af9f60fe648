"""The rods that the in-hand task loses, played again by `mj_step`: dropped, or thrown by a skin of the batch?

    MENAGERIE_ROOT=DIR python benchmarks/lost_rods.py --worlds 1024 --device cuda:0 --json OUT
        [--decisions 18] [--seed 1]
    MENAGERIE_ROOT=DIR python benchmarks/lost_rods.py --worlds 2 --device cpu --decisions 3     # tries it

The worlds, actions and limit are those of in_hand_speed.py. Every step of all worlds is recorded. Then each
world that lost its rod (of none: the one whose rod is furthest off) is played in one world of `mj_step` with
its rod, friction and controls. A row of the JSON is a world:

  lost, mj_step   step in which the rod's middle is beyond the limit, in the batch and in mj_step; null: never
  apart_mm        largest distance of the two rods' middles until then
  force_n         forces of the three fingers there [N]
  speed           of the rod [m/s], at most until then"""

import argparse
import dataclasses
import math
import os
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parent))

import mujoco
import numpy as np

__all__ = ["main", "play", "record"]


def record(env: object, decisions: int, seed: int) -> tuple[dict, dict]:
    """Plays random actions from open fingers. Returns {name: (step, world, n)} of qpos, ctrl and force, and
    {world: step of its first decision's end without the rod}."""
    import torch

    env.reset(seed=seed)
    draw = torch.Generator(env.device).manual_seed(seed)
    seen, step = {"qpos": [env.qpos.clone()], "ctrl": [], "force": []}, env._run

    def watched():
        step()
        for name, now in (("qpos", env.qpos), ("ctrl", env._ctrl), ("force", env.force)):
            seen[name].append(now.clone())

    env._run, lost = watched, {}
    for decision in range(decisions):
        actions = 2 * torch.rand(env.num_envs, env.num_actions, generator=draw, device=env.device) - 1
        gone = env.step(actions)[2]
        for world in gone.nonzero()[:, 0].tolist():
            lost.setdefault(world, (decision + 1) * env.cfg.substeps)
    return {name: torch.stack(rows).cpu().numpy().astype(float) for name, rows in seen.items()}, lost


def play(env: object, world: int, start: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Positions (step, 3) of a world's rod by `mj_step`, with the task's fixture.

    Args:
      env: the RollRod of the batch. start: (nq,) positions. controls: (step, nu)."""
    from biotac_mj.tasks.batched.hand import build

    s, friction = env.cfg, next(iter(env.batches.values())).skin.geoms.struct.friction.numpy()[0]
    spec, _ = build(
        env._hand,
        s.timestep,
        False,
        skin="coarse",
        tier="condensed",
        friction=float(friction[world % len(friction)]),
        options={"loss": s.loss},
        readings=False,
    )
    model = spec.compile()
    rod, mass, inertia = model.body("rod").id, env._m.body_mass.numpy(), env._m.body_inertia.numpy()
    model.body_mass[rod], model.body_inertia[rod] = mass[world, rod], inertia[world, rod]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data, held = mujoco.MjData(model), env._held_at[world].cpu().numpy()
    data.qpos[:], spin, out = start, np.zeros(3), []
    pos, dof = slice(env._at, env._at + 3), model.joint("rod").dofadr[0]
    for control in controls:
        fraction = np.clip((s.release - data.time) / (s.release - s.hold), 0.0, 1.0)
        velocity = data.qvel[dof : dof + 6]
        mujoco.mju_rotVecQuat(spin, velocity[3:], data.qpos[env._at + 3 : env._at + 7])
        weight = model.body_mass[rod] * model.opt.gravity
        force = s.stiffness * (held - data.qpos[pos]) - s.damping * velocity[:3] - weight
        data.xfrc_applied[rod] = fraction * np.concatenate([force, -s.twist * spin])
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        out.append(data.qpos[pos].copy())
    return np.array(out)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--device", default="cuda:0", help="of Warp")
    parser.add_argument("--decisions", type=int, default=18, help="of ten steps")
    parser.add_argument("--seed", type=int, default=1, help="of rods' places and of actions")
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/lost_rods.json")
    options = parser.parse_args(arguments)
    from records import write_json

    from biotac_mj.tasks.batched.roll_rod import RollRod, Settings

    hand = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie"), "shadow_hand", "right_hand.xml")
    settings = dataclasses.replace(Settings(), prepare=0, decisions=50, gentle=math.inf)
    env = RollRod(hand, options.worlds, options.device, settings=settings)
    seen, lost = record(env, options.decisions, options.seed)
    rods, centre = seen["qpos"][..., env._at : env._at + 3], env._axes[2].cpu().numpy()
    steps = options.decisions * env.cfg.substeps
    furthest = int(np.linalg.norm(rods[-1] - centre, axis=1).argmax())
    rows = []
    for world, end in (lost or {furthest: steps}).items():
        played = play(env, world, seen["qpos"][0, world], seen["ctrl"][:end, world])
        own = rods[1 : end + 1, world]
        gone = [np.flatnonzero(np.linalg.norm(p - centre, axis=1) > env.cfg.lost) for p in (own, played)]
        first, other = (int(at[0]) if len(at) else None for at in gone)
        until = len(own) if first is None else first + 1
        apart = np.linalg.norm(own - played[: len(own)], axis=1)[:until].max()
        speed = np.linalg.norm(np.diff(own[:until], axis=0), axis=1).max() / env.cfg.timestep
        row = {"world": world, "lost": first, "mj_step": other, "apart_mm": 1e3 * float(apart)}
        row |= {"speed": float(speed), "force_n": seen["force"][until - 1, world].tolist()}
        rows.append(row)
        print(row, flush=True)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    found = {"device": options.device, "worlds": options.worlds, "seed": options.seed, "lost": len(lost)}
    write_json(options.json, found | {"rows": rows})
    return int(any(row["lost"] != row["mj_step"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
