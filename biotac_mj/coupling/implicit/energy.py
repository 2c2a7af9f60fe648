"""Limits the energy that skins give to bodies in a step, by withholding a fraction of their force: one thread
for each world.

The energy account is updated after the rounds. Forces on a body are linear in the accelerations, as in
MuJoCo: `Rounds.acting`."""

import warp as wp

from ...geometry.rigid_warp import is_finite, motion
from ...kernels import kernel_module
from ...skin.newton.worlds import CONVERGED
from ...skin.types import mat66, real, vec6
from .rounds import MarkedWorlds, Model, Rounds, Solid, force_of, mark
from .rules import EULER, beta_of, fraction_within, in_store, lacking, spared

kernel_module(__name__)


_in_store, _lacking, _spared = (wp.func(rule) for rule in (in_store, lacking, spared))
_beta_of, _fraction_within = (wp.func(rule) for rule in (beta_of, fraction_within))


@wp.func
def given(r: Rounds, g: int, w: int):
    """Work of the skin's forces on a body along its motion in the step [J], and what the core's contact lifts
    it by while the skin pushes it; without forces that were lost before the step. What that contact takes in
    may come from another body that presses this one onto the core: the skin has not got it."""
    acts = r.acting[g, w]
    if acts == vec6():  # whatever lifts the body, the skin gives nothing
        return real(0.0)
    motion = r.straight[g, w]
    if not (is_finite(r.here_pos[g, w], r.here_mat[g, w]) and wp.isfinite(wp.dot(motion, motion))):
        return real(0.0)
    return wp.dot(acts, r.travel[g, w]) + wp.max(r.lifted[g, w], real(0.0))


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
def _is_unknown(r: Rounds, g: int, reason: int, w: int):
    """Whether a body began in the skin, of which no equilibrium has been found since."""
    began_inside = wp.isinf(r.left[g, w]) or (r.placed[g, w] == 1 and r.inside[w] == 1)
    return began_inside and reason != CONVERGED


@wp.func
def draws(r: Rounds, w: int):
    """Energy that the bodies of a skin lack together, and that they may give to each other [J]."""
    lacks = real(0.0)
    spare = real(0.0)
    for g in range(r.pos.shape[0]):
        gets = given(r, g, w)
        spare += _spared(r.left[g, w], r.store[g, w], gets)
        lacks += _lacking(r.store[g, w], gets)
    return wp.vec2d(lacks, spare)


@wp.func
def overdraws(r: Rounds, w: int):
    """Whether what acts gives bodies more energy than they have, or is no number."""
    both = draws(r, w)
    return not both[0] <= both[1]


@wp.kernel
def find_energy(
    # In:
    taking_part: wp.array(dtype=int),
    last: Model,
    reason: wp.array(dtype=int),
    solid: Solid,
    # In and out:
    r: Rounds,
    # Out:
    greedy_out: wp.array(dtype=int),
    damped: MarkedWorlds,
):
    """Finds the energy that each body has in the skin: that of the last step, and the work of what has moved
    the body since. Skins that would give more are greedy while they have not yet made backward Euler's step,
    which gives less: their worlds are marked.

    How much was put into a skin that a body begins in is not known before an equilibrium is found: until then
    the skin may brake the body and gives it nothing."""
    w = wp.tid()
    greedy_out[w] = 0
    if taking_part[w] == 0:
        return
    for g in range(r.pos.shape[0]):
        jump = motion(r.here_pos[g, w], r.here_mat[g, w], r.end_pos[g, w], r.end_mat[g, w])
        acts = r.acting[g, w]
        before = wp.dot(last.wrench0[g, w], jump)
        now = wp.dot(acts, jump)
        pushes = force_of(acts)
        # the force of a failed solve may be far below the one before it
        most = most_energy(r, wp.max(force_of(last.wrench0[g, w]), pushes), solid, w)
        store = _in_store(r.left[g, w], before, now, most)
        if r.placed[g, w] == 1:  # placing a body in a skin does the work of its push; outside it does none
            store = most_energy(r, wp.where(r.inside[w] == 1, pushes, real(0.0)), solid, w)
        if _is_unknown(r, g, reason[w], w) and solid.inertial == 0:
            store = real(0.0)
        r.most[g, w] = most
        r.store[g, w] = store
    undamped = int(0)
    for g in range(r.pos.shape[0]):
        if r.gamma[g, w] < real(EULER):
            undamped += 1
    if solid.inertial == 0 and undamped > 0 and overdraws(r, w):
        greedy_out[w] = 1
        mark(damped, w)


@wp.kernel
def restrain(
    # In:
    worlds: wp.array(dtype=int),
    rounding: real,
    solid: Solid,
    compliance: wp.array3d(dtype=mat66),
    # In and out:
    model: Model,
    r: Rounds,
    warmstart: wp.array2d(dtype=float),
    going: MarkedWorlds,
):
    """Withholds so much of the push on bodies that would get more energy than they have that they get what
    they have, all where that was not enough. Where others turn even that into a gain the skin does not act on
    the body in this step, and mujoco_warp's solver begins anew, since what it found may be no number. Marks
    their worlds.

    Args:
      rounding: of the most that a skin holds which pushes with what acts, may be the engine's. A solve that
        lost its way may leave a model so stiff and far off that what acts of it is rounding alone.
      compliance: of `Bodies`. warmstart: (nworld, nv) of mujoco_warp, empty without.
    """
    w = wp.tid()
    if worlds[w] == 0 or not overdraws(r, w):
        return
    for g in range(r.pos.shape[0]):
        gets = given(r, g, w)
        lacks = _lacking(r.store[g, w], gets)
        acts = r.acting[g, w]
        slack = real(0.0)
        if rounding > real(0.0):
            slack = rounding * most_energy(r, force_of(acts), solid, w)
        if r.push[g, w] > real(0.0) and not lacks == real(0.0):
            moves = compliance[g, g, w] * acts
            own = real(0.5) / _beta_of(r.gamma[g, w]) * wp.dot(acts, moves)
            fraction = real(0.0)
            if r.push[g, w] == real(1.0):
                fraction = _fraction_within(r.store[g, w], gets - own, own)
            # the rows stay, and take their part of the change
            change = (real(1.0) - fraction) * (acts + model.tangent0[g, w] * moves)
            r.withheld[g, w] = r.withheld[g, w] + change
            r.push[g, w] = fraction * r.push[g, w]
            mark(going, w)
        elif not (lacks <= slack or (model.wrench0[g, w] == vec6() and model.tangent0[g, w] == mat66())):
            r.push[g, w] = real(0.0)
            r.withheld[g, w] = vec6()
            r.settled[w] = 0
            model.wrench0[g, w] = vec6()
            model.tangent0[g, w] = mat66()
            for i in range(warmstart.shape[1]):
                warmstart[w, i] = 0.0
            mark(going, w)


@wp.kernel
def conclude(
    # In:
    taking_part: wp.array(dtype=int),
    reason: wp.array(dtype=int),
    r: Rounds,
    # Out:
    left_out: wp.array2d(dtype=real),
):
    """Finds the energy that is left to the bodies; left_out may be that of the last step, which it takes the
    place of."""
    w = wp.tid()
    if taking_part[w] == 0:
        return
    both = draws(r, w)
    passed = real(0.0)  # from some bodies to others
    if wp.isfinite(both[0] + both[1]):
        passed = wp.min(both[0], both[1])
    for g in range(r.pos.shape[0]):
        gets = given(r, g, w)
        left = r.store[g, w] - gets
        if passed > real(0.0):
            left += passed * _lacking(r.store[g, w], gets) / both[0]
            left -= passed * _spared(r.left[g, w], r.store[g, w], gets) / both[1]
        left = wp.min(left, r.most[g, w])
        if _is_unknown(r, g, reason[w], w):
            left = real(wp.inf)
        if wp.isnan(gets):  # the engine has lost the body
            left = real(0.0)
        left_out[g, w] = left


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
