"""Roll a sphere between fingertip and table to a known target; its position must be estimated by touch."""

import numpy as np
from dm_control import mjcf
from dm_control.utils import rewards

from ...coupling.config import OWN
from ..base import AWAY, TouchTask
from ..robots import Gantry

_PAD = 8.2e-3  # [m]
_CENTER = -9e-3  # x of the middle of the pad, BioTac frame [m]
_START = np.array([2e-3, 1e-3])  # initial distance of the ball from the pad's middle [m]
_RADIUS, _MASS = 5e-3, 4e-3  # of the ball [m], [kg]: steel


class RollBall(TouchTask):
    """Reward: 1 if the ball is within 0.5 mm of the target, 0 from 4 mm on."""

    estimated = ("ball_x", "ball_y", "force")
    seconds = 4.0

    def __init__(self, **settings: object):
        gantry = Gantry()
        super().__init__(gantry, [gantry.mount], **settings)
        world = self._arena.mjcf_model.worldbody
        # 2: the ball collides with the BioTac only, not with the finger's machine
        met = 2 | OWN
        rolls = dict(friction=[1, 0.005, 2e-5], condim=6, contype=met, conaffinity=met)
        floor = [0, 0, -_PAD - 2 * _RADIUS]
        world.add(
            "geom",
            name="table",
            type="plane",
            size=[0.1, 0.1, 0.01],
            pos=floor,
            rgba=[0.75, 0.6, 0.4, 1],
            **rolls,
        )
        self._ball = world.add("body", name="ball", pos=AWAY)
        self._joint = self._ball.add("freejoint", name="ball")
        self._ball.add(
            "geom",
            name="ball",
            type="sphere",
            size=[_RADIUS],
            mass=_MASS,
            rgba=[0.85, 0.45, 0.15, 1],
            **rolls,
        )
        self._target = np.zeros(2)
        mark = dict(type="cylinder", size=[5e-4, 1e-4], rgba=[0.1, 0.6, 0.2, 1], contype=0, conaffinity=0)
        world.add("body", name="target", mocap=True).add("geom", **mark)
        self._observe("target", lambda physics: self._target.copy())

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        start = np.array([_CENTER, 0.0]) + random_state.uniform(-1, 1, size=2) * _START
        # along the finger: across it the pad is too round and too narrow for rolling far
        self._target = start + np.array(
            [
                random_state.choice([-1, 1]) * random_state.uniform(4e-3, 6e-3),
                random_state.uniform(-1e-3, 1e-3),
            ]
        )
        floor = -_PAD - 2 * _RADIUS
        physics.bind(self._joint).qpos = [*start, floor + _RADIUS, 1, 0, 0, 0]
        physics.bind(self._joint).qvel = 0.0
        physics.bind(self._arena.mjcf_model.find("body", "target")).mocap_pos = np.append(self._target, floor)
        self.machine.place(physics, np.array([0.0, 0.0, 2e-3]))

    def ball(self, physics: mjcf.Physics) -> np.ndarray:
        """(2,) position of the ball on the table [m]."""
        return np.array(physics.bind(self._joint).qpos[:2])

    def hidden(self, physics: mjcf.Physics) -> np.ndarray:
        # position of the ball relative to the finger
        return np.append(
            self.ball(physics) - self.machine.position(physics)[:2], self.contact_force(physics)[1]
        )[None]

    def get_reward(self, physics: mjcf.Physics) -> float:
        return float(
            rewards.tolerance(
                np.linalg.norm(self.ball(physics) - self._target), (0, 5e-4), 3.5e-3, "linear", 0.0
            )
        )
