"""A recording of a BioTac pressed on a force plate against the simulated sensor.

python benchmarks/real_match.py --electrodes E.txt --force F.txt --json OUT

Every tenth loaded row (more than 0.5 N) gets the state of the simulated skin under a flat plate that fits it
best: pitch, roll and the drag along and across, four numbers for 19 readings; how hard it presses is
measured. The sensor's constants (counts at rest, gains, warm-up, Young's modulus) are fitted to the first
70 % of the rows, the scores are those of the last 30 %. Beside them: all gains 1, the mean pattern without a
state, electrodes that the state has not seen, and the force from the electrodes alone."""

import argparse
import pathlib
import sys
import time

from records import write_json

from biotac_mj.geometry.skins import load_skin
from biotac_mj.matching.fit import Setup
from biotac_mj.matching.match import log_changes, match, rows_of
from biotac_mj.matching.response import Response
from biotac_mj.matching.states import plate_states
from biotac_mj.recordings import load_one
from biotac_mj.sensor.film import FilmConduction, read_film
from biotac_mj.skin.rubber.material import Material
from biotac_mj.skin.settings import read_material


def table(skin: str, material: str | Material, film: dict) -> Response:
    """What the simulated sensor says in the states of a plate; film: settings of FilmConduction."""
    geometry = load_skin(skin)
    states = plate_states(geometry, read_material(material))
    return Response(states, log_changes(states, FilmConduction(geometry, sensor=None, **film)))


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--electrodes", required=True, help="text: 19 columns of counts")
    parser.add_argument("--force", required=True, help="text: Fx Fy Fz [N], as many rows")
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/real_match.json", help="where the scores go"
    )
    parser.add_argument("--skin", default="coarse", help="skin of the table of states")
    what = "preset, .json file or JSON of rubber and filling, of which E is fitted"
    parser.add_argument("--material", default="calibrated", help=what)
    parser.add_argument("--radius", type=float, help="of the electrodes [m]; default: the material's")
    parser.add_argument("--every", type=int, default=10, help="of the loaded rows one is taken")
    given = parser.parse_args(argv)
    given.json.parent.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    try:
        recording, _ = load_one(given.electrodes, force=given.force)
        rows = rows_of(recording.counts()[0], recording.force, given.every)
        material = read_material(given.material)
        film = read_film(None, given.radius or material.electrode_radius)
        response = table(given.skin, material, film)
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"real_match: {error}")
    found = match(response, rows)[0]
    found["gains_one"] = match(response, rows, Setup(gains=0.0), estimate_force=False)[0]
    found["seconds"] = time.perf_counter() - begin
    write_json(given.json, found)
    print(report(found))


def report(found: dict) -> str:
    """The scores as lines."""
    lines = [f"{found['rows']} rows, {found['free_per_row']} numbers each fitted to {found['known_per_row']}"]
    one = found["gains_one"]
    for name, part in (
        ("the last 30 %", found),
        ("  with all gains 1", one),
        ("  the mean pattern, no state", found["mean_pattern"]),
        ("  electrodes not seen", found["held_out"]),
        ("  the same with all gains 1", one["held_out"]),
        ("fitted part", found["fitted_part"]),
    ):
        lines.append(
            f"{name:30s} correlation {part['correlation_median']:.3f} "
            f"(lowest tenth {part['correlation_low']:.2f}), "
            f"RMS {part['rms_counts']:.0f} counts, {part['rms_rel']:.3f} of the change, "
            f"{part['rms_rel_mean']:.3f} of the spread"
        )
    force = found["force_alone_N"]
    lines.append(
        "force from the electrodes alone: "
        + ", ".join(f"{k} {v['rmse']:.2f} N (spread {v['std']:.2f})" for k, v in force.items())
    )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
