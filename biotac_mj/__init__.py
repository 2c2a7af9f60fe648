"""A SynTouch BioTac fingertip in MuJoCo: a finite-element skin stepped inside `mj_step`, and its 19
electrodes by physics.

    spec = mujoco.MjSpec.from_file("scene.xml")
    handle = biotac_mj.attach(spec, ...)

Importing registers the MuJoCo engine plugin and nothing heavy: the names below load their modules when they
are first used."""

import importlib
import os
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

__version__ = "0.2.0"

__all__ = [
    "SensorBioTac",
    "SkinData",
    "SkinGeometry",
    "SkinModel",
    "__version__",
    "attach",
    "attach_to_hand",
    "import_mesh",
    "load_skin",
    "plugin",
    "step",
]

_HOME = {
    "SkinGeometry": "geometry",
    "load_skin": "geometry",
    "import_mesh": "geometry",
    "SkinModel": "skin",
    "SkinData": "skin",
    "step": "skin",
    "attach": "coupling",
    "SensorBioTac": "coupling.sensor_biotac",
    "attach_to_hand": "tasks.hands",
}


_PACKAGES = ("batch", "calibration", "data", "discrepancy", "effects", "learning", "press", "tasks", "view")


def __getattr__(name):
    if name in _PACKAGES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__():
    return sorted(set(globals()) | set(__all__) | set(_PACKAGES))
