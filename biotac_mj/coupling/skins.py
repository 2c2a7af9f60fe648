"""Skins by name, by file, or as objects that a model can refer to."""

import hashlib
import os
import pathlib
import tempfile

from ..geometry.skin_geometry import SkinGeometry

__all__ = ["load", "reference"]


def load(name) -> SkinGeometry:
    """The skin that a setting names: "coarse", "default", "fine" or a stored file."""
    if pathlib.Path(name).suffix == ".npz":
        return SkinGeometry.load(name)
    from ..geometry import load_skin

    return load_skin(name)


def reference(skin):
    """(text, SkinGeometry) of a name, a path or a SkinGeometry; an object is stored in the user's cache,
    named by its content.

    Raises:
      FileNotFoundError, ValueError: no such skin.
    """
    if not isinstance(skin, SkinGeometry):
        text = os.fspath(skin)
        if text.endswith(".npz"):
            text = str(pathlib.Path(text).resolve())
        return text, load(text)
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
