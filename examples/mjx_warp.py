"""BioTacs beside mjx, for those who work in JAX: python examples/mjx_warp.py (needs biotac_mj[mjx])

mjx's Warp back end has no callback, so the skins step between its steps: they read JAX's arrays in place
(DLPack) and hand theirs back the same way. The skin's force acts one step late, explicitly: that is stable
for touched bodies of m > k (dt / 0.8)^2, k the stiffness of the contact. Lighter ones need
`biotac_mj.batch.attach` and mujoco_warp itself (examples/batch_mujoco_warp.py)."""

import argparse

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from biotac_mj import batch

RADIUS, DT = 3.5e-3, 5e-4  # [m], [s]


def scene(skin, mass):
    """A ball on a slide falls onto the pad; a little damping takes its energy."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    spec.option.gravity = [0, 9.81, 0]  # the pad looks along -y
    ball = spec.worldbody.add_body(name="ball", pos=[-9e-3, -RADIUS - 7.1e-3, 0])
    ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0], damping=[4.0, 0, 0])
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=mass)
    batch.add(spec, body="world", skin=skin, coupling="one-way")
    return spec.compile()


def main(nworld=4, steps=300, mass=0.05, skin="default"):
    """Drops balls; returns {channel: (nworld, dim)} at the end and the heights of the balls (nworld,) [m]."""
    mjm = scene(skin, mass)
    model = mjx.put_model(mjm, impl="warp")
    state = jax.vmap(lambda _: mjx.make_data(mjm, impl="warp"))(jnp.arange(nworld))
    device = "cuda:0" if jax.devices()[0].platform == "gpu" else "cpu"
    biotac = batch.make(mjm, nworld, device=device, skin=skin)

    forward = jax.jit(jax.vmap(mjx.forward, in_axes=(None, 0)))
    step = jax.jit(jax.vmap(mjx.step, in_axes=(None, 0)))
    state = forward(model, state)
    for _ in range(steps):
        jax.block_until_ready(state.xpos)  # JAX and Warp have a stream each
        biotac.step(state.xpos, state.xmat, state.xipos)
        state = step(model, state.replace(xfrc_applied=jnp.from_dlpack(biotac.xfrc_applied, copy=True)))
    readings = {name: value.numpy() for name, value in biotac.readings().items()}
    print(f"force {readings['contact_force'][:, 1].round(4)} N for a weight of {9.81 * mass:.4f} N")
    print(f"electrode 17 {readings['electrodes'][:, 16]}, pdc {readings['pdc'][:, 0]}")
    return readings, np.asarray(state.qpos)[:, 0]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--nworld", type=int, default=4)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--skin", default="default")
    main(**vars(parser.parse_args()))
