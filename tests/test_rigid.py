"""Rotations against scipy's and numpy's, motions against MuJoCo's."""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from biotac_mj.geometry import rigid


def test_rotations_equal_those_of_scipy():
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


def test_products_equal_numpy_s_and_frames_are_orthonormal():
    a, b = np.random.default_rng(1).normal(size=(2, 10, 3))
    np.testing.assert_allclose(rigid.cross(a, b), np.cross(a, b))
    np.testing.assert_allclose((rigid.skew(a) @ b[:, :, None])[..., 0], np.cross(a, b))
    unit = a / np.linalg.norm(a, axis=1, keepdims=True)
    frame = np.stack([unit, *rigid.across(unit)], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (10, 1, 1)), atol=1e-14)
    for direction in (*unit, np.array([0, -1.0, 0])):
        turned = rigid.matrix(rigid.quaternion_from_y(direction)) @ [0, 1, 0]
        np.testing.assert_allclose(turned, direction, atol=1e-14)


def test_a_body_that_spins_goes_where_mujoco_takes_it():
    """Without acceleration first, then moved by it: it turns by both at once."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 4e-3, [0, 0, 0]
    body = spec.worldbody.add_body(pos=[0.01, -0.02, 0.005])
    body.add_freejoint()
    body.add_geom(size=[3e-3, 0, 0], mass=1e-3)
    model = spec.compile()
    data, h = mujoco.MjData(model), model.opt.timestep
    data.qvel[:3], data.qvel[3:] = [0.3, 1.0, -0.2], [150.0, -60.0, 200.0]
    data.xfrc_applied[1] = [0.1, 0.05, -0.08, 5e-5, 4e-5, -6e-5]
    mujoco.mj_forward(model, data)
    here, drift, moved = data.xpos[1:].copy(), h * data.qvel, h * h * data.qacc
    assert np.linalg.norm(moved[3:]) > 0.1
    motions = []
    for motion in (drift, moved):
        spin = motion[3:]  # the ball's frame is the world's, now
        motions.append(np.concatenate([motion[:3] - np.cross(spin, here[0]), spin])[None])
    before = rigid.displace(here, data.xmat[1:].reshape(-1, 3, 3).copy(), motions[0])
    pos, mat = rigid.displace(*before, motions[1], here, drift[None, 3:])
    mujoco.mj_step(model, data)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(pos, data.xpos[1:], atol=1e-12)
    np.testing.assert_allclose(mat.ravel(), data.xmat[1], atol=1e-9)
