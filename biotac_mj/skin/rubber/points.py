"""The rubber at an integration point: its law, and what it has beyond the law.

Relaxation is finite linear viscoelasticity (Simo 1987; Holzapfel 2000, ch. 6): every term of the series adds
an overstress Q_i to the second Piola-Kirchhoff stress S of the elastic law, which stays the long-term one,

    dQ_i/dt + Q_i / tau_i = g_i dS/dt,    so that   G(t) = G_inf (1 + sum_i g_i exp(-t / tau_i))

and S, taken as linear in time within a step, gives Q_i exactly from its last value. Softening is the
pseudo-elasticity of Ogden and Roxburgh (1999): S is multiplied by

    eta = 1 - erf((W_max - W) / (m + beta W_max)) / r,    W_max the largest energy density so far.

Both act on what has to do with shape. For neo_hookean that is the isochoric part; the other laws have no such
split and the whole stress remembers, but for the dilatation that ten-node elements keep for an element's mean
(lam beyond 5 mu). Second Piola stresses turn with the body, so that nothing here depends on rotations (but
for the `linear` law, which never does).

Within a step the past is a constant H, S = (1 + c) eta S_elastic + H with c = sum_i g_i h_i: the elastic law
again, stiffer, with an initial stress. Hence the tangent is symmetric and exact (algorithmic). Stiffening
(`stiffening`) belongs to the elastic law, so it relaxes and softens too; friction (`friction`) stands beside.

What a material does not have is left out of the code that is compiled: nobody pays for it.
"""

import functools
import types

import warp as wp

from ..state import declared
from ..types import mat33, real, vec3
from .friction import deviator, push_forward, push_forward_change, sticking_fraction, strain, strain_change
from .law import energy_density, stress, stress_derivative
from .stiffening import added_derivative, added_energy, added_stress

__all__ = ["Mesh", "Rubber", "deformation_of", "point_functions"]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Mesh:
    """Constants of the elements."""

    elem: wp.array2d(dtype=int)  # [node of the element, element]
    shape: wp.array2d(dtype=vec3)  # gradients in the parent element [point, node]
    inverse: wp.array2d(dtype=mat33)  # of the parent's map [element, point]
    weight: wp.array2d(dtype=real)  # volume that a point stands for [element, point] [m^3]
    volume: wp.array(dtype=real)  # [element]
    # for tangents in single precision: a processor converts a number slower than it multiplies many
    shape_single: wp.array2d(dtype=wp.vec3)
    inverse_single: wp.array2d(dtype=wp.mat33)
    of_element: wp.array2d(dtype=int)  # nodes [element, 12], the last two no node's, of ten-node elements


@wp.struct
@declared("rubber")
class Rubber:
    """Constants of the rubber in every world and what its points remember, for which see `state.VARIABLES`;
    arrays of what there is not are empty. A point's number is (points of an element) x element + point."""

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
    """Function (mesh, element, point, x, world) -> deformation gradient, for elements of so many nodes: a
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
    """Second constant of the part of the law that remembers."""
    if law == 2:
        return real(0.0)
    return lam


@functools.cache
def point_functions(options: tuple[str, ...]) -> types.SimpleNamespace:
    """Functions of a point for rubber with these options beyond its law.

    Args:
      options: of "modulus", "prony", "mullins", "hysteresis", "stiffening".

    Returns:
      beyond_stress, beyond_derivative: what is added to the law's stress and to its derivative.
      remembered: the part of the law that remembers, its stress, the stress' derivative and energy density.
      softening: factor eta on a stress, and its derivative with the energy.
    """
    has = {name: name in options for name in ("modulus", "prony", "mullins", "hysteresis", "stiffening")}

    @wp.func
    def remembered(rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, R: mat33):
        part = remembering(rubber.law, lam)
        P = stress(rubber.law, mu, part, F, R)
        if wp.static(has["stiffening"]):
            P += added_stress(rubber.law, mu, rubber.stiffening[w], F, R)
        return P

    @wp.func
    def remembered_derivative(
        rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, R: mat33, dF: mat33
    ):
        dP = stress_derivative(rubber.law, mu, remembering(rubber.law, lam), F, R, dF)
        if wp.static(has["stiffening"]):
            dP += added_derivative(rubber.law, mu, rubber.stiffening[w], F, R, dF)
        return dP

    @wp.func
    def remembered_energy(rubber: Rubber, e: int, w: int, mu: real, lam: real, F: mat33, R: mat33):
        W = energy_density(rubber.law, mu, remembering(rubber.law, lam), F, R)
        if wp.static(has["stiffening"]):
            W += added_energy(rubber.law, mu, rubber.stiffening[w], F, R)
        if wp.static(has["modulus"]):
            W *= rubber.modulus[e, w]
        return W

    @wp.func
    def softening(rubber: Rubber, e: int, w: int, W: real, worst: real):
        eta = real(1.0)
        slope = real(0.0)
        mullins = rubber.mullins[w]
        if mullins[0] > real(0.0) and W < worst:
            width = mullins[1] + mullins[2] * worst
            s = (worst - W) / width
            eta = real(1.0) - wp.erf(s) / mullins[0]
            # 2 / sqrt(pi)
            slope = real(1.1283791670955126) * wp.exp(-s * s) / (mullins[0] * width)
            if wp.static(has["modulus"]):
                slope *= rubber.modulus[e, w]
        return wp.vec2d(eta, slope)

    @wp.func
    def beyond_stress(rubber: Rubber, e: int, i: int, w: int, mu: real, lam: real, F: mat33, R: mat33):
        own = stress(rubber.law, mu, remembering(rubber.law, lam), F, R)
        factor = real(1.0)
        if wp.static(has["prony"]):
            factor += rubber.gain[w]
        if wp.static(has["mullins"]):
            W = remembered_energy(rubber, e, w, mu, lam, F, R)
            factor *= softening(rubber, e, w, W, rubber.worst[i, w])[0]
        P = factor * remembered(rubber, e, w, mu, lam, F, R) - own
        if wp.static(has["prony"]):
            H = rubber.past[i, w]
            if rubber.law != 3:
                H = F * H
            P += H
        if wp.static(has["hysteresis"]):
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
        own = stress_derivative(rubber.law, mu, remembering(rubber.law, lam), F, R, dF)
        dP = remembered_derivative(rubber, e, w, mu, lam, F, R, dF)
        factor = real(1.0)
        if wp.static(has["prony"]):
            factor += rubber.gain[w]
        if wp.static(has["mullins"]):
            W = remembered_energy(rubber, e, w, mu, lam, F, R)
            soft = softening(rubber, e, w, W, rubber.worst[i, w])
            P = remembered(rubber, e, w, mu, lam, F, R)
            dP = soft[0] * dP + (soft[1] * wp.ddot(P, dF)) * P
        dP = factor * dP - own
        if wp.static(has["prony"]):
            if rubber.law != 3:  # there the past is a constant stress
                dP += dF * rubber.past[i, w]
        if wp.static(has["hysteresis"]):
            A = strain(rubber.law, F)
            dA = deviator(strain_change(rubber.law, F, dF))
            Q = mat33()
            dQ = mat33()
            for b in range(rubber.branch.shape[0]):
                T = deviator(A - rubber.slip[b, i, w])
                branch = rubber.branch[b, w]
                share = sticking_fraction(T, branch[1])
                modulus = real(2.0) * branch[0] * mu * share
                Q += modulus * T
                dQ += modulus * dA
                if share < real(1.0):
                    dQ -= (modulus * wp.ddot(T, dA) / wp.ddot(T, T)) * T
            dP += push_forward_change(rubber.law, F, Q, dF, dQ)
        return dP

    return types.SimpleNamespace(
        beyond_stress=beyond_stress,
        beyond_derivative=beyond_derivative,
        remembered=remembered,
        remembered_derivative=remembered_derivative,
        remembered_energy=remembered_energy,
        softening=softening,
    )
