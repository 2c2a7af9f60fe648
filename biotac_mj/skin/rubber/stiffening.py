"""Strain stiffening of rubber: a second term in the isochoric first invariant, for all laws.

The shear energy of a law is mu/2 q. For neo_hookean q is J^(-2/3) tr(F^T F) - 3; for the others it is twice
|dev A|^2 of their strain A (Biot for corotational, Green-Lagrange for svk, small strain for linear), which is
equal to second order. With s = c2 / c1 it is replaced by

    mu/2 (q + s q^2)                            s >= 0    first two terms of Yeoh (1993), c1 = mu/2
    mu/2 (sqrt(1 - 4 s q) - 1) / (-2 s)         s < 0     power law of Knowles (1977) with exponent 1/2

which have the same second derivative at q = 0. A negative second term of Yeoh would have no lower bound; the
exponent 1/2 is the smallest for which Knowles's law stays elliptic."""

import warp as wp

from ..types import mat33, real
from .law import Law, energy_density, stress, stress_derivative


@wp.func
def unit_lame(law: int):
    """Second constant with which a law's energy at mu = 1 is q / 2, without volume change."""
    if law == Law.NEO_HOOKEAN:
        return real(0.0)
    return -real(2.0) / real(3.0)


@wp.func
def added_slope(s: real, q: real):
    """Slope of the new shear energy in q over that of the law, minus one."""
    if s >= real(0.0):
        return real(2.0) * s * q
    return real(1.0) / wp.sqrt(real(1.0) - real(4.0) * s * q) - real(1.0)


@wp.func
def added_energy(law: int, mu: real, s: real, F: mat33, R: mat33):
    """Energy density added to the law's [J/m^3]."""
    q = real(2.0) * energy_density(law, real(1.0), unit_lame(law), F, R)
    if s >= real(0.0):
        return real(0.5) * mu * s * q * q
    return real(0.5) * mu * ((wp.sqrt(real(1.0) - real(4.0) * s * q) - real(1.0)) / (-real(2.0) * s) - q)


@wp.func
def added_stress(law: int, mu: real, s: real, F: mat33, R: mat33):
    """First Piola-Kirchhoff stress added to the law's [Pa]."""
    q = real(2.0) * energy_density(law, real(1.0), unit_lame(law), F, R)
    return mu * added_slope(s, q) * stress(law, real(1.0), unit_lame(law), F, R)


@wp.func
def added_derivative(law: int, mu: real, s: real, F: mat33, R: mat33, dF: mat33):
    """Directional derivative of `added_stress` [Pa]."""
    q = real(2.0) * energy_density(law, real(1.0), unit_lame(law), F, R)
    slope = real(2.0) * s
    if s < real(0.0):
        r = real(1.0) - real(4.0) * s * q
        slope = slope / (r * wp.sqrt(r))
    P = stress(law, real(1.0), unit_lame(law), F, R)
    dP = stress_derivative(law, real(1.0), unit_lame(law), F, R, dF)
    return mu * (added_slope(s, q) * dP + (real(2.0) * slope * wp.ddot(P, dF)) * P)
