"""Motion and readings do not hang on the time step."""

import mujoco
import numpy as np
import pytest

import biotac_mj

SCENE = """<mujoco><option timestep="{timestep}" integrator="{integrator}"/><worldbody>
<site name="fingertip" quat="1 -1 0 0"/><body pos="-0.01 0 {height}">
<joint name="slide" type="slide" axis="0 0 1" range="-1 {up}" limited="true"/>
<geom size="0.005" mass="{mass}"/></body></worldbody></mujoco>"""


def scene(timestep, integrator="implicitfast", height=0.0135, up=1, mass=0.1):
    text = SCENE.format(timestep=timestep, integrator=integrator, height=height, up=up, mass=mass)
    return mujoco.MjSpec.from_string(text)


def forces(timestep, tier, integrator, since=0.0):
    """On a ball of 100 g that falls 0.2 mm onto the pad [N]. since: [s] for which it falls already."""
    spec = scene(timestep, integrator)
    handle = biotac_mj.attach(spec, site="fingertip", skin="coarse", tier=tier, readings="none")
    model = spec.compile()
    data, push = mujoco.MjData(model), []
    data.qpos[0], data.qvel[0] = -0.5 * 9.81 * since**2, -9.81 * since
    while data.time < 0.036:
        mujoco.mj_step(model, data)
        push.append(handle.read(data, "contact_force")[1])
    return np.array(push)


def peak(*args):
    return forces(*args).max()


@pytest.mark.parametrize(
    "tier, integrator", [*(("condensed", name) for name in ("implicitfast", "RK4")), ("full", "Euler")]
)
def test_an_impact_peaks_alike_at_all_time_steps(tier, integrator):
    fine = peak(2.5e-4 if tier == "condensed" else 5e-4, tier, integrator)
    assert fine > 4.5
    for timestep, off in ((1e-3, 0.03), (2e-3, 0.03), (4e-3, 0.1)):
        assert peak(timestep, tier, integrator) == pytest.approx(fine, rel=off)


@pytest.mark.parametrize("timestep, off", [(2e-3, 0.01), (4e-3, 0.03)])
def test_peaks_between_samples_are_alike_wherever_steps_begin(timestep, off):
    """Mean over six phases of the first touch. At 4 ms up to 12 % of a single peak is where samples lie."""
    tops = []
    for phase in np.arange(6) / 6:
        push = forces(timestep, "condensed", "implicitfast", phase * timestep)
        a, b, c = push[push.argmax() - 1 : push.argmax() + 2]
        tops.append(b - (a - c) ** 2 / (8 * (a - 2 * b + c)))  # of the parabola through the highest
    assert np.mean(tops) == pytest.approx(peak(2.5e-4, "condensed", "implicitfast"), rel=off)


def test_a_batch_bounces_as_a_single_ball_does():
    mjw, wp = pytest.importorskip("mujoco_warp"), pytest.importorskip("warp")
    spec = scene(4e-3)
    biotac_mj.batch.add(spec, site="fingertip", skin="coarse")
    model = spec.compile()
    data, most = mujoco.MjData(model), 0.0
    mujoco.mj_forward(model, data)
    with wp.ScopedDevice("cpu"):
        m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=2)
        biotac_mj.batch.attach(model, m, d, tier="condensed", skin="coarse", readings=False)
        at = model.sensor("biotac_contact_force").adr[0] + 1
        for _ in range(9):
            mjw.step(m, d)
            most = np.maximum(most, d.sensordata.numpy()[:, at])
    np.testing.assert_allclose(most, peak(4e-3, "condensed", "implicitfast"), rtol=1e-4)


def loudness(timestep, tier="condensed"):
    """RMS of PAC over three taps of 20 g that a motor moves, ten a second [counts]."""
    spec = scene(timestep, height=0.014, up=0.001, mass=0.02)
    handle = biotac_mj.attach(spec, site="fingertip", skin="coarse", tier=tier, readings={"noise": False})
    model = spec.compile()
    data, pac = mujoco.MjData(model), []
    while data.time < 0.3 - 1e-9:
        data.qfrc_applied[0] = -0.6 if (10 * data.time + 1e-6) % 1 < 0.5 else 0.6
        mujoco.mj_step(model, data)
        pac.append(handle.read(data, "pac").ravel().copy())
    return np.concatenate(pac).std()


def test_taps_are_as_loud_at_all_time_steps():
    fine = loudness(5e-4)
    assert fine > 500
    for timestep in (1e-3, 2e-3, 4e-3):
        assert loudness(timestep) == pytest.approx(fine, rel=0.05)


def test_a_loss_is_of_two_way_contact():
    spec = scene(4e-3)
    with pytest.raises(ValueError, match="loss of options is of coupling='two-way'"):
        biotac_mj.attach(spec, site="fingertip", skin="coarse", coupling="one-way", options={"loss": 0.1})
    with pytest.raises(ValueError, match="loss of options is -1"):
        biotac_mj.attach(spec, site="fingertip", skin="coarse", options={"loss": -1})


def test_runge_kutta_bounces_wherever_a_step_meets_the_skin():
    """30 g that come with 0.5 m/s touch the skin for one or two steps of 4 ms. They would lose more if the
    skin were solved half a step beyond where the ball ends."""

    def leaves(timestep, height):
        spec = scene(timestep, "RK4", height=height, mass=0.03)
        spec.option.gravity = [0, 0, 0]
        biotac_mj.attach(spec, site="fingertip", skin="coarse", tier="condensed", readings=False)
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qvel[0] = -0.5
        while data.time < 0.03 - 1e-9:
            mujoco.mj_step(model, data)
        return data.qvel[0]

    fine = leaves(2.5e-4, 0.0135)
    for height in 0.0131, 0.0136, 0.0141, 0.0146:
        assert 0.75 * fine < leaves(4e-3, height) < 0.5
