"""Causal force estimation from electrodes: a prediction uses neither later rows nor the test rows.

ln Z of the 19 electrodes, its causal averages and products of its first principal components are features of
ridge regressions. A recording cannot separate the sensor's warm-up from slow creep, so warm-up is a further
feature 1 - exp(-t / tau): with a weight for each force component, or as one gain common to all electrodes
that is removed from ln Z. Features and ridge are selected for each component by walk-forward validation
inside the training rows. Further candidates are regressions without the mean over the electrodes, which
warm-up changes, and on random Fourier features. A small network then learns the residual of the ridge, and is
used if it helps in validation."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from ...sensor.channels import counts_from_log_impedance, log_impedance
from .linear import ridge, ridges
from .terms import Terms

__all__ = ["TRIALS", "ForceModel", "causal_average", "fit_force", "shared_gain", "walk_forward"]

_WARM_UP = (None, 0.5, 1.0, 1.5, 2.5, 5.0)  # time constants, in lengths of the training rows
_PRODUCTS = (0, 3, 5)  # number of principal components whose products are features
_RIDGE = (1e-5, 1e-4, 1e-3, 1e-2)
_EXACT = 1e-9  # [N]: smaller errors are zero, as for a constant component
_WINDOWS = ((), (3, 10))  # time constants of the causal averages [rows]
_WAVES = ((0.5, 1.0, 2.0), (1e-3, 1e-2, 1e-1))  # length scales and ridges of `Terms` with random features


def causal_average(x: np.ndarray, tau: float) -> np.ndarray:
    """Exponential average of x (n, k) over the past with time constant tau [rows], starting at the first
    row."""
    a = 1 - np.exp(-1 / tau)
    return lfilter([a], [1, a - 1], x, axis=0, zi=x[:1] * (1 - a))[0]


def walk_forward(n: int, folds: int = 4, first: float = 0.4) -> list[tuple[slice, slice]]:
    """(train, test) slices of 0..n-1: each test block follows all the rows that train for it."""
    # like scikit-learn's TimeSeriesSplit, but slices of rows copy nothing
    edge = np.rint(np.linspace(first, 1, folds + 1) * n).astype(int)
    return [(slice(0, int(a)), slice(int(a), int(b))) for a, b in zip(edge[:-1], edge[1:])]


def shared_gain(log_z: np.ndarray, force: np.ndarray, tau: float) -> float:
    """Amplitude a of the gain a (1 - exp(-t / tau)) common to all electrodes in ln Z, in addition to the
    force's contribution.

    Args:
      log_z: (n, 19); force: (n, 3) [N]; tau: [rows].
    """
    i, j = np.triu_indices(3)
    explained = np.linalg.qr(np.column_stack([np.ones(len(force)), force, force[:, i] * force[:, j]]))[0]
    rise = 1 - np.exp(-np.arange(len(force)) / tau)
    remaining_rise = rise - explained @ (explained.T @ rise)
    residual = log_z - explained @ (explained.T @ log_z)
    each = remaining_rise @ residual / (remaining_rise @ remaining_rise)
    weight = 1 / np.maximum((residual - remaining_rise[:, None] * each).var(0), 1e-8)
    return float(weight @ each / weight.sum())


@dataclasses.dataclass(frozen=True)
class _Candidate:
    window: tuple
    warm_up: float | None
    shared: bool
    products: int
    strength: float
    raw: bool = False
    common: bool = False
    waves: float = 0.0

    def text(self):
        words = ["counts" if self.raw else "ln Z"]
        if self.window:
            words.append(f"averages over {', '.join(map(str, self.window))} rows")
        if self.products:
            words.append(f"products of {self.products} components")
        if self.waves:
            words.append(f"waves of length {self.waves:g}")
        if self.common:
            words.append("common mode out")
        if self.warm_up:
            words.append(f"{'shared gain' if self.shared else 'warm-up'} tau {self.warm_up:g} n")
        return f"{' + '.join(words)}; ridge {self.strength:g}"


def _candidates():
    for window, products, strength in itertools.product(_WINDOWS, _PRODUCTS, _RIDGE):
        for warm_up in _WARM_UP:
            for shared in (False, True) if warm_up else (False,):
                yield _Candidate(window, warm_up, shared, products, strength)
    for window, warm_up, strength in itertools.product(_WINDOWS, _WARM_UP, _RIDGE):
        yield _Candidate(window, warm_up, False, 0, strength, raw=True)
    for window, products, strength in itertools.product(_WINDOWS, _PRODUCTS, _RIDGE):
        yield _Candidate(window, None, False, products, strength, common=True)
    for common, waves, strength in itertools.product((False, True), *_WAVES):
        yield _Candidate((), None, False, 0, strength, common=common, waves=waves)


# groups of candidates that differ only in their ridge: `fit_force` calls `progress` once per group
TRIALS = len({dataclasses.replace(c, strength=0.0) for c in _candidates()})


def _kind(c):
    return c.products, c.raw, bool(c.warm_up), c.common, bool(c.waves)


def _kinds(candidates):
    kinds = {}
    for c in candidates:
        kinds.setdefault(_kind(c), []).append(c)
    return kinds


def _features(log_z, force, fit_rows, candidate):
    """Features of all rows, fitted on the `fit_rows`. tau is relative to the length of `fit_rows`."""
    n = len(log_z)
    rise = None
    if candidate.warm_up:
        tau = candidate.warm_up * fit_rows.stop
        rise = 1 - np.exp(-np.arange(n) / tau)
        if candidate.shared:
            log_z = log_z - (shared_gain(log_z[fit_rows], force[fit_rows], tau) * rise)[:, None]
    if candidate.raw:
        log_z = counts_from_log_impedance(log_z) / 1000
    terms = Terms.fit(log_z[fit_rows], candidate.products, candidate.common, candidate.waves)(log_z)
    columns = [terms, *(causal_average(terms[:, : log_z.shape[1]], tau) for tau in candidate.window)]
    if rise is not None and not candidate.shared:
        columns.append(rise[:, None])
    return np.hstack(columns)


class ForceModel:
    """Predicts force from the counts up to each row; result of `fit_force`.

    Attributes:
      chosen: for x, y, z, descriptions of the averaged candidates.
      trust: (3,) retained fraction of the ridge's deviation from the mean, see `_trust`.
      network: whether the network's correction is used, for x, y, z.
      trials: walk-forward RMSE [N] of the ridge and of ridge plus network, each (3,).
    """

    def __init__(
        self,
        prediction: np.ndarray,
        chosen: list[list[str]],
        trust: np.ndarray,
        network: list[bool],
        trials: dict[str, list[float]],
        gain: float,
    ):
        self.prediction, self.chosen, self.trust = prediction, chosen, trust
        self.network, self.trials, self.gain = network, trials, gain


def fit_force(
    counts: np.ndarray,
    force: np.ndarray,
    ntrain: int,
    seed: int = 0,
    network: bool = True,
    progress: Callable[[], object] | None = None,
) -> ForceModel:
    """Fits on rows 0..ntrain-1 and predicts every row.

    Args:
      counts: (n, 19); force: (n, 3) [N], of which only the first ntrain rows are used.

    Returns:
      ForceModel whose `prediction` is (n, 3) [N].
    """
    log_z = log_impedance(counts)
    force = force[:ntrain]
    folds = walk_forward(ntrain)
    candidates = list(_candidates())
    groups = {}
    for c in candidates:
        groups.setdefault(dataclasses.replace(c, strength=0.0), []).append(c)
    error = {c: [] for c in candidates}
    for key, members in groups.items():
        for train, test in folds:
            x = _features(log_z[: test.stop], force, train, key)
            fits = ridges(x[train], force[train], [c.strength for c in members])
            for c, (w, b) in zip(members, fits):
                error[c].append(np.sqrt(((x[test] @ w + b - force[test]) ** 2).mean(0)))
        if progress:
            progress()
    error = {c: np.mean(e, axis=0) for c, e in error.items()}
    best = [_best(candidates, {c: e[k] for c, e in error.items()}) for k in range(3)]
    prediction = _mean_of(best, log_z, force, slice(0, ntrain))
    base = [_mean_of(best, log_z[: test.stop], force, train) for train, test in folds]
    centre = [force[train].mean(0) for train, _ in folds]
    trust = _trust(base, centre, force, folds)
    base = [c + trust * (b - c) for b, c in zip(base, centre)]
    prediction = force.mean(0) + trust * (prediction - force.mean(0))
    plain = np.array(
        [np.sqrt(((b[test] - force[test]) ** 2).mean(0)) for b, (_, test) in zip(base, folds)]
    ).mean(0)
    trials, kept = {"ridge": plain.tolist()}, [False] * 3
    if network:
        helped = []
        for b, (train, test) in zip(base[-2:], folds[-2:]):
            correction = _network(log_z[: test.stop], force[train] - b[train], train, seed)
            old, new = (np.sqrt(((p[test] - force[test]) ** 2).mean(0)) for p in (b, b + correction))
            helped.append(new / np.maximum(old, _EXACT))
        kept = (np.max(helped, axis=0) < 1).tolist()  # only if it helps in both trials
        trials["network_over_ridge"] = np.mean(helped, axis=0).tolist()
        if any(kept):
            correction = _network(log_z, force - prediction[:ntrain], slice(0, ntrain), seed)
            prediction = prediction + correction * kept
    gain = shared_gain(log_z[:ntrain], force, 1.5 * ntrain) * (1 - np.exp(-len(log_z) / (1.5 * ntrain)))
    return ForceModel(prediction, [[c.text() for c in cs] for cs in best], trust, kept, trials, gain)


def _trust(base, centre, force, folds):
    """(3,) least-squares factor on each component's deviation from the training mean in the trials: 0 is the
    mean, 1 the full deviation."""
    found, true = (
        np.concatenate([(y - c)[test] for y, c, (_, test) in zip(ys, centre, folds)])
        for ys in (base, [force] * len(folds))
    )
    return np.clip((found * true).sum(0) / np.maximum((found**2).sum(0), _EXACT), 0, 1)


def _best(candidates, error):
    """{candidate: weight} for one component of the force.

    One of each degree of flexibility, since their average generalises better than any of them. Weights are
    inverse mean squares in the trials; candidates with warm-up are included if it helped."""
    winners = {kind: min(same_kind, key=error.get) for kind, same_kind in _kinds(candidates).items()}
    cold = {kind: error[c] for kind, c in winners.items() if not c.warm_up}
    kept = [
        c
        for kind, c in winners.items()
        if not c.warm_up or error[c] < cold[_kind(dataclasses.replace(c, warm_up=None))]
    ]
    weight = np.array([max(error[c], _EXACT) ** -2 for c in kept])
    return dict(zip(kept, weight / weight.sum()))


def _mean_of(best, log_z, force, fit_rows):
    """(n, 3): weighted mean of each component's candidates, fitted on the `fit_rows`."""
    out = np.zeros((len(log_z), 3))
    for c in dict.fromkeys(c for chosen in best for c in chosen):  # in a fixed order
        x = _features(log_z, force, fit_rows, c)
        w, b = ridge(x[fit_rows], force[fit_rows], c.strength)
        out += (x @ w + b) * [chosen.get(c, 0.0) for chosen in best]
    return out


def _network(log_z, target, fit_rows, seed, members=6, epochs=8, width=64, batch=256):
    """(n, 3): mean prediction of `target` by small networks on ln Z, trained on the `fit_rows`. Inputs
    are augmented by noise and a common gain, for robustness to drift."""
    import torch

    from ..training.fitting import TrainingOptions, train

    mean, scale = log_z[fit_rows].mean(0), np.maximum(log_z[fit_rows].std(0), 1e-3)
    size = np.maximum(target.std(0), 1e-6)
    x = torch.tensor((log_z - mean) / scale, dtype=torch.float32)
    y = torch.tensor(target / size, dtype=torch.float32)
    common = torch.tensor(0.05 / scale, dtype=torch.float32)
    rows, steps = torch.arange(len(y)), epochs * max(1, len(y) // batch)

    def member(seed):
        torch.manual_seed(seed)
        net = torch.nn.Sequential(
            torch.nn.Linear(x.shape[1], width), torch.nn.ELU(), torch.nn.Dropout(0.1),
            torch.nn.Linear(width, width), torch.nn.ELU(), torch.nn.Dropout(0.1), torch.nn.Linear(width, 3),
        )  # fmt: skip

        def loss(row):
            shaken = x[row] + 0.05 * torch.randn(len(row), x.shape[1]) + torch.randn(len(row), 1) * common
            return ((net(shaken) - y[row]) ** 2).mean()

        train(net, loss, rows, TrainingOptions(batch, steps, 2e-3, weight_decay=0.01, seed=seed))
        with torch.no_grad():
            return net(x).numpy() * size

    return sum(member(seed + k) for k in range(members)) / members
