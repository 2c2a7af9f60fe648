"""Poses in, wrenches out: a BioTac's skin inside MuJoCo's step."""

_HOME = {
    "Config": "config",
    "Geom": "stepper",
    "Handle": "attachment",
    "Readings": "stepper",
    "SkinResult": "stepper",
    "SkinStepper": "stepper",
    "attach": "attachment",
    "register_readings": "stepper",
    "register_stepper": "stepper",
}

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
