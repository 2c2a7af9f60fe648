"""What no impact may do: gain energy, pass through the finger, lose the skin's force."""

import warnings

import mujoco
import numpy as np
import pytest
import spring_skin
import trimesh
from grids import covering, first

import biotac_mj
from biotac_mj import plugin
from biotac_mj.coupling.implicit.group import SkinGroup

PAD_UP = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
GHOST = 'contype="0" conaffinity="0"'
EQUALITY = int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)


def finger_under(thrown, timestep, free=None, integrator="implicitfast", gravity="0 0 0", **settings):
    """A finger with its pad up, fixed or of `free` [kg], and a body over it."""
    finger = '<body name="finger"/>'
    if free:
        box = f'<geom type="box" size=".008 .008 .008" pos="0.02 0 -.01" mass="{free}" {GHOST}/>'
        finger = f'<body name="finger"><freejoint/>{box}</body>'
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" integrator="{integrator}" gravity="{gravity}"/>'
        f"<worldbody>{finger}{thrown}</worldbody></mujoco>"
    )
    handle = biotac_mj.attach(
        spec, body="finger", quat=PAD_UP, pos=[6.2e-3, 0, 0], readings="none", **settings
    )
    model = spec.compile()
    return model, mujoco.MjData(model), handle


# a ball that presses 0.9 mm deep, and a box that flies beside it and turns
BESIDE_A_PRESS = """<body name="ball" mocap="true" pos="0 0 .01241"><geom size=".005" contype="0"/></body>
<body name="box" pos="-.008 0 .0176" quat=".4 .7 -.5 .3"><freejoint/><geom type="box" size=".005 .004 .0045"
mass="{mass}" contype="0"/></body>"""
BESIDE = [(0.28e-3, 0.33), (0.17e-3, 0.47), (0.11e-3, 0.29)]  # mass [kg], speed [m/s] of that box


def kinetic(model, data):
    mujoco.mj_energyVel(model, data)
    return data.energy[1]


@pytest.fixture(autouse=True)
def no_errors():
    plugin.clear_errors()
    yield
    plugin.check()


def thrown_body(rng, height):
    kind, size = rng.choice(["sphere", "box"]), 10 ** rng.uniform(-2.5, -1.8, 3)
    quat, (x, y) = rng.normal(size=4), rng.uniform(-0.004, 0.004, 2)
    geom = (
        f'<geom type="{kind}" size="{size[0]} {size[1]} {size[2]}" mass="{10 ** rng.uniform(-3, 0)}" '
        f'friction="{rng.uniform(0.1, 1.2)}"/>'
    )
    pos, quat = f"{x} {y} {height + 1.75 * size.max()}", " ".join(map(str, quat))
    return f'<body name="thrown" pos="{pos}" quat="{quat}"><freejoint/>{geom}</body>'


@pytest.mark.parametrize("rounds, tier", covering([None, 2, 1], ["condensed", "full"]))
def test_rounds_are_bounded_by_an_option(rounds, tier):
    """No more often than is said the skin is solved, and hardly ever more than once, since the box gives way
    while it is; it comes back with no more than it came with."""
    box = '<body name="thrown" pos="0 0 .0153" quat=".9 .3 .2 .1"><freejoint/>'
    box += '<geom type="box" size=".004 .005 .004" mass="0.004"/></body>'
    options = {} if rounds is None else {"options": {"rounds": rounds}}
    model, data, handle = finger_under(box, 0.002, skin="coarse", tier=tier, **options)
    data.qvel[2] = -0.8
    mujoco.mj_forward(model, data)
    start, most, energy = kinetic(model, data), 0, 0.0
    for _ in range(16):
        mujoco.mj_step(model, data)
        most = max(most, int(handle.read(data, "status")[5]))
        energy = max(energy, kinetic(model, data))
    assert 1 <= most <= (rounds or 2)
    assert energy < 1.01 * start and data.qvel[2] > -0.79


@pytest.mark.parametrize("speed", [0.7992, 0.7988949762260666])
def test_a_lost_first_step_in_the_skin_gives_nothing(speed):
    """What was put into the skin is not known before it has balanced. The solve of this step finds no
    equilibrium and ends with 9 N."""
    box = '<body name="thrown" pos="0 0 .0153" quat=".9 .3 .2 .1"><freejoint/>'
    box += '<geom type="box" size=".004 .005 .004" mass="0.004"/></body>'
    model, data, _ = finger_under(box, 0.002, skin="coarse", tier="full")
    data.qvel[2] = -speed
    mujoco.mj_forward(model, data)
    start = kinetic(model, data)
    mujoco.mj_step(model, data)
    assert kinetic(model, data) < 1.01 * start


def most_energy(model, data, seconds):
    """Largest kinetic energy on the way over that at the start."""
    start = kinetic(model, data)
    most = 0.0
    for _ in range(int(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        plugin.check()
        most = max(most, kinetic(model, data))
    assert np.isfinite(data.qpos).all()
    return most / start


@pytest.mark.law
@pytest.mark.parametrize(
    "seed, integrator",
    [
        pytest.param(seed, integrator, marks=[pytest.mark.slow] if seed % 3 else [])
        for seed, integrator in [*((s, None) for s in range(12)), *((s, "RK4") for s in range(6))]
    ],
)
def test_a_spinning_body_gains_no_energy_from_springs(seed, integrator):
    rng = np.random.default_rng([20, seed])
    free = 10 ** rng.uniform(-2, -0.7) if seed % 2 else None
    model, data, _ = finger_under(
        thrown_body(rng, 0.008),
        [0.001, 0.002, 0.004][seed % 3],
        free,
        integrator or str(rng.choice(["Euler", "implicitfast", "implicit"])),
        skin=spring_skin.pad_geometry(15),
        stepper="springs",
        options={"stiffness": float(10 ** rng.uniform(1, 3))},
    )
    model.geom_contype[:], model.geom_conaffinity[:] = 0, 0  # the springs alone, without the core
    j = 6 if free else 0
    data.qvel[j + 2] = -rng.uniform(0.05, 1.0)
    data.qvel[j + 3 : j + 6] = rng.normal(size=3) * 10 ** rng.uniform(0, 1.3)
    mujoco.mj_forward(model, data)
    assert most_energy(model, data, 0.1) < 1 + 1e-4


def test_the_rows_have_no_reference_acceleration():
    """MuJoCo gives a weld's rows dJ/dt v: 300 m/s^2 at 20 rad/s here, from its anchor far away."""
    model, data, _ = finger_under(
        '<body pos="0 0 .0179"><freejoint/><geom size=".01" mass=".02"/></body>',
        0.002,
        0.05,
        skin=spring_skin.pad_geometry(),
        stepper="springs",
    )
    data.qvel[[3, 4, 9, 10, 11]] = 5, 20, 20, -10, 5
    mujoco.mj_forward(model, data)
    rows = data.efc_type == EQUALITY
    assert rows.sum() == 6 and np.abs(data.efc_J[: 6 * model.nv]).max() > 0
    assert np.abs(data.efc_aref[rows]).max() < 1e-9


@pytest.mark.parametrize(
    "tier, seed, integrator",
    [
        *(("condensed", seed, "implicitfast") for seed in (0, 1)),
        pytest.param("condensed", 2, "implicitfast", marks=pytest.mark.slow),
        pytest.param("full", 1, "implicitfast", marks=pytest.mark.slow),
        ("condensed", 0, "RK4"),
        *(pytest.param("condensed", seed, "RK4", marks=pytest.mark.slow) for seed in (1, 2)),
        *(pytest.param("full", seed, "implicitfast", marks=pytest.mark.slow) for seed in (0, 2)),
        pytest.param("full", 0, "RK4", marks=pytest.mark.slow),
    ],
)
def test_a_skin_keeps_what_hits_it_out_and_gives_nothing(tier, seed, integrator):
    rng = np.random.default_rng([21, seed])
    free = 0.05 if seed == 1 else None
    model, data, handle = finger_under(
        thrown_body(rng, 8.31e-3), [0.004, 0.002, 0.001][seed], free, integrator, skin="coarse", tier=tier
    )
    j = 6 if free else 0
    data.qvel[j + 2], data.qvel[j + 3 : j + 6] = -0.8, rng.normal(size=3) * 10
    mujoco.mj_forward(model, data)
    assert most_energy(model, data, 0.06) < 1.01


@pytest.mark.parametrize("mass, speed, timestep", [(0.02, 3.0, 0.004), (0.5, 2.0, 0.001), (5.0, 1.0, 0.002)])
def test_nothing_passes_through_the_core(mass, speed, timestep):
    model, data, handle = finger_under(
        f'<body name="thrown" pos="0 0 .0193"><joint type="slide" axis="0 0 1"/>'
        f'<geom size=".008" mass="{mass}"/></body>',
        timestep,
        skin="coarse",
        tier="condensed",
    )
    data.qvel[0] = -speed
    mujoco.mj_forward(model, data)
    assert most_energy(model, data, 0.03) < 1.01
    assert data.body("thrown").xpos[2] > 0.012


def test_a_body_that_is_put_into_the_core_is_pushed_out():
    model, data, handle = finger_under(
        '<body name="ball" pos="0 0 .0125"><joint type="slide" axis="0 0 1" damping="2"/>'
        '<geom size=".008" mass=".05"/></body>',
        0.002,
        skin="coarse",
        tier="condensed",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mujoco.mj_step(model, data)
    assert 0 < data.qvel[0] < 1  # no faster than by what a skin that is pressed to its core holds
    mujoco.mj_step(model, data, 150)
    assert data.body("ball").xpos[2] > 0.0155 and handle.read(data, "status")[0] == 1


def test_the_core_meets_what_the_skin_meets():
    """Named geoms alone where they are named; the solid parts of another BioTac are none of the skin's."""
    objects = "".join(
        f'<body pos="0 0 {z}"><geom name="{name}" size=".01"/></body>' for name, z in (("a", 0.1), ("b", 0.2))
    )
    model, _, _ = finger_under(objects, 0.002, skin="coarse", tier="condensed", geoms=["a"])
    assert model.npair == 3 and {int(g) for g in model.pair_geom2} | {int(g) for g in model.pair_geom1} == {
        *(model.geom(f"biotac_{n}").id for n in ("core", "nail", "clamp")),
        model.geom("a").id,
    }
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='l'/><body name='r' pos='.1 0 0'/></worldbody></mujoco>"
    )
    for side in "lr":
        biotac_mj.attach(spec, body=side, prefix=side, skin="coarse", tier="condensed", readings="none")
    model = spec.compile()
    from biotac_mj.coupling.setup import Setup
    from biotac_mj.coupling.structs import ModelView

    assert len(Setup(ModelView(model._address), 0).touching.geom) == 0


def pinched(integrator, **settings):
    """A finger on a hinge that 2 kg and 12 g pinch, of which the light one turns by 0.7 rad a step."""
    half = np.array([0.00474238, 0.0115121, 0.00573276])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    spec = mujoco.MjSpec.from_string(f"""<mujoco><option timestep="0.004" integrator="{integrator}"
      gravity="0 9.81 0"/><asset><mesh name="block" vertex="{" ".join(f"{v:.6g}" for v in corners.ravel())}"/>
      </asset><worldbody>
      <body name="finger"><joint name="hinge" axis="0 0 1" pos=".03 0 0" damping=".001" armature="2e-5"/>
        <geom size=".004" pos=".025 0 0" mass="0.196715943"/></body>
      <body name="heavy" pos="-0.0202504616 0.0103301043 0.0264561356"
        quat="-0.532297439 0.723046246 0.428334241 -0.101947735"><freejoint/><geom type="ellipsoid"
        size="0.00717453326 0.00425579978 0.00706888428" mass="2.03219994" friction="1.5 .005 .0001"/></body>
      <body name="light" pos="-0.0216866768 -0.0084671836 0.0271298781"
        quat="-0.466813861 0.206021581 -0.779463581 0.363423241"><freejoint/><geom type="mesh" mesh="block"
        mass="0.0122241752" friction="0.3 .005 .0001"/></body>
      </worldbody><actuator><position joint="hinge" kp=".2" kv=".0005"/></actuator></mujoco>""")
    handle = biotac_mj.attach(spec, body="finger", skin="coarse", readings="none", **settings)
    model = spec.compile()
    data = mujoco.MjData(model)
    heavy = [1.05361286, -0.393576757, -1.59232294, 2.55574186, -24.9150126, -16.7581068]
    light = [0.271522429, 0.278233188, -0.89149271, -156.166662, 8.70264187, -44.2627034]
    data.qvel[1:] = heavy + light
    mujoco.mj_forward(model, data)
    return model, data, handle


@pytest.mark.law
@pytest.mark.parametrize("integrator", ["implicitfast", "implicit"])
def test_fast_turning_bodies_gain_nothing_from_withheld_force(integrator):
    """A third of their energy came from nowhere."""
    model, data, _ = pinched(integrator, tier="condensed")
    assert most_energy(model, data, 0.1) < 1.02


@pytest.mark.law
@pytest.mark.parametrize(
    "integrator, light, quat, place, heavy, speed",
    [
        pytest.param("RK4", 'box" size=".0022 .0038 .0031" mass=".0039', "-.62 .15 -1.61 .24",
                     ".0016 -.0001 .0312", 1.71, 0.79, marks=pytest.mark.slow),
        ("RK4", 'cylinder" size=".0028 .0022" mass=".0037', "1.83 .03 -.52 .58", "-.0009 .0013 .0324",
         2.06, 0.72),
        ("implicitfast", 'box" size=".0025 .003 .0027" mass=".0025', "-.63 -1.32 -.11 1", "-.002 .0002 .0298",
         2.15, 0.48),
        pytest.param("implicitfast", 'box" size=".0021 .0022 .003" mass=".0037', "-.01 -1.18 .41 -.46",
                     "-.0007 .0013 .029", 2.08, 0.71, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_a_light_body_that_a_heavy_one_crushes_gains_nothing(integrator, light, quat, place, heavy, speed):
    """Runge-Kutta's later stages held the force of the first, against what MuJoCo's contact with the heavy
    body was there: no number was left. With implicitfast steps went on from iterates that lacked 20 times the
    load, with 18 kN."""
    between = float(place.split()[2]) - 12e-3 - 8.4e-3
    bodies = f"""<body name="light" pos="0 0 {8.4e-3 + between / 2}" quat="{quat}"><freejoint/>
      <geom type="{light}"/>
      </body><body pos="{place}"><freejoint/><geom type="box" size=".012 .012 .0115" mass="{heavy}"/>
      </body>"""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".005" gravity="0 0 0" solver="CG" cone="elliptic" '
        f'integrator="{integrator}"/><worldbody><site name="tip" quat="1 -1 0 0"/>{bodies}'
        "</worldbody></mujoco>"
    )
    biotac_mj.attach(spec, site="tip", skin="coarse", tier="condensed", readings="none")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[8] = -speed
    mujoco.mj_forward(model, data)
    assert most_energy(model, data, 0.1) < 1.001


def test_the_stages_of_a_step_crush_no_light_body():
    """0.6 g under 0.34 kg: the contact of the two was solved anew in each of Runge-Kutta's stages, against a
    skin that was solved for the whole step."""
    bodies = """<body pos="-.01 0 .012117034" quat=".1452416157 -.6055152463 .1993579876 .7566455923">
      <freejoint/><geom type="box" size=".00186512 .00282813 .00313163" mass=".000635664"/></body>
      <body pos="-.010599392 .00029173575 .036345349"
      quat=".6303281957 -.4148536331 .6044899527 -.2552934114">
      <freejoint/><geom type="cylinder" size=".00919129 .00628003" mass=".344346"/></body>"""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".002" integrator="RK4" solver="CG" cone="elliptic"/>'
        f'<worldbody><site name="tip" quat="1 -1 0 0"/>{bodies}</worldbody></mujoco>'
    )
    biotac_mj.attach(spec, site="tip", skin="coarse", tier="condensed", readings="none")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[[2, 8]] = -0.02, -0.7529881272502237
    mujoco.mj_forward(model, data)

    def energy():
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        return data.energy.sum()

    start = energy()
    for _ in range(18):
        mujoco.mj_step(model, data)
        assert energy() < start + 1e-4


@pytest.mark.parametrize(
    "integrator, tie, turn",
    [
        ("implicitfast", '<connect body1="a" body2="b" anchor=".004 0 .002"/>', 0.6),
        ("implicitfast", '<weld body1="a" body2="b"/>', 1.0),
        ("RK4", '<connect body1="a" body2="b" anchor=".004 0 .002"/>', 1.5),
        ("RK4", '<weld body1="a" body2="b"/>', 3.0),
    ],
)
def test_mujoco_alone_loses_a_tied_pair_that_whirls(integrator, tie, turn):
    """By so many radians a step, with nothing else in the scene: a limit of what a crush may be."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep=".002" integrator="{integrator}" gravity="0 0 0"/><worldbody>'
        '<body name="a"><freejoint/><geom type="cylinder" size=".0041 .0056" euler="73 254 51" mass=".008"/>'
        '</body><body name="b" pos=".008 0 .004"><freejoint/><geom size=".003" mass=".008"/></body>'
        f"</worldbody><equality>{tie}</equality></mujoco>"
    )
    data = mujoco.MjData(model)
    spin = turn / 0.002 * np.array([0.3, 1, 0.2]) / np.linalg.norm([0.3, 1, 0.2])
    for body in range(2):
        data.qvel[6 * body :][:6] = *np.cross(spin, data.qpos[7 * body :][:3] - [0.004, 0, 0.002]), *spin
    mujoco.mj_step(model, data, 30)
    assert sum(warning.number for warning in data.warning)


@pytest.mark.parametrize("integrator", ["RK4", "implicitfast"])
def test_thrown_bodies_settle_with_all_integrators(integrator):
    """With Runge-Kutta 6 of 16 steps did not: its stages took bodies elsewhere than the first one said."""
    lost = 0
    for seed in (1, 3, 7):
        rng = np.random.default_rng([31, seed])
        thrown = thrown_body(rng, 8.31e-3)
        model, data, handle = finger_under(
            thrown, 0.004, integrator=integrator, skin="coarse", tier="condensed"
        )
        data.qvel[2], data.qvel[3:6] = -0.4, rng.normal(size=3) * 20
        mujoco.mj_step(model, data, 12)
        lost += handle.read(data, "status")[1]
    assert lost <= 1


@pytest.mark.parametrize("seed", [2, 20, 47, 51])
def test_narrow_balls_that_reach_the_core_gain_nothing(seed):
    """They come 4 to 7 mm a step: where they begin, half a step ahead of the positions, they are in the skin,
    and MuJoCo's contact with the core begins in one of the stages. What is reported is what acts."""
    rng = np.random.default_rng([77, seed])
    timestep, radius, mass = (
        rng.choice([0.002, 0.004, 0.005, 0.008]),
        rng.uniform(1.2e-3, 2e-3),
        10 ** rng.uniform(-3, -1),
    )
    step, place, gap, tilt, turn = (
        rng.uniform(3e-3, 9e-3),
        rng.uniform(-4e-3, 4e-3, 2),
        *rng.uniform(0, [1, 0.6, 6.28]),
    )
    friction, spin = rng.uniform(0, 1.5), rng.normal(size=3) * 30
    way = step * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    pos = np.array([place[0] - 1.8e-3, place[1], 8.6e-3 + radius]) - gap * way
    ball = f'<body name="ball" pos="{pos[0]} {pos[1]} {pos[2]}"><freejoint/>'
    ball += f'<geom size="{radius}" mass="{mass}" friction="{friction}"/></body>'
    model, data, handle = finger_under(ball, timestep, integrator="RK4", skin="coarse", tier="condensed")
    data.qvel[:] = *way / timestep, *spin
    mujoco.mj_forward(model, data)
    start, touched, force = kinetic(model, data), 0, np.zeros(3)
    for _ in range(round(0.04 / timestep)):
        before = data.qvel[:3].copy()
        mujoco.mj_step(model, data)
        mujoco.mju_rotVecQuat(force, handle.read(data, "contact_force")[:3], np.array(PAD_UP))
        touched += force.any()
        lost = mass * (before - data.qvel[:3]) / timestep
        np.testing.assert_allclose(force, lost, rtol=0, atol=1e-8 * (1 + np.abs(lost).max()))
        assert kinetic(model, data) <= start * (1 + 1e-12)
    assert touched > 1


@pytest.mark.law
@pytest.mark.parametrize("seed", [45, 50, 54, 56])
def test_a_ring_that_comes_into_the_core_gains_nothing(seed):
    """Its contact with the core lifts it against a skin that holds it from the other side: both together give
    no more than was put in."""
    ring = trimesh.creation.torus(6e-3, 2e-3, major_sections=28, minor_sections=14)
    corners, faces = (" ".join(str(x) for x in a.ravel()) for a in (ring.vertices.round(7), ring.faces))
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".004" gravity="0 0 0"/>'
        f'<asset><mesh name="ring" inertia="exact" vertex="{corners}" face="{faces}"/></asset>'
        '<worldbody><site name="tip" quat="1 -1 0 0"/><body name="ring" pos="0 0 .021"><freejoint/>'
        '<geom type="mesh" mesh="ring" mass=".0068" friction="0"/></body></worldbody></mujoco>'
    )
    biotac_mj.attach(spec, site="tip", skin="coarse", tier="condensed", friction=0.0, readings=False)
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[:2] = [-0.012, 0] + rng.uniform(-3e-3, 3e-3, 2)
    quat = rng.normal(size=4)
    data.qpos[3:] = quat / np.linalg.norm(quat)
    data.qvel[:3] = *rng.uniform(-0.15, 0.15, 2), -rng.uniform(0.5, 1.2)
    data.qvel[3:] = 8 * rng.normal(size=3)
    mujoco.mj_forward(model, data)
    start, into_core = kinetic(model, data), 0
    for _ in range(14):
        mujoco.mj_step(model, data)
        into_core += data.ncon
        assert all(contact.dim == 1 for contact in data.contact)
        assert kinetic(model, data) < 1.02 * start
    assert into_core


def test_a_tool_that_jumps_into_the_condensed_skin_is_followed():
    """Nothing can give way: each step goes on from where the one before it was cut off."""
    tool = '<body name="tool" mocap="true" pos="0 0 .01351"><geom type="box" size=".01 .008 .005"/></body>'
    model, data, handle = finger_under(tool, 0.002, skin="coarse", tier="condensed", material="calibrated")
    mujoco.mj_step(model, data)
    data.mocap_pos[0, 2] -= 0.0022
    settled = []
    for _ in range(13):
        mujoco.mj_step(model, data)
        settled.append(handle.read(data, "status")[0] == 1)
    assert not settled[0] and all(settled[7:]), settled
    assert np.linalg.norm(handle.read(data, "contact_force")[:3]) > 5


NOT_ALL = pytest.mark.xfail(strict=True, reason="in 20 of 75 steps a body is in the core: no skin fits")


@pytest.mark.slow
@pytest.mark.parametrize("most", [pytest.param(10, marks=NOT_ALL), 25])
def test_a_pinch_settles_in_the_full_tier(most):
    """All but two of its steps found no balance: way and depth were those of the force before it, and the
    friction that of all the way through the air. Then a skin that lost the way of its bodies held on to them
    when they were 20 mm off. What is left are steps that begin or end with a body in the core, which it meets
    with 6 mm a step: no skin fits there."""
    lost, fits = 0, 0
    for integrator in ("implicitfast", "implicit", "Euler"):
        model, data, handle = pinched(integrator)
        core = model.geom(f"{handle.prefix}core").id
        bodies = [int(model.body(name).geomadr[0]) for name in ("heavy", "light")]
        start, before = kinetic(model, data), np.inf
        for _ in range(25):
            mujoco.mj_step(model, data)
            assert kinetic(model, data) < 1.02 * start
            mujoco.mj_kinematics(model, data)
            after = min(mujoco.mj_geomDistance(model, data, geom, core, 0.05, None) for geom in bodies)
            if handle.read(data, "status")[0] != 1:
                lost, fits = lost + 1, fits + (min(before, after) > 0)
            before = after
    assert fits <= 2
    assert lost <= most  # of 75, where 69 were lost


LOST = pytest.mark.xfail(strict=True, reason="the body turns by up to 1.6 radians a step: 17 of 20 are lost")


@pytest.mark.slow
@pytest.mark.parametrize("timestep, most", [pytest.param(0.01, 5, marks=LOST), (0.01, 18), (0.002, 0)])
def test_two_fingers_settle_together(timestep, most):
    """Each skin looked for where its rounds lead by itself, though they held one body: nine of 18 steps were
    lost."""
    fingers = "".join(
        f'<body pos="0 0 {-s * 0.01566718}" gravcomp="1"><inertial pos="0 0 0" mass=".03" '
        f'diaginertia="1e-5 1e-5 1e-5"/><joint name="j{i}" type="slide" axis="0 0 1" damping="{1 - i}"/>'
        f'<site name="t{i}" quat="1 {-s} 0 0"/></body>'
        for i, s in enumerate((1, -1))
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" integrator="implicitfast" cone="elliptic"/>'
        f"<worldbody>{fingers}"
        '<body pos="-.00437919 -.00102685 0" quat="-.45647733 .78446803 .06504385 -.41473804"><freejoint/>'
        '<geom type="ellipsoid" size=".0033719 .00412547 .00733387" mass=".011415" friction="0"/></body>'
        '</worldbody><actuator><motor joint="j0"/><motor joint="j1"/></actuator></mujoco>'
    )
    rubber = {"youngs_modulus": 4e5, "poissons_ratio": 0.4999}
    hands = [
        biotac_mj.attach(
            spec,
            site=f"t{i}",
            prefix=f"b{i}_",
            tier="condensed",
            skin="coarse",
            material=rubber,
            liquid=False,
            friction=1.0,
            readings="none",
        )
        for i in (0, 1)
    ]
    model = spec.compile()
    data = mujoco.MjData(model)
    while data.time < 0.2 - 1e-9:
        push = min(1.0, data.time / 0.15) * 3.7 * (1 + 0.5 * np.sin(72 * data.time))
        data.ctrl[:] = push, -push
        mujoco.mj_step(model, data)
    assert max(hand.read(data, "status")[1] for hand in hands) <= most
    assert min(np.linalg.norm(hand.read(data, "contact_force")[:3]) for hand in hands) > 1


@pytest.mark.parametrize("tier, depth", first(["condensed", "full"], [2e-3, 3e-3]))
def test_a_body_that_starts_deep_inside_is_pushed_out_at_once(tier, depth):
    """Its force alternated; or it stayed where it was, since nobody had paid for what would push it out."""
    model, data, handle = finger_under(
        '<body name="ball" pos="0 0 .03"><freejoint/><geom name="ball" size=".005" mass=".05"/></body>',
        0.002,
        skin="coarse",
        tier=tier,
    )
    core = model.geom(f"{handle.prefix}core").id

    def gap():
        mujoco.mj_kinematics(model, data)
        return mujoco.mj_geomDistance(model, data, model.geom("ball").id, core, 0.05, None)

    while gap() > -depth:
        data.qpos[2] -= 2e-5

    def of_core():
        """Force of the solid parts on the ball, which the reading has besides the skin's."""
        found, total = np.zeros(6), np.zeros(3)
        for i, contact in enumerate(data.contact):
            mujoco.mj_contactForce(model, data, i, found)
            sign = 1.0 if contact.geom[1] == model.geom("ball").id else -1.0
            total += sign * found[:3] @ contact.frame.reshape(3, 3)
        return total

    speed, force = [0.0], [0.0]
    for _ in range(30):
        mujoco.mj_step(model, data)
        speed.append(data.qvel[2])
        read = -data.body(handle.body).xmat.reshape(3, 3) @ handle.read(data, "contact_force")[:3]
        force.append(np.linalg.norm(read - of_core()))
    force = np.array(force).round(9)
    assert (np.diff(speed) > -1e-9).all()  # nothing holds it back
    top = int(np.argmax(force))
    assert (np.diff(force[: top + 1]) > -0.05 * force[top]).all() and (np.diff(force[top:]) <= 0).all()
    assert gap() > 2e-3 and force[-1] == 0 and speed[-1] > 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    "mass, radius, timestep", [(3.0, 0.006, 0.004), pytest.param(5.0, 0.006, 0.002, marks=pytest.mark.slow)]
)
def test_heavy_bodies_come_to_rest_on_the_condensed_skin(mass, radius, timestep):
    """The step that was too dear for one solve was given up with all that the skin had carried; then each
    second one was, and the core carried what the skin had let go."""
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" integrator="implicitfast"/><worldbody>'
        '<site name="tip" quat="1 -1 0 0"/><body name="weight" pos="-.01 0 .0135">'
        f'<joint type="slide" axis="0 0 1" damping="{200 * mass}"/>'
        f'<geom type="cylinder" size="{radius} .004" mass="{mass}"/></body></worldbody></mujoco>'
    )
    handle = biotac_mj.attach(spec, site="tip", skin="coarse", tier="condensed", readings="none")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, int(0.6 / timestep))
    converged, failed, *_, withheld = handle.read(data, "status")
    weight = mass * np.linalg.norm(model.opt.gravity)
    assert handle.read(data, "contact_force")[1] == pytest.approx(weight, rel=0.01) and data.ncon == 0
    assert converged == 1 and failed < 8 and withheld == 0


def test_a_thrown_box_takes_nothing_from_an_untouched_skin(monkeypatch):
    """Its first step in touch was taken for one in which somebody had pressed it in, and lent it energy."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".01" integrator="implicit" cone="elliptic"/><worldbody>'
        '<site name="tip" quat="1 -1 0 0"/><body name="box"><freejoint/>'
        '<geom type="box" size=".008293 .004844 .007986" mass=".001115" friction="0"/></body>'
        "</worldbody></mujoco>"
    )
    biotac_mj.attach(
        spec,
        site="tip",
        tier="condensed",
        skin="coarse",
        material={"youngs_modulus": 8e6},
        liquid=True,
        friction=0.371493,
        readings="none",
    )
    model = spec.compile()
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    data.qpos[:] = -0.0276994, -0.0033384, 0.0185314, -0.225419, -0.0676020, -0.113161, -0.965303
    data.qvel[:] = 0.253901, 0.100407, -0.544565, -8.408973, 55.940941, -5.622781
    mujoco.mj_forward(model, data)
    has = kinetic(model, data)
    energy, lent, stiffness, conclude = [], [], [], SkinGroup.conclude

    def watch(self, *how):
        stiffness.extend(np.linalg.eigvalsh(self.arrays.tangent0))
        conclude(self, *how)

    monkeypatch.setattr(SkinGroup, "conclude", watch)
    for _ in range(8):
        mujoco.mj_step(model, data)
        energy.append(data.energy.sum())
        lent.append(data.plugin_state[model.plugin_stateadr[0] + 3 + 66])  # what the skin may still give
    assert max(energy) < 1.05 * energy[0] and 0 < max(lent) < 1.05 * has
    assert np.min(stiffness) > -1e-4 * np.max(stiffness)  # also where every node slips


@pytest.mark.law
def test_a_finger_that_swings_round_in_a_step_is_lent_nothing():
    """414 g turn a finger of 10 g on its hinge by 0.7 rad a step. That it went round in an arc was taken for
    a hand that had pressed the body in, and the skin was lent a quarter of all energy."""
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep=".002" gravity="0 0 0"/><worldbody><body name="finger">
        <joint axis="1 0 0" pos=".04 0 -.005"/><geom type="box" size=".008 .008 .008" mass="0.010231453"
        pos="-0.002124382 0 -.01" {GHOST}/></body><body pos="-6.50336626e-05 0.00491418669 -0.0156431955"
        quat="-1.8040011 -0.811183637 -2.60204596 -0.999693443"><freejoint/><geom type="ellipsoid"
        size="0.00295285879 0.00457980876 0.00567131085" mass="0.414184455" friction="0.376376052"/></body>
        </worldbody></mujoco>"""
    )
    biotac_mj.attach(
        spec, body="finger", quat=PAD_UP, pos=[6.2e-3, 0, 0], readings="none", skin="coarse", tier="condensed"
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[1:4] = -0.21042521375, -0.2664581679, 0.84820872135
    data.qvel[4:] = 1.500407675, -1.642102394, 0.66264996125
    mujoco.mj_forward(model, data)
    start = kinetic(model, data)
    has, turned, lent = start, 0.0, 0.0
    for _ in range(8):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        before, has = has, kinetic(model, data) + data.plugin_state[model.plugin_stateadr[0] + 3 + 66]
        turned, lent = max(turned, abs(data.qvel[0]) * model.opt.timestep), max(lent, has - before)
    assert turned > 0.5 and lent < 0.02 * start  # the core's contact gives back what it took


@pytest.mark.parametrize("nv", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_body_that_is_led_into_the_core_is_followed_along_it(nv):
    """The skin stayed with one force where the sphere had first met the core, and called it balanced."""
    spare = '<joint type="slide"/><geom size=".001" pos="0 0 1"/>' if nv else ""
    model, data, handle = finger_under(
        f'<body name="ball" mocap="true"><geom size=".0067"/></body><body>{spare}</body>',
        0.004,
        skin="coarse",
        tier="condensed",
        friction=2.0,
    )

    def follow(way):
        seen = []
        for x, z in way:
            data.mocap_pos[0] = x, 0, z
            mujoco.mj_step(model, data)
            seen.append([*handle.read(data, "contact_force")[:3], *handle.read(data, "status")[[0, 6]]])
        return np.array(seen)

    follow((0.0, z) for z in np.linspace(0.0155, 0.0115, 20))
    aside = follow((0.002 * np.sin(0.3 * k), 0.0115) for k in range(16))
    assert (aside[:, 3] == 0).all() and (aside[:, 4] < 1).all()  # no skin fits between
    assert (np.linalg.norm(np.diff(aside[:, :3], axis=0), axis=1) > 0.05).all()
    up = follow((x, z) for x, z in zip(np.linspace(-0.002, 0, 10), np.linspace(0.0119, 0.0135, 10)))
    assert (up[:, 3] == 1).all() and (np.diff(up[:, 1]) < 0).all()


@pytest.mark.xfail(strict=True, reason="what the clamp's contact took in is not kept for what it lifts")
@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
def test_a_ball_that_fell_onto_the_clamp_leans_on_the_skin(tier):
    """The clamp's contact takes in what it lifts the ball by afterwards, so that the skin's push beside it
    gives nothing."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.002" gravity="0 0 0" integrator="implicitfast" cone="elliptic"/>'
        '<worldbody><site name="tip" quat="1 1 0 0"/><body name="ball" pos=".00691 0 .0047">'
        '<joint name="z" type="slide" axis="0 0 1" damping="10"/>'
        '<geom size="0.0005" mass="0.05" friction=".5"/></body></worldbody>'
        '<actuator><motor joint="z"/></actuator></mujoco>'
    )
    handle = biotac_mj.attach(spec, site="tip", skin="coarse", tier=tier, readings=False, friction=0.5)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = -1.0
    mujoco.mj_step(model, data, 60)
    force, status = (handle.read(data, name) for name in ("contact_force", "status"))
    assert status[0] == 1 and status[7] == 0
    assert -0.3 < force[0] < -0.1  # 0 where the push is withheld
    assert force[1] == pytest.approx(-1.0, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("mass, friction, most", [(0.02, 1.0, 0), (2.335e-3, 2.0, 13)])
def test_a_light_ball_that_rolls_settles(mass, friction, most):
    """It turns by 0.3 rad a step, where a skin's tangents are far from exact: rounds came closer by so little
    that they were taken for too bold, and were shortened until they stood still."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".005" integrator="implicitfast"/><worldbody>'
        '<site name="tip" quat="1 -1 0 0"/><body name="ball"><freejoint/>'
        f'<geom size=".00237" mass="{mass}" friction="0"/></body></worldbody></mujoco>'
    )
    handle = biotac_mj.attach(
        spec,
        site="tip",
        tier="condensed",
        skin="coarse",
        material="paper",
        friction=friction,
        readings="none",
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = -0.00997067, 0.00157612, 0.01077133, 0.7071068, 0.7071068, 0, 0
    data.qvel[:] = 0.14719, 0, 0, 0.683, -0.353, -0.458
    touched = 0
    for _ in range(40):
        mujoco.mj_step(model, data)
        touched += handle.read(data, "contact_force").any()
    assert touched > 12 and handle.read(data, "status")[1] <= most


def lost_by_a_box(seed, timestep):
    """Steps in touch of a light box that is thrown at the pad with a corner or an edge, those of them that do
    not settle, and its energy at most as a share of that at the start."""
    rng = np.random.default_rng([5, seed])
    size, mass, quat = 10 ** rng.uniform(-2.5, -1.9, 3), 10 ** rng.uniform(-3, -2.22), rng.normal(size=4)
    velocity = np.zeros(6)
    velocity[2] = -rng.uniform(0.05, 1)
    velocity[3:] = rng.normal(size=3) * 10 ** rng.uniform(-1, 1.3)
    geom = f'<geom type="box" size="{size[0]} {size[1]} {size[2]}" mass="{mass}" '
    geom += f'friction="{rng.uniform(0.1, 1.2)}"/>'
    body = f'<body name="box"><freejoint/>{geom}</body>'
    model, data, handle = finger_under(body, timestep, skin="coarse", tier="condensed")
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, quat / np.linalg.norm(quat))
    lowest = np.abs(turned[6:]) @ size
    data.qpos[:] = *rng.uniform(-0.004, 0.004, 2), 8.31e-3 + lowest + 3e-4, *(quat / np.linalg.norm(quat))
    data.qvel[:] = velocity
    mujoco.mj_forward(model, data)
    start, touched, lost, most = kinetic(model, data), 0, 0, 0.0
    for _ in range(round(0.03 / timestep)):
        mujoco.mj_step(model, data)
        if handle.read(data, "contact_force")[:3].any():
            touched, lost = touched + 1, lost + (handle.read(data, "status")[0] != 1)
        most = max(most, kinetic(model, data) / start)
    return touched, lost, most


@pytest.mark.slow
@pytest.mark.parametrize(
    "seeds, share",
    [(range(10), 0.18), pytest.param((*range(12), *range(20, 32)), 0.12, marks=pytest.mark.slow)],
    ids=["quick", "all"],
)
def test_light_boxes_on_edges_and_corners_settle(seeds, share):
    """A corner stiffens over micrometres: rounds went from where it hardly touched to deep in the skin, and
    from there off it, and were shortened until they stood still."""
    quick = len(seeds) == 10
    cases = [lost_by_a_box(s, dt) for s in seeds for dt in ((0.004,) if quick else (0.004, 0.002))]
    touched, lost, most = zip(*cases)
    print(f"{sum(lost)} of {sum(touched)} steps in touch unsettled, energy {max(most):.4f} of the start's")
    assert sum(touched) > 2 * len(cases) and max(most) < 1.01
    assert sum(lost) <= share * sum(touched)


def test_a_light_stick_gains_nothing_from_open_pgs_rows():
    """0.6 g at 1 m/s: a damper of which PGS takes back too little threw it off, faster in each step, to
    numbers that are none."""
    pos = "-0.004531920753110217 0.0005847219277294378 0.02744877159081723"
    quat = "-0.19106979261493415 -0.47426522684478123 0.14831923028629268 -0.846502353737564"
    size = 'size="0.018895924026121665 0.001 0.001" mass="0.0005648524944810105" friction="1"'
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep=".002" solver="PGS" iterations="2" ls_iterations="20"/><worldbody>
        <site name="tip" quat="1 -1 0 0"/><body pos="{pos}" quat="{quat}"><freejoint/>
        <geom type="box" {size}/></body></worldbody></mujoco>"""
    )
    handle = biotac_mj.attach(spec, site="tip", skin="coarse", tier="condensed")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:3] = 0.05090855631646283, 0.06373690489265631, -1.0532299787241806
    data.qvel[3:] = -4.635074836465481, -1.4488462798084354, -5.557408818114601
    mujoco.mj_forward(model, data)
    start = before = kinetic(model, data)
    touched = 0
    for _ in range(12):
        mujoco.mj_step(model, data)
        after = kinetic(model, data)
        if np.linalg.norm(handle.read(data, "contact_force")[:3]) > 1e-3:  # the skin gives back what it took
            assert after < 1.1 * max(start, before)
            touched += 1
        before = after  # in flight MuJoCo's Euler itself may gain: the stick spins at up to 450 rad/s
    assert touched >= 2


def thin_plate(number):
    """A plate thrown at the finger under PGS, begun number * 0.1 nm higher: its largest energy, without what
    falling gives it, over that at the start, steps that push, and its height and speed at the end."""
    pos = " ".join(map(repr, [-0.00716, -0.00117, 0.02765 + 1e-10 * number]))
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep=".003" solver="PGS" iterations="3"/><worldbody>
        <site name="tip" quat="1 -1 0 0"/>
        <body pos="{pos}" quat="-0.25046 -0.85244 0.41404 0.19798"><freejoint/>
        <geom type="box" size="0.00875 0.0119 0.00126" mass="0.00076" friction="0.2"/></body>
        </worldbody></mujoco>"""
    )
    handle = biotac_mj.attach(spec, site="tip", skin="coarse", tier="full")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:3] = 0.074, 0.1209, -1.9015
    mujoco.mj_forward(model, data)
    start, height, most, pushed = kinetic(model, data), data.qpos[2], 0.0, 0
    for _ in range(6):
        mujoco.mj_step(model, data)
        pushed += np.linalg.norm(handle.read(data, "contact_force")[:3]) > 0.05
        fallen = 0.00076 * 9.81 * (height - data.qpos[2])
        most = max(most, kinetic(model, data) - fallen)
    return most / start, pushed, data.qpos[2], data.qvel[2]


@pytest.mark.slow  # quick: a light stick and PGS
def test_thin_plates_stay_out_of_the_core_with_open_pgs_rows():
    """0.8 g at 1.9 m/s, 6 mm a step: what PGS made of the rows led a round to where nothing touches, and the
    plate went through the skin without a force. Its solves are cut off, and where one ends hangs on 1e-10 m
    of the plate's place, with MuJoCo's Newton solver as well: none of five gains energy, and the median of
    the rest."""
    plates = np.array([thin_plate(number) for number in range(5)])
    assert plates[:, 0].max() < 1.05
    pushes, height, speed = np.median(plates[:, 1:], axis=0)
    assert pushes >= 2 and height > 6.5e-3 and speed > -0.3


@pytest.mark.parametrize("mass", [0.01, 0.1])
def test_a_ball_that_comes_to_rest_takes_few_iterations(mass):
    """Newton's first step goes from the last balance. From forces alone, which pose the ball, it took twice
    as many."""
    ball = f'<body name="ball" pos="0 0 .024"><freejoint/><geom size=".015" mass="{mass}"/></body>'
    model, data, handle = finger_under(
        ball, 0.002, gravity="0 0 -9.81", skin="coarse", tier="condensed", options={"loss": 2.0}
    )
    iterations = []
    for _ in range(100):
        mujoco.mj_step(model, data)
        if handle.read(data, "contact_force").any():
            iterations.append(handle.read(data, "status")[2])
    assert handle.read(data, "status")[1] == 0 and len(iterations) > 50
    assert np.mean(iterations) < 3


@pytest.mark.law
@pytest.mark.parametrize(
    "mass, speed, tier",
    [
        *((*case, "condensed") for case in BESIDE),
        *(pytest.param(*case, "full", marks=pytest.mark.slow) for case in BESIDE),
    ],
)
def test_a_light_box_gains_nothing_beside_a_press(mass, speed, tier):
    """What a fixed ball that presses has put into the skin is not for a box that hits beside it."""
    model, data, _ = finger_under(BESIDE_A_PRESS.format(mass=mass), 0.004, skin="coarse", tier=tier)
    data.qvel[2] = -speed
    mujoco.mj_forward(model, data)
    start, most = kinetic(model, data), 0.0
    for _ in range(14):
        mujoco.mj_step(model, data)
        most = max(most, kinetic(model, data))
    assert kinetic(model, data) < 0.9 * start and most < 1.01 * start


def test_a_box_that_sank_beside_a_press_comes_up_with_it():
    """Nothing of its push is withheld: what it did while it sank is in the skin."""
    box = '<body name="box" pos="-.007 0 .0118"><joint type="slide" axis="0 0 1" damping="1"/>'
    box += '<geom type="box" size=".003 .004 .003" mass=".02"/></body>'
    model, data, handle = finger_under(
        '<body name="ball" mocap="true" pos=".003 0 .0146"><geom size=".006"/></body>' + box,
        0.002, gravity="0 0 -9.81", skin="coarse", tier="condensed",
    )  # fmt: skip
    mujoco.mj_step(model, data, 120)
    height, withheld = [], 0.0
    for speed in [-0.03] * 20 + [0.03] * 20 + [0.0] * 80:
        data.mocap_pos[0, 2] += speed * model.opt.timestep
        mujoco.mj_step(model, data)
        height.append(data.qpos[0])
        withheld = max(withheld, handle.read(data, "status")[7])
    assert withheld == 0.0
    assert min(height) < height[0] - 1e-4 and height[-1] == pytest.approx(height[0], abs=2e-6)


@pytest.mark.parametrize(
    "half, mass, timestep, pos, quat, velocity",
    [
        ((4e-3, 4.4e-3, 2.1e-3), 0.0042, 0.001, (-0.0098, 0.0001), (0.27, -0.03, 0.36, -0.89),
         (0.08, -0.02, -1.12, -1.9, 2.32, 4.12)),
        pytest.param((3.4e-3, 4.8e-3, 5.4e-3), 0.0514, 0.004, (-0.0075, -0.0026), (0.02, 0.35, 0.71, -0.61),
                     (0.03, 0.19, -0.7, -3.43, 3.43, -15.36), marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_a_box_that_leaves_is_not_pulled(half, mass, timestep, pos, quat, velocity):
    """In the full tier, where solves of steps on its edges and corners are cut off: what acts then is the
    contact law at the best iterate, and the law pushes."""
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{timestep}" gravity="0 0 0"/><worldbody>'
        '<site name="mount" quat="1 -1 0 0"/>'
        f'<body name="box" pos="{pos[0]} {pos[1]} .0235" quat="{" ".join(map(str, quat))}"><freejoint/>'
        f'<geom type="box" size="{" ".join(map(str, half))}" mass="{mass}"/></body></worldbody></mujoco>'
    )
    handle = biotac_mj.attach(spec, site="mount", tier="full", skin="coarse", readings="none")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:] = velocity
    push, settled = [], []
    while len(push) < 60 and not (push and push[-1] == 0 and max(push) > 0):
        mujoco.mj_step(model, data)
        push.append(handle.read(data, "contact_force")[1])
        settled.append(handle.read(data, "status")[0])
    assert max(push) > 1 and data.qvel[2] > 0.1 * abs(velocity[2])
    assert min(push) > -1e-3 * max(push)
    assert not all(settled)
