"""All BioTacs of one mjData, stepped together: the implicit step that finds forces and motion at once.

A step of length h must satisfy x' = x + h v + h^2 a(W(x')): the skin's wrench W at the end of the step, the
accelerations a with which MuJoCo's integrator moves the bodies under it (`integrator`). Newton's method on
x': every round asks MuJoCo for the accelerations with the skins' linear models in force (`metric`), which
says where the bodies go, and solves the skins there, which gives new linear models. The models of the last
step start it. A resting or smoothly moving contact takes one solve of the skin per step; an impact, or a
light object that meets the skin within the step, two or three."""

import mujoco
import numpy as np

from ..geometry.rigid import displace, displacement, rotation
from .instance import Instance
from .integrator import FixedPoint, Integrator
from .structs import DataView, ModelView

__all__ = ["World"]

MAX_ROUNDS = 4
# [m] change of the predicted pose, rotations over a lever of _LEVER, below which the skin is not solved again
TOLERANCE = 2e-6
MAX_CORRECTIONS = 12
# of the skins' wrenches: how well the rows and the passive forces together must give the linear model
CORRECTED = 1e-6
_PGS = int(mujoco.mjtSolver.mjSOL_PGS)
_LEVER = 0.01  # [m] about the size of a fingertip
_SCALE = np.array([1.0, 1.0, 1.0, *[1 / _LEVER] * 3])  # compares torques with forces


class World:
    """The instances of the plugin in one mjData."""

    def __init__(self, model: ModelView, data: DataView, indices: list[int]):
        self.model, self.data = model, data
        self.instances = {i: Instance(model, data, i) for i in indices}
        self.coupled = [t for t in self.instances.values() if t.two_way]
        self.first = self.coupled[0].index if self.coupled else -1
        self._damped = (
            None  # whether the integrator's accelerations differ from the constraint solver's in this step
        )
        self.integrator = Integrator(
            model, {b for t in self.coupled for b in (t.touching.core, *t.touching.body)}
        )

    def passive(self, index: int) -> None:
        """Solves the skins: a one-way one by itself, the two-way ones together when the first of them is
        asked."""
        instance = self.instances[index]
        if not instance.two_way:
            instance.forget_last_solve()
            core = instance.touching.core_motion(self.data, instance.horizon) if instance.inertial else ()
            instance.solve_for_pose(*instance.touching.predict(self.data, instance.horizon), core)
        elif index == self.first:
            for other in self.coupled:
                other.forget_last_solve()
            self._step()

    def failed(self, index: int) -> None:
        """After an exception: no skin that was being solved is known, and none acts."""
        instance = self.instances[index]
        for other in self.coupled if instance.two_way else [instance]:
            other.failed()

    def _step(self):
        outside = self.data.qfrc_passive.copy()
        skins = [_Coupled(t, self.data) for t in self.coupled]
        try:
            self._newton(skins, outside)
        except BaseException:
            self.data.qfrc_passive[:] = outside
            for skin in skins:
                skin.let_go()
            raise

    def _newton(self, skins, outside):
        moving = skins[0].horizon > 0 and self.model.nv > 0
        self._damped = None
        for skin in skins:
            if skin.idle:
                skin.leave_at_rest()
        skins = [skin for skin in skins if not skin.idle]
        if not skins:
            return
        for _ in range(MAX_ROUNDS):
            acceleration = self._accelerations(skins, outside) if moving else np.zeros(self.model.nv)
            solved = [skin.follow(acceleration) for skin in skins]
            if not any(solved):
                return
            if not moving:
                break
        if moving and self._damped:
            self._accelerations(skins, outside)
        else:
            self._forces(skins, outside)

    def _accelerations(self, skins, outside):
        """The accelerations with which MuJoCo will move the bodies under the skins' linear models; leaves the
        forces that do this in place.

        The rows answer to the constraint solver's accelerations a, the skins to the integrator's a': h^2 S J
        (a - a') corrects it."""
        self._forces(skins, outside)
        found = self.data.acceleration()
        if self._damped is None:  # known only after the actuation stage
            self._damped = self.integrator.take_matrices(self.data)
        if not self._damped:
            return found
        if not any(s.tangent.any() for s in skins):
            return self.integrator.integrated(found)
        jacobian, tangent, wrench0, correction = (
            np.concatenate([getattr(s, name) for s in skins])
            for name in ("jacobian", "tangent", "wrench0", "correction")
        )
        stiffness, ends = skins[0].horizon ** 2 * tangent, np.cumsum([len(s.wrench0) for s in skins])[:-1]
        search = slope = None
        for last in range(MAX_CORRECTIONS, -1, -1):
            moved = self.integrator.integrated(found)
            excess = (stiffness @ (jacobian @ (found - moved))[:, :, None])[:, :, 0]
            wrong = excess - correction
            poor = np.abs(_SCALE * wrong).max() > CORRECTED * np.abs(_SCALE * [excess, wrench0]).max()
            if not (poor and last):  # also where the simulation has blown up: nothing is greater than nan
                return moved
            if search is None:
                search, slope = FixedPoint(), self.integrator.slope(jacobian, stiffness)
            step = np.linalg.solve(slope, wrong.ravel()).reshape(-1, 6)
            correction = (
                search.next((_SCALE * correction).ravel(), (_SCALE * step).ravel()).reshape(-1, 6) / _SCALE
            )
            for skin, part in zip(skins, np.split(correction, ends)):
                skin.correction = part
            self._forces(skins, outside)
            found = self.data.acceleration()

    def _forces(self, skins, outside):
        self.data.qfrc_passive[:] = outside
        for skin in skins:
            skin.apply()
        option = self.model.opt
        if option.solver == _PGS or option.noslip_iterations:  # they work on what the rows were before
            self.data.project_constraints()


class _Coupled:
    """A two-way skin during one step: its linear model wrench0 - tangent (pose - pose0)."""

    def __init__(self, instance, data):
        self.instance, self.data, self.horizon = instance, data, instance.horizon
        instance.metric.find_rows(data)
        self.pose = instance.touching.predict(data, self.horizon)
        # the skin rests, and what comes is too far for this step's accelerations to matter
        self.idle = instance.is_out_of_reach(*self.pose)
        self.core, self.jacobian = (), None
        if self.idle:
            return
        self.wrench0, self.tangent, *self.pose0 = instance.last_model()
        self.jacobian = instance.metric.jacobians(data)
        if instance.inertial:
            self.core = instance.touching.core_motion(data, self.horizon)
            self.core_jacobian = data.jacobian(instance.touching.core, np.ascontiguousarray(self.core[0][0]))
        self.correction = np.zeros((len(self.wrench0), 6))
        self.solved = self.written = False
        self.converged = True

    def leave_at_rest(self):
        """Leaves a skin that nothing reaches as it is, and takes its rows away."""
        self.instance.stay_at_rest(*self.pose)
        self.let_go()

    def follow(self, acceleration):
        """Solves the skin where its bodies go, unless it has been solved there; returns whether it did."""
        motion = self.horizon**2 * (self.jacobian @ acceleration)
        pose = displace(*self.pose, motion)
        if self.solved and (not self.converged or self._distance(pose) < TOLERANCE):
            return False
        result = self.instance.solve_for_pose(*pose, self._core_motion(acceleration))
        self.wrench0, self.tangent, self.pose0 = result.wrench, result.tangent, pose
        self.solved, self.converged, self.written = True, result.converged, False
        if not self.tangent.any():
            self.correction = np.zeros_like(self.wrench0)
        return True

    def _core_motion(self, acceleration):
        if not self.core:
            return ()
        (start, end), (turned, turning) = self.core
        move = self.horizon**2 * (self.core_jacobian @ acceleration)
        return np.stack([start, end + move[:3]]), np.stack([turned, rotation(move[None, 3:])[0] @ turning])

    def _distance(self, pose):
        motion = displacement(*pose, *self.pose0)
        return max(np.abs(motion[:, :3]).max(initial=0.0), _LEVER * np.abs(motion[:, 3:]).max(initial=0.0))

    def apply(self):
        metric = self.instance.metric
        if not self.written:
            metric.write(self.jacobian, self.tangent, self.horizon)
            self.written = True
        if self.wrench0.any() or self.tangent.any():
            motion = displacement(*self.pose, *self.pose0)
            wrench = self.correction + self.wrench0 - (self.tangent @ motion[:, :, None])[:, :, 0]
            self.data.qfrc_passive += wrench.ravel() @ self.jacobian.reshape(wrench.size, -1)

    def let_go(self):
        self.instance.metric.release()
