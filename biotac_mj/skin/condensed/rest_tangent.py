"""Stiffness of a skin that rests on its filling, as a sparse matrix: what the condensed tier is linear
about."""

import numpy as np
import scipy.sparse as sp
import warp as wp

from .. import elasticity, liquid
from ..types import vec3

__all__ = ["rest_tangent"]


def rest_tangent(model) -> sp.csc_matrix:
    """Tangent of elastic forces and of the liquid's pressure at `model.rest`, over the free coordinates
    [N/m].

    Columns come from products with the tangent; nodes without a common neighbour are probed together.

    Args:
      model: SkinModel on the CPU.
    """
    from ..data import SkinData, view

    data = SkinData(model)
    view(data.x)[:, 0] = model.rest.vert
    model.elasticity.force(data.elastic, data.mu, data.lam, data.x, data.product)
    pattern = _neighbours(model.nvert, model._elem)
    color = _colors(pattern)
    if model.has_liquid:
        nface = len(model.inner.face)
        wet = wp.full(
            (nface, 1), value=wp.vec3d(1 / 3, 1 / 3, 1 / 3), dtype=vec3, device=model.device
        )  # all: the skin is off its core
        bend, nodal = (
            wp.zeros((3 * nface, 1), dtype=vec3, device=model.device),
            wp.zeros((model.nvert, 1), dtype=vec3, device=model.device),
        )
    row, column, value = [], [], []
    for c in range(color.max() + 1):
        nodes = np.flatnonzero(color == c)
        part = pattern[:, nodes].tocoo()
        for axis in range(3):
            view(data.direction)[...] = 0
            view(data.direction)[nodes, 0, axis] = 1
            model.elasticity.product(data.elastic, data.mu, data.lam, data.x, data.direction, data.product)
            q = view(data.product)[:, 0].copy()
            if model.has_liquid:
                inputs = [model.inner.face, wet, data.x, data.direction]
                wp.launch(liquid.gradient_derivative, (nface, 1), inputs, [bend], device=model.device)
                inputs = [model.inner.start, model.inner.slot, bend, 1.0, 0]
                wp.launch(elasticity.gather, (model.nvert, 1), inputs, [nodal], device=model.device)
                q -= model.rest.pressure * view(nodal)[:, 0]
            row.append((3 * part.row[:, None] + np.arange(3)).ravel())
            column.append(np.repeat(3 * nodes[part.col] + axis, 3))
            value.append(q[part.row].ravel())
    n = 3 * model.nvert
    K = sp.coo_matrix(
        (np.concatenate(value), (np.concatenate(row), np.concatenate(column))), shape=(n, n)
    ).tocsc()
    return model._of_free((K + K.T) / 2)


def _neighbours(nvert, elem):
    """Which nodes share an element (nvert, nvert)."""
    belongs = sp.coo_matrix(
        (np.ones(elem.size, bool), (np.repeat(np.arange(len(elem)), elem.shape[1]), elem.ravel())),
        (len(elem), nvert),
    )
    belongs = belongs.tocsr().astype(np.int32)
    return ((belongs.T @ belongs) > 0).tocsc()


def _colors(pattern):
    """Numbers (nvert,) such that nodes with the same one have no common neighbour."""
    near = ((pattern.astype(np.int32) @ pattern.astype(np.int32)) > 0).tocsr()
    color = np.full(near.shape[0], -1)
    for node in range(near.shape[0]):
        taken = color[near.indices[near.indptr[node] : near.indptr[node + 1]]]
        free = np.ones(len(taken) + 1, bool)
        taken = taken[(taken >= 0) & (taken < len(free))]
        free[taken] = False
        color[node] = free.argmax()
    return color
