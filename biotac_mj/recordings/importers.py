"""Reads files of any kind as recordings; the kind is recognised by content."""

import os
import pathlib
import re
import typing
from collections.abc import Callable, Sequence

import h5py

from ..fields import as_real
from ..reading import reading
from ..short_repr import short_repr
from .formats.arrays import is_numpy, read_numpy
from .formats.bags import is_bag, read_bag
from .formats.btd import is_btd, read_btd
from .formats.columns import open_bytes
from .formats.joining import join
from .formats.matlab import is_matlab, read_hdf5, read_matlab
from .formats.nvidia import read_nvidia
from .formats.pressed import KEYS, read_press
from .formats.published import companions, is_companion, object_of, rate_of
from .formats.streams import Stream
from .formats.text import read_text
from .inspection import warnings
from .recording import Recording, read

_NVIDIA = {"electrode_vals", "contact_loc", "force_vec"}
_HDF5 = b"\x89HDF\r\n\x1a\n"

# kinds of files: test of the content (bytes), and reader (path, content, role) -> list[Stream]. The first
# that recognises a file reads it; `read_text` reads all others
READERS: list[tuple[Callable, Callable]] = [
    (is_matlab, read_matlab),
    (is_btd, read_btd),
    (is_numpy, read_numpy),
]


def load(
    paths: Sequence[pathlib.Path | str] | pathlib.Path | str,
    *,
    force: pathlib.Path | str | None = None,
    tdc: pathlib.Path | str | None = None,
    rate: float | None = None,
    scale: float | None = None,
    object_name: str | None = None,
    objects: list[str] | None = None,
) -> list[Recording]:
    """Loads recordings from files: our own HDF5, a press, text and CSV, MATLAB, NumPy, other HDF5, .btd, ROS
    bags, NVIDIA's HDF5, gzipped or not.

    Files without electrodes (forces, poses) are aligned with the rows of those that have them, by clock or
    row by row. Companion files of published data sets are read too (`published`).

    Args:
      paths: files, or folders of ROS 2 bags.
      force, tdc: text files of forces [N], or raw counts of the thermistor, row by row.
      rate: [Hz] of rows without times (None: guessed; `Recording.rate_source` has the source).
      scale: counts per unit of the channels, 4095 for normalised ones.
      object_name: what touched. objects: names of NVIDIA's indenter types.

    Raises:
      FileNotFoundError, ValueError: a file that does not exist or cannot be read; the text has file, place
        and remedy.
    """
    paths = [paths] if isinstance(paths, str | os.PathLike) else paths
    for what, given in (("paths", paths), ("force", [force or ""]), ("tdc", [tdc or ""])):
        known = isinstance(given, list | tuple) and all(isinstance(one, str | os.PathLike) for one in given)
        if not known:
            raise ValueError(f"{what} is {short_repr(given)}: give names of files")
    for what, number in (("rate", rate), ("scale", scale)):
        if number is not None:
            as_real(what, number, 0.0, above=True)
    paths = [pathlib.Path(one) for one in paths]
    if len(set(paths)) < len(paths):
        raise ValueError("a file is given twice: give each once")
    if not paths:
        raise ValueError("no file was given: give the sensor's own, and others with it")
    roles = {pathlib.Path(p): role for p, role in ((force, "force"), (tdc, "tdc")) if p is not None}
    done, groups, without_sensor = [], [], []
    companion_files = [path for path in paths if len(paths) > 1 and is_companion(path)]
    read_with = {other for path in paths for other in companions(path)}
    for path in [*(path for path in paths if path not in {*companion_files, *read_with}), *roles]:
        role = roles.get(path, "electrodes" if len(paths) == 1 else None)
        found = _read(path, role, rate, objects)
        if objects and path not in roles and not _is_nvidia(path):
            raise ValueError(
                f"{path} is no file of NVIDIA's, whose indenter types the list of objects names: give the "
                "name of the one object"
            )
        if found and isinstance(found[0], Recording):
            done += found
        elif any(stream.has_channels for stream in found) and path not in roles:
            of_companions = [stream for one in companions(path) for stream in _read(one, None, rate, None)]
            groups.append([*found, *of_companions])
        else:
            without_sensor += found
    if not groups and without_sensor and done:
        raise ValueError(
            f"{without_sensor[0].source} cannot be put beside {done[0].name}, which is complete: import the "
            "log that it was made from with this file (`biotac recording import LOG FILE --out REC.h5`)"
        )
    if not groups and not done:
        groups.append([])
    for group in _merge_row_by_row(_with_electrodes(groups)):
        done += join([*group, *without_sensor], rate, object_name, scale)
    if companion_files:
        names = ", ".join(path.name for path in companion_files[:4]) + (
            " ..." if len(companion_files) > 4 else ""
        )
        for one in done:
            one.notes = (*one.notes, f"left out {names}")
    return done


def _with_electrodes(groups):
    """Groups of streams in which files of other channels are joined to the electrodes' file (to that of the
    same number if there are several), if they were logged together."""
    have = [group for group in groups if any("electrodes" in stream.fields for stream in group)]
    out = list(have)
    for group in (group for group in groups if group not in have):
        fit = have if len(have) == 1 else [one for one in have if _number(one) == _number(group) != ""]
        if len(fit) == 1 and all(_meet(fit[0][0], stream) for stream in group):
            fit[0].extend(group)
        else:
            out.append(group)
    return out


def _number(group):
    """Number at the end of the name of a group's file."""
    return re.search(r"\d*$", group[0].source.split(".")[0])[0]


def _meet(stream, other):
    """Whether one sensor can have logged both at a time, each with its own channels."""
    if stream.sensor != other.sensor or set(stream.fields) & set(other.fields):
        return False
    if stream.time is None or other.time is None:
        return stream.time is other.time and len(stream) == len(other)
    return stream.time[0] <= other.time[-1] and other.time[0] <= stream.time[-1]


def _merge_row_by_row(groups):
    """Groups of streams; those without times and of equal length are merged: sensors logged row by row."""
    out = {}
    for k, group in enumerate(groups):
        rows = {len(stream) for stream in group}
        loose = len(rows) == 1 and all(stream.time is None and stream.rate is None for stream in group)
        kept = out.setdefault(("rows", *rows) if loose else ("clock", k), [])
        kept += [stream for stream in group if stream.source not in {one.source for one in kept}]
    return list(out.values())


class Loaded(typing.NamedTuple):
    """Result of `load_one`: recording, notes = load_one(path).

    Attributes:
      recording: Recording.
      notes: other recordings in the file and reasons for doubt (`warnings`), one line each.
    """

    recording: Recording
    notes: list[str]


def load_one(path: pathlib.Path | str, recording: str | None = None, **options: object) -> Loaded:
    """Loads one recording of a file, with notes.

    Args:
      path: as for `load`, which returns all its recordings.
      recording: its name, or the end of it; None: the first.
      options: keywords of `load`.

    Raises:
      FileNotFoundError, ValueError: see `load`; or no recording of that name.
    """
    one, others = choose(load(path, **options), path, recording)
    return Loaded(one, others + warnings(one))


def choose(
    found: Sequence[Recording], path: pathlib.Path | str, recording: str | None = None
) -> tuple[Recording, list[str]]:
    """One of the recordings that `load` found in a file, and a note if none was requested and there are
    others; arguments as for `load_one`.

    Raises:
      ValueError: no recording of that name.
    """
    names = [one.name for one in found]
    if recording is None:
        others = f"{len(found)} recordings are in {path}, this is {names[0]}: --recording takes another of "
        return found[0], [others + ", ".join(names[:6])] if len(found) > 1 else []
    chosen = [one for one in found if one.name == recording] or [
        one for one in found if one.name.endswith(recording)
    ]
    if len(chosen) != 1:
        raise ValueError(
            f"{path} has {len(chosen)} recordings called {recording!r}: choose one of {', '.join(names[:12])}"
        )
    return chosen[0], []


def _read(path, role, rate, objects) -> list[Stream] | list[Recording]:
    try:
        return _read_any(path, role, rate, objects)
    except OSError as error:
        if error.errno and not error.filename:  # a failed read does not name the file
            error.filename = str(path)
        raise


def _read_any(path, role, rate, objects):
    if is_bag(path):
        return _named(path, read_bag(path))
    if path.is_dir():
        raise FileNotFoundError(
            f"{path}: no such file: it is a folder, and no ROS 2 bag (no metadata.yaml): give the files in it"
        )
    if path.is_file():
        with open(path, "rb") as file:
            head = file.read(520)
        if _HDF5 in (head[:8], head[512:]):
            return _read_hdf5(path, rate, objects)
    content = open_bytes(path)
    for recognise, read_streams in READERS:
        if recognise(content):
            return _named(path, read_streams(path, content, role))
    if content.startswith(b"PK\x03\x04"):
        raise ValueError(f"{path} is a .zip or .xlsx file: unpack it, or save its table as CSV")
    if path.suffix in (".h5", ".hdf5", ".mat", ".bag", ".mcap", ".db3"):
        raise ValueError(
            f"{path} is no {path.suffix} file, whatever its name says: was it cut off? Copy it again"
        )
    return _named(path, read_text(path, content, role))


def _read_hdf5(path, rate, objects):
    names, schema = _holds(path)
    if schema.startswith("biotac_mj.data"):
        raise ValueError(
            f"{path} is a shard of a data set, no recording: `biotac learn train` and `biotac data export` "
            "take it"
        )
    if names & _NVIDIA:
        return read_nvidia(path, rate, objects)
    if set(KEYS) <= names:
        return read_press(path)
    if schema:
        return read(path)
    return _named(path, read_hdf5(path))


def _holds(path):
    """Names of an HDF5 file's groups, and its schema."""
    with reading(path, "recording", "copy it again"), h5py.File(path) as file:
        return set(file), str(file.attrs.get("schema", ""))


def _is_nvidia(path):
    return path.is_file() and h5py.is_hdf5(path) and bool(_holds(path)[0] & _NVIDIA)


def _named(path, streams):
    for stream in streams:
        stream.object = stream.object or object_of(path)
        stream.rate = stream.rate or rate_of(path)
    return streams
