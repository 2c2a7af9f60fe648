"""State of a solve of one skin between its phases. A kernel can thus have some of them, and skip worlds that
have finished or are in another phase."""

import enum

import warp as wp

from ..types import real

# next phase: none; broad phase of an increment; Newton's method; decision about increment and step
DONE, SEARCH, NEWTON, BALANCED = (wp.constant(i) for i in range(4))


@wp.struct
class Linear:
    """The linear skin of a solve, u = W f + shift: W = scale * compliance - swell bulk_stiffness a a'."""

    scale: real  # softening over E [1/Pa]
    bulk_stiffness: real  # pressure per volume [Pa/m^3]
    swell: real  # swelling over E [1/Pa]
    bulge: real  # [m^3]


@wp.struct
class LoadStepping:
    """Load stepping of a step, in fractions of the geoms' motion."""

    holds: int  # whether the skin keeps its last state, since no equilibrium was found
    deep: int  # whether a geom is in the core
    again: int  # whether the first try begins at `Previous`
    iterations: int
    at: real
    to: real  # trial load factor
    part: real  # size of the increment
    longest: real  # largest increment
    length: real  # of the motion [m]
    modulus: real  # Young's modulus [Pa]
    left: real  # limit of the increment's cost
    spent: real  # cost of the step, in evaluations of contact
    error: real


@wp.struct
class Increment:
    """State of a load increment."""

    ok: int  # 1: an equilibrium, `CUT`, or 0
    deep: int
    measured: int
    iterations: int
    nface: int
    ncore: int
    nnode: int
    nin: int
    solving: int  # whether Newton's method has started
    searches: int  # number of searches for candidates by the broad phase
    cutbacks: int  # of the first one, to half of its reach, for lack of room
    passes: int  # number of updates of pressure and softening
    view: int  # of `broadphase.choose_view`
    travel: real
    near: wp.int64
    reach: real  # faces closer than this are candidates when the increment begins [m]
    fraction: real  # inner faces closer to the core than this times their displacement are
    largest: real  # displacement of a node [m]
    spent: real
    error: real
    pressure: real
    bulge: real
    solved: wp.vec2d
    after: wp.vec2d
    linear: Linear


class Predictor(enum.IntEnum):
    """Where Newton's first step starts, see `newton_from`."""

    NONE = 0  # from the forces and poses as they are
    PENDING = 1  # from the last equilibrium, at which contact is still to be evaluated
    EVALUATED = 2  # from the last equilibrium, at which contact has been evaluated


@wp.struct
class Newton:
    """State of Newton's method, see `balance`."""

    found: int  # whether an equilibrium was found, as `Increment.ok`
    iterations: int
    predictor: int  # a `Predictor`
    fresh: int  # vector of displacements that the forces bring about, to be found; -1: none
    at: int  # vector of displacements at which contact is to be evaluated
    searching: int  # whether a line search is in progress
    tried: int  # step lengths that were tried
    ends: int  # whether the next evaluation is the last
    most: real  # limit of the cost
    tolerance: real
    spent: real
    error: real
    last: real
    viscosity: real  # artificial
    slope: real
    work: real
    travel: real  # how far nodes have come at most since all faces were evaluated, over all evaluations [m]
    alpha: real  # length of the step that is tried, and what is known of shorter and longer ones
    low: real
    high: real
    at_low: real
    at_high: real
    caught: real  # how long the piece of the last step is in which the residual turned round
    before: Linear  # the skin of the equilibrium from which the first step goes
    linear: Linear


@wp.struct
class Solve:
    """State of the solves in all worlds."""

    phase: wp.array(dtype=int)
    stepping: wp.array(dtype=LoadStepping)
    increment: wp.array(dtype=Increment)
    newton: wp.array(dtype=Newton)
