"""Linear systems with the consistent tangent: GMRES, made short by the skin's sparse factor, corrected for
contact and liquid as they are, unsymmetric."""

from collections.abc import Callable

import numpy as np

from ..skin.model import SkinModel

__all__ = ["Factors", "RoughInverse", "solve_by_gmres"]

_FACTOR = 80  # products with the tangent that cost as much as a factor
_FEW = 8  # that a solve takes with a factor of the present shape


class Factors:
    """The factor of a skin's stiffness, made anew in the present shape where solves take too long: the steps
    of a press have much the same shape.

    Attributes:
      now: a `skin.precondition.sparse.SparseFactor`.
    """

    def __init__(self, model: SkinModel):
        self._model = model
        self.begin()

    def begin(self) -> None:
        """Begins with the factor at rest: a gradient does not depend on those before."""
        self.now, self._products = self._model.factor, 0

    def watch(self, products: int, x: np.ndarray) -> None:
        """After solves that took so many products with the tangent at x (nvert, 3) [m]."""
        self._products += max(products - _FEW, 0)
        if self._products > _FACTOR:
            self.now, self._products = self._model.factor_at(x), 0


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
        m, nvert = 3 * len(nodes), len(a) // 3
        self._dof = (3 * nodes[:, None] + np.arange(3)).ravel()
        columns = np.zeros((m + 1, 3 * nvert))
        columns[np.arange(m), self._dof], columns[m] = 1.0, a
        self._columns = self._plain(columns)
        felt = np.concatenate([self._columns[:, self._dof], self._columns @ b[:, None]], 1).T
        stiff = np.zeros((m + 1, m + 1))
        stiff[:m, :m], stiff[m, m] = stiffness, 1.0
        self._small = np.linalg.solve(np.eye(m + 1) + stiff @ felt, stiff)

    def __call__(self, v: np.ndarray) -> np.ndarray:
        """Times v (3 nvert,), zero at fixed nodes."""
        y = self._plain(v[None])[0]
        return y - (self._small @ np.append(y[self._dof], self._b @ y)) @ self._columns

    def _plain(self, rows):
        right = np.swapaxes(rows.reshape(len(rows), -1, 3), 0, 1)
        solved = self._factor.solve(np.ascontiguousarray(right))
        return self._soft * np.swapaxes(solved, 0, 1).reshape(len(rows), -1)


def solve_by_gmres(
    product: Callable, inverse: Callable, right: np.ndarray, precision: float, most: int = 400
) -> tuple[np.ndarray, int]:
    """Solution of A x = right, and how many products it took.

    The residual is measured after the inverse, so that `precision` is of x: a skin is a million times stiffer
    against some motions than against others, and a small residual would say little.

    Args:
      product, inverse: A and its approximate inverse times a vector (n,).
      precision: error of x to end at, of its size.
      most: products.

    Raises:
      ValueError: not solved with so many: the matrix is next to singular.
    """
    z = inverse(right)
    size = np.linalg.norm(z)
    if size == 0:
        return z, 0
    basis, along = np.empty((most + 1, len(right))), np.zeros((most + 1, most))
    basis[0] = z / size
    for j in range(most):
        w = inverse(product(basis[j]))
        for _ in range(2):  # once more for what rounding left
            part = basis[: j + 1] @ w
            along[: j + 1, j] += part
            w -= part @ basis[: j + 1]
        along[j + 1, j] = np.linalg.norm(w)
        first = np.zeros(j + 2)
        first[0] = size
        y = np.linalg.lstsq(along[: j + 2, : j + 1], first, rcond=None)[0]
        missed = np.linalg.norm(first - along[: j + 2, : j + 1] @ y)
        if missed <= precision * size:
            return y @ basis[: j + 1], j + 1
        basis[j + 1] = w / along[j + 1, j]
    raise ValueError(
        f"a step's adjoint was not solved with {most} products: its tangent is next to singular, as of skin "
        "that slides freely; look at the step's changes and shorten it"
    )
