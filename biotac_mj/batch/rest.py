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

from ..coupling.implicit.rounds import MarkedWorlds, Marks, Model, mark
from ..coupling.implicit.rules import PATIENCE
from ..kernels import add_zeros, kernel_module
from ..skin.contact.broadphase import contact_range
from ..skin.contact.clearance import TOUCH, Clearance, Seen, forget, make_seen, margin_of
from ..skin.contact.faces import Laws
from ..skin.contact.posed import Geoms
from ..skin.newton.worlds import CONVERGED, NOT_FINITE, Worlds
from ..skin.state import allocate
from ..skin.types import mat66, real, vec3, vec4, vec6

kernel_module(__name__)

_PATIENCE = wp.constant(PATIENCE)
# what is known of a geom near a skin whose solve begins
AFAR, NEAR, TOUCHING = (wp.constant(i) for i in range(3))


@wp.struct
class Sleep:
    """What is known of the sleep of every skin (nworld,). Flags are 0 or 1."""

    awake: wp.array(dtype=int)  # takes part in this step
    woken: wp.array(dtype=int)  # in this step, by a geom that comes near
    near: wp.array(dtype=int)  # AFAR, NEAR or TOUCHING
    at_rest: wp.array(dtype=int)  # came to rest by the last solve
    undeformed: wp.array(dtype=int)  # rests, since a reset or by the last step
    resting: wp.array(dtype=int)  # sleeps
    unsettled: wp.array(dtype=int)  # steps in a row that did not settle
    own: wp.array(dtype=vec4)  # constants as it was made, and as it fell asleep
    constants: wp.array(dtype=vec4)
    seen: Seen


@wp.func
def _constants(st: Worlds, w: int):
    """Constants on which the motion of a skin without contact depends, if they are changed between steps."""
    return vec4(st.mu[w], st.lam[w], st.kappa[w], st.natural[w])


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
    known: wp.array(dtype=int),
    clearance: wp.array(dtype=wp.vec2d),
    # In and out:
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    s: Sleep,
    # Out:
    any_out: wp.array(dtype=int),
    taking_part_out: MarkedWorlds,
):
    """Wakes skins that were changed, or that a geom comes close to, whose core it is in, or that is nowhere;
    leaves the others."""
    w = wp.tid()
    awake = 1 - known[w]
    near = int(0)
    if not wp.length_sq(s.constants[w] - _constants(st, w)) == real(0.0):
        awake = 1
    elif clearance[w][0] < margin_of(laws, w) or clearance[w][1] < real(0.0):
        near = 1
        awake = 1
    s.woken[w] = near
    s.awake[w] = awake
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
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    s: Sleep,
):
    """Leaves the skins of worlds that take no part."""
    w = wp.tid()
    if s.awake[w] == 1 and taking_part[w] == 0:
        s.awake[w] = 0
        st.wanted[w] = 0
        _pass_by(w, geoms, motion, st)


@wp.kernel
def skip_untouched(
    # In:
    core_depth: real,
    filled: int,
    laws: Laws,
    known: wp.array(dtype=int),
    clearance: wp.array(dtype=wp.vec2d),
    # In and out:
    st: Worlds,
    s: Sleep,
    # Out:
    gone_out: wp.array(dtype=bool),
    met_out: wp.array(dtype=int),
):
    """Takes worlds out of the solve whose skin nothing is near to: it comes to rest. One that rests stays so
    while nothing touches it; another may bulge to what is near. met: those that rested and are touched."""
    w = wp.tid()
    off = _constants(st, w) - s.own[w]
    if filled == 0:  # rests where it was made, however stiff it is
        off = vec4(real(0.0), real(0.0), real(0.0), off[3])
    near = int(AFAR)
    if known[w] == 0 or not wp.length_sq(off) == real(0.0):
        near = TOUCHING
    elif clearance[w][0] < contact_range(laws, w) or clearance[w][1] < -core_depth:
        near = TOUCHING
    elif clearance[w][0] < margin_of(laws, w):
        near = NEAR
    s.near[w] = near
    gone_out[w] = near == AFAR or (near == NEAR and s.undeformed[w] == 1)
    met_out[w] = wp.where(near == TOUCHING, st.wanted[w] * s.undeformed[w], 0)
    if gone_out[w]:
        st.wanted[w] = 0


@wp.kernel
def give_up(
    # In and out:
    st: Worlds,
    s: Sleep,
    gone: wp.array(dtype=bool),
    # Out:
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
        if s.near[w] != TOUCHING:
            gone[w] = True
            st.nonconverged[w] = st.nonconverged[w] - 1
        elif st.load_factor[w] == real(0.0) and s.unsettled[w] >= _PATIENCE:
            anew = True
    if st.wanted[w] == 1:
        s.at_rest[w] = wp.where(gone[w], 1, 0)
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
    st: Worlds,
    # In and out:
    s: Sleep,
    failed: wp.array(dtype=int),
    began: wp.array(dtype=int),
    # Out:
    touched_by_out: wp.array2d(dtype=int),
    wrench_out: wp.array2d(dtype=vec6),
    tangent_out: wp.array2d(dtype=mat66),
):
    """Counts the steps that reached no equilibrium, of skin or of skin and bodies, and those in a
    row; puts untouched skins in equilibrium to sleep. A released one with a geom
    nearby stays awake: when the geom leaves, it comes to rest. Those that slept touch nothing, whatever the
    solves of other worlds wrote."""
    w = wp.tid()
    if st.reason[w] != NOT_FINITE:
        began[w] = 1
        if st.reason[w] == CONVERGED and settled[w] == 1:
            s.unsettled[w] = 0
        else:
            s.unsettled[w] += 1
            failed[w] += 1
    if s.awake[w] == 0:
        _push_nothing(w, touched_by_out, wrench_out, tangent_out)
        return
    s.undeformed[w] = s.at_rest[w]
    forget(s.seen, w)
    still = sleeps * settled[w]
    if s.near[w] == NEAR and s.at_rest[w] == 0:
        still = 0
    if st.reason[w] != CONVERGED or st.iterations[w] > 0 or st.load_factor[w] < real(1.0) or rounds[w] != 1:
        still = 0
    for g in range(model.wrench0.shape[0]):
        if not wp.dot(model.wrench0[g, w], model.wrench0[g, w]) == real(0.0):
            still = 0
    s.resting[w] = still
    s.constants[w] = _constants(st, w)


@wp.kernel
def reset_rest(mask: wp.array(dtype=bool), s: Sleep):
    """Worlds of the mask rest as they were made."""
    w = wp.tid()
    if mask[w]:
        s.resting[w] = 1
        s.constants[w] = s.own[w]
        forget(s.seen, w)


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
      unsettled: (nworld,) wp.array int, steps in a row that did not settle.
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
            self._any_reset, self._met = wp.zeros(1, dtype=int), wp.zeros(n, dtype=int)
            self._sleep, st = Sleep(), data.worlds
            s = self._sleep
            add_zeros(s, "woken near at_rest resting", n)
            s.awake, s.unsettled, s.undeformed = self.awake, self.unsettled, self.undeformed
            s.seen = make_seen(skin.geoms.count, n)
            made = np.stack([a.numpy() for a in (st.mu, st.lam, st.kappa, st.natural)], axis=1)
            s.own, s.constants = (wp.array(made, dtype=vec4) for _ in range(2))
        many = skin.geoms.count, n
        self._from_asleep, self.clearance = Clearance(model, *many, s.seen), Clearance(model, *many)
        self._filled = int(bool(model.options.fill_volume or model.options.rest_pressure or data.rests))
        seen = [s.seen.pos, s.seen.mat, s.seen.clearance]
        self.lasting = [s.resting, s.constants, *seen]

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
        at.find(self._sleep.resting, geoms, laws, skin.x)
        written = [skin.motion, st, self._sleep, self.any, taking_part.struct]
        self._launch(leave, [geoms, laws, at.known, at.found], written)

    def look_ahead(self, taking_part: Marks) -> None:
        """After `begin_step`, with the geoms where they go under the forces that act without these skins:
        marks worlds in which a skin is touched there, or awake for another reason. Launches only."""
        if not self.sleeps:
            taking_part.fill()
            return
        skin, at = self._skin, self._from_asleep
        laws = skin.data.laws.struct
        at.find(self._sleep.woken, skin.geoms.struct, laws, skin.x, TOUCH)
        self._launch(mark_touched, [laws, self.awake, at.known, at.found], [taking_part.struct])

    def leave(self, taking_part: Marks) -> None:
        """After `look_ahead` of all skins of the worlds: leaves those at rest in worlds that take no part.
        Launches only."""
        skin = self._skin
        known = [taking_part.world, skin.geoms.struct]
        self._launch(leave_untouched, known, [skin.motion, skin.data.worlds, self._sleep])

    def end_step(
        self, model: Model, settled: wp.array, rounds: wp.array, failed: wp.array, began: wp.array
    ) -> None:
        """Finds the skins that sleep from now on; counts steps that `failed`, and writes which skins `began`,
        (nworld,) each. Launches only."""
        known = [int(self.sleeps), model, settled, rounds, self._skin.data.worlds]
        self._launch(end_step, known, [self._sleep, failed, began, *self._skin.outcome])

    def reset(self, mask: wp.array) -> None:
        """Worlds of mask rest. Launches only."""
        if self.sleeps:
            self._launch(reset_rest, [mask], [self._sleep])

    # --- a solve ---

    def begin_solve(self) -> None:
        """Before a solve, with geoms where they go without the skin: takes worlds out of it that nothing is
        near to; in others a skin at rest is first touched where it is met. Launches only."""
        if not self.possible:
            return
        d, laws, at = self._skin.data, self._skin.data.laws.struct, self.clearance
        at.find(d.worlds.wanted, self._skin.geoms.struct, laws, d.rest_vert)
        known = [self._skin.model.options.max_core_depth, self._filled, laws, at.known, at.found]
        self._launch(skip_untouched, known, [d.worlds, self._sleep, self.gone, self._met])
        at.begin_where_met(self._met, self._skin.geoms.struct, laws, d.rest_vert)

    def end_solve(self) -> None:
        """After it: finds `gone` and `resets`. Launches only."""
        if self.possible:
            self._any_reset.zero_()
            changed = [self._skin.data.worlds, self._sleep, self.gone]
            self._launch(give_up, [], [*changed, self.resets, self._any_reset])

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
