"""Linear systems with the consistent tangent, for all worlds of a skin: GMRES with an approximate inverse
that includes the unsymmetric contact and liquid terms."""

import typing
from collections.abc import Callable

import numpy as np
import torch
import warp as wp

from ..skin import SkinWorlds
from ..tensors import add_rows
from .factors import Factors

_CANCELLED = 0.1  # fraction of a vector's length below which it is orthogonalised again, against rounding
_MOST = 400  # products of a solve
# reduction of a residual by a single-precision inverse before it is recomputed; size of the basis then,
# before a restart
_DIGITS, _BASIS = 1e-4, 40
# blocks of a face's nine that the skin's surfaces store: of two of its corners
_PAIRS = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)


class FaceBlocks:
    """A matrix over the nodes of all worlds: a sum of dense blocks of faces.

    Args:
      face: (m,) numbers of the faces. node: (m, 3) of their nodes, row by row of [node, world].
      block: (m, 9, 9).
    """

    def __init__(self, face: torch.Tensor, node: torch.Tensor, block: torch.Tensor):
        self.face, self.node, self.block = face, node, block

    @classmethod
    def of(cls, face: torch.Tensor, node: torch.Tensor, block: torch.Tensor) -> typing.Self:
        """Sum of blocks of samples, several per face (m,)."""
        which, place = torch.unique(face, return_inverse=True)
        nodes = node.new_zeros((len(which), 3))
        nodes[place] = node
        return cls(which, nodes, add_rows(block.new_zeros((len(which), 9, 9)), place, block))

    @classmethod
    def joined(cls, parts: list[typing.Self]) -> typing.Self:
        """Sum of several matrices."""
        return cls(
            *(torch.cat([getattr(part, name) for part in parts]) for name in ("face", "node", "block"))
        )

    def multiply(self, v: torch.Tensor, transpose: bool = False) -> torch.Tensor:
        """The matrix, or its transpose, times v (nvert, nworld, 3)."""
        felt = v.reshape(-1, 3)[self.node].reshape(-1, 9, 1)
        felt = torch.bmm(self.block.mT if transpose else self.block, felt)
        out = v.new_zeros(v.shape)
        add_rows(out.view(-1, 3), self.node, felt)
        return out


class FactorInverse:
    """(A - B + a b')^-1 of each world by the Woodbury identity, on the CPU; A is the stiffness of the factor
    over `softness`. All sums are in double precision: with the steps' preconditioner, whose sums over rows
    are in single precision, GMRES takes as many products, but gradients are off by 1e-3.

    Args:
      factors: of the skin. softness: (nworld,), see `newton.worlds.Worlds`.
      blocks: B, of faces in contact. free: (nvert,) bool, of nodes.
      a, b: (nvert, nworld, 3), zero at fixed nodes; None: zero.
      transpose: of the matrix, with B' and b a'.
    """

    digits, restart = 0.0, _MOST

    def __init__(
        self,
        factors: Factors,
        softness: torch.Tensor,
        blocks: FaceBlocks,
        free: np.ndarray,
        a: torch.Tensor | None,
        b: torch.Tensor | None,
        transpose: bool,
    ):
        self._factor, self._soft, nworld = factors.now, softness.numpy(), len(softness)
        node, block = blocks.node.numpy(), blocks.block.numpy()
        if transpose:
            block, a, b = np.swapaxes(block, 1, 2), b, a
        self._worlds, size = [], 3 * len(free)
        for w, soft in enumerate(self._soft):
            mine = node[:, 0] % nworld == w
            corner = node[mine] // nworld
            nodes = np.unique(corner)
            nodes = nodes[free[nodes]]
            m = 3 * len(nodes)
            place = np.full(len(free), -1)
            place[nodes] = np.arange(len(nodes))
            at = np.where(place[corner] < 0, -m, 3 * place[corner])
            at = (at[:, :, None] + np.arange(3)).reshape(-1, 9)
            entry = m * at[:, :, None] + at[:, None, :]
            known = (at[:, :, None] >= 0) & (at[:, None, :] >= 0)
            stiff = np.zeros((m + 1, m + 1))
            stiff[:m, :m] = -np.bincount(entry[known], block[mine][known], m * m).reshape(m, m)
            stiff[m, m] = 1.0
            dof = (3 * nodes[:, None] + np.arange(3)).ravel()
            columns, along = np.zeros((m + 1, size)), np.zeros(size)
            # the factor caches columns of its inverse, and nodes stay in contact for many steps
            columns[:m, factors.dof] = soft * self._factor.rows(nodes)
            if a is not None:
                columns[m] = soft * self._factor.solve(a[:, w : w + 1].numpy()).ravel()
                along = b[:, w].numpy().ravel()
            felt = np.concatenate([columns[:, dof], columns @ along[:, None]], 1).T
            self._worlds.append((dof, along, columns, np.linalg.solve(np.eye(m + 1) + stiff @ felt, stiff)))

    def __call__(self, v: torch.Tensor) -> torch.Tensor:
        """Product with v (nvert, nworld, 3), zero at fixed nodes."""
        out = self._soft[:, None] * self._factor.solve(v.numpy())
        for w, (dof, along, columns, small) in enumerate(self._worlds):
            y = out[:, w].ravel()
            y = y - (small @ np.append(y[dof], along @ y)) @ columns
            out[:, w] = y.reshape(-1, 3)
        return torch.from_numpy(out)


class StepInverse:
    """The steps' approximate inverse on the skin's device, with the contact terms of a gradient. The skin has
    no liquid, and is in the state at the end of a step (`record.restore`).

    Args:
      skin: the worlds. outer, core: blocks of the faces of both surfaces in contact. transpose: of the
        transposed matrix.
    """

    def __init__(self, skin: SkinWorlds, outer: FaceBlocks, core: FaceBlocks | None, transpose: bool):
        self._skin, k = skin, skin.solver(skin.geoms).k
        st = skin.data.worlds
        for flag in (st.active, st.running):
            flag.fill_(1)
        st.viscosity.zero_()
        k.norms.fill_(1.0)  # unused: an update has no residual here
        k.r.zero_()
        for state, blocks in ((skin.data.outer, outer), (skin.data.core, core)):
            if state is None:
                continue
            touching, block = wp.to_torch(state.touching), wp.to_torch(state.block)
            touching.zero_()
            if blocks is None:
                continue
            touching.view(-1)[blocks.face] = 1
            # equal for both orders of two corners: contact acts at points between them
            own = blocks.block.transpose(1, 2) if transpose else blocks.block
            own = own.reshape(-1, 3, 3, 3, 3)
            face, world = blocks.face // skin.nworld, blocks.face % skin.nworld
            for i, (a, b) in enumerate(_PAIRS):
                block[6 * face + i, world] = -own[:, a, :, b]
        skin.precondition.run()
        self._r, self._z, self._part = (wp.to_torch(array) for array in (k.r, k.z, k.partial))
        self._chunk = torch.arange(len(self._r), device=self._r.device) // k.chunk
        single = self._r.dtype == torch.float32
        self.digits, self.restart = (_DIGITS, _BASIS) if single else (0.0, _MOST)

    def __call__(self, v: torch.Tensor) -> torch.Tensor:
        """Product with v (nvert, nworld, 3), zero at fixed nodes, in the precision of the step's
        directions."""
        self._r.copy_(v)
        squares = self._part[0].zero_()  # of a right-hand side by chunks of nodes, for scaling
        add_rows(squares, self._chunk, (self._r.double() ** 2).sum(2))
        self._skin.invert.run()
        return self._z.clone()


def solve_by_gmres(
    product: Callable[[torch.Tensor], torch.Tensor],
    inverse: Callable[[torch.Tensor], torch.Tensor],
    right: torch.Tensor,
    precision: float,
    most: int = _MOST,
    digits: float = 0.0,
    restart: int = _MOST,
) -> tuple[torch.Tensor, int]:
    """Solutions of A x = right of all worlds, each with its own A, and the number of products.

    The residual is preconditioned, so that `precision` refers to x: a skin is a million times stiffer against
    some motions than against others, so a small plain residual bounds no error. The basis has the precision
    of the inverse's result.

    Args:
      product, inverse: A and its approximate inverse times a tensor (n, nworld, 3).
      right: (n, nworld, 3).
      precision: relative error of x in each world.
      most: largest number of products.
      digits: reduction of a residual before it is recomputed; 0: never.
      restart: size of the basis.

    Raises:
      ValueError: no convergence within `most`: a matrix is nearly singular.
    """
    x, z = torch.zeros_like(right), inverse(right)
    wanted, count = precision * _lengths(_rows(z)), 0
    while True:
        beta = _lengths(_rows(z))
        going = ~(beta <= wanted)
        if not going.any():
            return x, count
        if count >= most or not np.isfinite(beta).all():
            raise _unsolved(going, count)
        change, more, missed = _cycle(
            product, inverse, z, beta, going, np.maximum(wanted, digits * beta), min(restart, most - count)
        )
        x, count = x + change, count + more
        if digits == 0 and (np.abs(missed) <= wanted)[going].all():
            return x, count
        z = inverse(right - product(x))


def _cycle(product, inverse, z, beta, going, goal, most):
    """One basis, started with z (n, nworld, 3) of lengths beta: changes of x, number of products, and
    remaining residuals of the worlds."""
    nworld = len(beta)
    v = _rows(z)
    basis = v.new_empty((nworld, most + 1, v.shape[1]))
    basis[:, 0] = v * _over(beta, v)
    turns, columns, heads, missed = [], [], [], beta.copy()
    used, on = np.zeros(nworld, int), going.copy()
    for j in range(most):
        w = _rows(inverse(product(_nodes(basis[:, j], z).to(torch.float64))))
        column, length = _project(w, basis[:, : j + 1])
        # Givens rotations keep the projected matrix triangular
        for i, (c, s) in enumerate(turns):
            above, below = column[:, i].copy(), column[:, i + 1].copy()
            column[:, i], column[:, i + 1] = c * above + s * below, c * below - s * above
        diagonal = np.hypot(column[:, j], length)
        if (on & ~(diagonal > 0)).any():
            raise _unsolved(on & ~(diagonal > 0), j + 1)
        diagonal = np.where(diagonal > 0, diagonal, 1.0)
        c, s = column[:, j] / diagonal, length / diagonal
        column[:, j] = diagonal
        turns.append((c, s))
        columns.append(column)
        heads.append(c * missed)
        used[on] = j + 1
        missed = np.where(on, -s * missed, missed)
        on = on & ~(np.abs(missed) <= goal) & np.isfinite(missed)
        if not on.any():
            break
        basis[:, j + 1] = w * _over(length, w)
    k = len(columns)
    triangle, head = np.tile(np.eye(k), (nworld, 1, 1)), np.zeros((nworld, k))
    for j, (column, value) in enumerate(zip(columns, heads)):
        mine = used > j
        triangle[mine, : j + 1, j], head[mine, j] = column[mine], value[mine]
    y = torch.from_numpy(np.linalg.solve(triangle, head[..., None])).to(basis)
    found = (y.transpose(1, 2) @ basis[:, :k])[:, 0]
    return _nodes(found, z).to(torch.float64), k, missed


def _project(w, basis):
    """Removes the projection of w (nworld, n) on a basis (nworld, k, n): returns its coefficients (nworld, k)
    and the lengths of the remainder."""
    along = torch.zeros_like(basis[:, :, 0])
    double = w.dtype == torch.float64
    length = torch.linalg.vector_norm(w, dim=1) if double else None
    for _ in range(2 if double else 1):
        part = (basis @ w[:, :, None])[..., 0]
        along += part
        w -= (part[:, None] @ basis)[:, 0]
        before, length = length, torch.linalg.vector_norm(w, dim=1)
        if not double or (length > _CANCELLED * before).all():
            break  # else again, to remove rounding errors
    felt = torch.cat([along, length[:, None]], 1).double().cpu().numpy()
    return felt[:, :-1], felt[:, -1]


def _rows(v):
    """(nworld, 3 n) of (n, nworld, 3)."""
    return v.transpose(0, 1).reshape(v.shape[1], -1)


def _nodes(v, like):
    """The inverse of `_rows`."""
    n, nworld, _ = like.shape
    return v.reshape(nworld, n, 3).transpose(0, 1).contiguous()


def _lengths(v):
    return v.norm(dim=1).double().cpu().numpy()


def _over(length, like):
    """(nworld, 1) inverse lengths; 0 for length 0."""
    safe = np.where(length > 0, length, 1.0)
    return torch.from_numpy(np.where(length > 0, 1 / safe, 0.0)).to(like)[:, None]


def _unsolved(worlds, products):
    world = int(np.argmax(worlds))
    return ValueError(
        f"the adjoint of a step of world {world} was not solved with {products} products: its tangent is "
        "next to singular, as of skin that slides freely; look at the step's changes and shorten it"
    )
