"""Forces of MuJoCo's own contacts on the solid parts of a BioTac: core, nail and clamp."""

import ctypes

import numpy as np

from ..geometry.rigid import cross
from .solid_contacts import contacts_of
from .structs import LIBRARY, DataView, ModelView

LIBRARY.mj_contactForce.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
SOLVED = 1e-3  # of the forces at hand, which MuJoCo's constraint solver may leave open


def solid_wrench(
    model: ModelView, data: DataView, core: int, dofs: np.ndarray, trees: np.ndarray
) -> tuple[np.ndarray, bool]:
    """(2, 6) forces [N] and torques [N m] of contacts on the geoms of body `core`, about the origin of its
    frame and in that frame: of those that act on none of `trees` (ntree,) and of the others; and whether
    MuJoCo's solver finds them, on these dofs, to `SOLVED`.

    For when all passive forces are known and accelerations are not: where anything touches, MuJoCo's
    constraint solver runs in advance.
    """
    out = np.zeros((2, 6))
    if not data.ncon:
        return out, True
    contacts = contacts_of(data)
    geom = contacts["geom"]
    mine = (geom >= 0) & (model.geom_bodyid[geom] == core)  # -1: a flex, or none
    touching = (mine.any(axis=1) & (contacts["efc_address"] >= 0)).nonzero()[0]
    if not len(touching):
        return out, True
    solved = data.unsolved(data.acceleration(), dofs) < SOLVED
    which = data.trees_of_rows()[contacts["efc_address"][touching]][:, trees].any(axis=1)
    found, frame = np.empty(6), data.xmat[core].reshape(3, 3)
    for i, k in zip(touching, which.astype(int)):
        LIBRARY.mj_contactForce(model.address, data.address, int(i), found.ctypes.data)
        sign = float(mine[i, 1]) - float(mine[i, 0])  # it acts on the second
        force, torque = sign * found.reshape(2, 3) @ contacts["frame"][i].reshape(3, 3)
        torque += cross((contacts["pos"][i] - data.xpos[core])[None], force[None])[0]
        out[k] += np.concatenate([force @ frame, torque @ frame])
    return out, solved
