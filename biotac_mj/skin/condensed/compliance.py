"""What a unit force at a node of the skin's surface does everywhere: rows of the inverse of the rest
stiffness, kept on disk.

A contact coordinate is one of the three directions of a free outer node, or the direction away from the core
of an inner node (the liquid lubricates the core, so there is no friction there and one direction is enough).
Rows are rounded to half precision (5e-4 of the row's largest entry at most) and belong to Young's modulus
one, so that one file serves all moduli: 110 MB for the default skin.

The file's name is a digest of the stiffness. Which one that is for a model is kept too, so that the stiffness
is made, and its factor, only where something is not in the cache."""

import functools
import hashlib
import pathlib
import typing
import zlib

import numpy as np
import scipy.sparse as sp

from ...threads import single_thread
from ..cache import cache_folder, kept, replace_file, report_damage, touch
from .rest_tangent import rest_tangent

if typing.TYPE_CHECKING:
    from ..model import SkinModel

__all__ = ["SurfaceCompliance"]

_LARGEST_FILE = 400e6  # rows of a finer skin are computed when they are first needed [bytes]
_BATCH = 60  # right-hand sides solved together
_FORMAT = b"2"  # rows float16, scales float32, checksums uint32 of the rows and one of these two


class _Rows:
    """Rows of a file, mapped; each is compared with its checksum when it is first used.

    Raises:
      OSError: the file cannot be read. ValueError: it is damaged.
    """

    def __init__(self, path: pathlib.Path, count: int, size: int):
        begin = 2 * count * size
        with open(path, "rb") as file:
            file.seek(begin)
            end = file.read()
        scales = end[: 8 * count]
        if len(end) != 8 * count + 4 or end[8 * count :] != _checksum(scales):
            raise ValueError("not as long as it should be, or another checksum")
        self._largest = np.frombuffer(scales, np.float32, count)
        self._sum = np.frombuffer(scales, np.uint32, offset=4 * count)
        self._rows = np.asarray(np.memmap(path, np.float16, "r", shape=(count, size)))  # indexing is faster
        self._sound = np.zeros(count, bool)

    def check(self, coordinates: np.ndarray) -> bool:
        """Whether the rows of coordinates (n,) are what was written."""
        for c in coordinates[~self._sound[coordinates]].tolist():
            if zlib.crc32(self._rows[c]) != self._sum[c]:
                return False
            self._sound[c] = True
        return True

    def row(self, c: int) -> np.ndarray:
        """(size,) float32."""
        return self._rows[c].astype(np.float32) * self._largest[c]

    def part(self, coordinates: np.ndarray, at: np.ndarray) -> np.ndarray:
        """(n, k) float32 of the rows (n,) at places (k,)."""
        return self._rows[coordinates[:, None], at].astype(np.float32) * self._largest[coordinates, None]


def _checksum(content) -> bytes:
    return zlib.crc32(content).to_bytes(4, "little")


class SurfaceCompliance:
    """Rows of the inverse rest stiffness for contact coordinates.

    Args:
      model: SkinModel on the CPU.
      outer: (nouter,) free outer nodes; node i has the coordinates 3 i .. 3 i + 2.
      inner: (ninner,) free inner nodes; node j has the coordinate 3 nouter + j.
      direction: (ninner, 3) of the inner nodes' forces, unit vectors.
      cache: whether to keep the rows on disk.

    Attributes:
      size: coordinates of the free nodes, the length of a row.
      count: contact coordinates.
    """

    def __init__(
        self,
        model: "SkinModel",
        outer: np.ndarray,
        inner: np.ndarray,
        direction: np.ndarray,
        cache: bool = True,
    ):
        self._model, self._outer, self._inner, self._direction = model, outer, inner, direction
        self.size, self.count = 3 * len(model.free), 3 * len(outer) + len(inner)
        self._position = np.full(model.nvert, -1)
        self._position[model.free] = np.arange(len(model.free))
        self._scale = 1 / model.material.youngs_modulus
        self._kept = {}
        self._cache = cache
        self._file = self._open() if cache and 2 * self.count * self.size <= _LARGEST_FILE else None

    @functools.cached_property
    def stiffness(self) -> sp.csc_matrix:
        """Over the free coordinates, where the skin rests on its filling [N/m]."""
        with single_thread():
            return rest_tangent(self._model) if self._model.rest.pressure else self._model.stiffness

    @functools.cached_property
    def _factor(self):
        model = self._model
        with single_thread():
            return model.factor_of(self.stiffness) if model.rest.pressure else model.factor

    def row(self, coordinates: list) -> list:
        """For each contact coordinate (n,) its row (size,) float32: displacement of the free nodes per unit
        force [m/N], times E."""
        missing = [c for c in coordinates if c not in self._kept]
        if missing and self._readable(np.array(missing)):
            for c in missing:
                self._kept[c] = self._file.row(c)
        elif missing:
            for block in {self._block(c) for c in missing}:
                for c, row, largest in zip(block, *self._compute(np.array(block))):
                    self._kept[c] = row.astype(np.float32) * largest
        return [self._kept[c] for c in coordinates]

    def part(self, coordinates: np.ndarray, at: np.ndarray) -> np.ndarray:
        """What `row` has at the places `at` (k,): (n, k) float32; cheaper than the whole rows."""
        if self._readable(coordinates):
            return self._file.part(coordinates, at)
        return np.array([row[at] for row in self.row(coordinates.tolist())]).reshape(
            len(coordinates), len(at)
        )

    def _readable(self, coordinates):
        """Whether rows (n,) are in the file; one that is damaged is written anew."""
        if self._file is not None and not self._file.check(coordinates):
            self._file = None
            report_damage(self._path)
            if self._write(self._path):
                self._file = self._read(self._path)
        return self._file is not None

    def _block(self, c):
        """Coordinates that are computed together with c: the three of an outer node."""
        return (c,) if c >= 3 * len(self._outer) else (c - c % 3, c - c % 3 + 1, c - c % 3 + 2)

    def vector(self, field: np.ndarray) -> np.ndarray:
        """Inverse stiffness times nodal forces (nvert, 3): (size,) [m/N], times E; refined once, as the
        factor is rounded. Kept on disk."""

        def make():
            free = self._model.free
            first = self._factor.solve(field[:, None])
            left = field.copy()
            left[free] -= (self.stiffness @ first[free, 0].ravel()).reshape(-1, 3)
            return {"vector": (first + self._factor.solve(left[:, None]))[free, 0].ravel() / self._scale}

        made = kept("vector", [*self._inputs(), field], make) if self._cache else make()
        return made["vector"]

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

    def position(self, node: np.ndarray) -> np.ndarray:
        """Index of free nodes (n,) in a row reshaped to (nfree, 3)."""
        return self._position[node]

    # --- the file  ---

    def _open(self):
        """Rows mapped from the cache, written there first if need be; None where nothing can be written."""
        path = self._path
        return self._read(path) or (self._read(path) if self._write(path) else None)

    def _read(self, path):
        try:
            rows = _Rows(path, self.count, self.size)
            touch(path)
            return rows
        except OSError:  # not there, or not to be read
            return None
        except ValueError:
            report_damage(path)
            return None

    def _write(self, path):
        def write(file):
            ends = [], []
            for start in range(0, self.count, _BATCH):
                rows, largest = self._compute(np.arange(start, min(start + _BATCH, self.count)))
                file.write(rows)
                ends[0].append(largest)
                ends[1].append(np.array([zlib.crc32(row) for row in rows], np.uint32))
            scales = b"".join(part.tobytes() for end in ends for part in end)
            file.write(scales + _checksum(scales))

        self._factor  # noqa: B018 - before there is a file
        return replace_file(path, write)

    @functools.cached_property
    def _path(self):
        def make():
            return {"stiffness": np.array(self._digest())}

        return cache_folder() / f"compliance-{kept('stiffness', self._inputs(), make)['stiffness']}.rows"

    def _inputs(self):
        """All that the stiffness and the coordinates depend on."""
        model, m = self._model, self._model.material
        mesh = [model.geometry.vert, model._elem, model.geometry.inner_face, model.free, model.element]
        rest = [model.rest.vert, model.rest.pressure, model.has_liquid] if model.rest.pressure else []
        law = [m.law, m.youngs_modulus, m.poissons_ratio]
        law += [] if model.modulus is None else [model.modulus]
        return [*mesh, *law, *rest, self._outer, self._inner, self._direction]

    def _digest(self):
        stiffness = self.stiffness
        # rounded, so that the modulus divided out leaves no trace in the last digits
        content = [
            (stiffness.data * self._scale).astype(np.float32),
            stiffness.indices,
            stiffness.indptr,
            self._model.free,
        ]
        content += [self._outer, self._inner, self._direction.astype(np.float32)]
        digest = hashlib.sha256(_FORMAT)
        for array in content:
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:24]
