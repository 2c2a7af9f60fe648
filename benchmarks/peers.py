"""Peers at equal work: error over time per step, ours beside Newton's VBD and MuJoCo's flex, in batches.

    python benchmarks/peers.py --device cpu --json out/peers_cpu.json [--worlds 1,16]
    python benchmarks/peers.py --device cuda:0 --json out/peers.json [--worlds 1,256,1024] [--minutes 8]
                               [--with out/peers_cpu.json --table --figure out/peers.png]

The first millimetre of the press of `speed.py` (25 steps) on the same linear tetrahedra with the same held
nodes, dry. Each solver is stopped early and late: ours by its tolerance, the others by their iterations.

error: mean over the steps of the distance of the force from that of the solver's own converged press, over
the largest force of that one; of the worst world. So it is what stopping early costs, and single precision
on a GPU. Laws and contact of the solvers differ, and with them the forces that they converge to (`force_N`).
Converged are ours on the CPU in double precision at a tolerance of 1e-6, Newton's with 1000 iterations in one
world, and both flexes with 1000 of MuJoCo's own in double precision.
ms_per_step: mean wall time of a step of all worlds, the least of up to three presses; compilation and models
do not count. On the CPU one world has one core; of more worlds MuJoCo's flex has a thread each, and ours is
left out.

Rows are written one by one: a file that is there goes on where it was stopped. A row that fails says why in
`note`. Solvers that are not installed are left out."""

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")  # before numpy reads

import argparse
import math
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).parent))

import mujoco
import numpy as np
import peer_scenes
import warp as wp
from records import read_json, write_json
from speed import RADIUS, TIGHT, TO_1MM, standard_path
from timed_press import press
from tqdm import tqdm

from biotac_mj.geometry import SKINS, load_skin
from biotac_mj.skin import PRESETS, SkinModel, SkinOptions

__all__ = ["KNOBS", "draw", "main", "table", "times_at"]

KNOBS = {  # where each is stopped, what is most telling first
    "ours": (1e-3, 1e-2, 1e-1, 1e-4),
    "vbd": (100, 10, 30, 300),
    "flex": (100, 30, 300),
    "flex_warp": (100, 30, 300),
}
NAMES = {"ours": "biotac_mj", "vbd": "Newton VBD", "flex": "MuJoCo flex", "flex_warp": "mujoco_warp flex"}
CONVERGED = 1000  # iterations
SCENES = {"vbd": peer_scenes.NewtonVBD, "flex": peer_scenes.Flex, "flex_warp": peer_scenes.FlexWarp}
STEPS = TO_1MM  # deeper the skin meets the core, which the peers lack
FLOOR = 1e-6  # smaller errors are drawn here
LEVELS = 0.1, 0.01, 0.001  # errors whose times are told beside each other
PRESSES, ENOUGH = 3, 0.5  # how often a press is timed at most; not again after so many seconds


class Rows:
    """What is measured, in a file that is written row by row."""

    def __init__(self, path: pathlib.Path, case: dict):
        self.path, self.case = path, case
        self.found = read_json(path, {"case": case, "converged": {}, "rows": []})
        if self.found["case"] != case:
            raise ValueError(f"{path} is of {self.found['case']}, not of {case}: name another file")

    def has(self, **key) -> bool:
        return any(all(row[k] == v for k, v in key.items()) for row in self.found["rows"])

    def add(self, row: dict):
        self.found["rows"].append(row)
        write_json(self.path, self.found)

    def converged(self, name: str, make) -> np.ndarray:
        """(n, 3) forces [N]; made where the file has none."""
        if name not in self.found["converged"]:
            self.found["converged"][name] = make().tolist()
            write_json(self.path, self.found)
        return np.array(self.found["converged"][name])


class Solver:
    """One of the four on one press; `run(knob)` gives forces (n, worlds, 3) and seconds (n,)."""

    def __init__(self, key: str, skin: str, steps: int, worlds: int, device: str):
        self.key, self.worlds, self.device = key, worlds, device
        self.geometry, self.material = load_skin(skin), PRESETS["paper"]
        self.path, self.direction = standard_path(self.geometry, steps)
        self._scene = self._knob = None

    def run(self, knob):
        if self.key == "ours":
            if self._scene is None or self._knob != knob:
                most = 60 if knob < 1e-4 else SkinOptions.max_newton
                options = SkinOptions(element="linear", liquid=False, tolerance=knob, max_newton=most)
                self._knob, self._scene = (
                    knob,
                    SkinModel(self.geometry, self.material, options, device=self.device),
                )
                press(self._scene, self.path[:2], self.worlds)  # compiles
            force, seconds, lost = press(self._scene, self.path, self.worlds)
            if lost:
                raise RuntimeError(f"{lost} steps did not converge")
            return force, seconds[:, 0]
        if self._scene is None:
            press_ = self.geometry, self.material, RADIUS, self.path, self.direction
            self._scene = SCENES[self.key](*press_, self.worlds, self.device)
        return self._scene.press(knob)

    def converged(self):
        """(n, 3) forces of the press that its errors are measured against [N]."""
        knob, device = (TIGHT, "cpu") if self.key == "ours" else (CONVERGED, self.device)
        one = Solver.__new__(Solver)
        one.__dict__.update(self.__dict__, worlds=1, device=device, _scene=None)
        one.key = "flex" if self.key == "flex_warp" else self.key
        return one.run(knob)[0][:, 0]


def measure(rows: Rows, solver: Solver, knob, truth) -> dict:
    """A row."""
    row = {
        "solver": NAMES[solver.key],
        "device": "cpu" if solver.device == "cpu" else wp.get_device(solver.device).name,
        "worlds": solver.worlds,
        "knob": knob,
        "steps": rows.case["steps"],
    }
    began, times = time.perf_counter(), []
    try:
        while len(times) < PRESSES and (not times or sum(times) < ENOUGH):
            force, seconds = solver.run(knob)
            times.append(seconds.sum())
        if not np.isfinite(force).all():
            raise FloatingPointError("the press ended in numbers that are not finite")
    except Exception as error:  # a peer may refuse in any way; the others go on
        return row | {"ms_per_step": None, "error": None, "note": one_line(error)}
    wrong = np.linalg.norm(force - truth[:, None], axis=2).mean(0).max()
    return row | {
        "ms_per_step": 1e3 * min(times) / len(truth),
        "error": float(wrong / np.linalg.norm(truth, axis=1).max()),
        "force_N": float(np.linalg.norm(force[-1, 0])),
        "all_s": time.perf_counter() - began,
        "note": "",
    }


def one_line(error) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0] if text else ''}"


def digits(number: float, count: int = 3) -> str:
    """That many of them, without an exponent."""
    return f"{number:.{max(0, count - 1 - math.floor(math.log10(number)))}f}"


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| worlds | solver | device | stopped at | ms per step | ms per step and world | error |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in sorted(
        rows, key=lambda r: (r["worlds"], r["solver"], -r["knob"] if r["knob"] < 1 else r["knob"])
    ):
        stop = f"{row['knob']:g}" if row["knob"] < 1 else f"{row['knob']} iterations"
        cells = [row["worlds"], row["solver"], row["device"], stop]
        if row["ms_per_step"] is None:
            cells += ["", "", row["note"]]
        else:
            error = "below 0.0001 %" if row["error"] < FLOOR else f"{digits(100 * row['error'], 2)} %"
            cells += [digits(row["ms_per_step"]), digits(row["ms_per_step"] / row["worlds"]), error]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def times_at(rows: list[dict]) -> str:
    """Markdown: time per step and world for each error of `LEVELS`, on straight lines between the rows in the
    figure. Outside of them it says that it takes more than the last row, or less than the first."""
    lines = [
        "| worlds | solver | device | " + " | ".join(f"{100 * level:g} %" for level in LEVELS) + " |",
        "|---" * (3 + len(LEVELS)) + "|",
    ]
    lines_of = {}
    for row in rows:
        if row["ms_per_step"] is not None:
            key = row["worlds"], row["solver"], row["device"]
            lines_of.setdefault(key, []).append((row["error"], row["ms_per_step"] / row["worlds"]))
    for key, points in sorted(lines_of.items()):
        error, time_ = np.log(np.maximum(sorted(points), FLOOR)).T
        cells = [
            ("above " if level < error[0] else "below " if level > error[-1] else "")
            + digits(math.exp(np.interp(level, error, time_)), 2)
            for level in np.log(LEVELS)
        ]
        lines.append("| " + " | ".join(map(str, [*key, *cells])) + " |")
    return "\n".join(lines)


def draw(rows: list[dict], path: pathlib.Path) -> None:
    """Error over time per step and world, a panel for each number of worlds that a GPU had; hollow marks are
    of a CPU. Numbers at the marks are where each was stopped. Cores beside each other are drawn in every
    panel of more than one world: more worlds than cores take turns."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = [row for row in rows if row["ms_per_step"] is not None]
    cores = {row["worlds"] for row in rows if row["device"] == "cpu"} - {1}
    numbers = sorted({row["worlds"] for row in rows if row["device"] != "cpu"} | {1})
    marks = dict(zip(NAMES.values(), (("o", "C3"), ("s", "C0"), ("^", "C2"), ("D", "C4")), strict=True))
    sides = {"C3": (-6, -3, "right"), "C0": (2, 6, "center"), "C4": (-3, -13, "center")}
    figure, axes = plt.subplots(
        1, len(numbers), figsize=(4.6 * len(numbers) + 0.6, 4.6), sharex=True, sharey=True, squeeze=False
    )
    names = {}
    for axis, worlds in zip(axes[0], numbers, strict=True):
        for (name, (mark, color)), gpu in [(m, g) for m in marks.items() for g in (True, False)]:
            mine = [
                row
                for row in rows
                if row["solver"] == name
                and (row["device"] != "cpu") == gpu
                and (
                    row["worlds"] == worlds
                    or (not gpu and worlds > 1 and row["worlds"] == max(cores, default=0))
                )
            ]
            if not mine:
                continue
            mine.sort(key=lambda row: row["error"])
            x = [row["ms_per_step"] / row["worlds"] for row in mine]
            y = [max(row["error"], FLOOR) for row in mine]
            where = "GPU" if gpu else "one core" if mine[0]["worlds"] == 1 else f"{mine[0]['worlds']} cores"
            label = f"{name}, {where}"
            face = color if gpu else "white"
            (line,) = axis.loglog(x, y, marker=mark, color=color, mfc=face, ls="-" if gpu else ":", lw=1)
            names.setdefault(label, line)
            *offset, side = sides[color] if gpu else (6, 2, "left")
            for row, a, b in zip(mine, x, y, strict=True):
                axis.annotate(f"{row['knob']:g}", (a, b), offset, textcoords="offset points", ha=side,
                              fontsize=8, color=color)  # fmt: skip
        axis.set_title(f"{worlds} world{'s' if worlds > 1 else ''}", fontsize=10)
        axis.set_xlabel("time per step and world [ms]")
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
        axis.grid(alpha=0.3)
        axis.margins(0.12)
    axes[0, 0].set_ylabel("error against its own converged press")
    figure.legend(names.values(), names.keys(), loc="lower center", ncols=3, fontsize=9, frameon=False)
    figure.tight_layout(rect=(0, 0.02 + 0.04 * -(-len(names) // 3), 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--device", default="cpu", help="cpu, or a CUDA device of Warp such as cuda:0")
    parser.add_argument(
        "--json",
        type=pathlib.Path,
        default="out/benchmarks/peers.json",
        help="file to write, or to go on with",
    )
    parser.add_argument("--solvers", help=f"comma-separated: {', '.join(KNOBS)}; what suits the device")
    parser.add_argument("--worlds", help="comma-separated; 1 on the CPU, 1,256,1024 on CUDA")
    parser.add_argument(
        "--knobs", help="comma-separated iterations or tolerances in place of the solvers' own"
    )
    parser.add_argument("--skin", default="default", choices=SKINS)
    parser.add_argument("--steps", type=int, default=STEPS, help="of 0.04 mm")
    parser.add_argument("--minutes", type=float, default=np.inf, help="no row is begun that would end later")
    parser.add_argument("--with", type=pathlib.Path, nargs="*", default=[], dest="others", metavar="JSON",
                        help="more files, for table and figure")  # fmt: skip
    parser.add_argument(
        "--table", action="store_true", help="print all rows, and times at equal errors, as Markdown"
    )
    parser.add_argument(
        "--figure", type=pathlib.Path, help="PNG to write: error over time per step and world"
    )
    parser.add_argument(
        "--no-runs", action="store_true", help="only the table and the figure of what is there"
    )
    options = parser.parse_args(arguments)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    on_cpu = options.device == "cpu"
    keys = (options.solvers or ("ours,flex" if on_cpu else "ours,vbd,flex_warp")).split(",")
    if unknown := [key for key in keys if key not in KNOBS]:
        parser.error(f"unknown solver {', '.join(unknown)}: choose from {', '.join(KNOBS)}")
    if not 1 <= options.steps <= STEPS:
        parser.error(f"--steps must be 1 to {STEPS}: deeper the skin meets the core, which the peers lack")
    for path in options.others:
        if not path.exists():
            parser.error(f"--with {path}: there is no such file")
    wp.config.log_level = wp.LOG_WARNING
    try:
        rows = Rows(options.json, {"skin": options.skin, "steps": options.steps})
    except ValueError as error:
        parser.error(str(error))
    if not options.no_runs:
        worlds = [int(n) for n in (options.worlds or ("1" if on_cpu else "1,256,1024")).split(",")]
        mujoco.set_mju_user_warning(lambda text: None)  # that a solver was stopped early is what is asked for
        try:
            run(rows, keys, worlds, options)
        finally:
            mujoco.set_mju_user_warning(None)
    found = rows.found["rows"] + [row for path in options.others for row in read_json(path, {})["rows"]]
    if options.table:
        print(table(found), times_at(found), sep="\n\n")
    if options.figure:
        draw(found, options.figure)
    return 0


def run(rows: Rows, keys, worlds, options) -> None:
    end = time.perf_counter() + 60 * options.minutes
    for key in [key for key in keys if SCENES.get(key) in peer_scenes.MISSING]:
        print(f"{NAMES[key]} is not installed: left out", file=sys.stderr)
        keys.remove(key)
    left_out = [("ours", count) for count in worlds if options.device == "cpu" and count > 1]
    plan = [(count, key) for count in worlds for key in keys if (key, count) not in left_out]
    bar = tqdm(plan, unit="solver", disable=None)
    for count, key in bar:
        bar.set_postfix_str(f"{NAMES[key]}, {count} worlds")
        device = "cpu" if key == "flex" else options.device
        name = "cpu" if device == "cpu" else wp.get_device(device).name
        knobs = KNOBS[key]
        if options.knobs is not None:
            knobs = [float(knob) if key == "ours" else int(knob) for knob in options.knobs.split(",")]
        todo = [
            knob for knob in knobs if not rows.has(solver=NAMES[key], device=name, worlds=count, knob=knob)
        ]
        if not todo:
            continue
        solver, pace = Solver(key, options.skin, options.steps, count, device), 0.0
        try:
            truth = rows.converged("MuJoCo flex" if key == "flex_warp" else NAMES[key], solver.converged)
        except Exception as error:
            tqdm.write(f"{NAMES[key]}: no converged press: {one_line(error)}")
            continue
        for knob in todo:
            left = end - time.perf_counter()
            if left < 0 or pace * knob > left:
                tqdm.write(f"{NAMES[key]}, {count} worlds, {knob:g}: left out, {left:.0f} s are left")
                continue
            row = measure(rows, solver, knob, truth)
            rows.add(row)
            if row["ms_per_step"] is None:
                said = row["note"]
            else:
                said = f"{row['ms_per_step']:.3g} ms per step, error {row['error']:.2%}"
                pace = 0.0 if key == "ours" else 1e-3 * row["ms_per_step"] * options.steps / knob
            tqdm.write(f"{row['solver']}, {name}, {count} worlds, {knob:g}: {said}")
        del solver


if __name__ == "__main__":
    sys.exit(main())
