"""How 19 electrodes move together: time bins, the load's covariance, and the amplitude of a pattern over
time.

ln Z of all electrodes moves on few dimensions while the skin is loaded. The covariance S of *fast* changes
(within a few seconds) knows these and the noise, and hardly any drift. For a pattern p the amplitude a(t) =
p' S^-1 (y - mean) / (p' S^-1 p) is the estimate that the load disturbs least (the minimum-variance filter,
Capon, Proc. IEEE 57, 1969). With p = e_k it is the residual of predicting electrode k from the other 18, with
p = 1 the shared gain. Unloaded, S is the noise and a(t) a plain average: one formula for both."""

from collections.abc import Callable, Sequence

import numpy as np

from ...sensor.channels import log_impedance
from ..noise import noise_level
from .recording import Recording

__all__ = ["Timeline"]

_FAST = 4.0  # [s] window within which a change counts as fast
_BINS = 1200  # at most


class Timeline:
    """Bins of a recording. m bins, c usable electrodes.

    Args:
      recording: Recording.
      counts: (n, 19) to use in its place, e.g. corrected for an effect.
      masked: (n, 19) bool, samples that are no measurement; an electrode masked for more than half of the
        rows is left out.

    Attributes:
      width: rows per bin; time: (m,) [s] of the bins' middle; value: (m, c) ln Z; used: (c,) electrode
        numbers from 0.
      noise: (c,) standard deviation of a bin's value from white noise of the samples [ln Z].
      covariance: (c, c) of fast changes; loaded: whether the skin was loaded.
    """

    def __init__(
        self, recording: Recording, counts: np.ndarray | None = None, masked: np.ndarray | None = None
    ):
        counts = recording.electrodes if counts is None else counts
        n = len(counts)
        seconds = n / recording.rate
        self.width = max(1, int(round(max(0.25, seconds / _BINS) * recording.rate)), 1)
        self.width = min(self.width, max(1, n // 200))
        m = n // self.width
        good = np.ones(counts.shape, bool) if masked is None else ~masked
        self.used = np.flatnonzero(good.mean(0) > 0.5)
        y = log_impedance(counts)[:, self.used]
        good = good[:, self.used]
        self.time = (np.arange(m) + 0.5) * self.width / recording.rate
        self.period = self.width / recording.rate
        shape = (m, self.width, len(self.used))
        y, good = y[: m * self.width].reshape(shape), good[: m * self.width].reshape(shape)
        weight = good.sum(1)
        with np.errstate(invalid="ignore", divide="ignore"):
            self.value = np.where(weight > 0, (y * good).sum(1) / weight, np.nan)
        slope = 4095 / (
            np.clip(counts[:, self.used], 1, 4094) * (4095 - np.clip(counts[:, self.used], 1, 4094))
        )
        sample = noise_level(counts[:, self.used], recording.repeated) * np.median(slope, axis=0)
        effective = max(1.0, self.width * (1 - recording.repeated.mean()))
        self.noise = np.maximum(sample, 1e-5) / np.sqrt(effective)
        self._fill()
        white = self.noise
        if self.width > 2:  # noise that is not white is larger in means than its samples say
            self.noise = np.maximum(self.noise, noise_level(self.value, None, 1e-6))
        self._departures = {}
        self.covariance = self._fast_covariance()
        c = len(self.used)
        # what all electrodes do alike is no load: a contact raises some and lowers others
        apart = np.eye(c) - 1 / c
        size = np.sqrt(np.diag(apart @ self.covariance @ apart))
        # A load moves electrodes by tens of counts within seconds; noise, filtered or not, does not.
        self.loaded = bool(
            np.median(np.sort(size / white)[-6:]) > 5
            and np.median(np.sort(size / np.median(slope, axis=0))[-6:]) > 6
        )

    def _fill(self):
        """Bins without a good sample take the conditional mean given the others, or the electrode's
        median."""
        hole = np.isnan(self.value)
        self.hole = hole
        if not hole.any():
            return
        median = np.nanmedian(self.value, axis=0)
        filled = np.where(hole, median, self.value)
        centred = filled - median
        cov = centred.T @ centred / len(filled) + np.diag(self.noise**2)
        for row in np.flatnonzero(hole.any(1)):
            miss = hole[row]
            if not miss.all():
                filled[row, miss] = median[miss] + cov[np.ix_(miss, ~miss)] @ np.linalg.solve(
                    cov[np.ix_(~miss, ~miss)], centred[row, ~miss]
                )
        self.value = filled

    def _fast_covariance(self):
        span = int(np.clip(round(_FAST / self.period), 6, max(6, len(self.time) // 12)))
        k = len(self.time) // span
        x = self.value[: k * span].reshape(k, span, -1)
        basis = np.linalg.qr(np.vander(np.linspace(-1, 1, span), 2))[0]
        x = x - basis @ (basis.T @ x)
        # A step inside one window is a change of the sensor, not the load's: the liveliest windows give way
        # to the next.
        energy = (x**2).sum((1, 2))
        x = x[energy <= np.quantile(energy, 0.98)].reshape(-1, x.shape[2])
        return x.T @ x / len(x) * span / (span - 2) + np.diag(self.noise**2)

    def amplitude(self, pattern: np.ndarray) -> tuple[np.ndarray, float]:
        """(m,) of a pattern (c,), about its mean, and the standard deviation that fast changes give it."""
        q = np.linalg.solve(self.covariance, pattern)
        scale = pattern @ q
        return (self.value - self.value.mean(0)) @ q / scale, 1 / np.sqrt(scale)

    def jumps(self, known: Sequence[float] = (), seconds: float = 0.6) -> tuple[np.ndarray, np.ndarray, int]:
        """Changes of level within a bin: rows (q,) of bins, change (q, c) of means over `seconds` before and
        after [ln Z], bins on a side.

        Bins near `known` times [s] of jumps already found are left out.
        """
        w = max(2, int(round(seconds / self.period)))
        n, c = self.value.shape
        if n < 6 * w:
            return np.zeros(0, int), np.zeros((0, c)), w
        total = np.concatenate([np.zeros((1, c)), np.cumsum(self.value, axis=0)])
        at = np.arange(w, n - w - 1)
        for time in known:
            at = at[np.abs(self.time[at] - time) > (w + 2) * self.period]
        # bin `at` itself may be cut in two
        return (at, (total[at + w + 1] - total[at + 1] - total[at] + total[at - w]) / w, w)

    def jump_at(self, row: int, known: Sequence[float] = (), seconds: float = 6.0) -> np.ndarray:
        """(c,) change of level at bin `row`, a straight line on either side taken into account [ln Z]."""
        w = int(round(seconds / self.period))
        first, last = max(row - w, 0), min(row + w + 1, len(self.time))
        for time in known:
            other = int(np.argmin(np.abs(self.time - time)))
            if first <= other < row:
                first = other + 2
            elif row < other < last:
                last = other - 1
        rows = np.array([i for i in range(first, last) if abs(i - row) > 0])
        design = np.stack([np.ones(len(rows)), rows - row, (rows > row).astype(float)], axis=1)
        if (rows > row).sum() < 3 or (rows < row).sum() < 3:
            return np.zeros(self.value.shape[1])
        return np.linalg.lstsq(design, self.value[rows], rcond=None)[0][2]

    def explained_by_others(self, k: int) -> Callable[[np.ndarray], np.ndarray]:
        """A function that takes out of (m,) or (m, q) what the other electrodes can say about electrode
        `used[k]`; loaded only.

        Ridge regression on the others and on squares and products of their six principal components, because
        the place of a contact bends what two electrodes have to do with each other. What an effect does must
        go through the same function before it is fitted."""
        if k not in self._departures:
            x = np.delete(self.value, k, axis=1)
            x = x - x.mean(0)
            u, s, _ = np.linalg.svd(x, full_matrices=False)
            keep = s > 1e-9 * s[0]
            score = u[:, :6] * np.sqrt(len(x))
            i, j = np.triu_indices(score.shape[1])
            a = np.concatenate(
                [np.ones((len(x), 1)), u[:, keep] * np.sqrt(len(x)), score[:, i] * score[:, j]], axis=1
            )
            weight = np.concatenate(
                [
                    [0.0],
                    np.mean(self.noise**2) / np.maximum(s[keep] ** 2 / len(x), 1e-12),
                    np.full(len(i), 0.02),
                ]
            )
            inverse = np.linalg.inv(a.T @ a / len(x) + np.diag(weight)) @ a.T / len(x)
            self._departures[k] = a, inverse
        a, inverse = self._departures[k]
        return lambda y: y - a @ (inverse @ y)
