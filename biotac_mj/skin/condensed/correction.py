"""Corrections of the linear skin, fitted to the full FEM (`benchmarks/condensed.py --fit`).

softening  s = (1 + 1 / (H / d + 1 / s_max)) / (1 + q sqrt(w) e^2),  H = h w,  w = 1 + (r / b)^2: factor
           on the displacement by contact forces. The skin wraps around a geom at the depth d, the more the
           smaller the radius of gyration r of the forces is; compressed between geom and core by the
           fraction e of its thickness, rubber stiffens (q > 0).
swelling   c = 1 / (1 + p / (k E)): factor on the displacement by pressure, since the skin is stretched.
"""

import dataclasses
import math
from typing import Any

_TOUCH = 0.01  # compressed fraction of the thickness above which the skin counts as compressed


# for Python and for Warp
def softening_of(depth: Any, spread: Any, squeezed: Any, h: Any, most: Any, width: Any, squeeze: Any) -> Any:
    """s at the largest displacement [m], the mean square spread of the forces [m^2] and the compressed
    fraction; constants as in `Correction`."""
    one = type(depth)(1.0)
    wide = one + spread / (width * width)
    rolls = one + depth * most / (depth + h * wide * most)
    return rolls / (one + squeeze * wide ** type(depth)(0.5) * squeezed * squeezed)


def swelling_of(pressure: Any, modulus: Any, stretch: Any) -> Any:
    """c at a pressure above that without contact, and a Young's modulus [Pa]."""
    one = type(pressure)(1.0)
    return one / (one + max(pressure, type(pressure)(0.0)) / (stretch * modulus))


def is_measured(squeezed: Any, spread: Any, most: Any, narrow: Any) -> bool:
    """Whether the error is known for skin that is compressed by a fraction under forces of this mean square
    spread [m^2]: by at most `most` and, if it is compressed, with a spread of at most `narrow` [m]."""
    wide = squeezed > type(squeezed)(_TOUCH) and spread > narrow * narrow
    return squeezed <= most and not wide


@dataclasses.dataclass(frozen=True)
class Correction:
    """Constants of one material law.

    Attributes:
      depth: h [m]. most: s_max. width: b [m]. stretch: k. squeeze: q.
      poissons_ratio: least and largest Poisson's ratio that was compared with the full FEM.
      squeezed: compressed fraction of the thickness up to which the documented error is valid.
      narrow: spread of the forces on compressed skin up to which it is valid; with a wider spread rubber is
        stiffer than the correction [m].
    """

    depth: float
    most: float
    width: float
    stretch: float
    squeeze: float
    poissons_ratio: tuple = (0.0, 0.0)
    squeezed: float = 0.0
    narrow: float = math.inf

    def measured(self, poissons_ratio: float, squeezed: float, spread: float = 0.0) -> bool:
        """Whether the error was measured and is at most the documented one. squeezed: compressed fraction of
        the thickness. spread: mean square spread of the forces [m^2]."""
        low, high = self.poissons_ratio
        return low <= poissons_ratio <= high and is_measured(squeezed, spread, self.squeezed, self.narrow)


FITTED = {
    "corotational": Correction(6.1e-3, 2.6, 2.8e-3, 0.033, 0.0, (0.25, 0.4), 0.6),
    "neo_hookean": Correction(5.0e-3, 1.8, 2.1e-3, 0.041, 5.3, (0.4, 0.4999), 0.45, 1.5e-3),
    "linear": Correction(math.inf, 1.0, 1.0, math.inf, 0.0, (0.0, 0.4), 1.0),
}


def correction(law: str) -> Correction:
    """Correction of a material law; laws that were not fitted have that of the corotational law, and count as
    not measured."""
    return FITTED.get(law) or dataclasses.replace(
        FITTED["corotational"], poissons_ratio=(0.0, 0.0), squeezed=0.0
    )
