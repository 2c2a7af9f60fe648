"""Many BioTacs on one GPU: skins, liquid and sensors of every world inside `mujoco_warp.step` (docs/batch.md)."""

from .attach import add, attach
from .batch import Batch

__all__ = ["Batch", "add", "attach"]
