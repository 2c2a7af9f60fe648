"""Forces on a BioTac other than the contacts of its own skin: mujoco_warp's contacts of core, nail and clamp
(`coupling/solid.py` for all worlds at once), and the skins of other BioTacs."""

import warp as wp

from ..kernels import kernel_module
from ..skin.types import double, real, vec6, widen
from .engine import Contacts, Rows

kernel_module(__name__)


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
