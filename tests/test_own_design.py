"""Pads of one's own: `biotac design new`, and what they give in a simulation."""

import json
import warnings

import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure
from meshing import write_obj
from readers_files import GROUND, SIX

import biotac_mj
from biotac_mj.cli import main
from biotac_mj.data.generation.synthetic_sensor import SensorVariation
from biotac_mj.geometry.design import Design, read_design
from biotac_mj.geometry.making.pads import block, dome_core, dome_shell, plate
from biotac_mj.geometry.skins import place_of
from biotac_mj.geometry.tet_mesh import check_closed, enclosed_volume
from biotac_mj.press import PressOptions, build_scene, plan_path, press, report
from biotac_mj.press.indenter import make_indenter
from biotac_mj.sensor.own_design import PadShape, new_design
from biotac_mj.view import window

DOMED = {"dome": (9.0, 9.0, 9.0), "core": (6.0, 6.0, 6.0)}
DOME = PadShape(**DOMED, edge=2.4)


def pushed(folder, start, depth, **more):
    """(handle, model, data) of a ball on a pad, led from start [m] along +y."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 0.02, np.zeros(3)
    body = spec.worldbody.add_body(name="ball", mocap=True)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[4e-3, 0, 0])
    more = {"tier": "condensed", "coupling": "one-way", "on_error": "raise"} | more
    handle = biotac_mj.attach(spec, body="world", design=str(folder), **more)
    model = spec.compile()
    data = mujoco.MjData(model)
    for step in range(9):
        data.mocap_pos[0] = [0, start - 1e-4 + (depth + 1e-4) * min(step, 6) / 6, 0]
        mujoco.mj_step(model, data)
    return handle, model, data


def test_shapes_of_pads_are_closed_and_have_their_volume():
    vert, face = dome_core((np.array([6.0, 6.0, 6.0]), 0.0), 30)
    check_closed(face)
    assert enclosed_volume(vert, face) == pytest.approx(2 / 3 * np.pi * 6**3, rel=0.01)
    shell = dome_shell((np.array([9.0, 9.0, 9.0]), 0.0), (np.array([8.0, 8.0, 8.0]), 0.0), 16).check()
    assert shell.volumes.sum() == pytest.approx(2 / 3 * np.pi * (9**3 - 8**3), rel=0.01)
    assert block((10, 4, 8), (3, 2, 3)).check().volumes.sum() == pytest.approx(320)
    vert, face = plate([[-3, -2], [3, -2], [3, 2], [-3, 2]], 1.0)
    check_closed(face)
    assert enclosed_volume(vert, face) == pytest.approx(24)


def test_a_dome_of_six_electrodes_feels_where_it_is_pressed(tmp_path):
    design = new_design(tmp_path / "dome", DOME, SIX, GROUND)
    assert read_design(tmp_path / "dome") == design and design.discs == (
        *(f"E{i}" for i in range(1, 7)),
        "X1",
        "X2",
    )
    handle, _, data = pushed(tmp_path / "dome", -13e-3, 1.2e-3, readings={"noise": False})
    rest = np.array(design.sensors["ideal"]["rest"])
    change = handle.read(data, "electrodes") - rest
    assert change.shape == (6,) and change.argmin() == 0 and change[0] < -20
    np.testing.assert_allclose(change[3], change[4], atol=6)  # on both sides of the midline
    assert handle.read(data, "contact_force")[1] > 0.1 and handle.read(data, "pdc")[0] > 2010
    assert handle.read(data, "status")[0] == 1 and set(handle.read(data)) >= {"electrodes", "pac"}


def test_sensors_written_into_a_pad_s_design_are_its_own(tmp_path):
    new_design(tmp_path / "dome", DOME, SIX, GROUND)
    path = tmp_path / "dome" / "design.json"
    written = json.loads(path.read_text()) | {"sensor": "mine"}
    written["sensors"]["mine"] = {"rest": [3000, 3100, 3200, 3100, 3000, 2900]}
    path.write_text(json.dumps(written))
    assert biotac_mj.load_skin(tmp_path / "dome").design == read_design(tmp_path / "dome")
    handle, _, data = pushed(tmp_path / "dome", -20e-3, 0.0, readings={"noise": False})
    rest = written["sensors"]["mine"]["rest"]
    np.testing.assert_allclose(handle.read(data, "electrodes"), rest, atol=2)
    rest[0] -= 100  # and edited again in the same process
    path.write_text(json.dumps(written))
    handle, _, data = pushed(tmp_path / "dome", -20e-3, 0.0, readings={"noise": False})
    np.testing.assert_allclose(handle.read(data, "electrodes"), rest, atol=2)
    path.write_text(json.dumps(written | {"slots": written["slots"] + 2}))
    with pytest.raises(ValueError, match="is not the design that default.npz was made of: .* sensors alone"):
        biotac_mj.load_skin(tmp_path / "dome")


def test_a_flat_pad_without_electrodes_gives_force_and_depth(tmp_path, capsys):
    assert (
        main(["design", "new", str(tmp_path / "flat"), "--block", "20mm", "20mm", "6mm", "--edge", "3mm"])
        == 0
    )
    assert "solid, leave the liquid out: liquid=False; no electrodes" in " ".join(
        capsys.readouterr().out.split()
    )
    pad, model, data = pushed(tmp_path / "flat", -10e-3, 1e-3, liquid=False)
    skin = biotac_mj.load_skin(pad.config.skin)
    outer = np.unique(skin.outer_face)
    depth = (pad.vert_xpos(model, data)[outer] - skin.vert[outer])[:, 1]
    under = np.hypot(*skin.vert[outer][:, [0, 2]].T).argmin()
    assert depth.max() == pytest.approx(1e-3, rel=0.25) and depth[under] == depth.max()
    force = pad.read(data, "contact_force")[1]
    # of a ball on a half space; this one lies on a stiff backing, which makes it stiffer
    hertz = 4 / 3 * 1.55e6 / (1 - 0.316**2) * np.sqrt(4e-3) * 1e-3**1.5
    assert hertz < force < 1.8 * hertz
    assert "electrodes" not in pad.read(data) and biotac_mj.load_skin(tmp_path / "flat").name == skin.name
    with pytest.raises(ValueError, match="a pad flat .0 electrodes. has no channel 'electrodes': choose one"):
        pad.read(data, "electrodes")


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pads") / "flat"
    new_design(folder, PadShape(block=(20.0, 14.0, 6.0), edge=3.0))
    return folder


def test_a_press_on_a_pad_without_electrodes_shows_what_it_has(flat, tmp_path):
    options = PressOptions(
        design=flat, liquid=False, tier="condensed", location=(0.0, 0.0), depth=5e-4, timestep=2e-2
    )
    record = press(options, progress=False).record
    text = report.table(record)
    assert "skin moved" in text and "kPa at most" in text and "E1" not in text and "PDC" not in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report.write_picture(record, tmp_path / "press.png")
    axes = Figure().add_subplot()
    report.draw_pressure(axes, record, record.peak)
    assert axes.get_xlim() == pytest.approx((-10, 10)) and axes.get_ylim() == pytest.approx((-7, 7))


def test_a_block_lies_on_a_backing_of_its_shape(flat):
    skin = biotac_mj.load_skin(flat)
    backing = skin.core_vert if len(skin.core_face) else skin.nail_vert
    corners = np.unique(np.abs(backing[:, [0, 2]]).round(6), axis=0)
    np.testing.assert_allclose(corners, [[0, 0], [10.5e-3, 7.35e-3]], atol=1e-6)


def test_all_of_a_block_s_front_may_touch_at_once(tmp_path):
    """With cells of 1.2 mm, 1200 nodes of this front are more than a contact of the condensed tier has."""
    new_design(tmp_path / "wide", PadShape(block=(22.0, 16.0, 4.0)))
    spec = mujoco.MjSpec()
    spec.option.gravity = np.zeros(3)
    body = spec.worldbody.add_body(name="plate", mocap=True)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.015, 0.01, 0.015])
    pad = biotac_mj.attach(
        spec, body="world", design=str(tmp_path / "wide"), liquid=False, tier="condensed", coupling="one-way"
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    for depth in (-1e-4, 0.0, 2e-5, 4e-5):
        data.mocap_pos[0] = [0, -0.014 + depth, 0]
        mujoco.mj_step(model, data)
    assert pad.read(data, "status")[0] == 1
    # between a column that is free at its sides and a layer that is held there
    young, nu, strain = 1.55e6, 0.316, 4e-5 / 4e-3
    layer = young * (1 - nu) / (1 + nu) / (1 - 2 * nu)
    force = pad.read(data, "contact_force")[1] / (22e-3 * 16e-3 * strain)
    assert young < force < layer


def test_a_press_goes_to_the_middle_of_a_pad_unless_told(tmp_path):
    cube = block((12, 6, 12), (3, 2, 3))
    mesh = written(tmp_path / "aside.tet", cube.vert + [9, 0, 0], cube.elem)
    new_design(tmp_path / "aside", PadShape(mesh=mesh))
    skin, shape = biotac_mj.load_skin(tmp_path / "aside"), make_indenter("sphere_7mm")
    options = PressOptions(design=tmp_path / "aside", liquid=False)
    assert options.location is None
    np.testing.assert_allclose(plan_path(skin, shape, options).start[0], 9e-3, atol=1e-6)
    assert place_of(biotac_mj.load_skin("coarse")) == (-12e-3, 0.0)
    spec, _ = window.build_scene(tmp_path / "aside", liquid=False)
    assert spec.body("ball").pos[0] == pytest.approx(9e-3)


def test_a_map_of_a_dome_has_one_scale():
    angle = np.linspace(0, 2 * np.pi, 9)
    ring = 1e-3 * np.stack([3 * np.cos(angle), np.full(9, -5.0), 3 * np.sin(angle)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(report.unroll(ring, Design("a", "b")), axis=1), 3)


def test_a_map_of_another_cylinder_is_unrolled_by_its_radius():
    own = Design(
        "c",
        "d",
        [[0, 0, -3.0], [0, 3.0, 0]],
        [[0.0, -1.0]],
        sensor="ideal",
        sensors={"ideal": {"rest": [1, 2]}},
    )
    side = report.unroll(np.array([[0, 0, 3e-3]]), own)
    np.testing.assert_allclose(side, [[0, 3 * np.pi / 2]])


@pytest.mark.parametrize("indenter", ["sphere_7mm", "geom:sphere:0.05"])
def test_the_picture_of_a_press_shows_pad_and_indenter(tmp_path, indenter):
    new_design(tmp_path / "high", PadShape(block=(12.0, 12.0, 14.0), edge=4.0))
    options = PressOptions(design=tmp_path / "high", liquid=False, location=(0.0, 0.0), indenter=indenter)
    skin, shape = biotac_mj.load_skin(tmp_path / "high"), make_indenter(indenter)
    path = plan_path(skin, shape, options)
    model = build_scene(shape, path, options)[0].compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    camera = data.camera("press")
    ball = shape.vert + path.start if indenter == "sphere_7mm" else skin.vert  # the other is too large
    seen = (np.concatenate([skin.vert, ball]) - camera.xpos) @ camera.xmat.reshape(3, 3)
    half = np.tan(np.radians(model.camera("press").fovy / 2))
    assert (np.abs(seen[:, 1]) < -half * seen[:, 2]).all()
    assert (np.abs(seen[:, 0]) < -900 / 640 * half * seen[:, 2]).all() and seen[:, 2].min() > -0.15


def test_composer_takes_a_design_s_own_skin(flat, tmp_path):
    pytest.importorskip("dm_control")
    from biotac_mj.tasks import BioTac

    new_design(tmp_path / "dome", DOME, SIX, GROUND)
    entity = BioTac(design=str(tmp_path / "dome"))
    assert entity.handle.design.name == "dome" and len(entity.sensor.rest) == 6
    with pytest.raises(ValueError, match="a pad flat .0 electrodes. has no readings to observe"):
        BioTac(design=str(flat), liquid=False)


def written(path, vert, elem):
    lines = [f"tet {len(vert)} {len(elem)}", *(f"v {x:g} {y:g} {z:g}" for x, y, z in 1e-3 * np.asarray(vert))]
    path.write_text("\n".join([*lines, *("t " + " ".join(map(str, row)) for row in elem)]))
    return path


def test_meshes_that_are_no_pad_are_refused(tmp_path):
    cube = block((10, 4, 8), (3, 2, 3))
    up = written(tmp_path / "up.tet", cube.vert + [0, 8, 0], cube.elem)
    with pytest.raises(ValueError, match="the mesh ends at y = 8 mm, and a pad is held on the plane y = 0"):
        new_design(tmp_path / "pad", PadShape(mesh=up))
    ridge = written(tmp_path / "ridge.tet", cube.vert - [0, 1, 0] * (5 + cube.vert[:, :1]), cube.elem)
    with pytest.raises(ValueError, match="the mesh meets the plane y = 0 in a point or a line"):
        new_design(tmp_path / "pad", PadShape(mesh=ridge))
    pair = np.r_[cube.vert, cube.vert + [30, 0, 0]], np.r_[cube.elem, cube.elem + len(cube.vert)]
    with pytest.raises(ValueError, match="the mesh has 2 separate parts"):
        new_design(tmp_path / "pad", PadShape(mesh=written(tmp_path / "two.tet", *pair)))
    shell = dome_shell((np.array([9.0, 9.0, 9.0]), 0.0), (np.array([7.5, 7.5, 7.5]), 0.0), 6)
    inside = PadShape(mesh=written(tmp_path / "shell.tet", shell.vert, shell.elem), core=(8.4, 8.4, 8.4))
    with pytest.raises(ValueError, match="the mesh is a shell: give --core"):
        new_design(tmp_path / "pad", PadShape(mesh=tmp_path / "shell.tet"))
    with pytest.raises(ValueError, match="the core reaches .* mm into the skin: no liquid fits"):
        new_design(tmp_path / "pad", inside, SIX, GROUND)
    core = tmp_path / "core.obj"
    write_obj(
        core, np.array([[0, -6, 0], [6, 0, 0], [-6, 0, 0], [0, 0, 6]]), np.array([[0, 1, 2], [0, 3, 1]])
    )
    with pytest.raises(
        ValueError, match="the core's largest dimension is 1.2e.04 mm, .* is it in millimetres"
    ):
        new_design(tmp_path / "pad", PadShape(mesh=tmp_path / "shell.tet", core=core), SIX, GROUND)
    vert, face = dome_core((np.array([6.0, 6.0, 6.0]), 0.0), 12)
    write_obj(core, 1e-3 * (vert + [0, 3, 0]), face)
    with pytest.raises(ValueError, match="the core reaches 3 mm behind the plane y = 0: cut it there"):
        new_design(tmp_path / "pad", PadShape(mesh=tmp_path / "shell.tet", core=core), SIX, GROUND)
    assert not (tmp_path / "pad").exists()


def test_a_mesh_of_any_outline_is_held_at_its_whole_rim(tmp_path):
    """A box open to the backing; an ellipse of its width would hold the middles of its sides only."""
    x, z = [-8, -6, 0, 6, 8], [-6, -4, 0, 4, 6]
    full = block((16, 4, 12), (4, 2, 4))
    nodes = np.stack([np.interp(full.vert[:, 0], np.linspace(-8, 8, 5), x), full.vert[:, 1],
                      np.interp(full.vert[:, 2], np.linspace(-6, 6, 5), z)], axis=1)  # fmt: skip
    centre = nodes[full.elem].mean(1)
    hollow = (np.abs(centre[:, 0]) < 6) & (np.abs(centre[:, 2]) < 4) & (centre[:, 1] > -2)
    kept, elem = np.unique(full.elem[~hollow], return_inverse=True)
    mesh = written(tmp_path / "box.tet", nodes[kept], elem.reshape(-1, 4))
    vert = np.array([[i, j, k] for i in (-5, 5) for j in (-1.2, 0) for k in (-3, 3)])
    face = np.array([[0, 3, 1], [0, 2, 3], [4, 7, 6], [4, 5, 7], [0, 5, 4], [0, 1, 5], [2, 7, 3], [2, 6, 7],
                     [0, 6, 2], [0, 4, 6], [1, 7, 5], [1, 3, 7]])  # fmt: skip
    write_obj(tmp_path / "core.obj", 1e-3 * vert, face)
    places = [[i, k, -1.2] for i in (-3, 0, 3) for k in (-1.5, 1.5)]
    shape = PadShape(mesh=mesh, core=tmp_path / "core.obj")
    new_design(tmp_path / "box", shape, places, [[4.5, 0, -1.2], [-4.5, 0, -1.2]])
    skin = biotac_mj.load_skin(tmp_path / "box")
    back = np.flatnonzero(np.abs(skin.vert[:, 1]) < 1e-9)
    assert set(back) <= set(skin.fixed) and len(skin.inner_face)


def test_a_design_is_not_overwritten(tmp_path):
    flat = PadShape(block=(20.0, 20.0, 6.0), edge=6.0)
    new_design(tmp_path / "flat", flat)
    with pytest.raises(ValueError, match="flat/design.json is there already: give a new name"):
        new_design(tmp_path / "flat", flat)
    with pytest.raises(ValueError, match="biotac_sp' names no design of your own"):
        new_design(tmp_path / "biotac_sp", flat)


@pytest.mark.parametrize(
    "shape, places, said",
    [
        ({}, (), "a pad has one shape: give one of --dome, --block and --mesh"),
        ({"dome": (9.0, 9.0, 9.0)}, (), "a dome is a shell over a core with liquid between"),
        ({"block": (9.0, 9.0, 9.0), "core": (6.0, 6.0, 6.0)}, (), "a block is solid and has no core"),
        ({"dome": (9.0, 9.0, 9.0), "core": (8.0, 8.0, 8.0)}, (), "no liquid fits"),
        ({"block": (20.0, 20.0, 6.0)}, (SIX, GROUND), "electrodes feel the liquid .*, and this pad is solid"),
        (DOMED, (SIX, ()), "6 electrodes and 0 of excitation"),
        (DOMED, ([*SIX[:5], [40, 0, -5]], GROUND), "E6 is 34.3 mm off the core, and a disc is 1 mm wide"),
        (DOMED, (1e-3 * np.array(SIX), GROUND), "off the core, .*: are they in metres. give places .* in mm"),
        (DOMED, (SIX, 1e3 * np.array(GROUND)), "off the core, .*: are they in micrometres. give places"),
        (DOMED, ([*SIX[:5], [1, 0, 0]], GROUND), "E6 is 5 mm off the core"),  # on the backing is no liquid
        (DOMED, ([*SIX, [0, 0.6, -6]], GROUND), "E1 and E7 are 0.6 mm apart, and a disc is 1 mm wide"),
        ({"block": (2.0, 2.0, 2.0)}, (), "is 2 mm, not between 5 and 100 mm"),
        ({"block": (0.02, 0.02, 0.006)}, (), "is 0.02 mm, .*: was it scaled twice. multiply it by 1000"),
        ({"dome": (9e3,) * 3, "core": (6e3,) * 3}, (), "is 1.8e.04 mm, .*: is it in millimetres"),
    ],
)
def test_pads_that_cannot_be_are_refused(tmp_path, shape, places, said):
    with pytest.raises(ValueError, match=said):
        new_design(tmp_path / "pad", PadShape(**shape), *places)
    assert not (tmp_path / "pad").exists()


def test_a_synthetic_sensor_of_a_pad_rests_at_the_pad_s_counts(tmp_path):
    design = new_design(tmp_path / "dome", DOME, SIX, GROUND)
    variation = SensorVariation.draw(0, design)
    assert list(variation.sensor.rest) == design.sensors["ideal"]["rest"] and variation.mixing.shape == (6, 6)


def test_calibrate_s_own_data_are_of_the_design_of_its_skin(flat, tmp_path, capsys):
    """The path and the synthetic forces were those of a BioTac, whatever the skin."""
    out = str(tmp_path / "out")
    said = ["lab", "calibrate", "--synthetic", "--truth", "default", "--fit", "E", "--noise", "0", "--quiet"]
    settings = ["--no-liquid", "--no-truth-liquid", "--skin", str(flat), "--out", out]
    assert main([*said, *settings, "--material", '{"youngs_modulus": 1e6}']) == 0
    found = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert found["parameters"] == ["youngs_modulus"] and found["value"] == pytest.approx([1.55e6], rel=0.015)
    assert main([*said, *settings, "--truth-skin", "coarse"]) == 2
    assert "is of pad flat (0 electrodes), --truth-skin coarse of BioTac" in capsys.readouterr().err
    assert main(["lab", "compare", "--skin", "biotac_sp/coarse", "--count", "1"]) == 2
    assert "the configurations compared are the paper's of a BioTac" in capsys.readouterr().err


def test_a_design_is_shown_with_the_electrodes_places(capsys):
    assert main(["design", "show", "biotac"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    shown = {row[0]: row[1:] for row in rows}
    places = [[float(length) for length in shown[f"e{k}"]] for k in range(1, 20)]
    np.testing.assert_allclose(places, 1e3 * biotac_mj.load_skin("default").electrode_pos, atol=5.1e-3)
