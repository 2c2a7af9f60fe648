"""Cache on disk: arrays, found by a digest of all inputs.

A file is written to a temporary name and then renamed, so that no incomplete file is seen. It ends with a
digest of its key and all its bytes: a file that is damaged, or another one, is made again. Without a writable
folder the arrays are computed each time. The size of the folder is limited, since every material has its own
files, up to 200 MB, and a data set has thousands of materials; the least recently used files are deleted."""

import contextlib
import dataclasses
import functools
import hashlib
import io
import os
import pathlib
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import BinaryIO

import numpy as np
import platformdirs

from .files import replacing

_FORMAT = "2"  # of keys and files
_LETTERS = 24  # letters of a digest
_SKIN = ("geometry", "skin")  # folders whose code makes most arrays
_LARGEST = 4  # default limit of the folder, see BIOTAC_CACHE_GB [GB]
_PACKAGE = pathlib.Path(__file__).parent
_PATIENCE = 5.0  # [s] before a note says what takes so long
_LONG = {
    "grid": "computing the distances around a mesh",
    "spline": "interpolating the distances around a mesh",
    "core": "finding where the skin may meet the core",
    "rest": "filling the skin",
    "rests": "filling the skins",
    "modes": "computing the skin's modes",
    "film": "laying out the film of liquid",
    "stiffness": "computing the stiffness of the condensed skin",
    "vector": "computing forces of the condensed skin",
}


def cache_folder() -> pathlib.Path:
    """$BIOTAC_CACHE, or biotac_mj in the user's cache folder."""
    given = os.environ.get("BIOTAC_CACHE")
    return pathlib.Path(given) if given else platformdirs.user_cache_path("biotac_mj", appauthor=False)


def digest(*content: object) -> str:
    """Digest of arrays (with type and shape), bytes, texts, numbers, and of dataclasses, dicts and lists of
    these.

    Raises:
      TypeError: any other type.
    """
    found = hashlib.sha256(_FORMAT.encode())
    _add(found, content)
    return found.hexdigest()[:_LETTERS]


def _add(found, item):
    """Adds an item to a digest, after its kind and size, so that different lists of items have different
    bytes."""
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
    """Digest of folders and modules of this package, so that arrays of other code are not used."""
    files = [
        file
        for name in names
        for file in (sorted((_PACKAGE / name).rglob("*.py")) or [_PACKAGE / f"{name}.py"])
    ]
    return digest([(file.relative_to(_PACKAGE).as_posix(), file.read_bytes()) for file in files])


def key_of(kind: str, inputs: Iterable, code: Iterable[str] = _SKIN) -> str:
    """The key of a result.

    Args:
      kind: of the result.
      inputs: everything that it depends on, as for `digest`; a skin's geometry as the whole SkinGeometry.
      code: folders and modules of the package that compute it.
    """
    return digest(kind, _code(tuple(code)), list(inputs))


class Entry:
    """A file of arrays in the cache.

    Args:
      kind: start of the file's name. inputs, code: see `key_of`.
      folder: another folder, without a limit of its size.
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
        """The arrays, or None if the file is missing or damaged."""
        try:
            whole = self.path.read_bytes()
            if self._seal(np.frombuffer(whole, np.uint8)[:-_LETTERS]) != whole[-_LETTERS:]:
                return None
            with np.load(io.BytesIO(whole), allow_pickle=False) as file:
                found = dict(file)
        except Exception:  # whatever it is: the arrays can be made again
            return None
        touch(self.path)
        return found

    def save(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Writes the arrays, if the folder is writable."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        buffer.write(self._seal(np.frombuffer(buffer.getvalue(), np.uint8)))
        replace_file(self.path, lambda file: file.write(buffer.getbuffer()), self._bounded)

    def _seal(self, content):
        """The end of a file. The archive's own checksums do not cover which arrays it has."""
        return digest(self._key, content).encode()


def cached(
    kind: str,
    inputs: Iterable,
    make: Callable[[], dict[str, np.ndarray]],
    code: Iterable[str] = _SKIN,
) -> dict[str, np.ndarray]:
    """The arrays that `make` returns for the inputs, from disk if they exist; see `Entry`."""
    entry = Entry(kind, inputs, code)
    found = entry.load()
    if found is None:
        with _announced(kind):
            found = make()
        entry.save(found)
    return found


@contextlib.contextmanager
def _announced(kind):
    """Says on standard error what is made, if it takes long."""
    text = f"biotac_mj: {_LONG.get(kind)}, once on this machine: it is read from disk afterwards"
    timer = threading.Timer(_PATIENCE, print, [text], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    if kind in _LONG:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def touch(path: pathlib.Path) -> None:
    """Sets the time of a file's last use."""
    with contextlib.suppress(OSError):
        os.utime(path)


def _limit() -> float:
    """Limit of the folder's size [bytes]."""
    given = os.environ.get("BIOTAC_CACHE_GB") or _LARGEST
    try:
        found = float(given) * 1e9
    except ValueError:
        found = -1.0
    if not found >= 0:
        raise ValueError(f"BIOTAC_CACHE_GB must be a number of gigabytes of 0 or more, not {given!r}")
    return found


def _prune(newest: pathlib.Path) -> None:
    """Deletes the least recently used files until the folder is within its limit, but not the newest file. A
    file that a process has mapped exists until that process ends (on Windows it cannot be deleted)."""
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
