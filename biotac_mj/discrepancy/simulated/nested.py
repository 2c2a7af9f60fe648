"""Nested models of one recording, each fitted on one half of the blocks of time and judged on the other."""

import dataclasses

import numpy as np

from ...matching.fit import Constants, Rows, Setup, fit_constants, fit_states
from ...matching.response import Response
from ...sensor.channels import counts_from_log_impedance
from ..evidence import sign_flip

__all__ = ["Compared", "Judged", "blocks", "compare", "judge", "noise_of_prediction"]

_BLOCKS = 16  # of time: rows of one press are one piece of evidence


@dataclasses.dataclass(frozen=True, eq=False)
class Judged:
    """A model on both halves of n rows, each by constants that the other half gave.

    Attributes:
      constants: of the first and of the second half. state: (n, 4). error: (n, 19) modelled less measured
        [counts]. own: (n, 19) error by the half's own constants. change: (n, 19) modelled change of the
        counts from rest.
    """

    constants: tuple[Constants, Constants]
    state: np.ndarray
    error: np.ndarray
    own: np.ndarray
    change: np.ndarray


@dataclasses.dataclass(frozen=True)
class Compared:
    """A model against a larger one that contains it, on rows that neither was fitted on.

    Attributes:
      before, after: RMS [counts]. gain: by how much each block's mean squared error falls [counts^2].
    """

    before: float
    after: float
    gain: tuple[float, ...]

    @property
    def p(self) -> float:
        """Of the error falling, by sign flips of the blocks."""
        return sign_flip(np.array(self.gain))

    @property
    def better(self) -> int:
        """Blocks in which it falls."""
        return sum(gain > 0 for gain in self.gain)

    @property
    def closed(self) -> float:
        """Share of the squared error that the larger model takes away; below 0 where it adds to it."""
        return 1 - (self.after / max(self.before, 1e-12)) ** 2


def blocks(n: int) -> list[np.ndarray]:
    """Row numbers of the blocks of n rows, in order."""
    return np.array_split(np.arange(n), _BLOCKS)


def halves(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Row numbers of every other block, and of the others: no drift is carried beyond where it was seen."""
    parts = blocks(n)
    return np.concatenate(parts[::2]), np.concatenate(parts[1::2])


def judge(response: Response, rows: Rows, setup: Setup, begin: Judged | None = None) -> Judged:
    """Fits a model to each half and judges it on the other.

    Args:
      begin: a smaller model from whose constants and states the search goes on; None begins anew.
    """
    parts = halves(len(rows))
    constants = []
    for k, part in enumerate(parts):
        start = begin and (begin.constants[k], begin.state[part])
        constants.append(fit_constants(response, rows[part], setup, start)[0])
    state, error = np.zeros((len(rows), 4)), np.zeros((len(rows), rows.counts.shape[1]))
    own, change = np.zeros_like(error), np.zeros_like(error)
    for k, part in enumerate(parts):
        other, mine = constants[1 - k], constants[k]
        also = None if begin is None else begin.state[part]
        found = fit_states(response, rows[part], other, setup, also=also)
        again = fit_states(response, rows[part], mine, setup, also=found.state)
        rest = counts_from_log_impedance(other.offset + other.drifted(rows[part].time)[:, None])
        state[part], error[part] = found.state, found.counts - rows[part].counts
        own[part], change[part] = again.counts - rows[part].counts, found.counts - rest
    return Judged(tuple(constants), state, error, own, change)


def compare(smaller: Judged, larger: Judged, electrodes: np.ndarray | list | None = None) -> Compared:
    """Whether the larger model errs less on some electrodes (numbers from 0; None: all)."""
    which = np.arange(smaller.error.shape[1]) if electrodes is None else np.asarray(electrodes)
    square = [
        np.array([(judged.error[b][:, which] ** 2).mean() for b in blocks(len(judged.error))])
        for judged in (smaller, larger)
    ]
    gain = square[0] - square[1]
    rms = [float(np.sqrt(s.mean())) for s in square]
    return Compared(*rms, tuple(gain.tolist()))


def noise_of_prediction(judged: Judged) -> np.ndarray:
    """(n, 19) standard deviation of a prediction: how far constants of both halves part on the same rows."""
    return np.abs(judged.error - judged.own) / np.sqrt(2)
