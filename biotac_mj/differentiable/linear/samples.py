"""What a touching sample feels, as a function of what it depends on: Warp's adjoint of the contact's own
functions.

In the geom's frame a sample's force and its new anchor depend on where it is and on where it sticks, on the
coefficient of friction and on the stiffness of its springs; turning and moving the geom is left to `linear`.
All six numbers of a sample have copies of these side by side, so that one backward pass gives all slopes."""

import dataclasses

import numpy as np
import warp as wp

from ...skin.contact.faces import Geoms
from ...skin.contact.shapes import distance
from ...skin.contact.touch import smooth_push, smooth_stick_or_slip, stick_or_slip
from ...skin.types import real, vec3

__all__ = ["SampleJacobians", "differentiate_samples"]

_OUTPUTS = 6  # force, anchor


@wp.kernel(module=f"{__name__}.adjoint", enable_backward=True)
def _feel(
    # In:
    stick_ratio: real,
    width: real,
    geom: wp.array(dtype=int),
    geoms: Geoms,
    local: wp.array2d(dtype=vec3),
    stick: wp.array2d(dtype=vec3),
    friction: wp.array2d(dtype=real),
    stiffness: wp.array2d(dtype=real),
    # Out:
    felt_out: wp.array2d(dtype=real),
):
    """One of the numbers of a sample [sample, number]: force [N], anchor [m]."""
    i, o = wp.tid()
    g = geom[i]
    y = local[i, o]
    k = stiffness[i, o]
    dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
    normal = vec3(dn[0], dn[1], dn[2])
    push = -k * dn[3]
    if width > real(0.0):
        push = smooth_push(k, width, dn[3])[0]
    most = friction[i, o] * push
    held = vec3()
    anchor = y
    if most > real(0.0):
        if width > real(0.0):
            held, _K, anchor = smooth_stick_or_slip(y, stick[i, o], normal, most, k * stick_ratio, width)
        else:
            held, _K, anchor = stick_or_slip(y, stick[i, o], normal, most, k * stick_ratio)
    force = push * normal + held
    if o < 3:
        felt_out[i, o] = force[o]
    else:
        felt_out[i, o] = anchor[o - 3]


@dataclasses.dataclass(frozen=True)
class SampleJacobians:
    """Derivatives of force and anchor (m, 6) of m samples in their geoms' frames.

    Attributes:
      force: (m, 3) [N]. anchor: (m, 3) [m].
      by_local, by_stick: (m, 6, 3). by_friction, by_stiffness: (m, 6), the latter by the sample's springs.
      slips: (m,) whether it slips.
    """

    force: np.ndarray
    anchor: np.ndarray
    by_local: np.ndarray
    by_stick: np.ndarray
    by_friction: np.ndarray
    by_stiffness: np.ndarray
    slips: np.ndarray


def differentiate_samples(
    geoms: Geoms,
    geom: np.ndarray,
    local: np.ndarray,
    stick: np.ndarray,
    friction: np.ndarray,
    stiffness: np.ndarray,
    stick_ratio: float,
    smoothing: float = 0.0,
) -> SampleJacobians:
    """Force and anchor of samples that touch, with their derivatives.

    Args:
      geoms: struct of the geoms, on the CPU.
      geom: (m,) which one each sample touches.
      local: (m, 3) where it is, stick: (m, 3) where it sticks, in the geom's frame [m].
      friction: (m,). stiffness: (m,) of its springs [N/m].
      stick_ratio: `SkinOptions.stick_ratio`. smoothing: half width of first touch, see `press` [m].
    """
    m = len(geom)

    def copies(value, dtype):
        value = np.repeat(np.asarray(value, float)[:, None], _OUTPUTS, 1)
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device="cpu", requires_grad=True)

    inputs = [copies(local, vec3), copies(stick, vec3), copies(friction, real), copies(stiffness, real)]
    felt = wp.zeros((m, _OUTPUTS), dtype=real, device="cpu", requires_grad=True)
    which = wp.array(np.ascontiguousarray(geom, np.int32), dtype=int, device="cpu")
    if m:
        given = [stick_ratio, smoothing, which, geoms, *inputs]
        wp.launch(_feel, (m, _OUTPUTS), given, [felt], device="cpu")
        felt.grad.fill_(1.0)
        # as a tape would, which takes longer to find out what to do than this takes
        wp.launch(
            _feel, (m, _OUTPUTS), given, [felt], device="cpu",
            adj_inputs=[stick_ratio, smoothing, None, geoms, *(a.grad for a in inputs)],
            adj_outputs=[felt.grad], adjoint=True,
        )  # fmt: skip
    value, slopes = felt.numpy(), [a.grad.numpy().copy() for a in inputs]
    slips = (np.asarray(friction) > 0) & (value[:, 3:] != stick).any(1)
    return SampleJacobians(value[:, :3].copy(), value[:, 3:].copy(), *slopes, slips)
