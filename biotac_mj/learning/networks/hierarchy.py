"""Hierarchy of coarser graphs of a tetrahedral mesh, with the matrices that restrict and interpolate fields.

Nodes of a level are chosen by farthest-point sampling in geodesic distance along the edges, which separates
the two faces of the thin skin. The coarse graph is the dual of their Voronoi cells. Restriction selects those
nodes. Interpolation is by affine-exact moving least squares over the nearest kept nodes, so that linear
fields are exact. (COMA's quadric simplification measures a surface's flatness and has no meaning inside a
volume.)
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, identity
from scipy.sparse.csgraph import connected_components, dijkstra

_NEIGHBOURS = 8


@dataclasses.dataclass(frozen=True)
class Level:
    """One graph, and the matrices to and from the next coarser one.

    Attributes:
      laplacian: (n, n) CSR, symmetric, eigenvalues in [-1, 1].
      keep: (m,) nodes of this level in the next one; None at the last.
      up: (n, m) CSR from the next level's fields to this one's; rows sum to one; None at the last.
    """

    laplacian: csr_matrix
    keep: np.ndarray | None = None
    up: csr_matrix | None = None


def edges_of(elem: np.ndarray) -> np.ndarray:
    """(nedge, 2) sorted unique edges of tetrahedra (n, 4)."""
    pairs = np.concatenate([elem[:, [i, j]] for i in range(4) for j in range(i)])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def scaled_laplacian(adjacency: csr_matrix) -> csr_matrix:
    """L - 1, the argument of the Chebyshev polynomials, with L = 1 - D^-1/2 A D^-1/2 and an assumed largest
    eigenvalue of 2."""
    degree = np.asarray(adjacency.sum(1)).ravel()
    inverse = 1 / np.sqrt(np.maximum(degree, 1e-12))
    scaled = adjacency.multiply(inverse[:, None]).multiply(inverse[None]).tocsr()
    return (-scaled).astype(np.float64)


def build_hierarchy(
    vert: np.ndarray, elem: np.ndarray, factors: Sequence[float] = (4, 4, 4, 2)
) -> list[Level]:
    """Levels of a mesh, the finest first, len(factors) + 1 of them.

    Args:
      vert: (n, 3); elem: (m, 4).
      factors: ratio of the numbers of nodes of successive levels.

    Raises:
      ValueError: a disconnected mesh, or too few nodes for the factors.
    """
    vert = np.asarray(vert, float)
    n = len(vert)
    edge = edges_of(np.asarray(elem))
    length = np.linalg.norm(vert[edge[:, 0]] - vert[edge[:, 1]], axis=1)
    graph = _symmetric(edge, length, n)
    if connected_components(graph, directed=False)[0] > 1:
        raise ValueError(
            "the mesh is not connected: a graph network on it would not see all of it; "
            "import a mesh of one piece"
        )
    levels, here = [], vert
    for factor in factors:
        m = int(np.ceil(len(here) / factor))
        if m < 5:
            raise ValueError(
                f"{n} nodes are too few for factors {tuple(factors)}: "
                f"the coarsest level would have {m} nodes, fewer than 5"
            )
        keep, owner = _farthest(graph, m)
        up = _interpolation(graph, here, keep)
        levels.append(Level(scaled_laplacian(_binary(graph)), keep, up))
        graph, here = _dual(graph, owner, here[keep]), here[keep]
    levels.append(Level(scaled_laplacian(_binary(graph))))
    return levels


def _symmetric(edge, value, n):
    i, j = np.concatenate([edge, edge[:, ::-1]]).T
    return coo_matrix((np.concatenate([value, value]), (i, j)), shape=(n, n)).tocsr()


def _binary(graph):
    return csr_matrix((np.ones_like(graph.data), graph.indices, graph.indptr), shape=graph.shape)


def _farthest(graph, count):
    """Nodes (count,) of a farthest-point sampling, and the nearest sampled node of each node."""
    nearest = np.full(graph.shape[0], np.inf)
    owner = np.zeros(graph.shape[0], int)
    keep, new = [], 0
    for k in range(count):
        keep.append(new)
        # nodes farther than this cannot get closer to the new one
        reach = nearest.max() if k else np.inf
        d = dijkstra(graph, indices=new, limit=reach)
        closer = d < nearest
        nearest[closer], owner[closer] = d[closer], k
        new = int(np.argmax(nearest))
    return np.array(keep), owner


def _dual(graph, owner, vert):
    entries = graph.tocoo()
    a, b = owner[entries.row], owner[entries.col]
    pairs = np.unique(np.sort(np.stack([a, b], 1)[a != b], axis=1), axis=0)
    return _symmetric(pairs, np.linalg.norm(vert[pairs[:, 0]] - vert[pairs[:, 1]], axis=1), len(vert))


def _interpolation(graph, vert, keep):
    """Weights (n, m) of moving least squares on the nearest kept nodes; the identity at kept ones."""
    n, m = len(vert), len(keep)
    k = min(_NEIGHBOURS, m)
    distance = dijkstra(graph, indices=keep)  # (m, n)
    neighbours = np.argpartition(distance, k - 1, axis=0)[:k].T  # (n, k)
    d = np.take_along_axis(distance.T, neighbours, axis=1)
    weight = 1 / (d + 1e-3 * d.max(1, keepdims=True)) ** 2
    offset = vert[keep[neighbours]] - vert[:, None]  # (n, k, 3)
    scale = np.sqrt((offset**2).sum(2).mean(1))[:, None, None]
    p = np.concatenate([np.ones((n, k, 1)), offset / scale], axis=2)
    # Minimise sum |c|^2 / w subject to P^T c = e1: c = W P (P^T W P)^-1 e1. The small ridge matters for
    # coplanar neighbours.
    gram = np.einsum("nka,nk,nkb->nab", p, weight, p)
    ridge = 1e-6 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.diag([0.0, 1, 1, 1])
    c = np.linalg.solve(gram + ridge, np.broadcast_to(np.eye(4)[0], (n, 4))[..., None])[..., 0]
    value = weight * np.einsum("nka,na->nk", p, c)
    row_of = np.full(n, -1)
    row_of[keep] = np.arange(m)
    kept = row_of >= 0
    rows = np.repeat(np.arange(n)[~kept], k)
    up = coo_matrix((value[~kept].ravel(), (rows, neighbours[~kept].ravel())), shape=(n, m)).tocsr()
    up = up + identity(n, format="csr")[:, keep]
    return csr_matrix(up.multiply(1 / np.asarray(up.sum(1))))
