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

from .nested_dissection import cut
from .right_hand_sides import LOW

_ALIGN = 64  # rows are padded to tiles of the tensor cores; other sizes run at a third of the speed
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
        # rows of the separators that it meets
        self.width = _padded(3 * max(1, *map(len, piece_separators)), _ALIGN // 2)
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
    def matrices(self) -> list:
        """Matrices for products: blocks, G^T, and S, each column as often as a right-hand side is stored in
        `block_products.Product.side`. Torch tensors on CUDA, numpy arrays in single precision on the CPU."""
        return self._matrices(self._columns)

    @functools.cached_property
    def single_matrices(self) -> list:
        """The same with each column once."""
        return self._matrices(self._columns[:1])

    def _matrices(self, columns):
        made = [np.stack(c, -1).reshape(*c[0].shape[:-1], -1) for c in zip(*columns)]
        if not self.device.is_cuda:
            return [m.astype(np.float32) for m in made]
        import torch

        return [torch.from_numpy(m).to(wp.device_to_torch(self.device)) for m in made]

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
