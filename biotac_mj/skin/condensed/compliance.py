"""Displacements of the skin by unit forces at its surface: rows of the inverse stiffness, cached on disk.

A contact coordinate is one of the three directions of a free outer node, or the direction away from the core
of an inner node (there is no friction on the core, so that one direction suffices). Rows are in half
precision (with an error of at most 5e-4 of the row's largest entry) and for a Young's modulus of one, so that
one file is
valid for all moduli: 196 MB for the default skin, with the compliance between contact coordinates.

The name of the file is a digest of the stiffness. The digest of a model's stiffness is cached as well, so
that stiffness and factor are computed only if a file is missing."""

import functools
import pathlib
import typing
import zlib

import numpy as np
import scipy.sparse as sp

from ...cache import cache_folder, cached, digest, replace_file, touch
from ...threads import single_thread
from .rest_tangent import rest_tangent

if typing.TYPE_CHECKING:
    from ..model import SkinModel

_LARGEST_FILE = 2e9  # rows of a finer skin are computed in each process [bytes]
_BATCH = 60  # right-hand sides solved together
_FORMAT = "3"  # `between` float32, scales float32, rows float16, and a checksum uint32 of all that


class _Matrices(typing.NamedTuple):
    """Compliances of `count` contact coordinates: among each other, and over all `size` coordinates."""

    between: np.ndarray
    largest: np.ndarray
    rows: np.ndarray


def _read(path: pathlib.Path, count: int, size: int) -> _Matrices:
    """Maps the arrays from a file, whose memory processes share.

    Raises:
      OSError: the file cannot be read. ValueError: it is damaged.
    """
    ends = np.cumsum([4 * count * count, 4 * count, 2 * count * size, 4])
    if path.stat().st_size != ends[-1]:
        raise ValueError("not as long as it should be")
    content = np.asarray(np.memmap(path, np.uint8, "c"))  # "c": Warp takes no array that is read only
    between, largest, rows, checksum = np.split(content, ends[:-1])
    if zlib.crc32(content[: ends[-2]]) != checksum.view(np.uint32)[0]:
        raise ValueError("another checksum")
    return _Matrices(
        between.view(np.float32).reshape(count, count),
        largest.view(np.float32),
        rows.view(np.float16).reshape(count, size),
    )


class SurfaceCompliance:
    """Rows of the inverse stiffness for contact coordinates.

    Args:
      model: SkinModel on the CPU.
      outer: (nouter,) free outer nodes; node i has the coordinates 3 i .. 3 i + 2.
      inner: (ninner,) free inner nodes; node j has the coordinate 3 nouter + j.
      direction: (ninner, 3) of the inner nodes' forces, unit vectors.
      cache: whether to cache the rows on disk.

    Attributes:
      size: coordinates of the free nodes, the length of a row. position: (nvert,) of nodes in it, -1: fixed.
      count: contact coordinates.
      rows: (count, size) float16, displacement of the free nodes per unit force along each contact coordinate
        [m/N], times E, over its largest entry: largest (count,) float32.
      between: (count, count) float32, displacement of contact coordinates per unit force along others; the
        mean of both orders, since rows are rounded separately.
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
        self.position = np.full(model.nvert, -1)
        self.position[model.free] = np.arange(len(model.free))
        self._scale = 1 / model.material.youngs_modulus
        self._cache = cache
        small = 2 * self.count * (self.size + 2 * self.count) <= _LARGEST_FILE
        self.between, self.largest, self.rows = self._open() if cache and small else self._make()

    @functools.cached_property
    def stiffness(self) -> sp.csc_matrix:
        """Stiffness over the free coordinates, of the filled skin without contact [N/m]."""
        with single_thread():
            return rest_tangent(self._model) if self._model.rest.pressure else self._model.stiffness

    @functools.cached_property
    def _factor(self):
        model = self._model
        with single_thread():
            return model.factor_of(self.stiffness) if model.rest.pressure else model.factor

    def vector(self, field: np.ndarray) -> np.ndarray:
        """Inverse stiffness times nodal forces (nvert, 3): (size,) [m/N], times E. Refined once, since the
        factor is rounded; cached on disk."""

        def make():
            free = self._model.free
            first = self._factor.solve(field[:, None])
            left = field.copy()
            left[free] -= (self.stiffness @ first[free, 0].ravel()).reshape(-1, 3)
            return {"vector": (first + self._factor.solve(left[:, None]))[free, 0].ravel() / self._scale}

        made = cached("vector", [*self._inputs(), field], make) if self._cache else make()
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

    def _make(self):
        made = _Matrices(
            np.empty((self.count, self.count), np.float32),
            np.empty(self.count, np.float32),
            np.empty((self.count, self.size), np.float16),
        )
        outer = (3 * self.position[self._outer][:, None] + np.arange(3)).ravel()
        inner = 3 * self.position[self._inner][:, None] + np.arange(3)
        for start in range(0, self.count, _BATCH):
            batch = np.arange(start, min(start + _BATCH, self.count))
            made.rows[batch], made.largest[batch] = self._compute(batch)
            rows = made.rows[batch].astype(np.float32) * made.largest[batch, None]
            along = np.einsum("kna,na->kn", rows[:, inner], self._direction)
            made.between[batch] = np.concatenate([rows[:, outer], along], axis=1)
        for start in range(0, self.count, _BATCH):  # in place
            end = start + _BATCH
            mean = (made.between[start:end, start:] + made.between[start:, start:end].T) / 2
            made.between[start:end, start:], made.between[start:, start:end] = mean, mean.T
        return made

    # --- the file  ---

    def _open(self):
        """The cached matrices, computed if necessary."""
        path = self._path
        try:
            found = _read(path, self.count, self.size)
            touch(path)
            return found
        except (OSError, ValueError):  # missing, unreadable or damaged
            pass
        made = self._make()

        def write(file):
            parts, total = [part.reshape(-1).view(np.uint8) for part in made], 0
            for part in parts:
                file.write(part)
                total = zlib.crc32(part, total)
            file.write(total.to_bytes(4, "little"))

        if not replace_file(path, write):
            return made
        try:
            return _read(path, self.count, self.size)
        except (OSError, ValueError):  # another process has replaced it
            return made

    @functools.cached_property
    def _path(self):
        def make():
            return {"stiffness": np.array(self._digest())}

        return cache_folder() / f"compliance-{cached('stiffness', self._inputs(), make)['stiffness']}.rows"

    def _inputs(self):
        """All inputs of the stiffness and the coordinates."""
        model, m = self._model, self._model.material
        mesh = [model.geometry, model._elem, model.free, model.element]
        rest = [model.rest.vert, model.rest.pressure, model.has_liquid] if model.rest.pressure else []
        law = [m.law, m.youngs_modulus, m.poissons_ratio]
        law += [] if model.modulus is None else [model.modulus]
        return [*mesh, *law, *rest, self._outer, self._inner, self._direction]

    def _digest(self):
        stiffness = self.stiffness
        # rounded, so that division by the modulus does not change the digest
        content = [
            (stiffness.data * self._scale).astype(np.float32),
            stiffness.indices,
            stiffness.indptr,
            self._model.free,
        ]
        content += [self._outer, self._inner, self._direction.astype(np.float32)]
        return digest(_FORMAT, content)
