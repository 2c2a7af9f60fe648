"""What can be named in a recording: effects of the catalogue; a candidate with its parameters, and how it is
taken out of the counts."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ...effects.catalogue import entries
from ...effects.effect import Effect
from ..report.verdict import Gap

__all__ = ["KINDS", "Candidate"]


KINDS = {effect.id: effect for effect in entries("log")}


@dataclasses.dataclass
class Candidate:
    """An effect that the search has found, with what the search needs to go on; a `report.verdict.Finding` is
    what is said of it.

    Attributes:
      id: of KINDS; channels: electrode numbers from 0; parameters: name -> (value, low, high), nan where no
        interval is known.
      nats: evidence on blocks left out; p: sign flips of these blocks; start, end [s]; ties: ids that the
        evidence does not part; note: in words.
      clues: numbers that the confidence is made of (`confidence.py`); confidence 0..1.
      correct: (counts (n, 19), time (n,)) -> counts without the effect, or None; mask: (n, 19) bool of
        samples that are no measurement, or None; delay: [s] by which the electrodes follow the force later.
      beyond: of what is masked, 1: it lay above what was recorded, -1: below, 0: nothing is known of it.
      gap: on the rows kept aside, None where nothing there measures it; verified: whether they confirm it,
        None where they cannot.
    """

    id: str
    channels: tuple
    parameters: dict
    nats: float
    p: float
    start: float
    end: float
    note: str = ""
    ties: tuple = ()
    clues: dict = dataclasses.field(default_factory=dict)
    confidence: float = 0.0
    correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    mask: np.ndarray | None = None
    beyond: int = 0
    delay: float = 0.0
    gap: Gap | None = None
    verified: bool | None = None

    @property
    def kind(self) -> Effect:
        return KINDS[self.id]
