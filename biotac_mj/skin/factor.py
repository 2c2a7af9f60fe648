"""The inverse of the rest stiffness: constant, shared by all worlds, and the heart of every solve.

Both classes hold the same operator over the free nodes: `solve` applies it and `rows` gives what one node's unit forces do everywhere.
"""

import numpy as np
import warp as wp

__all__ = ["DenseFactor", "SparseFactor"]

_CLUSTER = 8  # nodes whose columns are computed together; CHOLMOD takes as long for 8 right-hand sides as for 24


class SparseFactor:
    """CHOLMOD's sparse factor (through cholespy) on the CPU."""

    def __init__(self, stiffness, free, nvert, device):
        from cholespy import CholeskySolverD, MatrixType

        coo = stiffness.tocoo()
        self.size = coo.shape[0]
        self._solver = CholeskySolverD(self.size, coo.row.astype(np.int32), coo.col.astype(np.int32), coo.data, MatrixType.COO)
        self._free = free
        self._index = np.full(nvert, -1)
        self._index[free] = np.arange(len(free))
        self._clusters = {}

    def solve(self, rhs):
        """Inverse times rhs: (nvert, nworld, 3) -> the same shape, zero at fixed nodes."""
        out = np.zeros_like(rhs)
        nworld = rhs.shape[1]
        b = np.ascontiguousarray(np.moveaxis(rhs[self._free], 1, 2).reshape(self.size, nworld))
        x = np.empty_like(b)
        if nworld == 1:
            b, x = b[:, 0].copy(), x[:, 0].copy()
        self._solver.solve(b, x)
        out[self._free] = np.moveaxis(x.reshape(len(self._free), 3, nworld), 2, 1)
        return out

    def rows(self, nodes) -> np.ndarray:
        """Rows of the inverse that belong to free nodes: (3 len(nodes), size) float32.

        A row is computed with the rest of its cluster of nodes, always the same one, so that it does not depend on the order of requests.
        """
        local = self._index[nodes]
        out = np.empty((len(nodes), 3, self.size), np.float32)
        for cluster in np.unique(local // _CLUSTER):
            if cluster not in self._clusters:
                first, last = cluster * _CLUSTER, min((cluster + 1) * _CLUSTER, len(self._free))
                b = np.zeros((self.size, 3 * (last - first)))
                b[np.arange(3 * first, 3 * last), np.arange(3 * (last - first))] = 1
                x = np.empty_like(b)
                self._solver.solve(b, x)
                self._clusters[cluster] = x.T.reshape(-1, 3, self.size).astype(np.float32)
            here = local // _CLUSTER == cluster
            out[here] = self._clusters[cluster][local[here] % _CLUSTER]
        return out.reshape(-1, self.size)

    def dof(self, nodes) -> np.ndarray:
        """Positions of the nodes' coordinates in a row (3 len(nodes),)."""
        return (3 * self._index[nodes][:, None] + np.arange(3)).ravel()


class DenseFactor:
    """The dense inverse in single precision on a CUDA device (torch)."""

    def __init__(self, stiffness, free, nvert, device):
        import torch

        self._device = wp.device_to_torch(device)
        self.size = stiffness.shape[0]
        matrix = torch.tensor(stiffness.toarray(), device=self._device)
        self.inverse = torch.cholesky_inverse(torch.linalg.cholesky(matrix)).float()
        self._free = torch.as_tensor(free, device=self._device)
        self._index = np.full(nvert, -1)
        self._index[free] = np.arange(len(free))

    def solve(self, rhs):
        out = rhs.new_zeros(rhs.shape)
        nworld = rhs.shape[1]
        b = rhs[self._free].movedim(1, 2).reshape(self.size, nworld)
        scale = b.abs().amax(0).clamp_min(1e-300)
        x = (self.inverse @ (b / scale).float()).double() * scale
        out[self._free] = x.reshape(-1, 3, nworld).movedim(2, 1)
        return out

    def rows(self, nodes):
        return self.inverse[self.dof(nodes)]

    def dof(self, nodes):
        import torch

        return torch.as_tensor((3 * self._index[nodes][:, None] + np.arange(3)).ravel(), device=self._device)
