"""Finds where simulation and measurement disagree, names the missing effect, adds it, and shows that the gap
shrinks."""

_HOME = {
    "CATALOGUE": "..effects.catalogue",
    "Effect": "..effects.effect",
    "Param": "..effects.effect",
    "Recording": ".recordings.recording",
    "Report": ".trajectories.workflow",
    "Simulator": ".trajectories.simulator",
    "Trajectory": ".trajectories.trajectory",
    "diagnose": ".trajectories.workflow",
    "diagnose_recording": ".recordings.search",
    "load_simulator": ".trajectories.sensor_file",
    "read_recording": ".recordings.recording",
    "read_trajectories": ".trajectories.trajectory",
    "write_trajectories": ".trajectories.trajectory",
}

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(_HOME[name], __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
