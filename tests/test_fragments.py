"""Fragments of the documentation, which a reader puts into a program: blocks marked `py`, `console`, `bash`.

Those of Python run where the names that they take are there; commands are understood. What cannot run here is
named, with what it lacks."""

import pathlib
import re
import shlex

import mujoco
import pytest
from test_documents import DOCUMENTS, REPO

import biotac_mj
from biotac_mj import cli
from biotac_mj.data import TactileSet, export_mujoco
from biotac_mj.view import find_gl

_BLOCK = re.compile(r"^```(py|python|console|bash)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = [p for p in sorted((REPO / "docs").rglob("*.md")) if p.parent.name != "lab" and p.name != "api.md"]
# page and beginning of a block -> what it lacks
LACKS = {
    (
        "effects.md",
        'biotac_mj.attach(spec, site="tip", effects=',
    ): "a report, which your_sensor.md makes and uses",
    ("your_sensor.md", "biotac_mj.attach(spec"): "a report, which the page's sh blocks make and use",
    ("isaaclab.md", "tip = robot"): "Isaac Lab",
    ("ros.md", "from biotac_mj.neighbours.ros"): "ROS; test_ros.py has doubles of rclpy and rospy",
    ("train.md", "biotac_mj.attach(spec"): "three choices for one finger; test_attach.py has them",
    ("your_hand.md", "spec = mujoco.MjSpec.from_file"): "MuJoCo Menagerie; test_menagerie.py has it",
    ("your_hand.md", "left = "): "MuJoCo Menagerie; test_menagerie.py has it",
    ("verdict.md", "from biotac_mj.discrepancy"): "minutes; test_samples.py runs the verb of it",
}

SCENE = """<mujoco><worldbody>
  <body name="index_tip"><joint/><geom size="0.004" mass="0.01" contype="0" conaffinity="0"/>
    <site name="fingertip" quat="1 -1 0 0"/><site name="tip" pos="0 0.1 0" quat="1 -1 0 0"/></body>
  <body pos="-0.01 0 0.0135"><joint type="slide" axis="0 0 1"/><geom size="0.005" mass="0.1"/></body>
  <geom name="mug" size="0.005" pos="0.3 0 0"/><geom name="block" size="0.005" pos="0.4 0 0"/>
  <geom name="file" size="0.005" pos="0.5 0 0"/><geom name="thing" size="0.005" pos="0.6 0 0"/>
</worldbody></mujoco>"""


def fragments(page):
    """(language, line, text) of a page's blocks that no other test runs."""
    text, whole = page.read_text(), page in DOCUMENTS
    for match in _BLOCK.finditer(text):
        if not (match[1] == "python" and whole):
            yield match[1], text.count("\n", 0, match.start(2)), match[2]


def lacks(page, text):
    """What a block lacks, None: nothing."""
    found = [why for (name, begin), why in LACKS.items() if page.name == name and text.startswith(begin)]
    return found[0] if found else None


def test_what_is_left_out_is_in_the_pages():
    blocks = [(page, text) for page in PAGES for _, _, text in fragments(page)]
    for (name, begin), why in LACKS.items():
        assert any(page.name == name and text.startswith(begin) for page, text in blocks), (name, begin, why)


def test_commands_of_all_blocks_are_understood():
    """Verbs, options and choices of every line that begins with biotac, comments left out."""
    shown = []
    for page in [REPO / "README.md", *PAGES]:
        for language, _, text in fragments(page):
            if language in ("console", "bash"):
                shown += re.findall(r"^(?:\$ )?(?:\.venv/bin/)?biotac (.*)$", text, re.M)
    assert len(shown) > 20
    for line in shown:
        try:
            cli.parser().parse_args(shlex.split(line, comments=True))
        except (SystemExit, ValueError) as error:
            pytest.fail(f"biotac {line}: {error}")


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(f[0] in ("py", "python") for f in fragments(p))], ids=lambda p: p.name
)
def test_fragments_run(page, tmp_path, monkeypatch):
    """In one session for a page, each with a new spec to attach to and a model that has a BioTac."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["data", "samples", "samples", "--quiet"]) == 0
    pathlib.Path("out").mkdir()
    pathlib.Path("samples/set").rename("out/small")
    with TactileSet("out/small") as data:
        export_mujoco(data, "out/mujoco", progress=False)
    other = mujoco.MjSpec.from_string(SCENE)
    handle = biotac_mj.attach(other, site="fingertip", skin="coarse", tier="condensed")
    model = other.compile()
    session = {"biotac_mj": biotac_mj, "mujoco": mujoco, "model": model, "data": mujoco.MjData(model)}
    session |= {"handle": handle, "camera": mujoco.MjvCamera()}
    for language, line, text in fragments(page):
        if language not in ("py", "python") or lacks(page, text):
            continue
        if "Offscreen" in text and find_gl() is None:
            pytest.skip("no GL library to render with")
        session["spec"] = mujoco.MjSpec.from_string(SCENE)
        exec(compile("\n" * line + text, str(page), "exec"), session)
