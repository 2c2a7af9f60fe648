"""A BioTac with the interface of Isaac Lab's sensors, for a simulation other than MuJoCo's.

`BioTacSensor` has the methods of `isaaclab.sensors.SensorBase` that a scene calls, but is no subclass of it,
because `SensorBase` needs a USD stage. `InteractiveScene` therefore does not create it from its
configuration; add it when the simulation is ready:

    scene.sensors["biotac"] = BioTacSensor(BioTacSensorCfg(model=model, poses=poses, num_envs=n))

The scene then updates and resets it with its own sensors. The skin gets the poses of bodies; its reaction is
in `forces`, for `set_external_force_and_torque` of the assets.
"""

import dataclasses
import typing
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from .. import batch
from .readings import BioTacData, world_mask

if typing.TYPE_CHECKING:
    import torch

__all__ = ["BioTacSensor", "BioTacSensorCfg"]

_EARLY = 1e-6  # [s] tolerance at the end of a period, for rounding errors of summed time steps


@dataclasses.dataclass(kw_only=True)
class BioTacSensorCfg:
    """Configuration.

    Attributes:
      model: MjModel of the BioTac and the objects that can touch it, made with `biotac_mj.batch.add(spec,
        coupling="one-way")`; its time step is the simulation's.
      poses: () -> {body name: ((n, 3) [m], (n, 4) w x y z)} of the model's moving bodies, torch tensors in
        one frame; other bodies stay at their poses in the model.
      num_envs: n. device: of Warp and torch.
      update_period: [s] between updates of `data`, 0 for every step. prim_path, history_length, debug_vis: as
        in `SensorBaseCfg`; there is no history and no drawing.
      settings: further arguments of `biotac_mj.batch.make`, such as {"skin": "coarse", "prefix": "biotac_"}.
    """

    model: mujoco.MjModel
    poses: Callable[[], dict]
    num_envs: int
    device: str = "cpu"
    update_period: float = 0.0
    prim_path: str = ""
    history_length: int = 0
    debug_vis: bool = False
    settings: dict = dataclasses.field(default_factory=dict)

    @property
    def class_type(self) -> type:
        """The sensor's class."""
        return BioTacSensor


class BioTacSensor:
    """BioTacs of all environments.

    Raises:
      ValueError: an invalid setting, or a history.
    """

    has_debug_vis_implementation = False
    supports_batch_update = False

    def __init__(self, cfg: BioTacSensorCfg):
        import torch

        if cfg.history_length or cfg.update_period < 0:
            raise ValueError(
                f"history_length is {cfg.history_length} and update_period {cfg.update_period}: no history "
                "is kept, take 0; the period is 0 or more"
            )
        self.cfg, model = cfg, cfg.model
        self.batch = batch.make(model, cfg.num_envs, cfg.device, **cfg.settings)
        rest = mujoco.MjData(model)
        mujoco.mj_kinematics(model, rest)
        self._rest = [self._tensor(x) for x in (rest.xpos, rest.xmat.reshape(-1, 3, 3))]
        self._ipos = self._tensor(model.body_ipos)
        self._pos, self._mat = (x.expand(cfg.num_envs, *x.shape).clone() for x in self._rest)
        self._elapsed = torch.full((cfg.num_envs,), cfg.update_period, device=cfg.device)
        self._data = self._read()

    def _tensor(self, value):
        import torch

        return torch.tensor(value, dtype=torch.float32, device=self.cfg.device)

    @property
    def is_initialized(self) -> bool:
        """Always True."""
        return True

    @property
    def num_instances(self) -> int:
        """Number of sensors: one per environment."""
        return self.cfg.num_envs

    @property
    def device(self) -> str:
        """Device of `data`."""
        return self.cfg.device

    @property
    def data(self) -> BioTacData:
        """Readings at each environment's last due update."""
        return self._data

    @property
    def forces(self) -> dict[str, "torch.Tensor"]:
        """{body name: (n, 6)} force and torque [N, N m] of the last update on the bodies in `poses` and on
        those fixed to them, such as the BioTac with its finger, at the named bodies' centres of mass, in the
        frame of the poses."""
        import torch
        import warp as wp

        applied, model = wp.to_torch(self.batch.xfrc_applied), self.cfg.model
        center = self._pos + (self._mat @ self._ipos[..., None])[..., 0]
        names = {model.body(name).id: name for name in self.cfg.poses()}
        found = {name: torch.zeros_like(applied[:, 0]) for name in names.values()}
        for body, top in self._attached(names):
            force = applied[:, body, :3]
            turning = torch.linalg.cross(center[:, body] - center[:, top], force)
            found[names[top]] += torch.cat([force, applied[:, body, 3:] + turning], dim=1)
        return found

    def set_debug_vis(self, debug_vis: bool) -> bool:
        """False: there is no drawing."""
        return False

    def update(self, dt: float, force_recompute: bool = False) -> None:
        """Call after a step of the simulation. The skin is solved every time, because it has memory; `data`
        is updated when the period is over.

        Args:
          dt: [s], the model's time step. force_recompute: update all data.

        Raises:
          ValueError: another time step, a body that the model does not have, or poses of another shape.
        """
        step = self.cfg.model.opt.timestep
        if abs(dt - step) > 1e-9 + 1e-6 * step:
            raise ValueError(f"dt is {dt:g} s, the model's time step {step:g} s: make them equal")
        self._place()
        self.batch.step(self._pos, self._mat, self._pos + (self._mat @ self._ipos[..., None])[..., 0])
        self._elapsed += dt
        due = (self._elapsed + _EARLY >= self.cfg.update_period) | force_recompute
        new = self._read()
        for field in dataclasses.fields(BioTacData):
            getattr(self._data, field.name)[due] = getattr(new, field.name)[due]
        self._elapsed[due] = 0.0

    def reset(self, env_ids: Sequence[int] | None = None, env_mask: object = None) -> None:
        """Resets skins and clocks of some environments; their next update is due.

        Args:
          env_ids: their numbers, None for all. env_mask: (n,) of bool instead, also of Warp.
        """
        if hasattr(env_mask, "numpy"):
            env_mask = env_mask.numpy()
        mask = world_mask(env_ids if env_mask is None else np.asarray(env_mask, bool), self.cfg.num_envs)
        self.batch.reset(mask)
        self._elapsed[mask.nonzero()[0]] = self.cfg.update_period

    def _place(self):
        """Moves the bodies, and those fixed to them, to `poses`."""
        model, n = self.cfg.model, self.cfg.num_envs
        there = [model.body(i).name for i in range(model.nbody)]
        poses = self.cfg.poses()
        for name, (pos, quat) in poses.items():
            if name not in there:
                raise ValueError(
                    f"poses name {name!r}: the model's bodies are {', '.join(filter(None, there))}"
                )
            if tuple(pos.shape) != (n, 3) or tuple(quat.shape) != (n, 4):
                raise ValueError(
                    f"poses of {name!r} have shapes {tuple(pos.shape)} and {tuple(quat.shape)}: ({n}, 3) and "
                    f"({n}, 4) are needed"
                )
        tops = {there.index(name): self._pose(*pose) for name, pose in poses.items()}
        for body, top in self._attached(tops):
            back = self._rest[1][top].T
            pos, mat = tops[top]
            self._pos[:, body] = pos + mat @ (back @ (self._rest[0][body] - self._rest[0][top]))
            self._mat[:, body] = mat @ (back @ self._rest[1][body])

    def _attached(self, tops):
        """(body, nearest of `tops` that it is or is fixed to) for all bodies fixed to one of these."""
        parent = self.cfg.model.body_parentid
        for body in range(1, self.cfg.model.nbody):
            top = body
            while top and top not in tops:
                top = int(parent[top])
            if top:
                yield body, top

    def _pose(self, pos, quat):
        """(n, 3), (n, 3, 3) from positions and quaternions w x y z."""
        import torch

        quat = quat / quat.norm(dim=1, keepdim=True)
        w, v = quat[:, 0, None, None], quat[:, 1:]
        x, y, z, o = *v.T, torch.zeros_like(quat[:, 0])
        cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).reshape(-1, 3, 3)
        return pos, torch.eye(3, device=quat.device) + 2 * (w * cross + cross @ cross)

    def _read(self):
        import warp as wp

        return BioTacData(
            **{name: wp.to_torch(value).clone() for name, value in self.batch.readings().items()}
        )
