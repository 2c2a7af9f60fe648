"""Puts skins to rest instead of solving them: those that are no longer touched, and those that cannot move
on. `FemStepper` and `Instance` do the same for one world; formulas in `coupling/implicit/rules.py`."""

import numpy as np
import warp as wp

from ..coupling.implicit.rules import PATIENCE, stayed
from ..coupling.steppers.fem import CLEAR
from ..skin.contact.faces import Laws
from ..skin.contact.posed import Geoms, bound_to, place_on
from ..skin.contact.shapes import distance_bound
from ..skin.data import SkinData
from ..skin.geoms import GeomSet
from ..skin.model import SkinModel
from ..skin.newton.worlds import CONVERGED, NOT_FINITE, Worlds
from .rigid import is_finite

__all__ = ["Release", "ball_of", "constants_of", "count_stays", "margin_of"]

wp.set_module_options({"enable_backward": False})

real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d
vec6 = wp.spatial_vectord
mat66 = wp.spatial_matrixd
_CLEAR = wp.constant(wp.float64(CLEAR))
_PATIENCE = wp.constant(PATIENCE)
_stayed = wp.func(stayed)
# what is known of a geom near a skin at rest
_AFAR, _NEAR, _TOUCHING = (wp.constant(i) for i in range(3))


@wp.func
def constants_of(st: Worlds, w: int):
    """What moves a skin that nothing touches, where it is changed between steps."""
    return vec4(st.mu[w], st.lam[w], st.kappa[w], st.natural[w])


@wp.func
def margin_of(laws: Laws, w: int):
    """How far geoms stay away that do not reach the skin in a step [m]."""
    margin = _CLEAR
    if laws.reach.shape[0] > 0:
        margin = wp.max(margin, laws.reach[w])
    return margin


@wp.kernel
def keep_constants(st: Worlds, out: wp.array(dtype=vec4)):
    w = wp.tid()
    out[w] = constants_of(st, w)


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
):
    """Which worlds may be put to rest, and which of them have a geom within the ball around their skin."""
    w = wp.tid()
    off = constants_of(st, w) - own[w]
    if filled == 0:  # rests where it was made, however stiff it is
        off = vec4(real(0.0), real(0.0), real(0.0), off[3])
    may = st.wanted[w]
    if not wp.length_sq(off) == real(0.0):
        may = 0
    close = int(0)
    for g in range(geoms.count):
        p = geoms.pos[g, w]
        R = geoms.mat[g, w]
        if not is_finite(p, R):
            may = 0
        else:
            if bound_to(geoms, g, center, place_on(geoms, g, w, center)) < radius + margin_of(laws, w):
                close = 1
    near_out[w] = wp.where(may == 1, _AFAR, _TOUCHING)
    close_out[w] = may * close


@wp.func
def near_face(
    f: int,
    w: int,
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    laws: Laws,
    rest: wp.array2d(dtype=vec3),
):
    """How near geoms are to a face at rest."""
    t = face[f]
    own = w % rest.shape[1]
    x0 = rest[t[0], own]
    x1 = rest[t[1], own]
    x2 = rest[t[2], own]
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(
        wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center)))
    )
    gap = radius + margin_of(laws, w)
    for g in range(geoms.count):
        far = bound_to(geoms, g, center, place_on(geoms, g, w, center))
        if far < radius + margin_of(laws, w):
            for s in range(sample.shape[0]):
                b = sample[s]
                p = b[0] * x0 + b[1] * x1 + b[2] * x2
                gap = wp.min(gap, bound_to(geoms, g, p, place_on(geoms, g, w, p)))
    reach = real(0.0)
    if laws.reach.shape[0] > 0:
        reach = laws.reach[w]
    if gap < reach:
        return _TOUCHING
    if gap < margin_of(laws, w):
        return _NEAR
    return _AFAR


@wp.func
def near_core(i: int, w: int, vert: wp.array(dtype=vec3), depth: real, core: Geoms, geoms: Geoms):
    """Whether geoms are deep in the core, at a vertex of it or, for the first one, between all of them."""
    gap = real(0.0)
    for g in range(geoms.count):
        c = geoms.pos[g, w]
        gap = wp.min(gap, bound_to(geoms, g, vert[i], place_on(geoms, g, w, vert[i])))
        if i == 0:
            if bound_to(geoms, g, c, vec3()) < real(0.0):
                inside = distance_bound(
                    core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], c
                )
                gap = wp.min(gap, inside)
    if gap < -depth:
        return _TOUCHING
    return _AFAR


@wp.kernel
def search(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    core_vert: wp.array(dtype=vec3),
    core_depth: real,
    core: Geoms,
    geoms: Geoms,
    laws: Laws,
    rest: wp.array2d(dtype=vec3),
    close: wp.array(dtype=int),
    # In and out:
    near: wp.array(dtype=int),
):
    """How near geoms are to the skin at rest, or whether they are deep inside its core: `NearSearch.clear` of
    one world. A thread for each face, then for each vertex of the core."""
    f, w = wp.tid()
    if close[w] == 0 or near[w] == _TOUCHING:
        return
    if f < face.shape[0]:
        wp.atomic_max(near, w, near_face(f, w, face, sample, geoms, laws, rest))
    else:
        wp.atomic_max(near, w, near_core(f - face.shape[0], w, core_vert, core_depth, core, geoms))


@wp.kernel
def leave_alone(
    # In:
    near: wp.array(dtype=int),
    # In and out:
    wanted: wp.array(dtype=int),
    # Out:
    gone_out: wp.array(dtype=bool),
):
    """Takes worlds out of the solve whose skin nothing is near to: it comes to rest."""
    w = wp.tid()
    gone_out[w] = near[w] == _AFAR
    if near[w] == _AFAR:
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
        if near[w] != _TOUCHING:
            gone[w] = True
            st.nonconverged[w] = st.nonconverged[w] - 1
        elif st.reached[w] == real(0.0) and stays[w] >= _PATIENCE:
            anew_out[w] = True
    reset_out[w] = gone[w] or anew_out[w]
    if reset_out[w]:
        any_out[0] = 1


@wp.kernel
def rest_worlds(
    # In:
    gone: wp.array(dtype=bool),
    reset: wp.array(dtype=bool),
    rest_pressure: wp.array(dtype=real),
    # Out:
    st: Worlds,
    geoms: Geoms,
    motion_out: wp.array2d(dtype=vec3),
    touched_by_out: wp.array2d(dtype=int),
    pressure_out: wp.array(dtype=real),
    wrench_out: wp.array2d(dtype=vec6),
    tangent_out: wp.array2d(dtype=mat66),
):
    """What a step leaves of skins that come to rest; of one that begins anew, nothing is known of how the
    geoms came to where they are."""
    w = wp.tid()
    if not reset[w]:
        return
    pressure = rest_pressure[w]
    if st.kappa[w] == real(0.0):  # no liquid
        pressure = real(0.0)
    st.last_pressure[w] = pressure
    st.pressure[w] = pressure
    pressure_out[w] = real(0.0)
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
        st.reached[w] = real(1.0)
        st.iterations[w] = 0
        st.error[w] = real(0.0)
        for g in range(wrench_out.shape[0]):
            wrench_out[g, w] = vec6()
            tangent_out[g, w] = mat66()


@wp.kernel
def count_stays(st: Worlds, stays: wp.array(dtype=int)):
    """Ends a step: in how many the skins have stayed where they were."""
    w = wp.tid()
    if st.reason[w] != NOT_FINITE:
        stays[w] = _stayed(stays[w], st.reached[w])


def ball_of(model: SkinModel) -> tuple:
    """Centre and radius [m] of a ball around the skin at rest."""
    vert = model.rest.vert
    center = (vert.min(0) + vert.max(0)) / 2
    # wider than any skin at rest is than another of this model: liquids differ by world
    return vec3(*center), 1.1 * float(np.linalg.norm(vert - center, axis=1).max())


class Release:
    """Which skins of a solve are put to rest. Not those with inertia or with rubber that remembers: they
    have more to lose.

    Attributes:
      possible: whether any can be.
      stays: (nworld,) wp.array int, steps in a row in which the skin has stayed where it was.
      reset, gone: (nworld,) wp.array bool, whose nodes and contacts are to be those of rest after this solve;
        those of them that are in balance so.
      any: (1,) wp.array int, 1 where any is.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        self.possible = not (model.options.dynamics == "implicit" or data.memory) and geoms.count > 0
        self._model, self._data, self._geoms = model, data, geoms
        n = data.nworld
        with wp.ScopedDevice(model.device):
            self.stays, self._near, self._close = (wp.zeros(n, dtype=int) for _ in range(3))
            self.gone, self._anew, self.reset = (wp.zeros(n, dtype=bool) for _ in range(3))
            self.any = wp.zeros(1, dtype=int)
            self._own = wp.zeros(n, dtype=vec4)
            self._none = wp.zeros(0, dtype=vec3)
        self._ball = ball_of(model)
        self._core = model.core(n).struct if model.has_core else Geoms()
        self._filled = int(bool(model.options.fill_volume or model.options.rest_pressure or data.rests))
        self._launch(keep_constants, n, [data.worlds], [self._own])

    def begin(self) -> None:
        """Before a solve: takes worlds out of it that nothing is near to. Launches only."""
        if not self.possible:
            return
        m, d, geoms, laws = self._model, self._data, self._geoms.struct, self._data.laws.struct
        n = d.nworld
        known = [*self._ball, self._filled, geoms, laws, self._own, d.worlds]
        self._launch(begin_search, n, known, [self._near, self._close])
        face, core = m.outer.face, m.core_vert if m.has_core else self._none
        inputs = [face, m.sample, core, m.options.max_core_depth, self._core, geoms, laws, d.rest_vert]
        self._launch(search, (len(face) + len(core), n), [*inputs, self._close], [self._near])
        self._launch(leave_alone, n, [self._near], [d.worlds.wanted, self.gone])

    def end(self) -> None:
        """After it: finds `reset` and `any`. Launches only."""
        if not self.possible:
            return
        self.any.zero_()
        outputs = [self._data.worlds, self.gone, self._anew, self.reset, self.any]
        self._launch(give_up, self._data.nworld, [self._near, self.stays], outputs)

    def count(self) -> None:
        """Ends a step. Launches only."""
        self._launch(count_stays, self._data.nworld, [self._data.worlds], [self.stays])

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._model.device)
