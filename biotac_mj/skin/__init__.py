"""The skin: finite elements in Warp."""

from ..quiet import quiet_warp
from . import fill  # noqa: F401  it registers itself in `model`
from .contact.law import ContactLaw
from .contact.meshes import bake_distance_grid
from .data import SkinData
from .geoms import GeomSet
from .model import SkinModel, SkinOptions
from .rubber.material import PRESETS, Material, material
from .step import launch_step, prepare_step, step

quiet_warp()

__all__ = [
    "PRESETS",
    "ContactLaw",
    "GeomSet",
    "Material",
    "SkinData",
    "SkinModel",
    "SkinOptions",
    "bake_distance_grid",
    "launch_step",
    "material",
    "prepare_step",
    "step",
]
