"""Time per step of a Shadow Hand with 1 to 5 BioTacs, of which none, some or all touch something, for both
tiers.

    MENAGERIE_ROOT=DIR python benchmarks/hands.py --json out/hands.json [--tiers condensed,full] [--steps 40]

A ball of 10 mm radius that does not move is pushed 0.6 mm into the pad of each finger that touches; the hand
is held by its servos, with no gravity. Milliseconds of processor time of the thread per mj_step of 4 ms,
median and mean over the steps: the film of the electrodes is solved once per 10 ms, so in two of five steps.
Beside it the hand alone."""

import os

# before numpy reads them
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import pathlib
import sys
import time

import mujoco
import numpy as np
import warp as wp

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from accuracy import write_json

import biotac_mj
from biotac_mj import plugin

__all__ = ["build", "main", "measure"]

FINGERS = ("ff", "mf", "rf", "lf", "th")
RADIUS, DEPTH, TIMESTEP = 10e-3, 0.6e-3, 4e-3
PAD = np.array([-10e-3, -8.2e-3, 0.0])  # middle of the pad in the BioTac frame [m]


def build(hand, count, tier, skin):
    """A hand with `count` BioTacs and a ball for each finger, far away: model, handles."""
    spec = mujoco.MjSpec.from_file(str(hand))
    spec.option.timestep, spec.option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0, 0, 0]
    for i in range(count):
        ball = spec.worldbody.add_body(name=f"ball{i}", mocap=True, pos=[0, 0, 2 + 0.1 * i])
        ball.add_geom(name=f"ball{i}", size=[RADIUS, 0, 0])
    handles = {}
    if count:
        handles = biotac_mj.attach_to_hand(spec, "shadow_hand", fingers=FINGERS[:count], tier=tier, skin=skin)
    return spec.compile(), handles


def measure(hand, count, touching, tier, skin="coarse", steps=40) -> dict:
    """Median and mean milliseconds of a step after a settling time, and how many skins carry a force."""
    model, handles = build(hand, count, tier, skin)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for i, handle in enumerate(list(handles.values())[:touching]):
        body = data.body(handle.body)
        mat = body.xmat.reshape(3, 3)
        data.mocap_pos[i] = body.xpos + mat @ (PAD - [0, RADIUS - DEPTH, 0])
    for _ in range(10):
        mujoco.mj_step(model, data)
    seconds = []
    for _ in range(steps):
        begin = time.thread_time()
        mujoco.mj_step(model, data)
        seconds.append(time.thread_time() - begin)
    plugin.check()
    loaded = sum(np.linalg.norm(h.read(data, "contact_force")[:3]) > 0.01 for h in handles.values())
    return {
        "sensors": count,
        "touching": int(loaded),
        "tier": tier if count else "none",
        "skin": skin,
        "ms_median": 1e3 * float(np.median(seconds)),
        "ms_mean": 1e3 * float(np.mean(seconds)),
    }


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, required=True, help="file to write")
    parser.add_argument("--tiers", default="condensed,full", help="comma-separated")
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--most", type=int, default=5, help="sensors")
    options = parser.parse_args(arguments)
    root = os.environ.get("MENAGERIE_ROOT")
    if not root or not (pathlib.Path(root) / "shadow_hand").is_dir():
        raise FileNotFoundError(
            f"no shadow_hand in MENAGERIE_ROOT={root}: set it to a clone of MuJoCo Menagerie"
        )
    hand = pathlib.Path(root) / "shadow_hand" / "right_hand.xml"
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    print("| tier | sensors | touching | ms per step, median | mean |\n|---|---|---|---|---|")
    cases = [("condensed", 0, 0)]
    for tier in options.tiers.split(","):
        cases += [(tier, n, 0) for n in range(1, options.most + 1)] + [
            (tier, options.most, k) for k in range(1, options.most + 1)
        ]
        cases += [(tier, n, n) for n in range(1, options.most)]
    for tier, count, touching in cases:
        rows.append(measure(hand, count, touching, tier, options.skin, options.steps))
        r = rows[-1]
        print(
            f"| {r['tier']} | {r['sensors']} | {r['touching']} | {r['ms_median']:.2f} | {r['ms_mean']:.2f} |",
            flush=True,
        )
        write_json(options.json, {"rows": rows, "timestep": TIMESTEP})
    return 0


if __name__ == "__main__":
    sys.exit(main())
