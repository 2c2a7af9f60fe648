"""Explore an object and classify it as one of seventeen: the paper's eight indenters, six pegs, a table's
surface, edge and corner."""

from collections.abc import Sequence

import mujoco
import numpy as np
from dm_control import mjcf
from dm_env import specs

from ...data.objects import OBJECTS, make_object
from ...fields import check_choice
from ...short_repr import short_repr
from ..base import AWAY, TouchTask
from ..robots import Gantry

_PAD = 8.2e-3  # [m]
CENTER = -9e-3  # x of the middle of the pad, BioTac frame [m]
_OFF, _TURN = 1e-3, 0.2  # largest offset [m] and rotation [rad] of the object
# rotates an object's forward direction +y to the world's +z
_TURNED_UP = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0])


class Explore(TouchTask):
    """An action moves the finger (3) and sets a belief for each object (17). Reward: the fraction of the
    right object in the beliefs, counted from -1: 1/17 without knowledge."""

    estimated = ("force",)
    seconds = 4.0

    def __init__(self, objects: Sequence[str] = OBJECTS, **settings: object):
        """objects: names of those that occur; beliefs always cover all 17. Raises ValueError for unknown
        ones."""
        if not isinstance(objects, (list, tuple)) or not objects:
            raise ValueError(f"objects is {short_repr(objects)}: give a list of some of {', '.join(OBJECTS)}")
        for name in objects:
            check_choice("no object", name, OBJECTS)
        self.choices = [OBJECTS.index(name) for name in objects]
        shapes = [make_object(name) for name in OBJECTS]
        gantry, rounding = Gantry(), {shape.name: shape.rounding for shape in shapes if shape.rounding}
        super().__init__(
            gantry,
            [gantry.mount],
            **settings | {"biotac": {"rounding": rounding, **(settings.get("biotac") or {})}},
        )
        self._objects = [_add(self._arena.mjcf_model, shape) for shape in shapes]
        self.chosen = 0
        self._belief = np.full(len(OBJECTS), 1 / len(OBJECTS))

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        names = self.machine.axes + list(OBJECTS)
        return specs.BoundedArray((len(names),), np.float64, -1.0, 1.0, name="\t".join(names))

    def before_step(
        self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState
    ) -> None:
        self.machine.command(physics, action[:3])
        weight = np.clip(action[3:], -1, 1) + 1
        self._belief = weight / weight.sum() if weight.sum() > 0 else np.full(len(OBJECTS), 1 / len(OBJECTS))

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        self.chosen = self.choices[random_state.randint(len(self.choices))]
        height, angle = -_PAD - random_state.uniform(1e-3, 3e-3), random_state.uniform(-_TURN, _TURN)
        place = np.array([CENTER, 0.0]) + random_state.uniform(-_OFF, _OFF, size=2)
        for i, body in enumerate(self._objects):
            bound = physics.bind(body)
            bound.mocap_pos = np.append(place, height) if i == self.chosen else AWAY
            bound.mocap_quat = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
        self.machine.place(physics, np.zeros(3))
        self._belief[:] = 1 / len(OBJECTS)

    def hidden(self, physics: mjcf.Physics) -> np.ndarray:
        return self.contact_force(physics)[None, 1:2]

    def get_reward(self, physics: mjcf.Physics) -> float:
        return float(self._belief[self.chosen])


def _add(root, shape):
    """A mocap body with the shape, foremost point at its origin, upwards; both have the shape's name."""
    body = root.worldbody.add("body", name=shape.name, mocap=True, pos=AWAY)
    pos, quat = np.empty(3), np.empty(4)
    mujoco.mju_rotVecQuat(pos, shape.pos, _TURNED_UP)
    mujoco.mju_mulQuat(quat, _TURNED_UP, shape.quat)
    geom = dict(name=shape.name, type=shape.type, pos=pos, quat=quat, rgba=[0.75, 0.6, 0.4, 1])
    if shape.type == "mesh":
        root.asset.add(
            "mesh", name=shape.name, vertex=shape.vert.ravel(), face=shape.face.ravel(), inertia="shell"
        )
        body.add("geom", mesh=shape.name, **geom)
    else:
        body.add("geom", size=shape.size, **geom)
    return body
