"""Excitation of the skin's modes by a solved step: forces of the contacts, heights under the contacts, and
speeds of slip."""

import functools
import math

import numpy as np

from ...sensor.vibration import Modes
from ...skin.modes import NMODE, skin_modes
from ...skin.touched import faces_of
from ..stepper import Geom, SkinResult
from ..steppers.fem import FemStepper


class Shaking:
    """Excitation of the modes of one skin.

    Args:
      stepper: of the skin. geoms: that can touch it.
    """

    def __init__(self, stepper: FemStepper, geoms: list[Geom]):
        self._stepper = stepper
        self._group = np.array([g.group for g in geoms], int)
        self._ngroup = 1 + max((g.group for g in geoms), default=-1)

    @functools.cached_property
    def _modes(self):
        return skin_modes(self._stepper.model)

    @property
    def modes(self) -> Modes:
        """The skin's modes as the sensor takes them."""
        return Modes(self._modes.rate, self._modes.static_pressure)

    @functools.cached_property
    def _faces(self):
        """(nface, (nmode + 1) 3) modal forces and steady pressure of a unit force on each outer face."""
        model = self._stepper.model
        each = faces_of(self._modes, model.outer.face_np, model.nvert)
        return np.ascontiguousarray(each.reshape(-1, 3 * (NMODE + 1)), np.float32)

    def of_step(self, before: np.ndarray, result: SkinResult, dt: float) -> tuple | None:
        """`drive`, `gain`, `slip` and `area` of `sensor.vibration.Vibration` at the end of a step.

        A body's force acts on the samples that it touches, along itself; a height is a motion along it too,
        and the step's tangent gives its force. The speed of slip is the mean speed of the friction anchors
        over the body. Samples are weighted by their forces: a sample that begins or ceases to touch has none,
        so it causes no knock.

        Args:
          before: the skin's state. result: of the step. dt: its length [s].
        """
        if result.state is None:
            return None
        rows = self._stepper.contact_rows(result.state)
        if not len(rows):
            return None
        drive, gain = np.zeros(NMODE), np.zeros((self._ngroup, NMODE + 1))
        slip, area = np.zeros(self._ngroup), self._stepper.contact_area(result)
        sample, geom = rows[:, :2].T.astype(int)
        group, face = self._group[geom], sample // len(self._stepper.model.sample)
        moved, known = self._moved(self._stepper.contact_rows(before), rows, sample)
        for g in np.bincount(group).nonzero()[0]:
            force, mine = -result.wrench[g, :3], (group == g).nonzero()[0]
            size, load = math.sqrt(force @ force), result.load[mine]
            if size == 0 or not load.any():
                continue
            along, weight = force / size, np.bincount(face[mine], load / load.sum())
            at = weight.nonzero()[0]
            modal = (weight[at].astype(np.float32) @ self._faces.take(at, 0)).reshape(-1, 3) @ along
            drive += size * modal[:-1]
            gain[g] = (along @ result.tangent[g, :3, :3] @ along) * modal
            also = known[mine] * load
            mean = also @ moved[mine] / (also.sum() or 1.0)
            slip[g] = math.sqrt(mean @ mean) / dt
        return drive, gain, slip, area

    @functools.cached_property
    def _place(self):
        model = self._stepper.model
        return np.full(len(model.outer.face_np) * len(model.sample), -1)

    def _moved(self, old, new, sample):
        """Distances of the contacts' anchors (k, 5) over their geoms (k, 3) [m], and a mask (k,) of those
        that were contacts before."""
        if not len(old):
            return np.zeros((len(new), 3)), np.zeros(len(new))
        before = old[:, 0].astype(int)
        self._place[before] = np.arange(len(old))
        found = self._place[sample]
        self._place[before] = -1
        known = (found >= 0) & (old[found, 1] == new[:, 1])
        return new[:, 2:] - old[found, 2:], known.astype(float)
