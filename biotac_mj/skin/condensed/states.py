"""What a solve of one skin stands at between its phases: so each phase can be a kernel of its own, and a
world that is done, or in another phase, is passed over."""

import warp as wp

from ..types import real

__all__ = [
    "BALANCED",
    "DONE",
    "EVALUATE",
    "Increment",
    "Linear",
    "LoadStepping",
    "NEWTON",
    "Newton",
    "SEARCH",
    "Solve",
]

wp.set_module_options({"enable_backward": False})

# what comes next: nothing; the broad phase of an increment; contact; a step of Newton's method; what its end
# means for the increment and the step
DONE, SEARCH, EVALUATE, NEWTON, BALANCED = (wp.constant(i) for i in range(5))


@wp.struct
class Linear:
    """The skin of a solve, u = W f + shift: W = scale * compliance - swell bulk_stiffness a a'."""

    scale: real  # softening over E [1/Pa]
    bulk_stiffness: real  # pressure per volume [Pa/m^3]
    swell: real  # swelling over E [1/Pa]
    bulge: real  # [m^3]


@wp.struct
class LoadStepping:
    """Of a step: how far the geoms have come, as a fraction of their motion."""

    known: int  # whether it is known where they come from
    holds: int  # whether the skin stays as it is remembered, since no balance was found
    deep: int  # whether the core was in the way
    iterations: int
    at: real
    to: real  # which load factor is tried
    part: real  # of this increment
    longest: real  # increment
    length: real  # of the motion [m]
    modulus: real  # Young's [Pa]
    left: real  # what this increment may cost
    spent: real  # what the step has cost, an evaluation of contact being one
    error: real


@wp.struct
class Increment:
    """What an increment came to so far."""

    ok: int  # 1: a balance, `CUT`, or 0
    deep: int
    measured: int
    iterations: int
    nface: int
    ncore: int
    nnode: int
    nin: int
    solving: int  # whether Newton's method was begun
    searches: int  # how often the broad phase has looked for candidates
    passes: int  # how often pressure and softening were found
    view: int  # of `broadphase.choose_view`
    travel: real
    near: wp.int64
    reach: real  # faces nearer than this are candidates [m]
    spent: real
    error: real
    pressure: real
    bulge: real
    solved: wp.vec2d
    after: wp.vec2d
    linear: Linear


@wp.struct
class Newton:
    """Of Newton's method, see `balance`."""

    found: int  # whether a balance is, as `Increment.ok`
    iterations: int
    foretold: int  # 1: contact is to be evaluated where the geoms are held, 2: it has been
    fresh: int  # vector of displacements that the forces bring about, to be found; -1: none
    at: int  # vector of displacements at which contact is to be evaluated
    searching: int  # along a step
    tried: int  # lengths of it
    ends: int  # whether what is to be evaluated is where it ends
    most: real  # what it may cost
    tolerance: real
    spent: real
    error: real
    last: real
    viscosity: real  # artificial
    slope: real
    work: real
    alpha: real  # length of the step that is tried, and what is known of shorter and longer ones
    low: real
    high: real
    at_low: real
    at_high: real
    caught: real  # how long the piece of the last step is in which the residual turned round
    before: Linear  # the skin of the balance from which the first step goes
    linear: Linear


@wp.struct
class Solve:
    """Of all worlds."""

    phase: wp.array(dtype=int)
    stepping: wp.array(dtype=LoadStepping)
    increment: wp.array(dtype=Increment)
    newton: wp.array(dtype=Newton)
