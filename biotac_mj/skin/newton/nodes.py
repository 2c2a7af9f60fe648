"""Kernels over nodes: sums of forces, residual, inertia and damping, start and end of a step.

Sums over nodes are made chunk by chunk, so that their order is always the same.
"""

import functools
import types
from typing import Any

import warp as wp

from ...kernels import kernel_module
from ..block import sum_of_lanes
from ..types import Precision, mat33, real, vec3, vec6
from .worlds import Worlds

kernel_module(__name__)


@wp.struct
class NodeSlots:
    """CSR lists of element corners: node i sums slot[start[i]] to slot[start[i + 1]], with `lanes`
    threads."""

    lanes: int
    start: wp.array(dtype=int)
    slot: wp.array(dtype=int)


@wp.struct
class SurfaceForces:
    """Contact of a surface, to be summed into nodes; without such a surface no array is set, and kernels see
    empty ones."""

    face: wp.array(dtype=wp.vec3i)
    start: wp.array(dtype=int)  # CSR lists of the corners at each node, by 3 face + corner
    slot: wp.array(dtype=int)
    touching: wp.array2d(dtype=int)  # [face, world]
    corner: wp.array2d(dtype=vec3)  # forces [3 face + corner, world] [N]
    block: wp.array2d(dtype=mat33)  # tangent [6 face + block, world] [N/m]
    node_force: wp.array2d(dtype=vec3)  # [node, world] [N]


@wp.struct
class LiquidForces:
    """Gradient of the liquid's volume, to be summed into nodes; without a liquid no array is set."""

    face: wp.array(dtype=wp.vec3i)
    start: wp.array(dtype=int)  # CSR lists of the corners at each node, by 3 face + corner
    slot: wp.array(dtype=int)
    wet: wp.array2d(dtype=vec3)  # fraction of a face's area that is wet, by corners [face, world]
    corner: wp.array2d(dtype=vec3)  # gradient [3 face + corner, world] [m^2]
    node: wp.array(dtype=int)  # 1: the node belongs to the inner surface
    gradient: wp.array2d(dtype=vec3)  # [node, world] [m^2]


@wp.struct
class Loads:
    """Forces on nodes other than those of elements and inertia; `external` [node, world] [N] has no memory
    where none are prescribed."""

    outer: SurfaceForces
    core: SurfaceForces
    liquid: LiquidForces
    external: wp.array2d(dtype=vec3)


@wp.kernel
def begin_nodes(
    # In:
    mask: wp.array(dtype=real),
    increment: wp.array2d(dtype=vec3),
    st: Worlds,
    # In and out:
    x: wp.array2d(dtype=vec3),
    # Out:
    x_start_out: wp.array2d(dtype=vec3),
):
    """Initial guess of node i: the last step's increment times `repeat`."""
    i, w = wp.tid()
    x_start_out[i, w] = x[i, w]
    if st.active[w] == 1 and mask[i] > real(0.0) and st.repeat[w] > real(0.0):
        x[i, w] = x[i, w] + st.repeat[w] * increment[i, w]


@wp.kernel
def set_where(
    # In:
    value: wp.array2d(dtype=Any),
    on: wp.array(dtype=int),
    # Out:
    out: wp.array2d(dtype=Any),
):
    """out = value [item, 1 or nworld] at item i in the worlds that are on."""
    i, w = wp.tid()
    if on[w] == 1:
        out[i, w] = value[i, w % value.shape[1]]


for _type in (vec3, mat33, vec6):  # compiled with the others, ahead of a capture
    wp.overload(set_where, [wp.array2d(dtype=_type), wp.array(dtype=int), wp.array2d(dtype=_type)])


@wp.kernel
def predict_free_flight(
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
    """Position of node i at the end of a step without forces, in the moved BioTac frame [m]."""
    i, w = wp.tid()
    at = mat_last[w] * x[i, w] + pos_last[w]
    world_out[i, w] = at
    target_out[i, w] = wp.transpose(mat[w]) * (at + dt[w] * velocity[i, w] - pos[w])


@wp.func
def sum_contact(i: int, w: int, lane: int, lanes: int, surface: SurfaceForces):
    """Sums a surface's contact forces at node i, and stores them where it has the node."""
    push = vec3()
    for k in range(surface.start[i] + lane, surface.start[i + 1], lanes):
        s = surface.slot[k]
        if surface.touching[s // 3, w] == 1:
            push += surface.corner[s, w]
    push = sum_of_lanes(push, lanes)
    if surface.start[i + 1] > surface.start[i]:  # elsewhere it stays zero
        surface.node_force[i, w] = push
    return push


@wp.kernel
def assemble_force(
    # In:
    elements: NodeSlots,
    corner: wp.array2d(dtype=vec3),
    external: wp.array2d(dtype=vec3),
    pressure: wp.array(dtype=real),
    on: wp.array(dtype=int),
    # In and out:
    outer: SurfaceForces,
    core: SurfaceForces,
    liquid: LiquidForces,
    # Out:
    force_out: wp.array2d(dtype=vec3),
):
    """Sums the forces of elements, contact, liquid and loads at node i [N]. All lanes write the same."""
    i, w, lane = wp.tid()
    if on[w] == 0:
        return
    lanes = elements.lanes
    total = vec3()
    for k in range(elements.start[i] + lane, elements.start[i + 1], lanes):
        total += corner[elements.slot[k], w]
    total = sum_of_lanes(total, lanes)
    if external.shape[0] > 0:
        total += external[i, w]
    total += sum_contact(i, w, lane, lanes, outer)
    if core.start.shape[0] > 0:
        total += sum_contact(i, w, lane, lanes, core)
    if liquid.start.shape[0] > 0:
        push = vec3()
        for k in range(liquid.start[i] + lane, liquid.start[i + 1], lanes):
            push += liquid.corner[liquid.slot[k], w]
        push = sum_of_lanes(push, lanes)
        if liquid.start[i + 1] > liquid.start[i]:
            liquid.gradient[i, w] = push
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
    """Moves node i along the volume's gradient so that the volume fits the pressure that
    `convergence.check_convergence` has found, and corrects the liquid's force. The motion is too small to
    change other forces. Without this a press of a filled skin takes 13 to 21 % more evaluations and
    products."""
    i, w = wp.tid()
    pressure_correction = st.pressure_correction[w]
    if pressure_correction == real(0.0):
        return
    g = gradient[i, w]
    force[i, w] = force[i, w] - st.pressure_response[w] * g
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
    """Stores increment, position and velocity of node i at the end of a step."""
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
    """Stores the pose of the BioTac frame at the end of a step."""
    w = wp.tid()
    pos_out[w] = pos[w]
    mat_out[w] = mat[w]


@functools.cache
def nodes_kernels(precision: Precision) -> types.SimpleNamespace:
    """Kernels with directions, for one precision of these."""
    module = kernel_module(f"{__name__}.{precision.name}")
    vec, lower, raised = precision.vec, precision.lower, precision.raised

    @wp.kernel(module=module)
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
        """Inertial force of node i and its damping by mass, of backward Euler [N]."""
        i, w = wp.tid()
        if on[w] == 0:
            return
        h = dt[w]
        m = density[w] * node_volume[i] / (h * h)
        inertial = -m * (x[i, w] - target[i, w]) - damping * h * m * (x[i, w] - x_last[i, w])
        inertial_out[i, w] = lower(inertial)
        force[i, w] = force[i, w] + inertial

    @wp.kernel(module=module)
    def displacement(
        x_last: wp.array2d(dtype=vec3),
        x: wp.array2d(dtype=vec3),
        on: wp.array(dtype=int),
        out: wp.array2d(dtype=vec),
    ):
        """Displacement of node i in this step [m]."""
        i, w = wp.tid()
        if on[w] == 1:
            out[i, w] = lower(x[i, w] - x_last[i, w])

    @wp.kernel(module=module)
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
        """Rayleigh damping of node i by the stiffness. corner: tangent times the step's displacement."""
        i, w = wp.tid()
        if on[w] == 0:
            return
        total = vec3()
        for k in range(start[i], start[i + 1]):
            c = corner[slot[k], w]
            total += raised(c)
        force[i, w] = force[i, w] - damping / dt[w] * total

    @wp.kernel(module=module)
    def residuals(
        # In:
        chunk: int,
        mask: wp.array(dtype=real),
        force: wp.array2d(dtype=vec3),
        loads: Loads,
        x: wp.array2d(dtype=vec3),
        rest: wp.array2d(dtype=vec3),
        inertial: wp.array2d(dtype=vec),
        st: Worlds,
        # Out:
        r_out: wp.array2d(dtype=vec),
        norms_out: wp.array3d(dtype=real),
        any_active: wp.array(dtype=int),
    ):
        """Residual r of a chunk of nodes; norms [quantity, chunk, world]: square of r, work of the loads,
        square of the volume's gradient, work of inertia."""
        c, w = wp.tid()
        if c == 0 and w == 0:
            any_active[0] = 0
        if st.active[w] == 0:
            return
        if c == 0:
            st.touched[w] = 0
        outer = loads.outer
        core = loads.core
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
                if loads.liquid.node.shape[0] > 0 and loads.liquid.node[i] == 1:
                    gg += wp.length_sq(loads.liquid.gradient[i, w])
            r_out[i, w] = r
            load = vec3()
            if outer.start[i + 1] > outer.start[i]:
                load = outer.node_force[i, w]
            if core.start.shape[0] > 0 and core.start[i + 1] > core.start[i]:
                load += core.node_force[i, w]
            if loads.external.shape[0] > 0:
                load += loads.external[i, w]
            if inertial.shape[0] > 0 or wp.length_sq(load) > real(0.0):  # few nodes have a load
                u = x[i, w] - rest[i, w % rest.shape[1]]
                work += wp.dot(load, u)
                if inertial.shape[0] > 0:
                    fly += wp.dot(raised(inertial[i, w]), u)
        norms_out[0, c, w] = rr
        norms_out[1, c, w] = work
        norms_out[2, c, w] = gg
        norms_out[3, c, w] = fly

    return types.SimpleNamespace(
        add_inertia=add_inertia, displacement=displacement, add_damping=add_damping, residuals=residuals
    )
