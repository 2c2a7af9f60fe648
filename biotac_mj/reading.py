"""Reads files of others: any defect becomes an error of one line that names file, cause and remedy."""

import contextlib
import json
import os
import pathlib
import typing
import zipfile
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from .short_repr import short_repr

_KINDS = {"finite": "fiu", "number": "fiu", "index": "iu", "flag": "biu", "text": "OSU"}


class Array(typing.NamedTuple):
    """Requirements on an array in a file.

    shape: numbers, names (the same size wherever they occur) or None (any). kind: "finite" numbers, "number"
    (NaN allowed), "index" (integers >= 0), "flag" or "text".
    """

    shape: tuple
    kind: str = "finite"


class Unfit(ValueError):
    """A file that can be read has other contents; the message is complete."""


@contextlib.contextmanager
def reading(path: pathlib.Path | str, what: str, remedy: str) -> Iterator[pathlib.Path]:
    """Context of a library's calls that read `path`; any exception becomes one line.

    Args:
      what: expected contents, such as "recorded press". remedy: advice in the message.

    Raises:
      FileNotFoundError: no such file. ValueError: the file has other contents, or is damaged.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise ValueError(f"the path of a {what} is {short_repr(path)}: {remedy}")
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no {what} at {path}: {remedy}")
    try:
        yield pathlib.Path(path)
    except Unfit:
        raise
    except Exception as error:  # libraries raise any type for broken files
        text = str(error).strip()
        if len(text) > 1 and text[0] == text[-1] in "'\"":  # as of a KeyError
            text = text[1:-1]
        lines = text.splitlines() or [type(error).__name__]
        raise ValueError(f"{path} is no {what} ({lines[0][:200]}): {remedy}") from error


def check_arrays(
    path: pathlib.Path | str,
    found: Mapping,
    wanted: Mapping[str, Array],
    remedy: str,
    sizes: dict | None = None,
) -> dict:
    """Checks arrays, and returns the sizes of the named axes in their shapes.

    Args:
      path: of the file, for messages. found: name -> array or HDF5 data set; values of "finite" and "index"
        are checked in numpy arrays only. sizes: known sizes.

    Raises:
      ValueError: an array is missing, or has another shape, type or values.
    """
    sizes = {} if sizes is None else sizes
    missing = [name for name in wanted if name not in found]
    if missing:
        raise Unfit(f"{path} has no {', '.join(missing)}: {remedy}")
    for name, (shape, kind) in wanted.items():
        value = found[name]
        if not hasattr(value, "dtype"):
            raise Unfit(f"{name} of {path} is no array: {remedy}")
        if value.dtype.kind not in _KINDS[kind]:
            raise Unfit(f"{name} of {path} holds {value.dtype}, not {kind} values: {remedy}")
        same = value.shape is not None and len(value.shape) == len(shape)
        for size, needed in zip(value.shape, shape) if same else ():
            needed = sizes.setdefault(needed, size) if isinstance(needed, str) else needed
            same &= needed in (None, size)
        if not same:
            text = ", ".join(str(sizes.get(s, s) if isinstance(s, str) else s or "any") for s in shape)
            raise Unfit(f"{name} of {path} has shape {value.shape}, ({text}) is needed: {remedy}")
        if isinstance(value, np.ndarray) and kind == "finite" and not np.isfinite(value).all():
            raise Unfit(f"{name} of {path} has values that are not finite: {remedy}")
        if isinstance(value, np.ndarray) and kind == "index" and value.size and value.min() < 0:
            raise Unfit(f"{name} of {path} has negative numbers: {remedy}")
    return sizes


def read_hdf5(
    path: pathlib.Path | str,
    what: str,
    remedy: str,
    wanted: Mapping[str, Array],
    attributes: Iterable = (),
    also: Mapping[str, Array] | None = None,
) -> tuple[dict, dict]:
    """Arrays and attributes of an HDF5 file, see `check_arrays`. also: optional arrays."""
    import h5py

    with reading(path, what, remedy), h5py.File(path) as file:
        wanted = {**wanted, **{name: array for name, array in (also or {}).items() if name in file}}
        there = {name: file[name] for name in wanted if name in file}
        check_arrays(path, there, wanted, remedy)  # before anything is read
        found = {name: value[()] for name, value in there.items()}
        check_arrays(path, found, wanted, remedy)
        missing = [name for name in attributes if name not in file.attrs]
        if missing:
            raise Unfit(f"{path} has no attribute {', '.join(missing)}: {remedy}")
        return found, {name: file.attrs[name] for name in attributes}


def read_npz(
    path: pathlib.Path | str,
    what: str,
    remedy: str,
    wanted: Mapping[str, Array] | None = None,
    also: Mapping[str, Array] | None = None,
) -> dict:
    """Arrays of an .npz file, the wanted ones or all, see `check_arrays`. also: optional arrays."""
    with reading(path, what, remedy):
        if pathlib.Path(path).is_file() and not zipfile.is_zipfile(path):
            raise Unfit(f"{path} is no {what}, not even an .npz file: {remedy}")
    with reading(path, what, remedy), np.load(path, allow_pickle=False) as file:
        there = {name: array for name, array in (also or {}).items() if name in file.files}
        wanted = {**wanted, **there} if wanted is not None else None
        names = file.files if wanted is None else [name for name in wanted if name in file.files]
        found = {name: file[name] for name in names}
        check_arrays(path, found, wanted or {}, remedy)
    return found


def read_text(path: pathlib.Path | str, what: str, remedy: str) -> str:
    """Contents of a text file."""
    with reading(path, what, remedy):
        return pathlib.Path(path).read_text(encoding="utf-8-sig")


def read_json(path: pathlib.Path | str, what: str, remedy: str) -> dict:
    """The dict in a JSON file."""
    text = read_text(path, what, remedy)
    with reading(path, what, remedy):
        return _dict(path, what, remedy, json.loads(text))


def read_yaml(path: pathlib.Path | str, what: str, remedy: str) -> dict:
    """The dict in a YAML file."""
    import yaml

    text = read_text(path, what, remedy)
    with reading(path, what, remedy):
        return _dict(path, what, remedy, yaml.safe_load(text))


def _dict(path, what, remedy, found):
    if not isinstance(found, dict):
        raise Unfit(f"{path} is no {what} (it holds {type(found).__name__}, not names with values): {remedy}")
    return found
