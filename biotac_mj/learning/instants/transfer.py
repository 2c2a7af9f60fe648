"""Force of a sensor with few labelled touches, with another sensor's recording as a prior."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from ...sensor.channels import log_impedance
from .force import columns_of
from .linear import held_out_errors, of_strengths, ridge
from .terms import KINDS, Terms

__all__ = ["TOUCHES", "label", "touches_of_force", "transfer_force"]

TOUCHES = 20  # labelled touches of a new sensor
_SMOOTH, _RELEASE = 10, 0.5  # [rows], [N]: a touch ends when the smoothed force has fallen by this much
_KNOWN_RIDGE = 1e-3  # of the other sensor's regressions
_RIDGE = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # of the new sensor's difference
_FOLDS = 5


def touches_of_force(force: np.ndarray) -> np.ndarray:
    """(n,) number of the touch of each row of force (n, 3) [N], between minima of its size, so that a press
    without full release is split into touches."""
    size = gaussian_filter1d(np.linalg.norm(force, axis=1), _SMOOTH)
    lowest, _ = find_peaks(-size, prominence=_RELEASE)
    return np.searchsorted(lowest, np.arange(len(force)), "right")


def label(force: np.ndarray, touch: np.ndarray, count: int = TOUCHES) -> np.ndarray:
    """Force (n, 3), NaN except in `count` whole touches, evenly spread over the time; touch: (n,) of each
    row.

    Raises:
      ValueError: too few touches.
    """
    whole = np.unique(touch)[:-1]  # the last one may be incomplete
    count = min(count, len(whole))
    if count < _FOLDS:
        raise ValueError(
            f"{count} labelled touches: at least {_FOLDS} whole ones are needed to choose how much of the "
            "other sensor is believed; label more, or record longer"
        )
    chosen = whole[np.linspace(0, len(whole) - 1, count).round().astype(int)]
    return np.where(np.isin(touch, chosen)[:, None], force, np.nan)


def transfer_force(
    known_counts: np.ndarray,
    known_force: np.ndarray,
    counts: np.ndarray,
    force: np.ndarray,
    touch: np.ndarray,
) -> np.ndarray:
    """(n, 3) [N], force of a new sensor in every row.

    Each kind of regression is fitted to the known sensor. Labelled touches of the new sensor decide, per
    component, whether it is the starting point, and fit a ridge to the residual. Held-out touches select and
    weigh the kinds. Each sensor's ln Z is centred, because baselines differ.

    Args:
      known_counts: (m, nelectrode), known_force: (m, 3) [N], of the other sensor.
      counts: (n, nelectrode) of the new one; rows up to the last labelled one give its mean.
      force: (n, 3) [N], NaN if unknown. touch: number of each row's touch, at least up to the last labelled
        row.
    """
    rows = np.flatnonzero(np.isfinite(force).all(1))
    from_known, log_z = log_impedance(known_counts), log_impedance(counts)
    from_known = from_known - from_known.mean(0)
    log_z = log_z - log_z[: rows[-1] + 1].mean(0)
    out, total = 0.0, 0.0
    for kind in KINDS:
        terms = Terms.fit(from_known, **kind)
        weight, offset = ridge(columns_of(terms, from_known), known_force, _KNOWN_RIDGE)
        columns = columns_of(terms, log_z)
        prediction, error = _amended(columns, columns @ weight + offset, force[rows], rows, touch[rows])
        out, total = out + prediction / error, total + 1 / error
    return out / total


def _amended(columns, believed, force, rows, touch):
    """Prediction for all rows (n, 3), and its mean square on held-out touches (3,)."""
    starts = np.stack([np.zeros_like(believed), believed])
    residuals, component = force - starts[:, rows], np.arange(believed.shape[1])
    error = np.concatenate([held_out_errors(columns[rows], y, touch, _RIDGE, _FOLDS) for y in residuals])
    start, strength = np.divmod(error.argmin(0), len(_RIDGE))
    target = residuals[start, :, component].T
    weight, offset = of_strengths(columns[rows], target, _RIDGE, strength)
    return starts[start, :, component].T + columns @ weight + offset, error.min(0) + 1e-12
