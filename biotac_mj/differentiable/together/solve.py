"""Linear systems of many worlds at once: GMRES on tensors of the device, each world with its own matrix.

The approximate inverse may be one in single precision: residuals are measured in double and solved for again,
each time as far as the inverse's digits carry."""

from collections.abc import Callable

import numpy as np
import torch

__all__ = ["solve_worlds"]

_BASIS = 40  # vectors, after which it begins anew: a solve takes 25, or 15 for the digits of a single inverse
_FIRST = 20  # of them, for which memory is taken at once: of 256 worlds of the coarse skin 360 MB
_LEAST = 1e-300


def solve_worlds(
    product: Callable,
    inverse: Callable,
    right: torch.Tensor,
    precision: float,
    digits: float,
    most: int = 400,
) -> tuple[torch.Tensor, int]:
    """Solutions of A x = right, and how many products they took; the residual is measured after the inverse,
    as `linear.inverse.solve_by_gmres` has it.

    Args:
      product, inverse: A and its approximate inverse times vectors (n, nworld, 3), world by world.
      right: (n, nworld, 3).
      precision: error of x to end at, of its size in each world.
      digits: how far a residual is reduced before it is measured anew; 1e-4 where the inverse is single.
      most: products.

    Raises:
      ValueError: not solved with so many, in a world that is named.
    """
    x, left = torch.zeros_like(right), right
    size, count, basis = (
        None,
        0,
        torch.empty((_BASIS + 1, *right.shape), dtype=right.dtype, device=right.device),
    )
    while True:
        z = inverse(left)
        length = torch.linalg.vector_norm(z, dim=(0, 2))
        beta = length.cpu().numpy()
        size = beta if size is None else size
        asked = precision * size
        if (beta <= asked).all():
            return x, count
        if count >= most:
            world = int(np.argmax(beta / np.maximum(asked, _LEAST)))
            raise ValueError(
                f"the adjoint of a step of world {world} was not solved with {most} products: its tangent is "
                "next to singular, as of skin that slides freely; look at the step's changes and shorten it"
            )
        goal = np.maximum(asked, digits * beta)
        basis[0] = _over(z, length)
        along = np.zeros((_BASIS + 1, _BASIS, len(beta)))
        turns, missed = np.zeros((_BASIS, 2, len(beta))), np.zeros((_BASIS + 1, len(beta)))
        missed[0] = beta
        for j in range(_BASIS):
            w = inverse(product(basis[j]))
            count += 1
            parts = []
            for _ in range(2):  # once more for what rounding left
                parts.append(torch.einsum("jnwc,nwc->jw", basis[: j + 1], w))
                w = w - torch.einsum("jw,jnwc->nwc", parts[-1], basis[: j + 1])
            length = torch.linalg.vector_norm(w, dim=(0, 2))
            if len(basis) == j + 1:
                basis = torch.cat([basis, torch.empty_like(basis)])
            basis[j + 1] = _over(w, length)
            # one look at the device for each product
            found = torch.cat([parts[0] + parts[1], length[None]]).cpu().numpy()
            along[: j + 1, j], length = found[:-1], found[-1]
            # Givens' rotations keep what is along the basis triangular
            column = along[:, j]
            for i in range(j):
                c, s = turns[i]
                column[i], column[i + 1] = (
                    c * column[i] + s * column[i + 1],
                    c * column[i + 1] - s * column[i],
                )
            diagonal = np.hypot(column[j], length)
            safe = np.where(diagonal > 0, diagonal, 1.0)
            c, s = turns[j] = np.where(diagonal > 0, column[j] / safe, 1.0), length / safe
            column[j] = safe
            missed[j], missed[j + 1] = c * missed[j], -s * missed[j]
            if (np.abs(missed[j + 1]) <= goal).all():
                break
        k = j + 1
        triangle, sides = along[:k, :k].transpose(2, 0, 1), missed[:k].T[..., None]
        share = np.linalg.solve(np.triu(triangle), sides)[..., 0].T
        share = torch.from_numpy(np.ascontiguousarray(share)).to(right.device)
        x = x + torch.einsum("jw,jnwc->nwc", share, basis[:k])
        left = right - product(x)


def _over(v, length):
    """v over its length, zero where that is."""
    return v * torch.where(length > _LEAST, 1 / length.clamp(min=_LEAST), 0.0)[:, None]
