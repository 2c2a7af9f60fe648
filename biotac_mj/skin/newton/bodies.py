"""Newton's method with compliant bodies, see `skin.bodies`.

Unknowns are the nodes x and the wrenches y at which the bodies are posed, d = A (y - w0). In equilibrium y
equals the skin's wrench w. With the contact tangent D, the bodies' rigid motions R and S = R' D R, a step is

    (K + D - D R B R' D) dx = F + D R B (w - y),      dy = (1 + S A)^-1 (w - y + R' D dx),

where B = A (1 + S A)^-1 is symmetric and of rank six for each body. It softens contact, and the forces still
have a potential. The bodies add one term to the residual, to each product and to the slope of the line
search. They have the same artificial viscosity as the skin, which divides A by 1 + viscosity.

The first iteration of a touched skin is such a step, too. It starts from the last equilibrium, whose contact
is known, and takes the geoms' motion in this step as its load (`pending`). Without it a box that rolls off
the pad takes 18 % more evaluations and products, and a cylinder of 1 kg that falls on it 22 %; 2 of 58 of its
steps then do not converge."""

import functools
import types

import warp as wp

from ...geometry.rigid_warp import motion
from ...kernels import kernel_module
from ..block import block_sum, sync
from ..bodies import Bodies
from ..contact.faces import Contact, block_index
from ..contact.posed import Geoms, LoadPath
from ..types import Precision, mat33, real, vec3, vec6
from .worlds import Worlds, total_of

kernel_module(__name__)


@wp.struct
class BodyContact:
    """Contact of the skin with compliant bodies in an iteration; arrays are [group, world] unless stated."""

    group: wp.array2d(dtype=int)  # to which a touching face belongs; -1: none [face, world]
    skin_wrench: wp.array2d(dtype=wp.spatial_vectord)  # w at the last evaluation
    residual: wp.array2d(dtype=wp.spatial_vectord)  # w - y at the start of the iteration
    step: wp.array2d(dtype=wp.spatial_vectord)  # dy of the iteration
    displacement: wp.array2d(dtype=wp.spatial_vectord)  # motion of the bodies by dy
    pending: wp.array2d(dtype=wp.spatial_vectord)  # motion from the start of the step, where it is a load
    inverse: wp.array3d(dtype=real)  # of 1 + S A [world, 6 group, 6 group]
    pivot: wp.array2d(dtype=int)  # of each row of it; -1: that of a body that does not touch [world, 6 group]
    has_pending: wp.array(dtype=int)  # 1: the motion in this step is the first iteration's load [world]
    wrench_known: wp.array(dtype=int)  # 1: the wrenches at the start of the step were evaluated [world]


@wp.kernel
def begin_bodies(wanted: wp.array(dtype=int), touched_by: wp.array2d(dtype=int), b: Bodies, d: BodyContact):
    """Starts the step of body g at its predicted pose; a touched skin may have pending motion."""
    g, w = wp.tid()
    if wanted[w] == 1:
        b.posed[g, w] = b.predicted[g, w]
        b.converged[g, w] = b.predicted[g, w]
        b.begun[g, w] = b.predicted[g, w]
    if g == 0:
        d.wrench_known[w] = 0
        d.has_pending[w] = 0
        for k in range(touched_by.shape[0]):
            d.has_pending[w] = wp.max(d.has_pending[w], touched_by[k, w])


@wp.kernel
def begin_pending(geoms: Geoms, path: LoadPath, d: BodyContact, st: Worlds, any_out: wp.array(dtype=int)):
    """Pending motion of the bodies of world w, if its initial guess is not fixed and all poses are known."""
    w = wp.tid()
    known = real(0.0)
    for g in range(geoms.count):
        begin = path.pos_start[g, w]
        known += begin[0] + begin[1] + begin[2]
    if st.wanted[w] == 0 or st.unfinished[w] == 0 or st.guessed[w] == 1 or not wp.isfinite(known):
        d.has_pending[w] = 0
    if d.has_pending[w] == 0:
        return
    any_out[0] = 1
    d.wrench_known[w] = 1
    st.repeat[w] = real(0.0)
    for g in range(geoms.count):
        d.pending[geoms.group[g], w] = motion(
            path.pos_end[g, w], path.mat_end[g, w], path.pos_start[g, w], path.mat_start[g, w]
        )


@wp.kernel
def find_pending(partial: wp.array3d(dtype=real), st: Worlds):
    """Starts the linear solve of an active world. partial: residual . z."""
    w, t = wp.tid()
    if st.active[w] == 0:
        return
    rz = total_of(partial, 0, w, t)
    if t == 0:
        st.rz[w] = rz
        st.start_rz[w] = rz


@wp.kernel
def copy_flags(on: wp.array(dtype=int), out: wp.array(dtype=int)):
    w = wp.tid()
    out[w] = on[w]


@wp.kernel
def end_pending(st: Worlds, d: BodyContact):
    """Clears the pending motion of world w, and activates all unfinished worlds."""
    w = wp.tid()
    st.active[w] = st.unfinished[w]
    for g in range(d.pending.shape[0]):
        d.pending[g, w] = vec6()


@wp.kernel
def mark_unknown_wrenches(st: Worlds, d: BodyContact, needs_wrench_out: wp.array(dtype=int)):
    """Marks a moving world whose wrenches at the start of the load path have not been evaluated."""
    w = wp.tid()
    needs_wrench_out[w] = 0
    if st.moving[w] == 1 and d.wrench_known[w] == 0:
        needs_wrench_out[w] = 1
        d.wrench_known[w] = 1


@wp.kernel
def measure_stiffness(
    # In:
    chunk: int,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    contact: Contact,
    on: wp.array(dtype=int),
    # Out:
    d: BodyContact,
    touched_out: wp.array3d(dtype=int),
    partial_out: wp.array3d(dtype=wp.spatial_matrixd),
):
    """S = R' D R of a chunk of faces, and whether it touches the body [group, chunk, world]. S is written
    only there: few chunks touch."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    for g in range(touched_out.shape[0]):
        touched_out[g, c, w] = 0
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
                total = wp.spatial_matrixd()
                if touched_out[mine, c, w] == 1:
                    total = partial_out[mine, c, w]
                touched_out[mine, c, w] = 1
                for i in range(3):
                    for j in range(3):
                        total[i, j] = total[i, j] + move[i, j]
                        total[i, 3 + j] = total[i, 3 + j] + turn[i, j]
                        total[3 + i, j] = total[3 + i, j] + bend[i, j]
                        total[3 + i, 3 + j] = total[3 + i, 3 + j] + wind[i, j]
                partial_out[mine, c, w] = total


@wp.func
def _invert(w: int, t: int, n: int, M: wp.array3d(dtype=real), pivot: wp.array2d(dtype=int)):
    """Inverts M[w] in place by Gauss-Jordan elimination with row pivots, together with the other threads of a
    block; t is this one. Rows whose pivot is -1 are those of the unit matrix, of bodies that do not touch."""
    for k in range(n):
        if pivot[w, k] < 0:
            continue
        p = int(k)
        for i in range(k + 1, n):
            if wp.abs(M[w, i, k]) > wp.abs(M[w, p, k]):
                p = i
        scale = real(1.0) / M[w, p, k]
        sync()
        for j in range(t, n, wp.block_dim()):
            value = M[w, p, j]
            M[w, p, j] = M[w, k, j]
            M[w, k, j] = scale * wp.where(j == k, real(1.0), value)
        if t == 0:
            pivot[w, k] = p
        sync()
        for e in range(t, n * n, wp.block_dim()):
            i = e // n
            j = e % n
            if i != k and j != k:
                M[w, i, j] = M[w, i, j] - M[w, i, k] * M[w, k, j]
        sync()
        for i in range(t, n, wp.block_dim()):
            if i != k:
                M[w, i, k] = -M[w, i, k] * M[w, k, k]
        sync()
    for back in range(n):
        k = n - 1 - back
        p = pivot[w, k]
        if p < 0:
            for i in range(t, n, wp.block_dim()):
                if i != k:
                    M[w, i, k] = -M[w, i, k]
        elif p != k:
            for i in range(t, n, wp.block_dim()):
                value = M[w, i, k]
                M[w, i, k] = M[w, i, p]
                M[w, i, p] = value
            sync()


@wp.func
def _motion_by(w: int, g: int, b: Bodies, wrench: wp.array2d(dtype=wp.spatial_vectord)):
    """Motion of body g by wrenches on all bodies."""
    m = vec6()
    for h in range(wrench.shape[0]):
        m += b.compliance[g, h, w] * wrench[h, w]
    return m


@wp.func
def _corrected(w: int, g: int, d: BodyContact, wrench: wp.array2d(dtype=wp.spatial_vectord)):
    """(1 + S A)^-1 times wrenches on all bodies, for body g."""
    y = vec6()
    for h in range(wrench.shape[0]):
        for i in range(6):
            for j in range(6):
                y[i] = y[i] + d.inverse[w, 6 * g + i, 6 * h + j] * wrench[h, w][j]
    return y


@wp.func
def _respond(w: int, t: int, b: Bodies, d: BodyContact, st: Worlds):
    """Changes of the wrenches by the loads `b.wrench`, and the motions of the bodies by these, together with
    the other threads of a block; t is this one."""
    factor = real(1.0) / (real(1.0) + st.viscosity[w])  # on the compliance, by the artificial viscosity
    for g in range(t, b.motion.shape[0], wp.block_dim()):
        d.step[g, w] = factor * _corrected(w, g, d, b.wrench)
    sync()
    for g in range(t, b.motion.shape[0], wp.block_dim()):
        b.motion[g, w] = _motion_by(w, g, b, d.step)
    sync()


@wp.kernel
def begin_iteration(
    # In:
    touched: wp.array3d(dtype=int),
    partial: wp.array3d(dtype=wp.spatial_matrixd),
    on: wp.array(dtype=int),
    # In and out:
    b: Bodies,
    d: BodyContact,
    st: Worlds,
):
    """Starts an iteration: the inverse of 1 + S A, the residual w - y, the motion of the bodies by it, and
    twice its energy (`body_residual`)."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    groups = partial.shape[0]
    for g in range(groups):
        own = wp.spatial_matrixd()
        mine = real(0.0)
        for c in range(t, partial.shape[1], wp.block_dim()):
            if touched[g, c, w] == 1:
                own += partial[g, c, w]
                mine = real(1.0)
        S = wp.spatial_matrixd()
        touching = block_sum(mine) > real(0.0)
        if touching:
            for i in range(6):
                row = block_sum(vec6(own[i, 0], own[i, 1], own[i, 2], own[i, 3], own[i, 4], own[i, 5]))
                for j in range(6):
                    S[i, j] = row[j]
        for i in range(t, 6, wp.block_dim()):
            d.pivot[w, 6 * g + i] = wp.where(touching, 0, -1)
        for h in range(t, groups, wp.block_dim()):
            M = S * b.compliance[g, h, w] / (real(1.0) + st.viscosity[w])
            for i in range(6):
                for j in range(6):
                    unit = wp.where(g == h and i == j, real(1.0), real(0.0))
                    d.inverse[w, 6 * g + i, 6 * h + j] = M[i, j] + unit
        if t == 0:
            d.residual[g, w] = d.skin_wrench[g, w] - b.posed[g, w] - S * d.pending[g, w]
            b.wrench[g, w] = d.residual[g, w]
    sync()
    _invert(w, t, 6 * groups, d.inverse, d.pivot)
    _respond(w, t, b, d, st)
    if t > 0:
        return
    body_residual = real(0.0)
    for g in range(groups):
        body_residual += wp.dot(b.motion[g, w], d.residual[g, w])
        b.motion[g, w] = b.motion[g, w] + d.pending[g, w]
    st.body_residual[w] = body_residual


@wp.func
def _load_on(w: int, t: int, g: int, partial: wp.array3d(dtype=vec3)):
    """Wrench on group g, summed over chunks by the threads of a block."""
    own = vec6()
    for c in range(t, partial.shape[1], wp.block_dim()):
        f = partial[2 * g, c, w]
        m = partial[2 * g + 1, c, w]
        own += vec6(f[0], f[1], f[2], m[0], m[1], m[2])
    return block_sum(own)


@wp.kernel
def body_motion(
    ends: int, partial: wp.array3d(dtype=vec3), on: wp.array(dtype=int), b: Bodies, d: BodyContact, st: Worlds
):
    """Motions B R' D p of the bodies of world w. partial: R' D p of each chunk. ends: 1: p is the solution
    dx, and the residual is added: the step dy of the wrenches in an iteration, and its motions."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    groups = b.motion.shape[0]
    for g in range(groups):
        load = _load_on(w, t, g, partial)
        if t == 0:
            b.wrench[g, w] = load + real(ends) * d.residual[g, w]
    sync()
    _respond(w, t, b, d, st)
    if ends == 0 or t > 0:
        return
    viscous_work = real(0.0)
    for g in range(groups):
        d.displacement[g, w] = b.motion[g, w]
        viscous_work += wp.dot(d.displacement[g, w], d.step[g, w])
    st.viscous_work[w] = st.viscous_work[w] + st.viscosity[w] * viscous_work


@wp.kernel
def move_bodies(first: int, on: wp.array(dtype=int), st: Worlds, b: Bodies, d: BodyContact):
    """Moves the wrench of body g by the full step (first), else by the change of the step length."""
    g, w = wp.tid()
    if on[w] == 1:
        b.posed[g, w] = b.posed[g, w] + wp.where(first == 1, real(1.0), st.alpha_change[w]) * d.step[g, w]


@wp.kernel
def add_slope(st: Worlds, b: Bodies, d: BodyContact, partial: wp.array3d(dtype=real)):
    """Adds the bodies' part of residual . direction after the step, and in the first try also before it."""
    w = wp.tid()
    if st.moving[w] == 0:
        return
    now = real(0.0)
    before = real(0.0)
    for g in range(b.motion.shape[0]):
        now += wp.dot(d.displacement[g, w], d.skin_wrench[g, w] - b.posed[g, w])
        before += wp.dot(d.displacement[g, w], d.residual[g, w])
    partial[0, 0, w] = partial[0, 0, w] + now
    if st.tries[w] == 0:
        partial[1, 0, w] = partial[1, 0, w] + before


@functools.cache
def bodies_kernels(precision: Precision) -> types.SimpleNamespace:
    """Kernels with directions, for one precision of these."""
    module = kernel_module(f"{__name__}.{precision.name}")
    vec, lower, raised = precision.vec, precision.lower, precision.raised

    @wp.kernel(module=module)
    def body_load(
        # In:
        chunk: int,
        x: wp.array2d(dtype=vec3),
        contact: Contact,
        p: wp.array2d(dtype=vec),
        on: wp.array(dtype=int),
        d: BodyContact,
        # Out:
        partial_out: wp.array3d(dtype=vec3),
    ):
        """Wrenches R' D p on the bodies from a chunk of faces, by the contact stiffness D and displacements p
        of the nodes: forces in row 2 group, torques in row 2 group + 1."""
        c, w = wp.tid()
        if on[w] == 0:
            return
        for k in range(partial_out.shape[0]):
            partial_out[k, c, w] = vec3()
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
                partial_out[k, c, w] = partial_out[k, c, w] + push
                partial_out[k + 1, c, w] = partial_out[k + 1, c, w] + turn

    @wp.kernel(module=module)
    def add_body_forces(
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
        d: BodyContact,
        # In and out:
        r: wp.array2d(dtype=vec),
        # Out:
        square_out: wp.array3d(dtype=real),
    ):
        """r += sign D R motion in a chunk of nodes, and the square of r."""
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

    return types.SimpleNamespace(body_load=body_load, add_body_forces=add_body_forces)
