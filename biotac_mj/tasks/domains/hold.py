"""Hold an object with changing weight, and lift one of unknown mass, with two fingertips."""

import numpy as np
from dm_control import mjcf
from dm_control.utils import rewards

from ...coupling.config import Config
from ..base import AWAY, TouchTask
from ..robots import Gripper

FRICTION = Config().friction  # of the skin, the larger of the pair
_HALF = np.array([9e-3, 8e-3, 14e-3])  # of the object [m]
_PADS = -0.010  # z of the pads' middle below the gripper's origin [m]
_GRAVITY = 9.81


class _Grip(TouchTask):
    estimated = ("grip", "load")

    def __init__(self, lift: bool, mass: float, **settings: object):
        gripper = Gripper(lift=lift)
        super().__init__(gripper, gripper.mounts, **settings)
        world = self._arena.mjcf_model.worldbody
        self._body = world.add("body", name="object", pos=AWAY)
        self._joint = self._body.add("freejoint", name="object")
        inertia = mass / 3 * (np.sum(_HALF**2) - _HALF**2)
        self._body.add("inertial", pos=[0, 0, 0], mass=mass, diaginertia=inertia)
        self._body.add(
            "geom",
            name="object",
            type="box",
            size=_HALF,
            friction=[0.5, 0.005, 1e-4],
            rgba=[0.85, 0.45, 0.15, 1],
        )
        self._mass = mass

    def _put(self, physics, height, open_by):
        """Sets the object's centre to a height [m], with the fingers `open_by` [m] away from it."""
        physics.bind(self._joint).qpos = [0, 0, height, 1, 0, 0, 0]
        physics.bind(self._joint).qvel = 0.0
        fingers = np.full(2, -_HALF[1] - open_by)
        self.machine.place(physics, fingers if len(self.machine.joints) == 2 else np.append(0.0, fingers))

    def height(self, physics: mjcf.Physics) -> float:
        """Height of the object's centre [m]."""
        return float(physics.bind(self._joint).qpos[2])

    def hidden(self, physics: mjcf.Physics) -> np.ndarray:
        # the object's weight pulls towards the tips, -x of the BioTacs
        return np.array([self.contact_force(physics, i)[[1, 0]] for i in range(2)]) * [1, -1]

    def grip(self, physics: mjcf.Physics) -> float:
        """Mean normal force of the fingers [N]."""
        return float(self.hidden(physics)[:, 0].mean())


class Hold(_Grip):
    """The object's support is removed at 0.5 s, and its weight changes three times. Reward: 1 if it has sunk
    by less than 1 mm (0 at 10 mm), times a gentleness factor: 1 up to 1.6 times the grip that friction
    requires plus 0.3 N, a half at 3 N more."""

    seconds = 4.0

    def __init__(self, **settings: object):
        super().__init__(lift=False, mass=0.04, **settings)
        self._support = self._arena.mjcf_model.worldbody.add("body", name="support", mocap=True, pos=AWAY)
        self._support.add(
            "geom", name="support", type="box", size=[0.01, 0.004, 0.002], rgba=[0.5, 0.5, 0.5, 1]
        )
        self._times, self._pulls = np.zeros(3), np.zeros(4)
        self._begin = 0.0

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self._times = np.array([1.0, 1.9, 2.8]) + random_state.uniform(0, 0.5, size=3)
        self._pulls = np.append(0.0, random_state.uniform(0.0, 1.5, size=3))
        self._put(physics, _PADS, 1e-3)
        physics.bind(self._support).mocap_pos = [0, 0, _PADS - _HALF[2] - 0.002]
        self._begin = _PADS

    def pull(self, time: float) -> float:
        """Force added to the object's weight [N]; each change takes 0.1 s."""
        return float(
            np.interp(time, np.ravel([[t, t + 0.1] for t in self._times]), np.repeat(self._pulls, 2)[1:-1])
        )

    def before_substep(
        self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState
    ) -> None:
        time = physics.data.time  # written directly: see Gantry.command
        if time > 0.5:
            physics.data.mocap_pos[physics.bind(self._support).mocapid] = AWAY
        physics.data.xfrc_applied[physics.bind(self._body).element_id, 2] = -self.pull(time)

    def get_reward(self, physics: mjcf.Physics) -> float:
        needed = (self._mass * _GRAVITY + self.pull(physics.data.time)) / (2 * FRICTION)
        held = rewards.tolerance(self._begin - self.height(physics), (-2e-3, 1e-3), 9e-3, "linear", 0.0)
        gentle = rewards.tolerance(self.grip(physics), (0.0, 1.6 * needed + 0.3), 6.0, "linear", 0.0)
        return float(held * max(0.5, gentle))


class Lift(_Grip):
    """Pinch a block of 20 to 150 g on a table and lift it by 30 mm. Reward: the height as a fraction of 30
    mm, times a gentleness factor: 1 up to twice the grip that friction requires plus 0.5 N, a half at 3 N
    more."""

    seconds = 4.0
    _goal = 0.03

    def __init__(self, **settings: object):
        super().__init__(lift=True, mass=0.1, **settings)
        table = dict(
            type="box", size=[0.1, 0.1, 0.005], pos=[0, 0, _PADS - _HALF[2] - 0.005], rgba=[0.75, 0.6, 0.4, 1]
        )
        self._arena.mjcf_model.worldbody.add("geom", name="table", **table)

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        body = physics.bind(self._body)
        mass = random_state.uniform(0.02, 0.15)
        body.mass, body.inertia = mass, mass / 3 * (np.sum(_HALF**2) - _HALF**2)
        # like mj_setConst
        physics.model.body_subtreemass[[0, body.element_id]] += mass - body.subtreemass
        self._mass = mass
        self._put(physics, _PADS, random_state.uniform(2e-3, 5e-3))

    def get_reward(self, physics: mjcf.Physics) -> float:
        raised = np.clip((self.height(physics) - _PADS) / self._goal, 0, 1)
        gentle = rewards.tolerance(
            self.grip(physics), (0.0, self._mass * _GRAVITY / FRICTION + 0.5), 6.0, "linear", 0.0
        )
        return float(raised * max(0.5, gentle))
