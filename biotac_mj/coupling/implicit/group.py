"""All skins of a step at once, with their bodies one after the other in each array."""

from collections.abc import Sequence

import numpy as np

from .coupled import Coupled
from .integrator import Integrator

__all__ = ["SkinGroup"]


class SkinGroup:
    """Skins of one step, none of them idle."""

    def __init__(self, skins: Sequence[Coupled]):
        ends = np.cumsum([0, *(len(skin.jacobian) for skin in skins)]).tolist()
        self._all = [(skin, slice(a, b)) for skin, a, b in zip(skins, ends, ends[1:])]
        jacobian = np.concatenate([skin.jacobian for skin in skins])
        self._rows = jacobian.reshape(6 * ends[-1], jacobian.shape[2])
        self._data = skins[0].data
        self._response = None  # of all bodies to wrenches on them, without skins and dampers

    def evaluate(self, acceleration: np.ndarray) -> float:
        """Finds where the bodies go with accelerations (nv,); returns how far that is from where the skins
        were solved at most [m]."""
        for skin, _ in self._all:
            skin.evaluate(acceleration)
        return max(skin.off for skin, _ in self._all)

    def find_compliance(self, integrator: Integrator | None) -> None:
        """Finds how the bodies of each skin give way to its wrenches: held by their inertia, by the damping
        that an `Integrator` treats implicitly, and by what MuJoCo's other constraints, the rows of other
        skins among them, now hold."""
        rows, constrained, stiffness = self._data.springs()
        undamped = self._data.moved_by(np.concatenate([self._rows, constrained]))
        damped = undamped if integrator is None else integrator.integrated(undamped)
        numbers = [skin.instance.metric.numbers() for skin, _ in self._all]

        def give(response, own, but):
            """Accelerations of bodies `own` by wrenches on them, held by other rows than some."""
            others = (rows[:, None] != but).all(axis=1)
            J, C = self._rows[own], constrained[others]
            free, Y = response[own], response[len(self._rows) :][others]
            A, coupled = J @ free.T, C @ free.T
            if coupled.any():
                A -= J @ Y.T @ np.linalg.solve(np.diag(1 / stiffness[others]) + C @ Y.T, coupled)
            return A

        self._response = give(undamped, slice(0, len(self._rows)), np.concatenate(numbers))
        for (skin, part), own in zip(self._all, numbers):
            n = part.stop - part.start
            A = give(damped, slice(6 * part.start, 6 * part.stop), own).reshape(n, 6, n, 6)
            # of two bodies whose steps differ the mean, so that it stays symmetric
            square = np.sqrt(skin.square[:, None] * skin.square)[:, :, None, None]
            skin.compliance[:] = square * np.ascontiguousarray(A.transpose(0, 2, 1, 3))

    def frequencies(self) -> list[np.ndarray | None]:
        """Of each skin (n,) angular frequencies [rad/s] at which its bodies bounce in the stiffest mode in
        which it holds them, with all other skins; None where that is not known anew."""
        if self._response is None:
            return [None] * len(self._all)
        tangent = np.concatenate([skin.tangent for skin, _ in self._all])
        modes = self._response.reshape(len(self._rows), len(tangent), 1, 6) @ tangent
        modes = modes.reshape(self._response.shape)
        # by traces of powers, in which the largest square of a frequency outweighs all others
        second = modes @ modes
        low, high = ((power * power.T).sum(axis=1).reshape(-1, 6).sum(axis=1) for power in (modes, second))
        known = (low > 0.0) & (high > 0.0)
        frequency = np.where(known, np.where(known, high, 0.0) / np.where(known, low, 1.0), 0.0) ** 0.25
        return [frequency[part] for _, part in self._all]

    def apply(self) -> np.ndarray:
        """Puts the skins' models into MuJoCo's rows; returns the passive forces (nv,) that act besides."""
        wrench = np.concatenate([skin.apply() for skin, _ in self._all])
        return wrench.ravel() @ self._rows
