"""The preconditioner of `sparse.py` for all worlds at once and without reads by the host, for CUDA.

Woodbury's identity with the inverse of the undeformed stiffness: first the displacements u of the touching
nodes and the liquid by the residual, then their forces q = (I + D W)^-1 D u, which are subtracted from the
residual. G = (I + D W)^-1 D is computed explicitly, so that it is applied by one short product. The inverse
is that of `block_inverse`; for nearly incompressible rubber it is pushed forward, see `pushed_forward`."""

import typing
from collections.abc import Callable

import numpy as np
import warp as wp

from ...kernels import set_fields
from ..newton.nodes import SurfaceForces
from ..program import FEW, LANES_FEW, THREADS_FEW, Launcher
from ..types import SINGLE, real
from . import Preconditioner, Residual, body_tangent, right_hand_sides, touching_nodes, woodbury
from .block_products import Product
from .pushed_forward import PushForwardMatrices, pushes_forward

if typing.TYPE_CHECKING:
    from ..geoms import GeomSet


class DensePreconditioner(Preconditioner):
    """The dense preconditioner of all worlds of one SkinData, see `precondition.Preconditioner`. Conjugate
    gradients correct for touching nodes beyond `contact_capacity`, in more iterations."""

    precision = SINGLE

    def __init__(self, data: typing.Any):
        model, nworld, capacity = data.model, data.nworld, data.contact_capacity
        self._bodies, self._body_contact, self._st = data.bodies, data.body_contact, data.worlds
        self.m, self.nworld, self.chunk, self.capacity = model, nworld, data.chunk, capacity
        self.device, self.liquid = model.device, int(model.has_liquid)
        n, inverse, lanes = model.nvert, model.inverse, 1
        if self.device.is_cuda and nworld <= FEW:
            lanes = LANES_FEW
        self._nodes, self._chunks = (n, nworld), (-(-n // self.chunk), nworld)
        size = self.liquid + 3 * capacity
        index, row = (np.full(n, -1, np.int32) for _ in range(2))
        index[model.free], row[model.free] = np.arange(len(model.free)), inverse.row
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
            self._along = wp.zeros(self._nodes if self.liquid else (0, nworld), dtype=wp.vec3)
            self._partial = wp.zeros((2, *self._chunks), dtype=real)
            self._no_slot, self._nothing = wp.zeros((0, nworld), dtype=int), wp.zeros(nworld, dtype=float)
            entries = right_hand_sides.InverseEntries()
            set_fields(entries, half=inverse.half, rest=inverse.rest, scale=inverse.scale)
            self._entries = set_fields(entries, free_index=self._free)
            known = {"row": row, "norm": self._norm, "scale": inverse.back}
            none = wp.zeros((0, nworld), dtype=wp.mat33)
            self._undeformed = set_fields(right_hand_sides.NodeMap(), matrix=none, **known)
            self._pushed, self._node_map = None, self._undeformed
            if pushes_forward(model.elements, model.material.poissons_ratio):
                self._pushed = PushForwardMatrices(model.elements, nworld, self.device, lanes)
                known["matrix"] = self._pushed.matrix
                self._node_map = set_fields(right_hand_sides.NodeMap(), **known)
        self._product = Product(inverse, nworld)
        # residual and volume's gradient of all worlds, in one product
        self._pairs = Product(inverse, 2 * nworld) if self.liquid else self._product
        self._outer, self._row_group = data.outer, None
        self._surfaces = [SurfaceForces() if s is None else s.forces for s in (data.outer, data.core)]

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        """Takes x, for the deformed shape; the undeformed inverse is valid for every step."""
        self._x = x

    def update(
        self,
        program: Launcher,
        residual: Residual,
        z_out: wp.array,
        partial_out: wp.array,
        in_parallel: Callable[..., None],
    ) -> None:
        """See `precondition.Preconditioner`."""
        st, on, w = self._st, self._st.active, self.nworld
        outer, core = self._surfaces

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
                [self.capacity, residual.norms, st, self._found],
                [self._found_count, self.slot, self.node, self.size, self._norm, self.full],
            )

        def push_forward():
            if self._pushed:
                self._launch(program, *self._pushed.measurement(self._x, on))

        def gather():
            self._gather(program, True, on, residual)

        def make():
            self._make_system(program, on, self._bodies)

        def prepare():
            dim = self._ring.shape[1], self.capacity, w
            inputs = [outer, core, self._ring, self.slot, self.node, self.size, on]
            self._launch(program, woodbury.fill_stiffness, dim, inputs, [self._link, self._spring])
            if not self.liquid:  # with a liquid, its displacements are needed first
                make()

        self._given = residual
        in_parallel(find, push_forward) if self._pushed else find()
        in_parallel(gather, prepare)
        if self.liquid:
            make()
        self._finish(program, on, residual, z_out, partial_out)

    def apply(self, program: Launcher, residual: Residual, z_out: wp.array, partial_out: wp.array) -> None:
        """See `precondition.Preconditioner`."""
        on = self._st.running
        program.launch_blocks(
            right_hand_sides.measure_norm, [self.nworld], [residual.norms, on], [self._norm]
        )
        self._gather(program, False, on, residual)
        self._finish(program, on, residual, z_out, partial_out)

    def _gather(self, program, first, on, residual):
        """Computes the displacements u of the liquid and the touching nodes by the residual. first: also the
        displacements of all nodes by the volume's gradient."""
        product, wet, st, liquid = self._product, [self.m.wet_node, residual.gradient], self._st, self.liquid
        nodes = [self._node_map, *wet]
        if liquid and first:
            product = self._pairs
            self._launch(program, right_hand_sides.load_gradient, self._nodes, [*nodes, on], [product.side])
        inputs = [0, self._node_map, self._no_slot, residual.r, *wet, self._u, self._nothing, st, on]
        self._launch(program, right_hand_sides.load_difference, self._nodes, inputs, [product.side])
        product.run(program)
        if liquid:
            inputs = [self.chunk, *nodes, product.answer, st, on]
            if first:
                out = [self._along, self._partial]
                self._launch(program, right_hand_sides.read_along, self._chunks, inputs, out)
            kernel = right_hand_sides.measure_volume_change
            self._launch(program, kernel, self._chunks, inputs, [self._partial])
            inputs = [self._partial, on, int(first)]
            program.launch_blocks(woodbury.sum_liquid, [self.nworld], inputs, [self._W, self._u])
        inputs = [liquid, self._node_map, self.node, self.size, product.answer, st, on]
        kernel = right_hand_sides.gather_displacements
        self._launch(program, kernel, self.node.shape, inputs, [self._u, self._largest])

    def _make_system(self, program, on, bodies=None):
        """Computes G from the springs of contact and the displacements by the liquid."""
        w, st = self.nworld, self._st
        # with many worlds each has one block; most have a third of the touching nodes that they may have
        threads = self.capacity**2 if w <= FEW else 256
        nodes = [self._entries, self.node, self.size]
        given = [*nodes, self.liquid, self._along, st, on, self._node_map.matrix, threads]
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

    def _finish(self, program, on, residual, z_out, partial_out):
        """Computes the forces q of contact and liquid, and the result z, the inverse times what these leave
        of the residual."""
        st, product, liquid = self._st, self._product, self.liquid
        answer = [liquid, self.size, self._G, self._u, self._norm, st, on]
        self._launch(program, woodbury.contact_forces, self._u.shape, answer, [self._q, self._largest])
        r, wet = residual.r, [self.m.wet_node, residual.gradient]
        inputs = [liquid, self._node_map, self.slot, r, *wet, self._q, self._largest, st, on]
        self._launch(program, right_hand_sides.load_difference, self._nodes, inputs, [product.side])
        product.run(program)
        inputs = [self.chunk, self._node_map, product.answer, self._largest, r, *wet, st, on]
        self._launch(program, right_hand_sides.read_answer, self._chunks, inputs, [z_out, partial_out])

    def measure_tangents(
        self, program: Launcher, geoms: "GeomSet", x: wp.array, tangent_out: wp.array
    ) -> None:
        """See `precondition.Preconditioner`. By the inverse of the undeformed skin, as for many worlds on the
        CPU, and without the compliance of the bodies."""
        outer, rows = self._outer, (self.capacity, self.nworld)
        if self._pushed or self._bodies is not None:
            # the Woodbury systems of all worlds at the last residual
            present, self._node_map = self._node_map, self._undeformed
            if self.liquid:
                self._gather(program, True, self._all, self._given)
            self._make_system(program, self._all)
            self._node_map = present
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

    def _launch(self, program, kernel, dim, inputs, outputs):
        program.launch(kernel, dim, inputs, outputs, THREADS_FEW if self.nworld <= FEW else 256)
