"""The report of trajectories: what `diagnose` found, as a verdict, figures and files."""

import dataclasses
import pathlib

import numpy as np

from ...effects.catalogue import CATALOGUE
from ..report import plots
from ..report.files import Picture, write
from ..report.verdict import Gap, Verdict, electrode_names
from .fitting import fit_effects
from .levels import excess
from .model.simulator import Simulator
from .where import conditions
from .workflow import THRESHOLDS, Report, threshold_hash

__all__ = ["verdict_of", "write_report"]

_NAMES = {"electrodes": "the electrodes", "pdc": "the liquid's pressure (PDC)", "force": "the force"}
_SHOWN = 4  # trajectories, of each of two channels


def verdict_of(report: Report) -> Verdict:
    """What `diagnose` found, as reports say it."""
    c, gaps = report.comparison, _gaps(report)
    significant = report.verdict != "no significant disagreement"
    level, after = report.trace["before"], report.trace["after"]
    names = {e.id: e.name for e in CATALOGUE}
    return Verdict(
        kind="trajectories",
        name="trajectories",
        data=f"{len(report.selection)} fitted, {len(report.locked)} kept aside",
        verdict=report.verdict,
        significant=significant,
        effects=[_proved(one, report, gaps) for one in report.effects],
        gap=gaps,
        aside=f"{len(report.locked)} trajectories that took no part in the search",
        closed=report.closed,
        where=report.where,
        where_note=(
            f"{len(report.where)} pairs of channel and condition stand out, 5 % false all together; mean "
            f"square over noise, resolution and scatter of poses {level['level']:.2f} of a trajectory and "
            f"{level['peak']:.2f} of the worst channel, {after['level']:.2f} and {after['peak']:.2f} with "
            f"the causes added; beyond {THRESHOLDS['significant']} or {THRESHOLDS['peak']} something is wrong"
        ),
        remainder=report.remainder,
        unknown=significant and bool(report.remainder),
        tried=[{"id": i, "name": names.get(i, i), "evidence_nats": n, "p": p} for i, n, p in report.ranking],
        tried_note=f"each cause alone, on trajectories left out; {THRESHOLDS['gain']} nats are asked for",
        notes=report.notes,
        next_experiment=report.next_experiment,
        details={
            "isolability": report.isolability,
            "mean_square": {"before": report.before["mean_square"], "after": report.after["mean_square"]},
            "trajectories": {
                "fitted": len(report.selection),
                "kept_aside": [c.trajectories[i].id for i in report.locked],
            },
            "thresholds": THRESHOLDS,
            "threshold_hash": threshold_hash(),
            "repeatability_m": c.repeatability,
        },
    )


def _gaps(report):
    """Group of channels -> Gap on trajectories kept aside."""
    c, names, out = report.comparison, _channel_names(report), {}
    for group, part in c.groups.items():
        each = [tuple(np.array(gap["channels"])[part].tolist()) for gap in (report.before, report.after)]
        out[group] = Gap(
            "N" if group == "force" else "counts",
            report.before[group],
            report.after[group],
            float(np.sqrt(np.mean(c.sigma[part] ** 2))),
            _NAMES[group],
            tuple(names[part]),
            *each,
        )
    return out


def _proved(finding, report, gaps):
    """A Finding with what trajectories kept aside say of it: whether it was added and they are nearer, and,
    where it alone was added, the gap that it closes most of."""
    if any(finding.id == one.finding.id for one in report.beside):
        return finding  # of the base model, which both sides have
    before, after = (excess(gap["mean_square"]) for gap in (report.before, report.after))
    added = [e.id for e, _ in report.fit.effects]
    closed = [gap for gap in gaps.values() if np.isfinite(gap.closed)] if added == [finding.id] else []
    gap = max(closed, key=lambda one: one.closed, default=None)
    return dataclasses.replace(finding, confirmed=finding.id in added and after < before, gap=gap)


def write_report(report: Report, sim: Simulator, folder: pathlib.Path | str) -> list[pathlib.Path]:
    """Writes report.html, verdict.json, sensor_amended.yaml and the figures; returns the paths."""
    folder = pathlib.Path(folder)
    drawn = {
        "curves": ("curves", _curves),
        "channels": ("gap", _channels),
        "where": ("where", _where),
        "evidence": ("tried", _evidence),
        "isolability": ("unknown", _isolability),
    }
    pictures = [Picture(name, section, draw(report)) for name, (section, draw) in drawn.items()]
    page, verdict, *figures = write(verdict_of(report), pictures, folder)
    report.apply(sim).save(folder / "sensor_amended.yaml")
    return [page, verdict, folder / "sensor_amended.yaml", *figures]


def _channel_names(report):
    return (
        electrode_names(range(19))
        + (["pdc"] if report.comparison.has_pdc else [])
        + (["Fx", "Fy", "Fz"] if report.comparison.has_force else [])
    )


def _curves(report):
    """Of the two channels that are furthest off, in some of the trajectories kept aside."""
    c, names, panels = report.comparison, _channel_names(report), []
    for channel in np.argsort(-np.array(report.before["channels"]) / c.sigma)[:2]:
        for k, i in enumerate(report.locked[:_SHOWN]):
            measured = c.measured[i][:, channel]
            panels.append(
                plots.Panel(
                    f"{names[channel]}, {c.trajectories[i].id}",
                    "N" if names[channel].startswith("F") else "counts",
                    c.trajectories[i].time,
                    measured,
                    *(measured - part[k][:, channel] for part in report.residuals),
                )
            )
    return plots.curves(panels, columns=min(_SHOWN, len(report.locked)))


def _channels(report):
    sigma = report.comparison.sigma
    each = [np.array(gap["channels"]) / sigma for gap in (report.before, report.after)]
    title, unit = "trajectories kept aside", "noise, resolution"
    return plots.channels([plots.Bars(title, unit, _channel_names(report), *each, 1.0)])


def _where(report):
    """Mean whitened residual of the model without effects (or its trend over trajectories)."""
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
    column = {"force": "Fy"}
    dots = [
        (list(asked).index(one["condition"]), names.index(column.get(one["channel"], one["channel"])))
        for one in report.where
    ]
    return plots.matrix(table, list(asked), names, dots, "mean residual, or trend [sigma]")


def _evidence(report):
    names, named = {e.id: e.name for e in CATALOGUE}, {one.id for one in report.effects}
    return plots.ranking(
        [names.get(i, i) for i, _, _ in report.ranking],
        [nats for _, nats, _ in report.ranking],
        [i in named for i, _, _ in report.ranking],
        THRESHOLDS["gain"],
    )


def _isolability(report):
    table = report.isolability
    return plots.isolability(table["ids"], table["matrix"], table["nats"])
