"""Delay of the electrodes behind the force that is logged beside them, or of the force behind them.

The force is regressed on the electrodes (ln Z and products of its principal components, because they depend
on the place of the contact, which force alone does not contain) by ridge regression, cross-validated on
blocks of time. The regressors are delayed, never the force, so that the variance to be explained stays the
same. Both sides are smoothed by 20 ms, which takes the electrodes' noise out of the comparison.

A log's row has the electrodes of the bus's last frame and the force of the moment, so electrodes are late by
up to a frame in every log. Delays of a frame are therefore part of the null model."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ....effects.effect import shifted
from ....quality.evidence import sign_flip
from ....sensor.channels import log_impedance
from ...trajectories.base.nuisance import ages
from ..candidates import KINDS, Candidate
from ..conditional import Components
from ..recording import FORCE_MOVED
from ..session import Session

_BLOCKS = 24
_SMOOTH = 0.02  # [s]
_RIDGE = 1e-4
_ROWS = 4000
_AXES = 6  # principal components
_P = 0.02
_SOUND = 5  # delays that are tried within a frame


class ForceView:
    """Cross-validated prediction of force from electrodes on some contiguous rows.

    Args:
      counts: (n, nelectrode); force: (n, 3) as the sensor said [N]; rows: (n,) bool, contiguous; usable:
        electrodes to use; rate: [Hz].
    """

    def __init__(
        self, counts: np.ndarray, force: np.ndarray, rows: np.ndarray, usable: np.ndarray, rate: float
    ):
        rows, self.rate = np.flatnonzero(rows), rate
        z = log_impedance(counts[np.ix_(rows, usable)])
        z = z - z.mean(0)
        x = np.concatenate([z, Components(z, _AXES).products(z)], axis=1)
        self.x = self._smooth((x - x.mean(0)) / np.maximum(x.std(0), 1e-9))
        self.time, self.step = np.arange(len(z)) / rate, max(1, len(z) // _ROWS)
        self.target = self._smooth(force[rows])[:: self.step]
        self.edges = -(-np.arange(_BLOCKS + 1) * len(self.target) // _BLOCKS)

    def _smooth(self, x):
        return gaussian_filter1d(x, _SMOOTH * self.rate, axis=0, mode="nearest")

    def errors(self, act: Callable[[np.ndarray], np.ndarray] = np.asarray) -> np.ndarray:
        """(blocks, 3) logarithm of the mean square error of each block left out, where `act` is done to what
        the electrodes say (n, q)."""
        x, t = act(self.x)[:: self.step], self.target
        A = np.concatenate([np.ones((len(x), 1)), x], axis=1)
        parts = [(A[a:b], t[a:b]) for a, b in zip(self.edges[:-1], self.edges[1:])]
        G = np.stack([a.T @ a for a, _ in parts])
        H = np.stack([a.T @ v for a, v in parts])
        total = G.sum(0)
        ridge = _RIDGE * np.diag(total).copy()
        ridge[0] = 0  # in units of each column's variance, and none of the mean
        w = np.linalg.solve(total - G + np.diag(ridge + 1e-9), H.sum(0) - H)
        square = np.array([((v - a @ of) ** 2).mean(0) for (a, v), of in zip(parts, w)])
        return np.log(np.maximum(square, 1e-12))

    def at_delay(self, delay: float) -> np.ndarray:
        """(blocks,) mean of `errors` over components where the electrodes are `delay` [s] late."""
        return self.errors(lambda x: shifted(x, self.time, -delay)).mean(1)


def force_view(session: Session, rows: np.ndarray) -> ForceView | None:
    """ForceView of contiguous rows (n,) bool, None where force and electrodes are not related."""
    r = session.recording
    usable = np.flatnonzero(session.masked[rows].mean(0) < 0.02)
    if r.force is None or len(usable) < 6 or r.force[rows].std(0).max() < FORCE_MOVED:
        return None
    return ForceView(session.counts, r.force, rows, usable, r.rate)


def delayed(session: Session) -> Candidate | None:
    """A delay of electrodes or force, if the force is predicted better with it on blocks left out."""
    view = force_view(session, session.fit)
    if view is None:
        return None
    low, high = ages(session.recording.design)
    delays = _tried(view.rate, low, high)
    table = np.stack([view.at_delay(d) for d in delays])
    best = int(table.mean(1).argmin())
    sound = table[(low <= delays) & (delays <= high)]
    gain = sound[sound.mean(1).argmin()] - table[best]
    p, seconds = sign_flip(gain), session.fit.sum() / view.rate
    if p >= _P or gain.mean() <= 0:
        return None
    # bootstrap over blocks
    rng = np.random.default_rng(0)
    draws = [table[:, rng.integers(0, _BLOCKS, _BLOCKS)].mean(1) for _ in range(200)]
    ends = np.quantile([_vertex(delays, d) for d in draws], [0.025, 0.975])
    delay = _vertex(delays, table.mean(1))
    found = f"errors of the force fall in {np.mean(gain > 0):.0%} of {_BLOCKS} blocks"
    if delay < 0:
        least = "at least" if best == 0 else "about"
        found = f"the force log is late by {least} {-delay:.2g} s: shift it so much earlier; {found}"
    kind = KINDS["force_late" if delay < 0 else "latency"]
    size = min(abs(delay), kind.params["delay"].high)
    return Candidate(
        kind.id,
        tuple(range(session.counts.shape[1])),
        0.0,
        float(session.recording.time[-1]),
        found,
        {"delay": (size, *sorted(float(np.sign(delay) * end) for end in ends))},
        # half the summed log-error ratio, per independent second of a block
        nats=float(0.5 * 3 * gain.sum() * min(max(1.0, seconds / _BLOCKS), 20)),
        p=p,
        detector="late",
        delay=delay,
        features={
            "gain": float(np.log(max(gain.mean(), 1e-4))),
            "size": float(np.log(max(abs(10 * delay), 1e-3))),
        },
    )


def _tried(rate, low, high):
    """(m,) delays [s], rising: some within low .. high, which a sound log has, and rows on either side."""
    fine = max(1, round(0.01 * rate))
    near, far = np.arange(-5, 11) * fine, np.unique(np.geomspace(12 * fine, 0.6 * rate, 8).astype(int))
    delays = np.concatenate([-far[far < 0.3 * rate], near, far]) / rate
    return np.unique(np.concatenate([delays, np.linspace(low, high, _SOUND)]))


def _vertex(x, y):
    """Position of the least y (n,) over x (n,), between the tried ones by a parabola through three."""
    i = int(np.argmin(y))
    if not 0 < i < len(x) - 1:
        return float(x[i])
    bend, slope, _ = np.polyfit(x[i - 1 : i + 2] - x[i], y[i - 1 : i + 2], 2)
    return float(np.clip(x[i] - 0.5 * slope / max(bend, 1e-12), x[i - 1], x[i + 1]))
