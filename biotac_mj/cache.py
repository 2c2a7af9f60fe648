"""What is kept between processes: arrays on disk, found by a digest of everything that they were made of.

A file is written under a temporary name and then renamed, so that none is ever seen half written. A damaged
file is made again and replaced. A folder that cannot be written costs time and nothing else. The folder has a
bound: every material has its own files, 200 MB where its compliance is kept, and a set of data draws
thousands, so the files that were not used for longest are deleted."""

import contextlib
import dataclasses
import functools
import hashlib
import io
import os
import pathlib
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from typing import BinaryIO

import numpy as np
import platformdirs

from .files import replacing

__all__ = ["Entry", "cache_folder", "cached", "digest", "key_of", "replace_file", "touch"]

_FORMAT = "2"  # of keys and files
_SKIN = ("geometry", "skin")  # the code of which most of it is made
_LARGEST = 4  # of the whole folder unless BIOTAC_CACHE_GB says otherwise [GB]
_PACKAGE = pathlib.Path(__file__).parent


def cache_folder() -> pathlib.Path:
    """$BIOTAC_CACHE, or biotac_mj in the user's cache folder."""
    given = os.environ.get("BIOTAC_CACHE")
    return pathlib.Path(given) if given else platformdirs.user_cache_path("biotac_mj", appauthor=False)


def digest(*content: object) -> str:
    """Of arrays (with type and shape), bytes, texts, numbers, and of dataclasses, dicts and lists of these.

    Raises:
      TypeError: anything else, whose bytes are not known.
    """
    found = hashlib.sha256(_FORMAT.encode())
    _add(found, content)
    return found.hexdigest()[:24]


def _add(found, item):
    """Each item begins with its kind and size, so that no two lists of items are the same bytes."""
    if isinstance(item, np.generic):
        item = item.item()
    parts = ()
    if isinstance(item, np.ndarray) and not item.dtype.hasobject:
        kind, content = f"{item.dtype.str}{item.shape}", np.ascontiguousarray(item).data
    elif isinstance(item, bytes):
        kind, content = f"bytes {len(item)}", item
    elif item is None or isinstance(item, (bool, int, float, complex, str, os.PathLike)):
        content = repr(item).encode()
        kind = f"plain {len(content)}"
    elif dataclasses.is_dataclass(item) and not isinstance(item, type):
        parts = [part for f in dataclasses.fields(item) for part in (f.name, getattr(item, f.name))]
        kind, content = f"{type(item).__qualname__} {len(parts)}", b""
    elif isinstance(item, Mapping):
        parts = [part for name in sorted(item, key=repr) for part in (name, item[name])]
        kind, content = f"dict {len(parts)}", b""
    elif isinstance(item, (list, tuple)):
        kind, content, parts = f"list {len(item)}", b"", item
    else:
        raise TypeError(f"a {type(item).__name__} cannot be a part of a cache's key: give its arrays")
    found.update(f"{kind};".encode())
    found.update(content)
    for part in parts:
        _add(found, part)


@functools.cache
def _code(names):
    """Digest of folders and modules of this package: what other code has made is not taken from the cache."""
    files = [
        file
        for name in names
        for file in (sorted((_PACKAGE / name).rglob("*.py")) or [_PACKAGE / f"{name}.py"])
    ]
    return digest([(file.relative_to(_PACKAGE).as_posix(), file.read_bytes()) for file in files])


def key_of(kind: str, inputs: Iterable, code: Iterable[str] = _SKIN) -> str:
    """The key of a result.

    Args:
      kind: what it is.
      inputs: everything that it depends on, as for `digest`: where a skin's geometry goes in, the whole
        SkinGeometry.
      code: folders and modules of the package that make it.
    """
    return digest(kind, _code(tuple(code)), list(inputs))


class Entry:
    """The place of some arrays in the cache.

    Args:
      kind: the beginning of the file's name. inputs, code: see `key_of`.
      folder: in place of the cache's, of a size that has no bound.
    """

    def __init__(
        self,
        kind: str,
        inputs: Iterable,
        code: Iterable[str] = _SKIN,
        folder: pathlib.Path | str | None = None,
    ):
        self._key = key_of(kind, inputs, code)
        self._bounded = folder is None
        self.path = (cache_folder() if folder is None else pathlib.Path(folder)) / f"{kind}-{self._key}.npz"

    def load(self) -> dict[str, np.ndarray] | None:
        """The arrays, or None where they are not there or damaged."""
        try:
            with np.load(self.path, allow_pickle=False) as file:  # the archive has a checksum of each array
                found = dict(file)
            if str(found.pop("key")) != self._key:
                return None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError):
            return None
        touch(self.path)
        return found

    def save(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Writes them, where that is possible."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, key=np.array(self._key), **arrays)
        replace_file(self.path, lambda file: file.write(buffer.getbuffer()), self._bounded)


def cached(
    kind: str,
    inputs: Iterable,
    make: Callable[[], dict[str, np.ndarray]],
    code: Iterable[str] = _SKIN,
) -> dict[str, np.ndarray]:
    """The arrays that `make` makes of the inputs, from disk where they have been made before; see `Entry`."""
    entry = Entry(kind, inputs, code)
    found = entry.load()
    if found is None:
        found = make()
        entry.save(found)
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
            if file.suffix in (".npz", ".rows") and file != newest:
                files.append((state.st_mtime, state.st_size, file))
    room = _limit() - newest.stat().st_size
    for _, size, file in sorted(files, reverse=True):
        room -= size
        if room < 0:
            with contextlib.suppress(OSError):
                file.unlink()


def replace_file(path: pathlib.Path, write: Callable[[BinaryIO], object], bounded: bool = True) -> bool:
    """Writes a file of the cache all at once; False where that is not possible. bounded: whether old files
    beside it are deleted.

    Raises:
      ValueError: BIOTAC_CACHE_GB is no size.
    """
    try:
        with replacing(path) as temporary, open(temporary, "wb") as file:
            write(file)
        if bounded:
            _prune(path)
    except OSError:
        return False
    return True
