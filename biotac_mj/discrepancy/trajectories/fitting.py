"""Fits of effects with all that the base model may be off by: the most probable parameters, and the evidence
of the data for the effects, by Laplace's method."""

import dataclasses
import typing
from collections.abc import Sequence

import numpy as np

from . import likelihood
from .base.nuisance import BETWEEN, HIGH, KNOWN, LOW, PRIOR, Nuisance
from .settings import SETTINGS

if typing.TYPE_CHECKING:
    from ...effects.effect import Effect
    from .whitening import Comparison

_NUISANCE = [f.name for f in dataclasses.fields(Nuisance)]
_MOVES = np.array([0.05, 0.05, 0.02, 0.2, 0.2, 0.2, 0.2, 0.3])  # of the nuisance, for differences
_SMALL, _SHAPE = 0.3, 0.2  # the same of a parameter's scale and of a shape's logarithm
_TANGENT = 0.01  # the same where errors of poses, whose tangents are known, do what a parameter does
_SHAPE_PRIOR = 1.0  # standard deviation of a shape's logarithm
_STEPS, _DONE = 8, 0.1  # Gauss-Newton's; [nats] below which one more changes nothing
_SHORTER = 1.0, 0.5, 0.2  # of a step
_FARTHEST = 3.0  # standard deviations of priors that a step leads


@dataclasses.dataclass
class Fit:
    """Effects with their parameters and the nuisance fitted with them.

    Attributes:
      effects: list of (Effect, theta). nuisance: fitted with them. names: of the free parameters: (effect
      id, name); covariance: theirs.
      score: log evidence of the data for these effects [nats]. own_evidence: evidence [nats] over no effect
      that errors in the laws of other effects cannot explain. overlap: of where the last effect acts with
      where each of the others does, 0 to 1 each, in sum. amplitude: (width,) by how many times more
      than `size` (width,) [counts, N], which is what is expected of a base model, the model with them is off;
      off: (width,) the same beside what the laws of the effects may lack.
      modulus_error: standard error of the logarithm of the modulus.
      information: (k, k) of data and priors about all `parameters` of the effects, in standard deviations of
      the priors.
      y, columns: (n, width), (m, n, width) of the linear model about this fit, in the likelihood's
      eigenvectors. offsets: (trajectories, 3) most probable errors of poses [m].
    """

    effects: list
    nuisance: Nuisance
    names: list
    covariance: np.ndarray
    score: float = 0.0
    overlap: float = 0.0
    amplitude: np.ndarray | None = None
    size: np.ndarray | None = None
    off: np.ndarray | None = None
    law_errors: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    modulus_error: float = float("nan")
    information: np.ndarray | None = None
    y: np.ndarray | None = None
    columns: np.ndarray | None = None
    offsets: np.ndarray | None = None
    own_evidence: float = 0.0

    def posed(self, comparison: "Comparison") -> list:
        """Residuals (n, width) over noise and resolution, at the most probable poses."""
        raw = comparison.raw(self.effects, self.nuisance, offsets=self.offsets)
        return [r / s for r, s in zip(raw, comparison.sigmas)]

    def mean_square(self, comparison: "Comparison") -> np.ndarray:
        """(trajectories,) mean square of rows, and of the pose's error, by noise and resolution."""
        return np.array([v @ v for v in comparison.vectors(self.effects, self.nuisance)])

    def raw(self, comparison: "Comparison", exact: bool | list = False) -> list:
        return comparison.raw(self.effects, self.nuisance, exact)

    def scatter(self, comparison: "Comparison") -> float:
        """Negative log density of its poses, whose errors are of `comparison.repeatability` [nats]."""
        return 0.5 * float(np.square(self.offsets / comparison.repeatability).sum())

    def interval(self, k: int) -> tuple[float, float]:
        """95 % interval of free parameter k, from its posterior and the error of its effect's law."""
        effect, name = self.names[k]
        number = next(n for n, (e, _) in enumerate(self.effects) if e.id == effect)
        value = self.effects[number][1][name]
        law = 0.0 if self.effects[number][0].wiring else self.law_errors[number] * value
        half = 1.96 * float(np.sqrt(max(self.covariance[k, k], 0) + law**2))
        return value - half, value + half


@dataclasses.dataclass
class _Point:
    """Parameters and offsets (trajectories, 3) of poses, the residual (n, width) there, in eigenvectors, and
    each parameter's distance from its prior's mean in standard deviations; done: the contribution of each
    effect; errors: derivatives by errors of poses, then of laws; y: the residual at the recorded poses."""

    effects: list
    nuisance: Nuisance
    offsets: np.ndarray
    residual: np.ndarray
    away: np.ndarray
    done: list
    errors: np.ndarray
    y: np.ndarray


def sizes(effect: "Effect") -> typing.Iterator[tuple[str, float]]:
    """(name, realistic size) of the free parameters."""
    for name in effect.free:
        p = effect.params[name]
        yield name, (1.0 if p.high > 0 else -1.0) * min(p.scale, 0.5 * max(abs(p.high), abs(p.low)))


def parameters(effects: list, free: Sequence[str] = _NUISANCE) -> list[tuple[int | None, str, float, float]]:
    """Parameters of the nuisance and of effects [(Effect, theta)]: (index of the effect, or None; name;
    standard deviation of the prior; step of differences), of a shape those of its logarithm."""
    out = [(None, name, PRIOR[k], _MOVES[k]) for k, name in enumerate(_NUISANCE) if name in free]
    for k, (effect, _) in enumerate(effects):
        step = _TANGENT if effect.pose_offset else _SMALL
        out += [
            (k, name, SETTINGS.wide * effect.params[name].scale, step * size) for name, size in sizes(effect)
        ]
        out += [(k, name, _SHAPE_PRIOR, _SHAPE) for name, p in effect.params.items() if p.shape]
    return out


def fit_effects(
    comparison: "Comparison",
    effects: list,
    keep: np.ndarray | None = None,
    start: Fit | None = None,
    known: Sequence[str] = (),
) -> Fit:
    """The most probable parameters of effects (list of (Effect, theta to start from)) and of the nuisance.

    Args:
      keep: trajectories to use (indices), None all. start: Fit whose nuisance, offsets and errors of laws to
        start from.
      known: names of the nuisance parameters that are fixed at the base model's values.
    """
    chosen = np.arange(len(comparison.trajectories)) if keep is None else np.asarray(keep)
    model = _Model(comparison, likelihood.of(comparison, chosen), effects, known)
    nuisance = KNOWN if start is None else start.nuisance
    nuisance = dataclasses.replace(nuisance, **{n: 0.0 for n in _NUISANCE if n not in model.free})
    amplitude = None if start is None else start.amplitude
    offsets = np.zeros((len(comparison.trajectories), 3)) if start is None else start.offsets
    known_errors = {} if start is None else {e.id: v for (e, _), v in zip(start.effects, start.law_errors)}
    law_errors = np.array([known_errors.get(e.id, SETTINGS.law) for e, _ in effects])
    return model.fitted([(e, dict(th)) for e, th in effects], nuisance, amplitude, offsets, law_errors)


def changes(
    comparison: "Comparison", own: likelihood.Likelihood, effects: list, nuisance: Nuisance
) -> list[np.ndarray]:
    """(n, width) what each of effects [(Effect, theta)] does by itself; nothing where it has no other law."""
    if not effects:
        return []
    bare = own.stacked(comparison.raw([], nuisance))
    return [
        bare * 0.0 if one[0].wiring else bare - own.stacked(comparison.raw([one], nuisance))
        for one in effects
    ]


class _Model:
    """Effects and nuisance as one list of `parameters`."""

    def __init__(self, comparison, own: likelihood.Likelihood, effects, known):
        self.comparison, self.likelihood = comparison, own
        absent = set(known) | {name for e, _ in effects for name in e.instead_of}
        if not np.any(comparison.sim.log_rest):
            absent.add("stands_off")
        slopes = comparison.fields.slopes
        absent |= {name for name in BETWEEN if name not in slopes}
        absent |= {"log_film"} if comparison.fields.film is None else set()
        self.free = [n for n in _NUISANCE if n not in absent]
        self.parameters = parameters(effects, self.free)
        self.spread = np.array([p[2] for p in self.parameters])
        self.middle = [dict(theta) for _, theta in effects]

    def _value(self, effects, nuisance, k, name):
        """Distance from the prior's mean."""
        if k is None:
            return getattr(nuisance, name)
        effect, theta = effects[k]
        p = effect.params[name]
        return float(np.log(theta[name] / self.middle[k][name])) if p.shape else theta[name] - p.start

    def _with(self, effects, nuisance, k, name, value):
        """Effects and nuisance with one parameter at a distance from the prior's mean, within its bounds."""
        if k is None:
            at = _NUISANCE.index(name)
            value = float(np.clip(value, LOW[at], HIGH[at]))
            return effects, dataclasses.replace(nuisance, **{name: value})
        effect, theta = effects[k]
        p = effect.params[name]
        value = self.middle[k][name] * np.exp(np.clip(value, -9, 9)) if p.shape else p.start + value
        moved = (effect, theta | {name: float(np.clip(value, p.low, p.high))})
        return [*effects[:k], moved, *effects[k + 1 :]], nuisance

    def _residual(self, effects, nuisance, offsets):
        likelihood = self.likelihood
        raw = self.comparison.raw(effects, nuisance, offsets=offsets)
        return likelihood.turned(likelihood.stacked(raw))

    def _point(self, effects, nuisance, offsets, law_errors):
        away = np.array([self._value(effects, nuisance, k, n) for k, n, *_ in self.parameters])
        residual, pose = self._residual(effects, nuisance, offsets), self.likelihood.poses(offsets)
        off = offsets[self.likelihood.chosen].ravel() / self.comparison.repeatability
        y = residual + np.tensordot(off, pose, 1)
        done = changes(self.comparison, self.likelihood, effects, nuisance)
        errors = np.concatenate([pose, self.likelihood.laws(done, law_errors)])
        return _Point(effects, nuisance, offsets, residual, away / self.spread, done, errors, y)

    def _columns(self, point):
        """Decrease of the residual by one standard deviation of each parameter (parameters, n, width)."""
        out = []
        for (k, name, spread, step), away in zip(self.parameters, point.away):
            for by in (step, -step):
                moved = self._with(point.effects, point.nuisance, k, name, away * spread + by)
                made = self._value(*moved, k, name) - away * spread
                if abs(made) > 0.5 * abs(step):
                    break
            if abs(made) < 1e-12:
                out.append(np.zeros_like(point.residual))
                continue
            out.append((point.residual - self._residual(*moved, point.offsets)) * (spread / made))
        return np.array(out).reshape(len(out), *point.residual.shape)

    def _log(self, point, variance):
        """log density of data and parameters at a point, errors of poses and laws marginalised."""
        log, _, factor = self.likelihood.evidence(point.y, point.errors, variance)
        return log - 0.5 * point.away @ point.away, factor

    def fitted(self, effects, nuisance, amplitude, offsets, law_errors) -> Fit:
        """The Fit, by Gauss-Newton's steps of the parameters and steps of the amplitudes and of errors of
        laws in turn, each of which makes the data more likely."""
        likelihood, size = self.likelihood, self.likelihood.size
        point, poses = self._point(effects, nuisance, offsets, law_errors), 3 * len(likelihood.chosen)
        if amplitude is None:
            # from above: what parameters explain is taken from what is missed, and not the other way
            amplitude = likelihood.amplitude_of(point.y**2, size)
        for _ in range(_STEPS):
            columns = lawful = self._columns(point)
            y = point.y + np.tensordot(point.away, columns, 1)  # as from the prior's mean
            whole = np.concatenate([point.errors, columns])
            amplitude = likelihood.amplitudes(y, whole, amplitude, size)
            variance = likelihood.variance(amplitude, size)
            _, weights, factor = likelihood.evidence(y, whole, variance)
            if point.done:
                lawful = self._lawful(columns, weights[poses:], law_errors)
                y = point.y + np.tensordot(point.away, lawful, 1)
                whole = np.concatenate([point.errors, lawful])
                _, weights, factor = likelihood.evidence(y, whole, variance)
            known, law_errors = law_errors, likelihood.law_errors(law_errors, weights, factor, poses)
            larger = np.concatenate(
                [np.ones(poses), np.repeat(law_errors / known, len(likelihood.error_modes))]
            )
            point = dataclasses.replace(point, errors=point.errors * larger[:, None, None])
            step, off = weights[len(point.errors) :] - point.away, self._offsets(weights) - point.offsets
            far = max(np.abs(step).max(initial=0), np.abs(off).max() / self.comparison.repeatability)
            step, off = (by * min(1.0, _FARTHEST / max(far, 1e-9)) for by in (step, off))
            before, gain = self._log(point, variance)[0], 0.0
            for fraction in _SHORTER:
                trial = self._moved(point, fraction * step, point.offsets + fraction * off, law_errors)
                more = self._log(trial, variance)[0] - before
                if more > 0:
                    point, gain = trial, more
                    break
            if gain < _DONE and np.array_equal(known, law_errors):
                break
        else:
            columns = self._columns(point)
        return self._finished(point, columns, amplitude, law_errors)

    def _lawful(self, columns, weights, law_errors):
        """Columns of parameters beside what the laws of their effects lack by these weights: where an effect
        does more, there is more of that, too."""
        columns, count = columns.copy(), likelihood.ERROR_MODES
        for j, (k, *_) in enumerate(self.parameters):
            if k is not None:
                own = law_errors[k] * weights[k * count : (k + 1) * count]
                columns[j] = self.likelihood.times(1 + own @ self.likelihood.error_modes, columns[j])
        return columns

    def _offsets(self, weights):
        """(trajectories, 3) of poses by their coefficients."""
        chosen = self.likelihood.chosen
        out = np.zeros((len(self.comparison.trajectories), 3))
        out[chosen] = self.comparison.repeatability * weights[: 3 * len(chosen)].reshape(-1, 3)
        return out

    def _moved(self, point, step, offsets, law_errors):
        effects, nuisance = point.effects, point.nuisance
        for (k, name, spread, _), away, by in zip(self.parameters, point.away, step):
            effects, nuisance = self._with(effects, nuisance, k, name, (away + by) * spread)
        return self._point(effects, nuisance, offsets, law_errors)

    def _overlap(self, done) -> float:
        """Correlation of how much the last effect does in each row and channel with how much each other one
        does, in sum."""
        acts = [(np.abs(change) / self.likelihood.noise).ravel() for change in done]
        acts = [act / max(np.linalg.norm(act), 1e-30) for act in acts]
        return float(sum(act @ acts[-1] for act in acts[:-1]))

    def _finished(self, point, columns, amplitude, law_errors):
        likelihood, size = self.likelihood, self.likelihood.size
        expected = size
        for change, error in zip(point.done, law_errors):
            expected = np.hypot(expected, error * np.quantile(np.abs(change), 0.98, axis=0))
        whole, errors = np.concatenate([point.errors, columns]), len(point.errors)
        y = point.y + np.tensordot(point.away, columns, 1)
        # by what is left at the point itself: where a bound holds, the linear model would leave less
        for _ in range(2):
            variance = likelihood.variance(amplitude, size)
            amplitude = likelihood.amplitudes(point.y, point.errors, amplitude, size, 1)
        variance = likelihood.variance(amplitude, size)
        log, of_errors = self._log(point, variance)
        _, _, factor = likelihood.evidence(y, whole, variance)
        score = log + likelihood.prior(amplitude, law_errors)
        score += np.log(np.diag(of_errors)).sum() - np.log(np.diag(factor)).sum()
        marginal = np.linalg.inv(factor @ factor.T)[errors:, errors:]
        every = [p[:2] for p in parameters(point.effects)]
        at, information = [every.index(p[:2]) for p in self.parameters], np.eye(len(every))
        information[np.ix_(at, at)] = np.linalg.inv(marginal)
        covariance = marginal * np.outer(self.spread, self.spread)
        own = [i for i, p in enumerate(self.parameters) if p[0] is not None]
        scale = np.ones(len(own))
        for j, i in enumerate(own):
            k, name, *_ = self.parameters[i]
            effect, theta = point.effects[k]
            scale[j] = theta[name] if effect.params[name].shape else 1.0
        modulus = self.free.index("log_modulus") if "log_modulus" in self.free else None
        return Fit(
            point.effects,
            point.nuisance,
            [(point.effects[self.parameters[i][0]][0].id, self.parameters[i][1]) for i in own],
            covariance[np.ix_(own, own)] * np.outer(scale, scale),
            float(score),
            self._overlap(point.done),
            amplitude,
            size,
            amplitude * size / expected,
            law_errors,
            float("nan") if modulus is None else float(np.sqrt(covariance[modulus, modulus])),
            information,
            y,
            whole,
            point.offsets,
        )
