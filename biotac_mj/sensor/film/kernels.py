"""Kernels of `conduction.py`: film over the core, sheet, discs; and the network of their resistances. Arrays
over worlds are [item, world], but those of the linear system [world, item]."""

import warp as wp

from biotac_mj.geometry.core_surface import Core, NearestTriangles, nearest_listed_on_core
from biotac_mj.geometry.design import MOST_EXCITATION

from ...kernels import kernel_module

kernel_module(__name__)

NSAMPLE = 24  # sample points of equal area on a disc
# barycentric tolerance for a sample on an edge: both faces accept it under rounding
_ON_EDGE = 1e-9
real = wp.float64
vec3 = wp.vec3d
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
    given_out: wp.array2d(dtype=real),
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
    given_out[3 * f, w] = -scale * wp.dot(e1, e2)
    given_out[3 * f + 1, w] = -scale * wp.dot(e2, e0)
    given_out[3 * f + 2, w] = -scale * wp.dot(e0, e1)


@wp.struct
class Discs:
    """Electrodes as discs, where current enters the sheet. A pair is a disc and a face that may lie over
    it."""

    pos: wp.array(dtype=vec3)  # (ndisc,) centres [m]
    tangent: wp.array2d(dtype=vec3)  # (ndisc, 2) axes
    pair_start: wp.array(dtype=int)  # (ndisc + 1,) range of each disc in the pairs
    pair_disc: wp.array(dtype=int)
    pair_face: wp.array(dtype=int)
    sample: wp.array(dtype=wp.vec2d)  # (NSAMPLE,) points on a disc [m]
    footprint: real  # radius [m]


@wp.func
def _where_on_disc(discs: Discs, e: int, q: vec3):
    off = q - discs.pos[e]
    return wp.vec2d(wp.dot(off, discs.tangent[e, 0]), wp.dot(off, discs.tangent[e, 1]))


@wp.func
def _on_disc(k: int, w: int, discs: Discs, face: wp.array(dtype=wp.vec3i), middle: wp.array2d(dtype=vec3)):
    """Corners of a pair's face in the disc's plane, as rows."""
    e = discs.pair_disc[k]
    t = face[discs.pair_face[k]]
    return wp.matrix_from_rows(
        _where_on_disc(discs, e, middle[t[0], w]),
        _where_on_disc(discs, e, middle[t[1], w]),
        _where_on_disc(discs, e, middle[t[2], w]),
    )


@wp.func
def _barycentric(corner: wp.types.matrix((3, 2), wp.float64), p: wp.vec2d):
    e1 = corner[1] - corner[0]
    e2 = corner[2] - corner[0]
    d = p - corner[0]
    scale = real(1.0) / (e1[0] * e2[1] - e1[1] * e2[0])
    u = scale * (d[0] * e2[1] - d[1] * e2[0])
    v = scale * (e1[0] * d[1] - e1[1] * d[0])
    return vec3(real(1.0) - u - v, u, v)


@wp.kernel
def samples_over(
    # In:
    due: wp.array(dtype=int),
    discs: Discs,
    face: wp.array(dtype=wp.vec3i),
    middle: wp.array2d(dtype=vec3),
    # Out:
    over_out: wp.array2d(dtype=int),
):
    """The samples over which the face of each pair lies, as bits [pair, world]."""
    k, w = wp.tid()
    if due[w] == 0:
        return
    corner = _on_disc(k, w, discs, face, middle)
    low = wp.min(corner[0], wp.min(corner[1], corner[2]))
    high = wp.max(corner[0], wp.max(corner[1], corner[2]))
    over = int(0)
    if wp.max(low[0], low[1]) <= discs.footprint and wp.min(high[0], high[1]) >= -discs.footprint:
        for i in range(NSAMPLE):
            if wp.min(_barycentric(corner, discs.sample[i])) >= real(-_ON_EDGE):
                over |= 1 << i
    over_out[k, w] = over


@wp.kernel
def find_weights(
    # In:
    due: wp.array(dtype=int),
    discs: Discs,
    face: wp.array(dtype=wp.vec3i),
    over: wp.array2d(dtype=int),
    middle: wp.array2d(dtype=vec3),
    thickness: wp.array2d(dtype=real),
    # Out:
    given_out: wp.array2d(dtype=real),
    local_out: wp.array2d(dtype=real),
):
    """The mean over each disc as weights of its pairs' corners [3 (face + pair) + corner, world]: faces that
    lie over one sample share it. Mean thickness [disc, world], zero without film."""
    e, w = wp.tid()
    if due[w] == 0:
        return
    hits = samples()
    for k in range(discs.pair_start[e], discs.pair_start[e + 1]):
        mine = over[k, w]
        if mine != 0:
            for i in range(NSAMPLE):
                hits[i] += (mine >> i) & 1
    covered = int(0)
    for i in range(NSAMPLE):
        covered += wp.min(hits[i], 1)
    local = real(0.0)
    for k in range(discs.pair_start[e], discs.pair_start[e + 1]):
        mine = over[k, w]
        weights = vec3()
        if mine != 0:  # where a corner is not finite the face is over no sample
            corner = _on_disc(k, w, discs, face, middle)
            for i in range(NSAMPLE):
                if ((mine >> i) & 1) == 1:
                    weights += _barycentric(corner, discs.sample[i]) / real(hits[i] * covered)
            t = face[discs.pair_face[k]]
            for c in range(3):
                local += weights[c] * thickness[t[c], w]
        for c in range(3):
            given_out[3 * (face.shape[0] + k) + c, w] = weights[c]
    local_out[e, w] = local


@wp.struct
class Network:
    """Resistance near a disc that the mesh does not resolve, see `near_resistance`."""

    spreading: wp.array(dtype=real)
    step: real
    radius: real
    footprint: real


@wp.func
def driving_point(
    e: int,
    w: int,
    n: int,
    place: wp.array2d(dtype=int),
    system: wp.array2d(dtype=real),
    local: wp.array2d(dtype=real),
    network: Network,
    conductivity: real,
):
    """Impedance of a sensing disc, of n, against the grounded ones; - system at `place`: the sheet's
    resistances."""
    m = place.shape[0] - n
    # of the grounded electrodes among themselves; those that are not there stay apart
    among = wp.identity(n=MOST_EXCITATION, dtype=real)
    one = grounded()
    into = grounded()
    for i in range(m):
        for j in range(m):
            among[i, j] = -system[w, place[n + i, n + j]]
        among[i, i] = among[i, i] + _near(local[n + i, w], network, conductivity)
        one[i] = real(1.0)
        into[i] = -system[w, place[n + i, e]]
    inverse = wp.inverse(among)
    equal = inverse * one  # currents of equal potentials
    # their common potential, at which they take the whole current
    potential = (wp.dot(equal, into) - real(1.0)) / wp.dot(equal, one)
    z = _near(local[e, w], network, conductivity) - system[w, place[e, e]]
    return z - wp.dot(into, inverse * (into - potential * one)) - potential


@wp.func
def _near(thickness: real, network: Network, conductivity: real):
    return near_resistance(
        thickness, network.spreading, network.step, network.radius, network.footprint, conductivity
    )
