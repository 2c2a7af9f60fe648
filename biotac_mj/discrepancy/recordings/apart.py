"""What sets electrodes apart from the others of the same recording, whatever its cause: numbers of each, most of
them logarithms, that are alike among the electrodes of a sound sensor. Nothing here has a name; how far one
stands above the median electrode is compared with recordings without an effect (`rest.py`)."""

import numpy as np

from ...sensor.channels import FULL_SCALE, log_impedance
from ..noise import sound_noise
from .families.courses import hats
from .model import slope_of

__all__ = ["SAID", "apart"]

_CELLS, _SHORT = 24, 60  # of noise, and rows of each at least
_CLIP, _OWN = 6.0, 0.05  # of a sample's noise; of a channel's noise, that no other knows of
_BIN = 0.1  # [s]
_AXES, _KNOTS = 5, 6  # of the load, whose products are among the regressors; of a course over time
_BLOCKS = 8
_COUNT = 1.0  # [counts] that nothing says
# what one does where a number of its is unusual
SAID = {
    "noise": "is noisier than the others",
    "dull": "has less noise than the others",
    "swings": "has noise that comes and goes",
    "tails": "is far off again and again",
    "equal": "repeats values",
    "since": "answers otherwise after some time",
}


def apart(x: np.ndarray, rate: float) -> tuple[dict, np.ndarray]:
    """Numbers of each electrode.

    Args:
      x: (n, c) counts, no row a repetition; rate: of these rows [Hz].

    Returns:
      name, whose first word is of SAID -> (c,); and what the others do not say of each (m, c) [counts], in bins.
    """
    x = np.clip(x, 1.0, FULL_SCALE - 1)
    law, width = sound_noise(np.median(x, axis=0)), max(1, round(_BIN * rate))
    x = x[: len(x) // width * width]
    z = log_impedance(x).reshape(-1, width, x.shape[1]).mean(1) * slope_of(x)
    z -= z.mean(0)
    left, better = _left(z, law**2 / width)
    time = np.linspace(-1, 1, len(z))[:, None]
    since = {"since 0.5": z * (time > 0), "since 0.7": z * (time > 0.4), "since": z * time}
    return _noise(x, law) | {name: better(column) for name, column in since.items()}, left


def _noise(x, law):
    """Of the fifth differences: size, tails, and how it comes and goes; and values that come again."""
    d = np.diff(x, n=5, axis=0) / np.sqrt(252) / law
    clipped = np.clip(d, -_CLIP, _CLIP)
    P = np.linalg.inv(clipped.T @ clipped / len(d) + _OWN * np.eye(len(law)))
    own = d + clipped @ P / np.diag(P) - clipped  # without the load's part
    size = max(_SHORT, len(own) // _CELLS)
    cells = np.abs(own[: len(own) // size * size]).reshape(-1, size, len(law))
    level = np.log(np.quantile(cells, 0.8, axis=1) / 1.28 + 0.2 / law)
    level -= np.median(level, axis=1)[:, None]
    low, middle, loud, high = np.quantile(level, [0.1, 0.5, 0.85, 0.9], axis=0)
    usual, far = np.quantile(np.abs(own), [0.6, 0.998], axis=0) + 0.1 / law
    step = np.diff(x, axis=0)
    swing = np.sqrt(np.mean(np.clip(step / law, -8, 8) ** 2, axis=0)) * law
    chance = 0.4 / np.maximum(swing, 0.3)
    return {
        "noise": loud,
        "dull": -middle,
        "swings": high - low,
        "tails": np.log(far / usual),
        "equal": np.log(((step == 0).mean(0) + 0.01) / (chance + 0.01)),
    }


def _left(z, noise):
    """What the others, their products and a course do not say of each electrode of z (m, c) [counts], with this
    variance of noise; and a function of a column of each (m, c): how much better that says it, in blocks left
    out."""
    m, c = z.shape
    time = np.linspace(-1, 1, m)
    score = z @ np.linalg.svd(z, full_matrices=False)[2][:_AXES].T
    score /= score.std(0) + 1e-9
    i, j = np.triu_indices(_AXES)
    bent, course = np.clip(score[:, i] * score[:, j], -5, 5), hats(time, np.linspace(-1, 1, _KNOTS))[:, 1:]
    y = np.hstack([z, bent, course])
    y -= y.mean(0)
    floor = np.r_[noise + _COUNT**2, np.full(len(i), 0.02), np.full(_KNOTS - 1, 1e-3)]
    P = np.linalg.inv(y.T @ y / m + np.diag(floor))
    diagonal, k = np.diag(P)[:c], np.arange(c)
    left = y @ P[:, :c] / diagonal
    block = np.arange(m) * _BLOCKS // m
    number = np.bincount(block)[:, None] + 0.0

    def sums(a):
        return np.add.reduceat(a, np.searchsorted(block, np.arange(_BLOCKS)), axis=0)

    def better(column):
        """(c,) logarithms of mean squares, each electrode's column less what the others say of that, too."""
        column = column - column.mean(0)
        V = y.T @ column / m
        V[k, k] = 0
        W = P @ V
        W -= P[:, :c] * (W[k, k] / diagonal)
        W[k, k] = 0
        column = column - y @ W
        both, own, now = sums(column * left), sums(column**2), sums(left**2)
        beta = (both.sum(0) - both) / (own.sum(0) - own + 1e-9)
        then = now - 2 * beta * both + beta**2 * own
        return np.clip(np.log((now / number + 1) / (then / number + 1)), -1, 3).mean(0)

    return left, better
