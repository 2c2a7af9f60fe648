"""All skins of a step at once, with their bodies one after the other in each array."""

from collections.abc import Sequence

import numpy as np

from .coupled import Coupled
from .springs import Springs


class SkinGroup:
    """Skins of one step, none of them idle.

    Attributes:
      correction, amiss, excess: (n, 6) of `Coupled`, of all bodies.
    """

    def __init__(self, skins: Sequence[Coupled], springs: Springs):
        ends = np.cumsum([0, *(len(skin.jacobian) for skin in skins)]).tolist()
        self._skins, self._begins = skins, ends[:-1]
        jacobian = np.concatenate([skin.jacobian for skin in skins])
        self._rows = jacobian.reshape(6 * ends[-1], jacobian.shape[2])
        self._springs = springs
        self.correction, self.amiss, self.excess = all_ = np.zeros((3, ends[-1], 6))
        for skin, a, b in zip(skins, ends, ends[1:]):
            skin.correction, skin.amiss, skin.excess = all_[:, a:b]

    @property
    def touching(self) -> np.ndarray:
        """Numbers of the bodies that any skin holds."""
        return np.concatenate([a + skin.touching for a, skin in zip(self._begins, self._skins)])

    def held(self, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Jacobian (6 k, nv) of some bodies that skins hold, and what these push against accelerations (nv,)
        on them, (6 k, nv)."""
        tangent = np.concatenate([skin.tangent[skin.touching] for skin in self._skins])
        square = np.concatenate([skin.square[skin.touching] for skin in self._skins])
        jacobian = self._rows.reshape(-1, 6, self._rows.shape[1])[touching]
        held = square[:, None, None] * tangent @ jacobian
        return jacobian.reshape(-1, self._rows.shape[1]), held.reshape(-1, self._rows.shape[1])

    def evaluate(self, acceleration: np.ndarray) -> None:
        """Finds the poses that the bodies reach with accelerations (nv,), and how far they are from the poses
        for which the skins were solved."""
        for skin in self._skins:
            skin.evaluate(acceleration)

    def find_compliance(self, skins: Sequence[Coupled], inertia: np.ndarray | None) -> None:
        """Finds how the bodies of some skins give way to its wrenches: held by their inertia, with the
        damping that the integrator treats implicitly (`Integrator.inertia`; None: M alone), and by what
        MuJoCo's other constraints, the rows of other skins among them, now hold."""
        self._springs.take(inertia)
        for skin in skins:
            self._springs.factor(skin.instance.number)
            skin.arrays.find_compliance()

    def find_frequencies(self) -> None:
        """Finds the frequencies at which the bodies bounce on all skins, as inertia and MuJoCo's other
        constraints let them."""
        self._springs.take(None)
        self._springs.factor(None)
        self._springs.held[:] = 0.0
        for skin in self._skins:
            skin.arrays.add_stiffness()
        for skin in self._skins:
            skin.arrays.find_frequencies()

    def apply(self) -> np.ndarray:
        """Puts the skins' models into MuJoCo's rows; returns the passive forces (nv,) that act besides."""
        wrench = np.concatenate([skin.apply() for skin in self._skins])
        return wrench.ravel() @ self._rows
