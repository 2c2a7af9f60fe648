"""The test double itself: its tangent is the derivative of its wrench."""

import numpy as np
import spring_skin

from biotac_mj.coupling import Config, Geom
from biotac_mj.geometry.rigid import displace


def test_tangent_is_the_derivative_of_the_wrench():
    geom = Geom("box", "box", np.array([0.05, 0.005, 0.05]), 0.5, 0)
    skin = spring_skin.SpringSkin(
        Config(stepper="springs", options={"stiffness": 1e3}), spring_skin.pad_geometry(), [geom]
    )
    state = np.zeros(skin.nstate)
    skin.reset(state)
    pos, mat = np.array([[-0.01, spring_skin.HEIGHT - 0.0049, 0.0]]), np.eye(3)[None]
    state = skin.solve_skin(state, pos, mat, 1e-3).state
    result = skin.solve_skin(state, pos, mat, 1e-3)
    for i in range(6):
        step = np.zeros((1, 6))
        step[0, i] = 1e-7
        plus = skin.solve_skin(state, *displace(pos, mat, step), 1e-3).wrench[0]
        minus = skin.solve_skin(state, *displace(pos, mat, -step), 1e-3).wrench[0]
        # frictionless turning changes the normals, which the tangent leaves out: a few percent for the
        # rotations
        np.testing.assert_allclose(
            -(plus - minus) / 2e-7,
            result.tangent[0][:, i],
            rtol=0.02,
            atol=0.02 * abs(result.tangent[0][:, i]).max(),
        )
