"""The skins of a batch inside `mujoco_warp.step`: launches only, so that the step can be captured in a CUDA
graph.

Once per step, when mujoco_warp asks for passive forces, as `coupling/world.py` does for one world:
1. the linear models of the last step enter the dynamics, and mujoco_warp's own later stages say where the
   bodies go;
2. the skins are solved there;
3. their new linear models take the old ones' place, and mujoco_warp goes on.
The readings are written when it asks for the velocity sensors.
"""

import typing

import mujoco
import numpy as np
import warp as wp

from ..coupling.touching import Touching
from . import dynamics
from .skin import BatchSkin
from .skins import Skins

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw


__all__ = ["Batch", "Hook"]


class Batch(Skins):
    """One BioTac in every world of a mujoco_warp Data; made by `biotac_mj.batch.attach`.

    Attributes besides those of `Skins`:
      active: False leaves the skins out of `mjw.step` and `mjw.forward`: nothing is solved, nothing acts.
    """

    def __init__(
        self,
        mjm: mujoco.MjModel,
        touching: Touching,
        slots: dict,
        skin: BatchSkin,
        film: object,
        acquisition: object,
        addresses: list,
        two_way: bool,
    ):
        super().__init__(touching, skin, film, acquisition, mjm.opt.timestep, addresses)
        self.active = True
        self.moving = two_way and mjm.nv > 0  # whether forces change where anything goes
        weld = sorted(set(slots.values()))
        group_slot = [weld.index(slots[g]) if g in slots else -1 for g in range(skin.ngroup)]
        with wp.ScopedDevice(self.device):
            self._slot = wp.array(np.array(weld, np.int32), dtype=int)
            self._group_slot = wp.array(np.array(group_slot, np.int32), dtype=int)
            self._row = wp.full((len(weld), self.nworld), -1, dtype=int)
            self._jacobian = wp.zeros((*self.groups, mjm.nv), dtype=wp.spatial_vectord)
            self._start_pos, self._start_mat = (
                wp.zeros(self.groups, dtype=wp.vec3d),
                wp.zeros(self.groups, dtype=wp.mat33d),
            )
            self._wrench = wp.zeros(self.groups, dtype=wp.spatial_vectord)

    def predict(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Where the bodies go without acceleration, and their Jacobians; finds this step's rows."""
        arrays = [m.body_rootid, m.body_isdofancestor, d.xpos, d.xmat, d.subtree_com, d.cvel, d.cdof]
        self._launch(
            dynamics.advance_groups,
            self.groups,
            [self._core, self._body, self.dt, *arrays],
            [self._start_pos, self._start_mat, self._jacobian],
        )
        if self.moving:
            self._launch(
                dynamics.find_rows, self._row.shape, [self._slot, d.ne, d.efc.type, d.efc.id], [self._row]
            )

    def act(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Puts the linear models into the forces and the rows."""
        model = [self.wrench0, self.tangent0, self.pos0, self.mat0]
        self._launch(
            dynamics.linear_models, self.groups, [self._start_pos, self._start_mat, *model], [self._wrench]
        )
        self._launch(
            dynamics.add_forces, d.qfrc_passive.shape, [self._jacobian, self._wrench], [d.qfrc_passive]
        )
        efc = d.efc
        self._launch(
            dynamics.write_rows,
            self._row.shape,
            [self.dt**2, self._group_slot, self._row, self._jacobian, self.tangent0]
            + [int(m.is_sparse), efc.J_rownnz, efc.J_rowadr, efc.J_colind],
            [efc.J, efc.D, efc.aref, efc.pos],
        )

    def solve_skins(self, m: "mjw.Model", d: "mjw.Data", accelerated: bool) -> None:
        """Solves the skins where the bodies go, with d.qacc or without acceleration."""
        pos, mat = self._start_pos, self._start_mat
        if accelerated:
            self._launch(
                dynamics.follow,
                self.groups,
                [self.dt**2, self._jacobian, d.qacc, pos, mat],
                [self._pos, self._mat],
            )
            pos, mat = self._pos, self._mat
        if self.skin.inertial:
            skin, data = self.skin, self.skin.data
            arrays = [
                m.body_rootid,
                m.body_isdofancestor,
                d.xpos,
                d.xmat,
                d.subtree_com,
                d.cvel,
                d.cdof,
                d.qacc,
            ]
            self._launch(
                dynamics.advance_core,
                self.nworld,
                [self._core, self.dt, int(accelerated), *arrays],
                [skin.core_pos, skin.core_mat, data.frame_pos, data.frame_mat],
            )
        self.solve_at(pos, mat, m.geom_pos, m.geom_quat)


class Hook:
    """What a mujoco_warp Model calls: all batches of the Model step together, after callbacks that were there
    before."""

    def __init__(self, m: "mjw.Model"):
        self.batches = []
        self._passive, self._sensor = m.callback.passive, m.callback.sensor
        self._outside = None
        m.callback.passive, m.callback.sensor = self.passive, self.sensor

    @classmethod
    def of(cls, m: "mjw.Model") -> "Hook":
        """The Model's hook, made when first asked for."""
        there = getattr(m.callback.passive, "__self__", None)
        return there if isinstance(there, cls) else cls(m)

    def add(self, batch: Batch) -> None:
        self.batches.append(batch)

    def passive(self, m: "mjw.Model", d: "mjw.Data") -> None:
        if self._passive:
            self._passive(m, d)
        batches = [b for b in self.batches if b.active]
        for batch in batches:
            batch.predict(m, d)
        moving = [b for b in batches if b.moving]
        if moving:
            if self._outside is None:
                self._outside = wp.empty_like(d.qfrc_passive)
            wp.copy(self._outside, d.qfrc_passive)
            for batch in moving:
                batch.act(m, d)
            _accelerate(m, d)
        for batch in batches:
            batch.solve_skins(m, d, batch.moving)
        if moving:
            wp.copy(d.qfrc_passive, self._outside)
            for batch in moving:
                batch.act(m, d)

    def sensor(self, m: "mjw.Model", d: "mjw.Data", stage: object) -> None:
        from mujoco_warp._src.types import Stage

        if self._sensor:
            self._sensor(m, d, stage)
        if stage == Stage.VEL:
            for batch in self.batches:
                if batch.active:
                    batch.sense(d.sensordata)


def _accelerate(m, d):
    """The accelerations under the present passive forces and rows, by mujoco_warp's own later stages; it does
    them again afterwards."""
    import mujoco_warp as mjw
    from mujoco_warp._src import smooth

    mjw.rne(m, d)
    if m.ntendon:
        smooth.tendon_bias(m, d, d.qfrc_bias)
    if not m.opt.disableflags & mjw.DisableBit.ACTUATION and m.callback.control:
        m.callback.control(m, d)
    mjw.fwd_actuation(m, d)
    mjw.fwd_acceleration(m, d, factorize=True)
    mjw.solve(m, d)
    wp.copy(d.qacc_warmstart, d.qacc)
