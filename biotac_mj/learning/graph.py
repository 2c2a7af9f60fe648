"""Chebyshev graph convolutions and level changes on torch's sparse matrices."""

import math
import warnings

import numpy as np
import torch
from torch import nn

__all__ = ["ChebConv", "SparseMatrix", "sparse_product"]


class _Product(torch.autograd.Function):
    """matrix (n, m) @ x (m, c), with the transpose given, so that the gradient is a product of the same kind."""

    @staticmethod
    def forward(ctx, x, matrix, transpose):
        ctx.matrices = transpose, matrix
        return matrix @ x

    @staticmethod
    def backward(ctx, grad):
        transpose, matrix = ctx.matrices
        return _Product.apply(grad.contiguous(), transpose, matrix), None, None


class SparseMatrix(nn.Module):
    """A constant sparse matrix that moves with its module; not among the parameters or the saved weights: it follows from the mesh."""

    def __init__(self, matrix, symmetric=False):
        super().__init__()
        self.shape = matrix.shape
        for name, m in (("forward_", matrix), ("backward_", matrix if symmetric else matrix.T)):
            m = m.tocsr().astype(np.float32)
            m.sort_indices()
            for part, value in (("crow", m.indptr), ("col", m.indices), ("value", m.data)):
                self.register_buffer(name + part, torch.from_numpy(value.copy()), persistent=False)
        self._made = None

    def _matrices(self):
        key = (self.forward_value.device, self.forward_value.dtype)
        if self._made is None or self._made[0] != key:
            n, m = self.shape
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # torch calls its CSR matrices a beta
                pair = [
                    torch.sparse_csr_tensor(getattr(self, s + "crow"), getattr(self, s + "col"), getattr(self, s + "value"), size)
                    for s, size in (("forward_", (n, m)), ("backward_", (m, n)))
                ]
            self._made = key, pair
        return self._made[1]

    def forward(self, x):
        """(n, ...) = matrix @ x (m, ...)."""
        return sparse_product(self._matrices(), x)


def sparse_product(pair, x):
    """matrix @ x for pair = (matrix, its transpose), x (m, ...); the leading axis is the graph's."""
    flat = x.reshape(x.shape[0], -1)
    return _Product.apply(flat, *pair).reshape(-1, *x.shape[1:])


class ChebConv(nn.Module):
    """y = sum over k < K of T_k(L) x W_k + b on a graph; L the scaled Laplacian, T_k Chebyshev polynomials (Defferrard et al., 2016).

    The recurrence runs on whichever is narrower, inputs or outputs (Clenshaw's scheme for the latter): the sparse products are what costs.

    Args:
      laplacian: SparseMatrix, symmetric. inputs, outputs: channels. order: K. bias: COMA's last layer has none.
    """

    def __init__(self, laplacian, inputs, outputs, order=6, bias=True):
        super().__init__()
        self.laplacian = laplacian
        self.weight = nn.Parameter(torch.empty(order, inputs, outputs))
        nn.init.normal_(self.weight, std=math.sqrt(1 / (order * inputs)))
        self.bias = nn.Parameter(torch.zeros(outputs)) if bias else None

    def forward(self, x, keep=None):
        """(n, batch, outputs) of x (n, batch, inputs); with keep (m,) only those nodes of the result, (m, batch, outputs)."""
        order, inputs, outputs = self.weight.shape
        if outputs < inputs:
            y = self._clenshaw(x) if keep is None else self._clenshaw(x).index_select(0, keep)
        else:
            y = self._forward_recurrence(x, keep)
        return y if self.bias is None else y + self.bias

    def _forward_recurrence(self, x, keep):
        at = (lambda v: v) if keep is None else (lambda v: v.index_select(0, keep))
        before, now = None, x
        y = at(x) @ self.weight[0]
        for k in range(1, len(self.weight)):
            new = self.laplacian(now) if before is None else 2 * self.laplacian(now) - before
            before, now = now, new
            y = y + at(now) @ self.weight[k]
        return y

    def _clenshaw(self, x):
        after, now = None, None
        for k in range(len(self.weight) - 1, 0, -1):
            new = x @ self.weight[k]
            if now is not None:
                new = new + 2 * self.laplacian(now)
            if after is not None:
                new = new - after
            after, now = now, new
        y = x @ self.weight[0]
        if now is not None:
            y = y + self.laplacian(now)
        return y if after is None else y - after
