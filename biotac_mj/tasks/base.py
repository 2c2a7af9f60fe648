"""Common parts of all tasks: arena, machine with BioTacs, actions in [-1, 1], observables by preset, rewards
in [0, 1]."""

import abc

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from ..fields import as_real, check_choice
from ..short_repr import short_repr
from .biotac import ESTIMATED, PRIVILEGED, TACTILE, BioTac
from .robots import Gantry, Gripper

AWAY = (0.0, 0.0, -1.0)  # [m] position of unused mocap objects
CONTROL_TIMESTEP = 0.01  # [s] one frame of the sensor
_OBSERVE = {"tactile": TACTILE, "estimated": ESTIMATED, "privileged": TACTILE + PRIVILEGED, "none": ()}


def arena() -> composer.Arena:
    """A lit scene with a camera on the finger and nothing to touch."""
    out = composer.Arena()
    root = out.mjcf_model
    root.compiler.angle = "radian"
    root.option.integrator = "implicitfast"
    root.visual.headlight.set_attributes(ambient=[0.35] * 3, diffuse=[0.5] * 3, specular=[0.1] * 3)
    getattr(root.visual, "global").set_attributes(offwidth=1280, offheight=960)
    root.visual.map.set_attributes(znear=0.001, zfar=30)
    root.statistic.set_attributes(center=[0, 0, 0.01], extent=0.1)
    root.asset.add(
        "texture",
        name="sky",
        type="skybox",
        builtin="gradient",
        rgb1=[0.95, 0.97, 1.0],
        rgb2=[0.6, 0.65, 0.7],
        width=64,
        height=384,
    )
    root.worldbody.add(
        "light",
        pos=[-0.1, -0.2, 0.5],
        dir=[0.2, 0.4, -1],
        directional=True,
        castshadow=True,
        diffuse=[0.4] * 3,
    )
    root.worldbody.add(
        "camera", name="side", pos=[-0.075, -0.115, 0.06], xyaxes=[0.84, -0.55, 0, 0.22, 0.34, 0.91], fovy=35
    )
    return out


class TouchTask(composer.Task, abc.ABC):
    """A task of a machine with BioTacs.

    Args:
      observe: "tactile" (readings of a real sensor), "estimated" (contact position and force by a formula
        from these), "privileged" (also forces, patches and the skin) or "none" (no touch).
      physics_timestep: [s].
      biotac: settings of every `BioTac`.

    Attributes:
      estimated: names of the hidden state that a controller may estimate; `hidden(physics)` returns it, for
        calibration only.
    """

    estimated: tuple
    seconds = 4.0  # length of an episode

    def __init__(
        self,
        machine: Gantry | Gripper,
        mounts: list,
        observe: str = "tactile",
        physics_timestep: float = 5e-3,
        biotac: dict | None = None,
    ):
        check_choice("unknown preset of observe", observe, _OBSERVE)
        as_real("physics_timestep", physics_timestep)
        steps = CONTROL_TIMESTEP / physics_timestep if physics_timestep > 0 else 0.0
        if steps < 0.5 or abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"physics_timestep is {physics_timestep}: give seconds of which whole numbers make "
                f"{CONTROL_TIMESTEP:g}, a frame of the sensor, as 0.005 or 0.002"
            )
        if not isinstance(biotac, (dict, type(None))):
            raise ValueError(f"biotac is {short_repr(biotac)}: give a dict of settings of a BioTac")
        if "name" in (biotac or {}):
            raise ValueError(f"biotac has name {biotac['name']!r}: leave it out, a task names its sensors")
        self._arena, self.machine = arena(), machine
        self._arena.attach(machine)
        names = ["biotac"] if len(mounts) == 1 else [f"biotac_{i}" for i in range(len(mounts))]
        self.biotacs = [BioTac(name=name, **(biotac or {})) for name in names]
        for entity, mount in zip(self.biotacs, mounts, strict=True):
            machine.attach(entity, mount)
            entity.observables.enable(_OBSERVE[observe])
        self.set_timesteps(control_timestep=CONTROL_TIMESTEP, physics_timestep=physics_timestep)
        self._task_observables = {"position": observable.Generic(machine.position)}
        for item in self._task_observables.values():
            item.enabled = True

    def _observe(self, name, read):
        self._task_observables[name] = observable.Generic(read)
        self._task_observables[name].enabled = True

    @property
    def root_entity(self) -> composer.Arena:
        return self._arena

    @property
    def task_observables(self) -> dict:
        return self._task_observables

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        return specs.BoundedArray(
            (len(self.machine.axes),), np.float64, -1.0, 1.0, name="\t".join(self.machine.axes)
        )

    def before_step(
        self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState
    ) -> None:
        self.machine.command(physics, action)

    def contact_force(self, physics: mjcf.Physics, index: int = 0) -> np.ndarray:
        """(3,) force on a BioTac in its frame [N]."""
        return self.biotacs[index].read(physics, "contact_force")[:3]

    @abc.abstractmethod
    def hidden(self, physics: mjcf.Physics) -> np.ndarray:
        """(nbiotac, nestimated) true values of `estimated`, which touch-only controllers must not use."""

    @abc.abstractmethod
    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None: ...

    @abc.abstractmethod
    def get_reward(self, physics: mjcf.Physics) -> float: ...
