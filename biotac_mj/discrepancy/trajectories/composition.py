"""Which effects together: round after round the best one is refitted and tested; ties are carried on as
further beams; at the end each has to be needed."""

import dataclasses
import typing

import numpy as np
import tqdm
from scipy.stats import false_discovery_control

from ..evidence import sign_flip, signed_root_t
from .base.channels import narrowed
from .fitting import Fit, fit_effects
from .levels import levels, steady, wrong
from .model.in_skin import FOLLOWS, remember
from .screening import screen
from .thresholds import THRESHOLDS

if typing.TYPE_CHECKING:
    from .whitening import Comparison

__all__ = ["Candidate", "chance", "compose", "kept", "left_out", "resumed"]

_LEVER = 10e-3  # [m] of a turn: what is pressed lies 5 to 20 mm from the sensor's origin
_SOLVED = 2  # times that the skin is solved for an effect that moves the object,
_WORTH = 0.2  # [nats per trajectory] if it explains so much of the very trajectories of its fit,
# and more often where it explains so much: a sensor turned by two degrees was fitted with a fifth of that by
# what the skin did there, and came out right, with twice the nats, where it was solved eight times
_FURTHER, _MUCH = 10, 3.0
_ABOUT = 3  # times with changes of each parameter there, each of which is one solution more
_BEAMS = 3
_SOME, _KINS = 0.15, 2  # of the best one's evidence, from which on another effect's rubber is solved for, too
_FOLDS = 8
_ACTS = 1e-3  # counts or newtons, from which on an effect acts on a channel
_FAR = 10.0  # standard errors, beyond which a lead counts no more (`thresholds.terms`)


@dataclasses.dataclass
class Candidate:
    """An effect refitted on top of others.

    Attributes:
      effect, fit. gain: (chosen,) evidence on trajectories left out over the model without it; nats: its
        mean; p, q: see `chance`.
      held: (chosen,) that evidence itself. share: of the closable log mean square.
      energy: of the mean square taken away by all effects so far, what this one took.
      refused: reasons. ties: ids that do as well. lead: over the runner-up, in standard errors.
    """

    effect: object
    fit: Fit
    gain: np.ndarray
    held: np.ndarray
    nats: float
    p: float
    share: float
    energy: float
    refused: list
    q: float = 1.0
    ties: list = dataclasses.field(default_factory=list)
    lead: float = 0.0

    def record(self) -> dict:
        """What a file can hold of it."""
        keys = ("nats", "p", "q", "share", "energy", "refused", "ties", "lead")
        theta = next(th for e, th in self.fit.effects if e.id == self.effect.id)
        found = {"id": self.effect.id, **{k: getattr(self, k) for k in keys}, "theta": theta}
        return {**found, "gains": self.gain.tolist()}


def compose(
    comparison: "Comparison",
    null: Fit,
    usable: list,
    chosen: np.ndarray,
    seed: int,
    bar: tqdm.tqdm | None = None,
) -> tuple[Fit, list, list]:
    """The composition that trajectories left out like best.

    Args:
      bar: of the fits, which are counted as they are found to be needed.

    Returns:
      fit: Fit; found: list of Candidate, in the order of their acceptance; rounds: lists of Candidate of the
        winning beam, best first.
    """
    bar = tqdm.tqdm(total=0, disable=True) if bar is None else bar
    first = _round(comparison, null, null, usable, chosen, seed, bar)
    ends = {}
    # Where what only promises comes to nothing, what stands by itself begins.
    for accepted in ([c for c in first if _promising(c)], [c for c in first if not c.refused]):
        if not accepted or any(found for _, found, *_ in ends.values()):
            break
        _rank(accepted[0], first)
        tied = [accepted[0], *[c for c in accepted[1:] if c.effect.id in accepted[0].ties]]
        ends = {}
        for start in tied[:_BEAMS]:
            fit, found, rounds, held = _grown(
                comparison, start.fit, [start], null, usable, chosen, seed, bar, first
            )
            ends[start.effect.id] = fit, found, [first, *rounds], held - THRESHOLDS["gain"] * len(found)
    if not ends:
        return null, [], [first]
    ends = {k: e for k, e in ends.items() if e[1]} or ends
    size = [sum(len(c.effect.params) for c in e[1]) for e in ends.values()]
    winner = list(ends)[_simplest([(e[3], k) for e, k in zip(ends.values(), size)])]
    fit, found, rounds, score = ends[winner]
    if found and found[0].effect.id == winner:
        _rank(found[0], first)
        # Who tied at first and was carried on has to tie in the end too.
        zero = left_out(comparison, null, chosen, seed)[chosen]
        equivalents = found[0].effect.equivalents
        found[0].ties = [
            t
            for t in found[0].ties
            if t not in ends or _tied(score - zero, ends[t][3] - zero, t in equivalents)
        ]
        if len(found) > 1:  # and in the winner's place, beside the others
            held = left_out(comparison, fit, chosen, seed)[chosen]
            others = [c for c in first if c.effect.id in found[0].ties]
            swapped = [_instead(comparison, fit, winner, c, chosen, seed) for c in others]
            found[0].ties = [
                c.effect.id
                for c, other in zip(others, swapped)
                if other is not None and _tied(held - zero, other - zero, c.effect.id in equivalents)
            ]
    return fit, _told_apart(found), rounds


def _told_apart(found):
    """Candidates without ties to each other: both are named."""
    named = {c.effect.id for c in found}
    for c in found:
        c.ties = [t for t in c.ties if t not in named]
    return found


def resumed(
    comparison: "Comparison",
    null: Fit,
    current: Fit,
    found: list,
    usable: list,
    chosen: np.ndarray,
    seed: int,
    bar: tqdm.tqdm,
) -> tuple[Fit, list, list]:
    """`compose` gone on with from effects that were found with another scatter of poses: fit, found, and the
    further rounds."""
    fit = fit_effects(comparison, current.effects, chosen, current)
    fit, found, rounds, _ = _grown(comparison, fit, found, null, usable, chosen, seed, bar)
    return fit, _told_apart(found), rounds


def kept(
    comparison: "Comparison", current: Fit, found: list, chosen: np.ndarray, seed: int
) -> tuple[Fit, list]:
    """Of effects that were found with another scatter of poses those that are needed with this one: fit,
    found."""
    return _needed(comparison, fit_effects(comparison, current.effects, chosen, current), found, chosen, seed)


def _grown(comparison, fit, found, null, usable, chosen, seed, bar, first=()):
    """Fit and Candidates with the best one of every further round, without what is not needed then; rounds;
    evidence (chosen,) left out before that. first: Candidates beside nothing, where they are known."""
    rounds, found = [], list(found)
    while len(found) < THRESHOLDS["most"]:
        step = _round(comparison, fit, null, usable, chosen, seed, bar)
        rounds.append(step)
        able = [c for c in step if _promising(c)]
        if not able:
            break
        best = able[_simplest([(c.held, len(c.effect.params)) for c in able])]
        _rank(best, step)
        if _remainder(best, found) or _doubtful(comparison, fit, best, chosen):
            break
        alone = [c.nats for c in first if c.effect.id == best.effect.id]
        alone = alone or [_alone(comparison, best, null, chosen, seed)]
        if best.nats < THRESHOLDS["shared"] * alone[0]:
            break
        found, fit = [*found, best], best.fit
    held = found[-1].held
    return *_needed(comparison, fit, found, chosen, seed), rounds, held


def _remainder(best, found):
    """Whether what is left is what the law of one that is there lacks: its kin would explain as much."""
    equivalents = {name for c in found for name in c.effect.equivalents}
    return best.effect.id not in equivalents and bool(equivalents & set(best.ties))


def _doubtful(comparison, fit, best, chosen) -> bool:
    """Whether what is left lies within noise, resolution and scatter of poses, and another effect would
    explain it as well: so it is with what a law of another form leaves of itself."""
    return bool(best.ties) and not wrong(levels(comparison, fit, steady(comparison, fit, chosen)))


def _alone(comparison, best, null, chosen, seed) -> float:
    """Evidence [nats] of an effect beside nothing, which it has to have beside others, too.

    Evidence is a logarithm of mean squares. Of two effects that do different things to the data each has
    more of it beside the other, which hides it no longer: log((a + b + n) / (a + n)) < log((b + n) / n). One
    that has less explains what the other explains too, and what it adds is what the other's law lacks."""
    item = next(one for one in best.fit.effects if one[0].id == best.effect.id)
    alone = left_out(comparison, fit_effects(comparison, [item], chosen, null), chosen, seed)
    return float((alone - left_out(comparison, null, chosen, seed))[chosen].mean())


def _instead(comparison, fit, winner, other, chosen, seed):
    """Evidence (chosen,) left out with another Candidate's effect in the winner's place; None where it is
    there already."""
    if any(e.id == other.effect.id for e, _ in fit.effects):
        return None
    mine = next(item for item in other.fit.effects if item[0].id == other.effect.id)
    effects = [mine if e.id == winner else (e, theta) for e, theta in fit.effects]
    return left_out(comparison, fit_effects(comparison, effects, chosen, fit), chosen, seed)[chosen]


def _simplest(options) -> int:
    """Index of the one with the fewest parameters among those (evidence (chosen,), parameters) that the best
    does not lead by much."""
    best = max(options, key=lambda o: o[0].mean())[0]
    near = [k for k, (e, _) in enumerate(options) if not _ahead(best - e, THRESHOLDS["simpler"])]
    return min(near, key=lambda k: (options[k][1], -options[k][0].mean()))


def _ahead(lead, by=None):
    return bool(
        lead.mean() > (THRESHOLDS["tie"] if by is None else by) * lead.std(ddof=1) / np.sqrt(len(lead))
    )


def _tied(gain, other, equivalents) -> bool:
    """Whether the other's evidence (chosen,) is as good: within the spread over trajectories, or nearer than
    laws are known; less so of kin."""
    alike = THRESHOLDS["equivalent" if equivalents else "alike"]
    return not _ahead(gain - other) or other.mean() > alike * gain.mean()


def _rank(best, step):
    """Ties of the best one, and its lead over the runner-up."""
    leads = {c.effect.id: best.gain - c.gain for c in step if c is not best}
    best.ties = [
        c.effect.id
        for c in step
        if c is not best
        # what all electrodes do is the same effect, called another; what their places do is none
        and not {"common", "places"} & set(c.refused)
        and c.nats >= THRESHOLDS["gain"]
        and _tied(best.gain, c.gain, c.effect.id in best.effect.equivalents)
    ]
    best.lead = min(
        (float(v.mean() / max(v.std(ddof=1) / np.sqrt(len(v)), 1e-9)) for v in leads.values()), default=10.0
    )


def _round(comparison, current, null, effects, chosen, seed, bar):
    """Screen, then refit the short list with cross-validation by trajectory; Candidates, best first."""
    bar.set_description(" + ".join(["diagnose", *(e.name for e, _ in current.effects)]))
    known = {e.id for e, _ in current.effects}
    # Which electrodes stand out is seen better beside what is there already.
    effects = [narrowed(comparison, current, e, chosen) for e in effects if e.id not in known]
    ranked = screen(comparison, current, effects, chosen)
    rows = float(np.mean([len(comparison.trajectories[i].time) for i in chosen]))
    asked = THRESHOLDS["screened"] * THRESHOLDS["further" if known else "gain"] / (0.5 * rows)

    def always(effect):
        """What moves the object most often is wrong, and straight lines about no effect do not show it: a
        tilt gained 15 nats a trajectory when it was fitted, and none in the screen. Each costs solutions of
        the skin, so the first round alone tries all of it."""
        return effect.pose_offset if known else effect.moves_object

    short = [r for r in ranked[: THRESHOLDS["refit"]] if r[0] > asked or always(r[1])]
    short += [r for r in ranked[THRESHOLDS["refit"] :] if always(r[1])]
    beside = {name for _, effect, _ in short for name in effect.refit_with}
    short += [r for r in ranked if r not in short and r[1].id in beside]
    begun = _Begun(comparison, current, null, chosen, seed)
    out = []
    bar.total += len(short)
    for _, effect, start in short:
        # The skin is solved again where that may decide: not beside who explains it all, or all but noise.
        solve = not known or begun.more
        solve &= not any(not c.refused and c.share >= THRESHOLDS["named"] for c in out)
        fit = _refit(comparison, effect, start, chosen, current, solve)
        if "more" in start and effect.rejection_reason(fit.effects[-1][1]) == "film":
            # It took up something else, as beside a loop of the force that no electrode sees.
            whole = next(e for e in effects if e.id == effect.id)
            effect = whole.given([name for name in whole.rare if name != "more"])
            start = {name: start[name] for name in effect.params}
            fit = _refit(comparison, effect, start, chosen, current, solve)
        out.append(_candidate(comparison, effect, fit, begun, chosen, seed, out))
        bar.update()
    late = _late(out)
    for turn in (late, late and [max(range(len(out)), key=lambda k: out[k].nats)]):
        for k in turn:
            fit = _remembered(comparison, out[k], chosen, current)
            if fit is not None:
                out[k] = _candidate(comparison, out[k].effect, fit, begun, chosen, seed, [])
    for c, q in zip(out, false_discovery_control([c.p for c in out])):
        c.q = float(q)
    return sorted(out, key=lambda c: -c.nats)


def _wired(current, null):
    """Fit with nothing, or with the exchange of electrodes that was found: it has no law of another form that
    could leave some of it, and beside what it takes away a warm-up is little."""
    wiring = [one for one in current.effects if one[0].wiring]
    return dataclasses.replace(current, effects=wiring) if wiring else null


class _Begun:
    """What a round begins with.

    Attributes:
      current: Fit. fitted, reference: (chosen,) its evidence on the very trajectories of its fit, and on
        trajectories left out, beside which that of more effects is set: with what the base is off by an
        effect is fitted too, and would be charged with what that fails to foresee.
      nothing: Fit without effects but wiring. excess: mean log of the mean squares with `current` that can be
        closed; more: whether it is more than noise.
    """

    def __init__(self, comparison, current, null, chosen, seed):
        self.current, self.fitted = current, current.evidence(comparison)[chosen]
        self.reference = left_out(comparison, current, chosen, seed)[chosen]
        self.nothing = _wired(current, null)
        square = current.mean_square(comparison)[chosen]
        self.excess = max(float(np.log(np.maximum(square, 1.0)).mean()), 1e-9)
        self.more = self.excess > np.log(THRESHOLDS["significant"])


def _energy(comparison, fit, begun, chosen):
    """Of the mean square that all effects of a Fit take away, the share of the last one, in those groups of
    channels on which it acts: a gain of PDC acts on one of 23, and is little beside a turned sensor."""
    last, base = fit.effects[-1], fit.effects[:-1]
    runs = [comparison.raw(effects, fit.nuisance) for effects in ([*base, last], base)]
    acts = np.zeros(comparison.width, bool)
    for part in comparison.groups.values():
        acts[part] = any(np.abs(b[:, part] - a[:, part]).max() > _ACTS for a, b in zip(*runs))
    if not acts.any():
        return 0.0

    def square(of):
        residuals = of.residuals(comparison)
        return np.mean([(residuals[i][:, acts] ** 2).mean() for i in chosen])

    with_it, without, nothing = (square(of) for of in (fit, begun.current, begun.nothing))
    return float((without - with_it) / max(nothing - with_it, 1e-9))


def _candidate(comparison, effect, fit, begun, chosen, seed, others):
    """Candidate of a fit with one effect more than the round began with, beside others of it."""
    present = [e for e, _ in begun.current.effects]
    held, reference = fit.evidence(comparison)[chosen], begun.fitted
    if not _hopeless(held - reference, others, effect, bool(present)):
        held, reference = left_out(comparison, fit, chosen, seed)[chosen], begun.reference
    gain = held - reference
    energy = _energy(comparison, fit, begun, chosen)
    rows = float(np.mean([len(comparison.trajectories[i].time) for i in chosen]))
    nats, p = float(gain.mean()), chance(gain)
    one = Candidate(effect, fit, gain, held, nats, p, nats / (0.5 * rows * begun.excess), energy, [])
    one.refused = _refused(comparison, one, chosen, present, begun.more)
    return one


def _late(out):
    """Indices of the Candidates whose rubber is worth solving for, the best of the two best kins, where the
    best of a round leaves more than noise. Reduced forms are right about a separable field, which rubber
    under liquid is not: loops may be better told by a relaxation's reduced form than by their own."""
    best = max((c.nats for c in out), default=0.0)
    if best < _MUCH or any(not c.refused and c.share >= THRESHOLDS["named"] for c in out):
        return []
    taken, chosen = set(), []
    for k in sorted(range(len(out)), key=lambda k: -out[k].nats):
        if out[k].nats > _SOME * best and out[k].effect.remembers and out[k].effect.id not in taken:
            chosen.append(k)
            taken |= {out[k].effect.id, *out[k].effect.equivalents}
    return chosen[:_KINS]


def _remembered(comparison, one, chosen, current):
    """Fit of a Candidate's effect where the skin's rubber does it itself; None where that is not solved."""
    theta = one.fit.effects[-1][1]
    if not remember(comparison.sim, comparison.fields, one.effect, theta):
        return None
    # what its form lets film and liquid do besides follows from the skin now
    begin = {n: 0.0 if n in FOLLOWS else v for n, v in theta.items()}
    return fit_effects(comparison, [*current.effects, (one.effect, begin)], chosen, current)


def _refit(comparison, effect, start, chosen, current, solve=True):
    """Fit with one effect more. Where it moves the object the skin is solved again there, and it is fitted
    once more, since differences do not reach far."""
    fit = fit_effects(comparison, [*current.effects, (effect, start)], chosen, current)
    if not solve or not effect.before_skin and effect.joining(start) is None:
        return fit
    for k in range(_FURTHER):
        gain = (fit.evidence(comparison) - current.evidence(comparison))[chosen].mean()
        theta = fit.effects[-1][1]
        little = effect.pose_offset and _repeatable(comparison, fit, effect, theta, chosen)
        if gain < (_WORTH if k < _SOLVED and not little else _MUCH):
            break
        work = effect.joining(theta)
        if work is not None:
            new = comparison.sim.stick(comparison.fields, work)
        else:
            about = gain > _MUCH and _SOLVED <= k < _SOLVED + _ABOUT and len(effect.free) > 1
            new = comparison.sim.bend(comparison.fields, fit.effects, fit.nuisance, chosen, about)
        if not new:
            break
        fit = fit_effects(comparison, [*current.effects, (effect, theta)], chosen, fit)
    return fit


def _repeatable(comparison, fit, effect, theta, chosen, nats=0.0):
    """Whether a set-up's offset is within what its trials' scatter makes of the mean: the scatter that is
    left beside it, since an offset along headings that differ is scatter itself where nothing takes it up.
    Where trajectories left out bear it out by many `nats`, the scatter that is stated: of what is left some
    is what else is hidden."""
    much = nats > THRESHOLDS["much"]
    left = comparison.stated if much else comparison.scatter(fit.effects, fit.nuisance, chosen)
    limit = left / np.sqrt(len(chosen)) * 2
    return all(abs(theta[n]) * (_LEVER if effect.params[n].unit == "rad" else 1) < limit for n in effect.free)


def _hopeless(gain, others, effect, beside) -> bool:
    """Whether a gain (chosen,) on the very trajectories that were fitted, which flatters, is too little to be
    accepted, or so far behind one of the Candidates that it neither wins nor ties nor lowers its lead."""
    if gain.mean() <= THRESHOLDS["further" if beside else "gain"]:
        return True
    return any(
        not c.refused
        and _ahead(c.gain - gain, _FAR)
        and not _tied(c.gain, gain, effect.id in c.effect.equivalents)
        for c in others
    )


def left_out(comparison: "Comparison", whole: Fit, chosen: np.ndarray, seed: int) -> np.ndarray:
    """(trajectories,) evidence of every chosen one with parameters fitted on the other folds, from where the
    fit to all of them ended; nan for others. Where there are few, each is left out alone: what but two of
    them show could not be fitted with both left out."""
    out, folds = np.full(len(comparison.trajectories), np.nan), min(len(chosen), _FOLDS)
    fold = np.random.default_rng(seed + 1).permutation(len(chosen)) % folds
    for f in range(folds):
        fit = fit_effects(comparison, whole.effects, chosen[fold != f], whole, near=True)
        out[chosen[fold == f]] = fit.evidence(comparison)[chosen[fold == f]]
    return out


def _refused(comparison, one, chosen, present, more) -> list:
    """Why a candidate is not accepted beside those present; more: whether they leave more than noise."""
    theta = next(th for e, th in one.fit.effects if e.id == one.effect.id)
    params = [(theta[n], one.effect.params[n]) for n in one.effect.free]
    numbers = {"gain": one.nats, "share": one.share, "energy": one.energy}
    out = [k for k, v in numbers.items() if v <= THRESHOLDS[k]]
    out += ["p"] if one.p >= _asked_p(one.effect, one.nats) else []
    if all(min(abs(v - p.low), abs(v - p.high)) < 1e-3 * p.scale for v, p in params):
        out.append("bound")
    # What is left of an effect whose true law is a little different looks like those that it is confused
    # with.
    alike = any(one.effect.id in e.confusable or e.id in one.effect.confusable for e in present)
    equivalents = any(one.effect.id in e.equivalents or e.id in one.effect.equivalents for e in present)
    if present and one.nats <= THRESHOLDS["further"] * (2 if alike or equivalents else 1):
        out.append("further")
    small = alike and (one.energy <= THRESHOLDS["form"] or not more)
    # Where all lies within noise already, what adds little is the remainder of a law of another form.
    # So it is with a third one, and with what takes up something of nearly anything, though more is left:
    # laws of another form leave a few hundredths of what they explain.
    apt = one.effect.flexible or len(present) > 1
    little = present and (apt or not more) and one.energy <= THRESHOLDS["little"]
    if small or little or equivalents and one.energy <= 1 - THRESHOLDS["equivalent"]:
        out.append("form")
    if one.effect.rejection_reason(theta):
        out.append(one.effect.rejection_reason(theta))
    if one.effect.sound and _size(one.fit, one.effect) <= one.effect.sound:
        out.append("places")
    if one.effect.flexible and one.nats <= THRESHOLDS["vague"]:
        out.append("vague")
    if one.effect.undoes(theta, one.fit.nuisance.log_modulus):
        out.append("undone")
    if one.effect.pose_offset and _repeatable(comparison, one.fit, one.effect, theta, chosen, one.nats):
        out.append("repeatability")
    return out


def _size(fit, effect):
    """Weighted root mean square of an effect's parameters, without what their errors make of it."""
    at = [k for k, (of, name) in enumerate(fit.names) if of == effect.id and name in effect.free]
    theta = next(th for e, th in fit.effects if e.id == effect.id)
    value = np.array([theta[fit.names[k][1]] for k in at])
    error = np.diag(fit.covariance)[at]
    weight = 1 / (error + effect.sound**2)
    return float(np.sqrt(max((weight * (value**2 - error)).sum() / weight.sum(), 0.0)))


def chance(gain: np.ndarray) -> float:
    """p of gains of evidence (chosen,): of few trajectories one that loses is no veto."""
    return min(sign_flip(gain), signed_root_t(gain))


def _asked_p(effect, nats):
    """p below which an effect with so many nats per trajectory is accepted; what takes up something of nearly
    anything does not get more of it for having much."""
    much = nats > THRESHOLDS["much"] and not effect.flexible
    return THRESHOLDS["much_p" if much else "p"]


def _promising(one) -> bool:
    """Whether an effect may be built upon: `_needed` has the last word, when others no longer hide it."""
    return not one.refused or (one.refused == ["p"] and one.p < THRESHOLDS["promising"])


def _needed(comparison, current, found, chosen, seed):
    """Without every effect whose removal costs nothing significant on trajectories left out."""
    for item in sorted(found, key=lambda c: -c.p) if len(found) > 1 or found[0].refused else ():
        held = left_out(comparison, current, chosen, seed)[chosen]
        rest = [(e, th) for e, th in current.effects if e.id != item.effect.id]
        reduced = fit_effects(comparison, rest, chosen, current)
        loss = held - left_out(comparison, reduced, chosen, seed)[chosen]
        item.p = chance(loss)
        if item.p >= _asked_p(item.effect, loss.mean()) or loss.mean() < THRESHOLDS["gain"]:
            current, found = reduced, [f for f in found if f is not item]
    return current, found
