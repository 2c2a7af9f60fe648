"""Heat inside mj_step: what is touched tells itself by TDC and TAC."""

import mujoco
import numpy as np
import pytest
from mechanics import check_repeats

from biotac_mj import attach

PLATE = (-0.009, -0.0133, 0.0)


def pressed(thermal, seconds=0.75, readings=None, depth=1.6e-3):
    """A plate pressed on the pad within 0.25 s; the model, its data and the handle."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.01
    plate = spec.worldbody.add_body(name="plate", mocap=True, pos=PLATE)
    plate.add_geom(name="plate", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.03, 0.005, 0.03])
    handle = attach(
        spec,
        body="world",
        skin="coarse",
        tier="condensed",
        coupling="one-way",
        thermal=thermal,
        options={"readings": {"noise": False} | (readings or {})},
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    for k in range(round(seconds / 0.01)):
        data.mocap_pos[0] = np.add(PLATE, (0, depth * min(1, (k + 1) / 25), 0))
        mujoco.mj_step(model, data)
    return model, data, handle


@pytest.fixture(scope="module")
def steel():
    """A plate of steel, pressed: the model, its data, which stay as they are, and the handle."""
    return pressed({"plate": "steel"})


def test_steel_cools_the_sensor_more_than_foam(steel):
    counts = {}
    for name in ("steel", "foam", None):
        seconds = 0.75 if name else 0.3  # without heat nothing changes after the press
        _, data, handle = steel if name == "steel" else pressed(name and {"plate": name}, seconds)
        counts[name] = [int(handle.read(data, channel)[0]) for channel in ("tac", "tdc")]
        assert handle.read(data, "contact_force")[1] > 3
    assert counts["steel"][0] > counts["foam"][0] + 20 and counts["foam"][0] > counts[None][0]
    # TDC falls where the body cools the sensor
    assert counts["steel"][1] < counts["foam"][1] <= counts[None][1]


def test_a_warm_body_warms(steel):
    _, data, handle = pressed({"plate": {"material": "steel", "temperature": 80}})
    _, cool, _ = steel
    assert handle.read(data, "tac")[0] < 2047 < handle.read(cool, "tac")[0]


def test_a_step_repeated_from_its_state_is_equal_to_the_bit():
    model, data, _ = pressed({"plate": "steel"}, 0.3)
    check_repeats(model, data)


def test_a_cold_sensor_warms_up():
    """Every electrode falls in impedance, so rises in counts, and TDC rises with it."""
    clear = -5e-3  # the plate goes away
    _, data, handle = pressed({}, 0.05, {"cold": True}, clear)
    early = handle.read(data, "electrodes"), handle.read(data, "tdc")
    _, data, handle = pressed({}, 5.0, {"cold": True}, clear)
    late = handle.read(data, "electrodes"), handle.read(data, "tdc")
    assert (late[0] > early[0]).all() and late[1] > early[1] + 30


def test_thermal_is_checked():
    with pytest.raises(ValueError, match="no material is known by 'unobtainium'"):
        pressed({"plate": "unobtainium"})
    with pytest.raises(ValueError, match="no geom 'cup' to touch"):
        pressed({"cup": "glass"})
    with pytest.raises(ValueError, match="cold needs a sensor with heat"):
        pressed(None, 0.01, {"cold": True})
