"""The linear system of a step of Newton's method, by the threads of a block: what contact, compliance and
liquid make of the coordinates that touch."""

import warp as wp

from ..block import block_rank, block_sum, sync
from ..types import mat33, narrow, real, vec3, vec6
from .bodies import move_nodes, number_bodies
from .elimination import eliminate
from .lanes import add_row, add_rows, begin_row, dot_column, gather_rows, keep_rows, sum_rows
from .states import Linear
from .structs import DF, DU, TRY, Constants, F, G, Scratch


@wp.func
def gather_load(w: int, t: int, n: int, p: int, c: Constants, s: Scratch):
    """Lists what of vector[p] over n coordinates is not zero, since most of it is; how much that is, and its
    product with `give_at`."""
    each = (n + wp.block_dim() - 1) / wp.block_dim()
    first = t * each
    last = wp.min(first + each, n)
    own = real(0.0)
    count = int(0)
    for a in range(first, last):
        f = s.vector[w, p, a]
        if f != real(0.0):
            count += 1
            own += c.give_at[s.coordinate[w, a]] * f
    rank = block_rank(count)
    at = rank[0]
    for a in range(first, last):
        f = s.vector[w, p, a]
        if f != real(0.0):
            s.loaded[w, at] = s.coordinate[w, a]
            s.loaded_place[w, at] = a
            s.load[w, at] = float(f)
            at += 1
    own = block_sum(own)  # its barriers make what was written readable
    return rank[1], own


@wp.func
def _gather(w: int, m: int, row: int, count: int, n: int, c: Constants, s: Scratch):
    """`gather_rows` of the candidates' m coordinates and of n columns."""
    gather_rows(
        c.compliance, w, m, s.coordinate, row, count, s.ready, s.between, n, s.column_place, s.columns
    )


@wp.func
def multiply(
    w: int, t: int, nnode: int, n: int, p: int, out: int, shifted: int, l: Linear, c: Constants, s: Scratch
):
    """vector[out] = W vector[p] over n coordinates, of outer nodes relative to their bodies, which give way;
    with `shifted` besides where the bulge alone puts them."""
    count, swollen = gather_load(w, t, n, p, c, s)
    push = l.bulk_stiffness * l.swell * l.scale * swollen
    if shifted == 1:
        push += l.bulk_stiffness * l.swell * l.bulge
    if wp.block_dim() == 1:
        for a in range(count):
            _gather(w, n, s.loaded_place[w, a], 1, 0, c, s)
        sum_rows(s.between, w, n, count, s.loaded_place, s.load, s.sum)
    for j in range(t, n, wp.block_dim()):
        cj = s.coordinate[w, j]
        total = float(0.0)
        if wp.block_dim() == 1:
            total = s.sum[w, j]
        else:
            total = dot_column(c.compliance, cj, w, count, s.loaded, s.load)
        s.vector[w, out, j] = l.scale * real(total) - push * c.give_at[cj]
    sync()
    move_nodes(w, t, nnode, p, out, shifted, s)


@wp.func
def _find_touched(w: int, t: int, nnode: int, nin: int, s: Scratch):
    """Lists what touches; how many outer and inner nodes."""
    n = nnode + nin
    each = (n + wp.block_dim() - 1) / wp.block_dim()
    first = t * each
    last = wp.min(first + each, n)
    outer = int(0)
    inner = int(0)
    for k in range(first, last):
        if k < nnode:
            outer += s.on[w, k]
        else:
            inner += s.on[w, k]
    rank = block_rank(outer)
    rank_in = block_rank(inner)
    at = rank[0] + rank_in[0]
    for k in range(first, last):
        if s.on[w, k] == 1:
            if at < s.touched.shape[1]:
                s.touched[w, at] = k
            at += 1
    sync()
    return rank[1], rank_in[1]


@wp.func
def gather_blocks(w: int, t: int, nnode: int, nin: int, c: Constants, s: Scratch):
    """Lists what touches, and the stiffness of the pairs of outer nodes of which the first does; how many
    outer and inner nodes do, which are not listed where there is no room."""
    outer, inner = _find_touched(w, t, nnode, nin, s)
    room = wp.min(outer, s.touched.shape[1])
    most = s.block.shape[2]
    for m in range(t, room * most, wp.block_dim()):
        k = m / most
        p = s.node[w, s.touched[w, k]]
        e = c.ring_start[p] + m % most
        if e < c.ring_start[p + 1]:
            total = mat33()
            for i in range(c.term_start[e], c.term_start[e + 1]):
                f = c.term[i] / 9
                if s.touch.touching[f, w] == 1:
                    a = (c.term[i] / 3) % 3
                    b = c.term[i] % 3
                    low = wp.min(a, b)
                    total += s.touch.block[6 * f + low * (5 - low) / 2 + wp.max(a, b), w]
            s.block[w, k, m % most] = narrow(total)
    sync()
    nsample = c.sample.shape[0]
    most = s.core_block.shape[2]
    for m in range(t, wp.min(inner, s.touched.shape[1] - room) * most, wp.block_dim()):
        k = m / most
        p = s.core_node[w, s.touched[w, outer + k] - nnode]
        e = c.inner_ring_start[p] + m % most
        if e < c.inner_ring_start[p + 1]:
            stiff = real(0.0)
            for i in range(c.inner_term_start[e], c.inner_term_start[e + 1]):
                f = c.inner_term[i] / 9
                a = (c.inner_term[i] / 3) % 3
                b = c.inner_term[i] % 3
                place = s.near_core[w, f] - 1
                if place >= 0:
                    weight = s.touch.stiffness[w] * c.inner_area[f] / real(nsample)
                    for n in range(nsample):
                        if s.now[w, place, n] < real(0.0):
                            stiff += weight * c.sample[n][a] * c.sample[n][b]
            s.core_block[w, k, m % most] = float(stiff)
    sync()
    return outer, inner


@wp.func
def count_contacts(w: int, t: int, nface: int, c: Constants, s: Scratch):
    """Number of touching samples of the candidates."""
    nsample = c.sample.shape[0]
    own = int(0)
    for k in range(t, nface * nsample, wp.block_dim()):
        f = s.face[w, k / nsample]
        if s.touch.touching[f, w] == 1 and s.touch.trial_geom[f * nsample + k % nsample, w] >= 0:
            own += 1
    return block_rank(own)[1]


@wp.func
def coordinate_at(w: int, k: int, outer: int, nnode: int, s: Scratch):
    """The coordinate among the candidates of equation k."""
    if k < 3 * outer:
        return 3 * s.touched[w, k / 3] + k % 3
    return 3 * nnode + s.touched[w, outer + k - 3 * outer] - nnode


@wp.func
def _fill_by_rows(
    w: int, outer: int, inner: int, wide: int, nnode: int, nin: int, soft: float, lumped: int, scale: float,
    c: Constants, s: Scratch,
):  # fmt: skip
    """The matrix of `fill_contact` by one thread."""
    n = 3 * outer + inner
    m = 3 * nnode + nin
    keep_rows(w, n, s.column_place, s.last_column, m, 1, s.ready)
    for i in range(n):
        begin_row(s.matrix, w, n, wide, i, soft * s.held[w, i], s.push)
    for k in range(outer):
        p = s.node[w, s.touched[w, k]]
        for e in range(c.ring_start[p], wp.where(lumped == 1, c.ring_start[p] + 1, c.ring_start[p + 1])):
            block = s.block[w, k, e - c.ring_start[p]]
            if wp.ddot(block, block) > 0.0:
                row = 3 * wp.where(lumped == 1, s.touched[w, k], s.place[w, c.ring[e]])
                _gather(w, m, row, 3, n, c, s)
                add_rows(s.matrix, w, n, wide, 3 * k, scale * block, s.columns, row)
    for k in range(inner):
        i = 3 * outer + k
        place = s.column_place[w, i]
        p = s.core_node[w, place - 3 * nnode]
        for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
            one = s.core_block[w, k, e - c.inner_ring_start[p]]
            row = 3 * nnode + s.core_place[w, c.inner_ring[e]]
            if lumped == 1:
                one = wp.where(row == place, float(s.stiff[w, place - 3 * nnode]), 0.0)
            if one != 0.0:
                _gather(w, m, row, 1, n, c, s)
                add_row(s.matrix, w, n, wide, i, scale * one, s.columns, row)


@wp.func
def fill_contact(
    w: int, t: int, outer: int, inner: int, wide: int, nnode: int, nin: int, soft: float, lumped: int,
    l: Linear, c: Constants, s: Scratch,
):  # fmt: skip
    """1 + D W over the outer and inner nodes that touch, in rows of length `wide`, D being softer by a
    factor. lumped: whether D is diagonal, its blocks being the first of each node."""
    n = 3 * outer + inner
    scale = soft * float(l.scale)
    pressed = float(l.bulk_stiffness * l.swell * l.scale)
    for i in range(t, n, wp.block_dim()):
        place = coordinate_at(w, i, outer, nnode, s)
        at = s.coordinate[w, place]
        s.column[w, i] = at
        s.column_place[w, i] = place
        s.push[w, i] = pressed * float(c.give_at[at])
        held = float(0.0)  # against the liquid's pressure
        if i < 3 * outer and lumped == 1:
            q = at - i % 3
            give = wp.vec3(float(c.give_at[q]), float(c.give_at[q + 1]), float(c.give_at[q + 2]))
            held = wp.dot(s.block[w, i / 3, 0][i % 3], give)
        elif i < 3 * outer:
            p = s.node[w, s.touched[w, i / 3]]
            for e in range(c.ring_start[p], c.ring_start[p + 1]):
                q = 3 * c.ring[e]
                give = wp.vec3(float(c.give_at[q]), float(c.give_at[q + 1]), float(c.give_at[q + 2]))
                held += wp.dot(s.block[w, i / 3, e - c.ring_start[p]][i % 3], give)
        elif lumped == 1:
            held = float(s.stiff[w, place - 3 * nnode]) * float(c.give_at[at])
        else:
            p = s.core_node[w, place - 3 * nnode]
            for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
                one = s.core_block[w, i - 3 * outer, e - c.inner_ring_start[p]]
                held += one * float(c.give_at[3 * c.node.shape[0] + c.inner_ring[e]])
        s.held[w, i] = held
    sync()
    if wp.block_dim() == 1:
        _fill_by_rows(w, outer, inner, wide, nnode, nin, soft, lumped, scale, c, s)
        return
    for m in range(t, outer * n, wp.block_dim()):
        k = m / n
        j = m % n
        at = s.column[w, j]
        p = s.node[w, s.touched[w, k]]
        begin = c.ring_start[p]
        end = c.ring_start[p + 1]
        if lumped == 1:
            end = begin + 1
        total = wp.vec3()
        for e in range(begin, end):
            q = 3 * wp.where(lumped == 1, p, c.ring[e])
            v = wp.vec3(c.compliance[q, at], c.compliance[q + 1, at], c.compliance[q + 2, at])
            total += s.block[w, k, e - begin] * v
        for a in range(3):
            i = 3 * k + a
            value = scale * total[a] - soft * s.held[w, i] * s.push[w, j]
            s.matrix[w, i * wide + j] = value + wp.where(i == j, 1.0, 0.0)
    for m in range(t, inner * n, wp.block_dim()):
        i = 3 * outer + m / n
        j = m % n
        at = s.column[w, j]
        value = float(0.0)
        if lumped == 1:
            stiff = float(s.stiff[w, coordinate_at(w, i, outer, nnode, s) - 3 * nnode])
            value = stiff * c.compliance[s.column[w, i], at]
        else:
            p = s.column[w, i] - 3 * c.node.shape[0]
            for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
                one = s.core_block[w, i - 3 * outer, e - c.inner_ring_start[p]]
                value += one * c.compliance[3 * c.node.shape[0] + c.inner_ring[e], at]
        value = scale * value - soft * s.held[w, i] * s.push[w, j]
        s.matrix[w, i * wide + j] = value + wp.where(i == j, 1.0, 0.0)


@wp.func
def _fill_bodies(
    w: int, t: int, outer: int, equations: int, wide: int, soft: float, c: Constants, s: Scratch
):
    """What the bodies add to `solve_system`: columns for how contact resists their motions, and rows for how
    forces on the nodes move them."""
    b = s.bodies
    bodies = s.borders[w] / 6
    for m in range(t, outer * bodies, wp.block_dim()):
        k = m / bodies
        column = 6 * (m % bodies)
        p = s.node[w, s.touched[w, k]]
        push = wp.mat33()
        turn = wp.mat33()
        for e in range(c.ring_start[p], c.ring_start[p + 1]):
            near = s.place[w, c.ring[e]]
            if near >= 0:
                if b.column[s.group[w, near], w] == column:
                    block = s.block[w, k, e - c.ring_start[p]]
                    push += block
                    turn += block * wp.skew(wp.vec3(s.arm[w, near]))
        for a in range(3):
            begin = (3 * k + a) * wide + equations + column
            for i in range(3):
                s.matrix[w, begin + i] = -push[a, i]
                s.matrix[w, begin + 3 + i] = turn[a, i]
    for h in range(wp.where(bodies > 0, b.compliance.shape[0], 0)):
        if b.column[h, w] >= 0:
            begin = equations + b.column[h, w]
            for j in range(t, wide, wp.block_dim()):
                moved = vec6()
                if j < 3 * outer:
                    at = s.touched[w, j / 3]
                    unit = vec3()
                    unit[j % 3] = real(1.0)
                    turned = wp.cross(s.arm[w, at], unit)
                    load = vec6(unit[0], unit[1], unit[2], turned[0], turned[1], turned[2])
                    moved = real(soft) * (b.compliance[h, s.group[w, at], w] * load)
                for i in range(6):
                    value = float(moved[i])
                    if j == begin + i:
                        value = 1.0
                    s.matrix[w, (begin + i) * wide + j] = value


@wp.func
def solve_system(
    w: int, t: int, nnode: int, nin: int, viscosity: real, moved: int, l: Linear, c: Constants, s: Scratch
):
    """(1 + D W) df = g - f, of skin and bodies that are stiffer by the viscosity, and W df; whether that can
    be, and how many equations it took. The motions of the bodies are unknowns of their own: df moves them,
    and D resists that. With `moved` D resists besides that the nodes move by vector[TRY]."""
    n = 3 * nnode + nin
    softer = real(1.0) / (real(1.0) + viscosity)
    outer, inner = gather_blocks(w, t, nnode, nin, c, s)
    equations = 3 * outer + inner
    number_bodies(w, t, wp.min(outer, s.touched.shape[1]), s)
    wide = equations + s.borders[w] + 1  # of a row, the right-hand side being its last entry
    if outer + inner > s.touched.shape[1] or wide * wide > s.matrix.shape[1]:
        return 0, 0
    # what touches no more goes at once
    for k in range(t, nnode, wp.block_dim()):
        for a in range(3):
            j = 3 * k + a
            s.vector[w, DF, j] = wp.where(s.on[w, k] == 1, real(0.0), -s.vector[w, F, j])
    for k in range(t, nin, wp.block_dim()):
        j = 3 * nnode + k
        s.vector[w, DF, j] = wp.where(s.on[w, nnode + k] == 1, real(0.0), -s.vector[w, F, j])
    sync()
    multiply(w, t, nnode, n, DF, DU, 0, l, c, s)
    for j in range(t, wp.where(moved == 1, n, 0), wp.block_dim()):
        s.vector[w, DU, j] = s.vector[w, DU, j] + s.vector[w, TRY, j]
    sync()
    if equations > 0:
        soft = float(softer)
        fill_contact(w, t, outer, inner, wide, nnode, nin, soft, 0, l, c, s)
        for k in range(t, outer, wp.block_dim()):
            p = s.node[w, s.touched[w, k]]
            total = wp.vec3()
            for e in range(c.ring_start[p], c.ring_start[p + 1]):
                near = s.place[w, c.ring[e]]
                if near >= 0:
                    v = wp.vec3()
                    for a in range(3):
                        v[a] = float(s.vector[w, DU, 3 * near + a])
                    total += s.block[w, k, e - c.ring_start[p]] * v
            for a in range(3):
                at = 3 * s.touched[w, k] + a
                value = float(s.vector[w, G, at] - s.vector[w, F, at]) - soft * total[a]
                s.matrix[w, (3 * k + a + 1) * wide - 1] = value
        for k in range(t, inner, wp.block_dim()):
            at = coordinate_at(w, 3 * outer + k, outer, nnode, s)
            p = s.core_node[w, at - 3 * nnode]
            value = float(0.0)
            for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
                near = s.core_place[w, c.inner_ring[e]]
                if near >= 0:
                    one = s.core_block[w, k, e - c.inner_ring_start[p]]
                    value += one * float(s.vector[w, DU, 3 * nnode + near])
            value = float(s.vector[w, G, at] - s.vector[w, F, at]) - soft * value
            s.matrix[w, (3 * outer + k + 1) * wide - 1] = value
            for j in range(equations, wide - 1):
                s.matrix[w, (3 * outer + k) * wide + j] = 0.0
        _fill_bodies(w, t, outer, equations, wide, soft, c, s)
        if eliminate(s.matrix, w, wide - 1, 1) == 0:
            return 0, equations
        for k in range(t, equations, wp.block_dim()):
            at = coordinate_at(w, k, outer, nnode, s)
            s.vector[w, DF, at] = real(s.matrix[w, k * wide + wide - 1])
        sync()
    if viscosity > real(0.0):
        for j in range(t, n, wp.block_dim()):
            s.vector[w, DF, j] = softer * s.vector[w, DF, j]
        sync()
    multiply(w, t, nnode, n, DF, DU, 0, l, c, s)
    return 1, equations
