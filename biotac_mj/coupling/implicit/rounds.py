"""The coupled step of skins and bodies, of one world or of all at once: where bodies go, what acts on them,
and how the rounds go on. The account of energy is in `energy`.

Poses are [group, world], in the BioTac frame."""

import warp as wp

from ...geometry.rigid_warp import LEVER, displace_at_once, is_finite, motion, motion_at_once, size_of
from ...kernels import add_zeros, kernel_module, set_fields
from ...skin.bodies import Bodies
from ...skin.contact.broadphase import contact_range
from ...skin.contact.faces import Laws
from ...skin.newton.worlds import CONVERGED
from ...skin.types import mat33, mat66, real, vec3, vec6
from .rules import EULER, TELEPORT, TOLERANCE, beta_of, gamma_of

kernel_module(__name__)


_gamma_of, _beta_of = (wp.func(rule) for rule in (gamma_of, beta_of))
_TOLERANCE, _TELEPORT = (wp.constant(wp.float64(x)) for x in (TOLERANCE, TELEPORT))


@wp.struct
class MarkedWorlds:
    """Marks [world] of those that take part in a stage of the step, and whether any is set. The others are
    frozen: no launch changes a bit of them."""

    world: wp.array(dtype=int)
    any: wp.array(dtype=int)


@wp.func
def mark(marks: MarkedWorlds, w: int):
    marks.world[w] = 1
    marks.any[0] = 1


class Marks:
    """Marked worlds, none at first, on Warp's default device.

    Attributes:
      world: (nworld,) wp.array int, 1 where marked. any: (1,) wp.array int, 1 where any is.
      struct: both, for kernels.
    """

    def __init__(self, nworld: int):
        self._all = wp.zeros(nworld + 1, dtype=int)
        self.world, self.any = self._all[:nworld], self._all[nworld:]
        self.struct = set_fields(MarkedWorlds(), world=self.world, any=self.any)

    def clear(self) -> None:
        """Marks none. Launches only."""
        self._all.zero_()

    def fill(self) -> None:
        """Marks all. Launches only."""
        self._all.fill_(1)

    def copy(self, other: "Marks") -> None:
        """Marks those of another. Launches only."""
        wp.copy(self._all, other._all)


@wp.struct
class Model:
    """Linear models of skins [group, world]: wrench0 - tangent0 (pose - pose0). A body that goes from
    there no further than `slack` [m], turns times LEVER, cannot touch the skin; 0: it may."""

    wrench0: wp.array2d(dtype=vec6)
    tangent0: wp.array2d(dtype=mat66)
    pos0: wp.array2d(dtype=vec3)
    mat0: wp.array2d(dtype=mat33)
    slack: wp.array2d(dtype=real)


@wp.struct
class Rounds:
    """A coupled step of every world.

    Poses of the bodies: when the step begins; where the skins are solved, without acceleration and with it;
    the target poses of the skins' solves; where they would go without the skins' wrenches; where the last
    step left them.
    """

    here_pos: wp.array2d(dtype=vec3)
    here_mat: wp.array2d(dtype=mat33)
    start_pos: wp.array2d(dtype=vec3)
    start_mat: wp.array2d(dtype=mat33)
    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    # motions in MuJoCo's linear measure, by Jacobians: in the step without acceleration; by the mean velocity
    # in it; to where the skin is solved, without acceleration and by the integrator's
    straight: wp.array2d(dtype=vec6)
    travel: wp.array2d(dtype=vec6)
    drift: wp.array2d(dtype=vec6)
    moved: wp.array2d(dtype=vec6)
    gamma: wp.array2d(dtype=real)  # Newmark's, with which the step is made
    horizon: wp.array2d(dtype=real)  # [s] after which the skin is solved, without acceleration
    square: wp.array2d(dtype=real)  # beta h^2, [m per m/s^2]
    frequency: wp.array2d(dtype=real)  # angular, at which bodies bounce on the skin [rad/s]
    # what passive forces and rows lack of the skin's model or have more than it: it acts on the bodies too
    amiss: wp.array2d(dtype=vec6)
    acting: wp.array2d(dtype=vec6)  # what acts on the bodies, linear in the accelerations
    lifted: wp.array2d(dtype=real)  # [J] work of MuJoCo's contacts with core, nail and clamp on the bodies
    asked_pos: wp.array2d(dtype=vec3)
    asked_mat: wp.array2d(dtype=mat33)
    free_pos: wp.array2d(dtype=vec3)
    free_mat: wp.array2d(dtype=mat33)
    end_pos: wp.array2d(dtype=vec3)
    end_mat: wp.array2d(dtype=mat33)
    settled: wp.array(dtype=int)  # the skin was solved where the bodies go
    rounds: wp.array(dtype=int)  # solves of the skin
    limit: int  # of these
    began: wp.array(dtype=int)  # a step was made since the reset
    placed: wp.array2d(dtype=int)  # a body was put where it is from outside
    inside: wp.array(dtype=int)  # and one of them into the skin
    passed: wp.array(dtype=int)  # the last step was one in which no skin took part
    push: wp.array2d(dtype=real)  # fraction of its wrench that a body gets
    withheld: wp.array2d(dtype=vec6)  # by which its wrench without acceleration is less
    left: wp.array2d(dtype=real)  # [J] energy that the last step left a body in the skin at most, or inf
    store: wp.array2d(dtype=real)  # [J] and with what was put into it since
    most: wp.array2d(dtype=real)  # [J] that the skin can hold of it
    surface: wp.array(dtype=real)  # [J/m^2] of adhesion, of length zero without a law


@wp.struct
class Solid:
    """Properties of the skin: largest distance from its outside to the core [m], its outer area [m^2],
    whether it has inertia."""

    thickness: real
    area: real
    inertial: int


def make_model(groups: int, nworld: int) -> Model:
    """No forces of any body, on Warp's default device."""
    model = Model()
    add_zeros(model, " ".join(Model.vars), groups, nworld)
    return model


def make_rounds(groups: int, nworld: int, limit: int = 0) -> Rounds:
    """Rounds of `groups` bodies on Warp's default device. All fields are zero, but the fraction of the force
    that acts is one and the skins have settled in one round."""
    r = Rounds()
    for name, variable in Rounds.vars.items():
        kind = getattr(variable.type, "dtype", None)
        if kind is not None:
            shape = (groups, nworld) if variable.type.ndim == 2 else nworld
            setattr(r, name, wp.zeros(shape, dtype=kind))
    for array in (r.push, r.settled, r.rounds):
        array.fill_(1)
    r.surface, r.limit = wp.zeros(0, dtype=real), limit
    return r


@wp.func
def force_of(wrench: vec6):
    """Its size [N]."""
    return wp.length(vec3(wrench[0], wrench[1], wrench[2])) + wp.length(
        vec3(wrench[3], wrench[4], wrench[5])
    ) / real(LEVER)


@wp.func
def _turns(drift: vec6):
    return vec3(drift[3], drift[4], drift[5])


@wp.kernel
def wrenches(
    # In:
    model: Model,
    r: Rounds,
    # Out:
    wrench_out: wp.array2d(dtype=vec6),
):
    """On each group without acceleration, without what is withheld. Displacements are measured as in the
    constraint rows, so that the wrench at the bodies' new poses is that of the skin's linear model there.
    Finds `acting`, too, after `follow`."""
    g, w = wp.tid()
    total = vec6()
    if is_finite(r.start_pos[g, w], r.start_mat[g, w]):
        motion = motion_at_once(
            model.pos0[g, w],
            model.mat0[g, w],
            r.start_pos[g, w],
            r.start_mat[g, w],
            r.here_pos[g, w],
            _turns(r.drift[g, w]),
        )
        total = model.wrench0[g, w] + model.tangent0[g, w] * motion - r.withheld[g, w]
    wrench_out[g, w] = total
    r.acting[g, w] = total - model.tangent0[g, w] * r.moved[g, w] + r.amiss[g, w]


@wp.func
def follow(r: Rounds, g: int, w: int, h: real, gain: vec6):
    """Predicts a body's travel in the step for its acceleration `gain`, and the pose at which the skin is
    solved: the pose without acceleration, displaced by beta h^2 `gain` (`displace_at_once`)."""
    m = r.square[g, w] * gain
    r.moved[g, w] = m
    r.travel[g, w] = r.straight[g, w] + real(0.5) * h * h * gain
    start, spin = r.start_pos[g, w], _turns(r.drift[g, w])
    p, R = displace_at_once(start, r.start_mat[g, w], m, r.here_pos[g, w], spin)
    r.pos[g, w] = p
    r.mat[g, w] = R


@wp.func
def _set_gamma(r: Rounds, g: int, w: int, step: real, gamma: real):
    r.gamma[g, w] = gamma
    r.horizon[g, w] = (gamma - real(0.5)) * step
    r.square[g, w] = _beta_of(gamma) * step * step


@wp.kernel
def choose_gamma(step: real, ahead: real, delay: real, solid: Solid, last: Model, r: Rounds):
    """Newmark's gamma of the step of each body. A skin with inertia steps itself to the end of the step.
    Where contact begins the skin is solved for the step's end, too: how stiff it will be is not known, and a
    body must not go deep unseen, nor be pushed before it comes.

    Args:
      ahead: by how many steps the step begins ahead of the positions, see `Instance.lead`. delay: of the
        rubber's force, in steps.
    """
    g, w = wp.tid()
    gamma = real(EULER) - ahead
    if solid.inertial == 0 and wp.ddot(last.tangent0[g, w], last.tangent0[g, w]) > real(0.0):
        gamma = _gamma_of(r.frequency[g, w] * step, delay)
    _set_gamma(r, g, w, step, gamma)


@wp.kernel
def begin_rounds(
    # In:
    awake: wp.array(dtype=int),
    by_mocap: wp.array(dtype=bool),
    # In and out:
    r: Rounds,
    last: Model,
    model: Model,
):
    """Begins a step: finds which bodies were placed by the user. These have left their contact, so their
    models of the last step are cleared; not so those of bodies that a mocap body has moved there."""
    w = wp.tid()
    r.inside[w] = 1 - r.began[w]
    for g in range(r.pos.shape[0]):
        r.placed[g, w] = 1 - r.began[w]
        r.push[g, w] = real(1.0)
        r.withheld[g, w] = vec6()
        if r.began[w] == 0:
            r.left[g, w] = real(0.0)
        jump = motion(r.here_pos[g, w], r.here_mat[g, w], r.end_pos[g, w], r.end_mat[g, w])
        if not size_of(jump) <= wp.max(_TELEPORT, size_of(r.straight[g, w])):
            r.placed[g, w] = 1
            r.inside[w] = 1
            if not by_mocap[g]:
                last.wrench0[g, w] = vec6()
                last.tangent0[g, w] = mat66()
                model.wrench0[g, w] = vec6()
                model.tangent0[g, w] = mat66()
                r.frequency[g, w] = real(0.0)
        if r.passed[w] == 1:  # where it ended is only about known, and nobody touched it
            r.end_pos[g, w] = r.here_pos[g, w]
            r.end_mat[g, w] = r.here_mat[g, w]
    r.passed[w] = 0
    r.settled[w] = 1
    r.rounds[w] = 1 - awake[w]


@wp.kernel
def use_euler(step: real, greedy: wp.array(dtype=int), r: Rounds):
    """Makes the step that of backward Euler in greedy worlds, whose skins are to be solved again."""
    w = wp.tid()
    if greedy[w] == 1:
        r.settled[w] = 0
        for g in range(r.gamma.shape[0]):
            _set_gamma(r, g, w, step, real(EULER))


@wp.kernel
def look_inside(laws: Laws, clearance: wp.array(dtype=wp.vec2d), r: Rounds):
    """Finds which of the bodies that were placed are in the skin, by their clearance from it."""
    w = wp.tid()
    if not clearance[w][0] < contact_range(laws, w):
        r.inside[w] = 0


@wp.kernel
def tell_bodies(
    # In:
    wanted: wp.array(dtype=int),
    fraction: wp.array(dtype=real),
    model: Model,
    wrench: wp.array2d(dtype=vec6),
    # Out:
    bodies: Bodies,
    r: Rounds,
):
    """Writes the linear motion of the bodies of the wanted worlds: wrenches, and poses without them."""
    g, w = wp.tid()
    if wanted[w] == 0:
        return
    spin = _turns(r.drift[g, w] + r.moved[g, w])
    bodies.predicted[g, w] = (wrench[g, w] - model.tangent0[g, w] * r.moved[g, w] + r.amiss[g, w]) / fraction[
        g
    ]
    bodies.origin[g, w] = r.pos[g, w]
    bodies.arm[g, w] = r.here_pos[g, w]
    bodies.spin[g, w] = spin


@wp.kernel
def uncoupled_poses(wanted: wp.array(dtype=int), bodies: Bodies, r: Rounds):
    """Computes the bodies' poses without the skin's wrenches."""
    g, w = wp.tid()
    if wanted[w] == 0:
        return
    m = vec6()
    for h in range(bodies.compliance.shape[0]):
        m -= bodies.compliance[g, h, w] * bodies.predicted[h, w]
    p, R = displace_at_once(r.pos[g, w], r.mat[g, w], m, bodies.arm[g, w], bodies.spin[g, w])
    r.free_pos[g, w] = p
    r.free_mat[g, w] = R


@wp.kernel
def ask(wanted: wp.array(dtype=int), gone: wp.array(dtype=bool), r: Rounds):
    """Writes the poses at which the skins are solved: the bodies' predicted ones, or the free ones of bodies
    that nothing holds any more."""
    g, w = wp.tid()
    if gone[w]:
        r.asked_pos[g, w] = r.free_pos[g, w]
        r.asked_mat[g, w] = r.free_mat[g, w]
    elif wanted[w] == 1:
        r.asked_pos[g, w] = r.pos[g, w]
        r.asked_mat[g, w] = r.mat[g, w]


@wp.func
def _beyond_slack(model: Model, g: int, w: int, moved: vec6, free: real):
    """Size of a motion from the pose of the skin's model [m]; zero within `free` times `slack`, where the
    body cannot touch."""
    length = wp.length(vec3(moved[0], moved[1], moved[2])) + real(LEVER) * wp.length(_turns(moved))
    if length > free * model.slack[g, w]:
        return size_of(moved)
    return real(0.0)


@wp.func
def distance_off(model: Model, r: Rounds, w: int, free: real):
    """Largest distance of the bodies from the poses of the skin's model [m], see `_beyond_slack`."""
    off = real(0.0)
    for g in range(r.pos.shape[0]):
        if is_finite(r.pos[g, w], r.mat[g, w]):  # what is lost takes no part
            moved = motion(r.pos[g, w], r.mat[g, w], model.pos0[g, w], model.mat0[g, w])
            off = wp.max(off, _beyond_slack(model, g, w, moved, free))
    return off


@wp.kernel
def find_off(
    # In:
    model: Model,
    r: Rounds,
    # Out:
    off_out: wp.array(dtype=real),
):
    """Largest distance from where the skin was solved [m], of the bodies that may touch it and of all."""
    for k in range(2):
        off_out[k] = distance_off(model, r, 0, real(1 - k))


@wp.kernel
def look(
    # In:
    awake: wp.array(dtype=int),
    fraction: wp.array(dtype=real),
    bodies: Bodies,
    model: Model,
    # In and out:
    r: Rounds,
    going: MarkedWorlds,
):
    """After the first solve: counts it, and marks worlds that need another one, since their bodies do not
    move as predicted: neither to where the skin was solved, nor by its wrenches, which on nodes that are
    fixed do not move bodies in a solve of the condensed tier. Other constraints on the bodies make the change
    smaller than their inertia alone."""
    w = wp.tid()
    if awake[w] == 0:
        return
    r.rounds[w] = 1
    r.settled[w] = 0
    off = distance_off(model, r, w, real(1.0))
    for g in range(r.pos.shape[0]):
        moves = vec6()
        for h in range(r.pos.shape[0]):
            moves += bodies.compliance[g, h, w] * (model.wrench0[h, w] - fraction[h] * bodies.predicted[h, w])
        if is_finite(r.pos[g, w], r.mat[g, w]):
            off = wp.max(off, _beyond_slack(model, g, w, moves, real(1.0)))
    if off < _TOLERANCE:
        r.settled[w] = 1
    else:
        mark(going, w)


@wp.kernel
def judge(
    # In:
    going: wp.array(dtype=int),
    reason: wp.array(dtype=int),
    model: Model,
    # In and out:
    r: Rounds,
    wanted: wp.array(dtype=int),
    still_going: MarkedWorlds,
):
    """After MuJoCo's answer to the models: which of the worlds that are going go again. Not those whose last
    solve found no balance: another one is not worth its cost."""
    w = wp.tid()
    wanted[w] = 0
    if going[w] == 0 or r.settled[w] == 1:
        return
    if distance_off(model, r, w, real(1.0)) < _TOLERANCE:
        r.settled[w] = 1
    elif reason[w] == CONVERGED and r.rounds[w] < r.limit:
        r.rounds[w] = r.rounds[w] + 1
        wanted[w] = 1
        mark(still_going, w)
