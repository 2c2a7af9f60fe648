"""Stored states of worlds, so that episodes start with the object in the grip: closing the fingers takes
longer than the task."""

from collections.abc import Sequence

import mujoco_warp as mjw
import torch
import warp as wp

from ...batch import Batch
from ...batch.rows import Rows

# of mujoco_warp's Data: what a step depends on, and the last sensor data
_FIELDS = ("time", "qpos", "qvel", "act", "ctrl", "qacc", "qacc_warmstart", "qfrc_applied", "xfrc_applied")
_FIELDS += ("mocap_pos", "mocap_quat", "xpos", "xmat", "sensordata")


class Bank:
    """States of all worlds: mujoco_warp's Data, skins and sensors; each can be copied to any world.

    Args:
      d: mujoco_warp's Data. batches: with a skin in each of its worlds.
      others: further (nworld, ...) torch tensors, written in place.
    """

    def __init__(self, d: mjw.Data, batches: Sequence[Batch], others: Sequence[torch.Tensor] = ()):
        self._rows = Rows(batches)
        row = self._rows.row
        words = wp.array(ptr=row.ptr, dtype=wp.int32, shape=row.shape, device=row.device, copy=False)
        fields = [getattr(d, name) for name in _FIELDS]
        self._parts = [wp.to_torch(a) for a in (words, *fields) if a.size] + list(others)
        # friction is no state of a skin, but a grip depends on it
        self._parts += [wp.to_torch(b.skin.geoms.struct.friction).T for b in batches]
        self._kept = []

    def keep(self) -> None:
        """Stores the present state of every world."""
        self._rows.write()
        self._kept = [part.clone() for part in self._parts]

    def give(self, worlds: torch.Tensor, source: torch.Tensor) -> None:
        """Copies the stored states of worlds `source` (k,) to worlds (k,)."""
        self._rows.write()
        for now, kept in zip(self._parts, self._kept, strict=True):
            now.index_copy_(0, worlds, kept.index_select(0, source))
        self._rows.read()
