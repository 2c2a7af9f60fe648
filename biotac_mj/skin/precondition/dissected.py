"""The inverse of a stiffness for many worlds: by dense blocks of a dissection, for the tensor cores.

A few layers of nodes, the joints, part the skin into pieces that touch each other nowhere else. With D the
inverse of a piece whose joints are held, G = D K its motion for motions of the joints (K couples both), and S
the inverse of what the joints feel once the pieces have answered,

    z_joints = S (r_joints - sum G^T r_piece),    z_piece = D r_piece - G z_joints

is the inverse's product with r (George 1973). The blocks have a fifth of the entries of the inverse itself,
and a product of a thousand worlds takes as long as its multiplications.

Blocks are in half precision, sums in single. Rounding (4e-4) makes a slightly different inverse, symmetric
and positive definite still as long as S and each D are, which costs nothing as long as everything is computed
from the same rounded blocks. Rounding the right-hand side would cost: contact makes results that are small
differences of large ones. So it travels as a sum of two halves, 22 bits in all: each column of a block stands
twice in its matrix, beside itself. Nearly incompressible rubber gives way to changes of volume lambda / mu
times less than to others, which rounded blocks no longer know; there, and where rounding leaves too little of
the inverse in some direction, a third column has what rounding took.
"""

import functools
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import warp as wp

from ..program import Launcher
from .dissection import cut
from .sides import LOW

__all__ = ["DissectedInverse", "Product"]

wp.set_module_options({"enable_backward": False})

_ALIGN = 64  # rows, as the tensor cores' tiles have them; ragged sizes run at a third of the speed
_COLUMNS = 8  # worlds likewise
_FEW = 4  # worlds that are multiplied by themselves
_ROWS, _THREADS = 16, 256  # of a block that does that
_PART = 4096  # of a right-hand side that it holds at a time
_AHEAD = 4  # reads of a row, eight entries each, that a thread has under way
_MOST = 32  # pieces that are tried
_CUTS = (0.42, 0.46, 0.48, 0.5, 0.52, 0.54, 0.58)  # share of a piece's nodes on one side
_TRAVEL = 1000  # entries of a block whose product takes as long as one row of joints takes to travel
_SOUND = 0.1  # of the inverse that rounding leaves at least, in every direction
_ROOM = 2.0**14  # of a half, which ends at 65504, and two
_ENTRY = 2.0**6  # largest entry of D and S as they are kept, so that what rounding took is a normal half
_LEAST = 2.0**-10  # that joints move with a piece, as if they did where they do not
_NORM = 2.0**10  # a right-hand side is shorter: RAISE times less than 16, see `sides.load_balance`


class _Parts(NamedTuple):
    """A dissection: nodes of each piece, joints, and the joints that each piece meets (as their numbers)."""

    pieces: list
    joints: np.ndarray
    met: list


class _Blocks(NamedTuple):
    """See the module; and the stiffness inside each piece, and S's inverse."""

    D: list
    G: list
    S: np.ndarray
    inside: list
    schur: np.ndarray


class DissectedInverse:
    """See the module.

    Args:
      stiffness: scipy sparse matrix (3 n, 3 n), positive definite. points: (n, 3) where its nodes are.
      device: Warp device: its matrix products are torch's on CUDA, numpy's on the CPU.
      thirds: there is a third column; False: where the rounded blocks are not sound without.

    Attributes:
      half, rest: Warp arrays (3 n, 3 n) of the entries of the inverse that the blocks make, over `scale`: as
        halves, and what these lack times `sides.LOW`.
      row: (n,) each node's first row in right-hand sides and answers.
      back: an answer times this is the inverse times the right-hand side.
    """

    def __init__(self, stiffness: sp.csc_matrix, points: np.ndarray, device: wp.Device, thirds: bool):
        self.device = device
        parts = _dissect(stiffness, points)
        pieces, joints, met = parts
        # where nothing joins the pieces, rows that are padding
        self.npiece, self.njoint = len(pieces), _padded(3 * max(1, len(joints)))
        self.size = _padded(3 * max(map(len, pieces)))  # rows of a piece
        self.width = _padded(3 * max(1, *map(len, met)), _ALIGN // 2)  # rows of the joints that it meets
        self.first = self.npiece * (self.size + self.width)  # row of the first joint
        self.padded = self.first + self.njoint
        self.row = np.empty(len(points), np.int32)
        for i, piece in enumerate(pieces):
            self.row[piece] = i * (self.size + self.width) + 3 * np.arange(len(piece))
        self.row[joints] = self.first + 3 * np.arange(len(joints))

        exact = _blocks(stiffness.tocsr(), parts)
        D, G, S = exact.D, exact.G, exact.S
        largest = max(np.abs(a).max(initial=0.0) for a in (S, *D))
        # how large what travels can become: what joints are told, and what they answer; of two, so that
        # nothing is rounded by it
        told = _NORM * (1.0 + np.sqrt(sum((g**2).sum() for g in G)))
        reach = told * max(map(np.linalg.norm, S), default=largest) / largest
        steep = max([_LEAST, *(np.abs(g).max(initial=0.0) for g in G)])
        self.tell = _power(min(1.0, _ROOM / told))
        raised = _power(min(_ENTRY, _ROOM * _ROOM / (steep * reach)))
        self.told = _power(_ROOM / (raised * reach))
        raised /= largest
        self.back = 1.0 / raised

        blocks = np.zeros((self.npiece, self.size, self.size + self.width))
        lift = np.zeros((self.npiece, self.width, self.size))
        joint = np.zeros((self.njoint, self.njoint))
        for i, (d, g) in enumerate(zip(D, G, strict=True)):
            rows, columns = slice(len(d)), slice(self.size, self.size + g.shape[1])
            blocks[i, rows, rows], blocks[i, rows, columns] = d * raised, -g / self.told
            lift[i, : g.shape[1], rows] = g.T / self.told  # rounded as in `blocks`
        joint[: len(S), : len(S)] = S * (raised / self.tell)
        wanted = blocks, lift, joint
        halves = [a.astype(np.float16) for a in wanted]
        columns = [halves, halves]
        kept = self._unpack(parts, *halves)
        if thirds or not _sound(exact, *kept, parts.met):
            columns.append([(a - h).astype(np.float16) for a, h in zip(wanted, halves)])
            kept = self._unpack(parts, *(h.astype(float) + c for h, c in zip(halves, columns[2])))
        self.copies, self._columns = len(columns), columns
        self._write_entries(parts, *kept)

        # which joint's coordinate each row is that a piece has for them, and which rows each coordinate has
        of_row = np.full((self.npiece, self.width), -1, np.int32)
        for i, met in enumerate(parts.met):
            of_row[i, : 3 * len(met)] = _coordinates(met)
        of_row = of_row.ravel()
        rows = np.flatnonzero(of_row >= 0)
        rows = rows[np.argsort(of_row[rows], kind="stable")]
        start = np.searchsorted(of_row[rows], np.arange(self.njoint + 1))
        with wp.ScopedDevice(device):
            self.of_row, self.rows, self.start = (wp.array(a, dtype=int) for a in (of_row, rows, start))

    @functools.cached_property
    def wide(self) -> list:
        """The blocks, what pieces tell joints, and S, for matrix products: each column as often as the
        right-hand side stands in `Product.side`. Torch's tensors on CUDA, numpy's in single precision on the
        CPU."""
        made = [np.stack(c, -1).reshape(*c[0].shape[:-1], -1) for c in zip(*self._columns)]
        if not self.device.is_cuda:
            return [m.astype(np.float32) for m in made]
        import torch

        return [torch.from_numpy(m).to(wp.device_to_torch(self.device)) for m in made]

    @functools.cached_property
    def narrow(self) -> list[wp.array]:
        """The same for vectors, each column once, and what rounding took of it."""
        made = [np.stack(c[1:], -1).reshape(-1, *c[0].shape[-2:-1], (self.copies - 1) * c[0].shape[-1])
                for c in zip(*self._columns)]  # fmt: skip
        return [wp.array(m, dtype=wp.float16, device=self.device) for m in made]

    def product(self, nworld: int, two: bool = False) -> "Product":
        """Arrays for products with a right-hand side of each world; two: or with two of each."""
        return Product(self, nworld, two)

    def _unpack(self, parts, blocks, _lift, joint):
        """D and G of each piece, and S, as matrices have them."""
        D, G = [], []
        for i, (piece, met) in enumerate(zip(parts.pieces, parts.met, strict=True)):
            rows, columns = slice(3 * len(piece)), slice(self.size, self.size + 3 * len(met))
            D.append(blocks[i, rows, rows].astype(float) * self.back)
            G.append(-blocks[i, rows, columns].astype(float) * self.told)
        n = slice(3 * len(parts.joints))
        return D, G, joint[n, n].astype(float) * (self.tell * self.back)

    def _write_entries(self, parts, D, G, S):
        """`half`, `rest` and `scale`."""
        at = _coordinates(parts.joints)
        # what joints feel of a force anywhere, from both sides of S
        felt = np.zeros((3 * len(self.row), len(at)))
        felt[at, np.arange(len(at))] = 1.0
        for piece, met, g in zip(parts.pieces, parts.met, G, strict=True):
            felt[np.ix_(_coordinates(piece), _coordinates(met))] = -g
        if self.device.is_cuda:
            import torch

            def given(a):
                return torch.from_numpy(a).to(wp.device_to_torch(self.device))
        else:

            def given(a):
                return a.astype(np.float32) if a.dtype == float else a

        felt, S = given(felt), given(S)
        made = (felt @ S) @ felt.T
        for piece, d in zip(parts.pieces, D, strict=True):
            rows = given(_coordinates(piece))
            made[rows[:, None], rows] += given(d)
        self.scale = float(abs(made).max())
        made /= self.scale
        if self.device.is_cuda:
            half = made.half()
            self._kept = half, ((made - half) * LOW).half()  # whose memory the arrays share
            self.half, self.rest = (wp.from_torch(a) for a in self._kept)
        else:
            half = made.astype(np.float16)
            rest = ((made - half) * np.float32(LOW)).astype(np.float16)
            self.half, self.rest = (wp.array(a, dtype=wp.float16, device="cpu") for a in (half, rest))


class Product:
    """The inverse times a right-hand side of each world: by matrix products, of few worlds on CUDA each by
    itself, which takes as long as reading the blocks.

    Attributes:
      side: (rows, halves, columns) right-hand sides, as `sides.write_node` writes them.
      answer: (rows, columns); a node's first row is `DissectedInverse.row`, a world's column its number.
      second: side and answer of the second right-hand sides, which take no longer beside the first; None
        where there are none.
      needs_torch: torch multiplies.
    """

    def __init__(self, inverse: DissectedInverse, nworld: int, two: bool = False):
        few = inverse.device.is_cuda and nworld <= _FEW
        self.needs_torch = inverse.device.is_cuda and not few
        self._inverse, self._nworld, self.second = inverse, nworld, None
        columns = _FEW if few else -(-nworld // _COLUMNS) * _COLUMNS
        self._apart = nworld if nworld <= _FEW // 2 else _FEW  # columns from a world's first to its second
        if few and two and self._apart == _FEW:
            columns *= 2
        k, s, q, first = inverse.npiece, inverse.size, inverse.width, inverse.first
        with wp.ScopedDevice(inverse.device):
            self.side = wp.zeros((inverse.padded, inverse.copies, columns), dtype=wp.float16)
            self.answer = wp.zeros((inverse.padded, columns), dtype=float)
            self._felt = wp.zeros((k * q, columns), dtype=float)
        if few:
            if two:
                self.second = self.side[:, :, self._apart :], self.answer[:, self._apart :]
            # a matrix; first row, rows and stride of the pieces' sides; where the result begins, its stride
            blocks, lift, joint = inverse.narrow
            self._lift = lift, 0, s, s + q, self._felt, 0, q
            self._joint = joint, first, inverse.njoint, 0, self.answer, first, 0
            self._blocks = blocks, 0, s + q, s + q, self.answer, 0, s + q
            self._multiply = self._multiply_vectors
            return
        side, answer, felt = (_view(a) for a in (self.side, self.answer, self._felt))
        pieces, joints = side[:first].reshape(k, -1, columns), side[first:].reshape(-1, columns)
        blocks, lift, joint = inverse.wide
        # a matrix, what it is multiplied by, and where the result lies
        self._lift = lift, pieces[:, : s * inverse.copies], felt.reshape(k, q, columns)
        self._joint = joint, joints, answer[first:]
        self._blocks = blocks, pieces, answer[:first].reshape(k, s + q, columns)[:, :s]
        self._multiply = _multiply_matrices

    def run(self, program: Launcher, both: bool = False) -> None:
        """The answer to what is in `side`, whose rows of joints it overwrites; both: to the second right-hand
        sides too."""
        inverse, columns = self._inverse, self.side.shape[2] // 4
        if self.second and not both:
            columns = 1
        self._kernel = multiply_rows[both]
        self._multiply(program, *self._lift)
        program.launch(
            tell_joints,
            (inverse.njoint, columns),
            [inverse.first, inverse.start, inverse.rows, self._felt, inverse.told, inverse.tell],
            [self.side],
        )
        self._multiply(program, *self._joint)
        program.launch(
            tell_pieces,
            (inverse.npiece * inverse.width, columns),
            [inverse.first, inverse.size, inverse.width, inverse.of_row, self.answer, inverse.told],
            [self.side],
        )
        self._multiply(program, *self._blocks)

    def _multiply_vectors(self, program, matrix, side_first, rows, side_stride, answer, first, stride):
        dim = matrix.shape[0], -(-matrix.shape[1] // _ROWS), self._nworld
        places = [self._inverse.copies - 1, rows, side_first, side_stride, first, stride, self._apart]
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


# A block's warps have two rows each; the right-hand sides come by parts that fit, while the matrix's first
# entries are on their way: a warp's reads do not wait for each other. A world's second one is `apart` columns
# on.
_MULTIPLY = f"""
#if defined(__CUDA_ARCH__)
    __shared__ __align__(16) float part[SIDES][{_PART}];
    const int t = threadIdx.x, lane = t & 31, row = block * {_ROWS} + t / 32 * 2;
    const int n = columns, wide = side.shape[2], there = matrix.shape[1] - row;
    float total[2][SIDES] = {{}};
    for (int from = 0; from < n; from += {_PART}) {{
        const int count = min({_PART}, n - from);
        const wp::half* begin = matrix.data + ((long long)piece * matrix.shape[1] + row) * n + from;
        for (int at = 0; at < count; at += 256 * {_AHEAD}) {{
            uint4 packed[2][{_AHEAD}];
            #pragma unroll
            for (int k = 0; k < 2; ++k)
                #pragma unroll
                for (int u = 0; u < {_AHEAD}; ++u) {{
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
                    for (int v = 0; v < SIDES; ++v, h += apart)
                        part[v][i] = wp::half_to_float(h[0]) + wp::half_to_float(h[wide]);
                }}
                __syncthreads();
            }}
            #pragma unroll
            for (int u = 0; u < {_AHEAD}; ++u) {{
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
                answer.data[(long long)(first + row + k) * wide + world + apart * v] = total[k][v];
        }}
#endif
"""


def _of_sides(sides):
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
        apart: int,
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
        apart: int,
        # Out:
        answer_out: wp.array2d(dtype=float),
    ):
        """Matrices of pieces times right-hand sides of a world; each row of that meets so many columns."""
        piece, block, world, _t = wp.tid()
        at = side_first + piece * side_stride
        to = first + piece * stride
        columns = rows * columns_each
        multiply_two_rows(piece, block, world, matrix, side, columns_each, columns, at, to, apart, answer_out)

    return multiply_rows


multiply_rows = _of_sides(1), _of_sides(2)


# Four worlds a thread, read and written at once; their columns are there even where there is no such world.
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
        const Four f = *(const Four*)(felt.data + (long long)rows.data[i] * columns + 4 * c);
        for (int k = 0; k < 4; ++k) total.v[k] -= told * f.v[k];
    }}
    for (int k = 0; k < 4; ++k) total.v[k] *= tell;
    {_WRITE}
""")
def tell_joint(
    j: int,
    c: int,
    first: int,
    start: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    felt: wp.array2d(dtype=float),
    told: float,
    tell: float,
    side: wp.array3d(dtype=wp.float16),
): ...


@wp.func_native(f"""
    {_FOUR}
    Four total = *(const Four*)(answer.data + (long long)joint * columns + 4 * c);
    for (int k = 0; k < 4; ++k) total.v[k] *= factor;
    wp::half* at = side.data + (long long)row * copies * columns + 4 * c;
    {_WRITE}
""")
def tell_piece(
    joint: int,
    row: int,
    c: int,
    answer: wp.array2d(dtype=float),
    factor: float,
    side: wp.array3d(dtype=wp.float16),
): ...


@wp.kernel
def tell_joints(
    # In:
    first: int,
    start: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    felt: wp.array2d(dtype=float),
    told: float,
    tell: float,
    # In and out:
    side: wp.array3d(dtype=wp.float16),
):
    """What the joints feel once the pieces have answered, in a fixed order."""
    j, c = wp.tid()
    tell_joint(j, c, first, start, rows, felt, told, tell, side)


@wp.kernel
def tell_pieces(
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
    """How the joints that each piece meets have moved."""
    k, c = wp.tid()
    j = of_row[k]
    if j >= 0:
        row = (k // width) * (size + width) + size + k % width
        tell_piece(first + j, row, c, answer, factor, side_out)


def _uneven(middle, left, right):
    return middle + abs(left - right) / 2  # all pieces take as long as the largest


def _dissect(stiffness, points):
    """The dissection whose product takes least: the largest piece is cut again and again."""
    near = sp.coo_matrix(stiffness)
    n = len(points)
    near = sp.coo_matrix((np.ones(near.nnz), (near.row // 3, near.col // 3)), shape=(n, n)).tocsr()
    pieces, joints = [np.arange(n)], np.zeros(0, int)
    best, least = None, np.inf
    for _ in range(_MOST - 1):
        pieces.sort(key=len)
        largest = pieces.pop()
        middle, *sides = cut(near[largest][:, largest], points[largest], _CUTS, _uneven)
        pieces += [largest[side] for side in sides if len(side)]
        joints = np.concatenate([joints, largest[middle]])
        number = np.full(n, -1)
        number[joints] = np.arange(len(joints))
        met = [number[np.unique(near[piece].indices)] for piece in pieces]
        met = [one[one >= 0] for one in met]
        k, t = len(pieces), _padded(3 * len(joints))
        s, q = _padded(3 * max(map(len, pieces))), _padded(3 * max(map(len, met)), _ALIGN // 2)
        cost = k * s * (s + 2 * q) + t * t + _TRAVEL * (k * q + 2 * t)
        if cost < least:
            best, least = _Parts(list(pieces), joints, met), cost
        if len(pieces[-1]) < _ALIGN:
            break
    return best


def _blocks(stiffness, parts):
    at = _coordinates(parts.joints)
    schur = stiffness[at][:, at].toarray()
    D, G, inside = [], [], []
    for piece, met in zip(parts.pieces, parts.met, strict=True):
        rows, columns = _coordinates(piece), _coordinates(met)
        own = stiffness[rows]
        to_joints = own[:, at[columns]].toarray()
        inside.append(own[:, rows])
        d = np.linalg.inv(inside[-1].toarray())
        D.append((d + d.T) / 2)
        G.append(D[-1] @ to_joints)
        schur[np.ix_(columns, columns)] -= to_joints.T @ G[-1]
    S = np.linalg.inv(schur)
    return _Blocks(D, G, (S + S.T) / 2, inside, schur)


def _sound(exact, D, G, S, met) -> bool:
    """Whether rounded blocks leave enough of the inverse in every direction, and a rounded G lends motions of
    the joints little energy."""
    lent = np.zeros_like(exact.schur)
    for g, wanted, k, one in zip(G, exact.G, exact.inside, met, strict=True):
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
