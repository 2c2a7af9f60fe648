"""Fixed points of a design's skin, at which networks read the displacements of any mesh.

The points are nodes of a reference skin, chosen by geodesic farthest-point sampling. A mesh's displacements
are interpolated to them by the shape functions of its tetrahedra, and from them to its nodes through the
reference skin."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from ...geometry.skin_geometry import SkinGeometry
from .hierarchy import Level, build_hierarchy

SAME_SHAPE = (
    0.5e-3  # [m] half the thickness of the skin: at a larger distance the points belong to another skin
)


def shape_values(vert: np.ndarray, tets: np.ndarray, target: np.ndarray) -> csr_matrix:
    """(n, nvert) CSR: values of a nodal field at targets (n, 3), by the shape functions of the tetrahedra
    (nelem, 4); for targets outside of them by clipped ones of a near tetrahedron."""
    corner = vert[tets]
    inverse = np.linalg.inv(np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2))
    candidates = cKDTree(corner.mean(1)).query(target, min(24, len(tets)))[1]  # (n, k)
    b = np.einsum("nkab,nkb->nka", inverse[candidates], target[:, None] - corner[candidates, 0])
    b = np.concatenate([1 - b.sum(2, keepdims=True), b], 2)
    best = np.argmax(b.min(2), axis=1)
    chosen = np.clip(b[np.arange(len(b)), best], 0, None)
    chosen /= chosen.sum(1, keepdims=True)
    node = tets[candidates[np.arange(len(b)), best]]
    rows = np.repeat(np.arange(len(target)), 4)
    return coo_matrix((chosen.ravel(), (rows, node.ravel())), shape=(len(target), len(vert))).tocsr()


@dataclasses.dataclass(frozen=True)
class SkinPoints:
    """Points, their graph, and the interpolation to and from them.

    Attributes:
      place: (n, 3) at rest [m].
      levels: of `build_hierarchy`; the finest is the graph of the points.
      spread: (nvert of the reference skin, n) CSR, values at its nodes from those at the points.
      reference: name of that skin.
    """

    place: np.ndarray
    levels: list[Level]
    spread: csr_matrix
    reference: str = "coarse"

    @classmethod
    def choose(cls, count: int, factors: Sequence[float], reference: str = "coarse") -> "SkinPoints":
        """Samples `count` nodes of a reference skin; factors: of `build_hierarchy` from the points on."""
        from ...geometry import load_skin

        skin = load_skin(reference)
        whole, *levels = build_hierarchy(skin.vert, skin.tets, (skin.nvert / count, *factors))
        return cls(skin.vert[whole.keep], levels, whole.up, reference)

    def reading(self, geometry: SkinGeometry) -> csr_matrix:
        """Sparse matrix (n, nvert) that interpolates a field on the nodes of a skin at the points.

        Raises:
          ValueError: the points are not in that skin.
        """
        out = shape_values(geometry.vert, geometry.tets, self.place)
        off = np.linalg.norm(out @ geometry.vert - self.place, axis=1)
        if np.mean(off > SAME_SHAPE) > 0.02:
            raise ValueError(
                f"skin {geometry.name!r} has not the shape of the network's, {self.reference!r}, in the "
                f"BioTac frame: {np.mean(off > SAME_SHAPE):.0%} of the network's points lie over "
                f"{1e3 * SAME_SHAPE:g} mm beside it; take that skin, or another of its design"
            )
        return out

    def spreading(self, geometry: SkinGeometry) -> csr_matrix:
        """(nvert, n) CSR: interpolation from the points to the nodes of a skin."""
        from ...geometry import load_skin

        skin = load_skin(self.reference)
        return csr_matrix(shape_values(skin.vert, skin.tets, geometry.vert) @ self.spread)

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays for a file of weights, inverse of `of_arrays`."""
        out = {"place": self.place, **_csr_arrays("spread", self.spread)}
        for k, level in enumerate(self.levels):
            out |= _csr_arrays(f"laplacian{k}", level.laplacian)
            if level.keep is not None:
                out |= {f"keep{k}": level.keep, **_csr_arrays(f"up{k}", level.up)}
        return out

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray], reference: str) -> "SkinPoints":
        """The points that `arrays` describe."""
        levels = []
        while f"laplacian{len(levels)}.shape" in arrays:
            k, keep, up = len(levels), None, None
            if f"keep{k}" in arrays:
                keep, up = arrays[f"keep{k}"].astype(int), _csr_from(arrays, f"up{k}")
            levels.append(Level(_csr_from(arrays, f"laplacian{k}"), keep, up))
        return cls(arrays["place"], levels, _csr_from(arrays, "spread"), reference)


def _csr_arrays(name, matrix):
    matrix = csr_matrix(matrix)
    parts = {"shape": np.array(matrix.shape), "crow": matrix.indptr, "col": matrix.indices}
    return {f"{name}.{part}": value for part, value in (parts | {"value": matrix.data}).items()}


def _csr_from(arrays, name):
    crow, col, shape = (arrays[f"{name}.{part}"].astype(int) for part in ("crow", "col", "shape"))
    return csr_matrix((arrays[f"{name}.value"], col, crow), shape=tuple(shape))
