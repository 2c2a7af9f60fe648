"""The skin's elements: tetrahedra of four nodes with constant strain, or of ten nodes with averaged
dilatation.

Ten nodes have four integration points: Gauss's, pulled towards the centroid by `CONTRACTION`. That lowers the
energy of a strain's variation inside an element, of which a mesh as coarse as the wall has too much, by
CONTRACTION^2 and leaves its mean alone: a strain that is constant is still exact (the alpha finite element
method of Liu, Nguyen-Thoi and Lam 2008 scales strain gradients the same way).

Each element's energy is  sum_q w_q W(F_q; lam_q) + V (lam - lam_q)/2 mean(theta)^2,  lam_q = min(lam,
POINTWISE mu), with the law's measure of dilatation theta (`law.dilatation`; J - 1 for neo_hookean). What goes
beyond lam_q is felt by the element's mean dilatation alone (Nagtegaal, Parks and Rice 1974; Simo, Taylor and
Pister 1985): volume is kept per element, not at every point, which leaves the element free to bend. A mean
dilatation for all of lam (POINTWISE = 0) would be too soft under local loads, since a pressure that is
constant over large elements is crude. What varies inside an element vanishes with its size, so POINTWISE
changes the error of a mesh, not the limit; so does CONTRACTION. With CONTRACTION = 1 and lam <= POINTWISE mu
integration is full, as in CalculiX's C3D10. Four nodes have one point, which feels all of lam.
"""

import copy

import numpy as np
import scipy.sparse as sp
import warp as wp

from ...geometry.edge_nodes import shape_gradients
from ..types import mat33, real, vec3
from .law import LAWS
from .points import Mesh

__all__ = ["CONTRACTION", "POINTWISE", "Tetrahedra", "incidence"]

POINTWISE = 5.0  # of mu; docs/lab/elements.md has the error of other values
CONTRACTION = 0.92  # of the distance from the centroid to Gauss's points; docs/lab/elements.md has the error
_SQUEEZED = 0.2  # least stretch that `deformed` takes
_NEAR, _FAR = (5 + 3 * 5**0.5) / 20, (5 - 5**0.5) / 20  # barycentric Gauss points, exact to degree 2
_POINTS = np.full((4, 4), _FAR) + (_NEAR - _FAR) * np.eye(4)


def incidence(nvert: int, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """CSR lists of the corner slots (cell * ncorner + corner) that belong to each node: start (nvert+1,),
    slot (ncell * ncorner,)."""
    flat = cells.ravel()
    slot = np.argsort(flat, kind="stable").astype(np.int32)
    start = np.zeros(nvert + 1, np.int32)
    np.cumsum(np.bincount(flat, minlength=nvert), out=start[1:])
    return start, slot


class Tetrahedra:
    """The elements of a skin at rest.

    Args:
      vert: (nvert, 3) rest positions [m].
      elem: (nelem, 4), or (nelem, 10): corners, then the nodes of `edge_nodes.EDGES`; edges may be curved.
      law: number of the material law, see `law.LAWS`.
      device: Warp device.
      modulus: (nelem,) factors on the elastic constants that `rest_stiffness` takes, or None.
      contraction: of the integration points of ten-node tetrahedra, see above.

    Attributes:
      npoint: integration points of an element. corners: its nodes.
      cap: the largest lam over mu that points feel.
      mesh: `points.Mesh`. start, slot: CSR lists of the corners that belong to each node (Warp).
      node_volume: (nvert,) lumped [m^3].
      gradient: (nelem, npoint, corners, 3) of the shape functions by rest positions [1/m].
      weight: (nelem, npoint) volume that a point stands for [m^3]. elem: (nelem, corners) nodes.

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
            self.npoint, self.cap, share = 1, 1e300, np.full(4, 1 / 4)
            shape = np.concatenate([-np.ones((1, 3)), np.eye(3)])[None]
            whole = 6
        else:
            self.npoint, self.cap = 4, POINTWISE
            # lumped as by the eight linear parts (Hinton, Rock and Zienkiewicz 1976)
            share = np.array([1 / 32] * 4 + [7 / 48] * 6)
            shape = shape_gradients(0.25 + contraction * (_POINTS - 0.25))
            whole = 24
        self._shape, self._whole, self._share = shape, whole, share
        inverse, weight = self._measure(vert)
        start, slot = incidence(self.nvert, elem)
        self.mesh = Mesh()
        with wp.ScopedDevice(device):
            self.mesh.elem = wp.array(np.ascontiguousarray(elem.T), dtype=int, ndim=2)
            self.mesh.shape = wp.array(shape, dtype=vec3, ndim=2)
            self.mesh.inverse = wp.array(inverse, dtype=mat33, ndim=2)
            self.mesh.weight = wp.array(weight, dtype=real, ndim=2)
            self.mesh.volume = wp.array(weight.sum(1), dtype=real)
            padded = np.pad(elem, ((0, 0), (0, 12 - elem.shape[1])))
            self.mesh.of_element = wp.array(padded, dtype=int, ndim=2)
            self.mesh.shape_single = wp.array(shape, dtype=wp.vec3, ndim=2)
            self.mesh.inverse_single = wp.array(inverse, dtype=wp.mat33, ndim=2)
            self.start, self.slot = wp.array(start, dtype=int), wp.array(slot, dtype=int)

    def _measure(self, vert):
        """Inverse of the parent's map and volume of the points, of a skin that lies there at rest."""
        elem = self.elem
        _refuse_degenerate(vert, elem)
        edges = np.einsum("eai,qak->eqik", vert[elem], self._shape)
        weight = np.linalg.det(edges) / self._whole
        folded = np.flatnonzero(weight.min(1) <= 0)
        if len(folded):
            raise ValueError(
                f"{len(folded)} of {len(elem)} quadratic tetrahedra are folded (first: {folded[0]}): "
                "straighten their edges"
            )
        inverse, volume = np.linalg.inv(edges), np.outer(weight.sum(1), self._share)
        self.node_volume = np.bincount(elem.ravel(), volume.ravel(), self.nvert)
        self.gradient, self.weight = np.einsum("qak,eqki->eqai", self._shape, inverse), weight
        return inverse, weight

    def rest_at(self, vert: np.ndarray) -> None:
        """Gives the nodes other rest positions (nvert, 3) [m].

        Raises:
          ValueError: a tetrahedron would be inverted, degenerate or folded; then nothing has changed.
        """
        inverse, weight = self._measure(vert)
        self.mesh.inverse.assign(inverse)
        self.mesh.inverse_single.assign(inverse)
        self.mesh.weight.assign(weight)
        self.mesh.volume.assign(weight.sum(1))

    def deformed(self, vert: np.ndarray) -> "Tetrahedra":
        """Elements whose `rest_stiffness` is near the tangent of these in a deformed shape, and positive
        definite: made in that shape, but for what is squeezed to nothing or inside out; only turned under the
        corotational law, which measures volume change along the axes that turn.

        Args:
          vert: (nvert, 3) [m].
        """
        there = copy.copy(self)
        left, stretch, right = np.linalg.svd(np.einsum("eai,eqak->eqik", vert[self.elem], self.gradient))
        left[..., 2] *= np.linalg.det(left @ right)[..., None]
        stretch = np.maximum(stretch, _SQUEEZED)
        if self.law == LAWS["corotational"]:
            stretch = np.ones_like(stretch)
        there.gradient = np.einsum("eqij,eqaj->eqai", (left / stretch[..., None, :]) @ right, self.gradient)
        there.weight = self.weight * stretch.prod(-1)
        return there

    def rest_stiffness(self, mu: float, lame: float) -> sp.csc_matrix:
        """(3 nvert, 3 nvert) [N/m] for Lame constants [Pa]: every law here has the same linearisation, but
        decides which part of the stiffness is averaged."""
        second = lame + 2 / 3 * mu if self.law == LAWS["neo_hookean"] else lame
        local = min(second, self.cap * mu)
        pointwise = local + lame - second
        n, total = 3 * self.corners, sp.csc_matrix((3 * self.nvert, 3 * self.nvert))
        dof = (3 * self.elem[:, :, None] + np.arange(3, dtype=np.int32)).reshape(self.nelem, n)
        weight = self.weight if self.modulus is None else self.weight * self.modulus[:, None]
        # up to 900 numbers an element: in slices
        for part in np.array_split(np.arange(self.nelem), 1 + self.nelem // 8192):
            g, w = self.gradient[part], weight[part]
            gw = w[:, :, None, None] * g
            outer = np.einsum("eqai,eqbj->eaibj", gw, g, optimize=True)
            block = mu * np.swapaxes(outer, 2, 4) + pointwise * outer
            dot = np.einsum("eqak,eqbk->eab", gw, g, optimize=True)
            for i in range(3):
                block[:, :, i, :, i] += mu * dot
            block = block.reshape(len(part), n, n)
            if second > local:
                mean = gw.sum(1).reshape(len(part), n)
                stiff = (second - local) / w.sum(1)
                block += stiff[:, None, None] * mean[:, :, None] * mean[:, None, :]
            rows = np.repeat(dof[part], n, axis=1).ravel()
            cols = np.tile(dof[part], n).ravel()
            total += sp.coo_matrix((block.ravel(), (rows, cols)), shape=total.shape).tocsc()
        return total


def _refuse_degenerate(vert, elem):
    edges = np.moveaxis(vert[elem[:, 1:4]] - vert[elem[:, :1]], 1, 2)
    volume = np.linalg.det(edges) / 6
    bad = np.flatnonzero(~(volume > 1e-9 * np.abs(edges).max(axis=(1, 2)) ** 3))
    if len(bad):
        raise ValueError(
            f"{len(bad)} of {len(elem)} tetrahedra are inverted or degenerate (first: {bad[0]}, volume "
            f"{volume[bad[0]]:.3g} m^3): repair the mesh or swap two nodes of each inverted tetrahedron"
        )
