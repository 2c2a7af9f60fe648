"""The faces that a geom may touch in a step of the condensed skin: contact forces at their nodes, stiffness,
wrenches.

Few faces are at stake, so what counts is the number of launches: each kernel is one thread that does all of
them, which also fixes the order of sums."""

import typing

import numpy as np
import warp as wp

from ...launches import recorded
from ..contact.faces import Laws, empty_laws
from ..contact.posed import Geoms, distance_to
from ..contact.touch import SKINS, contact_kernels
from ..contact.watch import distance_from_afar
from ..geoms import GeomSet
from ..types import mat33, real, vec3

if typing.TYPE_CHECKING:
    from ..model import SkinModel

__all__ = ["CandidateFaces"]

wp.set_module_options({"enable_backward": False})

_coulomb = contact_kernels(False, False, SKINS)
touch_sample, touch_face = _coulomb.touch_sample, _coulomb.touch_face
_SLIPPING = wp.constant(0.999)  # share of the largest friction from which on a sample counts as slipping
_BY = wp.constant(1e-9)  # of a difference [m]


@wp.struct
class Contact:
    """What the law of contact takes of the candidate faces and of the skin."""

    area: wp.array(dtype=real)
    sample: wp.array(dtype=vec3)
    stiffness: real
    stick_ratio: real
    laws: Laws
    x: wp.array2d(dtype=vec3)
    x_last: wp.array2d(dtype=vec3)
    anchor_geom: wp.array2d(dtype=int)
    anchor: wp.array2d(dtype=vec3)


@wp.kernel
def _touch(
    # In:
    count: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    slot: wp.array(dtype=int),
    geoms: Geoms,
    contact: Contact,
    # Out:
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
    sample_force_out: wp.array2d(dtype=vec3),
    force_out: wp.array(dtype=vec3),
    lumped_out: wp.array(dtype=mat33),
    touched_out: wp.array(dtype=int),
):
    """Forces, lumped stiffness (rows summed) and whether it is touched of the count[1] nodes of the first
    count[0] faces."""
    c = contact
    nsample = c.sample.shape[0]
    for i in range(count[1]):
        force_out[i] = vec3()
        lumped_out[i] = mat33()
        touched_out[i] = 0
    for f in range(count[0]):
        t = face[f]
        touching_out[f, 0] = 0
        for s in range(nsample):
            geom_out[f * nsample + s, 0] = -1
        if distance_from_afar(c.x[t[0], 0], c.x[t[1], 0], c.x[t[2], 0], 0, geoms) < real(0.0):
            touch_face(
                f, 0, face, c.area, c.sample, c.stiffness, c.stick_ratio, geoms, c.laws, c.x, c.x_last,
                c.anchor_geom, c.anchor, 0, corner_out, block_out, touching_out, geom_out, geom_out,
                anchor_out, sample_force_out,
            )  # fmt: skip
        if touching_out[f, 0] == 1:
            b01 = block_out[6 * f + 1, 0]
            b02 = block_out[6 * f + 2, 0]
            b12 = block_out[6 * f + 4, 0]
            i = slot[t[0]]
            if i >= 0:
                force_out[i] += corner_out[3 * f, 0]
                lumped_out[i] += block_out[6 * f, 0] + b01 + b02
                touched_out[i] = 1
            i = slot[t[1]]
            if i >= 0:
                force_out[i] += corner_out[3 * f + 1, 0]
                lumped_out[i] += b01 + block_out[6 * f + 3, 0] + b12
                touched_out[i] = 1
            i = slot[t[2]]
            if i >= 0:
                force_out[i] += corner_out[3 * f + 2, 0]
                lumped_out[i] += b02 + b12 + block_out[6 * f + 5, 0]
                touched_out[i] = 1


@wp.func
def _force(
    s: int, t: wp.vec3i, b: vec3, by: vec3, stiffness: real, share: real, geoms: Geoms, contact: Contact
):
    """On sample s, with weights b in the face t, moved by a vector."""
    c = contact
    _t, _b, _c, force, _K, _a = touch_sample(
        s, 0, b, t, c.x[t[0], 0] + by, c.x[t[1], 0] + by, c.x[t[2], 0] + by, stiffness,
        stiffness * c.stick_ratio, share, c.laws, geoms, c.x_last, c.anchor_geom, c.anchor, 0,
    )  # fmt: skip
    return force


@wp.kernel
def _differ(
    # In:
    count: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    geoms: Geoms,
    contact: Contact,
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    # Out:
    block_out: wp.array2d(dtype=mat33),
):
    """Stiffness of the faces that touch as it is, by differences of the contact itself: with what friction
    takes from the normal force and with the curvature of the geoms. It is not symmetric."""
    nsample = contact.sample.shape[0]
    for f in range(count[0]):
        if touching[f, 0] == 1:
            t = face[f]
            share = contact.area[f] / real(nsample)
            k = contact.stiffness * share
            for c in range(6):
                block_out[6 * f + c, 0] = mat33()
            for s in range(nsample):
                if geom[f * nsample + s, 0] >= 0:
                    b = contact.sample[s]
                    K = mat33()
                    for axis in range(3):
                        by = vec3()
                        by[axis] = real(_BY)
                        ahead = _force(f * nsample + s, t, b, by, k, share, geoms, contact)
                        behind = _force(f * nsample + s, t, b, -by, k, share, geoms, contact)
                        change = (behind - ahead) / (real(2.0) * real(_BY))
                        for row in range(3):
                            K[row, axis] = change[row]
                    for c in range(3):
                        for e in range(c, 3):
                            block_out[6 * f + c * (5 - c) // 2 + e, 0] += b[c] * b[e] * K


@wp.kernel
def _couple(
    # In:
    count: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    # Out:
    block_out: wp.array2d(dtype=mat33),
):
    """Adds to the stiffness of slipping samples how friction follows the normal force; it is not symmetric
    then."""
    for f in range(count[0]):
        if touching[f, 0] == 1:
            t = face[f]
            for s in range(sample.shape[0]):
                g = geom[f * sample.shape[0] + s, 0]
                if g >= 0:
                    b = sample[s]
                    p = b[0] * x[t[0], 0] + b[1] * x[t[1], 0] + b[2] * x[t[2], 0]
                    dn = distance_to(geoms, g, 0, p)
                    n = geoms.mat[g, 0] * vec3(dn[0], dn[1], dn[2])
                    F = force[f * sample.shape[0] + s, 0]
                    push = wp.dot(F, n)
                    along = F - push * n
                    if dn[3] < real(0.0) and wp.length(along) > real(_SLIPPING) * geoms.friction[g, 0] * push:
                        K = wp.outer(along, n) / -dn[3]
                        for c in range(3):
                            for e in range(c, 3):
                                block_out[6 * f + c * (5 - c) // 2 + e, 0] += b[c] * b[e] * K


@wp.kernel
def _matrix(
    # In:
    count: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    slot: wp.array(dtype=int),
    touching: wp.array2d(dtype=int),
    block: wp.array2d(dtype=mat33),
    place: wp.array(dtype=int),
    # Out:
    stiffness_out: wp.array(dtype=real),
):
    """Stiffness as a matrix over count[2] of the nodes; place is a node's number among them."""
    n = 3 * count[2]
    for i in range(n * n):
        stiffness_out[i] = real(0.0)
    for f in range(count[0]):
        if touching[f, 0] == 1:
            t = face[f]
            for a in range(3):
                i = slot[t[a]]
                if i >= 0:
                    i = 3 * place[i]
                    for b in range(3):
                        j = slot[t[b]]
                        if j >= 0:
                            j = 3 * place[j]
                            low = wp.min(a, b)
                            K = block[6 * f + low * (5 - low) // 2 + wp.max(a, b), 0]
                            for k in range(3):
                                for l in range(3):
                                    stiffness_out[(i + k) * n + j + l] += K[k, l]


@wp.kernel
def _product(
    # In:
    count: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    slot: wp.array(dtype=int),
    touching: wp.array2d(dtype=int),
    block: wp.array2d(dtype=mat33),
    p: wp.array(dtype=vec3),
    # Out:
    product_out: wp.array(dtype=vec3),
):
    """Stiffness times p over all nodes."""
    for i in range(count[1]):
        product_out[i] = vec3()
    for f in range(count[0]):
        if touching[f, 0] == 1:
            t = face[f]
            i = slot[t[0]]
            j = slot[t[1]]
            k = slot[t[2]]
            p0 = vec3()
            p1 = vec3()
            p2 = vec3()
            if i >= 0:
                p0 = p[i]
            if j >= 0:
                p1 = p[j]
            if k >= 0:
                p2 = p[k]
            b01 = block[6 * f + 1, 0]
            b02 = block[6 * f + 2, 0]
            b12 = block[6 * f + 4, 0]
            if i >= 0:
                product_out[i] += block[6 * f, 0] * p0 + b01 * p1 + b02 * p2
            if j >= 0:
                product_out[j] += b01 * p0 + block[6 * f + 3, 0] * p1 + b12 * p2
            if k >= 0:
                product_out[k] += b02 * p0 + b12 * p1 + block[6 * f + 5, 0] * p2


@wp.kernel
def _loads(
    # In:
    count: wp.array(dtype=int),
    face: wp.array(dtype=wp.vec3i),
    slot: wp.array(dtype=int),
    sample: wp.array(dtype=vec3),
    geoms: Geoms,
    ngroup: int,
    x: wp.array2d(dtype=vec3),
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    # Out:
    load_out: wp.array2d(dtype=real),
    share_out: wp.array2d(dtype=real),
):
    """Force and moment of each group of geoms on the skin (ngroup, 6), and how much each group touches each
    node (ngroup, nnode)."""
    for g in range(ngroup):
        for k in range(6):
            load_out[g, k] = real(0.0)
        for i in range(count[1]):
            share_out[g, i] = real(0.0)
    for f in range(count[0]):
        if touching[f, 0] == 1:
            t = face[f]
            for s in range(sample.shape[0]):
                g = geom[f * sample.shape[0] + s, 0]
                if g >= 0:
                    group = geoms.group[g]
                    b = sample[s]
                    p = b[0] * x[t[0], 0] + b[1] * x[t[1], 0] + b[2] * x[t[2], 0]
                    F = force[f * sample.shape[0] + s, 0]
                    M = wp.cross(p, F)
                    for k in range(3):
                        load_out[group, k] += F[k]
                        load_out[group, 3 + k] += M[k]
                        i = slot[t[k]]
                        if i >= 0:
                            share_out[group, i] += b[k]


class CandidateFaces:
    """Candidate faces, `count[0]` of them over `count[1]` free nodes, on buffers that grow as needed.

    Args:
      model: SkinModel. geoms: GeomSet of one world.
      x, x_last, slot: present positions of all nodes, those at the start of the step, a node's number among
        the candidates' nodes (-1: it is held), as Warp arrays.

    Attributes:
      force: (nnode, 3) [N]. lumped: (nnode, 3, 3) [N/m]. touched: (k,) numbers of the nodes that are touched;
        all of the last `evaluate`.
    """

    def __init__(self, model: "SkinModel", geoms: GeomSet, x: wp.array, x_last: wp.array, slot: wp.array):
        self._model, self._geoms, self._x, self._last, self._slot_wp, self.slot = (
            model,
            geoms,
            x,
            x_last,
            slot,
            slot.numpy(),
        )
        self._nsample = len(model.sample)
        self._limit = 0, 0
        self._allocate(64, 100)

    def _allocate(self, nface, nnode):
        m, geoms, nsample = self._model, self._geoms, self._nsample
        self._limit = nface, nnode

        def zeros(shape, dtype):
            array = wp.zeros(shape, dtype=dtype, device="cpu")
            return array, array.numpy()

        count, self.count = zeros(3, int)
        face, self._face = zeros(nface, wp.vec3i)
        area, self._area = zeros(nface, real)
        anchor_geom, self._anchor_geom = zeros((nface * nsample, 1), int)
        anchor, self._anchor = zeros((nface * nsample, 1), vec3)
        corner = zeros((3 * nface, 1), vec3)[0]
        block = zeros((6 * nface, 1), mat33)[0]
        touching = zeros((nface, 1), int)[0]
        geom, self._geom = zeros((nface * nsample, 1), int)
        trial, self._trial = zeros((nface * nsample, 1), vec3)
        sample_force, self._sample_force = zeros((nface * nsample, 1), vec3)
        force, self._force = zeros(nnode, vec3)
        lumped, self._lumped = zeros(nnode, mat33)
        touched, self._touched = zeros(nnode, int)
        place, self._place = zeros(nnode, int)
        p, self._p = zeros(nnode, vec3)
        product, self._result = zeros(nnode, vec3)
        load, self._load = zeros((geoms.ngroup, 6), real)
        share, self._share = zeros((geoms.ngroup, nnode), real)
        faces, springs = [count, face, self._slot_wp], [touching, block]
        contact = Contact()
        contact.area, contact.sample, contact.laws = area, m.sample, empty_laws("cpu")
        contact.stiffness, contact.stick_ratio = m.contact_stiffness, m.options.stick_ratio
        contact.x, contact.x_last = self._x, self._last
        contact.anchor_geom, contact.anchor = anchor_geom, anchor
        law = [geoms.struct, contact]
        self.evaluate = recorded(
            _touch,
            1,
            [*faces, *law],
            [corner, block, touching, geom, trial, sample_force, force, lumped, touched],
        )
        self.couple = recorded(
            _couple,
            1,
            [count, face, m.sample, geoms.struct, self._x, touching, geom, sample_force],
            [block],
        )
        self.differ = recorded(_differ, 1, [count, face, *law, touching, geom], [block])
        self._multiply = recorded(_product, 1, [*faces, *springs, p], [product])
        self._loads = recorded(
            _loads,
            1,
            [*faces, m.sample, geoms.struct, geoms.ngroup, self._x, touching, geom, sample_force],
            [load, share],
        )
        self._matrix_inputs, self._dense = [*faces, *springs, place], None

    def choose(
        self, number: np.ndarray, face: np.ndarray, area: np.ndarray, nnode: int, contacts: np.ndarray
    ) -> None:
        """Takes faces (n,), their nodes and areas (n, 3), (n,) and the sticking contacts of the last step (k,
        5) that are theirs."""
        n, nsample = len(number), self._nsample
        if n > self._limit[0] or nnode > self._limit[1]:
            self._allocate(max(self._limit[0], 2 * n), max(self._limit[1], 2 * nnode))
        self.count[:2] = n, nnode
        self._face[:n], self._area[:n] = face, area
        self._anchor_geom[: n * nsample] = -1
        self.number = number
        if len(contacts):
            sample = contacts[:, 0].astype(int)
            place = np.searchsorted(number, sample // nsample)
            known = place < n
            known[known] = number[place[known]] == sample[known] // nsample
            here = place[known] * nsample + sample[known] % nsample
            self._anchor_geom[here, 0], self._anchor[here, 0] = contacts[known, 1], contacts[known, 2:]

    @property
    def force(self) -> np.ndarray:
        return self._force[: self.count[1]]

    @property
    def lumped(self) -> np.ndarray:
        return self._lumped[: self.count[1]]

    @property
    def touched(self) -> np.ndarray:
        """Numbers of the nodes that are touched."""
        return self._touched[: self.count[1]].nonzero()[0]

    def product(self, p: np.ndarray) -> np.ndarray:
        """Stiffness times p (3 nnode,)."""
        n = self.count[1]
        self._p[:n] = p.reshape(n, 3)
        self._multiply()
        return self._result[:n].ravel()

    def matrix(self, node: np.ndarray) -> np.ndarray:
        """Stiffness over the touched nodes (k,): (3 k, 3 k)."""
        n = 3 * len(node)
        if self._dense is None or len(self._dense[0]) < n * n:
            array = wp.zeros(4 * n * n, dtype=real, device="cpu")
            self._dense = array.numpy(), recorded(_matrix, 1, self._matrix_inputs, [array])
        self.count[2] = len(node)
        self._place[node] = np.arange(len(node))
        self._dense[1]()
        return self._dense[0][: n * n].reshape(n, n)

    def contacts(self) -> np.ndarray:
        """(k, 5) sample, geom and anchor (in the geom's frame) [m] of what touches."""
        nsample = self._nsample
        geom = self._geom[: len(self.number) * nsample, 0]
        here = np.flatnonzero(geom >= 0)
        out = np.empty((len(here), 5))
        out[:, 0] = self.number[here // nsample] * nsample + here % nsample
        out[:, 1], out[:, 2:] = geom[here], self._trial[here, 0]
        return out

    def sample_forces(self) -> np.ndarray:
        """(k, 3) forces on the samples that `contacts` lists [N]."""
        n = len(self.number) * self._nsample
        return self._sample_force[:n, 0][self._geom[:n, 0] >= 0]

    def loads(self) -> tuple[np.ndarray, np.ndarray]:
        """Force and moment (ngroup, 6) of the geoms on the skin, and each group's share (ngroup, nnode) in
        the contact of each node."""
        self._loads()
        share = self._share[:, : self.count[1]]
        if len(share) > 1:
            return self._load, share / np.maximum(share.sum(0), 1e-12)
        return self._load, np.ones_like(share)
