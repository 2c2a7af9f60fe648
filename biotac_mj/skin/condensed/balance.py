"""The balance of one skin, by the threads of a block: Newton's method on the contact law over the
candidates.

Where friction, or a skin that snaps, leads Newton's method round in circles, the skin creeps: each iteration
is a step of time of rubber with viscosity, which resists its motion as rubber stiffer by the lag would. It
slides and snaps to where real skin comes to rest; near there the steps grow and are Newton's again, so what
is found is a balance without viscosity."""

import functools

import warp as wp

from ..contact.faces import Laws
from ..contact.posed import Geoms
from ..contact.touch import contact_kernels
from ..contact.watch import near_geoms
from ..types import mat33, narrow, real, vec3
from .lanes import block_rank, block_sum, eliminate, fill_row, sync
from .structs import BACK, DF, DU, TRY, Constants, F, G, Scratch, U

__all__ = [
    "Contact",
    "Linear",
    "balance",
    "coordinate_at",
    "count_contacts",
    "entry_of",
    "gather_blocks",
    "gather_load",
    "multiply",
]

wp.set_module_options({"enable_backward": False})

_TOLERANCE = wp.constant(real(1e-4))  # of the residual: the error of single steps is heard as chatter
# at an edge of a mesh the law's force jumps, and what balances it may lie in between: so much may be left
# where a search along a step has caught the jump so closely, as a share of the tolerance
_ROUGH, _CAUGHT = (wp.constant(real(x)) for x in (0.05, 0.1))
_MAX_NEWTON, _SLOW, _LENGTHS = (wp.constant(i) for i in (200, 8, 10))
_LAG, _QUICKER, _SLOWER = (wp.constant(real(x)) for x in (1.0, 3.0, 4.0))
_DEAR = wp.constant(real(80.0))  # equations that cost as much as an evaluation; twice as many, four
_AT_ONCE, _FIXED = (wp.constant(real(x)) for x in (0.01, 1e5))


@wp.struct
class Contact:
    """What a `ContactState` holds, and of the world's material."""

    stiffness: wp.array(dtype=real)
    laws: Laws
    x_last: wp.array2d(dtype=vec3)
    anchor_geom: wp.array2d(dtype=int)
    anchor: wp.array2d(dtype=vec3)
    corner: wp.array2d(dtype=vec3)
    block: wp.array2d(dtype=mat33)
    touching: wp.array2d(dtype=int)
    geom: wp.array2d(dtype=int)
    trial: wp.array2d(dtype=vec3)
    force: wp.array2d(dtype=vec3)
    kept: wp.array2d(dtype=int)


@wp.struct
class Linear:
    """The skin of a solve, u = W f + shift: W = scale * compliance - swell share a a'."""

    scale: real  # softening over E [1/Pa]
    share: real  # pressure per volume [Pa/m^3]
    swell: real  # swelling over E [1/Pa]
    bulge: real  # [m^3]


@wp.func
def gather_load(w: int, t: int, threads: int, n: int, p: int, c: Constants, s: Scratch):
    """Lists what of vector[p] over n coordinates is not zero, since most of it is; how much that is, and its
    product with `give_at`."""
    each = (n + threads - 1) / threads
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
            s.load[w, at] = float(f)
            at += 1
    own = block_sum(own)  # its barriers make what was written readable
    return rank[1], own


@wp.func
def multiply(
    w: int,
    t: int,
    threads: int,
    n: int,
    p: int,
    out: int,
    shifted: int,
    l: Linear,
    c: Constants,
    s: Scratch,
):
    """vector[out] = W vector[p] over n coordinates, and with `shifted` where the bulge alone puts them."""
    count, swollen = gather_load(w, t, threads, n, p, c, s)
    push = l.share * l.swell * l.scale * swollen
    if shifted == 1:
        push += l.share * l.swell * l.bulge
    whole = count - count % 4
    for j in range(t, n, threads):
        cj = s.coordinate[w, j]
        total = float(0.0)
        for a in range(0, whole, 4):  # four loads at once
            total += (
                c.compliance[s.loaded[w, a], cj] * s.load[w, a]
                + c.compliance[s.loaded[w, a + 1], cj] * s.load[w, a + 1]
                + c.compliance[s.loaded[w, a + 2], cj] * s.load[w, a + 2]
                + c.compliance[s.loaded[w, a + 3], cj] * s.load[w, a + 3]
            )
        for a in range(whole, count):
            total += c.compliance[s.loaded[w, a], cj] * s.load[w, a]
        s.vector[w, out, j] = l.scale * real(total) - push * c.give_at[cj]
    sync()


@wp.func
def _find_touched(w: int, t: int, threads: int, nnode: int, nin: int, s: Scratch):
    """Lists what touches; how many outer and inner nodes."""
    n = nnode + nin
    each = (n + threads - 1) / threads
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
def gather_blocks(
    w: int, t: int, threads: int, nnode: int, nin: int, touch: Contact, c: Constants, s: Scratch
):
    """Lists what touches, and the stiffness of the pairs of outer nodes of which the first does; how many
    outer and inner nodes do, which are not listed where there is no room."""
    outer, inner = _find_touched(w, t, threads, nnode, nin, s)
    room = wp.min(outer, s.touched.shape[1])
    most = s.block.shape[2]
    for m in range(t, room * most, threads):
        k = m / most
        p = s.node[w, s.touched[w, k]]
        e = c.ring_start[p] + m % most
        if e < c.ring_start[p + 1]:
            total = mat33()
            for i in range(c.term_start[e], c.term_start[e + 1]):
                f = c.term[i] / 9
                if touch.touching[f, w] == 1:
                    a = (c.term[i] / 3) % 3
                    b = c.term[i] % 3
                    low = wp.min(a, b)
                    total += touch.block[6 * f + low * (5 - low) / 2 + wp.max(a, b), w]
            s.block[w, k, m % most] = narrow(total)
    sync()
    for k in range(t, room, threads):
        p = s.node[w, s.touched[w, k]]
        held = wp.vec3()
        for e in range(c.ring_start[p], c.ring_start[p + 1]):
            q = 3 * c.ring[e]
            give = wp.vec3(float(c.give_at[q]), float(c.give_at[q + 1]), float(c.give_at[q + 2]))
            held += s.block[w, k, e - c.ring_start[p]] * give
        for a in range(3):
            s.swollen[w, 3 * k + a] = held[a]
    nsample = c.sample.shape[0]
    for k in range(t, wp.min(inner, s.touched.shape[1] - room), threads):
        p = s.core_node[w, s.touched[w, outer + k] - nnode]
        for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
            stiff = real(0.0)
            for m in range(c.inner_term_start[e], c.inner_term_start[e + 1]):
                f = c.inner_term[m] / 9
                a = (c.inner_term[m] / 3) % 3
                b = c.inner_term[m] % 3
                place = s.near_core[w, f] - 1
                if place >= 0:
                    share = touch.stiffness[w] * c.inner_area[f] / real(nsample)
                    for n in range(nsample):
                        if s.now[w, place, n] < real(0.0):
                            stiff += share * c.sample[n][a] * c.sample[n][b]
            s.core_block[w, k, e - c.inner_ring_start[p]] = float(stiff)
    sync()
    return outer, inner


@wp.func
def count_contacts(w: int, t: int, threads: int, nface: int, touch: Contact, c: Constants, s: Scratch):
    """How many samples of the candidates touch."""
    nsample = c.sample.shape[0]
    own = int(0)
    for k in range(t, nface * nsample, threads):
        f = s.face[w, k / nsample]
        if touch.touching[f, w] == 1 and touch.geom[f * nsample + k % nsample, w] >= 0:
            own += 1
    return block_rank(own)[1]


@wp.func
def coordinate_at(w: int, k: int, outer: int, nnode: int, s: Scratch):
    """The coordinate among the candidates of equation k."""
    if k < 3 * outer:
        return 3 * s.touched[w, k / 3] + k % 3
    return 3 * nnode + s.touched[w, outer + k - 3 * outer] - nnode


@wp.func
def entry_of(a: int, b: int, l: Linear, c: Constants):
    """Entry of W between contact coordinates a and b."""
    push = l.share * l.swell * l.scale * c.give_at[a] * c.give_at[b]
    return float(l.scale) * c.compliance[a, b] - float(push)


@wp.func
def _fill_rows(
    w: int,
    outer: int,
    inner: int,
    nnode: int,
    soft: float,
    scale: float,
    pressed: float,
    c: Constants,
    s: Scratch,
):
    """The matrix of `_solve`, row by row, for one thread."""
    n = 3 * outer + inner
    for j in range(n):
        s.column[w, j] = s.coordinate[w, coordinate_at(w, j, outer, nnode, s)]
    for i in range(n):
        for j in range(n):
            s.matrix[w, i * (n + 1) + j] = 0.0
    for k in range(outer):
        p = s.node[w, s.touched[w, k]]
        for e in range(c.ring_start[p], c.ring_start[p + 1]):
            block = s.block[w, k, e - c.ring_start[p]]
            for a in range(3):
                for b in range(3):
                    if block[a, b] != 0.0:
                        fill_row(
                            s.matrix, w, n, 3 * k + a, block[a, b], c.compliance, 3 * c.ring[e] + b, s.column
                        )
    for k in range(inner):
        p = s.core_node[w, coordinate_at(w, 3 * outer + k, outer, nnode, s) - 3 * nnode]
        for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
            stiff = s.core_block[w, k, e - c.inner_ring_start[p]]
            if stiff != 0.0:
                row = 3 * c.node.shape[0] + c.inner_ring[e]
                fill_row(s.matrix, w, n, 3 * outer + k, stiff, c.compliance, row, s.column)
    for i in range(n):
        held = float(0.0)
        if i < 3 * outer:
            held = s.swollen[w, i]
        else:
            p = s.core_node[w, coordinate_at(w, i, outer, nnode, s) - 3 * nnode]
            for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
                stiff = s.core_block[w, i - 3 * outer, e - c.inner_ring_start[p]]
                held += stiff * float(c.give_at[3 * c.node.shape[0] + c.inner_ring[e]])
        begin = i * (n + 1)
        for j in range(n):
            push = pressed * float(c.give_at[s.column[w, j]])
            s.matrix[w, begin + j] = soft * (scale * s.matrix[w, begin + j] - held * push)
        s.matrix[w, begin + i] = s.matrix[w, begin + i] + 1.0


@wp.func
def _solve(
    w: int,
    t: int,
    threads: int,
    nnode: int,
    nin: int,
    lag: real,
    l: Linear,
    touch: Contact,
    c: Constants,
    s: Scratch,
):
    """(1 + D W) df = g - f, of skin that is stiffer by the lag, and W df; whether that can be, and how many
    equations it took."""
    n = 3 * nnode + nin
    softer = real(1.0) / (real(1.0) + lag)
    outer, inner = gather_blocks(w, t, threads, nnode, nin, touch, c, s)
    equations = 3 * outer + inner
    if outer + inner > s.touched.shape[1] or equations * (equations + 1) > s.matrix.shape[1]:
        return 0, 0
    # what touches no more goes at once
    for k in range(t, nnode, threads):
        for a in range(3):
            j = 3 * k + a
            s.vector[w, DF, j] = wp.where(s.on[w, k] == 1, real(0.0), -s.vector[w, F, j])
    for k in range(t, nin, threads):
        j = 3 * nnode + k
        s.vector[w, DF, j] = wp.where(s.on[w, nnode + k] == 1, real(0.0), -s.vector[w, F, j])
    sync()
    multiply(w, t, threads, n, DF, DU, 0, l, c, s)
    if equations > 0:
        wide = equations + 1
        soft = float(softer)
        scale = float(l.scale)
        pressed = float(l.share * l.swell * l.scale)
        first = int(0)  # column of a row that a thread of many forms
        if threads == 1:
            _fill_rows(w, outer, inner, nnode, soft, scale, pressed, c, s)
            first = equations
        count = wide - first
        for m in range(t, outer * count, threads):
            k = m / count
            j = first + m % count
            p = s.node[w, s.touched[w, k]]
            total = wp.vec3()
            cj = int(0)
            if j < equations:
                cj = s.coordinate[w, coordinate_at(w, j, outer, nnode, s)]
            for e in range(c.ring_start[p], c.ring_start[p + 1]):
                q = c.ring[e]
                v = wp.vec3()
                for a in range(3):
                    if j < equations:
                        v[a] = c.compliance[3 * q + a, cj]
                    elif s.place[w, q] >= 0:
                        v[a] = float(s.vector[w, DU, 3 * s.place[w, q] + a])
                total += s.block[w, k, e - c.ring_start[p]] * v
            push = float(0.0)
            if j < equations:
                total = scale * total
                push = pressed * float(c.give_at[cj])
            for a in range(3):
                i = 3 * k + a
                value = soft * (total[a] - s.swollen[w, i] * push)
                if j == equations:
                    at = 3 * s.touched[w, k] + a
                    value = float(s.vector[w, G, at] - s.vector[w, F, at]) - value
                elif j == i:
                    value += 1.0
                s.matrix[w, i * wide + j] = value
        for m in range(t, inner * count, threads):
            k = 3 * outer + m / count
            j = first + m % count
            at = coordinate_at(w, k, outer, nnode, s)
            p = s.core_node[w, at - 3 * nnode]
            cj = int(0)
            if j < equations:
                cj = s.coordinate[w, coordinate_at(w, j, outer, nnode, s)]
            value = float(0.0)
            for e in range(c.inner_ring_start[p], c.inner_ring_start[p + 1]):
                q = c.inner_ring[e]
                one = float(0.0)
                if j < equations:
                    one = entry_of(3 * c.node.shape[0] + q, cj, l, c)
                elif s.core_place[w, q] >= 0:
                    one = float(s.vector[w, DU, 3 * nnode + s.core_place[w, q]])
                value += s.core_block[w, k - 3 * outer, e - c.inner_ring_start[p]] * one
            value = soft * value
            if j == equations:
                value = float(s.vector[w, G, at] - s.vector[w, F, at]) - value
            elif j == k:
                value += 1.0
            s.matrix[w, k * wide + j] = value
        if eliminate(s.matrix, w, equations, 1) == 0:
            return 0, equations
        for k in range(t, equations, threads):
            at = coordinate_at(w, k, outer, nnode, s)
            s.vector[w, DF, at] = real(s.matrix[w, k * wide + equations])
        sync()
    if lag > real(0.0):
        for j in range(t, n, threads):
            s.vector[w, DF, j] = softer * s.vector[w, DF, j]
        sync()
    multiply(w, t, threads, n, DF, DU, 0, l, c, s)
    return 1, equations


@functools.cache
def balance(shapes: str) -> wp.Function:
    """Newton's method of skins that meet such shapes, see `contact.touch`."""
    touch_face = contact_kernels(False, False, shapes).touch_face

    @wp.func
    def evaluate(
        w: int,
        t: int,
        threads: int,
        nface: int,
        ncore: int,
        nnode: int,
        nin: int,
        at: int,
        coupled: int,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        c: Constants,
        s: Scratch,
    ):
        """Forces vector[G] of the contact law at displacements vector[at] of the candidates, and which
        touch."""
        sync()
        for k in range(t, nnode, threads):
            i = c.node[s.node[w, k]]
            u = vec3(s.vector[w, at, 3 * k], s.vector[w, at, 3 * k + 1], s.vector[w, at, 3 * k + 2])
            x[i, w] = c.rest[i, 0] + u
        sync()
        for k in range(t, nface, threads):
            f = s.face[w, k]
            face = c.face[f]
            touch.touching[f, w] = 0
            count, asked = near_geoms(x[face[0], w], x[face[1], w], x[face[2], w], w, geoms)
            if count > 0:
                touch_face(
                    f, w, c.face, c.area, c.sample, touch.stiffness[w], c.stick_ratio, geoms, touch.laws, x,
                    touch.x_last, touch.anchor_geom, touch.anchor, coupled, asked, touch.corner, touch.block,
                    touch.touching, touch.geom, touch.geom, touch.trial, touch.force,
                )  # fmt: skip
        sync()
        for k in range(t, nnode, threads):
            i = c.node[s.node[w, k]]
            total = vec3()
            on = int(0)
            for m in range(c.start[i], c.start[i + 1]):
                if touch.touching[c.slot[m] / 3, w] == 1:
                    total += touch.corner[c.slot[m], w]
                    on = 1
            s.on[w, k] = on
            for a in range(3):
                s.vector[w, G, 3 * k + a] = total[a]
        nsample = c.sample.shape[0]
        for k in range(t, ncore * nsample, threads):
            place = k / nsample
            face = c.inner_face[s.core_face[w, place]]
            moved = vec3()
            for a in range(3):
                q = c.inner_number[face[a]]
                if q >= 0:
                    j = 3 * nnode + s.core_place[w, q]
                    moved[a] = s.vector[w, at, j] - s.vector[w, BACK, j]
            n = k % nsample
            s.now[w, place, n] = s.gap[w, place, n] + wp.dot(c.sample[n], moved)
        sync()
        for k in range(t, nin, threads):
            push = real(0.0)
            stiff = real(0.0)
            v = c.inner[s.core_node[w, k]]
            for m in range(c.inner_start[v], c.inner_start[v + 1]):
                f = c.inner_slot[m] / 3
                place = s.near_core[w, f] - 1
                if place >= 0:
                    share = touch.stiffness[w] * c.inner_area[f] / real(nsample)
                    for n in range(nsample):
                        gap = s.now[w, place, n]
                        if gap < real(0.0):
                            b = c.sample[n][c.inner_slot[m] % 3]
                            push -= share * gap * b
                            stiff += share * b
            s.vector[w, G, 3 * nnode + k] = push
            s.stiff[w, k] = stiff
            s.on[w, nnode + k] = wp.where(stiff > real(0.0), 1, 0)
        sync()

    @wp.func
    def newton(
        w: int,
        t: int,
        threads: int,
        nface: int,
        ncore: int,
        nnode: int,
        nin: int,
        most: real,
        l: Linear,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        c: Constants,
        s: Scratch,
    ):
        """Balanced forces vector[F] from those there, displacements vector[U], and the contact there with a
        symmetric tangent; whether that was found, the error, how many iterations it took, and its cost, an
        evaluation's being one. Where it may cost nothing it is the contact of the forces as they are."""
        n = 3 * nnode + nin
        multiply(w, t, threads, n, F, U, 1, l, c, s)
        lag = real(0.0)
        alpha = real(1.0)
        error = real(wp.inf)
        last = error
        slope = real(0.0)
        work = real(0.0)
        low = real(0.0)
        high = real(-1.0)
        at_low = real(0.0)
        at_high = real(0.0)
        found = int(0)
        iterations = int(0)
        spent = real(0.0)
        tried = int(0)
        caught = real(1.0)  # how long the piece of the last step is in which the residual turned round
        at = int(U)
        searching = int(0)
        ends = int(0)
        on = int(1)
        # one place that evaluates, since the compiler copies it to each: first, along a step, in the end
        while on == 1:
            evaluate(w, t, threads, nface, ncore, nnode, nin, at, 1 - ends, geoms, x, touch, c, s)
            spent += real(1.0)
            steps = 1 - searching  # whether a step is to be found
            if ends == 1:
                on = 0
                steps = 0
            if searching == 1:
                tried += 1
                mine = real(0.0)
                for j in range(t, n, threads):
                    f = s.vector[w, F, j] + alpha * s.vector[w, DF, j]
                    mine += (s.vector[w, G, j] - f) * s.vector[w, DU, j]
                now = wp.sign(slope) * block_sum(mine) - alpha * lag * work
                good = wp.where(wp.abs(now) <= real(0.5) * wp.abs(slope), 1, 0)
                if good == 1 or (now > real(0.0) and high < real(0.0)) or tried >= _LENGTHS:
                    searching = 0
                    steps = 1
                    caught = real(1.0)
                    if good == 0 and high >= real(0.0):
                        caught = high - low
                    for j in range(t, n, threads):
                        s.vector[w, F, j] = s.vector[w, F, j] + alpha * s.vector[w, DF, j]
                        s.vector[w, U, j] = s.vector[w, TRY, j]
                    sync()
                    if good == 1 and alpha == real(1.0) and (lag > real(0.0) or error < last):
                        good = 2
                    # a step after which there is more left to do than was foreseen is none too long
                    if good == 0 and alpha == real(1.0) and now > real(0.0) and lag > real(0.0):
                        good = 2
                    if iterations > _SLOW and good < 2:
                        lag = wp.max(_SLOWER * lag, _LAG)
                    elif lag > _AT_ONCE and error > _TOLERANCE:
                        lag = lag / _QUICKER
                    else:
                        lag = real(0.0)
                else:
                    if now > real(0.0):
                        low = alpha
                        at_low = now
                        at_high = real(0.5) * at_high
                    else:
                        if high >= real(0.0):
                            at_low = real(0.5) * at_low
                        high = alpha
                        at_high = now
                    alpha = low + (high - low) * at_low / (at_low - at_high)
                    edge = real(0.05) * (high - low)
                    alpha = wp.min(wp.max(alpha, low + edge), high - edge)
            while steps == 1:
                steps = 0
                last = error
                good = int(0)
                if iterations < _MAX_NEWTON and spent < most and lag <= _FIXED:
                    good, equations = _solve(w, t, threads, nnode, nin, lag, l, touch, c, s)
                    dear = real(equations) / _DEAR
                    spent += dear * dear
                if good == 1:
                    own = vec3()
                    for j in range(t, n, threads):
                        f = s.vector[w, F, j]
                        df = s.vector[w, DF, j]
                        du = s.vector[w, DU, j]
                        r = s.vector[w, G, j] - f
                        own += vec3(r * du, df * du, (f + df) * (s.vector[w, U, j] + du))
                    total = block_sum(own)
                    slope = total[0]
                    work = total[1]
                    left = wp.max(wp.abs(slope), work)
                    error = (real(1.0) + lag) * wp.sqrt(left / (wp.abs(total[2]) + real(1e-14)))
                    if not wp.isfinite(error):
                        good = 0
                    elif error < _ROUGH and error * caught < _CAUGHT * _TOLERANCE and lag == real(0.0):
                        found = 1
                        good = 0
                    elif error < _TOLERANCE and lag == real(0.0):
                        found = 1
                        good = 0
                        for j in range(t, n, threads):
                            s.vector[w, F, j] = s.vector[w, F, j] + s.vector[w, DF, j]
                            s.vector[w, U, j] = s.vector[w, U, j] + s.vector[w, DU, j]
                        sync()
                    elif lag > real(0.0) and slope <= real(0.0):
                        iterations += 1
                        lag = _SLOWER * lag
                        good = 0
                        steps = 1
                    else:
                        iterations += 1
                        searching = 1
                        tried = 0
                        alpha = real(1.0)
                        low = real(0.0)
                        high = real(-1.0)
                        at_low = wp.abs(slope)
                        at_high = real(0.0)
                if good == 0 and steps == 0:
                    ends = 1
                    at = U
            if searching == 1:
                at = TRY
                for j in range(t, n, threads):
                    s.vector[w, TRY, j] = s.vector[w, U, j] + alpha * s.vector[w, DU, j]
        if not wp.isfinite(error):  # no step was made
            error = real(1.0)
        return found, error, iterations, spent

    return newton
