"""Force from electrodes, causal: nothing later than the row that is predicted, and nothing of the test part,
is ever used.

ln Z of the 19 electrodes, with or without their mean, which warm-up moves, causal averages of it, products of
its first principal components or random waves go into ridge regressions. The sensor's warm-up, which a
recording cannot tell from slow creep, goes in as 1 - exp(-t / tau), with its own weight for each force
component; late rows may count more than early ones. Which of these, and how strong the ridge, is chosen for
every component by walk-forward trials inside the training part, each kind by itself; the kinds' weighted mean
predicts."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from ...sensor.channels import log_impedance
from .terms import Terms

__all__ = ["TRIALS", "ForceModel", "causal_average", "fit_force", "ridge", "shared_gain", "walk_forward"]

# arguments of `Terms.fit` and ridges that go with them
_TERMS = (
    *(({"products": products}, (1e-5, 1e-4, 1e-3, 1e-2)) for products in (0, 3, 5)),
    *(({"length": length}, (1e-3, 1e-2, 1e-1)) for length in (1.0, 2.0)),
)
_WARM_UP = (None, 1.0, 5.0)  # time constants, in lengths of the training part
_RECENT = (None, 0.5, 0.25)  # how fast rows are forgotten: so too
_WINDOWS = (3, 10)  # time constants of the causal averages [rows]
_POWER = 4  # kinds count as this power of the inverse of their error
_EXACT = 1e-9  # [N]: an error below is none, as of a component that does not change


def causal_average(x: np.ndarray, tau: float) -> np.ndarray:
    """Exponential average of x (n, k) over the past, time constant tau [rows]; it starts at the first row."""
    a = 1 - np.exp(-1 / tau)
    return lfilter([a], [1, a - 1], x, axis=0, zi=x[:1] * (1 - a))[0]


def walk_forward(
    n: int, folds: int = 4, first: float = 0.4, ahead: float = 3 / 7
) -> list[tuple[slice, slice]]:
    """(train, test) slices of 0..n-1: each test piece lies right after all the rows that train for it, and is
    as long as the last 30 % are beside the first 70 %, or shorter at the end."""
    stop = np.rint(np.linspace(first, 1, folds + 1)[:-1] * n).astype(int).tolist()
    return [(slice(0, a), slice(a, min(n, round((1 + ahead) * a)))) for a in stop]


@dataclasses.dataclass(frozen=True, eq=False)
class _Moments:
    """Of weighted rows, all that ridges on some of their columns need."""

    mean: np.ndarray
    scale: np.ndarray
    inner: np.ndarray
    cross: np.ndarray
    target: np.ndarray

    @classmethod
    def of(cls, x, y, weight=None):
        weight = np.full(len(x), 1 / len(x)) if weight is None else weight / weight.sum()
        mean, target = weight @ x, weight @ y
        scale = np.sqrt(weight @ (x - mean) ** 2)
        scale = np.where(scale > 1e-9, scale, np.inf)  # a feature that is constant gets no weight
        a = (x - mean) / scale
        heavy = (a * weight[:, None]).T
        return cls(mean, scale, heavy @ a, heavy @ (y - target), target)

    def solve(self, strength, columns=None):
        """Weights (k, m), zero of all but `columns`, and offset (m,)."""
        some = np.arange(len(self.mean)) if columns is None else columns
        weight = np.zeros_like(self.cross)
        square = self.inner[np.ix_(some, some)] + strength * np.eye(len(some))
        weight[some] = np.linalg.solve(square, self.cross[some]) / self.scale[some, None]
        return weight, self.target - self.mean @ weight


def ridge(x: np.ndarray, y: np.ndarray, strength: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights (k, m) and offset (m,) that minimise |y - x w - b|^2 / n + strength * |std(x) w|^2; x (n, k), y
    (n, m)."""
    return _Moments.of(x, y).solve(strength)


def shared_gain(log_z: np.ndarray, force: np.ndarray, tau: float) -> float:
    """Amplitude a of the gain a (1 - exp(-t / tau)) that all electrodes have in common in ln Z besides what
    the force explains.

    Args:
      log_z: (n, 19); force: (n, 3) [N]; tau: [rows].
    """
    i, j = np.triu_indices(3)
    explained = np.linalg.qr(np.column_stack([np.ones(len(force)), force, force[:, i] * force[:, j]]))[0]
    rise = 1 - np.exp(-np.arange(len(force)) / tau)
    rise_left = rise - explained @ (explained.T @ rise)
    left = log_z - explained @ (explained.T @ log_z)
    each = rise_left @ left / (rise_left @ rise_left)
    weight = 1 / np.maximum((left - rise_left[:, None] * each).var(0), 1e-8)
    return float(weight @ each / weight.sum())


@dataclasses.dataclass(frozen=True)
class _Group:
    """Regressions on the same columns and rows; a candidate is one of them with a warm-up and a ridge."""

    products: int = 0
    length: float = 0.0
    common: bool = False
    recent: float | None = None
    ridges: tuple = ()

    @property
    def kind(self):
        return self.products, self.length, self.common

    @property
    def members(self):
        return list(itertools.product((self,), _WARM_UP, self.ridges))

    def columns(self, log_z, part):
        """All rows' features, a column for each warm-up the last; what has to be fitted is fitted on the rows
        of `part`."""
        terms = Terms.fit(log_z[part], self.products, self.common, self.length)(log_z)
        averages = [causal_average(terms[:, : log_z.shape[1]], tau) for tau in _WINDOWS]
        rows = np.arange(len(log_z))[:, None] / part.stop
        return np.hstack([terms, *averages, *(1 - np.exp(-rows / tau) for tau in _WARM_UP if tau)])

    def predictions(self, log_z, force, part, members):
        """Of each of `members`, fitted on the rows of `part`: (n, 3)."""
        x = self.columns(log_z, part)
        age = 1 - np.arange(part.stop) / part.stop
        moments = _Moments.of(x[part], force[part], np.exp(-age / self.recent) if self.recent else None)
        warm = [tau for tau in _WARM_UP if tau]
        plain = x.shape[1] - len(warm)
        for _, tau, strength in members:
            some = [*range(plain), *([plain + warm.index(tau)] if tau else [])]
            weight, offset = moments.solve(strength, np.array(some))
            yield x @ weight + offset


def _text(group, warm_up, strength):
    words = ["ln Z", f"averages over {', '.join(map(str, _WINDOWS))} rows"]
    if group.products:
        words.append(f"products of {group.products} components")
    if group.length:
        words.append(f"waves of length {group.length:g}")
    if group.common:
        words.append("common mode out")
    if warm_up:
        words.append(f"warm-up tau {warm_up:g} n")
    if group.recent:
        words.append(f"rows forgotten in {group.recent:g} n")
    return f"{' + '.join(words)}; ridge {strength:g}"


_GROUPS = [
    _Group(**terms, common=common, recent=recent, ridges=ridges)
    for (terms, ridges), common, recent in itertools.product(_TERMS, (False, True), _RECENT)
]
TRIALS = len(_GROUPS)  # what `progress` of `fit_force` is called for


@dataclasses.dataclass(frozen=True, eq=False)
class ForceModel:
    """Force from the counts up to each row; made by `fit_force`.

    Attributes:
      prediction: (n, 3) [N].
      chosen: for x, y, z, descriptions of the candidates whose weighted mean predicts.
      trials: RMSE [N] of that mean on the rows of the walk-forward trials, the late ones counting more, for
        x, y, z.
      gain: that all electrodes have in common in ln Z at the end besides what the force explains.
    """

    prediction: np.ndarray
    chosen: list[list[str]]
    trials: list[float]
    gain: float


def fit_force(
    counts: np.ndarray, force: np.ndarray, ntrain: int, progress: Callable[[], object] | None = None
) -> ForceModel:
    """Fits on rows 0..ntrain-1 and predicts every row.

    Args:
      counts: (n, 19); force: (n, 3) [N], of which only the first ntrain rows are read.
      progress: called TRIALS times.
    """
    log_z = log_impedance(counts)
    force = force[:ntrain]
    folds = walk_forward(ntrain)
    late = np.arange(1, len(folds) + 1) ** 2  # a late trial is more like what comes after the training part

    def judged(predictions):
        """(candidates, 3)"""
        errors = [
            [np.sqrt(((y[test] - force[test]) ** 2).mean(0)) for y in predictions(log_z[: test.stop], train)]
            for train, test in folds
        ]
        return np.average(errors, axis=0, weights=late)

    error = {}
    for group in _GROUPS:
        found = judged(lambda rows, part: group.predictions(rows, force, part, group.members))  # noqa: B023
        error |= dict(zip(group.members, found))
        if progress:
            progress()
    best = [_best({c: e[k] for c, e in error.items()}) for k in range(3)]
    trials = judged(lambda rows, part: [_mean_of(best, rows, force, part)])[0]
    gain = shared_gain(log_z[:ntrain], force, 1.5 * ntrain) * (1 - np.exp(-len(log_z) / (1.5 * ntrain)))
    prediction = _mean_of(best, log_z, force, slice(0, ntrain))
    return ForceModel(prediction, [[_text(*c) for c in cs] for cs in best], trials.tolist(), gain)


def _best(error):
    """{candidate: weight} for one component of the force: the best of each kind, as a power of the inverse of
    its error in the trials. Their mean is steadier than any of them where something new comes."""
    winners = {}
    for c in sorted(error, key=error.get):
        winners.setdefault(c[0].kind, c)
    weight = np.array([max(error[c], _EXACT) ** -float(_POWER) for c in winners.values()])
    return dict(zip(winners.values(), weight / weight.sum()))


def _mean_of(best, log_z, force, part):
    """(n, 3): weighted mean of each component's chosen candidates, fitted on the rows of `part`."""
    out = np.zeros((len(log_z), 3))
    for group in _GROUPS:
        members = [c for c in group.members if any(c in chosen for chosen in best)]
        if members:
            for c, y in zip(members, group.predictions(log_z, force, part, members)):
                out += y * [chosen.get(c, 0.0) for chosen in best]
    return out
