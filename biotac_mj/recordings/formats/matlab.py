"""MATLAB files and other HDF5: variables by name, including those in structs and groups."""

import io
import pathlib
import re

import numpy as np

from ...geometry.design import designs
from ...reading import reading
from .names import is_time, place_of, unit_named
from .streams import SECONDS, Stream, make_streams

_WHAT, _REMEDY = (
    "MATLAB file",
    "save it again with `save -v7`, variables called electrodes, pdc, pac, force, time",
)
_DEEPEST = 8  # nesting of structs


def is_matlab(content: bytes) -> bool:
    """Whether a file's content is MATLAB's, up to v7; later versions are HDF5."""
    return content.startswith(b"MATLAB 5.0 MAT-file")


def read_matlab(path: pathlib.Path, content: bytes, role: str | None = None) -> list[Stream]:
    """Streams of a file up to v7. Each struct of an array is a separate log, as are the cells of arrays of
    equal length. Variables have names, so `role` has no effect.

    Raises:
      ValueError: damaged, or nothing recognised.
    """
    import scipy.io

    with reading(path, _WHAT, _REMEDY):
        found = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True)
    found = {name: value for name, value in found.items() if not name.startswith("__")}
    while len(found) == 1 and isinstance(inner := next(iter(found.values())), dict):
        found = inner  # a single struct that holds all
    streams, trials = [], _trials(found)
    for k, trial in enumerate(trials, 1):
        columns, words = {}, {}
        _walk(trial, "", columns, words, 0)
        for stream in _streams(path, columns, words):
            stream.source = f"{path.stem}_{k}" if len(trials) > 1 else stream.source
            streams.append(stream)
    return streams


def read_hdf5(path: pathlib.Path) -> list[Stream]:
    """Streams of a MATLAB file of v7.3, or of any HDF5 file whose data sets have such names. If all data are
    in groups and these have electrodes, each group is a separate log.

    Raises:
      ValueError: damaged, or nothing recognised.
    """
    import h5py

    columns, said = {}, []
    with reading(path, _WHAT, _REMEDY), h5py.File(path) as file:

        def take(name, item):
            if not isinstance(item, h5py.Dataset) or name.startswith("#"):
                return
            if item.dtype.kind not in "fiu":
                said.append(f"{path.name}: left out {name}, which has no numbers")
            else:
                value, note = _in_our_unit(
                    name, item[()], item.attrs.get("unit", item.attrs.get("units", ""))
                )
                said.extend([f"{path.name}: {note}"] if note else [])
                if value is not None:
                    columns[name] = value

        file.visititems(take)
    groups = {}
    for name, value in columns.items():
        group, _, own = name.partition("/")
        groups.setdefault(group if own else "", {})[own or group] = value
    logs = {name: one for name, one in groups.items() if any(map(_is_electrodes, one))}
    if "" in groups or not logs:
        out = _streams(path, {name.replace("/", "_"): value for name, value in columns.items()}, {})
        for stream in out:
            stream.notes = [*said, *stream.notes]
        return out
    out = []
    for name, one in groups.items():
        try:
            streams = _streams(path, {inner.replace("/", "_"): value for inner, value in one.items()}, {})
            if name not in logs and any(stream.time is None for stream in streams):
                raise ValueError  # its time is unknown
        except ValueError:
            if name in logs:
                raise
            said.append(f"{path.name}: left out group {name}")
            continue
        for stream in streams:
            stream.source = f"{path.stem}_{name}" if len(logs) > 1 or name not in logs else stream.source
            if len(logs) > 1:  # a data set named after one of them belongs to it
                stream.called = name if name in logs else ""
                stream.sensor = stream.sensor if name in logs else f"{name}_{stream.sensor}".strip("_")
            out.append(stream)
    for stream in out:
        stream.notes = [*said, *stream.notes]
    return out


def _in_our_unit(name, value, unit):
    """(value, note) of a data set with a unit attribute; (None, note) for an unknown unit."""
    place, unit = place_of(name.replace("/", "_")), unit.decode() if isinstance(unit, bytes) else str(unit)
    field = place.field if place else ""
    plain = re.sub(r"[\s,*.·]", "", unit)
    if not plain:
        return value, ""
    if is_time(name.rpartition("/")[2]):
        factor = SECONDS.get(plain.lower(), 1.0)
        return (value * factor, f"{name} is read as {unit}") if factor != 1.0 else (value, "")
    if field.endswith("quat") and plain.lower() == "xyzw" and value.ndim == 2 and value.shape[1] == 4:
        return np.roll(value, 1, axis=1), f"{name} is read as x y z w"
    if field not in ("force", "torque") and not field.endswith("_pos"):
        return value, ""
    said, factor = unit_named(plain)
    if not said:
        return None, f"left out {name}, whose unit is {unit!r}: N, N m and m and parts of them are known"
    return (value * factor, f"{name} is read as {said}") if factor != 1.0 else (value, "")


def _is_electrodes(name):
    place = place_of(name.replace("/", "_"))
    return place is not None and place.field == "electrodes"


def _trials(found):
    """Logs in a file: itself, the structs of its only struct array, or one per cell."""
    (only, *others) = [value for value in found.values() if not isinstance(value, str)] or [None]
    if not others and _each(only, dict):
        return list(only)
    cells = {name: value for name, value in found.items() if _each(value, np.ndarray)}
    if any(map(_is_electrodes, cells)) and len({len(value) for value in cells.values()}) == 1:
        many = range(len(next(iter(cells.values()))))
        rest = {name: value for name, value in found.items() if isinstance(value, str)}
        return [{**rest, **{name: value[k] for name, value in cells.items()}} for k in many]
    return [found]


def _each(value, kind):
    """Whether a value is a list or a cell array whose elements all are of a kind."""
    listed = isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object)
    return listed and len(value) > 0 and all(isinstance(one, kind) for one in value)


def _walk(value, name, columns, words, depth):
    if isinstance(value, dict) and depth < _DEEPEST:
        for key, item in value.items():
            if not key.startswith("__"):
                _walk(item, f"{name}_{key}" if name else key, columns, words, depth + 1)
    elif isinstance(value, str):
        words[name.lower()] = value
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size > 1:
        columns[name] = value


def _streams(path, columns, words):
    columns, notes = _with_electrodes(path.name, columns)
    streams = make_streams(path.name, columns, notes)
    for stream in streams:
        stream.object = words.get("object", "")
    return streams


def _with_electrodes(source, columns):
    """Columns, and a note, if no name marks the electrodes and exactly one array has as many columns or rows
    as a fingertip has electrodes."""
    if any(map(_is_electrodes, columns)):
        return columns, []
    counts = {design.nelectrode for design in designs()}
    like = [name for name, value in columns.items() if value.ndim == 2 and not counts.isdisjoint(value.shape)]
    if len(like) != 1 or place_of(like[0]):
        return columns, []
    called = {"electrodes" if name == like[0] else name: value for name, value in columns.items()}
    return called, [f"{source}: {like[0]}, the only array of as many, was taken for the electrodes"]
