"""Skins that rest in all worlds: those at rest sleep until a geom reaches them, and those that are let go, or
cannot move on, come to rest instead of being solved. If the skins of every world sleep, none of their kernels
runs. `FemStepper` and `Instance` do the same for one world; formulas in `coupling/implicit/rules.py`.

A skin falls asleep after a reset, and once a step without contact has left its equilibrium unchanged. Without
inertia and memory the next step would find the same, unless something touches or changes the skin. A geom
that accelerations could bring to the skin in a step wakes it; if no skin of a world is touched at the
predicted poses of the bodies, nothing is solved in that world."""

import typing

import numpy as np
import warp as wp

from ..coupling.implicit.marks import MarkedWorlds, Marks, mark
from ..coupling.implicit.rounds import Model
from ..coupling.implicit.rules import PATIENCE, stayed
from ..coupling.steppers.fem import CLEAR
from ..geometry.rigid_warp import is_finite
from ..skin.block import block_max
from ..skin.contact.broadphase import ALL, contact_range, face_clearance, motion_bound, sample_clearance
from ..skin.contact.faces import Laws
from ..skin.contact.penetration import geoms_core_clearance
from ..skin.contact.posed import Geoms, bound_to, place_on
from ..skin.model import SkinModel
from ..skin.newton.worlds import CONVERGED, NOT_FINITE, Worlds
from ..skin.program import Launcher
from ..skin.state import allocate
from ..skin.types import mat33, mat66, real, vec3, vec4, vec6

wp.set_module_options({"enable_backward": False})

_CLEAR = wp.constant(wp.float64(CLEAR))
_PATIENCE = wp.constant(PATIENCE)
_stayed = wp.func(stayed)
# by which distances may change faster than places: grids are trilinear
_ROOT3 = wp.constant(wp.float64(3**0.5))
# what is known of a geom near a skin whose solve begins
AFAR, NEAR, TOUCHING = (wp.constant(i) for i in range(3))


@wp.struct
class Seen:
    """When clearances of the geoms from a skin at rest were measured last: poses of the geoms [geom, world],
    not finite where they never were, and the clearances [world], of which poses since then give a bound; of
    length zero where none are kept."""

    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    clearance: wp.array(dtype=wp.vec2d)


@wp.func
def _bound(seen: Seen, w: int, center: vec3, radius: real, geoms: Geoms):
    """Clearances from the skin and from the core are no less than this [m]; nan: it is not known."""
    most = real(0.0)
    for g in range(geoms.count):
        pos = geoms.pos[g, w]
        moved = motion_bound(seen.pos[g, w], seen.mat[g, w], pos, geoms.mat[g, w], center, radius)
        if not moved <= most:
            most = moved
        most = wp.max(most, wp.length(pos - seen.pos[g, w]))  # its centre, which may be far from the skin
    return seen.clearance[w] - _ROOT3 * most * wp.vec2d(real(1.0), real(1.0))


@wp.func
def _forget(seen: Seen, w: int):
    for g in range(seen.pos.shape[0]):
        seen.pos[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))


@wp.func
def _constants(st: Worlds, w: int):
    """Constants on which the motion of a skin without contact depends, if they are changed between steps."""
    return vec4(st.mu[w], st.lam[w], st.kappa[w], st.natural[w])


@wp.func
def _margin(laws: Laws, w: int):
    """Distance of a geom beyond which it cannot reach the skin within a step [m]."""
    margin = _CLEAR
    if laws.reach.shape[0] > 0:
        margin = wp.max(margin, laws.reach[w])
    return margin


@wp.kernel
def find_clearance(
    # In:
    center: vec3,
    radius: real,
    touch: int,
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core_vert: wp.array(dtype=vec3),
    core: Geoms,
    geoms: Geoms,
    laws: Laws,
    on: wp.array(dtype=int),
    x: wp.array2d(dtype=vec3),
    # In and out:
    touched: wp.array(dtype=int),
    seen: Seen,
    # Out:
    known_out: wp.array(dtype=int),
    clearance_out: wp.array(dtype=wp.vec2d),
):
    """Clearance of the geoms from the skin, beyond the margin a bound of it, and from the core: as
    `ProximityQuery` of one world, in the worlds that are on. It is measured where a geom comes near the ball
    around the skin, and may be near the skin after its motion since the last time. In others with finite
    poses it is infinite or, where a geom was near and may still be, a bound.

    One block per world: each time its threads have measured a face each, they end if one is touched. They
    begin with those among which the last touched face was.

    Args:
      touch: 1 where only contact matters, not what is near.
    """
    w, t = wp.tid()
    known = on[w]
    close = int(0)
    clearance = wp.vec2d(real(wp.inf), real(wp.inf))
    margin = _margin(laws, w)
    reach = contact_range(laws, w)
    for g in range(geoms.count):
        if not is_finite(geoms.pos[g, w], geoms.mat[g, w]):
            known = 0
        elif bound_to(geoms, g, center, place_on(geoms, g, w, center)) < radius + margin:
            close = 1
    close *= known
    if close == 1 and seen.clearance.shape[0] > 0:
        bound = _bound(seen, w, center, radius, geoms)
        if bound[0] >= wp.where(touch == 1, reach, margin) and bound[1] >= real(0.0):
            close = 0
        elif touch == 0 and seen.clearance[w][0] < margin and wp.isfinite(bound[0]):
            clearance = bound
            close = 0
    if t == 0:
        known_out[w] = known
        clearance_out[w] = clearance
    if close == 0:
        return
    threads = wp.block_dim()
    own = w % x.shape[1]
    parts = (face.shape[0] + threads - 1) / threads
    part = touched[w]
    skin = real(wp.inf)
    done = int(0)
    while done < parts:
        f = part * threads + t
        if f < face.shape[0]:
            i = face[f]
            least = sample_clearance(
                x[i[0], own], x[i[1], own], x[i[2], own], sample, w, geoms, ALL, margin, reach
            )
            if least >= margin:
                ball, _beyond, _count, _within = face_clearance(
                    x[i[0], own], x[i[1], own], x[i[2], own], w, geoms, ALL, margin
                )
                least = wp.max(least, ball)
            skin = wp.min(skin, least)
        skin = -block_max(-skin)
        done += 1
        if skin < reach:
            done = parts
        else:
            part = (part + 1) % parts
    inside = real(wp.inf)
    if skin >= reach:
        inside = geoms_core_clearance(w, t, threads, geoms, ALL, core, core_vert)
    if t == 0:
        touched[w] = part
        clearance_out[w] = wp.vec2d(skin, inside)
        if seen.clearance.shape[0] > 0:
            seen.clearance[w] = clearance_out[w]
            for g in range(geoms.count):
                seen.pos[g, w] = geoms.pos[g, w]
                seen.mat[g, w] = geoms.mat[g, w]


@wp.func
def _pass_by(w: int, geoms: Geoms, motion: wp.array2d(dtype=vec3), st: Worlds):
    """Writes the results of a step for a skin that is at rest: last poses of the geoms, no iterations."""
    st.iterations[w] = 0
    for g in range(geoms.count):
        last = geoms.pos_last[g, w]
        motion[g, w] = vec3()
        if wp.isfinite(last[0] + last[1] + last[2]):
            motion[g, w] = geoms.pos[g, w] - last
        geoms.pos_last[g, w] = geoms.pos[g, w]
        geoms.mat_last[g, w] = geoms.mat[g, w]


@wp.kernel
def leave(
    # In:
    geoms: Geoms,
    laws: Laws,
    constants: wp.array(dtype=vec4),
    known: wp.array(dtype=int),
    clearance: wp.array(dtype=wp.vec2d),
    # In and out:
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    # Out:
    awake_out: wp.array(dtype=int),
    near_out: wp.array(dtype=int),
    any_out: wp.array(dtype=int),
    taking_part_out: MarkedWorlds,
):
    """Wakes skins that were changed, or that a geom comes close to, whose core it is in, or that is nowhere;
    leaves the others."""
    w = wp.tid()
    awake = 1 - known[w]
    near = int(0)
    if not wp.length_sq(constants[w] - _constants(st, w)) == real(0.0):
        awake = 1
    elif clearance[w][0] < _margin(laws, w) or clearance[w][1] < real(0.0):
        near = 1
        awake = 1
    near_out[w] = near
    awake_out[w] = awake
    st.wanted[w] = awake
    if awake == 1:
        any_out[0] = 1
        mark(taking_part_out, w)
    else:
        _pass_by(w, geoms, motion, st)


@wp.kernel
def mark_touched(
    # In:
    laws: Laws,
    awake: wp.array(dtype=int),
    known: wp.array(dtype=int),
    clearance: wp.array(dtype=wp.vec2d),
    # Out:
    taking_part_out: MarkedWorlds,
):
    """Marks worlds whose skin is awake, but not those where that is only for a geom near it, which does not
    touch."""
    w = wp.tid()
    touched = clearance[w][0] < contact_range(laws, w) or clearance[w][1] < real(0.0)
    if awake[w] == 1 and (known[w] == 0 or touched):
        mark(taking_part_out, w)


@wp.kernel
def leave_untouched(
    # In:
    taking_part: wp.array(dtype=int),
    geoms: Geoms,
    # In and out:
    awake: wp.array(dtype=int),
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
):
    """Leaves the skins of worlds that take no part."""
    w = wp.tid()
    if awake[w] == 1 and taking_part[w] == 0:
        awake[w] = 0
        st.wanted[w] = 0
        _pass_by(w, geoms, motion, st)


@wp.kernel
def skip_untouched(
    # In:
    core_depth: real,
    filled: int,
    laws: Laws,
    own: wp.array(dtype=vec4),
    known: wp.array(dtype=int),
    clearance: wp.array(dtype=wp.vec2d),
    undeformed: wp.array(dtype=int),
    # In and out:
    st: Worlds,
    # Out:
    near_out: wp.array(dtype=int),
    gone_out: wp.array(dtype=bool),
):
    """Takes worlds out of the solve whose skin nothing is near to: it comes to rest. One that rests stays so
    while nothing touches it; another may bulge to what is near."""
    w = wp.tid()
    off = _constants(st, w) - own[w]
    if filled == 0:  # rests where it was made, however stiff it is
        off = vec4(real(0.0), real(0.0), real(0.0), off[3])
    near = int(AFAR)
    if known[w] == 0 or not wp.length_sq(off) == real(0.0):
        near = TOUCHING
    elif clearance[w][0] < contact_range(laws, w) or clearance[w][1] < -core_depth:
        near = TOUCHING
    elif clearance[w][0] < _margin(laws, w):
        near = NEAR
    near_out[w] = near
    gone_out[w] = near == AFAR or (near == NEAR and undeformed[w] == 1)
    if gone_out[w]:
        st.wanted[w] = 0


@wp.kernel
def give_up(
    # In:
    near: wp.array(dtype=int),
    stays: wp.array(dtype=int),
    # In and out:
    st: Worlds,
    gone: wp.array(dtype=bool),
    # Out:
    at_rest_out: wp.array(dtype=int),
    resets_out: wp.array(dtype=bool),
    any_out: wp.array(dtype=int),
):
    """After the solve: which skins without equilibrium come to rest, since nothing touches them there, and
    which begin anew, since they have not moved on for too long."""
    w = wp.tid()
    anew = bool(False)
    if gone[w]:
        st.wanted[w] = 1
    elif st.wanted[w] == 1 and st.reason[w] != CONVERGED and st.reason[w] != NOT_FINITE:
        if near[w] != TOUCHING:
            gone[w] = True
            st.nonconverged[w] = st.nonconverged[w] - 1
        elif st.load_factor[w] == real(0.0) and stays[w] >= _PATIENCE:
            anew = True
    if st.wanted[w] == 1:
        at_rest_out[w] = wp.where(gone[w], 1, 0)
    resets_out[w] = gone[w] or anew
    if resets_out[w]:
        any_out[0] = 1


@wp.func
def _push_nothing(
    w: int,
    touched_by: wp.array2d(dtype=int),
    wrench: wp.array2d(dtype=vec6),
    tangent: wp.array2d(dtype=mat66),
):
    for g in range(touched_by.shape[0]):
        touched_by[g, w] = 0
    for g in range(wrench.shape[0]):
        wrench[g, w] = vec6()
        tangent[g, w] = mat66()


@wp.kernel
def rest_worlds(
    # In:
    gone: wp.array(dtype=bool),
    resets: wp.array(dtype=bool),
    # Out:
    st: Worlds,
    geoms: Geoms,
    motion_out: wp.array2d(dtype=vec3),
    touched_by_out: wp.array2d(dtype=int),
    wrench_out: wp.array2d(dtype=vec6),
    tangent_out: wp.array2d(dtype=mat66),
):
    """Writes the results of a step for skins that come to rest, besides `StateArrays.reset_skin`. After a
    reset, the earlier motion of the geoms is unknown."""
    w = wp.tid()
    if gone[w]:
        _pass_by(w, geoms, motion_out, st)
        _push_nothing(w, touched_by_out, wrench_out, tangent_out)
        st.reason[w] = CONVERGED
        st.load_factor[w] = real(1.0)
        st.error[w] = real(0.0)
    elif resets[w]:
        for g in range(geoms.count):
            motion_out[g, w] = vec3()
            touched_by_out[g, w] = 0
            geoms.pos_last[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))


@wp.kernel
def end_step(
    # In:
    sleeps: int,
    model: Model,
    settled: wp.array(dtype=int),
    rounds: wp.array(dtype=int),
    near: wp.array(dtype=int),
    at_rest: wp.array(dtype=int),
    awake: wp.array(dtype=int),
    st: Worlds,
    # In and out:
    failed: wp.array(dtype=int),
    began: wp.array(dtype=int),
    stays: wp.array(dtype=int),
    # Out:
    undeformed_out: wp.array(dtype=int),
    resting_out: wp.array(dtype=int),
    constants_out: wp.array(dtype=vec4),
    seen: Seen,
    touched_by_out: wp.array2d(dtype=int),
    wrench_out: wp.array2d(dtype=vec6),
    tangent_out: wp.array2d(dtype=mat66),
):
    """Counts the steps that reached no equilibrium, of skin or of skin and bodies, and consecutive ones in
    which the skin did not move; puts untouched skins in equilibrium to sleep. A released one with a geom
    nearby stays awake: when the geom leaves, it comes to rest. Those that slept touch nothing, whatever the
    solves of other worlds wrote."""
    w = wp.tid()
    if st.reason[w] != NOT_FINITE:
        began[w] = 1
        stays[w] = _stayed(stays[w], st.load_factor[w])
        if st.reason[w] != CONVERGED or settled[w] == 0:
            failed[w] += 1
    if awake[w] == 0:
        _push_nothing(w, touched_by_out, wrench_out, tangent_out)
        return
    undeformed_out[w] = at_rest[w]
    _forget(seen, w)
    still = sleeps * settled[w]
    if near[w] == NEAR and at_rest[w] == 0:
        still = 0
    if st.reason[w] != CONVERGED or st.iterations[w] > 0 or st.load_factor[w] < real(1.0) or rounds[w] != 1:
        still = 0
    for g in range(model.wrench0.shape[0]):
        if not wp.dot(model.wrench0[g, w], model.wrench0[g, w]) == real(0.0):
            still = 0
    resting_out[w] = still
    constants_out[w] = _constants(st, w)


@wp.kernel
def reset_rest(
    # In:
    mask: wp.array(dtype=bool),
    own: wp.array(dtype=vec4),
    # Out:
    resting_out: wp.array(dtype=int),
    constants_out: wp.array(dtype=vec4),
    seen: Seen,
):
    """Worlds of the mask rest as they were made."""
    w = wp.tid()
    if mask[w]:
        resting_out[w] = 1
        constants_out[w] = own[w]
        _forget(seen, w)


class Clearance:
    """Distances of geoms from the skins of a batch.

    Args:
      seen: `Seen`, what is kept for bounds, of skins that do not change; None: all is measured.

    Attributes:
      ball: centre and radius [m] of a ball around the skin at rest.
      known: (nworld,) wp.array int, 1 where the last `find` ran, and all geoms have finite poses.
      found: (nworld,) wp.array vec2d, clearance from the skin, beyond the margin a bound of it, and from the
        core [m]; infinite where no geom is close. Where the skin is touched it is that of any touch.
    """

    def __init__(self, model: SkinModel, nworld: int, seen: typing.Any = None):
        self._device, vert = model.device, model.rest.vert
        center = (vert.min(0) + vert.max(0)) / 2
        # wider than any skin at rest is than another of this model: liquids differ by world
        self.ball = vec3(*center), 1.1 * float(np.linalg.norm(vert - center, axis=1).max())
        with wp.ScopedDevice(model.device):
            self._seen = make_seen(0, 0) if seen is None else seen
            self.known, self._touched = (wp.zeros(nworld, dtype=int) for _ in range(2))
            self.found = wp.zeros(nworld, dtype=wp.vec2d)
            core = [wp.zeros(0, dtype=vec3), Geoms()]
            if model.has_core:
                core = [model.core_vert, model.core(nworld).struct]
        self._skin = [model.outer.face, model.sample, *core]

    def find(self, on: wp.array, geoms: Geoms, laws: Laws, x: wp.array, touch: int = 0) -> None:
        """Finds the clearance in worlds that are on (nworld,), of skins with nodes at (nvert, nworld or 1).
        Launches only. touch: see `find_clearance`."""
        known = [*self.ball, touch, *self._skin, geoms, laws, on, x]
        found = [self._touched, self._seen, self.known, self.found]
        Launcher(self._device).launch_blocks(find_clearance, [len(on)], known, found)


def make_seen(ngeom: int, nworld: int) -> Seen:
    """Nothing seen, on Warp's default device."""
    seen = Seen()
    seen.pos, seen.mat = (wp.zeros((ngeom, nworld), dtype=kind) for kind in (vec3, mat33))
    seen.clearance = wp.zeros(nworld, dtype=wp.vec2d)
    return seen


class Rest:
    """Which skins of a batch sleep, and which come to rest; none with inertia or with viscoelastic rubber,
    whose state outlasts the contact.

    Args:
      skin: the BatchSkin, whose data, geoms and motion are there.

    Attributes:
      possible: whether any can come to rest. sleeps: whether any can sleep.
      awake: (nworld,) wp.array int, 1 where the skin takes part in this step.
      any: (1,) wp.array int, 1 where any does.
      gone: (nworld,) wp.array bool, which skins come to rest by this solve; resets: those, and those that
        begin anew.
      stays: (nworld,) wp.array int, steps in a row in which the skin has stayed where it was.
      clearance: `Clearance` from the skins at rest.
      lasting: the arrays [world] that outlive a step, besides those that are declared in `skin.state`.
    """

    def __init__(self, skin: typing.Any):
        self._skin, model, data, n = skin, skin.model, skin.data, skin.nworld
        self.possible = self.sleeps = not (skin.inertial or data.memory)
        with wp.ScopedDevice(model.device):
            allocate("rest", self, {"world": n})
            self.awake, self.any = wp.ones(n, dtype=int), wp.ones(1, dtype=int)
            self.gone, self.resets = (wp.zeros(n, dtype=bool) for _ in range(2))
            self._resting, self._woken = (wp.zeros(n, dtype=int) for _ in range(2))
            self._near, self._undeformed, self._at_rest = (wp.zeros(n, dtype=int) for _ in range(3))
            self._any_reset = wp.zeros(1, dtype=int)
            st = data.worlds
            made = np.stack([a.numpy() for a in (st.mu, st.lam, st.kappa, st.natural)], axis=1)
            self._own, self._constants = (wp.array(made, dtype=vec4) for _ in range(2))
            self._seen = seen = make_seen(skin.geoms.count, n)
        self._from_asleep, self.clearance = Clearance(model, n, seen), Clearance(model, n)
        self._filled = int(bool(model.options.fill_volume or model.options.rest_pressure or data.rests))
        self.lasting = [self._resting, self._constants, seen.pos, seen.mat, seen.clearance, self._undeformed]

    # --- a step ---

    def begin_step(self, taking_part: Marks) -> None:
        """Finds the skins that take part in the step, from the geoms' poses at its end without acceleration;
        writes the skins' `wanted`, and marks their worlds. Launches only."""
        skin, st = self._skin, self._skin.data.worlds
        if not self.sleeps:
            st.wanted.fill_(1)
            taking_part.fill()
            return
        geoms, laws, at = skin.geoms.struct, skin.data.laws.struct, self._from_asleep
        self.any.zero_()
        at.find(self._resting, geoms, laws, skin.x)
        known, written = [geoms, laws, self._constants, at.known, at.found], [skin.motion, st]
        self._launch(leave, known, [*written, self.awake, self._woken, self.any, taking_part.struct])

    def look_ahead(self, taking_part: Marks) -> None:
        """After `begin_step`, with the geoms where they go under the forces that act without these skins:
        marks worlds in which a skin is touched there, or awake for another reason. Launches only."""
        if not self.sleeps:
            taking_part.fill()
            return
        skin, at = self._skin, self._from_asleep
        laws = skin.data.laws.struct
        at.find(self._woken, skin.geoms.struct, laws, skin.x, touch=1)
        self._launch(mark_touched, [laws, self.awake, at.known, at.found], [taking_part.struct])

    def leave(self, taking_part: Marks) -> None:
        """After `look_ahead` of all skins of the worlds: leaves those at rest in worlds that take no part.
        Launches only."""
        skin = self._skin
        known = [taking_part.world, skin.geoms.struct]
        self._launch(leave_untouched, known, [self.awake, skin.motion, skin.data.worlds])

    def end_step(
        self, model: Model, settled: wp.array, rounds: wp.array, failed: wp.array, began: wp.array
    ) -> None:
        """Finds the skins that sleep from now on; counts steps that `failed`, and writes which skins `began`,
        (nworld,) each. Launches only."""
        st, sleeps = self._skin.data.worlds, int(self.sleeps)
        known = [sleeps, model, settled, rounds, self._near, self._at_rest, self.awake, st, failed, began]
        written = [self.stays, self._undeformed, self._resting, self._constants, self._seen]
        self._launch(end_step, known, [*written, *self._skin.outcome])

    def reset(self, mask: wp.array) -> None:
        """Worlds of mask rest. Launches only."""
        if self.sleeps:
            self._launch(reset_rest, [mask, self._own], [self._resting, self._constants, self._seen])

    # --- a solve ---

    def begin_solve(self) -> None:
        """Before a solve: takes worlds out of it that nothing is near to. Launches only."""
        if not self.possible:
            return
        d, laws, at = self._skin.data, self._skin.data.laws.struct, self.clearance
        at.find(d.worlds.wanted, self._skin.geoms.struct, laws, d.rest_vert)
        known = [self._skin.model.options.max_core_depth, self._filled, laws, self._own, at.known, at.found]
        self._launch(skip_untouched, [*known, self._undeformed], [d.worlds, self._near, self.gone])

    def end_solve(self) -> None:
        """After it: finds `gone` and `resets`. Launches only."""
        if self.possible:
            self._any_reset.zero_()
            known = [self._near, self.stays, self._skin.data.worlds, self.gone]
            self._launch(give_up, known, [self._at_rest, self.resets, self._any_reset])

    def come_to_rest(self) -> None:
        """Then: resets those skins. Launches only."""
        if self.possible:
            wp.capture_if(self._any_reset, self._put_to_rest)

    def _put_to_rest(self):
        skin = self._skin
        skin.state.reset_skin(self.resets)
        written = [skin.data.worlds, skin.geoms.struct, skin.motion, *skin.outcome]
        self._launch(rest_worlds, [self.gone, self.resets], written)

    def _launch(self, kernel, inputs, outputs):
        wp.launch(kernel, self._skin.nworld, inputs, outputs, device=self._skin.model.device)
