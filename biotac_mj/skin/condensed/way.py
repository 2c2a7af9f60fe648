"""A step of one skin, by the threads of a block: the geoms are followed to where they are asked to be, at
once where that can be, else in parts, as far as the skin finds a balance."""

import functools

import warp as wp

from ..contact.faces import Contact, commit_face
from ..contact.posed import Geoms
from ..newton.worlds import CONVERGED, INSIDE_CORE, NOT_CONVERGED, NOT_FINITE, Worlds, modulus_of
from ..types import real, vec3
from .balance import CUT, TOLERANCE, balance
from .bodies import find_groups, pose_by_forces, pose_by_load
from .broadphase import (
    choose_view,
    find_faces,
    find_nodes,
    forget_faces,
    is_deep,
    largest_displacement,
    measure_core,
)
from .correction import is_measured
from .lanes import sync
from .results import correct, place_nodes
from .structs import Constants, F, G, Remembered, Scratch
from .system import Linear, count_contacts, gather_load

__all__ = ["BLOCK", "solver"]

wp.set_module_options({"enable_backward": False})

_is_measured = wp.func(is_measured)

BLOCK = 256  # threads of a world
_REACH = wp.constant(real(2e-5))  # faces nearer than this, plus what the geoms move, are candidates [m]
# the geoms move at most so far at once, at least [m]
_PART, _LEAST = (wp.constant(real(x)) for x in (2e-3, 1e-5))
_SHORTEST = wp.constant(real(1.0 / 32.0))  # of a way of many parts
_LEVER = wp.constant(real(1e-2))  # at which turning counts as moving [m]
# first part of a way that failed at once, and [m]
_FIRST, _SHORT = (wp.constant(real(x)) for x in (0.125, 1e-4))
_PASSES, _AGAIN = (wp.constant(i) for i in (4, 4))
_PASSING = wp.constant(real(1e-2))  # error that will do where geoms only pass, in one pass
_SETTLED = wp.constant(real(3e-3))  # relative change of pressure and softening that ends the step
_STANDS = wp.constant(real(5e-6))  # motion of bodies by the last change of their wrenches that ends it [m]


@wp.struct
class Found:
    """What a try came to."""

    ok: int
    deep: int
    measured: int
    iterations: int
    nface: int
    ncore: int
    nnode: int
    nin: int
    spent: real
    error: real
    pressure: real
    bulge: real
    solved: wp.vec2d
    after: wp.vec2d
    linear: Linear


@wp.func
def _linear_of(w: int, solved: wp.vec2d, bulge: real, modulus: real, c: Constants, st: Worlds):
    l = Linear()
    l.scale = solved[0] / modulus
    l.swell = solved[1] / modulus
    l.bulge = bulge
    l.share = real(0.0)
    if st.kappa[w] > real(0.0):
        give = real(0.0)  # of a liquid that keeps its volume
        if st.holds[w] == 0:
            give = real(1.0) / st.kappa[w]
        l.share = real(1.0) / (give + l.swell * c.liquid_give)
    return l


@wp.func
def _load(w: int, t: int, threads: int, nnode: int, nin: int, c: Constants, s: Scratch):
    """vector[F] of the candidates from the forces that a solve begins with."""
    for k in range(t, nnode, threads):
        f = s.force[w, s.node[w, k]]
        for a in range(3):
            s.vector[w, F, 3 * k + a] = f[a]
    for k in range(t, nin, threads):
        s.vector[w, F, 3 * nnode + k] = s.core_force[w, s.core_node[w, k]]
    sync()


@wp.func
def _store(w: int, t: int, threads: int, nnode: int, nin: int, c: Constants, s: Scratch):
    """The other way round; what is no candidate has no force."""
    for i in range(t, c.node.shape[0], threads):
        f = vec3()
        k = s.place[w, i]
        if k >= 0:
            f = vec3(s.vector[w, F, 3 * k], s.vector[w, F, 3 * k + 1], s.vector[w, F, 3 * k + 2])
        s.force[w, i] = f
    for i in range(t, c.inner.shape[0], threads):
        push = real(0.0)
        if s.core_place[w, i] >= 0:
            push = s.vector[w, F, 3 * nnode + s.core_place[w, i]]
        s.core_force[w, i] = push
    sync()


@wp.func
def _bound(w: int, t: int, threads: int, nnode: int, nin: int, s: Scratch):
    """Makes forces of no balance safe: the law's own at each node, which push and lie in friction's cone, but
    no more than what the skin balances where it is."""
    for k in range(t, nnode, threads):
        square = real(0.0)
        product = real(0.0)
        for a in range(3):
            g = s.vector[w, G, 3 * k + a]
            square += g * g
            product += g * s.vector[w, F, 3 * k + a]
        share = real(0.0)
        if square > real(0.0):
            share = wp.clamp(product / square, real(0.0), real(1.0))
        for a in range(3):
            s.vector[w, F, 3 * k + a] = share * s.vector[w, G, 3 * k + a]
    for k in range(t, nin, threads):
        j = 3 * nnode + k
        s.vector[w, F, j] = wp.clamp(s.vector[w, F, j], real(0.0), s.vector[w, G, j])
    sync()


@wp.func
def _largest_motion(w: int, geoms: Geoms):
    """How far a point of a geom has moved since the step began, about [m]."""
    most = real(0.0)
    for g in range(geoms.count):
        turn = geoms.mat[g, w] - geoms.mat_last[g, w]
        way = wp.length(geoms.pos[g, w] - geoms.pos_last[g, w]) + _LEVER * wp.sqrt(wp.ddot(turn, turn))
        most = wp.max(most, way)
    return most


@functools.cache
def solver(shapes: str) -> wp.Kernel:
    """The kernel of skins that meet such shapes, see `contact.touch`: a block for each world."""
    newton = balance(shapes)

    @wp.func
    def attempt(
        w: int,
        t: int,
        threads: int,
        holds: int,
        known: int,
        to: real,
        most: real,
        passes: int,
        modulus: real,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        c: Constants,
        s: Scratch,
        r: Remembered,
        st: Worlds,
    ):
        """Solves for the geoms at a share `to` of their way, from what is remembered; with `holds` they are
        where that is, and the skin stays so."""
        found = Found()
        for i in range(t, c.node.shape[0], threads):
            s.force[w, i] = r.force[i, w]
        for i in range(t, c.inner.shape[0], threads):
            s.core_force[w, i] = r.core_force[i, w]
        forget_faces(w, t, threads, touch.kept, c, s, r, touch.touching)
        pose_by_forces(w, t, threads, to, geoms, x, touch, c, s)
        moved = _PART
        if known == 1:
            moved = real(2.0) * _largest_motion(w, geoms)
        view, way = choose_view(w, t, threads, geoms, c, s)
        largest = largest_displacement(w, t, threads, x, c)
        share = real(0.0)
        if largest > real(0.0):
            share = wp.min(real(1.0), real(1.5) * moved / largest)
        found.solved = r.after[w]
        found.bulge = r.bulge[w]
        reach = _REACH + moved
        turns = int(0)
        searching = int(1)
        if holds == 1:
            found.solved = r.solved[w]
            reach = real(-1.0)  # what touched
            share = real(0.0)
        elif is_deep(w, t, threads, view, way, geoms, c, s):
            found.deep = 1
            searching = 0
        while searching == 1:
            if turns > 0:
                largest = largest_displacement(w, t, threads, x, c)
            nface, ncore, new = find_faces(
                w, t, threads, reach, view, way, largest, share, geoms, x, c, s
            )  # fmt: skip
            if turns > 0 and (new == 0 or turns == _AGAIN):
                searching = 0
            elif nface > s.face.shape[1] or ncore > s.core_face.shape[1]:
                searching = 0
                found.ok = 0
            else:
                found.nface = nface
                found.ncore = ncore
                nnode, nin = find_nodes(w, t, threads, nface, ncore, x, c, s)
                found.nnode = nnode
                found.nin = nin
                if nnode > s.node.shape[1] or nin > s.core_node.shape[1]:
                    searching = 0
                    found.ok = 0
                else:
                    measure_core(w, t, threads, nnode, nin, ncore, x, c, s)
                    find_groups(w, t, threads, nnode, geoms, x, touch, c, s)
                    _load(w, t, threads, nnode, nin, c, s)
                    n = 3 * nnode + nin
                    foretold = int(0)
                    before = _linear_of(w, r.solved[w], r.bulge[w], modulus, c, st)
                    count, own = gather_load(w, t, threads, n, F, c, s)
                    if turns == 0 and holds == 0 and known == 1 and count > 0:
                        foretold = 1
                        if before.share > real(0.0):  # what it was when the pressure was found
                            before.bulge = -r.pressure[w] / before.share - before.scale * own
                        for g in range(t, geoms.count, threads):
                            s.held_pos[g, w] = geoms.pos_last[g, w]
                            s.held_mat[g, w] = geoms.mat_last[g, w]
                        sync()
                    turn = int(0)
                    going = int(1)
                    while going == 1:
                        l = _linear_of(w, found.solved, found.bulge, modulus, c, st)
                        if holds == 1 and l.share > real(0.0):  # what it was when the pressure was found
                            count, own = gather_load(w, t, threads, 3 * nnode + nin, F, c, s)
                            l.bulge = -r.pressure[w] / l.share - l.scale * own
                        left = most - found.spent
                        exact = wp.where(passes == 1, _PASSING, TOLERANCE)
                        ok, error, iterations, spent = newton(
                            w,
                            t,
                            threads,
                            nface,
                            ncore,
                            nnode,
                            nin,
                            left,
                            exact,
                            to,
                            foretold,
                            before,
                            l,
                            geoms,
                            x,
                            touch,
                            c,
                            s,
                        )
                        found.ok = ok
                        found.error = error
                        found.iterations = found.iterations + iterations
                        found.spent = found.spent + spent
                        found.linear = l
                        turn += 1
                        if ok == CUT:
                            _bound(w, t, threads, nnode, nin, s)
                        if count_contacts(w, t, threads, nface, touch, c, s) > s.most_contacts:
                            ok = 0
                            found.ok = 0
                        if ok == 0:
                            going = 0
                            searching = 0
                        else:
                            count, own = gather_load(w, t, threads, n, F, c, s)
                            if count == 0:  # nothing touches any more
                                found.bulge = real(0.0)
                            found.pressure = -l.share * (l.scale * own + found.bulge)
                            volume, part = place_nodes(w, t, threads, count, found.pressure, l, x, c, s)
                            after, squeezed, spread = correct(
                                w, t, threads, nnode, found.pressure, modulus, x, c, s
                            )
                            found.after = after
                            found.measured = wp.where(
                                _is_measured(squeezed, spread, c.squeezed, c.narrow), 1, -1
                            )
                            if count == 0:
                                found.measured = 1
                            foretold = 2
                            for g in range(t, geoms.count, threads):
                                s.held_pos[g, w] = geoms.pos[g, w]
                                s.held_mat[g, w] = geoms.mat[g, w]
                            sync()
                            done = int(1)
                            if pose_by_load(w, t, threads, to, nnode, geoms, x, c, s) >= _STANDS:
                                done = 0
                            if wp.abs(after[0] - found.solved[0]) >= _SETTLED:
                                done = 0
                            if wp.abs(after[1] - found.solved[1]) >= _SETTLED:
                                done = 0
                            bulge = found.bulge
                            if l.share > real(0.0):
                                bulge = volume - part
                                if l.share * wp.abs(bulge - found.bulge) >= (
                                    _SETTLED * wp.abs(found.pressure) + real(1.0)
                                ):
                                    done = 0
                            if ok == CUT:
                                going = 0
                            elif done == 1 or turn == passes:
                                going = 0
                            else:
                                found.solved = after
                            found.bulge = bulge
                    if searching == 1:
                        _store(w, t, threads, nnode, nin, c, s)
                    if found.ok == CUT:
                        searching = 0
            turns += 1
            reach = real(0.0)
            share = real(0.0)
        return found

    @wp.func
    def commit(
        w: int,
        t: int,
        threads: int,
        found: Found,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        c: Constants,
        s: Scratch,
        r: Remembered,
        st: Worlds,
        rest_pressure: real,
    ):
        """Where a try came to is remembered; friction goes on from there."""
        for i in range(t, c.node.shape[0], threads):
            r.force[i, w] = s.force[w, i]
        for i in range(t, c.inner.shape[0], threads):
            r.core_force[i, w] = s.core_force[w, i]
        for f in range(t, c.face.shape[0], threads):
            commit_face(f, w, touch)
        for i in range(t, x.shape[0], threads):
            touch.x_last[i, w] = x[i, w]
        for g in range(t, geoms.count, threads):
            geoms.pos_last[g, w] = geoms.pos[g, w]
            geoms.mat_last[g, w] = geoms.mat[g, w]
        if t == 0:
            r.bulge[w] = found.bulge
            r.solved[w] = found.solved
            r.after[w] = found.after
            r.pressure[w] = found.pressure
            st.pressure[w] = found.pressure + rest_pressure
            st.last_pressure[w] = st.pressure[w]
        sync()

    @wp.kernel(module=f"{__name__}.{shapes}", enable_backward=False, launch_bounds=BLOCK)
    def solve(
        # In:
        law: int,
        geoms: Geoms,
        rest_pressure: wp.array(dtype=real),
        c: Constants,
        # In and out:
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        s: Scratch,
        r: Remembered,
        st: Worlds,
        # Out:
        node_force_out: wp.array2d(dtype=vec3),
        tier_out: wp.array(dtype=int),
    ):
        w, t = wp.tid()
        threads = wp.block_dim()
        if st.wanted[w] == 0:
            return
        modulus = modulus_of(law, st.mu[w], st.lam[w])
        finite = wp.where(wp.isfinite(modulus + st.kappa[w]) and modulus > real(0.0), 1, 0)
        most = s.most[w]
        known = int(1)
        length = real(0.0)
        for g in range(geoms.count):
            p = geoms.pos[g, w]
            R = geoms.mat[g, w]
            if not wp.isfinite(p[0] + p[1] + p[2] + wp.ddot(R, R) + geoms.friction[g, w]):
                finite = 0
            last = geoms.pos_last[g, w]
            if not wp.isfinite(last[0] + last[1] + last[2]):
                known = 0
        sync()
        if finite == 0:
            if t == 0:
                st.reason[w] = NOT_FINITE
                st.reached[w] = real(0.0)
                st.iterations[w] = 0
                s.spent[w] = real(0.0)
                s.deep[w] = 0
                st.nonconverged[w] = st.nonconverged[w] + 1
            return
        for g in range(t, geoms.count, threads):
            s.pos[g, w] = geoms.pos[g, w]
            s.mat[g, w] = geoms.mat[g, w]
            if known == 1:
                s.from_pos[g, w] = geoms.pos_last[g, w]
                s.from_mat[g, w] = geoms.mat_last[g, w]
            else:
                s.from_mat[g, w] = geoms.mat[g, w]
                geoms.pos_last[g, w] = geoms.pos[g, w]
                geoms.mat_last[g, w] = geoms.mat[g, w]
        sync()
        if known == 1:
            for g in range(geoms.count):
                turn = s.mat[g, w] - s.from_mat[g, w]
                way = wp.length(s.pos[g, w] - s.from_pos[g, w]) + _LEVER * wp.sqrt(wp.ddot(turn, turn))
                length = wp.max(length, way)
        longest = real(1.0)
        if length > _PART:
            longest = wp.max(_PART / length, _SHORTEST)
        if s.bodies.begun.shape[0] > 0:
            for i in range(t, c.node.shape[0], threads):
                s.force[w, i] = r.force[i, w]
            for g in range(t, geoms.count, threads):
                geoms.pos[g, w] = s.from_pos[g, w]
                geoms.mat[g, w] = s.from_mat[g, w]
            sync()
            pose_by_forces(w, t, threads, real(1.0), geoms, x, touch, c, s)
            for h in range(t, s.bodies.begun.shape[0], threads):
                s.bodies.begun[h, w] = s.bodies.posed[h, w]
            sync()
        at = real(0.0)
        part = longest
        holds = int(0)
        arrived = int(0)  # whether what was found last is where the way goes on
        deep = int(0)
        spent = real(0.0)
        iterations = int(0)
        error = real(0.0)
        on = int(1)
        found = Found()
        while on == 1:
            to = at + part
            if to > real(1.0) - real(1e-9):
                to = real(1.0)
            left = most - spent
            passes = wp.where(to < real(1.0), 1, _PASSES)
            if holds == 1:
                left = real(0.0)
            found = attempt(
                w, t, threads, holds, known, to, left, passes, modulus, geoms, x, touch, c, s, r, st
            )  # fmt: skip
            if holds == 1:
                on = 0
            else:
                spent += found.spent
                iterations += found.iterations
                error = found.error
            arrived = found.ok
            if holds == 1:
                for i in range(t, x.shape[0], threads):
                    x[i, w] = touch.x_last[i, w]
                sync()
            elif found.ok != 0:
                if t == 0:
                    tier_out[w] = found.measured
                commit(w, t, threads, found, geoms, x, touch, c, s, r, st, rest_pressure[w])
                at = to
                part = wp.min(real(2.0) * part, longest)
                if at == real(1.0) or found.ok == CUT:  # nothing is left for another try
                    on = 0
            else:
                arrived = 0
                deep = wp.max(deep, found.deep)
                for i in range(t, x.shape[0], threads):
                    x[i, w] = touch.x_last[i, w]
                sync()
                if known == 0:  # from where they come nobody knows: from outside
                    known = 1
                    length = real(0.0)
                    for g in range(geoms.count):
                        p = s.from_pos[g, w]
                        length = wp.max(length, wp.length(s.pos[g, w] - p))
                        if t == 0:
                            geoms.pos_last[g, w] = p
                    sync()
                    part = wp.min(longest, wp.max(_PART / wp.max(length, _PART), _SHORTEST))
                    longest = part
                elif at == real(0.0) and part == real(1.0) and length > real(0.0):
                    part = wp.min(real(0.5), wp.max(_FIRST, _SHORT / length))
                else:
                    part = real(0.5) * part
                if part * length < _LEAST:
                    on = 0
            if holds == 0 and (on == 0 or spent >= most):
                on = 0
                if arrived == 0:  # the skin as it is remembered
                    holds = 1
                    part = real(0.0)
                    on = 1
        if t == 0:
            s.count[w, 0] = found.nface
            s.count[w, 1] = found.nnode
            s.count[w, 2] = found.nin
            s.linear[w, 0] = found.linear.scale
            s.linear[w, 1] = found.linear.share
            s.linear[w, 2] = found.linear.swell
        for i in range(t, c.node.shape[0], threads):
            node_force_out[c.node[i], w] = r.force[i, w]
        for g in range(t, geoms.count, threads):
            geoms.pos[g, w] = s.pos[g, w]
            geoms.mat[g, w] = s.mat[g, w]
        if t == 0:
            st.iterations[w] = iterations
            s.spent[w] = spent
            s.deep[w] = deep
            st.error[w] = error
            st.reached[w] = at
            st.reason[w] = CONVERGED
            if at < real(1.0) or found.ok != 1:
                st.reason[w] = wp.where(deep == 1, INSIDE_CORE, NOT_CONVERGED)
                st.nonconverged[w] = st.nonconverged[w] + 1

    return solve
