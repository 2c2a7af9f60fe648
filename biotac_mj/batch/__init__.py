"""Many BioTacs on one GPU: skins, liquid and sensors of every world inside `mujoco_warp.step`
(docs/lab/batch.md).

In two steps: `add` changes the MjSpec, as `biotac_mj.attach` does for `mj_step`; when it is compiled,
`attach` hooks the skins into mujoco_warp, or `make` makes them for another simulator. JAX has
`biotac_mj.mjx`."""

from .adding import add
from .attach import attach, make
from .batch import Batch
from .skins import PoseBatch

__all__ = ["Batch", "PoseBatch", "add", "attach", "make"]
