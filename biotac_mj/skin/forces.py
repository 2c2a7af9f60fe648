"""Forces at the nodes of all worlds, and their tangent times a direction: rubber, contact, core, liquid and
inertia. All methods put launches into a program."""

import itertools
from collections.abc import Sequence

import numpy as np
import warp as wp

from ..kernels import add_zeros, set_fields
from . import liquid
from .contact import broadphase, faces, touch
from .data import SkinData
from .geoms import GeomSet
from .model import SkinModel
from .newton import krylov, nodes, worlds
from .program import FEW, LANES_FEW, THREADS_FEW, Fork, Launcher
from .types import real, vec3

_LISTED = 1 << 16  # most threads for listed faces: each takes several faces if there are more
_BLOCKS = 1 << 10  # most blocks of threads, likewise
_FACES = 4  # faces of the cavity that one thread sums, with many worlds
_MARKS = itertools.count()  # a number for each step's geoms
_WRENCH_CHUNKS = 4, 32  # faces whose forces one thread sums: with few worlds on CUDA, otherwise


class Vectors:
    """Vectors of all worlds, shared by the recorded steps of one SkinData."""

    def __init__(self, model: SkinModel, data: SkinData):
        n, w, vec = model.nvert, data.nworld, data.precision.vec
        self.chunk = data.chunk
        self.nchunk = -(-n // self.chunk)
        inner = 0 if model.inner is None else len(model.inner.face)
        implicit = model.options.dynamics == "implicit"
        has_law = model.options.contact_law is not None
        surfaces = [s for s in (data.outer, data.core) if s]
        with wp.ScopedDevice(model.device):
            self.r, self.z, self.p, self.q, self.dx = (wp.zeros((n, w), dtype=vec) for _ in range(5))
            self.x_start = wp.zeros((n, w), dtype=vec3)  # nodes at the start of the load increment
            self.norms = wp.zeros((4, self.nchunk, w), dtype=real)
            self.partial = wp.zeros((3, self.nchunk, w), dtype=real)
            self.viscous_work = wp.zeros((n, w), dtype=data.precision.scalar)
            self.near = [wp.zeros(s.touching.shape, dtype=int) for s in surfaces]
            self.flags = wp.zeros(8, dtype=int)
            # bound of each sample's friction at the start of the load increment [N]
            self.bound = wp.zeros((len(model.outer.face) * len(model.sample), w), dtype=real)
            self.corner_normal_force = wp.zeros((3 * len(model.outer.face) if has_law else 0, w), dtype=real)
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
    """Forces of the worlds of `data` with `geoms`.

    Attributes:
      ball: centre [m] and radius [m] of a ball around the skin.
      in_parallel: launches independent functions.
      wrench_chunk, wrench_chunks: faces whose forces one thread sums, and the number of such chunks.
      node_forces: `SurfaceForces` of the outer surface and of the core's, and `LiquidForces`.
    """

    def __init__(self, model: SkinModel, data: SkinData, geoms: GeomSet, vectors: Vectors):
        self.m, self.d, self.geoms, self.k, self.st = model, data, geoms, vectors, data.worlds
        self._nodes_kernels = nodes.nodes_kernels(data.precision)
        self._krylov_kernels = krylov.krylov_kernels(data.precision)
        self.implicit = model.options.dynamics == "implicit"
        few = model.device.is_cuda and data.nworld <= FEW  # more worlds fill the device by themselves
        self.in_parallel = Fork(model.device, few).run
        self.wrench_chunk = _WRENCH_CHUNKS[not few]
        self._lanes = LANES_FEW if few else 1
        self._summed = *data.x.shape, self._lanes
        self.wrench_chunks = -(-len(model.outer.face) // self.wrench_chunk)
        with wp.ScopedDevice(model.device):
            self._partial_wrench = wp.zeros((2 * geoms.ngroup, self.wrench_chunks, data.nworld), dtype=vec3)
        elements, self.node_forces = vectors.elements, self._node_forces()
        self._slots = set_fields(
            nodes.NodeSlots(), lanes=self._lanes, start=elements.start, slot=elements.slot
        )
        self._no_laws = faces.empty_laws(model.device)
        rest = model.rest.vert
        center = (rest.min(0) + rest.max(0)) / 2
        self.ball = vec3(*center), float(np.linalg.norm(rest - center, axis=1).max())
        self._mark = next(_MARKS)
        self._surfaces = [self._surface(data.outer, geoms.count, data.laws.struct, vectors.bound)]
        self._surfaces += [self._surface(data.core, 1, self._no_laws, None)]

    def _surface(self, state, ngeom, laws, bound):
        """`ClearanceCache` and `Contact` of a surface."""
        if state is None:
            return None
        cache, (center, radius) = broadphase.ClearanceCache(), self.ball
        for name in broadphase.ClearanceCache.vars:
            setattr(cache, name, getattr(state.clearances, name))
        cache.center, cache.radius = center, 2.0 * radius
        with wp.ScopedDevice(self.m.device):
            add_zeros(cache, "pos mat", ngeom, self.d.nworld)
        m, stiffness = self.m, self.st.contact_stiffness
        law = [m.sample, m.options.stick_ratio, stiffness, laws, self.k.x_start, bound]
        return cache, state.contact(*law)

    def loads(self) -> nodes.Loads:
        """What acts on the nodes."""
        out = nodes.Loads()
        out.outer, out.core, out.liquid = self.node_forces
        if self.d.external is not None:
            out.external = self.d.external
        return out

    @property
    def contact(self) -> faces.Contact:
        """`Contact` of the outer surface."""
        return self._surfaces[0][1]

    @property
    def gradient(self) -> wp.array | None:
        """Gradient of the liquid's volume [node, world] [m^2]; None without a liquid."""
        return self.d.gradient if self.m.has_liquid else None

    def launch(
        self,
        program: Launcher,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence = (),
    ) -> None:
        """Launches a kernel over dim."""
        threads = THREADS_FEW if self.d.nworld <= FEW else 256
        program.launch(kernel, dim, inputs, outputs, threads)

    def decide(self, program: Launcher, kernel: wp.Kernel, inputs: Sequence, outputs: Sequence = ()) -> None:
        """Launches a kernel with a block of threads for each world."""
        program.launch_blocks(kernel, [self.d.nworld], inputs, outputs, worlds.BLOCK)

    def evaluate(self, program: Launcher, on: wp.array, keep_pressure: int = 0) -> None:
        """Evaluates all forces at x in the worlds that are on. keep_pressure: 1 while the tangent keeps the
        pressure that Newton's method predicts."""
        d, k, st = self.d, self.k, self.st
        self.in_parallel(
            lambda: k.elements.evaluate_corners(program, d.x, on, st.inverted),
            lambda: self._evaluate_inside(program, on, keep_pressure),
            lambda: self._evaluate_contact(program, d.outer, self.geoms, k.near[0], 0, on),
        )
        self.launch(
            program, nodes.assemble_force, self._summed,
            [self._slots, k.elements.corner_force, d.external, st.pressure, on, *self.node_forces],
            [d.force],
        )  # fmt: skip
        if self.implicit:
            self._resist_motion(program, on)

    def multiply(self, program: Launcher) -> None:
        """q = tangent of all forces times p, at constant pressure of the liquid."""
        m, d, k, st = self.m, self.d, self.k, self.st
        e = k.elements
        e.multiply_corners(program, d.x, k.p, st.running)
        inputs = [self._slots, e.corner, *self.node_forces, m.free_mask, self._inertia(), d.x, k.p, st]
        self.launch(
            program, self._krylov_kernels.assemble_product, self._summed, inputs, [k.q, k.viscous_work]
        )

    def _inertia(self):
        o, out = self.m.options, krylov.Inertia()
        out.on, out.node_volume, out.dt = int(self.implicit), self.k.node_volume, self.d.dt
        if self.implicit:
            out.mass_damping, out.stiffness_damping = o.mass_damping, o.stiffness_damping
        return out

    def compute_volume(self, program: Launcher) -> None:
        """Computes the volume of a cavity without liquid, which no force needs."""
        if self.m.inner is not None and not self.m.has_liquid:
            self.launch(program, worlds.all_on, self.d.nworld, [], [self.st.moving])
            self._fill(program, self.st.moving)

    def compute_wrench(self, program: Launcher, touched_by: wp.array, wrench: wp.array) -> None:
        """Computes the wrenches on the groups of geoms from the last evaluation, and marks geoms that
        touch."""
        d, g = self.d, self.geoms
        if g.ngroup:
            inputs = [self.wrench_chunk, g.struct, d.x, self.contact]
            chunks = self.wrench_chunks, d.nworld
            self.launch(program, faces.partial_wrench, chunks, inputs, [self._partial_wrench, touched_by])
            sums = [2 * g.ngroup, d.nworld]
            program.launch_blocks(faces.sum_wrench, sums, [self._partial_wrench], [wrench], worlds.BLOCK)

    def limit_contacts(self, program: Launcher, on: wp.array) -> None:
        """Limits the contact forces of the last evaluation to those that the skin balances."""
        outer = self.d.outer
        inputs = [self.m.free_mask, self.d.force, outer.forces.node_force, on]
        self.launch(program, faces.limit_contacts, outer.touching.shape, inputs, [self.contact])

    def commit_contacts(self, program: Launcher, on: wp.array) -> None:
        """Stores the friction anchors of an equilibrium."""
        self.launch(program, faces.commit_contacts, self.d.outer.touching.shape, [on], [self.contact])

    def _resist_motion(self, program, on):
        """Adds inertia and damping to the forces."""
        d, k, o, kernels = self.d, self.k, self.m.options, self._nodes_kernels
        mass = [self.st.density, o.mass_damping, k.node_volume, d.dt]
        positions = [k.target, d.x_last, d.x]
        self.launch(program, kernels.add_inertia, d.x.shape, [*mass, *positions, on, d.force], [k.inertial])
        e = k.damped
        if e:
            self.launch(program, kernels.displacement, d.x.shape, [d.x_last, d.x, on], [k.q])
            e.evaluate_corners(program, d.x, on, self.st.inverted)
            e.multiply_corners(program, d.x, k.q, on)
            inputs = [e.start, e.slot, e.corner, o.stiffness_damping, d.dt, on, d.force]
            self.launch(program, kernels.add_damping, d.x.shape, inputs)

    def _evaluate_inside(self, program, on, keep_pressure):
        """Evaluates contact with the core, and the liquid."""
        m, d = self.m, self.d
        if d.core:
            self._evaluate_contact(program, d.core, m.core(d.nworld), self.k.near[1], 1, on)
        if m.has_liquid:
            self._fill(program, on, keep_pressure)

    def _evaluate_contact(self, program, state, geoms, near, surface, on):
        """Contact of one surface; the core is a geom that never moves."""
        m, d, k, s, on_cuda = self.m, self.d, self.k, state.surface, self.m.device.is_cuda
        cache, contact = self._surfaces[surface]
        laws = contact.laws
        # fewer shapes save registers, of which the CPU needs none: it has one kernel for all
        shapes = geoms.shapes if on_cuda or geoms.shapes == touch.CORE else touch.SKINS
        kernels = touch.contact_kernels(bool(len(laws.reach)), bool(len(laws.smoothing)), shapes)
        dim, nsample = state.touching.shape, len(m.sample)
        threads = min(_LISTED, dim[0] * dim[1]) if on_cuda else 1
        self.launch(program, broadphase.track_geoms, d.nworld, [self._mark, geoms.struct, on], [cache])
        self.launch(program, broadphase.list_unknown, dim, [contact, d.x, on], [cache, near])
        unknown = [threads, geoms.struct, d.x]
        self.launch(program, broadphase.list_near, threads, unknown, [cache, contact, near])
        if len(laws.reach):
            inputs = [geoms.struct, d.x, on, near, contact]
            self.launch(program, faces.normal_forces, dim, inputs, [k.corner_normal_force])
            inputs = [s.start, s.slot, k.corner_normal_force, on]
            self.launch(program, faces.sum_normal_forces, d.x.shape, inputs, [laws])
        law = [geoms.struct, d.x, self.st.friction_mode]
        if on_cuda:
            blocks = min(_BLOCKS, -(-dim[0] * dim[1] * nsample // touch.BLOCK))
            program.launch_blocks(kernels.by_sample, [blocks], [blocks, *law], [cache, contact], touch.BLOCK)
        else:
            self.launch(program, kernels.by_face, threads, [threads, *law], [cache, contact])

    def _fill(self, program, on, keep_pressure=0):
        """Computes the liquid's volume and pressure."""
        m, d, k, st = self.m, self.d, self.k, self.st
        c = d.core
        law = [st.contact_stiffness, st.reference]
        area, touched = m.inner.area, [None, None, None]
        if c:
            area, touched = c.surface.area, [c.touching, c.trial_geom, c.sample_force]
        inner = set_fields(
            liquid.InnerFaces(), face=m.inner.face, slot=m.core_slot, sample=m.sample, area=area
        )
        self.launch(
            program, liquid.wet_faces, (k.face_chunks, d.nworld),
            [k.face_chunk, inner, *law, *touched, d.x, on],
            [k.fraction, k.wet, k.wet_corner],
        )  # fmt: skip
        enclosed = m.liquid_volume - m.rest_volume
        inputs = [enclosed, k.fraction, st.offset, st.kappa, st.natural, keep_pressure, on]
        self.decide(program, liquid.settle_pressure, inputs, [st.volume, st.pressure, st.tangent_pressure])
        if m.has_liquid and c:
            inputs = [m.sample, area, *law, st.tangent_pressure, *touched, k.near[1], on, c.block]
            self.launch(program, liquid.release_pressure, c.touching.shape, inputs)

    def _node_forces(self):
        """Structs of the outer surface, the core's surface and the liquid, empty where there is none."""
        m, d, k = self.m, self.d, self.k
        liquid = nodes.LiquidForces()
        if m.has_liquid:
            set_fields(liquid, face=m.inner.face, start=m.inner.start, slot=m.inner.slot, node=m.wet_node)
            set_fields(liquid, wet=k.wet, corner=k.wet_corner, gradient=d.gradient)
        core = d.core.forces if d.core else nodes.SurfaceForces()
        return d.outer.forces, core, liquid
