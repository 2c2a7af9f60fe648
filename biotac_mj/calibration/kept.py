"""Finished parts of a long comparison, in a file: stopped and called again with the same settings, it goes on
where it was."""

import pathlib
import pickle
from collections.abc import Callable

from ..files import replacing

__all__ = ["Kept"]


class Kept:
    """Results by name, written after each.

    Args:
      path: file; one of other settings, or that cannot be read, is started anew.
      settings: what the results depend on, compared with `==`.
    """

    def __init__(self, path: pathlib.Path | str, settings: dict):
        self._path, self._content = pathlib.Path(path), {"settings": settings, "parts": {}}
        try:
            content = pickle.loads(self._path.read_bytes())
            if content["settings"] == settings:
                self._content = content
        except (
            OSError,
            pickle.UnpicklingError,
            EOFError,
            AttributeError,
            ImportError,
            IndexError,
            KeyError,
            TypeError,
        ):
            pass  # nothing there, cut short, or of another version of this package

    @property
    def names(self) -> list:
        return list(self._content["parts"])

    def get(self, name: str, make: Callable) -> object:
        """The part of this name, made by `make()` unless it is there."""
        parts = self._content["parts"]
        if name not in parts:
            parts[name] = make()
            with replacing(self._path) as temporary:
                temporary.write_bytes(pickle.dumps(self._content))
        return parts[name]
