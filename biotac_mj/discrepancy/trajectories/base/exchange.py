"""Which electrodes may be read in each other's place: the permutation whose prediction fits best.

Found before anything is fitted, since no small change leads from one wiring to another."""

import typing

import numpy as np
from scipy.optimize import linear_sum_assignment

from ....effects.electrodes import Exchange
from ...evidence import signed_root_t

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = ["exchanged"]

_NATS = 3.0  # per trajectory that each electrode has to gain in another's place
_CHANCE = 0.01


def exchanged(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> Exchange | None:
    """Electrodes that another one's prediction fits better, by their changes in touch, or None.

    What stands still is no evidence: rests are compared with nothing here."""
    predicted = [m - r for m, r in zip(comparison.measured, fit.raw(comparison))]
    # (chosen, 19, 19) evidence of electrode i read as j says
    fits = np.array([_evidence(comparison, i, predicted[i]) for i in chosen])
    _, reads = linear_sum_assignment(-fits.mean(0))
    moved = []
    for i in np.flatnonzero(reads != np.arange(19)):
        gain = fits[:, i, reads[i]] - fits[:, i, i]
        if gain.mean() > _NATS and signed_root_t(gain) < _CHANCE:
            moved.append((int(i), int(reads[i])))
    # who shows another's counts is shown by somebody: what is left over is no exchange
    while {i for i, _ in moved} != {j for _, j in moved}:
        shown, shows = {j for _, j in moved}, {i for i, _ in moved}
        moved = [(i, j) for i, j in moved if i in shown and j in shows]
    return Exchange(moved) if moved else None


def _evidence(comparison, i, predicted):
    """(19, 19) -(rows / 2) log of the mean square of measured electrode a about prediction b [nats]."""
    measured = comparison.measured[i][:, :19]
    square = ((measured[:, :, None] - predicted[:, None, :19]) ** 2).mean(0) / comparison.sigma[
        :19, None
    ] ** 2
    return -0.5 * len(measured) * np.log(np.maximum(square, 1.0))
