"""Kernels of `conduction.py`: core, sheet, discs, factorisation, network. Arrays over worlds are [item,
world], except tiles.

A world's system is an array of rows of TILE numbers: its Laplacian in a layout of `systems.py`, followed by
the right-hand sides, one column for each disc."""

import warp as wp

from biotac_mj.geometry.core_surface import Core, NearestTriangles, nearest_listed_on_core
from biotac_mj.geometry.design import MOST_DISCS, MOST_EXCITATION

__all__ = [
    "NSAMPLE",
    "TILE",
    "assemble",
    "clear_system",
    "cover_discs",
    "driving_point",
    "face_conductance",
    "film_surface",
]

wp.set_module_options({"enable_backward": False})

NSAMPLE = 24  # sample points of equal area on a disc
TILE = MOST_DISCS  # rows of a tile, and columns of right-hand sides: the discs, padded
# barycentric tolerance for a sample on an edge: both faces accept it under rounding
_ON_EDGE = 1e-9
real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d
samples = wp.types.vector(NSAMPLE, int)
grounded = wp.types.vector(MOST_EXCITATION, wp.float64)

# `rough_thickness`, `sheet_scale` and `near_resistance` also run on tensors, for gradients
# (`differentiable.impedance`).


@wp.func
def rough_thickness(thickness: real, rest: real, power: real):
    """Thickness [m] of a smooth film with the conductance of a rough one, which is a power of its
    thickness."""
    return rest * wp.pow(thickness / rest, power)


@wp.func
def sheet_scale(conductivity: real, thickness: real, area: real):
    """Conductance of a face of the sheet over its area [S/m^2]; products of its edges with it are
    conductances between corners. thickness: sum over its corners, area: of the parallelogram."""
    sheet = conductivity * thickness / real(3.0)
    return real(0.5) * sheet / area


@wp.func
def near_resistance(
    thickness: real,
    spreading: wp.array(dtype=real),
    step: real,
    radius: real,
    footprint: real,
    conductivity: real,
):
    """Resistance [ohm] near a disc that the mesh does not resolve: the logarithm within the footprint, and
    the slab's addition to the sheet, from the table `spreading` (`conduction.spreading_table`)."""
    ratio = thickness / radius
    s = ratio / (real(1.0) + ratio) / step
    i = wp.min(int(s), spreading.shape[0] - 2)
    f = wp.min(s - real(i), real(1.0))  # beyond the table: its last value
    slab = spreading[i] * (real(1.0) - f) + spreading[i + 1] * f
    within = wp.log(footprint / radius) / (real(2.0) * real(wp.pi) * thickness)
    return (within + slab / radius) / conductivity


@wp.kernel
def film_surface(
    # In:
    due: wp.array(dtype=int),
    core: Core,
    nearest: NearestTriangles,
    node: wp.array(dtype=int),
    residual_film: real,
    power: real,
    rest: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    middle_out: wp.array2d(dtype=vec3),
    thickness_out: wp.array2d(dtype=real),
):
    """The surface halfway between skin and core, and the film's thickness [node, world]. For `power` other
    than one, the thickness of a smooth film of the same conductance."""
    i, w = wp.tid()
    if due[w] == 0:
        return
    p = x[node[i], w]
    gap, distance, _face = nearest_listed_on_core(core, nearest, i, p)
    thickness = wp.where(distance < residual_film, residual_film, distance)  # keeps nan
    if power != real(1.0):
        thickness = rough_thickness(thickness, rest[i], power)
    middle_out[i, w] = p - real(0.5) * gap
    thickness_out[i, w] = thickness


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
    e0 = middle[t[2], w] - middle[t[1], w]
    e1 = middle[t[0], w] - middle[t[2], w]
    e2 = middle[t[1], w] - middle[t[0], w]
    area = wp.length(wp.cross(e0, e1))
    # keeps a degenerate face finite
    area = wp.max(area, real(1.0e-6) * (wp.length_sq(e0) + wp.length_sq(e1) + wp.length_sq(e2)))
    scale = sheet_scale(conductivity, thickness[t[0], w] + thickness[t[1], w] + thickness[t[2], w], area)
    edge_out[3 * f, w] = -scale * wp.dot(e1, e2)
    edge_out[3 * f + 1, w] = -scale * wp.dot(e2, e0)
    edge_out[3 * f + 2, w] = -scale * wp.dot(e0, e1)


@wp.kernel
def clear_system(
    # In:
    due: wp.array(dtype=int),
    # Out:
    quads_out: wp.array2d(dtype=vec4),
):
    """Clears the systems of the worlds that are due, four numbers per thread."""
    w, i = wp.tid()
    if due[w] != 0:
        quads_out[w, i] = vec4()


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
    system_out: wp.array3d(dtype=real),
):
    """Sums the Laplacian's entries over the faces' edges; padding has a unit diagonal."""
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
        # fixes the free constant; no current flows through it, so the impedances do not depend on it
        value = real(2.0) * value
    system_out[w, entry[e][0], entry[e][1]] = value


@wp.func
def _where_on_disc(q: vec3, pos: vec3, tangent1: vec3, tangent2: vec3):
    return wp.vec2d(wp.dot(q - pos, tangent1), wp.dot(q - pos, tangent2))


@wp.struct
class Discs:
    """Electrodes as discs: where current enters the sheet."""

    pos: wp.array(dtype=vec3)  # (ndisc,) centres [m]
    tangent: wp.array2d(dtype=vec3)  # (ndisc, 2) axes
    pair_start: wp.array(dtype=int)  # (ndisc + 1,) range of each disc in pair_face
    pair_face: wp.array(dtype=int)  # candidate faces
    sample: wp.array(dtype=wp.vec2d)  # (NSAMPLE,) points on a disc [m]
    footprint: real  # radius [m]


@wp.kernel
def cover_discs(
    # In:
    due: wp.array(dtype=int),
    discs: Discs,
    face: wp.array(dtype=wp.vec3i),
    rhs: int,
    middle: wp.array2d(dtype=vec3),
    thickness: wp.array2d(dtype=real),
    # Out:
    system_out: wp.array3d(dtype=real),
    local_out: wp.array2d(dtype=real),
):
    """Mean over each disc as weights of nodal values (columns of the right-hand side, from row `rhs` on), and
    mean thickness [disc, world]."""
    e, w = wp.tid()
    if due[w] == 0:
        return
    hits = samples()
    covered = int(0)
    local = real(0.0)
    for sweep in range(2):  # count the faces over each sample, then divide its weight
        for k in range(discs.pair_start[e], discs.pair_start[e + 1]):
            t = face[discs.pair_face[k]]
            a = _where_on_disc(middle[t[0], w], discs.pos[e], discs.tangent[e, 0], discs.tangent[e, 1])
            b = _where_on_disc(middle[t[1], w], discs.pos[e], discs.tangent[e, 0], discs.tangent[e, 1])
            c = _where_on_disc(middle[t[2], w], discs.pos[e], discs.tangent[e, 0], discs.tangent[e, 1])
            low = wp.min(a, wp.min(b, c))
            high = wp.max(a, wp.max(b, c))
            if wp.max(low[0], low[1]) <= discs.footprint and wp.min(high[0], high[1]) >= -discs.footprint:
                e1 = b - a
                e2 = c - a
                area = e1[0] * e2[1] - e1[1] * e2[0]
                for i in range(NSAMPLE):
                    d = discs.sample[i] - a
                    u = (d[0] * e2[1] - d[1] * e2[0]) / area
                    v = (e1[0] * d[1] - e1[1] * d[0]) / area
                    if wp.min(wp.min(u, v), real(1.0) - u - v) >= real(-_ON_EDGE):
                        if sweep == 0:
                            if hits[i] == 0:
                                covered += 1
                            hits[i] += 1
                        else:
                            weight = real(1.0) / real(hits[i] * covered)
                            system_out[w, rhs + t[0], e] = (
                                system_out[w, rhs + t[0], e] + (real(1.0) - u - v) * weight
                            )
                            system_out[w, rhs + t[1], e] = system_out[w, rhs + t[1], e] + u * weight
                            system_out[w, rhs + t[2], e] = system_out[w, rhs + t[2], e] + v * weight
                            mean = (
                                (real(1.0) - u - v) * thickness[t[0], w]
                                + u * thickness[t[1], w]
                                + v * thickness[t[2], w]
                            )
                            local += weight * mean
    local_out[e, w] = local  # zero if no film is over the disc


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
    cell_constant: wp.array2d(dtype=real),
    # Out:
    impedance_out: wp.array2d(dtype=real),
    valid_out: wp.array(dtype=int),
):
    """Impedance of each sensing disc against the grounded ones, [world, electrode]. If the film cannot be
    solved, the last values stay."""
    w = wp.tid()
    if due[w] == 0:
        return
    n = impedance_out.shape[1]
    m = local.shape[0] - n
    # of the grounded electrodes among themselves; those that are not there stay apart
    among = wp.identity(n=MOST_EXCITATION, dtype=real)
    one = grounded()
    for i in range(m):
        for j in range(m):
            among[i, j] = resistance[w, n + i, n + j]
        near = near_resistance(local[n + i, w], spreading, spreading_step, radius, footprint, conductivity)
        among[i, i] = among[i, i] + near
        one[i] = real(1.0)
    inverse = wp.inverse(among)
    equal = inverse * one  # currents of equal potentials
    for sweep in range(2):  # check all, then write
        for e in range(n):
            z = resistance[w, e, e] + near_resistance(
                local[e, w], spreading, spreading_step, radius, footprint, conductivity
            )
            into = grounded()
            for i in range(m):
                into[i] = resistance[w, n + i, e]
            # their common potential, at which they take the whole current
            potential = (wp.dot(equal, into) - real(1.0)) / wp.dot(equal, one)
            z -= wp.dot(into, inverse * (into - potential * one)) + potential
            z = cell_constant[w % cell_constant.shape[0], e] * z
            if sweep == 0:
                if not (z > real(0.0) and z < real(1.0e12)):
                    valid_out[w] = 0
                    return
            else:
                impedance_out[w, e] = z
    valid_out[w] = 1
