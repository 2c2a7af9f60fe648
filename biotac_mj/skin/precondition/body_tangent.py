"""Stiffness of the skin against rigid motions of a touching body, 6 x 6 about the BioTac frame's origin.

The stiffness is R' (D - D C D) R, with the contact springs D of the nodes that the body touches, the
corrected compliance C = (A0 + U D U^T)^-1 of the skin behind them, and the body's rigid motions R,
translations first. The undeformed stiffness A0 replaces the tangent, as in the preconditioners.

`body_tangent` computes it in double precision for one body. The kernels use G = (I + D W)^-1 D = D - D C D
over all touching nodes, from the linear solves of many worlds. A node that two bodies touch counts for one of
them.
"""

from collections.abc import Callable

import numpy as np
import warp as wp

from ...geometry.rigid import rigid_motions
from ...kernels import kernel_module
from ..types import mat33, real, vec3

kernel_module(__name__)

# index of the block between corners: `faces.block_index`
_BLOCK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def body_tangent(
    nodes: np.ndarray,
    compliance: np.ndarray,
    solver: Callable[[np.ndarray], np.ndarray],
    blocks: tuple,
    x: np.ndarray,
    nvert: int,
) -> np.ndarray:
    """Stiffness (6, 6) of the skin against rigid motions of a touching body about the origin (translation,
    rotation vector), see the module's docstring.

    Args:
      nodes: (m,) touching free nodes.
      compliance: (3m [+ 1], ...) W over them (and the liquid).
      solver: u -> (I + D W)^-1 D u.
      blocks: (faces (n, 3), stiffness (n, 6, 3, 3)) of the body's contact alone.
      x: (nvert, 3) nodal positions.
      nvert: number of nodes.
    """
    if not len(blocks[0]):
        return np.zeros((6, 6))
    size, m = len(compliance), 3 * len(nodes)
    springs = np.zeros((size, size))
    springs[:m, :m] = assemble(nodes, *blocks, nvert)
    rigid = rigid_motions(x[nodes], size)
    pull = springs @ rigid
    displacement = compliance @ pull
    displacement -= compliance @ solver(displacement)
    stiffness = rigid.T @ pull - pull.T @ displacement
    values, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def assemble(nodes: np.ndarray, faces: np.ndarray, blocks: np.ndarray, nvert: int) -> np.ndarray:
    """Contact stiffness (3m, 3m) over `nodes` from the blocks (n, 6, 3, 3) of faces (n, 3)."""
    size = 3 * len(nodes)
    position = np.full(nvert, len(nodes))  # the last rows and columns catch fixed nodes
    position[nodes] = np.arange(len(nodes))
    column = 3 * position[faces][..., None] + np.arange(3)  # of each corner's coordinates
    row = (size + 3) * column
    place = row[:, :, None, :, None] + column[:, None, :, None, :]
    dense = np.bincount(place.ravel(), blocks[:, _BLOCK].ravel(), (size + 3) ** 2)
    return dense.reshape(size + 3, size + 3)[:size, :size]


@wp.kernel
def group_rows(
    # In:
    size: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    nsample: int,
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    group: wp.array(dtype=int),
    # Out:
    group_out: wp.array2d(dtype=int),
):
    """Group of the body that touches node s of a Woodbury system from outside [row, world]; -1: none."""
    s, w = wp.tid()
    found = int(-1)
    if s < size[w]:
        i = node[s, w]
        for k in range(start[i], start[i + 1]):
            f = slot[k] / 3
            if touching[f, w] == 1:
                for j in range(nsample):
                    g = geom[f * nsample + j, w]
                    if g >= 0:
                        found = wp.max(found, group[g])
    group_out[s, w] = found


@wp.kernel
def row_tangents(
    # In:
    liquid: int,
    size: wp.array(dtype=int),
    node: wp.array2d(dtype=int),
    G: wp.array3d(dtype=float),
    x: wp.array2d(dtype=vec3),
    group: wp.array2d(dtype=int),
    # Out:
    partial_out: wp.array2d(dtype=wp.spatial_matrixd),
):
    """Contribution R_s' sum_t G_st R_t of row s to the tangent of its body [row, world]."""
    s, w = wp.tid()
    if s >= size[w]:
        return
    mine = group[s, w]
    if mine < 0:
        return
    move = mat33()  # forces on node s by unit translations of the body, and by rotations
    turn = mat33()
    for t in range(size[w]):
        if group[t, w] == mine:
            g = mat33()
            for a in range(3):
                for b in range(3):
                    # stored transposed; G is symmetric but for rounding
                    g[a, b] = real(G[w, liquid + 3 * t + b, liquid + 3 * s + a])
            move += g
            turn -= g * wp.skew(x[node[t, w], w])
    arm = wp.skew(x[node[s, w], w])
    bend = arm * move
    wind = arm * turn
    partial = wp.spatial_matrixd()
    for a in range(3):
        for b in range(3):
            partial[a, b] = move[a, b]
            partial[a, 3 + b] = turn[a, b]
            partial[3 + a, b] = bend[a, b]
            partial[3 + a, 3 + b] = wind[a, b]
    partial_out[s, w] = partial


@wp.kernel
def sum_rows(
    # In:
    size: wp.array(dtype=int),
    group: wp.array2d(dtype=int),
    partial: wp.array2d(dtype=wp.spatial_matrixd),
    # Out:
    tangent_out: wp.array2d(dtype=wp.spatial_matrixd),
):
    g, w = wp.tid()
    total = wp.spatial_matrixd()
    for s in range(size[w]):
        if group[s, w] == g:
            total += partial[s, w]
    tangent_out[g, w] = real(0.5) * (total + wp.transpose(total))
