"""Leaves skins at rest alone while nothing reaches them: the plugin's idle skins (`coupled.py`), for all
worlds at once. Where that holds for every world, none of the skin's kernels runs.

A skin rests once it has found itself in balance where it was, untouched. Without inertia and memory the
next step would find the same, to the last bit, unless something touches the skin or changes it."""

import warp as wp

from ..skin.contact.faces import Laws
from ..skin.contact.posed import Geoms, bound_to, place_on
from ..skin.contact.shapes import distance_bound
from ..skin.contact.watch import distance_from_afar
from ..skin.newton.worlds import CONVERGED, Worlds
from .kernels import Model
from .release import ball_of, constants_of, margin_of
from .rigid import is_finite
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
    core: Geoms,
    geoms: Geoms,
    laws: Laws,
    constants: wp.array(dtype=vec4),
    resting: wp.array(dtype=int),
    st: Worlds,
    # Out:
    close_out: wp.array(dtype=int),
):
    """Wakes skins that were changed or have a geom in their core or nowhere; which of the others have a geom
    within the ball around the skin."""
    w = wp.tid()
    wanted = 1 - resting[w]
    if not wp.length_sq(constants[w] - constants_of(st, w)) == real(0.0):
        wanted = 1
    close = int(0)
    margin = margin_of(laws, w)
    for g in range(geoms.count):
        p = geoms.pos[g, w]
        R = geoms.mat[g, w]
        if not is_finite(p, R):
            wanted = 1
        else:
            if bound_to(geoms, g, center, place_on(geoms, g, w, center)) < radius + margin:
                close = 1
            if core.count > 0:
                if distance_bound(
                    core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], p
                ) < real(0.0):
                    wanted = 1
    st.wanted[w] = wanted
    close_out[w] = close


@wp.kernel
def meet(
    # In:
    face: wp.array(dtype=wp.vec3i),
    core_vert: wp.array(dtype=vec3),
    geoms: Geoms,
    laws: Laws,
    x: wp.array2d(dtype=vec3),
    close: wp.array(dtype=int),
    # In and out:
    wanted: wp.array(dtype=int),
):
    """Wakes skins of which a geom comes close to a face, or to a vertex of the core."""
    f, w = wp.tid()
    if close[w] == 0 or wanted[w] == 1:
        return
    if f < face.shape[0]:
        t = face[f]
        if distance_from_afar(x[t[0], w], x[t[1], w], x[t[2], w], w, geoms) < margin_of(laws, w):
            wanted[w] = 1
        return
    p = core_vert[f - face.shape[0]]
    if distance_from_afar(p, p, p, w, geoms) < real(0.0):
        wanted[w] = 1


@wp.kernel
def leave(
    # In:
    geoms: Geoms,
    # In and out:
    motion: wp.array2d(dtype=vec3),
    st: Worlds,
    # Out:
    awake_out: wp.array(dtype=int),
    any_out: wp.array(dtype=int),
    any_of_all_out: wp.array(dtype=int),
):
    """Of skins that are left at rest, what a step writes: where the geoms were last, no iterations."""
    w = wp.tid()
    awake_out[w] = st.wanted[w]
    if st.wanted[w] == 1:
        any_out[0] = 1
        any_of_all_out[0] = 1
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
    awake: wp.array(dtype=int),
    st: Worlds,
    # In and out:
    resting: wp.array(dtype=int),
    # Out:
    constants_out: wp.array(dtype=vec4),
):
    """Which skins were in balance where they were, untouched."""
    w = wp.tid()
    if awake[w] == 0:
        return
    still = settled[w]
    if st.reason[w] != CONVERGED or st.iterations[w] > 0 or st.reached[w] < real(1.0) or rounds[w] != 1:
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
    """

    def __init__(self, skin: BatchSkin):
        self._skin, model = skin, skin.model
        self.possible = not (skin.inertial or skin.data.memory)
        self._ball = ball_of(model)
        n = skin.nworld
        with wp.ScopedDevice(model.device):
            self.awake = wp.ones(n, dtype=int)
            self.any = wp.ones(1, dtype=int)
            self._resting, self._close = (wp.zeros(n, dtype=int) for _ in range(2))
            self._constants = wp.zeros(n, dtype=vec4)
            self._none = wp.zeros(0, dtype=vec3)
        self._core = model.core(n).struct if model.has_core else Geoms()

    def begin_step(self, any_of_all: wp.array) -> None:
        """Finds who takes part in the step, with the geoms where they go without acceleration; writes the
        skins' `wanted`, and sets any_of_all[0] where one does. Launches only."""
        skin, st = self._skin, self._skin.data.worlds
        if not self.possible:
            st.wanted.fill_(1)
            any_of_all.fill_(1)
            return
        model, geoms, laws = skin.model, skin.geoms.struct, skin.data.laws.struct
        self.any.zero_()
        known = [self._constants, self._resting, st]
        self._launch(wake, skin.nworld, [*self._ball, self._core, geoms, laws, *known], [self._close])
        face, core = model.outer.face, model.core_vert if model.has_core else self._none
        near = [face, core, geoms, laws, skin.x, self._close]
        self._launch(meet, (len(face) + len(core), skin.nworld), near, [st.wanted])
        self._launch(leave, skin.nworld, [geoms], [skin.motion, st, self.awake, self.any, any_of_all])

    def end_step(self, model: Model, settled: wp.array, rounds: wp.array) -> None:
        """Finds who rests from now on. Launches only."""
        if self.possible:
            st = self._skin.data.worlds
            inputs = [model, settled, rounds, self.awake, st]
            self._launch(fall_asleep, self._skin.nworld, inputs, [self._resting, self._constants])

    def reset(self, mask: wp.array) -> None:
        """Worlds of mask are solved in their next step."""
        self._launch(reset_rest, self._skin.nworld, [mask], [self._resting])

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._skin.model.device)
