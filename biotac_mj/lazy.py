"""Packages whose names load their modules when they are first used.

`lazy_loader` does the same: it names no known names where one is unknown, and its stubs are parsed at every
import."""

import importlib
import sys
from collections.abc import Callable, Mapping

__all__ = ["lazy"]


def lazy(package: str, home: Mapping[str, str | None]) -> tuple[Callable, Callable]:
    """`__getattr__` and `__dir__` of a package.

    Editors and type checkers do not run these: the package imports the same names once more under
    `typing.TYPE_CHECKING`.

    Args:
      package: its `__name__`. home: name -> the module that has it, relative to the package; None: the name
        is that of a module itself.
    """

    def get(name):
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}; it has {', '.join(home)}")
        if home[name] is None:
            return importlib.import_module(f"{package}.{name}")
        return getattr(importlib.import_module(home[name], package), name)

    def names():
        return sorted({*home, *(n for n in vars(sys.modules[package]) if n.startswith("__"))})

    return get, names
