"""Clearances of geoms from undeformed skins: measured where a geom is near, elsewhere bounded by earlier
ones."""

import typing

import numpy as np
import warp as wp

from ...geometry.rigid_warp import is_finite
from ...kernels import add_zeros, kernel_module
from ..block import block_max
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

    One block per world: each time its threads have measured a face each, they end if one is touched. They
    begin with those among which the last nearest face was: of others the ball is mostly further away.

    Args:
      wanted: BOUND, TOUCH or EXACT.
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
    threads = wp.block_dim()
    own = w % x.shape[1]
    parts = (skin.face.shape[0] + threads - 1) / threads
    part = touched[w]
    closest = part
    nearest = real(wp.inf)
    p = vec3()
    around = real(-wp.inf)  # least distance of a geom from p, which bounds that of the faces next to it
    done = int(0)
    while done < parts:
        f = part * threads + t
        least = nearest
        if f < skin.face.shape[0]:
            i = skin.face[f]
            x0 = x[i[0], own]
            x1 = x[i[1], own]
            x2 = x[i[2], own]
            center, radius = face_ball(x0, x1, x2)
            if around - _ROOT3 * wp.length(center - p) - _SPREAD * radius < nearest:
                ball, _beyond, _count, _within = face_clearance(x0, x1, x2, w, geoms, ALL, margin)
                p = center
                around = ball + radius
                if ball < nearest:
                    least = wp.max(
                        ball, sample_clearance(x0, x1, x2, skin.sample, w, geoms, ALL, nearest, reach)
                    )
        least = -block_max(-least)
        if least < nearest:
            nearest = least
            closest = part
        part = (part + 1) % parts
        done = wp.where(nearest < reach, parts, done + 1)
    inside = real(wp.inf)
    if nearest >= reach:
        inside = geoms_core_clearance(w, t, threads, geoms, ALL, skin.core, skin.core_vert)
    if t == 0:
        touched[w] = closest
        clearance_out[w] = wp.vec2d(nearest, inside)
        if seen.clearance.shape[0] > 0:
            seen.clearance[w] = clearance_out[w]
            for g in range(geoms.count):
                seen.pos[g, w] = geoms.pos[g, w]
                seen.mat[g, w] = geoms.mat[g, w]


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

    def __init__(self, model: "SkinModel", nworld: int, seen: object = None):
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
