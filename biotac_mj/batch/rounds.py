"""What decides in the rounds of a coupled step, and how much energy a skin may give: `coupling/world.py` and
`coupling/coupled.py` for all worlds at once, one thread each.

Poses are [group, world], in the BioTac frame."""

import warp as wp

from ..coupling.coupled import DEEPER, TELEPORT
from ..coupling.world import CLOSER, LEAST_STEP, TOLERANCE
from ..skin.contact.faces import Geoms
from ..skin.contact.shapes import distance_bound
from ..skin.newton.worlds import CONVERGED
from .kernels import Model, wrench_at
from .rigid import LEVER, displace, is_finite, motion, size_of

__all__ = [
    "SHARES",
    "Rounds",
    "ask",
    "begin_rounds",
    "change_forces",
    "conclude",
    "draw_near",
    "judge",
    "look",
    "look_ahead",
    "pass_by",
    "restrain",
    "share_push",
    "withhold",
    "wrenches",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
vec6 = wp.spatial_vectord
mat66 = wp.spatial_matrixd

_MAX_ROUNDS = 6
_TOLERANCE, _CLOSER, _LEAST_STEP, _DEEPER, _TELEPORT = (
    wp.constant(wp.float64(x)) for x in (TOLERANCE, CLOSER, LEAST_STEP, DEEPER, TELEPORT)
)
_MOST_ITERATIONS = 60  # of the skin's solver in a step, after which the last model must do
_BISECTIONS = 12
_TRIALS = 4
_CAUTION = wp.constant(wp.float64(0.9))
SHARES = 8  # of a way that crosses the skin are looked at


@wp.struct
class Rounds:
    """A coupled step of every world.

    Poses of the bodies: when the step begins, without acceleration, where they go, where the skins were
    solved, and where the last step left them.
    """

    here_pos: wp.array2d(dtype=vec3)
    here_mat: wp.array2d(dtype=mat33)
    start_pos: wp.array2d(dtype=vec3)
    start_mat: wp.array2d(dtype=mat33)
    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    drift: wp.array2d(dtype=vec6)  # motion without acceleration, in MuJoCo's linear measure h J v
    moved: wp.array2d(dtype=vec6)  # by acceleration: h^2 J a
    asked_pos: wp.array2d(dtype=vec3)
    asked_mat: wp.array2d(dtype=mat33)
    end_pos: wp.array2d(dtype=vec3)
    end_mat: wp.array2d(dtype=mat33)
    settled: wp.array(dtype=int)  # the skin was solved where the bodies go
    rounds: wp.array(dtype=int)  # solves of the skin
    spent: wp.array(dtype=int)  # iterations of its solver
    began: wp.array(dtype=int)  # a step was made since the reset
    placed: wp.array(dtype=int)  # bodies were put where they are from outside
    inside: wp.array(dtype=int)  # and into the skin
    passed: wp.array(dtype=int)  # the last step was one in which no skin took part
    far: wp.array(dtype=int)  # so far the bodies go from where nothing touches that they may cross the skin
    depth: wp.array2d(dtype=real)  # [m] of the skin in them on their way there [share, world]
    off: wp.array(dtype=real)  # [m] how far the bodies go from where the skin was solved
    share: wp.array(dtype=real)  # of the way between them that the next round goes
    push: wp.array(dtype=real)  # of the wrench at the present pose that acts: less than 1 where not paid for
    trial: wp.array(dtype=int)  # of shares of the push
    without: wp.array(dtype=real)  # [J] work without any push
    # with all of the push: wrenches that act, and motions of the bodies
    full_wrench: wp.array2d(dtype=vec6)
    full_motion: wp.array2d(dtype=vec6)
    store: wp.array(dtype=real)  # [J] energy that the last step left in the skin at most
    most: wp.array(dtype=real)  # [J] that the skin can hold
    surface: wp.array(dtype=real)  # [J/m^2] of adhesion, of length zero without a law


@wp.struct
class Solid:
    """Of the skin: from its outside to the core at most [m], its outer area [m^2], whether it has inertia."""

    thickness: real
    area: real
    inertial: int


@wp.func
def force_of(wrench: vec6):
    """Its size [N]."""
    return wp.length(vec3(wrench[0], wrench[1], wrench[2])) + wp.length(
        vec3(wrench[3], wrench[4], wrench[5])
    ) / real(LEVER)


@wp.kernel
def wrenches(
    # In:
    model: Model,
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    here: int,
    r: Rounds,
    # Out:
    wrench_out: wp.array2d(dtype=vec6),
):
    """On each group at poses pos, mat; with `here`, without what is withheld of the push at the present
    pose."""
    g, w = wp.tid()
    total = vec6()
    if is_finite(pos[g, w], mat[g, w]):
        total = wrench_at(model, g, w, pos[g, w], mat[g, w])
        push = r.push[w]
        if here == 1 and push < real(1.0):
            # against the drift itself: the way from here to the pose is another one where bodies turn far
            total = push * total - (real(1.0) - push) * (model.tangent0[g, w] * r.drift[g, w])
    wrench_out[g, w] = total


@wp.kernel
def begin_rounds(awake: wp.array(dtype=int), r: Rounds):
    w = wp.tid()
    r.placed[w] = 1 - r.began[w]
    for g in range(r.pos.shape[0]):
        jump = motion(r.here_pos[g, w], r.here_mat[g, w], r.end_pos[g, w], r.end_mat[g, w])
        if not size_of(jump) <= wp.max(_TELEPORT, size_of(r.drift[g, w])):
            r.placed[w] = 1
        if r.passed[w] == 1:  # where it ended is only about known, and nobody touched it
            r.end_pos[g, w] = r.here_pos[g, w]
            r.end_mat[g, w] = r.here_mat[g, w]
    r.passed[w] = 0
    r.inside[w] = r.placed[w]
    r.settled[w] = 1
    r.rounds[w] = 1 - awake[w]
    r.spent[w] = 0
    r.off[w] = real(wp.inf)
    r.share[w] = real(1.0)
    r.push[w] = real(1.0)


@wp.func
def within_reach(r: Rounds, model: Model, w: int):
    """Share of the way from the model's pose to the asked ones that leads no deeper than is known; and
    whether anything touches there."""
    touched = int(0)
    depth = real(0.0)
    for g in range(r.pos.shape[0]):
        wrench = model.wrench0[g, w]
        force = force_of(wrench)
        if force > real(0.0):
            touched = 1
            way = motion(r.asked_pos[g, w], r.asked_mat[g, w], model.pos0[g, w], model.mat0[g, w])
            depth = wp.max(depth, -wp.dot(wrench, way) / force)
    share = real(1.0)
    if touched == 1 and depth > _DEEPER:
        share = _DEEPER / depth
    return share, touched


@wp.kernel
def ask(
    # In:
    wanted: wp.array(dtype=int),
    model: Model,
    # In and out:
    r: Rounds,
):
    """Where the skins of the wanted worlds are solved next: where their bodies go, or a share of the way from
    where they were solved before."""
    w = wp.tid()
    if wanted[w] == 0:
        return
    for g in range(r.pos.shape[0]):
        p = r.pos[g, w]
        R = r.mat[g, w]
        if r.rounds[w] > 0 and r.share[w] < real(1.0):
            p0 = r.asked_pos[g, w]
            R0 = r.asked_mat[g, w]
            p, R = displace(p0, R0, r.share[w] * motion(p, R, p0, R0))
        r.asked_pos[g, w] = p
        r.asked_mat[g, w] = R
    near, touched = within_reach(r, model, w)
    if near < real(1.0):
        for g in range(r.pos.shape[0]):
            p0 = model.pos0[g, w]
            R0 = model.mat0[g, w]
            p, R = displace(p0, R0, near * motion(r.asked_pos[g, w], r.asked_mat[g, w], p0, R0))
            r.asked_pos[g, w] = p
            r.asked_mat[g, w] = R
    far = real(0.0)
    for g in range(r.pos.shape[0]):
        way = motion(r.asked_pos[g, w], r.asked_mat[g, w], r.here_pos[g, w], r.here_mat[g, w])
        far = wp.max(far, size_of(way))
    r.far[w] = 0
    if touched == 0 and far > _DEEPER:
        r.far[w] = 1
    if r.rounds[w] == 0 and r.placed[w] == 1:
        r.far[w] = 1
    for k in range(r.depth.shape[0]):
        r.depth[k, w] = real(-1.0)
    r.rounds[w] = r.rounds[w] + 1


@wp.kernel
def look_ahead(
    # In:
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    # In and out:
    r: Rounds,
):
    """How deep nodes of the skin, where it is, would be in the bodies on their way to where they are asked
    to."""
    i, w = wp.tid()
    if r.far[w] == 0:
        return
    for g in range(geoms.count):
        k = geoms.group[g]
        pos = r.asked_pos[k, w]
        mat = r.asked_mat[k, w]
        way = motion(pos, mat, r.here_pos[k, w], r.here_mat[k, w])
        for s in range(r.depth.shape[0]):
            p, R = displace(r.here_pos[k, w], r.here_mat[k, w], real(s) / real(SHARES) * way)
            y = mat * (wp.transpose(R) * (x[i, w] - p)) + pos - geoms.pos[g, w]
            y = wp.transpose(geoms.mat[g, w]) * y
            d = distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
            wp.atomic_max(r.depth, s, w, -d)


@wp.kernel
def draw_near(r: Rounds):
    """Leaves so much of a way from where nothing touches that the bodies are no deeper in the skin than one
    round goes."""
    w = wp.tid()
    if r.far[w] == 0:
        return
    if r.rounds[w] == 1 and r.depth[0, w] <= real(0.0):
        r.inside[w] = 0
    share = real(1.0)
    for s in range(r.depth.shape[0] - 1):
        before = r.depth[s, w]
        after = r.depth[s + 1, w]
        if share == real(1.0) and before <= _DEEPER and after > _DEEPER:
            share = (real(s) + (_DEEPER - before) / (after - before)) / real(SHARES)
    for g in range(r.pos.shape[0]):
        p0 = r.here_pos[g, w]
        R0 = r.here_mat[g, w]
        p, R = displace(p0, R0, share * motion(r.asked_pos[g, w], r.asked_mat[g, w], p0, R0))
        r.asked_pos[g, w] = p
        r.asked_mat[g, w] = R


@wp.func
def distance_off(r: Rounds, w: int):
    off = real(0.0)
    for g in range(r.pos.shape[0]):
        if is_finite(r.pos[g, w], r.mat[g, w]):  # what is lost takes no part
            way = motion(r.pos[g, w], r.mat[g, w], r.asked_pos[g, w], r.asked_mat[g, w])
            off = wp.max(off, size_of(way))
    return off


@wp.kernel
def change_forces(
    # In:
    jacobian: wp.array3d(dtype=vec6),
    wrench: wp.array2d(dtype=vec6),
    wrench_before: wp.array2d(dtype=vec6),
    # Out:
    qfrc_out: wp.array2d(dtype=float),
):
    """What new models change of the forces [world, dof]."""
    w, i = wp.tid()
    total = real(0.0)
    for g in range(wrench.shape[0]):
        total += wp.dot(jacobian[g, w, i], wrench[g, w] - wrench_before[g, w])
    qfrc_out[w, i] = float(total)


@wp.kernel
def look(
    # In:
    awake: wp.array(dtype=int),
    h2: real,
    jacobian: wp.array3d(dtype=vec6),
    change: wp.array2d(dtype=float),
    # In and out:
    r: Rounds,
    again: wp.array(dtype=int),
):
    """Which worlds need no second look after their first solve: the bodies would not go elsewhere under the
    new models, though nothing but inertia held them; `change` are the accelerations [world, dof] for that.

    Rows, contacts and limits only hold: what they leave of a change of forces is smaller."""
    w = wp.tid()
    if awake[w] == 0:
        return
    off = distance_off(r, w)
    for g in range(r.pos.shape[0]):
        way = vec6()
        for i in range(jacobian.shape[2]):
            way += h2 * real(change[w, i]) * jacobian[g, w, i]
        off = wp.max(off, size_of(way))
    r.settled[w] = 0
    if off < _TOLERANCE:
        r.settled[w] = 1
    else:
        again[0] = 1


@wp.kernel
def judge(
    # In:
    reason: wp.array(dtype=int),
    iterations: wp.array(dtype=int),
    # In and out:
    r: Rounds,
    wanted: wp.array(dtype=int),
    again: wp.array(dtype=int),
):
    """After MuJoCo's answer to the models: which worlds go again, and how far.

    Another solve after one that found no balance, which took long, is not worth its cost.
    """
    w = wp.tid()
    r.spent[w] = r.spent[w] + wanted[w] * iterations[w]
    wanted[w] = 0
    if r.settled[w] == 1:
        return
    off = distance_off(r, w)
    if off < _TOLERANCE:
        r.settled[w] = 1
    elif reason[w] == CONVERGED and r.spent[w] < _MOST_ITERATIONS and r.rounds[w] < _MAX_ROUNDS:
        share = wp.min(real(1.0), real(2.0) * r.share[w])
        if off > _CLOSER * r.off[w]:
            share = wp.max(real(0.5) * r.share[w], _LEAST_STEP)
        r.share[w] = share
        r.off[w] = off
        wanted[w] = 1
        again[0] = 1


@wp.func
def acting(r: Rounds, model: Model, wrench: wp.array2d(dtype=vec6), g: int, w: int):
    """What acts on a body, as MuJoCo takes it: linear in the accelerations, from its wrench without them."""
    return wrench[g, w] - model.tangent0[g, w] * r.moved[g, w]


@wp.func
def given(r: Rounds, model: Model, wrench: wp.array2d(dtype=vec6), w: int):
    """Work of what acts on the bodies on their way [J]."""
    work = real(0.0)
    for g in range(r.pos.shape[0]):
        work += wp.dot(acting(r, model, wrench, g, w), r.drift[g, w] + r.moved[g, w])
    return work


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
def overdraws(r: Rounds, model: Model, wrench: wp.array2d(dtype=vec6), w: int):
    """Whether what acts gives more energy than there is."""
    return given(r, model, wrench, w) > wp.max(r.store[w], real(0.0))


@wp.kernel
def restrain(
    # In:
    model: Model,
    last: Model,
    wrench: wp.array2d(dtype=vec6),
    solid: Solid,
    # In and out:
    r: Rounds,
    again: wp.array(dtype=int),
):
    """Finds the energy in the skins, and takes the push of those that would give more.

    What remains without it is the skin's tangent about the present pose: a damper. The energy is that of the
    last step, and what those have put in who have moved bodies since.
    """
    w = wp.tid()
    before = real(0.0)
    now = real(0.0)
    pushed = real(0.0)
    pushes = real(0.0)
    for g in range(r.pos.shape[0]):
        jump = motion(r.here_pos[g, w], r.here_mat[g, w], r.end_pos[g, w], r.end_mat[g, w])
        acts = acting(r, model, wrench, g, w)
        before += wp.dot(last.wrench0[g, w], jump)
        now += wp.dot(acts, jump)
        pushed += force_of(last.wrench0[g, w])
        pushes += force_of(acts)
        r.full_wrench[g, w] = acts
        r.full_motion[g, w] = r.drift[g, w] + r.moved[g, w]
    store = r.store[w] - wp.min(before, now)
    if r.placed[w] == 1:  # who puts bodies into a skin puts in what it pushes with
        store = real(0.0)
        if r.inside[w] == 1 or solid.inertial == 1:
            store = most_energy(r, pushes, solid, w)
        elif r.surface.shape[0] > 0:
            store = r.surface[w] * solid.area
    # a solve that lost its way knows little of the force that was there before it
    r.most[w] = most_energy(r, wp.max(pushed, pushes), solid, w)
    r.store[w] = wp.min(store, r.most[w])
    if overdraws(r, model, wrench, w):
        r.push[w] = real(0.0)
        again[0] = 1


@wp.kernel
def share_push(
    # In:
    model: Model,
    wrench: wp.array2d(dtype=vec6),
    # In and out:
    r: Rounds,
):
    """As much push as there is energy for, of skins without any: what acts, and how bodies move, is linear in
    it while no other contact changes."""
    w = wp.tid()
    if r.push[w] == real(1.0):
        return
    # of the work: without push, with all of it, and half of the curve between them
    none = given(r, model, wrench, w)
    full = real(0.0)
    bend = real(0.0)
    for g in range(r.pos.shape[0]):
        full += wp.dot(r.full_wrench[g, w], r.full_motion[g, w])
        change = r.full_wrench[g, w] - acting(r, model, wrench, g, w)
        bend += wp.dot(change, r.full_motion[g, w] - r.drift[g, w] - r.moved[g, w])
    low = real(0.0)
    high = real(1.0)
    for _ in range(_BISECTIONS):
        p = real(0.5) * (low + high)
        if none + p * (full - none - bend) + p * p * bend > wp.max(r.store[w], real(0.0)):
            high = p
        else:
            low = p
    r.push[w] = low
    r.without[w] = none
    r.trial[w] = 0


@wp.kernel
def withhold(
    # In:
    model: Model,
    wrench: wp.array2d(dtype=vec6),
    # In and out:
    r: Rounds,
    again: wp.array(dtype=int),
):
    """Withholds more where a share of the push still gives too much, at last all."""
    w = wp.tid()
    if r.push[w] == real(1.0) or r.push[w] == real(0.0) or not overdraws(r, model, wrench, w):
        return
    none = r.without[w]
    room = (wp.max(r.store[w], real(0.0)) - none) / (given(r, model, wrench, w) - none)
    r.push[w] = _CAUTION * room * r.push[w]
    r.trial[w] = r.trial[w] + 1
    if r.trial[w] == _TRIALS:
        r.push[w] = real(0.0)
    again[0] = 1


@wp.kernel
def conclude(
    # In:
    model: Model,
    wrench: wp.array2d(dtype=vec6),
    # In and out:
    r: Rounds,
):
    """Keeps the energy that is left, and where the bodies go."""
    w = wp.tid()
    # what is withheld is in the skin all the same
    r.store[w] = wp.min(r.store[w] - given(r, model, wrench, w), r.most[w])
    for g in range(r.pos.shape[0]):
        r.end_pos[g, w] = r.pos[g, w]
        r.end_mat[g, w] = r.mat[g, w]


@wp.kernel
def pass_by(area: real, r: Rounds):
    """Instead of all rounds where no skin takes part: bodies go where they go, a skin has the energy of its
    adhesion."""
    w = wp.tid()
    r.store[w] = real(0.0)
    if r.surface.shape[0] > 0:
        r.store[w] = r.surface[w] * area
    r.passed[w] = 1
    for g in range(r.pos.shape[0]):
        r.end_pos[g, w] = r.start_pos[g, w]
        r.end_mat[g, w] = r.start_mat[g, w]
