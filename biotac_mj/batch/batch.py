"""The skins of a batch inside `mujoco_warp.step`: launches only, so that the step can be captured in a CUDA
graph.

Once per step, when mujoco_warp asks for passive forces, and as in `coupling/implicit/world.py` for one world:
1. The linear models of the last step enter the dynamics, and mujoco_warp's own later stages predict where
   the bodies go.
2. The skins are solved, while their bodies give way from there as their inertia lets them.
3. Their new linear models take the old ones' place. Where that moved a body mujoco_warp predicts again, and
   the skins of worlds in which something else held it are solved again.
4. Push is withheld where the skins would give more energy than was put into them, and mujoco_warp goes on.
The readings are written when mujoco_warp asks for the velocity sensors. contact_force, which is what acts
in the step, is written again when it asks for acceleration sensors, after its constraint solver."""

import functools
import math
import typing

import mujoco
import numpy as np
import warp as wp

from ..coupling.implicit.rules import LOSS_FREQUENCY
from ..coupling.loads import core_geom
from ..coupling.solid_contacts import SolidPairs
from ..coupling.structs import ModelView
from ..coupling.touching import Touching
from ..skin.program import Fork
from . import kernels, solid
from .ahead import kernels_of_step
from .implicit import dynamics, energy, integrator, rounds
from .implicit.compliance import Response
from .implicit.ends import Ends
from .implicit.integrator import Integrator
from .marks import Marks
from .memory import Scratch
from .release import Clearance
from .senses import Senses
from .skin import BatchSkin, solve_group
from .skins import Skins
from .solid_contacts import SolidContacts

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw


__all__ = ["Batch", "Hook"]


class Batch(Skins):
    """One BioTac in every world of a mujoco_warp Data; made by `biotac_mj.batch.attach`.

    Attributes besides those of `Skins`:
      active: False leaves the skins out of `mjw.step` and `mjw.forward`: nothing is solved, nothing acts.
      ngeom: number of geoms that can touch.
    """

    def __init__(
        self,
        mjm: mujoco.MjModel,
        touching: Touching,
        slots: dict,
        skin: BatchSkin,
        senses: Senses | None,
        addresses: list,
        thickness: float | None,
        limit: int,
        loss: float,
    ):
        super().__init__(touching, skin, senses, mjm.opt.timestep, addresses)
        self.active, self.skins_met, self._skins = True, [], touching.skins
        self._two_way = thickness is not None
        self.moving = self._two_way and skin.ngroup > 0  # whether forces change where anything goes
        weld = sorted(set(slots.values()))
        group_slot = [weld.index(slots[g]) if g in slots else -1 for g in range(skin.ngroup)]
        with wp.ScopedDevice(self.device):
            self._slot = wp.array(np.array(weld, np.int32), dtype=int)
            self._group_slot = wp.array(np.array(group_slot, np.int32), dtype=int)
            self._row = wp.full((len(weld), self.nworld), -1, dtype=int)
            self._jacobian = wp.zeros((*self.groups, mjm.nv), dtype=wp.spatial_vectord)
            self._wrench = wp.zeros(self.groups, dtype=wp.spatial_vectord)
            self._acting = wp.zeros(self.groups, dtype=wp.spatial_vectord)
            self._on_solid = wp.zeros(self.nworld, dtype=wp.spatial_vectord)
            kinds = (wp.vec3d, wp.vec3d, wp.float64, wp.spatial_vectord)
            self._touches = [wp.zeros((len(touching.geom), self.nworld), dtype=kind) for kind in kinds]
            self._of_step = r = rounds.Rounds()
            r.limit = limit
            for name in ("here", "start", "", "asked", "free", "end"):
                for part, dtype in (("pos", wp.vec3d), ("mat", wp.mat33d)):
                    setattr(r, f"{name}_{part}" if name else part, wp.zeros(self.groups, dtype=dtype))
            for name in ("straight", "travel", "drift", "moved", "full_wrench", "full_motion"):
                setattr(r, name, wp.zeros(self.groups, dtype=wp.spatial_vectord))
            for name in ("trial", "placed", "inside", "open", "passed"):
                setattr(r, name, wp.zeros(self.nworld, dtype=int))
            for name in ("gamma", "horizon", "square", "frequency", "left", "store", "most", "without"):
                setattr(r, name, wp.zeros(self.nworld, dtype=wp.float64))
            self._step = wp.full(self.nworld, self.dt, dtype=wp.float64)
            self._power = wp.zeros((self.nworld, 6 * skin.ngroup), dtype=wp.vec2d)
            self._greedy = wp.zeros(self.nworld, dtype=int)
        view = ModelView(mjm._address)
        self._core_geom, self.ngeom = core_geom(view, touching.core), len(touching.geom)
        pairs = SolidPairs(view, touching)
        self.solid_contacts = SolidContacts(pairs, self.nworld, self.device)
        self._delay = loss / (2 * math.pi * LOSS_FREQUENCY * self.dt)
        self._clearance = Clearance(skin.model, self.nworld)
        self._qacc = None  # with which the bodies go
        self._response = None
        r.settled, r.rounds, r.push, r.began = self._settled, self._rounds, self._push, self.began
        r.surface = skin.data.laws.struct.work
        if self.moving:
            skin.prepare_keep()
        self._solid = rounds.Solid()
        self._solid.thickness, self._solid.inertial = thickness or 0.0, int(skin.inertial)
        self._solid.area = float(skin.model.outer.area.numpy().sum())

    def lasting(self) -> tuple[list[wp.array], list[wp.array]]:
        last, first = super().lasting()
        r = self._of_step
        return [*last, r.end_pos, r.end_mat, r.left, r.frequency, r.open, r.passed], first

    def predict(self, m: "mjw.Model", d: "mjw.Data", taking_part: Marks) -> None:
        """Begins a step: where the bodies are and where they go without acceleration, and their Jacobians;
        marks the worlds whose skin takes part; finds this step's rows."""
        r = self._of_step
        bodies = [self._core, self._body, d.xpos, d.xmat]
        self._launch(kernels.relative_poses, self.groups, bodies, [r.here_pos, r.here_mat])
        where, start = [d.xpos, d.xmat, d.subtree_com], [r.start_pos, r.start_mat]
        self._advance(m, d, self._step)
        turning = [self._core, self._body, m.body_rootid, m.body_isdofancestor, *where, d.cdof, *start]
        self._launch(dynamics.relative_jacobians, self._jacobian.shape, turning, [self._jacobian])
        self.begin_step(r.start_pos, r.start_mat, m.geom_pos, m.geom_quat, taking_part)
        if self.moving:
            inertial = int(self.skin.inertial)
            by = [self.dt, self._delay, inertial, self.model]
            self._launch(rounds.choose_gamma, self.nworld, by, [r])
            self._find_drift(m, d)
            self._correction_force.zero_()
            r.amiss.zero_()
            self._launch(rounds.begin_rounds, self.nworld, [self.rest.awake], [r])
            self._look_inside(m)
            self._launch(
                dynamics.find_rows, self._row.shape, [self._slot, d.ne, d.efc.type, d.efc.id], [self._row]
            )

    def _advance(self, m, d, horizon):
        """Finds where the bodies go in a horizon (nworld,) [s] without acceleration."""
        r = self._of_step
        going = [self._core, self._body, horizon, m.body_rootid, d.xpos, d.xmat, d.subtree_com, d.cvel]
        self._launch(dynamics.advance_groups, self.groups, going, [r.start_pos, r.start_mat])

    def _find_drift(self, m, d):
        """Finds where they go so to where the skins are solved, of the worlds' gamma."""
        r = self._of_step
        self._advance(m, d, r.horizon)
        known = [self.dt, r.horizon, self._jacobian, d.qvel]
        self._launch(dynamics.find_drift, self.groups, known, [r.straight, r.drift])

    def use_euler(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Makes greedy worlds' step that of backward Euler, after `restrain`. Launches only."""
        self._launch(rounds.use_euler, self.nworld, [self.dt, self._greedy], [self._of_step])
        self._find_drift(m, d)

    def add_forces(self, d: "mjw.Data") -> None:
        """Adds the linear models to the forces, after `act`."""
        wrenches = [self._wrench, self._correction_force]
        self._launch(dynamics.add_forces, d.qfrc_passive.shape, [self._jacobian, *wrenches], [d.qfrc_passive])

    def act(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Finds the linear models' forces, and puts the rest of them into the rows."""
        self._find_wrenches()
        efc = d.efc
        self._launch(
            dynamics.write_rows,
            (*self._row.shape, self._jacobian.shape[2]),
            [self._of_step.square, self._group_slot, self._row, self._jacobian, self.model.tangent0]
            + [int(m.is_sparse), efc.J_rownnz, efc.J_rowadr, efc.J_colind],
            [efc.J, efc.D, efc.aref, efc.pos],
        )

    @property
    def nslot(self) -> int:
        """How many slots of six rows it has."""
        return len(self._slot)

    def take_part(
        self, m: "mjw.Model", correction: integrator.Correction, first: int, rows: wp.array, first_row: int
    ) -> None:
        """Has its own groups in a correction of all skins, from number `first` on, and its own of the rows of
        all."""
        self._all_rows, self._row = rows, rows[first_row : first_row + self.nslot]
        self._response = Response(m, self.skin.ngroup, self.nworld)
        self._driven = wp.empty_like(self._response.response)
        own = slice(first, first + self.groups[0])
        self._correction, self._first_group = correction, first
        self._correction_force, self._of_step.amiss = correction.force[own], correction.amiss[own]

    def find_amiss(self, d: "mjw.Data", qacc: wp.array) -> None:
        """Finds what the correction lacks for accelerations qacc (nworld, nv) of the integrator; what does
        not act lacks nothing."""
        if self.active:
            found = [self._first_group, self._of_step.square, self._jacobian, d.qacc, qacc, self.model]
            self._launch(integrator.find_amiss, self.nworld, found, [self._correction])
        else:
            own = [self._first_group, self.groups[0]]
            self._launch(integrator.leave_out, self.nworld, own, [self._correction])

    def respond(self, factors: list[wp.array]) -> None:
        """Finds accelerations by unit wrenches on the bodies; factors: see `integrator.respond`."""
        known = [self._first_group, self._jacobian, *factors]
        self._launch(integrator.respond, (self.nworld, 6 * self.groups[0]), known, [self._correction])

    def write_slope(self, columns: int) -> None:
        """Writes this skin's rows of the correction's slope."""
        known = [self._first_group, self._of_step.square, self._jacobian, self.model, int(self.active)]
        dim = self.nworld, self.groups[0], columns
        self._launch(integrator.write_slope, dim, known, [self._correction])

    def evaluate(self, qacc: wp.array) -> None:
        """Finds where the bodies go with accelerations (nworld, nv), and where the skins are solved."""
        r, self._qacc = self._of_step, qacc
        going = [self.dt, r.square, self._jacobian, qacc, r.here_pos, r.start_pos, r.start_mat]
        found = [r.moved, r.travel, r.pos, r.mat]
        self._launch(dynamics.follow, self.groups, [*going, r.straight, r.drift], found)

    def _look_inside(self, m):
        """Whether bodies that were put somewhere were put into the skin."""
        r, skin, clearance = self._of_step, self.skin, self._clearance
        laws, geoms = skin.data.laws.struct, skin.geoms.struct
        self.place_geoms(r.here_pos, r.here_mat, m.geom_pos, m.geom_quat)
        clearance.found.fill_(wp.vec2d(math.inf, math.inf))
        wp.copy(clearance.close, r.placed)
        clearance.measure(geoms, laws, skin.data.rest_vert)
        self._launch(rounds.look_inside, self.nworld, [laws, clearance.found], [r])

    def find_compliance(self, m: "mjw.Model", d: "mjw.Data", going: wp.array, inertia: wp.array) -> None:
        """Finds how the bodies give way in worlds that are going (nworld,), after mujoco_warp's constraint
        solver; inertia: see `Integrator`. Launches only."""
        self._response.find(m, d, going, inertia, self._row, self._jacobian)
        self._response.write(going, self._jacobian, self._of_step.square, self.skin.bodies.compliance)
        self._response.find(m, d, going, d.M, self._all_rows, self._jacobian)

    def begin_solve(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Begins to solve the wanted skins where the bodies go; those that move no bodies it solves, where
        these go without acceleration."""
        r, skin = self._of_step, self.skin
        if skin.inertial:
            data = skin.data
            arrays = [
                m.body_rootid,
                m.body_isdofancestor,
                d.xpos,
                d.xmat,
                d.subtree_com,
                d.cvel,
                d.cdof,
                self._qacc if self.moving else d.qacc,
            ]
            self._launch(
                dynamics.advance_core,
                self.nworld,
                [self._core, self.dt, int(self.moving), *arrays],
                [skin.core_pos, skin.core_mat, data.frame_pos, data.frame_mat],
            )
        on_bodies = m.geom_pos, m.geom_quat
        if not self.moving:
            self.solve_at(r.start_pos, r.start_mat, *on_bodies)
            return
        wanted, bodies = skin.data.worlds.wanted, skin.bodies
        inputs = [wanted, skin.fraction, self.model, self._wrench]
        self._launch(rounds.tell_bodies, self.groups, inputs, [bodies, r])
        self._launch(rounds.uncoupled_poses, self.groups, [wanted, bodies], [r])
        self.place_geoms(r.free_pos, r.free_mat, *on_bodies)
        skin.release.begin()
        self._launch(rounds.ask, self.groups, [wanted, skin.release.gone], [r])
        self.place_geoms(r.asked_pos, r.asked_mat, *on_bodies)
        skin.begin_solve()

    def accept_models(self) -> None:
        """After `BatchSkin.end_solve`: takes the models of the skins."""
        self.accept(self._of_step.asked_pos, self._of_step.asked_mat)

    def solve_one_way(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Solves the skins that take part where the bodies go without acceleration."""

        def solve():
            self.keep_models()
            self.begin_solve(m, d)

        wp.capture_if(self.rest.any, solve)

    def solve_first(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """The first round. Launches only."""
        self.keep_models()
        self.skin.keep()
        self.begin_solve(m, d)

    def compare(self, going: Marks) -> None:
        """After it; marks worlds whose bodies may go elsewhere under its new model."""
        self._launch(rounds.look, self.nworld, [self.rest.awake, self.model], [self._of_step, going.struct])

    def judge(self, going: Marks, still_going: Marks) -> None:
        """After `evaluate`: marks those of the worlds that are going whose skin is to be solved again."""
        st = self.skin.data.worlds
        known, changed = [going.world, st.reason, self.model], [self._of_step, st.wanted, still_going.struct]
        self._launch(rounds.judge, self.nworld, known, changed)

    def solve_again(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Another round of the worlds that want one. Launches only."""
        self.skin.put_back()
        self.begin_solve(m, d)

    def find_energy(self, taking_part: Marks, damped: Marks) -> None:
        """Finds the energy of skins in worlds that take part, after `evaluate`; marks those in which a step
        of more damping is to be tried."""
        out = [self._greedy, damped.struct]
        self._settle(energy.find_energy, taking_part, [self._last], [self._solid], out)

    def restrain(self, taking_part: Marks, going: Marks) -> None:
        """Takes the push of skins that have not the energy for it, after `find_energy`, and marks their
        worlds."""
        self._settle(energy.restrain, taking_part, outputs=[going.struct])

    def scale_push(self) -> None:
        """Gives those as much push as they have energy for, after `evaluate` without any."""
        self._settle(energy.scale_push)

    def withhold(self, going: Marks, still_going: Marks) -> None:
        """Takes it again where it still is too much, as `restrain`."""
        self._settle(energy.withhold, going, outputs=[still_going.struct])

    def find_gain(self, taking_part: Marks, gains: Marks) -> None:
        """Marks worlds where withholding all does not help, after `evaluate`."""
        self._settle(energy.find_gain, taking_part, outputs=[gains.struct])

    def withdraw(self, d: "mjw.Data", gains: wp.array) -> None:
        """Lets the skins of those worlds not act in this step."""
        changed = [self.model, self._of_step, self._correction_force, d.qacc_warmstart]
        self._launch(energy.withdraw, self.nworld, [gains], changed)

    def add_stiffness(self, stiffness: wp.array) -> None:
        """Adds the skin's to that of all (nworld, nv, nv)."""
        dim = stiffness.shape[:2]
        self._launch(energy.add_stiffness, dim, [self._jacobian, self.model], [stiffness])

    def conclude(self, taking_part: Marks, stiffness: wp.array) -> None:
        """Settles the account of energy, after `evaluate`; stiffness: of all skins."""
        found, driven = self._response, self._driven
        self._launch(energy.drive, self._power.shape, [stiffness, found.L, found.response], [driven])
        known = [stiffness, found.response, driven, self.model]
        self._launch(energy.add_powers, self._power.shape, known, [self._power])
        self._settle(energy.conclude, taking_part, how=[self.skin.reason, self._power])

    def finish(self, end: "mjw.Data") -> None:
        """Takes where bodies are after the step: what the next one finds elsewhere was moved by others."""
        ends = [self._of_step.end_pos, self._of_step.end_mat]
        bodies = [self._core, self._body, end.xpos, end.xmat]
        self._launch(kernels.relative_poses, self.groups, bodies, ends)

    def find_acting(self, d: "mjw.Data") -> None:
        """Finds what acts on the bodies in the step, after mujoco_warp's constraint solver."""
        if self.moving:
            forces = [self._wrench, self._correction_force, self.model.tangent0]
            known = [self._of_step.square, self._jacobian, d.qacc, *forces, self.skin.reason]
            self._launch(dynamics.acting_wrenches, self.groups, known, [self._acting])

    def report_force(self, m: "mjw.Model", d: "mjw.Data", contact_force: wp.array) -> None:
        """Writes what acts on the BioTac in the step, on its skin and on core, nail and clamp, when each has
        found what acts. Launches only.

        Args:
          contact_force: (naconmax,) force and torque of d's contacts in the world's frame.
        """
        acting = self._acting if self.moving else self.model.wrench0
        c = d.contact
        contacts = [d.nacon, c.geom, c.worldid, c.efc_address, c.pos, contact_force, d.xpos, d.xmat]
        self._on_solid.zero_()
        self._launch(
            solid.sum_contacts,
            contact_force.shape,
            [self._core, m.geom_bodyid, *contacts],
            [self._on_solid],
        )
        for other, group in self.skins_met:
            met = [self._core, other._core, group, other._acting, d.xpos, d.xmat]
            self._launch(solid.add_push, self.nworld, met, [self._on_solid])
        known = [self._addresses, acting, self._on_solid]
        self._launch(kernels.write_force, (self.nworld, 6), known, [d.sensordata])

    def apply_wrenches(self, d: "mjw.Data") -> None:
        """Adds what acts on bodies and core to xfrc_applied, and takes it from its rows."""
        from . import loads  # here, as mujoco_warp is: `make` does without

        where = [self._core, self._body, self._acting, d.xpos, d.xmat, d.xipos]
        self._launch(loads.apply_wrenches, self.nworld, where, [d.xfrc_applied])
        self._launch(loads.clear_rows, self._row.shape, [self._row], [d.efc.force])

    def find_touches(self) -> None:
        """Parts what acts among the geoms."""
        from . import loads

        skin, outer, model = self.skin, self.skin.data.outer, self.skin.model
        samples = [len(model.sample), model.outer.face, self._group, outer.kept, outer.anchor_geom]
        samples += [outer.sample_force, skin.x, self._acting]
        self._launch(loads.find_touches, self.groups, samples, [*self._touches])

    def add_touch(self, m: "mjw.Model", d: "mjw.Data", sensor: wp.array) -> None:
        """Adds its touches to the touch sensors of these numbers."""
        from . import loads

        sensors = [sensor, m.sensor_objid, m.sensor_adr, m.sensor_cutoff]
        sensors += [m.body_weldid, m.body_rootid, m.geom_bodyid, m.site_bodyid]
        sites = [m.site_type, m.site_size, d.site_xpos, d.site_xmat, d.xpos, d.xmat]
        pos, normal, _, wrench = self._touches
        known = [self._core, self._geom, *sensors, *sites, pos, normal, wrench]
        self._launch(loads.add_touch, (len(sensor), self.nworld), known, [d.sensordata])

    def list_touches(self, m: "mjw.Model", d: "mjw.Data", row: int, listed: list) -> None:
        """Adds its touches to the contacts, with rows from `row` on."""
        from mujoco_warp import ConeType

        from . import loads

        pos, normal, _, wrench = self._touches
        pyramidal = m.opt.cone == ConeType.PYRAMIDAL
        known = [self._core, self._core_geom, self._geom, pyramidal, row, d.xpos, d.xmat, pos, normal, wrench]
        self._launch(loads.list_touches, (self.ngeom, self.nworld), known, listed)

    def meet(self, others: list["Batch"]) -> None:
        """Shares what skins do to each other between two that both move bodies."""
        both = [other for other in others if self._two_way]
        self.skins_met = [
            (other, k) for other in both for k in other._skins if other._body.numpy()[k] == self._core
        ]
        bodies, cores = self._body.numpy(), {other._core for other, _ in self.skins_met}
        fraction = np.ones(len(bodies))
        fraction[[k for k in self._skins if bodies[k] in cores]] = 0.5
        self.skin.fraction.assign(fraction)

    def pass_by(self, taking_part: Marks) -> None:
        """Ends a step of the worlds in which no skin takes part."""
        known = [taking_part.world, self._solid.area]
        self._launch(energy.pass_by, self.nworld, known, [self._of_step])

    def _settle(self, kernel, worlds=None, last=(), how=(), outputs=()):
        self._find_wrenches()
        inputs = [*([worlds.world] if worlds else []), self.model, *last, self._wrench, *how]
        self._launch(kernel, self.nworld, inputs, [self._of_step, *outputs])

    def _find_wrenches(self):
        self._launch(rounds.wrenches, self.groups, [self.model, self._of_step], [self._wrench])


class Hook:
    """What a mujoco_warp Model calls: all batches of the Model step together, after callbacks that were there
    before."""

    def __init__(self, m: "mjw.Model"):
        self.batches = []
        self._passive, self._sensor = m.callback.passive, m.callback.sensor
        self._contactfilter = m.callback.contactfilter
        self._contact_force = None
        self._corrected = []  # whose forces are corrected together
        self._fork = Fork(m.qpos0.device)
        self._taking_part = self._going = self._next = None  # `Marks` of worlds: in the step, in a round
        m.callback.passive, m.callback.sensor = self.passive, self.sensor
        m.callback.contactfilter = self.contactfilter

    @classmethod
    def of(cls, m: "mjw.Model") -> "Hook":
        """The Model's hook, made when first asked for."""
        return m.callback.passive.__self__ if cls.is_of(m) else cls(m)

    @classmethod
    def is_of(cls, m: "mjw.Model") -> bool:
        """Whether the Model has one."""
        return isinstance(getattr(m.callback.passive, "__self__", None), cls)

    def add(self, batch: Batch, d: "mjw.Data") -> None:
        if any(there._core == batch._core for there in self.batches):
            raise ValueError("this BioTac is attached to the mujoco_warp Model already: attach it once")
        self.batches.append(batch)
        for one in self.batches:
            one.meet([other for other in self.batches if other.moving])
        if self._contact_force is None or len(self._contact_force) < d.naconmax:
            self._contact = wp.array(np.arange(d.naconmax, dtype=np.int32), device=d.qpos.device)
            self._contact_force = wp.zeros(d.naconmax, dtype=wp.spatial_vector, device=d.qpos.device)
        with wp.ScopedDevice(d.qpos.device):
            self._taking_part, self._going, self._next = (Marks(d.nworld) for _ in range(3))

    def kernels(self, mjm: mujoco.MjModel, m: "mjw.Model") -> list[tuple[wp.Module, int]]:
        """Of a step of the Model with its batches, see `ahead.kernels_of_step`; no other callback is
        called."""
        before = self._passive, self._sensor, self._contactfilter
        self._passive = self._sensor = self._contactfilter = None
        own = type(m.callback)()
        own.passive, own.sensor, own.contactfilter = self.passive, self.sensor, self.contactfilter
        try:
            return kernels_of_step(mjm, m, own)
        finally:
            self._passive, self._sensor, self._contactfilter = before
            self._corrected = []  # the memory was for another Data

    def contactfilter(self, m: "mjw.Model", d: "mjw.Data") -> None:
        if self._contactfilter:
            self._contactfilter(m, d)
        for batch in self.batches:
            if batch.active:
                batch.solid_contacts.amend(m, d)

    def passive(self, m: "mjw.Model", d: "mjw.Data") -> None:
        if self._passive:
            self._passive(m, d)
        if self._corrected != [b for b in self.batches if b.moving]:
            self._take_memory(m, d)
        batches = [b for b in self.batches if b.active]
        self._taking_part.clear()
        self._fork.run(*(functools.partial(batch.predict, m, d, self._taking_part) for batch in batches))
        moving = [b for b in batches if b.moving]
        for batch in batches:
            if batch not in moving:
                batch.solve_one_way(m, d)
        if moving:
            wp.copy(self._outside, d.qfrc_passive)
            with self._scratch:
                wp.capture_if(self._taking_part.any, lambda: self._find_balance(m, d, moving))
            self._fork.run(*(functools.partial(batch.pass_by, self._taking_part) for batch in moving))
            self._act(m, d, moving)
        self._fork.run(*(batch.end_step for batch in batches))

    def _take_memory(self, m, d):
        """What the skins that move bodies share, of the first step with them."""
        from .loads import Loads

        device = d.qacc.device
        if device.is_cuda and device.is_capturing:
            raise ValueError(
                "mujoco_warp.step has not run yet: step once before the capture begins, which takes "
                "the memory for the loops in it"
            )
        self._corrected = [batch for batch in self.batches if batch.moving]
        groups = [batch.groups[0] for batch in self._corrected]
        slots = np.cumsum([0, *(batch.nslot for batch in self._corrected)])
        with wp.ScopedDevice(device):
            self._outside = wp.empty_like(d.qfrc_passive)
            self._amiss = wp.zeros(1, dtype=int)
            self._stiffness = wp.zeros((d.nworld, m.nv, m.nv), dtype=wp.float64)
            rows = wp.full((int(slots[-1]), d.nworld), -1, dtype=int)
            self._integrator, self._ends, self._loads = (
                Integrator(m, d),
                Ends(d),
                Loads(m, d, self._corrected),
            )
            self._slope = integrator.Slope(m, sum(groups), d.nworld)
        self._scratch = Scratch(device)
        for batch, first, row in zip(self._corrected, np.cumsum([0, *groups]), slots):
            batch.take_part(m, self._slope.correction, int(first), rows, int(row))

    def _find_balance(self, m, d, moving):
        """Models of the skins that hold where they lead, and that give no energy which is not there.

        A world is going until its skins are settled. From then on no launch changes it."""
        going, taking_part = self._going, self._taking_part
        going.copy(taking_part)
        _begin_dynamics(m, d)
        if self._integrator.differs:
            self._integrator.take_matrices(m, d)
        self._accelerate(m, d, moving, first=True)
        self._find_compliance(m, d, moving)
        self._solve(moving, lambda batch: batch.solve_first(m, d))
        self._choose(moving, lambda batch, found: batch.compare(found))
        self._go_on(m, d, moving)
        self._choose(moving, lambda batch, found: batch.find_energy(taking_part, found))
        wp.capture_if(going.any, lambda: self._damp(m, d, moving))
        self._choose(moving, lambda batch, found: batch.restrain(taking_part, found))
        wp.capture_if(going.any, lambda: self._restrain(m, d, moving))
        self._stiffness.zero_()
        for batch in moving:
            batch.add_stiffness(self._stiffness)
        for batch in moving:
            batch.conclude(taking_part, self._stiffness)
        end = self._ends.find(m, d, self._integrator.qacc)
        self._fork.run(*(functools.partial(batch.finish, end) for batch in moving))

    def _choose(self, moving, choose):
        """Which worlds go on: those that any batch chooses."""
        self._next.clear()
        for batch in moving:
            choose(batch, self._next)
        self._going.copy(self._next)

    def _go_on(self, m, d, moving):
        """Rounds of the worlds that are going, until all are settled or cannot be."""

        def go_on():
            self._accelerate(m, d, moving)
            self._choose(moving, lambda batch, found: batch.judge(self._going, found))
            wp.capture_if(self._going.any, lambda: self._solve(moving, lambda batch: batch.solve_again(m, d)))

        wp.capture_while(self._going.any, go_on)

    def _damp(self, m, d, moving):
        """Backward Euler's step in the worlds that are going."""
        for batch in moving:
            batch.use_euler(m, d)
        self._accelerate(m, d, moving)
        self._find_compliance(m, d, moving)
        self._go_on(m, d, moving)
        for batch in moving:
            batch.find_energy(self._taking_part, self._next)

    def _restrain(self, m, d, moving):
        """Withholds push in the worlds that are going."""

        def withhold():
            self._accelerate(m, d, moving)
            self._choose(moving, lambda batch, found: batch.withhold(self._going, found))

        def withdraw():
            for batch in moving:
                batch.withdraw(d, self._going.world)
            self._accelerate(m, d, moving)

        self._accelerate(m, d, moving)
        for batch in moving:
            batch.scale_push()
        wp.capture_while(self._going.any, withhold)
        self._choose(moving, lambda batch, found: batch.find_gain(self._taking_part, found))
        wp.capture_if(self._going.any, withdraw)

    def _find_compliance(self, m, d, moving):
        known = m, d, self._going.world, self._integrator.inertia
        self._fork.run(*(functools.partial(batch.find_compliance, *known) for batch in moving))

    def _solve(self, moving, solve):
        """Solves the skins, those of the condensed tier side by side."""
        condensed = [batch for batch in moving if batch.skin.kind == "condensed"]

        def solve_single(batch):
            solve(batch)
            batch.skin.end_solve()
            batch.accept_models()

        self._fork.run(*(functools.partial(solve, batch) for batch in condensed))
        solve_group([batch.skin for batch in condensed], self._fork)
        self._fork.run(*(batch.skin.end_solve for batch in condensed))
        for batch in condensed:
            batch.accept_models()
        for batch in moving:
            if batch not in condensed:
                wp.capture_if(batch.rest.any, functools.partial(solve_single, batch))

    def _act(self, m, d, moving):
        wp.copy(d.qfrc_passive, self._outside)
        self._fork.run(*(functools.partial(batch.act, m, d) for batch in moving))
        for batch in moving:
            batch.add_forces(d)

    def _accelerate(self, m, d, moving, first=False):
        """Where the bodies go under the present models, in the worlds that are going."""
        going, correction, device = self._going.world, self._slope.correction, d.qacc.device
        self._find_accelerations(m, d, moving, going, first)
        if self._integrator.differs:

            def compare():
                self._integrator.integrate(m, d, correction.going)
                self._amiss.zero_()
                for batch in self._corrected:
                    batch.find_amiss(d, self._integrator.qacc)
                wp.launch(integrator.judge, d.nworld, [correction], [self._amiss], device=device)

            def go_on():
                self._slope.find(m, d, self._integrator.inertia, self._corrected)
                self._find_accelerations(m, d, moving, correction.going)
                compare()

            wp.launch(integrator.begin_correction, d.nworld, [going, correction], device=device)
            compare()
            wp.capture_while(self._amiss, go_on)
        self._fork.run(*(functools.partial(batch.evaluate, self._integrator.qacc) for batch in moving))

    def _find_accelerations(self, m, d, moving, going, first=False):
        """Those of the constraint solver, in worlds that are going."""
        import mujoco_warp as mjw

        self._act(m, d, moving)
        mjw.fwd_acceleration(m, d, factorize=first)
        mjw.solve(m, d)
        integrator.accept(going, d.qacc, d.qacc_warmstart)

    def sensor(self, m: "mjw.Model", d: "mjw.Data", stage: object) -> None:
        import mujoco_warp as mjw
        from mujoco_warp._src.types import Stage

        if self._sensor:
            self._sensor(m, d, stage)
        batches = [batch for batch in self.batches if batch.active]
        if stage == Stage.VEL:
            self._fork.run(*(batch.look for batch in batches))
            for batch in batches:
                batch.solve_film()
            self._fork.run(*(functools.partial(batch.sense, d.sensordata) for batch in batches))
        elif stage == Stage.ACC and batches:
            mjw.contact_force(m, d, self._contact, True, self._contact_force)
            force = self._contact_force
            self._fork.run(*(functools.partial(batch.find_acting, d) for batch in batches))
            self._fork.run(*(functools.partial(batch.report_force, m, d, force) for batch in batches))
            moving = [batch for batch in batches if batch.moving]
            if moving:
                self._loads.write(m, d, moving)


def _begin_dynamics(m, d):
    """The stages of mujoco_warp between passive forces and accelerations, which forces do not change; it does
    them again afterwards."""
    import mujoco_warp as mjw
    from mujoco_warp._src import smooth

    mjw.rne(m, d)
    if m.ntendon:
        smooth.tendon_bias(m, d, d.qfrc_bias)
    if not m.opt.disableflags & mjw.DisableBit.ACTUATION and m.callback.control:
        m.callback.control(m, d)
    mjw.fwd_actuation(m, d)
