"""Clearances of geoms from undeformed skins: measured where a geom is near, elsewhere bounded by earlier
ones."""

import typing

import numpy as np
import warp as wp

from ...geometry.rigid_warp import is_finite, motion, rotation
from ...kernels import add_zeros, kernel_module
from ..block import block_max, sync
from ..program import Launcher
from ..types import mat33, real, vec3
from .broadphase import ALL, contact_range, face_ball, face_clearance, motion_bound, sample_clearance
from .faces import Laws
from .penetration import geoms_core_clearance
from .posed import WINDOW, Geoms, bound_to, place_on

if typing.TYPE_CHECKING:
    from ..model import SkinModel

kernel_module(__name__)

# geoms further than this from the resting skin do not reach it by this step's acceleration: 250 m/s^2 at 2 ms
# [m]
CLEAR = 1e-3
_CLEAR = wp.constant(real(CLEAR))
# what is to be found: a clearance that is less than the margin may be a bound; only whether there is contact;
# every clearance within the margin
BOUND, TOUCH, EXACT = (wp.constant(i) for i in range(3))
# [m] longest way to the skin over which friction sees the whole motion; accuracy of where it is met; from the
# BioTac's frame to its skin
_SHORT, _NARROW, _REACH = (wp.constant(real(x)) for x in (5e-4, 1e-5, 0.02))
_MOST = wp.constant(64)  # measures of a way
# by which distances may change faster than places: grids are trilinear
_ROOT3 = wp.constant(wp.float64(3**0.5))
_SPREAD = wp.constant(real(1.0 + WINDOW))  # radii of a face by which it is nearer than its centre at most


@wp.struct
class Surfaces:
    """Surfaces of a skin that geoms may reach, and a ball around it at rest."""

    center: vec3
    radius: real
    face: wp.array(dtype=wp.vec3i)
    sample: wp.array(dtype=vec3)
    core_vert: wp.array(dtype=vec3)
    core: Geoms


@wp.struct
class Seen:
    """When clearances of the geoms from a skin at rest were measured last: poses of the geoms [geom, world],
    not finite where they never were, and the clearances [world], of which poses since then give a bound; of
    length zero where none are kept."""

    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    clearance: wp.array(dtype=wp.vec2d)


@wp.func
def _bound(seen: Seen, w: int, skin: Surfaces, geoms: Geoms):
    """Clearances from the skin and from the core are no less than this [m]; nan: it is not known."""
    most = real(0.0)
    for g in range(geoms.count):
        pos = geoms.pos[g, w]
        moved = motion_bound(seen.pos[g, w], seen.mat[g, w], pos, geoms.mat[g, w], skin.center, skin.radius)
        if not moved <= most:
            most = moved
        most = wp.max(most, wp.length(pos - seen.pos[g, w]))  # its centre, which may be far from the skin
    return seen.clearance[w] - _ROOT3 * most * wp.vec2d(real(1.0), real(1.0))


@wp.func
def forget(seen: Seen, w: int):
    """Forgets what was seen: the next clearance is measured."""
    for g in range(seen.pos.shape[0]):
        seen.pos[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))


@wp.func
def margin_of(laws: Laws, w: int):
    """Distance of a geom beyond which it cannot reach the skin within a step [m]."""
    margin = _CLEAR
    if laws.reach.shape[0] > 0:
        margin = wp.max(margin, laws.reach[w])
    return margin


@wp.func
def _nearest(
    w: int, t: int, skin: Surfaces, geoms: Geoms, x: wp.array2d(dtype=vec3), first: int, reach: real
):
    """Distance of the nearest geom from the skin [m], and the part of the faces where it is; that of any
    touch if one is nearer than reach. The threads of a block measure a face each, part by part from the first
    one on, which should be the nearest: the balls of other faces are then mostly further away."""
    own = w % x.shape[1]
    parts = (skin.face.shape[0] + wp.block_dim() - 1) / wp.block_dim()
    part = first
    closest = first
    nearest = real(wp.inf)
    p = vec3()
    around = real(-wp.inf)  # least distance of a geom from p, which bounds that of the faces next to it
    done = int(0)
    while done < parts:
        f = part * wp.block_dim() + t
        least = nearest
        if f < skin.face.shape[0]:
            i = skin.face[f]
            x0 = x[i[0], own]
            x1 = x[i[1], own]
            x2 = x[i[2], own]
            center, radius = face_ball(x0, x1, x2)
            if around - _ROOT3 * wp.length(center - p) - _SPREAD * radius < nearest:
                ball, _beyond, _count, _within = face_clearance(x0, x1, x2, w, geoms, ALL, real(0.0))
                p = center
                around = ball + radius
                if ball < nearest:
                    least = sample_clearance(x0, x1, x2, skin.sample, w, geoms, ALL, nearest, reach)
                    least = wp.max(ball, least)
        least = -block_max(-least)
        if least < nearest:
            nearest = least
            closest = part
        part = (part + 1) % parts
        done = wp.where(nearest < reach, parts, done + 1)
    return nearest, closest


@wp.kernel
def find_clearance(
    # In:
    skin: Surfaces,
    wanted: int,
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
    """Clearance of the geoms from the skin, beyond the margin a bound of it, and from the core, in the worlds
    that are on. It is measured where a geom comes near the ball around the skin, and may be near the skin
    after its motion since the last time. In others with finite poses it is infinite or, where a geom was near
    and may still be, a bound.

    Args:
      wanted: BOUND, TOUCH or EXACT. touched: where `_nearest` begins.
    """
    w, t = wp.tid()
    known = on[w]
    close = int(0)
    clearance = wp.vec2d(real(wp.inf), real(wp.inf))
    margin = margin_of(laws, w)
    reach = contact_range(laws, w)
    for g in range(geoms.count):
        if not is_finite(geoms.pos[g, w], geoms.mat[g, w]):
            known = 0
        elif bound_to(geoms, g, skin.center, place_on(geoms, g, w, skin.center)) < skin.radius + margin:
            close = 1
    close *= known
    if close == 1 and seen.clearance.shape[0] > 0:
        bound = _bound(seen, w, skin, geoms)
        if bound[0] >= wp.where(wanted == TOUCH, reach, margin) and bound[1] >= real(0.0):
            close = 0
        elif wanted == BOUND and seen.clearance[w][0] < margin and wp.isfinite(bound[0]):
            clearance = bound
            close = 0
    if t == 0:
        known_out[w] = known
        clearance_out[w] = clearance
    if close == 0:
        return
    nearest, part = _nearest(w, t, skin, geoms, x, touched[w], reach)
    inside = real(wp.inf)
    if nearest >= reach:
        inside = geoms_core_clearance(w, t, wp.block_dim(), geoms, ALL, skin.core, skin.core_vert)
    if t == 0:
        touched[w] = part
        clearance_out[w] = wp.vec2d(nearest, inside)
        if seen.clearance.shape[0] > 0:
            seen.clearance[w] = clearance_out[w]
            for g in range(geoms.count):
                seen.pos[g, w] = geoms.pos[g, w]
                seen.mat[g, w] = geoms.mat[g, w]


@wp.kernel
def begin_where_met(
    # In:
    skin: Surfaces,
    laws: Laws,
    on: wp.array(dtype=int),
    x: wp.array2d(dtype=vec3),
    # In and out:
    touched: wp.array(dtype=int),
    geoms: Geoms,
    to_pos: wp.array2d(dtype=vec3),
    to_mat: wp.array2d(dtype=mat33),
):
    """Lets geoms that come to a resting skin on a long way begin their step where they meet it, to within 10
    um: what they did before is none of its friction's. In the worlds that are on, of geoms with known poses.
    to_pos, to_mat: scratch [geom, world]."""
    w, t = wp.tid()
    far = real(0.0)
    for g in range(geoms.count):
        turn = geoms.mat[g, w] * wp.transpose(geoms.mat_last[g, w])
        shift = wp.length(geoms.pos[g, w] - turn * geoms.pos_last[g, w])
        turn = turn - wp.identity(n=3, dtype=real)
        moved = shift + _REACH * wp.sqrt(wp.ddot(turn, turn))
        if not moved <= far:
            far = moved
    if on[w] == 0 or far < _SHORT or not wp.isfinite(far):
        return
    reach = contact_range(laws, w)
    for g in range(t, geoms.count, wp.block_dim()):
        to_pos[g, w] = geoms.pos[g, w]
        to_mat[g, w] = geoms.mat[g, w]
    part = touched[w]
    at = real(0.0)
    clear = real(0.0)
    goes = int(_MOST)
    while goes > 0:
        _pose_between(w, t, at, geoms, to_pos, to_mat)
        nearest, part = _nearest(w, t, skin, geoms, x, part, reach)
        goes -= 1
        if nearest >= reach:
            clear = at
        if nearest < reach + _NARROW or at == real(1.0):
            goes = 0
        at = wp.min(real(1.0), at + (nearest - reach) / (_ROOT3 * far))
    _pose_between(w, t, clear, geoms, to_pos, to_mat)
    for g in range(t, geoms.count, wp.block_dim()):
        geoms.pos_last[g, w] = geoms.pos[g, w]
        geoms.mat_last[g, w] = geoms.mat[g, w]
        geoms.pos[g, w] = to_pos[g, w]
        geoms.mat[g, w] = to_mat[g, w]


@wp.func
def _pose_between(
    w: int, t: int, at: real, geoms: Geoms, to_pos: wp.array2d(dtype=vec3), to_mat: wp.array2d(dtype=mat33)
):
    """Poses the geoms on their way from where they were last: on a straight line, along the shortest arc."""
    sync()
    for g in range(t, geoms.count, wp.block_dim()):
        R = geoms.mat_last[g, w]
        m = motion(vec3(), to_mat[g, w], vec3(), R)
        geoms.pos[g, w] = (real(1.0) - at) * geoms.pos_last[g, w] + at * to_pos[g, w]
        geoms.mat[g, w] = rotation(at * vec3(m[3], m[4], m[5])) * R
    sync()


def make_seen(ngeom: int, nworld: int) -> Seen:
    """Nothing seen, on Warp's default device."""
    seen = Seen()
    add_zeros(seen, "pos mat", ngeom, nworld)
    add_zeros(seen, "clearance", nworld)
    return seen


class Clearance:
    """Distances of geoms from skins.

    Args:
      seen: `Seen`, what is kept for bounds, of skins that do not change; None: all is measured.

    Attributes:
      skin: `Surfaces` of one at rest.
      known: (nworld,) wp.array int, 1 where the last `find` ran, and all geoms have finite poses.
      found: (nworld,) wp.array vec2d, clearance from the skin, beyond the margin a bound of it, and from the
        core [m]; infinite where no geom is close. Where the skin is touched it is that of any touch.
    """

    def __init__(self, model: "SkinModel", ngeom: int, nworld: int, seen: object = None):
        self._device, vert = model.device, model.rest.vert
        center = (vert.min(0) + vert.max(0)) / 2
        # wider than any skin at rest is than another of this model: liquids differ by world
        self.skin, radius = Surfaces(), 1.1 * float(np.linalg.norm(vert - center, axis=1).max())
        self.skin.center, self.skin.radius = vec3(*center), radius
        self.skin.face, self.skin.sample = model.outer.face, model.sample
        with wp.ScopedDevice(model.device):
            self._seen = make_seen(0, 0) if seen is None else seen
            self.known, self._touched = (wp.zeros(nworld, dtype=int) for _ in range(2))
            self.found = wp.zeros(nworld, dtype=wp.vec2d)
            self._way = [wp.zeros((ngeom, nworld), dtype=kind) for kind in (vec3, mat33)]
        if model.has_core:
            self.skin.core_vert, self.skin.core = model.core_vert, model.core(nworld).struct

    def find(
        self,
        on: wp.array,
        geoms: Geoms,
        laws: Laws,
        x: wp.array,
        wanted: int = 0,
        launcher: Launcher | None = None,
    ) -> None:
        """Finds the clearance in worlds that are on (nworld,), of skins with nodes at (nvert, nworld or 1).
        Launches only. wanted: BOUND, TOUCH or EXACT."""
        known = [self.skin, wanted, geoms, laws, on, x]
        found = [self._touched, self._seen, self.known, self.found]
        launcher = launcher or Launcher(self._device)
        launcher.launch_blocks(find_clearance, [len(on)], known, found)

    def begin_where_met(
        self, on: wp.array, geoms: Geoms, laws: Laws, x: wp.array, launcher: Launcher | None = None
    ) -> None:
        """See the kernel; on: (nworld,) int. Launches only."""
        launcher = launcher or Launcher(self._device)
        known, way = [self.skin, laws, on, x], [self._touched, geoms, *self._way]
        launcher.launch_blocks(begin_where_met, [len(on)], known, way)
