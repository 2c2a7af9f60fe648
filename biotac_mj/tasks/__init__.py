"""Tasks by touch: the BioTac as a dm_control Entity, a suite of tasks with scripted controllers, Gymnasium,
robot hands.

    env = biotac_mj.tasks.load("finger", "press", task_kwargs={"random": 0})

dm_control is the extra `control`, Gymnasium the extra `gymnasium`; importing this package needs neither.
"""

import importlib

__all__ = ["BioTac", "PRIVILEGED", "TACTILE", "attach_to_hand", "load", "register", "tasks"]

_HOME = {
    "BioTac": "biotac",
    "TACTILE": "biotac",
    "PRIVILEGED": "biotac",
    "load": "suite",
    "tasks": "suite",
    "attach_to_hand": "hands",
    "register": "environments",
}
_EXTRA = {"dm_control": "control", "gymnasium": "gymnasium"}


def __getattr__(name):
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    try:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package not in _EXTRA:
            raise
        raise ModuleNotFoundError(
            f"{error}: pip install 'biotac-mj[{_EXTRA[package]}]'", name=error.name
        ) from error


def __dir__():
    return sorted(set(globals()) | set(__all__))
