"""The joint model of all electrodes: rest + load on few dimensions + what develops over time + noise.

Electrodes and the products of their principal components are one Gaussian (`conditional.py`) whose covariance
is taken from changes *within* cells of a few seconds, so that nothing slow enters it. The true direction p of
an effect has the most energy in units of 1 / sqrt(p'P p) (Cauchy-Schwarz). So an effect is assigned to the
channel that has it, and not to channels that are correlated with it."""

import numpy as np

from ...quality.noise import noise_level
from ...sensor.channels import FULL_SCALE, log_impedance
from .conditional import Components, Conditional

_BIN = 0.1  # [s]: load moves by hand, below 10 Hz
_CELLS = 48  # of the rows fitted, whose levels are compared
WINDOW = (2.0, 4.0)  # [s] within which a change is load: at least and at most
LEAST = 16.0  # [s] fitted, in which load and drift can be separated: eight windows
_MOVED = 6.0  # [counts] within windows, of the six liveliest electrodes
_DIMENSIONS = 8  # of the load at most
_FLOOR = 0.02  # variance of a product that no load makes


def slope_of(counts: np.ndarray) -> np.ndarray:
    """(c,) counts by which an electrode rises when ln Z falls by one, at the median of counts (n, c)."""
    middle = np.clip(np.median(counts, axis=0), 1, FULL_SCALE - 1)
    return middle * (1 - middle / FULL_SCALE)


class Model:
    """Bins of a recording and the Gaussian of the rows that are fitted. m bins, c usable electrodes.

    Args:
      counts: (n, nelectrode); good: (n, nelectrode) bool, samples that are measurements; fit: (n,) bool,
        contiguous from row 0; rate: [Hz]; fresh: fraction of the rows that are no repetition.

    Attributes:
      used (c,) electrode numbers; time (m,) [s]; value (m, c) ln Z about the mean of the rows fitted;
      inside (m,) bool, bins fitted; slope (c,) [counts]; noise (c,) of a bin [ln Z]; dimensions of the load,
      0 of an unloaded sensor; activity (c,) RMS change within windows [ln Z]; moved: whether by as much as a
      load; parted: whether nothing moved, or for long enough to separate load and drift; given: Gaussian of
      electrodes and products; whole (m, c + products).
    """

    def __init__(self, counts: np.ndarray, good: np.ndarray, fit: np.ndarray, rate: float, fresh: float):
        n = len(counts)
        self.width = int(max(1, min(round(_BIN * rate), fit.sum() // 200)))
        m = n // self.width
        rows = fit & good.any(1)  # rows without any good sample are a fault of the log, not of a channel
        self.used = np.flatnonzero(good[rows].mean(0) > 0.5)
        self.rate, self.period = rate, self.width / rate
        self.time = (np.arange(m) + 0.5) * self.period
        self.inside = self.time < fit.sum() / rate
        self.slope = slope_of(counts[rows][:, self.used])
        x = log_impedance(counts[: m * self.width, self.used]).reshape(m, self.width, -1)
        weight = good[: m * self.width, self.used].reshape(x.shape)
        self.known = weight.mean(1) > 0.5
        self.known |= weight.any(1) & (good[: m * self.width].any(1).reshape(m, -1).mean(1) < 0.5)[:, None]
        # of one whose samples are too sparse for bins, as every second of bins of two, any will do
        self.known |= weight.any(1) & (self.known[self.inside].mean(0) < 0.5)
        x = np.where(self.known, (x * weight).sum(1) / np.maximum(weight.sum(1), 1), np.nan)
        self.mean = np.nanmean(x[self.inside], axis=0)
        x = x - self.mean
        sample = noise_level(counts[rows][:, self.used])
        self.noise = sample / self.slope / np.sqrt(max(1.0, self.width * fresh))
        last = np.zeros(x.shape, int)  # a gap takes the bin before it, then the prediction from the others
        last[self.known] = np.nonzero(self.known)[0]
        last = np.maximum.accumulate(last, axis=0)
        first = np.argmax(self.known, axis=0)
        last = np.where(np.arange(m)[:, None] < first, first, last)
        self.value = np.take_along_axis(np.where(self.known, x, 0), last, axis=0)
        self._fit()
        if not self.known.all():
            for _ in range(2):
                self.value = np.where(self.known, self.value, self.value - self.residual())
                self._fit()

    def _fit(self):
        span = int(np.clip(self.inside.sum() / 24, WINDOW[0] / self.period, WINDOW[1] / self.period))
        span = max(4, span)
        x = self.value
        centred = x - x.mean(1, keepdims=True)
        long = bool(self.inside.sum() * self.period >= LEAST)
        within = _within(x[self.inside], span, self.known[self.inside], 0.96 if long else 1.0)
        self.activity = np.sqrt((within**2).mean(0))
        # dimensions that move by more than noise and rounding do
        lively = np.linalg.eigvalsh((within / self.noise).T @ (within / self.noise) / len(within))[::-1]
        self.dimensions = int(min((lively > 9).sum(), _DIMENSIONS, np.sqrt(len(within) / 12)))
        # a load moves electrodes by tens of counts within seconds; noise, filtered or not, does not
        self.moved = bool(np.median(np.sort(self.activity * self.slope)[-6:]) >= _MOVED)
        self.parted = long or not self.moved
        if not (self.parted and self.moved):
            self.dimensions = 0
        q = self.dimensions
        self.whole = x
        if not q:
            self.given = Conditional(np.zeros((len(self.used),) * 2), self.noise**2)
            return
        products = Components(centred[self.inside], q).products(centred)
        self.whole = np.concatenate([x, products], axis=1)
        within = _within(self.whole[self.inside], span, self.known[self.inside])
        floor = np.concatenate([self.noise**2, np.full(products.shape[1], _FLOOR)])
        self.given = Conditional(within.T @ within / len(within), floor, len(self.used))

    def residual(self, value: np.ndarray | None = None) -> np.ndarray:
        """(m, c) residual of every electrode given the others [ln Z]; unloaded: less the common change.
        value: (m, c) other levels than the model's own."""
        if not self.dimensions:
            value = self.value if value is None else value
            return value - self.shared(np.ones(len(self.used)), value)[:, None]
        return self.given.residual(self._rows(value))

    def shared(self, pattern: np.ndarray, value: np.ndarray | None = None) -> np.ndarray:
        """(m,) amplitude of a pattern (c,); unloaded the median over electrodes, so that none decides
        alone."""
        if not self.dimensions:
            return np.median((self.value if value is None else value) / pattern, axis=1)
        return self.given.along(pattern, self._rows(value))

    def _rows(self, value):
        """(m, c + products) with other levels (m, c)."""
        c = len(self.used)
        return self.whole if value is None else np.concatenate([value, self.whole[:, c:]], axis=1)

    def levels(self, series: np.ndarray, every: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Means (w, ...) of a series (m, ...) over cells, of the bins fitted or of all, and the cells' times
        (w,)."""
        size = max(1, int(self.inside.sum() // _CELLS))
        rows = len(self.time) if every else int(self.inside.sum())
        w = rows // size
        cells = series[: w * size].reshape(w, size, *series.shape[1:])
        return cells.mean(1), self.time[: w * size].reshape(w, size).mean(1)


def _within(x, span, known, usual=0.96):
    """(rows, q) less the mean and slope of every window of span rows; all but a usual fraction of them, the
    liveliest, are left out, for a step within one is a change of the sensor and not of the load, and those
    with holes (m, c) while enough are left."""
    span = min(span, len(x))  # a part may be shorter than a window
    k = len(x) // span
    cells = x[: k * span].reshape(k, span, -1)
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, span), 2))[0]
    cells = (cells - basis @ (basis.T @ cells)) * np.sqrt(span / (span - 2))
    energy = (cells / np.maximum(np.sqrt((cells**2).mean((0, 1))), 1e-12)) ** 2
    energy = energy.mean(1).max(1)
    keep = energy <= np.quantile(energy, usual)
    whole = known[: k * span].reshape(k, -1).all(1)
    if (keep & whole).sum() * span > 2 * x.shape[1]:
        keep &= whole
    return cells[keep].reshape(-1, x.shape[1])
