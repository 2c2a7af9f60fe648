"""How the quick tests are chosen (scripts/quick_tests.py), and that tests/slow.txt names tests that exist."""

import ast
import json

import pytest
from quick_tests import SLOW, chosen, measured, shortened


def row(test, seconds, *runs, shared=None, marks=()):
    return {"test": test, "marks": marks, "seconds": seconds, "runs": list(runs), "shared": shared or {}}


def lines(*numbers):
    return [f"biotac_mj/a.py:{number}" for number in numbers]


def quick(*rows, line=0.1, cheap=0.1):
    return chosen({row["test"]: row for row in rows}, line, cheap)


def test_of_tests_of_the_same_lines_the_cheapest_is_quick():
    same = lines(*range(30))
    found, seconds = quick(row("t::a", 3, *same), row("t::b", 2, *same), row("t::c", 2.5, *same))
    assert found == {"t::b"} and seconds == 2


def test_a_line_of_its_own_keeps_a_dear_test_up_to_its_worth():
    for last, kept in ((31, False), (49, True)):
        rows = row("t::a", 2, *lines(*range(30))), row("t::b", 2.5, *lines(*range(last)))
        assert ("t::b" in quick(*rows)[0]) == kept


def test_one_case_of_a_function_stays_where_all_run_the_same():
    same = lines(*range(30))
    rows = [row(f"t::f[{i}]", 0.5 + 0.1 * i, *same) for i in range(3)]
    found, _ = quick(row("t::a", 0.05, *same), *rows)
    assert found == {"t::a", "t::f[0]"}
    assert shortened({"t::f[1]", "t::f[2]", "t::g[0]", "t::g[1]"}, found) == ["t::f[1]", "t::f[2]", "t::g"]


def test_a_law_is_worth_more_than_its_lines():
    same = row("t::a", 0.05, *lines(*range(30)))
    for marks, kept in (((), set()), (["law"], {"t::f[0]"})):
        laws = [row(f"t::f[{i}]", 4 + i, *lines(*range(30)), marks=marks) for i in range(2)]
        assert quick(same, *laws)[0] == {"t::a"} | kept


def test_a_module_is_compiled_once_and_shared():
    shared = {"m 12ab": 4.0}
    runs = [f"biotac_mj/a.py:{i}" for i in range(15)]
    rows = row("t::a", 0.1, *runs, "m 12ab", shared=shared), row("t::b", 0.2, *lines(20), "m 12ab")
    assert quick(*rows) == ({"t::a"}, 4.1)
    assert quick(*rows, line=0.2) == ({"t::a", "t::b"}, 4.1 + 0.2)


def test_rows_of_all_processes_are_read(tmp_path):
    for process, test in enumerate("ab"):
        (tmp_path / f"{process}.jsonl").write_text(json.dumps(row(test, 1.0)) + "\n")
    assert measured(tmp_path).keys() == {"a", "b"}


@pytest.mark.law
def test_slow_txt_names_tests_that_exist(repo):
    names = SLOW.read_text().splitlines()
    assert names == sorted(set(names)) and names
    functions = {}
    for name in names:
        file, _, test = name.partition("::")
        if file not in functions:
            tree = ast.parse((repo / file).read_text())
            functions[file] = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        assert test.partition("[")[0] in functions[file], f"slow.txt: {name} is gone, take it out"
