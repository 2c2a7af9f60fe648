"""Linearised memory of the rubber at the end of a step: stress from the history, and the new history.

`skin.rubber.points` has the equations. The implicit function theorem takes the history as an input, like the
step, so memory enters like the anchors of friction: with F the deformation gradient of a point, the new
memory and the stress are functions of F and the old memory. Slipping friction elements, and softening that
begins or ends, are kinks; derivatives are those of the side where the step ended."""

import dataclasses

import numpy as np
from scipy.special import erf

from ...skin.rubber.law import LAWS
from ...skin.rubber.material import Material
from ..memory_constants import split_constants
from ..record import Record
from ..skin import SkinWorlds

__all__ = ["LinearMemory", "Memory"]

_KINK = 1e-9  # relative distance from slip of friction elements, or from the largest energy, taken as a kink
_SHORT = 1e-4  # step over relaxation time below which `prony_weight` uses its series


@dataclasses.dataclass(frozen=True)
class Memory:
    """Memory of the n points of a skin, or cotangents or tangents of it.

    Attributes:
      overstress: (nterm, n, 3, 3) of the Prony series [Pa]. last: (n, 3, 3) the stress that relaxes [Pa].
      worst: (n,) largest energy density so far [J/m^3]. slip: (nbranch, n, 3, 3) of friction elements.
    """

    overstress: np.ndarray
    last: np.ndarray
    worst: np.ndarray
    slip: np.ndarray

    @classmethod
    def none(cls, material: Material, n: int) -> "Memory":
        """Zeros."""
        terms, branches = len(material.prony), len(material.hysteresis)
        zeros = np.zeros
        return cls(zeros((terms, n, 3, 3)), zeros((n, 3, 3)), zeros(n), zeros((branches, n, 3, 3)))


class LinearMemory:
    """The points of a skin in the state at the end of a step (`record.restore`).

    Args:
      skin: of one world, with memory.
      record: of the step.
    """

    def __init__(self, skin: SkinWorlds, record: Record):
        elements, rubber, material = skin.model.elements, skin.data.rubber, skin.model.material
        self._skin, self._elem, self._gradient = skin, elements.elem, elements.gradient
        self._linear, self._isochoric = (rubber.law == LAWS[name] for name in ("linear", "neo_hookean"))
        self._shape = elements.weight.shape
        n = elements.weight.size
        modulus = np.ones(len(self._elem)) if elements.modulus is None else elements.modulus
        self._modulus = np.repeat(modulus, self._shape[1])
        self._volume = self._modulus * elements.weight.ravel()
        self._F = self._gradient_of(record.x[:, 0].numpy())
        self._inverse = np.linalg.inv(self._F)
        overstress, last, slip = (
            getattr(rubber, name).numpy()[..., 0, :, :].reshape(-1, n, 3, 3)
            for name in ("overstress", "last", "slip")
        )
        last = last[0] if len(last) else np.zeros((n, 3, 3))
        # state at the start of the step, which a further load increment continued
        worst = getattr(record.begun, "worst", np.zeros(n))
        self.before = Memory(overstress.copy(), last.copy(), worst, slip.copy())
        prony, mullins, branch = split_constants(material, record.constants)
        self._series(prony, record.dt)
        self._moduli(record.numbers)
        self._soften(mullins)
        self._slip(branch)
        self._fix_branches()
        self._S = self._second(self._eta[:, None, None] * self._P)

    # --- parts ---

    def _gradient_of(self, x):
        """(n, 3, 3) of displacements (nvert, 3) of the nodes."""
        return np.einsum("eai,eqaj->eqij", x[self._elem], self._gradient).reshape(-1, 3, 3)

    def _series(self, prony, dt):
        g, tau = prony.T
        a = dt / tau
        step_weight = -np.expm1(-a) / a
        by_a = np.where(a < _SHORT, a / 3 - 0.5, (np.exp(-a) - step_weight) / a)
        self._decay, self._decay_by_time = np.exp(-a), np.exp(-a) * a / tau
        self._step_weight, self._step_weight_by_strength = g * step_weight, step_weight
        self._step_weight_by_time = -g * by_a * a / tau
        self._gain = self._step_weight.sum()

    def _moduli(self, numbers):
        """Stress and energy density of the rubber with memory, and their linear dependence on the law's
        constants, see `LinearStep`."""
        skin, mu, lam = self._skin, float(numbers["mu"]), float(numbers["lam"])
        memory, x, none = skin.data.memory, skin.data.x, np.zeros_like(self._F)
        with skin.another_lam() as other:
            P, _, W = memory.point_slopes(x, none)
        self._P, _, self._W = memory.point_slopes(x, none)
        lam_step = float(other) - lam
        lams = (P - self._P) / lam_step, (W - self._W) / lam_step
        mus = (self._P - lam * lams[0]) / mu, (self._W - lam * lams[1]) / mu
        self._mu, self._by = mu, {"mu": mus, "lam": lams}

    def _soften(self, mullins):
        """eta, and its derivatives by energy, by the largest energy, and by the Mullins constants."""
        W, worst, n = self._W, self.before.worst, len(self._W)
        self._eta, self._by_energy, self._by_worst = np.ones(n), np.zeros(n), np.zeros(n)
        self._by_mullins = np.zeros((len(mullins), n))
        self._loads = worst <= W
        if not (len(mullins) and mullins[0] > 0):
            return
        r, m, beta = mullins
        on_kink = np.abs(self._W - worst) <= _KINK * worst
        worst = self.before.worst[...] = np.where(on_kink, (1 - _KINK) * self._W, worst)
        self._loads = worst <= self._W
        width = m + beta * worst
        s = (worst - W) / width
        bell = np.where(self._loads, 0.0, 2 / np.pi**0.5 * np.exp(-(s**2)) / r)
        self._eta = np.where(self._loads, 1.0, 1 - erf(s) / r)
        self._by_energy = bell / width
        self._by_worst = -bell * (1 - beta * s) / width
        self._by_mullins = np.array([(1 - self._eta) / r, bell * s / width, bell * s * worst / width])

    def _slip(self, branch):
        """Trial strains of the friction elements, their norms, and the factors of the return mapping."""
        self._strength, most = branch.T[0][:, None, None, None], 1.5**0.5 * branch.T[1][:, None]
        self._trial = _deviator(self._strain() - self.before.slip)
        size = np.sqrt((self._trial**2).sum((-2, -1)))
        on_kink = (np.abs(size - most) <= _KINK * most) & (most > 0)
        self.before.slip[on_kink] += 2 * _KINK * self._trial[on_kink]
        self._slips = (size > most) & ~on_kink | (most == 0)
        self._size = np.where(size > 0, size, 1.0)[..., None, None]
        self._return_factor = np.where(self._slips, most / self._size[..., 0, 0], 1.0)[..., None, None]
        self._sliding = self._slips[..., None, None]

    def _fix_branches(self):
        """Rubber at rest after a step in which it slipped, or had its largest energy, is on a kink up to
        rounding: this decides the side for the elements' tangent."""
        rubber, before = self._skin.data.rubber, self.before
        for array, value in ((rubber.slip, before.slip), (rubber.worst, before.worst)):
            if array.size:
                array.assign(value.reshape(array.shape + array.numpy().shape[len(array.shape) :]))

    # --- geometry of a point, as `skin.rubber.friction` and `skin.rubber.memory` have it ---

    def _second(self, P):
        return P if self._linear else _symmetric(self._inverse @ P)

    def _strain(self):
        F = self._F
        if self._linear:
            return _symmetric(F) - np.eye(3)
        C = _t(F) @ F
        return 0.5 * ((self._volumetric() * C if self._isochoric else C) - np.eye(3))

    def _volumetric(self):
        return np.linalg.det(self._F)[:, None, None] ** (-2 / 3)

    def _strain_change(self, dF):
        if self._linear:
            return _symmetric(dF)
        dE = _symmetric(_t(self._F) @ dF)
        if self._isochoric:
            third = np.trace(self._inverse @ dF, axis1=1, axis2=2)[:, None, None] / 3
            return self._volumetric() * (dE - third * _t(self._F) @ self._F)
        return dE

    def _push_forward(self, Q):
        """Transpose of `_strain_change`."""
        if self._linear:
            return Q
        P = self._F @ Q
        if self._isochoric:
            return self._volumetric() * (P - _dot(self._F, P) / 3 * _t(self._inverse))
        return P

    def _turn(self, T):
        """Derivative of the return mapping by the trial strain, times T; symmetric."""
        along = (self._trial * T).sum((-2, -1), keepdims=True) / self._size**2 * self._trial
        return self._return_factor * (T - np.where(self._sliding, along, 0.0))

    def _derivative(self, change):
        return self._skin.data.memory.point_slopes(self._skin.data.x, change)[1]

    def _of_nodes(self, stress):
        """(nvert, 3) sum over points (n, 3, 3) at their nodes."""
        out = np.zeros((self._skin.model.nvert, 3))
        parts = np.einsum("eqij,eqaj->eai", stress.reshape(*self._shape, 3, 3), self._gradient)
        np.add.at(out, self._elem, parts)
        return out

    # --- backwards ---

    def _stress_cotangents(self, after):
        """Cotangents of the second Piola-Kirchhoff stress, of the first, and of eta, from those of the
        memory."""
        sigma = _symmetric(after.last + np.tensordot(self._step_weight, after.overstress, 1))
        tau = sigma if self._linear else _t(self._inverse) @ sigma
        return sigma, tau, _dot(tau, self._P)[:, 0, 0]

    def pull_deformation(self, after: Memory) -> np.ndarray:
        """(n, 3, 3) cotangents of the deformation gradients from those of the new memory."""
        sigma, tau, eta = self._stress_cotangents(after)
        out = self._eta[:, None, None] * self._derivative(tau)
        if not self._linear:
            out -= _t(self._inverse) @ sigma @ self._S
        energy = self._modulus * (eta * self._by_energy + np.where(self._loads, after.worst, 0.0))
        out += energy[:, None, None] * self._P
        if len(after.slip):
            out += self._push_forward(_deviator(after.slip - self._turn(after.slip)).sum(0))
        return out

    def pull_nodes(self, deformation: np.ndarray) -> np.ndarray:
        """(nvert, 3) cotangents of the nodes from those of deformation gradients (n, 3, 3)."""
        return self._of_nodes(deformation)

    def pull_rest(self, deformation: np.ndarray) -> np.ndarray:
        """(nvert, 3) cotangents of rest positions from those of deformation gradients (n, 3, 3), see
        `rest`."""
        return self._of_nodes(-_t(self._F) @ deformation)

    def pull(self, after: Memory, balance: np.ndarray) -> tuple[Memory, np.ndarray, dict]:
        """Cotangents of the old memory, of the memory's constants (c,), and, by name, of mu and lam (those
        that `LinearStep` lacks), from those of the new memory and from the balance."""
        _, tau, eta = self._stress_cotangents(after)
        force = -self._volume[:, None, None] * self._gradient_of(balance)
        stiff, before = 1 + self._gain, self.before
        past = _symmetric(force if self._linear else _t(self._F) @ force)
        over = self._decay[:, None, None, None] * (after.overstress + past)
        last = -np.tensordot(self._step_weight, after.overstress, 1) - self._gain * past
        eta = eta + stiff * _dot(force, self._P)[:, 0, 0]
        worst = eta * self._by_worst + np.where(self._loads, 0.0, after.worst)
        strain = _deviator(self._strain_change(force))
        work = self._turn(strain)
        slip = after.slip - _deviator(after.slip - self._turn(after.slip))
        slip = slip - 2 * self._strength * self._mu * _deviator(work)
        gain = (force * self._eta[:, None, None] * self._P).sum() - (past * before.last).sum()
        step_weight = gain + (after.overstress * (self._S - before.last)).sum((1, 2, 3))
        decay = ((after.overstress + past) * before.overstress).sum((1, 2, 3))
        by_time = step_weight * self._step_weight_by_time + decay * self._decay_by_time
        prony = np.stack([step_weight * self._step_weight_by_strength, by_time], 1)
        shear = 2 * self._mu * (self._return_factor * self._trial * strain).sum((1, 2, 3))
        most = 2 * self._strength * self._mu * strain - after.slip
        most = np.where(self._sliding, self._trial / self._size * most, 0.0).sum((1, 2, 3))
        branch = np.stack([shear, 1.5**0.5 * most], 1)
        constants = np.concatenate([prony.ravel(), self._by_mullins @ eta, branch.ravel()])
        moduli = {}
        soft = (self._eta - 1)[:, None, None]
        weight = stiff * soft * force + self._eta[:, None, None] * tau
        energy = eta * self._by_energy + np.where(self._loads, after.worst, 0.0)
        for name, (P, W) in self._by.items():
            moduli[name] = float((weight * P).sum() + energy @ W)
        return Memory(over, last, worst, slip), constants, moduli

    # --- forwards ---

    def push_force(self, before: Memory, constants: np.ndarray, moduli: dict) -> np.ndarray:
        """(nvert, 3) change of the rubber's forces at fixed nodes, without the terms of `LinearStep`."""
        prony, mullins, branch = split_constants(self._skin.model.material, constants)
        step_weight, decay = self._changes(prony)
        eta = self._eta_change(before, mullins, moduli)[:, None, None]
        P = sum(moduli[name] * self._by[name][0] for name in self._by)
        gain, known = step_weight.sum(), self.before
        past = -gain * known.last - self._gain * before.last
        past = (
            past + np.tensordot(decay, known.overstress, 1) + np.tensordot(self._decay, before.overstress, 1)
        )
        change = gain * self._eta[:, None, None] * self._P
        change = change + (1 + self._gain) * ((self._eta[:, None, None] - 1) * P + eta * self._P)
        change = change + (past if self._linear else self._F @ past)
        if len(branch):
            returned, most = self._branch_change(before, branch)
            Q = (
                2
                * self._mu
                * (
                    branch.T[0][:, None, None, None] * self._return_factor * self._trial
                    + self._strength * (returned + most)
                )
            )
            change = change + self._push_forward(Q.sum(0))
        return self._of_nodes(-self._volume[:, None, None] * change)

    def push(
        self,
        before: Memory,
        constants: np.ndarray,
        moduli: dict,
        x: np.ndarray,
        vert: np.ndarray | None = None,
    ) -> Memory:
        """Tangents of the new memory; x (nvert, 3): of the nodes, vert: of rest positions."""
        prony, mullins, branch = split_constants(self._skin.model.material, constants)
        F = self._gradient_of(x)
        if vert is not None:
            F = F - self._F @ self._gradient_of(vert)
        W = _dot(self._P, F)[:, 0, 0]
        energy = self._modulus * W + sum(moduli[name] * self._by[name][1] for name in self._by)
        eta = self._eta_change(before, mullins, moduli) + self._by_energy * self._modulus * W
        P = self._derivative(F) + sum(moduli[name] * self._by[name][0] for name in self._by)
        T = self._eta[:, None, None] * P + eta[:, None, None] * self._P
        S = T if self._linear else _symmetric(self._inverse @ (T - F @ self._S))
        terms = *self._changes(prony), self._step_weight, self._decay
        by_step_weight, by_decay, step_weight, decay = (c[:, None, None, None] for c in terms)
        over = by_decay * self.before.overstress + decay * before.overstress
        over = over + by_step_weight * (self._S - self.before.last) + step_weight * (S - before.last)
        slip = before.slip
        if len(branch):
            returned, most = self._branch_change(before, branch)
            trial = _deviator(self._strain_change(F))
            slip = slip + (trial - _deviator(before.slip)) - returned - self._turn(trial) - most
        return Memory(over, S, np.where(self._loads, energy, before.worst), slip)

    def _changes(self, prony):
        g, tau = prony.T
        return self._step_weight_by_strength * g + self._step_weight_by_time * tau, self._decay_by_time * tau

    def _eta_change(self, before, mullins, moduli):
        W = sum(moduli[name] * self._by[name][1] for name in self._by)
        return self._by_worst * before.worst + mullins @ self._by_mullins + self._by_energy * W

    def _branch_change(self, before, branch):
        """Tangents of the returned trial strains at fixed strains, by slips and by the largest energy."""
        most = 1.5**0.5 * branch.T[1][:, None, None, None] / self._size * self._trial
        return -self._turn(_deviator(before.slip)), np.where(self._sliding, most, 0.0)


def _t(A):
    return np.swapaxes(A, -2, -1)


def _symmetric(A):
    return 0.5 * (A + _t(A))


def _deviator(A):
    return A - np.trace(A, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)


def _dot(A, B):
    """(n, 1, 1) double contraction."""
    return (A * B).sum((-2, -1), keepdims=True)
