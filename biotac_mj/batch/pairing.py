"""mujoco_warp is MuJoCo's step of one version, written once more: the two go together by their version."""

import importlib.metadata

import mujoco

__all__ = ["refuse_other_version"]


def refuse_other_version() -> None:
    """Nothing without mujoco_warp: `make` and `PoseBatch` do not need it.

    Raises:
      ImportError: mujoco and mujoco_warp are of different major versions; pip lets them stand side by side.
    """
    try:
        beside = importlib.metadata.version("mujoco-warp")
    except importlib.metadata.PackageNotFoundError:
        return
    major = int(mujoco.__version__.split(".")[0])
    if int(beside.split(".")[0]) != major:
        raise ImportError(
            f"mujoco {mujoco.__version__} stands beside mujoco-warp {beside}, which steps as another MuJoCo "
            f"does: pip install 'mujoco-warp>={'3.17' if major == 3 else major},<{major + 1}'",
            name="mujoco_warp",
        )
