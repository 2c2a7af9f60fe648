"""The fast setting against the full tier: a rod that a Shadow Hand holds and rolls, step by step.

    MENAGERIE_ROOT=DIR python benchmarks/held_rod.py [--json OUT] [--decisions 28] [--from 8] [--seed 1]
        [--skin coarse]

`RollRod` (tasks/batched) is stepped with one world and random actions. The rod's poses on each fingertip are
recorded: where the batch solved the skin. Then they are replayed on a BioTac that stands still, one way, by
the condensed and by the full tier, and compared from decision --from on, in which the rod is held:

  force_rel     RMS over steps of the difference of the force, over the RMS of the full tier's
  counts_rms    RMS over steps and electrodes of the difference of their counts
  electrodes, pdc, pac  slope of the full tier's changes over those of the condensed tier
  batch_rel     as force_rel, of what acted in the batch against the condensed tier's replay

A row of the JSON is a finger. Steps are of 4 ms, ten a decision."""

import argparse
import os
import pathlib
import sys
import warnings

import mujoco
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from records import write_json

import biotac_mj

__all__ = ["main", "record", "replay"]

STEPS = 10  # of a decision


def record(hand: pathlib.Path, decisions: int, seed: int) -> tuple[dict, tuple]:
    """For each finger positions (n, 3) [m] and rotations (n, 3, 3) of the rod in the BioTac frame, the forces
    on it (n, 3) [N] and the friction; and the rod's radius and half length [m]."""
    import torch

    from biotac_mj.tasks.batched.roll_rod import RollRod, Settings

    open_fingers = Settings(prepare=0, decisions=50, gentle=np.inf)
    env = RollRod(hand, num_envs=1, device="cpu", settings=open_fingers)
    env.reset(seed=seed)
    draw = torch.Generator().manual_seed(seed)
    seen = {name: ([], [], []) for name in env.batches}
    step = env._run

    def watched():
        step()
        for name, batch in env.batches.items():
            pos, mat, force = seen[name]
            # where its body has given way to; at the origin until it has come near
            pos.append(batch.model.pos0.numpy()[0, 0].copy())
            mat.append(batch.model.mat0.numpy()[0, 0].copy())
            force.append(batch.skin.wrench.numpy()[0, 0, :3].copy())

    env._run = watched
    for _ in range(decisions):
        _, _, lost, _, _ = env.step(2 * torch.rand(1, env.num_actions, generator=draw) - 1)
        if lost.any():
            raise RuntimeError("the rod is lost: take another --seed")
    geoms = next(iter(env.batches.values())).skin.geoms.struct
    out = {}
    for name, (pos, mat, force) in seen.items():
        friction = float(env.batches[name].skin.geoms.struct.friction.numpy()[0, 0])
        out[name] = np.array(pos), np.array(mat), np.array(force), friction
    return out, tuple(geoms.size.numpy()[0][:2])


def replay(
    pos: np.ndarray, mat: np.ndarray, friction: float, size: tuple, tier: str, skin: str = "coarse"
) -> tuple:
    """Forces (n, 3) [N] and {channel: counts (n, k)} of a BioTac on which a capsule goes along; while its
    place is the origin it is a metre away."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".004" gravity="0 0 0"/><worldbody><body name="finger"/>'
        '<body name="rod" mocap="true" pos="0 0 1">'
        f'<geom name="rod" type="capsule" size="{size[0]} {size[1]}"/></body>'
        "</worldbody></mujoco>"
    )
    handle = biotac_mj.attach(
        spec, body="finger", tier=tier, skin=skin, geoms=["rod"], friction=friction, coupling="one-way"
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    core = data.body(handle.body)
    frame, origin = core.xmat.reshape(3, 3).copy(), core.xpos.copy()
    force, counts = [], {name: [] for name in ("electrodes", "pdc", "pac")}
    for p, R in zip(pos, mat):
        if p.any():
            data.mocap_pos[0] = origin + frame @ p
            mujoco.mju_mat2Quat(data.mocap_quat[0], (frame @ R).ravel())
        mujoco.mj_step(model, data)
        force.append(handle.read(data, "contact_force")[:3])
        for name, rows in counts.items():
            rows.append(handle.read(data, name))
    return np.array(force), {name: np.array(rows) for name, rows in counts.items()}


def changes(counts: dict, begin: int) -> dict:
    """{channel: (n, k)} from row `begin` on, as changes from the first rows, in which nothing touches; of PAC
    from its mean."""
    return {
        name: rows[begin:] - (rows[begin:].mean() if name == "pac" else rows[:5].mean(0))
        for name, rows in counts.items()
    }


def slope(first: np.ndarray, second: np.ndarray) -> float:
    """Of `second` over `first`, through zero, by least squares."""
    return float((first * second).sum() / (first**2).sum())


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/held_rod.json")
    parser.add_argument("--decisions", type=int, default=28, help="in all, of ten steps")
    parser.add_argument("--from", type=int, default=8, dest="first", help="decision from which is compared")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--skin", default="coarse", help="of the full tier")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    root = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie"))
    hand = root / "shadow_hand" / "right_hand.xml"
    seen, size = record(hand, options.decisions, options.seed)
    rows = []
    for name, (pos, mat, acted, friction) in seen.items():
        (fast, fast_counts), (full, full_counts) = (
            replay(pos, mat, friction, size, *kind) for kind in (("condensed",), ("full", options.skin))
        )
        begin = STEPS * options.first
        fast, full, acted = fast[begin:], full[begin:], acted[begin:]
        fast_changes, full_changes = (changes(counts, begin) for counts in (fast_counts, full_counts))
        rms = float(np.sqrt((full**2).sum(axis=1).mean()))
        row = {
            "finger": name,
            "steps": len(full),
            "force_n": rms,
            "force_rel": float(np.sqrt(((fast - full) ** 2).sum(axis=1).mean())) / rms,
            "counts_rms": float(
                np.sqrt(((fast_counts["electrodes"] - full_counts["electrodes"])[begin:] ** 2).mean())
            ),
            **{name: slope(fast_changes[name], full_changes[name]) for name in fast_changes},
            "batch_rel": float(np.sqrt(((fast + acted) ** 2).sum(axis=1).mean())) / rms,
        }
        rows.append(row)
        print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    write_json(options.json, {"rows": rows, "seed": options.seed})
    return 0


if __name__ == "__main__":
    sys.exit(main())
