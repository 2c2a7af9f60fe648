"""What a condensed skin remembers between steps, and what a step comes to."""

import dataclasses
import typing

import numpy as np

from ..state import CONDENSED, ROOM, SavedState, StateLayout

__all__ = ["MAX_CONTACTS", "MAX_FORCES", "Memory", "Outcome", "layout_of"]

MAX_FORCES, MAX_CONTACTS = (ROOM[name][CONDENSED] for name in ("forces", "contacts"))


def layout_of(ngeom: int) -> StateLayout:
    """Of a skin that so many geoms may touch, as a row of numbers."""
    return StateLayout(CONDENSED, (), {"geom": ngeom})


class Memory(SavedState):
    """What the skin remembers between steps, by the names of `state.VARIABLES`; `started` is whether a step
    was made, and `forces` (k, 2) has contact coordinates with a force, ascending, and the forces [N]."""

    @classmethod
    def rest(cls, ngeom: int) -> typing.Self:
        """Of a skin at rest that nothing has come near yet."""
        return layout_of(ngeom).rest(cls)

    @property
    def coordinate(self) -> np.ndarray:
        """(k,) contact coordinates with a force."""
        return self.forces[:, 0].astype(int)

    @property
    def force(self) -> np.ndarray:
        """(k,) on them [N]."""
        return self.forces[:, 1]

    @property
    def softening(self) -> float:
        """By which the forces were found."""
        return float(self.solved[0])

    @property
    def swelling(self) -> float:
        """The same of the liquid's pressure."""
        return float(self.solved[1])

    def key(self) -> tuple:
        """What the nodes depend on."""
        return self.forces.tobytes(), self.pressure, self.solved.tobytes()


@dataclasses.dataclass
class Outcome:
    """A solved step.

    Attributes:
      memory: what to remember.
      wrench, tangent: (ngroup, 6), (ngroup, 6, 6) of the skin on the geoms.
      vert_xpos: (nvert, 3) nodes [m].
      measured: whether the error of such a step has been measured.
      converged: whether this holds for the poses that were asked for. load_factor: else, the fraction of the
        geoms' path at which it does.
      iterations, error: Newton's, and the relative residual in the energy norm.
      load: (k,) size of the force on each of the memory's contacts [N].
      cost: as a fraction of what a hard step may cost.
    """

    memory: Memory
    wrench: np.ndarray
    tangent: np.ndarray
    vert_xpos: np.ndarray
    measured: bool
    converged: bool
    iterations: int
    error: float
    load: np.ndarray
    load_factor: float = 1.0
    cost: float = 0.0
