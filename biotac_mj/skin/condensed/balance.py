"""The balance of one skin, by the threads of a block: Newton's method on the contact law over the
candidates.

Where friction, or a skin that snaps, leads Newton's method round in circles, the skin creeps: each iteration
is a step of time of rubber with viscosity, which resists its motion as rubber stiffer by the lag would. It
slides and snaps to where real skin comes to rest; near there the steps grow and are Newton's again, so what
is found is a balance without viscosity."""

import functools

import warp as wp

from ..contact.broadphase import face_ball, geoms_within
from ..contact.faces import Contact
from ..contact.posed import Geoms
from ..contact.touch import contact_kernels
from ..types import real, vec3
from .bodies import pose_by_load, touching_group
from .lanes import block_rank, block_sum, sync
from .structs import BACK, DF, DU, TRY, Constants, F, G, Scratch, U
from .system import Linear, multiply, solve_system

__all__ = ["CUT", "TOLERANCE", "balance"]

wp.set_module_options({"enable_backward": False})

TOLERANCE = wp.constant(real(1e-4))  # of the residual: the error of single steps is heard as chatter
# at an edge of a mesh the law's force jumps, and what balances it may lie in between: so much may be left
# where a search along a step has caught the jump so closely, as a share of the tolerance
_ROUGH, _CAUGHT = (wp.constant(real(x)) for x in (0.05, 0.1))
CUT = wp.constant(2)
_MAX_NEWTON, _SLOW, _LENGTHS = (wp.constant(i) for i in (200, 8, 10))
_LAG, _QUICKER, _SLOWER = (wp.constant(real(x)) for x in (1.0, 3.0, 4.0))
_DEAR = wp.constant(real(80.0))  # equations that cost as much as an evaluation; twice as many, four
_AT_ONCE, _FIXED = (wp.constant(real(x)) for x in (0.01, 1e5))


@functools.cache
def balance(shapes: str) -> wp.Function:
    """Newton's method of skins that meet such shapes, see `contact.touch`."""
    touch_faces = contact_kernels(False, False, shapes).touch_faces

    @wp.func
    def evaluate(
        w: int,
        t: int,
        threads: int,
        nface: int,
        ncore: int,
        nnode: int,
        nin: int,
        at: int,
        coupled: int,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        c: Constants,
        s: Scratch,
    ):
        """Forces vector[G] of the contact law at displacements vector[at] of the candidates, and which
        touch."""
        sync()
        for k in range(t, nnode, threads):
            i = c.node[s.node[w, k]]
            u = vec3(s.vector[w, at, 3 * k], s.vector[w, at, 3 * k + 1], s.vector[w, at, 3 * k + 2])
            x[i, w] = c.rest[i, 0] + u
        sync()
        several = s.bodies.compliance.shape[0] > 1
        close = int(0)
        for begin in range(0, nface, threads):
            k = begin + t
            count = int(0)
            near = wp.int64(0)
            f = int(0)
            if k < nface:
                f = s.face[w, k]
                face = c.face[f]
                touch.touching[f, w] = 0
                center, radius = face_ball(x[face[0], w], x[face[1], w], x[face[2], w])
                count, near = geoms_within(center, radius, w, geoms)
            rank = block_rank(wp.min(count, 1))
            if count > 0:
                s.close[w, close + rank[0]] = f
                s.close_to[w, close + rank[0]] = near
            close += rank[1]
        sync()
        touch_faces(w, t, threads, close, s.close, s.close_to, geoms, x, touch, coupled)
        sync()
        for k in range(t, nnode, threads):
            i = c.node[s.node[w, k]]
            total = vec3()
            on = int(0)
            for m in range(c.start[i], c.start[i + 1]):
                f = c.slot[m] / 3
                if touch.touching[f, w] == 1:
                    total += touch.corner[c.slot[m], w]
                    if on == 0 and several:
                        s.group[w, k] = touching_group(f, w, geoms, touch, c.sample.shape[0], s.group[w, k])
                    on = 1
            s.on[w, k] = on
            for a in range(3):
                s.vector[w, G, 3 * k + a] = total[a]
        nsample = c.sample.shape[0]
        for k in range(t, ncore * nsample, threads):
            place = k / nsample
            face = c.inner_face[s.core_face[w, place]]
            moved = vec3()
            for a in range(3):
                q = c.inner_number[face[a]]
                if q >= 0:
                    j = 3 * nnode + s.core_place[w, q]
                    moved[a] = s.vector[w, at, j] - s.vector[w, BACK, j]
            n = k % nsample
            s.now[w, place, n] = s.gap[w, place, n] + wp.dot(c.sample[n], moved)
        sync()
        for k in range(t, nin, threads):
            push = real(0.0)
            stiff = real(0.0)
            v = c.inner[s.core_node[w, k]]
            for m in range(c.inner_start[v], c.inner_start[v + 1]):
                f = c.inner_slot[m] / 3
                place = s.near_core[w, f] - 1
                if place >= 0:
                    share = touch.stiffness[w] * c.inner_area[f] / real(nsample)
                    for n in range(nsample):
                        gap = s.now[w, place, n]
                        if gap < real(0.0):
                            b = c.sample[n][c.inner_slot[m] % 3]
                            push -= share * gap * b
                            stiff += share * b
            s.vector[w, G, 3 * nnode + k] = push
            s.stiff[w, k] = stiff
            s.on[w, nnode + k] = wp.where(stiff > real(0.0), 1, 0)
        sync()

    @wp.func
    def swap_poses(w: int, t: int, threads: int, geoms: Geoms, s: Scratch):
        """Puts the geoms where they are held, and the other way round."""
        sync()
        for g in range(t, geoms.count, threads):
            pos = geoms.pos[g, w]
            mat = geoms.mat[g, w]
            geoms.pos[g, w] = s.held_pos[g, w]
            geoms.mat[g, w] = s.held_mat[g, w]
            s.held_pos[g, w] = pos
            s.held_mat[g, w] = mat
        sync()

    @wp.func
    def find_motion(
        w: int,
        t: int,
        threads: int,
        nnode: int,
        nin: int,
        geoms: Geoms,
        touch: Contact,
        c: Constants,
        s: Scratch,
    ):
        """Makes vector[TRY], displacements of the nodes, their motion from vector[U], of those that touch
        relative to the geoms, which have moved from where they were held."""
        nsample = c.sample.shape[0]
        for k in range(t, nnode, threads):
            i = c.node[s.node[w, k]]
            u = vec3(s.vector[w, U, 3 * k], s.vector[w, U, 3 * k + 1], s.vector[w, U, 3 * k + 2])
            p = c.rest[i, 0] + u
            g = int(-1)
            for m in range(c.start[i], c.start[i + 1]):
                f = c.slot[m] / 3
                if touch.touching[f, w] == 1:
                    for n in range(nsample):
                        g = wp.max(g, touch.trial_geom[f * nsample + n, w])
            if g >= 0:
                turn = geoms.mat[g, w] * wp.transpose(s.held_mat[g, w])
                u += geoms.pos[g, w] + turn * (p - s.held_pos[g, w]) - p
            for a in range(3):
                s.vector[w, TRY, 3 * k + a] = s.vector[w, TRY, 3 * k + a] - u[a]
        for j in range(3 * nnode + t, 3 * nnode + nin, threads):
            s.vector[w, TRY, j] = s.vector[w, TRY, j] - s.vector[w, U, j]
        sync()

    @wp.func
    def newton(
        w: int,
        t: int,
        threads: int,
        nface: int,
        ncore: int,
        nnode: int,
        nin: int,
        most: real,
        tolerance: real,
        share: real,
        foretold: int,
        before: Linear,
        l: Linear,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        touch: Contact,
        c: Constants,
        s: Scratch,
    ):
        """Balanced forces vector[F] from those there, displacements vector[U], and the contact there with a
        symmetric tangent, for the geoms at a share of their way; whether that was found (`CUT`: it would cost
        more than it may), the error, how many iterations it took, and its cost, an evaluation's being one.
        Where it may cost nothing it is the contact of the forces as they are.

        Where it is `foretold`, vector[F] is a balance of the skin as it was `before` with the geoms where
        they are held, and Newton's first step goes from there. 2: contact has been evaluated there, at
        vector[U]."""
        n = 3 * nnode + nin
        foretelling = foretold
        fresh = int(U)  # displacements that the forces bring about, to be found; -1: none
        if foretold == 2:
            fresh = TRY
        lag = real(0.0)
        alpha = real(1.0)
        error = real(wp.inf)
        last = error
        slope = real(0.0)
        work = real(0.0)
        low = real(0.0)
        high = real(-1.0)
        at_low = real(0.0)
        at_high = real(0.0)
        found = int(0)
        iterations = int(0)
        spent = real(0.0)
        tried = int(0)
        caught = real(1.0)  # how long the piece of the last step is in which the residual turned round
        at = int(U)
        searching = int(0)
        ends = int(0)
        on = int(1)
        # one place that evaluates, since the compiler copies it to each: first, along a step, in the end
        while on == 1:
            if fresh >= 0:
                skin = l
                if foretelling == 1:
                    skin = before
                multiply(w, t, threads, nnode, n, F, fresh, 1, skin, c, s)
                fresh = -1
            steps = 1 - searching  # whether a step is to be found
            if foretelling == 2:
                find_motion(w, t, threads, nnode, nin, geoms, touch, c, s)
                steps = 2
            else:
                if foretelling == 1:
                    swap_poses(w, t, threads, geoms, s)
                evaluate(w, t, threads, nface, ncore, nnode, nin, at, 1 - ends, geoms, x, touch, c, s)
                spent += real(1.0)
            if foretelling == 1:
                swap_poses(w, t, threads, geoms, s)
                foretelling = 2
                fresh = TRY
                steps = 0
            if ends == 1:
                on = 0
                steps = 0
            if searching == 1:
                tried += 1
                mine = real(0.0)
                for j in range(t, n, threads):
                    f = s.vector[w, F, j] + alpha * s.vector[w, DF, j]
                    mine += (s.vector[w, G, j] - f) * s.vector[w, DU, j]
                now = wp.sign(slope) * block_sum(mine) - alpha * lag * work
                good = wp.where(wp.abs(now) <= real(0.5) * wp.abs(slope), 1, 0)
                if good == 1 or (now > real(0.0) and high < real(0.0)) or tried >= _LENGTHS:
                    searching = 0
                    steps = 1
                    caught = real(1.0)
                    if good == 0 and high >= real(0.0):
                        caught = high - low
                    for j in range(t, n, threads):
                        s.vector[w, F, j] = s.vector[w, F, j] + alpha * s.vector[w, DF, j]
                        s.vector[w, U, j] = s.vector[w, TRY, j]
                    sync()
                    if good == 1 and alpha == real(1.0) and (lag > real(0.0) or error < last):
                        good = 2
                    # a step after which there is more left to do than was foreseen is none too long
                    if good == 0 and alpha == real(1.0) and now > real(0.0) and lag > real(0.0):
                        good = 2
                    if iterations > _SLOW and good < 2:
                        lag = wp.max(_SLOWER * lag, _LAG)
                    elif lag > _AT_ONCE and error > tolerance:
                        lag = lag / _QUICKER
                    else:
                        lag = real(0.0)
                else:
                    if now > real(0.0):
                        low = alpha
                        at_low = now
                        at_high = real(0.5) * at_high
                    else:
                        if high >= real(0.0):
                            at_low = real(0.5) * at_low
                        high = alpha
                        at_high = now
                    alpha = low + (high - low) * at_low / (at_low - at_high)
                    edge = real(0.05) * (high - low)
                    alpha = wp.min(wp.max(alpha, low + edge), high - edge)
            while steps > 0:
                steps = 0
                last = error
                good = int(0)
                if spent >= most and most > real(0.0) and foretelling == 0:
                    found = CUT
                elif iterations < _MAX_NEWTON and spent < most and lag <= _FIXED:
                    moved = wp.where(foretelling > 0, 1, 0)
                    good, equations = solve_system(w, t, threads, nnode, nin, lag, moved, l, touch, c, s)
                    dear = real(equations) / _DEAR
                    spent += dear * dear
                if foretelling > 0:
                    for j in range(t, wp.where(good == 1, n, 0), threads):
                        s.vector[w, F, j] = s.vector[w, F, j] + s.vector[w, DF, j]
                    sync()
                    pose_by_load(w, t, threads, share, nnode, geoms, x, c, s)
                    fresh = U
                    good = 3
                    foretelling = 0
                if good == 1:
                    own = vec3()
                    for j in range(t, n, threads):
                        f = s.vector[w, F, j]
                        df = s.vector[w, DF, j]
                        du = s.vector[w, DU, j]
                        r = s.vector[w, G, j] - f
                        own += vec3(r * du, df * du, (f + df) * (s.vector[w, U, j] + du))
                    total = block_sum(own)
                    slope = total[0]
                    work = total[1]
                    left = wp.max(wp.abs(slope), work)
                    error = (real(1.0) + lag) * wp.sqrt(left / (wp.abs(total[2]) + real(1e-14)))
                    if not wp.isfinite(error):
                        good = 0
                    elif error < _ROUGH and error * caught < _CAUGHT * TOLERANCE and lag == real(0.0):
                        found = 1
                        good = 0
                    elif error < tolerance and lag == real(0.0):
                        found = 1
                        good = 0
                        for j in range(t, n, threads):
                            s.vector[w, F, j] = s.vector[w, F, j] + s.vector[w, DF, j]
                            s.vector[w, U, j] = s.vector[w, U, j] + s.vector[w, DU, j]
                        sync()
                    elif lag > real(0.0) and slope <= real(0.0):
                        iterations += 1
                        lag = _SLOWER * lag
                        good = 0
                        steps = 1
                    else:
                        iterations += 1
                        searching = 1
                        tried = 0
                        alpha = real(1.0)
                        low = real(0.0)
                        high = real(-1.0)
                        at_low = wp.abs(slope)
                        at_high = real(0.0)
                if good == 0 and steps == 0:
                    ends = 1
                    at = U
            if searching == 1:
                at = TRY
                for j in range(t, n, threads):
                    s.vector[w, TRY, j] = s.vector[w, U, j] + alpha * s.vector[w, DU, j]
        if not wp.isfinite(error):  # no step was made
            error = real(1.0)
        return found, error, iterations, spent

    return newton
