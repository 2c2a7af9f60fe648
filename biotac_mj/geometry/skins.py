"""Skins by name, by file, or as objects that a model can refer to."""

import copy
import functools
import hashlib
import os
import pathlib
import tempfile

from biotac_mj.geometry.assets import asset_path
from biotac_mj.geometry.skin_geometry import SkinGeometry

from ..shown import shown

__all__ = ["SKINS", "load_skin", "skin_reference"]

SKINS = ("coarse", "default", "fine")


def load_skin(name_or_path: pathlib.Path | str = "default") -> SkinGeometry:
    """A shipped skin by name ("coarse", "default", "fine"), or one stored as .npz by path.

    Raises:
      FileNotFoundError: no such skin.
      ValueError: the file is not a stored skin, or it is no name.
    """
    if not isinstance(name_or_path, (str, os.PathLike)):
        raise ValueError(
            f"skin is {shown(name_or_path)}: pass one of {', '.join(SKINS)}, or a stored skin's file"
        )
    if name_or_path in SKINS:
        return copy.deepcopy(_shipped(name_or_path))  # each caller may change its own
    return SkinGeometry.load(name_or_path)


@functools.lru_cache(maxsize=len(SKINS))
def _shipped(name):
    """A shipped skin: it is read and checked once a process, since each `attach` asks for it three times."""
    return SkinGeometry.load(asset_path(f"skins/{name}.npz"))


def skin_reference(skin: str | pathlib.Path | SkinGeometry) -> tuple[str, SkinGeometry]:
    """(text, SkinGeometry) of a name, a path or a SkinGeometry; an object is stored in the user's cache,
    named by its content.

    Raises:
      FileNotFoundError, ValueError: no such skin.
    """
    if not isinstance(skin, (SkinGeometry, str, os.PathLike)):
        raise ValueError(
            f"skin is {shown(skin)}: pass one of {', '.join(SKINS)}, a stored skin's file or a SkinGeometry"
        )
    if not isinstance(skin, SkinGeometry):
        text = os.fspath(skin)
        if text.endswith(".npz"):
            text = str(pathlib.Path(text).resolve())
        return text, load_skin(text)
    digest = hashlib.sha256(
        skin.vert.tobytes() + skin.elem.tobytes() + skin.outer_face.tobytes() + skin.fixed.tobytes()
    ).hexdigest()[:16]
    cache = (
        pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
        / "biotac_mj"
        / "skins"
    )
    if not os.access(next(p for p in (cache, *cache.parents) if p.exists()), os.W_OK):
        cache = pathlib.Path(tempfile.gettempdir()) / "biotac_mj_skins"
    path = cache / f"{digest}.npz"
    return str(path if path.exists() else skin.save(path)), skin
