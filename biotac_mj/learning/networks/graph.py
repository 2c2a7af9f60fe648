"""Chebyshev graph convolutions and changes of level with torch's sparse matrices."""

import functools
import math
import warnings

import numpy as np
import torch
from scipy.sparse import spmatrix
from torch import nn


class _Product(torch.autograd.Function):
    """matrix (n, m) @ x (m, c) with a given transpose, so that the gradient is a sparse product too."""

    @staticmethod
    def forward(ctx, x, matrix, transpose):
        ctx.matrices = transpose, matrix
        return matrix @ x

    @staticmethod
    def backward(ctx, grad):
        transpose, matrix = ctx.matrices
        return _Product.apply(grad.contiguous(), transpose, matrix), None, None


class SparseMatrix(nn.Module):
    """A constant sparse matrix that moves with its module. It is neither a parameter nor saved, since it
    follows from the mesh."""

    def __init__(self, matrix: spmatrix, symmetric: bool = False):
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
                    torch.sparse_csr_tensor(
                        getattr(self, s + "crow"), getattr(self, s + "col"), getattr(self, s + "value"), size
                    )
                    for s, size in (("forward_", (n, m)), ("backward_", (m, n)))
                ]
            self._made = key, pair
        return self._made[1]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, ...) = matrix @ x (m, ...)."""
        return _Product.apply(x.reshape(x.shape[0], -1), *self._matrices()).reshape(-1, *x.shape[1:])

    def fields(self, u: torch.Tensor) -> torch.Tensor:
        """(k, n, 3) of fields u (k, m, 3), each times the matrix."""
        return self(u.float().transpose(0, 1).contiguous()).transpose(0, 1)


# torch_geometric's ChebConv takes the edges of a graph at each call and gathers along them; the mesh is
# constant, so that one sparse matrix serves all calls and their gradients
class ChebConv(nn.Module):
    """y = sum over k < K of T_k(L) x W_k + b on a graph; L the scaled Laplacian, T_k Chebyshev polynomials
    (Defferrard et al., 2016).

    On the CPU the recurrence runs on the narrower of inputs and outputs (Clenshaw's scheme for the latter),
    since the sparse products dominate. On a GPU, where the graph becomes coarser or finer, all T_k form one
    dense matrix, cut to the wanted nodes: one product instead of K - 1 sparse ones, which take five times as
    long there.

    Args:
      laplacian: SparseMatrix, symmetric. inputs, outputs: channels. order: K. bias: COMA's last layer has
        none.
      keep: (m,) nodes of the result; None: all.
      up: SparseMatrix (n, m) that interpolates the input from a coarser graph; None: the input is on this
        one.
    """

    def __init__(
        self,
        laplacian: "SparseMatrix",
        inputs: int,
        outputs: int,
        order: int = 6,
        bias: bool = True,
        keep: np.ndarray | None = None,
        up: "SparseMatrix | None" = None,
    ):
        super().__init__()
        self.laplacian, self.up = laplacian, up
        self.weight = nn.Parameter(torch.empty(order, inputs, outputs))
        nn.init.normal_(self.weight, std=math.sqrt(1 / (order * inputs)))
        self.bias = nn.Parameter(torch.zeros(outputs)) if bias else None
        self.register_buffer("keep", None if keep is None else torch.as_tensor(keep), persistent=False)
        self._dense = None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n or m, batch, outputs) of x (n or m, batch, inputs)."""
        if x.is_cuda and (self.keep is not None or self.up is not None):
            y = self.dense(x)
        else:
            x = x if self.up is None else self.up(x)
            narrower = self.weight.shape[2] < self.weight.shape[1]
            if narrower:
                y = self._at_kept(self._clenshaw(x))
            else:
                y = functools.reduce(torch.add, map(torch.matmul, self._polynomials(x), self.weight))
        return y if self.bias is None else y + self.bias

    def dense(self, x: torch.Tensor) -> torch.Tensor:
        """The result without the bias, by the dense matrices."""
        order, inputs, outputs = self.weight.shape
        matrix = self._matrix(x)
        if self.up is None:  # (K m, n)
            y = (matrix @ x.flatten(1)).view(order, -1, x.shape[1], inputs)
            return torch.einsum("kmbi,kio->mbo", y, self.weight)
        z = torch.einsum("mbi,kio->kmbo", x, self.weight).reshape(matrix.shape[1], -1)  # (K m, batch outputs)
        return (matrix @ z).view(-1, x.shape[1], outputs)

    @torch.no_grad()
    def _matrix(self, x):
        """[T_0; T_1; ..] at the kept nodes (K m, n), or [T_0, T_1, ..] times `up` (n, K m)."""
        if self._dense is None or self._dense.device != x.device:
            eye = torch.eye(self.laplacian.shape[0], device=x.device)
            now = eye if self.up is None else self.up(torch.eye(self.up.shape[1], device=x.device))
            self._dense = torch.cat(list(self._polynomials(now)), 0 if self.up is None else 1)
        return self._dense

    def _at_kept(self, v):
        return v if self.keep is None else v.index_select(0, self.keep)

    def _polynomials(self, x):
        """T_k(L) x at the kept nodes, one k after another."""
        before, now = None, x
        for k in range(len(self.weight)):
            if k:
                new = self.laplacian(now) if before is None else 2 * self.laplacian(now) - before
                before, now = now, new
            yield self._at_kept(now)

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
