"""A fault of a log."""

import dataclasses
from collections.abc import Callable

import numpy as np

__all__ = ["Fault"]


@dataclasses.dataclass
class Fault:
    """A fault of a log of n rows and c channels.

    Attributes:
      id: "clock", "contact", "freeze", "hum", "jump", "lost_rows", "order", "overflow", "quantise",
        "saturate", "spikes" or "stuck".
      channels: numbers from 0. start, end: [s] from the first row. message: one line.
      parameters: name -> (value, low, high), nan where no interval is known.
      mask: (n, c) bool, samples that are no measurement, or None.
      correct: (counts (n, c)) -> counts without the fault, or None where that is not possible.
      places: [s], where it happens at some times.
      beyond: of masked samples, 1: the true value lies above the recorded one, -1: below, 0: unknown.
      silent: whether its channels show one value whatever touches them. held: whether it is of rows that
        repeat or tremble about the one before.
      detector: key of `confidence.WEIGHTS`. features: numbers that its confidence is computed from.
      nats: log likelihood ratio against chance. p: that chance alone is as strong. confidence: 0..1.
      ties: ids of effects that look the same.
    """

    id: str
    channels: tuple[int, ...]
    start: float
    end: float
    message: str
    parameters: dict[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
    mask: np.ndarray | None = None
    correct: Callable[[np.ndarray], np.ndarray] | None = None
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
        """[counts] between the codes that are read where some are left out, else 0."""
        return self.parameters.get("step", (0.0,))[0]
