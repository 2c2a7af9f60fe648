"""NumPy files: .npy as a table, with or without field names; .npz by the names of its arrays."""

import io
import pathlib

import numpy as np

from ...reading import reading
from .columns import Table
from .streams import Stream, make_streams
from .text import read_matrix

__all__ = ["is_numpy", "read_numpy"]

_NPY, _ZIP = b"\x93NUMPY", b"PK\x03\x04"
_REMEDY = "save it again with numpy.save or numpy.savez, numbers alone"


def is_numpy(content: bytes) -> bool:
    """Whether a file's content comes from numpy.save or numpy.savez."""
    return content.startswith(_NPY) or (content.startswith(_ZIP) and b".npy" in content[:256])


def read_numpy(path: pathlib.Path, content: bytes, role: str | None = None) -> list[Stream]:
    """Streams of a NumPy file. role: as for `read_text`.

    Raises:
      ValueError: damaged, objects instead of numbers, or nothing recognised.
    """
    with reading(path, "NumPy file", _REMEDY):
        found = np.load(io.BytesIO(content), allow_pickle=False)
        found = found if isinstance(found, np.ndarray) else {name: found[name] for name in found.files}
    if isinstance(found, np.ndarray) and found.dtype.names:
        found = {name: found[name] for name in found.dtype.names}
    if isinstance(found, dict):
        return make_streams(
            path.name, {k: v for k, v in found.items() if v.dtype.kind in "fiub" and v.size > 1}
        )
    if found.ndim != 2 or found.dtype.kind not in "fiub" or not found.size:
        raise ValueError(
            f"{path} is an array of shape {found.shape} and type {found.dtype}: a table with a row for "
            "each sample is needed, or numpy.savez with the names electrodes, force, time"
        )
    cells = [[repr(one) for one in row] for row in found.astype(float).tolist()]
    return read_matrix(Table(path, None, list(range(1, len(cells) + 1)), cells), role)
