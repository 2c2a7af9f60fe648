"""Courses over time of one series of levels: a constant, a step, or a smooth curve, compared on blocks of
time left out; and how a trend goes on beyond the last row fitted."""

import dataclasses
import functools

import numpy as np

from ....quality.evidence import sign_flip
from ...evidence import log_ratio

BLOCKS = 16
_KNOTS = (4, 7, 11)
SHARP = 5.0  # robust standard deviations by which a step beside a smooth trend stands out
_LASTS = 6  # cells for which a change of level over three lasts: a step's three, a ramp's as long as it is


@dataclasses.dataclass
class Trend:
    """A trend that was fitted to levels.

    Attributes:
      kind: "step" or "smooth"; onset [s] of the step, nan; knots [s], values there without the step, jump: of
        the step; gain (blocks,) nats of each block left out against a constant; p of their sign flips;
        tail: (rate per s, time constant [s]) with which it goes on.
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
        out = np.interp(time, self.knots, self.values) + self.jump * (time > self.onset)
        rate, tau = self.tail
        if rate:
            late = np.maximum(time - self.knots[-1], 0)
            out = out + rate * (late if np.isinf(tau) else tau * (1 - np.exp(-late / tau)))
        return out

    def continued(self, level: np.ndarray, time: np.ndarray) -> "Trend":
        """It as it goes on beyond the levels (w,), at times (w,) [s], that it was fitted to."""
        return dataclasses.replace(self, tail=_goes_on(level, time)) if self.kind == "smooth" else self

    def sampled(self) -> np.ndarray:
        """(100,) values over the rows fitted."""
        return self(np.linspace(self.knots[0], self.knots[-1], 100))

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


def trends(level: np.ndarray, time: np.ndarray, kinds: tuple = ("step", "smooth")) -> list[Trend]:
    """Courses compared with a constant on blocks left out, the best first.

    Args:
      level: (w,) means of cells; time: (w,) [s]; kinds: to choose from.
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
    residual = np.empty(w)
    for b in range(block[-1] + 1):
        rest = block != b
        onset, before, jump = _with_step(level, time, rest)
        residual[~rest] = (level - before - jump * (time > onset))[~rest]
    gain = compare(null, residual, block, scale)
    onset, before, jump = _with_step(level, time, np.ones(w, bool))
    found.append(Trend("step", onset, time[[0, -1]], np.full(2, before), jump, gain, sign_flip(gain)))
    return sorted((c for c in found if c.kind in kinds), key=lambda c: -c.nats)


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


@functools.lru_cache(maxsize=64)
def _left_out(w, k):
    """Matrix (w, w) from w levels to the residuals of each block, by least squares of the other blocks on k
    hats over even cells; and matrix (k, w) from levels to the weights of a fit to all."""
    cells = np.linspace(0, 1, w)
    knots = np.linspace(0, 1, k)
    basis = (
        np.stack([np.interp(cells, knots, row) for row in np.eye(k)], axis=1) if k > 1 else np.ones((w, 1))
    )
    block = np.arange(w) * min(BLOCKS, w // 2) // w
    out = np.eye(w)
    small = 1e-3 * np.eye(k)
    for b in range(block[-1] + 1):
        rest = block != b
        A = basis[rest]
        out[np.ix_(~rest, rest)] = -basis[~rest] @ np.linalg.solve(A.T @ A + small, A.T)
    return out, np.linalg.solve(basis.T @ basis + small, basis.T)


def _with_step(level, time, rows):
    """Onset [s] of the step that explains some rows best, the level before it, and its size."""
    y, t = level[rows], time[rows]
    total, count = np.cumsum(y), np.arange(1, len(y) + 1)
    before = total / count
    after = (total[-1] - total) / np.maximum(len(y) - count, 1)
    i = 2 + int((count * (len(y) - count) * (after - before) ** 2)[2:-3].argmax())
    return float((t[i] + t[i + 1]) / 2), float(before[i]), float(after[i] - before[i])


def _goes_on(level: np.ndarray, time: np.ndarray) -> tuple:
    """(rate, time constant) of a damped trend (Gardner and McKenzie 1985) beyond the last cell, chosen by
    forward validation: at three earlier ends the cells that follow are predicted from those before."""
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
