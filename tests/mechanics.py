"""What any step of MuJoCo must keep: momentum, and the state from which it is repeated."""

import mujoco
import numpy as np


def momentum(model, data):
    """Linear (3,) and angular (3,) momentum of all bodies about the world's origin."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    linear, angular = np.zeros(3), np.zeros(3)
    for b in range(1, model.nbody):
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, b, velocity, 0)
        axes = data.ximat[b].reshape(3, 3)
        linear += model.body_mass[b] * velocity[3:]
        angular += np.cross(data.xipos[b], model.body_mass[b] * velocity[3:]) + axes @ (
            model.body_inertia[b] * (axes.T @ velocity[:3])
        )
    return linear, angular


def check_repeats(model, data, steps=5):
    """Steps repeated from a state are equal to the bit, in sensordata and plugin_state."""
    saved = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, saved, mujoco.mjtState.mjSTATE_INTEGRATION)
    rows = []
    for _ in range(2):
        mujoco.mj_setState(model, data, saved, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_step(model, data, steps)
        rows.append((data.sensordata.copy(), data.plugin_state.copy()))
    assert (rows[0][0] == rows[1][0]).all() and (rows[0][1] == rows[1][1]).all()
