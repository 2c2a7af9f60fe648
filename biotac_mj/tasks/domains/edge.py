"""Follow an edge: the rim of a round plate of unknown radius and position, at a given speed, with the pad on
it."""

import numpy as np
from dm_control import mjcf
from dm_control.utils import rewards

from ..base import AWAY, TouchTask
from ..robots import Gantry

_PAD = 8.2e-3  # [m]
_REFERENCE = -9e-3  # x of the pad's point that should stay on the edge, BioTac frame [m]
_RADII = (0.03, 0.045, 0.07)  # [m]
_EDGE = 1e-3  # rounding of the rim [m]
_SPEED = 8e-3  # along the rim [m/s]
_FORCES = (0.15, 3.0)  # [N]


def _name(radius):
    return f"disc_{1e3 * radius:.0f}mm"


class FollowEdge(TouchTask):
    """Reward: the product of three factors in [0, 1]: force between 0.15 and 3 N; the pad within 0.7 mm of
    the rim (0 at 3 mm); speed along the rim, tip first, 8 mm/s or more (0 at rest)."""

    estimated = ("offset", "turn", "force")
    seconds = 5.0

    def __init__(self, **settings: object):
        gantry = Gantry(yaw=True)
        rounding = {_name(radius): _EDGE for radius in _RADII}
        super().__init__(
            gantry,
            [gantry.mount],
            **settings | {"biotac": {"rounding": rounding, **(settings.get("biotac") or {})}},
        )
        self._discs = []
        for radius in _RADII:
            disc = self._arena.mjcf_model.worldbody.add("body", name=_name(radius), mocap=True, pos=AWAY)
            disc.add(
                "geom",
                name=disc.name,
                type="cylinder",
                size=[radius, 4e-3],
                pos=[0, 0, -4e-3],
                rgba=[0.75, 0.6, 0.4, 1],
            )
            self._discs.append(disc)
        self._center, self._radius = np.zeros(2), _RADII[0]

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        chosen = random_state.randint(len(_RADII))
        self._radius = _RADII[chosen]
        offset, turn = random_state.uniform(-2e-3, 2e-3), random_state.uniform(-0.25, 0.25)
        self._center = np.array([_REFERENCE, self._radius + offset])
        for i, disc in enumerate(self._discs):
            height = -_PAD - random_state.uniform(1e-3, 3e-3)
            physics.bind(disc).mocap_pos = np.append(self._center, height) if i == chosen else AWAY
        # rotated about the pad's point, not about the BioTac's origin
        place = np.array([_REFERENCE - _REFERENCE * np.cos(turn), -_REFERENCE * np.sin(turn)])
        self.machine.place(physics, np.array([*place, 0.0, turn]))

    def _pose(self, physics):
        """Signed distance of the pad's point from the rim (positive outside) [m], the finger's angle to the
        rim [rad], the tangent."""
        x, y, _, yaw = self.machine.position(physics)
        heading = np.array([np.cos(yaw), np.sin(yaw)])
        away = np.array([x, y]) + _REFERENCE * heading - self._center
        distance = np.linalg.norm(away)
        normal = away / distance
        tangent = np.array([-normal[1], normal[0]])  # the plate on its left
        return (
            distance - self._radius,
            np.arctan2(tangent[0] * heading[1] - tangent[1] * heading[0], tangent @ heading),
            tangent,
        )

    def hidden(self, physics: mjcf.Physics) -> np.ndarray:
        offset, turn, _ = self._pose(physics)  # offset: distance of the rim to the finger's left
        return np.array([[offset, turn, self.contact_force(physics)[1]]])

    def get_reward(self, physics: mjcf.Physics) -> float:
        offset, _, tangent = self._pose(physics)
        velocity = physics.bind(self.machine.joints[:2]).qvel
        on_rim = rewards.tolerance(offset, (-0.7e-3, 0.7e-3), 2.3e-3, "linear", 0.0)
        pressing = rewards.tolerance(self.contact_force(physics)[1], _FORCES, 0.15, "linear", 0.0)
        return float(on_rim * pressing * np.clip(-velocity @ tangent / _SPEED, 0, 1))
