"""Nested dissection of a mesh: the order in which a sparse factor of its stiffness stays small (George 1973).

The nodes are cut in two across their longest direction; the fewest nodes that separate both sides are a
smallest vertex cover of the cut edges (Koenig: a largest matching gives it). They come last, both sides are
cut on in the same way."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

__all__ = ["clusters", "cut", "dissect"]

_LEAF = 25  # nodes that are not cut further
_CUTS = (0.42, 0.5, 0.58)  # share of the nodes on one side


def dissect(neighbours: sp.csr_matrix, points: np.ndarray) -> list[np.ndarray]:
    """Groups of nodes in the order of elimination: what is below a group in the tree comes before it.

    Args:
      neighbours: (n, n) pattern of the nodes' stiffness, symmetric.
      points: (n, 3) where the nodes are.

    Returns:
      arrays of node numbers, each node in one of them.
    """
    groups = []
    stack = [(np.arange(len(points)), neighbours, False)]
    while stack:
        nodes, near, done = stack.pop()
        if done or len(nodes) <= _LEAF:
            groups.append(nodes)
            continue
        middle, *sides = cut(near, points[nodes], _CUTS, _fill)
        if len(middle):
            stack.append((nodes[middle], None, True))
        for side in sides[::-1]:
            if len(side):
                stack.append((nodes[side], near[side][:, side], False))
    return groups


def _fill(middle, left, right):
    return middle * (1 + abs(left - right) / (2 * (middle + left + right)))


def cut(
    near: sp.csr_matrix, points: np.ndarray, shares: Sequence[float], cost: Callable[[int, int, int], float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best separator found across the longest direction and both sides of it: three index arrays.

    Args:
      near, points: as for `dissect`.
      shares: of the nodes on one side, that are tried.
      cost: of so many nodes between and on each side.
    """
    centered = points - points.mean(0)
    along = centered @ np.linalg.eigh(centered.T @ centered)[1][:, -1]
    order, n = np.argsort(along, kind="stable"), len(points)
    best, least = None, np.inf
    for share in shares:
        first = np.zeros(n, bool)
        first[order[: int(share * n)]] = True
        middle = _separator(near, first)
        rest = np.ones(n, bool)
        rest[middle] = False
        left, right = np.flatnonzero(rest & first), np.flatnonzero(rest & ~first)
        worth = cost(len(middle), len(left), len(right))
        if worth < least:
            best, least = (middle, left, right), worth
    return best


def _separator(near, first):
    """Fewest nodes without which no edge leads from `first` (n,) to the others."""
    a, b = np.flatnonzero(first), np.flatnonzero(~first)
    cut = near[a][:, b].tocsr()
    rows, columns = np.flatnonzero(np.diff(cut.indptr)), np.unique(cut.indices)
    cut = cut[rows][:, columns]
    partner = maximum_bipartite_matching(cut, perm_type="column")  # of each row
    of_column = np.full(len(columns), -1)
    of_column[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    row_seen, column_seen = partner < 0, np.zeros(len(columns), bool)
    front = np.flatnonzero(row_seen)
    while len(front):  # alternating paths from rows without a partner
        reached = np.unique(cut[front].indices)
        reached = reached[~column_seen[reached]]
        column_seen[reached] = True
        front = of_column[reached]
        front = front[(front >= 0) & ~row_seen[front]]
        row_seen[front] = True
    return np.concatenate([a[rows[~row_seen]], b[columns[column_seen]]])


def clusters(points: np.ndarray, size: int) -> list[np.ndarray]:
    """Nodes (n,) at points (n, 3) in groups of about `size` neighbours: halves along the longest side, again
    and again."""
    order = np.arange(len(points))
    stack, out = [order], []
    while stack:
        part = stack.pop()
        if len(part) <= size:
            out.append(part)
            continue
        axis = np.ptp(points[part], axis=0).argmax()
        part = part[np.argsort(points[part, axis], kind="stable")]
        stack += [part[len(part) // 2 :], part[: len(part) // 2]]
    order = np.concatenate(out)
    return np.array_split(order, max(1, len(order) // size))
