"""Which faces of a surface may touch: far ones are left out by one distance of their centre, and those that
were far, until they or the geoms may have come near."""

import warp as wp

from ..types import double, mat33, real, single, vec3
from .faces import Laws
from .posed import Geoms, bound_to, place_on

__all__ = [
    "ALL",
    "Watch",
    "cull_faces",
    "distance_from_afar",
    "has",
    "list_faces",
    "look_at_listed",
    "near_geoms",
    "remember_clearance",
    "watch_geoms",
    "with_geom",
]

wp.set_module_options({"enable_backward": False})


@wp.func
def distance_from_afar(x0: vec3, x1: vec3, x2: vec3, w: int, geoms: Geoms):
    """How far a face is from every geom at least [m], by one distance of its centre each."""
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(
        wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center)))
    )
    free = real(1.0)
    for g in range(geoms.count):
        bound = bound_to(geoms, g, center, place_on(geoms, g, w, center))
        free = wp.min(free, bound - radius)
    return free


# bits of geoms: one for each of the first 63; those behind them are always asked
ALL = wp.constant(wp.int64(-1))


@wp.func
def has(asked: wp.int64, g: int):
    """Whether the bits have geom g."""
    if g >= 63:
        return True
    return (asked >> wp.int64(g)) & wp.int64(1) == wp.int64(1)


@wp.func
def with_geom(asked: wp.int64, g: int):
    """The bits with geom g besides."""
    if g >= 63:
        return asked
    return asked | (wp.int64(1) << wp.int64(g))


@wp.func
def near_geoms(x0: vec3, x1: vec3, x2: vec3, w: int, geoms: Geoms):
    """How many geoms a face may touch, and their bits, by one distance of its centre each."""
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(
        wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center)))
    )
    count = int(0)
    near = wp.int64(0)
    for g in range(geoms.count):
        if bound_to(geoms, g, center, place_on(geoms, g, w, center)) < radius:
            count += 1
            near = with_geom(near, g)
    return count, near


@wp.struct
class Watch:
    """What is known of where faces cannot touch. A distance changes by no more than the face and the geoms
    have moved, so a face that was clear by more is left alone; `watch_geoms` adds up what geoms move. What is
    outside the ball around the skin is always looked at."""

    center: vec3  # of the ball [m]
    radius: real
    mark: wp.array(dtype=int)  # of the geoms that were watched last [world]
    pos: wp.array2d(dtype=vec3)  # where they were [geom, world]
    mat: wp.array2d(dtype=mat33)
    travel: wp.array(dtype=real)  # at most, of what is in the ball, since it was last zero [world] [m]
    # corners of the face when its clearance was found, to 1e-9 m [3 face + corner, world]
    seen: wp.array2d(dtype=wp.vec3)
    since: wp.array2d(dtype=real)  # travel then [face, world]
    clearance: wp.array2d(dtype=real)  # [face, world] [m]
    look: wp.array(dtype=int)  # faces x worlds that have to be looked at, where they are listed
    near: wp.array(dtype=int)  # that may touch
    count: wp.array(dtype=int)  # how many of either


_FAR = wp.constant(real(2.0))  # [m] more than any clearance
_ROUNDED = wp.constant(real(1.0e-7))  # [m] more than places and distances of meshes are rounded by
_STRETCHED = wp.constant(real(1.0 + 1.0e-6))  # more than poses in single precision stretch
_LONG = wp.constant(real(1.0e3))  # [m] of travel beside which small motions would be lost


@wp.kernel
def watch_geoms(
    # In:
    mark: int,
    geoms: Geoms,
    on: wp.array(dtype=int),
    # In and out:
    watch: Watch,
):
    """Adds what geoms have moved since the last look: no more than a point that lies still in the ball moves
    in the frame of each. By that frame's coordinates, as distances are: rotations may be rounded."""
    w = wp.tid()
    if w == 0:
        watch.count[0] = 0
        watch.count[1] = 0
    if on[w] == 0:
        return
    far = real(0.0)
    for g in range(geoms.count):
        p = geoms.pos[g, w]
        R = geoms.mat[g, w]
        turn = R - watch.mat[g, w]
        there = wp.transpose(watch.mat[g, w]) * (watch.center - watch.pos[g, w])
        moved = wp.length(wp.transpose(R) * (watch.center - p) - there)
        moved += wp.sqrt(wp.ddot(turn, turn)) * watch.radius
        if not (moved < _FAR):
            moved = _FAR
        far = wp.max(far, moved)
        watch.pos[g, w] = p
        watch.mat[g, w] = R
    if watch.mark[w] != mark:  # others were watched
        watch.mark[w] = mark
        far = _FAR
    watch.travel[w] = watch.travel[w] + far
    if not (watch.travel[w] < _LONG):
        watch.travel[w] = real(0.0)  # less than any face has seen: all are looked at


@wp.func
def is_clear(f: int, w: int, x0: vec3, x1: vec3, x2: vec3, reach: real, watch: Watch):
    """Whether a face has not come near since it was last looked at."""
    out = wp.length_sq(x0 - watch.center)
    out = wp.max(out, wp.max(wp.length_sq(x1 - watch.center), wp.length_sq(x2 - watch.center)))
    if not (out < watch.radius * watch.radius) or watch.since[f, w] > watch.travel[w]:
        return False
    a = wp.length_sq(x0 - double(watch.seen[3 * f, w]))
    b = wp.length_sq(x1 - double(watch.seen[3 * f + 1, w]))
    c = wp.length_sq(x2 - double(watch.seen[3 * f + 2, w]))
    moved = _STRETCHED * wp.sqrt(wp.max(a, wp.max(b, c))) + watch.travel[w] - watch.since[f, w]
    return moved + _ROUNDED < watch.clearance[f, w] - reach


@wp.func
def remember_clearance(f: int, w: int, x0: vec3, x1: vec3, x2: vec3, free: real, watch: Watch):
    """Of a face that is so far from every geom [m]. Nothing is known of one without a place: it is looked at
    again, wherever it goes."""
    known = free
    if not wp.isfinite(wp.length_sq(x0) + wp.length_sq(x1) + wp.length_sq(x2)):
        known = real(-1.0)
    watch.clearance[f, w] = known
    watch.since[f, w] = watch.travel[w]
    watch.seen[3 * f, w] = single(x0)
    watch.seen[3 * f + 1, w] = single(x1)
    watch.seen[3 * f + 2, w] = single(x2)


@wp.func
def reach_of(laws: Laws, w: int):
    """How far from a geom skin feels it [m]."""
    reach = real(0.0)
    if laws.reach.shape[0] > 0:
        reach = laws.reach[w]
    if laws.smoothing.shape[0] > 0:
        reach = laws.smoothing[w]
    return reach


@wp.func
def comes_near(
    f: int,
    w: int,
    x0: vec3,
    x1: vec3,
    x2: vec3,
    nsample: int,
    geoms: Geoms,
    reach: real,
    watch: Watch,
    touching: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    bond_out: wp.array2d(dtype=int),
):
    """Whether a face may touch, by one distance of its centre; of one that does not, what is known."""
    free = distance_from_afar(x0, x1, x2, w, geoms)
    if free < reach:
        return 1
    if touching[f, w] == 1:
        touching[f, w] = 0
        for s in range(nsample):
            geom_out[f * nsample + s, w] = -1
            bond_out[f * nsample + s, w] = -1
    remember_clearance(f, w, x0, x1, x2, free, watch)
    return 0


@wp.kernel
def cull_faces(
    # In:
    nsample: int,
    face: wp.array(dtype=wp.vec3i),
    geoms: Geoms,
    laws: Laws,
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # In and out:
    watch: Watch,
    touching: wp.array2d(dtype=int),
    # Out:
    near_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    bond_out: wp.array2d(dtype=int),
):
    """Which faces may touch."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    t = face[f]
    x0 = x[t[0], w]
    x1 = x[t[1], w]
    x2 = x[t[2], w]
    reach = reach_of(laws, w)
    near = int(0)
    if not is_clear(f, w, x0, x1, x2, reach, watch):
        near = comes_near(f, w, x0, x1, x2, nsample, geoms, reach, watch, touching, geom_out, bond_out)
    near_out[f, w] = near


@wp.kernel
def list_faces(
    # In:
    face: wp.array(dtype=wp.vec3i),
    laws: Laws,
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # In and out:
    watch: Watch,
    # Out:
    near_out: wp.array2d(dtype=int),
):
    """`cull_faces` in two, for CUDA: few faces have to be looked at, and a look takes so many registers
    that all would wait for it. Which place in the list a face has is chance, and of no consequence."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    t = face[f]
    near_out[f, w] = 0
    if not is_clear(f, w, x[t[0], w], x[t[1], w], x[t[2], w], reach_of(laws, w), watch):
        watch.look[wp.atomic_add(watch.count, 0, 1)] = f * x.shape[1] + w


@wp.kernel
def look_at_listed(
    # In:
    threads: int,
    nsample: int,
    face: wp.array(dtype=wp.vec3i),
    geoms: Geoms,
    laws: Laws,
    x: wp.array2d(dtype=vec3),
    # In and out:
    watch: Watch,
    touching: wp.array2d(dtype=int),
    # Out:
    near_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    bond_out: wp.array2d(dtype=int),
):
    for i in range(wp.tid(), watch.count[0], threads):
        f = watch.look[i] // x.shape[1]
        w = watch.look[i] % x.shape[1]
        t = face[f]
        reach = reach_of(laws, w)
        if (
            comes_near(
                f, w, x[t[0], w], x[t[1], w], x[t[2], w], nsample, geoms, reach, watch, touching, geom_out,
                bond_out,
            )
            == 1
        ):  # fmt: skip
            near_out[f, w] = 1
            watch.near[wp.atomic_add(watch.count, 1, 1)] = watch.look[i]
