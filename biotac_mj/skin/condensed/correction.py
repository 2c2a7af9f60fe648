"""What a skin does differently from a linear one, in three numbers: fitted to the full FEM
(`benchmarks/condensed.py --fit`).

softening  s = (1 + 1 / (H / d + 1 / s_max)) / (1 + q sqrt(w) e^2),  H = h w,  w = 1 + (r / b)^2: contact
           forces move the skin by s times as much.
           Skin rolls around what is pressed into it by d, the more so the less its forces are spread (by r,
           their radius of gyration); squeezed between geom and core by the share e of its thickness, rubber
           stiffens (q > 0).
swelling   c = 1 / (1 + p / (k E)): pressure moves the skin by c times as much. It is stretched.
"""

import dataclasses
import math

__all__ = ["FITTED", "Correction", "correction"]

_TOUCH = 0.01  # squeezed share from which on the skin counts as squeezed


@dataclasses.dataclass(frozen=True)
class Correction:
    """Constants of one material law.

    Attributes:
      depth: h [m]. most: s_max. width: b [m]. stretch: k. squeeze: q.
      poissons_ratio: least and largest Poisson's ratio that was compared with the full FEM.
      squeezed: up to which share of its thickness the skin may be squeezed until the error exceeds what the
        docs state.
      narrow: how far the forces of squeezed skin may be spread: wider, rubber is stiffer than the correction
        knows [m].
    """

    depth: float
    most: float
    width: float
    stretch: float
    squeeze: float
    poissons_ratio: tuple = (0.0, 0.0)
    squeezed: float = 0.0
    narrow: float = math.inf

    def softening(self, depth: float, spread: float, squeezed: float) -> float:
        """s at the largest displacement [m], the mean square spread of the forces [m^2] and the squeezed
        share."""
        wide = 1 + spread / self.width**2
        h = self.depth * wide
        return (1 + depth * self.most / (depth + h * self.most)) / (
            1 + self.squeeze * math.sqrt(wide) * squeezed**2
        )

    def swelling(self, pressure: float, youngs_modulus: float) -> float:
        """c at a pressure above that at rest [Pa]."""
        return 1 / (1 + max(pressure, 0.0) / (self.stretch * youngs_modulus))

    def measured(self, poissons_ratio: float, squeezed: float, spread: float = 0.0) -> bool:
        """Whether the error has been measured there and is not worse than the docs state; arguments as in
        `softening`."""
        low, high = self.poissons_ratio
        wide = squeezed > _TOUCH and spread > self.narrow**2
        return low <= poissons_ratio <= high and squeezed <= self.squeezed and not wide


FITTED = {
    "corotational": Correction(6.1e-3, 2.6, 2.8e-3, 0.033, 0.0, (0.25, 0.4), 0.5),
    "neo_hookean": Correction(5.0e-3, 1.8, 2.1e-3, 0.041, 5.3, (0.4, 0.4999), 0.45, 1.5e-3),
    "linear": Correction(math.inf, 1.0, 1.0, math.inf, 0.0, (0.0, 0.4), 1.0),
}


def correction(law: str) -> Correction:
    """Of a material law; those that were not fitted have that of the corotational one and count as not
    measured."""
    return FITTED.get(law) or dataclasses.replace(
        FITTED["corotational"], poissons_ratio=(0.0, 0.0), squeezed=0.0
    )
