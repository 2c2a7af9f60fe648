"""Bodies that give way while Newton's method seeks the balance of a skin, see `skin.bodies`.

Unknowns are the nodes x and the wrenches y with which the bodies are posed, d = A (y - w0); in balance they
are those of the skin, w. With the tangent D of contact, the bodies' rigid motions R and S = R' D R a step is

    (K + D - D R B R' D) dx = F + D R B (w - y),      dy = (1 + S A)^-1 (w - y + R' D dx),

where B = A (1 + S A)^-1 is symmetric and of rank six for each body: it softens contact, and forces have a
potential as they have without bodies. So the residual gets a term, products of conjugate gradients get one,
and the line search one for its slope. Where the skin is viscous bodies resist as it does: A is less by it.

A skin that is touched begins with such a step, too: from the last balance, where its contact is known, with
the bodies' way from there as a motion that is still to come (`pending`)."""

import functools
import types

import warp as wp

from ...geometry.rigid_warp import motion
from ..bodies import Bodies
from ..contact.faces import Contact, block_index
from ..contact.posed import Geoms, LoadPath
from ..types import Precision, mat33, real, sum_of_block, vec3, vec6
from .worlds import Worlds, total_of

__all__ = [
    "Drag",
    "add_slope",
    "find_unknown_wrenches",
    "begin_pending",
    "begin_bodies",
    "bodies_kernels",
    "end_pending",
    "find_step",
    "measure_drag",
    "find_pending",
    "move_bodies",
    "respond",
    "set_where",
    "settle_bodies",
    "switch_to",
]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Drag:
    """What bodies feel of the skin where it is; a face that touches counts for one group [face, world]."""

    group: wp.array2d(dtype=int)
    skin_wrench: wp.array2d(
        dtype=wp.spatial_vectord
    )  # wrenches of the skin at the last evaluation [group, world]
    off: wp.array2d(dtype=wp.spatial_vectord)  # from those of their poses, where an iteration begins
    step: wp.array2d(dtype=wp.spatial_vectord)  # by which these change in it
    displacement: wp.array2d(dtype=wp.spatial_vectord)  # motions by that
    pending: wp.array2d(dtype=wp.spatial_vectord)  # motions from where geoms are that are not in these
    inverse: wp.array3d(dtype=real)  # of 1 + S A [world, 6 group, 6 group]
    pivot: wp.array2d(dtype=int)  # [world, 6 group]
    looks: wp.array(dtype=int)  # whether it looks ahead [world]
    known: wp.array(dtype=int)  # whether the wrenches are known with which the step began [world]


@wp.kernel
def begin_bodies(wanted: wp.array(dtype=int), touched_by: wp.array2d(dtype=int), b: Bodies, d: Drag):
    """The first try begins with the bodies at their predicted poses; a touched skin looks ahead."""
    g, w = wp.tid()
    if wanted[w] == 1:
        b.posed[g, w] = b.predicted[g, w]
        b.converged[g, w] = b.predicted[g, w]
        b.begun[g, w] = b.predicted[g, w]
    if g == 0:
        d.known[w] = 0
        d.looks[w] = 0
        for k in range(touched_by.shape[0]):
            d.looks[w] = wp.max(d.looks[w], touched_by[k, w])


@wp.kernel
def begin_pending(geoms: Geoms, path: LoadPath, d: Drag, st: Worlds, any_out: wp.array(dtype=int)):
    """Which worlds look ahead, and how far their bodies go."""
    w = wp.tid()
    known = real(0.0)
    for g in range(geoms.count):
        begin = path.pos_start[g, w]
        known += begin[0] + begin[1] + begin[2]
    if st.wanted[w] == 0 or st.asked[w] == 0 or st.guessed[w] == 1 or not wp.isfinite(known):
        d.looks[w] = 0
    if d.looks[w] == 0:
        return
    any_out[0] = 1
    d.known[w] = 1
    st.repeat[w] = real(0.0)
    for g in range(geoms.count):
        d.pending[geoms.group[g], w] = motion(
            path.pos_end[g, w], path.mat_end[g, w], path.pos_start[g, w], path.mat_start[g, w]
        )


@wp.kernel
def find_pending(part: wp.array3d(dtype=real), st: Worlds):
    """Takes the residual of a step that begins where the last one ended. part: residual . z."""
    w, t = wp.tid()
    if st.active[w] == 0:
        return
    rz = total_of(part, 0, w, t)
    if t == 0:
        st.rz[w] = rz
        st.first[w] = rz


@wp.kernel
def switch_to(on: wp.array(dtype=int), out: wp.array(dtype=int)):
    w = wp.tid()
    out[w] = on[w]


@wp.kernel
def end_pending(st: Worlds, d: Drag):
    w = wp.tid()
    st.active[w] = st.asked[w]
    for g in range(d.pending.shape[0]):
        d.pending[g, w] = vec6()


@wp.kernel
def set_where(
    value: wp.array2d(dtype=wp.spatial_vectord),
    on: wp.array(dtype=int),
    out: wp.array2d(dtype=wp.spatial_vectord),
):
    g, w = wp.tid()
    if on[w] == 1:
        out[g, w] = value[g, w]


@wp.kernel
def find_unknown_wrenches(st: Worlds, d: Drag, needs_wrench_out: wp.array(dtype=int)):
    """Worlds that go their way in parts have to know the wrenches with which it begins."""
    w = wp.tid()
    needs_wrench_out[w] = 0
    if st.moving[w] == 1 and d.known[w] == 0:
        needs_wrench_out[w] = 1
        d.known[w] = 1


@wp.kernel
def measure_drag(
    # In:
    chunk: int,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    contact: Contact,
    on: wp.array(dtype=int),
    # Out:
    d: Drag,
    part_out: wp.array3d(dtype=wp.spatial_matrixd),
):
    """S = R' D R by chunks of faces [group, chunk, world]."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    for g in range(part_out.shape[0]):
        part_out[g, c, w] = wp.spatial_matrixd()
    nsample = contact.sample.shape[0]
    for f in range(c * chunk, wp.min((c + 1) * chunk, contact.face.shape[0])):
        if contact.touching[f, w] == 1:
            mine = int(-1)
            for s in range(nsample):
                g = contact.trial_geom[f * nsample + s, w]
                if g >= 0:
                    mine = wp.max(mine, geoms.group[g])
            d.group[f, w] = mine
            if mine >= 0:
                t = contact.face[f]
                move = mat33()
                turn = mat33()
                bend = mat33()
                wind = mat33()
                for a in range(3):
                    arm = wp.skew(x[t[a], w])
                    for b in range(3):
                        K = contact.block[6 * f + block_index(wp.min(a, b), wp.max(a, b)), w]
                        back = K * wp.skew(x[t[b], w])
                        move += K
                        turn -= back
                        bend += arm * K
                        wind -= arm * back
                total = part_out[mine, c, w]
                for i in range(3):
                    for j in range(3):
                        total[i, j] = total[i, j] + move[i, j]
                        total[i, 3 + j] = total[i, 3 + j] + turn[i, j]
                        total[3 + i, j] = total[3 + i, j] + bend[i, j]
                        total[3 + i, 3 + j] = total[3 + i, 3 + j] + wind[i, j]
                part_out[mine, c, w] = total


@wp.func
def _invert(w: int, n: int, M: wp.array3d(dtype=real), pivot: wp.array2d(dtype=int)):
    """M[w] becomes its inverse: Gauss and Jordan's, in place, with row pivots."""
    for k in range(n):
        p = int(k)
        for i in range(k + 1, n):
            if wp.abs(M[w, i, k]) > wp.abs(M[w, p, k]):
                p = i
        pivot[w, k] = p
        if p != k:
            for j in range(n):
                value = M[w, k, j]
                M[w, k, j] = M[w, p, j]
                M[w, p, j] = value
        scale = real(1.0) / M[w, k, k]
        M[w, k, k] = real(1.0)
        for j in range(n):
            M[w, k, j] = M[w, k, j] * scale
        for i in range(n):
            f = M[w, i, k]
            if i != k and f != real(0.0):
                M[w, i, k] = real(0.0)
                for j in range(n):
                    M[w, i, j] = M[w, i, j] - f * M[w, k, j]
    for back in range(n):
        k = n - 1 - back
        p = pivot[w, k]
        if p != k:
            for i in range(n):
                value = M[w, i, k]
                M[w, i, k] = M[w, i, p]
                M[w, i, p] = value


@wp.func
def _moved(w: int, g: int, b: Bodies, wrench: wp.array2d(dtype=wp.spatial_vectord)):
    """Motion of a body by wrenches on all."""
    m = vec6()
    for h in range(wrench.shape[0]):
        m += b.compliance[g, h, w] * wrench[h, w]
    return m


@wp.func
def _give(st: Worlds, w: int):
    """Fraction of their compliance that bodies have in an iteration: they are viscous as the skin is."""
    return real(1.0) / (real(1.0) + st.viscosity[w])


@wp.func
def _answered(w: int, g: int, d: Drag, wrench: wp.array2d(dtype=wp.spatial_vectord)):
    """(1 + S A)^-1 times wrenches on all, of one body."""
    y = vec6()
    for h in range(wrench.shape[0]):
        for i in range(6):
            for j in range(6):
                y[i] = y[i] + d.inverse[w, 6 * g + i, 6 * h + j] * wrench[h, w][j]
    return y


@wp.kernel
def settle_bodies(
    # In:
    part: wp.array3d(dtype=wp.spatial_matrixd),
    on: wp.array(dtype=int),
    # In and out:
    b: Bodies,
    d: Drag,
    st: Worlds,
):
    """Where an iteration begins: the inverse of 1 + S A, how far wrenches are from those of the bodies'
    poses, how that alone moves the bodies, and what energy lies in that."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    groups = part.shape[0]
    for g in range(groups):
        own = wp.spatial_matrixd()
        for c in range(t, part.shape[1], wp.block_dim()):
            own += part[g, c, w]
        S = wp.spatial_matrixd()
        for i in range(6):
            row = sum_of_block(vec6(own[i, 0], own[i, 1], own[i, 2], own[i, 3], own[i, 4], own[i, 5]))
            for j in range(6):
                S[i, j] = row[j]
        if t == 0:
            d.off[g, w] = d.skin_wrench[g, w] - b.posed[g, w] - S * d.pending[g, w]
            for h in range(groups):
                M = _give(st, w) * S * b.compliance[g, h, w]
                for i in range(6):
                    for j in range(6):
                        d.inverse[w, 6 * g + i, 6 * h + j] = M[i, j]
            for i in range(6):
                d.inverse[w, 6 * g + i, 6 * g + i] = d.inverse[w, 6 * g + i, 6 * g + i] + real(1.0)
    if t > 0:
        return
    _invert(w, 6 * groups, d.inverse, d.pivot)
    for g in range(groups):
        b.wrench[g, w] = _answered(w, g, d, d.off)
    loose = real(0.0)
    for g in range(groups):
        b.motion[g, w] = _give(st, w) * _moved(w, g, b, b.wrench)
        loose += wp.dot(b.motion[g, w], d.off[g, w])
        b.motion[g, w] = b.motion[g, w] + d.pending[g, w]
    st.loose[w] = loose


@wp.func
def _load_of(w: int, t: int, g: int, part: wp.array3d(dtype=vec3)):
    """Wrench of a group by chunks, summed by the threads of a block."""
    own = vec6()
    for c in range(t, part.shape[1], wp.block_dim()):
        f = part[2 * g, c, w]
        m = part[2 * g + 1, c, w]
        own += vec6(f[0], f[1], f[2], m[0], m[1], m[2])
    return sum_of_block(own)


@wp.kernel
def respond(part: wp.array3d(dtype=vec3), on: wp.array(dtype=int), b: Bodies, d: Drag, st: Worlds):
    """Motions B R' D p of the bodies, of the chunks' R' D p."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    groups = b.motion.shape[0]
    for g in range(groups):
        load = _load_of(w, t, g, part)
        if t == 0:
            d.step[g, w] = load
    if t > 0:
        return
    for g in range(groups):
        b.wrench[g, w] = _answered(w, g, d, d.step)
    for g in range(groups):
        b.motion[g, w] = _give(st, w) * _moved(w, g, b, b.wrench)


@wp.kernel
def find_step(part: wp.array3d(dtype=vec3), on: wp.array(dtype=int), b: Bodies, d: Drag, st: Worlds):
    """How far an iteration's step takes wrenches and bodies, of R' D dx by chunks."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    groups = b.motion.shape[0]
    for g in range(groups):
        load = _load_of(w, t, g, part)
        if t == 0:
            b.wrench[g, w] = d.off[g, w] + load
    if t > 0:
        return
    for g in range(groups):
        d.step[g, w] = _give(st, w) * _answered(w, g, d, b.wrench)
    viscous_work = real(0.0)
    for g in range(groups):
        d.displacement[g, w] = _moved(w, g, b, d.step)
        viscous_work += wp.dot(d.displacement[g, w], d.step[g, w])
    st.viscous_work[w] = st.viscous_work[w] + st.viscosity[w] * viscous_work


@wp.kernel
def move_bodies(first: int, on: wp.array(dtype=int), st: Worlds, b: Bodies, d: Drag):
    """Along the step: all of it at first, else by how much longer the search makes it."""
    g, w = wp.tid()
    if on[w] == 1:
        b.posed[g, w] = b.posed[g, w] + wp.where(first == 1, real(1.0), st.longer[w]) * d.step[g, w]


@wp.kernel
def add_slope(st: Worlds, b: Bodies, d: Drag, part: wp.array3d(dtype=real)):
    """The bodies' share of the residual's component along the step; before it, too, where this is the first
    try."""
    w = wp.tid()
    if st.moving[w] == 0:
        return
    now = real(0.0)
    before = real(0.0)
    for g in range(b.motion.shape[0]):
        now += wp.dot(d.displacement[g, w], d.skin_wrench[g, w] - b.posed[g, w])
        before += wp.dot(d.displacement[g, w], d.off[g, w])
    part[0, 0, w] = part[0, 0, w] + now
    if st.tries[w] == 0:
        part[1, 0, w] = part[1, 0, w] + before


@functools.cache
def bodies_kernels(precision: Precision) -> types.SimpleNamespace:
    """Kernels that know directions, for one precision of them."""
    module = f"{__name__}.{precision.name}"
    vec, lower, raised = precision.vec, precision.lower, precision.raised

    @wp.kernel(module=module, enable_backward=False)
    def drag(
        # In:
        chunk: int,
        x: wp.array2d(dtype=vec3),
        contact: Contact,
        p: wp.array2d(dtype=vec),
        on: wp.array(dtype=int),
        d: Drag,
        # Out:
        part_out: wp.array3d(dtype=vec3),
    ):
        """R' D p by chunks of faces [2 group + (0, 1), chunk, world]."""
        c, w = wp.tid()
        if on[w] == 0:
            return
        for k in range(part_out.shape[0]):
            part_out[k, c, w] = vec3()
        for f in range(c * chunk, wp.min((c + 1) * chunk, contact.face.shape[0])):
            if contact.touching[f, w] == 1 and d.group[f, w] >= 0:
                k = 2 * d.group[f, w]
                t = contact.face[f]
                push = vec3()
                turn = vec3()
                for a in range(3):
                    force = vec3()
                    for b in range(3):
                        K = contact.block[6 * f + block_index(wp.min(a, b), wp.max(a, b)), w]
                        force += K * raised(p[t[b], w])
                    push += force
                    turn += wp.cross(x[t[a], w], force)
                part_out[k, c, w] = part_out[k, c, w] + push
                part_out[k + 1, c, w] = part_out[k + 1, c, w] + turn

    @wp.kernel(module=module, enable_backward=False)
    def push_nodes(
        # In:
        chunk: int,
        sign: real,
        mask: wp.array(dtype=real),
        start: wp.array(dtype=int),
        slot: wp.array(dtype=int),
        x: wp.array2d(dtype=vec3),
        contact: Contact,
        on: wp.array(dtype=int),
        b: Bodies,
        d: Drag,
        # In and out:
        r: wp.array2d(dtype=vec),
        # Out:
        square_out: wp.array3d(dtype=real),
    ):
        """r += sign D R motion; its square by chunks."""
        c, w = wp.tid()
        if on[w] == 0:
            return
        rr = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, r.shape[0])):
            if mask[i] > real(0.0):
                push = vec3()
                for k in range(start[i], start[i + 1]):
                    f = slot[k] // 3
                    if contact.touching[f, w] == 1 and d.group[f, w] >= 0:
                        a = slot[k] % 3
                        m = b.motion[d.group[f, w], w]
                        t = contact.face[f]
                        for l in range(3):
                            u = vec3(m[0], m[1], m[2]) + wp.cross(vec3(m[3], m[4], m[5]), x[t[l], w])
                            push += contact.block[6 * f + block_index(wp.min(a, l), wp.max(a, l)), w] * u
                r[i, w] = r[i, w] + lower(sign * push)
                rr += wp.length_sq(raised(r[i, w]))
        square_out[0, c, w] = rr

    return types.SimpleNamespace(drag=drag, push_nodes=push_nodes)
