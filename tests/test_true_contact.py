"""What MuJoCo itself measures of a skin, and what else may touch a BioTac: in `mj_step`, in a batch, in both
tiers."""

import mujoco
import numpy as np
import pytest
import trimesh
import warp as wp
from grids import first

import biotac_mj
from biotac_mj.geometry import load_skin

WEIGHT = 0.1 * 9.81
# a ball of 100 g on the pad of a finger on a wrist on a spring; the world's z axis is the BioTac's -y
WRIST = """<mujoco><option timestep=".002" integrator="{integrator}" cone="{cone}"/><worldbody>
<body name="arm"><joint type="slide" axis="0 0 1" stiffness="2e4" damping="100"/>
<inertial mass=".2" pos="0 0 -.02" diaginertia="1e-4 1e-4 1e-4"/>
<body name="wrist"><inertial mass=".01" pos="0 0 0" diaginertia="1e-6 1e-6 1e-6"/>
<site name="wrist"/><site name="mount" quat="1 -1 0 0"/><site name="around" size=".04"/>
<site name="far" pos="0 0 .1"/>
</body></body>
<body name="ball" pos="-.009 0 .0134"><joint type="slide" axis="0 0 1" damping="4"/>
<geom name="ball" size=".005" mass=".1"/><site name="ball" size=".006"/></body></worldbody>
<sensor><force name="force" site="wrist"/><torque name="torque" site="wrist"/>
<touch name="finger" site="around"/><touch name="ball" site="ball"/><touch name="far" site="far"/>
<force name="cut" site="wrist" cutoff=".5"/>
<touch name="touch_cut" site="ball" cutoff=".7"/><force name="late" site="wrist" delay=".004" nsample="3"/>
</sensor></mujoco>"""


def on_the_wrist(tier, integrator="implicitfast", cone="pyramidal", steps=120, **settings):
    """Model, data and Handle of the ball at rest."""
    spec = mujoco.MjSpec.from_string(WRIST.format(integrator=integrator, cone=cone))
    handle = biotac_mj.attach(spec, site="mount", tier=tier, skin="coarse", readings=False, **settings)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, steps)
    return model, data, handle


def own_weight(model):
    """Of the wrist and the BioTac fixed to it [N]."""
    return 9.81 * (model.body("wrist").mass[0] + model.body("biotac_core").mass[0])


@pytest.mark.parametrize(
    ("tier", "integrator", "cone"),
    [
        ("condensed", "implicitfast", "pyramidal"),
        ("condensed", "RK4", "elliptic"),
        ("full", "Euler", "elliptic"),
    ],
)
def test_sensors_of_mujoco_feel_the_skin(tier, integrator, cone):
    model, data, handle = on_the_wrist(tier, integrator, cone, 200 if tier == "condensed" else 120)

    def read(name):
        return data.sensor(name).data.copy()

    force, torque = read("force"), read("torque")
    assert force[2] - own_weight(model) == pytest.approx(WEIGHT, rel=1e-3)
    # the weight 9 mm beside the wrist, and the friction that the ball's guide takes
    assert 1e3 * torque[1] == pytest.approx(9e3 * 1e-3 * WEIGHT, rel=0.03)
    np.testing.assert_allclose(read("late"), force, atol=1e-4)
    for name in ("finger", "ball"):
        assert read(name)[0] == pytest.approx(WEIGHT, rel=1e-2)
    assert read("far")[0] == 0.0
    np.testing.assert_array_equal(read("cut"), np.clip(force, -0.5, 0.5))
    assert read("touch_cut")[0] == 0.7
    assert not data.xfrc_applied.any()
    # the same bodies with forces of opposite sense, and Newton's second law down the chain
    core, ball = (data.cfrc_ext[model.body(name).id] for name in ("biotac_core", "ball"))
    assert ball[5] == pytest.approx(WEIGHT, rel=1e-3)
    np.testing.assert_allclose(core[3:], -ball[3:], atol=1e-12)
    frame = data.body("biotac_core").xmat.reshape(3, 3)
    np.testing.assert_allclose(frame @ handle.read(data, "contact_force")[:3], core[3:], atol=1e-6)
    inside = data.cfrc_int[[model.body(name).id for name in ("biotac_core", "wrist", "arm")], 5]
    masses = [model.body_subtreemass[model.body(name).id] for name in ("biotac_core", "wrist", "arm")]
    np.testing.assert_allclose(inside, WEIGHT + 9.81 * np.array(masses), rtol=1e-3)


def test_a_body_that_moves_obeys_newton():
    """In every step of an impact: what cfrc_int says of a free body is nothing."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".002" gravity="0 0 0"/><worldbody><body name="hand"><freejoint/>'
        '<inertial mass=".05" pos="0 0 0" diaginertia="1e-5 1e-5 1e-5"/>'
        '<site name="mount" quat="1 -1 0 0"/></body>'
        '<body name="ball" pos="-.009 .001 .0145"><freejoint/><geom size=".005" mass=".02"/></body>'
        "</worldbody></mujoco>"
    )
    biotac_mj.attach(spec, site="mount", tier="condensed", skin="coarse", readings=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[6:12] = [0.05, 0.0, -0.3, 3.0, -2.0, 5.0]
    most = 0.0
    for _ in range(20):
        mujoco.mj_step(model, data)
        ext, free = data.cfrc_ext, data.cfrc_int[[model.body("hand").id, model.body("ball").id]]
        most = max(most, np.abs(ext[:, 3:]).max())
        np.testing.assert_allclose(free[:, 3:], 0, atol=1e-6 * max(most, 1.0))
        np.testing.assert_allclose(free[:, :3], 0, atol=1e-8 * max(most, 1.0))
    assert most > 0.5


@pytest.mark.law
def test_nothing_is_counted_twice_or_left_behind():
    model, data, _ = on_the_wrist("condensed")
    mujoco.mj_forward(model, data)
    first = data.sensordata.copy(), data.cfrc_ext.copy()
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.sensordata, first[0], atol=1e-9)
    np.testing.assert_allclose(data.cfrc_ext, first[1], atol=1e-9)
    copy = mujoco.MjData(model)
    mujoco.mj_copyData(copy, model, data)
    mujoco.mj_step1(model, copy)
    mujoco.mj_step2(model, copy)
    assert copy.sensor("force").data[2] == pytest.approx(first[0][model.sensor("force").adr[0] + 2], rel=1e-3)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    data.sensordata[:] = 7.0
    mujoco.mj_step(model, data, 2)
    assert (data.sensordata == 7.0).all()
    one_way, resting, _ = on_the_wrist("condensed", coupling="one-way", steps=5)
    assert np.isfinite(resting.sensordata).all() and one_way.nsensor == model.nsensor


@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
def test_a_batch_measures_what_mujoco_does(tier):
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    from biotac_mj import batch

    spec = mujoco.MjSpec.from_string(WRIST.format(integrator="implicitfast", cone="pyramidal"))
    batch.add(spec, site="mount", skin="coarse")
    mjm = spec.compile()
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        m, d = mjw.put_model(mjm), mjw.make_data(mjm, nworld=2)
        mjw.reset_data(m, d)
        batch.attach(mjm, m, d, tier=tier, skin="coarse", readings=False)
        for _ in range(120):
            mjw.step(m, d)
        data, external = d.sensordata.numpy(), d.cfrc_ext.numpy()
        assert not d.xfrc_applied.numpy().any()
    for world in range(2):
        read = {
            name: data[world][mjm.sensor(name).adr[0] :]
            for name in ("force", "torque", "finger", "ball", "far")
        }
        assert read["force"][2] - own_weight(mjm) == pytest.approx(WEIGHT, rel=5e-3)
        assert 1e3 * read["torque"][1] == pytest.approx(9e3 * 1e-3 * WEIGHT, rel=0.03)
        assert read["finger"][0] == pytest.approx(WEIGHT, rel=1e-2)
        assert read["ball"][0] == pytest.approx(WEIGHT, rel=1e-2)
        assert read["far"][0] == 0.0
        core, ball = (external[world, mjm.body(name).id, 3:] for name in ("biotac_core", "ball"))
        assert ball[2] == pytest.approx(WEIGHT, rel=5e-3)
        np.testing.assert_allclose(core, -ball, atol=1e-5)
        assert data[world][mjm.sensor("touch_cut").adr[0]] == pytest.approx(0.7)


def test_in_dm_control_a_wrist_feels_the_ball():
    composer = pytest.importorskip(
        "dm_control.composer", reason="needs dm_control: pip install biotac_mj[tasks]"
    )
    from dm_control import mjcf

    from biotac_mj.tasks import BioTac

    arena = composer.Arena()
    root = arena.mjcf_model
    root.option.timestep = 0.002
    wrist = root.worldbody.add("body", name="wrist")
    wrist.add("inertial", mass=0.01, pos=[0, 0, 0], diaginertia=[1e-6] * 3)
    force = root.sensor.add("force", name="force", site=wrist.add("site", name="wrist"))
    ball = root.worldbody.add("body", name="ball", pos=[-0.009, 0, 0.0134])
    ball.add("joint", type="slide", axis=[0, 0, 1], damping=6)
    ball.add("geom", name="ball", size=[0.005], mass=0.1)
    arena.attach(BioTac(), wrist.add("site", name="mount", quat=[1, -1, 0, 0]))
    physics = mjcf.Physics.from_mjcf_model(root)
    physics.step(150)
    masses = physics.named.model.body_mass
    own = 9.81 * (masses["wrist"] + masses["biotac/core"])
    assert physics.bind(force).sensordata[2] - own == pytest.approx(WEIGHT, rel=5e-3)


CLOTH = """<mujoco><option timestep=".002" integrator="Euler"/><worldbody><site name="mount" quat="1 -1 0 0"/>
<geom name="plate" type="box" size=".01 .01 .001" pos="0 0 .1"/>
<flexcomp name="cloth" type="grid" count="4 4 1" spacing=".004 .004 .004" pos="-.009 0 .0105" dim="2"
radius=".0005" mass=".05"><contact contype="{mask}" conaffinity="{mask}" selfcollide="none"/>
<edge equality="true"/></flexcomp>
</worldbody></mujoco>"""


def test_a_flex_that_would_pass_through_the_skin_is_refused():
    from biotac_mj import batch

    said = "flex 'cloth' collides with the BioTac, whose skin meets rigid geoms alone"
    for add in (biotac_mj.attach, batch.add):
        with pytest.raises(ValueError, match=said):
            add(mujoco.MjSpec.from_string(CLOTH.format(mask=1)), site="mount", skin="coarse")
    for mask, geoms in ((0, None), (2, None), (1, ["plate"])):
        spec = mujoco.MjSpec.from_string(CLOTH.format(mask=mask))
        biotac_mj.attach(spec, site="mount", skin="coarse", readings=False, geoms=geoms)
        mujoco.mj_step(model := spec.compile(), mujoco.MjData(model))
    spec = mujoco.MjSpec.from_string('<mujoco><worldbody><site name="mount"/></worldbody></mujoco>')
    biotac_mj.attach(spec, site="mount", skin="coarse", readings=False)
    spec.attach(
        mujoco.MjSpec.from_string(CLOTH.format(mask=1)), frame=spec.worldbody.add_frame(), prefix="later_"
    )
    said = "flex 'later_cloth' collides"
    with pytest.warns(RuntimeWarning, match=said), pytest.raises(ValueError, match=said):
        with biotac_mj.plugin.explained():
            spec.compile()


EVERYTHING = "found force torque dist pos normal tangent"
CONTACTS = f"""<mujoco><option timestep=".002" integrator="implicitfast" cone="{{cone}}"/><worldbody>
<body name="arm"><joint type="slide" axis="0 0 1" stiffness="2e4" damping="100"/>
<inertial mass=".2" pos="0 0 -.02" diaginertia="1e-4 1e-4 1e-4"/>
<site name="mount" quat="1 -1 0 0"/><site name="zone" size=".03"/>
<site name="far" pos="0 0 .1" size=".03"/></body>
<body name="plate" pos="-.009 0 .0134"><joint type="slide" axis="0 0 1" damping="4"/>
<geom name="left" size=".005" pos="-.003 0 0" mass=".05" margin=".002"/>
<geom name="right" size=".005" pos=".003 0 0" mass=".05" gap=".003"/>
<geom name="clear" size=".005" pos="0 0 .1" mass="1e-6"/></body>
</worldbody><sensor>
<contact name="left" geom1="left" data="{EVERYTHING}"/>
<contact name="right" geom2="right" data="{EVERYTHING}"/>
<contact name="net" site="zone" reduce="netforce" data="{EVERYTHING}"/>
<contact name="ordered" subtree1="arm" body2="plate" num="3" reduce="maxforce" data="force normal"/>
<contact name="clear" geom1="clear"/><contact name="far" site="far"/><force site="zone"/></sensor></mujoco>"""


def check_contacts(read, external):
    """What `<contact>` sensors read of two balls on one body, 100 g, that lie on a skin; external: the
    cfrc_ext (6,) of that body."""
    both = [
        dict(zip(("found", "force", "torque", "dist", "pos", "normal", "tangent"), part))
        for part in (np.split(read(name), [1, 4, 7, 8, 11, 14]) for name in ("left", "right"))
    ]
    total = np.zeros(3)
    for one, sign in zip(both, (-1.0, 1.0)):
        assert one["found"][0] == 1 and one["dist"][0] == 0.0
        # a normal points from the sensor's first object to its second: here out of the ball, and into it
        assert sign * one["normal"][2] > 0.9
        frame = np.stack([one["normal"], one["tangent"], np.cross(one["normal"], one["tangent"])])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-6)
        total += sign * one["force"] @ frame
        assert one["force"][0] > 0.2
    assert both[0]["pos"][0] < both[1]["pos"][0] - 0.004
    np.testing.assert_allclose(total, external[3:], atol=1e-5)
    assert total[2] == pytest.approx(WEIGHT, rel=5e-3)
    net = read("net")
    assert net[0] == 2
    np.testing.assert_allclose(np.abs(net[1:4]), np.abs(total), atol=1e-5)
    ordered = read("ordered").reshape(3, 6)
    assert ordered[0, 0] >= ordered[1, 0] > 0.2 and not ordered[2].any()
    assert (ordered[:2, 5] > 0.9).all()  # from arm to plate
    assert read("clear")[0] == read("far")[0] == 0


@pytest.mark.law
@pytest.mark.parametrize(
    ("tier", "cone"),
    [("condensed", "pyramidal"), pytest.param("full", "elliptic", marks=pytest.mark.slow)],  # quick: above
)
def test_contact_sensors_feel_the_skin(tier, cone):
    spec = mujoco.MjSpec.from_string(CONTACTS.format(cone=cone))
    biotac_mj.attach(spec, site="mount", tier=tier, skin="coarse", readings=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 150)
    assert data.ncon == 0  # as MuJoCo leaves them
    check_contacts(lambda name: data.sensor(name).data, data.cfrc_ext[model.body("plate").id])


@pytest.mark.law
@pytest.mark.parametrize("cone", first(["elliptic", "pyramidal"]))
def test_in_a_batch_contact_sensors_feel_the_skin(cone):
    d, _ = batch_of(CONTACTS.format(cone=cone), 150)
    model = mujoco.MjModel.from_xml_string(CONTACTS.format(cone=cone))  # sensors that come first
    for data, external in zip(d.sensordata.numpy(), d.cfrc_ext.numpy()):
        read = {
            model.sensor(i).name: data[model.sensor_adr[i] :][: model.sensor_dim[i]]
            for i in range(model.nsensor)
        }
        check_contacts(read.get, external[-1])  # the plate's


def on_a_static_link(turn=-1, height=0.0134):
    """MJCF of a ball that comes to rest on a BioTac whose link, and the stand below it, do not move: on its
    pad, or with turn 1 on its nail."""
    link = f'<body name="stand"><body name="link"><site name="mount" quat="1 {turn} 0 0"/>'
    link += '<site name="around" size=".04"/></body><site name="below" size=".04"/></body>'
    link += '<site name="world" size=".04"/>'
    beside = '<body name="beside"><site name="beside" size=".04"/></body>'
    ball = f'<body pos="-.009 0 {height}"><joint type="slide" axis="0 0 1" damping="4"/>'
    ball += '<geom size=".005" mass=".1"/>'
    touch = "".join(
        f'<touch name="{name}" site="{name}"/>' for name in ("around", "below", "world", "beside")
    )
    return (
        f'<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>{link}{beside}{ball}</body>'
        f"</worldbody><sensor>{touch}</sensor></mujoco>"
    )


ON_A_LINK = pytest.mark.parametrize("place", [(-1, 0.0134), (1, 0.025)], ids=["pad", "nail"])


@ON_A_LINK
def test_touch_at_a_static_link_feels_its_biotac(place):
    spec = mujoco.MjSpec.from_string(on_a_static_link(*place))
    biotac_mj.attach(spec, site="mount", tier="condensed", skin="coarse", readings=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 200)
    for name, expected in (("around", WEIGHT), ("below", WEIGHT), ("world", WEIGHT), ("beside", 0.0)):
        assert data.sensor(name).data[0] == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("place", first([(-1, 0.0134), (1, 0.025)]), ids=["pad", "nail"])
def test_in_a_batch_touch_at_a_static_link_feels_its_biotac(place):
    d, _ = batch_of(on_a_static_link(*place), 200)
    read = d.sensordata.numpy()[:, :4]  # before those of the BioTac
    np.testing.assert_allclose(read, np.tile([WEIGHT, WEIGHT, WEIGHT, 0.0], (2, 1)), rtol=1e-2)


def mesh_asset(name, vert, face):
    """MJCF of a mesh."""
    numbers = (" ".join(map(str, np.ravel(a).tolist())) for a in (np.round(vert, 6), face))
    return '<mesh name="{}" vertex="{}" face="{}"/>'.format(name, *numbers)


def cup_and_ring():
    """MJCF of a cup of 16 mm inner radius, and of a ring of 9 mm inner radius: one closed mesh each."""
    cup = trimesh.creation.revolve(
        [[0, 0], [0.02, 0], [0.02, 0.05], [0.016, 0.05], [0.016, 0.006], [0, 0.006]]
    )
    ring = trimesh.creation.torus(0.0112, 0.0022, 32, 12)
    return "".join(mesh_asset(name, m.vertices, m.faces) for name, m in (("cup", cup), ("ring", ring)))


@pytest.mark.parametrize("tier", ["condensed", "full"])
def test_the_nail_alone_meets_what_lies_on_it(tier):
    """Where all its nodes are fixed the skin's surface is the nail's, which MuJoCo's contact holds; the skin
    gives way to nothing there, and half a millimetre deep it pushed with kilonewtons, too."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><site name="mount" quat="1 1 0 0"/><body mocap="true"><geom size=".002"/></body>'
        "</worldbody></mujoco>"
    )
    handle = biotac_mj.attach(spec, site="mount", tier=tier, skin="coarse", readings=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    skin = load_skin("coarse")
    # in the nail, half a millimetre below the skin that is fixed to it; no contact of MuJoCo: neither moves
    data.mocap_pos[0] = -0.0107, 0, skin.nail_vert[:, 1].min() + 0.0015
    mujoco.mj_step(model, data)
    assert handle.read(data, "status")[0] == 1 and not handle.read(data, "contact_force").any()


# the finger points down into the cup and through the ring; then, nail up, both rest on it
AROUND = """<mujoco><option timestep=".002" gravity="0 0 0"/><asset>{assets}</asset><worldbody>
<site name="mount" pos="0 0 .045" xyaxes="0 0 1 1 0 0"/><body name="cup"><freejoint/>
<geom type="mesh" mesh="cup" mass=".1"/></body><body name="ring" pos="0 0 .039"><freejoint/>
<geom type="mesh" mesh="ring" mass=".02"/></body></worldbody>
<contact><exclude body1="cup" body2="ring"/></contact></mujoco>"""
ON_THE_NAIL = """<mujoco><option timestep=".002"/><asset>{assets}</asset><worldbody>
<site name="mount" quat="1 1 0 0"/><body name="cup" pos="-.006 0 .0136" quat="0 1 0 0"><freejoint/>
<geom type="mesh" mesh="cup" mass=".1" friction="1 .05 .001"/></body></worldbody></mujoco>"""


def force_of_what_surrounds(tier):
    """The largest component in ten steps [N] on a finger in a cup and through a ring that touch nothing."""
    spec = mujoco.MjSpec.from_string(AROUND.format(assets=cup_and_ring()))
    handle = biotac_mj.attach(spec, site="mount", tier=tier, skin="coarse", readings=False)
    model = spec.compile()
    data, most = mujoco.MjData(model), 0.0
    for _ in range(10):
        mujoco.mj_step(model, data)
        most = max(most, np.abs(handle.read(data, "contact_force")).max())
        assert data.ncon == 0
    assert not data.qvel.any()
    return most


@pytest.mark.parametrize("tier", ["condensed", "full"])
def test_what_surrounds_a_finger_touches_nothing(tier):
    assert force_of_what_surrounds(tier) == 0


def test_a_trough_around_the_finger_touches_nothing():
    """Its walls are nearer than the law of edges reaches: it does not begin in the skin."""
    u = [(-11, -9.5), (-11, 9.5), (9, 9.5), (9, 7.5), (-9, 7.5), (-9, -7.5), (9, -7.5), (9, -9.5)]
    vert = [[x, y, z] for x in (-4, 4) for y, z in u]
    cap = [[0, 5, 6], [0, 6, 7], [0, 4, 5], [0, 1, 4], [1, 3, 4], [1, 2, 3]]
    sides = [[i, (i + 1) % 8, (i + 1) % 8 + 8] for i in range(8)]
    sides += [[i, (i + 1) % 8 + 8, i + 8] for i in range(8)]
    trough = trimesh.Trimesh(np.array(vert) * 1e-3, [*cap, *([8 + i for i in f[::-1]] for f in cap), *sides])
    trough.fix_normals()
    assert trough.is_watertight
    spec = mujoco.MjSpec.from_string(
        '<mujoco><asset>{}</asset><worldbody><site name="mount"/><body pos="-.01 .0002 0" mocap="true">'
        '<geom type="mesh" mesh="u"/></body></worldbody></mujoco>'.format(
            mesh_asset("u", trough.vertices, trough.faces)
        )
    )
    handle = biotac_mj.attach(spec, site="mount", tier="condensed", skin="coarse", readings=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2)
    assert handle.read(data, "status")[0] == 1 and not handle.read(data, "contact_force").any()


def test_a_cup_hangs_on_the_nail():
    """By its bottom, of which MuJoCo knows the hull alone."""
    spec = mujoco.MjSpec.from_string(ON_THE_NAIL.format(assets=cup_and_ring()))
    handle = biotac_mj.attach(spec, site="mount", tier="condensed", skin="coarse", readings=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 150)
    up = data.body("biotac_core").xmat.reshape(3, 3).T @ [0, 0, 1]
    assert handle.read(data, "contact_force")[:3] @ up == pytest.approx(-WEIGHT, rel=0.03)
    assert 0 < data.ncon and all(-5e-5 < contact.dist < 0 for contact in data.contact)
    assert np.abs(data.qvel).max() < 0.5


def change_of_electrodes(tier, margin):
    """Counts of a ball with this margin [m] that has come to rest on the pad, less those before."""
    spec = mujoco.MjSpec.from_string(WRIST.format(integrator="implicitfast", cone="pyramidal"))
    spec.geom("ball").margin = margin
    handle = biotac_mj.attach(spec, site="mount", tier=tier, skin="coarse", readings={"noise": False})
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rest = handle.read(data, "electrodes")
    mujoco.mj_step(model, data, 40)
    return handle.read(data, "electrodes") - rest


@pytest.mark.law
@pytest.mark.parametrize("tier", ["condensed", "full"])
def test_a_margin_moves_no_load(tier):
    plain, wide = (change_of_electrodes(tier, margin) for margin in (0.0, 0.002))
    assert plain[16] < -500
    np.testing.assert_allclose(wide, plain, atol=0.02 * np.abs(plain).max())


def batch_of(xml, steps, margin=0.0, **settings):
    """The Data after some steps of two worlds, and their contact_force (2, 3)."""
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    from biotac_mj import batch

    spec = mujoco.MjSpec.from_string(xml)
    for geom in spec.geoms:
        geom.margin = margin
    batch.add(spec, site="mount", skin="coarse")
    mjm = spec.compile()
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        m, d = mjw.put_model(mjm), mjw.make_data(mjm, nworld=2)
        mjw.reset_data(m, d)
        batch.attach(mjm, m, d, tier="condensed", skin="coarse", readings=False, **settings)
        for _ in range(steps):
            mjw.step(m, d)
    return d, d.sensordata.numpy()[:, mjm.sensor("biotac_contact_force").adr[0] :][:, :3]


def test_in_a_batch_what_surrounds_touches_nothing():
    d, force = batch_of(AROUND.format(assets=cup_and_ring()), 5)
    assert not force.any() and not d.qvel.numpy().any()


@pytest.mark.slow
def test_in_a_batch_a_cup_hangs_on_the_nail():
    d, force = batch_of(ON_THE_NAIL.format(assets=cup_and_ring()), 150)
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), WEIGHT, rtol=0.03)
    assert np.abs(d.qvel.numpy()).max() < 0.5


@pytest.mark.law
def test_in_a_batch_a_margin_moves_no_load():
    xml = WRIST.format(integrator="implicitfast", cone="pyramidal")
    plain, wide = (batch_of(xml, 40, margin) for margin in (0.0, 0.002))
    assert np.linalg.norm(plain[1], axis=1).min() > 0.5
    np.testing.assert_allclose(wide[1], plain[1], atol=1e-4)
    np.testing.assert_allclose(wide[0].qpos.numpy(), plain[0].qpos.numpy(), atol=1e-7)


SLICK = on_a_static_link(1, 0.025).replace('mass=".1"', 'mass=".1" friction="0"')


def test_contact_without_friction_is_as_soft_as_condim_1():
    """Edges of a pyramid of MuJoCo's least friction are harder by billions."""
    ends = []
    for dim in (3, 1):
        spec = mujoco.MjSpec.from_string(SLICK)
        biotac_mj.attach(spec, site="mount", tier="condensed", skin="coarse", friction=0.0, readings=False)
        model = spec.compile()
        model.geom_condim[:] = dim
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 200)
        assert 0 < data.ncon == data.nefc - data.ne
        ends.append(data.qpos[0])
    assert ends[0] == ends[1]


def test_in_a_batch_contact_without_friction_has_one_row():
    d, force = batch_of(SLICK, 200, friction=0.0)
    count = int(d.nacon.numpy()[0])
    assert count >= 2 and (d.contact.dim.numpy()[:count] == 1).all()
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), WEIGHT, rtol=0.01)


APEX = """<mujoco><option timestep=".002"/><asset>{asset}</asset><worldbody>
<site name="mount" quat="1 -1 0 0"/>
<body name="cone" pos="-.0095 0 {height}"><joint type="slide" axis="0 0 1" damping="10"/>
<geom type="mesh" mesh="cone" mass=".1"/></body></worldbody></mujoco>"""


def apex_spec(height):
    """A cone of 100 g whose apex looks down, at a height [m] before the mesh's frame is MuJoCo's."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = 0.01 * np.stack([np.cos(angle), np.sin(angle), np.full(24, 1.2)], 1)
    number, following = np.arange(2, 26), np.roll(np.arange(2, 26), -1)
    face = [*zip([0] * 24, following, number), *zip([1] * 24, number, following)]
    asset = mesh_asset("cone", np.concatenate([[[0, 0, 0], [0, 0, 0.012]], rim]), face)
    return mujoco.MjSpec.from_string(APEX.format(asset=asset, height=height))


def settled_apex(height, tier, steps=120):
    """Height of the cone [m] and the electrodes' changes at its balance."""
    spec = apex_spec(height)
    handle = biotac_mj.attach(spec, site="mount", tier=tier, skin="coarse", readings={"noise": False})
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, steps)
    assert handle.read(data, "status")[0] == 1
    return height + data.qpos[0], handle.read(data, "electrodes") - handle.numbers.rest


@pytest.mark.parametrize("tier", ["condensed", pytest.param("full", marks=pytest.mark.slow)])
def test_an_apex_inside_the_skin_comes_to_the_same_balance(tier):
    above, counts = settled_apex(0.0088, tier)
    for height in (0.007, 0.0055):
        inside, also = settled_apex(height, tier)
        assert inside == pytest.approx(above, abs=5e-5)
        np.testing.assert_allclose(also, counts, atol=0.05 * np.abs(counts).max())


SHARPER = pytest.mark.xfail(strict=True, reason="E17 falls by 788 counts in the full tier, by 969 condensed")


@pytest.mark.slow
@pytest.mark.parametrize("share", [pytest.param(0.15, marks=SHARPER), 0.25])
def test_tiers_find_one_balance_of_an_apex(share):
    """As far as the condensed tier knows one: an apex presses beyond where its error was measured."""
    (height, counts), (also, others) = (settled_apex(0.0088, tier) for tier in ("condensed", "full"))
    assert also == pytest.approx(height, abs=1e-4)
    np.testing.assert_allclose(others, counts, atol=share * np.abs(counts).max())


@pytest.mark.law
def test_in_a_batch_an_apex_comes_to_the_same_balance():
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    from biotac_mj import batch

    spec = apex_spec(0.0088)
    batch.add(spec, site="mount", skin="coarse")
    mjm = spec.compile()
    with wp.ScopedDevice("cuda:0" if wp.is_cuda_available() else "cpu"):
        m, d = mjw.put_model(mjm), mjw.make_data(mjm, nworld=3)
        mjw.reset_data(m, d)
        d.qpos.assign(np.array([[0.0], [0.007 - 0.0088], [0.0055 - 0.0088]], np.float32))
        batch.attach(mjm, m, d, tier="condensed", skin="coarse", readings=False)
        for _ in range(120):
            mjw.step(m, d)
        height = d.qpos.numpy()[:, 0]
    np.testing.assert_allclose(height, height[0], atol=1e-4)


def test_touch_of_two_skins_that_meet_has_both_halves():
    """Each of the two answers for half of what acts between them; sites on the links feel all of it."""
    link = '<site name="{0}" size=".08"/><site name="m{0}" quat="1 {1} 0 0"/>'
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>'
        f'<body name="a">{link.format("a", -1)}</body>'
        '<body name="b" pos="0 0 .015"><joint type="slide" axis="0 0 1" damping="5"/>'
        f'<inertial mass=".05" pos="0 0 0" diaginertia="1e-5 1e-5 1e-5"/>{link.format("b", 1)}</body>'
        '</worldbody><sensor><touch site="a"/><touch site="b"/></sensor></mujoco>'
    )
    for name in "ab":
        biotac_mj.attach(
            spec, site=f"m{name}", tier="condensed", skin="coarse", readings=False, prefix=f"{name}_"
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 150)
    weight = 9.81 * model.body_subtreemass[model.body("b").id]
    assert data.cfrc_ext[model.body("b_core").id][5] == pytest.approx(weight, rel=2e-3)
    np.testing.assert_allclose(data.sensordata[:2], weight, rtol=1e-2)
