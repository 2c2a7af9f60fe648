"""Scenes as other people make them: hands and grippers with tendons, pairs and sensors over what a BioTac
replaces, meshes that bound no solid, height fields, nested attachments, sleep, disabled flags. Each is
pressed."""

import subprocess
import sys
import warnings

import mujoco
import numpy as np
import pytest
from grids import covering

import biotac_mj
from biotac_mj.tasks.hands import Mount, attach_to_hand

APEX = np.array([-6.2e-3, -8.31e-3, 0])  # the pad's highest point in the BioTac frame [m]
OUT = np.array([1, 0, 0, 0, 0, -1, 0, 1, 0.0])  # rotation there: z leads out of the pad
DEPTH, START, STEPS = 0.8e-3, 0.3e-3, 16
FINGER = {"skin": "coarse", "tier": "condensed", "readings": "none"}
GHOST = 'contype="0" conaffinity="0"'
BALL = '<geom name="{name}" size=".008" pos="0 0 .008" {more}/>'

# eight corners of a box whose top comes at z = 0, in front of the pad
CORNERS = "-.02 -.02 0 .02 -.02 0 -.02 .02 0 .02 .02 0 -.02 -.02 .02 .02 -.02 .02 -.02 .02 .02 .02 .02 .02"
FACES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]]
    + [[2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
)


def mesh(name, face, more=""):
    numbers = " ".join(map(str, np.ravel(face)))
    return f'<mesh name="{name}" inertia="shell" vertex="{CORNERS}" face="{numbers}" {more}/>'


def presser(geoms=None, name="presser"):
    """A mocap body; what lies at z > 0 of it comes to the pad."""
    geoms = BALL.format(name=name, more="") if geoms is None else geoms
    return f'<body name="{name}" mocap="true" pos="0 0 9">{geoms}</body>'


def scene(bodies, asset="", more="", option='integrator="implicitfast" gravity="0 0 0"', flag=""):
    return mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="0.004" {option}>{flag}</option><asset>{asset}</asset>'
        f"<worldbody>{bodies}</worldbody>{more}</mujoco>"
    )


def press(model, handle, name="presser", depth=DEPTH, data=None):
    """Force (3,) [N] on the BioTac with a mocap body pressed into its pad; the mjData."""
    data = mujoco.MjData(model) if data is None else data
    place = model.body(name).mocapid[0]
    for i in range(STEPS):
        mujoco.mj_kinematics(model, data)
        body = data.body(handle.body)
        turn = body.xmat.reshape(3, 3)
        out = turn @ [0, -1, 0]
        data.mocap_pos[place] = body.xpos + turn @ APEX + out * (START - (START + depth) * (i + 1) / STEPS)
        mujoco.mju_mat2Quat(data.mocap_quat[place], (turn @ OUT.reshape(3, 3)).ravel())
        mujoco.mj_step(model, data)
    assert handle.read(data, "status")[0] == 1
    return handle.read(data, "contact_force")[:3], data


def press_each(spec, handles, names=None):
    """Presses each finger in turn: it feels more than 50 mN against its pad, the others nothing."""
    model = spec.compile()
    for finger, handle in handles.items():
        force, data = press(model, handle, *([] if names is None else [names[finger]]))
        assert force[1] > 0.05, finger
        for other, elsewhere in handles.items():
            assert other == finger or not elsewhere.read(data, "contact_force").any()
    return model


@pytest.fixture(autouse=True)
def no_errors():
    yield
    biotac_mj.plugin.check()


# --- meshes, height fields  ---


def finger_and(bodies, asset="", extra="", **settings):
    spec = scene('<body name="finger"/>' + presser(bodies) + extra, asset)
    return spec, biotac_mj.attach(spec, body="finger", **(FINGER | settings))


@pytest.fixture(scope="module")
def force_of_a_box():
    """Of the box whose corners the meshes here have."""
    spec, handle = finger_and('<geom type="box" size=".02 .02 .01" pos="0 0 .01"/>')
    return press(spec.compile(), handle)[0]


INNER = [[0, 1, 7], [0, 7, 6]]  # a wall inside: its edges are passed a third time
ODD_MESHES = {"open": FACES[:-4], "wall inside": [*FACES, *INNER], "two faces": FACES[[0, 6]]}


@pytest.mark.parametrize("name, coupling", covering(ODD_MESHES, ["two-way", "one-way"]))
def test_a_mesh_that_bounds_no_solid_is_met_as_its_hull(name, coupling, force_of_a_box):
    """As MuJoCo's own contacts meet it; said once a model, by the mesh's name."""
    odd = mesh("odd", ODD_MESHES[name])
    spec, handle = finger_and('<geom type="mesh" mesh="odd"/>', odd, coupling=coupling)
    with pytest.warns(UserWarning, match="collision mesh 'odd' is open or does not bound a solid") as notes:
        model = spec.compile()
        force, data = press(model, handle)
        mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, mujoco.MjData(model))
    assert len(notes) == 1
    np.testing.assert_allclose(force, force_of_a_box, rtol=0.02, atol=5e-3)


def test_an_open_mesh_elsewhere_does_no_harm():
    """In the full tier: a body a metre away with an open mesh, and a closed one that presses; no note names
    that."""
    bodies = '<body name="far" pos="1 0 0" mocap="true"><geom type="mesh" mesh="odd"/></body>'
    asset = mesh("odd", FACES[:-1]) + mesh("whole", FACES)
    spec, handle = finger_and('<geom type="mesh" mesh="whole"/>', asset, bodies, tier="full")
    with pytest.warns(UserWarning, match="collision mesh 'odd' is open") as notes:
        force = press(spec.compile(), handle, depth=0.3e-3)[0]
    assert force[1] > 0.05 and len(notes) == 1


def test_hollows_of_a_closed_mesh_are_kept():
    """A ring that is closed keeps its hole: the pad enters it, where the hull would press."""
    from trimesh.creation import annulus

    ring = annulus(r_min=0.012, r_max=0.016, height=0.01)
    vert = " ".join(f"{x:.6f}" for x in (ring.vertices + [0, 0, 0.005]).ravel())
    face = " ".join(map(str, ring.faces.ravel()))
    spec, handle = finger_and(
        '<geom type="mesh" mesh="ring"/>', f'<mesh name="ring" vertex="{vert}" face="{face}"/>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        model = spec.compile()
        force, _ = press(model, handle, depth=0.5e-3)
    disc, other = finger_and('<geom type="cylinder" size=".016 .005" pos="0 0 .005"/>')
    assert force[1] < 0.5 * press(disc.compile(), other, depth=0.5e-3)[0][1]


def test_long_thin_meshes_are_felt(force_of_a_box):
    """Cells of a distance grid are wider than a rod that is a metre long; and it is no tip that is inside the
    core."""
    corner = [f"{x} {y} {z}" for z in (0, 0.004) for y in (-0.002, 0.002) for x in (-0.5, 0.5)]
    asset = f'<mesh name="rod" vertex="{" ".join(corner)}"/>'
    spec, handle = finger_and('<geom type="mesh" mesh="rod"/>', asset)
    force, _ = press(spec.compile(), handle)
    assert 0.3 * force_of_a_box[1] < force[1] < 1.1 * force_of_a_box[1]


def test_a_flat_mesh_alone_is_left_out():
    flat = '<mesh name="flat" inertia="shell" vertex="0 0 0 .01 0 0 0 .01 0" face="0 1 2"/>'
    flat = flat.replace('0 .01 0"', '0 .01 0 .01 .01 0"')
    spec, handle = finger_and(
        BALL.format(name="ball", more="")
        + '<geom name="sheet" type="mesh" mesh="flat" contype="0" conaffinity="0"/>',
        flat,
        geoms=["ball", "sheet"],
    )
    with pytest.warns(UserWarning, match=r"geom 'sheet' \(mesh 'flat'\) is flat .* left out") as notes:
        assert press(spec.compile(), handle)[0][1] > 0.05
    assert len(notes) == 1


def test_a_height_field_is_met_as_ground(force_of_a_box):
    """Turned to look at the pad: flat, it presses like a box; with a bump in its middle, less."""
    turned = '<geom type="hfield" hfield="field" pos="0 0 {}" quat="0 1 0 0"/>'
    heights = np.zeros((5, 7))
    for bump in (0.0, 1.0):
        heights[2, 3] = bump
        asset = (
            f'<hfield name="field" nrow="5" ncol="7" size=".02 .02 .002 .01" '
            f'elevation="{" ".join(map(str, heights.ravel()))}"/>'
        )
        spec, handle = finger_and(turned.format(0.002 * bump), asset)
        force, _ = press(spec.compile(), handle)
        if bump:
            assert 0.02 < force[1] < 0.6 * force_of_a_box[1]
        else:
            np.testing.assert_allclose(force, force_of_a_box, rtol=0.02, atol=5e-3)


def test_ground_is_where_mujocos_rays_meet_it():
    from biotac_mj.geometry.solid import bounds_solid, ground

    rng = np.random.default_rng(0)
    asset = (
        f'<hfield name="field" nrow="4" ncol="6" size="1 2 .5 .1" '
        f'elevation="{" ".join(map(str, rng.uniform(size=24)))}"/>'
    )
    model = scene('<geom type="hfield" hfield="field"/>', asset).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    vert, face = ground(model.hfield_data.reshape(4, 6), model.hfield_size[0])
    assert bounds_solid(vert, face)
    import trimesh

    solid = trimesh.Trimesh(vert, face, process=False)
    for x, y in rng.uniform([-1, -2], [1, 2], (20, 2)):
        down = mujoco.mj_ray(model, data, [x, y, 5], [0, 0, -1], None, 1, -1, np.zeros(1, np.int32))
        inside = solid.contains([[x, y, 5 - down - 1e-6], [x, y, 5 - down + 1e-6]])
        assert list(inside) == [True, False]


@pytest.mark.slow
def test_a_signed_distance_field_is_met_as_its_mesh():
    ring = '<plugin plugin="mujoco.sdf.torus"><instance name="ring">{}</instance></plugin>'.format(
        '<config key="radius1" value="0.01"/><config key="radius2" value="0.004"/>'
    )
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><extension>{ring}</extension>"
        '<asset><mesh name="ring"><plugin instance="ring"/></mesh></asset>'
        '<worldbody><body name="finger"/>'
        + presser('<geom type="sdf" mesh="ring" pos="0 0 .004"><plugin instance="ring"/></geom>')
        + "</worldbody></mujoco>"
    )
    handle = biotac_mj.attach(spec, body="finger", **FINGER)
    assert press(spec.compile(), handle, depth=1.5e-3)[0][1] > 0.05


def test_a_batch_meets_the_hull_too():
    pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    from test_batch import shell

    spec = scene('<body name="finger"/>' + presser('<geom type="mesh" mesh="odd"/>'), mesh("odd", FACES[1:]))
    biotac_mj.batch.add(spec, body="finger", skin=shell(), coupling="one-way")
    model = spec.compile()
    for _ in range(2):  # also where a model that is gone had its place
        with pytest.warns(UserWarning, match="collision mesh 'odd' is open"):
            batch = biotac_mj.batch.make(model, 1, "cpu", skin=shell(), readings=False)
    hull = batch.skin.geoms.struct.grids.value.numpy()
    assert batch.skin.geoms.types == ["mesh"] and hull.min() == pytest.approx(-0.01, abs=1e-3)


# --- hands and grippers  ---

LINK = """<body name="{n}middle" pos="{x} 0 .04">
  <joint name="{n}J2" axis="1 0 0" stiffness="1" damping=".01"/>
  <geom name="{n}mid" type="capsule" size=".006 .01" pos="0 0 .01"/><site name="{n}root" pos="0 -.012 0"/>
  <body name="{n}distal" pos="0 0 .025"><joint name="{n}J1" axis="1 0 0" stiffness="1" damping=".01"/>
    <geom name="{n}tip" type="capsule" size=".008 .01" pos="0 0 .012" material="skin"/>
    <geom name="{n}pulley" type="cylinder" size=".003 .01" quat="1 0 1 0" contype="0" conaffinity="0"/>
    <body><geom name="{n}nail" type="box" size=".002 .002 .004" pos="0 .008 .012"/></body>
    <site name="{n}top" pos="0 -.009 .02" size=".004"/><site name="{n}beside" pos="0 -.02 .01"/>
  </body></body>"""
REFERENCES = """
  <tendon><spatial name="{n}flexor"><site site="{n}root"/><geom geom="{n}pulley" sidesite="{n}beside"/>
      <site site="{n}top"/></spatial>
    <fixed name="{n}both"><joint joint="{n}J2" coef="1"/><joint joint="{n}J1" coef="1"/></fixed></tendon>
  <contact><pair geom1="{n}tip" geom2="{pressed}"/><pair name="{n}p" geom1="palm" geom2="{n}nail"/>
    <exclude body1="{n}distal" body2="palm"/></contact>
  <sensor><tendonpos name="{n}length" tendon="{n}flexor"/><tendonpos name="{n}sum" tendon="{n}both"/>
    <touch name="{n}touch" site="{n}top"/><jointpos name="{n}bent" joint="{n}J1"/>
    <distance name="{n}distance" geom1="{n}tip" geom2="palm" cutoff="1"/>
    <actuatorfrc name="{n}effort" actuator="{n}pull"/>
    <framepos name="{n}place" objtype="geom" objname="{n}tip"/>
  </sensor>
  <actuator><position name="{n}servo" tendon="{n}both" kp=".1"/><motor name="{n}pull" tendon="{n}flexor"/>
    <motor name="{n}last" joint="{n}J1"/>
    <adhesion name="{n}glue" body="{n}distal" ctrlrange="0 1"/></actuator>
  <equality><joint name="{n}coupled" joint1="{n}J1" joint2="{n}J2" active="false"/></equality>
  <keyframe><key ctrl="{zeros}"/></keyframe>"""


def hand(fingers="ab", pair_only=True, unnamed=False):
    """A palm with fingers and what refers to their tips; each has a presser that collides in pairs alone."""
    ghost = GHOST if pair_only else ""
    pressers = "".join(presser(BALL.format(name=f"{n}ball", more=ghost), f"{n}presser") for n in fingers)
    links = "".join(LINK.format(n=n, x=0.04 * i) for i, n in enumerate(fingers))
    if unnamed:
        links += '<body pos="-.03 0 .03"><joint axis="1 0 0"/><geom type="capsule" size=".006 .02"/></body>'
    zeros = " ".join("0" for _ in range(4 * len(fingers)))
    more = "".join(REFERENCES.format(n=n, pressed=f"{n}ball", zeros=zeros) for n in fingers)
    return scene(
        f'{pressers}<body name="palm"><geom name="palm" type="box" size=".05 .01 .03"/>{links}</body>',
        '<material name="skin" rgba=".9 .7 .6 1"/>',
        more,
    )


def tips(fingers="ab", **settings):
    return {n: Mount(f"{n}distal", (0, 0, 0.0107), **settings) for n in fingers}


def pressers(fingers="ab"):
    return {n: f"{n}presser" for n in fingers}


def test_what_refers_to_a_replaced_tip_goes_on():
    """Tendons over it, sensors and actuators of it; it touches nothing, weighs nothing and is not drawn, and
    the skin touches what the tip touched in pairs."""
    spec = hand(unnamed=True)
    before = hand(unnamed=True).compile()
    handles = attach_to_hand(spec, tips(), **FINGER)
    model = press_each(spec, handles, pressers())
    kept = dict(nv=before.nv, nu=before.nu, ntendon=before.ntendon, nkey=before.nkey)
    assert {name: getattr(model, name) for name in kept} == kept
    for i in range(before.nsensor):
        assert model.sensor(before.sensor(i).name).type == before.sensor(i).type
    for name in ("atip", "apulley", "anail"):
        geom = model.geom(name)
        assert not geom.contype[0] and not geom.conaffinity[0] and geom.rgba[3] == 0 and geom.matid[0] == -1
    assert model.npair == 0 and model.geom("amid").contype[0]
    assert model.body("adistal").mass[0] == 0 and model.body("biotac_a_core").mass[0] > 3e-3
    data, other = mujoco.MjData(model), mujoco.MjData(before)
    mujoco.mj_step(model, data)
    mujoco.mj_step(before, other)
    assert data.sensor("alength").data == pytest.approx(other.sensor("alength").data)


def test_there_is_room_for_all_that_collided_in_pairs():
    spec = hand("abcdef")
    attach_to_hand(spec, tips("abcdef"), **FINGER)
    model = spec.compile()
    assert sum(model.equality(i).name.startswith("biotac_a_couple") for i in range(model.neq)) > 7
    assert all(model.geom(f"{n}ball").conaffinity[0] for n in "abcdef")


def test_what_is_not_drawn_is_not_in_the_scene():
    spec = hand("a")
    attach_to_hand(spec, tips("a"), **FINGER)
    model = spec.compile()
    data, shown = mujoco.MjData(model), mujoco.MjvScene(model, 1000)
    mujoco.mj_forward(model, data)
    option = mujoco.MjvOption()
    option.geomgroup[:] = 1
    every = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), every, shown)
    drawn = {
        g.objid for g in shown.geoms[: shown.ngeom] if g.objtype == mujoco.mjtObj.mjOBJ_GEOM and g.rgba[3]
    }
    assert model.geom("atip").id not in drawn and model.geom("amid").id in drawn


def test_only_what_is_named_is_replaced():
    spec = hand("a", pair_only=False)
    handles = attach_to_hand(spec, tips("a", replaces=("tip",), shown=("pulley",)), **FINGER)
    model = press_each(spec, handles, pressers("a"))
    assert model.geom("anail").contype[0] and not model.geom("atip").contype[0] and model.npair == 1
    with pytest.raises(
        ValueError, match=r"link 'adistal' has no geom 'thumb': its geoms are atip, apulley, anail"
    ):
        attach_to_hand(hand("a"), tips("a", replaces=("thumb",)), **FINGER)


@pytest.mark.parametrize(
    "how",
    [pytest.param(dict(hand="shadow_hand_authentic"), marks=pytest.mark.slow), dict(variant="authentic")],
    ids=["name", "variant"],
)
def test_authentic_fingers_lose_their_last_joint(how):
    """By either way of asking; servos and sensors of the coupled joints become those of the joint before."""
    fingers = ("ff", "th")
    spec = hand(fingers)
    handles = attach_to_hand(spec, fingers=fingers, **how, **FINGER)
    model = press_each(spec, handles, pressers(fingers)) if "hand" in how else spec.compile()
    assert model.nv == 2 and model.nkey == 0
    names = {model.sensor(i).name for i in range(model.nsensor)}
    assert {"fflength", "ffsum", "fftouch", "ffdistance", "ffeffort"} <= names and "ffbent" not in names
    assert model.sensor("ffsum").type == mujoco.mjtSensor.mjSENS_JOINTPOS
    assert [model.actuator(i).name for i in range(model.nu)] == [
        f"{n}{kind}" for n in fingers for kind in ("servo", "pull", "glue")
    ]
    origin = model.body("biotac_ff_core").pos
    np.testing.assert_allclose(origin, [0, -5.4e-3, 34.3e-3])


def test_a_hand_that_was_attached_twice():
    """Two hands with prefixes, and BioTacs on both; the whole is then attached to another scene."""
    inner = mujoco.MjSpec()
    for i, side in enumerate(("left_", "right_")):
        frame = inner.worldbody.add_frame(pos=[0.3 * i, 0, 0])
        inner.attach(hand("a"), frame=frame, prefix=side)
    handles = {}
    for side in ("left_", "right_"):
        mount = {side: Mount(f"{side}adistal", (0, 0, 0.0107))}
        handles |= attach_to_hand(inner, mount, prefix="tip_", **FINGER)
    outer = scene('<geom name="floor" type="plane" size="1 1 1" pos="0 0 -1"/>')
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo's, of options that differ
        outer.attach(inner, frame=outer.worldbody.add_frame(pos=[0, 0, 0.5]), prefix="robot_")
        model = outer.compile()
    there_are = biotac_mj.handles(model)
    for side, handle in handles.items():
        there = there_are["robot_" + handle.prefix]
        assert press(model, there, f"robot_{side}apresser")[0][1] > 0.05


GRIPPER = """<body name="base"><geom type="box" size=".02 .05 .01"/>{sides}</body>"""
SIDE = """<body name="{n}_follower" pos="0 {y} .03" quat="{q}">
  <joint name="{n}_driver" type="slide" axis="0 1 0" damping="10" stiffness="100"/>
  <geom type="box" size=".007 .0035 .015" pos="0 .0035 .016" mass=".02"/>
  <body name="{n}_pad"><geom name="{n}_pad1" type="box" size=".011 .004 .009" pos="0 -.0026 .028" mass="0"/>
    <geom name="{n}_pad2" type="box" size=".011 .004 .009" pos="0 -.0026 .0094" mass="0"/>
    <inertial mass=".0035" pos="0 0 .018" diaginertia="1e-6 1e-6 1e-6"/>
    <body name="{n}_silicone_pad"><geom type="box" size=".011 .001 .019" pos="0 -.006 .019" mass="0"/></body>
  </body></body>"""


def test_a_gripper_whose_pads_are_bodies_of_their_own():
    """Pads welded to the links that carry them, with a silicone pad welded to them: none is left in front of
    the skin, and both BioTacs hold a box."""
    sides = SIDE.format(n="right", y=0.05, q="1 0 0 0") + SIDE.format(n="left", y=-0.05, q="0 0 0 1")
    more = """<tendon><fixed name="split"><joint joint="right_driver" coef=".5"/>
      <joint joint="left_driver" coef=".5"/></fixed></tendon>
      <actuator><motor name="close" tendon="split"/></actuator>
      <equality><joint joint1="right_driver" joint2="left_driver"/></equality>"""
    box = (
        '<body name="box" pos="0 0 .052"><freejoint/><geom type="box" size=".01 .012 .01" mass=".02"/></body>'
    )
    spec = scene(GRIPPER.format(sides=sides) + box + presser(), more=more)
    handles = attach_to_hand(spec, "robotiq_2f85", **FINGER)
    model = spec.compile()
    for name in ("left_pad1", "left_pad2"):
        assert model.geom(name).rgba[3] == 0
    data = mujoco.MjData(model)
    for _ in range(150):
        data.ctrl[0] = -6.0
        mujoco.mj_step(model, data)
    force = {n: h.read(data, "contact_force")[:3] for n, h in handles.items()}
    assert force["left"][1] > 0.3 and force["right"][1] == pytest.approx(force["left"][1], rel=0.05)
    assert data.ncon == 0


def test_a_link_that_is_drawn_by_the_mesh_of_its_tip():
    """Of a hand like LEAP the picture of the link goes with its tip, and the link's own boxes are shown. No
    finger begins in the palm, which would push it to one side or the other."""
    links = "".join(
        f'<body name="{f}_ds" pos="{0.05 * (i + 1)} 0 0"><joint axis="0 0 1" stiffness="1" damping=".01"/>'
        + f'<geom name="{f}_ds_visual" type="mesh" mesh="whole" {GHOST} group="1" mass="0"/>'
        + "".join(
            f'<geom name="{f}_ds_collision_{k}" type="box" size=".005 .005 .005" group="3"/>'
            for k in (1, 2, 3)
        )
        + f'<geom name="{f}_tip" type="mesh" mesh="whole" group="3"/></body>'
        for i, f in enumerate(("if", "mf", "rf", "th"))
    )
    spec = scene(f'<body name="palm"><geom size=".01"/>{links}</body>{presser()}', mesh("whole", FACES))
    handles = attach_to_hand(spec, "leap_hand", fingers=("if", "th"), **FINGER)
    model = press_each(spec, handles)
    assert model.geom("if_ds_visual").rgba[3] == 0 and model.geom("mf_ds_visual").rgba[3] == 1
    assert model.geom("if_ds_collision_1").group[0] == 0 and model.geom("if_ds_collision_1").contype[0]


# --- sleep, new bodies, disabled flags  ---

RESTING = """<body name="ball" pos="0 0 .01631" {more}><joint type="slide" axis="0 0 1" damping="1"/>
  <geom size=".008" mass=".02"/></body>"""
WEIGHT = 0.02 * 9.81
SETTLED = 100  # steps, after which nothing of a thousandth of it moves


def resting(flag="", more="", extra="", **settings):
    """A ball that comes to rest on the pad."""
    spec = scene(
        '<body name="finger"/>' + RESTING.format(more=more) + extra,
        option='integrator="implicitfast"',
        flag=flag,
    )
    up = dict(body="finger", quat=[np.sqrt(0.5), -np.sqrt(0.5), 0, 0], pos=[0.0062, 0, 0])
    soon = {} if settings.get("coupling") == "one-way" else {"options": {"loss": 2.0}}  # at rest
    return spec, biotac_mj.attach(spec, **up, **(FINGER | soon | settings))


def weight(data, handle):
    assert handle.read(data, "status")[0] == 1
    return handle.read(data, "contact_force")[1]


@pytest.mark.parametrize(
    "policy", ['sleep="allowed"', *(pytest.param(p, marks=pytest.mark.slow) for p in ("", 'sleep="init"'))]
)
def test_a_resting_body_reads_its_weight_through_sleep(policy):
    """What the skin may carry stays awake; what it cannot touch sleeps as ever."""
    ghost = f'<body pos="1 0 0"><joint type="slide" axis="1 0 0"/><geom size=".01" {GHOST}/></body>'
    spec, handle = resting('<flag sleep="enable"/>', policy, ghost)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, SETTLED)
    for _ in range(20):
        mujoco.mj_step(model, data, 5)
        assert weight(data, handle) == pytest.approx(WEIGHT, rel=1e-3)
    assert data.tree_asleep[0] < 0 <= data.tree_asleep[1]


@pytest.mark.slow
def test_one_way_reads_through_sleep():
    spec, handle = resting('<flag sleep="enable"/>', coupling="one-way")
    spec.body("ball").joints[0].range, spec.body("ball").joints[0].limited = [-0.8e-3, 1], True
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    awake = weight(data, handle)
    mujoco.mj_step(model, data, 400)
    assert data.tree_asleep[0] >= 0 and weight(data, handle) == pytest.approx(awake, rel=1e-2) and awake > 0.1


@pytest.mark.slow
def test_a_body_that_is_added_to_a_running_model():
    spec, handle = resting()
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, SETTLED)
    body = spec.worldbody.add_body(name="new", pos=[0.3, 0, 0])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0])
    model, data = spec.recompile(model, data)
    for _ in range(50):
        mujoco.mj_step(model, data)
        assert handle.read(data, "status")[0] == 1
    assert weight(data, handle) == pytest.approx(WEIGHT, rel=1e-2)


def test_equalities_that_are_all_switched_off():
    """The skin's own rows are no user's constraint: they are there again, within the same step."""
    spec, handle = resting()
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, SETTLED)
    for _ in range(5):
        data.eq_active[:] = 0
        mujoco.mj_step(model, data)
        assert weight(data, handle) == pytest.approx(WEIGHT, rel=1e-4)


@pytest.mark.parametrize("how", [pytest.param("recompiled", marks=pytest.mark.slow), "switched off"])
def test_rows_of_two_sensors_that_are_made_again(how):
    """The second's rows must not be made after the first has found its own: the arena moves."""
    spec, handle = resting(extra='<body name="other" pos="0 .1 0"/>')
    biotac_mj.attach(spec, body="other", quat=[1, -1, 0, 0], prefix="other_", **FINGER)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, SETTLED)
    if how == "recompiled":
        body = spec.worldbody.add_body(name="new", pos=[0.3, 0, 0])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0])
        model, data = spec.recompile(model, data)
    else:
        data.eq_active[:] = 0
    mujoco.mj_step(model, data, 1 if how == "switched off" else SETTLED)
    biotac_mj.plugin.check()
    assert weight(data, handle) == pytest.approx(WEIGHT, rel=1e-3)


# together, but for spring and damper, of which one is needed
@pytest.mark.parametrize("flags", ["spring limit frictionloss", "damper island warmstart"])
def test_flags_that_do_not_matter(flags):
    disabled = " ".join(f'{flag}="disable"' for flag in flags.split())
    spec, handle = resting(f"<flag {disabled}/>")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, SETTLED)
    assert weight(data, handle) == pytest.approx(WEIGHT, rel=1e-3)


@pytest.mark.parametrize(
    "coupling, tier",
    [
        ("two-way", "condensed"),
        ("one-way", "condensed"),
        pytest.param("two-way", "full", marks=pytest.mark.slow),
        pytest.param("one-way", "full", marks=pytest.mark.slow),
    ],
)
def test_without_contact_nothing_touches_until_it_is_back(coupling, tier):
    """As everywhere in MuJoCo, at any step: the ball falls through the skin as if that were not there. Back
    in it, the skin holds what it has room for."""
    spec, handle = resting(coupling=coupling, tier=tier)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 30)
    assert handle.read(data, "contact_force")[1] > 0.1 * WEIGHT
    start = data.qpos.copy(), data.qvel.copy()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    for _ in range(3):
        speed = data.qvel[0]
        mujoco.mj_step(model, data)
        assert data.qfrc_passive[0] == pytest.approx(-speed)  # the joint's damping alone
        assert handle.read(data, "status")[0] == 1
        assert not handle.read(data, "contact_force").any()
    model.opt.disableflags = 0
    data.qpos[:], data.qvel[:] = start
    mujoco.mj_forward(model, data)
    assert handle.read(data, "contact_force")[1] > 0.1 * WEIGHT
    if coupling == "two-way":
        mujoco.mj_step(model, data, SETTLED)
        assert weight(data, handle) == pytest.approx(WEIGHT, rel=1e-3)


def test_without_contact_a_plane_does_not_touch_either():
    spec, _ = resting()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], pos=[0, 0, -0.008])
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.body("finger").add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    handle = next(iter(biotac_mj.handles(model := spec.compile()).values()))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 10)
    assert handle.read(data, "status")[0] == 1
    assert not handle.read(data, "contact_force").any()


def test_flags_that_matter_are_named():
    """And the skin goes on when they are back."""
    spec, handle = resting()
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 20)
    for flags, text in (
        (["constraint"], "the flag constraint is disabled"),
        (["equality"], "the flag equality is disabled"),
        (["constraint", "equality"], "the flag constraint and equality is disabled"),
        (["spring", "damper"], "the flags spring and damper are both disabled: enable one of them"),
    ):
        for flag in flags:
            model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}")
        with pytest.warns(RuntimeWarning, match=text):
            mujoco.mj_step(model, data)
        assert handle.read(data, "status")[0] == -1
        with pytest.raises(ValueError, match=text):
            biotac_mj.plugin.check()
        biotac_mj.plugin.clear_errors()
        model.opt.disableflags = 0
        mujoco.mj_step(model, data)
        assert handle.read(data, "status")[0] == 1
    mujoco.mj_step(model, data, SETTLED)
    assert weight(data, handle) == pytest.approx(WEIGHT, rel=1e-3)


@pytest.mark.slow
def test_a_binary_model_needs_the_import(tmp_path):
    """docs/lab/coupling.md says so; with it, the model loads in a process that has seen nothing else."""
    spec, _ = resting(readings="none")
    mujoco.mj_saveModel(spec.compile(), str(tmp_path / "scene.mjb"))
    code = (
        "import biotac_mj, mujoco, sys; m = mujoco.MjModel.from_binary_path(sys.argv[1]);"
        f"d = mujoco.MjData(m); mujoco.mj_step(m, d, {SETTLED});"
        "print(d.sensor('biotac_contact_force').data[1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "scene.mjb")], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) == pytest.approx(WEIGHT, rel=1e-2)


def test_masks_that_change_do_not_break_a_reset():
    """What can touch is read when an mjData is made: it stays so in its resets, and a new one sees the
    change."""
    spec = scene('<body name="finger"/>' + presser())
    handle = biotac_mj.attach(spec, body="finger", **FINGER | {"readings": "biotac"})
    model = spec.compile()
    force, data = press(model, handle)
    geom = model.geom("presser")
    geom.contype = geom.conaffinity = 0
    mujoco.mj_resetData(model, data)
    again, _ = press(model, handle, data=data)
    assert handle.read(data, "status")[0] == 1
    np.testing.assert_allclose(again, force, rtol=1e-6)
    none, new = press(model, handle)
    assert handle.read(new, "status")[0] == 1
    assert not none.any()
