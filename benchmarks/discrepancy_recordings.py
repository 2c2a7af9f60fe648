"""Plain recordings with a hidden effect: what `biotac diagnose --electrodes` names, over many recordings of
our own making.

    python benchmarks/discrepancy_recordings.py --count 2 --null 10 --seeds practice --json
    out/recordings.json

The recordings are made by `discrepancy_recordings_generator.py`. A run goes on where its JSON ends.
"""

import argparse
import collections
import hashlib
import json
import pathlib
import tempfile
import time

import numpy as np
from discrepancy_recordings_generator import ALSO, NATURAL, OUTSIDE, SEEDS, hide

__all__ = ["diagnose", "right", "score", "table"]


def right(effect, truth):
    """Whether an effect of a verdict is the hidden one, on its channel."""
    wanted = ALSO.get(truth["effect"], {truth["effect"]})
    if not (effect["id"] in wanted or wanted & set(effect["ties"])):
        return False
    single = truth["effect"] in ("drift", "jump", "gain", "stuck", "noise", "spikes", "saturate", "swap")
    return bool(not single or {f"e{k + 1}" for k in truth["channels"]} & set(effect["channels"]))


def score(verdict, truth):
    """hit, extra ids, whether the gap or the effect's own number shrank."""
    named = [e["id"] for e in verdict["effects"]]
    natural = NATURAL.get(truth["base"], set())
    wanted = ALSO.get(truth["effect"], {truth["effect"]})
    ok = [e for e in verdict["effects"] if right(e, truth)]
    extra = [i for i in named if i not in natural and i not in wanted]
    if truth["effect"] == "none":
        return (
            (not extra and (bool(natural) or verdict["verdict"] == "no significant disagreement")),
            extra,
            True,
        )
    if truth["effect"] in OUTSIDE:
        return "unknown" in verdict["verdict"], extra, True
    shrunk = any(
        e["gap"] and e["gap"].get("before") is not None and e["gap"]["after"] < e["gap"]["before"] for e in ok
    )
    return bool(ok), extra, shrunk


def main(argv=None):
    args = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    args.add_argument("--count", type=int, default=3)
    args.add_argument("--null", type=int, help="recordings without effect on each base, default: count")
    args.add_argument("--seeds", choices=SEEDS, default="development")
    args.add_argument("--only", nargs="*")
    args.add_argument("--base")
    args.add_argument("--json")
    args.add_argument("--verbose", action="store_true")
    args = args.parse_args(argv)
    rows = []
    path = pathlib.Path(args.json) if args.json else None
    if path and path.exists():
        rows = json.loads(path.read_text())["cases"]
    done = {(r["seeds"], r["case"]) for r in rows}
    with tempfile.TemporaryDirectory() as folder:
        for name, make in hide(args.count, args.seeds, args.only, args.base, args.null):
            if (args.seeds, name) in done:
                continue
            rows.append({"case": name, "seeds": args.seeds, **diagnose(make, pathlib.Path(folder))})
            r = rows[-1]
            if args.verbose or not r["hit"] or r["extra"]:
                mark = "ok  " if r["hit"] else "MISS"
                print(
                    f"{mark} {name} {r['channels'][:3]} {r['rate']:g} Hz extra {r['extra']}: "
                    f"{r['verdict'][:230]}",
                    flush=True,
                )
            if path:
                path.parent.mkdir(parents=True, exist_ok=True)
                part = path.with_suffix(".part")
                part.write_text(json.dumps({"code": code_hash(), "cases": rows}, indent=1))
                part.replace(path)
    print(table(rows))


def diagnose(make, folder):
    """Runs one case as a user would, through text files, and scores it."""
    from biotac_mj.discrepancy import diagnose_recording, read_recording
    from biotac_mj.discrepancy.recordings.report import verdict_dict

    e, force, rate, truth = make()
    paths = folder / "e.txt", folder / "f.txt"
    np.savetxt(paths[0], e, fmt="%d")
    if force is not None:
        np.savetxt(paths[1], force, fmt="%.5f")
    began = time.process_time()
    verdict = verdict_dict(
        diagnose_recording(read_recording(paths[0], None if force is None else paths[1], None, rate))
    )
    hit, extra, shrunk = score(verdict, truth)
    natural = NATURAL.get(truth["base"], set())
    named = [
        {
            "id": f["id"],
            "nats": f["nats"],
            "ties": f["ties"],
            "confirmed": f["confirmed"],
            "confidence": f["confidence"],
            "natural": f["id"] in natural and f["id"] != truth["effect"],
            "right": right(f, truth),
        }
        for f in verdict["effects"]
    ]
    views = {k: (v["before"], v["after"]) for k, v in verdict["gap"].items()}
    return {
        **truth,
        "force": force is not None,
        "rate": rate,
        "rows": len(e),
        "seconds": time.process_time() - began,
        "hit": bool(hit),
        "extra": extra,
        "shrunk": bool(shrunk),
        "verdict": verdict["verdict"],
        "named": named,
        "views": views,
    }


def code_hash():
    """Of everything that decides a verdict: written beside the results, so that a frozen run can be told."""
    folder = pathlib.Path(__file__).parents[1] / "biotac_mj/discrepancy"
    files = [folder / "evidence.py", folder / "noise.py", *sorted((folder / "recordings").rglob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def table(rows):
    """Rows by base: without effect, inside and outside the catalogue."""
    heads = (
        ("no effect", 11),
        ("false", 7),
        ("hidden", 8),
        ("right", 7),
        ("with extras", 13),
        ("outside", 9),
        ("unknown", 9),
        ("worse view", 12),
    )
    lines = [f"{'base':<30}" + "".join(f"{head:>{width}}" for head, width in heads)]
    groups = collections.defaultdict(list)
    for r in rows:
        groups[r["base"] + (" with force" if r["force"] else "")].append(r)
    for base, members in [*groups.items(), ("all", rows)]:
        none = [r for r in members if r["effect"] == "none"]
        outside = [r for r in members if r["effect"] in OUTSIDE]
        inside = [r for r in members if r["effect"] != "none" and r["effect"] not in OUTSIDE]
        worse = sum(any(after > 1.02 * before for before, after in r["views"].values()) for r in members)
        counts = (
            len(none),
            sum(bool(r["extra"]) for r in none),
            len(inside),
            sum(r["hit"] for r in inside),
            sum(bool(r["extra"]) for r in inside),
            len(outside),
            sum(r["hit"] for r in outside),
            worse,
        )
        lines.append(f"{base:<30}" + "".join(f"{value:>{width}}" for value, (_, width) in zip(counts, heads)))
    lines.append("")
    for effect in dict.fromkeys(r["effect"] for r in rows):
        mine = [r for r in rows if r["effect"] == effect]
        wrong = collections.Counter(i for r in mine for i in r["extra"])
        lines.append(
            f"{effect:<14}{sum(r['hit'] for r in mine):>4} of "
            f"{len(mine):<4}{', '.join(f'{k} {v}' for k, v in wrong.items())}"
        )
    lines += ["", f"{'confidence':<14}names, right"]
    for value in sorted({round(f["confidence"], 3) for r in rows for f in r["named"]}):
        told = [
            f["right"] or f["natural"] for r in rows for f in r["named"] if round(f["confidence"], 3) == value
        ]
        lines.append(f"{value:<14}{len(told):>4}{sum(told):>7}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
