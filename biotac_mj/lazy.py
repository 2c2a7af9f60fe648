"""Packages whose names load their modules at the first access.

`lazy_loader` does the same, but does not suggest names when one is unknown, and parses its stubs, which are
further files, at every import."""

import ast
import functools
import importlib
import sys
from collections.abc import Callable


def lazy(package: str) -> tuple[Callable, Callable]:
    """`__getattr__` and `__dir__` of a package, which imports its names under `typing.TYPE_CHECKING`: for
    editors and type checkers, and here this block is read at the first access. `__all__` are these names,
    unless the package has its own.

    Args:
      package: its `__name__`.
    """

    @functools.cache
    def home():
        """Name -> module that has it, relative to the package; None: the name is a module."""
        module = sys.modules[package]
        body = ast.parse(module.__spec__.loader.get_source(package)).body
        (block,) = (
            n for n in body if isinstance(n, ast.If) and ast.unparse(n.test) == "typing.TYPE_CHECKING"
        )
        return {
            alias.name: node.module and "." * node.level + node.module
            for node in block.body
            for alias in node.names
        }

    def get(name):
        if name == "__all__":
            return list(home())
        if name not in home():
            raise AttributeError(f"module {package!r} has no attribute {name!r}; it has {', '.join(home())}")
        if home()[name] is None:
            return importlib.import_module(f"{package}.{name}")
        return getattr(importlib.import_module(home()[name], package), name)

    def names():
        own = vars(sys.modules[package])
        return sorted({*home(), *own.get("__all__", ()), *(n for n in own if n.startswith("__"))})

    return get, names
