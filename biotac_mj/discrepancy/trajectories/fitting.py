"""Fits of effects: nuisance parameters always with them, trajectories weighted so that none decides alone,
evidence by trajectory."""

import dataclasses
import typing

import numpy as np
from scipy.optimize import least_squares

from .base.nuisance import HIGH, LOW, PRIOR, Nuisance

if typing.TYPE_CHECKING:
    from .whitening import Comparison

__all__ = ["Fit", "fit_effects"]

_N = len(PRIOR)


@dataclasses.dataclass
class Fit:
    """Effects with their parameters and the nuisance fitted with them.

    Attributes:
      effects: list of (Effect, theta). nuisance: fitted with them. covariance: of the free parameters, by
        trajectory (sandwich).
      names: of the free parameters: (effect id, name); cost.
      modulus_error: standard error of the logarithm of the modulus, by trajectory.
    """

    effects: list
    nuisance: Nuisance
    names: list
    covariance: np.ndarray
    cost: float
    modulus_error: float = float("nan")

    def residuals(self, comparison: "Comparison", exact: bool | list = False) -> list:
        return comparison.residuals(self.effects, self.nuisance, exact)

    def vectors(self, comparison: "Comparison") -> list:
        return comparison.vectors(self.effects, self.nuisance)

    def mean_square(self, comparison: "Comparison") -> np.ndarray:
        """(trajectories,) c_i: mean square of rows, and of the pose's error."""
        return np.array([v @ v for v in self.vectors(comparison)])

    def evidence(self, comparison: "Comparison") -> np.ndarray:
        """(trajectories,) -(rows / 2) log c_i: scale-free, rows rather than samples because channels share
        their causes [nats]."""
        rows = np.array([len(t.time) for t in comparison.trajectories])
        return -0.5 * rows * np.log(np.maximum(self.mean_square(comparison), 0.05))

    def raw(self, comparison: "Comparison", exact: bool | list = False) -> list:
        return comparison.raw(self.effects, self.nuisance, exact)

    def interval(self, k: int) -> tuple[float, float]:
        """95 % interval of free parameter k, from the covariance by trajectory and what the effect says of
        its law."""
        effect, name = self.names[k]
        value = next(th for e, th in self.effects if e.id == effect)[name]
        law = next(e.law for e, _ in self.effects if e.id == effect) * value
        half = 1.96 * float(np.sqrt(max(self.covariance[k, k], 0) + law**2))
        return value - half, value + half


def fit_effects(
    comparison: "Comparison",
    effects: list,
    keep: np.ndarray | None = None,
    start: Fit | None = None,
    near: bool = False,
    known: tuple = (),
) -> Fit:
    """MAP fit of effects (list of (Effect, theta of shape values)) with the nuisance parameters.

    Args:
      keep: trajectories to use (indices), None all. start: Fit whose nuisance to start from.
      near: the start is nearly the answer already, as with a part of the same trajectories.
      known: names of the nuisance that is as the base model says.
    """
    keep = np.arange(len(comparison.trajectories)) if keep is None else np.asarray(keep)
    names, scale, low, high, x0 = [], [], [], [], []
    for effect, theta in effects:
        free = effect.free + [n for n, p in effect.params.items() if p.shape]
        for name in free:
            p = effect.params[name]
            names.append((effect.id, name))
            scale.append(p.scale if not p.shape else 1.0)
            value = theta[name]
            if p.shape:  # in the logarithm
                (
                    low.append(np.log(p.low)),
                    high.append(np.log(p.high)),
                    x0.append(np.log(np.clip(value, p.low * 1.001, p.high * 0.999))),
                )
            else:
                (
                    low.append(p.low / p.scale),
                    high.append(p.high / p.scale),
                    x0.append(np.clip(value / p.scale, low[-1] + 1e-6, high[-1] - 1e-6)),
                )
    scale = np.array(scale)
    nuisance = np.zeros(_N) if start is None else start.nuisance.vector()
    sliding = any("log_friction" in e.instead_of for e, _ in effects)
    free = np.array([f.name not in known for f in dataclasses.fields(Nuisance)])
    x = np.concatenate([nuisance * free, x0])
    small = np.where(free, 1.0, 1e-6)  # bounds have to leave some room
    bounds = (np.concatenate([LOW * small, low]), np.concatenate([HIGH * small, high]))
    prior = np.array(
        [
            2.5 if not e.params[n].shape else 1.0
            for i, (eid, n) in enumerate(names)
            for e, _ in effects
            if e.id == eid
        ]
    )
    centre = np.array(
        [
            0.0 if not _param(effects, nm).shape else np.log({e.id: th for e, th in effects}[nm[0]][nm[1]])
            for nm in names
        ]
    )

    def unpack(v):
        filled = [(e, dict(th)) for e, th in effects]
        table = {e.id: th for e, th in filled}
        for (eid, name), value, s in zip(names, v[_N:], scale):
            table[eid][name] = (
                float(np.exp(value)) if _param(effects, (eid, name)).shape else float(value * s)
            )
        base = Nuisance(*map(float, v[:_N]))
        return filled, dataclasses.replace(base, log_friction=0.0) if sliding else base

    weight = np.ones(len(comparison.trajectories))

    def function(v):
        r = comparison.vectors(*unpack(v))
        parts = [r[i] * np.sqrt(weight[i]) for i in keep]
        penalty = (
            np.concatenate([v[:_N] / PRIOR, (v[_N:] - centre) / prior]) if len(names) else v[:_N] / PRIOR
        )
        return np.concatenate([*parts, penalty])

    rows = np.array([len(t.time) for t in comparison.trajectories])
    for evaluations in (4,) if near else (8, 6):
        c = np.array([r @ r for r in comparison.vectors(*unpack(x))])
        weight = rows / np.maximum(c, 0.5)
        out = least_squares(
            function,
            x,
            bounds=bounds,
            method="trf",
            diff_step=1e-3,
            max_nfev=evaluations,
            x_scale="jac",
            ftol=3e-4,  # a tenth of a nat
            xtol=3e-4,
        )
        x = out.x
    filled, nuisance = unpack(x)
    # Sandwich by trajectory: bread of Gauss-Newton, meat of the trajectories' own scores.
    sizes = [len(comparison.vector(i, comparison.measured[i])) for i in keep]
    edges = np.concatenate([[0], np.cumsum(sizes)])
    J, r = out.jac, out.fun
    bread = np.linalg.pinv(J.T @ J)
    score = np.array([J[a:b].T @ r[a:b] for a, b in zip(edges[:-1], edges[1:])])
    n = len(keep)
    sandwich = bread @ (score.T @ score * n / max(n - 1, 1)) @ bread
    variance = np.maximum(np.diag(sandwich), np.diag(bread) * max(1.0, 2 * out.cost / rows[keep].sum()))
    covariance = variance[_N:]
    jacobian = np.array(
        [
            1.0 if not _param(effects, nm).shape else {e.id: th for e, th in filled}[nm[0]][nm[1]]
            for nm in names
        ]
    )
    covariance = np.diag(covariance * (scale * jacobian) ** 2) if len(names) else np.zeros((0, 0))
    return Fit(filled, nuisance, names, covariance, float(out.cost), float(np.sqrt(variance[0])))


def _param(effects, name):
    return next(e for e, _ in effects if e.id == name[0]).params[name[1]]
