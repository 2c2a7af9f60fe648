"""Nested dissection of a mesh: an elimination order with little fill-in (George 1973).

The nodes are divided across their longest direction. The smallest separator is a minimum vertex cover of the
edges between both sides, which a maximum matching gives (Koenig). It is eliminated last; both sides are
divided in the same way."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

_LEAF = 25  # nodes that are not divided further
_CUTS = (0.42, 0.5, 0.58)  # fractions of the nodes on one side that are tried


def dissect(neighbours: sp.csr_matrix, points: np.ndarray) -> list[np.ndarray]:
    """Groups of nodes in the order of elimination: groups below a group in the tree come before it.

    Args:
      neighbours: (n, n) pattern of the nodes' stiffness, symmetric.
      points: (n, 3) positions of the nodes.

    Returns:
      Arrays of node indices; each node is in one of them.
    """
    groups = []
    stack = [(np.arange(len(points)), neighbours, False)]
    while stack:
        nodes, neighbours, done = stack.pop()
        if done or len(nodes) <= _LEAF:
            groups.append(nodes)
            continue
        middle, *sides = cut(neighbours, points[nodes], _CUTS, _fill)
        if len(middle):
            stack.append((nodes[middle], None, True))
        for side in sides[::-1]:
            if len(side):
                stack.append((nodes[side], neighbours[side][:, side], False))
    return groups


def _fill(middle, left, right):
    return middle * (1 + abs(left - right) / (2 * (middle + left + right)))


def cut(
    neighbours: sp.csr_matrix,
    points: np.ndarray,
    fractions: Sequence[float],
    cost: Callable[[int, int, int], float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best separator across the longest direction, and both of its sides: three index arrays.

    Args:
      neighbours, points: as for `dissect`.
      fractions: of the nodes on one side, that are tried.
      cost: of the sizes of separator, left and right side; the least is taken.
    """
    centered = points - points.mean(0)
    along = centered @ np.linalg.eigh(centered.T @ centered)[1][:, -1]
    order, n = np.argsort(along, kind="stable"), len(points)
    best, least = None, np.inf
    for fraction in fractions:
        first = np.zeros(n, bool)
        first[order[: int(fraction * n)]] = True
        middle = _separator(neighbours, first)
        others = np.ones(n, bool)
        others[middle] = False
        left, right = np.flatnonzero(others & first), np.flatnonzero(others & ~first)
        value = cost(len(middle), len(left), len(right))
        if value < least:
            best, least = (middle, left, right), value
    return best


def _separator(neighbours, first):
    """Smallest set of nodes that separates `first` (n,) from the other nodes."""
    a, b = np.flatnonzero(first), np.flatnonzero(~first)
    cut = neighbours[a][:, b].tocsr()
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
