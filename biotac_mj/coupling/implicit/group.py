"""All skins of a step at once, with their bodies one after the other in each array."""

from collections.abc import Sequence

import numpy as np

from .coupled import Coupled
from .springs import Springs

__all__ = ["SkinGroup"]


class SkinGroup:
    """Skins of one step, none of them idle."""

    def __init__(self, skins: Sequence[Coupled], springs: Springs):
        ends = np.cumsum([0, *(len(skin.jacobian) for skin in skins)]).tolist()
        self._all = [(skin, slice(a, b)) for skin, a, b in zip(skins, ends, ends[1:])]
        jacobian = np.concatenate([skin.jacobian for skin in skins])
        self._rows = jacobian.reshape(6 * ends[-1], jacobian.shape[2])
        self._springs = springs

    def evaluate(self, acceleration: np.ndarray) -> float:
        """Finds where the bodies go with accelerations (nv,); returns how far that is from where the skins
        were solved at most [m]."""
        for skin, _ in self._all:
            skin.evaluate(acceleration)
        return max(skin.off for skin, _ in self._all)

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
        self._springs.stiffness.zero_()
        for skin, _ in self._all:
            skin.arrays.add_stiffness()
        for skin, _ in self._all:
            skin.arrays.find_frequencies()

    def apply(self) -> np.ndarray:
        """Puts the skins' models into MuJoCo's rows; returns the passive forces (nv,) that act besides."""
        wrench = np.concatenate([skin.apply() for skin, _ in self._all])
        return wrench.ravel() @ self._rows
