"""BioTacs on hands: frames, freedoms, exclusions; the Menagerie's Shadow Hand where it is, else a small hand
of our own."""

import os
import pathlib

import mujoco
import numpy as np
import pytest

import biotac_mj
from biotac_mj.tasks.hands import HANDS, Mount, attach_to_hand

# Two fingers of two links with flexion about x, a thumb opposite, and a ball: a synthetic hand.
HAND = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1" pos="0 0 -1"/>
  <body name="ball" pos="0 -0.05 0.5"><freejoint/><geom name="ball" size="0.01" mass="0.01"/></body>
  <body name="my_palm" gravcomp="1"><geom name="palm" type="box" size=".04 .01 .04"/>
    {fingers}
  </body></worldbody></mujoco>"""
FINGER = """<body name="my_{n}middle" pos="{x} 0 .04" gravcomp="1"><joint name="{n}J2" axis="1 0 0"/>
      <geom type="capsule" size=".008 .01" pos="0 0 .01"/>
      <body name="my_{n}distal" pos="0 0 .025" gravcomp="1"><joint name="{n}J1" axis="1 0 0"/>
        <geom name="{n}tip" type="capsule" size=".008 .01" pos="0 0 .012" mass=".013"/></body></body>"""


def small_hand():
    return mujoco.MjSpec.from_string(
        HAND.format(fingers="".join(FINGER.format(n=n, x=x) for n, x in (("a", -0.02), ("b", 0.02))))
    )


def mounts():
    return {n: Mount(f"{n}distal", (0, 0, 0.0107)) for n in ("a", "b")}


def shadow_folder():
    root = (
        os.environ.get("MENAGERIE_ROOT")
        or pathlib.Path(__file__).resolve().parents[2] / "shared" / "menagerie"
    )
    folder = pathlib.Path(root) / "shadow_hand"
    if not folder.is_dir():
        pytest.skip("needs the Menagerie's shadow_hand: set MENAGERIE_ROOT")
    return folder


def springs(**settings):
    """Settings of a skin that costs nothing."""
    import spring_skin

    return {"skin": spring_skin.pad_geometry(), "stepper": "springs", "readings": "sum"} | settings


@pytest.fixture(autouse=True)
def no_errors():
    yield
    biotac_mj.plugin.check()


def tip_at(model, data, handle, joint, angle):
    """Tip (3,) [m] of a finger with one joint bent."""
    data.qpos[model.jnt_qposadr[model.joint(joint).id]] = angle
    mujoco.mj_kinematics(model, data)
    body = data.body(handle.body)
    mat = body.xmat.reshape(3, 3)
    data.qpos[model.jnt_qposadr[model.joint(joint).id]] = 0
    return body.xpos + mat @ [-21.3e-3, 0, 0]


def assert_pad_leads(model, data, handle, joint):
    """Bending a finger moves its tip the way that the pad looks."""
    tip, bent = tip_at(model, data, handle, joint, 0.0), tip_at(model, data, handle, joint, 0.05)
    body = data.body(handle.body)
    mujoco.mj_kinematics(model, data)
    looks = -body.xmat.reshape(3, 3)[:, 1]
    assert (bent - tip) @ looks > 0.9 * np.linalg.norm(bent - tip) > 0


def test_a_hand_by_body_names():
    spec = small_hand()
    handles = biotac_mj.attach_to_hand(spec, mounts(), **springs())
    assert list(handles) == ["a", "b"]
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name, handle in handles.items():
        body = data.body(handle.body)
        mat = body.xmat.reshape(3, 3)
        np.testing.assert_allclose(
            body.xpos + mat @ [-21.3e-3, 0, 0], data.body(f"my_{name}distal").xpos + [0, 0, 0.032], atol=1e-6
        )
        np.testing.assert_allclose(mat, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)
        assert_pad_leads(model, data, handle, f"{name}J1")
    for name in "ab":  # what is replaced stays, for what refers to it, but touches nothing and is not drawn
        tip = model.geom(f"{name}tip")
        assert not tip.contype[0] and not tip.conaffinity[0] and tip.rgba[3] == 0
    # the skin touches the ball and the floor, and none of the hand's own links
    from test_attach import touching

    assert touching(model, 0)[0] == touching(model, 1)[0] == ["floor", "ball"]
    mujoco.mj_step(model, data, 3)
    assert handles["a"].read(data, "status")[0] == 1


def test_links_of_the_hand_can_touch_if_asked():
    from test_attach import touching

    spec = small_hand()
    attach_to_hand(spec, mounts(), fingers=("a",), self_touch=True, **springs())
    names = touching(spec.compile())[0]
    # its own link and that link's parent are MuJoCo's to leave out
    assert set(names) == {"floor", "ball", "palm", "btip", ""}


def test_a_ball_between_two_fingers_feels_both():
    """Fingers that bend onto a ball hold it: equal and opposite forces, from mj_step alone, with the FEM
    skin."""
    text = """<mujoco><option timestep="0.004" integrator="implicitfast" gravity="0 0 0"/><worldbody>
      <body name="ball"><freejoint/><geom name="ball" size="0.01" mass="0.02"/></body>
      {}</worldbody></mujoco>"""
    finger = """<body name="{n}" pos="0 {y} -.012" euler="0 0 {turn}">
      <joint name="{n}" type="slide" axis="0 -1 0" damping="20"/>
      <geom type="box" size=".002 .002 .002" pos="0 .01 -.02" mass=".05"/></body>"""
    spec = mujoco.MjSpec.from_string(
        text.format(finger.format(n="l", y=0.0185, turn=0) + finger.format(n="r", y=-0.0185, turn=180))
    )
    hand = {n: Mount(n, (0, 0, 0.002), replaces=()) for n in "lr"}
    handles = {n: attach_to_hand(spec, {n: hand[n]}, skin="coarse", tier="condensed")[n] for n in "lr"}
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(60):
        data.qfrc_applied[model.jnt_dofadr[[model.joint(n).id for n in "lr"]]] = 0.5
        mujoco.mj_step(model, data)
    force = {n: h.read(data, "contact_force")[:3] for n, h in handles.items()}
    assert force["l"][1] == pytest.approx(0.5, rel=0.03) and force["r"][1] == pytest.approx(0.5, rel=0.03)
    assert np.linalg.norm(data.body("ball").xpos) < 1e-4


def test_shadow_hand_both_variants():
    """24 freedoms with the tip replaced, 19 with Shadow's own BioTac fingers; pads look where fingers bend,
    left and right."""
    folder = shadow_folder()
    for side in ("right", "left"):
        for variant, nv, nu in (("replace", 24, 20), ("authentic", 19, 19)):
            spec = mujoco.MjSpec.from_file(str(folder / f"{side}_hand.xml"))
            handles = attach_to_hand(spec, "shadow_hand", variant=variant, **springs())
            model = spec.compile()
            assert (model.nv, model.nu, model.nplugin) == (nv, nu, 5)
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            for finger, handle in handles.items():
                joint = f"{side[0]}h_{finger.upper()}J{'1' if variant == 'replace' else '2'}"
                if variant == "replace" or finger != "th":  # the thumb's joint before the last turns across
                    assert_pad_leads(model, data, handle, joint)
                mass = (
                    model.body_mass[model.body_parentid[model.body(handle.body).id]]
                    + model.body(handle.body).mass[0]
                )
                assert mass == pytest.approx(
                    0.017 if finger == "th" else 0.013, abs=1e-4
                )  # as without BioTacs
            if variant == "authentic":  # the tendon's servo drives what is left of the pair
                servo = model.actuator(f"{side[0]}h_A_FFJ0")
                assert model.joint(servo.trnid[0]).name == f"{side[0]}h_FFJ2" and servo.ctrlrange[
                    1
                ] == pytest.approx(1.5708)
            mujoco.mj_step(model, data, 2)
            assert all(h.read(data, "status")[0] == 1 for h in handles.values())


def test_shadow_hand_with_some_fingers_inside_a_scene():
    scene = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body name="ball" pos="0 0 .5"><freejoint/><geom '
        'size=".02"/></body></worldbody></mujoco>'
    )
    hand = mujoco.MjSpec.from_file(str(shadow_folder() / "right_hand.xml"))
    scene.attach(hand, frame=scene.worldbody.add_frame(pos=[0, 0, 1]), prefix="robot_")
    handles = attach_to_hand(scene, "shadow_hand", fingers=("ff", "th"), prefix="tip_", **springs())
    model = scene.compile()
    assert [h.body for h in handles.values()] == ["tip_ff_core", "tip_th_core"]
    assert model.body(model.body("tip_ff_core").parentid[0]).name == "robot_rh_ffdistal"
    mujoco.mj_step(model, mujoco.MjData(model), 2)


def test_mounting_frames_point_as_the_hands_do():
    """Of each hand in the table the BioTac's -x is the finger's tip direction and its -y the pad's."""
    for hand in HANDS.values():
        for mount in hand.values():
            matrix = np.empty(9)
            mujoco.mju_quat2Mat(matrix, mount.quat)
            np.testing.assert_allclose(matrix.reshape(3, 3) @ [-1, 0, 0], mount.tip, atol=1e-9)
            np.testing.assert_allclose(matrix.reshape(3, 3) @ [0, -1, 0], mount.pad, atol=1e-9)


def two_hands():
    scene = mujoco.MjSpec()
    for side, x in (("left_", -0.2), ("right_", 0.2)):
        scene.attach(small_hand(), frame=scene.worldbody.add_frame(pos=[x, 0, 0]), prefix=side)
    return scene


def test_two_hands_of_a_kind_in_one_scene():
    scene = two_hands()
    text = "of several hands say which one takes the BioTacs, with link_prefix='left_my_' or 'right_my_'"
    with pytest.raises(ValueError, match=f"several links end with 'adistal': .*{text}"):
        attach_to_hand(scene, mounts(), **springs())
    handles = [
        *attach_to_hand(scene, mounts(), link_prefix="left_", **springs()).values(),
        *attach_to_hand(scene, mounts(), link_prefix="right_", **springs()).values(),
    ]
    model = scene.compile()
    assert [h.body for h in handles] == [f"{s}_biotac_{f}_core" for s in ("left", "right") for f in "ab"]
    for handle in handles:
        link = model.body(model.body(handle.body).parentid[0]).name
        side, _, finger, _ = handle.body.split("_")
        assert link == f"{side}_my_{finger}distal"
    mujoco.mj_step(model, mujoco.MjData(model), 2)


def test_another_hand_than_the_one_named_is_recognised():
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody>"
        + "".join(f'<body name="{m.body}"><geom size=".01"/></body>' for m in HANDS["leap_hand"].values())
        + "</worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="'ffdistal': .*it looks like a leap_hand: name that"):
        attach_to_hand(spec, "shadow_hand")


@pytest.mark.parametrize(
    "settings, text",
    [
        (dict(hand="barrett"), r"unknown hand 'barrett': choose one of shadow_hand.*or give \{finger: Mount"),
        (
            dict(hand="allegro_hand", variant="authentic"),
            r"only the shadow_hand comes with authentic BioTac fingers, not 'allegro_hand'",
        ),
        (dict(variant="new"), r"unknown variant 'new': choose one of replace, authentic"),
        (dict(fingers=("ff", "pinky")), r"the hand has no finger 'pinky': choose from ff, mf, rf, lf, th"),
        (
            dict(fingers=("ff",)),
            r"no link ends with 'ffdistal': the model has world, ball, my_palm.*FILE with `biotac hand mo",
        ),
        (dict(link_prefix="his_"), r"no link ends with 'ffdistal' and begins with 'his_': the model"),
        (dict(link_prefix=None), r"link_prefix is None: pass the text that the links' names begin"),
        (
            dict(hand={"x": Mount("distal", (0, 0, 0))}),
            r"several links end with 'distal': the model has my_adistal, my_bdistal",
        ),
        (
            dict(hand={"a": Mount("adistal", (0, 0, 0), tip=(0, 0, 1), pad=(0, 0, 1))}),
            r"of link 'adistal' must be at right angles",
        ),
    ],
)
def test_bad_settings_of_hands_are_refused(settings, text):
    with pytest.raises(ValueError, match=text):
        attach_to_hand(small_hand(), **({"hand": "shadow_hand"} | settings))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ball", "cube", "can"])
def test_shadow_hand_lifts(name, monkeypatch, repo):
    """The example's hand lifts each object by most of its own lift, held by all five fingertips nearly all
    the way."""
    from test_examples import load

    monkeypatch.setenv("MENAGERIE_ROOT", str(shadow_folder().parent))
    example = load(repo, "shadow_hand_grasp")
    result = example.run(name, progress=False)
    assert result["height"][-1] > 0.07
    lifting = result["time"] > example.CLOSE + example.SQUEEZE
    assert (result["force"] > example.HELD).all(axis=1)[lifting].mean() > 0.9 and (
        result["force"][-1] > 0.1
    ).all()
    assert (np.abs(result["counts"] - result["counts"][0]).max(axis=(0, 2)) > 20).sum() >= 4


def test_fingers_share_settings_and_have_noise_of_their_own():
    keywords = dict(skin="coarse", tier="condensed", sensor="random", seed=3)
    stages = {"skin": {"mesh": "coarse", "tier": "condensed"}, "sensor": {"individual": "random"}, "seed": 3}
    by_name = attach_to_hand(small_hand(), mounts(), **keywords)
    by_stage = attach_to_hand(small_hand(), mounts(), settings=stages)
    assert [h.config for h in by_name.values()] == [h.config for h in by_stage.values()]
    assert len({h.config.noise_seed() for h in by_name.values()}) == len(by_name) == 2


def test_a_hand_of_a_batch_leaves_the_rest_to_its_attach():
    assert list(attach_to_hand(small_hand(), mounts(), batch=True, skin="coarse")) == ["a", "b"]
    hand = small_hand()
    attach_to_hand(hand, mounts(), batch=True, settings={"skin": {"design": "biotac_sp", "mesh": "coarse"}})
    assert {site.name for site in hand.sites} >= {"biotac_a_e24", "biotac_b_e24"}
    with pytest.raises(TypeError, match="attach_to_hand with batch=True has 'options'"):
        attach_to_hand(small_hand(), mounts(), batch=True, options={})


@pytest.mark.slow
def test_a_hand_in_a_batch_presses_as_the_single_one():
    """Of two fingers in two worlds of mujoco_warp one is pressed; in the second world none."""
    mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp: pip install biotac_mj[batch]")
    from biotac_mj import batch

    def build(**settings):
        spec = small_hand()
        spec.option.gravity, spec.option.timestep = [0, 0, 0], 2e-3
        pin = spec.worldbody.add_body(name="pin", mocap=True, pos=[0, 0.2, 0])
        pin.add_geom(size=[4e-3, 0, 0])  # without a name
        return attach_to_hand(spec, mounts(), skin="coarse", **settings), spec.compile()

    def place(data, core, k):  # contact comes in small steps: a jump into it may find another balance
        body = data.body(core)
        return body.xpos + body.xmat.reshape(3, 3) @ [-12e-3, -12.4e-3 + 1e-4 * k, 0]

    handles, model = build()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start, expected = mujoco.MjData(model), []
    mujoco.mj_forward(model, start)
    for k in range(12):
        data.mocap_pos[0] = place(start, handles["a"].body, k)
        mujoco.mj_step(model, data)
        expected.append([handles[f].read(data, "contact_force")[:3] for f in ("a", "b")])
    expected = np.array(expected)
    prefixes, mjm = build(batch=True)
    mjd = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, mjd)
    m, d = mjw.put_model(mjm), mjw.put_data(mjm, mjd, nworld=2)
    both = [batch.attach(mjm, m, d, prefix=p, skin="coarse", readings=False) for p in prefixes.values()]
    found, mocap = [], d.mocap_pos.numpy().copy()
    for k in range(12):
        mocap[0, 0] = place(mjd, f"{prefixes['a']}core", k)
        d.mocap_pos.assign(mocap)
        mjw.step(m, d)
        rows = [
            d.sensordata.numpy()[:, mjm.sensor(f"{p}contact_force").adr[0] :][:, :3].copy()
            for p in prefixes.values()
        ]
        found.append(rows)
    found = np.moveaxis(np.array(found), 2, 0)
    peak = np.abs(expected).max()
    assert peak > 0.03 and not expected[:, 1].any() and not found[1].any()
    np.testing.assert_allclose(found[0], expected, atol=5e-3 * peak)
    assert not both[1].rest.any.numpy()[0]
