"""One press of an indenter into a BioTac: where it goes (`path`), the scene, the run (`pressing`), what is
kept and written of it (`record`, `report`)."""

_HOME = {
    "Path": "path",
    "PressOptions": "path",
    "build_scene": "scene",
    "plan_path": "path",
    "press": "pressing",
    "render": "pressing",
    "see_through": "scene",
}

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
