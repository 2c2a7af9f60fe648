"""Right-hand sides and answers of the block inverse: conversion between vectors of nodes and half precision.

Only free nodes of the inner surface have a gradient of the liquid's volume: they are `wet`. A right-hand side
is stored as the sum of two half-precision numbers, see `block_inverse`. Its length is RAISE, or up to 16
times that with the forces of contact and liquid, so that the second number is normal down to 1e-7 of it."""

import warp as wp

from ...kernels import kernel_module
from ..newton.worlds import Worlds, total_of
from ..types import real, single, vec3

kernel_module(__name__)

# [N/m] stiffness along the scaled gradient of the liquid: like that of contact, so that single precision
# suffices
STIFF = wp.constant(1.0e5)
TINY = wp.constant(1.0e-30)  # least norm that is divided by
LOW = wp.constant(2048.0)  # factor on the second number of an entry of the inverse
RAISE = wp.constant(64.0)  # length of a right-hand side


@wp.func
def write_node(b: wp.vec3, row: int, column: int, out: wp.array3d(dtype=wp.float16)):
    """Stores vector b as two half-precision numbers, the first again for a third column of
    `block_inverse`."""
    for a in range(3):
        value = RAISE * b[a]
        high = wp.float16(value)
        out[row + a, 0, column] = high
        out[row + a, 1, column] = wp.float16(value - float(high))
        if out.shape[1] == 3:
            out[row + a, 2, column] = high


@wp.func
def read_node(x: wp.array3d(dtype=float), row: int, column: int):
    total = wp.vec3()
    for h in range(x.shape[1]):
        total += wp.vec3(x[row, h, column], x[row + 1, h, column], x[row + 2, h, column])
    return total / RAISE


@wp.struct
class NodeMap:
    """Maps vectors of nodes to right-hand sides of the block inverse, and its solutions to vectors of
    nodes."""

    row: wp.array(dtype=int)  # first row of each node; -1: the node is fixed
    matrix: wp.array2d(dtype=wp.mat33)  # M of `pushed_forward` [node, world]; empty: the identity
    norm: wp.array2d(dtype=float)  # of the residual and of the volume's gradient [2, world]
    scale: float  # an answer times this is the inverse times the right-hand side


@wp.struct
class InverseEntries:
    """Entries of the inverse of the undeformed stiffness, see `DissectedInverse`."""

    half: wp.array2d(dtype=wp.float16)
    rest: wp.array2d(dtype=wp.float16)
    scale: float
    free_index: wp.array(dtype=int)  # number of a node among the free ones


@wp.func(inline=True)
def push_forward(node_map: NodeMap, i: int, w: int, motion: wp.vec3):
    """Motion of node i for a motion of the undeformed skin, see `pushed_forward`."""
    if node_map.matrix.shape[0] > 0:
        return node_map.matrix[i, w] * motion
    return motion


@wp.func(inline=True)
def pull_back(node_map: NodeMap, i: int, w: int, force: wp.vec3):
    """Force on the undeformed skin for a force on node i."""
    if node_map.matrix.shape[0] > 0:
        return wp.transpose(node_map.matrix[i, w]) * force
    return force


@wp.func(inline=True)
def entry(inverse: InverseEntries, row: int, column: int):
    """Entry of the inverse over its scale."""
    value = float(inverse.half[row, column])
    if inverse.rest.shape[0] > 0:
        value += float(inverse.rest[row, column]) / LOW
    return value


@wp.func
def liquid_scale(st: Worlds, w: int):
    """Factor on the volume's gradient that makes its stiffness STIFF."""
    return wp.sqrt(float(st.kappa[w]) / STIFF)


@wp.kernel
def load_gradient(
    node_map: NodeMap,
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    side_out: wp.array3d(dtype=wp.float16),
):
    """Stores the volume's gradient at node i, over its norm, as a right-hand side after those of all
    residuals."""
    i, w = wp.tid()
    j = node_map.row[i]
    if on[w] == 1 and j >= 0:
        g = wp.vec3()
        if wet[i] == 1:
            g = single(gradient[i, w]) / node_map.norm[1, w]
        write_node(pull_back(node_map, i, w, g), j, node_map.norm.shape[1] + w, side_out)


@wp.kernel
def measure_norm(partial: wp.array3d(dtype=real), on: wp.array(dtype=int), norm_out: wp.array2d(dtype=float)):
    """Norm of the residual in world w. partial: its square by chunks."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    rr = total_of(partial, 0, w, t)
    if t == 0:
        norm_out[0, w] = wp.max(float(wp.sqrt(rr)), TINY)


@wp.kernel
def read_along(
    # In:
    chunk: int,
    node_map: NodeMap,
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    answer: wp.array3d(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    along_out: wp.array2d(dtype=wp.vec3),
    partial_out: wp.array3d(dtype=real),
):
    """Displacements of a chunk of nodes by the scaled gradient, see `load_gradient`, and their product with
    it."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    column = node_map.norm.shape[1] + w
    pull = liquid_scale(st, w)
    factor = node_map.norm[1, w] * pull * node_map.scale * float(st.softness[w])
    gg = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, node_map.row.shape[0])):
        j = node_map.row[i]
        along = wp.vec3()
        if j >= 0:
            along = push_forward(node_map, i, w, read_node(answer, j, column) * factor)
            if wet[i] == 1:
                gg += real(wp.dot(pull * single(gradient[i, w]), along))
        along_out[i, w] = along
    partial_out[1, c, w] = gg


@wp.kernel
def measure_volume_change(
    # In:
    chunk: int,
    node_map: NodeMap,
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    answer: wp.array3d(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    partial_out: wp.array3d(dtype=real),
):
    """Change of the liquid's volume by the residual, from a chunk of nodes, times the gradient's scale."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    factor = node_map.norm[0, w] * liquid_scale(st, w) * node_map.scale * float(st.softness[w])
    total = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, node_map.row.shape[0])):
        if wet[i] == 1:
            y = push_forward(node_map, i, w, read_node(answer, node_map.row[i], w))
            total += real(wp.dot(single(gradient[i, w]), y))
    partial_out[0, c, w] = real(factor) * total


@wp.kernel
def gather_displacements(
    # In:
    has_liquid: int,
    node_map: NodeMap,
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    answer: wp.array3d(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    u_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
):
    """Displacement u of touching node s by the residual [m]."""
    s, w = wp.tid()
    if on[w] == 0:
        return
    if s == 0:
        largest_out[w] = 0.0
    if s < size[w]:
        i = node[s, w]
        factor = node_map.norm[0, w] * node_map.scale * float(st.softness[w])
        y = push_forward(node_map, i, w, read_node(answer, node_map.row[i], w) * factor)
        for a in range(3):
            u_out[w, has_liquid + 3 * s + a] = y[a]


@wp.kernel
def load_difference(
    # In:
    has_liquid: int,
    node_map: NodeMap,
    slot: wp.array2d(dtype=int),
    r: wp.array2d(dtype=wp.vec3),
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    q: wp.array2d(dtype=float),
    largest: wp.array(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    side_out: wp.array3d(dtype=wp.float16),
):
    """Stores the residual minus the forces q of contact and liquid at node i as a right-hand side; without
    slots and liquid the residual."""
    i, w = wp.tid()
    j = node_map.row[i]
    if on[w] == 0 or j < 0:
        return
    b = r[i, w]
    s = int(-1)
    if slot.shape[0] > 0:
        s = slot[i, w]
    if s >= 0:
        at = has_liquid + 3 * s
        b -= wp.vec3(q[w, at], q[w, at + 1], q[w, at + 2])
    if has_liquid == 1 and wet[i] == 1:
        b -= q[w, 0] * liquid_scale(st, w) * single(gradient[i, w])
    write_node(pull_back(node_map, i, w, b / (node_map.norm[0, w] + 2.0 * largest[w])), j, w, side_out)


@wp.kernel
def read_answer(
    # In:
    chunk: int,
    node_map: NodeMap,
    answer: wp.array3d(dtype=float),
    largest: wp.array(dtype=float),
    r: wp.array2d(dtype=wp.vec3),
    wet: wp.array(dtype=int),
    gradient: wp.array2d(dtype=vec3),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    z_out: wp.array2d(dtype=wp.vec3),
    partial_out: wp.array3d(dtype=real),
):
    """Result z of a chunk of nodes, and its products with the residual and with the volume's gradient."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    factor = (node_map.norm[0, w] + 2.0 * largest[w]) * node_map.scale * float(st.softness[w])
    rz = real(0.0)
    gz = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, node_map.row.shape[0])):
        z = wp.vec3()
        j = node_map.row[i]
        if j >= 0:
            z = push_forward(node_map, i, w, factor * read_node(answer, j, w))
            rz += real(wp.dot(r[i, w], z))
            if wet.shape[0] > 0 and wet[i] == 1:
                gz += real(wp.dot(single(gradient[i, w]), z))
        z_out[i, w] = z
    partial_out[0, c, w] = rz
    partial_out[1, c, w] = gz
