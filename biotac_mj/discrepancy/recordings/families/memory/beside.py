"""What one electrode lags behind the others, by what these say of it at all frequencies.

The other electrodes, their squares and products are fitted together with a course over time, on blocks of
time left out: an electrode lags if they say it better as they were before."""

import numpy as np
from scipy.signal import lfilter

from .....sensor.channels import counts_from_log_impedance, log_impedance
from ....evidence import sign_flip
from ...findings import Finding
from ...model import Model
from ...session import Session
from ..courses import BLOCKS, hats
from .between import shift

__all__ = ["Beside", "beside", "lagging"]

_AXES = 5  # principal components whose products are among the regressors
_FAR = 4.0  # standard deviations of one: beyond, a square would only extrapolate
_KNOTS = 7
_RIDGE, _BENT = 1e-3, 1e-4  # of a regressor's variance: of the others, of the course
_COUNT = 1.0  # [counts] that nothing says
_DELAYS = (1, 2, 3, 4, 6)  # bins
_TAUS = (0.1, 0.2, 0.4, 0.8)  # [s]
# nats a cell that a lag gains of some that are not asked of each other: 0.15 at most in 25 recordings
# without one
_LAGS_ALIKE, _SOME = 0.4, 3
_TIED = 0.8  # of a lag's gain that one of the other kind has


class Beside:
    """Regressions of each electrode used (c,) on the others, of the bins fitted, or kept aside."""

    def __init__(self, model: Model, aside: bool = False):
        self._model, bins = model, model.inside != aside
        self._x, self._time = model.value[bins], model.time[bins]
        n, self.number = self._x.shape
        self._block = np.arange(n) * BLOCKS // n
        self._knots = np.linspace(self._time[0], self._time[-1], _KNOTS)
        self._hats = hats(self._time, self._knots)
        self._floor = model.noise**2 + (_COUNT / model.slope) ** 2

    def lags(self, i: int, silent: tuple = ()) -> list:
        """(gain (blocks,), name, seconds) of the best delay and of the best low-pass of used electrode i;
        silent: used electrodes that are not asked."""
        A, y, ridge = self._design(i, silent)
        period, without = self._model.period, self._left_out(A, y, ridge)
        out = [("latency", d * period) for d in _DELAYS] + [("lowpass", tau) for tau in _TAUS]
        tried = [
            (self._gain(i, without, self._left_out(self._behind(A, name, seconds), y, ridge)), name, seconds)
            for name, seconds in out
        ]
        return [
            max((t for t in tried if t[1] == name), key=lambda t: t[0].mean())
            for name in ("latency", "lowpass")
        ]

    def missed(self, i: int, name: str, seconds: float, silent: tuple = ()) -> tuple[np.ndarray, np.ndarray]:
        """(blocks,) RMS [ln Z] of used electrode i against what the others but the silent ones say as they
        are, and as they were before."""
        A, y, ridge = self._design(i, silent)
        least = self._floor[i]  # so that a block in which nothing moves is as the others
        both = (A, self._behind(A, name, seconds))
        return tuple(np.sqrt(self._left_out(B, y, ridge) + least) for B in both)

    def _behind(self, A, name, seconds):
        """Regressors A (n, q) as they were before, those of a course as they are."""
        now, period = A[:, :-_KNOTS], self._model.period
        if name == "latency":
            d = round(seconds / period)
            late = np.concatenate([np.repeat(now[:1], d, axis=0), now[:-d]])
        else:
            a = np.exp(-period / seconds)
            late = lfilter([1 - a], [1, -a], now, axis=0, zi=a * now[:1])[0]
        return np.hstack([late, A[:, -_KNOTS:]])

    def _gain(self, i, without, missed):
        return 0.5 * np.log((without + self._floor[i]) / (missed + self._floor[i]))

    def _design(self, i, silent=()):
        """Regressors (n, q) of used electrode i, the course's last; its own values (n,); ridge (q,)."""
        n = len(self._x)
        others = np.delete(self._x, [i, *silent], axis=1)
        others = others - others.mean(0)
        u = np.linalg.svd(others / np.delete(self._model.noise, [i, *silent]), full_matrices=False)[0]
        u = np.clip(u[:, :_AXES] * np.sqrt(n), -_FAR, _FAR)
        a, b = np.triu_indices(u.shape[1])
        products = u[:, a] * u[:, b]
        linear = np.column_stack([others, products - products.mean(0)])
        linear /= np.maximum(linear.std(0), 1e-12)
        ridge = n * np.r_[np.full(linear.shape[1], _RIDGE), np.full(_KNOTS, _BENT)]
        course = self._hats - self._hats.mean(0)
        return np.column_stack([linear, course]), self._x[:, i] - self._x[:, i].mean(), ridge

    def _left_out(self, A, y, ridge):
        """(blocks,) mean squares of y (n,) less what regressors A (n, q) say of it, fitted without each
        block."""
        G, h = A.T @ A + np.diag(ridge), A.T @ y
        parts = [(A[mine], y[mine]) for mine in (self._block == b for b in range(BLOCKS))]
        rest = np.stack([G - a.T @ a for a, _ in parts]), np.stack([h - a.T @ v for a, v in parts])
        w = np.linalg.solve(rest[0], rest[1][:, :, None])[:, :, 0]
        return np.array([np.mean((v - a @ of) ** 2) for (a, v), of in zip(parts, w)])


def beside(model: Model, aside: bool = False) -> Beside | None:
    """None where nothing moves, so little is fitted that a block has no bins, or few electrodes are left."""
    if not model.moved or (model.inside != aside).sum() <= 4 * BLOCKS or len(model.used) < 7:
        return None
    return Beside(model, aside)


def lagging(session: Session) -> Finding | None:
    """The electrode that is late, or filtered, where the others are not; or some that are so alike."""
    m = session.model()
    every = beside(m)
    if every is None:
        return None
    best = [every.lags(i) for i in range(every.number)]
    gain = np.array([_most(b) for b in best])
    some = np.argsort(-gain)[:_SOME].tolist()
    for i in some:  # those that lag alike hide each other: they are not asked of each other
        again = every.lags(i, tuple(j for j in some if j != i))
        if _most(again) > max(gain[i], _LAGS_ALIKE):
            best[i], gain[i] = again, _most(again)
    late = sorted((i for i in some if gain[i] >= _LAGS_ALIKE), key=lambda i: -gain[i]) or [int(gain.argmax())]
    total = np.array([[b[0].mean() for b in best[i]] for i in late]).sum(0)
    which = int(total.argmax())  # a delay or a low-pass, of all of them
    each = {int(m.used[i]): best[i][which][2] for i in late}
    mine, name, seconds = best[late[0]][which]
    p, rate = sign_flip(mine), session.recording.rate
    if p > 0.02:
        return None

    def correct(counts, time):
        out = counts.copy()
        for k, behind in each.items():
            z = log_impedance(counts[:, [k]])
            # the derivative of a low-pass over its own time, so that noise is not magnified
            early = shift(z, -behind * rate) if name == "latency" else z + _half(z, behind * rate)
            out[:, k] = counts_from_log_impedance(early)[:, 0]
        return out

    wide = m.period if name == "latency" else 0.5 * seconds
    who = ", ".join(f"e{k + 1}" for k in each)
    return Finding(
        name,
        tuple(each),
        {"delay" if name == "latency" else "tau": (seconds, seconds - wide, seconds + wide)},
        float(3 * mine.sum()),
        p,
        0.0,
        session.recording.time[-1],
        note=f"the others say {who} best as they were {seconds:.2f} s before"
        if name == "latency"
        else f"the others say {who} best through a low-pass of {seconds:.2f} s",
        ties=(best[late[0]][1 - which][1],) if total[1 - which] > _TIED * total[which] else (),
        clues={"gain": float(gain[late[0]]), "lag": float(gain[late[0]] - np.delete(gain, late).max())},
        correct=correct,
    )


def _most(lags):
    return max(b[0].mean() for b in lags)


def _half(z, rows):
    """tau dz/dt of (n, 1) by differences over tau: rows of it."""
    return shift(z, -0.5 * rows) - shift(z, 0.5 * rows)
