"""Where the shipped meshes are, in a wheel and in a source checkout."""

import importlib.resources
import pathlib

__all__ = ["asset_path"]


def asset_path(name: str) -> pathlib.Path:
    """Path of a shipped asset, for example "skins/default.npz", "core.obj" or "indenters/ring_7mm.obj".

    Raises:
      FileNotFoundError: there is no such asset.
    """
    checkout = pathlib.Path(__file__).parents[2]
    # a checkout uses its own meshes, whatever is installed beside it
    roots = [checkout / "assets"] if (checkout / "pyproject.toml").is_file() else []
    try:
        roots.append(pathlib.Path(str(importlib.resources.files("biotac_mj.assets"))))  # wheel
    except ModuleNotFoundError:
        pass
    for root in roots:
        if (root / name).is_file():
            return root / name
    looked = " and ".join(str(root) for root in dict.fromkeys(roots))
    raise FileNotFoundError(
        f"missing asset {name!r} (looked in {looked}): reinstall biotac_mj, or run `python "
        "scripts/make_assets.py` in a checkout"
    )
