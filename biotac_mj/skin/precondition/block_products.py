"""Products of the block inverse (`block_inverse`) with right-hand sides of all worlds: the forces of the
pieces on the separators, these times S, then the motion of the pieces. torch multiplies for many worlds, by
tensor cores; with few worlds on CUDA each has a product of its own, whose time is that of reading the
blocks."""

import numpy as np
import warp as wp

from ..program import Launcher
from .block_inverse import DissectedInverse

__all__ = ["Product"]

wp.set_module_options({"enable_backward": False})

_COLUMNS = 8  # worlds are padded to tiles of the tensor cores
_FEW = 4  # worlds up to which each has a product of its own
_ROWS, _THREADS = 16, 256  # rows and threads of a block of that product
_CHUNK = 4096  # entries of a right-hand side in shared memory
_PREFETCH = 4  # reads of a row, eight entries each, that a thread starts before it uses the first


class Product:
    """The inverse times a right-hand side of each world, by matrix products. With few worlds on CUDA each
    world has a product of its own, whose time is that of reading the blocks.

    Args:
      inverse: the blocks. nworld: number of worlds.
      two: whether there is a second right-hand side of each world.

    Attributes:
      side: (rows, halves, columns) right-hand sides, as `right_hand_sides.write_node` stores them.
      answer: (rows, columns); the first row of a node is `DissectedInverse.row`, a world has one column.
      second: side and answer of a second right-hand side, which takes no additional time; or None.
      needs_torch: whether torch computes the products.
    """

    def __init__(self, inverse: DissectedInverse, nworld: int, two: bool = False):
        few = inverse.device.is_cuda and nworld <= _FEW
        self.needs_torch = inverse.device.is_cuda and not few
        self._inverse, self._nworld, self.second = inverse, nworld, None
        columns = _FEW if few else -(-nworld // _COLUMNS) * _COLUMNS
        self._column_offset = (
            nworld if nworld <= _FEW // 2 else _FEW
        )  # columns from a world's first to its second
        if few and two and self._column_offset == _FEW:
            columns *= 2
        k, s, q, first = inverse.npiece, inverse.size, inverse.width, inverse.first
        with wp.ScopedDevice(inverse.device):
            self.side = wp.zeros((inverse.padded, inverse.copies, columns), dtype=wp.float16)
            self.answer = wp.zeros((inverse.padded, columns), dtype=float)
            self._separator_force = wp.zeros((k * q, columns), dtype=float)
        if few:
            if two:
                self.second = self.side[:, :, self._column_offset :], self.answer[:, self._column_offset :]
            # matrix; first row, rows and stride of the right-hand sides; result, its first row and stride
            blocks, lift, separator = inverse.narrow
            self._lift = lift, 0, s, s + q, self._separator_force, 0, q
            self._joint = separator, first, inverse.nseparator, 0, self.answer, first, 0
            self._blocks = blocks, 0, s + q, s + q, self.answer, 0, s + q
            self._multiply = self._multiply_vectors
            return
        side, answer, separator_force = (_view(a) for a in (self.side, self.answer, self._separator_force))
        pieces, separators = side[:first].reshape(k, -1, columns), side[first:].reshape(-1, columns)
        blocks, lift, separator = inverse.wide
        # matrix, right-hand sides, result
        self._lift = lift, pieces[:, : s * inverse.copies], separator_force.reshape(k, q, columns)
        self._joint = separator, separators, answer[first:]
        self._blocks = blocks, pieces, answer[:first].reshape(k, s + q, columns)[:, :s]
        self._multiply = _multiply_matrices

    def run(self, program: Launcher, both: bool = False) -> None:
        """Computes the answer for `side`, whose rows of separators are overwritten; both: also for the second
        right-hand sides."""
        inverse, columns = self._inverse, self.side.shape[2] // 4
        if self.second and not both:
            columns = 1
        self._kernel = multiply_rows[both]
        self._multiply(program, *self._lift)
        program.launch(
            load_separators,
            (inverse.nseparator, columns),
            [
                inverse.first,
                inverse.start,
                inverse.rows,
                self._separator_force,
                inverse.motion_scale,
                inverse.force_scale,
            ],
            [self.side],
        )
        self._multiply(program, *self._joint)
        program.launch(
            load_pieces,
            (inverse.npiece * inverse.width, columns),
            [inverse.first, inverse.size, inverse.width, inverse.of_row, self.answer, inverse.motion_scale],
            [self.side],
        )
        self._multiply(program, *self._blocks)

    def _multiply_vectors(self, program, matrix, side_first, rows, side_stride, answer, first, stride):
        dim = matrix.shape[0], -(-matrix.shape[1] // _ROWS), self._nworld
        places = [self._inverse.copies - 1, rows, side_first, side_stride, first, stride, self._column_offset]
        program.launch_blocks(self._kernel, dim, [matrix, self.side, *places], [answer], _THREADS)


def _multiply_matrices(program, matrix, side, answer):
    if not program.device.is_cuda:
        program.call(lambda: np.matmul(matrix, side.astype(np.float32), out=answer))
        return
    import torch

    stream = torch.cuda.ExternalStream(program.device.stream.cuda_stream, device=matrix.device)
    with torch.cuda.stream(stream):
        multiply = torch.bmm if matrix.ndim == 3 else torch.mm
        multiply(matrix, side, out_dtype=torch.float32, out=answer)


# Each warp of a block has two rows. The right-hand sides are loaded by chunks into shared memory while the
# first entries of the matrix are read, so that the reads of a warp do not wait for each other. A world's
# second right-hand side is `column_offset` columns after the first.
_MULTIPLY = f"""
#if defined(__CUDA_ARCH__)
    __shared__ __align__(16) float part[SIDES][{_CHUNK}];
    const int t = threadIdx.x, lane = t & 31, row = block * {_ROWS} + t / 32 * 2;
    const int n = columns, wide = side.shape[2], there = matrix.shape[1] - row;
    float total[2][SIDES] = {{}};
    for (int from = 0; from < n; from += {_CHUNK}) {{
        const int count = min({_CHUNK}, n - from);
        const wp::half* begin = matrix.data + ((long long)piece * matrix.shape[1] + row) * n + from;
        for (int at = 0; at < count; at += 256 * {_PREFETCH}) {{
            uint4 packed[2][{_PREFETCH}];
            #pragma unroll
            for (int k = 0; k < 2; ++k)
                #pragma unroll
                for (int u = 0; u < {_PREFETCH}; ++u) {{
                    const int i = at + 256 * u + 8 * lane;
                    if (i < count && k < there)
                        packed[k][u] = __ldg((const uint4*)(begin + (long long)k * n + i));
                }}
            if (at == 0) {{
                __syncthreads();
                for (int i = t; i < count; i += {_THREADS}) {{
                    const long long from_row = side_first + (from + i) / columns_each;
                    const wp::half* h = side.data + from_row * side.shape[1] * wide + world;
                    #pragma unroll
                    for (int v = 0; v < SIDES; ++v, h += column_offset)
                        part[v][i] = wp::half_to_float(h[0]) + wp::half_to_float(h[wide]);
                }}
                __syncthreads();
            }}
            #pragma unroll
            for (int u = 0; u < {_PREFETCH}; ++u) {{
                const int i = at + 256 * u + 8 * lane;
                if (i >= count) continue;
                float x[SIDES][8];
                #pragma unroll
                for (int v = 0; v < SIDES; ++v)
                    #pragma unroll
                    for (int j = 0; j < 8; j += 4) *(float4*)&x[v][j] = *(const float4*)&part[v][i + j];
                #pragma unroll
                for (int k = 0; k < 2; ++k) {{
                    if (k >= there) continue;
                    const uint4 four = packed[k][u];
                    const unsigned words[4] = {{four.x, four.y, four.z, four.w}};
                    #pragma unroll
                    for (int j = 0; j < 8; ++j) {{
                        wp::half h;
                        h.u = (unsigned short)(j & 1 ? words[j / 2] >> 16 : words[j / 2] & 0xffffu);
                        const float entry = wp::half_to_float(h);
                        #pragma unroll
                        for (int v = 0; v < SIDES; ++v) total[k][v] += entry * x[v][j];
                    }}
                }}
            }}
        }}
    }}
    #pragma unroll
    for (int k = 0; k < 2; ++k)
        #pragma unroll
        for (int v = 0; v < SIDES; ++v) {{
            for (int far = 16; far > 0; far /= 2)
                total[k][v] += __shfl_xor_sync(0xffffffffu, total[k][v], far);
            if (lane == 0 && k < there)
                answer.data[(long long)(first + row + k) * wide + world + column_offset * v] = total[k][v];
        }}
#endif
"""


def _multiplication(sides):
    @wp.func_native(_MULTIPLY.replace("SIDES", str(sides)))
    def multiply_two_rows(
        piece: int,
        block: int,
        world: int,
        matrix: wp.array3d(dtype=wp.float16),
        side: wp.array3d(dtype=wp.float16),
        columns_each: int,
        columns: int,
        side_first: int,
        first: int,
        column_offset: int,
        answer: wp.array2d(dtype=float),
    ): ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=_THREADS)
    def multiply_rows(
        # In:
        matrix: wp.array3d(dtype=wp.float16),
        side: wp.array3d(dtype=wp.float16),
        columns_each: int,
        rows: int,
        side_first: int,
        side_stride: int,
        first: int,
        stride: int,
        column_offset: int,
        # Out:
        answer_out: wp.array2d(dtype=float),
    ):
        """Matrices of pieces times right-hand sides of a world; each row of these has `columns_each`
        columns."""
        piece, block, world, _t = wp.tid()
        at = side_first + piece * side_stride
        to = first + piece * stride
        columns = rows * columns_each
        multiply_two_rows(
            piece, block, world, matrix, side, columns_each, columns, at, to, column_offset, answer_out
        )

    return multiply_rows


multiply_rows = _multiplication(1), _multiplication(2)


# Four worlds for each thread, read and written together; columns are padded to whole groups of four.
_FOUR = """
    struct alignas(16) Four { float v[4]; };
    struct alignas(8) Halves { wp::half v[4]; };
    const int copies = side.shape[1], columns = side.shape[2];
"""
_WRITE = """
    Halves high, low;
    for (int k = 0; k < 4; ++k) {
        high.v[k] = wp::float_to_half(total.v[k]);
        low.v[k] = wp::float_to_half(total.v[k] - wp::half_to_float(high.v[k]));
    }
    *(Halves*)at = high;
    *(Halves*)(at + columns) = low;
    if (copies == 3) *(Halves*)(at + 2 * columns) = high;
"""


@wp.func_native(f"""
    {_FOUR}
    wp::half* at = side.data + (long long)(first + j) * copies * columns + 4 * c;
    const Halves a = *(const Halves*)at, b = *(const Halves*)(at + columns);
    Four total;
    for (int k = 0; k < 4; ++k) total.v[k] = wp::half_to_float(a.v[k]) + wp::half_to_float(b.v[k]);
    for (int i = start.data[j]; i < start.data[j + 1]; ++i) {{
        const Four f = *(const Four*)(separator_force.data + (long long)rows.data[i] * columns + 4 * c);
        for (int k = 0; k < 4; ++k) total.v[k] -= motion_scale * f.v[k];
    }}
    for (int k = 0; k < 4; ++k) total.v[k] *= force_scale;
    {_WRITE}
""")
def load_separator(
    j: int,
    c: int,
    first: int,
    start: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    separator_force: wp.array2d(dtype=float),
    motion_scale: float,
    force_scale: float,
    side: wp.array3d(dtype=wp.float16),
): ...


@wp.func_native(f"""
    {_FOUR}
    Four total = *(const Four*)(answer.data + (long long)separator * columns + 4 * c);
    for (int k = 0; k < 4; ++k) total.v[k] *= factor;
    wp::half* at = side.data + (long long)row * copies * columns + 4 * c;
    {_WRITE}
""")
def load_piece(
    separator: int,
    row: int,
    c: int,
    answer: wp.array2d(dtype=float),
    factor: float,
    side: wp.array3d(dtype=wp.float16),
): ...


@wp.kernel
def load_separators(
    # In:
    first: int,
    start: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    separator_force: wp.array2d(dtype=float),
    motion_scale: float,
    force_scale: float,
    # In and out:
    side: wp.array3d(dtype=wp.float16),
):
    """Right-hand side of row j of the separators, after the pieces, summed in a fixed order."""
    j, c = wp.tid()
    load_separator(j, c, first, start, rows, separator_force, motion_scale, force_scale, side)


@wp.kernel
def load_pieces(
    # In:
    first: int,
    size: int,
    width: int,
    of_row: wp.array(dtype=int),
    answer: wp.array2d(dtype=float),
    factor: float,
    # Out:
    side_out: wp.array3d(dtype=wp.float16),
):
    """Motion of the separators at a piece, as rows of its right-hand side."""
    k, c = wp.tid()
    j = of_row[k]
    if j >= 0:
        row = (k // width) * (size + width) + size + k % width
        load_piece(first + j, row, c, answer, factor, side_out)


def _view(array):
    return wp.to_torch(array) if array.device.is_cuda else array.numpy()
