"""Forces of the elements alone, as nodes feel them, and what their points remember, without a step."""

import functools

import numpy as np
import warp as wp

from biotac_mj.skin.program import Launcher
from biotac_mj.skin.rubber.element_points import Kind, material_functions
from biotac_mj.skin.rubber.law import COMPRESSED, barrier, energy_density
from biotac_mj.skin.rubber.points import Mesh, Rubber, deformation_of
from biotac_mj.skin.types import DOUBLE, SINGLE, mat33, real, vec3

__all__ = ["Elements", "begin", "check_tangent", "commit", "energy_of", "gradients"]


class Elements:
    """Elastic forces, with all that the rubber remembers, of a SkinData's elements.

    Args:
      data: SkinData.
      precision: `types.Precision` of directions; None: the data's.
    """

    def __init__(self, data, precision=None):
        if precision is not None:
            from biotac_mj.skin.rubber.element_forces import ElementForces

            self.elements = ElementForces(data.model.elements, data.rubber, data.options, precision)
            self.precision = precision
        else:
            self.elements, self.precision = data.element_forces(), data.precision
        self._model, self._rubber, self._options = data.model, data.rubber, data.options
        self.nvert, self.nworld = data.model.nvert, data.nworld
        self.device = data.model.device
        self._launcher = Launcher(self.device)
        self._on = wp.full(self.nworld, 1, dtype=int, device=self.device)
        self._inverted = wp.zeros(self.nworld, dtype=int, device=self.device)
        self._x = None

    def force(self, x) -> np.ndarray:
        """Nodal forces [N] at positions x, (nvert, 3) of a single world or (nvert, nworld, 3) [m]."""
        self._x, x = self._array(x, vec3), np.asarray(x)
        self.elements.evaluate_corners(self._launcher, self._x, self._on, self._inverted)
        return self._gather(self.elements.corner_force).reshape(x.shape)

    def product(self, p) -> np.ndarray:
        """Tangent where `force` was last, times p, of the same shape [N]."""
        p = np.asarray(p)
        along = self._array(p, self.precision.vec)
        self.elements.multiply_corners(self._launcher, self._x, along, self._on)
        return self._gather(self.elements.corner).reshape(p.shape)

    def energy(self, x) -> float:
        """Of all elements of a single world by their law [J]."""
        return energy_of(self._model.elements, self._rubber, self._options, self._array(x, vec3)).sum()

    def upright(self, x) -> np.ndarray:
        """Whether no element of a world (nworld,) is inverted at x."""
        self._inverted.zero_()
        self.elements.evaluate_corners(self._launcher, self._array(x, vec3), self._on, self._inverted)
        inverted = self._inverted.numpy() >= 2
        self._inverted.zero_()
        return ~inverted

    def _array(self, x, kind):
        nodal = np.ascontiguousarray(np.asarray(x, float).reshape(self.nvert, self.nworld, 3))
        return wp.array(nodal, dtype=kind, ndim=2, device=self.device)

    def _gather(self, corner):
        start, slot = self.elements.start.numpy(), self.elements.slot.numpy()
        out = np.zeros((self.nvert, self.nworld, 3))
        np.add.at(out, np.repeat(np.arange(self.nvert), np.diff(start)), corner.numpy()[slot])
        return out


def check_tangent(data, elastic, x, directions, h, bound):
    """The tangent that rubber with memory adds to that of `elastic`, both SkinData, is the derivative of the
    forces at x (nvert, 3) along the first of two directions, by differences of step h; it is symmetric, and
    the same in single precision. Returns the added force as a function of the step along that direction."""
    whole, law = Elements(data), Elements(elastic)
    p, q = directions

    def force(shift):
        return whole.force(x + shift * p) - law.force(x + shift * p)

    def product(direction):
        return whole.product(direction) - law.product(direction)

    expected = -(8 * (force(h) - force(-h)) - (force(2 * h) - force(-2 * h))) / (12 * h)
    force(0.0)
    found = product(p)
    np.testing.assert_allclose(found, expected, atol=bound * abs(expected).max())
    np.testing.assert_allclose(np.vdot(q, found), np.vdot(p, product(q)), rtol=1e-9)
    single, double = Elements(data, SINGLE), whole.product(p)
    single.force(x)
    np.testing.assert_allclose(single.product(p), double, rtol=0, atol=1e-5 * abs(double).max())
    return force


@wp.func
def barrier_energy(law: int, mu: real, F: mat33):
    """Energy density of the barrier against total compression [J/m^3]."""
    J = wp.determinant(F)
    if law == 3 or J >= COMPRESSED:
        return real(0.0)
    return mu * COMPRESSED * barrier(J)[0]


@functools.cache
def _energy_kernel(kind):
    f, deformation, npoint = material_functions(kind), deformation_of(kind.corners), kind.npoint
    rotation, theta, weighted_volume, local_lame = f.rotation, f.theta, f.weighted_volume, f.local_lame

    @wp.kernel(module=f"{__name__}.{kind.module}", enable_backward=False)
    def energy(
        cap: real, rubber: Rubber, mesh: Mesh, x: wp.array2d(dtype=vec3), energy_out: wp.array2d(dtype=real)
    ):
        e, w = wp.tid()
        mu = rubber.mu[w]
        lam = rubber.lam[w]
        local = local_lame(mu, lam, cap)
        mean = real(0.0)
        total = real(0.0)
        for q in range(wp.static(npoint)):
            F = deformation(mesh, e, q, x, w)
            R = rotation(F)
            mean += mesh.weight[e, q] * theta(rubber.law, F, R)
            density = energy_density(rubber.law, mu, local, F, R) + barrier_energy(rubber.law, mu, F)
            total += weighted_volume(rubber, mesh, e, q, w) * density
        factor = weighted_volume(rubber, mesh, e, 0, w) / mesh.weight[e, 0]
        energy_out[e, w] = total + factor * real(0.5) * (lam - local) * mean * mean / mesh.volume[e]

    return energy


def energy_of(elements, rubber, options, x) -> np.ndarray:
    """Elastic energy (nelem, nworld) of each of `Tetrahedra` by its law [J], at x [nvert, nworld]."""
    kind = Kind(elements.corners, elements.law == 0, DOUBLE, bool(options))
    out = wp.zeros((elements.nelem, x.shape[1]), dtype=real, device=x.device)
    inputs = [elements.cap, rubber, elements.mesh, x]
    wp.launch(_energy_kernel(kind), out.shape, inputs, [out], device=x.device)
    return out.numpy()


def gradients(elements, x) -> tuple[np.ndarray, np.ndarray]:
    """Deformation gradients (n, 3, 3) at all integration points of `Tetrahedra` at x (nvert, 3), from the
    shape functions, and the volumes (n,) that belong to them [m^3]."""
    mesh = elements.mesh
    shape = np.einsum("qak,eqki->eqai", mesh.shape.numpy(), mesh.inverse.numpy())
    F = np.einsum("aei,eqaj->eqij", x[mesh.elem.numpy()], shape).reshape(-1, 3, 3)
    return F, mesh.weight.numpy().ravel()


def begin(data, dt=1.0) -> None:
    """Prepares what the points remember for a step of dt [s]."""
    data.dt.fill_(dt)
    data.worlds.softness.fill_(1.0)
    data.memory.begin_step(Launcher(data.model.device), data.dt, data.worlds.softness)


def commit(data, ended=None) -> None:
    """Takes over a step that has ended at data.x, in the worlds of the mask `ended`."""
    ended = np.ones(data.nworld, bool) if ended is None else np.asarray(ended)
    failed = wp.array((~ended).astype(np.int32), dtype=int, device=data.model.device)
    data.memory.commit_step(Launcher(data.model.device), data.x, data.dt, failed)
