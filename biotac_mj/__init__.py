"""A SynTouch BioTac fingertip in MuJoCo: a finite-element skin stepped inside `mj_step`, and its 19
electrodes by physics.

    spec = mujoco.MjSpec.from_file("scene.xml")
    handle = biotac_mj.attach(spec, ...)

The import only registers the MuJoCo engine plugin; the names below load their modules at the first access."""

import os
import typing
import warnings

try:
    import mujoco as _mujoco  # noqa: F401
except (AttributeError, ImportError, OSError, RuntimeError) as error:
    # MuJoCo loads the GL library that MUJOCO_GL names while it is imported. A missing one must not stop the
    # physics.
    if not os.environ.get("MUJOCO_GL") or isinstance(error, ModuleNotFoundError):
        raise
    warnings.warn(
        f"MUJOCO_GL={os.environ['MUJOCO_GL']} does not work here ({error}): "
        "going on without MuJoCo's renderer",
        stacklevel=2,
    )
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco as _mujoco  # noqa: F401

from . import plugin  # registers the engine plugin  # noqa: E402
from .lazy import lazy  # noqa: E402

if typing.TYPE_CHECKING:
    from . import batch as batch
    from . import calibration as calibration
    from . import coupling as coupling
    from . import data as data
    from . import differentiable as differentiable
    from . import discrepancy as discrepancy
    from . import effects as effects
    from . import geometry as geometry
    from . import learning as learning
    from . import mjx as mjx
    from . import neighbours as neighbours
    from . import press as press
    from . import recordings as recordings
    from . import resimulation as resimulation
    from . import sensor as sensor
    from . import skin as skin
    from . import tasks as tasks
    from . import view as view
    from .coupling.attachment import attach as attach
    from .coupling.handle import Handle as Handle
    from .coupling.handle import handles as handles
    from .geometry import SkinGeometry as SkinGeometry
    from .geometry import import_mesh as import_mesh
    from .geometry import load_skin as load_skin
    from .skin import SkinData as SkinData
    from .skin import SkinModel as SkinModel
    from .skin import step as step
    from .tasks.hands import attach_to_hand as attach_to_hand

__version__ = "0.3.0"

__all__ = [
    "Handle",
    "SkinData",
    "SkinGeometry",
    "SkinModel",
    "__version__",
    "attach",
    "attach_to_hand",
    "handles",
    "import_mesh",
    "load_skin",
    "plugin",
    "step",
]
__getattr__, __dir__ = lazy(__name__)
