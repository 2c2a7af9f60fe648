"""Assumptions of a diagnosis of data with poses: priors, one bound on effort and one rate of false
discoveries."""

import dataclasses
import hashlib
import json

from ..evidence import RATE


@dataclasses.dataclass(frozen=True)
class Settings:
    """Attributes:
    resolution: of the largest changes of a group of channels, by which the base model is expected to be off
      (mesh, tier, film: docs/lab/condensed.md).
    spread, own: standard deviations of the logarithm of how far a group, and a channel of it, is off.
    law: fraction of what an effect does, by which its true law is another: median of the prior; the standard
      deviation of its logarithm is `own`.
    wide: standard deviation of a parameter, in units of `Param.scale`.
    rate: of false discoveries. explained: fraction of its gap on held-out trajectories that an effect with a
      name closes. beyond: times as much as is expected of a model, from which on it misses something.
    most, refit: effects of an explanation; effects that are refitted after the screen.
    """

    resolution: float = 0.01
    spread: float = 1.5
    own: float = 0.5
    law: float = 0.1
    wide: float = 2.5
    rate: float = RATE
    explained: float = 0.2
    beyond: float = 3.0
    most: int = 3
    refit: int = 6

    @property
    def hash(self) -> str:
        """Names the settings that a verdict was reached with."""
        return hashlib.sha256(json.dumps(dataclasses.asdict(self)).encode()).hexdigest()[:12]


SETTINGS = Settings()
