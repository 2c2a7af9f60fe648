"""The skin's elements: tetrahedra of four nodes with constant strain, or of ten nodes with averaged
dilatation.

Ten-node elements have four integration points: Gauss points, moved towards the centroid by `CONTRACTION`.
This lowers the energy of strain variation inside an element, which is too high where a mesh is as coarse as
the wall, by CONTRACTION^2. A constant strain remains exact (the alpha finite element method of Liu,
Nguyen-Thoi and Lam 2008 scales strain gradients in the same way).

The energy of an element is  sum_q w_q W(F_q; lam_q) + V (lam - lam_q)/2 mean(theta)^2,  lam_q = min(lam,
POINTWISE mu), with the law's measure of dilatation theta (`law.dilatation`; J - 1 for neo_hookean). The part
of lam beyond lam_q acts on the element's mean dilatation only (Nagtegaal, Parks and Rice 1974; Simo, Taylor
and Pister 1985): volume is kept per element, not at every point, so that the element can bend. With a mean
dilatation for all of lam (POINTWISE = 0) elements would be too soft under local loads, since a pressure that
is constant over a large element is a poor approximation. Variation inside an element vanishes with its size,
so that POINTWISE and CONTRACTION change the error of a mesh, not the limit. With CONTRACTION = 1 and lam <=
POINTWISE mu integration is full, as in CalculiX's C3D10. Four-node elements have one point with all of lam.
"""

import copy

import numpy as np
import scipy.sparse as sp
import warp as wp

from ...geometry.edge_nodes import shape_gradients
from ...geometry.tet_mesh import check_volumes
from ...kernels import set_fields
from .law import LAWS
from .points import Mesh

POINTWISE = 5.0  # of mu; docs/lab/elements.md has the error of other values
CONTRACTION = 0.92  # of the distance from the centroid to Gauss's points; docs/lab/elements.md has the error
_LEAST_STRETCH = 0.2  # of `deformed`
# barycentric Gauss points, exact to degree 2
_GAUSS_NEAR, _GAUSS_FAR = (5 + 3 * 5**0.5) / 20, (5 - 5**0.5) / 20
_POINTS = np.full((4, 4), _GAUSS_FAR) + (_GAUSS_NEAR - _GAUSS_FAR) * np.eye(4)


def incidence(nvert: int, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """CSR lists of the corners (cell * ncorner + corner) at each node: start (nvert+1,), slot (ncell *
    ncorner,)."""
    flat = cells.ravel()
    slot = np.argsort(flat, kind="stable").astype(np.int32)
    start = np.zeros(nvert + 1, np.int32)
    np.cumsum(np.bincount(flat, minlength=nvert), out=start[1:])
    return start, slot


class Tetrahedra:
    """The elements of the undeformed skin.

    Args:
      vert: (nvert, 3) reference positions [m].
      elem: (nelem, 4), or (nelem, 10): corners, then the nodes of `edge_nodes.EDGES`; edges may be curved.
      law: number of the material law, see `law.LAWS`.
      device: Warp device.
      modulus: (nelem,) factors on the elastic constants that `rest_stiffness` takes, or None.
      contraction: of the integration points of ten-node tetrahedra, see above.

    Attributes:
      npoint: integration points of an element. corners: its nodes.
      cap: largest lam over mu at points.
      mesh: `points.Mesh`. start, slot: CSR lists of the corners at each node (Warp).
      node_volume: (nvert,) lumped [m^3].
      gradient: (nelem, npoint, corners, 3) of the shape functions by reference positions [1/m].
      weight: (nelem, npoint) volume of a point [m^3]. elem: (nelem, corners) nodes.

    Raises:
      ValueError: a tetrahedron is inverted or degenerate, or a curved edge folds one.
    """

    def __init__(
        self,
        vert: np.ndarray,
        elem: np.ndarray,
        law: int,
        device: wp.DeviceLike,
        modulus: np.ndarray | None = None,
        contraction: float = CONTRACTION,
    ):
        self.nvert, self.nelem, self.law, self.device = len(vert), len(elem), law, device
        self.corners = elem.shape[1]
        self.elem, self.modulus = elem, modulus
        if self.corners == 4:
            self.npoint, self.cap, volume_fraction = 1, 1e300, np.full(4, 1 / 4)
            shape = np.concatenate([-np.ones((1, 3)), np.eye(3)])[None]
            whole = 6
        else:
            self.npoint, self.cap = 4, POINTWISE
            # lumped as by the eight linear parts (Hinton, Rock and Zienkiewicz 1976)
            volume_fraction = np.array([1 / 32] * 4 + [7 / 48] * 6)
            shape = shape_gradients(0.25 + contraction * (_POINTS - 0.25))
            whole = 24
        self._shape, self._whole, self._volume_fraction = shape, whole, volume_fraction
        inverse, weight = self._measure(vert)
        start, slot = incidence(self.nvert, elem)
        with wp.ScopedDevice(device):
            self.mesh = set_fields(Mesh(), elem=np.ascontiguousarray(elem.T), shape=shape, inverse=inverse)
            set_fields(self.mesh, weight=weight, volume=weight.sum(1))
            self.start, self.slot = wp.array(start, dtype=int), wp.array(slot, dtype=int)

    def _measure(self, vert):
        """Inverse of the parent map, and volume of the points, for reference positions `vert`."""
        elem = self.elem
        check_volumes(vert, elem)
        edges = np.einsum("eai,qak->eqik", vert[elem], self._shape)
        weight = np.linalg.det(edges) / self._whole
        folded = np.flatnonzero(weight.min(1) <= 0)
        if len(folded):
            raise ValueError(
                f"{len(folded)} of {len(elem)} quadratic tetrahedra are folded (first: {folded[0]}): "
                "straighten their edges"
            )
        inverse, volume = np.linalg.inv(edges), np.outer(weight.sum(1), self._volume_fraction)
        self.node_volume = np.bincount(elem.ravel(), volume.ravel(), self.nvert)
        self.gradient, self.weight = np.einsum("qak,eqki->eqai", self._shape, inverse), weight
        return inverse, weight

    def rest_at(self, vert: np.ndarray) -> None:
        """Sets other reference positions (nvert, 3) [m].

        Raises:
          ValueError: a tetrahedron would be inverted, degenerate or folded; then nothing changes.
        """
        inverse, weight = self._measure(vert)
        self.mesh.inverse.assign(inverse)
        self.mesh.weight.assign(weight)
        self.mesh.volume.assign(weight.sum(1))

    def deformed(self, vert: np.ndarray) -> "Tetrahedra":
        """Elements whose `rest_stiffness` approximates the tangent in a deformed shape, and is positive
        definite: elements of that shape, with stretches of at least 0.2. For the corotational law, which
        measures volume change along rotated axes, they are only rotated.

        Args:
          vert: (nvert, 3) [m].
        """
        there = copy.copy(self)
        left, stretch, right = np.linalg.svd(np.einsum("eai,eqak->eqik", vert[self.elem], self.gradient))
        left[..., 2] *= np.linalg.det(left @ right)[..., None]
        stretch = np.maximum(stretch, _LEAST_STRETCH)
        if self.law == LAWS["corotational"]:
            stretch = np.ones_like(stretch)
        there.gradient = np.einsum("eqij,eqaj->eqai", (left / stretch[..., None, :]) @ right, self.gradient)
        there.weight = self.weight * stretch.prod(-1)
        return there

    def rest_stiffness(self, mu: float, lame: float) -> sp.csc_matrix:
        """Stiffness (3 nvert, 3 nvert) [N/m] of the undeformed skin for Lame constants [Pa]. All laws have
        the same linearisation, except for the part of the stiffness that is averaged."""
        second = lame + 2 / 3 * mu if self.law == LAWS["neo_hookean"] else lame
        local = min(second, self.cap * mu)
        pointwise = local + lame - second
        n, total = 3 * self.corners, sp.csc_matrix((3 * self.nvert, 3 * self.nvert))
        dof = (3 * self.elem[:, :, None] + np.arange(3, dtype=np.int32)).reshape(self.nelem, n)
        weight = self.weight if self.modulus is None else self.weight * self.modulus[:, None]
        # in slices, since an element has up to 900 numbers
        for elements in np.array_split(np.arange(self.nelem), 1 + self.nelem // 8192):
            g, w = self.gradient[elements], weight[elements]
            gw = w[:, :, None, None] * g
            outer = np.einsum("eqai,eqbj->eaibj", gw, g, optimize=True)
            block = mu * np.swapaxes(outer, 2, 4) + pointwise * outer
            dot = np.einsum("eqak,eqbk->eab", gw, g, optimize=True)
            for i in range(3):
                block[:, :, i, :, i] += mu * dot
            block = block.reshape(len(elements), n, n)
            if second > local:
                mean = gw.sum(1).reshape(len(elements), n)
                stiff = (second - local) / w.sum(1)
                block += stiff[:, None, None] * mean[:, :, None] * mean[:, None, :]
            rows = np.repeat(dof[elements], n, axis=1).ravel()
            cols = np.tile(dof[elements], n).ravel()
            total += sp.coo_matrix((block.ravel(), (rows, cols)), shape=total.shape).tocsc()
        return total
