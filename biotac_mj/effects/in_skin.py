"""Constitutive effects inside the finite elements instead of on the resulting forces: changes of a skin's
material, contact, model and film.

`docs/lab/discrepancy.md` says how much the reduced forms differ."""

import dataclasses
import typing
from collections.abc import Callable

import numpy as np

if typing.TYPE_CHECKING:
    from ..geometry.skin_geometry import SkinGeometry
    from ..skin import Material
    from ..skin.model import SkinOptions


# measured by benchmarks/discrepancy_in_skin_maps.py on presses of the coarse skin (docs/lab/memory.md):
# apparent c2 of the force over the stiffening c2 / c1 of the rubber,
_STIFFENING = (-120, -40, -12, -4, -1, 0, 1, 4, 12, 40, 120, 400, 1000)
_C2 = (
    *(-0.7168, -0.3972, -0.1518, -0.0522, -0.0131, 0.0),
    *(0.0128, 0.0470, 0.1197, 0.2990, 0.6382, 1.3962, 2.4646),
)
# and, for widths of the hysteresis [m], the strain of slip of a friction branch and its modulus over the
# fraction
_WIDTH = (0.05e-3, 0.1e-3, 0.2e-3, 0.3e-3, 0.4e-3, 0.6e-3)
_STRAIN = (0.00030, 0.00105, 0.00319, 0.00436, 0.00683, 0.01297)
_BRANCH = (41.20, 12.36, 4.95, 3.86, 2.77, 1.81)


class Inside(typing.NamedTuple):
    """Changes inside the skin: of its `Material`, of its `SkinOptions` (the contact), arguments of its
    `SkinModel`, the liquid's `loss` [1/h], the fraction of it lost `before`, and the `power` of its film's
    conductance; and `rest`, the effects [(Effect, theta)] that act outside the skin."""

    material: dict
    contact: dict
    model: dict
    film: dict
    rest: list

    def rubber(self, material: "Material") -> "Material":
        """The material with these changes, in addition to the memory and the stiffening it has already."""
        more = {n: self.material[n] for n in ("prony", "hysteresis", "stiffening") if n in self.material}
        own = {name: getattr(material, name) + one for name, one in more.items()}
        return dataclasses.replace(material, **self.material | own)

    def options(self, options: "SkinOptions") -> "SkinOptions":
        """The skin's options with these changes of the contact; the rest of its contact law stays."""
        from ..skin.contact.law import ContactLaw

        changes = dict(self.contact)
        if "contact_law" in changes:
            law = options.contact_law or ContactLaw()
            changes["contact_law"] = dataclasses.replace(law, **changes["contact_law"])
        if "tolerance" in changes:
            changes["tolerance"] = min(changes["tolerance"], options.tolerance)
        return dataclasses.replace(options, **changes)


def memory_of(effects: list) -> Inside:
    """Changes of a skin that models effects [(Effect, theta)] inside."""
    inside = Inside({"prony": ()}, {}, {}, {}, [])
    for effect, theta in effects:
        if not effect.in_skin(inside, theta):
            inside.rest.append((effect, theta))
    return inside


def moduli(
    given: np.ndarray | Callable | None, more: Callable | None, geometry: "SkinGeometry"
) -> np.ndarray | Callable | None:
    """Factors on the modulus of each element: `given` (nelem,), a function of positions or None, times the
    function `more`; `given` if that is None."""
    if more is None:
        return given
    at = geometry.vert[geometry.elem[:, :4]].mean(1)
    own = given(at) if callable(given) else given
    return np.asarray(more(at) if own is None else own * more(at), float)


def stiffening(c2: float, already: float) -> float:
    """Ratio c2 / c1 of rubber whose force stiffens by the apparent `c2` more than that of rubber with the
    ratio `already`."""
    return float(np.interp(c2 + np.interp(already, _STIFFENING, _C2), _C2, _STIFFENING))


def friction_branch(fraction: float, width: float) -> tuple[float, float]:
    """Modulus, as a fraction, and strain of slip of the friction branch whose loops have a fraction over a
    width [m] of depth."""
    strain, ratio = (
        np.exp(np.interp(np.log(width), np.log(_WIDTH), np.log(table))) for table in (_STRAIN, _BRANCH)
    )
    return float(ratio * fraction), float(strain)
