"""README, tutorials and how-to pages do what they say: their blocks run in order, in one folder."""

import json
import os
import pathlib
import re
import subprocess
import sys

import pytest

import biotac_mj

REPO = pathlib.Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```(sh|python|\{code-cell\}[^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
DOCUMENTS = [REPO / "README.md", *sorted((REPO / "docs" / "tutorials").glob("*.md"))]
DOCUMENTS += [p for p in sorted((REPO / "docs" / "howto").glob("*.md")) if BLOCK.search(p.read_text())]
NEEDS = {"ros.md": "rosbags", "mjlab.md": "mjlab", "isaaclab.md": "mujoco_warp"}
MINUTES = 20  # more than any document takes

# All Python of a document is one session, as in a notebook. An error names the document and its line.
RUNNER = """
import json, subprocess, sys
name, blocks = json.loads(sys.stdin.read())
session = {"__name__": "__main__"}
for language, line, text in blocks:
    if language == "sh":
        trap = f"trap 'echo {name}:$((LINENO + {line - 1})): $BASH_COMMAND >&2' ERR\\n"
        done = subprocess.run(["bash", "-eE", "-c", trap + text], stdin=subprocess.DEVNULL)
        if done.returncode:
            sys.exit(1)
    else:
        exec(compile("\\n" * line + text, name, "exec"), session)
"""


def blocks(text):
    """(language, lines before its first, text) of each block that runs, a cell's options left out."""
    found = []
    for match in BLOCK.finditer(text):
        language, body = match.groups()
        before = text.count("\n", 0, match.start(2))
        body = re.sub(r"^(:[\w-]+:.*|---)$", "", body, flags=re.MULTILINE)
        found.append(("sh" if language == "sh" else "python", before, body))
    return found


def run(name, found, folder):
    """What a document's blocks leave, run in a folder with the commands of this Python's environment."""
    paths = {
        "PATH": f"{pathlib.Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(
            filter(None, [str(pathlib.Path(biotac_mj.__file__).parents[1]), os.environ.get("PYTHONPATH")])
        ),
    }
    return subprocess.run(
        [sys.executable, "-c", RUNNER],
        input=json.dumps([name, found]),
        cwd=folder,
        env={**os.environ, **paths},
        capture_output=True,
        text=True,
        timeout=60 * MINUTES,
    )


def test_a_block_that_fails_is_named_with_its_line(tmp_path):
    text = "# A\n\n```sh\necho a > f\n```\n```console\nfalse\n```\n"
    text += "```{code-cell} python\n:tags: [x]\nn = 1\n```\n"
    found = blocks(text)
    assert [(kind, line) for kind, line, _ in found] == [("sh", 3), ("python", 9)]
    assert run("a.md", found, tmp_path).returncode == 0 and (tmp_path / "f").read_text() == "a\n"
    for last, where in (
        ("```python\nassert open('f').read()\n\nassert n == 2\n```\n", r'File "a.md", line 16'),
        ("```sh\ntrue\nls nowhere\n```\n", r"a.md:15: ls nowhere"),
    ):
        done = run("a.md", blocks(text + last), tmp_path)
        assert done.returncode and re.search(where, done.stderr), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_blocks_run_in_order(path, tmp_path):
    if path.name in NEEDS:
        pytest.importorskip(NEEDS[path.name], reason=f"{path.name} needs {NEEDS[path.name]}")
    name = str(path.relative_to(REPO))
    found = blocks(path.read_text())
    assert found, f"{name} has no block marked sh or python"
    done = run(name, found, tmp_path)
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
