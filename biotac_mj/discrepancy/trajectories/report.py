"""The report of the full workflow: report.html with figures, verdict.json, sensor_amended.yaml, and the
summary for the terminal."""

import argparse
import base64
import dataclasses
import html
import io
import json
import pathlib
from collections.abc import Sequence

import numpy as np

from ...effects.catalogue import CATALOGUE
from ...effects.effect import STAGES
from ...files import replacing
from ...recordings.recording import Recording
from ...skin.settings import read_dict
from ..plain_values import plain_values
from .model.in_skin import InSkinSimulator
from .model.sensor_file import load_simulator
from .model.simulator import Simulator
from .recorded import trajectories_of
from .trajectory import read_trajectories
from .where import conditions
from .whitening import REPEATABILITY
from .workflow import THRESHOLDS, Report, diagnose, threshold_hash

__all__ = ["diagnose_data", "headline", "summary", "verdict_dict", "write_report"]


def diagnose_data(args: argparse.Namespace, recordings: Sequence[Recording] = ()) -> None:
    """`biotac diagnose measured.h5 --effects sensor.yaml --out report/`; recordings: with poses, in place of
    a file of trajectories."""
    out, notes = pathlib.Path(args.out), []
    if args.effects:
        sim = load_simulator(args.effects)
    else:
        sim = InSkinSimulator() if args.in_skin else Simulator(tier=args.tier)
    if args.in_skin and not isinstance(sim, InSkinSimulator):
        raise ValueError(
            f"{args.effects} has constitutive effects in their reduced form: write `constitutive: "
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


def headline(report: Report) -> str:
    """The verdict in one sentence for somebody who has never seen a report: the largest gap, what closes it,
    by how much."""
    group = max(report.comparison.groups, key=lambda g: report.before[g] / _noise(report, g))
    unit = _unit(group)
    noise = f"{_noise(report, group):.2g} {unit} are noise and the simulation's own resolution"
    names = [
        e["name"] + (f" (or {' or '.join(e['tie_names'])})" if e["ties"] else "") for e in report.effects
    ]
    if report.verdict == "no significant disagreement":
        return (
            f"Sensor and simulation agree within noise and resolution; most differ {_NAMES[group]}, by "
            f"{report.before[group]:.3g} {unit} RMS where {noise}."
        )
    gap = f"The largest gap is in {_NAMES[group]}, {report.before[group]:.3g} {unit} RMS where {noise}"
    if not names:
        return f"{gap}; none of the known causes that were tried explains it."
    rest = "; for the rest no cause is known" if report.remainder else ""
    return f"{gap}; with {' and '.join(names)} added it is {report.after[group]:.3g} {unit}{rest}."


def summary(report: Report) -> str:
    """Text for the terminal: one sentence, a table of causes, the proof, and what the data cannot tell."""
    lines = [headline(report), ""]
    if report.effects:
        width = max(len(e["name"]) for e in report.effects) + 2
        lines.append(f"  {'cause':{width}}confidence  size (95 % interval)")
    for e in report.effects:
        numbers = [_number(p) for p in e["parameters"]]
        lines.append(f"  {e['name']:{width}}{e['confidence']:>6.0%}      {', '.join(numbers[:4])}")
        lines.append(f"    {e['physics']}")
        lines += [f"    not told apart from: {', '.join(e['tie_names'])}"] if e["ties"] else []
    lines.append(f"\n  on {len(report.locked)} trajectories kept aside    without      with     noise")
    for g in report.comparison.groups:
        numbers = (report.before[g], report.after[g], _noise(report, g))
        label = f"{g} [{_unit(g)} RMS]"
        lines.append(f"    {label:26}" + "".join(f"{n:10.3g}" for n in numbers))
    if np.isfinite(report.closed):
        lines.append(f"    of what is above noise, poses and resolution {report.closed:.0%} is closed")
    lines.append("")
    if report.where:
        cells = ", ".join(f"{c['channel']} ({c['condition']})" for c in report.where[:6])
        lines.append(f"  clearest at: {cells}")
    if report.remainder:
        lines.append(f"  the rest: {report.remainder}")
    lines.append(f"  next experiment: {report.next_experiment}")
    return "\n".join([*lines, *(f"  note: {n}" for n in report.notes)])


_NAMES = {"electrodes": "the electrodes", "pdc": "the liquid's pressure (PDC)", "force": "the force"}


def _unit(group):
    return "N" if group == "force" else "counts"


def _noise(report, group):
    """RMS that noise and resolution leave in a group of channels."""
    c = report.comparison
    return float(np.sqrt(np.mean(c.sigma[c.groups[group]] ** 2)))


def _number(p):
    low, high = p["interval95"]
    return f"{p['name']} {p['value']:.3g} {p['unit']} ({low:.3g} .. {high:.3g})".replace(" 1 (", " (")


def write_report(report: Report, sim: Simulator, folder: pathlib.Path | str) -> list:
    """Writes report.html, verdict.json, sensor_amended.yaml and the figures; returns the paths."""
    folder = pathlib.Path(folder)
    paths, pictures = [], {}
    for draw in (_curves, _channels, _where, _evidence, _isolability):
        store, name = io.BytesIO(), draw.__name__[1:]
        draw(report).savefig(store, dpi=110, format="png")
        pictures[name] = base64.b64encode(store.getvalue()).decode()
        paths.append(folder / f"{name}.png")
        with replacing(paths[-1]) as temporary:
            temporary.write_bytes(store.getvalue())
    with replacing(folder / "verdict.json") as temporary:
        temporary.write_text(json.dumps(verdict_dict(report), indent=1, allow_nan=False))
    report.apply(sim).save(folder / "sensor_amended.yaml")
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(_page(report, pictures))
    return [folder / "report.html", folder / "verdict.json", folder / "sensor_amended.yaml", *paths]


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


def _curves(report):
    """Measured, simulated, amended over time, of the two channels that are furthest off, in up to four of the
    trajectories kept aside."""
    from matplotlib.figure import Figure

    shown = range(min(4, len(report.locked)))
    worst = np.argsort(-np.array(report.before["channels"]) / report.comparison.sigma)[:2]
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots(2, len(shown), squeeze=False)
    for row, channel in zip(axes, worst):
        for ax, k in zip(row, shown):
            i = report.locked[k]
            one = report.comparison.trajectories[i]
            measured = report.comparison.measured[i][:, channel]
            ax.plot(one.time, measured, "k.", ms=3, label="measured")
            for part, colour, label in zip(report.residuals, ("0.6", "tab:blue"), ("simulated", "amended")):
                ax.plot(one.time, measured - part[k][:, channel], color=colour, lw=1.2, label=label)
            ax.set_title(f"{_channel_names(report)[channel]}, {one.id}", fontsize=8)
            ax.tick_params(labelsize=7)
    axes[0, 0].legend(fontsize=7)
    for ax in axes[1]:
        ax.set_xlabel("time [s]", fontsize=8)
    return figure


def _channels(report):
    figure, ax = _figure(9, 3)
    x = np.arange(report.comparison.width)
    sigma = report.comparison.sigma
    ax.bar(x - 0.2, np.array(report.before["channels"]) / sigma, 0.4, color="0.6", label="simulated")
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
    names = {e.id: e.name for e in CATALOGUE}
    ax.set_yticks(y, [names.get(i, i) for i, _, _ in report.ranking], fontsize=8)
    ax.axvline(THRESHOLDS["gain"], color="k", lw=0.7, ls=":")
    ax.set_xlabel("evidence of each cause alone [nats]; dotted: asked for", fontsize=8)
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
    rows = "".join(
        f"<tr><td><b>{esc(e['name'])}</b><br>{esc(e['physics'])}</td><td>{STAGES[e['stage']]}</td>"
        f"<td>{e['confidence']:.0%}</td><td>{'<br>'.join(esc(_number(p)) for p in e['parameters'])}</td>"
        f"<td>{esc(', '.join(e['tie_names']) or 'none')}</td><td>{e['nats']:.1f}</td>"
        f"<td>{e['p']:.2g}</td></tr>"
        for e in report.effects
    )
    gap = "".join(
        f"<tr><td>{g} [{_unit(g)}]</td><td>{report.before[g]:.3g}</td><td>{report.after[g]:.3g}</td>"
        f"<td>{_noise(report, g):.2g}</td></tr>"
        for g in report.comparison.groups
    )
    closed = f"{report.closed:.0%}" if np.isfinite(report.closed) else "nothing to close"
    notes = "".join(f"<li>{esc(n)}</li>" for n in report.notes)
    image = {
        name: f'<img src="data:image/png;base64,{data}" alt="{name}">' for name, data in pictures.items()
    }
    level, after = report.trace["before"], report.trace["after"]
    cells = "".join(
        f"<tr><td>{c['channel']}</td><td>{c['condition']}</td><td>{c['t']:.1f}</td><td>{c['p']:.2g}</td></tr>"
        for c in report.where[:20]
    )
    return f"""<!doctype html><meta charset="utf-8"><title>diagnosis</title>
<style>body{{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}}
table{{border-collapse:collapse;font-size:13px}}img{{max-width:100%}}
td,th{{border:1px solid #ccc;padding:4px 6px;vertical-align:top;text-align:left}}
h1{{font-size:1.3em}}h2{{font-size:1.05em}}</style>
<h1>{esc(headline(report))}</h1>
<h2>1. What closes the gap</h2><table><tr><th>cause</th><th>where it acts</th><th>confidence</th>
<th>size (95 % interval)</th><th>not told apart from</th><th>evidence</th><th>p</th></tr>
{rows or "<tr><td colspan=7>none</td></tr>"}</table>
<p>{esc(report.remainder and "The rest: " + report.remainder)}</p>
<p>Confidence: how often names with such evidence were right on practice data. Evidence: by how much likelier
(as a logarithm, in nats) trajectories become that the cause was not fitted on; {THRESHOLDS["gain"]} is asked
for. p: how often chance gives as much.
All causes are in sensor_amended.yaml, a sensor that can be attached.</p>
<h2>2. Proof on {len(report.locked)} trajectories that took no part in the search</h2>
<table><tr><th>RMS</th><th>simulated</th><th>amended</th><th>noise and resolution</th></tr>{gap}</table>
<p>Of what is above noise, scatter of poses and resolution, closed: {closed}.</p>
{image["curves"]}{image["channels"]}
<h2>3. Where they differ</h2><p>Mean square of what is left over noise, resolution and scatter of poses:
{level["level"]:.2f} of a trajectory, {level["peak"]:.2f} of the worst channel
(beyond {THRESHOLDS["significant"]} or {THRESHOLDS["peak"]} something is wrong).
With the causes added {after["level"]:.2f} and {after["peak"]:.2f}.
{len(report.where)} pairs of channel and condition stand out (5 % false, all together):</p><table>
<tr><th>channel</th><th>condition</th><th>t</th><th>p</th></tr>{cells}</table>{image["where"]}
<h2>4. What was tried</h2>{image["evidence"]}
<h2>5. What the data cannot tell</h2><p>Next experiment: {esc(report.next_experiment)}.</p><ul>{notes}</ul>
{image["isolability"]}
<p>thresholds {threshold_hash()}</p>"""
