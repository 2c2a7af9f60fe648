"""Contact force at the samples of a face: penalty contact, adhesion, friction with stick and slip; and its
sums over faces.

The normal traction is k * overclosure. Friction is a spring k * stick_ratio to an anchor that is fixed on the
geom, with radial return to mu times the normal force. Surfaces with a `law.ContactLaw` have kernels of their
own, with pressure-dependent friction and adhesion. Kernels of Coulomb's law may have smoothed kinks, for
gradients. The CPU evaluates face by face; on CUDA each sample has a thread, and a block sums its faces.
"""

import functools
import types

import warp as wp

from ...kernels import kernel_module
from ..block import block_memory
from ..types import mat33, real, vec3
from .broadphase import ALL, ClearanceCache, contact_range, face_clearance, has, store_clearance
from .faces import Contact, Laws
from .meshes import smooth_distance
from .posed import (
    Geoms,
    convected_anchor,
    distance_from,
    face_radius,
    least_to,
    meet,
    meet_side,
    place_on,
    touch_bound,
)
from .shapes import distance, lower_bound, primitive_distance

# kinds of geoms that kernels support: one smooth mesh; and three kinds, each with the ones before
CORE, SOLIDS, MESHES, SKINS = "core", "solids", "meshes", "skins"
BLOCK = 256  # threads of a block of `by_sample`, and the most samples of a face
# Friction modes: the bound is mu times the current normal force, with a symmetric tangent (CURRENT) or with
# the exact one (CONSISTENT); it is stored as well (RECORDED); it is the stored one of an earlier equilibrium
# (LAGGED), and acts also where the sample leaves the geom, so that the forces have a potential
CURRENT, CONSISTENT, RECORDED, LAGGED = (wp.constant(i) for i in range(4))
_LEAST_PRESSURE = 1e-2  # over friction_pressure: below it the coefficient is constant


@wp.func
def stick_or_slip(local: vec3, stick: vec3, normal: vec3, most: real, kt: real):
    """Coulomb friction at `local` by a spring kt [N/m] to the anchor `stick`, of at most `most` [N]: force,
    its tangent, new anchor."""
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
def normal_traction(k: real, peak: real, reach: real, gap: real):
    """Normal traction (negative: adhesion) and its slope, which is 0 on the softening branch, for contact
    springs k; per area, or all for the same area."""
    if k * gap <= peak:
        return wp.vec2d(-k * gap, k)
    return wp.vec2d(-peak * (reach - gap) / (reach - peak / k), real(0.0))


@wp.func
def adhesive_traction(laws: Laws, w: int, k: real, area: real, gap: real, bonded: int):
    """`normal_traction` of a sample of a law's surface, and whether it is bonded then. A bond that is there
    takes the work of separation."""
    joined = real(2.0) * laws.work[w] * area  # peak force times range
    work = joined
    if bonded == 1:
        work = real(2.0) * laws.separation[w] * area
    peak = real(0.0)
    if laws.reach[w] > real(0.0):
        peak = work / laws.reach[w]
        joined = joined / laws.reach[w]
    bond = int(bonded)
    if k * gap <= joined:
        bond = 1
    return normal_traction(k, peak, laws.reach[w], gap), bond


@wp.func
def pressed_friction(laws: Laws, w: int, corner: wp.vec3i, b: vec3):
    """Factors of a law's power of the pressure, at barycentric coordinates b of a face: on the friction
    coefficient, and of the slope of the slip force over the normal force."""
    pressure = real(0.0)
    slope = real(1.0)
    for n in range(3):
        pressure += b[n] * laws.node_normal_force[corner[n], w] / laws.node_area[corner[n]]
    if pressure > real(_LEAST_PRESSURE) * laws.pressure[w]:
        slope = real(1.0) - laws.exponent[w]
    pressure = wp.max(pressure, real(_LEAST_PRESSURE) * laws.pressure[w])
    return wp.pow(pressure / laws.pressure[w], -laws.exponent[w]), slope


@wp.func
def smooth_traction(k: real, width: real, gap: real):
    """Normal traction and its slope of contact springs k: a parabola between the gaps `width` and -`width`,
    linear beyond. Without a width the slope has a kink at zero."""
    if gap <= -width:
        return wp.vec2d(-k * gap, k)
    within = width - gap
    return wp.vec2d(real(0.25) * k * within * within / width, real(0.5) * k * within / width)


@wp.func
def smooth_stick_or_slip(local: vec3, stick: vec3, normal: vec3, most: real, kt: real, width: real):
    """`stick_or_slip` with a parabola around the start of slip: within h = w d / (w + d) of the stretch d at
    which Coulomb friction slips, so that the kink of light contact is smooth as well."""
    slip = local - stick
    slip = slip - wp.dot(slip, normal) * normal
    length = wp.length(slip)
    tangent = wp.identity(n=3, dtype=real) - wp.outer(normal, normal)
    force = -kt * slip
    K = kt * tangent
    anchor = stick
    most_stretch = most / kt
    half = width * most_stretch / (width + most_stretch)
    if length > most_stretch - half:
        along = slip / length
        over = length - most_stretch + half
        stretch = most_stretch
        slope = real(0.0)
        if over < real(2.0) * half:
            stretch = length - real(0.25) * over * over / half
            slope = real(1.0) - real(0.5) * over / half
        force = -kt * stretch * along
        K = kt * (stretch / length * (tangent - wp.outer(along, along)) + slope * wp.outer(along, along))
        # where Coulomb friction slips, its anchor has the point's normal component
        kept = real(1.0) - slope
        kept = kept * kept * (real(3.0) - real(2.0) * kept)
        anchor = stick + (length - stretch) * along + kept * (local - stick - length * along)
    return force, K, anchor


@wp.func
def slide(local: vec3, stick: vec3, normal: vec3, most: real, kt: real, width: real):
    """`smooth_stick_or_slip`, or without a width `stick_or_slip`."""
    if width > real(0.0):
        return smooth_stick_or_slip(local, stick, normal, most, kt, width)
    return stick_or_slip(local, stick, normal, most, kt)


# Sums of a face over its samples, in their order: 9 numbers of its corners and, where it touches, 6 blocks of
# 9 numbers. On CUDA all threads of a block take part; f is negative in a thread without a sample. Returns
# the least clearance of the face, -1 where a sample touches. On the CPU the one thread adds the samples that
# touch, one after the other, and tells the first: so many sums in variables were copied for each sample.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    typedef double numbers[16];
    typedef int names[3];
    numbers* value = (numbers*)memory;
    names* item = (names*)(value + blockDim.x);
    const int thread = threadIdx.x, faces = blockDim.x / nsample;
    for (int i = 0; i < 3; ++i) {
        value[thread][i] = force[i];
        for (int j = 0; j < 3; ++j) value[thread][3 + 3 * i + j] = K.data[i][j];
    }
    for (int i = 0; i < 3; ++i) value[thread][12 + i] = at[i];
    value[thread][15] = free_;
    item[thread][0] = f;
    item[thread][1] = w;
    __syncthreads();
    double least = free_;
    const int own = thread - thread % nsample;
    for (int s = 0; s < nsample && own < faces * nsample; ++s) least = fmin(least, value[own + s][15]);
    item[thread][2] = least <= -1.0;
    __syncthreads();
    for (int o = thread; o < 63 * faces; o += blockDim.x) {
        const int begin = o / 63 * nsample, column = o % 63;
        if (item[begin][0] < 0) break;
        double total = 0.0;
        if (column < 9) {
            for (int s = 0; s < nsample; ++s)
                total += value[begin + s][12 + column / 3] * value[begin + s][column % 3];
            const int row = 3 * item[begin][0] + column / 3;
            (*wp::address(corner, row, item[begin][1]))[column % 3] = total;
        } else if (item[begin][2]) {
            const int block = column / 9 - 1, a = block < 3 ? 0 : block < 5 ? 1 : 2;
            const int b = block < 3 ? block : block < 5 ? block - 2 : 2, entry = column % 9;
            for (int s = 0; s < nsample; ++s)
                total += value[begin + s][12 + a] * value[begin + s][12 + b] * value[begin + s][3 + entry];
            const int row = 6 * item[begin][0] + block;
            ((double*)wp::address(blocks, row, item[begin][1]))[entry] = total;
        }
    }
    __syncthreads();
    return least;
#else
    double* blocks_[6];
    for (int i = 0; i < 6; ++i) blocks_[i] = (double*)wp::address(blocks, 6 * f + i, w);
    for (int a = 0, i = 0; a < 3; ++a) {
        double* to = (double*)wp::address(corner, 3 * f + a, w);
        for (int j = 0; j < 3; ++j) to[j] = (first ? 0.0 : to[j]) + at[a] * force[j];
        for (int b = a; b < 3; ++b, ++i) {
            const double weight = at[a] * at[b];
            const double* k = &K.data[0][0];
            for (int j = 0; j < 9; ++j) blocks_[i][j] = (first ? 0.0 : blocks_[i][j]) + weight * k[j];
        }
    }
    return free_;
#endif
""")
def add_samples(
    f: int,
    w: int,
    first: int,
    free_: real,
    force: vec3,
    K: mat33,
    at: vec3,
    nsample: int,
    corner: wp.array2d(dtype=vec3),
    blocks: wp.array2d(dtype=mat33),
    memory: wp.uint64,
) -> real: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 0;
#else
    return 1;
#endif
""")
def one_thread() -> int:
    """1 on the CPU, where a block is one thread, else 0: known to the compiler."""
    ...


@functools.cache
def _samples_function(has_law: bool, smooth: bool, shapes: str) -> wp.Function:
    """`touch_samples` for `contact_kernels`."""

    # The loop over samples is in here: on the CPU a call copies all that Geoms and Contact hold, which takes
    # as long as a sample does
    @wp.func
    def touch_samples(
        f: int,
        begin: int,
        end: int,
        w: int,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        c: Contact,
        friction_mode: int,
        near: wp.int64,
    ):
        """Contact of the samples begin to end - 1 of face f with a set of geoms: whether they touch, their
        least clearance [m], and of the last one force [N], tangent [N/m] and barycentric coordinates at which
        the force acts. On the CPU they are added to the face's sums."""
        t = c.face[f]
        x0 = x[t[0], w]
        x1 = x[t[1], w]
        x2 = x[t[2], w]
        nsample = c.sample.shape[0]
        radius = face_radius(x1 - x0, x2 - x0)
        touching = int(0)
        clearance = real(1.0)
        force = vec3()
        K = mat33()
        at = vec3()
        for s in range(begin, end):
            i = f * nsample + s
            b = c.sample[s]
            area = c.area[f] / real(nsample)
            k = c.stiffness[w] * area
            p = b[0] * x0 + b[1] * x1 + b[2] * x2
            touched = int(-1)
            reach = real(0.0)
            if wp.static(has_law):
                reach = c.laws.reach[w]
            width = real(0.0)
            if wp.static(smooth):
                width = c.laws.smoothing[w]
                reach = width
            gap = reach
            if friction_mode == LAGGED and c.bound.shape[0] > i:
                gap = wp.where(c.bound[i, w] > real(0.0), real(wp.inf), reach)
            normal = vec3()
            local = vec3()
            at = b
            weight = real(1.0)
            for g in range(geoms.count):
                if not has(near, g) or c.bonded[f] == 1:
                    continue
                y = place_on(geoms, g, w, p)
                if wp.static(shapes == SKINS):
                    dn = distance_from(geoms, g, p, y, geoms.mat[g, w])
                    clearance = wp.min(clearance, touch_bound(geoms, g, y, least_to(geoms, g, dn[3]), radius))
                elif wp.static(shapes == CORE):
                    dn = smooth_distance(geoms.grids, geoms.grid[g], y)
                    least = lower_bound(geoms.kind[g], geoms.grids, geoms.grid[g], dn[3])
                    clearance = wp.min(clearance, least)
                elif wp.static(shapes == MESHES):
                    dn = distance(
                        geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y
                    )
                    least = lower_bound(geoms.kind[g], geoms.grids, geoms.grid[g], dn[3])
                    clearance = wp.min(clearance, touch_bound(geoms, g, y, least, radius))
                else:
                    dn = primitive_distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], y)
                    clearance = wp.min(clearance, touch_bound(geoms, g, y, dn[3], radius))
                if wp.static(shapes == CORE):
                    met = meet_side(dn, b)
                else:
                    met = meet(geoms, g, w, y, dn, b, x1 - x0, x2 - x0, wp.static(int(shapes != SOLIDS)))
                if met.gap < gap:
                    gap = met.gap
                    touched = g
                    normal = met.normal
                    at = met.at
                    weight = met.weight
                    local = y
            force = vec3()
            K = mat33()
            stick = local
            bond = touched
            if touched >= 0:
                k = k * weight
                area = area * weight
                mu = geoms.friction[touched, w]
                slope_factor = real(1.0)  # of the slip force over the normal force: exponent of its power law
                fn = -k * gap
                if wp.static(has_law):
                    bonded = wp.where(c.anchor_geom[i, w] == touched, 1, 0)
                    traction, bonded = adhesive_traction(c.laws, w, k, area, gap, bonded)
                    bond = wp.where(bonded == 1, touched, -1)
                    fn = traction[0]
                    K = traction[1] * wp.outer(normal, normal)
                    if c.laws.exponent[w] != real(0.0):
                        weaker, slope_factor = pressed_friction(c.laws, w, t, b)
                        mu = mu * weaker
                else:
                    K = k * wp.outer(normal, normal)
                if wp.static(smooth):
                    push = smooth_traction(k, width, gap)
                    fn = push[0]
                    K = push[1] * wp.outer(normal, normal)
                if gap >= reach:
                    fn = real(0.0)
                    K = mat33()
                # K leaves out how a smooth surface turns the normal: with it the tangent is not definite, and
                # Newton's method finds equilibria that are not stable
                force = fn * normal
                if friction_mode == RECORDED and mu > real(0.0):
                    c.bound[i, w] = wp.max(mu * fn, real(0.0))
                if mu > real(0.0) and (fn > real(0.0) or friction_mode == LAGGED):
                    if c.anchor_geom[i, w] == touched:
                        stick = c.anchor[i, w]
                    else:  # new contact: slip counts from where it was on the geom when the step began
                        last = b[0] * c.x_last[t[0], w] + b[1] * c.x_last[t[1], w] + b[2] * c.x_last[t[2], w]
                        stick = wp.transpose(geoms.mat_last[touched, w]) * (last - geoms.pos_last[touched, w])
                    if wp.static(shapes == SKINS):
                        stick = convected_anchor(geoms, touched, w, stick, local)
                    most = mu * fn
                    if friction_mode == LAGGED:
                        most = c.bound[i, w]
                    start = stick
                    ft, Kt, stick = slide(local, start, normal, most, k * c.stick_ratio, width)
                    force = force + ft
                    slips = wp.length_sq(stick - start) > real(0.0)
                    if friction_mode == CONSISTENT and width == real(0.0) and slips:
                        Kt = Kt + slope_factor * mu / most * wp.outer(ft, K * normal)
                    K = K + Kt
                R = geoms.mat[touched, w]
                force = R * force
                K = R * K * wp.transpose(R)
                c.trial_anchor[i, w] = stick
                c.sample_force[i, w] = force
                if one_thread() == 1:
                    first = 1 - touching
                    add_samples(
                        f, w, first, clearance, force, K, at, nsample, c.corner, c.block, block_memory()
                    )
                touching = 1
            c.trial_geom[i, w] = touched
            c.bond[i, w] = bond
        return touching, clearance, force, K, at

    return touch_samples


@functools.cache
def _faces_functions(has_law: bool, smooth: bool, shapes: str) -> tuple[wp.Function, wp.Function]:
    """`touch_face` and `touch_faces` for `contact_kernels`."""
    touch_samples = _samples_function(has_law, smooth, shapes)

    @wp.func
    def leave_face(f: int, w: int, c: Contact):
        """Face f touches nothing."""
        c.touching[f, w] = 0
        for a in range(3):
            c.corner[3 * f + a, w] = vec3()

    @wp.func
    def touch_face(
        f: int,
        w: int,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        c: Contact,
        friction_mode: int,
        near: wp.int64,
    ):
        """Evaluates face f on the CPU; returns a lower bound of its clearance [m], -1 where it touches."""
        touching, clearance, _force, _K, _at = touch_samples(
            f, 0, c.sample.shape[0], w, geoms, x, c, friction_mode, near
        )
        if touching == 1:  # evaluated again, for any range of adhesion
            clearance = real(-1.0)
            c.touching[f, w] = 1
        else:
            leave_face(f, w, c)
        return clearance

    @wp.func
    def touch_faces(
        w: int,
        t: int,
        threads: int,
        count: int,
        listed: wp.array2d(dtype=int),
        near: wp.array2d(dtype=wp.int64),
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        c: Contact,
        friction_mode: int,
        travel: real,
        free: wp.array2d(dtype=real),
    ):
        """Evaluates the first `count` faces listed[w], each with its set of geoms near[w, face], by a block
        with one sample for each thread, or on the CPU by a single thread, which leaves out geoms that the
        face's ball does not touch. free[w, face] becomes travel plus a lower bound of the face's clearance,
        less than travel where it touches [m]."""
        if one_thread() == 1:
            for n in range(count):
                f = listed[w, n]
                v = c.face[f]
                _least, clearance, met, within = face_clearance(
                    x[v[0], w], x[v[1], w], x[v[2], w], w, geoms, near[w, f], contact_range(c.laws, w)
                )
                if met == 0:
                    leave_face(f, w, c)
                else:
                    clearance = wp.min(clearance, touch_face(f, w, geoms, x, c, friction_mode, within))
                free[w, f] = travel + clearance
            return
        nsample = c.sample.shape[0]
        parallel_faces = threads // nsample
        s = t % nsample
        for first in range(0, count, parallel_faces):
            k = first + t // nsample
            mine = int(-1)
            clearance = real(1.0)
            force = vec3()
            K = mat33()
            at = vec3()
            if k < count and t < parallel_faces * nsample:
                mine = listed[w, k]
                touching, clearance, force, K, at = touch_samples(
                    mine, s, s + 1, w, geoms, x, c, friction_mode, near[w, mine]
                )
                if touching == 1:
                    clearance = real(-1.0)
            clearance = add_samples(
                mine, w, 0, clearance, force, K, at, nsample, c.corner, c.block, block_memory()
            )  # fmt: skip
            if mine >= 0 and s == 0:
                c.touching[mine, w] = wp.where(clearance > real(-1.0), 0, 1)
                free[w, mine] = travel + clearance

    return touch_face, touch_faces


@functools.cache
def contact_kernels(has_law: bool, smooth: bool, shapes: str) -> types.SimpleNamespace:
    """Kernels `by_face` and `by_sample`, and `touch_faces`, a function for the threads of a block.

    Args:
      has_law: whether surfaces have a ContactLaw. smooth: whether Coulomb's law has smoothed kinks.
      shapes: CORE, SOLIDS, MESHES or SKINS; fewer kinds take fewer registers.
    """
    law = "lawful" if has_law else "smooth" if smooth else "coulomb"
    module = kernel_module(f"{__name__}.{law}_{shapes}")
    touch_samples = _samples_function(has_law, smooth, shapes)
    touch_face, touch_faces = _faces_functions(has_law, smooth, shapes)

    @wp.kernel(module=module)
    def by_face(
        # In:
        threads: int,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        friction_mode: wp.array(dtype=int),
        # In and out:
        cache: ClearanceCache,
        contact: Contact,
    ):
        """Contact of the faces that the broad phase listed."""
        for at in range(wp.tid(), cache.count[1], threads):
            f = cache.near[at] // x.shape[1]
            w = cache.near[at] % x.shape[1]
            t = contact.face[f]
            clearance = touch_face(f, w, geoms, x, contact, friction_mode[w], ALL)
            store_clearance(f, w, x[t[0], w], x[t[1], w], x[t[2], w], clearance, cache)

    @wp.kernel(module=kernel_module(f"{module}.listed"), launch_bounds=(BLOCK, 2))
    def by_sample(
        # In:
        blocks: int,
        geoms: Geoms,
        x: wp.array2d(dtype=vec3),
        friction_mode: wp.array(dtype=int),
        # In and out:
        cache: ClearanceCache,
        contact: Contact,
    ):
        """Contact of the listed faces with a thread for each sample, for CUDA."""
        block, thread = wp.tid()
        nsample = contact.sample.shape[0]
        count = cache.count[1]
        parallel_faces = BLOCK // nsample
        s = thread % nsample
        for first in range(block * parallel_faces, count, blocks * parallel_faces):
            at = first + thread // nsample
            f = int(-1)
            w = int(0)
            clearance = real(1.0)
            force = vec3()
            K = mat33()
            push = vec3()
            t = wp.vec3i()
            if at < count and thread < parallel_faces * nsample:
                f = cache.near[at] // x.shape[1]
                w = cache.near[at] % x.shape[1]
                t = contact.face[f]
                touching, clearance, force, K, push = touch_samples(
                    f, s, s + 1, w, geoms, x, contact, friction_mode[w], ALL
                )
                if touching == 1:
                    clearance = real(-1.0)  # evaluated again, for any range of adhesion
            clearance = add_samples(
                f, w, 0, clearance, force, K, push, nsample, contact.corner, contact.block, block_memory()
            )  # fmt: skip
            if f >= 0 and s == 0:
                contact.touching[f, w] = wp.where(clearance > real(-1.0), 0, 1)
                store_clearance(f, w, x[t[0], w], x[t[1], w], x[t[2], w], clearance, cache)

    return types.SimpleNamespace(
        touch_faces=touch_faces,
        by_face=by_face,
        by_sample=by_sample,
    )
