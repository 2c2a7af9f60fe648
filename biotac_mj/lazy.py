"""Packages whose names load their modules at the first access.

`lazy_loader` does the same, but does not suggest names when one is unknown, and parses its stubs at every
import."""

import importlib
import sys
from collections.abc import Callable, Mapping

__all__ = ["lazy"]


def lazy(package: str, home: Mapping[str, str | None]) -> tuple[Callable, Callable]:
    """`__getattr__` and `__dir__` of a package.

    Editors and type checkers do not run these, so the package also imports the names under
    `typing.TYPE_CHECKING`.

    Args:
      package: its `__name__`. home: name -> module that has it, relative to the package; None: the name is a
        module.
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
