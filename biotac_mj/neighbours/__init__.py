"""Sensor classes with the interfaces of other frameworks: `mjlab` inside mujoco_warp's step, `isaaclab`
beside any physics that tells poses. Neither needs the framework."""

import importlib
import types

__all__ = ["isaaclab", "mjlab"]


def __getattr__(name: str) -> types.ModuleType:
    if name in __all__:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
