"""Materials of the skin: constants of its rubber, presets."""

import dataclasses
import math

from ...fields import as_real, check_choice, check_types
from .law import LAWS

ELEMENTS = ("linear", "quadratic")

_SOFTEST, _HARDEST = 100.0, 1e15  # [Pa]: softer than any gel, harder than any solid
_LEAST_DIFFERENCE = 1e-8  # of nu from 0.5: with less, rounding makes the stiffness indefinite


@dataclasses.dataclass(frozen=True)
class Material:
    """Material of the skin.

    Attributes:
      law: "corotational", "svk", "neo_hookean" or "linear".
      youngs_modulus: E [Pa], from 100 to 1e15.
      poissons_ratio: nu, inside (-1, 0.5).
      friction: Coulomb coefficient against the touching geoms.
      density: [kg/m^3]; used by implicit dynamics only.
      liquid: whether the preset has liquid between skin and core.
      element: "linear" or "quadratic" elements of the preset; None: those of the geometry, see `SkinOptions`.
      rest_pressure: pressure of the preset's filling [Pa], see `SkinOptions`.
      electrode_radius: radius in the film with which the preset was fitted [m]; None: the film's own, see
        `sensor.film.read_film`.
      prony: ((g, tau [s]), ...) of stress relaxation, G(t) = G (1 + sum g exp(-t / tau)): E is the long-term
        modulus. Steps need their dt.
      mullins: (r, m [J/m^3], beta) of Ogden and Roxburgh's softening, or None; see `points`.
      hysteresis: ((g, strain), ...) of friction elements in parallel: springs of g times the shear modulus
        that slip at this von Mises strain, see `friction`.
      stiffening: c2 / c1 of a second term in the isochoric first invariant, see `stiffening`. The condensed
        tier has none of the last four.

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
    rest_pressure: float = 0.0
    electrode_radius: float | None = None
    prony: tuple = ()
    mullins: tuple | None = None
    hysteresis: tuple = ()
    stiffening: float = 0.0

    def __post_init__(self):
        self._check_memory()
        self._check_hysteresis()
        check_types(self)
        check_choice("unknown material law", self.law, LAWS)
        if self.element is not None:
            check_choice("unknown element", self.element, ELEMENTS, ", or None for the geometry's")
        for name in ("youngs_modulus", "poissons_ratio", "density", "stiffening", "rest_pressure"):
            as_real(f"material {name}", getattr(self, name))
        as_real("material friction", self.friction, 0.0)
        if not (_SOFTEST <= self.youngs_modulus <= _HARDEST and self.density > 0):
            raise ValueError(
                f"Young's modulus {self.youngs_modulus:g} Pa must be from {_SOFTEST:g} to {_HARDEST:g} (give "
                f"it in Pa: 0.65 MPa is 650000) and density {self.density:g} kg/m^3 positive"
            )
        if not -1 < self.poissons_ratio < 0.5:
            raise ValueError(
                f"Poisson's ratio {self.poissons_ratio} is outside (-1, 0.5): an incompressible rubber "
                "needs nu below 0.5, the liquid's volume constraint does the rest"
            )
        if self.poissons_ratio > 0.5 - _LEAST_DIFFERENCE:
            raise ValueError(
                f"Poisson's ratio is 0.5 less {0.5 - self.poissons_ratio:.1g}, too little for double "
                f"precision: pass at most 0.5 - {_LEAST_DIFFERENCE:g}"
            )

    def _check_memory(self):
        try:  # lists, as YAML and JSON give them, become tuples: a material is a key
            object.__setattr__(self, "prony", tuple((float(g), float(tau)) for g, tau in self.prony))
            if self.mullins is not None:
                r, m, beta = (float(v) for v in self.mullins)
                object.__setattr__(self, "mullins", (r, m, beta))
        except (TypeError, ValueError):
            raise ValueError(
                f"prony is {self.prony!r} and mullins {self.mullins!r}: pass ((g, tau), ...) and "
                "(r, m, beta) or None"
            ) from None
        for g, tau in self.prony:
            if not (math.isfinite(g) and g >= 0 and math.isfinite(tau) and tau > 0):
                raise ValueError(
                    f"a Prony term of g {g} and tau {tau} s: g must be >= 0 and tau positive, else energy "
                    "would come from nothing"
                )
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
    def extensions(self) -> tuple[str, ...]:
        """Names of the effects beyond the law: prony, mullins, hysteresis, stiffening."""
        names = ("prony", "mullins", "hysteresis", "stiffening")
        return tuple(name for name in names if getattr(self, name) not in ((), None, 0.0))

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


# Narang et al., ICRA 2021: constants fitted for Isaac Gym ("paper") and for ANSYS ("ansys", on elements that
# do not lock: nu 0.5 there, 0.499 here, whose force is that of 0.4999 to 0.1 % until the skin is compressed
# on the core). "rubber": nu 0.45, as in the reference solutions. "paper" uses linear tetrahedra, since its
# modulus was fitted with their stiffness. "calibrated": FITTED to two real sensors pressed on a plate
# (docs/lab/real_match.md): E 0.56 to 0.75 MPa with all gains 1; the filling was compared with none and twice
# as much; electrode radii of 0.8 and 1.1 mm leave smaller residuals than the film's own 0.5 mm. Neo-Hookean
# with nu 0.45 does not fit better.
PRESETS = {
    "default": Material(),
    "paper": Material(liquid=False, element="linear"),
    "rubber": Material("neo_hookean", 2.80e5, 0.45, 0.186),
    "ansys": Material("neo_hookean", 2.80e5, 0.499, 0.186, element="quadratic"),
    "calibrated": Material(youngs_modulus=6.5e5, rest_pressure=6.3e3, electrode_radius=9e-4),
}


# [m^3] of liquid beyond the volume of the unstressed skin, FITTED to two real sensors pressed on a plate:
# 6.7e-8 to 1.14e-7, depending on sensor and half of the rows (docs/lab/real_match.md, 'The tip'). For
# `SkinOptions.fill_volume`; not the default, since the other constants were fitted without it
CALIBRATED_FILL = 8.0e-8


def material(choice: str | Material) -> Material:
    """Converts the name of a preset, or a Material, to a Material; ValueError names the presets."""
    if isinstance(choice, Material):
        return choice
    check_choice("unknown material", choice, PRESETS, ", or pass a Material")
    return PRESETS[choice]
