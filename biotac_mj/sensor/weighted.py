"""Place and force of a contact from the electrodes, by the formula that drivers of real sensors use: Lin,
Fishel and Loeb, "Estimating point of contact, force and torque in a biomimetic tactile sensor with deformable
skin" (2013)."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.closest import ray_distances
from ..geometry.design import BIOTAC
from ..geometry.skin_geometry import SkinGeometry

# [N/count] of the shipped BioTac, fitted to synthetic presses: benchmarks/weighted_electrodes.py
_SCALE = (7.9e-4, 1.85e-3, 8.8e-4)


@dataclasses.dataclass(frozen=True)
class WeightedElectrodes:
    """The position is the mean of the electrodes, weighted by a power of the fall of their counts, projected
    outwards to the skin. The force is the sum of their normals, weighted by the fall, times a scale for each
    axis. Counts fall where the film gets thinner; those that rise indicate displaced liquid and are ignored.

    Args:
      geometry: of the skin.
      scale: (3,) [N/count] of the axes of the BioTac frame; None: of the shipped BioTac, fitted to synthetic
        presses. `fitted` computes that of a sensor.
      power: of the position's weights; the paper's is 2.
    """

    geometry: SkinGeometry
    scale: tuple | None = None
    power: float = 2.0

    def place(self, change: ArrayLike) -> np.ndarray:
        """(..., 3) contact position [m], BioTac frame, on the skin at rest; nan if no electrode falls, or
        none below the skin.

        Args:
          change: (..., nelectrode) of counts from rest.
        """
        fall = self._fall(change)
        weight = fall**self.power
        total = weight.sum(-1, keepdims=True)
        weight = np.divide(weight, total, out=np.full_like(weight, np.nan), where=total > 0)
        start = weight @ self.geometry.electrode_pos
        out = weight @ self.geometry.electrode_normal
        found = np.full(start.shape, np.nan)
        for i in np.argwhere(total[..., 0] > 0):
            found[(*i,)] = self._on_skin(start[(*i,)], out[(*i,)])
        return found

    def force(self, change: ArrayLike) -> np.ndarray:
        """(..., 3) on the BioTac [N], in its frame; change as for `place`.

        Raises:
          ValueError: no scale is known for this fingertip.
        """
        scale = self.scale
        if scale is None:
            if self.geometry.design != BIOTAC:
                raise ValueError(
                    f"no scale of force is known of a {self.geometry.design.title}: give scale, or take "
                    "fitted(change, force) with presses of known force"
                )
            scale = _SCALE
        return self._sum(change) * np.asarray(scale, float)

    def fitted(self, change: ArrayLike, force: ArrayLike) -> "WeightedElectrodes":
        """A copy with the scale that fits known forces best, per axis.

        Args:
          change: (n, nelectrode) as for `place`. force: (n, 3) on the BioTac [N].
        """
        summed, force = self._sum(change), np.asarray(force, float)
        if force.shape != summed.shape or not (summed**2).sum(0).all():
            raise ValueError(
                f"force has shape {force.shape} for changes {np.shape(change)}: give (n, 3), of presses in "
                "which electrodes fall"
            )
        scale = (summed * force).sum(0) / (summed**2).sum(0)
        return dataclasses.replace(self, scale=tuple(scale.tolist()))

    def _sum(self, change):
        return -self._fall(change) @ self.geometry.electrode_normal

    def _fall(self, change):
        change, n = np.asarray(change, float), len(self.geometry.electrode_pos)
        if change.shape[-1:] != (n,):
            raise ValueError(f"change has shape {change.shape}: give (..., {n}) counts from rest")
        return np.maximum(0.0, -change)

    def _on_skin(self, start, out):
        """Exit point of a ray from inside through the skin at rest."""
        away = ray_distances(self.geometry.vert[self.geometry.outer_face], start, out)
        away = away[np.isfinite(away)]
        return start + away.max() * out if len(away) else np.full(3, np.nan)
