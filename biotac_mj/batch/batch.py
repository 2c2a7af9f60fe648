"""The skins of a batch inside `mujoco_warp.step`: launches only, so that the step can be captured in a CUDA graph.

Once per step, when mujoco_warp asks for passive forces, as `coupling/world.py` does for one world:
1. the linear models of the last step enter the dynamics, and mujoco_warp's own later stages say where the bodies go;
2. the skins are solved there;
3. their new linear models take the old ones' place, and mujoco_warp goes on.
The readings are written when it asks for the velocity sensors.
"""

import numpy as np
import warp as wp

from . import kernels

__all__ = ["Batch", "Hook"]

real = wp.float64


class Batch:
    """One BioTac in every world of a mujoco_warp Data; made by `biotac_mj.batch.attach`.

    Attributes:
      nworld: number of worlds.
      skin: the `BatchSkin`, with its arrays on the device.
      film, acquisition: `BatchFilm`, `BatchAcquisition`, or None.
      failed: (nworld,) wp.array int, steps that did not converge since the reset; bad: (nworld,) whether the last pose was refused.
      active: False leaves the skins out of `mjw.step` and `mjw.forward`: nothing is solved, nothing acts.
      wrench0, tangent0: (ngroup, nworld) linear models in force, of the skin ON each touching body in the BioTac frame.
    """

    def __init__(self, mjm, m, d, touching, slots, skin, film, acquisition, addresses, two_way):
        self.nworld, self.skin, self.film, self.acquisition = d.nworld, skin, film, acquisition
        self.active = True
        self.moving = two_way and mjm.nv > 0  # whether forces change where anything goes
        self._dt = float(mjm.opt.timestep)
        self._core = int(touching.core)
        self.device = skin.model.device
        ngroup, nworld = skin.ngroup, d.nworld
        weld = sorted(set(slots.values()))
        with wp.ScopedDevice(self.device):
            self._body = wp.array(touching.body.astype(np.int32), dtype=int)
            self._geom = wp.array(touching.geom.astype(np.int32), dtype=int)
            self._group = wp.array(touching.group.astype(np.int32), dtype=int)
            self._slot = wp.array(np.array(weld, np.int32), dtype=int)
            self._group_slot = wp.array(np.array([weld.index(slots[g]) if g in slots else -1 for g in range(ngroup)], np.int32), dtype=int)
            self._addresses = wp.array(np.array(addresses, np.int32), dtype=int)
            self._row = wp.full((len(weld), nworld), -1, dtype=int)
            self._jacobian = wp.zeros((ngroup, nworld, mjm.nv), dtype=wp.spatial_vectord)
            self._start_pos, self._pos, self.pos0 = (wp.zeros((ngroup, nworld), dtype=wp.vec3d) for _ in range(3))
            self._start_mat, self._mat, self.mat0 = (wp.zeros((ngroup, nworld), dtype=wp.mat33d) for _ in range(3))
            self._wrench = wp.zeros((ngroup, nworld), dtype=wp.spatial_vectord)
            self.wrench0 = wp.zeros((ngroup, nworld), dtype=wp.spatial_vectord)
            self.tangent0 = wp.zeros((ngroup, nworld), dtype=wp.spatial_matrixd)
            self._started, self.failed, self.bad = (wp.zeros(nworld, dtype=int) for _ in range(3))
            self._valid = film.valid if film else wp.ones(nworld, dtype=int)
            self._no_state = wp.zeros((nworld, 69), dtype=real)
            self._all = wp.full(nworld, True, dtype=bool)
        if acquisition is None:
            self._addresses.assign(np.array([*[-1] * 5, *addresses[5:]], np.int32))
        self.reset()

    def reset(self, world_mask=None):
        """Puts skins, sensors and their clocks of some worlds back to rest, as mjw.reset_data does with the rest of the world.

        Args:
          world_mask: (nworld,) of bool, a wp.array or on the host; None resets all.

        Raises:
          ValueError: another shape.
        """
        mask = self._all
        if world_mask is not None:
            mask = (
                world_mask if isinstance(world_mask, wp.array) else wp.array(np.asarray(world_mask, bool), dtype=bool, device=self.device)
            )
            if mask.shape != (self.nworld,) or mask.dtype is not wp.bool:
                raise ValueError(f"world_mask has shape {mask.shape} and type {mask.dtype}: pass ({self.nworld},) of bool, True resets")
        self.skin.reset(mask)
        self._launch(
            kernels.reset_models,
            self.nworld,
            [mask],
            [self.wrench0, self.tangent0, self.pos0, self.mat0, self._started, self.failed, self.bad],
        )
        if self.acquisition:
            self.acquisition.reset(mask)

    @property
    def vert_xpos(self):
        """(nworld, nvert, 3) nodes of the skins in the BioTac frame [m], a copy on the host."""
        return np.swapaxes(self.skin.x.numpy(), 0, 1).copy()

    @property
    def wrench(self):
        """(nworld, ngroup, 6) of the skin ON each touching body, BioTac frame, about its origin [N, N m], a copy on the host."""
        return np.swapaxes(self.wrench0.numpy(), 0, 1).copy()

    def predict(self, m, d):
        """Where the bodies go without acceleration, and their Jacobians; finds this step's rows."""
        arrays = [m.body_rootid, m.body_isdofancestor, d.xpos, d.xmat, d.subtree_com, d.cvel, d.cdof]
        self._launch(
            kernels.advance_groups,
            self._body_dim,
            [self._core, self._body, self._dt, *arrays],
            [self._start_pos, self._start_mat, self._jacobian],
        )
        if self.moving:
            self._launch(kernels.find_rows, self._row.shape, [self._slot, d.ne, d.efc.type, d.efc.id], [self._row])

    def act(self, m, d):
        """Puts the linear models into the forces and the rows."""
        model = [self.wrench0, self.tangent0, self.pos0, self.mat0]
        self._launch(kernels.linear_models, self._body_dim, [self._start_pos, self._start_mat, *model], [self._wrench])
        self._launch(kernels.add_forces, d.qfrc_passive.shape, [self._jacobian, self._wrench], [d.qfrc_passive])
        efc = d.efc
        self._launch(
            kernels.write_rows,
            self._row.shape,
            [self._dt**2, self._group_slot, self._row, self._jacobian, self.tangent0]
            + [int(m.is_sparse), efc.J_rownnz, efc.J_rowadr, efc.J_colind],
            [efc.J, efc.D, efc.aref, efc.pos],
        )

    def solve(self, m, d, accelerated):
        """Solves the skins where the bodies go, with d.qacc or without acceleration."""
        skin, pos, mat = self.skin, self._start_pos, self._start_mat
        if accelerated:
            self._launch(kernels.follow, self._body_dim, [self._dt**2, self._jacobian, d.qacc, pos, mat], [self._pos, self._mat])
            pos, mat = self._pos, self._mat
        poses = [m.geom_pos, m.geom_quat, pos, mat]
        self._launch(kernels.geom_poses, skin.pos.shape, [self._geom, self._group, *poses], [skin.pos, skin.mat])
        skin.find_depth()
        self._launch(
            kernels.check_poses,
            self.nworld,
            [skin.depth, skin.model.options.max_core_depth, self._started, skin.pos, skin.mat, skin.pos_last, skin.mat_last],
            [self.bad],
        )
        skin.step(self._dt)
        self._launch(
            kernels.accept_models,
            self._body_dim,
            [self.bad, skin.converged, skin.wrench, skin.tangent, pos, mat]
            + [self.wrench0, self.tangent0, self.pos0, self.mat0, self._started, self.failed],
            [],
        )

    def sense(self, d):
        """Film and acquisition of the step, then all readings into d.sensordata."""
        state = self._no_state
        if self.acquisition:
            self.film.solve(self.skin.x, self.acquisition.find_due(self._dt))
            self.acquisition.advance(self._dt, self.film.impedance, self.film.valid, self.skin.pressure)
            state = self.acquisition.state
        skin = self.skin
        self._launch(
            kernels.write_sensors,
            self.nworld,
            [self._addresses, state, self.wrench0, self.bad, self._valid, skin.converged, self.failed, skin.iterations, skin.error],
            [d.sensordata],
        )

    @property
    def _body_dim(self):
        return self.wrench0.shape

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


class Hook:
    """What a mujoco_warp Model calls: all batches of the Model step together, after callbacks that were there before."""

    def __init__(self, m):
        self.batches = []
        self._passive, self._sensor = m.callback.passive, m.callback.sensor
        self._outside = None
        m.callback.passive, m.callback.sensor = self.passive, self.sensor

    @classmethod
    def of(cls, m):
        """The Model's hook, made when first asked for."""
        there = getattr(m.callback.passive, "__self__", None)
        return there if isinstance(there, cls) else cls(m)

    def add(self, batch):
        self.batches.append(batch)

    def passive(self, m, d):
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
            batch.solve(m, d, batch.moving)
        if moving:
            wp.copy(d.qfrc_passive, self._outside)
            for batch in moving:
                batch.act(m, d)

    def sensor(self, m, d, stage):
        from mujoco_warp._src.types import Stage

        if self._sensor:
            self._sensor(m, d, stage)
        if stage == Stage.VEL:
            for batch in self.batches:
                if batch.active:
                    batch.sense(d)


def _accelerate(m, d):
    """The accelerations under the present passive forces and rows, by mujoco_warp's own later stages; it does them again afterwards."""
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
