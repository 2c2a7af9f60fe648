"""The catalogue of effects: what stands in it, and that nothing outside it decides by an effect's id."""

import ast
import pathlib
import re

import numpy as np
import pytest
from imports import modules

from biotac_mj.discrepancy.recordings.recording import PlainRecording
from biotac_mj.discrepancy.recordings.search import diagnose_recording
from biotac_mj.effects.catalogue import CATALOGUE, by_id, entries
from biotac_mj.effects.effect import STAGES, Effect, Param, Run
from biotac_mj.sensor.channels import counts_from_log_impedance

# --- decisions by an effect's id

ID_NAMES = frozenset({"id", "id_", "ids"})  # arguments that hold ids, beside attributes `.id`
BINDS = (ast.Assign, ast.AnnAssign, ast.NamedExpr, ast.For, ast.comprehension)
ITERATES = {"dict", "enumerate", "frozenset", "list", "next", "reversed", "set", "sorted", "tuple", "zip"}


class Decisions(ast.NodeVisitor):
    """Where code compares an id with a string that is one, looks one up by it, or joins it with a set of
    them. Followed are `.id`, what is assigned from it, and literals that have a name.

    Attributes:
      known: the ids. ids: names that hold ids. texts: names of literals -> their ids. found: (line, text).
    """

    def __init__(self, known, ids=ID_NAMES, texts=None):
        self.known, self.ids, self.texts, self.found = known, set(ids), dict(texts or {}), []

    def of(self, tree, tables=frozenset()):
        """Found in a module; tables: names of others' tables by ids, which it may import."""
        defined = ast.FunctionDef, ast.ClassDef
        top = ast.Module([n for n in tree.body if not isinstance(n, defined)], [])
        imported = {a.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names}
        self.ids |= imported & tables
        self.read(top)
        for body in (n for n in tree.body if isinstance(n, defined)):
            for one in body.body if isinstance(body, ast.ClassDef) else [body]:
                inside = Decisions(self.known, self.ids, self.texts)
                inside.read(one)
                self.found += inside.found
        return self.found

    def read(self, tree):
        """Finds what is bound in a tree of one scope, then what is decided there."""
        bound, before = [n for n in ast.walk(tree) if isinstance(n, BINDS)], None
        while before != (before := (len(self.ids), len(self.texts))):
            for node in bound:
                self._bind(node)
        self.visit(tree)

    def _bind(self, node):
        value = node.iter if isinstance(node, (ast.For, ast.comprehension)) else node.value
        ids, texts = value and self._holds_id(value), value and self._texts(value)
        for target in getattr(node, "targets", None) or [node.target]:
            for name in (n.id for n in ast.walk(target) if (ids or texts) and isinstance(n, ast.Name)):
                self.ids |= {name} if ids else set()
                self.texts |= {name: texts} if texts else {}

    def _holds_id(self, node):
        """Whether an expression is an id, or a collection of ids."""
        if isinstance(node, ast.Attribute):
            return node.attr == "id"
        if isinstance(node, ast.Name):
            return node.id in self.ids
        if isinstance(node, (ast.GeneratorExp, ast.ListComp, ast.SetComp)):
            return self._holds_id(node.elt)
        if isinstance(node, ast.DictComp):
            return self._holds_id(node.key)
        if isinstance(node, ast.Call):
            parts = node.args if getattr(node.func, "id", "") in ITERATES else []
        elif isinstance(node, ast.Dict):
            parts = filter(None, node.keys)
        elif isinstance(node, ast.IfExp):
            parts = [node.body, node.orelse]
        elif isinstance(node, (ast.Starred, ast.Subscript, ast.NamedExpr)):
            parts = [node.value]
        elif isinstance(node, ast.BinOp):
            parts = [node.left, node.right]
        else:
            parts = getattr(node, "elts", None) or getattr(node, "values", [])
        return any(map(self._holds_id, parts))

    def _texts(self, node):
        """Ids that an expression names."""
        if isinstance(node, ast.Constant):
            return {node.value} & self.known if isinstance(node.value, str) else set()
        if isinstance(node, ast.Name):
            return self.texts.get(node.id, set())
        if isinstance(node, ast.Dict):
            parts = filter(None, node.keys)
        elif isinstance(node, ast.Call):
            parts = node.args if getattr(node.func, "id", "") in ITERATES else []
        else:
            parts = [node.value] if isinstance(node, ast.Starred) else getattr(node, "elts", [])
        return set().union(*map(self._texts, parts))

    def _meet(self, node, one, other):
        if self._holds_id(one) and self._texts(other) or self._holds_id(other) and self._texts(one):
            self.found.append((node.lineno, ast.unparse(node)))

    def visit_Compare(self, node):
        sides = [node.left, *node.comparators]
        for one, other in zip(sides, sides[1:]):
            self._meet(node, one, other)
        self.generic_visit(node)

    def visit_BinOp(self, node):
        self._meet(node, node.left, node.right)
        self.generic_visit(node)

    def visit_Subscript(self, node):
        self._meet(node, node.value, node.slice)
        self.generic_visit(node)

    def visit_Call(self, node):
        if isinstance(node.func, ast.Attribute):
            for arg in node.args[:1]:
                self._meet(node, node.func.value, arg)
        called = getattr(node.func, "id", "") or getattr(node.func, "attr", "")
        if called == "by_id" and node.args and self._texts(node.args[0]):
            self.found.append((node.lineno, ast.unparse(node)))
        self.generic_visit(node)

    def visit_Match(self, node):
        for case in node.cases:
            for value in (n.value for n in ast.walk(case.pattern) if isinstance(n, ast.MatchValue)):
                self._meet(case.pattern, node.subject, value)
        self.generic_visit(node)


@pytest.mark.parametrize(
    "code, number",
    [
        ('if e.id == "gain" or e.id in ("swap", "x"): pass', 2),
        ('{"drift": 1}[by_id("noise").id]', 2),
        ('KIN = {"gain": 1}\nKIN.get(e.id)\nKIN[e.id]', 2),
        ('one = e.id\nother = one\nif other != "gain": pass', 1),
        ('A = "gain"\nB = {A, "x"}\n[e for e in all if e.id in B]', 1),
        ('names = [e.id for e in all]\nif "gain" in names: pass', 1),
        ('by = {e.id: e for e in all}\nby["gain"]\nby.get("swap")', 2),
        ('{"gain", "swap"} & {f.id for f in found}', 1),
        ('match e.id:\n    case "gain" | "swap": pass', 2),
        ('def f(ids): return "gain" in ids', 1),
        ('f("gain", e.id)\n{"gain": 1}["drift"]\n{"noise": noise}', 0),
        ('if e.id == other.id or e.id == "mine" or e.stage == "gain": pass', 0),
    ],
)
def test_decisions_by_an_id_are_found(code, number):
    found = Decisions({"gain", "swap", "drift", "noise"}).of(ast.parse(code))
    assert len(found) == number, found


def test_no_decision_by_an_id_outside_the_catalogue():
    known, tables, found = {e.id for e in (*entries("poses"), *entries("log"))}, set(), {}
    texts = {name: pathlib.Path(path).read_text() for name, path in modules().items()}
    for text in (t for t in texts.values() if ".id" in t):
        top = Decisions(known, ())
        top.read(ast.Module([n for n in ast.parse(text).body if isinstance(n, ast.Assign)], []))
        tables |= top.ids
    named = re.compile("|".join(f"[\"']{name}[\"']" for name in known))
    for name, text in texts.items():
        if named.search(text) and not name.startswith("biotac_mj.effects"):
            lines = Decisions(known).of(ast.parse(text), tables)
            found |= {name: lines} if lines else {}
    assert {"KINDS", "RANDOM"} <= tables
    assert not found, f"make a decision by an effect's id an attribute of the effect: {found}"


@pytest.mark.parametrize("fits", ["poses", "log"])
def test_ids_stand_once_and_parameters_lie_within_bounds(fits):
    found = entries(fits)
    assert len({e.id for e in found}) == len(found) > 10
    for effect in found:
        assert effect.stage in STAGES and effect.name and effect.physics and effect.params, effect.id
        for name, p in effect.params.items():
            assert p.low < p.high and p.unit and p.source, (effect.id, name)
            assert p.low <= p.start <= p.high or fits == "log", (effect.id, name)


def test_the_search_with_poses_has_the_effects_that_it_can_fit():
    assert entries("poses") == CATALOGUE and all("poses" in e.fits for e in CATALOGUE)
    assert {e.id for e in entries("log")} - {e.id for e in CATALOGUE} == {
        *("count_offset", "count_gain", "flip", "stuck", "force_late", "freeze"),
        *("lost_rows", "quantise", "spikes", "hum", "noise", "common_noise"),
    }


def test_effects_confused_with_each_other_are_known():
    searched = (*entries("poses"), *entries("log"))
    known = {e.id for e in searched} | {by_id("modulus").id, "base"}  # what the base model is off by
    for effect in searched:
        assert {*effect.confusable, *effect.equivalents, *effect.refit_with} <= known, effect.id


# --- faults of a log


def at_rest(seconds=60, seed=0):
    """Counts of a sensor that nothing touches, their rests [ln ohm], and their noise's generator."""
    rng, n = np.random.default_rng(seed), int(100 * seconds)
    log_z = np.log(1e4) + rng.uniform(-1, -0.2, 19)
    return np.tile(counts_from_log_impedance(log_z - np.log(1e4)), (n, 1)), log_z, rng


@pytest.mark.parametrize("name", ["stuck", "hum", "noise"])
def test_a_fault_of_the_catalogue_is_diagnosed_as_itself(name):
    counts, _, rng = at_rest()
    time, channels = np.arange(len(counts)) / 100, range(19) if name == "hum" else [5]
    counts = counts + 4 * rng.standard_normal(counts.shape)
    if name == "stuck":
        counts[:, 5] = 900.0
    elif name == "hum":
        counts += 8.0 * np.sin(2 * np.pi * 12.5 * time)[:, None]
    else:
        counts[:, 5] += 12.0 * rng.standard_normal(len(counts))
    found = diagnose_recording(PlainRecording(np.clip(np.rint(counts), 0, 4095), rate=100.0))
    assert [f.id for f in found.findings] == [name] and list(found.findings[0].channels) == list(channels)


def test_an_effect_is_one_class():
    """What it says of itself is all that the searches ask for."""

    class Half(Effect):
        id, name, stage = "half", "one half of the multiplexer creeps", "A"
        params = {"rate": Param("counts/s", -5, 5, "a made-up board", 0.1)}

        def apply(self, run, theta):
            run.counts[:, ::2] += theta["rate"] * run.clock[:, None]

    effect, (counts, log_z, _) = Half(), at_rest(1)
    time = np.arange(len(counts)) / 100
    run = Run.of_counts(counts.copy(), log_z, time=time)
    effect.apply(run, {"rate": 2.0})
    assert np.allclose((run.counts - counts)[-1], np.where(np.arange(19) % 2, 0, 2 * run.time[-1]))
    assert not (effect.before_skin or effect.per_channel or effect.undoes({}, 1.0))
