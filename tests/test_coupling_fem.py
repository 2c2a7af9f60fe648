"""The two-way coupling with the finite-element skin: statics, Coulomb's law, momentum, replay and errors, through the public way in."""

import sys

import mujoco
import mujoco.rollout
import numpy as np
import pytest

import biotac_mj
from biotac_mj.geometry import asset_path, indenter

G = 9.81
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
RADIUS = 0.008
TOP = 0.00831  # the pad's highest point when it faces up, 6.2 mm from the frame's origin towards the tip
APEX = [0.0062, 0, 0]  # puts that point over the world's origin
PAD_UP = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
PAD_DOWN = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
GHOST = 'contype="0" conaffinity="0"'  # a geom that nothing collides with
UPRIGHT = '<joint name="z" type="slide" axis="0 0 1" damping="{}"/>'


@pytest.fixture(autouse=True)
def no_errors():
    yield
    biotac_mj.plugin.check()


def scene(bodies, timestep=0.002, gravity="0 0 -9.81", finger='<body name="finger"/>', **settings):
    """A BioTac, pad up, its highest point over the origin."""
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" gravity="{gravity}" integrator="implicitfast"/><worldbody>{finger}{bodies}</worldbody></mujoco>'
    )
    handle = biotac_mj.attach(spec, body="finger", quat=PAD_UP, pos=APEX, **(dict(skin="coarse", readings="none") | settings))
    model = spec.compile()
    return model, mujoco.MjData(model), handle


def ball(mass, joint="<freejoint/>", pos=(0, 0, TOP + RADIUS), friction=0.1, name="ball"):
    return (
        f'<body name="{name}" pos="{" ".join(map(str, pos))}">{joint}'
        f'<geom name="{name}" type="sphere" size="{RADIUS}" mass="{mass}" friction="{friction}"/></body>'
    )


def solved_skin(data, number=0):
    """What the stepper of a BioTac of this mjData holds after its last solve: a SkinData."""
    world = sys.modules["biotac_mj.plugin.engine"]._worlds[data._address]
    return list(world.instances.values())[number].setup.skin.stepper._data


def state_of(model, data, kind=STATE):
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


# stiffness [N/m] of the coarse skin under each mass [kg], roughly: only to choose a damping with which the ball settles soon
STIFFNESS = {0.001: 600, 0.01: 1000, 0.1: 2500, 1.0: 16000}


def check_weight(mass, timestep, **settings):
    stiffness = STIFFNESS[mass]
    critical = 2 * np.sqrt(stiffness * mass)
    damping = min(0.7 * critical, 0.2 * mass / timestep)
    rate = damping / (2 * mass) + min(0.5 * stiffness / mass * timestep, 0.5 / timestep)  # the damper's, and backward Euler's own
    model, data, handle = scene(ball(mass, UPRIGHT.format(damping)), timestep, **settings)
    mujoco.mj_step(model, data, int(10 / rate / timestep) + 20)
    weight, force, balance, clamp, speed = mass * G, [], [], [], []
    for _ in range(30):
        mujoco.mj_step(model, data)
        skin = solved_skin(data)
        force.append(handle.read(data, "contact_force")[:3])
        balance.append(data.qfrc_passive[0] + damping * data.qvel[0])
        clamp.append(skin.reaction[0] + skin.core_force[0].sum(0))
        speed.append(data.qvel[0])
    force, clamp = np.array(force), np.array(clamp)
    assert handle.read(data, "status")[:2].tolist() == [1, 0]
    # in the BioTac frame the weight points along +y; every single step, not the mean
    np.testing.assert_allclose(force[:, 1], weight, rtol=0.01)
    np.testing.assert_allclose(balance, weight, rtol=0.01)
    np.testing.assert_allclose(clamp, -force, atol=0.01 * weight)
    np.testing.assert_allclose(clamp[:, 1], -weight, rtol=0.015)
    assert force[:, 1].mean() == pytest.approx(weight, rel=0.002)
    assert abs(data.qacc[0]) < 0.01 * G
    # chatter: no more than a force error of 1 % of the weight during one step would make, 0.05 mm/s on the whole
    assert max(np.abs(speed)) < 0.01 * G * timestep + 2e-5
    assert np.sqrt(np.mean(np.square(speed))) < 5e-5


@pytest.mark.parametrize("timestep", [0.0005, 0.004])
@pytest.mark.parametrize("mass", [0.001, 0.01, 0.1, 1.0])
def test_a_ball_reads_its_weight(mass, timestep):
    check_weight(mass, timestep)


@pytest.mark.slow
@pytest.mark.parametrize("liquid", [True, False])
@pytest.mark.parametrize("timestep", [0.0005, 0.001, 0.002, 0.004])
@pytest.mark.parametrize("mass", [0.001, 0.01, 0.1, 1.0])
def test_a_ball_reads_its_weight_on_the_default_skin(mass, timestep, liquid):
    check_weight(mass, timestep, skin="default", liquid=liquid)
