"""NumPy files: .npy as a table, with or without field names; .npz by the names of its arrays."""

import io
import pathlib

import numpy as np

from ...reading import reading
from .columns import Table
from .names import is_stamp, is_time
from .streams import Stream, make_streams
from .text import read_matrix

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
        found = {
            name: _clock(path, name, v) if is_time(name) or is_stamp(name) else v for name, v in found.items()
        }
        columns = {name: v for name, v in found.items() if v.dtype.kind in "fiub" and v.size > 1}
        left = [name for name in found if name not in columns]
        notes = [f"{path.name}: left out {', '.join(left)}, which have no rows of numbers"] if left else []
        return make_streams(path.name, columns, notes)
    if found.ndim != 2 or found.dtype.kind not in "fiub" or not found.size:
        raise ValueError(
            f"{path} is an array of shape {found.shape} and type {found.dtype}: a table with a row for "
            "each sample is needed, or numpy.savez with the names electrodes, force, time"
        )
    cells = [[repr(one) for one in row] for row in found.astype(float).tolist()]
    return read_matrix(Table(path, None, list(range(1, len(cells) + 1)), cells), role)


def _clock(path, name, value):
    """(n,) times [s]: dates since 1970, durations, or words as in text logs; numbers as they are."""
    if value.dtype.kind == "M":
        value = value - np.datetime64(0, "s")
    if value.dtype.kind == "m":
        return value / np.timedelta64(1, "s")
    if value.dtype.kind != "U" or value.ndim != 1:
        return value
    return Table(path, [name], list(range(1, len(value) + 1)), [[str(one)] for one in value]).clock(0, name)
