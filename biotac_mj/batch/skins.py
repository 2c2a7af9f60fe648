"""The BioTacs of many worlds: skins, liquid and sensors. Poses are an input, so any simulator can step the
bodies."""

import types

import mujoco
import numpy as np
import warp as wp

from ..coupling.handle import SENSORS, sensor_widths
from ..coupling.implicit.poses import Bodies
from ..coupling.implicit.rounds import Marks, Model, make_model
from ..coupling.touching import Touching
from ..sensor.acquisition_kernels import place_of
from ..skin.program import Fork, compile_ahead, finish_compiling
from ..skin.state import GUESS, MEMORY, OUTCOME
from . import kernels
from .ahead import launched_by
from .senses import Senses
from .skin import BatchSkin, solve_group


class Skins:
    """One BioTac in each of `nworld` worlds, in the touching bodies' poses that the caller gives.

    Args:
      touching: `coupling.touching.Touching`, what can touch.
      skin: BatchSkin. senses: its sensors, or None.
      dt: time step [s].
      addresses: where each of SENSORS begins in the sensor data; -1: nowhere.

    Attributes:
      nworld: number of worlds.
      failed: (nworld,) wp.array int, steps that reached no equilibrium since the reset.
      model: `Model`, linear models in force: of the skin ON each touching body in the BioTac frame.
      began: (nworld,) wp.array int, whether a step was made since the reset.
      rest: `rest.Rest` of the skin, which skins take part in the step.
    """

    def __init__(
        self,
        touching: Touching,
        skin: BatchSkin,
        senses: Senses | None,
        dt: float,
        addresses: list,
    ):
        self.nworld, self.skin, self.senses = skin.nworld, skin, senses
        self.device, self.dt = skin.model.device, float(dt)
        self._core = int(touching.core)
        shape = skin.ngroup, skin.nworld
        design = skin.model.geometry.design
        self._place, self._widest = place_of(design), max(sensor_widths(design).values())
        if senses is None:
            addresses = [-1 if c in design.widths else a for c, a in zip(SENSORS, addresses)]
        with wp.ScopedDevice(self.device):
            self._body = wp.array(touching.body.astype(np.int32), dtype=int)
            self._bodies = Bodies(self._core, self._body)
            self._geom = wp.array(touching.geom.astype(np.int32), dtype=int)
            self._group = wp.array(touching.group.astype(np.int32), dtype=int)
            self._addresses = wp.array(np.array(addresses, np.int32), dtype=int)
            self.model, self._last = (make_model(*shape) for _ in range(2))
            self.failed, self.began = (wp.zeros(self.nworld, dtype=int) for _ in range(2))
            # how a step goes in which bodies and skin do not meet: one round, all of the push
            self._settled, self._rounds = (wp.ones(self.nworld, dtype=int) for _ in range(2))
            self._push = wp.ones(shape, dtype=wp.float64)
            self._valid = senses.film.valid if senses else wp.ones(self.nworld, dtype=int)
            self._no_state = wp.zeros((self.nworld, self._place.nstate), dtype=wp.float64)
            self._on_solid = wp.zeros(self.nworld, dtype=wp.spatial_vectord)  # core, nail and clamp
            self._all = wp.full(self.nworld, True, dtype=bool)
        self.rest = skin.rest
        if self.device.is_cuda:
            finish_compiling(compile_ahead(self.device, launched_by(self.reset)))
        self.reset()

    def reset(self, world_mask: wp.array | np.ndarray | None = None) -> None:
        """Puts skins, sensors and their clocks of some worlds back to rest, as mjw.reset_data does with the
        rest of the world.

        Args:
          world_mask: (nworld,) of bool, a wp.array or on the host; None resets all.

        Raises:
          ValueError: another shape.
        """
        mask = self._all
        if isinstance(world_mask, wp.array):
            mask = world_mask
        elif world_mask is not None:
            mask = wp.array(np.asarray(world_mask, bool), dtype=bool, device=self.device)
        if mask.shape != (self.nworld,) or mask.dtype is not wp.bool:
            raise ValueError(
                f"world_mask has shape {mask.shape} and type {mask.dtype}: "
                f"pass ({self.nworld},) of bool, True resets"
            )
        self.skin.reset(mask)
        self._launch(kernels.reset_models, self.nworld, [mask], [self.model, self.failed, self.began])
        self.rest.reset(mask)
        if self.senses:
            self.senses.reset(mask)

    @property
    def vert_xpos(self) -> np.ndarray:
        """(nworld, nvert, 3) nodes of the skins in the BioTac frame [m], a copy on the host."""
        return np.swapaxes(self.skin.x.numpy(), 0, 1).copy()

    @property
    def wrench(self) -> np.ndarray:
        """(nworld, ngroup, 6) of the skin ON each touching body, BioTac frame, about its origin [N, N m], a
        copy on the host."""
        return np.swapaxes(self.model.wrench0.numpy(), 0, 1).copy()

    def lasting(self) -> tuple[list[wp.array], list[wp.array]]:
        """The arrays that outlive a step: those with the worlds as their last axis, and those with the worlds
        as their first. A step from the same numbers in them, and the same world of the simulator, gives the
        same."""
        models = [getattr(self.model, name) for name in Model.vars]
        last = [*self.skin.state.of_role(MEMORY, GUESS, OUTCOME), *models, self.failed, self.began]
        return [*last, *self.rest.lasting], self.senses.lasting if self.senses else []

    @property
    def nbytes(self) -> int:
        """Device memory that grows with the number of worlds, of skins and sensors together [bytes]."""
        return self.skin.nbytes + (self.senses.nbytes if self.senses else 0)

    def begin_step(
        self, pos: wp.array, mat: wp.array, geom_pos: wp.array, geom_quat: wp.array, taking_part: Marks
    ) -> None:
        """Before the first `solve_at` of a step, with the bodies where they go without acceleration; marks
        worlds whose skin takes part in it. Launches only."""
        self.place_geoms(pos, mat, geom_pos, geom_quat)
        self.rest.begin_step(taking_part)
        if self.senses:
            self.senses.begin_step()

    def keep_models(self) -> None:
        """Keeps the linear models of the last step, before the first `solve_at`. Launches only."""
        for name in Model.vars:
            wp.copy(getattr(self._last, name), getattr(self.model, name))

    def end_step(self) -> None:
        """After the last one. Launches only."""
        self.rest.end_step(self.model, self._settled, self._rounds, self.failed, self.began)

    def solve_at(self, pos: wp.array, mat: wp.array, geom_pos: wp.array, geom_quat: wp.array) -> None:
        """Solves the skins of the wanted worlds for touching bodies at pos, mat [group, world] in the BioTac
        frame. Launches only.

        Args:
          geom_pos, geom_quat: mujoco_warp's arrays (1 or nworld, ngeom) of the geoms on their bodies.
        """
        self.place_geoms(pos, mat, geom_pos, geom_quat)
        self.rest.begin_solve()
        self.skin.begin_solve()
        solve_group([self.skin], Fork(self.device, wanted=False))
        self.skin.end_solve()
        self.accept(pos, mat)

    def accept(self, pos: wp.array, mat: wp.array) -> None:
        """Takes the models of skins that were solved for bodies there. Launches only."""
        skin, st = self.skin, self.skin.data.worlds
        self.rest.come_to_rest()
        where = [pos, mat, skin.geoms.struct]
        solved = [st, self.began, skin.wrench, skin.tangent, skin.slack, self.rest.resets]
        self._launch(kernels.accept_models, self.groups, [*solved, *where, self._last], [self.model])

    def place_geoms(self, pos: wp.array, mat: wp.array, geom_pos: wp.array, geom_quat: wp.array) -> None:
        """Puts the skins' geoms on bodies as in `solve_at`."""
        skin, poses = self.skin, [geom_pos, geom_quat, pos, mat]
        self._launch(
            kernels.geom_poses, skin.pos.shape, [self._geom, self._group, *poses], [skin.pos, skin.mat]
        )

    def look(self, any: wp.array) -> None:
        """Updates the sensors' inputs of the step, before `solve_film`; any: see `Senses.look`. Launches
        only."""
        if self.senses:
            self.senses.look(self.model.wrench0, self.model.tangent0, self.rest.awake, any)

    def solve_film(self) -> None:
        """The film, where electrodes are sampled and skins have moved, before `sense`. Launches only."""
        if self.senses:
            self.senses.solve_film()

    def sense(self, sensordata: wp.array) -> None:
        """Acquisition of the step, then readings and status into sensordata (nworld, n) float. Launches
        only."""
        state, skin = self._no_state, self.skin
        if self.senses:
            state = self.senses.sample()
        read = [self._place, self._addresses, state]
        self._launch(kernels.write_sensors, (self.nworld, self._widest), read, [sensordata])
        how = [self._valid, self._settled, self.failed, self._rounds, self._push, skin.tier]
        status = [self._addresses, skin.data.worlds, *how]
        self._launch(kernels.write_status, self.nworld, status, [sensordata])

    @property
    def groups(self) -> tuple:
        """(ngroup, nworld)."""
        return self.model.wrench0.shape

    def _launch(self, kernel, dim, inputs, outputs=()):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


class PoseBatch(Skins):
    """For a simulator that has no callback: poses in, forces and readings out, between its steps. Made by
    `biotac_mj.batch.make`.

    The forces act in the simulator's next step, explicitly: with a touched mass m the step must stay below
    some 0.8 sqrt(m / k), k the contact's stiffness (docs/lab/coupling.md). Prescribed poses have no such
    limit.

    Attributes:
      xfrc_applied: (nworld, nbody, 6) wp.array float, force and torque [N, N m] on every body at its centre
        of mass, world frame.
      sensordata: (nworld, n) wp.array float, the channels of `readings` one after another.
    """

    def __init__(self, mjm: mujoco.MjModel, touching: Touching, skin: BatchSkin, senses: Senses | None):
        self._widths = sensor_widths(skin.model.geometry.design)
        widths = list(self._widths.values())
        super().__init__(touching, skin, senses, mjm.opt.timestep, [0, *np.cumsum(widths)[:-1]])
        with wp.ScopedDevice(self.device):
            self._geom_pos = wp.array(mjm.geom_pos[None].astype(np.float32), dtype=wp.vec3)
            # (w, x, y, z), as mujoco_warp keeps it
            self._geom_quat = wp.array(mjm.geom_quat[None].astype(np.float32), dtype=wp.quat)
            self._pos = wp.zeros(self.groups, dtype=wp.vec3d)
            self._mat = wp.zeros(self.groups, dtype=wp.mat33d)
            self._taking_part, self._films = Marks(self.nworld), wp.zeros(1, dtype=int)
            self.xfrc_applied = wp.zeros((self.nworld, mjm.nbody, 6), dtype=float)
            self.sensordata = wp.zeros((self.nworld, sum(widths)), dtype=float)

    def step(self, xpos: np.ndarray, xmat: np.ndarray, xipos: np.ndarray) -> None:
        """Solves the skins where the bodies are, and writes `xfrc_applied` and `sensordata`. Launches only.

        Args:
          xpos, xipos: (nworld, nbody, 3) float, frames and centres of mass of the bodies [m]; xmat: (nworld,
            nbody, 3, 3). Arrays of Warp, or of anything that speaks DLPack (JAX, torch), on the batch's
            device; they are not copied.

        Raises:
          ValueError: a wrong shape, not single precision, or on another device.
        """
        shape = self.xfrc_applied.shape[:2]
        xpos, xmat, xipos = (
            _as(array, dtype, shape, name, self.device)
            for name, array, dtype in (
                ("xpos", xpos, wp.vec3),
                ("xmat", xmat, wp.mat33),
                ("xipos", xipos, wp.vec3),
            )
        )
        at = types.SimpleNamespace(xpos=xpos, xmat=xmat)
        self._launch(*self._bodies.here(at, self._pos, self._mat))
        if self.skin.inertial:
            skin, data = self.skin, self.skin.data
            self._launch(
                kernels.core_pose,
                self.nworld,
                [self._core, xpos, xmat, skin.fresh],
                [data.frame_pos, data.frame_mat, skin.core_pos, skin.core_mat],
            )
        where = self._pos, self._mat, self._geom_pos, self._geom_quat
        self.begin_step(*where, self._taking_part)
        wp.capture_if(self.rest.any, lambda: (self.keep_models(), self.solve_at(*where)))
        self.end_step()
        bodies = [self._core, self._body, self.model.wrench0, xpos, xmat, xipos]
        self._launch(kernels.body_forces, self.nworld, bodies, [self.xfrc_applied])
        self._films.zero_()
        self.look(self._films)
        wp.capture_if(self._films, self.solve_film)
        self.sense(self.sensordata)
        force = [self._addresses, self.model.wrench0, self.skin.fraction, self._on_solid]
        self._launch(kernels.write_force, (self.nworld, 6), force, [self.sensordata])

    def readings(self) -> dict:
        """{channel: (nworld, dim)} views of `sensordata`."""
        ends = np.cumsum(list(self._widths.values())).tolist()
        return {
            name: self.sensordata[:, end - width : end]
            for (name, width), end in zip(self._widths.items(), ends)
        }


def _as(array, dtype, shape, name, device):
    """A (nworld, nbody) wp.array of dtype over the memory of a wp.array or of another library's (nworld,
    nbody, ...) array."""
    full = (*shape, *dtype._shape_)
    if isinstance(array, wp.array) and array.dtype is dtype:
        full, whole = shape, array
    else:
        whole = array if isinstance(array, wp.array) else wp.from_dlpack(array)
    if whole.shape != full or (full != shape and whole.dtype is not wp.float32):
        raise ValueError(f"{name} has shape {whole.shape} of {whole.dtype.__name__}: pass {full} of float32")
    if whole.device != wp.get_device(device):
        raise ValueError(f"{name} is on {whole.device}, the batch on {device}: bring it there")
    made = wp.array(
        ptr=whole.ptr, shape=shape, dtype=dtype, device=whole.device, capacity=whole.capacity, copy=False
    )
    made._ref = whole  # whose memory it is: the caller may have no other name for it
    return made
