"""Another modulus of the base model's rubber, which is calibrated before anything is looked for, and which no
effect is charged with."""

import typing

import numpy as np

from ....effects.rubber import Modulus
from ...evidence import ODDS
from ...report.verdict import Estimate, Finding
from ..fitting import fit_effects

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

_LOG_MODULUS = 0.2  # smaller factors are within what batches of rubber, force sensors and warmth make
_LIKE_MODULUS = "BC"  # stages: another law of load, or what gives way, takes part of a modulus or gives some
_OTHER_MESH = 0.5


def other_modulus(
    comparison: "Comparison", fit: "Fit", chosen: np.ndarray
) -> "tuple[Finding, Fit] | tuple[None, None]":
    """The finding that the rubber has another modulus beside the effects of `fit`, and the Fit without it."""
    by = fit.nuisance.log_modulus
    like_modulus = any(e.stage in _LIKE_MODULUS for e, _ in fit.effects)
    if abs(by) < _LOG_MODULUS or like_modulus or fit.nuisance.mesh > _OTHER_MESH:
        return None, None
    bare = fit_effects(comparison, fit.effects, chosen, fit, known=("log_modulus",))
    gain = float(fit.score - bare.score)
    if gain < np.log(ODDS):
        return None, None
    effect, factor, half = Modulus(), np.exp(by), 1.96 * fit.modulus_error
    value = Estimate.of(effect.params["factor"], factor, factor * np.exp(-half), factor * np.exp(half))
    return Finding.of(effect, parameters={"factor": value}, evidence=gain, p=float(np.exp(-gain))), bare
