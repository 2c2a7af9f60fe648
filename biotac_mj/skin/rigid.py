"""Rigid motions of a body that touches the skin: translations, and rotations about the origin."""

import numpy as np

__all__ = ["rigid_motions"]


def rigid_motions(x: np.ndarray, size: int) -> np.ndarray:
    """Motion (size, 6) of the coordinates of points x (n, 3) per translation and rotation vector of a body
    that holds them; zero in what follows the first 3 n rows."""
    out = np.zeros((size, 6))
    motion = out[: 3 * len(x)].reshape(-1, 3, 6)
    motion[:, :, :3] = np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        motion[:, i, 3 + j], motion[:, i, 3 + k] = x[:, k], -x[:, j]
    return out
