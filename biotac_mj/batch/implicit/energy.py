"""What energy the skins of a batch may give in a step, and what is withheld of their push so that they give
no more. It is the account of `coupled.py` and `World._restrain` in `coupling/implicit/`, for all worlds at
once with one thread each, made after the `rounds`."""

import warp as wp

from ...coupling.implicit.rules import EULER, in_store, lacking, spared
from ...geometry.rigid_warp import is_finite, motion
from ...skin.newton.worlds import CONVERGED
from ..kernels import Model
from ..marks import MarkedWorlds, mark
from .compliance import substitute
from .rounds import Rounds, Solid, force_of

__all__ = [
    "conclude",
    "find_energy",
    "find_gain",
    "pass_by",
    "restrain",
    "withdraw",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec6 = wp.spatial_vectord

_in_store, _lacking, _spared = (wp.func(rule) for rule in (in_store, lacking, spared))
mat66 = wp.spatial_matrixd

# of the most that a skin holds: accelerations are of single precision
_ROUNDING = wp.constant(wp.float64(1e-3))


@wp.func
def acting(r: Rounds, model: Model, wrench: wp.array2d(dtype=vec6), g: int, w: int):
    """What acts on a body, as MuJoCo takes it: linear in the accelerations, from its wrench without them."""
    return wrench[g, w] - model.tangent0[g, w] * r.moved[g, w] + r.amiss[g, w]


@wp.func
def given(r: Rounds, model: Model, wrench: wp.array2d(dtype=vec6), g: int, w: int):
    """Work of what acts on a body on its way [J]; not on what was lost before the step."""
    motion = r.straight[g, w]
    if not (is_finite(r.here_pos[g, w], r.here_mat[g, w]) and wp.isfinite(wp.dot(motion, motion))):
        return real(0.0)
    return wp.dot(acting(r, model, wrench, g, w), r.travel[g, w])


@wp.func
def most_energy(r: Rounds, force: real, solid: Solid, w: int):
    """The most that a skin which pushes with so much force can hold: over the whole way to the core [J]."""
    if solid.inertial == 1:
        return real(wp.inf)
    most = solid.thickness * force
    if r.surface.shape[0] > 0:
        most += r.surface[w] * solid.area
    return most


@wp.func
def draws(r: Rounds, model: Model, wrench: wp.array2d(dtype=vec6), w: int, slack: real):
    """What the bodies of a skin lack together, and what they may leave to each other [J]. slack: of the most
    that the skin can hold, by which each may get more."""
    lacks = real(0.0)
    spare = real(0.0)
    for g in range(r.pos.shape[0]):
        gets = given(r, model, wrench, g, w)
        spare += _spared(r.left[g, w], r.store[g, w], gets)
        if slack > real(0.0):
            gets -= slack * r.most[g, w]
        lacks += _lacking(r.store[g, w], gets)
    return wp.vec2d(lacks, spare)


@wp.func
def overdraws(r: Rounds, model: Model, wrench: wp.array2d(dtype=vec6), w: int, slack: real):
    """Whether what acts gives bodies more energy than they have, or is no number."""
    both = draws(r, model, wrench, w, slack)
    return not both[0] <= both[1]


@wp.kernel
def find_energy(
    # In:
    taking_part: wp.array(dtype=int),
    model: Model,
    last: Model,
    wrench: wp.array2d(dtype=vec6),
    solid: Solid,
    # In and out:
    r: Rounds,
    # Out:
    greedy_out: wp.array(dtype=int),
    damped: MarkedWorlds,
):
    """Finds the energy that each body has in the skin: that of the last step, and what those have put in who
    have moved it since. Skins that would give more are greedy while they have not yet made backward Euler's
    step, which gives less: their worlds are marked."""
    w = wp.tid()
    greedy_out[w] = 0
    if taking_part[w] == 0:
        return
    for g in range(r.pos.shape[0]):
        jump = motion(r.here_pos[g, w], r.here_mat[g, w], r.end_pos[g, w], r.end_mat[g, w])
        acts = acting(r, model, wrench, g, w)
        before = wp.dot(last.wrench0[g, w], jump)
        now = wp.dot(acts, jump)
        pushes = force_of(acts)
        # a solve that lost its way knows little of the force that was there before it
        most = most_energy(r, wp.max(force_of(last.wrench0[g, w]), pushes), solid, w)
        store = _in_store(r.left[g, w], before, now, most)
        if r.placed[g, w] == 1:  # who puts bodies into a skin puts in what it pushes with, elsewhere nothing
            store = most_energy(r, wp.where(r.inside[w] == 1, pushes, real(0.0)), solid, w)
        r.most[g, w] = most
        r.store[g, w] = store
    least = real(EULER)
    for g in range(r.pos.shape[0]):
        least = wp.min(least, r.gamma[g, w])
    if least < real(EULER) and overdraws(r, model, wrench, w, real(0.0)):
        greedy_out[w] = 1
        mark(damped, w)


@wp.kernel
def restrain(
    # In:
    worlds: wp.array(dtype=int),
    model: Model,
    wrench: wp.array2d(dtype=vec6),
    # In and out:
    r: Rounds,
    going: MarkedWorlds,
):
    """Takes the push on bodies that would get more energy than they have, and marks their worlds. What
    remains without it is the skin's tangent about the present pose: a damper."""
    w = wp.tid()
    if worlds[w] == 0 or not overdraws(r, model, wrench, w, real(0.0)):
        return
    for g in range(r.pos.shape[0]):
        gets = given(r, model, wrench, g, w)
        if r.push[g, w] > real(0.0) and not _lacking(r.store[g, w], gets) == real(0.0):
            r.push[g, w] = real(0.0)
            mark(going, w)


@wp.kernel
def find_gain(
    # In:
    taking_part: wp.array(dtype=int),
    model: Model,
    wrench: wp.array2d(dtype=vec6),
    r: Rounds,
    # Out:
    gains: MarkedWorlds,
):
    """Marks worlds where a skin gives more than it has whatever is withheld, or what acts is no number."""
    w = wp.tid()
    if taking_part[w] == 1 and overdraws(r, model, wrench, w, _ROUNDING):
        mark(gains, w)


@wp.kernel
def withdraw(
    # In:
    gains: wp.array(dtype=int),
    # In and out:
    model: Model,
    r: Rounds,
    correction: wp.array2d(dtype=vec6),
    warmstart: wp.array2d(dtype=float),
):
    """No skin of such a world acts in this step, as at last in `World._act_by_force`; mujoco_warp's solver
    begins anew, since what it found may be no number."""
    w = wp.tid()
    if gains[w] == 0:
        return
    for i in range(warmstart.shape[1]):
        warmstart[w, i] = float(0.0)
    r.settled[w] = 0
    for g in range(correction.shape[0]):
        r.push[g, w] = real(0.0)
        model.wrench0[g, w] = vec6()
        model.tangent0[g, w] = mat66()
        correction[g, w] = vec6()


@wp.kernel
def add_stiffness(
    # In:
    jacobian: wp.array3d(dtype=vec6),
    model: Model,
    # In and out:
    stiffness: wp.array3d(dtype=real),
):
    """Adds a skin's stiffness against the degrees of freedom [world, dof, dof], a row by each thread."""
    w, i = wp.tid()
    for g in range(jacobian.shape[0]):
        held = wp.transpose(model.tangent0[g, w]) * jacobian[g, w, i]
        if wp.dot(held, held) > real(0.0):
            for j in range(jacobian.shape[2]):
                stiffness[w, i, j] = stiffness[w, i, j] + wp.dot(held, jacobian[g, w, j])


@wp.kernel
def drive(
    # In:
    stiffness: wp.array3d(dtype=real),
    L: wp.array3d(dtype=real),
    response: wp.array3d(dtype=real),
    # Out:
    driven_out: wp.array3d(dtype=real),
):
    """Accelerations by what all skins do against motions of the degrees of freedom [world, column, dof]."""
    w, c = wp.tid()
    for i in range(stiffness.shape[1]):
        held = real(0.0)
        for j in range(stiffness.shape[1]):
            held += stiffness[w, i, j] * response[w, c, j]
        driven_out[w, c, i] = held
    substitute(L, w, c, driven_out)


@wp.kernel
def add_powers(
    # In:
    stiffness: wp.array3d(dtype=real),
    response: wp.array3d(dtype=real),
    driven: wp.array3d(dtype=real),
    model: Model,
    # Out:
    power_out: wp.array2d(dtype=wp.vec2d),
):
    """What each wrench on a skin's bodies [world, column] adds to the traces of the second and the fourth
    power of the modes, see `SkinGroup.frequencies`."""
    w, c = wp.tid()
    g = c / 6
    second = vec6()
    fourth = vec6()
    if wp.ddot(model.tangent0[g, w], model.tangent0[g, w]) > real(0.0):
        for i in range(stiffness.shape[1]):
            once = real(0.0)
            twice = real(0.0)
            for j in range(stiffness.shape[1]):
                once += stiffness[w, i, j] * response[w, c, j]
                twice += stiffness[w, i, j] * driven[w, c, j]
            for b in range(6):
                second[b] = second[b] + once * response[w, 6 * g + b, i]
                fourth[b] = fourth[b] + twice * driven[w, 6 * g + b, i]
    T = model.tangent0[g, w]
    power_out[w, c] = wp.vec2d((T * second)[c % 6], (T * fourth)[c % 6])


@wp.func
def _frequency(power: wp.array2d(dtype=wp.vec2d), g: int, w: int):
    """As `SkinGroup.frequencies`."""
    total = wp.vec2d()
    for c in range(6 * g, 6 * g + 6):
        total += power[w, c]
    if total[0] > real(0.0) and total[1] > real(0.0):
        return wp.sqrt(wp.sqrt(total[1] / total[0]))
    return real(0.0)


@wp.kernel
def conclude(
    # In:
    taking_part: wp.array(dtype=int),
    model: Model,
    wrench: wp.array2d(dtype=vec6),
    reason: wp.array(dtype=int),
    power: wp.array2d(dtype=wp.vec2d),
    # In and out:
    r: Rounds,
):
    """Keeps the energy that is left, and how fast bodies bounce."""
    w = wp.tid()
    if taking_part[w] == 0:
        return
    both = draws(r, model, wrench, w, real(0.0))
    passed = wp.min(both[0], both[1])  # from some bodies to others
    for g in range(r.pos.shape[0]):
        r.frequency[g, w] = _frequency(power, g, w)
        gets = given(r, model, wrench, g, w)
        # what is withheld is in the skin all the same; a damper, which is all that acts then, keeps nothing
        left = r.store[g, w] - wp.where(r.push[g, w] > real(0.0), gets, wp.max(gets, real(0.0)))
        if passed > real(0.0):
            left += passed * _lacking(r.store[g, w], gets) / both[0]
            left -= passed * _spared(r.left[g, w], r.store[g, w], gets) / both[1]
        left = wp.min(left, r.most[g, w])
        if r.open[g, w] == 1 or (r.placed[g, w] == 1 and r.inside[w] == 1):
            # what was put in is not known before a balance is found
            r.open[g, w] = wp.where(reason[w] == CONVERGED, 0, 1)
            if r.open[g, w] == 1:
                left = real(wp.inf)
        r.left[g, w] = left


@wp.kernel
def pass_by(taking_part: wp.array(dtype=int), area: real, r: Rounds):
    """Instead of all rounds in worlds where no skin takes part: bodies go where they go, a skin has the
    energy of its adhesion."""
    w = wp.tid()
    if taking_part[w] == 1:
        return
    r.passed[w] = 1
    r.rounds[w] = 1
    for g in range(r.pos.shape[0]):
        r.left[g, w] = real(0.0)
        if r.surface.shape[0] > 0:
            r.left[g, w] = r.surface[w] * area
        r.end_pos[g, w] = r.start_pos[g, w]
        r.end_mat[g, w] = r.start_mat[g, w]
