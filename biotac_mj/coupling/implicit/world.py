"""All BioTacs of one mjData, stepped together: the implicit step that finds forces and motion at once.

A step of length h must satisfy p = x + (gamma - 1/2) h v + beta h^2 a(W(p)), with W the skin's wrench at the
pose p, a the accelerations with which MuJoCo's integrator then moves the bodies (`integrator`), and gamma and
beta Newmark's (`rules`; docs/design.md, "A step in time"). Newton's method finds p. In every round MuJoCo
gives the accelerations with the skins' linear models in force (`metric`). The skins are solved at the poses
that follow, while the bodies yield by the compliance of their inertia and of their other constraints
(`SkinGroup.find_compliance`). That gives new linear models. The first round has the models of the last step.
One round is enough, at impacts too, unless what else holds a body changes within it: a joint's friction
begins to slip, another skin lets go.

Where the rounds do not converge, the last models act. No skin gives back more energy than was put into it
(`_damp`, `_restrain`)."""

import functools

import mujoco
import numpy as np

from ...geometry.rigid_warp import LEVER
from ...threads import run_in_threads
from ..instance import NO_PASSIVE, NO_SENSOR, Instance
from ..loads import Loads
from ..solid_contacts import SOLVED, SolidContacts, contacts_of
from ..structs import MINVAL, DataView, ModelView
from .group import SkinGroup
from .integrator import Integrator
from .rules import MAX_CORRECTIONS, TOLERANCE, poorly_corrected

# of the skins' wrenches: how well the rows and the passive forces together must give the linear model
CORRECTED = 1e-6
# [m] largest distance between the pose at which a skin was solved and the one that Runge-Kutta's stages reach
ASTRAY = 1e-4
_SCALE = np.array([1.0, 1.0, 1.0, *[1 / LEVER] * 3])  # compares torques with forces
_RESETS = {
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name.upper()}")): name for name in ("qpos", "qvel", "qacc")
}


class World:
    """The instances of the plugin in one mjData.

    Attributes:
      tolerance: [m] how far bodies may go from where the skins were solved for them.
      begins, last: instances that MuJoCo computes first and last.
    """

    def __init__(self, model: ModelView, data: DataView, indices: list[int]):
        self.model, self.data, self.tolerance = model, data, TOLERANCE
        self.instances = {i: Instance(model, data, i) for i in indices}
        self.begins, self.last = min(indices), max(indices)
        self.coupled = [t for t in self.instances.values() if t.two_way]
        for t in self.coupled:
            t.skins_met = [
                (other, k)
                for other in self.coupled
                for k in np.flatnonzero(other.touching.body == t.touching.core).tolist()
            ]
        self.first = self.coupled[0].index if self.coupled else -1
        self._stage, self._began = 1, np.nan  # of Runge-Kutta's step
        self._acting, self._now = False, None  # whether bodies are under way, and from where
        self._weights = None  # of the rows, which one of Runge-Kutta's stages has taken
        self._held_trees = np.zeros(model.ntree, bool)  # see `_apply_first_stage`
        self._loads = None
        self._solids = {i: SolidContacts(model, one.touching) for i, one in self.instances.items()}
        # whether the integrator's accelerations differ from the constraint solver's in this step
        self._damped = None
        self.integrator = Integrator(
            model, {b for t in self.coupled for b in (t.touching.core, *t.touching.body)}
        )

    @functools.cached_property
    def _group(self):
        return SkinGroup(self.model, self.data, self.coupled)

    def passive(self, index: int) -> None:
        """Solves the skins: a one-way skin by itself, all two-way skins when MuJoCo computes their first. The
        wrenches on each are found when all are solved."""
        try:
            self._pass(self.instances[index])
        finally:
            if index == self.last:
                self._end_stage()
                self.sense()

    def _pass(self, instance):
        index = instance.index
        if index == self.begins:
            self._amend_contacts()
            self._stage = self._next_stage() if instance.by_stages else 1
        if self._stage == 1:
            try:
                self._solve(instance)
            except Exception as error:
                for other in self.instances.values():
                    other.refuse_foreign_state(error)
                raise
        elif index == self.first:
            self._apply_first_stage()

    def _end_stage(self):
        for instance in self.instances.values():
            if instance.by_stages:
                try:
                    instance.end_stage(self._stage == 1, self._held_trees & self._acting)
                except Exception:
                    self.failed(instance.index)
                    raise

    def _amend_contacts(self):
        amended = [one.amend(self.data) for one in self._solids.values()] if self.data.ncon else []
        if any(amended):
            self.data.make_constraints()

    def commit(self, index: int) -> None:
        """Ends the step of a skin."""
        if index == self.first:
            self._finish()
        self.instances[index].commit_step()

    def sense(self, asked: bool = False) -> None:
        """Writes the readings of all skins, which are solved. asked: MuJoCo asks for them; else where it has
        cleared them to do so later."""
        if self._stage > 1 or self.model.opt.disableflags & NO_SENSOR:
            return
        for instance in self.instances.values():
            if not instance.sensed and (asked or instance.is_cleared):
                try:
                    instance.sense()
                except Exception:
                    instance.failed()
                    raise

    def sense_forces(self) -> None:
        """Writes what the skins do to their bodies into MuJoCo's own force quantities, after its solver.

        Raises:
          ValueError: MuJoCo has not asked for the skins.
        """
        if self.model.opt.disableflags & NO_PASSIVE == NO_PASSIVE:
            raise ValueError(
                "the skin is a passive force, and the flags spring and damper are both disabled: "
                "enable one of them"
            )
        self.sense(asked=True)
        if not self.coupled:
            return
        if self._loads is None:
            self._loads = Loads(self.model, self.data, self.coupled, self._group.metric)
        acting = {t: t.acting_wrench() for t in self.coupled}
        if self._acting:
            found = self._group.acting_with(self.data.qacc)
            acting |= {one.instance: one.instance.seen(found[one.bodies]) for one in self._group.skins}
        self._loads.write(acting)

    def _next_stage(self):
        """Number of the Runge-Kutta stage that MuJoCo evaluates: two in the middle and one at the end of the
        step that the first begins."""
        now, step = self.data.struct.time, self.model.opt.timestep
        if self._stage < 4 and now == self._began + (step if self._stage == 3 else 0.5 * step):
            return self._stage + 1
        self._began = now
        return 1

    def _refuse_reset(self):
        """Raises ValueError where MuJoCo found numbers with which it does not go on, and began anew by
        itself."""
        now = self.data.struct
        for warning, name in _RESETS.items() if now.time == 0.0 else ():
            if now.warning[warning].number:
                raise ValueError(
                    f"NaN or a huge number in {name}, so MuJoCo has reset the simulation: check what was "
                    "written to it, or take a smaller timestep"
                )

    def _solve(self, instance):
        if instance.index == self.begins:
            self._refuse_reset()
        if not instance.two_way:
            instance.forget_last_solve()
            self._solve_one_way(instance)
        elif instance.index == self.first:
            for other in self.coupled:
                other.forget_last_solve()
            self._step()

    def _solve_one_way(self, instance):
        """Solves a skin that pushes nothing where MuJoCo takes the bodies: at their velocities, or where its
        core, nail or clamp stops one, at those of the step's end."""
        bodies, step, data = instance.kinematics, self.model.opt.timestep, self.data
        before = None
        if data.ncon and self._solids[instance.index].met_any:
            before = data.qvel.copy()
            data.set_velocity(before + step * data.acceleration())
        core = bodies.core_motion(step, 0.0, np.zeros(self.model.nv)) if instance.inertial else ()
        pose = bodies.predict(step)
        if before is not None:
            data.set_velocity(before)
        instance.solve_for_pose(*pose, core)

    def failed(self, index: int) -> None:
        """Discards solves that an exception interrupted: these skins have no result and exert no force."""
        instance = self.instances[index]
        for other in self.coupled if instance.two_way else [instance]:
            other.failed()

    def _take_rows(self):
        metric = self._group.metric
        if metric.switch_on(self.data):
            self.data.make_constraints()
        metric.find_rows(self.data)

    def _step(self):
        self._acting, self._weights = False, None
        self._now, self._began_with = self.data.qpos.copy(), self.data.qvel.copy()
        self._take_rows()
        outside = self.data.qfrc_passive.copy()
        with self.data.ahead(self.coupled[0].lead):
            self._group.begin()
        try:
            self._newton(self._group, outside)
            self._pushes = self.data.qfrc_passive - outside
        except BaseException:
            self.data.qfrc_passive[:] = outside
            self._group.metric.release()
            raise

    def _newton(self, group, outside):
        self._damped, skins = None, group.skins
        if not skins:
            self._group.metric.release()
            return
        group.springs.own[:] = self._group.metric.first
        if self.model.opt.timestep > 0 and self.model.nv > 0:
            rounds = self._find_balance(outside)
            rounds += self._damp(outside)
            self._restrain(outside)
            for skin in skins:
                skin.settled &= self._solved(skin)
            if self.data.is_dual:  # its iterations would leave the rows open: forces act in their place
                group.hold(self._found)
                self._forces(outside)
            group.find_frequencies()
            self._acting = True
            if skins[0].instance.by_stages:
                self._held_trees, self._ties = self._touched_trees(group), self._force_of_ties()
        else:
            rounds = 1
            group.evaluate(np.zeros(self.model.nv))
            self._solve_all({skin: skin.finish for skin in skins})
            self._forces(outside)
            group.evaluate(np.zeros(self.model.nv))
        group.conclude(rounds)

    def _touched_trees(self, group):
        """(ntree,) kinematic trees that skins touch, or core, nail and clamp, and those that constraints link
        to them."""
        tree, trees = self.model.dof_treeid, np.zeros(self.model.ntree, bool)
        trees[tree[group.jacobian[group.touching].any(axis=(0, 1))]] = True
        contacts = contacts_of(self.data)
        pairs = contacts["geom"][contacts["efc_address"] >= 0]
        bodies = self.model.geom_bodyid[pairs[(pairs >= 0).all(axis=1)]]  # -1: a flex
        solid = np.isin(bodies, [skin.instance.touching.core for skin in group.skins]).any(axis=1)
        touched = self.model.body_treeid[bodies[solid]]
        trees[touched[touched >= 0]] = True
        return self.data.linked_trees(trees)

    def _force_of_ties(self):
        """(nv,) generalised forces of equality constraints, as the last solve left them."""
        force = self.data.rows().efc_force.copy()
        force[self.data.ne :] = 0.0
        force[self._group.metric.numbers] = 0.0
        return self.data.pushed_by(force)

    def _apply_first_stage(self):
        """Lets the forces of the skins, and of MuJoCo's contacts, limits and friction on trees that they
        touch, that the first of Runge-Kutta's stages found act in this one: all were found for the whole
        step, and do not hold where a stage has the bodies. All other forces are those of the stage: equality
        constraints turn with what they hold, and answer to the others."""
        data = self.data
        self._take_rows()
        self._group.metric.release()
        self._now = data.qpos.copy()
        if self._acting:
            if self._stage == 2:
                held = self._held_trees[self.model.dof_treeid]
                self._held = np.where(held, data.qfrc_constraint - self._ties, 0.0)
            data.qfrc_passive += self._pushes + self._held
            self._weights = data.rows().efc_D.copy()
            held = data.trees_of_rows()[:, self._held_trees].any(axis=1)
            held[: data.ne] = False
            data.weigh_constraints(np.where(held, MINVAL, self._weights))

    def _leave_constraint_forces(self):
        """Leaves in mjData the constraint forces of the last of Runge-Kutta's stages, as MuJoCo does."""
        self.data.weigh_constraints(self._weights)
        self.data.qfrc_passive -= self._held
        self.data.acceleration(again=True)
        self._weights = None

    def _finish(self):
        """After the step: gives the skins the poses that their bodies have reached. These differ from where
        each skin was solved: joints move in arcs, and other forces may have been predicted badly."""
        before, self._now = self._now, None
        if before is None:  # MuJoCo has not called the skins
            return
        acting, self._acting = self._acting, False
        if self._weights is not None:
            self._leave_constraint_forces()
        moved = 0.5 * self.model.opt.timestep * (self._began_with + self.data.qvel)
        after = self.data.qpos.copy()
        self.data.integrate_positions(self.coupled[0].lead)
        self.data.find_poses()
        if acting:
            self._group.settle(moved, ASTRAY)
        self._group.keep_poses()
        self.data.qpos[:] = before
        self.data.find_poses()  # those that MuJoCo leaves after a step
        self.data.qpos[:] = after

    def _solved(self, skin):
        """Whether a skin's rows push what its model says, and MuJoCo's constraint solver found what holds its
        bodies."""
        rows = np.abs(_SCALE * self._group.excess[skin.bodies]).max(initial=0.0)
        if rows > SOLVED * np.abs(_SCALE * skin.part("acting")).max(initial=0.0):
            return False
        return self.data.unsolved(self._found, skin.instance.dofs) < SOLVED

    def _find_balance(self, outside):
        """Finds models of the skins that hold where these lead; returns how many rounds that took.

        Their forces are left in place.
        """
        skins = self._group.skins
        most = max(skin.instance.setup.config.rounds for skin in skins)
        for rounds in range(most + 1):
            self._predict(outside)
            going = [skin for skin in skins if skin.off >= self.tolerance and skin.may_act]
            if rounds == most or not going:
                break
            self._group.find_compliance(going, self._inertia)
            self._solve_all({skin: skin.solve for skin in going})
        for skin in skins:
            skin.settled = skin.off < self.tolerance
        return rounds

    def _solve_all(self, solves):
        """Calls what solves each skin; those that have been solved before side by side: the first time
        kernels are made."""
        threads, shared = max(s.instance.setup.config.threads for s in solves), {}
        for skin, solve in solves.items():
            shared.setdefault(skin.instance.setup.skin, []).append(solve)
        for one in [one for one in shared if not one.solved]:
            run_in_threads(shared.pop(one), 1)
            one.solved = True
        run_in_threads([functools.partial(run_in_threads, mine, 1) for mine in shared.values()], threads)
        self._group.use_models()

    def _predict(self, outside):
        """Finds where MuJoCo will move the bodies under the skins' linear models, and how far that is from
        where the skins were solved; leaves the forces that do this in place.

        The rows answer to the constraint solver's accelerations a, the skins to the integrator's a': h^2 S J
        (a - a') corrects it."""
        self._found, moved = self._corrected(outside)
        self._group.excess[:] = self._group.metric.excess(self._found)
        self._group.evaluate(moved)

    def _damp(self, outside):
        """Makes the step that of backward Euler for skins that would give more energy than they have; returns
        how many rounds that took."""
        group = self._group
        if not group.find_energy():
            return 0
        group.use_euler()
        group.find_compliance(group.skins, self._inertia)
        rounds = self._find_balance(outside)
        group.find_energy()
        return rounds

    def _restrain(self, outside):
        """Withholds so much of the push on bodies that they get no more energy than they have put in.

        An accepted step may be wrong (friction's tangent is not exact, a solve may end on its way), and
        nothing a wrong one does may feed on itself.
        """
        group = self._group
        while group.restrain():
            group.use_models()
            self._predict(outside)
        for skin in group.skins:  # unless it does not act on a body
            skin.settled &= bool(skin.part("push")[~skin.part("wrench0").any(axis=1)].all())

    def _corrected(self, outside):
        """Accelerations a and a'."""
        self._forces(outside)
        found = self.data.acceleration(again=self._damped is not None, primal=True)
        if self._damped is None:  # known only after the actuation stage
            self._damped = self.integrator.take_matrices(self.data)
            self._inertia = self.integrator.inertia if self._damped else None
        if not self._damped and not self.integrator.by_forces:
            return found, found
        group = self._group
        touching = group.touching
        group.amiss[:] = 0.0
        if not len(touching):
            return found, self.integrator.accelerations(self.data, found)
        jacobian, held = group.held(touching)
        correction = group.correction[touching].ravel()
        largest = np.abs(_SCALE * group.arrays.wrench0).max(initial=0.0)
        for last in range(MAX_CORRECTIONS, -1, -1):
            excess = held @ (found - self.integrator.integrated(found))
            wrong = excess - correction
            sizes = (np.abs(_SCALE * w.reshape(-1, 6)).max() for w in (wrong, excess))
            if not (poorly_corrected(*sizes, largest, CORRECTED) and last):
                moved = self.integrator.accelerations(self.data, found)
                group.amiss[touching] = (correction - held @ (found - moved)).reshape(-1, 6)
                return found, moved
            # what the constraint solver would find if the rows answered to the integrator
            known = group.springs, jacobian.T @ held, correction @ jacobian
            found = self.integrator.answer(found, *known)
            correction = held @ (found - self.integrator.integrated(found))
            group.correction[touching] = correction.reshape(-1, 6)
            self._forces(outside)
            found = self.data.acceleration(again=True, primal=True)

    def _forces(self, outside):
        self.data.qfrc_passive[:] = outside
        self.data.qfrc_passive += self._group.apply()
        if self.data.is_dual:  # it works on what the rows were before
            self.data.project_constraints()
