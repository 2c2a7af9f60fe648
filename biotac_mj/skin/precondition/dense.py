"""The preconditioner of `sparse.py` for all worlds at once and without reads by the host, for CUDA.

Woodbury's identity with the inverse of the undeformed stiffness: first the displacements u of the touching
nodes and the liquid by the residual, then their forces q = (I + D W)^-1 D u, which are subtracted from the
residual. G = (I + D W)^-1 D is computed explicitly, so that it is applied by one short product. The inverse
is that of `block_inverse`; for nearly incompressible rubber it is pushed forward, see `pushed_forward`."""

import functools
import typing
from collections.abc import Callable

import numpy as np
import warp as wp

from ..newton.nodes import SurfaceForces
from ..newton.worlds import Worlds
from ..program import FEW, LANES_FEW, THREADS_FEW, Launcher
from ..types import SINGLE
from . import Preconditioner, Residual, body_tangent, right_hand_sides, touching_nodes, woodbury
from .inverse import Inverse

if typing.TYPE_CHECKING:
    from ..bodies import Bodies
    from ..geoms import GeomSet
    from ..newton.bodies import BodyContact


class DensePreconditioner(Preconditioner):
    """The dense preconditioner of all worlds of one SkinData, see `precondition.Preconditioner`.

    Attributes:

    Args:
      model: the SkinModel.
      surfaces: (outer, core) contact states; core may be None.
      st: Worlds.
      chunk: nodes summed by one thread.
      capacity: most touching nodes of a Woodbury system; conjugate gradients correct for others, in more
        iterations.
      bodies, body_contact: of compliant bodies; None: poses are prescribed.
    """

    precision = SINGLE

    def __init__(
        self,
        model: typing.Any,
        surfaces: tuple,
        st: Worlds,
        chunk: int,
        capacity: int,
        bodies: "Bodies | None" = None,
        body_contact: "BodyContact | None" = None,
    ):
        nworld = st.softness.shape[0]
        self._bodies, self._body_contact = bodies, body_contact
        self.m, self.nworld, self.chunk, self.capacity = model, nworld, chunk, capacity
        self.device = model.device
        self._launch = functools.partial(_launch, THREADS_FEW if nworld <= FEW else 256)
        self.liquid = int(model.has_liquid)
        n = model.nvert
        self._nodes = (n, nworld)
        index = np.full(n, -1, np.int32)
        index[model.free] = np.arange(len(model.free))
        size = self.liquid + 3 * capacity
        with wp.ScopedDevice(self.device):
            self._free = wp.array(index, dtype=int)
            self.slot = wp.zeros(self._nodes, dtype=int)
            self.node = wp.zeros((capacity, nworld), dtype=int)
            self._found, self._found_count = wp.zeros(self._nodes, dtype=int), wp.zeros(nworld, dtype=int)
            self.size = wp.zeros(nworld, dtype=int)
            self.full = wp.zeros(1, dtype=int)
            self._norm = wp.zeros((2, nworld), dtype=float)
            self._largest = wp.zeros(nworld, dtype=float)
            self._ring = model.ring
            links = nworld, capacity, self._ring.shape[1]
            self._link, self._spring = wp.zeros(links, dtype=int), wp.zeros(links, dtype=wp.mat33)
            self._W, self._A, self._G = (wp.zeros((nworld, size, size), dtype=float) for _ in range(3))
            self._all = wp.full(nworld, 1, dtype=int)
            self._u, self._q = wp.zeros((nworld, size), dtype=float), wp.zeros((nworld, size), dtype=float)
        lanes = LANES_FEW if self.device.is_cuda and nworld <= FEW else 1
        self._inverse = Inverse(model, nworld, chunk, self._norm, self._launch, lanes)
        inverse, entries = self._inverse.inverse, right_hand_sides.InverseEntries()
        entries.half, entries.rest, entries.scale = inverse.half, inverse.rest, inverse.scale
        entries.free_index, self._entries = self._free, entries
        self._outer, self._row_group = surfaces[0], None
        self._surfaces = [SurfaceForces() if s is None else s.forces for s in surfaces]

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        """Takes x, for the deformed shape; the undeformed inverse is valid for every step."""
        self._x = x

    def update(
        self,
        program: Launcher,
        st: Worlds,
        residual: Residual,
        z_out: wp.array,
        partial_out: wp.array,
        in_parallel: Callable[..., None],
    ) -> None:
        """See `precondition.Preconditioner`."""
        norms, r, gradient = residual
        on, m, w = st.active, self.capacity, self.nworld
        outer, core = self._surfaces
        blocks = [self._link, self._spring]

        def find():
            self._launch(
                program,
                touching_nodes.list_touching_nodes,
                self._nodes,
                [self._free, outer, core, on],
                [self._found_count, self.slot, self._found, st.touched],
            )
            program.launch_blocks(
                touching_nodes.number_touching_nodes,
                [w],
                [m, norms, st, self._found],
                [self._found_count, self.slot, self.node, self.size, self._norm, self.full],
            )

        def push_forward():
            if self._inverse.pushed:
                self._launch(program, *self._inverse.pushed.measurement(self._x, on))

        def gather():
            self._gather(program, True, st, on, r, gradient)

        def make():
            self._make_system(program, st, on, self._bodies)

        def prepare():
            self._launch(
                program,
                woodbury.fill_stiffness,
                (self._ring.shape[1], m, w),
                [outer, core, self._ring, self.slot, self.node, self.size, on],
                blocks,
            )
            if not self.liquid:  # with a liquid, its displacements are needed first
                make()

        self._given = st, r, gradient
        in_parallel(find, push_forward) if self._inverse.pushed else find()
        in_parallel(gather, prepare)
        if self.liquid:
            make()
        self._finish(program, st, on, r, gradient, z_out, partial_out)

    def apply(
        self,
        program: Launcher,
        st: Worlds,
        partial: wp.array,
        r: wp.array,
        gradient: wp.array,
        z_out: wp.array,
        partial_out: wp.array,
    ) -> None:
        """z = approximate inverse of the tangent times r in the running worlds. partial: square of r by
        chunks."""
        program.launch_blocks(
            right_hand_sides.measure_norm, [self.nworld], [partial, st.running], [self._norm]
        )
        self._gather(program, False, st, st.running, r, gradient)
        self._finish(program, st, st.running, r, gradient, z_out, partial_out)

    def _gather(self, program, first, st, on, r, gradient):
        touching, out = (self.node, self.size), (self._W, self._u, self._largest)
        self._inverse.gather(program, first, st, on, r, gradient, touching, *out)

    def _make_system(self, program, st, on, bodies=None):
        """Computes G from the springs of contact and the displacements by the liquid."""
        inverse, w = self._inverse, self.nworld
        # with many worlds each has one block; most have a third of the touching nodes that they may have
        threads = self.capacity**2 if w <= FEW else 256
        nodes = [self._entries, self.node, self.size]
        given = [*nodes, self.liquid, inverse.along, st, on, inverse.node_map.matrix, threads]
        self._launch(program, woodbury.fill_compliance, (w, threads), given, [self._W])
        if bodies is not None:
            outer = self._surfaces[0]
            touched = [self.liquid, outer, self._body_contact.group, bodies, self._x]
            given = [*touched, self.node, self.size, st, on, threads]
            self._launch(program, woodbury.add_bodies, (w, threads), given, [self._W])
        system = [self.liquid, self.size, self._link, self._spring, self._W, on, threads]
        self._launch(program, woodbury.fill_system, (w, threads), system, [self._A])
        self._invert(program, on)
        self._launch(program, woodbury.multiply_springs, (w, threads), system, [self._G])

    def _invert(self, program, on):
        """Stores the inverse of A in W."""
        if self.device.is_cuda:
            from .batched_inverse import invert

            invert(program, self.liquid, self.size, on, self._A, self._W)
            return
        worlds, rows, A, W = (a.numpy() for a in (on, self.size, self._A, self._W))

        def invert_each():
            for w in np.flatnonzero(worlds):
                n = self.liquid + 3 * rows[w]
                W[w, :n, :n] = np.linalg.inv(A[w, :n, :n])

        program.call(invert_each)

    def _finish(self, program, st, on, r, gradient, z_out, partial_out):
        """Computes the forces of contact and liquid, and the result z."""
        answer = [self.liquid, self.size, self._G, self._u, self._norm, st, on]
        self._launch(program, woodbury.contact_forces, self._u.shape, answer, [self._q, self._largest])
        forces = self.slot, self._q, self._largest
        self._inverse.apply(program, st, on, r, gradient, *forces, z_out, partial_out)

    def measure_tangents(
        self, program: Launcher, geoms: "GeomSet", x: wp.array, tangent_out: wp.array
    ) -> None:
        """See `precondition.Preconditioner`. By the inverse of the undeformed skin, as for many worlds on the
        CPU, and without the compliance of the bodies."""
        outer, rows = self._outer, (self.capacity, self.nworld)
        if self._inverse.pushed or self._bodies is not None:
            self._inverse.without_deformation(lambda: self._undeformed_system(program))
        if self._row_group is None:
            with wp.ScopedDevice(self.device):
                self._row_group = wp.zeros(rows, dtype=int)
                self._row_tangent = wp.zeros(rows, dtype=wp.spatial_matrixd)
        surface, nsample = outer.surface, len(self.m.sample)
        touched = [surface.start, surface.slot, nsample, outer.touching, outer.trial_geom, geoms.struct.group]
        here = [self.size, self.node]
        program.launch(body_tangent.group_rows, rows, [*here, *touched], [self._row_group])
        inputs = [self.liquid, *here, self._G, x, self._row_group]
        program.launch(body_tangent.row_tangents, rows, inputs, [self._row_tangent])
        sums = [self.size, self._row_group, self._row_tangent]
        program.launch(body_tangent.sum_rows, tangent_out.shape, sums, [tangent_out])

    def _undeformed_system(self, program):
        """Computes the Woodbury systems of all worlds with the present `node_map`, at the last residual."""
        st, r, gradient = self._given
        if self.liquid:
            self._gather(program, True, st, self._all, r, gradient)
        self._make_system(program, st, self._all)


def _launch(threads, program, kernel, dim, inputs, outputs):
    program.launch(kernel, dim, inputs, outputs, threads)
