"""Factors of the inertias of all worlds of mujoco_warp."""

import typing

import warp as wp

from ...coupling.implicit.compliance import factor
from ...skin.program import Launcher
from ...skin.types import real

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

__all__ = ["Factor"]

_BLOCK = 64  # threads that factor a world's matrix


class Factor:
    """Cholesky's factors of inertias, with the springs that MuJoCo's constraints are.

    Args:
      m: mujoco_warp Model. nworld: number of worlds.

    Attributes:
      L: (nworld, nv, nv), lower triangles.
    """

    def __init__(self, m: "mjw.Model", nworld: int):
        self._inertia_rows = [m.M_rownnz, m.M_rowadr, m.M_colind]
        with wp.ScopedDevice(m.qpos0.device):
            self.L = wp.zeros((nworld, m.nv, m.nv), dtype=real)
            self._none = wp.zeros(nworld, dtype=int), wp.zeros((0, nworld), dtype=int)

    def find(
        self,
        m: "mjw.Model",
        d: "mjw.Data",
        going: wp.array,
        inertia: wp.array,
        springs: bool = True,
        own: wp.array | None = None,
    ) -> None:
        """Factors the inertias. Launches only.

        Args:
          going: (nworld,) of int, 1 where it is to be done.
          inertia: (nworld, nM) matrices laid out as mujoco_warp's M.
          springs: whether constraints hold, as its solver left them. own: (slot, nworld) the first of six
            rows each that do not.
        """
        efc, (none, no_slot) = d.efc, self._none
        held = [no_slot if own is None else own, d.nefc if springs else none]
        held += [efc.state, efc.J, efc.D, int(m.is_sparse), efc.J_rownnz, efc.J_rowadr, efc.J_colind]
        known = [going, inertia, *self._inertia_rows, *held]
        Launcher(self.L.device).launch_blocks(factor, [len(self.L)], known, [self.L], block_dim=_BLOCK)
