"""Kernels of conjugate gradients and of the line search: products with the tangent, updates of the solution,
scalar products."""

import functools
import types

import warp as wp

from ...kernels import kernel_module
from ..block import sum_of_lanes
from ..contact.faces import block_index
from ..types import Precision, real, vec3
from .line_search import begin_line_search
from .nodes import LiquidForces, NodeSlots, SurfaceForces
from .worlds import Worlds, total_of, totals_of

kernel_module(__name__)


@wp.struct
class Inertia:
    """Inertia and damping in the tangent of implicit dynamics."""

    on: int  # 0: the dynamics are not implicit
    mass_damping: real  # [1/s]
    stiffness_damping: real  # [s]
    node_volume: wp.array(dtype=real)  # [m^3]
    dt: wp.array(dtype=real)  # [world] [s]


@wp.kernel
def begin_solve(st: Worlds):
    """Starts the linear solve of world w, unless it has converged."""
    w = wp.tid()
    st.running[w] = st.active[w]
    st.moving[w] = st.active[w]
    st.iterations_cg[w] = 0
    st.start_pressure[w] = st.pressure[w]
    st.predicted_pressure[w] = st.pressure[w]


@wp.kernel
def choose_alpha(limit: int, partial: wp.array3d(dtype=real), st: Worlds):
    """Step length of conjugate gradients in world w. partial: p . q, gradient . p, viscous work."""
    w, t = wp.tid()
    if st.running[w] == 0:
        if t == 0:
            st.alpha[w] = real(0.0)
            st.pressure_response[w] = real(0.0)
        return
    # read before the sums, as in `convergence.check_convergence`
    kappa = st.kappa[w]
    iterations = st.iterations_cg[w]
    done = st.work[w]
    rz = st.rz[w]
    before = st.viscous_work[w]
    total = totals_of(partial, w, t)
    if t > 0:
        return
    pq = total[0]
    gp = total[1]
    viscous_work = total[2]
    st.pressure_response[w] = kappa * gp
    curvature = pq + kappa * gp * gp
    first = iterations == 0
    if first:
        before = real(0.0)
    st.iterations_cg[w] = iterations + 1
    st.work[w] = done + 1
    if not (curvature > real(0.0)):
        # the tangent is not positive definite: the solution so far is a descent direction; in the first
        # iteration, the preconditioned residual is
        st.running[w] = 0
        st.alpha[w] = real(0.0)
        if first:
            st.alpha[w] = wp.where(rz < real(0.0), real(-1.0), real(1.0))
            st.viscous_work[w] = wp.max(viscous_work, real(0.0))
        st.predicted_pressure[w] = st.predicted_pressure[w] - st.alpha[w] * st.pressure_response[w]
        return
    alpha = rz / curvature
    st.alpha[w] = alpha
    st.predicted_pressure[w] = st.predicted_pressure[w] - alpha * st.pressure_response[w]
    st.viscous_work[w] = before + wp.max(alpha * alpha * viscous_work, real(0.0))
    if iterations + 1 >= limit:
        st.running[w] = 0


@wp.kernel
def choose_beta(partial: wp.array3d(dtype=real), st: Worlds, any_active: wp.array(dtype=int)):
    """Ends the linear solve of world w if it has reduced r . z to a hundredth, or if its last step length was
    near one. partial: r . z."""
    w, t = wp.tid()
    if st.running[w] == 0:
        return
    first = st.start_rz[w]
    before = st.rz[w]
    alpha = st.alpha[w]
    rz = total_of(partial, 0, w, t)
    if t > 0:
        return
    st.rz[w] = rz
    # a step length near one: the preconditioner is as accurate as the tangent where the load acts. What is
    # left lies where it is not: a motion along it needs a product, which the next tangent has better
    if rz > real(0.01) * wp.abs(first) and wp.abs(alpha - real(1.0)) > real(0.2):
        st.beta[w] = rz / before
        any_active[0] = 1
    else:
        st.running[w] = 0


@functools.cache
def krylov_kernels(precision: Precision) -> types.SimpleNamespace:
    """Kernels of conjugate gradients and of the line search, for one precision of directions."""
    return types.SimpleNamespace(
        **_product_kernels(precision), **_update_kernels(precision), **_search_kernels(precision)
    )


def _product_kernels(precision):
    module = kernel_module(f"{__name__}.{precision.name}")
    scalar, vec, lower, raised = precision.scalar, precision.vec, precision.lower, precision.raised

    @wp.func(inline=True)
    def face_product(s: int, w: int, surface: SurfaceForces, p: wp.array2d(dtype=vec)):
        """Contact tangent of face s // 3 times p, at its corner s % 3."""
        f = s // 3
        a = s % 3
        total = vec3()
        for b in range(3):
            K = surface.block[6 * f + block_index(wp.min(a, b), wp.max(a, b)), w]
            total += K * raised(p[surface.face[f][b], w])
        return lower(total)

    @wp.kernel(module=module)
    def assemble_product(
        # In:
        elements: NodeSlots,
        corner: wp.array2d(dtype=vec),
        outer: SurfaceForces,
        core: SurfaceForces,
        liquid: LiquidForces,
        mask: wp.array(dtype=real),
        inertia: Inertia,
        x: wp.array2d(dtype=vec3),
        p: wp.array2d(dtype=vec),
        st: Worlds,
        # Out:
        q_out: wp.array2d(dtype=vec),
        viscous_work_out: wp.array2d(dtype=scalar),
    ):
        """q = tangent of all forces times p at node i, at constant pressure of the liquid."""
        i, w, lane = wp.tid()
        if st.running[w] == 0:
            return
        if mask[i] == real(0.0):
            q_out[i, w] = vec()
            viscous_work_out[i, w] = scalar(0.0)
            return
        lanes = elements.lanes
        q = vec()
        for k in range(elements.start[i] + lane, elements.start[i + 1], lanes):
            q += corner[elements.slot[k], w]
        q = sum_of_lanes(q, lanes)
        viscosity = scalar(st.viscosity[w])
        viscous_work_out[i, w] = viscosity * wp.dot(p[i, w], q)
        q = (scalar(1.0) + viscosity) * q
        if inertia.on == 1:
            h = inertia.dt[w]
            m = st.density[w] * inertia.node_volume[i] / (h * h)
            q = scalar(real(1.0) + inertia.stiffness_damping / h) * q
            q += scalar((real(1.0) + inertia.mass_damping * h) * m) * p[i, w]
        push = vec()
        for k in range(outer.start[i] + lane, outer.start[i + 1], lanes):
            s = outer.slot[k]
            if outer.touching[s // 3, w] == 1:
                push += face_product(s, w, outer, p)
        if core.start.shape[0] > 0:
            for k in range(core.start[i] + lane, core.start[i + 1], lanes):
                s = core.slot[k]
                if core.touching[s // 3, w] == 1:
                    push += face_product(s, w, core, p)
        if liquid.start.shape[0] > 0:
            bend = vec()
            for k in range(liquid.start[i] + lane, liquid.start[i + 1], lanes):
                s = liquid.slot[k]
                t = liquid.face[s // 3]
                p0 = p[t[0], w]
                d1 = p[t[1], w] - p0
                d2 = p[t[2], w] - p0
                e1 = lower(x[t[1], w] - x[t[0], w])
                e2 = lower(x[t[2], w] - x[t[0], w])
                bend += scalar(liquid.wet[s // 3, w][s % 3]) * (wp.cross(d1, e2) + wp.cross(e1, d2))
            push += scalar(real(0.5) * st.tangent_pressure[w]) * bend
        q_out[i, w] = q + sum_of_lanes(push, lanes)

    @wp.kernel(module=module)
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
        partial_out: wp.array3d(dtype=real),
        any_active: wp.array(dtype=int),
    ):
        """p . q, gradient . p and the viscous work of a chunk of nodes [quantity, chunk, world]."""
        c, w = wp.tid()
        if c == 0 and w == 0:
            any_active[0] = 0
        if on[w] == 0:
            return
        pq = real(0.0)
        gp = real(0.0)
        viscous = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, p.shape[0])):
            pq += real(wp.dot(p[i, w], q[i, w]))
            viscous += real(viscous_work[i, w])
            if wet.shape[0] > 0 and wet[i] == 1:
                gp += wp.dot(gradient[i, w], raised(p[i, w]))
        partial_out[0, c, w] = pq
        partial_out[1, c, w] = gp
        partial_out[2, c, w] = viscous

    return {"assemble_product": assemble_product, "measure_product": measure_product}


def _update_kernels(precision):
    module = kernel_module(f"{__name__}.{precision.name}")
    scalar, vec, lower = precision.scalar, precision.vec, precision.lower

    @wp.kernel(module=module)
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
        partial_out: wp.array3d(dtype=real),
    ):
        """Updates dx += alpha p and r -= alpha (q + pressure_response gradient) in a chunk of nodes, and sums
        the square of r."""
        c, w = wp.tid()
        if st.active[w] == 0:
            return
        alpha = scalar(st.alpha[w])
        pressure_response = scalar(st.alpha[w] * st.pressure_response[w])
        rr = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, p.shape[0])):
            if first == 1:
                dx[i, w] = alpha * p[i, w]
            else:
                dx[i, w] = dx[i, w] + alpha * p[i, w]
            if st.running[w] == 1:
                residual = r[i, w] - alpha * q[i, w]
                if wet.shape[0] > 0 and wet[i] == 1:
                    residual -= pressure_response * lower(gradient[i, w])
                r[i, w] = residual
                rr += real(wp.dot(residual, residual))
        partial_out[0, c, w] = rr

    @wp.kernel(module=module)
    def next_direction(z: wp.array2d(dtype=vec), st: Worlds, p: wp.array2d(dtype=vec)):
        """p = z + beta p at node i."""
        i, w = wp.tid()
        if st.running[w] == 1:
            p[i, w] = z[i, w] + scalar(st.beta[w]) * p[i, w]

    return {"update_solution": update_solution, "next_direction": next_direction}


def _search_kernels(precision):
    module, vec, raised = f"{__name__}.{precision.name}", precision.vec, precision.raised

    @wp.kernel(module=module)
    def first_length(
        # In:
        chunk: int,
        force: wp.array2d(dtype=vec3),
        dx: wp.array2d(dtype=vec),
        st: Worlds,
        # In and out:
        x: wp.array2d(dtype=vec3),
        # Out:
        partial_out: wp.array3d(dtype=real),
    ):
        """Takes the full step in a chunk of nodes; force . dx before the step."""
        c, w = wp.tid()
        if st.active[w] == 0:
            return
        if c == 0:
            begin_line_search(st, w)
        slope = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, x.shape[0])):
            d = raised(dx[i, w])
            slope += wp.dot(force[i, w], d)
            x[i, w] = x[i, w] + d
        partial_out[1, c, w] = slope

    @wp.kernel(module=module)
    def move(dx: wp.array2d(dtype=vec), st: Worlds, x: wp.array2d(dtype=vec3)):
        """Moves node i by the change of the step length."""
        i, w = wp.tid()
        if st.moving[w] == 1:
            x[i, w] = x[i, w] + st.alpha_change[w] * raised(dx[i, w])

    @wp.kernel(module=module)
    def measure_slope(
        # In:
        chunk: int,
        force: wp.array2d(dtype=vec3),
        dx: wp.array2d(dtype=vec),
        gradient: wp.array2d(dtype=vec3),
        wet: wp.array(dtype=int),
        st: Worlds,
        # Out:
        partial_out: wp.array3d(dtype=real),
        any_active: wp.array(dtype=int),
    ):
        """force . dx and gradient . dx of a chunk of nodes."""
        c, w = wp.tid()
        if c == 0 and w == 0:
            any_active[0] = 0
        if st.moving[w] == 0:
            return
        slope = real(0.0)
        pressure_response = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, force.shape[0])):
            d = raised(dx[i, w])
            slope += wp.dot(force[i, w], d)
            if wet.shape[0] > 0 and wet[i] == 1:
                pressure_response += wp.dot(gradient[i, w], d)
        partial_out[0, c, w] = slope
        partial_out[2, c, w] = pressure_response

    return {"first_length": first_length, "move": move, "measure_slope": measure_slope}
