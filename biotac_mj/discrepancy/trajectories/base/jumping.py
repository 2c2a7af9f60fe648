"""Electrodes that jump from one row to the next, as with a loose lead: too seldom for a mean square, and
nothing that a skin does."""

import typing

import numpy as np

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = ["jumping"]

# Standard errors of the second largest change between rows, median over contacts, and of that of other
# electrodes: noise alone makes 1.4 to 2.2 of 30 to 40 rows, in nine sensors with nothing hidden.
_FAR, _MORE = 2.5, 1.5
_MOST = 3  # of many that jump something else is wrong


def jumping(comparison: "Comparison", fit: "Fit") -> list[str]:
    """Names of electrodes whose residuals jump and come back in most contacts, the worst one first; none
    where many do."""
    raw, second = fit.raw(comparison), []
    for residual, sigma in zip(raw, comparison.sigmas):
        steps = np.abs(np.diff(residual[:, :19] / sigma[:19], axis=0)) / np.sqrt(2)
        if len(steps) > 1:
            second.append(np.sort(steps, axis=0)[-2])
    if not second:
        return []
    size = np.median(second, axis=0)
    far = (size > _FAR) & (size > _MORE * np.median(size))
    return [f"e{k + 1}" for k in np.argsort(-size) if far[k]] if far.sum() <= _MOST else []
