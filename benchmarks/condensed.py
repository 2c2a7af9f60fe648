"""Error and time of the condensed tier against the full FEM by depth, and the fit of its correction.

    python benchmarks/condensed.py --json out/condensed.json [--skins coarse,default] [--materials
    default,rubber]
                                   [--indenters sphere_7mm,cube_14mm] [--markdown]
    python benchmarks/condensed.py --json out/condensed_time.json --time [--indenters sphere_7mm,cube_14mm]
    python benchmarks/condensed.py --json out/condensed_fit.json --fit [--materials default]
    python benchmarks/condensed.py --json out/condensed_field.json --field [--skins coarse]
    python benchmarks/condensed.py --json out/condensed_worlds.json --worlds 1,128,1024,4096 --device cuda:0
                                   [--skins coarse,default]

The same press is made with both tiers: along the inward normal at the location, to 2.4 mm, without noise of
its own in the comparison (both tiers draw the same). force: size of the force on the indenter. film: distance
from the inner surface to the core at the node where the press thins the film most. counts: root mean square
over the 19 electrodes of the tiers' difference, beside the largest change of any electrode in the full FEM.
"beyond": from this depth on the tier says itself that its error was not measured. ms: median of the processor
time of a step of the skin alone (no readings).

--fit finds the constants of `skin/condensed/correction.py` for the law of the material: least squares of the
logarithms of force and (weight 0.3) pressure against the full FEM over all presses, small errors squared and
large ones nearly linear.

--field: displacements of the inner surface, electrodes and PDC of the condensed tier over those of the full
FEM, on the same skin. bulge and pressed: slope, by least squares, of the displacements away from the core and
towards it, of nodes with more than a twentieth of the largest and more than 0.05 mm; in brackets what is
left of them, of their RMS, in %.

--worlds: a sphere of 7 mm goes 0.96 mm into the pad in steps of 0.04 mm, the same in all worlds, default
material with liquid, by the skin alone. Milliseconds a step (mean without the first, and largest), and of the
press for each world."""

import os

# before numpy reads them
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import dataclasses
import itertools
import pathlib
import sys
import time

import numpy as np
import scipy.optimize
import warp as wp

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from records import write_json

from biotac_mj.coupling import setup
from biotac_mj.coupling.steppers import fem
from biotac_mj.coupling.steppers.condensed import CondensedStepper
from biotac_mj.geometry.core_surface import CoreSurface
from biotac_mj.press import PressOptions, press
from biotac_mj.skin import PRESETS
from biotac_mj.skin.condensed import correction

__all__ = ["compare", "compare_fields", "fields", "fit", "main", "run", "time_steps"]

DEPTHS = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.2, 2.4)  # [mm]
INDENTERS = ("sphere_7mm", "cube_14mm", "cylinder_short_7mm")
LOCATIONS = ((-12e-3, 0.0), (-8e-3, 0.6))
_ROD, _PLATE = "geom:capsule:10mm,60mm", "geom:box:50mm,5mm,50mm"
FIELD_DEPTHS = (0.6, 1.0, 1.4)  # [mm]
FIELD_PRESSES = (
    ("sphere_7mm", -12e-3, 0.0),
    ("sphere_7mm", -8e-3, 0.6),
    ("cube_14mm", -12e-3, 0.0),
    (_PLATE, -4e-3, 0.0),
    (_ROD, -6e-3, 0.2),
    (_ROD, -12e-3, 0.0),
    (_ROD, -18e-3, 0.0),  # as a thumb holds it
    (_ROD, -18e-3, 0.5),
)


def run(
    tier: str,
    skin: str,
    indenter: str,
    location,
    material: str = "default",
    depth: float = 2.4e-3,
    timestep: float = 4e-3,
):
    """A press with one tier: its record and, of each step after the first, the skin's result and its seconds
    (wall, processor)."""
    results, seconds = [], []
    stepper = fem.FemStepper
    if tier == "condensed":
        stepper = CondensedStepper
    solve = stepper.solve_skin

    def timed(self, *arguments, **named):
        begin = time.perf_counter(), time.thread_time()
        result = solve(self, *arguments, **named)
        seconds.append((time.perf_counter() - begin[0], time.thread_time() - begin[1]))
        results.append(result)
        return result

    stepper.solve_skin = timed
    try:
        options = PressOptions(
            indenter=indenter,
            location=location,
            depth=depth,
            skin=skin,
            tier=tier,
            material=material,
            hold=0.0,
            timestep=timestep,
        )
        record, _ = press(options, progress=False)
    finally:
        stepper.solve_skin = solve
    n = len(record.depth) - 1
    return record, results[-n:], np.array(seconds[-n:])


def compare(full, condensed) -> list[dict]:
    """One row per depth of two records of the same press."""
    geometry = full.geometry
    core = CoreSurface(geometry.core_vert, geometry.core_face)
    node = np.unique(geometry.inner_face)

    def film(record, step):
        return core.closest(np.asarray(record.vert_xpos[step, node], float))[0]

    thinnest = (film(full, 0) - film(full, len(full.depth) - 1)).argmax()
    rows = []
    for depth in DEPTHS:
        step = int(np.abs(full.depth - 1e-3 * depth).argmin())
        if abs(full.depth[step] - 1e-3 * depth) > 1e-5:
            continue
        forces = [float(np.linalg.norm(record.force[step])) for record in (full, condensed)]
        films = [1e6 * float(film(record, step)[thinnest]) for record in (full, condensed)]
        change = [record.electrode_change[step] for record in (full, condensed)]
        rows.append(
            {
                "depth_mm": depth,
                "force_full_N": forces[0],
                "force_condensed_N": forces[1],
                "force_error": forces[1] / forces[0] - 1,
                "film_full_um": films[0],
                "film_condensed_um": films[1],
                "counts_largest_change": float(np.abs(change[0]).max()),
                "counts_rms_error": float(np.sqrt(((change[1] - change[0]) ** 2).mean())),
            }
        )
    return rows


def compare_fields(full, condensed, pressures, depths=FIELD_DEPTHS) -> list[dict]:
    """One row per depth of two records of the same press, with the pressures of both [Pa]: ratios of force
    and pressure, slopes of the condensed tier over the full one and what is left, of the RMS."""
    geometry = full.geometry
    node = np.unique(geometry.inner_face)
    core = CoreSurface(geometry.core_vert, geometry.core_face)
    node = node[core.closest(np.asarray(full.vert_xpos[0, node], float))[0] > 2e-5]  # others are held
    rest = np.asarray(full.vert_xpos[0, node], float)
    away = rest - core.closest(rest)[1]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    rows = []
    for depth in depths:
        step = int(np.abs(full.depth - 1e-3 * depth).argmin())
        records = full, condensed
        moved = [np.einsum("ij,ij->i", r.vert_xpos[step, node] - rest, away) for r in records]
        counts = [r.electrode_change[step] for r in records]
        force = [float(np.linalg.norm(r.force[step])) for r in records]
        bulged, pressed = moved[0] > 0.05 * moved[0].max(), moved[0] < -5e-5
        row = {"depth_mm": depth, "force": force[1] / force[0]}
        row["pressure"] = float(pressures[1][step - 1] / pressures[0][step - 1])
        for name, one, other in (
            ("bulge", moved[0][bulged], moved[1][bulged]),
            ("pressed", moved[0][pressed], moved[1][pressed]),
            ("electrodes", *counts),
        ):
            slope = float(one @ other / (one @ one))
            left = np.linalg.norm(other - slope * one) / np.linalg.norm(one)
            row |= {name: slope, f"{name}_left": float(left)}
        rows.append(row)
    return rows


def fields(skin: str, material: str) -> list[dict]:
    """Rows of `compare_fields` of FIELD_PRESSES, which are printed as a table."""
    print("| indenter, x mm, angle | mm | force | PDC | bulge | pressed | electrodes |\n" + "|---" * 7 + "|")
    out = []
    for indenter, *location in FIELD_PRESSES:
        pair = [
            run(tier, skin, indenter, location, material, 1e-3 * FIELD_DEPTHS[-1], _FIT_STEP)
            for tier in ("full", "condensed")
        ]
        pressures = [[r.pressure for r in results] for _, results, _ in pair]
        for row in compare_fields(pair[0][0], pair[1][0], pressures):
            out.append({"skin": skin, "material": material, "indenter": indenter, "location": location} | row)
            slopes = [
                f"{row[n]:.2f} ({100 * row[f'{n}_left']:.0f})" for n in ("bulge", "pressed", "electrodes")
            ]
            place = f"{indenter}, {1e3 * location[0]:.0f}, {location[1]:.1f}"
            cells = [
                place,
                f"{row['depth_mm']:.1f}",
                f"{row['force']:.2f}",
                f"{row['pressure']:.2f}",
                *slopes,
            ]
            print(f"| {' | '.join(cells)} |", flush=True)
    return out


def fit(skin: str, material: str, indenters, depth: float):
    """Constants of the correction for a material's law, by least squares over presses; prints the errors that
    are left."""
    law = PRESETS[material].law
    presses = [(indenter, location) for indenter in indenters for location in LOCATIONS]
    full = [run("full", skin, *press_, material, depth, _FIT_STEP) for press_ in presses]
    names = ("depth", "most", "width", "stretch", "squeeze")
    start = correction.correction(law)

    def residual(x):
        values = dict(zip(names, x * _SCALES, strict=True))
        correction.FITTED[law] = dataclasses.replace(start, **values)
        setup._skins.forget()
        out = []
        for press_, wanted in zip(presses, full, strict=True):
            mine = run("condensed", skin, *press_, material, depth, _FIT_STEP)
            force, wanted_force = (np.linalg.norm(record.force[1:], axis=1) for record, *_ in (mine, wanted))
            pressure, wanted_pressure = (
                np.maximum([r.pressure for r in results], 1.0) for _, results, _ in (mine, wanted)
            )
            out += [np.log(force / wanted_force), 0.3 * np.log(pressure / wanted_pressure)]
        out = np.concatenate(out) / np.sqrt(len(full[0][1]))
        print(
            ", ".join(f"{n} {v:.4g}" for n, v in values.items()),
            f"rms {np.sqrt((out**2).sum() / len(full)):.4f}",
            flush=True,
        )
        return out

    x = np.array([getattr(start, n) for n in names]) / _SCALES
    found = scipy.optimize.least_squares(
        residual,
        x,
        bounds=(_LEAST, _MOST),
        diff_step=0.05,
        x_scale=np.maximum(x, 0.5),
        max_nfev=12,
        loss="soft_l1",
        f_scale=0.05,
    )
    return {
        "law": law,
        "skin": skin,
        "material": material,
        **dict(zip(names, (found.x * _SCALES).tolist(), strict=True)),
        "cost": found.cost,
    }


# of the constants in the fit: millimetres, E
_SCALES, _LEAST, _MOST = np.array([1e-3, 1, 1e-3, 1, 1]), (1, 0.05, 0.5, 0.005, 0), (40, 3, 50, 1, 30)
_FIT_STEP = 1e-2  # [s], so 0.1 mm
_WORLD_STEPS = 25

COLUMNS = ("depth", "force full", "condensed", "error", "film full", "condensed", "counts", "rms error")


def _cells(row):
    return (
        f"{row['depth_mm']:.1f}",
        f"{row['force_full_N']:.3f}",
        f"{row['force_condensed_N']:.3f}",
        f"{100 * row['force_error']:+.1f} %",
        f"{row['film_full_um']:.0f}",
        f"{row['film_condensed_um']:.0f}",
        f"{row['counts_largest_change']:.0f}",
        f"{row['counts_rms_error']:.0f}",
    )


def _curves(cases):
    """Tables for the docs: force error, film error and counts error of each press by depth."""
    for title, cell in (
        ("force error %", lambda r: f"{100 * r['force_error']:+.1f}"),
        ("film error um", lambda r: f"{r['film_condensed_um'] - r['film_full_um']:+.0f}"),
        (
            "counts rms error (largest change)",
            lambda r: f"{r['counts_rms_error']:.0f} ({r['counts_largest_change']:.0f})",
        ),
    ):
        print(f"\n| {title} | " + " | ".join(f"{d:.1f}" for d in DEPTHS[1::2]) + " mm | beyond |")
        print("|---" * (len(DEPTHS[1::2]) + 2) + "|")
        for case in cases:
            rows = {r["depth_mm"]: cell(r) for r in case["rows"]}
            beyond = "" if case["measured_to_mm"] is None else f"{case['measured_to_mm']:.1f}"
            place = f"{1e3 * case['location'][0]:.0f} mm, {case['location'][1]:.1f}"
            print(f"| {case['skin']}, {case['material']}, {case['indenter']}, {place} | "
                  + " | ".join(rows.get(d, "") for d in DEPTHS[1::2]) + f" | {beyond} |")  # fmt: skip


def time_steps(skin: str, material: str, indenter: str, location, increment: float, again: int = 4) -> dict:
    """Processor time of the skin's solve in steps of a press [ms]: in the first press, and least of `again`
    more for each step."""
    first, *more = (
        1e3 * run("condensed", skin, indenter, location, material, timestep=increment / 10e-3)[2][:, 1]
        for _ in range(again + 1)
    )
    least = np.min(more, axis=0)
    shallow = len(least) * 10 // 24
    numbers = (
        np.median(first),
        np.median(least),
        np.median(least[:shallow]),
        np.median(least[shallow:]),
        least.max(),
    )
    names = ("first_press", "again", "to_1mm", "beyond_1mm", "slowest_step")
    return {"skin": skin, "material": material, "indenter": indenter, "increment_mm": 1e3 * increment,
            **{f"{n}_ms": float(v) for n, v in zip(names, numbers, strict=True)}}  # fmt: skip


def press_worlds(skin: str, nworld: int, device: str) -> tuple[np.ndarray, list[float]]:
    """A press of many worlds at once: seconds of each step, and the force of the first world at the end
    [N]."""
    from biotac_mj.coupling.config import Config
    from biotac_mj.geometry.skins import skin_reference
    from biotac_mj.skin import GeomSet, SkinData
    from biotac_mj.skin.condensed import CondensedStep, LinearSkin
    from biotac_mj.skin.settings import Settings

    settings, radius = Settings(*fem.skin_settings(Config(name="press_", skin=skin))), 7e-3
    geometry = skin_reference(skin)[1]
    model, twin = (fem.shared_model(geometry, settings, where) for where in (device, "cpu"))
    geoms = GeomSet(["sphere"], [(radius, 0, 0)], friction=[0.8], nworld=nworld, device=device)
    data = SkinData(model, nworld)
    step = CondensedStep(model, LinearSkin.of(twin), data, geoms)
    tangent = wp.zeros((1, nworld), dtype=wp.spatial_matrixd, device=device)
    geoms.struct.pos_last.fill_(wp.vec3d(np.nan, np.nan, np.nan))
    geoms.struct.mat.assign(np.tile(np.eye(3), (1, nworld, 1, 1)))
    taken = []
    for k in range(_WORLD_STEPS):
        pos = [-12e-3, twin.rest.vert[:, 1].min() - radius + 4e-5 * k, 0]
        geoms.struct.pos.assign(np.tile(pos, (1, nworld, 1)))
        wp.synchronize_device(device)
        begin = time.perf_counter()
        step.launch(tangent)
        wp.synchronize_device(device)
        taken.append(time.perf_counter() - begin)
        if (data.worlds.reason.numpy() != 0).any():
            raise RuntimeError(f"step {k} found no balance")
    return np.array(taken), data.geom_memory(1, 1)[2].numpy()[0, 0, :3].tolist()


def time_worlds(skins: list[str], counts: list[int], device: str) -> list[dict]:
    """A row for each skin and number of worlds."""
    rows = []
    for skin in skins:
        press_worlds(skin, 1, device)  # compiles, and makes what is kept
        for nworld in counts:
            taken, force = press_worlds(skin, nworld, device)
            row = {"skin": skin, "worlds": nworld, "step_ms": 1e3 * float(taken[1:].mean())}
            row |= {"slowest_ms": 1e3 * float(taken[1:].max()), "press_ms": 1e3 * float(taken.sum()) / nworld}
            rows.append(row | {"force_n": force})
            print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    return rows


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/condensed.json", help="file to write"
    )
    parser.add_argument("--skins", default="default", help="comma-separated")
    parser.add_argument("--materials", default="default", help="presets of the skin, comma-separated")
    parser.add_argument("--indenters", default=",".join(INDENTERS), help="comma-separated")
    parser.add_argument("--depth", type=float, default=2.4, help="of the presses [mm]")
    parser.add_argument("--locations", type=int, default=2, help="how many of the two locations")
    parser.add_argument("--markdown", action="store_true", help="tables for docs/lab/condensed.md")
    parser.add_argument(
        "--time", action="store_true", help="processor time of steps instead, without the full tier"
    )
    parser.add_argument(
        "--fit", action="store_true", help="fit the correction of the first skin and each material instead"
    )
    parser.add_argument("--field", action="store_true", help="compare displacements and electrodes instead")
    parser.add_argument("--worlds", help="comma-separated: time presses of so many worlds at once instead")
    parser.add_argument("--device", default="cuda:0", help="of Warp, with --worlds")
    options = parser.parse_args(arguments)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    wp.config.log_level = wp.LOG_WARNING
    skins, materials, indenters = (
        getattr(options, n).split(",") for n in ("skins", "materials", "indenters")
    )
    if options.worlds:
        rows = time_worlds(skins, [int(n) for n in options.worlds.split(",")], options.device)
        write_json(options.json, {"device": wp.get_device(options.device).name, "rows": rows})
        return 0
    if options.time:
        out = [
            time_steps(skin, material, indenter, LOCATIONS[0], increment)
            for skin, material, indenter, increment in itertools.product(
                skins, materials, indenters, (2e-5, 4e-5)
            )
        ]
        print(
            "| skin | material | indenter | step mm | first press | again | to 1 mm | beyond | slowest |\n"
            + "|---" * 9
            + "|"
        )
        for row in out:
            print("| " + " | ".join(f"{v:.2f}" if isinstance(v, float) else v for v in row.values()) + " |")
        write_json(options.json, {"times": out})
        return 0
    if options.field:
        rows = [row for pair in itertools.product(skins, materials) for row in fields(*pair)]
        write_json(options.json, {"fields": rows})
        return 0
    if options.fit:
        write_json(
            options.json,
            {"fits": [fit(skins[0], material, indenters, 1e-3 * options.depth) for material in materials]},
        )
        return 0
    out = []
    presses = itertools.product(skins, materials, indenters, LOCATIONS[: options.locations])
    for skin, material, indenter, location in presses:
        records, times = {}, {}
        for tier in ("full", "condensed"):
            records[tier], results, times[tier] = run(
                tier, skin, indenter, location, material, 1e-3 * options.depth
            )
        rows = compare(records["full"], records["condensed"])
        ms = {tier: (1e3 * np.median(t, 0)).tolist() for tier, t in times.items()}
        lost = int(records["condensed"].nonconverged[-1])
        measured = [r.measured for r in results]
        first = None if all(measured) else 1e3 * float(records["condensed"].depth[1:][np.argmin(measured)])
        print(
            f"\n{skin}, {material}, {indenter} at x = {1e3 * location[0]:.0f} mm, angle {location[1]:.1f} "
            "rad; "
            f"ms per step: full {ms['full'][0]:.1f} wall, {ms['full'][1]:.1f} cpu; condensed "
            f"{ms['condensed'][0]:.2f} wall, "
            f"{ms['condensed'][1]:.2f} cpu; condensed steps that did not converge: {lost}; measured to: "
            + ("the end" if first is None else f"{first:.2f} mm")
            + "\n"
        )
        print("".join(f"{c:>11} " for c in COLUMNS))
        for row in rows:
            print("".join(f"{c:>11} " for c in _cells(row)), flush=True)
        cost = {
            "ms_wall_and_cpu": ms,
            "condensed_ms_p95": (1e3 * np.quantile(times["condensed"], 0.95, axis=0)).tolist(),
        }
        out.append(
            {
                "skin": skin,
                "material": material,
                "indenter": indenter,
                "location": location,
                "rows": rows,
                "not_converged": lost,
                "measured_to_mm": first,
                **cost,
            }
        )
    if options.markdown:
        _curves(out)
    errors = [
        (abs(r["force_error"]), r["depth_mm"], c["measured_to_mm"] or 1e3) for c in out for r in c["rows"]
    ]
    summary = {
        "force_error_to_1mm": max(e for e, depth, _ in errors if depth <= 1.0),
        "force_error_measured": max(e for e, depth, end in errors if depth < end),
        "force_error": max(e for e, _, _ in errors),
    }
    print(
        "\nlargest force error to 1 mm {:.1f} %, where the tier says that it is measured {:.1f} %, to the "
        "end {:.1f} %".format(*(100 * e for e in summary.values()))
    )
    write_json(options.json, {"cases": out, **summary})
    return 0


if __name__ == "__main__":
    sys.exit(main())
