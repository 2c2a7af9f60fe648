"""mujoco_warp's contacts and constraint rows as structs of its arrays, by its names."""

import typing

import warp as wp

from ..coupling.implicit.rows import ROWS
from ..kernels import set_fields

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

Rows = ROWS[wp.float32]
vec5 = wp.types.vector(length=5, dtype=wp.float32)


@wp.struct
class Contacts:
    """Contacts of all worlds, one after another. Their number `nacon` may exceed the room for them."""

    nacon: wp.array(dtype=int)
    dist: wp.array(dtype=float)
    pos: wp.array(dtype=wp.vec3)
    frame: wp.array(dtype=wp.mat33)
    includemargin: wp.array(dtype=float)
    friction: wp.array(dtype=vec5)
    solref: wp.array(dtype=wp.vec2)
    solreffriction: wp.array(dtype=wp.vec2)
    solimp: wp.array(dtype=vec5)
    dim: wp.array(dtype=int)
    geom: wp.array(dtype=wp.vec2i)
    efc_address: wp.array2d(dtype=int)
    worldid: wp.array(dtype=int)
    type: wp.array(dtype=int)
    adhesion: wp.array(dtype=float)


@wp.func
def copy_contact(source: Contacts, s: int, target: Contacts, t: int):
    """Makes contact t of the target what contact s of the source is."""
    target.dist[t] = source.dist[s]
    target.pos[t] = source.pos[s]
    target.frame[t] = source.frame[s]
    target.includemargin[t] = source.includemargin[s]
    target.friction[t] = source.friction[s]
    target.solref[t] = source.solref[s]
    target.solreffriction[t] = source.solreffriction[s]
    target.solimp[t] = source.solimp[s]
    target.dim[t] = source.dim[s]
    target.geom[t] = source.geom[s]
    target.worldid[t] = source.worldid[s]
    target.type[t] = source.type[s]
    target.adhesion[t] = source.adhesion[s]
    for k in range(source.efc_address.shape[1]):
        target.efc_address[t, k] = source.efc_address[s, k]


def contacts_of(d: "mjw.Data") -> Contacts:
    """The contacts of a Data."""
    own = {name: getattr(d.contact, name) for name in Contacts.vars if name != "nacon"}
    return set_fields(Contacts(), nacon=d.nacon, **own)


def rows_of(m: "mjw.Model", d: "mjw.Data") -> Rows:
    """The constraint rows of a Data."""
    own = {name: getattr(d.efc, name) for name in Rows.vars if name != "sparse"}
    return set_fields(Rows(), sparse=int(m.is_sparse), **own)
