"""README, tutorials and how-to pages do what they say: their blocks run in order, in one folder, and print
what
stands in the page."""

import pathlib
import re

import pytest
from documents import BLOCK, agree, blocks, pictures, printed, run, with_output

REPO = pathlib.Path(__file__).resolve().parents[1]
DOCUMENTS = [REPO / "README.md", REPO / "docs" / "start.md", *sorted((REPO / "docs/tutorials").glob("*.md"))]
DOCUMENTS += [p for p in sorted((REPO / "docs" / "howto").glob("*.md")) if BLOCK.search(p.read_text())]
NEEDS = {"ros.md": "rosbags", "mjlab.md": "mjlab", "isaaclab.md": "mujoco_warp", "mjx.md": "jax"}


def test_a_block_that_fails_is_named_with_its_line(tmp_path):
    text = "# A\n\n```sh\necho a > f\n```\n```console\nfalse\n```\n```python\nn = 1\n```\n"
    found = blocks(text)
    assert [(kind, line) for kind, line, *_ in found] == [("sh", 3), ("python", 9)]
    assert run("a.md", found, tmp_path).returncode == 0 and (tmp_path / "f").read_text() == "a\n"
    for last, where in (
        ("```python\nassert open('f').read()\n\nassert n == 2\n```\n", r'File "a.md", line 15'),
        ("```sh\ntrue\nls nowhere\n```\n", r"a.md:14: ls nowhere"),
    ):
        done = run("a.md", blocks(text + last), tmp_path)
        assert done.returncode and re.search(where, done.stderr), done.stderr


def test_what_a_block_prints_is_written_after_it(tmp_path):
    text = "```python\nprint('a', 1 / 3)\n```\n\n```text\nold\n```\n\nWords.\n\n```python\nn = 2\n```\n"
    done = run("a.md", blocks(text), tmp_path)
    page = with_output(text, printed(done))
    assert page == (
        "```python\nprint('a', 1 / 3)\n```\n\n```text\na 0.3333333333333333\n```\n\nWords.\n\n```python\nn "
        "= 2\n```\n"
    )
    assert [out for *_, out in blocks(page)] == ["a 0.3333333333333333\n", ""]
    assert pictures("![x](a.png) ![y](../b.png)") == ["a.png"]


@pytest.mark.parametrize(
    "written, got, same",
    [
        ("force 1.00 N", "force 1.02 N", True),
        ("force 1.00 N", "force 1.10 N", False),
        ("E1 +333", "E2 +333", False),
        ("[0.0 -1]", "[0.0  -1]", True),
        ("a 1", "a", False),
    ],
)
def test_outputs_agree_to_what_machines_differ_by(written, got, same):
    assert agree(written, got) is same


@pytest.mark.slow
@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_blocks_run_in_order(path, tmp_path):
    if path.name in NEEDS:
        pytest.importorskip(NEEDS[path.name], reason=f"{path.name} needs {NEEDS[path.name]}")
    name, text = str(path.relative_to(REPO)), path.read_text()
    found = blocks(text)
    assert found, f"{name} has no block marked sh or python"
    done = run(name, found, tmp_path)
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    for (_, line, _, written), got in zip(found, printed(done), strict=True):
        assert agree(written, got), f"{name}, line {line}: prints\n{got}\nand the page has\n{written}"
    for picture in pictures(text):
        assert (path.parent / picture).is_file()
