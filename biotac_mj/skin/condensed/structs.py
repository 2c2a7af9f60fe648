"""Structs of a condensed solve: constants of a skin, memory of a world, scratch arrays."""

import warp as wp

from ..bodies import Bodies
from ..contact.faces import Contact
from ..contact.posed import Geoms
from ..state import declared
from ..types import mat33, real, vec3
from .states import Solve


@wp.struct
class Constants:
    """Constants of a skin, the same in all worlds. Contact coordinates are three for each free outer node,
    then one for each inner node that can meet the core, away from it. Compliances are those of Young's
    modulus one."""

    node: wp.array(dtype=int)  # free outer nodes
    number: wp.array(dtype=int)  # of each node among them; -1: it is held, or not there
    opposite: wp.array(dtype=int)  # the node across the wall from each of them
    free: wp.array(dtype=int)  # all free nodes
    rest: wp.array2d(dtype=vec3)
    face: wp.array(dtype=wp.vec3i)
    sample: wp.array(dtype=vec3)
    start: wp.array(dtype=int)  # corners of faces at each node, as CSR lists
    slot: wp.array(dtype=int)
    # nodes that share a face with each outer one, itself too, as CSR lists of their numbers; and of each such
    # pair the blocks of stiffness: 9 face + 3 corner + other corner
    ring_start: wp.array(dtype=int)
    ring: wp.array(dtype=int)
    term_start: wp.array(dtype=int)
    term: wp.array(dtype=int)
    compliance: wp.array2d(dtype=float)  # of contact coordinates [m/N Pa]
    row: wp.array2d(dtype=wp.float16)  # of contact coordinates, over the coordinates of all free nodes,
    largest: wp.array(dtype=float)  # times this
    give: wp.array(dtype=vec3)  # of the liquid's pressure, over the free nodes [m]
    give_at: wp.array(dtype=real)  # over contact coordinates
    liquid_give: real  # [m^3]
    gradient: wp.array(dtype=vec3)  # of the cavity's volume, over the free nodes [m^2]
    wet: wp.array(dtype=wp.vec3i)  # faces of the cavity
    cavity: real  # its volume at rest [m^3]
    center: vec3  # of a ball around the skin at rest [m]
    radius: real
    core: Geoms
    core_vert: wp.array(dtype=vec3)
    core_depth: real  # of a geom that no skin fits between
    inner: wp.array(dtype=int)  # nodes that can meet the core
    inner_number: wp.array(dtype=int)  # of each node among them, -1: none
    away: wp.array(dtype=vec3)
    inner_face: wp.array(dtype=wp.vec3i)
    inner_area: wp.array(dtype=real)
    inner_start: wp.array(dtype=int)
    inner_slot: wp.array(dtype=int)
    inner_ring_start: wp.array(dtype=int)  # as those of outer nodes
    inner_ring: wp.array(dtype=int)
    inner_term_start: wp.array(dtype=int)
    inner_term: wp.array(dtype=int)
    inner_rest: wp.array2d(dtype=real)  # gaps of the samples at rest, nothing more than nothing [m]
    inner_gap: wp.array2d(dtype=real)  # these gaps by the core's spline, and the least of each face [m]
    inner_far: wp.array(dtype=real)
    inner_slope: wp.array2d(dtype=vec3)  # their slopes
    inner_bend: wp.array(dtype=real)  # by which fraction of a motion at most that is off which they foretell
    inner_mean_slope: wp.array(dtype=vec3)  # of each face, and how far its slopes are from it at most
    inner_spread: wp.array(dtype=real)
    # of `correction.Correction`
    depth: real
    most: real
    width: real
    stretch: real
    squeeze: real
    squeezed: real
    narrow: real


@wp.struct
@declared("condensed")
class Remembered:
    """The equilibrium at the end of the last step [item, world]; `state.VARIABLES` has its fields."""


@wp.struct
class Previous:
    """Result of the previous solve: the equilibrium and the geoms' poses in it [geom, world]; no geoms where
    poses are prescribed."""

    balance: Remembered
    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    begins: wp.array(dtype=int)  # [world] 1: the next solve is another one of the same step, and begins there


# vectors over the coordinates of the candidates
F, U, G, DF, DU, TRY, BACK = (wp.constant(i) for i in range(7))
NVECTOR = 7


@wp.struct
class Scratch:
    """Scratch arrays of a solve [world, item]: candidates, nodes and faces that may touch, and their
    results."""

    x: wp.array2d(dtype=vec3)  # nodes, those of the state [node, world] [m]
    touch: Contact  # of the outer surface
    near: wp.array2d(dtype=int)  # which faces are candidates, by their place among them plus one; 0: none
    near_core: wp.array2d(dtype=int)  # which inner ones
    free: wp.array2d(dtype=real)  # `Newton.travel` until which a candidate face touches nothing [m]
    look: wp.array2d(dtype=int)  # faces of which that is not known yet
    face: wp.array2d(dtype=int)  # their numbers
    core_face: wp.array2d(dtype=int)
    close_to: wp.array2d(dtype=wp.int64)  # which geoms may touch a face that is a candidate
    place: wp.array2d(dtype=int)  # of an outer node among the candidates; -1: it is none
    core_place: wp.array2d(dtype=int)
    force: wp.array2d(dtype=vec3)  # on all outer nodes, to begin with [N]
    core_force: wp.array2d(dtype=real)
    node: wp.array2d(dtype=int)  # numbers of the candidates
    core_node: wp.array2d(dtype=int)
    coordinate: wp.array2d(dtype=int)
    loaded: wp.array2d(dtype=int)  # contact coordinates with a force, and it, of a product
    load: wp.array2d(dtype=float)
    loaded_place: wp.array2d(dtype=int)  # and their places among the candidates'
    push: wp.array2d(dtype=float)  # of the equations, how pressure pushes them
    vector: wp.array3d(dtype=real)
    on: wp.array2d(dtype=int)  # which touch
    stiff: wp.array2d(dtype=real)  # stiffness of inner coordinates, lumped [N/m]
    gap: wp.array3d(dtype=real)  # of the candidates' samples from the core [m], where their nodes are `BACK`
    now: wp.array3d(dtype=real)  # and where they are now
    core_block: wp.array3d(dtype=float)  # stiffness of pairs of inner nodes [N/m]
    touched: wp.array2d(dtype=int)  # candidates that touch, outer nodes first
    block: wp.array3d(dtype=wp.mat33)  # stiffness of pairs of nodes [N/m]
    matrix: wp.array2d(dtype=float)
    column: wp.array2d(dtype=int)  # contact coordinates of the equations
    column_place: wp.array2d(dtype=int)  # and their places among the candidates'
    # by one thread, see `lanes.gather_rows`: compliance between candidates, and in the columns of the
    # equations; which rows are ready (1: of the first, 2: of both); the number of the candidates'
    # coordinates and these, and of the columns; sums of rows
    between: wp.array2d(dtype=float)
    columns: wp.array2d(dtype=float)
    ready: wp.array2d(dtype=int)
    last: wp.array2d(dtype=int)
    last_column: wp.array2d(dtype=int)
    sum: wp.array2d(dtype=float)
    held: wp.array2d(dtype=float)  # of the equations, how they are held against the liquid's pressure
    solve: Solve
    previous: Previous
    pos: wp.array2d(dtype=vec3)  # where geoms are asked to be, and where the step began [geom, world]
    mat: wp.array2d(dtype=mat33)
    from_pos: wp.array2d(dtype=vec3)
    from_mat: wp.array2d(dtype=mat33)
    sought_x: wp.array2d(dtype=vec3)  # where nodes and geoms were when candidates were sought first
    sought_pos: wp.array2d(dtype=vec3)
    sought_mat: wp.array2d(dtype=mat33)
    held_pos: wp.array2d(dtype=vec3)  # where they were at the equilibrium from which a predictor starts
    held_mat: wp.array2d(dtype=mat33)
    # of `broadphase.choose_view` [view, geom, world]: where geoms were when it was taken; [world, view]: how
    # far faces of the resting skin were from them at least [m], which geoms were near each; how deep they
    # were in the core [m]; the next view
    seen_pos: wp.array3d(dtype=vec3)
    seen_mat: wp.array3d(dtype=mat33)
    far: wp.array3d(dtype=real)
    seen: wp.array3d(dtype=wp.int64)
    seen_depth: wp.array2d(dtype=real)
    turn: wp.array(dtype=int)
    most_contacts: int  # samples that may touch
    most: wp.array(dtype=real)  # what a step may cost, an evaluation of contact being one
    spent: wp.array(dtype=real)  # what it has
    deep: wp.array(dtype=int)  # whether the core was in the way
    bodies: Bodies
    arm: wp.array2d(dtype=vec3)  # where the outer candidates are [m]
    group: wp.array2d(dtype=int)  # whose body each of them answers to
    borders: wp.array(dtype=int)  # equations of the bodies
    slack: wp.array2d(dtype=real)  # of the model of each group, see `coupling.implicit.rounds` [group, world]
