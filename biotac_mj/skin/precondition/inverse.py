"""Products with the inverse for the dense preconditioner: displacements of the touching nodes and of the
liquid by a residual, and the result. For nearly incompressible rubber the inverse is pushed forward into the
deformed shape."""

import typing

import numpy as np
import warp as wp

from ..newton.worlds import Worlds
from ..program import Launcher
from ..types import real
from . import right_hand_sides, woodbury
from .block_products import Product
from .pushed_forward import PushForwardMatrices, pushes_forward


class Inverse:
    """Applies the block inverse (`block_inverse`) to the right-hand sides of all worlds.

    Args:
      model: the SkinModel.
      nworld: number of worlds.
      chunk: nodes that one thread sums.
      norm: norms of the residual and of the volume's gradient [2, world].
      launch: launches a kernel, see `DensePreconditioner`.
      lanes: threads that sum the matrices of one node.

    Attributes:
      pushed: `PushForwardMatrices`, or None if the inverse of the undeformed skin is used.
      node_map: rows, matrices and scales by which kernels read and write the inverse's vectors.
    """

    def __init__(
        self,
        model: typing.Any,
        nworld: int,
        chunk: int,
        norm: wp.array,
        launch: typing.Callable,
        lanes: int,
    ):
        self.inverse = model.inverse
        self._chunk, self._launch, self._nworld = chunk, launch, nworld
        self._liquid, self._wet = int(model.has_liquid), model.wet_node
        self._nodes, self._chunks = (model.nvert, nworld), (-(-model.nvert // chunk), nworld)
        row = np.full(model.nvert, -1, np.int32)
        row[model.free] = self.inverse.row
        with wp.ScopedDevice(model.device):
            row = wp.array(row, dtype=int)
            self.along = wp.zeros(self._nodes if self._liquid else (0, nworld), dtype=wp.vec3)
            self._partial = wp.zeros((2, *self._chunks), dtype=real)
            none = wp.zeros((0, nworld), dtype=wp.mat33)
            self._no_slot, self._nothing = wp.zeros((0, nworld), dtype=int), wp.zeros(nworld, dtype=float)
        self.pushed = None
        if pushes_forward(model.elements, model.material.poissons_ratio):
            self.pushed = PushForwardMatrices(model.elements, nworld, model.device, lanes)
        self._undeformed = self._node_map(row, none, norm)
        self.node_map = self._node_map(row, self.pushed.matrix, norm) if self.pushed else self._undeformed
        self._product = Product(self.inverse, nworld)
        # residual and volume's gradient of all worlds, in one product
        self._pairs = Product(self.inverse, 2 * nworld) if self._liquid else self._product

    def _node_map(self, row, matrix, norm):
        out = right_hand_sides.NodeMap()
        out.row, out.matrix, out.norm, out.scale = row, matrix, norm, self.inverse.back
        return out

    def without_deformation(self, launches: typing.Callable[[], None]) -> None:
        """Calls `launches` with the inverse of the undeformed skin."""
        present, self.node_map = self.node_map, self._undeformed
        launches()
        self.node_map = present

    def gather(
        self,
        program: Launcher,
        first: bool,
        st: Worlds,
        on: wp.array,
        r: wp.array,
        gradient: wp.array,
        touching: tuple,
        W_out: wp.array,
        u_out: wp.array,
        largest_out: wp.array,
    ) -> None:
        """Computes the displacements u of the liquid and the touching nodes by the residual r. first: also
        the displacements of all nodes by the volume's gradient.

        Args:
          touching: `node` and `size` of `DensePreconditioner`.
        """
        product, nodes, liquid = self._product, [self.node_map, self._wet, gradient], self._liquid
        if liquid and first:
            product = self._pairs
            self._launch(program, right_hand_sides.load_gradient, self._nodes, [*nodes, on], [product.side])
        inputs = [0, self.node_map, self._no_slot, r, *nodes[1:], u_out, self._nothing, st, on]
        self._launch(program, right_hand_sides.load_difference, self._nodes, inputs, [product.side])
        product.run(program)
        if liquid:
            inputs = [self._chunk, *nodes, product.answer, st, on]
            if first:
                out = [self.along, self._partial]
                self._launch(program, right_hand_sides.read_along, self._chunks, inputs, out)
            kernel = right_hand_sides.measure_volume_change
            self._launch(program, kernel, self._chunks, inputs, [self._partial])
            inputs = [self._partial, on, int(first)]
            program.launch_blocks(woodbury.sum_liquid, [self._nworld], inputs, [W_out, u_out])
        inputs = [liquid, self.node_map, *touching, product.answer, st, on]
        kernel = right_hand_sides.gather_displacements
        self._launch(program, kernel, touching[0].shape, inputs, [u_out, largest_out])

    def apply(
        self,
        program: Launcher,
        st: Worlds,
        on: wp.array,
        r: wp.array,
        gradient: wp.array,
        slot: wp.array,
        q: wp.array,
        largest: wp.array,
        z_out: wp.array,
        partial_out: wp.array,
    ) -> None:
        """Computes z = inverse times r minus the forces q of contact and liquid."""
        product, nodes, liquid = self._product, self.node_map, (self._wet, gradient)
        inputs = [self._liquid, nodes, slot, r, *liquid, q, largest, st, on]
        self._launch(program, right_hand_sides.load_difference, self._nodes, inputs, [product.side])
        product.run(program)
        inputs = [self._chunk, nodes, product.answer, largest, r, *liquid, st, on]
        self._launch(program, right_hand_sides.read_answer, self._chunks, inputs, [z_out, partial_out])
