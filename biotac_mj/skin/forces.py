"""Forces at the nodes of all worlds where they are, and their tangent along a direction: of rubber, contact,
core, liquid and inertia. Launches alone, for a program."""

import itertools
from collections.abc import Sequence

import numpy as np
import warp as wp

from . import liquid
from .contact import broadphase, faces, touch
from .data import SkinData
from .geoms import GeomSet
from .model import SkinModel
from .newton import krylov, nodes, worlds
from .precondition.dense import FEW, LANES_FEW, THREADS_FEW
from .program import Fork, Launcher
from .types import mat33, real, vec3

__all__ = ["Forces", "Vectors"]

_LISTED = 1 << 16  # threads for faces that are listed: each takes several if there are more
_BLOCKS = 1 << 10  # likewise
_FACES = 4  # of the cavity, that a thread adds up for many worlds
_MARKS = itertools.count()  # one for each step's geoms
_WRENCH_CHUNKS = 4, 32  # faces whose forces are summed by one thread, of few worlds on CUDA and otherwise


class Vectors:
    """Vectors of all worlds, shared by the recorded steps of one SkinData."""

    def __init__(self, model: SkinModel, data: SkinData):
        n, w, vec = model.nvert, data.nworld, data.precision.vec
        self.chunk = data.chunk
        self.nchunk = -(-n // self.chunk)
        inner = 0 if model.inner is None else len(model.inner.face)
        implicit = model.options.dynamics == "implicit"
        lawful = model.options.contact_law is not None
        surfaces = [s for s in (data.outer, data.core) if s]
        with wp.ScopedDevice(model.device):
            self.r, self.z, self.p, self.q, self.dx = (wp.zeros((n, w), dtype=vec) for _ in range(5))
            self.begun = wp.zeros((n, w), dtype=vec3)  # where the present part of the way began
            self.worth = wp.zeros((4, self.nchunk, w), dtype=real)
            self.part = wp.zeros((3, self.nchunk, w), dtype=real)
            self.held = wp.zeros((n, w), dtype=data.precision.scalar)
            self.near = [wp.zeros(s.touching.shape, dtype=int) for s in surfaces]
            self.flags = wp.zeros(9, dtype=int)
            self.no_vector = wp.zeros((0, w), dtype=vec3)
            self.no_list = wp.zeros(0, dtype=int)
            self.no_flag = wp.zeros((0, w), dtype=int)
            self.no_face = wp.zeros(0, dtype=wp.vec3i)
            self.no_block = wp.zeros((0, w), dtype=mat33)
            # friction that samples may bear at most, as it was where a part of the way began [N]
            self.bound = wp.zeros((len(model.outer.face) * len(model.sample), w), dtype=real)
            self.no_bound = wp.zeros((0, w), dtype=real)
            self.corner_push = wp.zeros((3 * len(model.outer.face) if lawful else 0, w), dtype=real)
            few = model.device.is_cuda and w <= FEW
            self.face_chunk = 1 if few else data.chunk if w < 256 else _FACES
            self.face_chunks = -(-inner // self.face_chunk)
            self.fraction = wp.zeros((1, self.face_chunks, w), dtype=real)
            self.wet = wp.zeros((inner, w), dtype=vec3)
            self.wet_corner = wp.zeros((3 * inner, w), dtype=vec3)
            self.world, self.target = (wp.zeros((n if implicit else 0, w), dtype=vec3) for _ in range(2))
            self.inertial = wp.zeros((n if implicit else 0, w), dtype=vec)
            self.node_volume = wp.array(model.elements.node_volume, dtype=real)
        self.elements = data.element_forces()
        damped = implicit and model.options.stiffness_damping
        self.damped = data.element_forces() if damped else None


class Forces:
    """Of the worlds of `data` under `geoms`.

    Attributes:
      ball: centre [m] and radius [m] around the skin.
      beside: launches functions that do not need each other's results.
      wrench_chunk, wrench_chunks: faces whose forces are summed by one thread, and how often that is.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet, vectors: Vectors):
        self.m, self.d, self.geoms, self.k, self.st = model, data, geoms, vectors, data.worlds
        self._of_nodes = nodes.nodes_kernels(data.precision)
        self._of_krylov = krylov.krylov_kernels(data.precision)
        self.implicit = model.options.dynamics == "implicit"
        few = model.device.is_cuda and data.nworld <= FEW  # many worlds fill the device without
        self.beside = Fork(model.device, few).run
        self.wrench_chunk = _WRENCH_CHUNKS[not few]
        self._lanes = LANES_FEW if few else 1
        self._summed = *data.x.shape, self._lanes
        self.wrench_chunks = -(-len(model.outer.face) // self.wrench_chunk)
        with wp.ScopedDevice(model.device):
            self._part = wp.zeros((2 * geoms.ngroup, self.wrench_chunks, data.nworld), dtype=vec3)
        self._lawless = faces.empty_laws(model.device)
        rest = model.rest.vert
        center = (rest.min(0) + rest.max(0)) / 2
        self.ball = vec3(*center), float(np.linalg.norm(rest - center, axis=1).max())
        self._mark = next(_MARKS)
        self._surfaces = [self._surface(data.outer, geoms.count, data.laws.struct, vectors.bound)]
        self._surfaces += [self._surface(data.core, 1, self._lawless, vectors.no_bound)]

    def _surface(self, state, ngeom, laws, bound):
        """Clearances and contact of a surface."""
        if state is None:
            return None
        cache, (center, radius) = broadphase.ClearanceCache(), self.ball
        for name in broadphase.ClearanceCache.vars:
            setattr(cache, name, getattr(state.clearances, name))
        cache.center, cache.radius = center, 2.0 * radius
        with wp.ScopedDevice(self.m.device):
            cache.pos, cache.mat = (wp.zeros((ngeom, self.d.nworld), dtype=t) for t in (vec3, mat33))
        m, stiffness = self.m, self.st.contact_stiffness
        law = [m.sample, m.options.stick_ratio, stiffness, laws, self.k.begun, bound]
        return cache, state.contact(*law)

    @property
    def contact(self) -> faces.Contact:
        """Of the outer surface."""
        return self._surfaces[0][1]

    @property
    def external(self) -> wp.array:
        """Forces that somebody adds at the nodes, of length zero without."""
        return self.k.no_vector if self.d.external is None else self.d.external

    @property
    def gradient(self) -> wp.array:
        """Of the liquid's volume, of length zero without."""
        return self.d.gradient if self.m.has_liquid else self.k.no_vector

    def launch(
        self,
        program: Launcher,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence = (),
    ) -> None:
        """A kernel over dim."""
        threads = THREADS_FEW if self.d.nworld <= FEW else 256
        program.launch(kernel, dim, inputs, outputs, threads)

    def decide(self, program: Launcher, kernel: wp.Kernel, inputs: Sequence, outputs: Sequence = ()) -> None:
        """A block of threads for each world."""
        program.launch_blocks(kernel, [self.d.nworld], inputs, outputs, worlds.BLOCK)

    def evaluate(self, program: Launcher, on: wp.array, kept: int = 0) -> None:
        """Forces at x in the worlds that are on: elastic, external, contact, core, liquid, inertia. kept:
        1 while Newton's method has a pressure of its own in the tangent."""
        m, d, k, st = self.m, self.d, self.k, self.st
        self.beside(
            lambda: k.elements.push_corners(program, d.x, on, st.inverted),
            lambda: self._inside(program, on, kept),
            lambda: self._contact(program, d.outer, self.geoms, k.near[0], 0, on),
        )
        none = [k.no_list, k.no_list, k.no_flag, k.no_vector]
        core, wet = none, [k.no_list, k.no_list, k.no_vector]
        if d.core:
            core = [m.core_surface.start, m.core_surface.slot, d.core.touching, d.core.corner]
        if m.has_liquid:
            wet = [m.inner.start, m.inner.slot, k.wet_corner]
        inside = [k.elements.start, k.elements.slot, k.elements.corner_force]
        outside = [m.outer.start, m.outer.slot, d.outer.touching, d.outer.corner]
        self.launch(
            program, nodes.assemble_force, self._summed,
            [self._lanes, *inside, *outside, *core, *wet, self.external, st.pressure, on],
            [d.force, d.outer.node_force, d.core.node_force if d.core else k.no_vector, d.gradient],
        )  # fmt: skip
        if self.implicit:
            self._resist_motion(program, on)

    def multiply(self, program: Launcher) -> None:
        """Tangent of all forces times p, but for what the liquid's pressure changes by."""
        m, d, k, st = self.m, self.d, self.k, self.st
        e = k.elements
        e.multiply_corners(program, d.x, k.p, st.running)
        inertia = wp.vec3d(0.0, 0.0, 0.0)
        if self.implicit:
            inertia = wp.vec3d(1.0, m.options.mass_damping, m.options.stiffness_damping)
        wet = [k.no_face, k.no_list, k.no_list, k.no_vector]
        if m.has_liquid:
            wet = [m.inner.face, m.inner.start, m.inner.slot, k.wet]
        surfaces = [
            *self._blocks(m.outer, d.outer),
            *self._blocks(m.core_surface if d.core else None, d.core),
        ]
        self.launch(
            program,
            self._of_krylov.assemble_product,
            self._summed,
            [
                self._lanes,
                e.start,
                e.slot,
                e.corner,
                *surfaces,
                *wet,
                m.free_mask,
                inertia,
                k.node_volume,
                d.dt,
                d.x,
                k.p,
                st,
            ],
            [k.q, k.held],
        )

    def tell_volume(self, program: Launcher) -> None:
        """Of a cavity without liquid, whose volume no force has asked for."""
        if self.m.inner is not None and not self.m.has_liquid:
            self.launch(program, worlds.all_on, self.d.nworld, [], [self.st.moving])
            self._fill(program, self.st.moving)

    def tell_wrench(self, program: Launcher, touched_by: wp.array, wrench: wp.array) -> None:
        """On the groups of geoms, and which geoms touch, of the forces that were evaluated last."""
        d, g = self.d, self.geoms
        if g.ngroup:
            inputs = [self.wrench_chunk, g.struct, d.x, self.contact]
            chunks = self.wrench_chunks, d.nworld
            self.launch(program, faces.partial_wrench, chunks, inputs, [self._part, touched_by])
            sums = [2 * g.ngroup, d.nworld]
            program.launch_blocks(faces.sum_wrench, sums, [self._part], [wrench], worlds.BLOCK)

    def commit_contacts(self, program: Launcher, on: wp.array) -> None:
        """What friction remembers, where a balance was found."""
        self.launch(program, faces.commit_contacts, self.d.outer.touching.shape, [on], [self.contact])

    def _resist_motion(self, program, on):
        """Inertia and damping."""
        d, k, o, kernels = self.d, self.k, self.m.options, self._of_nodes
        mass = [self.st.density, o.mass_damping, k.node_volume, d.dt]
        positions = [k.target, d.x_last, d.x]
        self.launch(program, kernels.add_inertia, d.x.shape, [*mass, *positions, on, d.force], [k.inertial])
        e = k.damped
        if e:
            self.launch(program, kernels.displacement, d.x.shape, [d.x_last, d.x, on], [k.q])
            e.push_corners(program, d.x, on, self.st.inverted)
            e.multiply_corners(program, d.x, k.q, on)
            inputs = [e.start, e.slot, e.corner, o.stiffness_damping, d.dt, on, d.force]
            self.launch(program, kernels.add_damping, d.x.shape, inputs)

    def _inside(self, program, on, kept):
        """The skin's inner side: core and liquid."""
        m, d = self.m, self.d
        if d.core:
            self._contact(program, d.core, m.core(d.nworld), self.k.near[1], 1, on)
        if m.has_liquid:
            self._fill(program, on, kept)

    def _contact(self, program, state, geoms, near, still, on):
        """Contact of one surface; the core is a geom that never moves."""
        m, d, k, s, on_cuda = self.m, self.d, self.k, state.surface, self.m.device.is_cuda
        cache, contact = self._surfaces[still]
        laws, shapes = contact.laws, geoms.shapes
        if shapes == touch.SOLIDS and not on_cuda:  # which takes the core's kernels anyway
            shapes = touch.MESHES
        kernels = touch.contact_kernels(bool(len(laws.reach)), bool(len(laws.smoothing)), shapes)
        dim, nsample = state.touching.shape, len(m.sample)
        threads = min(_LISTED, dim[0] * dim[1]) if on_cuda else 1
        self.launch(program, broadphase.track_geoms, d.nworld, [self._mark, geoms.struct, on], [cache])
        self.launch(program, broadphase.list_unknown, dim, [contact, d.x, on], [cache, near])
        unknown = [threads, geoms.struct, d.x]
        self.launch(program, broadphase.list_near, threads, unknown, [cache, contact, near])
        if len(laws.reach):
            inputs = [geoms.struct, d.x, on, near, contact]
            self.launch(program, faces.push, dim, inputs, [k.corner_push])
            self.launch(program, faces.sum_pushes, d.x.shape, [s.start, s.slot, k.corner_push, on], [laws])
        law = [geoms.struct, d.x, self.st.slips]
        if on_cuda:
            blocks = min(_BLOCKS, -(-dim[0] * dim[1] * nsample // touch.BLOCK))
            program.launch_blocks(kernels.by_sample, [blocks], [blocks, *law], [cache, contact], touch.BLOCK)
        else:
            self.launch(program, kernels.by_face, threads, [threads, *law], [cache, contact])

    def _fill(self, program, on, kept=0):
        """The liquid's volume; with it, its pressure."""
        m, d, k, st = self.m, self.d, self.k, self.st
        c = d.core
        law = [st.contact_stiffness, st.reference]
        area, touched = m.inner.area, [k.no_flag, k.no_flag, k.no_vector]
        if c:
            area, touched = c.surface.area, [c.touching, c.trial_geom, c.sample_force]
        self.launch(
            program, liquid.wet_faces, (k.face_chunks, d.nworld),
            [k.face_chunk, m.inner.face, m.core_slot, m.sample, area, *law, *touched, d.x, on],
            [k.fraction, k.wet, k.wet_corner],
        )  # fmt: skip
        enclosed = m.liquid_volume - m.rest_volume
        inputs = [enclosed, k.fraction, st.offset, st.kappa, st.natural, kept, on]
        self.decide(program, liquid.settle_pressure, inputs, [st.volume, st.pressure, st.borne])
        if m.has_liquid and c:
            inputs = [m.sample, area, *law, st.borne, *touched, k.near[1], on, c.block]
            self.launch(program, liquid.release_pressure, c.touching.shape, inputs)

    def _blocks(self, surface, state):
        k = self.k
        if state is None:
            return [k.no_face, k.no_list, k.no_list, k.no_flag, k.no_block]
        return [surface.face, surface.start, surface.slot, state.touching, state.block]
