"""Runs the code of a page in its order and writes what it prints and draws into the page.

    python scripts/documents.py README.md docs/tutorials/first_press.md

Blocks marked `sh`, `python` and `py` run, all of a page in one folder, its Python in one session. A `py`
block is a fragment of a program: it finds a new `spec`, with sites and geoms of the names that pages use, and
a `model` with its `data` and `handle`. `examples/` of the repository lies in the folder. What a block of
Python prints stands in the block marked `text` after it. A picture beside the page (`![...](name.png)`) is
what the code writes under that name. `tests/test_documents.py` runs the pages again and compares.
"""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile

import biotac_mj

__all__ = ["BLOCK", "agree", "blocks", "pictures", "printed", "run", "with_output"]

BLOCK = re.compile(r"^```(sh|python|py)\n(.*?)^```$(?:\n\n^```text\n(.*?)^```$)?", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
_MINUTES = 20  # more than any page takes

_SCENE = """<mujoco><worldbody>
  <body name="index_tip"><joint name="bend"/><geom size="0.004" mass="0.01" contype="0" conaffinity="0"/>
    <site name="fingertip" quat="1 -1 0 0"/><site name="tip" pos="0 0.1 0" quat="1 -1 0 0"/></body>
  <body pos="-0.01 0 0.0135"><joint type="slide" axis="0 0 1"/><geom size="0.005" mass="0.1"/></body>
  <geom name="mug" size="0.005" pos="0.3 0 0"/><geom name="block" size="0.005" pos="0.4 0 0"/>
  <geom name="file" size="0.005" pos="0.5 0 0"/><geom name="thing" size="0.005" pos="0.6 0 0"/>
</worldbody><actuator><motor joint="bend"/></actuator></mujoco>"""

# All Python of a page is one session, as in a notebook. An error names the page and its line.
_RUNNER = """
import contextlib, io, json, os, subprocess, sys
def give(session):
    import mujoco, biotac_mj
    new = lambda: mujoco.MjSpec.from_string(scene)
    if "spec" not in session:
        spec = new()
        handle = biotac_mj.attach(spec, site="fingertip", skin="coarse", tier="condensed")
        model = spec.compile()
        given = dict(mujoco=mujoco, biotac_mj=biotac_mj, model=model, handle=handle)
        given |= {"data": mujoco.MjData(model), "camera": mujoco.MjvCamera()}
        session.update(given | session)
    session["spec"] = new()
os.environ.setdefault("MPLBACKEND", "Agg")
name, blocks, scene = json.loads(sys.stdin.read())
session, printed = {"__name__": "__main__"}, []
for language, line, text, _ in blocks:
    said = io.StringIO()
    if language == "sh":
        trap = f"trap 'echo {name}:$((LINENO + {line - 1})): $BASH_COMMAND >&2' ERR\\n"
        done = subprocess.run(["bash", "-eE", "-c", trap + text], stdin=subprocess.DEVNULL, stdout=sys.stderr)
        if done.returncode:
            sys.exit(1)
    else:
        if language == "py":
            give(session)
        with contextlib.redirect_stdout(said):
            exec(compile("\\n" * line + text, name, "exec"), session)
    printed.append(said.getvalue())
print(json.dumps(printed))
"""


def blocks(text: str) -> list[tuple[str, int, str, str]]:
    """(language, lines before its first, text, output that is written) of each block that runs."""
    return [
        (match[1], text.count("\n", 0, match.start(2)), match[2], match[3] or "")
        for match in BLOCK.finditer(text)
    ]


def run(name: str, found: list, folder: pathlib.Path) -> subprocess.CompletedProcess:
    """Runs a page's blocks in a folder, with the commands of this Python's environment; stdout is JSON of
    what each printed."""
    if not (folder / "examples").exists():
        (folder / "examples").symlink_to(pathlib.Path(__file__).resolve().parents[1] / "examples")
    paths = {
        "PATH": f"{pathlib.Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(
            filter(None, [str(pathlib.Path(biotac_mj.__file__).parents[1]), os.environ.get("PYTHONPATH")])
        ),
    }
    return subprocess.run(
        [sys.executable, "-c", _RUNNER],
        input=json.dumps([name, found, _SCENE]),
        cwd=folder,
        env={**os.environ, **paths},
        capture_output=True,
        text=True,
        timeout=60 * _MINUTES,
    )


def printed(done: subprocess.CompletedProcess) -> list[str]:
    """What each block printed."""
    return json.loads(done.stdout.splitlines()[-1])


def agree(written: str, got: str) -> bool:
    """Whether an output says the same: equal words, and numbers within 3 % or 3 in their last place, by which
    machines differ."""
    if _NUMBER.sub("#", written).split() != _NUMBER.sub("#", got).split():
        return False
    for a, b in zip(_NUMBER.findall(written), _NUMBER.findall(got)):
        place = 10.0 ** -len(a.partition(".")[2])
        if abs(float(a) - float(b)) > max(0.03 * abs(float(a)), 3 * place):
            return False
    return True


def pictures(text: str) -> list[str]:
    """Names of pictures that lie beside the page."""
    return re.findall(r"!\[[^\]]*\]\(([\w.-]+\.png)\)", text)


def with_output(text: str, outputs: list[str]) -> str:
    """The page with what its blocks printed; a block of a shell has none."""
    left = iter(outputs)

    def block(match):
        said = next(left)
        out = f"```{match[1]}\n{match[2]}```"
        return f"{out}\n\n```text\n{said}```" if said.strip() else out

    return BLOCK.sub(block, text)


def main(pages):
    for page in map(pathlib.Path, pages):
        text = page.read_text()
        with tempfile.TemporaryDirectory() as folder:
            done = run(str(page), blocks(text), pathlib.Path(folder))
            if done.returncode:
                sys.exit(done.stderr)
            for name in pictures(text):
                if (pathlib.Path(folder) / name).is_file():
                    shutil.copy(pathlib.Path(folder) / name, page.parent / name)
        page.write_text(with_output(text, printed(done)))
        print(f"{page}: {len(blocks(text))} blocks")


if __name__ == "__main__":
    main(sys.argv[1:])
