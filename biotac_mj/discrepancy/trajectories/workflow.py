"""The workflow: is there a disagreement, where, what is it, added, proved on trajectories that took no part,
and what cannot be known."""

import dataclasses
import typing
from collections.abc import Sequence

import numpy as np
import tqdm

from ...effects.catalogue import CATALOGUE
from ...effects.sensor_file import SensorFile
from ...geometry.design import check_nelectrode
from ..report.plots import Panel, Table
from ..report.verdict import Estimate, Finding, Gap, Verdict, of_electrodes
from .base.exchanges import exchanged
from .base.findings import other_modulus
from .base.rests import rested
from .beliefs import Beliefs, believed
from .fitting import Fit, fit_effects
from .model.simulator import Simulator
from .proof import Proof, borne_out, proved
from .remarks import few_off, next_experiment, of_base, of_data, of_search, strays
from .search import Search, found
from .settings import SETTINGS
from .trajectory import FEWEST, measurement_noise
from .where import left_over, overall, residual_cells, where
from .whitening import REPEATABILITY, Comparison

if typing.TYPE_CHECKING:
    from .model.fields import Fields
    from .trajectory import Trajectory

_GROUPS = {"electrodes": "the electrodes", "pdc": "the liquid's pressure (PDC)", "force": "the force"}
_PANELS = 4  # trajectories, of the report's first figure
_SURE = 1 - SETTINGS.rate  # the most that is stated: so many of all names are false


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrajectoryDiagnosis(Verdict):
    """A verdict on data with poses; `effects` are those of single electrodes, too, with their channels.

    Attributes:
      given: the simulator that was compared. fit: Fit, with the effects that are named and added; null:
        without effects.
      proof: on held-out trajectories, the skin solved again. comparison, selection, locked: what it was
        made of. beliefs: how likely which explanation is.
      search: what was tried.
    """

    given: Simulator
    fit: Fit
    null: Fit
    proof: Proof
    comparison: Comparison
    selection: np.ndarray
    locked: np.ndarray
    beliefs: Beliefs
    search: Search

    def panels(self) -> list[list[Panel]]:
        """The two channels with the largest error, in some of the held-out trajectories."""
        c, rows = self.comparison, []
        for channel in np.argsort(-np.array(self.proof.before["channels"]) / c.sigma)[:2]:
            name, row = c.channels[channel], []
            for k, i in enumerate(self.locked[:_PANELS]):
                t, measured = c.trajectories[i], c.measured[i][:, channel]
                each = (measured - part[k][:, channel] for part in self.proof.residuals)
                unit = "N" if name.startswith("F") else "counts"
                row.append(Panel(f"{name}, {t.id}", unit, t.time, measured, *each))
            rows.append(row)
        return rows

    def table(self) -> Table:
        """Mean residual of the model without effects, in noise and resolution, or its trend over
        trajectories."""
        c = self.comparison
        asked, _, mean = residual_cells(c, self.null, self.selection)
        dots = [(asked.index(one["condition"]), c.channels.index(one["channel"])) for one in self.where]
        return Table(overall(mean), asked, c.channels, dots, "mean residual, or trend [sigma]")

    def sensor(self) -> SensorFile:
        return self.apply(self.given).file

    def apply(self, sim: Simulator) -> Simulator:
        """The simulator with the effects found as further stages, and the modulus that was fitted with
        them."""
        own = self.comparison.sim.log_rest * (1 - self.fit.nuisance.stands_off)
        sim = sim.rested(own)
        new = sim.with_effects(self.fit.effects, sim.modulus * self.fit.nuisance.modulus)
        for k, (effect, name) in enumerate(self.fit.names):
            new.intervals.setdefault(effect, {})[name] = self.fit.interval(k)
        return new


def diagnose(
    sim: Simulator,
    data: "list[Trajectory]",
    *,
    effects: Sequence = CATALOGUE,
    repeatability: float = REPEATABILITY,
    locked: float = 0.25,
    progress: bool = True,
    fields: "Fields | None" = None,
) -> TrajectoryDiagnosis:
    """Compares a simulator with measured trajectories and names what it misses.

    Args:
      sim: Simulator. data: list of Trajectory. effects: the catalogue to choose from.
      repeatability: standard deviation of a pose from trial to trial [m]. locked: fraction of
        trajectories opened once, at the end.
      fields: what `sim.fields(data)` gave, to use again.

    Raises:
      ValueError: too few trajectories, or a fraction that leaves none.
    """
    for one in data:
        check_nelectrode(sim.design, one.electrodes.shape[1], f"trajectory {one.id!r}")
    n = len(data)
    if n < FEWEST:
        raise ValueError(
            f"{n} trajectories are too few: the trajectory is the unit of evidence and some are held out; "
            f"measure at least {FEWEST}, better 24"
        )
    if not 0 < locked < 0.6:
        raise ValueError(f"locked is {locked}: hold out a fraction between 0 and 0.6 of the trajectories")
    order = np.random.default_rng(0).permutation(n)
    aside = np.sort(order[: max(2, round(locked * n))])
    chosen = np.sort(order[len(aside) :])
    fields = sim.fields(data, progress) if fields is None else fields
    comparison = about_rests(sim, data, fields, repeatability)
    usable, hidden, notes = [], [], of_data(data, comparison)
    some = [data[i] for i in chosen]
    for effect in effects:
        one = effect.on(sim.design).among(some).solved(list(fields.slopes))
        why = one.applicable(some)
        if why:
            notes.append(f"{effect.name} cannot be known: {why}")
            hidden.append(one)
        else:
            usable.append(one)
    with tqdm.tqdm(total=3, desc="diagnose", unit="fit", disable=not progress or None, leave=False) as bar:
        # The base first: what poses are worth depends on its stiffness, and effects are looked for beside it.
        first = fit_effects(comparison, [], chosen)
        usable = _wired(usable, comparison, first, chosen)
        exchange = next((e for e in usable if e.wiring), None)
        if exchange is not None:
            comparison = about_rests(sim, data, fields, repeatability, exchange.reads)
            first = fit_effects(comparison, [], chosen, first)
        comparison = dataclasses.replace(comparison, modulus=first.nuisance.modulus)
        bar.update()
        null = fit_effects(comparison, [], chosen)
        search = found(comparison, null, usable, chosen, bar)
        search.hidden = hidden
        bar.update()
        report = _settle(sim, comparison, null, search, chosen, aside, notes, usable)
        bar.update()
    return report


def about_rests(
    given: Simulator, data: "list[Trajectory]", fields: "Fields", repeatability: float, reads: tuple = ()
) -> Comparison:
    """Comparison with a simulator whose electrodes rest where they did.

    Args:
      given: Simulator. fields: what it solved for the data. repeatability: of poses [m].
      reads: (electrode, the one whose counts, and whose rest, it shows)."""
    sim, own = rested(given, fields, data, reads)
    noise = measurement_noise(data)
    return Comparison(sim, data, own, noise, repeatability)


def _wired(usable, comparison, fit, chosen):
    """Effects with the exchange that the data may have in place of any, and without those of the rest alone,
    about which electrodes are compared."""
    out = []
    for effect in usable:
        if effect.wiring:
            effect = exchanged(comparison, fit, chosen)
        out += [effect] if effect is not None and not effect.of_rest else []
    return out


def _off(comparison, fit) -> tuple[float, float]:
    """Ratio of the residual to what is expected of a model: in the worst group of channels, and in the worst
    channel."""
    groups = [np.exp(np.log(fit.off[part]).mean()) for part in comparison.groups.values()]
    return float(max(groups)), float(fit.off.max())


def _wrong(comparison, fit) -> bool:
    """Whether the model misses more than is expected of it."""
    group, channel = _off(comparison, fit)
    return group > SETTINGS.beyond or channel > SETTINGS.beyond**2


def _tie_aliases(current, found, names):
    """Adds to the ties of Candidates the effects that are as likely with their parameters."""
    for item in found:
        theta = next(th for e, th in current.effects if e.id == item.effect.id)
        known = {*item.ties, *(one.effect.id for one in found)}
        item.ties = [*item.ties, *(i for i in item.effect.alias(theta) if i in names and i not in known)]


def _with(comparison, null, some, search, chosen):
    """Fit of these Candidates' effects together."""
    pairs = [one.fit.effects[-1] for one in some]
    fit = search.fits.get(frozenset(e.id for e, _ in pairs))
    return fit_effects(comparison, pairs, chosen, null) if fit is None else fit


def _upheld(comparison, null, found, search, chosen, aside):
    """Fit and Candidates of the effects that held-out trajectories confirm, one effect after another, and the
    other Candidates: an effect that explains the fitted ones alone has no name. Where they confirm another
    one that ties with it, that one has."""
    best, upheld, before = null, [], []
    for one in found:
        starts = [null] if best is null else [best, null]
        for other in (one, *_tied(one, search)):
            some = [*before, other]
            fit = _with(comparison, null, some, search, chosen)
            if all(borne_out(comparison, start, fit, aside) for start in starts):
                best, upheld = fit, some
                break
        before = upheld if len(upheld) > len(before) else [*before, one]
    return best, upheld, found[len(upheld) :]


def _tied(one, search):
    """Candidates that tie with one, the likeliest first, each with the ties after it."""
    step = next(step for step in search.rounds if any(c.fit is one.fit for c in step))
    tied = [c for c in step if c.effect.id in one.ties and not c.rejections]
    out, left = [], one.ties
    for c in tied:
        left = [name for name in left if name != c.effect.id]
        out.append(dataclasses.replace(c, ties=left))
    return out


def _unnamed(refuted, suspected):
    """Line on Candidates that held-out trajectories do not confirm, and on Findings that are less likely than
    not; "" if there are none."""
    what = " and ".join(one.effect.name for one in refuted)
    out = (
        [f"{what} would explain what was fitted, and held-out trajectories do not confirm it"] if what else []
    )
    what = " and ".join(f"{one.name} ({one.confidence:.0%})" for one in suspected)
    return "; ".join(out + ([f"suspected, and less likely than not: {what}"] if what else []))


def _settle(given, comparison, null, search, chosen, aside, notes, usable):
    """Diagnosis by a Search: named effects, errors of the base model, the proof."""
    names = {e.id: e.name for e in usable}
    _tie_aliases(search.fit, search.found, names)
    current, found, refuted = _upheld(comparison, null, search.found, search, chosen, aside)
    gone = {one.effect.id for one in search.found} - {one.effect.id for one in found}
    search.found = found + refuted
    if gone:  # by held-out trajectories: no experiment has to distinguish it from others
        some = {ids: fit for ids, fit in search.fits.items() if not ids & gone}
        search.fits = {k: fit for k, fit in some.items() if not k or borne_out(comparison, null, fit, aside)}
    beliefs = believed(comparison, search, len(chosen))
    sure = {one.effect.id: _sure(beliefs, one) for one in found}
    likely = [one for one in found if sure[one.effect.id] >= 0.5]  # what has a name is there rather than not
    doubtful = [one for one in found if one not in likely]
    suspected = [_described(one, one.fit, sure[one.effect.id], names, True) for one in doubtful]
    if doubtful:
        current, found, more = _upheld(comparison, null, likely, search, chosen, aside)
        refuted += more
    without_name = _unnamed(refuted, suspected)
    named = not _wrong(comparison, current)
    # Another modulus has a name where it is all that is left: else it may be a part of what is not known.
    modulus, without = other_modulus(comparison, current, chosen) if named else (None, None)
    if modulus and not found:
        null = without
    # what has no name is not written, and what is not written has no name
    proof = proved(comparison, null, current if found or modulus else null, aside)
    modulus = modulus if proof.fit is current else None
    seen = found or modulus or _wrong(comparison, null)
    alike = [names[name] for one in found for name in one.ties if name in names]
    doubts = [f"{', '.join(alike)} may be as good"] if alike else []
    if not named:
        doubts.append("a part of what is missed has no name")
    if refuted:
        doubts.append(_unnamed(refuted, []))
    beliefs = dataclasses.replace(beliefs, doubts=doubts)
    gaps = _gaps(comparison, proof)
    effects = [_described(item, current, sure[item.effect.id], names) for item in found]
    effects = [_proved(one, proof, gaps) for one in effects]
    effects += [dataclasses.replace(modulus, confidence=_SURE)] if modulus else []
    rest = ""
    if not effects and (not seen or few_off(null.mean_square(comparison)[chosen])):
        rest = strays(comparison, null, chosen, aside, search.rounds[0])
    if not (rest or effects and named):
        rest = without_name or (left_over(comparison, current, chosen) if seen else "")
    explained = (
        "" if seen else "noise, the model's resolution and the set-up's repeatability explain the data"
    )
    further = next_experiment(effects, suspected, names, bool(rest), comparison.sim.tier)
    notes = [*notes, *of_base(comparison, current, chosen), *of_search(search)]
    before, after = (dict(zip(("level", "peak"), _off(comparison, fit))) for fit in (null, current))
    cells = where(comparison, null, chosen)
    added = [effect.name for effect, _ in proof.fit.effects] + ([modulus.name] if modulus else [])
    return TrajectoryDiagnosis(
        kind="trajectories",
        name="trajectories",
        data=f"{len(chosen)} fitted, {len(aside)} held out",
        significant=bool(seen or rest),
        effects=effects,
        not_named=[_described(item, item.fit, None, names, False) for item in refuted] + suspected,
        gap=gaps,
        aside=f"{len(aside)} trajectories that took no part in the search, errors of their poses taken out",
        closed=proof.closed,
        closed_within=proof.within,
        where=cells,
        where_note=(
            f"{len(cells)} pairs of channel and condition stand out, 5 % false all together; the model is "
            f"off by {before['level']:.2g} times what is expected of it in the worst group of channels and "
            f"{before['peak']:.2g} in the worst channel, by {after['level']:.2g} and {after['peak']:.2g} "
            f"with the causes added; beyond {SETTINGS.beyond:g} or {SETTINGS.beyond**2:g} something is missed"
        ),
        remainder=rest or explained,
        unknown=bool(rest),
        tried=[
            {"id": c.effect.id, "name": c.effect.name, "evidence_nats": c.gain, "p": c.p}
            for c in search.rounds[0]
        ],
        tried_note="evidence of each cause alone over the base model, its parameters marginalised",
        notes=notes,
        next_experiment=f"{beliefs.text}; {further}",
        next_command="" if beliefs.decided else "biotac next REPORT --budget 20 --out plan.csv",
        amended=[f"sensor_amended.yaml has {', '.join(added)}"] if added else [],
        details={
            "trajectories": {
                "fitted": len(chosen),
                "kept_aside": [comparison.trajectories[i].id for i in aside],
            },
            "settings": dataclasses.asdict(SETTINGS),
            "settings_hash": SETTINGS.hash,
            "repeatability_m": comparison.repeatability,
            "explanations": [{"effects": one.ids, "probability": one.weight} for one in beliefs.explanations],
        },
        given=given,
        fit=proof.fit,
        null=null,
        proof=proof,
        comparison=comparison,
        selection=chosen,
        locked=aside,
        beliefs=beliefs,
        search=search,
    )


def _gaps(comparison, proof):
    """Group of channels -> Gap on held-out trajectories."""
    out = {}
    for group, part in comparison.groups.items():
        each = [tuple(gap["channels"][part]) for gap in (proof.before, proof.after)]
        out[group] = Gap(
            "N" if group == "force" else "counts",
            proof.before[group],
            proof.after[group],
            float(np.sqrt(np.mean(comparison.sigma[part] ** 2))),
            _GROUPS[group],
            tuple(comparison.channels[part]),
            *each,
        )
    return out


def _proved(finding, proof, gaps):
    """A Finding, confirmed by held-out trajectories, with the gap that it closes most of where it alone
    was added."""
    added = [e.id for e, _ in proof.fit.effects]
    closed = [gap for gap in gaps.values() if np.isfinite(gap.closed)] if added == [finding.id] else []
    gap = max(closed, key=lambda one: one.closed, default=None)
    return dataclasses.replace(finding, confirmed=True, gap=gap)


def _sure(beliefs, item) -> float:
    """Probability that a Candidate's effect, or one that it ties with, is there."""
    names = {item.effect.id, *item.ties}
    return _SURE * sum(one.weight for one in beliefs.explanations if names & {*one.ids})


def _described(item, current, certain, names, confirmed=None) -> Finding:
    """A Candidate as it is reported; names: id -> name of the effects that were looked for."""
    effect = item.effect
    theta = next(th for e, th in current.effects if e.id == effect.id)
    parameters = {
        name: Estimate.of(
            effect.params[name], value, *current.interval(current.names.index((effect.id, name)))
        )
        for name, value in theta.items()
    }
    return Finding.of(
        effect,
        channels=of_electrodes(parameters),
        parameters=parameters,
        evidence=item.gain,
        p=item.p,
        confidence=certain,
        confirmed=confirmed,
        ties={i: names[i] for i in item.ties},
    )
