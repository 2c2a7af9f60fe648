"""All skins of a step at once, with their bodies one after the other in each array. What is alike for every
skin is done once, since a call of numpy takes longer than its work on so few numbers."""

from collections.abc import Sequence

import numpy as np

from ...geometry.rigid import displace, displacement
from .coupled import Coupled, size

__all__ = ["Together"]


class Together:
    """Skins of one step, none of them idle."""

    def __init__(self, skins: Sequence[Coupled]):
        ends = np.cumsum([0, *(len(skin.jacobian) for skin in skins)]).tolist()
        self._all = [(skin, slice(a, b)) for skin, a, b in zip(skins, ends, ends[1:])]
        self._jacobian = np.concatenate([skin.jacobian for skin in skins])
        self._rows = self._jacobian.reshape(6 * ends[-1], self._jacobian.shape[2])
        self._pose, (self._here, _) = self._poses("pose"), self._poses("here")
        self._square = skins[0].square
        drift = skins[0].horizon * (self._jacobian @ skins[0].data.qvel)
        self._spin = drift[:, 3:]
        for skin, part in self._all:
            skin.drift = drift[part]

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
        moved = self._square * (self._jacobian @ acceleration)
        pos, mat = displace(*self._pose, moved, self._here, self._spin)
        for skin, part in self._all:
            skin.take_aim(acceleration, moved[part], (pos[part], mat[part]))
        solved = [one for one in self._all if one[0].asked is not None]
        if solved:
            for skin, way in self._ways((pos, mat), "asked", solved):
                skin.off = size(way)
        return max(skin.off for skin, _ in self._all)

    def apply(self) -> np.ndarray:
        """Puts the skins' models into MuJoCo's rows; returns the passive forces (nv,) that act besides."""
        new = [one for one in self._all if one[0].drifted is None and not one[0].at_once]
        if new:
            for skin, way in self._ways(self._pose, "pose0", new):
                skin.drifted = skin.after(way)
        wrench = np.concatenate([skin.apply() for skin, _ in self._all])
        return wrench.ravel() @ self._rows

    def look_ahead(self) -> None:
        """Finds the wrenches where the bodies go, which the skins' energies ask for."""
        new = [one for one in self._all if one[0].ahead is None]
        if new:
            for skin, way in self._ways(self._poses("target"), "pose0", new):
                skin.ahead = skin.after(way)
