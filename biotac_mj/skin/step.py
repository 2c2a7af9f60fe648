"""One step of the skin: Newton's method on the balance of forces, each linear system by preconditioned
conjugate gradients.

    step(model, data, geoms, dt)               # poses that were set in, positions and wrenches out

A step is launches alone, with loops and branches between them that look at flags on the device (`program`): a
recorded list on the CPU, one captured graph on CUDA, alone or inside the caller's own graph:

    prepare_step(model, data, geoms)           # allocates and compiles; then, inside a capture or without
    one: launch_step(model, data, geoms)

Everything that changes between steps is read from device arrays: poses and frictions `geoms.struct.pos, .mat,
.friction` [geom, world], materials `data.rubber`, laws of contact `data.laws.struct`, the liquids
`data.worlds.kappa, .natural, .holds`, `data.dt`, and the pose of the BioTac frame `data.frame_pos,
.frame_mat` (implicit dynamics). Overwrite them, then step.

A world that does not converge is solved in load increments: its geoms move from where they were when the last
step ended, as far as the skin finds equilibria, and friction slips on from increment to increment; no skin
fits between the core and a geom deep inside it. A world that does not reach the end stays at its last
equilibrium (`data.load_factor`), is counted in `data.worlds.nonconverged` and has its reason in
`data.worlds.reason`; so does one whose input is not finite, which stays where it was. Other worlds are not
affected. Converged worlds are skipped; those that are not `data.worlds.wanted` take no part, and stay as the
last step left them."""

import dataclasses
import types
import weakref

import numpy as np
import warp as wp

from ..threads import single_thread
from .bodies import make_bodies
from .contact import broadphase, faces, penetration
from .contact.posed import LoadPath
from .contact.touch import BLOCK, contact_kernels
from .data import SkinData
from .forces import Forces, Vectors
from .geoms import GeomSet
from .give import CompliantBodies
from .model import SkinModel
from .newton import krylov, load_path, nodes, worlds
from .precondition import Residual
from .precondition.native import kernels_up_to
from .program import Launcher, Program, compile_ahead, compile_kernels
from .rubber.element_forces import module_for_cuda
from .types import SINGLE, mat33, vec3

__all__ = ["SkinStep", "kernels_for_cuda", "launch_step", "prepare_step", "step"]

_FREE = (
    "tolerance",
    "max_newton",
    "max_cg",
    "max_work",
    "stick_ratio",
    "mass_damping",
    "stiffness_damping",
    "max_core_depth",
)
# (SkinModel, SkinData, GeomSet) -> alone.Alone; set by `alone`, which steps too and stands above this module
make_alone = None

_SHORTEST = 1 / 32  # load increment


def step(
    model: SkinModel,
    data: SkinData,
    geoms: GeomSet,
    dt: float | np.ndarray | None = None,
    core_pos: np.ndarray | None = None,
    core_mat: np.ndarray | None = None,
    alone: bool = True,
) -> None:
    """Advances every world to the balance of forces with the geoms where they are now.

    A world that finds no balance there comes as far as it can, see `data.load_factor`; it is counted in
    `data.nonconverged` and flagged in `data.converged`. The next step goes on from there.

    With the dense preconditioner (CUDA, many worlds) such a world is solved once more by itself before, on
    the CPU (`alone.Alone`): that takes as long as a hard step of a single skin, while the others wait.

    Args:
      model, data: the skin.
      geoms: touching geoms, poses in the BioTac frame at the end of the step.
      dt: time step [s], a number or (nworld,); needed by implicit dynamics and by skin with a Prony series.
      core_pos, core_mat: (nworld, 3) [m], (nworld, 3, 3) pose of the BioTac frame in the world at the end of
        the step, for the inertia of implicit dynamics; None means that it does not move.
      alone: whether worlds without a balance are solved once more; skins with inertia never are.

    Raises:
      ValueError: geoms of another number of worlds, adhesion that reaches further than a mesh geom's distance
        is known, or a time step that is missing or not positive.
    """
    ready = prepare_step(model, data, geoms)
    _set_time(model, data, dt, core_pos, core_mat)
    data.laws.refuse_coarse_grids(geoms)
    if model.device.is_cuda:
        ready.run()
    else:
        with single_thread():
            ready.run()
    if alone and not ready.implicit and data.precision is SINGLE:
        ready.solve_lost(data)


def prepare_step(model: SkinModel, data: SkinData, geoms: GeomSet) -> "SkinStep":
    """Allocates and compiles what `launch_step` needs; again only where the model's options or the geoms are
    others.

    Raises:
      ValueError: geoms of another number of worlds, options that the data was not made for, or called first
        while a graph is captured.
    """
    if geoms.nworld != data.nworld:
        raise ValueError(
            f"geoms are for {geoms.nworld} worlds and the data for {data.nworld}: make both for the same "
            "number"
        )
    key = (id(geoms), model.options)
    if key not in data.steps:
        if model.device.is_cuda and model.device.is_capturing:
            raise ValueError(
                "the step is not ready: call prepare_step(model, data, geoms) before the capture begins"
            )
        _refuse_other_options(model, data)
        geoms.resolve(model.spacing, model.options.samples)
        data.steps[key] = SkinStep(model, data, geoms)
    return data.steps[key]


def kernels_for_cuda(shapes: str) -> list[tuple[types.ModuleType | wp.Module, int]]:
    """Of a step's kernels on CUDA those that take long to compile, whatever the rubber, for skins that meet
    such shapes (`GeomSet.shapes`): for `program.compile_ahead`."""
    found = [(contact_kernels(False, False, shapes).by_sample.module, BLOCK)]
    found += [(kernel.module, threads) for kernel, threads in kernels_up_to()]
    return [*found, (penetration, 256), (faces, 256), (broadphase, 256)]


def _refuse_other_options(model, data):
    """What model and data were made for cannot change; tolerances, limits and damping can."""
    now, made = model.options, data.made_for
    names = [f.name for f in dataclasses.fields(now) if f.name not in _FREE]
    changed = [name for name in names if getattr(now, name) != getattr(made, name)]
    if bool(now.stiffness_damping) != bool(made.stiffness_damping):
        changed.append("stiffness_damping")
    if changed:
        raise ValueError(
            f"the model's {' and '.join(changed)} changed since its SkinData was made: make a new one"
        )


def launch_step(model: SkinModel, data: SkinData, geoms: GeomSet) -> None:
    """Launches a step of every world on the device's current stream: for use inside a captured graph, or
    without one.

    Takes the poses from `geoms.struct` as they are when it runs. Raises what `prepare_step` raises.
    """
    prepare_step(model, data, geoms).launch()


def _set_time(model, data, dt, core_pos, core_mat):
    implicit = model.options.dynamics == "implicit"
    if implicit or model.material.prony:
        if dt is None or not (np.isfinite(dt).all() and np.min(dt) > 0):
            what = "implicit dynamics" if implicit else "skin with a Prony series, which relaxes in time,"
            raise ValueError(f"{what} needs the time step: pass dt > 0")
        if np.ndim(dt) == 0:
            data.dt.fill_(dt)
        else:
            data.dt.assign(np.asarray(dt, float))
    if implicit:
        for array, last, value in (
            (data.frame_pos, data.frame_pos_last, core_pos),
            (data.frame_mat, data.frame_mat_last, core_mat),
        ):
            if value is None:
                wp.copy(array, last)
            else:
                array.assign(np.asarray(value, float))


class SkinStep:
    """A step of the worlds of `data` under `geoms`, see the module's docstring.

    Raises:
      ValueError: `data` and `geoms` do not fit, see `prepare_step`.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        # takes long: it begins before the preconditioner is made
        compile_ahead(model.device, [module_for_cuda(model.elements, model.rubber_options)])
        # the data owns its steps: a reference back would keep gigabytes until the garbage collector passes
        self.m, self.d, self.geoms = model, weakref.proxy(data), geoms
        if data._vectors is None:
            data._vectors = Vectors(model, data)
        self.k, self.st, self.M = data._vectors, data.worlds, data.preconditioner
        self._forces = Forces(model, self.d, geoms, self.k)
        self._of_nodes = nodes.nodes_kernels(data.precision)
        self._of_krylov = krylov.krylov_kernels(data.precision)
        self.implicit, w = self._forces.implicit, data.nworld
        self._giving = CompliantBodies(self._forces) if data.bodies else None
        with wp.ScopedDevice(model.device):
            self._bodies = data.bodies or make_bodies(0, w)
            self._path = LoadPath()
            self._path.pos_start, self._path.pos_end = (
                wp.zeros((geoms.count, w), dtype=vec3) for _ in range(2)
            )
            self._path.mat_start, self._path.mat_end = (
                wp.zeros((geoms.count, w), dtype=mat33) for _ in range(2)
            )
        self._of_geoms = data.geom_memory(geoms.count, geoms.ngroup)
        flags = self.k.flags
        self._newton_on, self._solve_on, self._search_on = (flags[i : i + 1] for i in range(3))
        (
            self._any_open,
            self._any_lost,
            self._any_increment,
            self._any_short,
            self._any_lagged,
            self._any_looks,
        ) = (flags[i : i + 1] for i in range(3, 9))
        self._graph = None
        if model.device.is_cuda:
            compile_kernels(model.device, self._record)
            if self.M.needs_torch:  # whose workspaces are made before anything is captured
                self._warm_up()
        self._program = Program(model.device, self._record)
        self._evaluation = self._alone = None

    def run(self) -> None:
        """One step, on the current stream."""
        self.d.geom_memory(self.geoms.count, self.geoms.ngroup)  # its outputs are now the data's
        if not self.m.device.is_cuda:
            with single_thread():  # small systems are not faster in several, and end in other bits
                self._program.run()
            return
        self.record()
        wp.capture_launch(self._graph)

    def record(self) -> None:
        """Captures the step as a CUDA graph, which takes some 15 ms: the first `run` does it otherwise. On
        the CPU a step is recorded when it is made."""
        if self.m.device.is_cuda and self._graph is None:
            with wp.ScopedCapture(self.m.device) as capture:
                self._program.run()
            self._graph = capture.graph

    def forget(self) -> None:
        """Lets go of what was recorded; it cannot run again."""
        self._program.forget()
        if self._evaluation:
            self._evaluation.forget()

    def launch(self) -> None:
        """Launches a step, for the caller's capture."""
        self._program.run()

    # --- for looking at a skin where it is: forces and tangent, without a step ---

    def evaluate_forces(self) -> None:
        """Writes the forces at `data.x` and what belongs to them, in all worlds."""
        wp.copy(self.k.begun, self.d.x_last)
        self.st.moving.fill_(1)
        if not self._evaluation:  # recorded, as steps are: a gradient comes here once a step
            self._evaluation = Program(self.m.device, self._record_evaluation)
        self._evaluation.run()
        self._launcher = Launcher(self.m.device)  # of whoever looks further

    def normal_push(self, touched: np.ndarray) -> np.ndarray:
        """(nface,) normal push of the geoms on the outer faces at `data.x` [N], in a single world; 0 on those
        that are not among `touched`, numbers of faces."""
        return faces.normal_push(self._forces.contact, self.geoms.struct, self.d.x, touched)

    def _record_evaluation(self, program):
        self._launcher = program
        self._forces.evaluate(self._launcher, self.st.moving)

    def multiply_tangent(self, p: np.ndarray, at_pressure: bool = False) -> np.ndarray:
        """Tangent of all forces where `evaluate_forces` was last, times p (nvert, nworld, 3); zero at fixed
        nodes.

        Args:
          at_pressure: of a liquid that keeps its pressure, instead of one that resists changes of its volume.
        """
        k, st = self.k, self.st
        k.p.assign(np.ascontiguousarray(p))
        st.running.fill_(1)
        self._once(lambda: self._forces.multiply(self._launcher))
        q = k.q.numpy().astype(float)
        if self.m.has_liquid and not at_pressure:
            free = self.m.free_mask.numpy()[:, None, None]
            gradient = self.d.gradient.numpy() * free
            swell = st.kappa.numpy() * (gradient * p).sum((0, 2))
            q += swell[:, None] * gradient
        return q

    # --- for whoever solves with the tangent of contact of its own: into a program, of worlds that run ---

    def put_preconditioner(self, program: Launcher) -> None:
        """Takes what is in `touching` and `block` of the surfaces into the preconditioner, in the active
        worlds; k.worth holds no zeros."""
        k = self.k
        self.M.begin_step(program, self.d.x)
        residual = Residual(k.worth, k.r, self._forces.gradient)
        self.M.update(program, self.st, residual, k.z, k.part, self._forces.beside)

    def put_inverse(self, program: Launcher, r: wp.array) -> None:
        """k.z becomes the approximate inverse of that times r, zero at fixed nodes; k.part holds the square
        of r by chunks."""
        k = self.k
        self.M.apply(program, self.st, k.part, r, self._forces.gradient, k.z, k.part)

    def _once(self, body):
        self.st.moving.fill_(1)
        self._launcher = Launcher(self.m.device)
        body()

    def look(self) -> None:
        """Forces and tangents at `data.x` of the worlds that are moving and active, whose flags go out."""
        self._launcher = Launcher(self.m.device)
        wp.copy(self.k.begun, self.d.x_last)
        self._forces.evaluate(self._launcher, self.st.moving)
        self._precondition()
        self.st.active.zero_()
        self.st.moving.zero_()

    def solve_lost(self, data: SkinData) -> None:
        """Solves the worlds of the step that found no balance once more, see `alone`."""
        if self._alone is None:
            if data.converged.all():
                return
            self._alone = make_alone(self.m, data, self.geoms)
        self._alone.solve(self, data, self.geoms)

    # --- the step ---

    def _record(self, program):
        """Puts one step into a program."""
        self._launcher = program
        m, d, k, st, g = self.m, self.d, self.k, self.st, self.geoms
        n, w = m.nvert, d.nworld
        motion, touched_by, wrench = self._of_geoms
        if self._giving:
            self._giving.begin(program, touched_by)
        self.M.begin_step(program, d.x)
        bounds = [m.options.max_newton, m.options.max_work]
        given = [m.law, m.material.youngs_modulus, *bounds, g.struct, motion, st]
        self._launch(worlds.begin_worlds, w, [*given, touched_by], [self._path, k.flags])
        if self._giving:
            self._giving.begin_pending(program, self._path, self._any_looks)
        if d.memory:
            d.memory.begin_step(program, d.dt, st.softness)
        if self.implicit:
            frames = [d.frame_pos_last, d.frame_mat_last, d.frame_pos, d.frame_mat, d.dt]
            self._launch(nodes.fly_freely, (n, w), [d.x, d.velocity, *frames], [k.world, k.target])
        self._launch(nodes.begin_nodes, (n, w), [m.free_mask, d.increment, st, d.x], [k.begun])
        if self._giving:
            program.branch(self._any_looks, self._find_pending)
        self._try()
        program.loop(self._any_open, self._go_on)
        self._launch(load_path.end_path, w, [st], [self._any_short])
        program.branch(self._any_short, self._stay)
        self._finish(motion, touched_by, wrench)

    def _find_pending(self):
        """A step from the last balance to where the geoms come, of the worlds that look ahead: what touches
        there is known, where the last increment leads it is not."""
        st, giving, on = self.st, self._giving, self._giving.looks
        self._pose(st.load_factor, on)
        self._forces.evaluate(self._launcher, on)
        giving.start_pending(self._launcher)
        self._precondition()
        giving.find_pending(self._launcher)
        self._solve()
        self._launcher.loop(self._solve_on, self._continue_solve)
        self._go_all_the_way()
        giving.end_pending(self._launcher)

    def _try(self):
        """Newton's method where the geoms are, in the active worlds."""
        m, g, w = self.m, self.geoms, self.d.nworld
        if m.has_core and g.count:
            points = len(m.core_vert) + 1
            chunk = points if not m.device.is_cuda else 2 if w < 32 else 64
            dim = (g.count, -(-points // chunk), w)
            core = m.core(w).struct
            constants = [chunk, m.options.max_core_depth, m.core_vert, core, g.struct]
            outputs = [self.st.active, self.st.failed, self.st.deep]
            self._launch(penetration.refuse_deep, dim, constants, outputs)
        self._forces.evaluate(self._launcher, self.st.active, kept=1)
        if self._giving:
            self._giving.tell(self._launcher)
        self._check()
        self._launcher.loop(self._newton_on, self._iterate)
        self._end_try()

    def _go_on(self):
        """The next try of the open worlds."""
        d, k, st, m, g = self.d, self.k, self.st, self.m, self.geoms
        if not (self.implicit or d.memory):  # else rest is not where a skin that is left is
            self._launch(worlds.find_lost, d.nworld, [st], [self._any_lost])
            self._launcher.branch(self._any_lost, self._rest_untouched)
        bounds, passed = [_SHORTEST if g.count else 1.0, m.options.max_work], k.flags[3:5]
        self._launch(load_path.judge_increment, d.nworld, [*bounds, st, passed, self._any_increment])
        self._launch(load_path.keep_geoms, (g.count, d.nworld), [g.struct, st.kept])
        self._launch(nodes.keep_nodes, d.x.shape, [d.x, st.kept], [k.begun])
        self._forces.commit_contacts(self._launcher, st.kept)
        if self._giving:
            self._giving.keep(self._launcher, st.kept)
        self._launcher.branch(self._any_increment, self._start_part)
        self._try()

    def _rest_untouched(self):
        """A skin that all that touched it has left in one step is far from its rest, and found in many parts
        where Newton's method begins at the last balance."""
        d, st = self.d, self.st
        self._launch(nodes.lie_at_rest, d.x.shape, [d.rest_vert, st.moving], [d.x])
        if self._giving:
            self._giving.let_go(self._launcher, st.moving)
            self._pose(st.trial_factor, st.moving)
        self._forces.evaluate(self._launcher, st.moving)
        self._launch(faces.leave_touched, d.outer.touching.shape, [d.outer.touching, st.moving])
        self._launch(worlds.start_at_rest, d.nworld, [self.m.options.max_work, st])

    def _start_part(self):
        """The next load increment of the worlds that are moving."""
        d, st, o = self.d, self.st, self.m.options
        self._launch(
            load_path.start_increment,
            d.nworld,
            [o.max_newton, o.max_work, st, self._any_increment, self._any_lagged],
        )
        self._launch(
            penetration.draw_back, d.nworld, [*self._forces.ball, self.geoms.struct, st.moving], [self._path]
        )
        if self._giving:
            self._giving.find_unknown_wrenches(self._launcher)
            self._place(st.load_factor, self._giving.needs_wrench)
            self._forces.evaluate(self._launcher, self._giving.needs_wrench)
            self._giving.begin_path(self._launcher, self._giving.needs_wrench)
        self._launcher.branch(self._any_lagged, self._lag_friction)
        self._place(st.trial_factor, st.returns)
        self.M.renew(self._launcher, d.x)

    def _lag_friction(self):
        """Tells what friction is bounded by where the worlds are, or where their part begins."""
        bound, on = self.k.bound, self.st.lagged  # others keep the pressure that their tangents have
        self._place(self.st.load_factor, self.st.returns)
        self._launch(faces.forget_bounds, bound.shape, [on, bound])
        self._forces.evaluate(self._launcher, on)
        self._launch(load_path.lag_friction, self.d.nworld, [self.st, self._any_lagged])

    def _place(self, fraction, on):
        """Geoms at a share of their way, nodes where they were last in balance."""
        if self._giving:
            self._giving.go_back(self._launcher, on)
        self._pose(fraction, on)
        self._launch(nodes.return_nodes, self.d.x.shape, [self.k.begun, on], [self.d.x])

    def _pose(self, fraction, on):
        """Geoms at a share of their way, where their bodies go from there."""
        g = self.geoms
        inputs = [self._path, fraction, on, self._bodies]
        self._launch(load_path.place_geoms, (g.count, self.d.nworld), inputs, [g.struct])

    def _stay(self):
        """Forces where the load path ended, and the tangents of what touches, as if it were asked for."""
        self._place(self.st.load_factor, self.st.moving)
        self._forces.evaluate(self._launcher, self.st.moving)
        self._precondition()

    def _end_try(self):
        """Finds the worlds that go on. Balance of an inverted element, or of skin that went through the core,
        is none."""
        m, d, st = self.m, self.d, self.st
        if d.core:
            surface, core = d.core.surface.node, m.core(d.nworld).struct
            inputs = [m.crushed_depth, surface, core, d.x, st.asked]
            self._launch(penetration.crushed_on_core, (len(surface), d.nworld), inputs, [st.failed])
        self._launch(load_path.end_try, d.nworld, [st, self._any_open])

    def _iterate(self):
        self._solve()
        self._launcher.loop(self._solve_on, self._continue_solve)
        self._search()
        self._launcher.loop(self._search_on, self._continue_search)
        self.M.watch_products(self._launcher, self.d.x)
        self._launch(worlds.choose_viscosity, self.d.nworld, [self.m.options.tolerance, self.st])
        self._check()

    def _check(self):
        """Residual, preconditioner and the first direction; which worlds are in balance."""
        m, k, st = self.m, self.k, self.st
        self._precondition()
        bounds = [m.options.tolerance, m.options.max_work, int(m.has_liquid), self.d.rest_pressure]
        self._decide(worlds.judge_balance, [*bounds, k.part, k.worth, st], [self._newton_on])
        if m.has_liquid:
            given = [m.free_mask, self.d.gradient, st]
            self._launch(nodes.correct_pressure, self.d.x.shape, given, [self.d.x, self.d.force])

    def _precondition(self):
        m, d, k, st = self.m, self.d, self.k, self.st
        core = [m.core_surface.start, d.core.node_force] if d.core else [k.no_list, k.no_vector]
        outer, liquid = [m.outer.start, d.outer.node_force], [m.wet_node, self._forces.gradient]
        forces = [d.force, *outer, *core, self._forces.external, *liquid]
        self._launch(
            self._of_nodes.residuals, (k.nchunk, d.nworld),
            [k.chunk, m.free_mask, *forces, d.x, d.rest_vert, k.inertial, st.active],
            [k.r, k.worth, st.touched, self._newton_on],
        )  # fmt: skip
        if self._giving:
            self._giving.settle(self._launcher)
            self._giving.push(self._launcher)
        residual = Residual(k.worth, k.r, self._forces.gradient)
        self.M.update(self._launcher, st, residual, k.p, k.part, self._forces.beside)

    def _solve(self):
        self._launch(krylov.begin_solve, self.d.nworld, [self.st, self._solve_on])
        self._advance_solve(1)

    def _continue_solve(self):
        k, st = self.k, self.st
        self.M.apply(self._launcher, st, k.part, k.r, self._forces.gradient, k.z, k.part)
        self._decide(krylov.choose_beta, [k.part, st])
        self._launch(self._of_krylov.next_direction, self.d.x.shape, [k.z, st, k.p])
        self._advance_solve(0)

    def _advance_solve(self, first):
        """A step of conjugate gradients along p."""
        m, d, k, st, kernels = self.m, self.d, self.k, self.st, self._of_krylov
        self._forces.multiply(self._launcher)
        if self._giving:
            self._giving.resist(self._launcher)
        chunks, gradient = (k.nchunk, d.nworld), self._forces.gradient
        inputs = [k.chunk, k.p, k.q, k.held, gradient, m.wet_node, st.running]
        self._launch(kernels.measure_product, chunks, inputs, [k.part, self._solve_on])
        self._decide(krylov.choose_alpha, [m.options.max_cg, k.part, st], [self._solve_on])
        inputs = [k.chunk, first, k.p, k.q, gradient, m.wet_node, st, k.dx, k.r]
        self._launch(kernels.update_solution, chunks, inputs, [k.part])

    def _search(self):
        self._go_all_the_way()
        self._look()

    def _go_all_the_way(self):
        """Takes the step that the linear solve has found."""
        d, k, first = self.d, self.k, self._of_krylov.first_length
        chunks = (k.nchunk, d.nworld)
        if self._giving:
            self._giving.step(self._launcher)
            self._pose(self.st.trial_factor, self.st.active)
        self._launch(first, chunks, [k.chunk, d.force, k.dx, self.st, d.x], [k.part])

    def _continue_search(self):
        k = self.k
        self._launch(self._of_krylov.move, self.d.x.shape, [k.dx, self.st, self.d.x])
        if self._giving:
            self._giving.move(self._launcher)
            self._pose(self.st.trial_factor, self.st.moving)
        self._look()

    def _look(self):
        d, k = self.d, self.k
        self._forces.evaluate(self._launcher, self.st.moving, kept=1)
        inputs = [k.chunk, d.force, k.dx, self._forces.gradient, self.m.wet_node, self.st]
        self._launch(self._of_krylov.measure_slope, (k.nchunk, d.nworld), inputs, [k.part, self._search_on])
        if self._giving:
            self._giving.add_slope(self._launcher, k.part)
        self._decide(worlds.choose_length, [k.part, self.st], [self._search_on])

    def _finish(self, motion, touched_by, wrench):
        d, k, st, g = self.d, self.k, self.st, self.geoms
        w = d.nworld
        self._forces.beside(
            lambda: self._forces.tell_volume(self._launcher),
            lambda: self._forces.tell_wrench(self._launcher, touched_by, wrench),
            lambda: self._forces.commit_contacts(self._launcher, st.wanted),
        )
        if d.memory:
            d.memory.commit_step(self._launcher, d.x, d.dt, st.failed)
        self._launch(load_path.release_geoms, (g.count, w), [g.struct, self._path, st], [motion])
        frame = [d.frame_pos, d.frame_mat]
        end = [int(self.implicit), st.wanted, d.x, k.world, *frame, d.dt, d.x_last]
        self._launch(nodes.end_nodes, d.x.shape, end, [d.increment, d.velocity])
        if self.implicit:
            self._launch(nodes.end_core, w, frame, [d.frame_pos_last, d.frame_mat_last])
        self._launch(worlds.end_worlds, w, [st])

    # --- launching ---

    def _launch(self, kernel, dim, inputs, outputs=()):
        self._forces.launch(self._launcher, kernel, dim, inputs, outputs)

    def _decide(self, kernel, inputs, outputs=()):
        self._forces.decide(self._launcher, kernel, inputs, outputs)

    def _warm_up(self):
        """Runs what every iteration does once, with no world switched on."""
        self._launcher = Launcher(self.m.device)
        for flag in (self.st.active, self.st.running, self.st.moving, self.st.failed):
            flag.zero_()
        self._forces.evaluate(self._launcher, self.st.active)
        self._check()
        self._solve()
        self._continue_solve()
        self._search()
        self._continue_search()
        self._end_try()
        self.k.flags.zero_()
