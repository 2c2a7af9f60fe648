"""Woodbury systems of the dense preconditioner, over the liquid and the touching nodes of each world.

The liquid has the first row, each touching node three. D is sparse, and is stored by blocks: the links of a
node to the nodes of its faces, and their springs."""

import warp as wp

from ...kernels import kernel_module
from ..bodies import Bodies
from ..contact.faces import block_index
from ..newton.nodes import SurfaceForces
from ..newton.worlds import Worlds, total_of
from ..types import narrow, real, vec3, vec6
from .right_hand_sides import STIFF, InverseEntries, entry, liquid_scale

kernel_module(__name__)


@wp.kernel
def sum_liquid(
    partial: wp.array3d(dtype=real),
    on: wp.array(dtype=int),
    first: int,
    W_out: wp.array3d(dtype=float),
    u_out: wp.array2d(dtype=float),
):
    """Sums the liquid's row of u and, at first, its diagonal entry of W."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    gy = total_of(partial, 0, w, t)
    gg = total_of(partial, 1, w, t)
    if t == 0:
        u_out[w, 0] = float(gy)
        if first == 1:
            W_out[w, 0, 0] = float(gg)


@wp.kernel
def fill_compliance(
    # In:
    inverse: InverseEntries,
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    has_liquid: int,
    along: wp.array2d(dtype=wp.vec3),
    st: Worlds,
    on: wp.array(dtype=int),
    matrix: wp.array2d(dtype=wp.mat33),
    threads: int,
    # Out:
    W_out: wp.array3d(dtype=float),
):
    """Compliance W between the liquid and the touching nodes, by blocks; `threads` threads for each world."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    n = size[w]
    soft = inverse.scale * float(st.softness[w])
    for p in range(t, n * n, threads):
        i = p // n
        j = p % n
        a = 3 * inverse.free_index[node[i, w]]
        b = 3 * inverse.free_index[node[j, w]]
        row = has_liquid + 3 * i
        column = has_liquid + 3 * j
        block = wp.mat33()  # all reads before the writes, so that no read waits for another
        for k in range(3):
            for l in range(3):
                block[k, l] = entry(inverse, a + k, b + l) * soft
        if matrix.shape[0] > 0:
            block = matrix[node[i, w], w] * block * wp.transpose(matrix[node[j, w], w])
        for k in range(3):
            for l in range(3):
                W_out[w, row + k, column + l] = block[k, l]
        if j == 0 and has_liquid == 1:
            v = along[node[i, w], w]
            for k in range(3):
                W_out[w, 0, row + k] = v[k]
                W_out[w, row + k, 0] = v[k]


@wp.func(inline=True)
def _group_of(
    i: int,
    w: int,
    outer: SurfaceForces,
    group: wp.array2d(dtype=int),
):
    """Group of the body that touches node i; -1: none."""
    found = int(-1)
    for k in range(outer.start[i], outer.start[i + 1]):
        if outer.touching[outer.slot[k] // 3, w] == 1:
            found = wp.max(found, group[outer.slot[k] // 3, w])
    return found


@wp.kernel
def add_bodies(
    # In:
    has_liquid: int,
    outer: SurfaceForces,
    group: wp.array2d(dtype=int),
    b: Bodies,
    x: wp.array2d(dtype=vec3),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    st: Worlds,
    on: wp.array(dtype=int),
    threads: int,
    # In and out:
    W: wp.array3d(dtype=float),
):
    """Adds to W the compliance R A R' of the bodies that touch the nodes."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    n = size[w]
    for p in range(t, n * n, threads):
        i = p // n
        j = p % n
        g = _group_of(node[i, w], w, outer, group)
        h = _group_of(node[j, w], w, outer, group)
        if g >= 0 and h >= 0:
            here = x[node[i, w], w]
            there = x[node[j, w], w]
            A = b.compliance[g, h, w] / (real(1.0) + st.viscosity[w])  # the artificial viscosity of the skin
            for l in range(3):
                unit = vec3()
                unit[l] = real(1.0)
                turn = wp.cross(there, unit)
                m = A * vec6(unit[0], unit[1], unit[2], turn[0], turn[1], turn[2])
                u = vec3(m[0], m[1], m[2]) + wp.cross(vec3(m[3], m[4], m[5]), here)
                for k in range(3):
                    row = has_liquid + 3 * i + k
                    column = has_liquid + 3 * j + l
                    W[w, row, column] = W[w, row, column] + float(u[k])


@wp.func(inline=True)
def contact_stiffness_between(
    i: int,
    j: int,
    w: int,
    surface: SurfaceForces,
):
    """Contact stiffness of a surface between nodes i and j [N/m]."""
    total = wp.mat33()
    for k in range(surface.start[i], surface.start[i + 1]):
        f = surface.slot[k] // 3
        t = surface.face[f]
        b = int(-1)
        for c in range(3):
            if t[c] == j:
                b = c
        if b >= 0:
            if surface.touching[f, w] == 1:
                a = surface.slot[k] % 3
                total += narrow(surface.block[6 * f + block_index(wp.min(a, b), wp.max(a, b)), w])
    return total


@wp.kernel
def fill_stiffness(
    # In:
    outer: SurfaceForces,
    core: SurfaceForces,
    ring: wp.array2d(dtype=int),
    slot: wp.array2d(dtype=int),
    node: wp.array2d(dtype=int),
    size: wp.array(dtype=int),
    on: wp.array(dtype=int),
    # Out:
    link_out: wp.array3d(dtype=int),
    spring_out: wp.array3d(dtype=wp.mat33),
):
    """Blocks of D: the touching nodes that contact couples node s with (-1: none), and their springs."""
    l, s, w = wp.tid()
    if on[w] == 0 or s >= size[w]:
        return
    i = node[s, w]
    j = ring[i, l]
    other = int(-1)
    if j >= 0:
        other = slot[j, w]
    link_out[w, s, l] = other
    if other >= 0:
        K = contact_stiffness_between(i, j, w, outer)
        if core.start.shape[0] > 0:
            K += contact_stiffness_between(i, j, w, core)
        spring_out[w, s, l] = K


@wp.func
def read_block(A: wp.array3d(dtype=float), w: int, row: int, column: int):
    return wp.mat33(
        A[w, row, column], A[w, row, column + 1], A[w, row, column + 2],
        A[w, row + 1, column], A[w, row + 1, column + 1], A[w, row + 1, column + 2],
        A[w, row + 2, column], A[w, row + 2, column + 1], A[w, row + 2, column + 2],
    )  # fmt: skip


def _spring_products(adjoint):
    """Kernel that computes 1 + D X by blocks, or, with `adjoint`, the transpose of X D, so that threads which
    sum one entry of a product with it each read neighbouring numbers. A spring is equal for both of its
    nodes; it may be unsymmetric, as that of slip."""

    @wp.func
    def of_block(K: wp.mat33, X: wp.array3d(dtype=float), w: int, row: int, column: int):
        if wp.static(adjoint):
            return wp.transpose(read_block(X, w, column, row) * K)
        return K * read_block(X, w, row, column)

    @wp.func
    def of_liquid(K: wp.mat33, X: wp.array3d(dtype=float), w: int, row: int):
        if wp.static(adjoint):
            return wp.transpose(K) * wp.vec3(X[w, 0, row], X[w, 0, row + 1], X[w, 0, row + 2])
        return K * wp.vec3(X[w, row, 0], X[w, row + 1, 0], X[w, row + 2, 0])

    @wp.kernel(module=kernel_module(f"{__name__}.{'adjoint' if adjoint else 'product'}"))
    def multiply(
        # In:
        has_liquid: int,
        size: wp.array(dtype=int),
        link: wp.array3d(dtype=int),
        spring: wp.array3d(dtype=wp.mat33),
        X: wp.array3d(dtype=float),
        on: wp.array(dtype=int),
        threads: int,
        # Out:
        out: wp.array3d(dtype=float),
    ):
        w, t = wp.tid()
        if on[w] == 0:
            return
        n = size[w]
        if t == 0 and has_liquid == 1:
            out[w, 0, 0] = wp.static(0.0 if adjoint else 1.0) + STIFF * X[w, 0, 0]
        for p in range(t, n * n, threads):
            i = p // n
            j = p % n
            row = has_liquid + 3 * i
            column = has_liquid + 3 * j
            total = wp.mat33()
            if wp.static(not adjoint):
                if i == j:
                    total = wp.identity(n=3, dtype=float)
            for k in range(link.shape[2]):
                l = link[w, i, k]
                if l >= 0:
                    total += of_block(spring[w, i, k], X, w, has_liquid + 3 * l, column)
            for a in range(3):
                for b in range(3):
                    out[w, row + a, column + b] = total[a, b]
            if has_liquid == 1 and i == 0:
                for b in range(3):
                    if wp.static(adjoint):
                        out[w, 0, column + b] = STIFF * X[w, column + b, 0]
                    else:
                        out[w, 0, column + b] = STIFF * X[w, 0, column + b]
            if has_liquid == 1 and j == 0:
                v = wp.vec3()
                for k in range(link.shape[2]):
                    l = link[w, i, k]
                    if l >= 0:
                        v += of_liquid(spring[w, i, k], X, w, 1 + 3 * l)
                for a in range(3):
                    out[w, row + a, 0] = v[a]

    return multiply


fill_system, multiply_springs = _spring_products(False), _spring_products(True)


@wp.kernel
def contact_forces(
    # In:
    has_liquid: int,
    size: wp.array(dtype=int),
    G: wp.array3d(dtype=float),
    u: wp.array2d(dtype=float),
    norm: wp.array2d(dtype=float),
    st: Worlds,
    on: wp.array(dtype=int),
    # Out:
    q_out: wp.array2d(dtype=float),
    largest_out: wp.array(dtype=float),
):
    """Forces q = G u, and a bound of their size."""
    w, i = wp.tid()
    if on[w] == 0:
        return
    n = has_liquid + 3 * size[w]
    if i >= n:
        return
    total = float(0.0)
    eights = n // 8
    for b in range(eights):
        for k in range(8):  # unrolled: the reads do not wait for each other
            total += G[w, 8 * b + k, i] * u[w, 8 * b + k]
    for k in range(8 * eights, n):
        total += G[w, k, i] * u[w, k]
    q_out[w, i] = total
    bound = wp.abs(total)
    if i < has_liquid:
        bound *= norm[1, w] * liquid_scale(st, w)
    wp.atomic_max(largest_out, w, bound)
