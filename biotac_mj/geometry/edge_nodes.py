"""Ten-node tetrahedra: adds a node on every edge of a four-node mesh."""

import dataclasses
from collections.abc import Callable

import numpy as np

from biotac_mj.geometry.skin_geometry import PARTS, SkinGeometry

# of the nodes 4..9, in the order of CalculiX's C3D10
EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])

# least volume of a curved tetrahedron over the straight one, in its map at each node and in each of its parts
_FOLD = 0.3


def with_edge_nodes(geometry: SkinGeometry, project: Callable | None = None) -> SkinGeometry:
    """Adds a node on every edge of a skin of four-node tetrahedra.

    The nodes of `geometry` come first and keep their indices. Every boundary face f is divided into four (4 f
    .. 4 f + 3). The new node of a boundary edge is fixed if both ends are.

    Args:
      geometry: a skin with elem (nelem, 4).
      project: None leaves new nodes in the middle of their edges; else a function from points (n, 3) and a
        name, "outer" or "inner", to the nearest points (n, 3) of that surface [m], applied to the new nodes
        of boundary edges. If that would fold a tetrahedron, or nearly, its new nodes move only in part.

    Returns:
      The same skin with elem (nelem, 10): corners, then edges in the order of `EDGES`.

    Raises:
      ValueError: the skin has ten-node tetrahedra already.
    """
    n, elem = geometry.nvert, geometry.elem
    if elem.shape[1] != 4:
        raise ValueError(f"skin {geometry.name!r} has ten-node tetrahedra already: pass one with four")
    ends = np.sort(elem[:, EDGES].reshape(-1, 2), axis=1).astype(np.int64)
    keys, number = np.unique(ends[:, 0] * n + ends[:, 1], return_inverse=True)
    elem = np.hstack([elem, n + number.reshape(-1, 6)]).astype(np.int32)
    edge = np.stack([keys // n, keys % n], axis=1)

    def split(face):
        pairs = np.sort(face[:, [[0, 1], [1, 2], [2, 0]]], axis=2).astype(np.int64)
        a, b, c = n + np.searchsorted(keys, pairs[..., 0] * n + pairs[..., 1]).T
        i, j, k = face.T
        four = np.stack([i, a, c, a, j, b, c, b, k, a, b, c], axis=1)
        return four.reshape(-1, 3), np.stack([a, b, c], axis=1)

    outer, on_outer = split(geometry.outer_face)
    inner, on_inner = split(geometry.inner_face)
    fixed = np.isin(edge, geometry.fixed).all(1)
    surface = np.zeros(len(edge), bool)
    for new in (on_outer, on_inner):
        surface[new.ravel() - n] = True
    vert = np.concatenate([geometry.vert, geometry.vert[edge].mean(1)])
    if project is not None:
        target = vert.copy()
        common = np.intersect1d(on_outer, on_inner)
        for name, new in (("outer", on_outer), ("inner", on_inner)):
            new = np.setdiff1d(new, common)
            target[new] = project(vert[new], name)
        vert = _unfolded(vert, target, elem)
    return dataclasses.replace(
        geometry,
        vert=vert,
        elem=elem,
        outer_face=outer,
        inner_face=inner,
        fixed=np.concatenate([geometry.fixed, n + np.flatnonzero(fixed & surface)]),
    )


def shape_gradients(points: np.ndarray) -> np.ndarray:
    """(npoint, 10, 3) derivatives of the ten shape functions by the barycentric coordinates 1..3 at
    barycentric points (npoint, 4)."""
    by_all = np.zeros((len(points), 10, 4))
    for point, b in enumerate(points):
        for i in range(4):
            by_all[point, i, i] = 4 * b[i] - 1
        for node, (i, j) in enumerate(EDGES):
            by_all[point, 4 + node, i] = 4 * b[j]
            by_all[point, 4 + node, j] = 4 * b[i]
    return by_all[:, :, 1:] - by_all[:, :, :1]


def _unfolded(straight, curved, elem):
    """Edge nodes moved from `straight` towards `curved` as far as no tetrahedron folds."""
    corners = np.eye(4)
    gradient = shape_gradients(np.vstack([corners, corners[EDGES].mean(1)]))
    volume = np.linalg.det(straight[elem[:, 1:4]] - straight[elem[:, :1]])
    scale = np.ones(len(straight))
    for _ in range(20):
        vert = straight + scale[:, None] * (curved - straight)
        map_volume = np.linalg.det(np.einsum("eai,qak->eqik", vert[elem], gradient))
        corner = vert[elem[:, PARTS]]
        part_volume = 8 * np.linalg.det(corner[:, :, 1:] - corner[:, :, :1])
        bad = np.minimum(map_volume.min(1), part_volume.min(1)) < _FOLD * volume
        if not bad.any():
            break
        scale[np.unique(elem[bad])] *= 0.7
    return vert
