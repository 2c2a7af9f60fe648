"""What an effect on plain recordings is: found in a `Session`, applied to clean counts, taken out of measured
ones."""

import abc
import dataclasses
from typing import Any

import numpy as np

__all__ = ["Finding", "Parameter", "RecordedEffect", "runs", "spans"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """unit; bounds low, high; source of the bounds."""

    unit: str
    low: float
    high: float
    source: str


@dataclasses.dataclass
class Finding:
    """An effect that was found.

    Attributes:
      effect: RecordedEffect. channels: electrode numbers from 0. theta: what `apply` and `correct` need.
      parameters: name -> (value, low, high) to report; low and high are nan where no interval is known.
      nats: evidence, log-likelihood of effectively independent samples less the price of the parameters. p:
        of the test, blocks in time.
      start, end: [s] when it acts. ties: ids that fit as well. note: in words.
      statistic: name, unit and value of the number that diagnoses the effect, before and after, on the part
        kept aside.
      verified: whether the part kept aside confirms it; None if it could not be checked. confidence: 0..1.
    """

    effect: "RecordedEffect"
    channels: tuple
    theta: dict
    parameters: dict
    nats: float
    start: float
    end: float
    p: float = float("nan")
    ties: tuple = ()
    note: str = ""
    statistic: dict = dataclasses.field(default_factory=dict)
    verified: bool | None = None
    confidence: float = 0.0

    @property
    def id(self) -> str:
        return self.effect.id

    def correct(self, counts: np.ndarray, time: np.ndarray) -> np.ndarray:
        return self.effect.correct(counts, time, self.channels, self.theta)

    def apply(self, counts: np.ndarray, time: np.ndarray) -> np.ndarray:
        return self.effect.apply(counts, time, self.channels, self.theta)


class RecordedEffect(abc.ABC):
    """One effect that recordings alone can show.

    Subclasses set id, name, stage (of STAGES), physics, params (name -> Parameter) and confusable (id -> what
    would tell them apart) and write

      find(session) -> list of Finding: on the rows `session.fit` only;
      apply(counts, time, channels, theta): counts (n, 19) as the effect changes them;
      correct(...): the inverse, as far as there is one; samples that cannot be had back are marked by `mask`;
      statistic(session, counts, rows, finding): the number that shows the effect, near zero without it.
    """

    id = name = stage = physics = unit = ""
    params: dict = {}
    confusable: dict = {}

    @abc.abstractmethod
    def find(self, session: Any) -> list:
        """Findings in the part of the session that may be fitted."""

    def apply(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return counts

    def correct(self, counts: np.ndarray, time: np.ndarray, channels: tuple, theta: dict) -> np.ndarray:
        return counts

    def mask(self, counts: np.ndarray, time: np.ndarray, finding: "Finding") -> np.ndarray | None:
        """(n, 19) bool of samples that are no measurement, or None."""
        return None


def runs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Starts and lengths of runs of equal values."""
    edge = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0) + 1, [len(x)]])
    return edge[:-1], np.diff(edge)


def spans(flag: np.ndarray, edges: np.ndarray, least: int = 2) -> list[tuple[float, float]]:
    """Contiguous stretches [s] of windows that are True; edges (w + 1,) [s]. One window missing inside a
    stretch is bridged."""
    flag = np.asarray(flag, bool).copy()
    flag[1:-1] |= flag[:-2] & flag[2:]
    starts, lengths = runs(flag.astype(int))
    return [
        (float(edges[s]), float(edges[s + n]))
        for s, n in zip(starts, lengths)
        if flag[s] and n >= min(least, len(flag))
    ]
