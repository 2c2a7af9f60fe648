"""How much is left above noise, and whether that is anything: by the trajectories that a fit explains."""

import typing

import numpy as np

from .thresholds import THRESHOLDS

if typing.TYPE_CHECKING:
    from .fitting import Fit
    from .whitening import Comparison

__all__ = ["astray", "excess", "levels", "steady", "wrong"]

_ASTRAY = 0.25  # of the trajectories, that may be off whatever is named
# Mean square of one alone beyond what another balance at an edge makes of it: at most 5.2 in 41 contacts of
# sensors with nothing hidden, 28 where one of eleven presses was deep enough for rubber that stiffens.
_FAR = 10.0


def steady(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> np.ndarray:
    """Those three quarters of the trajectories (chosen,) that a fit explains best: where the base model finds
    another balance than the skin (an edge, a flat tool) it is off by as much with any effect."""
    order = np.argsort(fit.mean_square(comparison)[chosen], kind="stable")
    return chosen[np.sort(order[: len(chosen) - round(_ASTRAY * len(chosen))])]


def levels(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> dict:
    """level: mean square of a trajectory, peak: of the worst channel, both geometric means over
    trajectories."""
    residuals = fit.residuals(comparison)
    square = np.array([(residuals[i] ** 2).mean(0) for i in chosen])
    return {
        "level": float(np.exp(np.log(np.maximum(fit.mean_square(comparison)[chosen], 0.05)).mean())),
        "peak": float(np.exp(np.log(np.maximum(square, 0.05)).mean(0).max())),
    }


def astray(fitted: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """Indices of trajectories that are off, of mean squares of those that were fitted and then of those kept
    aside: where these are more than `steady` leaves out, or more than half of those kept aside; else those
    that are very far off."""
    square = np.concatenate([fitted, aside])
    off = square > THRESHOLDS["peak"]
    many = off.mean() > _ASTRAY or off[len(fitted) :].mean() > 0.5
    return np.flatnonzero(off if many else square > _FAR)


def wrong(left: dict) -> bool:
    """Whether what is `left`, as `levels` has it, is more than noise, resolution and scatter of poses."""
    return left["level"] > THRESHOLDS["significant"] or left["peak"] > THRESHOLDS["peak"]


def excess(square: np.ndarray) -> float:
    """Mean log of mean squares (trajectories,) above that of noise."""
    return float(np.mean(np.log(np.maximum(square, 1.0))))
