"""Where the shipped meshes are, in a wheel and in a source checkout."""

import importlib.resources
import pathlib

__all__ = ["asset_path"]


def asset_path(name: str) -> pathlib.Path:
    """Path of a shipped asset, for example "skins/default.npz", "core.obj" or "indenters/ring_7mm.obj".

    Raises:
      FileNotFoundError: there is no such asset.
    """
    roots = [pathlib.Path(__file__).parents[2] / "assets"]  # source checkout and editable install
    try:
        roots.insert(0, pathlib.Path(str(importlib.resources.files("biotac_mj.assets"))))  # wheel
    except ModuleNotFoundError:
        pass
    for root in roots:
        if (root / name).is_file():
            return root / name
    looked = " and ".join(str(root) for root in dict.fromkeys(roots))
    raise FileNotFoundError(
        f"missing asset {name!r} (looked in {looked}): reinstall biotac_mj, or run `python scripts/make_assets.py` in a checkout"
    )
