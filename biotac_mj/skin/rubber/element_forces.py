"""Forces of the elements on their corners, and the tangent times a direction, in all worlds."""

import typing

import numpy as np
import warp as wp

from ..program import FEW, Launcher
from ..types import DOUBLE, SINGLE, Precision, mat33, real, vec3
from .element_kernels import element_kernels
from .element_points import BOUNDS
from .points import Rubber

if typing.TYPE_CHECKING:
    from .tetrahedra import Tetrahedra


def module_for_cuda(elements: "Tetrahedra", options: tuple[str, ...]) -> tuple[wp.Module, int]:
    """Module of the kernels for many worlds, and its block size, for `program.compile_ahead`. options: as in
    `ElementForces`."""
    kernels = element_kernels(elements.corners, elements.law == 0, SINGLE, bool(options))
    return kernels.force.module, BOUNDS[0]


class ElementForces:
    """Forces of the elements of all worlds on their corners, and the tangent times a direction.

    Args:
      elements: Tetrahedra.
      rubber: `points.Rubber` of all worlds.
      options: of the rubber beyond its law, see `SkinModel.rubber_options`.
      precision: of directions.

    Attributes:
      start, slot: CSR lists of the corners at each node.
      corner_force, corner: results of `evaluate_corners` and `multiply_corners` [slot, world] [N].
    """

    def __init__(
        self, elements: "Tetrahedra", rubber: Rubber, options: tuple[str, ...], precision: Precision
    ):
        self._elements, self._rubber, self.device = elements, rubber, elements.device
        self._nworld, self._count = len(rubber.mu), elements.nelem
        self.start, self.slot = elements.start, elements.slot
        self._kernels = element_kernels(elements.corners, elements.law == 0, precision, bool(options))
        # in double precision on CUDA they are for gradients of few worlds: small blocks use more
        # multiprocessors
        single, on_cuda = precision.name == "single", self.device.is_cuda
        self._block_dim = 64 if on_cuda and not single else BOUNDS[0]
        self._lanes = elements.npoint if on_cuda and single and self._nworld <= FEW else 1
        corners, averaged = (elements.corners * self._count, self._nworld), elements.npoint > 1
        with wp.ScopedDevice(self.device):
            shape = np.ascontiguousarray(elements.mesh.shape.numpy())
            self._shape, self._thin_shape = (
                wp.array(shape, dtype=self._kernels.gradients(p)) for p in (DOUBLE, precision)
            )
            self._pressure = wp.zeros((self._count if averaged else 0, self._nworld), dtype=real)
            stored = elements.npoint * self._count if precision.name == "double" else 0
            self._deformation = wp.zeros((stored, self._nworld), dtype=mat33)
            self._rotation = wp.zeros((stored if elements.law == 0 else 0, self._nworld), dtype=mat33)
            self.corner_force = wp.zeros(corners, dtype=vec3)
            self.corner = wp.zeros(corners, dtype=precision.vec)

    def evaluate_corners(self, program: Launcher, x: wp.array, on: wp.array, inverted: wp.array) -> None:
        """Computes the forces on the corners at x [nvert, nworld] in the worlds that are on. Marks worlds
        with a point that is inverted (2), flatter than its law allows (1), or both (3)."""
        stored = [self._pressure, self._deformation, self._rotation]
        self._launch(
            program, self._kernels.force, [self._shape, x, on], [*stored, self.corner_force, inverted]
        )

    def multiply_corners(self, program: Launcher, x: wp.array, p: wp.array, on: wp.array) -> None:
        """Computes the tangent at x, the nodes of the last `evaluate_corners`, times p, on the corners."""
        stored = [self._pressure, self._deformation, self._rotation]
        self._launch(program, self._kernels.product, [self._thin_shape, x, p, on, *stored], [self.corner])

    def stress(self, x: wp.array, rubber: Rubber) -> tuple[wp.array, wp.array]:
        """Mean Cauchy stress of the elements [nelem, nworld] mat33, and its von Mises stress [Pa]."""
        dim = (self._count, self._nworld)
        outputs = [
            wp.zeros(dim, dtype=mat33, device=self.device),
            wp.zeros(dim, dtype=real, device=self.device),
        ]
        inputs = [self._elements.cap, rubber, self._elements.mesh, x]
        wp.launch(self._kernels.cauchy, dim, inputs, outputs, device=self.device)
        return outputs[0], outputs[1]

    def point_slopes(self, x: wp.array, change: np.ndarray) -> tuple[np.ndarray, ...]:
        """Stress, dilatation and their derivatives at each integration point of a single world, for
        derivatives by reference positions.

        Args:
          x: (nvert, 1) [m].
          change: (nelem, npoint, 3, 3) of the deformation gradient.

        Returns:
          First Piola-Kirchhoff stress (nelem, npoint, 3, 3) [Pa]; its derivative at constant mean dilatation;
          the dilatation (nelem, npoint); its gradient (nelem, npoint, 3, 3).
        """
        shape, n = change.shape, change.shape[0] * change.shape[1]
        given = wp.array(np.ascontiguousarray(change).reshape(n, 1, 3, 3), dtype=mat33, device=self.device)
        out = [wp.zeros((n, 1), dtype=t, device=self.device) for t in (mat33, mat33, real, mat33)]
        inputs = [self._elements.cap, self._rubber, self._elements.mesh, x, given]
        wp.launch(self._kernels.point_slopes, (self._count, 1), inputs, out, device=self.device)
        return tuple(a.numpy().reshape(shape[: 2 if a.dtype is real else 4]) for a in out)

    def _launch(self, program, kernel, inputs, outputs):
        inputs = [self._lanes, self._elements.cap, self._rubber, self._elements.mesh, *inputs]
        dim = self._count, self._nworld, self._lanes
        program.launch(kernel, dim, inputs, outputs, self._block_dim)
