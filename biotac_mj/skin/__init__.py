"""The skin: finite elements in Warp."""

from .contact_law import ContactLaw
from .data import SkinData
from .geoms import GeomSet
from .material import PRESETS, Material, material
from .model import SkinModel, SkinOptions
from .shapes import bake_distance_grid
from .solver import step

__all__ = [
    "PRESETS",
    "ContactLaw",
    "GeomSet",
    "Material",
    "SkinData",
    "SkinModel",
    "SkinOptions",
    "bake_distance_grid",
    "material",
    "step",
]
