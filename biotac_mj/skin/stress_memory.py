"""What a material has beyond its law, at every integration point of any element: relaxation, Mullins
softening, friction, stiffening.

Relaxation is finite linear viscoelasticity (Simo 1987; Holzapfel 2000, ch. 6): every term of the series adds
  an overstress Q_i to the
second Piola-Kirchhoff stress S of the elastic law, which stays the long-term one,

    dQ_i/dt + Q_i / tau_i = g_i dS/dt,    so that   G(t) = G_inf (1 + sum_i g_i exp(-t / tau_i))

and S, taken as linear in time within a step, gives Q_i exactly from its last value. Softening is the
pseudo-elasticity of Ogden and
Roxburgh (1999): S is multiplied by  eta = 1 - erf((W_max - W) / (m + beta W_max)) / r,  W_max the largest
  energy density so far.

Both act on what has to do with shape. For neo_hookean that is the isochoric part; the other laws have no such
split and the whole stress remembers, but for the dilatation that quadratic elements keep for an element's
mean (lam beyond 5 mu). Second Piola stresses turn with the body, so that nothing here depends on rotations
(but for the `linear` law, which never does).

Within a step the past is a constant H, S = (1 + c) eta S_elastic + H with c = sum_i g_i h_i: the elastic law
again, stiffer, with an initial stress. Hence the tangent is symmetric and exact (algorithmic).

Stiffening (`stiffening.py`) belongs to the elastic law, so it relaxes and softens too; friction
(`hysteresis.py`) stands beside both."""

import numpy as np
import warp as wp

from . import quadratic
from .hysteresis import FrictionBranches
from .material import energy_density, polar_rotation, stress, stress_derivative
from .points import IntegrationPoints
from .stiffening import added_derivative, added_energy, added_stress
from .types import mat33, real, vec3

__all__ = ["StressMemory"]

wp.set_module_options({"enable_backward": False})

_ROW, _COLUMN, _WHOLE = (
    [0, 0, 0, 1, 1, 2],
    [0, 1, 2, 1, 2, 2],
    [0, 1, 2, 1, 3, 4, 2, 4, 5],
)  # six numbers of a symmetric 3 x 3, and back


@wp.func
def remembering(law: int, mu: real, lam: real, cap: real):
    """Second constant of the part of the law that remembers."""
    if law == 2:
        return real(0.0)
    return wp.min(lam, cap * mu)


@wp.func
def pull_back(law: int, F: mat33, P: mat33):
    """Second Piola stress of the first."""
    if law == 3:
        return P
    S = wp.inverse(F) * P
    return real(0.5) * (S + wp.transpose(S))


@wp.kernel
def evaluate(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    cap: real,
    stiffening: real,
    mullins: vec3,
    gain: real,
    modulus: wp.array(dtype=real),
    worst: wp.array2d(dtype=real),
    past: wp.array2d(dtype=mat33),
    gradient: wp.array2d(dtype=mat33),
    # Out:
    rotation_out: wp.array2d(dtype=mat33),
    softening_out: wp.array2d(dtype=real),
    slope_out: wp.array2d(dtype=real),
    stress_out: wp.array2d(dtype=mat33),
):
    """First Piola stress that is added to that of the law; eta and d eta / dW."""
    i, w = wp.tid()
    F = gradient[i, w]
    R = mat33()
    if law == 0:
        R = polar_rotation(F)
        rotation_out[i, w] = R
    part = remembering(law, mu[w], lam[w], cap)
    eta = real(1.0)
    slope = real(0.0)
    if mullins[0] > real(0.0):
        W = energy_density(law, mu[w], part, F, R)
        if stiffening != real(0.0):
            W += added_energy(law, mu[w], stiffening, F, R)
        W *= modulus[i]
        if W < worst[i, w]:
            width = mullins[1] + mullins[2] * worst[i, w]
            s = (worst[i, w] - W) / width
            eta = real(1.0) - wp.erf(s) / mullins[0]
            slope = (
                modulus[i] * real(1.1283791670955126) * wp.exp(-s * s) / (mullins[0] * width)
            )  # 2 / sqrt(pi)
    softening_out[i, w] = eta
    slope_out[i, w] = slope
    H = past[i, w]
    if law != 3:
        H = F * H
    factor = (real(1.0) + gain) * eta
    P = (factor - real(1.0)) * stress(law, mu[w], part, F, R) + H
    if stiffening != real(0.0):
        P += factor * added_stress(law, mu[w], stiffening, F, R)
    stress_out[i, w] = P


@wp.kernel
def differentiate(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    cap: real,
    stiffening: real,
    gain: real,
    past: wp.array2d(dtype=mat33),
    gradient: wp.array2d(dtype=mat33),
    rotation: wp.array2d(dtype=mat33),
    softening: wp.array2d(dtype=real),
    slope: wp.array2d(dtype=real),
    change: wp.array2d(dtype=mat33),
    # Out:
    stress_out: wp.array2d(dtype=mat33),
):
    """Derivative of `evaluate` along a change of the deformation gradient."""
    i, w = wp.tid()
    F = gradient[i, w]
    dF = change[i, w]
    R = mat33()
    if law == 0:
        R = rotation[i, w]
    part = remembering(law, mu[w], lam[w], cap)
    factor = real(1.0) + gain
    dP = (factor * softening[i, w] - real(1.0)) * stress_derivative(law, mu[w], part, F, R, dF)
    if stiffening != real(0.0):
        dP += factor * softening[i, w] * added_derivative(law, mu[w], stiffening, F, R, dF)
    if slope[i, w] != real(0.0):
        P = stress(law, mu[w], part, F, R)
        if stiffening != real(0.0):
            P += added_stress(law, mu[w], stiffening, F, R)
        dP += (factor * slope[i, w] * wp.ddot(P, dF)) * P
    if law != 3:
        dP += dF * past[i, w]
    stress_out[i, w] = dP


@wp.kernel
def settle(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    cap: real,
    stiffening: real,
    modulus: wp.array(dtype=real),
    gradient: wp.array2d(dtype=mat33),
    # Out:
    stress_out: wp.array2d(dtype=mat33),
    energy_out: wp.array2d(dtype=real),
):
    """Second Piola stress and energy density of the part of the elastic law that remembers."""
    i, w = wp.tid()
    F = gradient[i, w]
    R = mat33()
    if law == 0:
        R = polar_rotation(F)
    part = remembering(law, mu[w], lam[w], cap)
    P = stress(law, mu[w], part, F, R)
    W = energy_density(law, mu[w], part, F, R)
    if stiffening != real(0.0):
        P += added_stress(law, mu[w], stiffening, F, R)
        W += added_energy(law, mu[w], stiffening, F, R)
    stress_out[i, w] = pull_back(law, F, P)
    energy_out[i, w] = modulus[i] * W


class StressMemory:
    """What the points of a skin remember, of every world: overstresses, the largest energy so far, the slip
    of friction elements.

    Made by `SkinData` where the model's material has `prony`, `mullins`, `hysteresis` or `stiffening`; on the
    CPU's full tier.

    Args:
      model: SkinModel; nworld: number of worlds; mu, lam: (nworld,) Warp arrays of the elastic constants
        [Pa].

    Attributes:
      overstress: (nterm, npoint, nworld, 3, 3) second Piola [Pa]; worst: (npoint, nworld) largest energy
        density [J/m^3].
      last: (npoint, nworld, 3, 3) second Piola stress that relaxes, when the last step ended [Pa].
      friction: FrictionBranches, or None.
      stiffness: factor on the stiffness of a step as long as the current one, without its history.

    Raises:
      ValueError: the model is not on the CPU.
    """

    def __init__(self, model, nworld, mu, lam):
        if model.device.is_cuda:
            raise ValueError(
                f"skin with {' and '.join(model.material.extensions)} is solved on the CPU's full tier "
                "only: choose device='cpu', "
                "or leave this out of the material"
            )
        material = model.material
        self.points = points = IntegrationPoints(model.elasticity, nworld)
        self.prony = np.array(material.prony, float).reshape(-1, 2)
        self.mullins = vec3(*(material.mullins or (0.0, 0.0, 0.0)))
        cap = float(quadratic.POINTWISE) if points.quadratic else 1e300
        self._law = [model.law, mu, lam, cap]
        self.stiffening = material.stiffening
        self.gain = 0.0
        self.gradient, self.change, self.rotation, self.past, self.stress = (
            points.allocate(mat33) for _ in range(5)
        )
        self._worst, self.softening, self.slope, self.energy = (points.allocate(real) for _ in range(4))
        self.worst = self._worst.numpy()
        self.overstress = np.zeros((len(self.prony), *points.shape, 3, 3))
        self.last = np.zeros((*points.shape, 3, 3))
        self.friction = (
            FrictionBranches(material.hysteresis, model.law, mu, points) if material.hysteresis else None
        )
        self._remembers = material.remembers

    @property
    def stiffness(self) -> float:
        return 1 + self.gain + (self.friction.modulus if self.friction else 0.0)

    def reset(self, x):
        """Forgets: x (Warp, [nvert, nworld]) is the relaxed and virgin state."""
        self.overstress[:] = 0
        self.worst[:] = 0
        self.last = self._settle(x)
        self.worst[:] = self.energy.numpy() if self.mullins[0] > 0 else 0
        if self.friction:
            self.friction.reset(self.gradient)

    def begin(self, dt):
        """Prepares a step of length dt [s].

        Raises:
          ValueError: relaxation without a positive dt.
        """
        if not len(self.prony):
            return
        if dt is None or not (np.isfinite(dt) and dt > 0):
            raise ValueError("skin with a Prony series relaxes in time: pass the time step, dt > 0")
        g, tau = self.prony.T
        self.decay = np.exp(-dt / tau)
        self.share = -g * np.expm1(-dt / tau) * tau / dt
        self.gain = float(self.share.sum())
        self.past.numpy()[:] = np.tensordot(self.decay, self.overstress, 1) - self.gain * self.last

    def add_force(self, x, force):
        """Adds the nodal forces of what the law does not have [N], of the positions x."""
        self._evaluate(x)
        self.points.add_forces(self.stress, -1.0, force)

    def _evaluate(self, x):
        points = self.points
        points.gradient(x, self.gradient)
        points.launch(
            evaluate,
            [
                *self._law,
                self.stiffening,
                self.mullins,
                self.gain,
                points.modulus,
                self._worst,
                self.past,
                self.gradient,
            ],
            [self.rotation, self.softening, self.slope, self.stress],
        )
        if self.friction:
            self.friction.add_stress(self.gradient, self.stress)

    def add_product(self, p, product):
        """Adds their tangent stiffness, where `add_force` was last, times p."""
        points = self.points
        points.gradient(p, self.change)
        points.launch(
            differentiate,
            [
                *self._law,
                self.stiffening,
                self.gain,
                self.past,
                self.gradient,
                self.rotation,
                self.softening,
                self.slope,
                self.change,
            ],
            [self.stress],
        )
        if self.friction:
            self.friction.add_derivative(self.gradient, self.change, self.stress)
        points.add_forces(self.stress, 1.0, product)

    def commit(self, x, good):
        """Takes over the step that has ended at x in the worlds that are good (nworld,); the others keep
        their past."""
        if not self._remembers:
            return
        new = self._settle(x)
        if len(self.prony):
            gained = self.share[:, None, None, None, None] * (new - self.last)
            self.overstress[:, :, good] = (self.decay[:, None, None, None, None] * self.overstress + gained)[
                :, :, good
            ]
        self.last[:, good] = new[:, good]
        if self.mullins[0] > 0:
            self.worst[:, good] = np.maximum(self.worst, self.energy.numpy())[:, good]
        if self.friction:
            self.friction.commit(self.gradient, good)

    def add_cauchy(self, x, cauchy, mises):
        """Adds what the law does not have, at x where the last step ended, to the elements' mean Cauchy
        stresses [nelem, nworld] mat33 and renews their von Mises stresses [nelem, nworld] [Pa]."""
        nworld = x.shape[1]
        self.past.numpy()[:] = self.overstress.sum(0)
        gain, self.gain = self.gain, 0.0
        self._evaluate(x)
        self.gain = gain
        F, P = self.gradient.numpy(), self.stress.numpy()
        at_points = np.einsum("pwik,pwjk->pwij", P, F) / np.linalg.det(F)[..., None, None]
        share = (self.points.share * self.points.modulus.numpy()).reshape(cauchy.shape[0], -1, 1, 1, 1)
        total = cauchy.numpy()
        total += (share * at_points.reshape(*share.shape[:2], nworld, 3, 3)).sum(1)
        deviator = total - np.trace(total, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)
        mises.numpy()[:] = np.sqrt(1.5 * (deviator**2).sum((-1, -2)))

    @staticmethod
    def size(material, npoint) -> int:
        """Doubles of one world's memory."""
        return (6 * len(material.prony) + 6 * len(material.hysteresis) + 1) * npoint

    def state(self) -> np.ndarray:
        """(size,) memory of the first world, to be saved."""
        parts = [self.overstress, self.friction.slip] if self.friction else [self.overstress]
        return np.concatenate([*(p[:, :, 0][..., _ROW, _COLUMN].ravel() for p in parts), self.worst[:, 0]])

    def load(self, state, x):
        """Sets the first world's memory, of a skin that is at x (Warp, [nvert, nworld]); the inverse of
        `state`."""
        n = len(self.worst)
        parts = np.asarray(state[:-n]).reshape(-1, n, 6)[..., _WHOLE].reshape(-1, n, 3, 3)
        self.overstress[:, :, 0] = parts[: len(self.prony)]
        if self.friction:
            self.friction.slip[:, :, 0] = parts[len(self.prony) :]
        self.worst[:, 0] = state[-n:]
        self.last[:, 0] = self._settle(x)[:, 0]

    def _settle(self, x):
        """(npoint, nworld, 3, 3) second Piola stress at x that relaxes, softened by what was borne up to
        now."""
        self.points.gradient(x, self.gradient)
        self.points.launch(
            settle,
            [*self._law, self.stiffening, self.points.modulus, self.gradient],
            [self.stress, self.energy],
        )
        out = self.stress.numpy().copy()
        if self.mullins[0] > 0:
            from scipy.special import erf

            r, m, beta = (float(v) for v in self.mullins)
            worst = np.maximum(self.worst, self.energy.numpy())
            out *= (1 - erf((worst - self.energy.numpy()) / (m + beta * worst)) / r)[..., None, None]
        return out
