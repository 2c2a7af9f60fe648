"""Electrodes that rest elsewhere than the others say, which comparisons about the rest leave out."""

import typing

import numpy as np

from ....effects.electrodes import Offset

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = ["offsets", "standing"]

_FAR = 8.0  # robust standard deviations of the other electrodes, which differ from sensor to sensor
_LEAST = 12.0  # [counts]
_OF_MEDIAN = 1.4826 * 1.2533  # standard error of a normal median by the median of absolute deviations
_MOST = 4  # electrodes: where more stand off, it is the base model that is another


def standing(other: np.ndarray) -> tuple[np.ndarray, float]:
    """Of rests (19,) about those of the model, and about their median [counts]: which stand off, none where
    many do; and by how much at least."""
    limit = max(_FAR * 1.4826 * np.median(np.abs(other)), _LEAST)
    away = np.flatnonzero(np.abs(other) > limit)
    return away if len(away) <= _MOST else away[:0], limit


def offsets(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> tuple[Offset, dict, dict] | None:
    """The effect, its theta and {electrode: (low, high)} of 95 % by trajectory, or None.

    Rests are set beside those of the model with the effects of `fit`, and the difference of one electrode
    beside those of the others: a sensor whose rests are simply other ones has large differences everywhere,
    and none stands out."""
    runs = comparison.sim.run(
        comparison.trajectories,
        comparison.fields,
        False,
        [*comparison.sim.effects, *fit.effects],
        nuisance=fit.nuisance,
    )
    off = np.array([comparison.trajectories[i].electrodes[0] - runs[i].counts[0] for i in chosen])
    off = off + comparison.rest_apart
    # Of one that began within the session some trajectories know nothing.
    middle = np.median(off, axis=0)
    error = _OF_MEDIAN * np.median(np.abs(off - middle), axis=0) / np.sqrt(len(chosen))
    other = middle - np.median(middle)
    limit = standing(other)[1]
    other[[k for effect, theta in fit.effects for k in effect.unread(theta)]] = 0.0
    away = np.flatnonzero(np.abs(other) > limit)
    # where the trajectories do not agree it is no offset
    if not 0 < len(away) <= _MOST or (np.abs(other[away]) < 5 * error[away]).any():
        return None
    theta = dict(Offset().default()) | {f"e{k + 1}": float(other[k]) for k in away}
    sure = {f"e{k + 1}": (float(other[k] - 1.96 * error[k]), float(other[k] + 1.96 * error[k])) for k in away}
    return Offset(), theta, sure
