"""Paths of shipped files."""

import importlib.resources
import pathlib


def asset_path(name: str) -> pathlib.Path:
    """Path of a shipped asset, for example "skins/default.npz", "core.obj" or "indenters/ring_7mm.obj".

    Raises:
      FileNotFoundError: there is no such asset.
    """
    path = pathlib.Path(str(importlib.resources.files("biotac_mj.assets"))) / name
    if not path.is_file():
        raise FileNotFoundError(
            f"missing asset {name!r} (looked in {path.parent}): reinstall biotac_mj, or run `python "
            "scripts/make_assets.py` in a checkout"
        )
    return path
