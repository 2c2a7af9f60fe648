"""Many BioTacs on one GPU: skins, liquid and sensors of every world inside `mujoco_warp.step`
(docs/lab/batch.md)."""

from .adding import add
from .attach import attach, make
from .batch import Batch
from .skins import PoseBatch

__all__ = ["Batch", "PoseBatch", "add", "attach", "make"]
