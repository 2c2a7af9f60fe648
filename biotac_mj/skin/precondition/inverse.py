"""What the dense preconditioner asks of the inverse: what a residual does at the touching nodes and to the
liquid, and the result. Of nearly incompressible rubber it is the inverse carried into the present shape."""

import typing

import numpy as np
import warp as wp

from ..newton.worlds import Worlds
from ..program import Launcher
from ..types import real
from . import sides, small
from .carried import Matrices, carries

__all__ = ["Inverse"]


class Inverse:
    """Products of the dissected inverse with a right-hand side of each world, and what is made of them.

    Args:
      model: the SkinModel. nworld: how many. chunk: nodes summed by one thread.
      launch: of a kernel, as `DensePreconditioner` does it. lanes: that share what is summed into a node.

    Attributes:
      carried: `carried.Matrices`, or None where the inverse is as at rest.
      needs_torch: see `dissected.Product`.
    """

    def __init__(self, model: typing.Any, nworld: int, chunk: int, launch: typing.Callable, lanes: int):
        self.inverse = model.inverse
        self._chunk, self._launch, self._nworld = chunk, launch, nworld
        self._liquid, self._wet = int(model.has_liquid), model.wet_node
        self._nodes, self._chunks = (model.nvert, nworld), (-(-model.nvert // chunk), nworld)
        row = np.full(model.nvert, -1, np.int32)
        row[model.free] = self.inverse.row
        with wp.ScopedDevice(model.device):
            self._row = wp.array(row, dtype=int)
            self.along = wp.zeros(self._nodes if self._liquid else (0, nworld), dtype=wp.vec3)
            self._part = wp.zeros((2, *self._chunks), dtype=real)
            self._none = wp.zeros((0, nworld), dtype=wp.mat33)
        self.carried = None
        if carries(model.elements, model.material.poissons_ratio):
            self.carried = Matrices(model.elements, nworld, model.device, lanes)
        self.matrix = self.carried.matrix if self.carried else self._none
        self._product = self.inverse.product(nworld, two=bool(self._liquid))
        self.needs_torch = self._product.needs_torch

    def as_at_rest(self, launches: typing.Callable[[], None]) -> None:
        """What `launches` launches takes the inverse as it is at rest."""
        kept, self.matrix = self.matrix, self._none
        launches()
        self.matrix = kept

    def meet(
        self,
        program: Launcher,
        first: bool,
        st: Worlds,
        on: wp.array,
        r: wp.array,
        gradient: wp.array,
        norm: wp.array,
        touch: tuple,
        W_out: wp.array,
        u_out: wp.array,
        largest_out: wp.array,
    ) -> None:
        """What the residual does to the liquid and at the touching nodes; at first, what the liquid's
        direction does everywhere.

        Args:
          touch: `node` and `size`, see `touched`.
        """
        product, back = self._product, self.inverse.back
        nodes, liquid = [self._row, self._wet, gradient], self._liquid
        second = product.second
        if liquid and first:
            side, answer = second or (product.side, product.answer)
            given = [*nodes, norm, on, self.matrix]
            self._launch(program, sides.load_gradient, self._nodes, given, [side])
            if not second:
                product.run(program)
                self._read_along(program, nodes, answer, norm, st, on)
        given = [self._row, r, norm, on, self.matrix]
        self._launch(program, sides.load_residual, self._nodes, given, [product.side])
        product.run(program, both=bool(liquid and first and second))
        if liquid and first and second:
            self._read_along(program, nodes, answer, norm, st, on)
        if liquid:
            onto = [self._chunk, *nodes, product.answer, norm, back, st, on, self.matrix]
            self._launch(program, sides.measure_swelling, self._chunks, onto, [self._part])
            program.launch_blocks(
                small.sum_liquid, [self._nworld], [self._part, on, int(first)], [W_out, u_out]
            )
        here = [liquid, self._row, *touch, product.answer, norm, back, st, on, self.matrix]
        self._launch(program, sides.small_side, touch[0].shape, here, [u_out, largest_out])

    def _read_along(self, program, nodes, answer, norm, st, on):
        direction = [self._chunk, *nodes, answer, norm, self.inverse.back, st, on, self.matrix]
        self._launch(program, sides.read_along, self._chunks, direction, [self.along, self._part])

    def balance(
        self,
        program: Launcher,
        st: Worlds,
        on: wp.array,
        r: wp.array,
        gradient: wp.array,
        norm: wp.array,
        touch: tuple,
        slot: wp.array,
        q: wp.array,
        largest: wp.array,
        z_out: wp.array,
        part_out: wp.array,
    ) -> None:
        """The result, once contact and liquid have answered q."""
        product, row, liquid = self._product, self._row, (self._wet, gradient)
        answers = [self._liquid, row, slot, r, *liquid, q, norm, largest, st, on, self.matrix]
        self._launch(program, sides.load_balance, self._nodes, answers, [product.side])
        product.run(program)
        answer = [self._chunk, row, product.answer, norm, largest, self.inverse.back]
        result = [*answer, r, *liquid, st, on, self.matrix]
        self._launch(program, sides.read_answer, self._chunks, result, [z_out, part_out])
