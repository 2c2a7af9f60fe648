"""The two-way coupling against statics, Coulomb's law and conservation of momentum, with a skin of
springs."""

import sys

import mujoco
import numpy as np
import pytest
import spring_skin
from grids import covering, first
from mechanics import momentum
from scipy.linalg import block_diag
from scipy.optimize import brentq

import biotac_mj
from biotac_mj.coupling import attach
from biotac_mj.coupling.implicit import group
from biotac_mj.coupling.implicit import world as coupled_world
from biotac_mj.geometry.rigid import cross, displace, displacement, rotation
from biotac_mj.geometry.rigid_warp import LEVER

PAD_UP = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]  # the pad's -y becomes the world's +z
GHOST = 'contype="0" conaffinity="0"'  # a geom that nothing collides with
PAD_DOWN = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
G = 9.81
HINGED = """<body name="finger"><joint name="hinge" type="hinge" axis="0 1 0" pos="-.04 0 0" {}/>
  <geom type="capsule" fromto="-.04 0 -.01 0 0 -.01" size=".004" mass="0.02" contype="0" conaffinity="0"/>
  </body>"""


def scene(
    bodies,
    timestep=0.002,
    gravity="0 0 -9.81",
    integrator="implicitfast",
    finger='<body name="finger"/>',
    stiffness=1e3,
    flags="",
    **settings,
):
    """A pad of springs, facing up in the plane z = 8 mm around the origin, under other bodies."""
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" gravity="{gravity}" integrator="{integrator}"/>'
        f"<worldbody>{finger}{bodies}</worldbody></mujoco>"
    )
    settings = (
        dict(stepper="springs", readings="none", friction=0.3, options={"stiffness": stiffness}) | settings
    )
    handle = attach(
        spec, body="finger", quat=PAD_UP, pos=[0.01, 0, 0], skin=spring_skin.pad_geometry(), **settings
    )
    model = spec.compile()
    return model, mujoco.MjData(model), handle


def ball(mass, joint="<freejoint/>", pos=f"0 0 {0.018 - 1e-5}", friction=0.3):
    return (
        f'<body name="ball" pos="{pos}">{joint}<geom name="ball" type="sphere" size=".01" mass="{mass}" '
        f'friction="{friction}"/></body>'
    )


@pytest.fixture(autouse=True)
def no_errors():
    yield
    biotac_mj.plugin.check()


@pytest.mark.parametrize("mass, timestep", covering([0.001, 0.01, 0.1, 1.0], [0.0005, 0.001, 0.002, 0.004]))
def test_a_ball_reads_its_weight(mass, timestep):
    # node stiffness such that each ball sinks in by about 0.1 mm and settles within the run
    model, data, handle = scene(ball(mass), timestep, stiffness=2e4 * max(mass, 0.05))
    steps = int(0.2 / timestep)
    mujoco.mj_step(model, data, steps)
    forces = []
    for _ in range(20):
        mujoco.mj_step(model, data)
        forces.append(handle.read(data, "contact_force")[:3])
    weight = mass * G
    # no chatter: every step, not the mean
    np.testing.assert_allclose(forces, np.tile([0.0, weight, 0.0], (20, 1)), atol=0.01 * weight)
    assert np.ptp(np.array(forces)[:, 1]) < 0.005 * weight
    # MuJoCo's balance without constraints: the passive force carries the weight
    np.testing.assert_allclose(data.qfrc_passive[2], data.qfrc_bias[2], rtol=0.01)
    assert handle.read(data, "status")[0] == 1


@pytest.mark.parametrize("mass, timestep", covering([0.001, 1.0, None], [0.004, 0.0005]))
def test_a_light_finger_pushes_without_static_error(mass, timestep):
    """A hinged finger of 24 g turns against a ball that a joint limit (or the world) holds back: the torques
    balance exactly."""
    joint = (
        '<joint type="slide" axis="0 0 1" range="-1 0" limited="true" solreflimit=".01 1"/>' if mass else ""
    )
    model, data, _ = scene(
        ball(mass or 1.0, joint, "0 0 .0181"), timestep, "0 0 0", finger=HINGED.format(""), stiffness=2e3
    )
    torque = -0.04 * min(2 * G * (mass or 1.0), 5.0)
    data.qfrc_applied[0] = torque
    mujoco.mj_step(model, data, int(0.25 / timestep))
    assert abs(data.qvel).max() < 1e-5
    assert data.qfrc_passive[0] == pytest.approx(-torque, rel=1e-5)


def test_a_light_finger_on_its_limit_carries_a_ball():
    finger = HINGED.format('range="-90 0" limited="true" solreflimit=".01 1"')
    model, data, _ = scene(ball(0.1, '<joint type="slide" axis="0 0 1"/>'), 0.004, finger=finger)
    mujoco.mj_step(model, data, 200)
    assert abs(data.qvel).max() < 1e-6
    assert data.qfrc_passive[1] == pytest.approx(0.1 * G, rel=1e-6)
    assert data.qfrc_constraint[1] == pytest.approx(
        0.0, abs=1e-6
    )  # at rest the rows that carry the stiffness push nothing


@pytest.mark.parametrize(
    "damping, integrator, timestep",
    covering([0.0, 1.55, 0.05], ["Euler", "implicitfast", "implicit"], [0.0005, 0.004]),
)
def test_a_damped_ball_moves_as_newmark_says(damping, integrator, timestep):
    """1 g on a damped slide, up to h c / m = 6: the skin acts where the integrator takes the ball, not where
    the solver's qacc points; its step is Newmark's, with gamma by how fast the ball bounces."""
    mass, stiffness, start, delay = 0.001, 5.0, 0.0181, 0.2 / (100 * np.pi)
    model, data, handle = scene(
        ball(mass, f'<joint type="slide" axis="0 0 1" damping="{damping}"/>', f"0 0 {start}"),
        timestep,
        "0 0 -9.81",
        integrator,
        stiffness=stiffness,
    )
    line = np.linspace(-0.004, 0.004, 9)
    x, y = (grid.ravel() for grid in np.meshgrid(line, line))

    def springs(height):
        distance = np.sqrt(x**2 + y**2 + height**2)
        touched, slope = distance < 0.01, height / distance
        push = (stiffness * np.maximum(0.01 - distance, 0.0) * slope).sum()
        return push, (stiffness * touched * slope**2).sum()

    weight, most, stiff = mass * G, 0.0, 0.0
    for _ in range(min(int(0.4 / timestep), 200)):
        height, speed = data.qpos[0] + start - 0.008, data.qvel[0]  # over the springs' plane
        mujoco.mj_step(model, data)
        pace = timestep * np.sqrt(stiff / mass)
        gamma = 0.5 + max(delay / timestep, 1 - 2 / pace if pace > 2 else 0.0) if stiff else 1.5
        beta = (gamma + 0.5) ** 2 / 4 - max(1.5 - gamma, 0) ** 2 / 6

        def met(after, height=height, speed=speed, gamma=gamma, beta=beta):
            return height + timestep * ((gamma - 0.5 - beta) * speed + beta * after)

        def wrong(after, speed=speed, met=met):
            return mass * (after - speed) / timestep + weight + damping * after - springs(met(after))[0]

        after = brentq(wrong, -5, 5, xtol=1e-15, rtol=1e-14)
        push, stiff = springs(met(after))
        assert data.qpos[0] + start - 0.008 == pytest.approx(height + timestep * after, abs=3e-6)
        assert handle.read(data, "contact_force")[1] == pytest.approx(
            push, abs=2e-6 * 81 * stiffness
        )  # solved within 2 um
        most = max(most, push)
    assert most > 0.5 * weight  # it has met the springs


def test_what_a_correction_lacks_is_in_the_account_of_energy(monkeypatch):
    """The integrator's accelerations are met by a fixed point: what it has not reached acts on the bodies
    too."""
    seen, conclude = [], group.SkinGroup.conclude

    def watch(self, *how):
        seen.append(self.arrays.acting.ravel() @ self.jacobian.reshape(-1, self.jacobian.shape[-1]))
        conclude(self, *how)

    monkeypatch.setattr(group.SkinGroup, "conclude", watch)
    monkeypatch.setattr(coupled_world, "MAX_CORRECTIONS", 0)
    model, data, _ = scene(
        ball(0.001, '<joint type="slide" axis="0 0 1" damping="0.5"/>', "0 0 .0178"), 0.004, "0 0 0", "Euler"
    )
    data.qvel[0] = -0.05
    mujoco.mj_step(model, data, 3)
    mujoco.mj_forward(model, data)
    found = data.qfrc_passive - data.qfrc_damper + data.qfrc_constraint
    assert abs(found[0]) > 1e-3
    np.testing.assert_allclose(seen[-1], found, rtol=1e-6)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "implicit"])
def test_a_top_is_met_where_the_integrator_takes_it(integrator):
    """20 g that spin at 100 rad/s: without what implicitfast takes of velocity products, by 0.1 mm elsewhere
    10 mm from the axis."""
    top = '<geom type="ellipsoid" size=".004 .006 .012" mass=".02" pos=".002 0 0"/>'
    model, data, _ = scene(
        f'<body name="top" pos="0 0 .03"><freejoint/>{top}</body>', 0.004, "0 0 0", integrator
    )
    data.qvel[:] = 0.1, 0.0, -0.1, 44.0, 22.0, 87.0
    mujoco.mj_forward(model, data)
    world = sys.modules["biotac_mj.plugin.engine"]._worlds[data._address]
    explicit, before = data.qacc.copy(), data.qvel.copy()
    used = world.integrator.integrated(explicit) if world.integrator.take_matrices(world.data) else explicit
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(before + 0.004 * used, data.qvel, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "implicit"])
@pytest.mark.parametrize(
    "disabled", [0, mujoco.mjtDisableBit.mjDSBL_EULERDAMP, mujoco.mjtDisableBit.mjDSBL_DAMPER]
)
def test_the_skin_is_solved_at_the_integrators_poses(integrator, disabled):
    """(M - h D)^-1 M a is the change of the velocities in mj_step: dampers of higher order, a tendon's,
    servos, also at their limit."""
    finger = (
        '<body name="finger"><joint name="a" type="hinge" axis="0 1 0" pos="-.04 0 0" damping=".01 .002 '
        '.001"/>'
        '<geom type="capsule" fromto="-.04 0 -.01 0 0 -.01" size=".004" mass=".02"/></body>'
    )
    arm = (
        '<body name="arm" pos="0 .1 0"><joint name="b" type="hinge" axis="0 1 0" damping="1e-3"/>'
        '<geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".05"/><body pos=".1 0 0"><joint '
        'name="c" type="hinge" axis="0 1 0"/>'
        '<geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".05"/></body></body>'
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="0.004" integrator="{integrator}"/><worldbody>{finger}{arm}'
        + ball(0.03, '<joint type="free" damping=".2"/>', "0 0 .03")
        + "</worldbody>"
        '<tendon><fixed name="t" damping=".02"><joint joint="b" coef="1"/><joint joint="c" '
        'coef="-1"/></fixed></tendon>'
        '<actuator><velocity joint="b" kv=".05"/><position joint="c" kp="1" kv=".03" forcerange="-.01 .01"/>'
        '<position joint="a" kp="1" kv=".02"/></actuator></mujoco>'
    )
    settings = dict(stepper="springs", readings="none", friction=0.3)
    attach(spec, body="finger", quat=PAD_UP, pos=[0.01, 0, 0], skin=spring_skin.pad_geometry(), **settings)
    model = spec.compile()
    model.opt.disableflags |= int(disabled)
    data = mujoco.MjData(model)
    data.qvel[:], data.ctrl[:] = np.random.default_rng(0).normal(size=model.nv), (0.3, 0.5, -0.2)
    mujoco.mj_forward(model, data)
    world = sys.modules["biotac_mj.plugin.engine"]._worlds[data._address]
    explicit, before = data.qacc.copy(), data.qvel.copy()
    used = world.integrator.integrated(explicit) if world.integrator.take_matrices(world.data) else explicit
    mujoco.mj_step(model, data)
    real = (data.qvel - before) / model.opt.timestep
    np.testing.assert_allclose(used, real, rtol=1e-9, atol=1e-9 * abs(real).max())
    if integrator != "Euler" or not disabled:
        assert abs(explicit - real).max() > 0.1 * abs(real).max()  # there was something to get right


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "implicit"])
@pytest.mark.parametrize("damping", [0, 1e-2])
def test_bodies_are_where_an_unfinished_solver_sends_them(integrator, damping, monkeypatch):
    """2 g under 200 g, after one iteration of CG: where the integrator goes by forces, it does not go by the
    accelerations that the solver has."""
    joint = f'<joint type="free" damping="{damping}"/>'
    heavy = ball(0.2, joint, ".002 0 .0375").replace("ball", "heavy")
    bodies = ball(0.002, joint) + heavy
    model, data, _ = scene(bodies, 0.004, integrator=integrator)
    model.opt.solver, model.opt.iterations = mujoco.mjtSolver.mjSOL_CG, 1
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    data.qvel[8] = -0.1
    seen = []

    def finish(world, after=coupled_world.World._finish):
        if world._acting:
            seen.append(world._group.arrays.qacc.copy())
        after(world)

    monkeypatch.setattr(coupled_world.World, "_finish", finish)
    before = data.qvel.copy()
    mujoco.mj_step(model, data)
    real = (data.qvel - before) / model.opt.timestep
    np.testing.assert_allclose(seen.pop(), real, rtol=1e-8, atol=1e-8 * abs(real).max())
    if damping or integrator != "Euler":
        assert abs(data.qacc - real).max() > 0.1 * abs(real).max()  # there was something to get right


@pytest.mark.law
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "implicit"])
def test_only_dampers_take_momentum(integrator):
    """A damped finger hit by a free ball: what both lose is what the joint's dampers take, at the end of each
    step."""
    damping, timestep = 5.0, 0.004
    joints = "".join(
        f'<joint type="slide" axis="{axis}" damping="{damping}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1")
    )
    finger = f'<body name="finger">{joints}<geom type="box" size=".008 .008 .008" mass=".02" {GHOST}/></body>'
    model, data, handle = scene(
        ball(0.03, pos=".002 .001 .0182"), timestep, "0 0 0", integrator, finger, stiffness=2e3
    )
    data.qvel[3:6] = [0.1, 0.05, -0.3]
    finger_mass, touched = model.body_subtreemass[1], 0
    for _ in range(20):
        before = finger_mass * data.qvel[:3] + 0.03 * data.qvel[3:6]
        mujoco.mj_step(model, data)
        after = finger_mass * data.qvel[:3] + 0.03 * data.qvel[3:6]
        np.testing.assert_allclose(after - before, -timestep * damping * data.qvel[:3], atol=1e-14)
        touched += handle.read(data, "contact_force").any()
    assert touched >= 2


@pytest.mark.law
@pytest.mark.parametrize(
    "masses, integrator, timestep",
    covering(
        [(0.02, 0.001), (0.05, 0.03), (0.02, 1.0)], ["Euler", "implicitfast", "implicit"], [0.004, 0.0005]
    ),
)
def test_momentum_of_free_finger_and_object_is_conserved(masses, integrator, timestep):
    """A spinning ball hits a free finger off its centre and slides."""
    finger = (
        f'<body name="finger"><freejoint/><geom type="box" size=".008 .008 .008" mass="{masses[0]}" '
        f"{GHOST}/></body>"
    )
    model, data, handle = scene(
        ball(masses[1], pos=".002 .001 .0185"), timestep, "0 0 0", integrator, finger, stiffness=2e3
    )
    # MuJoCo's own step of a free body errs by 1e-3 at 4 ms, with its own contacts too, where its centre of
    # mass is off its joint or its inertia has unequal axes: such a finger would test MuJoCo
    core = model.body("biotac_core").id
    model.body_ipos[core] = [-0.01, 0, 0]
    model.body_inertia[core] = model.body_inertia[core].mean()
    mujoco.mj_setConst(model, data)
    data.qvel[6:] = [0.1, 0.05, -0.3, 3, 4, 2]
    linear, angular = momentum(model, data)
    touched = 0
    for _ in range(int(0.05 / timestep)):
        mujoco.mj_step(model, data)
        touched += handle.read(data, "contact_force").any()
    after = momentum(model, data)
    assert touched >= 2
    assert np.linalg.norm(after[0] - linear) < 1e-12 * np.linalg.norm(linear)
    assert np.linalg.norm(after[1] - angular) < 1e-12 * np.linalg.norm(angular)
    assert np.linalg.norm(data.qvel[:3]) > 1e-4  # there was something to conserve


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_a_bounce_loses_what_the_rubber_loses(integrator):
    """Without loss, energy is what it was, to second order in the step: beyond the step in which contact
    begins. With it, a bounce loses exp(-pi loss f / f0) at its own frequency f, whatever the step."""

    def bounce(timestep, loss):
        finger = (
            '<body name="finger"><joint type="slide" axis="0 0 1"/><geom type="box" size=".01 .01 '
            f'.01" mass=".03" {GHOST}/></body>'
        )
        model, data, _ = scene(
            ball(0.03, '<joint type="slide" axis="0 0 1"/>', "0 0 .0181"),
            timestep,
            "0 0 0",
            integrator,
            finger,
            options={"stiffness": 1e2, "loss": loss},
        )
        data.qvel[1] = -0.2
        mujoco.mj_step(model, data, int(0.02 / timestep))
        assert data.qvel[1] > data.qvel[0]  # they part
        return (data.qvel[1] - data.qvel[0]) / 0.2

    finest = bounce(2e-5, 0.2)
    for timestep in (0.0005, 0.0001):
        assert bounce(timestep, 0.0) == pytest.approx(1.0, abs=0.02)
        left = bounce(timestep, 0.2)
        assert left == pytest.approx(finest, abs=0.02) and 0.5 < left < 0.8


@pytest.mark.parametrize("mass, timestep", first([0.1, 0.001], [0.004, 0.0005]))
def test_a_block_sticks_and_slips_at_mu(mass, timestep):
    joints = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    block = (
        f'<body name="block" pos="0 0 .01299">{joints}<geom type="box" size=".05 .05 .005" '
        f'mass="{mass}" friction="0.2"/></body>'
    )
    model, data, _ = scene(block, timestep, friction=0.3)  # MuJoCo's rule: the larger friction counts
    mujoco.mj_step(model, data, int(0.2 / timestep))
    limit = 0.3 * mass * G
    data.qfrc_applied[0] = 0.98 * limit
    mujoco.mj_step(model, data, int(0.2 / timestep))
    start = data.qpos[0]
    mujoco.mj_step(model, data, int(0.2 / timestep))
    assert abs(data.qpos[0] - start) < 2e-7  # sticks: creeps less than 1 um/s
    data.qfrc_applied[0] = 1.5 * limit
    mujoco.mj_step(model, data, 5)
    start, time = data.qvel[0], data.time
    mujoco.mj_step(model, data, 10)
    assert (data.qvel[0] - start) / (data.time - time) == pytest.approx(0.5 * limit / mass, rel=0.01)


def test_priority_decides_whose_friction_counts():
    for priority, expected in ((0, 0.8), (1, 0.3), (-1, 0.2)):
        block = (
            '<body name="block" pos="0 0 .013"><freejoint/><geom type="box" size=".05 .05 .005" '
            'mass="0.1" friction="{}"/></body>'
        )
        friction = 0.8 if priority == 0 else 0.2
        seen = {}
        name = f"watch{priority}"

        class Watching(spring_skin.SpringSkin):
            def __init__(self, config, geometry, geoms, seen=seen):
                seen["friction"] = geoms[0].friction
                super().__init__(config, geometry, geoms)

        biotac_mj.coupling.register_stepper(name, Watching)
        scene(block.format(friction), priority=priority, friction=0.3, stepper=name)
        assert seen["friction"] == pytest.approx(expected)


def displacement_at_once(pos, mat, pos0, mat0, here, spin):
    """Motions (n, 6) for which `displace(pos0, mat0, motion, here, spin)` gives pos, mat; exact to third
    order in turn and spin (Baker-Campbell-Hausdorff)."""
    turn = displacement(pos, mat, pos0, mat0)[:, 3:]
    both = cross(turn, spin)
    turn = turn + 0.5 * both + cross(turn - spin, both) / 12
    return np.concatenate([pos - pos0 - cross(turn, here), turn], axis=1)


def test_what_is_found_for_all_skins_together_is_each_skin_s_own(monkeypatch):
    """Two fingers under balls of other weights that also spin: where bodies go and what models say there, by
    the definitions, of one skin."""
    seen, conclude = [], group.SkinGroup.conclude

    def watch(self, *how):
        J, a = self.jacobian, self.arrays
        drift = a.horizon[:, None] * (J @ data.qvel)
        moved = a.square[:, None] * (J @ a.qacc)
        target = displace(a.start_pos, a.start_mat, moved, a.here_pos, drift[:, 3:])
        way = displacement_at_once(a.pos0, a.mat0, a.start_pos, a.start_mat, a.here_pos, drift[:, 3:])
        wrench = a.wrench0 + np.einsum("nij,nj->ni", a.tangent0, way)
        wanted = (
            (moved, a.moved),
            (target[0], a.pos),
            (target[1], a.mat),
            (wrench, a.wrench),
            (wrench - np.einsum("nij,nj->ni", a.tangent0, moved) + self.excess, a.acting),
        )
        for one, other in wanted:
            np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-15)
        off = np.abs(displacement(*target, a.pos0, a.mat0) * ([1.0] * 3 + [LEVER] * 3))
        for skin in self.skins:
            assert skin.off == pytest.approx(off[skin.bodies].max(), abs=1e-15)
            seen.append(np.abs(skin.part("wrench")).max())
        conclude(self, *how)

    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="left"/>'
        '<body name="right" pos="0 .1 0"/>'
        + "".join(
            f'<body name="{n}" pos="0 {y} .0179"><freejoint/><geom name="{n}" size=".01" mass="{m}"/></body>'
            for n, y, m in (("light", 0, 0.02), ("heavy", 0.1, 0.1))
        )
        + "</worldbody></mujoco>"
    )
    for finger, ball in (("left", ["light", "heavy"]), ("right", ["heavy"])):
        attach(
            spec, body=finger, prefix=finger, quat=PAD_UP, pos=[0.01, 0, 0], skin=spring_skin.pad_geometry(),
            stepper="springs", readings="none", geoms=ball, options={"stiffness": 1e3},
        )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    monkeypatch.setattr(group.SkinGroup, "conclude", watch)
    data.qvel[:] = np.tile([0.01, 0, 0, 0.5, 1.0, 2.0], 2) * np.repeat([1, -1], 6)
    mujoco.mj_step(model, data, 10)
    assert len(seen) >= 20 and min(seen) > 0.05


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_bodies_give_way_as_all_else_lets_them(jacobian, monkeypatch):
    """A ball between two pads on joints with dry friction: the compliance is that of the inverse of inertia,
    implicit damping and all rows that hold but the skin's own."""
    seen, find = [], group.SkinGroup.find_compliance

    def watch(self, skins, inertia):
        find(self, skins, inertia)
        H = np.zeros((model.nv, model.nv))
        row, column = np.repeat(np.arange(model.nv), model.M_rownnz), model.M_colind
        H[row, column] = H[column, row] = data.M if inertia is None else inertia
        rows = np.zeros((data.nefc, model.nv))
        if mujoco.mj_isSparse(model):
            mujoco.mju_sparse2dense(rows, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
        else:
            rows[:] = data.efc_J.reshape(rows.shape)
        # by the forces: where MuJoCo solves island by island, efc_state is that of the warm start
        holds = np.abs(data.efc_force) < data.efc_frictionloss
        holds[: data.ne] = True
        for skin in skins:
            others = holds.copy()
            own = np.isin(data.efc_id[: data.ne], list(skin.instance.slots.values()))
            others[: data.ne] = ~own
            J = self.jacobian[skin.bodies].reshape(-1, model.nv)
            springs = rows[others].T @ (data.efc_D[others, None] * rows[others])
            wanted = skin.part("square")[0] * J @ np.linalg.solve(H + springs, J.T)
            found = self.arrays.compliance[skin.number][0, 0]
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-15)
            seen.append(np.abs(springs).max())

    fingers = "".join(
        f'<body name="finger{i}" pos="0 0 {z}"><joint type="slide" axis="0 0 {s}" damping="5" '
        f'frictionloss=".2"/><geom size=".003" mass=".03" {GHOST}/></body>'
        for i, (z, s) in enumerate(((-0.0131, 1), (0.0131, -1)))
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="0.002" integrator="implicitfast" jacobian="{jacobian}"/>'
        f'<worldbody>{fingers}<body name="box"><freejoint/><geom type="box" size=".004 .004 .005" '
        'mass=".005"/></body></worldbody></mujoco>'
    )
    for i, quat in enumerate((PAD_UP, PAD_DOWN)):
        attach(
            spec, body=f"finger{i}", quat=quat, pos=[0.01, 0, 0], prefix=f"b{i}_",
            skin=spring_skin.pad_geometry(), stepper="springs", readings="none", options={"stiffness": 1e3},
        )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    monkeypatch.setattr(group.SkinGroup, "find_compliance", watch)
    data.qfrc_applied[:2] = 1.0
    mujoco.mj_step(model, data, 30)
    assert len(seen) > 40 and min(seen[-10:]) > 0.1  # against 0.03 kg


@pytest.mark.parametrize("jacobian", ["DENSE", "SPARSE"])
def test_bodies_give_way_as_a_sliding_contact_lets_them(jacobian, monkeypatch):
    """Two balls over a pad that rub on each other in MuJoCo's elliptic cone: by differences of its answer."""
    seen, find = [], group.SkinGroup.find_compliance

    def watch(self, skins, inertia):
        find(self, skins, inertia)
        if len(self.touching):  # its own rows hold them, too
            return
        J, passive = self.jacobian.reshape(-1, model.nv), data.qfrc_passive.copy()
        scale = np.tile([1, 1, 1, 0.01, 0.01, 0.01], 2)  # compares turning with going
        view = skins[0].instance.data
        answers = [view.acceleration(again=True)]
        for force in 1e-6 * scale[:, None] * J:
            data.qfrc_passive[:] = passive + force
            answers.append(view.acceleration(again=True))
        sliding = view.row_states() == mujoco.mjtConstraintState.mjCNSTRSTATE_CONE
        data.qfrc_passive[:] = passive
        view.acceleration(again=True)
        wanted = 1e6 * self.arrays.square[0] * (scale[:, None] * J) @ (np.array(answers[1:]) - answers[0]).T
        found = self.arrays.compliance[0].transpose(0, 2, 1, 3).reshape(12, 12) * np.outer(scale, scale)
        np.testing.assert_allclose(found, wanted, atol=1e-4 * np.abs(wanted).max())
        seen.append(sliding.sum())

    balls = "".join(
        f'<body pos="{x} 0 .0182"><freejoint/><geom size=".01" mass="{mass}" friction=".1"/></body>'
        for x, mass in ((-0.0099, 0.01), (0.0099, 0.02))
    )
    model, data, _ = scene(balls, integrator="Euler", friction=0.1)
    model.opt.cone, model.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{jacobian}")
    data = mujoco.MjData(model)
    monkeypatch.setattr(group.SkinGroup, "find_compliance", watch)
    data.qvel[:] = 0.5, 0.3, -0.3, 0, 0, 5, -0.5, -0.3, -0.3, 0, 20, 0
    mujoco.mj_step(model, data)
    assert seen and seen[0] == 3


@pytest.mark.parametrize("timestep", [pytest.param(0.001, marks=pytest.mark.slow), 0.004])
def test_two_biotacs_hold_a_light_box_against_gravity(timestep, monkeypatch):
    """Pinch: 1 N from each side, gravity along the pads, a box of 5 g whose weight is a tenth of the friction
    there is. Both skins make it bounce, and each knows how fast."""
    seen, conclude = [], group.SkinGroup.conclude

    def watch(self, rounds):
        conclude(self, rounds)
        frequency = [skin.instance.outcome.frequency for skin in self.skins]
        seen[:] = self.jacobian, self.arrays.tangent0.copy(), np.concatenate(frequency)

    monkeypatch.setattr(group.SkinGroup, "conclude", watch)
    fingers = "".join(
        f'<body name="finger{i}" pos="0 0 {z}"><joint type="slide" axis="0 0 {s}" damping="5"/>'
        f'<geom size=".003" mass=".03" {GHOST}/></body>'
        for i, (z, s) in enumerate(((-0.0131, 1), (0.0131, -1)))
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" gravity="-9.81 0 0" '
        f'integrator="implicitfast"/><worldbody>{fingers}'
        '<body name="box"><freejoint/><geom type="box" size=".004 .004 .005" '
        'mass=".005"/></body></worldbody></mujoco>'
    )
    handles = [
        attach(
            spec,
            body=f"finger{i}",
            quat=quat,
            pos=[0.01, 0, 0],
            prefix=f"b{i}_",
            skin=spring_skin.pad_geometry(),
            stepper="springs",
            readings="none",
            friction=0.5,
            options={"stiffness": 1e3},
        )
        for i, quat in enumerate((PAD_UP, PAD_DOWN))
    ]
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qfrc_applied[:2] = 1.0
    mujoco.mj_step(model, data, int(0.3 / timestep))
    start = data.body("box").xpos.copy()
    mujoco.mj_step(model, data, int(0.3 / timestep))
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    jacobian, tangent, frequency = seen
    J = jacobian.reshape(-1, model.nv)
    modes = J @ np.linalg.solve(inertia, J.T) @ block_diag(*tangent)
    stiffest = np.sqrt(np.linalg.eigvals(modes).real.max())
    np.testing.assert_allclose(frequency, stiffest, rtol=0.1)
    np.testing.assert_allclose(data.body("box").xpos, start, atol=1e-6)
    for handle in handles:
        assert handle.read(data, "contact_force")[1] == pytest.approx(1.0, rel=0.01)
    total = sum(
        data.xmat[model.body(h.body).id].reshape(3, 3) @ h.read(data, "contact_force")[:3] for h in handles
    )
    np.testing.assert_allclose(total, [-0.005 * G, 0, 0], atol=1e-5)


def test_several_bodies_touch_one_skin():
    bodies = "".join(
        f'<body pos="{x} 0 .0129"><freejoint/><geom type="box" size=".0025 .004 .005" mass="{mass}"/></body>'
        for x, mass in ((-0.003, 0.002), (0.003, 0.05))
    )
    model, data, handle = scene(bodies, 0.002)
    mujoco.mj_step(model, data, 150)
    assert handle.read(data, "contact_force")[1] == pytest.approx(0.052 * G, rel=0.01)
    np.testing.assert_allclose(data.qfrc_passive[[2, 8]], [0.002 * G, 0.05 * G], rtol=0.01)


def test_a_mocap_indenter_presses_a_resting_finger():
    """Position-driven: the force is the springs' for that depth, and the welded finger feels it."""
    body = '<body name="probe" mocap="true" pos="0 0 .0185"><geom type="box" size=".05 .05 .01"/></body>'
    model, data, handle = scene(body, 0.002, stiffness=1e3)
    data.mocap_pos[0] = [0, 0, 0.0178]  # 0.2 mm deep
    mujoco.mj_step(model, data)
    assert handle.read(data, "contact_force")[1] == pytest.approx(81 * 1e3 * 0.2e-3, rel=1e-6)


@pytest.mark.parametrize("solver", ["PGS", "CG", "Newton"])
@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_every_solver_and_jacobian_gives_the_same_motion(solver, jacobian):
    def run(**option):
        model, data, _ = scene(ball(0.001), 0.002, finger=HINGED.format('range="-90 0" limited="true"'))
        model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{option['solver'].upper()}")
        model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{option['jacobian'].upper()}")
        model.opt.iterations, model.opt.tolerance = 1000, 1e-14
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 25)
        return data.qpos.copy()

    np.testing.assert_allclose(
        run(solver=solver, jacobian=jacobian), run(solver="Newton", jacobian="dense"), atol=2e-7
    )


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
def test_one_way_leaves_the_dynamics_alone(integrator):
    bodies = ball(0.01, pos="0.001 0 .0182") + '<geom type="plane" size="1 1 .1" pos="0 0 .0075"/>'
    model, data, handle = scene(bodies, coupling="one-way", readings="sum", integrator=integrator)
    bare = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody>'
        f'<body name="finger"><body name="core" quat="{" ".join(map(str, PAD_UP))}" pos=".01 0 0"><inertial '
        'pos="0 0 0" mass=".004" '
        f'diaginertia="1e-7 1e-7 1e-7"/></body></body>{bodies}</worldbody></mujoco>'
    )
    plain = mujoco.MjData(bare)
    for _ in range(100):
        mujoco.mj_step(model, data)
        mujoco.mj_step(bare, plain)
        assert np.array_equal(data.qpos, plain.qpos) and np.array_equal(data.qvel, plain.qvel)
    assert handle.read(data, "contact_force")[1] > 0  # it did read


@pytest.mark.parametrize("mass, timestep, stiffness", [(0.001, 0.004, 1e3), (0.003, 0.002, 2e4)])
def test_runge_kutta_does_not_throw_what_is_light(mass, timestep, stiffness):
    """Each stage took the skin's force where it was itself: explicit, and a gram was thrown off."""
    model, data, handle = scene(ball(mass), timestep, stiffness=stiffness, integrator="RK4")
    data.qpos[2] += 1e-3
    mujoco.mj_step(model, data, int(0.3 / timestep))
    force = handle.read(data, "contact_force")[:3]
    np.testing.assert_allclose(force, [0.0, mass * G, 0.0], atol=1e-6 * mass * G)
    assert np.abs(data.qvel).max() < 1e-6 and handle.read(data, "status")[0] == 1


@pytest.mark.parametrize("integrator", ["RK4", pytest.param("Euler", marks=pytest.mark.slow), "implicitfast"])
def test_a_smooth_press_is_of_second_order(integrator):
    """1 kg on a slide is pressed smoothly, but for the springs that it meets: against steps of 0.1 ms."""

    def way(timestep):
        """Mean positions of a step and the next, which semi-implicit integrators have half a step late."""
        slide = ball(1.0, '<joint type="slide" axis="0 0 1"/>', "0 0 .0177")
        model, data, _ = scene(slide, timestep, integrator=integrator)
        data.qpos[0], out = -6e-4, []
        for k in range(round(0.064 / timestep)):
            data.qfrc_applied[0] = -8 * (1 - np.cos(2 * np.pi * (data.time + timestep / 2) / 0.064))
            mujoco.mj_step(model, data)
            if (k + 1) % round(0.004 / timestep) == 0:
                out.append(data.qpos[0] - (integrator != "RK4") * data.qvel[0] * timestep / 2)
        return np.array(out)

    exact = way(1e-4)
    off = [np.sqrt(np.mean((way(h) - exact) ** 2)) for h in (0.004, 0.002, 0.001)]
    print([f"{1e6 * one:.3g} um" for one in off])  # for the lab book: -rP
    assert off[1] < off[0] / 2.5 and off[2] < off[1] / 2.5


def taken_and_told(model, data, handle, steps):
    """Of steps in which the finger holds free bodies: force [N] that it took from their momentum, the one
    that it told, whether it called the step settled; (n, 3), (n, 3), (n,)."""
    free = [i for i in range(model.nbody) if model.body_dofnum[i] == 6 and model.body(i).name != "finger"]
    mass, dof = model.body_mass[free, None], model.body_dofadr[free, None] + np.arange(3)
    taken, told, settled = [], [], []
    for _ in range(steps):
        mujoco.mj_kinematics(model, data)
        frame, before = data.body(handle.body).xmat.reshape(3, 3).copy(), data.qvel[dof].copy()
        mujoco.mj_step(model, data)
        change = (data.qvel[dof] - before) / model.opt.timestep - model.opt.gravity
        taken.append((mass * change).sum(0))
        told.append(-frame @ handle.read(data, "contact_force")[:3])
        settled.append(handle.read(data, "status")[0] == 1)
    taken, told = np.array(taken), np.array(told)
    held = np.linalg.norm(taken, axis=1) > 1e-3
    assert held.sum() > 5
    return taken[held], told[held], np.array(settled)[held]


SPINNING = """<body name="finger"><freejoint/><geom type="box" size=".01 .01 .01" pos="0 0 -.01" mass="0.1"
  contype="0" conaffinity="0"/></body>"""


@pytest.mark.parametrize("finger", ['<body name="finger"/>', SPINNING])
def test_runge_kutta_reports_what_acted_over_the_step(finger):
    model, data, handle = scene(ball(0.1), 0.001, integrator="RK4", finger=finger, gravity="0 0 0")
    data.qvel[model.body("ball").dofadr[0] + 2] = -0.3
    if finger == SPINNING:
        data.qvel[3:6] = 2.0, -3.0, 4.0
    taken, told, _ = taken_and_told(model, data, handle, 100)
    np.testing.assert_allclose(told, taken, atol=1e-9 * np.abs(taken).max())


def test_the_stages_of_a_step_are_one_step():
    """What a look at the state adds between steps, mj_forward, is none of its stages; mj_step2 has one, and
    makes a step for which the skin was not solved."""
    bare, looked = (scene(ball(0.1), 0.002, integrator="RK4") for _ in range(2))
    for _ in range(20):
        mujoco.mj_step(bare[0], bare[1])
        mujoco.mj_forward(looked[0], looked[1])
        mujoco.mj_step(looked[0], looked[1])
        assert np.array_equal(bare[1].sensordata, looked[1].sensordata)
    model, data, handle = looked
    mujoco.mj_step1(model, data)
    assert handle.read(data, "contact_force")[1] > 0
    with pytest.warns(RuntimeWarning, match="mj_step2 makes Euler's step.*call mj_step"):
        mujoco.mj_step2(model, data)
    biotac_mj.plugin.clear_errors()


STACK = ball(0.1) + (
    '<body name="top" pos="0 .001 .0379"><freejoint/>'
    '<geom name="top" size=".01" mass="0.3" friction="0.5"/></body>'
)


def test_runge_kutta_leaves_the_forces_of_mujocos_contacts():
    """They act in a step together with the skin, as forces; mjData has them where contacts are read."""
    model, data, handle = scene(STACK, 0.002, integrator="RK4", geoms=["ball"])
    mujoco.mj_step(model, data, 20)
    found = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, found)
    assert data.ncon == 1 and 0.3 * G < found[0] < handle.read(data, "contact_force")[1]  # falling


BESIDE = """<geom type="plane" size="1 1 .1" pos="0 0 -.1"/>
  <body name="falls" pos=".2 0 -.08"><freejoint/><geom size=".01" mass="0.2"/></body>
  <body name="swings" pos=".3 0 0"><joint axis="0 1 0" limited="true" range="-.2 .2"/>
    <geom size=".01" pos=".1 0 0" mass="0.1"/></body>
  <body name="whirls" pos=".5 0 0"><freejoint/>
    <geom type="box" size=".02 .02 .02" mass="0.1" contype="0" conaffinity="0"/></body>"""
CONNECT = '<equality><connect body1="whirls" body2="world" anchor="0 0 .1"/></equality>'


@pytest.mark.parametrize("jacobian", first(["dense", "sparse"]))
def test_what_no_skin_touches_moves_as_in_mujocos_runge_kutta(jacobian):
    """A constraint force that is held over a step does not turn with the body: a pendulum on a connect gained
    a third of its energy in two seconds while a ball lay on the pad."""
    paths = []
    for attached in (True, False):
        bodies = BESIDE + (ball(0.1) if attached else "")
        spec = mujoco.MjSpec.from_string(
            f'<mujoco><option timestep="0.002" integrator="RK4" jacobian="{jacobian}"/>'
            f'<worldbody><body name="finger"/>{bodies}</worldbody>{CONNECT}</mujoco>'
        )
        if attached:
            handle = attach(
                spec, body="finger", quat=PAD_UP, pos=[0.01, 0, 0], skin=spring_skin.pad_geometry(),
                stepper="springs", readings="none", friction=0.3, options={"stiffness": 1e3}, geoms=["ball"],
            )  # fmt: skip
        data = mujoco.MjData(model := spec.compile())
        joint = model.body("whirls").jntadr[0]
        data.qvel[model.jnt_dofadr[joint]] = 2.0
        path = []
        for _ in range(300):
            mujoco.mj_step(model, data)
            path.append([data.body(name).xpos.copy() for name in ("falls", "swings", "whirls")])
        paths.append(np.array(path))
        if attached:
            assert handle.read(data, "contact_force")[1] == pytest.approx(0.1 * G, rel=1e-2)
    np.testing.assert_allclose(*paths, atol=1e-9)


@pytest.mark.parametrize("order", [("here", "there"), ("there", "here")])
def test_a_core_elsewhere_reads_its_contact_once(order):
    """The core on which another ball lies counted its contact 11/6 times under RK4, as if the skin that is
    touched here held it; attached first, it put its forces in the place of those held here."""

    def run(names):
        bodies = ball(0.1, '<joint type="slide" axis="0 0 1"/>') + (
            '<body pos=".08 0 .018"><freejoint/><geom size=".01" mass=".3"/></body>'
        )
        spec = mujoco.MjSpec.from_string(
            '<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body name="here"/>'
            f'<body name="there" pos=".08 0 0"/>{bodies}</worldbody></mujoco>'
        )
        handles = {}
        for name in names:
            handles[name] = attach(
                spec, body=name, prefix=name, quat=PAD_UP, pos=[0.01, 0, 0], skin=spring_skin.pad_geometry(),
                stepper="springs", readings="none", options={"stiffness": 1e3},
                coupling={"here": "two-way", "there": "one-way"}[name],
            )  # fmt: skip
        data, out = mujoco.MjData(model := spec.compile()), []
        for _ in range(60):
            mujoco.mj_step(model, data)
            out.append(
                [data.qpos[0], *(h.read(data, "contact_force")[1] for _, h in sorted(handles.items()))]
            )
        return np.array(out)

    both, here, alone = run(order), run(["here"]), run(["there"])
    assert alone[-1, 1] > 0.3 * G
    np.testing.assert_allclose(both[:, :2], here, atol=1e-6)
    np.testing.assert_allclose(both[:, 2], alone[:, 1], rtol=1e-4)


@pytest.mark.law
@pytest.mark.parametrize("turn", [0.02, 0.1, 0.4])
def test_what_whirls_on_a_touched_body_gains_nothing(turn):
    """turn: [rad] in a step. With a tie's force of the first stage in all four, a whirl gained the square of
    that in each step: 2.5 times its energy at 0.05 rad, and without bound at 0.4."""
    whirls = (
        '<body name="whirls" pos="0 0 .01799" gravcomp="1"><freejoint/>'
        '<geom size=".003" pos=".03 0 0" mass=".002" contype="0" conaffinity="0"/></body>'
    )
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" integrator="RK4"/><worldbody><body name="finger"/>'
        f"""{ball(1.0, '<joint type="slide" axis="0 0 1"/>')}{whirls}</worldbody>"""
        '<equality><connect body1="whirls" body2="ball" anchor="0 0 0"/></equality></mujoco>'
    )
    handle = attach(
        spec, body="finger", quat=PAD_UP, pos=[0.01, 0, 0], skin=spring_skin.pad_geometry(),
        stepper="springs", readings="none", friction=0.3, options={"stiffness": 1e4}, geoms=["ball"],
    )  # fmt: skip
    data = mujoco.MjData(model := spec.compile())
    speed, velocity = turn / 0.002, np.zeros(6)
    data.qvel[-1] = speed
    for _ in range(100):
        mujoco.mj_step(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body("whirls").id, velocity, 0)
        assert handle.read(data, "contact_force")[1] > 0
        assert np.linalg.norm(velocity[3:]) < 1.01 * 0.03 * speed


def stack(solver, iterations, integrator, flags=0):
    model, data, handle = scene(STACK, integrator=integrator, geoms=["ball"])
    model.opt.disableflags |= flags
    model.opt.solver, model.opt.iterations = getattr(mujoco.mjtSolver, f"mjSOL_{solver.upper()}"), iterations
    data.qvel[2] = -0.2
    return taken_and_told(model, data, handle, 100)


@pytest.mark.parametrize("iterations, integrator", covering([3, 100], ["Euler", "implicitfast"]))
def test_a_dual_solver_that_stops_early_is_reported_as_it_acts(iterations, integrator):
    taken, told, settled = stack("PGS", iterations, integrator)
    np.testing.assert_allclose(told, taken, atol=1e-9 * np.abs(taken).max())
    assert iterations == 3 or settled.all()  # with 3 the rows would lack up to 8 % of the skin's force


def test_a_dual_solver_that_stops_early_settles():
    _, _, settled = stack("PGS", 3, "Euler")
    assert settled.all()


@pytest.mark.parametrize(
    "solver, iterations",
    [
        ("CG", 3),
        ("Newton", 1),
        *(pytest.param(s, 100, marks=pytest.mark.slow) for s in ("CG", "Newton")),  # as elsewhere
    ],
)
def test_a_primal_solver_that_stops_early_goes_on(solver, iterations):
    """Euler moves bodies by its accelerations, which forces do not explain before it has finished."""
    taken, told, settled = stack(solver, iterations, "Euler")
    np.testing.assert_allclose(told, taken, atol=1e-3 * np.abs(taken).max())
    assert settled.all()


def test_a_primal_solver_that_cannot_go_on_is_not_called_settled():
    taken, told, settled = stack("CG", 3, "Euler", int(mujoco.mjtDisableBit.mjDSBL_WARMSTART))
    off = np.linalg.norm(told - taken, axis=1) / np.linalg.norm(taken, axis=1)
    assert (off > 0.01).sum() > 10 and not settled[off > 0.01].any()


def test_displacement_undoes_displace():
    rng = np.random.default_rng(0)
    pos, mat = rng.normal(size=(5, 3)) * 0.01, rotation(rng.normal(size=(5, 3)))
    motion = rng.normal(size=(5, 6)) * 1e-5
    np.testing.assert_allclose(displacement(*displace(pos, mat, motion), pos, mat), motion, atol=1e-11)
    # of bodies that spin, from 50 rad/s in 2 ms, and that the step's acceleration takes from where they are
    here, spin, motion = pos + 1e-3 * rng.normal(size=(5, 3)), 0.1 * rng.normal(size=(5, 3)), 1e3 * motion
    moved = displace(pos, mat, motion, here, spin)
    np.testing.assert_allclose(displacement_at_once(*moved, pos, mat, here, spin), motion, atol=1e-6)
    large = rotation(np.array([[0.0, 0.0, 3.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(
        displacement(np.zeros((2, 3)), large, np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))[:, 3:],
        [[0, 0, 3], [1, 0, 0]],
        atol=1e-12,
    )
