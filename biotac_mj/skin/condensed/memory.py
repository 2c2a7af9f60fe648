"""State of a condensed skin between steps, and outcome of a step."""

import dataclasses
import typing

import numpy as np

from ..state import CONDENSED, ROOM, SavedState, StateLayout

__all__ = ["MAX_CONTACTS", "MAX_FORCES", "Memory", "Outcome", "layout_of"]

MAX_FORCES, MAX_CONTACTS = (ROOM[name][CONDENSED] for name in ("forces", "contacts"))


def layout_of(ngeom: int) -> StateLayout:
    """Layout of the state of a skin with `ngeom` geoms, as a row of numbers."""
    return StateLayout(CONDENSED, (), {"geom": ngeom})


class Memory(SavedState):
    """State of a skin between steps, by the names of `state.VARIABLES`. `started`: whether a step was made;
    `forces` (k, 2): contact coordinates with a force, in ascending order, and the forces [N]."""

    @classmethod
    def rest(cls, ngeom: int) -> typing.Self:
        """State of a skin without contact, and without previous poses of geoms."""
        return layout_of(ngeom).rest(cls)

    @property
    def coordinate(self) -> np.ndarray:
        """Contact coordinates (k,) with a force."""
        return self.forces[:, 0].astype(int)

    @property
    def force(self) -> np.ndarray:
        """Forces (k,) on these coordinates [N]."""
        return self.forces[:, 1]

    def contents(self) -> tuple:
        """All variables, to be compared."""
        values = sorted(vars(self).items())
        return tuple(v.tobytes() if isinstance(v, np.ndarray) else v for _, v in values)

    def key(self) -> tuple:
        """All variables on which the nodes depend."""
        return self.forces.tobytes(), self.pressure, self.solved.tobytes()


@dataclasses.dataclass
class Outcome:
    """A solved step.

    Attributes:
      memory: state after the step.
      wrench, tangent: (ngroup, 6), (ngroup, 6, 6) of the skin on the geoms.
      vert_xpos: (nvert, 3) nodes [m].
      measured: whether the error of such a step was measured.
      converged: whether the results are valid for the given poses. load_factor: fraction of the geoms' path
        at which they are valid.
      iterations, error: of Newton's method, and relative residual in the energy norm.
      load: (k,) size of the force on each contact of the state [N].
      cost: as a fraction of the limit for a difficult step.
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
