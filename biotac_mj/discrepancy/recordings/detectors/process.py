"""Change of one electrode over time under load, by a Gaussian process of the other electrodes and of time.

An electrode is the sum of a linear map of the others, a smooth function of the load's place (their principal
components), a memory of about a second, and noise. These return to the same value with the same load; a
drift, a smooth function of time, does not. The amplitudes maximise the likelihood of the whole recording
(type II maximum likelihood; Rasmussen and Williams 2006, 5.4), so that no rows have to be left out, and the
evidence of the drift is the gain in log-likelihood."""

import functools

import numpy as np
from scipy.linalg import lapack

from ..conditional import Components
from ..model import Model
from .trends import BLOCKS, Trend

_CELLS = 250  # of time, at most
_FEWEST = 60
_AXES = np.array([1, 0.8, 0.6, 0.5, 0.4, 0.3])  # weights of principal components, where a load is
_LEAST_AXIS = 0.02  # of the first component, what weight a further one has in a linear map at least
# amplitudes tried, over the electrode's variance: a linear map; a function of the load's place and its length
# scale [standard deviations of the first component]; memory; a trend over time
_LINEAR = (1.0, 10.0)
_CURVED = ((0.0, 1.0), (0.03, 1.0), (0.3, 1.0), (0.1, 2.0), (1.0, 2.0))
_MEMORY, _SECONDS = (0.001, 0.01), 1.5
_DRIFT, _SMOOTH = (0.003, 0.03, 0.3), 0.2  # and its time scale, as a fraction of the recording
_LOADS = (0.05, 0.25, 0.75, 0.95)  # quantiles of the prediction about which a gain may change
_NOISE = 0.001
_LEVEL = 10.0
_FASTER = (1, 9, 36, 144)  # squares of how much faster a trend may change
_KNOTS = 81


class Process:
    """Each used electrode of a model as a Gaussian process over all its bins. drifting: numbers of electrodes
    that do not predict others."""

    def __init__(self, model: Model, drifting: frozenset = frozenset()):
        self._silent = np.isin(model.used, list(drifting))
        span = -(-len(model.time) // _CELLS)
        n = len(model.time) // span
        x = model.value[: n * span].reshape(n, span, -1).mean(1)
        self._time = model.time[: n * span].reshape(n, span).mean(1)
        self._model, self._span, self._x = model, span, x - x.mean(0)
        distance = np.abs(self._time[:, None] - self._time)
        self._memory = np.exp(-distance / _SECONDS)
        self._smooth = np.exp(-0.5 * (distance / (_SMOOTH * np.ptp(self._time))) ** 2)
        self._fits: dict[int, tuple] = {}

    def nats(self, i: int) -> float:
        """Gain in log-likelihood of used electrode i by a smooth trend over time."""
        return self._of(i)[0]

    def answers(self, i: int) -> float:
        """Gain in log-likelihood [nats] by a gain that changes over time, about the load where it is largest:
        a gain moves levels, too."""
        nats, without, y, _, _, K, load = self._of(i)
        said, best = load @ np.linalg.solve(K, y), -np.inf
        for middle in (0.0, *np.quantile(said, _LOADS)):
            both = np.outer(said - middle, said - middle) * self._smooth
            best = max(best, *(_log_likelihood(K + a * both, y) for a in _DRIFT))
        return best - without

    def _of(self, i):
        if i not in self._fits:
            self._fits[i] = self._fit(i)
        return self._fits[i]

    def _fit(self, i):
        """Nats of a trend, logarithm of the likelihood without it; electrode (n,) in standard deviations;
        what one is [ln Z]; amount of the trend; covariance without it, and of the load's part."""
        telling = ~self._silent & (np.arange(self._x.shape[1]) != i)
        others, y, noise = self._x[:, telling], self._x[:, i], self._model.noise
        load = Components(others / noise[telling])
        score = load.scores(others / noise[telling])
        each = score * np.maximum(load.size / load.size[0], _LEAST_AXIS)
        linear = each @ each.T
        place = score[:, : len(_AXES)] * _AXES[: score.shape[1]]
        square = (place**2).sum(1)
        away = np.maximum(square[:, None] + square - 2 * place @ place.T, 0)
        scale = max(float(y.std()), 1e-9)
        y = y / scale
        base = (noise[i] / scale) ** 2 / self._span + _NOISE
        base = max(base, 1e-5) * np.eye(len(y)) + _LEVEL
        best = None
        for amount, far in _CURVED:
            curved = amount * np.exp(-0.5 * away / far**2) + base if amount else base
            for slope in _LINEAR:
                for memory in _MEMORY:
                    K = slope * linear + curved + memory * self._memory
                    nats = _log_likelihood(K, y)
                    if best is None or nats > best[0]:
                        best = nats, K, slope * linear + curved - base
        without, K, load = best
        drift = [_log_likelihood(K + a * self._smooth, y) for a in _DRIFT]
        return max(drift) - without, without, y, scale, _DRIFT[int(np.argmax(drift))], K, load

    def trend(self, i: int) -> Trend:
        """Change of used electrode i over time [ln Z], from the fitted bins alone. Its overall gain is
        predicted block by block, each from the earlier ones."""
        _, _, y, scale, amount, K, _ = self._of(i)
        both = K + amount * self._smooth
        n = max(2, int((self._time <= self._model.time[self._model.inside][-1]).sum()))
        # the fitted bins choose how fast it changes
        shapes = [a * self._smooth[:n, :n] ** q for q in _FASTER for a in (amount, 10 * amount)]
        shape = max(shapes, key=lambda k: _log_likelihood(K[:n, :n] + k, y[:n]))
        values = scale * shape @ np.linalg.solve(K[:n, :n] + shape, y[:n])
        knots = np.linspace(self._time[0], self._time[n - 1], _KNOTS)
        values = np.interp(knots, self._time[:n], values)
        block = np.arange(len(y)) * BLOCKS // len(y)
        gain = np.bincount(block, _log_predictive(both, y) - _log_predictive(K, y))
        p = min(1.0, self._x.shape[1] * float(np.exp(-gain.sum())))  # Markov, of all electrodes tried
        return Trend("smooth", np.nan, knots, values - values.mean(), 0.0, gain, p)


def _log_likelihood(K, y):
    """Logarithm of the likelihood of y (n,) for a covariance K (n, n) times the factor that fits best."""
    return float(_log_predictive(K, y).sum())


def _log_predictive(K, y):
    """(n,) logarithms of the predictive density of each value of y (n,), given those before."""
    L, failed = lapack.dpotrf(K.T, lower=1, clean=0)  # in Fortran's order, which takes half of the time
    if failed:
        raise np.linalg.LinAlgError("covariance is not positive definite")
    e = lapack.dtrtrs(L, y, lower=1)[0]
    scale = max(float(e @ e) / len(y), 1e-9)
    return -0.5 * (e**2 / scale + np.log(scale)) - np.log(np.diag(L)) + 0.5


@functools.lru_cache(maxsize=2)
def process(model: Model, drifting: frozenset = frozenset()) -> Process | None:
    """None where nothing moves, or of too few electrodes or rows."""
    if not model.moved or len(model.time) < _FEWEST or len(model.used) - len(drifting) < 7:
        return None
    return Process(model, drifting)
