"""Forces at the nodes of all worlds, and the beginning and end of their step.

Sums over nodes go chunk by chunk, so that their order is always the same.
"""

import functools
import types

import warp as wp

from ..types import Precision, mat33, real, sum_of_lanes, vec3
from .worlds import Worlds

__all__ = [
    "assemble_force",
    "begin_nodes",
    "end_core",
    "end_nodes",
    "fly_freely",
    "keep_nodes",
    "lie_at_rest",
    "correct_pressure",
    "nodes_kernels",
    "return_nodes",
]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_nodes(
    # In:
    mask: wp.array(dtype=real),
    increment: wp.array2d(dtype=vec3),
    st: Worlds,
    # In and out:
    x: wp.array2d(dtype=vec3),
    # Out:
    begun_out: wp.array2d(dtype=vec3),
):
    """Starts from the last step's increment, as far as the geoms repeat their last motion."""
    i, w = wp.tid()
    begun_out[i, w] = x[i, w]
    if st.active[w] == 1 and mask[i] > real(0.0) and st.repeat[w] > real(0.0):
        x[i, w] = x[i, w] + st.repeat[w] * increment[i, w]


@wp.kernel
def return_nodes(
    # In:
    begun: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # Out:
    x: wp.array2d(dtype=vec3),
):
    """Back to the last converged load increment."""
    i, w = wp.tid()
    if on[w] == 1:
        x[i, w] = begun[i, w]


@wp.kernel
def lie_at_rest(
    # In:
    rest: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # Out:
    x: wp.array2d(dtype=vec3),
):
    """To where nothing touches; rest is [nvert, 1], or each world's own."""
    i, w = wp.tid()
    if on[w] == 1:
        x[i, w] = rest[i, w % rest.shape[1]]


@wp.kernel
def keep_nodes(x: wp.array2d(dtype=vec3), kept: wp.array(dtype=int), begun_out: wp.array2d(dtype=vec3)):
    """The next part begins where one ended that was gone."""
    i, w = wp.tid()
    if kept[w] == 1:
        begun_out[i, w] = x[i, w]


@wp.kernel
def fly_freely(
    # In:
    x: wp.array2d(dtype=vec3),
    velocity: wp.array2d(dtype=vec3),
    pos_last: wp.array(dtype=vec3),
    mat_last: wp.array(dtype=mat33),
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    dt: wp.array(dtype=real),
    # Out:
    world_out: wp.array2d(dtype=vec3),
    target_out: wp.array2d(dtype=vec3),
):
    """Where free flight would take the nodes, seen from the moved BioTac frame."""
    i, w = wp.tid()
    at = mat_last[w] * x[i, w] + pos_last[w]
    world_out[i, w] = at
    target_out[i, w] = wp.transpose(mat[w]) * (at + dt[w] * velocity[i, w] - pos[w])


@wp.kernel
def assemble_force(
    # In:
    lanes: int,
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    corner: wp.array2d(dtype=vec3),
    outer_start: wp.array(dtype=int),
    outer_slot: wp.array(dtype=int),
    outer_touching: wp.array2d(dtype=int),
    outer_corner: wp.array2d(dtype=vec3),
    core_start: wp.array(dtype=int),
    core_slot: wp.array(dtype=int),
    core_touching: wp.array2d(dtype=int),
    core_corner: wp.array2d(dtype=vec3),
    wet_start: wp.array(dtype=int),
    wet_slot: wp.array(dtype=int),
    wet_corner: wp.array2d(dtype=vec3),
    external: wp.array2d(dtype=vec3),
    pressure: wp.array(dtype=real),
    on: wp.array(dtype=int),
    # Out:
    force_out: wp.array2d(dtype=vec3),
    outer_out: wp.array2d(dtype=vec3),
    core_out: wp.array2d(dtype=vec3),
    gradient_out: wp.array2d(dtype=vec3),
):
    """Sums what the corners of elements and faces hold into their nodes, each by so many lanes of a warp,
    which all write the same. Arrays of length zero: there is no such thing."""
    i, w, lane = wp.tid()
    if on[w] == 0:
        return
    total = vec3()
    for k in range(start[i] + lane, start[i + 1], lanes):
        total += corner[slot[k], w]
    total = sum_of_lanes(total, lanes)
    if external.shape[0] > 0:
        total += external[i, w]
    push = vec3()
    for k in range(outer_start[i] + lane, outer_start[i + 1], lanes):
        s = outer_slot[k]
        if outer_touching[s // 3, w] == 1:
            push += outer_corner[s, w]
    push = sum_of_lanes(push, lanes)
    if outer_start[i + 1] > outer_start[i]:  # elsewhere it stays zero
        outer_out[i, w] = push
        total += push
    if core_start.shape[0] > 0:
        push = vec3()
        for k in range(core_start[i] + lane, core_start[i + 1], lanes):
            s = core_slot[k]
            if core_touching[s // 3, w] == 1:
                push += core_corner[s, w]
        push = sum_of_lanes(push, lanes)
        if core_start[i + 1] > core_start[i]:
            core_out[i, w] = push
            total += push
    if wet_start.shape[0] > 0:
        push = vec3()
        for k in range(wet_start[i] + lane, wet_start[i + 1], lanes):
            push += wet_corner[wet_slot[k], w]
        push = sum_of_lanes(push, lanes)
        if wet_start[i + 1] > wet_start[i]:
            gradient_out[i, w] = push
            total += pressure[w] * push
    force_out[i, w] = total


@wp.kernel
def correct_pressure(
    # In:
    mask: wp.array(dtype=real),
    gradient: wp.array2d(dtype=vec3),
    st: Worlds,
    # In and out:
    x: wp.array2d(dtype=vec3),
    force: wp.array2d(dtype=vec3),
):
    """Brings the volume to the pressure that `worlds.judge_balance` has found, along the volume's gradient,
    and the liquid's forces with it. What that little motion does to other forces is not asked."""
    i, w = wp.tid()
    pressure_correction = st.pressure_correction[w]
    if pressure_correction == real(0.0):
        return
    g = gradient[i, w]
    force[i, w] = force[i, w] - st.swell[w] * g
    if mask[i] > real(0.0):
        x[i, w] = x[i, w] + pressure_correction * g


@wp.kernel
def end_nodes(
    # In:
    implicit: int,
    wanted: wp.array(dtype=int),
    x: wp.array2d(dtype=vec3),
    world: wp.array2d(dtype=vec3),
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    dt: wp.array(dtype=real),
    # In and out:
    x_last: wp.array2d(dtype=vec3),
    # Out:
    increment_out: wp.array2d(dtype=vec3),
    velocity_out: wp.array2d(dtype=vec3),
):
    i, w = wp.tid()
    if wanted[w] == 0:
        return
    increment_out[i, w] = x[i, w] - x_last[i, w]
    x_last[i, w] = x[i, w]
    if implicit == 1:
        velocity_out[i, w] = (mat[w] * x[i, w] + pos[w] - world[i, w]) / dt[w]


@wp.kernel
def end_core(
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    pos_out: wp.array(dtype=vec3),
    mat_out: wp.array(dtype=mat33),
):
    w = wp.tid()
    pos_out[w] = pos[w]
    mat_out[w] = mat[w]


@functools.cache
def nodes_kernels(precision: Precision) -> types.SimpleNamespace:
    """Kernels that know directions, for one precision of them."""
    module = f"{__name__}.{precision.name}"
    vec, lower, raised = precision.vec, precision.lower, precision.raised

    @wp.kernel(module=module, enable_backward=False)
    def add_inertia(
        # In:
        density: wp.array(dtype=real),
        damping: real,
        node_volume: wp.array(dtype=real),
        dt: wp.array(dtype=real),
        target: wp.array2d(dtype=vec3),
        x_last: wp.array2d(dtype=vec3),
        x: wp.array2d(dtype=vec3),
        on: wp.array(dtype=int),
        # In and out:
        force: wp.array2d(dtype=vec3),
        # Out:
        inertial_out: wp.array2d(dtype=vec),
    ):
        i, w = wp.tid()
        if on[w] == 0:
            return
        h = dt[w]
        m = density[w] * node_volume[i] / (h * h)
        inertial = -m * (x[i, w] - target[i, w]) - damping * h * m * (x[i, w] - x_last[i, w])
        inertial_out[i, w] = lower(inertial)
        force[i, w] = force[i, w] + inertial

    @wp.kernel(module=module, enable_backward=False)
    def displacement(
        x_last: wp.array2d(dtype=vec3),
        x: wp.array2d(dtype=vec3),
        on: wp.array(dtype=int),
        out: wp.array2d(dtype=vec),
    ):
        i, w = wp.tid()
        if on[w] == 1:
            out[i, w] = lower(x[i, w] - x_last[i, w])

    @wp.kernel(module=module, enable_backward=False)
    def add_damping(
        # In:
        start: wp.array(dtype=int),
        slot: wp.array(dtype=int),
        corner: wp.array2d(dtype=vec),
        damping: real,
        dt: wp.array(dtype=real),
        on: wp.array(dtype=int),
        # In and out:
        force: wp.array2d(dtype=vec3),
    ):
        """Rayleigh damping by the stiffness: `corner` is the tangent times the step's displacement."""
        i, w = wp.tid()
        if on[w] == 0:
            return
        total = vec3()
        for k in range(start[i], start[i + 1]):
            c = corner[slot[k], w]
            total += raised(c)
        force[i, w] = force[i, w] - damping / dt[w] * total

    @wp.kernel(module=module, enable_backward=False)
    def residuals(
        # In:
        chunk: int,
        mask: wp.array(dtype=real),
        force: wp.array2d(dtype=vec3),
        outer_start: wp.array(dtype=int),
        outer: wp.array2d(dtype=vec3),
        core_start: wp.array(dtype=int),
        core: wp.array2d(dtype=vec3),
        external: wp.array2d(dtype=vec3),
        wet: wp.array(dtype=int),
        gradient: wp.array2d(dtype=vec3),
        x: wp.array2d(dtype=vec3),
        rest: wp.array2d(dtype=vec3),
        inertial: wp.array2d(dtype=vec),
        on: wp.array(dtype=int),
        # Out:
        r_out: wp.array2d(dtype=vec),
        part_out: wp.array3d(dtype=real),
        touch_out: wp.array(dtype=int),
        any_active: wp.array(dtype=int),
    ):
        """Residual; by chunks its square, the work of the loads, the square of the liquid's direction, the
        work of inertia."""
        c, w = wp.tid()
        if c == 0 and w == 0:
            any_active[0] = 0
        if on[w] == 0:
            return
        if c == 0:
            touch_out[w] = 0
        rr = real(0.0)
        work = real(0.0)
        gg = real(0.0)
        fly = real(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, force.shape[0])):
            r = vec()
            if mask[i] > real(0.0):
                f = force[i, w]
                rr += wp.length_sq(f)
                r = lower(f)
                if wet.shape[0] > 0 and wet[i] == 1:
                    gg += wp.length_sq(gradient[i, w])
            r_out[i, w] = r
            load = vec3()
            if outer_start[i + 1] > outer_start[i]:
                load = outer[i, w]
            if core_start.shape[0] > 0 and core_start[i + 1] > core_start[i]:
                load += core[i, w]
            if external.shape[0] > 0:
                load += external[i, w]
            if inertial.shape[0] > 0 or wp.length_sq(load) > real(0.0):  # of few nodes otherwise
                u = x[i, w] - rest[i, w % rest.shape[1]]
                work += wp.dot(load, u)
                if inertial.shape[0] > 0:
                    fly += wp.dot(raised(inertial[i, w]), u)
        part_out[0, c, w] = rr
        part_out[1, c, w] = work
        part_out[2, c, w] = gg
        part_out[3, c, w] = fly

    return types.SimpleNamespace(
        add_inertia=add_inertia, displacement=displacement, add_damping=add_damping, residuals=residuals
    )
