"""The liquid between core and skin: one pressure per sensor that resists a change of the enclosed volume.

The inner surface of the skin is closed, so the divergence theorem gives its volume and the volume's gradient; the core inside
is rigid and only subtracts a constant. p = -K (V - V0) / V0 with the bulk modulus K and the liquid's rest volume V0.
"""

import warp as wp

from .types import real, vec3

__all__ = ["cavity_volume", "volume_gradient"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def cavity_volume(
    # In:
    face: wp.array(dtype=wp.vec3i),
    x: wp.array2d(dtype=vec3),
    # Out:
    volume_out: wp.array2d(dtype=real),
):
    """Each inner face's share of the cavity's volume [face, world]; normals point into the cavity, hence the sign."""
    f, w = wp.tid()
    t = face[f]
    volume_out[f, w] = -wp.dot(x[t[0], w], wp.cross(x[t[1], w], x[t[2], w])) / real(6.0)


@wp.kernel
def volume_gradient(
    # In:
    face: wp.array(dtype=wp.vec3i),
    x: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    """dV/dx of a closed surface: a third of each face's area vector to each of its corners."""
    f, w = wp.tid()
    t = face[f]
    g = -wp.cross(x[t[1], w] - x[t[0], w], x[t[2], w] - x[t[0], w]) / real(6.0)
    corner_out[3 * f, w] = g
    corner_out[3 * f + 1, w] = g
    corner_out[3 * f + 2, w] = g
