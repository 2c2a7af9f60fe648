"""Candidates of a recording: effects of the catalogue with their parameters, and their removal from the
counts."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ...effects.catalogue import entries
from ...effects.effect import Effect
from ..report.verdict import Gap

if TYPE_CHECKING:
    from .detectors.trends import Trend

__all__ = ["KINDS", "Detector", "Candidate"]


KINDS = {effect.id: effect for effect in entries("log")}
_MOST = 12  # electrodes: what more have is of the sensor


@dataclasses.dataclass(frozen=True)
class Detector:
    """A class of findings with one confidence.

    Attributes:
      name: key of the confidence's weights.
      pair: finds faults that a connector gives to two electrodes: the other of a pair is no argument against
        either.
      sudden: finds what happens between two rows, by these rows alone: several findings of one row are one
        event, and held-out rows say nothing more of it.
      beside_load: compares an electrode with the others while a load moves them.
      of_log: finds faults of the log itself, by their own rows and those beside them.
    """

    name: str
    pair: bool = False
    sudden: bool = False
    beside_load: bool = False
    of_log: bool = False


@dataclasses.dataclass(eq=False)
class Candidate:
    """An effect that the search has found, with what the search needs to go on; a `report.verdict.Finding` is
    what is said of it.

    Attributes:
      id: of KINDS; channels: electrode numbers from 0; parameters: name -> (value, low, high), nan where no
        interval is known.
      nats: evidence on blocks left out; p: sign flips of these blocks; start, end [s]; ties: ids that the
        evidence does not part; note: in words.
      detector; features: numbers that its confidence is computed from; confidence 0..1.
      correct: (counts (n, 19), time (n,)) -> counts without the effect, or None; mask: (n, 19) bool of
        samples that are no measurement, or None; delay: [s] by which the electrodes follow the force later.
      beyond: of what is masked, 1: it lay above what was recorded, -1: below, 0: nothing is known of it.
      trend: of levels over time, or None; share: (19,) of it that each electrode has, None of a single one.
      places: [s], where it happens at some times.
      gap: on the held-out rows, None where nothing there measures it; verified: whether they confirm it,
        None where they cannot.
    """

    id: str
    channels: tuple
    parameters: dict
    nats: float
    p: float
    start: float
    end: float
    detector: Detector
    note: str = ""
    ties: tuple = ()
    features: dict[str, float] = dataclasses.field(default_factory=dict)
    confidence: float = 0.0
    correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    mask: np.ndarray | None = None
    beyond: int = 0
    delay: float = 0.0
    trend: "Trend | None" = None
    share: np.ndarray | None = None
    places: tuple[float, ...] = ()
    gap: Gap | None = None
    verified: bool | None = None

    @property
    def kind(self) -> Effect:
        return KINDS[self.id]

    @property
    def possible(self) -> bool:
        """Whether its parameters lie within the catalogue's bounds."""
        return self.kind.possible(self.parameters)

    @property
    def of_all(self) -> bool:
        """Whether it is of the sensor rather than of some electrodes."""
        return len(self.channels) > _MOST

    @property
    def where(self) -> str:
        """Its electrodes in words, " e3, e4"; nothing where it is of all."""
        return "" if self.of_all else " " + ", ".join(f"e{k + 1}" for k in self.channels[:4])
