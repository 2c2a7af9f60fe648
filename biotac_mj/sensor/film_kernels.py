"""Kernels of `batch_film.py`: core, sheet, discs, factorisation, network. Arrays over worlds are [item,
world] unless they are tiles."""

import warp as wp

__all__ = [
    "NDISC",
    "TILE",
    "assemble",
    "clear_system",
    "cover_discs",
    "driving_point",
    "face_conductance",
    "film_surface",
    "solve_band",
]

wp.set_module_options({"enable_backward": False})

NDISC = 23  # 19 electrodes and X1..X4
TILE = 32  # rows of a tile, and columns of right-hand sides: the discs, padded
_MAX_GAP = 8.0  # [mm] how far from the core a node may be; a film is at most some 2 mm thick
real = wp.float64
vec3 = wp.vec3d
samples = wp.types.vector(24, int)
ground = wp.types.matrix((5, 5), wp.float64)


@wp.func
def _double(p: wp.vec3):
    return vec3(real(p[0]), real(p[1]), real(p[2]))


@wp.func
def nearest_on_core(mesh: wp.uint64, p: vec3):
    """Gap vector (foot to p) and its signed length [m]: nearest triangle of the core's mesh (in mm), exact on
    that one."""
    mm = real(1.0e3) * p
    query = wp.mesh_query_point_no_sign(
        mesh, wp.vec3(wp.float32(mm[0]), wp.float32(mm[1]), wp.float32(mm[2])), wp.float32(_MAX_GAP)
    )
    if not query.result:
        return wp.vec4d(real(0.0), real(0.0), real(0.0), real(wp.nan))
    a = _double(wp.mesh_get_point(mesh, 3 * query.face))
    ab = _double(wp.mesh_get_point(mesh, 3 * query.face + 1)) - a
    ac = _double(wp.mesh_get_point(mesh, 3 * query.face + 2)) - a
    n = wp.normalize(wp.cross(ab, ac))
    u = real(query.u)
    v = real(query.v)
    gap = mm - (u * a + v * (a + ab) + (real(1.0) - u - v) * (a + ac))
    edge = real(1.0e-5)
    if wp.min(u, wp.min(v, real(1.0) - u - v)) > edge:
        gap = wp.dot(mm - a, n) * n  # over the inside of a face: its plane, exactly
    d = wp.length(gap)
    if wp.dot(gap, n) < real(0.0):
        d = -d
    gap = real(1.0e-3) * gap
    return wp.vec4d(gap[0], gap[1], gap[2], real(1.0e-3) * d)


@wp.kernel
def film_surface(
    # In:
    due: wp.array(dtype=int),
    mesh: wp.uint64,
    node: wp.array(dtype=int),
    residual_film: real,
    x: wp.array2d(dtype=vec3),
    # Out:
    middle_out: wp.array2d(dtype=vec3),
    thickness_out: wp.array2d(dtype=real),
):
    """The surface halfway between skin and core, and the film's thickness [node, world]."""
    i, w = wp.tid()
    if due[w] == 0:
        return
    p = x[node[i], w]
    near = nearest_on_core(mesh, p)
    middle_out[i, w] = p - real(0.5) * vec3(near[0], near[1], near[2])
    thickness_out[i, w] = wp.where(near[3] == near[3], wp.max(near[3], residual_film), near[3])  # nan stays


@wp.kernel
def face_conductance(
    # In:
    due: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    conductivity: real,
    middle: wp.array2d(dtype=vec3),
    thickness: wp.array2d(dtype=real),
    # Out:
    edge_out: wp.array2d(dtype=real),
):
    """Conductance times cot / 2 of the angle opposite each edge, [3 face + corner, world]."""
    f, w = wp.tid()
    if due[w] == 0:
        return
    t = face[f]
    sheet = conductivity * (thickness[t[0], w] + thickness[t[1], w] + thickness[t[2], w]) / real(3.0)
    e0 = middle[t[2], w] - middle[t[1], w]
    e1 = middle[t[0], w] - middle[t[2], w]
    e2 = middle[t[1], w] - middle[t[0], w]
    area = wp.length(wp.cross(e0, e1))
    # a face squeezed to a line stays finite
    area = wp.max(area, real(1.0e-6) * (wp.length_sq(e0) + wp.length_sq(e1) + wp.length_sq(e2)))
    scale = real(0.5) * sheet / area
    edge_out[3 * f, w] = -scale * wp.dot(e1, e2)
    edge_out[3 * f + 1, w] = -scale * wp.dot(e2, e0)
    edge_out[3 * f + 2, w] = -scale * wp.dot(e0, e1)


@wp.kernel
def clear_system(
    # In:
    due: wp.array(dtype=int),
    # Out:
    band_out: wp.array3d(dtype=real),
    rhs_out: wp.array3d(dtype=real),
):
    w, i, j = wp.tid()
    if due[w] == 0:
        return
    band_out[w, i, j] = real(0.0)
    if i < rhs_out.shape[1]:
        rhs_out[w, i, j] = real(0.0)


@wp.kernel
def assemble(
    # In:
    due: wp.array(dtype=int),
    entry: wp.array(dtype=wp.vec2i),
    sign: wp.array(dtype=real),
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    edge: wp.array2d(dtype=real),
    # Out:
    band_out: wp.array3d(dtype=real),
):
    """Gathers the Laplacian's entries from the faces' edges; padding gets a diagonal of one."""
    e, w = wp.tid()
    if due[w] == 0:
        return
    total = real(0.0)
    for k in range(start[e], start[e + 1]):
        total += edge[slot[k], w]
    value = sign[e] * total
    if start[e] == start[e + 1]:
        value = real(1.0)
    if e == 0:
        value = (
            real(2.0) * value
        )  # holds the free constant; no current flows through it, so the impedances do not depend on it
    band_out[w, entry[e][0], entry[e][1]] = value


@wp.func
def _where_on_disc(q: vec3, pos: vec3, tangent1: vec3, tangent2: vec3):
    return wp.vec2d(wp.dot(q - pos, tangent1), wp.dot(q - pos, tangent2))


@wp.kernel
def cover_discs(
    # In:
    due: wp.array(dtype=int),
    pos: wp.array(dtype=vec3),
    tangent: wp.array2d(dtype=vec3),
    pair_start: wp.array(dtype=int),
    pair_face: wp.array(dtype=int),
    disc: wp.array(dtype=wp.vec2d),
    face: wp.array(dtype=wp.vec3i),
    footprint: real,
    middle: wp.array2d(dtype=vec3),
    thickness: wp.array2d(dtype=real),
    # Out:
    rhs_out: wp.array3d(dtype=real),
    local_out: wp.array2d(dtype=real),
):
    """Mean over each disc as weights of nodal values (columns of the right-hand side), and the mean thickness
    [disc, world]."""
    e, w = wp.tid()
    if due[w] == 0:
        return
    hits = samples()
    covered = int(0)
    local = real(0.0)
    for sweep in range(2):  # count how many faces lie over each sample, then share
        for k in range(pair_start[e], pair_start[e + 1]):
            t = face[pair_face[k]]
            a = _where_on_disc(middle[t[0], w], pos[e], tangent[e, 0], tangent[e, 1])
            b = _where_on_disc(middle[t[1], w], pos[e], tangent[e, 0], tangent[e, 1])
            c = _where_on_disc(middle[t[2], w], pos[e], tangent[e, 0], tangent[e, 1])
            low = wp.min(a, wp.min(b, c))
            high = wp.max(a, wp.max(b, c))
            if wp.max(low[0], low[1]) <= footprint and wp.min(high[0], high[1]) >= -footprint:
                e1 = b - a
                e2 = c - a
                area = e1[0] * e2[1] - e1[1] * e2[0]
                for i in range(24):
                    d = disc[i] - a
                    u = (d[0] * e2[1] - d[1] * e2[0]) / area
                    v = (e1[0] * d[1] - e1[1] * d[0]) / area
                    if u >= real(0.0) and v >= real(0.0) and u + v <= real(1.0):
                        if sweep == 0:
                            if hits[i] == 0:
                                covered += 1
                            hits[i] += 1
                        else:
                            share = real(1.0) / real(hits[i] * covered)
                            rhs_out[w, t[0], e] = rhs_out[w, t[0], e] + (real(1.0) - u - v) * share
                            rhs_out[w, t[1], e] = rhs_out[w, t[1], e] + u * share
                            rhs_out[w, t[2], e] = rhs_out[w, t[2], e] + v * share
                            mean = (
                                (real(1.0) - u - v) * thickness[t[0], w]
                                + u * thickness[t[1], w]
                                + v * thickness[t[2], w]
                            )
                            local += share * mean
    local_out[e, w] = local  # zero where no film is left over the disc


@wp.kernel(
    module="unique", enable_backward=False
)  # launched with blocks of its own size: else all kernels here were compiled for both
def solve_band(
    # In:
    due: wp.array(dtype=int),
    nblock: int,
    reach: int,
    # In, out:
    band: wp.array3d(dtype=real),
    rhs: wp.array3d(dtype=real),
    # Out:
    resistance_out: wp.array3d(dtype=real),
):
    """W' A^-1 W of the discs W by Cholesky's factor, a thread block for each world; A has `reach` tiles
    beside the diagonal."""
    w = wp.tid()
    if due[w] == 0:
        return
    total = wp.tile_zeros(shape=(TILE, TILE), dtype=real, storage="shared")
    for k in range(nblock):
        first = k * (reach + 1) * TILE
        factor = wp.tile_load(band[w], shape=(TILE, TILE), offset=(first, 0), storage="shared")
        wp.tile_cholesky_inplace(factor)
        y = wp.tile_load(rhs[w], shape=(TILE, TILE), offset=(k * TILE, 0), storage="shared")
        wp.tile_lower_solve_inplace(factor, y)
        wp.tile_matmul(wp.tile_transpose(y), y, total)
        for i in range(1, wp.min(reach, nblock - 1 - k) + 1):
            z = wp.tile_load(band[w], shape=(TILE, TILE), offset=(first + i * TILE, 0), storage="shared")
            wp.tile_lower_solve_inplace(factor, z)
            wp.tile_store(band[w], z, offset=(first + i * TILE, 0))
            below = wp.tile_load(rhs[w], shape=(TILE, TILE), offset=((k + i) * TILE, 0), storage="shared")
            wp.tile_matmul(wp.tile_transpose(z), y, below, alpha=-1.0)
            wp.tile_store(rhs[w], below, offset=((k + i) * TILE, 0))
            for j in range(1, i + 1):
                other = wp.tile_load(
                    band[w], shape=(TILE, TILE), offset=(first + j * TILE, 0), storage="shared"
                )
                row = ((k + j) * (reach + 1) + i - j) * TILE
                rest = wp.tile_load(band[w], shape=(TILE, TILE), offset=(row, 0), storage="shared")
                wp.tile_matmul(wp.tile_transpose(other), z, rest, alpha=-1.0)
                wp.tile_store(band[w], rest, offset=(row, 0))
    wp.tile_store(resistance_out[w], total)


@wp.kernel
def driving_point(
    # In:
    due: wp.array(dtype=int),
    resistance: wp.array3d(dtype=real),
    local: wp.array2d(dtype=real),
    spreading: wp.array(dtype=real),
    spreading_step: real,
    radius: real,
    footprint: real,
    conductivity: real,
    cell_constant: wp.array(dtype=real),
    # Out:
    impedance_out: wp.array2d(dtype=real),
    valid_out: wp.array(dtype=int),
):
    """Impedance of each sensing disc against the grounded ones, [world, electrode]; a film that cannot be
    solved keeps the last ones."""
    w = wp.tid()
    if due[w] == 0:
        return
    a = ground()
    for i in range(4):
        for j in range(4):
            a[i, j] = resistance[w, 19 + i, 19 + j]
        a[i, 4] = real(1.0)
        a[4, i] = real(1.0)
        a[i, i] = a[i, i] + _near(
            local[19 + i, w], spreading, spreading_step, radius, footprint, conductivity
        )
    inverse = _inverse5(a)
    for sweep in range(2):  # check all, then write
        for e in range(19):
            z = resistance[w, e, e] + _near(
                local[e, w], spreading, spreading_step, radius, footprint, conductivity
            )
            for i in range(5):
                current = real(0.0)
                for j in range(5):
                    current += inverse[i, j] * wp.where(j < 4, resistance[w, 19 + wp.min(j, 3), e], real(1.0))
                z -= current * wp.where(i < 4, resistance[w, 19 + wp.min(i, 3), e], real(1.0))
            z = cell_constant[e] * z
            if sweep == 0:
                if not (z > real(0.0) and z < real(1.0e12)):
                    valid_out[w] = 0
                    return
            else:
                impedance_out[w, e] = z
    valid_out[w] = 1


@wp.func
def _near(
    thickness: real,
    spreading: wp.array(dtype=real),
    step: real,
    radius: real,
    footprint: real,
    conductivity: real,
):
    """Resistance [ohm] near a disc that the mesh does not see: the logarithm within the footprint, and what
    the slab adds to the sheet."""
    ratio = thickness / radius
    s = ratio / (real(1.0) + ratio) / step
    i = wp.min(int(s), spreading.shape[0] - 2)
    f = wp.min(s - real(i), real(1.0))  # beyond the table: its last value
    slab = spreading[i] * (real(1.0) - f) + spreading[i + 1] * f
    return (wp.log(footprint / radius) / (real(2.0) * real(wp.pi) * thickness) + slab / radius) / conductivity


@wp.func
def _inverse5(a: ground):
    """Gauss-Jordan with row pivots: the last diagonal entry is zero."""
    scale = real(0.0)
    for i in range(4):
        scale = wp.max(scale, wp.abs(a[i, i]))
    b = ground()
    for i in range(5):
        b[i, i] = real(1.0)
    for i in range(4):  # resistances are some ten thousand ohm, the border is one
        a[i, 4] = scale
        a[4, i] = scale
    for k in range(5):
        pivot = int(k)
        for i in range(k + 1, 5):
            if wp.abs(a[i, k]) > wp.abs(a[pivot, k]):
                pivot = i
        for j in range(5):
            swap = a[k, j]
            a[k, j] = a[pivot, j]
            a[pivot, j] = swap
            swap = b[k, j]
            b[k, j] = b[pivot, j]
            b[pivot, j] = swap
        inverse = real(1.0) / a[k, k]
        for j in range(5):
            a[k, j] = a[k, j] * inverse
            b[k, j] = b[k, j] * inverse
        for i in range(5):
            if i != k:
                factor = a[i, k]
                for j in range(5):
                    a[i, j] = a[i, j] - factor * a[k, j]
                    b[i, j] = b[i, j] - factor * b[k, j]
    for i in range(5):
        b[i, 4] = b[i, 4] * scale
        b[4, i] = b[4, i] * scale
    return b
