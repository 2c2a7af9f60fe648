"""The preconditioner of `preconditioner.py` for all worlds at once, without a look back at the host.

Woodbury's identity with the dense inverse of the rest stiffness: first what the residual does at the touching
nodes (by their rows of the inverse for few worlds, by a product for many), then the forces of contact and
liquid that answer there, q = (I + D W)^-1 D u; these join the residual, and one product gives the result. G =
(I + D W)^-1 D is made explicitly, so that applying it is one short product."""

import numpy as np
import warp as wp

from . import device_product as one
from . import device_sides as sides
from . import device_small as small
from . import device_touch as touch
from .device_worlds import BLOCK
from .types import mat33, real

__all__ = ["FEW", "THREADS_FEW", "DevicePreconditioner"]

_LISTED = 512
FEW = 16  # worlds that do not fill the device: work is split finer there
THREADS_FEW = 64  # of a block there, so that more multiprocessors take part


class DevicePreconditioner:
    """For all worlds of one SkinData: `update` after each evaluation of the forces, then `apply`.

    Args:
      model: the SkinModel.
      surfaces: (outer, core) contact states, core None where there is none.
      nworld: number of worlds.
      chunk: nodes summed by one thread.
      capacity: touching nodes that the small systems hold; contact beyond is left to conjugate gradients,
        which then take longer.
    """

    def __init__(self, model, surfaces, nworld, chunk, capacity):
        self.m, self.nworld, self.chunk, self.capacity = model, nworld, chunk, capacity
        self.device = model.device
        self.liquid = int(model.has_liquid)
        n, nchunk = model.nvert, -(-model.nvert // chunk)
        self._chunks, self._nodes = (nchunk, nworld), (n, nworld)
        index = np.full(n, -1, np.int32)
        index[model.free] = np.arange(len(model.free))
        self._inverse = model.__dict__.setdefault("_device_inverse", None) or _Inverse(model)
        model._device_inverse = self._inverse  # made once for each model
        rows, size = self._inverse.padded, self.liquid + 3 * capacity
        with wp.ScopedDevice(self.device):
            self._free, self._free_nodes = wp.array(index, dtype=int), wp.array(model.free, dtype=int)
            none = (
                wp.zeros(0, dtype=int),
                wp.zeros((0, nworld), dtype=int),
                wp.zeros(0, dtype=wp.vec3i),
                wp.zeros((0, nworld), dtype=mat33),
            )
            self.slot = wp.zeros(self._nodes, dtype=int)
            self.node = wp.zeros((capacity, nworld), dtype=int)
            self.size = wp.zeros(nworld, dtype=int)
            self.any_touch = wp.zeros(nworld, dtype=int)
            self.full = wp.zeros(1, dtype=int)
            self._norm = wp.zeros((2, nworld), dtype=float)
            self._largest = wp.zeros(nworld, dtype=float)
            self._along = wp.zeros(self._nodes if self.liquid else (0, nworld), dtype=wp.vec3)
            self._part = wp.zeros((2, *self._chunks), dtype=real)
            # nodes that touch in any world: as long as they are few, their rows of the inverse are enough for
            # a first look
            few = 3 * min(_LISTED, n) if nworld > FEW else 0
            self._wanted, self._place = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
            self._listed, self._count_listed, self._fits = (
                wp.zeros(few // 3, dtype=int),
                wp.zeros(1, dtype=int),
                wp.zeros(1, dtype=int),
            )
            kept = few if len(self._inverse.rest) else 0
            self._rows = [wp.zeros((k, rows), dtype=wp.float16) for k in (few, kept)]
            self._few = wp.zeros((few, 2 * nworld), dtype=float), wp.zeros((kept, nworld), dtype=float)
            self._count = wp.zeros((nworld, capacity), dtype=int)
            self._link = wp.zeros((nworld, capacity, small.LINKS), dtype=int)
            self._spring = wp.zeros((nworld, capacity, small.LINKS), dtype=wp.mat33)
            self._W, self._A, self._G = (wp.zeros((nworld, size, size), dtype=float) for _ in range(3))
            self._pivot = wp.zeros((nworld, size), dtype=int)
            self._u, self._q = wp.zeros((nworld, size), dtype=float), wp.zeros((nworld, size), dtype=float)
            self._alone = None
            if nworld == 1:
                self._alone = one.SymmetricProduct(self._inverse.half, self._inverse.rest)
                self._pair, self._pair_answer = (wp.zeros((2, rows), dtype=float) for _ in range(2))
                self._corrections = wp.zeros((one.PARTS, n), dtype=wp.vec3)
                rows = 0
            self._side = wp.zeros((rows, 2 * nworld), dtype=wp.float16)
            third = rows if len(self._inverse.rest) else 0
            self._answer = wp.zeros((rows, 2 * nworld), dtype=float), wp.zeros((third, nworld), dtype=float)
        self._surfaces = []
        for state in surfaces:
            if state is None:
                self._surfaces.append((none[2], none[0], none[0], none[1], none[3]))
            else:
                s = state.surface
                self._surfaces.append((s.face, s.start, s.slot, state.touching, state.block))

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(
            kernel,
            dim,
            inputs,
            outputs,
            device=self.device,
            block_dim=THREADS_FEW if self.nworld <= FEW else 256,
        )

    def _by_block(self, kernel, dim, inputs, outputs):
        wp.launch_tiled(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=BLOCK, device=self.device)

    def update(self, st, part, r, gradient, z_out, part_out, beside):
        """Takes the tangents of contact and liquid; z is the approximate inverse of the new tangent times r.

        Args:
          st: Worlds, of which the active ones are looked at.
          part: (4, nchunk, nworld) squares of r and of the gradient as its first and third.
          r: [nvert, nworld] residual, zero at fixed nodes. gradient: of the liquid's volume [nvert, nworld],
            or of length zero.
          z_out: [nvert, nworld]. part_out: (2, nchunk, nworld) r . z and gradient . z.
          beside: launches functions that do not need each other's results.
        """
        on, m, w, inverse = st.active, self.capacity, self.nworld, self._inverse
        entries = [inverse.half, inverse.rest, inverse.scale]
        outer, core = self._surfaces
        self._launch(
            touch.find_touched,
            self._nodes,
            [self._free, *outer[1:4], *core[1:4], on],
            [self.slot, self.any_touch, self._wanted],
        )
        self._by_block(
            touch.survey, [w], [m, part, st, self.slot], [self.node, self.size, self._norm, self.full]
        )
        if w > FEW:
            self._by_block(
                touch.list_wanted,
                [1],
                [self._wanted],
                [self._place, self._listed, self._count_listed, self._fits],
            )
            for source, rows in zip((inverse.half, inverse.rest), self._rows):
                self._launch(
                    touch.copy_rows,
                    rows.shape,
                    [source, self._free, self._listed, self._count_listed],
                    [rows],
                )
        blocks = [self._count, self._link, self._spring]

        def meet():
            if self._alone:
                self._meet_alone(1, st, on, r, gradient)
                return
            if self.liquid:
                self._direct_liquid(st, on, gradient)
            self._meet(1, st, on, r)

        def make():
            self._launch(
                small.small_compliance,
                (w, m, m),
                [*entries, self._free, self.node, self.size, self.liquid, self._along, st],
                [self._W],
            )
            self._launch(
                small.small_system, (w, m, m), [self.liquid, self.size, *blocks, self._W, on], [self._A]
            )
            self._invert(on)
            self._launch(
                small.small_answer, (w, m, m), [self.liquid, self.size, *blocks, self._W, on], [self._G]
            )

        def prepare():
            self._launch(
                small.small_stiffness, (m, w), [*outer, *core, self.slot, self.node, self.size, on], blocks
            )
            if not self.liquid:  # which has to be met first
                make()

        beside(meet, prepare)
        if self.liquid:
            make()
        self._balance(st, on, r, gradient, z_out, part_out)

    def apply(self, st, part, r, gradient, z_out, part_out):
        """z = approximate inverse of the tangent times r in the running worlds; `part` holds the square of r
        by chunks."""
        if self._alone:
            self._meet_alone(0, st, st.running, r, gradient)
            self._balance(st, st.running, r, gradient, z_out, part_out)
            return
        self._by_block(sides.measure_norm, [self.nworld], [part, st.running], [self._norm])
        self._meet(0, st, st.running, r)
        self._balance(st, st.running, r, gradient, z_out, part_out)

    def _direct_liquid(self, st, on, gradient):
        """What the liquid's direction does everywhere."""
        inverse = self._inverse
        self._launch(sides.load_gradient, self._nodes, [self._free, gradient, self._norm, on], [self._side])
        inverse.multiply(self._side, *self._answer)
        self._launch(sides.read_along, self._chunks,
                     [self.chunk, self._free, gradient, *self._answer, self._norm, inverse.scale, st, on],
                     [self._along, self._part])  # fmt: skip

    def _meet_alone(self, first, st, on, r, gradient):
        """`_direct_liquid` and `_meet` for one world: a single pass over the inverse."""
        self._launch(one.load_pair, self._nodes[0], [self._free, r, gradient, on], [self._pair])
        self._alone.multiply(self._pair, self._pair_answer)
        self._launch(
            one.read_pair,
            max(self._chunks[0], 3 * self.capacity),
            [
                first,
                self.chunk,
                self.liquid,
                self._free,
                self.node,
                self.size,
                r,
                gradient,
                self._pair_answer,
                self._inverse.scale,
                st,
                on,
                self._along,
            ],
            [self._u, self._largest, self._part],
        )
        if self.liquid:
            self._by_block(small.sum_liquid, [1], [self._part, on, first], [self._W, self._u])

    def _meet(self, first, st, on, r):
        """What the residual does to the liquid and at the touching nodes."""
        inverse = self._inverse
        if self.liquid:
            self._launch(sides.measure_along, self._chunks, [self.chunk, r, self._along, on], [self._part])
            self._by_block(small.sum_liquid, [self.nworld], [self._part, on, first], [self._W, self._u])
        if self.nworld <= FEW:
            self._by_block(
                sides.small_rows,
                [self.nworld, 3 * self.capacity],
                [
                    self.liquid,
                    inverse.half,
                    inverse.rest,
                    inverse.scale,
                    self._free_nodes,
                    self._free,
                    self.node,
                    self.size,
                    r,
                    st,
                    on,
                ],
                [self._u, self._largest],
            )
            return
        self._launch(sides.load_residual, self._nodes, [self._free, r, self._norm, on], [self._side])
        wp.capture_if(self._fits, self._read_rows, self._read_all, st=st, on=on)

    def _read_rows(self, st, on):
        self._inverse.multiply_rows(self._rows, self._side, self._few)
        self._read(self._place, self._few, st, on)

    def _read_all(self, st, on):
        self._inverse.multiply(self._side, *self._answer)
        self._read(self._free, self._answer, st, on)

    def _read(self, row, answer, st, on):
        self._launch(
            sides.small_side,
            (self.capacity, self.nworld),
            [self.liquid, row, self.node, self.size, *answer, self._norm, self._inverse.scale, st, on],
            [self._u, self._largest],
        )

    def _invert(self, on):
        """The inverse of A, in W's place."""
        if self.device.is_cuda:
            from .device_native import invert

            invert(self.liquid, self.size, on, self._A, self._pivot, self._W)
        else:
            self._launch(
                small.invert_serial,
                self.nworld,
                [self.liquid, self.size, on, self._A, self._pivot],
                [self._W],
            )

    def _balance(self, st, on, r, gradient, z_out, part_out):
        """What contact and liquid answer, and the result."""
        inverse = self._inverse
        self._launch(
            small.small_forces,
            self._u.shape,
            [self.liquid, self.size, self._G, self._u, self._norm, st, on],
            [self._q, self._largest],
        )
        if self._alone:
            self._launch(
                one.correct,
                (one.PARTS, self._nodes[0]),
                [self.liquid, inverse.half, inverse.rest, self._free, self.node, self.size, self._q, on],
                [self._corrections],
            )
            self._launch(
                one.read_corrected,
                self._chunks[0],
                [
                    self.chunk,
                    self.liquid,
                    self._free,
                    self._pair_answer,
                    self._corrections,
                    self._along,
                    self._q,
                    inverse.scale,
                    r,
                    gradient,
                    st,
                    on,
                ],
                [z_out, part_out],
            )
            return
        self._launch(
            sides.load_balance,
            self._nodes,
            [self.liquid, self._free, self.slot, r, gradient, self._q, self._norm, self._largest, st, on],
            [self._side],
        )
        inverse.multiply(self._side, *self._answer)
        self._launch(
            sides.read_answer,
            self._chunks,
            [
                self.chunk,
                self._free,
                *self._answer,
                self._norm,
                self._largest,
                inverse.scale,
                r,
                gradient,
                st,
                on,
            ],
            [z_out, part_out],
        )


class _Inverse:
    """The dense inverse of the rest stiffness as a half-precision matrix, and a second one of what its
    rounding took where that is felt.

    Nearly incompressible rubber gives way to changes of volume lambda / mu times less than to others: rounded
    to half precision (2e-4) the inverse no longer knows how much less. By torch on CUDA, by numpy on the CPU
    (where it is for tests)."""

    def __init__(self, model):
        two = model.material.poissons_ratio > 0.45
        if model.device.is_cuda:
            factor = model.factor
            self.scale, self.padded, self._matrix = factor.scale, factor.padded, factor.inverse
            self._rest = factor.remainder(sides.LOW) if two else factor.inverse[:0]
            self.half, self.rest = wp.from_torch(self._matrix), wp.from_torch(self._rest)
        else:
            inverse = np.linalg.inv(model._stiffness.toarray())
            self.scale, self.padded = float(np.abs(inverse).max()), len(inverse)
            inverse /= self.scale
            half = inverse.astype(np.float16)
            rest = ((inverse - half) * sides.LOW).astype(np.float16)[: None if two else 0]
            self.half, self.rest = (wp.array(a, dtype=wp.float16, ndim=2, device="cpu") for a in (half, rest))
            self._matrix, self._rest = half.astype(np.float32), rest.astype(np.float32)
        self._views = {}

    def multiply(self, side, answer, third):
        """answer = inverse times side, (padded, 2 nworld) half -> single; third = remainder times its first
        columns."""
        self._multiply((self._matrix, self._rest), side, (answer, third))

    def multiply_rows(self, rows, side, answer):
        """The same for some rows of the inverse and of its remainder, given as arrays."""
        self._multiply([self._view(a) for a in rows], side, answer)

    def _view(self, array):
        if not array.device.is_cuda:
            return array.numpy().astype(np.float32) if array.dtype is wp.float16 else array.numpy()
        if array.ptr not in self._views:  # made once, not while a graph is recorded
            self._views[array.ptr] = wp.to_torch(array)
        return self._views[array.ptr]

    def _multiply(self, matrices, side, answers):
        b = self._view(side)
        for matrix, answer, columns in zip(matrices, answers, (side.shape[1], side.shape[1] // 2)):
            if not len(matrix):
                continue
            if not side.device.is_cuda:
                np.matmul(matrix, b[:, :columns], out=self._view(answer))
                continue
            import torch

            x = self._view(answer)
            with torch.cuda.stream(
                torch.cuda.ExternalStream(side.device.stream.cuda_stream, device=x.device)
            ):
                torch.mm(matrix, b[:, :columns], out_dtype=torch.float32, out=x)
