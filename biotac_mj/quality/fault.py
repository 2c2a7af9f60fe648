"""A fault of a log."""

import dataclasses
from collections.abc import Callable

import numpy as np


@dataclasses.dataclass(eq=False)
class Fault:
    """A fault of a log of n rows and c channels.

    Attributes:
      id: "again", "clock", "contact", "freeze", "hum", "jump", "lost_rows", "noise", "order",
        "overflow", "quantise", "saturate", "spikes" or "stuck".
      channels: from 0. start, end: [s] from the first row. message: one line.
      parameters: name -> (value, low, high), nan if no interval is known.
      mask: (n, c) bool, samples without a measurement, or None.
      correct: (counts (n, c), time (n,) [s]) -> counts without the fault, or None if it cannot be corrected.
      places: times of single events [s].
      beyond: side of the true value of masked samples: 1 above the recorded one, -1 below, 0 unknown.
      silent: whether its channels do not respond to contact. held: whether rows repeat the
        one before (sample and hold).
      detector: key of `confidence.WEIGHTS`. features: inputs of its confidence.
      nats: log-likelihood ratio against chance. p: probability by chance. confidence: 0..1.
      ties: ids of effects that it cannot be distinguished from.
    """

    id: str
    channels: tuple[int, ...]
    start: float
    end: float
    message: str
    parameters: dict[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
    mask: np.ndarray | None = None
    correct: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    places: tuple[float, ...] = ()
    beyond: int = 0
    silent: bool = False
    held: bool = False
    detector: str = ""
    features: dict[str, float] = dataclasses.field(default_factory=dict)
    nats: float = 0.0
    p: float = 0.0
    confidence: float = 1.0
    ties: tuple[str, ...] = ()

    @property
    def step(self) -> float:
        """Distance between occurring codes [counts] if some are omitted, else 0."""
        return self.parameters.get("step", (0.0,))[0]
