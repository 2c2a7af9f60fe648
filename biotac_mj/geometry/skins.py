"""Loads skins by name or file, and stores SkinGeometry objects so that a model can refer to them."""

import copy
import dataclasses
import functools
import os
import pathlib
import tempfile

import numpy as np

from biotac_mj.geometry.assets import asset_path
from biotac_mj.geometry.design import BIOTAC, DESIGNS, Design, designs, read_design
from biotac_mj.geometry.skin_geometry import SkinGeometry

from ..cache import cache_folder, digest
from ..short_repr import short_repr

SKINS = ("coarse", "default", "fine")  # of every shipped design
_SHIPPED = (*SKINS, *(f"{design}/{name}" for design in DESIGNS[1:] for name in SKINS))


def load_skin(name_or_path: pathlib.Path | str = "default") -> SkinGeometry:
    """A shipped skin by name ("coarse", "default", "fine"; of another design "biotac_sp/coarse"), or one
    stored as .npz by path, that of a design by its folder.

    Raises:
      FileNotFoundError: no such skin.
      ValueError: the file is not a stored skin, or the name is unknown.
    """
    return copy.deepcopy(_loaded(name_or_path))  # callers may change their copy


def _loaded(name_or_path):
    """The skin of `load_skin`, cached in the process: each `attach` loads it three times, and each
    `Handle.read` takes its design."""
    if not isinstance(name_or_path, (str, os.PathLike)):
        raise ValueError(
            f"skin is {short_repr(name_or_path)}: pass one of {', '.join(SKINS)}, or a stored skin's file"
        )
    return _read(name_or_path, file_state(name_or_path))


def file_state(name_or_path: pathlib.Path | str) -> tuple:
    """Tells a stored skin from a later one of this path; () for a shipped skin."""
    if name_or_path in _SHIPPED:
        return ()
    path = _file(name_or_path)
    files = [file.stat() for file in (path, path.parent / "design.json") if file.exists()]
    return tuple((f.st_ino, f.st_mtime_ns, f.st_size) for f in files)


@functools.lru_cache(maxsize=2 * len(_SHIPPED))
def _read(name_or_path, state):
    """A skin from its file; state: tells a stored one from later ones of this path. The sensors of a design
    are those of the folder's design.json, where users write theirs."""
    path = _file(name_or_path)
    geometry, folder = SkinGeometry.load(path), path.parent
    if name_or_path in _SHIPPED or not (folder / "design.json").is_file():
        return geometry
    design, stored = read_design(folder), geometry.design
    if dataclasses.replace(design, sensors=stored.sensors, sensor=stored.sensor) != stored:
        raise ValueError(
            f"{folder / 'design.json'} is not the design that {path.name} was made of: change its sensors "
            "alone, or make it anew with `biotac design new`"
        )
    return dataclasses.replace(geometry, design=design)


def _file(name_or_path):
    """The file of a shipped or a stored skin, of a folder made by `biotac design new` the one in it."""
    if name_or_path in _SHIPPED:
        folder, _, mesh = name_or_path.rpartition("/")
        return asset_path(f"designs/{folder}/{mesh}.npz" if folder else f"skins/{mesh}.npz")
    path = pathlib.Path(name_or_path)
    return path / "default.npz" if (path / "design.json").is_file() else path


def design_of(skin: pathlib.Path | str | SkinGeometry) -> Design:
    """Design of a skin, given as for `load_skin` or `skin_reference`."""
    return skin.design if isinstance(skin, SkinGeometry) else _loaded(skin).design


def shipped_skin(design: Design, mesh: str = "default") -> str:
    """Name of a shipped design's skin, for `load_skin`."""
    return mesh if design == BIOTAC else f"{design.name}/{mesh}"


def mesh_of_same_design(skin: pathlib.Path | str | SkinGeometry, mesh: str) -> pathlib.Path | str:
    """A mesh of a skin's design by its name, for `load_skin`; the skin itself where the design is not shipped
    and has one mesh."""
    design = design_of(skin)
    if design in designs():
        return shipped_skin(design, mesh)
    return skin_reference(skin)[0] if isinstance(skin, SkinGeometry) else skin


def skin_of_design(
    design: str | pathlib.Path | None, mesh: str | pathlib.Path | SkinGeometry | None
) -> str | pathlib.Path | SkinGeometry:
    """The argument of `skin_reference` for a design's name or folder and an optional mesh.

    Raises:
      FileNotFoundError, ValueError: no such design, or the mesh is of another one.
    """
    if design is None:
        return "default" if mesh is None else mesh
    wanted = read_design(design)
    if mesh is None or (isinstance(mesh, str) and mesh in SKINS):
        name = "default" if mesh is None else mesh
        if design in DESIGNS:
            return shipped_skin(wanted, name)
        return pathlib.Path(design) / f"{name}.npz"
    if design_of(mesh) != wanted:
        raise ValueError(
            f"the skin is one of {design_of(mesh).title} and the design {wanted.title}: leave one of them out"
        )
    return mesh


def place_of(geometry: SkinGeometry, of_finger: tuple[float, float] = (-12e-3, 0.0)) -> tuple[float, float]:
    """Location, x [m] and angle about the finger [rad], of a press whose place is not given: `of_finger` on a
    finger with a cylindrical core, such as a BioTac; the middle of a pad on a flat backing."""
    if geometry.design.radius is not None:
        return of_finger
    x = geometry.vert[geometry.outer_face][..., 0]
    return float(x.min() + x.max()) / 2, 0.0


def skin_reference(skin: str | pathlib.Path | SkinGeometry) -> tuple[str, SkinGeometry]:
    """(text, SkinGeometry) of a name, a path or a SkinGeometry; an object is stored in the user's cache,
    under a digest of its content.

    Raises:
      FileNotFoundError, ValueError: no such skin. OSError: it cannot be stored anywhere.
    """
    if not isinstance(skin, (SkinGeometry, str, os.PathLike)):
        raise ValueError(
            f"skin is {short_repr(skin)}: pass one of {', '.join(SKINS)}, a stored skin's file or a "
            "SkinGeometry"
        )
    if not isinstance(skin, SkinGeometry):
        text = os.fspath(skin)
        if text not in _SHIPPED and _file(text).suffix == ".npz":
            text = str(_file(text).resolve())
        return text, load_skin(text)
    skin.check(repr(skin.name))
    return str(_stored(skin)), skin


def _stored(skin):
    """The file of a skin, in a folder of the cache that is never pruned, since saved models refer to it; in
    the folder for temporary files if the cache cannot be written."""
    name = f"{digest(skin)}.npz"
    for folder in (cache_folder(), pathlib.Path(tempfile.gettempdir()) / "biotac_mj"):
        path = folder / "skins" / name
        try:
            return path if _holds(path, skin) else skin.save(path)
        except OSError as error:
            failed = error
    raise failed


def _holds(path, skin):
    """Whether a file exists and has this skin, bit for bit."""
    try:
        found = SkinGeometry.load(path)
        names = (field.name for field in dataclasses.fields(skin))
        return all(np.array_equal(getattr(found, name), getattr(skin, name)) for name in names)
    except (OSError, ValueError):
        return False
