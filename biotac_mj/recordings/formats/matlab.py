"""MATLAB files: variables by their names, structs looked into; v7.3, which is HDF5, too."""

import io
import pathlib

import numpy as np

from ...reading import reading
from .parts import Part, make_parts

__all__ = ["read_matlab", "read_matlab_hdf5"]

_WHAT, _REMEDY = (
    "MATLAB file",
    "save it again with `save -v7`, variables called electrodes, pdc, pac, force, time",
)
_DEEPEST = 8  # structs in structs


def read_matlab(path: pathlib.Path, content: bytes) -> list[Part]:
    """Parts of a file up to v7.

    Raises:
      ValueError: damaged, or nothing in it is known.
    """
    import scipy.io

    with reading(path, _WHAT, _REMEDY):
        found = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True)
    columns, words = {}, {}
    _walk(found, "", columns, words, 0)
    return _parts(path, columns, words)


def read_matlab_hdf5(path: pathlib.Path) -> list[Part]:
    """Parts of a file of v7.3.

    Raises:
      ValueError: damaged, or nothing in it is known.
    """
    import h5py

    columns, words = {}, {}
    with reading(path, _WHAT, _REMEDY), h5py.File(path) as file:

        def take(name, item):
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and not name.startswith("#"):
                columns[name.replace("/", "_")] = item[()]

        file.visititems(take)
    return _parts(path, columns, words)


def _walk(value, name, columns, words, depth):
    if isinstance(value, dict) and depth < _DEEPEST:
        for key, item in value.items():
            if not key.startswith("__"):
                _walk(item, f"{name}_{key}" if name else key, columns, words, depth + 1)
    elif isinstance(value, str):
        words[name.lower()] = value
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 1:
        columns[name] = value


def _parts(path, columns, words):
    parts = make_parts(path.name, columns)
    for part in parts:
        part.object = words.get("object", "")
    return parts
