"""All two-way skins of an mjData in a step: their linear models, where their bodies go under these, and the
energy that the skins can give. The bodies of one skin follow those of another in each array."""

from collections.abc import Sequence

import mujoco
import numpy as np

from ...geometry.rigid_warp import LEVER
from ..instance import Instance
from ..setup import LINEAR, MODEL, STARTED
from ..solid_contacts import contacts_of
from ..structs import DataView, ModelView
from .coupled import Coupled
from .kinematics import Kinematics
from .metric import Metric
from .springs import Springs
from .step_arrays import StepArrays

_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)  # the first type of a contact's row
_SCALE = np.array([1.0] * 3 + [LEVER] * 3)  # compares turning with going


class SkinGroup:
    """The two-way skins of an mjData.

    Attributes:
      skins: `Coupled` that take part in this step: not those that rest with nothing in reach.
      arrays: `StepArrays`, where the step stands. springs: `Springs`. metric: `Metric`.
      jacobian: (n, 6, nv) of the bodies relative to their BioTacs.
      correction: (n, 6) of what the integrator's accelerations differ in from the constraint solver's.
      amiss: (n, 6) what that still lacks: it acts on the bodies too.
      excess: (n, 6) what the rows push beyond their stiffness where MuJoCo's solver did not converge: it acts
        too.
      forced: wrenches (n, 6) that act in place of models and rows, or None. withdrawn: nothing acts.
    """

    def __init__(self, model: ModelView, data: DataView, instances: Sequence[Instance]):
        self._model, self._data, self._instances = model, data, instances
        meets = ((t.touching.core, body) for t in instances for body in t.touching.body)
        self._meets = np.array(list(meets), int).reshape(-1, 2)
        touchings, slots = [t.touching for t in instances], [t.slots for t in instances]
        self._kinematics = Kinematics(model, data, touchings)
        self.springs = Springs(model, data, list(map(len, slots)))
        self.arrays = arrays = StepArrays(self._kinematics, [t.setup for t in instances], self.springs)
        self.metric = Metric(model, touchings, slots, arrays.stiffness)
        both = zip(instances, self._kinematics.parts)
        self._all = [Coupled(t, data, arrays, k, bodies) for k, (t, bodies) in enumerate(both)]
        for k, t in enumerate(instances):
            t.keep_held = lambda tangent, k=k: arrays.held(k, tangent)

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
        self.forced, self.withdrawn, self.written = None, False, False
        arrays.record(step, 0.5 * first.by_stages)
        for name in MODEL.names:
            getattr(arrays, name)[:] = models[name]
        for name in LINEAR:
            arrays.last[name][:] = models[name]
        for skin in self._all:
            if skin not in self.skins:
                skin.part("wrench0")[:] = 0.0
        arrays.began[:] = [head[STARTED] != 0.0 for head in heads]
        arrays.begin()
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
        return np.flatnonzero(self.arrays.tangent0.any(axis=(1, 2)) & (not self.withdrawn))

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
        self.arrays.evaluate()
        self.arrays.lifted[:] = self._find_lift()
        if self.withdrawn:
            self.arrays.acting[:] = 0.0
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
            self.arrays.find_compliance[skin.number]()

    def find_frequencies(self) -> None:
        """Finds the frequencies at which the bodies bounce on all skins, as inertia and MuJoCo's other
        constraints let them."""
        self.springs.take(None)
        self.springs.factor(None)
        self.springs.held[:] = 0.0
        self.arrays.find_frequencies()

    def apply(self) -> np.ndarray:
        """Puts the models into MuJoCo's rows; returns the passive forces (nv,) that act besides."""
        if self.forced is not None:
            self.metric.release()
            return self.forced.ravel() @ self._rows
        if not self.written:
            self.metric.write(self.touching)
            self.written = True
        self.arrays.find_wrenches()
        return (self.correction + self.arrays.wrench).ravel() @ self._rows

    def use_euler(self) -> None:
        """Makes the step of the bodies of greedy skins that of backward Euler."""
        self.arrays.use_euler()
        self.written = False

    def withdraw(self) -> None:
        """Lets nothing act in this step; the models stay as the next one's first."""
        self.forced, self.withdrawn, self.arrays.push[:] = np.zeros_like(self.correction), True, 0.0
        for skin in self.skins:
            skin.settled = False

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
        converged = np.zeros(len(self._all), bool)
        converged[[skin.number for skin in self.skins]] = [skin.result.converged for skin in self.skins]
        self.arrays.conclude(converged)
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
