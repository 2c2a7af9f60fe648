"""What a solved step of the skin does to its modes: forces of the contacts, what heights under them would
make, and how fast bodies slip."""

import functools
import math

import numpy as np

from ..sensor.vibration import Modes
from ..skin.modes import NMODE, skin_modes
from .fem import FemStepper
from .stepper import Geom, SkinResult

__all__ = ["Shaking"]


class Shaking:
    """Of one skin.

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
        """What the sensor needs of the skin's modes."""
        return Modes(self._modes.rate, self._modes.share)

    @functools.cached_property
    def _faces(self):
        """(nface, (nmode + 1) 3) modal forces and steady pressure of a unit force on each outer face."""
        modes = self._modes
        place = np.zeros(self._stepper.model.nvert, int)
        place[modes.node] = np.arange(len(modes.node))
        each = np.concatenate([modes.shape, modes.static[None]])[:, place[self._stepper.model.outer.face_np]]
        return np.ascontiguousarray(each.mean(2).swapaxes(0, 1).reshape(-1, 3 * (NMODE + 1)), np.float32)

    def of_step(self, before: np.ndarray, result: SkinResult, dt: float) -> tuple | None:
        """`drive`, `gain`, `slip` and `area` of `sensor.vibration.Vibration` at the end of a step.

        A body's force acts on the samples that it touches, along itself; a height is a motion along it too,
        and what it makes the tangent of the step. The speed of slip is that at which what holds the samples
        in friction moves over the body, on average.

        Args:
          before: the skin's state. result: of the step. dt: its length [s].
        """
        if result.state is None:
            return None
        rows = self._stepper.contact_rows(result.state)
        if not len(rows):
            return None
        drive, gain = np.zeros(NMODE), np.zeros((self._ngroup, NMODE + 1))
        slip, area = np.zeros(self._ngroup), self._stepper.touched_area(result.state)
        group = self._group[rows[:, 1].astype(int)]
        face = rows[:, 0].astype(int) // len(self._stepper.model.sample)
        way, known = _moved(self._stepper.contact_rows(before), rows)
        for g in area.nonzero()[0]:
            force, mine = -result.wrench[g, :3], (group == g).nonzero()[0]
            size = math.sqrt(force @ force)
            if size == 0:
                continue
            along = force / size
            heard = (self._faces.take(face[mine], 0).sum(0) / len(mine)).reshape(-1, 3) @ along
            drive += size * heard[:-1]
            gain[g] = (along @ result.tangent[g, :3, :3] @ along) * heard
            also = known[mine]
            mean = also @ way[mine] / max(also.sum(), 1.0)
            slip[g] = math.sqrt(mean @ mean) / dt
        return drive, gain, slip, area


def _moved(old, new):
    """How far the anchors of the contacts (k, 5) went over their geoms (k, 3) [m], and where they were
    contacts before: (k,) 1 or 0."""
    if not len(old):
        return np.zeros((len(new), 3)), np.zeros(len(new))
    if old.shape == new.shape and (old[:, :2] == new[:, :2]).all():  # most steps
        return new[:, 2:] - old[:, 2:], np.ones(len(new))
    many = 1 + max(old[:, 1].max(), new[:, 1].max())
    key, wanted = (rows[:, 0] * many + rows[:, 1] for rows in (old, new))
    order = key.argsort()
    found = order[np.minimum(key.searchsorted(wanted, sorter=order), len(key) - 1)]
    return new[:, 2:] - old[found, 2:], (key[found] == wanted).astype(float)
