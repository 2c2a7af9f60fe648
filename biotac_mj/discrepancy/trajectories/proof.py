"""The proof: models as a sensor file would hold them, the skin solved again, on trajectories that took no
part in the search, in any choice, or in any fit."""

import dataclasses
import typing

import numpy as np

from ..evidence import ODDS, further_off
from . import likelihood
from .base.nuisance import Nuisance
from .fitting import changes
from .settings import SETTINGS

if typing.TYPE_CHECKING:
    from .fitting import Fit
    from .whitening import Comparison


@dataclasses.dataclass(frozen=True)
class Proof:
    """Test of a fit on held-out trajectories.

    Attributes:
      fit: Fit that they do not contradict: with effects, with the base model's constants alone, or the base
        model as it was given.
      before, after: without effects and with this fit, the mean square of each trajectory and the RMS of
        groups and channels.
      residuals: (before, after) for each trajectory (n, width), without its pose's most probable error.
      closed: fraction of the RMS residual that the effects remove from the readings they act on (without
        effects, that a fitted modulus removes); nan if there is neither.
    """

    fit: "Fit"
    before: dict
    after: dict
    residuals: tuple
    closed: float
    within: tuple[float, float]


def borne_out(comparison: "Comparison", smaller: "Fit", larger: "Fit", aside: np.ndarray) -> bool:
    """Whether held-out trajectories are likelier by `ODDS` with one Fit than with another that has fewer
    effects, whether the sensor that is written with it is nearer to them, and whether its further effects
    close as much of the gap as a name needs. The skin is solved again, with the fitted parameters. Both use
    the one likelihood: errors of an effect's law do not contradict it."""
    first, last = (_density(comparison, fit, aside) for fit in (smaller, larger))
    if last - first <= np.log(ODDS):
        return False
    _, begin = _begun(comparison, smaller, aside)
    nearer = _nearer(comparison, begin, _measured(comparison, larger, aside), aside)
    return nearer and _fractions_closed(comparison, smaller, larger, aside)[1] >= SETTINGS.explained


def _density(comparison, fit, aside):
    """Logarithm of the density of held-out trajectories, by as much as the model misses of them, where the
    others tell what the laws of its effects lack."""
    every = np.arange(len(comparison.trajectories))
    raw = comparison.raw(fit.effects, fit.nuisance, list(aside), fit.offsets)
    known = _evidence(comparison, fit, raw, np.setdiff1d(every, aside))
    return _evidence(comparison, fit, raw, every, aside) - known


def _evidence(comparison, fit, raw, some, independent=()):
    """Logarithm of the likelihood of some trajectories (indices), by residuals `raw` where a Fit has them."""
    own = likelihood.of(comparison, some, independent)
    laws = own.laws(changes(comparison, own, fit.effects, fit.nuisance), fit.law_errors)
    poses = own.poses(fit.offsets)
    off = fit.offsets[some].ravel() / comparison.repeatability
    y = own.turned(own.stacked(raw)) + np.tensordot(off, poses, 1)
    errors = np.concatenate([poses, laws])
    amplitude = own.amplitudes(y, errors, fit.amplitude, fit.size)
    log = own.evidence(y, errors, own.variance(amplitude, fit.size))[0]
    return log + own.prior(amplitude, fit.law_errors)


def proved(comparison: "Comparison", null: "Fit", current: "Fit", aside: np.ndarray) -> Proof:
    """Sets the model with constants alone beside the one that was given, and the amended one beside the
    better of these; what makes any group of channels worse is not taken.

    Args:
      null, current: Fits without what was found and with it. aside: indices of the trajectories.
    """
    start, begin = _begun(comparison, null, aside)
    before, first, _ = begin
    if current is null:
        return Proof(start, before, before, (first, first), np.nan, (np.nan, np.nan))
    after, last, _ = end = _measured(comparison, current, aside)
    if not _nearer(comparison, begin, end, aside):
        return Proof(start, before, before, (first, first), 0.0, (0.0, 0.0))
    if current.effects:
        least, most = _fractions_closed(comparison, null, current, aside)
    else:
        least, most = _closed(comparison, begin, end, SETTINGS.law, aside)
    # what a law lacks is in part taken for errors of poses and of the base
    law = SETTINGS.law if any(not effect.wiring for effect, _ in current.effects) else 0.0
    narrow = most - least <= 2 * SETTINGS.law
    closed = 1 - float(np.hypot(1 - most, law)) if narrow else np.nan
    within = max(least - law, 0.0), min(most + law, 1.0)
    return Proof(current, before, after, (first, last), closed, within)


def _fractions_closed(comparison, smaller, larger, aside):
    """Least and most share of the gap that the effects which one Fit has beyond another close by themselves,
    with all that the base model is found to be off by on both sides."""
    known = {effect.id for effect, _ in smaller.effects}
    new = np.array([effect.id not in known for effect, _ in larger.effects])
    bare = dataclasses.replace(
        larger, effects=[one for one, further in zip(larger.effects, new) if not further], names=[]
    )
    law = float(np.sqrt(np.mean(larger.law_errors[new] ** 2)))
    return _closed(comparison, *(_compared(comparison, fit, aside) for fit in (bare, larger)), law, aside)


def _begun(comparison, fit, aside):
    """The Fit, or the model as it was given where the Fit is worse, and its result of `_measured`."""
    given = dataclasses.replace(fit, effects=[], names=[], nuisance=Nuisance())
    ends = [_measured(comparison, one, aside) for one in (given, fit)]
    return (given, ends[0]) if _worse(comparison, *ends, aside) else (fit, ends[1])


def _nearer(comparison, before, after, aside) -> bool:
    """Whether a model is nearer to held-out trajectories, and in no group of channels further off."""
    return 0 < before[-1] > after[-1] and not _worse(comparison, before, after, aside)


def _measured(comparison, fit, rows):
    """Numbers of a model as it is written, its residuals, see `Proof`, and its result of `_compared`."""
    written = dataclasses.replace(fit, nuisance=fit.nuisance.written)
    square, residual, beyond = _compared(comparison, written, rows)
    out = {"mean_square": square}
    for name, part in comparison.groups.items():
        out[name] = float(np.sqrt(np.mean([(r[:, part] ** 2).mean() for r in residual])))
    out["channels"] = np.sqrt(np.mean([(r**2).mean(0) for r in residual], axis=0)).tolist()
    return out, residual, beyond


def _compared(comparison, fit, rows):
    """Mean squares of trajectories `rows`, the skin solved again; their residuals without errors of poses;
    and the error of these, as a sum over rows of mean squares beyond noise.

    What all poses are off by is as much a disagreement as what is left of the channels: the most probable
    error of a pose counts in units of its repeatability, and each of its three numbers as much as a row."""
    about, raw = comparison.posed(fit.raw(comparison, exact=rows), fit.effects, fit.nuisance)
    residual = [about.unposed(i, raw[i]) for i in rows]
    channels = sum((((r / comparison.noises) ** 2).mean(1) - 1).sum() for r in residual)
    poses = sum((about.astray(i, raw[i]) ** 2 - 1).sum() for i in rows)
    square = [float(np.sum(about.vector(i, raw[i]) ** 2)) for i in rows]
    return square, residual, float(channels + poses)


def _worse(comparison, before, after, aside) -> bool:
    """Whether the error of a group of channels has grown, by more than chance within the comparison's
    resolution."""
    parts, rows = comparison.groups.values(), [len(comparison.trajectories[i].time) for i in aside]
    first, last = (
        np.array(
            [
                [((r / comparison.sigmas[i])[:, part] ** 2).mean(1).sum() for part in parts]
                for i, r in zip(aside, residuals)
            ]
        )
        for _, residuals, _ in (before, after)
    )
    independent = np.array([[_independent(comparison, i)[part].sum() for part in parts] for i in aside])
    return further_off(first, last, np.sqrt((2 * np.square(rows)[:, None] / independent).sum(0)))


def _independent(comparison, i):
    """As how many independent rows of a trajectory each channel counts (width,): what the model misses is the
    same in all rows, noise is another in each."""
    rows = len(comparison.trajectories[i].time)
    alike = 1 - (comparison.noises / comparison.sigmas[i]) ** 2
    return rows / (1 + (rows - 1) * alike**2)


def _closed(comparison, before, after, law, aside):
    """Least and most fraction of the root mean square residual in the readings that effects act on which they
    remove; law: relative error of their laws.

    The remainder beyond noise is expected to be this error and that of the base model, at most the model's
    resolution; least: it is this error alone."""
    (_, first, begun), (_, last, left) = before, after
    change = sum((((a - b) / comparison.noises) ** 2).mean(1).sum() for a, b in zip(first, last))
    base = sum(
        len(r) * ((comparison.sigmas[i] / comparison.noises) ** 2 - 1).mean() for i, r in zip(aside, last)
    )
    remains, out = max(left, 0.0), []
    for of_base in (0.0, min(base, remains * base / max(law**2 * change + base, 1e-12))):
        lacking, hidden = remains - of_base, begun - of_base
        out.append(float(1 - np.sqrt(lacking / hidden)) if hidden > lacking else 0.0)
    return tuple(out)
