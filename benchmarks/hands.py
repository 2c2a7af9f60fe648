"""Time per step of a Shadow Hand with 1 to 5 BioTacs, of which none, some or all touch something, for both
tiers.

    MENAGERIE_ROOT=DIR python benchmarks/hands.py --json out/hands.json [--tiers condensed,full] [--steps 40]
    MENAGERIE_ROOT=DIR python benchmarks/hands.py --json out/hands_gpu.json --worlds 256,1024
                                                  [--device cuda:0] [--pressing 0,2] [--depth 0.6e-3]
    MENAGERIE_ROOT=DIR python benchmarks/hands.py --against DIR --json out/against.json [--tiers condensed]

A ball of 10 mm radius that does not move is pushed 0.6 mm into the pad of each finger that touches; the hand
is held by its servos, with no gravity. Milliseconds of processor time of the thread per mj_step of 4 ms,
median and mean over the steps: the film of the electrodes is solved once per 10 ms, so in two of five steps.
Beside it the hand alone.

--worlds: five BioTacs in every world of mujoco_warp batches, of which --pressing fingers touch: wall time of
a step (on CUDA one graph), the least of the means over runs of --steps; beside it the same hand without
BioTacs.

--against DIR: only all fingers touching, in turns with that of another checkout, each in a process of its
own, 9 of each: the medians and means of the turns, and their ratios turn by turn; processor time.

--moving, of condensed and full: a ball stays with its finger, presses it up to 1.3 mm deep and moves on it by
up to 0.16 mm a step. Balls that stay where they are push the fingers back, as servos yield: all fingers but
the thumb then touch with 0.03 N. `force_N` is the mean over fingers and steps."""

import os

# before numpy reads them
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import functools
import itertools
import json
import pathlib
import sys
import time

import mujoco
import numpy as np
import warp as wp

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from checkouts import beside, run_with
from records import write_json

import biotac_mj
from biotac_mj import plugin

__all__ = ["build", "compare", "main", "measure"]

FINGERS = ("ff", "mf", "rf", "lf", "th")
RADIUS, DEPTH, TIMESTEP = 10e-3, 0.6e-3, 4e-3
RUNS = 5
SETTLING = 10  # steps before those that are timed
TURNS = 9  # of each checkout that is compared
PAD = np.array([-10e-3, -8.2e-3, 0.0])  # middle of the pad in the BioTac frame [m]


def build(hand, count, **settings):
    """A hand with `count` BioTacs and a ball for each finger, far away: model, what `attach_to_hand`
    returns."""
    spec = mujoco.MjSpec.from_file(str(hand))
    spec.option.timestep, spec.option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0, 0, 0]
    for i in range(len(FINGERS)):
        ball = spec.worldbody.add_body(name=f"ball{i}", mocap=True, pos=[0, 0, 2 + 0.1 * i])
        ball.add_geom(name=f"ball{i}", size=[RADIUS, 0, 0])
    handles = {}
    if count:
        handles = biotac_mj.attach_to_hand(spec, "shadow_hand", fingers=FINGERS[:count], **settings)
    return spec.compile(), handles


def pressed(data, body, depth=DEPTH):
    """Where a ball presses the pad of a BioTac."""
    body = data.body(body)
    return body.xpos + body.xmat.reshape(3, 3) @ (PAD - [0, RADIUS - depth, 0])


def measure_batch(
    hand, count, pressing, worlds, device, skin="coarse", steps=40, depth=DEPTH, tier="full"
) -> dict:
    """Milliseconds of a step of a batch, after a settling time."""
    import mujoco_warp as mjw

    from biotac_mj import batch

    begin = time.perf_counter()
    with wp.ScopedDevice(device):
        mjm, prefixes = build(hand, count, batch=True, skin=skin) if count else build(hand, 0)
        mjd = mujoco.MjData(mjm)
        mujoco.mj_forward(mjm, mjd)
        m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=worlds)
        batches = [batch.attach(mjm, m, d, prefix=p, skin=skin, tier=tier) for p in prefixes.values()]
        mocap = d.mocap_pos.numpy()
        for i, prefix in enumerate(list(prefixes.values())[:pressing]):
            mocap[:, i] = pressed(mjd, f"{prefix}core", depth)
        d.mocap_pos.assign(mocap)
        mjw.step(m, d)
        run = functools.partial(mjw.step, m, d)
        if wp.get_device(device).is_cuda:
            with wp.ScopedCapture() as capture:
                mjw.step(m, d)
            run = functools.partial(wp.capture_launch, capture.graph)
        setup, seconds = time.perf_counter() - begin, []
        for _ in range(RUNS + 1):  # the first is the settling time
            wp.synchronize()
            begin = time.perf_counter()
            for _ in range(steps):
                run()
            wp.synchronize()
            seconds.append((time.perf_counter() - begin) / steps)
        force = np.array([np.linalg.norm(b.wrench[..., :3].sum(1), axis=1) for b in batches])
    return {
        "sensors": count,
        "tier": tier if count else "none",
        "pressing": pressing,
        "touching_share": float((force[:pressing] > 0.01).mean()) if pressing else 0.0,
        "worlds": worlds,
        "device": wp.get_device(device).name,
        "skin": skin,
        "depth_m": depth,
        "setup_s": setup,
        "ms_per_step": 1e3 * min(seconds[1:]),
        "hand_steps_per_s": worlds / min(seconds[1:]),
        "rates": [worlds / t for t in seconds[1:]],
        "failed": int(sum(b.failed.numpy().sum() for b in batches)),
    }


def compare_batches(hand, options) -> list[dict]:
    """A row for each number of worlds, tier and number of pressing fingers, and for the hand alone."""
    rows = []
    print("| worlds | BioTacs | tier | pressing | ms per step | hand-steps per s | failed | set-up s |")
    print("|---|---|---|---|---|---|---|---|")
    tiers, pressings = options.tiers.split(","), map(int, options.pressing.split(","))
    cases = [(0, 0, tiers[0]), *((len(FINGERS), p, tier) for p, tier in itertools.product(pressings, tiers))]
    how = options.device, options.skin, options.steps, options.depth
    for worlds in map(int, options.worlds.split(",")):
        for count, pressing, tier in cases:
            row = measure_batch(hand, count, pressing, worlds, *how, tier)
            rows.append(row)
            print(
                f"| {worlds} | {count} | {row['tier']} | {pressing} | {row['ms_per_step']:.2f} | "
                f"{row['hand_steps_per_s']:.0f} | {row['failed']} | {row['setup_s']:.0f} |",
                flush=True,
            )
            write_json(options.json, {"rows": rows, "timestep": TIMESTEP})
    return rows


def slide(data, bodies, step):
    """Moves each ball along its BioTac's pad and into it."""
    for i, body in enumerate(bodies):
        depth = DEPTH + 0.7e-3 * np.sin(2 * np.pi * (step / 40 + i / 7))
        along = 1e-3 * np.array([np.sin(step / 15 + i), 0.0, np.cos(step / 11)])
        data.mocap_pos[i] = pressed(data, body, depth) + data.body(body).xmat.reshape(3, 3) @ along


def measure(hand, count, touching, tier, skin="coarse", steps=40, moving=False, threads=None) -> dict:
    """Median and mean milliseconds of a step after a settling time, and how many skins carry a force: of the
    processor, or by the clock where a number of threads is given."""
    clock, more = time.thread_time, {}
    if threads:
        clock, more = time.perf_counter, {"options": {"threads": threads}}
    model, handles = build(hand, count, tier=tier, skin=skin, **more)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bodies = [handle.body for handle in list(handles.values())[:touching]]
    for i, body in enumerate(bodies):
        data.mocap_pos[i] = pressed(data, body)
    seconds, force = [], np.zeros((SETTLING + steps, count))
    for step in range(SETTLING + steps):
        if moving:
            slide(data, bodies, step)
        begin = clock()
        mujoco.mj_step(model, data)
        seconds.append(clock() - begin)
        force[step] = [np.linalg.norm(h.read(data, "contact_force")[:3]) for h in handles.values()]
    plugin.check()
    seconds, loaded = seconds[SETTLING:], (force[-1] > 0.01).sum()
    return {
        "sensors": count,
        "touching": int(loaded),
        "force_N": float(force[SETTLING:, :touching].mean()) if touching else 0.0,
        "tier": tier if count else "none",
        "skin": skin,
        "ms_median": 1e3 * float(np.median(seconds)),
        "ms_mean": 1e3 * float(np.mean(seconds)),
    }


def compare_threads(hand, tier: str, skin: str, steps: int, moving: bool, threads: list[int]) -> dict:
    """Seconds by the clock with each number of threads, in turns; and the ratio to the first, of turns."""
    n, turns = len(FINGERS), {count: [] for count in threads}
    for _ in range(TURNS):
        for count in threads:
            turns[count].append(measure(hand, n, n, tier, skin, steps, moving, count))
    first, out = turns[threads[0]], {"tier": tier, "skin": skin, "moving": moving, "turns": turns}
    for count in threads:
        mean = [row["ms_mean"] for row in turns[count]]
        ratio = [now / before["ms_mean"] for now, before in zip(mean, first)]
        out[f"ratio_{count}"] = float(np.median(ratio))
        same = all(row["force_N"] == one["force_N"] for row, one in zip(turns[count], first))
        print(
            f"{tier}, {count} threads: {min(mean):.2f} ms a step by the clock, least of {TURNS} turns; ratio "
            f"{np.median(ratio):.3f} ({min(ratio):.3f} to {max(ratio):.3f}), forces the same: {same}"
        )
    return out


def compare(other: pathlib.Path, tier: str, skin: str, steps: int, moving: bool = False) -> dict:
    """This checkout against another: a row with the milliseconds of each turn."""
    found = {"here": [], "against": []}
    with beside(other) as folders:
        worker = [__file__, "--turn", "--tiers", tier, "--skin", skin, "--steps", steps, "--json", os.devnull]
        worker += ["--moving"] if moving else []
        for turn in range(TURNS):
            for name in found if turn % 2 else reversed(found):
                found[name].append(json.loads(run_with(folders[name], worker, 1).splitlines()[-1]))
    row = {"tier": tier, "skin": skin, "sensors": len(FINGERS), "moving": moving, "turns": found}
    for key in ("ms_median", "ms_mean"):
        here, against = (np.array([turn[key] for turn in found[name]]) for name in ("here", "against"))
        ratio = here / against
        row |= {f"{key}_least": [here.min(), against.min()], f"{key}_ratio": float(np.median(ratio))}
        print(
            f"{tier} {key}: least here {here.min():.2f}, against {against.min():.2f}; ratio of turns, median "
            f"{np.median(ratio):.3f} ({ratio.min():.3f} to {ratio.max():.3f})",
            flush=True,
        )
    return row


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/hands.json", help="file to write"
    )
    parser.add_argument("--tiers", default="condensed,full", help="comma-separated")
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--most", type=int, default=5, help="sensors")
    parser.add_argument("--worlds", help="comma-separated numbers of worlds of mujoco_warp batches")
    parser.add_argument("--pressing", default="0,2", help="of a batch: comma-separated numbers of fingers")
    parser.add_argument("--depth", type=float, default=DEPTH, help="of a batch [m]")
    parser.add_argument("--device", default=None, help="of a batch; Warp's default")
    parser.add_argument("--against", type=pathlib.Path, help="another checkout to compare with")
    parser.add_argument("--moving", action="store_true", help="balls press fingers and slide on them")
    parser.add_argument("--threads", help="comma-separated, to compare with the first of them by the clock")
    parser.add_argument("--turn", action="store_true", help="print one row, which --against asks for")
    options = parser.parse_args(arguments)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    root = os.environ.get("MENAGERIE_ROOT")
    if not root or not (pathlib.Path(root) / "shadow_hand").is_dir():
        raise FileNotFoundError(
            f"no shadow_hand in MENAGERIE_ROOT={root}: set it to a clone of MuJoCo Menagerie"
        )
    hand = pathlib.Path(root) / "shadow_hand" / "right_hand.xml"
    wp.config.log_level = wp.LOG_WARNING
    if options.turn:
        fingers = len(FINGERS)
        row = measure(hand, fingers, fingers, options.tiers, options.skin, options.steps, options.moving)
        print(json.dumps(row))
        return 0
    if options.against:
        tiers, how = options.tiers.split(","), (options.skin, options.steps, options.moving)
        rows = [compare(options.against, tier, *how) for tier in tiers]
        write_json(options.json, {"rows": rows, "timestep": TIMESTEP})
        return 0
    if options.threads:
        counts, how = (
            [int(n) for n in options.threads.split(",")],
            (options.skin, options.steps, options.moving),
        )
        rows = [compare_threads(hand, tier, *how, counts) for tier in options.tiers.split(",")]
        write_json(options.json, {"rows": rows, "timestep": TIMESTEP})
        return 0
    if options.worlds:
        compare_batches(hand, options)
        return 0
    rows = []
    print("| tier | sensors | touching | ms per step, median | mean |\n|---|---|---|---|---|")
    cases = [("condensed", 0, 0)]
    for tier in options.tiers.split(","):
        cases += [(tier, n, 0) for n in range(1, options.most + 1)] + [
            (tier, options.most, k) for k in range(1, options.most + 1)
        ]
        cases += [(tier, n, n) for n in range(1, options.most)]
    for tier, count, touching in cases:
        rows.append(measure(hand, count, touching, tier, options.skin, options.steps, options.moving))
        r = rows[-1]
        print(
            f"| {r['tier']} | {r['sensors']} | {r['touching']} | {r['ms_median']:.2f} | {r['ms_mean']:.2f} |",
            flush=True,
        )
        write_json(options.json, {"rows": rows, "timestep": TIMESTEP})
    return 0


if __name__ == "__main__":
    sys.exit(main())
