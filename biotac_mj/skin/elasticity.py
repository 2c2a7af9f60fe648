"""Elastic forces of linear tetrahedra. Arrays are [item, world], so that neighbouring threads read
neighbouring worlds."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import warp as wp

from . import material as mat
from .launch import Launches
from .types import mat33, real, vec3

__all__ = [
    "LinearTetrahedra",
    "elastic_energy",
    "elastic_force",
    "gather",
    "hessian_product",
    "rest_shape",
    "rest_stiffness",
    "tet_stress",
]

wp.set_module_options({"enable_backward": False})


def rest_shape(vert: np.ndarray, elem: np.ndarray):
    """Inverse rest edge matrices (nelem, 3, 3) [1/m] and volumes (nelem,) [m^3].

    Raises:
      ValueError: a tetrahedron is inverted or degenerate.
    """
    edges = np.moveaxis(vert[elem[:, 1:]] - vert[elem[:, :1]], 1, 2)
    volume = np.linalg.det(edges) / 6
    scale = np.abs(edges).max(axis=(1, 2)) ** 3
    bad = np.flatnonzero(~(volume > 1e-9 * scale))
    if len(bad):
        raise ValueError(
            f"{len(bad)} of {len(elem)} tetrahedra are inverted or degenerate (first: {bad[0]}, volume "
            f"{volume[bad[0]]:.3g} m^3): "
            "repair the mesh or swap two nodes of each inverted tetrahedron"
        )
    return np.linalg.inv(edges), volume


def rest_stiffness(
    nvert: int, elem: np.ndarray, inverse_edges: np.ndarray, volume: np.ndarray, mu: float, lame: float
) -> sp.csc_matrix:
    """Stiffness matrix at rest (3 nvert, 3 nvert) [N/m]; every law here has the same linearisation."""
    grad = np.empty((len(elem), 4, 3))  # shape function gradients
    grad[:, 1:] = inverse_edges
    grad[:, 0] = -inverse_edges.sum(axis=1)
    outer = np.einsum("eai,ebj->eabij", grad, grad)
    dot = np.einsum("eabkk->eab", outer)
    block = lame * outer + mu * np.swapaxes(outer, 3, 4) + mu * dot[..., None, None] * np.eye(3)
    block *= volume[:, None, None, None, None]
    dof = 3 * elem[:, :, None] + np.arange(3)
    rows = np.broadcast_to(dof[:, :, None, :, None], block.shape)
    cols = np.broadcast_to(dof[:, None, :, None, :], block.shape)
    return sp.coo_matrix((block.ravel(), (rows.ravel(), cols.ravel())), shape=(3 * nvert, 3 * nvert)).tocsc()


@wp.func
def edge_matrix(x: wp.array2d(dtype=vec3), t: wp.vec4i, w: int):
    x0 = x[t[0], w]
    return wp.matrix_from_cols(x[t[1], w] - x0, x[t[2], w] - x0, x[t[3], w] - x0)


@wp.func
def write_corners(H: mat33, e: int, w: int, corner_out: wp.array2d(dtype=vec3)):
    """The columns of H are the forces on corners 1 to 3; corner 0 balances them."""
    f1 = vec3(H[0, 0], H[1, 0], H[2, 0])
    f2 = vec3(H[0, 1], H[1, 1], H[2, 1])
    f3 = vec3(H[0, 2], H[1, 2], H[2, 2])
    corner_out[4 * e, w] = -f1 - f2 - f3
    corner_out[4 * e + 1, w] = f1
    corner_out[4 * e + 2, w] = f2
    corner_out[4 * e + 3, w] = f3


@wp.kernel
def elastic_force(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    rotation_out: wp.array2d(dtype=mat33),
    corner_out: wp.array2d(dtype=vec3),
    jacobian_out: wp.array2d(dtype=real),
):
    e, w = wp.tid()
    t = elem[e]
    F = edge_matrix(x, t, w) * inverse_edges[e]
    R = mat33()
    if law == 0:
        R = mat.polar_rotation(F)
        rotation_out[e, w] = R
    jacobian_out[e, w] = wp.determinant(F)
    H = -volume[e] * mat.stress(law, mu[w], lam[w], F, R) * wp.transpose(inverse_edges[e])
    write_corners(H, e, w, corner_out)


@wp.kernel
def hessian_product(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    rotation: wp.array2d(dtype=mat33),
    p: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    e, w = wp.tid()
    t = elem[e]
    B = inverse_edges[e]
    F = edge_matrix(x, t, w) * B
    dF = edge_matrix(p, t, w) * B
    R = mat33()
    if law == 0:
        R = rotation[e, w]
    H = volume[e] * mat.stress_derivative(law, mu[w], lam[w], F, R, dF) * wp.transpose(B)
    write_corners(H, e, w, corner_out)


@wp.kernel
def elastic_energy(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    energy_out: wp.array2d(dtype=real),
):
    e, w = wp.tid()
    F = edge_matrix(x, elem[e], w) * inverse_edges[e]
    R = mat33()
    if law == 0:
        R = mat.polar_rotation(F)
    energy_out[e, w] = volume[e] * mat.energy_density(law, mu[w], lam[w], F, R)


@wp.kernel
def tet_stress(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    x: wp.array2d(dtype=vec3),
    # Out:
    cauchy_out: wp.array2d(dtype=mat33),
    von_mises_out: wp.array2d(dtype=real),
):
    e, w = wp.tid()
    F = edge_matrix(x, elem[e], w) * inverse_edges[e]
    R = mat.polar_rotation(F)
    sigma = mat.stress(law, mu[w], lam[w], F, R) * wp.transpose(F) / wp.determinant(F)
    deviator = sigma - wp.trace(sigma) / real(3.0) * wp.identity(n=3, dtype=real)
    cauchy_out[e, w] = sigma
    von_mises_out[e, w] = wp.sqrt(real(1.5) * wp.ddot(deviator, deviator))


@wp.kernel
def gather(
    # In:
    start: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    corner: wp.array2d(dtype=vec3),
    scale: real,
    add: int,
    # Out:
    node_out: wp.array2d(dtype=vec3),
):
    """Sums what the corners of elements (or faces) hold into their nodes: no atomics, so the sum's order is
    fixed."""
    i, w = wp.tid()
    total = vec3()
    for k in range(start[i], start[i + 1]):
        total += corner[slot[k], w]
    if add != 0:
        node_out[i, w] = node_out[i, w] + scale * total
    else:
        node_out[i, w] = scale * total


def incidence(nvert: int, cells: np.ndarray):
    """CSR lists of the corner slots (cell * ncorner + corner) that belong to each node: start (nvert+1,),
    slot (ncell * ncorner,)."""
    flat = cells.ravel()
    slot = np.argsort(flat, kind="stable").astype(np.int32)
    start = np.zeros(nvert + 1, np.int32)
    np.cumsum(np.bincount(flat, minlength=nvert), out=start[1:])
    return start, slot


def scale_stress(modulus, cauchy, mises):
    """Multiplies stresses [nelem, nworld] on the CPU by factors (nelem,), or by nothing."""
    if modulus is not None:
        cauchy.numpy()[...] *= modulus[:, None, None, None]
        mises.numpy()[...] *= modulus[:, None]


class LinearTetrahedra:
    """Four-node tetrahedra with constant strain (the paper's, CalculiX's C3D4).

    An element formulation offers what the solver asks for: `node_volume`, `rest_stiffness`, `allocate`,
      `force`, `product`,
    `smallest_jacobian` and `stress`.

    Args:
      vert: (nvert, 3) rest positions [m].
      elem: (nelem, 4).
      law: number of the material law, see `material.LAWS`.
      device: Warp device.
      modulus: (nelem,) factors on the elastic constants, or None.

    Raises:
      ValueError: a tetrahedron is inverted or degenerate.
    """

    def __init__(self, vert, elem, law, device, modulus=None):
        self.nvert, self.nelem, self.law, self.device = len(vert), len(elem), law, device
        self._elem, self._launch, self.modulus = elem, Launches(device), modulus
        self._inverse_edges, self._volume = rest_shape(vert, elem)
        self.node_volume = np.bincount(elem.ravel(), np.repeat(self._volume / 4, 4), self.nvert)
        if modulus is not None:  # energy is linear in the constants: they may as well multiply the volume
            self._volume = self._volume * modulus
        start, slot = incidence(self.nvert, elem)
        with wp.ScopedDevice(device):
            self.elem = wp.array(elem, dtype=wp.vec4i)
            self.inverse_edges = wp.array(self._inverse_edges, dtype=mat33)
            self.volume = wp.array(self._volume, dtype=real)
            self.start = wp.array(start, dtype=int)
            self.slot = wp.array(slot, dtype=int)

    def rest_stiffness(self, mu, lame) -> sp.csc_matrix:
        """(3 nvert, 3 nvert) [N/m] for Lame constants [Pa]."""
        return rest_stiffness(self.nvert, self._elem, self._inverse_edges, self._volume, mu, lame)

    def allocate(self, nworld):
        """Scratch memory of one SkinData: what `force` leaves for `product`."""
        with wp.ScopedDevice(self.device):
            return _Scratch(
                wp.zeros((self.nelem, nworld), dtype=mat33),
                wp.zeros((self.nelem, nworld), dtype=real),
                wp.zeros((4 * self.nelem, nworld), dtype=vec3),
            )

    def force(self, scratch, mu, lam, x, force_out):
        """Elastic nodal forces at x: [nvert, nworld] vec3 -> the same [N]."""
        n, w = x.shape
        self._launch(
            elastic_force,
            (self.nelem, w),
            [self.law, mu, lam, self.elem, self.inverse_edges, self.volume, x],
            [scratch.rotation, scratch.corner, scratch.jacobian],
        )
        self._launch(gather, (n, w), [self.start, self.slot, scratch.corner, 1.0, 0], [force_out])

    def product(self, scratch, mu, lam, x, p, product_out):
        """Tangent stiffness at x, where `force` was evaluated last, times p [N]."""
        n, w = x.shape
        self._launch(
            hessian_product,
            (self.nelem, w),
            [self.law, mu, lam, self.elem, self.inverse_edges, self.volume, x, scratch.rotation, p],
            [scratch.corner],
        )
        self._launch(gather, (n, w), [self.start, self.slot, scratch.corner, 1.0, 0], [product_out])

    def smallest_jacobian(self, scratch) -> np.ndarray:
        """(nworld,) smallest det F where `force` was evaluated last."""
        if self.device.is_cuda:
            return wp.to_torch(scratch.jacobian).amin(0).cpu().numpy()
        return scratch.jacobian.numpy().min(0)

    def stress(self, mu, lam, x):
        """Cauchy stress [nelem, nworld] mat33 and von Mises stress [nelem, nworld] [Pa]."""
        cauchy = wp.zeros((self.nelem, x.shape[1]), dtype=mat33, device=self.device)
        mises = wp.zeros((self.nelem, x.shape[1]), dtype=real, device=self.device)
        self._launch(
            tet_stress, mises.shape, [self.law, mu, lam, self.elem, self.inverse_edges, x], [cauchy, mises]
        )
        scale_stress(self.modulus, cauchy, mises)
        return cauchy, mises


class _Scratch(NamedTuple):
    rotation: wp.array
    jacobian: wp.array
    corner: wp.array
