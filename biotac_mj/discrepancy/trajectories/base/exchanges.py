"""Electrodes that are exchanged: found before anything is fitted, since no small change leads from one wiring
to another."""

import typing

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from ....effects.electrodes import Exchange
from ....quality.evidence import signed_root_t

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

_SWAPPED = 3.0  # nats per trajectory that each electrode has to gain in another's place
_SWAP_CHANCE = 0.01  # of all electrodes of a ring together


def exchanged(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> Exchange | None:
    """Electrodes that another one's prediction fits better, by their changes in touch, or None.

    What stands still is no evidence: rests are compared with nothing here."""
    predicted = [m - r for m, r in zip(comparison.measured, fit.raw(comparison))]
    # (chosen, nelectrode, nelectrode) evidence of electrode i read as j says
    fits = np.array([_in_place_of(comparison, i, predicted[i]) for i in chosen])
    _, reads = linear_sum_assignment(-fits.mean(0))
    row = np.arange(len(reads))
    gain = fits[:, row, reads] - fits[:, row, row]
    # A contact that changes one electrode little is still evidence on the others in its ring.
    moved = []
    of = connected_components(np.eye(len(reads))[reads])[1]
    for ring in (np.flatnonzero(of == k) for k in np.unique(of[reads != row])):
        if gain[:, ring].mean(0).min() > _SWAPPED and signed_root_t(gain[:, ring].sum(1)) < _SWAP_CHANCE:
            moved += [(i, int(reads[i])) for i in ring]
    return Exchange(sorted(moved)).on(comparison.sim.design) if moved else None


def _in_place_of(comparison, i, predicted):
    """(nelectrode, nelectrode) evidence of measured electrode a by prediction b, both about their first
    row: what the session's clock does is no wiring."""
    n = comparison.nelectrode
    measured = comparison.measured[i][:, :n]
    measured, predicted = measured - measured[:1], predicted[:, :n] - predicted[:1, :n]
    square = ((measured[:, :, None] - predicted[:, None]) ** 2).mean(0) / comparison.sigma[:n, None] ** 2
    return -0.5 * len(measured) * np.log(np.maximum(square, 1.0))  # of what lies beyond noise
