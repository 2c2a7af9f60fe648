"""Rotations against scipy's and numpy's."""

import numpy as np
from scipy.spatial.transform import Rotation

from biotac_mj.geometry import rigid


def test_against_scipy():
    rng = np.random.default_rng(0)
    vector = np.concatenate([rng.normal(size=(20, 3)), 1e-6 * rng.normal(size=(3, 3)), np.zeros((1, 3))])
    expected = Rotation.from_rotvec(vector)
    mat = expected.as_matrix()
    np.testing.assert_allclose(rigid.rotation(vector), mat, atol=1e-14)
    np.testing.assert_allclose(
        rigid.rotation(1e-5 * vector), Rotation.from_rotvec(1e-5 * vector).as_matrix(), atol=1e-15
    )
    quat = rigid.quaternion(mat)
    np.testing.assert_allclose(rigid.matrix(quat), mat, atol=1e-14)
    np.testing.assert_allclose(rigid.matrix(quat.reshape(4, 6, 4))[1, 2], mat[8], atol=1e-14)
    np.testing.assert_allclose(np.abs(np.roll(expected.as_quat(), 1, axis=1)), np.abs(quat), atol=1e-14)


def test_products_and_directions():
    a, b = np.random.default_rng(1).normal(size=(2, 10, 3))
    np.testing.assert_allclose(rigid.cross(a, b), np.cross(a, b))
    np.testing.assert_allclose((rigid.skew(a) @ b[:, :, None])[..., 0], np.cross(a, b))
    unit = a / np.linalg.norm(a, axis=1, keepdims=True)
    frame = np.stack([unit, *rigid.across(unit)], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (10, 1, 1)), atol=1e-14)
    for direction in (*unit, np.array([0, -1.0, 0])):
        turned = rigid.matrix(rigid.quaternion_from_y(direction)) @ [0, 1, 0]
        np.testing.assert_allclose(turned, direction, atol=1e-14)
