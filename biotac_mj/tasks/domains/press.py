"""Press to a target force on a plate of unknown height and tilt; the target is observed, the actual force is
not."""

import numpy as np
from dm_control import mjcf
from dm_control.utils import rewards

from ..base import AWAY, TouchTask
from ..robots import Gantry

_PAD = 8.2e-3  # of the pad below the BioTac's axis [m]
_FORCES = (0.5, 3.0)  # [N]
_TILT = 0.08  # [rad]


class Press(TouchTask):
    """Reward: 1 if the normal force is within 10 % of the target, 0 if its error is the whole target, which
    changes once."""

    estimated = ("force",)
    seconds = 3.0

    def __init__(self, **settings: object):
        gantry = Gantry()
        super().__init__(gantry, [gantry.mount], **settings)
        self._plate = self._arena.mjcf_model.worldbody.add("body", name="plate", mocap=True, pos=AWAY)
        self._plate.add(
            "geom",
            name="plate",
            type="box",
            size=[0.04, 0.04, 0.005],
            pos=[0, 0, -0.005],
            rgba=[0.75, 0.6, 0.4, 1],
        )
        self._targets = np.zeros(2)
        self._observe("target", lambda physics: np.array([self.target(physics)]))

    def target(self, physics: mjcf.Physics) -> float:
        """The target force [N]."""
        return self._targets[int(physics.data.time > self.seconds / 2)]

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self._targets = random_state.uniform(*_FORCES, size=2)
        angle = random_state.uniform(-_TILT, _TILT, size=2)
        plate = physics.bind(self._plate)
        plate.mocap_pos = [0, 0, -_PAD - random_state.uniform(1e-3, 4e-3)]
        plate.mocap_quat = np.array([1, *(angle / 2), 0]) / np.linalg.norm([1, *(angle / 2)])
        self.machine.place(physics, np.append(random_state.uniform(-5e-3, 5e-3, size=2), 0.0))

    def hidden(self, physics: mjcf.Physics) -> np.ndarray:
        return self.contact_force(physics)[None, 1:2]

    def get_reward(self, physics: mjcf.Physics) -> float:
        target = self.target(physics)
        return float(
            rewards.tolerance(
                self.contact_force(physics)[1], (0.9 * target, 1.1 * target), 0.9 * target, "linear", 0.0
            )
        )
