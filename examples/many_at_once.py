"""Presses side by side on the CPU: whole ways with mujoco.rollout, step by step with mujoco.batch.

Needs no GPU: python examples/many_at_once.py. For thousands, examples/batch_mujoco_warp.py."""

import argparse
import os

import mujoco
import mujoco.batch
import mujoco.rollout
import numpy as np

import biotac_mj

RADIUS, STEPS = 3.5e-3, 20  # [m]
START = np.array([-12e-3, -8.3e-3 - RADIUS, 0.0])  # [m] of the ball, just clear of the pad
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


def scene(skin):
    spec = mujoco.MjSpec()
    spec.option.timestep = 4e-3
    ball = spec.worldbody.add_body(name="ball", mocap=True, pos=START)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0])
    biotac_mj.attach(spec, body="world", skin=skin, tier="condensed", coupling="one-way")
    return spec.compile()


def main(count=4, skin="coarse", threads=None):
    """Electrodes (count, STEPS, 19) [counts] of presses to count depths, by rollout and by batch."""
    model = scene(skin)
    threads = threads or len(os.sched_getaffinity(0))
    depth = np.linspace(0.2e-3, 1.2e-3, count)
    # (count, STEPS, 3): where the ball of each press is at each step
    way = START + np.linspace(0, depth, STEPS + 1)[1:].T[..., None] * [0, 1, 0]
    sensor = model.sensor("biotac_electrodes")
    place = slice(sensor.adr[0], sensor.adr[0] + sensor.dim[0])

    data = mujoco.MjData(model)
    rest = np.empty(mujoco.mj_stateSize(model, FULL))
    mujoco.mj_getState(model, data, rest, FULL)
    _, sensed = mujoco.rollout.rollout(
        model,
        [mujoco.MjData(model) for _ in range(threads)],
        np.tile(rest, (count, 1)),
        way,
        control_spec=mujoco.mjtState.mjSTATE_MOCAP_POS.value,
    )
    whole = sensed[:, :, place]

    sims = mujoco.batch.Batch(model, nsim=count, nthread=threads)
    ball, sensed = sims.bind("mocap_pos"), sims.bind("sensordata")
    stepwise = np.empty_like(whole)
    for k in range(STEPS):
        ball[:, 0] = way[:, k]  # here a policy could look at what the sensors read
        sims.step()
        stepwise[:, k] = sensed[:, place]
    for d, counts in zip(depth, whole):
        change = counts[-1] - counts[0]
        most = np.abs(change).argmax()
        print(f"{1e3 * d:.1f} mm: e{most + 1} changes by {change[most]:+.0f}")
    return whole, stepwise


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--skin", default="coarse")
    main(**vars(parser.parse_args()))
