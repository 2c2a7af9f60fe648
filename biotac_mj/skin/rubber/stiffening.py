"""Rubber that stiffens with strain: what a second term in the isochoric first invariant adds to any of the
laws.

Every law's shear energy is mu/2 q. For neo_hookean q is J^(-2/3) tr(F^T F) - 3; for the others it is 2 |dev
A|^2 of their own strain A (Biot's for corotational, Green and Lagrange's for svk, the small one for linear),
the same number to second order. With s = c2 / c1

    mu/2 (q + s q^2)                            s >= 0    Yeoh's first two terms (1993), c1 = mu/2
    mu/2 (sqrt(1 - 4 s q) - 1) / (-2 s)         s < 0     Knowles's power law (1977) of exponent 1/2, same
    slope in q at rest

stand in its place. A negative second term of Yeoh's would have no lower bound; Knowles's is the softest of
his that stays elliptic."""

import warp as wp

from ..types import mat33, real
from .law import energy_density, stress, stress_derivative

__all__ = ["added_derivative", "added_energy", "added_stress"]

wp.set_module_options({"enable_backward": False})


@wp.func
def unit_lame(law: int):
    """Second constant with which a law's energy at mu = 1 is q / 2: its shear energy alone."""
    if law == 2:
        return real(0.0)
    return -real(2.0) / real(3.0)


@wp.func
def growth(s: real, q: real):
    """d(q + ...)/dq less one: how much stiffer the tangent line through rest has become."""
    if s >= real(0.0):
        return real(2.0) * s * q
    return real(1.0) / wp.sqrt(real(1.0) - real(4.0) * s * q) - real(1.0)


@wp.func
def added_energy(law: int, mu: real, s: real, F: mat33, R: mat33):
    """Energy density beyond the law's own [J/m^3]."""
    q = real(2.0) * energy_density(law, real(1.0), unit_lame(law), F, R)
    if s >= real(0.0):
        return real(0.5) * mu * s * q * q
    return real(0.5) * mu * ((wp.sqrt(real(1.0) - real(4.0) * s * q) - real(1.0)) / (-real(2.0) * s) - q)


@wp.func
def added_stress(law: int, mu: real, s: real, F: mat33, R: mat33):
    """First Piola-Kirchhoff stress beyond the law's own [Pa]."""
    q = real(2.0) * energy_density(law, real(1.0), unit_lame(law), F, R)
    return mu * growth(s, q) * stress(law, real(1.0), unit_lame(law), F, R)


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
    return mu * (growth(s, q) * dP + (real(2.0) * slope * wp.ddot(P, dF)) * P)
