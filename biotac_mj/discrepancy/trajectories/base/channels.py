"""Single electrodes that show what the others do not: a gain or a drift of their own, another rest, noise,
jumps from row to row.

Each search gives every electrode a number and looks for those that stand out of the others'. Where many do,
it is the base model or the sensor that is another, and none is named."""

import typing

import numpy as np

from ....effects.electrodes import Noise, Offset
from ....sensor.channels import electrode_noise
from ...evidence import signed_root_t
from ..trajectory import Trajectory, settled, still_differences

if typing.TYPE_CHECKING:
    from ....effects.effect import Effect
    from ..fitting import Fit
    from ..whitening import Comparison

__all__ = [
    "evidence",
    "jumping",
    "narrowed",
    "noisy_electrodes",
    "offsets",
    "predicted_by",
    "standing",
    "supported",
]

_ROBUST = 1.4826  # standard deviation of a normal variable by its median absolute deviation
_RIDGE = 1e-3

# Electrodes of which each has a gain or a drift: nineteen parameters of which two are needed cost more than
# they explain.
_OWN = 1.0  # nats per trajectory left out, of one electrode
_OWN_CHANCE = 0.05
_APART = 5.0  # robust standard deviations of the other electrodes
_FEW = 5  # electrodes: where more have it, all may
_OFF = 0.1  # of its change, by which what the base model says of an electrode may be off

# Electrodes that rest elsewhere, which comparisons about the rest leave out.
_FAR = 8.0  # robust standard deviations of the other electrodes, which differ from sensor to sensor
_LEAST = 12.0  # [counts]
_OF_MEDIAN = _ROBUST * 1.2533  # standard error of a normal median by the median of absolute deviations
_FEW_OFFSETS = 4

# Noise, which no prediction tells and which makes readings worth less.
_FEWEST = 40  # rows at rest
_FREE = 2.0  # as the ratio, without touch
_RATIO = 2.5  # over the law of noise, to the median electrode
_TOUCH = 1e-3  # [N]
_LEAST_NOISE = 6.0  # [counts]
_FEW_NOISY = 6
_LAGS = 4  # rows over which coloured noise has grown to what it is

# Jumps, as with a loose lead: too seldom for a mean square, and nothing that a skin does. Standard errors of
# the second largest change between rows, median over contacts, and of that of other electrodes: noise alone
# makes 1.4 to 2.2 of 30 to 40 rows, in nine sensors with nothing hidden.
_STEP, _STEP_MORE = 2.5, 1.5
_FEW_JUMPS = 3


def evidence(square: np.ndarray, rows: int) -> np.ndarray:
    """-(rows / 2) log of mean squares, of what lies beyond noise [nats]."""
    return -0.5 * rows * np.log(np.maximum(square, 1.0))


def supported(gain: np.ndarray, nats: float, p: float) -> bool:
    """Whether gains of evidence (trajectories,) are large enough on average, and no chance."""
    return bool(gain.mean() > nats and signed_root_t(gain) < p)


def predicted_by(y: list[np.ndarray], x: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Evidence (trajectories,) of y [(n,)] by x [(n, q)], each by weights from the others [nats]; the last
    weight of all together."""
    squares = np.array([a.T @ a for a in x])
    products = np.array([a.T @ b for a, b in zip(x, y)])
    ridge = (_RIDGE * squares.sum(0).trace() + 1e-12) * np.eye(squares.shape[1])
    left = [
        b - a @ np.linalg.solve(squares.sum(0) - s + ridge, products.sum(0) - p)
        for a, b, s, p in zip(x, y, squares, products)
    ]
    whole = np.linalg.solve(squares.sum(0) + ridge, products.sum(0))
    return np.array([evidence((b**2).mean(), len(b)) for b in left]), float(whole[-1])


def _few(away, most):
    """Electrodes of a mask (nelectrode,); none where there are more than so many."""
    which = np.flatnonzero(away)
    return which if len(which) <= most else which[:0]


def _named(effect, which, size, half):
    """The effect, its theta and {electrode: (low, high)} of 95 %, of some electrodes."""
    sure = {f"e{k + 1}": (float(size[k] - half[k]), float(size[k] + half[k])) for k in which}
    return effect, effect.default() | {f"e{k + 1}": float(size[k]) for k in which}, sure


def narrowed(comparison: "Comparison", fit: "Fit", effect: "Effect", chosen: np.ndarray) -> "Effect":
    """The effect with the electrodes that stand out beside `fit`, or as it is where none or many do, or where
    it is not of single electrodes."""
    if not effect.per_channel or any(e.id in effect.confusable for e, _ in fit.effects):
        return effect  # what the law of one like it lacks stands out, too
    # What a pose may be off by moves all electrodes.
    n = comparison.nelectrode
    residual = [r[:, :n] for r in fit.posed(comparison)]
    parts = zip(comparison.measured, fit.raw(comparison), comparison.sigmas)
    change = [(m - r)[:, :n] / s[:n] for m, r, s in parts]  # what each electrode should have shown
    found = set()
    for trend in effect.trends(change, [t.clock + t.time for t in comparison.trajectories]):
        found |= _following(residual, trend, chosen)
    return effect.only([f"e{k + 1}" for k in sorted(found)]) if 0 < len(found) <= _FEW else effect


def _following(residual, trend, chosen):
    """Electrodes whose weight on the course is another than the others'."""
    weights, gains = np.zeros(residual[0].shape[1]), []
    for k in range(len(weights)):
        x = [trend[i][:, k] for i in chosen]
        y = [residual[i][:, k] for i in chosen]
        doubt = [np.sqrt(1 + (_OFF * b) ** 2) for b in x]
        x, y = ([a / d for a, d in zip(one, doubt)] for one in (x, y))
        held, weights[k] = predicted_by(y, [b[:, None] for b in x])
        gains.append(held - predicted_by(y, [0.0 * b[:, None] for b in x])[0])
    away = np.abs(weights - np.median(weights))
    far = away > _APART * _ROBUST * np.median(away)
    return {k for k, gain in enumerate(gains) if far[k] and supported(gain, _OWN, _OWN_CHANCE)}


def standing(other: np.ndarray) -> tuple[np.ndarray, float]:
    """Baselines that deviate from the model's, by differences (nelectrode,) about their median [counts]: a
    mask, empty if many do, and the threshold."""
    limit = max(_FAR * _ROBUST * np.median(np.abs(other)), _LEAST)
    return _few(np.abs(other) > limit, _FEW_OFFSETS), limit


def offsets(comparison: "Comparison", fit: "Fit", chosen: np.ndarray) -> tuple[Offset, dict, dict] | None:
    """The effect, its theta and {electrode: (low, high)} of 95 % by trajectory, or None.

    Rests are set beside those of the model with the effects of `fit`, and the difference of one electrode
    beside those of the others: a sensor whose rests are simply other ones has large differences everywhere,
    and none stands out."""
    runs = comparison.sim.run(
        comparison.trajectories,
        comparison.fields,
        False,
        [*comparison.sim.effects, *fit.effects],
        nuisance=fit.nuisance,
    )
    off = np.array([comparison.trajectories[i].electrodes[0] - runs[i].counts[0] for i in chosen])
    off = off + comparison.rest_apart
    # Of one that began within the session some trajectories know nothing.
    middle = np.median(off, axis=0)
    error = _OF_MEDIAN * np.median(np.abs(off - middle), axis=0) / np.sqrt(len(chosen))
    other = middle - np.median(middle)
    limit = standing(other)[1]
    other[[k for effect, theta in fit.effects for k in effect.unsearched(theta)]] = 0.0
    away = _few(np.abs(other) > limit, _FEW_OFFSETS)
    # where the trajectories do not agree it is no offset
    if not len(away) or (np.abs(other[away]) < 5 * error[away]).any():
        return None
    return _named(Offset().on(comparison.sim.design), away, other, 1.96 * error)


def noisy_electrodes(
    trajectories: list[Trajectory], forces: list[np.ndarray], values: list[np.ndarray] | None = None
) -> tuple[Noise, dict, dict] | None:
    """The effect, its theta [counts RMS] and {electrode: (low, high)} of 95 %, or None.

    By rows in which the object stands still, and by those without touch alone: what only touch stirs is
    another matter. By the later half of such rows, too: what is late comes to rest after the object, and a
    latency is no noise. An electrode's share of the noise that all have is taken off by the law of its
    counts.

    Args:
      forces: (n, 3) of the base model, which tell the touch. values: (n, nelectrode) what scatters, in
        place of the
        counts: what a fit leaves of them.
    """
    values = [t.electrodes for t in trajectories] if values is None else values
    steps, late = (
        [
            np.concatenate(
                [still_differences(x, t, lag, only) for x, t, only in zip(values, trajectories, o)]
            )
            for lag in range(1, _LAGS + 1)
        ]
        for o in ([None] * len(values), [settled(t) for t in trajectories])
    )
    apart = [_untouched(x, f) for x, f in zip(values, forces)]
    rows, free = len(steps[0]), sum(map(len, apart))
    if rows < _FEWEST or free < _FEWEST // 4 or not any(map(len, late)):  # never long enough at rest
        return None
    rms = np.minimum(*(np.max([_rms(one) for one in ones if len(one)], axis=0) for ones in (steps, late)))
    law = electrode_noise(np.mean([t.electrodes[0] for t in trajectories], axis=0))
    own = np.median(rms / law)
    noisy = (rms > _RATIO * own * law) & (rms > _LEAST_NOISE)
    alone = _rms(np.concatenate(apart))
    away = _few(noisy & (alone > _FREE * np.median(alone / law) * law), _FEW_NOISY)
    if not len(away):
        return None
    more = np.sqrt(np.maximum(rms**2 - (own * law) ** 2, 0.0))
    half = 1.96 / np.sqrt(2 * rows / _LAGS)  # of a standard deviation, of rows that know of each other
    return _named(Noise(), away, more, half * more)


def _untouched(electrodes, force):
    """(k, nelectrode) steps between rows without touch, before it and after."""
    free = np.linalg.norm(force, axis=1) < _TOUCH
    return np.diff(electrodes, axis=0)[free[1:] & free[:-1]]


def _rms(steps):
    """(nelectrode,) RMS of what differs by these steps [(n, nelectrode)]; spikes and colour are in it."""
    return np.sqrt((steps**2).mean(0) / 2)


def jumping(comparison: "Comparison", fit: "Fit") -> list[str]:
    """Names of electrodes whose residuals jump and come back in most contacts, the worst one first; none
    where many do."""
    raw, second, n = fit.raw(comparison), [], comparison.nelectrode
    for residual, sigma in zip(raw, comparison.sigmas):
        steps = np.abs(np.diff(residual[:, :n] / sigma[:n], axis=0)) / np.sqrt(2)
        if len(steps) > 1:
            second.append(np.sort(steps, axis=0)[-2])
    if not second:
        return []
    size = np.median(second, axis=0)
    which = _few((size > _STEP) & (size > _STEP_MORE * np.median(size)), _FEW_JUMPS)
    return [f"e{k + 1}" for k in which[np.argsort(-size[which])]]
