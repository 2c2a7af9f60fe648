"""The test double itself: its tangent is the derivative of its wrench."""

import numpy as np
import pytest
import spring_skin

from biotac_mj.coupling import Config, Geom, register_stepper
from biotac_mj.coupling.stepper import make_stepper
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


def test_a_skin_derives_from_the_base_class():
    class Other:
        def __init__(self, config, geometry, geoms):
            pass

    register_stepper("other", Other)
    with pytest.raises(ValueError, match="stepper 'other' makes Other: derive it from .*SkinStepper"):
        make_stepper(Config(stepper="other"), spring_skin.pad_geometry(), [])
    made = make_stepper(Config(stepper="springs"), spring_skin.pad_geometry(), [])
    state = np.ones(made.nstate)
    assert made.key(state) == state.tobytes() and made.came_to(state) is None
    assert not made.resting(state) and made.pressure(state) is None and made.put(state, *[None] * 3) is None
