"""The two-way coupling with the finite-element skin: statics, Coulomb's law, momentum, replay and errors,
through the public way in."""

import sys

import mujoco
import mujoco.rollout
import numpy as np
import pytest
import scipy.sparse.linalg
from blocks import four_nodes
from grids import covering
from mechanics import momentum
from scipy.spatial.transform import Rotation

import biotac_mj
from biotac_mj.coupling import Config
from biotac_mj.coupling.stepper import Geom
from biotac_mj.coupling.steppers import fem
from biotac_mj.coupling.steppers.condensed import CondensedStepper
from biotac_mj.geometry import indenter, load_skin
from biotac_mj.skin.step import SkinStep

# four nodes an element: a quarter of the work of the shipped skin's ten, which those tests take that need
# more contact samples, or a stepper, which takes a name
SKIN = four_nodes("coarse")
COARSE = {"skin": "coarse"}
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
        f'<mujoco><option timestep="{timestep}" gravity="{gravity}" integrator="implicitfast"/>'
        f"<worldbody>{finger}{bodies}</worldbody></mujoco>"
    )
    handle = biotac_mj.attach(
        spec, body="finger", quat=PAD_UP, pos=APEX, **(dict(skin=SKIN, readings="none") | settings)
    )
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


# stiffness [N/m] of the coarse skin under each mass [kg], roughly: only to choose a damping with which the
# ball settles soon
STIFFNESS = {0.001: 600, 0.01: 1000, 0.1: 1500, 1.0: 12000}


def check_weight(mass, timestep, **settings):
    stiffness = STIFFNESS[mass]
    critical = 2 * np.sqrt(stiffness * mass)
    damping = min(0.7 * critical, 0.2 * mass / timestep)
    # the damper's, and backward Euler's own
    rate = damping / (2 * mass) + min(0.5 * stiffness / mass * timestep, 0.5 / timestep)
    model, data, handle = scene(ball(mass, UPRIGHT.format(damping)), timestep, **settings)
    mujoco.mj_step(model, data, int(12 / rate / timestep) + 20)
    weight, force, balance, clamp, speed = mass * G, [], [], [], []
    for _ in range(30):
        mujoco.mj_step(model, data)
        skin = solved_skin(data)
        force.append(handle.read(data, "contact_force")[:3])
        balance.append(data.qfrc_passive[0] + damping * data.qvel[0])
        # what holds the skin: clamp and nail, the core it lies on, and the liquid, which rests on the core
        # too
        clamp.append(skin.reaction[0] + skin.core_force[0].sum(0) + skin.liquid_force[0].sum(0))
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
    # chatter: no more than a force error of 1 % of the weight during one step would make, 0.05 mm/s on the
    # whole
    assert max(np.abs(speed)) < 0.01 * G * timestep + 2e-5
    assert np.sqrt(np.mean(np.square(speed))) < 5e-5


# the ends of both; all of both on the default skin follow
@pytest.mark.slow  # quick: the pinch below, and weights in test_coupling.py and test_skin_condensed.py
@pytest.mark.parametrize("mass, timestep", [(0.001, 0.0005), (1.0, 0.004)])
def test_a_ball_reads_its_weight(mass, timestep):
    check_weight(mass, timestep)


@pytest.mark.parametrize("integrator", ["EULER", "IMPLICITFAST", "IMPLICIT"])
def test_a_damped_ball_settles_along_the_static_curve(integrator):
    """1 g, h c / m = 6.2: what it reads at each depth is what the skin reads where a geom is held at that
    depth, and it comes to rest within a few steps. The depth is that at which the step solves the skin."""
    mass, timestep = 0.001, 0.004
    weight = mass * G
    model, data, handle = scene(ball(mass, UPRIGHT.format(1.55)), timestep)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    depth, force = [], []
    for _ in range(40):
        mujoco.mj_step(model, data)
        ball_in_finger = data.plugin_state[3 + 42 : 3 + 45]  # of the linear model
        depth.append(TOP + RADIUS + ball_in_finger[1])
        force.append(handle.read(data, "contact_force")[1])
    depth, force = np.array(depth), np.array(force)
    model, data, handle = pressing(f'<geom type="sphere" size="{RADIUS}" friction="0.1"/>', timestep)
    static = []
    for d in depth[:8]:
        data.mocap_pos[0] = [0, 0, TOP + RADIUS - d]
        mujoco.mj_step(model, data, 2)
        static.append(handle.read(data, "contact_force")[1])
    np.testing.assert_allclose(force[:8], static, atol=0.02 * weight)
    assert force[0] < 0.3 * weight  # it begins shallow
    assert np.ptp(depth[8:]) < 1e-7
    np.testing.assert_allclose(force[8:], weight, rtol=0.005)


@pytest.mark.slow
@pytest.mark.parametrize("liquid", [True, False])
@pytest.mark.parametrize("timestep", [0.0005, 0.001, 0.002, 0.004])
@pytest.mark.parametrize("mass", [0.001, 0.01, 0.1, 1.0])
def test_a_ball_reads_its_weight_on_the_default_skin(mass, timestep, liquid):
    check_weight(mass, timestep, skin="default", liquid=liquid)


@pytest.mark.parametrize("timestep", [pytest.param(0.001, marks=pytest.mark.slow), 0.004])
def test_a_ball_sticks_and_slips_at_mu(timestep):
    """Pressed by 0.3 N and pushed along the finger, where the pad is flat to 2 degrees."""
    mass, load, mu = 0.03, 0.3, 0.4
    joints = UPRIGHT.format(3) + '<joint name="x" type="slide" axis="1 0 0" damping="1"/>'
    # MuJoCo's rule: the larger friction counts
    model, data, handle = scene(ball(mass, joints), timestep, friction=mu)
    data.qfrc_applied[0] = mass * G - load
    mujoco.mj_step(model, data, int(0.1 / timestep))
    for share in np.linspace(0, 0.85, int(0.05 / timestep)):
        data.qfrc_applied[1] = -share * mu * load
        mujoco.mj_step(model, data)
    mujoco.mj_step(model, data, int(0.05 / timestep))
    start = data.qpos[1]
    mujoco.mj_step(model, data, int(0.05 / timestep))
    assert abs(data.qpos[1] - start) < 2e-6  # sticks: creeps less than 40 um/s
    force = handle.read(data, "contact_force")
    assert force[0] == pytest.approx(-0.85 * mu * load, rel=0.01)
    data.qfrc_applied[1] = -1.4 * mu * load
    mujoco.mj_step(model, data, int(0.02 / timestep))
    ratio = []
    for _ in range(int(0.03 / timestep)):
        mujoco.mj_step(model, data)
        force = handle.read(data, "contact_force")
        ratio.append(np.hypot(force[0], force[2]) / force[1])
    assert data.qvel[1] < -0.01
    assert np.mean(ratio) == pytest.approx(mu, rel=0.05)  # what the pad's slope leaves: tan(1 degree) / mu


@pytest.mark.law
@pytest.mark.parametrize("masses, timestep", covering([(0.02, 0.005), (0.05, 0.05)], [0.0005, 0.002]))
def test_momentum_of_a_free_finger_and_a_ball_is_conserved(masses, timestep):
    """A spinning ball hits a free finger beside its centre and slides."""
    finger = (
        f'<body name="finger"><freejoint/><geom type="box" size=".008 .008 .008" mass="{masses[0]}" '
        f"{GHOST}/></body>"
    )
    model, data, handle = scene(
        ball(masses[1], pos=(0.002, 0.001, TOP + RADIUS + 2e-4)), timestep, "0 0 0", finger, friction=0.3
    )
    data.qvel[6:] = [0.1, 0.05, -0.3, 3, 4, 2]
    linear, angular = momentum(model, data)
    touched = 0
    for _ in range(int(0.03 / timestep)):
        mujoco.mj_step(model, data)
        touched += handle.read(data, "contact_force").any()
    after = momentum(model, data)
    assert touched >= 2 and np.linalg.norm(data.qvel[:3]) > 0.01  # there was something to conserve
    assert np.linalg.norm(after[0] - linear) < 1e-3 * np.linalg.norm(linear)
    assert np.linalg.norm(after[1] - angular) < 1e-3 * np.linalg.norm(angular)


def pinch(timestep, friction, mass=0.02, grip=2.0):
    """Two BioTacs face each other, pads 16 mm apart with a ball between; gravity along the fingers, towards
    their tips."""
    fingers = "".join(
        f'<body name="finger{i}" pos="0 0 {z}"><joint name="f{i}" type="slide" axis="0 0 {s}" damping="5"/>'
        f'<geom size=".003" mass=".05" {GHOST}/></body>'
        for i, (z, s) in enumerate(((-TOP - RADIUS, 1), (TOP + RADIUS, -1)))
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" gravity="-9.81 0 0" '
        f'integrator="implicitfast"/><worldbody>{fingers}'
        f"{ball(mass, pos=(0, 0, 0), friction=0)}</worldbody>"
        '<actuator><motor joint="f0"/><motor joint="f1"/></actuator></mujoco>'
    )
    handles = [
        biotac_mj.attach(
            spec,
            body=f"finger{i}",
            quat=quat,
            pos=APEX,
            prefix=f"b{i}_",
            skin=SKIN,
            readings="none",
            friction=friction,
        )
        for i, quat in enumerate((PAD_UP, PAD_DOWN))
    ]
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = grip
    return model, data, handles


def in_world(model, data, handle):
    return data.xmat[model.body(handle.body).id].reshape(3, 3) @ handle.read(data, "contact_force")[:3]


@pytest.mark.parametrize("timestep", [pytest.param(0.001, marks=pytest.mark.slow), 0.004])
def test_a_pinch_holds_a_ball_against_gravity(timestep):
    """1 N from each side; the weight is 0.28 of the friction there is."""
    mass, grip = 0.02, 1.0
    model, data, handles = pinch(timestep, 0.35, mass, grip)
    mujoco.mj_step(model, data, int(0.15 / timestep))
    start = data.body("ball").xpos.copy()
    total = np.zeros(3)
    for _ in range(int(0.1 / timestep)):
        mujoco.mj_step(model, data)
        total += sum(in_world(model, data, handle) for handle in handles) / int(0.1 / timestep)
    moved = data.body("ball").xpos - start
    assert abs(moved[0]) < 1e-4  # held: in free fall it would have gone 49 mm
    np.testing.assert_allclose(total, [-mass * G, 0, 0], atol=0.01 * mass * G)
    for handle in handles:
        assert handle.read(data, "contact_force")[1] == pytest.approx(grip, rel=0.02)


def test_without_friction_the_pinched_ball_falls():
    model, data, _ = pinch(0.004, 0.0, grip=1.0)
    mujoco.mj_step(model, data, 8)
    assert data.body("ball").xpos[0] < -0.5 * 0.5 * G * 0.032**2  # at least half of free fall


def two_biotacs(**settings):
    """Two BioTacs side by side, a ball sliding on each; the balls are light and not in the same state."""
    bodies = "".join(
        ball(0.002 * (i + 1), pos=(0.04 * i, 0, TOP + RADIUS - 2e-5), name=f"ball{i}") for i in range(2)
    )
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" '
        f'integrator="implicitfast"/><worldbody>{bodies}</worldbody></mujoco>'
    )
    for i in range(2):
        settings = dict(skin=SKIN, friction=0.3, seed=i) | settings
        biotac_mj.attach(
            spec, body="world", pos=[APEX[0] + 0.04 * i, 0, 0], quat=PAD_UP, prefix=f"b{i}_", **settings
        )
    return spec.compile()


def start(model, speed=0.05):
    data = mujoco.MjData(model)
    data.qvel[0], data.qvel[7] = speed, 0.7 * speed
    return data


@pytest.fixture(scope="module", params=[pytest.param("quasistatic", marks=pytest.mark.slow), "implicit"])
def both(request):
    """The whole sensor, counts with noise and all, on both dynamics."""
    return two_biotacs(readings="biotac", options={"skin": {"dynamics": request.param}})


@pytest.mark.law
def test_replay_copies_and_reset_are_bit_equal(both):
    data = start(both)
    mujoco.mj_step(both, data, 2)
    saved = state_of(both, data)
    copied = mujoco.MjData(both)
    mujoco.mj_copyData(copied, both, data)
    mujoco.mj_step(both, data, 2)
    assert (
        all(data.sensor(f"b{i}_contact_force").data[1] > 0.005 for i in range(2))
        and data.sensor("b0_electrodes").data.all()
    )

    def same(other):
        assert np.array_equal(other.qpos, data.qpos) and np.array_equal(other.qvel, data.qvel)
        assert np.array_equal(other.sensordata, data.sensordata) and np.array_equal(
            state_of(both, other), state_of(both, data)
        )

    restored = mujoco.MjData(both)
    mujoco.mj_setState(both, restored, saved, STATE)
    for other in (restored, copied):
        mujoco.mj_step(both, other, 2)
        same(other)
    mujoco.mj_resetData(both, restored)
    assert np.array_equal(restored.plugin_state, mujoco.MjData(both).plugin_state)
    restored.qvel[:] = start(both).qvel
    mujoco.mj_step(both, restored, 4)
    same(restored)


def test_rollout_with_two_threads_equals_the_loop(both):
    starts = np.stack([state_of(both, start(both, 0.02 * i), FULL) for i in range(2)])
    states, sensors = mujoco.rollout.rollout(
        both, [mujoco.MjData(both), mujoco.MjData(both)], starts, nstep=2
    )
    for i in range(2):
        data = mujoco.MjData(both)
        mujoco.mj_setState(both, data, starts[i], FULL)
        for k in range(2):
            mujoco.mj_step(both, data)
            assert np.array_equal(states[i, k], state_of(both, data, FULL))
            assert np.array_equal(sensors[i, k], data.sensordata)


def test_biotacs_of_equal_settings_do_not_read_each_other():
    """They share the skin's constants and working memory, not what they read."""
    model = two_biotacs(readings="biotac", seed=0)
    untouched = mujoco.MjData(model)
    untouched.qpos[[2, 9]] = 1.0
    pressed = mujoco.MjData(model)
    pressed.qpos[2] = 1.0
    counts = []
    for data in (untouched, pressed):
        mujoco.mj_step(model, data, 6)
        counts.append([data.sensor(f"b{i}_electrodes").data.copy() for i in range(2)])
    assert not np.array_equal(counts[0][0], counts[0][1])  # noise is each name's own
    assert np.array_equal(counts[0][0], counts[1][0])  # lies first, was not pressed
    assert not np.array_equal(counts[0][1], counts[1][1])


def test_one_way_reads_and_leaves_the_dynamics_alone():
    bodies = ball(0.01) + f'<geom type="plane" size="1 1 .1" pos="0 0 {TOP - 3e-4}" friction="0.5"/>'
    reading, data, handle = scene(bodies, coupling="one-way")
    deaf, plain, _ = scene(bodies, coupling="one-way", geoms=[])
    data.qvel[0] = plain.qvel[0] = 0.02
    for _ in range(40):
        mujoco.mj_step(reading, data)
        mujoco.mj_step(deaf, plain)
        assert (
            np.array_equal(data.qpos, plain.qpos)
            and np.array_equal(data.qvel, plain.qvel)
            and np.array_equal(data.qacc, plain.qacc)
        )
    assert handle.read(data, "contact_force")[1] > 0.05  # it did read


def pressing(shape, timestep=0.002, **settings):
    """A geom on a mocap body; it moves with data.mocap_pos[0], which starts over the pad without touching
    it."""
    return scene(f'<body name="probe" mocap="true" pos="0 0 .03">{shape}</body>', timestep, **settings)


@pytest.mark.parametrize("tier", ["full", "condensed"])
def test_pressure_on_the_skin_adds_up_to_the_force(tier):
    """Without friction all of it is pressure; it is where the ball is, and gone with it."""
    model, data, handle = pressing(
        f'<geom type="sphere" size="{RADIUS}" friction="0"/>', friction=0.0, tier=tier, **COARSE
    )
    mujoco.mj_step(model, data)
    assert not handle.contact_pressure(model, data).any()
    data.mocap_pos[0] = [0, 0, TOP + RADIUS - 4e-4]
    mujoco.mj_step(model, data, 2)
    pressure, vert = handle.contact_pressure(model, data), handle.vert_xpos(model, data)
    corner = vert[load_skin("coarse").outer_face]
    area = np.zeros_like(vert)
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 6
    np.add.at(area, load_skin("coarse").outer_face, across[:, None])
    force = handle.read(data, "contact_force")[:3]
    assert np.linalg.norm(force) > 0.1
    np.testing.assert_allclose(-(pressure[:, None] * area).sum(0), force, atol=0.03 * np.linalg.norm(force))
    pressed = vert[pressure > 0.1 * pressure.max()]
    assert np.ptp(pressed, axis=0).max() < RADIUS and pressure.min() > -1e-3 * pressure.max()
    data.mocap_pos[0] = [0, 0, 0.03]
    mujoco.mj_step(model, data)
    assert not handle.contact_pressure(model, data).any()


def test_a_geom_deep_in_the_core_is_told_and_survived():
    model, data, handle = pressing(f'<geom name="probe" type="sphere" size="{RADIUS}"/>')
    mujoco.mj_step(model, data)
    data.mocap_pos[0, 2] = 0.0
    mujoco.mj_step(model, data)
    assert handle.read(data, "status")[0] == 0
    data.mocap_pos[0, 2] = TOP + RADIUS - 3e-4
    mujoco.mj_step(model, data)
    assert handle.read(data, "status")[0] == 1
    assert handle.read(data, "contact_force")[1] > 0.1


@pytest.mark.parametrize(
    "back", [8, pytest.param(3, marks=[pytest.mark.slow, pytest.mark.xfail(strict=True)])]
)
def test_an_unconverged_step_goes_on_from_its_iterate(back):
    """back: steps after which the skin is as before; 3 where an unconverged step kept the last state.
    What acts is the contact law there, but no more than the skin balances: 2.2 mm deeper than a touch that is
    nine times as large as the touch's linear model."""
    onto_the_core = []
    for options in ({}, {"max_newton": 3}):
        model, data, handle = pressing(
            f'<geom type="sphere" size="{RADIUS}"/>', options={"skin": options}, **COARSE
        )
        data.mocap_pos[0, 2] = TOP + RADIUS - 2e-5
        mujoco.mj_step(model, data, 5)
        failed, force = handle.read(data, "status")[1], handle.read(data, "contact_force")
        assert handle.read(data, "status")[0] == 1 and force[1] > 0
        data.mocap_pos[0, 2] -= 2.2e-3  # on the core at once: three iterations cannot
        mujoco.mj_step(model, data)
        first = handle.read(data, "contact_force")
        mujoco.mj_step(model, data)
        onto_the_core.append(handle.read(data, "contact_force"))
    # no more than what the skin balances there: by the contact law alone it is 18 % more
    assert first[1] == pytest.approx(onto_the_core[0][1], rel=0.02)
    status = handle.read(data, "status")
    assert status[0] == 0 and status[1] == failed + 2 and status[3] > 3e-4
    np.testing.assert_allclose(*onto_the_core[::-1], atol=0.02 * onto_the_core[0][1])
    data.mocap_pos[0, 2] += 2.2e-3  # and back: the skin begins anew where that is in vain, too
    mujoco.mj_step(model, data, back)
    assert handle.read(data, "status")[0] == 1
    np.testing.assert_allclose(handle.read(data, "contact_force"), force, rtol=0.01, atol=1e-5)


@pytest.mark.parametrize("tier", ["full", "condensed"])
def test_readings_hold_where_the_skin_did_not_get(tier):
    """To a ball in the core, on whichever way solves come, and anew from rest; force and counter go on."""
    model, data, handle = pressing(
        f'<geom type="sphere" size="{RADIUS}"/>',
        readings="biotac",
        options={"readings": {"noise": False}},
        tier=tier,
        **COARSE,
    )

    def read():
        return np.concatenate([handle.read(data, name) for name in ("electrodes", "pdc")])

    mujoco.mj_step(model, data)
    rest = read()
    data.mocap_pos[0, 2] = TOP + RADIUS - 5e-4
    mujoco.mj_step(model, data, 10)
    settled = read()
    data.mocap_pos[0, 2] -= 4e-3
    for step in range(1, 7):
        mujoco.mj_step(model, data)
        assert handle.read(data, "status")[:2].tolist() == [0, step]
        np.testing.assert_array_equal(read(), settled)
    assert handle.read(data, "contact_force")[1] > 1
    data.mocap_pos[0, 2] += 2e-2
    mujoco.mj_step(model, data, 10)
    assert handle.read(data, "status")[0] == 1
    np.testing.assert_allclose(read(), rest, atol=1)


def test_a_press_that_asked_for_too_much_work_goes_on():
    """From its iterate, where a body is held whatever the skin does: it would be as hard, in vain and for
    ever."""
    model, data, handle = pressing(
        f'<geom type="sphere" size="{RADIUS}"/>', options={"skin": {"max_work": 12}}, **COARSE
    )
    data.mocap_pos[0, 2] = TOP + RADIUS - 2e-5
    mujoco.mj_step(model, data, 5)
    data.mocap_pos[0, 2] -= 6e-4
    mujoco.mj_step(model, data)
    assert handle.read(data, "status")[[0, 6]].tolist() == [0, 1]
    mujoco.mj_step(model, data)
    assert handle.read(data, "status")[[0, 6]].tolist() == [1, 1]
    assert handle.read(data, "contact_force")[1] > 0.3


@pytest.mark.parametrize(
    "nu, tolerance, work",
    [(-0.2, 3e-4, 145), (0.2562, 1e-3, 145), (0.2562, 1e-6, 247), (0.45, 3e-4, 308), (0.4999, 3e-4, 580)],
)
def test_what_converges_slower_or_further_may_work_more(nu, tolerance, work):
    rubber = {"law": "neo_hookean", "youngs_modulus": 1e6, "poissons_ratio": nu}
    config = Config(options={"skin": {"tolerance": tolerance}}, material=rubber)
    assert fem._in_time(config, fem.skin_settings(config)).options.max_work == work


@pytest.mark.slow  # quick: what it may work
@pytest.mark.parametrize("material, lost", [("rubber", 3), ("ansys", 14)])
def test_rubber_that_keeps_its_volume_bears_a_ball(material, lost):
    """100 g that the skin bears on the core: by the bound of softer rubber the skin lets go in most steps."""
    sinking = ball(0.1, '<joint type="slide" axis="0 0 1"/>', (0, 0, TOP + RADIUS + 1e-4))
    model, data, handle = scene(sinking, material=material, options={"loss": 2.0}, **COARSE)
    settled = 0
    for _ in range(60):
        mujoco.mj_step(model, data)
        settled += handle.read(data, "status")[0]
    assert settled >= 60 - lost
    assert handle.read(data, "contact_force")[1] == pytest.approx(0.1 * G, rel=0.2)


@pytest.mark.parametrize("tier", ["full", "condensed"])
def test_either_tier_goes_on_after_a_step_in_vain(tier):
    model, data, handle = pressing(f'<geom type="sphere" size="{RADIUS}"/>', tier=tier, **COARSE)
    data.mocap_pos[0, 2] = TOP + RADIUS - 2e-4
    mujoco.mj_step(model, data, 2)
    force = handle.read(data, "contact_force")
    data.plugin_state[1] = -1.0  # the head of the state: a step in which the skin stayed where it was
    mujoco.mj_step(model, data)
    assert handle.read(data, "status")[0] == 1
    np.testing.assert_allclose(handle.read(data, "contact_force"), force, rtol=0.02, atol=1e-3)


@pytest.mark.slow  # quick: friction of a held bound, in test_skin_contact.py
def test_a_light_ball_that_spins_settles_at_once():
    """The skin barely feels 1 g, and the ball comes and goes from one iteration to the next: a solve whose
    bounds of friction follow the push does not settle."""
    options = 'gravity="0 0 0" integrator="Euler" timestep=".004" cone="elliptic"'
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option {options}/><worldbody><site name="tip"/><body name="ball"><freejoint/>'
        '<geom size=".004" mass=".001" friction=".5 .005 .0001"/></body></worldbody></mujoco>'
    )
    handle = biotac_mj.attach(spec, site="tip", skin="coarse", readings=False, friction=0.5)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:3] = -0.012247837, -0.0185, 0.0020223164
    data.qvel[:] = -0.058161299, 0.25, -0.031464405, -1.4640175, -2.1399401, 1.6601354
    for _ in range(12):
        mujoco.mj_step(model, data)
        assert handle.read(data, "status")[0] == 1
    assert -0.02 < data.qvel[1] < -0.01  # 0.07 where the first step in touch is lost


@pytest.mark.slow
def test_a_mesh_with_a_hole_presses_around_the_hole():
    """A ring of 50 g lies on the pad, read as a signed distance field: its weight, and where it touches."""
    ring = indenter("ring_7mm")
    vert, face = ring.mesh()
    mass, damping, timestep = 0.05, 5.0, 0.004
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" integrator="implicitfast"/></mujoco>'
    )
    spec.add_mesh(name="ring", uservert=vert.ravel().tolist(), userface=face.ravel().tolist())
    body = spec.worldbody.add_body(name="ring", pos=[0, 0, TOP], quat=PAD_UP)
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, -1, 0], damping=[damping, 0, 0])
    body.add_geom(name="ring", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ring", mass=mass)
    handle = biotac_mj.attach(
        spec, body="world", quat=PAD_UP, pos=APEX, skin="coarse", readings="none", friction=0.3
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 50)
    force = []
    for _ in range(10):
        mujoco.mj_step(model, data)
        force.append(handle.read(data, "contact_force")[1])
    np.testing.assert_allclose(force, mass * G, rtol=0.01)
    outer = solved_skin(data).outer
    anchor = outer.anchor.numpy()[outer.anchor_geom.numpy() >= 0]
    place = anchor @ data.geom("ring").xmat.reshape(3, 3).T + data.geom("ring").xpos
    axis = np.linalg.norm(vert[:, [0, 2]], axis=1)
    radius = np.linalg.norm(place[:, :2], axis=1)
    assert len(radius) > 3
    assert axis.min() - 1e-4 < radius.min() and radius.max() < axis.max() + 1e-4


def sagging(model, acceleration):
    """(nvert, 3) displacements of the linear skin, of scipy's own, under the inertia of a constant
    acceleration of the core."""
    force = -model.material.density * model.elements.node_volume[model.free, None] * acceleration
    out = np.zeros((model.nvert, 3))
    out[model.free] = scipy.sparse.linalg.spsolve(model.stiffness, force.ravel()).reshape(-1, 3)
    return out


@pytest.mark.parametrize("coupling", ["two-way", "one-way"])
def test_an_accelerating_finger_leaves_its_skin_behind(coupling):
    """Implicit dynamics: 100 m/s^2, along and around, from a moving start; backward Euler damps the skin's
    own vibration."""
    finger = (
        f'<body name="finger"><joint type="slide" axis="0 0 1"/><geom size=".01" mass=".02" {GHOST}/></body>'
    )
    settings = dict(coupling=coupling, liquid=False, geoms=[], options={"skin": {"dynamics": "implicit"}})
    model, data, _ = scene("", 0.002, "0 0 0", finger, **settings)
    data.qvel[0] = 1.5
    mujoco.mj_step(model, data, 3)
    skin = solved_skin(data)
    rest = skin.model.geometry.vert
    np.testing.assert_allclose(skin.vert_xpos[0], rest, atol=1e-9)  # uniform motion is no motion
    acceleration = 100.0
    data.qfrc_applied[0] = acceleration * model.body_subtreemass[1]
    mujoco.mj_step(model, data, 60)
    # up is the BioTac's -y
    moved, expected = (skin.vert_xpos[0] - rest, sagging(skin.model, [0, -acceleration, 0]))
    assert abs(expected).max() > 2e-5
    assert abs(moved - expected).max() < 0.03 * abs(expected).max()


@pytest.mark.slow
def test_a_turning_finger_feels_the_centrifugal_force():
    """50 rad/s about the finger's axis: the skin turns with it and is drawn outwards by omega^2 r, late by a
    step: by the angle omega h."""
    finger = (
        f'<body name="finger"><joint type="hinge" axis="1 0 0"/><geom size=".01" mass=".02" {GHOST}/></body>'
    )
    options = {"skin": {"dynamics": "implicit", "mass_damping": 300.0}}
    model, data, _ = scene("", 0.00025, "0 0 0", finger, liquid=False, geoms=[], options=options)
    data.qvel[0] = omega = 50.0
    mujoco.mj_step(model, data, 120)
    skin = solved_skin(data)
    rest = skin.model.geometry.vert
    outwards = -(omega**2) * rest * [0, 1, 1]
    moved, expected = skin.vert_xpos[0] - rest, sagging(skin.model, outwards[skin.model.free])
    assert abs(moved - expected).max() < 0.1 * abs(expected).max()


# --- a skin at rest


def steps_made(monkeypatch):
    """Counts the full solves from here on."""
    made, step = [], fem.step
    monkeypatch.setattr(fem, "step", lambda *args, **also: made.append(1) or step(*args, **also))
    return made


def test_a_skin_that_nothing_reaches_is_not_solved(monkeypatch):
    """A ball falls onto the pad and is taken away: only steps in which it is within a millimetre ask, only
    those in contact solve."""
    model, data, handle = scene(ball(0.02, pos=(0, 0, TOP + RADIUS + 3e-3)), readings="biotac", **COARSE)
    mujoco.mj_forward(model, data)
    at_rest, counts = state_of(model, data), handle.read(data, "electrodes")
    made = steps_made(monkeypatch)
    while data.qpos[2] > TOP + RADIUS + 1.2e-3:
        mujoco.mj_step(model, data)
    assert not made and not handle.read(data, "contact_force").any()
    mujoco.mj_step(model, data, 10)
    assert made and handle.read(data, "contact_force")[1] > 0.05
    data.qpos[2], data.qvel[:] = 1.0, 0.0
    mujoco.mj_step(model, data)  # back to rest takes one step
    made.clear()
    state = state_of(model, data)
    mujoco.mj_step(model, data, 20)
    assert not made and not handle.read(data, "contact_force").any()
    np.testing.assert_allclose(handle.vert_xpos(model, data), load_skin("coarse").vert, atol=1e-15)
    again = mujoco.MjData(model)
    mujoco.mj_setState(model, again, state, STATE)
    mujoco.mj_step(model, again, 20)
    assert np.array_equal(again.sensordata, data.sensordata) and np.array_equal(
        state_of(model, again), state_of(model, data)
    )
    assert (
        np.abs(handle.read(data, "electrodes") - counts).max() < 20
    )  # noise alone; in contact they changed by more
    mujoco.mj_setState(model, data, at_rest, STATE)
    mujoco.mj_step(model, data)
    assert not made


@pytest.mark.parametrize("options", [{}, {"fill_volume": 2e-8}])
def test_a_skin_at_rest_is_what_a_solve_would_leave(options):
    """The stepper with and without its short cut: near the skin, in contact, and after it."""
    stepper = fem.FemStepper(
        Config(skin="coarse", options={"skin": options}),
        load_skin("coarse"),
        [Geom("b", "sphere", [RADIUS, 0, 0], 0.5, 0)],
    )
    state = np.empty(stepper.nstate)
    stepper.reset(state)
    top, where = stepper.vert_xpos(state)[:, 1].min(), np.array([-0.0062, 0.0, 0.0])
    solved, turn = state.copy(), np.eye(3)[None]
    for gap in (2e-4, 1e-5, -3e-4, -3e-4, 2e-4, 1e-3, 1e-5):
        pos = (where + [0, top - RADIUS - gap, 0])[None]
        short = stepper.solve_skin(state, pos, turn, 2e-3)
        solved[stepper._layout.slices["resting"]] = 0.0  # forbids the short cut
        long = stepper.solve_skin(solved, pos, turn, 2e-3)
        assert short.wrench.any() == (gap < 0) and stepper.resting(short.state) == (gap > 0)
        np.testing.assert_allclose(short.vert_xpos, long.vert_xpos, atol=1e-8)
        np.testing.assert_allclose(short.wrench, long.wrench, rtol=1e-3, atol=1e-6)
        assert abs(short.pressure - long.pressure) < 1.0 + 1e-3 * long.pressure
        state, solved = short.state, long.state


def test_a_geom_inside_the_core_presses_though_no_skin_feels_it():
    stepper = fem.FemStepper(
        Config(skin="coarse", coupling="one-way"), SKIN, [Geom("b", "sphere", [3e-3, 0, 0], 0.5, 0)]
    )
    state = np.empty(stepper.nstate)
    stepper.reset(state)
    found = stepper.solve_skin(state, np.array([[-2e-3, 0.0, 0.0]]), np.eye(3)[None], 2e-3)
    assert not found.converged and 0 < found.load_factor < 1 and np.linalg.norm(found.wrench[0, :3]) > 0.1
    again = stepper.solve_skin(found.state, np.array([[-2e-3, 0.0, 0.0]]), np.eye(3)[None], 2e-3)
    assert np.linalg.norm(again.wrench[0, :3]) > 0.9 * np.linalg.norm(found.wrench[0, :3])
    with pytest.raises(ValueError, match="NaN"):
        stepper.solve_skin(state, np.array([[np.nan, 0, 0]]), np.eye(3)[None], 2e-3)


def ball_stepper(radius=RADIUS, kind=fem.FemStepper):
    """A stepper that a ball may touch, its state at rest, and where the ball touches."""
    tier = "condensed" if kind is CondensedStepper else "full"
    stepper = kind(Config(skin="coarse", tier=tier), SKIN, [Geom("b", "sphere", [radius, 0, 0], 0.5, 0)])
    state = np.empty(stepper.nstate)
    stepper.reset(state)
    return stepper, state, np.array([[-0.0062, stepper.vert_xpos(state)[:, 1].min() - radius, 0.0]])


@pytest.mark.parametrize("resting", [True, False])
def test_a_later_round_begins_where_an_earlier_one_ended(resting):
    """It began at a part of that where the skin was at rest, since friction knows of the way from first touch
    alone, and without it where the ball only turned."""
    stepper, state, touch = ball_stepper()
    turn, pose = np.eye(3)[None], touch + [0, 4e-4, 0]
    far = touch - [0, 2e-3, 0]
    state = stepper.solve_skin(state, far if resting else pose, turn, 2e-3).state
    assert stepper.resting(state) == resting
    if not resting:
        turn = np.array([[[0.995, 0, 0.0998334], [0, 1, 0], [-0.0998334, 0, 0.995]]])
    found = stepper.solve_skin(state, pose, turn, 2e-3)
    assert found.converged and found.iterations > 2
    again = stepper.solve_skin(state, pose, turn, 2e-3, near=found)
    assert again.converged and again.iterations <= 1
    np.testing.assert_allclose(again.wrench, found.wrench, rtol=1e-3, atol=1e-6)


def test_a_later_round_goes_no_parts_of_its_way():
    """A balance was found before: what another round reaches of a way that leads to none is not used."""
    stepper, state, touch = ball_stepper(3e-3)
    turn = np.eye(3)[None]
    found = stepper.solve_skin(state, touch + [0, 4e-4, 0], turn, 2e-3)
    deep = np.array([[-2e-3, 0.0, 0.0]])
    alone, later = (stepper.solve_skin(state, deep, turn, 2e-3, near=near) for near in (None, found))
    assert not alone.converged and 0 < alone.load_factor < 1
    assert not later.converged and later.load_factor == 0 and later.iterations < alone.iterations


@pytest.mark.parametrize("kind", [fem.FemStepper, CondensedStepper])
def test_later_rounds_take_no_more_than_earlier_ones_left(kind):
    """Else a step of several rounds, of which the last one fails, takes twice what a hard solve may."""
    stepper, state, touch = ball_stepper(kind=kind)
    turn, pose = np.eye(3)[None], touch + [0, 4e-4, 0]
    easy, late = (stepper.solve_skin(state, pose, turn, 2e-3, spent=spent) for spent in (0.0, 0.6))
    assert easy.converged and late.converged and abs(easy.cost - late.cost) < 0.02
    np.testing.assert_array_equal(easy.wrench, late.wrench)
    hard = touch + [2e-3, 2.4e-3, 1e-3], Rotation.from_rotvec([[0.0, 0.0, 0.9]]).as_matrix()
    alone, last = (stepper.solve_skin(state, *hard, 2e-3, spent=spent) for spent in (0.0, 0.975))
    assert alone.converged and alone.cost > 0.03
    assert not last.converged and last.cost < 0.07, "what an iteration takes that has begun is not broken off"


def test_what_a_contact_needs_is_made_before_the_first(monkeypatch):
    """Factors and programs take a second, in the middle of whatever moves."""
    made, prepare = [], SkinStep.__init__
    monkeypatch.setattr(SkinStep, "__init__", lambda *args: made.append(1) or prepare(*args))
    model, data, handle = scene(ball(0.0123, UPRIGHT.format(0), pos=(0, 0, TOP + RADIUS + 2e-3)))
    mujoco.mj_step(model, data)
    assert made
    made.clear()
    while not handle.read(data, "contact_force").any():
        mujoco.mj_step(model, data)
        assert data.time < 0.1
    assert not made


def test_transitions_of_mujoco_are_those_of_the_linear_model():
    """`mjd_transitionFD` goes through the skin, leaves it where it was, and finds what the coupling's tangent
    says: an implicit spring of 3.8 kN/m."""
    timestep, mass = 0.002, 0.1
    model, data, handle = scene(
        ball(mass, UPRIGHT.format(0)), timestep, options={"skin": {"tolerance": 1e-6}}
    )
    while data.time < 0.3:
        mujoco.mj_step(model, data)
    before, transition = state_of(model, data), np.zeros((2, 2))
    mujoco.mjd_transitionFD(model, data, 1e-5, 1, transition, None, None, None)
    assert np.array_equal(state_of(model, data), before)
    ((body, (wrench, tangent)),) = handle.linear_model(model, data).items()
    assert model.body(body).name == "ball"
    force = handle.read(data, "contact_force")[:3]
    assert wrench[:3] == pytest.approx(-force, abs=2e-3)
    up = data.xmat[model.body(handle.body).id].reshape(3, 3).T @ [0, 0, 1]
    stiff = up @ tangent[:3, :3] @ up
    delay = 0.2 / (2 * np.pi * 50) / timestep  # of the rubber's force, in steps: gamma - 1/2
    beta = (1 + delay) ** 2 / 4 - (1 - delay) ** 2 / 6
    answer = stiff / (mass + beta * timestep**2 * stiff)
    assert transition[1, 1] == pytest.approx(1 - delay * timestep**2 * answer, rel=0.02)
    assert transition[1, 0] == pytest.approx(-timestep * answer, rel=0.08)
