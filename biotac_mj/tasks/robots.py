"""Machines that carry BioTacs in the tasks: a gantry for one finger, a parallel gripper with two."""

import numpy as np
from dm_control import composer, mjcf

from ..geometry.rigid import quaternion

_MASS = 0.15  # of a carriage [kg]
_STIFFNESS = 3000.0  # of a servo [N/m]: 1 N moves it by 0.3 mm
_YAW_INERTIA, _YAW_STIFFNESS = 1e-4, 20.0  # [kg m^2], [N m/rad]
_LARGEST_FORCE = 12.0  # of a servo [N]: above it the finger is pushed back
_PAD = 8.2e-3  # from the BioTac's axis to its pad [m]
_ROD = dict(type="capsule", size=[0.005], rgba=[0.55, 0.58, 0.62, 1.0], contype=0, conaffinity=0)


def _quaternion(columns):
    """(w, x, y, z) of the rotation whose columns are the BioTac's axes in the parent frame."""
    return quaternion(np.transpose(columns))


class _Machine(composer.Entity):
    """Sliding (and rotating) carriages driven by servos that integrate a commanded velocity.

    A command is in [-1, 1] for each axis; `speed` is the velocity of 1.
    """

    def _start(self, name):
        self._root = mjcf.RootElement(model=name)
        self._root.compiler.angle = "radian"
        self._joints, self._actuators, self._speed = [], [], []

    def _axis(self, body, name, direction, limits, speed, hinge=False):
        stiffness = _YAW_STIFFNESS if hinge else _STIFFNESS
        inertia = _YAW_INERTIA if hinge else _MASS
        joint = body.add(
            "joint", name=name, type="hinge" if hinge else "slide", axis=direction, range=limits, limited=True
        )
        actuator = self._root.actuator.add(
            "general",
            name=name,
            joint=joint,
            dyntype="integrator",
            biastype="affine",
            gainprm=[stiffness],
            biasprm=[0, -stiffness, -2 * np.sqrt(stiffness * inertia)],
            ctrllimited=True,
            ctrlrange=[-speed, speed],
            actlimited=True,
            actrange=limits,
            forcelimited=True,
            forcerange=[-_LARGEST_FORCE, _LARGEST_FORCE],
        )
        self._joints.append(joint)
        self._actuators.append(actuator)
        self._speed.append(speed)

    def _carriage(self, parent, name, pos=(0, 0, 0), inertia=_YAW_INERTIA):
        body = parent.add("body", name=name, pos=pos, gravcomp=1)
        body.add("inertial", pos=[0, 0, 0], mass=_MASS, diaginertia=[inertia] * 3)
        return body

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        return self._root

    @property
    def joints(self) -> list[mjcf.Element]:
        return self._joints

    @property
    def actuators(self) -> list[mjcf.Element]:
        return self._actuators

    @property
    def axes(self) -> list[str]:
        """Names of the axes of a command."""
        return [a.name for a in self._actuators]

    @property
    def speed(self) -> np.ndarray:
        """(naxis,) velocity of a command of 1 [m/s], [rad/s]."""
        return np.array(self._speed[: len(self.axes)])

    def command(self, physics: mjcf.Physics, action: np.ndarray) -> None:
        """Sets the velocities of the axes: action (naxis,) in [-1, 1]."""
        # not through a binding, which would make dm_control recompute the whole step, including the skin,
        # before the next reading
        physics.data.ctrl[physics.bind(self._actuators).element_id] = np.clip(action, -1, 1) * np.array(
            self._speed
        )

    def place(self, physics: mjcf.Physics, position: np.ndarray) -> None:
        """Moves the axes to position (naxis,) [m], [rad], at rest, and the servos with them."""
        physics.bind(self._joints).qpos = position
        physics.bind(self._joints).qvel = 0.0
        physics.bind(self._actuators).act = position

    def position(self, physics: mjcf.Physics) -> np.ndarray:
        """(naxis,) [m], [rad]."""
        return np.array(physics.bind(self._joints).qpos)


class Gantry(_Machine):
    """Carries one BioTac, pad down: axes x, y, z and optionally yaw about the vertical through the BioTac's
    origin.

    At rest the BioTac's axes are x along the world's x (tip at -x), y up, z along -y of the world.
    """

    def _build(self, name="finger", yaw=False):
        self._start(name)
        body = self._root.worldbody
        for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
            body = self._carriage(body, f"carriage_{axis}")
            self._axis(body, axis, direction, [-0.06, 0.06], 0.03)
        body = self._carriage(body, "carriage_z")
        self._axis(body, "z", [0, 0, 1], [-0.03, 0.05], 0.03)
        if yaw:
            body = self._carriage(body, "wrist")
            self._axis(body, "yaw", [0, 0, 1], [-1.6, 1.6], 1.0, hinge=True)
        body.add("geom", name="arm", fromto=[0.014, 0, 0, 0.014, 0, 0.05], **_ROD)
        body.add("geom", name="holder", fromto=[0.008, 0, 0, 0.014, 0, 0], **_ROD)
        self.mount = body.add("site", name="mount", quat=_quaternion([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))


class Gripper(_Machine):
    """Two facing BioTacs, tips down: lift raises both, grip moves each towards the other; at 0 the pads are
    just in contact."""

    def _build(self, name="gripper", lift=True):
        self._start(name)
        body = self._carriage(self._root.worldbody, "carriage")
        if lift:
            self._axis(body, "lift", [0, 0, 1], [-0.02, 0.08], 0.03)
        body.add("geom", name="beam", fromto=[0, -0.03, 0.055, 0, 0.03, 0.055], **_ROD)
        self.mounts = []
        for side, name in ((1, "left"), (-1, "right")):
            finger = self._carriage(body, name, pos=[0, side * _PAD, 0])
            self._axis(finger, name, [0, -side, 0], [-0.05, 0.002], 0.02)
            finger.add("geom", fromto=[0, 0, 0.012, 0, 0, 0.052], **_ROD)
            self.mounts.append(
                finger.add(
                    "site", name=f"mount_{name}", quat=_quaternion([[0, 0, 1], [0, side, 0], [-side, 0, 0]])
                )
            )

    @property
    def axes(self) -> list[str]:
        return ["lift", "grip"] if len(self._actuators) == 3 else ["grip"]

    def command(self, physics: mjcf.Physics, action: np.ndarray) -> None:
        """action: (lift, grip) or (grip,) in [-1, 1]; a grip of 1 closes."""
        super().command(physics, np.append(action, action[-1]))
