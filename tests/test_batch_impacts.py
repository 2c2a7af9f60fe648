"""What no impact may do in a batch, beside the engine plugin: gain energy, be lent any, pass through the
finger, lose the skin's force. mujoco_warp's state is of single precision, so is what both begin with."""

import mujoco
import numpy as np
import pytest

mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")

# ruff: noqa: E402
import warp as wp
from blocks import four_nodes

import biotac_mj
from biotac_mj import batch as batches
from biotac_mj.batch import solid_contacts
from biotac_mj.batch.engine import Contacts, Rows
from biotac_mj.skin import SkinOptions

# four nodes an element: a quarter of the work of the shipped skin's ten, which those tests take ("coarse")
# whose impact does not come about on a stiffer skin
SKIN = four_nodes("coarse")
PAD_UP = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
TIP = {"body": "finger", "quat": PAD_UP, "pos": [6.2e-3, 0, 0]}
APEX = 8.31e-3  # [m] height of the pad over the finger's axis


@pytest.fixture(scope="module", autouse=True)
def where_batches_run(default_device):
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        yield


def scene(objects, timestep, option="", finger=""):
    return (
        f'<mujoco><option timestep="{timestep}" {option}/><worldbody><body name="finger">{finger}</body>'
        f'<site name="tip" quat="1 -1 0 0"/>{objects}</worldbody></mujoco>'
    )


class Seen:
    """What a run does: energy (nstep + 1,) [J], kinetic energy at its start, the most that is gained as a
    share of it, the body's height over the finger [m], status (nstep, 8), force (nstep, 3) [N] and its size,
    that of the skin's last solve alone (own, of batches), how fast it is (nstep + 1, nv), where and how fast
    it ends."""

    def __init__(self, model, states, status, force, own=None):
        data = mujoco.MjData(model)
        energy = []
        for qpos, qvel in states:
            data.qpos[:], data.qvel[:] = qpos, qvel
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_energyPos(model, data)
            mujoco.mj_energyVel(model, data)
            energy.append(data.energy.copy())
        self.qpos, self.qvel = states[-1]
        self.height = data.xipos[-1, 2] - data.xpos[1, 2]
        energy = np.array(energy)
        self.energy = energy.sum(axis=1)
        self.kinetic, gained = energy[0, 1], (energy.sum(axis=1) - energy[0].sum()).max()
        self.growth = gained / self.kinetic if self.kinetic else np.inf
        self.status, self.force = np.array(status), np.array(force)
        self.touched = int(self.force.any(axis=1).sum())
        self.lost = int((self.status[:, 0] != 1).sum())
        self.size = np.linalg.norm(self.force, axis=1)
        self.own = None if own is None else np.linalg.norm(own, axis=1)
        self.speed = np.array([v for _, v in states])


def in_batch(xml, qpos, qvel, steps, where, readings=False, skin=SKIN, **settings):
    """A `Seen` of each world, and energies [J] that the skins could give (nstep, nbody, nworld)."""
    spec = mujoco.MjSpec.from_string(xml)
    batches.add(spec, **where, skin=skin)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=len(qpos), nconmax=32, njmax=128)
    batch = batches.attach(model, m, d, skin=skin, readings=readings, **settings)
    d.qpos.assign(np.asarray(qpos, np.float32))
    d.qvel.assign(np.asarray(qvel, np.float32))
    states, status, force, own, store = [(d.qpos.numpy().copy(), d.qvel.numpy().copy())], [], [], [], []
    begin = {c: int(model.sensor(f"biotac_{c}").adr[0]) for c in ("status", "contact_force")}
    for _ in range(steps):
        mjw.step(m, d)
        read = d.sensordata.numpy().copy()
        states.append((d.qpos.numpy().copy(), d.qvel.numpy().copy()))
        status.append(read[:, begin["status"] :][:, :8])
        force.append(read[:, begin["contact_force"] :][:, :3])
        own.append(batch.wrench[:, 0, :3].copy())
        store.append(batch._of_step.left.numpy().copy())
    worlds = [
        Seen(
            model, [(q[w], v[w]) for q, v in states], *([x[w] for x in rows] for rows in (status, force, own))
        )
        for w in range(len(qpos))
    ]
    return worlds, np.array(store)


def in_plugin(xml, qpos, qvel, steps, where, skin=SKIN, **settings):
    spec = mujoco.MjSpec.from_string(xml)
    handle = biotac_mj.attach(spec, **where, skin=skin, readings="none", **settings)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.float32(qpos), np.float32(qvel)
    mujoco.mj_forward(model, data)
    states, status, force = [(data.qpos.copy(), data.qvel.copy())], [], []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy()))
        status.append(handle.read(data, "status"))
        force.append(handle.read(data, "contact_force")[:3])
    return Seen(model, states, status, force)


def thrown_box(inertia="", places=(0.0, 0.15, 0.3), integrator="Euler"):
    """A box of 1.115 g that is thrown so that a corner comes 5 mm a step, from places on its way of the first
    one: its time step [s], what it does in each world, and energies that the skin could give it."""
    box = (
        f'<body name="box"><freejoint/>{inertia}'
        '<geom type="box" size=".008293 .004844 .007986" mass=".001115" friction="0"/></body>'
    )
    quat = np.array([-0.225419, -0.0676020, -0.113161, -0.965303])
    start = [-0.0276994, -0.0033384, 0.0185314, *(quat / np.linalg.norm(quat))]
    velocity, timestep = np.array([0.253901, 0.100407, -0.544565, -8.408973, 55.940941, -5.622781]), 0.01
    qpos = np.tile(start, (len(places), 1))
    qpos[:, :3] += np.outer(places, timestep * velocity[:3])
    settings = dict(material={"youngs_modulus": 8e6}, liquid=True, friction=0.371493)
    thrown = qpos, np.tile(velocity, (len(places), 1)), 4, {"site": "tip"}
    option = f'cone="elliptic" integrator="{integrator}"'
    return timestep, *in_batch(scene(box, timestep, option), *thrown, **settings)


@pytest.mark.slow  # quick: the same box in the plugin, by the same rules; skins without energy push nobody
def test_a_thrown_box_is_lent_nothing():
    """What a first step in touch may give is what was put into the skin, not all that it can hold. A step is
    longer than the box is in touch, so that one may do: what pushes it is as much as the box brought."""
    timestep, seen, store = thrown_box()
    assert np.any([world.force[0].any() for world in seen])  # touch at once
    for world, lent in zip(seen, store.T):
        brought = 0.001115 * np.linalg.norm(world.speed[0, :3])
        assert world.growth < 0.05 and timestep * world.size.sum() > 0.5 * brought
        lost = world.energy[0] - world.energy[1:]  # by the body, in whose fall is as much as in its speed
        assert 0 < lent.max() and (lent < lost + 0.1 * world.kinetic).all()


@pytest.mark.slow  # quick: as above
def test_a_thrown_box_gains_and_owes_nothing():
    """However its steps end. A solve that lost its way may leave kilonewtons: no account goes below zero by
    their rounding. Energy is that of the mean velocity in a step, half a step before, and the moments of
    inertia are equal: else gravity, and Euler's velocity products, as they were when the step began, seem to
    add up to a fifth of it."""
    timestep, seen, store = thrown_box(
        '<inertial pos="0 0 0" mass=".001115" diaginertia="33e-9 33e-9 33e-9"/>'
    )
    assert np.any([world.force.any() for world in seen])
    for world, lent in zip(seen, store.T):
        energy = world.energy - 0.5 * timestep * 0.001115 * 9.81 * world.speed[:, 2]
        assert energy.max() < energy[0] + 0.01 * world.kinetic and lent.min() > -1e-3 * world.kinetic
    _timestep, seen, store = thrown_box(places=(0.079, 0.2526), integrator="implicitfast")
    assert store.min() > -1e-3 * seen[0].kinetic


def rolling(mass, friction, timestep):
    ball = f'<body name="ball"><freejoint/><geom size=".00237" mass="{mass}" friction="0"/></body>'
    return (
        scene(ball, timestep, 'integrator="implicitfast"'),
        [-0.00997067, 0.00157612, 0.01077133, np.sqrt(0.5), np.sqrt(0.5), 0, 0],
        [0.14719, 0, 0, 0.683, -0.353, -0.458],
        {"material": "paper", "friction": friction},
    )


@pytest.mark.slow  # quick: a lighter one settles, and this one does in the plugin, by the same rules
def test_a_rolling_ball_settles_where_the_plugins_ball_does():
    """Rounds that come closer by little are no reason to shorten them; six of them were too few."""
    xml, qpos, qvel, settings = rolling(0.02, 1.0, 0.005)
    settings["skin"] = "coarse"
    (seen,), _ = in_batch(xml, [qpos], [qvel], 22, {"site": "tip"}, **settings)
    # nobody waits for a batch, so the plugin is given as long: by its own bound it loses two steps
    settings["options"] = {"skin": {"max_work": SkinOptions().max_work}}
    expected = in_plugin(xml, qpos, qvel, 22, {"site": "tip"}, **settings)
    assert seen.touched > 12 and seen.growth < 0.05 and seen.lost <= 4
    assert (seen.status[:, 7] == 0).all()  # nothing is withheld
    np.testing.assert_allclose(seen.qpos[:3], expected.qpos[:3], atol=3e-5)
    assert seen.size.max() == pytest.approx(expected.size.max(), rel=0.1)


@pytest.mark.slow  # quick: this ball and a thrown box in the plugin
def test_a_light_ball_that_rolls_gains_nothing():
    xml, qpos, qvel, settings = rolling(2.335e-3, 2.0, 0.005)
    qvel[0] += 1e-4  # without, 6 or 20 steps were lost by the last digit of where a step ends
    settings["skin"] = "coarse"  # on four nodes it gains nothing either where nothing is withheld
    (seen,), store = in_batch(xml, [qpos], [qvel], 22, {"site": "tip"}, **settings)
    fallen = 2.335e-3 * 9.81 * (qpos[2] - seen.qpos[2])  # [J]
    assert seen.touched > 12 and seen.growth < 0.05 and store.max() < 1.05 * (seen.kinetic + fallen)
    assert seen.lost <= 6  # of 22 steps; which ones is chance, as small as the rest of a balance


def test_bodies_that_start_inside_are_pushed_out():
    """One that begins where no skin fits is lent what it takes, since what was put in is not known."""
    ball = '<body name="ball"><freejoint/><geom size=".005" mass=".05"/></body>'
    qpos = [[0, 0, z, 1, 0, 0, 0] for z in (0.0118, 0.0112, 0.0105)]
    xml = scene(ball, 0.002, 'gravity="0 0 0"')
    seen, _ = in_batch(xml, qpos, np.zeros((3, 6)), 20, TIP)
    for world in seen:
        assert world.qvel[2] > 0.1 and world.qpos[2] > 0.0135 and world.size[-1] == 0
        assert (world.force[:, 1] >= -1e-3 * world.size.max()).all()  # on the finger: it never pulls
        assert (world.status[:, 7] == 0).all() and world.lost <= 8


def impact(seed, nworld):
    """A body thrown at a finger, and how in each world."""
    rng = np.random.default_rng([77, seed])
    mass, timestep = 10 ** rng.uniform(-3, 0), float(rng.choice([0.001, 0.002, 0.004]))
    kind, size = (
        rng.choice(["sphere", "box", "capsule", "cylinder", "ellipsoid"]),
        10 ** rng.uniform(-2.5, -1.8, 3),
    )
    thrown = (
        f'<body name="thrown"><freejoint/><geom type="{kind}" size="{size[0]} {size[1]} {size[2]}" '
        f'mass="{mass}" friction="{rng.uniform(0.1, 1.2)}"/></body>'
    )
    integrator = rng.choice(["Euler", "implicitfast", "implicit"])
    quat = rng.normal(size=(nworld, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    height = np.full((nworld, 1), APEX + 1.75 * size.max())
    qpos = np.concatenate([rng.uniform(-0.004, 0.004, (nworld, 2)), height, quat], axis=1)
    still = np.zeros((nworld, 2))
    spin = rng.normal(size=(nworld, 3)) * 10 ** rng.uniform(-1, 1.3, (nworld, 1))
    qvel = np.concatenate([still, -rng.uniform(0.05, 1.0, (nworld, 1)), spin], axis=1)
    return scene(thrown, timestep, f'gravity="0 0 0" integrator="{integrator}"'), qpos, qvel, timestep


def table(seeds, nworld, skin, seconds=0.05):
    """Of random impacts: {"batch", "plugin": [`Seen`]}."""
    out = {"batch": [], "plugin": []}
    for seed in seeds:
        xml, qpos, qvel, timestep = impact(seed, nworld)
        steps = int(seconds / timestep)
        out["batch"] += in_batch(xml, qpos, qvel, steps, TIP, skin=skin)[0]
        out["plugin"] += [in_plugin(xml, q, v, steps, TIP, skin=skin) for q, v in zip(qpos, qvel)]
    return out


@pytest.mark.slow  # quick: what each body of the others does
@pytest.mark.parametrize("seeds, skin", [((0,), SKIN), (range(12), "coarse")], ids=["one", "all"])
def test_random_impacts_are_those_of_the_plugin(seeds, skin):
    """Steps without a balance are as many as the plugin's; where both settle, bodies leave alike."""
    seen = table(seeds, 2, skin)
    for name, cases in seen.items():
        lost, touched = (sum(getattr(c, x) for c in cases) for x in ("lost", "touched"))
        print(
            f"{name}: {len(cases)} cases, growth {max(c.growth for c in cases):.3f}, through "
            f"{sum(c.height < -0.012 for c in cases)}, dropped "
            f"{sum((c.status[:, 0] == -1).any() for c in cases)}, unconverged {lost} of {touched}"
        )
        assert touched > 2 * len(seeds)
        for case in cases:
            assert case.growth < 0.05 and case.height > -0.012 and (case.status[:, 0] >= 0).all()
    both = list(zip(*seen.values()))
    settled = [(a, b) for a, b in both if a.lost + b.lost == 0 and b.touched]
    assert 2 * len(settled) >= len(seeds)  # mostly the plugin loses steps: it may spend less on each
    for a, b in settled:
        np.testing.assert_allclose(a.qvel[:3], b.qvel[:3], atol=0.03 * np.linalg.norm(b.qvel[:3]))
    assert sum(a.lost for a, _ in both) <= 1.5 * sum(b.lost for _, b in both) + 3


@pytest.mark.law
def test_a_thrown_box_has_the_force_of_the_plugin():
    """To single precision, also where the candidates of a long step find no room at first."""
    box = '<body><freejoint/><geom type="box" size=".004 .004 .004" mass="0.0486"/></body>'
    quat = np.array([-2.828, 1.021, -0.960, -1.669])
    qpos = np.concatenate([[-0.009, 0.001, 0.0155], quat / np.linalg.norm(quat)])
    qvel = np.array([0.07, -0.044, -0.314, 0.131, -0.264, 7.03])
    xml = scene(box, 0.002, 'integrator="implicit"')
    where = {"site": "tip"}
    single = in_plugin(xml, qpos, qvel, 12, where, skin="coarse", tier="condensed")
    batch = in_batch(xml, qpos[None], qvel[None], 12, where, skin="coarse", tier="condensed")[0][0]
    assert single.touched > 8 and batch.lost + single.lost == 0
    np.testing.assert_allclose(batch.force, single.force, atol=1e-5 * single.size.max())


@pytest.mark.slow
def test_a_gem_with_corners_has_the_force_of_the_plugin():
    """Its light body turns fast, so that the integrator's accelerations are not the constraint solver's: what
    a batch left of that difference, 1e-4 of the wrench, parted the forces by 2e-5."""
    turn = np.arange(8) * np.pi / 4
    rings = ((2.2, 1.4, np.pi / 8), (4.0, 0.2, 0.0))
    rings = [np.stack([r * np.cos(turn + o), r * np.sin(turn + o), 0 * turn + z]) for r, z, o in rings]
    vert = np.concatenate([*rings, [[0.0], [0.0], [-3.4]]], axis=1).T / 1e3
    gem = '<body><freejoint/><geom type="mesh" mesh="gem" mass=".03" friction="0"/></body>'
    asset = f'<asset><mesh name="gem" vertex="{" ".join(f"{x:.5f}" for x in vert.ravel())}"/></asset>'
    xml = scene(gem, 0.001, 'integrator="implicitfast"').replace("<worldbody>", asset + "<worldbody>")
    quat = np.random.default_rng(1).normal(size=4)
    qpos = np.concatenate([[-0.01, 0.0005, 0.0121], quat / np.linalg.norm(quat)]).astype(np.float32)
    qvel = np.array([0.02, 0.01, -0.12, 0.0, 0.0, 0.0], np.float32)
    settings = dict(skin="coarse", tier="condensed", friction=0.0)
    single = in_plugin(xml, qpos, qvel, 26, {"site": "tip"}, **settings)
    batch = in_batch(xml, qpos[None], qvel[None], 11, {"site": "tip"}, **settings)[0][0]
    assert batch.touched >= 9 and batch.lost + single.lost == 0
    np.testing.assert_allclose(batch.force, single.force[:11], atol=1e-5 * single.size.max())


@pytest.mark.law
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_the_second_step_of_a_batch_has_the_force_of_the_plugin(integrator):
    """Friction begins where it was at the end of the first step, in which the skin rests; and the body turns
    in both as MuJoCo's integrator turns it."""
    capsule = '<body><freejoint/><geom type="capsule" size=".00465 .00725" mass=".012"/></body>'
    quat = np.array([-0.2163, -0.1429, 0.9007, -0.3485])
    qpos = np.concatenate([[-0.0063, -0.0014, 0.0206], quat / np.linalg.norm(quat)]).astype(np.float32)
    qvel = np.array([-0.05, 0.012, -0.68, 4.6, 4.1, -7.2], np.float32)  # both begin at the same numbers
    xml = scene(capsule, 0.004, f'integrator="{integrator}"')
    where = {"site": "tip"}
    single = in_plugin(xml, qpos, qvel, 5, where, skin="coarse", tier="condensed")
    batch = in_batch(xml, qpos[None], qvel[None], 5, where, skin="coarse", tier="condensed")[0][0]
    assert single.size[0] == 0.0 < single.size[1] and batch.lost + single.lost == 0
    np.testing.assert_allclose(batch.force, single.force, atol=1e-5 * single.size.max())


@pytest.mark.law
@pytest.mark.parametrize(
    "timestep, integrator", [(0.004, "Euler"), (0.004, "implicitfast"), (0.002, "Euler")]
)
def test_two_light_balls_on_a_pad_have_the_force_of_the_plugin(timestep, integrator):
    """They touch each other, too: which of that contact's rows hold changes within a step. Where the next
    round takes them as they are, rounds converge as Newton's method does."""
    balls = "".join(
        f'<body pos="{x} 0 {z}"><freejoint/><geom size=".003" mass="{mass}"/></body>'
        for x, z, mass in ((-0.0095, 0.0125, 0.005), (-0.01545, 0.0123, 0.008))
    )
    xml = scene(balls, timestep, f'integrator="{integrator}"')
    qpos = mujoco.MjModel.from_xml_string(xml).qpos0.astype(np.float32)  # both begin at the same numbers
    qvel = np.array([0, 0, -0.3, 1, 2, 0, 0, 0, -0.3, 0, -2, 1], np.float32)
    steps, where = round(0.02 / timestep), {"site": "tip"}
    single = in_plugin(xml, qpos, qvel, steps, where, skin="coarse", tier="condensed")
    batch = in_batch(xml, qpos[None], qvel[None], steps, where, skin="coarse", tier="condensed")[0][0]
    assert single.touched >= 4 and batch.lost + single.lost == 0
    assert max(single.status[:, 5].max(), batch.status[:, 5].max()) <= 3
    np.testing.assert_allclose(batch.force, single.force, atol=2e-5 * single.size.max())


@pytest.mark.law
def test_balls_that_slide_on_an_elliptic_cone_as_in_the_plugin():
    """Two spinning balls rub on each other over a pad, and their contact holds by the Hessian of its cone;
    without it six of twelve steps took another round, and forces parted by 6e-4."""
    balls = "".join(
        f'<body pos="{x} 0 .0142"><freejoint/><geom size=".006" mass="{mass}" friction=".3"/></body>'
        for x, mass in ((-0.0095, 0.01), (0.0023, 0.02))
    )
    xml = scene(balls, 0.002, 'cone="elliptic" impratio="10"')
    qpos = mujoco.MjModel.from_xml_string(xml).qpos0.astype(np.float32)
    qvel = np.array([0.3, 0.2, -0.2, 0, 0, 5, -0.3, -0.2, -0.1, 0, 20, 0], np.float32)
    where = {"site": "tip"}
    single = in_plugin(xml, qpos, qvel, 12, where, skin="coarse", tier="condensed")
    batch = in_batch(xml, qpos[None], qvel[None], 12, where, skin="coarse", tier="condensed")[0][0]
    assert single.touched >= 10 and batch.lost + single.lost == 0
    np.testing.assert_array_equal(batch.status[:, 5], single.status[:, 5])
    np.testing.assert_allclose(batch.force, single.force, atol=5e-5 * single.size.max())


@pytest.mark.slow
def test_a_ball_that_hits_and_leaves_settles_in_every_step():
    """Friction begins where the ball meets the skin in every round, not in the first alone; and one that
    leaves is not held back by the skin that it touched when the step began."""
    ball = '<body name="ball"><freejoint/><geom size=".00894" mass=".0054" friction=".516"/></body>'
    qpos = [[-0.0025, -0.0022, 0.0275, 1, 0, 0, 0], [-0.0015, -0.0035, 0.0262, 1, 0, 0, 0]]
    qvel = [[0, 0, -0.81, 15, 5, 0.8], [0, 0, -0.87, -0.6, 0.2, 0.4]]
    seen, _ = in_batch(scene(ball, 0.002, 'gravity="0 0 0"'), qpos, qvel, 16, TIP, skin="coarse")
    for world in seen:
        assert world.touched >= 3 and world.size[-1] == 0 and world.qvel[2] > 0.2  # it came and went
        # of one step rounds go to and fro beside a kink of friction: 7 to 12 of them, by the last digit
        assert world.lost == 0 and world.status[:, 5].max() <= 12
        assert np.median(world.status[:, 5]) <= 2


def where_it_ends(model, batch, d):
    """How far the first touching body of each world is from where its batch expected it to go [m], points of
    it at a fingertip's size, (nworld,)."""
    data, r, out = mujoco.MjData(model), batch._of_step, []
    expected = zip(r.end_pos.numpy()[0], r.end_mat.numpy()[0])
    core, body = batch._core, int(batch._body.numpy()[0])
    for qpos, (pos, mat) in zip(d.qpos.numpy(), expected):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        frame = data.xmat[core].reshape(3, 3).T
        off = frame @ (data.xpos[body] - data.xpos[core]) - pos
        turn = frame @ data.xmat[body].reshape(3, 3) - mat
        out.append(np.linalg.norm(off) + 0.01 * np.linalg.norm(turn))
    return np.array(out)


@pytest.mark.slow  # quick: the same finger in the plugin, by the same rules
def test_a_finger_that_swings_round_in_a_step_is_lent_nothing():
    """600 g turn a finger of 6 g on its hinge by a third of a radian a step. That it went round in an arc
    was taken for a hand that had pressed the body in: the skin was lent nine tenths of all energy, and gave
    six."""
    finger = (
        '<joint axis="1 0 0" pos=".04 0 -.005"/><geom type="box" size=".008 .008 .008" mass=".006" '
        'pos="-.0021 0 -.01" contype="0" conaffinity="0"/>'
    )
    thrown = (
        '<body name="thrown"><freejoint/>'
        '<geom type="ellipsoid" size=".00295 .00458 .00567" mass=".6" friction=".376"/></body>'
    )
    qpos = [0, -0.00052, 0.00379, 0.0158, -0.5278, -0.23733, -0.761286, -0.292482]
    qvel = [0, 0, 0, -0.9284, -8.6607, -0.4185, -5.8161]
    (seen,), store = in_batch(scene(thrown, 0.004, 'gravity="0 0 0"', finger), [qpos], [qvel], 8, TIP)
    has = seen.energy + np.concatenate([[0], store[..., 0].sum(1)])
    assert seen.touched > 1 and np.abs(seen.speed[:, 0]).max() * 0.004 > 0.3
    assert np.diff(has).max() < 0.02 * seen.kinetic and seen.growth < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["implicitfast", "implicit"])
def test_a_body_that_turns_far_ends_where_predicted(integrator):
    """Velocity products act after the constraint solver: 0.56 rad in a step."""
    box = (
        '<body name="box"><freejoint/>'
        '<geom type="box" size=".008293 .004844 .007986" mass=".001115" friction="0.3"/></body>'
    )
    spec = mujoco.MjSpec.from_string(scene(box, 0.01, f'integrator="{integrator}"'))
    batches.add(spec, site="tip", skin=SKIN)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=2, nconmax=32, njmax=128)
    batch = batches.attach(model, m, d, skin=SKIN, readings=False, friction=0.37)
    quat = np.array([-0.225419, -0.0676020, -0.113161, -0.965303])
    start = np.array([-0.0276994, -0.0033384, 0.0185314, *(quat / np.linalg.norm(quat))])
    velocity = np.array([0.253901, 0.100407, -0.544565, -8.408973, 55.940941, -5.622781])
    qpos = np.tile(start, (2, 1))
    qpos[1, :3] += 0.003 * velocity[:3]
    d.qpos.assign(np.float32(qpos))
    d.qvel.assign(np.float32(np.tile(velocity, (2, 1))))
    off, force = [], []
    for _ in range(5):
        mjw.step(m, d)
        off.append(where_it_ends(model, batch, d) * batch.rest.awake.numpy())
        force.append(batch.wrench[:, 0, :3].any(axis=1))
    assert np.any(force, axis=0).all()  # both touch
    assert np.max(off) < 1e-6


@pytest.mark.law
def test_a_ball_on_a_damped_slide_is_that_of_the_plugin():
    """What the integrator takes from joint damping counts: time step x damping / inertia is 2."""
    ball = (
        '<body name="ball" pos="0 0 .0136"><joint type="slide" axis="0 0 1" damping="10"/>'
        '<geom size=".005" mass=".01"/></body>'
    )
    xml = scene(ball, 0.002, 'gravity="0 0 0"')
    (seen,), _ = in_batch(xml, [[0.0]], [[-0.5]], 8, TIP)
    expected = in_plugin(xml, [0.0], [-0.5], 8, TIP)
    assert seen.touched > 3 and seen.lost == expected.lost == 0
    np.testing.assert_allclose(seen.qpos, expected.qpos, atol=5e-6)
    np.testing.assert_allclose(seen.own, expected.size, atol=0.03 * expected.size.max())
    # what is reported is what acted, by the ball's momentum; damping takes fifty times as much of it, so that
    # a step which settles by motion may be off by a fifth of the peak
    acted = 0.01 * np.diff(seen.speed[:, 0]) / 0.002 + 10 * seen.speed[1:, 0]
    np.testing.assert_allclose(seen.size, acted, atol=0.003 * acted.max())
    np.testing.assert_allclose(seen.size.sum(), expected.size.sum(), rtol=0.03)


@pytest.mark.slow
def test_a_skin_that_cannot_move_on_begins_anew():
    """After three steps, and only that of its world; a skin that finds its way again has lost nothing."""
    ball = '<body name="ball" mocap="true"><geom size=".005"/></body>'
    spec = mujoco.MjSpec.from_string(scene(ball, 0.002))
    batches.add(spec, **TIP, skin=SKIN, coupling="one-way")
    model = spec.compile()
    data = mujoco.MjData(model)
    options = {"skin": {"max_work": 160}}
    batch = batches.make(model, 2, device="cpu", skin=SKIN, readings=False, options=options)

    def step(height):
        data.mocap_pos[0] = 0, 0, height
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        shape = (model.nbody, 3), (model.nbody, 3, 3), (model.nbody, 3)
        where = zip((data.xpos, data.xmat, data.xipos), shape)
        given = (np.float32(np.tile(x.reshape(1, *s), (2,) + (1,) * len(s))) for x, s in where)
        batch.step(*(wp.array(x, device="cpu") for x in given))
        status = batch.readings()["status"].numpy()
        return status[:, 0], status[:, 6], np.linalg.norm(batch.wrench[:, 0, :3], axis=1)

    for height in (0.0135, 0.0132, 0.0131, 0.013, 0.0129):
        good, _, force = step(height)
    assert good.all() and force[0] == force[1] > 0.01
    torn = batch.skin.data.x.numpy()
    torn[:, 1] = np.random.default_rng(0).permutation(torn[:, 1])  # a skin that is nowhere near a balance
    batch.skin.data.x.assign(torn)
    for _ in range(4):
        good, reached, held = step(0.0129)
        assert good.tolist() == [1, 0] and reached[1] == 0 and held[1] == force[1]  # the last force is kept
    good, reached, found = step(0.0129)
    assert good.all() and reached[1] == 1
    np.testing.assert_allclose(found, force, rtol=0.02)


def forces(xml, velocity, steps, where, **settings):
    """Of each step and world what the finger took per time from the body's momentum (3,) [N], what it
    reports, status, whether a solid part of it touched, and torques about the body that its solver finds and
    that are reported (2, 3) [N m]."""
    spec = mujoco.MjSpec.from_string(xml)
    batches.add(spec, **where, skin=SKIN)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    m, d = mjw.put_model(model), mjw.put_data(model, data, nworld=len(velocity), nconmax=32, njmax=128)
    batches.attach(model, m, d, skin=SKIN, readings=False, **settings)
    d.qvel.assign(np.float32(velocity))
    mass, core = model.body("thrown").mass[0], model.body("biotac_core").id
    begin = {c: int(model.sensor(f"biotac_{c}").adr[0]) for c in ("status", "contact_force")}
    out = []
    for _ in range(steps):
        qpos, qvel = d.qpos.numpy().copy(), d.qvel.numpy().astype(float)
        mjw.step(m, d)
        took = mass * ((d.qvel.numpy() - qvel)[:, :3] / model.opt.timestep - model.opt.gravity)
        read = d.sensordata.numpy().astype(float)
        count = d.nacon.numpy()[0]
        solid = np.bincount(d.contact.worldid.numpy()[:count], minlength=len(velocity)) > 0
        acts = d.qfrc_passive.numpy() + d.qfrc_constraint.numpy()
        for w in range(len(velocity)):
            data.qpos[:] = qpos[w]
            mujoco.mj_kinematics(model, data)
            frame = data.xmat[core].reshape(3, 3)
            wrench = read[w, begin["contact_force"] :][:6].reshape(2, 3)
            told, torque = -wrench @ frame.T
            torque = torque + np.cross(data.xpos[core] - data.body("thrown").xpos, told)
            torques = acts[w, 3:], torque @ data.body("thrown").xmat.reshape(3, 3)
            out.append((took[w], told, read[w, begin["status"] :][:8], solid[w], torques))
    return out


THROWN = '<body name="thrown" pos="0 0 {}"><freejoint/><geom {}/></body>'
ROLLS = THROWN.format(APEX + 0.0062, 'type="ellipsoid" size=".004 .009 .006" mass=".0017" friction="1"')
FALLS = THROWN.format(APEX + 0.0061, 'type="box" size=".006 .006 .006" mass="5"')


@pytest.mark.parametrize(
    "integrator", ["Euler", *(pytest.param(i, marks=pytest.mark.slow) for i in ("implicit", "implicitfast"))]
)
def test_the_reported_force_acts_where_steps_do_not_settle(integrator):
    """A light body that hits, rolls and sticks by turns, at a long step."""
    velocity = [[0.2, 0.1, -0.74, 5, 8, 20], [0.1, 0.0, -0.5, 15, 20, 5]]
    rows = forces(scene(ROLLS, 0.005, f'integrator="{integrator}"'), velocity, 4, TIP)
    assert any(status[0] == 0 and np.linalg.norm(told) > 1e-3 for _, told, status, *_ in rows)
    for took, told, *_ in rows:
        np.testing.assert_allclose(told, took, atol=1e-4 * np.linalg.norm(took) + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("cone", [pytest.param("pyramidal", marks=pytest.mark.slow), "elliptic"])
def test_skin_and_core_are_reported_together(cone):
    """5 kg go down to the core, which mujoco_warp's own contacts hold, in one world alone."""
    velocity = [[0.1, 0.0, -1.0, 1.0, 0.5, 0.2], [0, 0, -0.01, 0, 0, 0]]  # at half of it the skin stops them
    rows = forces(scene(FALLS, 0.002, f'cone="{cone}"'), velocity, 8, TIP)
    assert sum(row[3] for row in rows[::2]) >= 2 and not any(row[3] for row in rows[1::2])
    for took, told, _, _, (torque, reported) in rows:
        np.testing.assert_allclose(told, took, atol=1e-4 * np.linalg.norm(took) + 5e-3)
        np.testing.assert_allclose(reported, torque, atol=1e-4 * np.linalg.norm(torque) + 1e-4)


@pytest.mark.law
@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
def test_a_light_box_gains_nothing_beside_a_press(tier):
    """What a fixed ball that presses has put into the skin is not for a box that hits beside it."""
    bodies = (
        '<body name="ball" mocap="true" pos="0 0 .01241"><geom size=".005" contype="0"/></body>'
        '<body name="box" pos="-.008 0 .0176" quat=".4 .7 -.5 .3"><freejoint/>'
        '<geom type="box" size=".005 .004 .0045" mass=".28e-3" contype="0"/></body>'
    )
    quat = np.array([0.4, 0.7, -0.5, 0.3])
    qpos = np.tile([-0.008, 0, 0.0176, *(quat / np.linalg.norm(quat))], (4, 1))
    qvel = np.zeros((4, 6))
    qvel[:, 2] = -0.2, -0.28, -0.33, -0.5
    seen, _ = in_batch(scene(bodies, 0.004, 'gravity="0 0 0"'), qpos, qvel, 14, TIP, skin="coarse", tier=tier)
    for world in seen:
        assert world.size.min() > 0.1  # the ball presses all the time
        assert world.growth < 0.01 and world.energy[-1] < 0.9 * world.energy[0]


@pytest.mark.parametrize("integrator", ["implicit", pytest.param("implicitfast", marks=pytest.mark.slow)])
def test_the_integrator_is_corrected_for_where_bodies_spin_fast(integrator, monkeypatch):
    """These integrators turn free bodies by their velocity products, too. Where their answer was thought to
    be without these, forces grew from round to round, and a light body that a heavy one crushed gained energy
    without bound."""
    body = 'type="ellipsoid" size=".004 .009 .006" mass=".0017" friction="1"'
    xml = scene(THROWN.format(APEX + 0.0062, body), 0.005, f'integrator="{integrator}"')
    spin = np.array([[30, 20, 40], [100, 60, 120], [200, 150, 300]])
    qpos = np.tile([0, 0, APEX + 0.0062, 1, 0, 0, 0.0], (len(spin), 1))
    seen = []

    def finish(batch, end, after=batches.batch.Batch.finish):
        r = batch._of_step
        seen.append([np.abs(array.numpy()[0, :, :3]).max(1) for array in (r.amiss, r.acting)])
        after(batch, end)

    monkeypatch.setattr(batches.batch.Batch, "finish", finish)
    in_batch(xml, qpos, np.c_[np.tile([0, 0, -0.3], (len(spin), 1)), spin], 2, TIP)
    amiss, acting = seen[-2]  # on CUDA attach goes through a step before, to compile its kernels
    assert acting.min() > 0.05 and (amiss < 3e-4 * acting).all(), amiss / acting


@pytest.mark.parametrize("sparse", [0, 1])
def test_contacts_with_the_core_do_the_work_of_their_rows(sparse):
    """Two contacts with body 2, of the touching body 1 and of another, and one between these."""
    rng, step = np.random.default_rng(0), 0.004
    J, force, qvel, qacc = (rng.normal(size=shape).astype(np.float32) for shape in ((4, 3), 4, 3, 3))
    contact, rows = Contacts(), Rows()
    contact.nacon = wp.array([3], dtype=int)
    contact.geom = wp.array([[1, 3], [2, 3], [1, 2]], dtype=wp.vec2i)
    contact.worldid = wp.zeros(3, dtype=int)
    contact.efc_address = wp.array([[0, 1], [2, -1], [3, -1]], dtype=int, ndim=2)
    rows.sparse, rows.force = sparse, wp.array(force[None], dtype=float, ndim=2)
    rows.J = wp.array(J.reshape(1, 1, -1) if sparse else J[None], dtype=float, ndim=3)
    rows.J_rownnz, rows.J_rowadr, rows.J_colind = (
        wp.array(a, dtype=int, ndim=n)
        for a, n in zip(([[3] * 4], [[0, 3, 6, 9]], [[list(range(3)) * 4]]), (2, 2, 3), strict=True)
    )
    moved = [wp.array(a[None], dtype=float, ndim=2) for a in (qvel, qacc)]
    lifted = wp.zeros((1, 1), dtype=wp.float64)
    body, bodies_of_geoms = (wp.array(a, dtype=int) for a in ([1], [0, 1, 3, 2]))
    wp.launch(solid_contacts.find_lift, 3, [2, body, step, bodies_of_geoms, contact, rows, *moved], [lifted])
    work = step * (force * (J @ (qvel + 0.5 * step * qacc)))
    np.testing.assert_allclose(lifted.numpy()[0, 0], work[:2].sum(), rtol=1e-6)


def test_a_skin_that_only_reads_feels_the_nail_stop_a_body():
    """In each world by itself: a third one has no contact."""
    ball = '<body pos="-.009 0 .01"><joint type="slide" axis="0 0 1"/><geom size=".005" mass=".02"/></body>'
    xml = scene(ball, 0.002).replace("1 -1 0 0", "1 1 0 0")
    read = []
    for coupling in ("two-way", "one-way"):
        where = {"site": "tip", "coupling": coupling}
        thrown = [[0.0], [0.45e-3], [0.1]], [[-0.45]] * 3, 5, where
        seen, _ = in_batch(xml, *thrown, tier="condensed", coupling=coupling)
        read.append([world.force for world in seen])
    assert np.abs(read[0][:2]).max() > 4 and not np.any(read[0][2])
    np.testing.assert_allclose(read[1], read[0], rtol=1e-4, atol=1e-4)


def test_a_ball_that_comes_onto_the_nails_rim_gains_nothing():
    """Where the skin's nodes are fixed: 2 mm deep in a step, at several places about it."""
    ball = '<body name="ball" pos="-.0097 .0008 -.013"><freejoint/><geom size=".004" mass=".02"/></body>'
    places = [[-0.0097 + dx, 0.0008, -0.013, 1, 0, 0, 0] for dx in (-0.002, 0.0, 0.002)]
    option = 'gravity="0 0 0" integrator="implicitfast"'
    thrown = places, [[0, 0, 1, 0, 0, 0]] * 3, 12, {"site": "tip"}
    seen, _ = in_batch(scene(ball, 0.002, option), *thrown, tier="condensed")
    for world in seen:
        assert world.touched and world.growth < 1e-3
        assert world.speed[-1, 2] < 0.3  # it was stopped
