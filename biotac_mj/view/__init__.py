"""What a BioTac looks like: in MuJoCo's viewer, in a picture, in the browser."""

_HOME = {"build_hand": "window", "build_scene": "window", "view": "window"}

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
