"""The inverse of the rest stiffness: constant, shared by all worlds, and the heart of every solve.

Both classes hold the same operator over the free nodes: `solve` applies it and `rows` gives what one node's
  unit forces do everywhere.
"""

import numpy as np
import warp as wp

from .supernodal import Elimination, SupernodalFactor

__all__ = ["DenseFactor", "SparseFactor"]

_CLUSTER = 4  # nodes whose rows are computed together


class SparseFactor:
    """A sparse factor on the CPU, see `supernodal`.

    Args:
      elimination: of a matrix with the same pattern; None: made here, and kept as the attribute.
    """

    def __init__(self, stiffness, free, vert, device, elimination=None):
        self.elimination = elimination or Elimination(stiffness, vert[free])
        self._solver = SupernodalFactor(stiffness, self.elimination, free)
        self.size = stiffness.shape[0]
        self._free = free
        self._index = np.full(len(vert), -1)
        self._index[free] = np.arange(len(free))
        # clusters of neighbours: what touches together is computed together
        order = _bisection_order(vert[free])
        self._cluster_nodes = np.array_split(order, max(1, len(order) // _CLUSTER))
        self._cluster = np.empty(len(free), int)
        self._member = np.empty(len(free), int)
        for number, members in enumerate(self._cluster_nodes):
            self._cluster[members], self._member[members] = number, np.arange(len(members))
        self._rows = {}

    def solve(self, rhs):
        """Inverse times rhs: (nvert, nworld, 3) -> the same shape, zero at fixed nodes."""
        return self._solver.solve(rhs)

    def rows(self, nodes) -> np.ndarray:
        """Rows of the inverse that belong to free nodes: (3 len(nodes), size) float32.

        A row is computed with the rest of its cluster of nodes, always the same one, so that it does not
        depend on the order of requests."""
        local = self._index[nodes]
        out = np.empty((len(nodes), 3, self.size), np.float32)
        for cluster in np.unique(self._cluster[local]):
            if cluster not in self._rows:
                members = self._free[self._cluster_nodes[cluster]]
                unit = np.zeros((len(self._index), len(members), 3, 3))
                unit[members, np.arange(len(members))] = np.eye(3)
                rows = self._solver.solve(unit.reshape(len(unit), -1, 3))[self._free]
                self._rows[cluster] = np.moveaxis(rows, 1, 0).astype(np.float32).reshape(-1, 3, self.size)
            here = self._cluster[local] == cluster
            out[here] = self._rows[cluster][self._member[local[here]]]
        return out.reshape(-1, self.size)

    def dof(self, nodes) -> np.ndarray:
        """Positions of the nodes' coordinates in a row (3 len(nodes),)."""
        return (3 * self._index[nodes][:, None] + np.arange(3)).ravel()


# rows of whole nodes (3) that fill the tensor cores' tiles (64): ragged sizes run at a third of the speed
_ALIGN = 192


class DenseFactor:
    """The dense inverse on a CUDA device (torch), rounded to half precision; sums are in single precision.

    Rounding the matrix (4e-4) makes a slightly different but still symmetric preconditioner, which costs
    nothing as long as everything is computed from the same rounded entries. Rounding the right-hand side
    would cost: contact makes results that are small differences of large ones. So it travels as a sum of two
    halves, 22 bits in all."""

    def __init__(self, stiffness, free, vert, device):
        import torch

        self._torch, self._device = torch, wp.device_to_torch(device)
        self.size, self._stiffness = stiffness.shape[0], stiffness
        inverse = self._inverse()
        self.scale = float(inverse.abs().max())
        self.padded = -(-self.size // _ALIGN) * _ALIGN
        self.inverse = torch.zeros(self.padded, self.padded, dtype=torch.float16, device=self._device)
        self.inverse[: self.size, : self.size] = inverse / self.scale
        self._free = torch.as_tensor(free, device=self._device)

    def _inverse(self):
        matrix = self._torch.tensor(self._stiffness.toarray(), device=self._device)
        return self._torch.cholesky_inverse(self._torch.linalg.cholesky(matrix))

    def remainder(self, magnified):
        """What rounding took from `inverse`, magnified, in half precision too: for materials to which it
        matters."""
        out = self._torch.zeros_like(self.inverse)
        inside = (slice(self.size), slice(self.size))
        out[inside] = (self._inverse() / self.scale - self.inverse[inside]) * magnified
        return out

    def solve(self, rhs):
        """Inverse times rhs: (nvert, nworld, 3) -> the same shape, zero at fixed nodes."""
        nworld = rhs.shape[1]
        b = rhs[self._free].movedim(1, 2).reshape(self.size, nworld)
        scale = b.abs().amax(0).clamp_min(1e-300)
        b = self._torch.nn.functional.pad((b / scale).float(), (0, 0, 0, self.padded - self.size))
        high = b.half()
        halves = self._torch.cat([high, ((b - high) * 2048).half()], 1)
        x = self._torch.mm(self.inverse, halves, out_dtype=self._torch.float32)
        x = x[: self.size, :nworld].double() + x[: self.size, nworld:] / 2048
        out = rhs.new_zeros(rhs.shape)
        out[self._free] = (x * (scale * self.scale)).reshape(-1, 3, nworld).movedim(2, 1)
        return out


def _bisection_order(points: np.ndarray) -> np.ndarray:
    """Order in which neighbours in space are neighbours in the list: halves along the longest side, again and
    again."""
    order = np.arange(len(points))
    stack, out = [order], []
    while stack:
        part = stack.pop()
        if len(part) <= _CLUSTER:
            out.append(part)
            continue
        axis = np.ptp(points[part], axis=0).argmax()
        part = part[np.argsort(points[part, axis], kind="stable")]
        stack += [part[len(part) // 2 :], part[: len(part) // 2]]
    return np.concatenate(out)
