"""A skin in two-way coupling during one step: its linear model, where its bodies go under this model, and the
energy that it can give."""

from typing import NamedTuple

import numpy as np

from ...geometry.rigid import displacement, displacement_at_once, rotation
from ...skin.bodies import BodyMotion
from ..instance import LEVER, STAGES, Instance
from ..stepper import SkinResult
from ..structs import DataView
from .rules import (
    EULER,
    beta_of,
    in_store,
    lacking,
    share_that_pushes,
    spared,
)

__all__ = ["TELEPORT", "Coupled", "size"]

# of what the solves of a step may cost together: what is left is not worth another one, and the closest model
# must do
_MOST = 0.9
# [m] a body that was moved further than this, and than it goes by itself in a step, was put there
TELEPORT = 1e-3
_SCALE = np.array([1.0] * 3 + [LEVER] * 3)  # compares turning with going


class _Energy(NamedTuple):
    """Of each body (n,) [J]: what the last step left of its work on the skin, that and what has been put in
    since, the most that the skin can hold of it, what acts gives it on its way; and the wrenches (n, 6) that
    act."""

    left: np.ndarray
    store: np.ndarray
    most: np.ndarray
    given: np.ndarray
    acting: np.ndarray

    def draws(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) what each body lacks, and what it may leave to others, see `rules.lacking`."""
        lacks = [lacking(*each) for each in zip(self.store.tolist(), self.given.tolist())]
        spare = [spared(*each) for each in zip(*(a.tolist() for a in (self.left, self.store, self.given)))]
        return np.array(lacks), np.array(spare)


class Coupled:
    """An `Instance` during a step. Its model is wrench0 - tangent (pose - pose0).

    Attributes:
      idle: the skin rests, and what comes is too far for this step's accelerations to matter.
      gamma: (n,) Newmark's, of this step: the skin is solved where its bodies come after `horizon` (n,) [s]
        without acceleration, and by `square` (n,) times an acceleration [m per m/s^2] further. Each body has
        its own: one that arrives beside others that the skin holds makes backward Euler's step.
      off: [m] how far the bodies go from where the skin was last solved.
      straight: (n, 6) how its bodies move in the step without acceleration. travel: how they move by the mean
        of the velocities before and after it, so that a force's work is a change of kinetic energy.
      drift: (n, 6) how they move without acceleration to where the skin is solved, moved: what accelerations
        add.
      drifted, predicted_wrench: wrenches (n, 6) of its model where that leads to, and where both do; None
        where they are not known yet. `SkinGroup` finds these, `off`, `drift` and `moved`, for all
        skins at once.
      touching: numbers of the bodies that the skin holds: it has a stiffness against them.
      may_act: whether another solve is worth its cost: not after one that found no balance, which took long.
      push: (n,) 1 where the wrenches at the present pose act, 0 where they are withheld, see
        `World._restrain`.
      amiss: what the correction of the integrator's accelerations still lacks: it acts on the bodies too.
      excess: what the rows push beyond their stiffness where MuJoCo's solver did not converge: it acts too.
      compliance: (n, n, 6, 6) motion of one body by a wrench on another where the skin is solved [m/N], see
        `SkinGroup.find_compliance`.
      passed: (n, 6, nv) by which the bodies' motion in the step is that of the degrees of freedom: the mean
        over Runge-Kutta's stages.
      forced: wrenches (n, 6) that act in place of model and rows, or None, see `World._solve_group`.
    """

    def __init__(self, instance: Instance, data: DataView):
        self.instance, self.data = instance, data
        self.wrench0, self.tangent, *self.pose0 = instance.last_model()
        self.touching, self.idle = _touching(self.tangent), False
        if not len(self.touching):  # maybe nothing is near
            self.pose = instance.touching.predict(data, instance.horizon)
            self.idle = instance.is_out_of_reach(*self.pose)
        self.core, self.jacobian = (), None
        if self.idle:
            return
        self.passed = self.jacobian = instance.metric.jacobians(data)
        if instance.inertial:
            self.core = instance.touching.core_motion(data, instance.horizon)
            self.core_jacobian = data.jacobian(instance.touching.core, np.ascontiguousarray(self.core[0][0]))
        self.correction, self.amiss, self.excess = np.zeros((3, len(self.wrench0), 6))
        self.push = np.ones(len(self.wrench0))
        self.asked = self.result = self.compliance = None
        self.use_gamma(instance.gamma(self.tangent.any(axis=(1, 2))))
        self.drifted = self.predicted_wrench = None
        self._account = None  # the `_Energy` of the present model and accelerations
        self.written, self.settled, self.forced = False, True, None
        self.off, self.may_act, self._cost = np.inf, True, 0.0
        self.here = instance.touching.predict(data, 0.0)

    def use_gamma(self, gamma: np.ndarray) -> None:
        """Makes the bodies' step (n,) that of another member of Newmark's family; `SkinGroup.find_drift` has
        to follow."""
        instance = self.instance
        self.gamma, self.horizon = gamma, (gamma - 0.5) * instance.horizon
        if instance.by_stages:  # positions go by the mean velocity, as those of others half a step before
            self.horizon = self.horizon + 0.5 * instance.horizon
        self.square = np.array([beta_of(g) for g in gamma.tolist()]) * instance.horizon**2
        self.pose = instance.touching.predict(self.data, self.horizon)
        self.written, self.drifted = False, None

    def leave_at_rest(self) -> None:
        """Leaves a skin that nothing reaches as it is, and takes its rows away."""
        self.instance.stay_at_rest(*self.pose)
        self.release()

    # --- Newton's method on the pose at the end of the step ---

    def set_target(
        self, acceleration: np.ndarray, moved: np.ndarray, travel: np.ndarray, target: tuple
    ) -> None:
        """Takes where the bodies go with accelerations (nv,): what these move them by (n, 6), their travel,
        and poses (n, 3) [m], (n, 3, 3)."""
        self.acceleration, self.moved, self.travel, self.target = acceleration, moved, travel, target
        self.off, self._account, self.predicted_wrench = np.inf, None, None

    def solve(self) -> None:
        """Solves the skin where its bodies go, which give way from there."""
        if not getattr(self.instance.setup.skin.stepper, "gives_way", False):  # it knows prescribed poses
            self._solve(self.target)
            return
        spin = self.drift[:, 3:] + self.moved[:, 3:]
        wrench = self.acting() / self.instance.touching.fraction[:, None]
        where = self.target[0], self.here[0], spin
        self._solve(self.target, BodyMotion(self.compliance, wrench, *where))

    def finish(self) -> None:
        """Solves the skin where its bodies are sure to come."""
        self._solve(self.target)

    def _solve(self, pose, bodies=None):
        self._let_go = pose if bodies is None else bodies.without(np.arange(len(self.wrench0)), *pose)
        result = self.instance.solve_for_pose(*pose, self._core_motion(), self.result, self._cost, bodies)
        self._cost += result.cost
        self.may_act = result.converged and self._cost < _MOST
        self.use(pose if bodies is None else result.pose, result)

    @property
    def balanced(self) -> bool:
        """Whether its model is that of a balance found in this step."""
        return self.result is not None and self.result.converged

    def model(self) -> tuple:
        """What `use` takes to come back to the present model."""
        return self.asked, self.result

    def use(self, asked: tuple | None, result: SkinResult) -> None:
        """Takes the model of a solve at `asked`."""
        if asked is None:
            return
        self.asked, self.result = asked, result
        self.instance.keep(result)
        self.wrench0, self.tangent, self.pose0 = result.wrench, result.tangent, result.pose
        if not result.converged:
            model = self.wrench0, self.tangent, displacement(*self._let_go, *self.pose0)
            shares = np.array([share_that_pushes(*each, LEVER) for each in zip(*model)])
            self.tangent = shares[:, None, None] * self.tangent
        self.written = False
        self.drifted = self.predicted_wrench = self._account = None
        self.touching, correction = _touching(self.tangent), np.zeros_like(self.wrench0)
        correction[self.touching] = self.correction[self.touching]
        self.correction = correction

    def _core_motion(self):
        if not self.core:
            return ()
        (start, end), (turned, turning) = self.core
        moved_by = self.instance.horizon**2 * (0.5 if self.instance.by_stages else 1.0)
        move = moved_by * (self.core_jacobian @ self.acceleration)
        return np.stack([start, end + move[:3]]), np.stack([turned, rotation(move[None, 3:])[0] @ turning])

    # --- in MuJoCo's dynamics ---

    def apply(self) -> np.ndarray:
        """Puts the model into MuJoCo's rows; returns the wrenches (n, 6) that act besides."""
        metric = self.instance.metric
        if self.forced is not None:
            metric.release()
            return self.forced
        if not self.written:
            metric.write(self.jacobian, self.tangent, self.square)
            self.written = True
        return self.correction + self._push()

    def force(self, wrench: np.ndarray, push: float) -> None:
        """Lets wrenches (n, 6) act in place of model and rows; push: 1 where these are the skin's, 0 where
        they are none."""
        self.forced, self._account = wrench, None
        self.push = np.full(len(wrench), push)
        self.touching, self.written, self.settled = np.zeros(0, int), False, False

    def hold(self) -> None:
        """Lets what acts go on as it is, whatever accelerations come: in all stages of Runge-Kutta's step."""
        self.forced, self.touching, self.written = self.acting(), np.zeros(0, int), False
        self.passed = STAGES[0] * self.jacobian

    def act_by_rows(self) -> None:
        """Lets model and rows act again."""
        if self.forced is not None:
            self.forced, self.touching, self._account = None, _touching(self.tangent), None

    def equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Wrenches (n, 6) without acceleration, and how they fall as the bodies move on (n, 6, 6)."""
        self.push = np.ones(len(self.push))
        return self._push(), self.tangent

    def _push(self):
        """Wrenches where the bodies come without acceleration."""
        if self.drifted is None:  # ways are measured as the rows measure them, also where bodies turn
            start = *self.pose, self.here[0], self.drift[:, 3:]
            self.drifted = self.after(-displacement_at_once(*self.pose0, *start))
        if (self.push > 0.0).all():
            return self.drifted
        # against the drift itself: the way from here to the pose is another one where bodies turn by a radian
        return np.where(self.push[:, None] > 0.0, self.drifted, -self._by_tangent(self.drift))

    def acting(self) -> np.ndarray:
        """Wrenches (n, 6) that act on the bodies, as MuJoCo takes them: linear in the accelerations."""
        if self.forced is not None:
            return self.forced
        return self._push() - self._by_tangent(self.moved) + self.amiss + self.excess

    def acting_with(self, acceleration: np.ndarray) -> np.ndarray:
        """The same with accelerations (nv,) that MuJoCo's constraint solver has found, in this step."""
        if self.forced is not None:
            return self.forced
        rows = self.instance.metric.excess(self.data, acceleration) - self._by_tangent(
            self.square[:, None] * (self.jacobian @ acceleration)
        )
        return self.correction + self._push() + rows

    def _by_tangent(self, motion):
        return (self.tangent @ motion[:, :, None])[:, :, 0]

    def _model(self, pose):
        return self.after(displacement(*pose, *self.pose0))

    def after(self, motion: np.ndarray) -> np.ndarray:
        """Wrenches (n, 6) of its model after motions (n, 6) from the pose that it is of."""
        return self.wrench0 - self._by_tangent(motion)

    def _predicted_wrench(self):
        if self.predicted_wrench is None:
            self.predicted_wrench = self._model(self.target)
        return self.predicted_wrench

    def release(self) -> None:
        """Takes the rows' stiffness away."""
        self.instance.metric.release()

    # --- the energy that the skin can give ---

    @property
    def euler(self) -> bool:
        """Whether no member of the family damps more than that of its step."""
        return self.instance.inertial or bool((self.gamma >= EULER).all())

    @property
    def turning(self) -> float:
        """How far its bodies turn in the step at most [rad]."""
        return np.abs(self.travel[:, 3:]).max(initial=0.0)

    def overdraws(self) -> bool:
        """Whether what acts gives bodies more energy on their way than they have in the skin."""
        lacks, spare = self._energy().draws()
        return lacks.sum() > spare.sum()

    def restrain(self) -> bool:
        """Takes the push on bodies that would get more than they have; returns whether there are any. Such a
        body is leaving: force and motion point the same way."""
        greedy = (self._energy().draws()[0] > 0.0) & (self.push > 0.0)
        if not (self.overdraws() and greedy.any()):
            return False
        self.push, self._account = np.where(greedy, 0.0, self.push), None
        return True

    def _energy(self):
        if self._account is None:
            acting = self.acting()
            most = self.instance.most_energy(self.instance.last_model()[0])
            # a solve that lost its way knows little of the force that was there before it, and what is
            # withheld is in the skin all the same
            most = np.maximum(most, self.instance.most_energy(self._predicted_wrench()))
            given = (acting * self.travel).sum(axis=1)
            left = self.instance.last_energy()[0]
            self._account = _Energy(left, self._store(left, acting, most), most, given, acting)
        return self._account

    def _store(self, left, acting, most):
        """(n,) what the bodies have put into the skin so far, also by those who move them from outside
        [J]."""
        ends = self.instance.last_energy()[1]
        if ends is None:
            jump, placed = None, np.ones(len(left), bool)
        else:
            jump = displacement(*self.here, *ends)
            placed = sizes(jump) > np.maximum(TELEPORT, sizes(self.straight))
        store, self._placed = np.minimum(left, most), placed
        if jump is not None and not self.instance.was_out_of_reach:
            # who moved them by little out of reach did not push them in
            before, now = ((w * jump).sum(axis=1) for w in (self.instance.last_model()[0], acting))
            store = np.array([in_store(*each) for each in zip(left, before, now, most)])
        if placed.any():
            clear = self.instance.is_clear(*self.here)
            self._placed = placed & (not clear)
            pushes = np.zeros_like(acting) if clear else self._predicted_wrench()
            # into the skin, by somebody: that puts energy in
            store = np.where(placed, self.instance.most_energy(pushes), store)
        return store

    def conclude(self, rounds: int, frequency: np.ndarray | None) -> None:
        """Tells the instance how the step went; frequency: of `SkinGroup.frequencies`."""
        energy, withheld = self._energy(), 1.0 - self.push.min(initial=1.0)
        self.instance.concluded(
            rounds, self.settled, withheld, self._left(energy.given), self.target, energy.acting
        )
        self.instance.bounced(self.gamma, frequency)

    def arrived(self, moved: np.ndarray, near: float) -> None:
        """Settles the account when the degrees of freedom have moved (nv,), and MuJoCo's poses are those of
        now. near: [m] from where they were to go."""
        ends, travel = self.instance.touching.predict(self.data, 0.0), self.passed @ moved
        if not self.instance.by_stages:  # they went by the velocity after the step
            travel = travel + self.straight - self.travel
        given = (self._energy().acting * travel).sum(axis=1)
        self.instance.arrived(self._left(given), ends, size(travel - self.travel) < near)

    def _left(self, given):
        """(n,) energy that is in the skin after it gave bodies some (n,) [J]."""
        energy = self._energy()._replace(given=given)
        lacks, spare = energy.draws()
        all_lack, all_spare = lacks.sum(), spare.sum()
        passed = min(all_lack, all_spare)  # from some to others
        # a damper, which is all that acts without push, keeps nothing
        left = energy.store - np.where(self.push > 0.0, given, np.maximum(given, 0.0))
        if passed > 0.0:
            left = left + passed * (lacks / all_lack - spare / all_spare)
        left = np.minimum(left, energy.most)
        if not self.result.converged:  # what was put in is not known before a balance is found
            left = np.where(self._placed | np.isinf(energy.left), np.inf, left)
        return left


def _touching(tangent):
    """Numbers of the bodies that tangents (n, 6, 6) hold."""
    return np.flatnonzero(tangent.any(axis=(1, 2)))


def sizes(motion: np.ndarray) -> np.ndarray:
    """(n,) of motions (n, 6) the largest entry each, of turns at a lever [m]."""
    return np.abs(motion * _SCALE).max(axis=1)


def size(motion: np.ndarray) -> float:
    """The largest of these."""
    return float(np.abs(motion * _SCALE).max(initial=0.0))
