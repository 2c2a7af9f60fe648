"""`biotac hand mount`: places found by a link's own shape, the file that `attach_to_hand` takes, the picture;
hands of the Menagerie where it is."""

import importlib.util
import re
from importlib import resources

import mujoco
import numpy as np
import pytest
from test_hands import FINGER, HAND, springs

from biotac_mj import cli
from biotac_mj.coupling.show import SKIN
from biotac_mj.tasks.hands import HANDS, attach_to_hand, fixed_geoms
from biotac_mj.tasks.mounting import _REPLACED, draw_mount, guess_mount, stands_off
from biotac_mj.tasks.mounts import CLAMP, read_mounts, write_mounts
from biotac_mj.view.offscreen import find_gl


@pytest.fixture
def hand(tmp_path):
    path = tmp_path / "hand.xml"
    path.write_text(
        HAND.format(fingers="".join(FINGER.format(n=n, x=x) for n, x in (("a", -0.02), ("b", 0.02))))
    )
    return path


def test_a_mount_by_the_links_shape(hand):
    """The capsule ends 30 mm from the joint, which bends it towards -y."""
    mount = guess_mount(mujoco.MjSpec.from_file(str(hand)), "adistal")
    assert mount.body == "my_adistal" and mount.tip == (0, 0, 1) and mount.pad == (0, -1, 0)
    np.testing.assert_allclose(mount.pos, [0, 0, 30e-3 - 21.3e-3], atol=1e-5)
    turned = guess_mount(mujoco.MjSpec.from_file(str(hand)), "adistal", tip=(1.0, 0, 0), pad=(0, 0, 1.0))
    np.testing.assert_allclose(turned.pos, [8e-3 - 21.3e-3, 0, 12e-3], atol=1e-5)


@pytest.mark.parametrize(
    ("body", "given", "text"),
    [
        ("nowhere", {}, "no link ends with 'nowhere': the model has world, ball, my_palm"),
        ("distal", {}, "several links end with 'distal': the model has my_adistal, my_bdistal: name one"),
        ("my_palm", {}, "no hinge moves this link: say where its pad looks, --pad X Y Z"),
        ("adistal", {"tip": (1.0, 0, 0)}, "turns about its own length: say where its pad looks"),
        ("adistal", {"tip": (0, 1.0, 0), "pad": (0, 1.0, 0)}, "must be at right angles"),
    ],
)
def test_what_cannot_be_guessed_is_said(hand, body, given, text):
    with pytest.raises(ValueError, match=text):
        guess_mount(mujoco.MjSpec.from_file(str(hand)), body, **given)


SLIDING = """<mujoco><worldbody><body name="palm"><geom type="box" size=".04 .02 .01"/>
  <body name="left" pos="-.02 0 .01"><joint type="slide" axis="1 0 0"/>
    <geom type="box" size=".005 .008 .015" pos="0 0 .015"/></body>
  <body name="right" pos=".02 0 .01"><joint type="slide" axis="-1 0 0"/>
    <geom type="box" size=".005 .008 .015" pos="0 0 .015"/></body></body></worldbody></mujoco>"""


def test_pads_of_jaws_that_slide_look_at_each_other(tmp_path, capsys):
    (tmp_path / "g.xml").write_text(SLIDING)
    words = [
        "hand",
        "mount",
        str(tmp_path / "g.xml"),
        "--body",
        "left",
        "right",
        "--out",
        str(tmp_path / "m.yaml"),
    ]
    assert cli.main(words) == 0 and not capsys.readouterr().err
    assert [m.pad for m in read_mounts(tmp_path / "m.yaml").values()] == [(1, 0, 0), (-1, 0, 0)]
    assert cli.main([*words, "--pad", "1", "0", "0"]) == 0
    assert "the pad of right looks away from left" in capsys.readouterr().err


# Jaws that hinge at their feet and open with positive angles, as with negative ones.
TURNING = """<mujoco><worldbody><body name="palm"><geom type="box" size=".04 .02 .01"/>
  <body name="left" pos="-.02 0 .01"><joint axis="0 1 0" range="{left}"/>
    <geom type="box" size=".005 .008 .025" pos="0 0 .025"/></body>
  <body name="right" pos=".02 0 .01"><joint axis="0 1 0" range="{right}"/>
    <geom type="box" size=".005 .008 .025" pos="0 0 .025"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("left", "right"), [("-50 0", "0 50"), ("0 50", "-50 0"), ("-50 50", "-50 50")])
def test_pads_of_turning_jaws_face_each_other(left, right):
    spec = mujoco.MjSpec.from_string(TURNING.format(left=left, right=right))
    assert guess_mount(spec, "left", ["right"]).pad == (1, 0, 0)
    assert guess_mount(spec, "right", ["left"]).pad == (-1, 0, 0)


def test_an_oblique_link_is_mounted_along_its_own_axis():
    """A capsule of 8 mm radius, 40 mm along the diagonal of x and z, on a hinge about y."""
    spec = mujoco.MjSpec.from_string("""<mujoco><worldbody><body name="palm"><geom size=".02"/>
      <body name="link" pos="0 0 .02"><joint axis="0 1 0" range="0 90"/>
        <geom type="capsule" size=".008" fromto="0 0 0 .0283 0 .0283"/></body></body></worldbody></mujoco>""")
    mount, way = guess_mount(spec, "link"), np.array([1, 0, 1]) / np.sqrt(2)
    np.testing.assert_allclose(mount.tip, way, atol=1e-3)
    np.testing.assert_allclose(mount.pad, [way[2], 0, -way[0]], atol=1e-3)  # turned on about +y
    np.testing.assert_allclose(mount.pos, (0.048 - 21.3e-3) * way, atol=1e-4)


@pytest.mark.parametrize("size", [1e3, 1e2, 0.03])
def test_a_model_that_is_not_in_metres_is_said(size):
    xml = TURNING.format(left="-50 0", right="0 50")

    def scaled(found):
        return f'{found[1]}="{" ".join(str(size * float(x)) for x in found[2].split())}"'

    xml = re.sub('(size|pos)="([^"]*)"', scaled, xml)
    with pytest.raises(ValueError, match=r"'left' is .* m long, and a BioTac 0.029 m: MuJoCo counts in metr"):
        guess_mount(mujoco.MjSpec.from_string(xml), "left")


@pytest.mark.slow  # quick: a file of mounts with its picture
@pytest.mark.skipif(find_gl() is None, reason="needs a GL library: libosmesa6 or libegl1")
def test_the_picture_shows_links_whatever_the_model_shows(hand):
    """No touch site covers the sensor, and links that have nothing but geoms to collide with are there."""
    mount, plain = guess_mount(mujoco.MjSpec.from_file(str(hand)), "adistal"), hand.read_text()
    pictures = [draw_mount(hand, mount, 150, 150)]
    site = '<site name="touch" type="sphere" size=".02" pos="0 0 .012" rgba="0 0 1 1"/><geom name="atip"'
    for changed in (plain.replace('<geom name="atip"', site), plain.replace("<geom ", '<geom group="3" ')):
        hand.write_text(changed)
        pictures.append(draw_mount(hand, mount, 150, 150))
    np.testing.assert_array_equal(pictures[1], pictures[0])
    np.testing.assert_array_equal(pictures[2], pictures[0])


def test_a_file_of_mounts_is_what_attach_to_hand_takes(hand, tmp_path, capsys):
    out, picture = tmp_path / "mount.yaml", tmp_path / "mount.png"
    words = ["hand", "mount", str(hand), "--body", "adistal", "bdistal", "--out", str(out)]
    words += ["--picture", str(picture)] if find_gl() else []
    assert cli.main(words) == 0
    assert "stands for atip: not drawn, touches nothing" in capsys.readouterr().out
    spec = mujoco.MjSpec.from_file(str(hand))
    handles = attach_to_hand(spec, mount=out, **springs())
    assert list(handles) == ["my_adistal", "my_bdistal"] and spec.compile().nplugin == 2
    if find_gl():
        from matplotlib.image import imread

        legend = imread(picture)[-70:, :, :3]
        for colour in (_REPLACED, SKIN):
            assert (np.abs(legend - colour).max(2) < 0.02).sum() > 100
        for mount in list(read_mounts(out).values())[:1]:
            before, beside, onto = (x / 255 for x in draw_mount(hand, mount))
            pure = [(x[..., i] > 0.6 * x.sum(2)).sum() for x, i in ((before, 0), (beside, 1), (onto, 2))]
            assert pure[0] > 1000 and min(pure[1:]) > 20  # the capsule that goes; axes to the nail and across
            assert (beside[..., 1] > 1.3 * beside[..., 0]).mean() > 0.01  # the skin


# A finger whose last link has a bracket behind the fingertip, both drawn as one: as LEAP's.
BRACKET = """<mujoco><worldbody><body name="palm"><geom type="box" size=".02 .02 .01"/>
  <body name="link" pos="0 0 .01"><joint axis="1 0 0"/>
    <geom name="drawn" type="box" size=".009 .009 .03" pos="0 0 .03" contype="0" conaffinity="0" group="2"/>
    <geom {bracket} type="box" size=".009 .009 .013" pos="0 0 .015" group="3"/>
    <geom {tip} type="box" size=".009 .009 .015" pos="0 0 .045" group="3"/>
  </body></body></worldbody></mujoco>"""


def test_what_lies_behind_a_biotac_stays_with_the_link(tmp_path, capsys):
    """The link is 60 mm long, a BioTac 29: replaced whole, the sensor hangs 30 mm before the palm."""
    hand, out = tmp_path / "hand.xml", tmp_path / "m.yaml"
    words = ["hand", "mount", str(hand), "--body", "link", "--out", str(out)]
    hand.write_text(BRACKET.format(bracket='name="bracket"', tip='name="tip"'))
    assert cli.main(words) == 0
    said = capsys.readouterr()
    assert not said.err
    assert "stands for drawn, tip: not" in said.out and "leaves bracket of the link" in said.out
    mount = read_mounts(out)["link"]
    assert mount.replaces == ("drawn", "tip") and mount.shown == ("bracket",)
    spec = mujoco.MjSpec.from_file(str(hand))
    attach_to_hand(spec, mount=out, **springs())
    assert spec.geom("bracket").group == 0 and spec.geom("bracket").contype and not spec.geom("tip").contype
    for tip, more in (('name="tip"', ["--replaces", "drawn", "bracket", "tip"]), ("", [])):
        hand.write_text(BRACKET.format(bracket='name="bracket"', tip=tip))
        assert cli.main([*words, *more]) == 0
        assert "the BioTac of link hangs in the air, 31 mm from" in capsys.readouterr().err


def test_a_biotac_is_as_long_as_its_clamp_says():
    lines = (resources.files("biotac_mj") / "assets" / "clamp.obj").read_text().splitlines()
    assert max(float(line.split()[1]) for line in lines if line.startswith("v ")) == CLAMP


def test_mounts_come_back(tmp_path):
    write_mounts(tmp_path / "all.yaml", HANDS["leap_hand"])
    assert read_mounts(tmp_path / "all.yaml") == HANDS["leap_hand"]
    for text, said in (
        ("f: {body: a, pos: [0, 0, 0], tips: [1, 0, 0]}", "finger f has 'tips': did you mean 'tip'"),
        ("f: {pos: [0, 0, 0]}", "finger f has no body: add what is missing"),
        ("f: {body: 3, pos: [0, 0, 0]}", "body of finger f is 3: pass a text"),
        ("f: [1]", "finger f is [1]: a dict is needed"),
    ):
        (tmp_path / "bad.yaml").write_text(text)
        with pytest.raises(ValueError, match=f"bad.yaml is no file of mounts .*{re.escape(said)}"):
            read_mounts(tmp_path / "bad.yaml")
    with pytest.raises(
        FileNotFoundError, match="no file of mounts at .*: give a file that `biotac hand mount` wrote"
    ):
        attach_to_hand(mujoco.MjSpec(), mount=tmp_path / "none.yaml")


def benchmark(repo):
    spec = importlib.util.spec_from_file_location("mounts", repo / "benchmarks" / "mounts.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("hand", ["allegro_hand", "leap_hand", "robotiq_2f85", "aero_hand", "shadow_hand"])
def test_every_finger_of_the_menageries_hands_feels_a_ball(hand, repo):
    """As hard on every finger, and on the pad; a link's shape says what was measured on its meshes."""
    mounts = benchmark(repo)
    path = mounts.model_of(hand)
    if path is None:
        pytest.skip(f"needs the Menagerie's {mounts.MODELS[hand]}: set MENAGERIE_ROOT")
    found, *_ = mounts.press(path, hand)
    assert list(found) == list(HANDS[hand])
    for one in found.values():
        assert one["lost"] == 0 and 0.3 < one["force"][1] < 1.0  # towards the nail
        assert np.abs(one["change"]).argmax() in (0, 10) and one["change"].max() > 150  # e1, e11: beneath it
    for mount in HANDS[hand].values():
        assert stands_off(mujoco.MjSpec.from_file(str(path)), mount) < 3e-3
        others = [other.body for other in HANDS[hand].values() if other is not mount]
        guessed = guess_mount(mujoco.MjSpec.from_file(str(path)), mount.body, others)
        np.testing.assert_allclose((guessed.tip, guessed.pad), (mount.tip, mount.pad), atol=0.03)
        assert abs(np.dot(np.subtract(guessed.pos, mount.pos), mount.tip)) < 3e-4
        spec = mujoco.MjSpec.from_file(str(path))
        goes = {g.name for g in fixed_geoms(spec.body(guessed.body), guessed.replaces)}
        assert goes == {g.name for g in fixed_geoms(spec.body(guessed.body), mount.replaces)}


@pytest.mark.parametrize("wrong", ["{}", ".nan", "'1'", "null"])
def test_a_place_that_is_no_number_is_refused_where_it_is_read(wrong, tmp_path):
    (tmp_path / "m.yaml").write_text(f"a:\n  body: a\n  pos: [0.0, 0.0, {wrong}]\n")
    with pytest.raises(ValueError, match="pos of finger a"):
        read_mounts(tmp_path / "m.yaml")


def test_a_link_that_is_named_twice_is_refused(tmp_path, capsys):
    file, out = tmp_path / "twice.xml", tmp_path / "mount.yaml"
    file.write_text(SLIDING)
    assert cli.main(["hand", "mount", str(file), "--body", "left", "right", "left", "--out", str(out)]) == 2
    assert "--body names left twice: name each link once" in capsys.readouterr().err
    assert not out.exists()


def test_an_unknown_picture_suffix_is_refused_before_the_work(tmp_path, capsys):
    hand, out = tmp_path / "hand.xml", tmp_path / "mount.yaml"
    hand.write_text("<mujoco/>")
    picture = tmp_path / "mount.foo"
    args = ["hand", "mount", str(hand), "--body", "a", "--out", str(out), "--picture", str(picture)]
    with pytest.raises(SystemExit):
        cli.main(args)
    assert "mount.foo is no picture: give a name that ends in one of" in capsys.readouterr().err
    assert not out.exists()
