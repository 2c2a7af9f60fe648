"""Errors of the base model itself that are attributed to no effect: the rubber's modulus, calibrated before
the search, and the baselines of single electrodes, about which counts are compared."""

import dataclasses
import typing

import numpy as np

from ....effects.rubber import Modulus
from ...evidence import ODDS
from ...report.verdict import Estimate, Finding, of_electrodes
from ..fitting import fit_effects
from .channels import noisy_electrodes, offsets

if typing.TYPE_CHECKING:
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = ["BaseCandidate", "base_findings"]

_LOG_MODULUS = 0.2  # smaller factors are within what batches of rubber, force sensors and warmth make
_LIKE_MODULUS = "BC"  # stages: another law of load, or what gives way, takes part of a modulus or gives some
_OTHER_MESH = 0.5


@dataclasses.dataclass
class BaseCandidate:
    """An effect that was not composed with the others.

    Attributes:
      finding: as it is reported. pairs: [(Effect, theta)] to add to the amended simulator.
      bare: Fit of the base model without it, or None.
    """

    finding: Finding
    pairs: list
    bare: "Fit | None" = None


def base_findings(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> list[BaseCandidate]:
    """Noise and offsets of single electrodes and another modulus, beside the effects of `fit`."""
    found = (
        _noise(comparison, fit),
        _offsets(comparison, fit, chosen),
        _modulus(comparison, fit, chosen),
    )
    return [one for one in found if one is not None]


def _noise(comparison, fit):
    """Electrodes that scatter in what the fit leaves, too: what an effect explains is no noise."""
    if comparison.noisy is None:
        return None
    forces = [one["force"] for one in comparison.fields.base]
    left = [r[:, : comparison.nelectrode] for r in fit.raw(comparison)]
    again = noisy_electrodes(comparison.trajectories, forces, left)
    effect, theta, sure = comparison.noisy
    sure = {e: size for e, size in sure.items() if again is not None and e in again[2]}
    if not sure:
        return None
    theta = {e: size if e in sure else 0.0 for e, size in theta.items()}
    size = {e: theta[e] for e in sure}
    nats = float(np.log(max(size.values())))
    return _found(effect, size, sure, nats, 2.0 ** -len(comparison.trajectories), [(effect, theta)])


def _offsets(comparison, fit, chosen):
    standing = offsets(comparison, fit, chosen)
    if standing is None:
        return None
    effect, theta, sure = standing
    away = np.array([abs(theta[e]) for e in sure])
    noise = comparison.sigma[[int(e[1:]) - 1 for e in sure]]
    nats = float(np.log1p((away / noise) ** 2).max() / 2)
    return _found(effect, {e: theta[e] for e in sure}, sure, nats, 2.0 ** -len(chosen), [(effect, theta)])


def _modulus(comparison, fit, chosen):
    by = fit.nuisance.log_modulus
    like_modulus = any(e.stage in _LIKE_MODULUS for e, _ in fit.effects)
    if abs(by) < _LOG_MODULUS or like_modulus or fit.nuisance.mesh > _OTHER_MESH:
        return None
    bare = fit_effects(comparison, fit.effects, chosen, fit, known=("log_modulus",))
    gain = fit.score - bare.score
    if gain < np.log(ODDS):
        return None
    factor, half = float(np.exp(by)), 1.96 * fit.modulus_error
    sure = {"factor": (factor * np.exp(-half), factor * np.exp(half))}
    return _found(Modulus(), {"factor": factor}, sure, float(gain), float(np.exp(-gain)), [], bare)


def _found(effect, theta, sure, nats, p, pairs, bare=None):
    parameters = {name: Estimate.of(effect.params[name], value, *sure[name]) for name, value in theta.items()}
    channels = of_electrodes(parameters)
    finding = Finding.of(effect, channels=channels, parameters=parameters, evidence=nats, p=p)
    return BaseCandidate(finding, pairs, bare)
