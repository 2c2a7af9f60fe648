"""mujoco_warp's contacts of core, nail and clamp with what a skin meets, made those of the shapes that it
meets, and their forces: `coupling/solid_contacts.py` for all worlds at once. Their friction, which is not
known when `add` makes them, and forces by the skins of other BioTacs."""

import typing

import mujoco
import numpy as np
import warp as wp

from ..coupling.config import Config
from ..coupling.implicit.rounds import MarkedWorlds, Marks, mark
from ..coupling.solid_contacts import SolidPairs
from ..kernels import kernel_module
from ..skin.contact.overlap import MOST
from ..skin.types import double, mat33, real, vec3, vec6, widen
from .engine import Contacts, Rows, contacts_of, copy_contact

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

kernel_module(__name__)

_CONSTRAINT = wp.constant(1)  # bit of mujoco_warp's ContactType
_MINMU = wp.constant(wp.float32(mujoco.mjMINMU))


@wp.kernel
def amend_contacts(
    # In:
    nshapes: int,
    part_of: wp.array(dtype=int),
    shape_of: wp.array(dtype=int),
    met: wp.array(dtype=int),
    # In and out:
    contact: Contacts,
    # Out:
    wanted_out: wp.array2d(dtype=int),
    source_out: wp.array2d(dtype=int),
    any_out: wp.array(dtype=int),
    stopped: MarkedWorlds,
):
    """Removes the margins of a BioTac's rigid parts and what lies within them, friction of none, and contacts
    with convex hulls of non-convex shapes. The last of these of each pair [pair, world] is the template of
    those that replace it."""
    i = wp.tid()
    if i >= contact.nacon[0]:
        return
    g = contact.geom[i]
    if g[0] < 0 or g[1] < 0:  # a flex
        return
    for k in range(2):
        part = part_of[g[k]]
        other = g[1 - k]
        if part >= 0 and met[other] == 1:
            w = contact.worldid[i]
            mark(stopped, w)
            contact.includemargin[i] = 0.0
            if contact.friction[i][0] <= _MINMU:
                contact.dim[i] = 1
            shape = shape_of[other]
            apart = contact.dist[i] >= 0.0
            if (contact.type[i] & _CONSTRAINT) == 0 or not (apart or shape >= 0):
                continue
            contact.type[i] = contact.type[i] - _CONSTRAINT
            if not apart:
                wanted_out[part * nshapes + shape, w] = 1
                wp.atomic_max(source_out, part * nshapes + shape, w, i)
                any_out[0] = 1


@wp.kernel
def place_shapes(
    # In:
    core: int,
    nparts: int,
    shape: wp.array(dtype=int),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    geom_xpos: wp.array2d(dtype=wp.vec3),
    geom_xmat: wp.array2d(dtype=wp.mat33),
    # Out:
    pos_out: wp.array2d(dtype=vec3),
    mat_out: wp.array2d(dtype=mat33),
):
    """Poses of the shapes in the BioTac frame, behind those of the parts [solid, world]."""
    s, w = wp.tid()
    turn = wp.transpose(widen(xmat[w, core]))
    pos_out[nparts + s, w] = turn * (double(geom_xpos[w, shape[s]]) - double(xpos[w, core]))
    mat_out[nparts + s, w] = turn * widen(geom_xmat[w, shape[s]])


@wp.kernel
def append_contacts(
    # In:
    core: int,
    part_of: wp.array(dtype=int),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    source: wp.array2d(dtype=int),
    found_pos: wp.array3d(dtype=vec3),
    found_normal: wp.array3d(dtype=vec3),
    found_depth: wp.array3d(dtype=real),
    # In and out:
    contact: Contacts,
):
    """Adds what `Overlaps` found to mujoco_warp's contacts while there is room; their number counts those
    without room too, which shows the overflow."""
    pair, s, w = wp.tid()
    if found_depth[pair, s, w] <= real(0.0):
        return
    t = source[pair, w]
    i = wp.atomic_add(contact.nacon, 0, 1)
    if i >= contact.dist.shape[0]:
        return
    turn = widen(xmat[w, core])
    n = wp.vec3(turn * found_normal[pair, s, w])
    if part_of[contact.geom[t][0]] < 0:  # from the first geom to the second
        n = -n
    across = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(n[0]) > 0.6:
        across = wp.vec3(0.0, 1.0, 0.0)
    a = wp.normalize(wp.cross(n, across))
    b = wp.cross(n, a)
    copy_contact(contact, t, contact, i)
    contact.dist[i] = -float(found_depth[pair, s, w])
    contact.pos[i] = wp.vec3(turn * found_pos[pair, s, w] + double(xpos[w, core]))
    contact.frame[i] = wp.mat33(n[0], n[1], n[2], a[0], a[1], a[2], b[0], b[1], b[2])
    contact.type[i] = _CONSTRAINT
    for k in range(contact.efc_address.shape[1]):
        contact.efc_address[i, k] = -1


@wp.kernel
def sum_contacts(
    # In:
    core: int,
    geom_bodyid: wp.array(dtype=int),
    contact: Contacts,
    force: wp.array(dtype=wp.spatial_vector),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    # In and out:
    wrench: wp.array(dtype=vec6),
):
    """Adds up the contacts of all worlds on the geoms of body `core`; forces and torques are those of
    `mujoco_warp.contact_force` in the world's frame."""
    i = wp.tid()
    if i >= contact.nacon[0] or contact.efc_address[i, 0] < 0:
        return
    sign = real(0.0)  # it acts on the second
    for k in range(2):
        g = contact.geom[i][k]
        if g >= 0:  # -1: a flex
            if geom_bodyid[g] == core:
                sign += real(2 * k - 1)
    if sign == real(0.0):
        return
    w = contact.worldid[i]
    turn = wp.transpose(widen(xmat[w, core]))
    push = sign * double(wp.spatial_top(force[i]))
    twist = sign * double(wp.spatial_bottom(force[i]))
    twist += wp.cross(double(contact.pos[i]) - double(xpos[w, core]), push)
    f = turn * push
    t = turn * twist
    wp.atomic_add(wrench, w, vec6(f[0], f[1], f[2], t[0], t[1], t[2]))


@wp.kernel
def find_lift(
    # In:
    core: int,
    body: wp.array(dtype=int),
    step: real,
    geom_bodyid: wp.array(dtype=int),
    contact: Contacts,
    rows: Rows,
    qvel: wp.array2d(dtype=float),
    qacc: wp.array2d(dtype=float),
    # In and out:
    lifted: wp.array2d(dtype=real),
):
    """Adds up the work that contacts with body `core` do on the touching bodies in the step [J]."""
    i = wp.tid()
    if i >= contact.nacon[0] or contact.efc_address[i, 0] < 0:
        return
    geom = contact.geom[i]
    if wp.min(geom[0], geom[1]) < 0:  # -1: a flex
        return
    first, second = geom_bodyid[geom[0]], geom_bodyid[geom[1]]
    if first != core and second != core:
        return
    w = contact.worldid[i]
    work = real(0.0)
    for k in range(contact.efc_address.shape[1]):
        r = contact.efc_address[i, k]
        if r >= 0 and rows.force[w, r] != 0.0:
            speed = real(0.0)
            entries = int(qvel.shape[1])
            if rows.sparse == 1:
                entries = rows.J_rownnz[w, r]
            for n in range(entries):
                line = int(r)
                at = int(n)
                column = int(n)
                if rows.sparse == 1:
                    line = 0
                    at = rows.J_rowadr[w, r] + n
                    column = rows.J_colind[w, 0, at]
                mean = real(qvel[w, column]) + real(0.5) * step * real(qacc[w, column])
                speed += real(rows.J[w, line, at]) * mean
            work += step * real(rows.force[w, r]) * speed
    for g in range(body.shape[0]):
        if body[g] == wp.where(first == core, second, first):
            wp.atomic_add(lifted, g, w, work)


@wp.kernel
def add_push(
    # In:
    core: int,
    other: int,
    group: int,
    acting: wp.array2d(dtype=vec6),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    # In and out:
    wrench: wp.array(dtype=vec6),
):
    """Adds what the skin of BioTac `other` does to BioTac `core`, its touching body `group`."""
    w = wp.tid()
    turn = wp.transpose(widen(xmat[w, core])) * widen(xmat[w, other])
    offset = wp.transpose(widen(xmat[w, core])) * (double(xpos[w, other]) - double(xpos[w, core]))
    push = turn * wp.spatial_top(acting[group, w])
    twist = turn * wp.spatial_bottom(acting[group, w]) + wp.cross(offset, push)
    wrench[w] += vec6(push[0], push[1], push[2], twist[0], twist[1], twist[2])


class SolidContacts:
    """Contacts of the rigid parts of one BioTac in every world.

    Attributes:
      stopped: `Marks` of worlds that had some when they were last amended.
    """

    def __init__(self, pairs: SolidPairs, nworld: int, device: wp.DeviceLike):
        self._core, self._nworld, self._device = pairs.core, nworld, wp.get_device(device)
        self._overlaps = pairs.overlaps(nworld, device) if len(pairs.shape) else None
        npair = max(len(pairs.part) * len(pairs.shape), 1)
        with wp.ScopedDevice(device):
            numbers = pairs.part_of, pairs.shape_of, pairs.met
            self._of_geoms = [wp.array(a.astype(np.int32), dtype=int) for a in numbers]
            self._shape = wp.array(pairs.shape.astype(np.int32), dtype=int)
            self._wanted = wp.zeros((npair, nworld), dtype=int)
            if self._overlaps:
                self._wanted = self._overlaps.wanted
            self._source = wp.zeros((npair, nworld), dtype=int)
            self._any, self.stopped = wp.zeros(1, dtype=int), Marks(nworld)

    def amend(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Makes the contacts what they should be, before constraints are made of them. Launches only."""
        for array in (self._wanted, self._source, self._any):
            array.zero_()
        self.stopped.clear()
        outputs = [contacts_of(d), self._wanted, self._source, self._any, self.stopped.struct]
        self._launch(amend_contacts, d.naconmax, [len(self._shape), *self._of_geoms], outputs)
        if self._overlaps:
            wp.capture_if(self._any, lambda: self._replace(d))

    def _replace(self, d):
        found = self._overlaps
        frames = [d.xpos, d.xmat, d.geom_xpos, d.geom_xmat]
        where = [self._core, found.nparts, self._shape, *frames]
        self._launch(place_shapes, (found.nshapes, self._nworld), where, [found.pos, found.mat])
        found.find()
        known = [self._core, self._of_geoms[0], d.xpos, d.xmat, self._source]
        known += [found.contact_pos, found.contact_normal, found.depth]
        self._launch(append_contacts, (found.npair, MOST, self._nworld), known, [contacts_of(d)])

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)


def set_solids(mjm: mujoco.MjModel, m: "mjw.Model", core: int, friction: np.ndarray, priority: int) -> None:
    """Gives the geoms of body `core`, and their pairs, the skins' friction (nworld,) and contact priority, as
    `biotac_mj.attach` does. Values that differ from those of `add` were set by the user, and stay."""
    left = Config()
    solid = np.flatnonzero(mjm.geom_bodyid == core)
    _set(m, "geom_friction", solid, slice(0, 1), np.full(len(solid), left.friction), friction[:, None])
    rank = m.geom_priority.numpy().copy()
    rank[solid] = np.where(rank[solid] == left.priority, priority, rank[solid])
    m.geom_priority.assign(rank)
    first = np.isin(mjm.pair_geom1, solid)
    pair = np.flatnonzero(first != np.isin(mjm.pair_geom2, solid))
    other = mjm.geom_friction[np.where(first, mjm.pair_geom2, mjm.pair_geom1)[pair], 0]
    was, now = (np.maximum(value, other) for value in (left.friction, friction[:, None]))
    _set(m, "pair_friction", pair, slice(0, 2), was, now)


def _set(m, name, items, parts, was, now):
    """Makes numbers (n,) of items of an array of the Model, where these they are, others (nworld, n or 1):
    of all worlds, or of each."""
    array = getattr(m, name)
    now = np.broadcast_to(now, (len(now), len(items)))
    if not len(items) or np.array_equal(now, np.broadcast_to(was, now.shape)):
        return
    table = array.numpy()
    if (now != now[0]).any():
        table = table[np.arange(len(now)) % len(table)]
    table, now = table.copy(), now[: len(table)]
    part = table[:, items, parts]
    table[:, items, parts] = np.where(np.isclose(part, was[:, None]), now[:, :, None], part)
    if len(table) == len(array):
        array.assign(table)
    else:
        setattr(m, name, wp.array(table, dtype=array.dtype, device=array.device))
