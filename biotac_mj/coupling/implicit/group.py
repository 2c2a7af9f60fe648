"""All skins of a step at once, with their bodies one after the other in each array. What is alike for every
skin is done once, since a call of numpy takes longer than its work on so few numbers."""

from collections.abc import Sequence

import numpy as np

from ...geometry.rigid import displace, displacement
from .coupled import Coupled, size
from .integrator import Integrator

__all__ = ["SkinGroup"]


class SkinGroup:
    """Skins of one step, none of them idle."""

    def __init__(self, skins: Sequence[Coupled]):
        ends = np.cumsum([0, *(len(skin.jacobian) for skin in skins)]).tolist()
        self._all = [(skin, slice(a, b)) for skin, a, b in zip(skins, ends, ends[1:])]
        self._jacobian = np.concatenate([skin.jacobian for skin in skins])
        self._rows = self._jacobian.reshape(6 * ends[-1], self._jacobian.shape[2])
        self._here, _ = self._poses("here")
        self._data, self._step = skins[0].data, skins[0].instance.horizon
        self._response = None  # of all bodies to wrenches on them, without skins and dampers
        self._velocity = self._jacobian @ self._data.qvel
        self.find_drift()

    def find_drift(self) -> None:
        """Finds where the bodies go without acceleration, of their gamma."""
        self._pose = self._poses("pose")
        horizon, self._square = (
            np.concatenate([getattr(skin, name) for skin, _ in self._all])[:, None]
            for name in ("horizon", "square")
        )
        drift, self._straight = horizon * self._velocity, self._step * self._velocity
        self._spin = drift[:, 3:]
        for skin, part in self._all:
            skin.drift, skin.straight = drift[part], self._straight[part]

    def _poses(self, name, of=None):
        pos, mat = zip(*[getattr(skin, name) for skin, _ in of or self._all])
        return np.concatenate(pos), np.concatenate(mat)

    def _motions(self, pose, name, of):
        """Each of some skins, and the motions (n, 6) of its bodies to poses of all skins' bodies from those
        that it has as attribute `name`."""
        if len(of) < len(self._all):
            pose = [np.concatenate([a[part] for _, part in of]) for a in pose]
        motion, begin = displacement(*pose, *self._poses(name, of)), 0
        for skin, part in of:
            end = begin + part.stop - part.start
            yield skin, motion[begin:end]
            begin = end

    def evaluate(self, acceleration: np.ndarray) -> float:
        """Finds where the bodies go with accelerations (nv,); returns how far that is from where the skins
        were solved at most [m]."""
        gain = self._jacobian @ acceleration
        moved, travel = self._square * gain, self._straight + 0.5 * self._step**2 * gain
        pos, mat = displace(*self._pose, moved, self._here, self._spin)
        for skin, part in self._all:
            skin.set_target(acceleration, moved[part], travel[part], (pos[part], mat[part]))
        solved = [one for one in self._all if one[0].asked is not None]
        if solved:
            for skin, motion in self._motions((pos, mat), "asked", solved):
                skin.off = size(motion)
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
            skin.compliance = square * np.ascontiguousarray(A.transpose(0, 2, 1, 3))

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

    def predict_wrenches(self) -> None:
        """Finds the wrenches where the bodies go, which the skins' energies ask for."""
        new = [one for one in self._all if one[0].predicted_wrench is None]
        if new:
            for skin, motion in self._motions(self._poses("target"), "pose0", new):
                skin.predicted_wrench = skin.after(motion)
