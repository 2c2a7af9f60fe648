"""Rigid motions in numpy: rotations as matrices, unit quaternions (w, x, y, z) and rotation vectors [rad],
and poses."""

import typing

import numpy as np
from numpy.typing import ArrayLike

UPRIGHT = np.array([1.0, 0, 0, 0])
Z_TO_Y = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0])  # turns the z axis of a geom to the pressing direction
_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])  # positions of a cross product's factors
_SKEW = np.zeros((3, 9))
for _i, (_j, _k) in enumerate(zip(_NEXT, _AFTER)):
    _SKEW[_i, 3 * _k + _j], _SKEW[_i, 3 * _j + _k] = 1.0, -1.0
_EYE, _DIAGONAL, _TINY = np.eye(3), np.array([0, 4, 8]), np.finfo(float).tiny


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (n, 3) of (n, 3) and (n, 3); faster than np.cross for a few vectors."""
    # fancy indexing would take twice as long
    return a.take(_NEXT, 1) * b.take(_AFTER, 1) - a.take(_AFTER, 1) * b.take(_NEXT, 1)


def skew(vector: ArrayLike) -> np.ndarray:
    """Skew matrices (..., 3, 3) of (..., 3): skew(a) @ b = a x b."""
    vector = np.asarray(vector, dtype=float)
    return (vector @ _SKEW).reshape(*vector.shape, 3)


def rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3) (Rodrigues). scipy's function makes ten times as
    many calls, which matters in every `mj_step`."""
    angle2 = (vector * vector).sum(axis=1)[:, None, None]
    k = skew(vector)
    if angle2.max(initial=0.0) < 1e-8:  # the series to the fourth order: exact to rounding
        return _EYE + (1.0 - angle2 / 6) * k + (0.5 - angle2 / 24) * (k @ k)
    angle = np.sqrt(np.maximum(angle2, _TINY))
    half = np.sin(0.5 * angle) / angle
    return _EYE + np.sin(angle) / angle * k + 2.0 * half * half * (k @ k)


def matrix(quat: ArrayLike) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    quat = np.asarray(quat, dtype=float)
    return np.stack(matrix_entries(*np.moveaxis(quat, -1, 0)), axis=-1).reshape(*quat.shape[:-1], 3, 3)


def matrix_entries(w: typing.Any, x: typing.Any, y: typing.Any, z: typing.Any) -> list:
    """The nine entries, row by row, of the rotation matrix of a unit quaternion, in arrays or tensors."""
    return [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]


def quaternion(mat: ArrayLike) -> np.ndarray:
    """Unit quaternions (..., 4) of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(mat).as_quat(scalar_first=True)


def unit(vector: ArrayLike) -> np.ndarray:
    """Unit vector (n,) of a vector (n,) of any length above 0, also if its square overflows."""
    vector = np.asarray(vector, dtype=float)
    vector = vector / np.abs(vector).max()
    return vector / np.linalg.norm(vector)


def quaternion_from_y(direction: np.ndarray) -> np.ndarray:
    """Quaternion (4,) of the smallest rotation from +y to a unit vector (3,)."""
    quat = np.array([1 + direction[1], direction[2], 0.0, -direction[0]])
    return quat / np.linalg.norm(quat) if np.linalg.norm(quat) > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])


def across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) perpendicular to unit vectors (n, 3) and to each other."""
    first = np.cross(direction, np.where(np.abs(direction[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(direction, first)


def displacement(pos: np.ndarray, mat: np.ndarray, pos0: np.ndarray, mat0: np.ndarray) -> np.ndarray:
    """Small motions (n, 6) (translation of the point at the origin, rotation vector) from poses pos0 (n, 3),
    mat0 (n, 3, 3) to pos, mat."""
    turn = (mat @ mat0.transpose(0, 2, 1)).reshape(-1, 9)
    vector = 0.5 * (turn @ _SKEW.T)  # axis times sine of the angle
    sine = np.sqrt((vector * vector).sum(axis=1))
    if sine.max(initial=0.0) > 1e-5:
        angle = np.arctan2(sine, 0.5 * (turn.take(_DIAGONAL, 1).sum(axis=1) - 1))
        vector = vector * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None]
    return np.concatenate([pos - pos0 - cross(vector, pos0), vector], axis=1)


def displace(
    pos: np.ndarray,
    mat: np.ndarray,
    motion: np.ndarray,
    here: np.ndarray | None = None,
    spin: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses after small motions (n, 6), the inverse of `displacement`. Reference points move along straight
    lines, as MuJoCo moves rotating bodies; `here` (n, 3) are these points where the motions were measured, by
    default pos. `spin` (n, 3) are rotation vectors that mat contains already: bodies rotate by the sum of
    both, which differs from two rotations in sequence."""
    arm = pos if here is None else here
    turn = motion[:, 3:]
    if spin is not None:
        turn, mat = spin + turn, rotation(-spin) @ mat
    return pos + motion[:, :3] + cross(motion[:, 3:], arm), rotation(turn) @ mat


def rigid_motions(x: np.ndarray, size: int) -> np.ndarray:
    """Derivative (size, 6) of the coordinates of points x (n, 3) of a rigid body with respect to its
    translation and rotation vector; zero after the first 3 n rows."""
    out = np.zeros((size, 6))
    motion = out[: 3 * len(x)].reshape(-1, 3, 6)
    motion[:, :, :3] = np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        motion[:, i, 3 + j], motion[:, i, 3 + k] = x[:, k], -x[:, j]
    return out
