"""Writes files completely or not at all, and checks before the work that they can be written."""

import contextlib
import fcntl
import io
import json
import os
import pathlib
import shlex
import shutil
import stat
import tempfile
import typing
from collections.abc import Iterator

import numpy as np

from .short_repr import short_repr

if typing.TYPE_CHECKING:
    import h5py
    from matplotlib.figure import Figure

_MARK = ".biotac-"  # start of the names of temporary files
_ROOM = 32  # characters that the name of a temporary file needs beyond the suffix


def quoted(path: pathlib.Path | str) -> str:
    """A path as the shell takes it, in a command that is printed."""
    return shlex.quote(str(path))


@contextlib.contextmanager
def replacing(path: pathlib.Path | str, folder: bool = False) -> Iterator[pathlib.Path]:
    """Yields a temporary path with the same suffix in the same folder; renames it to `path` on success, else
    removes it. First removes temporary files of killed processes from the folder.

    Args:
      path: of the file, or with `folder` of a folder that does not exist.

    Raises:
      ValueError: not a path, or the path of an existing folder. OSError: it cannot be written.
    """
    path = _path(path)
    if path.is_dir() or not path.name:
        raise ValueError(f"{path} is a folder: give a new name" if folder else _is_folder(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    temporary, lock = _temporary(path, folder)
    try:
        yield temporary
        os.chmod(temporary, 0o755 if folder else 0o644)
        os.replace(temporary, path)
    except BaseException:
        _remove(temporary)
        raise
    finally:
        if lock is not None:
            os.close(lock)


def _path(value):
    if not isinstance(value, (str, os.PathLike)) or isinstance(path := os.fspath(value), bytes):
        raise ValueError(f"path is {short_repr(value)}: give the name of a file, as text")
    if "\0" in path:
        raise ValueError(f"path is {short_repr(path)}: give a name without a zero byte")
    return pathlib.Path(path)


def _is_folder(path):
    return f"{path} is a folder: give the name of a file"


def remove_leftovers(folder: pathlib.Path | str) -> None:
    """Removes the temporary files of processes that have ended from a folder; those of others are locked."""
    for path in pathlib.Path(folder).glob(f"{_MARK}*"):
        with contextlib.suppress(OSError):  # locked, gone meanwhile, or on a disk without locks
            lock = _lock(path)
            _remove(path)
            os.close(lock)


def _temporary(path, folder):
    """A unique path, and the handle that locks it (None on a disk without locks)."""
    while True:
        if folder:
            made = tempfile.mkdtemp(dir=path.parent, prefix=_MARK)
        else:
            handle, made = tempfile.mkstemp(dir=path.parent, prefix=_MARK, suffix=path.suffix)
            os.close(handle)
        try:
            lock = _lock(made)
        except (BlockingIOError, FileNotFoundError):  # another process took it for a leftover
            continue
        except OSError:
            return pathlib.Path(made), None
        if os.path.exists(made):
            return pathlib.Path(made), lock
        os.close(lock)


def _lock(path):
    """A handle that locks the file until it is closed or its process ends.

    Raises:
      BlockingIOError: another process has locked it. OSError: it does not exist, or its disk has no locks.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise
    return handle


def _remove(path):
    if os.path.isdir(path):
        shutil.rmtree(path, ignore_errors=True)
    else:
        pathlib.Path(path).unlink(missing_ok=True)


@contextlib.contextmanager
def hdf5(path: pathlib.Path | str, **settings: object) -> Iterator["h5py.File"]:
    """A new HDF5 file, which appears at `path` when it is complete.

    It is made in memory, since on a full disk HDF5 fails when it closes, and ends the process.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w", **settings) as file:
        yield file
    with replacing(path) as temporary:
        temporary.write_bytes(memory.getbuffer())


def write_npz(path: pathlib.Path | str, **arrays: np.ndarray) -> None:
    """Writes arrays to a compressed .npz file."""
    memory = io.BytesIO()
    np.savez_compressed(memory, allow_pickle=False, **arrays)
    with replacing(path) as temporary:
        temporary.write_bytes(memory.getbuffer())


def write_json(path: pathlib.Path | str, value: object, indent: int | None = 1) -> None:
    """Writes JSON types to a file."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=indent) + "\n", encoding="utf-8")


def save_figure(path: pathlib.Path | str, figure: "Figure", dpi: int = 110, kind: str | None = None) -> None:
    """Writes a picture of a figure of Matplotlib; kind: its format, None: by the suffix."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format=kind)


def check_output(folder: pathlib.Path | str, *names: str) -> None:
    """Checks that files of these names can be written to a folder; changes nothing, except for
    `remove_leftovers`.

    Raises:
      ValueError: they cannot be written, with the reason.
    """
    folder = pathlib.Path(folder)
    try:
        _refuse_long(folder, names)
        there = _nearest(folder)
        if there == folder:
            for path in (folder / name for name in names):
                if os.path.lexists(path) and not path.is_file():
                    raise ValueError(f"{path} is there and is no file: remove it, or choose another folder")
            remove_leftovers(folder)
        with tempfile.TemporaryFile(dir=there, buffering=0) as file:
            file.write(bytes(4096))
    except OSError as error:
        raise ValueError(
            f"{folder} cannot be written to ({error.strerror or error}): choose another place"
        ) from None


def check_output_file(path: pathlib.Path | str, *more: str) -> None:
    """`check_output` for one file, and for others in its folder."""
    path = _path(path)
    if os.path.isdir(path) or not path.name:
        raise ValueError(_is_folder(path))
    check_output(path.parent, path.name, *more)


def picture_kind(path: pathlib.Path | str) -> str:
    """Format of a picture from its name, for matplotlib; PNG without a suffix.

    Raises:
      ValueError: an unknown format.
    """
    from matplotlib.backend_bases import FigureCanvasBase

    kind, known = pathlib.Path(path).suffix[1:].lower() or "png", FigureCanvasBase.filetypes
    if kind not in known:
        raise ValueError(f"{path} is no picture: give a name that ends in one of {', '.join(sorted(known))}")
    return kind


def refuse_existing(*paths: pathlib.Path | str) -> None:
    """Raises ValueError if one of these exists. Results replace earlier ones of the same name; recordings,
    bags, sets, designs and protocols never do."""
    for path in paths:
        if os.path.lexists(path):
            raise ValueError(f"{path} is there already: give a new name, or remove it")


def refuse_inputs(
    option: str, path: pathlib.Path | str, *inputs: pathlib.Path | str | None, given: str = ""
) -> None:
    """Raises ValueError if an output file is also an input. given: the folder, if an option named that."""
    for one in inputs:
        if one and os.path.exists(one) and os.path.exists(path) and os.path.samefile(path, one):
            where, remedy = f"{option} {path}", "give another name"
            if given and str(given) != str(path):
                where, remedy = f"{option} {given}: {path}", "choose another folder"
            raise ValueError(f"{where} is one of the files that are read: {remedy}")


def _nearest(folder):
    """The folder, or its nearest existing parent."""
    for path in (folder, *folder.parents):
        try:
            mode = os.stat(path).st_mode
        except FileNotFoundError:
            if os.path.islink(path):
                raise ValueError(f"{path} is a link to nothing: choose another folder") from None
            continue
        except NotADirectoryError:
            continue
        if not stat.S_ISDIR(mode):
            under = "is a file" if path == folder else f"lies under {path}, which is a file"
            raise ValueError(f"{folder} {under}: choose another folder")
        return path
    raise ValueError(f"{folder} lies nowhere: choose another folder")


def _refuse_long(folder, names):
    longest, whole = os.pathconf("/", "PC_NAME_MAX"), os.pathconf("/", "PC_PATH_MAX")
    for part in (*folder.parts, *names):
        if len(os.fsencode(part)) > longest - _ROOM:
            raise ValueError(f"{part[:40]}... is too long for a name: {longest - _ROOM} letters at most")
    if len(os.fsencode(folder.absolute())) + max(map(len, ("", *names))) > whole - _ROOM:
        raise ValueError(f"{str(folder)[:40]}... is too long for a path: {whole - _ROOM} letters at most")
