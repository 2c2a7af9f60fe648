"""The folder for MuJoCo Menagerie: what its checks ask of one (`test/model_dir_test.py`, `test/model_test.py`
and `format_xml.py` there), and that the model is this sensor."""

import importlib.util
import re
import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
import pytest

from biotac_mj.geometry import load_skin


@pytest.fixture(scope="module")
def folder(repo, tmp_path_factory):
    spec = importlib.util.spec_from_file_location("menagerie", repo / "scripts" / "make_menagerie.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.write_folder(tmp_path_factory.mktemp("menagerie"))


def test_it_has_what_a_folder_there_has(folder):
    for name in ("README.md", "LICENSE", "CHANGELOG.md", "scene.xml", "biotac.xml"):
        text = (folder / name).read_text()
        assert text.endswith("\n") and not text.endswith("\n\n"), name
        assert not re.search(r"[ \t]+$|\r", text, re.MULTILINE), name
    assert "Apache License" in (folder / "LICENSE").read_text()


@pytest.mark.parametrize("name", ["biotac.xml", "scene.xml"])
def test_its_xml_is_written_as_theirs(folder, name):
    """Two spaces a level, 120 columns, no space before a slash; a tag's line is broken where it is too long
    alone."""
    text = (folder / name).read_text()
    depth, lines = 0, text.splitlines()
    for i, line in enumerate(lines):
        assert len(line) <= 120 and " />" not in line and "'" not in line, line
        tag = line.strip()
        if not tag:
            continue
        goes_on = not lines[i - 1].endswith(">") and lines[i - 1].strip() and i > 0
        depth -= tag.startswith("</")
        assert len(line) - len(line.lstrip()) == 2 * (depth + bool(goes_on)), line
        if goes_on:
            assert len(lines[i - 1]) + 1 + len(tag.split('" ')[0]) > 118, line
        opens = re.match(r"<\w[^/]*>$", tag) is not None
        depth += opens
    assert depth == 0 and ElementTree.fromstring(text).tag == "mujoco"


def test_its_scene_steps_without_a_warning(folder):
    """With MuJoCo alone: a ball falls onto the pad's side and rests somewhere, for a second."""
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    while data.time < 1.0:
        mujoco.mj_step(model, data)
    assert not any(data.warning.number) and model.nplugin == 0
    assert data.body("ball").xpos[2] > -0.03


def test_the_model_is_this_sensor(repo, folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "biotac.xml"))
    whole = mujoco.MjModel.from_xml_path(str(repo / "biotac_mj" / "mjcf" / "biotac.xml"))
    assert model.body("biotac").mass == whole.body("core").mass
    np.testing.assert_allclose(model.body("biotac").inertia, whole.body("core").inertia, rtol=1e-6)
    for i in range(19):
        np.testing.assert_allclose(model.site(f"e{i + 1}").pos, whole.site(f"e{i + 1}").pos, atol=6e-6)
    skin = load_skin("coarse")
    outer = skin.vert[np.unique(skin.outer_face)]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom, mesh = model.geom("skin_visual").id, model.mesh("skin")
    vert = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    vert = vert @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    np.testing.assert_allclose([vert.min(0), vert.max(0)], [outer.min(0), outer.max(0)], atol=1e-5)
