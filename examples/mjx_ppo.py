"""A policy learns by touch to press with a wanted force: Brax' PPO on BioTacs inside MJX.

    python examples/mjx_ppo.py            (needs biotac_mj[mjx], brax and jax<0.10)

The environment has the interface of Brax, with the names of MuJoCo Playground. Where the probe is when an
episode begins the policy is not told: it has to feel it."""

import argparse

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import Env, State
from brax.training.agents.ppo import networks
from brax.training.agents.ppo import train as ppo

from biotac_mj import batch, mjx

RADIUS, START = 3.5e-3, -1.2e-2  # [m] of the probe; its centre under the pad, which looks along -y
NEAR, DEEP = 5e-4, 2.5e-3  # [m] how far off the probe may be at first; how deep it may be sent
LEAST, MOST = 0.1, 0.6  # [N] that may be wanted
STEPS, SUBSTEPS, DT = 20, 2, 4e-3  # decisions of an episode, steps of a decision, time step [s]


def scene(skin):
    """A probe on a slide with a servo, under the pad of a BioTac that is fixed."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    probe = spec.worldbody.add_body(name="probe", pos=[-1e-2, START, 0])
    probe.add_joint(name="up", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
    probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.02)
    servo = spec.add_actuator(name="up", target="up", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=400.0, kv=5.0)
    batch.add(spec, body="world", skin=skin)
    return spec.compile()


class PressByTouch(Env):
    """Observed: by how much each electrode changed [500 counts], where the servo was sent [DEEP], and the
    wanted force. An action (1,) of -1 .. 1 says where it is sent next. The reward is 0 for the wanted force,
    -1 where it is off by that."""

    def __init__(self, skin="coarse"):
        self.mj_model = scene(skin)
        self.mjx_model = mjx.put_model(self.mj_model, skin=skin, tier="condensed")

    observation_size, action_size, backend = 21, 1, "mjx"

    def reset(self, rng):
        noise, place, wish = jax.random.split(rng, 3)
        data = mjx.make_data(self.mjx_model, jax.random.bits(noise))
        off = jax.random.uniform(place, minval=-NEAR, maxval=NEAR)
        data = mjx.step(self.mjx_model, data.replace(qpos=off[None], ctrl=off[None]))
        info = {"off": off, "wanted": jax.random.uniform(wish, minval=LEAST, maxval=MOST)}
        info["rest"] = mjx.readings(self.mjx_model, data)["electrodes"]
        zero = jnp.zeros(())
        return State(data, self._observe(data, info), zero, zero, {"force_off": zero}, info)

    def step(self, state, action):
        info = state.info
        sent = info["off"] + DEEP * (0.5 + 0.5 * jnp.clip(action, -1, 1))
        data = state.pipeline_state.replace(ctrl=sent)
        for _ in range(SUBSTEPS):
            data = mjx.step(self.mjx_model, data)
        force = mjx.readings(self.mjx_model, data)["contact_force"][1]
        off = jnp.abs(force - info["wanted"])
        return state.replace(
            pipeline_state=data,
            obs=self._observe(data, info),
            reward=-off / info["wanted"],
            metrics=state.metrics | {"force_off": off},
        )

    def _observe(self, data, info):
        change = (mjx.readings(self.mjx_model, data)["electrodes"] - info["rest"]) / 500
        sent = (data.ctrl - info["off"]) / DEEP
        return jnp.concatenate([change, sent, (info["wanted"][None] - LEAST) / (MOST - LEAST)])


def main(timesteps=8192, nworld=16, skin="coarse"):
    """Trains; prints and returns how far the force was off on average before and after [N]."""
    found = []

    def report(_steps, metrics):
        found.append(float(metrics["eval/episode_force_off"]) / STEPS)
        print(f"force off by {found[-1]:.3f} N on average", flush=True)

    ppo.train(
        environment=PressByTouch(skin),
        num_timesteps=timesteps,
        episode_length=STEPS,
        num_envs=nworld,
        num_eval_envs=nworld,
        num_evals=2,
        unroll_length=8,
        batch_size=nworld,
        num_minibatches=4,
        num_updates_per_batch=8,
        learning_rate=1e-3,
        entropy_cost=1e-3,
        discounting=0.9,
        normalize_observations=True,
        network_factory=lambda *sizes, **given: networks.make_ppo_networks(
            *sizes, **given, policy_hidden_layer_sizes=(64, 64), value_hidden_layer_sizes=(64, 64)
        ),
        progress_fn=report,
    )
    return found[0], found[-1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--timesteps", type=int, default=8192)
    parser.add_argument("--nworld", type=int, default=16)
    parser.add_argument("--skin", default="coarse")
    main(**vars(parser.parse_args()))
