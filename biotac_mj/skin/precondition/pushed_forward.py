"""The inverse of the undeformed stiffness, pushed forward into a deformed shape.

The directions along which nearly incompressible rubber resists volume change depend on the deformation. The
Piola transform, which preserves divergence, maps a motion w of the undeformed skin to F w of the deformed
skin. M A0^-1 M^T, with M the deformation gradient at each node scaled to unit determinant, therefore keeps
volume where the deformed skin does. For the corotational law, which measures volume change along rotated
axes, M is the rotation. The result depends on the shape only, and is symmetric and positive definite."""

import functools
import typing

import numpy as np
import scipy.sparse as sp
import warp as wp

from ...kernels import kernel_module
from ...launches import recorded
from ..block import sum_of_lanes
from ..rubber.law import LAWS
from ..types import DOUBLE, SINGLE, Precision, mat33, real, vec3

if typing.TYPE_CHECKING:
    from ..rubber.tetrahedra import Tetrahedra

kernel_module(__name__)

_LEAST_DETERMINANT = 0.1  # of a node's deformation gradient; below it M is the identity
# of M in half precision, whose range is four times a right-hand side; else M is the identity
_MOST_NORM = 4.0


@wp.func
def push_forward_matrix(F: mat33, turns: int):
    """M of a deformation gradient F. turns: 1: M is the rotation."""
    det = wp.determinant(F)
    M = wp.identity(n=3, dtype=real)
    if det > real(_LEAST_DETERMINANT):  # false for nan
        M = F / wp.cbrt(det)
        if turns == 1:
            U, _stretch, V = wp.svd3(F)
            M = U * wp.transpose(V)
    return M


@functools.cache
def _measurement(precision: Precision) -> wp.Kernel:
    """Kernel that computes M in this precision."""
    narrow = precision.narrow

    @wp.kernel(module=kernel_module(f"{__name__}.{precision.name}"))
    def measure(
        # In:
        lanes: int,
        start: wp.array(dtype=int),
        other: wp.array(dtype=int),
        gradient: wp.array(dtype=vec3),
        turns: int,
        x: wp.array2d(dtype=vec3),
        on: wp.array(dtype=int),
        # Out:
        matrix_out: wp.array2d(dtype=precision.mat),
    ):
        """M of node i, from the mean deformation gradient of the elements at it, summed by `lanes`
        threads."""
        i, w, lane = wp.tid()
        if on[w] == 0:
            return
        a = vec3()
        b = vec3()
        c = vec3()
        for k in range(start[i] + lane, start[i + 1], lanes):
            p = x[other[k], w]
            g = gradient[k]
            a += p[0] * g
            b += p[1] * g
            c += p[2] * g
        a = sum_of_lanes(a, lanes)
        b = sum_of_lanes(b, lanes)
        c = sum_of_lanes(c, lanes)
        M = push_forward_matrix(mat33(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]), turns)
        if wp.static(precision is SINGLE):
            if wp.ddot(M, M) > real(_MOST_NORM * _MOST_NORM):
                M = wp.identity(n=3, dtype=real)
        matrix_out[i, w] = narrow(M)

    return measure


@wp.kernel
def _turn(
    # In:
    matrix: wp.array2d(dtype=mat33),
    world: wp.array(dtype=int),
    transposed: int,
    # In and out:
    side: wp.array2d(dtype=vec3),
):
    """Multiplies right-hand side k at node i by M of its world, or by its transpose."""
    i, k = wp.tid()
    M = matrix[i, world[k]]
    if transposed == 1:
        M = wp.transpose(M)
    side[i, k] = M * side[i, k]


class PushForward:
    """Pushes the inverse at rest forward into the deformed shape, by a matrix M at each node, on the CPU.

    Args:
      elements: of the skin. x: [nvert, nworld] nodes, a wp.array.

    Attributes:
      matrix: (nvert, nworld, 3, 3) M of the last `measure`.
    """

    def __init__(self, elements: "Tetrahedra", x: wp.array):
        matrices = PushForwardMatrices(elements, x.shape[1], x.device, 1, DOUBLE)
        on, self._launches = wp.zeros(x.shape[1], dtype=int, device="cpu"), {}
        self._flags, self._matrix, self.matrix = on.numpy(), matrices.matrix, matrices.matrix.numpy()
        self._measure = recorded(*matrices.measurement(x, on))

    def measure(self, worlds: np.ndarray) -> None:
        """Computes M of worlds (k,) at their present nodes."""
        self._flags[:] = 0
        self._flags[worlds] = 1
        self._measure()

    def apply(self, worlds: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """M w of motions w (nvert, k, 3), one for each of the worlds (k,)."""
        return self._turned(0, worlds, motion)

    def pull_back(self, worlds: np.ndarray, force: np.ndarray) -> np.ndarray:
        """M^T f of forces f (nvert, k, 3); as `apply`."""
        return self._turned(1, worlds, force)

    def _turned(self, transposed, worlds, values):
        key = transposed, len(worlds)
        if key not in self._launches:
            with wp.ScopedDevice("cpu"):
                world = wp.zeros(len(worlds), dtype=int)
                side = wp.zeros((len(self.matrix), len(worlds)), dtype=vec3)
            launch = recorded(_turn, side.shape, [self._matrix, world, transposed], [side])
            self._launches[key] = world.numpy(), side.numpy(), launch
        world, side, launch = self._launches[key]
        world[:], side[...] = worlds, values
        launch()
        return side.copy()

    def pull_back_force(self, w: int, nodes: np.ndarray, force: np.ndarray) -> np.ndarray:
        """M^T f of forces f (3 k,) on the nodes (k,) of a world."""
        return np.einsum("nji,nj->ni", self.matrix[nodes, w], force.reshape(-1, 3)).ravel()

    def compliance(self, w: int, nodes: np.ndarray, W: np.ndarray) -> np.ndarray:
        """M W M^T of the compliance W (3 k, 3 k) among nodes (k,) of a world."""
        M, k = self.matrix[nodes, w], len(nodes)
        half = np.matmul(M[:, None], W.reshape(k, 3, k, 3).swapaxes(1, 2))
        return np.matmul(half, M[None].swapaxes(2, 3)).swapaxes(1, 2).reshape(W.shape)


class PushForwardMatrices:
    """The matrices M of all nodes and worlds of one SkinData on its device.

    Args:
      elements: of the skin. nworld: number of worlds. device: Warp device. lanes: threads that sum one M.
      precision: of the matrices; in single, M is bounded by the range of half precision.

    Attributes:
      matrix: [nvert, nworld] M of the last `measurement`.
    """

    def __init__(
        self,
        elements: "Tetrahedra",
        nworld: int,
        device: wp.Device,
        lanes: int,
        precision: Precision = SINGLE,
    ):
        self._dim, self._kernel = (elements.nvert, nworld, lanes), _measurement(precision)
        start, other, gradient = _node_gradients(elements)
        with wp.ScopedDevice(device):
            self._constants = [
                lanes,
                wp.array(start, dtype=int),
                wp.array(other, dtype=int),
                wp.array(gradient, dtype=vec3),
                int(elements.law == LAWS["corotational"]),
            ]
            self.matrix = wp.zeros((elements.nvert, nworld), dtype=precision.mat)

    def measurement(self, x: wp.array, on: wp.array) -> tuple:
        """Kernel, dim, inputs and outputs of the launch that computes M at x [nvert, nworld] in the worlds
        that are on."""
        return self._kernel, self._dim, [*self._constants, x, on], [self.matrix]


def pushes_forward(elements: "Tetrahedra", poissons_ratio: float) -> bool:
    """Whether the inverse is pushed forward: the law resists volume change much more than shear, along
    directions that depend on the shape."""
    return poissons_ratio > 0.45 and elements.law in (LAWS["neo_hookean"], LAWS["corotational"])


def _node_gradients(elements):
    """Mean deformation gradient of the elements at each node, weighted by volume, as sums of outer products
    of positions and vectors: start (nvert + 1,), other node (nnz,), vector (nnz, 3)."""
    elem, n, corners = elements.elem, elements.nvert, elements.corners
    mean = np.einsum("eq,eqaj->eaj", elements.weight, elements.gradient)
    volume = np.bincount(elem.ravel(), np.repeat(elements.weight.sum(1), corners), n)
    rows = np.repeat(elem, corners, axis=1).ravel()
    columns = np.tile(elem, corners).ravel()
    entries = np.tile(mean, (1, corners, 1)).reshape(-1, 3) / volume[rows, None]
    each = [sp.coo_matrix((component, (rows, columns)), shape=(n, n)).tocsr() for component in entries.T]
    for matrix in each:
        matrix.sort_indices()
    return each[0].indptr, each[0].indices, np.stack([matrix.data for matrix in each], axis=1)
