"""History variables of the integration points: overstress, largest energy, slip of friction elements. See
`points` for the equations."""

import functools
import types
from typing import Any

import numpy as np
import warp as wp

from ...kernels import kernel_module, set_fields
from ..program import Launcher
from ..state import allocate
from ..types import mat33, real, vec3
from . import points
from .friction import deviator, sticking_fraction, strain
from .law import Law, polar
from .material import Material
from .points import Mesh, Rubber, deformation_of

kernel_module(__name__)


@wp.func
def pull_back(law: int, F: mat33, P: mat33):
    """Second Piola stress from the first."""
    if law == Law.LINEAR:
        return P
    S = wp.inverse(F) * P
    return real(0.5) * (S + wp.transpose(S))


@wp.func
def prony_weight(term: wp.vec2d, dt: real):
    """g h of a term of the Prony series: overstress per step of the stress."""
    a = dt / term[1]
    if a < real(1.0e-4):  # a series, since the difference would lose digits
        return term[0] * (real(1.0) - a * (real(0.5) - a / real(6.0)))
    return term[0] * (real(1.0) - wp.exp(-a)) / a


@wp.kernel
def begin_worlds(
    # In:
    rubber: Rubber,
    dt: wp.array(dtype=real),
    # In and out:
    softness: wp.array(dtype=real),
):
    """The sum c of the Prony weights of this step in world w, and the compliance scale of the
    preconditioner."""
    w = wp.tid()
    stiff = real(1.0)
    if rubber.prony.shape[0] > 0:
        gain = real(0.0)
        for k in range(rubber.prony.shape[0]):
            gain += prony_weight(rubber.prony[k, w], dt[w])
        rubber.gain[w] = gain
        stiff += gain
    for b in range(rubber.branch.shape[0]):
        stiff += rubber.branch[b, w][0]
    softness[w] = softness[w] / stiff


@wp.kernel
def begin_points(rubber: Rubber, dt: wp.array(dtype=real)):
    """The initial stress H of point i in this step."""
    i, w = wp.tid()
    H = -rubber.gain[w] * rubber.last[i, w]
    for k in range(rubber.prony.shape[0]):
        H += wp.exp(-dt[w] / rubber.prony[k, w][1]) * rubber.overstress[k, i, w]
    rubber.past[i, w] = H


@wp.func
def rotation(law: int, F: mat33):
    """Rotation of a deformation gradient for the corotational law, zero for laws that do not need it."""
    if law == Law.COROTATIONAL:
        return polar(F)
    return mat33()


@wp.func
def relaxing_stress(rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, worst: real):
    """Second Piola stress that relaxes [Pa], at the largest energy density `worst`."""
    R = rotation(rubber.law, F)
    S = pull_back(rubber.law, F, points.remembered(rubber, e, w, mu, lam, F, R))
    if rubber.mullins[w][0] > real(0.0):
        W = points.remembered_energy(rubber, e, w, mu, lam, F, R)
        S *= points.softening(rubber, e, w, W, worst)[0]
    return S


@wp.func
def largest_energy(rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, worst: real):
    """Largest energy density, including the present one [J/m^3]."""
    if rubber.mullins[w][0] <= real(0.0):
        return worst
    return wp.max(worst, points.remembered_energy(rubber, e, w, mu, lam, F, rotation(rubber.law, F)))


@functools.cache
def _kernels(corners: int) -> types.SimpleNamespace:
    module = kernel_module(f"{__name__}.{corners}")
    deformation = deformation_of(corners)

    @wp.func
    def point(cap: real, mesh: Mesh, rubber: Rubber, x: wp.array2d(dtype=vec3), e: int, q: int, w: int):
        """Number of point q of an element, its deformation gradient and the law's constants there."""
        mu = rubber.mu[w]
        i = mesh.weight.shape[1] * e + q
        return i, deformation(mesh, e, q, x, w), mu, wp.min(rubber.lam[w], cap * mu)

    @wp.kernel(module=module)
    def commit(
        # In:
        cap: real,
        mesh: Mesh,
        rubber: Rubber,
        x: wp.array2d(dtype=vec3),
        dt: wp.array(dtype=real),
        failed: wp.array(dtype=int),
    ):
        """Updates the history variables of point q for the step that ended at x, unless the world failed."""
        e, q, w = wp.tid()
        if failed[w] == 1:
            return
        i, F, mu, lam = point(cap, mesh, rubber, x, e, q, w)
        if rubber.last.shape[0] > 0:
            worst = largest_energy(rubber, e, w, mu, lam, F, rubber.worst[i, w])
            S = relaxing_stress(rubber, e, w, mu, lam, F, worst)
            for k in range(rubber.prony.shape[0]):
                term = rubber.prony[k, w]
                Q = wp.exp(-dt[w] / term[1]) * rubber.overstress[k, i, w]
                rubber.overstress[k, i, w] = Q + prony_weight(term, dt[w]) * (S - rubber.last[i, w])
            rubber.last[i, w] = S
            rubber.worst[i, w] = worst
        if rubber.branch.shape[0] > 0:
            A = strain(rubber.law, F)
            for b in range(rubber.branch.shape[0]):
                E = rubber.slip[b, i, w]
                T = deviator(A - E)
                rubber.slip[b, i, w] = E + (real(1.0) - sticking_fraction(T, rubber.branch[b, w][1])) * T

    @wp.kernel(module=module)
    def forget(cap: real, mesh: Mesh, rubber: Rubber, x: wp.array2d(dtype=vec3), mask: wp.array(dtype=bool)):
        """Resets point q to the relaxed, virgin state at x, without stress of the friction elements."""
        e, q, w = wp.tid()
        if not mask[w]:
            return
        i, F, mu, lam = point(cap, mesh, rubber, x, e, q, w)
        if rubber.last.shape[0] > 0:
            worst = largest_energy(rubber, e, w, mu, lam, F, real(0.0))
            rubber.worst[i, w] = worst
            rubber.last[i, w] = relaxing_stress(rubber, e, w, mu, lam, F, worst)
            for k in range(rubber.prony.shape[0]):
                rubber.overstress[k, i, w] = mat33()
        for b in range(rubber.branch.shape[0]):
            rubber.slip[b, i, w] = deviator(strain(rubber.law, F))

    @wp.kernel(module=module)
    def recall(cap: real, mesh: Mesh, rubber: Rubber, x: wp.array2d(dtype=vec3)):
        """Computes the stress that relaxes at x, the end of the last step."""
        e, q, w = wp.tid()
        i, F, mu, lam = point(cap, mesh, rubber, x, e, q, w)
        worst = largest_energy(rubber, e, w, mu, lam, F, rubber.worst[i, w])
        rubber.last[i, w] = relaxing_stress(rubber, e, w, mu, lam, F, worst)

    @wp.kernel(module=kernel_module(f"{module}.points"))
    def point_slopes(
        # In:
        cap: real,
        mesh: Mesh,
        rubber: Rubber,
        x: wp.array2d(dtype=vec3),
        change: wp.array2d(dtype=mat33),
        # Out:
        stress_out: wp.array2d(dtype=mat33),
        change_out: wp.array2d(dtype=mat33),
        energy_out: wp.array2d(dtype=real),
    ):
        """See `RubberMemory.point_slopes`."""
        e, q, w = wp.tid()
        i, F, mu, lam = point(cap, mesh, rubber, x, e, q, w)
        R = rotation(rubber.law, F)
        stress_out[i, w] = points.remembered(rubber, e, w, mu, lam, F, R)
        change_out[i, w] = points.remembered_derivative(rubber, e, w, mu, lam, F, R, change[i, w])
        energy_out[i, w] = points.remembered_energy(rubber, e, w, mu, lam, F, R)

    return types.SimpleNamespace(commit=commit, forget=forget, recall=recall, point_slopes=point_slopes)


def rubber_of_worlds(model: Any, materials: list[Material], modulus: np.ndarray | None) -> Rubber:
    """The constants of `materials`, one for each world, as `Rubber` on the model's device, without history.

    Args:
      modulus: (nelem, nworld) factors on Young's modulus, or None.
    """
    none = np.zeros((0, len(materials)))
    branch = _by_world([m.hysteresis for m in materials]) * [1, 1.5**0.5]
    second = [m.bulk if m.law == "neo_hookean" else m.lame for m in materials]
    mullins = [m.mullins or (0.0, 0.0, 0.0) for m in materials]
    with wp.ScopedDevice(model.device):
        rubber = set_fields(Rubber(), law=model.law, mu=[m.mu for m in materials], lam=second)
        set_fields(rubber, modulus=none if modulus is None else modulus, branch=branch, mullins=mullins)
        set_fields(rubber, prony=_by_world([m.prony for m in materials]))
        return set_fields(rubber, stiffening=[m.stiffening for m in materials])


def _by_world(tables):
    """Tables (k, 2) of each world as (k, nworld, 2)."""
    table = np.array(tables, float).reshape(len(tables), -1, 2)
    return np.ascontiguousarray(np.swapaxes(table, 0, 1))


class RubberMemory:
    """History variables of the points of every world.

    Made by `SkinData` if the model's material has `prony`, `mullins` or `hysteresis`.

    Args:
      model: SkinModel.
      rubber: constants of the worlds, to which the arrays are added.
      options: of the rubber beyond its law, see `SkinModel.rubber_options`.
    """

    def __init__(self, model: Any, rubber: Rubber, options: tuple[str, ...]):
        self._model, self.rubber, self.options = model, rubber, options
        elements, nworld = model.elements, len(rubber.mu)
        self.npoint, self._dim = elements.npoint * elements.nelem, (elements.nelem, elements.npoint, nworld)
        timed = rubber.prony.shape[0]
        sizes = {"term": timed, "branch": rubber.branch.shape[0], "point": self.npoint, "world": nworld}
        with wp.ScopedDevice(model.device):
            allocate("rubber", rubber, sizes, options)
            rubber.gain = wp.zeros(nworld, dtype=real)
            rubber.past = wp.zeros((self.npoint if timed else 0, nworld), dtype=mat33)
            self._all = wp.full(nworld, True, dtype=bool)
        self._kernels = _kernels(model.elements.corners)

    def begin_step(self, program: Launcher, dt: wp.array, softness: wp.array) -> None:
        """Starts a step; updates the compliance scale `softness` (nworld,) of the preconditioner."""
        program.launch(begin_worlds, len(softness), [self.rubber, dt], [softness])
        if self.rubber.prony.shape[0]:
            program.launch(begin_points, self.rubber.past.shape, [self.rubber, dt])

    def commit_step(self, program: Launcher, x: wp.array, dt: wp.array, failed: wp.array) -> None:
        """Updates the history variables for the step that ended at x, in worlds that did not fail."""
        program.launch(self._kernels.commit, self._dim, [*self._constants, x, dt, failed])

    def forget(self, x: wp.array, mask: wp.array | None = None) -> None:
        """Resets the worlds of mask (nworld,) bool to the relaxed, virgin state at x [nvert, nworld]."""
        self._launch(self._kernels.forget, [x, self._all if mask is None else mask])

    def largest_energy(self) -> np.ndarray:
        """Largest energy densities so far [point, world] [J/m^3]; empty without softening."""
        return self.rubber.worst.numpy().copy()

    def raise_energy(self, largest_energy: np.ndarray, x: wp.array) -> None:
        """Raises the points' largest energy densities so far to at least these, at x. Call it after
        `forget`."""
        if largest_energy.size:
            self.rubber.worst.assign(np.maximum(largest_energy, self.rubber.worst.numpy()))
            self.recall(x)

    def recall(self, x: wp.array) -> None:
        """Computes the stress that relaxes of points at x, from the largest energy densities."""
        if self.rubber.worst.size:
            self._launch(self._kernels.recall, [x])

    def point_slopes(self, x: wp.array, change: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stress and energy on which the history variables of a single world depend, at every point.

        Args:
          x: (nvert, 1) [m]. change: (npoint, 3, 3) of the deformation gradient.

        Returns:
          First Piola-Kirchhoff stress (npoint, 3, 3) of the part with history, before softening [Pa]; its
          derivative along `change`; its energy density (npoint,) [J/m^3].
        """
        device = self._model.device
        given = wp.array(np.ascontiguousarray(change[:, None]), dtype=mat33, device=device)
        out = [wp.zeros((self.npoint, 1), dtype=t, device=device) for t in (mat33, mat33, real)]
        inputs = [*self._constants, x, given]
        wp.launch(self._kernels.point_slopes, self._dim, inputs, out, device=device)
        return tuple(a.numpy()[:, 0] for a in out)

    def at_present(self) -> Rubber:
        """The rubber between steps: the overstress is an initial stress, and does not relax."""
        now, rubber = Rubber(), self.rubber
        for name in Rubber.vars:
            setattr(now, name, getattr(rubber, name))
        now.gain = wp.zeros_like(rubber.gain)
        if len(rubber.past):
            now.past = wp.clone(rubber.past)
            now.past.assign(rubber.overstress.numpy().sum(0))
        return now

    @property
    def _constants(self):
        return [self._model.elements.cap, self._model.elements.mesh, self.rubber]

    def _launch(self, kernel, inputs):
        wp.launch(kernel, self._dim, [*self._constants, *inputs], device=self._model.device)
