"""Finds the trajectories that disagree with the model."""

import numpy as np

__all__ = ["astray", "few_off"]

_ASTRAY = 0.25  # of the trajectories, that may be off whatever is named
# Mean square of one alone beyond what another balance at an edge makes of it: at most 5.2 in 41 contacts of
# sensors with nothing hidden, 28 where one of eleven presses was deep enough for rubber that stiffens.
_FAR = 10.0
_OFF = 2.5  # mean square from which on a trajectory is off


def astray(fitted: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """Indices of trajectories that disagree, by mean squares of the fitted ones and then of the held-out
    ones: where these are more than `steady` leaves out, or more than half of the held-out ones; else those
    with very large errors."""
    square = np.concatenate([fitted, aside])
    off = square > _OFF
    many = off.mean() > _ASTRAY or off[len(fitted) :].mean() > 0.5
    return np.flatnonzero(off if many else square > _FAR)


def few_off(square: np.ndarray) -> bool:
    """Whether no more than half of the trajectories with these mean squares are off."""
    return bool(np.mean(square > _OFF) <= 0.5)
