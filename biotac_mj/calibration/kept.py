"""Checkpoints of a long comparison, in a file next to its results: when called again with the same inputs, it
continues. The file is JSON and can only restore the dataclasses named here."""

import dataclasses
import pathlib
from collections.abc import Callable, Iterable

import numpy as np

from ..cache import key_of
from ..fields import check_types
from ..files import write_json
from ..reading import read_json
from ..skin.contact.law import ContactLaw
from ..skin.model import SkinOptions
from ..skin.rubber.material import Material
from .comparison import Comparison
from .fit import Calibration
from .indentation import Indentation

_MADE = {
    kind.__name__: kind for kind in (Calibration, Comparison, ContactLaw, Indentation, Material, SkinOptions)
}
_TYPE, _DATA = "type", "data"  # keys of a dict that encodes an array or a dataclass
_ARRAY = "array"


class Kept:
    """Results by name, saved after each.

    Args:
      path: file; one of other inputs or other code, or an unreadable one, is replaced.
      inputs: everything that the results depend on, see `cache.key_of`.
    """

    def __init__(self, path: pathlib.Path | str, inputs: Iterable):
        self._path, self._results = pathlib.Path(path), {}
        self._key = key_of("comparison", inputs, ("geometry", "skin", "calibration"))
        try:
            content = read_json(self._path, "kept comparison", "leave it out")
            if content["key"] == self._key:
                self._results = {name: _made(part) for name, part in content["parts"].items()}
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            pass  # missing, truncated, or of another version of this package

    @property
    def names(self) -> list:
        return list(self._results)

    def get(self, name: str, kind: type, make: Callable) -> object:
        """The result of this name and type, computed by `make()` unless it is saved."""
        if not isinstance(self._results.get(name), kind):
            self._results[name] = make()
            content = {"key": self._key, "parts": _plain(self._results)}
            write_json(self._path, content, None)
        return self._results[name]


def _plain(value):
    """JSON form of a value, inverse of `_made`."""
    if type(value).__name__ in _MADE:
        fields = {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {_TYPE: type(value).__name__, _DATA: fields}
    if isinstance(value, np.ndarray):
        return {_TYPE: _ARRAY, _DATA: value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {str(name): _plain(one) for name, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, (list, tuple)) else value


def _made(value):
    if isinstance(value, list):
        return [_made(one) for one in value]
    if not isinstance(value, dict):
        return value
    if set(value) != {_TYPE, _DATA}:
        return {name: _made(one) for name, one in value.items()}
    if value[_TYPE] == _ARRAY:
        return np.asarray(value[_DATA])
    made = _MADE[value[_TYPE]](**_made(value[_DATA]))
    check_types(made, nan=True)  # a comparison with measured data has no nodal error
    return made
