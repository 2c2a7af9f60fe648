"""Finds where simulation and measurement disagree, names the missing effect, adds it, and shows that the gap
shrinks."""

_HOME = {
    "CATALOGUE": "catalogue",
    "Effect": "effect",
    "Param": "effect",
    "RecordedEffect": "recorded_effect",
    "Recording": "recording",
    "Report": "workflow",
    "Simulator": "simulator",
    "Trajectory": "trajectories",
    "diagnose": "workflow",
    "diagnose_recording": "plain",
    "load_simulator": "simulator",
    "read_recording": "recording",
    "read_trajectories": "trajectories",
    "write_trajectories": "trajectories",
}

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
