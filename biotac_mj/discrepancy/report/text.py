"""A verdict as text for the terminal."""

import math

from ...effects.effect import STAGES
from .verdict import Finding, Verdict

_NUMBERS = 6  # parameters of an effect that are printed
_CELLS, _TRIED = 6, 12  # cells and causes that are printed
_HIDDEN = {"id", "stage", "unit", "attach"}  # columns of tables that are for programs


def summary(verdict: Verdict) -> str:
    """The headline, effects, the proof on held-out data, where it disagrees, and what the data cannot
    decide."""
    v = verdict
    lines = [v.headline, "", f"{v.name}: {v.data}"]
    lines += [f"warning: {line}" for line in v.warnings]
    lines.append(f"verdict: {v.verdict}")
    for f in v.effects:
        lines += _effect(f)
    for f in v.not_named:
        if f.confirmed is not None:
            why = (
                "suspected, less likely than not"
                if f.confirmed
                else "not confirmed by held-out data, left out"
            )
            lines.append(f"  {why}: {f.name}, {f.where}")
    lines += _gaps(v)
    if v.tried:
        lines += [f"  tried ({v.tried_note}):", *_table(v.tried[:_TRIED])]
    if v.where:
        lines += [f"  where ({v.where_note}):", *_table(v.where[:_CELLS])]
        if len(v.where) > _CELLS:
            lines.append(f"    and {len(v.where) - _CELLS} more")
    lines += [f"  left: {v.remainder}"] if v.remainder else []
    lines += [f"  {line}" for line in v.amended]
    lines += ["  what the data cannot tell:", *(f"    {line}" for line in v.notes)] if v.notes else []
    lines += [f"  next experiment: {v.next_experiment}"] if v.next_experiment else []
    lines += [f"    {v.next_command}"] if v.next_command else []
    return "\n".join(lines)


def _effect(f: Finding):
    certain = "" if f.confidence is None else f", confidence {f.confidence:.2f}"
    lines = [f"  {f.name} [{STAGES[f.stage]}], {f.where}{certain}" + (f", {f.when}" if f.when else "")]
    numbers = [f"{name} {value}" for name, value in f.parameters.items()]
    more = [f"and {len(numbers) - _NUMBERS} more"] if len(numbers) > _NUMBERS else []
    lines += [f"    {', '.join(numbers[:_NUMBERS] + more)}"] if numbers else []
    lines += [f"    {f.note or f.physics}", f"    {f.proof}"]
    return lines + [f"    not told from {name}: {how}" for name, how in f.experiments.items()]


def _gaps(v: Verdict):
    rows = [
        {
            "RMS_of": name,
            "simulated": f"{gap.before:.4g}",
            "amended": f"{gap.after:.4g}",
            "noise_and_resolution": gap.floor,
            "unit": gap.unit,
        }
        for name, gap in v.gap.items()
    ]
    return [f"  on {v.aside}:", *_table(rows, hidden=set()), *([f"    {v.share}"] if v.share else [])]


def columns(rows: list[dict], hidden: set[str] = _HIDDEN) -> list[str]:
    """Names of what dicts of a table have, but what is for programs."""
    return [name for name in dict.fromkeys(k for row in rows for k in row) if name not in hidden]


def cell(value: object) -> str:
    """A value of a table as text."""
    if isinstance(value, float):
        return f"{value:.3g}" if math.isfinite(value) else ""
    return "" if value is None else str(value)


def _table(rows, hidden=_HIDDEN):
    """Lines of a table with one column for each key."""
    names = columns(rows, hidden)
    cells = [[name.replace("_", " ") for name in names]]
    cells += [[cell(row.get(name)) for name in names] for row in rows]
    width = [max(map(len, column)) for column in zip(*cells)]
    return ["    " + "  ".join(c.ljust(w) for c, w in zip(row, width)).rstrip() for row in cells]
