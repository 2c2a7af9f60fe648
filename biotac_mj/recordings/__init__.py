"""Recordings of real BioTacs: one format, importers that say what they found, a picture, live recording."""

_HOME = {
    "FIELDS": ".recording",
    "SCHEMA": ".recording",
    "Recording": ".recording",
    "draw": ".picture",
    "findings": ".inspection",
    "load": ".importers",
    "load_one": ".importers",
    "of_simulation": ".simulated",
    "read": ".recording",
    "warnings": ".inspection",
    "write": ".recording",
    "write_bag": ".formats.bags",
}

__all__ = list(_HOME)


def __getattr__(name):
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(_HOME[name], __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
