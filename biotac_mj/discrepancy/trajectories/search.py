"""Searches for the effects that explain the data together, one after another: each is the one under which the
data are likeliest, if it is far likelier than none. The prior: every effect of the catalogue is there or not,
whatever others are, one of them on average; and a cause has one law."""

import dataclasses
import typing

import numpy as np
import tqdm

from ..evidence import asked, by_chance, not_distinguished
from .fitting import Fit, fit_effects, sizes
from .settings import SETTINGS
from .signatures import Signatures

if typing.TYPE_CHECKING:
    from ...effects.effect import Effect
    from .whitening import Comparison

_SOLVED, _FURTHER = 2, 4  # times that the skin is solved for an effect that moves the object; and again
_WORTH = 5.0  # [nats] of evidence that is worth it
_SETTLED = 1.0  # [nats] that a solution changes where a fit has found its end
_KINS, _SOME = 2, 0.15  # effects that are solved further, and their fraction of the best one's evidence
_ELECTRODES = 5  # at most; where more have it, all may
_LEVER = 10e-3  # [m] of a turn: what is pressed lies 5 to 20 mm from the sensor's origin


@dataclasses.dataclass
class Candidate:
    """An effect refitted beside others.

    Attributes:
      effect, fit. gain: evidence over the fit without it [nats]; p: the largest probability with which any
      effect has as much of data without it. rejections: reasons why it is not taken. ties: ids that are as
      likely.
    """

    effect: "Effect"
    fit: Fit
    gain: float
    p: float
    rejections: list[str]
    ties: list[str] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Search:
    """Result of a search.

    Attributes:
      fit: Fit with all effects. found: Candidates in their order. rounds: lists of Candidate, best first.
      fits: of every explanation that was tried, by the ids of its effects. unseen: [(evidence beside what was
      found, by straight lines, effect, what one of a realistic size would make [nats])] of the last round.
      hidden: effects that the data cannot show.
    """

    fit: Fit
    found: list[Candidate]
    rounds: list[list[Candidate]]
    fits: dict[frozenset, Fit]
    unseen: list[tuple] = dataclasses.field(default_factory=list)
    hidden: list = dataclasses.field(default_factory=list)


def found(
    comparison: "Comparison",
    null: Fit,
    usable: "list[Effect]",
    chosen: np.ndarray,
    bar: tqdm.tqdm | None = None,
) -> Search:
    """The effects that the chosen trajectories are likeliest with.

    Args:
      null: Fit without effects. usable: effects to choose from. bar: of the fits.
    """
    out = Search(null, [], [], {frozenset(): null})
    bar = tqdm.tqdm(total=0, disable=True) if bar is None else bar
    while len(out.found) < SETTINGS.most:
        step = _round(comparison, out, usable, chosen, bar)
        out.rounds.append(step)
        able = [c for c in step if not c.rejections]
        little = [c for c in step if c.rejections == ["evidence"]]  # others contradict their names
        out.fits |= {frozenset(e.id for e, _ in c.fit.effects): c.fit for c in little}
        if not able:
            break
        best = able[0]
        best.fit, best.gain = _other_shapes(comparison, best, out.fit, chosen)
        out.fits |= {frozenset(e.id for e, _ in c.fit.effects): c.fit for c in able}
        best.ties = [
            c.effect.id for c in able[1:] if not_distinguished(best.gain, c.gain, best.fit.law_errors[-1])
        ]
        out.found.append(best)
        out.fit = best.fit
    return out


def _other_shapes(comparison, one, current, chosen):
    """Fit of a Candidate at the likeliest of its shapes, and its gain: a fit ends at the shape nearest to
    its start."""
    effect, theta = one.fit.effects[-1]
    best = one.fit
    for shape in effect.grid if len(effect.grid) > 1 else ():
        begin = [*current.effects, (effect, theta | shape)]
        fit = fit_effects(comparison, begin, chosen, current)
        if fit.score > best.score and not effect.rejection_reason(fit.effects[-1][1]):
            best = fit
    gain = one.gain + float(best.score - one.fit.score)
    return _with_own_evidence(best, current, gain), gain


def _with_own_evidence(fit, current, gain) -> Fit:
    """The Fit with the evidence that is its own: an effect that acts where others do also explains errors of
    their laws, so its gain counts less by the overlap."""
    return dataclasses.replace(fit, own_evidence=current.own_evidence + gain / (1 + fit.overlap))


def _round(comparison, search, usable, chosen, bar):
    """Candidates beside what was found, best first."""
    current = search.fit
    bar.set_description(" + ".join(["diagnose", *(e.name for e, _ in current.effects)]))
    known = [e for e, _ in current.effects]
    same = {one.id for one in known}.union(*(one.equivalents for one in known))
    effects = [e for e in usable if e.id not in same and not same & {*e.equivalents}]
    ranked = screened(comparison, current, effects, chosen)
    search.unseen = [(gain, effect, visible) for gain, effect, _, visible in ranked]
    short = [r for r in ranked[: SETTINGS.refit] if r[0] > 0]
    # differences do not reach far where poses are moved
    short += [r for r in ranked if r not in short and r[1].pose_offset and not known]
    partners = {name for _, effect, *_ in short for name in effect.refit_with}
    short += [r for r in ranked if r not in short and r[1].id in partners]
    bar.total += len(short)
    out = []
    for expected, effect, start, _ in short:
        fit = _fitted(comparison, effect, start, expected, current, chosen)
        plain = next(e for e in effects if e.id == effect.id)
        if effect is not plain and effect.rejection_reason(fit.effects[-1][1]):
            # its rare parameters, or so few electrodes, contradict its name
            effect, start = plain, {name: start.get(name, v) for name, v in plain.default().items()}
            fit = _fitted(comparison, effect, start, expected, current, chosen)
        fit = _solved(comparison, fit, effect, current, chosen)
        out.append(_candidate(comparison, effect, fit, current, usable))
        bar.update()
    for k in _moving(out):
        fit = _solved(comparison, out[k].fit, out[k].effect, current, chosen, _FURTHER, True)
        out[k] = _candidate(comparison, out[k].effect, fit, current, usable)
    return sorted(out, key=lambda c: -c.gain)


def _fitted(comparison, effect, start, expected, current, chosen):
    """Fit of an effect in addition to others; expected: evidence of the linear model, whose optimum is
    `start`.

    It starts from no effect and its current poses and nuisance, which have absorbed part of the effect. If
    that ends below the expected evidence, it starts again from `start` and the recorded poses."""
    none = {n: v if effect.params[n].shape else effect.params[n].start for n, v in start.items()}
    fit = fit_effects(comparison, [*current.effects, (effect, none)], chosen, current)
    if fit.score - current.score >= expected:
        return fit
    begin = dataclasses.replace(current, offsets=0 * current.offsets)
    other = fit_effects(comparison, [*current.effects, (effect, start)], chosen, begin)
    return max(fit, other, key=lambda one: one.score)


def _candidate(comparison, effect, fit, current, usable):
    """Candidate of a fit with one effect more than `current`."""
    every = next(e for e in usable if e.id == effect.id)
    any_of = every.free if every.per_channel else every.rare
    few = effect.per_channel and len(effect.free) < len(any_of)
    # any electrode, or any pair, may have it
    forms = len(effect.free) * np.log(len(any_of)) if few else 0.0
    gain, theta = float(fit.score - current.score - forms), fit.effects[-1][1]
    p = by_chance(gain, len(usable))
    rejections = ["evidence"] if gain < asked(len(usable)) else []
    rejections += [doubt] if (doubt := effect.rejection_reason(theta)) else []
    rejections += ["undone"] if effect.undoes(theta, fit.nuisance.log_modulus) else []
    rejections += ["little"] if _little(comparison, effect, theta) else []
    return Candidate(effect, _with_own_evidence(fit, current, gain), gain, p, rejections)


def _little(comparison, effect, theta) -> bool:
    """Whether an effect is no larger than a sound sensor or the set-up's repeatability makes it."""
    size = np.array([theta[name] for name in effect.free])
    if effect.sound:
        return bool(np.sqrt(np.mean(size**2)) <= effect.sound)
    if not effect.pose_offset:
        return False
    lever = np.array([_LEVER if effect.params[n].unit == "rad" else 1.0 for n in effect.free])
    limit = 2 * comparison.repeatability / np.sqrt(len(comparison.trajectories))
    return bool((np.abs(size) * lever < limit).all())


def _solved(comparison, fit, effect, current, chosen, times=_SOLVED, about=False):
    """The fit where the skin was solved, so many times, with what moves the object, since differences do not
    reach far. about: until it has found its end, first with each of its parameters changed as well."""
    if not effect.before_skin and effect.joining(fit.effects[-1][1]) is None:
        return fit
    for k in range(times):
        if fit.score - current.score < _WORTH:
            break
        work = effect.joining(fit.effects[-1][1])
        if work is not None:
            new = comparison.sim.stick(comparison.fields, work)
        else:
            slopes = about and not k and len(effect.free) > 1  # each parameter is one solution more
            new = comparison.sim.bend(comparison.fields, fit.effects, fit.nuisance, chosen, slopes)
        if not new:
            break
        before = fit.score
        fit = fit_effects(comparison, fit.effects, chosen, fit)
        if about and k and abs(fit.score - before) < _SETTLED:
            break
    return fit


def _moving(out):
    """Indices of the likeliest Candidates that move the object: where their fits end they may lead."""
    least = max(_WORTH, _SOME * max((c.gain for c in out), default=0.0))
    some = [k for k, c in enumerate(out) if c.effect.before_skin and c.gain > least]
    return sorted(some, key=lambda k: -out[k].gain)[:_KINS]


def screened(
    comparison: "Comparison", current: Fit, effects: "list[Effect]", chosen: np.ndarray
) -> list[tuple[float, "Effect", dict, float]]:
    """By straight lines about a fit: evidence of each effect beside it [nats], the effect, parameters where a
    fit may start, and the evidence that one of a realistic size would make; best first."""
    signatures = Signatures(comparison, current, chosen)
    y = signatures.own(current.y.reshape(1, -1) / signatures.sd)[0]
    # each as it is mostly, and with its rare parameters
    every, best = ([e, e.given(list(e.rare))] if e.rare else [e] for e in effects), {}
    for effect, shape in [(e, s) for one in every for e in one for s in e.grid]:
        prior = np.array([[SETTINGS.wide * effect.params[name].scale / size] for name, size in sizes(effect)])
        columns = signatures.columns(effect, shape) * prior
        precision = np.eye(len(columns)) + columns @ signatures.own(columns).T
        visible = 0.5 * float(((np.diag(precision) - 1) / prior[:, 0] ** 2).max())
        pull = columns @ y
        some = _few(precision, pull) if effect.per_channel else []
        if effect.per_channel and not some and len(columns) > effect.design.nelectrode:
            continue  # not all pairs of electrodes
        if some:
            precision, pull = precision[np.ix_(some, some)], pull[some]
            effect = effect.only([effect.free[k] for k in some])
            shape = effect.grid[0] | shape
        gain, weights = _gained(precision, pull), np.linalg.solve(precision, pull)
        gain -= len(some) * np.log(len(columns))
        if effect.id not in best or gain > best[effect.id][0]:
            best[effect.id] = gain, effect, _begin(effect, shape, weights), visible
    return sorted(best.values(), key=lambda one: -one[0])


def _gained(precision, pull) -> float:
    """Evidence of a linear model [nats], by the precision of its coefficients of unit variance and what pulls
    at them."""
    return 0.5 * float(pull @ np.linalg.solve(precision, pull) - np.linalg.slogdet(precision)[1])


def _few(precision, pull) -> list[int]:
    """Electrodes that are likelier to have an effect than all of them, any of them before the data; none
    where many have it. One after another that which adds most evidence."""
    some, best = [], 0.0
    while len(some) <= _ELECTRODES:
        more = [
            _gained(precision[np.ix_(some + [k], some + [k])], pull[some + [k]]) if k not in some else -np.inf
            for k in range(len(pull))
        ]
        k, gain = int(np.argmax(more)), max(more) - (len(some) + 1) * np.log(len(pull))
        if gain < best:
            return sorted(some) if best > _gained(precision, pull) else []
        some, best = [*some, k], gain
    return []


def _begin(effect, shape, weights):
    """Parameters where a fit may start, of weights (free,) in standard deviations of the prior."""
    start = {**effect.default(), **shape}
    for (name, _), weight in zip(sizes(effect), weights):
        p = effect.params[name]
        value = start[name] + np.clip(weight, -2, 2) * SETTINGS.wide * p.scale
        start[name] = float(np.clip(value, p.low + 0.01 * p.scale, p.high - 0.01 * p.scale))
    return start
