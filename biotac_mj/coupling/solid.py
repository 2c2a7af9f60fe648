"""Forces of MuJoCo's own contacts on the solid parts of a BioTac: core, nail and clamp."""

import ctypes

import numpy as np

from ..geometry.rigid import cross
from .solid_contacts import contacts_of
from .structs import LIBRARY, DataView, ModelView

LIBRARY.mj_contactForce.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
SOLVED = 1e-3  # of the forces at hand, which MuJoCo's constraint solver may leave open


def solid_wrench(model: ModelView, data: DataView, core: int, dofs: np.ndarray) -> tuple[np.ndarray, bool]:
    """(6,) force [N] and torque [N m] of contacts on the geoms of body `core`, about the origin of its frame
    and in that frame; and whether MuJoCo's solver finds them, on these dofs, to `SOLVED`.

    For when all passive forces are known and accelerations are not: where anything touches, MuJoCo's
    constraint solver runs in advance.
    """
    out = np.zeros(6)
    if not data.ncon:
        return out, True
    contacts = contacts_of(data)
    geom = contacts["geom"]
    mine = (geom >= 0) & (model.geom_bodyid[geom] == core)  # -1: a flex, or none
    touching = np.flatnonzero(mine.any(axis=1) & (contacts["efc_address"] >= 0))
    if not len(touching):
        return out, True
    solved = data.unsolved(data.acceleration(), dofs) < SOLVED
    found = np.empty(6)
    for i in touching:
        LIBRARY.mj_contactForce(model.address, data.address, int(i), found.ctypes.data)
        frame = contacts["frame"][i].reshape(3, 3)
        sign = float(mine[i, 1]) - float(mine[i, 0])  # it acts on the second
        force, torque = sign * found[:3] @ frame, sign * found[3:] @ frame
        out[:3] += force
        out[3:] += torque + cross((contacts["pos"][i] - data.xpos[core])[None], force[None])[0]
    frame = data.xmat[core].reshape(3, 3)
    return np.concatenate([out[:3] @ frame, out[3:] @ frame]), solved
