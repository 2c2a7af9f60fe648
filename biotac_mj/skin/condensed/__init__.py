"""The real-time tier: a skin that is linear but for its contact.

The names below load their modules when they are first used: the full tier takes its search for near geoms
from here, and nothing else."""

import importlib

__all__ = ["CondensedSkin", "Memory", "Outcome"]

_HOME = {"CondensedSkin": "skin", "Memory": "step", "Outcome": "step"}


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
