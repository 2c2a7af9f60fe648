"""The liquid between core and skin: one pressure per sensor that resists a change of the volume between them.

The inner surface of the skin is closed, so that the divergence theorem gives the cavity's volume and its
gradient; the rigid core subtracts a constant. There is no liquid where the skin lies on the core: the overlap
of penalty contact does not count as volume, and no pressure acts there. p = -K (V - Vn) / Vn with the bulk
modulus K and the volume Vn of the liquid without pressure; with infinite K the pressure is an unknown of its
own (see `docs/lab/liquid.md`).

The transition is gradual: the dry fraction s of a contact sample grows with the contact pressure c,

    s = min(c / 2 p_ref, 1),

with the liquid's pressure p_ref at the start of the step. The pressure on the skin, c + (1 - s) p, then grows
with the overlap everywhere. With a jump at c = 0 there would be two equilibria, on and off the core. Bonded
faces need no such transition, since pressure on their fixed nodes has no effect.
"""

import dataclasses
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..fields import as_numbers
from ..geometry.surface import face_areas, node_areas
from ..kernels import kernel_module
from ..short_repr import short_repr
from .newton.worlds import Worlds, total_of
from .types import mat33, real, vec3

kernel_module(__name__)

WATER = 2.2e9  # [Pa]


def volume_gradient(vert: np.ndarray, face: np.ndarray) -> np.ndarray:
    """dV/dx (nvert, 3) [m^2] of the cavity in inner faces (n, 3), whose normals point into it; vert: (nvert,
    3) [m]."""
    return -node_areas(face, face_areas(vert, face), len(vert))


@wp.func
def contact_pressure(i: int, w: int, geom: wp.array2d(dtype=int), force: wp.array2d(dtype=vec3), area: real):
    """Normal traction of the core on a sample of this area [Pa]."""
    c = real(0.0)
    if geom[i, w] >= 0:
        c = wp.length(force[i, w]) / area
    return c


@wp.func
def dry_fraction(
    k: int,
    w: int,
    sample: wp.array(dtype=vec3),
    area: real,
    stiffness: real,
    reference: real,
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
):
    """Wet fraction that each corner of face k loses by contact with the core, and the overlap with the core
    to subtract from the liquid's thickness [m]."""
    nsample = sample.shape[0]
    fraction = real(1.0) / real(nsample)
    full = real(2.0) * reference
    loss = vec3()
    overlap = real(0.0)
    for s in range(nsample):
        pressure = contact_pressure(k * nsample + s, w, geom, force, area * fraction)
        dry = real(1.0)
        if pressure < full:
            dry = pressure / full
            overlap += fraction * dry * pressure / (real(2.0) * stiffness)
        else:
            overlap += fraction * (pressure - reference) / stiffness
        loss += fraction * dry * sample[s]
    return loss, overlap


@wp.struct
class InnerFaces:
    """Faces of the cavity: their nodes, and their numbers `slot` among those that can touch the core, -1 of
    others; of these the rest areas [m^2] and the samples' barycentric coordinates."""

    face: wp.array(dtype=wp.vec3i)
    slot: wp.array(dtype=int)
    sample: wp.array(dtype=vec3)
    area: wp.array(dtype=real)


@wp.kernel
def wet_faces(
    # In:
    chunk: int,
    inner: InnerFaces,
    stiffness: wp.array(dtype=real),
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
    """Volume of a chunk of inner faces, the wet fractions of their corners, and their part in the volume's
    gradient."""
    c, w = wp.tid()
    if on[w] == 0:
        return
    third = real(1.0) / real(3.0)
    total = real(0.0)
    # read once: what a loop reads through a struct is loaded again after each store
    face = inner.face
    slot = inner.slot
    sample = inner.sample
    rest_area = inner.area
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
                area = rest_area[k]
                loss, overlap = dry_fraction(k, w, sample, area, stiffness[w], reference[w], geom, force)
                wet -= loss
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
    fraction: wp.array3d(dtype=real),
    offset: wp.array(dtype=real),
    kappa: wp.array(dtype=real),
    natural: wp.array(dtype=real),
    keep_pressure: int,
    on: wp.array(dtype=int),
    # Out:
    volume_out: wp.array(dtype=real),
    pressure_out: wp.array(dtype=real),
    tangent_out: wp.array(dtype=real),
):
    """Volume of the liquid and its pressure in world w. enclosed: the liquid's volume minus that of the faces
    [m^3]. keep_pressure: 1: the tangent keeps its pressure, see `newton.line_search.choose_length`."""
    w, t = wp.tid()
    if on[w] == 0:
        return
    volume = enclosed + total_of(fraction, 0, w, t)
    if t > 0:
        return
    volume_out[w] = volume
    pressure = offset[w] - kappa[w] * (volume - natural[w])
    pressure_out[w] = pressure
    if keep_pressure == 0:
        tangent_out[w] = pressure


@wp.kernel
def release_pressure(
    # In:
    sample: wp.array(dtype=vec3),
    area: wp.array(dtype=real),
    stiffness: wp.array(dtype=real),
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
    """Subtracts the decrease of the liquid's force with the dry fraction, p / (2 p_ref) k, from the tangent
    of core face f, if that was evaluated. Gradients and the tangents of bodies need it; a press takes the
    same work without it."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    p = pressure[w]
    if near[f, w] == 1 and touching[f, w] == 1 and p > real(0.0):
        nsample = sample.shape[0]
        fraction = area[f] / real(nsample)
        factor = wp.min(p / (real(2.0) * reference[w]), real(1.0)) * stiffness[w] * fraction
        for s in range(nsample):
            i = f * nsample + s
            c = contact_pressure(i, w, geom, force, fraction)
            if c > real(0.0) and c < real(2.0) * reference[w]:
                n = wp.normalize(force[i, w])
                K = factor * wp.outer(n, n)
                b = sample[s]
                block[6 * f, w] = block[6 * f, w] - (b[0] * b[0]) * K
                block[6 * f + 1, w] = block[6 * f + 1, w] - (b[0] * b[1]) * K
                block[6 * f + 2, w] = block[6 * f + 2, w] - (b[0] * b[2]) * K
                block[6 * f + 3, w] = block[6 * f + 3, w] - (b[1] * b[1]) * K
                block[6 * f + 4, w] = block[6 * f + 4, w] - (b[1] * b[2]) * K
                block[6 * f + 5, w] = block[6 * f + 5, w] - (b[2] * b[2]) * K


@dataclasses.dataclass(frozen=True)
class Rest:
    """Equilibrium of a skin without contact, or, with arrays of a leading nworld, of those of many worlds.

    Attributes:
      vert: (nvert, 3) nodes [m].
      pressure: of the liquid, above the surroundings [Pa].
      volume: of the liquid [m^3]; natural_volume: the same liquid without pressure, and of worlds without
        `Liquid.extra` [m^3].
    """

    vert: np.ndarray
    pressure: float | np.ndarray
    volume: float | np.ndarray
    natural_volume: float | np.ndarray


def _copy_of(name):
    """Property: a copy of a number of the worlds on the host."""
    return property(lambda liquid: getattr(liquid._worlds, name).numpy().copy())


class Liquid:
    """The liquid of one SkinData: its amount, pressure and volume in every world.

    Args:
      model: SkinModel. worlds: `newton.worlds.Worlds` with the numbers on the device.

    Attributes (nworld,), copies on the host:
      bulk_modulus: K [Pa]. extra: liquid beyond the model's filling [m^3].
      natural_volume: without pressure [m^3]. stiffness: kappa = K / natural_volume = -dp/dV [Pa/m^3].
      last_pressure: at the end of the last step, above the surroundings [Pa]. rest_pressure: without contact.
      gauge_pressure: above the surroundings [Pa], volume: [m^3] at the last evaluation.
    """

    def __init__(self, model: Any, nworld: int, worlds: Worlds):
        self._model, self._worlds, self.nworld = model, worlds, nworld
        self.bulk_modulus, self.extra = np.full(nworld, model.options.bulk_modulus), np.zeros(nworld)
        numbers = (model.rest.pressure, model.rest.volume, model.rest.natural_volume)
        self.rest_at(*(np.full(nworld, x) for x in numbers))
        self.reset()

    natural_volume, stiffness, gauge_pressure, volume = map(
        _copy_of, ("natural", "kappa", "pressure", "volume")
    )

    @property
    def last_pressure(self) -> np.ndarray:
        return self._worlds.last_pressure.numpy().copy()

    @last_pressure.setter
    def last_pressure(self, value: ArrayLike) -> None:
        self._write("last_pressure", value)

    def reset(self) -> None:
        """Resets the filling of every world; pressures are reset by `state`."""
        self.fill(self._natural + self.extra)
        self._write("volume", self._volume)

    def rest_at(self, pressure: np.ndarray, volume: np.ndarray, natural_volume: np.ndarray) -> None:
        """Sets pressure, volume and natural volume without contact (nworld,), from the next `reset` on."""
        self.rest_pressure, self._volume, self._natural = pressure, volume, natural_volume

    def fill(self, natural_volume: ArrayLike) -> None:
        """Sets the volume of the liquid without pressure [m^3]."""
        # for an incompressible liquid the stiffness only determines the change from the last step's pressure
        K = self.bulk_modulus
        kappa = np.where(np.isfinite(K), K, WATER) / natural_volume if self._model.has_liquid else 0.0
        self._write("natural", natural_volume)
        self._write("kappa", kappa)
        self._write("keeps_volume", (np.asarray(kappa) == 0) | np.isinf(K))

    def keep_pressure(self, pressure: ArrayLike) -> None:
        """Keeps the pressure above the surroundings at this value [Pa], with any amount of liquid."""
        self._write("kappa", 0.0)
        self._write("keeps_volume", 1)
        self._write("last_pressure", pressure)

    def set(self, bulk_modulus: ArrayLike | None = None, fill_volume: ArrayLike | None = None) -> None:
        """See `SkinData.set_liquid`."""
        if not self._model.has_liquid:
            raise ValueError("this model has no liquid: make it with SkinOptions(liquid=True)")
        natural, n = self._natural, self.nworld
        bulk, extra = self.bulk_modulus, self.extra
        if bulk_modulus is not None:
            bulk = _each("bulk_modulus", bulk_modulus, n)
        if fill_volume is not None:
            extra = _each("fill_volume", fill_volume, n)
        if not (bulk >= 0).all():
            raise ValueError(
                f"bulk_modulus is {short_repr(bulk_modulus)}: pass numbers >= 0 [Pa], math.inf for a "
                "liquid that keeps its volume"
            )
        if not (np.isfinite(extra) & (natural + extra > 0)).all():
            raise ValueError(
                f"fill_volume is {short_repr(fill_volume)}: pass finite numbers [m^3] above minus the "
                f"{np.min(natural):g} m^3 that there are"
            )
        self.bulk_modulus, self.extra = bulk, extra
        self.fill(natural + extra)
        self._write("last_pressure", np.where(bulk == 0, 0.0, self.last_pressure))

    def _write(self, field, value):
        array = getattr(self._worlds, field)
        dtype = np.int32 if array.dtype is wp.int32 else np.float64
        array.assign(np.array(np.broadcast_to(np.asarray(value), self.nworld), dtype))


def _each(name, value, nworld):
    """Broadcasts a number or (nworld,) to (nworld,)."""
    value = as_numbers(name, value)
    if value.shape not in ((), (1,), (nworld,)):
        raise ValueError(f"{name} has shape {value.shape}: pass one number or ({nworld},)")
    return np.array(np.broadcast_to(value, nworld))
