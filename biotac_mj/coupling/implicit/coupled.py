"""A skin in two-way coupling during one step: its linear model, where its bodies go under this model, and the
energy that it can give."""

import numpy as np

from ...geometry.rigid_warp import LEVER
from ...skin.bodies import BodyMotion
from ..instance import Instance
from ..structs import DataView
from .rules import FORETOLD, STILL, TOLERANCE

# of what the solves of a step may cost together: what is left is not worth another one
_MOST = 0.9
_SCALE = np.array([1.0] * 3 + [LEVER] * 3)  # compares turning with going


class Coupled:
    """An `Instance` during a step. Its model is wrench0 - tangent (pose - pose0).

    Attributes:
      idle: the skin rests, and what comes is too far for this step's accelerations to matter.
      arrays: `StepArrays` of the instance, where the step stands.
      off: [m] how far the bodies go from where the skin was last solved.
      touching: numbers of the bodies that the skin holds: it has a stiffness against them.
      may_act: whether another solve is worth its cost: not after one that reached no equilibrium.
      amiss: (n, 6) what the correction of the integrator's accelerations still lacks: it acts on the bodies
        too.
      excess: (n, 6) what the rows push beyond their stiffness where MuJoCo's solver did not converge: it acts
        too.
      compliance: (n, n, 6, 6) motion of one body by a wrench on another where the skin is solved [m/N], see
        `SkinGroup.find_compliance`.
      forced: wrenches (n, 6) that act in place of model and rows, or None. withdrawn: nothing acts.
    """

    def __init__(self, instance: Instance, data: DataView):
        self.instance, self.data = instance, data
        self.touching, self.idle = _touching(instance.last_model()[1]), False
        if not len(self.touching):  # maybe nothing is near
            self.pose = instance.kinematics.predict(instance.model.opt.timestep - instance.lead)
            self.idle = instance.is_out_of_reach(*self.pose)
        if self.idle:
            return
        self.result = self.forced = None
        self.withdrawn, self.written, self.settled = False, False, True
        self.off, self.may_act, self._cost = np.inf, True, 0.0
        self.jacobian = instance.kinematics.jacobians()
        self.arrays = arrays = instance.begin_arrays()
        self.touching = _touching(arrays.tangent0)  # without bodies that were placed
        self.square, self.tangent, self.moved = arrays.square, arrays.tangent0, arrays.moved
        self.compliance = arrays.compliance

    def use_euler(self) -> None:
        """Makes the bodies' step that of backward Euler."""
        self.arrays.use_euler()
        self.written = False

    def leave_at_rest(self) -> None:
        """Leaves a skin that nothing reaches as it is, and takes its rows away."""
        self.instance.stay_at_rest(*self.pose)
        self.instance.metric.release()

    # --- Newton's method on the pose at the end of the step ---

    def evaluate(self, acceleration: np.ndarray) -> None:
        """Finds where its bodies go with accelerations (nv,), what acts on them so, and how far they go from
        where it was solved."""
        arrays, self.acceleration = self.arrays, acceleration
        arrays.qacc[:] = acceleration
        np.add(self.amiss, self.excess, out=arrays.amiss)
        arrays.evaluate()
        if self.withdrawn:
            arrays.acting[:] = 0.0
        if self.result is None:  # where the last step has left it
            still = arrays.off[0] < STILL and arrays.off[1] < TOLERANCE
            self.still = len(arrays.acting) > 0 and still and not arrays.placed.any()
            self.result = self.instance.stay() if self.still else None
        self.off = np.inf if self.result is None else float(arrays.off[0])

    @property
    def target(self) -> tuple:
        """Poses (n, 3) [m], (n, 3, 3) to which its bodies go."""
        return self.arrays.pos.copy(), self.arrays.mat.copy()

    def solve(self) -> None:
        """Solves the skin where its bodies go, which give way from there."""
        arrays, target = self.arrays, self.target
        if not self.instance.setup.skin.stepper.gives_way:  # it takes poses only
            self._solve(target)
            return
        spin = arrays.drift[:, 3:] + arrays.moved[:, 3:]
        wrench = arrays.acting / self.instance.touching.fraction[:, None]
        where = target[0], arrays.here_pos.copy(), spin
        self._solve(target, BodyMotion(self.compliance.copy(), wrench, *where))

    def finish(self) -> None:
        """Solves the skin where its bodies are sure to come."""
        self._solve(self.target)

    def _solve(self, pose, bodies=None):
        arrays = self.arrays
        result = self.instance.solve_for_pose(*pose, self._core_motion(), self.result, self._cost, bodies)
        self._cost += result.cost
        if self.still and self.result is None and result.converged:
            wrong, wrench = np.abs(result.wrench - arrays.acting), np.abs(result.wrench)
            self.instance.stays = bool(wrong.max() < FORETOLD * wrench.max())
        self.result, self.may_act = result, result.converged and self._cost < _MOST
        arrays.wrench0[:], arrays.tangent0[:] = result.wrench, result.tangent
        (arrays.pos0[:], arrays.mat0[:]), arrays.slack[:] = result.pose, result.slack
        self.written = False
        held = arrays.tangent0.any(axis=(1, 2))
        self.touching, self.correction[~held] = held.nonzero()[0], 0.0

    def _core_motion(self):
        if not self.instance.inertial:
            return ()
        step = self.instance.model.opt.timestep
        with self.data.ahead(self.instance.lead):
            return self.instance.kinematics.core_motion(step, step**2, self.acceleration)

    # --- in MuJoCo's dynamics ---

    def apply(self) -> np.ndarray:
        """Puts the model into MuJoCo's rows; returns the wrenches (n, 6) that act besides."""
        metric = self.instance.metric
        if self.forced is not None:
            metric.release()
            return self.forced
        if not self.written:
            metric.write(self.touching)
            self.written = True
        self.arrays.find_wrenches()
        return self.correction + self.arrays.wrench

    def withdraw(self) -> None:
        """Lets nothing act in this step; the model stays as the next one's first."""
        self.forced, self.withdrawn, self.arrays.push[:] = np.zeros_like(self.correction), True, 0.0
        self.touching, self.written, self.settled = np.zeros(0, int), False, False

    def hold(self, acceleration: np.ndarray) -> None:
        """Lets what acts with accelerations (nv,) of MuJoCo's constraint solver act in place of the rows."""
        self.forced, self.written = self.acting_with(acceleration), False

    def acting_with(self, acceleration: np.ndarray) -> np.ndarray:
        """(n, 6) that acts with accelerations (nv,) that MuJoCo's constraint solver has found, in this
        step."""
        if self.forced is not None:
            return self.forced
        moved = self.square[:, None] * (self.jacobian @ acceleration)
        rows = self.instance.metric.excess(acceleration)
        rows -= (self.tangent @ moved[:, :, None])[:, :, 0]
        return self.correction + self.arrays.wrench + rows

    # --- the energy that the skin can give ---

    def conclude(self, rounds: int) -> None:
        """Tells the instance how the step went."""
        arrays, withheld = self.arrays, 1.0 - self.arrays.push.min(initial=1.0)
        left = arrays.conclude(self.result.converged)
        acting = self.instance.seen(arrays.acting)
        self.instance.concluded(rounds, self.settled, withheld, left, acting)
        self.instance.step_gamma, self.instance.frequency = arrays.gamma.copy(), arrays.frequency.copy()

    def settle(self, moved: np.ndarray, near: float) -> None:
        """Settles the account when MuJoCo's poses are those of now. moved: (nv,) displacement of the degrees
        of freedom by their mean velocity in the step. near: [m] from where they were to go."""
        arrays, travel = self.arrays, self.jacobian @ moved
        error = size(travel - arrays.travel)
        arrays.travel[:] = travel
        self.instance.settle(arrays.conclude(self.result.converged), error < near)


def _touching(tangent):
    """Numbers of the bodies that tangents (n, 6, 6) hold."""
    return np.flatnonzero(tangent.any(axis=(1, 2)))


def size(motion: np.ndarray) -> float:
    """The largest entry of motions (n, 6), of turns at a lever [m]."""
    return float(np.abs(motion * _SCALE).max(initial=0.0))
