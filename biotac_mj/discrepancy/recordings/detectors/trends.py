"""Courses over time of one series of levels: a constant, a step, a smooth curve, or both, compared on
blocks of time left out; and how a trend goes on beyond the last row fitted."""

import dataclasses
import functools

import numpy as np

from ...evidence import log_ratio, sign_flip

__all__ = ["BLOCKS", "SHARP", "Trend", "compare", "trends", "goes_on", "hats", "sharp"]

BLOCKS = 16
_KNOTS = (4, 7, 11)
SHARP = 5.0  # robust standard deviations by which a step beside a smooth trend stands out
_LASTS = 6  # cells for which a change of level over three lasts: a step's three, a ramp's as long as it is


@dataclasses.dataclass
class Trend:
    """A trend that was fitted to levels.

    Attributes:
      kind: "step", "smooth", "both" or "walk", from cell to cell; onset [s] of the step, nan; knots [s],
        values there without the step, jump: of the step; gain (blocks,) nats of each block left out against
        a constant; p of their sign flips; tail: (rate per s, time constant [s]) with which it goes on.
    """

    kind: str
    onset: float
    knots: np.ndarray
    values: np.ndarray
    jump: float
    gain: np.ndarray
    p: float
    tail: tuple = (0.0, 0.0)

    @property
    def nats(self) -> float:
        return float(self.gain.sum())

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Values at times [s]."""
        last = self.knots[-1]
        out = np.interp(time, self.knots, self.values) + self.jump * (time > self.onset)
        rate, tau = self.tail
        if rate:
            late = np.maximum(time - last, 0)
            out = out + rate * (late if np.isinf(tau) else tau * (1 - np.exp(-late / tau)))
        return out

    def sampled(self) -> np.ndarray:
        """(100,) values over the rows fitted."""
        return self(np.linspace(self.knots[0], self.knots[-1], 100))

    def parts(self) -> tuple["Trend", "Trend"]:
        """The step and the smooth trend of both."""
        zero = np.zeros_like(self.values)
        return (
            dataclasses.replace(self, kind="step", values=zero, tail=(0.0, 0.0)),
            dataclasses.replace(self, kind="smooth", jump=0.0),
        )

    @property
    def size(self) -> float:
        return float(np.ptp(self.sampled()))

    @property
    def turns(self) -> float:
        """Way over range: 1 goes one way only."""
        y = self.sampled()
        return float(np.abs(np.diff(y)).sum() / max(np.ptp(y), 1e-12))

    @property
    def start(self) -> float:
        """[s] from which it leaves its first level by a tenth of its size."""
        if self.kind == "step":
            return float(self.onset)
        time = np.linspace(self.knots[0], self.knots[-1], 100)
        y = self(time)
        return float(time[np.argmax(np.abs(y - y[0]) > 0.1 * np.ptp(y))])


def compare(null: np.ndarray, other: np.ndarray, block: np.ndarray, scale: float) -> np.ndarray:
    """(blocks,) nats by which residuals `other` (w,) beat `null` (w,), both predicted from other blocks: half
    the logarithm of the ratio of mean squares for every cell, with noise of variance scale^2 beneath."""
    number = np.bincount(block)
    square = [np.bincount(block, r**2) / number for r in (null, other)]
    return log_ratio(*square, number, scale**2)


def trends(
    level: np.ndarray, time: np.ndarray, thorough: bool = False, kinds: tuple = ("step", "smooth", "both")
) -> list[Trend]:
    """Courses compared with a constant on blocks left out, the best first.

    Args:
      level: (w,) means of cells; time: (w,) [s]; thorough: whether a step on a smooth trend is tried too,
        and how it goes on; kinds: to choose from. A walk, of which each cell is left out alone and said by
        the two beside it, is tried where nothing else is a trend, if asked for: a load's levels do as much.
    """
    w = len(level)
    scale = max(1.4826 * np.median(np.abs(np.diff(level))) / np.sqrt(2), 0.01 * level.std(), 1e-9)
    block = np.arange(w) * min(BLOCKS, w // 2) // w
    null = _left_out(w, 1)[0] @ level
    found = []
    for k in _KNOTS:
        left_out, weights = _left_out(w, k)
        gain = compare(null, left_out @ level, block, scale)
        knots = np.linspace(time[0], time[-1], k)
        found.append(Trend("smooth", np.nan, knots, weights @ level, 0.0, gain, sign_flip(gain)))
    smooth = max(found, key=lambda c: c.nats).knots
    for knots in (time[[0, -1]], *([smooth] if thorough else [])):
        basis = hats(time, knots) if len(knots) > 2 else np.ones((w, 1))
        residual = np.empty(w)
        for b in range(block[-1] + 1):
            rest = block != b
            onset, weights = _with_step(level, basis, time, rest)
            said = basis @ weights[:-1] + weights[-1] * (time > onset)
            residual[~rest] = (level - said)[~rest]
        gain = compare(null, residual, block, scale)
        onset, weights = _with_step(level, basis, time, np.ones(w, bool))
        values = weights[:-1] if len(knots) > 2 else np.repeat(weights[0], 2)
        kind = "both" if len(knots) > 2 else "step"
        found.append(Trend(kind, onset, knots, values, float(weights[-1]), gain, sign_flip(gain)))
    if "walk" in kinds and min(c.p for c in found) > 0.02:
        near = np.r_[level[1], 0.5 * (level[2:] + level[:-2]), level[-2]]
        gain = compare(null, level - near, block, scale)
        found.append(Trend("walk", np.nan, time, level - level.mean(), 0.0, gain, sign_flip(gain)))
    found = [c for c in found if c.kind in kinds]
    found = [c for c in found if c.kind != "both" or sharp(level, time, c.onset) > SHARP]
    found.sort(key=lambda c: -c.nats)
    if thorough:
        best = found[0]
        best.tail = goes_on(level, time) if best.kind == "smooth" else (0.0, 0.0)
    return found


def sharp(level: np.ndarray, time: np.ndarray, onset: float) -> float:
    """Change of the level at a time over those at other times, in robust standard deviations; 0 where it
    continues, as in a ramp that is flat elsewhere."""
    total = np.concatenate([[0.0], np.cumsum(level)])
    at = np.arange(3, len(level) - 2)
    change = (total[at + 3] - 2 * total[at] + total[at - 3]) / 3
    change = change - np.median(change)
    spread = 1.4826 * np.median(np.abs(change)) + 1e-12
    i = int(np.argmin(np.abs(time[at] - 0.5 * (time[1] - time[0]) - onset)))
    near = np.abs(change[max(i - 1, 0) : i + 2]).max()
    small = np.abs(change) < 0.5 * near
    before = int(np.argmax(small[max(i - 1, 0) :: -1])) if small[: max(i - 1, 0) + 1].any() else i
    after = int(np.argmax(small[i + 1 :])) if small[i + 1 :].any() else len(small) - i
    return float(near / spread) if before + after <= _LASTS else 0.0


def hats(time: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """(w, k) piecewise linear functions, one at each knot."""
    return np.stack([np.interp(time, knots, row) for row in np.eye(len(knots))], axis=1)


def _solve(A, y):
    return np.linalg.solve(A.T @ A + 1e-3 * np.eye(A.shape[1]), A.T @ y)


@functools.lru_cache(maxsize=64)
def _left_out(w, k):
    """Matrix (w, w) from w levels to the residuals of each block, by least squares of the other blocks on k
    hats over even cells; and matrix (k, w) from levels to the weights of a fit to all."""
    cells = np.linspace(0, 1, w)
    basis = hats(cells, np.linspace(0, 1, k)) if k > 1 else np.ones((w, 1))
    block = np.arange(w) * min(BLOCKS, w // 2) // w
    out = np.eye(w)
    small = 1e-3 * np.eye(k)
    for b in range(block[-1] + 1):
        rest = block != b
        A = basis[rest]
        out[np.ix_(~rest, rest)] = -basis[~rest] @ np.linalg.solve(A.T @ A + small, A.T)
    return out, np.linalg.solve(basis.T @ basis + small, basis.T)


def _with_step(level, basis, time, rows):
    """Onset [s] and weights of basis and step that explain some rows best."""
    A, y, t = basis[rows], level[rows], time[rows]
    q, steps, size = _steps(A.tobytes(), A.shape)
    rest = y - q @ (q.T @ y)
    explained = (steps.T @ rest) ** 2 / size
    i = int(explained.argmax()) + 2
    onset = float((t[i] + t[i + 1]) / 2)
    return onset, _solve(np.column_stack([A, t > onset]), y)


@functools.lru_cache(maxsize=256)
def _steps(basis, shape):
    """For a basis (cells, k), passed as bytes since all electrodes of a session share it: an orthonormal
    basis, the steps (cells, candidates) orthogonal to it (one projection for all onsets), and their squared
    norms."""
    q = np.linalg.qr(np.frombuffer(basis).reshape(shape))[0]
    steps = np.tri(shape[0], shape[0] - 1, -1)[:, 2:-2]
    steps = steps - q @ (q.T @ steps)
    return q, steps, np.maximum((steps**2).sum(0), 1e-2)


def goes_on(level: np.ndarray, time: np.ndarray) -> tuple:
    """(rate, time constant) of a damped trend (Gardner and McKenzie 1985) beyond the last cell, chosen by
    walking forward through the cells: at three earlier ends what came next is said from what was there."""
    span = time[-1] - time[0]
    ends = [int(f * len(level)) for f in (0.55, 0.7, 0.85)]
    taus = [0.0, *(span * f for f in (0.1, 0.25, 0.5, 1.0)), np.inf]

    def rate(end, tau):
        if tau == 0:
            return 0.0
        back = max(6, int(len(level) * 0.25))
        t, y = time[max(end - back, 0) : end], level[max(end - back, 0) : end]
        late = t - t[-1]
        basis = late if np.isinf(tau) else tau * (1 - np.exp(-np.clip(late / tau, -20, 0)))
        basis = basis - basis.mean()
        return float(basis @ (y - y.mean()) / max(basis @ basis, 1e-12))

    def error(tau):
        total = 0.0
        for end in ends:
            r, late = rate(end, tau), time[end : end + len(level) // 4] - time[end - 1]
            ahead = r * (late if np.isinf(tau) else tau * (1 - np.exp(-late / tau)) if tau else 0 * late)
            total += np.sum((level[end : end + len(late)] - level[end - 3 : end].mean() - ahead) ** 2)
        return total

    errors = [error(tau) for tau in taus]
    best = int(np.argmin(errors))
    tau = taus[best] if errors[best] < 0.8 * errors[0] else 0.0
    return rate(len(level), tau), tau
