"""All two-way skins of an mjData in a step: their linear models, where their bodies go under these, and the
energy that the skins can give. The arrays and kernels of `rounds` and `energy`, seen from numpy; the bodies
of one skin follow those of another."""

import math
import types
from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp

from ...geometry.rigid_warp import LEVER
from ...kernels import set_fields
from ...skin.types import mat66, real, vec6
from ..instance import Instance
from ..setup import LINEAR, MODEL, STARTED
from ..solid_contacts import contacts_of
from ..structs import DataView, ModelView
from . import energy, rounds
from .compliance import Response, add_stiffness
from .coupled import Coupled
from .kinematics import Kinematics, row, rows_of
from .metric import Metric
from .rounds import MarkedWorlds, Model, Rounds, Solid
from .rows import keep_held
from .rules import LOSS_FREQUENCY
from .springs import Springs

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)  # the first type of a contact's row
_SCALE = np.array([1.0] * 3 + [LEVER] * 3)  # compares turning with going
_FLAGS = "awake", "began", "inside", "reason", "greedy", "marked"  # [skin]


class SkinGroup:
    """The two-way skins of an mjData. A stage of all skins is one call: a launch takes 1 us, several numpy
    calls on so few numbers.

    Attributes:
      skins: `Coupled` that take part in this step: not those that rest with nothing in reach.
      arrays: views (n, ...) of what kernels work on, by the names of `Rounds` and `Model`; last: of the last
        step's `Model`.
      find_energy, restrain: functions that do the energy balance. They return whether a skin is greedy, and
        whether push on a body had to be withheld.
      springs: `Springs`. metric: `Metric`. jacobian: (n, 6, nv) of the bodies relative to their BioTacs.
      correction: (n, 6) of what the integrator's accelerations differ in from the constraint solver's.
      amiss: (n, 6) what that still lacks: it acts on the bodies too.
      excess: (n, 6) what the rows push beyond their stiffness where MuJoCo's solver did not converge: it acts
        too.
      forced: wrenches (n, 6) that act in place of models and rows, or None.
    """

    def __init__(self, model: ModelView, data: DataView, instances: Sequence[Instance]):
        self._model, self._data, self._instances, self._made = model, data, instances, None
        meets = ((t.touching.core, body) for t in instances for body in t.touching.body)
        self._meets = np.array(list(meets), int).reshape(-1, 2)
        touchings, slots = [t.touching for t in instances], [t.slots for t in instances]
        self._kinematics = at = Kinematics(model, data, touchings)
        self.springs, self.arrays = Springs(model, data, list(map(len, slots))), types.SimpleNamespace()
        both = zip(instances, at.parts)
        self._all = [Coupled(t, data, self.arrays, k, bodies) for k, (t, bodies) in enumerate(both)]
        with wp.ScopedDevice("cpu"):
            self._make_arrays(at, at.jacobian.shape[:2])
        self._respond(at.jacobian)
        square, tangent = self._whole.square, self._models.tangent0
        self.metric = Metric(model, touchings, slots, (square, at.jacobian, tangent))

    def _make_arrays(self, at, shape):
        """Makes the arrays of all skins, each skin's structs cut out of them, and the views."""
        self._whole = whole = rounds.make_rounds(*shape)
        self._models, last = (rounds.make_model(*shape) for _ in range(2))
        wrench, tangent = wp.zeros(shape, dtype=vec6), wp.zeros(shape, dtype=mat66)
        left, self._qacc = wp.zeros(shape, dtype=real), wp.zeros_like(at.d.qvel)
        off, self._any = wp.zeros((len(self._all), 2), dtype=real), wp.zeros(1, dtype=int)
        flags = {name: wp.zeros(len(self._all), dtype=int) for name in _FLAGS}
        for k, (skin, part) in enumerate(zip(self._all, at.parts)):
            setup = skin.instance.setup
            skin.moving, skin.jacobian = at.bodies[k], rows_of(at.jacobian, part)
            skin.flags = {name: array[k : k + 1] for name, array in flags.items()}
            skin.wrench, skin.left, skin.off_out = rows_of(wrench, part), rows_of(left, part), off[k]
            skin.rounds = set_fields(
                _of_skin(Rounds, whole, part),
                began=skin.flags["began"],
                inside=skin.flags["inside"],
                surface=np.array([setup.skin.stepper.surface_energy]),
            )
            skin.model, skin.last = (_of_skin(Model, one, part) for one in (self._models, last))
            skin.marks = set_fields(MarkedWorlds(), world=skin.flags["marked"], any=self._any)
            skin.compliance = wp.zeros((setup.ngroup, setup.ngroup, 1), dtype=wp.spatial_matrixd)
            skin.by_mocap = wp.array(setup.touching.by_mocap, dtype=bool)
            of_skin = {"thickness": setup.skin.thickness, "inertial": setup.skin.stepper.inertial}
            skin.solid = set_fields(Solid(), area=1.0, **of_skin)
            skin.instance.keep_held = _keeping(rows_of(tangent, part))
        views = {"wrench": _seen(wrench), "left_out": _seen(left), "qacc": self._qacc.numpy()[0]}
        views |= {name: array.numpy() for name, array in {"off": off, **flags}.items()}
        views["compliance"] = [skin.compliance.numpy()[:, :, 0] for skin in self._all]
        views["last"] = {name: _seen(getattr(last, name)) for name in Model.vars}
        for struct in (whole, self._models):
            of_bodies = (name for name in struct._cls.vars if _is_of_bodies(getattr(struct, name)))
            views |= {name: _seen(getattr(struct, name)) for name in of_bodies}
        vars(self.arrays).update(views)

    def _respond(self, jacobian):
        """Makes the launches that find how the bodies respond to wrenches, with the factors of `springs`."""
        L, stiffness, frequencies = self.springs.L, self.springs.stiffness, []
        for skin in self._all:
            response, r, awake = Response(skin.jacobian, skin.model), skin.rounds, skin.flags["awake"]
            skin.find_compliance = row(*response.compliance(awake, L, r.square, skin.compliance))
            frequencies += response.frequencies(awake, stiffness, L, r.frequency)
        known = [jacobian, self._models, stiffness]
        self._find_frequencies = row((add_stiffness, stiffness.shape[:2], known), *frequencies)

    def _record(self, step, ahead):
        """Makes the launches for a time step [s]; ahead: see `rounds.choose_gamma`."""
        if self._made == (step, ahead):
            return
        self._made, m, d = (step, ahead), self._kinematics.m, self._kinematics.d

        def drift(skin):
            return skin.moving.drift(m, d, step, skin.jacobian, skin.rounds)

        def begin(skin):
            r, awake = skin.rounds, skin.flags["awake"]
            delay = skin.instance.setup.config.loss / (2 * math.pi * LOSS_FREQUENCY * step)
            return (
                skin.moving.here(d, r.here_pos, r.here_mat),
                *drift(skin),
                (rounds.begin_rounds, 1, [awake, skin.by_mocap, r, skin.last, skin.model]),
                (rounds.choose_gamma, r.pos.shape, [step, ahead, delay, skin.solid, skin.last, r]),
                *drift(skin),
            )

        def forces(skin):
            return [(rounds.wrenches, skin.wrench.shape, [skin.model, skin.rounds, skin.wrench])]

        def evaluate(skin):
            moved = skin.moving.accelerate(step, skin.jacobian, self._qacc, skin.rounds)
            return moved, (rounds.find_off, 1, [skin.model, skin.rounds, skin.off_out]), *forces(skin)

        def use_euler(skin):
            return (rounds.use_euler, 1, [step, skin.flags["greedy"], skin.rounds]), *drift(skin)

        def conclude(skin):
            flags = skin.flags["awake"], skin.flags["reason"]
            return [(energy.conclude, 1, [*flags, skin.rounds, skin.left])]

        stages = begin, use_euler, forces, evaluate, conclude
        self._begin, self._use_euler, self._find_wrenches, self._evaluate, self._conclude = (
            self._row(stage) for stage in stages
        )
        self.find_energy = self._marking(
            energy.find_energy, lambda s: (s.last, s.flags["reason"], s.solid, s.rounds, s.flags["greedy"])
        )
        none = wp.zeros((1, 0), dtype=float, device="cpu")
        self.restrain = self._marking(
            energy.restrain, lambda s: (0.0, s.solid, s.compliance, s.model, s.rounds, none)
        )

    def _row(self, launches):
        """One call for the launches of all skins."""
        return row(*(launch for skin in self._all for launch in launches(skin)))

    def _marking(self, kernel, known):
        """A function that runs a kernel and returns whether it has marked a skin."""
        run = self._row(lambda s: [(kernel, 1, [s.flags["awake"], *known(s), s.marks])])
        marked = self._any.numpy()

        def find():
            marked[0] = 0
            run()
            return bool(marked[0])

        return find

    def begin(self) -> None:
        """Begins a step: the linear models in force are those of the last one. Skins that rest with nothing
        in reach of this step's accelerations are left as they are."""
        first, arrays, step = self._instances[0], self.arrays, self._model.opt.timestep
        heads, tables, *_ = zip(*(t.parts for t in self._instances))
        models = np.concatenate(tables)
        resting = [not models["tangent0"][skin.bodies].any() for skin in self._all]
        if any(resting):  # maybe nothing is near
            pos, mat = self._kinematics.predict(step - first.lead)
        self.skins = []
        for skin, rests in zip(self._all, resting):
            skin.begin()
            idle = rests and skin.instance.stay_at_rest(pos[skin.bodies], mat[skin.bodies])
            arrays.awake[skin.number] = not idle
            if not idle:
                self.skins.append(skin)
        if not self.skins:
            return
        self.jacobian = self._kinematics.jacobians()
        self._rows = self.jacobian.reshape(6 * len(models), self._model.nv)
        self.correction, self.amiss, self.excess = np.zeros((3, len(models), 6))
        self.forced, self.written = None, False
        self._record(step, 0.5 * first.by_stages)
        for name in MODEL.names:
            getattr(arrays, name)[:] = models[name]
        for name in LINEAR:
            arrays.last[name][:] = models[name]
        for skin in self._all:
            if skin not in self.skins:
                skin.part("wrench0")[:] = 0.0
        arrays.began[:] = [head[STARTED] != 0.0 for head in heads]
        self._begin()
        self._kinematics.check(arrays.start_pos, arrays.start_mat)
        if arrays.placed.any():
            for skin in self.skins:
                if skin.part("placed").any() and skin.instance.take_placed(skin.part("placed")):
                    arrays.inside[skin.number] = 0
        for skin in self.skins:
            skin.instance.begun = skin.instance.frame()

    @property
    def touching(self) -> np.ndarray:
        """Numbers of the bodies that a skin holds: it has a stiffness against them."""
        return np.flatnonzero(self.arrays.tangent0.any(axis=(1, 2)))

    def held(self, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Jacobian (6 k, nv) of some bodies that skins hold, and what these push against accelerations (nv,)
        on them, (6 k, nv)."""
        tangent, square = self.arrays.tangent0[touching], self.arrays.square[touching]
        jacobian = self.jacobian[touching]
        held = square[:, None, None] * tangent @ jacobian
        return jacobian.reshape(-1, jacobian.shape[2]), held.reshape(-1, jacobian.shape[2])

    def evaluate(self, acceleration: np.ndarray) -> None:
        """Finds the poses that the bodies reach with accelerations (nv,), what acts on them so, and how far
        they are from the poses for which the skins were solved."""
        self.arrays.qacc[:] = acceleration
        np.add(self.amiss, self.excess, out=self.arrays.amiss)
        self._evaluate()
        self.arrays.lifted[:] = self._find_lift()
        for skin in self.skins:
            skin.find_off()

    def _find_lift(self):
        """(n,) [J] work that MuJoCo's contacts with core, nail and clamp do on the bodies in the step."""
        if not self._data.ncon:
            return 0.0
        geom = contacts_of(self._data)["geom"]
        pairs = np.where(geom >= 0, self._model.geom_bodyid[geom], -1)  # -1: a flex
        meet = (pairs[None, :, :, None] == self._meets[:, None, None]).any(axis=2).all(axis=2)
        if not meet.any():
            return 0.0
        rows, step = self._data.rows(), self._model.opt.timestep
        mean = self._data.qvel + 0.5 * step * self.arrays.qacc
        work = step * rows.efc_force * self._data.rows_moved_by(mean)
        of_contacts = rows.efc_type >= _CONTACT
        return meet @ np.bincount(rows.efc_id[of_contacts], work[of_contacts], len(geom))

    def use_models(self) -> None:
        """Takes the models of the last solves into use."""
        self.written = False
        self.correction[~self.arrays.tangent0.any(axis=(1, 2))] = 0.0

    def find_compliance(self, skins: Sequence[Coupled], inertia: np.ndarray | None) -> None:
        """Finds how the bodies of some skins give way to its wrenches: held by their inertia, with the
        damping that the integrator treats implicitly (`Integrator.inertia`; None: M alone), and by what
        MuJoCo's other constraints, the rows of other skins among them, now hold."""
        self.springs.take(inertia)
        for skin in skins:
            self.springs.factor(skin.number)
            skin.find_compliance()

    def find_frequencies(self) -> None:
        """Finds the frequencies at which the bodies bounce on all skins, as inertia and MuJoCo's other
        constraints let them."""
        self.springs.take(None)
        self.springs.factor(None)
        self.springs.held[:] = 0.0
        self._find_frequencies()

    def apply(self) -> np.ndarray:
        """Puts the models into MuJoCo's rows; returns the passive forces (nv,) that act besides."""
        if self.forced is not None:
            self.metric.release()
            return self.forced.ravel() @ self._rows
        if not self.written:
            self.metric.write(self.touching)
            self.written = True
        self._find_wrenches()
        return (self.correction + self.arrays.wrench).ravel() @ self._rows

    def use_euler(self) -> None:
        """Steps by backward Euler where a skin would give more energy than it stores."""
        self._use_euler()
        self.written = False

    def hold(self, acceleration: np.ndarray) -> None:
        """Lets what acts with accelerations (nv,) of MuJoCo's constraint solver act in place of the rows."""
        self.forced = self.acting_with(acceleration)

    def acting_with(self, acceleration: np.ndarray) -> np.ndarray:
        """(n, 6) that acts with accelerations (nv,) that MuJoCo's constraint solver has found, in this
        step."""
        if self.forced is not None:
            return self.forced
        moved = self.arrays.square[:, None] * (self.jacobian @ acceleration)
        rows = self.metric.excess(acceleration)
        rows -= (self.arrays.tangent0 @ moved[:, :, None])[:, :, 0]
        return self.correction + self.arrays.wrench + rows

    def conclude(self, rounds: int) -> None:
        """Tells the instances how the step went; what energy is left is known when it has ended."""
        for skin in self.skins:
            skin.conclude(rounds)

    def settle(self, moved: np.ndarray, near: float) -> None:
        """Settles the account of energy when MuJoCo's poses are those of now.

        Args:
          moved: (nv,) displacement of the degrees of freedom by their mean velocity in the step.
          near: [m] from where they were to go, by Runge-Kutta's stages.
        """
        travel = self.jacobian @ moved
        error = np.abs((travel - self.arrays.travel) * _SCALE)
        self.arrays.travel[:] = travel
        self._conclude()
        for skin in self.skins:
            outcome = skin.instance.outcome
            outcome.energy = skin.part("left_out").copy()
            if skin.instance.by_stages:  # whose status is written when the step ends
                outcome.settled &= bool(error[skin.bodies].max(initial=0.0) < near)

    def keep_poses(self) -> None:
        """Keeps where the bodies are when MuJoCo's poses are those at the end of the step."""
        pos, mat = self._kinematics.predict(0.0)
        for skin in self._all:
            skin.instance.ends = pos[skin.bodies], mat[skin.bodies]


def _keeping(tangent):
    """A function that gives the part of tangents (ngroup, 6, 6) that rows represent, see
    `rows.hold_by_rows`."""
    held, keep = _seen(tangent), row((keep_held, tangent.shape, [tangent]))

    def find(given):
        held[:] = given
        keep()
        return held.copy()

    return find


def _of_skin(kind, whole, part):
    """A struct with rows `part` of the arrays [body, world] of another, and its other fields."""
    one = kind()
    for name in kind.vars:
        value = getattr(whole, name)
        setattr(one, name, rows_of(value, part) if _is_of_bodies(value) else value)
    return one


def _is_of_bodies(value):
    return isinstance(value, wp.array) and value.ndim == 2


def _seen(array):
    """A view of the only world of an array [item, world]."""
    return array.numpy()[:, 0]
