"""The report of a plain recording: what `diagnose_recording` found, as a verdict, figures and files."""

import pathlib

import numpy as np

from ...effects.catalogue import name_of
from ...effects.sensor_file import write_sensor_file
from ...sensor.channels import counts_from_log_impedance
from ..report import plots
from ..report.files import Picture, write
from ..report.verdict import Estimate, Finding, Verdict
from .amended import amended_sensor
from .candidates import Candidate
from .search import RecordingDiagnosis

__all__ = ["pictures_of", "verdict_of", "write_report"]

_SHOWN = 4  # channels
_NEXT = 3  # experiments


def verdict_of(diagnosis: RecordingDiagnosis) -> Verdict:
    """What `diagnose_recording` found, as reports say it."""
    d, r = diagnosis, diagnosis.recording
    seconds = len(r) / r.rate
    data = f"{r.design.title}, {len(r)} rows, {seconds:.0f} s at {r.rate:.1f} Hz ({r.rate_source})"
    data += ", with force" if r.force is not None else ""
    return Verdict(
        kind="plain recording",
        name=r.name,
        data=f"{data}; last {d.locked:.0%} kept aside",
        warnings=list(r.warnings),
        verdict=d.verdict,
        significant=d.verdict != "no significant disagreement",
        effects=[_finding(f) for f in (*d.findings, *d.late)],
        not_named=[_finding(f) for f in d.rejected],
        gap=d.gap,
        aside="rows that took no part in any fit",
        where=d.rest.cells,
        where_note="electrodes that depart, from and to [s], RMS [counts]",
        remainder=d.rest.text,
        unknown=d.rest.significant,
        notes=d.notes[1:],
        next_experiment=_next(d),
        next_command="" if d.protocol else "biotac checkup --out protocol.yaml",
        amended=_amended(d),
        details={
            "recording": {
                "name": r.name,
                "design": r.design.name,
                "rows": len(r),
                "rate_hz": r.rate,
                "rate_source": r.rate_source,
                "seconds": seconds,
                "force": r.force is not None,
                "tdc": r.tdc is not None,
                "loaded": d.session.loaded,
                "locked_share": d.locked,
            },
        },
    )


def _next(d):
    """What would tell names from those they are confused with, and what a checkup would add."""
    tied = [(f.kind, i) for f in d.findings for i in f.ties]
    rivals = [(kind, i) for kind in dict.fromkeys(f.kind for f in d.findings) for i in [*kind.confusable][:1]]
    out = {
        f"to tell {kind.name} from {name_of(i)}: {kind.confusable.get(i, 'no experiment is known')}": None
        for kind, i in (tied or rivals)[:_NEXT]
    }
    if d.protocol is None:
        out["three minutes of touches that isolate one effect each tell what a plain log mixes"] = None
    return "; ".join(out)


def _finding(f: Candidate) -> Finding:
    known = f.kind.params
    return Finding.of(
        f.kind,
        channels=tuple(f.channels),
        parameters={name: Estimate.of(known[name], *values) for name, values in f.parameters.items()},
        evidence=f.nats,
        p=f.p,
        confidence=f.confidence,
        confirmed=f.verified,
        ties={i: name_of(i) for i in f.ties},
        gap=f.gap,
        note=f.note,
        start=f.start,
        end=f.end,
    )


def _amended(d):
    lines = [
        "sensor_amended.yaml has calibrated rubber, as real sensors were matched with: softer than default"
    ]
    if left := amended_sensor(d)[1]:
        lines.append(
            f"not in sensor_amended.yaml: {', '.join(left)}: of the logger, of the force or of the moment, "
            "or no running sensor has it"
        )
    return lines


def write_report(diagnosis: RecordingDiagnosis, folder: pathlib.Path | str) -> list[pathlib.Path]:
    """Writes report.html, verdict.json, sensor_amended.yaml (a sensor that `attach(effects=)` takes) and the
    figures; returns the paths."""
    folder = pathlib.Path(folder)
    page, verdict, *figures = write(verdict_of(diagnosis), pictures_of(diagnosis), folder)
    write_sensor_file(folder / "sensor_amended.yaml", amended_sensor(diagnosis)[0])
    return [page, verdict, folder / "sensor_amended.yaml", *figures]


def pictures_of(diagnosis: RecordingDiagnosis) -> list[Picture]:
    """The channels that change most over time; RMS by channel; the whole recording with and without what was
    found."""
    d, r = diagnosis, diagnosis.recording
    views = {"as measured": r.electrodes, "without the effects found": d.session.filled()}
    bars = [
        plots.Bars(f"{name}, kept aside", g.unit, g.channels, g.channels_before, g.channels_after, g.noise)
        for name, g in d.gap.items()
        if g.unit == "counts"
    ]
    curves = plots.curves(_panels(d), simulated="simulated: rest and load, as the others say it")
    return [
        Picture("curves", "curves", curves),
        Picture("channels", "gap", plots.channels(bars)),
        Picture("overview", "unknown", plots.overview(r.time, views, r.force, _aside(d))),
    ]


def _aside(d):
    time = d.recording.time
    return time[~d.session.fit][0], time[-1]


def worst(diagnosis: RecordingDiagnosis) -> list[int]:
    """Electrodes that the effects change most on the part kept aside, by number from 0; of an empty verdict
    those with the largest residual."""
    s = diagnosis.session
    change = np.sqrt(((s.recording.electrodes - s.filled())[~s.fit] ** 2).mean(0))
    if not diagnosis.findings:
        return [int(c["channel"][1:]) - 1 for c in diagnosis.rest.cells][:2] or [0]
    return [int(k) for k in np.argsort(-change)[:_SHOWN] if change[k] > 0.2 * change.max()] or [0]


def _panels(d):
    """Of the worst channels; simulated is rest and load, as the other electrodes say them."""
    s, r, m = d.session, d.recording, d.session.model()
    said = counts_from_log_impedance(m.value - (m.alone() if m.dimensions else m.value) + m.mean)
    measured, effect = (
        x[: len(m.time) * m.width].reshape(len(m.time), m.width, -1).mean(1)
        for x in (r.electrodes, r.electrodes - s.filled())
    )
    panels = []
    for k in worst(d):
        simulated = said[:, np.flatnonzero(m.used == k)[0]] if k in m.used else None
        names = dict.fromkeys(
            f.kind.name
            for f in d.findings
            if k in f.channels and (f.correct is not None or f.mask is not None)
        )
        panels.append(
            plots.Panel(
                f"e{k + 1}" + (": " + "; ".join(names) if names else ""),
                "counts",
                m.time,
                measured[:, k],
                simulated,
                None if simulated is None else simulated + effect[:, k],
                _aside(d),
            )
        )
    return panels
