"""What a unit force at a node of the skin's surface does everywhere: rows of the inverse of the rest
stiffness, kept on disk.

A contact coordinate is one of the three directions of a free outer node, or the direction away from the core
of an inner node (the liquid lubricates the core, so there is no friction there and one direction is enough).
Rows are rounded to half precision (5e-4 of the row's largest entry at most) and belong to Young's modulus
one, so that one file serves all moduli: 120 MB for the default skin."""

import hashlib
import os
import pathlib
import sys
import tempfile

import numpy as np

__all__ = ["SurfaceCompliance", "cache_folder"]

_LARGEST_FILE = 400e6  # rows of a finer skin are computed when they are first needed [bytes]
_BATCH = 60  # right-hand sides solved together


def cache_folder() -> pathlib.Path:
    """Where rows are kept: $BIOTAC_CACHE, or biotac_mj in the user's cache folder."""
    if os.environ.get("BIOTAC_CACHE"):
        return pathlib.Path(os.environ["BIOTAC_CACHE"])
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA", pathlib.Path.home() / "AppData/Local")
    elif sys.platform == "darwin":
        base = pathlib.Path.home() / "Library/Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(base) / "biotac_mj"


class SurfaceCompliance:
    """Rows of the inverse rest stiffness for contact coordinates.

    Args:
      model: SkinModel on the CPU. factor, stiffness: operator and sparse matrix over its free nodes, at rest.
      outer: (nouter,) free outer nodes; node i has the coordinates 3 i .. 3 i + 2.
      inner: (ninner,) free inner nodes; node j has the coordinate 3 nouter + j.
      direction: (ninner, 3) of the inner nodes' forces, unit vectors.
      cache: whether to keep the rows on disk.

    Attributes:
      size: coordinates of the free nodes, the length of a row.
      count: contact coordinates.
    """

    def __init__(self, model, factor, stiffness, outer, inner, direction, cache=True):
        self._factor, self._stiffness = factor, stiffness
        self._model, self._outer, self._inner, self._direction = model, outer, inner, direction
        self.size, self.count = 3 * len(model.free), 3 * len(outer) + len(inner)
        self._position = np.full(model.nvert, -1)
        self._position[model.free] = np.arange(len(model.free))
        self._scale = 1 / model.material.youngs_modulus
        self._kept = {}
        self._file = self._open() if cache and 2 * self.count * self.size <= _LARGEST_FILE else None

    def row(self, coordinates) -> list:
        """For each contact coordinate (n,) its row (size,) float32: displacement of the free nodes per unit
        force [m/N], times E."""
        missing = [c for c in coordinates if c not in self._kept]
        if missing and self._file is not None:
            largest, rows = self._file
            for c in missing:
                self._kept[c] = rows[c].astype(np.float32) * largest[c]
        elif missing:
            for block in {self._block(c) for c in missing}:
                for c, row, largest in zip(block, *self._compute(np.array(block))):
                    self._kept[c] = row.astype(np.float32) * largest
        return [self._kept[c] for c in coordinates]

    def part(self, coordinates, at) -> np.ndarray:
        """What `row` has at the places `at` (k,): (n, k) float32; cheaper than the whole rows."""
        if self._file is None:
            return np.array([row[at] for row in self.row(coordinates.tolist())]).reshape(
                len(coordinates), len(at)
            )
        largest, rows = self._file
        return rows[coordinates[:, None], at].astype(np.float32) * largest[coordinates, None]

    def _block(self, c):
        """Coordinates that are computed together with c: the three of an outer node."""
        return (c,) if c >= 3 * len(self._outer) else (c - c % 3, c - c % 3 + 1, c - c % 3 + 2)

    def vector(self, field) -> np.ndarray:
        """Inverse stiffness times nodal forces (nvert, 3): (size,) [m/N], times E; refined once, as the
        factor is rounded."""
        free = self._model.free
        first = self._factor.solve(field[:, None])
        left = field.copy()
        left[free] -= (self._stiffness @ first[free, 0].ravel()).reshape(-1, 3)
        return (first + self._factor.solve(left[:, None]))[free, 0].ravel() / self._scale

    def _compute(self, coordinates):
        n = len(self._outer)
        force = np.zeros((self._model.nvert, len(coordinates), 3))
        column = np.arange(len(coordinates))
        outer = coordinates < 3 * n
        force[self._outer[coordinates[outer] // 3], column[outer], coordinates[outer] % 3] = 1
        j = coordinates[~outer] - 3 * n
        force[self._inner[j], column[~outer]] = self._direction[j]
        rows = self._factor.solve(force)[self._model.free] / self._scale
        rows = np.ascontiguousarray(np.moveaxis(rows, 1, 0)).reshape(len(coordinates), self.size)
        largest = np.abs(rows).max(1).astype(np.float32)
        return (rows / largest[:, None]).astype(np.float16), largest

    def position(self, node) -> np.ndarray:
        """Index of free nodes (n,) in a row reshaped to (nfree, 3)."""
        return self._position[node]

    def _open(self):
        """(scales, rows) mapped from the cache, written there first if need be; None where nothing can be
        written."""
        path = cache_folder() / f"compliance-{self._digest()}.npy"
        shape = (self.count, self.size + 2)  # two halves in front hold the row's scale
        if not path.is_file() and not self._write(path, shape):
            return None
        table = np.load(path, mmap_mode="r")
        if table.shape != shape:
            raise ValueError(
                f"{path} does not hold the compliance of this skin: delete it, it is computed again"
            )
        return np.ascontiguousarray(table[:, :2]).view(np.float32)[:, 0], table[:, 2:]

    def _write(self, path, shape):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".npy")
        except OSError:
            return False
        os.close(handle)
        try:
            table = np.lib.format.open_memmap(temporary, mode="w+", dtype=np.float16, shape=shape)
            for start in range(0, self.count, _BATCH):
                chosen = np.arange(start, min(start + _BATCH, self.count))
                rows, largest = self._compute(chosen)
                table[chosen, 2:], table[chosen, :2] = rows, largest[:, None].view(np.float16)
            table.flush()
            del table
            os.replace(temporary, path)
        except OSError:
            os.unlink(temporary)
            return False
        except BaseException:
            os.unlink(temporary)
            raise
        return True

    def _digest(self):
        stiffness = self._stiffness
        # rounded, so that the modulus divided out leaves no trace in the last digits
        content = [
            (stiffness.data * self._scale).astype(np.float32),
            stiffness.indices,
            stiffness.indptr,
            self._model.free,
        ]
        content += [self._outer, self._inner, self._direction.astype(np.float32)]
        digest = hashlib.sha256(b"1")
        for array in content:
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:24]
