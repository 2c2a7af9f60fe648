"""Broad phase of a solve: faces near a geom, inner faces near the core, and their nodes."""

import warp as wp

from ...geometry.rigid_warp import LEVER
from ..block import block_max, block_rank, sync
from ..contact.broadphase import (
    ALL,
    face_ball,
    face_clearance,
    geoms_within,
    has,
    motion_bound,
    sample_within,
)
from ..contact.meshes import TRILINEAR, smooth_distance
from ..contact.penetration import geoms_core_clearance
from ..contact.posed import SKIN, Geoms, bound_to, face_radius, place_on, touch_bound
from ..contact.shapes import GEOM_TYPES
from ..types import real, vec3
from .lanes import keep_rows
from .states import Increment
from .structs import BACK, Constants, Scratch

_MESH = wp.constant(GEOM_TYPES["mesh"])
_REGION = wp.constant(real(1e-3))  # geoms may move this far before distances at rest are measured again [m]
_STILL = wp.constant(real(2e-4))  # so far, where the core's may be nearer than these tell [m]
_AWAY = wp.constant(real(8e-3))  # geoms that are further from the ball around the skin move unnoticed [m]
_SEEN = wp.constant(real(4e-3))  # a view says of each face which geoms are nearer than this [m]
_NEARLY = wp.constant(real(3e-5))  # more than the core's spline is off the distance [m]
ROOT3 = wp.constant(real(1.7321))  # by which distances may change faster than places: grids are trilinear


@wp.func
def _moved_since(w: int, k: int, near: wp.int64, geoms: Geoms, c: Constants, s: Scratch):
    """Bound of the motion of near geoms at the skin since view k was taken [m]; nan: it never was."""
    most = real(0.0)
    for g in range(geoms.count):
        if has(near, g):
            moved = motion_bound(
                s.seen_pos[k, g, w], s.seen_mat[k, g, w], geoms.pos[g, w], geoms.mat[g, w], c.center, c.radius
            )
            if not (moved <= most):  # nor is no number
                most = moved
    return most


@wp.func
def _is_clear(w: int, view: int, travel: real, near: wp.int64, geoms: Geoms, c: Constants, s: Scratch):
    """Whether no geom is too deep in the core, by a view and how far geoms have moved since it was taken."""
    jump = real(0.0)  # of a mesh a bound is the distance here and less there
    for g in range(geoms.count):
        if has(near, g) and (geoms.kind[g] == _MESH or geoms.kind[g] == SKIN):
            jump = wp.max(jump, TRILINEAR * geoms.grids.spacing[geoms.grid[g]])
    return s.seen_depth[w, view] + real(2.0) * travel + jump <= c.core_depth


@wp.func
def choose_view(w: int, t: int, geoms: Geoms, c: Constants, s: Scratch):
    """Chooses the view of the undeformed skin; returns it, the motion of the geoms there since it was taken
    [m], and the geoms near the skin. A view that is too old is renewed. A skin that serves several BioTacs in
    turn has several views."""
    least = _REGION
    view = int(-1)
    _count, near = geoms_within(c.center, c.radius + _AWAY, w, geoms, ALL)
    for k in range(s.far.shape[1]):
        moved = _moved_since(w, k, near, geoms, c, s)
        if moved < least and (moved < _STILL or _is_clear(w, k, moved, near, geoms, c, s)):
            least = moved
            view = k
    if view >= 0:
        return view, least, near
    view = s.turn[w]
    sync()
    for f in range(t, c.face.shape[0], wp.block_dim()):
        face = c.face[f]
        clearance, _beyond, _count, within = face_clearance(
            c.rest[face[0], 0], c.rest[face[1], 0], c.rest[face[2], 0], w, geoms, near, _SEEN
        )
        s.far[w, view, f] = clearance
        s.seen[w, view, f] = within
    depth = -geoms_core_clearance(w, t, wp.block_dim(), geoms, near, c.core, c.core_vert)
    for g in range(t, geoms.count, wp.block_dim()):
        s.seen_pos[view, g, w] = geoms.pos[g, w]
        s.seen_mat[view, g, w] = geoms.mat[g, w]
    if t == 0:
        s.seen_depth[w, view] = depth
        s.turn[w] = (view + 1) % s.far.shape[1]
    sync()
    return view, real(0.0), near


@wp.func
def largest_displacement(w: int, t: int, x: wp.array2d(dtype=vec3), c: Constants):
    """Largest displacement of a node [m]."""
    largest = real(0.0)
    for i in range(t, c.free.shape[0], wp.block_dim()):
        largest = wp.max(largest, wp.length_sq(x[c.free[i], w] - c.rest[c.free[i], 0]))
    return wp.sqrt(block_max(largest))


@wp.func
def forget_faces(w: int, t: int, geoms: Geoms, c: Constants, s: Scratch):
    """Candidates are those that touched when the last step ended; inner ones, those with a loaded node."""
    for i in range(t, s.x.shape[0], wp.block_dim()):
        s.sought_x[i, w] = s.x[i, w]
    for g in range(t, geoms.count, wp.block_dim()):
        s.sought_pos[g, w] = geoms.pos[g, w]
        s.sought_mat[g, w] = geoms.mat[g, w]
    for f in range(t, c.face.shape[0], wp.block_dim()):
        s.near[w, f] = s.touch.kept[f, w]
        s.close_to[w, f] = wp.int64(0)
        s.touch.touching[f, w] = 0
    for f in range(t, c.inner_face.shape[0], wp.block_dim()):
        loaded = int(0)
        for k in range(3):
            i = c.inner_number[c.inner_face[f][k]]
            if i >= 0:
                if s.core_force[w, i] != real(0.0):
                    loaded = 1
        s.near_core[w, f] = loaded
    sync()


@wp.func(inline=True)
def _moved(f: int, w: int, face: wp.array(dtype=wp.vec3i), x: wp.array2d(dtype=vec3), c: Constants):
    """Largest squared displacement of a face's nodes [m^2]."""
    most = real(0.0)
    for k in range(3):
        i = face[f][k]
        most = wp.max(most, wp.length_sq(x[i, w] - c.rest[i, 0]))
    return most


@wp.func
def _seen_from(
    f: int,
    w: int,
    reach: real,
    view: int,
    travel: real,
    near: wp.int64,
    c: Constants,
    s: Scratch,
):
    """The near geoms that may be within reach [m] of a face, by a view and the face's displacement."""
    room = _SEEN - reach - ROOT3 * travel
    if room > real(0.0) and room * room > ROOT3 * ROOT3 * _moved(f, w, c.face, s.x, c):
        return near & s.seen[w, view, f]
    return near


@wp.func
def _may_meet_core(f: int, w: int, fraction: real, x: wp.array2d(dtype=vec3), c: Constants):
    """Whether an inner face may be nearer to the core than a fraction of its displacement: none has come
    nearer by more than it has moved, or by much more than the slope of its gaps predicts."""
    face = c.inner_face[f]
    moved = real(0.0)
    away = real(wp.inf)
    for k in range(3):
        u = x[face[k], w] - c.rest[face[k], 0]
        moved = wp.max(moved, wp.length_sq(u))
        away = wp.min(away, wp.dot(c.inner_mean_slope[f], u))
    moved = wp.sqrt(moved)
    nearer = wp.min((c.inner_bend[f] + c.inner_spread[f]) * moved - away, moved)
    return c.inner_far[f] < nearer + fraction * moved + _NEARLY


@wp.func
def _meets_core(f: int, i: int, w: int, fraction: real, x: wp.array2d(dtype=vec3), c: Constants):
    """Whether sample i of an inner face is nearer to the core than a fraction of the face's displacement. The
    bounds of `_may_meet_core` exclude most samples: few distances are evaluated."""
    face = c.inner_face[f]
    reach = fraction * wp.sqrt(_moved(f, w, c.inner_face, x, c))
    x0 = x[face[0], w]
    x1 = x[face[1], w]
    x2 = x[face[2], w]
    b = c.sample[i]
    u = b[0] * (x0 - c.rest[face[0], 0]) + b[1] * (x1 - c.rest[face[1], 0]) + b[2] * (x2 - c.rest[face[2], 0])
    moved = wp.length(u)
    nearer = wp.min(c.inner_bend[f] * moved - wp.dot(c.inner_slope[f, i], u), moved)
    if c.inner_gap[f, i] - nearer >= reach + _NEARLY:
        return False
    p = b[0] * x0 + b[1] * x1 + b[2] * x2
    return smooth_distance(c.core.grids, c.core.grid[0], p)[3] - c.inner_rest[f, i] < reach


@wp.func
def _list_marked(w: int, t: int, none: int, mark: wp.array2d(dtype=int), list_out: wp.array2d(dtype=int)):
    """Lists the items whose mark is above none, in their order, as far as there is room, and makes their
    marks none + 1, none + 2, ...; how many there are."""
    n = mark.shape[1]
    each = (n + wp.block_dim() - 1) / wp.block_dim()
    first = t * each
    last = wp.min(first + each, n)
    count = int(0)
    for i in range(first, last):
        if mark[w, i] > none:
            count += 1
    rank = block_rank(count)
    at = rank[0]
    for i in range(first, last):
        if mark[w, i] > none:
            if at < list_out.shape[1]:
                list_out[w, at] = i
            at += 1
            mark[w, i] = none + at
    sync()
    return rank[1]


@wp.func
def find_faces(
    w: int,
    t: int,
    reach: real,
    view: int,
    travel: real,
    moved: real,
    near: wp.int64,
    geoms: Geoms,
    c: Constants,
    s: Scratch,
):
    """Adds the faces within reach of a geom [m] and those geoms; how many there are, and how many are new,
    with those that have a new geom. view, travel, near: those of `choose_view`. moved: how far the skin has
    at most [m]."""
    free = reach + ROOT3 * travel
    most = free + ROOT3 * moved
    if most > _AWAY:  # not computed yet
        most = real(wp.inf)
        free = most
        near = ALL
    # what is left is listed after each test, so that each thread has a part of it, and in the end a sample
    count = int(0)
    for begin in range(0, c.face.shape[0], wp.block_dim()):
        f = begin + t
        left = int(0)
        if f < c.face.shape[0]:
            left = wp.where(s.near[w, f] > 0 or s.far[w, view, f] < most, 1, 0)
            if left == 1 and s.near[w, f] == 0:
                room = s.far[w, view, f] - free  # by which it has to move
                if room > real(0.0) and room * room > ROOT3 * ROOT3 * _moved(f, w, c.face, s.x, c):
                    left = 0
        rank = block_rank(left)
        if left == 1:
            s.look[w, count + rank[0]] = f
        count += rank[1]
    sync()
    close = int(0)
    new = int(0)
    for begin in range(0, count, wp.block_dim()):
        f = int(0)
        left = int(0)
        within = wp.int64(0)
        if begin + t < count:
            f = s.look[w, begin + t]
            near_by = wp.where(s.near[w, f] > 0, wp.max(reach, real(0.0)), reach)
            face = c.face[f]
            center, radius = face_ball(s.x[face[0], w], s.x[face[1], w], s.x[face[2], w])
            within = _seen_from(f, w, near_by, view, travel, near, c, s)
            left, within = geoms_within(center, radius + near_by, w, geoms, within)
            if s.near[w, f] > 0:
                left = 0
                if within & s.close_to[w, f] != within:
                    s.close_to[w, f] = within | s.close_to[w, f]
                    new += 1
        rank = block_rank(wp.min(left, 1))  # its barriers are between reading and writing
        if left > 0:
            s.look[w, close + rank[0]] = f
            s.close_to[w, f] = within
        close += rank[1]
    sync()
    nsample = c.sample.shape[0]
    for m in range(t, close * nsample, wp.block_dim()):
        f = s.look[w, m / nsample]
        if s.near[w, f] == 0:
            face = c.face[f]
            b = c.sample[m % nsample]
            x0 = s.x[face[0], w]
            x1 = s.x[face[1], w]
            x2 = s.x[face[2], w]
            p = b[0] * x0 + b[1] * x1 + b[2] * x2
            if sample_within(p, reach, face_radius(x1 - x0, x2 - x0), w, geoms, s.close_to[w, f]):
                s.near[w, f] = 1
    sync()
    for k in range(t, close, wp.block_dim()):
        new += s.near[w, s.look[w, k]]
    sync()
    nface = _list_marked(w, t, 0, s.near, s.face)
    return nface, block_rank(new)[1]


@wp.func
def find_slack(w: int, t: int, o: Increment, geoms: Geoms, c: Constants, s: Scratch):
    """Finds how far each group of geoms can go without touching the skin [m], its turns times LEVER."""
    for group in range(t, s.slack.shape[0], wp.block_dim()):
        s.slack[group, w] = wp.where(o.ok == 1, _REGION, real(0.0))
    sync()
    close = wp.int64(0)
    for k in range(t, o.nface, wp.block_dim()):
        close = close | s.close_to[w, s.face[w, k]]
    for g in range(geoms.count):
        if has(close, g):
            wp.atomic_min(s.slack, geoms.group[g], w, real(0.0))
    others = o.near & ~close
    moved = _REGION + ROOT3 * _moved_since(w, o.view, o.near, geoms, c, s)
    for f in range(t, c.face.shape[0], wp.block_dim()):
        within = wp.int64(0)
        if ROOT3 * o.largest + moved >= s.far[w, o.view, f]:
            moves = ROOT3 * wp.sqrt(_moved(f, w, c.face, s.x, c)) + moved
            if moves >= s.far[w, o.view, f]:
                within = others
                if moves < _SEEN:
                    within = others & s.seen[w, o.view, f]
        if within != wp.int64(0):
            face = c.face[f]
            center, radius = face_ball(s.x[face[0], w], s.x[face[1], w], s.x[face[2], w])
            for g in range(geoms.count):
                if has(within, g):
                    y = place_on(geoms, g, w, center)
                    bound = touch_bound(geoms, g, y, bound_to(geoms, g, center, y), radius) - radius
                    wp.atomic_min(s.slack, geoms.group[g], w, wp.max(bound, real(0.0)))
    sync()
    lever = wp.max(real(1.0), (wp.length(c.center) + c.radius) / real(LEVER))
    for group in range(t, s.slack.shape[0], wp.block_dim()):
        s.slack[group, w] = s.slack[group, w] / (ROOT3 * lever)


@wp.func
def may_be_touched(w: int, t: int, o: Increment, geoms: Geoms, c: Constants, s: Scratch):
    """Whether a face that was no candidate when they were sought may have come to a geom since, or an inner
    one to the core, by how far nodes and near geoms have moved at most."""
    nodes = real(0.0)
    for k in range(t, c.node.shape[0], wp.block_dim()):
        i = c.node[k]
        nodes = wp.max(nodes, wp.length_sq(s.x[i, w] - s.sought_x[i, w]))
    posed = real(0.0)
    for g in range(geoms.count):
        if has(o.near, g):
            moved = motion_bound(
                s.sought_pos[g, w], s.sought_mat[g, w], geoms.pos[g, w], geoms.mat[g, w], c.center, c.radius
            )
            posed = wp.max(posed, moved)
    if ROOT3 * (wp.sqrt(block_max(nodes)) + posed) >= o.reach:
        return True
    over = real(0.0)
    for k in range(t, c.inner.shape[0], wp.block_dim()):
        i = c.inner[k]
        went = wp.length_sq(s.x[i, w] - s.sought_x[i, w])
        before = wp.length_sq(s.sought_x[i, w] - c.rest[i, 0])
        over = wp.max(over, ROOT3 * ROOT3 * went - o.fraction * o.fraction * before)
    return block_max(over) > real(0.0)


@wp.func
def is_known(w: int, t: int, o: Increment, geoms: Geoms, c: Constants, s: Scratch):
    """Whether the candidates that were found last are all that can touch."""
    other = real(0.0)
    for f in range(t, c.face.shape[0], wp.block_dim()):
        if s.touch.kept[f, w] == 1 and s.near[w, f] == 0:
            other = real(1.0)
    for k in range(t, c.inner.shape[0], wp.block_dim()):
        if s.core_force[w, k] != real(0.0) and s.core_place[w, k] < 0:
            other = real(1.0)
    if block_max(other) > real(0.0):
        return 0
    return wp.where(may_be_touched(w, t, o, geoms, c, s), 0, 1)


@wp.func
def find_inner_faces(w: int, t: int, fraction: real, c: Constants, s: Scratch):
    """Lists the inner faces whose distance to the core is below `fraction` of their displacement. Returns how
    many there are, and how many are new; the list may be shorter, it ends at its capacity."""
    nsample = c.sample.shape[0]
    new = int(0)
    inside = int(0)
    for begin in range(0, c.inner_face.shape[0], wp.block_dim()):
        f = begin + t
        left = int(0)
        if f < c.inner_face.shape[0]:
            if s.near_core[w, f] == 0 and _may_meet_core(f, w, fraction, s.x, c):
                left = 1
        rank = block_rank(left)
        if left == 1:
            s.look[w, inside + rank[0]] = f
        inside += rank[1]
    sync()
    for m in range(t, inside * nsample, wp.block_dim()):
        f = s.look[w, m / nsample]
        if s.near_core[w, f] == 0 and _meets_core(f, m % nsample, w, fraction, s.x, c):
            s.near_core[w, f] = 1
    sync()
    for k in range(t, inside, wp.block_dim()):
        new += s.near_core[w, s.look[w, k]]
    sync()
    ncore = _list_marked(w, t, 0, s.near_core, s.core_face)
    return ncore, block_rank(new)[1]


@wp.func
def find_nodes(w: int, t: int, nface: int, ncore: int, c: Constants, s: Scratch):
    """Numbers the free nodes of the candidate faces and their coordinates; how many outer and inner nodes
    there are, which are not listed where there is no room."""
    for i in range(t, c.node.shape[0], wp.block_dim()):
        s.place[w, i] = -1
    for i in range(t, c.inner.shape[0], wp.block_dim()):
        s.core_place[w, i] = -1
    sync()
    for k in range(t, nface, wp.block_dim()):
        face = c.face[s.face[w, k]]
        for a in range(3):
            i = c.number[face[a]]
            if i >= 0:
                s.place[w, i] = 0
    for k in range(t, wp.min(ncore, s.core_face.shape[1]), wp.block_dim()):
        face = c.inner_face[s.core_face[w, k]]
        for a in range(3):
            i = c.inner_number[face[a]]
            if i >= 0:
                s.core_place[w, i] = 0
    sync()
    nnode = _list_marked(w, t, -1, s.place, s.node)
    nin = _list_marked(w, t, -1, s.core_place, s.core_node)
    if 3 * nnode + nin <= s.coordinate.shape[1]:
        for k in range(t, nnode, wp.block_dim()):
            for a in range(3):
                s.coordinate[w, 3 * k + a] = 3 * s.node[w, k] + a
        for k in range(t, nin, wp.block_dim()):
            s.coordinate[w, 3 * nnode + k] = 3 * c.node.shape[0] + s.core_node[w, k]
        if wp.block_dim() == 1:
            keep_rows(w, 3 * nnode + nin, s.coordinate, s.last, 3 * nnode + nin, 0, s.ready)
    sync()
    return nnode, nin


@wp.func
def measure_core(w: int, t: int, nnode: int, nin: int, ncore: int, c: Constants, s: Scratch):
    """Gaps of the candidates' samples from the core, where the skin is now."""
    k = int(0)
    if ncore > 0:  # else there may be no core
        k = c.core.grid[0]
    for j in range(t, nin, wp.block_dim()):
        i = c.inner[s.core_node[w, j]]
        s.vector[w, BACK, 3 * nnode + j] = wp.dot(s.x[i, w] - c.rest[i, 0], c.away[s.core_node[w, j]])
    for j in range(t, ncore * c.sample.shape[0], wp.block_dim()):
        at = j / c.sample.shape[0]
        i = j % c.sample.shape[0]
        f = s.core_face[w, at]
        face = c.inner_face[f]
        b = c.sample[i]
        p = b[0] * s.x[face[0], w] + b[1] * s.x[face[1], w] + b[2] * s.x[face[2], w]
        s.gap[w, at, i] = smooth_distance(c.core.grids, k, p)[3] - c.inner_rest[f, i]
    sync()


@wp.func
def is_deep(w: int, t: int, view: int, travel: real, near: wp.int64, geoms: Geoms, c: Constants, s: Scratch):
    """Whether a geom is deeper in the core than a skin has room for. view, travel, near: those of
    `choose_view`."""
    if _is_clear(w, view, travel, near, geoms, c, s):
        return False
    return geoms_core_clearance(w, t, wp.block_dim(), geoms, near, c.core, c.core_vert) < -c.core_depth
