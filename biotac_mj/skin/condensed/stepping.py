"""Load stepping of one skin, by the threads of a block: the geoms are moved to their new poses in one
increment if possible, else in several, as far as the skin finds an equilibrium. The functions below are
phases of `states`; `solve` launches them."""

import warp as wp

from ..block import sync
from ..contact.faces import balanced_fraction, commit_face
from ..contact.posed import Geoms
from ..newton.worlds import CONVERGED, INSIDE_CORE, NOT_CONVERGED, NOT_FINITE, Worlds, modulus_of
from ..types import mat33, real, vec3
from .balance import CUT, TOLERANCE, newton_from
from .bodies import find_groups, place_bodies, pose_by_load, sum_forces
from .broadphase import (
    choose_view,
    find_faces,
    find_inner_faces,
    find_nodes,
    find_slack,
    forget_faces,
    is_deep,
    is_known,
    largest_displacement,
    may_be_touched,
    measure_core,
)
from .correction import is_measured
from .results import correct, place_nodes
from .states import BALANCED, DONE, NEWTON, SEARCH, Increment, Linear, LoadStepping, Predictor
from .structs import Constants, F, G, Remembered, Scratch
from .system import count_contacts, gather_load

_is_measured = wp.func(is_measured)

_REACH = wp.constant(real(2e-5))  # faces nearer than this, plus what the geoms move, are candidates [m]
# the geoms move at most so far at once, at least [m]
_PART, _LEAST = (wp.constant(real(x)) for x in (2e-3, 1e-5))
_SHORTEST = wp.constant(real(1.0 / 32.0))  # least increment of a motion
_LEVER = wp.constant(real(1e-2))  # lever arm of rotations [m]
# first increment of a motion that failed at once, and [m]
_FIRST, _SHORT = (wp.constant(real(x)) for x in (0.125, 1e-4))
_PASSES, _AGAIN = (wp.constant(i) for i in (4, 4))
_PASSING = wp.constant(real(1e-2))  # tolerance of intermediate increments, which have one pass
_SETTLED = wp.constant(real(3e-3))  # relative change of pressure and softening that ends the step
# motion of bodies by the last change of their wrenches that ends the step [m]
_STANDS = wp.constant(real(5e-6))


@wp.func
def _linear_of(w: int, solved: wp.vec2d, bulge: real, modulus: real, c: Constants, st: Worlds):
    l = Linear()
    l.scale = solved[0] / modulus
    l.swell = solved[1] / modulus
    l.bulge = bulge
    l.bulk_stiffness = real(0.0)
    if st.kappa[w] > real(0.0):
        give = real(0.0)  # of a liquid that keeps its volume
        if st.keeps_volume[w] == 0:
            give = real(1.0) / st.kappa[w]
        l.bulk_stiffness = real(1.0) / (give + l.swell * c.liquid_give)
    return l


@wp.func
def _load(w: int, t: int, nnode: int, nin: int, s: Scratch):
    """Sets vector[F] of the candidates to the initial forces of a solve."""
    for k in range(t, nnode, wp.block_dim()):
        f = s.force[w, s.node[w, k]]
        for a in range(3):
            s.vector[w, F, 3 * k + a] = f[a]
    for k in range(t, nin, wp.block_dim()):
        s.vector[w, F, 3 * nnode + k] = s.core_force[w, s.core_node[w, k]]
    sync()


@wp.func
def _store(w: int, t: int, nnode: int, c: Constants, s: Scratch):
    """Stores vector[F] as forces of the nodes; nodes that are no candidates have none."""
    for i in range(t, c.node.shape[0], wp.block_dim()):
        f = vec3()
        k = s.place[w, i]
        if k >= 0:
            f = vec3(s.vector[w, F, 3 * k], s.vector[w, F, 3 * k + 1], s.vector[w, F, 3 * k + 2])
        s.force[w, i] = f
    for i in range(t, c.inner.shape[0], wp.block_dim()):
        push = real(0.0)
        if s.core_place[w, i] >= 0:
            push = s.vector[w, F, 3 * nnode + s.core_place[w, i]]
        s.core_force[w, i] = push
    sync()


@wp.func
def _bound(w: int, t: int, nnode: int, nin: int, s: Scratch):
    """Limits forces that are not in equilibrium: those of the contact law at each node, which push and lie in
    the friction cone, but at most the forces that the skin balances at its displacements."""
    for k in range(t, nnode, wp.block_dim()):
        push = vec3(s.vector[w, G, 3 * k], s.vector[w, G, 3 * k + 1], s.vector[w, G, 3 * k + 2])
        balanced = vec3(s.vector[w, F, 3 * k], s.vector[w, F, 3 * k + 1], s.vector[w, F, 3 * k + 2])
        fraction = balanced_fraction(push, balanced)
        for a in range(3):
            s.vector[w, F, 3 * k + a] = fraction * push[a]
    for k in range(t, nin, wp.block_dim()):
        j = 3 * nnode + k
        s.vector[w, F, j] = wp.clamp(s.vector[w, F, j], real(0.0), s.vector[w, G, j])
    sync()


@wp.func
def _largest_motion(w: int, geoms: Geoms):
    """Approximate largest motion of a point of the geoms in this step [m]."""
    most = real(0.0)
    for g in range(geoms.count):
        turn = geoms.mat[g, w] - geoms.mat_last[g, w]
        travel = wp.length(geoms.pos[g, w] - geoms.pos_last[g, w]) + _LEVER * wp.sqrt(wp.ddot(turn, turn))
        most = wp.max(most, travel)
    return most


@wp.func
def _begin_increment(p: LoadStepping, most: real):
    """Starts the next increment at the end of the last one."""
    p.to = p.at + p.part
    if p.to > real(1.0) - real(1e-9):
        p.to = real(1.0)
    p.left = most - p.spent
    if p.holds == 1:
        p.left = real(0.0)
    return p


@wp.func
def _next_increment(last: Increment):
    """A new increment with the candidates of the last one."""
    o = Increment()
    o.nface = last.nface
    o.ncore = last.ncore
    o.nnode = last.nnode
    o.nin = last.nin
    o.near = last.near
    o.reach = last.reach
    o.fraction = last.fraction
    return o


@wp.func
def begin_step(w: int, t: int, law: int, geoms: Geoms, s: Scratch, st: Worlds):
    """Starts a step: previous and new poses of the geoms."""
    if st.wanted[w] == 0:
        if t == 0:
            s.solve.phase[w] = DONE
        return
    p = LoadStepping()
    p.modulus = modulus_of(law, st.mu[w], st.lam[w])
    finite = wp.where(wp.isfinite(p.modulus + st.kappa[w]) and p.modulus > real(0.0), 1, 0)
    for g in range(geoms.count):
        at = geoms.pos[g, w]
        R = geoms.mat[g, w]
        if not wp.isfinite(at[0] + at[1] + at[2] + wp.ddot(R, R) + geoms.friction[g, w]):
            finite = 0
    sync()
    if finite == 0:
        if t == 0:
            st.reason[w] = NOT_FINITE
            st.load_factor[w] = real(0.0)
            st.iterations[w] = 0
            s.spent[w] = real(0.0)
            s.deep[w] = 0
            st.nonconverged[w] = st.nonconverged[w] + 1
            s.solve.phase[w] = DONE
        return
    for g in range(t, geoms.count, wp.block_dim()):
        s.pos[g, w] = geoms.pos[g, w]
        s.mat[g, w] = geoms.mat[g, w]
        last = geoms.pos_last[g, w]
        if not wp.isfinite(last[0] + last[1] + last[2]):  # it begins where it is
            geoms.pos_last[g, w] = geoms.pos[g, w]
            geoms.mat_last[g, w] = geoms.mat[g, w]
        s.from_pos[g, w] = geoms.pos_last[g, w]
        s.from_mat[g, w] = geoms.mat_last[g, w]
    sync()
    p.length = _largest_motion(w, geoms)
    p.longest = real(1.0)
    if p.length > _PART:
        p.longest = wp.max(_PART / p.length, _SHORTEST)
    p.part = p.longest
    if p.part == real(1.0):
        p.again = s.previous.begins[w]
    sync()
    if t == 0:
        s.previous.begins[w] = 0
        s.solve.stepping[w] = _begin_increment(p, s.most[w])
        s.solve.increment[w] = _next_increment(s.solve.increment[w])
        s.solve.phase[w] = SEARCH


@wp.func
def _begin_at(
    w: int,
    t: int,
    o: Increment,
    r: Remembered,
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
    modulus: real,
    c: Constants,
    s: Scratch,
    st: Worlds,
):
    """Begins an increment at an equilibrium with geoms at these poses: its forces, pressure and linear skin,
    the softening after it, and where geoms are held."""
    for i in range(t, c.node.shape[0], wp.block_dim()):
        s.force[w, i] = r.force[i, w]
    for i in range(t, c.inner.shape[0], wp.block_dim()):
        s.core_force[w, i] = r.core_force[i, w]
    for g in range(t, pos.shape[0], wp.block_dim()):
        s.held_pos[g, w] = pos[g, w]
        s.held_mat[g, w] = mat[g, w]
    sync()
    o.solved = r.after[w]
    o.bulge = r.bulge[w]
    o.pressure = r.pressure[w]
    o.linear = _linear_of(w, r.solved[w], r.bulge[w], modulus, c, st)
    return o


@wp.func
def search(w: int, t: int, geoms: Geoms, c: Constants, s: Scratch, r: Remembered, st: Worlds):
    """The phase SEARCH: finds the candidates, first at the start of an increment, then at its displacements
    while there are new ones. Where those of a long motion find no room it begins anew with nearer ones:
    the searches that follow find which of the others are touched."""
    p = s.solve.stepping[w]
    o = s.solve.increment[w]
    sync()
    first = wp.where(o.searches == 0, 1, 0)
    looking = int(1)
    known = int(0)  # whether the candidates of an earlier increment are all that can touch
    moved = real(0.0)
    if first == 1:
        if p.again == 1:
            at = s.previous
            o = _begin_at(w, t, o, at.balance, at.pos, at.mat, p.modulus, c, s, st)
        else:
            o = _begin_at(w, t, o, r, geoms.pos_last, geoms.mat_last, p.modulus, c, s, st)
        sum_forces(w, t, geoms, c, s)
        if p.at == real(0.0):  # where the step begins
            for h in range(t, s.bodies.begun.shape[0], wp.block_dim()):
                s.bodies.begun[h, w] = s.bodies.posed[h, w]
            sync()
        place_bodies(w, t, p.to, geoms, s)
        moved = wp.pow(real(0.5), real(o.cutbacks - 1)) * _largest_motion(w, geoms)
        view, travel, near = choose_view(w, t, geoms, c, s)
        if p.holds == 1:
            o.solved = r.solved[w]
        elif is_deep(w, t, view, travel, near, geoms, c, s):
            o.deep = 1
            looking = 0
        elif near & o.near == near:
            known = is_known(w, t, o, geoms, c, s)
        o.view = view
        o.travel = travel
        o.near = near
        if known == 0:
            forget_faces(w, t, geoms, c, s)
            o.reach = _REACH + moved
            if p.holds == 1 or looking == 0:  # what touched
                o.reach = real(-1.0)
            o.nface = 0
    if looking == 1 and known == 0:
        largest = largest_displacement(w, t, s.x, c)
        reach = real(0.0)
        fraction = real(0.0)
        if first == 1:
            o.fraction = real(0.0)
            if o.reach * largest > real(0.0):
                o.fraction = wp.min(real(1.0), real(1.5) * o.reach / largest)
            reach = o.reach
            fraction = o.fraction
        else:
            o.reach = real(-1.0)  # which nodes have left
        nface, new = find_faces(w, t, reach, o.view, o.travel, largest, o.near, geoms, c, s)
        ncore, inner = find_inner_faces(w, t, fraction, c, s)
        new += inner
        if first == 0 and (new == 0 or o.searches == _AGAIN):
            looking = 0
        else:
            o.nface = nface
            o.ncore = ncore
    if looking == 1 and known == 0:
        nnode, nin = find_nodes(w, t, o.nface, o.ncore, c, s)
        o.nnode = nnode
        o.nin = nin
        if o.ncore > s.core_face.shape[1] or 3 * nnode + nin > s.coordinate.shape[1]:
            o.reach = real(-1.0)  # not all are listed
            if first == 1 and moved > _REACH:
                o.cutbacks += 1
                if t == 0:
                    s.solve.increment[w] = o
                return
            looking = 0
            o.ok = 0
    if looking == 1:
        measure_core(w, t, o.nnode, o.nin, o.ncore, c, s)
        find_groups(w, t, o.nnode, geoms, c, s)
        _load(w, t, o.nnode, o.nin, s)
        predictor = int(Predictor.NONE)
        before = o.linear
        count, own = gather_load(w, t, 3 * o.nnode + o.nin, F, c, s)
        l = _linear_of(w, o.solved, o.bulge, p.modulus, c, st)
        if first == 1 and count > 0 and p.holds == 0:
            predictor = int(Predictor.PENDING)
            if before.bulk_stiffness > real(0.0):  # what it was when the pressure was found
                before.bulge = -o.pressure / before.bulk_stiffness - before.scale * own
        if p.holds == 1 and l.bulk_stiffness > real(0.0):
            l.bulge = -r.pressure[w] / l.bulk_stiffness - l.scale * own
        if t == 0:
            exact = wp.where(p.to < real(1.0), _PASSING, TOLERANCE)
            s.solve.newton[w] = newton_from(predictor, before, l, p.left - o.spent, exact)
    o.searches += 1
    o.passes = 0
    o.solving = looking
    if t == 0:
        s.solve.increment[w] = o
        s.solve.phase[w] = wp.where(looking == 1, NEWTON, BALANCED)


@wp.func
def _remember(
    w: int,
    t: int,
    found: Increment,
    geoms: Geoms,
    c: Constants,
    s: Scratch,
    r: Remembered,
    pos: wp.array2d(dtype=vec3),
    mat: wp.array2d(dtype=mat33),
):
    for i in range(t, c.node.shape[0], wp.block_dim()):
        r.force[i, w] = s.force[w, i]
    for i in range(t, c.inner.shape[0], wp.block_dim()):
        r.core_force[i, w] = s.core_force[w, i]
    for g in range(t, geoms.count, wp.block_dim()):
        pos[g, w] = geoms.pos[g, w]
        mat[g, w] = geoms.mat[g, w]
    if t == 0:
        r.bulge[w] = found.bulge
        r.solved[w] = found.solved
        r.after[w] = found.after
        r.pressure[w] = found.pressure


@wp.func
def _commit(
    w: int,
    t: int,
    found: Increment,
    geoms: Geoms,
    c: Constants,
    s: Scratch,
    r: Remembered,
    st: Worlds,
    rest_pressure: real,
):
    """Stores the state at the end of an increment, with the friction anchors."""
    _remember(w, t, found, geoms, c, s, r, geoms.pos_last, geoms.mat_last)
    if s.previous.pos.shape[0] > 0:
        _remember(w, t, found, geoms, c, s, s.previous.balance, s.previous.pos, s.previous.mat)
    for k in range(t, found.nface, wp.block_dim()):  # those that had anchors are candidates
        commit_face(s.face[w, k], w, s.touch)
    for i in range(t, s.x.shape[0], wp.block_dim()):
        s.touch.x_last[i, w] = s.x[i, w]
    if t == 0:
        st.pressure[w] = found.pressure + rest_pressure
        st.last_pressure[w] = st.pressure[w]
    sync()


@wp.func
def _conclude_pass(
    w: int, t: int, p: LoadStepping, o: Increment, geoms: Geoms, c: Constants, s: Scratch, st: Worlds
):
    """Ends a pass of Newton's method; returns the increment and the next phase, BALANCED if the increment has
    ended, SEARCH if what was no candidate may be touched now."""
    d = s.solve.newton[w]
    l = d.linear
    o.ok = d.found
    o.error = d.error
    if not wp.isfinite(d.error):  # no step was made
        o.error = real(1.0)
    o.iterations += d.iterations
    o.spent += d.spent
    o.linear = l
    o.passes += 1
    n = 3 * o.nnode + o.nin
    if o.ok == CUT:
        if o.error < real(1.0) - p.at:
            _bound(w, t, o.nnode, o.nin, s)
        else:  # further from an equilibrium than where the path began
            o.ok = 0
    if count_contacts(w, t, o.nface, c, s) > s.most_contacts:
        o.ok = 0
    if o.ok == 0:
        return o, BALANCED
    count, own = gather_load(w, t, n, F, c, s)
    if count == 0:  # nothing touches any more
        o.bulge = real(0.0)
    o.pressure = -l.bulk_stiffness * (l.scale * own + o.bulge)
    volume, part, largest = place_nodes(w, t, count, o.pressure, l, c, s)
    o.largest = largest
    after, squeezed, spread = correct(w, t, o.nnode, o.pressure, p.modulus, c, s)
    o.after = after
    o.measured = wp.where(_is_measured(squeezed, spread, c.squeezed, c.narrow), 1, -1)
    if count == 0:
        o.measured = 1
    for g in range(t, geoms.count, wp.block_dim()):
        s.held_pos[g, w] = geoms.pos[g, w]
        s.held_mat[g, w] = geoms.mat[g, w]
    sync()
    done = int(1)
    if pose_by_load(w, t, p.to, o.nnode, geoms, c, s) >= _STANDS:
        done = 0
    if wp.abs(after[0] - o.solved[0]) >= _SETTLED:
        done = 0
    if wp.abs(after[1] - o.solved[1]) >= _SETTLED:
        done = 0
    bulge = o.bulge
    if l.bulk_stiffness > real(0.0):
        bulge = volume - part
        if l.bulk_stiffness * wp.abs(bulge - o.bulge) >= _SETTLED * wp.abs(o.pressure) + real(1.0):
            done = 0
    o.bulge = bulge
    passes = wp.where(p.to < real(1.0), 1, _PASSES)
    if o.ok != CUT and done == 0 and o.passes < passes:
        o.solved = after
        if t == 0:
            again = _linear_of(w, o.solved, o.bulge, p.modulus, c, st)
            s.solve.newton[w] = newton_from(
                int(Predictor.EVALUATED), d.before, again, p.left - o.spent, d.tolerance
            )
        return o, NEWTON
    _store(w, t, o.nnode, c, s)
    if o.ok != CUT:
        if may_be_touched(w, t, o, geoms, c, s):
            return o, SEARCH
    return o, BALANCED


@wp.func
def _advance_load(most: real, p: LoadStepping, o: Increment):
    """Accepts or cuts back the load increment, and chooses the next; returns whether there is one."""
    on = int(1)
    if p.holds == 1:
        return p, 0
    p.again = 0
    p.spent += o.spent
    p.iterations += o.iterations
    p.error = o.error
    if o.ok != 0:
        p.at = p.to
        p.part = wp.min(real(2.0) * p.part, p.longest)
        if p.at == real(1.0) or o.ok == CUT:  # nothing is left for another try
            on = 0
    else:
        p.deep = wp.max(p.deep, o.deep)
        if p.at == real(0.0) and p.part == real(1.0) and p.length > real(0.0):
            p.part = wp.min(real(0.5), wp.max(_FIRST, _SHORT / p.length))
        else:
            p.part = real(0.5) * p.part
        if p.part * p.length < _LEAST:
            on = 0
    if on == 0 or p.spent >= most:
        on = 0
        if o.ok == 0:  # the skin as it is remembered
            p.holds = 1
            p.part = real(0.0)
            on = 1
    return p, on


@wp.func
def conclude_balance(
    w: int,
    t: int,
    geoms: Geoms,
    rest_pressure: wp.array(dtype=real),
    c: Constants,
    s: Scratch,
    r: Remembered,
    st: Worlds,
    node_force: wp.array2d(dtype=vec3),
    tier: wp.array(dtype=int),
):
    """The phase BALANCED: decides about the increment and the step after Newton's method has ended."""
    p = s.solve.stepping[w]
    o = s.solve.increment[w]
    sync()
    phase = BALANCED
    if o.solving == 1:
        o, phase = _conclude_pass(w, t, p, o, geoms, c, s, st)
    if phase != BALANCED:
        if t == 0:
            s.solve.increment[w] = o
            s.solve.phase[w] = phase
        return
    if p.holds == 0 and o.ok != 0:
        if t == 0:
            tier[w] = o.measured
        _commit(w, t, o, geoms, c, s, r, st, rest_pressure[w])
    else:
        for i in range(t, s.x.shape[0], wp.block_dim()):
            s.x[i, w] = s.touch.x_last[i, w]
        sync()
    p, on = _advance_load(s.most[w], p, o)
    if on == 1:
        if t == 0:
            s.solve.stepping[w] = _begin_increment(p, s.most[w])
            s.solve.increment[w] = _next_increment(o)
            s.solve.phase[w] = SEARCH
        return
    if s.slack.shape[0] > 0:
        find_slack(w, t, o, geoms, c, s)
        sync()
    for i in range(t, c.node.shape[0], wp.block_dim()):
        node_force[c.node[i], w] = r.force[i, w]
    for g in range(t, geoms.count, wp.block_dim()):
        geoms.pos[g, w] = s.pos[g, w]
        geoms.mat[g, w] = s.mat[g, w]
    if t == 0:
        s.solve.increment[w] = o
        s.solve.phase[w] = DONE
        st.iterations[w] = p.iterations
        s.spent[w] = p.spent
        s.deep[w] = p.deep
        st.error[w] = p.error
        st.load_factor[w] = p.at
        st.reason[w] = CONVERGED
        if p.at < real(1.0) or o.ok != 1:
            st.reason[w] = wp.where(p.deep == 1, INSIDE_CORE, NOT_CONVERGED)
            st.nonconverged[w] = st.nonconverged[w] + 1
