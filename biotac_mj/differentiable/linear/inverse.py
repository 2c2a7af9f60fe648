"""Linear systems with the consistent tangent: GMRES, made short by the skin's sparse factor, corrected for
contact and liquid as they are, unsymmetric."""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular

from ...skin.model import SkinModel

__all__ = ["FaceBlocks", "Factors", "RoughInverse", "solve_by_gmres"]

# products too many after which a factor, which costs 75 and saves two to four a step, is made
_FACTOR = 150
_FEW = 16
_CANCELLED = 0.1  # of a vector's length: less is left of it beside the basis, and rounding is felt


class Factors:
    """The factor of a skin's stiffness, made anew in the present shape where solves take too long: the steps
    of a press have much the same shape.

    Attributes:
      now: a `skin.precondition.sparse.SparseFactor`. dof: free coordinates, in the order of its rows.
    """

    def __init__(self, model: SkinModel):
        self._model = model
        self.dof = (3 * model.free[:, None] + np.arange(3)).ravel()
        self.begin()

    def begin(self) -> None:
        """Begins with the factor at rest: a gradient does not depend on those before."""
        self.now, self._products = self._model.factor, 0

    def watch(self, products: int, x: np.ndarray) -> None:
        """After solves that took so many products with the tangent at x (nvert, 3) [m]."""
        self._products += max(products - _FEW, 0)
        if self._products > _FACTOR:
            self.now, self._products = self._model.factor_at(x), 0


class FaceBlocks:
    """Sparse sums of dense blocks of the same faces, whose pattern is found once.

    Args:
      face: (nface, 3) nodes. n: number of nodes.
    """

    def __init__(self, face: np.ndarray, n: int):
        at = (3 * face[:, :, None].astype(np.int64) + np.arange(3)).reshape(len(face), 9)
        entry = 3 * n * at[:, :, None] + at[:, None, :]
        entry, self._place = np.unique(entry, return_inverse=True)
        self._place, self._shape = self._place.ravel(), (3 * n, 3 * n)
        self._column = (entry % (3 * n)).astype(np.int32)
        self._start = np.searchsorted(entry, 3 * n * np.arange(3 * n + 1)).astype(np.int32)

    def sum(self, block: np.ndarray) -> sp.csr_matrix:
        """(3n, 3n) of blocks (nface, 9, 9)."""
        value = np.bincount(self._place, block.ravel(), len(self._column))
        return sp.csr_matrix((value, self._column, self._start), shape=self._shape)


class RoughInverse:
    """(A + N D N' + a b')^-1 by Woodbury's identity, A the stiffness of the factor over `softness`.

    Args:
      factors: of the skin. softness: see `newton.worlds.Worlds`.
      nodes: (m,) free nodes in contact; N takes their coordinates. stiffness: (3m, 3m) D.
      a, b: (3 nvert,), zero at fixed nodes.
    """

    def __init__(
        self,
        factors: Factors,
        softness: float,
        nodes: np.ndarray,
        stiffness: np.ndarray,
        a: np.ndarray,
        b: np.ndarray,
    ):
        self._factor, self._soft, self._b = factors.now, softness, b
        m = 3 * len(nodes)
        self._dof = (3 * nodes[:, None] + np.arange(3)).ravel()
        self._columns = np.zeros((m + 1, len(a)))
        # the factor keeps its inverse's rows, and nodes touch for many steps
        self._columns[:m, factors.dof] = softness * self._factor.rows(nodes)
        if a.any():
            self._columns[m] = self._plain(a)
        felt = np.concatenate([self._columns[:, self._dof], self._columns @ b[:, None]], 1).T
        stiff = np.zeros((m + 1, m + 1))
        stiff[:m, :m], stiff[m, m] = stiffness, 1.0
        self._small = np.linalg.solve(np.eye(m + 1) + stiff @ felt, stiff)

    def __call__(self, v: np.ndarray) -> np.ndarray:
        """Times v (3 nvert,), zero at fixed nodes."""
        y = self._plain(v)
        return y - (self._small @ np.append(y[self._dof], self._b @ y)) @ self._columns

    def _plain(self, v):
        return self._soft * self._factor.solve(v.reshape(-1, 1, 3)).ravel()


def solve_by_gmres(
    product: Callable,
    inverse: Callable,
    right: np.ndarray,
    precision: float,
    start: np.ndarray | None = None,
    most: int = 400,
) -> tuple[np.ndarray, int]:
    """Solution of A x = right, and how many products it took.

    The residual is measured after the inverse, so that `precision` is of x: a skin is a million times stiffer
    against some motions than against others, and a small residual would say little.

    Args:
      product, inverse: A and its approximate inverse times a vector (n,).
      precision: error of x to end at, of its size.
      start: a solution of nearly the same system, from which less is left to find.
      most: products.

    Raises:
      ValueError: not solved with so many: the matrix is next to singular.
    """
    if start is None or not start.any():
        z = inverse(right)
        wanted = precision * np.linalg.norm(z)
        start = np.zeros_like(z)
    else:
        z = inverse(right - product(start))
        wanted = precision * np.linalg.norm(start)
    size = np.linalg.norm(z)
    if size <= wanted:
        return start + z, 0
    basis, along = np.empty((most + 1, len(right))), np.zeros((most + 1, most))
    basis[0], missed = z / size, np.zeros(most + 1)
    turns, missed[0] = np.zeros((most, 2)), size
    for j in range(most):
        w = inverse(product(basis[j]))
        length = np.linalg.norm(w)
        for _ in range(2):
            before, part = length, basis[: j + 1] @ w
            along[: j + 1, j] += part
            w -= part @ basis[: j + 1]
            length = np.linalg.norm(w)
            if length > _CANCELLED * before:
                break  # else once more for what rounding left
        # Givens' rotations keep what is along the basis triangular
        column = along[: j + 1, j]
        for i, (c, s) in enumerate(turns[:j].tolist()):
            column[i], column[i + 1] = c * column[i] + s * column[i + 1], c * column[i + 1] - s * column[i]
        diagonal = float(np.hypot(column[j], length))
        if diagonal == 0:
            break
        c, s = turns[j] = column[j] / diagonal, length / diagonal
        column[j] = diagonal
        missed[j], missed[j + 1] = c * missed[j], -s * missed[j]
        if abs(missed[j + 1]) <= wanted:
            y = solve_triangular(along[: j + 1, : j + 1], missed[: j + 1])
            return start + y @ basis[: j + 1], j + 1
        basis[j + 1] = w / length
    raise ValueError(
        f"a step's adjoint was not solved with {most} products: its tangent is next to singular, as of skin "
        "that slides freely; look at the step's changes and shorten it"
    )
