"""Quadratic tetrahedra: ten nodes, four integration points, selectively averaged dilatation: incompressible
rubber does not lock.

The four points are Gauss's, pulled towards the centroid by `CONTRACTION`. That lowers the energy of a
strain's variation inside an element, of which a mesh as coarse as the wall has too much, by CONTRACTION^2 and
leaves its mean alone: a strain that is constant is still exact (the alpha finite element method of Liu,
Nguyen-Thoi and Lam 2008 scales strain gradients the same way).

Each element's energy is  sum_q w_q W(F_q; lam_q) + V (lam - lam_q)/2 mean(theta)^2,  lam_q = min(lam,
POINTWISE mu), with the law's measure of dilatation theta (`material.dilatation`; J - 1 for neo_hookean). What
goes beyond lam_q is felt by the element's mean dilatation alone (Nagtegaal, Parks and Rice 1974; Simo, Taylor
and Pister 1985): volume is kept per element, not at every point, which leaves the element free to bend. A
mean dilatation for all of lam (POINTWISE = 0) would be too soft under local loads, since a pressure that is
constant over large elements is crude. What varies inside an element vanishes with its size, so POINTWISE
changes the error of a mesh, not the limit; so does CONTRACTION. With CONTRACTION = 1 and lam <= POINTWISE mu
integration is full, as in CalculiX's C3D10."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..geometry.edge_nodes import shape_gradients
from .elasticity import gather, incidence, rest_shape, scale_stress
from .launch import Launches
from .material import (
    LAWS,
    dilatation,
    dilatation_gradient,
    dilatation_hessian,
    energy_density,
    polar_rotation,
    stress,
    stress_derivative,
)
from .types import mat33, real, vec3

__all__ = ["QuadraticTetrahedra"]

wp.set_module_options({"enable_backward": False})

POINTWISE = wp.constant(5.0)  # of mu; docs/elements.md has the error of other values

# of the distance from the centroid to Gauss's points; docs/elements.md has the error with and without
CONTRACTION = 0.92
_NEAR, _FAR = (
    (5 + 3 * 5**0.5) / 20,
    (5 - 5**0.5) / 20,
)  # barycentric coordinates of the four Gauss points, exact to degree 2
_POINTS = np.full((4, 4), _FAR) + (_NEAR - _FAR) * np.eye(4)

mat310 = wp.types.matrix(shape=(3, 10), dtype=wp.float64)


@wp.func
def nodes(x: wp.array2d(dtype=vec3), elem: wp.array2d(dtype=int), e: int, w: int):
    X = mat310()
    for a in range(10):
        v = x[elem[e, a], w]
        X[0, a] = v[0]
        X[1, a] = v[1]
        X[2, a] = v[2]
    return X


@wp.func
def scatter(C: mat310, e: int, w: int, corner_out: wp.array2d(dtype=vec3)):
    for a in range(10):
        corner_out[10 * e + a, w] = vec3(C[0, a], C[1, a], C[2, a])


@wp.kernel
def quadratic_force(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array2d(dtype=int),
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    weight: wp.array2d(dtype=real),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    deformation_out: wp.array2d(dtype=mat33),
    rotation_out: wp.array2d(dtype=mat33),
    pressure_out: wp.array2d(dtype=real),
    jacobian_out: wp.array2d(dtype=real),
    corner_out: wp.array2d(dtype=vec3),
):
    e, w = wp.tid()
    X = nodes(x, elem, e, w)
    mean = real(0.0)
    smallest = real(1.0e30)
    for q in range(4):
        F = X * shape[q] * inverse[e, q]
        R = mat33()
        if law == 0:
            R = polar_rotation(F)
            rotation_out[4 * e + q, w] = R
        deformation_out[4 * e + q, w] = F
        smallest = wp.min(smallest, wp.determinant(F))
        mean += weight[e, q] * dilatation(law, F, R)
    local = wp.min(lam[w], real(POINTWISE) * mu[w])
    pressure = (lam[w] - local) * mean / volume[e]
    pressure_out[e, w] = pressure
    jacobian_out[e, w] = smallest
    C = mat310()
    for q in range(4):
        F = deformation_out[4 * e + q, w]
        R = mat33()
        if law == 0:
            R = rotation_out[4 * e + q, w]
        P = stress(law, mu[w], local, F, R) + pressure * dilatation_gradient(law, F, R)
        C -= (weight[e, q] * P * wp.transpose(inverse[e, q])) * wp.transpose(shape[q])
    scatter(C, e, w, corner_out)


@wp.kernel
def quadratic_product(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array2d(dtype=int),
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    weight: wp.array2d(dtype=real),
    volume: wp.array(dtype=real),
    deformation: wp.array2d(dtype=mat33),
    rotation: wp.array2d(dtype=mat33),
    pressure: wp.array2d(dtype=real),
    p: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    e, w = wp.tid()
    X = nodes(p, elem, e, w)
    local = wp.min(lam[w], real(POINTWISE) * mu[w])
    rest = (lam[w] - local) / volume[e]
    change = real(0.0)  # of the mean dilatation, times the volume
    if rest > real(0.0):
        for q in range(4):
            R = mat33()
            if law == 0:
                R = rotation[4 * e + q, w]
            change += weight[e, q] * wp.ddot(
                dilatation_gradient(law, deformation[4 * e + q, w], R), X * shape[q] * inverse[e, q]
            )
    C = mat310()
    for q in range(4):
        F = deformation[4 * e + q, w]
        dF = X * shape[q] * inverse[e, q]
        R = mat33()
        if law == 0:
            R = rotation[4 * e + q, w]
        dP = stress_derivative(law, mu[w], local, F, R, dF)
        if rest > real(0.0):
            dP += pressure[e, w] * dilatation_hessian(law, F, R, dF) + (rest * change) * dilatation_gradient(
                law, F, R
            )
        C += (weight[e, q] * dP * wp.transpose(inverse[e, q])) * wp.transpose(shape[q])
    scatter(C, e, w, corner_out)


@wp.kernel
def quadratic_energy(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array2d(dtype=int),
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    weight: wp.array2d(dtype=real),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    energy_out: wp.array2d(dtype=real),
):
    e, w = wp.tid()
    X = nodes(x, elem, e, w)
    mean = real(0.0)
    energy = real(0.0)
    local = wp.min(lam[w], real(POINTWISE) * mu[w])
    for q in range(4):
        F = X * shape[q] * inverse[e, q]
        R = mat33()
        if law == 0:
            R = polar_rotation(F)
        mean += weight[e, q] * dilatation(law, F, R)
        energy += weight[e, q] * energy_density(law, mu[w], local, F, R)
    energy_out[e, w] = energy + real(0.5) * (lam[w] - local) * mean * mean / volume[e]


@wp.kernel
def quadratic_stress(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    elem: wp.array2d(dtype=int),
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    weight: wp.array2d(dtype=real),
    volume: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    cauchy_out: wp.array2d(dtype=mat33),
    von_mises_out: wp.array2d(dtype=real),
):
    e, w = wp.tid()
    X = nodes(x, elem, e, w)
    mean = real(0.0)
    for q in range(4):
        F = X * shape[q] * inverse[e, q]
        mean += weight[e, q] * dilatation(law, F, polar_rotation(F))
    local = wp.min(lam[w], real(POINTWISE) * mu[w])
    pressure = (lam[w] - local) * mean / volume[e]
    sigma = mat33()
    for q in range(4):
        F = X * shape[q] * inverse[e, q]
        R = polar_rotation(F)
        P = stress(law, mu[w], local, F, R) + pressure * dilatation_gradient(law, F, R)
        sigma += (weight[e, q] / volume[e] / wp.determinant(F)) * (P * wp.transpose(F))
    deviator = sigma - wp.trace(sigma) / real(3.0) * wp.identity(n=3, dtype=real)
    cauchy_out[e, w] = sigma
    von_mises_out[e, w] = wp.sqrt(real(1.5) * wp.ddot(deviator, deviator))


class QuadraticTetrahedra:
    """Ten-node tetrahedra with a mean dilatation; offers the solver what `LinearTetrahedra` does.

    Args:
      vert: (nvert, 3) rest positions [m].
      elem: (nelem, 10) corners, then the nodes of `edge_nodes.EDGES`; edges may be curved.
      law: number of the material law, see `material.LAWS`.
      device: Warp device.
      contraction: of the integration points, see above.
      modulus: (nelem,) factors on the elastic constants, or None.

    Raises:
      ValueError: a tetrahedron is inverted or degenerate, or a curved edge folds one.
    """

    def __init__(self, vert, elem, law, device, contraction=CONTRACTION, modulus=None):
        self.nvert, self.nelem, self.law, self.device = len(vert), len(elem), law, device
        self._elem, self._launch, self.modulus = elem, Launches(device), modulus
        rest_shape(vert, elem[:, :4])
        shape = shape_gradients(0.25 + contraction * (_POINTS - 0.25))
        edges = np.einsum("eai,qak->eqik", vert[elem], shape)
        weight = np.linalg.det(edges) / 24
        folded = np.flatnonzero(weight.min(1) <= 0)
        if len(folded):
            raise ValueError(
                f"{len(folded)} of {len(elem)} quadratic tetrahedra are folded (first: {folded[0]}): "
                "straighten their edges"
            )
        inverse = np.linalg.inv(edges)
        # lumped as by the eight linear parts: 1/32 to a corner, 7/48 to an edge (Hinton, Rock and Zienkiewicz
        # 1976)
        share = np.array([1 / 32] * 4 + [7 / 48] * 6)
        self.node_volume = np.bincount(elem.ravel(), np.outer(weight.sum(1), share).ravel(), self.nvert)
        if modulus is not None:  # energy is linear in the constants: they may as well multiply the volume
            weight = weight * modulus[:, None]
        self._gradient, self._weight = np.einsum("qak,eqki->eqai", shape, inverse), weight
        self._volume = weight.sum(1)
        start, slot = incidence(self.nvert, elem)
        with wp.ScopedDevice(device):
            self.elem = wp.array(elem, dtype=int, ndim=2)
            self.shape = wp.array(shape, dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64))
            self.inverse = wp.array(inverse, dtype=mat33, ndim=2)
            self.weight = wp.array(weight, dtype=real, ndim=2)
            self.volume = wp.array(self._volume, dtype=real)
            self.start = wp.array(start, dtype=int)
            self.slot = wp.array(slot, dtype=int)

    def rest_stiffness(self, mu, lame) -> sp.csc_matrix:
        """(3 nvert, 3 nvert) [N/m] for Lame constants [Pa]; the law decides which part of the stiffness is
        averaged."""
        second = lame + 2 / 3 * mu if self.law == LAWS["neo_hookean"] else lame
        local = min(second, POINTWISE * mu)
        pointwise = local + lame - second
        dof = (3 * self._elem[:, :, None] + np.arange(3, dtype=np.int32)).reshape(self.nelem, 30)
        total = sp.csc_matrix((3 * self.nvert, 3 * self.nvert))
        for part in np.array_split(
            np.arange(self.nelem), 1 + self.nelem // 8192
        ):  # 900 numbers an element: in slices
            g, w = self._gradient[part], self._weight[part]
            gw = w[:, :, None, None] * g
            outer = np.einsum("eqai,eqbj->eaibj", gw, g, optimize=True)
            block = mu * np.swapaxes(outer, 2, 4) + pointwise * outer
            dot = np.einsum("eqak,eqbk->eab", gw, g, optimize=True)
            for i in range(3):
                block[:, :, i, :, i] += mu * dot
            mean = gw.sum(1).reshape(len(part), 30)
            block = block.reshape(len(part), 30, 30)
            block += (
                ((second - local) / self._volume[part])[:, None, None] * mean[:, :, None] * mean[:, None, :]
            )
            rows = np.repeat(dof[part], 30, axis=1).ravel()
            cols = np.tile(dof[part], 30).ravel()
            total += sp.coo_matrix((block.ravel(), (rows, cols)), shape=total.shape).tocsc()
        return total

    def allocate(self, nworld):
        """Scratch memory of one SkinData: what `force` leaves for `product`."""
        points, rotations = (4 * self.nelem, nworld), (4 * self.nelem if self.law == 0 else 1, nworld)
        with wp.ScopedDevice(self.device):
            return _Scratch(
                wp.zeros(points, dtype=mat33),
                wp.zeros(rotations, dtype=mat33),
                wp.zeros((self.nelem, nworld), dtype=real),
                wp.zeros((self.nelem, nworld), dtype=real),
                wp.zeros((10 * self.nelem, nworld), dtype=vec3),
            )

    def _mesh(self, mu, lam):
        return [self.law, mu, lam, self.elem, self.shape, self.inverse, self.weight, self.volume]

    def force(self, scratch, mu, lam, x, force_out):
        """Elastic nodal forces at x: [nvert, nworld] vec3 -> the same [N]."""
        n, w = x.shape
        self._launch(
            quadratic_force,
            (self.nelem, w),
            [*self._mesh(mu, lam), x],
            [scratch.deformation, scratch.rotation, scratch.pressure, scratch.jacobian, scratch.corner],
        )
        self._launch(gather, (n, w), [self.start, self.slot, scratch.corner, 1.0, 0], [force_out])

    def product(self, scratch, mu, lam, x, p, product_out):
        """Tangent stiffness at x, where `force` was evaluated last, times p [N]."""
        n, w = x.shape
        self._launch(
            quadratic_product,
            (self.nelem, w),
            [*self._mesh(mu, lam), scratch.deformation, scratch.rotation, scratch.pressure, p],
            [scratch.corner],
        )
        self._launch(gather, (n, w), [self.start, self.slot, scratch.corner, 1.0, 0], [product_out])

    def energy(self, mu, lam, x) -> np.ndarray:
        """(nelem, nworld) elastic energy of each element [J]."""
        out = wp.zeros((self.nelem, x.shape[1]), dtype=real, device=self.device)
        self._launch(quadratic_energy, out.shape, [*self._mesh(mu, lam), x], [out])
        return out.numpy()

    def smallest_jacobian(self, scratch) -> np.ndarray:
        """(nworld,) smallest det F at a Gauss point where `force` was evaluated last."""
        if self.device.is_cuda:
            return wp.to_torch(scratch.jacobian).amin(0).cpu().numpy()
        return scratch.jacobian.numpy().min(0)

    def stress(self, mu, lam, x):
        """Mean Cauchy stress of each element [nelem, nworld] mat33 and the von Mises stress of this mean
        [nelem, nworld] [Pa]."""
        cauchy = wp.zeros((self.nelem, x.shape[1]), dtype=mat33, device=self.device)
        mises = wp.zeros((self.nelem, x.shape[1]), dtype=real, device=self.device)
        self._launch(quadratic_stress, mises.shape, [*self._mesh(mu, lam), x], [cauchy, mises])
        scale_stress(self.modulus, cauchy, mises)
        return cauchy, mises


class _Scratch(NamedTuple):
    deformation: wp.array
    rotation: wp.array
    pressure: wp.array
    jacobian: wp.array
    corner: wp.array
