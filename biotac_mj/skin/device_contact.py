"""Contact of all worlds on the device: far faces are left out, near ones evaluated by the same law as on the
host."""

import warp as wp

from .contact import Geoms, touch_face, touch_sample
from .shapes import distance_bound
from .types import mat33, real, vec3

__all__ = [
    "block_index",
    "commit_contacts",
    "contact_inside_core",
    "crushed_on_core",
    "cull_faces",
    "near_contact",
    "partial_wrench",
    "sample_contact",
    "sum_samples",
    "sum_wrench",
]

wp.set_module_options({"enable_backward": False})


@wp.func
def block_index(a: int, b: int):
    """Which of the six stored blocks of a face couples corners a <= b: 00 01 02 11 12 22."""
    return a * (5 - a) // 2 + b


@wp.func
def known_clearance(x0: vec3, x1: vec3, x2: vec3, free: real):
    """Nothing is known of a face without a place: it is looked at again, wherever it goes."""
    if wp.isfinite(wp.length_sq(x0) + wp.length_sq(x1) + wp.length_sq(x2)):
        return free
    return real(-1.0)


@wp.kernel
def cull_faces(
    # In:
    still: int,
    nsample: int,
    face: wp.array(dtype=wp.vec3i),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # In and out:
    seen: wp.array2d(dtype=vec3),
    clearance: wp.array2d(dtype=real),
    touching: wp.array2d(dtype=int),
    # Out:
    near_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
):
    """Which faces may touch: by one distance of their centre. Where the geoms are still, a face that has
    moved less than its clearance, since that was last seen, needs not even that; what was said of it
    holds."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    t = face[f]
    x0 = x[t[0], w]
    x1 = x[t[1], w]
    x2 = x[t[2], w]
    if still == 1:
        a = wp.length_sq(x0 - seen[3 * f, w])
        b = wp.length_sq(x1 - seen[3 * f + 1, w])
        c = wp.length_sq(x2 - seen[3 * f + 2, w])
        if wp.sqrt(wp.max(a, wp.max(b, c))) < clearance[f, w]:
            near_out[f, w] = 0
            return
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(
        wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center)))
    )
    near = int(0)
    free = real(1.0)
    for g in range(geoms.count):
        y = wp.transpose(geoms.mat[g, w]) * (center - geoms.pos[g, w])
        bound = distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        free = wp.min(free, bound - radius)
        if bound < radius:
            near = 1
    near_out[f, w] = near
    if near == 0:
        if touching[f, w] == 1:
            touching[f, w] = 0
            for s in range(nsample):
                geom_out[f * nsample + s, w] = -1
        if still == 1:
            clearance[f, w] = known_clearance(x0, x1, x2, free)
            seen[3 * f, w] = x0
            seen[3 * f + 1, w] = x1
            seen[3 * f + 2, w] = x2


@wp.kernel
def near_contact(
    # In:
    still: int,
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
    on: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
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
    """Contact of the near faces."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    if near[f, w] == 0:
        return
    free = touch_face(
        f, w, face, area, sample, stiffness, stick_ratio, geoms, x, x_last, anchor_geom,
        anchor, corner_out, block_out, touching_out, geom_out, anchor_out, force_out,
    )  # fmt: skip
    if still == 1:
        t = face[f]
        clearance[f, w] = known_clearance(x[t[0], w], x[t[1], w], x[t[2], w], free)
        for c in range(3):
            seen[3 * f + c, w] = x[face[f][c], w]


@wp.kernel
def sample_contact(
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
    on: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    # Out:
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
    force_out: wp.array2d(dtype=vec3),
    gap_out: wp.array2d(dtype=real),
    tangent_out: wp.array2d(dtype=mat33),
):
    """The same by samples, for few worlds: `sum_samples` then adds up the faces."""
    i, w = wp.tid()
    f = i // sample.shape[0]
    if on[w] == 0:
        return
    if near[f, w] == 0:
        return
    t = face[f]
    k = stiffness * area[f] / real(sample.shape[0])
    touched, gap, force, K, stick = touch_sample(
        i,
        w,
        sample[i % sample.shape[0]],
        t,
        x[t[0], w],
        x[t[1], w],
        x[t[2], w],
        k,
        k * stick_ratio,
        geoms,
        x_last,
        anchor_geom,
        anchor,
    )
    geom_out[i, w] = touched
    gap_out[i, w] = gap
    if touched >= 0:
        anchor_out[i, w] = stick
        force_out[i, w] = force
        tangent_out[i, w] = K


@wp.kernel
def sum_samples(
    # In:
    still: int,
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    gap: wp.array2d(dtype=real),
    tangent: wp.array2d(dtype=mat33),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
    seen: wp.array2d(dtype=vec3),
    clearance: wp.array2d(dtype=real),
):
    """Corner c of a face adds up its force, and two of the six blocks of the tangent."""
    f, c, w = wp.tid()
    if on[w] == 0:
        return
    if near[f, w] == 0:
        return
    nsample = sample.shape[0]
    touching = int(0)
    total = vec3()
    first = mat33()  # block c c
    second = mat33()  # block c (c + 1)
    free = real(1.0)
    d = (c + 1) % 3
    for s in range(nsample):
        i = f * nsample + s
        free = wp.min(free, gap[i, w])
        if geom[i, w] >= 0:
            touching = 1
            b = sample[s]
            total += b[c] * force[i, w]
            K = tangent[i, w]
            first += (b[c] * b[c]) * K
            second += (b[c] * b[d]) * K
    corner_out[3 * f + c, w] = total
    if touching == 1:
        block_out[6 * f + block_index(c, c), w] = first
        block_out[6 * f + block_index(wp.min(c, d), wp.max(c, d)), w] = second
    if c == 0:
        touching_out[f, w] = touching
        if still == 1:
            t = face[f]
            clearance[f, w] = known_clearance(x[t[0], w], x[t[1], w], x[t[2], w], free)
    if still == 1:
        seen[3 * f + c, w] = x[face[f][c], w]


@wp.kernel
def partial_wrench(
    # In:
    chunk: int,
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    # Out:
    part_out: wp.array3d(dtype=vec3),
    touched_by: wp.array2d(dtype=int),
):
    """Force and torque of a chunk of faces ON each group of geoms [2 group + (0, 1), chunk, world]; marks
    geoms that touch."""
    c, w = wp.tid()
    for k in range(part_out.shape[0]):
        part_out[k, c, w] = vec3()
    nsample = sample.shape[0]
    for f in range(c * chunk, wp.min((c + 1) * chunk, face.shape[0])):
        if touching[f, w] == 1:
            t = face[f]
            for s in range(nsample):
                i = f * nsample + s
                g = geom[i, w]
                if g >= 0:
                    b = sample[s]
                    p = b[0] * x[t[0], w] + b[1] * x[t[1], w] + b[2] * x[t[2], w]
                    k = 2 * geoms.group[g]
                    part_out[k, c, w] = part_out[k, c, w] - force[i, w]
                    part_out[k + 1, c, w] = part_out[k + 1, c, w] - wp.cross(p, force[i, w])
                    touched_by[g, w] = 1


@wp.kernel
def sum_wrench(part: wp.array3d(dtype=vec3), wrench_out: wp.array3d(dtype=real)):
    """Wrench on each group of geoms [group, world, 6]."""
    k, w = wp.tid()
    total = vec3()
    for c in range(part.shape[1]):
        total += part[k, c, w]
    for a in range(3):
        wrench_out[k // 2, w, 3 * (k % 2) + a] = total[a]


@wp.kernel
def commit_contacts(
    # In:
    nsample: int,
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    # In and out:
    kept: wp.array2d(dtype=int),
    # Out:
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
):
    """Anchors of the faces that touch, and that touched when the last step ended, become those that the next
    step starts from."""
    f, w = wp.tid()
    if touching[f, w] == 0 and kept[f, w] == 0:
        return
    kept[f, w] = touching[f, w]
    for s in range(nsample):
        i = f * nsample + s
        geom_out[i, w] = -1
        if touching[f, w] == 1:
            geom_out[i, w] = geom[i, w]
            anchor_out[i, w] = anchor[i, w]


@wp.kernel
def crushed_on_core(
    # In:
    limit: real,
    face: wp.array(dtype=wp.vec3i),
    core: Geoms,
    x: wp.array2d(dtype=vec3),
    asked: wp.array(dtype=int),
    # Out:
    failed_out: wp.array(dtype=int),
):
    """Marks worlds with a corner of the inner surface deeper in the core than the limit: on its way through,
    see `solver._possible`."""
    f, w = wp.tid()
    if asked[w] == 0:
        return
    R = wp.transpose(core.mat[0, w])
    for c in range(3):
        y = R * (x[face[f][c], w] - core.pos[0, w])
        if distance_bound(core.kind[0], core.size[0], core.rounding[0], core.grids, core.grid[0], y) < -limit:
            failed_out[w] = 1


@wp.kernel
def contact_inside_core(
    # In:
    chunk: int,
    limit: real,
    core_vert: wp.array(dtype=vec3),
    geoms: Geoms,
    # Out:
    deep_out: wp.array(dtype=int),
):
    """Marks worlds in which a geom reaches deeper into the rigid core than the limit."""
    g, c, w = wp.tid()
    R = geoms.mat[g, w]
    for i in range(c * chunk, wp.min((c + 1) * chunk, core_vert.shape[0])):
        y = wp.transpose(R) * (core_vert[i] - geoms.pos[g, w])
        if (
            distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
            < -limit
        ):
            deep_out[w] = 1
