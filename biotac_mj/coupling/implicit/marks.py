"""Worlds that take part in a stage of the coupled step. The others are frozen: no launch changes a bit of
them."""

import warp as wp


@wp.struct
class MarkedWorlds:
    """Marks [world], and whether any is set."""

    world: wp.array(dtype=int)
    any: wp.array(dtype=int)


@wp.func
def mark(marks: MarkedWorlds, w: int):
    marks.world[w] = 1
    marks.any[0] = 1


class Marks:
    """Marked worlds, none at first, on Warp's default device.

    Attributes:
      world: (nworld,) wp.array int, 1 where marked. any: (1,) wp.array int, 1 where any is.
      struct: both, for kernels.
    """

    def __init__(self, nworld: int):
        self._all = wp.zeros(nworld + 1, dtype=int)
        self.world, self.any = self._all[:nworld], self._all[nworld:]
        self.struct = MarkedWorlds()
        self.struct.world, self.struct.any = self.world, self.any

    def clear(self) -> None:
        """Marks none. Launches only."""
        self._all.zero_()

    def fill(self) -> None:
        """Marks all. Launches only."""
        self._all.fill_(1)

    def copy(self, other: "Marks") -> None:
        """Marks those of another. Launches only."""
        wp.copy(self._all, other._all)
