"""From nodes to integration points and back: deformation gradients there, and the nodal forces of stresses
there, for both elements."""

import numpy as np
import warp as wp

from . import elasticity, quadratic
from .types import mat33, real, vec3

__all__ = ["IntegrationPoints"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def linear_gradient(
    # In:
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    x: wp.array2d(dtype=vec3),
    # Out:
    gradient_out: wp.array2d(dtype=mat33),
):
    e, w = wp.tid()
    gradient_out[e, w] = elasticity.edge_matrix(x, elem[e], w) * inverse_edges[e]


@wp.kernel
def quadratic_gradient(
    # In:
    elem: wp.array2d(dtype=int),
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    x: wp.array2d(dtype=vec3),
    # Out:
    gradient_out: wp.array2d(dtype=mat33),
):
    e, w = wp.tid()
    X = quadratic.nodes(x, elem, e, w)
    for q in range(4):
        gradient_out[4 * e + q, w] = X * shape[q] * inverse[e, q]


@wp.kernel
def linear_divergence(
    # In:
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    stress: wp.array2d(dtype=mat33),
    sign: real,
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    """Nodal forces of first Piola stresses, times sign."""
    e, w = wp.tid()
    elasticity.write_corners(
        sign * volume[e] * stress[e, w] * wp.transpose(inverse_edges[e]), e, w, corner_out
    )


@wp.kernel
def quadratic_divergence(
    # In:
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    weight: wp.array2d(dtype=real),
    stress: wp.array2d(dtype=mat33),
    sign: real,
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    e, w = wp.tid()
    C = quadratic.mat310()
    for q in range(4):
        C += (sign * weight[e, q] * stress[4 * e + q, w] * wp.transpose(inverse[e, q])) * wp.transpose(
            shape[q]
        )
    quadratic.scatter(C, e, w, corner_out)


class IntegrationPoints:
    """Those of an element formulation on the CPU, for stresses that it does not have itself.

    Args:
      elements: LinearTetrahedra (one point each) or QuadraticTetrahedra (four).
      nworld: number of worlds.

    Attributes:
      shape: (npoint, nworld). modulus: (npoint,) Warp array of factors on the elastic constants. share:
        (npoint,) of the element's volume.
    """

    def __init__(self, elements, nworld):
        self._elements, self.quadratic = elements, isinstance(elements, quadratic.QuadraticTetrahedra)
        each, corners = (4, 10) if self.quadratic else (1, 4)
        self.shape = (each * elements.nelem, nworld)
        with wp.ScopedDevice("cpu"):
            self._corner = wp.zeros((corners * elements.nelem, nworld), dtype=vec3)
            self.modulus = wp.full(self.shape[0], real(1.0), dtype=real)
        self.share = (
            (elements._weight / elements._volume[:, None]).ravel()
            if self.quadratic
            else np.ones(elements.nelem)
        )
        if elements.modulus is not None:
            self.modulus.numpy()[:] = elements.modulus.repeat(each)

    def allocate(self, dtype):
        """Zeros at every point [npoint, nworld]."""
        return wp.zeros(self.shape, dtype=dtype, device="cpu")

    def gradient(self, x, out):
        """Deformation gradients of positions x, or changes of them, [nvert, nworld] -> [npoint, nworld]."""
        e = self._elements
        if self.quadratic:
            self.launch(quadratic_gradient, [e.elem, e.shape, e.inverse, x], [out], (e.nelem, x.shape[1]))
        else:
            self.launch(linear_gradient, [e.elem, e.inverse_edges, x], [out])

    def add_forces(self, stress, sign, node_out):
        """Adds the nodal forces of first Piola stresses [npoint, nworld], times sign, to node_out [nvert,
        nworld]."""
        e = self._elements
        if self.quadratic:
            inputs = [e.shape, e.inverse, e.weight, stress, sign]
            self.launch(quadratic_divergence, inputs, [self._corner], (e.nelem, node_out.shape[1]))
        else:
            self.launch(linear_divergence, [e.inverse_edges, e.volume, stress, sign], [self._corner])
        self.launch(elasticity.gather, [e.start, e.slot, self._corner, 1.0, 1], [node_out], node_out.shape)

    def launch(self, kernel, inputs, outputs, dim=None):
        """Launches a kernel over all points and worlds, or over dim."""
        wp.launch(kernel, dim=dim or self.shape, inputs=inputs, outputs=outputs, device="cpu")
