"""The skins of a batch inside `mujoco_warp.step`: launches only, so that the step can be captured in a CUDA
graph.

Once per step, when mujoco_warp computes passive forces, and as in `coupling/implicit/world.py` for one world:
1. The linear models of the last step enter the dynamics, and mujoco_warp's own later stages predict where
   the bodies go.
2. The skins are solved, while their bodies give way from there as their inertia lets them.
3. Their new linear models take the old ones' place. Where that moved a body mujoco_warp predicts again, and
   the skins of worlds in which something else held it are solved again.
4. Push is withheld where the skins would give more energy than was put into them, and mujoco_warp continues.
The readings are written with mujoco_warp's velocity sensors. contact_force, the force that acts in the step,
is written again with its acceleration sensors, after its constraint solver."""

import functools
import typing

import mujoco
import numpy as np
import warp as wp

from ..coupling.implicit.rounds import Marks
from ..skin.program import Fork, Launcher
from .ahead import kernels_of_step
from .batch import Batch
from .implicit import integrator
from .implicit.factor import Cones, Factor
from .implicit.integrator import Ends, Integrator
from .memory import Scratch
from .skin import solve_group

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw


class Hook:
    """Callback of a mujoco_warp Model. It steps all batches of the Model together, after the callbacks that
    were there before."""

    def __init__(self, m: "mjw.Model"):
        self.batches = []
        self._passive, self._sensor = m.callback.passive, m.callback.sensor
        self._contactfilter = m.callback.contactfilter
        self._contact_force = None
        self._corrected = []  # whose forces are corrected together
        self._began_with = self._aside = None  # velocities of one-way skins' bodies, memory of the search
        self._fork = Fork(m.qpos0.device)
        self._taking_part = self._going = self._next = None  # `Marks` of worlds: in the step, in a round
        m.callback.passive, m.callback.sensor = self.passive, self.sensor
        m.callback.contactfilter = self.contactfilter

    @classmethod
    def of(cls, m: "mjw.Model") -> "Hook":
        """The Model's hook, made at the first call."""
        return m.callback.passive.__self__ if cls.is_of(m) else cls(m)

    @classmethod
    def is_of(cls, m: "mjw.Model") -> bool:
        """Whether the Model has one."""
        return isinstance(getattr(m.callback.passive, "__self__", None), cls)

    def add(self, batch: Batch, d: "mjw.Data") -> None:
        if any(there._core == batch._core for there in self.batches):
            raise ValueError("this BioTac is attached to the mujoco_warp Model already: attach it once")
        self.batches.append(batch)
        moving = [one for one in self.batches if one.moving]
        for one in self.batches:
            one.meet(moving)
        if self._contact_force is None or len(self._contact_force) < d.naconmax:
            self._contact = wp.array(np.arange(d.naconmax, dtype=np.int32), device=d.qpos.device)
            self._contact_force = wp.zeros(d.naconmax, dtype=wp.spatial_vector, device=d.qpos.device)
        with wp.ScopedDevice(d.qpos.device):
            self._taking_part, self._going, self._next = (Marks(d.nworld) for _ in range(3))
            self._films = wp.zeros(1, dtype=int)
            first = np.cumsum([0, *(one.groups[0] for one in moving)]).tolist()
            self._correction = integrator.corrections(first[-1], d.nworld, d.qvel.shape[1])
        for one, number in zip(moving, first):
            one.keep_in(self._correction, number)

    def kernels(self, mjm: mujoco.MjModel, m: "mjw.Model") -> list[tuple[wp.Module, int]]:
        """Kernels of a step of the Model with its batches, see `ahead.kernels_of_step`; no other callback is
        called."""
        before = self._passive, self._sensor, self._contactfilter
        self._passive = self._sensor = self._contactfilter = None
        own = type(m.callback)()
        own.passive, own.sensor, own.contactfilter = self.passive, self.sensor, self.contactfilter
        try:
            return kernels_of_step(mjm, m, own)
        finally:
            self._passive, self._sensor, self._contactfilter = before
            self._corrected, self._began_with = [], None  # the memory was for another Data

    def contactfilter(self, m: "mjw.Model", d: "mjw.Data") -> None:
        if self._contactfilter:
            self._contactfilter(m, d)
        for batch in self.batches:
            if batch.active:
                batch.solid_contacts.amend(m, d)

    def passive(self, m: "mjw.Model", d: "mjw.Data") -> None:
        if self._passive:
            self._passive(m, d)
        first = self._corrected != [b for b in self.batches if b.moving]
        if first:
            self._take_memory(m, d)
        batches = [b for b in self.batches if b.active]
        self._taking_part.clear()
        moving = [b for b in batches if b.moving]
        for batch in batches:
            if batch not in moving:
                self._predict_one_way(m, d, batch)
                batch.solve_one_way(m, d)
        self._fork.run(*(functools.partial(batch.predict, m, d, self._taking_part) for batch in moving))
        if moving:
            wp.copy(self._outside, d.qfrc_passive)
            with self._scratch:
                if first:  # also where nothing is near: it takes the memory that a capture must find
                    self._look_ahead(m, d, moving)
                else:
                    wp.capture_if(self._taking_part.any, lambda: self._look_ahead(m, d, moving))
            self._fork.run(*(functools.partial(batch.pass_by, self._taking_part) for batch in moving))
            self._act(m, d, moving)
        self._fork.run(*(batch.end_step for batch in batches))

    def _predict_one_way(self, m, d, batch):
        """Predicts where bodies go at their velocities; where core, nail or clamp stops one, at those of the
        step's end."""
        import mujoco_warp as mjw

        stopped, first = batch.solid_contacts.stopped, self._began_with is None
        if first:
            self._began_with, self._aside = wp.empty_like(d.qvel), Scratch(d.qvel.device)
        wp.copy(self._began_with, d.qvel)

        def speed_up():
            _begin_dynamics(m, d)
            mjw.fwd_acceleration(m, d, factorize=True)
            mjw.solve(m, d)
            known = [stopped.world, batch.dt, d.qacc]
            wp.launch(integrator.speed_up, d.qvel.shape, known, [d.qvel], device=d.qvel.device)
            mjw.com_vel(m, d)

        with self._aside:
            if first:  # it takes the memory that a capture must find
                speed_up()
            else:
                wp.capture_if(stopped.any, speed_up)
        batch.predict(m, d, self._taking_part)
        wp.copy(d.qvel, self._began_with)
        wp.capture_if(stopped.any, lambda: mjw.com_vel(m, d))

    def _take_memory(self, m, d):
        """Allocates the arrays shared by the skins that move bodies, at the first step with them."""
        from .loads import Loads

        device = d.qacc.device
        if device.is_cuda and device.is_capturing:
            raise ValueError(
                "mujoco_warp.step has not run yet: step once before the capture begins, which takes "
                "the memory for the loops in it"
            )
        self._corrected = [batch for batch in self.batches if batch.moving]
        slots = np.cumsum([0, *(batch.nslot for batch in self._corrected)])
        with wp.ScopedDevice(device):
            self._outside = wp.empty_like(d.qfrc_passive)
            self._amiss = wp.zeros(1, dtype=int)
            self._stiffness = wp.zeros((d.nworld, m.nv, m.nv), dtype=wp.float64)
            self._rows = rows = wp.full((int(slots[-1]), d.nworld), -1, dtype=int)
            self._integrator, self._ends = Integrator(m, d), Ends(d)
            self._loads = Loads(m, d, self._corrected)
            cones = Cones(m, d)
            self._slope = integrator.Slope(m, d.nworld, cones)
        self._scratch, self._free = Scratch(device), Factor(m, d.nworld, cones)
        for batch, row in zip(self._corrected, slots):
            batch.take_part(m, rows, int(row), cones)

    def _look_ahead(self, m, d, moving):
        """Predicts the bodies' poses with the linear models of the last step and, in worlds whose skins act
        or are touched there, finds the equilibrium."""
        going, taking_part = self._going, self._taking_part
        going.copy(taking_part)
        _begin_dynamics(m, d)
        if self._integrator.differs:
            self._integrator.take_matrices(m, d)
            for batch in self._corrected:
                batch.update_active()
        self._accelerate(m, d, moving, first=True)
        taking_part.clear()
        self._fork.run(*(functools.partial(batch.look_ahead, m, taking_part) for batch in moving))
        self._fork.run(*(functools.partial(batch.rest.leave, taking_part) for batch in moving))
        wp.capture_if(taking_part.any, lambda: self._find_balance(m, d, moving))

    def _find_balance(self, m, d, moving):
        """Models of the skins that hold where they lead, and that give no energy which is not there.

        A world is going until its skins are settled. From then on no launch changes it."""
        going, taking_part = self._going, self._taking_part
        going.copy(taking_part)
        self._find_compliance(m, d, moving)
        self._solve(moving, lambda batch: batch.solve_first(m, d))
        self._choose(moving, lambda batch, found: batch.compare(found))
        self._run_rounds(m, d, moving)
        self._choose(moving, lambda batch, found: batch.find_energy(taking_part, found))
        wp.capture_if(going.any, lambda: self._damp(m, d, moving))
        self._choose(moving, lambda batch, found: batch.restrain(d, taking_part, found))
        wp.capture_if(going.any, lambda: self._restrain(m, d, moving))
        self._stiffness.zero_()
        for batch in moving:
            batch.add_stiffness(self._stiffness)
        self._free.find(m, d, taking_part.world, d.M, own=self._rows)
        known = taking_part, self._stiffness, self._free.L
        self._fork.run(*(functools.partial(batch.conclude, *known) for batch in moving))
        end = self._ends.find(m, d, self._integrator.qacc)
        self._fork.run(*(functools.partial(batch.finish, end) for batch in moving))

    def _choose(self, moving, choose):
        """Selects the worlds that continue: those that choose(batch, found) finds in any batch."""
        self._next.clear()
        self._fork.run(*(functools.partial(choose, batch, self._next) for batch in moving))
        self._going.copy(self._next)

    def _run_rounds(self, m, d, moving):
        """Rounds of the worlds that are going, until all are settled or cannot be."""

        def solve():
            self._find_compliance(m, d, moving)
            self._solve(moving, lambda batch: batch.solve_again(m, d))

        def one_round():
            self._accelerate(m, d, moving)
            self._choose(moving, lambda batch, found: batch.judge(self._going, found))
            wp.capture_if(self._going.any, solve)

        wp.capture_while(self._going.any, one_round)

    def _damp(self, m, d, moving):
        """Backward Euler's step in the worlds that are going."""
        for batch in moving:
            batch.use_euler(m, d)
        self._accelerate(m, d, moving)
        self._find_compliance(m, d, moving)
        self._run_rounds(m, d, moving)
        for batch in moving:
            batch.find_energy(self._taking_part, self._next)

    def _restrain(self, m, d, moving):
        """Withholds push in the worlds that are going: also on bodies that get too much only now that others
        get none."""

        def withhold():
            self._accelerate(m, d, moving)
            self._choose(moving, lambda batch, found: batch.restrain(d, self._going, found))

        wp.capture_while(self._going.any, withhold)

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
        """Computes the bodies' poses with the present models, in the worlds that continue."""
        going, correction, device = self._going.world, self._correction, d.qacc.device
        if self._integrator.differs:
            wp.launch(integrator.begin_correction, d.nworld, [going, correction], device=device)
        self._find_accelerations(m, d, moving, going, first)
        if self._integrator.differs:

            def compare():
                self._integrator.integrate(m, d, correction.going)
                self._amiss.zero_()
                known, again = [d.qacc, self._integrator.qacc, correction], [self._amiss]
                worlds, threads = [d.nworld], integrator.BLOCK
                Launcher(device).launch_blocks(integrator.find_amiss, worlds, known, again, threads)

            def one_round():
                self._slope.find(m, d, self._integrator, correction)
                self._find_accelerations(m, d, moving, correction.going)
                compare()

            compare()
            wp.capture_while(self._amiss, one_round)
        self._fork.run(*(functools.partial(batch.evaluate, m, d, self._integrator.qacc) for batch in moving))

    def _find_accelerations(self, m, d, moving, going, first=False):
        """Computes the constraint solver's accelerations in the worlds that continue."""
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
            self._films.zero_()
            self._fork.run(*(functools.partial(batch.look, self._films) for batch in batches))
            films = [batch.solve_film for batch in batches]
            wp.capture_if(self._films, lambda: self._fork.run(*films))
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
