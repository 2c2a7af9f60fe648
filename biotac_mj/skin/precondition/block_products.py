"""Products of the block inverse (`block_inverse`) with right-hand sides of all worlds: the forces of the
pieces on the separators, these times S, then the motion of the pieces. On CUDA torch multiplies, by tensor
cores."""

import numpy as np
import warp as wp

from ...kernels import kernel_module
from ..program import Launcher
from .block_inverse import DissectedInverse

kernel_module(__name__)

_COLUMNS = 8  # right-hand sides are padded to tiles of the tensor cores
_APART = 32  # right-hand sides up to which a product takes as long as reading the matrices


class Product:
    """The inverse times right-hand sides, which are sums of `halves`. Few right-hand sides have a column for
    each half, so that every entry of the matrices is read once; more of them have a row for each half, so
    that there are no more results than right-hand sides.

    Args:
      inverse: the blocks. nside: number of right-hand sides.

    Attributes:
      side: (rows, halves, columns) right-hand sides, as `right_hand_sides.write_node` stores them.
      answer: (rows, 1 or halves, columns), to be summed over the halves; the first row of a node is
        `DissectedInverse.row`, a right-hand side has one column.
    """

    def __init__(self, inverse: DissectedInverse, nside: int):
        self._inverse, columns = inverse, -(-nside // _COLUMNS) * _COLUMNS
        k, s, q, first = inverse.npiece, inverse.size, inverse.width, inverse.first
        apart = nside <= _APART and inverse.copies == 2  # a third one has other entries
        halves, each = (inverse.copies, 1) if apart else (1, inverse.copies)
        with wp.ScopedDevice(inverse.device):
            self.side = wp.zeros((inverse.padded, inverse.copies, columns), dtype=wp.float16)
            self.answer = wp.zeros((inverse.padded, halves, columns), dtype=float)
            self._separator_force = wp.zeros((k * q, halves, columns), dtype=float)
        side, answer, separator_force = (_view(a) for a in (self.side, self.answer, self._separator_force))
        columns *= halves
        pieces, separators = side[:first].reshape(k, -1, columns), side[first:].reshape(-1, columns)
        blocks, lift, separator = inverse.single_matrices if apart else inverse.matrices
        # matrix, right-hand sides, result
        self._lift = lift, pieces[:, : s * each], separator_force.reshape(k, q, columns)
        self._joint = separator, separators, answer[first:].reshape(-1, columns)
        self._blocks = blocks, pieces, answer[:first].reshape(k, s + q, columns)[:, :s]

    def run(self, program: Launcher) -> None:
        """Computes the answer for `side`, whose rows of separators are overwritten."""
        inverse, columns = self._inverse, self.side.shape[2] // 4
        _multiply(program, *self._lift)
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
        _multiply(program, *self._joint)
        program.launch(
            load_pieces,
            (inverse.npiece * inverse.width, columns),
            [inverse.first, inverse.size, inverse.width, inverse.of_row, self.answer, inverse.motion_scale],
            [self.side],
        )
        _multiply(program, *self._blocks)


def _multiply(program, matrix, side, answer):
    if not program.device.is_cuda:
        program.call(lambda: np.matmul(matrix, side.astype(np.float32), out=answer))
        return
    import torch

    stream = torch.cuda.ExternalStream(program.device.stream.cuda_stream, device=matrix.device)
    with torch.cuda.stream(stream):
        multiply = torch.bmm if matrix.ndim == 3 else torch.mm
        multiply(matrix, side, out_dtype=torch.float32, out=answer)


# Four worlds for each thread, read and written together; columns are padded to whole groups of four.
_FOUR = """
    struct alignas(16) Four { float v[4]; };
    struct alignas(8) Halves { wp::half v[4]; };
    const int copies = side.shape[1], columns = side.shape[2], halves = answer.shape[1];
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
        const float* from = answer.data + (long long)rows.data[i] * halves * columns + 4 * c;
        for (int h = 0; h < halves; ++h, from += columns) {{
            const Four f = *(const Four*)from;
            for (int k = 0; k < 4; ++k) total.v[k] -= motion_scale * f.v[k];
        }}
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
    answer: wp.array3d(dtype=float),
    motion_scale: float,
    force_scale: float,
    side: wp.array3d(dtype=wp.float16),
): ...


@wp.func_native(f"""
    {_FOUR}
    const float* from = answer.data + (long long)separator * halves * columns + 4 * c;
    Four total = *(const Four*)from;
    for (int h = 1; h < halves; ++h) {{
        const Four f = *(const Four*)(from + h * columns);
        for (int k = 0; k < 4; ++k) total.v[k] += f.v[k];
    }}
    for (int k = 0; k < 4; ++k) total.v[k] *= factor;
    wp::half* at = side.data + (long long)row * copies * columns + 4 * c;
    {_WRITE}
""")
def load_piece(
    separator: int,
    row: int,
    c: int,
    answer: wp.array3d(dtype=float),
    factor: float,
    side: wp.array3d(dtype=wp.float16),
): ...


@wp.kernel
def load_separators(
    # In:
    first: int,
    start: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    separator_force: wp.array3d(dtype=float),
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
    answer: wp.array3d(dtype=float),
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
