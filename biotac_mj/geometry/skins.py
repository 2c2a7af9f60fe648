"""The skins that come with the package."""

from biotac_mj.geometry.assets import asset_path
from biotac_mj.geometry.skin_geometry import SkinGeometry

__all__ = ["SKINS", "load_skin"]

SKINS = ("coarse", "default", "fine")


def load_skin(name_or_path="default") -> SkinGeometry:
    """A shipped skin by name ("coarse", "default", "fine"), or one stored as .npz by path.

    Raises:
      FileNotFoundError: no such skin.
      ValueError: the file is not a stored skin.
    """
    if name_or_path in SKINS:
        return SkinGeometry.load(asset_path(f"skins/{name_or_path}.npz"))
    return SkinGeometry.load(name_or_path)
