"""Files that are written whole or not at all, and the versions of what wrote them."""

import contextlib
import os
import pathlib
import tempfile

import numpy as np

__all__ = ["replacing", "versions"]


@contextlib.contextmanager
def replacing(path):
    """Gives a temporary path with the same ending in the same folder; renames it to `path` if all went well,
    else removes it."""
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=path.suffix)
    os.close(handle)
    try:
        yield pathlib.Path(temporary)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def versions() -> dict:
    """Versions of what computed the press."""
    import mujoco
    import warp

    from . import __version__

    return {
        "biotac-mj": __version__,
        "mujoco": mujoco.__version__,
        "warp-lang": warp.__version__,
        "numpy": np.__version__,
    }
