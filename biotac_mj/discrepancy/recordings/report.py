"""The report of a plain recording: verdict.json, report.html with figures, and the summary for the
terminal."""

import html
import json
import math
import pathlib

import numpy as np

from ...effects.effect import STAGES
from ...files import replacing
from ..plain_values import plain_values
from .effects.drifts import TimeShaped
from .search import EFFECTS, RecordingDiagnosis
from .views import whole_line

__all__ = ["summary", "verdict_dict", "write_report"]

SCHEMA = 1


# of parameters that an effect reports besides those it names
_OTHER_UNITS = {"counts": "counts", "change": "ln Z", "spread": "1", "delay_otherwise": "s"}


def verdict_dict(diagnosis: RecordingDiagnosis) -> dict:
    """What verdict.json holds; numbers, strings, lists and dicts only, no NaN."""
    d = diagnosis
    out = {
        "schema": SCHEMA,
        "kind": "plain recording",
        "verdict": d.verdict,
        "significant": d.verdict != "no significant disagreement",
        "effects": [_finding(f) for f in d.findings],
        "not_confirmed": [_finding(f) for f in d.rejected],
        "where": d.where,
        "gap": d.gap,
        "gap_before": _main_gap(d, "before"),
        "gap_after": _main_gap(d, "after"),
        "remainder": d.remainder,
        "cannot_be_known": d.notes,
        "recording": {
            "name": d.recording.name,
            "rows": len(d.recording),
            "rate_hz": d.recording.rate,
            "rate_source": d.recording.rate_source,
            "seconds": len(d.recording) / d.recording.rate,
            "force": d.recording.force is not None,
            "tdc": d.recording.tdc is not None,
            "loaded": d.session.timeline().loaded,
            "locked_share": d.locked,
        },
    }
    return plain_values(out)


def _main_gap(d, side):
    for view in ("electrodes from force", "electrodes at rest", "each electrode from the others"):
        if view in d.gap:
            return {"view": view, "value": d.gap[view][side], "unit": d.gap[view]["unit"]}
    return None


def _finding(f):
    parameters = []
    for name, (value, low, high) in f.parameters.items():
        known = f.effect.params.get(name)
        parameters.append(
            {
                "name": name,
                "value": value,
                "unit": known.unit if known else _OTHER_UNITS.get(name, ""),
                "interval95": [low, high],
                "bounds": [known.low, known.high] if known else None,
                "source": known.source if known else None,
                "at_bound": bool(known and not (known.low < value < known.high)),
            }
        )
    return {
        "id": f.id,
        "name": f.effect.name,
        "stage": STAGES[f.effect.stage],
        "physics": f.effect.physics,
        "channels": [f"e{k + 1}" for k in f.channels],
        "start_s": f.start,
        "end_s": f.end,
        "parameters": parameters,
        "confidence": f.confidence,
        "nats": f.nats,
        "p": f.p,
        "confirmed": f.verified,
        "ties": list(f.ties),
        "note": f.note,
        "gap": f.statistic,
        "confusable": f.effect.confusable,
    }


def summary(diagnosis: RecordingDiagnosis) -> str:
    """Text for the terminal."""
    d = diagnosis
    r = d.recording
    lines = [
        f"{r.name}: {len(r)} rows, {len(r) / r.rate:.0f} s at {r.rate:.1f} Hz ({r.rate_source})"
        + (", with force" if r.force is not None else "") + f"; last {d.locked:.0%} kept aside",
        f"verdict: {d.verdict}",
    ]  # fmt: skip
    for f in d.findings:
        numbers = ", ".join(_number(n, *v, f.effect.params.get(n)) for n, v in f.parameters.items())
        lines.append(
            f"  {f.effect.name} [{STAGES[f.effect.stage]}], confidence {f.confidence:.2f}, from "
            f"{f.start:.1f} s to {f.end:.1f} s"
        )
        lines.append(f"    {numbers}")
        lines.append(f"    {f.note}")
        apart = {
            e.name: f.effect.confusable[e.id]
            for e in EFFECTS
            if e.id in f.ties and e.id in f.effect.confusable
        }
        lines += [f"    to tell it from {name}: {how}" for name, how in apart.items()]
        s = f.statistic
        if s:
            sign = {True: "confirmed", False: "NOT confirmed", None: "not checked"}[f.verified]
            lines.append(
                f"    {s['part']}: {s['name']} {s['before']:.3g} -> {s['after']:.3g} {s['unit']} ({sign})"
            )
    for f in d.rejected:
        lines.append(f"  not confirmed by the part kept aside, left out: {f.effect.name}")
    for name, view in d.gap.items():
        lines.append(
            f"  {name}: {view['before']:.4g} -> {view['after']:.4g} {view['unit']} RMS on the part kept aside"
        )
        lines.append(f"    amended by {_amendments(view)} (walk-forward trials in the part fitted)")
        if "after_with_late" in view:
            lines.append(
                f"    {view['after_with_late']:.4g} with what begins in that part and was fitted there"
            )
        if "drift_variance_removed" in view and view["before"] > 1.05 * view["noise"]:
            lines.append(
                f"    variance removed {view['variance_removed']:.1%}, of the drift within that part "
                f"{view['drift_variance_removed']:.1%}"
            )
    if d.remainder.get("force"):
        lines.append(f"  {d.remainder['force']['text']}")
    lines.append(f"  left: {d.remainder['text']}")
    if d.where:
        c = d.where[0]
        lines.append(
            f"  where: {len(d.where)} cells (channel x tenth of the record) depart, most {c['channel']} at "
            f"{c['from']:.0f}-{c['to']:.0f} s"
        )
    lines += [f"  cannot be known: {n}" for n in d.notes[1:]]
    return "\n".join(lines)


def _amendments(view):
    """The view's choices in words, with the components that made them where they differ."""
    choices = view["amendments"]
    if len(set(choices)) == 1:
        return choices[0]
    names = ("Fx", "Fy", "Fz") if len(choices) == 3 else [f"e{k + 1}" for k in range(len(choices))]
    return "; ".join(
        f"{' '.join(n for n, c in zip(names, choices) if c == choice)}: {choice}"
        for choice in dict.fromkeys(choices)
    )


def write_report(diagnosis: RecordingDiagnosis, folder: pathlib.Path | str) -> list:
    """Writes verdict.json, report.html and the figures; returns the paths."""
    folder = pathlib.Path(folder)
    figures = [("overview.png", _overview), ("channels.png", _channels)]
    shaped = [f for f in diagnosis.findings if isinstance(f.effect, TimeShaped)]
    if shaped:
        figures.append(("shapes.png", lambda d: _shapes(d, shaped)))
    paths = []
    for name, draw in figures:
        figure = draw(diagnosis)
        with replacing(folder / name) as temporary:
            figure.savefig(temporary, dpi=110)
        paths.append(folder / name)
    with replacing(folder / "verdict.json") as temporary:
        temporary.write_text(json.dumps(verdict_dict(diagnosis), indent=1, allow_nan=False))
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(_page(diagnosis, [p.name for p in paths]))
    return [folder / "report.html", folder / "verdict.json", *paths]


def _figure(rows, height):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, height), layout="constrained")
    return figure, figure.subplots(rows, 1, squeeze=False)[:, 0]


def _overview(d):
    """The recording, and the same without the effects found."""
    r = d.recording
    width = max(1, len(r) // 1500)
    m = len(r) // width
    t = r.time[: m * width].reshape(m, width).mean(1)

    def bins(x):
        return x[: m * width].reshape(m, width, -1).mean(1)

    figure, axes = _figure(3 if r.force is not None else 2, 7 if r.force is not None else 5)
    level = np.median(bins(r.electrodes)[: max(3, m // 50)], axis=0)
    axes[0].plot(t, bins(r.electrodes) - level, lw=0.6)
    axes[0].set_title("measured, e1..e19 about the first rows", fontsize=9)
    shown = np.where(d.session.masked, np.nan, d.session.counts)
    with np.errstate(invalid="ignore"):
        import warnings

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            amended = np.nanmean(shown[: m * width].reshape(m, width, 19), axis=1)
    axes[1].plot(t, amended - np.nanmedian(amended[: max(3, m // 50)], axis=0), lw=0.6)
    axes[1].set_title("the effects found taken out", fontsize=9)
    for ax in axes[:2]:
        ax.set_ylabel("counts")
    if r.force is not None:
        axes[2].plot(t, bins(r.force), lw=0.6, label=["Fx", "Fy", "Fz"])
        axes[2].set_ylabel("N")
        axes[2].legend(fontsize=7, ncols=3)
    for ax in axes:
        ax.axvspan(r.time[~d.session.fit][0], r.time[-1], color="0.9", zorder=0)
    axes[-1].set_xlabel("s; grey: kept aside")
    return figure


def _channels(d):
    """RMS per channel on the part kept aside, before and after."""
    views = [(n, v) for n, v in d.gap.items() if "channels_before" in v]
    figure, axes = _figure(max(1, len(views)), 2.6 * max(1, len(views)))
    for ax, (name, view) in zip(axes, views):
        x = np.arange(len(view["channels_before"]))
        ax.bar(x - 0.2, view["channels_before"], 0.4, label="unamended", color="0.6")
        ax.bar(x + 0.2, view["channels_after"], 0.4, label="amended", color="tab:blue")
        if "noise" in view:
            ax.axhline(view["noise"], color="k", lw=0.7, ls=":", label="noise")
        ax.set_xticks(x, [f"e{k + 1}" for k in x] if len(x) == 19 else x, fontsize=7)
        ax.set_ylabel("counts RMS")
        ax.set_title(f"{name}, part kept aside", fontsize=9)
        ax.legend(fontsize=7)
    return figure


def _shapes(d, shaped):
    """Amplitude of each pattern over time and the shape that was fitted."""
    figure, axes = _figure(len(shaped), 2.3 * len(shaped))
    from .session import Session

    for ax, f in zip(axes, shaped):
        s = Session(d.recording, d.session.fit)
        s.masked = d.session.masked
        for other in d.findings:
            if other is not f:
                s._take_out(other)
        line, deviation, _ = whole_line(s)
        pattern = f.theta["pattern"][line.used]
        q = np.linalg.solve(line.covariance, pattern)
        ax.plot(
            line.time,
            deviation @ q / (pattern @ q),
            lw=0.7,
            color="0.4",
            label="measured, the load filtered out",
        )
        level = f.effect._level(d.recording.time, f.theta)
        inside = d.session.fit
        ax.plot(
            d.recording.time,
            level - level[inside].mean(),
            color="tab:red",
            lw=1.2,
            label="fitted on the white part",
        )
        ax.axvspan(d.recording.time[~inside][0], d.recording.time[-1], color="0.9", zorder=0)
        channels = "" if len(f.channels) > 12 else " " + ", ".join(f"e{k + 1}" for k in f.channels)
        ax.set_title(f.effect.name + channels, fontsize=9)
        ax.set_ylabel("ln Z")
        ax.legend(fontsize=7)
    axes[-1].set_xlabel("s")
    return figure


def _page(d, figures):
    esc = html.escape
    rows = []
    for f in d.findings:
        numbers = "<br>".join(esc(_number(n, *v, f.effect.params.get(n))) for n, v in f.parameters.items())
        ties = ", ".join(e.name for e in EFFECTS if e.id in f.ties) or "none"
        s = f.statistic
        proof = (
            f"{esc(s['name'])}: {s['before']:.3g} → {s['after']:.3g} {esc(s['unit'])}, {esc(s['part'])}"
            if s
            else "not checked"
        )
        channels = "all" if len(f.channels) > 12 else ", ".join(f"e{k + 1}" for k in f.channels)
        rows.append(
            f"<tr><td><b>{esc(f.effect.name)}</b><br>{esc(f.effect.physics)}</td>"
            f"<td>{STAGES[f.effect.stage]}</td><td>{channels}</td>"
            f"<td>{f.start:.1f}–{f.end:.1f} s</td><td>{numbers}</td>"
            f"<td>{f.confidence:.2f}<br>{f.nats:.0f} nats</td><td>{esc(ties)}</td>"
            f"<td>{proof}<br>{esc(f.note)}</td></tr>"
        )
    effects = "".join(rows) or "<tr><td colspan=8>none</td></tr>"
    cells = "".join(
        f"<tr><td>{c['channel']}</td><td>{c['from']:.0f}–{c['to']:.0f} s</td>"
        f"<td>{c['counts']:+.1f}</td><td>{c['p']:.1e}</td></tr>"
        for c in d.where[:12]
    )
    gaps = "".join(
        f"<tr><td>{esc(n)}</td><td>{v['before']:.4g}</td><td>{v['after']:.4g}</td><td>{esc(v['unit'])}</td>"
        f"<td>{v['variance_removed']:.1%}</td><td>{esc(_amendments(v))}</td></tr>"
        for n, v in d.gap.items()
    )
    apart = "".join(
        f"<li>{esc(f.effect.name)}: "
        f"{esc('; '.join(f'{k}: {v}' for k, v in f.effect.confusable.items()))}</li>"
        for f in d.findings
    )
    left = esc(d.remainder["text"]) + (
        "<br>" + esc(d.remainder["force"]["text"]) if d.remainder.get("force") else ""
    )
    pictures = "".join(f'<img src="{name}" style="max-width:100%">' for name in figures)
    return f"""<!doctype html><meta charset="utf-8"><title>{esc(d.recording.name)}</title>
<style>body{{font:15px/1.45 sans-serif;max-width:1100px;margin:2em auto;padding:0 1em}}
table{{border-collapse:collapse;width:100%;font-size:13px}}
td,th{{border:1px solid #ccc;padding:4px 6px;vertical-align:top;text-align:left}}
h1{{font-size:1.3em}}h2{{font-size:1.05em}}</style>
<h1>{esc(d.recording.name)}: {esc(d.verdict)}</h1>
<p>{len(d.recording)} rows, {len(d.recording) / d.recording.rate:.0f} s, {esc(d.notes[0])};
the last {d.locked:.0%} took no part in the fits.</p>
<h2>1. What was found and added</h2>
<table><tr><th>effect</th><th>stage</th><th>electrodes</th><th>when</th><th>parameters (95 %)</th>
<th>confidence</th><th>not distinguished from</th><th>proof</th></tr>
{effects}</table>
<h2>2. Where the unamended recording departs</h2>
<p>{len(d.where)} cells of channel x tenth of the record, family-wise 5 %.</p>
<table><tr><th>channel</th><th>when</th><th>counts</th><th>p</th></tr>{cells}</table>
<h2>3. Gap on the part kept aside</h2>
<table><tr><th>view</th><th>before</th><th>after</th><th>unit</th><th>variance removed</th>
<th>amended by</th></tr>{gaps}</table>
<p>Walk-forward trials inside the part fitted decided which of the findings a view takes.</p>
<h2>4. What is left</h2><p>{left}</p>
<h2>5. What the recording cannot tell</h2><ul>{"".join(f"<li>{esc(n)}</li>" for n in d.notes)}</ul>
<h2>6. What would tell alike effects apart</h2><ul>{apart or "<li>nothing was found</li>"}</ul>
{pictures}"""


def _number(name, value, low, high, known):
    unit = known.unit if known else {"counts": "counts", "change": "ln Z"}.get(name, "")
    unit = "" if unit == "1" else " " + unit
    text = f"{name} {value:.4g}{unit}"
    return text if math.isnan(low) or math.isnan(high) or low == high else f"{text} ({low:.4g} .. {high:.4g})"
