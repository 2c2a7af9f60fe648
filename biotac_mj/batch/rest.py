"""Sleep and wake of skins in all worlds: a skin at rest is not solved until a geom reaches it (the plugin's
idle skins, `coupled.py`). If the skins of every world sleep, none of their kernels runs.

A skin falls asleep after a reset, and once a step without contact has left its equilibrium unchanged. Without
inertia and memory the next step would find the same, unless something touches or changes the skin. A geom
that accelerations could bring to the skin in a step wakes it; if no skin of a world is touched at the
predicted poses of the bodies, nothing is solved in that world."""

import warp as wp

from ..coupling.implicit.marks import MarkedWorlds, Marks, mark
from ..coupling.implicit.rounds import Model
from ..skin.contact.broadphase import contact_range, motion_bound
from ..skin.contact.faces import Laws
from ..skin.contact.posed import Geoms
from ..skin.newton.worlds import CONVERGED, Worlds
from ..skin.types import mat33, mat66, real, vec3, vec4, vec6
from .release import NEAR, Clearance, constants_of, find_close, margin_of
from .skin import BatchSkin

__all__ = ["Rest"]

wp.set_module_options({"enable_backward": False})

# by which distances may change faster than places: grids are trilinear
_ROOT3 = wp.constant(wp.float64(3**0.5))


@wp.struct
class Seen:
    """When clearances of the geoms from a skin at rest were measured last: poses of the geoms [geom, world],
    not finite where they never were, and the clearances [world], of which poses since then give a bound."""

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
def _see(seen: Seen, w: int, geoms: Geoms, clearance: wp.vec2d):
    seen.clearance[w] = clearance
    for g in range(geoms.count):
        seen.pos[g, w] = geoms.pos[g, w]
        seen.mat[g, w] = geoms.mat[g, w]


@wp.func
def _forget(seen: Seen, w: int):
    for g in range(seen.pos.shape[0]):
        seen.pos[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))


@wp.kernel
def wake(
    # In:
    center: vec3,
    radius: real,
    geoms: Geoms,
    laws: Laws,
    constants: wp.array(dtype=vec4),
    resting: wp.array(dtype=int),
    seen: Seen,
    st: Worlds,
    # Out:
    close_out: wp.array(dtype=int),
    clearance_out: wp.array(dtype=wp.vec2d),
):
    """Wakes skins that were changed or have a geom nowhere; of which of the others the clearance is to be
    measured. Not of those with no geom within the ball around the skin or none near since the last time; nor
    where one was near then, and may still be."""
    w = wp.tid()
    margin = margin_of(laws, w)
    finite, close = find_close(center, radius, w, geoms, margin)
    wanted = wp.max(1 - resting[w], 1 - finite)
    if not wp.length_sq(constants[w] - constants_of(st, w)) == real(0.0):
        wanted = 1
    st.wanted[w] = wanted
    close = close * (1 - wanted)
    clearance = wp.vec2d(real(wp.inf), real(wp.inf))
    if close == 1:
        bound = _bound(seen, w, center, radius, geoms)
        if bound[0] >= margin and bound[1] >= real(0.0):
            close = 0
        elif seen.clearance[w][0] < margin and wp.isfinite(bound[0]):
            clearance = bound
            close = 0
    close_out[w] = close
    clearance_out[w] = clearance


@wp.func
def _pass_by(w: int, geoms: Geoms, motion: wp.array2d(dtype=vec3), st: Worlds):
    """Writes the results of a step for a skin that stays at rest: last poses of the geoms, no iterations."""
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
    close: wp.array(dtype=int),
    clearance: wp.array(dtype=wp.vec2d),
    # In and out:
    seen: Seen,
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    # Out:
    awake_out: wp.array(dtype=int),
    near_out: wp.array(dtype=int),
    any_out: wp.array(dtype=int),
    taking_part_out: MarkedWorlds,
):
    """Wakes skins that a geom comes close to, or whose core it is in, and leaves the others."""
    w = wp.tid()
    near_out[w] = 0
    if close[w] == 1:
        _see(seen, w, geoms, clearance[w])
    if clearance[w][0] < margin_of(laws, w) or clearance[w][1] < real(0.0):
        near_out[w] = 1
        st.wanted[w] = 1
    awake_out[w] = st.wanted[w]
    if st.wanted[w] == 1:
        any_out[0] = 1
        mark(taking_part_out, w)
    else:
        _pass_by(w, geoms, motion, st)


@wp.kernel
def look_again(
    # In:
    center: vec3,
    radius: real,
    geoms: Geoms,
    laws: Laws,
    seen: Seen,
    near: wp.array(dtype=int),
    awake: wp.array(dtype=int),
    # Out:
    close_out: wp.array(dtype=int),
    clearance_out: wp.array(dtype=wp.vec2d),
    taking_part_out: MarkedWorlds,
):
    """Tests the skins that are awake only because a geom is near for possible contact; marks the worlds of
    the others that are awake."""
    w = wp.tid()
    close_out[w] = 0
    if awake[w] == 0:
        return
    finite, close = find_close(center, radius, w, geoms, contact_range(laws, w))
    if near[w] == 0 or finite == 0:
        mark(taking_part_out, w)
        return
    bound = _bound(seen, w, center, radius, geoms)
    if bound[0] >= contact_range(laws, w) and bound[1] >= real(0.0):
        close = 0
    close_out[w] = close
    clearance_out[w] = wp.vec2d(real(wp.inf), real(wp.inf))


@wp.kernel
def mark_touched(
    # In:
    geoms: Geoms,
    laws: Laws,
    close: wp.array(dtype=int),
    clearance: wp.array(dtype=wp.vec2d),
    # In and out:
    seen: Seen,
    # Out:
    taking_part_out: MarkedWorlds,
):
    w = wp.tid()
    if close[w] == 0:
        return
    _see(seen, w, geoms, clearance[w])
    if clearance[w][0] < contact_range(laws, w) or clearance[w][1] < real(0.0):
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
def fall_asleep(
    # In:
    model: Model,
    settled: wp.array(dtype=int),
    rounds: wp.array(dtype=int),
    near: wp.array(dtype=int),
    at_rest: wp.array(dtype=int),
    awake: wp.array(dtype=int),
    st: Worlds,
    # In and out:
    resting: wp.array(dtype=int),
    seen: Seen,
    # Out:
    constants_out: wp.array(dtype=vec4),
    touched_by_out: wp.array2d(dtype=int),
    wrench_out: wp.array2d(dtype=vec6),
    tangent_out: wp.array2d(dtype=mat66),
):
    """Puts untouched skins in balance to sleep. A released one with a geom nearby stays awake: when the geom
    leaves, `Release` puts it to rest. Those that rested touch nothing, whatever the solves of other worlds
    wrote."""
    w = wp.tid()
    if awake[w] == 0:
        for g in range(touched_by_out.shape[0]):
            touched_by_out[g, w] = 0
        for g in range(wrench_out.shape[0]):
            wrench_out[g, w] = vec6()
            tangent_out[g, w] = mat66()
        return
    _forget(seen, w)
    still = settled[w]
    if near[w] == NEAR and at_rest[w] == 0:
        still = 0
    if st.reason[w] != CONVERGED or st.iterations[w] > 0 or st.load_factor[w] < real(1.0) or rounds[w] != 1:
        still = 0
    for g in range(model.wrench0.shape[0]):
        if not wp.dot(model.wrench0[g, w], model.wrench0[g, w]) == real(0.0):
            still = 0
    resting[w] = still
    constants_out[w] = constants_of(st, w)


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


class Rest:
    """Sleeping and awake skins of a batch.

    Attributes:
      awake: (nworld,) wp.array int, 1 where the skin takes part in this step.
      any: (1,) wp.array int, 1 where any does.
      lasting: the arrays [world] that outlive a step.
    """

    def __init__(self, skin: BatchSkin):
        self._skin, model = skin, skin.model
        self.possible = not (skin.inertial or skin.data.memory)
        self._clearance = Clearance(model, skin.nworld)
        n = skin.nworld
        with wp.ScopedDevice(model.device):
            self.awake = wp.ones(n, dtype=int)
            self.any = wp.ones(1, dtype=int)
            self._resting, self._near = (wp.zeros(n, dtype=int) for _ in range(2))
            self._constants = wp.zeros(n, dtype=vec4)
            self._seen = seen = Seen()
            seen.pos, seen.mat = (wp.zeros((skin.geoms.count, n), dtype=kind) for kind in (vec3, mat33))
            seen.clearance = wp.zeros(n, dtype=wp.vec2d)
        self.lasting = [self._resting, self._constants, seen.pos, seen.mat, seen.clearance]

    def begin_step(self, taking_part: Marks) -> None:
        """Finds who takes part in the step, with the geoms where they go without acceleration; writes the
        skins' `wanted`, and marks their worlds. Launches only."""
        skin, st = self._skin, self._skin.data.worlds
        if not self.possible:
            st.wanted.fill_(1)
            taking_part.fill()
            return
        geoms, laws, clearance = skin.geoms.struct, skin.data.laws.struct, self._clearance
        self.any.zero_()
        known = [*clearance.ball, geoms, laws, self._constants, self._resting, self._seen, st]
        self._launch(wake, skin.nworld, known, [clearance.close, clearance.found])
        clearance.measure(geoms, laws, skin.x)
        known, written = [geoms, laws, clearance.close, clearance.found], [self._seen, skin.motion, st]
        written += [self.awake, self._near, self.any, taking_part.struct]
        self._launch(leave, skin.nworld, known, written)

    def look_ahead(self, taking_part: Marks) -> None:
        """After `begin_step`, with the geoms where they go under the forces that act without these skins:
        marks worlds in which a skin is touched there, or awake for another reason. Launches only."""
        if not self.possible:
            taking_part.fill()
            return
        skin, clearance = self._skin, self._clearance
        geoms, laws = skin.geoms.struct, skin.data.laws.struct
        known = [*clearance.ball, geoms, laws, self._seen, self._near, self.awake]
        found = [clearance.close, clearance.found]
        self._launch(look_again, skin.nworld, known, [*found, taking_part.struct])
        clearance.measure(geoms, laws, skin.x)
        known, written = [geoms, laws, *found], [self._seen, taking_part.struct]
        self._launch(mark_touched, skin.nworld, known, written)

    def leave(self, taking_part: Marks) -> None:
        """After `look_ahead` of all skins of the worlds: leaves those at rest in worlds that take no part.
        Launches only."""
        skin, st = self._skin, self._skin.data.worlds
        known = [taking_part.world, skin.geoms.struct]
        self._launch(leave_untouched, skin.nworld, known, [self.awake, skin.motion, st])

    def end_step(self, model: Model, settled: wp.array, rounds: wp.array) -> None:
        """Finds who rests from now on. Launches only."""
        if self.possible:
            st = self._skin.data.worlds
            release = self._skin.release
            inputs = [model, settled, rounds, release.near, release.at_rest, self.awake, st]
            outputs = [self._resting, self._seen, self._constants, *self._skin.outcome]
            self._launch(fall_asleep, self._skin.nworld, inputs, outputs)

    def reset(self, mask: wp.array) -> None:
        """Worlds of mask rest."""
        if self.possible:
            known, written = [mask, self._skin.release.own], [self._resting, self._constants, self._seen]
            self._launch(reset_rest, self._skin.nworld, known, written)

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._skin.model.device)
