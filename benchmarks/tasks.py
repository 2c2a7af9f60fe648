"""Scores of the tasks: their scripted controllers, which act on touch alone, and a random policy, over seeds.

    python benchmarks/tasks.py --json out/tasks.json [--tasks press,lift] [--policies scripted,random]
    [--seeds 20] python benchmarks/tasks.py --markdown out/tasks.json [out/more.json ...]

The score of an episode is its mean reward per step (0 to 1); solved: the mean over its last second is at
least 0.8. Episodes that the JSON file already holds are not run again, so an interrupted run goes on where it
was. Seconds are processor time of the thread per episode."""

import os

# before numpy reads them
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import json
import pathlib
import sys
import time

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from records import write_json

from biotac_mj.tasks import suite
from biotac_mj.tasks.scripted import make_controller

__all__ = ["episode", "main", "table"]

SOLVED = 0.8


class Random:
    """Actions uniform over their bounds, whatever is observed; spec: of the actions (dm_env)."""

    def __init__(self, spec: object, seed: int):
        self.spec, self.rng = spec, np.random.RandomState(seed)

    def reset(self) -> None:
        """Nothing to forget."""

    def act(self, observation: dict) -> np.ndarray:
        return self.rng.uniform(self.spec.minimum, self.spec.maximum, size=self.spec.shape)


def episode(env, controller, seed) -> dict:
    """Runs one episode; score, mean reward of the last second, skin solves that failed, processor seconds."""
    begin, rewards = time.thread_time(), []
    env.random_state.seed(seed)
    step = env.reset()
    controller.reset()
    while not step.last():
        step = env.step(controller.act(step.observation))
        rewards.append(step.reward)
    last = round(1 / env.control_timestep())
    failed = sum(b.read(env.physics, "status")[1] for b in env.task.biotacs)
    return {
        "score": float(np.mean(rewards)),
        "last_second": float(np.mean(rewards[-last:])),
        "failed_steps": int(failed),
        "seconds": time.thread_time() - begin,
    }


def table(rows) -> str:
    """Markdown: one line per task."""
    lines = [
        "| task | scripted: score | solved | random: score | solved | seeds | processor s | not converged |",
        "|" + "---|" * 8,
    ]
    for domain, task in suite.tasks():
        cells, counts, seconds, failed = [], [], [], 0
        for policy in ("scripted", "random"):
            found = [r for r in rows if (r["domain"], r["task"], r["policy"]) == (domain, task, policy)]
            counts.append(str(len(found)))
            if not found:
                cells += ["", ""]
                continue
            score = [r["score"] for r in found]
            solved = np.mean([r["last_second"] >= SOLVED for r in found])
            seconds.append(f"{np.mean([r['seconds'] for r in found]):.1f}")
            failed += sum(r["failed_steps"] for r in found)
            cells += [f"{np.mean(score):.2f} +- {np.std(score):.2f}", f"{100 * solved:.0f} %"]
        lines.append(
            f"| {domain}/{task} | {' | '.join(cells)} | {', '.join(counts)} | {', '.join(seconds)} | "
            f"{failed} |"
        )
    return "\n".join(lines)


def merged(paths) -> list[dict]:
    """Rows of several files; a task that is in two is taken from the last."""
    rows = {}
    for path in paths:
        found = json.loads(path.read_text())["rows"]
        rows |= {task: [r for r in found if r["task"] == task] for task in {r["task"] for r in found}}
    return [r for of_task in rows.values() for r in of_task]


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, help="file to write, and to go on from")
    parser.add_argument(
        "--markdown",
        type=pathlib.Path,
        nargs="+",
        help="print the table of these files and stop; of a task in two, the last counts",
    )
    parser.add_argument(
        "--tasks", default=",".join(task for _, task in suite.tasks()), help="comma-separated"
    )
    parser.add_argument("--policies", default="scripted,random", help="comma-separated")
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args(arguments)
    if options.markdown:
        print(table(merged(options.markdown)))
        return 0
    if options.json is None:
        parser.error("--json FILE is missing: where to write")
    rows = json.loads(options.json.read_text())["rows"] if options.json.exists() else []
    done = {(r["task"], r["policy"], r["seed"]) for r in rows}
    known = {task: domain for domain, task in suite.tasks()}
    for task in options.tasks.split(","):
        if task not in known:
            raise ValueError(f"no task {task!r}: choose from {', '.join(known)}")
        todo = [
            (p, s)
            for s in range(options.seeds)
            for p in options.policies.split(",")
            if (task, p, s) not in done
        ]
        if not todo:
            continue
        env = suite.load(known[task], task)
        for policy, seed in tqdm(todo, desc=task):
            controller = (
                make_controller(task, env) if policy == "scripted" else Random(env.action_spec(), seed)
            )
            rows.append(
                {
                    "domain": known[task],
                    "task": task,
                    "policy": policy,
                    "seed": seed,
                    **episode(env, controller, seed),
                }
            )
            write_json(options.json, {"rows": rows})
        env.close()
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
