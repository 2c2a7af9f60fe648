"""Speed of the standard press; `peers.py` has other programs on the same mesh and press.

    python benchmarks/speed.py --device cpu --json out/speed.json [--skins coarse,default,fine]
    python benchmarks/speed.py --device cuda:0 --json out/speed_gpu.json --skins coarse,default,fine
                               --worlds 1,16,128,1024,4096
    python benchmarks/speed.py --against DIR --json out/against.json [--device cuda:0 --worlds 1,128]

The standard press: a sphere of 7 mm diameter on the pad's midline at x = -12 mm, along the inward normal of
the outer surface there, the paper's constants, 60 increments of 0.04 mm from first touch to 2.4 mm, where the
skin meets the core; with liquid and without. A CPU run is held to one core. Kernels are compiled and the
factor is made before the clock starts (`setup_s` is the model and its factor); what is timed is the first
press of a fresh skin, with every cost that a user's press has. `cpu_ms_per_press` is the processor time of
the same press: where it is well below the wall time, other programs shared the core.

force_error_rel: mean over increments of |F - F_tight| over the largest |F_tight|, F_tight from the same press
solved on the CPU in double precision to a tolerance of 1e-6: what stopping early and, on a GPU, single
precision cost, not what the mesh costs.
mb_per_world: device memory that a world of the batch takes; what the model takes once is `mb_model`. A row
that does not fit says so.
For the condensed tier F_tight is the full tier's press of the row above (docs/lab/condensed.md says more).

--against DIR: only the press, in turns with that of another checkout, each in a process of its own: the
least of the times of 5 presses each, and the ratio of this one's to that one's; processor time on the CPU,
wall time on CUDA.
"""

import os

os.environ.update(
    OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1"
)  # before numpy reads them

import argparse
import functools
import itertools
import json
import pathlib
import platform
import sys
import time

import numpy as np
import warp as wp

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from checkouts import beside, run_with
from records import write_json
from timed_press import RADIUS, clocks, press

from biotac_mj.geometry import SKINS, SkinGeometry, load_skin
from biotac_mj.press.approach import nearest_point, surface_point
from biotac_mj.skin import PRESETS, GeomSet, SkinData, SkinModel, SkinOptions

__all__ = ["compare", "main", "press", "standard_path", "time_skin"]

PLACE = -12e-3  # x of the press [m]
INCREMENT = 4e-5  # [m]
INCREMENTS = 60
TIGHT = 1e-6  # tolerance of the press that force errors are measured against
TURNS = 5  # presses of each checkout that are compared
TO_1MM = 25  # increments
COLUMNS = (
    "device",
    "solver",
    "skin",
    "element",
    "tier",
    "liquid",
    "worlds",
    "tolerance",
    "ms_per_press",
    "cpu_ms_per_press",
    "ms_per_press_and_world",
    "ms_per_step",
    "mb_per_world",
    "setup_s",
    "force_error_rel",
    "not_converged",
)


def standard_path(geometry: SkinGeometry, increments: int = INCREMENTS) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the sphere (increments + 1, 3) [m], the first at first touch, and the unit direction (3,) of
    the press."""
    point, normal = surface_point(geometry, PLACE, 0.0)
    center = point + (RADIUS + 1e-3) * normal
    for _ in range(200):  # the gap is never more than the way left
        gap = np.linalg.norm(nearest_point(geometry, center)[0] - center) - RADIUS
        center = center - gap * normal
        if gap < 1e-9:
            break
    return center - np.outer(np.arange(increments + 1) * INCREMENT, normal), -normal


@functools.cache
def _compile(element, device):
    """Compiles what making a model needs."""
    SkinModel(load_skin("coarse"), PRESETS["paper"], SkinOptions(element=element), device=device).factor  # noqa: B018


@functools.cache
def _model(skin, element, liquid, device, tolerance):
    """The model of a row, with its factor, and the seconds and the device memory [bytes] that it takes."""
    most = 60 if tolerance < 1e-4 else SkinOptions.max_newton
    options = SkinOptions(element=element, liquid=liquid, tolerance=tolerance, max_newton=most)

    def make():
        model = SkinModel(load_skin(skin), PRESETS["paper"], options, device=device)
        model.factor  # noqa: B018  made once for each model
        return model

    _compile(element, device)
    begin, memory = time.perf_counter(), _used(device)
    model = make()
    return model, time.perf_counter() - begin, _used(device) - memory


@functools.cache
def _tight(skin, element, liquid, increments, folder=None):
    """Forces (increments, 1, 3) of the same press solved tightly in double precision on the CPU, and steps
    that did not converge.

    Where a folder is named they are kept there for the next run.
    """
    file = folder and folder / f"{skin}_{element}_{'liquid' if liquid else 'dry'}_{increments}.npz"
    if file and file.exists():
        with np.load(file) as kept:
            return kept["force"], int(kept["lost"])
    force, _, lost = press(
        _model(skin, element, liquid, "cpu", TIGHT)[0], standard_path(load_skin(skin), increments)[0]
    )
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        partial = file.with_suffix(".part.npz")
        np.savez(partial, force=force, lost=lost)
        partial.replace(file)
    return force, lost


def _used(device) -> int:
    """Memory in use on a CUDA device, by Warp and by torch [bytes]; 0 on the CPU."""
    if device == "cpu":
        return 0
    import torch

    return wp.get_mempool_used_mem_current(device) + torch.cuda.memory_allocated(
        wp.device_to_torch(wp.get_device(device))
    )


def _per_world(model, worlds) -> float:
    """Device memory [bytes] of a world in a batch."""
    if not model.device.is_cuda:
        return 0.0
    from biotac_mj.skin import prepare_step

    before = _used(str(model.device))
    data = SkinData(model, worlds)
    geoms = GeomSet(
        ["sphere"], [(RADIUS,)], [model.material.friction], nworld=worlds, device=str(model.device)
    )
    prepare_step(model, data, geoms)
    return (_used(str(model.device)) - before) / worlds


def time_skin(
    skin: str,
    element: str,
    liquid: bool,
    device: str,
    worlds: int,
    increments: int,
    tolerance: float = SkinOptions.tolerance,
    references=None,
) -> dict:
    """A row of the table, with the forces of the first world (increments, 3) beside it."""
    geometry = load_skin(skin)
    path, _ = standard_path(geometry, increments)
    model, setup, memory = _model(skin, element, liquid, device, tolerance)
    row = {
        "device": device,
        "solver": "biotac_mj",
        "skin": skin,
        "element": element,
        "tier": "full",
        "liquid": liquid,
        "worlds": worlds,
        "tolerance": tolerance,
    }
    row |= {"setup_s": setup, "mb_model": memory / 1e6, "mb_per_world": None, "increments": increments}
    if device != "cpu":
        total = wp.get_device(device).total_memory
        per_world = _per_world(model, min(worlds, 32))
        if memory + per_world * worlds > 0.95 * total:
            note = f"does not fit: {(memory + per_world * worlds) / 1e9:.0f} GB of {total / 1e9:.0f}"
            return row | {"note": note, "mb_per_world": per_world / 1e6}
        per_world = _per_world(model, worlds)
        row |= {"mb_per_world": per_world / 1e6, "largest_nworld": int((0.95 * total - memory) / per_world)}
    press(model, path[:2], worlds)  # compiles
    force, seconds, lost = press(model, path, worlds)
    again = press(model, path, worlds)[1] if worlds <= 128 else seconds
    tight, lost_tight = _tight(skin, element, liquid, increments, references)
    wrong = np.linalg.norm(force - tight, axis=2).mean(1)
    return row | {
        "ms_per_press": 1e3 * seconds[:, 0].sum(),
        "cpu_ms_per_press": 1e3 * seconds[:, 1].sum(),
        "ms_per_press_and_world": 1e3 * seconds[:, 0].sum() / worlds,
        "ms_per_step": 1e3 * seconds[:, 0].mean(),
        "ms_slowest_step": 1e3 * seconds[:, 0].max(),
        "ms_median_step": 1e3 * float(np.median(seconds[:, 0])),
        "ms_per_press_again": 1e3 * again[:, 0].sum() if again is not seconds else None,
        "force_error_rel": float(wrong.mean() / np.linalg.norm(tight, axis=2).max()),
        "not_converged": lost,
        "not_converged_tight": lost_tight,
        "peak_force_N": float(np.linalg.norm(force[:, 0], axis=1).max()),
        "force": force[:, 0].tolist(),
        "wall_and_cpu_ms_of_steps": (1e3 * seconds).tolist(),
    }


def time_condensed(ours: dict) -> dict:
    """The condensed tier on the press of one of our rows; its row, with errors against the forces of that
    row."""
    from biotac_mj.skin.condensed import CondensedSkin, Memory

    geometry = load_skin(ours["skin"])
    path, _ = standard_path(geometry, ours["increments"])
    model = SkinModel(geometry, PRESETS["paper"], SkinOptions(element=ours["element"], liquid=ours["liquid"]))
    mat = np.eye(3)[None]

    def walk(skin):
        memory, force, seconds, lost = Memory.rest(1), [], [], 0
        for center in path[1:]:
            begin = clocks()
            out = skin.solve(memory, center[None], mat)
            seconds.append(clocks() - begin)
            memory, lost = out.memory, lost + (not out.converged)
            force.append(out.wrench[0, :3])
        return np.array(force), np.array(seconds), lost

    def make():
        return CondensedSkin(model, GeomSet(["sphere"], [(RADIUS,)], [model.material.friction]))

    make().solve(
        Memory.rest(1), path[1:2], mat
    )  # compiles, and computes the compliance where it is not yet on disk
    begin = time.perf_counter()
    skin = make()
    setup = time.perf_counter() - begin
    force, seconds, lost = walk(skin)
    wanted = np.array(ours["force"])
    size = np.linalg.norm(wanted, axis=1)
    wrong = np.linalg.norm(force - wanted, axis=1)
    to_1mm = slice(0, TO_1MM)
    return {
        "device": "cpu",
        "solver": "biotac_mj",
        "skin": ours["skin"],
        "element": ours["element"],
        "tier": "condensed",
        "liquid": ours["liquid"],
        "worlds": 1,
        "ms_per_press": 1e3 * seconds[:, 0].sum(),
        "cpu_ms_per_press": 1e3 * seconds[:, 1].sum(),
        "ms_per_step": 1e3 * seconds[:, 0].mean(),
        "ms_slowest_step": 1e3 * seconds[:, 0].max(),
        "ms_per_press_again": 1e3 * walk(skin)[1][:, 0].sum(),
        "setup_s": setup,
        "force_error_rel": float(wrong.mean() / size.max()),
        "force_error_to_1mm": float((wrong / size)[to_1mm].max()),
        "not_converged": lost,
        "increments": ours["increments"],
        "peak_force_N": float(np.linalg.norm(force, axis=1).max()),
        "force": force.tolist(),
        "wall_and_cpu_ms_of_steps": (1e3 * seconds).tolist(),
    }


def compare(
    other: pathlib.Path, cases: list[tuple], turns: int = TURNS, material: str = "paper"
) -> list[dict]:
    """This checkout against another: a row for each case, (skin, element, liquid, device, worlds,
    increments)."""
    rows = []
    with beside(other) as folders:
        for case in cases:
            skin, increments = case[0], case[-1]
            path = standard_path(load_skin(skin), increments)[0].tolist()
            worker = [
                pathlib.Path(__file__).parent / "timed_press.py",
                json.dumps([*case[:-1], path, material]),
            ]
            seconds = {name: [] for name in folders}
            for _ in range(turns):
                for name, folder in folders.items():
                    seconds[name].append(json.loads(run_with(folder, worker, 1).splitlines()[-1]))
            least = {name: min(found) for name, found in seconds.items()}
            row = dict(
                zip(("skin", "element", "liquid", "device", "worlds", "increments"), case, strict=True)
            )
            row |= {"clock": "processor" if row["device"] == "cpu" else "wall", "material": material}
            row |= {f"{name}_s": found for name, found in least.items()} | {"seconds": seconds}
            rows.append(row | {"ratio": least["here"] / least["against"]})
            print(
                f"{row['skin']:<9}{row['element']:<10}{'liquid' if row['liquid'] else 'dry':<7}"
                f"{row['worlds']:>6} worlds  here {1e3 * least['here']:.1f} ms  against "
                f"{1e3 * least['against']:.1f} ms  ratio {rows[-1]['ratio']:.3f}",
                flush=True,
            )
    return rows


def _cpu_name() -> str:
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _print_row(row):
    cells = []
    for column in COLUMNS:
        value = row.get(column, "")
        if value is None or value == "":
            value = ""
        elif column == "force_error_rel":
            value = f"{value:.2%}"
        elif isinstance(value, float):
            value = f"{value:.3g}" if column == "tolerance" else f"{value:.2f}"
        cells.append(f"{value!s:>{max(9, len(column) + 1)}}" if column != "solver" else f"{value:>20}")
    print("".join(cells), row.get("note", ""), flush=True)


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--device", default="cpu", help="cpu, or a CUDA device of Warp such as cuda:0")
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/speed.json", help="file to write"
    )
    parser.add_argument("--skins", default="default", help=f"comma-separated: {', '.join(SKINS)}")
    parser.add_argument(
        "--elements",
        default="quadratic,linear",
        help="comma-separated: quadratic (the default), linear (the paper's)",
    )
    parser.add_argument("--worlds", default="1", help="comma-separated numbers of skins solved together")
    parser.add_argument(
        "--tolerances", default=str(SkinOptions.tolerance), help="comma-separated tolerances of the solver"
    )
    parser.add_argument("--increments", type=int, default=INCREMENTS, help="how many increments of 0.04 mm")
    parser.add_argument(
        "--references",
        type=pathlib.Path,
        help="folder that keeps the tight presses that errors are measured against",
    )
    parser.add_argument("--against", type=pathlib.Path, help="the root of another checkout: see above")
    parser.add_argument("--material", default="paper", choices=PRESETS, help="with --against: a preset")
    options = parser.parse_args(arguments)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    skins = options.skins.split(",")
    if unknown := [skin for skin in skins if skin not in SKINS]:
        parser.error(f"unknown skin {', '.join(unknown)}: choose from {', '.join(SKINS)}")
    if options.increments < 1:
        parser.error("--increments must be at least 1")
    if options.against:
        cases = [
            (skin, element, liquid, options.device, int(worlds), options.increments)
            for skin in skins
            for element in options.elements.split(",")
            for worlds in options.worlds.split(",")
            for liquid in (False, True)
        ]
        write_json(options.json, {"rows": compare(options.against, cases, material=options.material)})
        return 0
    wp.config.log_level = wp.LOG_WARNING
    machine = _cpu_name()
    if options.device == "cpu" and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        machine += ", held to one core"
    elif options.device != "cpu":
        machine = f"{wp.get_device(options.device).name}, host {machine}"
    print(f"standard press, {options.increments} increments of 0.04 mm, on {machine}")
    print("".join(f"{c:>{max(9, len(c) + 1)}}" if c != "solver" else f"{c:>20}" for c in COLUMNS))
    rows = []
    for skin in skins:
        for element, liquid in itertools.product(options.elements.split(","), (False, True)):
            for tolerance in map(float, options.tolerances.split(",")):
                for worlds in map(int, options.worlds.split(",")):
                    row = time_skin(
                        skin,
                        element,
                        liquid,
                        options.device,
                        worlds,
                        options.increments,
                        tolerance,
                        options.references,
                    )
                    rows.append({**row, "machine": machine})
                    _print_row(rows[-1])
                if "largest_nworld" in rows[-1]:
                    print(
                        f"  model {rows[-1]['mb_model']:.0f} MB; "
                        f"the largest nworld here: {rows[-1]['largest_nworld']}",
                        flush=True,
                    )
            _model.cache_clear()
    if options.device == "cpu":
        for ours in [row for row in rows if row["worlds"] == 1]:
            rows.append({**time_condensed(ours), "machine": machine})
            _print_row(rows[-1])
    write_json(options.json, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
