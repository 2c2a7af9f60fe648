"""Speed of the in-hand task while rods are held: random actions, decision by decision, set-up included.

    MENAGERIE_ROOT=DIR python benchmarks/in_hand_speed.py --worlds 512,1024,4096 --device cuda:0 --json OUT
        [--decisions 18] [--repeats 1] [--settings JSON] [--seed 1] [--cold] [--against DIR]
    MENAGERIE_ROOT=DIR python benchmarks/in_hand_speed.py --worlds 2 --device cpu --json OUT     # tries it
    python benchmarks/in_hand_speed.py --table OUT                                        # prints it again

`RollRod` (tasks/batched): a Shadow Hand holds a rod between three of its fingers. Each number of worlds is a
process of its own. All worlds begin with open fingers, close in the first ten decisions, and get actions that
are drawn evenly from [-1, 1] by --seed. A decision is ten steps of 4 ms. A row of the JSON is a decision, -1
one of an episode whose rods are 0.3 m away, so that nothing is near; the one before it, in which memory is
taken and PyTorch loads kernels, is left out. In decision 0 rods are 1 mm away:

  ms_per_step        wall time of a step of all worlds; with --repeats the least of several runs that begin
                     alike
  hand_steps_per_s   worlds / that time
  unsettled          steps of a skin without a balance, of skin or of skin and bodies, of 1000
  lost               rods that were lost in this decision; such worlds begin anew
  held               share of worlds whose rod is between the fingers at the end of the decision
  force_n            mean over worlds and fingers of the force at the end of the decision [N]

`setup_s` of the JSON has, for each process, seconds of the import and from there until the worlds can be
stepped (model, skins, kernels, graph, first reset), how many modules of kernels were compiled in it and how
many its cache of kernels held before, and how many files the skins' cache held.

--cold: each process begins with empty caches of kernels and of skins. --against DIR: the same of another
checkout's package, in turns with this one's; --against-settings: the task's settings there."""

import argparse
import contextlib
import dataclasses
import json
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

sys.path.insert(0, str(pathlib.Path(__file__).parent))

__all__ = ["main", "measure", "summary", "table"]

HELD = range(8, 18)  # decisions with the rod held
_AWAY = 0.3  # [m] of rods to which nothing is near
COLUMNS = ("ms_per_step", "hand_steps_per_s", "unsettled", "lost", "held", "force_n")


def measure(
    hand: pathlib.Path,
    worlds: int,
    device: str,
    decisions: int,
    repeats: int,
    seed: int,
    settings: dict,
) -> Iterator[dict]:
    """First {"setup_s": {...}, "device": name}, then {"row": {...}} for each decision, in this process.

    Raises:
      FileNotFoundError: no such hand.
    """
    begin = time.perf_counter()
    import torch
    import warp as wp

    from biotac_mj.cache import cache_folder
    from biotac_mj.tasks.batched.roll_rod import RollRod, Settings

    class Counted(RollRod):
        """Counts failed steps of skins also in worlds that begin anew."""

        forgotten = 0
        away = 0.0  # of rods when an episode begins [m]

        def _place(self, some):
            super()._place(some)
            up = self.away * some[:, 0].float()
            self.pos[:, 2] += up
            self._held_at[:, 2] += up

        def _begin(self, which):
            gone = which.cpu().numpy()
            self.forgotten += int(sum(b.failed.numpy()[gone].sum() for b in self.batches.values()))
            super()._begin(which)

        @property
        def failed(self):
            return self.forgotten + int(sum(b.failed.numpy().sum() for b in self.batches.values()))

    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    imported = time.perf_counter() - begin
    kernels, kept = pathlib.Path(wp.config.kernel_cache_dir), cache_folder()
    binary = "*/*.cubin" if wp.get_device(device).is_cuda else "*/*.o"
    caches = {"modules_before": _count(kernels, binary), "kept_before": _count(kept, "*")}
    choice = {"prepare": 0, "decisions": 50, "gentle": math.inf} | settings  # from open fingers
    choice = {k: tuple(v) if isinstance(v, list) else v for k, v in choice.items()}
    begin = time.perf_counter()
    env = Counted(hand, worlds, device, settings=Settings(**choice))
    wp.synchronize()
    setup = {"worlds": worlds, "import_s": imported, "seconds": time.perf_counter() - begin, **caches}
    setup["modules_compiled"] = _count(kernels, binary) - caches["modules_before"]
    yield {"setup_s": setup, "device": wp.get_device(device).name}

    skin_steps, cfg = worlds * len(env.batches) * env.cfg.substeps, env.cfg
    for again in range(repeats):
        for env.away, numbers in ((_AWAY, range(-2, 0)), (0.0, range(decisions))):
            env.cfg = dataclasses.replace(cfg, lost=cfg.lost + env.away)
            env.reset(seed=seed)
            draw = torch.Generator(env.device).manual_seed(seed)
            for decision in numbers:
                actions = 2 * torch.rand(worlds, env.num_actions, generator=draw, device=env.device) - 1
                failed = env.failed
                wp.synchronize()
                begin = time.perf_counter()
                _, _, lost, _, _ = env.step(actions)
                wp.synchronize()
                seconds = (time.perf_counter() - begin) / env.cfg.substeps
                row = {
                    "worlds": worlds,
                    "decision": decision,
                    "ms_per_step": 1e3 * seconds,
                    "hand_steps_per_s": worlds / seconds,
                    "unsettled": 1e3 * (env.failed - failed) / skin_steps,
                    "lost": int(lost.sum()),
                    "held": float(env.held.float().mean()),
                    "force_n": float(env.force.mean()),
                }
                if decision >= -1:
                    yield {"row": row | {"repeat": again}}


def _count(folder, pattern):
    return sum(1 for _ in folder.glob(pattern)) if folder.is_dir() else 0


def best(rows: list[dict]) -> list[dict]:
    """Rows of repeats as one for each decision: the least time, the most that was unsettled or lost."""
    found = {}
    for row in rows:
        key = row.get("checkout"), row["worlds"], row["decision"]
        one = found.setdefault(key, dict(row))
        one["ms_per_step"] = min(one["ms_per_step"], row["ms_per_step"])
        for name in ("hand_steps_per_s", "unsettled", "lost"):
            one[name] = max(one[name], row[name])
        one["held"] = min(one["held"], row["held"])
        one.pop("repeat", None)
    return list(found.values())


def summary(rows: list[dict]) -> list[dict]:
    """Of each checkout and number of worlds: hand-steps/s where nothing is near, in the first decision, and
    over the decisions with the rod held, lost rods of all decisions and the most unsettled of 1000 steps."""
    groups = {}
    for row in rows:
        groups.setdefault((row["checkout"], row["worlds"]), []).append(row)
    out = []
    for (checkout, worlds), some in groups.items():
        held = [row for row in some if row["decision"] in HELD]
        one = {"checkout": checkout, "worlds": worlds}
        one |= {name: row["hand_steps_per_s"] for name, row in zip(("nothing_near", "near"), some)}
        one["lost"] = sum(row["lost"] for row in some)
        if held:
            one["held"] = 1e3 * worlds * len(held) / sum(row["ms_per_step"] for row in held)
            one["unsettled"] = sum(row["unsettled"] for row in held) / len(held)
        out.append(one)
    return out


def table(found: dict) -> str:
    """What was measured, in Markdown."""
    lines = [f"{found['device']}; seed {found['seed']}; settings {json.dumps(found['settings'])}\n"]
    lines += [
        "| checkout | worlds | import s | set-up s | modules compiled (there before) | skin files before |",
        "|---|---|---|---|---|---|",
    ]
    for one in found["setup_s"]:
        lines.append(
            f"| {one['checkout']} | {one['worlds']} | {one['import_s']:.1f} | {one['seconds']:.1f} | "
            f"{one['modules_compiled']} ({one['modules_before']}) | {one['kept_before']} |"
        )
    lines += [f"\n| checkout | worlds | decision | {' | '.join(COLUMNS)} |", "|" + "---|" * 9]
    for row in found["rows"]:
        cells = [f"{row[name]:.4g}" for name in COLUMNS]
        lines.append(f"| {row['checkout']} | {row['worlds']} | {row['decision']} | {' | '.join(cells)} |")
    span = f"decisions {HELD[0]} to {HELD[-1]}"
    lines += [
        f"\n| checkout | worlds | hand-steps/s, nothing near | decision 0 | held, {span} | unsettled of 1000 "
        "| lost in all |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in summary(found["rows"]):
        held = f"{one['held']:.0f} | {one['unsettled']:.3g}" if "held" in one else "|"
        far = f"{one['nothing_near']:.0f} | {one.get('near', math.nan):.0f}"
        numbers = f"{one['worlds']} | {far} | {held} | {one['lost']}"
        lines.append(f"| {one['checkout']} | {numbers} |")
    lines += [f"\n{one['checkout']}, {one['worlds']} worlds: {one['why']}" for one in found["failed"]]
    return "\n".join(lines)


def _follow(folder, options, worlds, settings, caches):
    """What a process says that imports from the folder, line by line; {"failed": why} where it ends badly."""
    from checkouts import first_on_path

    env = {**os.environ, "PYTHONPATH": first_on_path(folder)}
    if caches:
        env |= {"WARP_CACHE_PATH": f"{caches}/warp", "BIOTAC_CACHE": f"{caches}/biotac"}
    command = [sys.executable, __file__, "--child", "--worlds", str(worlds), "--device", options.device]
    command += ["--decisions", str(options.decisions), "--repeats", str(options.repeats)]
    command += ["--seed", str(options.seed), "--settings", json.dumps(settings)]
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=errors, text=True)
        for line in process.stdout:
            with contextlib.suppress(json.JSONDecodeError):  # what others print
                yield json.loads(line)
        if process.wait():
            errors.seek(0)
            said = errors.read().strip().splitlines()
            yield {"failed": said[-1] if said else f"exit status {process.returncode}"}


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/in_hand_speed.json", help="file to write"
    )
    parser.add_argument("--table", type=pathlib.Path, help="print the table of such a file, and end")
    parser.add_argument("--worlds", default="512", help="comma-separated")
    parser.add_argument("--device", default="cuda:0", help="of Warp")
    parser.add_argument("--decisions", type=int, default=18, help="of ten steps")
    parser.add_argument("--repeats", type=int, default=1, help="runs of a process, of which the least counts")
    parser.add_argument("--seed", type=int, default=1, help="of rods' places and of actions")
    parser.add_argument("--settings", type=json.loads, default={}, help="JSON, other settings of the task")
    parser.add_argument("--cold", action="store_true", help="begin each process with empty caches")
    parser.add_argument("--against", type=pathlib.Path, help="the root of another checkout")
    parser.add_argument("--against-settings", type=json.loads, help="JSON; those of --settings if left out")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.table:
        print(table(json.loads(options.table.read_text(encoding="utf-8"))))
        return 0
    sizes = [int(n) for n in options.worlds.split(",")]
    if options.child:
        root = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie"))
        hand, how = root / "shadow_hand" / "right_hand.xml", (options.repeats, options.seed, options.settings)
        for said in measure(hand, sizes[0], options.device, options.decisions, *how):
            print(json.dumps(said), flush=True)
        return 0
    options.json.parent.mkdir(parents=True, exist_ok=True)
    from checkouts import beside
    from records import write_json

    settings = {"here": options.settings, "against": options.against_settings}
    if settings["against"] is None:
        settings["against"] = options.settings
    found = {"device": None, "setup_s": [], "seed": options.seed, "cold": options.cold, "settings": settings}
    found |= {"repeats": options.repeats, "rows": [], "failed": []}
    with beside(options.against) as folders:
        found["settings"] = {name: settings[name] for name in folders}
        for worlds in sizes:
            for name, folder in folders.items():
                rows, before = [], found["rows"]
                with contextlib.ExitStack() as stack:
                    caches = options.cold and stack.enter_context(tempfile.TemporaryDirectory())
                    for said in _follow(folder, options, worlds, settings[name], caches):
                        if "setup_s" in said:
                            found["device"] = said["device"]
                            found["setup_s"].append({"checkout": name, **said["setup_s"]})
                        if "row" in said:
                            rows.append({"checkout": name, **said["row"]})
                            print(
                                f"{name}, {worlds} worlds, decision {rows[-1]['decision']}: "
                                + ", ".join(f"{c} {rows[-1][c]:.4g}" for c in COLUMNS),
                                flush=True,
                            )
                        if "failed" in said:
                            why = {"checkout": name, "worlds": worlds, "why": said["failed"]}
                            found["failed"].append(why)
                        found["rows"] = before + best(rows)
                        write_json(options.json, found)
    print(table(found))
    return 1 if found["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
