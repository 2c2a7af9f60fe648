"""The rubber at an integration point: its law, and effects beyond the law.

Relaxation is finite linear viscoelasticity (Simo 1987; Holzapfel 2000, ch. 6): every term of the Prony series
adds an overstress Q_i to the second Piola-Kirchhoff stress S of the elastic law, which is the long-term one,

    dQ_i/dt + Q_i / tau_i = g_i dS/dt,    so that   G(t) = G_inf (1 + sum_i g_i exp(-t / tau_i))

and Q_i follows exactly from its last value if S is linear in time within a step. Softening is the
pseudo-elasticity of Ogden and Roxburgh (1999): S is multiplied by

    eta = 1 - erf((W_max - W) / (m + beta W_max)) / r,    W_max the largest energy density so far.

Both act on the isochoric part of neo_hookean. The other laws have no such split, and both act on the whole
stress, except the mean dilatation of ten-node elements (lam beyond 5 mu). Second Piola stresses rotate with
the body, so that the effects are objective (except for the `linear` law).

Within a step the history is a constant H: S = (1 + c) eta S_elastic + H with c = sum_i g_i h_i. This is the
elastic law, stiffer and with an initial stress, so that the tangent is symmetric and exact (algorithmic).
Stiffening (`stiffening`) is part of the elastic law, so that it relaxes and softens, too; friction
(`friction`) acts in parallel.

Kernels of rubber without any effect are compiled without them; the others look in the arrays of `Rubber`.
"""

import functools

import warp as wp

from ..state import declared
from ..types import mat33, real, vec3
from .friction import deviator, push_forward, push_forward_change, sticking_fraction, strain, strain_change
from .law import Law, energy_density, stress, stress_derivative
from .stiffening import added_derivative, added_energy, added_stress


@wp.struct
class Mesh:
    """Constants of the elements."""

    elem: wp.array2d(dtype=int)  # [node of the element, element]
    shape: wp.array2d(dtype=vec3)  # gradients in the parent element [point, node]
    inverse: wp.array2d(dtype=mat33)  # of the parent's map [element, point]
    weight: wp.array2d(dtype=real)  # volume that a point stands for [element, point] [m^3]
    volume: wp.array(dtype=real)  # [element]


@wp.struct
@declared("rubber")
class Rubber:
    """Constants of the rubber in every world, and history variables of its points, see `state.VARIABLES`.
    Arrays of absent effects are empty. The index of a point is (points of an element) x element + point."""

    law: int
    mu: wp.array(dtype=real)  # [world]
    lam: wp.array(dtype=real)  # [world], of neo_hookean the bulk modulus
    modulus: wp.array2d(dtype=real)  # factor on both [element, world]
    prony: wp.array2d(dtype=wp.vec2d)  # g, tau [term, world]
    mullins: wp.array(dtype=vec3)  # r, m, beta [world]; r of 0: none
    stiffening: wp.array(dtype=real)  # [world]
    branch: wp.array2d(dtype=wp.vec2d)  # g, r [branch, world], see `friction`
    gain: wp.array(dtype=real)  # c of this step [world]
    past: wp.array2d(dtype=mat33)  # H of this step [point, world]


@functools.cache
def deformation_of(corners: int) -> wp.Function:
    """Function (mesh, element, point, x, world) -> deformation gradient, for elements of `corners` nodes: a
    loop of known length is a third faster on CUDA."""

    @wp.func
    def deformation(mesh: Mesh, e: int, q: int, x: wp.array2d(dtype=vec3), w: int):
        F = mat33()
        first = x[mesh.elem[0, e], w]
        for a in range(1, wp.static(corners)):
            F += wp.outer(x[mesh.elem[a, e], w] - first, mesh.shape[q, a])
        return F * mesh.inverse[e, q]

    return deformation


@wp.func
def remembering(law: int, lam: real):
    """Constant lambda of the part of the law with history."""
    if law == Law.NEO_HOOKEAN:
        return real(0.0)
    return lam


@wp.func
def has_effects(rubber: Rubber, w: int):
    """Whether the rubber has an effect beyond its law, of all but the modulus."""
    return rubber.last.shape[0] > 0 or rubber.branch.shape[0] > 0 or rubber.stiffening[w] != real(0.0)


@wp.func
def remembered(rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, R: mat33):
    """Stress of the part of the law with history [Pa]."""
    P = stress(rubber.law, mu, remembering(rubber.law, lam), F, R)
    if rubber.stiffening[w] != real(0.0):
        P += added_stress(rubber.law, mu, rubber.stiffening[w], F, R)
    return P


@wp.func
def remembered_derivative(rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, R: mat33, dF: mat33):
    """Derivative of `remembered` along dF [Pa]."""
    dP = stress_derivative(rubber.law, mu, remembering(rubber.law, lam), F, R, dF)
    if rubber.stiffening[w] != real(0.0):
        dP += added_derivative(rubber.law, mu, rubber.stiffening[w], F, R, dF)
    return dP


@wp.func
def remembered_energy(rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, R: mat33):
    """Energy density of the part of the law with history [J/m^3]."""
    W = energy_density(rubber.law, mu, remembering(rubber.law, lam), F, R)
    if rubber.stiffening[w] != real(0.0):
        W += added_energy(rubber.law, mu, rubber.stiffening[w], F, R)
    if rubber.modulus.shape[0] > 0:
        W *= rubber.modulus[e, w]
    return W


@wp.func
def softening(rubber: Rubber, e: int, w: int, W: real, worst: real):
    """Factor eta on a stress of rubber that softens, and its derivative by the energy."""
    eta = real(1.0)
    slope = real(0.0)
    mullins = rubber.mullins[w]
    if W < worst:
        width = mullins[1] + mullins[2] * worst
        s = (worst - W) / width
        eta = real(1.0) - wp.erf(s) / mullins[0]
        # 2 / sqrt(pi)
        slope = real(1.1283791670955126) * wp.exp(-s * s) / (mullins[0] * width)
        if rubber.modulus.shape[0] > 0:
            slope *= rubber.modulus[e, w]
    return wp.vec2d(eta, slope)


@wp.func
def beyond_stress(rubber: Rubber, e: int, i: int, w: int, mu: real, lam: real, F: mat33, R: mat33):
    """Stress that the effects add to the law's [Pa]."""
    own = stress(rubber.law, mu, remembering(rubber.law, lam), F, R)
    factor = real(1.0)
    if rubber.prony.shape[0] > 0:
        factor += rubber.gain[w]
    if rubber.mullins[w][0] > real(0.0):
        W = remembered_energy(rubber, e, w, mu, lam, F, R)
        factor *= softening(rubber, e, w, W, rubber.worst[i, w])[0]
    P = factor * remembered(rubber, e, w, mu, lam, F, R) - own
    if rubber.prony.shape[0] > 0:
        H = rubber.past[i, w]
        if rubber.law != Law.LINEAR:
            H = F * H
        P += H
    if rubber.branch.shape[0] > 0:
        A = strain(rubber.law, F)
        Q = mat33()
        for b in range(rubber.branch.shape[0]):
            T = deviator(A - rubber.slip[b, i, w])
            branch = rubber.branch[b, w]
            Q += (real(2.0) * branch[0] * mu * sticking_fraction(T, branch[1])) * T
        P += push_forward(rubber.law, F, Q)
    return P


@wp.func
def beyond_derivative(
    rubber: Rubber, e: int, i: int, w: int, mu: real, lam: real, F: mat33, R: mat33, dF: mat33
):
    """Derivative of `beyond_stress` along dF [Pa]."""
    own = stress_derivative(rubber.law, mu, remembering(rubber.law, lam), F, R, dF)
    dP = remembered_derivative(rubber, e, w, mu, lam, F, R, dF)
    factor = real(1.0)
    if rubber.prony.shape[0] > 0:
        factor += rubber.gain[w]
    if rubber.mullins[w][0] > real(0.0):
        W = remembered_energy(rubber, e, w, mu, lam, F, R)
        soft = softening(rubber, e, w, W, rubber.worst[i, w])
        P = remembered(rubber, e, w, mu, lam, F, R)
        dP = soft[0] * dP + (soft[1] * wp.ddot(P, dF)) * P
    dP = factor * dP - own
    if rubber.prony.shape[0] > 0:
        if rubber.law != Law.LINEAR:  # for `linear`, H is a constant stress
            dP += dF * rubber.past[i, w]
    if rubber.branch.shape[0] > 0:
        A = strain(rubber.law, F)
        dA = deviator(strain_change(rubber.law, F, dF))
        Q = mat33()
        dQ = mat33()
        for b in range(rubber.branch.shape[0]):
            T = deviator(A - rubber.slip[b, i, w])
            branch = rubber.branch[b, w]
            sticking = sticking_fraction(T, branch[1])
            modulus = real(2.0) * branch[0] * mu * sticking
            Q += modulus * T
            dQ += modulus * dA
            if sticking < real(1.0):
                dQ -= (modulus * wp.ddot(T, dA) / wp.ddot(T, T)) * T
        dP += push_forward_change(rubber.law, F, Q, dF, dQ)
    return dP
