"""Tetrahedral meshes: volumes, angles, boundary, and checks whether they can be simulated."""

import dataclasses
import functools

import numpy as np

# Faces of a tetrahedron with positive volume, ordered so that their normals point out of it; face i is
# opposite to vertex i.
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
_FACE_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
# volume over longest edge^3 (0.118 for a regular one) below which a tetrahedron is flat within the rounding
# of files
_DEGENERATE = 1e-6
_INT32 = np.iinfo(np.int32).min, np.iinfo(np.int32).max


def indices(name: str, numbers: np.ndarray) -> np.ndarray:
    """Converts numbers to int32 indices; a cast alone would wrap large numbers.

    Args:
      name: of the array, for messages.

    Raises:
      ValueError: a number is not an index.
    """
    out = np.ascontiguousarray(np.clip(np.nan_to_num(numbers), *_INT32), np.int32)
    if not np.array_equal(out, numbers):
        wrong = np.asarray(numbers)[out != numbers].flat[0]
        raise ValueError(f"{name} has {wrong}, which is no index: import the mesh again")
    return out


@dataclasses.dataclass(frozen=True)
class TetMesh:
    """Tetrahedra over nodes.

    Attributes:
      vert: (nvert, 3) float64 [m].
      elem: (nelem, 4) int32, 0-based; the volume is positive if (v1 - v0, v2 - v0, v3 - v0) is right-handed.
    """

    vert: np.ndarray
    elem: np.ndarray

    def __post_init__(self):
        vert = np.ascontiguousarray(self.vert, dtype=np.float64)
        elem = indices("elem", self.elem)
        if vert.ndim != 2 or vert.shape[1] != 3:
            raise ValueError(f"vert has shape {vert.shape}: pass (nvert, 3) positions in metres")
        if elem.ndim != 2 or elem.shape[1] != 4 or not len(elem):
            raise ValueError(
                f"elem has shape {elem.shape}: pass (nelem, 4) vertex indices, at least one tetrahedron"
            )
        object.__setattr__(self, "vert", vert)
        object.__setattr__(self, "elem", elem)

    @functools.cached_property
    def volumes(self) -> np.ndarray:
        """(nelem,) signed volumes [m^3]."""
        corner = self.vert[self.elem]
        return np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6.0

    @functools.cached_property
    def dihedral_angles(self) -> np.ndarray:
        """(nelem, 6) angles between faces [rad]."""
        corner = self.vert[self.elem][:, _FACES]  # (nelem, 4 faces, 3 corners, 3)
        normal = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.finfo(float).tiny)
        cosine = np.stack([-np.sum(normal[:, i] * normal[:, j], axis=-1) for i, j in _FACE_PAIRS], axis=-1)
        return np.arccos(np.clip(cosine, -1.0, 1.0))

    @functools.cached_property
    def boundary(self) -> np.ndarray:
        """(nface, 3) int32 faces that belong to one tetrahedron only, normals outwards."""
        face = self.elem[:, _FACES].reshape(-1, 3)
        number = triangle_numbers(np.sort(face, axis=1))
        _, first, count = np.unique(number, return_index=True, return_counts=True)
        if count.max() > 2:
            raise ValueError(
                f"{np.sum(count > 2)} faces belong to more than two tetrahedra, the first: "
                f"{face[first[count > 2][0]].tolist()}: remove duplicate or overlapping tetrahedra"
            )
        return np.ascontiguousarray(face[np.sort(first[count == 1])])

    def boundary_components(self) -> list[np.ndarray]:
        """Connected components (nface_i, 3) of the boundary, in descending order of absolute enclosed volume.

        A component with positive `enclosed_volume` is an outer surface, one with negative volume a cavity.
        """
        surfaces = connected_cells(self.boundary)
        return sorted(surfaces, key=lambda face: -abs(enclosed_volume(self.vert, face)))

    def check(self) -> "TetMesh":
        """Returns itself if it can be simulated.

        Raises:
          ValueError: non-finite vertices, indices out of range, inverted or flat tetrahedra, an open or
            non-manifold surface, unused vertices; the text says how many, which comes first and what to do.
        """
        corner = "vertex {}".format
        lost = ~np.isfinite(self.vert).all(axis=1)
        _refuse(lost, "vertices are NaN or infinite", corner, "the file is damaged, export it again")

        def tet(k):
            return f"tetrahedron {k} = {self.elem[k].tolist()}"

        outside = ((self.elem < 0) | (self.elem >= len(self.vert))).any(axis=1)
        what = f"tetrahedra name vertices outside 0..{len(self.vert) - 1}"
        _refuse(outside, what, tet, "indices must be 0-based (subtract 1 if the file counts from 1)")
        edge = [self.vert[self.elem[:, i]] - self.vert[self.elem[:, j]] for i, j in _FACE_PAIRS]
        flat = np.abs(self.volumes) <= _DEGENERATE * np.linalg.norm(edge, axis=2).max(axis=0) ** 3
        remedy = "merge its nodes or mesh again with a larger edge length"
        _refuse(flat, "tetrahedra are degenerate (no volume)", tet, remedy)
        inverted = self.volumes < 0
        remedy = "swap two of its indices, or mesh again"
        remedy = "swap two indices of every tetrahedron" if inverted.all() else remedy
        _refuse(inverted, "tetrahedra are inverted (negative volume)", tet, remedy)
        check_closed(self.boundary)
        unused = ~np.isin(np.arange(len(self.vert)), self.elem)
        _refuse(unused, "vertices belong to no tetrahedron", corner, "remove them and renumber")
        return self


def _refuse(wrong, what, called, remedy):
    """Raises ValueError if any of (n,) bool `wrong` is set, with their number and the first of them."""
    if wrong.any():
        raise ValueError(f"{wrong.sum()} {what}, the first is {called(int(wrong.argmax()))}: {remedy}")


def triangle_numbers(face: np.ndarray) -> np.ndarray:
    """(n,) int64 numbers of triangles (n, 3) of indices, in the order of rows; they sort faster."""
    return face.astype(np.int64) @ [1 << 42, 1 << 21, 1]


def connected_cells(cell: np.ndarray) -> list[np.ndarray]:
    """Connected components (n_i, k) of faces or tetrahedra (n, k); connected ones share a node."""
    import scipy.sparse as sparse

    edge = np.concatenate([cell[:, :-1].T.ravel()[None], cell[:, 1:].T.ravel()[None]])
    size = int(cell.max(initial=-1)) + 1
    graph = sparse.coo_matrix((np.ones(edge.shape[1]), edge), shape=(size, size))
    _, label = sparse.csgraph.connected_components(graph, directed=False)
    label = label[cell[:, 0]]
    return [cell[label == i] for i in np.unique(label)]


def check_closed(face: np.ndarray, name: str = "surface") -> None:
    """Raises ValueError unless every edge of `face` (nface, 3) belongs to exactly two faces that run through
    it in opposite directions."""
    edge = np.asarray(face)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    # pairs as single numbers, which sort ten times as fast
    from_0 = edge.astype(np.int64) - edge.min(initial=0)
    number = from_0.max(initial=0) + 1
    low, high = np.minimum(*from_0.T), np.maximum(*from_0.T)
    _, first, count = np.unique(low * number + high, return_index=True, return_counts=True)
    if (count == 1).any():
        where = edge[first[count == 1][0]].tolist()
        raise ValueError(
            f"the {name} is open: {np.sum(count == 1)} edges have one face only, "
            f"the first joins vertices {where}: fill the holes"
        )
    if (count > 2).any():
        where = edge[first[count > 2][0]].tolist()
        raise ValueError(
            f"the {name} is not a manifold: {np.sum(count > 2)} edges have more than two faces, the first "
            f"joins vertices {where}: separate the parts that touch along them"
        )
    if len(np.unique(from_0 @ [number, 1])) != len(edge):
        raise ValueError(f"the {name} has faces of both orientations: make all normals point outwards")


def check_volumes(vert: np.ndarray, elem: np.ndarray, of: str = "") -> None:
    """Raises ValueError if tetrahedra (nelem, 4 or more) are inverted or degenerate; of: names their skin in
    the message."""
    edges = np.moveaxis(vert[elem[:, 1:4]] - vert[elem[:, :1]], 1, 2)
    volume = np.linalg.det(edges) / 6
    bad = np.flatnonzero(~(volume > 1e-9 * np.abs(edges).max(axis=(1, 2)) ** 3))
    if len(bad):
        raise ValueError(
            f"{len(bad)} of {len(elem)} tetrahedra {of}are inverted or degenerate (first: {bad[0]}, volume "
            f"{volume[bad[0]]:.3g} m^3): repair the mesh or swap two nodes of each inverted tetrahedron"
        )


def enclosed_volume(vert: np.ndarray, face: np.ndarray) -> float:
    """Volume inside a closed surface by the divergence theorem; negative where the normals point inwards."""
    a, b, c = (vert[face[:, i]] for i in range(3))
    return float(np.sum(np.cross(a, b) * c) / 6.0)
