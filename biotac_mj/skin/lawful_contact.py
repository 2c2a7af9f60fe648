"""Contact of a skin's outer surface by a `ContactLaw`: adhesion, and friction that depends on pressure. See
`contact_law` for the law."""

import warp as wp

from .contact import FaceSum, Geoms, stick_or_slip, with_sample, write_face
from .shapes import distance, distance_bound
from .types import mat33, real, vec3

__all__ = ["Laws", "lawful_contact_force", "push"]

wp.set_module_options({"enable_backward": False})

_LEAST = 1e-2  # of friction_pressure: below this pressure the coefficient stays


@wp.struct
class Laws:
    """One number for each world: n; W of coming together and of parting [J/m^2]; range [m]. For all: p0 [Pa];
    nodal areas [m^2]."""

    exponent: wp.array(dtype=real)
    work: wp.array(dtype=real)
    parting: wp.array(dtype=real)
    reach: wp.array(dtype=real)
    pressure: real
    node_area: wp.array(dtype=real)


@wp.func
def normal_traction(k: real, peak: real, reach: real, gap: real):
    """Push (negative: pull) per area and its slope where it is not softening, for contact springs k; all
    three in one unit of area."""
    if k * gap <= peak:
        return wp.vec2d(-k * gap, k)
    return wp.vec2d(-peak * (reach - gap) / (reach - peak / k), real(0.0))


@wp.kernel
def push(
    # In:
    face: wp.array(dtype=wp.vec3i),
    area: wp.array(dtype=real),
    sample: wp.array(dtype=vec3),
    stiffness: real,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    """Size of the normal push on the corners of every face [N], as the first component."""
    f, w = wp.tid()
    t = face[f]
    c0 = x[t[0], w]
    center = (c0 + x[t[1], w] + x[t[2], w]) / real(3.0)
    radius = wp.max(
        wp.length(c0 - center), wp.max(wp.length(x[t[1], w] - center), wp.length(x[t[2], w] - center))
    )
    total = vec3()
    k = stiffness * area[f] / real(sample.shape[0])
    for g in range(geoms.count):
        R = wp.transpose(geoms.mat[g, w])
        y = R * (center - geoms.pos[g, w])
        if (
            distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
            < radius
        ):
            for s in range(sample.shape[0]):
                b = sample[s]
                y = R * (b[0] * c0 + b[1] * x[t[1], w] + b[2] * x[t[2], w] - geoms.pos[g, w])
                dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
                total += wp.max(-k * dn[3], real(0.0)) * b
    for c in range(3):
        corner_out[3 * f + c, w] = vec3(total[c], real(0.0), real(0.0))


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
    share: real,
    node_push: wp.array2d(dtype=vec3),
    laws: Laws,
    geoms: Geoms,
    x_last: wp.array2d(dtype=vec3),
    anchor_geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
):
    """Contact of sample i with its share of area [m^2]: geom (-1: none), the geom that it has touched, force
    [N], its tangent [N/m], anchor."""
    p = b[0] * x0 + b[1] * x1 + b[2] * x2
    touched = int(-1)
    gap = laws.reach[w]
    normal = vec3()
    local = vec3()
    for g in range(geoms.count):
        R = geoms.mat[g, w]
        y = wp.transpose(R) * (p - geoms.pos[g, w])
        dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        if dn[3] < gap:
            gap = dn[3]
            touched = g
            normal = vec3(dn[0], dn[1], dn[2])
            local = y
    force = vec3()
    K = mat33()
    stick = local
    bond = int(-1)
    if touched >= 0:
        joined = real(2.0) * laws.work[w] * share  # peak force times range
        work = joined
        if anchor_geom[i, w] == touched:
            work = real(2.0) * laws.parting[w] * share
            bond = touched
        peak = real(0.0)
        if laws.reach[w] > real(0.0):
            peak = work / laws.reach[w]
            joined = joined / laws.reach[w]
        if k * gap <= joined:
            bond = touched
        tn = normal_traction(k, peak, laws.reach[w], gap)
        fn = tn[0]
        force = fn * normal
        K = tn[1] * wp.outer(normal, normal)
        mu = geoms.friction[touched, w]
        if mu > real(0.0) and fn > real(0.0):
            if laws.exponent[w] != real(0.0):
                pressure = real(0.0)
                for c in range(3):
                    pressure += b[c] * node_push[t[c], w][0] / laws.node_area[t[c]]
                pressure = wp.max(pressure, real(_LEAST) * laws.pressure)
                mu = mu * wp.pow(pressure / laws.pressure, -laws.exponent[w])
            if anchor_geom[i, w] == touched:
                stick = anchor[i, w]
            else:
                last = b[0] * x_last[t[0], w] + b[1] * x_last[t[1], w] + b[2] * x_last[t[2], w]
                stick = wp.transpose(geoms.mat_last[touched, w]) * (last - geoms.pos_last[touched, w])
            ft, Kt, stick = stick_or_slip(local, stick, normal, mu * fn, kt)
            force = force + ft
            K = K + Kt
        R = geoms.mat[touched, w]
        force = R * force
        K = R * K * wp.transpose(R)
    return touched, bond, force, K, stick


@wp.kernel
def lawful_contact_force(
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
    laws: Laws,
    node_push: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
    force_out: wp.array2d(dtype=vec3),
    bond_out: wp.array2d(dtype=int),
):
    """As `contact.contact_force`; bond_out: the geom that a sample is in contact with, or has been and is
    still in range of."""
    f, w = wp.tid()
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
    for g in range(geoms.count):
        R = geoms.mat[g, w]
        y = wp.transpose(R) * (center - geoms.pos[g, w])
        bound = distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        if bound < radius + laws.reach[w]:
            near = 1
    touching = int(0)
    total = FaceSum()
    share = area[f] / real(nsample)
    k = stiffness * area[f] / real(nsample)
    kt = k * stick_ratio
    for s in range(nsample):
        i = f * nsample + s
        geom_out[i, w] = -1
        bond_out[i, w] = -1
        if near == 1:
            b = sample[s]
            touched, bond, force, K, stick = touch_sample(
                i, w, b, t, x0, x1, x2, k, kt, share, node_push, laws, geoms, x_last, anchor_geom, anchor
            )
            if touched >= 0:
                touching = 1
                geom_out[i, w] = touched
                bond_out[i, w] = bond
                anchor_out[i, w] = stick
                force_out[i, w] = force
                total = with_sample(total, b, force, K)
    write_face(f, w, touching, total, corner_out, block_out, touching_out)
