"""Broad phase: which faces of a surface may touch which geoms.

Distances are bounded from below (`posed.bound_to`), so a face that is excluded cannot touch. A ball around a
face bounds its distance by one evaluation for each geom. The full tier stores the distance as a clearance
until the face and the geoms may have moved that far; without this a press on the default skin takes 1.2 times
as long on one core.
"""

import warp as wp

from ..types import double, mat33, real, single, vec3
from .faces import Contact, Laws
from .meshes import DISTANCES
from .posed import Geoms, bound_to, place_on, touch_bound

FREE = wp.constant(real(1.0))  # [m] clearance of a face far from all geoms


# a set of geoms has a bit for each of the first 63; later geoms belong to every set
ALL = wp.constant(wp.int64(-1))


@wp.func
def has(geom_set: wp.int64, g: int):
    """Whether geom g is in the set."""
    if g >= 63:
        return True
    return (geom_set >> wp.int64(g)) & wp.int64(1) == wp.int64(1)


@wp.func
def bit_of(g: int):
    """Set of geom g alone."""
    if g >= 63:
        return wp.int64(0)
    return wp.int64(1) << wp.int64(g)


@wp.func
def geoms_within(center: vec3, reach: real, w: int, geoms: Geoms, geom_set: wp.int64):
    """Number and set of the geoms of a set that may be closer to a point than `reach` [m]."""
    count = int(0)
    found = wp.int64(0)
    for g in range(geoms.count):
        if has(geom_set, g):
            y = place_on(geoms, g, w, center)
            if touch_bound(geoms, g, y, bound_to(geoms, g, center, y), reach) < reach:
                count += 1
                found = found | bit_of(g)
    return count, found


@wp.func
def face_ball(x0: vec3, x1: vec3, x2: vec3):
    """Centre and radius of a ball around a face [m]."""
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(
        wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center)))
    )
    return center, radius


@wp.func
def face_clearance(x0: vec3, x1: vec3, x2: vec3, w: int, geoms: Geoms, geom_set: wp.int64, reach: real):
    """Lower bound of a face's distance from all geoms of a set [m], from its ball; of those that are not
    within reach [m]; number and set of those that may be."""
    center, radius = face_ball(x0, x1, x2)
    clearance = FREE
    beyond = FREE
    count = int(0)
    within = wp.int64(0)
    for g in range(geoms.count):
        if has(geom_set, g):
            y = place_on(geoms, g, w, center)
            bound = touch_bound(geoms, g, y, bound_to(geoms, g, center, y), radius) - radius
            clearance = wp.min(clearance, bound)
            if bound > reach:
                beyond = wp.min(beyond, bound)
            else:
                count += 1
                within = within | bit_of(g)
    return clearance, beyond, count, within


@wp.func
def geom_clearance(
    geoms: Geoms,
    g: int,
    pos: vec3,
    mat: mat33,
    x0: vec3,
    x1: vec3,
    x2: vec3,
    center: vec3,
    radius: real,
    sample: wp.array(dtype=vec3),
    most: real,
    enough: real,
):
    """Lower bound of the distance of a face's samples from geom g at pos, mat, at most `most` [m]. Returns
    early at a sample that is closer than `enough`. center, radius: ball around the face."""
    clearance = most
    y = wp.transpose(mat) * (center - pos)
    if touch_bound(geoms, g, y, bound_to(geoms, g, center, y), radius) < radius + most:
        for s in range(sample.shape[0]):
            b = sample[s]
            p = b[0] * x0 + b[1] * x1 + b[2] * x2
            y = wp.transpose(mat) * (p - pos)
            clearance = wp.min(clearance, touch_bound(geoms, g, y, bound_to(geoms, g, p, y), radius))
            if clearance < enough:
                return clearance
    return clearance


@wp.func
def sample_within(p: vec3, reach: real, radius: real, w: int, geoms: Geoms, geom_set: wp.int64):
    """Whether a sample of a face may be nearer to a geom of a set than the reach [m]. radius: of the face's
    ball."""
    for g in range(geoms.count):
        if has(geom_set, g):
            y = place_on(geoms, g, w, p)
            if touch_bound(geoms, g, y, bound_to(geoms, g, p, y), radius) < reach:
                return True
    return False


@wp.func
def sample_clearance(
    x0: vec3,
    x1: vec3,
    x2: vec3,
    sample: wp.array(dtype=vec3),
    w: int,
    geoms: Geoms,
    geom_set: wp.int64,
    most: real,
    enough: real,
):
    """`geom_clearance` from all geoms of a set."""
    center, radius = face_ball(x0, x1, x2)
    clearance = most
    for g in range(geoms.count):
        if has(geom_set, g) and clearance >= enough:
            clearance = geom_clearance(
                geoms, g, geoms.pos[g, w], geoms.mat[g, w], x0, x1, x2, center, radius, sample, clearance,
                enough,
            )  # fmt: skip
    return clearance


@wp.func
def motion_bound(pos0: vec3, mat0: mat33, pos: vec3, mat: mat33, center: vec3, radius: real):
    """Most that a point fixed in a ball moves in the frame of a geom that moves from pose 0 to another [m].
    Computed from coordinates in that frame, as distances are, since rotations may be rounded."""
    turn = mat - mat0
    moved = wp.length(wp.transpose(mat) * (center - pos) - wp.transpose(mat0) * (center - pos0))
    return moved + wp.sqrt(wp.ddot(turn, turn)) * radius


@wp.func
def contact_range(laws: Laws, w: int):
    """Largest gap with a contact force [m]."""
    reach = real(0.0)
    if laws.reach.shape[0] > 0:
        reach = laws.reach[w]
    if laws.smoothing.shape[0] > 0:
        reach = laws.smoothing[w]
    return reach


@wp.struct
class ClearanceCache:
    """Clearances of the faces of a surface. A distance changes by at most the motion of the face plus that of
    the geoms, so a face is skipped while its clearance is larger. A face outside the ball is always
    evaluated."""

    center: vec3  # of the ball around the skin [m]
    radius: real
    mark: wp.array(dtype=int)  # number of the geoms that were tracked last [world]
    pos: wp.array2d(dtype=vec3)  # their poses [geom, world]
    mat: wp.array2d(dtype=mat33)
    travel: wp.array(dtype=real)  # bound of the geoms' path length since it was last zero [world] [m]
    seen: wp.array2d(dtype=wp.vec3)  # corners when the clearance was found [3 face + corner, world] [m]
    since: wp.array2d(dtype=real)  # travel when the clearance was found [face, world] [m]
    clearance: wp.array2d(dtype=real)  # [face, world] [m]
    unknown: wp.array(dtype=int)  # face * nworld + world of the faces without clearance
    near: wp.array(dtype=int)  # face * nworld + world of the faces that may touch
    count: wp.array(dtype=int)  # lengths of these two lists


_FAR = wp.constant(real(2.0))  # [m] above every clearance
_ROUNDED = wp.constant(real(1.0e-7))  # [m] above the rounding of positions and of distances of meshes
_STRETCHED = wp.constant(real(1.0 + 1.0e-6))  # above the stretch by rotations in single precision
_LONG = wp.constant(real(1.0e3))  # [m] of travel, to which small motions cannot be added exactly


@wp.kernel(module=DISTANCES)
def track_geoms(
    # In:
    mark: int,
    geoms: Geoms,
    on: wp.array(dtype=int),
    # In and out:
    cache: ClearanceCache,
):
    """Adds the geoms' motion since the last evaluation to `travel` of world w, and empties the lists."""
    w = wp.tid()
    if w == 0:
        cache.count[0] = 0
        cache.count[1] = 0
    if on[w] == 0:
        return
    far = real(0.0)
    for g in range(geoms.count):
        p = geoms.pos[g, w]
        R = geoms.mat[g, w]
        moved = motion_bound(cache.pos[g, w], cache.mat[g, w], p, R, cache.center, cache.radius)
        if not (moved < _FAR):
            moved = _FAR
        far = wp.max(far, moved)
        cache.pos[g, w] = p
        cache.mat[g, w] = R
    if cache.mark[w] != mark:  # other geoms were tracked
        cache.mark[w] = mark
        far = _FAR
    cache.travel[w] = cache.travel[w] + far
    if not (cache.travel[w] < _LONG):
        cache.travel[w] = real(0.0)  # less than `since` of every face: all are evaluated


@wp.func
def _is_clear(f: int, w: int, x0: vec3, x1: vec3, x2: vec3, reach: real, cache: ClearanceCache):
    """Whether the clearance of a face is larger than all motion since it was found."""
    out = wp.length_sq(x0 - cache.center)
    out = wp.max(out, wp.max(wp.length_sq(x1 - cache.center), wp.length_sq(x2 - cache.center)))
    if not (out < cache.radius * cache.radius) or cache.since[f, w] > cache.travel[w]:
        return False
    a = wp.length_sq(x0 - double(cache.seen[3 * f, w]))
    b = wp.length_sq(x1 - double(cache.seen[3 * f + 1, w]))
    c = wp.length_sq(x2 - double(cache.seen[3 * f + 2, w]))
    moved = _STRETCHED * wp.sqrt(wp.max(a, wp.max(b, c))) + cache.travel[w] - cache.since[f, w]
    return moved + _ROUNDED < cache.clearance[f, w] - reach


@wp.func
def store_clearance(f: int, w: int, x0: vec3, x1: vec3, x2: vec3, clearance: real, cache: ClearanceCache):
    """Stores the clearance of a face [m]. A face whose position is not finite has none, and is always
    evaluated."""
    known = clearance
    if not wp.isfinite(wp.length_sq(x0) + wp.length_sq(x1) + wp.length_sq(x2)):
        known = real(-1.0)
    cache.clearance[f, w] = known
    cache.since[f, w] = cache.travel[w]
    cache.seen[3 * f, w] = single(x0)
    cache.seen[3 * f + 1, w] = single(x1)
    cache.seen[3 * f + 2, w] = single(x2)


@wp.kernel(module=DISTANCES)
def list_unknown(
    # In:
    contact: Contact,
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # In and out:
    cache: ClearanceCache,
    # Out:
    near_out: wp.array2d(dtype=int),
):
    """Lists face f if its clearance is used up. A kernel of its own, since `list_near` takes many registers
    on CUDA and only few faces need it. The order of the list changes no result."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    t = contact.face[f]
    near_out[f, w] = 0
    reach = contact_range(contact.laws, w)
    if not _is_clear(f, w, x[t[0], w], x[t[1], w], x[t[2], w], reach, cache):
        cache.unknown[wp.atomic_add(cache.count, 0, 1)] = f * x.shape[1] + w


@wp.kernel(module=DISTANCES)
def list_near(
    # In:
    threads: int,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    # In and out:
    cache: ClearanceCache,
    contact: Contact,
    # Out:
    near_out: wp.array2d(dtype=int),
):
    """Lists the faces without clearance that may touch, and stores the clearance of the others."""
    for k in range(wp.tid(), cache.count[0], threads):
        f = cache.unknown[k] // x.shape[1]
        w = cache.unknown[k] % x.shape[1]
        t = contact.face[f]
        x0 = x[t[0], w]
        x1 = x[t[1], w]
        x2 = x[t[2], w]
        clearance, _beyond, _count, _within = face_clearance(x0, x1, x2, w, geoms, ALL, real(0.0))
        if clearance < contact_range(contact.laws, w):
            near_out[f, w] = 1
            cache.near[wp.atomic_add(cache.count, 1, 1)] = cache.unknown[k]
        else:
            if contact.touching[f, w] == 1:
                contact.touching[f, w] = 0
                nsample = contact.sample.shape[0]
                for i in range(f * nsample, (f + 1) * nsample):
                    contact.trial_geom[i, w] = -1
                    contact.bond[i, w] = -1
            store_clearance(f, w, x0, x1, x2, clearance, cache)
