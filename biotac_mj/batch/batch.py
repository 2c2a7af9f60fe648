"""One BioTac in every world of a batch: its part of each stage of a step, as launches only. `hook.py` puts
them in order."""

import math
import typing

import mujoco
import numpy as np
import warp as wp

from ..coupling.implicit import energy, rounds
from ..coupling.implicit.compliance import Response, add_stiffness
from ..coupling.implicit.rounds import Marks, Model
from ..coupling.implicit.rows import write_rows
from ..coupling.implicit.rules import LOSS_FREQUENCY
from ..coupling.loads import core_geom, find_touches
from ..coupling.solid_contacts import SolidPairs
from ..coupling.structs import ModelView
from ..coupling.touching import Touching
from ..kernels import set_fields
from . import kernels, solid_contacts
from .engine import contacts_of, rows_of
from .implicit import integrator
from .implicit.factor import Cones, Factor
from .senses import Senses
from .skin import BatchSkin
from .skins import Skins
from .solid_contacts import SolidContacts

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

_ROUNDING = 1e-3  # of the most energy of a skin with such a push: accelerations are of single precision


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
            self._whole = wp.ones(skin.ngroup, dtype=wp.float64)
            kinds = (wp.vec3d, wp.vec3d, wp.float64, wp.spatial_vectord)
            self._touches = [wp.zeros((len(touching.geom), self.nworld), dtype=kind) for kind in kinds]
            self._of_step = r = rounds.make_rounds(*self.groups, limit)
            self._step = wp.full(self.groups, self.dt, dtype=wp.float64)
            self._greedy = wp.zeros(self.nworld, dtype=int)
            self._no_basis = wp.zeros((0, self.nworld), dtype=wp.spatial_vectord)
        view = ModelView(mjm._address)
        self._core_geom, self.ngeom = core_geom(view, touching.core), len(touching.geom)
        pairs = SolidPairs(view, touching)
        self.solid_contacts = SolidContacts(pairs, self.nworld, self.device)
        self._delay = loss / (2 * math.pi * LOSS_FREQUENCY * self.dt)
        self._qacc = None  # with which the bodies go
        self._response = self._factor = None
        r.settled, r.rounds, r.push, r.began = self._settled, self._rounds, self._push, self.began
        r.surface = skin.data.laws.struct.work
        if self.moving:
            skin.prepare_keep()
        area = float(skin.model.outer.area.numpy().sum())
        known = {"thickness": thickness or 0.0, "area": area, "inertial": skin.inertial}
        self._solid = set_fields(rounds.Solid(), **known)

    def lasting(self) -> tuple[list[wp.array], list[wp.array]]:
        last, first = super().lasting()
        r = self._of_step
        return [*last, r.end_pos, r.end_mat, r.left, r.frequency, r.passed], first

    def predict(self, m: "mjw.Model", d: "mjw.Data", taking_part: Marks) -> None:
        """Begins a step: where the bodies are and where they go without acceleration, and their Jacobians;
        marks the worlds whose skin takes part; finds this step's rows."""
        r = self._of_step
        start = r.start_pos, r.start_mat
        self._launch(*self._bodies.here(d, r.here_pos, r.here_mat))
        self._launch(*self._bodies.ahead(m, d, self._step, *start))
        self._launch(*self._bodies.jacobians(m, d, *start, self._jacobian))
        self.begin_step(r.start_pos, r.start_mat, m.geom_pos, m.geom_quat, taking_part)
        if self.moving:
            self._find_drift(m, d)
            self._correction_force.zero_()
            r.amiss.zero_()
            known = [self.rest.awake, self.skin.by_mocap]
            self._launch(rounds.begin_rounds, self.nworld, known, [r, self._last, self.model])
            by = [self.dt, 0.0, self._delay, self._solid, self.model]
            self._launch(rounds.choose_gamma, self.groups, by, [r])
            self._find_drift(m, d)
            self._put_bodies(m)
            self._launch(
                kernels.find_rows, self._row.shape, [self._slot, d.ne, d.efc.type, d.efc.id], [self._row]
            )

    def _find_drift(self, m, d):
        """Finds where the bodies go without acceleration to where the skins are solved, of their gamma."""
        for launch in self._bodies.drift(m, d, self.dt, self._jacobian, self._of_step):
            self._launch(*launch)

    def use_euler(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Makes greedy worlds' step that of backward Euler, after `restrain`. Launches only."""
        self._launch(rounds.use_euler, self.nworld, [self.dt, self._greedy], [self._of_step])
        self._find_drift(m, d)

    def add_forces(self, d: "mjw.Data") -> None:
        """Adds the linear models to the forces, after `act`."""
        wrenches = [self._wrench, self._correction_force]
        self._launch(kernels.add_forces, d.qfrc_passive.shape, [self._jacobian, *wrenches], [d.qfrc_passive])

    def act(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Finds the linear models' forces, and puts the rest of them into the rows."""
        self._find_wrenches()
        nv = self._jacobian.shape[2]
        known = [self._of_step.square, self._group_slot, self._row, self._jacobian, self.model.tangent0, nv]
        self._launch(write_rows, (*self._row.shape, nv), known, [rows_of(m, d), self._no_basis])

    @property
    def nslot(self) -> int:
        """Number of slots of six rows."""
        return len(self._slot)

    def keep_in(self, correction: integrator.Correction, first: int) -> None:
        """Keeps what is corrected in the arrays of all skins, its own bodies from number `first` on."""
        own, r, model = slice(first, first + self.groups[0]), self._of_step, self.model
        for name in Model.vars:
            array = getattr(correction.model, name)[own]
            wp.copy(array, getattr(model, name))
            setattr(model, name, array)
        self._jacobian, r.square = correction.jacobian[own], correction.square[own]
        self._correction_force, r.amiss = correction.force[own], correction.amiss[own]
        self._acts = correction.acts[own]

    def take_part(self, m: "mjw.Model", rows: wp.array, first_row: int, cones: Cones) -> None:
        """Has its own of the rows of all skins."""
        self._row = rows[first_row : first_row + self.nslot]
        self._response, self._factor = Response(self._jacobian, self.model), Factor(m, self.nworld, cones)

    def update_active(self) -> None:
        """Writes whether the skin acts into the correction of all skins. Launches only."""
        self._acts.fill_(int(self.active))

    def evaluate(self, m: "mjw.Model", d: "mjw.Data", qacc: wp.array) -> None:
        """Finds where the bodies go with accelerations (nworld, nv), where the skins are solved, and the work
        of mujoco_warp's contacts with core, nail and clamp."""
        self._qacc, r = qacc, self._of_step
        self._launch(*self._bodies.accelerate(self.dt, self._jacobian, qacc, r))
        r.lifted.zero_()
        known = [self._core, self._body, self.dt, m.geom_bodyid, contacts_of(d), rows_of(m, d), d.qvel, qacc]
        self._launch(solid_contacts.find_lift, d.naconmax, known, [r.lifted])

    def _put_bodies(self, m):
        """Lets bodies that were placed begin without contact; finds which were placed in the skin."""
        r, skin, at, laws = self._of_step, self.skin, self.rest.clearance, self.skin.data.laws.struct
        self.place_geoms(r.here_pos, r.here_mat, m.geom_pos, m.geom_quat)
        skin.put_bodies(r.placed, self.began, self.rest.awake, r.inside)
        at.find(r.inside, skin.geoms.struct, laws, skin.data.rest_vert)
        self._launch(rounds.look_inside, self.nworld, [laws, at.found], [r])

    def look_ahead(self, m: "mjw.Model", taking_part: Marks) -> None:
        """Marks worlds that this skin cannot leave alone, after `evaluate`."""
        r = self._of_step
        self.place_geoms(r.pos, r.mat, m.geom_pos, m.geom_quat)
        self.rest.look_ahead(taking_part)

    def find_compliance(self, m: "mjw.Model", d: "mjw.Data", going: wp.array, inertia: wp.array) -> None:
        """Finds how the bodies give way in worlds that are going (nworld,), after mujoco_warp's constraint
        solver; inertia: see `Integrator`. Launches only."""
        self._factor.find(m, d, going, inertia, own=self._row)
        out = self._of_step.square, self.skin.bodies.compliance
        for launch in self._response.compliance(going, self._factor.L, *out):
            self._launch(*launch)

    def begin_solve(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Begins to solve the wanted skins where the bodies go; those that move no bodies it solves, where
        these go without acceleration."""
        r, skin = self._of_step, self.skin
        if skin.inertial:
            qacc, square = (self._qacc, self.dt**2) if self.moving else (d.qacc, 0.0)
            frames = [skin.core_pos, skin.core_mat, skin.data.frame_pos, skin.data.frame_mat]
            self._launch(*self._bodies.core_motion(m, d, self.dt, square, qacc, frames))
        on_bodies = m.geom_pos, m.geom_quat
        if not self.moving:
            self.solve_at(r.start_pos, r.start_mat, *on_bodies)
            return
        wanted, bodies = skin.data.worlds.wanted, skin.bodies
        inputs = [wanted, skin.fraction, self.model, self._wrench]
        self._launch(rounds.tell_bodies, self.groups, inputs, [bodies, r])
        self._launch(rounds.uncoupled_poses, self.groups, [wanted, bodies], [r])
        self.place_geoms(r.free_pos, r.free_mat, *on_bodies)
        self.rest.begin_solve()
        self._launch(rounds.ask, self.groups, [wanted, self.rest.gone], [r])
        self.place_geoms(r.asked_pos, r.asked_mat, *on_bodies)
        skin.begin_solve()

    def accept_models(self) -> None:
        """After `BatchSkin.end_solve`: takes the models of the skins."""
        r = self._of_step
        self.accept(r.asked_pos, r.asked_mat)

    def solve_one_way(self, m: "mjw.Model", d: "mjw.Data") -> None:
        """Solves the skins that are awake, for the bodies' poses at the end of a step without
        acceleration."""

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
        known = [self.rest.awake, self.skin.fraction, self.skin.bodies, self.model]
        self._launch(rounds.look, self.nworld, known, [self._of_step, going.struct])

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
        self._settle(energy.find_energy, taking_part, [self._last, self.skin.reason, self._solid], out)

    def restrain(self, d: "mjw.Data", worlds: Marks, going: Marks) -> None:
        """Takes the push on bodies that have not the energy for it, after `find_energy` and `evaluate`, and
        marks their worlds."""
        known = [_ROUNDING, self._solid, self.skin.bodies.compliance, self.model]
        self._settle(energy.restrain, worlds, known, [d.qacc_warmstart, going.struct])

    def add_stiffness(self, stiffness: wp.array) -> None:
        """Adds the skin's to that of all (nworld, nv, nv)."""
        dim = stiffness.shape[:2]
        self._launch(add_stiffness, dim, [self._jacobian, self.model, stiffness])

    def conclude(self, taking_part: Marks, stiffness: wp.array, L: wp.array) -> None:
        """Finds the frequencies and settles the account of energy, after `evaluate`; stiffness, L: see
        `Response.frequencies`."""
        r, worlds = self._of_step, taking_part.world
        for launch in self._response.frequencies(worlds, stiffness, L, r.frequency):
            self._launch(*launch)
        self._find_wrenches()
        known = [taking_part.world, self.skin.reason, r]
        self._launch(energy.conclude, self.nworld, known, [r.left])

    def finish(self, end: "mjw.Data") -> None:
        """Takes where bodies are after the step: what the next one finds elsewhere was moved by others."""
        self._launch(*self._bodies.here(end, self._of_step.end_pos, self._of_step.end_mat))

    def find_acting(self, d: "mjw.Data") -> None:
        """Finds what acts on the bodies in the step, after mujoco_warp's constraint solver."""
        if self.moving:
            forces = [self._wrench, self._correction_force, self.model.tangent0]
            known = [self._of_step.square, self._jacobian, d.qacc, *forces, self.skin.reason]
            self._launch(kernels.acting_wrenches, self.groups, known, [self._acting])

    def report_force(self, m: "mjw.Model", d: "mjw.Data", contact_force: wp.array) -> None:
        """Writes what acts on the BioTac in the step, on its skin and on core, nail and clamp, when each has
        found what acts. Launches only.

        Args:
          contact_force: (naconmax,) force and torque of d's contacts in the world's frame.
        """
        acting = self._acting if self.moving else self.model.wrench0
        known = [self._core, m.geom_bodyid, contacts_of(d), contact_force, d.xpos, d.xmat]
        self._on_solid.zero_()
        self._launch(solid_contacts.sum_contacts, contact_force.shape, known, [self._on_solid])
        for other, group in self.skins_met:
            met = [self._core, other._core, group, other._acting, d.xpos, d.xmat]
            self._launch(solid_contacts.add_push, self.nworld, met, [self._on_solid])
        known = [self._addresses, acting, self._whole, self._on_solid]
        self._launch(kernels.write_force, (self.nworld, 6), known, [d.sensordata])

    def find_touches(self) -> None:
        """Parts what acts among the geoms."""
        skin, outer, model = self.skin, self.skin.data.outer, self.skin.model
        samples = [len(model.sample), model.outer.face, self._group, outer.kept, outer.anchor_geom]
        samples += [outer.sample_force, skin.x, self._acting]
        self._launch(find_touches, self.groups, samples, [*self._touches])

    def list_touches(self, m: "mjw.Model", d: "mjw.Data", row: int, listed: list) -> None:
        """Adds its touches to the contacts, with rows from `row` on, and clears its own rows."""
        from mujoco_warp import ConeType

        from . import loads  # here, as mujoco_warp is: `make` does without

        pos, normal, _, wrench = self._touches
        pyramidal = m.opt.cone == ConeType.PYRAMIDAL
        known = [self._core, self._core_geom, self._geom, pyramidal, row, d.xpos, d.xmat, pos, normal, wrench]
        self._launch(loads.list_touches, (self.ngeom, self.nworld), known, listed)
        self._launch(loads.clear_rows, self._row.shape, [self._row], listed[-1:])

    def meet(self, others: list["Batch"]) -> None:
        """Shares what skins do to each other between two that both move bodies."""
        self.skins_met = []
        bodies, fraction = self._body.numpy(), np.ones(self._body.size)
        for other in others if self._two_way else ():
            mine = np.flatnonzero(other._body.numpy() == self._core).tolist()
            self.skins_met += [(other, k) for k in mine]
            if set(mine) & set(other._skins):
                fraction[[k for k in self._skins if bodies[k] == other._core]] = 0.5
        self.skin.fraction.assign(fraction)

    def pass_by(self, taking_part: Marks) -> None:
        """Ends a step of the worlds in which no skin takes part."""
        known = [taking_part.world, self._solid.area]
        self._launch(energy.pass_by, self.nworld, known, [self._of_step])

    def _settle(self, kernel, worlds, known=(), outputs=()):
        self._find_wrenches()
        self._launch(kernel, self.nworld, [worlds.world, *known], [self._of_step, *outputs])

    def _find_wrenches(self):
        self._launch(rounds.wrenches, self.groups, [self.model, self._of_step], [self._wrench])
