"""What is worth keeping between processes: arrays on disk, found by a digest of what they were made of.

A file is written under a temporary name and then renamed, so that none is ever seen half written. One that is
damaged is noticed, made again and replaced. A folder that cannot be written costs time and nothing else, and
it does not grow for ever: every material has its own files, 200 MB where its compliance is kept, and a set of
data draws thousands, so what was not used for longest is deleted."""

import contextlib
import functools
import hashlib
import io
import os
import pathlib
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterable
from typing import BinaryIO

import numpy as np

from ..files import replacing

__all__ = ["cache_folder", "digest", "kept", "replace_file", "report_damage", "touch"]

_FORMAT = "1"  # of the files and of what is in them
_LARGEST = 4  # of the whole folder unless BIOTAC_CACHE_GB says otherwise [GB]


def cache_folder() -> pathlib.Path:
    """$BIOTAC_CACHE, or biotac_mj in the user's cache folder."""
    if os.environ.get("BIOTAC_CACHE"):
        return pathlib.Path(os.environ["BIOTAC_CACHE"])
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA", pathlib.Path.home() / "AppData/Local")
    elif sys.platform == "darwin":
        base = pathlib.Path.home() / "Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(base) / "biotac_mj"


def digest(content: Iterable) -> str:
    """Of arrays (their type and shape count), bytes, and anything whose repr says all."""
    found = hashlib.sha256(_FORMAT.encode())
    for item in content:
        if isinstance(item, np.ndarray):
            found.update(f"{item.dtype.str}{item.shape}".encode())
            item = np.ascontiguousarray(item).data
        elif not isinstance(item, bytes):
            item = repr(item).encode()
        found.update(item)
        found.update(b";")
    return found.hexdigest()[:24]


@functools.cache
def _program() -> str:
    """Digest of the code of the skin: what other code has made is not taken from the cache."""
    files = sorted(pathlib.Path(__file__).parent.rglob("*.py"))
    return digest(part for file in files for part in (file.name, file.read_bytes()))


def kept(kind: str, inputs: Iterable, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays that `make` makes of the inputs, from disk where they have been made before.

    Args:
      kind: what they are, the beginning of the file's name.
      inputs: all that the arrays depend on beside the skin's code, see `digest`.
    """
    key = digest([kind, _program(), *inputs])
    path = cache_folder() / f"{kind}-{key}.npz"
    found = _load(path, key)
    if found is None:
        found = make()
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, key=np.array(key), **found)
        replace_file(path, lambda file: file.write(buffer.getbuffer()))
    return found


def _load(path, key):
    try:
        with np.load(path, allow_pickle=False) as file:  # the archive has a checksum of each array
            found = dict(file)
        if str(found.pop("key")) != key:
            raise ValueError("made of something else")
    except OSError:  # not there, or not to be read
        return None
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError):
        report_damage(path)
        return None
    touch(path)
    return found


def touch(path: pathlib.Path) -> None:
    """Notes that a file has been used now."""
    with contextlib.suppress(OSError):
        os.utime(path)


def _limit() -> float:
    """Bytes that the folder may hold."""
    given = os.environ.get("BIOTAC_CACHE_GB") or _LARGEST
    try:
        found = float(given) * 1e9
    except ValueError:
        found = -1.0
    if not found >= 0:
        raise ValueError(f"BIOTAC_CACHE_GB must be a number of gigabytes of 0 or more, not {given!r}")
    return found


def _prune(newest: pathlib.Path) -> None:
    """Deletes what was used longest ago until the folder is within its limit; never the newest file. A file
    that a process has mapped lives on until that process ends (on Windows it stays: it cannot be deleted)."""
    files = []
    for file in newest.parent.iterdir():
        with contextlib.suppress(OSError):  # also where another process is doing the same
            state = file.stat()
            if file.suffix in (".npz", ".npy", ".rows") and file != newest:
                files.append((state.st_mtime, state.st_size, file))
    room = _limit() - newest.stat().st_size
    for _, size, file in sorted(files, reverse=True):
        room -= size
        if room < 0:
            with contextlib.suppress(OSError):
                file.unlink()


def report_damage(path: pathlib.Path) -> None:
    """Says in one line that a file cannot be used."""
    print(f"biotac_mj: {path} is damaged, what it held is computed again", file=sys.stderr)


def replace_file(path: pathlib.Path, write: Callable[[BinaryIO], object]) -> bool:
    """Writes a file of the cache all at once and deletes old ones; False where that is not possible.

    Raises:
      ValueError: BIOTAC_CACHE_GB is no size.
    """
    try:
        with replacing(path) as temporary, open(temporary, "wb") as file:
            write(file)
        _prune(path)
    except OSError:
        return False
    return True
