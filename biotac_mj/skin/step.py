"""One step of the skin: Newton's method for equilibrium, with preconditioned conjugate gradients.

    step(model, data, geoms, dt)               # poses in, positions and wrenches out

A step consists of kernel launches, with loops and branches that read flags on the device (`program`): a
recorded list on the CPU, a captured graph on CUDA, which may be part of the caller's graph:

    prepare_step(model, data, geoms)           # allocates and compiles
    launch_step(model, data, geoms)            # inside a capture, or without one

Everything that changes between steps is read from device arrays: poses and frictions `geoms.struct.pos, .mat,
.friction` [geom, world], materials `data.rubber`, contact laws `data.laws.struct`, the liquids
`data.worlds.kappa, .natural, .keeps_volume`, `data.dt`, and the pose of the BioTac frame `data.frame_pos,
.frame_mat` (implicit dynamics). Overwrite them, then step.

A world that does not converge is solved in load increments along the geoms' path from the last step. A world
that does not reach the end of the path stops at its last equilibrium (`data.load_factor`), is counted in
`data.worlds.nonconverged` and has its reason in `data.worlds.reason`. A world whose input is not finite keeps
its state. Other worlds are not affected. Worlds that are not `data.worlds.wanted` are skipped."""

import dataclasses
import types
import weakref

import numpy as np
import warp as wp

from ..kernels import add_zeros
from ..threads import single_thread
from .bodies import Bodies
from .compliant_bodies import CompliantBodies
from .contact import faces, penetration
from .contact.meshes import DISTANCES
from .contact.posed import LoadPath
from .contact.touch import BLOCK, CORE, contact_kernels
from .data import SkinData
from .forces import Forces, Vectors
from .geoms import GeomSet
from .model import SkinModel
from .newton import convergence, krylov, line_search, load_path, nodes, worlds
from .precondition import Residual, batched_inverse
from .program import Launcher, Program, compile_ahead, compile_kernels
from .rubber.element_forces import module_for_cuda

_FREE = """
    tolerance max_newton max_cg max_work stick_ratio mass_damping stiffness_damping max_core_depth
""".split()

_LEAST_INCREMENT = 1 / 32  # of the load factor
_SQUEEZED = 0.43  # fraction of the wall's thickness to which `benchmarks/accuracy.py` has measured the error
_PASSING = 1e-2  # tolerance of increments that a step goes through, where bodies give way


def step(
    model: SkinModel,
    data: SkinData,
    geoms: GeomSet,
    dt: float | np.ndarray | None = None,
    core_pos: np.ndarray | None = None,
    core_mat: np.ndarray | None = None,
) -> None:
    """Advances every world to equilibrium at the present poses of the geoms.

    A world that does not converge stops at the last equilibrium on its load path, see `data.load_factor`; it
    is counted in `data.nonconverged` and flagged in `data.converged`. The next step starts from there.

    Args:
      model, data: the skin.
      geoms: touching geoms, with their poses in the BioTac frame at the end of the step.
      dt: time step [s], a number or (nworld,); needed by implicit dynamics and by a Prony series.
      core_pos, core_mat: (nworld, 3) [m], (nworld, 3, 3) pose of the BioTac frame in the world at the end of
        the step, for implicit dynamics; None: it does not move.

    Raises:
      ValueError: geoms of another number of worlds, adhesion beyond the range in which a mesh geom's distance
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


def prepare_step(model: SkinModel, data: SkinData, geoms: GeomSet) -> "SkinStep":
    """Allocates and compiles what `launch_step` needs, once for each geoms and options of the model.

    Raises:
      ValueError: geoms of another number of worlds, options that the data was not made for, or a first call
        during the capture of a graph.
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
    """Modules of a step's kernels on CUDA that take long to compile, with their block sizes, for
    `program.compile_ahead`. shapes: see `GeomSet.shapes`."""
    found = [(contact_kernels(False, False, kind).by_sample.module, BLOCK) for kind in (CORE, shapes)]
    found.append((batched_inverse.invert_kernel.module, batched_inverse.THREADS))
    return [*found, (wp.get_module(DISTANCES), 256), (faces, 256)]


def _refuse_other_options(model, data):
    """Refuses options that changed since the data was made, except tolerances, limits and damping."""
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
    """Launches a step of every world on the device's current stream, inside a captured graph or without one.

    The poses in `geoms.struct` are read when it runs. Raises the errors of `prepare_step`.
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
    """A step of the worlds of `data` with `geoms`, see the module's docstring.

    Raises:
      ValueError: `data` and `geoms` do not fit, see `prepare_step`.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet):
        # it takes long, and the preconditioner is made meanwhile
        compile_ahead(model.device, [module_for_cuda(model.elements, model.rubber_options)])
        # the data owns its steps: a strong reference would keep gigabytes until the next garbage collection
        self.m, self.d, self.geoms = model, weakref.proxy(data), geoms
        if data._vectors is None:
            data._vectors = Vectors(model, data)
        self.k, self.st, self.M = data._vectors, data.worlds, data.preconditioner
        self._forces = Forces(model, self.d, geoms, self.k)
        self._nodes_kernels = nodes.nodes_kernels(data.precision)
        self._krylov_kernels = krylov.krylov_kernels(data.precision)
        self.implicit, w = self._forces.implicit, data.nworld
        self._compliant = CompliantBodies(self._forces) if data.bodies else None
        with wp.ScopedDevice(model.device):
            self._bodies = data.bodies or Bodies()
            self._path = LoadPath()
            add_zeros(self._path, "pos_start pos_end mat_start mat_end", geoms.count, w)
        self._geom_memory = data.geom_memory(geoms.count, geoms.ngroup)
        flags = self.k.flags
        self._newton_on, self._solve_on, self._search_on = (flags[i : i + 1] for i in range(3))
        self._any_open, self._any_increment, self._any_short = (flags[i : i + 1] for i in range(3, 6))
        self._any_lagged, self._any_pending = (flags[i : i + 1] for i in range(6, 8))
        self._graph = None
        compile_kernels(model.device, self._record)
        if model.device.is_cuda:
            self._warm_up()
        self._program = Program(model.device, self._record)
        self._evaluation = self._normal_forces = None

    def run(self) -> None:
        """Runs one step on the current stream."""
        self.d.geom_memory(self.geoms.count, self.geoms.ngroup)  # makes its outputs those of the data
        if not self.m.device.is_cuda:
            with single_thread():  # more threads are not faster on small systems, and change the last bits
                self._program.run()
            return
        self.record()
        wp.capture_launch(self._graph)

    def record(self) -> None:
        """Captures the step as a CUDA graph, which takes some 15 ms, before the first `run` does it. On the
        CPU a step is recorded when it is made."""
        if self.m.device.is_cuda and self._graph is None:
            with wp.ScopedCapture(self.m.device) as capture:
                self._program.run()
            self._graph = capture.graph

    def forget(self) -> None:
        """Frees what was recorded; the step cannot run again."""
        self._program.forget()
        if self._evaluation:
            self._evaluation.forget()

    def launch(self) -> None:
        """Launches a step inside the caller's capture."""
        self._program.run()

    # --- forces and tangent without a step ---

    def evaluate_forces(self) -> None:
        """Evaluates the forces at `data.x` in all worlds."""
        wp.copy(self.k.x_start, self.d.x_last)
        self.st.moving.fill_(1)
        if not self._evaluation:  # recorded, since gradients evaluate the forces once a step
            self._evaluation = Program(self.m.device, self._record_evaluation)
        self._evaluation.run()
        self._launcher = Launcher(self.m.device)  # for further evaluations by the caller

    def normal_force_of_faces(self, touched: np.ndarray) -> np.ndarray:
        """Normal forces (nface,) of the geoms on the outer faces at `data.x` [N], in a single world.

        Args:
          touched: (n,) indices of the faces that are evaluated; the others get 0.
        """
        if self._normal_forces is None:
            self._normal_forces = faces.NormalForces(self._forces.contact, self.geoms.struct, self.d.x)
        return self._normal_forces(touched)

    def _record_evaluation(self, program):
        self._launcher = program
        self._forces.evaluate(self._launcher, self.st.moving)

    def multiply_tangent(self, p: np.ndarray, at_pressure: bool = False) -> np.ndarray:
        """Tangent of all forces at the last `evaluate_forces`, times p (nvert, nworld, 3); zero at fixed
        nodes.

        Args:
          at_pressure: whether the liquid keeps its pressure, instead of resisting changes of its volume.
        """
        k, st = self.k, self.st
        k.p.assign(np.ascontiguousarray(p))
        st.running.fill_(1)
        self._forces.multiply(Launcher(self.m.device))
        q = k.q.numpy().astype(float)
        if self.m.has_liquid and not at_pressure:
            free = self.m.free_mask.numpy()[:, None, None]
            gradient = self.d.gradient.numpy() * free
            pressure_response = st.kappa.numpy() * (gradient * p).sum((0, 2))
            q += pressure_response[:, None] * gradient
        return q

    # --- for callers that solve with another contact tangent: launches into a program ---

    def put_preconditioner(self, program: Launcher) -> None:
        """Updates the preconditioner of the active worlds with `touching` and `block` of the surfaces;
        k.norms must not be zero."""
        k = self.k
        self.M.begin_step(program, self.d.x)
        residual = Residual(k.norms, k.r, self._forces.gradient)
        self.M.update(program, residual, k.z, k.partial, self._forces.in_parallel)

    def put_inverse(self, program: Launcher) -> None:
        """k.z = approximate inverse of the tangent times k.r, zero at fixed nodes, and k.partial r . z and
        gradient . z; k.partial must hold the square of r by chunks."""
        k = self.k
        self.M.apply(program, Residual(k.partial, k.r, self._forces.gradient), k.z, k.partial)

    # --- the step ---

    def _record(self, program):
        """Puts one step into a program."""
        self._launcher = program
        m, d, k, st, g = self.m, self.d, self.k, self.st, self.geoms
        n, w = m.nvert, d.nworld
        motion, touched_by, wrench = self._geom_memory
        if self._compliant:
            self._compliant.begin(program, touched_by)
        self.M.begin_step(program, d.x)
        bounds = [m.options.max_newton, m.options.max_work, int(self._compliant is not None)]
        given = [m.law, m.material.youngs_modulus, *bounds, g.struct, motion, st]
        self._launch(worlds.begin_worlds, w, [*given, touched_by], [self._path, k.flags])
        if self._compliant:
            self._compliant.begin_pending(program, self._path, self._any_pending)
        if d.memory:
            d.memory.begin_step(program, d.dt, st.softness)
        if self.implicit:
            frames = [d.frame_pos_last, d.frame_mat_last, d.frame_pos, d.frame_mat, d.dt]
            self._launch(nodes.predict_free_flight, (n, w), [d.x, d.velocity, *frames], [k.world, k.target])
        self._launch(nodes.begin_nodes, (n, w), [m.free_mask, d.increment, st, d.x], [k.x_start])
        if self._compliant:
            program.branch(self._any_pending, self._find_pending)
        self._try()
        program.loop(self._any_open, self._try_next)
        self._launch(load_path.end_path, w, [bounds[2], st], [self._any_short])
        program.branch(self._any_short, self._stay)
        self._finish(motion, touched_by, wrench)

    def _find_pending(self):
        """First iteration of the worlds with compliant bodies in contact: from the last equilibrium, whose
        contact is known, with the geoms' motion as the load."""
        st, compliant, on = self.st, self._compliant, self._compliant.has_pending
        self._pose(st.load_factor, on)
        self._forces.evaluate(self._launcher, on)
        compliant.start_pending(self._launcher)
        self._precondition()
        compliant.find_pending(self._launcher)
        self._solve()
        self._take_full_step()
        compliant.end_pending(self._launcher)

    def _try(self):
        """Newton's method at the present poses, in the active worlds."""
        m, g, w = self.m, self.geoms, self.d.nworld
        if m.has_core and g.count:
            points = len(m.core_vert) + 1
            chunk = points if not m.device.is_cuda else 2 if w < 32 else 64
            dim = (g.count, -(-points // chunk), w)
            core = m.core(w).struct
            ball = [m.core_center, m.core_radius]
            constants = [chunk, m.options.max_core_depth, m.core_vert, *ball, core, g.struct]
            outputs = [self.st.active, self.st.failed, self.st.deep]
            self._launch(penetration.mark_deep_geoms, dim, constants, outputs)
        self._forces.evaluate(self._launcher, self.st.active, keep_pressure=1)
        if self._compliant:
            self._compliant.compute_wrench(self._launcher)
        self._check()
        self._launcher.loop(self._newton_on, self._iterate)
        self._end_try()

    def _try_next(self):
        """The next try of the open worlds."""
        d, k, st, m, g = self.d, self.k, self.st, self.m, self.geoms
        bounds = [_LEAST_INCREMENT if g.count else 1.0, m.options.max_work]
        inputs = [*bounds, int(self._compliant is not None), st, self._any_open, self._any_increment]
        self._launch(load_path.choose_increment, d.nworld, inputs)
        # slip of new contact counts from the poses at the end of an accepted increment
        poses = [(g.struct.pos, g.struct.pos_last), (g.struct.mat, g.struct.mat_last)]
        for value, out in [*poses, (d.x, k.x_start)]:
            self._set(value, st.accepted, out)
        self._forces.commit_contacts(self._launcher, st.accepted)
        if self._compliant:
            self._compliant.accept(self._launcher, st.accepted)
        self._launcher.branch(self._any_increment, self._start_increment)
        self._try()

    def _start_increment(self):
        """The next load increment of the worlds that are moving."""
        d, st, o = self.d, self.st, self.m.options
        self._launch(
            load_path.start_increment,
            d.nworld,
            [o.max_newton, o.max_work, st, self._any_increment, self._any_lagged],
        )
        self._launch(
            penetration.start_path_outside,
            d.nworld,
            [*self._forces.ball, self.geoms.struct, st.moving],
            [self._path],
        )
        if self._compliant:
            self._compliant.mark_unknown_wrenches(self._launcher)
            self._place(st.load_factor, self._compliant.needs_wrench)
            self._forces.evaluate(self._launcher, self._compliant.needs_wrench)
            self._compliant.begin_path(self._launcher, self._compliant.needs_wrench)
        self._launcher.branch(self._any_lagged, self._lag_friction)
        self._place(st.trial_factor, st.restores)
        self.M.renew(self._launcher, d.x)

    def _lag_friction(self):
        """Records the friction bounds at the present equilibrium, or at the start of the increment."""
        bound, on = self.k.bound, self.st.lagged  # other worlds keep the pressure of their tangents
        self._place(self.st.load_factor, self.st.restores)
        self._launch(faces.clear_bounds, bound.shape, [on, bound])
        self._forces.evaluate(self._launcher, on)
        self._launch(load_path.lag_friction, self.d.nworld, [self.st, self._any_lagged])

    def _place(self, fraction, on):
        """Sets the geoms to a load factor of their path, and the nodes to the last equilibrium."""
        if self._compliant:
            self._compliant.restore(self._launcher, on)
        self._pose(fraction, on)
        self._set(self.k.x_start, on, self.d.x)

    def _pose(self, fraction, on):
        """Sets the geoms to a load factor of their path, moved by their compliant bodies."""
        g = self.geoms
        inputs = [self._path, fraction, on, self._bodies]
        self._launch(load_path.place_geoms, (g.count, self.d.nworld), inputs, [g.struct])

    def _stay(self):
        """Sets nodes and geoms to the end of the load path, and evaluates forces and tangents there."""
        self._place(self.st.load_factor, self.st.moving)
        if self._compliant:
            self._compliant.take_iterate(self._launcher)
            self._pose(self.st.load_factor, self.st.cut_off)
        self._forces.evaluate(self._launcher, self.st.moving)
        self._forces.limit_contacts(self._launcher, self.st.cut_off)
        self._precondition()

    def _end_try(self):
        """Marks the worlds that continue. Equilibrium with an inverted element, or with skin that passed
        through the core, counts as a failure."""
        m, d, st = self.m, self.d, self.st
        if d.core:
            surface, core = d.core.surface.node, m.core(d.nworld).struct
            inputs = [m.crushed_depth, surface, core, d.x, st.unfinished]
            self._launch(penetration.mark_crushed, (len(surface), d.nworld), inputs, [st.failed])
        self._launch(load_path.end_try, d.nworld, [st, self._any_open])

    def _iterate(self):
        self._solve()
        self._search()
        self._launcher.loop(self._search_on, self._continue_search)
        self.M.renew_if_due(self._launcher, self.d.x)
        self._launch(convergence.choose_viscosity, self.d.nworld, [self.m.options.tolerance, self.st])
        self._check()

    def _check(self):
        """Updates residual, preconditioner and the first direction, and tests for convergence."""
        m, k, st = self.m, self.k, self.st
        self._precondition()
        passing = max(m.options.tolerance, _PASSING) if self._compliant else m.options.tolerance
        bounds = [m.options.tolerance, passing, m.options.max_work, int(m.has_liquid), self.d.rest_pressure]
        self._decide(convergence.check_convergence, [*bounds, k.partial, k.norms, st], [self._newton_on])
        if self._compliant:
            self._compliant.keep_iterate(self._launcher)
        if m.has_liquid:
            given = [m.free_mask, self.d.gradient, st]
            self._launch(nodes.correct_pressure, self.d.x.shape, given, [self.d.x, self.d.force])

    def _precondition(self):
        m, d, k, st = self.m, self.d, self.k, self.st
        self._launch(
            self._nodes_kernels.residuals, (k.nchunk, d.nworld),
            [k.chunk, m.free_mask, d.force, self._forces.loads(), d.x, d.rest_vert, k.inertial, st],
            [k.r, k.norms, self._newton_on],
        )  # fmt: skip
        if self._compliant:
            self._compliant.begin_iteration(self._launcher)
        residual = Residual(k.norms, k.r, self._forces.gradient)
        self.M.update(self._launcher, residual, k.p, k.partial, self._forces.in_parallel)

    def _solve(self):
        self._launch(krylov.begin_solve, self.d.nworld, [self.st])
        self._advance_solve(1)
        self._launcher.loop(self._solve_on, lambda: self._advance_solve(0))

    def _advance_solve(self, first):
        """One iteration of conjugate gradients along p."""
        m, d, k, st, kernels = self.m, self.d, self.k, self.st, self._krylov_kernels
        self._forces.multiply(self._launcher)
        if self._compliant:
            self._compliant.soften_product(self._launcher)
        chunks, gradient = (k.nchunk, d.nworld), self._forces.gradient
        inputs = [k.chunk, k.p, k.q, k.viscous_work, gradient, m.wet_node, st.running]
        self._launch(kernels.measure_product, chunks, inputs, [k.partial, self._solve_on])
        self._decide(krylov.choose_alpha, [m.options.max_cg, k.partial, st])
        inputs = [k.chunk, first, k.p, k.q, gradient, m.wet_node, st, k.dx, k.r]
        self._launch(kernels.update_solution, chunks, inputs, [k.partial])
        self.put_inverse(self._launcher)
        self._decide(krylov.choose_beta, [k.partial, st], [self._solve_on])
        self._launch(kernels.next_direction, d.x.shape, [k.z, st, k.p])

    def _search(self):
        self._take_full_step()
        self._measure_slope()

    def _take_full_step(self):
        """Takes the full step of the linear solve."""
        d, k, first = self.d, self.k, self._krylov_kernels.first_length
        chunks = (k.nchunk, d.nworld)
        if self._compliant:
            self._compliant.step(self._launcher)
            self._pose(self.st.trial_factor, self.st.active)
        self._launch(first, chunks, [k.chunk, d.force, k.dx, self.st, d.x], [k.partial])

    def _continue_search(self):
        k = self.k
        self._launch(self._krylov_kernels.move, self.d.x.shape, [k.dx, self.st, self.d.x])
        if self._compliant:
            self._compliant.move(self._launcher)
            self._pose(self.st.trial_factor, self.st.moving)
        self._measure_slope()

    def _measure_slope(self):
        d, k = self.d, self.k
        self._forces.evaluate(self._launcher, self.st.moving, keep_pressure=1)
        inputs = [k.chunk, d.force, k.dx, self._forces.gradient, self.m.wet_node, self.st]
        self._launch(
            self._krylov_kernels.measure_slope, (k.nchunk, d.nworld), inputs, [k.partial, self._search_on]
        )
        if self._compliant:
            self._compliant.add_slope(self._launcher, k.partial)
        self._decide(line_search.choose_length, [k.partial, self.st], [self._search_on])

    def _finish(self, motion, touched_by, wrench):
        d, k, st, g = self.d, self.k, self.st, self.geoms
        w = d.nworld
        self._forces.in_parallel(
            lambda: self._forces.compute_volume(self._launcher),
            lambda: self._forces.compute_wrench(self._launcher, touched_by, wrench),
            lambda: self._forces.commit_contacts(self._launcher, st.wanted),
        )
        m = self.m
        wall = [_SQUEEZED, m.outer.node, m.opposite, d.rest_vert, d.x, d.outer.node_force, st.wanted]
        self._launcher.launch_blocks(faces.find_tier, [w], wall, [st.squeezed, st.tier], worlds.BLOCK)
        if d.memory:
            d.memory.commit_step(self._launcher, d.x, d.dt, st.failed)
        self._launch(load_path.end_geoms, (g.count, w), [g.struct, self._path, st], [motion])
        frame = [d.frame_pos, d.frame_mat]
        end = [int(self.implicit), st.wanted, d.x, k.world, *frame, d.dt, d.x_last]
        self._launch(nodes.end_nodes, d.x.shape, end, [d.increment, d.velocity])
        if self.implicit:
            self._launch(nodes.end_core, w, frame, [d.frame_pos_last, d.frame_mat_last])
        self._launch(worlds.end_worlds, w, [st])

    # --- launching ---

    def _launch(self, kernel, dim, inputs, outputs=()):
        self._forces.launch(self._launcher, kernel, dim, inputs, outputs)

    def _set(self, value, on, out):
        self._launch(nodes.set_where, out.shape, [value, on], [out])

    def _decide(self, kernel, inputs, outputs=()):
        self._forces.decide(self._launcher, kernel, inputs, outputs)

    def _warm_up(self):
        """Runs every kernel of an iteration once, without active worlds."""
        self._launcher = Launcher(self.m.device)
        for flag in (self.st.active, self.st.running, self.st.moving, self.st.failed):
            flag.zero_()
        self._forces.evaluate(self._launcher, self.st.active)
        self._check()
        self._solve()
        self._search()
        self._continue_search()
        self._end_try()
        self.k.flags.zero_()
