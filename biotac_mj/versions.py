"""Versions of the packages that computed a result, which are stored with it."""

import numpy as np


def versions() -> dict:
    """Name of the package -> version."""
    import mujoco
    import warp

    from . import __version__

    return {
        "biotac-mj": __version__,
        "mujoco": mujoco.__version__,
        "warp-lang": warp.__version__,
        "numpy": np.__version__,
    }
