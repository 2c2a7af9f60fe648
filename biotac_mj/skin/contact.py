"""Contact of a skin surface with geoms: linear pressure-overclosure sampled inside the faces, Coulomb
friction with stick and slip.

Each face carries `nsample` points with equal shares of its rest area, so contact acts between the nodes too
(as surface-to-surface contact does in ANSYS and CalculiX). Normal traction is k * overclosure; friction is an
elastic stick of k * stick_ratio about an anchor that stays put on the geom, returned radially to mu times the
normal force where it slips."""

import numpy as np
import warp as wp

from .shapes import Grids, distance, distance_bound
from .types import mat33, real, vec3

__all__ = [
    "FaceSum",
    "Geoms",
    "contact_force",
    "contact_product",
    "contact_wrench",
    "core_contact_force",
    "face_samples",
    "stick_or_slip",
    "with_sample",
    "write_face",
]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Geoms:
    """Touching geoms in the BioTac frame, at the end and at the start of the step; arrays over worlds are
    [geom, world]."""

    count: int
    kind: wp.array(dtype=int)
    size: wp.array(dtype=vec3)
    rounding: wp.array(dtype=real)
    grid: wp.array(dtype=int)
    group: wp.array(dtype=int)
    friction: wp.array2d(dtype=real)
    pos: wp.array2d(dtype=vec3)
    mat: wp.array2d(dtype=mat33)
    pos_last: wp.array2d(dtype=vec3)
    mat_last: wp.array2d(dtype=mat33)
    grids: Grids


def face_samples(order: int) -> np.ndarray:
    """Barycentric coordinates (order^2, 3) of the centroids of the order^2 equal triangles that subdivide a
    face."""
    points = []
    for i in range(order):
        for j in range(order - i):
            points.append((i + 1 / 3, j + 1 / 3))
            if j < order - i - 1:
                points.append((i + 2 / 3, j + 2 / 3))
    ab = np.array(points) / order
    return np.column_stack([ab, 1 - ab.sum(axis=1)])


@wp.func
def stick_or_slip(local: vec3, stick: vec3, normal: vec3, most: real, kt: real):
    """Coulomb's friction of at most `most` [N] at `local`, held by a spring kt about the anchor `stick`:
    force, its tangent, anchor."""
    slip = local - stick
    slip = slip - wp.dot(slip, normal) * normal
    length = wp.length(slip)
    tangent = wp.identity(n=3, dtype=real) - wp.outer(normal, normal)
    force = -kt * slip
    K = kt * tangent
    anchor = stick
    if kt * length > most:
        along = slip / length
        force = -most * along
        K = most / length * (tangent - wp.outer(along, along))
        anchor = local - most / kt * along
    return force, K, anchor


@wp.func
def touch_sample(
    i: int,
    w: int,
    b: vec3,
    t: wp.vec3i,
    x0: vec3,
    x1: vec3,
    x2: vec3,
    k: real,
    kt: real,
    geoms: Geoms,
    x_last: wp.array2d(dtype=vec3),
    anchor_geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
):
    """Contact of sample i at b of a face: geom (-1: none), least distance [m], force [N], its tangent [N/m],
    anchor."""
    p = b[0] * x0 + b[1] * x1 + b[2] * x2
    touched = int(-1)
    clearance = real(1.0)
    gap = real(0.0)
    normal = vec3()
    local = vec3()
    for g in range(geoms.count):
        R = geoms.mat[g, w]
        y = wp.transpose(R) * (p - geoms.pos[g, w])
        dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        clearance = wp.min(clearance, dn[3])
        if dn[3] < gap:
            gap = dn[3]
            touched = g
            normal = vec3(dn[0], dn[1], dn[2])
            local = y
    force = vec3()
    K = mat33()
    stick = local
    if touched >= 0:
        fn = -k * gap
        force = fn * normal
        K = k * wp.outer(normal, normal)
        mu = geoms.friction[touched, w]
        if mu > real(0.0):
            if anchor_geom[i, w] == touched:
                stick = anchor[i, w]
            else:
                # touched within this step: slip counts from where the sample was on the geom when the step
                # began
                last = b[0] * x_last[t[0], w] + b[1] * x_last[t[1], w] + b[2] * x_last[t[2], w]
                stick = wp.transpose(geoms.mat_last[touched, w]) * (last - geoms.pos_last[touched, w])
            ft, Kt, stick = stick_or_slip(local, stick, normal, mu * fn, kt)
            force = force + ft
            K = K + Kt
        R = geoms.mat[touched, w]
        force = R * force
        K = R * K * wp.transpose(R)
    return touched, clearance, force, K, stick


@wp.struct
class FaceSum:
    """Force on the corners of a face, and the six blocks of its tangent between them, of the samples so
    far."""

    f0: vec3
    f1: vec3
    f2: vec3
    b00: mat33
    b01: mat33
    b02: mat33
    b11: mat33
    b12: mat33
    b22: mat33


@wp.func
def with_sample(total: FaceSum, b: vec3, force: vec3, K: mat33):
    """The sum with a sample at barycentric b."""
    total.f0 += b[0] * force
    total.f1 += b[1] * force
    total.f2 += b[2] * force
    total.b00 += (b[0] * b[0]) * K
    total.b01 += (b[0] * b[1]) * K
    total.b02 += (b[0] * b[2]) * K
    total.b11 += (b[1] * b[1]) * K
    total.b12 += (b[1] * b[2]) * K
    total.b22 += (b[2] * b[2]) * K
    return total


@wp.func
def write_face(
    f: int,
    w: int,
    touching: int,
    total: FaceSum,
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
):
    touching_out[f, w] = touching
    corner_out[3 * f, w] = total.f0
    corner_out[3 * f + 1, w] = total.f1
    corner_out[3 * f + 2, w] = total.f2
    if touching == 1:
        block_out[6 * f, w] = total.b00
        block_out[6 * f + 1, w] = total.b01
        block_out[6 * f + 2, w] = total.b02
        block_out[6 * f + 3, w] = total.b11
        block_out[6 * f + 4, w] = total.b12
        block_out[6 * f + 5, w] = total.b22


@wp.func
def touch_face(
    f: int,
    w: int,
    # In:
    face: wp.array(dtype=wp.vec3i),
    area: wp.array(dtype=real),
    sample: wp.array(dtype=vec3),
    stiffness: real,
    stick_ratio: real,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    x_last: wp.array2d(dtype=vec3),
    anchor_geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
    force_out: wp.array2d(dtype=vec3),
):
    """Evaluates a face; returns how far its nearest sample is from touching [m] (a lower bound)."""
    nsample = sample.shape[0]
    t = face[f]
    x0 = x[t[0], w]
    x1 = x[t[1], w]
    x2 = x[t[2], w]
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(
        wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center)))
    )
    near = int(0)
    clearance = real(1.0)
    # most faces are far from every geom: one distance each tells
    for g in range(geoms.count):
        R = geoms.mat[g, w]
        y = wp.transpose(R) * (center - geoms.pos[g, w])
        bound = distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        clearance = wp.min(clearance, bound - radius)
        if bound < radius:
            near = 1
    if near == 1:
        clearance = real(1.0)
    touching = int(0)
    total = FaceSum()
    k = stiffness * area[f] / real(nsample)
    kt = k * stick_ratio
    for s in range(nsample):
        i = f * nsample + s
        geom_out[i, w] = -1
        if near == 1:
            b = sample[s]
            touched, gap, force, K, stick = touch_sample(
                i, w, b, t, x0, x1, x2, k, kt, geoms, x_last, anchor_geom, anchor
            )
            clearance = wp.min(clearance, gap)
            if touched >= 0:
                touching = 1
                geom_out[i, w] = touched
                anchor_out[i, w] = stick
                force_out[i, w] = force
                total = with_sample(total, b, force, K)
    write_face(f, w, touching, total, corner_out, block_out, touching_out)
    return clearance


@wp.kernel
def contact_force(
    # In:
    face: wp.array(dtype=wp.vec3i),
    area: wp.array(dtype=real),
    sample: wp.array(dtype=vec3),
    stiffness: real,
    stick_ratio: real,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    x_last: wp.array2d(dtype=vec3),
    anchor_geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
    force_out: wp.array2d(dtype=vec3),
):
    f, w = wp.tid()
    touch_face(
        f, w, face, area, sample, stiffness, stick_ratio, geoms, x, x_last, anchor_geom,
        anchor, corner_out, block_out, touching_out, geom_out, anchor_out, force_out,
    )  # fmt: skip


@wp.kernel
def core_contact_force(
    # In:
    face: wp.array(dtype=wp.vec3i),
    area: wp.array(dtype=real),
    sample: wp.array(dtype=vec3),
    stiffness: real,
    stick_ratio: real,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    x_last: wp.array2d(dtype=vec3),
    anchor_geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    # In and out:
    seen: wp.array2d(dtype=vec3),
    clearance: wp.array2d(dtype=real),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
    force_out: wp.array2d(dtype=vec3),
):
    """The same against geoms that never move: a face that has moved less than its clearance, since that was
    last seen, cannot touch."""
    f, w = wp.tid()
    t = face[f]
    moved = real(0.0)
    for c in range(3):
        moved = wp.max(moved, wp.length_sq(x[t[c], w] - seen[3 * f + c, w]))
    if wp.sqrt(moved) < clearance[f, w]:
        return
    free = touch_face(
        f, w, face, area, sample, stiffness, stick_ratio, geoms, x, x_last, anchor_geom,
        anchor, corner_out, block_out, touching_out, geom_out, anchor_out, force_out,
    )  # fmt: skip
    known = wp.isfinite(wp.length_sq(x[t[0], w]) + wp.length_sq(x[t[1], w]) + wp.length_sq(x[t[2], w]))
    clearance[f, w] = wp.where(
        known, free, real(-1.0)
    )  # nothing is known of a face without a place: looked at again, wherever it goes
    for c in range(3):
        seen[3 * f + c, w] = x[t[c], w]


@wp.kernel
def contact_product(
    # In:
    face: wp.array(dtype=wp.vec3i),
    touching: wp.array2d(dtype=int),
    block: wp.array2d(dtype=mat33),
    p: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    f, w = wp.tid()
    q0 = vec3()
    q1 = vec3()
    q2 = vec3()
    if touching[f, w] == 1:
        t = face[f]
        p0 = p[t[0], w]
        p1 = p[t[1], w]
        p2 = p[t[2], w]
        b01 = block[6 * f + 1, w]
        b02 = block[6 * f + 2, w]
        b12 = block[6 * f + 4, w]
        q0 = block[6 * f, w] * p0 + b01 * p1 + b02 * p2
        q1 = b01 * p0 + block[6 * f + 3, w] * p1 + b12 * p2
        q2 = b02 * p0 + b12 * p1 + block[6 * f + 5, w] * p2
    corner_out[3 * f, w] = q0
    corner_out[3 * f + 1, w] = q1
    corner_out[3 * f + 2, w] = q2


@wp.kernel
def contact_wrench(
    # In:
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    # Out:
    wrench_out: wp.array3d(dtype=real),
):
    """Force and torque about the origin of the surface ON each group of geoms [group, world, 6]."""
    group, w = wp.tid()
    nsample = sample.shape[0]
    total = vec3()
    torque = vec3()
    for f in range(face.shape[0]):
        if touching[f, w] == 1:
            t = face[f]
            for s in range(nsample):
                i = f * nsample + s
                g = geom[i, w]
                if g >= 0:
                    if geoms.group[g] == group:
                        b = sample[s]
                        p = b[0] * x[t[0], w] + b[1] * x[t[1], w] + b[2] * x[t[2], w]
                        total -= force[i, w]
                        torque -= wp.cross(p, force[i, w])
    for c in range(3):
        wrench_out[group, w, c] = total[c]
        wrench_out[group, w, 3 + c] = torque[c]
