"""The report of the full workflow: report.html with figures, verdict.json, sensor_amended.yaml, and the
summary for the terminal."""

import argparse
import dataclasses
import html
import json
import pathlib
from collections.abc import Sequence

import numpy as np

from ...effects.effect import STAGES
from ...files import replacing
from ...recordings.recording import Recording
from ...skin.settings import read_dict
from ..plain_values import plain_values
from .in_skin import InSkinSimulator
from .recorded import trajectories_of
from .sensor_file import load_simulator
from .simulator import Simulator
from .trajectory import read_trajectories
from .where import conditions
from .whitening import REPEATABILITY
from .workflow import THRESHOLDS, Report, diagnose, threshold_hash

__all__ = ["diagnose_data", "summary", "verdict_dict", "write_report"]


def diagnose_data(args: argparse.Namespace, recordings: Sequence[Recording] = ()) -> None:
    """`biotac diagnose measured.h5 --sensor sensor.yaml --out report/`; recordings: with poses, in place of a
    file of trajectories."""
    out, notes = pathlib.Path(args.out), []
    if args.sensor:
        sim = load_simulator(args.sensor)
    else:
        sim = InSkinSimulator() if args.in_skin else Simulator(tier=args.tier)
    if args.in_skin and not isinstance(sim, InSkinSimulator):
        raise ValueError(
            f"{args.sensor} has constitutive effects in their reduced form: write `constitutive: "
            "in_skin` into it, or leave --in-skin out"
        )
    changes = {"device": args.device, "cache": str(out / "fields")}  # run again after an interruption
    if args.skin:
        changes["skin"] = args.skin
    if args.material:
        changes["material"] = args.material
    if args.options:
        changes["options"] = read_dict(args.options, "options")
    sim = dataclasses.replace(sim, **changes)
    if args.device != "cpu" and sim.tier != "full":
        raise ValueError(f"--device {args.device} is for the full tier: add --tier full, or leave it out")
    if recordings:
        data, notes = trajectories_of(list(recordings), sim.skin)
    else:
        data = read_trajectories(args.data)
    report = diagnose(
        sim,
        data,
        repeatability=1e-3 * args.repeatability if args.repeatability else REPEATABILITY,
        locked=0.25 if args.locked is None else args.locked,
        progress=not args.quiet,
    )
    report.notes[:0] = notes
    files = write_report(report, sim, out)
    print(summary(report))
    print("  " + " ".join(str(f) for f in files[:3]))


def verdict_dict(report: Report) -> dict:
    """What verdict.json holds."""
    return plain_values(
        {
            "schema": 1,
            "kind": "trajectories",
            "verdict": report.verdict,
            "significant": report.verdict != "no significant disagreement",
            "effects": [{**e, "stage": STAGES[e["stage"]]} for e in report.effects],
            "ranking": [{"id": i, "nats_per_trajectory": n, "p": p} for i, n, p in report.ranking],
            "where": report.where,
            "gap_before": report.before,
            "gap_after": report.after,
            "share_closed": report.closed,
            "remainder": report.remainder,
            "isolability": report.isolability,
            "next_experiment": report.next_experiment,
            "cannot_be_known": report.notes,
            "trajectories": {
                "fitted": len(report.selection),
                "kept_aside": [report.comparison.trajectories[i].id for i in report.locked],
            },
            "thresholds": THRESHOLDS,
            "threshold_hash": threshold_hash(),
            "repeatability_m": report.comparison.repeatability,
        }
    )


def summary(report: Report) -> str:
    """Text for the terminal, in the report's order."""
    lines = [f"verdict: {report.verdict}"]
    if report.where:
        cells = ", ".join(f"{c['channel']} ({c['condition']})" for c in report.where[:6])
        lines.append(f"  where: {len(report.where)} cells of channel x condition at family-wise 5 %: {cells}")
    for e in report.effects:
        lines.append(
            f"  {e['name']} [{STAGES[e['stage']]}], confidence {e['confidence']:.2f}, {e['nats']:.1f} nats "
            f"per trajectory left out, p {e['p']:.2g}"
        )
        for p in e["parameters"][:4]:
            lines.append(
                f"    {p['name']} {p['value']:.4g} {p['unit']} ({p['interval95'][0]:.4g} .. "
                f"{p['interval95'][1]:.4g})"
            )
    lines.append(f"  proof on {len(report.locked)} trajectories kept aside, the skin solved again:")
    for group in report.comparison.groups:
        unit = "N" if group == "force" else "counts"
        lines.append(f"    {group}: {report.before[group]:.4g} -> {report.after[group]:.4g} {unit} RMS")
    if np.isfinite(report.closed):
        lines.append(f"    share of the closable gap closed: {report.closed:.0%}")
    if report.remainder:
        lines.append(f"  left: {report.remainder}")
    lines.append(f"  next experiment: {report.next_experiment}")
    lines += [f"  cannot be known: {n}" for n in report.notes]
    return "\n".join(lines)


def write_report(report: Report, sim: Simulator, folder: pathlib.Path | str) -> list:
    """Writes report.html, verdict.json, sensor_amended.yaml and the figures; returns the paths."""
    folder = pathlib.Path(folder)
    pictures = []
    for name, draw in (
        ("channels.png", _channels),
        ("where.png", _where),
        ("evidence.png", _evidence),
        ("isolability.png", _isolability),
    ):
        figure = draw(report)
        with replacing(folder / name) as temporary:
            figure.savefig(temporary, dpi=110)
        pictures.append(folder / name)
    with replacing(folder / "verdict.json") as temporary:
        temporary.write_text(json.dumps(verdict_dict(report), indent=1, allow_nan=False))
    report.apply(sim).save(folder / "sensor_amended.yaml")
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(_page(report, [p.name for p in pictures]))
    return [folder / "report.html", folder / "verdict.json", folder / "sensor_amended.yaml", *pictures]


def _figure(width, height):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _channel_names(report):
    return (
        [f"e{k + 1}" for k in range(19)]
        + (["pdc"] if report.comparison.has_pdc else [])
        + (["Fx", "Fy", "Fz"] if report.comparison.has_force else [])
    )


def _channels(report):
    figure, ax = _figure(9, 3)
    x = np.arange(report.comparison.width)
    sigma = report.comparison.sigma
    ax.bar(x - 0.2, np.array(report.before["channels"]) / sigma, 0.4, color="0.6", label="unamended")
    ax.bar(x + 0.2, np.array(report.after["channels"]) / sigma, 0.4, color="tab:blue", label="amended")
    ax.axhline(1, color="k", lw=0.7, ls=":")
    ax.set_xticks(x, _channel_names(report), fontsize=7)
    ax.set_ylabel("RMS / (noise, resolution)")
    ax.set_title("trajectories kept aside", fontsize=9)
    ax.legend(fontsize=7)
    return figure


def _where(report):
    """Mean whitened residual of the model without effects (or its trend over trajectories), channel x
    condition; dots: significant."""
    from .fitting import fit_effects

    c = report.comparison
    white = fit_effects(c, [], report.selection).residuals(c)
    names, asked = _channel_names(report), conditions([c.trajectories[i] for i in report.selection])
    table = np.full((len(asked), len(names)), np.nan)
    for k, parts in enumerate(asked.values()):
        means = [
            weight * white[i][rows].mean(0)
            for i, (rows, weight) in zip(report.selection, parts)
            if rows.any()
        ]
        if means:
            table[k] = np.mean(means, axis=0)
    figure, ax = _figure(9, 0.8 + 0.28 * len(asked))
    limit = max(np.nanmax(np.abs(table)), 1.0)
    image = ax.imshow(table, cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
    for cell in report.where:
        name = {"force": "Fy"}.get(cell["channel"], cell["channel"])
        ax.plot(names.index(name), list(asked).index(cell["condition"]), "k.", ms=4)
    ax.set_xticks(np.arange(len(names)), names, fontsize=7)
    ax.set_yticks(np.arange(len(asked)), asked, fontsize=7)
    figure.colorbar(image, label="mean residual, or trend [sigma]")
    return figure


def _evidence(report):
    figure, ax = _figure(6, 0.6 + 0.3 * max(len(report.ranking), 1))
    y = np.arange(len(report.ranking))[::-1]
    ax.barh(
        y,
        [n for _, n, _ in report.ranking],
        color=[
            "tab:blue" if any(e["id"] == i for e in report.effects) else "0.7" for i, _, _ in report.ranking
        ],
    )
    ax.set_yticks(y, [i for i, _, _ in report.ranking], fontsize=8)
    ax.axvline(THRESHOLDS["gain"], color="k", lw=0.7, ls=":")
    ax.set_xlabel("nats per trajectory left out, first round")
    return figure


def _isolability(report):
    figure, ax = _figure(8, 7)
    ids = report.isolability["ids"]
    image = ax.imshow(report.isolability["matrix"], vmin=0, vmax=1, cmap="viridis")
    ax.set_xticks(np.arange(len(ids)), ids, rotation=90, fontsize=7)
    ax.set_yticks(
        np.arange(len(ids)),
        [f"{i} ({n:.2g} nats)" for i, n in zip(ids, report.isolability["nats"])],
        fontsize=7,
    )
    ax.set_title("share of the row's signature that the column cannot mimic", fontsize=9)
    figure.colorbar(image)
    return figure


def _page(report, pictures):
    esc = html.escape
    rows = []
    for e in report.effects:
        numbers = "<br>".join(
            f"{p['name']} {p['value']:.4g} {esc(p['unit'])} ({p['interval95'][0]:.4g} .. "
            f"{p['interval95'][1]:.4g})"
            for p in e["parameters"]
        )
        rows.append(
            f"<tr><td><b>{esc(e['name'])}</b><br>{esc(e['physics'])}</td><td>{STAGES[e['stage']]}</td>"
            f"<td>{numbers}</td><td>{e['confidence']:.2f}</td>"
            f"<td>{e['nats']:.1f}</td><td>{e['p']:.2g}</td>"
            f"<td>{esc(', '.join(e['ties']) or 'none')}</td></tr>"
        )
    gap = "".join(
        f"<tr><td>{g}</td><td>{report.before[g]:.4g}</td><td>{report.after[g]:.4g}</td></tr>"
        for g in report.comparison.groups
    )
    closed = f"{report.closed:.0%}" if np.isfinite(report.closed) else "nothing to close"
    notes = "".join(f"<li>{esc(n)}</li>" for n in report.notes)
    image = {name.split(".")[0]: f'<img src="{name}" style="max-width:100%">' for name in pictures}
    level, after = report.trace["before"], report.trace["after"]
    cells = "".join(
        f"<tr><td>{c['channel']}</td><td>{c['condition']}</td><td>{c['t']:.1f}</td><td>{c['p']:.2g}</td></tr>"
        for c in report.where[:20]
    )
    return f"""<!doctype html><meta charset="utf-8"><title>diagnosis</title>
<style>body{{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}}
table{{border-collapse:collapse;font-size:13px}}
td,th{{border:1px solid #ccc;padding:4px 6px;vertical-align:top;text-align:left}}
h1{{font-size:1.3em}}h2{{font-size:1.05em}}</style>
<h1>{esc(report.verdict)}</h1>
<h2>1. Is there a disagreement?</h2><p>Mean square of residuals over noise, resolution and repeatability:
{level["level"]:.2f} of a trajectory, {level["peak"]:.2f} of the worst channel
(beyond {THRESHOLDS["significant"]} or {THRESHOLDS["peak"]} something is wrong).
With the effects found {after["level"]:.2f} and {after["peak"]:.2f}.</p>
<h2>2. Where</h2><p>{len(report.where)} cells of channel x condition at family-wise 5 %.</p><table>
<tr><th>channel</th><th>condition</th><th>t</th><th>p</th></tr>{cells}</table>{image["where"]}
<h2>3. What</h2><table><tr><th>effect</th><th>stage</th><th>parameters (95 %)</th><th>confidence</th>
<th>nats per trajectory</th><th>p</th><th>ties</th></tr>
{"".join(rows) or "<tr><td colspan=7>none</td></tr>"}</table><p>{esc(report.remainder)}</p>{image["evidence"]}
<h2>4. Added</h2><p>sensor_amended.yaml</p>
<h2>5. Proof on trajectories kept aside</h2>
<table><tr><th></th><th>before</th><th>after</th></tr>{gap}</table>
<p>share of the closable gap: {closed}</p>{image["channels"]}
<h2>6. What the data cannot tell</h2><ul>{notes}</ul><p>Next experiment: {esc(report.next_experiment)}</p>
{image["isolability"]}
<p>thresholds {threshold_hash()}</p>"""
