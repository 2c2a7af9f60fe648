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
_CHANCE = 0.01  # of all electrodes of a ring together


def exchanged(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> Exchange | None:
    """Electrodes that another one's prediction fits better, by their changes in touch, or None.

    What stands still is no evidence: rests are compared with nothing here."""
    predicted = [m - r for m, r in zip(comparison.measured, fit.raw(comparison))]
    # (chosen, 19, 19) evidence of electrode i read as j says
    fits = np.array([_evidence(comparison, i, predicted[i]) for i in chosen])
    _, reads = linear_sum_assignment(-fits.mean(0))
    row = np.arange(19)
    gain = fits[:, row, reads] - fits[:, row, row]
    # A contact that one electrode does not feel says nothing of it, but of the others in its ring.
    moved = []
    for ring in _rings(reads):
        if gain[:, ring].mean(0).min() > _NATS and signed_root_t(gain[:, ring].sum(1)) < _CHANCE:
            moved += [(i, int(reads[i])) for i in ring]
    return Exchange(sorted(moved)) if moved else None


def _rings(reads):
    """Lists of electrodes each of which shows the next one: who shows another's is shown by somebody."""
    left, out = set(np.flatnonzero(reads != np.arange(len(reads))).tolist()), []
    while left:
        ring = [left.pop()]
        while int(reads[ring[-1]]) in left:
            ring.append(int(reads[ring[-1]]))
            left.remove(ring[-1])
        out.append(ring)
    return out


def _evidence(comparison, i, predicted):
    """(19, 19) -(rows / 2) log of the mean square of measured electrode a about prediction b [nats], both
    about their first row: what the session's clock does is no wiring."""
    measured = comparison.measured[i][:, :19]
    measured, predicted = measured - measured[:1], predicted[:, :19] - predicted[:1, :19]
    square = ((measured[:, :, None] - predicted[:, None]) ** 2).mean(0) / comparison.sigma[:19, None] ** 2
    return -0.5 * len(measured) * np.log(np.maximum(square, 1.0))
