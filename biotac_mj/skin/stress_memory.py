"""Skin that remembers: stress relaxation by a Prony series and Mullins softening, inside the elements, on top of any law and element.

Relaxation is finite linear viscoelasticity (Simo 1987; Holzapfel 2000, ch. 6): every term of the series adds an overstress Q_i to the
second Piola-Kirchhoff stress S of the elastic law, which stays the long-term one,

    dQ_i/dt + Q_i / tau_i = g_i dS/dt,    so that   G(t) = G_inf (1 + sum_i g_i exp(-t / tau_i))

and S, taken as linear in time within a step, gives Q_i exactly from its last value. Softening is the pseudo-elasticity of Ogden and
Roxburgh (1999): S is multiplied by  eta = 1 - erf((W_max - W) / (m + beta W_max)) / r,  W_max the largest energy density so far.

Both act on what has to do with shape. For neo_hookean that is the isochoric part; the other laws have no such split and the whole stress
remembers, but for the dilatation that quadratic elements keep for an element's mean (lam beyond 5 mu). Second Piola stresses turn with
the body, so that nothing here depends on rotations (but for the `linear` law, which never does).

Within a step the past is a constant H, S = (1 + c) eta S_elastic + H with c = sum_i g_i h_i: the elastic law again, stiffer, with an
initial stress. Hence the tangent is symmetric and exact (algorithmic).
"""

import numpy as np
import warp as wp

from . import elasticity, quadratic
from .material import energy_density, polar_rotation, stress, stress_derivative
from .types import mat33, real, vec3

__all__ = ["StressMemory"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def linear_gradient(
    # In:
    elem: wp.array(dtype=wp.vec4i),
    inverse_edges: wp.array(dtype=mat33),
    x: wp.array2d(dtype=vec3),
    # Out:
    gradient_out: wp.array2d(dtype=mat33),
):
    e, w = wp.tid()
    gradient_out[e, w] = elasticity.edge_matrix(x, elem[e], w) * inverse_edges[e]


@wp.kernel
def quadratic_gradient(
    # In:
    elem: wp.array2d(dtype=int),
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    x: wp.array2d(dtype=vec3),
    # Out:
    gradient_out: wp.array2d(dtype=mat33),
):
    e, w = wp.tid()
    X = quadratic.nodes(x, elem, e, w)
    for q in range(4):
        gradient_out[4 * e + q, w] = X * shape[q] * inverse[e, q]


@wp.kernel
def linear_divergence(
    # In:
    inverse_edges: wp.array(dtype=mat33),
    volume: wp.array(dtype=real),
    stress: wp.array2d(dtype=mat33),
    sign: real,
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    """Nodal forces of first Piola stresses, times sign."""
    e, w = wp.tid()
    elasticity.write_corners(sign * volume[e] * stress[e, w] * wp.transpose(inverse_edges[e]), e, w, corner_out)


@wp.kernel
def quadratic_divergence(
    # In:
    shape: wp.array(dtype=wp.types.matrix(shape=(10, 3), dtype=wp.float64)),
    inverse: wp.array2d(dtype=mat33),
    weight: wp.array2d(dtype=real),
    stress: wp.array2d(dtype=mat33),
    sign: real,
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    e, w = wp.tid()
    C = quadratic.mat310()
    for q in range(4):
        C += (sign * weight[e, q] * stress[4 * e + q, w] * wp.transpose(inverse[e, q])) * wp.transpose(shape[q])
    quadratic.scatter(C, e, w, corner_out)


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
    mullins: vec3,
    gain: real,
    worst: wp.array2d(dtype=real),
    past: wp.array2d(dtype=mat33),
    gradient: wp.array2d(dtype=mat33),
    # Out:
    rotation_out: wp.array2d(dtype=mat33),
    softening_out: wp.array2d(dtype=real),
    slope_out: wp.array2d(dtype=real),
    stress_out: wp.array2d(dtype=mat33),
):
    """First Piola stress that memory adds to that of the elastic law; eta and d eta / dW."""
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
        if W < worst[i, w]:
            width = mullins[1] + mullins[2] * worst[i, w]
            s = (worst[i, w] - W) / width
            eta = real(1.0) - wp.erf(s) / mullins[0]
            slope = real(1.1283791670955126) * wp.exp(-s * s) / (mullins[0] * width)  # 2 / sqrt(pi)
    softening_out[i, w] = eta
    slope_out[i, w] = slope
    H = past[i, w]
    if law != 3:
        H = F * H
    stress_out[i, w] = ((real(1.0) + gain) * eta - real(1.0)) * stress(law, mu[w], part, F, R) + H


@wp.kernel
def differentiate(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    lam: wp.array(dtype=real),
    cap: real,
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
    if slope[i, w] != real(0.0):
        P = stress(law, mu[w], part, F, R)
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
    stress_out[i, w] = pull_back(law, F, stress(law, mu[w], part, F, R))
    energy_out[i, w] = energy_density(law, mu[w], part, F, R)


class StressMemory:
    """What the points of a skin remember, of every world: overstresses and the largest energy so far.

    Made by `SkinData` where the model's material has `prony` or `mullins`; on the CPU's full tier.

    Args:
      model: SkinModel; nworld: number of worlds; mu, lam: (nworld,) Warp arrays of the elastic constants [Pa].

    Attributes:
      overstress: (nterm, npoint, nworld, 3, 3) second Piola [Pa]; worst: (npoint, nworld) largest energy density [J/m^3].
      last: (npoint, nworld, 3, 3) second Piola stress that relaxes, when the last step ended [Pa].
      stiffening: factor on the stiffness of a step as long as the current one, without its history.

    Raises:
      ValueError: the model is not on the CPU.
    """

    def __init__(self, model, nworld, mu, lam):
        if model.device.is_cuda:
            raise ValueError(
                "skin that remembers (prony, mullins) is solved on the CPU's full tier only: choose device='cpu', or leave both out of the material"  # noqa: E501
            )
        self.elements, self.law, self.mu, self.lam = model.elasticity, model.law, mu, lam
        self.prony = np.array(model.material.prony, float).reshape(-1, 2)
        self.mullins = vec3(*(model.material.mullins or (0.0, 0.0, 0.0)))
        self.quadratic = model.element == "quadratic"
        self.cap = float(quadratic.POINTWISE) if self.quadratic else 1e300
        npoint, ncorner = (4, 10) if self.quadratic else (1, 4)
        shape = (npoint * model.nelem, nworld)
        self.gain, self.stiffening = 0.0, 1.0
        with wp.ScopedDevice("cpu"):
            self.gradient, self.change, self.rotation, self.past, self.stress = (wp.zeros(shape, dtype=mat33) for _ in range(5))
            self._worst, self.softening, self.slope, self.energy = (wp.zeros(shape, dtype=real) for _ in range(4))
            self.corner = wp.zeros((ncorner * model.nelem, nworld), dtype=vec3)
        self.worst = self._worst.numpy()
        self.overstress = np.zeros((len(self.prony), *shape, 3, 3))
        self.last = np.zeros((*shape, 3, 3))

    def reset(self, x):
        """Forgets: x (Warp, [nvert, nworld]) is the relaxed and virgin state."""
        self.overstress[:] = 0
        self.worst[:] = 0
        self.last = self._settle(x)
        self.worst[:] = self.energy.numpy() if self.mullins[0] > 0 else 0

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
        self.stiffening = 1 + self.gain
        self.past.numpy()[:] = np.tensordot(self.decay, self.overstress, 1) - self.gain * self.last

    def add_force(self, x, force):
        """Adds the nodal forces of what is remembered [N], of the positions x."""
        self._gradient(x, self.gradient)
        self._launch(evaluate, self.gradient.shape,
                     [self.law, self.mu, self.lam, self.cap, self.mullins, self.gain, self._worst, self.past, self.gradient],
                     [self.rotation, self.softening, self.slope, self.stress])  # fmt: skip
        self._gather(-1.0, force)

    def add_product(self, p, product):
        """Adds their tangent stiffness, where `add_force` was last, times p."""
        self._gradient(p, self.change)
        self._launch(differentiate, self.gradient.shape,
                     [self.law, self.mu, self.lam, self.cap, self.gain, self.past, self.gradient, self.rotation, self.softening, self.slope,
                      self.change], [self.stress])  # fmt: skip
        self._gather(1.0, product)

    def commit(self, x, good):
        """Takes over the step that has ended at x in the worlds that are good (nworld,); the others keep their past."""
        new = self._settle(x)
        if len(self.prony):
            gained = self.share[:, None, None, None, None] * (new - self.last)
            self.overstress[:, :, good] = (self.decay[:, None, None, None, None] * self.overstress + gained)[:, :, good]
        self.last[:, good] = new[:, good]
        if self.mullins[0] > 0:
            self.worst[:, good] = np.maximum(self.worst, self.energy.numpy())[:, good]

    @staticmethod
    def size(material, npoint) -> int:
        """Doubles of one world's memory."""
        return (6 * len(material.prony) + 1) * npoint

    def state(self) -> np.ndarray:
        """(size,) memory of the first world, to be saved."""
        six = self.overstress[:, :, 0][..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        return np.concatenate([six.ravel(), self.worst[:, 0]])

    def load(self, state, x):
        """Sets the first world's memory, of a skin that is at x (Warp, [nvert, nworld]); the inverse of `state`."""
        n = len(self.worst)
        six = np.asarray(state[:-n]).reshape(len(self.prony), n, 6)
        self.overstress[:, :, 0] = six[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(len(self.prony), n, 3, 3)
        self.worst[:, 0] = state[-n:]
        self.last[:, 0] = self._settle(x)[:, 0]

    def _settle(self, x):
        """(npoint, nworld, 3, 3) second Piola stress at x that relaxes, softened by what was borne up to now."""
        self._gradient(x, self.gradient)
        self._launch(settle, self.gradient.shape, [self.law, self.mu, self.lam, self.cap, self.gradient], [self.stress, self.energy])
        out = self.stress.numpy().copy()
        if self.mullins[0] > 0:
            from scipy.special import erf

            r, m, beta = (float(v) for v in self.mullins)
            worst = np.maximum(self.worst, self.energy.numpy())
            out *= (1 - erf((worst - self.energy.numpy()) / (m + beta * worst)) / r)[..., None, None]
        return out

    def _gradient(self, x, out):
        e = self.elements
        if self.quadratic:
            self._launch(quadratic_gradient, (e.nelem, x.shape[1]), [e.elem, e.shape, e.inverse, x], [out])
        else:
            self._launch(linear_gradient, (e.nelem, x.shape[1]), [e.elem, e.inverse_edges, x], [out])

    def _gather(self, sign, node_out):
        e = self.elements
        if self.quadratic:
            self._launch(
                quadratic_divergence, (e.nelem, node_out.shape[1]), [e.shape, e.inverse, e.weight, self.stress, sign], [self.corner]
            )
        else:
            self._launch(linear_divergence, (e.nelem, node_out.shape[1]), [e.inverse_edges, e.volume, self.stress, sign], [self.corner])
        self._launch(elasticity.gather, node_out.shape, [e.start, e.slot, self.corner, 1.0, 1], [node_out])

    @staticmethod
    def _launch(kernel, dim, inputs, outputs):
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device="cpu")
