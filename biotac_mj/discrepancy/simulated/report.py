"""The report of simulation in the loop: what was tried on flat presses, as a verdict, and the files of the
first recording's report with it."""

import dataclasses
import pathlib

import numpy as np

from ...effects.effect import STAGES
from ...effects.plate import PLATE
from ...effects.sensor_file import write_sensor_file
from ..recordings import report as recordings
from ..recordings.search import RecordingDiagnosis
from ..report import plots
from ..report.files import Picture, write
from ..report.verdict import Estimate, Finding, Gap, Verdict, electrode_names
from .amended import acting, amended_simulated, attached
from .diagnosis import Candidate, Simulated, names

__all__ = ["picture_of", "verdict_of", "with_recording", "write_simulated"]

_TRIED = {"has": " (in the model)", "lacks": "", "fits": " (a fit, no reason)"}
_BLOCKS = "blocks of time that took no part in the fit"


def verdict_of(found: Simulated) -> Verdict:
    """What simulation in the loop found, as reports say it."""
    by_id = {f.id: f for f in found.tried}
    named, acts = [by_id[i] for i in found.named], acting(found)
    significant = any(c.red for s in found.sensors for c in s.cells)
    first = found.sensors[0].name
    amended = [f"sensor_amended.yaml has, as {first} has it: {acts.name}"] if acts else []
    for f in named:
        each = _by_sensor(f, found) or {}
        amended += [f"{f.name} as {sensor} has it: attach(spec, **{one})" for sensor, one in each.items()]
    return Verdict(
        kind="flat presses, simulated",
        name=", ".join(s.name for s in found.sensors),
        data=f"{', '.join(str(len(s.rows)) for s in found.sensors)} loaded rows, each with a fitted pose",
        verdict=found.verdict,
        significant=significant,
        effects=[_finding(f, found) for f in named],
        gap=_gaps(found, named),
        aside=_BLOCKS,
        where=[{"sensor": s.name} | _cell(c) for s in found.sensors for c in s.cells if c.red],
        where_note="electrodes and conditions of simulated presses that are off; RMS [counts], and expected",
        remainder="" if named or not significant else "no effect that was tried takes the gap away",
        unknown=significant and not named,
        tried=[_row(f, k, found) for f in found.tried for k in range(len(found.sensors))],
        tried_note=(
            f"RMS [counts] without -> with it on {_BLOCKS}, and how often chance gives as much; its value by "
            "either half of the rows"
        ),
        amended=amended,
        details={"simulated": _details(found)},
    )


def _cell(c):
    """An electrode in a condition."""
    channel = electrode_names([c.channel])[0]
    condition = f"{c.view} {c.part}"
    return {"channel": channel, "condition": condition, "counts": c.rms, "expected": c.expected, "p": c.p}


def _gaps(found, named):
    out = {}
    for k, s in enumerate(found.sensors):
        cells = [c.expected for c in s.cells if c.channel in s.worst and c.view == "phase"]
        before = float(np.sqrt((s.judged.error[:, s.worst] ** 2).mean()))
        after = named[0].tested[k].worst.after if named else before
        noise = float(np.sqrt(np.mean(np.square(cells)))) if cells else np.nan
        key = f"worst electrodes of {s.name} in simulated presses"
        out[key] = Gap("counts", before, after, noise, f"{names(s.worst)} of {s.name}")
    return out


def _finding(f: Candidate, found) -> Finding:
    several = len(found.sensors) > 1
    parameters = {
        f.parameter + (f" of {s.name}" if several else ""): Estimate(float(np.mean(t.value)), unit=f.unit)
        for s, t in zip(found.sensors, f.tested)
        if t.value
    }
    locked = [t.locked["worst"] for t in f.tested if t.locked]
    before, after = (float(np.sqrt(np.mean(np.square(x)))) for x in zip(*locked)) if locked else (0.0, 0.0)
    return Finding(
        id=f.id,
        name=f.name,
        stage=f.stage,
        physics=next((one.physics for one in PLATE if one.id == f.id), ""),
        channels=tuple(sorted({k for s in found.sensors for k in s.worst})),
        parameters=parameters,
        p=max(t.worst.p for t in f.tested),
        confirmed=all(b < a for a, b in locked) if locked else None,
        ties={one.id: one.name for one in found.tried if one.id in found.named and one.id != f.id},
        gap=Gap("counts", before, after, name="worst electrodes, RMS on rows kept aside") if locked else None,
        note=f"of the {f.whose}" if f.whose == "base model" else "",
    )


def _row(f, k, found):
    """A line of the table of what was tried: a model on one sensor."""
    t, unit = f.tested[k], "" if f.unit == "1" else f" {f.unit}"
    return {
        "id": f.id,
        "name": f.name + _TRIED[f.kind],
        "sensor": found.sensors[k].name,
        "value": ", ".join(f"{v:.3g}" for v in t.value) + unit if t.value else "",
        "worst_electrodes": f"{t.worst.before:.0f} -> {t.worst.after:.0f} ({t.worst.p:.1g})",
        "all_electrodes": f"{t.all.before:.0f} -> {t.all.after:.0f} ({t.all.p:.1g})",
        "kept_aside": "{:.0f} -> {:.0f}".format(*t.locked["worst"]) if t.locked else "",
        "whose": f.whose,
    }


def _details(found):
    """All that was tried and where, in numbers."""
    return {
        "verdict": found.verdict,
        "tried": [_tried(f, found) for f in found.tried],
        "where": {
            s.name: {
                "worst": electrode_names(s.worst),
                "rms": float(np.sqrt((s.judged.error**2).mean())),
                "missing": dict(zip(electrode_names(range(len(s.slope))), s.slope.tolist())),
                "missing_error": s.error.tolist(),
                "cells": [_cell(c) | {"red": c.red} for c in s.cells],
            }
            for s in found.sensors
        },
        "alike": found.alike and {"correlation": found.alike[0], "p": found.alike[1]},
    }


def _tried(f, found):
    return {
        "id": f.id,
        "name": f.name,
        "stage": STAGES[f.stage],
        "kind": f.kind,
        "whose": f.whose,
        "parameters": [
            {"name": f.parameter, "unit": f.unit, "sensor": s.name, "value_by_halves": t.value}
            for s, t in zip(found.sensors, f.tested)
        ],
        "attach": _by_sensor(f, found),
        "significant": dict(zip((s.name for s in found.sensors), f.significant)),
        "gap": {
            s.name: {
                where: {key: getattr(c, key) for key in ("before", "after", "closed", "p", "better")}
                for where, c in (("worst", t.worst), ("all", t.all))
            }
            | {"locked": t.locked}
            for s, t in zip(found.sensors, f.tested)
        },
    }


def _by_sensor(f, found):
    given = attached(f)
    return given and dict(zip((s.name for s in found.sensors), given))


def with_recording(found: Simulated, first: RecordingDiagnosis) -> Verdict:
    """The verdict of the first recording with what simulation found beside it."""
    own, more = recordings.verdict_of(first), verdict_of(found)
    return dataclasses.replace(
        own,
        verdict=f"{own.verdict}; {more.verdict}",
        significant=own.significant or more.significant,
        effects=[*own.effects, *more.effects],
        gap=own.gap | more.gap,
        lead=max(more.gap, key=lambda name: more.gap[name].loudness) if more.significant else "",
        where=[*own.where, *more.where],
        where_note="; ".join(one.where_note for one in (own, more) if one.where),
        remainder="; ".join(filter(None, (own.remainder, more.remainder))),
        unknown=own.unknown or more.unknown,
        tried=more.tried,
        tried_note=more.tried_note,
        amended=[*own.amended, *more.amended],
        details=own.details | more.details,
    )


def write_simulated(
    found: Simulated, first: RecordingDiagnosis, folder: pathlib.Path | str
) -> list[pathlib.Path]:
    """Writes the first recording's report.html and verdict.json with what simulation found (all of it under
    "simulated"), sensor_amended.yaml (`attach(effects=)`) and the figures; returns the paths."""
    folder = pathlib.Path(folder)
    pictures = [*recordings.pictures_of(first), picture_of(found)]
    page, verdict, *figures = write(with_recording(found, first), pictures, folder)
    write_sensor_file(folder / "sensor_amended.yaml", amended_simulated(found, first))
    return [page, verdict, folder / "sensor_amended.yaml", *figures]


def picture_of(found: Simulated) -> Picture:
    """Error by electrode, what each electrode's change lacks, what each model takes away."""
    tried = [f for f in found.tried if f.kind != "has"]
    figure = plots.plates(
        [s.name for s in found.sensors],
        [names(s.worst) for s in found.sensors],
        [np.sqrt((s.judged.error**2).mean(0)) for s in found.sensors],
        [(s.slope, s.error) for s in found.sensors],
        [f"{f.name}{' *' if f.id in found.named else ''}" for f in tried],
        [[f.tested[i].worst.closed for f in tried] for i in range(len(found.sensors))],
    )
    return Picture("simulated", "tried", figure)
