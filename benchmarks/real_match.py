"""A recording of a BioTac pressed on a force plate against the simulated sensor.

python benchmarks/real_match.py --electrodes E.txt --force F.txt --json OUT

Every tenth loaded row (more than 0.5 N) gets the state of the simulated skin under a flat plate that fits it
best: pitch, roll and the drag along and across, four numbers for 19 readings; how hard it presses is
measured. The sensor's constants (counts at rest, gains, warm-up, Young's modulus) are fitted to the first
70 % of the rows, the scores are those of the last 30 %. Beside them: all gains 1, the mean pattern without a
state, electrodes that the state has not seen, and the force from the electrodes alone."""

import argparse
import dataclasses
import pathlib
import sys
import time

import numpy as np
from records import write_json

from biotac_mj.geometry.skins import load_skin
from biotac_mj.matching.fit import Constants, Rows, Setup, fit_constants, fit_states, rows_of
from biotac_mj.matching.response import Response, log_changes
from biotac_mj.matching.states import plate_states
from biotac_mj.recordings import load_one
from biotac_mj.sensor.channels import counts_from_log_impedance
from biotac_mj.sensor.film import FilmConduction, read_film
from biotac_mj.skin.rubber.material import Material
from biotac_mj.skin.settings import read_material

_TRAIN_FRACTION = 0.7  # fraction of the rows, in time, for fitting constants
HELD_OUT = (1, 7, 8, 12, 16)  # of e2 e8 e9 e13 e17: sides, tip and pad
_TRIED = 13  # candidate loads for a row's force, down to a tenth of the largest
FREE = 4  # degrees of freedom of a row's state


@dataclasses.dataclass(frozen=True)
class Scores:
    """Errors of the model for changes of the counts from rest.

    Attributes:
      correlation_median, correlation_low: over the electrodes of a row; median and lowest tenth of the rows.
      rms_counts: root mean square of the error. rms_rel: relative to that of the measured change.
      rms_rel_mean: relative to that of the measured counts about their mean in the fitted rows, which is
        independent of the fitted baseline.
    """

    correlation_median: float
    correlation_low: float
    rms_counts: float
    rms_rel: float
    rms_rel_mean: float


def table(skin: str, material: str | Material, film: dict) -> Response:
    """What the simulated sensor says in the states of a plate; film: settings of FilmConduction."""
    geometry = load_skin(skin)
    states = plate_states(geometry, read_material(material))
    return Response(states, log_changes(states, FilmConduction(geometry, sensor=None, **film)))


def match(
    response: Response, rows: Rows, setup: Setup | None = None, estimate_force: bool = True
) -> tuple[dict, Constants]:
    """Fits constants to the first 70 % of rows and judges states of the last 30 %.

    Args:
      estimate_force: whether the force is also estimated from the electrodes only.

    Returns:
      what is written, and the constants.
    """
    setup = setup or Setup()
    cut = int(_TRAIN_FRACTION * len(rows))
    first, last = rows[:cut], rows[cut:]
    const, fitted = fit_constants(response, first, setup)
    found = fit_states(response, last, const, setup)
    seen = np.setdiff1d(np.arange(rows.counts.shape[1]), HELD_OUT)
    fewer = fit_states(response, last, const, setup, electrodes=seen)
    mean = first.counts.mean(0)
    out = dataclasses.asdict(_scores(last, found.counts, const, mean))
    out |= {
        "rows": len(last),
        "free_per_row": FREE if len(response.drag_paths) > 1 else 2,
        "known_per_row": rows.counts.shape[1] + 2 * bool(setup.shear),
        "fitted_part": dataclasses.asdict(_scores(first, fitted.counts, const, mean)),
        "held_out_electrodes": [f"e{i + 1}" for i in HELD_OUT],
        "held_out": dataclasses.asdict(_scores(last, fewer.counts, const, mean, np.array(HELD_OUT))),
        "mean_pattern": dataclasses.asdict(
            _scores(last, np.broadcast_to(mean, last.counts.shape), const, mean)
        ),
        "electrode_rms_counts": np.sqrt(((found.counts - last.counts) ** 2).mean(0)).round(1).tolist(),
        "shear_rms_N": np.sqrt(((found.force - last.force[:, :2]) ** 2).mean(0)).round(3).tolist(),
        "modulus_Pa": const.modulus,
        "gains": const.gain.round(3).tolist(),
        "rest_counts": counts_from_log_impedance(const.offset).round(0).tolist(),
        "drift": {"size_ln_Z": const.drift[0], "tau_share_of_recording": float(np.exp(const.drift[1]))},
    }
    if estimate_force:
        out["force_alone_N"] = _force_from_electrodes(response, first, fitted, last, const, setup)
    return out, const


def _force_from_electrodes(response, first, fitted, rows, const, setup):
    """RMSE [N] along, across, pressing, of the force estimated from the electrodes only, and its spread.

    The best of several loads, refined by a parabola. The prior of a load is its frequency in the first rows,
    and the electrodes' error is that of the first rows."""
    blind = dataclasses.replace(setup, shear=0.0)
    top = first.force[:, 2].max()
    loads = np.geomspace(top / 10, top * 1.2, _TRIED)
    fits, also = [], None
    for load in loads:
        force = np.concatenate([rows.force[:, :2], np.full((len(rows), 1), load)], 1)
        fits.append(fit_states(response, Rows(rows.counts, force, rows.time), const, blind, also=also))
        also = fits[-1].state
    sigma = _rms(fitted.counts - first.counts)
    usual = (loads - first.force[:, 2].mean()) / first.force[:, 2].std()
    cost = np.array([f.cost for f in fits]) / sigma**2 + (usual * usual)[:, None]
    k = np.clip(cost.argmin(0), 1, _TRIED - 2)
    row = np.arange(len(rows))
    before, here, after = (cost[k + i, row] for i in (-1, 0, 1))
    bend = before - 2 * here + after
    shift = np.clip(np.where(bend > 0, 0.5 * (before - after) / np.where(bend > 0, bend, 1), 0), -1, 1)
    pressing = np.exp(np.log(loads)[k] + shift * np.log(loads[1] / loads[0]))
    guess = np.column_stack([np.array([f.force for f in fits])[k, row], pressing])
    error = np.sqrt(((guess - rows.force) ** 2).mean(0))
    spread = rows.force.std(0)
    return {
        name: {"rmse": float(e), "std": float(s)}
        for name, e, s in zip(("along", "across", "pressing"), error, spread)
    }


def _scores(rows, counts, const, mean, electrodes=None):
    which = np.arange(rows.counts.shape[1]) if electrodes is None else electrodes
    rest = counts_from_log_impedance(const.offset + const.drifted(rows.time)[:, None])
    measured, modelled = (rows.counts - rest)[:, which], (counts - rest)[:, which]
    a, b = (x - x.mean(1, keepdims=True) for x in (measured, modelled))
    correlation = (a * b).sum(1) / np.sqrt((a * a).sum(1) * (b * b).sum(1))
    rms = _rms(measured - modelled)
    return Scores(
        float(np.median(correlation)),
        float(np.percentile(correlation, 10)),
        rms,
        rms / _rms(measured),
        rms / _rms((rows.counts - mean)[:, which]),
    )


def _rms(x):
    return float(np.sqrt((x * x).mean()))


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
