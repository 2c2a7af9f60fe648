"""The preconditioner of `sparse.py` for all worlds at once, without a look back at the host: for CUDA.

Woodbury's identity with the dense inverse of the rest stiffness: first what the residual does at the touching
nodes (by their rows of the inverse for few worlds, by a product for many), then the forces of contact and
liquid that answer there, q = (I + D W)^-1 D u; these join the residual, and one product gives the result. G =
(I + D W)^-1 D is made explicitly, so that applying it is one short product."""

import typing
from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..newton.worlds import Worlds
from ..program import Launcher
from ..types import SINGLE, mat33, real
from . import body_tangent, sides, small
from . import symmetric_product as one
from . import touched as touch

if typing.TYPE_CHECKING:
    from ..geoms import GeomSet

__all__ = ["FEW", "THREADS_FEW", "DenseInverse", "DensePreconditioner"]

_LISTED = 512
# rows of whole nodes (3) that fill the tensor cores' tiles (64): ragged sizes run at a third of the speed
_ALIGN = 192
_SOUND = 0.1  # of the inverse that rounding leaves at least, in every direction
FEW = 16  # worlds that do not fill the device: work is split finer there
THREADS_FEW = 64  # of a block there, so that more multiprocessors take part


class DensePreconditioner:
    """For all worlds of one SkinData, see `precondition.Preconditioner`.

    Args:
      model: the SkinModel.
      surfaces: (outer, core) contact states, core None where there is none.
      st: Worlds.
      chunk: nodes summed by one thread.
      capacity: touching nodes that the small systems hold; contact beyond is left to conjugate gradients,
        which then take longer.
    """

    precision = SINGLE

    def __init__(self, model: typing.Any, surfaces: tuple, st: Worlds, chunk: int, capacity: int):
        nworld = st.softness.shape[0]
        self.m, self.nworld, self.chunk, self.capacity = model, nworld, chunk, capacity
        self.device = model.device
        self.liquid = int(model.has_liquid)
        n, nchunk = model.nvert, -(-model.nvert // chunk)
        self._chunks, self._nodes = (nchunk, nworld), (n, nworld)
        index = np.full(n, -1, np.int32)
        index[model.free] = np.arange(len(model.free))
        self._inverse = model.dense_inverse
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
            self._found, self._found_count = wp.zeros(self._nodes, dtype=int), wp.zeros(nworld, dtype=int)
            self.size = wp.zeros(nworld, dtype=int)
            self.full = wp.zeros(1, dtype=int)
            self._norm = wp.zeros((2, nworld), dtype=float)
            self._largest = wp.zeros(nworld, dtype=float)
            self._along = wp.zeros(self._nodes if self.liquid else (0, nworld), dtype=wp.vec3)
            self._part = wp.zeros((2, *self._chunks), dtype=real)
            # nodes that touch in any world: as long as they are few, their rows of the inverse are enough for
            # a first look
            few = 3 * min(_LISTED, n) if nworld > FEW else 0
            self._wanted, self._place = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
            self._listed = wp.full(few // 3, -1, dtype=int)
            self._count_listed, self._fits, self._relisted = (wp.zeros(1, dtype=int) for _ in range(3))
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
        self._outer, self._row_group = surfaces[0], None
        self._surfaces = []
        for state in surfaces:
            if state is None:
                self._surfaces.append((none[2], none[0], none[0], none[1], none[3]))
            else:
                s = state.surface
                self._surfaces.append((s.face, s.start, s.slot, state.touching, state.block))

    def begin_step(self, program: Launcher, x: wp.array) -> None:
        """Nothing: the factor at rest serves every step."""

    def watch_products(self, program: Launcher, x: wp.array) -> None:
        """Nothing: an inverse takes longer than the products that it would save."""

    def renew(self, program: Launcher, x: wp.array) -> None:
        """Nothing, see `watch_products`."""

    def _launch(self, program, kernel, dim, inputs, outputs):
        program.launch(kernel, dim, inputs, outputs, THREADS_FEW if self.nworld <= FEW else 256)

    def update(
        self,
        program: Launcher,
        st: Worlds,
        worth: wp.array,
        r: wp.array,
        gradient: wp.array,
        z_out: wp.array,
        part_out: wp.array,
        beside: Callable[..., None],
    ) -> None:
        """See `precondition.Preconditioner`."""
        on, m, w, inverse = st.active, self.capacity, self.nworld, self._inverse
        outer, core = self._surfaces
        self._launch(
            program,
            touch.find_touched,
            self._nodes,
            [self._free, *outer[1:4], *core[1:4], on],
            [self._found_count, self.slot, self._found, st.touched, self._wanted],
        )
        program.launch_blocks(
            touch.survey,
            [w],
            [m, worth, st, self._found],
            [self._found_count, self.slot, self.node, self.size, self._norm, self.full],
        )
        if w > FEW:
            program.launch_blocks(
                touch.list_wanted,
                [1],
                [self._wanted],
                [self._place, self._listed, self._count_listed, self._fits, self._relisted],
            )
            for source, rows in zip((inverse.half, inverse.rest), self._rows):
                self._launch(
                    program,
                    touch.copy_rows,
                    rows.shape,
                    [source, self._free, self._listed, self._count_listed, self._relisted],
                    [rows],
                )
        blocks = [self._count, self._link, self._spring]

        def meet():
            if self._alone:
                self._meet_alone(program, 1, st, on, r, gradient)
                return
            if self.liquid:
                self._direct_liquid(program, st, on, gradient)
            self._meet(program, 1, st, on, r)

        def make():
            # of many worlds each has one block; most touch with a third of the nodes that they may
            threads = m * m if w <= FEW else 256
            entries = [inverse.half, inverse.rest, inverse.scale, self._free, self.node, self.size]
            given = [*entries, self.liquid, self._along, st, threads]
            self._launch(program, small.small_compliance, (w, threads), given, [self._W])
            system = [self.liquid, self.size, *blocks, self._W, on, threads]
            self._launch(program, small.small_system, (w, threads), system, [self._A])
            self._invert(program, on)
            self._launch(program, small.small_answer, (w, threads), system, [self._G])

        def prepare():
            self._launch(
                program,
                small.small_stiffness,
                (m, w),
                [*outer, *core, self.slot, self.node, self.size, on],
                blocks,
            )
            if not self.liquid:  # which has to be met first
                make()

        beside(meet, prepare)
        if self.liquid:
            make()
        self._balance(program, st, on, r, gradient, z_out, part_out)

    def apply(
        self,
        program: Launcher,
        st: Worlds,
        part: wp.array,
        r: wp.array,
        gradient: wp.array,
        z_out: wp.array,
        part_out: wp.array,
    ) -> None:
        """z = approximate inverse of the tangent times r in the running worlds; `part` holds the square of r
        by chunks."""
        if self._alone:
            self._meet_alone(program, 0, st, st.running, r, gradient)
            self._balance(program, st, st.running, r, gradient, z_out, part_out)
            return
        program.launch_blocks(sides.measure_norm, [self.nworld], [part, st.running], [self._norm])
        self._meet(program, 0, st, st.running, r)
        self._balance(program, st, st.running, r, gradient, z_out, part_out)

    def _direct_liquid(self, program, st, on, gradient):
        """What the liquid's direction does everywhere."""
        inverse = self._inverse
        self._launch(
            program, sides.load_gradient, self._nodes, [self._free, gradient, self._norm, on], [self._side]
        )
        inverse.multiply(program, self._side, *self._answer)
        self._launch(program, sides.read_along, self._chunks,
                     [self.chunk, self._free, gradient, *self._answer, self._norm, inverse.scale, st, on],
                     [self._along, self._part])  # fmt: skip

    def _meet_alone(self, program, first, st, on, r, gradient):
        """`_direct_liquid` and `_meet` for one world: a single pass over the inverse."""
        self._launch(program, one.load_pair, self._nodes[0], [self._free, r, gradient, on], [self._pair])
        self._alone.multiply(program, self._pair, self._pair_answer)
        self._launch(
            program,
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
            program.launch_blocks(small.sum_liquid, [1], [self._part, on, first], [self._W, self._u])

    def _meet(self, program, first, st, on, r):
        """What the residual does to the liquid and at the touching nodes."""
        inverse = self._inverse
        if self.liquid:
            self._launch(
                program, sides.measure_along, self._chunks, [self.chunk, r, self._along, on], [self._part]
            )
            program.launch_blocks(
                small.sum_liquid, [self.nworld], [self._part, on, first], [self._W, self._u]
            )
        if self.nworld <= FEW:
            program.launch_blocks(
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
        self._launch(program, sides.load_residual, self._nodes, [self._free, r, self._norm, on], [self._side])
        program.branch(
            self._fits, lambda: self._read_rows(program, st, on), lambda: self._read_all(program, st, on)
        )

    def _read_rows(self, program, st, on):
        self._inverse.multiply_rows(program, self._rows, self._side, self._few)
        self._read(program, self._place, self._few, st, on)

    def _read_all(self, program, st, on):
        self._inverse.multiply(program, self._side, *self._answer)
        self._read(program, self._free, self._answer, st, on)

    def _read(self, program, row, answer, st, on):
        self._launch(
            program,
            sides.small_side,
            (self.capacity, self.nworld),
            [self.liquid, row, self.node, self.size, *answer, self._norm, self._inverse.scale, st, on],
            [self._u, self._largest],
        )

    def _invert(self, program, on):
        """The inverse of A, in W's place."""
        if self.device.is_cuda:
            from .native import invert

            invert(program, self.liquid, self.size, on, self._A, self._pivot, self._W)
        else:
            self._launch(
                program,
                small.invert_serial,
                self.nworld,
                [self.liquid, self.size, on, self._A, self._pivot],
                [self._W],
            )

    def _balance(self, program, st, on, r, gradient, z_out, part_out):
        """What contact and liquid answer, and the result."""
        inverse = self._inverse
        self._launch(
            program,
            small.small_forces,
            self._u.shape,
            [self.liquid, self.size, self._G, self._u, self._norm, st, on],
            [self._q, self._largest],
        )
        if self._alone:
            self._launch(
                program,
                one.correct,
                (one.PARTS, self._nodes[0]),
                [self.liquid, inverse.half, inverse.rest, self._free, self.node, self.size, self._q, on],
                [self._corrections],
            )
            self._launch(
                program,
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
            program,
            sides.load_balance,
            self._nodes,
            [self.liquid, self._free, self.slot, r, gradient, self._q, self._norm, self._largest, st, on],
            [self._side],
        )
        inverse.multiply(program, self._side, *self._answer)
        self._launch(
            program,
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

    def measure_tangents(
        self, program: Launcher, geoms: "GeomSet", x: wp.array, tangent_out: wp.array
    ) -> None:
        """See `precondition.Preconditioner`."""
        outer, rows = self._outer, (self.capacity, self.nworld)
        if self._row_group is None:
            with wp.ScopedDevice(self.device):
                self._row_group = wp.zeros(rows, dtype=int)
                self._row_part = wp.zeros(rows, dtype=wp.spatial_matrixd)
        surface, nsample = outer.surface, len(self.m.sample)
        touched = [surface.start, surface.slot, nsample, outer.touching, outer.trial_geom, geoms.struct.group]
        here = [self.size, self.node]
        program.launch(body_tangent.group_rows, rows, [*here, *touched], [self._row_group])
        dragged = [self.liquid, *here, self._G, x, self._row_group]
        program.launch(body_tangent.drag_rows, rows, dragged, [self._row_part])
        sums = [self.size, self._row_group, self._row_part]
        program.launch(body_tangent.sum_rows, tangent_out.shape, sums, [tangent_out])


class DenseInverse:
    """The dense inverse of a stiffness as a half-precision matrix; sums are in single precision.

    Rounding the matrix (4e-4) makes a slightly different but still symmetric preconditioner, which costs
    nothing as long as everything is computed from the same rounded entries. Rounding the right-hand side
    would cost: contact makes results that are small differences of large ones. So it travels as a sum of two
    halves, 22 bits in all.

    Nearly incompressible rubber gives way to changes of volume lambda / mu times less than to others: rounded
    to half precision the inverse no longer knows how much less. Of a skin that hangs from little it is not
    even positive: what it gives way as a whole is far more than what single nodes do. A second matrix then
    has what rounding took. By torch on CUDA, by numpy on the CPU.

    Args:
      stiffness: scipy sparse matrix, positive definite. device: Warp device.
      two: there is a second matrix; False: where the rounded one alone is not (soundly) positive definite.

    Attributes:
      half, rest: Warp arrays (padded, padded) of the inverse over `scale`, and of what rounding took times
        `sides.LOW`, empty where that is not kept.
    """

    def __init__(self, stiffness: sp.csc_matrix, device: wp.Device, two: bool):
        if device.is_cuda:
            import torch

            made = torch.tensor(stiffness.toarray(), device=wp.device_to_torch(device))
            made = torch.cholesky_inverse(torch.linalg.cholesky(made))
            size, self.scale = len(made), float(made.abs().max())
            self.padded = -(-size // _ALIGN) * _ALIGN
            inside = (slice(size), slice(size))
            self._matrix = made.new_zeros((self.padded, self.padded), dtype=torch.float16)
            self._matrix[inside] = made / self.scale
            self._rest = self._matrix[:0]
            if not two:
                kept = self._matrix[inside] - (_SOUND / self.scale) * made
                two = bool(torch.linalg.cholesky_ex(kept).info)
                del kept
            if two:
                self._rest = torch.zeros_like(self._matrix)
                self._rest[inside] = (made / self.scale - self._matrix[inside]) * sides.LOW
            self.half, self.rest = wp.from_torch(self._matrix), wp.from_torch(self._rest)
        else:
            inverse = np.linalg.inv(stiffness.toarray())
            self.scale, self.padded = float(np.abs(inverse).max()), len(inverse)
            inverse /= self.scale
            half = inverse.astype(np.float16)
            if not two:
                try:
                    np.linalg.cholesky(half - _SOUND * inverse)
                except np.linalg.LinAlgError:
                    two = True
            rest = ((inverse - half) * sides.LOW).astype(np.float16)[: None if two else 0]
            self.half, self.rest = (wp.array(a, dtype=wp.float16, ndim=2, device="cpu") for a in (half, rest))
            self._matrix, self._rest = half.astype(np.float32), rest.astype(np.float32)
        self._views = {}

    def multiply(self, program: Launcher, side: wp.array, answer: wp.array, third: wp.array) -> None:
        """answer = inverse times side, (padded, 2 nworld) half -> single; third = remainder times its first
        columns."""
        self._multiply(program, (self._matrix, self._rest), side, (answer, third))

    def multiply_rows(
        self, program: Launcher, rows: Sequence[wp.array], side: wp.array, answer: wp.array
    ) -> None:
        """The same for some rows of the inverse and of its remainder, given as arrays."""
        if program.device.is_cuda:
            self._multiply(program, [self._view(a) for a in rows], side, answer)
        else:
            program.call(lambda: self._matmul([self._view(a) for a in rows], side, answer))

    def _view(self, array):
        if not array.device.is_cuda:
            return array.numpy().astype(np.float32) if array.dtype is wp.float16 else array.numpy()
        if array.ptr not in self._views:  # made once, not while a graph is recorded
            self._views[array.ptr] = wp.to_torch(array)
        return self._views[array.ptr]

    def _multiply(self, program, matrices, side, answers):
        if program.device.is_cuda:
            self._matmul(matrices, side, answers)
        else:
            program.call(lambda: self._matmul(matrices, side, answers))

    def _matmul(self, matrices, side, answers):
        b = self._view(side)
        for matrix, answer, columns in zip(matrices, answers, (side.shape[1], side.shape[1] // 2)):
            if not len(matrix):
                continue
            if not side.device.is_cuda:
                np.matmul(matrix, b[:, :columns], out=self._view(answer))
                continue
            import torch

            x = self._view(answer)
            stream = torch.cuda.ExternalStream(side.device.stream.cuda_stream, device=x.device)
            with torch.cuda.stream(stream):
                torch.mm(matrix, b[:, :columns], out_dtype=torch.float32, out=x)
