"""Controllers that solve the tasks from touch, the machine's own position and the observed target.

A controller never uses the simulation's hidden state. Its estimates of force, position and load come from
`touch.Estimator`, a regression calibrated on other episodes (`calibrate`), or, during the calibration, from
the truth passed to `act`."""

import pathlib
import typing

import numpy as np

from ..coupling.config import Config
from ..data.objects import OBJECTS
from .touch import Touch, check_fitted_on, load_calibration, load_estimator

if typing.TYPE_CHECKING:
    from dm_control import composer

_FRICTION = Config().friction  # of the skin, known to the gripper


class Scripted:
    """Estimates the hidden state from touch, and acts. `act(observation, truth)` takes (nbiotac, nestimated)
    true values instead of the estimates."""

    task: str
    calibration = None  # name of its estimator if not the task's
    # the estimator, loaded on use; arrays of the calibration, None: the package's
    estimator = stored = None

    @property
    def fit(self) -> str:
        """Name of its estimator."""
        return self.calibration or self.task

    def reset(self) -> None:
        """Before an episode."""
        self.touch, self.frame = Touch(), 0

    def act(self, observation: dict, truth: np.ndarray | None = None) -> np.ndarray:
        """The action for an observation."""
        self.felt = self.touch.update(observation)
        self.frame += 1
        if truth is None:
            if self.estimator is None:
                self.estimator = load_estimator(self.fit, self.stored)
            truth = self.estimator(self.felt)
        touching = float(np.abs(self.felt).max()) > 0.6
        return np.clip(
            self.control(observation, truth, touching) if self.touch.tared else self.wait(observation), -1, 1
        )

    def wait(self, observation: dict) -> np.ndarray:
        return np.zeros(3)

    def control(self, observation: dict, estimate: np.ndarray, touching: bool) -> np.ndarray:
        raise NotImplementedError


class Press(Scripted):
    """Moves down until contact, then in proportion to the error of the force."""

    task = "press"

    def control(self, observation: dict, estimate: np.ndarray, touching: bool) -> np.ndarray:
        error = estimate[0, 0] - observation["target"][0]
        return np.array([0, 0, 0.25 * error if touching else -0.4])


class FollowEdge(Scripted):
    """Keeps the force, steers the pad onto the rim, turns with it, and moves tip first."""

    task = "follow_edge"

    def wait(self, observation: dict) -> np.ndarray:
        return np.zeros(4)

    def control(self, observation: dict, estimate: np.ndarray, touching: bool) -> np.ndarray:
        offset, turn, force = estimate[0]
        if not touching:
            return np.array([0, 0, -0.4, 0])
        yaw = observation["position"][3]
        along, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        velocity = np.clip(6.0 * offset, -8e-3, 8e-3) * left - 9e-3 * (abs(offset) < 1.5e-3) * along
        return np.array(
            [*(velocity / 0.03), np.clip(0.2 * (force - 0.8), -0.2, 0.2), np.clip(-4.0 * turn, -0.8, 0.8)]
        )


class RollBall(Scripted):
    """Presses lightly and moves the finger at twice the desired speed of the ball."""

    task = "roll_ball"

    def control(self, observation: dict, estimate: np.ndarray, touching: bool) -> np.ndarray:
        ball, force = observation["position"][:2] + estimate[0, :2], estimate[0, 2]
        if not touching:
            return np.array([0, 0, -0.3])
        velocity = (
            np.clip(6.0 * (observation["target"] - ball), -0.015, 0.015) if force > 0.1 else np.zeros(2)
        )
        return np.array([*(velocity / 0.03), np.clip(0.3 * (force - 0.4), -0.2, 0.2)])


class Explore(Scripted):
    """Presses at five locations to one depth below first contact, then chooses the object with the most
    similar presses."""

    task = "explore"
    places = 1e-3 * np.array([[0, 0], [3, 0], [-3, 0], [0, 3], [0, -3]])
    depth, clear = 0.9e-3, 0.7e-3
    # frames at depth before the reading; frames after which a stiff object is read as is
    settle, patience = (4, 25)

    def reset(self) -> None:
        super().reset()
        self.stage, self.first, self.count, self.pressed, self.felt_at = "search", None, 0, 0, []
        self.belief = np.zeros(len(OBJECTS))

    def act(self, observation: dict, truth: np.ndarray | None = None) -> np.ndarray:
        self.felt = self.touch.update(observation)
        self.frame += 1
        motion = self._move(observation["position"]) if self.touch.tared else np.zeros(3)
        return np.concatenate([np.clip(motion, -1, 1), self.belief])

    def _to(self, position, goal):
        """Velocity towards a goal [m], and whether it is reached."""
        error = np.asarray(goal) - position
        return np.clip(25.0 * error / 0.03, -1, 1), np.abs(error).max() < 1.5e-4

    def _move(self, position):
        if self.stage == "search":
            if np.abs(self.felt).max() > 0.6:
                self.first, self.stage = position[2], "press"
            return np.array([0, 0, -0.3])
        if self.stage == "done":
            return self._to(position, [0, 0, self.first + 2e-3])[0]
        place = self.places[len(self.felt_at)]
        if self.stage == "press":
            motion, there = self._to(position, [*place, self.first - self.depth])
            self.pressed += 1
            self.count = self.count + 1 if there else 0
            if self.count >= self.settle or self.pressed >= self.patience:
                self.felt_at.append(self.felt[0])
                self.count, self.pressed, self.stage = 0, 0, "lift"
                if len(self.felt_at) == len(self.places):
                    self.stage = "done"
                    self.decide()
            return motion
        if self.stage == "lift":
            motion, there = self._to(position, [*position[:2], self.first + self.clear])
            self.stage = "shift" if there else "lift"
            return motion
        motion, there = self._to(position, [*place, self.first + self.clear])
        self.stage = "press" if there else "shift"
        return motion

    def decide(self) -> None:
        """Linear discriminant analysis of the presses."""
        stored = load_calibration() if self.stored is None else self.stored
        score = np.ravel(self.felt_at) @ stored["explore/weight"] + stored["explore/bias"]
        self.belief[:] = -1
        self.belief[np.argmax(score)] = 1


class Hold(Scripted):
    """Grips as hard as the estimated load requires, with a margin; closes fast if the load approaches the
    friction limit, which indicates slip."""

    task, calibration = "hold", "grip"
    # grip without load [N]; factor on the required grip, and margin [N]; gain
    least, factor, margin, gain = (1.0, 1.5, 0.35, 1.5)

    def wait(self, observation: dict) -> np.ndarray:
        return np.zeros(1)

    def control(self, observation: dict, estimate: np.ndarray, touching: bool) -> np.ndarray:
        return np.array([self.grip(estimate, touching)])

    def grip(self, estimate: np.ndarray, touching: bool) -> float:
        if not touching:
            return 0.4
        grip, load = estimate[:, 0].mean(), max(0.0, estimate[:, 1].sum())
        needed = load / (2 * _FRICTION)
        self.slipping = needed > 0.85 * max(grip, 0.1)
        error = max(self.least, self.factor * needed + self.margin) - grip
        return np.clip((self.gain if error > 0 else 0.7) * error, -0.15, 1.0) + 0.3 * self.slipping


class Lift(Hold):
    """Like `Hold`; raises after gripping, slowly while the load grows."""

    task = "lift"
    least, factor, margin, gain = 0.35, 1.3, 0.15, 0.7  # the load comes slowly here
    goal = 0.0315  # [m] of the gripper

    def wait(self, observation: dict) -> np.ndarray:
        return np.zeros(2)

    def reset(self) -> None:
        super().reset()
        self.ready = self.slipping = False

    def control(self, observation: dict, estimate: np.ndarray, touching: bool) -> np.ndarray:
        grip = self.grip(estimate, touching)
        self.ready = self.ready or (touching and estimate[:, 0].mean() > 0.9 * self.least)
        height = observation["position"][0]
        speed = 0.15 if height < 1.5e-3 else 0.9
        return np.array(
            [min(speed * (not self.slipping), 20 * (self.goal - height) / 0.03) if self.ready else 0.0, grip]
        )


SCRIPTED = {c.task: c for c in (Press, FollowEdge, RollBall, Explore, Hold, Lift)}


def make_controller(
    task: str, env: "composer.Environment | None" = None, calibration: pathlib.Path | str | None = None
) -> Scripted:
    """The scripted controller of a task.

    Args:
      task: its name.
      env: environment; a `CalibrationWarning` is issued if its BioTacs differ from those of the estimator's
        fit.
      calibration: file of `python scripts/fit_estimators.py --out`; None: the package's.

    Raises:
      ValueError: the task has none.
    """
    if task not in SCRIPTED:
        raise ValueError(f"no scripted controller for task {task!r}: there are {', '.join(SCRIPTED)}")
    controller = SCRIPTED[task]()
    controller.stored = load_calibration(None if calibration is None else str(calibration))
    for config in {str(b.handle.config): b.handle.config for b in env.task.biotacs}.values() if env else ():
        check_fitted_on(controller.fit, controller.stored, config)
    return controller
