"""The skin under a batch of motions of one object: every interaction is a world."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from ..skin import SkinData, SkinModel, step
from .clearance import Placed
from .schema import DISPLACEMENT_SCALE, nodes_of

__all__ = ["Fields", "simulate", "simulate_condensed"]

_STRIDE = 1.0e-4  # [m] longest way between two steps of the skin: twice that costs convergence where edges dig in
_ARM = 4e-3  # [m] lever arm that turns of an object count with


@dataclasses.dataclass
class Fields:
    """What the skin did: k interactions of n time steps.

    Attributes:
      displacement: (k, n, nvert, 3) int16, in units of schema.DISPLACEMENT_SCALE; nodes against the unstressed skin.
      contact_force: (k, n, nouter, 3) float32 [N]; None where the condensed tier does not know it.
      wrench: (k, n, 6) of the skin on the object [N, N m]. pressure: (k, n) [Pa]. converged: (k, n) bool.
    """

    displacement: np.ndarray
    contact_force: np.ndarray | None
    wrench: np.ndarray
    pressure: np.ndarray
    converged: np.ndarray

    def vert_xpos(self, vert, i) -> np.ndarray:
        """(n, nvert, 3) nodes of interaction i as they are stored [m]; vert: the skin at rest."""
        return vert + self.displacement[i] * DISPLACEMENT_SCALE


def simulate(model: SkinModel, name: str, motions, progress=None) -> Fields:
    """Walks all motions at once. A step that does not converge keeps the last good state and is marked.

    Args:
      model: the skin, on any device.
      name: of the object that they share.
      motions: plan.Motions of equal length.
      progress: called after each time step.

    Raises:
      ValueError: an object deep inside the rigid core (plans keep clear of it).
    """
    nworld, nstep = len(motions), len(motions[0].pos)
    pos = np.stack([m.pos for m in motions], 1)  # (n, k, 3)
    turn = np.stack([m.mat for m in motions], 1)
    data = SkinData(model, nworld)
    placed = Placed(name, nworld, model.device, model.material.friction)
    outer = nodes_of(model.geometry)
    fields = _empty(nworld, nstep, model.nvert, len(outer))
    placed.place(pos[0], turn[0])
    for i in range(nstep):
        for at, mat in _between(pos[max(i - 1, 0)], turn[max(i - 1, 0)], pos[i], turn[i]):
            placed.place(at, mat)
            step(model, data, placed.geoms)
        # whether what is stored is in balance with the object where it is: failures on the way that were made good do not count
        fields.converged[:, i] = data.converged
        fields.displacement[:, i] = _units(data.vert_xpos - model.geometry.vert)
        fields.contact_force[:, i] = data.contact_force[:, outer]
        fields.wrench[:, i], fields.pressure[:, i] = data.wrench[:, 0], data.pressure
        if progress:
            progress()
    return fields


def simulate_condensed(model: SkinModel, name: str, motions, progress=None) -> Fields:
    """The same with the condensed skin, one interaction after another on one core; it has no contact forces of nodes.

    Raises:
      ValueError: the skin is inflated at rest, or an object deep inside the rigid core.
    """
    from ..skin.condensed import CondensedSkin, Memory

    nstep = len(motions[0].pos)
    placed = Placed(name, 1, model.device, model.material.friction)
    skin = CondensedSkin(model, placed.geoms)
    fields = _empty(len(motions), nstep, model.nvert, None)
    for k, motion in enumerate(motions):
        memory = Memory.rest(1)
        pos, mat = motion.pos[:, None], motion.mat[:, None]
        for i in range(nstep):
            for at, turn in _between(pos[max(i - 1, 0)], mat[max(i - 1, 0)], pos[i], mat[i]):
                at, turn = placed.pose(at, turn)
                out = skin.solve(memory, at[0], turn[0])
                memory = out.memory
            fields.converged[k, i], fields.wrench[k, i], fields.pressure[k, i] = out.converged, out.wrench[0], memory.pressure
            fields.displacement[k, i] = _units(out.vert_xpos - model.geometry.vert)
    if progress:
        progress(nstep)
    return fields


def _empty(nworld, nstep, nvert, nouter):
    return Fields(
        np.zeros((nworld, nstep, nvert, 3), np.int16),
        None if nouter is None else np.zeros((nworld, nstep, nouter, 3), np.float32),
        np.zeros((nworld, nstep, 6)),
        np.zeros((nworld, nstep)),
        np.ones((nworld, nstep), bool),
    )


def _units(displacement):
    return np.clip(np.rint(displacement / DISPLACEMENT_SCALE), -32767, 32767).astype(np.int16)


def _between(pos, mat, next_pos, next_mat):
    """Poses on the way from one time step to the next, the last one included; all worlds in equally many steps."""
    vector = Rotation.from_matrix(next_mat @ np.swapaxes(mat, 1, 2)).as_rotvec()
    way = np.linalg.norm(next_pos - pos, axis=1) + _ARM * np.linalg.norm(vector, axis=1)
    count = max(1, int(np.ceil(way.max() / _STRIDE - 1e-6)))
    for k in range(1, count):
        share = k / count
        yield pos + share * (next_pos - pos), Rotation.from_rotvec(share * vector).as_matrix() @ mat
    yield next_pos, next_mat
