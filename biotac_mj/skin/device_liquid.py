"""The liquid of all worlds on the device: `liquid`'s equations, its kernels joined where one can do the work
of two."""

import warp as wp

from .device_worlds import total_of
from .liquid import contact_pressure, soften_face
from .types import mat33, real, vec3

__all__ = ["release_pressure", "settle_pressure", "wet_faces"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def wet_faces(
    # In:
    chunk: int,
    face: wp.array(dtype=wp.vec3i),
    slot: wp.array(dtype=int),
    sample: wp.array(dtype=vec3),
    area: wp.array(dtype=real),
    stiffness: real,
    reference: wp.array(dtype=real),
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    on: wp.array(dtype=int),
    # Out:
    volume_out: wp.array3d(dtype=real),
    wet_out: wp.array2d(dtype=vec3),
    corner_out: wp.array2d(dtype=vec3),
):
    """Volume under every chunk of inner faces, their wet parts, and what they add to the volume's gradient
    (see `liquid.wetting`)."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    third = real(1.0) / real(3.0)
    total = real(0.0)
    for f in range(c * chunk, wp.min((c + 1) * chunk, face.shape[0])):
        t = face[f]
        x0 = x[t[0], w]
        x1 = x[t[1], w]
        x2 = x[t[2], w]
        total -= wp.dot(x0, wp.cross(x1, x2)) / real(6.0)
        wet = vec3(third, third, third)
        normal = wp.cross(x1 - x0, x2 - x0)
        k = slot[f]
        if k >= 0:
            if touching[k, w] == 1:
                nsample = sample.shape[0]
                share = real(1.0) / real(nsample)
                full = real(2.0) * reference[w]
                overlap = real(0.0)
                for s in range(nsample):
                    pressure = contact_pressure(k * nsample + s, w, geom, force, area[k] * share)
                    dry = real(1.0)
                    if pressure < full:
                        dry = pressure / full
                        overlap += share * dry * pressure / (real(2.0) * stiffness)
                    else:
                        overlap += share * (pressure - reference[w]) / stiffness
                    wet -= share * dry * sample[s]
                total += overlap * wp.length(normal) / real(2.0)
        wet_out[f, w] = wet
        g = real(-0.5) * normal
        for a in range(3):
            corner_out[3 * f + a, w] = wet[a] * g
    volume_out[0, c, w] = total


@wp.kernel
def settle_pressure(
    # In:
    enclosed: real,
    share: wp.array3d(dtype=real),
    offset: wp.array(dtype=real),
    kappa: wp.array(dtype=real),
    natural: wp.array(dtype=real),
    on: wp.array(dtype=int),
    # Out:
    volume_out: wp.array(dtype=real),
    pressure_out: wp.array(dtype=real),
):
    """Volume of the liquid and its pressure; `enclosed` is what the shares' sum is short of the liquid's
    volume."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    volume = enclosed + total_of(share, 0, w, t)
    if t > 0:
        return
    volume_out[w] = volume
    pressure_out[w] = offset[w] - kappa[w] * (volume - natural[w])


@wp.kernel
def release_pressure(
    # In:
    sample: wp.array(dtype=vec3),
    area: wp.array(dtype=real),
    stiffness: real,
    reference: wp.array(dtype=real),
    pressure: wp.array(dtype=real),
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    near: wp.array2d(dtype=int),
    on: wp.array(dtype=int),
    # In, out:
    block: wp.array2d(dtype=mat33),
):
    """See `liquid.soften_face`; only where the tangent was made anew."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    if near[f, w] == 1 and touching[f, w] == 1 and pressure[w] > real(0.0):
        soften_face(f, w, sample, area, stiffness, reference[w], pressure[w], geom, force, block)
