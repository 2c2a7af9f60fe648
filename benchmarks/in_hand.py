"""Learning in the hand: PPO (RSL-RL) on RollRod, with touch and without, five seeds of each.

    MENAGERIE_ROOT=DIR python benchmarks/in_hand.py --json out/in_hand.json --minutes 20 --figure PNG
    python benchmarks/in_hand.py --inputs touch --device cuda:0 --json out/touch.json    # on one GPU
    python benchmarks/in_hand.py --inputs none --device cuda:1 --json out/none.json      # on another
    python benchmarks/in_hand.py --table out/touch.json out/none.json --figure PNG       # both

Episodes begin with the rod held, somewhere on the pads, which is not told; the fingers roll it to a told
place on them. The critic, which is left behind after learning, knows where it is, with touch and without.
All runs learn side by side: each has its own share of the worlds of one batch, its own networks and seed,
and makes as many decisions as the others. After each iteration the JSON is written, and with --policies the
networks, so it may be stopped at any time; `--resume` goes on from both. What a run is paid and how often it
succeeds is that of its episodes while it learns, with the noise of its exploration; at the end each plays its
worlds once more, with rods that are held anew, without noise. Seconds are those of the whole batch. Needs
rsl-rl-lib and, to be done in time, a GPU."""

import argparse
import copy
import dataclasses
import json
import os
import pathlib
import sys
import time

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))

__all__ = ["Run", "main", "table"]

INPUTS = {"touch": ["body", "touch"], "none": ["body"]}
TASK = {
    "decisions": 12,
    "begin": "held",
    "prepare": 17,
    "hold": 0.4,
    "release": 0.55,
    "goal": "place",
    "target": (-1e-3, 3e-3),
    "tolerance": 0.4e-3,
    "near": 0.7e-3,
    "offset": (4e-3, 3e-3),
    "lead": 4e-3,
    "encoder": 5e-3,  # exact angles, which differ by 1e-3, tell the place to 0.1 mm; no hand's do
    "actions": "pads",
    "rate": 0.8e-3,
    "reach": 8e-3,
    "gentle": 4.0,
    "work": 240,  # with 40 a step that is cut off throws the rod away
}
BARS = (0.5, 0.7, 0.8, 0.9)  # of success, whose first times are told
WINDOW = 4  # iterations, two episodes, whose episodes make a rate
PPO = {
    "num_steps_per_env": 6,
    "actor": {
        "class_name": "MLPModel",
        "hidden_dims": [128, 64],
        "activation": "elu",
        "obs_normalization": True,
        "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5},
    },
    "critic": {
        "class_name": "MLPModel",
        "hidden_dims": [128, 64],
        "activation": "elu",
        "obs_normalization": True,
    },
    "algorithm": {
        "class_name": "PPO",
        "num_learning_epochs": 5,
        "num_mini_batches": 4,
        "clip_param": 0.2,
        "gamma": 0.9,  # a decision is paid at once; with 0.97 noise hides what it gave
        "lam": 0.9,
        "value_loss_coef": 1.0,
        "entropy_coef": 0.0,
        "learning_rate": 1e-3,
        "max_grad_norm": 1.0,
        "schedule": "adaptive",
        "desired_kl": 0.03,
        "rnd_cfg": None,
        "symmetry_cfg": None,
    },
    "multi_gpu": None,
}


class Run:
    """One policy that learns in its share of the worlds.

    Args:
      env: the environment of all. worlds: slice of them. inputs: of INPUTS. seed: of networks.

    Attributes:
      rows: of each iteration, what its episodes came to. end: what it does without noise, see `play`.
    """

    end = None

    def __init__(self, env, worlds: slice, inputs: str, seed: int):
        import torch
        from rsl_rl.algorithms import PPO as Algorithm

        self.worlds, self.inputs, self.seed = worlds, inputs, seed
        self.num_envs, self.num_actions, self.device = (
            worlds.stop - worlds.start,
            env.num_actions,
            env.device,
        )
        torch.manual_seed(seed)
        groups = {"actor": INPUTS[inputs], "critic": ["body", "touch", "state"]}
        config = copy.deepcopy(PPO) | {"obs_groups": groups}
        self.algorithm = Algorithm.construct_algorithm(self.part(env.observe()), self, config, env.device)
        self.algorithm.train_mode()
        self.rows = []

    def part(self, observations):
        """This run's share, a TensorDict."""
        from tensordict import TensorDict

        mine = {name: value[self.worlds] for name, value in observations.items()}
        return TensorDict(mine, batch_size=[self.num_envs])

    def keep(self, folder: pathlib.Path) -> None:
        """The networks into a file of the folder."""
        import torch

        part = folder / f"{self.inputs}_{self.seed}.part"
        torch.save(self.algorithm.save(), part)
        part.replace(part.with_suffix(".pt"))

    def resume(self, folder: pathlib.Path, found: dict) -> None:
        """Goes on where a run of these inputs and this seed was stopped.

        Raises:
          ValueError: no such run was kept.
        """
        import torch

        file = folder / f"{self.inputs}_{self.seed}.pt"
        mine = [r for r in found["runs"] if (r["inputs"], r["seed"]) == (self.inputs, self.seed)]
        if not mine or not file.exists():
            raise ValueError(f"{self.inputs}, seed {self.seed}: nothing to resume; leave out --resume")
        kept = torch.load(file, map_location=self.device, weights_only=True)
        self.algorithm.load(kept, None, strict=True)
        self.rows = mine[0]["rows"]


def _episodes(done, success, held, error):
    """Counts of the episodes that ended: [ended, successes, held, error of the held, summed]."""
    return [int(done.sum()), int(success.sum()), int(held.sum()), float(error[held].sum())]


def learn(env, runs, until, written, progress=True):
    """Has the runs learn until then (`time.perf_counter()`); `written(seconds)` after each iteration. An
    episode's share of the time is left for the end.

    Returns:
      seconds of simulation, and of learning.
    """
    import torch
    from tqdm import tqdm

    before = {run: run.rows[-1] if run.rows else {"decisions": 0, "seconds": 0.0} for run in runs}
    observations, _ = env.reset(seed=max(row["decisions"] for row in before.values()))
    begin, simulated, learned = time.perf_counter(), 0.0, 0.0
    bar = tqdm(total=round(until - begin), desc="learning", unit="s", disable=not progress or None)
    decisions, one = 0, 0.0  # one: [s] of a decision
    spare = env.cfg.prepare + env.max_episode_length + PPO["num_steps_per_env"]
    while (at := time.perf_counter()) + 1.2 * spare * one < until:
        counts, paid = np.zeros((len(runs), 4)), np.zeros(len(runs))
        with torch.inference_mode():
            for _ in range(PPO["num_steps_per_env"]):
                actions = torch.cat([run.algorithm.act(run.part(observations)) for run in runs])
                observations, reward, terminated, truncated, extras = env.step(actions)
                done = (terminated | truncated).long()
                for i, run in enumerate(runs):
                    w = run.worlds
                    more = {"time_outs": extras["time_outs"][w].float()}
                    run.algorithm.process_env_step(run.part(observations), reward[w], done[w], more)
                    counts[i] += _episodes(done[w], extras["success"][w], truncated[w], extras["error"][w])
                    paid[i] += float(reward[w].mean())
            decisions += PPO["num_steps_per_env"]
            middle = time.perf_counter()
            for run in runs:
                run.algorithm.compute_returns(run.part(observations))
        for i, run in enumerate(runs):
            torch.manual_seed(1000 * (len(run.rows) + 1) + run.seed)
            run.algorithm.update()
            row = dict(zip(("ended", "success", "held", "error"), counts[i].tolist()))
            row |= {
                "decisions": before[run]["decisions"] + decisions * run.num_envs,
                "reward": paid[i] / PPO["num_steps_per_env"],
                "seconds": before[run]["seconds"] + time.perf_counter() - begin,
            }
            run.rows.append(row)
        simulated, learned = simulated + middle - at, learned + time.perf_counter() - middle
        one = (time.perf_counter() - begin) / decisions
        written(simulated, learned)
        rates = {k: np.mean([rate(r.rows) for r in runs if r.inputs == k]) for k in INPUTS}
        bar.set_postfix({k: f"{v:.2f}" for k, v in rates.items()})
        bar.n = round(min(time.perf_counter(), until) - begin)
        bar.refresh()
        print(
            f"{time.perf_counter() - begin:6.0f} s, {decisions} decisions of {env.num_envs} worlds, "
            f"{one:.2f} s each; success, reward: "
            + "; ".join(f"{r.inputs} {r.seed} {rate(r.rows):.2f} {r.rows[-1]['reward']:.3f}" for r in runs),
            flush=True,
        )
    bar.close()
    return simulated, learned


def rate(rows, what="success"):
    """Share of the last iterations' episodes."""
    last = rows[-WINDOW:]
    return sum(r[what] for r in last) / max(sum(r["ended"] for r in last), 1)


def first(rows, bar):
    """The row by which that share of the last iterations' episodes had succeeded, or None."""
    for i in range(WINDOW, len(rows) + 1):
        if sum(r["ended"] for r in rows[i - WINDOW : i]) and rate(rows[:i]) >= bar:
            return rows[i - 1]
    return None


def play(env, runs, shown=2):
    """Each run's worlds once more, held anew, without noise: `run.end` has {"success", "held", "error",
    "force_n"}.

    Returns:
      what the first `shown` worlds of each run did: {"qpos" (decisions, runs, shown, nq), "sensordata",
      "target", "success" (runs, shown)}.
    """
    import torch

    if env.cfg.begin == "held":
        env.prepare_held(seed=54321)  # rods that lie where none lay in learning
    observations, _ = env.reset(seed=12345)
    ended = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    success, held = ended.clone(), ended.clone()
    error = torch.zeros(env.num_envs, device=env.device)
    force = torch.zeros(env.num_envs, 3, device=env.device)
    some = torch.tensor([[run.worlds.start + i for i in range(shown)] for run in runs], device=env.device)
    way = {"qpos": [], "sensordata": []}
    target = env.target[some].cpu().numpy()
    with torch.inference_mode():
        for _ in range(env.max_episode_length):
            for name, kept in way.items():
                kept.append(getattr(env, name)[some].cpu().numpy())
            actions = torch.cat([run.algorithm.get_policy()(run.part(observations)) for run in runs])
            observations, _, terminated, truncated, extras = env.step(actions)
            now = (terminated | truncated) & ~ended
            success, held = success | extras["success"] & now, held | truncated & now
            error = torch.where(now, extras["error"], error)
            ended |= now
            force = torch.maximum(force, env.force)
    for run in runs:
        w = run.worlds
        run.end = {
            "success": float(success[w].float().mean()),
            "held": float(held[w].float().mean()),
            "error": float(error[w][held[w]].mean()) if held[w].any() else None,
            "force_n": float(force[w].max(dim=1).values.median()),
        }
    way = {name: np.stack(kept) for name, kept in way.items()}
    return way | {"target": target, "success": success[some].cpu().numpy()}


def table(found: dict) -> str:
    """What was learned, in Markdown."""
    unit, scale = ("rad", 1) if found["settings"]["goal"] == "angle" else ("mm", 1e3)
    lines = [
        f"{found['device']}, {found['worlds']} worlds of each run, {len(found['runs'])} runs; "
        f"{found['setup_s']:.0f} s until learning began, {found['simulated_s']:.0f} s of simulation, "
        f"{found['learned_s']:.0f} s of learning; {found['decisions']} decisions of all worlds, "
        f"{sum(found['failed_steps'].values())} steps of a skin in the last episodes without a balance\n",
        "| observed | seed | decisions | success, learning | success, without noise | held "
        f"| error [{unit}] " + "".join(f"| {b:.0%} after decisions, s " for b in BARS) + "|",
        "|" + "---|" * (7 + len(BARS)),
    ]
    for run in found["runs"]:
        end = run.get("end") or {}
        cells = [
            run["inputs"],
            str(run["seed"]),
            str(run["rows"][-1]["decisions"]),
            f"{rate(run['rows']):.2f}",
        ]
        cells += [f"{end[k]:.2f}" if end.get(k) is not None else "" for k in ("success", "held")]
        cells += [f"{scale * end['error']:.3f}" if end.get("error") is not None else ""]
        for bar in BARS:
            row = first(run["rows"], bar)
            cells.append(f"{row['decisions']}, {row['seconds']:.0f}" if row else "never")
        lines.append(f"| {' | '.join(cells)} |")
    for inputs in INPUTS:
        ends = [r["end"]["success"] for r in found["runs"] if r["inputs"] == inputs and r.get("end")]
        if ends:
            mean, least, most = np.mean(ends), min(ends), max(ends)
            lines.append(f"\n{inputs}: success without noise {mean:.3f} ({least:.2f} to {most:.2f})")
    return "\n".join(lines)


def together(parts: list[dict]) -> dict:
    """What several processes found, as one: the runs side by side, seconds the longest of them."""
    whole = dict(parts[0])
    whole["runs"] = [run for part in parts for run in part["runs"]]
    whole["device"] = ", ".join(part["device"] for part in parts)
    for name in ("setup_s", "simulated_s", "learned_s", "decisions"):
        whole[name] = max(part[name] for part in parts)
    names = {finger for part in parts for finger in part["failed_steps"]}
    whole["failed_steps"] = {f: sum(p["failed_steps"].get(f, 0) for p in parts) for f in names}
    return whole


def draw(found: dict, path: pathlib.Path) -> None:
    """Success over decisions, a line for each run."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for run in found["runs"]:
        rows = run["rows"]
        rates = [rate(rows[: i + 1]) for i in range(len(rows))]
        color = "C0" if run["inputs"] == "touch" else "C1"
        axes.plot([r["decisions"] / 1e3 for r in rows], rates, color=color, lw=1)
    for inputs, color in (("with touch", "C0"), ("without", "C1")):
        axes.plot([], [], color=color, label=inputs)
    axes.set(xlabel="decisions of each run [thousands]", ylabel="share of episodes that succeed", ylim=(0, 1))
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def settings_of(given: dict):
    """The task's settings of what JSON holds."""
    from biotac_mj.tasks.in_hand.environment import Settings

    return Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})


def main(arguments=None) -> int:
    begin = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, help="file to write")
    parser.add_argument(
        "--table", type=pathlib.Path, nargs="+", help="print the table of such files, and end"
    )
    parser.add_argument("--figure", type=pathlib.Path, help="PNG to draw")
    parser.add_argument(
        "--policies",
        type=pathlib.Path,
        help="folder for the runs' networks, and for what they played at the end",
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from --json and --policies, as long as --minutes says"
    )
    parser.add_argument("--worlds", type=int, default=96, help="of each run")
    parser.add_argument("--seeds", default="0,1,2,3,4", help="comma-separated, of runs of each kind")
    parser.add_argument("--inputs", default=",".join(INPUTS), help="comma-separated: touch, none")
    parser.add_argument("--device", default="cuda:0", help="of Warp")
    parser.add_argument("--minutes", type=float, default=20.0, help="of all, setting up and playing too")
    parser.add_argument("--settings", default="{}", help="JSON, other settings of the task")
    options = parser.parse_args(arguments)
    if options.table:
        found = together([json.loads(path.read_text(encoding="utf-8")) for path in options.table])
        print(table(found))
        if options.figure:
            draw(found, options.figure)
        return 0
    if options.json is None:
        parser.error("--json FILE to write, or --table FILE to print")
    if options.resume and not (options.policies and options.json.exists()):
        parser.error("--resume needs --policies and --json of a run that was stopped")
    import warp as wp
    from records import write_json

    from biotac_mj.tasks.in_hand import RollRod

    root = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie"))
    settings = settings_of(TASK | json.loads(options.settings))
    if options.resume:
        old = json.loads(options.json.read_text(encoding="utf-8"))
        if settings_of(old["settings"]) != settings:
            parser.error(f"{options.json} learned with other settings of the task: give the same --settings")
    seeds = [int(seed) for seed in options.seeds.split(",")]
    kinds = [(inputs, seed) for seed in seeds for inputs in options.inputs.split(",")]
    env = RollRod(
        root / "shadow_hand" / "right_hand.xml",
        options.worlds * len(kinds),
        options.device,
        settings=settings,
    )
    runs = [
        Run(env, slice(i * options.worlds, (i + 1) * options.worlds), inputs, seed)
        for i, (inputs, seed) in enumerate(kinds)
    ]
    found = {
        "device": wp.get_device(options.device).name,
        "worlds": options.worlds,
        "setup_s": time.perf_counter() - begin,
        "held": len(env.good),
        "settings": dataclasses.asdict(settings),
        "ppo": PPO,
    }
    print(
        f"{found['setup_s']:.0f} s: set up, {found['held']} of {env.num_envs} worlds hold a rod", flush=True
    )
    spent = (0.0, 0.0)
    if options.resume:
        for run in runs:
            run.resume(options.policies, old)
        spent = old["simulated_s"], old["learned_s"]

    def written(simulated, learned):
        found["simulated_s"], found["learned_s"] = spent[0] + simulated, spent[1] + learned
        found["decisions"] = runs[0].rows[-1]["decisions"] // options.worlds
        found["failed_steps"] = {f: int(b.failed.numpy().sum()) for f, b in env.batches.items()}
        found["runs"] = [{"inputs": r.inputs, "seed": r.seed, "rows": r.rows, "end": r.end} for r in runs]
        write_json(options.json, found)
        if options.policies:
            options.policies.mkdir(parents=True, exist_ok=True)
            for run in runs:
                run.keep(options.policies)

    seconds = learn(env, runs, begin + 60 * options.minutes, written)
    way = play(env, runs)
    written(*seconds)
    if options.policies:
        np.savez_compressed(options.policies / "played.npz", **way)
    print(table(found))
    if options.figure:
        draw(found, options.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
