"""The linearised contact of a condensed step: (1 + D W) df = r, with W the compliance and D the stiffness of
what touches.

Few coordinates are solved directly. Many are solved by conjugate gradients in the inner product of W, in
which 1 + D W is self-adjoint; contact is up to 1e4 times stiffer than the skin, so they are preconditioned by
the same matrix with the springs lumped at the nodes, P = 1 + D' W, of which (1/D' + W) is one Cholesky factor
in single precision: three or four iterations do."""

import numpy as np
from scipy.linalg.blas import sgemv
from scipy.linalg.lapack import dgesv, sgesv, spotrf, spotrs

from .faces import CandidateFaces

__all__ = ["Compliance", "Lumped", "Springs", "solve"]

_ROUNDING = 3e-4  # of entries of W, which come in half precision
_SLIP = 1e-6  # of a node's stiffness, along the direction in which it slips: Coulomb friction has none there
_DIRECT, _COUPLED = 120, 400  # so many coordinates are solved directly; where D is not symmetric
_MAX_CG, _CG_TOLERANCE = 40, 0.1
# of the stiffest node, by which the lumped springs of an old factor may differ where a tangent is asked for
_ALIKE = 0.02
_STALE = 8  # a factor with which conjugate gradients took more iterations is made anew


class Springs:
    """D at the last evaluation of the contact law: faces against geoms, and samples against the core.

    Args:
      faces: CandidateFaces.
      core: (weights B (k, ninner), stiffness (k,)) of the samples that touch the core, or None.
      ninner: number of inner coordinates.

    Attributes:
      on: coordinates with stiffness, outer ones first.
    """

    def __init__(self, faces: CandidateFaces, core: tuple | None, ninner: int):
        self._faces, self.n = faces, int(faces.count[1])
        self._node = faces.touched
        self.outer = (3 * self._node[:, None] + _AXES).ravel()
        self.on, self._core = self.outer, None
        if core is not None and len(core[1]):
            B, k = self._core = core
            self._inner = k @ B
            self._pressed = self._inner.nonzero()[0]
            self.on = np.concatenate([self.outer, 3 * self.n + self._pressed])

    def dense(self) -> np.ndarray:
        """Stiffness (k, k) of the coordinates `on`."""
        m = len(self.outer)
        if not self._core:
            return self._faces.matrix(self._node)
        D = np.zeros((len(self.on), len(self.on)))
        if m:
            D[:m, :m] = self._faces.matrix(self._node)
        B, k = self._core
        B = B[:, self._pressed]
        D[m:, m:] = (B.T * k) @ B
        return D

    def product(self, p: np.ndarray) -> np.ndarray:
        """D p for p (n,) of all coordinates."""
        m = 3 * self.n
        out = np.zeros(len(p))
        if m:
            out[:m] = self._faces.product(p[:m])
        if self._core:
            B, k = self._core
            out[m:] = (k * (B @ p[m:])) @ B
        return out

    def lumped(self) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness lumped at the touched nodes: (k, 3, 3) of outer and (l,) of inner ones."""
        return self._faces.lumped[self._node], self._inner[self._pressed] if self._core else _NONE

    def add_inverse_lumped(self, matrix: np.ndarray) -> None:
        """Adds the inverse of the stiffness, lumped at the nodes, to a matrix (k, k) over the coordinates
        `on`."""
        block, inner = self.lumped()
        block += (_SLIP * np.einsum("kii->k", block))[:, None, None] * _EYE
        n = len(block)
        if n:
            place = np.arange(3 * n).reshape(n, 3)
            matrix[place[:, :, None], place[:, None, :]] += np.linalg.inv(block)
        if self._core:
            place = np.arange(3 * n, len(matrix))
            matrix[place, place] += 1 / inner


_AXES, _EYE, _NONE = np.arange(3), np.eye(3), np.zeros(0)


class Compliance:
    """W of the candidates: scale * rest - share a a', the softened skin and its liquid.

    Args:
      rest: (n, n) float32, symmetric. a: (n,) or None without liquid.
    """

    def __init__(self, rest: np.ndarray, scale: float, share: float = 0.0, a: np.ndarray | None = None):
        self._rest, self._scale, self._share, self._a = rest, scale, share, a

    def __matmul__(self, p: np.ndarray) -> np.ndarray:
        """W p of p (n,)."""
        # in single precision: half the memory, and rest is no better than that
        if not len(p):  # which BLAS refuses
            return np.zeros(0)
        out = sgemv(self._scale, self._rest.T, p).astype(float)
        if self._a is not None:
            out -= (self._share * float(self._a @ p)) * self._a
        return out

    def stiffer(self, share: float) -> "Compliance":
        """That of a skin that gives a share of what this one does."""
        return Compliance(self._rest, share * self._scale, share * self._share, self._a)

    def part(self, on: np.ndarray, dtype: type = float) -> np.ndarray:
        """W over the coordinates `on` (k,): (k, k)."""
        out = self._rest.take(on, 0).take(on, 1).astype(dtype, copy=False)
        out *= self._scale
        if self._a is not None:
            a = self._a[on].astype(dtype)
            out -= np.multiply.outer(self._share * a, a).astype(dtype, copy=False)
        return out


class Lumped:
    """(1/D' + W) over the coordinates `on` of springs, D' their stiffness lumped at the nodes; one Cholesky
    factor.

    Raises:
      np.linalg.LinAlgError: W is not positive definite.
    """

    def __init__(self, springs: Springs, W: Compliance):
        self.on, self._blocks = springs.on, springs.lumped()
        rounding, info = _ROUNDING, 1
        while info:
            if rounding > len(self.on):  # a matrix with a positive diagonal is positive definite long before
                raise np.linalg.LinAlgError("the compliance over the contact is not positive definite")
            matrix = W.part(self.on, np.float32)
            springs.add_inverse_lumped(matrix)
            matrix.ravel()[:: len(matrix) + 1] *= 1 + rounding
            self._factor, info = spotrf(matrix.T, lower=1, overwrite_a=1, clean=0)
            rounding *= 10

    def fits(self, springs: Springs) -> bool:
        """Whether the same is touched and the stiffness of the nodes is nearly that of these springs."""
        if len(self.on) != len(springs.on) or not (self.on == springs.on).all():
            return False
        return all(
            np.abs(new - old).max(initial=0.0) < _ALIKE * old.max(initial=0.0)
            for new, old in zip(springs.lumped(), self._blocks)
        )

    def solve(self, b: np.ndarray) -> np.ndarray:
        """(1/D' + W) x = b for b (k,) or (k, m)."""
        return spotrs(self._factor, b, lower=1)[0]

    def stiffness(self, rigid: np.ndarray) -> np.ndarray:
        """G' (1/D' + W)^-1 G for G (n, m): stiffness against motions of what touches; symmetric, positive
        semi-definite."""
        G = rigid[self.on]
        return G.T @ self.solve(G)


def exact_fits(springs: Springs) -> bool:
    """Whether so few coordinates touch that their stiffness may be unsymmetric."""
    return len(springs.on) <= _COUPLED


def cost(k: int, coupled: bool) -> float:
    """What `solve` costs over k coordinates that touch, in products of a matrix with one row and column;
    without those of conjugate gradients, which it counts itself."""
    return 0.05 * k**3 if k <= (_COUPLED if coupled else _DIRECT) else 10.0 * k**2


def solve(
    W: Compliance, springs: Springs, r: np.ndarray, lumped: Lumped | None, coupled: bool = False
) -> tuple[np.ndarray, np.ndarray, Lumped | None, int]:
    """Solves (1 + D W) df = r.

    Args:
      lumped: factor of springs like these, or None.
      coupled: whether D is not symmetric, which conjugate gradients do not take.

    Returns:
      df (n,), W df (n,), the factor to go on with, and how many products of conjugate gradients that took.
    """
    if len(springs.on) <= (_COUPLED if coupled else _DIRECT):
        return *_solve_direct(W, springs, r, np.float32 if coupled else float), None, 0
    lumped = lumped or Lumped(springs, W)
    df, du, iterations = _solve_iterative(W, springs, r, lumped)
    return df, du, lumped if iterations <= _STALE else None, iterations


def _solve_direct(W, springs, r, dtype):
    df, on = r.copy(), springs.on
    if len(on):  # only the rows of closed contacts are coupled
        D = springs.dense()
        df[on] = 0
        matrix = D.astype(dtype, copy=False) @ W.part(on, dtype)
        matrix.ravel()[:: len(on) + 1] += 1
        right = r[on]
        if df.any():
            right = right - D @ (W @ df)[on]
        gesv = sgesv if dtype is np.float32 else dgesv
        df[on] = gesv(matrix, right, overwrite_a=1)[2]
    return df, W @ df


def _solve_iterative(W, springs, r, lumped):
    on = lumped.on

    def precondition(res):
        z = res.copy()
        z[on] -= lumped.solve((W @ res)[on])
        return z, W @ z

    x, Wx, res = np.zeros_like(r), np.zeros_like(r), r.copy()
    p, Wp = precondition(res)
    rho = float(res @ Wp)
    enough = _CG_TOLERANCE**2 * rho
    for iterations in range(1, _MAX_CG + 1):  # noqa: B007
        Ap = p + springs.product(Wp)
        work = float(Ap @ Wp)
        if not work > 0:
            break
        alpha = rho / work
        x += alpha * p
        Wx += alpha * Wp
        res -= alpha * Ap
        z, Wz = precondition(res)
        last, rho = rho, float(res @ Wz)
        if rho <= enough:
            break
        p, Wp = z + (rho / last) * p, Wz + (rho / last) * Wp
    return x, Wx, iterations
