"""The liquid between core and skin: one pressure per sensor that resists a change of the volume between them.

The inner surface of the skin is closed, so the divergence theorem gives the cavity's volume and its gradient;
the core inside is rigid and only subtracts a constant. Liquid is what is between the two: where the skin lies
on the core there is none, so the overlap that penalty contact needs is no volume, and no pressure acts there.
p = -K (V - Vn) / Vn with the bulk modulus K and the volume Vn that the liquid has without pressure; with
infinite K the pressure is an unknown of its own (see `docs/liquid.md`).

Skin leaves the core gradually: the share s of a contact sample that is dry grows with the contact pressure c,
  s = min(c / 2 p_ref, 1),
p_ref the liquid's pressure when the step began. What pushes the skin off, c + (1 - s) p, then grows with the
overlap everywhere. Switched at c = 0 instead, the skin would have two states of balance: pressed off the core
by liquid under it, or stuck to it without. Bonded
faces need no such care: their nodes are held, so it does not matter that pressure is counted on them as well.
"""

import dataclasses

import numpy as np
import warp as wp

from .launch import Launches
from .types import mat33, real, vec3

__all__ = ["Liquid", "Rest", "cavity_volume", "volume_gradient"]

wp.set_module_options({"enable_backward": False})

WATER = 2.2e9  # [Pa]
_REFERENCE = 1e3  # [Pa], least pressure that sets over which overlap skin and core part


@wp.kernel
def cavity_volume(
    # In:
    face: wp.array(dtype=wp.vec3i),
    x: wp.array2d(dtype=vec3),
    # Out:
    volume_out: wp.array2d(dtype=real),
):
    """Each inner face's share of the cavity's volume [face, world]; normals point into the cavity, hence the
    sign."""
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


@wp.func
def contact_pressure(i: int, w: int, geom: wp.array2d(dtype=int), force: wp.array2d(dtype=vec3), area: real):
    """Normal traction of the core on a sample that stands for an area [Pa]."""
    c = real(0.0)
    if geom[i, w] >= 0:
        c = wp.length(force[i, w]) / area
    return c


@wp.kernel
def wetting(
    # In:
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
    # Out:
    volume_out: wp.array2d(dtype=real),
    wet_out: wp.array2d(dtype=vec3),
):
    """Share of the liquid's volume under each inner face, and of the face's area that is wet and pushes on
    each corner (1/3 where all is).

    `slot` is a face's number on the surface that can meet the core, -1 where it cannot; `area` to `force` are
    of that surface."""
    f, w = wp.tid()
    t = face[f]
    x0 = x[t[0], w]
    x1 = x[t[1], w]
    x2 = x[t[2], w]
    volume = -wp.dot(x0, wp.cross(x1, x2)) / real(6.0)
    third = real(1.0) / real(3.0)
    wet = vec3(third, third, third)
    c = slot[f]
    if c >= 0:
        if touching[c, w] == 1:
            nsample = sample.shape[0]
            share = real(1.0) / real(nsample)
            full = real(2.0) * reference[w]
            overlap = real(0.0)
            for s in range(nsample):
                pressure = contact_pressure(c * nsample + s, w, geom, force, area[c] * share)
                if pressure < full:
                    dry = pressure / full
                    overlap += share * dry * pressure / (real(2.0) * stiffness)
                else:
                    dry = real(1.0)
                    overlap += share * (pressure - reference[w]) / stiffness
                wet -= share * dry * sample[s]
            volume += overlap * wp.length(wp.cross(x1 - x0, x2 - x0)) / real(2.0)
    volume_out[f, w] = volume
    wet_out[f, w] = wet


@wp.kernel
def wet_gradient(
    # In:
    face: wp.array(dtype=wp.vec3i),
    wet: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    """dV/dx: the wet part of each face's area vector to its corners."""
    f, w = wp.tid()
    t = face[f]
    g = -wp.cross(x[t[1], w] - x[t[0], w], x[t[2], w] - x[t[0], w]) / real(2.0)
    for k in range(3):
        corner_out[3 * f + k, w] = wet[f, w][k] * g


@wp.kernel
def gradient_derivative(
    # In:
    face: wp.array(dtype=wp.vec3i),
    wet: wp.array2d(dtype=vec3),
    x: wp.array2d(dtype=vec3),
    p: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    """Derivative of `wet_gradient` along p, the wet parts held; its sum over a closed surface is
    symmetric."""
    f, w = wp.tid()
    t = face[f]
    e1 = x[t[1], w] - x[t[0], w]
    e2 = x[t[2], w] - x[t[0], w]
    d1 = p[t[1], w] - p[t[0], w]
    d2 = p[t[2], w] - p[t[0], w]
    g = -(wp.cross(d1, e2) + wp.cross(e1, d2)) / real(2.0)
    for k in range(3):
        corner_out[3 * f + k, w] = wet[f, w][k] * g


@wp.func
def soften_face(
    f: int,
    w: int,
    # In:
    sample: wp.array(dtype=vec3),
    area: wp.array(dtype=real),
    stiffness: real,
    reference: real,
    p: real,
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    # In, out:
    block: wp.array2d(dtype=mat33),
):
    """Takes from a core face's tangent what the liquid's force falls by as samples become dry: p / (2 p_ref)
    of k."""
    nsample = sample.shape[0]
    share = area[f] / real(nsample)
    factor = wp.min(p / (real(2.0) * reference), real(1.0)) * stiffness * share
    for s in range(nsample):
        i = f * nsample + s
        c = contact_pressure(i, w, geom, force, share)
        if c > real(0.0) and c < real(2.0) * reference:
            n = wp.normalize(force[i, w])
            K = factor * wp.outer(n, n)
            b = sample[s]
            block[6 * f, w] = block[6 * f, w] - (b[0] * b[0]) * K
            block[6 * f + 1, w] = block[6 * f + 1, w] - (b[0] * b[1]) * K
            block[6 * f + 2, w] = block[6 * f + 2, w] - (b[0] * b[2]) * K
            block[6 * f + 3, w] = block[6 * f + 3, w] - (b[1] * b[1]) * K
            block[6 * f + 4, w] = block[6 * f + 4, w] - (b[1] * b[2]) * K
            block[6 * f + 5, w] = block[6 * f + 5, w] - (b[2] * b[2]) * K


@wp.kernel
def soften_contact(
    # In:
    sample: wp.array(dtype=vec3),
    area: wp.array(dtype=real),
    stiffness: real,
    reference: wp.array(dtype=real),
    pressure: wp.array(dtype=real),
    touching: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    force: wp.array2d(dtype=vec3),
    # In, out:
    block: wp.array2d(dtype=mat33),
):
    """See `soften_face`."""
    f, w = wp.tid()
    if touching[f, w] == 1 and pressure[w] > real(0.0):
        soften_face(f, w, sample, area, stiffness, reference[w], pressure[w], geom, force, block)


@dataclasses.dataclass(frozen=True)
class Rest:
    """What a skin is without touching geoms.

    Attributes:
      vert: (nvert, 3) nodes [m].
      pressure: of the liquid, above the surroundings [Pa].
      volume: of the liquid [m^3]; natural_volume: the same liquid without pressure [m^3].
    """

    vert: np.ndarray
    pressure: float
    volume: float
    natural_volume: float


class _PerWorld:
    """An attribute (nworld,) that numpy holds, or a field of `Worlds` on the device."""

    def __init__(self, field):
        self._field = field

    def __set_name__(self, owner, name):
        self._name = "_" + name

    def __get__(self, liquid, owner=None):
        return (
            getattr(liquid, self._name)
            if liquid.worlds is None
            else getattr(liquid.worlds, self._field).numpy()
        )

    def __set__(self, liquid, value):
        value = np.array(np.broadcast_to(np.asarray(value, float), (liquid.nworld,)))
        if liquid.worlds is None:
            setattr(liquid, self._name, value)
        else:
            getattr(liquid.worlds, self._field).assign(value)


class Liquid:
    """The liquid of one SkinData: `evaluate` after the contact forces, then `force`; `product` is its share
    of the tangent.

    Args:
      worlds: `device_worlds.Worlds` where the state lives on the device, which then also evaluates; else
        None.

    Attributes (nworld,):
      bulk_modulus: K [Pa]. extra: liquid beyond the model's fill [m^3].
      natural_volume: without pressure [m^3]. stiffness: kappa = K / natural_volume, by which p falls with V
        [Pa/m^3].
      offset: pressure at the natural volume [Pa]: zero, but the last step's pressure where the liquid is
        incompressible.
      last_pressure: above the surroundings, of the last step [Pa].
      gauge_pressure: above the surroundings [Pa], volume: [m^3] at the last evaluation.
    """

    natural_volume = _PerWorld("natural")
    stiffness = _PerWorld("kappa")
    last_pressure = _PerWorld("last_pressure")
    gauge_pressure = _PerWorld("pressure")
    volume = _PerWorld("volume")

    def __init__(self, model, nworld, worlds=None):
        self.m, self.nworld, self.worlds = model, nworld, worlds
        self.bulk_modulus, self.extra = np.full(nworld, model.options.bulk_modulus), np.zeros(nworld)
        if worlds is None:
            self._allocate(len(model.inner.face))
        self.reset()

    def _allocate(self, nface):
        self._launch = Launches(self.m.device)
        with wp.ScopedDevice(self.m.device):
            self._share = wp.zeros((nface, self.nworld), dtype=real)
            self._wet = wp.zeros((nface, self.nworld), dtype=vec3)
            self._corner = wp.zeros((3 * nface, self.nworld), dtype=vec3)
            self._none = wp.zeros((0, self.nworld), dtype=int), wp.zeros((0, self.nworld), dtype=vec3)
            self._no_area = wp.zeros(0, dtype=real)
            self._reference, self._pressure = (wp.zeros(self.nworld, dtype=real) for _ in range(2))

    def reset(self):
        rest = self.m.rest
        self.fill(rest.natural_volume + self.extra)
        self.last_pressure = np.where(self.bulk_modulus == 0, 0.0, rest.pressure)
        self.gauge_pressure = self.last_pressure.copy()
        self.volume = rest.volume

    def fill(self, natural_volume):
        """Takes as much liquid as has this volume without pressure [m^3]."""
        # an incompressible liquid: the pressure of the last step is what the next starts from, and this
        # stiffness only finds the change
        K = self.bulk_modulus
        self.natural_volume = natural_volume
        self.stiffness = np.where(np.isfinite(K), K, WATER) / natural_volume if self.m.has_liquid else 0.0
        self._tell_device()

    def keep_pressure(self, pressure):
        """Takes liquid in and out so that its pressure above the surroundings stays this [Pa]."""
        self.stiffness, self.last_pressure = 0.0, pressure
        self._tell_device()

    def _tell_device(self):
        if self.worlds is not None:
            self.worlds.holds.assign(self._holds().astype(np.int32))

    def _holds(self):
        return (self.stiffness == 0) | np.isinf(self.bulk_modulus)

    def begin(self):
        """Starts a step."""
        self.offset = np.where(self._holds(), self.last_pressure, 0.0)
        _view(self._reference)[...] = np.maximum(np.abs(self.last_pressure), _REFERENCE)

    def evaluate(self, x, core):
        """Volume, wet faces and pressure of the skin at x [nvert, nworld]; `core` is the contact with the
        core there, or None."""
        m = self.m
        if core is None:
            area, touching, geom, force = self._no_area, self._none[0], self._none[0], self._none[1]
        else:
            area, touching, geom, force = core.surface.area, core.touching, core.trial_geom, core.sample_force
        contact = [m.sample, area, m.contact_stiffness, self._reference]
        inputs = [m.inner.face, m.core_slot, *contact, touching, geom, force, x]
        self._launch(wetting, self._share.shape, inputs, [self._share, self._wet])
        self.volume = m.liquid_volume + _host(_view(self._share).sum(0)) - m.rest_volume
        if not m.has_liquid:
            return
        self.gauge_pressure = self.offset - self.stiffness * (self.volume - self.natural_volume)
        if core is not None:
            _view(self._pressure)[...] = self.gauge_pressure
            self._launch(
                soften_contact,
                touching.shape,
                [*contact, self._pressure, touching, geom, force],
                [core.block],
            )

    def gradient(self, x):
        """dV/dx by corners of the inner faces, for `elasticity.gather`."""
        self._launch(wet_gradient, self._share.shape, [self.m.inner.face, self._wet, x], [self._corner])
        return self._corner

    def gradient_derivative(self, x, p):
        """The same of the derivative of dV/dx along p."""
        self._launch(
            gradient_derivative, self._share.shape, [self.m.inner.face, self._wet, x, p], [self._corner]
        )
        return self._corner

    def commit(self, good):
        """Ends a step; worlds that are not good keep their last pressure."""
        self.last_pressure = np.where(good, self.gauge_pressure, self.last_pressure)


def _view(array):
    return wp.to_torch(array) if array.device.is_cuda else array.numpy()


def _host(array):
    return array if isinstance(array, np.ndarray) else array.cpu().numpy()
