"""The report of trajectories: what `diagnose` found, as a verdict, figures and files."""

import dataclasses
import pathlib
import shlex

import numpy as np

from ...effects.catalogue import CATALOGUE
from ..report import plots
from ..report.files import Picture, write
from ..report.verdict import Gap, Verdict, electrode_names
from .fitting import fit_effects
from .levels import excess
from .model.simulator import Simulator
from .remarks import scattered
from .settings import SETTINGS
from .where import conditions
from .workflow import TrajectoryDiagnosis

__all__ = ["verdict_of", "write_report"]

_NAMES = {"electrodes": "the electrodes", "pdc": "the liquid's pressure (PDC)", "force": "the force"}
_SHOWN = 4  # trajectories, of each of two channels


def verdict_of(diagnosis: TrajectoryDiagnosis, folder: pathlib.Path | str = "REPORT") -> Verdict:
    """What `diagnose` found, as reports say it; folder: of the report, for the command that goes on."""
    c, gaps = diagnosis.comparison, _gaps(diagnosis)
    significant = diagnosis.verdict != "no significant disagreement"
    level, after = diagnosis.trace["before"], diagnosis.trace["after"]
    names = {e.id: e.name for e in CATALOGUE}
    added = [effect.name for effect, _ in diagnosis.fit.effects]
    added += [one.finding.name for one in diagnosis.beside]
    return Verdict(
        kind="trajectories",
        name="trajectories",
        data=f"{len(diagnosis.selection)} fitted, {len(diagnosis.locked)} kept aside",
        verdict=diagnosis.verdict,
        significant=significant,
        effects=[_proved(one, diagnosis, gaps) for one in diagnosis.effects],
        not_named=diagnosis.refuted,
        gap=gaps,
        warnings=[line] if (line := scattered(c)) else [],
        aside=f"{len(diagnosis.locked)} trajectories that took no part in the search, errors of their poses "
        "taken out",
        closed=diagnosis.closed,
        where=diagnosis.where,
        where_note=(
            f"{len(diagnosis.where)} pairs of channel and condition stand out, 5 % false all together; the "
            f"model is off by {level['level']:.2g} times what is expected of it in the worst group of "
            f"channels and {level['peak']:.2g} in the worst channel, by {after['level']:.2g} and "
            f"{after['peak']:.2g} with the causes added; "
            f"beyond {SETTINGS.beyond:g} or {SETTINGS.beyond**2:g} something is missed"
        ),
        remainder=diagnosis.remainder,
        unknown=significant and bool(diagnosis.remainder),
        tried=[
            {"id": i, "name": names.get(i, i), "evidence_nats": n, "p": p} for i, n, p in diagnosis.ranking
        ],
        tried_note="evidence of each cause alone over the base model, its parameters marginalised",
        notes=diagnosis.notes,
        next_experiment=f"{diagnosis.beliefs.text}; {diagnosis.next_experiment}",
        next_command=""
        if diagnosis.beliefs.decided
        else f"biotac next {shlex.quote(str(folder))} --budget 20 --out plan.csv",
        amended=[f"sensor_amended.yaml has {', '.join(added)}"] if added else [],
        details={
            "isolability": diagnosis.isolability,
            "mean_square": {
                "before": diagnosis.before["mean_square"],
                "after": diagnosis.after["mean_square"],
            },
            "trajectories": {
                "fitted": len(diagnosis.selection),
                "kept_aside": [c.trajectories[i].id for i in diagnosis.locked],
            },
            "settings": dataclasses.asdict(SETTINGS),
            "settings_hash": SETTINGS.hash,
            "repeatability_m": c.repeatability,
            "explanations": [
                {"effects": one.ids, "probability": one.weight} for one in diagnosis.beliefs.explanations
            ],
        },
    )


def _gaps(diagnosis):
    """Group of channels -> Gap on trajectories kept aside."""
    c, names, out = diagnosis.comparison, _channel_names(diagnosis), {}
    for group, part in c.groups.items():
        each = [
            tuple(np.array(gap["channels"])[part].tolist()) for gap in (diagnosis.before, diagnosis.after)
        ]
        out[group] = Gap(
            "N" if group == "force" else "counts",
            diagnosis.before[group],
            diagnosis.after[group],
            float(np.sqrt(np.mean(c.sigma[part] ** 2))),
            _NAMES[group],
            tuple(names[part]),
            *each,
        )
    return out


def _proved(finding, diagnosis, gaps):
    """A Finding with what trajectories kept aside say of it: whether it was added and they are nearer, and,
    where it alone was added, the gap that it closes most of."""
    if any(finding.id == one.finding.id for one in diagnosis.beside):
        return finding  # of the base model, which both sides have
    before, after = (excess(gap["mean_square"]) for gap in (diagnosis.before, diagnosis.after))
    added = [e.id for e, _ in diagnosis.fit.effects]
    closed = [gap for gap in gaps.values() if np.isfinite(gap.closed)] if added == [finding.id] else []
    gap = max(closed, key=lambda one: one.closed, default=None)
    return dataclasses.replace(finding, confirmed=finding.id in added and after < before, gap=gap)


def write_report(
    diagnosis: TrajectoryDiagnosis, sim: Simulator, folder: pathlib.Path | str
) -> list[pathlib.Path]:
    """Writes diagnosis.html, verdict.json, sensor_amended.yaml and the figures; returns the paths."""
    folder = pathlib.Path(folder)
    drawn = {
        "curves": ("curves", _curves),
        "channels": ("gap", _channels),
        "where": ("where", _where),
        "evidence": ("tried", _evidence),
        "isolability": ("unknown", _isolability),
    }
    pictures = [Picture(name, section, draw(diagnosis)) for name, (section, draw) in drawn.items()]
    page, verdict, *figures = write(verdict_of(diagnosis, folder), pictures, folder)
    diagnosis.apply(sim).save(folder / "sensor_amended.yaml")
    return [page, verdict, folder / "sensor_amended.yaml", *figures]


def _channel_names(diagnosis):
    return (
        electrode_names(range(diagnosis.comparison.nelectrode))
        + (["pdc"] if diagnosis.comparison.has_pdc else [])
        + (["Fx", "Fy", "Fz"] if diagnosis.comparison.has_force else [])
    )


def _curves(diagnosis):
    """Of the two channels that are furthest off, in some of the trajectories kept aside."""
    c, names, panels = diagnosis.comparison, _channel_names(diagnosis), []
    for channel in np.argsort(-np.array(diagnosis.before["channels"]) / c.sigma)[:2]:
        for k, i in enumerate(diagnosis.locked[:_SHOWN]):
            measured = c.measured[i][:, channel]
            panels.append(
                plots.Panel(
                    f"{names[channel]}, {c.trajectories[i].id}",
                    "N" if names[channel].startswith("F") else "counts",
                    c.trajectories[i].time,
                    measured,
                    *(measured - part[k][:, channel] for part in diagnosis.residuals),
                )
            )
    return plots.curves(panels, columns=min(_SHOWN, len(diagnosis.locked)))


def _channels(diagnosis):
    sigma = diagnosis.comparison.sigma
    each = [np.array(gap["channels"]) / sigma for gap in (diagnosis.before, diagnosis.after)]
    title, unit = "trajectories kept aside", "times noise and resolution"
    return plots.channels([plots.Bars(title, unit, _channel_names(diagnosis), *each, 1.0)])


def _where(diagnosis):
    """Mean residual of the model without effects, in noise and resolution, or its trend over trajectories."""
    c = diagnosis.comparison
    white = fit_effects(c, [], diagnosis.selection).posed(c)
    names, asked = _channel_names(diagnosis), conditions([c.trajectories[i] for i in diagnosis.selection])
    table = np.full((len(asked), len(names)), np.nan)
    for k, parts in enumerate(asked.values()):
        means = [
            weight * white[i][rows].mean(0)
            for i, (rows, weight) in zip(diagnosis.selection, parts)
            if rows.any()
        ]
        if means:
            table[k] = np.mean(means, axis=0)
    column = {"force": "Fy"}
    dots = [
        (list(asked).index(one["condition"]), names.index(column.get(one["channel"], one["channel"])))
        for one in diagnosis.where
    ]
    return plots.matrix(table, list(asked), names, dots, "mean residual, or trend [sigma]")


def _evidence(diagnosis):
    names, named = {e.id: e.name for e in CATALOGUE}, {one.id for one in diagnosis.effects}
    return plots.ranking(
        [names.get(i, i) for i, _, _ in diagnosis.ranking],
        [nats for _, nats, _ in diagnosis.ranking],
        [i in named for i, _, _ in diagnosis.ranking],
        float(np.log(SETTINGS.odds)),
    )


def _isolability(diagnosis):
    table = diagnosis.isolability
    return plots.isolability(table["ids"], table["matrix"], table["nats"])
