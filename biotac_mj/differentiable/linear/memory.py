"""Linearised memory of the rubber at the end of a step: stress from the history, and the new history.

`skin.rubber.points` has the equations. The implicit function theorem takes the history as an input, like the
step, so memory enters like the anchors of friction. With F the deformation gradient of a point, the new
memory and the stress are functions of F, the old memory and the material's constants. They are written once,
on tensors, and PyTorch differentiates them in both modes; the law's stress and its derivative are the
elements' own. Slipping friction elements, and softening that begins or ends, are kinks; derivatives are those
of the side where the step ended."""

import dataclasses

import numpy as np
import torch
from torch.autograd import forward_ad

from ...skin.rubber.law import LAWS
from ...skin.rubber.material import Material
from ..memory_constants import split_constants
from ..record import Record
from ..skin import SkinWorlds

_KINK = 1e-9  # relative distance from slip of friction elements, or from the largest energy, taken as a kink
_SHORT = 1e-4  # step over relaxation time below which a Prony weight is a series, see `memory.prony_weight`


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

    def tensors(self) -> list[torch.Tensor]:
        """The arrays as tensors that share their memory."""
        return [torch.from_numpy(getattr(self, field.name)) for field in dataclasses.fields(self)]


class LinearMemory:
    """The points of a skin in the state at the end of a step (`record.restore`).

    Args:
      skin: of one world, with memory.
      record: of the step.

    Attributes:
      before: memory at the start of the step; points on a kink are moved to one of its sides.
      energy: (n,) energy densities [J/m^3]. loads: (n,) whether they exceed the largest so far.
      slips: (nbranch, n) whether a friction element slips.
    """

    def __init__(self, skin: SkinWorlds, record: Record):
        elements, rubber, material = skin.model.elements, skin.data.rubber, skin.model.material
        self._skin, self._elem, self._gradient = skin, elements.elem, elements.gradient
        self._small_strain, self._isochoric = (rubber.law == LAWS[name] for name in ("linear", "neo_hookean"))
        self._shape, self._dt = elements.weight.shape, record.dt
        n = elements.weight.size
        modulus = np.ones(len(self._elem)) if elements.modulus is None else elements.modulus
        modulus = np.repeat(modulus, self._shape[1])
        self._volume = modulus * elements.weight.ravel()
        F = self._gradient_of(record.x[:, 0].numpy())
        overstress, last, slip = (
            getattr(rubber, name).numpy()[..., 0, :, :].reshape(-1, n, 3, 3)
            for name in ("overstress", "last", "slip")
        )
        last = last[0] if len(last) else np.zeros((n, 3, 3))
        # state at the start of the step, which a further load increment continued
        worst = getattr(record.begun, "worst", np.zeros(n))
        self.before = Memory(overstress.copy(), last.copy(), worst, slip.copy())
        constants, moduli = record.constants, [float(record.numbers[name]) for name in ("mu", "lam")]
        self._law = self._law_here(modulus, *moduli)
        self.energy = self._law[1].numpy()
        self._choose_sides(F, *split_constants(material, constants)[1:])
        tensors = [torch.from_numpy(F), *self.before.tensors(), torch.from_numpy(constants)]
        self._inputs = [*tensors, *torch.tensor(moduli, dtype=torch.float64)]
        self._graph = None

    def _gradient_of(self, x):
        """(n, 3, 3) of displacements (nvert, 3) of the nodes."""
        return np.einsum("eai,eqaj->eqij", x[self._elem], self._gradient).reshape(-1, 3, 3)

    def _law_here(self, modulus, mu, lam):
        """Stress and energy density of the rubber with memory, and their derivatives. Both are homogeneous in
        mu and lam and linear in lam, so two evaluations are exact."""
        memory, x, none = self._skin.data.memory, self._skin.data.x, np.zeros((len(modulus), 3, 3))

        def derivative(change):
            return torch.from_numpy(memory.point_slopes(x, change.numpy())[1])

        with self._skin.another_lam() as other:
            there = memory.point_slopes(x, none)
        here = [torch.from_numpy(value) for value in memory.point_slopes(x, none)[::2]]
        lams = [(torch.from_numpy(b) - a) / (float(other) - lam) for a, b in zip(here, there[::2])]
        mus = [(a - lam * by) / mu for a, by in zip(here, lams)]
        return (*here, derivative, torch.from_numpy(modulus), mus, lams)

    def _choose_sides(self, F, mullins, branch):
        """Moves the old memory of points on a kink, which rubber at rest after slip or after its largest
        energy has up to rounding, also in the elements' tangent."""
        energy, before, rubber = self.energy, self.before, self._skin.data.rubber
        if len(mullins) and mullins[0] > 0:
            on_kink = np.abs(energy - before.worst) <= _KINK * before.worst
            before.worst[...] = np.where(on_kink, (1 - _KINK) * energy, before.worst)
        trial, most = self._trial(torch.from_numpy(F), torch.from_numpy(before.slip)).numpy(), _most(branch)
        size = np.sqrt((trial**2).sum((-2, -1)))
        on_kink = (np.abs(size - most) <= _KINK * most) & (most > 0)
        before.slip[on_kink] += 2 * _KINK * trial[on_kink]
        self.loads, self.slips = before.worst <= energy, (size > most) & ~on_kink | (most == 0)
        for array, value in ((rubber.slip, before.slip), (rubber.worst, before.worst)):
            if array.size:
                array.assign(value.reshape(array.shape + array.numpy().shape[len(array.shape) :]))

    # --- the equations of `skin.rubber.points` and `skin.rubber.friction` ---

    def _trial(self, F, slip):
        """(nbranch, n, 3, 3) deviators of the strains of the friction elements' springs before they slip."""
        if self._small_strain:
            strain = _symmetric(F)
        else:
            strain = 0.5 * F.mT @ F
            if self._isochoric:
                strain = _volume_ratio(F)[:, None, None] ** (-2 / 3) * strain
        strain = strain - slip
        mean = strain.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] / 3
        return strain - mean * torch.eye(3, dtype=strain.dtype)

    def _sticking(self, trial, branch):
        """Trial strains after the return mapping."""
        square = torch.where(torch.from_numpy(self.slips), (trial**2).sum((-2, -1)), 1.0)
        size = torch.where(square > 0, square, 1.0).sqrt()
        fraction = torch.where(torch.from_numpy(self.slips), _most(branch) / size, 1.0)
        return fraction[..., None, None] * trial

    def _push_forward(self, F, Q):
        """First Piola stress of the friction elements' Q."""
        if self._small_strain:
            return Q
        P = F @ Q
        if self._isochoric:
            third = (F * P).sum((1, 2))[:, None, None] / 3
            return _volume_ratio(F)[:, None, None] ** (-2 / 3) * (P - third * torch.linalg.inv(F).mT)
        return P

    def _softening(self, energy, worst, mullins):
        if not len(mullins) or mullins[0] <= 0:
            return torch.ones_like(energy)
        r, m, beta = mullins
        eta = 1 - torch.special.erf((worst - energy) / (m + beta * worst)) / r
        return torch.where(torch.from_numpy(self.loads), 1.0, eta)

    def _series(self, prony):
        """Decays and weights of the terms in this step, and the sum of the weights."""
        g, tau = prony.unbind(1)
        a = self._dt / tau
        weight = g * torch.where(a < _SHORT, 1 - a * (0.5 - a / 6), -torch.expm1(-a) / a)
        return torch.exp(-a), weight, weight.sum()

    def _after(self, F, overstress, last, worst, slip, constants, mu, lam):
        """The new memory."""
        prony, mullins, branch = split_constants(self._skin.model.material, constants)
        P, energy = _Law.apply(self._law, F, mu, lam)
        S = self._softening(energy, worst, mullins)[:, None, None] * P
        if not self._small_strain:
            S = _symmetric(torch.linalg.inv(F) @ S)
        decay, weight, _ = (value[..., None, None, None] for value in self._series(prony))
        trial = self._trial(F, slip)
        worst = torch.where(torch.from_numpy(self.loads), energy, worst)
        return (
            decay * overstress + weight * (S - last),
            S,
            worst,
            slip + trial - self._sticking(trial, branch),
        )

    def _stress(self, F, overstress, last, worst, slip, constants, mu, lam):
        """First Piola stress at fixed nodes. By mu and lam only what `SkinWorlds.rubber_slopes` lacks."""
        prony, mullins, branch = split_constants(self._skin.model.material, constants)
        P, energy = _Law.apply(self._law, F, mu, lam)
        decay, _, gain = self._series(prony)
        history = (decay[:, None, None, None] * overstress).sum(0) - gain * last
        eta = self._softening(energy, worst, mullins)[:, None, None]
        elastic = (1 + gain) * ((eta - 1) * P + self._law[0])
        strength = 2 * branch[:, 0, None, None, None] * self._inputs[-2]
        friction = (strength * self._sticking(self._trial(F, slip), branch)).sum(0)
        return (
            elastic
            + (history if self._small_strain else F @ history)
            + (self._push_forward(F, friction) if len(branch) else 0.0)
        )

    def pull_nodes(self, stress: np.ndarray) -> np.ndarray:
        """(nvert, 3) sum at the nodes over points (n, 3, 3): forces of stresses, or cotangents of the nodes
        from those of deformation gradients."""
        out = np.zeros((self._skin.model.nvert, 3))
        parts = np.einsum("eqij,eqaj->eai", stress.reshape(*self._shape, 3, 3), self._gradient)
        np.add.at(out, self._elem, parts)
        return out

    # --- backwards ---

    def _pull(self, kind, cotangents, names):
        """Cotangents of some inputs, by number, from those of the new memory (0) or of the stress (1)."""
        if self._graph is None:
            with torch.enable_grad():
                inputs = [value.clone().requires_grad_() for value in self._inputs]
                self._graph = inputs, self._after(*inputs), (self._stress(*inputs),)
        inputs = [self._graph[0][k] for k in names]
        kept = dict(retain_graph=True, allow_unused=True, materialize_grads=True)
        return torch.autograd.grad(self._graph[1 + kind], inputs, cotangents, **kept)

    def pull_deformation(self, after: Memory) -> np.ndarray:
        """(n, 3, 3) cotangents of the deformation gradients from those of the new memory."""
        return self._pull(0, after.tensors(), [0])[0].numpy()

    def pull_rest(self, deformation: np.ndarray) -> np.ndarray:
        """(nvert, 3) cotangents of rest positions from those of deformation gradients (n, 3, 3), see
        `rest`."""
        return self.pull_nodes(-np.swapaxes(self._inputs[0].numpy(), 1, 2) @ deformation)

    def pull(self, after: Memory, balance: np.ndarray) -> tuple[Memory, np.ndarray, dict]:
        """Cotangents of the old memory, of the memory's constants (c,), and, by name, of mu and lam (those
        that `LinearStep` lacks), from those of the new memory and from the equilibrium."""
        force = torch.from_numpy(-self._volume[:, None, None] * self._gradient_of(balance))
        parts = zip(self._pull(0, after.tensors(), range(1, 8)), self._pull(1, [force], range(1, 8)))
        *memory, constants, mu, lam = ((a + b).numpy() for a, b in parts)
        return Memory(*memory), constants, {"mu": float(mu), "lam": float(lam)}

    # --- forwards ---

    def _push(self, function, tangents):
        """Tangents of a function of the inputs."""
        with forward_ad.dual_level(), torch.no_grad():
            pairs = zip(self._inputs, tangents)
            out = function(*(a if t is None else forward_ad.make_dual(a, t) for a, t in pairs))
            pairs = [forward_ad.unpack_dual(one) for one in (out if isinstance(out, tuple) else (out,))]
            return [np.zeros(p.shape) if t is None else t.numpy() for p, t in pairs]

    @staticmethod
    def _tangents(F, before, constants, moduli):
        two = torch.tensor([moduli["mu"], moduli["lam"]], dtype=torch.float64)
        return [F, *before.tensors(), torch.from_numpy(constants), *two]

    def push_force(self, before: Memory, constants: np.ndarray, moduli: dict) -> np.ndarray:
        """(nvert, 3) change of the rubber's forces at fixed nodes, without the terms of `LinearStep`."""
        (change,) = self._push(self._stress, self._tangents(None, before, constants, moduli))
        return self.pull_nodes(-self._volume[:, None, None] * change)

    def push(
        self,
        before: Memory,
        constants: np.ndarray,
        moduli: dict,
        x: np.ndarray,
        vert: np.ndarray | None = None,
    ) -> Memory:
        """Tangents of the new memory; x (nvert, 3): of the nodes, vert: of rest positions."""
        F = self._gradient_of(x)
        if vert is not None:
            F = F - self._inputs[0].numpy() @ self._gradient_of(vert)
        return Memory(
            *self._push(self._after, self._tangents(torch.from_numpy(F), before, constants, moduli))
        )


class _Law(torch.autograd.Function):
    """Stress (n, 3, 3) [Pa] and energy density (n,) [J/m^3] of the rubber with memory at the end of a step,
    by the deformation gradients and the law's two constants."""

    @staticmethod
    def forward(law, F, mu, lam):
        return law[0].clone(), law[1].clone()

    @staticmethod
    def setup_context(context, inputs, output):
        context.law = inputs[0]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context, stress, energy):
        P, _, derivative, modulus, mus, lams = context.law
        F = derivative(stress) + (modulus * energy)[:, None, None] * P
        return None, F, *((stress * by[0]).sum() + energy @ by[1] for by in (mus, lams))

    @staticmethod
    def jvp(context, _, F, mu, lam):
        P, _, derivative, modulus, mus, lams = context.law
        stress = mu * mus[0] + lam * lams[0]
        energy = mu * mus[1] + lam * lams[1]
        if F is not None:
            stress, energy = stress + derivative(F), energy + modulus * (P * F).sum((1, 2))
        return stress, energy


def _most(branch):
    """(nbranch, 1) norms of strain at which friction elements slip."""
    return 1.5**0.5 * branch[:, 1, None]


def _volume_ratio(F):
    a, b, c = F.unbind(-1)
    return (a * torch.linalg.cross(b, c)).sum(-1)


def _symmetric(A):
    return 0.5 * (A + A.mT)
