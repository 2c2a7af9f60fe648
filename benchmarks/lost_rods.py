"""The rods that the in-hand task loses, played again by `mj_step`: dropped, or thrown by a skin?

    MENAGERIE_ROOT=DIR python benchmarks/lost_rods.py --worlds 1024 --device cuda:0 --json OUT
        [--decisions 18] [--seed 1]
    MENAGERIE_ROOT=DIR python benchmarks/lost_rods.py --worlds 2 --device cpu --decisions 3     # tries it

The worlds, actions and limit are those of in_hand_speed.py. Every step of all worlds is recorded. Then each
world that lost its rod (of none: the one whose rod is furthest off) is played in one world of `mj_step` with
its rod, friction and controls, without the batch's single precision and limit of work. `thrown` of the JSON
is the number of rods that `mj_step` keeps; the others are dropped by the actions. A row is a world:

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
import warp as wp

__all__ = ["main", "play", "record"]


def record(env: object, decisions: int, seed: int) -> tuple[dict, dict]:
    """Plays random actions from open fingers. Returns {name: (step, world, n)} of qpos, ctrl and force, with
    masses, inertias and held places as they begin, since a world that lost its rod gets another; and {world:
    step of its first decision's end without the rod}."""
    import torch

    env.reset(seed=seed)
    rods = {"mass": env._m.body_mass, "inertia": env._m.body_inertia, "held": wp.from_torch(env._held_at)}
    rods = {name: array.numpy().copy() for name, array in rods.items()}
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
    seen = {name: torch.stack(rows).cpu().numpy().astype(float) for name, rows in seen.items()}
    return seen | rods, lost


def play(env: object, world: int, seen: dict, end: int) -> np.ndarray:
    """Positions (end, 3) of a world's rod by `mj_step`, with the task's fixture.

    Args:
      env: the RollRod of the batch. seen: of `record`."""
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
    rod = model.body("rod").id
    model.body_mass[rod], model.body_inertia[rod] = seen["mass"][world, rod], seen["inertia"][world, rod]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data, held = mujoco.MjData(model), seen["held"][world]
    data.qpos[:], spin, out = seen["qpos"][0, world], np.zeros(3), []
    pos, dof = slice(env._at, env._at + 3), model.joint("rod").dofadr[0]
    for control in seen["ctrl"][:end, world]:
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
        own, played = rods[1 : end + 1, world], play(env, world, seen, end)
        ways = {"lost": own, "mj_step": played}
        gone = {n: np.flatnonzero(np.linalg.norm(p - centre, axis=1) > env.cfg.lost) for n, p in ways.items()}
        row = {"world": world} | {name: int(at[0]) if len(at) else None for name, at in gone.items()}
        until = len(own) if row["lost"] is None else row["lost"] + 1
        apart = np.linalg.norm(own - played, axis=1)[:until].max()
        speed = np.linalg.norm(np.diff(own[:until], axis=0), axis=1).max() / env.cfg.timestep
        row |= {"apart_mm": 1e3 * float(apart), "speed": float(speed)}
        row |= {"force_n": seen["force"][until - 1, world].tolist()}
        rows.append(row)
        print(row, flush=True)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    thrown = sum(row["lost"] is not None and row["mj_step"] is None for row in rows)
    found = {"device": options.device, "worlds": options.worlds, "seed": options.seed}
    write_json(options.json, found | {"lost": len(lost), "thrown": thrown, "rows": rows})
    return int(thrown > 0 or any(row["lost"] != row["mj_step"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
