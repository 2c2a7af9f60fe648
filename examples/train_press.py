"""Short training on the force task with PPO, with touch and without: python examples/train_press.py --steps
30000 --json out/train.json

The finger only moves up and down, thirty times a second, over a plate of unknown height; the wanted force is
told and changes once. With touch the policy sees electrodes and PDC, without only its own height and the
wanted force. Needs the extra `examples` (stable-baselines3)."""

import argparse
import json
import pathlib
import time

import gymnasium
import numpy as np

from biotac_mj.sensor.channels import REST_COUNTS
from biotac_mj.tasks.environments import BioTacEnv

REPEAT, SECONDS = 3, 2.0  # frames that an action lasts; an episode [s]


class PressByTouch(gymnasium.Env):
    """finger/press with one action, the vertical velocity, and scaled features.

    Args:
      touch: whether the 19 electrodes and PDC are among the features.
    """

    def __init__(self, touch=True):
        self.touch = touch
        self.env = BioTacEnv(
            "finger",
            "press",
            observe="tactile" if touch else "none",
            time_limit=SECONDS,
            physics_timestep=0.01,
        )
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (22 if touch else 2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def _features(self, observation):
        out = [observation["target"] / 3.0, observation["position"][2:] / 4e-3]
        if self.touch:
            out += [
                (observation["finger/biotac/electrodes"] - REST_COUNTS["1"]) / 200.0,
                (observation["finger/biotac/pdc"] - 2000.0) / 150.0,
            ]
        return np.concatenate(out).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._features(self.env.reset(seed=seed)[0]), {}

    def step(self, action):
        total = 0.0
        for _ in range(REPEAT):
            observation, reward, ended, over, _ = self.env.step([0.0, 0.0, 0.5 * float(action[0])])
            total += reward / REPEAT
            if ended or over:
                break
        return self._features(observation), total, ended, over, {}

    def close(self):
        self.env.close()


def train(touch, steps, seed=0, rollout=512, minutes=None):
    """Mean reward per step of the last 10 episodes, after each rollout: [{"steps", "reward", "seconds"}]."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.monitor import Monitor

    torch.set_num_threads(1)
    rows, begin = [], time.process_time()

    class Log(BaseCallback):
        def _on_step(self):
            return minutes is None or time.process_time() - begin < 60 * minutes

        def _on_rollout_end(self):
            done = list(self.model.ep_info_buffer)[-10:]
            length = SECONDS / 0.01 / REPEAT
            mean = (
                float(np.mean([e["r"] for e in done]) / length)
                if done
                else float(np.mean(self.model.rollout_buffer.rewards))
            )
            rows.append(
                {"steps": int(self.num_timesteps), "reward": mean, "seconds": time.process_time() - begin}
            )
            print(f"{'touch' if touch else 'no touch'}: {rows[-1]}", flush=True)

    env = Monitor(PressByTouch(touch))
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=rollout,
        batch_size=64,
        n_epochs=8,
        gamma=0.97,
        learning_rate=1e-3,
        ent_coef=1e-3,
        seed=seed,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -0.7},
        device="cpu",
    )
    model.learn(steps, callback=Log())
    env.close()
    return rows


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=30000, help="decisions of each training")
    parser.add_argument("--minutes", type=float, help="of processor time at most, each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--inputs", default="touch,none", help="comma-separated: touch, none")
    parser.add_argument("--json", type=pathlib.Path, default=pathlib.Path("out/train.json"))
    options = parser.parse_args(arguments)
    found = {
        name: train(name == "touch", options.steps, options.seed, minutes=options.minutes)
        for name in options.inputs.split(",")
    }
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(found, indent=1))
    for name, rows in found.items():
        print(f"{name}: mean reward {rows[-1]['reward']:.2f} after {rows[-1]['steps']} decisions")
    return found


if __name__ == "__main__":
    main()
