"""The inverse of a stiffness for many worlds, by dense blocks of a nested dissection, for tensor cores.

A few layers of nodes, the separators, divide the skin into pieces that are not connected otherwise. With D
the inverse of a piece with fixed separators, G = D K its motion by unit motions of the separators (K couples
both), and S the inverse of the separators' Schur complement,

    z_separators = S (r_separators - sum G^T r_piece),    z_piece = D r_piece - G z_separators

is the inverse times r (George 1973). The blocks have a fifth of the entries of the inverse, and a product of
a thousand worlds is limited by its multiplications.

Blocks are in half precision, sums in single. Rounding (4e-4) gives a slightly different inverse, which is
still symmetric and positive definite if S and each D are, provided that everything is computed from the same
rounded blocks. Rounding of the right-hand side would cause errors, since contact makes results that are small
differences of large numbers. It is therefore a sum of two half-precision numbers, 22 bits together: each
column of a block stands twice in its matrix. Nearly incompressible rubber is lambda / mu times stiffer
against changes of volume than against shear, and rounded blocks lose that. There, and where rounding leaves
too little of the inverse in some direction, a third column has the rounding errors."""

import functools
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import warp as wp

from ..program import Launcher
from .nested_dissection import cut
from .right_hand_sides import LOW

__all__ = ["DissectedInverse", "Product"]

wp.set_module_options({"enable_backward": False})

_ALIGN = 64  # rows are padded to tiles of the tensor cores; other sizes run at a third of the speed
_COLUMNS = 8  # worlds likewise
_FEW = 4  # worlds up to which each has a product of its own
_ROWS, _THREADS = 16, 256  # rows and threads of a block of that product
_CHUNK = 4096  # entries of a right-hand side in shared memory
_PREFETCH = 4  # reads of a row, eight entries each, that a thread starts before it uses the first
_MAX_PIECES = 32  # pieces that are tried
_CUTS = (0.42, 0.46, 0.48, 0.5, 0.52, 0.54, 0.58)  # fractions of a piece's nodes on one side that are tried
_TRAVEL = 1000  # entries of a block whose product takes the time of one row of separators between pieces
_SOUND = 0.1  # least fraction of the inverse that must remain after rounding, in every direction
_HALF_RANGE = 2.0**14  # numbers up to this are safe in half precision, which ends at 65504
_ENTRY = 2.0**6  # largest stored entry of D and S, so that rounding errors are normal half-precision numbers
_LEAST_MOTION = 2.0**-10  # lower limit of the largest entry of G
_NORM = 2.0**10  # upper bound of a right-hand side: 16 times RAISE, see `right_hand_sides.load_difference`


class _Dissection(NamedTuple):
    """Nodes of each piece, separators, and the indices of the separators at each piece."""

    pieces: list
    separators: np.ndarray
    piece_separators: list


class _Blocks(NamedTuple):
    """D, G, S as in the module's docstring, the stiffness inside each piece, and the inverse of S."""

    D: list
    G: list
    S: np.ndarray
    inside: list
    schur: np.ndarray


class DissectedInverse:
    """The block inverse of a stiffness, see the module's docstring.

    Args:
      stiffness: scipy sparse matrix (3 n, 3 n), positive definite. points: (n, 3) positions of its nodes.
      device: Warp device. Matrix products are computed by torch on CUDA, and by numpy on the CPU.
      thirds: whether there is a third column; False: only if the rounded blocks need it.

    Attributes:
      half, rest: Warp arrays (3 n, 3 n) with the entries of the inverse over `scale` in half precision, and
        the rounding error times `right_hand_sides.LOW`.
      row: (n,) first row of each node in right-hand sides and answers.
      back: factor from an answer to the inverse times the right-hand side.
    """

    def __init__(self, stiffness: sp.csc_matrix, points: np.ndarray, device: wp.Device, thirds: bool):
        self.device = device
        dissection = _dissect(stiffness, points)
        pieces, separators, piece_separators = dissection
        # at least one separator, which may be padding
        self.npiece, self.nseparator = len(pieces), _padded(3 * max(1, len(separators)))
        self.size = _padded(3 * max(map(len, pieces)))  # rows of a piece
        self.width = _padded(
            3 * max(1, *map(len, piece_separators)), _ALIGN // 2
        )  # rows of the separators that it meets
        self.first = self.npiece * (self.size + self.width)  # row of the first separator
        self.padded = self.first + self.nseparator
        self.row = np.empty(len(points), np.int32)
        for i, piece in enumerate(pieces):
            self.row[piece] = i * (self.size + self.width) + 3 * np.arange(len(piece))
        self.row[separators] = self.first + 3 * np.arange(len(separators))

        exact = _blocks(stiffness.tocsr(), dissection)
        D, G, S = exact.D, exact.G, exact.S
        largest = max(np.abs(a).max(initial=0.0) for a in (S, *D))
        # bounds of the forces on the separators and of their motions; scales are powers of two, which do not
        # round
        force = _NORM * (1.0 + np.sqrt(sum((g**2).sum() for g in G)))
        reach = force * max(map(np.linalg.norm, S), default=largest) / largest
        steep = max([_LEAST_MOTION, *(np.abs(g).max(initial=0.0) for g in G)])
        self.force_scale = _power(min(1.0, _HALF_RANGE / force))
        raised = _power(min(_ENTRY, _HALF_RANGE * _HALF_RANGE / (steep * reach)))
        self.motion_scale = _power(_HALF_RANGE / (raised * reach))
        raised /= largest
        self.back = 1.0 / raised

        blocks = np.zeros((self.npiece, self.size, self.size + self.width))
        lift = np.zeros((self.npiece, self.width, self.size))
        separator = np.zeros((self.nseparator, self.nseparator))
        for i, (d, g) in enumerate(zip(D, G, strict=True)):
            rows, columns = slice(len(d)), slice(self.size, self.size + g.shape[1])
            blocks[i, rows, rows], blocks[i, rows, columns] = d * raised, -g / self.motion_scale
            lift[i, : g.shape[1], rows] = g.T / self.motion_scale  # rounded as in `blocks`
        separator[: len(S), : len(S)] = S * (raised / self.force_scale)
        wanted = blocks, lift, separator
        halves = [a.astype(np.float16) for a in wanted]
        columns = [halves, halves]
        rounded = self._unpack(dissection, *halves)
        if thirds or not _sound(exact, *rounded, dissection.piece_separators):
            columns.append([(a - h).astype(np.float16) for a, h in zip(wanted, halves)])
            rounded = self._unpack(dissection, *(h.astype(float) + c for h, c in zip(halves, columns[2])))
        self.copies, self._columns = len(columns), columns
        self._write_entries(dissection, *rounded)

        # which separator's coordinate each row is that a piece has for them, and which rows each coordinate
        # has
        of_row = np.full((self.npiece, self.width), -1, np.int32)
        for i, piece_separators in enumerate(dissection.piece_separators):
            of_row[i, : 3 * len(piece_separators)] = _coordinates(piece_separators)
        of_row = of_row.ravel()
        rows = np.flatnonzero(of_row >= 0)
        rows = rows[np.argsort(of_row[rows], kind="stable")]
        start = np.searchsorted(of_row[rows], np.arange(self.nseparator + 1))
        with wp.ScopedDevice(device):
            self.of_row, self.rows, self.start = (wp.array(a, dtype=int) for a in (of_row, rows, start))

    @functools.cached_property
    def wide(self) -> list:
        """Matrices for products: blocks, G^T, and S, each column as often as a right-hand side is stored in
        `Product.side`. Torch tensors on CUDA, numpy arrays in single precision on the CPU."""
        made = [np.stack(c, -1).reshape(*c[0].shape[:-1], -1) for c in zip(*self._columns)]
        if not self.device.is_cuda:
            return [m.astype(np.float32) for m in made]
        import torch

        return [torch.from_numpy(m).to(wp.device_to_torch(self.device)) for m in made]

    @functools.cached_property
    def narrow(self) -> list[wp.array]:
        """The matrices of `wide` for vectors: each column once, and its rounding error."""
        made = [np.stack(c[1:], -1).reshape(-1, *c[0].shape[-2:-1], (self.copies - 1) * c[0].shape[-1])
                for c in zip(*self._columns)]  # fmt: skip
        return [wp.array(m, dtype=wp.float16, device=self.device) for m in made]

    def product(self, nworld: int, two: bool = False) -> "Product":
        """Arrays for products with one right-hand side of each world, or with one and with two."""
        return Product(self, nworld, two)

    def _unpack(self, dissection, blocks, _lift, separator):
        """D and G of each piece, and S, from the rounded matrices."""
        D, G = [], []
        for i, (piece, piece_separators) in enumerate(
            zip(dissection.pieces, dissection.piece_separators, strict=True)
        ):
            rows, columns = slice(3 * len(piece)), slice(self.size, self.size + 3 * len(piece_separators))
            D.append(blocks[i, rows, rows].astype(float) * self.back)
            G.append(-blocks[i, rows, columns].astype(float) * self.motion_scale)
        n = slice(3 * len(dissection.separators))
        return D, G, separator[n, n].astype(float) * (self.force_scale * self.back)

    def _write_entries(self, dissection, D, G, S):
        """Sets `half`, `rest` and `scale`."""
        at = _coordinates(dissection.separators)
        # forces on the separators by unit forces at all nodes
        separator_force = np.zeros((3 * len(self.row), len(at)))
        separator_force[at, np.arange(len(at))] = 1.0
        for piece, piece_separators, g in zip(dissection.pieces, dissection.piece_separators, G, strict=True):
            separator_force[np.ix_(_coordinates(piece), _coordinates(piece_separators))] = -g
        if self.device.is_cuda:
            import torch

            def given(a):
                return torch.from_numpy(a).to(wp.device_to_torch(self.device))
        else:

            def given(a):
                return a.astype(np.float32) if a.dtype == float else a

        separator_force, S = given(separator_force), given(S)
        made = (separator_force @ S) @ separator_force.T
        for piece, d in zip(dissection.pieces, D, strict=True):
            rows = given(_coordinates(piece))
            made[rows[:, None], rows] += given(d)
        self.scale = float(abs(made).max())
        made /= self.scale
        if self.device.is_cuda:
            half = made.half()
            self._tensors = half, ((made - half) * LOW).half()  # whose memory the arrays share
            self.half, self.rest = (wp.from_torch(a) for a in self._tensors)
        else:
            half = made.astype(np.float16)
            rest = ((made - half) * np.float32(LOW)).astype(np.float16)
            self.half, self.rest = (wp.array(a, dtype=wp.float16, device="cpu") for a in (half, rest))


class Product:
    """The inverse times a right-hand side of each world, by matrix products. With few worlds on CUDA each
    world has a product of its own, whose time is that of reading the blocks.

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


def _cost(middle, left, right):
    return middle + abs(left - right) / 2  # the largest piece determines the time


def _dissect(stiffness, points):
    """The dissection with the fastest product, by repeated division of the largest piece."""
    neighbours = sp.coo_matrix(stiffness)
    n = len(points)
    neighbours = sp.coo_matrix(
        (np.ones(neighbours.nnz), (neighbours.row // 3, neighbours.col // 3)), shape=(n, n)
    ).tocsr()
    pieces, separators = [np.arange(n)], np.zeros(0, int)
    best, least = None, np.inf
    for _ in range(_MAX_PIECES - 1):
        pieces.sort(key=len)
        largest = pieces.pop()
        middle, *sides = cut(neighbours[largest][:, largest], points[largest], _CUTS, _cost)
        pieces += [largest[side] for side in sides if len(side)]
        separators = np.concatenate([separators, largest[middle]])
        number = np.full(n, -1)
        number[separators] = np.arange(len(separators))
        piece_separators = [number[np.unique(neighbours[piece].indices)] for piece in pieces]
        piece_separators = [one[one >= 0] for one in piece_separators]
        k, t = len(pieces), _padded(3 * len(separators))
        s, q = _padded(3 * max(map(len, pieces))), _padded(3 * max(map(len, piece_separators)), _ALIGN // 2)
        cost = k * s * (s + 2 * q) + t * t + _TRAVEL * (k * q + 2 * t)
        if cost < least:
            best, least = _Dissection(list(pieces), separators, piece_separators), cost
        if len(pieces[-1]) < _ALIGN:
            break
    return best


def _blocks(stiffness, dissection):
    at = _coordinates(dissection.separators)
    schur = stiffness[at][:, at].toarray()
    D, G, inside = [], [], []
    for piece, piece_separators in zip(dissection.pieces, dissection.piece_separators, strict=True):
        rows, columns = _coordinates(piece), _coordinates(piece_separators)
        own = stiffness[rows]
        to_separators = own[:, at[columns]].toarray()
        inside.append(own[:, rows])
        d = np.linalg.inv(inside[-1].toarray())
        D.append((d + d.T) / 2)
        G.append(D[-1] @ to_separators)
        schur[np.ix_(columns, columns)] -= to_separators.T @ G[-1]
    S = np.linalg.inv(schur)
    return _Blocks(D, G, (S + S.T) / 2, inside, schur)


def _sound(exact, D, G, S, piece_separators) -> bool:
    """Whether rounded blocks leave enough of the inverse in every direction, and the error of a rounded G
    adds little energy to motions of the separators."""
    lent = np.zeros_like(exact.schur)
    for g, wanted, k, one in zip(G, exact.G, exact.inside, piece_separators, strict=True):
        columns = _coordinates(one)
        lent[np.ix_(columns, columns)] += (g - wanted).T @ (k @ (g - wanted))
    return (
        _positive(_SOUND * exact.schur - lent)
        and _positive(S - _SOUND * exact.S)
        and all(_positive(d - _SOUND * wanted) for d, wanted in zip(D, exact.D, strict=True))
    )


def _positive(matrix):
    return not scipy.linalg.lapack.dpotrf(matrix, lower=True, overwrite_a=True)[1]


def _coordinates(nodes):
    return (3 * np.asarray(nodes)[:, None] + np.arange(3)).ravel()


def _padded(n, align=_ALIGN):
    return -(-n // align) * align


def _power(x):
    """The largest power of two that is not above x."""
    return 2.0 ** np.floor(np.log2(x))


def _view(array):
    return wp.to_torch(array) if array.device.is_cuda else array.numpy()
