"""Likelihood of data under a model that is nearly right.

The residual, measured less predicted, is the sum of noise, the error of every trial's pose, errors of the
effects' laws, and the model's discrepancy: a Gaussian process per channel over place, depth, time since touch
and the session's clock (Kennedy and O'Hagan 2001). In the eigenvectors of its kernel noise and process are
diagonal, whatever the process's amplitude, which is a parameter with a prior as all others are.

The true law of an effect differs from the catalogue's: its contribution is the catalogue's times one plus a
Gaussian process over depth, time since touch and the session's clock, the same for all channels. The standard
deviation of this process is the effect's law error, one parameter with a prior whose median is
`SETTINGS.law`.
"""

import typing

import numpy as np

from .settings import SETTINGS

if typing.TYPE_CHECKING:
    from .trajectory import Trajectory
    from .whitening import Comparison

_ROWS = 1500  # of all trajectories, that eigenvectors are computed of; of more, some are left out
# Lengths over which what a model misses changes: across the skin (a contact's radius), in depth, in heading,
# in the logarithm of the time since touch, in the session.
_PLACE, _DEPTH, _HEADING, _SINCE, _CLOCK = 3e-3, 0.4e-3, 0.5, 0.7, 60.0
# Shares of the variance that come again wherever the same is touched as deep; that pass with the touch; that
# have no length, as of films that touch and part; and that go with the session's clock alone, touched or not.
_STATIC, _PASSING, _ROUGH, _DRIFTING = 0.6, 0.25, 0.05, 0.1
_OTHER_TOOL = 0.7  # correlation between tools
_UNTOUCHED = 0.03  # of what is missed under the deepest press, in air
_TOUCH = 20e-6  # [m]
# Amplitudes that are tried, in what is expected: data of one sensor at some places do not show that the model
# is much better than it was found to be elsewhere.
_FACTORS = np.exp(np.arange(-0.4, 4.01, 0.4))
_LAW_FACTORS = np.exp(np.arange(-1.2, 1.61, 0.2))  # of law errors, in their prior's median
ERROR_MODES = 24  # along which the law of an effect may be another
_LAW_PLACE = 10e-3  # [m] along the finger, over which a law is nearly the same


def kernel(data: "list[Trajectory]", rows: list[np.ndarray]) -> np.ndarray:
    """(n, n) covariance of what a model misses, 1 under the deepest press; rows: of each trajectory, whose
    `time`, `clock`, `pos`, `mat`, `depth` and `tool` count."""

    def gathered(of):
        return _gathered(data, rows, of)

    depth = gathered(lambda t: t.depth)
    place = _distances(gathered(lambda t: t.pos), _PLACE) + _distances(depth, _DEPTH)
    heading = _distances(gathered(lambda t: t.mat[:, :, 1]), _HEADING)
    since = _distances(gathered(_since_touch), _SINCE)
    clock = _distances(gathered(lambda t: t.clock + t.time), _CLOCK)
    static = np.exp(-0.5 * (place + heading)) * _same_tool(data, rows)
    passing = np.exp(-0.5 * (place + since + clock))
    load = _UNTOUCHED + np.clip(depth / max(depth.max(), 1e-9), 0.0, 1.0)
    rough = _ROUGH * np.eye(len(load))
    touched = (_STATIC * static + _PASSING * passing + rough) * load[:, None] * load
    return touched + _DRIFTING * np.exp(-0.5 * clock)


def error_modes(data: "list[Trajectory]", rows: list[np.ndarray]) -> np.ndarray:
    """(k, n) functions of depth, time since touch, the session's clock, place and tool whose sum with
    coefficients of unit variance is the process of a law's error."""
    away = _distances(_gathered(data, rows, lambda t: t.depth), _DEPTH)
    away += _distances(_gathered(data, rows, _since_touch), _SINCE)
    away += _distances(_gathered(data, rows, lambda t: t.clock + t.time), _CLOCK)
    away += _distances(_gathered(data, rows, lambda t: t.pos), _LAW_PLACE)
    values, vectors = np.linalg.eigh(_same_tool(data, rows) * np.exp(-0.5 * away))
    return (np.sqrt(np.maximum(values, 0.0)) * vectors).T[: -ERROR_MODES - 1 : -1]


def _same_tool(data, rows):
    """(n, n) correlation of rows by their tools."""
    tool = _gathered(data, rows, lambda t: np.full(len(t.time), t.tool))
    return np.where(tool[:, None] == tool, 1.0, _OTHER_TOOL)


def _gathered(data, rows, of):
    return np.concatenate([np.asarray(of(t))[r] for t, r in zip(data, rows)])


def _distances(x, length):
    """(n, n) squared distances of x (n, ...) over a length."""
    x = x.reshape(len(x), -1) / length
    square = (x**2).sum(1)
    return np.maximum(square[:, None] + square - 2 * x @ x.T, 0.0)


def _since_touch(t):
    return np.log1p(np.maximum(t.time - t.time[np.argmax(t.depth > _TOUCH)], 0.0) / 0.1)


class Likelihood:
    """Likelihood of residuals (n, width) of rows under a model that is nearly right.

    Attributes:
      groups: slices of channels whose errors have something in common. noise: (width,) its standard deviation
        [counts, N]. error_modes: (k, n) of errors of laws. size: (width,) expected error of the base model
        [counts, N] under the deepest press.
    """

    def __init__(
        self,
        covariance: np.ndarray,
        error_modes: np.ndarray,
        noise: np.ndarray,
        groups: list[slice],
        largest: np.ndarray,
    ):
        """covariance: (n, n) of what the model misses, 1 under the deepest press; largest: (width,) change of
        each channel."""
        values, vectors = np.linalg.eigh(covariance)
        self._scale, self._vectors = np.maximum(values, 0.0), vectors
        self.error_modes, self.noise, self.groups = error_modes, noise, groups
        self.size = np.concatenate(
            [np.full(s.stop - s.start, SETTINGS.resolution * _upper(largest[s])) for s in groups]
        )

    def turned(self, values: np.ndarray) -> np.ndarray:
        """(..., n, width) in the kernel's eigenvectors, all by one product."""
        return np.moveaxis(np.tensordot(self._vectors, values, (0, -2)), 0, -2)

    def times(self, process: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Values (n, width) in the eigenvectors times a process (n,) over rows."""
        return self._vectors.T @ (process[:, None] * (self._vectors @ values))

    def laws(self, changes: list[np.ndarray], errors: np.ndarray) -> np.ndarray:
        """(m, n, width) what errors of laws do, of one standard deviation each, in the eigenvectors; changes:
        (n, width) what each effect does, errors (effects,): of its law."""
        out = [e * change * mode[:, None] for change, e in zip(changes, errors) for mode in self.error_modes]
        return self.turned(np.reshape(out, (-1, len(self.error_modes[0]), len(self.size))))

    def law_errors(
        self, errors: np.ndarray, weights: np.ndarray, factor: np.ndarray, begin: int
    ) -> np.ndarray:
        """(effects,) most probable errors of laws, by what `evidence` gave with errors (effects,): weights
        (m,) and the factor of their precision, those of laws from `begin` on."""
        rows = slice(begin, begin + len(errors) * ERROR_MODES)
        expected = weights[rows] ** 2 + (np.linalg.inv(factor)[:, rows] ** 2).sum(0)
        square = errors[:, None] ** 2 * expected.reshape(len(errors), ERROR_MODES)
        log = np.log(SETTINGS.law * _LAW_FACTORS)
        fits = -ERROR_MODES * log - 0.5 * square.sum(1)[:, None] * np.exp(-2 * log)
        return np.exp(log[(fits + _law_prior(log)).argmax(1)])

    def variance(self, amplitude: np.ndarray, size: np.ndarray) -> np.ndarray:
        """(n, width) of noise and of what is missed."""
        return self.noise**2 + (amplitude * size) ** 2 * self._scale[:, None]

    def evidence(
        self, y: np.ndarray, columns: np.ndarray, variance: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """log density of y (n, width), in the eigenvectors, with coefficients of unit variance on columns
        (m, n, width); their most probable values (m,) and the Cholesky factor of their precision."""
        white = 1 / np.sqrt(variance)
        flat, y = (columns * white).reshape(len(columns), -1), (y * white).ravel()
        factor = np.linalg.cholesky(np.eye(len(flat)) + flat @ flat.T)
        pull = np.linalg.solve(factor, flat @ y)
        log = -0.5 * (y @ y - pull @ pull) - np.log(np.diag(factor)).sum() + np.log(white).sum()
        return float(log), np.linalg.solve(factor.T, pull), factor

    def prior(self, amplitude: np.ndarray, law_errors: np.ndarray) -> float:
        """log density of amplitudes (width,), of which those of a group have something in common, and of
        errors of laws (effects,)."""
        out = _law_prior(np.log(law_errors)).sum()
        for group in self.groups:
            log = np.log(amplitude[group])
            covariance = SETTINGS.own**2 * np.eye(len(log)) + SETTINGS.spread**2
            out -= 0.5 * log @ np.linalg.solve(covariance, log)
        return float(out)

    def amplitudes(
        self, y: np.ndarray, columns: np.ndarray, begin: np.ndarray, size: np.ndarray, rounds: int = 2
    ) -> np.ndarray:
        """(width,) most probable amplitudes, the coefficients of `columns` marginalised."""
        amplitude = begin
        for _ in range(rounds):
            _, weights, factor = self.evidence(y, columns, self.variance(amplitude, size))
            spread = np.linalg.inv(factor) @ columns.reshape(len(columns), -1)
            square = (y - np.tensordot(weights, columns, 1)) ** 2 + (spread**2).sum(0).reshape(y.shape)
            new = self.amplitude_of(square, size)
            if np.array_equal(new, amplitude):
                break
            amplitude = new
        return amplitude

    def amplitude_of(self, square: np.ndarray, size: np.ndarray) -> np.ndarray:
        """(width,) that fit expected squares (n, width) best."""
        log, out = np.log(_FACTORS), np.ones(len(size))
        table = np.empty((len(log), len(size)))
        for k, factor in enumerate(_FACTORS):
            variance = self.variance(np.full(len(size), factor), size)
            table[k] = -0.5 * (square / variance + np.log(variance)).sum(0)
        for group in self.groups:
            best = -np.inf
            for middle in log:
                each = table[:, group] - 0.5 * ((log[:, None] - middle) / SETTINGS.own) ** 2
                value = each.max(0).sum() - 0.5 * (middle / SETTINGS.spread) ** 2
                if value > best:
                    best, out[group] = value, _FACTORS[each.argmax(0)]
        return out


class TrajectoryLikelihood(Likelihood):
    """Likelihood of some trajectories of a Comparison.

    Attributes:
      chosen: their indices; independent: of these, those in which what the model misses is not known by the
        others, as what the laws of effects lack is.
    """

    def __init__(self, comparison: "Comparison", chosen: np.ndarray, independent: np.ndarray = ()):
        self.comparison, self.chosen = comparison, np.asarray(chosen)
        data = [comparison.trajectories[i] for i in self.chosen]
        every = max(1, int(np.ceil(sum(len(t.time) for t in data) / _ROWS)))
        self._rows = [np.arange(0, len(t.time), every) for t in data]
        side = np.repeat(np.isin(self.chosen, independent), [len(r) for r in self._rows])
        self._resting = np.ones(comparison.width)  # force has no rest
        self._resting[comparison.groups.get("force", slice(0))] = 0.0
        super().__init__(
            kernel(data, self._rows) * (side[:, None] == side),
            error_modes(data, self._rows),
            comparison.noises,
            list(comparison.groups.values()),
            np.abs(self.stacked(comparison.measured)).max(0),
        )

    def stacked(self, values: list) -> np.ndarray:
        """(n, width) of values (rows, width) of every trajectory, the chosen ones one after another, about
        their own mean rest: the poses of others, whose row 0 may touch, are not fitted."""
        rest = self._resting * np.mean([values[i][0] for i in self.chosen], axis=0)
        return np.concatenate([values[i][r] - rest for i, r in zip(self.chosen, self._rows)])

    def poses(self, offsets: np.ndarray) -> np.ndarray:
        """Changes of the residual (m, n, width), in the eigenvectors, by pose errors of one standard
        deviation: three for each trajectory, about its offset in `offsets` (trajectories, 3) [m]. Their mean
        is left out: an offset of all trajectories is a finding, not an error."""
        out, edges = [], np.concatenate([[0], np.cumsum([len(r) for r in self._rows])])
        total = self._vectors.sum(0)
        for k, (i, rows) in enumerate(zip(self.chosen, self._rows)):
            own = self._vectors[edges[k] : edges[k + 1]].T  # of all other rows the rest alone moves
            for column in self.comparison.moved(i, offsets[i]):
                rest = self._resting * column[0] / len(self.chosen)
                out.append(own @ column[rows] - np.outer(total, rest))
        return self.comparison.repeatability * np.array(out)


def of(comparison: "Comparison", chosen: np.ndarray, independent: np.ndarray = ()) -> TrajectoryLikelihood:
    """The Likelihood of the chosen trajectories of a Comparison, which keeps it."""
    key = tuple(map(int, chosen)), tuple(map(int, independent))
    if key not in comparison.likelihoods:
        comparison.likelihoods[key] = TrajectoryLikelihood(comparison, chosen, independent)
    return comparison.likelihoods[key]


def _law_prior(log):
    """log density of logarithms of law errors."""
    return -0.5 * ((log - np.log(SETTINGS.law)) / SETTINGS.own) ** 2


def _upper(x):
    """Mean of the upper third of a group's channels: the others hardly feel it."""
    return float(np.sort(x)[-max(1, len(x) // 3) :].mean())
