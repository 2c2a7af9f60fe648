"""What is worth keeping between processes: arrays on disk, found by a digest of what they were made of.

A file is written under a temporary name and then renamed, so that none is ever seen half written. One that is
damaged is noticed, made again and replaced. A folder that cannot be written costs time and nothing else."""

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

__all__ = ["cache_folder", "digest", "kept", "replace_file", "report_damage"]

_FORMAT = "1"  # of the files and of what is in them
_MOST = 64  # files of a kind: those that were used last stay


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
        if replace_file(path, lambda file: file.write(buffer.getbuffer())):
            _prune(kind)
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
    with contextlib.suppress(OSError):
        os.utime(path)
    return found


def _prune(kind):
    with contextlib.suppress(OSError):  # also where another process is doing the same
        files = sorted(cache_folder().glob(f"{kind}-*.npz"), key=lambda file: file.stat().st_mtime)
        for file in files[:-_MOST]:
            file.unlink()


def report_damage(path: pathlib.Path) -> None:
    """Says in one line that a file cannot be used."""
    print(f"biotac_mj: {path} is damaged, what it held is computed again", file=sys.stderr)


def replace_file(path: pathlib.Path, write: Callable[[BinaryIO], object]) -> bool:
    """Writes a file all at once; False where that is not possible."""
    try:
        with replacing(path) as temporary, open(temporary, "wb") as file:
            write(file)
    except OSError:
        return False
    return True
