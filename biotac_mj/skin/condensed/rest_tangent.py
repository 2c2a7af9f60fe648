"""Tangent stiffness of the filled skin without contact, as a sparse matrix, for the condensed tier."""

import typing

import numpy as np
import scipy.sparse as sp

from ..data import SkinData
from ..geoms import GeomSet
from ..step import prepare_step
from ..types import vec3

if typing.TYPE_CHECKING:
    from ..model import SkinModel


def rest_tangent(model: "SkinModel") -> sp.csc_matrix:
    """Tangent of elastic forces and of the liquid's pressure at `model.rest`, over the free coordinates
    [N/m], without contact with the core.

    Columns are computed by products with the tangent, for all nodes without a common neighbour at a time.

    Args:
      model: SkinModel on the CPU.
    """
    data = SkinData(model)
    at_rest = prepare_step(model, data, GeomSet([], []))
    at_rest.evaluate_forces()
    data.worlds.tangent_pressure.fill_(model.rest.pressure)
    at_rest.k.wet.fill_(vec3(1 / 3, 1 / 3, 1 / 3))
    if data.core:
        data.core.touching.zero_()
    pattern = _neighbours(model.nvert, model._elem)
    color = _colors(pattern)
    row, column, value = [], [], []
    for c in range(color.max() + 1):
        nodes = np.flatnonzero(color == c)
        part = pattern[:, nodes].tocoo()
        for axis in range(3):
            direction = np.zeros((model.nvert, 1, 3))
            direction[nodes, 0, axis] = 1
            q = at_rest.multiply_tangent(direction, at_pressure=True)[:, 0]
            row.append((3 * part.row[:, None] + np.arange(3)).ravel())
            column.append(np.repeat(3 * nodes[part.col] + axis, 3))
            value.append(q[part.row].ravel())
    n = 3 * model.nvert
    K = sp.coo_matrix(
        (np.concatenate(value), (np.concatenate(row), np.concatenate(column))), shape=(n, n)
    ).tocsc()
    return model._of_free((K + K.T) / 2)


def _neighbours(nvert, elem):
    """Sparse pattern (nvert, nvert) of nodes that share an element."""
    belongs = sp.coo_matrix(
        (np.ones(elem.size, bool), (np.repeat(np.arange(len(elem)), elem.shape[1]), elem.ravel())),
        (len(elem), nvert),
    )
    belongs = belongs.tocsr().astype(np.int32)
    return ((belongs.T @ belongs) > 0).tocsc()


def _colors(pattern):
    """Colours (nvert,) such that nodes of the same colour have no common neighbour."""
    near = ((pattern.astype(np.int32) @ pattern.astype(np.int32)) > 0).tocsr()
    color = np.full(near.shape[0], -1)
    for node in range(near.shape[0]):
        taken = color[near.indices[near.indptr[node] : near.indptr[node + 1]]]
        free = np.ones(len(taken) + 1, bool)
        taken = taken[(taken >= 0) & (taken < len(free))]
        free[taken] = False
        color[node] = free.argmax()
    return color
