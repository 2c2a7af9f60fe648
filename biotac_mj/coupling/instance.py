"""One BioTac in one mjData: poses in, skin solved, wrenches and readings out.

The state between steps is in `mjData.plugin_state`. Everything else in an `Instance` can be recomputed from
it, so mj_getState, mj_copyData, mj_resetData, rollouts and threads work on MuJoCo's own state alone."""

import dataclasses
import functools
import math
import warnings

import mujoco
import numpy as np

from ..geometry.rigid import cross
from ..geometry.surface import face_areas
from ..skin.bodies import BodyMotion
from .config import TIERS
from .implicit.kinematics import Kinematics
from .implicit.metric import assign_slots
from .implicit.rules import EULER, PATIENCE
from .loads import Touches
from .setup import (
    CONVERGED,
    FAILED,
    LINEAR,
    OUT_OF_REACH,
    REACHED,
    STARTED,
    STAYED,
    Setup,
)
from .solid_contacts import solid_wrench
from .stepper import SkinResult
from .structs import DataView, ModelView

# flags with which, both set, MuJoCo asks for no passive forces, and so for no skin
NO_PASSIVE = int(mujoco.mjtDisableBit.mjDSBL_SPRING) | int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
# flag with which nothing in the model touches, the skin neither
NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

_RK4, _DISCRETE = (int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for name in ("RK4", "DISCRETE"))
NO_SENSOR = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)  # flag with which MuJoCo writes no sensors
STAGES = 1 / 6, 1 / 3, 1 / 3, 1 / 6  # of Runge-Kutta: their shares in its step


@dataclasses.dataclass
class Outcome:
    """How a coupled step went; the defaults are of a step in which bodies and skin do not meet.

    Attributes:
      rounds: through MuJoCo's solver and the skin.
      settled: whether the skin was solved where the bodies go.
      withheld: fraction of the skin's push on a body that was, for lack of energy.
      energy: (ngroup,) left to each body in the skin at most [J]; None leaves the stored one.
      acting: wrenches (ngroup, 6) that the bodies get, None: those of the skin's last solve.
      gamma: (ngroup,) Newmark's. frequency: (ngroup,) angular, at which bodies bounce on the skin [rad/s];
        None leaves the stored one.
    """

    rounds: int = 1
    settled: bool = True
    withheld: float = 0.0
    energy: np.ndarray | float | None = 0.0
    acting: np.ndarray | None = None
    gamma: np.ndarray | float = EULER
    frequency: np.ndarray | None = None


class Instance:
    """The BioTac `index` of a model in one mjData.

    Attributes:
      dofs: those of the kinematic trees of the BioTac and of what can touch it.
      outcome: `Outcome` of the last step. ends: poses (ngroup, 3), (ngroup, 3, 3) of the bodies at its end,
        None: the predicted ones. A body that the next step finds elsewhere was moved by others.
      begun: frame in which a coupled step began.
      state: (nstate,) view of the plugin state, which stays where it is; parts: its parts, see `Setup.parts`;
        state_address: where it is.
      slots: of a two-way one, see `assign_slots`. keep_held: what of tangents rows represent; set by its
        group.
      sensed: whether the readings of this step are written.
      stays: whether the last solve left the skin as it was.
      put: the skin's state after bodies were placed before this step; None: none was.
      skins_met: (instance, which of its touching bodies this one is) of those that meet this one's skin.
    """

    def __init__(self, model: ModelView, data: DataView, index: int):
        self.setup = setup = Setup(model, index)
        self.model, self.data, self.index, self.touching = model, data, index, setup.touching
        two_way = setup.config.coupling == "two-way"
        self.touching.warn(model)
        sensors = setup.named("sensor")
        self.sensor = {
            name: slice(int(model.sensor_adr[i]), int(model.sensor_adr[i] + model.sensor_dim[i]))
            for name, i in sensors.items()
            if model.sensor_type[i] == int(mujoco.mjtSensor.mjSENS_USER)
        }
        numbers = np.arange(model.nsensordata)
        self._channels = np.concatenate([numbers[:0], *(numbers[where] for where in self.sensor.values())])
        # MuJoCo clears a user's sensors at their stage; they are written when the skin has been solved
        for name in self.sensor:
            model.sensor_needstage[sensors[name]] = int(mujoco.mjtStage.mjSTAGE_POS)
        self._tier, self._said = TIERS.index(setup.config.tier), set()
        self.two_way = two_way
        if self.two_way:
            slots = sorted(
                (int(n[6:]), i)
                for n, i in setup.named("eq").items()
                if n.startswith("couple") and n[6:].isdigit()
            )
            self.slots = assign_slots(model, setup.touching, [i for _, i in slots])
        start, size = int(model.plugin_stateadr[index]), int(model.plugin_statenum[index])
        if size < setup.nstate:
            raise ValueError(
                f"the model holds {size} numbers of BioTac state where {setup.nstate} are needed: "
                "compile it again from its XML or MjSpec"
            )
        self.state = data.plugin_state[start : start + setup.nstate]
        self.parts, self.state_address = setup.parts(self.state), self.state.ctypes.data
        self._geom_pose, self._solved = None, {}
        self._forget()
        trees = model.body_treeid[[self.touching.core, *self.touching.body]]
        self.dofs = np.flatnonzero(np.isin(model.dof_treeid, trees[trees >= 0]))
        self.skins_met = ()
        self._stages = []  # of Runge-Kutta: what acted, and where
        self._shown = None

    @property
    def lead(self) -> float:
        """Time by which the step begins ahead of the positions [s]. Runge-Kutta's positions go by the mean
        velocity, so those half a step ahead go by the one after a step, as with the other integrators."""
        return 0.5 * self.model.opt.timestep * self.by_stages

    @property
    def by_stages(self) -> bool:
        """Whether the integrator is RK4, whose four stages all call the skin."""
        return self.model.opt.integrator == _RK4

    def refuse_foreign_state(self, cause: Exception | None = None) -> None:
        """Raises ValueError for a plugin state that is none of this model: one with NaN, or, where a `cause`
        is known that it may have led to, one without the rotations that each has."""
        bad = not math.isfinite(self.state.sum())
        if bad:
            state = self.state.copy()
            energy = self.setup.parts(state)[1]["left"]
            energy[energy == np.inf] = 0.0
            bad = not np.isfinite(state).all()
        if cause is not None and not bad:
            turned = np.concatenate([self.parts[1][name] for name in ("mat0", "end_mat")])
            bad = np.abs(turned @ turned.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0) > 1e-6
        if bad:
            raise ValueError(
                "the BioTac's part of plugin_state is no state of this model: call mj_resetData, or "
                "mj_setState with a state that mj_getState gave"
            ) from cause

    def forget_last_solve(self) -> None:
        """Forgets the last solve. Raises ValueError where the model cannot be stepped two-way or the state is
        none."""
        self.refuse_foreign_state()
        self.touching.parted = bool(self.model.opt.disableflags & NO_CONTACT)
        self._forget()
        if self.two_way and self.model.opt.integrator == _DISCRETE:
            raise ValueError(
                "the integrator discrete overwrites the skin's stiffness: "
                "choose implicitfast, implicit or Euler, or coupling='one-way'"
            )

    def _forget(self):
        self._error, self._result, self._reading = False, None, None
        self.outcome, self.ends = Outcome(), None
        self.put, self.sensed, self.stays = None, False, False

    @functools.cached_property
    def kinematics(self) -> Kinematics:
        """Of the touching bodies."""
        return Kinematics(self.model, self.data, [self.touching])

    def take_placed(self, placed: np.ndarray) -> bool | None:
        """Bodies that were placed, (ngroup,) of int, begin where they were put, which may lie behind where
        the step begins. Returns whether they leave the skin alone; None where it is not known."""
        where = self.touching.geom_pose(*self.kinematics.predict(-self.lead))
        placed = (placed > 0) & ~(self.touching.by_mocap & (self.parts[0][STARTED] != 0.0))
        stepper = self.setup.skin.stepper
        with self.setup.skin.lock:
            if placed.any():
                self.put = stepper.put(self._skin, placed[self.touching.group], *where)
            return stepper.is_clear(*where)

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose (3,) [m], (3, 3) of the BioTac in the world."""
        core = self.touching.core
        return self.data.xpos[core].copy(), self.data.xmat[core].reshape(3, 3).copy()

    def seen(self, wrench: np.ndarray) -> np.ndarray:
        """Wrenches (n, 6) in the BioTac frame with which the step began, in that of now."""
        return _in_frame(wrench, self.begun, self.frame()) if self.lead else wrench.copy()

    @property
    def _skin(self):
        """The skin's state when the step begins, after bodies were placed."""
        return self.parts[2] if self.put is None else self.put

    @property
    def inertial(self) -> bool:
        """Whether the skin has inertia, and so needs the motion of the BioTac."""
        return self.setup.skin.stepper.inertial

    def stay_at_rest(self, pos: np.ndarray, mat: np.ndarray) -> bool:
        """Whether the skin is at rest and so clear of bodies at (ngroup, 3), (ngroup, 3, 3) that they do not
        reach it within the step. It then needs no `solve_for_pose`, and costs next to nothing."""
        stepper, skin = self.setup.skin.stepper, self.parts[2]
        if not stepper.resting(skin):
            return False
        self._geom_pose = self.touching.geom_pose(pos, mat)
        with self.setup.skin.lock:
            stays = stepper.is_out_of_reach(skin, *self._geom_pose)
            if stays:
                self._result = dataclasses.replace(self.setup.skin.untouched, pose=(pos, mat))
                self._reading = None
        return stays

    def stay(self) -> SkinResult | None:
        """Instead of `solve_for_pose`, for bodies where the skin was solved in the last step: the result is
        the same, if that solve left the skin as it was. None: it did not, or a solve is needed for more."""
        reach, skin, state = self.parts[0][STARTED], self.setup.skin, self.parts[2]
        changes = self.put is not None or self.touching.parted or self.setup.config.textures is not None
        known = abs(reach) == STAYED and not changes
        pressure = skin.stepper.pressure(state) if known else None
        if pressure is None:
            return None
        wrench, tangent, *pose, slack = self._last_model()
        with skin.lock:
            vert = skin.stepper.vert_xpos(state)
        known = {"measured": reach > 0, "pose": tuple(pose), "slack": slack}
        result = SkinResult(state, wrench, tangent, vert, pressure, **known)
        self._result, self._reading, self.stays = result, None, True
        return result

    def _last_model(self):
        """Copies of the `LINEAR` model of the last step."""
        return (self.parts[1][name].copy() for name in LINEAR)

    def solve_for_pose(
        self,
        pos: np.ndarray,
        mat: np.ndarray,
        core: tuple = (),
        near: SkinResult | None = None,
        spent: float = 0.0,
        bodies: BodyMotion | None = None,
    ) -> SkinResult:
        """Solves the skin for touching bodies at (ngroup, 3), (ngroup, 3, 3) in the BioTac frame and keeps
        the result for the readings. near: an earlier result of this step, to begin from. spent: of what a
        step may cost, by earlier solves. bodies: how the touching bodies give way; the result then holds
        where its own wrenches bring them. None: their poses are prescribed.

        An inertial skin needs `core`: poses (2, 3), (2, 3, 3) of the BioTac in the world at the start and the
          end of the step.
        """
        self.stays = False
        dt, stepper, before = self.model.opt.timestep, self.setup.skin.stepper, self._skin
        near = near if near is not None and near.converged else None
        more = {"near": near, "spent": spent}
        if stepper.inertial:
            more["core_pos"], more["core_mat"] = core
        if stepper.gives_way:
            more["bodies"] = bodies
        begun = () if near is None else near.pose
        given = () if bodies is None else (bodies.compliance, bodies.wrench)
        poses = [a.tobytes() for a in (pos, mat, *core, *begun, *given)]
        flags = near is None, bodies is None, self.touching.parted
        key = (dt, spent, *flags, *poses, self.parts[1].tobytes(), stepper.key(before))
        # solving is a function of the key, so a second mj_forward costs nothing
        result = self._solved.get(key)
        if result is None:
            geom_pose = self.touching.geom_pose(pos, mat)
            with self.setup.skin.lock:
                result = stepper.solve_skin(before, *geom_pose, dt, **more)
            pose = (pos, mat) if bodies is None else self._came_to(result.state)
            fraction, path = self.touching.fraction, self.touching.path
            wrench, tangent = (
                fraction[:, None] * result.wrench,
                (fraction * path)[:, None, None] * result.tangent,
            )
            if self.two_way:
                tangent = self.keep_held(tangent)
            # a stepper may keep its own
            result = dataclasses.replace(result, pose=pose, wrench=wrench, tangent=tangent)
            if not result.converged:
                result = self._as_far_as_known(result, before)
            if len(self._solved) > 8:
                self._solved.clear()
            self._solved[key] = result
        self._result, self._reading = result, None
        return result

    def _came_to(self, state):
        """Poses (ngroup, 3), (ngroup, 3, 3) of the bodies for which a skin's state holds; None where the skin
        does not know."""
        ends = self.setup.skin.stepper.came_to(state)
        return ends and self.touching.body_pose(*ends)

    def _as_far_as_known(self, result, before):
        """Result of a solve that did not converge: the end of its load path, or the last step's model. Short
        of where the bodies are nothing is known of the skin there: the readings hold."""
        stepper = self.setup.skin.stepper
        if result.load_factor < 1.0:
            result = dataclasses.replace(result, vert_xpos=None, pressure=None)
        if result.load_factor > 0.0 and (pose := self._came_to(result.state)):  # maybe on a path from outside
            return dataclasses.replace(result, pose=pose)
        if not self.parts[0][STARTED]:  # the first step
            return result
        wrench, tangent, *last, _ = self._last_model()
        state = before.copy()
        if self.parts[0][CONVERGED] <= -PATIENCE:
            stepper.reset(state)
            if not stepper.resting(state):  # it has more to lose
                state[:] = before
        load = np.ones(len(stepper.contact_rows(state)))  # not known: even
        model = {"wrench": wrench, "tangent": tangent, "pose": tuple(last)}
        return dataclasses.replace(result, state=state, load=load, **model)

    def _counts(self):
        if self._reading is None:
            skin, result = self.setup.skin, self._result
            state, touch, config = self.parts[3].copy(), {}, self.setup.config
            with skin.lock:
                felt = result.wrench / self.touching.fraction[:, None]  # by the skin itself
                if config.thermal is not None:
                    after = result.state is not None
                    area = skin.stepper.contact_area(result) if after else np.zeros(self.setup.ngroup)
                    touch = {"area": area, "force": np.linalg.norm(felt[:, :3], axis=1)}
                if config.textures is not None:
                    whole = dataclasses.replace(result, wrench=felt)
                    touch["shaking"] = skin.readings.shaking(self._skin, whole, self.model.opt.timestep)
                counts = skin.readings.advance(
                    state, self.data.time, self.model.opt.timestep, result.vert_xpos, result.pressure, **touch
                )
            self._reading = state, counts
        return self._reading

    @property
    def is_cleared(self) -> bool:
        """Whether MuJoCo has cleared the sensors, because it writes them in this step."""
        return not self.data.sensordata[self._channels].any()

    def sense(self) -> None:
        """Writes the readings into sensordata."""
        out, result, self.sensed = self.data.sensordata, self._result, True
        if self._error or result is None:
            self._flag()
            return
        for name, counts in self._counts()[1].items():
            if name in self.sensor:
                out[self.sensor[name]] = counts
        wrench, good = self._stages[0] if self._stages else self._acting()
        if "contact_force" in self.sensor:
            out[self.sensor["contact_force"]] = wrench
        if "status" in self.sensor:
            tier = self._tier if result.measured else -1
            if not good:
                self._warn_once(
                    "a step did not settle, and status[1] counts these: if more do than one in a hundred, "
                    "take a shorter time step or press more slowly (docs/concepts/coupling.md)"
                )
            elif not result.measured:
                self._warn_once(
                    f"it is pressed beyond the range in which the error of tier={TIERS[self._tier]!r} was "
                    "measured, and status[4] is -1 there: press less"
                    f"{', or take the full tier' * self._tier} (docs/concepts/tiers.md)"
                )
            failed, load_factor = self.state[FAILED] + (not good), result.load_factor
            of_solve = result.iterations, result.residual
            of_step = good, failed, *of_solve, tier, self.outcome.rounds, load_factor, self.outcome.withheld
            out[self.sensor["status"]] = of_step

    def _warn_once(self, text):
        if text not in self._said:
            self._said.add(text)
            name = self.model.name("body", self.touching.core)
            warnings.warn(f"BioTac {name!r}: {text}", RuntimeWarning, stacklevel=3)

    def _acting(self):
        """Wrench (6,) on the BioTac in its frame as it acts now, and whether skin, bodies and MuJoCo's
        constraint solver settled."""
        none = np.zeros(self.model.ntree, bool)
        (solid, _), solved = solid_wrench(self.model, self.data, self.touching.core, self.dofs, none)
        return solid + self._pushed(), self._settled and solved

    @property
    def _settled(self):
        """Whether skin and bodies did."""
        return self._result.converged and self.outcome.settled

    def _pushed(self):
        """Wrench (6,) on the BioTac in its frame by what meets its skin, and by skins that it meets."""
        force = -self.acting_wrench().sum(axis=0)
        for other, group in self.skins_met:
            push = other.acting_wrench()[[group]]
            if push.any():
                force += _in_frame(push, other.frame(), self.frame())[0]
        return force

    def acting_wrench(self) -> np.ndarray:
        """(ngroup, 6) that the touching bodies get from the skin in this step, in the BioTac frame; zeros
        after an error."""
        if self._error or self._result is None:
            return np.zeros((self.setup.ngroup, 6))
        return self._result.wrench if self.outcome.acting is None else self.outcome.acting

    @functools.cached_property
    def _touches(self):
        geometry = self.setup.skin.geometry
        return Touches(self.touching.group, geometry.outer_face, geometry.nvert, self.setup.ngroup)

    def touches(self, wrench: np.ndarray, by_place: bool) -> tuple[np.ndarray, np.ndarray]:
        """Wrenches (ngroup, 6) on the touching bodies as contacts of their geoms, see `Touches.find`.
        by_place: at the places where the skin pushes; else on the axis of the wrench."""
        found, skin, result = self._touches, self.setup.skin, self._result
        found.wrench[:], found.kept[:] = wrench, 0
        known = by_place and result is not None and result.state is not None
        with skin.lock:
            touched = skin.stepper.touched_faces(result.state) if known else None
            if touched is not None:
                found.x[:] = skin.stepper.vert_xpos(result.state)
        if touched is not None:
            face, geom, push = touched
            normal = face_areas(found.x, skin.geometry.outer_face[face])
            normal /= np.linalg.norm(normal, axis=1)[:, None]
            found.kept[face], found.geom[face], found.force[face] = 1, geom, -push[:, None] * normal
        return found.find()

    def end_stage(self, first: bool, held: np.ndarray) -> None:
        """After the forces of all skins in a stage of Runge-Kutta's step: MuJoCo writes sensors in the first
        alone, and bodies get all four. The skin's push in the first acts in all, and so do contacts on the
        kinematic trees `held` (ntree,), whose own forces in later stages are none."""
        if self._error or self._result is None:
            return
        (of_stage, kept), solved = solid_wrench(self.model, self.data, self.touching.core, self.dofs, held)
        if first:
            self._stages, self._first, self._stays = [], self.frame(), self._pushed() + kept
        wrench = self._stays + _in_frame(of_stage[None], self.frame(), self._first)[0]
        self._stages.append((wrench, self._settled and solved))

    def _sum_up(self, settled):
        """Writes what acted over the stages of a step, in the frame of its start; whether all settled, and
        the step as a whole."""
        stages, self._stages = self._stages, []
        if not self.by_stages:
            return settled
        if len(stages) < len(STAGES):
            raise ValueError(
                "under RK4 MuJoCo's mj_step2 makes Euler's step, for which the skin was not solved: call "
                'mj_step, or set <option integrator="Euler"/>'
            )
        settled = settled and all(good for _, good in stages)
        total = sum(fraction * wrench for fraction, (wrench, _) in zip(STAGES, stages))
        if not self.model.opt.disableflags & NO_SENSOR:
            out = self.data.sensordata
            if "contact_force" in self.sensor:
                out[self.sensor["contact_force"]] = total
            if "status" in self.sensor:
                out[self.sensor["status"]][:2] = settled, self.state[FAILED] + (not settled)
        return settled

    def failed(self) -> None:
        """After an exception: the step's skin is unknown; the status sensor says -1."""
        self._error, self._result, self._reading, self._stages = True, None, None, []
        self.sensed = True
        self._flag()

    def _flag(self):
        if "status" in self.sensor:
            of_step = -1.0, self.state[FAILED], 0.0, np.nan, self._tier, 0.0, 0.0, 0.0
            self.data.sensordata[self.sensor["status"]] = of_step

    def commit_step(self) -> None:
        """Commits the solved step."""
        result = self._result
        if self._error or result is None:
            return
        readings, _ = self._counts()
        head, models, skin, readings_state = self.parts
        good = self._sum_up(self._settled)
        reach = OUT_OF_REACH if self.outcome.acting is None else REACHED
        if good and self.stays:
            reach = STAYED if result.measured else -STAYED
        head[:] = head[FAILED] + (not good), 1.0 if good else min(head[CONVERGED], 0.0) - 1.0, reach
        for name, value in zip(LINEAR, result.model):
            models[name] = value
        models["end_pos"], models["end_mat"] = self.ends or result.pose
        for name, value in (("left", self.outcome.energy), ("frequency", self.outcome.frequency)):
            if value is not None:
                models[name] = value
        if result.state is None:
            self.setup.skin.stepper.stay_at_rest(skin, *self._geom_pose)
        else:
            skin[:] = result.state
        if self.touching.parted:  # what is in the skin when contact is back was put there, as at the start
            head[STARTED] = 0.0
            stepper = self.setup.skin.stepper
            if stepper.resting(skin):
                stepper.reset(skin)
        readings_state[:] = readings
        self._solved.clear()

    def visualize(self) -> None:
        """Shows the deformed outer surface and colours the electrodes; MuJoCo calls it while it updates a
        scene."""
        from .show import Shown

        if self._shown is None:
            self._shown = Shown(self)
        self._shown.update()


def _in_frame(wrench, before, now):
    """Wrenches (n, 6) in a frame and about its origin (3,), (3, 3), in another one."""
    (at, turned), (origin, frame) = before, now
    force, torque = wrench[:, :3] @ turned.T, wrench[:, 3:] @ turned.T
    torque += cross((at - origin)[None], force)
    return np.concatenate([force @ frame, torque @ frame], axis=1)
