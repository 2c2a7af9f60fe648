"""The force that a BioTac reports is the force that acted: what it took from a free body's momentum, in every
step, settled or not, of skin and solid parts together."""

import mujoco
import numpy as np
import pytest
import spring_skin

import biotac_mj
from biotac_mj import plugin

PAD_UP = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
NAIL_UP = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
TOP = 8.31e-3  # of the pad over the finger's axis [m]
G = 9.81
SPRINGS = dict(skin=spring_skin.pad_geometry(15), stepper="springs", options={"stiffness": 300.0})
CONDENSED = dict(skin="coarse", tier="condensed")


@pytest.fixture(autouse=True)
def no_errors():
    plugin.clear_errors()
    yield
    plugin.check()


def scene(geom, height, timestep, integrator="Euler", gravity=0.0, finger="", quat=PAD_UP, **settings):
    """A body that is free over a finger."""
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" integrator="{integrator}" gravity="0 0 {gravity}"/>'
        f'<worldbody><body name="finger">{finger}</body>'
        f'<body name="thrown" pos="0 0 {height}"><freejoint/><geom {geom}/></body></worldbody></mujoco>'
    )
    handle = biotac_mj.attach(spec, body="finger", quat=quat, pos=[6.2e-3, 0, 0], readings="none", **settings)
    model = spec.compile()
    return model, mujoco.MjData(model), handle


def force_on_body(data, handle):
    """(3,) in the world."""
    return -data.body(handle.body).xmat.reshape(3, 3) @ handle.read(data, "contact_force")[:3]


def steps(model, data, handle, count):
    """Of each step what the finger took per time from the thrown body's momentum (3,) [N], what it reports,
    and status."""
    body = model.body("thrown")
    at, mass = slice(body.dofadr[0], body.dofadr[0] + 3), body.mass[0]
    for _ in range(count):
        before = data.qvel[at].copy()
        mujoco.mj_step(model, data)
        took = mass * ((data.qvel[at] - before) / model.opt.timestep - model.opt.gravity)
        yield took, force_on_body(data, handle), handle.read(data, "status")


def assert_told(rows, floor=1e-9):
    for took, told, _ in rows:
        assert np.linalg.norm(took - told) <= 1e-9 * np.linalg.norm(took) + floor


@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast"])
def test_a_skin_that_withholds_its_push_reports_what_is_left(integrator):
    """A light body that is pressed in and let go, when of the skin is forgotten what was put into it."""
    geom = 'type="box" size=".01 .01 .002" mass=".02" friction="1"'
    model, data, handle = scene(geom, TOP + 0.002, 0.001, integrator, -G, skin="coarse", tier="condensed")
    data.body("thrown").xfrc_applied[2] = -2.0
    mujoco.mj_step(model, data, 20)
    data.body("thrown").xfrc_applied[2] = 0.0
    data.plugin_state[3 + 66] = 0.0  # after the head: the energy that the body has in the skin [J]
    rows = list(steps(model, data, handle, 3))
    assert any(status[7] > 0 for *_, status in rows)
    assert_told(rows)


@pytest.mark.law
@pytest.mark.parametrize(
    "integrator, tier, speed",
    [pytest.param("Euler", "full", 2.22, marks=pytest.mark.slow), ("implicit", "condensed", 2.2)],
)
def test_a_step_that_does_not_settle_reports_what_acted(integrator, tier, speed):
    """A light body that hits at 2 m/s, rolls and sticks by turns, at a long step."""
    geom = 'type="ellipsoid" size=".004 .009 .006" mass=".0017" friction="1"'
    how = {"skin": "coarse", "tier": tier, "options": {"rounds": 1}}
    model, data, handle = scene(geom, TOP + 0.0062, 0.005, integrator, -G, **how)
    data.qvel[:] = [0.6, 0.3, -speed, 15, 24, 60]
    rows = list(steps(model, data, handle, 6))
    assert any(status[0] == 0 and np.linalg.norm(told) > 1e-3 for _, told, status in rows)
    assert_told(rows)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_a_stiffness_that_rows_cannot_hold_does_not_act(integrator):
    """A cylinder whose tangent has a negative direction at a rim: of all that the model has rows hold what is
    positive."""
    model, data, handle = scene(
        'type="cylinder" size=".00463 .00576" mass=".010567" friction=".1 .005 .0001"',
        0.0,
        5e-4,
        integrator,
        **CONDENSED,
    )
    data.qpos[:] = [0.0002, 0, 0.01623, 0.84862, -0.352314, -0.060457, 0.389955]
    data.qvel[:] = [-0.114068, 0.066106, -1.098932, -9.632, 7.32374, 53.934426]
    rows = list(steps(model, data, handle, 14))
    assert_told(rows)
    assert max(told[2] for _, told, _ in rows) > 1 and all(status[0] == 1 for *_, status in rows)


def test_a_finger_with_an_equality_constraint_moves_on():
    """Its dampers are stiff for its inertia, and the tangent of its touch has a negative direction."""
    spec = mujoco.MjSpec.from_string("""
    <mujoco><option timestep="0.002" integrator="implicitfast" jacobian="dense"/><worldbody>
      <site name="tip" quat="1 -1 0 0"/>
      <body pos="-.05 0 .016">
        <joint name="j1" axis="0 1 0" damping=".002" stiffness=".01" armature="1e-6"/>
        <geom type="capsule" fromto="0 0 0 .02 0 0" size=".003" mass=".01" contype="0" conaffinity="0"/>
        <body pos=".02 0 0">
          <joint name="j2" axis="0 1 0" damping=".002"/>
          <geom type="capsule" fromto="0 0 0 .02 0 0" size=".003" mass=".008" contype="0" conaffinity="0"/>
          <body name="thrown" pos=".02 0 0">
            <joint axis="0 1 0" damping=".002" range="-40 40" limited="true"/>
            <geom type="cylinder" size=".004 .003" mass=".005"/>
          </body>
        </body>
      </body></worldbody>
      <tendon><fixed name="both"><joint joint="j1" coef="1"/><joint joint="j2" coef="-1"/></fixed></tendon>
      <equality><tendon tendon1="both" polycoef="0 0 0 0 0"/></equality>
    </mujoco>""")
    handle = biotac_mj.attach(spec, site="tip", readings="none", **CONDENSED)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:] = [0.534047, 7.858955, -3.384874]
    pushed = 0.0
    for _ in range(30):
        mujoco.mj_step(model, data)
        assert handle.read(data, "status")[0] == 1
        pushed = max(pushed, handle.read(data, "contact_force")[1])
    assert pushed > 0.02


def test_skin_and_core_are_reported_together():
    """5 kg go down to the core, which MuJoCo's own contacts hold; force and torque are the body's."""
    model, data, handle = scene(
        'type="box" size=".006 .006 .006" mass="5"', TOP + 0.0061, 0.001, "Euler", -G, **CONDENSED
    )
    data.qvel[:] = [0.1, 0.0, -0.5, 1.0, 0.5, 0.2]
    core, touched = model.body(handle.body).id, 0
    for _ in range(40):
        mujoco.mj_step(model, data)
        touched += any(core in model.geom_bodyid[c.geom] for c in data.contact)
        told = -handle.read(data, "contact_force")
        frame, origin = data.xmat[core].reshape(3, 3), data.xpos[core]
        force, torque = frame @ told[:3], frame @ told[3:]
        pushed = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, pushed, data.qacc)
        pushed += data.qfrc_bias
        jacp, jacr = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, data, jacp, jacr, origin, model.body("thrown").id)
        np.testing.assert_allclose(jacp.T @ force + jacr.T @ torque, pushed, rtol=1e-8, atol=1e-9)
    assert touched > 3


@pytest.mark.parametrize("coupling", ["two-way", "one-way"])
def test_the_nail_reads_the_weight_on_it(coupling):
    """The skin rests meanwhile: nothing touches it."""
    model, data, handle = scene(
        'type="box" size=".002 .002 .002" mass=".05"',
        0.0069,
        0.002,
        gravity=-G,
        quat=NAIL_UP,
        coupling=coupling,
        **CONDENSED,
    )
    mujoco.mj_step(model, data, 150)
    assert not handle.read(data, "status")[2] and data.ncon
    assert np.allclose(force_on_body(data, handle), [0, 0, 0.05 * G], atol=1e-3)
    assert_told(steps(model, data, handle, 3))
