"""Decides how the rounds of a coupled step go on: `world.py` and `coupled.py` of `coupling/implicit/` for all
worlds at once, one thread each. The account of their energy is in `energy`.

Poses are [group, world], in the BioTac frame."""

import warp as wp

from ...coupling.implicit.coupled import DEEPER, TELEPORT
from ...coupling.implicit.rules import TOLERANCE, Seen, accelerated, next_share, place_of
from ...coupling.instance import FITS
from ...skin.contact.broadphase import contact_range, face_ball, geom_clearance
from ...skin.contact.faces import Laws
from ...skin.contact.penetration import core_clearance
from ...skin.contact.posed import Geoms
from ...skin.newton.worlds import CONVERGED
from ..kernels import Model, wrench_at
from ..rigid import LEVER, displace, is_finite, motion, size_of

__all__ = [
    "PATIENCE_OF",
    "SHARES",
    "Rounds",
    "Solid",
    "ask",
    "begin_rounds",
    "change_forces",
    "draw_near",
    "force_of",
    "judge",
    "look",
    "look_ahead",
    "look_down",
    "wrenches",
]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
mat33 = wp.mat33d
vec6 = wp.spatial_vectord
mat66 = wp.spatial_matrixd

_TOLERANCE, _DEEPER, _TELEPORT, _FITS = (
    wp.constant(wp.float64(x)) for x in (TOLERANCE, DEEPER, TELEPORT, FITS)
)
_next_share = wp.func(next_share)
# iterations of the skin's solver in a solve and in a step, after which the closest model must do: more than
# in `mj_step`, since no one waits for a single world. The condensed tier counts those of all parts of a way
PATIENCE_OF = {"full": (32, 160), "condensed": (96, 480)}
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
    moved: wp.array2d(dtype=vec6)  # by the integrator's acceleration: h^2 J a'
    amiss: wp.array2d(dtype=vec6)  # what the correction for it still lacks: it acts on the bodies too
    asked_pos: wp.array2d(dtype=vec3)
    asked_mat: wp.array2d(dtype=mat33)
    end_pos: wp.array2d(dtype=vec3)
    end_mat: wp.array2d(dtype=mat33)
    settled: wp.array(dtype=int)  # the skin was solved where the bodies go
    rounds: wp.array(dtype=int)  # solves of the skin
    limit: int  # of these
    long_solve: int  # iterations: see `PATIENCE_OF`
    long_step: int
    spent: wp.array(dtype=int)  # iterations of its solver
    seen: Seen
    best: wp.array(dtype=real)  # [m] `off` of the model that came closest
    found: wp.array(dtype=int)  # it is that of a balance
    better: wp.array(dtype=int)  # it is the present one
    back: wp.array(dtype=int)  # it must do
    ended: wp.array(dtype=int)  # no more rounds
    began: wp.array(dtype=int)  # a step was made since the reset
    placed: wp.array(dtype=int)  # bodies were put where they are from outside
    inside: wp.array(dtype=int)  # and into the skin
    open: wp.array(dtype=int)  # what was put in so is not yet known
    passed: wp.array(dtype=int)  # the last step was one in which no skin took part
    untouched: wp.array(dtype=int)  # the skin that the way begins at
    meets: wp.array(dtype=int)  # nothing touched the skin when the step began: bodies meet it on their way
    far: wp.array(dtype=int)  # so far the bodies go from where nothing touches that they may cross the skin
    depth: wp.array2d(dtype=real)  # [m] of the skin in them on their way there [share, world]
    down: wp.array(dtype=int)  # so far they go from where something touches that they may come to the core
    clearance: wp.array3d(dtype=real)  # [m] of the geoms from it on that way [share, geom, world]
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
    """Of the skin: from its outside to the core at most [m], how deep in it no skin fits [m], whether there
    is one; its outer area [m^2], whether it has inertia."""

    thickness: real
    core_depth: real
    core: int
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
    if r.began[w] == 0:
        r.open[w] = 0
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
    r.seen.count[w] = 0
    r.best[w] = real(wp.inf)
    r.found[w] = 0
    r.better[w] = 0
    r.back[w] = 0
    r.ended[w] = 0
    r.off[w] = real(wp.inf)
    r.share[w] = real(1.0)
    r.push[w] = real(1.0)


@wp.func
def levelled(m: vec6, lever: real):
    """A small motion in which turning compares with going."""
    return vec6(m[0], m[1], m[2], lever * m[3], lever * m[4], lever * m[5])


@wp.kernel
def ask(
    # In:
    wanted: wp.array(dtype=int),
    last: Model,
    model: Model,
    # In and out:
    r: Rounds,
):
    """Where the skins of the wanted worlds are solved next: where their bodies go in the end, as far as
    earlier rounds tell, and a share of the way that these do not explain."""
    w = wp.tid()
    if wanted[w] == 0:
        return
    now = place_of(r.seen, w)
    for g in range(r.pos.shape[0]):
        p = r.pos[g, w]
        R = r.mat[g, w]
        done = vec6()
        left = vec6()
        if r.rounds[w] > 0 and is_finite(p, R):
            p0 = r.asked_pos[g, w]
            R0 = r.asked_mat[g, w]
            done = levelled(motion(p0, R0, r.start_pos[g, w], r.start_mat[g, w]), real(LEVER))
            left = levelled(motion(p, R, p0, R0), real(LEVER))
        r.seen.x[now, g, w] = done
        r.seen.residual[now, g, w] = left
    if r.rounds[w] > 0:
        accelerated(r.seen, w, r.share[w])
    for g in range(r.pos.shape[0]):
        p = r.pos[g, w]
        R = r.mat[g, w]
        if r.rounds[w] > 0 and is_finite(p, R):
            way = levelled(r.seen.to[g, w], real(1.0) / real(LEVER))
            p, R = displace(r.start_pos[g, w], r.start_mat[g, w], way)
        r.asked_pos[g, w] = p
        r.asked_mat[g, w] = R
    r.untouched[w] = 1
    r.meets[w] = 1
    far = real(0.0)
    down = real(0.0)
    for g in range(r.pos.shape[0]):
        p = r.asked_pos[g, w]
        R = r.asked_mat[g, w]
        far = wp.max(far, size_of(motion(p, R, r.here_pos[g, w], r.here_mat[g, w])))
        down = wp.max(down, size_of(motion(p, R, model.pos0[g, w], model.mat0[g, w])))
        if force_of(model.wrench0[g, w]) > real(0.0):
            r.untouched[w] = 0
        if force_of(last.wrench0[g, w]) > real(0.0):
            r.meets[w] = 0
    if far <= _DEEPER and r.placed[w] == 0:
        r.meets[w] = 0
    r.far[w] = 0
    r.down[w] = 0
    if r.untouched[w] == 1 and far > _DEEPER:
        r.far[w] = 1
    if r.rounds[w] == 0 and r.placed[w] == 1:
        r.far[w] = 1
    elif r.untouched[w] == 0 and down > _DEEPER:
        r.down[w] = 1
    for k in range(r.depth.shape[0]):
        r.depth[k, w] = real(-1.0)
        for g in range(r.clearance.shape[1]):
            r.clearance[k, g, w] = real(1.0)
    r.rounds[w] = r.rounds[w] + 1


@wp.func
def geom_on_path(share: int, pos0: vec3, mat0: mat33, pos: vec3, mat: mat33, geoms: Geoms, g: int, w: int):
    """Pose of a geom, which is posed for its body at pos, mat, when that has gone a share of its path from
    pose 0."""
    p, R = displace(pos0, mat0, real(share) / real(SHARES) * motion(pos, mat, pos0, mat0))
    turn = R * wp.transpose(mat)
    return turn * (geoms.pos[g, w] - pos) + p, turn * geoms.mat[g, w]


@wp.kernel
def look_ahead(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    laws: Laws,
    x: wp.array2d(dtype=vec3),
    # In and out:
    r: Rounds,
):
    """How deep the skin, where it is, would be in the bodies on their way to where they are asked to."""
    f, w = wp.tid()
    if r.far[w] == 0 and r.meets[w] == 0:
        return
    reach = contact_range(laws, w)
    t = face[f]
    x0 = x[t[0], w]
    x1 = x[t[1], w]
    x2 = x[t[2], w]
    center, radius = face_ball(x0, x1, x2)
    for g in range(geoms.count):
        k = geoms.group[g]
        pos0 = r.here_pos[k, w]
        mat0 = r.here_mat[k, w]
        pos = r.asked_pos[k, w]
        mat = r.asked_mat[k, w]
        for s in range(r.depth.shape[0]):
            p, R = geom_on_path(s, pos0, mat0, pos, mat, geoms, g, w)
            # only what is deeper than others are known to be. Of twice the ball: the bounds of meshes change
            # a little faster than their place, and what comes out may not depend on who is first
            most = reach - r.depth[s, w]
            least = geom_clearance(
                geoms, g, p, R, x0, x1, x2, center, real(2.0) * radius, sample, most, -real(wp.inf)
            )
            if least < most:
                wp.atomic_max(r.depth, s, w, reach - least)


@wp.kernel
def look_down(
    # In:
    core_vert: wp.array(dtype=vec3),
    core: Geoms,
    geoms: Geoms,
    model: Model,
    # In and out:
    r: Rounds,
):
    """How far the geoms would be from the core on their way from where the skin is known; as
    `ProximityQuery.clearance` of one world."""
    i, w = wp.tid()
    if r.down[w] == 0:
        return
    for g in range(geoms.count):
        k = geoms.group[g]
        pos0 = model.pos0[k, w]
        mat0 = model.mat0[k, w]
        pos = r.asked_pos[k, w]
        mat = r.asked_mat[k, w]
        for s in range(r.clearance.shape[0]):
            p, R = geom_on_path(s, pos0, mat0, pos, mat, geoms, g, w)
            wp.atomic_min(r.clearance, s, g, w, core_clearance(i, geoms, g, p, R, core, core_vert))


@wp.func
def clear_share(r: Rounds, w: int):
    """Of a way, after which about the bodies meet the skin; who leaves it meets none."""
    share = real(1.0)
    if r.depth[0, w] > real(0.0) and r.depth[r.depth.shape[0] - 1, w] > real(0.0):
        share = real(0.0)
    elif r.depth[0, w] > real(0.0):
        return share
    for s in range(r.depth.shape[0] - 1):
        before = r.depth[s, w]
        after = r.depth[s + 1, w]
        if share == real(1.0) and after > real(0.0):
            share = (real(s) - before / (after - before)) / real(SHARES)
    return share


@wp.func
def share_down(r: Rounds, solid: Solid, w: int):
    """As `Instance.share_down`: of a way, on which no geom goes deeper by more than is known, nor to where no
    skin fits; what slides there is not held."""
    share = real(1.0)
    near = real(wp.inf)
    for s in range(r.clearance.shape[0]):
        deep = real(-wp.inf)
        for g in range(r.clearance.shape[1]):
            known = r.clearance[0, g, w] + solid.core_depth
            allowed = wp.max(wp.min(known, solid.thickness) - _DEEPER, _FITS)
            allowed = wp.min(allowed, known - _FITS)
            deep = wp.max(deep, allowed - r.clearance[s, g, w] - solid.core_depth)
        if share == real(1.0) and deep > real(0.0):
            share = (real(s - 1) + near / (near + deep)) / real(SHARES)
        near = -deep
    return share


@wp.kernel
def draw_near(solid: Solid, geoms: Geoms, model: Model, r: Rounds):
    """Leaves so much of a way that the bodies are no deeper in the skin than one round goes. Where nothing
    touched it when the step began, friction knows of their way from about where they meet it, in every
    round."""
    w = wp.tid()
    if r.far[w] == 0 and r.down[w] == 0 and r.meets[w] == 0:
        return
    share = real(1.0)
    met = clear_share(r, w)
    if r.meets[w] == 1 and met > real(0.0):
        for g in range(geoms.count):
            k = geoms.group[g]
            pos = r.asked_pos[k, w]
            mat = r.asked_mat[k, w]
            p, R = displace(
                r.here_pos[k, w],
                r.here_mat[k, w],
                met * motion(pos, mat, r.here_pos[k, w], r.here_mat[k, w]),
            )
            turn = R * wp.transpose(mat)
            geoms.pos_last[g, w] = turn * (geoms.pos[g, w] - pos) + p
            geoms.mat_last[g, w] = turn * geoms.mat[g, w]
    if r.far[w] == 1:
        if r.rounds[w] == 1 and r.depth[0, w] <= real(0.0):
            r.inside[w] = 0
        way = real(0.0)
        for g in range(r.pos.shape[0]):
            there = motion(r.asked_pos[g, w], r.asked_mat[g, w], r.here_pos[g, w], r.here_mat[g, w])
            way = wp.max(way, size_of(there))
        share = wp.min(met + _DEEPER / wp.max(way, _DEEPER), real(1.0))
    elif r.down[w] == 1 and solid.core == 1:
        share = share_down(r, solid, w)
    if share == real(1.0):
        return
    for g in range(r.pos.shape[0]):
        p0 = r.here_pos[g, w]
        R0 = r.here_mat[g, w]
        if r.down[w] == 1:
            p0 = model.pos0[g, w]
            R0 = model.mat0[g, w]
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
    going: wp.array(dtype=int),
    again: wp.array(dtype=int),
):
    """After MuJoCo's answer to the models: which worlds go again, and how far; which take the model back that
    came closest.

    Another solve after one that found no balance, or took long, is not worth its cost.
    """
    w = wp.tid()
    r.spent[w] = r.spent[w] + wanted[w] * iterations[w]
    wanted[w] = 0
    r.better[w] = 0
    r.back[w] = 0
    if r.settled[w] == 1:
        return
    off = distance_off(r, w)
    if off < _TOLERANCE:
        r.settled[w] = 1
    elif r.ended[w] == 0:
        balanced = wp.where(reason[w] == CONVERGED, 1, 0)
        # what was found counts before what was not
        if balanced > r.found[w] or (balanced == r.found[w] and off < r.best[w]):
            r.better[w] = 1
            r.found[w] = balanced
            r.best[w] = off
        quick = iterations[w] < r.long_solve and r.spent[w] < r.long_step and r.rounds[w] < r.limit
        if balanced == 1 and quick:
            r.share[w] = _next_share(r.share[w], off, r.off[w])
            r.off[w] = off
            wanted[w] = 1
            going[0] = 1
            again[0] = 1
        else:
            r.ended[w] = 1
            r.back[w] = 1 - r.better[w]
            if r.back[w] == 1:
                again[0] = 1
