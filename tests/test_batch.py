"""BioTacs in mujoco_warp against the engine plugin in MuJoCo: one world of the batch is one simulation on the
CPU."""

import functools

import mujoco
import numpy as np
import pytest
from blocks import finger

mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")

# ruff: noqa: E402
import warp as wp

import biotac_mj
from biotac_mj import batch as batches
from biotac_mj.coupling.implicit.rules import EULER
from biotac_mj.geometry import load_skin
from biotac_mj.sensor import channels
from biotac_mj.sensor.readings import PhysicsReadings
from biotac_mj.skin import SkinOptions
from biotac_mj.skin.newton.worlds import NOT_CONVERGED
from biotac_mj.skin.rubber.material import material as preset
from biotac_mj.skin.state import GUESS, MEMORY, VARIABLES

DT = 2e-3
RADIUS = 3.5e-3
K = 2.8e11  # [Pa/m] one contact stiffness, so that materials differ in nothing but what is said


@pytest.fixture(scope="module", autouse=True)
def where_batches_run(default_device):
    """mujoco_warp's arrays are on Warp's default device: here, as for its users, a GPU where there is one."""
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        yield


@functools.cache
def shell():
    """A closed shell of a finger's size of 324 nodes, one layer, with 19 electrodes: every path of the code,
    but no real sensor."""
    return finger(2, fixed=2e-3, tip=-14e-3, radius=4.5e-3)


def press_spec():
    """A sphere that goes where it is told, below the pad."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    pin = spec.worldbody.add_body(name="pin", pos=[-0.012, -0.03, 0], mocap=True)
    pin.add_geom(name="pin", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0])
    return spec


def ball_spec(mass=0.01):
    """A ball that can move towards the pad; gravity points there."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    spec.option.gravity = [0, 9.81, 0]
    ball = spec.worldbody.add_body(name="ball", pos=[-0.012, -0.0111, 0])
    ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=mass)
    return spec


def impact_spec():
    """A free finger and a free ball that will meet it off its centre, without gravity."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    spec.option.gravity = [0, 0, 0]
    finger = spec.worldbody.add_body(name="finger")
    finger.add_freejoint()
    finger.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.005, 0, 0], mass=0.02, contype=0, conaffinity=0
    )
    ball = spec.worldbody.add_body(name="ball", pos=[-0.009, -0.0107, 0.001])
    ball.add_freejoint()
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.01)
    return spec


def make(spec, nworld, body=None, skin=None, **settings):
    """mjm, m, d and the Batch of a spec."""
    skin = skin or shell()
    batches.add(spec, body=body or "world", skin=skin)
    if body is not None:  # all mass where the joint is: MuJoCo's own integration of a free body errs without
        spec.body("biotac_core").mass, spec.body("biotac_core").fullinertia = 1e-7, [1e-13] * 3 + [0.0] * 3
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=nworld)
    return mjm, m, d, batches.attach(mjm, m, d, skin=skin, **settings)


@pytest.mark.parametrize("rounds", [*(pytest.param(n, marks=pytest.mark.slow) for n in (None, 2)), 1])
def test_rounds_are_bounded_by_an_option(rounds):
    """No more often than is said the skin is solved; a ball of 2 g that comes at 0.6 m/s leaves with no
    more."""
    mjm, m, d, _ = make(ball_spec(0.002), 1, **({} if rounds is None else {"options": {"rounds": rounds}}))
    d.qvel.fill_(0.6)
    most, fastest = 0, 0.0
    for _ in range(30):
        mjw.step(m, d)
        most = max(most, int(read(mjm, d, "status")[0, 5]))
        fastest = min(fastest, float(d.qvel.numpy()[0, 0]))
    assert 1 <= most <= (rounds or 2)
    assert -0.6 < fastest < -0.05


def test_rounds_of_a_skin_that_has_none_are_refused():
    spec = ball_spec()
    batches.add(spec, body="world", skin=shell(), coupling="one-way")
    mjm = spec.compile()
    m, d = mjw.put_model(mjm), mjw.make_data(mjm)
    one_way = {"skin": shell(), "options": {"rounds": 2}}
    with pytest.raises(ValueError, match="rounds of options is of coupling='two-way'"):
        batches.attach(mjm, m, d, coupling="one-way", **one_way)
    with pytest.raises(ValueError, match="rounds of options is of coupling='two-way'"):
        batches.make(mjm, 1, device="cpu", **one_way)


def read(mjm, d, channel):
    """(nworld, dim) of a channel."""
    sensor = mjm.sensor(f"biotac_{channel}")
    return d.sensordata.numpy()[:, sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]


@pytest.mark.parametrize("tier", ["condensed", "full"])
def test_readings_hold_in_the_world_that_did_not_get_there(tier):
    """They are those of the last step in which its skin reached the ball, as with `mj_step`."""
    mjm, m, d, _ = make(press_spec(), 2, tier=tier, readings={"noise": False})
    kept = []
    for steps, deep in ((1, [-1, -1]), (10, [1, 1]), (6, [1, 8])):
        for _ in range(steps):
            assert list(press(m, d, places(2), 1, 1e-3 * np.array(deep))) == [1]
        kept.append(readings_of(mjm, d))
    rest, before, after = kept
    assert read(mjm, d, "status")[:, 1].tolist() == [0, 6] and abs(before - rest).max() > 10
    np.testing.assert_array_equal(after[1], before[1])


def readings_of(mjm, d):
    return np.concatenate([read(mjm, d, name) for name in ("electrodes", "pdc")], axis=1).copy()


@pytest.mark.parametrize("tier", ["condensed", "full"])
def test_skins_that_are_put_back_remember_the_step_before(tier):
    """Of worlds that touch, begin to touch, and leave in the step."""
    _, m, d, batch = make(press_spec(), 3, tier=tier, readings=False)
    skin, start = batch.skin, places(3)
    inwards = -start * [0, 1, 1] / np.linalg.norm(start[:, 1:], axis=1, keepdims=True)
    skin.prepare_keep()
    for depth in ([8e-4, -2e-3, 8e-4], [1e-3, 8e-4, -2e-3]):
        before = {
            v.name: skin.state.arrays[v.name].numpy().copy()
            for v in VARIABLES
            if v.role in (MEMORY, GUESS) and v.name in skin.state.arrays
        }
        skin.keep()
        move(d, start + np.array(depth)[:, None] * inwards)
        mjw.step(m, d)
    assert (before["kept"].any(0) != skin.state.arrays["kept"].numpy().any(0)).tolist() == [False, True, True]
    skin.data.worlds.wanted.fill_(1)
    skin.reason.fill_(NOT_CONVERGED)  # so that guesses are put back, too
    skin.put_back()
    held = before["anchor_geom"] >= 0
    for name, value in before.items():
        now = skin.state.arrays[name].numpy()
        same = (now[held], value[held]) if name == "anchor" else (now, value)
        np.testing.assert_array_equal(*same, err_msg=name)


def places(nworld, seed=0, geometry=None):
    """Random places around the pad (nworld, 3) [m]: where the sphere touches a skin's first node; for the
    shell, a depth that it bears."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-0.4, 0.4, nworld)
    along = rng.uniform(-13e-3, -4e-3, nworld)
    if geometry is None or geometry is shell():
        reach = 7.2e-3 + RADIUS
        return np.stack([along, -reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    outer = geometry.vert[np.unique(geometry.outer_face)]
    out = []
    for x, a in zip(along, angle):
        outwards = np.array([0, -np.cos(a), np.sin(a)])
        near, far = 5e-3, 20e-3
        for _ in range(20):
            middle = 0.5 * (near + far)
            if np.linalg.norm(outer - ([x, 0, 0] + middle * outwards), axis=1).min() < RADIUS:
                near = middle
            else:
                far = middle
        out.append([x, 0, 0] + far * outwards)
    return np.array(out)


def move(d, pos):
    d.mocap_pos.assign(np.asarray(pos, np.float32)[:, None])


def press(m, d, start, steps, depth):
    """Steps while the spheres go along their radius by depth (nworld,) [m]; yields after each step."""
    inwards = -start * [0, 1, 1] / np.linalg.norm(start[:, 1:], axis=1, keepdims=True)
    for k in range(1, steps + 1):
        move(d, start + (k / steps * np.asarray(depth))[:, None] * inwards)
        mjw.step(m, d)
        yield k


def single(pos, skin, settings):
    """Force (nstep, 6), electrodes, pdc and status of one world by the engine plugin over the poses pos
    (nstep, 3)."""
    spec = press_spec()
    handle = biotac_mj.attach(spec, body="world", skin=skin, **settings)
    model = spec.compile()
    data = mujoco.MjData(model)
    rows = []
    for p in pos:
        data.mocap_pos[0] = p.astype(np.float32)
        mujoco.mj_step(model, data)
        rows.append(
            np.concatenate([handle.read(data, c) for c in ("contact_force", "electrodes", "pdc", "status")])
        )
    return np.array(rows)


def compare_with_single_worlds(skin, nworld, steps, force_error, counts):
    rng = np.random.default_rng(1)
    base = preset("default")
    materials = [
        {**_fields(base), "youngs_modulus": e} for e in base.youngs_modulus * rng.uniform(0.6, 1.5, nworld)
    ]
    friction, depth, start = (
        rng.uniform(0.2, 1.0, nworld),
        rng.uniform(0.8e-3, 1.6e-3, nworld),
        places(nworld, geometry=skin),
    )
    options = {"skin": {"contact_stiffness": K, "tolerance": 1e-4}}
    mjm, m, d, _ = make(
        press_spec(),
        nworld,
        skin=skin,
        material=materials,
        friction=friction,
        priority=1,
        options=options,
        readings={"noise": False},
    )
    move(d, start * [1, 1.03, 1.03])  # what jumps into the skin in its first step comes from nowhere
    mjw.step(m, d)
    rows, paths = [], [d.mocap_pos.numpy()[:, 0].astype(float)]
    for _ in press(m, d, start, steps, depth):
        rows.append(np.concatenate([read(mjm, d, c) for c in ("contact_force", "electrodes", "pdc")], axis=1))
        paths.append(d.mocap_pos.numpy()[:, 0].astype(float))
    got, paths = np.stack(rows, axis=1), np.stack(paths, axis=1)
    assert (read(mjm, d, "status")[:, 0] == 1).all()
    worst, lost = 0.0, 0
    for w in range(nworld):
        settings = {"material": materials[w], "friction": friction[w], "priority": 1}
        options = {"skin": {"contact_stiffness": K, "tolerance": 1e-4}, "readings": {"noise": False}}
        expected = single(paths[w], skin, settings | {"options": options})[1:]
        good = expected[:, 26] == 1  # where the CPU itself found the balance
        lost += (~good).sum()
        expected, mine = expected[good, :26], got[w, good]
        scale = np.linalg.norm(expected[:, :3], axis=1).max()
        assert scale > 0.2
        np.testing.assert_allclose(
            mine[:, :3], expected[:, :3], atol=force_error * scale, err_msg=f"world {w}"
        )
        np.testing.assert_allclose(mine[:, 6:], expected[:, 6:], atol=counts, err_msg=f"world {w}")
        worst = max(worst, np.abs(mine[:, :3] - expected[:, :3]).max() / scale)
    assert lost <= 0.05 * nworld * steps
    return worst


def _fields(material):
    import dataclasses

    return dataclasses.asdict(material)


@pytest.mark.law
def test_each_world_is_the_single_simulation():
    # on CUDA directions are single: what is left of a solve's error is felt where the film is thin
    counts = 4 if wp.is_cuda_available() else 1
    compare_with_single_worlds(shell(), 3, 10, force_error=2e-3, counts=counts)


@pytest.mark.slow
def test_64_random_worlds_are_the_single_simulations():
    worst = compare_with_single_worlds(load_skin("coarse"), 64, 16, force_error=0.01, counts=3)
    print(f"largest force error {worst:.1e}")


def test_readings_are_those_of_the_single_sensor():
    nworld = 2
    mjm, m, d, batch = make(press_spec(), nworld, seed=[5, 7])
    sensors = [PhysicsReadings(shell(), seed=s) for s in (5, 7)]
    states = np.zeros((nworld, sensors[0].nstate))
    for sensor, state in zip(sensors, states):
        sensor.reset(state)
    for k in press(m, d, places(nworld), 12, [1.2e-3] * nworld):
        x, pressure = batch.vert_xpos, batch.skin.pressure.numpy()
        for w, sensor in enumerate(sensors):
            sensor.advance(states[w], (k - 1) * DT, DT, x[w], pressure[w])
            expected = sensor.readings(states[w])
            for name in ("electrodes", "pdc", "pac", "tac", "tdc"):
                np.testing.assert_array_equal(
                    read(mjm, d, name)[w], expected[name], err_msg=f"{name}, step {k}"
                )
    change = read(mjm, d, "electrodes") - channels.REST_COUNTS["1"]
    assert np.abs(pressure).min() > 200 and np.abs(change).max() > 50


def run(bad_step=None, bad_pose=None, bad_world=1, nworld=3, steps=8):
    """Sensordata (nstep, nworld, n) of a press, one world of which may get a wrong pose for a step."""
    mjm, m, d, _ = make(press_spec(), nworld)
    start, rows = places(nworld), []
    inwards = -start * [0, 1, 1] / np.linalg.norm(start[:, 1:], axis=1, keepdims=True)
    for k in range(steps):
        pos = start + 1.2e-3 * k / steps * inwards
        if k == bad_step:
            pos[bad_world] = bad_pose
        move(d, pos)
        mjw.step(m, d)
        rows.append(d.sensordata.numpy().copy())
    return mjm, np.array(rows)


def reading(mjm, channel):
    """Columns of a channel in sensordata."""
    sensor = mjm.sensor(f"biotac_{channel}")
    return slice(sensor.adr[0], sensor.adr[0] + sensor.dim[0])


@pytest.mark.parametrize("step", [5, 0], ids=["nan", "nan at once"])
def test_a_bad_pose_is_flagged_and_disturbs_no_other_world(step):
    mjm, good = run()
    _, bad = run(step, [np.nan, 0, 0])
    others = [0, 2]
    np.testing.assert_array_equal(bad[:, others], good[:, others])
    status, force = mjm.sensor("biotac_status").adr[0], mjm.sensor("biotac_contact_force").adr[0]
    assert (good[:, :, status] == 1).all()
    assert (
        bad[step, 1, status] == -1
        and np.isnan(bad[step, 1, status + 3])
        and (bad[step, 1, force : force + 6] == 0).all()
    )
    assert (np.delete(bad[:, 1, status], step) == 1).all()  # and goes on
    np.testing.assert_allclose(
        bad[-1, 1, force : force + 3],
        good[-1, 1, force : force + 3],
        atol=0.05 * np.abs(good[-1, 1, force + 1]),
    )
    assert np.isfinite(np.delete(bad, step, axis=0)).all()


def test_a_pose_in_the_core_is_gone_to_as_far_as_it_can():
    """The force belongs to the share of the way that is told; the others do not notice, and the world goes
    on."""
    mjm, good = run()
    start = places(3)[1]
    _, bad = run(5, start * [1, 0.5, 0.5])
    np.testing.assert_array_equal(bad[:, [0, 2]], good[:, [0, 2]])
    status, force = reading(mjm, "status"), reading(mjm, "contact_force")
    state = bad[5, 1, status]
    assert state[0] == 0 and state[1] == 1 and np.isfinite(state).all() and 0 < state[6] < 0.6
    assert bad[5, 1, force][1] > 3 * good[5, 1, force][1] > 0  # it pushes out
    assert (np.delete(bad[:, 1, status][:, 0], 5) == 1).all()
    assert (np.delete(bad[:, 1, status][:, 6], 5) == 1).all()
    there, here = (np.linalg.norm(x[-1, 1, force][:3]) for x in (good, bad))
    assert here == pytest.approx(there, rel=0.3)  # but for friction, which remembers


@pytest.mark.slow
def test_a_ten_gram_ball_rests_with_its_weight_on_the_pad():
    soon = {"options": {"loss": 2.0}}  # at rest
    mjm, m, d, _ = make(ball_spec(), 2, readings=False, **soon)
    for _ in range(150):
        mjw.step(m, d)
    weight = 0.01 * 9.81
    np.testing.assert_allclose(read(mjm, d, "contact_force")[:, 1], weight, rtol=5e-3)
    assert np.abs(d.qvel.numpy()).max() < 2e-4 and np.abs(d.qfrc_constraint.numpy()).max() < 0.01 * weight
    spec = ball_spec()
    handle = biotac_mj.attach(spec, body="world", skin=shell(), readings="none", **soon)
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(150):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(d.qpos.numpy()[:, 0], data.qpos[0], atol=1e-6)
    np.testing.assert_allclose(
        read(mjm, d, "contact_force")[0], handle.read(data, "contact_force"), atol=5e-3 * weight
    )


@pytest.mark.law
def test_sparse_and_dense_constraints_give_one_motion():
    qpos = []
    for jacobian in (mujoco.mjtJacobian.mjJAC_DENSE, mujoco.mjtJacobian.mjJAC_SPARSE):
        spec = ball_spec()
        spec.option.jacobian = jacobian
        _, m, d, _ = make(spec, 1, readings=False)
        assert m.is_sparse == (jacobian == mujoco.mjtJacobian.mjJAC_SPARSE)
        for _ in range(15):
            mjw.step(m, d)
        qpos.append(d.qpos.numpy()[0, 0])
    assert qpos[0] == pytest.approx(qpos[1], abs=1e-7)
    assert abs(qpos[0]) < 2e-3  # of 12 mm without the skin


@pytest.mark.law
def test_tangent_is_that_of_the_single_world():
    _, m, d, batch = make(ball_spec(mass=0.3), 2, readings=False)
    for _ in range(20):
        mjw.step(m, d)
    got = np.swapaxes(batch.skin.tangent.numpy(), 0, 1)
    expected = batch.skin.data.tangent(batch.skin.geoms)
    assert got.shape == (2, 1, 6, 6) and expected[0, 0, 1, 1] > 100
    lever = np.array([1, 1, 1, 0.01, 0.01, 0.01])  # compares torques with forces
    scale = lever[:, None] * lever
    np.testing.assert_allclose(got / scale, expected / scale, atol=5e-3 * np.abs(expected / scale).max())


@pytest.mark.law
def test_finger_and_ball_exchange_momentum_and_lose_none():
    mjm, m, d, _ = make(impact_spec(), 2, body="finger", readings=False)
    velocity = d.qvel.numpy().copy()
    velocity[:, 6:9] = [[0.02, 0.08, -0.01], [-0.03, 0.05, 0.02]]
    velocity[1, 9:12] = [5, -3, 10]
    d.qvel.assign(velocity)
    data = mujoco.MjData(mjm)

    def momentum():
        out = []
        for w in range(2):
            data.qpos[:], data.qvel[:] = d.qpos.numpy()[w], d.qvel.numpy()[w]
            mujoco.mj_forward(mjm, data)
            mujoco.mj_subtreeVel(mjm, data)
            out.append(
                np.concatenate([mjm.body_subtreemass[0] * data.subtree_linvel[0], data.subtree_angmom[0]])
            )
        return np.array(out)

    before, force = momentum(), 0.0
    for _ in range(20):
        mjw.step(m, d)
        force = max(force, np.abs(read(mjm, d, "contact_force")).max())
    after = momentum()
    assert force > 0.05 and np.abs(d.qvel.numpy()[:, 6:9] - velocity[:, 6:9]).max() > 0.02
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=2e-8)  # of 8e-4 N s, in single precision
    np.testing.assert_allclose(after[:, 3:], before[:, 3:], atol=2e-3 * np.abs(before[:, 3:]).max())


def thrown(speeds, spins, mass, timestep, steps, neighbours=0, **settings):
    """Steps a ball thrown at a fixed finger in each world, and a quiet one in as many worlds more; yields
    kinetic energies (nworld,) [J], then the model, its Data and velocities at the start."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = timestep, [0, 0, 0]
    ball = spec.worldbody.add_body(name="ball", pos=[-0.009, -0.011, 0.001])
    ball.add_freejoint()
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=mass)
    nworld = len(speeds) + neighbours
    mjm, m, d, _ = make(spec, nworld, readings=False, **settings)
    velocity = np.zeros((nworld, 6))
    velocity[: len(speeds), 1], velocity[: len(speeds), 3:] = speeds, spins
    velocity[len(speeds) :, 1] = 0.02
    d.qvel.assign(velocity)
    weight = np.array([mass] * 3 + [0.4 * mass * RADIUS**2] * 3)
    for _ in range(steps):
        yield 0.5 * (weight * d.qvel.numpy().astype(float) ** 2).sum(axis=1), mjm, d, velocity
        mjw.step(m, d)
    yield 0.5 * (weight * d.qvel.numpy().astype(float) ** 2).sum(axis=1), mjm, d, velocity


@pytest.mark.law
@pytest.mark.parametrize(
    "middle, fastest",
    [
        *(pytest.param(0.15, fast, marks=pytest.mark.slow) for fast in (0.25, 0.4)),
        *(pytest.param(0.3, fast, marks=pytest.mark.slow) for fast in (0.5, 0.6)),
        (0.15, 0.6),
    ],
)
def test_balls_that_hit_the_pad_bounce_as_those_of_the_plugin_do(middle, fastest):
    speeds, timestep, steps = [0.05, middle, fastest], 2e-3, 14
    rounds = []
    for _, mjm, d, velocity in thrown(speeds, 0.0, 0.02, timestep, steps):  # noqa: B007
        rounds.append(read(mjm, d, "status")[:, 5].copy())
    assert (np.max(rounds, axis=0) == 1).all() and (read(mjm, d, "status")[:, 7] == 0).all()
    for w, v in enumerate(velocity):
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = timestep, [0, 0, 0]
        ball = spec.worldbody.add_body(name="ball", pos=[-0.009, -0.011, 0.001])
        ball.add_freejoint()
        ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.02)
        work = {"skin": {"max_work": SkinOptions().max_work}}  # as much as in batches
        biotac_mj.attach(spec, body="world", skin=shell(), readings="none", options=work)
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qvel[:] = v
        for _ in range(steps):
            mujoco.mj_step(model, data)
        assert data.qvel[1] < 0.5 * v[1]
        np.testing.assert_allclose(d.qvel.numpy()[w, :3], data.qvel[:3], atol=0.03 * v[1])


@pytest.mark.law
def test_a_step_without_a_balance_pulls_no_ball():
    """Of 100 g, in `mj_step` and in a batch. Which solves are cut off as a ball leaves skin that lay on the
    core is a matter of rounding: some of these speeds have one."""
    unsettled = np.zeros(2)
    for speed in (0.5, 0.52, 0.6, 0.65):
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = 2e-3, [0, 0, 0]
        ball = spec.worldbody.add_body(name="ball", pos=[-0.009, -0.011, 0.001])
        ball.add_freejoint()
        ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.1)
        biotac = biotac_mj.attach(spec, body="world", skin=shell(), readings="none")
        model = spec.compile()
        data, push, settled = mujoco.MjData(model), [], []
        data.qvel[1] = speed
        for _ in range(14):
            mujoco.mj_step(model, data)
            push.append(biotac.read(data, "contact_force")[1])
            settled.append(biotac.read(data, "status")[0])
        batch_push, batch_settled = [], []  # with even less work than mj_step has
        for _, mjm, d, _ in thrown([speed], 0.0, 0.1, 2e-3, 14, options={"skin": {"max_work": 80}}):  # noqa: B007
            batch_push.append(read(mjm, d, "contact_force")[0, 1])
            batch_settled.append(read(mjm, d, "status")[0, 0])
        unsettled += np.sum(np.equal(settled, 0)), np.sum(np.equal(batch_settled[1:], 0))
        for force, after in ((push, data.qvel[1]), (batch_push[1:], d.qvel.numpy()[0, 1])):
            assert max(force) > 5 and min(force) > -1e-3 * max(force)
            assert -speed < after < -0.5 * speed
    assert all(unsettled > 0)


@pytest.mark.parametrize(
    "mass, spin, seed",
    [
        pytest.param(1e-3, 50.0, 6, marks=pytest.mark.slow),  # quick: test_batch_impacts.py
        pytest.param(0.5, 5.0, 3, marks=pytest.mark.slow),
        pytest.param(1e-3, 5.0, 3, marks=pytest.mark.slow),
        pytest.param(1e-3, 50.0, 3, marks=pytest.mark.slow),
    ],
)
def test_no_ball_gains_energy(mass, spin, seed):
    """Light ones that spin, in steps of 4 ms; the neighbours notice nothing."""
    speeds = [0.05, 0.3, 1.0]
    spins = spin * np.random.default_rng(seed).normal(size=(3, 3))
    seen = thrown(speeds, spins, mass, 4e-3, 12, neighbours=1)
    alone = thrown([], 0.0, mass, 4e-3, 12, neighbours=1)
    start, mjm, d, _ = next(seen)
    *_, other, _ = next(alone)
    force = np.zeros(4)
    for energy, *_ in seen:
        next(alone)
        assert (energy <= 1.05 * start).all()
        force = np.maximum(force, np.linalg.norm(read(mjm, d, "contact_force")[:, :3], axis=1))
    assert (force[:3] > 5e-3).all() and (d.qpos.numpy()[:, 1] < -4e-3).all()  # none is past the middle
    # on CUDA four worlds are multiplied in single precision in another order than one
    bound = 1e-6 if d.qpos.device.is_cuda else 1e-7
    np.testing.assert_allclose(d.qpos.numpy()[3], other.qpos.numpy()[0], atol=bound)


@pytest.mark.law
def test_a_skin_without_energy_pushes_nobody():
    """A ball that was pressed in and let go; of the second skin is forgotten what was put into it. It bears
    the ball's weight and no more."""
    mjm, m, d, batch = make(ball_spec(), 2, readings=False)
    d.qfrc_applied.assign(np.full((2, 1), 1.0))
    for _ in range(30):
        mjw.step(m, d)
    d.qfrc_applied.zero_()
    batch._of_step.left.assign(batch._of_step.left.numpy() * [1, 0])
    mjw.step(m, d)
    (free, held), status = d.qvel.numpy()[:, 0], read(mjm, d, "status")
    assert free < -0.04 and 0.5 * 0.01 * held**2 < 0.05 * 0.5 * 0.01 * free**2
    assert status[0, 7] == 0 and 0.5 < status[1, 7] < 1
    assert (batch._of_step.gamma.numpy()[0] == EULER).tolist() == [False, True]
    assert read(mjm, d, "contact_force")[1, 1] == pytest.approx(0.01 * 9.81, rel=0.02)


@pytest.mark.law
def test_a_cut_back_step_has_the_model_of_where_it_ended():
    _, m, d, batch = make(press_spec(), 1, readings=False)
    start = places(1)
    for _ in press(m, d, start, 4, [1e-3]):
        pass
    before = batch.model.pos0.numpy()[0, 0].copy()
    np.testing.assert_allclose(before, d.mocap_pos.numpy()[0, 0], atol=1e-8)
    move(d, start * [1, 0.5, 0.5])
    mjw.step(m, d)
    reached, after = batch.skin.data.load_factor[0], batch.model.pos0.numpy()[0, 0]
    assert 0 < reached < 1 and batch.wrench[0, 0, 1] < -1
    asked = d.mocap_pos.numpy()[0, 0]
    np.testing.assert_allclose(after, before + reached * (asked - before), atol=1e-9)
    np.testing.assert_allclose(batch.skin.geoms.struct.pos_last.numpy()[0, 0], after, atol=1e-9)


INERTIA = {"dynamics": "implicit", "mass_damping": 50.0, "contact_stiffness": K, "tolerance": 1e-5}


def shaken_spec():
    """A finger on a rail and a hinge that is pushed about, and a ball on its pad."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    spec.option.gravity = [0, 0, 0]
    finger = spec.worldbody.add_body(name="finger")
    finger.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
    finger.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    finger.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.005, 0, 0], mass=0.02, contype=0, conaffinity=0
    )
    ball = spec.worldbody.add_body(name="ball", pos=[-0.009, -0.0107, 0.001])
    ball.add_freejoint()
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.01)
    return spec


@pytest.mark.law
@pytest.mark.parametrize(
    "coupling, steps", [pytest.param("one-way", 12, marks=pytest.mark.slow), ("two-way", 9)]
)
def test_inertia_of_the_skin_is_that_of_the_engine_plugin(coupling, steps):
    """Two worlds, pushed with other forces; two-way until they touch, where a batch solves its skins once.
    The second is reset at last, to begin at rest again."""
    push, heavy = np.array([[-0.06, 1e-5], [-0.05, -5e-6]]), {"density": 1e5}  # so that inertia shows
    settings = {
        "skin": shell(),
        "options": {"skin": INERTIA},
        "material": heavy,
        "coupling": coupling,
        "geoms": ["ball"],
    }
    spec = shaken_spec()
    batches.add(spec, body="finger", skin=shell(), coupling=coupling, geoms=["ball"])
    spec.body("biotac_core").mass, spec.body("biotac_core").fullinertia = 1e-7, [1e-13] * 3 + [0.0] * 3
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=2)
    batch = batches.attach(mjm, m, d, readings=False, **settings)
    force = np.zeros((2, mjm.nv))
    force[:, :2] = push
    d.qfrc_applied.assign(force)
    rest, got, moved = batch.vert_xpos, [], []
    for _ in range(steps):
        mjw.step(m, d)
        got.append(read(mjm, d, "contact_force")[:, :3].copy()), moved.append(batch.vert_xpos - rest)
    for w in range(2):
        spec = shaken_spec()
        handle = biotac_mj.attach(spec, body="finger", **settings)
        spec.body("biotac_core").mass, spec.body("biotac_core").fullinertia = 1e-7, [1e-13] * 3 + [0.0] * 3
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qfrc_applied[:2] = push[w]
        one, there = [], []
        for _ in range(steps):
            mujoco.mj_step(model, data)
            one.append(handle.read(data, "contact_force")[:3]), there.append(handle.vert_xpos(model, data))
        there = np.array(there) - shell().vert
        assert np.abs(there).max() > 2e-4 and (np.abs(one).max() > 0.02) == (coupling == "one-way")
        np.testing.assert_allclose(np.array(moved)[:, w], there, atol=1e-4 * np.abs(there).max())
        np.testing.assert_allclose(np.array(got)[:, w], one, atol=2e-3)
    batch.reset(np.array([False, True]))
    assert (batch.vert_xpos[1] == rest[1]).all() and batch.skin.fresh.numpy().tolist() == [0, 1]


@pytest.mark.law
def test_memory_and_liquids_of_worlds_equal_single_worlds():
    """Relaxation, friction in the rubber, adhesion, law of friction, fill and a modulus by element: two
    worlds, the second of which is reset and pressed again as if nothing had been."""
    rng = np.random.default_rng(5)
    rubber = [{"prony": [[g, 0.01]], "hysteresis": [[0.4, y]]} for g, y in ((0.2, 0.003), (0.5, 0.006))]
    modulus = rng.uniform(0.7, 1.4, (2, len(shell().elem)))
    law = {"friction_exponent": [0.1, 0.4], "adhesion": [0.02, 0.05]}
    skin = {"contact_stiffness": K, "tolerance": 1e-5, "contact_law": {"adhesion_range": 5e-5}}
    worlds = {**law, "modulus": modulus, "fill_volume": [0.0, 1e-8]}
    mjm, m, d, batch = make(
        press_spec(), 2, material=rubber, options={"skin": skin}, worlds=worlds, readings=False
    )
    start, depth = places(2), [1.2e-3, 1.0e-3]
    first = [read(mjm, d, "contact_force")[:, :3].copy() for _ in press(m, d, start, 6, depth)]
    batch.reset(np.array([False, True]))
    again = [read(mjm, d, "contact_force")[:, :3].copy() for _ in press(m, d, start, 6, depth)]
    got = np.array([np.array(first)[:, 0], np.array(again)[:, 1]])
    np.testing.assert_allclose(got[1], np.array(first)[:, 1], atol=1e-4 * abs(got).max())
    assert abs(np.array(again)[:, 0] - got[0]).max() > 2e-3 * abs(got).max()  # it remembers
    inwards = -start * [0, 1, 1] / np.linalg.norm(start[:, 1:], axis=1, keepdims=True)
    paths = start + np.arange(1, 7)[:, None, None] / 6 * np.array(depth)[:, None] * inwards
    mine = {"contact_law": {"adhesion_range": 5e-5} | {k: v[0] for k, v in law.items()}}
    expected = single(
        paths[:, 0], shell(), {"material": rubber[0], "options": {"skin": skin | mine, "modulus": modulus[0]}}
    )[:, :3]
    np.testing.assert_allclose(got[0], expected, atol=2e-3 * abs(expected).max())


@pytest.mark.slow  # quick: two fingers hold a ball in test_batch_together.py
def test_a_ball_between_two_biotacs_feels_both():
    spec = ball_spec()
    spec.option.gravity = [0, 0, 0]
    spec.body("ball").pos = [-8e-3, -7e-3 - RADIUS + 4e-4, 0]
    spec.body("ball").first_joint().damping = [0.3, 0, 0]
    across = {"pos": [0, -2 * (7e-3 + RADIUS) + 6e-4, 0], "quat": [0, 1, 0, 0]}  # its pad looks along +y
    for prefix, pose in (("biotac_", {}), ("other_", across)):
        batches.add(spec, body="world", skin=shell(), prefix=prefix, **pose)
    mjm = spec.compile()
    data = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, data)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, data, nworld=1)
    both = [
        batches.attach(mjm, m, d, skin=shell(), prefix=prefix, readings=False)
        for prefix in ("biotac_", "other_")
    ]
    for _ in range(90):
        mjw.step(m, d)
    force = [
        d.sensordata.numpy()[0, mjm.sensor(f"{p}contact_force").adr[0] :][:3] for p in ("biotac_", "other_")
    ]
    assert force[0][1] > 0.02 and np.abs(d.qvel.numpy()).max() < 1e-4
    assert force[1][1] == pytest.approx(force[0][1], rel=0.01)
    assert d.qpos.numpy()[0, 0] == pytest.approx(-1e-4, abs=3e-5)  # half-way between the pads
    both[1].active = False
    for _ in range(10):
        mjw.step(m, d)
    assert d.qpos.numpy()[0, 0] < -3e-4  # nothing holds it against the first


def test_each_world_has_its_liquid():
    mjm, m, d, batch = make(press_spec(), 3, readings={"noise": False})
    batch.skin.data.set_liquid(bulk_modulus=[2.2e9, 0.0, 2.2e9], fill_volume=[0.0, 0.0, 1e-8])
    start = np.repeat(places(1), 3, axis=0)
    for _ in press(m, d, start, 10, [1.2e-3] * 3):
        pass
    force, pdc = read(mjm, d, "contact_force")[:, :3], read(mjm, d, "pdc")[:, 0]
    assert (read(mjm, d, "status")[:, 0] == 1).all()
    assert pdc[1] == 2000 and pdc[0] > 2005 and pdc[2] > pdc[0] + 5
    force = np.linalg.norm(force, axis=1)
    assert force[1] < 0.98 * force[0] < 0.98 * force[2]


@pytest.mark.law
def test_reset_of_some_worlds():
    mjm, m, d, batch = make(press_spec(), 3)
    start = places(3)
    for _ in press(m, d, start, 6, [1e-3] * 3):
        pass
    x = batch.vert_xpos
    batch.reset([False, True, False])
    now = batch.vert_xpos
    np.testing.assert_array_equal(now[[0, 2]], x[[0, 2]])
    np.testing.assert_array_equal(now[1], shell().vert)
    assert np.abs(x[1] - now[1]).max() > 3e-4
    first = [read(mjm, d, "contact_force")[1].copy() for _ in press(m, d, start, 6, [1e-3] * 3)]
    _, m, d, _ = make(press_spec(), 3)
    again = [read(mjm, d, "contact_force")[1].copy() for _ in press(m, d, start, 6, [1e-3] * 3)]
    np.testing.assert_allclose(first, again, atol=1e-3 * np.abs(again).max())  # the solver's tolerance
    with pytest.raises(ValueError, match=r"world_mask has shape \(2,\).*\(3,\) of bool"):
        batch.reset([True, False])


def test_an_inactive_batch_changes_nothing():
    mjm, m, d, batch = make(ball_spec(), 1, readings=False)
    batch.active = False
    for _ in range(12):
        mjw.step(m, d)
    # free fall, through the pad
    assert d.qpos.numpy()[0, 0] == pytest.approx(9.81 * DT**2 * 12 * 13 / 2, rel=1e-4)
    assert (read(mjm, d, "status") == 0).all()


def test_a_callback_that_was_there_is_kept():
    spec = ball_spec()
    batches.add(spec, body="world", skin=shell())
    mjm = spec.compile()
    m, d = mjw.put_model(mjm), mjw.make_data(mjm, nworld=1)
    seen = []
    m.callback.passive = lambda m, d: seen.append("passive")
    m.callback.sensor = lambda m, d, stage: seen.append("sensor")
    batches.attach(mjm, m, d, skin=shell(), readings=False)
    mjw.step(m, d)
    assert seen.count("passive") == 1 and seen.count("sensor") == 3 and read(mjm, d, "status")[0, 0] == 1


def attach(mjm, nworld=1, **settings):
    data = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, data)
    put = {k: settings.pop(k) for k in ("njmax",) if k in settings}
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, data, nworld=nworld, **put)
    return batches.attach(mjm, m, d, skin=shell(), **settings)


def test_errors_say_what_to_do():
    spec = ball_spec()
    with pytest.raises(
        ValueError,
        match="no BioTac 'biotac_': add it to the spec with biotac_mj.batch.add; "
        "the model's bodies are world, ball",
    ):
        attach(spec.compile())
    batches.add(spec, body="world", skin=shell())
    two = ball_spec()
    for prefix in ("thumb", "index_"):
        batches.add(two, body="world", skin=shell(), prefix=prefix)
    with pytest.raises(ValueError, match="no BioTac 'left_': give prefix= one of 'thumb', 'index_'"):
        attach(two.compile(), prefix="left_")
    with pytest.raises(ValueError, match="prefix 'biotac_' is taken"):
        batches.add(spec, body="world", skin=shell())
    mjm = spec.compile()
    with pytest.raises(ValueError, match="2 materials for 3 worlds: pass one for each"):
        attach(mjm, 3, material=["default"] * 2)
    with pytest.raises(ValueError, match=r"friction is \[0.1, 0.2\] of shape \(2,\)"):
        attach(mjm, 3, friction=[0.1, 0.2])
    with pytest.raises(ValueError, match=r"worlds has 'adhesive': did you mean 'adhesion'\? choose from"):
        attach(mjm, 3, worlds={"adhesive": 0.1})
    with pytest.raises(ValueError, match=r"modulus has shape \(2, 5\)"):
        attach(mjm, 3, worlds={"modulus": np.ones((2, 5))})
    with pytest.raises(ValueError, match="larger njmax"):
        attach(mjm, njmax=12)
    for flags, text in (
        ("rk4", "integrator implicitfast"),
        ("spring", "springs and dampers"),
        ("equality", "coupling='one-way'"),
    ):
        other = ball_spec()
        if flags == "rk4":
            other.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        elif flags == "spring":
            other.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_SPRING) | int(
                mujoco.mjtDisableBit.mjDSBL_DAMPER
            )
        else:
            other.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
        batches.add(other, body="world", skin=shell())
        with pytest.raises(ValueError, match=text):
            attach(other.compile())
    crowded = ball_spec()
    batches.add(crowded, body="world", skin=shell(), coupling="one-way")
    with pytest.raises(
        ValueError,
        match="no room for two-way coupling of the BioTac 'biotac_' with ball: add it after the objects",
    ):
        attach(crowded.compile())


def test_without_contact_nothing_touches():
    """As in `mj_step`: the ball falls through the skin as if that were not there."""
    spec = ball_spec()
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    mjm, m, d, batch = make(spec, 2)
    for _ in range(20):
        mjw.step(m, d)
    assert (read(mjm, d, "status")[:, 0] == 1).all()
    assert not read(mjm, d, "contact_force").any()
    np.testing.assert_allclose(d.qvel.numpy()[:, 0], 20 * DT * 9.81, rtol=1e-5)


@pytest.mark.parametrize("geoms, met", [(None, ["ball", "other"]), (["ball"], ["ball"]), ([], [])])
def test_the_skin_meets_what_its_core_meets(geoms, met):
    """Geoms that `add` names collide in contact pairs; `attach`, which is told nothing, finds them there."""
    spec = ball_spec()
    other = spec.worldbody.add_body(name="other", pos=[0, 0, 1])
    other.add_freejoint()
    other.add_geom(name="other", size=[5e-3, 0, 0])
    batches.add(spec, body="world", skin=shell(), geoms=geoms)
    mjm = spec.compile()
    m, d = mjw.put_model(mjm), mjw.make_data(mjm, nworld=1, njmax=50)
    batch = batches.attach(mjm, m, d, skin=shell(), readings=False)
    assert [mjm.geom(int(i)).name for i in batch._geom.numpy()] == met


@pytest.mark.parametrize("how", ["all", "pairs", "set before"])
def test_core_nail_and_clamp_have_the_friction_of_the_skin(how):
    """That of `attach`, in each world; what somebody set between `add` and it stays."""
    spec, geoms = ball_spec(), ["ball"] if how == "pairs" else None
    batches.add(spec, body="world", skin=shell(), geoms=geoms)
    if how == "set before":
        spec.geom("biotac_core").friction[0] = 0.4
    mjm = spec.compile()
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=3)
    mu = [1.2, 1.3, 1.4]
    batches.attach(mjm, m, d, skin=shell(), geoms=geoms, friction=mu, priority=1)
    core, ball = mjm.geom("biotac_core").id, mjm.geom("ball").id
    found = m.geom_friction.numpy()[:, :, 0]
    np.testing.assert_allclose(found[:, core], 0.4 if how == "set before" else mu)
    np.testing.assert_allclose(found[:, ball], mjm.geom_friction[ball, 0])
    assert m.geom_priority.numpy()[[core, ball]].tolist() == [1, 0]
    pairs = m.pair_friction.numpy()
    assert pairs.shape[1] == (how == "pairs")
    for pair in pairs.swapaxes(0, 1):
        np.testing.assert_allclose(pair[:, :2], np.stack([mu, mu], 1))
        np.testing.assert_allclose(pair[:, 2:], np.tile(mjm.pair_friction[0, 2:], (3, 1)))


def test_a_sensor_is_attached_once():
    mjm, m, d, _ = make(ball_spec(), 2)
    with pytest.raises(ValueError, match="attached to the mujoco_warp Model already: attach it once"):
        batches.attach(mjm, m, d, skin=shell())


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device: graphs exist only there")
def test_the_step_is_captured_in_a_graph():
    _, m, d, _ = make(ball_spec(), 4)
    mjm, m2, d2, _ = make(ball_spec(), 4)
    mjw.step(m, d)  # compiles
    mjw.step(m2, d2)
    with wp.ScopedCapture() as capture:
        mjw.step(m2, d2)
    for _ in range(60):
        mjw.step(m, d)
        wp.capture_launch(capture.graph)
    np.testing.assert_allclose(d2.qpos.numpy(), d.qpos.numpy(), atol=1e-7)
    np.testing.assert_allclose(read(mjm, d2, "electrodes"), read(mjm, d, "electrodes"), atol=1)
