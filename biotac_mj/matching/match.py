"""Match of the sensor's model with a recording of a flat press, evaluated on its last part."""

import dataclasses

import numpy as np

from ..sensor.channels import counts_from_log_impedance
from ..sensor.film import FilmConduction
from .fit import Constants, Rows, Setup, fit_constants, fit_states
from .response import Response
from .states import PlateStates

__all__ = ["HELD_OUT", "SIGNS", "Scores", "log_changes", "match", "rows_of"]

_LOADED = 0.5  # [N] least force of a loaded row
_TRAIN_FRACTION = 0.7  # fraction of the rows, in time, for fitting constants
_FEWEST = 40  # least number of loaded rows
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


def log_changes(states: PlateStates, film: FilmConduction) -> np.ndarray:
    """(npitch, nroll, npath, nload, nelectrode) change of ln Z from rest in the states, by a film of their
    skin."""
    vert = film.geometry.vert.copy()
    places = states.xpos.reshape(-1, *states.xpos.shape[-2:])
    out = np.empty((len(places), film.design.nelectrode))
    rest = np.log(film.impedance(_with(vert, states.node, states.rest)))
    for i, place in enumerate(places):
        out[i] = np.log(film.impedance(_with(vert, states.node, place))) - rest
    return out.reshape(*states.xpos.shape[:-2], -1)


def _with(vert, node, place):
    vert[node] = place
    return vert


def rows_of(counts: np.ndarray, force: np.ndarray | None, every: int = 10) -> Rows:
    """Every tenth loaded row of raw counts (n, nelectrode) and force (n, 3) (across, along, away from the
    plate) [N].

    Raises:
      ValueError: no force, or too few loaded rows.
    """
    if force is None:
        raise ValueError("a match needs the force: give a file of Fx Fy Fz [N], as many rows")
    loaded = np.flatnonzero(np.linalg.norm(force, axis=1) > _LOADED)
    pushing = np.median(force[loaded, 2]) if len(loaded) else 0.0
    if pushing >= 0:
        raise ValueError(
            f"Fz is {pushing:.2g} N in the median of {len(loaded)} rows above {_LOADED} N: a press "
            "has it negative; give Fx Fy Fz [N] of the plate, z out of the sensor"
        )
    taken = loaded[::every]
    if len(taken) < _FEWEST:
        raise ValueError(
            f"{len(loaded)} rows have more than {_LOADED} N of force: {every * _FEWEST} are needed"
        )
    return Rows(counts[taken], force[taken] @ SIGNS, taken / len(counts))


# Fx, Fy, Fz of a recording as along, across, pressing
SIGNS = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def match(
    response: Response, rows: Rows, setup: Setup | None = None, estimate_force: bool = True
) -> tuple[dict, Constants]:
    """Fits constants to the first 70 % of rows and judges states of the last 30 %.

    Args:
      estimate_force: whether the force is also estimated from the electrodes only.

    Returns:
      content of `benchmarks/real_match.py`'s output, and the constants.
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
