"""All BioTacs of one mjData, stepped together: the implicit step that finds forces and motion at once.

A step of length h must satisfy x' = x + h v + h^2 a(W(x')): the skin's wrench W at the end of the step, MuJoCo's accelerations a under it. Newton's
method on x': every round asks MuJoCo for the accelerations with the skins' linear models in force (`metric`), which says where the bodies go, and
solves the skins there, which gives new linear models. The models of the last step start it. A resting or smoothly moving contact takes one solve of
the skin per step; an impact, or a light object that meets the skin within the step, takes two or three.
"""

import mujoco
import numpy as np

from .instance import Instance
from .touching import displace, displacement

__all__ = ["World"]

MAX_ROUNDS = 4
TOLERANCE = 2e-6  # [m] change of the predicted pose, rotations over a lever of _LEVER, below which the skin is not solved again
_PGS = int(mujoco.mjtSolver.mjSOL_PGS)
_LEVER = 0.01  # [m] about the size of a fingertip


class World:
    """The instances of the plugin in one mjData."""

    def __init__(self, model, data, indices):
        self.model, self.data = model, data
        self.instances = {i: Instance(model, data, i) for i in indices}
        self.coupled = [t for t in self.instances.values() if t.two_way]
        self.first = self.coupled[0].index if self.coupled else -1

    def passive(self, index):
        """Solves the skins: a one-way one by itself, the two-way ones together when the first of them is asked."""
        instance = self.instances[index]
        if not instance.two_way:
            instance.begin()
            instance.solve(*instance.touching.predict(self.data, instance.horizon))
        elif index == self.first:
            for other in self.coupled:
                other.begin()
            self._step()

    def failed(self, index):
        """After an exception: no skin that was being solved is known, and none acts."""
        instance = self.instances[index]
        for other in self.coupled if instance.two_way else [instance]:
            other.failed()

    def _step(self):
        data = self.data
        outside = data.qfrc_passive.copy()
        skins = [_Coupled(t, data) for t in self.coupled]
        horizon = skins[0].horizon
        moving = horizon and self.model.nv
        for _ in range(MAX_ROUNDS):
            moved = not any(s.solved for s in skins)
            acceleration = self._apply(skins, outside) if moving else None
            for skin in skins:
                pose = skin.pose_after(acceleration) if moving else skin.pose
                if not skin.solved or skin.change(pose) > TOLERANCE:
                    skin.solve(*pose)
                    moved = True
            if not moved or not moving:
                break
        self._forces(skins, outside)

    def _forces(self, skins, outside):
        data = self.data
        data.qfrc_passive[:] = outside
        for skin in skins:
            skin.apply()
        option = self.model.opt
        if option.solver == _PGS or option.noslip_iterations:  # they work on what the rows were before
            data.project_constraints()

    def _apply(self, skins, outside):
        self._forces(skins, outside)
        return self.data.acceleration()


class _Coupled:
    """A two-way skin during one step: its linear model wrench0 - tangent (pose - pose0)."""

    def __init__(self, instance, data):
        self.instance, self.data, self.horizon = instance, data, instance.horizon
        self.jacobian = instance.metric.jacobians(data)
        instance.metric.begin(data)
        self.pose = instance.touching.predict(data, self.horizon)
        self.wrench0, self.tangent, *self.pose0 = instance.last_model()
        self.solved = False

    def pose_after(self, acceleration):
        motion = self.horizon**2 * (self.jacobian @ acceleration)
        return displace(*self.pose, motion)

    def change(self, pose):
        motion = displacement(*pose, *self.pose0)
        return max(np.abs(motion[:, :3]).max(initial=0.0), _LEVER * np.abs(motion[:, 3:]).max(initial=0.0))

    def solve(self, pos, mat):
        result = self.instance.solve(pos, mat)
        self.wrench0, self.tangent, self.pose0, self.solved = result.wrench, result.tangent, (pos, mat), True

    def apply(self):
        if not self.wrench0.any() and not self.tangent.any():
            return self.instance.metric.write(self.jacobian, self.tangent, 0.0)
        motion = displacement(*self.pose, *self.pose0)
        wrench = self.wrench0 - (self.tangent @ motion[:, :, None])[:, :, 0]
        self.data.qfrc_passive += wrench.ravel() @ self.jacobian.reshape(wrench.size, -1)
        self.instance.metric.write(self.jacobian, self.tangent, self.horizon)
