"""Rubber with internal friction: loading and unloading differ at any speed, as Prandtl and Ishlinskii's
friction elements beside the law.

Every branch is a spring (shear modulus g mu) in series with a friction element that slips when the spring's
von Mises equivalent strain is `strain`. Within a step it has the potential

    min over E'  of   g mu |dev(A - E')|^2  +  2 g mu r |E' - E_p|,         r = sqrt(3/2) strain

of the strain A, with E_p the slip when the last step ended (Simo and Hughes 1998, ch. 1-3: radial return is
its minimum). So its stress Q = 2 g mu dev(A - E') has at most the size 2 g mu r, its tangent is symmetric and
exact, slip only dissipates, and nothing depends on time. A is the strain of Green and Lagrange, of
neo_hookean the isochoric one, (J^(-2/3) F^T F - I) / 2, of linear the small strain; Q is the second Piola
stress that belongs to it and turns with the body."""

import numpy as np
import warp as wp

from .types import mat33, real

__all__ = ["FrictionBranches"]

wp.set_module_options({"enable_backward": False})


@wp.func
def deviator(A: mat33):
    return A - wp.trace(A) / real(3.0) * wp.identity(n=3, dtype=real)


@wp.func
def symmetric(A: mat33):
    return real(0.5) * (A + wp.transpose(A))


@wp.func
def strain(law: int, F: mat33):
    """The strain A, whose deviator counts."""
    eye = wp.identity(n=3, dtype=real)
    if law == 3:
        return symmetric(F) - eye
    C = wp.transpose(F) * F
    if law == 2:
        C = wp.pow(wp.determinant(F), -real(2.0) / real(3.0)) * C
    return real(0.5) * (C - eye)


@wp.func
def strain_change(law: int, F: mat33, dF: mat33):
    """Directional derivative of `strain`."""
    if law == 3:
        return symmetric(dF)
    dE = symmetric(wp.transpose(F) * dF)
    if law == 2:
        third = wp.ddot(wp.transpose(wp.inverse(F)), dF) / real(3.0)
        return wp.pow(wp.determinant(F), -real(2.0) / real(3.0)) * (dE - third * wp.transpose(F) * F)
    return dE


@wp.func
def push_forward(law: int, F: mat33, Q: mat33):
    """First Piola stress P of Q: P : dF = Q : dA."""
    if law == 3:
        return Q
    P = F * Q
    if law == 2:
        third = wp.ddot(F, P) / real(3.0)  # Q : C
        return wp.pow(wp.determinant(F), -real(2.0) / real(3.0)) * (P - third * wp.transpose(wp.inverse(F)))
    return P


@wp.func
def push_forward_change(law: int, F: mat33, Q: mat33, dF: mat33, dQ: mat33):
    """Directional derivative of `push_forward`."""
    if law == 3:
        return dQ
    dP = dF * Q + F * dQ
    if law == 2:
        G = wp.transpose(wp.inverse(F))
        P = F * Q
        third = wp.ddot(F, P) / real(3.0)
        change = (wp.ddot(dF, P) + wp.ddot(F, dP)) / real(3.0)
        a = wp.pow(wp.determinant(F), -real(2.0) / real(3.0))
        da = -real(2.0) / real(3.0) * a * wp.ddot(G, dF)
        return a * (dP - change * G + third * G * wp.transpose(dF) * G) + da * (P - third * G)
    return dP


@wp.func
def held(T: mat33, most: real):
    """Share of a trial strain T that does not slip: radial return to the size `most`."""
    size = wp.sqrt(wp.ddot(T, T))
    if size > most:
        return most / size
    return real(1.0)


@wp.kernel
def add_stress(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    branch: wp.array(dtype=wp.vec2d),
    slip: wp.array3d(dtype=mat33),
    gradient: wp.array2d(dtype=mat33),
    # Out:
    stress_out: wp.array2d(dtype=mat33),
):
    """Adds the first Piola stress of all branches (g, r)."""
    i, w = wp.tid()
    F = gradient[i, w]
    A = strain(law, F)
    Q = mat33()
    for b in range(branch.shape[0]):
        T = deviator(A - slip[b, i, w])
        Q += (real(2.0) * branch[b][0] * mu[w] * held(T, branch[b][1])) * T
    stress_out[i, w] = stress_out[i, w] + push_forward(law, F, Q)


@wp.kernel
def add_derivative(
    # In:
    law: int,
    mu: wp.array(dtype=real),
    branch: wp.array(dtype=wp.vec2d),
    slip: wp.array3d(dtype=mat33),
    gradient: wp.array2d(dtype=mat33),
    change: wp.array2d(dtype=mat33),
    # Out:
    stress_out: wp.array2d(dtype=mat33),
):
    """Adds the derivative of `add_stress` along a change of the deformation gradient."""
    i, w = wp.tid()
    F = gradient[i, w]
    dF = change[i, w]
    A = strain(law, F)
    dA = deviator(strain_change(law, F, dF))
    Q = mat33()
    dQ = mat33()
    for b in range(branch.shape[0]):
        T = deviator(A - slip[b, i, w])
        modulus = real(2.0) * branch[b][0] * mu[w]
        share = held(T, branch[b][1])
        Q += (modulus * share) * T
        dQ += (modulus * share) * dA
        if share < real(1.0):
            dQ -= (modulus * share * wp.ddot(T, dA) / wp.ddot(T, T)) * T
    stress_out[i, w] = stress_out[i, w] + push_forward_change(law, F, Q, dF, dQ)


@wp.kernel
def slide(
    # In:
    law: int,
    branch: wp.array(dtype=wp.vec2d),
    slip: wp.array3d(dtype=mat33),
    gradient: wp.array2d(dtype=mat33),
    # Out:
    slip_out: wp.array3d(dtype=mat33),
):
    """The slip to which friction elements are dragged."""
    i, w = wp.tid()
    A = strain(law, gradient[i, w])
    for b in range(branch.shape[0]):
        E = slip[b, i, w]
        T = deviator(A - E)
        slip_out[b, i, w] = E + (real(1.0) - held(T, branch[b][1])) * T


class FrictionBranches:
    """The branches of `Material.hysteresis` at every integration point of every world.

    Args:
      hysteresis: ((g, strain), ...); law: number of the material law; mu: (nworld,) Warp array [Pa]; points:
        IntegrationPoints.

    Attributes:
      slip: (nbranch, npoint, nworld, 3, 3) E_p, deviatoric.
    """

    def __init__(self, hysteresis, law, mu, points):
        self._law, self._mu, self._points = law, mu, points
        self.modulus = float(sum(g for g, _ in hysteresis))  # of all branches before they slip, over mu
        shape = (len(hysteresis), *points.shape)
        with wp.ScopedDevice("cpu"):
            self._branch = wp.array([(g, 1.5**0.5 * strain) for g, strain in hysteresis], dtype=wp.vec2d)
            self._slip, self._next = wp.zeros(shape, dtype=mat33), wp.zeros(shape, dtype=mat33)
        self.slip = self._slip.numpy()

    def reset(self, gradient):
        """Begins without stress at the deformation gradients [npoint, nworld]."""
        limit = self._branch.numpy().copy()
        self._branch.numpy()[:, 1] = 0.0  # what has no strength follows
        self.slip[:] = 0
        self.commit(gradient, np.ones(self.slip.shape[2], bool))
        self._branch.numpy()[:] = limit

    def add_stress(self, gradient, stress):
        self._points.launch(add_stress, [self._law, self._mu, self._branch, self._slip, gradient], [stress])

    def add_derivative(self, gradient, change, stress):
        self._points.launch(
            add_derivative, [self._law, self._mu, self._branch, self._slip, gradient, change], [stress]
        )

    def commit(self, gradient, good):
        """Takes over the slip of the step that ended at these gradients in the worlds that are good
        (nworld,)."""
        self._points.launch(slide, [self._law, self._branch, self._slip, gradient], [self._next])
        self.slip[:, :, good] = self._next.numpy()[:, :, good]
