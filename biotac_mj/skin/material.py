"""Hyperelastic materials of the skin: energy density, first Piola-Kirchhoff stress and its directional
derivative.

The four laws take the same two Lame-like constants and differ in the energy W(F):

  corotational  W = mu |F - R|^2 + lambda/2 tr(R^T F - I)^2                 R the rotation of the polar
  decomposition
  svk           W = lambda/2 tr(E)^2 + mu tr(E^2),  E = (F^T F - I)/2       Saint Venant-Kirchhoff
  neo_hookean   W = mu/2 (J^(-2/3) tr(F^T F) - 3) + kappa/2 (J - 1)^2       isochoric split, as ANSYS and
  CalculiX have it linear        W = lambda/2 tr(e)^2 + mu e:e,  e = sym(F) - I              small strain; not
  invariant to rotation
"""

import dataclasses
import math

import warp as wp

from .types import mat33, real

__all__ = ["LAWS", "PRESETS", "Material", "material"]

wp.set_module_options({"enable_backward": False})

LAWS = {"corotational": 0, "svk": 1, "neo_hookean": 2, "linear": 3}
ELEMENTS = ("linear", "quadratic")


@dataclasses.dataclass(frozen=True)
class Material:
    """What the skin is made of.

    Attributes:
      law: "corotational", "svk", "neo_hookean" or "linear".
      youngs_modulus: E [Pa].
      poissons_ratio: nu, inside (-1, 0.5).
      friction: Coulomb coefficient against the touching geoms.
      density: [kg/m^3]; used by implicit dynamics only.
      liquid: whether the preset fills the space between skin and core with the liquid.
      element: what the preset is solved with, "linear" or "quadratic"; None: what the geometry has, see
        `SkinOptions`.
      prony: ((g, tau [s]), ...) of stress relaxation, G(t) = G (1 + sum g exp(-t / tau)): E is the long-term
        modulus. Steps need their dt.
      mullins: (r, m [J/m^3], beta) of Ogden and Roxburgh's softening, or None; see `stress_memory`.
      hysteresis: ((g, strain), ...) of friction elements in parallel: spring of g times the shear modulus
        that slips at this von Mises strain, see `hysteresis`.
      stiffening: c2 / c1 of a second term in the isochoric first invariant, see `stiffening`. These four:
        CPU, full tier.

    Raises:
      ValueError: unknown law, or a constant out of its range or not finite.
    """

    law: str = "corotational"
    youngs_modulus: float = 1.55223093e6
    poissons_ratio: float = 0.31645428
    friction: float = 0.783414394
    density: float = 1000.0
    liquid: bool = True
    element: str | None = None
    prony: tuple = ()
    mullins: tuple | None = None
    hysteresis: tuple = ()
    stiffening: float = 0.0

    def __post_init__(self):
        self._check_memory()
        self._check_hysteresis()
        if self.law not in LAWS:
            raise ValueError(f"unknown material law {self.law!r}: choose one of {', '.join(LAWS)}")
        if self.element not in (None, *ELEMENTS):
            raise ValueError(
                f"unknown element {self.element!r}: choose one of {', '.join(ELEMENTS)}, or None for the "
                "geometry's"
            )
        for name in ("youngs_modulus", "poissons_ratio", "friction", "density", "stiffening"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"material {name} is {getattr(self, name)}: pass a finite number")
        if self.youngs_modulus <= 0 or self.density <= 0:
            raise ValueError(
                f"Young's modulus {self.youngs_modulus} Pa and density {self.density} kg/m^3 must be positive"
            )
        if not -1 < self.poissons_ratio < 0.5:
            raise ValueError(
                f"Poisson's ratio {self.poissons_ratio} is outside (-1, 0.5): an incompressible rubber "
                "needs nu below 0.5, "
                "the liquid's volume constraint does the rest"
            )
        if self.friction < 0:
            raise ValueError(f"friction {self.friction} is negative: pass a Coulomb coefficient >= 0")

    def _check_memory(self):
        try:  # lists, as YAML and JSON give them, become tuples: a material is a key
            object.__setattr__(self, "prony", tuple((float(g), float(tau)) for g, tau in self.prony))
            if self.mullins is not None:
                r, m, beta = (float(v) for v in self.mullins)
                object.__setattr__(self, "mullins", (r, m, beta))
        except (TypeError, ValueError):
            raise ValueError(
                f"prony is {self.prony!r} and mullins {self.mullins!r}: pass ((g, tau), ...) and (r, m, "
                "beta) or None"
            ) from None  # noqa: E501
        for g, tau in self.prony:
            if not (math.isfinite(g) and g >= 0 and math.isfinite(tau) and tau > 0):
                raise ValueError(
                    f"a Prony term of g {g} and tau {tau} s: g must be >= 0 and tau positive, else energy "
                    "would come from nothing"
                )  # noqa: E501
        if self.mullins is not None and not (r > 1 and m > 0 and beta >= 0 and math.isfinite(r + m + beta)):
            raise ValueError(
                f"Mullins softening (r, m, beta) is {self.mullins}: r must be above 1, m positive, beta >= 0"
            )

    def _check_hysteresis(self):
        try:
            object.__setattr__(
                self, "hysteresis", tuple((float(g), float(strain)) for g, strain in self.hysteresis)
            )
        except (TypeError, ValueError):
            raise ValueError(f"hysteresis is {self.hysteresis!r}: pass ((g, strain), ...)") from None
        for g, strain in self.hysteresis:
            if not (math.isfinite(g) and g >= 0 and math.isfinite(strain) and strain > 0):
                raise ValueError(
                    f"a friction element of g {g} and strain {strain}: g must be >= 0 and the strain at "
                    "which it slips positive"
                )

    @property
    def remembers(self) -> bool:
        """Whether the stress depends on the past."""
        return bool(self.prony or self.hysteresis) or self.mullins is not None

    @property
    def beyond_law(self) -> dict:
        """What there is beside the law, by name: the CPU's full tier alone has it."""
        return {name: getattr(self, name) for name in ("prony", "mullins", "hysteresis", "stiffening")}

    @property
    def extensions(self) -> tuple[str, ...]:
        """Names of what is in use of it."""
        return tuple(name for name, value in self.beyond_law.items() if value not in ((), None, 0.0))

    @property
    def mu(self) -> float:
        """Shear modulus [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poissons_ratio))

    @property
    def lame(self) -> float:
        """Lame's first constant lambda [Pa]."""
        return (
            self.youngs_modulus
            * self.poissons_ratio
            / ((1 + self.poissons_ratio) * (1 - 2 * self.poissons_ratio))
        )

    @property
    def bulk(self) -> float:
        """Bulk modulus kappa [Pa]."""
        return self.youngs_modulus / (3 * (1 - 2 * self.poissons_ratio))


# Narang et al., ICRA 2021: the constants that they fitted for Isaac Gym ("paper") and for ANSYS ("ansys", on
# elements that do not lock: nu 0.5 there, 0.499 here, with the force of 0.4999 to 0.1 % until the skin is
# squeezed on the core; "rubber": nu 0.45, as the reference solutions). "paper" keeps to linear tetrahedra:
# the stiffness of its mesh is in the fitted modulus.
PRESETS = {
    "default": Material(),
    "paper": Material(liquid=False, element="linear"),
    "rubber": Material("neo_hookean", 2.80e5, 0.45, 0.186),
    "ansys": Material("neo_hookean", 2.80e5, 0.499, 0.186, element="quadratic"),
}


def material(choice) -> Material:
    """A preset's name or a Material, as a Material; ValueError names the presets."""
    if isinstance(choice, Material):
        return choice
    if choice not in PRESETS:
        raise ValueError(
            f"unknown material {choice!r}: choose one of {', '.join(PRESETS)}, or pass a Material"
        )
    return PRESETS[choice]


@wp.func
def polar_rotation(F: mat33):
    """Rotation of the polar decomposition F = R S (Newton's iteration; by SVD where F is inverted or nearly
    flat)."""
    if wp.determinant(F) < real(1.0e-3):
        U = mat33()
        s = wp.vec3d()
        V = mat33()
        wp.svd3(F, U, s, V)
        R = U * wp.transpose(V)
        if wp.determinant(R) < real(0.0):
            # svd3 sorts the singular values: the reflection goes to the smallest
            c = wp.vec3d(U[0, 2], U[1, 2], U[2, 2])
            d = wp.vec3d(V[0, 2], V[1, 2], V[2, 2])
            R = R - real(2.0) * wp.outer(c, d)
        return R
    X = F
    for _ in range(20):
        Y = real(0.5) * (X + wp.transpose(wp.inverse(X)))
        change = wp.ddot(Y - X, Y - X)
        X = Y
        if change < real(1.0e-14):
            break
    return X


@wp.func
def axial(A: mat33):
    """Twice the axial vector of the skew part of A."""
    return wp.vec3d(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])


@wp.func
def energy_density(law: int, mu: real, lam: real, F: mat33, R: mat33):
    """W(F) [J/m^3]; for neo_hookean `lam` is the bulk modulus."""
    eye = wp.identity(n=3, dtype=real)
    if law == 0:
        tr = wp.trace(wp.transpose(R) * F) - real(3.0)
        return mu * wp.ddot(F - R, F - R) + real(0.5) * lam * tr * tr
    if law == 1:
        E = real(0.5) * (wp.transpose(F) * F - eye)
        return real(0.5) * lam * wp.trace(E) * wp.trace(E) + mu * wp.ddot(E, E)
    if law == 2:
        J = wp.determinant(F)
        return real(0.5) * mu * (wp.pow(J, -real(2.0) / real(3.0)) * wp.ddot(F, F) - real(3.0)) + real(
            0.5
        ) * lam * (J - real(1.0)) * (J - real(1.0))
    e = real(0.5) * (F + wp.transpose(F)) - eye
    return real(0.5) * lam * wp.trace(e) * wp.trace(e) + mu * wp.ddot(e, e)


@wp.func
def stress(law: int, mu: real, lam: real, F: mat33, R: mat33):
    """First Piola-Kirchhoff stress P = dW/dF [Pa]."""
    eye = wp.identity(n=3, dtype=real)
    if law == 0:
        return real(2.0) * mu * (F - R) + lam * (wp.trace(wp.transpose(R) * F) - real(3.0)) * R
    if law == 1:
        E = real(0.5) * (wp.transpose(F) * F - eye)
        return F * (lam * wp.trace(E) * eye + real(2.0) * mu * E)
    if law == 2:
        J = wp.determinant(F)
        G = wp.transpose(wp.inverse(F))
        return (
            mu * wp.pow(J, -real(2.0) / real(3.0)) * (F - wp.ddot(F, F) / real(3.0) * G)
            + lam * (J - real(1.0)) * J * G
        )
    e = real(0.5) * (F + wp.transpose(F)) - eye
    return lam * wp.trace(e) * eye + real(2.0) * mu * e


@wp.func
def stress_derivative(law: int, mu: real, lam: real, F: mat33, R: mat33, dF: mat33):
    """Directional derivative of the stress, dP = (d2W/dF2) : dF [Pa]."""
    eye = wp.identity(n=3, dtype=real)
    if law == 0:
        Rt = wp.transpose(R)
        S = Rt * F
        A = Rt * dF
        trace_s = wp.trace(S)
        w = wp.inverse(trace_s * eye - S) * axial(A)
        dR = R * wp.skew(w)
        return real(2.0) * mu * (dF - dR) + lam * (wp.trace(A) * R + (trace_s - real(3.0)) * dR)
    if law == 1:
        Ft = wp.transpose(F)
        E = real(0.5) * (Ft * F - eye)
        A = Ft * dF
        dE = real(0.5) * (A + wp.transpose(A))
        return dF * (lam * wp.trace(E) * eye + real(2.0) * mu * E) + F * (
            lam * wp.trace(dE) * eye + real(2.0) * mu * dE
        )
    if law == 2:
        J = wp.determinant(F)
        G = wp.transpose(wp.inverse(F))
        a = wp.pow(J, -real(2.0) / real(3.0))
        GdF = wp.ddot(G, dF)
        dG = -G * wp.transpose(dF) * G
        I1 = wp.ddot(F, F) / real(3.0)
        iso = a * (dF - real(2.0) / real(3.0) * wp.ddot(F, dF) * G - I1 * dG) - real(2.0) / real(
            3.0
        ) * a * GdF * (F - I1 * G)
        return mu * iso + lam * J * ((real(2.0) * J - real(1.0)) * GdF * G + (J - real(1.0)) * dG)
    de = real(0.5) * (dF + wp.transpose(dF))
    return lam * wp.trace(de) * eye + real(2.0) * mu * de


@wp.func
def dilatation(law: int, F: mat33, R: mat33):
    """The measure theta of volume change that multiplies `lam` in the energy: W = W(lam = 0) + lam/2
    theta^2."""
    eye = wp.identity(n=3, dtype=real)
    if law == 0:
        return wp.trace(wp.transpose(R) * F) - real(3.0)
    if law == 1:
        return real(0.5) * (wp.ddot(F, F) - real(3.0))
    if law == 2:
        return wp.determinant(F) - real(1.0)
    return wp.trace(F - eye)


@wp.func
def dilatation_gradient(law: int, F: mat33, R: mat33):
    """d theta / dF."""
    if law == 0:
        return R
    if law == 1:
        return F
    if law == 2:
        return wp.determinant(F) * wp.transpose(wp.inverse(F))
    return wp.identity(n=3, dtype=real)


@wp.func
def dilatation_hessian(law: int, F: mat33, R: mat33, dF: mat33):
    """Directional derivative of `dilatation_gradient`, (d2 theta / dF2) : dF."""
    if law == 0:
        Rt = wp.transpose(R)
        S = Rt * F
        return R * wp.skew(wp.inverse(wp.trace(S) * wp.identity(n=3, dtype=real) - S) * axial(Rt * dF))
    if law == 1:
        return dF
    if law == 2:
        G = wp.transpose(wp.inverse(F))
        return wp.determinant(F) * (wp.ddot(G, dF) * G - G * wp.transpose(dF) * G)
    return mat33()
