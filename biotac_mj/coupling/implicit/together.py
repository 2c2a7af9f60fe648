"""All skins of a step at once, with their bodies one after the other in each array. What is alike for every
skin is done once, since a call of numpy takes longer than its work on so few numbers."""

from collections.abc import Sequence

import numpy as np

from ...geometry.rigid import displace, displacement
from .coupled import Coupled, size
from .integrator import Integrator

__all__ = ["Together"]


class Together:
    """Skins of one step, none of them idle."""

    def __init__(self, skins: Sequence[Coupled]):
        ends = np.cumsum([0, *(len(skin.jacobian) for skin in skins)]).tolist()
        self._all = [(skin, slice(a, b)) for skin, a, b in zip(skins, ends, ends[1:])]
        self._jacobian = np.concatenate([skin.jacobian for skin in skins])
        self._rows = self._jacobian.reshape(6 * ends[-1], self._jacobian.shape[2])
        self._here, _ = self._poses("here")
        self._data, self._step = skins[0].data, skins[0].instance.horizon
        self._velocity = self._jacobian @ self._data.qvel
        self.find_drift()

    def find_drift(self) -> None:
        """Finds where the bodies go without acceleration, of the skins' gamma."""
        self._pose = self._poses("pose")
        horizon, self._square = np.empty((2, len(self._jacobian), 1))
        for skin, part in self._all:
            horizon[part], self._square[part] = skin.horizon, skin.square
        drift, self._straight = horizon * self._velocity, self._step * self._velocity
        self._spin = drift[:, 3:]
        for skin, part in self._all:
            skin.drift, skin.straight = drift[part], self._straight[part]

    def _poses(self, name, of=None):
        pos, mat = zip(*[getattr(skin, name) for skin, _ in of or self._all])
        return np.concatenate(pos), np.concatenate(mat)

    def _ways(self, pose, name, of):
        """Each of some skins, and the motions (n, 6) of its bodies to poses of all skins' bodies from those
        that it has as attribute `name`."""
        if len(of) < len(self._all):
            pose = [np.concatenate([a[part] for _, part in of]) for a in pose]
        way, begin = displacement(*pose, *self._poses(name, of)), 0
        for skin, part in of:
            end = begin + part.stop - part.start
            yield skin, way[begin:end]
            begin = end

    def aim(self, acceleration: np.ndarray) -> float:
        """Finds where the bodies go with accelerations (nv,); returns how far that is from where the skins
        were solved at most [m]."""
        gain = self._jacobian @ acceleration
        moved, travel = self._square * gain, self._straight + 0.5 * self._step**2 * gain
        pos, mat = displace(*self._pose, moved, self._here, self._spin)
        for skin, part in self._all:
            skin.take_aim(acceleration, moved[part], travel[part], (pos[part], mat[part]))
        solved = [one for one in self._all if one[0].asked is not None]
        if solved:
            for skin, way in self._ways((pos, mat), "asked", solved):
                skin.off = size(way)
        return max(skin.off for skin, _ in self._all)

    def find_compliance(self, integrator: Integrator | None) -> None:
        """Finds how the bodies of each skin give way to its wrenches: held by their inertia, by the damping
        that an `Integrator` treats implicitly, and by what MuJoCo's other constraints, the rows of other
        skins among them, now hold."""
        rows, held, stiffness = self._data.springs()
        undamped = self._data.moved_by(np.concatenate([self._rows, held]))
        responses = [undamped] if integrator is None else [undamped, integrator.integrated(undamped)]
        for skin, part in self._all:
            own, n = slice(6 * part.start, 6 * part.stop), part.stop - part.start
            others = (rows[:, None] != skin.instance.metric.numbers()).all(axis=1)
            J, C, found = self._rows[own], held[others], []
            for response in responses:
                free, Y = response[own], response[len(self._rows) :][others]
                A, coupled = J @ free.T, C @ free.T
                if coupled.any():
                    A -= J @ Y.T @ np.linalg.solve(np.diag(1 / stiffness[others]) + C @ Y.T, coupled)
                found.append(np.ascontiguousarray(A.reshape(n, 6, n, 6).transpose(0, 2, 1, 3)))
            skin.response, skin.compliance = found[0], skin.square * found[-1]

    def apply(self) -> np.ndarray:
        """Puts the skins' models into MuJoCo's rows; returns the passive forces (nv,) that act besides."""
        wrench = np.concatenate([skin.apply() for skin, _ in self._all])
        return wrench.ravel() @ self._rows

    def look_ahead(self) -> None:
        """Finds the wrenches where the bodies go, which the skins' energies ask for."""
        new = [one for one in self._all if one[0].ahead is None]
        if new:
            for skin, way in self._ways(self._poses("target"), "pose0", new):
                skin.ahead = skin.after(way)
