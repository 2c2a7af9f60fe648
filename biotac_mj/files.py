"""Files that are written whole or not at all, and whether they could be, asked before the work."""

import contextlib
import fcntl
import io
import os
import pathlib
import shutil
import stat
import tempfile
import typing
from collections.abc import Iterator

import numpy as np

from .short_repr import short_repr

if typing.TYPE_CHECKING:
    import h5py

__all__ = [
    "check_output",
    "check_output_file",
    "hdf5",
    "picture_kind",
    "refuse_inputs",
    "remove_leftovers",
    "replacing",
    "write_npz",
]

_MARK = ".biotac-"  # the name of a temporary begins with it
_ROOM = 32  # letters that a temporary's name needs beyond the ending of the file's


@contextlib.contextmanager
def replacing(path: pathlib.Path | str, folder: bool = False) -> Iterator[pathlib.Path]:
    """Gives a temporary path with the same ending in the same folder; renames it to `path` if all went well,
    else removes it. What a killed process left in the folder is removed first.

    Args:
      path: of the file, or with `folder` of a folder that is not there yet.

    Raises:
      ValueError: it is no path, or one of a folder that is there. OSError: it cannot be written.
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
    """Removes the temporaries of processes that have ended from a folder; those of others are locked."""
    for path in pathlib.Path(folder).glob(f"{_MARK}*"):
        with contextlib.suppress(OSError):  # locked, gone meanwhile, or on a disk without locks
            lock = _lock(path)
            _remove(path)
            os.close(lock)


def _temporary(path, folder):
    """A path nobody else has, and the handle that holds it (None on a disk without locks)."""
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
    """A handle that holds the file until it is closed or its process ends.

    Raises:
      BlockingIOError: another one has it. OSError: it is gone, or its disk has no locks.
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
    """A new HDF5 file, which is at `path` as soon as it has been filled.

    It is filled in memory: on a full disk HDF5 fails when it closes, and takes the process with it.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w", **settings) as file:
        yield file
    with replacing(path) as temporary:
        temporary.write_bytes(memory.getbuffer())


def write_npz(path: pathlib.Path | str, **arrays: np.ndarray) -> None:
    """Arrays as a compressed .npz file."""
    memory = io.BytesIO()
    np.savez_compressed(memory, allow_pickle=False, **arrays)
    with replacing(path) as temporary:
        temporary.write_bytes(memory.getbuffer())


def check_output(folder: pathlib.Path | str, *names: str) -> None:
    """Refuses a folder in which files of these names could not be written; makes nothing but room: see
    `remove_leftovers`.

    Raises:
      ValueError: what is in the way.
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
    """The same for one file, and for others beside it."""
    path = _path(path)
    if os.path.isdir(path) or not path.name:
        raise ValueError(_is_folder(path))
    check_output(path.parent, path.name, *more)


def picture_kind(path: pathlib.Path | str) -> str:
    """The kind of a picture by its name, as matplotlib says it; PNG where the name has none.

    Raises:
      ValueError: no kind that can be written.
    """
    from matplotlib.backend_bases import FigureCanvasBase

    kind, known = pathlib.Path(path).suffix[1:] or "png", FigureCanvasBase.filetypes
    if kind not in known:
        raise ValueError(f"{path} is no picture: give a name that ends in one of {', '.join(sorted(known))}")
    return kind


def refuse_inputs(
    option: str, path: pathlib.Path | str, *inputs: pathlib.Path | str | None, given: str = ""
) -> None:
    """Raises ValueError where a file that will be written is one of those that are read; given: its folder,
    where an option named that."""
    for one in inputs:
        if one and os.path.exists(one) and os.path.exists(path) and os.path.samefile(path, one):
            where, remedy = f"{option} {path}", "give another name"
            if given and str(given) != str(path):
                where, remedy = f"{option} {given}: {path}", "choose another folder"
            raise ValueError(f"{where} is one of the files that are read: {remedy}")


def _nearest(folder):
    """The folder, or what is there of the way to it."""
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
