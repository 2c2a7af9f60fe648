"""Which effects together: round after round the best one is refitted and tested; ties are carried on as
further beams; at the end each has to be needed."""

import dataclasses
import typing

import numpy as np
import tqdm

from ..evidence import benjamini_hochberg, sign_flip
from .fitting import Fit, fit_effects
from .screening import screen
from .thresholds import THRESHOLDS

if typing.TYPE_CHECKING:
    from .whitening import Comparison

__all__ = ["Candidate", "compose"]

_SETUP = {"misalign", "depth0"}  # on every short list: what most often is wrong, and cheap to look at
_BEAMS = 3
_FAR = 10.0  # standard errors, beyond which a lead counts no more (`thresholds.terms`)


@dataclasses.dataclass
class Candidate:
    """An effect refitted on top of others.

    Attributes:
      effect, fit. gain: (chosen,) evidence on trajectories left out over the model without it; nats: its
        mean; p, q: of sign flips.
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
        return {"id": self.effect.id, **{k: getattr(self, k) for k in keys}, "theta": theta}


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
    accepted = [c for c in first if not c.refused]
    if not accepted:
        return null, [], [first]
    _rank(accepted[0], first)
    ends = {}
    tied = [accepted[0], *[c for c in accepted[1:] if c.effect.id in accepted[0].ties]]
    for start in tied[:_BEAMS]:
        fit, found, rounds = start.fit, [start], [first]
        while len(found) < THRESHOLDS["most"]:
            step = _round(comparison, fit, null, usable, chosen, seed, bar)
            rounds.append(step)
            able = [c for c in step if not c.refused]
            if not able:
                break
            best = able[_simplest([(c.held, len(c.effect.params)) for c in able])]
            _rank(best, step)
            found, fit = [*found, best], best.fit
        held = found[-1].held
        fit, found = _needed(comparison, fit, found, chosen)
        ends[start.effect.id] = fit, found, rounds, held - THRESHOLDS["gain"] * len(found)
    size = [sum(len(c.effect.params) for c in e[1]) for e in ends.values()]
    winner = list(ends)[_simplest([(e[3], k) for e, k in zip(ends.values(), size)])]
    fit, found, rounds, score = ends[winner]
    if found and found[0].effect.id == winner:
        _rank(found[0], first)
        # Who tied at first and was carried on has to tie in the end too.
        zero = null.evidence(comparison)[chosen]
        kin = found[0].effect.kin
        found[0].ties = [
            t for t in found[0].ties if t not in ends or _tied(score - zero, ends[t][3] - zero, t in kin)
        ]
        if len(found) > 1:  # and in the winner's place, beside the others
            held = _left_out(comparison, fit, chosen, seed)[chosen]
            others = [c for c in first if c.effect.id in found[0].ties]
            swapped = [_instead(comparison, fit, winner, c, chosen, seed) for c in others]
            found[0].ties = [
                c.effect.id
                for c, other in zip(others, swapped)
                if other is not None and _tied(held - zero, other - zero, c.effect.id in kin)
            ]
    named = {c.effect.id for c in found}
    for c in found:
        c.ties = [t for t in c.ties if t not in named]
    return fit, found, rounds


def _instead(comparison, fit, winner, other, chosen, seed):
    """Evidence (chosen,) left out with another Candidate's effect in the winner's place; None where it is
    there already."""
    if any(e.id == other.effect.id for e, _ in fit.effects):
        return None
    mine = next(item for item in other.fit.effects if item[0].id == other.effect.id)
    effects = [mine if e.id == winner else (e, theta) for e, theta in fit.effects]
    return _left_out(comparison, fit_effects(comparison, effects, chosen, fit), chosen, seed)[chosen]


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


def _tied(gain, other, kin) -> bool:
    """Whether the other's evidence (chosen,) is as good: within the spread over trajectories, or nearer than
    laws are known; less so of kin."""
    alike = THRESHOLDS["kin" if kin else "alike"]
    return not _ahead(gain - other) or other.mean() > alike * gain.mean()


def _rank(best, step):
    """Ties of the best one, and its lead over the runner-up."""
    leads = {c.effect.id: best.gain - c.gain for c in step if c is not best}
    best.ties = [
        c.effect.id
        for c in step
        if c is not best
        and c.nats >= THRESHOLDS["gain"]
        and _tied(best.gain, c.gain, c.effect.id in best.effect.kin)
    ]
    best.lead = min(
        (float(v.mean() / max(v.std(ddof=1) / np.sqrt(len(v)), 1e-9)) for v in leads.values()), default=10.0
    )


def _round(comparison, current, null, effects, chosen, seed, bar):
    """Screen, then refit the short list with cross-validation by trajectory; Candidates, best first."""
    bar.set_description(" + ".join(["diagnose", *(e.name for e, _ in current.effects)]))
    known = {e.id for e, _ in current.effects}
    ranked = screen(comparison, current, [e for e in effects if e.id not in known], chosen)
    rows = float(np.mean([len(comparison.trajectories[i].time) for i in chosen]))
    asked = THRESHOLDS["screened"] * THRESHOLDS["further" if known else "gain"] / (0.5 * rows)
    short = [r for r in ranked[: THRESHOLDS["refit"]] if r[0] > asked or r[1].id in _SETUP]
    short += [r for r in ranked[THRESHOLDS["refit"] :] if r[1].id in _SETUP]
    reference, square, square_null = (
        current.evidence(comparison),
        current.mean_square(comparison)[chosen],
        null.mean_square(comparison)[chosen],
    )
    excess = max(float(np.log(np.maximum(square, 1.0)).mean()), 1e-9)
    out = []
    bar.total += len(short)
    for _, effect, start in short:
        trial = [*current.effects, (effect, start)]
        fit = fit_effects(comparison, trial, chosen, current)
        held = fit.evidence(comparison)[chosen]
        if not _hopeless(held - reference[chosen], out, effect, bool(known)):
            held = _left_out(comparison, fit, chosen, seed)[chosen]
        gain = held - reference[chosen]
        left = fit.mean_square(comparison)[chosen]
        energy = float((square - left).mean() / max((square_null - left).mean(), 1e-9))
        one = Candidate(
            effect,
            fit,
            gain,
            held,
            float(gain.mean()),
            sign_flip(gain),
            float(gain.mean()) / (0.5 * rows * excess),
            energy,
            [],
        )
        one.refused = _refused(comparison, one, chosen, [e for e, _ in current.effects])
        out.append(one)
        bar.update()
    for c, q in zip(out, benjamini_hochberg([c.p for c in out])):
        c.q = float(q)
    return sorted(out, key=lambda c: -c.nats)


def _hopeless(gain, others, effect, beside) -> bool:
    """Whether a gain (chosen,) on the very trajectories that were fitted, which flatters, is too little to be
    accepted, or so far behind one of the Candidates that it neither wins nor ties nor lowers its lead."""
    if gain.mean() <= THRESHOLDS["further" if beside else "gain"]:
        return True
    return any(
        not c.refused and _ahead(c.gain - gain, _FAR) and not _tied(c.gain, gain, effect.id in c.effect.kin)
        for c in others
    )


def _left_out(comparison, whole, chosen, seed, folds=3):
    """Evidence of every chosen trajectory with parameters fitted on the other folds, from where the fit to
    all of them ended."""
    out = np.full(len(comparison.trajectories), np.nan)
    fold = np.random.default_rng(seed + 1).permutation(len(chosen)) % folds
    for f in range(folds):
        fit = fit_effects(comparison, whole.effects, chosen[fold != f], whole, near=True)
        out[chosen[fold == f]] = fit.evidence(comparison)[chosen[fold == f]]
    return out


def _refused(comparison, one, chosen, present) -> list:
    """Why a candidate is not accepted."""
    theta = next(th for e, th in one.fit.effects if e.id == one.effect.id)
    params = [(theta[n], one.effect.params[n]) for n in one.effect.free]
    numbers = {"gain": one.nats, "share": one.share, "energy": one.energy}
    out = [k for k, v in numbers.items() if v <= THRESHOLDS[k]] + (["p"] if one.p >= THRESHOLDS["p"] else [])
    if all(min(abs(v - p.low), abs(v - p.high)) < 1e-3 * p.scale for v, p in params):
        out.append("bound")
    if present and one.nats <= THRESHOLDS["further"]:
        out.append("further")
    # What is left of an effect whose true law is a little different looks like those that it is confused
    # with.
    alike = any(one.effect.id in e.confusable or e.id in one.effect.confusable for e in present)
    if alike and one.energy <= THRESHOLDS["form"]:
        out.append("form")
    if one.effect.doubt(theta):
        out.append(one.effect.doubt(theta))
    if one.effect.id in _SETUP and all(
        abs(v) < comparison.repeatability / np.sqrt(len(chosen)) * 2 for v, _ in params
    ):
        out.append("repeatability")
    return out


def _needed(comparison, current, found, chosen):
    """Without every effect whose removal costs nothing significant."""
    for item in list(found) if len(found) > 1 else ():
        rest = [(e, th) for e, th in current.effects if e.id != item.effect.id]
        reduced = fit_effects(comparison, rest, chosen, current)
        loss = (current.evidence(comparison) - reduced.evidence(comparison))[chosen]
        if sign_flip(loss) > THRESHOLDS["p"] or loss.mean() < THRESHOLDS["gain"]:
            current, found = reduced, [f for f in found if f is not item]
    return current, found
