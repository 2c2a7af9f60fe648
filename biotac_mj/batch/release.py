"""Puts skins to rest instead of solving them: those that are no longer touched, and those that cannot move
on. `FemStepper` and `Instance` do the same for one world; formulas in `coupling/implicit/rules.py`."""

import numpy as np
import warp as wp

from ..coupling.implicit.rules import PATIENCE, stayed
from ..coupling.steppers.fem import CLEAR
from ..geometry.rigid_warp import is_finite
from ..skin.block import block_max
from ..skin.contact.broadphase import ALL, contact_range, face_clearance, sample_clearance
from ..skin.contact.faces import Laws
from ..skin.contact.penetration import geoms_core_clearance
from ..skin.contact.posed import Geoms, bound_to, place_on
from ..skin.data import SkinData
from ..skin.geoms import GeomSet
from ..skin.model import SkinModel
from ..skin.newton.worlds import CONVERGED, NOT_FINITE, Worlds
from ..skin.program import Launcher
from ..skin.state import allocate
from ..skin.types import mat66, real, vec3, vec4, vec6

__all__ = ["NEAR", "Clearance", "Release", "constants_of", "count_stays", "find_close", "margin_of"]

wp.set_module_options({"enable_backward": False})

_CLEAR = wp.constant(wp.float64(CLEAR))
_PATIENCE = wp.constant(PATIENCE)
_stayed = wp.func(stayed)
# what is known of a geom near a skin at rest
AFAR, NEAR, TOUCHING = (wp.constant(i) for i in range(3))


@wp.func
def constants_of(st: Worlds, w: int):
    """Constants on which the motion of a skin without contact depends, if they are changed between steps."""
    return vec4(st.mu[w], st.lam[w], st.kappa[w], st.natural[w])


@wp.func
def margin_of(laws: Laws, w: int):
    """Distance of a geom beyond which it cannot reach the skin within a step [m]."""
    margin = _CLEAR
    if laws.reach.shape[0] > 0:
        margin = wp.max(margin, laws.reach[w])
    return margin


@wp.kernel
def keep_constants(st: Worlds, out: wp.array(dtype=vec4)):
    w = wp.tid()
    out[w] = constants_of(st, w)


@wp.func
def find_close(center: vec3, radius: real, w: int, geoms: Geoms, margin: real):
    """Whether all geoms have finite poses, and whether one comes within a margin [m] of a ball."""
    finite = int(1)
    close = int(0)
    for g in range(geoms.count):
        if not is_finite(geoms.pos[g, w], geoms.mat[g, w]):
            finite = 0
        elif bound_to(geoms, g, center, place_on(geoms, g, w, center)) < radius + margin:
            close = 1
    return finite, close


@wp.kernel
def begin_search(
    # In:
    center: vec3,
    radius: real,
    filled: int,
    geoms: Geoms,
    laws: Laws,
    own: wp.array(dtype=vec4),
    st: Worlds,
    # Out:
    near_out: wp.array(dtype=int),
    close_out: wp.array(dtype=int),
    clearance_out: wp.array(dtype=wp.vec2d),
):
    """Finds the worlds that may be put to rest, and those of them with a geom within the ball around their
    skin."""
    w = wp.tid()
    off = constants_of(st, w) - own[w]
    if filled == 0:  # rests where it was made, however stiff it is
        off = vec4(real(0.0), real(0.0), real(0.0), off[3])
    may, close = find_close(center, radius, w, geoms, margin_of(laws, w))
    may = may * st.wanted[w]
    if not wp.length_sq(off) == real(0.0):
        may = 0
    near_out[w] = wp.where(may == 1, AFAR, TOUCHING)
    close_out[w] = may * close
    clearance_out[w] = wp.vec2d(real(wp.inf), real(wp.inf))


@wp.kernel
def measure_clearance(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core_vert: wp.array(dtype=vec3),
    core: Geoms,
    geoms: Geoms,
    laws: Laws,
    x: wp.array2d(dtype=vec3),
    close: wp.array(dtype=int),
    # In and out:
    touched: wp.array(dtype=int),
    # Out:
    clearance_out: wp.array(dtype=wp.vec2d),
):
    """Clearance of the geoms from the skin, beyond the margin a bound of it, and from the core: as
    `ProximityQuery` of one world. One block per world: each time its threads have measured a face each, they
    end if one is touched. They begin with those among which the last touched face was."""
    w, t = wp.tid()
    if close[w] == 0:
        return
    threads = wp.block_dim()
    own = w % x.shape[1]
    margin = margin_of(laws, w)
    reach = contact_range(laws, w)
    parts = (face.shape[0] + threads - 1) / threads
    part = touched[w]
    skin = real(wp.inf)
    seen = int(0)
    while seen < parts:
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
        seen += 1
        if skin < reach:
            seen = parts
        else:
            part = (part + 1) % parts
    inside = real(wp.inf)
    if skin >= reach:
        inside = geoms_core_clearance(w, t, threads, geoms, ALL, core, core_vert)
    if t == 0:
        touched[w] = part
        clearance_out[w] = wp.vec2d(skin, inside)


@wp.kernel
def skip_untouched(
    # In:
    core_depth: real,
    laws: Laws,
    clearance: wp.array(dtype=wp.vec2d),
    undeformed: wp.array(dtype=int),
    # In and out:
    near: wp.array(dtype=int),
    wanted: wp.array(dtype=int),
    # Out:
    gone_out: wp.array(dtype=bool),
):
    """Takes worlds out of the solve whose skin nothing is near to: it comes to rest. One that rests stays so
    while nothing touches it; another may bulge to what is near."""
    w = wp.tid()
    if clearance[w][0] < contact_range(laws, w) or clearance[w][1] < -core_depth:
        near[w] = TOUCHING
    elif clearance[w][0] < margin_of(laws, w):
        near[w] = NEAR
    gone_out[w] = near[w] == AFAR or (near[w] == NEAR and undeformed[w] == 1)
    if gone_out[w]:
        wanted[w] = 0


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
    anew_out: wp.array(dtype=bool),
    reset_out: wp.array(dtype=bool),
    any_out: wp.array(dtype=int),
):
    """After the solve: which skins without a balance come to rest, since nothing touches them there, and
    which begin anew, since they have not moved on for too long."""
    w = wp.tid()
    anew_out[w] = False
    if gone[w]:
        st.wanted[w] = 1
    elif st.wanted[w] == 1 and st.reason[w] != CONVERGED and st.reason[w] != NOT_FINITE:
        if near[w] != TOUCHING:
            gone[w] = True
            st.nonconverged[w] = st.nonconverged[w] - 1
        elif st.load_factor[w] == real(0.0) and stays[w] >= _PATIENCE:
            anew_out[w] = True
    if st.wanted[w] == 1:
        at_rest_out[w] = wp.where(gone[w], 1, 0)
    reset_out[w] = gone[w] or anew_out[w]
    if reset_out[w]:
        any_out[0] = 1


@wp.kernel
def rest_worlds(
    # In:
    gone: wp.array(dtype=bool),
    reset: wp.array(dtype=bool),
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
    if not reset[w]:
        return
    for g in range(geoms.count):
        last = geoms.pos_last[g, w]
        motion_out[g, w] = vec3()
        touched_by_out[g, w] = 0
        if gone[w]:
            if wp.isfinite(last[0] + last[1] + last[2]):
                motion_out[g, w] = geoms.pos[g, w] - last
            geoms.pos_last[g, w] = geoms.pos[g, w]
            geoms.mat_last[g, w] = geoms.mat[g, w]
        else:
            geoms.pos_last[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))
    if gone[w]:
        st.reason[w] = CONVERGED
        st.load_factor[w] = real(1.0)
        st.iterations[w] = 0
        st.error[w] = real(0.0)
        for g in range(wrench_out.shape[0]):
            wrench_out[g, w] = vec6()
            tangent_out[g, w] = mat66()


@wp.kernel
def count_stays(
    awake: wp.array(dtype=int),
    at_rest: wp.array(dtype=int),
    st: Worlds,
    # In and out:
    stays: wp.array(dtype=int),
    # Out:
    undeformed_out: wp.array(dtype=int),
):
    """Ends a step: in how many the skins have stayed where they were; which have their form at rest."""
    w = wp.tid()
    if awake[w] == 1:
        undeformed_out[w] = at_rest[w]
    if st.reason[w] != NOT_FINITE:
        stays[w] = _stayed(stays[w], st.load_factor[w])


class Clearance:
    """Distances of geoms from the skins of a batch.

    Attributes:
      ball: centre and radius [m] of a ball around the skin at rest.
      close: (nworld,) wp.array int, 1 where a geom is so close to the ball that its distance is needed.
      found: (nworld,) wp.array vec2d, clearance from the skin, beyond the margin a bound of it, and from the
        core [m]; infinite where no geom is close. Where the skin is touched it is that of any touch.
    """

    def __init__(self, model: SkinModel, nworld: int):
        self._model, vert = model, model.rest.vert
        center = (vert.min(0) + vert.max(0)) / 2
        # wider than any skin at rest is than another of this model: liquids differ by world
        self.ball = vec3(*center), 1.1 * float(np.linalg.norm(vert - center, axis=1).max())
        with wp.ScopedDevice(model.device):
            self.close = wp.zeros(nworld, dtype=int)
            self.found = wp.zeros(nworld, dtype=wp.vec2d)
            self._touched = wp.zeros(nworld, dtype=int)
            core = [wp.zeros(0, dtype=vec3), Geoms()]
            if model.has_core:
                core = [model.core_vert, model.core(nworld).struct]
        self._skin = [model.outer.face, model.sample, *core]

    def measure(self, geoms: Geoms, laws: Laws, x: wp.array) -> None:
        """Finds the clearance of the close geoms, with nodes at (nvert, nworld or 1). Launches only."""
        known, found = [*self._skin, geoms, laws, x, self.close], [self._touched, self.found]
        Launcher(self._model.device).launch_blocks(measure_clearance, [len(self.close)], known, found)


class Release:
    """Selects the skins of a solve that are reset, but none with inertia or with viscoelastic rubber: their
    state outlasts the contact.

    Attributes:
      possible: whether any can be.
      near: (nworld,) wp.array int, how near geoms are: AFAR, NEAR or TOUCHING.
      stays: (nworld,) wp.array int, steps in a row in which the skin has stayed where it was.
      undeformed: (nworld,) wp.array int, 1 where the skin has its form at rest.
      at_rest: (nworld,) wp.array int, 1 where the solve put it to rest.
      reset, gone: (nworld,) wp.array bool, whose nodes and contacts are to be those of rest after this solve;
        those of them that are in balance so.
      any: (1,) wp.array int, 1 where any is.
      own: (nworld,) wp.array vec4d, `constants_of` the skins as they were made.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        self.possible = not (model.options.dynamics == "implicit" or data.memory) and geoms.count > 0
        self._model, self._data, self._geoms = model, data, geoms
        n = data.nworld
        with wp.ScopedDevice(model.device):
            allocate("release", self, {"world": n})
            self.near, self.undeformed, self.at_rest = (wp.zeros(n, dtype=int) for _ in range(3))
            self.gone, self._anew, self.reset = (wp.zeros(n, dtype=bool) for _ in range(3))
            self.any = wp.zeros(1, dtype=int)
            self.own = wp.zeros(n, dtype=vec4)
        self._clearance = Clearance(model, n)
        self._filled = int(bool(model.options.fill_volume or model.options.rest_pressure or data.rests))
        self._launch(keep_constants, n, [data.worlds], [self.own])

    def begin(self) -> None:
        """Before a solve: takes worlds out of it that nothing is near to. Launches only."""
        if not self.possible:
            return
        m, d, geoms, laws = self._model, self._data, self._geoms.struct, self._data.laws.struct
        near, clearance = self.near, self._clearance
        known = [*clearance.ball, self._filled, geoms, laws, self.own, d.worlds]
        self._launch(begin_search, d.nworld, known, [near, clearance.close, clearance.found])
        clearance.measure(geoms, laws, d.rest_vert)
        found = [m.options.max_core_depth, laws, clearance.found, self.undeformed]
        self._launch(skip_untouched, d.nworld, found, [near, d.worlds.wanted, self.gone])

    def end(self) -> None:
        """After it: finds `reset` and `any`. Launches only."""
        if not self.possible:
            return
        self.any.zero_()
        outputs = [self._data.worlds, self.gone, self.at_rest, self._anew, self.reset, self.any]
        self._launch(give_up, self._data.nworld, [self.near, self.stays], outputs)

    def count(self, awake: wp.array) -> None:
        """Ends a step; awake: (nworld,) 1 where the skin took part in it. Launches only."""
        known, outputs = [awake, self.at_rest, self._data.worlds], [self.stays, self.undeformed]
        self._launch(count_stays, self._data.nworld, known, outputs)

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._model.device)
