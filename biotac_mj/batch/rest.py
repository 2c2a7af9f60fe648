"""Leaves skins at rest alone while nothing reaches them: the plugin's idle skins (`coupled.py`), for all
worlds at once. Where that holds for every world, none of the skin's kernels runs.

A skin rests once it has found itself in balance where it was, untouched. Without inertia and memory the
next step would find the same, to the last bit, unless something touches the skin or changes it."""

import warp as wp

from ..skin.contact.faces import Laws
from ..skin.contact.posed import Geoms
from ..skin.newton.worlds import CONVERGED, Worlds
from .kernels import Model
from .marks import MarkedWorlds, Marks, mark
from .release import NEAR, Clearance, constants_of, find_close, margin_of
from .skin import BatchSkin

__all__ = ["Rest"]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d


@wp.kernel
def wake(
    # In:
    center: vec3,
    radius: real,
    geoms: Geoms,
    laws: Laws,
    constants: wp.array(dtype=vec4),
    resting: wp.array(dtype=int),
    st: Worlds,
    # Out:
    close_out: wp.array(dtype=int),
    clearance_out: wp.array(dtype=wp.vec2d),
):
    """Wakes skins that were changed or have a geom nowhere; which of the others have a geom within the ball
    around the skin."""
    w = wp.tid()
    finite, close = find_close(center, radius, w, geoms, margin_of(laws, w))
    wanted = wp.max(1 - resting[w], 1 - finite)
    if not wp.length_sq(constants[w] - constants_of(st, w)) == real(0.0):
        wanted = 1
    st.wanted[w] = wanted
    close_out[w] = close * (1 - wanted)
    clearance_out[w] = wp.vec2d(real(wp.inf), real(wp.inf))


@wp.kernel
def leave(
    # In:
    geoms: Geoms,
    laws: Laws,
    clearance: wp.array(dtype=wp.vec2d),
    # In and out:
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    # Out:
    awake_out: wp.array(dtype=int),
    any_out: wp.array(dtype=int),
    taking_part_out: MarkedWorlds,
):
    """Wakes skins that a geom comes close to, or whose core it is in. Of those that are left at rest, what a
    step writes: where the geoms were last, no iterations."""
    w = wp.tid()
    if clearance[w][0] < margin_of(laws, w) or clearance[w][1] < real(0.0):
        st.wanted[w] = 1
    awake_out[w] = st.wanted[w]
    if st.wanted[w] == 1:
        any_out[0] = 1
        mark(taking_part_out, w)
        return
    st.iterations[w] = 0
    for g in range(geoms.count):
        last = geoms.pos_last[g, w]
        motion[g, w] = vec3()
        if wp.isfinite(last[0] + last[1] + last[2]):
            motion[g, w] = geoms.pos[g, w] - last
        geoms.pos_last[g, w] = geoms.pos[g, w]
        geoms.mat_last[g, w] = geoms.mat[g, w]


@wp.kernel
def fall_asleep(
    # In:
    model: Model,
    settled: wp.array(dtype=int),
    rounds: wp.array(dtype=int),
    near: wp.array(dtype=int),
    awake: wp.array(dtype=int),
    st: Worlds,
    # In and out:
    resting: wp.array(dtype=int),
    # Out:
    constants_out: wp.array(dtype=vec4),
):
    """Which skins were in balance where they were, untouched. One that a geom is near to stays awake: when
    the geom leaves, `Release` puts it to rest."""
    w = wp.tid()
    if awake[w] == 0:
        return
    still = settled[w]
    if near[w] == NEAR:
        still = 0
    if st.reason[w] != CONVERGED or st.iterations[w] > 0 or st.load_factor[w] < real(1.0) or rounds[w] != 1:
        still = 0
    for g in range(model.wrench0.shape[0]):
        if not wp.dot(model.wrench0[g, w], model.wrench0[g, w]) == real(0.0):
            still = 0
    resting[w] = still
    constants_out[w] = constants_of(st, w)


@wp.kernel
def reset_rest(mask: wp.array(dtype=bool), resting_out: wp.array(dtype=int)):
    w = wp.tid()
    if mask[w]:
        resting_out[w] = 0


class Rest:
    """Which skins of a batch rest.

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
            self._resting = wp.zeros(n, dtype=int)
            self._constants = wp.zeros(n, dtype=vec4)
        self.lasting = [self._resting, self._constants]

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
        known = [*clearance.ball, geoms, laws, self._constants, self._resting, st]
        self._launch(wake, skin.nworld, known, [clearance.close, clearance.found])
        clearance.measure(geoms, laws, skin.x)
        known, written = [geoms, laws, clearance.found], [self.awake, self.any, taking_part.struct]
        self._launch(leave, skin.nworld, known, [skin.motion, st, *written])

    def end_step(self, model: Model, settled: wp.array, rounds: wp.array) -> None:
        """Finds who rests from now on. Launches only."""
        if self.possible:
            st = self._skin.data.worlds
            inputs = [model, settled, rounds, self._skin.release.near, self.awake, st]
            self._launch(fall_asleep, self._skin.nworld, inputs, [self._resting, self._constants])

    def reset(self, mask: wp.array) -> None:
        """Worlds of mask are solved in their next step."""
        self._launch(reset_rest, self._skin.nworld, [mask], [self._resting])

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._skin.model.device)
