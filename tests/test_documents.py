"""README and the documentation do what they say: the blocks of a page run in order, in one folder, and print
what stands in the page. What cannot run in a test is named, with the reason; its commands are understood."""

import argparse
import ast
import functools
import importlib.util
import os
import pathlib
import re
import shlex

import pytest
from _pytest.mark.expression import Expression
from documents import BLOCK, agree, blocks, pictures, printed, run, with_output
from readers_files import lay

from biotac_mj import cli
from biotac_mj.view import find_gl

REPO = pathlib.Path(__file__).resolve().parents[1]
PAGES = [REPO / "README.md", REPO / "CONTRIBUTING.md", *sorted((REPO / "docs").rglob("*.md"))]
PAGES = [page for page in PAGES if page.name != "api.md" and "_build" not in page.parts]
NEEDS = dict.fromkeys(("ros.md", "recordings.md", "export.md"), "rosbags") | {"isaaclab.md": "mujoco_warp"}
NEIGHBOURS = {"mjlab.md": "mjlab", "mjx.md": "jax"}  # and JAX of gradients.md: `make test-neighbours`
FENCE = re.compile(r"^ *```.*?^ *```$", re.M | re.S)
HAND = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie")).resolve() / "shadow_hand"
# page and beginning of a block -> why no test of the pages runs it, and what tests it
LEFT_OUT = {
    ("README.md", "pip install ."): "a network; `make test-wheel` installs the wheel",
    ("CONTRIBUTING.md", "make test"): "it runs the tests",
    ("CONTRIBUTING.md", "git tag"): "a release; test_package.py has the notes",
    ("start.md", "git clone"): "a network; timed on a fresh clone in docs/lab/tests.md",
    ("start.md", "source .venv"): "the environment of make",
    ("start.md", "pip install ."): "a network; `make test-wheel` installs the wheel",
    ("gradients.md", "biotac lab estimate"): "a recording with places; test_differentiable_estimate.py",
    ("train.md", "biotac data generate --count 2600"): "a GPU; test_data_generate.py",
    ("data_sets.md", "biotac data generate --count 2600"): "a GPU; test_data_generate.py",
    ("recordings.md", "biotac data resimulate"): "a log of the reader's; test_resimulation.py",
    ("rendering.md", "biotac play ball"): "it serves until it is stopped; test_web_view.py",
    ("rendering.md", "biotac play insert_peg"): "minutes; test_tasks_batched.py",
    ("checkup.md", "# prompts them"): "a sensor; test_checkup.py",
    ("experiments.md", "biotac diagnose"): "a sensor; test_discrepancy_rounds.py",
    ("mjlab.md", "pip install"): "a network; `make test-neighbours` has installed it",
    ("cluster.md", "pip install"): "a network; test_shards.py has three nodes",
    ("cluster.md", "ray start"): "machines; test_shards.py has three nodes",
    ("isaaclab.md", "tip = robot"): "Isaac Lab",
    ("ros.md", "from biotac_mj.neighbours.ros"): "ROS; test_ros.py has doubles of rclpy and rospy",
    ("discrepancy.md", "from biotac_mj.discrepancy"): "data of the reader's; test_discrepancy_poses.py",
}


def left_out(page, text):
    """Why a block does not run, None: it runs."""
    for (name, begin), why in LEFT_OUT.items():
        if page.name == name and text.startswith(begin):
            return why
    if "shadow_hand/" in text and not HAND.is_dir():
        return "MuJoCo Menagerie, in MENAGERIE_ROOT"
    if text.startswith("import jax\n") and importlib.util.find_spec("jax") is None:
        return "JAX, of the extra mjx"
    if re.search(r"Offscreen|--render", text) and find_gl() is None:
        return "a GL library"
    return None


def commands(text):
    """Lines of the text's blocks that call biotac."""
    for line in re.findall(r"^    biotac (.*)$", text, re.M):
        yield line.replace("[", "").replace("]", "")  # what may be left out
    for language, _, block, _ in blocks(text):
        if language == "sh":
            yield from re.findall(r"^biotac (.*)$", block, re.M)


def mentions(text):
    """(verb and job, its options) of each `biotac ...` in a line of prose, of code or of help."""
    for words in re.findall(r"`biotac ([^`\n{]+)", text):
        found = re.match(r"[a-z-]+( [a-z]+)?", words)
        if found:
            yield found[0], re.findall(r"(?<![\w-])--[a-z][\w-]*", words)


def stale(text, known):
    """Names between backticks that only verbs could have, and no verb has: words with a verb's joined by a
    hyphen, and words in a list with at least two verbs."""
    words = {word for name in known for word in name.split()}
    joined = re.findall(r"`([a-z]+(?:-[a-z]+)+)[ `]", text)
    yield from (name for name in joined if name not in words and words & set(name.split("-")))
    for line in re.findall(r"`[^`\n]+`(?:(?:, and|,| and| or|, or)\s`[^`\n]+`)+", text):
        listed = re.findall(r"`(?:biotac )?([a-z]+(?: [a-z]+)?)`", line)
        wrong = [name for name in listed if not set(name.split()) <= words]
        yield from wrong if len(listed) - len(wrong) > 1 else ()


def verbs(parser=None, name=""):
    """{verb and job: its parser}, groups too."""
    parser = parser or cli.parser()
    found = {name: parser}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, inner in action.choices.items():
                found |= verbs(inner, f"{name} {word}".strip())
    return found


def test_a_block_that_fails_is_named_with_its_line(tmp_path):
    text = "# A\n\n```sh\necho a > f\n```\n```text\nfalse\n```\n```python\nn = 1\n```\n"
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


def test_every_block_runs_or_is_named():
    """A block has a language that says what becomes of it, and what is left out is there."""
    for page in PAGES:
        kinds = set(re.findall(r"^ *```([^\n`]+)$", page.read_text(), re.M))
        assert kinds <= {"sh", "python", "py", "text", "yaml", "bibtex"}, (page.name, kinds)
        if page.parent.name != "lab":  # what measures for hours stands there, and is understood
            assert not re.search(r"\n\n    \S", FENCE.sub("", page.read_text())), f"{page.name}: use a fence"
    found = [(page.name, text) for page in PAGES for _, _, text, _ in blocks(page.read_text())]
    for (name, begin), why in LEFT_OUT.items():
        assert any(n == name and text.startswith(begin) for n, text in found), (name, begin, why)


def test_what_prints_shows_what_it_prints():
    """Known before a page runs: an output that is not written after its block."""
    for page in PAGES:
        for language, line, text, written in blocks(page.read_text()):
            if language != "sh" and not left_out(page, text):
                assert written or "print(" not in text, (
                    f"{page.name}:{line} prints, and no output stands there"
                )


def test_commands_of_all_blocks_are_understood():
    """Verbs, options and choices of every line that calls biotac, comments left out."""
    shown = [line for page in PAGES for line in commands(page.read_text())]
    assert len(shown) > 60
    for line in shown:
        try:
            cli.parser().parse_args(shlex.split(line, comments=True))
        except (SystemExit, ValueError) as error:
            pytest.fail(f"biotac {line}: {error}")


def test_commands_that_prose_code_and_help_name_exist():
    """Verbs and options between backticks: in pages, docstrings, messages, and what --help prints."""
    known, seen, wrong = verbs(), 0, []
    said = {str(page.relative_to(REPO)): page.read_text() for page in [*PAGES, REPO / "docs" / "api.md"]}
    for folder in ("biotac_mj", "benchmarks", "examples", "scripts"):
        code = (REPO / folder).rglob("*.py")
        # a text of several literals is one
        said |= {str(p.relative_to(REPO)): re.sub(r'"\n\s*f?"', "", p.read_text()) for p in code}
    for name, parser in known.items():
        helps = [parser.description, parser.epilog, *(action.help for action in parser._actions)]
        said[f"biotac {name} --help"] = "\n".join(filter(None, helps))
    for where, text in said.items():
        wrong += [] if where == "docs/api.md" else [f"{where}: no verb {one}" for one in stale(text, known)]
        for words, options in mentions(text):
            verb = words if words in known else words.split()[0]
            one = verbs(known[verb], verb) if verb in known else {}  # of a group any job
            taken = {option for parser in one.values() for option in parser._option_string_actions}
            wrong += [f"{where}: biotac {words} {option}" for option in options if option not in taken]
            wrong += [] if one else [f"{where}: no biotac {words}"]
            seen += 1
    assert not wrong, "\n".join(wrong)
    assert seen > 200


@functools.cache
def arguments(path, alone=True):
    """({options}, {required options}) of a script; what modules beside it add may be given."""
    tree, taken, required = ast.parse(path.read_text()), set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom | ast.Import):
            names = [node.module] if isinstance(node, ast.ImportFrom) else [name.name for name in node.names]
            for beside in (path.parent / f"{name}.py" for name in filter(None, names)):
                if alone and beside.is_file():
                    taken |= arguments(beside, False)[0]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument":
            names = {one.value for one in node.args if isinstance(one, ast.Constant)}
            needed = [
                one for one in node.keywords if one.arg == "required" and ast.unparse(one.value) == "True"
            ]
            taken |= {name for name in names if name.startswith("--")}
            required |= names if needed else set()
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):  # added in a loop over names
            taken |= {f"--{node.value}"} if re.fullmatch(r"[a-z-]+", node.value) else set()
    return taken, required


def test_scripts_and_tests_that_pages_name_exist():
    """`python FILE ...` has the options that a page gives it and lacks none, `pytest ... -k WORDS` finds a
    test."""
    ours = r"(?:pytest|(?:benchmarks|examples|scripts)/\w+\.py)\b[^`\n]*"
    called = rf"(?:^    |`)(?:[A-Z_]+=\S+ )?(python )?(?:-m )?({ours})"
    found = {(page, *one) for page in PAGES for one in re.findall(called, page.read_text(), re.M)}
    wrong = []
    for page, python, line in found:
        words = shlex.split(re.sub(r"[][]", "", line), comments=True)
        where = f"{page.name}: {line}"
        if words[0] == "pytest":
            files = [REPO / word for word in words if word.startswith("tests/") and "*" not in word]
            tests = [name for file in files for name in re.findall(r"def (test_\w+)", file.read_text())]
            if "-k" in words:
                chosen = Expression.compile(words[words.index("-k") + 1])
                if not any(chosen.evaluate(lambda word, of=name: word in of) for name in tests):
                    wrong.append(f"{where}: no such test")
            continue
        taken, required = arguments(REPO / words[0])
        given = {word for word in words if word.startswith("--")}
        wrong += [f"{where} has no {option}" for option in given - taken]
        if python and len(words) > 1:
            wrong += [f"{where} needs {option}" for option in required - given]
    assert not wrong, "\n".join(wrong)
    assert len(found) > 60


@pytest.mark.slow
@pytest.mark.parametrize("path", [p for p in PAGES if BLOCK.search(p.read_text())], ids=lambda p: p.name)
def test_blocks_run_in_order(path, tmp_path):
    for needed in filter(None, (NEEDS.get(path.name), NEIGHBOURS.get(path.name))):
        pytest.importorskip(needed, reason=f"{path.name} needs {needed}")
    name, text = str(path.relative_to(REPO)), path.read_text()
    found = [block for block in blocks(text) if not left_out(path, block[2])]
    lay(path.name, tmp_path)
    if HAND.is_dir():
        (tmp_path / "shadow_hand").symlink_to(HAND)
    done = run(name, found, tmp_path)
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    for (_, line, _, written), got in zip(found, printed(done), strict=True):
        assert agree(written, got), f"{name}, line {line}: prints\n{got}\nand the page has\n{written}"
    for picture in pictures(text):
        assert (path.parent / picture).is_file()
