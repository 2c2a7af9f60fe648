"""The proof: models as a sensor file would hold them, the skin solved again, on trajectories that took no
part in the search, in any choice, or in any fit."""

import dataclasses
import typing

import numpy as np

from .base.nuisance import Nuisance
from .levels import excess
from .thresholds import THRESHOLDS

if typing.TYPE_CHECKING:
    from .fitting import Fit
    from .whitening import Comparison

__all__ = ["Proof", "proved"]


@dataclasses.dataclass(frozen=True)
class Proof:
    """What trajectories kept aside say.

    Attributes:
      fit: Fit that they do not contradict: with effects, with the base model's constants alone, or the base
        model as it was given. before, after: of the model without effects and of that one the mean square of
        each trajectory and RMS of groups and channels. residuals: (before, after), of each trajectory
        (n, width), its pose's most probable error taken out. closed: share of the disagreement's root mean
        square beyond noise that effects take away (a modulus where there is none of them), nan without both.
    """

    fit: "Fit"
    before: dict
    after: dict
    residuals: tuple
    closed: float


def proved(comparison: "Comparison", null: "Fit", current: "Fit", aside: np.ndarray) -> Proof:
    """Sets the model with constants alone beside the one that was given, and the amended one beside the
    better of these; what makes any group of channels worse is not taken.

    Args:
      null, current: Fits without what was found and with it. aside: indices of the trajectories.
    """
    given = dataclasses.replace(null, effects=[], names=[], nuisance=Nuisance())
    ends = {id(fit): _measured(comparison, fit, aside) for fit in (given, null)}
    start = null if not _worse(comparison, ends[id(given)], ends[id(null)], aside) else given
    before, first = ends[id(start)]
    if current is null:
        return Proof(start, before, before, (first, first), float("nan"))
    after, last = end = _measured(comparison, current, aside)
    if _closed(comparison, first, last) <= 0 or _worse(comparison, (before, first), end, aside):
        return Proof(start, before, before, (first, first), 0.0)
    # what effects close by themselves: with all that the base model is found to be off by on both sides
    bare = dataclasses.replace(current, effects=[], names=[])
    sides = (
        [_residuals(comparison, fit, aside)[1] for fit in (bare, current)]
        if current.effects
        else [first, last]
    )
    return Proof(current, before, after, (first, last), _closed(comparison, *sides))


def _measured(comparison, fit, rows):
    """Numbers of a model as it is written, and its residuals, as `Proof` has them."""
    raw, residual = _residuals(comparison, dataclasses.replace(fit, nuisance=fit.nuisance.written), rows)
    out = {"mean_square": [float(np.sum(comparison.vector(i, raw[i]) ** 2)) for i in rows]}
    for name, part in comparison.groups.items():
        out[name] = float(np.sqrt(np.mean([(r[:, part] ** 2).mean() for r in residual])))
    out["channels"] = np.sqrt(np.mean([(r**2).mean(0) for r in residual], axis=0)).tolist()
    return out, residual


def _residuals(comparison, fit, rows):
    """Residuals of all trajectories, the skin solved again in `rows`, and those of `rows` without errors of
    their poses."""
    raw = fit.raw(comparison, exact=rows)
    return raw, [comparison.unposed(i, raw[i]) for i in rows]


def _worse(comparison, before, after, aside) -> bool:
    """Whether trajectories are further off than before, all channels together or a group of them, by what
    counts as evidence."""
    rows = np.mean([len(comparison.trajectories[i].time) for i in aside])
    loss = [excess(after[0]["mean_square"]) - excess(before[0]["mean_square"])]
    squares = [
        np.array([((r / comparison.sigmas[i]) ** 2).mean(0) for i, r in zip(aside, residuals)])
        for _, residuals in (before, after)
    ]
    loss += [
        excess(squares[1][:, part].mean(1)) - excess(squares[0][:, part].mean(1))
        for part in comparison.groups.values()
    ]
    return bool(0.5 * rows * max(loss) > THRESHOLDS["gain"])


def _closed(comparison, first, last):
    """Share of the root mean square beyond noise that is taken away, in units of the noise."""
    before, after = (
        sum(((r / comparison.noises) ** 2 - 1).sum() for r in residuals) for residuals in (first, last)
    )
    return float(1 - np.sqrt(max(after, 0.0) / before)) if before > 0 else 0.0
