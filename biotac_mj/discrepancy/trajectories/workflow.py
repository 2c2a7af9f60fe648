"""The workflow: is there a disagreement, where, what is it, added, proved on trajectories that took no part,
and what cannot be known."""

import dataclasses
import typing
from collections.abc import Sequence

import numpy as np
import tqdm

from ...effects.catalogue import CATALOGUE
from ...geometry.design import check_nelectrode
from ..report.verdict import Estimate, Finding, of_electrodes
from .base.channels import noisy_electrodes
from .base.findings import base_findings
from .base.pairs import exchanged, hearing
from .base.rests import rested
from .beliefs import Beliefs, believed
from .composition import chance, compose, kept, left_out, resumed
from .fitting import Fit, fit_effects
from .levels import excess, levels, steady, wrong
from .model.in_skin import in_the_skin
from .model.simulator import Simulator
from .proof import proved
from .remarks import jumps, of_base, of_data, strays
from .screening import isolability, next_experiment
from .thresholds import THRESHOLDS, confidence, threshold_hash
from .trajectory import FEWEST, measurement_noise
from .where import depends_on, where
from .whitening import REPEATABILITY, Comparison

if typing.TYPE_CHECKING:
    from .model.fields import Fields
    from .trajectory import Trajectory

_LESS = 1.4  # factor between two scatters of poses: that of a median of absolute values of few trajectories

__all__ = ["THRESHOLDS", "TrajectoryDiagnosis", "about_rests", "diagnose", "threshold_hash"]


@dataclasses.dataclass
class TrajectoryDiagnosis:
    """What `diagnose` found.

    Attributes:
      verdict: one line. effects: Findings, those of single electrodes with their channels.
      ranking: list of (id, nats per trajectory left out, p) of the first round. where: list of cells.
      before, after: dicts of mean square and RMS per channel on the locked trajectories. closed: share S on
        them.
      isolability: dict ids, matrix, nats. next_experiment: text. notes: what cannot be known.
      fit: Fit, with the effects that are added: those named but for what makes locked trajectories worse.
      comparison, selection, locked: what it was made of. residuals: (before, after), of every
        locked trajectory (n, width), the skin solved again. trace: numbers that thresholds are set on, as a
        file can hold them. beside: BaseCandidates, which `effects` names too. beliefs: how likely which
      explanation is.
    """

    verdict: str
    effects: list[Finding]
    ranking: list
    where: list
    before: dict
    after: dict
    closed: float
    isolability: dict
    next_experiment: str
    notes: list
    fit: Fit
    comparison: Comparison
    selection: np.ndarray
    locked: np.ndarray
    residuals: tuple
    remainder: str = ""
    trace: dict = dataclasses.field(default_factory=dict)
    beside: list = dataclasses.field(default_factory=list)
    beliefs: Beliefs | None = None

    def apply(self, sim: Simulator) -> Simulator:
        """The simulator with the effects found as further stages, and the modulus that was fitted with them;
        where the skin was solved with them for that, they act inside it."""
        own = self.comparison.sim.log_rest * (1 - self.fit.nuisance.stands_off)
        sim = sim.rested(own)
        more = [pair for one in self.beside for pair in one.pairs]
        new = sim.with_effects([*self.fit.effects, *more], sim.modulus * self.fit.nuisance.modulus)
        for one in self.beside:
            if one.pairs:
                found = one.finding.parameters.items()
                new.intervals[one.finding.id] = {name: (p.low, p.high) for name, p in found}
        for k, (effect, name) in enumerate(self.fit.names):
            new.intervals.setdefault(effect, {})[name] = self.fit.interval(k)
        solved = self.comparison.fields.remembered
        return in_the_skin(new) if any(e.id in solved for e, _ in self.fit.effects) else new


def diagnose(
    sim: Simulator,
    data: "list[Trajectory]",
    *,
    effects: Sequence = CATALOGUE,
    repeatability: float = REPEATABILITY,
    locked: float = 0.25,
    seed: int = 0,
    progress: bool = True,
    fields: "Fields | None" = None,
) -> TrajectoryDiagnosis:
    """Compares a simulator with measured trajectories and names what it misses.

    Args:
      sim: Simulator. data: list of Trajectory. effects: the catalogue to choose from.
      repeatability: standard deviation of a pose from trial to trial [m]. locked: share of the trajectories
        opened once, at the end.
      seed: of the split. fields: what `sim.fields(data)` gave, to use again.

    Raises:
      ValueError: too few trajectories, or a share that leaves none.
    """
    for one in data:
        check_nelectrode(sim.design, one.electrodes.shape[1], f"trajectory {one.id!r}")
    n = len(data)
    if n < FEWEST:
        raise ValueError(
            f"{n} trajectories are too few: the trajectory is the unit of evidence and some are kept aside; "
            f"measure at least {FEWEST}, better 24"
        )
    if not 0 < locked < 0.6:
        raise ValueError(f"locked is {locked}: keep a share between 0 and 0.6 of the trajectories aside")
    order = np.random.default_rng(seed).permutation(n)
    aside = np.sort(order[: max(2, round(locked * n))])
    chosen = np.sort(order[len(aside) :])
    fields = sim.fields(data, progress) if fields is None else fields
    comparison = about_rests(sim, data, fields, repeatability)
    usable, notes = [], of_data(data, comparison)
    some = [data[i] for i in chosen]
    for effect in effects:
        one = effect.on(sim.design).among(some).solved(list(fields.slopes))
        why = one.applicable(some)
        if why:
            notes.append(f"{effect.name} cannot be known: {why}")
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
        stated = comparison.calibrated(first.nuisance)
        bar.update()
        comparison, null, current, found, rounds = _explained(stated, usable, chosen, seed, bar)
        bar.update()
        report = _settle(comparison, null, current, found, rounds, chosen, aside, notes, usable, seed)
        bar.update()
    return report


def about_rests(
    given: Simulator, data: "list[Trajectory]", fields: "Fields", repeatability: float, reads: tuple = ()
) -> Comparison:
    """Comparison with a simulator whose electrodes rest where they did.

    Args:
      given: Simulator. fields: what it solved for the data. repeatability: of poses [m].
      reads: (electrode, the one whose counts, and whose rest, it shows)."""
    sim, own, apart = rested(given, fields, data, reads)
    noisy = noisy_electrodes(data, [one["force"] for one in own.base])
    noise = measurement_noise(data)
    return Comparison(sim, data, own, noise, repeatability, noisy=noisy, rest_apart=apart)


def _wired(usable, comparison, fit, chosen):
    """Effects with the exchange and the pairs of leads that the data may have in place of any, and without
    what is of the rest alone: electrodes are compared about it."""
    out = []
    for effect in usable:
        if effect.wiring:
            effect = exchanged(comparison, fit, chosen)
        elif effect.of_pairs:
            effect = hearing(comparison, fit, chosen) or effect
        out += [effect] if effect is not None and not effect.of_rest else []
    return out


def _explained(stated, usable, chosen, seed, bar):
    """Comparison with the scatter of poses that is left beside the effects, and what `compose` says with it.

    What is missing in the model looks like scatter, and scatter hides it: what grows with the load moves each
    trial's pose by something else. So effects are looked for twice, beside all the scatter that there is
    without them and beside what is stated. The second counts if, with the scatter that is left beside its own
    effects, trajectories left out are likelier than with more scatter and the first one's effects."""

    def begun(scatter, fields):
        comparison = dataclasses.replace(stated, repeatability=scatter, fields=fields)
        return comparison, fit_effects(comparison, [], chosen)

    def settled(start, found_there):
        """The same with the scatter that is left beside the effects, where that is another. More is looked
        for where it is less: with more scatter less can be seen."""
        (comparison, null), (fit, found, rounds) = start, found_there
        if not found:
            return comparison, null, fit, found, rounds
        least = dataclasses.replace(comparison, repeatability=stated.repeatability)
        here, left = comparison.repeatability, least.scatter(fit.effects, fit.nuisance, chosen)
        if max(left, here) <= _LESS * min(left, here):
            return comparison, null, fit, found, rounds
        other = begun(left, comparison.fields)
        if left > here:
            return *other, *kept(other[0], fit, found, chosen, seed), rounds
        fit, found, more = resumed(*other, fit, found, usable, chosen, seed, bar)
        return *other, fit, found, rounds + more

    first = begun(stated.scatter([], fit_effects(stated, [], chosen).nuisance, chosen), stated.fields)
    some = settled(first, compose(*first, usable, chosen, seed, bar))
    if some[0].repeatability <= _LESS * stated.repeatability:
        return some
    # its skin is solved where its own fits end
    second = begun(stated.repeatability, dataclasses.replace(stated.fields, curves={}))
    other = settled(second, compose(*second, usable, chosen, seed, bar))
    if not other[3]:
        return some
    gain = _likelihood(other, chosen, seed) - _likelihood(some, chosen, seed)
    return other if gain.mean() > THRESHOLDS["gain"] and chance(gain) < THRESHOLDS["p"] else some


def _likelihood(end, chosen, seed):
    """(chosen,) evidence of trajectories left out, less what their scatter leaves open [nats]."""
    comparison, _, fit, *_ = end
    return (left_out(comparison, fit, chosen, seed) - comparison.volume())[chosen]


def _compared(comparison, null, current, chosen):
    """Mean squares (chosen,) before and after; levels before and after, what is left of the excess and the
    share of it that is closed, all by the same trajectories."""
    rows = steady(comparison, current, chosen)
    square = [fit.mean_square(comparison) for fit in (null, current)]
    first, left = (excess(s[rows]) for s in square)
    before, after = (levels(comparison, fit, rows) for fit in (null, current))
    return [s[chosen] for s in square], before, after, left, 1 - left / max(first, left, 1e-9)


def _distinct(first, step, inside) -> bool:
    """Whether nothing but its kin explains a part of what the first effect does: then it is named though its
    law leaves much."""
    equivalents = {first.effect.id, *first.effect.equivalents, *first.ties}
    rivals = [c.nats for c in step if c.effect.id not in equivalents and c.p < THRESHOLDS["promising"]]
    other = max(rivals, default=0.0)
    return (
        inside > THRESHOLDS["distinct"]
        and first.nats > THRESHOLDS["other"] * max(other, THRESHOLDS["gain"])
        and not first.effect.flexible
    )


def _apart(one, found) -> bool:
    """Whether a further effect does too much, and too much else, to be what another one's law lacks."""
    others = [c.effect for c in found if c is not one]
    alike = any(
        one.effect.id in (*e.confusable, *e.equivalents)
        or e.id in (*one.effect.confusable, *one.effect.equivalents)
        for e in others
    )
    much = one.nats > 2 * THRESHOLDS["further"] and one.share > THRESHOLDS["apart"]
    return much and not alike and not one.effect.flexible


def _anything(found, usable) -> bool:
    """Whether all that was found takes up something of nearly anything, and another stage would as well."""
    stages = {e.id: e.stage for e in usable}
    tied = [stages[t] for one in found for t in one.ties if t in stages]
    return len(found) == 1 and found[0].effect.flexible and any(s != found[0].effect.stage for s in tied)


def _trimmed(comparison, null, current, found, rounds, chosen, usable):
    """Fit and Candidates without what is no name where much is left, and notes that say why."""
    _, _, after, _, inside = _compared(comparison, null, current, chosen)
    if len(found) > 1 and inside < THRESHOLDS["named"] and wrong(after):
        # Where the rest stays unknown, a further effect may be what the first one's law lacks.
        found = [found[0], *(one for one in found[1:] if _apart(one, found))]
        ids = {one.effect.id for one in found}
        current = fit_effects(comparison, [e for e in current.effects if e[0].id in ids], chosen, current)
        _, _, after, _, inside = _compared(comparison, null, current, chosen)
    little = found and inside < THRESHOLDS["partly"] and not _distinct(found[0], rounds[0], inside)
    if not wrong(after) or not (little or _anything(found, usable)):
        return current, found, []
    nearest = " and ".join(item.effect.name for item in found)
    why = "too little for a name" if little else "so would others elsewhere, and none explains it all"
    return null, [], [f"{nearest} would explain {inside:.0%} of it: {why}"]


def _tie_aliases(current, found, names):
    """Adds to the ties of Candidates what with their parameters is as likely."""
    for item in found:
        theta = next(th for e, th in current.effects if e.id == item.effect.id)
        known = {*item.ties, *(one.effect.id for one in found)}
        item.ties = [*item.ties, *(i for i in item.effect.alias(theta) if i in names and i not in known)]


def _in_words(comparison, current, effects, named, chosen):
    """Verdict, and what is said of the remainder, where something disagrees."""
    parts = [
        e.name + (f" (or {' or '.join(e.ties.values())}: not told apart)" if e.ties else "") for e in effects
    ]
    if effects and named:
        return ("found: " if len(parts) == 1 else "several: ") + "; ".join(parts), ""
    remainder = "" if effects else jumps(comparison, current)
    remainder = remainder or depends_on(comparison, current, chosen)
    if not effects:
        return f"unknown ({remainder})", remainder
    return f"partly: {'; '.join(parts)}; remainder unknown ({remainder})", remainder


def _not_added(found, added):
    """Notes of effects that have a name and are not added."""
    stay = {e.id for e, _ in added.effects}
    out = [one.effect for one in found if one.effect.id not in stay]
    if not out:
        return []
    what = " and ".join(e.name for e in out)
    return [f"named, not added: trajectories kept aside are further off with {what} than without"]


def _settle(comparison, null, current, found, rounds, chosen, aside, notes, usable, seed):
    """Report of what `compose` found: what of it has a name, what the base model is off by, the proof."""
    current, found, why = _trimmed(comparison, null, current, found, rounds, chosen, usable)
    square, before, after, left, inside = _compared(comparison, null, current, chosen)
    names = {e.id: e.name for e in usable}
    _tie_aliases(current, found, names)
    effects = [
        _described(item, current, confidence(item.nats, inside, left, item.lead, len(item.ties)), names)
        for item in found
    ]
    named = inside >= THRESHOLDS["named"] or not wrong(after)
    # What the base is off by has a name where it is all that is left: else it may be a part of what is not
    # known.
    beside = base_findings(comparison, current, chosen, seed) if named else []
    for one in beside:
        null = one.bare if one.bare is not None and not found else null
        certain = confidence(one.finding.evidence, 1.0, left, 10.0, 0)
        effects.append(dataclasses.replace(one.finding, confidence=certain))
    seen = found or beside or wrong(before)
    # what has no name is not written either
    proof = proved(comparison, null, current if found or beside else null, aside)
    alike = [name for one in effects for name in one.ties.values()]
    doubts = [f"by the spread over trajectories {', '.join(alike)} may be as good"] if alike else []
    if found and not proof.fit.effects:
        doubts.append("trajectories kept aside contradict it")
    beliefs = believed(comparison, null, current, found, rounds[0], doubts, chosen, seed)
    stray = ""
    if seen:
        verdict, remainder = _in_words(comparison, current, effects, named, chosen)
    else:
        stray = strays(comparison, null, chosen, aside, rounds[0])
        stray = stray or jumps(comparison, null) or beliefs.against_none
        remainder = stray or "noise, the model's resolution and the set-up's repeatability explain the data"
        verdict = f"unknown ({stray})" if stray else "no significant disagreement"
    table = isolability(comparison, current, usable, effects, chosen)
    more = bool(remainder) and (wrong(after) or bool(stray))
    notes = [*notes, *why, *_not_added(found, proof.fit), *of_base(comparison, current, chosen)]
    trace = {
        "before": before,
        "after": after,
        "inside": inside,
        "left": left,
        "rounds": [[c.record() for c in step] for step in rounds],
        "mean_square": [s.tolist() for s in square],
        "closed": proof.closed,
        "nuisance": [dataclasses.asdict(f.nuisance) for f in (null, current)],
    }
    return TrajectoryDiagnosis(
        verdict,
        effects,
        [(c.effect.id, c.nats, c.p) for c in rounds[0]],
        where(comparison, null, chosen),
        proof.before,
        proof.after,
        proof.closed,
        table,
        next_experiment(effects, table, more, comparison.sim.tier),
        notes + table.pop("notes"),
        proof.fit,
        comparison,
        chosen,
        aside,
        proof.residuals,
        remainder,
        trace,
        beside,
        beliefs,
    )


def _described(item, current, certain, names) -> Finding:
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
        evidence=item.nats,
        p=item.p,
        confidence=certain,
        ties={i: names[i] for i in item.ties},
    )
