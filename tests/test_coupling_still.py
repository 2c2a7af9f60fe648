"""A skin whose bodies stay where it was solved is not solved again."""

import dataclasses

import mujoco
import numpy as np
import pytest

import biotac_mj
from biotac_mj.coupling.steppers.condensed import CondensedStepper
from biotac_mj.coupling.steppers.fem import FemStepper

STEPPERS = {"full": FemStepper, "condensed": CondensedStepper}
MASS = 0.1


@pytest.fixture
def solves(monkeypatch):
    """Counts solves of skins."""
    made = []
    for stepper in set(STEPPERS.values()):
        own = stepper.solve_skin
        monkeypatch.setattr(
            stepper, "solve_skin", lambda *a, _own=own, **k: (made.append(0), _own(*a, **k))[1]
        )
    return made


def ball(tier, beside=None, **keywords):
    """A ball that has come to rest on a pad which looks up; its joint is damped. beside: velocity [m/s] along
    z of another one of 3 mm radius without weight, whose middle is 12.5 mm high in the end."""
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_site(name="tip", quat=[1, -1, 0, 0])
    body = spec.worldbody.add_body(name="ball", pos=[-10e-3, 0, 13.2e-3])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], damping=[5.0, 0, 0])
    body.add_geom(name="ball", size=[5e-3, 0, 0], mass=MASS)
    if beside is not None:
        other = spec.worldbody.add_body(name="other", pos=[0, 0, 0.0125 - 0.5 * beside], gravcomp=1)
        other.add_joint(name="other", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
        other.add_geom(name="other", size=[3e-3, 0, 0], mass=0.01, contype=2, conaffinity=0)
    handle = biotac_mj.attach(spec, site="tip", tier=tier, skin="coarse", **keywords)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[1:] = beside or 0.0
    while data.time < 0.5:
        mujoco.mj_step(model, data)
    biotac_mj.plugin.check()
    return model, data, handle


@pytest.mark.parametrize("tier", [pytest.param("full", marks=pytest.mark.slow), "condensed"])
def test_a_skin_under_a_ball_at_rest_is_not_solved_again(tier, solves):
    """Its readings go on; a copy goes on to the same bits; what moves the ball is felt at once."""
    model, data, handle = ball(tier)
    resting = handle.read(data, "contact_force").copy()
    solves.clear()
    for _ in range(20):
        mujoco.mj_step(model, data)
    other = mujoco.MjData(model)
    mujoco.mj_copyData(other, model, data)
    for _ in range(10):
        for one in (data, other):
            mujoco.mj_step(model, one)
    assert not solves
    assert (other.qpos == data.qpos).all() and (other.plugin_state == data.plugin_state).all()
    assert (other.sensordata == data.sensordata).all()
    assert abs(resting[1] - MASS * 9.81) < 1e-4 * MASS * 9.81
    status = handle.read(data, "status")
    assert status[0] == 1 and status[1] == 0 and status[4] == list(STEPPERS).index(tier)
    counts = handle.read(data, "electrodes").copy()
    height = data.qpos[0]
    data.xfrc_applied[model.body("ball").id, 2] = -0.1  # N
    solved_at, before = height, len(solves)
    for _ in range(100):
        mujoco.mj_step(model, data)
        if len(solves) > before:
            solved_at, before = data.qpos[0], len(solves)
        assert abs(data.qpos[0] - solved_at) < 5e-9  # further than this no linear model goes
    assert data.qpos[0] < height - 1e-5
    assert abs(handle.read(data, "contact_force")[1] - MASS * 9.81 - 0.1) < 0.01
    assert (handle.read(data, "electrodes") != counts).any()


def test_a_skin_that_is_asked_for_more_is_solved(solves):
    """Textures want what each contact bears."""
    model, data, _ = ball("condensed", textures={"ball": "cork"})
    solves.clear()
    mujoco.mj_step(model, data)
    assert solves


def test_a_body_that_cannot_touch_a_skin_does_not_have_it_solved(solves):
    """10 nm a step beside a ball at rest, for less than `TOLERANCE`."""
    model, data, _ = ball("condensed", beside=-5e-6, geoms=["ball", "other"])
    solves.clear()
    for _ in range(200):
        mujoco.mj_step(model, data)
    assert len(solves) <= 1


def test_a_body_that_comes_slowly_is_felt_in_time(monkeypatch):
    """0.2 um a step onto the skin, beside a ball at rest: less than `TOLERANCE`, within which the skin of a
    body that cannot touch it stays. Against a skin that is solved for all bodies."""

    def creep():
        model, data, _ = ball("condensed", beside=-4e-3, geoms=["ball", "other"])
        for _ in range(215):
            mujoco.mj_step(model, data)
        data.qvel[1] = -1e-4
        ways = []
        for _ in range(100):
            mujoco.mj_step(model, data)
            ways.append(data.qpos[1])
        assert ways[20] < ways[0] - 3.9e-6 and data.qvel[1] > 0.0  # it comes, and has touched
        return np.array(ways)

    ways, own = creep(), CondensedStepper.solve_skin
    monkeypatch.setattr(
        CondensedStepper, "solve_skin", lambda *a, **k: dataclasses.replace(own(*a, **k), slack=0.0)
    )
    assert np.abs(ways - creep()).max() < 1e-8


def test_a_body_that_the_nail_carries_leaves_the_skin_settled():
    """MuJoCo's contact lifts it, as it comes to rest; the skin does nothing, and owes nothing."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.worldbody.add_site(name="tip", quat=[1, 1, 0, 0])
    body = spec.worldbody.add_body(name="ball", pos=[-10e-3, 0, 9.5e-3])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    body.add_geom(size=[5e-3, 0, 0], mass=0.02)
    handle = biotac_mj.attach(spec, site="tip", skin="coarse")
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(50):
        mujoco.mj_step(model, data)
        assert handle.read(data, "status")[0] == 1.0
    assert handle.read(data, "contact_force")[1] == pytest.approx(-0.02 * 9.81, rel=1e-3)


@pytest.mark.parametrize("height", [10.15e-3, 9.95e-3])
def test_what_only_reads_feels_the_nail_stop_a_body(height):
    """Through it, at the body's speed, the skin below would be pressed by kilonewtons."""
    seen = {}
    for coupling in ("two-way", "one-way"):
        spec = mujoco.MjSpec()
        spec.option.timestep = 0.002
        spec.worldbody.add_site(name="tip", quat=[1, 1, 0, 0])
        body = spec.worldbody.add_body(name="ball", pos=[-9e-3, 0, height])
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
        body.add_geom(size=[5e-3, 0, 0], mass=0.02)
        handle = biotac_mj.attach(spec, site="tip", skin="coarse", readings=False, coupling=coupling)
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qvel[0] = -0.45
        steps = seen[coupling] = []
        for _ in range(8):
            mujoco.mj_step(model, data)
            steps.append(handle.read(data, "contact_force"))
    assert np.abs(seen["two-way"]).max() > 4
    np.testing.assert_allclose(seen["one-way"], seen["two-way"], rtol=1e-9, atol=1e-9)
