"""Equilibrium of one skin by the threads of a block: Newton's method on the contact law over the candidates.

If Newton's method cycles, because of friction or snap-through, artificial viscosity is added: each iteration
is then an implicit time step of rubber whose viscosity is proportional to its elasticity. Near equilibrium
the viscosity falls to zero, so that results contain none."""

import functools

import warp as wp

from ..block import block_max, block_rank, block_sum, sync
from ..contact.posed import Geoms
from ..contact.touch import contact_kernels
from ..types import real, vec3
from .bodies import pose_by_load, touching_group
from .broadphase import ROOT3
from .states import BALANCED, Increment, Linear, Newton, Predictor
from .structs import BACK, DF, DU, TRY, Constants, F, G, Scratch, U
from .system import multiply, solve_system

TOLERANCE = wp.constant(real(1e-4))  # of the residual: the error of single steps would cause chatter
# at an edge of a mesh the law's force jumps, and what balances it may lie in between: so much may be left
# where a search along a step has caught the jump so closely, as a fraction of the tolerance. Viscosity makes
# a step shorter by what makes its error larger, and the piece of it that encloses the jump stays as it is
_ROUGH, _CAUGHT = (wp.constant(real(x)) for x in (0.05, 0.1))
CUT = wp.constant(2)
_MAX_NEWTON, _SLOW, _LENGTHS = (wp.constant(i) for i in (200, 8, 10))
_VISCOSITY, _QUICKER, _SLOWER = (wp.constant(real(x)) for x in (1.0, 3.0, 4.0))
_DEAR = wp.constant(real(80.0))  # equations that cost as much as an evaluation; twice as many, four
_AT_ONCE, _FIXED = (wp.constant(real(x)) for x in (0.01, 1e5))


@wp.func
def _swap_poses(w: int, t: int, geoms: Geoms, s: Scratch):
    """Swaps the poses of the geoms with those of the last equilibrium."""
    sync()
    for g in range(t, geoms.count, wp.block_dim()):
        pos = geoms.pos[g, w]
        mat = geoms.mat[g, w]
        geoms.pos[g, w] = s.held_pos[g, w]
        geoms.mat[g, w] = s.held_mat[g, w]
        s.held_pos[g, w] = pos
        s.held_mat[g, w] = mat
    sync()


@wp.func
def _find_motion(w: int, t: int, nnode: int, nin: int, geoms: Geoms, c: Constants, s: Scratch):
    """Replaces displacements vector[TRY] by the motion from vector[U], for touching nodes relative to the
    geoms, which have moved since the last equilibrium."""
    nsample = c.sample.shape[0]
    for k in range(t, nnode, wp.block_dim()):
        i = c.node[s.node[w, k]]
        u = vec3(s.vector[w, U, 3 * k], s.vector[w, U, 3 * k + 1], s.vector[w, U, 3 * k + 2])
        p = c.rest[i, 0] + u
        g = int(-1)
        for m in range(c.start[i], c.start[i + 1]):
            f = c.slot[m] / 3
            if s.touch.touching[f, w] == 1:
                for n in range(nsample):
                    g = wp.max(g, s.touch.trial_geom[f * nsample + n, w])
        if g >= 0:
            turn = geoms.mat[g, w] * wp.transpose(s.held_mat[g, w])
            u += geoms.pos[g, w] + turn * (p - s.held_pos[g, w]) - p
        for a in range(3):
            s.vector[w, TRY, 3 * k + a] = s.vector[w, TRY, 3 * k + a] - u[a]
    for j in range(3 * nnode + t, 3 * nnode + nin, wp.block_dim()):
        s.vector[w, TRY, j] = s.vector[w, TRY, j] - s.vector[w, U, j]
    sync()


@wp.func
def newton_from(predictor: int, before: Linear, l: Linear, most: real, tolerance: real):
    """Newton's method for balanced forces vector[F] from those there, displacements vector[U], and the
    contact there with a symmetric tangent. Where it may cost nothing it finds the contact of the forces as
    they are.

    With a `Predictor`, vector[F] is an equilibrium of the skin as it was `before` with the geoms at
    `held_pos`, and Newton's first step starts there; vector[U] is where its contact has been evaluated."""
    d = Newton()
    d.predictor = predictor
    d.before = before
    d.linear = l
    d.most = most
    d.tolerance = tolerance
    d.fresh = wp.where(predictor == Predictor.EVALUATED, TRY, U)
    d.at = U
    d.alpha = real(1.0)
    d.error = real(wp.inf)
    d.last = d.error
    d.high = real(-1.0)
    d.caught = real(1.0)
    return d


@wp.func
def _search_length(w: int, t: int, n: int, d: Newton, s: Scratch):
    """Line search after an evaluation of contact at the end of a step: accepts the step, or chooses another
    length. Returns whether it was accepted."""
    d.tried += 1
    mine = real(0.0)
    for j in range(t, n, wp.block_dim()):
        f = s.vector[w, F, j] + d.alpha * s.vector[w, DF, j]
        mine += (s.vector[w, G, j] - f) * s.vector[w, DU, j]
    now = wp.sign(d.slope) * block_sum(mine) - d.alpha * d.viscosity * d.work
    good = wp.where(wp.abs(now) <= real(0.5) * wp.abs(d.slope), 1, 0)
    if good == 1 or (now > real(0.0) and d.high < real(0.0)) or d.tried >= _LENGTHS:
        d.searching = 0
        d.caught = real(1.0)
        if good == 0 and d.high >= real(0.0):
            d.caught = d.high - d.low
        for j in range(t, n, wp.block_dim()):
            s.vector[w, F, j] = s.vector[w, F, j] + d.alpha * s.vector[w, DF, j]
            s.vector[w, U, j] = s.vector[w, TRY, j]
        sync()
        if good == 1 and d.alpha == real(1.0) and (d.viscosity > real(0.0) or d.error < d.last):
            good = 2
        # a step after which there is more left to do than was foreseen is none too long
        if good == 0 and d.alpha == real(1.0) and now > real(0.0) and d.viscosity > real(0.0):
            good = 2
        if d.iterations > _SLOW and good < 2:
            d.viscosity = wp.max(_SLOWER * d.viscosity, _VISCOSITY)
        elif d.viscosity > _AT_ONCE and d.error > d.tolerance:
            d.viscosity = d.viscosity / _QUICKER
        else:
            d.viscosity = real(0.0)
    else:
        if now > real(0.0):
            d.low = d.alpha
            d.at_low = now
            d.at_high = real(0.5) * d.at_high
        else:
            if d.high >= real(0.0):
                d.at_low = real(0.5) * d.at_low
            d.high = d.alpha
            d.at_high = now
        d.alpha = d.low + (d.high - d.low) * d.at_low / (d.at_low - d.at_high)
        edge = real(0.05) * (d.high - d.low)
        d.alpha = wp.min(wp.max(d.alpha, d.low + edge), d.high - edge)
    return d


@wp.func
def _take_step(w: int, t: int, d: Newton, o: Increment, geoms: Geoms, c: Constants, s: Scratch):
    """After an evaluation of contact, tests a step, computes the next one, or ends."""
    n = 3 * o.nnode + o.nin
    if d.predictor == Predictor.EVALUATED:
        multiply(w, t, o.nnode, n, F, d.fresh, 1, d.linear, c, s)
        d.fresh = -1
        _find_motion(w, t, o.nnode, o.nin, geoms, c, s)
    elif d.searching == 1:
        d = _search_length(w, t, n, d, s)
    steps = 1 - d.searching  # whether a step is to be found
    while steps > 0:
        steps = 0
        d.last = d.error
        good = int(0)
        if d.spent >= d.most and d.most > real(0.0) and d.predictor == Predictor.NONE:
            d.found = CUT
        elif d.iterations < _MAX_NEWTON and d.spent < d.most and d.viscosity <= _FIXED:
            moved = wp.where(d.predictor != Predictor.NONE, 1, 0)
            good, equations = solve_system(w, t, o.nnode, o.nin, d.viscosity, moved, d.linear, c, s)
            dear = real(equations) / _DEAR
            d.spent += dear * dear
        if d.predictor != Predictor.NONE:
            for j in range(t, wp.where(good == 1, n, 0), wp.block_dim()):
                s.vector[w, F, j] = s.vector[w, F, j] + s.vector[w, DF, j]
            sync()
            pose_by_load(w, t, s.solve.stepping[w].to, o.nnode, geoms, c, s)
            d.fresh = U
            good = 3
            d.predictor = int(Predictor.NONE)
        if good == 1:
            own = vec3()
            for j in range(t, n, wp.block_dim()):
                f = s.vector[w, F, j]
                df = s.vector[w, DF, j]
                du = s.vector[w, DU, j]
                r = s.vector[w, G, j] - f
                own += vec3(r * du, df * du, (f + df) * (s.vector[w, U, j] + du))
            total = block_sum(own)
            d.slope = total[0]
            d.work = total[1]
            left = wp.max(wp.abs(d.slope), d.work)
            d.error = (real(1.0) + d.viscosity) * wp.sqrt(left / (wp.abs(total[2]) + real(1e-14)))
            if not wp.isfinite(d.error):
                good = 0
            elif d.error < _ROUGH and d.error * d.caught < _CAUGHT * TOLERANCE:
                d.found = 1
                good = 0
            elif d.error < d.tolerance and d.viscosity == real(0.0):
                d.found = 1
                good = 0
                for j in range(t, n, wp.block_dim()):
                    s.vector[w, F, j] = s.vector[w, F, j] + s.vector[w, DF, j]
                    s.vector[w, U, j] = s.vector[w, U, j] + s.vector[w, DU, j]
                sync()
            elif d.viscosity > real(0.0) and d.slope <= real(0.0):
                d.iterations += 1
                d.viscosity = _SLOWER * d.viscosity
                good = 0
                steps = 1
            else:
                d.iterations += 1
                d.searching = 1
                d.tried = 0
                d.alpha = real(1.0)
                d.low = real(0.0)
                d.high = real(-1.0)
                d.at_low = wp.abs(d.slope)
                d.at_high = real(0.0)
        if good == 0 and steps == 0:
            d.ends = 1
            d.at = U
    if d.searching == 1:
        d.at = TRY
        for j in range(t, n, wp.block_dim()):
            s.vector[w, TRY, j] = s.vector[w, U, j] + d.alpha * s.vector[w, DU, j]
    return d


@functools.cache
def newton_method(shapes: str) -> wp.Function:
    """The phase NEWTON. shapes: see `contact.touch`."""
    touch_faces = contact_kernels(False, False, shapes).touch_faces

    @wp.func
    def evaluate_contact(w: int, t: int, d: Newton, o: Increment, geoms: Geoms, c: Constants, s: Scratch):
        """Finds the displacements that the forces bring about, where they are not known, and there the forces
        vector[G] of the contact law, and flags of the candidates that touch: in the end with a symmetric
        tangent, and for a pending predictor with the geoms at `held_pos`. Unless geoms have moved,
        faces are left out that nothing can have reached."""
        nnode = o.nnode
        anew = wp.where(d.fresh >= 0, 1, 0)
        if anew == 1:
            skin = d.linear
            if d.predictor == Predictor.PENDING:
                skin = d.before
            multiply(w, t, nnode, 3 * nnode + o.nin, F, d.fresh, 1, skin, c, s)
        if d.predictor == Predictor.PENDING:
            _swap_poses(w, t, geoms, s)
        sync()
        most = real(0.0)
        for k in range(t, nnode, wp.block_dim()):
            i = c.node[s.node[w, k]]
            u = vec3(s.vector[w, d.at, 3 * k], s.vector[w, d.at, 3 * k + 1], s.vector[w, d.at, 3 * k + 2])
            most = wp.max(most, wp.length_sq(c.rest[i, 0] + u - s.x[i, w]))
            s.x[i, w] = c.rest[i, 0] + u
        d.travel = wp.where(anew == 1, real(0.0), d.travel + ROOT3 * wp.sqrt(block_max(most)))
        count = int(0)
        for begin in range(0, o.nface, wp.block_dim()):
            f = int(0)
            left = int(0)
            if begin + t < o.nface:
                f = s.face[w, begin + t]
                left = wp.where(anew == 1 or s.free[w, f] <= d.travel, 1, 0)
            rank = block_rank(left)
            if left == 1:
                s.look[w, count + rank[0]] = f
            count += rank[1]
        sync()
        several = s.bodies.compliance.shape[0] > 1
        touch_faces(
            w, t, wp.block_dim(), count, s.look, s.close_to, geoms, s.x, s.touch, 1 - d.ends, d.travel, s.free
        )
        sync()
        for k in range(t, nnode, wp.block_dim()):
            i = c.node[s.node[w, k]]
            total = vec3()
            on = int(0)
            for m in range(c.start[i], c.start[i + 1]):
                f = c.slot[m] / 3
                if s.touch.touching[f, w] == 1:
                    total += s.touch.corner[c.slot[m], w]
                    if on == 0 and several:
                        s.group[w, k] = touching_group(f, w, geoms, s.touch, c.sample.shape[0], s.group[w, k])
                    on = 1
            s.on[w, k] = on
            for a in range(3):
                s.vector[w, G, 3 * k + a] = total[a]
        nsample = c.sample.shape[0]
        for k in range(t, o.ncore * nsample, wp.block_dim()):
            place = k / nsample
            face = c.inner_face[s.core_face[w, place]]
            moved = vec3()
            for a in range(3):
                q = c.inner_number[face[a]]
                if q >= 0:
                    j = 3 * nnode + s.core_place[w, q]
                    moved[a] = s.vector[w, d.at, j] - s.vector[w, BACK, j]
            n = k % nsample
            s.now[w, place, n] = s.gap[w, place, n] + wp.dot(c.sample[n], moved)
        sync()
        for k in range(t, o.nin, wp.block_dim()):
            push = real(0.0)
            stiff = real(0.0)
            v = c.inner[s.core_node[w, k]]
            for m in range(c.inner_start[v], c.inner_start[v + 1]):
                f = c.inner_slot[m] / 3
                place = s.near_core[w, f] - 1
                if place >= 0:
                    weight = s.touch.stiffness[w] * c.inner_area[f] / real(nsample)
                    for n in range(nsample):
                        gap = s.now[w, place, n]
                        if gap < real(0.0):
                            b = c.sample[n][c.inner_slot[m] % 3]
                            push -= weight * gap * b
                            stiff += weight * b
            s.vector[w, G, 3 * nnode + k] = push
            s.stiff[w, k] = stiff
            s.on[w, nnode + k] = wp.where(stiff > real(0.0), 1, 0)
        sync()
        d.fresh = -1
        d.spent += real(1.0)
        if d.predictor == Predictor.PENDING:
            _swap_poses(w, t, geoms, s)
            d.predictor = int(Predictor.EVALUATED)
            d.fresh = TRY
        return d

    @wp.func
    def balance(w: int, t: int, geoms: Geoms, c: Constants, s: Scratch):
        """Newton's method from `newton_from` to its end."""
        d = s.solve.newton[w]
        o = s.solve.increment[w]
        evaluated = wp.where(d.predictor == Predictor.EVALUATED, 1, 0)
        going = int(1)
        while going == 1:
            sync()
            if evaluated == 1:
                d = _take_step(w, t, d, o, geoms, c, s)
            sync()
            going = 1 - d.ends
            d = evaluate_contact(w, t, d, o, geoms, c, s)
            evaluated = 1
        if t == 0:
            s.solve.newton[w] = d
            s.solve.phase[w] = BALANCED

    return balance
