"""Conjugate gradients and the line search of all worlds: products with the tangent, steps, what they
bring."""

import functools
import types

import warp as wp

from ..contact.faces import block_index
from ..types import Precision, mat33, real, sum_of_lanes, vec3
from .worlds import Worlds, clear_line, total_of, totals_of

__all__ = ["begin_solve", "choose_alpha", "choose_beta", "krylov_kernels"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_solve(st: Worlds, any_active: wp.array(dtype=int)):
    """Every world that is not in balance starts its linear solve."""
    w = wp.tid()
    if w == 0:
        any_active[0] = 0
    st.running[w] = st.active[w]
    st.moving[w] = st.active[w]
    st.iterations_cg[w] = 0
    st.before[w] = st.pressure[w]
    st.foreseen[w] = st.pressure[w]


@wp.kernel
def choose_alpha(limit: int, part: wp.array3d(dtype=real), st: Worlds, any_active: wp.array(dtype=int)):
    """Length of a step of conjugate gradients."""
    w, t = wp.tid()
    if st.running[w] == 0:
        if t == 0:
            st.alpha[w] = real(0.0)
            st.swell[w] = real(0.0)
        return
    # read before the sums, as in `worlds.judge_balance`
    kappa = st.kappa[w]
    iterations = st.iterations_cg[w]
    done = st.work[w]
    rz = st.rz[w]
    before = st.viscous_work[w]
    total = totals_of(part, w, t)
    if t > 0:
        return
    pq = total[0]
    gp = total[1]
    viscous_work = total[2]
    st.swell[w] = kappa * gp
    curvature = pq + kappa * gp * gp
    first = iterations == 0
    if first:
        before = real(0.0)
    st.iterations_cg[w] = iterations + 1
    st.work[w] = done + 1
    if not (curvature > real(0.0)):
        # the tangent is not positive definite there: what has been found so far is a descent direction; at
        # once, it is the first one
        st.running[w] = 0
        st.alpha[w] = real(0.0)
        if first:
            st.alpha[w] = wp.where(rz < real(0.0), real(-1.0), real(1.0))
            st.viscous_work[w] = wp.max(viscous_work, real(0.0))
        st.foreseen[w] = st.foreseen[w] - st.alpha[w] * st.swell[w]
        return
    alpha = rz / curvature
    st.alpha[w] = alpha
    st.foreseen[w] = st.foreseen[w] - alpha * st.swell[w]
    st.viscous_work[w] = before + wp.max(alpha * alpha * viscous_work, real(0.0))
    # a first step of length one says that the preconditioner is as good as the tangent
    if wp.abs(alpha - real(1.0)) <= real(0.2) or iterations + 1 >= limit:
        st.running[w] = 0
    else:
        any_active[0] = 1


@wp.kernel
def choose_beta(part: wp.array3d(dtype=real), st: Worlds):
    """Ends the linear solves that have reduced the residual enough. part: r . z."""
    w, t = wp.tid()
    if st.running[w] == 0:
        return
    first = st.first[w]
    before = st.rz[w]
    rz = total_of(part, 0, w, t)
    if t > 0:
        return
    if not (rz > real(0.01) * wp.abs(first)):
        st.running[w] = 0
        return
    st.beta[w] = rz / before
    st.rz[w] = rz


@functools.cache
def krylov_kernels(precision: Precision) -> types.SimpleNamespace:
    """Kernels that know directions, for one precision of them."""
    module = f"{__name__}.{precision.name}"
    scalar, vec, lower, raised = precision.scalar, precision.vec, precision.lower, precision.raised

    @wp.func
    def face_product(
        s: int,
        w: int,
        face: wp.array(dtype=wp.vec3i),
        block: wp.array2d(dtype=mat33),
        p: wp.array2d(dtype=vec),
    ):
        f = s // 3
        a = s % 3
        total = vec3()
        for b in range(3):
            total += block[6 * f + block_index(wp.min(a, b), wp.max(a, b)), w] * raised(p[face[f][b], w])
        return lower(total)

    @wp.kernel(module=module, enable_backward=False)
    def assemble_product(
        # In:
        lanes: int,
        start: wp.array(dtype=int),
        slot: wp.array(dtype=int),
        corner: wp.array2d(dtype=vec),
        outer_face: wp.array(dtype=wp.vec3i),
        outer_start: wp.array(dtype=int),
        outer_slot: wp.array(dtype=int),
        outer_touching: wp.array2d(dtype=int),
        outer_block: wp.array2d(dtype=mat33),
        core_face: wp.array(dtype=wp.vec3i),
        core_start: wp.array(dtype=int),
        core_slot: wp.array(dtype=int),
        core_touching: wp.array2d(dtype=int),
        core_block: wp.array2d(dtype=mat33),
        wet_face: wp.array(dtype=wp.vec3i),
        wet_start: wp.array(dtype=int),
        wet_slot: wp.array(dtype=int),
        wet: wp.array2d(dtype=vec3),
        mask: wp.array(dtype=real),
        inertia: wp.vec3d,
        node_volume: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        x: wp.array2d(dtype=vec3),
        p: wp.array2d(dtype=vec),
        st: Worlds,
        # Out:
        q_out: wp.array2d(dtype=vec),
        viscous_work_out: wp.array2d(dtype=scalar),
    ):
        """Tangent of all forces times p, but for what the liquid's pressure changes by. inertia: 1 with it,
        damping by mass, by stiffness."""
        i, w, lane = wp.tid()
        if st.running[w] == 0:
            return
        if mask[i] == real(0.0):
            q_out[i, w] = vec()
            viscous_work_out[i, w] = scalar(0.0)
            return
        q = vec()
        for k in range(start[i] + lane, start[i + 1], lanes):
            q += corner[slot[k], w]
        q = sum_of_lanes(q, lanes)
        viscosity = scalar(st.viscosity[w])
        viscous_work_out[i, w] = viscosity * wp.dot(p[i, w], q)
        q = (scalar(1.0) + viscosity) * q
        if inertia[0] > real(0.0):
            h = dt[w]
            m = st.density[w] * node_volume[i] / (h * h)
            q = scalar(real(1.0) + inertia[2] / h) * q + scalar((real(1.0) + inertia[1] * h) * m) * p[i, w]
        push = vec()
        for k in range(outer_start[i] + lane, outer_start[i + 1], lanes):
            s = outer_slot[k]
            if outer_touching[s // 3, w] == 1:
                push += face_product(s, w, outer_face, outer_block, p)
        if core_start.shape[0] > 0:
            for k in range(core_start[i] + lane, core_start[i + 1], lanes):
                s = core_slot[k]
                if core_touching[s // 3, w] == 1:
                    push += face_product(s, w, core_face, core_block, p)
        if wet_start.shape[0] > 0:
            bend = vec()
            for k in range(wet_start[i] + lane, wet_start[i + 1], lanes):
                s = wet_slot[k]
                t = wet_face[s // 3]
                p0 = p[t[0], w]
                d1 = p[t[1], w] - p0
                d2 = p[t[2], w] - p0
                e1 = lower(x[t[1], w] - x[t[0], w])
                e2 = lower(x[t[2], w] - x[t[0], w])
                bend += scalar(wet[s // 3, w][s % 3]) * (wp.cross(d1, e2) + wp.cross(e1, d2))
            push += scalar(real(0.5) * st.borne[w]) * bend
        q_out[i, w] = q + sum_of_lanes(push, lanes)

    @wp.kernel(module=module, enable_backward=False)
    def measure_product(
        # In:
        chunk: int,
        p: wp.array2d(dtype=vec),
        q: wp.array2d(dtype=vec),
        viscous_work: wp.array2d(dtype=scalar),
        gradient: wp.array2d(dtype=vec3),
        wet: wp.array(dtype=int),
        on: wp.array(dtype=int),
        # Out:
        part_out: wp.array3d(dtype=real),
        any_active: wp.array(dtype=int),
    ):
        """p . q, gradient . p and what is held by chunks."""
        c, w = wp.tid()
        if c == 0 and w == 0:
            any_active[0] = 0
        if on[w] == 0:
            return
        pq = real(0.0)
        gp = real(0.0)
        hold = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, p.shape[0])):
            pq += real(wp.dot(p[i, w], q[i, w]))
            hold += real(viscous_work[i, w])
            if wet.shape[0] > 0 and wet[i] == 1:
                gp += wp.dot(gradient[i, w], raised(p[i, w]))
        part_out[0, c, w] = pq
        part_out[1, c, w] = gp
        part_out[2, c, w] = hold

    @wp.kernel(module=module, enable_backward=False)
    def update_solution(
        # In:
        chunk: int,
        first: int,
        p: wp.array2d(dtype=vec),
        q: wp.array2d(dtype=vec),
        gradient: wp.array2d(dtype=vec3),
        wet: wp.array(dtype=int),
        st: Worlds,
        # In and out:
        dx: wp.array2d(dtype=vec),
        r: wp.array2d(dtype=vec),
        # Out:
        part_out: wp.array3d(dtype=real),
    ):
        """dx += alpha p, r -= alpha (q + swell gradient); the square of r by chunks."""
        c, w = wp.tid()
        if st.active[w] == 0:
            return
        alpha = scalar(st.alpha[w])
        swell = scalar(st.alpha[w] * st.swell[w])
        rr = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, p.shape[0])):
            if first == 1:
                dx[i, w] = alpha * p[i, w]
            else:
                dx[i, w] = dx[i, w] + alpha * p[i, w]
            if st.running[w] == 1:
                rest = r[i, w] - alpha * q[i, w]
                if wet.shape[0] > 0 and wet[i] == 1:
                    rest -= swell * lower(gradient[i, w])
                r[i, w] = rest
                rr += real(wp.dot(rest, rest))
        part_out[0, c, w] = rr

    @wp.kernel(module=module, enable_backward=False)
    def next_direction(z: wp.array2d(dtype=vec), st: Worlds, p: wp.array2d(dtype=vec)):
        i, w = wp.tid()
        if st.running[w] == 1:
            p[i, w] = z[i, w] + scalar(st.beta[w]) * p[i, w]

    @wp.kernel(module=module, enable_backward=False)
    def first_length(
        # In:
        chunk: int,
        force: wp.array2d(dtype=vec3),
        dx: wp.array2d(dtype=vec),
        st: Worlds,
        # In and out:
        x: wp.array2d(dtype=vec3),
        # Out:
        part_out: wp.array3d(dtype=real),
    ):
        """Takes the whole step; the residual's component along it, before, by chunks."""
        c, w = wp.tid()
        if st.active[w] == 0:
            return
        if c == 0:
            clear_line(st, w)
        slope = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, x.shape[0])):
            d = raised(dx[i, w])
            slope += wp.dot(force[i, w], d)
            x[i, w] = x[i, w] + d
        part_out[1, c, w] = slope

    @wp.kernel(module=module, enable_backward=False)
    def move(dx: wp.array2d(dtype=vec), st: Worlds, x: wp.array2d(dtype=vec3)):
        i, w = wp.tid()
        if st.moving[w] == 1:
            x[i, w] = x[i, w] + st.longer[w] * raised(dx[i, w])

    @wp.kernel(module=module, enable_backward=False)
    def measure_slope(
        # In:
        chunk: int,
        force: wp.array2d(dtype=vec3),
        dx: wp.array2d(dtype=vec),
        gradient: wp.array2d(dtype=vec3),
        wet: wp.array(dtype=int),
        st: Worlds,
        # Out:
        part_out: wp.array3d(dtype=real),
        any_active: wp.array(dtype=int),
    ):
        c, w = wp.tid()
        if c == 0 and w == 0:
            any_active[0] = 0
        if st.moving[w] == 0:
            return
        slope = real(0.0)
        swell = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, force.shape[0])):
            d = raised(dx[i, w])
            slope += wp.dot(force[i, w], d)
            if wet.shape[0] > 0 and wet[i] == 1:
                swell += wp.dot(gradient[i, w], d)
        part_out[0, c, w] = slope
        part_out[2, c, w] = swell

    return types.SimpleNamespace(
        assemble_product=assemble_product,
        measure_product=measure_product,
        update_solution=update_solution,
        next_direction=next_direction,
        first_length=first_length,
        move=move,
        measure_slope=measure_slope,
    )
