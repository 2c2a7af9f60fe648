"""State of a condensed skin between steps, and outcome of a step."""

import dataclasses
import functools
import typing

import numpy as np

from ..state import CONDENSED, ROOM, SavedState, StateLayout

MAX_FORCES, MAX_CONTACTS = (ROOM[name][CONDENSED] for name in ("forces", "contacts"))


@functools.cache
def layout_of(ngeom: int) -> StateLayout:
    """Layout of the state of a skin with `ngeom` geoms, as a row of numbers."""
    return StateLayout(CONDENSED, (), {"geom": ngeom})


class Memory:
    """State of a skin between steps: a row of numbers, read by the names of `state.VARIABLES`. `started`:
    whether a step was made; `forces` (k, 2): contact coordinates with a force, in ascending order, and the
    forces [N].

    Args:
      row: it is not copied. layout: `layout_of` its geoms.
    """

    def __init__(self, row: np.ndarray, layout: StateLayout):
        self.row, self.layout = row, layout

    @classmethod
    def rest(cls, ngeom: int) -> typing.Self:
        """State of a skin without contact, and without previous poses of geoms."""
        layout = layout_of(ngeom)
        return cls(layout.rest(), layout)

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        return self.layout.value(self.row, name)

    def replace(self, **changes: typing.Any) -> typing.Self:
        """A state with some values replaced."""
        out = type(self)(self.row.copy(), self.layout)
        self.layout.write(SavedState(**changes), out.row)
        return out

    @property
    def coordinate(self) -> np.ndarray:
        """Contact coordinates (k,) with a force."""
        return self.forces[:, 0].astype(int)

    @property
    def force(self) -> np.ndarray:
        """Forces (k,) on these coordinates [N]."""
        return self.forces[:, 1]


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
      slack: (ngroup,) of the groups' models, see `coupling.implicit.rounds` [m].
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
    slack: np.ndarray | float = 0.0
