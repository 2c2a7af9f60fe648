"""What a condensed skin remembers between steps, and what a step comes to."""

import dataclasses

import numpy as np

__all__ = ["MAX_CONTACTS", "MAX_FORCES", "Memory", "Outcome"]

MAX_FORCES, MAX_CONTACTS = 1024, 2048  # that a memory may have


@dataclasses.dataclass
class Memory:
    """What the skin remembers between steps.

    Attributes:
      started: whether a step was made.
      coordinate: (n,) contact coordinates with a force, ascending.
      force, change: (n,) forces and by how much they changed in the last step [N].
      pressure: of the liquid above that at rest [Pa]. bulge: the nonlinear part q of the cavity's volume
        [m^3], growth: by how much it grew in the last step.
      softening, swelling: s and c. after: (2,) what they are where the step left the skin, drift: (2,) by how
        much that grew in it.
      geom_pos, geom_mat, motion: (ngeom, 3) [m], (ngeom, 3, 3) at the end of the last step, (ngeom, 3) how
        far they moved in it [m].
      contacts: (k, 5) sample, geom and anchor (in the geom's frame) [m] of what touches.
    """

    started: bool
    coordinate: np.ndarray
    force: np.ndarray
    change: np.ndarray
    pressure: float
    bulge: float
    growth: float
    softening: float
    swelling: float
    after: np.ndarray
    drift: np.ndarray
    geom_pos: np.ndarray
    geom_mat: np.ndarray
    motion: np.ndarray
    contacts: np.ndarray

    @classmethod
    def rest(cls, ngeom: int) -> "Memory":
        """Of a skin at rest that nothing has come near yet."""
        none, pos = np.zeros(0), np.zeros((ngeom, 3))
        forces = none.astype(int), none, none
        liquid = 0.0, 0.0, 0.0, 1.0, 1.0, np.ones(2), np.zeros(2)
        return cls(False, *forces, *liquid, pos, np.zeros((ngeom, 3, 3)), pos, np.zeros((0, 5)))

    def key(self) -> tuple:
        """What the nodes depend on."""
        forces = self.coordinate.tobytes(), self.force.tobytes()
        return *forces, self.pressure, self.softening, self.swelling


@dataclasses.dataclass
class Outcome:
    """A solved step.

    Attributes:
      memory: what to remember.
      wrench, tangent: (ngroup, 6), (ngroup, 6, 6) of the skin on the geoms.
      vert_xpos: (nvert, 3) nodes [m].
      measured: whether the error of such a step has been measured.
      converged: whether this holds for the poses that were asked for. reached: else, the share of the geoms'
        way at which it does.
      iterations, error: Newton's, and the relative residual in the energy norm.
      load: (k,) size of the force on each of the memory's contacts [N].
      cost: as a share of what a hard step may cost.
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
    reached: float = 1.0
    cost: float = 0.0
