"""The four bodies that Narang et al. (ICRA 2021) compared, as skins with options."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..fields import check_choice
from ..geometry.assets import asset_path
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.skins import load_skin
from ..skin.model import SkinOptions


@dataclasses.dataclass(frozen=True)
class Configuration:
    """One of the four configurations.

    Attributes:
      name: as in CONFIGURATIONS.
      geometry: the body, in the BioTac frame.
      options: how it is solved; never with liquid, which the paper's model did not have.
      modulus: factors on Young's modulus of its elements, see `SkinModel`, or None.
    """

    name: str
    geometry: SkinGeometry
    options: SkinOptions
    modulus: np.ndarray | Callable | None = None


# Mesh of the body (None: the skin's mesh) and whether the inner surface can touch the rigid core. All are
# fixed at nail and clamp plate. The shells are also fixed where they are bonded to the core;
# `solid_with_core` is bonded to all of it, `solid` replaces it.
CONFIGURATIONS = {
    "deformable_shell": (None, False),
    "shell_with_core": (None, True),
    "solid_with_core": ("solid_with_core", False),
    "solid": ("solid", False),
}


def configuration(
    name: str, skin: str = "coarse", modulus: np.ndarray | Callable | None = None, **options: object
) -> Configuration:
    """One of the paper's four configurations.

    Args:
      name: of CONFIGURATIONS.
      skin: resolution; shells exist as "coarse", "default", "fine" or a file, solids as "coarse" only.
      modulus: factors on Young's modulus of the body's elements (nelem,), or a function of positions.
      options: further SkinOptions; `liquid=True` for shells only.

    Raises:
      ValueError: unknown name, a solid of another resolution, or a solid with liquid.
    """
    check_choice("unknown configuration", name, CONFIGURATIONS)
    body, core = CONFIGURATIONS[name]
    options = SkinOptions(**{"liquid": False, "core_contact": core, **options})
    if body is None:
        return Configuration(name, load_skin(skin), options, modulus)
    if options.liquid:
        raise ValueError(
            f"configuration {name!r} has no space for a liquid: take a shell, or leave the liquid out"
        )
    if skin != "coarse":
        raise ValueError(
            f"configuration {name!r} comes with the coarse mesh only, not {skin!r}: "
            "make others with scripts/make_solids.py"
        )
    return Configuration(name, SkinGeometry.load(asset_path(f"skins/{body}_coarse.npz")), options, modulus)
