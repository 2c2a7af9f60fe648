"""Chooses the quick tests and writes the others to tests/slow.txt, from what `tests/costs.py` measured:

    : > tests/slow.txt
    python -m pytest -n auto --dist loadfile -p tests.costs
    python scripts/quick_tests.py out/costs

Quick are tests that cost at most `--cheap` seconds, and those that cost at most `--line` seconds for each
line or kernel of the package that no cheaper quick test runs. Tests of the same lines hold different things:
the first case of a test function counts as ten lines more, that of a function marked `law` as 100: lines do
not tell what a test compares, so tests that hold a law of mechanics, that two engines agree, or a rule of the
source have this mark. The tests that need a module or a fixture share its cost.
"""

import argparse
import collections
import heapq
import json
import pathlib

SLOW = pathlib.Path(__file__).resolve().parents[1] / "tests" / "slow.txt"
_FUNCTION, _LAW = 10, 100  # lines that a test function counts as


def measured(folder: pathlib.Path) -> dict[str, dict]:
    """Name of a test -> its row of `tests/costs.py`."""
    files = sorted(folder.glob("*.jsonl"))
    return {row["test"]: row for file in files for row in map(json.loads, file.read_text().splitlines())}


def chosen(tests: dict[str, dict], line: float, cheap: float) -> tuple[set[str], float]:
    """Names of the quick tests, and what they cost [s of processor time].

    Args:
      tests: of `measured`.
      line: the most that a test may cost for each line and kernel that it adds [s].
      cheap: what a test may cost that adds nothing [s].
    """
    shared = collections.defaultdict(float)  # [s], of modules that are compiled and of fixtures
    for row in tests.values():
        for name, took in row["shared"].items():
            shared[name] = max(shared[name], took)
    needs = {name: [ran for ran in row["runs"] if ran in shared] for name, row in tests.items()}
    users = collections.Counter(thing for things in needs.values() for thing in things)
    cost = {
        name: row["seconds"] + sum(shared[thing] / users[thing] for thing in needs[name])
        for name, row in tests.items()
    }
    holds = {name: {ran for ran in row["runs"] if ran.startswith("biotac_mj")} for name, row in tests.items()}
    for name, held in holds.items():
        function, law = name.partition("[")[0], "law" in tests[name]["marks"]
        held.update((function, i) for i in range(_LAW if law else _FUNCTION))
    quick = {name for name in tests if cost[name] <= cheap}
    held = set().union(*map(holds.get, quick))
    queue = [(0.0, name) for name in sorted(tests.keys() - quick)]
    while queue:
        name = heapq.heappop(queue)[1]
        now = cost[name] / max(len(holds[name] - held), 1e-9)  # which grows as more is held
        if now > line:
            continue
        if queue and now > queue[0][0]:
            heapq.heappush(queue, (now, name))
            continue
        quick.add(name)
        held |= holds[name]
    used = {thing for name in quick for thing in needs[name]}
    return quick, sum(tests[name]["seconds"] for name in quick) + sum(map(shared.get, used))


def shortened(slow: set[str], quick: set[str]) -> list[str]:
    """Names of slow tests, that of the function alone where none of its cases is quick."""
    some = {name.partition("[")[0] for name in quick}
    return sorted({name if (function := name.partition("[")[0]) in some else function for name in slow})


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("costs", type=pathlib.Path, help="folder of tests/costs.py")
    parser.add_argument("--line", type=float, default=0.025, help="seconds for each line that a test adds")
    parser.add_argument("--cheap", type=float, default=0.03, help="seconds of a test that adds nothing")
    args = parser.parse_args()
    tests = measured(args.costs)
    quick, spent = chosen(tests, args.line, args.cheap)
    SLOW.write_text("".join(f"{name}\n" for name in shortened(set(tests) - quick, quick)))
    print(f"{len(quick)} of {len(tests)} tests are quick and take {spent:.0f} s of processor time")


if __name__ == "__main__":
    main()
