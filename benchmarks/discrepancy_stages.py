"""How far the evidence of hidden effects gets in the diagnosis of plain recordings: the last stage of each.

    python benchmarks/discrepancy_stages.py out/fourteenth.json ...

Reads what `discrepancy_recordings.py` wrote. Of every kind: named, refused by the part kept aside, a
candidate that is too unsure (from 0.5 on unknown with that name as a guess) or whose blocks differ, none at
all; and how many of those an observer sees who has the signal without what is hidden. Of every family:
candidates, and how many are right, by what confidence says of them.
"""

import argparse
import collections
import json
import pathlib

from authors.second import OUTSIDE
from discrepancy_observer import SEEN

__all__ = ["stage"]

_FLIPS = 0.02
STAGES = ("named", "kept aside", "0.5 or more", "below 0.5", "blocks differ", "no candidate")
_BINS = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


def stage(row: dict) -> str:
    """The last of STAGES that the only effect of a piece reached."""
    hidden = row["truth"][0]
    if any(n["right"] == hidden for n in row["named"]):
        return "named"
    found = [n for n in row["weak"] if n["right"] == hidden]
    if any(n["contradicted"] for n in found):
        return "kept aside"
    sure = [n["confidence"] for n in found if n["p"] < _FLIPS]
    if sure:
        return "0.5 or more" if max(sure) >= 0.5 else "below 0.5"
    return "blocks differ" if found else "no candidate"


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("json", nargs="+")
    args = args.parse_args(argv)
    rows = [r for f in args.json for r in json.loads(pathlib.Path(f).read_text())["cases"]]
    kinds = collections.defaultdict(collections.Counter)
    for r in rows:
        if len(r["truth"]) == 1 and not set(r["truth"]) & OUTSIDE:
            kinds[r["truth"][0]][stage(r)] += 1
            kinds[r["truth"][0]]["seen"] += (r.get("detectable") or SEEN) >= SEEN
    print(f"{'kind':<14}" + "".join(f"{s:>15}" for s in (*STAGES, "seen")))
    for kind, counts in [*sorted(kinds.items()), ("all", sum(kinds.values(), collections.Counter()))]:
        print(f"{kind:<14}" + "".join(f"{counts[s]:>15}" for s in (*STAGES, "seen")))
    families = collections.defaultdict(list)
    for r in rows:
        for n in (*r["named"], *(n for n in r["weak"] if n["p"] < _FLIPS)):
            if n["right"] != "natural":
                families[n["family"]].append((n["confidence"], n["right"] is not None))
    print("\nright of all candidates, by confidence\n" + " " * 14 + "".join(f"{b:>10}" for b in _BINS[:-1]))
    for family, said in sorted(families.items()):
        cells = [[right for p, right in said if a <= p < b] for a, b in zip(_BINS[:-1], _BINS[1:])]
        print(f"{family:<14}" + "".join(f"{f'{sum(c)}/{len(c)}' if c else '':>10}" for c in cells))


if __name__ == "__main__":
    main()
