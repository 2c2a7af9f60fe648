"""What can be named in a recording: effects of the catalogue; a finding with its parameters, and how it is
taken out of the counts."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ...effects.catalogue import entries
from ...effects.effect import Effect

__all__ = ["KINDS", "Finding"]


KINDS = {effect.id: effect for effect in entries("log")}


@dataclasses.dataclass
class Finding:
    """An effect that was found.

    Attributes:
      id: of KINDS; channels: electrode numbers from 0; parameters: name -> (value, low, high), nan where no
        interval is known.
      nats: evidence on blocks left out; p: sign flips of these blocks; start, end [s]; ties: ids that the
        evidence does not part; note: in words.
      clues: numbers that the confidence is made of (`confidence.py`); confidence 0..1.
      correct: (counts (n, 19), time (n,)) -> counts without the effect, or None; mask: (n, 19) bool of
        samples that are no measurement, or None; delay: [s] by which the electrodes follow the force later.
      beyond: of what is masked, 1: it lay above what was recorded, -1: below, 0: nothing is known of it.
      gap: name, unit, before, after, noise on the rows kept aside; verified: whether they confirm it, None
        where they cannot.
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
    gap: dict = dataclasses.field(default_factory=dict)
    verified: bool | None = None

    @property
    def kind(self) -> Effect:
        return KINDS[self.id]
