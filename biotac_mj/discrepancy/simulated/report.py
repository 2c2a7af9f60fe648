"""What simulation in the loop found: verdict.json and sensor_amended.yaml with the recording's own, a figure,
and the summary for the terminal."""

import json
import pathlib

import numpy as np

from ...effects.effect import STAGES
from ...effects.sensor_file import write_sensor_file
from ...files import replacing
from ..plain_values import plain_values
from ..recordings.report import verdict_dict
from ..recordings.search import RecordingDiagnosis
from .amended import acting, amended_simulated, attached
from .diagnosis import Finding, Simulated, names

__all__ = ["draw", "simulated_dict", "summary", "write_simulated"]

_SHOWN = 6  # cells of a sensor in the summary
_TRIED = {"has": " (in the model)", "lacks": "", "fits": " (a fit, no reason)"}


def simulated_dict(found: Simulated) -> dict:
    """What verdict.json holds of the simulation."""
    by_id = {f.id: f for f in found.findings}
    return plain_values(
        {
            "kind": "plain recordings of flat presses, simulated",
            "verdict": found.verdict,
            "effects": [_finding(by_id[i], found) for i in found.named],
            "tried": [_finding(f, found) for f in found.findings],
            "where": {
                s.name: {
                    "worst": [f"e{k + 1}" for k in s.worst],
                    "rms": float(np.sqrt((s.judged.error**2).mean())),
                    "missing": dict(zip((f"e{k + 1}" for k in range(19)), s.slope.tolist())),
                    "missing_error": s.error.tolist(),
                    "cells": [
                        {
                            "channel": f"e{c.channel + 1}",
                            "view": c.view,
                            "part": c.part,
                            "counts": c.rms,
                            "expected": c.expected,
                            "p": c.p,
                            "red": c.red,
                        }
                        for c in s.cells
                    ],
                }
                for s in found.sensors
            },
            "alike": found.alike and {"correlation": found.alike[0], "p": found.alike[1]},
        }
    )


def _finding(f: Finding, found: Simulated) -> dict:
    return {
        "id": f.id,
        "name": f.name,
        "stage": STAGES[f.stage],
        "kind": f.kind,
        "whose": f.whose,
        "ties": [i for i in found.named if i != f.id] if f.id in found.named else [],
        "parameters": [
            {"name": f.parameter, "unit": f.unit, "sensor": s.name, "value_by_halves": t.value}
            for s, t in zip(found.sensors, f.tested)
        ],
        "attach": _by_sensor(f, found),
        "channels": sorted({f"e{k + 1}" for s in found.sensors for k in s.worst}),
        "significant": dict(zip((s.name for s in found.sensors), f.significant)),
        "confirmed": all(t.locked["worst"][1] < t.locked["worst"][0] for t in f.tested)
        if f.tested[0].locked
        else None,
        "gap": {
            s.name: {
                where: {
                    "before": c.before,
                    "after": c.after,
                    "closed": c.closed,
                    "p": c.p,
                    "better": c.better,
                }
                for where, c in (("worst", t.worst), ("all", t.all))
            }
            | {"locked": t.locked}
            for s, t in zip(found.sensors, f.tested)
        },
    }


def headline(found: Simulated) -> str:
    """The verdict in one sentence for somebody who has never seen a report: the largest gap, what closes it,
    by how much."""
    by_id = {f.id: f for f in found.findings}
    named = [by_id[i] for i in found.named]
    gaps = []
    for k, s in enumerate(found.sensors):
        error = np.sqrt((s.judged.error[:, s.worst] ** 2).mean())
        gap = f"at {names(s.worst)} of {s.name}, {error:.0f} counts RMS"
        gaps.append(gap + (f" ({named[0].tested[k].worst.after:.0f} with {named[0].name})" if named else ""))
    if not any(c.red for s in found.sensors for c in s.cells):
        return f"Sensor and simulation agree within noise and the fit's uncertainty; most differ {gaps[0]}."
    if not named:
        what = "no mechanism that was tried takes it away"
        what += " from every sensor" if len(found.sensors) > 1 else ""
    else:
        what = f"{named[0].name} explains it best"
        what += f", not told apart from {' and '.join(f.name for f in named[1:])}" if named[1:] else ""
    return f"The largest gap between sensor and simulation is {' and '.join(gaps)}; {what}."


def summary(found: Simulated) -> str:
    """Text for the terminal: one sentence, a table of what was tried, where it is, the verdict's words."""
    lines = [headline(found), ""]
    labels = [f.name + _TRIED[f.kind] for f in found.findings]
    width = max(map(len, labels), default=0) + 2
    wide = max(len(s.name) for s in found.sensors)
    lines.append(
        f"  {'tried':{width}}{'sensor':{wide}}{'worst electrodes':>20}{'all electrodes':>20}  whose it is"
    )
    for f, label in zip(found.findings, labels):
        for k, (s, t) in enumerate(zip(found.sensors, f.tested)):
            cells = [f"{c.before:.0f} -> {c.after:.0f} ({c.p:.1g})" for c in (t.worst, t.all)]
            lines.append(
                f"  {label if not k else '':{width}}{s.name:{wide}}{cells[0]:>20}{cells[1]:>20}"
                f"  {f.whose if not k else ''}"
            )
            if t.value:
                values = ", ".join(f"{v:.3g}" for v in t.value) + ("" if f.unit == "1" else f" {f.unit}")
                lines.append(f"    {f.parameter} {values}, from either half of the rows")
            if t.locked:
                (a, b), (c, d) = t.locked["worst"], t.locked["all"]
                lines.append(f"    on rows kept aside {a:.0f} -> {b:.0f}, all electrodes {c:.0f} -> {d:.0f}")
        if f.id in found.named and attached(f):
            lines += [
                f"    a simulated {name}: attach(spec, **{one})" for name, one in _by_sensor(f, found).items()
            ]
    lines.append(
        "  (RMS [counts] without -> with it on rows that it was not fitted to; in brackets how often chance "
        "gives as much)"
    )
    for s in found.sensors:
        red = [c for c in s.cells if c.red]
        lines.append(f"  {s.name}: {len(red)} of {len(s.cells)} cells (electrode, condition) are off, first")
        lines += [
            f"    e{c.channel + 1} {c.view} {c.part}: {c.rms:.0f} counts, {c.expected:.0f} expected"
            for c in red[:_SHOWN]
        ]
    lines.append(f"  verdict: {found.verdict}")
    acts = acting(found)
    if acts:
        lines.append(f"  in sensor_amended.yaml, as {found.sensors[0].name} has it: {acts.name}")
    return "\n".join(lines)


def _by_sensor(f, found):
    given = attached(f)
    return given and dict(zip((s.name for s in found.sensors), given))


def write_simulated(found: Simulated, first: RecordingDiagnosis, folder: pathlib.Path | str) -> list:
    """Writes verdict.json (the first recording's, its effects with those of the simulation, and under
    "simulated" all that this found), sensor_amended.yaml (`attach(effects=)`) and simulated.png; returns the
    paths."""
    folder = pathlib.Path(folder)
    own, said = verdict_dict(first), simulated_dict(found)
    effects = [*own["effects"], *said["effects"]]
    verdict = own | {"verdict": f"{own['verdict']}; {found.verdict}", "effects": effects, "simulated": said}
    paths = [folder / name for name in ("verdict.json", "sensor_amended.yaml", "simulated.png")]
    with replacing(paths[0]) as temporary:
        temporary.write_text(json.dumps(verdict, indent=1, allow_nan=False))
    write_sensor_file(paths[1], amended_simulated(found, first))
    with replacing(paths[2]) as temporary:
        draw(found).savefig(temporary, dpi=110, format="png")
    return paths


def draw(found: Simulated) -> object:
    """A matplotlib figure: error by electrode, what each electrode's change lacks, what each model takes
    away."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 9), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[1, 1.5])
    rms, slope, models = (figure.add_subplot(g) for g in (grid[0, 0], grid[0, 1], grid[1, :]))
    x, width = np.arange(19), 0.8 / len(found.sensors)
    tried = [f for f in found.findings if f.kind != "has"]
    y = np.arange(len(tried))[::-1]
    for i, s in enumerate(found.sensors):
        at = (i - (len(found.sensors) - 1) / 2) * width
        rms.bar(x + at, np.sqrt((s.judged.error**2).mean(0)), width, label=s.name)
        slope.bar(x + at, 100 * s.slope, width, yerr=100 * s.error, error_kw={"lw": 0.7})
        closed = [100 * f.tested[i].worst.closed for f in tried]
        models.barh(y - at, closed, width, label=f"{s.name}, {names(s.worst)}")
    for ax, title in ((rms, "error [counts RMS]"), (slope, "what the modelled change lacks [%]")):
        ax.set_xticks(x, [f"e{k + 1}" for k in x], fontsize=7, rotation=60)
        ax.set_title(title + ", blocks not fitted on", fontsize=9)
    rms.legend(fontsize=7)
    slope.axhline(0, color="k", lw=0.6)
    models.axvline(0, color="k", lw=0.6)
    models.set_yticks(y, [f"{f.name}{' *' if f.id in found.named else ''}" for f in tried], fontsize=8)
    models.set_xlim(left=max(models.get_xlim()[0], -50))
    models.set_title(
        "squared error of the worst electrodes that each model takes away [%], blocks not fitted on "
        "(* named)",
        fontsize=9,
    )
    models.legend(fontsize=7)
    return figure
