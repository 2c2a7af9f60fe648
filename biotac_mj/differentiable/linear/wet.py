"""The liquid's volume and the area vectors by which its pressure pushes the skin, as functions of what the
core pushes: Warp's adjoint of `skin.liquid.wet_faces`.

The volume is one number: one backward pass gives its gradient. The nine numbers of a face that lies on the
core have a world each, so that one pass gives all Jacobians. That its area vectors turn with its corners is
left to the skin's own tangent: how much of a face is wet depends on the core's pushes alone."""

import dataclasses

import numpy as np
import warp as wp

from ...skin.liquid import wet_faces
from ...skin.types import real, vec3

__all__ = ["VolumeSlopes", "differentiate_push", "differentiate_volume"]

_NUMBERS = 9
_adjoint = wp.kernel(wet_faces.func, module=f"{__name__}.adjoint", enable_backward=True)


@dataclasses.dataclass(frozen=True)
class VolumeSlopes:
    """Of the liquid's volume.

    Attributes:
      by_node: (nvert, 3) [m^2]. by_force: (nsample, 3) by what the core pushes at each sample [m^3/N].
      by_stiffness: of the contact. by_reference: by the pressure at which skin and core part.
    """

    by_node: np.ndarray
    by_force: np.ndarray
    by_stiffness: float
    by_reference: float


def differentiate_volume(
    x: np.ndarray,
    face: wp.array,
    slot: wp.array,
    area: wp.array,
    sample: wp.array,
    force: np.ndarray,
    geom: np.ndarray,
    stiffness: float,
    reference: float,
) -> VolumeSlopes:
    """Slopes of the volume under the inner faces.

    Args:
      x: (nvert, 3) nodes [m].
      face, slot: (nface,) inner faces and their numbers among those that can meet the core.
      area: (ncore,) of these at rest [m^2]. sample: (s,) barycentric coordinates.
      force: (ncore s, 3) of the core on their samples [N]; geom: (ncore s,) -1 where none touches.
      stiffness: of the contact [Pa/m]. reference: `Worlds.reference` [Pa].
    """
    n = len(face)
    inputs = _Inputs(1, x, force, geom, len(sample), stiffness, reference)
    inputs.pull(n, face, slot, area, sample, volume=wp.ones((1, n, 1), dtype=real, device="cpu"))
    return VolumeSlopes(
        inputs.x.grad.numpy()[:, 0].copy(),
        inputs.force.grad.numpy()[:, 0].copy(),
        float(inputs.stiffness.grad.numpy()[0]),
        float(inputs.reference.grad.numpy()[0]),
    )


def differentiate_push(
    corner: np.ndarray,
    area: np.ndarray,
    sample: wp.array,
    force: np.ndarray,
    geom: np.ndarray,
    stiffness: float,
    reference: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the area vectors of faces that lie on the core.

    Args:
      corner: (m, 3, 3) positions [m]. area: (m,) at rest [m^2].
      force: (m, s, 3), geom: (m, s), others: see `differentiate_volume`.

    Returns:
      by_force (m, 9, s, 3) of the three corners' vectors [m^2/N] and by_reference (m, 9) [m^2/Pa].
    """
    (m, s), k = geom.shape, _NUMBERS
    inputs = _Inputs(k, corner.reshape(-1, 3), force.reshape(-1, 3), geom.ravel(), s, stiffness, reference)
    with wp.ScopedDevice("cpu"):
        face = wp.array(np.arange(3 * m, dtype=np.int32).reshape(m, 3), dtype=wp.vec3i)
        seed = np.zeros((m, 3, k, 3))
        for i in range(k):
            seed[:, i // 3, i, i % 3] = 1
        slot, area = wp.array(np.arange(m), dtype=int), wp.array(area, dtype=real)
        inputs.pull(m, face, slot, area, sample, corner=wp.array(seed.reshape(3 * m, k, 3), dtype=vec3))
    by_force = inputs.force.grad.numpy().reshape(m, s, k, 3).swapaxes(1, 2).copy()
    # doubling pushes and reference together leaves what is wet
    return by_force, -np.einsum("mnsk,msk->mn", by_force, force) / reference


class _Inputs:
    """A copy for each of k numbers."""

    def __init__(self, k, x, force, geom, s, stiffness, reference):
        def copies(value, dtype):
            value = np.ascontiguousarray(np.repeat(np.asarray(value)[:, None], k, 1))
            return wp.array(value, dtype=dtype, device="cpu", requires_grad=dtype is not int)

        self.k = k
        self.x, self.force, self.geom = copies(x, vec3), copies(force, vec3), copies(geom, int)
        self.touching = copies((np.reshape(geom, (-1, s)) >= 0).any(1).astype(np.int32), int)
        self.stiffness, self.reference = (
            wp.full(k, value, dtype=real, device="cpu", requires_grad=True)
            for value in (stiffness, reference)
        )

    def pull(self, n, face, slot, area, sample, volume=None, corner=None):
        """Gradients of the inputs from those of volumes (1, n, k) or corners (3n, k), each face a chunk of
        its own. The adjoint runs the kernel forwards itself: a tape would do so once before."""
        k = self.k
        with wp.ScopedDevice("cpu"):
            shapes = ((1, n, k), real), ((n, k), vec3), ((3 * n, k), vec3)
            outputs = [wp.zeros(shape, dtype=dtype) for shape, dtype in shapes]
            slopes = [wp.zeros_like(a) if given is None else given for a, given in zip(
                outputs, (volume, None, corner)
            )]  # fmt: skip
            law = [self.stiffness, self.reference, self.touching, self.geom, self.force, self.x]
            inputs = [1, face, slot, sample, area, *law, wp.ones(k, dtype=int)]
            given = [self.stiffness.grad, self.reference.grad, None, None, self.force.grad, self.x.grad]
            wp.launch(
                _adjoint, (n, k), inputs, outputs, adjoint=True,
                adj_inputs=[1, None, None, None, None, *given, None], adj_outputs=slopes,
            )  # fmt: skip
