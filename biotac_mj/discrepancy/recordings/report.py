"""The report of a plain recording: verdict.json, report.html (one file, to be sent), and the summary for the
terminal."""

import base64
import html
import io
import json
import math
import pathlib

import numpy as np

from ...effects.effect import STAGES
from ...effects.sensor_file import write_sensor_file
from ...files import replacing
from ...sensor.channels import counts_from_log_impedance
from ...sensor.colors import line_color
from ..plain_values import plain_values
from .amended import amended_sensor
from .confidence import clues
from .findings import KINDS, Finding
from .proof import NOISELESS
from .search import RecordingDiagnosis

__all__ = ["summary", "verdict_dict", "write_report"]

SCHEMA = 2
_SHOWN = 4  # channels


def verdict_dict(diagnosis: RecordingDiagnosis) -> dict:
    """What verdict.json holds; numbers, strings, lists and dicts only, no NaN."""
    d = diagnosis
    out = {
        "schema": SCHEMA,
        "kind": "plain recording",
        "verdict": d.verdict,
        "significant": d.verdict != "no significant disagreement",
        "effects": [_finding(f) for f in (*d.findings, *d.late)],
        "not_named": [_finding(f) for f in d.rejected],
        "where": d.rest.cells,
        "gap": d.gap,
        "remainder": {"significant": d.rest.significant, "text": d.rest.text, "clues": d.rest.clues},
        "cannot_be_known": d.notes,
        "recording": {
            "name": d.recording.name,
            "rows": len(d.recording),
            "rate_hz": d.recording.rate,
            "rate_source": d.recording.rate_source,
            "seconds": len(d.recording) / d.recording.rate,
            "force": d.recording.force is not None,
            "tdc": d.recording.tdc is not None,
            "loaded": d.session.loaded,
            "locked_share": d.locked,
            "warnings": list(d.recording.warnings),
        },
    }
    return plain_values(out)


def _finding(f: Finding) -> dict:
    known = f.kind.params
    return {
        "id": f.id,
        "name": f.kind.name,
        "stage": STAGES[f.kind.stage],
        "physics": f.kind.physics,
        "channels": [f"e{k + 1}" for k in f.channels],
        "start_s": f.start,
        "end_s": f.end,
        "parameters": [
            {
                "name": name,
                "value": value,
                "unit": known[name].unit,
                "interval95": [low, high],
                "bounds": [known[name].low, known[name].high],
                "source": known[name].source,
                "at_bound": not known[name].low < value < known[name].high,
            }
            for name, (value, low, high) in f.parameters.items()
        ],
        "confidence": f.confidence,
        "nats": f.nats,
        "p": f.p,
        "confirmed": f.verified,
        "ties": list(f.ties),
        "note": f.note,
        "gap": f.gap,
        "clues": clues(f),
        "confusable": f.kind.confusable,
    }


def _where(f: Finding) -> str:
    return "all electrodes" if len(f.channels) > 12 else ", ".join(f"e{k + 1}" for k in f.channels)


def _apart(f: Finding) -> dict:
    """What would tell a finding from those it is tied with: name -> experiment."""
    return {
        KINDS[i].name if i in KINDS else i: f.kind.confusable.get(i, "no experiment is known") for i in f.ties
    }


def _noise(gap: dict) -> str:
    return "none" if math.isclose(gap["noise"], NOISELESS) else f"{gap['noise']:.2g}"


def _proof(f: Finding) -> str:
    if not f.gap:
        return "not checked: nothing on the part kept aside measures it"
    g = f.gap
    sign = {True: "confirmed", False: "NOT confirmed", None: "not checked"}[f.verified]
    return f"{g['name']} {g['before']:.3g} -> {g['after']:.3g} {g['unit']}, noise {_noise(g)} ({sign})"


def summary(diagnosis: RecordingDiagnosis) -> str:
    """Text for the terminal, the largest gap closed first."""
    d, r = diagnosis, diagnosis.recording
    lines = [
        f"{r.name}: {len(r)} rows, {len(r) / r.rate:.0f} s at {r.rate:.1f} Hz ({r.rate_source})"
        + (", with force" if r.force is not None else "")
        + f"; last {d.locked:.0%} kept aside",
        *(f"warning: {line}" for line in r.warnings),
        f"verdict: {d.verdict}",
    ]
    for f in (*d.findings, *d.late):
        numbers = ", ".join(_number(n, *v, f.kind.params[n].unit) for n, v in f.parameters.items())
        lines.append(
            f"  {f.kind.name} [{STAGES[f.kind.stage]}], {_where(f)}, confidence {f.confidence:.2f}, from "
            f"{f.start:.1f} s to {f.end:.1f} s"
        )
        lines += [f"    {numbers}"] if numbers else []
        lines += [f"    {f.note}", f"    {_proof(f)}"]
        lines += [f"    not told from {name}: {how}" for name, how in _apart(f).items()]
    for f in d.rejected:
        if f.verified is False:
            lines.append(f"  not confirmed by the part kept aside, left out: {f.kind.name} {_where(f)}")
    for name, view in d.gap.items():
        lines.append(
            f"  {name}: {view['before']:.4g} -> {view['after']:.4g} {view['unit']} RMS on the part kept "
            f"aside, noise {_noise(view)}"
        )
    if left := amended_sensor(d)[1]:
        lines.append(
            f"  not in sensor_amended.yaml: {', '.join(left)}: of the logger, of the force or of the "
            "moment, or no running sensor has it"
        )
    lines.append(
        "  sensor_amended.yaml has calibrated rubber, as real sensors were matched with: softer than default"
    )
    lines.append(f"  left: {d.rest.text}")
    lines += [f"  cannot be known: {n}" for n in d.notes[1:]]
    return "\n".join(lines)


def write_report(diagnosis: RecordingDiagnosis, folder: pathlib.Path | str) -> list:
    """Writes report.html, verdict.json, sensor_amended.yaml (a sensor that `attach(effects=)` takes) and the
    figures; returns the paths."""
    folder = pathlib.Path(folder)
    paths, pictures = [folder / "report.html", folder / "verdict.json"], []
    for name, draw in (("curves.png", _curves), ("overview.png", _overview), ("channels.png", _channels)):
        store = io.BytesIO()
        draw(diagnosis).savefig(store, dpi=100, format="png")
        pictures.append(base64.b64encode(store.getvalue()).decode())
        with replacing(folder / name) as temporary:
            temporary.write_bytes(store.getvalue())
        paths.append(folder / name)
    with replacing(folder / "verdict.json") as temporary:
        temporary.write_text(json.dumps(verdict_dict(diagnosis), indent=1, allow_nan=False))
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(_page(diagnosis, pictures))
    write_sensor_file(folder / "sensor_amended.yaml", amended_sensor(diagnosis)[0])
    return [*paths, folder / "sensor_amended.yaml"]


def _figure(rows, height):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, height), layout="constrained")
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def worst(diagnosis: RecordingDiagnosis) -> list[int]:
    """Electrodes that the effects change most on the part kept aside, by number from 0; of an empty verdict
    those with the largest residual."""
    s = diagnosis.session
    change = np.sqrt(((s.recording.electrodes - s.filled())[~s.fit] ** 2).mean(0))
    if not diagnosis.findings:
        return [int(c["channel"][1:]) - 1 for c in diagnosis.rest.cells][:2] or [0]
    return [int(k) for k in np.argsort(-change)[:_SHOWN] if change[k] > 0.2 * change.max()] or [0]


def _curves(d):
    """Measured, simulated without and with what was found, over time, of the worst channels."""
    s, shown = d.session, worst(d)
    m, r = s.model(), d.recording
    said = counts_from_log_impedance(m.value - (m.alone() if m.dimensions else m.value) + m.mean)
    effect = (r.electrodes - s.filled())[: len(m.time) * m.width].reshape(len(m.time), m.width, 19).mean(1)
    measured = r.electrodes[: len(m.time) * m.width].reshape(len(m.time), m.width, 19).mean(1)
    figure, axes = _figure(len(shown), 2.4 * len(shown))
    for ax, k in zip(axes, shown):
        ax.plot(m.time, measured[:, k], color="0.6", lw=2.6, label="measured")
        i = np.flatnonzero(m.used == k)
        if len(i):
            ax.plot(
                m.time,
                said[:, i[0]],
                color="tab:orange",
                lw=0.9,
                label="simulated: rest and load, as the others say it",
            )
            ax.plot(m.time, said[:, i[0]] + effect[:, k], color="tab:blue", lw=0.9, label="amended")
        ax.axvspan(r.time[~s.fit][0], r.time[-1], color="0.92", zorder=0)
        names = dict.fromkeys(
            f.kind.name
            for f in d.findings
            if k in f.channels and f.correct or f.mask is not None and k in f.channels
        )
        ax.set_title(f"e{k + 1}" + (": " + "; ".join(names) if names else ""), fontsize=9)
        ax.set_ylabel("electrode [counts]")
    axes[0].legend(fontsize=7, ncols=3)
    axes[-1].set_xlabel("time [s]; grey: kept aside")
    return figure


def _overview(d):
    """The recording, and the same without the effects found."""
    r = d.recording
    width = max(1, len(r) // 1500)
    m = len(r) // width
    t = r.time[: m * width].reshape(m, width).mean(1)

    def bins(x):
        return x[: m * width].reshape(m, width, -1).mean(1)

    rows = 3 if r.force is not None else 2
    figure, axes = _figure(rows, 2.3 * rows)
    for ax, x, title in zip(
        axes, (r.electrodes, d.session.filled()), ("as measured", "without the effects found")
    ):
        x = bins(x)
        for k, line in enumerate((x - np.median(x[: max(3, m // 50)], axis=0)).T):
            ax.plot(t, line, lw=0.6, color=line_color(k), label=f"e{k + 1}")
        ax.set_title(f"e1..e19 {title}, change since the first rows", fontsize=9)
        ax.set_ylabel("change [counts]")
    axes[0].margins(y=0.25)  # room for 19 names
    axes[0].legend(ncols=10, fontsize=6, loc="upper left", handlelength=1, framealpha=0.6)
    if r.force is not None:
        axes[2].plot(t, bins(r.force), lw=0.6, label=["Fx", "Fy", "Fz"])
        axes[2].set_ylabel("force [N]")
        axes[2].legend(fontsize=7, ncols=3)
    for ax in axes:
        ax.axvspan(r.time[~d.session.fit][0], r.time[-1], color="0.92", zorder=0)
    axes[-1].set_xlabel("time [s]; grey: kept aside")
    return figure


def _channels(d):
    """RMS per channel on the part kept aside, before and after."""
    views = [(n, v) for n, v in d.gap.items() if "channels_before" in v]
    figure, axes = _figure(max(1, len(views)), 2.6 * max(1, len(views)))
    for ax, (name, view) in zip(axes, views):
        x = np.arange(len(view["channels_before"]))
        ax.bar(x - 0.2, view["channels_before"], 0.4, label="unamended", color="0.6")
        ax.bar(x + 0.2, view["channels_after"], 0.4, label="amended", color="tab:blue")
        ax.axhline(view["noise"], color="k", lw=0.7, ls=":", label="noise")
        ax.set_xticks(x, [f"e{k + 1}" for k in x], fontsize=7)
        ax.set_ylabel("RMS [counts]")
        ax.set_title(f"{name}, part kept aside", fontsize=9)
        ax.legend(fontsize=7)
    return figure


_STYLE = """body{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}
table{border-collapse:collapse;width:100%;font-size:13px}img{max-width:100%}
td,th{border:1px solid #ccc;padding:4px 6px;vertical-align:top;text-align:left}
h1{font-size:1.3em}h2{font-size:1.05em}"""


def _page(d, pictures):
    esc = html.escape
    rows = []
    for f in (*d.findings, *d.late):
        numbers = "<br>".join(esc(_number(n, *v, f.kind.params[n].unit)) for n, v in f.parameters.items())
        apart = "<br>".join(f"{esc(name)}: {esc(how)}" for name, how in _apart(f).items()) or "none"
        rows.append(
            f"<tr><td><b>{esc(f.kind.name)}</b><br>{esc(f.kind.physics)}</td><td>{STAGES[f.kind.stage]}</td>"
            f"<td>{_where(f)}<br>{f.start:.1f}–{f.end:.1f} s</td><td>{esc(_proof(f))}</td>"
            f"<td>{numbers}<br>{esc(f.note)}</td>"
            f"<td>{f.confidence:.2f}<br>p {f.p:.2g}</td><td>{apart}</td></tr>"
        )
    effects = "".join(rows) or "<tr><td colspan=7>nothing</td></tr>"
    gaps = "".join(
        f"<tr><td>{esc(n)}</td><td>{v['before']:.4g}</td><td>{v['after']:.4g}</td><td>{_noise(v)}</td>"
        f"<td>{esc(v['unit'])}</td><td>{v['variance_removed']:.1%}</td></tr>"
        for n, v in d.gap.items()
    )
    cells = "".join(
        f"<tr><td>{c['channel']}</td><td>{c['from']:.0f}–{c['to']:.0f} s</td><td>{c['counts']:.1f}</td></tr>"
        for c in d.rest.cells
    )
    weak = "; ".join(esc(f"{f.kind.name} {_where(f)} ({f.confidence:.2f})") for f in d.rejected) or "nothing"
    image = [f'<img src="data:image/png;base64,{p}">' for p in pictures]
    return f"""<!doctype html><meta charset="utf-8"><title>{esc(d.recording.name)}</title>
<style>{_STYLE}</style>
<h1>{esc(d.recording.name)}, {esc(d.verdict)}</h1>
<p>{len(d.recording)} rows, {len(d.recording) / d.recording.rate:.0f} s, {esc(d.notes[0])};
the last {d.locked:.0%} took no part in the fits, and every 'after' is computed there.</p>
{"".join(f"<p><b>Warning:</b> {esc(line)}</p>" for line in d.recording.warnings)}
<h2>1. What was found and added, the largest gap closed first</h2>
<table><tr><th>effect</th><th>stage</th><th>where</th><th>before and after</th><th>parameters (95 %)</th>
<th>confidence</th><th>not told from, and what would tell</th></tr>{effects}</table>
<h2>2. Measured, simulated, amended: the channels that change most</h2>{image[0]}
<h2>3. The whole model on the part kept aside</h2>
<table><tr><th>view</th><th>before</th><th>after</th><th>noise</th><th>unit</th><th>variance
removed</th></tr>{gaps}</table> {image[2]}
<h2>4. What is left</h2><p>{esc(d.rest.text)}</p>
<table><tr><th>electrode</th><th>most at</th><th>counts</th></tr>{cells}</table>
<p>Seen, and too weak or contradicted: {weak}.</p>
<h2>5. What the recording cannot tell</h2><ul>{"".join(f"<li>{esc(n)}</li>" for n in d.notes[1:])}</ul>
{image[1]}"""


def _number(name, value, low, high, unit):
    unit = "" if unit in ("", "1") else " " + unit
    text = f"{name} {value:.4g}{unit}"
    return text if math.isnan(low) or math.isnan(high) or low == high else f"{text} ({low:.4g} .. {high:.4g})"
