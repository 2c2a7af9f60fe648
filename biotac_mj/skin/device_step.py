"""One step of the skin without a look back at the host: recorded once as a CUDA graph and replayed, alone or
inside the caller's own graph.

    skin = DeviceStep(model, data, geoms)      # allocates and compiles
    skin.run()                                 # a step: replays the graph (on the CPU, where it is for tests,
    it runs kernel by kernel)

Everything that changes between steps is read from device arrays: poses and frictions `geoms.struct.pos, .mat,
.friction` [geom, world], materials `data.mu, .lam`, the liquids `data.worlds.kappa, .natural, .holds`,
`data.dt` and the pose of the BioTac frame `data.frame_pos, .frame_mat` (implicit dynamics only). Overwrite
them, then step. Inside a captured step of something else call `step_device(model, data, geoms)`, which only
launches; make it ready with `prepare_device` before the capture begins.

A world whose input is not finite, that has a geom deep inside the core or that finds no balance keeps its
last good state, is counted in `data.worlds.nonconverged` and says why in `data.worlds.reason`; the others do
not notice. Branches and loops are conditional nodes of the graph (CUDA 12.4 and later); worlds that are done
idle inside them."""

import weakref

import warp as wp

from . import device_contact as contact
from . import device_krylov as krylov
from . import device_liquid as liquid
from . import device_nodes as nodes
from . import device_worlds as worlds
from .device_preconditioner import FEW, THREADS_FEW, DevicePreconditioner
from .device_quadratic import device_elements
from .types import mat33, real, vec3

__all__ = ["DeviceStep", "prepare_device", "step_device"]


def prepare_device(model, data, geoms) -> "DeviceStep":
    """Allocates and compiles what `step_device` needs; again only where the model's options or the geoms are
    others.

    Raises:
      ValueError: the data does not live on the device, geoms of another number of worlds, or called first
        while a graph is captured.
    """
    if not data.resident:
        raise ValueError(
            "this data is stepped from the host: make it with SkinData(model, nworld, resident=True), as on "
            "CUDA it is"
        )
    if geoms.nworld != data.nworld:
        raise ValueError(
            f"geoms are for {geoms.nworld} worlds and the data for {data.nworld}: make both for the same "
            "number"
        )
    key = (id(geoms), model.options)
    if key not in data.device_steps:
        if model.device.is_cuda and model.device.is_capturing:
            raise ValueError(
                "the device step is not ready: call prepare_device(model, data, geoms) before the capture "
                "begins"
            )
        data.device_steps[key] = DeviceStep(model, data, geoms)
    return data.device_steps[key]


def step_device(model, data, geoms) -> None:
    """Launches a step of every world on the device's current stream: for use inside a captured graph, or
    without one.

    Takes the poses from `geoms.struct` as they are when it runs; see the module's docstring. Raises what
    `prepare_device` raises."""
    ready = prepare_device(model, data, geoms)
    ready.record()


class _Memory:
    """Vectors of all worlds, shared by the recorded steps of one SkinData."""

    def __init__(self, model, data):
        n, w = model.nvert, data.nworld
        # few worlds need many short sums, many worlds few long ones
        self.chunk = 4 if w < 32 else 8 if w < 256 else 32
        self.nchunk = -(-n // self.chunk)
        inner = 0 if model.inner is None else len(model.inner.face)
        with wp.ScopedDevice(model.device):
            self.r, self.z, self.p, self.q, self.dx = (wp.zeros((n, w), dtype=wp.vec3) for _ in range(5))
            self.base = wp.zeros((n, w), dtype=vec3)
            self.worth = wp.zeros((4, self.nchunk, w), dtype=real)
            self.part = wp.zeros((2, self.nchunk, w), dtype=real)
            self.near = [wp.zeros(s.touching.shape, dtype=int) for s in (data.outer, data.core) if s]
            self.flags = wp.zeros(5, dtype=int)
            shapes = [s.trial_geom.shape for s in (data.outer, data.core) if s and w <= FEW]
            self.by_sample = [(wp.zeros(s, dtype=real), wp.zeros(s, dtype=mat33)) for s in shapes]
            self.no_vector = wp.zeros((0, w), dtype=vec3)
            self.no_list = wp.zeros(0, dtype=int)
            self.no_flag = wp.zeros((0, w), dtype=int)
            self.no_face = wp.zeros(0, dtype=wp.vec3i)
            self.no_block = wp.zeros((0, w), dtype=mat33)
            self.face_chunks = -(-inner // self.chunk)
            self.share = wp.zeros((1, self.face_chunks, w), dtype=real)
            self.wet = wp.zeros((inner, w), dtype=vec3)
            self.wet_corner = wp.zeros((3 * inner, w), dtype=vec3)
            implicit = model.options.dynamics == "implicit"
            self.world, self.target = (wp.zeros((n, w) if implicit else (0, w), dtype=vec3) for _ in range(2))
            self.inertial = wp.zeros((n if implicit else 0, w), dtype=wp.vec3)
            self.node_volume = wp.array(model.elasticity.node_volume, dtype=real)
            self.damped = (
                device_elements(model.elasticity, w) if implicit and model.options.stiffness_damping else None
            )
        self.elements = device_elements(model.elasticity, w)
        capacity = data.contact_capacity or (63 if n <= 8000 else 127)
        self.preconditioner = DevicePreconditioner(model, (data.outer, data.core), w, self.chunk, capacity)


class DeviceStep:
    """A step of the worlds of `data` under `geoms`, see the module's docstring.

    Raises:
      ValueError: `data` and `geoms` do not fit, see `prepare_device`.
    """

    def __init__(self, model, data, geoms):
        # the data owns its steps: a reference back would keep gigabytes until the garbage collector passes
        self.m, self.d, self.geoms = model, weakref.proxy(data), geoms
        if data.device_memory is None:
            data.device_memory = _Memory(model, data)
        self.k, self.st = data.device_memory, data.worlds
        self.implicit = model.options.dynamics == "implicit"
        w, faces = data.nworld, len(model.outer.face)
        self._wrench_chunk = 32
        self._wrench_chunks = -(-faces // self._wrench_chunk)
        with wp.ScopedDevice(model.device):
            self._held_pos = wp.zeros((geoms.count, w), dtype=vec3)
            self._held_mat = wp.zeros((geoms.count, w), dtype=mat33)
            self._part = wp.zeros((2 * geoms.ngroup, self._wrench_chunks, w), dtype=vec3)
        self._of_geoms = data.geom_memory(geoms.count, geoms.ngroup)
        flags = self.k.flags
        self._newton_on, self._solve_on, self._search_on, self._again, self._any_failed = (
            flags[i : i + 1] for i in range(5)
        )
        self._graph = None
        few = model.device.is_cuda and data.nworld <= FEW
        self._streams = [
            wp.Stream(model.device) for _ in range(2 if few else 0)
        ]  # many worlds fill the device without
        self._events = [wp.Event(model.device) for _ in range(3 if few else 0)]
        self._warm_up()

    def run(self):
        """One step, on the current stream."""
        self.d.geom_memory(self.geoms.count, self.geoms.ngroup)  # its outputs are now the data's
        if not self.m.device.is_cuda:
            self.record()
            return
        if self._graph is None:
            with wp.ScopedCapture(self.m.device) as capture:
                self.record()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _launch(self, kernel, dim, inputs, outputs=()):
        threads = THREADS_FEW if self.d.nworld <= FEW else 256
        wp.launch(kernel, dim, inputs, list(outputs), device=self.m.device, block_dim=threads)

    def _decide(self, kernel, inputs, outputs=()):
        """A block of threads for each world."""
        wp.launch_tiled(
            kernel,
            dim=[self.d.nworld],
            inputs=inputs,
            outputs=list(outputs),
            block_dim=worlds.BLOCK,
            device=self.m.device,
        )

    def _beside(self, *branches):
        """Launches up to three functions, which do not need each other's results, as branches of the
        graph."""
        if not self._streams:
            for branch in branches:
                branch()
            return
        main = self.m.device.stream
        main.record_event(self._events[0])
        for stream, done, branch in zip(self._streams, self._events[1:], branches[1:]):
            stream.wait_event(self._events[0])
            with wp.ScopedStream(stream, sync_enter=False):
                branch()
                stream.record_event(done)
        branches[0]()
        for done, _ in zip(self._events[1:], branches[1:]):
            main.wait_event(done)

    def _warm_up(self):
        """Runs every kernel once with no world switched on: compiled, and with torch's workspaces made,
        before anything is captured."""
        for flag in (self.st.active, self.st.running, self.st.moving, self.st.failed):
            flag.zero_()
        self._evaluate(self.st.active)
        self._check()
        self._solve()
        self._continue_solve()
        self._search()
        self._continue_search()
        self._refuse_impossible()
        self.k.flags.zero_()

    # --- the step  ---

    def record(self):
        """Launches one step."""
        m, d, k, st, g = self.m, self.d, self.k, self.st, self.geoms
        n, w = m.nvert, d.nworld
        if m.has_core and g.count:
            chunk = 8 if w < 32 else 64
            dim = (g.count, -(-len(m.core_vert) // chunk), w)
            self._launch(
                contact.contact_inside_core,
                dim,
                [chunk, m.options.max_core_depth, m.core_vert, g.struct],
                [st.deep],
            )
        motion, touched_by, wrench = self._of_geoms
        E = m.material.youngs_modulus
        self._launch(worlds.begin_worlds, w, [m.law, E, g.struct, motion, st, touched_by], [k.flags])
        if self.implicit:
            self._launch(
                nodes.fly_freely,
                (n, w),
                [d.x, d.velocity, d.frame_pos_last, d.frame_mat_last, d.frame_pos, d.frame_mat, d.dt],
                [k.world, k.target],
            )
        self._launch(nodes.begin_nodes, (n, w), [m.free_mask, d.increment, st, d.x])
        self._newton()
        self._launch(worlds.retry_worlds, w, [st, self._again])
        wp.capture_if(self._again, self._second_try)
        self._launch(
            worlds.hold_geoms, w, [g.struct, st], [self._held_pos, self._held_mat, motion, self._any_failed]
        )
        wp.capture_if(self._any_failed, self._stay)
        self._finish(touched_by, wrench)

    def _second_try(self):
        """From where the step began: the guess may have been the trouble."""
        self._launch(nodes.retry_nodes, self.d.x.shape, [self.d.x_last, self.st.active, self.d.x])
        self._newton()

    def _stay(self):
        self._launch(nodes.retry_nodes, self.d.x.shape, [self.d.x_last, self.st.failed, self.d.x])
        self._evaluate(self.st.failed)

    def _newton(self):
        self._evaluate(self.st.active)
        self._check()
        wp.capture_while(self._newton_on, self._iterate)
        self._refuse_impossible()

    def _refuse_impossible(self):
        """Balance of an inverted element, or of skin that went through the core, is none: see
        `solver._Step._possible`."""
        m, d, st = self.m, self.d, self.st
        if m.material.law != "linear":
            self.k.elements.refuse_inverted(d.x, st.asked, st.failed)
        if d.core:
            face, core = d.core.surface.face, m.core(d.nworld).struct
            self._launch(
                contact.crushed_on_core,
                (len(face), d.nworld),
                [m.crushed_depth, face, core, d.x, st.asked],
                [st.failed],
            )

    def _iterate(self):
        self._solve()
        wp.capture_while(self._solve_on, self._continue_solve)
        self._search()
        wp.capture_while(self._search_on, self._continue_search)
        self._check()

    def _check(self):
        """Residual, preconditioner and the first direction; which worlds are in balance."""
        m, d, k, st = self.m, self.d, self.k, self.st
        self._launch(
            nodes.residuals,
            (k.nchunk, d.nworld),
            [
                k.chunk,
                m.free_mask,
                d.force,
                d.outer.node_force,
                d.core.node_force if d.core else k.no_vector,
                self._external(),
                self._gradient(),
                d.x,
                d.rest_vert,
                k.inertial,
                st.active,
            ],
            [k.r, k.worth, k.preconditioner.any_touch, self._newton_on],
        )
        k.preconditioner.update(st, k.worth, k.r, self._gradient(), k.p, k.part, self._beside)
        touch = k.preconditioner.any_touch
        limits = [m.options.tolerance, m.options.max_newton, int(m.has_liquid)]
        self._decide(worlds.judge_balance, [*limits, k.part, k.worth, touch, st], [self._newton_on])

    def _solve(self):
        self._launch(krylov.begin_solve, self.d.nworld, [self.st, self._solve_on])
        self._advance_solve(1)

    def _continue_solve(self):
        k, st = self.k, self.st
        k.preconditioner.apply(st, k.part, k.r, self._gradient(), k.z, k.part)
        self._decide(krylov.choose_beta, [k.part, st])
        self._launch(krylov.next_direction, self.d.x.shape, [k.z, st, k.p])
        self._advance_solve(0)

    def _advance_solve(self, first):
        """A step of conjugate gradients along p."""
        m, d, k, st = self.m, self.d, self.k, self.st
        e = k.elements
        e.product(d.mu, d.lam, d.x, k.p, st.running)
        inertia = wp.vec3d(0.0, 0.0, 0.0)
        if self.implicit:
            inertia = wp.vec3d(m.material.density, m.options.mass_damping, m.options.stiffness_damping)
        self._launch(
            krylov.assemble_product,
            d.x.shape,
            [
                e.start,
                e.slot,
                e.corner,
                *self._blocks(m.outer, d.outer),
                *self._blocks(m.core_surface if d.core else None, d.core),
                *self._wet_faces(),
                m.free_mask,
                inertia,
                k.node_volume,
                d.dt,
                d.x,
                k.p,
                st,
            ],
            [k.q],
        )
        chunks, gradient = (k.nchunk, d.nworld), self._gradient()
        self._launch(
            krylov.measure_product,
            chunks,
            [k.chunk, k.p, k.q, gradient, m.free_mask, st.running],
            [k.part, self._solve_on],
        )
        self._decide(krylov.choose_alpha, [m.options.max_cg, k.part, st], [self._solve_on])
        self._launch(
            krylov.update_solution,
            chunks,
            [k.chunk, first, k.p, k.q, gradient, m.free_mask, st, k.dx, k.r],
            [k.part],
        )

    def _search(self):
        d, k = self.d, self.k
        self._launch(
            krylov.first_length,
            (k.nchunk, d.nworld),
            [k.chunk, d.force, k.dx, self.st, d.x],
            [k.base, k.part],
        )
        self._look()

    def _continue_search(self):
        self._launch(krylov.move, self.d.x.shape, [self.k.base, self.k.dx, self.st, self.d.x])
        self._look()

    def _look(self):
        d, k = self.d, self.k
        self._evaluate(self.st.moving)
        self._launch(
            krylov.measure_slope,
            (k.nchunk, d.nworld),
            [k.chunk, d.force, k.dx, self.st],
            [k.part, self._search_on],
        )
        self._decide(worlds.choose_length, [k.part, self.st], [self._search_on])

    def _finish(self, touched_by, wrench):
        m, d, k, st, g = self.m, self.d, self.k, self.st, self.geoms
        w, o = d.nworld, d.outer
        if m.inner is not None and not m.has_liquid:
            self._launch(worlds.all_on, w, [], [st.moving])
            self._fill(st.moving)  # the cavity's volume is told all the same
        if g.ngroup:
            self._launch(
                contact.partial_wrench,
                (self._wrench_chunks, w),
                [
                    self._wrench_chunk,
                    o.surface.face,
                    m.sample,
                    g.struct,
                    d.x,
                    o.touching,
                    o.trial_geom,
                    o.sample_force,
                ],
                [self._part, touched_by],
            )
            self._launch(contact.sum_wrench, (2 * g.ngroup, w), [self._part], [wrench])
        self._launch(
            contact.commit_contacts,
            o.touching.shape,
            [len(m.sample), o.touching, o.trial_geom, o.trial_anchor, o.kept],
            [o.anchor_geom, o.anchor],
        )
        self._launch(worlds.release_geoms, w, [g.struct, self._held_pos, self._held_mat, st])
        self._launch(
            nodes.end_nodes,
            d.x.shape,
            [int(self.implicit), d.x, k.world, d.frame_pos, d.frame_mat, d.dt, d.x_last],
            [d.increment, d.velocity],
        )
        if self.implicit:
            self._launch(nodes.end_core, w, [d.frame_pos, d.frame_mat], [d.frame_pos_last, d.frame_mat_last])
        self._launch(worlds.end_worlds, w, [st])

    # --- forces  ---

    def _evaluate(self, on):
        """Forces at x in the worlds that are on: elastic, external, contact, core, liquid, inertia."""
        m, d, k, st = self.m, self.d, self.k, self.st
        self._beside(
            lambda: k.elements.force(d.mu, d.lam, d.x, on, st.inverted),
            lambda: self._inside(on),
            lambda: self._contact(d.outer, self.geoms, k.near[0], 0, on),
        )
        none = [k.no_list, k.no_list, k.no_flag, k.no_vector]
        core = [m.core_surface.start, m.core_surface.slot, d.core.touching, d.core.corner] if d.core else none
        wet = (
            [m.inner.start, m.inner.slot, k.wet_corner]
            if m.has_liquid
            else [k.no_list, k.no_list, k.no_vector]
        )
        self._launch(
            nodes.assemble_force,
            d.x.shape,
            [
                k.elements.start,
                k.elements.slot,
                k.elements.corner_force,
                m.outer.start,
                m.outer.slot,
                d.outer.touching,
                d.outer.corner,
                *core,
                *wet,
                self._external(),
                st.pressure,
                on,
            ],
            [d.force, d.outer.node_force, d.core.node_force if d.core else k.no_vector, d.gradient],
        )
        if self.implicit:
            o = m.options
            self._launch(
                nodes.add_inertia,
                d.x.shape,
                [
                    m.material.density,
                    o.mass_damping,
                    k.node_volume,
                    d.dt,
                    k.target,
                    d.x_last,
                    d.x,
                    on,
                    d.force,
                ],
                [k.inertial],
            )
            if k.damped:
                self._launch(nodes.displacement, d.x.shape, [d.x_last, d.x, on], [k.q])
                k.damped.force(d.mu, d.lam, d.x, on, st.inverted)
                k.damped.product(d.mu, d.lam, d.x, k.q, on)
                e = k.damped
                self._launch(
                    nodes.add_damping,
                    d.x.shape,
                    [e.start, e.slot, e.corner, real(o.stiffness_damping), d.dt, on, d.force],
                )

    def _inside(self, on):
        """The skin's inner side: core and liquid."""
        m, d = self.m, self.d
        if d.core:
            self._contact(d.core, m.core(d.nworld), self.k.near[1], 1, on)
        if m.has_liquid:
            self._fill(on)

    def _contact(self, state, geoms, near, still, on):
        m, d, s = self.m, self.d, state.surface
        dim, nsample = state.touching.shape, len(m.sample)
        self._launch(
            contact.cull_faces,
            dim,
            [still, nsample, s.face, geoms.struct, d.x, on, state.seen, state.clearance, state.touching],
            [near, state.trial_geom],
        )
        law = [
            s.face,
            s.area,
            m.sample,
            m.contact_stiffness,
            m.options.stick_ratio,
            geoms.struct,
            d.x,
            d.x_last,
        ]
        held, out = (
            [state.anchor_geom, state.anchor, on, near],
            [state.trial_geom, state.trial_anchor, state.sample_force],
        )
        if d.nworld > FEW:
            self._launch(contact.near_contact, dim, [still, *law, *held, state.seen, state.clearance],
                         [state.corner, state.block, state.touching, *out])  # fmt: skip
            return
        gap, tangent = self.k.by_sample[still]
        self._launch(contact.sample_contact, out[0].shape, [*law, *held], [*out, gap, tangent])
        self._launch(
            contact.sum_samples,
            (dim[0], 3, dim[1]),
            [still, s.face, m.sample, d.x, on, near, state.trial_geom, state.sample_force, gap, tangent],
            [state.corner, state.block, state.touching, state.seen, state.clearance],
        )

    def _fill(self, on):
        """The liquid's volume; with it, its pressure."""
        m, d, k, st = self.m, self.d, self.k, self.st
        c = d.core
        law = [m.contact_stiffness, st.reference]
        if c:
            area, touched = c.surface.area, [c.touching, c.trial_geom, c.sample_force]
        else:
            area, touched = m.inner.area, [k.no_flag, k.no_flag, k.no_vector]
        self._launch(liquid.wet_faces, (k.face_chunks, d.nworld),
                     [k.chunk, m.inner.face, m.core_slot, m.sample, area, *law, *touched, d.x, on],
                     [k.share, k.wet, k.wet_corner])  # fmt: skip
        enclosed = m.liquid_volume - m.rest_volume
        self._decide(
            liquid.settle_pressure,
            [enclosed, k.share, st.offset, st.kappa, st.natural, on],
            [st.volume, st.pressure],
        )
        if m.has_liquid and c:
            self._launch(
                liquid.release_pressure,
                c.touching.shape,
                [m.sample, area, *law, st.pressure, *touched, k.near[1], on, c.block],
            )

    def _external(self):
        return self.k.no_vector if self.d.external is None else self.d.external_device

    def _gradient(self):
        return self.d.gradient if self.m.has_liquid else self.k.no_vector

    def _blocks(self, surface, state):
        k = self.k
        if state is None:
            return [k.no_face, k.no_list, k.no_list, k.no_flag, k.no_block]
        return [surface.face, surface.start, surface.slot, state.touching, state.block]

    def _wet_faces(self):
        m, k = self.m, self.k
        return (
            [m.inner.face, m.inner.start, m.inner.slot, k.wet]
            if m.has_liquid
            else [k.no_face, k.no_list, k.no_list, k.no_vector]
        )
