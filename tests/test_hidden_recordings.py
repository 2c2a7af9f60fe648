"""The runner of recordings with hidden effects imports its generators, scores names and goes on."""

import importlib
import json
import re
import sys
import types

import pytest

WORDS = """
import dataclasses

import numpy as np

ACCEPTED = {"stuck": {"stuck"}, "lost": {"lost_rows"}, "other": {"other"}}
SINGLE, OUTSIDE, NATURAL = {"stuck"}, {"other"}, {}


@dataclasses.dataclass
class Case:
    base: str
    counts: np.ndarray
    rate: float
    truth: list
    channels: list
    forms: list = dataclasses.field(default_factory=list)
    gaps: list = dataclasses.field(default_factory=list)
    force: np.ndarray | None = None
    tdc: np.ndarray | None = None
    time: np.ndarray | None = None
"""
AUTHOR = """
import types

import numpy as np

from authors.second import Case as _same_package
from .vocabulary import KINDS

NATURAL = {"synthetic": {"warmup"}}


def plan():
    return [types.SimpleNamespace(name=name) for name in ("none", "stuck", "short")]


def make(spec, data):
    rng = np.random.default_rng(3)
    loads = np.sin(np.outer(np.arange(1500) / 100, [1.3, 2.1, 3.4]))
    x = np.rint(2500 + loads @ rng.uniform(-300, 300, (3, 19)) + 3 * rng.standard_normal((1500, 19)))
    clean = x.copy()
    if spec.name == "stuck":
        x[600:, 4] = x[600, 4]
    hidden = [KINDS["stuck"]] if spec.name == "stuck" else []
    n = 60 if spec.name == "short" else 1500
    case = dict(base="synthetic", counts=x[:n], rate=100.0, truth=hidden, channels=[[4]] * len(hidden))
    return case, clean[:n]
"""


@pytest.fixture
def runner(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "benchmarks"))
    yield importlib.import_module("discrepancy_recordings")
    for name in [n for n in sys.modules if n.split(".")[0] == "authors"]:
        del sys.modules[name]


@pytest.fixture
def folder(tmp_path):
    """Synthetic: of three pieces nothing is hidden in one, and one is too short to be diagnosed."""
    folder = tmp_path / "generators"
    folder.mkdir()
    for name, text in {
        "__init__": "",
        "vocabulary": 'KINDS = {"stuck": "stuck"}',
        "second": WORDS,
        "made_up": AUTHOR,
    }.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def test_pieces_of_a_folder_are_scored_once(runner, folder, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out.json"
    given = [str(tmp_path), "--authors", str(folder), "--half", "made_up", "--json", str(out), "--jobs", "1"]
    runner.main(given)
    said = capsys.readouterr()
    assert "single effects named                           1 of 1" in said.out
    assert "falsely named where nothing is hidden          0 of 1" in said.out
    assert "made_up ['short']: 60 rows are too few" in said.out + said.err
    rows = {row["key"][0]: row for row in json.loads(out.read_text())["cases"]}
    assert [n["right"] for n in rows["stuck"]["named"] if n["channels"] == ["e5"]] == ["stuck"]
    before = out.read_text()
    monkeypatch.setattr(runner, "judge", None)  # whatever is diagnosed once more fails
    runner.main(given)
    assert out.read_text() == before


def test_a_name_is_right_on_the_channel_and_at_the_time_alone(runner, folder, tmp_path):
    authors = runner.Authors(folder, tmp_path, [1])
    case = types.SimpleNamespace(
        base="synthetic", truth=["stuck", "lost"], channels=[[4], range(19)], rate=100.0, gaps=[500]
    )

    def right(name, channels=("e1",), ties=(), places=()):
        effect = dict(id=name, ties=ties, channels=channels, places=places)
        return runner.right(effect, case, authors)

    assert right("stuck", ["e5"]) == "stuck" and right("stuck", ["e6"]) is None
    assert right("saturate", ["e5"], ties=["stuck"]) == "stuck"
    assert right("lost_rows", places=[5.05]) == "lost" and right("lost_rows", places=[5.5]) is None
    assert right("warmup") == "natural" and right("hum", ties=["warmup"]) is None


def test_a_folder_or_an_author_that_is_not_there_is_said(runner, folder, tmp_path, capsys):
    for wrong, half, text in (
        (tmp_path, "made_up", "has no vocabulary.py: give the folder of the authors' modules"),
        (folder, "nobody", "no author 'nobody' in .*: choose from practice, .* made_up"),
    ):
        with pytest.raises(SystemExit):
            runner.main(["data", "--authors", str(wrong), "--half", half, "--json", str(tmp_path / "o.json")])
        assert re.search(text, capsys.readouterr().err)
