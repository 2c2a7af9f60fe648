"""Faces of a contact surface: sums over samples, wrenches, anchors.

Each face has `nsample` points with equal parts of its rest area, so that contact acts between the nodes, too
(surface-to-surface contact as in ANSYS and CalculiX). `touch` computes the force at a sample."""

import numpy as np
import warp as wp

from ...kernels import kernel_module
from ..block import block_sum
from ..program import Program
from ..types import mat33, real, vec3
from .posed import Geoms, Meeting, distance_from, meet, place_on

kernel_module(__name__)


@wp.struct
class Laws:
    """Parameters of a `ContactLaw` in every world (nworld,). Without a law all arrays except the smoothing
    are empty."""

    exponent: wp.array(dtype=real)  # n
    pressure: wp.array(dtype=real)  # p0 [Pa]
    work: wp.array(dtype=real)  # work of adhesion W [J/m^2]
    separation: wp.array(dtype=real)  # work of separation [J/m^2]
    reach: wp.array(dtype=real)  # range of adhesion [m]
    smoothing: wp.array(dtype=real)  # half width of the smoothed kink at first contact [m]; perhaps empty
    node_area: wp.array(dtype=real)  # of the surface [nvert] [m^2]
    node_normal_force: wp.array2d(dtype=real)  # normal force on the nodes [nvert, nworld] [N]


def empty_laws(device: wp.DeviceLike) -> Laws:
    """Laws of a surface without a ContactLaw."""
    laws = Laws()
    for name, variable in Laws.vars.items():
        none = wp.zeros((0,) * variable.type.ndim, dtype=variable.type.dtype, device=device)
        setattr(laws, name, none)
    return laws


@wp.struct
class Contact:
    """Contact of one surface in all worlds: parameters, anchors, and results of the evaluation."""

    face: wp.array(dtype=wp.vec3i)
    area: wp.array(dtype=real)  # of the faces at rest [m^2]
    bonded: wp.array(dtype=int)  # 1: a face of what the skin is fixed to, which meets geoms itself
    sample: wp.array(dtype=vec3)  # barycentric coordinates
    stick_ratio: real
    stiffness: wp.array(dtype=real)  # [world] [Pa/m]
    laws: Laws
    x_last: wp.array2d(dtype=vec3)  # nodes at the start of the load increment [node, world] [m]
    bound: wp.array2d(dtype=real)  # stored bound of friction [sample, world] [N]; perhaps empty
    # of a `data.ContactState`
    anchor_geom: wp.array2d(dtype=int)
    anchor: wp.array2d(dtype=vec3)
    kept: wp.array2d(dtype=int)
    corner: wp.array2d(dtype=vec3)
    block: wp.array2d(dtype=mat33)
    touching: wp.array2d(dtype=int)
    trial_geom: wp.array2d(dtype=int)
    bond: wp.array2d(dtype=int)
    trial_anchor: wp.array2d(dtype=vec3)
    sample_force: wp.array2d(dtype=vec3)


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
def block_index(a: int, b: int):
    """Index of the stored block of a face between corners a <= b: 00 01 02 11 12 22."""
    return a * (5 - a) // 2 + b


@wp.kernel
def clear_bounds(on: wp.array(dtype=int), bound: wp.array2d(dtype=real)):
    """Clears the friction bound of sample i, for faces that the broad phase will skip."""
    i, w = wp.tid()
    if on[w] == 1:
        bound[i, w] = real(0.0)


# in a module of its own: it takes as long to compile as all others here, and few uses need it
@wp.kernel(module=kernel_module(f"{__name__}.normal_forces"))
def normal_forces(
    # In:
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    contact: Contact,
    # Out:
    corner_out: wp.array2d(dtype=real),
):
    """Normal force on the corners of face f [N]."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    total = vec3()
    if near[f, w] == 1:
        t = contact.face[f]
        nsample = contact.sample.shape[0]
        k = contact.stiffness[w] * contact.area[f] / real(nsample)
        u = x[t[1], w] - x[t[0], w]
        v = x[t[2], w] - x[t[0], w]
        for s in range(nsample):
            b = contact.sample[s]
            p = b[0] * x[t[0], w] + b[1] * x[t[1], w] + b[2] * x[t[2], w]
            deepest = Meeting()  # a sample touches one geom, as in `touch`
            for g in range(geoms.count):
                y = place_on(geoms, g, w, p)
                dn = distance_from(geoms, g, p, y, geoms.mat[g, w])
                met = meet(geoms, g, w, y, dn, b, u, v, 1)
                if met.gap < deepest.gap:
                    deepest = met
            total -= k * deepest.weight * deepest.gap * deepest.at
    for c in range(3):
        corner_out[3 * f + c, w] = total[c]


class NormalForces:
    """Normal forces on faces of a single world, by a recorded launch.

    Args:
      contact, geoms: of the surface, and the geoms that touch it. x: nodes (nvert, 1) [m].
    """

    def __init__(self, contact: Contact, geoms: Geoms, x: wp.array):
        count, device = len(contact.face), x.device
        dim = count, 1
        self._near = wp.zeros(dim, dtype=int, device=device)
        corner = self._corner = wp.zeros((3 * count, 1), dtype=real, device=device)
        given = [geoms, x, wp.ones(1, dtype=int, device=device), self._near, contact]
        self._run = Program(device, lambda program: program.launch(normal_forces, dim, given, [corner])).run

    def __call__(self, faces: np.ndarray) -> np.ndarray:
        """Normal forces (nface,) [N], 0 on faces that are not in `faces`, indices of those that may be
        touched."""
        near = np.zeros(self._near.shape, np.int32)
        near[faces] = 1
        self._near.assign(near)
        self._run()
        return self._corner.numpy().reshape(-1, 3).sum(axis=1)


@wp.kernel
def sum_normal_forces(
    # In:
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    corner: wp.array2d(dtype=real),
    on: wp.array(dtype=int),
    # Out:
    laws: Laws,
):
    """Sums the normal force at node i [N]."""
    i, w = wp.tid()
    if on[w] == 0:
        return
    total = real(0.0)
    for k in range(start[i], start[i + 1]):
        total += corner[slot[k], w]
    laws.node_normal_force[i, w] = total


@wp.func
def balanced_fraction(push: vec3, balanced: vec3):
    """Fraction of the contact law's force `push` at a node with which it is at most the force that the skin
    balances there."""
    square = wp.length_sq(push)
    if square == real(0.0):
        return real(0.0)
    return wp.clamp(wp.dot(push, balanced) / square, real(0.0), real(1.0))


@wp.kernel
def limit_contacts(
    # In:
    mask: wp.array(dtype=real),
    force: wp.array2d(dtype=vec3),
    node_force: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # In and out:
    contact: Contact,
):
    """Limits the forces on face f to those that the skin balances, where nodes are not in equilibrium.

    force: residual of the nodes. node_force: force of contact on them."""
    f, w = wp.tid()
    if on[w] == 0 or contact.touching[f, w] == 0:
        return
    push = vec3()
    balanced = vec3()
    for a in range(3):
        i = contact.face[f][a]
        corner = contact.corner[3 * f + a, w]
        push += corner
        fraction = real(1.0)
        if mask[i] > real(0.0):
            fraction = balanced_fraction(node_force[i, w], node_force[i, w] - force[i, w])
        balanced += fraction * corner
    fraction = balanced_fraction(push, balanced)
    for a in range(3):
        contact.corner[3 * f + a, w] = fraction * contact.corner[3 * f + a, w]
    nsample = contact.sample.shape[0]
    for i in range(f * nsample, (f + 1) * nsample):
        contact.sample_force[i, w] = fraction * contact.sample_force[i, w]


@wp.kernel
def partial_wrench(
    # In:
    chunk: int,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    contact: Contact,
    # Out:
    partial_out: wp.array3d(dtype=vec3),
    touched_by: wp.array2d(dtype=int),
):
    """Force and torque of a chunk of faces ON each group of geoms [2 group + (0, 1), chunk, world] [N, N m];
    marks geoms that touch."""
    c, w = wp.tid()
    for k in range(partial_out.shape[0]):
        partial_out[k, c, w] = vec3()
    nsample = contact.sample.shape[0]
    last = int(-1)  # group whose force and torque have not been written yet
    push = vec3()
    turn = vec3()
    for f in range(c * chunk, wp.min((c + 1) * chunk, contact.face.shape[0])):
        if contact.touching[f, w] == 1:
            t = contact.face[f]
            # torque of the forces that act beside their samples, at edges of geoms
            other = vec3()
            for a in range(3):
                other += wp.cross(x[t[a], w], contact.corner[3 * f + a, w])
            for s in range(nsample):
                i = f * nsample + s
                g = contact.trial_geom[i, w]
                if g >= 0 and g < geoms.count:  # a skipped world may have touched other geoms
                    b = contact.sample[s]
                    p = b[0] * x[t[0], w] + b[1] * x[t[1], w] + b[2] * x[t[2], w]
                    k = 2 * geoms.group[g]
                    if k != last:
                        if last >= 0:
                            partial_out[last, c, w] = partial_out[last, c, w] + push
                            partial_out[last + 1, c, w] = partial_out[last + 1, c, w] + turn
                        last = k
                        push = vec3()
                        turn = vec3()
                    push -= contact.sample_force[i, w]
                    moment = wp.cross(p, contact.sample_force[i, w])
                    turn -= moment
                    other -= moment
                    touched_by[g, w] = 1
            turn -= other
    if last >= 0:
        partial_out[last, c, w] = partial_out[last, c, w] + push
        partial_out[last + 1, c, w] = partial_out[last + 1, c, w] + turn


# in a module of its own: the others are launched with another block size, and would be compiled for both
@wp.kernel(module=kernel_module(f"{__name__}.sum_wrench"))
def sum_wrench(partial: wp.array3d(dtype=vec3), wrench_out: wp.array3d(dtype=real)):
    """Wrench on each group of geoms [group, world, 6] [N, N m], summed by the threads of a block."""
    k, w, t = wp.tid()
    total = vec3()
    for c in range(t, partial.shape[1], wp.block_dim()):
        total += partial[k, c, w]
    total = block_sum(total)
    if t == 0:
        for a in range(3):
            wrench_out[k // 2, w, 3 * (k % 2) + a] = total[a]


@wp.func
def thinned(across: vec3, rest: vec3):
    """Fraction of a wall's thickness that is lost, from what leads through it and did so at rest: along the
    latter, since its sides slide."""
    return real(1.0) - wp.dot(across, rest) / wp.length_sq(rest)


@wp.kernel(module=kernel_module(f"{__name__}.sum_wrench"))
def find_tier(
    # In:
    most: real,
    node: wp.array(dtype=int),
    opposite: wp.array(dtype=int),
    rest: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    force: wp.array2d(dtype=vec3),
    wanted: wp.array(dtype=int),
    # Out:
    squeezed_out: wp.array(dtype=real),
    tier_out: wp.array(dtype=int),
):
    """Fraction by which the wall is squeezed, weighted as in `condensed.results.correct`, and 0, or -1 where
    that is more than `most`."""
    w, t = wp.tid()
    own = vec3()
    for n in range(t, node.shape[0], wp.block_dim()):
        i = node[n]
        j = opposite[n]
        weight = wp.length_sq(force[i, w])
        if weight > real(0.0):
            own += weight * vec3(real(1.0), thinned(x[i, w] - x[j, w], rest[i, 0] - rest[j, 0]), real(0.0))
    total = block_sum(own)
    if t == 0 and wanted[w] == 1:
        squeezed_out[w] = total[1] / wp.max(total[0], real(1.0e-300))
        tier_out[w] = wp.where(squeezed_out[w] > most, -1, 0)


@wp.func
def commit_face(f: int, w: int, contact: Contact):
    """Stores the anchors of face f for the next step, if it touches or had anchors."""
    touching = contact.touching[f, w]
    if touching == 0 and contact.kept[f, w] == 0:
        return
    contact.kept[f, w] = touching
    nsample = contact.sample.shape[0]
    for i in range(f * nsample, (f + 1) * nsample):
        bond = int(-1)
        if touching == 1:
            bond = contact.bond[i, w]
        contact.anchor_geom[i, w] = bond
        if bond >= 0:
            contact.anchor[i, w] = contact.trial_anchor[i, w]


@wp.kernel
def commit_contacts(on: wp.array(dtype=int), contact: Contact):
    """`commit_face` in the worlds that are on."""
    f, w = wp.tid()
    if on[w] == 1:
        commit_face(f, w, contact)
