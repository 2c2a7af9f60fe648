"""Finds where simulation and measurement disagree, names the missing effect, adds it, and shows that the gap shrinks."""

__all__ = ["RecordedEffect", "Recording", "diagnose_recording", "read_recording"]

_HOME = {"diagnose_recording": "plain", "Recording": "recording", "read_recording": "recording", "RecordedEffect": "recorded_effect"}


def __getattr__(name):
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
