"""Causal force estimation from electrodes: a prediction uses neither later rows nor the test rows.

Ridge regressions on `Terms` of ln Z and their causal averages. A recording cannot separate the sensor's
warm-up from slow creep, so each is fitted with a further feature 1 - exp(-t / tau) too, and without. The
prediction is their mean. Cross-validation on blocks of the training rows selects each ridge and weighs the
regressions, for each component of the force."""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from ...sensor.channels import log_impedance
from .linear import held_out_errors, of_strengths
from .terms import KINDS, Terms

_WARM_UP = 2.5  # time constant, in lengths of the training rows
_BLOCKS, _FOLDS = 40, 5  # rows are correlated in time
_RIDGE = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
_EXACT = 1e-18  # [N^2]: smaller errors are zero, as for a constant component
_WINDOW = 10  # time constant of the causal average [rows]
TRIALS = 2 * len(KINDS)  # calls of `progress` in `fit_force`


def causal_average(x: np.ndarray, tau: float) -> np.ndarray:
    """Exponential average of x (n, k) over the past with time constant tau [rows], starting at the first
    row."""
    a = 1 - np.exp(-1 / tau)
    return lfilter([a], [1, a - 1], x, axis=0, zi=x[:1] * (1 - a))[0]


@dataclasses.dataclass(frozen=True, eq=False)
class ForceModel:
    """Force from the counts up to each row; result of `fit_force`.

    Attributes:
      prediction: (n, 3) [N]. trials: regression -> RMSE [N] on blocks left out, for x, y, z.
    """

    prediction: np.ndarray
    trials: dict[str, list[float]]


def fit_force(
    counts: np.ndarray, force: np.ndarray, ntrain: int, progress: Callable[[], object] | None = None
) -> ForceModel:
    """Fits on rows 0..ntrain-1 and predicts every row.

    Args:
      counts: (n, nelectrode); force: (n, 3) [N], of which only the first ntrain rows are used.
      progress: called TRIALS times.
    """
    log_z, force, block = log_impedance(counts), force[:ntrain], np.arange(ntrain) * _BLOCKS // ntrain
    rise = 1 - np.exp(-np.arange(len(log_z)) / (_WARM_UP * ntrain))
    prediction, total, trials = 0.0, 0.0, {}
    for kind in KINDS:
        now = Terms.fit(log_z[:ntrain], **kind)(log_z)
        columns = np.hstack([now, causal_average(now[:, : log_z.shape[1]], _WINDOW)])  # of the electrodes
        for warm_up, x in (("", columns), (" and warm-up", np.column_stack([columns, rise]))):
            error = held_out_errors(x[:ntrain], force, block, _RIDGE, _FOLDS)
            weight, offset = of_strengths(x[:ntrain], force, _RIDGE, error.argmin(0))
            least = np.maximum(error.min(0), _EXACT)
            prediction, total = prediction + (x @ weight + offset) / least, total + 1 / least
            text = ", ".join(f"{name} {value:g}" for name, value in kind.items())
            trials[text + warm_up] = np.sqrt(error.min(0)).tolist()
            if progress:
                progress()
    return ForceModel(prediction / total, trials)
