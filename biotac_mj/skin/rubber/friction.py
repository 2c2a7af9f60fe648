"""Rate-independent hysteresis of rubber: Prandtl-Ishlinskii friction elements in parallel with the law.

A branch is a spring (shear modulus g mu) in series with a friction element that slips when the spring's von
Mises equivalent strain is `strain`. Within a step it has the potential

    min over E'  of   g mu |dev(A - E')|^2  +  2 g mu r |E' - E_p|,         r = sqrt(3/2) strain

of the strain A, with E_p the slip at the end of the last step (Simo and Hughes 1998, ch. 1-3: radial return
is its minimum). Its stress Q = 2 g mu dev(A - E') has at most the norm 2 g mu r, its tangent is symmetric and
exact, and slip only dissipates. A is the Green-Lagrange strain, for neo_hookean the isochoric one, (J^(-2/3)
F^T F - I) / 2, for linear the small strain. Q is the conjugate second Piola stress, and rotates with the
body."""

import warp as wp

from ..types import mat33, real
from .law import Law


@wp.func
def deviator(A: mat33):
    return A - wp.trace(A) / real(3.0) * wp.identity(n=3, dtype=real)


@wp.func
def symmetric(A: mat33):
    return real(0.5) * (A + wp.transpose(A))


@wp.func
def strain(law: int, F: mat33):
    """The strain A; only its deviator acts."""
    eye = wp.identity(n=3, dtype=real)
    if law == Law.LINEAR:
        return symmetric(F) - eye
    C = wp.transpose(F) * F
    if law == Law.NEO_HOOKEAN:
        C = wp.pow(wp.determinant(F), -real(2.0) / real(3.0)) * C
    return real(0.5) * (C - eye)


@wp.func
def strain_change(law: int, F: mat33, dF: mat33):
    """Directional derivative of `strain`."""
    if law == Law.LINEAR:
        return symmetric(dF)
    dE = symmetric(wp.transpose(F) * dF)
    if law == Law.NEO_HOOKEAN:
        third = wp.ddot(wp.transpose(wp.inverse(F)), dF) / real(3.0)
        return wp.pow(wp.determinant(F), -real(2.0) / real(3.0)) * (dE - third * wp.transpose(F) * F)
    return dE


@wp.func
def push_forward(law: int, F: mat33, Q: mat33):
    """First Piola stress P for Q, with P : dF = Q : dA."""
    if law == Law.LINEAR:
        return Q
    P = F * Q
    if law == Law.NEO_HOOKEAN:
        third = wp.ddot(F, P) / real(3.0)  # Q : C
        return wp.pow(wp.determinant(F), -real(2.0) / real(3.0)) * (P - third * wp.transpose(wp.inverse(F)))
    return P


@wp.func
def push_forward_change(law: int, F: mat33, Q: mat33, dF: mat33, dQ: mat33):
    """Directional derivative of `push_forward`."""
    if law == Law.LINEAR:
        return dQ
    dP = dF * Q + F * dQ
    if law == Law.NEO_HOOKEAN:
        G = wp.transpose(wp.inverse(F))
        P = F * Q
        third = wp.ddot(F, P) / real(3.0)
        change = (wp.ddot(dF, P) + wp.ddot(F, dP)) / real(3.0)
        a = wp.pow(wp.determinant(F), -real(2.0) / real(3.0))
        da = -real(2.0) / real(3.0) * a * wp.ddot(G, dF)
        return a * (dP - change * G + third * G * wp.transpose(dF) * G) + da * (P - third * G)
    return dP


@wp.func
def sticking_fraction(T: mat33, most: real):
    """Fraction of a trial strain T that does not slip: radial return to the norm `most`."""
    size = wp.sqrt(wp.ddot(T, T))
    if size > most:
        return most / size
    return real(1.0)
