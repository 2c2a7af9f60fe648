"""The package's structure: no module imports itself by way of others, every folder imports only what LAYERS
allows, and the pages about the code name what is there."""

import ast
import collections
import pathlib
import re

import pytest
from imports import circles, imports, modules

REPO = pathlib.Path(__file__).parent.parent
pytestmark = pytest.mark.law
# What each folder may import, itself aside; a dotted name is that module alone.
LAYERS = {
    "arguments": "quiet files units",
    "cache": "files",
    "fields": "short_repr",
    "files": "short_repr",
    "short_repr": "",
    "reading": "short_repr",
    "launches": "kernels",
    "kernels": "",
    "lazy": "",
    "shards": "files versions",
    "threads": "",
    "triangles": "",
    "units": "short_repr",
    "versions": "biotac_mj",
    "geometry": "kernels cache short_repr fields files reading quiet triangles",
    "skin": "kernels cache short_repr lazy geometry fields files reading threads quiet launches triangles",
    "quiet": "launches",
    "sensor": "kernels cache short_repr lazy fields files geometry threads quiet launches",
    "effects": "short_repr lazy skin sensor geometry fields files reading",
    "coupling": "kernels cache short_repr lazy skin sensor effects geometry fields launches threads "
    "learning.serve",
    "plugin": "coupling",
    "batch": "kernels short_repr coupling skin sensor effects geometry fields learning.serve",
    "mjx": "batch coupling fields",
    "neighbours": "lazy batch coupling geometry recordings",
    "press": "lazy coupling plugin skin sensor geometry fields files reading short_repr triangles units "
    "versions view.offscreen",
    "differentiable": "kernels cache short_repr fields coupling plugin geometry skin sensor threads "
    "calibration recordings files press.indenter data.generation.clearance",
    "calibration": "cache geometry skin sensor.channels fields files reading press.indenter press.path "
    "recordings.formats.columns",
    "quality": "sensor.channels",
    "recordings": "short_repr lazy arguments quality sensor geometry fields files reading",
    "data": "kernels lazy recordings geometry skin sensor effects fields files reading shards triangles "
    "versions press.approach press.indenter press.path learning.serve",
    "tasks": "kernels cache short_repr lazy coupling plugin batch sensor effects geometry fields files "
    "reading triangles versions data.objects view.offscreen",
    "view": "lazy coupling plugin skin sensor geometry fields files reading triangles tasks press",
    "learning": "arguments recordings data sensor effects geometry fields files reading shards",
    "discrepancy": "cache lazy effects quality recordings matching data skin sensor geometry fields files "
    "reading press.approach",
    "matching": "cache skin sensor geometry recordings",
    "resimulation": "lazy arguments matching data recordings skin sensor geometry fields files shards",
    "samples": "coupling plugin press.indenter data resimulation quality recordings effects sensor geometry "
    "files",
    "biotac_mj": "lazy plugin",
}
ABOVE_ALL = {"cli", "__main__"}
# what the walk's rows name of other files and of MuJoCo
OTHERS = set("mjData plugin_state SkinData GeomSet condensed py".split())


@pytest.fixture(scope="module")
def graph():
    return imports(modules())


def test_circles_are_found():
    """A module of two others' circle, one in a function, one outside."""
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}, "e": set()}) == [["a", "b", "c"]]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_no_import_circles(graph):
    found = circles(graph)
    assert not found, "circles of imports: " + "; ".join(" - ".join(names) for names in found)


def test_folders_import_only_what_lies_below_them(graph):
    wrong = collections.defaultdict(set)
    for name, others in graph.items():
        folder = _folder(name)
        if folder in ABOVE_ALL:
            continue
        for other in others:
            allowed = LAYERS[folder].split()
            if _folder(other) not in {folder, *allowed} and other.removeprefix("biotac_mj.") not in allowed:
                wrong[folder].add(f"{name} imports {other}")
    assert not wrong, "\n".join(line for lines in wrong.values() for line in sorted(lines))


def test_design_has_a_row_for_every_folder_and_module():
    text = (REPO / "docs" / "design.md").read_text()
    rows = {name.strip("/") for row in re.findall(r"^\| .*?\|", text, re.M)
            for name in re.findall(r"`biotac_mj/([\w./]+)`", row)}  # fmt: skip
    there = {path.name for path in (REPO / "biotac_mj").iterdir() if path.name != "__pycache__"}
    assert rows == {name for name in there if not name.startswith(("__main__", "py."))}


def test_the_walk_names_at_most_12_files_and_what_is_in_them():
    text = (REPO / "docs" / "concepts" / "step.md").read_text()
    rows = re.findall(r"^\| (\d+) \| \[`(.+?)`\]\((.+?)\) \| (.+?) \|$", text, re.M)
    assert [int(row[0]) for row in rows] == list(range(1, len(rows) + 1)) and 8 <= len(rows) <= 12
    for _, name, link, about in rows:
        path = (REPO / "docs" / "concepts" / link).resolve()
        assert path == REPO / "biotac_mj" / name and path.is_file(), name
        defined = {node.name for node in ast.walk(ast.parse(path.read_text())) if hasattr(node, "name")}
        said = {part for word in re.findall(r"`([A-Za-z_][\w.]*)`", about) for part in word.split(".")}
        assert said - OTHERS <= defined, f"{name} has no {', '.join(said - OTHERS - defined)}"


def test_names_on_the_pages_about_the_code_exist():
    """Each word of a name in backticks, and of `Class.name` in a file that has that class."""
    pages = [REPO / "docs" / "design.md", *(REPO / "docs" / "concepts").glob("*.md")]
    text = re.sub(r"```.*?```", "", "".join(page.read_text() for page in pages), flags=re.S)
    there, of_class = {"LAYERS", "py"}, collections.defaultdict(set)
    for source in (path.read_text() for path in modules().values()):
        words = set(re.findall(r"\w+", source))
        there |= words
        for name in re.findall(r"^class (\w+)", source, re.M):
            of_class[name] |= words
    for name in re.findall(r"`([A-Za-z_][\w.]*)`", text):
        first, *others = (word for word in name.split(".") if word)
        gone = {first, *others} - (of_class[first] if others and first in of_class else there)
        assert not gone or name.endswith((".md", ".npz", ".json")), f"{name}: {gone} is in no module"


def test_no_bar_is_drawn_where_no_terminal_is():
    """tqdm looks itself where `disable` is None."""
    bars = [
        (name, {k.arg: ast.unparse(k.value) for k in node.keywords}.get("disable", "False"))
        for name, path in modules().items()
        if "tqdm" in path.read_text()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("tqdm", "tqdm.tqdm", "tqdm.trange")
    ]
    wrong = [f"{name}: disable={said}" for name, said in bars if not said.endswith(("None", "True"))]
    assert len(bars) > 10 and not wrong, "\n".join(wrong)


def test_no_kernel_has_tiles_of_warp():
    """On the CPU those of all threads of a process lie in one place (`biotac_mj.launches.recorded`)."""
    called = re.compile(r"\b(?:wp|warp)\.tile\w*\(")
    tiles = {name: called.findall(path.read_text()) for name, path in modules().items()}
    assert not any(tiles.values()), {name: found for name, found in tiles.items() if found}


def repeats(sources, length=12):
    """{where: where} of runs of lines that stand in two places of sources {name: text}, without imports,
    comments and empty lines."""
    first, found = {}, {}
    for name, text in sources.items():
        lines = [
            (number, line.strip())
            for number, line in enumerate(text.splitlines(), 1)
            if line.strip() and not line.strip().startswith(("#", "import ", "from "))
        ]
        for k in range(len(lines) - length + 1):
            run, here = tuple(line for _, line in lines[k : k + length]), f"{name}:{lines[k][0]}"
            if first.setdefault(run, here) != here:
                found[here] = first[run]
    return found


def test_no_run_of_twelve_lines_stands_twice():
    text = "\n".join(f"x{i} = {i}" for i in range(12))
    assert repeats({"a": text, "b": f"y = 0\n{text}"}) == {"b:2": "a:1"}
    assert not repeats({"a": text, "b": text[:-2]})
    assert not repeats({name: path.read_text() for name, path in modules().items()})


def too_large(text, parameters=12, lines=150):
    """[what] functions of a module with more parameters, besides self or cls, or more lines."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            a = node.args
            names = [arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg) if arg]
            count = len(names) - (names[:1] in (["self"], ["cls"]))
            length = node.end_lineno - node.lineno + 1
            if count > parameters or length > lines:
                found.append(f"{node.name}: {count} parameters, {length} lines")
    return found


def test_functions_and_files_are_of_a_size_to_read():
    assert not too_large("def f(self, a, *, b):\n    pass", 2, 2)
    assert too_large("def f(a, b, **c):\n    pass", 2, 2) and too_large("def f():\n    1\n    2", 2, 2)
    texts = {name: path.read_text() for name, path in modules().items()}
    large = [
        f"{name}: {len(text.splitlines())} lines" for name, text in texts.items() if text.count("\n") > 600
    ]
    large += [f"{name}.{one}" for name, text in texts.items() for one in too_large(text)]
    assert len(texts) > 400 and not large, "\n".join(large)


def test_names_of_tests_have_at_most_60_characters():
    tests = {
        path.name: re.findall(r"^ *(?:async )?def (test_\w+)", path.read_text(), re.M)
        for path in pathlib.Path(__file__).parent.glob("test_*.py")
    }
    long = [f"{file}: {name}" for file, names in tests.items() for name in names if len(name) > 60]
    assert sum(map(len, tests.values())) > 1000 and not long, "\n".join(long)


def _folder(name):
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else parts[0]
