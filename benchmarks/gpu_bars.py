"""The bars of speed on one GPU, all in one run that ends in time, beside an older checkout if one is given.

    MENAGERIE_ROOT=DIR python benchmarks/gpu_bars.py --json out/gpu_bars.json [--against DIR] [--minutes 6]
    python benchmarks/gpu_bars.py --table out/gpu_bars.json                       # prints it again
    python benchmarks/gpu_bars.py --json OUT --device cpu --tiny --cases press    # tries the script itself

Each case is a process of its own, so that one that fails, or finds no time, leaves the others alone:

  press    the standard press of speed.py on the default skin, ten-node: 1024 worlds and one, dry and liquid
  ansys    the same press, its first 15 increments, with the preset "ansys": one world and 64, with liquid
  batch    benchmarks/batch.py: 1024 worlds in mujoco_warp.step with films, counts and two-way forces
  hand     benchmarks/hands.py: a Shadow Hand with five coarse BioTacs in mujoco_warp, nothing touches in 256
           worlds, two fingers press 0.8 mm in 256 and in 1024

First come the set-ups of all cases, at once, each with empty caches of its checkout's kernels and of what
skins keep (on CUDA; elsewhere and with --warm with the user's own): the seconds of `batch` and `hand` are
those of a machine that has compiled nothing, while others compile beside them. Then the cases one after
another, this checkout's and the other's in turns, with the kernels that are there now. A figure is the least,
the median and the most of its repeats: presses, or a hand's runs of 40 steps. What fails, or is not reached
within --minutes, stands in the JSON with the reason: set-ups have six tenths of that, nothing is started that
has 20 s left or fewer.

The bars and goals are those of the project's issue on speed; a bar is met where the least of this checkout
meets it; of sizes that are tiny, and of set-ups with kernels that were there, none is judged."""

import os

# before numpy reads them
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import contextlib
import json
import pathlib
import subprocess
import sys
import tempfile
import time

sys.path.insert(0, str(pathlib.Path(__file__).parent))

__all__ = ["BARS", "CASES", "main", "table"]

CASES = ("press", "batch", "ansys", "hand")
# figure: what it is, unit, bar, goal; more is better where the unit is a rate
BARS = {
    "press_1024_dry": ("standard press, 1024 worlds, dry", "ms a press and world", 0.7, 0.5),
    "press_1024_liquid": ("standard press, 1024 worlds, liquid", "ms a press and world", 1.0, 0.7),
    "press_1_dry": ("one world, dry", "ms a step", 1.3, 1.0),
    "press_1_liquid": ("one world, liquid", "ms a step", 1.7, 1.0),
    "batch_1024": ("mujoco_warp.step with films and counts, two-way, 1024 worlds", "ms a step", 18, 12),
    "hand_256_untouched": ("Shadow Hand, five coarse, nothing touches, 256 worlds", "hand-steps/s", 2e5, 4e5),
    "hand_256_pressed": ("the same, two fingers pressing 0.8 mm, 256 worlds", "hand-steps/s", 2.5e4, 6e4),
    "hand_1024_pressed": ("the same, two fingers pressing 0.8 mm, 1024 worlds", "hand-steps/s", 2.5e4, 6e4),
    "setup_batch": ("set-up of one batch, nothing compiled", "s", 40, None),
    "setup_hand": ("set-up of five on a hand, nothing compiled", "s", 60, None),
    "ansys_1": ("preset ansys (nu 0.499), one world", "ms a step", 6, None),
    "ansys_64": ("preset ansys, 64 worlds", "ms a step", 9, None),
}
_DEPTH = 0.8e-3  # [m] that fingers press
_LEAST = 20.0  # [s] without which no case is started
_SETUPS = 0.6  # of the time, that set-ups may take
_RATE = "hand-steps/s"


def _press(options, material, liquids, sizes, increments, name) -> dict:
    """Repeats of the standard press: figures by name."""
    import numpy as np
    from speed import standard_path
    from timed_press import press

    from biotac_mj.geometry import load_skin
    from biotac_mj.skin import PRESETS, SkinModel, SkinOptions

    geometry = load_skin("coarse" if options.tiny else "default")
    path = standard_path(geometry, increments)[0]
    found = {}
    for liquid in liquids:
        settings = SkinOptions(element="quadratic", liquid=liquid)
        model = SkinModel(geometry, PRESETS[material], settings, device=options.device)
        for worlds in sizes:
            press(model, path[:3], worlds)  # loads
            each, lost = [], 0
            for _ in range(1 if options.setup or options.tiny else 3 if worlds > 1 else 6):
                _, seconds, left = press(model, path, worlds)
                each.append(1e3 * float(np.sum(seconds[:, 0])))
                lost += left
            ours = f"{name}_{1024 if worlds > 100 else worlds if worlds in (1, 64) else 1024}"
            ours += f"_{'liquid' if liquid else 'dry'}" if len(liquids) > 1 else ""
            part = worlds if "a press" in BARS[ours][1] else increments
            found[ours] = {"each": [t / part for t in each], "worlds": worlds, "not_converged": lost}
    return found


def press_case(options) -> dict:
    """The standard press."""
    sizes = (2, 1) if options.tiny else (1024, 1)
    increments = 2 if options.tiny else 3 if options.setup else 60
    return _press(options, "default", (False, True), sizes, increments, "press")


def ansys_case(options) -> dict:
    """Nearly incompressible rubber."""
    sizes = (1,) if options.tiny else (64, 1)
    return _press(options, "ansys", (True,), sizes, 2 if options.tiny or options.setup else 15, "ansys")


def batch_case(options) -> dict:
    """BioTacs in mujoco_warp."""
    import warp as wp
    from batch import time_batch

    worlds, increments = (2, 1) if options.tiny else (32, 1) if options.setup else (1024, 60)
    with wp.ScopedDevice(options.device):
        row = time_batch("coarse" if options.tiny else "default", worlds, increments)
    found = {"batch_1024": {"each": [row["ms_per_step"]]} | row}
    if options.setup:
        found["setup_batch"] = {"each": [row["setup_s"]], "worlds": worlds}
    return found


def hand_case(options) -> dict:
    """A Shadow Hand in mujoco_warp."""
    from hands import FINGERS, measure_batch

    root = os.environ.get("MENAGERIE_ROOT")
    if not root or not (pathlib.Path(root) / "shadow_hand").is_dir():
        raise FileNotFoundError(
            f"no shadow_hand in MENAGERIE_ROOT={root}: set it to a clone of MuJoCo Menagerie, or leave the "
            "case hand out"
        )
    hand, found = pathlib.Path(root) / "shadow_hand" / "right_hand.xml", {}
    for name, worlds, pressing in (
        ("hand_256_untouched", 256, 0),
        ("hand_256_pressed", 256, 2),
        ("hand_1024_pressed", 1024, 2),
    ):
        steps = 1 if options.tiny or options.setup else 40
        few = 1 if options.tiny else 32 if options.setup else worlds
        count = 1 if options.tiny else len(FINGERS)
        row = measure_batch(hand, count, min(pressing, count), few, options.device, steps=steps, depth=_DEPTH)
        found[name] = {"each": row.get("rates", [row["hand_steps_per_s"]])} | row
        if options.setup or options.tiny:
            found["setup_hand"] = {"each": [row["setup_s"]], "worlds": few}
            break
    return found


def _work(options) -> int:
    """A case in this process; its figures on the last line."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    done = globals()[f"{options.work}_case"](options)
    print(json.dumps({"device": wp.get_device(options.device).name, "figures": done}))
    return 0


class _Run:
    """Processes of cases, with the time that is left for them."""

    def __init__(self, options, folders: dict, caches: dict):
        self.options, self.folders, self.caches = options, folders, caches
        self._end = time.monotonic() + 60 * options.minutes

    @property
    def left(self) -> float:
        """Seconds."""
        return self._end - time.monotonic()

    def start(self, name: str, case: str, setup: bool) -> subprocess.Popen:
        """A process of one checkout's case."""
        from checkouts import first_on_path

        o = self.options
        env = {**os.environ, "PYTHONPATH": first_on_path(self.folders[name])}
        if cache := self.caches.get(name):
            env |= {"WARP_CACHE_PATH": f"{cache}/warp", "BIOTAC_CACHE": f"{cache}/biotac"}
        command = [sys.executable, __file__, "--work", case, "--device", o.device]
        command += ["--tiny"] * o.tiny + ["--setup"] * setup
        return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def finish(self, process: subprocess.Popen, kept: float = 0.0) -> dict:
        """What a process found, or why it did not: it has the time that is left but for `kept` [s]."""
        try:
            out, error = process.communicate(timeout=max(self.left - kept, 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return {"failed": f"no end in its part of the {self.options.minutes:g} minutes"}
        if process.returncode:
            return {"failed": error.strip().splitlines()[-1] if error.strip() else str(process.returncode)}
        return json.loads(out.splitlines()[-1])


def measure(options) -> dict:
    """All cases of all checkouts: what `table` takes."""
    from checkouts import beside

    cold = not options.warm and options.device != "cpu"
    with contextlib.ExitStack() as stack:
        folders = stack.enter_context(beside(options.against))
        caches = {n: stack.enter_context(tempfile.TemporaryDirectory()) for n in folders if cold}
        run = _Run(options, folders, caches)
        cases = options.cases.split(",")
        found = {"device": None, "cold": cold, "tiny": options.tiny, "figures": {}, "failed": {}}

        def note(name, case, result, wanted):
            found["device"] = result.get("device") or found["device"]
            if "failed" in result:
                found["failed"][f"{name} {case}"] = result["failed"]
            for figure, row in result.get("figures", {}).items():
                if figure.startswith("setup_") == wanted:
                    found["figures"].setdefault(figure, {})[name] = row
            if options.json:
                from records import write_json

                write_json(options.json, found)

        processes = [(name, case, run.start(name, case, True)) for case in cases for name in folders]
        for name, case, process in processes:
            kept = (1.0 - _SETUPS) * 60 * options.minutes
            note(name, f"{case}, set-up", run.finish(process, kept), True)
        for case in cases:
            for name in folders:
                if run.left < (0 if options.tiny else _LEAST):
                    note(name, case, {"failed": f"no time left of {options.minutes:g} minutes"}, False)
                    continue
                note(name, case, run.finish(run.start(name, case, False)), False)
    return found


def table(found: dict) -> str:
    """The figures of a run beside bars and goals, in Markdown."""
    other = any("against" in row for row in found["figures"].values())
    heads = ["what", "unit", "here (median, most)", *(["against", "ratio"] * other), "bar", "goal", ""]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for figure, (what, unit, bar, goal) in BARS.items():
        row, rate = found["figures"].get(figure, {}), unit == _RATE
        best = {name: (max if rate else min)(r["each"]) for name, r in row.items()}
        cells = [what, unit, "not measured"]
        if "here" in best:
            each = sorted(row["here"]["each"], reverse=rate)
            cells[2] = f"**{each[0]:.4g}** ({each[len(each) // 2]:.4g}, {each[-1]:.4g})"
            if lost := row["here"].get("not_converged") or row["here"].get("failed"):
                cells[2] += f", {lost} steps not converged"
        if other:
            cells += [f"{best['against']:.4g}" if "against" in best else ""]
            cells += [f"{best['here'] / best['against']:.3f}" if len(best) == 2 else ""]
        judged = "here" in best and not found["tiny"] and (found["cold"] or not figure.startswith("setup_"))
        met = "" if not judged else "met" if (best["here"] >= bar) == rate else "missed"
        lines.append(f"| {' | '.join([*cells, f'{bar:g}', f'{goal:g}' if goal else '', met])} |")
    lines += [f"\n{name}: {why}" for name, why in found["failed"].items()]
    return "\n".join([f"{found['device']}\n", *lines])


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, help="file to write")
    parser.add_argument("--table", type=pathlib.Path, help="print the table of such a file, and end")
    parser.add_argument("--against", type=pathlib.Path, help="the root of another checkout")
    parser.add_argument("--device", default="cuda:0", help="of Warp")
    parser.add_argument("--cases", default=",".join(CASES), help="comma-separated, in this order")
    parser.add_argument("--minutes", type=float, default=6.0, help="after which the run ends")
    parser.add_argument("--warm", action="store_true", help="take the kernels that the user's cache has")
    parser.add_argument("--tiny", action="store_true", help="few worlds and steps, to try the script")
    parser.add_argument("--work", choices=CASES, help=argparse.SUPPRESS)
    parser.add_argument("--setup", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.work:
        return _work(options)
    if options.table:
        print(table(json.loads(options.table.read_text(encoding="utf-8"))))
        return 0
    if options.json is None:
        parser.error("--json FILE to write, or --table FILE to print")
    if unknown := set(options.cases.split(",")) - set(CASES):
        parser.error(f"unknown case {', '.join(sorted(unknown))}: choose from {', '.join(CASES)}")
    found = measure(options)
    print(table(found))
    return 1 if found["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
