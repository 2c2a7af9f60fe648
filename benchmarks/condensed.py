"""Error and time of the condensed tier against the full FEM: force, film thickness and counts by depth.

    python benchmarks/condensed.py --json out/condensed.json [--skins coarse,default] [--indenters sphere_7mm,cube_14mm] [--markdown]

The same press is made with both tiers: along the inward normal at the location, to 2.4 mm, without noise of its own in the comparison
(both tiers draw the same). force: size of the force on the indenter. film: distance from the inner surface to the core at the node
where the press thins the film most. counts: root mean square over the 19 electrodes of the tiers' difference, beside
the largest change of any electrode in the full FEM. ms: median time of a step of 0.04 mm of the skin alone (no readings), of which half
are slower: wall time and processor time of the thread.
"""

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")  # before numpy reads them

import argparse
import pathlib
import sys
import time

import numpy as np
import warp as wp

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from accuracy import write_json

from biotac_mj.coupling import fem
from biotac_mj.press import PressOptions, press
from biotac_mj.sensor.core_surface import CoreSurface

__all__ = ["compare", "main", "run"]

DEPTHS = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.2, 2.4)  # [mm]
INDENTERS = ("sphere_7mm", "cube_14mm", "cylinder_short_7mm")
LOCATIONS = ((-12e-3, 0.0), (-8e-3, 0.6))


def run(tier: str, skin: str, indenter: str, location, material: str = "default", depth: float = 2.4e-3):
    """A press with one tier: its record and the seconds of each of the skin's solves (n, 2), wall and processor time."""
    seconds = []
    stepper = fem.FemStepper
    if tier == "condensed":
        from biotac_mj.coupling.condensed import CondensedStepper as stepper
    solve = stepper.solve

    def timed(self, *arguments):
        begin = time.perf_counter(), time.thread_time()
        result = solve(self, *arguments)
        seconds.append((time.perf_counter() - begin[0], time.thread_time() - begin[1]))
        return result

    stepper.solve = timed
    try:
        options = PressOptions(
            indenter=indenter, location=location, depth=depth, skin=skin, tier=tier, material=material, hold=0.0, timestep=4e-3
        )
        record, _ = press(options, progress=False)
    finally:
        stepper.solve = solve
    return record, np.array(seconds[1:])


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


COLUMNS = ("depth", "force full", "condensed", "error", "film full", "condensed", "counts", "rms error")


def _cells(row):
    return (f"{row['depth_mm']:.1f}", f"{row['force_full_N']:.3f}", f"{row['force_condensed_N']:.3f}", f"{100 * row['force_error']:+.1f} %",
            f"{row['film_full_um']:.0f}", f"{row['film_condensed_um']:.0f}", f"{row['counts_largest_change']:.0f}",
            f"{row['counts_rms_error']:.0f}")  # fmt: skip


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", type=pathlib.Path, required=True, help="file to write")
    parser.add_argument("--skins", default="default", help="comma-separated")
    parser.add_argument("--material", default="default", help="preset of the skin")
    parser.add_argument("--indenters", default=",".join(INDENTERS), help="comma-separated")
    parser.add_argument("--depth", type=float, default=2.4, help="of the presses [mm]")
    parser.add_argument("--locations", type=int, default=2, help="how many of the two locations")
    parser.add_argument("--markdown", action="store_true", help="tables for docs/condensed.md")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    out, bar = [], "| " if options.markdown else ""
    for skin in options.skins.split(","):
        for indenter in options.indenters.split(","):
            for location in LOCATIONS[: options.locations]:
                records, times = {}, {}
                for tier in ("full", "condensed"):
                    records[tier], times[tier] = run(tier, skin, indenter, location, options.material, 1e-3 * options.depth)
                rows = compare(records["full"], records["condensed"])
                ms = {tier: (1e3 * np.median(t, 0)).tolist() for tier, t in times.items()}
                lost = int(records["condensed"].nonconverged[-1])
                print(f"\n{skin}, {options.material}, {indenter} at x = {1e3 * location[0]:.0f} mm, angle {location[1]:.1f} rad; "
                      f"ms per step: full {ms['full'][0]:.1f} wall, {ms['full'][1]:.1f} cpu; condensed {ms['condensed'][0]:.2f} wall, "
                      f"{ms['condensed'][1]:.2f} cpu; condensed steps that did not converge: {lost}\n")  # fmt: skip
                print(bar + bar.join(f"{c:>11} " for c in COLUMNS) + bar)
                if options.markdown:
                    print("|---" * len(COLUMNS) + "|")
                for row in rows:
                    print(bar + bar.join(f"{c:>11} " for c in _cells(row)) + bar, flush=True)
                cost = {"ms_wall": ms, "condensed_ms_p95": (1e3 * np.quantile(times["condensed"], 0.95, axis=0)).tolist()}
                out.append({"skin": skin, "material": options.material, "indenter": indenter, "location": location, "rows": rows,
                            "not_converged": lost, **cost})  # fmt: skip
    up_to_1mm = max(abs(r["force_error"]) for case in out for r in case["rows"] if r["depth_mm"] <= 1.0)
    overall = max(abs(r["force_error"]) for case in out for r in case["rows"])
    print(f"\nlargest force error to 1 mm {100 * up_to_1mm:.1f} %, to the end {100 * overall:.1f} %")
    write_json(options.json, {"cases": out, "force_error_to_1mm": up_to_1mm, "force_error": overall})
    return 0


if __name__ == "__main__":
    sys.exit(main())
