"""Press: the path against closed forms, the run with a skin of springs whose answer is known, the files read
back."""

import csv
import dataclasses
import json
import sys
import warnings

import h5py
import mujoco
import numpy as np
import pytest
import trimesh
from matplotlib.image import imread

from biotac_mj.coupling import SkinResult, SkinStepper, register_stepper, stepper
from biotac_mj.effects.catalogue import by_id
from biotac_mj.files import replacing
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.rigid import quaternion_from_y
from biotac_mj.geometry.solid import bounds_solid
from biotac_mj.geometry.tet_mesh import enclosed_volume
from biotac_mj.press import PressOptions, approach, build_scene, plan_path, press, render, report
from biotac_mj.press.indenter import make_indenter
from biotac_mj.press.record import write_readings, write_skin
from biotac_mj.sensor.channels import CHANNELS
from biotac_mj.skin.rubber.material import PRESETS
from biotac_mj.view import offscreen

STIFFNESS = 40.0  # of a node's spring [N/m]


class NodeSprings(SkinStepper):
    """Every outer node gives way to a sphere along its normal, held by a spring: forces are known by hand."""

    def __init__(self, config, geometry, geoms):
        self.geometry, self.geoms, self.nstate = geometry, geoms, 3 * geometry.nvert
        self.outer = np.unique(geometry.outer_face)

    def reset(self, state):
        state[:] = self.geometry.vert.ravel()

    def vert_xpos(self, state):
        return state.reshape(-1, 3)

    def solve_skin(self, state, geom_pos, geom_mat, dt, **more):
        x = self.geometry.vert.copy()
        away = x[self.outer] - geom_pos[0]
        distance = np.linalg.norm(away, axis=1)
        depth = np.clip(self.geoms[0].size[0] - distance, 0, None)[:, None]
        normal = away / distance[:, None]
        x[self.outer] += depth * normal
        force = -STIFFNESS * depth * normal
        wrench = np.concatenate([force.sum(0), np.cross(x[self.outer], force).sum(0)])[None]
        cross = np.array([[[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]] for p in x[self.outer]])
        jacobian = np.concatenate([np.tile(np.eye(3), (len(self.outer), 1, 1)), -cross], axis=2)
        along = np.einsum("ni,nij->nj", normal, jacobian) * (depth > 0)
        return SkinResult(x.ravel(), wrench, STIFFNESS * along.T[None] @ along, x)


@pytest.fixture
def springs(monkeypatch, shell, tmp_path):
    """Options of a press on the shell with node springs and no readings."""
    for table in (stepper._steppers, stepper._readings):
        for name, value in table.items():
            monkeypatch.setitem(table, name, value)
    register_stepper("fem", NodeSprings)
    monkeypatch.setitem(stepper._readings, "biotac", stepper._readings["none"])
    path = shell.save(tmp_path / "shell.npz")
    return dict(skin=str(path), location=(-8e-3, 0.0), depth=1e-3, hold=0.0)


def hand_force(shell, record, radius=3.5e-3):
    """(n, 3) force of the springs on the sphere at the recorded positions."""
    outer = shell.vert[np.unique(shell.outer_face)]
    away = outer[None] - (record.indenter_pos - [0, radius, 0])[:, None]
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    return -STIFFNESS * (np.clip(radius - distance, 0, None) * away / distance).sum(1)


# --- the path


def test_surface_point_and_first_touch_of_an_ellipsoid(shell):
    # the shell's outer surface inscribes an ellipsoid with half-axes 13, 7, 7 mm about (-8, 0, 0) mm
    point, normal = approach.surface_point(shell, -8e-3, 0.0)
    assert np.allclose(point, [-8e-3, -7e-3, 0], atol=5e-5) and np.allclose(normal, [0, -1, 0], atol=0.02)
    point, normal = approach.surface_point(shell, -8e-3, np.pi / 2)
    assert np.allclose(point, [-8e-3, 0, 7e-3], atol=5e-5) and np.allclose(normal, [0, 0, 1], atol=0.02)
    point, normal = approach.nearest_point(shell, [-30e-3, 0, 0])
    assert np.allclose(point, [-21e-3, 0, 0], atol=1e-4) and np.allclose(normal, [-1, 0, 0], atol=0.05)


def touching_box(size):
    """A flat box skin: its front face lies at y = -size."""
    from biotac_mj.geometry.skin_geometry import SkinGeometry

    box = trimesh.creation.box(extents=[20 * size, 2 * size, 20 * size])
    none, no_face = np.zeros((0, 3)), np.zeros((0, 3), int)
    return SkinGeometry(
        "box",
        box.vertices,
        np.zeros((0, 4)),
        box.faces,
        no_face,
        [],
        none,
        no_face,
        none,
        no_face,
        none,
        no_face,
        np.zeros((19, 3)),
        np.zeros((19, 3)),
    )


@pytest.mark.parametrize(
    ("name", "tip"),
    [
        ("sphere_7mm", 0.0),
        ("cylinder_short_7mm", 0.0),
        ("cube_14mm", 0.0),
        ("ring_7mm", 0.0),
        ("geom:capsule:0.002,0.003", 5e-3),
        ("geom:ellipsoid:0.002,0.003,0.004", 4e-3),
        ("geom:plane", 0.0),
    ],
)
def test_path_starts_5_um_before_a_flat_skin(name, tip):
    size = 5e-3
    options = PressOptions(
        indenter=name, location=(1e-3, 0.0), depth=1e-3, speed=0.01, timestep=4e-3, hold=0.0
    )
    path = plan_path(touching_box(size), make_indenter(name), options)
    # the frame's origin is `tip` behind the front of the shape, which touches inside a face
    assert path.position(0.0)[1] == pytest.approx(-size - tip, abs=0.3e-6)
    assert path.depth[0] == -5e-6 and path.depth[-1] == 1e-3
    assert np.allclose(np.diff(path.depth)[1:], 4e-5) and len(path.depth) == 26


def test_slide_goes_across_the_press(shell):
    options = PressOptions(location=(-8e-3, 0.3), depth=1e-3, slide=2e-3, hold=0.02)
    path = plan_path(shell, make_indenter("sphere_7mm"), options)
    assert abs(path.direction @ path.slide_direction) < 1e-12
    assert path.slid[-1] == 2e-3 and (np.diff(path.slid) >= 0).all() and path.depth[-1] == 1e-3
    assert (path.slid[path.depth < 1e-3] == 0).all()


def test_quaternion_turns_y_to_the_direction():
    for direction in ([0, 1, 0], [0, -1, 0], [0.6, 0.0, 0.8], [-0.48, -0.6, 0.64]):
        out = np.empty(3)
        mujoco.mju_rotVecQuat(out, np.array([0.0, 1, 0]), quaternion_from_y(np.array(direction, float)))
        assert np.allclose(out, direction)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (dict(location=(0.05, 0.0)), "no skin at x = 50 mm: it reaches from -21.0 to 5.0 mm"),
        (dict(direction=(0.0, -1.0, 0.0)), "leaves the skin"),
        (dict(slide=1e-3, slide_direction=(0.0, 1.0, 0.0), direction=(0.0, 1.0, 0.0)), "along the press"),
        (dict(depth=0.0), "depth is 0 mm: it must be a positive number"),
        (dict(speed=float("nan")), "speed is nan"),
        (dict(location=(float("nan"), 0.0)), "location .* NaN"),
        (dict(location=(0.0,) * 4), "give x, x and an angle, or x, y and z"),
        (dict(direction=(0.0, 0.0, 0.0)), "is no direction"),
        (dict(indenter="sphere_8mm"), "unknown indenter 'sphere_8mm': choose one of .*ring_7mm"),
        (dict(indenter="geom:torus:1"), "unknown geom type 'torus'.* sphere, capsule"),
        (dict(indenter="geom:capsule:0.003"), "no capsule: give its radius, half length, above 0"),
        (dict(indenter="geom:sphere:x"), "are not lengths"),
        (dict(indenter="geom:box:0.1,-1,1"), "no box: give its half width x, y, z, above 0"),
    ],
)
def test_bad_input_names_cause_and_remedy(shell, change, text):
    with pytest.raises(ValueError, match=text):
        options = PressOptions(**{"location": (-8e-3, 0.0), **change})
        plan_path(shell, make_indenter(options.indenter), options)


def test_a_press_has_the_settings_of_attach():
    """By stage or by keyword, and the indenter's own; a bad one is refused at once."""
    stages = {"skin": {"mesh": "coarse", "tier": "condensed"}, "sensor": {"signal": "learned"}, "seed": 4}
    one = PressOptions(depth=1e-3, skin="coarse", tier="condensed", signal="learned", seed=4)
    assert one == PressOptions(depth=1e-3, settings=stages) == PressOptions(depth=1e-3, settings=one.settings)
    assert PressOptions(**one.keywords) == one
    again = dataclasses.replace(one, seed=5, slide=1e-3)
    assert again.settings.seed == 5 and again.settings.skin == one.settings.skin and again.depth == 1e-3
    for wrong, kind, said in (
        ({"depht": 1e-3}, TypeError, "has 'depht': did you mean 'depth'"),
        ({"coupling": "two-way"}, TypeError, "a call of PressOptions has 'coupling'"),
        ({"settings": {"contact": {"geoms": ["ball"]}}}, ValueError, "geoms of settings is .'ball'"),
        ({"friction": -1.0}, ValueError, "the skin's friction is -1.0: give a finite number >= 0"),
        ({"seed": 0.5}, ValueError, "seed is 0.5: give a whole number"),
        ({"material": "jelly"}, ValueError, "unknown material 'jelly'"),
    ):
        with pytest.raises(kind, match=said):
            PressOptions(**wrong)


def test_effects_act_once_on_a_press():
    """Each asks for the settings with effects in them: path, scene and `attach`."""
    options = PressOptions(skin="coarse", effects=[(by_id("friction"), {"log_mu": -0.5})])
    amended = options.settings.amended()
    assert amended.effects is None and amended.amended() == amended
    path = plan_path(load_skin("coarse"), make_indenter(options.indenter), options)
    config = build_scene(make_indenter(options.indenter), path, options)[1].config
    assert config.friction == pytest.approx(np.exp(-0.5) * PRESETS["default"].friction)


@pytest.mark.parametrize("name", ["geom:plane", "cube_14mm", "sphere_7mm"])
def test_what_lies_over_the_core_is_known(name):
    skin = load_skin("coarse")
    options = PressOptions(indenter=name, location=(-12e-3, 0.0))
    path = plan_path(skin, make_indenter(name), options)
    # the core is a cylinder of 5.325 mm about the finger's axis, in facets
    assert path.room == pytest.approx(-path.start[1] - 5.325e-3, abs=5e-5)
    for y, inside in ((-5.2e-3, True), (-5.4e-3, False), (0.0, True)):
        assert approach.is_inside(skin.core_vert, skin.core_face, [-5e-3, y, 0]) is inside


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            dict(depth=3e-3),
            "depth is 3 mm, and the indenter meets core, nail or clamp 2.8. mm after the skin",
        ),
        (dict(location=(-12e-3, np.pi)), "core, nail or clamp 1.00 mm before the skin"),
    ],
)
def test_a_path_into_the_core_is_refused_before_it_is_run(change, text):
    with pytest.raises(ValueError, match=text):
        press(PressOptions(skin="coarse", **change), progress=False)


def test_a_press_that_felt_nothing_says_so(springs, monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        press(PressOptions(**springs), progress=False)
    monkeypatch.setattr(sys.modules[__name__], "STIFFNESS", 0.0)
    with pytest.warns(UserWarning, match="nothing was felt"):
        press(PressOptions(**springs), progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("skin", ["coarse", "default"])
def test_the_default_press_stays_where_errors_are_known(skin):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        press(PressOptions(skin=skin, timestep=10e-3), progress=False)


def test_indenter_meshes_are_checked(tmp_path):
    with pytest.raises(FileNotFoundError, match="no indenter mesh at .*none.obj"):
        make_indenter(f"mesh:{tmp_path / 'none.obj'}")
    ball = trimesh.creation.icosphere(subdivisions=1, radius=3e-3)
    ball.export(tmp_path / "ball.obj")
    assert make_indenter(f"mesh:{tmp_path / 'ball.obj'}").vert.shape == ball.vertices.shape
    trimesh.Trimesh(ball.vertices, ball.faces[1:]).export(tmp_path / "open.obj")
    with pytest.raises(ValueError, match="is open.*close its holes"):
        make_indenter(f"mesh:{tmp_path / 'open.obj'}")
    trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], process=False).export(tmp_path / "inside_out.obj")
    shape = make_indenter(f"mesh:{tmp_path / 'inside_out.obj'}")
    assert bounds_solid(shape.vert, shape.face)
    inside_out, larger = (trimesh.Trimesh(s * ball.vertices, ball.faces[:, ::-1]) for s in (1, 2))
    cavity, beside = inside_out.copy(), inside_out.copy().apply_translation([9e-3, 0, 0])
    upright = trimesh.Trimesh(2 * ball.vertices, ball.faces)
    for shells, volume in (
        ([ball, beside], 2),  # of equal size
        ([upright, beside], 9),
        ([larger, beside], 9),
        ([upright, cavity], 7),
        ([larger, ball, beside], 8),
    ):
        trimesh.util.concatenate(shells).export(tmp_path / "shells.stl")
        shape = make_indenter(f"mesh:{tmp_path / 'shells.stl'}")
        assert enclosed_volume(shape.vert, shape.face) == pytest.approx(volume * ball.volume, rel=1e-4)
        assert bounds_solid(shape.vert, shape.face)
    pair = trimesh.util.concatenate([upright, beside])
    assert not bounds_solid(pair.vertices, pair.faces)
    trimesh.creation.icosphere(radius=3.0).export(tmp_path / "big.obj")
    with pytest.raises(ValueError, match="is it in millimetres"):
        make_indenter(f"mesh:{tmp_path / 'big.obj'}")


# --- the run


def test_one_way_press_feels_the_springs(springs, shell):
    result = press(PressOptions(**springs), progress=False)
    record, picture = result
    assert result.record is record and result.picture is picture is None
    assert record.depth[-1] == pytest.approx(1e-3)
    expected = hand_force(shell, record)
    assert np.linalg.norm(record.force[0]) == 0 and np.linalg.norm(expected[-1]) > 0.1
    assert np.allclose(record.force, expected, atol=1e-9)
    # the recorded nodes touch the sphere and do not enter it
    gap = np.linalg.norm(record.vert_xpos[-1] - (record.indenter_pos[-1] - [0, 3.5e-3, 0]), axis=1) - 3.5e-3
    assert gap.min() == pytest.approx(0, abs=1e-8)
    assert np.allclose(np.diff(record.time), 4e-3) and (record.nonconverged == 0).all()


def test_two_way_press_gives_way_to_the_force(springs, shell):
    record, _ = press(PressOptions(**{**springs, "hold": 0.2}, two_way=True), progress=False)
    # at rest the servo (50 kN/m) carries the springs' force
    lag = 1e-3 - record.depth[-1]
    assert lag == pytest.approx(np.linalg.norm(record.force[-1]) / 5e4, rel=0.02)
    assert np.allclose(record.force[-1], hand_force(shell, record)[-1], rtol=1e-3, atol=1e-6)


def test_two_way_plane_is_refused(springs):
    with pytest.raises(ValueError, match="a plane cannot be pushed .* geom:box"):
        press(PressOptions(**springs, indenter="geom:plane", two_way=True), progress=False)


# --- the files


def test_readings_are_read_back(synthetic_press, tmp_path):
    write_readings(synthetic_press, tmp_path / "readings.csv")
    with open(tmp_path / "readings.csv") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "time_s",
        "depth_m",
        "force_x_N",
        "force_y_N",
        "force_z_N",
        *[f"e{i}" for i in range(1, 20)],
        "pdc",
        "pac",
        "tdc",
        "tac",
        "nonconverged",
        "tier",
    ]
    assert len(rows) == 12
    assert np.allclose([float(row["force_y_N"]) for row in rows], synthetic_press.force[:, 1], rtol=1e-8)
    assert np.array_equal([[float(row[name]) for name in CHANNELS] for row in rows], synthetic_press.counts)
    assert (
        rows[-1]["nonconverged"] == "1"
        and rows[-1]["tier"] == "full"
        and list(tmp_path.iterdir()) == [tmp_path / "readings.csv"]
    )


def test_skin_is_read_back(synthetic_press, tmp_path):
    write_skin(synthetic_press, tmp_path / "skin.h5")
    with h5py.File(tmp_path / "skin.h5") as file:
        assert file["vert_xpos"].dtype == np.float32 and file["vert_xpos"].attrs["unit"] == "m"
        assert np.array_equal(file["vert_xpos"], synthetic_press.vert_xpos)
        assert np.array_equal(file["elem"], synthetic_press.geometry.elem)
        assert np.array_equal(file["outer_face"], synthetic_press.geometry.outer_face)
        assert tuple(file["counts"].attrs["names"]) == CHANNELS
        assert json.loads(file.attrs["parameters"])["depth"] == 1.5e-3
        assert json.loads(file.attrs["versions"])["mujoco"] == mujoco.__version__


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.csv"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("new")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_record_refuses_wrong_shapes(synthetic_press):
    import dataclasses

    with pytest.raises(
        ValueError, match=r"counts of a press with 12 saved steps has shape \(12, 22\): \(12, 23\) is needed"
    ):
        dataclasses.replace(synthetic_press, counts=np.zeros((12, 22)))


def test_the_table_has_force_channels_and_failures(synthetic_press):
    text = report.table(synthetic_press, ["a.csv"])
    peak = 4 / 3 * 1.7e6 * np.sqrt(3.5e-3) * 1.5e-3**1.5
    assert (
        f"{peak:.3f} N at 1.500 mm" in text
        and "PDC         +300 counts" in text
        and "1 did not converge" in text
        and "a.csv" in text
    )
    first = np.argmax(np.abs(synthetic_press.electrode_change[-1]))
    assert f"electrodes  E{first + 1} " in text


def test_what_is_shown_is_the_moment_of_the_peak_force(springs):
    """A sphere that slides off the skin: readings, picture and MuJoCo's render are of one step in contact."""

    def seen(model, data):
        return data.time, data.mocap_pos[0].copy()

    far = dict(slide=30e-3, slide_direction=(-1, 0, 0), speed=0.05, timestep=1e-2)
    record, (time, pos) = press(PressOptions(**springs | far), render=seen, progress=False)
    force = np.linalg.norm(record.force, axis=1)
    assert force[-1] == 0 and force[record.peak] > 0.999 * force.max() > 0
    assert record.peak < len(force) - 1 and time == pytest.approx(record.time[record.peak])
    np.testing.assert_allclose(pos, record.indenter_pos[record.peak], atol=1e-12)
    counts = record.counts.copy()
    counts[record.peak, 4] += 77
    text = report.table(dataclasses.replace(record, counts=counts))
    assert "electrodes  E5 +77" in text and f"N at {1e3 * record.depth[record.peak]:.3f} mm" in text


def colors(image):
    """How many distinct colours, in steps of 1/16, cover at least 20 pixels."""
    _, count = np.unique((image[..., :3] * 16).astype(int).reshape(-1, 3), axis=0, return_counts=True)
    return (count >= 20).sum()


def test_a_picture_without_gl_shows_all_surfaces(synthetic_press, tmp_path):
    report.write_picture(synthetic_press, tmp_path / "press.png")
    image = imread(tmp_path / "press.png")
    # the surfaces, upper left: skin, dimple and indenter each bring their shades; a blank panel has black and
    # white
    assert colors(image[60:480, : image.shape[1] // 2]) > 40
    assert colors(image[60:480, image.shape[1] // 2 :]) > 20


def test_no_gl_library_means_no_render(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert offscreen.find_gl() is None
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setattr(offscreen, "_works", lambda gl: False)
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera name='press'/></worldbody></mujoco>")
    assert offscreen.find_gl() is None and render(model, mujoco.MjData(model)) is None
    with pytest.raises(ValueError, match="no GL library to render with: install libosmesa6"):
        offscreen.Offscreen(model, 32, 32, None)


def test_probe_rejects_a_library_that_is_not_there():
    assert not offscreen._works("nosuchlibrary")


def test_render_shows_skin_and_indenter(springs):
    if offscreen.find_gl() is None:
        pytest.skip("no GL library here: nothing to render with")
    _, picture = press(PressOptions(**springs), render=render, progress=False)
    assert picture.shape == (640, 900, 3) and colors(picture / 255) > 20
    green = (picture[..., 1] > 1.3 * picture[..., 0]) & (picture[..., 1] > 1.3 * picture[..., 2])
    orange = (picture[..., 0] > 1.3 * picture[..., 1]) & (picture[..., 0] > 1.5 * picture[..., 2])
    assert green.mean() > 0.05 and orange.mean() > 0.005


@pytest.mark.parametrize(
    "skin",
    [
        {"fill_volume": 1e-7},
        *(
            pytest.param(s, marks=pytest.mark.slow)
            for s in ({"rest_pressure": 3000.0}, {"fill_volume": -5e-8})
        ),
    ],
)
def test_a_filled_skin_is_met_where_its_filling_holds_it(skin):
    record, _ = press(PressOptions(skin="coarse", depth=2e-4, options={"skin": skin}), progress=False)
    force = np.linalg.norm(record.force, axis=1)
    assert record.depth[0] < 0 and force[0] == 0  # 5 um before first touch
    touched = record.depth > 5e-5
    assert touched.sum() > 2 and (force[touched] > 0.01).all() and (np.diff(force[touched]) >= 0).all()


@pytest.mark.parametrize("name, tip", [("cube_14mm", 0.0), ("geom:box:2mm,3mm,4mm", 4e-3)])
def test_frames_are_at_tips_and_centres_of_geoms(name, tip):
    """As docs/howto/file_formats.md says of `indenter_pos`."""
    assert make_indenter(name).vert[:, 1].max() == pytest.approx(tip, abs=1e-12)
